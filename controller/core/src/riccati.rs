//! The Riccati recursion of the unconstrained problem, and the forward rollout.
//!
//! With `V_k(x) = ½ x' P_k x + p_k' x` the cost-to-go and `z = (u, x)`, one stage backwards is
//!
//! ```text
//! M = [R S; S' Q] + [B A]' P_{k+1} [B A]          m = (r, q) + [B A]' (p_{k+1} + P_{k+1} d)
//! M = [L 0; Y' 1] [1 0; 0 P_k] [L' Y; 0 1]        H = M_uu = L L',  Y = L⁻¹ M_ux,  y = L⁻¹ m_u
//! P_k = M_xx - Y' Y     p_k = m_x - Y' y          K = -L⁻ᵀ Y        k = -L⁻ᵀ y
//! ```
//!
//! the leading part of a block Cholesky factorisation: `P_k` comes out symmetric by construction (one triangle is computed and
//! mirrored). The factors `L` stay for the constrained problem ([`crate::projected_qp`]).
//!
//! All matrices are column panels with rows in registers (file `panel.rs`). With `T' = [B A]'` as a panel (rows `z`), the stage is
//! `W = T' P`, the columns of `u` of `M = [R S; S' Q] + T' W'`, their Cholesky panel `(L; Y')`, and
//! `P_k = Q - Y'Y + T_x' W_x'` in one pass over its lower triangle. The linear terms are one more row of the same panels, the row of
//! a constant state 1: `d'` in `T'`, `(r, q)' + p'[B A]` in `M`; then `p_k` and `k` come out as that row of `P_k` and `K'`.
//!
//! Completing the square, the cost of `u_k = K_k x_k + k_k + v_k` along the dynamics is `V_0(x_0) + const + ½ Σ v_k' H_k v_k`.
//!
//! Cost: O(N (n_u + n_x)³): 1.4 million operations a stage at 60 states and 30 inputs, no allocation after [`Riccati::new`].
//!
//! Source: P. Dyer, S. R. McReynolds, *The Computation and Theory of Optimal Control*, 1970; square-root form of the stage:
//! G. Frison, J. B. Jørgensen, *Efficient implementation of the Riccati recursion*, IEEE CCA 2013.

use alloc::vec;
use alloc::vec::Vec;

use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, Mat, MatRef, Par};
use pulp::Arch;

use crate::eliminate_inputs::{EliminateInputs, Scratch, StageFactors};
use crate::errors::ControlError;
use crate::kernels::{gemm, gemv, vector_mut};
use crate::lq_problem::{LqProblem, LqSize};
use crate::panel::{Panel, padded};

/// Gains, factors and cost-to-go of every stage.
#[derive(Debug)]
pub struct Riccati {
    size: LqSize,
    arch: Arch,
    factors: Vec<StageFactors>,
    /// `P_N`.
    terminal: Panel,
    cost_to_go_gradient: Vec<Vec<f64>>,
    feed_forward: Vec<Vec<f64>>,
    scratch: Scratch,
    stage_gradient: Vec<f64>,
    shifted: Vec<f64>,
}

impl Riccati {
    /// Room for problems of this size.
    pub fn new(size: LqSize) -> Self {
        let LqSize { states, inputs, stages, .. } = size;
        let rows = padded(inputs) + padded(states + 1);
        let factors = StageFactors {
            cost_to_go: Panel::zeros(states + 1, states),
            gain: Panel::zeros(states + 1, inputs),
            input_factor: Panel::zeros(inputs, inputs),
        };
        Self {
            size,
            arch: Arch::new(),
            factors: vec![factors; stages],
            terminal: Panel::zeros(states + 1, states),
            cost_to_go_gradient: vec![vec![0.0; states]; stages + 1],
            feed_forward: vec![vec![0.0; inputs]; stages],
            scratch: Scratch {
                transition: Panel::zeros(rows, states),
                propagated: Panel::zeros(rows, states),
                elimination: Panel::zeros(rows, inputs),
                state_hessian: Panel::zeros(states + 1, states),
                carried_gradient: Panel::zeros(rows, 1),
            },
            stage_gradient: vec![0.0; inputs + states],
            shifted: vec![0.0; states],
        }
    }

    /// Backward sweep over all stages.
    ///
    /// # Errors
    /// [`ControlError::NotPositiveDefinite`] when `H_k` has no Cholesky factor (or holds a NaN).
    pub fn factorise(&mut self, problem: &LqProblem) -> Result<(), ControlError> {
        let LqSize { states, inputs, stages, .. } = self.size;
        for column in 0..states {
            let target = self.terminal.column_mut(column);
            for (row, entry) in target[..states].iter_mut().enumerate() {
                let (low, high) = (row.max(column), row.min(column));
                *entry = problem.terminal_hessian[(low, high)];
            }
        }
        self.cost_to_go_gradient[stages].copy_from_slice(&problem.terminal_gradient);
        for k in (0..stages).rev() {
            let (before, after) = self.factors.split_at_mut(k + 1);
            let next = after.first().map_or(&self.terminal, |stage| &stage.cost_to_go);
            self.scratch.take(&problem.stages[k], inputs, states);
            let gradient = &self.cost_to_go_gradient[k + 1];
            let factors = &mut before[k];
            let stage =
                EliminateInputs { inputs, states, scratch: &mut self.scratch, next, gradient, factors };
            if !self.arch.dispatch(stage) {
                return Err(ControlError::NotPositiveDefinite { stage: k });
            }
            for (x, target) in self.cost_to_go_gradient[k].iter_mut().enumerate() {
                *target = before[k].cost_to_go.column(x)[states];
            }
            for (u, target) in self.feed_forward[k].iter_mut().enumerate() {
                *target = before[k].gain.column(u)[states];
            }
        }
        Ok(())
    }

