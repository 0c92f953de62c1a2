//! Implicit Hermite-Simpson collocation as an integrator: the rival of figure 3.
//!
//! Rates and accelerations are collocated at the start, the middle and the end of a step (the Lobatto IIIA method with three stages, order
//! 4); the dynamics enter by inverse dynamics, without inverting the mass matrix. All but the accelerations `a_m, a_1` is eliminated:
//!
//! ```text
//! v_m = v_0 + h (5 a_0 + 8 a_m - a_1)/24        q_m = q_0 + h v_0/2 + h² (3 a_0 + 4 a_m - a_1)/48
//! v_1 = v_0 + h (a_0 + 4 a_m + a_1)/6           q_1 = q_0 + h v_0 + h² (a_0 + 2 a_m)/6
//! ID(q_m, v_m, a_m) = 0                         ID(q_1, v_1, a_1) = 0
//! ```
//!
//! That is [`Layout::Reduced`]. [`Layout::Full`] keeps `q, v, a` of the middle and the end as `6n` unknowns with `4n` linear and `2n`
//! dynamic equations, as collocation is usually transcribed; Newton's iterates are the same, only the linear systems are larger.
//!
//! `2n` unknowns, as many as the variational Simpson step, analytic derivatives of inverse dynamics, dense LU with pivoting. Start
//! (extrapolation with what it missed before and the trend of that), use of the Jacobian (factors kept over the steps, renewed when
//! the contraction is poor, Broyden's update) and stopping rule are the integrator's own ([`delmpc_mechanics::step`]), so that only the
//! equations differ.
//!
//! Source: J. T. Betts, *Practical Methods for Optimal Control and Estimation Using Nonlinear Programming*, 2nd ed., SIAM 2010, section 4.5;
//! M. Kelly, *An introduction to trajectory optimization*, SIAM Review 59, 2017, section 4; implicit form: the paper, section 5.

use delmpc_mechanics::broyden::Broyden;
use delmpc_mechanics::prelude::KinematicTree;

use crate::articulated_body::ArticulatedBody;
use crate::inverse_dynamics_derivatives::InverseDynamics;
use crate::pivoted_lu::PivotedLu;
use crate::rigid_bodies::RivalError;

const MAX_ITERATIONS: usize = 40;
/// As in the integrator: a small, a stagnating change of angles; contraction that renews.
const SMALL_CHANGE: f64 = 1e-14;
const STAGNATION_CHANGE: f64 = 1e-8;
const RENEW_CONTRACTION: f64 = 0.1;
/// As in the integrator: when old factors give way, for how long, and the safety of a predicted second change.
const FACTOR_ITERATIONS: usize = 2;
const REUSE_PAUSE: u32 = 16;
const SAFETY: f64 = 10.0;
/// `(q, v)` of the middle and the end by `(a_0, a_m, a_1)`.
const Q_BY_A: [[f64; 3]; 2] = [[3.0 / 48.0, 4.0 / 48.0, -1.0 / 48.0], [1.0 / 6.0, 2.0 / 6.0, 0.0]];
const V_BY_A: [[f64; 3]; 2] = [[5.0 / 24.0, 8.0 / 24.0, -1.0 / 24.0], [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0]];
/// Extrapolation of the parabola of accelerations by one step: rows middle and end.
const EXTRAPOLATION: [[f64; 3]; 2] = [[1.0, -3.0, 3.0], [3.0, -8.0, 6.0]];

/// Which unknowns the linear systems keep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Accelerations only: 2n.
    Reduced,
    /// Angles, rates and accelerations: 6n.
    Full,
}

/// A step that does not converge.
#[derive(Clone, Debug, thiserror::Error, PartialEq)]
#[error(
    "Hermite-Simpson step of {time_step} s: change {change:e} rad after {iterations} iterations; take smaller steps"
)]
pub struct NotConverged {
    time_step: f64,
    change: f64,
    iterations: usize,
}

/// The integrator of one tree.
#[derive(Clone, Debug)]
pub struct HermiteSimpson {
    time_step: f64,
    accuracy: f64,
    /// Inverse dynamics at the middle and at the end.
    nodes: [InverseDynamics; 2],
    /// For the acceleration at the very start.
    start: ArticulatedBody,
    layout: Layout,
    lu: PivotedLu,
    /// Right-hand side of the full system.
    full: Vec<f64>,
    /// Angles and rates.
    pub q: Vec<f64>,
    /// See [`Self::q`].
    pub v: Vec<f64>,
    a: Vec<f64>,
    /// `a_m, a_1`.
    unknowns: Vec<f64>,
    direction: Vec<f64>,
    broyden: Broyden,
    node_q: Vec<f64>,
    node_v: Vec<f64>,
    has_previous: bool,
    /// As in the integrator: unknowns as extrapolated, what the last two extrapolations missed, and whether that has a trend.
    extrapolated: Vec<f64>,
    missed: [Vec<f64>; 2],
    known_missed: usize,
    follows_trend: bool,
    /// As in the integrator: factors of an earlier step, what new ones took, and how long to go without old ones.
    factored: bool,
    new_factor_iterations: usize,
    reuse_pause: u32,
    quadratic: f64,
}

