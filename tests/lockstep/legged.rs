//! Robots on several feet and on their way, lockstep, noise and delay as in the scenarios. The figures of many seeds:
//! `cargo test --release --test lockstep legged -- --ignored --nocapture`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;

use delmpc::legged_metrics::LeggedFigures;
use delmpc::log::Log;
use delmpc::one_process::{Simulated, simulate};
use delmpc::setup::Setup;
use delmpc::summary::Summary;
use delmpc_controller_process::stop::StopFlag;
use delmpc_scenario::FaultSettings;

fn setup(scenario: &str, overrides: &[&str]) -> Setup {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("configs/scenarios/{scenario}.toml"));
    let mut all = vec!["clock=lockstep".to_owned()];
    all.extend(overrides.iter().map(|change| (*change).to_owned()));
    Setup::read(&file, &all).unwrap()
}

fn run(scenario: &str, overrides: &[&str]) -> Summary {
    run_set_up(scenario, overrides, &setup(scenario, overrides))
}

fn run_set_up(scenario: &str, overrides: &[&str], setup: &Setup) -> Summary {
    match simulate(setup, Log::none(), &StopFlag::on_signals().unwrap()).unwrap() {
        Simulated::Fault(why) => panic!("{scenario} {overrides:?}: {why}"),
        Simulated::Ended { plant, .. } => Summary::new(&setup.scenario, Some(*plant), None, None),
    }
}

fn feet(summary: &Summary) -> &LeggedFigures {
    summary.plant.as_ref().and_then(|plant| plant.robot.legged.as_ref()).unwrap()
}

fn stands(scenario: &str, overrides: &[&str]) -> Summary {
    let summary = run(scenario, overrides);
    let robot = &summary.plant.as_ref().unwrap().robot;
    println!("{scenario} {overrides:?}: {:?} {:?}", summary.failure, robot.legged);
    assert!(!robot.fell, "{scenario} {overrides:?}: {:?}", summary.failure);
    summary
}

#[test]
fn atlas_takes_a_push_on_two_feet() {
    let summary = stands("atlas_two_feet", &["duration_s=4.0"]);
    let robot = &summary.plant.as_ref().unwrap().robot;
    assert_eq!((feet(&summary).contact_sets_visited, feet(&summary).steps_taken), (1, 0));
    assert!(robot.settle_time_s.unwrap() < 2.5, "{:?}", robot.settle_time_s);
}

/// More than the pressure points of both feet could stop: the trunk has to help, and the end of the horizon must not forget it.
#[test]
fn atlas_takes_on_two_feet_what_its_soles_alone_could_not_stop() {
    stands("atlas_two_feet", &["duration_s=3.5", "push.impulse_ns=75", "push.direction=[1, 0, 0]"]);
}

#[test]
fn atlas_walks() {
    let summary = stands("atlas_walk", &["duration_s=3.6"]);
    let figures = feet(&summary);
    assert!(figures.steps_taken >= 3, "{figures:?}");
    assert!(figures.landing_error_max_m.unwrap() < 0.01, "{figures:?}");
    assert!(figures.max_slip_m < 0.01, "{figures:?}");
}

/// Half of the commands do not arrive: the others' law carries the robot on, with its base felt by gyroscope and standing legs.
#[test]
fn atlas_walks_with_every_second_command_lost() {
    let overrides = ["duration_s=3.0"];
    let mut setup = setup("atlas_walk", &overrides);
    setup.scenario.fault.push(FaultSettings { count: 100_000, probability: 0.5, ..FaultSettings::default() });
    let summary = run_set_up("atlas_walk", &overrides, &setup);
    assert!(!summary.plant.as_ref().unwrap().robot.fell, "{:?}", summary.failure);
    assert!(feet(&summary).steps_taken >= 2);
}

#[test]
fn littledog_trots_and_keeps_to_its_path() {
    let summary = stands("littledog_trot", &["duration_s=3.0"]);
    let figures = feet(&summary);
    assert!(figures.steps_taken >= 12, "{figures:?}");
    assert!(figures.base_error_rms_m.unwrap() < 0.006, "{figures:?}");
}

#[test]
fn an_unknown_foot_and_feet_that_are_left_out_are_refused_with_their_names() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/scenarios/atlas_walk.toml");
    let refused = |change: &str| Setup::read(&file, &[change.to_owned()]).unwrap_err().to_string();
    assert!(refused("step[3].foot=middle").contains("step[3].foot"), "{}", refused("step[3].foot=middle"));
    assert!(refused("robot.stance=[\"right\"]").contains("left"));
    assert!(refused("robot.stance=[\"right\", \"tail\"]").contains("tail"));
}

#[test]
#[ignore = "many minutes"]
fn seeds_slopes_masses_and_gaits() {
    for seed in 1..=20 {
        let seed = format!("seed={seed}");
        stands("atlas_walk", &[&seed]);
        stands("littledog_trot", &[&seed]);
        stands("littledog_rough", &[&seed]);
    }
    for change in [
        "plant.slope_rad=[0.05236, 0.0]",
        "plant.slope_rad=[-0.05236, 0.0]",
        "plant.slope_rad=[0.0, 0.05236]",
        "plant.ground_sink_m=0.7e-3",
        "plant.mass_scale=1.1",
        "plant.mass_scale=0.9",
        "plant.slope_rad=[0.0, -0.05236]",
    ] {
        stands("atlas_walk", &[change]);
    }
    for towards in ["[1, 0, 0]", "[-1, 0, 0]", "[0, 1, 0]", "[0, -1, 0]"] {
        let direction = format!("push.direction={towards}");
        stands("atlas_two_feet", &[&direction, "push.impulse_ns=75"]);
        let in_single_support = ["push.link=utorso", "push.impulse_ns=15", "push.start_s=3.35"];
        let push: Vec<&str> = in_single_support.iter().copied().chain([direction.as_str()]).collect();
        stands("atlas_walk", &push);
    }
    for gait in [["gait.kind=walk", "gait.speed_m_s=0.1"], ["gait.kind=bound", "gait.speed_m_s=0.1"]] {
        stands("littledog_trot", &["gait.yaw_rate_rad_s=0.0", gait[0], gait[1]]);
    }
}
