//! Joint actuators: delay, rate limit, torque limit, and the torque a motor has left at speed.
//!
//! ```text
//! u_cmd --delay--> |Δu| <= rate Δt --> |u| <= effort --> motoring (u q̇ > 0): |u| <= effort min(1, (1 - |q̇|/v_max)/(1 - knee)) --> u
//! ```
//!
//! Braking torque is not limited by speed: the motor's own voltage helps. The limits come last, so the output never exceeds them.

use crate::delay::{DelayLine, delay_steps};
use crate::error::{PlantError, require, require_length};

/// Limits of one actuator; infinite for none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ActuatorLimits {
    /// Largest torque (N·m) or force (N).
    pub effort: f64,
    /// Speed at which no motoring torque is left, rad/s or m/s.
    pub velocity: f64,
    /// Largest change of the torque per time, N·m/s or N/s.
    pub rate: f64,
}

impl ActuatorLimits {
    /// No limits at all.
    pub const NONE: Self = Self { effort: f64::INFINITY, velocity: f64::INFINITY, rate: f64::INFINITY };
}

/// What is fixed when [`Actuators`] are made.
#[derive(Clone, Debug, PartialEq)]
pub struct ActuatorConfig {
    /// Limits of every joint; empty for none.
    pub limits: Vec<ActuatorLimits>,
    /// Share of the top speed up to which the full torque is there.
    pub velocity_knee: f64,
    /// Time from command to torque, s; rounded to whole steps.
    pub delay: f64,
}

impl Default for ActuatorConfig {
    fn default() -> Self {
        Self { limits: Vec::new(), velocity_knee: 0.9, delay: 0.0 }
    }
}

/// The actuators of all joints.
#[derive(Clone, Debug)]
pub struct Actuators {
    limits: Vec<ActuatorLimits>,
    velocity_knee: f64,
    time_step: f64,
    line: DelayLine<Vec<f64>>,
    torque: Vec<f64>,
    saturated: bool,
    max_torque_ratio: f64,
}

impl Actuators {
    /// For `joints` joints driven every `time_step` (s).
    ///
    /// # Errors
    /// [`PlantError`] for limits or delays out of range, or a wrong number of limits.
    pub fn new(joints: usize, time_step: f64, config: &ActuatorConfig) -> Result<Self, PlantError> {
        let limits =
            if config.limits.is_empty() { vec![ActuatorLimits::NONE; joints] } else { config.limits.clone() };
        require_length("actuator limits", limits.len(), joints)?;
        for limit in &limits {
            for value in [limit.effort, limit.velocity, limit.rate] {
                require(value > 0.0, "actuator limit", value, "positive (infinite for none)")?;
            }
        }
        let knee = config.velocity_knee;
        require((0.0..1.0).contains(&knee), "velocity knee", knee, "in [0, 1)")?;
        require((0.0..=1.0).contains(&config.delay), "actuator delay", config.delay, "in [0, 1] s")?;
        Ok(Self {
            limits,
            velocity_knee: knee,
            time_step,
            line: DelayLine::new(delay_steps(config.delay, time_step), vec![0.0; joints]),
            torque: vec![0.0; joints],
            saturated: false,
            max_torque_ratio: 0.0,
        })
    }

    /// Starts as if `torque` had been given for a long time.
    pub fn preset(&mut self, torque: &[f64]) {
        self.torque.copy_from_slice(torque);
        self.line.newest().copy_from_slice(torque);
        let settled = self.line.newest().clone();
        self.line.fill(&settled);
    }

    /// One step: the torque the joints feel while the servo asks for `command`, at joint speeds `velocity`.
    pub fn apply(&mut self, command: &[f64], velocity: &[f64]) -> &[f64] {
        self.line.newest().copy_from_slice(command);
        self.line.advance();
        self.saturated = false;
        let asked = self.line.oldest();
        for (i, limit) in self.limits.iter().enumerate() {
            let before = self.torque[i];
            let reach = limit.rate * self.time_step;
            let mut torque = asked[i].clamp(before - reach, before + reach);
            let mut largest = limit.effort;
            if torque * velocity[i] > 0.0 && limit.velocity.is_finite() && largest.is_finite() {
                let left = (1.0 - velocity[i].abs() / limit.velocity) / (1.0 - self.velocity_knee);
                largest *= left.clamp(0.0, 1.0);
            }
            torque = torque.clamp(-largest, largest);
            if !torque.is_finite() {
                torque = 0.0;
            }
            self.saturated |= torque != asked[i];
            if limit.effort.is_finite() {
                self.max_torque_ratio = self.max_torque_ratio.max(torque.abs() / limit.effort);
            }
            self.torque[i] = torque;
        }
        &self.torque
    }

    /// Torque of the last step.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// Whether any actuator gave less or more than was asked in the last step.
    pub fn saturated(&self) -> bool {
        self.saturated
    }

    /// Largest `|u|/effort` so far.
    pub fn max_torque_ratio(&self) -> f64 {
        self.max_torque_ratio
    }

    /// The limits.
    pub fn limits(&self) -> &[ActuatorLimits] {
        &self.limits
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn actuators(limit: ActuatorLimits, delay: f64) -> Actuators {
        let config = ActuatorConfig { limits: vec![limit], velocity_knee: 0.5, delay };
        Actuators::new(1, 1e-3, &config).unwrap()
    }

    #[test]
    fn the_torque_limit_clips_and_says_so() {
        let mut a = actuators(ActuatorLimits { effort: 10.0, ..ActuatorLimits::NONE }, 0.0);
        assert_eq!(a.apply(&[4.0], &[0.0]), [4.0]);
        assert!(!a.saturated());
        assert_eq!(a.apply(&[-14.0], &[0.0]), [-10.0]);
        assert!(a.saturated());
        assert_eq!(a.max_torque_ratio(), 1.0);
    }

    #[test]
    fn the_rate_limit_ramps() {
        let mut a = actuators(ActuatorLimits { rate: 1000.0, ..ActuatorLimits::NONE }, 0.0);
        let ramp: Vec<f64> = (0..4).map(|_| a.apply(&[2.5], &[0.0])[0]).collect();
        assert_eq!(ramp, [1.0, 2.0, 2.5, 2.5]);
    }

    #[test]
    fn motoring_torque_fades_with_speed_and_braking_torque_does_not() {
        let limit = ActuatorLimits { effort: 10.0, velocity: 8.0, ..ActuatorLimits::NONE };
        let mut a = actuators(limit, 0.0);
        assert_eq!(a.apply(&[10.0], &[4.0]), [10.0]);
        assert_eq!(a.apply(&[10.0], &[6.0]), [5.0]);
        assert_eq!(a.apply(&[10.0], &[9.0]), [0.0]);
        assert_eq!(a.apply(&[-10.0], &[9.0]), [-10.0]);
    }

    #[test]
    fn the_delay_is_whole_steps() {
        let mut a = actuators(ActuatorLimits::NONE, 2e-3);
        let out: Vec<f64> = (1..=4).map(|k| a.apply(&[f64::from(k)], &[0.0])[0]).collect();
        assert_eq!(out, [0.0, 0.0, 1.0, 2.0]);
    }

    #[test]
    fn a_torque_that_is_no_number_becomes_zero() {
        let mut a = actuators(ActuatorLimits { effort: 10.0, ..ActuatorLimits::NONE }, 0.0);
        assert_eq!(a.apply(&[f64::NAN], &[0.0]), [0.0]);
    }
}
