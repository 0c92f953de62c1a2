//! Explicit and Gauss-Legendre Runge-Kutta methods on `q̈` by articulated bodies: the rivals beyond the paper.
//!
//! | method | order | steps | source |
//! |---|---|---|---|
//! | RK4 | 4 | fixed | W. Kutta, Z. Math. Phys. 46, 1901 |
//! | Dormand-Prince 5(4) | 5 | adaptive | J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6, 1980 |
//! | Runge-Kutta-Fehlberg 7(8) | 8 | adaptive | E. Fehlberg, NASA TR R-287, 1968, table X |
//! | Gauss-Legendre, two stages | 4 | fixed | E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed., section II.1 |
//!
//! The adaptive ones continue with the higher order (local extrapolation). Step control: PI controller on the error relative to
//! `tol (1 + |y|)`, root mean square; E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations I*, 2nd ed., sections II.4
//! and IV.2. The Gauss-Legendre stages are solved by fixed-point iteration from the polynomial of the last step, to a given
//! accuracy or round-off.

use delmpc_mechanics::prelude::KinematicTree;

use crate::articulated_body::ArticulatedBody;
use crate::rigid_bodies::{RivalError, vectorized};

/// An embedded pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pair {
    /// Dormand-Prince 5(4).
    DormandPrince54,
    /// Runge-Kutta-Fehlberg 7(8).
    Fehlberg78,
}

/// Coefficients: rows of `A`, weights of the solution, weights of its error estimate.
struct Tableau {
    a: &'static [&'static [f64]],
    b: &'static [f64],
    e: &'static [f64],
    /// The last stage is the first one of the next step.
    reuses_last: bool,
    /// Order of the error estimate plus one.
    exponent: f64,
}

