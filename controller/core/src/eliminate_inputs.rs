//! One stage of the Riccati recursion on column panels: the inputs are eliminated from the stage's quadratic.
//!
//! Letters and equations: [`crate::riccati`]. Rows of the panels are `(u, x, 1)`; the row of 1 carries the linear terms.
//!
//! ```text
//! W = T' P      (L; Y') L' = columns of u of [R 0; 0 Q] + T' W'      P_k = D + J'J - Y'Y + T_x' W_x'      K' = -Y' L⁻¹
//! ```
//!
//! `R` and `D` are diagonal, so they are added where the products have been stored.
//!
//! Cost: 1.4 million operations at 60 states and 30 inputs. No allocation. Source: as [`crate::riccati`].

use pulp::{Simd, WithSimd};

use crate::lq_stage::{Layout, LqStage};
use crate::panel::{BLOCK, Panel, TILE, Tile, accumulate, mirror, sqrt, store, zero_tile};

/// What one stage of the recursion leaves behind, beside `P_k`.
#[derive(Clone, Debug)]
pub(crate) struct StageFactors {
    /// `K_k'`; below it the row `k_k'`.
    pub gain: Panel,
    /// Lower triangular `L_k`, zeros above the diagonal.
    pub input_factor: Panel,
}

/// Panels over the rows of `z̃ = (u, x, 1)`.
#[derive(Debug)]
pub(crate) struct Scratch {
    /// `[B A d]' P`.
    pub propagated: Panel,
    /// Columns of `u` of `M`, then `(L; Y')`.
    pub elimination: Panel,
    /// `[B A d]' p`.
    pub carried_gradient: Panel,
}

impl Scratch {
    pub fn new(layout: Layout) -> Self {
        Self {
            propagated: Panel::zeros(layout.rows(), layout.states),
            elimination: Panel::zeros(layout.rows(), layout.inputs),
            carried_gradient: Panel::zeros(layout.rows(), 1),
        }
    }
}

