//! Atlas on its right foot fetches a ball: every constraint at the nodes and, by a fine integration, between them.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use crate::common;

use delmpc_planner::execution::execute;
use delmpc_planner::planner::{Planned, Search, plan};

const BALLS: [(&str, [f64; 3]); 3] =
    [("main", [0.8, 0.3, 0.5]), ("far_high", [1.0, 0.3, 0.9]), ("low", [0.6, 0.3, 0.3])];

/// Largest joint rate at the end that counts as rest, rad/s.
const REST: f64 = 0.05;

/// Whether a plan from rest to rest is one that the sole and the motors allow; says what it found.
/// Stages of 25 ms: shorter than the growth of an inverted pendulum and the damping of the wrists allow to be held.
fn holds(ball: [f64; 3], time_s: f64) -> (bool, Planned) {
    let stages = (time_s / 0.025).ceil() as usize;
    let task = common::atlas_pick(ball, time_s, stages);
    let planned = plan(&task, "atlas_pick", &Search::default(), |_| true).unwrap();
    if !planned.converged || planned.findings.hand_m.unwrap() > 5e-3 {
        return (false, planned);
    }
    let last = planned.plan.v.last().unwrap();
    let rate = last.iter().fold(0.0f64, |worst, v| worst.max(v.abs()));
    let found = execute(&planned.plan, &task.robot).unwrap();
    // The true sole: half of 0.2604 by 0.1286 m about its centre; friction 0.7.
    let between = found.sole.unwrap();
    let inside = |[low, high]: [f64; 2], half: f64| low > -half && high < half;
    let sole = inside(between.pressure_m[0], 0.1302) && inside(between.pressure_m[1], 0.0643);
    println!(
        "{time_s:.3} s: {:?}, off {:.1e} rad, {:.1e} rad/s, end {rate:.3} rad/s, {:?}",
        between, found.position, found.rate, planned.attempts
    );
    (
        sole && rate < REST
            && between.friction < 0.7
            && between.least_load > 0.0
            && found.stages_off.is_empty(),
        planned,
    )
}

#[test]
fn ball_in_1_3_s() {
    let (holds, planned) = holds(BALLS[0].1, 1.3);
    let findings = &planned.findings;
    println!("{:#?}", findings);
    assert!(holds);
    assert!(findings.del_s < 1e-10, "{:e}", findings.del_s);
    assert!(findings.hand_m.unwrap() <= 5e-3);
    let sole = findings.sole.unwrap();
    assert!(sole.pressure_m[0][0] > -0.1201 && sole.pressure_m[0][1] < 0.1201, "{sole:?}");
    assert!(sole.pressure_m[1][0] > -0.0541 && sole.pressure_m[1][1] < 0.0541, "{sole:?}");
    assert!(sole.friction < 0.5 && sole.yaw_arm_m < 0.0501);
    // Torques within their limits.
    let task = common::atlas_pick(BALLS[0].1, 1.3, 13);
    for stage in &planned.plan.u {
        for (&j, u) in task.robot.actuated.iter().zip(stage) {
            assert!(u.abs() <= 0.9501 * task.robot.limits[j].effort, "{}: {u}", task.robot.coordinates[j]);
        }
    }
}

/// The shortest time by bisection. The straight minimum-jerk motion needs 1.07, 0.95, 1.13 s.
#[test]
#[ignore = "a campaign of minutes"]
fn shortest_times() {
    for (name, ball) in BALLS {
        let (mut fails, mut works) = (0.3, 1.3);
        while works - fails > 0.02 {
            let middle = 0.5 * (works + fails);
            if holds(ball, middle).0 {
                works = middle;
            } else {
                fails = middle;
            }
        }
        println!("{name}: shortest time {works:.3} s (not {fails:.3} s)");
        assert!(works < 1.3);
    }
}
