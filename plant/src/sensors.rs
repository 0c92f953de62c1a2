//! Sensors: what is told of the state, with noise, bias, quantisation and delay. Seeded.
//!
//! ```text
//! measured = quantise( true + bias + σ n )     n normal, new in every step; bias normal, drawn once
//! ```
//!
//! Joint velocities come from `M⁻¹ p`, not from the integrator's interpolation (which has a lower order). What a robot feels of its base
//! is its inertial unit ([`crate::inertial_unit`]). The base pose, of the base link frame, and its twist in its own axes are those of
//! motion capture, where there is one; else they are for the log only.

use delmpc_mechanics::spatial::{RigidTransform, Twist, Wrench, exp_rotation};

use crate::delay::{DelayLine, delay_steps};
use crate::error::{PlantError, require};
use crate::inertial_unit::{InertialReading, InertialUnitConfig};
use crate::random::{Random, quantise};

/// Standard deviations, resolutions and delay; all 0 for perfect sensors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorConfig {
    /// Noise of the joint positions, rad or m.
    pub position_noise: f64,
    /// Standard deviation of the constant bias of the joint positions, rad or m.
    pub position_bias: f64,
    /// Smallest step of the joint encoders, rad or m; 0 for none.
    pub position_resolution: f64,
    /// Noise of the joint velocities, rad/s or m/s.
    pub velocity_noise: f64,
    /// Smallest step of the joint velocities, rad/s or m/s; 0 for none.
    pub velocity_resolution: f64,
    /// Whether there is an inertial unit.
    pub has_inertial_unit: bool,
    /// The inertial unit.
    pub inertial_unit: InertialUnitConfig,
    /// Whether every foot has a force and torque sensor.
    pub has_foot_wrench: bool,
    /// Whether the base is seen by motion capture.
    pub has_motion_capture: bool,
    /// Noise of the base position, m.
    pub base_position_noise: f64,
    /// Noise of the base orientation, rad about each axis.
    pub base_orientation_noise: f64,
    /// Noise of the base's angular velocity, rad/s.
    pub base_angular_velocity_noise: f64,
    /// Noise of the base's linear velocity, m/s.
    pub base_linear_velocity_noise: f64,
    /// Noise of the foot force, N.
    pub force_noise: f64,
    /// Noise of the foot torque, N·m.
    pub torque_noise: f64,
    /// Factor on all noises and biases.
    pub noise_scale: f64,
    /// Age of what is told, s; rounded to whole steps.
    pub delay: f64,
}

impl SensorConfig {
    /// Perfect sensors.
    pub const PERFECT: Self = Self {
        position_noise: 0.0,
        position_bias: 0.0,
        position_resolution: 0.0,
        velocity_noise: 0.0,
        velocity_resolution: 0.0,
        has_inertial_unit: true,
        inertial_unit: InertialUnitConfig::PERFECT,
        has_foot_wrench: true,
        has_motion_capture: false,
        base_position_noise: 0.0,
        base_orientation_noise: 0.0,
        base_angular_velocity_noise: 0.0,
        base_linear_velocity_noise: 0.0,
        force_noise: 0.0,
        torque_noise: 0.0,
        noise_scale: 1.0,
        delay: 0.0,
    };
}

impl Default for SensorConfig {
    /// Good encoders, a tactical inertial unit, strain gauges under the feet.
    fn default() -> Self {
        Self {
            position_noise: 2e-5,
            position_bias: 0.0,
            position_resolution: 1e-5,
            velocity_noise: 2e-3,
            velocity_resolution: 0.0,
            has_inertial_unit: true,
            inertial_unit: InertialUnitConfig {
                gyro_noise: 2e-3,
                accelerometer_noise: 0.02,
                ..InertialUnitConfig::PERFECT
            },
            has_foot_wrench: true,
            has_motion_capture: false,
            base_position_noise: 1e-4,
            base_orientation_noise: 1e-4,
            base_angular_velocity_noise: 2e-3,
            base_linear_velocity_noise: 2e-3,
            force_noise: 2.0,
            torque_noise: 0.2,
            noise_scale: 1.0,
            delay: 0.0,
        }
    }
}

