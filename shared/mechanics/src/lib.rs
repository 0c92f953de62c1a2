//! Linear-time higher-order variational integrators on kinematic trees.
//!
//! The mechanics of T. Fan, J. Schultz, T. Murphey, *Efficient computation of higher-order variational integrators in robotic
//! simulation and trajectory optimization* ("the paper"): O(n) evaluation of the discrete Euler-Lagrange (DEL) equations, an
//! exact O(n) Newton direction and an O(n²) linearisation, at any Lobatto order. Beyond the paper: its missing Algorithm B.1,
//! a branch-sparse block LU for robots, a chart-free floating base with exact momentum, constraints with the full order in
//! the momenta.
//!
//! # Reading order
//!
//! | step | module | what |
//! |---|---|---|
//! | model | [`spatial`], [`tree`], [`reroot`] | SE(3), trees of revolute and prismatic joints, re-rooting |
//! | nodes | [`lobatto`], [`state`], [`forces`] | control nodes of a step, the state `(q, p)`, Assumption 1 |
//! | equations | [`del_residual`], [`floating_base`] | Algorithm 1; rows of a floating base |
//! | derivatives | [`tangent`], [`kinetic_hessian`], [`gravity_hessian`], [`del_hessian`] | Algorithm T, Algorithms 2 and 3, `H[α,γ]` |
//! | Newton | [`newton_direction`], [`recursive_newton`], [`branch_lu`], [`dense_lu`], [`step`] | Algorithm B.1 and its rivals; the step |
//! | use | [`linearize`], [`recursive_linearize`], [`constraints`], [`velocity`] | `A`, `B`; points, loops, welds; velocities from momenta |
//! | contacts | [`contact_stage`] | the constrained step of a floating robot, solved or lifted |
//! | horizon | [`stage_batch`] | lifted linearisation of many stages at once, a SIMD lane each |
//! | classics | [`kinematics`], [`mass_matrix`], [`mass_matrix_factor`], [`inverse_dynamics`], [`energy`] | continuous mechanics |
//!
//! # Letters
//!
//! | paper | here | meaning |
//! |---|---|---|
//! | `s`, `α, β, γ` | [`lobatto::LobattoRule`] | unknown nodes per step, node indices 0..s |
//! | `w^α, b^{αβ}, a^{αβ}` | the same | weights, differentiation matrix, `w^β b^{βα}` |
//! | `g_i, S_i, v_i, M_i, μ_i, Γ_i` | [`del_residual`] | pose, joint twist, velocity, inertia, articulated momentum and impulse, all in frame {0} |
//! | `r^α` | [`del_residual`] | DEL residual |
//! | `J`, `H[α,γ]` | [`del_hessian`] | Newton matrix, derivative of row α by node γ |
//! | `A_k, B_k` | [`linearize`] | discrete linearisation |
//!
//! 6-vectors are angular first. Suffix `_w`: in frame {0} (the paper's bar); `_b`: in body axes. Units are SI; angles in rad.
//!
//! # Errata of the printed paper
//!
//! 1. Algorithm 2, line 4: `Ad_{g_i}ᵀ M_i Ad_{g_i}⁻¹` must be `Ad_{g_i}⁻ᵀ M_i Ad_{g_i}⁻¹`.
//! 2. Algorithm 3, line 10: `S_jᵀ σA` (6 against 3 rows) must be `s_jᵀ σA` with the angular part of `S_j`.
//! 3. Section 3.2: `δq = -J r` must be `δq = -J⁻¹ r`; section 3.3 iii: `(Dh·J·A)⁻¹` must be `(Dh·J⁻¹·A)⁻¹`.
//! 4. Equation (6c) lacks the multiplier of the end node: the printed momentum is only first-order accurate
//!    ([`constraints`]).
//! 5. "Accuracy of order 2s" holds for `q` and `p` at step boundaries, not for rates at nodes (order s).
//! 6. The passes of B.1 cost O(s³ n), not O(s² n); O(n²) for `A`, `B` covers the Hessian, the solves come on top.
//! 7. With Euler-angle virtual joints, angular momentum is conserved only to O(Δt^{2s}); [`floating_base`] has it exact.
//!
//! # Conventions of the crate
//!
//! The model ([`tree::KinematicTree`]) is immutable; every algorithm has one workspace that is allocated once. Nothing is
//! allocated in a step. Errors are values that name body, quantity and amount. Without default features the crate is
//! `no_std` (with `alloc` for constructors).
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]
// Nodes, coordinates and rows are indices of the formulas; iterators would hide which is which.
#![allow(clippy::needless_range_loop)]

extern crate alloc;

pub mod branch_lu;
pub mod broyden;
pub mod constraints;
pub mod contact_stage;
pub mod del_hessian;
pub mod del_residual;
pub mod dense_lu;
pub mod energy;
pub mod errors;
pub mod floating_base;
pub mod forces;
pub mod gravity_hessian;
pub(crate) mod inertial_newton;
pub mod inverse_dynamics;
pub mod kinematics;
pub mod kinetic_hessian;
pub(crate) mod lanes;
pub mod linearize;
pub mod load_response;
pub mod lobatto;
pub mod mass_matrix;
pub mod mass_matrix_factor;
pub mod newton_direction;
pub(crate) mod real;
pub mod recursive_linearize;
pub mod recursive_newton;
pub mod reroot;
pub mod row_matrix;
pub(crate) mod small_inverse;
pub mod spatial;
pub mod stage_batch;
pub(crate) mod stage_lanes;
pub mod state;
pub mod step;
pub mod tangent;
pub mod tree;
pub mod velocity;

/// What most users need.
pub mod prelude {
    pub use crate::errors::{FactorError, ModelError, StepError};
    pub use crate::forces::{JointForces, PointForce, StepForces, WrenchLaw};
    pub use crate::linearize::{InputHold, LinearStep, Linearizer, StateCoordinates};
    pub use crate::lobatto::LobattoRule;
    pub use crate::newton_direction::{NewtonDirection, NewtonMethod};
    pub use crate::spatial::{Momentum, RigidTransform, SpatialInertia, Twist, Wrench};
    pub use crate::state::State;
    pub use crate::step::{Integrator, StepOptions, StepReport};
    pub use crate::tree::{Base, Body, Joint, JointKind, KinematicTree, LinkInertia, TreeBuilder};
    pub use nalgebra::{Matrix3, Vector3, Vector6};
}
