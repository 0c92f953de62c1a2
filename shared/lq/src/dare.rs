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
//! Efforts, masses and weights of a robot lie decades apart, and with them the entries of `G` and `H`. So the states are scaled first,
//! `x = D x̂` with `d_i = (G_ii / H_ii)^¼`: then `Ĥ = D H D` and `Ĝ = D⁻¹ G D⁻¹` have the same diagonal. Convergence is judged by every
//! state's own cost: `H⁺ - H` is positive semidefinite, so no entry changes by more than its diagonal ones.
//!
//! Source: D. L. Kleinman, IEEE Trans. Automatic Control 13, 1968, for the refinement of what round-off leaves; E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, *Structure-preserving algorithms for periodic discrete-time algebraic
//! Riccati equations*, Int. J. Control 77, 2004.

use alloc::vec;
use alloc::vec::Vec;

use faer::{Accum, Mat, MatRef};

use crate::errors::LqError;
use crate::kernels::{gemm, solve_general};
use crate::lq_problem::{LqProblem, LqSize, LqStage};
use crate::riccati::Riccati;

/// Doublings after which there is no solution to be expected: 2^60 stages.
const MAX_DOUBLINGS: usize = 60;
/// Relative change of `H` below which it has converged: round-off of a few products.
const CONVERGED: f64 = 1e-13;
/// Newton steps after the doublings; each squares the error.
const MAX_REFINEMENTS: usize = 6;
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
    let cost = stage.cost.state_hessian();
    let scaled: Mat<f64> = Mat::from_fn(states, b.ncols(), |i, j| b[(i, j)] / stage.cost.input_weight[j]);
    let mut g: Mat<f64> = Mat::zeros(states, states);
    gemm(g.as_mut(), Accum::Replace, scaled.as_ref(), b.transpose(), 1.0);
    let scale: Vec<f64> = (0..states).map(|i| balance(g[(i, i)], cost[(i, i)])).collect();
    let mut h: Mat<f64> = Mat::from_fn(states, states, |i, j| scale[i] * cost[(i, j)] * scale[j]);
    let mut g: Mat<f64> = Mat::from_fn(states, states, |i, j| g[(i, j)] / (scale[i] * scale[j]));
    let mut a_j: Mat<f64> = Mat::from_fn(states, states, |i, j| a[(i, j)] * scale[j] / scale[i]);

    let mut product: Mat<f64> = Mat::zeros(states, states);
    let (mut change, mut state) = (f64::INFINITY, 0);
    for doubling in 0..MAX_DOUBLINGS {
        let mut w: Mat<f64> = Mat::identity(states, states);
        gemm(w.as_mut(), Accum::Add, g.as_ref(), h.as_ref(), 1.0);
        let [wa, wg] = solve_general(&w, [&a_j, &g]);
        // H⁺ - H = A' H W⁻¹ A
        gemm(product.as_mut(), Accum::Replace, h.as_ref(), wa.as_ref(), 1.0);
        let mut increment: Mat<f64> = Mat::zeros(states, states);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref().transpose(), product.as_ref(), 1.0);
        (change, state) = most_changed(&h, &increment);
        if !change.is_finite() {
            return Err(LqError::NoStabilisingSolution { iterations: doubling, change, state });
        }
        add_symmetric(&mut h, &increment);
        if change <= CONVERGED {
            let unscaled = Mat::from_fn(states, states, |i, j| h[(i, j)] / (scale[i] * scale[j]));
            let mut solution = finish(stage, unscaled, &mut change)?;
            for _ in 0..MAX_REFINEMENTS {
                if change <= RESIDUAL {
                    break;
                }
                let Some(better) = cost_of(stage, &solution.gain) else { break };
                solution = finish(stage, better, &mut change)?;
            }
            return if change <= RESIDUAL {
                Ok(solution)
            } else {
                Err(LqError::NoStabilisingSolution { iterations: doubling, change, state })
            };
        }
        gemm(product.as_mut(), Accum::Replace, wg.as_ref(), a_j.as_ref().transpose(), 1.0);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref(), product.as_ref(), 1.0);
        add_symmetric(&mut g, &increment);
        gemm(product.as_mut(), Accum::Replace, a_j.as_ref(), wa.as_ref(), 1.0);
        core::mem::swap(&mut a_j, &mut product);
    }
    Err(LqError::NoStabilisingSolution { iterations: MAX_DOUBLINGS, change, state })
}

/// `d` of one state, a power of two, so that scaling rounds nothing.
fn balance(g: f64, h: f64) -> f64 {
    let ratio = match (g > 0.0, h > 0.0) {
        (true, true) => g / h,
        (true, false) => g,
        (false, true) => 1.0 / h,
        (false, false) => 1.0,
    };
    libm::scalbn(1.0, (libm::ilogb(ratio) + 2).div_euclid(4))
}

/// The largest relative change of a state's own cost, and which state's.
fn most_changed(h: &Mat<f64>, increment: &Mat<f64>) -> (f64, usize) {
    let largest = (0..h.nrows()).map(|i| h[(i, i)]).fold(f64::MIN_POSITIVE, f64::max);
    (0..h.nrows()).fold((0.0, 0), |(most, state), i| {
        // A state that costs nothing yet counts by those that do.
        let size = if h[(i, i)] > 1e-14 * largest { h[(i, i)] } else { largest };
        let change = increment[(i, i)].abs() / size;
        if change > most || change.is_nan() { (change, i) } else { (most, state) }
    })
}

/// Cost for ever of the law `u = K x`, `P = M + (A + BK)' P (A + BK)` with `M = Q + K'RK`, by doubling (Smith's method): one step of Newton's
/// method on the Riccati equation (Kleinman), which corrects what the doublings above lost to round-off. `None` when the law does not stabilise.
fn cost_of(stage: &LqStage, gain: &Mat<f64>) -> Option<Mat<f64>> {
    let states = stage.a().nrows();
    let mut closed = stage.a().to_owned();
    gemm(closed.as_mut(), Accum::Add, stage.b(), gain.as_ref(), 1.0);
    let weighted = Mat::from_fn(gain.nrows(), states, |i, j| stage.cost.input_weight[i] * gain[(i, j)]);
    let mut cost = stage.cost.state_hessian();
    let mut product: Mat<f64> = Mat::zeros(states, states);
    gemm(product.as_mut(), Accum::Replace, gain.as_ref().transpose(), weighted.as_ref(), 1.0);
    add_symmetric(&mut cost, &product);
    for _ in 0..MAX_DOUBLINGS {
        let mut increment: Mat<f64> = Mat::zeros(states, states);
        gemm(product.as_mut(), Accum::Replace, cost.as_ref(), closed.as_ref(), 1.0);
        gemm(increment.as_mut(), Accum::Replace, closed.as_ref().transpose(), product.as_ref(), 1.0);
        let (change, _) = most_changed(&cost, &increment);
        if !change.is_finite() {
            return None;
        }
        add_symmetric(&mut cost, &increment);
        if change <= CONVERGED {
            return Some(cost);
        }
        gemm(product.as_mut(), Accum::Replace, closed.as_ref(), closed.as_ref(), 1.0);
        core::mem::swap(&mut closed, &mut product);
    }
    None
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
