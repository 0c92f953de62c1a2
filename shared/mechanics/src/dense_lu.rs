//! Dense LU with partial pivoting: the fallback when a leaf-to-root pivot fails, and the oracle of the tests.
//!
//! Source: G. H. Golub, C. F. Van Loan, *Matrix Computations*, 4th ed., algorithm 3.4.1. Cost: 2 m³/3 flops for `m` unknowns.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::FactorError;
use crate::newton_direction::{NewtonDirection, base_block};
use crate::row_matrix::RowMatrix;
use crate::tree::KinematicTree;

/// Pivots smaller than this, relative to the largest entry of the matrix, count as zero.
const SINGULAR: f64 = 1e-15;

/// A square matrix factorised in place, `P A = L U`.
#[derive(Clone, Debug)]
pub struct DenseLu {
    order: usize,
    entries: Vec<f64>,
    pivots: Vec<usize>,
}

impl DenseLu {
    /// Room for matrices of the given order.
    pub fn new(order: usize) -> Self {
        Self { order, entries: vec![0.0; order * order], pivots: vec![0; order] }
    }

    /// Changes the order, up to the one the room was made for without allocation; the entries become zero.
    pub(crate) fn set_order(&mut self, order: usize) {
        self.order = order;
        self.entries.clear();
        self.entries.resize(order * order, 0.0);
        self.pivots.clear();
        self.pivots.resize(order, 0);
    }

    /// Number of unknowns.
    pub(crate) fn order(&self) -> usize {
        self.order
    }

    /// Row `row` of the factors.
    pub(crate) fn row(&self, row: usize) -> &[f64] {
        &self.entries[row * self.order..(row + 1) * self.order]
    }

    /// Rows that the factorisation swapped: row k with `swaps()[k]`, in this order.
    pub(crate) fn swaps(&self) -> &[usize] {
        &self.pivots
    }

    /// The entries, row-major: fill them, then [`DenseLu::factor`].
    pub fn entries_mut(&mut self) -> &mut [f64] {
        &mut self.entries
    }

    /// Entry `(row, column)`, before or after factorisation.
    pub fn entry(&self, row: usize, column: usize) -> f64 {
        self.entries[row * self.order + column]
    }

    /// Factorises what [`DenseLu::entries_mut`] holds.
    ///
    /// # Errors
    /// The index and size of the first pivot that vanishes.
    pub fn factor(&mut self) -> Result<(), (usize, f64)> {
        let n = self.order;
        let largest = self.entries.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        for k in 0..n {
            let mut pivot = k;
            for row in k + 1..n {
                if self.entries[row * n + k].abs() > self.entries[pivot * n + k].abs() {
                    pivot = row;
                }
            }
            self.pivots[k] = pivot;
            let size = self.entries[pivot * n + k].abs();
            if size <= SINGULAR * largest || size.is_nan() {
                return Err((k, size));
            }
            if pivot != k {
                let (upper, lower) = self.entries.split_at_mut(pivot * n);
                upper[k * n..k * n + n].swap_with_slice(&mut lower[..n]);
            }
            let (upper, lower) = self.entries.split_at_mut((k + 1) * n);
            let pivot_row = &upper[k * n..];
            let inverse = 1.0 / pivot_row[k];
            for row in lower.chunks_exact_mut(n) {
                let factor = row[k] * inverse;
                row[k] = factor;
                for (x, p) in row[k + 1..].iter_mut().zip(&pivot_row[k + 1..]) {
                    *x -= factor * p;
                }
            }
        }
        Ok(())
    }

    /// Solves `A x = b` in place.
    pub fn solve(&self, b: &mut [f64]) {
        let n = self.order;
        for k in 0..n {
            b.swap(k, self.pivots[k]);
        }
        for row in 1..n {
            let sum: f64 = (0..row).map(|c| self.entries[row * n + c] * b[c]).sum();
            b[row] -= sum;
        }
        for row in (0..n).rev() {
            let sum: f64 = (row + 1..n).map(|c| self.entries[row * n + c] * b[c]).sum();
            b[row] = (b[row] - sum) / self.entries[row * n + row];
        }
    }

    /// Solves `Aᵀ x = b` in place.
    pub fn solve_transposed(&self, b: &mut [f64]) {
        let n = self.order;
        for row in 0..n {
            let sum: f64 = (0..row).map(|c| self.entries[c * n + row] * b[c]).sum();
            b[row] = (b[row] - sum) / self.entries[row * n + row];
        }
        for row in (0..n).rev() {
            let sum: f64 = (row + 1..n).map(|c| self.entries[c * n + row] * b[c]).sum();
            b[row] -= sum;
        }
        for k in (0..n).rev() {
            b.swap(k, self.pivots[k]);
        }
    }
}