impl HermiteSimpson {
    /// For steps of `time_step` (s). The iteration ends when the next change of an angle is predicted below `accuracy`, as in
    /// [`delmpc_mechanics::step::StepOptions::accuracy`].
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(
        tree: &KinematicTree,
        time_step: f64,
        layout: Layout,
        accuracy: f64,
    ) -> Result<Self, RivalError> {
        let n = tree.dof();
        let order = if layout == Layout::Full { 6 * n } else { 2 * n };
        Ok(Self {
            time_step,
            accuracy,
            nodes: [InverseDynamics::new(tree)?, InverseDynamics::new(tree)?],
            start: ArticulatedBody::new(tree)?,
            layout,
            lu: PivotedLu::new(order),
            full: vec![0.0; order],
            q: vec![0.0; n],
            v: vec![0.0; n],
            a: vec![0.0; n],
            unknowns: vec![0.0; 2 * n],
            direction: vec![0.0; 2 * n],
            broyden: Broyden::new(2 * n),
            node_q: vec![0.0; 2 * n],
            node_v: vec![0.0; 2 * n],
            has_previous: false,
            extrapolated: vec![0.0; 2 * n],
            missed: [vec![0.0; 2 * n], vec![0.0; 2 * n]],
            known_missed: 0,
            follows_trend: false,
            factored: false,
            new_factor_iterations: 0,
            reuse_pause: 0,
            quadratic: f64::INFINITY,
        })
    }

    /// At angles and rates.
    pub fn begin(&mut self, q: &[f64], v: &[f64]) {
        self.q.copy_from_slice(q);
        self.v.copy_from_slice(v);
        self.start.acceleration_into(q, v, &mut self.a);
        self.has_previous = false;
        self.known_missed = 0;
        self.factored = false;
    }

    /// One step. No allocation.
    ///
    /// # Errors
    /// [`NotConverged`]; the state is then as before.
    pub fn step(&mut self) -> Result<(), NotConverged> {
        let n = self.q.len();
        let (middle, end) = self.unknowns.split_at_mut(n);
        for i in 0..n {
            // The parabola of the last step; its first acceleration is kept in the place of the middle rates.
            let (a0, am, a1) = (self.node_v[i], middle[i], self.a[i]);
            let next = |row: &[f64; 3]| row[0] * a0 + row[1] * am + row[2] * a1;
            (middle[i], end[i]) =
                if self.has_previous { (next(&EXTRAPOLATION[0]), next(&EXTRAPOLATION[1])) } else { (a1, a1) };
        }
        self.extrapolated.copy_from_slice(&self.unknowns);
        if self.known_missed > 0 {
            for (k, x) in self.unknowns.iter_mut().enumerate() {
                let [last, before] = [self.missed[0][k], self.missed[1][k]];
                *x += if self.follows_trend { 2.0 * last - before } else { last };
            }
        }
        self.newton()?;
        if self.has_previous {
            self.remember_missed();
        }
        let end = &self.unknowns[n..];
        self.q.copy_from_slice(&self.node_q[n..]);
        self.v.copy_from_slice(&self.node_v[n..]);
        for i in 0..n {
            self.node_v[i] = self.a[i];
            self.a[i] = end[i];
        }
        self.has_previous = true;
        Ok(())
    }

    fn remember_missed(&mut self) {
        let (mut without, mut with) = (0.0f64, 0.0f64);
        let [last, before] = &mut self.missed;
        for (k, x) in self.unknowns.iter().enumerate() {
            let missed = x - self.extrapolated[k];
            let change = missed - last[k];
            without = without.max(change.abs());
            with = with.max((change - (last[k] - before[k])).abs());
            (before[k], last[k]) = (last[k], missed);
        }
        self.follows_trend = self.known_missed == 2 && with < without;
        self.known_missed = (self.known_missed + 1).min(2);
    }

    /// Accelerations at the present state, rad/s².
    pub fn acceleration(&self) -> &[f64] {
        &self.a
    }

