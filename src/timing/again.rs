//! The cycles of a run computed again: which part of their time is the software's.
//!
//! Computed again from its tape ([`crate::tape`]), a cycle goes through the same instructions on the same numbers, and its command comes out
//! the same bit by bit; that is checked. What a cycle takes every time is its own: more rounds of the QP, more active rows, another way through
//! the program. What it took once and then not again was the machine: its core given to somebody else in pieces too short to be
//! noticed, arithmetic units, caches or memory shared with strangers, or a core that has just woken up.
//!
//! ```text
//! the software's time of a cycle = least of the run's and of every pass over the tape
//! ```
//!
//! Of a pass the time on the core counts, not the clock's: on a machine busy with other things a cycle is interrupted in every pass.
//!
//! A pass goes over the whole run, so that the computations of a cycle are far apart and a slow stretch of the machine meets another cycle in
//! every pass. There are at least [`PASSES_LEAST`]; further ones, up to [`PASSES_MOST`], as long as there are cycles whose time would count
//! against the software. The least can only fall, never below what the cycle needs.

use std::thread::Builder;

use delmpc_controller_process::controller_loop::Controller;
use delmpc_controller_process::machine::bind_to_core;
use delmpc_controller_process::stop::StopFlag;
use delmpc_controller_process::usage::Usage;
use delmpc_messages::Command;

use crate::robot_controller::RobotController;
use crate::setup::Setup;
use crate::tape::{CycleInput, RewoundClock, checksum};
use crate::timing::loop_phase::cores_of;
use crate::verdict::Failure;

/// Passes in any case.
pub const PASSES_LEAST: u32 = 2;
/// Passes at most.
pub const PASSES_MOST: u32 = 12;

/// Everything that entered the cycles of a run.
#[derive(Debug, Clone, Default)]
pub struct Tape {
    /// States and times, cycle by cycle, those before the run began included.
    pub inputs: Vec<CycleInput>,
    /// Every reading of the controller's clock.
    pub readings: Vec<u64>,
}

/// What came of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Again {
    /// Times the tape was gone over.
    pub passes: u32,
    /// Commands that came out differently: then the times say nothing.
    pub different: u64,
    /// Least time of each cycle with the preparation of the next one (ns).
    pub least_ns: Vec<u64>,
}

/// Computes the last `cycles` cycles of a tape again, on the controller's core. `settled` says of the least times so
/// far whether another pass could still change anything.
///
/// # Errors
/// When there can be no controller or no thread. `None`: interrupted.
pub fn compute_again(
    setup: &Setup,
    tape: &Tape,
    cycles: usize,
    settled: impl Fn(&[u64]) -> bool,
    stop: &StopFlag,
) -> Result<Option<Again>, Failure> {
    let mut again = Again { least_ns: vec![u64::MAX; cycles.min(tape.inputs.len())], ..Again::default() };
    while again.passes < PASSES_LEAST || (again.passes < PASSES_MOST && !settled(&again.least_ns)) {
        let pass = std::thread::scope(|scope| {
            let thread = Builder::new().name("again".to_owned());
            let thread = thread.spawn_scoped(scope, || pass(setup, tape, stop)).map_err(Failure::fault)?;
            thread.join().map_err(|_| Failure::Fault("computing a cycle again broke down".to_owned()))?
        })?;
        let Some((times_ns, different)) = pass else { return Ok(None) };
        again.passes += 1;
        again.different += different;
        let before = times_ns.len() - again.least_ns.len();
        for (least, time) in again.least_ns.iter_mut().zip(&times_ns[before..]) {
            *least = (*least).min(*time);
        }
        if again.different > 0 {
            break;
        }
    }
    Ok(Some(again))
}

/// Goes over the tape once: the time of every cycle, and how many commands were others.
fn pass(setup: &Setup, tape: &Tape, stop: &StopFlag) -> Result<Option<(Vec<u64>, u64)>, Failure> {
    let [_, core] = cores_of(&setup.scenario);
    // At ordinary priority: a real-time thread that never waits is stopped by the operating system for a twentieth of the time.
    bind_to_core(core);
    let mut controller = RobotController::with_clock(setup, RewoundClock::new(&tape.readings))?;
    let joints = setup.robot.joint_names.len() as u32;
    let mut command = Box::new(Command::new(0, setup.joint_set_hash(), joints));
    let mut times_ns = Vec::with_capacity(tape.inputs.len());
    let mut different = 0;
    for input in &tape.inputs {
        if stop.is_set() {
            return Ok(None);
        }
        let before = Usage::now();
        controller.cycle(&input.state, input.now_ns, &mut command);
        controller.prepare();
        times_ns.push(Usage::now().since(&before).cpu_ns);
        different += u64::from(checksum(&command) != input.command);
    }
    Ok(Some((times_ns, different)))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use delmpc_controller_process::controller_loop::address;
    use delmpc_messages::PlantState;
    use delmpc_scenario::Clock;

    use super::*;
    use crate::plant_process::Plant;
    use crate::simulated_robot::SimulatedRobot;
    use crate::tape::TapedController;

    /// The main scenario, and a tape of its first cycles; the plant answers the commands as in lockstep.
    fn recorded(cycles: usize) -> (Setup, Tape) {
        let scenario = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/scenarios/atlas_one_foot.toml");
        let mut setup = Setup::read(&scenario, &[]).unwrap();
        setup.scenario.clock = Clock::Realtime;
        let mut plant = SimulatedRobot::new(&setup).unwrap();
        let mut controller = TapedController::new(&setup).unwrap();
        let joints = setup.robot.joint_names.len() as u32;
        let mut command = Command::new(0, setup.joint_set_hash(), joints);
        let mut state = PlantState::new(0, setup.joint_set_hash(), joints);
        for sequence in 1..=cycles as u64 {
            plant.measure(&mut state);
            state.header.sequence = sequence;
            controller.cycle(&state, state.time_ns, &mut command);
            controller.prepare();
            address(&mut command, &state);
            assert!(plant.accept(&command));
            (0..5).for_each(|_| plant.step().unwrap());
        }
        let (inputs, readings) = controller.into_tape();
        (setup, Tape { inputs: inputs.list().to_vec(), readings: readings.list().to_vec() })
    }

    #[test]
    fn a_tape_gives_the_same_commands_and_a_changed_one_others() {
        let (setup, mut tape) = recorded(12);
        let stop = StopFlag::never();
        let again = compute_again(&setup, &tape, 10, |_| true, &stop).unwrap().unwrap();
        assert_eq!((again.passes, again.different, again.least_ns.len()), (PASSES_LEAST, 0, 10));
        assert!(again.least_ns.iter().all(|time_ns| *time_ns > 0 && *time_ns < u64::MAX));

        let unsettled = compute_again(&setup, &tape, 1, |_| false, &stop).unwrap().unwrap();
        assert_eq!((unsettled.passes, unsettled.different), (PASSES_MOST, 0));

        tape.inputs[5].state.velocity[0] += 1e-9;
        let other = compute_again(&setup, &tape, 10, |_| true, &stop).unwrap().unwrap();
        assert_eq!(other.passes, 1);
        assert!(other.different > 0, "a tape that is not the run's must be noticed");
    }
}
