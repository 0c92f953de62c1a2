//! The cubic Hermite polynomial at one place of an interval: value, rate and change of rate from value and rate at both ends.
//!
//! ```text
//! p(t) = (1 - 3t² + 2t³) p_a + (3t² - 2t³) p_b + Δ (t - 2t² + t³) v_a + Δ (t³ - t²) v_b        0 <= t <= 1,  Δ: length
//! ```
//!
//! Exact for cubics; error O(Δ⁴) else.

use core::ops::{Add, Mul};

/// Weights of the value and the rate at the start, then of those at the end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hermite {
    value: [f64; 4],
    rate: [f64; 4],
    change: [f64; 4],
}

/// Value and rate at both ends of the interval: `(p_a, v_a), (p_b, v_b)`.
pub type Ends<T> = ((T, T), (T, T));

impl Hermite {
    /// At the part `t` of an interval of `length` s.
    pub fn new(t: f64, length: f64) -> Self {
        let (t2, t3) = (t * t, t * t * t);
        let slope = 6.0 * (t2 - t) / length;
        let bend = (12.0 * t - 6.0) / (length * length);
        Self {
            value: [
                1.0 - 3.0 * t2 + 2.0 * t3,
                length * (t - 2.0 * t2 + t3),
                3.0 * t2 - 2.0 * t3,
                length * (t3 - t2),
            ],
            rate: [slope, 1.0 - 4.0 * t + 3.0 * t2, -slope, 3.0 * t2 - 2.0 * t],
            change: [bend, (6.0 * t - 4.0) / length, -bend, (6.0 * t - 2.0) / length],
        }
    }

    /// The value.
    pub fn value<T: Copy + Mul<f64, Output = T> + Add<Output = T>>(&self, ends: Ends<T>) -> T {
        sum(&self.value, ends)
    }

    /// Its rate.
    pub fn rate<T: Copy + Mul<f64, Output = T> + Add<Output = T>>(&self, ends: Ends<T>) -> T {
        sum(&self.rate, ends)
    }

    /// The rate of that.
    pub fn change<T: Copy + Mul<f64, Output = T> + Add<Output = T>>(&self, ends: Ends<T>) -> T {
        sum(&self.change, ends)
    }
}

fn sum<T: Copy + Mul<f64, Output = T> + Add<Output = T>>(w: &[f64; 4], ((p, v), (q, r)): Ends<T>) -> T {
    p * w[0] + v * w[1] + q * w[2] + r * w[3]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_and_its_derivatives_are_met_exactly() {
        let value = |t: f64| 0.3 * t * t * t - t + 0.2;
        let slope = |t: f64| 0.9 * t * t - 1.0;
        for (a, b) in [(0.0, 0.1), (0.4, 0.9)] {
            let ends = ((value(a), slope(a)), (value(b), slope(b)));
            for part in [0.0, 0.3, 0.77, 1.0] {
                let t: f64 = a + part * (b - a);
                let at = Hermite::new(part, b - a);
                assert!((at.value(ends) - value(t)).abs() < 1e-14);
                assert!((at.rate(ends) - slope(t)).abs() < 1e-13);
                assert!((at.change(ends) - 1.8 * t).abs() < 1e-11);
            }
        }
    }
}