static DORMAND_PRINCE: Tableau = Tableau {
    a: &[
        &[],
        &[1.0 / 5.0],
        &[3.0 / 40.0, 9.0 / 40.0],
        &[44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0],
        &[19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0],
        &[9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0],
        &[35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
    ],
    b: &[35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0, 0.0],
    e: &[
        71.0 / 57600.0,
        0.0,
        -71.0 / 16695.0,
        71.0 / 1920.0,
        -17253.0 / 339_200.0,
        22.0 / 525.0,
        -1.0 / 40.0,
    ],
    reuses_last: true,
    exponent: 5.0,
};

static FEHLBERG: Tableau = Tableau {
    a: &[
        &[],
        &[2.0 / 27.0],
        &[1.0 / 36.0, 1.0 / 12.0],
        &[1.0 / 24.0, 0.0, 1.0 / 8.0],
        &[5.0 / 12.0, 0.0, -25.0 / 16.0, 25.0 / 16.0],
        &[1.0 / 20.0, 0.0, 0.0, 1.0 / 4.0, 1.0 / 5.0],
        &[-25.0 / 108.0, 0.0, 0.0, 125.0 / 108.0, -65.0 / 27.0, 125.0 / 54.0],
        &[31.0 / 300.0, 0.0, 0.0, 0.0, 61.0 / 225.0, -2.0 / 9.0, 13.0 / 900.0],
        &[2.0, 0.0, 0.0, -53.0 / 6.0, 704.0 / 45.0, -107.0 / 9.0, 67.0 / 90.0, 3.0],
        &[
            -91.0 / 108.0,
            0.0,
            0.0,
            23.0 / 108.0,
            -976.0 / 135.0,
            311.0 / 54.0,
            -19.0 / 60.0,
            17.0 / 6.0,
            -1.0 / 12.0,
        ],
        &[
            2383.0 / 4100.0,
            0.0,
            0.0,
            -341.0 / 164.0,
            4496.0 / 1025.0,
            -301.0 / 82.0,
            2133.0 / 4100.0,
            45.0 / 82.0,
            45.0 / 164.0,
            18.0 / 41.0,
        ],
        &[
            3.0 / 205.0,
            0.0,
            0.0,
            0.0,
            0.0,
            -6.0 / 41.0,
            -3.0 / 205.0,
            -3.0 / 41.0,
            3.0 / 41.0,
            6.0 / 41.0,
            0.0,
        ],
        &[
            -1777.0 / 4100.0,
            0.0,
            0.0,
            -341.0 / 164.0,
            4496.0 / 1025.0,
            -289.0 / 82.0,
            2193.0 / 4100.0,
            51.0 / 82.0,
            33.0 / 164.0,
            12.0 / 41.0,
            0.0,
            1.0,
        ],
    ],
    b: &[
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        34.0 / 105.0,
        9.0 / 35.0,
        9.0 / 35.0,
        9.0 / 280.0,
        9.0 / 280.0,
        0.0,
        41.0 / 840.0,
        41.0 / 840.0,
    ],
    e: &[
        41.0 / 840.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
        41.0 / 840.0,
        -41.0 / 840.0,
        -41.0 / 840.0,
    ],
    reuses_last: false,
    exponent: 8.0,
};

static RK4: Tableau = Tableau {
    a: &[&[], &[0.5], &[0.0, 0.5], &[0.0, 0.0, 1.0]],
    b: &[1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0],
    e: &[],
    reuses_last: false,
    exponent: 5.0,
};

/// The right-hand side and the stages `(q̇, q̈)` of an explicit method; the state is `(q, q̇)` in one vector.
#[derive(Clone, Debug)]
struct Stages {
    bodies: ArticulatedBody,
    arch: pulp::Arch,
    state: Vec<f64>,
    next: Vec<f64>,
    slopes: Vec<Vec<f64>>,
}

impl Stages {
    fn new(tree: &KinematicTree, count: usize) -> Result<Self, RivalError> {
        let order = 2 * tree.dof();
        Ok(Self {
            bodies: ArticulatedBody::new(tree)?,
            arch: pulp::Arch::new(),
            state: vec![0.0; order],
            next: vec![0.0; order],
            slopes: vec![vec![0.0; order]; count],
        })
    }

    fn begin(&mut self, q: &[f64], v: &[f64]) {
        self.state[..q.len()].copy_from_slice(q);
        self.state[q.len()..].copy_from_slice(v);
    }

    /// Slope of `next` into stage `k`.
    fn slope(&mut self, k: usize) {
        let n = self.next.len() / 2;
        let (q, v) = self.next.split_at(n);
        let (rate, acceleration) = self.slopes[k].split_at_mut(n);
        rate.copy_from_slice(v);
        self.bodies.acceleration_into(q, v, acceleration);
    }

    /// `next := state + h Σ weights slopes`.
    fn combine(&mut self, h: f64, weights: &[f64]) {
        vectorized!(self.arch, (), (
            next: &'a mut [f64] = &mut self.next, state: &'a [f64] = &self.state, slopes: &'a [Vec<f64>] = &self.slopes,
            h: f64 = h, weights: &'a [f64] = weights
        ) => {
            next.copy_from_slice(state);
            for (weight, slope) in weights.iter().zip(slopes) {
                if *weight != 0.0 {
                    let factor = h * weight;
                    for (x, k) in next.iter_mut().zip(slope) {
                        *x = factor.mul_add(*k, *x);
                    }
                }
            }
        });
    }

    /// All stages; the solution is then in `next`. `first_known`: stage 0 is up to date.
    fn explicit_step(&mut self, tableau: &Tableau, h: f64, first_known: bool) {
        for (k, row) in tableau.a.iter().enumerate() {
            if k == 0 && first_known {
                continue;
            }
            self.combine(h, row);
            self.slope(k);
        }
        self.combine(h, tableau.b);
    }
}

/// RK4 with fixed steps.
#[derive(Clone, Debug)]
pub struct ClassicalRk4 {
    stages: Stages,
    time_step: f64,
}

impl ClassicalRk4 {
    /// For steps of `time_step` (s).
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree, time_step: f64) -> Result<Self, RivalError> {
        Ok(Self { stages: Stages::new(tree, 4)?, time_step })
    }

    /// At angles and rates.
    pub fn begin(&mut self, q: &[f64], v: &[f64]) {
        self.stages.begin(q, v);
    }

    /// One step. No allocation.
    pub fn step(&mut self) {
        self.stages.explicit_step(&RK4, self.time_step, false);
        core::mem::swap(&mut self.stages.state, &mut self.stages.next);
    }

    /// Angles.
    pub fn q(&self) -> &[f64] {
        &self.stages.state[..self.stages.state.len() / 2]
    }

    /// Rates.
    pub fn v(&self) -> &[f64] {
        &self.stages.state[self.stages.state.len() / 2..]
    }
}

