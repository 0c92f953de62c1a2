//! One call a measurement: contacts, base, feet.
//!
//! The base comes from the filter ([`crate::base_filter`]); with motion capture it is what that says; with neither it is where encoders
//! have it over a reference foot that stands level and still, as a robot without inertial unit has to believe.
//!
//! At the first measurement the attitude is that of a level reference foot, within `first_tilt`, and, when what the accelerometer feels
//! has the size of gravity, that direction: a robot that hangs or falls feels another size.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity, base_pose_from_link};
use delmpc_mechanics::spatial::{RigidTransform, Twist};
use nalgebra::{Matrix3, Vector3};

use crate::base_filter::BaseFilter;
use crate::contact::{ContactSwitch, FootEstimate, Shake};
use crate::model::{EstimatorConfig, EstimatorModel, Inertial, Measurement};

/// Longest time between two measurements that is bridged, s.
const LONGEST_GAP_S: f64 = 0.5;
/// Deviation of the felt gravity's direction at the start, rad, and per part by which its size is not that of gravity.
const FELT_TILT: f64 = 5e-4;
const FELT_TILT_PER_SIZE: f64 = 1.0;
/// Part by which the felt size may differ for it to say anything.
const FELT_SIZE: f64 = 0.1;

/// A foot that is this many standard deviations from where it rests has been moved.
const MOVED_FOOT: f64 = 5.0;
/// How long a foot that shakes moves one way, s.
const SHAKE_MEMORY_S: f64 = 0.01;

/// Why a measurement could not be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EstimationError {
    /// Model and measurement do not fit each other.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A body of the model does not exist.
    #[error("{what} is on body {body}, but the tree has {count}")]
    NoSuchBody {
        /// What is on it.
        what: &'static str,
        /// The body.
        body: usize,
        /// Bodies of the tree.
        count: usize,
    },
    /// The filter diverged; it starts again with the next measurement.
    #[error("the estimate of the base at {time_s} s is no number; it starts again with the next measurement")]
    NotFinite {
        /// When.
        time_s: f64,
    },
}

/// What is believed of the base.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaseEstimate {
    /// Base link frame in {0}.
    pub base_link_pose_w: RigidTransform,
    /// Its twist in its own axes, at its origin.
    pub base_twist_b: Twist,
    /// Axes of the inertial unit in {0}.
    pub imu_rotation_w: Matrix3<f64>,
    /// Bias of the gyroscope, in its axes, rad/s.
    pub gyro_bias: Vector3<f64>,
    /// Bias of the accelerometer, in its axes, m/s².
    pub accelerometer_bias: Vector3<f64>,
    /// Whether the attitude is measured, by inertial unit or motion capture, and not taken from a foot that is said to be level.
    pub attitude_is_measured: bool,
}

/// Estimator with all its memory.
#[derive(Clone, Debug)]
pub struct Estimator {
    model: EstimatorModel,
    config: EstimatorConfig,
    weight: f64,
    /// Kinematics with the base link at the origin, at rest.
    kinematics: Kinematics,
    filter: BaseFilter,
    switches: Vec<ContactSwitch>,
    shakes: Vec<Shake>,
    feet: Vec<FootEstimate>,
    estimate: BaseEstimate,
    last_s: Option<f64>,
    last_sums: Option<(Vector3<f64>, Vector3<f64>)>,
}

impl Estimator {
    /// For a robot and its sensors. Allocates.
    ///
    /// # Errors
    /// [`EstimationError::NoSuchBody`] for a foot or inertial unit that is on none.
    pub fn new(model: EstimatorModel, config: EstimatorConfig) -> Result<Self, EstimationError> {
        let count = model.tree.body_count();
        let bodies = model.feet.iter().map(|foot| ("a foot", foot.body));
        for (what, body) in bodies.chain([("the inertial unit", model.imu_body)]) {
            if body >= count {
                return Err(EstimationError::NoSuchBody { what, body, count });
            }
        }
        let feet = model.feet.len();
        Ok(Self {
            weight: model.tree.total_mass() * model.tree.gravity_w().norm(),
            kinematics: Kinematics::new(&model.tree),
            filter: BaseFilter::new(feet, *model.tree.gravity_w()),
            switches: vec![ContactSwitch::default(); feet],
            shakes: vec![Shake::default(); feet],
            feet: vec![FootEstimate::default(); feet],
            estimate: BaseEstimate {
                base_link_pose_w: RigidTransform::identity(),
                base_twist_b: Twist::default(),
                imu_rotation_w: Matrix3::identity(),
                gyro_bias: Vector3::zeros(),
                accelerometer_bias: Vector3::zeros(),
                attitude_is_measured: false,
            },
            last_s: None,
            last_sums: None,
            model,
            config,
        })
    }

