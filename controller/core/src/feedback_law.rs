//! The feedback law a command carries to the servo: a piece of the plan, a gain, and bounds.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `u`, `K` | torque at the reference, gain on `(q, q̇)` | N·m, N·m/rad, N·m·s/rad |
//! | `x_ref(t)` | reference state, moving at constant acceleration | rad, rad/s |
//! | `[u_lower, u_upper]` | bounds | N·m |
//!
//! ```text
//! u(t) = clamp(u + K (x - x_ref(t)), u_lower, u_upper)
//! ```
//!
//! (N, N/m and so on for prismatic joints.) All but `K` goes by segments, one for a stage of the plan. The first one is meant for the
//! time up to the next command. The others are for the case that it is late: a torque that is right for a stage of 5 ms, held for 20,
//! throws the robot up. `K` is that of the first stage throughout.
//!
//! Source: own formulation; the gain is that of the Riccati recursion ([`delmpc_lq::riccati`]). Sending the rest of the plan along against
//! lost and late commands: D. Quevedo, D. Nešić, *Robust stability of packetized predictive control*, Automatica 48, 2012.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_messages::{Command, ConstraintKind, MAX_JOINTS, MAX_SEGMENTS};
use faer::{Mat, MatRef};
use nalgebra::Vector3;

use crate::horizon_problem::HorizonProblem;
use delmpc_lq::kernels::gemv;
use delmpc_lq::trajectory::Trajectory;

/// One segment of a [`Law`]. The reference is that of the moment it begins, from where it moves at constant acceleration.
#[derive(Clone, Debug)]
pub(crate) struct LawSegment {
    /// After the law began, s.
    pub begin_s: f64,
    pub torque: Vec<f64>,
    pub lower: Vec<f64>,
    pub upper: Vec<f64>,
    pub reference: Vec<f64>,
    pub acceleration: Vec<f64>,
}

impl LawSegment {
    fn new(n: usize) -> Self {
        let (lower, upper) = (vec![0.0; n], vec![0.0; n]);
        let (reference, acceleration) = (vec![0.0; 2 * n], vec![0.0; n]);
        Self { begin_s: 0.0, torque: vec![0.0; n], lower, upper, reference, acceleration }
    }

    fn copy_from(&mut self, other: &Self) {
        self.begin_s = other.begin_s;
        self.torque.copy_from_slice(&other.torque);
        self.lower.copy_from_slice(&other.lower);
        self.upper.copy_from_slice(&other.upper);
        self.reference.copy_from_slice(&other.reference);
        self.acceleration.copy_from_slice(&other.acceleration);
    }

    /// Brings the torque between the bounds.
    pub fn clamp(&mut self) {
        for ((u, lower), upper) in self.torque.iter_mut().zip(&self.lower).zip(&self.upper) {
            *u = u.max(*lower).min(*upper);
        }
    }
}

/// A law the command can carry: `u = torque + gain (x - reference)` between bounds, in the order of the tree.
#[derive(Clone, Debug)]
pub(crate) struct Law {
    segments: Vec<LawSegment>,
    used: usize,
    pub gain: Mat<f64>,
}

impl Law {
    /// Of one segment of zeros.
    pub fn new(n: usize) -> Self {
        Self { segments: vec![LawSegment::new(n); MAX_SEGMENTS], used: 1, gain: Mat::zeros(n, 2 * n) }
    }

    /// Copies a law of the same size.
    pub fn copy_from(&mut self, other: &Self) {
        self.used = other.used;
        for (segment, from) in self.segments.iter_mut().zip(other.segments()) {
            segment.copy_from(from);
        }
        self.gain.copy_from(&other.gain);
    }

    /// The segments in use, in the order of time.
    pub fn segments(&self) -> &[LawSegment] {
        &self.segments[..self.used]
    }

    /// The segments in use, to write.
    pub fn segments_mut(&mut self) -> &mut [LawSegment] {
        &mut self.segments[..self.used]
    }

    /// The segments in use, to write, and the gain.
    pub fn segments_and_gain(&mut self) -> (&mut [LawSegment], MatRef<'_, f64>) {
        (&mut self.segments[..self.used], self.gain.as_ref())
    }

    /// Leaves the first segment only, and hands it out.
    pub fn restart(&mut self) -> &mut LawSegment {
        self.used = 1;
        self.segments[0].begin_s = 0.0;
        self.segments[0].acceleration.fill(0.0);
        &mut self.segments[0]
    }

    /// The first segment.
    pub fn first(&self) -> &LawSegment {
        &self.segments[0]
    }

    /// One segment more, with what was in it before; `None` when there is no room.
    pub fn append(&mut self, begin_s: f64) -> Option<&mut LawSegment> {
        let segment = self.segments.get_mut(self.used)?;
        self.used += 1;
        segment.begin_s = begin_s;
        Some(segment)
    }

