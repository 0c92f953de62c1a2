//! Robots and tasks of the tests.
#![allow(dead_code, clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use std::path::PathBuf;

use delmpc_planner::outline::leg_outline;
use delmpc_planner::robot::PlanRobot;
use delmpc_planner::task::{BaseBounds, PlanWeights, Standing, Task};
use delmpc_planner::terrain::{Gap, Obstacle, Terrain};

pub fn robot(name: &str) -> PlanRobot {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../configs/robots");
    PlanRobot::new(&delmpc_robots::load(root.join(name).with_extension("urdf")).unwrap()).unwrap()
}

/// Spring Flamingo over the box; the task of the handbook's plans.
pub fn flamingo_jump(stages: usize) -> Task {
    let robot = robot("spring_flamingo");
    let start = robot.posture("double_support_com_over_ankles").unwrap().to_vec();
    let at = |name: &str| robot.coordinate(name).unwrap();
    let alike = ["hip", "knee", "ankle"]
        .map(|joint| (at(&format!("right_{joint}")), at(&format!("left_{joint}"))))
        .to_vec();
    let mut bounds = ["right_ankle", "left_ankle"].map(|name| (at(name), -1.3, 1.0)).to_vec();
    bounds.extend(["right_hip", "left_hip"].map(|name| (at(name), -1.8, 0.8)));
    Task {
        terrain: Terrain {
            obstacles: vec![Obstacle { x_m: 0.9, height_m: 0.16, thickness_m: 0.08 }],
            ..Terrain::flat()
        },
        stages,
        horizon_s: 2.0,
        distance_m: 1.8,
        speed_m_s: (0.26, 0.26),
        start,
        friction: 0.7,
        sliding: true,
        range_margin: 0.0,
        rate_fraction: 1.0,
        point_load: None,
        torque_fraction: 1.0,
        torque_limit_nm: 60.0,
        rate_limit: 15.0,
        bounds,
        base: BaseBounds { attitude_rad: 0.8, height_m: (0.5, 1.1) },
        clearance: leg_outline(&robot, 5, 6).unwrap(),
        weights: PlanWeights { legs_alike: 1.0, steady_speed: 0.2, ..PlanWeights::default() },
        alike,
        execution: None,
        standing: None,
        reach: None,
        guess_lift_m: 0.05,
        robot,
    }
}

/// LittleDog over two gaps; the task of the handbook's plan.
pub fn littledog_gaps(stages: usize) -> Task {
    let robot = robot("littledog");
    let start = robot.posture("stand").unwrap().to_vec();
    Task {
        terrain: Terrain {
            gaps: vec![Gap { from_m: 0.11, to_m: 0.17 }, Gap { from_m: 0.47, to_m: 0.56 }],
            edge_margin_m: 0.025,
            ..Terrain::flat()
        },
        stages,
        horizon_s: 2.8,
        distance_m: 0.72,
        speed_m_s: (0.0, 0.0),
        start,
        friction: 0.7,
        sliding: true,
        range_margin: 0.0,
        rate_fraction: 1.0,
        point_load: None,
        torque_fraction: 1.0,
        torque_limit_nm: 3.0,
        rate_limit: 12.0,
        bounds: Vec::new(),
        base: BaseBounds { attitude_rad: 0.5, height_m: (0.08, 0.25) },
        clearance: robot.contacts.clone(),
        weights: PlanWeights {
            torque_nm: 0.3,
            base_attitude: 2.0,
            base_height: 20.0,
            posture: 0.3,
            joint_rate: 1e-2,
            end_base: 200.0,
            ..PlanWeights::default()
        },
        alike: Vec::new(),
        execution: None,
        standing: None,
        reach: None,
        guess_lift_m: 0.01,
        robot,
    }
}

/// Atlas on its right foot fetches a ball.
pub fn atlas_pick(ball: [f64; 3], horizon_s: f64, stages: usize) -> Task {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../configs/robots/atlas.urdf");
    let robot = PlanRobot::standing(&delmpc_robots::load(root).unwrap(), "right").unwrap();
    let start = robot.posture("one_foot_right").unwrap().to_vec();
    let hand = robot.frames.iter().find(|frame| frame.name == "l_hand_point").unwrap().clone();
    Task {
        terrain: Terrain::flat(),
        stages,
        horizon_s,
        distance_m: 0.0,
        speed_m_s: (0.0, 0.0),
        start,
        friction: 0.5,
        sliding: true,
        range_margin: 0.0,
        rate_fraction: 1.0,
        point_load: None,
        torque_fraction: 0.95,
        torque_limit_nm: 100.0,
        rate_limit: 12.0,
        bounds: Vec::new(),
        base: BaseBounds { attitude_rad: 0.5, height_m: (-1.0, 1.0) },
        clearance: Vec::new(),
        weights: PlanWeights {
            torque_nm: 100.0,
            posture: 1.0,
            joint_rate: 1e-2,
            end_joint_rate: 1e3,
            ..PlanWeights::default()
        },
        alike: Vec::new(),
        execution: None,
        standing: Some(Standing {
            sole: "right".to_owned(),
            pressure_m: [[-0.12, 0.12], [-0.054, 0.054]],
            yaw_arm_m: 0.05,
        }),
        reach: Some((hand, ball)),
        guess_lift_m: 0.0,
        robot,
    }
}

/// Numbers in -1..1 from a seed.
pub fn random(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((state >> 11) as f64 / (1u64 << 53) as f64) * 2.0 - 1.0
    }
}
