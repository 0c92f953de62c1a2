//! Time of one call of the estimator, one core: Atlas (30 joints, two flat feet with sensors) and LittleDog (12 joints, four feet).
//!
//! `cargo bench -p delmpc-estimation --bench estimator`. The robot stands; a message every 5 ms with five samples of the inertial unit
//! summed up. Least and median of the calls, µs; times depend on the machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::time::Instant;

use delmpc_estimation::prelude::*;
use delmpc_mechanics::prelude::*;
use delmpc_robots::{RobotModel, load};

const PERIOD_S: f64 = 0.005;
const CALLS: usize = 4000;

fn feet(robot: &RobotModel) -> Vec<FootModel> {
    let foot = |sole: &delmpc_robots::Sole| {
        let frame = robot.frame(&sole.frame).unwrap();
        FootModel {
            body: frame.body.unwrap(),
            sole: frame.pose,
            polygon: sole.polygon.iter().map(|p| [p.x, p.y]).collect(),
        }
    };
    robot.soles.iter().map(foot).collect()
}

fn main() {
    println!("robot          joints  feet   least    median");
    for (name, posture) in [("atlas", "one_foot_right"), ("littledog", "stand")] {
        let file = format!("{}/../../configs/robots/{name}.urdf", env!("CARGO_MANIFEST_DIR"));
        let robot = load(&file).unwrap();
        let q = &robot.posture(posture).unwrap().q;
        let still = vec![0.0; q.len()];
        let feet = feet(&robot);
        let share = 9.81 * robot.tree.total_mass() / feet.len() as f64;
        let wrench = Wrench::new(Vector3::zeros(), Vector3::new(0.0, 0.0, share));
        let loaded = vec![FootMeasurement { wrench_s: Some(wrench), touches: true }; feet.len()];
        let count = feet.len();
        let mut estimator =
            Estimator::new(EstimatorModel::new(robot.tree.clone(), feet), EstimatorConfig::default())
                .unwrap();
        let mut times: Vec<f64> = (0..CALLS)
            .map(|k| {
                let time_s = PERIOD_S * k as f64;
                let up = Vector3::new(0.0, 0.0, 9.81);
                let measurement = Measurement {
                    time_s,
                    position: q,
                    velocity: &still,
                    inertial: Some(Inertial {
                        angular_velocity: Vector3::zeros(),
                        specific_force: up,
                        sums: Some((Vector3::zeros(), up * time_s)),
                    }),
                    feet: &loaded,
                    motion_capture: None,
                };
                let begin = Instant::now();
                estimator.update(&measurement).unwrap();
                begin.elapsed().as_secs_f64() * 1e6
            })
            .collect();
        let moved = estimator.estimate().base_twist_b.linear.norm();
        assert!(moved < 1e-3, "{name}: an estimate of {moved} m/s at rest");
        times.sort_by(f64::total_cmp);
        println!("{name:12}  {:6}  {count:4}  {:6.2}    {:6.2}", q.len(), times[0], times[CALLS / 2]);
    }
}
