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
use pulp::{Arch, Simd, WithSimd};

use crate::errors::ControlError;
use crate::kernels::{gemm, gemv, vector_mut};
use crate::lq_problem::{LqProblem, LqSize, LqStage};
use crate::panel::{BLOCK, Panel, TILE, Tile, accumulate, mirror, padded, sqrt, transpose, zero_tile};

/// What one stage of the recursion leaves behind.
#[derive(Clone, Debug)]
struct StageFactors {
    /// `P_k`, full symmetric; below it the row `p_k'`.
    cost_to_go: Panel,
    /// `K_k'`; below it the row `k_k'`.
    gain: Panel,
    /// Lower triangular `L_k`, zeros above the diagonal.
    input_factor: Panel,
}

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

/// Panels with rows `(u, x, 1)`, `u` and the rest padded to whole blocks.
#[derive(Debug)]
struct Scratch {
    /// `[B A]'`.
    transition: Panel,
    /// `[B A]' P`.
    propagated: Panel,
    /// Columns of `u` of `M`, then `(L; Y')`.
    elimination: Panel,
    /// `Q`, lower triangle.
    state_hessian: Panel,
    /// `[B A]' p`.
    carried_gradient: Panel,
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

impl Scratch {
    /// Brings a stage into panels.
    fn take(&mut self, stage: &LqStage, inputs: usize, states: usize) {
        let first_x = padded(inputs);
        transpose(&stage.transition, 0, inputs, &mut self.transition, 0);
        transpose(&stage.transition, inputs, states, &mut self.transition, first_x);
        let stride = self.transition.stride();
        let entries = self.transition.entries_mut();
        let one = first_x + states;
        for (l, value) in stage.defect.iter().enumerate() {
            entries[l * stride + one] = *value;
        }
        for u in 0..inputs {
            let (from, to) = (stage.hessian.col_as_slice(u), self.elimination.column_mut(u));
            to[u..inputs].copy_from_slice(&from[u..inputs]);
            to[first_x..one].copy_from_slice(&from[inputs..]);
            to[one] = stage.gradient[u];
        }
        for x in 0..states {
            let (from, to) = (stage.hessian.col_as_slice(inputs + x), self.state_hessian.column_mut(x));
            to[x..states].copy_from_slice(&from[inputs + x..]);
            to[states] = stage.gradient[inputs + x];
        }
    }
}

/// One stage backwards; `false`: `H_k` is not positive definite.
struct EliminateInputs<'a> {
    inputs: usize,
    states: usize,
    scratch: &'a mut Scratch,
    next: &'a Panel,
    gradient: &'a [f64],
    factors: &'a mut StageFactors,
}

impl WithSimd for EliminateInputs<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) -> bool {
        // As many sums as the registers hold beside the operands: 32 registers of 512 bits, 16 of 256.
        if S::F64_LANES == BLOCK { self.run::<S, 4>(simd) } else { self.run::<S, 2>(simd) }
    }
}

