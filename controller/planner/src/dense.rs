//! Dense kernels of the stage chain: partial Cholesky, symmetric rank-k updates, triangular solves.
//!
//! Matrices are column-major with a leading dimension that is a multiple of [`ALIGNMENT`]; only the lower triangle means
//! anything (the kernels may leave numbers above the diagonal).

use pulp::{Arch, Simd, WithSimd};

/// Leading dimensions are multiples of this many numbers.
pub const ALIGNMENT: usize = 8;

/// Columns factorised before the trailing matrix is updated.
const PANEL: usize = 8;

/// The next multiple of [`ALIGNMENT`].
pub fn padded(n: usize) -> usize {
    n.div_ceil(ALIGNMENT) * ALIGNMENT
}

/// A pivot of a Cholesky factorisation was not positive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotPositive {
    /// The pivot.
    pub pivot: usize,
}

/// `A := A + factor P Pᵀ` in the lower triangle; `P` has `width` columns with the leading dimension of `A`.
/// `n² width / 2` multiply-adds.
pub fn rank_update(arch: Arch, a: &mut [f64], ld: usize, n: usize, p: &[f64], width: usize, factor: f64) {
    arch.dispatch(RankUpdate { a, ld, from: 0, n, p, width, factor });
}

/// Factorises the leading `pivots` columns of a symmetric matrix in place: `L11`, `L21` there, and the Schur complement
/// `A22 - L21 L21ᵀ` in the rest.
///
/// # Errors
/// [`NotPositive`]; the matrix is then left half done.
pub fn partial_cholesky(
    arch: Arch,
    a: &mut [f64],
    ld: usize,
    n: usize,
    pivots: usize,
) -> Result<(), NotPositive> {
    let mut start = 0;
    while start < pivots {
        let width = PANEL.min(pivots - start);
        arch.dispatch(|| factor_panel(a, ld, n, start, width))?;
        if start + width < n {
            let (panel, rest) = a.split_at_mut((start + width) * ld);
            let (from, p) = (start + width, &panel[start * ld..]);
            arch.dispatch(RankUpdate { a: rest, ld, from, n, p, width, factor: -1.0 });
        }
        start += width;
    }
    Ok(())
}

#[inline(always)]
fn factor_panel(a: &mut [f64], ld: usize, n: usize, start: usize, width: usize) -> Result<(), NotPositive> {
    for j in start..start + width {
        let (done, rest) = a.split_at_mut(j * ld);
        let column = &mut rest[j..n];
        for p in start..j {
            let earlier = &done[p * ld + j..p * ld + n];
            let factor = earlier[0];
            for (x, l) in column.iter_mut().zip(earlier) {
                *x -= factor * l;
            }
        }
        let pivot = column[0];
        if pivot.is_nan() || pivot <= 0.0 || pivot.is_infinite() {
            return Err(NotPositive { pivot: j });
        }
        let root = pivot.sqrt();
        let inverse = 1.0 / root;
        column[0] = root;
        for x in &mut column[1..] {
            *x *= inverse;
        }
    }
    Ok(())
}

/// Columns `from..n` of a matrix (the first of them at the start of `a`): lower triangle `+= factor P Pᵀ`.
struct RankUpdate<'a> {
    a: &'a mut [f64],
    ld: usize,
    from: usize,
    n: usize,
    p: &'a [f64],
    width: usize,
    factor: f64,
}

impl WithSimd for RankUpdate<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { a, ld, from, n, p, width, factor } = self;
        let vector = S::F64_LANES;
        if ld % vector != 0 {
            return;
        }
        let mut c = from;
        while c < n {
            let columns = 4.min(n - c);
            let mut at = [0; 4];
            for (q, at) in at.iter_mut().enumerate() {
                *at = (c + q.min(columns - 1) - from) * ld;
            }
            let first = c / vector;
            let last = n.div_ceil(vector);
            let mut row = first;
            while row + 2 <= last {
                tile::<S, 2>(simd, a, &at, columns, p, ld, width, factor, c, row);
                row += 2;
            }
            if row < last {
                tile::<S, 1>(simd, a, &at, columns, p, ld, width, factor, c, row);
            }
            c += columns;
        }
    }
}

#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn tile<S: Simd, const ROWS: usize>(
    simd: S,
    a: &mut [f64],
    at: &[usize; 4],
    columns: usize,
    p: &[f64],
    ld: usize,
    width: usize,
    factor: f64,
    c: usize,
    row: usize,
) {
    let zero = simd.splat_f64s(0.0);
    let mut total = [[zero; ROWS]; 4];
    let last = columns - 1;
    for k in 0..width {
        let column = &p[k * ld..(k + 1) * ld];
        let (vectors, _) = S::as_simd_f64s(column);
        let vectors = &vectors[row..row + ROWS];
        let coefficients = &column[c..c + columns];
        for q in 0..4 {
            let coefficient = simd.splat_f64s(coefficients[q.min(last)]);
            for r in 0..ROWS {
                total[q][r] = simd.mul_add_e_f64s(coefficient, vectors[r], total[q][r]);
            }
        }
    }
    let factor = simd.splat_f64s(factor);
    for q in 0..columns {
        let (vectors, _) = S::as_mut_simd_f64s(&mut a[at[q]..at[q] + ld]);
        for r in 0..ROWS {
            vectors[row + r] = simd.mul_add_e_f64s(factor, total[q][r], vectors[row + r]);
        }
    }
}

