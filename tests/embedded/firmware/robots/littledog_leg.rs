//! littledog_leg: 3 joints. Written by `delmpc model --emit rust`; change the URDF or the scenario, not this.
//!
//! SI units; joints and bodies in the order of the messages, body 0 is the floating base.
#![allow(clippy::all, dead_code, unused_imports)]
#![cfg_attr(rustfmt, rustfmt_skip)]

use delmpc_controller_core::config::{ConstraintConfig, ControllerConfig, ControllerKind, StageBlock};
use delmpc_controller_core::fallback::FallbackConfig;
use delmpc_controller_core::prelude::{JointLimits, Reach, TaskWeights};
use delmpc_controller_core::tables::{BodyTable, PointTable, PoseTable, RobotTable, SoleTable, StanceTable};
use delmpc_estimation::prelude::EstimatorConfig;
use delmpc_lq::projected_qp::ProjectedQpOptions;
use delmpc_servo::prelude::{AffineLaw, WatchdogConfig};

/// Joint names.
pub const JOINT_NAMES: [&str; 3] = ["hip_roll", "hip_pitch", "knee"];

/// The floating tree.
pub const BODIES: [BodyTable; 4] = [
    BodyTable { parent: None, prismatic: false, axis: [0.0, 0.0, 1.0], placement: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, 0.0, 0.0] }, damping: 0.0, stiffness: 0.0, rest: 0.0, mass: 3.0, com: [0.0, 0.0, 0.02], inertia: [[0.0235, 0.0, 0.0], [0.0, 0.0235, 0.0], [0.0, 0.0, 0.045]] },
    BodyTable { parent: Some(0), prismatic: false, axis: [1.0, 0.0, 0.0], placement: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, -0.0236, 0.22] }, damping: 0.01, stiffness: 0.0, rest: 0.0, mass: 0.0623, com: [0.0, 0.0029, 0.0], inertia: [[4e-6, 0.0, 0.0], [0.0, 1.5e-5, 0.0], [0.0, 0.0, 1.5e-5]] },
    BodyTable { parent: Some(1), prismatic: false, axis: [0.0, 1.0, 0.0], placement: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, 0.0236, 0.0] }, damping: 0.01, stiffness: 0.0, rest: 0.0, mass: 0.1279, com: [0.0, 0.0, -0.0166], inertia: [[8.2e-5, 0.0, 0.0], [0.0, 8.9e-5, 0.0], [0.0, 0.0, 1.5e-5]] },
    BodyTable { parent: Some(2), prismatic: false, axis: [0.0, 1.0, 0.0], placement: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, 0.0, -0.0751] }, damping: 0.01, stiffness: 0.0, rest: 0.0, mass: 0.0464, com: [0.0, 0.0, -0.0202], inertia: [[3.8e-5, 0.0, 0.0], [0.0, 3.5e-5, 0.0], [0.0, 0.0, 4e-6]] },
];

/// Limits of the joints.
pub const LIMITS: [JointLimits; 3] = [
    JointLimits { lower: -0.6, upper: 0.6, effort: 3.0, velocity: 12.0 },
    JointLimits { lower: -3.5, upper: 2.4, effort: 3.0, velocity: 12.0 },
    JointLimits { lower: -3.1, upper: 1.0, effort: 3.0, velocity: 12.0 },
];

/// Home posture.
pub const POSTURE: [f64; 3] = [
    0.0,
    0.6,
    -1.2,
];

/// Corners of the sole `foot`.
pub const SOLE_0: [[f64; 2]; 4] = [
    [-0.15, -0.15],
    [0.15, -0.15],
    [0.15, 0.15],
    [-0.15, 0.15],
];

