//! What the guess of a step misses, itself extrapolated: by as many backward differences as told the last step best.
//!
//! | letter | meaning |
//! |---|---|
//! | `m_k` | solution of step k less the nodes that [`super`] extrapolates from the step before |
//! | `∇^j` | backward difference, `∇^0 m_k = m_k`, `∇^{j+1} m_k = ∇^j m_k - ∇^j m_{k-1}` |
//!
//! ```text
//! guess of step k+1: extrapolated nodes + Σ_{j < terms} ∇^j m_k            what j terms would have missed in step k: ∇^j m_k
//! ```
//!
//! Every term is worth an order while the motion is smooth, and nothing where inputs jump: the number of terms is that whose error in
//! the last step was least. Source: backward differences, E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations
//! I*, 2nd ed., Springer 1993, section III.1.

use alloc::vec;
use alloc::vec::Vec;

/// Most differences: a fifth gains nothing at usual steps, and the differences double round-off with every order.
const MOST_TERMS: usize = 4;
/// A further term must have been better than this times the error without it: at round-off, terms only add noise.
const WORTH: f64 = 0.5;

/// Differences of what the last steps missed.
#[derive(Clone, Debug)]
pub(super) struct Missed {
    /// `∇^j m`, one vector of `count` numbers after the other.
    differences: Vec<f64>,
    count: usize,
    steps: usize,
    terms: usize,
}

impl Missed {
    /// For guesses of `count` numbers. Allocates.
    pub fn new(count: usize) -> Self {
        Self { differences: vec![0.0; MOST_TERMS * count], count, steps: 0, terms: 0 }
    }

    /// The next step does not continue the motion.
    pub fn forget(&mut self) {
        (self.steps, self.terms) = (0, 0);
    }

    /// Whether a step has been remembered since the motion began.
    pub fn is_known(&self) -> bool {
        self.steps > 0
    }

    /// What the next step is expected to miss.
    pub fn expected_into(&self, out: &mut [f64]) {
        out.fill(0.0);
        for difference in self.differences.chunks_exact(self.count.max(1)).take(self.terms) {
            for (sum, x) in out.iter_mut().zip(difference) {
                *sum += x;
            }
        }
    }

    /// Remembers what was missed, and chooses the number of terms for the next step. Overwrites `missed`.
    pub fn remember(&mut self, missed: &mut [f64]) {
        let mut errors = [0.0f64; MOST_TERMS + 1];
        for (difference, error) in self.differences.chunks_exact_mut(self.count.max(1)).zip(&mut errors) {
            *error = largest(missed);
            for (before, x) in difference.iter_mut().zip(&mut *missed) {
                (*before, *x) = (*x, *x - *before);
            }
        }
        errors[MOST_TERMS] = largest(missed);
        // After the first step, whose guess had no terms, one is worth trying.
        self.terms = usize::from(self.steps == 0);
        for j in 1..=self.steps.min(MOST_TERMS) {
            if errors[j] < WORTH * errors[self.terms] {
                self.terms = j;
            }
        }
        self.steps += 1;
    }
}

fn largest(numbers: &[f64]) -> f64 {
    numbers.iter().fold(0.0, |most, x| if x.abs() > most { x.abs() } else { most })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What changes as a cubic is told exactly after four steps; a jump puts the terms back.
    #[test]
    fn follows_polynomials_and_drops_terms_at_jumps() {
        let cubic = |k: i32| f64::from(k * k * k - 2 * k * k + 5);
        let mut missed = Missed::new(1);
        for k in 0..5 {
            missed.remember(&mut [cubic(k)]);
        }
        let mut expected = [0.0];
        missed.expected_into(&mut expected);
        assert_eq!(expected, [cubic(5)]);
        missed.remember(&mut [cubic(5)]);
        missed.remember(&mut [0.0]);
        missed.expected_into(&mut expected);
        assert_eq!(expected, [0.0]);
    }
}
