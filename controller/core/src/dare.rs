//! The infinite-horizon Riccati equation by structure-preserving doubling: the terminal cost.
//!
//! `P = Q + A'PA - (S + B'PA)' (R + B'PB)⁻¹ (S + B'PA)`. With `u = v - R⁻¹S x` the cross term disappears; then
//!
//! ```text
//! A_0 = A - B R⁻¹ S      G_0 = B R⁻¹ B'      H_0 = Q - S' R⁻¹ S      W = 1 + G H
//! A⁺ = A W⁻¹ A           G⁺ = G + A W⁻¹ G A'           H⁺ = H + A' H W⁻¹ A           H -> P
//! ```
//!
//! Each doubling stands for twice as many stages as the one before, so `H_j` is the cost of `2^j` stages and converges
//! quadratically. Allocates; used at construction and when the goal posture changes.
//!
//! Source: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, *Structure-preserving algorithms for periodic discrete-time algebraic
//! Riccati equations*, Int. J. Control 77, 2004.

use alloc::vec;

use faer::linalg::solvers::{PartialPivLu, Solve};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, Mat, MatRef, Par};

use crate::errors::ControlError;
use crate::kernels::{CholeskyScratch, factor, gemm, gemm_lower, mirror_lower};

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

/// Infinite-horizon cost and gain for `transition = [B A]` and the lower triangle of `hessian = [R S; S' Q]`, inputs first.
///
/// # Errors
/// [`ControlError::NotPositiveDefinite`] when `R` has no Cholesky factor; [`ControlError::NoStabilisingSolution`] when the
/// doubling does not converge.
pub fn solve_dare(
    transition: MatRef<'_, f64>,
    hessian: MatRef<'_, f64>,
    inputs: usize,
) -> Result<InfiniteHorizon, ControlError> {
    let states = transition.nrows();
    let (b, a) = (transition.subcols(0, inputs), transition.subcols(inputs, states));
    let mut scratch = CholeskyScratch::new(inputs);
    let not_positive = ControlError::NotPositiveDefinite { stage: 0 };

    let mut cost = hessian.to_owned();
    let (mut r, _, mut s, mut h) = cost.as_mut().split_at_mut(inputs, inputs);
    factor(r.as_mut(), &mut scratch).ok_or(not_positive)?;
    // S := L⁻¹S (as its transpose), BL := B L⁻ᵀ.
    solve_lower_triangular_in_place(r.as_ref(), s.as_mut().transpose_mut(), Par::Seq);
    let mut bl = b.to_owned();
    solve_lower_triangular_in_place(r.as_ref(), bl.as_mut().transpose_mut(), Par::Seq);
    gemm_lower(h.as_mut(), Accum::Add, s.as_ref(), s.as_ref().transpose(), -1.0);
    mirror_lower(h.as_mut());
    let mut h = h.to_owned();
    let mut g: Mat<f64> = Mat::zeros(states, states);
    gemm(g.as_mut(), Accum::Replace, bl.as_ref(), bl.as_ref().transpose(), 1.0);
    let mut a_j = a.to_owned();
    gemm(a_j.as_mut(), Accum::Add, bl.as_ref(), s.as_ref().transpose(), -1.0);

    let mut product: Mat<f64> = Mat::zeros(states, states);
    let mut change = f64::INFINITY;
    for doubling in 0..MAX_DOUBLINGS {
        let mut w: Mat<f64> = Mat::identity(states, states);
        gemm(w.as_mut(), Accum::Add, g.as_ref(), h.as_ref(), 1.0);
        let lu: PartialPivLu<f64> = w.partial_piv_lu();
        let wa = lu.solve(&a_j);
        let wg = lu.solve(&g);
        // H⁺ - H = A' H W⁻¹ A
        gemm(product.as_mut(), Accum::Replace, h.as_ref(), wa.as_ref(), 1.0);
        let mut increment: Mat<f64> = Mat::zeros(states, states);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref().transpose(), product.as_ref(), 1.0);
        let size = largest(h.as_ref()).max(f64::MIN_POSITIVE);
        change = largest(increment.as_ref()) / size;
        if !change.is_finite() {
            return Err(ControlError::NoStabilisingSolution { iterations: doubling, change });
        }
        add_symmetric(&mut h, &increment);
        if change <= CONVERGED {
            let solution = finish(transition, hessian, inputs, h, &mut change)?;
            return if change <= RESIDUAL {
                Ok(solution)
            } else {
                Err(ControlError::NoStabilisingSolution { iterations: doubling, change })
            };
        }
        gemm(product.as_mut(), Accum::Replace, wg.as_ref(), a_j.as_ref().transpose(), 1.0);
        gemm(increment.as_mut(), Accum::Replace, a_j.as_ref(), product.as_ref(), 1.0);
        add_symmetric(&mut g, &increment);
        gemm(product.as_mut(), Accum::Replace, a_j.as_ref(), wa.as_ref(), 1.0);
        core::mem::swap(&mut a_j, &mut product);
    }
    Err(ControlError::NoStabilisingSolution { iterations: MAX_DOUBLINGS, change })
}

/// The gain that belongs to `P`, by one stage of the recursion, and by how much that stage changes `P`.
fn finish(
    transition: MatRef<'_, f64>,
    hessian: MatRef<'_, f64>,
    inputs: usize,
    cost_to_go: Mat<f64>,
    change: &mut f64,
) -> Result<InfiniteHorizon, ControlError> {
    let states = transition.nrows();
    let size = crate::lq_problem::LqSize { states, inputs, stages: 1, rows: 0 };
    let mut problem = crate::lq_problem::LqProblem::new(size);
    problem.stages[0].transition.copy_from(transition);
    problem.stages[0].hessian.copy_from(hessian);
    problem.terminal_hessian.copy_from(&cost_to_go);
    let mut riccati = crate::riccati::Riccati::new(size);
    riccati.factorise(&problem)?;
    let difference = riccati.cost_to_go(0) - &cost_to_go;
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