    /// The torque at the state `x`, `elapsed_s` after the law began.
    pub fn torque_at(&self, elapsed_s: f64, x: &[f64], error: &mut [f64], torque: &mut [f64]) {
        // Times are sums of periods: round-off must not decide.
        let begun = self.segments().iter().take_while(|segment| segment.begin_s <= elapsed_s + 1e-9).last();
        let segment = begun.unwrap_or(&self.segments[0]);
        let elapsed_s = (elapsed_s - segment.begin_s).max(0.0);
        let n = segment.torque.len();
        for ((e, x), r) in error.iter_mut().zip(x).zip(&segment.reference) {
            *e = x - r;
        }
        for j in 0..n {
            let change = elapsed_s * segment.acceleration[j];
            error[j] -= elapsed_s * (segment.reference[n + j] + 0.5 * change);
            error[n + j] -= change;
        }
        torque.copy_from_slice(&segment.torque);
        gemv(torque, faer::Accum::Add, self.gain.as_ref(), error, 1.0);
        for ((u, lower), upper) in torque.iter_mut().zip(&segment.lower).zip(&segment.upper) {
            *u = u.max(*lower).min(*upper);
        }
    }
}

/// The laws of the last commands: those that are in force between a measurement and the time the answer to it takes effect.
#[derive(Clone, Debug)]
pub(crate) struct LawHistory {
    /// When each took effect, s of the run, and the law.
    laws: Vec<(f64, Law)>,
    latest: usize,
}

impl LawHistory {
    /// Of `n` joints, for answers that take `delay_s` where a new law comes every `period_s`.
    pub fn new(n: usize, delay_s: f64, period_s: f64) -> Self {
        let count = libm::ceil(delay_s / period_s).clamp(0.0, 64.0) as usize + 2;
        Self { laws: vec![(f64::INFINITY, Law::new(n)); count], latest: 0 }
    }

    /// Takes a law in, in place of the oldest one.
    pub fn push(&mut self, from_s: f64, law: &Law) {
        self.latest = (self.latest + 1) % self.laws.len();
        let (from, stored) = &mut self.laws[self.latest];
        *from = from_s;
        stored.copy_from(law);
    }

    /// The law in force at a time, and how long it has been; before all of them the oldest one.
    pub fn at(&self, time_s: f64) -> (f64, &Law) {
        let count = self.laws.len();
        let newest_first = (0..count).map(|age| &self.laws[(self.latest + count - age) % count]);
        let mut found = &self.laws[self.latest];
        for law in newest_first.filter(|(from_s, _)| from_s.is_finite()) {
            found = law;
            // Times are sums of periods: round-off must not decide.
            if law.0 <= time_s + 1e-9 {
                break;
            }
        }
        ((time_s - found.0).max(0.0), &found.1)
    }
}

/// Keeps what the feedback adds between two cycles from driving the pressure point over the edge of the sole.
///
/// A row `e'y <= bound` of the pressure point has a slack in the plan; the joint that moves it most, an ankle, may use up that
/// slack and no more. A push acts on the state, not on the torque of the ankle, so this holds while the robot is being pushed.
///
/// What a push does change is the force `f` that the foot transmits: by `δf` from the planned one, as measured. With the foot at
/// rest and the torque of the ankle given, at a point `p` of its axis, the moment about the sole's origin changes by `p × δf`. Where
/// that and `δf` itself take up slack, the torque has to make room for it, the planned one too.
pub(crate) fn bound_by_pressure_point(
    horizon: &HorizonProblem,
    index: usize,
    solution: &Trajectory,
    force_change: &Vector3<f64>,
    law: &mut LawSegment,
) {
    let problem = &horizon.problem;
    let stage = &problem.stages[index];
    let (u, x) = (solution.u(index), solution.x(index));
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    for (row, bound) in problem
        .output_rows
        .iter()
        .zip(&stage.row_bounds)
        .filter(|(row, _)| row.tag.label == ConstraintKind::CentreOfPressure as u32)
    {
        let value: f64 = (row.coefficients.iter().enumerate())
            .map(|(output, coefficient)| {
                let (by_input, by_state, constant) = stage.output(output);
                coefficient * (dot(by_input, u) + dot(by_state, x) + constant)
            })
            .sum();
        let by_torque = |j: usize| -> f64 {
            row.coefficients.iter().enumerate().map(|(output, c)| c * stage.output(output).0[j]).sum()
        };
        let largest =
            (0..law.torque.len()).map(|j| (j, by_torque(j))).max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
        if let Some((j, by_torque)) = largest.filter(|(_, by_torque)| by_torque.abs() > f64::EPSILON) {
            let moment_change = horizon.axis_point(index, j).cross(force_change);
            let change: f64 = (row.coefficients.iter())
                .zip(moment_change.iter().chain(force_change.iter()))
                .map(|(coefficient, change)| coefficient * change)
                .sum();
            // A plan that gives way itself is not cut further than the force asks.
            let room = ((bound - value).max(0.0) - change.max(0.0)) / by_torque;
            let (planned, lower, upper) = (law.torque[j], &mut law.lower[j], &mut law.upper[j]);
            if by_torque > 0.0 {
                *upper = upper.min(planned + room).max(*lower);
            } else {
                *lower = lower.max(planned + room).min(*upper);
            }
        }
    }
}

