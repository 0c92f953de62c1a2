//! The linearisation of an unsolved stage.

use alloc::vec;
use alloc::vec::Vec;

use super::ContactStage;
use crate::errors::ModelError;
use crate::kinematics::check_length;

/// `x_{k+1} = A x_k + B u_k + d` of one unsolved stage with active contacts, its mean contact forces, and what its nodes and
/// multipliers do.
///
/// `x` are the local coordinates of [`super::BoundaryState`], `2 nv`; `u` the joint forces held over the stage, as deviations from those
/// the stage was linearised at. Maps list the columns `[1 | x | u]`. All matrices are row-major.
#[derive(Clone, Debug)]
pub struct LiftedStage {
    pub(super) nv: usize,
    pub(super) nu: usize,
    pub(super) s: usize,
    /// Active row -> row of all contacts.
    pub(super) rows: Vec<u32>,
    /// First active row of every contact, or none.
    pub(super) first_rows: Vec<Option<u32>>,
    /// `2 nv` rows of `[d | A | B]`.
    pub(super) transition: Vec<f64>,
    pub(super) forces: Vec<f64>,
    pub(super) nodes: Vec<f64>,
    pub(super) multipliers: Vec<f64>,
    pub(super) residual: f64,
}

impl LiftedStage {
    pub(super) fn new(nv: usize, nu: usize, s: usize, contacts: usize, rows: usize) -> Self {
        let columns = 1 + 2 * nv + nu;
        Self {
            nv,
            nu,
            s,
            rows: Vec::with_capacity(rows),
            first_rows: vec![None; contacts],
            transition: vec![0.0; 2 * nv * columns],
            forces: vec![0.0; rows * columns],
            nodes: vec![0.0; s * nv * columns],
            multipliers: vec![0.0; (s + 1) * rows * columns],
            residual: 0.0,
        }
    }

    /// # Errors
    /// [`ModelError::Length`] when it was not made by `stage` or one like it.
    pub(super) fn check(&self, stage: &ContactStage) -> Result<(), ModelError> {
        let (columns, rows) = (stage.map_columns(), stage.row_count());
        let s = stage.del.unknown_nodes();
        check_length("columns of the lifted stage", self.columns(), columns)?;
        check_length("contacts of the lifted stage", self.first_rows.len(), stage.contacts.len())?;
        check_length("forces of the lifted stage", self.forces.len(), rows * columns)?;
        check_length("multipliers of the lifted stage", self.multipliers.len(), (s + 1) * rows * columns)
    }

    /// Coordinates `nv = 6 + joints`; a state has `2 nv`.
    pub fn dof(&self) -> usize {
        self.nv
    }

    /// Inputs: all joints.
    pub fn inputs(&self) -> usize {
        self.nu
    }

    /// Unknown nodes `s`.
    pub fn unknown_nodes(&self) -> usize {
        self.s
    }

    /// Columns of the maps: `1 + 2 nv + inputs`.
    pub fn columns(&self) -> usize {
        1 + 2 * self.nv + self.nu
    }

    /// Active rows `m`.
    pub fn row_count(&self) -> usize {
        self.rows.len()
    }

    /// For every active row its place among the rows of all contacts.
    pub fn row_of_all(&self) -> &[u32] {
        &self.rows
    }

    /// First active row of a contact; none when it is not active.
    pub fn first_row(&self, contact: usize) -> Option<usize> {
        self.first_rows.get(contact).copied().flatten().map(|row| row as usize)
    }

    /// Row `row` of `[d | A | B]`, empty beyond `2 nv`.
    pub fn transition_row(&self, row: usize) -> &[f64] {
        row_of(&self.transition, row, self.columns())
    }

    /// Entry of `A`; NaN beyond it.
    pub fn a(&self, row: usize, column: usize) -> f64 {
        self.transition(row, 1 + column)
    }

    /// Entry of `B`; NaN beyond it.
    pub fn b(&self, row: usize, column: usize) -> f64 {
        self.transition(row, 1 + 2 * self.nv + column)
    }

    /// Entry of `d`: where the stage ends, from the next boundary state.
    pub fn d(&self, row: usize) -> f64 {
        self.transition(row, 0)
    }

    fn transition(&self, row: usize, column: usize) -> f64 {
        self.transition_row(row).get(column).copied().unwrap_or(f64::NAN)
    }

    /// `[f_0 | F_x | F_u]` of active row `row`: mean force `Σ_α λ^α/Δt`, N or N·m.
    pub fn force_row(&self, row: usize) -> &[f64] {
        row_of(&self.forces, row, self.columns())
    }

    /// Change of node coordinate `row` (node-major from node 1 on, base chart first); empty without the maps of the nodes.
    pub fn node_row(&self, row: usize) -> &[f64] {
        row_of(&self.nodes, row, self.columns())
    }

    /// Change of the multiplier of active row `row` at node `alpha` (0..=s).
    pub fn multiplier_row(&self, alpha: usize, row: usize) -> &[f64] {
        row_of(&self.multipliers, alpha * self.rows.len() + row, self.columns())
    }

    /// Largest absolute entry of the DEL residual at the nominal, N·m·s or N·s.
    pub fn residual(&self) -> f64 {
        self.residual
    }

    /// [`LiftedStage::node_row`] applied to deviations.
    pub fn node_change(&self, row: usize, x: &[f64], u: &[f64]) -> f64 {
        self.apply(self.node_row(row), x, u)
    }

    /// [`LiftedStage::multiplier_row`] applied to deviations.
    pub fn multiplier_change(&self, alpha: usize, row: usize, x: &[f64], u: &[f64]) -> f64 {
        self.apply(self.multiplier_row(alpha, row), x, u)
    }

    /// `x_{k+1} = d + A x + B u` into `next` (`2 nv`).
    pub fn next_into(&self, x: &[f64], u: &[f64], next: &mut [f64]) {
        for (row, value) in next.iter_mut().enumerate() {
            *value = self.apply(self.transition_row(row), x, u);
        }
    }

    /// Mean forces `f_0 + F_x x + F_u u` of the active rows into `force`, N or N·m.
    pub fn force_into(&self, x: &[f64], u: &[f64], force: &mut [f64]) {
        for (row, value) in force.iter_mut().enumerate().take(self.rows.len()) {
            *value = self.apply(self.force_row(row), x, u);
        }
    }

    fn apply(&self, row: &[f64], x: &[f64], u: &[f64]) -> f64 {
        let Some((constant, row)) = row.split_first() else { return 0.0 };
        let (of_x, of_u) = row.split_at((2 * self.nv).min(row.len()));
        let sum = |row: &[f64], v: &[f64]| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
        constant + sum(of_x, x) + sum(of_u, u)
    }
}

fn row_of(values: &[f64], row: usize, columns: usize) -> &[f64] {
    values.get(row * columns..(row + 1) * columns).unwrap_or(&[])
}
