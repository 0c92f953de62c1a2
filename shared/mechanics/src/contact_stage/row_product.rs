//! Products of sparse or small matrices with the rows of many right-hand sides, in lanes.

use alloc::vec::Vec;

use crate::dense_lu::DenseLu;
use crate::lanes::{Kernel, Quad, Simd, WIDE, WideLane};
use crate::row_matrix::RowMatrix;

/// A matrix of compressed rows whose factors change from stage to stage, its places with the set of contacts at most.
#[derive(Clone, Debug)]
pub(super) struct SparseRows {
    starts: Vec<u32>,
    sources: Vec<u32>,
    factors: Vec<f64>,
    /// Entries filled.
    filled: usize,
    /// First rows of groups of up to [`GROUP`] rows that take from the same sources: what they load is loaded once.
    groups: Vec<u32>,
}

/// Rows that a kernel fills at a time.
const GROUP: usize = 4;

impl SparseRows {
    /// Room for `rows` rows with `entries` entries in all.
    pub fn new(rows: usize, entries: usize) -> Self {
        let mut starts = Vec::with_capacity(rows + 1);
        starts.push(0);
        Self {
            starts,
            sources: Vec::with_capacity(entries),
            factors: Vec::with_capacity(entries),
            filled: 0,
            groups: Vec::with_capacity(rows),
        }
    }

    pub fn clear(&mut self) {
        self.starts.truncate(1);
        self.sources.clear();
        self.factors.clear();
        self.groups.clear();
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
        let row = self.starts.len() - 1;
        self.starts.push(self.sources.len() as u32);
        let joins = self.groups.last().is_some_and(|&first| {
            let first = first as usize;
            row - first < GROUP && self.sources_of(first) == self.sources_of(row)
        });
        if !joins {
            self.groups.push(row as u32);
        }
    }

    #[inline(always)]
    fn sources_of(&self, row: usize) -> &[u32] {
        &self.sources[self.starts[row] as usize..self.starts[row + 1] as usize]
    }

    /// Begins to fill in new factors of the entries that are there, by [`SparseRows::refill`] in the order of the pushes.
    pub fn rewind(&mut self) {
        self.filled = 0;
    }

