//! Small dense LU with partial pivoting, rows of equal length in one array; the passes run with the widest instructions.

use crate::rigid_bodies::vectorized;

/// Factors of a square matrix.
#[derive(Clone, Debug)]
pub struct PivotedLu {
    order: usize,
    arch: pulp::Arch,
    /// Row by row; filled by the caller, then overwritten by the factors.
    pub matrix: Vec<f64>,
    pivots: Vec<usize>,
}

impl PivotedLu {
    /// For matrices of `order` rows.
    pub fn new(order: usize) -> Self {
        Self { order, arch: pulp::Arch::new(), matrix: vec![0.0; order * order], pivots: vec![0; order] }
    }

    /// Factorises [`Self::matrix`] in place. `false` if it is singular to the last bit. No allocation.
    pub fn factor(&mut self) -> bool {
        vectorized!(self.arch, bool, (work: &'a mut PivotedLu = self) => work.eliminate())
    }

    /// `x := A⁻¹ x`. No allocation.
    pub fn solve(&self, x: &mut [f64]) {
        vectorized!(self.arch, (), (work: &'a PivotedLu = self, x: &'a mut [f64] = x) => work.substitute(x));
    }

    #[inline(always)]
    fn eliminate(&mut self) -> bool {
        let (n, matrix, pivots) = (self.order, &mut self.matrix, &mut self.pivots);
        for k in 0..n {
            let mut pivot = k;
            for r in k + 1..n {
                if matrix[r * n + k].abs() > matrix[pivot * n + k].abs() {
                    pivot = r;
                }
            }
            pivots[k] = pivot;
            let (top, rest) = matrix.split_at_mut((k + 1) * n);
            if pivot != k {
                let start = (pivot - k - 1) * n;
                top[k * n..].swap_with_slice(&mut rest[start..start + n]);
            }
            let row = &top[k * n..];
            if row[k] == 0.0 {
                return false;
            }
            let inverse = 1.0 / row[k];
            for below in rest.chunks_exact_mut(n) {
                let factor = below[k] * inverse;
                below[k] = factor;
                for (x, y) in below[k + 1..].iter_mut().zip(&row[k + 1..]) {
                    *x = (-factor).mul_add(*y, *x);
                }
            }
        }
        true
    }

    #[inline(always)]
    fn substitute(&self, x: &mut [f64]) {
        let (n, matrix, pivots) = (self.order, &self.matrix, &self.pivots);
        for k in 0..n {
            x.swap(k, pivots[k]);
        }
        for k in 0..n {
            x[k] -= inner(&matrix[k * n..k * n + k], &x[..k]);
        }
        for k in (0..n).rev() {
            let rest = inner(&matrix[k * n + k + 1..(k + 1) * n], &x[k + 1..n]);
            x[k] = (x[k] - rest) / matrix[k * n + k];
        }
    }
}

/// Scalar product in four partial sums.
#[inline(always)]
fn inner(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0f64; 4];
    let (whole, rest) = (a.chunks_exact(4), b.chunks_exact(4));
    let mut tail = 0.0f64;
    for (x, y) in whole.remainder().iter().zip(rest.remainder()) {
        tail = x.mul_add(*y, tail);
    }
    for (x, y) in whole.zip(rest) {
        for k in 0..4 {
            sums[k] = x[k].mul_add(y[k], sums[k]);
        }
    }
    tail + (sums[0] + sums[1]) + (sums[2] + sums[3])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pendulum::Uniform;

    #[test]
    fn solves_with_pivoting_and_refuses_singular_matrices() {
        for n in [1, 2, 7, 24] {
            let mut uniform = Uniform::new(n as u64);
            let mut lu = PivotedLu::new(n);
            let matrix = uniform.vector(n * n, 1.0);
            lu.matrix.copy_from_slice(&matrix);
            // The first pivot has to come from below.
            lu.matrix[0] = if n > 1 { 0.0 } else { 2.0 };
            let matrix = lu.matrix.clone();
            let x = uniform.vector(n, 1.0);
            let mut b: Vec<f64> = (0..n).map(|r| (0..n).map(|c| matrix[r * n + c] * x[c]).sum()).collect();
            assert!(lu.factor());
            lu.solve(&mut b);
            assert!(x.iter().zip(&b).all(|(x, b)| (x - b).abs() < 1e-10), "{n}");
        }
        let mut lu = PivotedLu::new(2);
        lu.matrix.copy_from_slice(&[1.0, 2.0, 2.0, 4.0]);
        assert!(!lu.factor());
    }
}
