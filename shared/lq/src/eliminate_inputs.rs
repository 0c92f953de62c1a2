//! One stage of the Riccati recursion on column panels: the inputs are eliminated from the stage's quadratic.
//!
//! Letters and equations: [`crate::riccati`]. Rows of the panels are `(u, x, 1)`; the row of 1 carries the linear terms.
//!
//! ```text
//! W = T' P      (L; Y') L' = columns of u of [R 0; 0 Q] + Z'Z + T' W'      P_k = D + J'J + Z_x'Z_x - Y'Y + T_x' W_x'      K' = -Y' L⁻¹
//! ```
//!
//! `R` and `D` are diagonal, so they are added where the products have been stored.
//!
//! Cost: 1.4 million operations at 60 states and 30 inputs. No allocation. Source: as [`crate::riccati`].

use core::ops::Range;

use pulp::{Simd, WithSimd};

use crate::lq_stage::{Layout, LqStage, Squares};
use crate::panel::{
    BLOCK, Panel, TILE, Tile, Tiled, accumulate, accumulate_columns, fill, load_tile, mirror_diagonal_tiles,
    sqrt, store, zero_tile,
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

/// The columns of `u` of `Z'Z + T' W'`.
struct InputColumns<'a> {
    squares: &'a Squares,
    transition: &'a Panel,
    propagated: &'a Panel,
}

impl Tiled for InputColumns<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let Self { squares, transition, propagated } = *self;
        let mut tile = zero_tile::<S, R>(simd);
        let panel = squares.panel();
        accumulate(simd, &mut tile, (panel, row), (panel, column), 0..squares.len());
        accumulate(simd, &mut tile, (transition, row), (propagated, column), 0..propagated.columns());
        tile
    }
}

/// `J'J + Z_x'Z_x - Y'Y + T_x' W_x'`.
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
        let squares = &stage.cost.squares;
        accumulate(simd, &mut tile, (squares.panel(), below), (squares.panel(), beyond), 0..squares.len());
        accumulate(simd, &mut tile, (stage.transition(), below), (propagated, beyond), 0..layout.states);
        tile
    }
}

impl EliminateInputs<'_> {
    /// `p'[B A d]`.
    #[inline(always)]
    fn carry_gradient<S: Simd>(&mut self, simd: S) {
        let (matrix, out) = (self.stage.transition(), &mut self.scratch.carried_gradient);
        let rows = 0..matrix.stride() / S::F64_LANES;
        in_tiles(simd, rows, &mut TimesVector { matrix, vector: self.gradient, out });
    }

    /// The columns of `u` of `M`, from the diagonal down.
    #[inline(always)]
    fn input_columns<S: Simd>(&mut self, simd: S) {
        let Layout { inputs, .. } = self.layout;
        let transition = self.stage.transition();
        let Scratch { propagated, elimination, carried_gradient } = &mut *self.scratch;
        let rows = 0..transition.stride() / S::F64_LANES;
        let cost = &self.stage.cost;
        let squares = &cost.squares;
        fill(simd, &InputColumns { squares, transition, propagated }, elimination, rows, 0..inputs, true);
        let carried = carried_gradient.column(0);
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
            let block = block..inputs.min(block + TILE);
            let rows = block.start / lanes..registers;
            in_tiles(simd, rows, &mut SubtractEarlier { panel, block: block.clone() });
            for j in block.clone() {
                let first = j / lanes;
                in_tiles(simd, first..registers, &mut SubtractColumns { panel, before: block.start..j });
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

    /// `P_k = D + J'J + Z_x'Z_x - Y'Y + T_x' W_x'`, lower triangle and tiles of the diagonal; below it `p_k'`.
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
        let first = self.layout.first_state() / S::F64_LANES;
        let StageFactors { gain, input_factor } = &mut *self.factors;
        let eliminated = &self.scratch.elimination;
        let rows = 0..gain.stride() / S::F64_LANES;
        for block in (0..inputs).step_by(TILE).rev() {
            let block = block..inputs.min(block + TILE);
            let factor = &diagonal_block(input_factor, &block);
            let mut work = BackSubstitute { gain, input_factor, eliminated, first, block, factor };
            in_tiles(simd, rows.clone(), &mut work);
        }
    }
}

/// Something done to `R` registers of some columns at a time.
trait InTiles {
    /// At `row` (in registers). Implementations must be inlined always.
    fn at<S: Simd, const R: usize>(&mut self, simd: S, row: usize);
}

/// Bands as high as the registers hold sums for; what is left, in pairs and singly.
#[inline(always)]
fn in_tiles<S: Simd>(simd: S, rows: Range<usize>, work: &mut impl InTiles) {
    let wide = S::F64_LANES == BLOCK;
    let mut row = rows.start;
    while row < rows.end {
        match rows.end - row {
            4.. if wide => {
                work.at::<S, 4>(simd, row);
                row += 4;
            }
            2.. => {
                work.at::<S, 2>(simd, row);
                row += 2;
            }
            _ => {
                work.at::<S, 1>(simd, row);
                row += 1;
            }
        }
    }
}

