//! Options of a step, and what it took.

use crate::del_residual::ForceCapacity;
use crate::newton_direction::NewtonMethod;

/// How the Newton matrix is used from one iteration to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NewtonVariant {
    /// Factorised anew in every iteration.
    Exact,
    /// Factorised once, renewed when the contraction is poor.
    Simplified,
    /// As `Simplified`, with Broyden's rank-one updates.
    Broyden,
    /// Its inertia part stands in for it, `J ≈ M(q) ⊗ A` with the mass matrix in the middle of the step, with Broyden's updates; the
    /// whole of it only in steps where that contracts too slowly. Twice as fast as `Broyden` for s >= 5 on chains of some ten links, no
    /// gain below s = 4. A floating base takes `Broyden`.
    Inertial,
}

/// What is fixed when an [`Integrator`](super::Integrator) is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepOptions {
    /// Factorisation; `None` takes [`NewtonMethod::fastest`].
    pub method: Option<NewtonMethod>,
    /// Use of the Newton matrix.
    pub variant: NewtonVariant,
    /// Iterations after which the step fails.
    pub max_iterations: usize,
    /// The iteration ends when the next change of a coordinate is predicted below this, times `1 + max|q|`. At 1e-16, the default,
    /// invariants hold over many steps; a prediction over a few steps needs less.
    pub accuracy: f64,
    /// A revolute joint may end a step this far (rad) from where the guess put it; solutions beyond are refused as spurious.
    pub turn_limit: f64,
    /// Largest change of a revolute joint in one iteration (rad): a longer change is shortened as a whole; infinite (the default): no
    /// limit. Without effect while changes are small. 0.3 helps long chains at steps so long that `J` is nearly singular on the way;
    /// a tree whose way to the root is longer than that may need more iterations with it than without.
    pub change_limit: f64,
    /// Room for forces outside the model.
    pub forces: ForceCapacity,
    /// Coordinates times nodes up to which a dense LU stands by for states where a leaf-to-root pivot is singular.
    pub dense_fallback: usize,
}

impl Default for StepOptions {
    fn default() -> Self {
        Self {
            method: None,
            variant: NewtonVariant::Broyden,
            max_iterations: 40,
            accuracy: 1e-16,
            turn_limit: 1.0,
            change_limit: f64::INFINITY,
            forces: ForceCapacity::default(),
            dense_fallback: 128,
        }
    }
}

/// What a step took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Newton iterations (residual evaluations with a solve).
    pub iterations: usize,
    /// Factorisations of the Newton matrix.
    pub factorizations: usize,
    /// Largest absolute entry of the last change.
    pub last_change: f64,
}