/// The step control gave up.
#[derive(Clone, Debug, thiserror::Error, PartialEq)]
#[error("the adaptive step fell to {time_step:e} s at {time} s; take a larger tolerance")]
pub struct StepTooSmall {
    time_step: f64,
    time: f64,
}

/// An embedded pair with step control.
#[derive(Clone, Debug)]
pub struct Adaptive {
    stages: Stages,
    pair: Pair,
    tolerance: f64,
    error: Vec<f64>,
}

impl Adaptive {
    /// With a tolerance per step, relative to `1 + |y|`.
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree, pair: Pair, tolerance: f64) -> Result<Self, RivalError> {
        let count = tableau(pair).a.len();
        Ok(Self { stages: Stages::new(tree, count)?, pair, tolerance, error: vec![0.0; 2 * tree.dof()] })
    }

    /// From angles and rates over `duration` (s). No allocation.
    ///
    /// # Errors
    /// [`StepTooSmall`] when the control gives up.
    pub fn run(&mut self, q: &[f64], v: &[f64], duration: f64) -> Result<(), StepTooSmall> {
        let method = tableau(self.pair);
        let stages = &mut self.stages;
        stages.begin(q, v);
        // A first step that any of the tolerances accepts or soon corrects.
        let mut h = (0.05 * self.tolerance.powf(1.0 / method.exponent)).min(duration);
        let (mut time, mut last_error, mut first_known) = (0.0f64, 1e-4f64, false);
        while duration - time > 1e-13 * duration {
            h = h.min(duration - time);
            stages.explicit_step(method, h, first_known);
            let error = self.tolerance.recip() * estimate(stages, method, h, &mut self.error);
            // PI controller, exponents 0.7/p and 0.4/p.
            let raw = 0.9 * error.max(1e-10).powf(-0.7 / method.exponent);
            if error <= 1.0 {
                time += h;
                core::mem::swap(&mut stages.state, &mut stages.next);
                if method.reuses_last {
                    let last = method.a.len() - 1;
                    stages.slopes.swap(0, last);
                    first_known = true;
                } else {
                    first_known = false;
                }
                h *= (raw * last_error.powf(0.4 / method.exponent)).clamp(0.2, 5.0);
                last_error = error.max(1e-4);
            } else {
                // Stage 0 stays: the state has not moved.
                first_known = true;
                h *= (0.9 * error.powf(-1.0 / method.exponent)).clamp(0.1, 0.9);
                if h.is_nan() || h < 1e-12 * duration {
                    return Err(StepTooSmall { time_step: h, time });
                }
            }
        }
        Ok(())
    }

    /// Angles.
    pub fn q(&self) -> &[f64] {
        &self.stages.state[..self.stages.state.len() / 2]
    }
}

fn tableau(pair: Pair) -> &'static Tableau {
    match pair {
        Pair::DormandPrince54 => &DORMAND_PRINCE,
        Pair::Fehlberg78 => &FEHLBERG,
    }
}

