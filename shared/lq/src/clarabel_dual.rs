//! The dual problem on Clarabel: interior point, fixed sizes, updated in place.
//!
//! One solver per size 8, 16, 32, .. up to the capacity, each set up once; a solve overwrites `P`, `q`, `A`, `b` in the stored
//! pattern. Unused rows get `Γ_ii = 1`, `h_i = 1`, so that they end at zero.
//!
//! ```text
//! min ½ ỹ'Γỹ + (h/σ)'ỹ     -ỹ_i + s_i = 0,   a_i ỹ_i + s_(r+i) = b_i,   s >= 0         y = σ ỹ,  σ = max |h|
//! ```
//!
//! Every answer is checked against the optimality conditions, and a matrix that is not positive semidefinite is refused beforehand: an
//! interior-point method may end on either. A solver that failed is made anew; its factors may hold what no later problem can undo.
//!
//! A soft row has `a = 1, b = ρ/σ`; a hard one `a = 0, b = 1` (a row that says nothing: the pattern stays, no infinities). Bounds far
//! above the multipliers cost iterations, and usually say nothing either: they are left out at first, and the problem is solved
//! again with them if a multiplier exceeds one.
//!
//! Cost (measured, one core): 0.06 / 0.13 / 0.40 / 1.7 ms for 8 / 16 / 32 / 64 rows. Allocations: one inside Clarabel per solve, and all of a new solver
//! after a failure.
//!
//! Source: P. Goulart, Y. Chen, *Clarabel: An interior-point solver for conic programs with quadratic objectives*, 2024.

use std::vec;
use std::vec::Vec;

use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettings, DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};
use faer::MatRef;

use crate::dual_qp::{Convexity, DualReport, QpSolver, check_answer, check_data};
use crate::errors::QpError;

/// The smallest solver.
const SMALLEST: usize = 8;
/// Bounds `ρ/σ` above this are tried without.
const FAR_BOUND: f64 = 30.0;
/// An answer may miss the optimality conditions by this times the root of the tolerance, relative to the largest slack.
const DEGENERATE_MISS: f64 = 10.0;
/// Iterations after which an interior-point solve is given up; 6-12 are usual.
const MAX_ITERATIONS: u32 = 30;

struct FixedSize {
    rows: usize,
    tolerance: f64,
    solver: DefaultSolver<f64>,
    hessian: Vec<f64>,
    gradient: Vec<f64>,
    matrix: Vec<f64>,
    bound: Vec<f64>,
}

impl core::fmt::Debug for FixedSize {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("FixedSize").field("rows", &self.rows).finish_non_exhaustive()
    }
}

/// Settings every Clarabel problem of this crate uses: one thread, quiet, data may be updated.
pub(crate) fn settings(tolerance: f64, max_iterations: u32) -> Result<DefaultSettings<f64>, QpError> {
    DefaultSettingsBuilder::default()
        .verbose(false)
        .max_threads(1)
        .max_iter(max_iterations)
        .tol_gap_abs(tolerance)
        .tol_gap_rel(tolerance)
        .tol_feas(tolerance)
        .direct_solve_method(std::string::String::from("qdldl"))
        .iterative_refinement_enable(false)
        .presolve_enable(false)
        .input_sparse_dropzeros(false)
        .build()
        .map_err(|_| QpError::Refused)
}

/// The upper triangle of a full symmetric matrix, with ones on the diagonal.
fn identity(rows: usize) -> CscMatrix<f64> {
    let (mut column_starts, mut row_indices, mut values) = (vec![0], Vec::new(), Vec::new());
    for column in 0..rows {
        for row in 0..=column {
            row_indices.push(row);
            values.push(if row == column { 1.0 } else { 0.0 });
        }
        column_starts.push(row_indices.len());
    }
    CscMatrix::new(rows, rows, column_starts, row_indices, values)
}

/// `-1` for the lower and `1` for the upper bound of every multiplier.
fn rows_of_bounds(rows: usize) -> CscMatrix<f64> {
    let (mut column_starts, mut row_indices, mut values) = (vec![0], Vec::new(), Vec::new());
    for column in 0..rows {
        row_indices.extend([column, rows + column]);
        values.extend([-1.0, 1.0]);
        column_starts.push(row_indices.len());
    }
    CscMatrix::new(2 * rows, rows, column_starts, row_indices, values)
}

/// A solver that has met no problem yet.
fn solver(
    rows: usize,
    tolerance: f64,
    gradient: &[f64],
    bound: &[f64],
) -> Result<DefaultSolver<f64>, QpError> {
    let cones = [SupportedConeT::NonnegativeConeT(2 * rows)];
    let settings = settings(tolerance, MAX_ITERATIONS)?;
    DefaultSolver::new(&identity(rows), gradient, &rows_of_bounds(rows), bound, &cones, settings)
        .map_err(|_| QpError::Refused)
}

impl FixedSize {
    fn new(rows: usize, tolerance: f64) -> Result<Self, QpError> {
        let (hessian, matrix) = (identity(rows).nzval, rows_of_bounds(rows).nzval);
        let mut bound = vec![0.0; rows];
        bound.resize(2 * rows, 1.0);
        let gradient = vec![1.0; rows];
        let solver = solver(rows, tolerance, &gradient, &bound)?;
        Ok(Self { rows, tolerance, solver, hessian, gradient, matrix, bound })
    }

