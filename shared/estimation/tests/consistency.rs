//! A robot that sways on a foot that rests: errors of tilt, heading and velocity against what the filter says of them, its biases, and what
//! a foot that is moved does to it. Sensors are simulated from the exact motion, seeded.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use delmpc_estimation::prelude::*;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::log_rotation;

const PERIOD: f64 = 0.005;
const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);

/// Normal deviates: SplitMix64 and the polar method's cheaper cousin, the sum of twelve.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }

    fn vector(&mut self, deviation: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| deviation * self.normal())
    }
}

/// A block of 40 kg, 0.9 m above a foot, on an ankle of two joints.
fn model() -> EstimatorModel {
    let block = LinkInertia::new(40.0, Vector3::zeros(), Matrix3::identity());
    let link = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.01);
    let mut tree = TreeBuilder::floating_base(GRAVITY, block);
    let ankle = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.8));
    let pitch = tree.add(Body::new(Some(0), Joint::revolute(Vector3::y(), ankle), link));
    tree.add(Body::new(Some(pitch), Joint::revolute(Vector3::x(), RigidTransform::identity()), link));
    let sole = RigidTransform::from_translation(Vector3::new(0.05, 0.0, -0.1));
    let polygon = vec![[-0.1, -0.06], [0.1, -0.06], [0.1, 0.06], [-0.1, 0.06]];
    EstimatorModel::new(tree.build().unwrap(), vec![FootModel { body: 2, sole, polygon }])
}

fn sway(time: f64) -> [f64; 2] {
    [0.06 * (2.1 * time).sin(), 0.04 * (3.3 * time).sin()]
}

/// The base link in {0}, with the sole at `sole_w`.
fn base_at(
    kinematics: &mut Kinematics,
    model: &EstimatorModel,
    time: f64,
    sole_w: &RigidTransform,
) -> RigidTransform {
    let origin = base_pose_from_link(&model.tree, &RigidTransform::identity());
    kinematics.update_positions(&model.tree, &Configuration::floating(origin, &sway(time))).unwrap();
    *sole_w * (kinematics.link_poses_w()[2] * model.feet[0].sole).inverse()
}

/// What a run ends with: squared error over covariance of (tilt, velocity), and the root mean squares of tilt and velocity.
struct Outcome {
    normalised: f64,
    tilt_rms: f64,
    velocity_rms: f64,
    gyro_bias_error: f64,
}

fn run(seed: u64, seconds: f64, config: &EstimatorConfig, sole_w: impl Fn(f64) -> RigidTransform) -> Outcome {
    let model = model();
    let mut kinematics = Kinematics::new(&model.tree);
    let mut noise = Noise(seed);
    let gyro_bias = noise.vector(config.gyro_bias);
    let accelerometer_bias = noise.vector(config.accelerometer_bias);
    let mut estimator = Estimator::new(model.clone(), *config).unwrap();
    let h = config.sample_s;
    let (mut angle, mut velocity_sum) = (Vector3::zeros(), Vector3::zeros());
    let weight = Wrench::new(Vector3::zeros(), Vector3::new(0.0, 0.0, 42.0 * 9.81));
    let (mut tilts, mut velocities, mut count) = (0.0, 0.0, 0.0);
    let mut normalised = 0.0;
    let samples = (seconds / h).round() as usize;
    let per_period = (PERIOD / h).round() as usize;
    for k in 0..=samples {
        let time = k as f64 * h;
        let pose = |kinematics: &mut Kinematics, time: f64| base_at(kinematics, &model, time, &sole_w(time));
        let (before, now, after) =
            (pose(&mut kinematics, time - h), pose(&mut kinematics, time), pose(&mut kinematics, time + h));
        let rate = log_rotation(&before.rotation.tr_mul(&after.rotation)) / (2.0 * h);
        let speed = (after.translation - before.translation) / (2.0 * h);
        let acceleration = (after.translation - now.translation * 2.0 + before.translation) / (h * h);
        let gyro = rate + gyro_bias + noise.vector(config.gyro_noise);
        let force = now.rotation.tr_mul(&(acceleration - GRAVITY))
            + accelerometer_bias
            + noise.vector(config.accelerometer_noise);
        if k > 0 {
            angle += gyro * h;
            velocity_sum += force * h;
        }
        if k % per_period != 0 {
            continue;
        }
        let q = sway(time);
        let (ahead, behind) = (sway(time + h), sway(time - h));
        let position = q.map(|q| q + config.position_noise * noise.normal());
        let mut velocity = [0.0; 2];
        for j in 0..2 {
            velocity[j] = (ahead[j] - behind[j]) / (2.0 * h) + config.velocity_noise * noise.normal();
        }
        let feet = [FootMeasurement { wrench_s: Some(weight), touches: true }];
        let sums = Some((angle, velocity_sum));
        let inertial = Inertial { angular_velocity: gyro, specific_force: force, sums };
        let measurement = Measurement {
            time_s: time,
            position: &position,
            velocity: &velocity,
            inertial: Some(inertial),
            feet: &feet,
            motion_capture: None,
        };
        estimator.update(&measurement).unwrap();
        let estimate = estimator.estimate();
        let error = log_rotation(&(now.rotation * estimate.base_link_pose_w.rotation.transpose()));
        let velocity_error = speed - estimate.base_link_pose_w.rotation * estimate.base_twist_b.linear;
        if time > 0.5 {
            tilts += error.xy().norm_squared();
            velocities += velocity_error.norm_squared();
            count += 1.0;
        }
        let covariance = estimator.base_filter().covariance_of_motion();
        let kept = [0, 1, 3, 4, 5];
        let part = nalgebra::Matrix5::from_fn(|i, j| covariance[(kept[i], kept[j])]);
        let e =
            nalgebra::Vector5::new(error.x, error.y, velocity_error.x, velocity_error.y, velocity_error.z);
        normalised = e.dot(&(part.try_inverse().unwrap() * e));
    }
    let found = estimator.estimate().gyro_bias;
    Outcome {
        normalised,
        tilt_rms: f64::sqrt(tilts / count),
        velocity_rms: f64::sqrt(velocities / count),
        gyro_bias_error: (found - gyro_bias).xy().norm(),
    }
}