    /// Takes a measurement in. Cost: kinematics O(n), and O(N²) a row of the filter; no allocation.
    ///
    /// # Errors
    /// [`EstimationError`]: lengths that do not fit; an estimate that is no number.
    pub fn update(&mut self, measurement: &Measurement<'_>) -> Result<(), EstimationError> {
        let tree = &self.model.tree;
        let at_origin = base_pose_from_link(tree, &RigidTransform::identity());
        let configuration = Configuration::floating(at_origin, measurement.position);
        let still = Velocity::floating(Twist::default(), measurement.velocity);
        self.kinematics.update(tree, &configuration, &still)?;
        let lost =
            self.last_s.is_some_and(|last| !(0.0..=LONGEST_GAP_S).contains(&(measurement.time_s - last)));
        if lost {
            self.last_s = None;
        }
        for (k, foot) in self.model.feet.iter().enumerate() {
            let measured = measurement.feet.get(k).copied().unwrap_or_default();
            let (switch, out) = (&mut self.switches[k], &mut self.feet[k]);
            switch.update(foot, &measured, self.weight, &self.config, measurement.time_s, out);
        }
        match (measurement.motion_capture, measurement.inertial) {
            (Some((pose, twist)), inertial) => self.take_motion_capture(&pose, &twist, inertial.as_ref()),
            (None, Some(inertial)) => self.filter(&inertial, measurement)?,
            (None, None) => self.stand_on_reference_foot(),
        }
        self.last_s = Some(measurement.time_s);
        self.place_feet();
        Ok(())
    }

    /// The base.
    pub fn estimate(&self) -> &BaseEstimate {
        &self.estimate
    }

    /// Angular velocity of the inertial unit in its axes, the gyroscope's bias taken off, rad/s.
    pub fn imu_rate(&self) -> Vector3<f64> {
        let imu_pose_b = self.imu_pose_b();
        let relative = self.kinematics.velocities_w()[self.model.imu_body];
        imu_pose_b.rotation.tr_mul(&(self.estimate.base_twist_b.angular + relative.angular))
    }

    /// The feet, in the order of the model.
    pub fn feet(&self) -> &[FootEstimate] {
        &self.feet
    }

    /// The filter, for its covariances.
    pub fn base_filter(&self) -> &BaseFilter {
        &self.filter
    }

    /// The robot.
    pub fn model(&self) -> &EstimatorModel {
        &self.model
    }

    /// Pose of the inertial unit in the base link.
    fn imu_pose_b(&self) -> RigidTransform {
        self.kinematics.link_poses_w()[self.model.imu_body] * self.model.imu_mounting
    }

    fn sole_pose_b(&self, foot: usize) -> RigidTransform {
        let foot = &self.model.feet[foot];
        self.kinematics.link_poses_w()[foot.body] * foot.sole
    }

    /// The base link where a level reference sole at the origin puts it.
    fn pose_over_reference_foot(&self) -> RigidTransform {
        match self.model.feet.is_empty() {
            true => RigidTransform::identity(),
            false => self.sole_pose_b(self.model.reference_foot.min(self.model.feet.len() - 1)).inverse(),
        }
    }

    fn start(&mut self, inertial: &Inertial) {
        let imu_pose_w = self.pose_over_reference_foot() * self.imu_pose_b();
        self.filter.start(imu_pose_w.rotation, imu_pose_w.translation, &self.config);
        let (size, gravity) = (inertial.specific_force.norm(), self.model.tree.gravity_w().norm());
        let off = (size / gravity - 1.0).abs();
        if off < FELT_SIZE {
            let noise = self.config.accelerometer_noise / gravity;
            let deviation = FELT_TILT + FELT_TILT_PER_SIZE * off;
            // Twice: the first one may be far. Both are the same sample.
            let variance = 2.0 * (noise * noise + deviation * deviation);
            for _ in 0..2 {
                for axis in 0..2 {
                    let row = self.filter.level_row(axis, &inertial.specific_force, variance);
                    self.filter.take(&row);
                }
                self.filter.correct();
            }
        }
        self.last_sums = inertial.sums;
    }

