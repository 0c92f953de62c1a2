//! The Riccati recursion of the unconstrained problem, and the forward rollout.
//!
//! With `V_k(x) = ½ x' P_k x + p_k' x` the cost-to-go and `z = (u, x)`, one stage backwards is
//!
//! ```text
//! M = [R 0; 0 Q] + [B A]' P_{k+1} [B A]           m = (r, q) + [B A]' (p_{k+1} + P_{k+1} d)
//! M = [L 0; Y' 1] [1 0; 0 P_k] [L' Y; 0 1]        H = M_uu = L L',  Y = L⁻¹ M_ux,  y = L⁻¹ m_u
//! P_k = M_xx - Y' Y     p_k = m_x - Y' y          K = -L⁻ᵀ Y        k = -L⁻ᵀ y
//! ```
//!
//! the leading part of a block Cholesky factorisation: `P_k` comes out symmetric by construction (one triangle is computed and
//! read). The factors `L` stay for the constrained problem ([`crate::projected_qp`]).
//!
//! All matrices are column panels with rows in registers (file `panel.rs`). With `T' = [B A d]'` as a panel (rows `z̃ = (u, x, 1)`,
//! [`crate::lq_stage`]), the stage is `W = T' P`, the columns of `u` of `M = [R 0; 0 Q] + T' W'`, their Cholesky panel `(L; Y')`,
//! and `P_k = D + J'J - Y'Y + T_x' W_x'` in one pass over its lower triangle. The linear terms are the row of the constant 1:
//! `d'` in `T'`, `r̄` in `J'`, `(r, q)' + p'[B A]` in `M`; then `p_k` and `k` come out as that row of `P_k` and `K'`.
//!
//! Completing the square, the cost of `u_k = K_k x_k + k_k + v_k` along the dynamics is `V_0(x_0) + const + ½ Σ v_k' H_k v_k`.
//!
//! Cost: O(N (n_u + n_x)³): 1.4 million operations a stage at 60 states and 30 inputs, no allocation after [`Riccati::new`].
//!
//! Source: P. Dyer, S. R. McReynolds, *The Computation and Theory of Optimal Control*, 1970; square-root form of the stage:
//! G. Frison, J. B. Jørgensen, *Efficient implementation of the Riccati recursion*, IEEE CCA 2013.

use alloc::vec;
use alloc::vec::Vec;

use faer::{Mat, MatRef};
use pulp::Arch;

use crate::eliminate_inputs::{EliminateInputs, Scratch, StageFactors};
use crate::errors::LqError;
use crate::kernels::dot;
use crate::lq_problem::{LqProblem, LqSize};
use crate::lq_stage::Layout;
use crate::panel::{Panel, mirror_diagonal_tiles};
use crate::trajectory::Trajectory;

/// Gains and factors of every stage, cost-to-go of the first.
#[derive(Debug)]
pub struct Riccati {
    size: LqSize,
    arch: Arch,
    factors: Vec<StageFactors>,
    /// `P_k` and `p_k'` of the stage in hand, and of the next one.
    cost_to_go: Panel,
    next_cost_to_go: Panel,
    /// `p_{k+1}`.
    gradient: Vec<f64>,
    scratch: Scratch,
}

impl Riccati {
    /// Room for problems of this size.
    pub fn new(size: LqSize) -> Self {
        let LqSize { states, inputs, stages, .. } = size;
        let factors = StageFactors {
            gain: Panel::zeros(states + 1, inputs),
            input_factor: Panel::zeros(inputs, inputs),
        };
        Self {
            size,
            arch: Arch::new(),
            factors: vec![factors; stages],
            cost_to_go: Panel::zeros(states + 1, states),
            next_cost_to_go: Panel::zeros(states + 1, states),
            gradient: vec![0.0; states],
            scratch: Scratch::new(Layout { inputs, states }),
        }
    }

    /// Backward sweep over all stages.
    ///
    /// # Errors
    /// [`LqError::NotPositiveDefinite`] when `H_k` has no Cholesky factor (or holds a NaN).
    pub fn factorise(&mut self, problem: &LqProblem) -> Result<(), LqError> {
        let LqSize { states, inputs, stages, .. } = self.size;
        for column in 0..states {
            let target = self.cost_to_go.column_mut(column);
            target[column..states].copy_from_slice(&problem.terminal_hessian.col_as_slice(column)[column..]);
            target[states] = problem.terminal_gradient[column];
        }
        let stride = self.cost_to_go.stride();
        mirror_diagonal_tiles(self.cost_to_go.entries_mut(), stride, states);
        for k in (0..stages).rev() {
            core::mem::swap(&mut self.cost_to_go, &mut self.next_cost_to_go);
            for (x, target) in self.gradient.iter_mut().enumerate() {
                *target = self.next_cost_to_go.column(x)[states];
            }
            let stage = EliminateInputs {
                layout: Layout { inputs, states },
                stage: &problem.stages[k],
                scratch: &mut self.scratch,
                next: &self.next_cost_to_go,
                gradient: &self.gradient,
                cost_to_go: &mut self.cost_to_go,
                factors: &mut self.factors[k],
            };
            if !self.arch.dispatch(stage) {
                return Err(LqError::NotPositiveDefinite { stage: k });
            }
        }
        Ok(())
    }

    pub(crate) fn factors(&self, stage: usize) -> &StageFactors {
        &self.factors[stage]
    }

    /// `K_k`, `n_u x n_x`.
    pub fn gain(&self, stage: usize) -> MatRef<'_, f64> {
        self.factors[stage].gain.view(self.size.states).transpose()
    }

    /// Lower triangular `L_k` with `L_k L_k' = H_k`; zeros above the diagonal.
    pub fn input_factor(&self, stage: usize) -> MatRef<'_, f64> {
        self.factors[stage].input_factor.view(self.size.inputs)
    }

    /// `v := L_k⁻ᵀ v`.
    pub fn solve_input_factor_transposed(&self, stage: usize, v: &mut [f64]) {
        let factor = &self.factors[stage].input_factor;
        for j in (0..self.size.inputs).rev() {
            let column = &factor.column(j)[..self.size.inputs];
            v[j] = (v[j] - dot(&column[j + 1..], &v[j + 1..])) / column[j];
        }
    }

    /// `P_0`, full symmetric. Allocates.
    pub fn cost_to_go(&self) -> Mat<f64> {
        let (states, lower) = (self.size.states, self.cost_to_go.view(self.size.states));
        Mat::from_fn(states, states, |i, j| lower[(i.max(j), i.min(j))])
    }

    /// Entry of `p_0`.
    pub fn cost_to_go_gradient(&self, state: usize) -> f64 {
        self.cost_to_go.column(state)[self.size.states]
    }

    /// Rolls `u = K x + k + v` out from the first node of `trajectory`; `v`, one column per stage, may be absent. Cost: O(N n²).
    pub fn rollout(&self, problem: &LqProblem, v: Option<&faer::Mat<f64>>, trajectory: &mut Trajectory) {
        for (k, stage) in problem.stages.iter().enumerate() {
            trajectory.feed_back(k, &self.factors[k].gain);
            if let Some(v) = v {
                trajectory.u_mut(k).iter_mut().zip(v.col_as_slice(k)).for_each(|(u, v)| *u += v);
            }
            trajectory.advance(k, stage.transition());
        }
    }
}
