//! Where the mass centre goes in a walk: nearest to zero-moment points in the feet, without jerk.
//!
//! ```text
//! min Σ_i w (c_i - (h/g) c̈_i - z_i)² + Σ_i (Δt³ c⃛_i)²      c̈ central difference, c⃛ third difference, both ends at rest
//! ```
//!
//! for each axis of the ground; a banded linear system, solved once for a walk (seven diagonals, Cholesky). `z_i` is the point under the
//! foot that stands, and moves to the next one while both do.
//!
//! Source: S. Kajita et al., *Biped walking pattern generation by using preview control of zero-moment point*, ICRA 2003, for the
//! problem; the least-squares form as in P.-B. Wieber, *Trajectory free linear model predictive control for stable walking*, 2006.

use alloc::vec;
use alloc::vec::Vec;

use nalgebra::Vector2;

/// Time between two points, s.
const SPACING_S: f64 = 0.01;
/// Weight of a zero-moment point against a jerk of `1/Δt³`.
const WEIGHT: f64 = 1e-5;
/// Width of the band beside the diagonal.
const BAND: usize = 3;

/// The way of the mass centre.
#[derive(Clone, Debug, PartialEq)]
pub struct MassCentrePlan {
    start_s: f64,
    points: Vec<Vector2<f64>>,
}

impl MassCentrePlan {
    /// From `start_s` to `end_s`, at rest at both ends over the points there; `height_m` above the ground under `gravity` (m/s²). Allocates.
    pub fn new(
        start_s: f64,
        end_s: f64,
        height_m: f64,
        gravity: f64,
        zero_moment_point: impl Fn(f64) -> Vector2<f64>,
    ) -> Self {
        let count = libm::ceil((end_s - start_s).max(0.0) / SPACING_S) as usize + 1;
        // Three points held at both ends: at rest.
        let n = count.saturating_sub(2 * BAND);
        let wanted: Vec<Vector2<f64>> =
            (0..count).map(|i| zero_moment_point(start_s + SPACING_S * i as f64)).collect();
        if n == 0 {
            return Self { start_s, points: wanted };
        }
        let (first, last) = (wanted[0], wanted[count - 1]);
        let lever = height_m / gravity / (SPACING_S * SPACING_S);
        let mut matrix = vec![[0.0; BAND + 1]; n];
        let mut right = vec![Vector2::zeros(); n];
        let mut add = |at: usize, row: &[f64], target: Vector2<f64>, weight: f64| {
            let known = |i: usize| if i < BAND { Some(first) } else { (i >= n + BAND).then_some(last) };
            let mut rest = target;
            for (k, c) in row.iter().enumerate() {
                rest -= known(at + k).unwrap_or_default() * *c;
            }
            for (k, c) in row.iter().enumerate().filter(|(k, _)| known(at + k).is_none()) {
                let i = at + k - BAND;
                right[i] += rest * (weight * c);
                for (l, d) in row.iter().enumerate().take(k + 1).filter(|(l, _)| known(at + l).is_none()) {
                    matrix[i][k - l] += weight * c * d;
                }
            }
        };
        for i in 1..count - 1 {
            add(i - 1, &[-lever, 1.0 + 2.0 * lever, -lever], wanted[i], WEIGHT);
        }
        for i in 0..count - BAND {
            add(i, &[-1.0, 3.0, -3.0, 1.0], Vector2::zeros(), 1.0);
        }
        let inner = solve_band(&mut matrix, right);
        let points =
            core::iter::repeat_n(first, BAND).chain(inner).chain(core::iter::repeat_n(last, BAND)).collect();
        Self { start_s, points }
    }

