//! Runs that follow a plan. The campaign of seeds, pushes and slopes: `cargo test --release --test lockstep planned -- --ignored --nocapture`.

use std::path::Path;

use delmpc::log::Log;
use delmpc::one_process::{Simulated, simulate};
use delmpc::plan_source::search;
use delmpc::plan_task::task_of;
use delmpc::setup::Setup;
use delmpc::summary::Summary;
use delmpc_controller_process::stop::StopFlag;
use delmpc_planner::plan_file::Plan;

fn read(overrides: &[&str]) -> Result<Setup, String> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/scenarios/atlas_pick.toml");
    let mut all = vec!["clock=lockstep".to_owned()];
    all.extend(overrides.iter().map(|change| (*change).to_owned()));
    Setup::read(&file, &all).map_err(|failure| failure.to_string())
}

fn planned(setup: &Setup) -> Plan {
    let settings = setup.scenario.plan.as_ref().unwrap();
    let task = task_of(&setup.urdf, &setup.scenario, settings).unwrap();
    let planned = search(&task, &setup.scenario, settings, None, true).unwrap();
    assert!(planned.converged, "{:?}", planned.attempts);
    planned.plan
}

/// Distance of hand and ball at the deadline, m.
fn hand_error_m(plan: &Plan, overrides: &[&str]) -> f64 {
    let mut setup = read(overrides).unwrap();
    setup.plan = Some(plan.clone());
    match simulate(&setup, Log::none(), &StopFlag::on_signals().unwrap()).unwrap() {
        Simulated::Fault(why) => panic!("{overrides:?}: {why}"),
        Simulated::Ended { plant, .. } => {
            let summary = Summary::new(&setup.scenario, Some(*plant), None, None);
            let robot = &summary.plant.as_ref().unwrap().robot;
            assert!(!robot.fell, "{overrides:?}: {:?}", summary.failure);
            let error = robot.hand_error_at_deadline_m.unwrap();
            println!("{overrides:?}: hand {:.1} mm, {:?}", 1e3 * error, summary.failure);
            error
        }
    }
}

const PUSH: [&str; 4] = ["push.link=utorso", "push.impulse_ns=10", "push.start_s=1.6", "push.duration_s=0.1"];

#[test]
fn atlas_picks_the_ball_along_its_plan_though_it_is_pushed() {
    let plan = planned(&read(&[]).unwrap());
    let mut pushed = PUSH.to_vec();
    pushed.extend(["push.direction=[0, 1, 0]", "duration_s=2.6"]);
    assert!(hand_error_m(&plan, &pushed) <= 0.01);
}

#[test]
#[ignore = "a campaign"]
fn atlas_picks_the_ball_in_all_seeds_pushed_from_all_sides_and_on_slopes() {
    let plan = planned(&read(&[]).unwrap());
    for seed in 1..=20 {
        assert!(hand_error_m(&plan, &[&format!("seed={seed}")]) <= 0.01);
    }
    for direction in ["[1, 0, 0]", "[0, 1, 0]", "[-1, 0, 0]", "[0, -1, 0]"] {
        for seed in 1..=4 {
            let (direction, seed) = (format!("push.direction={direction}"), format!("seed={seed}"));
            let mut pushed = PUSH.to_vec();
            pushed.extend([direction.as_str(), seed.as_str()]);
            assert!(hand_error_m(&plan, &pushed) <= 0.01);
        }
    }
    for slope in ["[0.0349, 0]", "[-0.0349, 0]", "[0, 0.0349]", "[0, -0.0349]"] {
        assert!(hand_error_m(&plan, &[&format!("plant.slope_rad={slope}")]) <= 0.01);
    }
}

#[test]
fn a_plan_that_does_not_fit_is_refused() {
    let far = read(&["reach.ball_m=[0.7, 0.3, 0.5]"]).unwrap_err();
    assert!(far.contains("`reach.ball_m` and `plan.target_m`"), "{far}");
    let soon = read(&["reach.deadline_s=1.0"]).unwrap_err();
    assert!(soon.contains("`reach.deadline_s` and `plan.horizon_s`"), "{soon}");
    let none = read(&["plan.file=nowhere.json"]).unwrap_err();
    assert!(none.contains("`plan.file`") && none.contains("nowhere.json"), "{none}");

    let other =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("controller/planner/tests/vectors/flamingo_jump_24.json");
    let setup = read(&[&format!("plan.file={}", other.display())]).unwrap();
    let refused = delmpc::robot_controller::RobotController::new(&setup).map(drop).unwrap_err().to_string();
    assert!(refused.contains("it is of another robot"), "{refused}");
}