fn still(_: f64) -> RigidTransform {
    RigidTransform::identity()
}

#[test]
fn errors_are_as_large_as_the_filter_says() {
    // The ground of this simulation is rigid.
    let config = EstimatorConfig {
        gyro_bias: 0.0087,
        accelerometer_bias: 0.01,
        contact_velocity: 1e-4,
        contact_walk: 1e-5,
        ..EstimatorConfig::default()
    };
    let runs = 100;
    let outcomes: Vec<Outcome> = (0..runs).map(|seed| run(seed, 2.0, &config, still)).collect();
    let mean = outcomes.iter().map(|outcome| outcome.normalised).sum::<f64>() / runs as f64;
    let worst = |of: fn(&Outcome) -> f64| outcomes.iter().map(of).fold(0.0, f64::max);
    println!(
        "mean normalised error {mean:.2} of 5; worst rms tilt {:.2e} rad, velocity {:.2e} m/s, bias {:.1e} rad/s",
        worst(|o| o.tilt_rms),
        worst(|o| o.velocity_rms),
        worst(|o| o.gyro_bias_error)
    );
    // Chi-square with 500 degrees of freedom over 100: 95 % within 5 ± 0.62.
    assert!((mean - 5.0).abs() < 0.62, "{mean}");
    assert!(worst(|o| o.tilt_rms) < 0.2_f64.to_radians());
    assert!(worst(|o| o.velocity_rms) < 0.02);
    assert!(worst(|o| o.gyro_bias_error) < 2e-3);
}

#[test]
fn a_foot_that_rocks_or_is_moved_does_not_take_the_base_along() {
    let config = EstimatorConfig { gyro_bias: 0.0087, ..EstimatorConfig::default() };
    // Rocks about its edge by 2 degrees, twice a second; is moved by 20 mm within a tenth of a second at 1 s.
    let rocking = |time: f64| {
        let angle = 0.035 * (12.0 * time).sin().max(0.0).powi(2);
        let edge = RigidTransform::from_translation(Vector3::new(0.0, 0.06, 0.0));
        let turn = RigidTransform::from_xyz_rpy(Vector3::zeros(), Vector3::new(angle, 0.0, 0.0));
        edge * turn * edge.inverse()
    };
    let moved = |time: f64| {
        let way = (10.0 * (time - 1.0)).clamp(0.0, 1.0);
        RigidTransform::from_translation(Vector3::new(0.0, 0.02 * way * way * (3.0 - 2.0 * way), 0.0))
    };
    for seed in 0..5 {
        for outcome in [run(seed, 3.0, &config, rocking), run(seed, 3.0, &config, moved)] {
            assert!(outcome.tilt_rms < 0.6_f64.to_radians(), "{:.2e}", outcome.tilt_rms);
            assert!(outcome.velocity_rms < 0.1, "{:.2e}", outcome.velocity_rms);
        }
    }
}
