//! Both loops in one process, over the in-process link: deterministic, and open to a debugger.

use delmpc_controller_process::controller_loop::ControllerLoop;
use delmpc_controller_process::membership::Alone;
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::{Command, PlantState};
use delmpc_transport::{RunId, in_process_link};

use crate::controller::part;
use crate::log::Log;
use crate::part::{leave_part, message_run_id};
use crate::robot_controller::RobotController;
use crate::simulated_robot::SimulatedRobot;
use crate::plant::log_head;
use crate::plant_process::PlantLoop;
use crate::run_folder::{CONTROLLER_PART, PLANT_PART, RunFolder};
use crate::setup::Setup;
use crate::supervisor::Course;
use crate::verdict::Failure;

/// Runs a lockstep scenario to its end.
///
/// # Errors
/// [`Failure::Input`] when a part cannot be made of the scenario, [`Failure::Fault`] when the log cannot be written.
pub fn run_in_one_process(setup: &Setup, folder: &RunFolder, stop: &StopFlag) -> Result<Course, Failure> {
    let scenario = &setup.scenario;
    let mut robot = SimulatedRobot::new(setup)?;
    let mut controller = RobotController::new(setup)?;
    let log = Log::create(&folder.file("log.mcap"), log_head(setup, RunId(0)), true)?;
    let (run, hash) = (message_run_id(RunId(0), scenario), setup.joint_set_hash());
    let joints = setup.robot.joint_names.len() as u32;
    let (states, states_in) = in_process_link::<PlantState>();
    let (commands, commands_in) = in_process_link::<Command>();
    let plant_loop = PlantLoop::new(scenario, states, commands_in, &PlantState::new(run, hash, joints), log);
    let controller_loop = ControllerLoop::new(scenario, states_in, commands, &Command::new(run, hash, joints));

    let (plant, controller) = std::thread::scope(|scope| {
        let attendance = Alone(stop.clone());
        let controller = scope.spawn(move || {
            let _last_words = LastWords(attendance.0.clone());
            controller_loop.run(&mut controller, &mut attendance.clone())
        });
        let plant = plant_loop.run(&mut robot, &mut Alone(stop.clone()));
        if plant.is_err() {
            stop.set(); // the controller waits for a state that will not come
        }
        (plant, controller.join())
    });
    let (_, mut plant_part, log) = match plant {
        Ok(outcome) => outcome,
        Err(fault) => return Ok(Course::Fault(fault.to_string())),
    };
    plant_part.log_records_dropped = log.finish()?;
    let controller = controller.map_err(|_| Failure::Fault("the controller broke down".to_owned()))?;
    let (_, figures) = controller.map_err(Failure::fault)?;
    leave_part(Some(folder.path()), PLANT_PART, &plant_part)?;
    leave_part(Some(folder.path()), CONTROLLER_PART, &part(scenario, &figures))?;
    Ok(if stop.is_set() { Course::Interrupted } else { Course::Finished })
}

/// A controller that breaks down must not leave the plant waiting.
struct LastWords(StopFlag);

impl Drop for LastWords {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.set();
        }
    }
}
