//! What a legged controller is told: robot, motion, everything that is chosen.

use alloc::vec::Vec;

use delmpc_estimation::prelude::{EstimatorConfig, EstimatorModel};
use delmpc_horizon::gait::Gait;
use delmpc_horizon::legged_model::LeggedModel;
use delmpc_horizon::legged_tasks::LeggedWeights;
use delmpc_horizon::motion_reference::SwingShape;
use delmpc_horizon::planned_base::PlannedBase;
use delmpc_horizon::step_plan::Step;
use delmpc_lq::projected_qp::ProjectedQpOptions;

use crate::config::{ConstraintConfig, ControllerKind};
use crate::fallback::FallbackConfig;

/// What the robot is to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Motion {
    /// Stand on all feet.
    Stand,
    /// Go by a gait.
    Gait(GaitCommand),
    /// Go by single steps, in the order of time.
    Steps(Vec<Step>),
    /// Go as planned through contact: base and mass centre, and the steps in the order of time.
    Planned(PlannedBase, Vec<Step>),
}

/// A gait and the way.
#[derive(Clone, Debug, PartialEq)]
pub struct GaitCommand {
    /// Times of the feet.
    pub gait: Gait,
    /// Forward and to the left, m/s.
    pub velocity: [f64; 2],
    /// Turning to the left, rad/s.
    pub yaw_rate: f64,
    /// When the first foot lifts off, s.
    pub start_s: f64,
    /// When the robot has stopped, s; infinite: never.
    pub stop_s: f64,
    /// How long it takes to be at speed, s.
    pub ramp_s: f64,
}

/// Robot and sensors.
#[derive(Clone, Debug)]
pub struct LeggedRobot {
    /// The robot; its joints in the order of the messages.
    pub model: LeggedModel,
    /// What the estimator knows of it; the same feet.
    pub estimator: EstimatorModel,
    /// How good the sensors are.
    pub sensors: EstimatorConfig,
    /// Hash of the joint set of the messages.
    pub joint_set_hash: u64,
}

/// Everything that is chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct LeggedConfig {
    /// Which law: the static LQR is none of a legged robot.
    pub kind: ControllerKind,
    /// Time between cycles, s.
    pub period_s: f64,
    /// Time between two evaluations of the command's feedback law in the plant, s.
    pub servo_period_s: f64,
    /// From the time of a measurement to the time its command takes effect, s.
    pub delay_s: f64,
    /// Stage lengths without switches, s.
    pub stage_lengths: Vec<f64>,
    /// Weights of the tasks.
    pub weights: LeggedWeights,
    /// Limits of the plan.
    pub limits: ConstraintConfig,
    /// How a foot swings.
    pub swing: SwingShape,
    /// By how much the robot crouches before it steps, m; 0: by its legs.
    pub crouch_m: f64,
    /// What to do.
    pub motion: Motion,
    /// The constrained QP.
    pub qp: ProjectedQpOptions,
    /// When to fall back.
    pub fallback: FallbackConfig,
    /// Oldest measurement that is used, s.
    pub max_state_age_s: f64,
    /// How long a command may be applied, s.
    pub command_life_s: f64,
    /// Time a cycle may take before it is called late, s.
    pub budget_s: f64,
    /// Time over which the servo takes the mean of velocities, s.
    pub rate_mean_s: f64,
}
