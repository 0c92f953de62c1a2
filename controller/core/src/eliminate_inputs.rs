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

use core::ops::Range;

use pulp::{Simd, WithSimd};

use crate::lq_stage::{Layout, LqStage};
use crate::panel::{
    BLOCK, Panel, TILE, Tile, Tiled, accumulate, accumulate_columns, fill, mirror_diagonal_tiles, sqrt,
    zero_tile,
};

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
    /// `P_{k+1}`, lower triangle and tiles of the diagonal; below it the row `p_{k+1}'`.
    pub next: &'a Panel,
    /// `p_{k+1}`.
    pub gradient: &'a [f64],
    /// `P_k` and `p_k'`, to be written; the same of it.
    pub cost_to_go: &'a mut Panel,
    pub factors: &'a mut StageFactors,
}

impl WithSimd for EliminateInputs<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) -> bool {
        let Self { stage, next, .. } = self;
        let (rows, columns) = (0..stage.transition().stride() / S::F64_LANES, 0..next.columns());
        let matrix = Propagated { transition: stage.transition(), next };
        fill(simd, &matrix, &mut self.scratch.propagated, rows, columns, false);
        self.carry_gradient(simd);
        self.input_columns(simd);
        if !self.factorise_inputs(simd) {
            return false;
        }
        self.cost_to_go(simd);
        self.gain(simd);
        true
    }
}

/// `W = [B A d]' P`.
struct Propagated<'a> {
    transition: &'a Panel,
    next: &'a Panel,
}

impl Tiled for Propagated<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let Self { transition, next } = *self;
        let mut tile = zero_tile::<S, R>(simd);
        // P(column + c, l): left of the tile by its rows, from the tile on by symmetry.
        accumulate(simd, &mut tile, (transition, row), (next, column), 0..column);
        accumulate_columns(simd, &mut tile, (transition, row), (next, column), column..next.columns());
        tile
    }
}

/// The columns of `u` of `T' W'`.
struct InputColumns<'a> {
    transition: &'a Panel,
    propagated: &'a Panel,
}

impl Tiled for InputColumns<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let Self { transition, propagated } = *self;
        let mut tile = zero_tile::<S, R>(simd);
        accumulate(simd, &mut tile, (transition, row), (propagated, column), 0..propagated.columns());
        tile
    }
}

/// `J'J - Y'Y + T_x' W_x'`.
struct CostToGo<'a> {
    layout: Layout,
    stage: &'a LqStage,
    propagated: &'a Panel,
    elimination: &'a Panel,
}

impl Tiled for CostToGo<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let Self { layout, stage, propagated, elimination } = *self;
        let first_x = layout.first_state();
        let (below, beyond) = (row + first_x / S::F64_LANES, column + first_x);
        let mut tile = zero_tile::<S, R>(simd);
        accumulate(simd, &mut tile, (elimination, below), (elimination, beyond), 0..layout.inputs);
        for column in &mut tile {
            for sum in column {
                *sum = simd.neg_f64s(*sum);
            }
        }
        let residuals = &stage.cost.residuals;
        let squares = residuals.panel();
        accumulate(simd, &mut tile, (squares, row), (squares, column), 0..residuals.len());
        accumulate(simd, &mut tile, (stage.transition(), below), (propagated, beyond), 0..layout.states);
        tile
    }
}

