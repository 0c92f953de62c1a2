//! Linear-quadratic problems over a horizon of stages: no robot, no message.
//!
//! ```text
//! LqProblem -> Riccati (time-varying gains) -> ProjectedQp (the rows that matter, through a small dual) -> Trajectory
//! ```
//!
//! | step | module | what |
//! |---|---|---|
//! | problem | [`lq_problem`], [`lq_stage`], [`trajectory`] | transitions, costs as weighted squares, bounds, rows with a caller's tag |
//! | without rows | [`riccati`], [`dare`] | the recursion in square-root form of the costs; standing still for ever |
//! | with rows | [`projected_qp`] | projection on the rows, row generation, warm start |
//! | its dual | [`dual_qp`], [`active_set_dual`], `clarabel_dual` | the solvers |
//! | oracle | `sparse_qp` | the same problem as one sparse QP: for tests |
//!
//! Without the default feature `clarabel` the crate is `no_std`, needs `alloc` in constructors only, and solves the dual by
//! [`active_set_dual`].
#![allow(clippy::needless_range_loop)]
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;
#[cfg(all(test, not(feature = "std")))]
extern crate std;

pub mod active_set_dual;
mod adjoint_sweep;
#[cfg(feature = "clarabel")]
pub mod clarabel_dual;
pub mod dare;
pub mod dual_qp;
mod eliminate_inputs;
pub mod errors;
pub mod kernels;
pub mod lq_problem;
pub mod lq_stage;
pub mod panel;
pub mod projected_qp;
pub mod riccati;
#[cfg(feature = "clarabel")]
pub mod sparse_qp;
pub mod trajectory;