/// Root mean square of the error estimate relative to `1 + |y|`.
fn estimate(stages: &Stages, tableau: &Tableau, h: f64, error: &mut [f64]) -> f64 {
    error.fill(0.0);
    for (weight, slope) in tableau.e.iter().zip(&stages.slopes) {
        if *weight != 0.0 {
            for (e, k) in error.iter_mut().zip(slope) {
                *e += h * weight * k;
            }
        }
    }
    let square: f64 = error
        .iter()
        .zip(stages.state.iter().zip(&stages.next))
        .map(|(e, (a, b))| (e / (1.0 + a.abs().max(b.abs()))).powi(2))
        .sum();
    (square / error.len() as f64).sqrt()
}

/// Gauss-Legendre with two stages and fixed steps.
#[derive(Clone, Debug)]
pub struct GaussLegendre4 {
    bodies: ArticulatedBody,
    time_step: f64,
    accuracy: f64,
    q: Vec<f64>,
    v: Vec<f64>,
    /// Accelerations of the stages.
    slopes: [Vec<f64>; 2],
    fresh: [Vec<f64>; 2],
    stage: [Vec<f64>; 2],
    has_previous: bool,
}

const MAX_FIXED_POINT: usize = 60;

impl GaussLegendre4 {
    /// For steps of `time_step` (s); the iteration ends when the change of an angle is below `accuracy` (rad).
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree, time_step: f64, accuracy: f64) -> Result<Self, RivalError> {
        let zero = vec![0.0; tree.dof()];
        let pair = || [zero.clone(), zero.clone()];
        Ok(Self {
            bodies: ArticulatedBody::new(tree)?,
            time_step,
            accuracy,
            q: zero.clone(),
            v: zero.clone(),
            slopes: pair(),
            fresh: pair(),
            stage: pair(),
            has_previous: false,
        })
    }

    /// At angles and rates.
    pub fn begin(&mut self, q: &[f64], v: &[f64]) {
        self.q.copy_from_slice(q);
        self.v.copy_from_slice(v);
        self.has_previous = false;
    }

    /// One step; returns whether the stages converged (after a fixed number of iterations the step is taken as it is). No
    /// allocation.
    pub fn step(&mut self) -> bool {
        let (h, n) = (self.time_step, self.q.len());
        let root = 3f64.sqrt();
        let a = [[0.25, 0.25 - root / 6.0], [0.25 + root / 6.0, 0.25]];
        // Positions by accelerations: the square of A; c = A 1.
        let aa: [[f64; 2]; 2] =
            core::array::from_fn(|r| core::array::from_fn(|c| a[r][0] * a[0][c] + a[r][1] * a[1][c]));
        let c = [0.5 - root / 6.0, 0.5 + root / 6.0];
        if self.has_previous {
            // The line through the accelerations of the last step, one step on.
            for i in 0..n {
                let (first, second) = (self.slopes[0][i], self.slopes[1][i]);
                let slope = (second - first) / (c[1] - c[0]);
                self.slopes[0][i] = first + slope;
                self.slopes[1][i] = second + slope;
            }
        } else {
            self.bodies.acceleration_into(&self.q, &self.v, &mut self.slopes[0]);
            let (first, second) = self.slopes.split_at_mut(1);
            second[0].copy_from_slice(&first[0]);
        }
        self.has_previous = true;
        let mut last = f64::INFINITY;
        let mut converged = false;
        for _ in 0..MAX_FIXED_POINT {
            for k in 0..2 {
                for i in 0..n {
                    let (first, second) = (self.slopes[0][i], self.slopes[1][i]);
                    let bend = aa[k][0] * first + aa[k][1] * second;
                    self.stage[0][i] = self.q[i] + h * (c[k] * self.v[i] + h * bend);
                    self.stage[1][i] = self.v[i] + h * (a[k][0] * first + a[k][1] * second);
                }
                self.bodies.acceleration_into(&self.stage[0], &self.stage[1], &mut self.fresh[k]);
            }
            let mut change = 0.0f64;
            for (old, new) in self.slopes.iter_mut().zip(&self.fresh) {
                for (x, y) in old.iter_mut().zip(new) {
                    change = change.max((*x - y).abs());
                    *x = *y;
                }
            }
            // Done: the change of an angle is small enough, or small and no longer shrinks (round-off).
            let small = h * change;
            if h * small <= self.accuracy || (small < 1e-11 && change > 0.5 * last) {
                converged = true;
                break;
            }
            last = change;
        }
        // Positions: bᵀA = (1/2 - c b) for this symmetric method.
        let b = [0.5 * (a[0][0] + a[1][0]), 0.5 * (a[0][1] + a[1][1])];
        for i in 0..n {
            let (first, second) = (self.slopes[0][i], self.slopes[1][i]);
            self.q[i] += h * (self.v[i] + h * (b[0] * first + b[1] * second));
            self.v[i] += 0.5 * h * (first + second);
        }
        converged
    }

    /// Angles.
    pub fn q(&self) -> &[f64] {
        &self.q
    }

    /// Rates.
    pub fn v(&self) -> &[f64] {
        &self.v
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::articulated_body::tests::tree;
    use crate::pendulum::initial_conditions;

    fn off(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs()))
    }

    /// Row sums of `A` by quadrature conditions: `Σ b c^k = 1/(k+1)` up to the order, and zero for the error estimate.
    #[test]
    fn tableaus_satisfy_the_quadrature_conditions() {
        for (tableau, order, estimate) in [(&RK4, 4, 0), (&DORMAND_PRINCE, 5, 4), (&FEHLBERG, 8, 7)] {
            let c: Vec<f64> = tableau.a.iter().map(|row| row.iter().sum()).collect();
            let moment = |weights: &[f64], k: i32| -> f64 {
                weights.iter().zip(&c).map(|(w, c)| w * if k == 0 { 1.0 } else { c.powi(k) }).sum()
            };
            for k in 0..order {
                assert!((moment(tableau.b, k) - 1.0 / f64::from(k + 1)).abs() < 1e-14, "{order} {k}");
            }
            for k in 0..estimate {
                assert!(moment(tableau.e, k).abs() < 1e-14, "{order} {k}");
            }
        }
    }

    #[test]
    fn fixed_steps_have_order_four() {
        let tree = tree();
        let start = &initial_conditions(tree.dof(), 1, 0.8, 3)[0];
        let mut reference = Adaptive::new(&tree, Pair::Fehlberg78, 1e-14).unwrap();
        reference.run(&start.q, &start.v, 0.4).unwrap();
        let rk4 = |steps: usize| {
            let mut work = ClassicalRk4::new(&tree, 0.4 / steps as f64).unwrap();
            work.begin(&start.q, &start.v);
            (0..steps).for_each(|_| work.step());
            off(work.q(), reference.q())
        };
        let gauss = |steps: usize| {
            let mut work = GaussLegendre4::new(&tree, 0.4 / steps as f64, 1e-18).unwrap();
            work.begin(&start.q, &start.v);
            assert!((0..steps).all(|_| work.step()));
            off(work.q(), reference.q())
        };
        for (coarse, fine) in [(rk4(60), rk4(120)), (gauss(60), gauss(120))] {
            let order = (coarse / fine).log2();
            assert!((3.8..4.2).contains(&order), "{order}: {coarse:e} {fine:e}");
        }
    }

    /// The error follows the tolerance, and the pairs agree with each other.
    #[test]
    fn adaptive_pairs_keep_their_tolerance() {
        let tree = tree();
        let start = &initial_conditions(tree.dof(), 1, 0.8, 3)[0];
        let mut reference = Adaptive::new(&tree, Pair::Fehlberg78, 1e-14).unwrap();
        reference.run(&start.q, &start.v, 0.4).unwrap();
        for pair in [Pair::DormandPrince54, Pair::Fehlberg78] {
            for tolerance in [1e-6, 1e-9] {
                let mut work = Adaptive::new(&tree, pair, tolerance).unwrap();
                work.run(&start.q, &start.v, 0.4).unwrap();
                let error = off(work.q(), reference.q());
                assert!(error < 1e2 * tolerance, "{pair:?} {tolerance:e}: {error:e}");
            }
        }
    }
}
