//! The contact law as an equation: projection on the friction cones and semismooth Newton.
//!
//! | letter | meaning |
//! |---|---|
//! | `x` | impulses, three per contact: two tangents, normal (scaled) |
//! | `v = A x + d` | velocities (scaled, regularisation included in `A` and `d`) |
//! | `K` | friction cones, `\|x_t\| <= μ x_n` |
//!
//! Signorini's condition, Coulomb's law and maximum dissipation together are `K ∋ x ⊥ v + μ|v_t| e_n ∈ K*`, that is
//!
//! ```text
//! F(x) = x - P_K( x - r (v + μ|v_t| e_n) ) = 0             any r > 0; residuals are told for r = 1 / largest diagonal of the contact's block
//! F'   = I - DP_K (I - r D)                                D = A + μ e_n (v_t/|v_t|)ᵀ A_t
//! P_K(z): z inside -> z;  μ|z_t| <= -z_n -> 0;  else n = (z_n + μ|z_t|)/(1 + μ²), (μ n z_t/|z_t|, n)
//! ```
//!
//! Newton's method on `F` with backtracking 1, 1/2, 1/4, 0.1 stops when nothing decreases. It removes the lift of the cone program's
//! relaxation in the same sweep. On a rigid sole with redundant contacts the regularisation alone tells sticking from slipping, by
//! velocities of relative size `ρ`: a larger `r` moves the two cases apart, so where the iteration stalls it goes on with larger `r`.
//!
//! Source: G. De Saxcé, Z.-Q. Feng, *The bipotential method*, 1998 (the law as one variational inequality); P. Alart, A. Curnier,
//! *A mixed formulation for frictional contact problems prone to Newton like solution methods*, 1991.

use crate::dense::{SmallLu, multiply};

/// Residual (scaled) at which an iteration stops.
const CONVERGED: f64 = 1e-14;
/// Residual (scaled) at which no other `r` is tried.
const ENOUGH: f64 = 1e-11;
/// Largest number of Newton iterations for one `r`.
const MAX_ITERATIONS: usize = 20;
/// Factors on `r`, tried one after the other.
const GAINS: [f64; 6] = [1.0, 1e3, 30.0, 1e5, 5.0, 300.0];

/// Projection of `z` on the cone of friction `mu`.
pub fn project(mu: f64, z: [f64; 3]) -> [f64; 3] {
    let tangent = z[0].hypot(z[1]);
    if tangent <= mu * z[2] {
        return z;
    }
    if mu * tangent <= -z[2] {
        return [0.0; 3];
    }
    let normal = (z[2] + mu * tangent) / (1.0 + mu * mu);
    [mu * normal * z[0] / tangent, mu * normal * z[1] / tangent, normal]
}

