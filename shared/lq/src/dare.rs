//! The infinite-horizon Riccati equation by structure-preserving doubling: the terminal cost.
//!
//! `P = Q + A'PA - A'PB (R + B'PB)⁻¹ B'PA`, with a diagonal `R`:
//!
//! ```text
//! A_0 = A      G_0 = B R⁻¹ B'      H_0 = Q      W = 1 + G H
//! A⁺ = A W⁻¹ A           G⁺ = G + A W⁻¹ G A'           H⁺ = H + A' H W⁻¹ A           H -> P
//! ```
//!
//! Each doubling stands for twice as many stages as the one before, so `H_j` is the cost of `2^j` stages and converges
//! quadratically. Allocates; used at construction and when the goal posture changes.
//!
//! Source: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, *Structure-preserving algorithms for periodic discrete-time algebraic
//! Riccati equations*, Int. J. Control 77, 2004.

use alloc::vec;

use faer::{Accum, Mat, MatRef};

use crate::errors::LqError;
use crate::kernels::{gemm, solve_general};
use crate::lq_problem::{LqProblem, LqSize, LqStage};
use crate::riccati::Riccati;

/// Doublings after which there is no solution to be expected: 2^60 stages.
const MAX_DOUBLINGS: usize = 60;
/// Relative change of `H` below which it has converged: round-off of a few products.
const CONVERGED: f64 = 1e-13;
/// A solution changes less than this, relative to its size, in one more stage; a mode without control does not pass.
const RESIDUAL: f64 = 1e-7;

/// Solution of [`solve_dare`].
#[derive(Clone, Debug)]
pub struct InfiniteHorizon {
    /// `P`, full symmetric.
    pub cost_to_go: Mat<f64>,
    /// `K` of `u = K x`, `n_u x n_x`.
    pub gain: Mat<f64>,
}

/// Infinite-horizon cost and gain for the transition and the quadratic cost of `stage`, repeated for ever.
///
/// # Errors
/// [`LqError::CrossTerms`] for a stage with squares; [`LqError::NotPositiveDefinite`] when a weight of `R` is not positive; [`LqError::NoStabilisingSolution`] when the
/// doubling does not converge.
pub fn solve_dare(stage: &LqStage) -> Result<InfiniteHorizon, LqError> {
    let (a, b) = (stage.a(), stage.b());
    let states = a.nrows();
    let count = stage.cost.squares.len();
    if count > 0 {
        return Err(LqError::CrossTerms { count });
    }
    if !stage.cost.input_weight.iter().all(|weight| *weight > 0.0) {
        return Err(LqError::NotPositiveDefinite { stage: 0 });
    }
    let mut h = stage.cost.state_hessian();
    let scaled: Mat<f64> = Mat::from_fn(states, b.ncols(), |i, j| b[(i, j)] / stage.cost.input_weight[j]);
    let mut g: Mat<f64> = Mat::zeros(states, states);
    gemm(g.as_mut(), Accum::Replace, scaled.as_ref(), b.transpose(), 1.0);
    let mut a_j = a.to_owned();

    let mut product: Mat<f64> = Mat::zeros(states, states);
    let mut change = f64::INFINITY;
    for doubling in 0..MAX_DOUBLINGS {
        let mut w: Mat<f64> = Mat::identity(states, states);
        gemm(w.as_mut(), Accum::Add, g.as_ref(), h.as_ref(), 1.0);
        let [wa, wg] = solve_general(&w, [&a_j, &g]);
        // H⁺ - H = A' H W⁻¹ A
        gemm(product.as_mut(), Accum::Replace, h.as_ref(), wa.as_ref(), 1.0);
        let mut increment: Mat<f64> = Mat::zeros(states, states);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref().transpose(), product.as_ref(), 1.0);
        let size = largest(h.as_ref()).max(f64::MIN_POSITIVE);
        change = largest(increment.as_ref()) / size;
        if !change.is_finite() {
            return Err(LqError::NoStabilisingSolution { iterations: doubling, change });
        }
        add_symmetric(&mut h, &increment);
        if change <= CONVERGED {
            let solution = finish(stage, h, &mut change)?;
            return if change <= RESIDUAL {
                Ok(solution)
            } else {
                Err(LqError::NoStabilisingSolution { iterations: doubling, change })
            };
        }
        gemm(product.as_mut(), Accum::Replace, wg.as_ref(), a_j.as_ref().transpose(), 1.0);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref(), product.as_ref(), 1.0);
        add_symmetric(&mut g, &increment);
        gemm(product.as_mut(), Accum::Replace, a_j.as_ref(), wa.as_ref(), 1.0);
        core::mem::swap(&mut a_j, &mut product);
    }
    Err(LqError::NoStabilisingSolution { iterations: MAX_DOUBLINGS, change })
}

/// The gain that belongs to `P`, by one stage of the recursion, and by how much that stage changes `P`.
fn finish(stage: &LqStage, cost_to_go: Mat<f64>, change: &mut f64) -> Result<InfiniteHorizon, LqError> {
    let (states, inputs) = (stage.a().nrows(), stage.b().ncols());
    let mut problem = LqProblem::new(LqSize { states, inputs, stages: 1, ..LqSize::default() });
    problem.stages[0].clone_from(stage);
    problem.terminal_hessian.copy_from(&cost_to_go);
    let mut riccati = Riccati::new(problem.size());
    riccati.factorise(&problem)?;
    let difference = riccati.cost_to_go() - &cost_to_go;
    *change = largest(difference.as_ref()) / largest(cost_to_go.as_ref()).max(f64::MIN_POSITIVE);
    Ok(InfiniteHorizon { gain: riccati.gain(0).to_owned(), cost_to_go })
}

fn add_symmetric(target: &mut Mat<f64>, increment: &Mat<f64>) {
    for column in 0..target.ncols() {
        for row in column..target.nrows() {
            let value = target[(row, column)] + 0.5 * (increment[(row, column)] + increment[(column, row)]);
            target[(row, column)] = value;
            target[(column, row)] = value;
        }
    }
}

fn largest(matrix: MatRef<'_, f64>) -> f64 {
    let mut column_values = vec![0.0; matrix.nrows()];
    (0..matrix.ncols()).fold(0.0, |m: f64, column| {
        for (row, value) in column_values.iter_mut().enumerate() {
            *value = matrix[(row, column)];
        }
        m.max(crate::kernels::largest(&column_values))
    })
}
