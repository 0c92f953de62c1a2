//! Dense kernels on faer with the shapes this crate uses: no allocation, one thread.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltRegularization, cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

/// `dst (+)= alpha lhs rhs`.
pub fn gemm(dst: MatMut<'_, f64>, beta: Accum, lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>, alpha: f64) {
    matmul(dst, beta, lhs, rhs, alpha, Par::Seq);
}

/// `out (+)= alpha matrix x`.
pub fn gemv(out: &mut [f64], beta: Accum, matrix: MatRef<'_, f64>, x: &[f64], alpha: f64) {
    let (rows, columns) = (matrix.nrows(), matrix.ncols());
    debug_assert!(out.len() == rows && x.len() == columns);
    matmul(
        MatMut::from_column_major_slice_mut(out, rows, 1),
        beta,
        matrix,
        MatRef::from_column_major_slice(x, columns, 1),
        alpha,
        Par::Seq,
    );
}

/// `a · b`, in four sums so that additions need not wait for each other.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut sums = [0.0; 4];
    for (a, b) in a.iter().zip(b) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Largest magnitude; NaN counts as infinite.
pub fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |m, x| if x.is_nan() { f64::INFINITY } else { m.max(x.abs()) })
}

/// Whether every entry is finite.
pub fn all_finite(values: &[f64]) -> bool {
    values.iter().all(|x| x.is_finite())
}

/// A vector as a matrix with one column.
pub fn vector_mut(values: &mut [f64]) -> MatMut<'_, f64> {
    let rows = values.len();
    MatMut::from_column_major_slice_mut(values, rows, 1)
}

/// Scratch memory of [`factor`].
pub struct CholeskyScratch(MemBuffer);

impl CholeskyScratch {
    /// For matrices up to this size.
    pub fn new(size: usize) -> Self {
        Self(MemBuffer::new(cholesky_in_place_scratch::<f64>(size.max(1), Par::Seq, Default::default())))
    }
}

impl core::fmt::Debug for CholeskyScratch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("CholeskyScratch").finish_non_exhaustive()
    }
}

/// Cholesky factor of the lower triangle in place; `None` when it is not positive definite or not finite.
pub fn factor(mut matrix: MatMut<'_, f64>, scratch: &mut CholeskyScratch) -> Option<()> {
    let stack = MemStack::new(&mut scratch.0);
    cholesky_in_place(matrix.as_mut(), LltRegularization::default(), Par::Seq, stack, Default::default())
        .ok()?;
    let good = |pivot: f64| pivot.is_finite() && pivot > 0.0;
    (0..matrix.nrows()).all(|i| good(matrix[(i, i)])).then_some(())
}
