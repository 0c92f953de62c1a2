//! Broyden's method on top of the factors of an earlier Jacobian, as the integrator uses it ([`crate::step`]).
//!
//! Turns the simplified change `d = -J_0⁻¹ r` into the quasi-Newton change by the changes `s_0, s_1, ...` made since the factorisation:
//!
//! ```text
//! d := d + (s_j·d / |s_j|²) s_{j+1}   (j = 0, 1, ..., last - 1)          d := d / (1 - s_last·d / |s_last|²)
//! ```
//!
//! Cost: O(m) for each of up to 8 remembered changes of `m` numbers. Source: C. T. Kelley, *Iterative Methods for Linear and Nonlinear Equations*, SIAM 1995, section 7.3.

use alloc::vec;
use alloc::vec::Vec;

/// Changes remembered; later ones use these.
const MEMORY: usize = 8;

/// The changes since the last factorisation.
#[derive(Clone, Debug)]
pub struct Broyden {
    order: usize,
    remembered: usize,
    changes: Vec<f64>,
    squares: [f64; MEMORY],
}

impl Broyden {
    /// For vectors of `order` numbers. Allocates.
    pub fn new(order: usize) -> Self {
        Self { order, remembered: 0, changes: vec![0.0; MEMORY * order], squares: [0.0; MEMORY] }
    }

    /// After a factorisation.
    pub fn forget(&mut self) {
        self.remembered = 0;
    }

    /// Improves a simplified change in place, and remembers it. No allocation.
    pub fn improve(&mut self, change: &mut [f64]) {
        let order = self.order;
        for j in 0..self.remembered {
            let own = &self.changes[j * order..(j + 1) * order];
            let factor = inner(own, change) / self.squares[j];
            if j + 1 < self.remembered {
                let next = &self.changes[(j + 1) * order..(j + 2) * order];
                for (x, n) in change.iter_mut().zip(next) {
                    *x += factor * n;
                }
            } else if (1.0 - factor).abs() > 0.1 {
                // A change that turns back on the last one: the simplified one is kept.
                let scale = 1.0 - factor;
                for x in change.iter_mut() {
                    *x /= scale;
                }
            }
        }
        if self.remembered < MEMORY {
            let place = self.remembered * order;
            self.changes[place..place + order].copy_from_slice(change);
            self.squares[self.remembered] = inner(change, change);
            self.remembered += 1;
        }
    }
}

/// Scalar product in four partial sums: additions need not wait for each other.
fn inner(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0f64; 4];
    let (whole, other) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = whole.remainder().iter().zip(other.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in whole.zip(other) {
        for k in 0..4 {
            sums[k] += x[k] * y[k];
        }
    }
    rest + (sums[0] + sums[1]) + (sums[2] + sums[3])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On a linear problem of n unknowns Broyden's method ends after at most 2n iterations, whatever the first Jacobian.
    #[test]
    fn ends_on_linear_problems() {
        let solution = [0.3, -0.7];
        let residual = |x: &[f64; 2]| {
            let d = [x[0] - solution[0], x[1] - solution[1]];
            [1.3 * d[0] + 0.4 * d[1], -0.2 * d[0] + 0.8 * d[1]]
        };
        let mut x = [0.0; 2];
        let mut broyden = Broyden::new(2);
        for _ in 0..5 {
            let r = residual(&x);
            let mut change = [-r[0], -r[1]];
            if change == [0.0; 2] {
                break;
            }
            broyden.improve(&mut change);
            x[0] += change[0];
            x[1] += change[1];
        }
        assert!((x[0] - solution[0]).abs() + (x[1] - solution[1]).abs() < 1e-12, "{x:?}");
    }
}
