//! The inertial unit: gyroscope and accelerometer on a link.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `R`, `v` | orientation of the unit's axes in {0}, velocity of its origin | 1, m/s |
//! | `g` | gravity | m/s² |
//! | `b_ω`, `b_a` | biases | rad/s, m/s² |
//! | `σ`, `ς` | noise of a sample; bias walk | rad/s, m/s²; rad/s/√s, m/s²/√s |
//!
//! ```text
//! n_ω = b_ω + σ_ω n                      n_a = b_a + σ_a n                                 b += ς √Δt n
//! ω + n_ω                                a = R_midᵀ ((v_{k+1} - v_k) / Δt - g) + n_a
//! Θ += log(R_kᵀ R_{k+1}) + n_ω Δt        V += a Δt
//! ```
//!
//! The gyroscope's sample is of the moment, as the encoders' velocities are; the accelerometer's is the mean over the step. The sums `Θ`
//! and `V` are what happened, however seldom somebody looks. Before the first step the robot is held at rest: the accelerometer says `-g`.
//!
//! Source: D. Titterton, J. Weston, *Strapdown Inertial Navigation Technology*, 2004, chapter 4 (errors of inertial sensors).

use delmpc_mechanics::spatial::{RigidTransform, exp_rotation, log_rotation};
use nalgebra::{Rotation3, Unit, UnitQuaternion, Vector3};

use crate::error::{PlantError, require};
use crate::random::{Random, quantise};

/// Where the unit is, and how bad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InertialUnitConfig {
    /// Body it sits on.
    pub body: usize,
    /// Its axes and origin in the body's link frame.
    pub mounting: RigidTransform,
    /// Noise of a sample of the gyroscope, rad/s.
    pub gyro_noise: f64,
    /// Standard deviation of its bias at the start, rad/s.
    pub gyro_bias: f64,
    /// Walk of its bias, rad/s/√s.
    pub gyro_bias_walk: f64,
    /// Smallest step of the gyroscope, rad/s; 0 for none.
    pub gyro_resolution: f64,
    /// Noise of a sample of the accelerometer, m/s².
    pub accelerometer_noise: f64,
    /// Standard deviation of its bias at the start, m/s².
    pub accelerometer_bias: f64,
    /// Walk of its bias, m/s²/√s.
    pub accelerometer_bias_walk: f64,
    /// Smallest step of the accelerometer, m/s²; 0 for none.
    pub accelerometer_resolution: f64,
}

impl InertialUnitConfig {
    /// A perfect one in the link frame of body 0.
    pub const PERFECT: Self = Self {
        body: 0,
        mounting: RigidTransform {
            rotation: nalgebra::Matrix3::new(1., 0., 0., 0., 1., 0., 0., 0., 1.),
            translation: Vector3::new(0., 0., 0.),
        },
        gyro_noise: 0.0,
        gyro_bias: 0.0,
        gyro_bias_walk: 0.0,
        gyro_resolution: 0.0,
        accelerometer_noise: 0.0,
        accelerometer_bias: 0.0,
        accelerometer_bias_walk: 0.0,
        accelerometer_resolution: 0.0,
    };

    pub(crate) fn check(&self) -> Result<(), PlantError> {
        for value in [
            self.gyro_noise,
            self.gyro_bias,
            self.gyro_bias_walk,
            self.gyro_resolution,
            self.accelerometer_noise,
            self.accelerometer_bias,
            self.accelerometer_bias_walk,
            self.accelerometer_resolution,
        ] {
            require(
                value.is_finite() && value >= 0.0,
                "inertial unit's noise",
                value,
                "finite and not negative",
            )?;
        }
        Ok(())
    }
}

/// What the unit says, in its own axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct InertialReading {
    /// `ω`, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// `a`, m/s².
    pub specific_force: Vector3<f64>,
    /// `Θ`, rad.
    pub angle: Vector3<f64>,
    /// `V`, m/s.
    pub velocity: Vector3<f64>,
}

/// A unit with its biases and sums.
#[derive(Clone, Debug)]
pub struct InertialUnit {
    config: InertialUnitConfig,
    noise_scale: f64,
    random: Random,
    gyro_bias: Vector3<f64>,
    accelerometer_bias: Vector3<f64>,
    last: Option<(UnitQuaternion<f64>, Vector3<f64>)>,
    reading: InertialReading,
}

impl InertialUnit {
    /// A unit whose noises and biases are those of `config` times `noise_scale`.
    pub fn new(config: &InertialUnitConfig, noise_scale: f64, seed: u64) -> Self {
        let mut random = Random::new(seed, 3);
        let gyro_bias = random.vector(noise_scale * config.gyro_bias);
        let accelerometer_bias = random.vector(noise_scale * config.accelerometer_bias);
        let (last, reading) = (None, InertialReading::default());
        Self { config: *config, noise_scale, random, gyro_bias, accelerometer_bias, last, reading }
    }