/// The Newton matrix as a dense matrix: O((s n)³). Rows and columns in coordinate-major order.
#[derive(Clone, Debug)]
pub struct DenseNewton {
    s: usize,
    hessian: DelHessian,
    lu: DenseLu,
    column: Vec<f64>,
}

impl DenseNewton {
    /// For the steps of `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let s = del.unknown_nodes();
        let order = s * tree.dof();
        Self { s, hessian: DelHessian::new(tree, del), lu: DenseLu::new(order), column: vec![0.0; order] }
    }

    /// Assembles the Newton matrix without factorising it (row-major, coordinate-major order).
    pub fn assemble(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> &[f64] {
        self.hessian.evaluate(tree, del);
        let (s, order, base) = (self.s, self.lu.order, tree.base_dof());
        let entries = &mut self.lu.entries;
        entries.fill(0.0);
        for i in tree.first_joint_body()..tree.body_count() {
            let row = tree.joint_dof(i);
            for (position, &dof) in tree.branch(i).iter().enumerate() {
                let (column, pair) = (dof as usize, self.hessian.pair_starts[i] + position);
                for alpha in 0..s {
                    for gamma in 1..=s {
                        let ahead = self.hessian.entry(pair, alpha, gamma);
                        entries[(row * s + alpha) * order + column * s + gamma - 1] = ahead;
                        if column != row {
                            let behind = self.hessian.mirrored(pair, alpha, gamma);
                            entries[(column * s + alpha) * order + row * s + gamma - 1] = behind;
                        }
                    }
                }
            }
        }
        if base > 0 {
            for i in tree.first_joint_body()..tree.body_count() {
                let dof = tree.joint_dof(i);
                let joint = self.hessian.joint_and_base(i, dof, s, self.hessian.groups);
                for k in 0..6 {
                    for alpha in 0..s {
                        for gamma in 1..=s {
                            entries[(dof * s + alpha) * order + k * s + gamma - 1] =
                                joint.joint_row(k, alpha, gamma);
                            entries[(k * s + alpha) * order + dof * s + gamma - 1] =
                                joint.base_row(k, alpha, gamma);
                        }
                    }
                }
            }
            base_block(del, &self.hessian, s, |[row, alpha], [column, gamma], value| {
                entries[(row * s + alpha) * order + column * s + gamma] = value;
            });
        }
        &self.lu.entries
    }
}

impl NewtonDirection for DenseNewton {
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError> {
        self.assemble(tree, del);
        let s = self.s;
        self.lu.factor().map_err(|(index, pivot)| {
            let dof = index / s;
            let body =
                if dof < tree.base_dof() { 0 } else { dof - tree.base_dof() + tree.first_joint_body() };
            FactorError::SingularPivot { body, pivot }
        })
    }

    fn solve(&mut self, _tree: &KinematicTree, rhs: &mut [f64]) {
        self.lu.solve(rhs);
    }

    fn solve_transposed(&mut self, _tree: &KinematicTree, rhs: &mut [f64]) {
        self.lu.solve_transposed(rhs);
    }

    fn solve_many(&mut self, _tree: &KinematicTree, rhs: &mut RowMatrix) {
        for c in 0..rhs.columns() {
            for (r, x) in self.column.iter_mut().enumerate() {
                *x = rhs.get(r, c);
            }
            self.lu.solve(&mut self.column);
            for (r, x) in self.column.iter().enumerate() {
                rhs.set(r, c, *x);
            }
        }
    }

    fn hessian(&self) -> Option<&DelHessian> {
        Some(&self.hessian)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_with_pivoting_both_ways() {
        let a = [0.0, 2.0, 1.0, 1.0, -1.0, 0.5, 3.0, 0.25, -2.0];
        let mut lu = DenseLu::new(3);
        lu.entries_mut().copy_from_slice(&a);
        lu.factor().unwrap();
        let x = [1.0, -2.0, 0.5];
        let times = |r: usize, c: usize| a[3 * r + c];
        let mut b: Vec<f64> = (0..3).map(|r| (0..3).map(|c| times(r, c) * x[c]).sum()).collect();
        lu.solve(&mut b);
        let mut bt: Vec<f64> = (0..3).map(|r| (0..3).map(|c| times(c, r) * x[c]).sum()).collect();
        lu.solve_transposed(&mut bt);
        for k in 0..3 {
            assert!((b[k] - x[k]).abs() < 1e-15 && (bt[k] - x[k]).abs() < 1e-15);
        }
    }

    #[test]
    fn a_singular_matrix_is_reported_with_its_pivot() {
        let mut lu = DenseLu::new(2);
        lu.entries_mut().copy_from_slice(&[1.0, 2.0, 2.0, 4.0]);
        assert!(matches!(lu.factor(), Err((1, _))));
    }
}
