//! Branch-sparse factorisation of the mass matrix, `H = Lᵀ D L`, without fill-in.
//!
//! Coordinates are eliminated from the tips to the root, a floating base (6 x 6, dense) last. Row `k` of the unit lower
//! triangular `L` is non-zero only at the coordinates on the branch of `k`, exactly where `H` is.
//!
//! ```text
//! factor, k = n-1..0:   for i on the branch of k (i < k):  a = H[k,i]/H[k,k];  H[i,j] -= a H[k,j] for j on the branch of i;  L[k,i] = a
//! solve H x = b:        x_j -= L[k,j] x_k (k = n-1..0);     x_k /= D_k;          x_k -= Σ_j L[k,j] x_j (k = 0..n-1)
//! ```
//!
//! Cost: factor O(Σ depth²), solve O(Σ depth), no allocation after [`MassMatrixFactor::new`].
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 6.5, table 6.3 (the "LTDL" factorisation).

use alloc::vec;
use alloc::vec::Vec;

use crate::errors::{FactorError, ModelError, StepError};
use crate::kinematics::check_length;
use crate::tree::KinematicTree;

/// Pivots below this part of the diagonal entry they came from are taken for zero (round-off of the elimination).
const SINGULAR_PIVOT: f64 = 1e-14;

/// Factors `L`, `D` of one mass matrix, and the sparsity pattern of the tree.
#[derive(Clone, Debug)]
pub struct MassMatrixFactor {
    /// Coordinates on the branch of every coordinate, root first, the coordinate itself left out.
    ancestors: Vec<u32>,
    ancestor_starts: Vec<usize>,
    /// Row-major `L` below the diagonal.
    lower: Vec<f64>,
    pivots: Vec<f64>,
    base_dof: usize,
}

impl MassMatrixFactor {
    /// Room and pattern for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        let dof = tree.dof();
        let base_dof = tree.base_dof();
        let mut ancestors = Vec::new();
        let mut ancestor_starts = vec![0];
        for coordinate in 0..dof {
            if coordinate < base_dof {
                ancestors.extend(0..coordinate as u32);
            } else {
                let branch = tree.branch(coordinate - base_dof + tree.first_joint_body());
                ancestors.extend_from_slice(&branch[..branch.len() - 1]);
            }
            ancestor_starts.push(ancestors.len());
        }
        Self { ancestors, ancestor_starts, lower: vec![0.0; dof * dof], pivots: vec![0.0; dof], base_dof }
    }

    #[inline(always)]
    pub(crate) fn ancestors(&self, coordinate: usize) -> &[u32] {
        &self.ancestors[self.ancestor_starts[coordinate]..self.ancestor_starts[coordinate + 1]]
    }

    /// Factorises `mass_matrix` (row-major dof x dof; only its lower triangle on the branches is read).
    ///
    /// # Errors
    /// [`StepError::Singular`] when a pivot is not positive (the body is named); [`StepError::Argument`] for a wrong length.
    /// The factors are then not to be used.
    pub fn factorise(&mut self, mass_matrix: &[f64]) -> Result<(), StepError> {
        let dof = self.pivots.len();
        check_length("mass matrix", mass_matrix.len(), dof * dof)?;
        self.lower.copy_from_slice(mass_matrix);
        for k in (0..dof).rev() {
            let (above, row) = self.lower.split_at_mut(k * dof);
            let pivot = row[k];
            // Written so that a NaN is refused as well.
            let positive = pivot > SINGULAR_PIVOT * mass_matrix[k * dof + k].abs();
            if !positive {
                let body = if k < self.base_dof { 0 } else { k - self.base_dof + self.base_dof.min(1) };
                return Err(FactorError::SingularPivot { body, pivot }.into());
            }
            self.pivots[k] = pivot;
            let range = self.ancestor_starts[k]..self.ancestor_starts[k + 1];
            let ancestors = &self.ancestors[range];
            for (place, &i) in ancestors.iter().enumerate().rev() {
                let i = i as usize;
                let factor = row[i] / pivot;
                // The branch of i is the branch of k up to and including i.
                for &j in &ancestors[..=place] {
                    above[i * dof + j as usize] -= factor * row[j as usize];
                }
                row[i] = factor;
            }
        }
        Ok(())
    }

    /// `x := H⁻¹ x`, for example momenta to velocities, or generalised forces to accelerations.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a vector that is not dof long.
    pub fn solve_in_place(&self, x: &mut [f64]) -> Result<(), ModelError> {
        let dof = self.pivots.len();
        check_length("right-hand side", x.len(), dof)?;
        for k in (0..dof).rev() {
            let value = x[k];
            for &j in self.ancestors(k) {
                x[j as usize] -= self.lower[k * dof + j as usize] * value;
            }
        }
        for (value, pivot) in x.iter_mut().zip(&self.pivots) {
            *value /= pivot;
        }
        for k in 0..dof {
            let row = &self.lower[k * dof..(k + 1) * dof];
            let sum: f64 = self.ancestors(k).iter().map(|&j| row[j as usize] * x[j as usize]).sum();
            x[k] -= sum;
        }
        Ok(())
    }

    /// Entry of `L` below the diagonal.
    #[inline(always)]
    pub(crate) fn lower(&self, row: usize, column: usize) -> f64 {
        self.lower[row * self.pivots.len() + column]
    }

    /// Diagonal of `D`, all positive; their product is the determinant of `H`.
    pub fn pivots(&self) -> &[f64] {
        &self.pivots
    }
}