/// The soles.
pub const SOLES: [SoleTable<'static>; 1] = [
    SoleTable { body: 0, frame: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, 0.0, 0.0] }, polygon: &SOLE_0 },
];
/// The robot.
pub const ROBOT: RobotTable<'static> = RobotTable {
    joint_set_hash: 0x43833da3f03021fc,
    gravity_w: [0.0, 0.0, -9.81],
    bodies: &BODIES,
    limits: &LIMITS,
    posture: &POSTURE,
    stance: Some(StanceTable {
        soles: &SOLES, stance: 0, imu_body: 0,
        imu_mounting: PoseTable { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0, 0.0, 0.0] },
        sensors: EstimatorConfig { sample_s: 0.001, gyro_noise: 0.002, gyro_bias: 0.001, gyro_bias_walk: 1e-5, accelerometer_noise: 0.02, accelerometer_bias: 0.01, accelerometer_bias_walk: 0.0001, position_noise: 2e-5, velocity_noise: 0.002, contact_velocity: 0.001, contact_walk: 0.001, sole_rate: 0.01, first_tilt: 0.05, foot_force_noise: 2.0, load_on: 0.05, load_off: 0.02, debounce_s: 0.002 },
    }),
    hand: None,
    swing_foot: None,
};
pub const STAGES: [StageBlock; 4] = [
    StageBlock { count: 1, seconds: 0.005 },
    StageBlock { count: 2, seconds: 0.006 },
    StageBlock { count: 2, seconds: 0.012 },
    StageBlock { count: 5, seconds: 0.11179999999999998 },
];
pub const WEIGHTS: TaskWeights = TaskWeights { posture: 20.0, joint_speed: 0.5, torque: 500.0, com: [2000.0, 2000.0, 0.0], com_velocity: [200.0, 200.0, 0.0], spin: [0.0, 0.0, 0.0], hand: 10000.0, hand_velocity: 10.0, swing_foot: [0.0, 0.0, 1000.0], swing_foot_rotation: 5.0 };
pub const CONSTRAINTS: ConstraintConfig = ConstraintConfig { torque_fraction: 0.98, friction: 0.6, friction_sides: 8, cop_margin_m: 0.003, yaw_arm_m: 0.06, min_force_fraction: 0.1, contact_penalty: 1.0, position_penalty: 10000.0, velocity_penalty: 1000.0 };
pub const QP: ProjectedQpOptions = ProjectedQpOptions { capacity: 32, rows_per_round: 24, max_rounds: 8, tolerance: 1e-9, pivots: 12 };

/// Times, weights and limits of the controller.
pub fn config() -> ControllerConfig {
    ControllerConfig {
        kind: ControllerKind::Mpc,
        period_s: 0.005,
        servo_period_s: 0.001,
        delay_s: 0.005,
        stages: STAGES.to_vec(),
        weights: WEIGHTS,
        constraints: CONSTRAINTS,
        qp: QP,
        reach: None,
        fallback: FallbackConfig { good_cycles: 5, plan_age_s: 1.0, lqr_s: 1.3, hold_s: 2.0, damping_s: 4.0 },
        max_state_age_s: 0.05,
        command_life_s: 0.1,
        budget_s: 0.005,
        trim_s: 1.0,
        mismatch_rate: 1.0,
    }
}

pub const HOLD_TORQUE: [f64; 3] = [
    0.04212561150000001,
    0.025870565812236745,
    -0.005191727636118883,
];
pub const HOLD_POSITION: [f64; 3] = [
    0.0,
    0.6,
    -1.2,
];
pub const HOLD_STIFFNESS: [f64; 3] = [
    0.07206675603069257,
    0.07068760870357557,
    0.007766360064000036,
];
pub const HOLD_DAMPING: [f64; 3] = [
    0.0084077882035808,
    0.008246887682083816,
    0.0009060753408000041,
];

/// What the servo does without a command.
pub fn watchdog() -> WatchdogConfig {
    WatchdogConfig {
        hold_gains: 1.0,
        static_law: 0.0,
        gravity_hold: 0.5,
        damping_only: 1.0,
        law: Some(AffineLaw::joint_stiffness(&HOLD_TORQUE, &HOLD_POSITION, &HOLD_STIFFNESS, &HOLD_DAMPING)),
        stiffness: HOLD_STIFFNESS.to_vec(),
        damping: HOLD_DAMPING.to_vec(),
        good_commands: 3,
    }
}