/// One stage backwards; `false`: `H_k` is not positive definite.
pub(crate) struct EliminateInputs<'a> {
    pub layout: Layout,
    pub stage: &'a LqStage,
    pub scratch: &'a mut Scratch,
    /// `P_{k+1}`, full symmetric; below it the row `p_{k+1}'`.
    pub next: &'a Panel,
    /// `p_{k+1}`.
    pub gradient: &'a [f64],
    /// `P_k` and `p_k'`, to be written.
    pub cost_to_go: &'a mut Panel,
    pub factors: &'a mut StageFactors,
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

    /// `W = [B A d]' P`.
    #[inline(always)]
    fn propagate<S: Simd, const R: usize>(&mut self, simd: S) {
        let (transition, propagated) = (self.stage.transition(), &mut self.scratch.propagated);
        let rows = transition.stride() / S::F64_LANES;
        let (depth, next) = (self.layout.states, self.next);
        for column in (0..depth).step_by(TILE) {
            let columns = TILE.min(depth - column);
            for (row, whole) in tiles(0, rows, R) {
                let operands = ((transition, row), (next, column));
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

    /// `p'[B A d]`.
    #[inline(always)]
    fn carry_gradient<S: Simd>(&mut self, simd: S) {
        let (transition, carried) = (self.stage.transition(), &mut self.scratch.carried_gradient);
        let height = transition.stride() / S::F64_LANES;
        let registers = transition.registers::<S>();
        for (row, whole) in tiles(0, height, 4) {
            if whole {
                times_vector::<S, 4>(simd, registers, height, self.gradient, carried, row);
            } else {
                times_vector::<S, 1>(simd, registers, height, self.gradient, carried, row);
            }
        }
    }

    /// The columns of `u` of `M`, from the diagonal down.
    #[inline(always)]
    fn input_columns<S: Simd, const R: usize>(&mut self, simd: S) {
        let Layout { inputs, states: depth } = self.layout;
        let transition = self.stage.transition();
        let Scratch { propagated, elimination, carried_gradient } = &mut *self.scratch;
        let rows = transition.stride() / S::F64_LANES;
        for column in (0..inputs).step_by(TILE) {
            let columns = TILE.min(inputs - column);
            for (row, whole) in tiles(column / S::F64_LANES, rows, R) {
                let operands = ((transition, row), (&*propagated, column));
                if whole {
                    let tile = product::<S, R>(simd, operands, depth);
                    store::<S, R>(elimination, &tile, row, column, columns);
                } else {
                    let tile = product::<S, 1>(simd, operands, depth);
                    store::<S, 1>(elimination, &tile, row, column, columns);
                }
            }
        }
        let (cost, carried) = (&self.stage.cost, carried_gradient.column(0));
        for u in 0..inputs {
            let entries = elimination.column_mut(u);
            entries[u] += cost.input_weight[u];
            entries[self.layout.one()] += cost.input_gradient[u] + carried[u];
        }
    }

    /// `(L; Y')` in place of the columns of `u`: left-looking Cholesky of the panel.
    #[inline(always)]
    fn factorise_inputs<S: Simd>(&mut self, simd: S) -> bool {
        let panel = &mut self.scratch.elimination;
        let (stride, lanes) = (panel.stride(), S::F64_LANES);
        let registers = stride / lanes;
        for j in 0..self.layout.inputs {
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
        for j in 0..self.layout.inputs {
            let column = self.factors.input_factor.column_mut(j);
            for (row, (entry, from)) in column.iter_mut().zip(panel.column(j)).enumerate() {
                *entry = if row < j { 0.0 } else { *from };
            }
        }
        true
    }

    /// `P_k = D + J'J - Y'Y + T_x' W_x'`, lower triangle, then mirrored; below it `p_k'`.
    #[inline(always)]
    fn cost_to_go<S: Simd, const R: usize>(&mut self, simd: S) {
        let Layout { states, .. } = self.layout;
        let rows = self.cost_to_go.stride() / S::F64_LANES;
        for column in (0..states).step_by(TILE) {
            let columns = TILE.min(states - column);
            for (row, whole) in tiles(column / S::F64_LANES, rows, R) {
                if whole {
                    let tile = self.cost_to_go_tile::<S, R>(simd, row, column);
                    store::<S, R>(self.cost_to_go, &tile, row, column, columns);
                } else {
                    let tile = self.cost_to_go_tile::<S, 1>(simd, row, column);
                    store::<S, 1>(self.cost_to_go, &tile, row, column, columns);
                }
            }
        }
        let (cost, carried) = (&self.stage.cost, self.scratch.carried_gradient.column(0));
        let first_x = self.layout.first_state();
        for x in 0..states {
            let entries = self.cost_to_go.column_mut(x);
            entries[x] += cost.state_weight[x];
            entries[states] += cost.state_gradient[x] + carried[first_x + x];
        }
        let stride = self.cost_to_go.stride();
        mirror(self.cost_to_go.entries_mut(), stride, states);
    }

    #[inline(always)]
    fn cost_to_go_tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let Layout { inputs, states } = self.layout;
        let first_x = self.layout.first_state();
        let shift = first_x / S::F64_LANES;
        let Scratch { propagated, elimination, .. } = &*self.scratch;
        let residuals = &self.stage.cost.residuals;
        let squares = residuals.panel();
        let eliminated = ((elimination, row + shift), (elimination, column + first_x));
        let mut tile = product::<S, R>(simd, eliminated, inputs);
        tile.iter_mut().flatten().for_each(|sum| *sum = simd.neg_f64s(*sum));
        accumulate(simd, &mut tile, (squares, row), (squares, column), residuals.len());
        let carried = ((self.stage.transition(), row + shift), (propagated, column + first_x));
        accumulate(simd, &mut tile, carried.0, carried.1, states);
        tile
    }

    /// `K' = -Y' L⁻¹`, from the last column to the first.
    #[inline(always)]
    fn gain<S: Simd>(&mut self, simd: S) {
        let Layout { inputs, .. } = self.layout;
        let first_x = self.layout.first_state();
        let StageFactors { gain, input_factor } = &mut *self.factors;
        let registers = gain.stride() / S::F64_LANES;
        for j in (0..inputs).rev() {
            let factor = input_factor.column(j);
            let target = gain.column_mut(j);
            target.copy_from_slice(&self.scratch.elimination.column(j)[first_x..]);
            for (row, whole) in tiles(0, registers, 4) {
                if whole {
                    eliminate_later::<S, 4>(simd, gain, factor, (j, inputs), row);
                } else {
                    eliminate_later::<S, 1>(simd, gain, factor, (j, inputs), row);
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