impl EliminateInputs<'_> {
    #[inline(always)]
    fn run<S: Simd, const R: usize>(&mut self, simd: S) -> bool {
        self.propagate::<S, R>(simd);
        self.carry_gradient(simd);
        self.input_columns::<S, R>(simd);
        if !self.factorise_inputs(simd) {
            return false;
        }
        self.cost_to_go::<S, R>(simd);
        self.gain(simd);
        true
    }

    /// `W = [B A]' P`.
    #[inline(always)]
    fn propagate<S: Simd, const R: usize>(&mut self, simd: S) {
        let Scratch { transition, propagated, .. } = &mut *self.scratch;
        let rows = transition.stride() / S::F64_LANES;
        let (depth, next) = (self.states, self.next);
        for column in (0..self.states).step_by(TILE) {
            let columns = TILE.min(self.states - column);
            for (row, whole) in tiles(0, rows, R) {
                let operands = ((&*transition, row), (next, column));
                if whole {
                    let tile = product::<S, R>(simd, operands, depth);
                    store::<S, R>(propagated, &tile, row, column, columns);
                } else {
                    let tile = product::<S, 1>(simd, operands, depth);
                    store::<S, 1>(propagated, &tile, row, column, columns);
                }
            }
        }
    }

    /// `p'[B A]`, into the row of 1 of `M`.
    #[inline(always)]
    fn carry_gradient<S: Simd>(&mut self, simd: S) {
        let Scratch { transition, elimination, state_hessian, carried_gradient, .. } = &mut *self.scratch;
        let height = transition.stride() / S::F64_LANES;
        let registers = transition.registers::<S>();
        for (row, whole) in tiles(0, height, 4) {
            if whole {
                times_vector::<S, 4>(simd, registers, height, self.gradient, carried_gradient, row);
            } else {
                times_vector::<S, 1>(simd, registers, height, self.gradient, carried_gradient, row);
            }
        }
        let first_x = padded(self.inputs);
        let carried = carried_gradient.column(0);
        for u in 0..self.inputs {
            elimination.column_mut(u)[first_x + self.states] += carried[u];
        }
        for x in 0..self.states {
            state_hessian.column_mut(x)[self.states] += carried[first_x + x];
        }
    }

    /// The columns of `u` of `M`, from the diagonal down.
    #[inline(always)]
    fn input_columns<S: Simd, const R: usize>(&mut self, simd: S) {
        let Scratch { transition, propagated, elimination, .. } = &mut *self.scratch;
        let rows = transition.stride() / S::F64_LANES;
        let depth = self.states;
        for column in (0..self.inputs).step_by(TILE) {
            let columns = TILE.min(self.inputs - column);
            for (row, whole) in tiles(column / S::F64_LANES, rows, R) {
                let operands = ((&*transition, row), (&*propagated, column));
                if whole {
                    let tile = product::<S, R>(simd, operands, depth);
                    add_to::<S, R>(simd, elimination, &tile, row, column, columns);
                } else {
                    let tile = product::<S, 1>(simd, operands, depth);
                    add_to::<S, 1>(simd, elimination, &tile, row, column, columns);
                }
            }
        }
    }

    /// `(L; Y')` in place of the columns of `u`: left-looking Cholesky of the panel.
    #[inline(always)]
    fn factorise_inputs<S: Simd>(&mut self, simd: S) -> bool {
        let panel = &mut self.scratch.elimination;
        let (stride, lanes) = (panel.stride(), S::F64_LANES);
        let registers = stride / lanes;
        for j in 0..self.inputs {
            let first = j / lanes;
            for (row, whole) in tiles(first, registers, 4) {
                if whole {
                    subtract_columns::<S, 4>(simd, panel, j, row);
                } else {
                    subtract_columns::<S, 1>(simd, panel, j, row);
                }
            }
            let pivot = panel.column(j)[j];
            if !(pivot > 0.0 && pivot.is_finite()) {
                return false;
            }
            let inverse = simd.splat_f64s(1.0 / sqrt(pivot));
            for entry in &mut panel.registers_mut::<S>()[j * registers + first..(j + 1) * registers] {
                *entry = simd.mul_f64s(*entry, inverse);
            }
        }
        // Above the diagonal the panel holds what the tiles left there.
        for j in 0..self.inputs {
            let column = self.factors.input_factor.column_mut(j);
            for (row, (entry, from)) in column.iter_mut().zip(panel.column(j)).enumerate() {
                *entry = if row < j { 0.0 } else { *from };
            }
        }
        true
    }

    /// `P_k = Q - Y'Y + T_x' W_x'`, lower triangle, then mirrored.
    #[inline(always)]
    fn cost_to_go<S: Simd, const R: usize>(&mut self, simd: S) {
        let first_x = padded(self.inputs);
        let shift = first_x / S::F64_LANES;
        let Scratch { transition, propagated, elimination, state_hessian, .. } = &*self.scratch;
        let cost_to_go = &mut self.factors.cost_to_go;
        let rows = cost_to_go.stride() / S::F64_LANES;
        let (inputs, states) = (self.inputs, self.states);
        for column in (0..states).step_by(TILE) {
            let columns = TILE.min(states - column);
            for (row, whole) in tiles(column / S::F64_LANES, rows, R) {
                let eliminated = ((elimination, row + shift), (elimination, column + first_x));
                let carried = ((transition, row + shift), (propagated, column + first_x));
                if whole {
                    let mut tile = product::<S, R>(simd, eliminated, inputs);
                    subtract_from::<S, R>(simd, state_hessian, &mut tile, row, column);
                    accumulate(simd, &mut tile, carried.0, carried.1, states);
                    store::<S, R>(cost_to_go, &tile, row, column, columns);
                } else {
                    let mut tile = product::<S, 1>(simd, eliminated, inputs);
                    subtract_from::<S, 1>(simd, state_hessian, &mut tile, row, column);
                    accumulate(simd, &mut tile, carried.0, carried.1, states);
                    store::<S, 1>(cost_to_go, &tile, row, column, columns);
                }
            }
        }
        let stride = cost_to_go.stride();
        mirror(cost_to_go.entries_mut(), stride, states);
    }

    /// `K' = -Y' L⁻¹`, from the last column to the first.
    #[inline(always)]
    fn gain<S: Simd>(&mut self, simd: S) {
        let first_x = padded(self.inputs);
        let StageFactors { gain, input_factor, .. } = &mut *self.factors;
        let registers = gain.stride() / S::F64_LANES;
        for j in (0..self.inputs).rev() {
            let factor = input_factor.column(j);
            let target = gain.column_mut(j);
            target.copy_from_slice(&self.scratch.elimination.column(j)[first_x..]);
            for (row, whole) in tiles(0, registers, 4) {
                if whole {
                    eliminate_later::<S, 4>(simd, gain, factor, (j, self.inputs), row);
                } else {
                    eliminate_later::<S, 1>(simd, gain, factor, (j, self.inputs), row);
                }
            }
        }
    }
}