    fn filter(&mut self, inertial: &Inertial, measurement: &Measurement<'_>) -> Result<(), EstimationError> {
        match self.last_s {
            None => self.start(inertial),
            Some(last_s) => {
                let duration = measurement.time_s - last_s;
                let sums = inertial.sums.zip(self.last_sums);
                let (angle, velocity) = match sums {
                    Some((now, before)) => (now.0 - before.0, now.1 - before.1),
                    None => (inertial.angular_velocity * duration, inertial.specific_force * duration),
                };
                self.last_sums = inertial.sums;
                if duration > 0.0 {
                    self.filter.propagate(&angle, &velocity, duration, &self.config);
                    self.take_contacts(inertial, duration);
                }
            }
        }
        if !self.filter.is_finite() {
            self.last_s = None;
            return Err(EstimationError::NotFinite { time_s: measurement.time_s });
        }
        let imu_pose_b = self.imu_pose_b();
        let filter = &self.filter;
        let imu_pose_w = RigidTransform { rotation: filter.rotation, translation: filter.position };
        let rate = inertial.angular_velocity - filter.gyro_bias;
        let base_link_pose_w = imu_pose_w * imu_pose_b.inverse();
        let twist_i = Twist { angular: rate, linear: filter.rotation.tr_mul(&filter.velocity) };
        // The unit may be on a link that moves against the base.
        let relative = self.kinematics.velocities_w()[self.model.imu_body];
        let mut base_twist_b = imu_pose_b.transform_twist(&twist_i);
        base_twist_b.angular -= relative.angular;
        base_twist_b.linear -= relative.linear;
        self.estimate = BaseEstimate {
            base_link_pose_w,
            base_twist_b,
            imu_rotation_w: filter.rotation,
            gyro_bias: filter.gyro_bias,
            accelerometer_bias: filter.accelerometer_bias,
            attitude_is_measured: true,
        };
        Ok(())
    }

    /// The rows of all feet.
    fn take_contacts(&mut self, inertial: &Inertial, duration: f64) {
        let c = self.config;
        let imu_pose_b = self.imu_pose_b();
        let imu_twist_b = self.kinematics.velocities_w()[self.model.imu_body];
        let rate = inertial.angular_velocity - self.filter.gyro_bias;
        for k in 0..self.model.feet.len() {
            let foot = &self.model.feet[k];
            let sole_b = self.sole_pose_b(k);
            let origin = imu_pose_b.inverse().transform_point(&sole_b.translation);
            let reach_w = self.filter.rotation * origin;
            let point_s = self.feet[k].pressure_point.push(0.0);
            let point_b = sole_b.transform_point(&point_s);
            let point = imu_pose_b.inverse().transform_point(&point_b);
            // Motion of the foot against the unit, in the unit's axes.
            let twist_b = self.kinematics.velocities_w()[foot.body];
            let turning_b = twist_b.angular - imu_twist_b.angular;
            let moving_b = (twist_b.linear - imu_twist_b.linear) + turning_b.cross(&point_b);
            let to_imu = imu_pose_b.rotation.transpose();
            let (turning, moving) = (to_imu * turning_b, to_imu * moving_b);
            let sole_rate = rate + turning;
            let loaded = self.feet[k].loaded;
            let lever = point_s.norm().max(0.02);
            let turned = sole_rate.norm() * lever * duration;
            let walk = libm::sqrt(
                (c.contact_walk * c.contact_walk + self.shakes[k].variance() * SHAKE_MEMORY_S) * duration
                    + turned * turned,
            );
            self.filter.set_foot(k, loaded, &(self.filter.position + reach_w), walk);
            if !loaded {
                self.shakes[k] = Shake::default();
                continue;
            }
            let share = (self.feet[k].load_n / self.weight).clamp(c.load_off, 1.0);
            // What carries little may move.
            let looseness = if self.feet[k].load_n > 0.0 { (0.3 / share).max(1.0) } else { 1.0 };
            let legs = self.leg_noise(k, &point_b);
            let speed = rate.cross(&point) + moving;
            let mut moved = false;
            for axis in 0..3 {
                let position = c.position_noise * c.position_noise * legs.0[axis] + 1e-12;
                let row = self.filter.foot_row(k, axis, &reach_w, position);
                if self.filter.take(&row) > MOVED_FOOT {
                    moved = true;
                }
                let lever = point.norm_squared() * 2.0 / 3.0;
                let velocity = c.velocity_noise * c.velocity_noise * legs.0[axis]
                    + c.gyro_noise * c.gyro_noise * lever
                    + square(c.contact_velocity * looseness);
                let mut row = self.filter.contact_row(axis, &point, &speed, velocity);
                let shaking = self.shakes[k].update(axis, row.residual, velocity, duration);
                row.variance += shaking * (SHAKE_MEMORY_S / duration).max(1.0);
                self.filter.take(&row);
            }
            if moved {
                self.filter.set_foot(k, false, &(self.filter.position + reach_w), 0.0);
            }
            if foot.polygon.len() < 3 {
                continue;
            }
            let turning_noise = c.velocity_noise * c.velocity_noise * legs.1 + c.gyro_noise * c.gyro_noise;
            for axis in 2..3 {
                let variance = turning_noise + square(c.sole_rate * looseness);
                let row = self.filter.sole_row(axis, &sole_rate, variance);
                self.filter.take(&row);
            }
        }
        self.filter.correct();
    }

