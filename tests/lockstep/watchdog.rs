//! A plant that hears no more commands: every rung of its watchdog is stable, and none of them shakes the robot.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;

use delmpc::plant_process::Plant;
use delmpc::robot_controller::RobotController;
use delmpc::setup::{MAIN_SCENARIO, Setup};
use delmpc::simulated_robot::SimulatedRobot;
use delmpc::truth::Truth;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_messages::{Command, FallbackLevel, PlantState};

/// When the controller falls silent, s.
const SILENT_S: f64 = 0.5;
/// Largest mean change of a torque in a step, N m.
const LARGEST_CHANGE: f64 = 5.0;

/// What a rung did: steps, and for every joint the sum of the changes of its torque.
#[derive(Clone, Default)]
struct Rung {
    steps: u32,
    changes: Vec<f64>,
}

/// Runs a scenario until the watchdog has gone through all of its rungs; the steps in which a level begins are left out.
fn silence(scenario: &str, overrides: &[&str]) -> [Rung; 6] {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(scenario);
    let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
    let setup = Setup::read(&file, &overrides).unwrap();
    let joints = setup.robot.joint_names.len();
    let (hash, n) = (setup.joint_set_hash(), joints as u32);
    // Refuses gains whose spectral radius is above 1.
    let mut plant = SimulatedRobot::new(&setup).unwrap();
    let mut controller = RobotController::new(&setup).unwrap();
    let (mut state, mut command) = (PlantState::new(0, hash, n), Command::new(0, hash, n));
    let mut truth = Truth::new(n);
    let mut rungs: [Rung; 6] = std::array::from_fn(|_| Rung { steps: 0, changes: vec![0.0; joints] });
    let cycle_steps = u64::from(setup.scenario.steps_per_cycle());
    let (mut before, mut last_level) = (vec![0.0; joints], u32::MAX);
    for step in 0..6_000_u64 {
        if step % cycle_steps == 0 && (step as f64) * setup.scenario.plant.step_s < SILENT_S {
            plant.measure(&mut state);
            state.header.sequence += 1;
            controller.cycle(&state, state.time_ns, &mut command);
            command.header.sequence = state.header.sequence;
            command.valid_from_ns = state.time_ns;
            assert!(plant.accept(&command));
        }
        if plant.step().is_err() {
            break;
        }
        plant.truth(&mut truth);
        let level = truth.watchdog_level;
        if level == last_level {
            let rung = &mut rungs[level as usize];
            rung.steps += 1;
            for (sum, (now, before)) in rung.changes.iter_mut().zip(truth.torque.iter().zip(&before)) {
                *sum += (now - before).abs();
            }
        }
        last_level = level;
        before.copy_from_slice(&truth.torque[..joints]);
    }
    rungs
}

fn assert_calm(name: &str, rungs: &[Rung; 6]) {
    let silent = [FallbackLevel::ShiftedPlan, FallbackLevel::GravityHold, FallbackLevel::DampingOnly];
    for level in silent {
        let rung = &rungs[level as usize];
        assert!(rung.steps > 100, "{name}: {level:?} was not reached");
        let (joint, worst) = rung.changes.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap();
        let mean = worst / f64::from(rung.steps);
        println!("{name}: {level:?}: joint {joint} changes by {mean:.3} N m a step on average");
        assert!(mean <= LARGEST_CHANGE, "{name}: {level:?}: joint {joint} changes by {mean:.1} N m a step");
    }
}

#[test]
fn no_rung_shakes_atlas_standing_or_sinking() {
    assert_calm("standing", &silence(MAIN_SCENARIO, &["reach.start_s=100"]));
    assert_calm("sinking", &silence(MAIN_SCENARIO, &["reach.start_s=100", "plant.ground_sink_m=2e-3"]));
    assert_calm("reaching", &silence(MAIN_SCENARIO, &["reach.start_s=0"]));
}

#[test]
fn no_rung_shakes_the_lamp() {
    assert_calm("lamp", &silence("configs/examples/lamp/reach.toml", &[]));
}

/// LittleDog on four feet, standing and while a trot is under way.
#[test]
fn no_rung_shakes_littledog() {
    assert_calm(
        "standing",
        &silence("configs/scenarios/littledog_trot.toml", &["gait.start_s=100", "gait.stop_s=200"]),
    );
    assert_calm("trotting", &silence("configs/scenarios/littledog_trot.toml", &["gait.start_s=0.05"]));
}

#[test]
#[ignore = "needs a scenario of the caller's: DELMPC_WATCHDOG_SCENARIO"]
fn no_rung_shakes_a_robot_of_the_callers() {
    let scenario = std::env::var("DELMPC_WATCHDOG_SCENARIO").unwrap();
    assert_calm("standing", &silence(&scenario, &[]));
    assert_calm("sinking", &silence(&scenario, &["plant.ground_sink_m=2e-3"]));
}
