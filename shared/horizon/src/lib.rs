//! Horizons of legged robots: what stands where and when, what the robot aims at, and the linear-quadratic problem of every stage.
//!
//! ```text
//! Gait, steps -> ContactSchedule -> StageGrid
//! MotionReference (base, legs, swing feet, load sharing)  }  -> LeggedProblem -> LqProblem (crate delmpc-lq)
//! MotionPlan (the last solution, resampled)               }
//! ```
//!
//! | step | module | what |
//! |---|---|---|
//! | robot | [`legged_model`], [`limits`] | floating tree, feet, limits, posture |
//! | when and where | [`contact_schedule`], [`gait`], [`step_plan`], [`retiming`], [`ground_plane`], [`stage_grid`] | stances of every foot, switch times as stage boundaries |
//! | aim | [`base_path`], [`mass_centre_plan`], [`planned_base`], [`hermite`], [`leg_kinematics`], [`load_sharing`], [`motion_reference`] | where base and feet shall be, and which forces carry that |
//! | stage | [`foot_cone`], [`motion_plan`], [`legged_tasks`], [`legged_problem`] | wrench rows, the nominal, costs and transitions |
//!
//! A stage has a contact set of its own: none, points, flat feet; the mechanics of it are those of
//! [`delmpc_mechanics::contact_stage`]. The crate is `no_std`; memory is taken in constructors only.
//!
//! Frames: suffix `_w` is the frame of the estimate, level, its origin under the robot at the start; `_b` body axes. 6-vectors are angular
//! first.
#![allow(clippy::needless_range_loop)]
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;
#[cfg(all(test, not(feature = "std")))]
extern crate std;

pub mod base_path;
pub mod contact_schedule;
pub mod errors;
pub mod foot_cone;
pub mod gait;
pub mod ground_plane;
pub mod hermite;
pub mod leg_kinematics;
pub mod legged_model;
pub mod legged_problem;
pub mod legged_tasks;
pub mod limits;
pub mod load_sharing;
pub mod mass_centre_plan;
pub mod motion_plan;
pub mod motion_reference;
pub mod planned_base;
pub mod retiming;
pub mod stage_grid;
pub mod step_plan;
