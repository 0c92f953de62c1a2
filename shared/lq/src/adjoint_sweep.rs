//! Constraint rows of the horizon as functions of the inputs, by one backward sweep of all of them together, on column panels.
//!
//! Letters and equations: [`crate::projected_qp`]. Every constraint row is a row of the panels here, so that the registers run over
//! constraint rows. With `z̃ = (u, x)` of stage k, `Λ` the adjoints at node k+1, one a row, and `(F, E)` the rows of the stage itself:
//!
//! ```text
//! Z = (Z_u, Z_x) = Λ [B A]      rows of stage k: Z = (F, E)      Λ := Z_x + Z_u K      G_k = Z_u L⁻ᵀ
//! ```
//!
//! Cost: 7000 multiply-adds per stage and row at 60 states and 30 inputs. No allocation after [`AdjointSweep::new`].
//!
//! Source: as [`crate::projected_qp`]; kernels: as `panel.rs`.

use core::ops::Range;

use pulp::{Arch, Simd, WithSimd};

use crate::eliminate_inputs::StageFactors;
use crate::lq_stage::Layout;
use crate::panel::{
    Panel, TILE, Tile, Tiled, accumulate, fill, load_tile, padded, store, transposed_times, zero_tile,
};

/// `G` and what a sweep needs.
#[derive(Debug)]
pub(crate) struct AdjointSweep {
    arch: Arch,
    layout: Layout,
    /// `G`, not scaled: column `k n_u + i` for input i of stage k.
    row_vectors: Panel,
    /// `Λ`.
    adjoint: Panel,
    /// `Z`.
    swept: Panel,
    /// `G G'`, lower triangle.
    gram: Panel,
    /// A vector over the rows.
    multipliers: Panel,
}

impl AdjointSweep {
    /// Room for `capacity` rows over `stages` stages.
    pub fn new(layout: Layout, stages: usize, capacity: usize) -> Self {
        Self {
            arch: Arch::new(),
            layout,
            row_vectors: Panel::zeros(capacity, stages * layout.inputs),
            adjoint: Panel::zeros(capacity, layout.states),
            swept: Panel::zeros(capacity, layout.rows()),
            gram: Panel::zeros(capacity, capacity),
            multipliers: Panel::zeros(capacity, 1),
        }
    }

    /// `Z := Λ [B A]` for `rows`.
    pub fn propagate(&mut self, transition: &Panel, rows: Range<usize>) {
        let Self { layout, adjoint, swept, .. } = self;
        self.arch.dispatch(Propagate { layout: *layout, transition, adjoint, swept, rows });
    }

    /// Sets a row of `Z` to `(F, E)`.
    pub fn set(&mut self, row: usize, by_input: &[f64], by_state: &[f64]) {
        let first_state = self.layout.first_state();
        for (column, entry) in by_input.iter().enumerate() {
            self.swept.column_mut(column)[row] = *entry;
        }
        for (column, entry) in by_state.iter().enumerate() {
            self.swept.column_mut(first_state + column)[row] = *entry;
        }
    }

    /// Sets a row of `Λ` at the last node.
    pub fn set_last(&mut self, row: usize, by_state: &[f64]) {
        for (column, entry) in by_state.iter().enumerate() {
            self.adjoint.column_mut(column)[row] = *entry;
        }
    }

    /// `Λ := Z_x + Z_u K`, `G_k := Z_u L⁻ᵀ` for `rows` of stage `stage`.
    pub fn project(&mut self, factors: &StageFactors, stage: usize, rows: Range<usize>) {
        let Self { layout, adjoint, swept, .. } = self;
        self.arch.dispatch(Project { layout: *layout, factors, adjoint, swept, rows: rows.clone() });
        for input in 0..self.layout.inputs {
            let target = self.row_vectors.column_mut(stage * self.layout.inputs + input);
            target[rows.clone()].copy_from_slice(&self.swept.column(input)[rows.clone()]);
        }
    }

    /// Rows of `G` in which stage `stage` has no part yet, and those that are not used, are zero there.
    pub fn clear(&mut self, stage: usize, rows: Range<usize>) {
        let rows = rows.start..padded(rows.end);
        for input in 0..self.layout.inputs {
            self.row_vectors.column_mut(stage * self.layout.inputs + input)[rows.clone()].fill(0.0);
        }
    }

    /// Computes `G G'` for `rows` and all before; `G` is zero from column `depth` on in one of the two.
    pub fn update_gram(&mut self, rows: Range<usize>, depth: usize) {
        let Self { row_vectors, gram, .. } = self;
        self.arch.dispatch(Gram { row_vectors, gram, rows, depth });
    }