/// Solves `L x = b` for the leading `pivots` entries and takes their part from the rest: `b2 := b2 - L21 x1`.
pub fn forward(a: &[f64], ld: usize, n: usize, pivots: usize, b: &mut [f64]) {
    for j in 0..pivots {
        let column = &a[j * ld + j..j * ld + n];
        let (head, rest) = b[j..n].split_at_mut(1);
        let x = head[0] / column[0];
        head[0] = x;
        for (b, l) in rest.iter_mut().zip(&column[1..]) {
            *b -= l * x;
        }
    }
}

/// Solves `L11ᵀ x1 = b1 - L21ᵀ x2` for the leading `pivots` entries; the rest of `b` holds `x2`.
pub fn backward(a: &[f64], ld: usize, n: usize, pivots: usize, b: &mut [f64]) {
    for j in (0..pivots).rev() {
        let column = &a[j * ld + j..j * ld + n];
        let (head, rest) = b[j..n].split_at_mut(1);
        let mut totals = [0.0; 4];
        let mut chunks_l = column[1..].chunks_exact(4);
        let mut chunks_b = rest.chunks_exact(4);
        for (l, b) in (&mut chunks_l).zip(&mut chunks_b) {
            for lane in 0..4 {
                totals[lane] += l[lane] * b[lane];
            }
        }
        let mut total = (totals[0] + totals[2]) + (totals[1] + totals[3]);
        for (l, b) in chunks_l.remainder().iter().zip(chunks_b.remainder()) {
            total += l * b;
        }
        head[0] = (head[0] - total) / column[0];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A positive definite matrix of fixed pseudo-random entries, padded.
    fn matrix(n: usize, ld: usize) -> Vec<f64> {
        let mut state = 1u64;
        let mut next = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let root: Vec<f64> = (0..n * n).map(|_| next()).collect();
        let mut a = vec![0.0; ld * n];
        for i in 0..n {
            for j in 0..=i {
                let product: f64 = (0..n).map(|k| root[i * n + k] * root[j * n + k]).sum();
                a[j * ld + i] = product + if i == j { 0.1 } else { 0.0 };
            }
        }
        a
    }

    #[test]
    fn partial_factor_then_rest_solves_the_system() {
        let arch = Arch::new();
        for (n, pivots) in [(5, 2), (19, 19), (38, 19), (87, 68), (152, 115)] {
            let ld = padded(n);
            let a = matrix(n, ld);
            let solution: Vec<f64> = (0..n).map(|i| (i as f64 * 0.7).sin()).collect();
            let entry = |i: usize, j: usize| a[i.min(j) * ld + i.max(j)];
            let mut b: Vec<f64> = (0..n).map(|i| (0..n).map(|j| entry(i, j) * solution[j]).sum()).collect();
            let mut factor = a.clone();
            partial_cholesky(arch, &mut factor, ld, n, pivots).unwrap();
            let rest = n - pivots;
            let rest_ld = padded(rest.max(1));
            let mut schur = vec![0.0; rest_ld * rest];
            for j in 0..rest {
                for i in j..rest {
                    schur[j * rest_ld + i] = factor[(pivots + j) * ld + pivots + i];
                }
            }
            partial_cholesky(arch, &mut schur, rest_ld, rest, rest).unwrap();
            forward(&factor, ld, n, pivots, &mut b);
            forward(&schur, rest_ld, rest, rest, &mut b[pivots..]);
            backward(&schur, rest_ld, rest, rest, &mut b[pivots..]);
            backward(&factor, ld, n, pivots, &mut b);
            for (got, want) in b.iter().zip(&solution) {
                assert!((got - want).abs() < 1e-10, "{n} {pivots}: {got} against {want}");
            }
        }
    }

    #[test]
    fn rank_update_is_the_sum_of_outer_products() {
        let (n, ld, width) = (21, 24, 7);
        let p: Vec<f64> = (0..ld * width).map(|i| (i as f64).cos()).collect();
        let mut a = vec![0.0; ld * n];
        rank_update(Arch::new(), &mut a, ld, n, &p, width, 1.0);
        for j in 0..n {
            for i in j..n {
                let want: f64 = (0..width).map(|k| p[k * ld + i] * p[k * ld + j]).sum();
                assert!((a[j * ld + i] - want).abs() < 1e-13);
            }
        }
    }

    #[test]
    fn an_indefinite_matrix_names_its_pivot() {
        let mut a = vec![0.0; 8 * 2];
        (a[0], a[1], a[9]) = (1.0, 2.0, 1.0);
        assert_eq!(partial_cholesky(Arch::new(), &mut a, 8, 2, 2), Err(NotPositive { pivot: 1 }));
    }
}