    /// Place, velocity and acceleration at a time; at rest before and after.
    pub fn at(&self, time_s: f64) -> [Vector2<f64>; 3] {
        let count = self.points.len();
        let along = ((time_s - self.start_s) / SPACING_S).clamp(0.0, (count - 1) as f64);
        let i = (along as usize).min(count.saturating_sub(2));
        let part = along - i as f64;
        let point = |k: usize| self.points[k.min(count - 1)];
        let before = if i == 0 { point(0) } else { point(i - 1) };
        let (here, next, after) = (point(i), point(i + 1), point(i + 2));
        // Cubic through four points, and its derivatives.
        let a = (after - next * 3.0 + here * 3.0 - before) * 0.5;
        let b = before - here * 2.5 + next * 2.0 - after * 0.5;
        let c = (next - before) * 0.5;
        let place = ((a * part + b) * part + c) * part + here;
        let velocity = ((a * (3.0 * part) + b * 2.0) * part + c) / SPACING_S;
        let second =
            |l: Vector2<f64>, m: Vector2<f64>, r: Vector2<f64>| (l - m * 2.0 + r) / (SPACING_S * SPACING_S);
        let acceleration = second(before, here, next) * (1.0 - part) + second(here, next, after) * part;
        [place, velocity, acceleration]
    }

    /// When it ends, s.
    pub fn end_s(&self) -> f64 {
        self.start_s + SPACING_S * (self.points.len().saturating_sub(1)) as f64
    }
}

/// Solves `M x = r` for a symmetric positive matrix whose row `i` has its entries `(i, i - k)` at `k`.
fn solve_band(matrix: &mut [[f64; BAND + 1]], mut right: Vec<Vector2<f64>>) -> Vec<Vector2<f64>> {
    let n = right.len();
    for i in 0..n {
        for k in (0..=BAND.min(i)).rev() {
            let j = i - k;
            let mut sum = matrix[i][k];
            for m in k + 1..=BAND.min(i) {
                // Column i - m, within the band of row j.
                if m - k <= BAND {
                    sum -= matrix[i][m] * matrix[j][m - k];
                }
            }
            matrix[i][k] = if k == 0 { libm::sqrt(sum.max(f64::MIN_POSITIVE)) } else { sum / matrix[j][0] };
        }
    }
    for i in 0..n {
        for k in 1..=BAND.min(i) {
            right[i] = right[i] - right[i - k] * matrix[i][k];
        }
        right[i] /= matrix[i][0];
    }
    for i in (0..n).rev() {
        for k in 1..=BAND.min(n - 1 - i) {
            right[i] = right[i] - right[i + k] * matrix[i + k][k];
        }
        right[i] /= matrix[i][0];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_zero_moment_point_follows_and_the_ends_rest() {
        let wanted = |t: f64| {
            Vector2::new(
                if t < 1.0 {
                    0.0
                } else if t < 1.2 {
                    1.5 * (t - 1.0)
                } else {
                    0.3
                },
                0.0,
            )
        };
        let (height, gravity) = (0.9, 9.81);
        let plan = MassCentrePlan::new(0.0, 2.5, height, gravity, wanted);
        let mut worst: f64 = 0.0;
        for k in 5..245 {
            let t = 0.01 * f64::from(k);
            let [place, _, acceleration] = plan.at(t);
            let point = place - acceleration * (height / gravity);
            worst = worst.max((point - wanted(t)).norm());
        }
        assert!(worst < 0.03, "{worst}");
        let [first, velocity, _] = plan.at(-1.0);
        assert_eq!((first.x, velocity.norm()), (0.0, 0.0));
        assert!((plan.at(9.0)[0].x - 0.3).abs() < 1e-12);
    }

    #[test]
    fn velocity_is_the_derivative() {
        let wanted = |t: f64| Vector2::new(0.1 * t, if t > 1.0 { 0.1 } else { -0.1 });
        let plan = MassCentrePlan::new(0.0, 2.0, 0.8, 9.81, wanted);
        for k in 10..180 {
            let t = 0.01 * f64::from(k) + 0.0037;
            let difference = (plan.at(t + 1e-5)[0] - plan.at(t - 1e-5)[0]) / 2e-5;
            assert!((difference - plan.at(t)[1]).norm() < 1e-5, "{t}");
        }
    }
}
