//! Contact-implicit motion planning on the Simpson integrator: nobody names a contact mode.
#![forbid(unsafe_code)]
// Nodes, coordinates and rows are indices of the formulas; iterators would hide which is which.
#![allow(clippy::needless_range_loop)]

pub mod barrier;
pub mod chain;
pub mod check;
pub mod contact_law;
pub mod dense;
pub mod error;
pub mod execution;
pub mod homotopy;
pub mod layout;
pub mod newton;
pub mod node;
pub mod outline;
pub mod plan_file;
pub mod planner;
pub mod points;
pub mod problem;
pub mod projection;
pub mod refine;
pub mod robot;
pub(crate) mod row_algebra;
pub mod scalar;
pub mod stage;
pub mod stage_derivatives;
pub mod task;
pub mod terrain;
