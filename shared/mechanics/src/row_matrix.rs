//! A row-major matrix whose rows start on SIMD boundaries: many right-hand sides of one factorisation.

use alloc::vec;
use alloc::vec::Vec;

use crate::lanes::{LANES, Quad, WIDE};

/// Row-major dense matrix; rows are padded to a multiple of sixteen doubles (the padding is scratch).
#[derive(Clone, Debug)]
pub struct RowMatrix {
    rows: usize,
    columns: usize,
    stride: usize,
    /// Where the first row starts: on a cache line, so that no register of eight doubles straddles two.
    first: usize,
    data: Vec<Quad>,
}

/// Bytes of a cache line.
const CACHE_LINE: usize = 64;

impl RowMatrix {
    /// A zero matrix.
    pub fn zeros(rows: usize, columns: usize) -> Self {
        let stride = WIDE * columns.div_ceil(WIDE * LANES);
        let data = vec![Quad::ZERO; rows * stride + 1];
        let first = data.as_ptr().align_offset(CACHE_LINE).min(1);
        Self { rows, columns, stride, first, data }
    }

    /// Another shape in the memory of the first one; no allocation unless it grows. All entries become zero.
    pub(crate) fn reshape(&mut self, rows: usize, columns: usize) {
        self.rows = rows;
        self.columns = columns;
        self.stride = WIDE * columns.div_ceil(WIDE * LANES);
        self.data.clear();
        self.data.resize(rows * self.stride + 1, Quad::ZERO);
        self.first = self.data.as_ptr().align_offset(CACHE_LINE).min(1);
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Sets every entry to zero.
    pub fn clear(&mut self) {
        self.data.fill(Quad::ZERO);
    }

    /// Entry `(row, column)`.
    #[inline(always)]
    pub fn get(&self, row: usize, column: usize) -> f64 {
        self.data[self.first + row * self.stride + column / LANES].0[column % LANES]
    }

    /// Sets entry `(row, column)`.
    #[inline(always)]
    pub fn set(&mut self, row: usize, column: usize, value: f64) {
        self.data[self.first + row * self.stride + column / LANES].0[column % LANES] = value;
    }

    /// Adds to entry `(row, column)`.
    #[inline(always)]
    pub fn add(&mut self, row: usize, column: usize, value: f64) {
        self.data[self.first + row * self.stride + column / LANES].0[column % LANES] += value;
    }

    /// Quads per row.
    #[inline(always)]
    pub(crate) fn stride(&self) -> usize {
        self.stride
    }

    /// All rows in pieces of sixteen columns, `stride() / WIDE` per row.
    #[inline(always)]
    pub(crate) fn pieces(&self) -> &[[Quad; WIDE]] {
        self.quads().as_chunks().0
    }

    /// As [`RowMatrix::pieces`].
    #[inline(always)]
    pub(crate) fn pieces_mut(&mut self) -> &mut [[Quad; WIDE]] {
        self.quads_mut().as_chunks_mut().0
    }

    #[inline(always)]
    pub(crate) fn quads(&self) -> &[Quad] {
        &self.data[self.first..]
    }

    #[inline(always)]
    pub(crate) fn quads_mut(&mut self) -> &mut [Quad] {
        &mut self.data[self.first..]
    }

    /// Copies the entries of a row from column `first` on.
    #[inline(always)]
    pub(crate) fn copy_part(&self, row: usize, first: usize, out: &mut [f64]) {
        let quads = &self.quads()[row * self.stride..(row + 1) * self.stride];
        for (k, value) in out.iter_mut().enumerate() {
            *value = quads[(first + k) / LANES].0[(first + k) % LANES];
        }
    }

    /// Copies the entries row by row into a plain slice of `rows * columns`.
    pub fn copy_to(&self, out: &mut [f64]) {
        for (row, target) in out.chunks_exact_mut(self.columns).enumerate() {
            for (column, value) in target.iter_mut().enumerate() {
                *value = self.get(row, column);
            }
        }
    }
}
