//! A plan: nodes and inputs over the horizon at absolute times, read at any time.
//!
//! Between nodes the state is the cubic Hermite polynomial through positions and rates at both ends (error O(Δt⁴) in `q`); beyond
//! the end it goes on at the last rate. Inputs are held over their stage; over a span they are averaged.

use alloc::vec::Vec;

use delmpc_lq::trajectory::Trajectory;

/// Nominal states `(q, q̇)` and inputs, with the stage lengths.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Values.
    pub values: Trajectory,
    /// Time of the first node, s of the run.
    pub start_s: f64,
    /// Node times after the first, from 0, one more than stages, s.
    offsets: Vec<f64>,
}

impl Plan {
    /// An empty plan over stages of these lengths.
    pub fn new(values: Trajectory, lengths: &[f64]) -> Self {
        let mut offsets = Vec::with_capacity(lengths.len() + 1);
        let mut at = 0.0;
        offsets.push(at);
        for length in lengths {
            at += length;
            offsets.push(at);
        }
        Self { values, start_s: 0.0, offsets }
    }

    /// Node times after the first node, s.
    pub fn offsets(&self) -> &[f64] {
        &self.offsets
    }

    /// Length of the horizon, s.
    pub fn horizon_s(&self) -> f64 {
        self.offsets.last().copied().unwrap_or(0.0)
    }

    /// Stage that a time (s of the run) lies in, clamped to the horizon.
    pub fn stage_at(&self, time_s: f64) -> usize {
        self.stage_after(time_s - self.start_s)
    }

    /// Stage at a time after the first node (s), clamped to the horizon.
    pub fn stage_after(&self, t: f64) -> usize {
        let stages = self.offsets.len() - 1;
        (1..stages).take_while(|&k| self.offsets[k] <= t).count()
    }

    /// State at a time (s of the run). Times before the start are read at the start.
    pub fn state_at(&self, time_s: f64, state: &mut [f64]) {
        let n = state.len() / 2;
        let k = self.stage_at(time_s);
        let length = self.offsets[k + 1] - self.offsets[k];
        let t = ((time_s - self.start_s - self.offsets[k]) / length).max(0.0);
        let (a, b) = (self.values.x(k), self.values.x(k + 1));
        if t > 1.0 {
            let beyond = (t - 1.0) * length;
            for i in 0..n {
                state[i] = b[i] + beyond * b[n + i];
                state[n + i] = b[n + i];
            }
            return;
        }
        let (t2, t3) = (t * t, t * t * t);
        let (h0, h1, g0, g1) = (1.0 - 3.0 * t2 + 2.0 * t3, 3.0 * t2 - 2.0 * t3, t - 2.0 * t2 + t3, t3 - t2);
        let (r, s0, s1) = (6.0 * (t2 - t) / length, 1.0 - 4.0 * t + 3.0 * t2, 3.0 * t2 - 2.0 * t);
        for i in 0..n {
            state[i] = h0 * a[i] + h1 * b[i] + length * (g0 * a[n + i] + g1 * b[n + i]);
            state[n + i] = r * (a[i] - b[i]) + s0 * a[n + i] + s1 * b[n + i];
        }
    }

    /// Mean input over a span of the run; beyond the end the last one.
    pub fn mean_input(&self, from_s: f64, to_s: f64, input: &mut [f64]) {
        let stages = self.offsets.len() - 1;
        let (from, to) = (from_s - self.start_s, to_s - self.start_s);
        input.fill(0.0);
        let mut covered = 0.0;
        for k in 0..stages {
            let last = k + 1 == stages;
            let begin = if k == 0 { f64::NEG_INFINITY } else { self.offsets[k] };
            let end = if last { f64::INFINITY } else { self.offsets[k + 1] };
            let share = to.min(end) - from.max(begin);
            if share > 0.0 {
                covered += share;
                for (u, value) in input.iter_mut().zip(self.values.u(k)) {
                    *u += share * value;
                }
            }
        }
        if covered > 0.0 {
            for u in input.iter_mut() {
                *u /= covered;
            }
        } else {
            input.copy_from_slice(self.values.u(self.stage_at(from_s)));
        }
    }

    /// Fills `shifted` with this plan as it looks from `start_s` on.
    pub fn shift_into(&self, start_s: f64, shifted: &mut Plan) {
        shifted.start_s = start_s;
        let Plan { values, offsets, .. } = shifted;
        for (k, offset) in offsets.iter().enumerate() {
            self.state_at(start_s + offset, values.x_mut(k));
        }
        for k in 0..offsets.len() - 1 {
            self.mean_input(start_s + offsets[k], start_s + offsets[k + 1], values.u_mut(k));
        }
    }

    /// Adds deviations to the nominal values.
    pub fn add(&mut self, deviation: &Trajectory) {
        self.values.add(deviation);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use delmpc_lq::lq_problem::LqSize;

    /// q = t³ - t, q̇ = 3t² - 1: a cubic is reproduced exactly.
    fn cubic() -> Plan {
        let lengths = [0.1, 0.1, 0.3];
        let size = LqSize { states: 2, inputs: 1, stages: 3, ..LqSize::default() };
        let mut plan = Plan::new(Trajectory::new(size), &lengths);
        plan.start_s = 5.0;
        for k in 0..4 {
            let t = plan.offsets[k];
            plan.values.x_mut(k).copy_from_slice(&[t * t * t - t, 3.0 * t * t - 1.0]);
        }
        for k in 0..3 {
            plan.values.u_mut(k)[0] = k as f64;
        }
        plan
    }

    #[test]
    fn a_cubic_motion_is_read_exactly_between_nodes() {
        let plan = cubic();
        let mut state = [0.0; 2];
        for t in [0.0f64, 0.03, 0.1, 0.17, 0.31, 0.5] {
            plan.state_at(5.0 + t, &mut state);
            assert!(
                (state[0] - (t * t * t - t)).abs() < 1e-14 && (state[1] - (3.0 * t * t - 1.0)).abs() < 1e-14
            );
        }
        plan.state_at(5.6, &mut state);
        assert!((state[0] - (0.125 - 0.5 + 0.1 * (0.75 - 1.0))).abs() < 1e-14);
    }

    #[test]
    fn inputs_are_averaged_over_the_new_stages() {
        let plan = cubic();
        let mut u = [0.0];
        plan.mean_input(5.05, 5.15, &mut u);
        assert!((u[0] - 0.5).abs() < 1e-12);
        plan.mean_input(5.4, 5.9, &mut u);
        assert_eq!(u[0], 2.0);
        let mut shifted = cubic();
        plan.shift_into(5.05, &mut shifted);
        assert!((shifted.values.u(0)[0] - 0.5).abs() < 1e-12);
        let mut state = [0.0; 2];
        plan.state_at(5.05, &mut state);
        assert_eq!(shifted.values.x(0), &state);
    }
}
