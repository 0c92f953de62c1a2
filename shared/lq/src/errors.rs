//! Why a problem has no solution.

/// Why the recursion over the stages gave none.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum LqError {
    /// A stage or terminal Hessian is not positive definite.
    #[error("the Riccati recursion broke down: H is not positive definite at stage {stage}")]
    NotPositiveDefinite {
        /// Stage of the horizon.
        stage: usize,
    },
    /// The infinite-horizon problem is solved for costs of state and input apart.
    #[error(
        "the stage has {count} residuals of state and input together: the infinite-horizon problem takes none"
    )]
    CrossTerms {
        /// How many it has.
        count: usize,
    },
    /// The infinite-horizon problem has no stabilising solution.
    #[error(
        "the terminal Riccati equation did not converge in {iterations} doublings (last change {change:e}, most of it in state {state}): posture or weights leave a mode without control"
    )]
    NoStabilisingSolution {
        /// Doublings made.
        iterations: usize,
        /// Relative change in the last one.
        change: f64,
        /// The state whose cost changed most.
        state: usize,
    },
}

/// Why a dual QP was not solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum QpError {
    /// The data or the answer hold a NaN or an infinity.
    #[error("QP data or solution are not finite")]
    NotFinite,
    /// The iteration stopped before its tolerance.
    #[error("the QP solver stopped after {iterations} iterations without reaching its tolerance")]
    NotConverged {
        /// Iterations made.
        iterations: u32,
    },
    /// The matrix is not positive semidefinite: the problem has no minimum, or many.
    #[error("the QP matrix is not symmetric positive semidefinite")]
    NotConvex,
    /// The objective falls without bound: hard rows contradict each other.
    #[error("the dual QP is unbounded: its hard rows contradict each other")]
    Unbounded,
    /// Nothing lies between the bounds of a multiplier.
    #[error("the upper bound of row {row} is below zero")]
    EmptyBox {
        /// The row.
        row: usize,
    },
    /// More rows than the solver has room for.
    #[error("{rows} rows, room for {capacity}")]
    TooLarge {
        /// Rows asked for.
        rows: usize,
        /// Rows there is room for.
        capacity: usize,
    },
    /// The solver refused its data.
    #[error("the QP solver refused its data")]
    Refused,
}