/// `out = matrix vector`.
struct TimesVector<'a> {
    matrix: &'a Panel,
    vector: &'a [f64],
    out: &'a mut Panel,
}

impl InTiles for TimesVector<'_> {
    #[inline(always)]
    fn at<S: Simd, const R: usize>(&mut self, simd: S, row: usize) {
        let height = self.matrix.stride() / S::F64_LANES;
        let registers = self.matrix.registers::<S>();
        let mut sums = [simd.splat_f64s(0.0); R];
        for (l, value) in self.vector.iter().enumerate() {
            let (factor, column) = (simd.splat_f64s(*value), &registers[l * height + row..][..R]);
            for r in 0..R {
                sums[r] = simd.mul_add_e_f64s(column[r], factor, sums[r]);
            }
        }
        self.out.registers_mut::<S>()[row..row + R].copy_from_slice(&sums);
    }
}

/// `column_j -= Σ_i column_i L(j, i)`, j in the tile of columns, i before it.
struct SubtractEarlier<'a> {
    panel: &'a mut Panel,
    block: Range<usize>,
}

impl InTiles for SubtractEarlier<'_> {
    #[inline(always)]
    fn at<S: Simd, const R: usize>(&mut self, simd: S, row: usize) {
        let Self { panel, block } = self;
        let mut tile = zero_tile::<S, R>(simd);
        accumulate(simd, &mut tile, (panel, row), (panel, block.start), 0..block.start);
        let height = panel.stride() / S::F64_LANES;
        let registers = panel.registers_mut::<S>();
        for (j, sums) in block.clone().zip(&tile) {
            let target = &mut registers[j * height + row..][..R];
            for r in 0..R {
                target[r] = simd.sub_f64s(target[r], sums[r]);
            }
        }
    }
}

/// `column_j -= Σ_i column_i L(j, i)`, j the end of the range of i.
struct SubtractColumns<'a> {
    panel: &'a mut Panel,
    before: Range<usize>,
}

impl InTiles for SubtractColumns<'_> {
    #[inline(always)]
    fn at<S: Simd, const R: usize>(&mut self, simd: S, row: usize) {
        let Self { panel, before } = self;
        let (stride, j) = (panel.stride(), before.end);
        let height = stride / S::F64_LANES;
        let mut sums = [simd.splat_f64s(0.0); R];
        {
            let (registers, entries) = (panel.registers::<S>(), panel.entries());
            for i in before.clone() {
                let factor = simd.splat_f64s(entries[i * stride + j]);
                let source = &registers[i * height + row..][..R];
                for r in 0..R {
                    sums[r] = simd.mul_add_e_f64s(source[r], factor, sums[r]);
                }
            }
        }
        let target = &mut panel.registers_mut::<S>()[j * height + row..][..R];
        for r in 0..R {
            target[r] = simd.sub_f64s(target[r], sums[r]);
        }
    }
}

/// Lower triangular, row-major, the diagonal inverted; the identity behind its end.
type DiagonalFactor = [[f64; TILE]; TILE];

/// The block of the diagonal that belongs to a tile of columns.
#[inline(always)]
fn diagonal_block(factor: &Panel, block: &Range<usize>) -> DiagonalFactor {
    let mut diagonal = [[0.0; TILE]; TILE];
    for (c, row) in diagonal.iter_mut().enumerate() {
        row[c] = 1.0;
    }
    for (c, j) in block.clone().enumerate() {
        let column = &factor.column(j)[block.clone()];
        diagonal[c][c] = 1.0 / column[c];
        for (row, entry) in diagonal.iter_mut().zip(column).skip(c + 1) {
            row[c] = *entry;
        }
    }
    diagonal
}

/// `X_j = -(Y_j' + Σ_i X_i L(i, j)) / L(j, j)`, j in the tile of columns, i behind j; the tiles behind have theirs.
struct BackSubstitute<'a> {
    gain: &'a mut Panel,
    input_factor: &'a Panel,
    /// `Y'`, from register `first` of a column on.
    eliminated: &'a Panel,
    first: usize,
    block: Range<usize>,
    factor: &'a DiagonalFactor,
}

impl InTiles for BackSubstitute<'_> {
    #[inline(always)]
    fn at<S: Simd, const R: usize>(&mut self, simd: S, row: usize) {
        let Self { gain, input_factor, eliminated, first, block, factor } = self;
        let mut tile = load_tile::<S, R>(simd, eliminated, block.clone(), *first + row);
        let later = block.end..input_factor.columns();
        accumulate_columns(simd, &mut tile, (gain, row), (input_factor, block.start), later);
        for c in (0..TILE).rev() {
            for k in c + 1..TILE {
                let weight = simd.splat_f64s(factor[k][c]);
                for r in 0..R {
                    tile[c][r] = simd.mul_add_e_f64s(tile[k][r], weight, tile[c][r]);
                }
            }
            let scale = simd.splat_f64s(-factor[c][c]);
            for r in 0..R {
                tile[c][r] = simd.mul_f64s(tile[c][r], scale);
            }
        }
        store(simd, gain, &tile, row, block.start, block.len());
    }
}
