//! Velocities and contacts at one boundary: projection, inelastic impact.
//!
//! ```text
//! v := v - 𝓜⁻¹Gᵀ W⁻¹ G v,   W = G 𝓜⁻¹ Gᵀ (+ ρ tr(W)/m)        impulse λ = -W⁻¹ G v
//! ```

use alloc::vec;
use alloc::vec::Vec;

use super::boundary_kinematics::BoundaryKinematics;
use super::contact::Contact;
use crate::dense_lu::DenseLu;
use crate::errors::{ModelError, StepError};
use crate::kinematics::check_length;
use crate::tree::KinematicTree;

/// Workspace of the projection onto sets of contacts, allocated once.
#[derive(Clone, Debug)]
pub struct ContactProjection {
    nv: usize,
    capacity: usize,
    /// Rows `G` of the active contacts on `(V_body, q̇)`, and `y = G v`.
    rows: Vec<f64>,
    velocities: Vec<f64>,
    /// Row k holds the column k of `𝓜⁻¹Gᵀ`.
    responses: Vec<f64>,
    pub(super) gram: DenseLu,
    /// `tr(W)/m`.
    pub(super) mean_gram: f64,
    impulse: Vec<f64>,
    /// Cholesky factor of `W`.
    triangle: Vec<f64>,
}

impl ContactProjection {
    /// Room for all of `contacts`.
    pub fn new(tree: &KinematicTree, contacts: &[Contact]) -> Self {
        let (nv, rows) = (tree.dof(), contacts.iter().map(Contact::row_count).sum());
        Self {
            nv,
            capacity: rows,
            rows: vec![0.0; rows * nv],
            velocities: vec![0.0; rows],
            responses: vec![0.0; rows * nv],
            gram: DenseLu::new(rows),
            mean_gram: 0.0,
            impulse: vec![0.0; rows],
            triangle: vec![0.0; rows * rows],
        }
    }

    /// Active rows of the last [`ContactProjection::factor`].
    pub fn row_count(&self) -> usize {
        self.gram.order()
    }

    /// Rows `G` on `(V_body, q̇)` of the active contacts, row-major.
    pub fn rows(&self) -> &[f64] {
        &self.rows[..self.row_count() * self.nv]
    }

    /// `y = G v` at the state of the boundary.
    pub fn velocities(&self) -> &[f64] {
        &self.velocities[..self.row_count()]
    }

    /// Rows and velocities of the active contacts at a boundary.
    ///
    /// # Errors
    /// [`ModelError::Length`].
    pub(super) fn update_rows(
        &mut self,
        tree: &KinematicTree,
        boundary: &BoundaryKinematics,
        contacts: &[Contact],
        active: &[bool],
    ) -> Result<(), ModelError> {
        check_length("active contacts", active.len(), contacts.len())?;
        let nv = self.nv;
        let mut m = 0;
        for (contact, _) in contacts.iter().zip(active).filter(|(_, active)| **active) {
            let count = contact.row_count();
            if m + count > self.capacity {
                let (got, expected) = (m + count, self.capacity);
                return Err(ModelError::Length { quantity: "contact rows", got, expected });
            }
            let (y, g) = (&mut self.velocities[m..m + count], &mut self.rows[m * nv..(m + count) * nv]);
            boundary.contact_rows_into(tree, contact, y, g)?;
            m += count;
        }
        self.gram.set_order(m);
        Ok(())
    }

    /// Factors of a `W` given by its entries.
    ///
    /// # Errors
    /// [`StepError::RedundantConstraint`] with the first row that depends on those before it, unless regularised.
    pub(super) fn factor_gram(
        &mut self,
        regularisation: f64,
        entry: impl Fn(usize, usize) -> f64,
    ) -> Result<(), StepError> {
        let m = self.gram.order();
        self.mean_gram = 0.0;
        let gram = self.gram.entries_mut();
        for k in 0..m {
            for l in 0..m {
                gram[k * m + l] = entry(k, l);
            }
            self.mean_gram += gram[k * m + k] / m as f64;
        }
        for k in 0..m {
            gram[k * m + k] += regularisation * self.mean_gram;
        }
        if regularisation == 0.0 {
            self.refuse_dependent_rows()?;
        }
        self.gram.factor().map_err(|(row, pivot)| StepError::RedundantConstraint { row, pivot })
    }

    /// Rows, responses and their factorised product for the active contacts at a boundary. `regularisation` ρ >= 0 allows dependent
    /// rows. O(m Σ depth + m³), no allocation.
    ///
    /// # Errors
    /// [`StepError::RedundantConstraint`] with the first row that depends on those before it (ρ = 0); [`ModelError::Length`].
    pub fn factor(
        &mut self,
        tree: &KinematicTree,
        boundary: &BoundaryKinematics,
        contacts: &[Contact],
        active: &[bool],
        regularisation: f64,
    ) -> Result<(), StepError> {
        self.update_rows(tree, boundary, contacts, active)?;
        let (nv, m) = (self.nv, self.row_count());
        let mut responses = core::mem::take(&mut self.responses);
        responses[..m * nv].copy_from_slice(&self.rows[..m * nv]);
        let mut solved = Ok(());
        for response in responses[..m * nv].chunks_exact_mut(nv) {
            solved = solved.and(boundary.factor().solve_in_place(response));
        }
        let rows = core::mem::take(&mut self.rows);
        let outcome = self.factor_gram(regularisation, |k, l| {
            let (k, l) = (k.max(l), k.min(l));
            rows[k * nv..(k + 1) * nv].iter().zip(&responses[l * nv..]).map(|(a, b)| a * b).sum()
        });
        (self.rows, self.responses) = (rows, responses);
        solved?;
        outcome
    }

    /// Elimination without pivoting of the positive `W` (its lower triangle): the first pivot that vanishes belongs to the first
    /// dependent row.
    fn refuse_dependent_rows(&mut self) -> Result<(), StepError> {
        let m = self.gram.order();
        let Self { gram, triangle, .. } = self;
        for k in 0..m {
            for c in 0..=k {
                let mut value = gram.entry(k, c);
                for j in 0..c {
                    value -= triangle[k * m + j] * triangle[c * m + j];
                }
                if c < k {
                    triangle[k * m + c] = value / triangle[c * m + c];
                    continue;
                }
                let scale = gram.entry(k, k);
                if value <= super::DEPENDENT_ROW * scale || value.is_nan() {
                    return Err(StepError::RedundantConstraint { row: k, pivot: value / scale });
                }
                triangle[k * m + k] = crate::real::sqrt(value);
            }
        }
        Ok(())
    }

    /// Removes from `velocity` (`V_body, q̇`) what violates the active contacts; returns the impulses (N·s, N·m·s). For a robot that
    /// touches down this is the inelastic impact.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a wrong length.
    pub fn project(&mut self, velocity: &mut [f64]) -> Result<&[f64], ModelError> {
        check_length("velocity", velocity.len(), self.nv)?;
        let m = self.row_count();
        for (k, impulse) in self.impulse[..m].iter_mut().enumerate() {
            let row = &self.rows[k * self.nv..(k + 1) * self.nv];
            *impulse = -row.iter().zip(&*velocity).map(|(a, b)| a * b).sum::<f64>();
        }
        self.gram.solve(&mut self.impulse[..m]);
        for (k, impulse) in self.impulse[..m].iter().enumerate() {
            let response = &self.responses[k * self.nv..(k + 1) * self.nv];
            for (v, a) in velocity.iter_mut().zip(response) {
                *v += a * impulse;
            }
        }
        Ok(&self.impulse[..m])
    }
}
