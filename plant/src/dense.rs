//! Dense LU with row pivoting for the few unknowns of a contact problem; no allocation after construction.

/// Factorisation workspace for up to a fixed order.
#[derive(Clone, Debug)]
pub(crate) struct SmallLu {
    order: usize,
    factors: Vec<f64>,
    swaps: Vec<usize>,
}

impl SmallLu {
    pub fn new(capacity: usize) -> Self {
        Self { order: 0, factors: vec![0.0; capacity * capacity], swaps: vec![0; capacity] }
    }

    /// Factorises the row-major matrix `matrix` of the given order; `false` when a pivot vanishes.
    pub fn factorise(&mut self, matrix: &[f64], order: usize) -> bool {
        let n = order;
        self.order = n;
        self.factors[..n * n].copy_from_slice(&matrix[..n * n]);
        let a = &mut self.factors[..n * n];
        for k in 0..n {
            let pivot_row =
                (k..n).fold(k, |best, r| if a[r * n + k].abs() > a[best * n + k].abs() { r } else { best });
            self.swaps[k] = pivot_row;
            if pivot_row != k {
                for c in 0..n {
                    a.swap(k * n + c, pivot_row * n + c);
                }
            }
            let pivot = a[k * n + k];
            if !pivot.is_normal() {
                return false;
            }
            let (top, below) = a.split_at_mut((k + 1) * n);
            let pivot_row = &top[k * n + k + 1..(k + 1) * n];
            for row in below.chunks_exact_mut(n) {
                let factor = row[k] / pivot;
                row[k] = factor;
                if factor != 0.0 {
                    for (x, p) in row[k + 1..].iter_mut().zip(pivot_row) {
                        *x -= factor * p;
                    }
                }
            }
        }
        true
    }

    /// `x := A⁻¹ x`.
    pub fn solve(&self, x: &mut [f64]) {
        let n = self.order;
        let a = &self.factors;
        for k in 0..n {
            x.swap(k, self.swaps[k]);
        }
        for r in 0..n {
            let sum: f64 = a[r * n..r * n + r].iter().zip(&x[..r]).map(|(a, x)| a * x).sum();
            x[r] -= sum;
        }
        for r in (0..n).rev() {
            let sum: f64 = a[r * n + r + 1..(r + 1) * n].iter().zip(&x[r + 1..n]).map(|(a, x)| a * x).sum();
            x[r] = (x[r] - sum) / a[r * n + r];
        }
    }
}

/// `out := A x`, row-major.
pub(crate) fn multiply(matrix: &[f64], x: &[f64], out: &mut [f64]) {
    for (row, out) in matrix.chunks_exact(x.len()).zip(out) {
        *out = row.iter().zip(x).map(|(a, x)| a * x).sum();
    }
}

pub(crate) fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |m: f64, x| m.max(x.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_that_needs_pivoting_is_solved() {
        let a = [0.0, 2.0, 1.0, 1.0, 1.0, 0.0, 4.0, -1.0, 3.0];
        let mut lu = SmallLu::new(5);
        assert!(lu.factorise(&a, 3));
        let mut b = [0.0; 3];
        multiply(&a, &[1.0, -2.0, 3.0], &mut b);
        lu.solve(&mut b);
        assert!(b.iter().zip([1.0, -2.0, 3.0]).all(|(x, y)| (x - y).abs() < 1e-14));
    }

    #[test]
    fn a_singular_matrix_is_refused() {
        assert!(!SmallLu::new(2).factorise(&[1.0, 2.0, 2.0, 4.0], 2));
    }
}
