//! Broyden's method on top of the factors of an earlier Jacobian, as the integrator uses it ([`crate::step`]).
//!
//! Turns the simplified change `d = -J_0⁻¹ r` into the quasi-Newton change by the changes `s_0, s_1, ...` made since the factorisation:
//!
//! ```text
//! d := d + (s_j·d / |s_j|²) s_{j+1}   (j = 0, 1, ..., last - 1)          d := d / (1 - s_last·d / |s_last|²)
//! ```
//!
//! Source: C. T. Kelley, *Iterative Methods for Linear and Nonlinear Equations*, SIAM 1995, section 7.3.
//!
//! **A sequence of problems** with the same factors, the steps of a motion: their Jacobians move away from `J_0` evenly. In the last
//! problem, the k-th since the factorisation, the first simplified change was `d_0`, and the whole iteration found `d_0 + m`. In the
//! next one, every `d` is first corrected by what that tells, a secant stretched to the k + 1 problems:
//!
//! ```text
//! d := d + (k+1)/k (d_0·d / |d_0|²) m
//! ```
//!
//! Cost: O(n) for each of up to 8 remembered changes of `n` numbers, and for the secant of the last problem.

use alloc::vec;
use alloc::vec::Vec;

/// Changes remembered; later ones use these.
const MEMORY: usize = 8;
/// A last problem whose first change missed more than this, relative to it, tells nothing about the next one.
const TRUSTED: f64 = 0.25;

/// The changes since the last factorisation.
#[derive(Clone, Debug)]
pub struct Broyden {
    order: usize,
    remembered: usize,
    changes: Vec<f64>,
    squares: [f64; MEMORY],
    /// `d_0` of this problem, and the sum of its changes.
    first: Vec<f64>,
    total: Vec<f64>,
    /// `d_0` and `(k+1)/k m / |d_0|²` of the last problem, if it is known.
    last_first: Vec<f64>,
    last_missed: Vec<f64>,
    has_last: bool,
    /// Problems solved since the one that `J_0` was made in, that one included.
    solved: u32,
}

impl Broyden {
    /// For vectors of `order` numbers. Allocates.
    pub fn new(order: usize) -> Self {
        let zeros = vec![0.0; order];
        Self {
            order,
            remembered: 0,
            changes: vec![0.0; MEMORY * order],
            squares: [0.0; MEMORY],
            first: zeros.clone(),
            total: zeros.clone(),
            last_first: zeros.clone(),
            last_missed: zeros,
            has_last: false,
            solved: 0,
        }
    }

    /// After a factorisation.
    pub fn forget(&mut self) {
        self.remembered = 0;
        self.has_last = false;
        self.solved = 0;
    }

    /// Begins the next problem with the factors at hand.
    pub fn begin(&mut self) {
        self.remembered = 0;
    }

    /// The problem at hand is solved: what it tells about the next one. No allocation.
    pub fn end(&mut self) {
        if self.remembered > 0 && self.solved > 0 {
            core::mem::swap(&mut self.last_first, &mut self.first);
            for ((missed, total), first) in self.last_missed.iter_mut().zip(&self.total).zip(&self.last_first)
            {
                *missed = total - first;
            }
            let square = inner(&self.last_first, &self.last_first);
            self.has_last =
                square > 0.0 && inner(&self.last_missed, &self.last_missed) <= TRUSTED * TRUSTED * square;
            let stretch = f64::from(self.solved + 1) / (f64::from(self.solved) * square);
            for missed in &mut self.last_missed {
                *missed *= stretch;
            }
        }
        self.solved = self.solved.saturating_add(1);
    }

    /// Improves a simplified change in place, and remembers it. No allocation.
    pub fn improve(&mut self, change: &mut [f64]) {
        let order = self.order;
        if self.remembered == 0 {
            self.first.copy_from_slice(change);
            self.total.fill(0.0);
        }
        if self.has_last {
            let factor = inner(&self.last_first, change);
            for (x, missed) in change.iter_mut().zip(&self.last_missed) {
                *x += factor * missed;
            }
        }
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
        for (total, x) in self.total.iter_mut().zip(&*change) {
            *total += x;
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

    /// Linear problems whose matrix moves away from the first one, along one line: the second change of the third problem is far
    /// smaller than without what the second one told.
    #[test]
    fn learns_from_the_problem_before() {
        let second_change = |learns: bool| {
            let mut broyden = Broyden::new(2);
            let mut size = 0.0;
            for problem in 0..3 {
                let drift = 0.05 * f64::from(problem);
                let solution = [0.3, -0.7];
                let mut x = [0.0; 2];
                broyden.begin();
                for iteration in 0..12 {
                    let d = [solution[0] - x[0], solution[1] - x[1]];
                    let mut change = [d[0] + drift * (d[0] + d[1]), d[1] - 2.0 * drift * d[0]];
                    if change == [0.0; 2] {
                        break;
                    }
                    broyden.improve(&mut change);
                    x = [x[0] + change[0], x[1] + change[1]];
                    if iteration == 1 {
                        size = change[0].abs().max(change[1].abs());
                    }
                }
                if learns {
                    broyden.end();
                }
            }
            size
        };
        assert!(second_change(true) < 0.2 * second_change(false), "{:e}", second_change(true));
    }
}
