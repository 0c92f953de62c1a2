//! The feedback law of a [`Command`], as whoever drives the motors evaluates it between two commands.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `τ`, `[l, h]` | feed-forward and bounds of the segment in force | N m |
//! | `q`, `q̇` | joints | rad, rad/s |
//! | `Θ`, `ω`, `b` | sum of the gyroscope's samples, its last sample, its bias | rad, rad/s |
//! | `f`, `F` | normal force on the foot the joint needs, the one at which it has its full torque | N |
//!
//! ```text
//! x_ref(t) = x_ref + v_ref t + ½ a_ref t²      v_ref(t) = v_ref + a_ref t      t since the segment began; stands from the command's end on
//! u = clamp( τ + K [q - q_ref(t); q̇ - q̇_ref(t)] + K_imu [Θ - Θ_ref(t) - b t; ω - ω_ref(t) - b], l, h )
//! a joint with a foot:   s = clamp(f/F, 0, 1)      u := s u + (1 - s) ( -k (q - q_ref(t)) - d q̇ )
//! ```
//!
//! `q̇` and `ω` are means over the servo's last samples, as many as the command says ([`RateMean`]): what a servo answers within one of
//! its own periods excites what it stands on at half its rate, where ground that gives lets a foot roll. `q` and `Θ` are the last ones.
//!
//! In `b t` the time goes on beyond the command's end. The bounds come before the share of the load, and the last line damps `q̇` itself.
//! Means count samples from before the command, too.
//!
//! Without an inertial unit its term is left out, without a force sensor `s = 1`. The last line is for a foot that hops, rocks or hangs:
//! the torque that balances 100 kg throws a foot of 2 kg by 5000 rad/s², and the gain that is right for the one makes the other chatter.

use crate::{Command, FootReading, MAX_JOINTS, Message, MessageError, PlantState, check, foot, sensor};

/// What a servo reads when it evaluates a command: all of the same time, as fresh as it can be had.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ServoReadings<'a> {
    /// Joint positions, rad or m.
    pub position: &'a [f64],
    /// Joint velocities, rad/s or m/s: means, see [`RateMean`].
    pub velocity: &'a [f64],
    /// Sum of the gyroscope's samples times their time, and the mean of its last ones; `None`: no inertial unit.
    pub imu: Option<([f64; 3], [f64; 3])>,
    /// The feet, as in [`PlantState`]; empty: none has a force sensor.
    pub feet: &'a [FootReading],
}

impl<'a> ServoReadings<'a> {
    /// Encoders only.
    pub fn joints(position: &'a [f64], velocity: &'a [f64]) -> Self {
        Self { position, velocity, imu: None, feet: &[] }
    }

    /// All that a state says, for instance in a simulation whose servo has the same sensors.
    pub fn of_state(state: &'a PlantState) -> Self {
        let n = (state.n_joints as usize).min(MAX_JOINTS);
        let imu = state.has_sensor(sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS);
        Self {
            position: &state.position[..n],
            velocity: &state.velocity[..n],
            imu: imu.then_some((state.imu_angle, state.imu_angular_velocity)),
            feet: state.feet(),
        }
    }

    /// Measured normal force on a foot, N; `None`: no sensor.
    fn load_n(&self, index: usize) -> Option<f64> {
        self.feet
            .get(index)
            .filter(|reading| reading.flags & foot::WRENCH != 0)
            .map(|reading| reading.force_s[2])
    }
}

/// Most samples a mean goes over.
pub const MAX_RATE_SAMPLES: usize = 8;

/// Means of joint velocities and gyroscope over the last samples, without allocation.
#[derive(Debug, Clone)]
pub struct RateMean {
    velocity: [[f64; MAX_JOINTS]; MAX_RATE_SAMPLES],
    rate: [[f64; 3]; MAX_RATE_SAMPLES],
    taken: usize,
    mean: ([f64; MAX_JOINTS], [f64; 3]),
}

impl Default for RateMean {
    fn default() -> Self {
        Self {
            velocity: [[0.0; MAX_JOINTS]; MAX_RATE_SAMPLES],
            rate: [[0.0; 3]; MAX_RATE_SAMPLES],
            taken: 0,
            mean: ([0.0; MAX_JOINTS], [0.0; 3]),
        }
    }
}