impl EliminateInputs<'_> {
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
    fn input_columns<S: Simd>(&mut self, simd: S) {
        let Layout { inputs, .. } = self.layout;
        let transition = self.stage.transition();
        let Scratch { propagated, elimination, carried_gradient } = &mut *self.scratch;
        let rows = 0..transition.stride() / S::F64_LANES;
        fill(simd, &InputColumns { transition, propagated }, elimination, rows, 0..inputs, true);
        let (cost, carried) = (&self.stage.cost, carried_gradient.column(0));
        for u in 0..inputs {
            let entries = elimination.column_mut(u);
            entries[u] += cost.input_weight[u];
            entries[self.layout.one()] += cost.input_gradient[u] + carried[u];
        }
    }

    /// `(L; Y')` in place of the columns of `u`: left-looking Cholesky of the panel, a tile of columns at a time.
    #[inline(always)]
    fn factorise_inputs<S: Simd>(&mut self, simd: S) -> bool {
        let Layout { inputs, .. } = self.layout;
        let panel = &mut self.scratch.elimination;
        let (stride, lanes) = (panel.stride(), S::F64_LANES);
        let registers = stride / lanes;
        for block in (0..inputs).step_by(TILE) {
            let end = inputs.min(block + TILE);
            for (row, whole) in tiles(block / lanes, registers, if lanes == BLOCK { 4 } else { 2 }) {
                if !whole {
                    subtract_earlier::<S, 1>(simd, panel, block..end, row);
                } else if lanes == BLOCK {
                    subtract_earlier::<S, 4>(simd, panel, block..end, row);
                } else {
                    subtract_earlier::<S, 2>(simd, panel, block..end, row);
                }
            }
            for j in block..end {
                let first = j / lanes;
                for (row, whole) in tiles(first, registers, 4) {
                    if whole {
                        subtract_columns::<S, 4>(simd, panel, block..j, row);
                    } else {
                        subtract_columns::<S, 1>(simd, panel, block..j, row);
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
        }
        // Above the diagonal the panel holds what the tiles left there; zeros stay in the factor.
        for j in 0..inputs {
            let column = self.factors.input_factor.column_mut(j);
            column[j..].copy_from_slice(&panel.column(j)[j..self.layout.first_state()]);
        }
        true
    }

    /// `P_k = D + J'J - Y'Y + T_x' W_x'`, lower triangle and tiles of the diagonal; below it `p_k'`.
    #[inline(always)]
    fn cost_to_go<S: Simd>(&mut self, simd: S) {
        let Layout { states, .. } = self.layout;
        let Scratch { propagated, elimination, carried_gradient } = &*self.scratch;
        let matrix = CostToGo { layout: self.layout, stage: self.stage, propagated, elimination };
        let rows = 0..self.cost_to_go.stride() / S::F64_LANES;
        fill(simd, &matrix, self.cost_to_go, rows, 0..states, true);
        let (cost, carried) = (&self.stage.cost, carried_gradient.column(0));
        let first_x = self.layout.first_state();
        for x in 0..states {
            let entries = self.cost_to_go.column_mut(x);
            entries[x] += cost.state_weight[x];
            entries[states] += cost.state_gradient[x] + carried[first_x + x];
        }
        let stride = self.cost_to_go.stride();
        mirror_diagonal_tiles(self.cost_to_go.entries_mut(), stride, states);
    }

    /// `K' = -Y' L⁻¹`, from the last tile of columns to the first.
    #[inline(always)]
    fn gain<S: Simd>(&mut self, simd: S) {
        let Layout { inputs, .. } = self.layout;
        let first_x = self.layout.first_state();
        let StageFactors { gain, input_factor } = &mut *self.factors;
        let lanes = S::F64_LANES;
        let registers = gain.stride() / lanes;
        for j in 0..inputs {
            gain.column_mut(j).copy_from_slice(&self.scratch.elimination.column(j)[first_x..]);
        }
        for block in (0..inputs).step_by(TILE).rev() {
            let end = inputs.min(block + TILE);
            for (row, whole) in tiles(0, registers, if lanes == BLOCK { 4 } else { 2 }) {
                if !whole {
                    add_later::<S, 1>(simd, gain, input_factor, block..end, row);
                } else if lanes == BLOCK {
                    add_later::<S, 4>(simd, gain, input_factor, block..end, row);
                } else {
                    add_later::<S, 2>(simd, gain, input_factor, block..end, row);
                }
            }
            for j in (block..end).rev() {
                let factor = input_factor.column(j);
                for (row, whole) in tiles(0, registers, 4) {
                    if whole {
                        eliminate_later::<S, 4>(simd, gain, factor, j..end, row);
                    } else {
                        eliminate_later::<S, 1>(simd, gain, factor, j..end, row);
                    }
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

/// `column_j -= Σ_i column_i L(j, i)`, i before the tile of columns that j is one of, in `R` registers from `row` on.
#[inline(always)]
fn subtract_earlier<S: Simd, const R: usize>(simd: S, panel: &mut Panel, block: Range<usize>, row: usize) {
    let height = panel.stride() / S::F64_LANES;
    let mut tile = zero_tile::<S, R>(simd);
    accumulate(simd, &mut tile, (panel, row), (panel, block.start), 0..block.start);
    let registers = panel.registers_mut::<S>();
    for (j, sums) in block.zip(&tile) {
        let target = &mut registers[j * height + row..][..R];
        for r in 0..R {
            target[r] = simd.sub_f64s(target[r], sums[r]);
        }
    }
}

/// `column_j -= Σ_i column_i L(j, i)`, j the end of the range of i, in `R` registers from `row` on.
#[inline(always)]
fn subtract_columns<S: Simd, const R: usize>(simd: S, panel: &mut Panel, before: Range<usize>, row: usize) {
    let (stride, lanes) = (panel.stride(), S::F64_LANES);
    let (height, j) = (stride / lanes, before.end);
    let mut sums = [simd.splat_f64s(0.0); R];
    {
        let (registers, entries) = (panel.registers::<S>(), panel.entries());
        for i in before {
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

/// `X_j += Σ_i X_i L(i, j)`, i behind the tile of columns that j is one of, in `R` registers from `row` on.
#[inline(always)]
fn add_later<S: Simd, const R: usize>(
    simd: S,
    panel: &mut Panel,
    factor: &Panel,
    block: Range<usize>,
    row: usize,
) {
    let height = panel.stride() / S::F64_LANES;
    let mut tile = zero_tile::<S, R>(simd);
    accumulate_columns(simd, &mut tile, (panel, row), (factor, block.start), block.end..factor.columns());
    let registers = panel.registers_mut::<S>();
    for (j, sums) in block.zip(&tile) {
        let target = &mut registers[j * height + row..][..R];
        for r in 0..R {
            target[r] = simd.add_f64s(target[r], sums[r]);
        }
    }
}

/// `X_j = -(X_j + Σ_i X_i L(i, j)) / L(j, j)`, j the first of the range and i the others, in `R` registers from `row` on.
#[inline(always)]
fn eliminate_later<S: Simd, const R: usize>(
    simd: S,
    panel: &mut Panel,
    factor: &[f64],
    range: Range<usize>,
    row: usize,
) {
    let height = panel.stride() / S::F64_LANES;
    let j = range.start;
    let registers = panel.registers_mut::<S>();
    let mut sums = [simd.splat_f64s(0.0); R];
    sums.copy_from_slice(&registers[j * height + row..][..R]);
    for i in j + 1..range.end {
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
