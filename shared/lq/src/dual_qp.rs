//! The small dual problem of a cycle, and who solves it.
//!
//! ```text
//! min ½ y' Γ y + h' y     s.t.  0 <= y <= ρ          Γ = G G' positive semidefinite with unit diagonal
//! ```
//!
//! `h` is the slack of every row at the unconstrained optimum (negative: violated), `ρ` the exact penalty of a soft row
//! (infinite: hard). See [`crate::projected_qp`] for where it comes from.

use faer::{Mat, MatRef};

use crate::errors::QpError;
use crate::kernels::{CholeskyScratch, factor, largest};

/// A matrix with an eigenvalue below this, relative to its largest diagonal entry, is not one of a convex problem.
const INDEFINITE: f64 = 1e-9;
/// Multipliers this large, relative to the largest slack, belong to a problem without a minimum.
pub(crate) const UNBOUNDED: f64 = 1e9;

/// What a solve took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DualReport {
    /// Iterations of the method.
    pub iterations: u32,
}

/// A solver of box-constrained dual problems up to a fixed size.
pub trait QpSolver: core::fmt::Debug {
    /// Rows there is room for.
    fn capacity(&self) -> usize;

    /// Fills `y` with the minimiser.
    ///
    /// | argument | meaning | shape |
    /// |---|---|---|
    /// | `gram` | `Γ`, full symmetric, unit diagonal | r x r |
    /// | `slack` | `h` | r |
    /// | `upper` | `ρ`, infinite for hard rows | r |
    /// | `y` | filled | r |
    ///
    /// # Errors
    /// [`QpError`]; `y` is then unspecified and must not be used.
    fn solve(
        &mut self,
        gram: MatRef<'_, f64>,
        slack: &[f64],
        upper: &[f64],
        y: &mut [f64],
    ) -> Result<DualReport, QpError>;
}

/// What every solver asks of its data.
///
/// # Errors
/// [`QpError::TooLarge`] for more rows than it has room for, [`QpError::NotFinite`] for a number that is not finite (an upper bound
/// may be infinite), [`QpError::EmptyBox`] for an upper bound below zero.
pub(crate) fn check_data(
    capacity: usize,
    gram: MatRef<'_, f64>,
    slack: &[f64],
    upper: &[f64],
) -> Result<(), QpError> {
    let rows = slack.len();
    if rows > capacity {
        return Err(QpError::TooLarge { rows, capacity });
    }
    let finite_gram = (0..rows).all(|j| (0..rows).all(|i| gram[(i, j)].is_finite()));
    if !finite_gram || !crate::kernels::all_finite(slack) || upper.iter().any(|u| u.is_nan()) {
        return Err(QpError::NotFinite);
    }
    match upper.iter().take(rows).position(|upper| *upper < 0.0) {
        Some(row) => Err(QpError::EmptyBox { row }),
        None => Ok(()),
    }
}

/// Whether problems have a minimum at all, by a Cholesky factorisation of `Γ` moved a little into the positive.
#[derive(Debug)]
pub(crate) struct Convexity {
    block: Mat<f64>,
    scratch: CholeskyScratch,
}

impl Convexity {
    /// Room for `capacity` rows.
    pub(crate) fn new(capacity: usize) -> Self {
        Self { block: Mat::zeros(capacity, capacity), scratch: CholeskyScratch::new(capacity) }
    }

    /// Refuses a matrix of `rows` rows that is not symmetric positive semidefinite. O(rows³), no allocation.
    ///
    /// # Errors
    /// [`QpError::NotConvex`].
    pub(crate) fn check(&mut self, gram: MatRef<'_, f64>, rows: usize) -> Result<(), QpError> {
        let top = (0..rows).fold(0.0f64, |top, i| top.max(gram[(i, i)]));
        let mut block = self.block.as_mut().submatrix_mut(0, 0, rows, rows);
        for j in 0..rows {
            for i in j..rows {
                block[(i, j)] = gram[(i, j)];
                if (gram[(i, j)] - gram[(j, i)]).abs() > INDEFINITE * top {
                    return Err(QpError::NotConvex);
                }
            }
            block[(j, j)] += INDEFINITE * top.max(f64::MIN_POSITIVE / INDEFINITE);
        }
        match rows {
            0 => Ok(()),
            _ => factor(block, &mut self.scratch).ok_or(QpError::NotConvex),
        }
    }
}

/// Refuses multipliers that do not solve the problem to `largest_miss` times the largest slack. O(r²), no allocation.
///
/// # Errors
/// [`QpError::NotFinite`], [`QpError::Unbounded`], [`QpError::NotConverged`].
pub(crate) fn check_answer(
    gram: MatRef<'_, f64>,
    slack: &[f64],
    upper: &[f64],
    y: &[f64],
    iterations: u32,
    largest_miss: f64,
) -> Result<(), QpError> {
    if !crate::kernels::all_finite(y) {
        return Err(QpError::NotFinite);
    }
    let scale = largest(slack);
    let residual = dual_residual(gram, slack, upper, y);
    if residual <= largest_miss * scale {
        return Ok(());
    }
    Err(if largest(y) > UNBOUNDED * scale {
        QpError::Unbounded
    } else {
        QpError::NotConverged { iterations }
    })
}

/// Largest violation of the optimality conditions of `y`: `|y - clamp(y - (Γ y + h), 0, ρ)|`. Zero exactly at a solution.
pub fn dual_residual(gram: MatRef<'_, f64>, slack: &[f64], upper: &[f64], y: &[f64]) -> f64 {
    let mut worst: f64 = 0.0;
    for (i, &value) in y.iter().enumerate() {
        let gradient = slack[i] + y.iter().enumerate().map(|(j, y)| gram[(i, j)] * y).sum::<f64>();
        let moved = (value - gradient).clamp(0.0, upper[i].max(0.0));
        worst = worst.max((value - moved).abs());
    }
    worst
}