impl RateMean {
    /// Takes a sample of all joints (those beyond the capacity are left out) and of the gyroscope; returns the means over the last
    /// `samples`, or over all there are.
    pub fn take(
        &mut self,
        velocity: &[f64],
        rate: &[f64; 3],
        samples: u32,
    ) -> (&[f64; MAX_JOINTS], &[f64; 3]) {
        let at = self.taken % MAX_RATE_SAMPLES;
        for (kept, now) in self.velocity[at].iter_mut().zip(velocity) {
            *kept = *now;
        }
        self.rate[at] = *rate;
        self.taken += 1;
        let count = (samples as usize).clamp(1, MAX_RATE_SAMPLES).min(self.taken);
        self.mean = ([0.0; MAX_JOINTS], [0.0; 3]);
        let part = 1.0 / count as f64;
        for back in 0..count {
            let sample = (self.taken - 1 - back) % MAX_RATE_SAMPLES;
            for (mean, value) in self.mean.0.iter_mut().zip(&self.velocity[sample]) {
                *mean += part * value;
            }
            for (mean, value) in self.mean.1.iter_mut().zip(&self.rate[sample]) {
                *mean += part * value;
            }
        }
        (&self.mean.0, &self.mean.1)
    }
}

impl Command {
    /// The torque of the law at the readings of `time_ns`, by the plant's clock: see the module's formulas. Before its time the reference
    /// is where it began; from its end on it stands where it ended.
    ///
    /// Cost: O(n²), no allocation. Call it on a validated command.
    ///
    /// # Errors
    /// [`MessageError::WrongLength`] when a slice has another length than `n_joints`; `torque` is untouched then.
    pub fn torque_into(
        &self,
        time_ns: u64,
        readings: &ServoReadings<'_>,
        torque: &mut [f64],
    ) -> Result<(), MessageError> {
        let n = check::joint_count(Self::NAME, self.n_joints, self.n_joints as usize)?;
        let ServoReadings { position, velocity, .. } = *readings;
        for (argument, found) in
            [("position", position.len()), ("velocity", velocity.len()), ("torque", torque.len())]
        {
            if found != n {
                return Err(MessageError::WrongLength { message: Self::NAME, argument, found, expected: n });
            }
        }
        let (segment, elapsed_s) = self.segment_at(time_ns);
        let moves = if time_ns < self.valid_until_ns { 1.0 } else { 0.0 };
        let way = |rate: f64, acceleration: f64| elapsed_s * (rate + 0.5 * elapsed_s * acceleration);
        let speed = |rate: f64, acceleration: f64| moves * (rate + elapsed_s * acceleration);
        let mut imu_error = [0.0; 6];
        if let Some((angle, rate)) = readings.imu {
            // The sum of the bias does not end with the command.
            let begin_ns = self.valid_from_ns.saturating_add(segment.begin_ns);
            let summed_s = time_ns.max(self.valid_from_ns).saturating_sub(begin_ns) as f64 * 1e-9;
            for k in 0..3 {
                let (rate_ref, acceleration) = (segment.imu_rate_ref[k], segment.imu_acceleration_ref[k]);
                let bias = self.imu_rate_bias[k];
                imu_error[k] =
                    angle[k] - segment.imu_angle_ref[k] - way(rate_ref, acceleration) - bias * summed_s;
                imu_error[3 + k] = rate[k] - speed(rate_ref, acceleration) - bias;
            }
        }
        for (i, torque) in torque.iter_mut().enumerate() {
            let (position_gain, velocity_gain) = self.gain[i].split_at(MAX_JOINTS);
            *torque = segment.torque[i];
            for j in 0..n {
                let (rate_ref, acceleration) = (segment.velocity_ref[j], segment.acceleration_ref[j]);
                let error = position[j] - segment.position_ref[j] - way(rate_ref, acceleration);
                *torque += position_gain[j] * error;
                *torque += velocity_gain[j] * (velocity[j] - speed(rate_ref, acceleration));
            }
            *torque += self.imu_gain[i].iter().zip(&imu_error).map(|(gain, error)| gain * error).sum::<f64>();
            *torque = torque.max(segment.torque_lower[i]).min(segment.torque_upper[i]);
            let load = (self.load_foot[i] as usize).checked_sub(1).and_then(|foot| {
                Some(
                    readings.load_n(foot)?
                        / self.full_load_n.get(foot).copied().filter(|full| *full > 0.0)?,
                )
            });
            if let Some(load) = load {
                let share = load.clamp(0.0, 1.0);
                let (rate_ref, acceleration) = (segment.velocity_ref[i], segment.acceleration_ref[i]);
                let error = position[i] - segment.position_ref[i] - way(rate_ref, acceleration);
                let held = -self.unloaded_stiffness[i] * error - self.unloaded_damping[i] * velocity[i];
                *torque = share * *torque + (1.0 - share) * held;
            }
        }
        Ok(())
    }
}
