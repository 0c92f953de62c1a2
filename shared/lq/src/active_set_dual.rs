//! Block principal pivoting for the dual problem: dense, allocation-free, finite. The backend without the standard library.
//!
//! Each row is free (F), at zero (L) or at its upper bound (U). For a partition, `Γ_FF y_F = -(h_F + Γ_FU ρ_U)` by Cholesky;
//! rows whose `y_F` leaves the box, or whose gradient has the wrong sign, change sides: all at once while their number shrinks,
//! else (after a few tries) only the last one, Murty's rule, which cannot cycle when `Γ` is positive definite. A relative
//! `1e-12` on the diagonal makes it so. [`QpSolver::solve`] starts cold; [`ActiveSetDual::settle`] starts from the sides that given
//! multipliers are on, and gives up early.
//!
//! If the partition has not settled after the iteration limit, projected coordinate descent takes over: slow, but it never
//! leaves the box and each sweep improves.
//!
//! Cost: O(r³) per partition, typically 3-8 partitions.
//!
//! Source: J. J. Júdice, F. M. Pires, *A block principal pivoting algorithm for large-scale strictly monotone linear
//! complementarity problems*, Computers & Operations Research 21, 1994; K. G. Murty, Opsearch 11, 1974.

use alloc::vec;
use alloc::vec::Vec;

use faer::{Mat, MatRef};

use crate::dual_qp::{Convexity, DualReport, QpSolver, UNBOUNDED, check_answer, check_data, dual_residual};
use crate::errors::QpError;
use crate::kernels::{CholeskyScratch, factor, solve_factored};

/// Added to the unit diagonal, so that dependent rows have a solution; far below the QP's tolerance.
const REGULARIZATION: f64 = 1e-12;
/// Partitions tried before coordinate descent.
const MAX_PARTITIONS: u32 = 200;
/// Exchanges of whole blocks that may fail to reduce the number of misplaced rows before Murty's rule.
const PATIENCE: u32 = 4;
/// Sweeps of coordinate descent.
const MAX_SWEEPS: u32 = 2000;
/// A row is misplaced when it breaks its condition by more than this, relative to the largest slack.
const MISPLACED: f64 = 1e-12;
/// Coordinate descent is done below this residual, relative to the largest slack.
const SWEEP_TOLERANCE: f64 = 1e-9;

/// An answer that misses the optimality conditions by more than this, relative to the largest slack, is none.
const LARGEST_MISS: f64 = 1e-5;
/// A gradient below this, relative to the largest slack, vanishes.
const STATIONARY: f64 = 1e-6;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    Free,
    Zero,
    Upper,
}

/// The solver and its memory.
#[derive(Debug)]
pub struct ActiveSetDual {
    sides: Vec<Side>,
    free: Vec<usize>,
    block: Mat<f64>,
    solution: Vec<f64>,
    gradient: Vec<f64>,
    scratch: CholeskyScratch,
    start: Vec<f64>,
    convexity: Convexity,
    /// The last partitions settled on multipliers that only the regularisation holds.
    diverged: bool,
}

impl ActiveSetDual {
    /// Room for `capacity` rows.
    pub fn new(capacity: usize) -> Self {
        Self {
            sides: vec![Side::Zero; capacity],
            free: Vec::with_capacity(capacity),
            block: Mat::zeros(capacity, capacity),
            solution: vec![0.0; capacity],
            gradient: vec![0.0; capacity],
            scratch: CholeskyScratch::new(capacity),
            start: Vec::with_capacity(capacity),
            convexity: Convexity::new(capacity),
            diverged: false,
        }
    }

