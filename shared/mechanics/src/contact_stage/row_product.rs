//! Products of sparse or small matrices with the rows of many right-hand sides, in lanes.

use alloc::vec::Vec;

use crate::dense_lu::DenseLu;
use crate::lanes::{Kernel, Simd, WIDE, WideLane};
use crate::row_matrix::RowMatrix;

/// A matrix of compressed rows that is filled anew for every stage.
#[derive(Clone, Debug)]
pub(super) struct SparseRows {
    starts: Vec<u32>,
    sources: Vec<u32>,
    factors: Vec<f64>,
}

impl SparseRows {
    /// Room for `rows` rows with `entries` entries in all.
    pub fn new(rows: usize, entries: usize) -> Self {
        let mut starts = Vec::with_capacity(rows + 1);
        starts.push(0);
        Self { starts, sources: Vec::with_capacity(entries), factors: Vec::with_capacity(entries) }
    }

    pub fn clear(&mut self) {
        self.starts.truncate(1);
        self.sources.clear();
        self.factors.clear();
    }

    /// An entry of the row that is being filled.
    #[inline(always)]
    pub fn push(&mut self, source: usize, factor: f64) {
        self.sources.push(source as u32);
        self.factors.push(factor);
    }

    /// Ends the row that is being filled.
    #[inline(always)]
    pub fn end_row(&mut self) {
        self.starts.push(self.sources.len() as u32);
    }

    pub fn rows(&self) -> usize {
        self.starts.len() - 1
    }
}

/// `target[first + row] += Σ factor source[row of the entry]` in the columns that both have.
pub(super) struct AddProduct<'a> {
    pub matrix: &'a SparseRows,
    pub source: &'a RowMatrix,
    pub target: &'a mut RowMatrix,
    pub first: usize,
}

impl Kernel for AddProduct<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { matrix, source, target, first } = self;
        let (from, to) = (source.stride() / WIDE, target.stride() / WIDE);
        let (zero, one) = (WideLane::splat(simd, 0.0), WideLane::splat(simd, 1.0));
        let source = source.pieces();
        let target = target.pieces_mut();
        for at in 0..from.min(to) {
            for row in 0..matrix.rows() {
                let range = matrix.starts[row] as usize..matrix.starts[row + 1] as usize;
                if range.is_empty() {
                    continue;
                }
                let sources = &matrix.sources[range.clone()];
                let factors = &matrix.factors[range];
                let own = &mut target[(first + row) * to + at];
                // Two sums hide the latency of the multiply-add.
                let (mut even, mut odd) = (WideLane::of(simd, own), zero);
                let mut entries = sources.iter().zip(factors);
                while let Some((&r, &factor)) = entries.next() {
                    let piece = WideLane::of(simd, &source[r as usize * from + at]);
                    even = WideLane::splat(simd, factor).mul_add(piece, even);
                    if let Some((&r, &factor)) = entries.next() {
                        let piece = WideLane::of(simd, &source[r as usize * from + at]);
                        odd = WideLane::splat(simd, factor).mul_add(piece, odd);
                    }
                }
                *own = one.mul_add(even, odd).quads();
            }
        }
    }
}

/// `target[first + r] += sign Σ_c block[r][c] source[c]`, `block` dense and row-major, in the columns that both have.
pub(super) struct AddDense<'a> {
    pub block: &'a [f64],
    pub columns: usize,
    pub sign: f64,
    pub source: &'a RowMatrix,
    pub target: &'a mut RowMatrix,
    pub first: usize,
}

impl Kernel for AddDense<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { block, columns, sign, source, target, first } = self;
        if columns == 0 {
            return;
        }
        let (from, to) = (source.stride() / WIDE, target.stride() / WIDE);
        let source = source.pieces();
        let target = target.pieces_mut();
        let sign = WideLane::splat(simd, sign);
        let zero = WideLane::splat(simd, 0.0);
        for at in 0..from.min(to) {
            // Four rows at a time share what is loaded of the source.
            for (four, rows) in block.chunks(4 * columns).enumerate() {
                let mut sums = [zero; 4];
                for c in 0..columns {
                    let piece = WideLane::of(simd, &source[c * from + at]);
                    for (r, row) in rows.chunks_exact(columns).enumerate() {
                        sums[r] = WideLane::splat(simd, row[c]).mul_add(piece, sums[r]);
                    }
                }
                for r in 0..rows.len() / columns {
                    let own = &mut target[(first + 4 * four + r) * to + at];
                    *own = sign.mul_add(sums[r], WideLane::of(simd, own)).quads();
                }
            }
        }
    }
}

/// `rows := A⁻¹ rows` with the factors of a small dense matrix.
pub(super) struct SolveRows<'a> {
    pub lu: &'a DenseLu,
    pub rows: &'a mut RowMatrix,
}

impl Kernel for SolveRows<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { lu, rows } = self;
        let stride = rows.stride() / WIDE;
        let pieces = rows.pieces_mut();
        let n = lu.order();
        let zero = WideLane::splat(simd, 0.0);
        for at in 0..stride {
            for (k, &with) in lu.swaps().iter().enumerate() {
                pieces.swap(k * stride + at, with * stride + at);
            }
            for row in 1..n {
                let mut own = WideLane::of(simd, &pieces[row * stride + at]);
                for c in 0..row {
                    let factor = WideLane::splat(simd, lu.entry(row, c));
                    own = factor.neg_mul_add(WideLane::of(simd, &pieces[c * stride + at]), own);
                }
                pieces[row * stride + at] = own.quads();
            }
            for row in (0..n).rev() {
                let mut own = WideLane::of(simd, &pieces[row * stride + at]);
                for c in row + 1..n {
                    let factor = WideLane::splat(simd, lu.entry(row, c));
                    own = factor.neg_mul_add(WideLane::of(simd, &pieces[c * stride + at]), own);
                }
                let inverse = WideLane::splat(simd, 1.0 / lu.entry(row, row));
                pieces[row * stride + at] = inverse.mul_add(own, zero).quads();
            }
        }
    }
}