    /// Backward sweep over the linear terms only, with the factors of the last [`Riccati::factorise`]: for another defect,
    /// gradient or terminal gradient. Cost: O(N n²).
    pub fn update_gradients(&mut self, problem: &LqProblem) {
        let last = self.size.stages;
        self.cost_to_go_gradient[last].copy_from_slice(&problem.terminal_gradient);
        for stage in (0..last).rev() {
            self.gradients(problem, stage);
        }
    }

    fn gradients(&mut self, problem: &LqProblem, k: usize) {
        let inputs = self.size.inputs;
        let stage = &problem.stages[k];
        self.shifted.copy_from_slice(&self.cost_to_go_gradient[k + 1]);
        let next = self.factors.get(k + 1).map_or(&self.terminal, |stage| &stage.cost_to_go);
        gemv(&mut self.shifted, Accum::Add, next.view(self.size.states), &stage.defect, 1.0);
        self.stage_gradient.copy_from_slice(&stage.gradient);
        gemv(&mut self.stage_gradient, Accum::Add, stage.transition.as_ref().transpose(), &self.shifted, 1.0);
        let (m_u, m_x) = self.stage_gradient.split_at(inputs);
        let feed_forward = &mut self.feed_forward[k];
        for (target, value) in feed_forward.iter_mut().zip(m_u) {
            *target = -value;
        }
        self.cost_to_go_gradient[k].copy_from_slice(m_x);
        // p = m_x - Y' y = m_x + K' m_u
        let factors = &self.factors[k];
        gemv(&mut self.cost_to_go_gradient[k], Accum::Add, factors.gain.view(self.size.states), m_u, 1.0);
        let l = factors.input_factor.view(inputs);
        solve_lower_triangular_in_place(l, vector_mut(feed_forward), Par::Seq);
        solve_upper_triangular_in_place(l.transpose(), vector_mut(feed_forward), Par::Seq);
    }

    /// `K_k`, `n_u x n_x`.
    pub fn gain(&self, stage: usize) -> MatRef<'_, f64> {
        self.factors[stage].gain.view(self.size.states).transpose()
    }

    /// `k_k`.
    pub fn feed_forward(&self, stage: usize) -> &[f64] {
        &self.feed_forward[stage]
    }

    /// Lower triangular `L_k` with `L_k L_k' = H_k`; zeros above the diagonal.
    pub fn input_factor(&self, stage: usize) -> MatRef<'_, f64> {
        self.factors[stage].input_factor.view(self.size.inputs)
    }

    /// `P_k`, full symmetric.
    pub fn cost_to_go(&self, stage: usize) -> MatRef<'_, f64> {
        let panel = self.factors.get(stage).map_or(&self.terminal, |stage| &stage.cost_to_go);
        panel.view(self.size.states)
    }

    /// `p_k`.
    pub fn cost_to_go_gradient(&self, stage: usize) -> &[f64] {
        &self.cost_to_go_gradient[stage]
    }

    /// Rolls `u = K x + k + v` out from the first column of `trajectory.x`; `v` may be absent. Cost: O(N n²).
    pub fn rollout(&self, problem: &LqProblem, v: Option<&Mat<f64>>, trajectory: &mut Trajectory) {
        let LqSize { inputs, states, stages, .. } = self.size;
        for k in 0..stages {
            let stage = &problem.stages[k];
            let u = trajectory.u.col_as_slice_mut(k);
            u.copy_from_slice(&self.feed_forward[k]);
            if let Some(v) = v {
                for (target, value) in u.iter_mut().zip(v.col_as_slice(k)) {
                    *target += value;
                }
            }
            gemv(u, Accum::Add, self.gain(k), trajectory.x.col_as_slice(k), 1.0);
            self.advance(stage.transition.as_ref(), &stage.defect, k, trajectory, inputs, states);
        }
    }

    fn advance(
        &self,
        transition: MatRef<'_, f64>,
        defect: &[f64],
        k: usize,
        trajectory: &mut Trajectory,
        inputs: usize,
        states: usize,
    ) {
        let (b, a) = (transition.subcols(0, inputs), transition.subcols(inputs, states));
        let (mut now, mut next) = trajectory.x.as_mut().split_at_col_mut(k + 1);
        let mut next = next.as_mut().subcols_mut(0, 1);
        for (row, value) in defect.iter().enumerate() {
            next[(row, 0)] = *value;
        }
        gemm(next.as_mut(), Accum::Add, a, now.as_mut().subcols_mut(k, 1).as_ref(), 1.0);
        gemm(next, Accum::Add, b, trajectory.u.as_ref().subcols(k, 1), 1.0);
    }
}

/// States at the nodes 0..=N and inputs of the stages 0..N, as columns.
#[derive(Clone, Debug)]
pub struct Trajectory {
    /// `n_x x (N + 1)`.
    pub x: Mat<f64>,
    /// `n_u x N`.
    pub u: Mat<f64>,
}

impl Trajectory {
    /// Zeros.
    pub fn new(size: LqSize) -> Self {
        Self { x: Mat::zeros(size.states, size.stages + 1), u: Mat::zeros(size.inputs, size.stages) }
    }

    /// Whether every entry is finite.
    pub fn is_finite(&self) -> bool {
        let finite = |m: &Mat<f64>| (0..m.ncols()).all(|j| crate::kernels::all_finite(m.col_as_slice(j)));
        finite(&self.x) && finite(&self.u)
    }

    /// Copies another trajectory of the same size.
    pub fn copy_from(&mut self, other: &Self) {
        self.x.copy_from(&other.x);
        self.u.copy_from(&other.u);
    }
}