    /// `G G'` of two rows, `row` at least `column`.
    pub fn gram(&self, row: usize, column: usize) -> f64 {
        self.gram.column(column)[row]
    }

    /// `out = G'y`; `y` gives the multipliers of the rows.
    pub fn transposed_times(&mut self, y: impl Iterator<Item = f64>, out: &mut [f64]) {
        let mut count = 0;
        let vector = self.multipliers.column_mut(0);
        for (target, y) in vector.iter_mut().zip(y) {
            *target = y;
            count += 1;
        }
        vector[count..].fill(0.0);
        transposed_times(&self.row_vectors, &vector[..padded(count)], out);
    }

    /// Row `to` becomes row `from`.
    pub fn move_row(&mut self, from: usize, to: usize) {
        for column in 0..self.row_vectors.columns() {
            let entries = self.row_vectors.column_mut(column);
            entries[to] = entries[from];
        }
    }
}

/// The registers in which rows lie.
#[inline(always)]
fn registers<S: Simd>(rows: &Range<usize>) -> Range<usize> {
    rows.start / S::F64_LANES..rows.end.div_ceil(S::F64_LANES)
}

struct Propagate<'a> {
    layout: Layout,
    transition: &'a Panel,
    adjoint: &'a Panel,
    swept: &'a mut Panel,
    rows: Range<usize>,
}

/// `a bᵀ` over the first columns of both.
struct ByTransposed<'a> {
    a: &'a Panel,
    b: &'a Panel,
    depth: usize,
}

impl Tiled for ByTransposed<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let mut tile = zero_tile::<S, R>(simd);
        accumulate(simd, &mut tile, (self.a, row), (self.b, column), 0..self.depth);
        tile
    }
}

impl WithSimd for Propagate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layout, transition, adjoint, swept, rows } = self;
        let product = ByTransposed { a: adjoint, b: transition, depth: layout.states };
        let rows = registers::<S>(&rows);
        fill(simd, &product, swept, rows.clone(), 0..layout.inputs, false);
        fill(simd, &product, swept, rows, layout.first_state()..layout.one(), false);
    }
}

struct Project<'a> {
    layout: Layout,
    factors: &'a StageFactors,
    adjoint: &'a mut Panel,
    swept: &'a mut Panel,
    rows: Range<usize>,
}

/// `Z_x + Z_u K`.
struct FedBack<'a> {
    layout: Layout,
    gain: &'a Panel,
    swept: &'a Panel,
}

impl Tiled for FedBack<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let first = self.layout.first_state() + column;
        let last = self.layout.one().min(first + TILE);
        let mut tile = load_tile::<S, R>(simd, self.swept, first..last, row);
        accumulate(simd, &mut tile, (self.swept, row), (self.gain, column), 0..self.layout.inputs);
        tile
    }
}

impl WithSimd for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layout, factors, adjoint, swept, rows } = self;
        let rows = registers::<S>(&rows);
        let matrix = FedBack { layout, gain: &factors.gain, swept };
        fill(simd, &matrix, adjoint, rows.clone(), 0..layout.states, false);
        for row in rows {
            for block in (0..layout.inputs).step_by(TILE) {
                let block = block..layout.inputs.min(block + TILE);
                divide(simd, swept, &factors.input_factor, block, row);
            }
        }
    }
}

/// A tile of `Z_u L⁻ᵀ` in place, those of the columns before being done.
#[inline(always)]
fn divide<S: Simd>(simd: S, swept: &mut Panel, factor: &Panel, block: Range<usize>, row: usize) {
    let mut earlier = zero_tile::<S, 1>(simd);
    accumulate(simd, &mut earlier, (swept, row), (factor, block.start), 0..block.start);
    let mut tile = load_tile::<S, 1>(simd, swept, block.clone(), row);
    for (c, j) in block.clone().enumerate() {
        let mut sum = simd.sub_f64s(tile[c][0], earlier[c][0]);
        for (k, i) in block.clone().enumerate().take(c) {
            let weight = simd.splat_f64s(factor.column(i)[j]);
            sum = simd.negate_mul_add_e_f64s(tile[k][0], weight, sum);
        }
        tile[c][0] = simd.mul_f64s(sum, simd.splat_f64s(1.0 / factor.column(j)[j]));
    }
    store(simd, swept, &tile, row, block.start, block.len());
}

struct Gram<'a> {
    row_vectors: &'a Panel,
    gram: &'a mut Panel,
    rows: Range<usize>,
    depth: usize,
}

impl WithSimd for Gram<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { row_vectors, gram, rows, depth } = self;
        let product = ByTransposed { a: row_vectors, b: row_vectors, depth };
        fill(simd, &product, gram, registers::<S>(&rows), 0..rows.end, true);
    }
}