/// Derivative of [`project`], row-major.
fn project_derivative(mu: f64, z: [f64; 3]) -> [f64; 9] {
    let tangent = z[0].hypot(z[1]);
    if tangent <= mu * z[2] {
        return [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    }
    if mu * tangent <= -z[2] {
        return [0.0; 9];
    }
    let scale = 1.0 / (1.0 + mu * mu);
    let normal = (z[2] + mu * tangent) * scale;
    let t = [z[0] / tangent, z[1] / tangent];
    let across = mu * normal / tangent;
    let mut d = [0.0; 9];
    for r in 0..2 {
        for c in 0..2 {
            let unit = if r == c { 1.0 } else { 0.0 };
            d[3 * r + c] = mu * mu * scale * t[r] * t[c] + across * (unit - t[r] * t[c]);
        }
        d[3 * r + 2] = mu * scale * t[r];
        d[6 + r] = mu * scale * t[r];
    }
    d[8] = scale;
    d
}

/// `max |F|` for the law `v = a x + d`; the velocities are left in `v`.
pub fn law_residual(a: &[f64], d: &[f64], mu: &[f64], x: &[f64], v: &mut [f64]) -> f64 {
    velocities(a, d, x, v);
    natural_residual(a, mu, x, v, 1.0).0
}

fn velocities(a: &[f64], d: &[f64], x: &[f64], v: &mut [f64]) {
    multiply(a, x, v);
    for (v, d) in v.iter_mut().zip(d) {
        *v += d;
    }
}

/// `max |F|` and `|F|²` for `r` larger by `factor`.
fn natural_residual(a: &[f64], mu: &[f64], x: &[f64], v: &[f64], factor: f64) -> (f64, f64) {
    let (mut worst, mut square) = (0.0f64, 0.0);
    for (i, &mu) in mu.iter().enumerate() {
        let own = [x[3 * i], x[3 * i + 1], x[3 * i + 2]];
        let projected = project(mu, shifted(factor * gain(a, x.len(), i), mu, i, own, v));
        for k in 0..3 {
            let entry = own[k] - projected[k];
            worst = worst.max(entry.abs());
            square += entry * entry;
        }
    }
    // `max` ignores NaN.
    if square.is_finite() { (worst, square) } else { (f64::INFINITY, f64::INFINITY) }
}

/// `r_i`.
fn gain(a: &[f64], size: usize, i: usize) -> f64 {
    let diagonal = |k: usize| a[(3 * i + k) * size + 3 * i + k];
    1.0 / diagonal(0).max(diagonal(1)).max(diagonal(2))
}

/// `x - r (v + μ|v_t| e_n)` of contact `i`.
fn shifted(r: f64, mu: f64, i: usize, x: [f64; 3], v: &[f64]) -> [f64; 3] {
    let slip = v[3 * i].hypot(v[3 * i + 1]);
    [x[0] - r * v[3 * i], x[1] - r * v[3 * i + 1], x[2] - r * (v[3 * i + 2] + mu * slip)]
}

/// Sweeps of projections, contact by contact: slow and hard to stop. A start for Newton where everything else stalled.
pub fn sweep(a: &[f64], d: &[f64], mu: &[f64], x: &mut [f64], sweeps: usize) {
    let size = x.len();
    for _ in 0..sweeps {
        for (i, &mu) in mu.iter().enumerate() {
            let own = [x[3 * i], x[3 * i + 1], x[3 * i + 2]];
            let mut v = [d[3 * i], d[3 * i + 1], d[3 * i + 2]];
            for (k, v) in v.iter_mut().enumerate() {
                let row = &a[(3 * i + k) * size..(3 * i + k + 1) * size];
                *v += row.iter().zip(x.iter()).map(|(a, x)| a * x).sum::<f64>();
            }
            let moved = project(mu, shifted(gain(a, size, i), mu, 0, own, &v));
            x[3 * i..3 * i + 3].copy_from_slice(&moved);
        }
    }
}

/// Workspace of the semismooth Newton iteration.
#[derive(Clone, Debug)]
pub struct SemismoothNewton {
    lu: SmallLu,
    jacobian: Vec<f64>,
    change: Vec<f64>,
    trial: Vec<f64>,
    best: Vec<f64>,
    velocity: Vec<f64>,
    trial_velocity: Vec<f64>,
}

impl SemismoothNewton {
    /// Room for `contacts` contacts.
    pub fn new(contacts: usize) -> Self {
        let n = 3 * contacts;
        let vector = || vec![0.0; n];
        Self {
            lu: SmallLu::new(n),
            jacobian: vec![0.0; n * n],
            change: vector(),
            trial: vector(),
            best: vector(),
            velocity: vector(),
            trial_velocity: vector(),
        }
    }

    /// Improves `x`; returns the residual reached and the iterations made.
    pub fn refine(&mut self, a: &[f64], d: &[f64], mu: &[f64], x: &mut [f64]) -> (f64, usize) {
        let mut iterations = 0;
        let mut residual = law_residual(a, d, mu, x, &mut self.velocity[..x.len()]);
        for factor in GAINS {
            if residual <= ENOUGH {
                break;
            }
            self.best[..x.len()].copy_from_slice(x);
            iterations += self.descend(a, d, mu, x, factor);
            let reached = law_residual(a, d, mu, x, &mut self.velocity[..x.len()]);
            if reached < residual {
                residual = reached;
            } else {
                x.copy_from_slice(&self.best[..x.len()]);
            }
        }
        (residual, iterations)
    }

    /// Newton's method with one `r`.
    fn descend(&mut self, a: &[f64], d: &[f64], mu: &[f64], x: &mut [f64], factor: f64) -> usize {
        let size = x.len();
        let (velocity, trial_velocity) = (&mut self.velocity[..size], &mut self.trial_velocity[..size]);
        velocities(a, d, x, velocity);
        let (mut residual, mut square) = natural_residual(a, mu, x, velocity, factor);
        for iteration in 0..MAX_ITERATIONS {
            if residual <= CONVERGED {
                return iteration;
            }
            assemble(a, mu, x, velocity, factor, &mut self.jacobian[..size * size], &mut self.change[..size]);
            if !self.lu.factorise(&self.jacobian, size) {
                return iteration;
            }
            self.lu.solve(&mut self.change[..size]);
            let mut improved = false;
            for fraction in [1.0, 0.5, 0.25, 0.1] {
                let trial = &mut self.trial[..size];
                for ((t, x), c) in trial.iter_mut().zip(x.iter()).zip(&self.change[..size]) {
                    *t = x - fraction * c;
                }
                velocities(a, d, trial, trial_velocity);
                let reached = natural_residual(a, mu, trial, trial_velocity, factor);
                if reached.1 < square {
                    (residual, square) = reached;
                    x.copy_from_slice(trial);
                    velocity.copy_from_slice(trial_velocity);
                    improved = true;
                    break;
                }
            }
            if !improved {
                return iteration + 1;
            }
        }
        MAX_ITERATIONS
    }
}

/// `F'` and `F`.
fn assemble(a: &[f64], mu: &[f64], x: &[f64], v: &[f64], factor: f64, jacobian: &mut [f64], f: &mut [f64]) {
    let size = x.len();
    for (i, &mu) in mu.iter().enumerate() {
        let own = [x[3 * i], x[3 * i + 1], x[3 * i + 2]];
        let r = factor * gain(a, size, i);
        let z = shifted(r, mu, i, own, v);
        let projected = project(mu, z);
        let derivative = project_derivative(mu, z);
        let slip = v[3 * i].hypot(v[3 * i + 1]);
        let lift = if slip > 0.0 { [mu * v[3 * i] / slip, mu * v[3 * i + 1] / slip] } else { [0.0; 2] };
        for c in 0..size {
            let column = |k: usize| a[(3 * i + k) * size + c];
            let mut moved = [
                -r * column(0),
                -r * column(1),
                -r * (column(2) + lift[0] * column(0) + lift[1] * column(1)),
            ];
            if c / 3 == i {
                moved[c % 3] += 1.0;
            }
            for k in 0..3 {
                let row = &derivative[3 * k..3 * k + 3];
                let unit = if c == 3 * i + k { 1.0 } else { 0.0 };
                jacobian[(3 * i + k) * size + c] =
                    unit - row[0] * moved[0] - row[1] * moved[1] - row[2] * moved[2];
            }
        }
        for k in 0..3 {
            f[3 * i + k] = own[k] - projected[k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_projection_is_the_nearest_point_of_the_cone() {
        for (mu, z) in
            [(0.5, [1.0, 2.0, 0.3]), (0.5, [0.1, 0.0, 1.0]), (0.5, [0.1, 0.2, -1.0]), (0.0, [1.0, 0.0, 2.0])]
        {
            let p = project(mu, z);
            assert!(p[0].hypot(p[1]) <= mu * p[2] + 1e-15);
            // Moreau: the rest is in the polar cone and orthogonal.
            let rest = [z[0] - p[0], z[1] - p[1], z[2] - p[2]];
            assert!(mu * rest[0].hypot(rest[1]) <= -rest[2] + 1e-15 || p[2] > 0.0);
            assert!((0..3).map(|k| rest[k] * p[k]).sum::<f64>().abs() < 1e-15);
        }
    }

    #[test]
    fn its_derivative_is_that_of_differences() {
        let (mu, z, h) = (0.7, [0.9, -0.4, 0.2], 1e-6);
        let d = project_derivative(mu, z);
        for c in 0..3 {
            let mut ahead = z;
            let mut behind = z;
            ahead[c] += h;
            behind[c] -= h;
            for r in 0..3 {
                let slope = (project(mu, ahead)[r] - project(mu, behind)[r]) / (2.0 * h);
                assert!((slope - d[3 * r + c]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_sliding_point_is_found_without_lift() {
        // Unit mass, gravity 1, sliding along x: friction is μ, the normal velocity stays 0.
        let a = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let d = [5.0, 0.0, -1.0];
        let mut x = [0.0, 0.0, 1.0];
        let (residual, _) = SemismoothNewton::new(1).refine(&a, &d, &[0.5], &mut x);
        assert!(residual < 1e-13);
        assert!((x[0] + 0.5).abs() < 1e-12 && (x[2] - 1.0).abs() < 1e-12);
    }
}