/// One set of readings, or the truth behind it.
#[derive(Clone, Debug, PartialEq)]
pub struct Readings {
    /// Time at which they were true, ns.
    pub time_ns: u64,
    /// Joint positions.
    pub position: Vec<f64>,
    /// Joint velocities.
    pub velocity: Vec<f64>,
    /// Pose of the base link frame in {0}.
    pub base_pose_w: RigidTransform,
    /// Twist of the base link frame in its own axes, at its origin.
    pub base_twist_b: Twist,
    /// The inertial unit.
    pub inertial: InertialReading,
    /// Wrench of the ground on every foot, sole frame, about its origin.
    pub foot_wrench: Vec<Wrench>,
    /// Torque the actuators gave during the step that ended at this time.
    pub applied_torque: Vec<f64>,
    /// Bit i: foot i touches.
    pub contact_flags: u32,
}

impl Readings {
    /// At rest at the origin.
    pub fn zeros(joints: usize, feet: usize) -> Self {
        Self {
            time_ns: 0,
            position: vec![0.0; joints],
            velocity: vec![0.0; joints],
            base_pose_w: RigidTransform::identity(),
            base_twist_b: Twist::default(),
            inertial: InertialReading::default(),
            foot_wrench: vec![Wrench::default(); feet],
            applied_torque: vec![0.0; joints],
            contact_flags: 0,
        }
    }

    fn copy_from(&mut self, other: &Self) {
        self.position.copy_from_slice(&other.position);
        self.velocity.copy_from_slice(&other.velocity);
        self.applied_torque.copy_from_slice(&other.applied_torque);
        self.time_ns = other.time_ns;
        self.base_pose_w = other.base_pose_w;
        self.base_twist_b = other.base_twist_b;
        self.inertial = other.inertial;
        self.foot_wrench.copy_from_slice(&other.foot_wrench);
        self.contact_flags = other.contact_flags;
    }
}

/// All sensors of the robot.
#[derive(Clone, Debug)]
pub struct Sensors {
    config: SensorConfig,
    random: Random,
    position_bias: Vec<f64>,
    line: DelayLine<Readings>,
    fresh: Readings,
}

impl Sensors {
    /// For `joints` joints and `feet` feet read every `time_step` (s).
    ///
    /// # Errors
    /// [`PlantError::Configuration`] for a negative or infinite number.
    pub fn new(
        joints: usize,
        feet: usize,
        time_step: f64,
        config: &SensorConfig,
        seed: u64,
    ) -> Result<Self, PlantError> {
        let c = config;
        for value in [
            c.position_noise,
            c.position_bias,
            c.position_resolution,
            c.velocity_noise,
            c.velocity_resolution,
            c.base_position_noise,
            c.base_orientation_noise,
            c.base_angular_velocity_noise,
            c.base_linear_velocity_noise,
            c.force_noise,
            c.torque_noise,
            c.noise_scale,
        ] {
            require(value.is_finite() && value >= 0.0, "sensor noise", value, "finite and not negative")?;
        }
        c.inertial_unit.check()?;
        require((0.0..=1.0).contains(&c.delay), "sensor delay", c.delay, "in [0, 1] s")?;
        let mut random = Random::new(seed, 1);
        let position_bias = (0..joints).map(|_| c.noise_scale * c.position_bias * random.normal()).collect();
        Ok(Self {
            config: *config,
            random,
            position_bias,
            line: DelayLine::new(delay_steps(c.delay, time_step), Readings::zeros(joints, feet)),
            fresh: Readings::zeros(joints, feet),
        })
    }