    /// `q`, `q̇`, `q̈` of the middle and the end of the last step, one after the other.
    pub fn step_nodes(&self) -> [Vec<f64>; 3] {
        let n = self.q.len();
        // The middle of the rates made room for the old accelerations: Hermite's interpolation has it again.
        let (before, middle, end) = (&self.node_v[..n], &self.unknowns[..n], &self.a);
        let h = self.time_step;
        let rate = (0..n).map(|i| self.v[i] - h * (-before[i] + 8.0 * middle[i] + 5.0 * end[i]) / 24.0);
        let mut v: Vec<f64> = rate.collect();
        v.extend_from_slice(&self.v);
        [self.node_q.clone(), v, [middle, end].concat()]
    }

    /// Residuals of both nodes into `direction`.
    fn evaluate(&mut self) {
        let n = self.q.len();
        let h = self.time_step;
        let (middle, end) = self.unknowns.split_at(n);
        for node in 0..2 {
            let (by_q, by_v) = (&Q_BY_A[node], &V_BY_A[node]);
            let c = [0.5, 1.0][node];
            let place = node * n;
            for i in 0..n {
                let (a0, am, a1) = (self.a[i], middle[i], end[i]);
                let mean = |row: &[f64; 3]| row[0] * a0 + row[1] * am + row[2] * a1;
                self.node_q[place + i] = self.q[i] + h * (c * self.v[i] + h * mean(by_q));
                self.node_v[place + i] = self.v[i] + h * mean(by_v);
            }
            self.nodes[node].torque_into(
                &self.node_q[place..place + n],
                &self.node_v[place..place + n],
                &self.unknowns[place..place + n],
                &mut self.direction[place..place + n],
            );
        }
    }

    fn factor(&mut self) -> bool {
        match self.layout {
            Layout::Reduced => self.factor_reduced(),
            Layout::Full => self.factor_full(),
        }
    }

    /// Columns `q_m, v_m, a_m, q_1, v_1, a_1`; rows: Hermite interpolation of `q, v`, dynamics, Simpson's rule of `q, v`, dynamics.
    fn factor_full(&mut self) -> bool {
        let n = self.q.len();
        let h = self.time_step;
        let columns = 6 * n;
        self.lu.matrix.fill(0.0);
        let matrix = &mut self.lu.matrix;
        let mut diagonal = |row: usize, entries: &[(usize, f64)]| {
            for &(column, value) in entries {
                for i in 0..n {
                    matrix[(row * n + i) * columns + column * n + i] = value;
                }
            }
        };
        diagonal(0, &[(0, 1.0), (3, -0.5), (4, h / 8.0)]);
        diagonal(1, &[(1, 1.0), (4, -0.5), (5, h / 8.0)]);
        diagonal(3, &[(3, 1.0), (1, -4.0 * h / 6.0), (4, -h / 6.0)]);
        diagonal(4, &[(4, 1.0), (2, -4.0 * h / 6.0), (5, -h / 6.0)]);
        for node in 0..2 {
            self.nodes[node].differentiate();
            let work = &self.nodes[node];
            for (part, block) in [&work.by_q, &work.by_v, &work.by_a].into_iter().enumerate() {
                for r in 0..n {
                    let place = ((3 * node + 2) * n + r) * columns + (3 * node + part) * n;
                    self.lu.matrix[place..place + n].copy_from_slice(&block[r * n..(r + 1) * n]);
                }
            }
        }
        self.lu.factor()
    }

    /// `direction := J⁻¹ direction`. The linear equations hold at every iterate: their residuals are zero.
    fn solve(&mut self) {
        let n = self.q.len();
        match self.layout {
            Layout::Reduced => self.lu.solve(&mut self.direction),
            Layout::Full => {
                self.full.fill(0.0);
                self.full[2 * n..3 * n].copy_from_slice(&self.direction[..n]);
                self.full[5 * n..].copy_from_slice(&self.direction[n..]);
                self.lu.solve(&mut self.full);
                self.direction[..n].copy_from_slice(&self.full[2 * n..3 * n]);
                self.direction[n..].copy_from_slice(&self.full[5 * n..]);
            }
        }
    }

    fn factor_reduced(&mut self) -> bool {
        let n = self.q.len();
        let h = self.time_step;
        for node in 0..2 {
            self.nodes[node].differentiate();
            let work = &self.nodes[node];
            for unknown in 0..2 {
                let (by_q, by_v) = (h * h * Q_BY_A[node][unknown + 1], h * V_BY_A[node][unknown + 1]);
                let by_a = if node == unknown { 1.0 } else { 0.0 };
                for r in 0..n {
                    let place = (node * n + r) * 2 * n + unknown * n;
                    let row = &mut self.lu.matrix[place..place + n];
                    let range = r * n..(r + 1) * n;
                    let parts = work.by_q[range.clone()].iter().zip(&work.by_v[range.clone()]);
                    for ((x, (q, v)), a) in row.iter_mut().zip(parts).zip(&work.by_a[range]) {
                        *x = by_q * q + by_v * v + by_a * a;
                    }
                }
            }
        }
        self.lu.factor()
    }

