//! What the estimator knows of robot and sensors, and what it is told at one time.

use alloc::vec::Vec;

use delmpc_mechanics::spatial::{RigidTransform, Twist, Wrench};
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;

/// A foot.
#[derive(Clone, Debug, PartialEq)]
pub struct FootModel {
    /// Body of the floating tree.
    pub body: usize,
    /// Sole frame in the body's link frame: z out of the ground, x forward.
    pub sole: RigidTransform,
    /// Corners of the sole in its frame, counter-clockwise from above, m; fewer than three: a point at the sole's origin.
    pub polygon: Vec<[f64; 2]>,
}

/// The robot.
#[derive(Clone, Debug)]
pub struct EstimatorModel {
    /// The floating tree; joints in the order of the measurements.
    pub tree: KinematicTree,
    /// Body the inertial unit sits on.
    pub imu_body: usize,
    /// Its axes and origin in that body's link frame.
    pub imu_mounting: RigidTransform,
    /// The feet.
    pub feet: Vec<FootModel>,
    /// The foot whose sole is {0} at the first measurement.
    pub reference_foot: usize,
}

impl EstimatorModel {
    /// A robot with its inertial unit in the base link's frame, and the first foot for reference.
    pub fn new(tree: KinematicTree, feet: Vec<FootModel>) -> Self {
        let imu_mounting = RigidTransform::identity();
        Self { tree, imu_body: 0, imu_mounting, feet, reference_foot: 0 }
    }
}

/// How good the sensors are: standard deviations. What is unknown had better be too large than too small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimatorConfig {
    /// Time between two samples of the inertial unit, s: its noise is that of one sample.
    pub sample_s: f64,
    /// Gyroscope: noise of a sample, rad/s.
    pub gyro_noise: f64,
    /// Gyroscope: bias at the start, rad/s.
    pub gyro_bias: f64,
    /// Gyroscope: walk of the bias, rad/s/√s.
    pub gyro_bias_walk: f64,
    /// Accelerometer: noise of a sample, m/s².
    pub accelerometer_noise: f64,
    /// Accelerometer: bias at the start, m/s².
    pub accelerometer_bias: f64,
    /// Accelerometer: walk of the bias, m/s²/√s.
    pub accelerometer_bias_walk: f64,
    /// Encoders: noise of a position, rad or m.
    pub position_noise: f64,
    /// Encoders: noise of a velocity, rad/s or m/s.
    pub velocity_noise: f64,
    /// A loaded contact point moves along the ground and into it by this, m/s ...
    pub contact_velocity: f64,
    /// ... and its place walks by this, m/√s.
    pub contact_walk: f64,
    /// A loaded sole turns about the vertical by this, rad/s.
    pub sole_rate: f64,
    /// Tilt of the ground, or of the foot on it, that is taken for possible before anything is measured, rad.
    pub first_tilt: f64,
    /// Noise of a foot's normal force, N: what could be noise is no load.
    pub foot_force_noise: f64,
    /// A foot carries load above this part of the weight ...
    pub load_on: f64,
    /// ... until it is below this one.
    pub load_off: f64,
    /// For so long a foot must be loaded or not before it is believed, s.
    pub debounce_s: f64,
}

impl Default for EstimatorConfig {
    /// A tactical inertial unit sampled at 1 kHz, good encoders, ground that may give.
    fn default() -> Self {
        Self {
            sample_s: 1e-3,
            gyro_noise: 2e-3,
            gyro_bias: 0.01,
            gyro_bias_walk: 1e-5,
            accelerometer_noise: 0.02,
            accelerometer_bias: 0.02,
            accelerometer_bias_walk: 1e-4,
            position_noise: 2e-5,
            velocity_noise: 2e-3,
            contact_velocity: 1e-3,
            contact_walk: 1e-3,
            sole_rate: 0.01,
            first_tilt: 0.05,
            foot_force_noise: 0.0,
            load_on: 0.05,
            load_off: 0.02,
            debounce_s: 0.002,
        }
    }
}

/// What the inertial unit says, in its own axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inertial {
    /// Last sample of the gyroscope, rad/s.
    pub angular_velocity: Vector3<f64>,
    /// Last sample of the accelerometer, m/s².
    pub specific_force: Vector3<f64>,
    /// Sums of all samples times their time since the start, rad and m/s; `None`: the unit does not sum up, and between two
    /// measurements its last sample is taken.
    pub sums: Option<(Vector3<f64>, Vector3<f64>)>,
}

/// What is measured at a foot.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootMeasurement {
    /// Wrench of the ground on the foot about the sole's origin, in the sole's axes; `None`: no sensor.
    pub wrench_s: Option<Wrench>,
    /// Contact switch; counts where there is no wrench.
    pub touches: bool,
}

/// Everything measured at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement<'a> {
    /// When, s.
    pub time_s: f64,
    /// Joint positions, rad or m.
    pub position: &'a [f64],
    /// Joint velocities, rad/s or m/s.
    pub velocity: &'a [f64],
    /// The inertial unit.
    pub inertial: Option<Inertial>,
    /// The feet, in the order of the model; missing ones are in the air.
    pub feet: &'a [FootMeasurement],
    /// Motion capture: pose of the base link in {0} or any level frame, its twist in its own axes.
    pub motion_capture: Option<(RigidTransform, Twist)>,
}
