//! Whole-body model-predictive control on a variational integrator: one control cycle.
//!
//! ```text
//! PlantState -> estimator -> shift the plan -> linearise every stage -> Riccati -> projected QP -> Command
//! ```
//!
//! Each cycle is one real-time iteration: the last plan, shifted in time, is linearised stage by stage with the variational
//! integrator; the time-varying LQR and a small dual QP over the constraints that matter give the next plan; the command carries
//! its first gain, and torque and reference of its next tenth of a second. [`cycle::Controller::cycle`] always answers.
//!
//! Without the default feature `clarabel` the crate is `no_std` and needs `alloc` in constructors only; the QP is then solved by
//! [`delmpc_lq::active_set_dual`].
//!
//! Reading order: [`model`], [`config`], [`cycle`]; then in the order of the cycle [`estimator`], [`plan`], [`horizon_dynamics`],
//! [`stage_dynamics`], [`node_kinematics`], [`tasks`], [`mod@reference`], [`planned_motion`], [`contact_wrench`], the solver ([`delmpc_lq`]), [`fallback`].
//! [`tables`] is a robot as constants, [`control_task`] cycle and servo on one processor: for firmware.
//! [`legged`] is the same cycle for a robot on any set of feet, on the horizons of [`delmpc_horizon`]. Files without public items:
//! `feedback_law.rs` (what a command carries), `level_stance.rs` (a foot that is not level), `unloaded_robot.rs` (one that carries
//! nothing), `balance_trim.rs` (wrong masses), `prediction.rs` (delay).
#![allow(clippy::needless_range_loop)]
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;
#[cfg(all(test, not(feature = "std")))]
extern crate std;

mod balance_trim;
pub mod config;
pub mod contact_wrench;
pub mod control_task;
pub mod cycle;
pub mod errors;
pub mod estimator;
pub mod fallback;
mod feedback_law;
pub mod horizon_dynamics;
mod horizon_problem;
pub mod legged;
mod level_stance;
pub mod model;
pub mod node_kinematics;
pub mod plan;
pub mod planned_motion;
pub mod posture_goal;
mod prediction;
pub mod reference;
pub mod stage_dynamics;
mod stop_watch;
pub mod tables;
pub mod tasks;
mod telling;
mod unloaded_robot;

/// What a process needs to run a controller.
pub mod prelude {
    pub use crate::config::{ConstraintConfig, ControllerConfig, ControllerKind, StageBlock};
    pub use crate::cycle::{Clock, Controller, StoppedClock};
    pub use crate::errors::ControlError;
    pub use crate::model::{BodyPoint, ControllerModel, JointLimits, Sensing};
    pub use crate::planned_motion::JointMotion;
    pub use crate::reference::Reach;
    pub use crate::tasks::TaskWeights;
}