    /// Sum of the squared columns of a foot point's Jacobian, per axis of {0}, m²; and the number of joints that turn the foot.
    fn leg_noise(&self, foot: usize, point_b: &Vector3<f64>) -> (Vector3<f64>, f64) {
        let tree = &self.model.tree;
        let (mut squares, mut turning) = (Vector3::zeros(), 0.0);
        let to_base = self.filter.rotation * self.imu_pose_b().rotation.transpose();
        let first = tree.first_joint_body();
        let mut body = Some(self.model.feet[foot].body);
        while let Some(at) = body.filter(|at| *at >= first) {
            let twist = self.kinematics.joint_twists_w()[at];
            let column = to_base * (twist.linear + twist.angular.cross(point_b));
            squares += column.component_mul(&column);
            turning += twist.angular.norm_squared() / 3.0;
            body = tree.bodies()[at].parent;
        }
        (squares, turning)
    }

    fn take_motion_capture(&mut self, pose: &RigidTransform, twist: &Twist, inertial: Option<&Inertial>) {
        let imu_rotation_w = pose.rotation * self.imu_pose_b().rotation;
        // What the gyroscope says beyond what is seen is its bias, smoothed.
        let seen = self
            .imu_pose_b()
            .rotation
            .tr_mul(&(twist.angular + self.kinematics.velocities_w()[self.model.imu_body].angular));
        let mut gyro_bias = self.estimate.gyro_bias;
        if let Some(inertial) = inertial {
            gyro_bias += (inertial.angular_velocity - seen - gyro_bias) * 0.01;
        }
        self.estimate = BaseEstimate {
            base_link_pose_w: *pose,
            base_twist_b: *twist,
            imu_rotation_w,
            gyro_bias,
            attitude_is_measured: true,
            ..self.estimate
        };
    }

    fn stand_on_reference_foot(&mut self) {
        let base_link_pose_w = self.pose_over_reference_foot();
        let mut base_twist_b = Twist::default();
        if let Some(foot) = self.model.feet.get(self.model.reference_foot) {
            // The foot rests: the base moves against it.
            let twist = self.kinematics.velocities_w()[foot.body];
            base_twist_b = Twist { angular: -twist.angular, linear: -twist.linear };
        }
        let imu_rotation_w = base_link_pose_w.rotation * self.imu_pose_b().rotation;
        self.estimate = BaseEstimate {
            base_link_pose_w,
            base_twist_b,
            imu_rotation_w,
            attitude_is_measured: false,
            ..self.estimate
        };
    }

    fn place_feet(&mut self) {
        let base = self.estimate.base_link_pose_w;
        let base_twist = self.estimate.base_twist_b;
        for k in 0..self.feet.len() {
            let sole_b = self.sole_pose_b(k);
            let twist = self.kinematics.velocities_w()[self.model.feet[k].body];
            let total = Twist {
                angular: base_twist.angular + twist.angular,
                linear: base_twist.linear + twist.linear,
            };
            self.feet[k].sole_pose_w = base * sole_b;
            self.feet[k].sole_twist_s = sole_b.inverse_transform_twist(&total);
        }
    }
}

fn square(x: f64) -> f64 {
    x * x
}