    fn newton(&mut self) -> Result<(), NotConverged> {
        let h = self.time_step;
        if self.reuse_pause > 0 || self.new_factor_iterations == 0 {
            self.reuse_pause = self.reuse_pause.saturating_sub(1);
            self.factored = false;
        }
        let old_factors = core::mem::take(&mut self.factored);
        let (mut contracts, mut factorizations) = (old_factors, 0);
        let (mut last, mut last_contraction) = (f64::INFINITY, 0.0f64);
        self.broyden.forget();
        let size = 1.0 + self.q.iter().fold(0.0f64, |m, q| m.max(q.abs()));
        let accuracy = self.accuracy * size;
        for iteration in 0..MAX_ITERATIONS {
            self.evaluate();
            if !contracts {
                if !self.factor() {
                    break;
                }
                factorizations += 1;
                self.broyden.forget();
            }
            self.solve();
            for x in &mut self.direction {
                *x = -*x;
            }
            self.broyden.improve(&mut self.direction);
            let mut largest = 0.0f64;
            for (x, d) in self.unknowns.iter_mut().zip(&self.direction) {
                *x += d;
                largest = largest.max(d.abs());
            }
            // In angles, so that the rule is the integrator's.
            let change = h * h * largest / 3.0;
            if !change.is_finite() {
                break;
            }
            let contraction = change / last;
            let old = old_factors && factorizations == 0;
            let rate = if old { contraction.max(last_contraction) } else { contraction };
            let left = last * last_contraction * last_contraction;
            let hidden = old && iteration > 1 && change < STAGNATION_CHANGE * size;
            let small = if old { accuracy } else { accuracy.max(SMALL_CHANGE * size) };
            let fresh = !old_factors && factorizations == 1;
            if fresh && iteration == 1 {
                self.quadratic = change / (last * last);
            }
            if change <= small
                || (fresh && iteration == 0 && SAFETY * self.quadratic * change * change <= accuracy)
                || (iteration > 0 && change * rate <= accuracy)
                || (hidden && left <= accuracy)
                || (!old && change < STAGNATION_CHANGE * size && contraction > 0.5)
            {
                self.factored = true;
                if !old_factors {
                    if self.known_missed > 0 {
                        self.new_factor_iterations = iteration + 1;
                    }
                } else if factorizations > 0 {
                    self.reuse_pause = REUSE_PAUSE;
                } else if iteration + 1 > self.new_factor_iterations + FACTOR_ITERATIONS {
                    self.reuse_pause = 1;
                }
                self.place_nodes();
                return Ok(());
            }
            contracts = contraction < RENEW_CONTRACTION || iteration == 0;
            (last, last_contraction) = (change, contraction);
        }
        Err(NotConverged { time_step: h, change: last, iterations: MAX_ITERATIONS })
    }

    /// Angles and rates at the nodes; what the last change still moves.
    fn place_nodes(&mut self) {
        let n = self.q.len();
        let h = self.time_step;
        for node in 0..2 {
            let c = [0.5, 1.0][node];
            for i in 0..n {
                let a = [self.a[i], self.unknowns[i], self.unknowns[n + i]];
                let mean = |row: &[f64; 3]| row[0] * a[0] + row[1] * a[1] + row[2] * a[2];
                self.node_q[node * n + i] = self.q[i] + h * (c * self.v[i] + h * mean(&Q_BY_A[node]));
                self.node_v[node * n + i] = self.v[i] + h * mean(&V_BY_A[node]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::articulated_body::tests::tree;
    use crate::pendulum::initial_conditions;
    use crate::runge_kutta::{Adaptive, Pair};

    /// Order 4 on a tree with skew axes.
    #[test]
    fn has_order_four() {
        let tree = tree();
        let start = &initial_conditions(tree.dof(), 1, 0.8, 3)[0];
        let mut reference = Adaptive::new(&tree, Pair::Fehlberg78, 1e-14).unwrap();
        reference.run(&start.q, &start.v, 0.4).unwrap();
        let error = |steps: usize, layout: Layout| {
            let mut work = HermiteSimpson::new(&tree, 0.4 / steps as f64, layout, 1e-16).unwrap();
            work.begin(&start.q, &start.v);
            for _ in 0..steps {
                work.step().unwrap();
            }
            let off = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs()));
            off(&work.q, reference.q())
        };
        for layout in [Layout::Reduced, Layout::Full] {
            let (coarse, fine) = (error(40, layout), error(80, layout));
            let order = (coarse / fine).log2();
            assert!((3.8..4.2).contains(&order), "{layout:?} {order}: {coarse:e} {fine:e}");
        }
    }
}