/// Registers `from..to` in tiles: `(row, true)` for whole ones of `height`, then `(row, false)` for single registers.
#[inline(always)]
fn tiles(from: usize, to: usize, height: usize) -> Tiles {
    Tiles { row: from, to, height }
}

/// See [`tiles`]. An iterator of our own, because all code between the kernels has to be inlined into the function that
/// enables their instructions.
struct Tiles {
    row: usize,
    to: usize,
    height: usize,
}

impl Iterator for Tiles {
    type Item = (usize, bool);

    #[inline(always)]
    fn next(&mut self) -> Option<(usize, bool)> {
        let row = self.row;
        if row >= self.to {
            return None;
        }
        let whole = row + self.height <= self.to;
        self.row += if whole { self.height } else { 1 };
        Some((row, whole))
    }
}

/// A panel and where in it to begin, twice.
type Operands<'a> = ((&'a Panel, usize), (&'a Panel, usize));

#[inline(always)]
fn product<S: Simd, const R: usize>(simd: S, (a, b): Operands<'_>, depth: usize) -> Tile<S, R> {
    let mut tile = zero_tile::<S, R>(simd);
    accumulate(simd, &mut tile, a, b, depth);
    tile
}

/// `out = matrix vector` in `R` registers from `row` on.
#[inline(always)]
fn times_vector<S: Simd, const R: usize>(
    simd: S,
    matrix: &[S::f64s],
    height: usize,
    vector: &[f64],
    out: &mut Panel,
    row: usize,
) {
    let mut sums = [simd.splat_f64s(0.0); R];
    for (l, value) in vector.iter().enumerate() {
        let (factor, column) = (simd.splat_f64s(*value), &matrix[l * height + row..][..R]);
        for r in 0..R {
            sums[r] = simd.mul_add_f64s(column[r], factor, sums[r]);
        }
    }
    out.registers_mut::<S>()[row..row + R].copy_from_slice(&sums);
}

/// Writes the first `columns` columns of a tile.
#[inline(always)]
fn store<S: Simd, const R: usize>(
    panel: &mut Panel,
    tile: &Tile<S, R>,
    row: usize,
    column: usize,
    columns: usize,
) {
    let stride = panel.stride() / S::F64_LANES;
    let registers = panel.registers_mut::<S>();
    for (c, sums) in tile.iter().enumerate().take(columns) {
        registers[(column + c) * stride + row..][..R].copy_from_slice(sums);
    }
}

/// Adds the first `columns` columns of a tile.
#[inline(always)]
fn add_to<S: Simd, const R: usize>(
    simd: S,
    panel: &mut Panel,
    tile: &Tile<S, R>,
    row: usize,
    column: usize,
    columns: usize,
) {
    let stride = panel.stride() / S::F64_LANES;
    let registers = panel.registers_mut::<S>();
    for (c, sums) in tile.iter().enumerate().take(columns) {
        let target = &mut registers[(column + c) * stride + row..][..R];
        for (entry, sum) in target.iter_mut().zip(sums) {
            *entry = simd.add_f64s(*entry, *sum);
        }
    }
}

/// `tile = panel - tile`; columns beyond the panel's end are left as they are.
#[inline(always)]
fn subtract_from<S: Simd, const R: usize>(
    simd: S,
    panel: &Panel,
    tile: &mut Tile<S, R>,
    row: usize,
    column: usize,
) {
    let stride = panel.stride() / S::F64_LANES;
    let registers = panel.registers::<S>();
    for (c, sums) in tile.iter_mut().enumerate() {
        if let Some(source) = registers.get((column + c) * stride + row..).and_then(|rest| rest.get(..R)) {
            for (sum, entry) in sums.iter_mut().zip(source) {
                *sum = simd.sub_f64s(*entry, *sum);
            }
        }
    }
}

/// `column_j -= Σ_{i<j} column_i L(j, i)` in `R` registers from `row` on.
#[inline(always)]
fn subtract_columns<S: Simd, const R: usize>(simd: S, panel: &mut Panel, j: usize, row: usize) {
    let (stride, lanes) = (panel.stride(), S::F64_LANES);
    let height = stride / lanes;
    let mut sums = [simd.splat_f64s(0.0); R];
    {
        let (registers, entries) = (panel.registers::<S>(), panel.entries());
        for i in 0..j {
            let factor = simd.splat_f64s(entries[i * stride + j]);
            let source = &registers[i * height + row..][..R];
            for r in 0..R {
                sums[r] = simd.mul_add_f64s(source[r], factor, sums[r]);
            }
        }
    }
    let target = &mut panel.registers_mut::<S>()[j * height + row..][..R];
    for r in 0..R {
        target[r] = simd.sub_f64s(target[r], sums[r]);
    }
}

/// `X_j = -(X_j + Σ_{j<i<end} X_i L(i, j)) / L(j, j)` in `R` registers from `row` on.
#[inline(always)]
fn eliminate_later<S: Simd, const R: usize>(
    simd: S,
    panel: &mut Panel,
    factor: &[f64],
    (j, end): (usize, usize),
    row: usize,
) {
    let height = panel.stride() / S::F64_LANES;
    let registers = panel.registers_mut::<S>();
    let mut sums = [simd.splat_f64s(0.0); R];
    sums.copy_from_slice(&registers[j * height + row..][..R]);
    for i in j + 1..end {
        let weight = simd.splat_f64s(factor[i]);
        let source = &registers[i * height + row..][..R];
        for r in 0..R {
            sums[r] = simd.mul_add_f64s(source[r], weight, sums[r]);
        }
    }
    let scale = simd.splat_f64s(-1.0 / factor[j]);
    for (target, sum) in registers[j * height + row..][..R].iter_mut().zip(sums) {
        *target = simd.mul_f64s(sum, scale);
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