    /// Where it sits.
    pub fn config(&self) -> &InertialUnitConfig {
        &self.config
    }

    /// The biases of gyroscope and accelerometer at present, rad/s and m/s².
    pub fn biases(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.gyro_bias, self.accelerometer_bias)
    }

    /// One sample: the unit's pose, the velocity of its origin and its angular velocity in {0} at the end of a step of `time_step` (s).
    /// No allocation.
    pub fn sample(
        &mut self,
        pose_w: &RigidTransform,
        velocity_w: &Vector3<f64>,
        angular_velocity_w: &Vector3<f64>,
        gravity_w: &Vector3<f64>,
        time_step: f64,
    ) -> InertialReading {
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(pose_w.rotation));
        let (turned, mean_rotation, acceleration) = match self.last {
            Some((last, last_velocity)) => {
                let turned = log_rotation((last.inverse() * rotation).to_rotation_matrix().matrix());
                let half = exp_rotation(&(0.5 * turned));
                (turned, last.to_rotation_matrix().matrix() * half, (velocity_w - last_velocity) / time_step)
            }
            None => (Vector3::zeros(), pose_w.rotation, Vector3::zeros()),
        };
        let first = self.last.is_none();
        self.last = Some((Unit::new_normalize(rotation.into_inner()), *velocity_w));
        let c = &self.config;
        let scale = self.noise_scale;
        let gyro_error = self.gyro_bias + self.random.vector(scale * c.gyro_noise);
        let gyro = pose_w.rotation.tr_mul(angular_velocity_w) + gyro_error;
        let force = mean_rotation.tr_mul(&(acceleration - gravity_w))
            + self.accelerometer_bias
            + self.random.vector(scale * c.accelerometer_noise);
        let out = &mut self.reading;
        out.angular_velocity = gyro.map(|x| quantise(x, c.gyro_resolution));
        out.specific_force = force.map(|x| quantise(x, c.accelerometer_resolution));
        if !first {
            out.angle += turned + (out.angular_velocity - gyro + gyro_error) * time_step;
            out.velocity += out.specific_force * time_step;
        }
        let root = time_step.sqrt() * scale;
        self.gyro_bias += self.random.vector(root * c.gyro_bias_walk);
        self.accelerometer_bias += self.random.vector(root * c.accelerometer_bias_walk);
        self.reading
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);
    const RATE: Vector3<f64> = Vector3::new(0.3, -0.8, 0.5);

    /// A unit that turns about an oblique axis while it is thrown.
    fn motion(time: f64) -> (RigidTransform, Vector3<f64>) {
        let rotation = exp_rotation(&(RATE * time));
        let pose = RigidTransform { rotation, translation: Vector3::zeros() };
        (pose, Vector3::new(1.0, 0.0, 2.0) + GRAVITY * time)
    }

    #[test]
    fn thrown_it_feels_nothing_but_its_turning_and_the_sums_are_what_happened() {
        let mut unit = InertialUnit::new(&InertialUnitConfig::PERFECT, 1.0, 1);
        let mut reading = InertialReading::default();
        for k in 0..=500 {
            let (pose, velocity) = motion(f64::from(k) * 1e-3);
            reading = unit.sample(&pose, &velocity, &RATE, &GRAVITY, 1e-3);
            if k == 0 {
                assert!((reading.specific_force + GRAVITY).norm() < 1e-15, "held at rest");
            }
        }
        assert!((reading.angular_velocity - RATE).norm() < 1e-9);
        assert!(reading.specific_force.norm() < 1e-9);
        assert!((reading.angle - Vector3::new(0.15, -0.4, 0.25)).norm() < 1e-9);
        assert!(reading.velocity.norm() < 1e-9);
    }

    #[test]
    fn bias_stays_noise_averages_out_and_resolution_counts() {
        let config = InertialUnitConfig {
            gyro_bias: 0.01,
            gyro_noise: 1e-3,
            accelerometer_resolution: 0.5,
            ..InertialUnitConfig::PERFECT
        };
        let mut unit = InertialUnit::new(&config, 1.0, 4);
        let still = RigidTransform::identity();
        let mut reading = InertialReading::default();
        for _ in 0..=10_000 {
            reading = unit.sample(&still, &Vector3::zeros(), &Vector3::zeros(), &GRAVITY, 1e-3);
        }
        let (bias, _) = unit.biases();
        assert!(bias.norm() > 1e-3 && (reading.angle / 10.0 - bias).norm() < 5e-5);
        assert_eq!(reading.specific_force.z, 10.0);
    }
}
