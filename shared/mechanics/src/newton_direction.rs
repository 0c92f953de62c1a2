//! The Newton direction of the DEL equations, `J x = rhs`: one trait over three factorisations.
//!
//! | implementation | cost | choose it for |
//! |---|---|---|
//! | [`crate::branch_lu::BranchLu`] | O(s³ Σ depth²) factor, O(s² Σ depth) per solve | robots: many short branches |
//! | [`crate::recursive_newton::RecursiveNewton`] (Algorithm B.1) | O(s³ n) factor, O(s² n) per solve | long chains |
//! | [`crate::dense_lu::DenseNewton`] | O(s³ n³) | a pivot block that is singular although `J` is not; tests |
//!
//! Vectors are coordinate-major: entry `dof * s + α` of a right-hand side (`α = 0..s-1`), entry `dof * s + γ - 1` of a solution
//! (`γ = 1..s`).

use crate::branch_lu::BranchLu;
use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::dense_lu::DenseNewton;
use crate::errors::FactorError;
use crate::recursive_newton::RecursiveNewton;
use crate::row_matrix::RowMatrix;
use crate::tree::KinematicTree;

mod base_block;

pub(crate) use base_block::{base_block, base_matrix, held_rows_matrix, second_order_matrix};

/// A factorisation of the Newton matrix of one step.
pub trait NewtonDirection {
    /// Factorises `J` at the nodes last evaluated in `del`. No allocation.
    ///
    /// # Errors
    /// [`FactorError::SingularPivot`] when a pivot block is singular to working precision.
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError>;

    /// `rhs := J⁻¹ rhs`.
    fn solve(&mut self, tree: &KinematicTree, rhs: &mut [f64]);

    /// `rhs := J⁻ᵀ rhs`.
    fn solve_transposed(&mut self, tree: &KinematicTree, rhs: &mut [f64]);

    /// `rhs := J⁻¹ rhs` for many columns.
    fn solve_many(&mut self, tree: &KinematicTree, rhs: &mut RowMatrix);

    /// The Hessian blocks behind the factorisation, where it has them.
    fn hessian(&self) -> Option<&DelHessian>;
}

/// Which factorisation a step uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NewtonMethod {
    /// Branch-sparse block LU.
    BranchLu,
    /// Algorithm B.1.
    Recursive,
    /// Dense LU with pivoting.
    Dense,
}

/// Root-mean-square depth above which Algorithm B.1 beats the branch LU, for s = 1, 2, 3, 4 and more.
///
/// Measured with `benches/crossover.rs` (Xeon with AVX-512; chains and stars of 8 to 125 links): factor and solve cost the same below the
/// least depth tried, 4, for s = 1, at 12 to 15 for s = 2, 33 for s = 3 (chains), 12 to 14 for s = 4. Atlas on its foot has 10.6.
const CROSSOVER_DEPTH: [f64; 4] = [3.0, 14.0, 33.0, 13.0];

impl NewtonMethod {
    /// The faster one for a tree and a number of unknown nodes, by measured crossover of the depth.
    pub fn fastest(tree: &KinematicTree, unknown_nodes: usize) -> Self {
        let bodies = tree.first_joint_body()..tree.body_count();
        let sum: f64 = bodies.map(|i| (tree.branch(i).len() * tree.branch(i).len()) as f64).sum();
        let limit = CROSSOVER_DEPTH[unknown_nodes.clamp(1, CROSSOVER_DEPTH.len()) - 1];
        if sum > limit * limit * tree.joint_count().max(1) as f64 { Self::Recursive } else { Self::BranchLu }
    }
}

/// One of the three, chosen at run time.
#[derive(Clone, Debug)]
#[allow(clippy::large_enum_variant)]
pub enum NewtonSolver {
    /// Branch-sparse block LU.
    BranchLu(BranchLu),
    /// Algorithm B.1.
    Recursive(RecursiveNewton),
    /// Dense LU with pivoting.
    Dense(DenseNewton),
}

impl NewtonSolver {
    /// Workspace of the given method for the steps of `del`.
    pub fn new(method: NewtonMethod, tree: &KinematicTree, del: &DelWorkspace) -> Self {
        match method {
            NewtonMethod::BranchLu => Self::BranchLu(BranchLu::new(tree, del)),
            NewtonMethod::Recursive => Self::Recursive(RecursiveNewton::new(tree, del)),
            NewtonMethod::Dense => Self::Dense(DenseNewton::new(tree, del)),
        }
    }
}

macro_rules! each {
    ($self:ident, $solver:ident => $call:expr) => {
        match $self {
            NewtonSolver::BranchLu($solver) => $call,
            NewtonSolver::Recursive($solver) => $call,
            NewtonSolver::Dense($solver) => $call,
        }
    };
}

impl NewtonDirection for NewtonSolver {
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError> {
        each!(self, solver => solver.factor(tree, del))
    }
    fn solve(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        each!(self, solver => solver.solve(tree, rhs))
    }
    fn solve_transposed(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        each!(self, solver => solver.solve_transposed(tree, rhs))
    }
    fn solve_many(&mut self, tree: &KinematicTree, rhs: &mut RowMatrix) {
        each!(self, solver => solver.solve_many(tree, rhs))
    }
    fn hessian(&self) -> Option<&DelHessian> {
        each!(self, solver => solver.hessian())
    }
}
