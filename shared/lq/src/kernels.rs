//! Dense kernels on faer with the shapes this crate uses: no allocation, one thread. With the feature `compact` plain loops instead: for a
//! microcontroller a tenth of the code, and as fast for its sizes.

#[cfg(not(feature = "compact"))]
use faer::Par;
#[cfg(not(feature = "compact"))]
use faer::dyn_stack::{MemBuffer, MemStack};
#[cfg(not(feature = "compact"))]
use faer::linalg::cholesky::llt::factor::{LltRegularization, cholesky_in_place, cholesky_in_place_scratch};
#[cfg(not(feature = "compact"))]
use faer::linalg::solvers::Solve;
#[cfg(not(feature = "compact"))]
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, Mat, MatMut, MatRef};

/// `dst (+)= alpha lhs rhs`.
#[cfg(not(feature = "compact"))]
pub fn gemm(dst: MatMut<'_, f64>, beta: Accum, lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>, alpha: f64) {
    faer::linalg::matmul::matmul(dst, beta, lhs, rhs, alpha, Par::Seq);
}

/// `dst (+)= alpha lhs rhs`, entry by entry.
#[cfg(feature = "compact")]
pub fn gemm(mut dst: MatMut<'_, f64>, beta: Accum, lhs: MatRef<'_, f64>, rhs: MatRef<'_, f64>, alpha: f64) {
    let keeps = matches!(beta, Accum::Add);
    for column in 0..dst.ncols() {
        for row in 0..dst.nrows() {
            let sum = (0..lhs.ncols()).fold(0.0, |sum, k| sum + lhs[(row, k)] * rhs[(k, column)]);
            dst[(row, column)] = alpha * sum + if keeps { dst[(row, column)] } else { 0.0 };
        }
    }
}

/// `out (+)= alpha matrix x`.
pub fn gemv(out: &mut [f64], beta: Accum, matrix: MatRef<'_, f64>, x: &[f64], alpha: f64) {
    let (rows, columns) = (matrix.nrows(), matrix.ncols());
    debug_assert!(out.len() == rows && x.len() == columns);
    let dst = MatMut::from_column_major_slice_mut(out, rows, 1);
    gemm(dst, beta, matrix, MatRef::from_column_major_slice(x, columns, 1), alpha);
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
#[cfg(not(feature = "compact"))]
pub struct CholeskyScratch(MemBuffer);

/// Scratch memory of [`factor`]: none.
#[cfg(feature = "compact")]
pub struct CholeskyScratch;

impl CholeskyScratch {
    /// For matrices up to this size.
    #[cfg(not(feature = "compact"))]
    pub fn new(size: usize) -> Self {
        Self(MemBuffer::new(cholesky_in_place_scratch::<f64>(size.max(1), Par::Seq, Default::default())))
    }

    /// For matrices up to this size.
    #[cfg(feature = "compact")]
    pub fn new(_: usize) -> Self {
        Self
    }
}

impl core::fmt::Debug for CholeskyScratch {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("CholeskyScratch").finish_non_exhaustive()
    }
}

/// Cholesky factor of the lower triangle in place; `None` when it is not positive definite or not finite.
#[cfg(not(feature = "compact"))]
pub fn factor(mut matrix: MatMut<'_, f64>, scratch: &mut CholeskyScratch) -> Option<()> {
    let stack = MemStack::new(&mut scratch.0);
    cholesky_in_place(matrix.as_mut(), LltRegularization::default(), Par::Seq, stack, Default::default())
        .ok()?;
    let good = |pivot: f64| pivot.is_finite() && pivot > 0.0;
    (0..matrix.nrows()).all(|i| good(matrix[(i, i)])).then_some(())
}

/// Cholesky factor of the lower triangle in place; `None` when it is not positive definite or not finite. O(n³/3), column by column
/// (G. Golub, C. Van Loan, *Matrix Computations*, algorithm 4.2.1).
#[cfg(feature = "compact")]
pub fn factor(mut matrix: MatMut<'_, f64>, _: &mut CholeskyScratch) -> Option<()> {
    for j in 0..matrix.nrows() {
        for i in j..matrix.nrows() {
            let product = (0..j).fold(0.0, |sum, k| sum + matrix[(i, k)] * matrix[(j, k)]);
            matrix[(i, j)] -= product;
        }
        let pivot = matrix[(j, j)];
        if !(pivot.is_finite() && pivot > 0.0) {
            return None;
        }
        let scale = 1.0 / libm::sqrt(pivot);
        for i in j..matrix.nrows() {
            matrix[(i, j)] *= scale;
        }
    }
    Some(())
}

/// `right := (L Lᵀ)⁻¹ right` with the factor of [`factor`] in the lower triangle.
#[cfg(not(feature = "compact"))]
pub fn solve_factored(lower: MatRef<'_, f64>, right: &mut [f64]) {
    solve_lower_triangular_in_place(lower, vector_mut(right), Par::Seq);
    solve_upper_triangular_in_place(lower.transpose(), vector_mut(right), Par::Seq);
}

/// `right := (L Lᵀ)⁻¹ right` with the factor of [`factor`] in the lower triangle.
#[cfg(feature = "compact")]
pub fn solve_factored(lower: MatRef<'_, f64>, right: &mut [f64]) {
    let n = right.len();
    for i in 0..n {
        let sum = (0..i).fold(right[i], |sum, k| sum - lower[(i, k)] * right[k]);
        right[i] = sum / lower[(i, i)];
    }
    for i in (0..n).rev() {
        let sum = (i + 1..n).fold(right[i], |sum, k| sum - lower[(k, i)] * right[k]);
        right[i] = sum / lower[(i, i)];
    }
}

/// `matrix⁻¹ right`; not finite for a matrix that is singular. Allocates.
#[cfg(not(feature = "compact"))]
pub(crate) fn solve_general(matrix: &Mat<f64>, right: [&Mat<f64>; 2]) -> [Mat<f64>; 2] {
    let lu = matrix.partial_piv_lu();
    right.map(|right| lu.solve(right))
}

/// `matrix⁻¹ right` by elimination with the largest pivot of a column (*Matrix Computations*, algorithm 3.4.1); not finite for a matrix that
/// is singular. Allocates.
#[cfg(feature = "compact")]
pub(crate) fn solve_general(matrix: &Mat<f64>, right: [&Mat<f64>; 2]) -> [Mat<f64>; 2] {
    let n = matrix.nrows();
    let mut left = matrix.clone();
    let mut right = right.map(Clone::clone);
    for k in 0..n {
        let pivot = (k..n).max_by(|a, b| left[(*a, k)].abs().total_cmp(&left[(*b, k)].abs())).unwrap_or(k);
        for matrix in core::iter::once(&mut left).chain(&mut right) {
            for column in 0..matrix.ncols() {
                let upper = matrix[(k, column)];
                matrix[(k, column)] = matrix[(pivot, column)];
                matrix[(pivot, column)] = upper;
            }
        }
        for row in (0..n).filter(|row| *row != k) {
            let share = left[(row, k)] / left[(k, k)];
            for column in k..n {
                left[(row, column)] -= share * left[(k, column)];
            }
            for right in &mut right {
                for column in 0..right.ncols() {
                    right[(row, column)] -= share * right[(k, column)];
                }
            }
        }
    }
    for right in &mut right {
        for column in 0..right.ncols() {
            for row in 0..n {
                right[(row, column)] /= left[(row, row)];
            }
        }
    }
    right
}
