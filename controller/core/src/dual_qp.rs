//! The small dual problem of a cycle, and who solves it.
//!
//! ```text
//! min ½ y' Γ y + h' y     s.t.  0 <= y <= ρ          Γ = G G' positive semidefinite with unit diagonal
//! ```
//!
//! `h` is the slack of every row at the unconstrained optimum (negative: violated), `ρ` the exact penalty of a soft row
//! (infinite: hard). See [`crate::projected_qp`] for where it comes from.

use faer::MatRef;

use crate::errors::QpError;

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
/// may be infinite).
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
    Ok(())
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
