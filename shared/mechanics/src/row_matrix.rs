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
    data: Vec<Quad>,
}

impl RowMatrix {
    /// A zero matrix.
    pub fn zeros(rows: usize, columns: usize) -> Self {
        let stride = WIDE * columns.div_ceil(WIDE * LANES);
        Self { rows, columns, stride, data: vec![Quad::ZERO; rows * stride] }
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
        self.data[row * self.stride + column / LANES].0[column % LANES]
    }

    /// Sets entry `(row, column)`.
    #[inline(always)]
    pub fn set(&mut self, row: usize, column: usize, value: f64) {
        self.data[row * self.stride + column / LANES].0[column % LANES] = value;
    }

    /// Adds to entry `(row, column)`.
    #[inline(always)]
    pub fn add(&mut self, row: usize, column: usize, value: f64) {
        self.data[row * self.stride + column / LANES].0[column % LANES] += value;
    }

    /// Quads per row.
    #[inline(always)]
    pub(crate) fn stride(&self) -> usize {
        self.stride
    }

    #[inline(always)]
    pub(crate) fn quads(&self) -> &[Quad] {
        &self.data
    }

    #[inline(always)]
    pub(crate) fn quads_mut(&mut self) -> &mut [Quad] {
        &mut self.data
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