    /// Reads the truth once per step. No allocation.
    pub fn read(&mut self, truth: &Readings) {
        self.fresh.copy_from(truth);
        let c = &self.config;
        let scale = c.noise_scale;
        for (value, bias) in self.fresh.position.iter_mut().zip(&self.position_bias) {
            let noisy = *value + bias + scale * c.position_noise * self.random.normal();
            *value = quantise(noisy, c.position_resolution);
        }
        for value in &mut self.fresh.velocity {
            let noisy = *value + scale * c.velocity_noise * self.random.normal();
            *value = quantise(noisy, c.velocity_resolution);
        }
        let random = &mut self.random;
        let pose = &mut self.fresh.base_pose_w;
        pose.translation += random.vector(scale * c.base_position_noise);
        pose.rotation *= exp_rotation(&random.vector(scale * c.base_orientation_noise));
        let twist = &mut self.fresh.base_twist_b;
        twist.angular += random.vector(scale * c.base_angular_velocity_noise);
        twist.linear += random.vector(scale * c.base_linear_velocity_noise);
        for wrench in &mut self.fresh.foot_wrench {
            wrench.force += random.vector(scale * c.force_noise);
            wrench.torque += random.vector(scale * c.torque_noise);
        }
        self.line.newest().copy_from(&self.fresh);
        self.line.advance();
    }

    /// Starts as if the present readings had been there for a long time.
    pub fn preset(&mut self) {
        self.line.fill(&self.fresh);
    }

    /// Which sensors there are, and how good.
    pub fn config(&self) -> &SensorConfig {
        &self.config
    }

    /// What the sensors say now, without delay: for a servo on the robot.
    pub fn fresh(&self) -> &Readings {
        &self.fresh
    }

    /// What is told to the outside, with delay.
    pub fn told(&self) -> &Readings {
        self.line.oldest()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth() -> Readings {
        let mut truth = Readings::zeros(2, 1);
        truth.position = vec![0.12345, -0.5];
        truth.velocity = vec![1.0, 2.0];
        truth.foot_wrench[0].force.z = 1700.0;
        truth
    }

    #[test]
    fn perfect_sensors_tell_the_truth() {
        let mut sensors = Sensors::new(2, 1, 1e-3, &SensorConfig::PERFECT, 3).unwrap();
        sensors.read(&truth());
        assert_eq!((sensors.told(), sensors.fresh()), (&truth(), &truth()));
    }

    #[test]
    fn noise_has_the_deviation_asked_for_and_bias_stays() {
        let config = SensorConfig { position_noise: 1e-3, position_bias: 0.1, ..SensorConfig::PERFECT };
        let mut sensors = Sensors::new(2, 1, 1e-3, &config, 5).unwrap();
        let n = 20_000;
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..n {
            sensors.read(&truth());
            let error = sensors.told().position[0] - 0.12345;
            sum += error;
            square += error * error;
        }
        let mean = sum / f64::from(n);
        let deviation = (square / f64::from(n) - mean * mean).sqrt();
        assert!(mean.abs() > 1e-3, "a bias of 0.1 was asked for, {mean} found");
        assert!((deviation / 1e-3 - 1.0).abs() < 0.03);
    }

    #[test]
    fn encoders_count_in_whole_steps() {
        let config = SensorConfig { position_resolution: 0.01, ..SensorConfig::PERFECT };
        let mut sensors = Sensors::new(2, 1, 1e-3, &config, 5).unwrap();
        sensors.read(&truth());
        assert!((sensors.told().position[0] - 0.12).abs() < 1e-15);
    }

    #[test]
    fn what_is_told_is_old_and_carries_its_own_time() {
        let config = SensorConfig { delay: 3e-3, ..SensorConfig::PERFECT };
        let mut sensors = Sensors::new(2, 1, 1e-3, &config, 5).unwrap();
        for k in 1..=5 {
            let mut now = truth();
            now.time_ns = k * 1_000_000;
            sensors.read(&now);
        }
        assert_eq!(sensors.told().time_ns, 2_000_000);
        assert_eq!(sensors.fresh().time_ns, 5_000_000);
    }

    #[test]
    fn the_noisy_orientation_is_a_rotation() {
        let config = SensorConfig { base_orientation_noise: 0.1, ..SensorConfig::PERFECT };
        let mut sensors = Sensors::new(2, 1, 1e-3, &config, 5).unwrap();
        sensors.read(&truth());
        let r = sensors.told().base_pose_w.rotation;
        assert!((r.tr_mul(&r) - nalgebra::Matrix3::identity()).amax() < 1e-14);
    }
}
