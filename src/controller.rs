//! `delmpc controller`: the controller process.

use delmpc_controller_process::controller_loop::{Controller, ControllerLoop};
use delmpc_controller_process::figures::CycleFigures;
use delmpc_controller_process::membership::Membership;
use delmpc_messages::{Command, Role, Verdict};
use delmpc_scenario::{Clock, Scenario};
use delmpc_transport::{Channel, RunId};

use crate::board::BoardController;
use crate::cli::{ControllerArguments, PartArguments};
use crate::faults::FaultyController;
use crate::output::say;
use crate::part::{
    PartFolder, StandIn, Supervisor, ended, leave_part, leave_records, lost_after_s, message_run_id,
    prepare_machine, run_id,
};
use crate::robot_controller::RobotController;
use crate::run_folder::{CLOCK_READINGS, CONTROLLER_PART, CYCLE_INPUTS, CYCLE_RECORDS};
use crate::setup::Setup;
use crate::summary::ControllerPart;
use crate::tape::TapedController;
use crate::verdict::{Ended, Failure};

/// Runs the command. `allocations` counts the heap allocations of this process so far.
///
/// # Errors
/// [`Failure::Input`] before anything runs, [`Failure::Fault`] when the run broke off.
pub fn controller(arguments: &ControllerArguments, allocations: fn() -> u64) -> Result<Ended, Failure> {
    let ControllerArguments { part: arguments, board } = arguments;
    let supervisor = Supervisor::of(arguments);
    let mut setup = Setup::read(&arguments.scenario, &arguments.set)?;
    crate::plan_source::provide(&mut setup, true)?;
    let run = run_id(arguments, &setup)?;
    let process = ControllerProcess { arguments, setup: &setup, run, supervisor, allocations };
    if let Some(address) = board {
        let (ended, board) = process.run(BoardController::connect(&setup, &arguments.scenario, address)?)?;
        return board.finish(arguments.out.as_deref(), ended);
    }
    if !arguments.timing {
        let controller = RobotController::new(&setup)?;
        warn_of_reach(&setup.scenario, controller.out_of_reach_m());
        return Ok(process.run(controller)?.0);
    }
    let controller = TapedController::new(&setup)?;
    warn_of_reach(&setup.scenario, controller.out_of_reach_m());
    let (ended, controller) = process.run(controller)?;
    let (inputs, readings) = controller.into_tape();
    leave_records(arguments.out.as_deref(), CYCLE_INPUTS, &inputs)?;
    leave_records(arguments.out.as_deref(), CLOCK_READINGS, &readings)?;
    Ok(ended)
}

fn warn_of_reach(scenario: &Scenario, out_of_reach_m: Option<f64>) {
    let allowed_m = scenario.success.hand_error_at_deadline_m;
    if let Some(distance_m) = out_of_reach_m.filter(|distance_m| *distance_m > allowed_m) {
        say(&format!(
            "warning: no balanced posture brings the hand nearer to the ball than {distance_m:.3} m: it goes there; move `reach.ball_m`"
        ));
    }
}

/// The process, whatever computes the commands.
struct ControllerProcess<'a> {
    arguments: &'a PartArguments,
    setup: &'a Setup,
    run: RunId,
    supervisor: Supervisor,
    allocations: fn() -> u64,
}

impl ControllerProcess<'_> {
    /// Takes part in the run to its end, leaves the results, and gives the controller back.
    fn run<C: Controller>(&self, controller: C) -> Result<(Ended, C), Failure> {
        let Self { arguments, setup, run, supervisor, allocations } = *self;
        let scenario = &setup.scenario;
        let part_folder = PartFolder::enter(arguments, Role::Controller, setup)?;
        let mut controller = FaultyController::new(controller, scenario);
        let _awake = prepare_machine(Role::Controller, scenario);

        let hash = setup.joint_set_hash();
        let _stand_in = StandIn(supervisor, run);
        let mut membership =
            Membership::join(run, hash, Role::Controller, arguments.supervised, lost_after_s(scenario))
                .map_err(Failure::fault)?;
        if !arguments.supervised {
            say(&format!("run {run}: the controller waits for a plant of the same scenario"));
        }
        let commands = membership.node().publisher(Channel::Command);
        let commands = membership.connected(commands).map_err(Failure::fault)?;
        let states = membership.node().subscriber(Channel::State);
        let states = membership.connected(states).map_err(Failure::fault)?;
        let blank = Command::new(message_run_id(run, scenario), hash, setup.robot.joint_names.len() as u32);
        let mut controller_loop = ControllerLoop::new(scenario, states, commands, &blank);
        if scenario.clock == Clock::Realtime {
            controller_loop = controller_loop.counting(allocations);
        }
        if arguments.timing {
            controller_loop = controller_loop.recording();
        }
        let (ending, figures, records) =
            controller_loop.run(&mut controller, &mut membership).map_err(Failure::fault)?;
        drop(membership);
        let folder = arguments.out.as_deref();
        leave_records(folder, CYCLE_RECORDS, &records)?;
        leave_part(folder, CONTROLLER_PART, &part(scenario, &figures))?;
        let ended = part_folder.leave(setup, ended(ending, "plant")?)?;
        Ok((ended, controller.into_inner()))
    }
}

/// The controller's part of the summary. Times and allocations are those of the
/// machine: in lockstep they are left out, so that runs are reproducible.
pub fn part(scenario: &Scenario, figures: &CycleFigures) -> ControllerPart {
    let realtime = scenario.clock == Clock::Realtime;
    let durations = figures.durations();
    let [p50, p99, p999, max] = [0.5, 0.99, 0.999, 1.0].map(|part| durations.total.percentile_s(part));
    let [feedback_p50, feedback_p99] = [0.5, 0.99].map(|part| durations.feedback.percentile_s(part));
    let [linearize, riccati, qp] =
        [&durations.linearize, &durations.riccati, &durations.qp].map(|stage| stage.percentile_s(0.5));
    let timed = |value: Option<f64>| value.filter(|_| realtime);
    let verdicts = |verdict: Verdict| figures.verdicts[verdict as usize];
    ControllerPart {
        cycles: figures.count(),
        cycle_time_p50_s: timed(p50),
        cycle_time_p99_s: timed(p99),
        cycle_time_p999_s: timed(p999),
        cycle_time_max_s: timed(max),
        feedback_p50_s: timed(feedback_p50),
        feedback_p99_s: timed(feedback_p99),
        linearize_p50_s: timed(linearize),
        riccati_p50_s: timed(riccati),
        qp_p50_s: timed(qp),
        qp_solves: figures.qp_solves,
        qp_iterations_max: figures.qp_iterations_max,
        deadline_misses: figures.deadline_misses,
        fallback_level_max: figures.fallback_level_max,
        allocations_per_cycle_max: realtime.then_some(figures.allocations_max),
        verdicts_late: verdicts(Verdict::Late),
        verdicts_infeasible: verdicts(Verdict::Infeasible),
        verdicts_model_mismatch: verdicts(Verdict::ModelMismatch),
        verdicts_bad_state: verdicts(Verdict::BadState),
    }
}
