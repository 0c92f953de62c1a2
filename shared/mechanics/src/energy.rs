//! Energies and momenta of a tree: for tests, logs and invariants.
//!
//! ```text
//! T = ½ Σ v_iᵀ M_i v_i       V = -Σ m_i g·c_i + ½ Σ k_i (q_i - rest_i)²       P = Σ M_i v_i       p_j = S_jᵀ Σ_(bodies beyond j) M_i v_i
//! ```
//!
//! The potential energy is zero when every mass lies in the plane through the origin of {0} normal to gravity and every
//! spring is relaxed. Mass welded to the ground counts in it, as it counts in the mass centre.
//!
//! Cost: O(n) (generalised momenta O(Σ depth)), no allocation.

use crate::errors::ModelError;
use crate::kinematics::{Kinematics, check_length};
use crate::spatial::Momentum;
use crate::tree::KinematicTree;

/// Kinetic energy at the state held by `kinematics` ([`Kinematics::update`]), J.
pub fn kinetic_energy(tree: &KinematicTree, kinematics: &Kinematics) -> f64 {
    let twice: f64 = kinematics
        .velocities_w()
        .iter()
        .enumerate()
        .map(|(i, velocity)| kinematics.inertia_w(tree, i).mul_twist(velocity).dot(velocity))
        .sum();
    0.5 * twice
}

/// Energy of the weight at the poses held by `kinematics`, J.
pub fn gravity_energy(tree: &KinematicTree, kinematics: &Kinematics) -> f64 {
    -tree.total_mass() * tree.gravity_w().dot(&kinematics.mass_centre_of_tree_w(tree))
}

/// Energy stored in the joint springs at the joint coordinates `q` (order of the bodies), J.
///
/// # Errors
/// [`ModelError::Length`] for a wrong number of coordinates.
pub fn spring_energy(tree: &KinematicTree, q: &[f64]) -> Result<f64, ModelError> {
    check_length("q", q.len(), tree.joint_count())?;
    let joints = tree.bodies().iter().skip(tree.first_joint_body()).map(|body| &body.joint);
    let twice: f64 = joints
        .zip(q)
        .map(|(joint, q)| {
            let stretch = q - joint.rest;
            joint.stiffness * stretch * stretch
        })
        .sum();
    Ok(0.5 * twice)
}

/// Potential energy, weight and springs, at the poses held by `kinematics` and their joint coordinates `q`, J.
///
/// # Errors
/// [`ModelError::Length`] for a wrong number of coordinates.
pub fn potential_energy(tree: &KinematicTree, kinematics: &Kinematics, q: &[f64]) -> Result<f64, ModelError> {
    Ok(gravity_energy(tree, kinematics) + spring_energy(tree, q)?)
}

/// Total spatial momentum about the origin of {0}: angular (N·m·s), linear (N·s).
pub fn total_momentum_w(tree: &KinematicTree, kinematics: &Kinematics) -> Momentum {
    let mut total = Momentum::default();
    for (i, velocity) in kinematics.velocities_w().iter().enumerate() {
        total += kinematics.inertia_w(tree, i).mul_twist(velocity);
    }
    total
}

/// Total momentum about the mass centre of the tree: the spin (N·m·s) and the linear momentum (N·s).
pub fn centroidal_momentum_w(tree: &KinematicTree, kinematics: &Kinematics) -> Momentum {
    let mut momentum = total_momentum_w(tree, kinematics);
    momentum.torque -= kinematics.mass_centre_of_tree_w(tree).cross(&momentum.force);
    momentum
}

/// Generalised momenta `(P; p_j) = H (V_w; q̇)` without forming `H`: `momentum` has one entry per degree of freedom.
///
/// # Errors
/// [`ModelError::Length`] for a wrong slice.
pub fn generalised_momentum_into(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    momentum: &mut [f64],
) -> Result<(), ModelError> {
    kinematics.check_tree(tree)?;
    check_length("momentum", momentum.len(), tree.dof())?;
    momentum.fill(0.0);
    for (i, velocity) in kinematics.velocities_w().iter().enumerate() {
        let own = kinematics.inertia_w(tree, i).mul_twist(velocity);
        for &coordinate in tree.branch(i) {
            let coordinate = coordinate as usize;
            momentum[coordinate] += own.dot(&kinematics.column_twist_w(tree, coordinate));
        }
    }
    Ok(())
}
