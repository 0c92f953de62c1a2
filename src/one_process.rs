//! Both loops in one thread, over the in-process link: deterministic, fast, and open to a debugger.
//!
//! The plant's loop runs; where it looks for the answer to a state, the controller gives it.

use delmpc_controller_process::controller_loop::ControllerLoop;
use delmpc_controller_process::figures::CycleFigures;
use delmpc_controller_process::membership::Alone;
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::{Command, PlantState};
use delmpc_transport::{LinkError, Publisher, RunId, Subscriber, in_process_link};

use crate::controller::part;
use crate::faults::{FaultyController, FaultyPlant};
use crate::log::Log;
use crate::part::{leave_part, message_run_id};
use crate::plant::log_head;
use crate::plant_process::PlantLoop;
use crate::robot_controller::RobotController;
use crate::run_folder::{CONTROLLER_PART, PLANT_PART, RunFolder};
use crate::setup::Setup;
use crate::simulated_robot::SimulatedRobot;
use crate::summary::PlantPart;
use crate::supervisor::Course;
use crate::verdict::Failure;

/// Runs a lockstep scenario to its end and leaves its results in a folder.
///
/// # Errors
/// [`Failure::Input`] when a part cannot be made of the scenario, [`Failure::Fault`] when the log cannot be written.
pub fn run_in_one_process(setup: &Setup, folder: &RunFolder, stop: &StopFlag) -> Result<Course, Failure> {
    let log = Log::create(&folder.file("log.mcap"), log_head(setup, RunId(0)), true, false)?;
    match simulate(setup, log, stop)? {
        Simulated::Fault(why) => Ok(Course::Fault(why)),
        Simulated::Ended { plant, figures } => {
            leave_part(Some(folder.path()), PLANT_PART, &*plant)?;
            leave_part(Some(folder.path()), CONTROLLER_PART, &part(&setup.scenario, &figures))?;
            Ok(if stop.is_set() { Course::Interrupted } else { Course::Finished })
        }
    }
}

/// How a simulated run ended.
#[derive(Debug)]
pub enum Simulated {
    /// It came to its end, or was stopped.
    Ended {
        /// What the plant has to say.
        plant: Box<PlantPart>,
        /// What the controller has to say.
        figures: Box<CycleFigures>,
    },
    /// A step could not be computed, or a link broke.
    Fault(String),
}

/// Runs a lockstep scenario to its end in this thread.
///
/// # Errors
/// As [`run_in_one_process`].
pub fn simulate(setup: &Setup, log: Log, stop: &StopFlag) -> Result<Simulated, Failure> {
    let scenario = &setup.scenario;
    let mut robot = FaultyPlant::new(SimulatedRobot::new(setup)?, scenario);
    let (run, hash) = (message_run_id(RunId(0), scenario), setup.joint_set_hash());
    let joints = setup.robot.joint_names.len() as u32;
    let (states, states_in) = in_process_link::<PlantState>();
    let (commands, commands_in) = in_process_link::<Command>();
    let controller_loop =
        ControllerLoop::new(scenario, states_in, commands, &Command::new(run, hash, joints));
    let controller = FaultyController::new(RobotController::new(setup)?, scenario);
    let mut answers = Answers { controller_loop, controller, commands: commands_in };
    let blank = PlantState::new(run, hash, joints);
    let plant_loop = PlantLoop::new(scenario, states, &mut answers, &blank, log).judged_for(setup)?;
    match plant_loop.run(&mut robot, &mut Alone(stop.clone())) {
        Err(fault) => Ok(Simulated::Fault(fault.to_string())),
        Ok(run) => {
            let mut plant = run.part;
            plant.log_records_dropped = run.log.finish()?;
            let figures = Box::new(answers.controller_loop.figures().clone());
            Ok(Simulated::Ended { plant: Box::new(plant), figures })
        }
    }
}

/// The plant's end of a link whose other end is a controller that answers when asked.
struct Answers<'a, S, P, C> {
    controller_loop: ControllerLoop<'a, S, P>,
    controller: FaultyController<RobotController>,
    commands: C,
}

impl<S: Subscriber<PlantState>, P: Publisher<Command>, C: Subscriber<Command>> Subscriber<Command>
    for Answers<'_, S, P, C>
{
    fn receive_latest(&mut self) -> Result<Option<&Command>, LinkError> {
        self.controller_loop.answer(&mut self.controller)?;
        self.commands.receive_latest()
    }
}