/// Writes a law in the order of the messages.
pub(crate) fn write_law(law: &Law, message_joint: &[usize], command: &mut Command) {
    let n = message_joint.len();
    command.n_segments = law.segments().len() as u32;
    for (segment, out) in law.segments().iter().zip(&mut command.segments) {
        out.begin_ns = libm::round(segment.begin_s * 1e9) as u64;
        for (i, &joint) in message_joint.iter().enumerate() {
            out.torque[joint] = segment.torque[i];
            out.torque_lower[joint] = segment.lower[i];
            out.torque_upper[joint] = segment.upper[i];
            out.position_ref[joint] = segment.reference[i];
            out.velocity_ref[joint] = segment.reference[n + i];
            out.acceleration_ref[joint] = segment.acceleration[i];
        }
    }
    for (i, &joint) in message_joint.iter().enumerate() {
        for (j, &column) in message_joint.iter().enumerate() {
            command.gain[joint][column] = law.gain[(i, j)];
            command.gain[joint][MAX_JOINTS + column] = law.gain[(i, n + j)];
        }
    }
}

#[cfg(test)]
mod tests {
    use delmpc_messages::ServoReadings;

    use super::*;

    #[test]
    fn the_law_in_force_is_the_one_that_began_last() {
        let mut history = LawHistory::new(1, 0.015, 0.005);
        let mut law = Law::new(1);
        for k in 0..9 {
            law.restart().torque[0] = f64::from(k);
            history.push(0.005 * f64::from(k), &law);
        }
        let at = |time_s: f64| history.at(time_s).1.first().torque[0];
        assert_eq!([at(0.0401), at(0.04), at(0.0399), at(0.0351), at(0.0301)], [8.0, 8.0, 7.0, 7.0, 6.0]);
        assert!((history.at(0.0375).0 - 0.0025).abs() < 1e-12);
        // Older than all that are kept: the oldest.
        assert_eq!(at(0.0), 4.0);
    }

    #[test]
    fn a_history_that_is_not_full_yet_knows_its_laws() {
        let mut history = LawHistory::new(1, 0.005, 0.005);
        let mut law = Law::new(1);
        law.restart().torque[0] = 3.0;
        history.push(1.0, &law);
        assert_eq!(history.at(0.5).1.first().torque[0], 3.0);
        assert_eq!(history.at(1.5).1.first().torque[0], 3.0);
    }

    #[test]
    fn a_law_goes_by_segments_and_says_the_same_as_its_message() {
        let n = 2;
        let mut law = Law::new(n);
        for k in 0..3 {
            let segment = match k {
                0 => law.restart(),
                _ => law.append(0.01 * f64::from(k)).unwrap(),
            };
            segment.torque.fill(1.0 + f64::from(k));
            segment.lower.fill(-4.0);
            segment.upper.fill(4.0);
            for (i, r) in segment.reference.iter_mut().enumerate() {
                *r = 0.1 * f64::from(k) - 0.2 * i as f64;
            }
            segment.acceleration.fill(3.0 - f64::from(k));
        }
        for i in 0..n {
            for j in 0..2 * n {
                law.gain[(i, j)] = 1.0 + i as f64 - 0.4 * j as f64;
            }
        }
        let mut command = Command::new(1, 2, n as u32);
        command.valid_until_ns = 100_000_000;
        write_law(&law, &[1, 0], &mut command);
        assert_eq!(command.validate(2, n), Ok(()));
        let (x, mut error, mut torque) = ([0.3, -0.1, 0.2, 0.4], [0.0; 4], [0.0; 2]);
        for ms in [0, 3, 9, 10, 15, 20, 60] {
            law.torque_at(1e-3 * f64::from(ms), &x, &mut error, &mut torque);
            let mut message = [0.0; 2];
            let (position, velocity) = ([x[1], x[0]], [x[3], x[2]]);
            let readings = ServoReadings::joints(&position, &velocity);
            command.torque_into(1_000_000 * ms as u64, &readings, &mut message).unwrap();
            let difference = (torque[0] - message[1]).abs() + (torque[1] - message[0]).abs();
            assert!(difference < 1e-12, "{ms} ms: {torque:?} and {message:?}");
        }
        assert!((3..MAX_SEGMENTS).all(|k| law.append(0.1 * k as f64).is_some()));
        assert!(law.append(9.0).is_none());
    }
}
