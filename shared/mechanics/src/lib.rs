//! Linear-time higher-order variational integrators on kinematic trees.
#![cfg_attr(not(feature = "std"), no_std)]
#![forbid(unsafe_code)]

extern crate alloc;

pub mod branch_lu;
pub mod constraints;
pub mod del_hessian;
pub mod del_residual;
pub mod dense_lu;
pub mod energy;
pub mod errors;
pub mod floating_base;
pub mod forces;
pub mod gravity_hessian;
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
pub mod recursive_newton;
pub mod reroot;
pub mod row_matrix;
pub(crate) mod small_inverse;
pub mod spatial;
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