    #[inline(always)]
    pub fn refill(&mut self, factor: f64) {
        if let Some(target) = self.factors.get_mut(self.filled) {
            *target = factor;
        }
        self.filled += 1;
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
    fn run<S: Simd>(mut self, simd: S) {
        let pieces = self.source.stride().min(self.target.stride()) / WIDE;
        let mut at = 0;
        while S::WIDES == 2 && at + 2 <= pieces {
            add_product_at::<S, 2>(simd, &mut self, at);
            at += 2;
        }
        for at in at..pieces {
            add_product_at::<S, 1>(simd, &mut self, at);
        }
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
fn add_product_at<S: Simd, const W: usize>(simd: S, work: &mut AddProduct<'_>, at: usize) {
    let rows = work.matrix.starts.len() - 1;
    let groups = &work.matrix.groups;
    for (k, &first) in groups.iter().enumerate() {
        let first = first as usize;
        let end = groups.get(k + 1).map_or(rows, |&next| next as usize);
        match end - first {
            4 => add_group_at::<S, W, 4>(simd, work, first, at),
            3 => add_group_at::<S, W, 3>(simd, work, first, at),
            2 => add_group_at::<S, W, 2>(simd, work, first, at),
            _ => add_group_at::<S, W, 1>(simd, work, first, at),
        }
    }
}

/// `R` rows from `row` on, which take from the same sources.
#[inline(always)]
fn add_group_at<S: Simd, const W: usize, const R: usize>(
    simd: S,
    work: &mut AddProduct<'_>,
    row: usize,
    at: usize,
) {
    let AddProduct { matrix, source, target, first } = work;
    let (from, to) = (source.stride() / WIDE, target.stride() / WIDE);
    let source = source.pieces();
    let target = target.pieces_mut();
    let sources = matrix.sources_of(row);
    let count = sources.len();
    if count == 0 {
        return;
    }
    let factors = &matrix.factors[matrix.starts[row] as usize..][..R * count];
    let one = WideLane::splat(simd, 1.0);
    let mut sums = [[WideLane::splat(simd, 0.0); W]; R];
    for (entry, &r) in sources.iter().enumerate() {
        let pieces = &source[r as usize * from + at..][..W];
        let mut x = [one; W];
        for w in 0..W {
            x[w] = WideLane::of(simd, &pieces[w]);
        }
        for k in 0..R {
            let factor = WideLane::splat(simd, factors[k * count + entry]);
            for w in 0..W {
                sums[k][w] = factor.mul_add(x[w], sums[k][w]);
            }
        }
    }
    for k in 0..R {
        let own = &mut target[(*first + row + k) * to + at..][..W];
        for w in 0..W {
            own[w] = one.mul_add(sums[k][w], WideLane::of(simd, &own[w])).quads();
        }
    }
}

/// `sums += factor source[first..]`.
#[inline(always)]
fn add_scaled<S: Simd, const W: usize>(
    simd: S,
    sums: &mut [WideLane<S>; W],
    factor: f64,
    source: &[[Quad; WIDE]],
    first: usize,
) {
    let row = &source[first..][..W];
    let factor = WideLane::splat(simd, factor);
    for w in 0..W {
        sums[w] = factor.mul_add(WideLane::of(simd, &row[w]), sums[w]);
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
    fn run<S: Simd>(mut self, simd: S) {
        if self.columns == 0 {
            return;
        }
        let pieces = self.source.stride().min(self.target.stride()) / WIDE;
        let mut at = 0;
        while S::WIDES == 2 && at + 2 <= pieces {
            add_dense_at::<S, 2>(simd, &mut self, at);
            at += 2;
        }
        for at in at..pieces {
            add_dense_at::<S, 1>(simd, &mut self, at);
        }
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
fn add_dense_at<S: Simd, const W: usize>(simd: S, work: &mut AddDense<'_>, at: usize) {
    let (from, to) = (work.source.stride() / WIDE, work.target.stride() / WIDE);
    let columns = work.columns;
    let source = work.source.pieces();
    let target = work.target.pieces_mut();
    let sign = WideLane::splat(simd, work.sign);
    // Four rows at a time share what is loaded of the source.
    let (fours, rest) = (work.block.chunks_exact(4 * columns), work.block.len() / columns % 4);
    let mut row = work.first;
    for rows in fours {
        let mut sums = [[WideLane::splat(simd, 0.0); W]; 4];
        for c in 0..columns {
            for r in 0..4 {
                add_scaled(simd, &mut sums[r], rows[r * columns + c], source, c * from + at);
            }
        }
        for r in 0..4 {
            for w in 0..W {
                let own = &mut target[(row + r) * to + at + w];
                *own = sign.mul_add(sums[r][w], WideLane::of(simd, own)).quads();
            }
        }
        row += 4;
    }
    for rows in work.block[work.block.len() - rest * columns..].chunks_exact(columns) {
        let mut sums = [WideLane::splat(simd, 0.0); W];
        for (c, &factor) in rows.iter().enumerate() {
            add_scaled(simd, &mut sums, factor, source, c * from + at);
        }
        for w in 0..W {
            let own = &mut target[row * to + at + w];
            *own = sign.mul_add(sums[w], WideLane::of(simd, own)).quads();
        }
        row += 1;
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
    fn run<S: Simd>(mut self, simd: S) {
        let pieces = self.rows.stride() / WIDE;
        let mut at = 0;
        while S::WIDES == 2 && at + 2 <= pieces {
            solve_rows_at::<S, 2>(simd, &mut self, at);
            at += 2;
        }
        for at in at..pieces {
            solve_rows_at::<S, 1>(simd, &mut self, at);
        }
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
fn solve_rows_at<S: Simd, const W: usize>(simd: S, work: &mut SolveRows<'_>, at: usize) {
    let stride = work.rows.stride() / WIDE;
    let pieces = work.rows.pieces_mut();
    let lu = work.lu;
    let n = lu.order();
    let zero = WideLane::splat(simd, 0.0);
    for (k, &with) in lu.swaps().iter().enumerate() {
        for w in 0..W {
            pieces.swap(k * stride + at + w, with * stride + at + w);
        }
    }
    for row in 1..n {
        let mut sums = [zero; W];
        for (c, &factor) in lu.row(row)[..row].iter().enumerate() {
            add_scaled(simd, &mut sums, factor, pieces, c * stride + at);
        }
        let one = WideLane::splat(simd, 1.0);
        for w in 0..W {
            let own = &mut pieces[row * stride + at + w];
            *own = one.neg_mul_add(sums[w], WideLane::of(simd, own)).quads();
        }
    }
    for row in (0..n).rev() {
        let mut sums = [zero; W];
        let factors = lu.row(row);
        for (c, &factor) in factors.iter().enumerate().skip(row + 1) {
            add_scaled(simd, &mut sums, factor, pieces, c * stride + at);
        }
        let inverse = 1.0 / factors[row];
        let (inverse, less) = (WideLane::splat(simd, inverse), WideLane::splat(simd, -inverse));
        for w in 0..W {
            let own = &mut pieces[row * stride + at + w];
            *own = inverse.mul_add(WideLane::of(simd, own), less.mul_add(sums[w], zero)).quads();
        }
    }
}
