//! Recursive Newton-Euler algorithm: the generalised forces that a motion takes; bias and gravity forces.
//!
//! ```text
//! outward: a_i = a_parent + S_i q̈_i + ad_{v_i} S_i q̇_i         a_{0} = -g (so that gravity needs no term of its own)
//! force:   F_i = M_i a_i - ad^D_{μ_i} v_i - external_i           μ_i = M_i v_i
//! inward:  F_parent += F_i                                       τ_i = S_iᵀ F_i,     base wrench = F_0
//! ```
//!
//! The result is `H (V̇_w; q̈) + c(q, V, q̇) + g(q) - Σ Jᵀ external` for the mass matrix `H` of [`crate::mass_matrix`]: floating trees
//! give the wrench on the base about the origin of {0} (torque first), then the joint forces. `V̇_w` is the time derivative
//! of the spatial twist `V_w`. Joint damping, springs, drag and constant wrenches of the tree are *not* in it: those are
//! applied forces, here only inertia and gravity count.
//!
//! Cost: O(n), no allocation.
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 5.3 (here in frame {0}).

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use crate::errors::ModelError;
use crate::kinematics::{Kinematics, Velocity, check_length};
use crate::spatial::{Twist, Wrench};
use crate::tree::{KinematicTree, NO_PARENT};

/// Scratch memory of the functions of this module.
#[derive(Clone, Debug)]
pub struct InverseDynamicsWorkspace {
    acceleration_w: Vec<Twist>,
    wrench_w: Vec<Wrench>,
}

impl InverseDynamicsWorkspace {
    /// Room for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        let count = tree.body_count();
        Self { acceleration_w: vec![Twist::default(); count], wrench_w: vec![Wrench::default(); count] }
    }

    /// Spatial wrench through the joint of every body (through the base: the external wrench needed) of the last call,
    /// about the origin of {0}: what the parent exerts on the body.
    pub fn joint_wrenches_w(&self) -> &[Wrench] {
        &self.wrench_w
    }

    fn check(&self, tree: &KinematicTree) -> Result<(), ModelError> {
        check_length("inverse dynamics workspace", self.wrench_w.len(), tree.body_count())
    }
}

/// Generalised forces for the accelerations `acceleration` at the state held by `kinematics` ([`Kinematics::update`]).
///
/// | argument | meaning | shape | unit | frame |
/// |---|---|---|---|---|
/// | `acceleration` | `(V̇_w; q̈)` | 6 + joints, or joints | rad/s², m/s² | {0} |
/// | `external_w` | wrench on every body about the origin of {0}; empty for none | bodies or 0 | N·m, N | {0} |
/// | `force` | filled: `(base wrench; τ)` | dof | N·m, N | {0} |
///
/// # Errors
/// [`ModelError::Length`] when an argument does not fit the tree.
pub fn inverse_dynamics_into(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    acceleration: &Velocity<'_>,
    external_w: &[Wrench],
    workspace: &mut InverseDynamicsWorkspace,
    force: &mut [f64],
) -> Result<(), ModelError> {
    check_length("accelerations", acceleration.q_dot.len(), tree.joint_count())?;
    let accelerations = |body: usize| acceleration.q_dot[body - tree.first_joint_body()];
    recursion(tree, kinematics, &acceleration.base_twist_w, accelerations, external_w, workspace, force)
}

/// Bias force `c(q, V, q̇) + g(q)`: what it takes for `V̇_w = 0` and `q̈ = 0`. Arguments as [`inverse_dynamics_into`].
///
/// # Errors
/// [`ModelError::Length`] when an argument does not fit the tree.
pub fn bias_force_into(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    workspace: &mut InverseDynamicsWorkspace,
    force: &mut [f64],
) -> Result<(), ModelError> {
    recursion(tree, kinematics, &Twist::default(), |_| 0.0, &[], workspace, force)
}

fn recursion(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    base_acceleration_w: &Twist,
    joint_acceleration: impl Fn(usize) -> f64,
    external_w: &[Wrench],
    workspace: &mut InverseDynamicsWorkspace,
    force: &mut [f64],
) -> Result<(), ModelError> {
    kinematics.check_tree(tree)?;
    workspace.check(tree)?;
    check_length("generalised force", force.len(), tree.dof())?;
    if !external_w.is_empty() {
        check_length("external wrenches", external_w.len(), tree.body_count())?;
    }
    let upwards = Twist::new(Vector3::zeros(), -tree.gravity_w());
    for (i, constants) in tree.constants().iter().enumerate() {
        let velocity = kinematics.velocities_w()[i];
        workspace.acceleration_w[i] = if tree.is_base(i) {
            *base_acceleration_w + upwards
        } else {
            // S_i q̇_i is what the joint adds to the velocity of the parent.
            let (parent_velocity, parent_acceleration) = match constants.parent {
                NO_PARENT => (Twist::default(), upwards),
                parent => (kinematics.velocities_w()[parent], workspace.acceleration_w[parent]),
            };
            let joint_velocity = velocity - parent_velocity;
            parent_acceleration
                + kinematics.joint_twists_w()[i] * joint_acceleration(i)
                + velocity.bracket(&joint_velocity)
        };
        let inertia = kinematics.inertia_w(tree, i);
        let momentum = inertia.mul_twist(&velocity);
        let mut wrench = inertia.mul_twist(&workspace.acceleration_w[i]) - momentum.dual_bracket(&velocity);
        if let Some(external) = external_w.get(i) {
            wrench = wrench - *external;
        }
        workspace.wrench_w[i] = wrench;
    }
    collect(tree, kinematics, workspace, force);
    Ok(())
}

/// Gravity force `g(q) = ∂V/∂q` at the poses held by `kinematics`: what holds the tree at rest. Velocities are not read.
///
/// Floating trees: first the wrench on the base about the origin of {0}. Cost: O(n), no allocation.
///
/// # Errors
/// [`ModelError::Length`] when an argument does not fit the tree.
pub fn gravity_force_into(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    workspace: &mut InverseDynamicsWorkspace,
    force: &mut [f64],
) -> Result<(), ModelError> {
    kinematics.check_tree(tree)?;
    workspace.check(tree)?;
    check_length("generalised force", force.len(), tree.dof())?;
    for (i, body) in tree.bodies().iter().enumerate() {
        let lift = tree.gravity_w() * -body.inertia.mass;
        workspace.wrench_w[i] = Wrench::new(kinematics.mass_centres_w()[i].cross(&lift), lift);
    }
    collect(tree, kinematics, workspace, force);
    Ok(())
}

/// Adds the wrenches up from the tips to the root and projects them on the joints.
fn collect(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    workspace: &mut InverseDynamicsWorkspace,
    force: &mut [f64],
) {
    for i in (tree.first_joint_body()..tree.body_count()).rev() {
        let wrench = workspace.wrench_w[i];
        force[tree.joint_dof(i)] = wrench.dot(&kinematics.joint_twists_w()[i]);
        let parent = tree.constants()[i].parent;
        if parent != NO_PARENT {
            workspace.wrench_w[parent] += wrench;
        }
    }
    if tree.is_floating() {
        force[..6].copy_from_slice(workspace.wrench_w[0].to_vector().as_slice());
    }
}