    /// Solves for the free rows of the present partition and computes all gradients.
    fn solve_partition(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Option<()> {
        let rows = slack.len();
        self.free.clear();
        for i in 0..rows {
            match self.sides[i] {
                Side::Free => self.free.push(i),
                Side::Zero => y[i] = 0.0,
                Side::Upper => y[i] = upper[i],
            }
        }
        let count = self.free.len();
        let mut block = self.block.as_mut().submatrix_mut(0, 0, count, count);
        for (a, &i) in self.free.iter().enumerate() {
            let mut right = -slack[i];
            for j in 0..rows {
                if self.sides[j] == Side::Upper {
                    right -= gram[(i, j)] * upper[j];
                }
            }
            self.solution[a] = right;
            for (b, &j) in self.free.iter().enumerate() {
                block[(a, b)] = gram[(i, j)];
            }
            block[(a, a)] += REGULARIZATION;
        }
        if count > 0 {
            factor(block.as_mut(), &mut self.scratch)?;
            let solution = &mut self.solution[..count];
            solve_factored(block.as_ref(), solution);
            for (a, &i) in self.free.iter().enumerate() {
                y[i] = self.solution[a];
            }
        }
        for i in 0..rows {
            self.gradient[i] = slack[i] + (0..rows).map(|j| gram[(i, j)] * y[j]).sum::<f64>();
        }
        Some(())
    }

    /// A few partitions from the sides `y` is on; `None` when they have not settled after `limit`, and `y` is as before.
    ///
    /// # Errors
    /// As [`QpSolver::solve`].
    pub fn settle(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
        limit: u32,
    ) -> Result<Option<DualReport>, QpError> {
        self.settle_near(gram, slack, upper, y, 0.0, limit)
    }

    /// The same where multipliers within `near` of a bound count as on it.
    ///
    /// # Errors
    /// As [`QpSolver::solve`].
    pub fn settle_near(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
        near: f64,
        limit: u32,
    ) -> Result<Option<DualReport>, QpError> {
        check_data(self.capacity(), gram, slack, upper)?;
        self.start.clear();
        self.start.extend_from_slice(y);
        for (side, (y, upper)) in self.sides.iter_mut().zip(y.iter().zip(upper)) {
            *side = match *y {
                y if y <= near => Side::Zero,
                y if y >= *upper - near => Side::Upper,
                _ => Side::Free,
            };
        }
        let settled = self.pivot(gram, slack, upper, y, limit);
        if settled.is_none() {
            y.copy_from_slice(&self.start);
        }
        Ok(settled)
    }

    /// Changes sides until every row is in its place; `None` after `limit` partitions, or when one has no solution.
    fn pivot(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
        limit: u32,
    ) -> Option<DualReport> {
        let rows = slack.len();
        let tolerance = MISPLACED * (1.0 + crate::kernels::largest(slack));
        self.diverged = false;
        let mut fewest = usize::MAX;
        let mut patience = PATIENCE;
        for iterations in 1..=limit {
            self.solve_partition(gram, slack, upper, y)?;
            let misplaced = |set: &Self, i: usize, y: &[f64]| set.better_side(i, y, upper, tolerance);
            let count = (0..rows).filter(|&i| misplaced(self, i, y).is_some()).count();
            if count == 0 {
                // Without a minimum it is the regularisation that holds the multipliers, and the gradient does not vanish.
                let scale = crate::kernels::largest(slack);
                if crate::kernels::largest(y) > UNBOUNDED * scale && !self.is_stationary(y, scale) {
                    self.diverged = true;
                    return None;
                }
                for (value, limit) in y.iter_mut().zip(upper) {
                    *value = value.clamp(0.0, limit.max(0.0));
                }
                return crate::kernels::all_finite(y).then_some(DualReport { iterations });
            }
            let whole_block = if count < fewest {
                fewest = count;
                patience = PATIENCE;
                true
            } else {
                patience = patience.saturating_sub(1);
                patience > 0
            };
            for i in (0..rows).rev() {
                if let Some(side) = misplaced(self, i, y) {
                    self.sides[i] = side;
                    if !whole_block {
                        break;
                    }
                }
            }
        }
        None
    }

    /// Whether the gradient of the free rows vanishes.
    fn is_stationary(&self, y: &[f64], scale: f64) -> bool {
        let rows = self.sides.iter().zip(&self.gradient).take(y.len());
        rows.filter(|(side, _)| **side == Side::Free)
            .all(|(_, gradient)| gradient.abs() <= STATIONARY * scale)
    }

    /// The side a row should change to, if it is misplaced.
    fn better_side(&self, i: usize, y: &[f64], upper: &[f64], tolerance: f64) -> Option<Side> {
        match self.sides[i] {
            Side::Free if y[i] < -tolerance => Some(Side::Zero),
            Side::Free if y[i] > upper[i] + tolerance => Some(Side::Upper),
            Side::Zero if self.gradient[i] < -tolerance && upper[i] > 0.0 => Some(Side::Free),
            Side::Upper if self.gradient[i] > tolerance => Some(Side::Free),
            _ => None,
        }
    }

    fn coordinate_descent(gram: MatRef<'_, f64>, slack: &[f64], upper: &[f64], y: &mut [f64]) -> (u32, f64) {
        let tolerance = SWEEP_TOLERANCE * (1.0 + crate::kernels::largest(slack));
        let mut residual = f64::INFINITY;
        for sweep in 0..MAX_SWEEPS {
            for i in 0..y.len() {
                let gradient = slack[i] + (0..y.len()).map(|j| gram[(i, j)] * y[j]).sum::<f64>();
                let curvature = gram[(i, i)].max(REGULARIZATION);
                y[i] = (y[i] - gradient / curvature).clamp(0.0, upper[i].max(0.0));
            }
            if sweep % 16 == 15 {
                residual = dual_residual(gram, slack, upper, y);
                if residual <= tolerance {
                    return (sweep + 1, residual);
                }
            }
        }
        (MAX_SWEEPS, residual)
    }
}

impl QpSolver for ActiveSetDual {
    fn capacity(&self) -> usize {
        self.sides.len()
    }

    fn solve(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Result<DualReport, QpError> {
        check_data(self.capacity(), gram, slack, upper)?;
        for (side, h) in self.sides.iter_mut().zip(slack) {
            *side = if *h < 0.0 { Side::Free } else { Side::Zero };
        }
        self.convexity.check(gram, slack.len())?;
        if let Some(report) = self.pivot(gram, slack, upper, y, MAX_PARTITIONS) {
            check_answer(gram, slack, upper, y, report.iterations, LARGEST_MISS)?;
            return Ok(report);
        }
        if self.diverged {
            return Err(QpError::Unbounded);
        }
        for (value, limit) in y.iter_mut().zip(upper) {
            *value = if value.is_finite() { value.clamp(0.0, limit.max(0.0)) } else { 0.0 };
        }
        let (sweeps, _) = Self::coordinate_descent(gram, slack, upper, y);
        let iterations = MAX_PARTITIONS + sweeps;
        check_answer(gram, slack, upper, y, iterations, LARGEST_MISS)?;
        Ok(DualReport { iterations })
    }
}