    /// Solves, and after a failure leaves a solver that has met nothing.
    fn solve(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Result<DualReport, QpError> {
        let solved = self.solve_once(gram, slack, upper, y);
        if solved.is_err() {
            let (gradient, bound) =
                (vec![1.0; self.rows], [vec![0.0; self.rows], vec![1.0; self.rows]].concat());
            self.solver = solver(self.rows, self.tolerance, &gradient, &bound)?;
        }
        solved
    }

    fn solve_once(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Result<DualReport, QpError> {
        let scale = crate::kernels::largest(slack);
        if scale == 0.0 {
            y.fill(0.0);
            return Ok(DualReport::default());
        }
        self.fill(gram, slack, scale);
        let far = |limit: f64| limit > FAR_BOUND * scale;
        self.bound(upper, scale, far);
        let mut report = self.attempt(scale, y)?;
        if y.iter().zip(upper).any(|(y, limit)| far(*limit) && y > limit) {
            self.bound(upper, scale, |limit| limit == f64::INFINITY);
            report.iterations += self.attempt(scale, y)?.iterations;
        }
        for (value, limit) in y.iter_mut().zip(upper) {
            *value = value.clamp(0.0, limit.max(0.0));
        }
        // Of a multiplier and a slack that are both nearly zero, an interior-point method knows the product.
        let miss = DEGENERATE_MISS * self.tolerance.sqrt();
        check_answer(gram, slack, upper, y, report.iterations, miss)?;
        Ok(report)
    }

    /// Objective of the problem, unused rows filled up.
    fn fill(&mut self, gram: MatRef<'_, f64>, slack: &[f64], scale: f64) {
        let used = slack.len();
        let mut entry = 0;
        for column in 0..self.rows {
            for row in 0..=column {
                self.hessian[entry] = match (column < used, row == column) {
                    (true, _) => gram[(row, column)],
                    (false, true) => 1.0,
                    (false, false) => 0.0,
                };
                entry += 1;
            }
            self.gradient[column] = if column < used { slack[column] / scale } else { 1.0 };
        }
    }

    /// Upper bounds, without those for which `absent` holds.
    fn bound(&mut self, upper: &[f64], scale: f64, absent: impl Fn(f64) -> bool) {
        for row in 0..self.rows {
            let limit = upper.get(row).copied().filter(|limit| !absent(*limit));
            self.matrix[2 * row + 1] = if limit.is_some() { 1.0 } else { 0.0 };
            self.bound[self.rows + row] = limit.map_or(1.0, |limit| limit.max(0.0) / scale);
        }
    }

    /// One run of Clarabel.
    fn attempt(&mut self, scale: f64, y: &mut [f64]) -> Result<DualReport, QpError> {
        self.solver
            .update_data(&self.hessian, &self.gradient, &self.matrix, &self.bound)
            .map_err(|_| QpError::Refused)?;
        self.solver.solve();
        let solution = &self.solver.solution;
        let iterations = solution.iterations;
        // Where it stops near the end, the optimality conditions judge the answer.
        let near_the_end = [
            SolverStatus::Solved,
            SolverStatus::AlmostSolved,
            SolverStatus::InsufficientProgress,
            SolverStatus::MaxIterations,
        ];
        if !near_the_end.contains(&solution.status) {
            return Err(QpError::NotConverged { iterations });
        }
        for (value, x) in y.iter_mut().zip(&solution.x) {
            *value = x * scale;
            if !value.is_finite() {
                return Err(QpError::NotFinite);
            }
        }
        Ok(DualReport { iterations })
    }
}

/// Clarabel as a [`QpSolver`].
#[derive(Debug)]
pub struct ClarabelDual {
    solvers: Vec<FixedSize>,
    convexity: Convexity,
}

impl ClarabelDual {
    /// Solvers of 8, 16, .. rows up to at least `capacity`, to the relative `tolerance`.
    ///
    /// # Errors
    /// [`QpError::Refused`] when Clarabel does not accept the set-up.
    pub fn new(capacity: usize, tolerance: f64) -> Result<Self, QpError> {
        let mut solvers = vec![FixedSize::new(SMALLEST, tolerance)?];
        let mut rows = SMALLEST;
        while rows < capacity {
            rows *= 2;
            solvers.push(FixedSize::new(rows, tolerance)?);
        }
        Ok(Self { solvers, convexity: Convexity::new(rows) })
    }
}

impl QpSolver for ClarabelDual {
    fn capacity(&self) -> usize {
        self.solvers.last().map_or(0, |solver| solver.rows)
    }

    fn solve(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Result<DualReport, QpError> {
        let (rows, capacity) = (slack.len(), self.capacity());
        check_data(capacity, gram, slack, upper)?;
        self.convexity.check(gram, rows)?;
        match self.solvers.iter_mut().find(|solver| solver.rows >= rows) {
            Some(solver) => solver.solve(gram, slack, upper, y),
            None => Err(QpError::TooLarge { rows, capacity }),
        }
    }
}
