//! Contact-implicit motion planning on the Simpson integrator: nobody names a contact mode.
//!
//! A [`task::Task`] says robot, ground, way and time; [`planner::plan`] finds the motion, the torques, the contact impulses and
//! the contact sequence, and leaves a [`plan_file::Plan`]. Friction and impacts are complementarity conditions of the stages,
//! whose boundaries are free to move onto the events, so that the fourth order of the integrator goes through landings.
//!
//! ```text
//! unknowns   X_k = (q_k, v_k, t_k) at the boundaries,  Y_k = (q^½, u, impulses and slip bounds of every contact) inside
//! equations  three DEL rows per stage with the contact impulses (C-RATTLE made one-sided)
//! contact    gaps, friction cones, slip bounds, and one row "sum of all products <= κ" per contact and stage;  κ -> 0
//! ```
//!
//! # Reading order
//!
//! | step | module | what |
//! |---|---|---|
//! | task | [`task`], [`terrain`], [`robot`], [`outline`] | what is asked, in words of the user |
//! | problem | [`problem`], [`layout`], [`contact_law`] | unknowns, bounds, cost; formulation C |
//! | stage | [`scalar`], [`node`], [`points`], [`stage`], [`stage_derivatives`], [`contact_derivatives`] | Algorithms 1 to 3 on dual numbers; rows, Jacobian, Hessian |
//! | solver | [`barrier`], [`newton`], [`chain`], [`dense`], [`homotopy`] | augmented-Lagrangian barrier Newton on the stage chain; two passes |
//! | plan | [`planner`], [`refine`], [`projection`], [`plan_file`] | guesses, more stages, DEL = 0, the file |
//! | trust | [`check`], [`execution`] | residuals recomputed with the mechanics alone; every stage integrated finely |
//!
//! # What it can do, measured
//!
//! Spring Flamingo over a box 0.16 m high (24 stages, refined to 48), Atlas on one foot to a ball (52 stages), Spring Flamingo
//! with bounds on what happens before an impact (24, 48, 96 stages), LittleDog over two gaps with feet that
//! do not slide (28 stages, 2866 iterations, 28 s of one core, products 4.2e-6 S m, 0.252 m/s, footholds 24 mm from edges; six
//! of six shifted guesses too): these converge from the plain guess. With full friction allowed to slide, LittleDog's feet carry
//! and slide by up to 110 mm in a stage.
//!
//! Limits: springs that are stiff for a stage (an ankle of 5 or 20 N m/rad under a foot of 0.003 kg m², with or without
//! damping, stages of 42 to 83 ms) do not converge. A plan on toes over a free ankle converges, but its stages do not hold
//! under a fine integration ([`execution`]) until they are some 10 ms long. Nor do LittleDog's: its legs weigh next to nothing,
//! and swings of a tenth of a second and flights of a stage are cheap. Terrain varies along x. A foot that is a sphere
//! takes its force at the centre.
#![forbid(unsafe_code)]
// Nodes, coordinates and rows are indices of the formulas; iterators would hide which is which.
#![allow(clippy::needless_range_loop)]

pub mod barrier;
pub mod chain;
pub mod check;
pub mod contact_derivatives;
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
