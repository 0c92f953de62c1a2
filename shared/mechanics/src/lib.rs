//! Linear-time higher-order variational integrators on kinematic trees.
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;

pub mod branch_lu;
pub mod del_hessian;
pub mod del_residual;
pub mod dense_lu;
pub mod errors;
pub mod floating_base;
pub mod forces;
pub mod gravity_hessian;
pub mod kinetic_hessian;
pub(crate) mod lanes;
pub mod lobatto;
pub mod newton_direction;
pub(crate) mod real;
pub mod recursive_newton;
pub mod row_matrix;
pub(crate) mod small_inverse;
pub mod spatial;
pub mod state;
pub mod tangent;
pub mod tree;
