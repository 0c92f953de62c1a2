//! Joint-space mass matrix by the composite-rigid-body algorithm.
//!
//! ```text
//! inward:  𝓜_i = M_i + Σ_children 𝓜_j          A_i = 𝓜_i S_i
//! entries: H[i, j] = H[j, i] = S_jᵀ A_i          for j on the branch of i;  zero for joints on different branches
//! floating base (S_base = 1):  H[base, base] = 𝓜_0,   H[base, i] = A_i
//! ```
//!
//! so that `(P; p_j) = H (V_w; q̇)` with the total spatial momentum `P` about the origin of {0}, and twice the kinetic energy is
//! `(V_w; q̇)ᵀ H (V_w; q̇)`. All inertias are composed in frame {0}.
//!
//! Cost: O(Σ depth) for the entries plus O(n²) to clear the output; no allocation. Factorise the result with
//! [`crate::mass_matrix_factor`].
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapter 6, table 6.2 (there in body frames).

use alloc::vec;
use alloc::vec::Vec;

use crate::errors::ModelError;
use crate::kinematics::{Kinematics, check_length};
use crate::spatial::SpatialInertia;
use crate::tree::{KinematicTree, NO_PARENT};

/// Scratch memory of [`mass_matrix_into`]: one composite inertia per body.
#[derive(Clone, Debug)]
pub struct MassMatrixWorkspace {
    composite_inertia_w: Vec<SpatialInertia>,
}

impl MassMatrixWorkspace {
    /// Room for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        Self { composite_inertia_w: vec![SpatialInertia::default(); tree.body_count()] }
    }

    /// Inertia of every body with all it carries, about the origin of {0}, of the last call of [`mass_matrix_into`].
    pub fn composite_inertias_w(&self) -> &[SpatialInertia] {
        &self.composite_inertia_w
    }
}

/// The mass matrix at the poses held by `kinematics` ([`Kinematics::update_positions`]).
///
/// | argument | meaning | shape | unit |
/// |---|---|---|---|
/// | `mass_matrix` | filled, symmetric, row-major | dof x dof | kg·m², kg·m, kg by coordinate types |
///
/// Floating base: coordinates 0..6 are the spatial twist of the base in {0}, angular first.
///
/// # Errors
/// [`ModelError::Length`] when a workspace or the output does not fit the tree.
pub fn mass_matrix_into(
    tree: &KinematicTree,
    kinematics: &Kinematics,
    workspace: &mut MassMatrixWorkspace,
    mass_matrix: &mut [f64],
) -> Result<(), ModelError> {
    let dof = tree.dof();
    kinematics.check_tree(tree)?;
    check_length("mass matrix workspace", workspace.composite_inertia_w.len(), tree.body_count())?;
    check_length("mass matrix", mass_matrix.len(), dof * dof)?;
    mass_matrix.fill(0.0);

    let composite = &mut workspace.composite_inertia_w;
    for (i, inertia) in composite.iter_mut().enumerate() {
        *inertia = kinematics.inertia_w(tree, i);
    }
    for i in (tree.first_joint_body()..tree.body_count()).rev() {
        let parent = tree.constants()[i].parent;
        if parent != NO_PARENT {
            let carried = composite[i];
            composite[parent] += carried;
        }
        let row = tree.joint_dof(i);
        let momentum = composite[i].mul_twist(&kinematics.joint_twists_w()[i]);
        let mut ancestor = i;
        while ancestor != NO_PARENT && !tree.is_base(ancestor) {
            let column = tree.joint_dof(ancestor);
            let entry = momentum.dot(&kinematics.joint_twists_w()[ancestor]);
            mass_matrix[row * dof + column] = entry;
            mass_matrix[column * dof + row] = entry;
            ancestor = tree.constants()[ancestor].parent;
        }
        if tree.is_floating() {
            for (column, &entry) in momentum.to_vector().iter().enumerate() {
                mass_matrix[row * dof + column] = entry;
                mass_matrix[column * dof + row] = entry;
            }
        }
    }
    if tree.is_floating() {
        let base = composite[0].to_matrix();
        for row in 0..6 {
            for column in 0..6 {
                // One triangle for both: exactly symmetric.
                mass_matrix[row * dof + column] = base[(row.max(column), row.min(column))];
            }
        }
    }
    Ok(())
}
