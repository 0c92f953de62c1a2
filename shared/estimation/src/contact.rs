//! Whether a foot carries load, and where.
//!
//! ```text
//! on:   f_z > max(load_on m g, 3 σ)  for debounce_s        off:  f_z < max(load_off m g, 1.5 σ)  for debounce_s
//! c = clamp_to_sole( (-τ_y, τ_x) / f_z )          pressure point: of a sole that rocks, the point that rests
//! ```
//!
//! Two thresholds, so that noise at one of them does not switch, and a time, so that one sample does not.

use delmpc_mechanics::spatial::{RigidTransform, Twist};
use nalgebra::Vector2;

use crate::model::{EstimatorConfig, FootMeasurement, FootModel};

/// What is known of a foot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootEstimate {
    /// Whether it carries load.
    pub loaded: bool,
    /// Normal force, N; 0 where nothing is measured.
    pub load_n: f64,
    /// Pressure point in the sole, m.
    pub pressure_point: Vector2<f64>,
    /// Distance of the measured pressure point from the sole's edge, m; negative outside, infinite when unknown.
    pub margin: f64,
    /// Sole frame in {0}.
    pub sole_pose_w: RigidTransform,
    /// Its twist in its own axes, at its origin.
    pub sole_twist_s: Twist,
}

impl Default for FootEstimate {
    fn default() -> Self {
        Self {
            loaded: false,
            load_n: 0.0,
            pressure_point: Vector2::zeros(),
            margin: f64::INFINITY,
            sole_pose_w: RigidTransform::identity(),
            sole_twist_s: Twist::default(),
        }
    }
}

/// So many standard deviations of its noise are a load.
const NOISE_DEVIATIONS: f64 = 3.0;

/// The switch of one foot.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ContactSwitch {
    /// When the measured load first contradicted the state.
    contradicted_s: Option<f64>,
    started: bool,
}

impl ContactSwitch {
    /// Takes a measurement in.
    pub fn update(
        &mut self,
        foot: &FootModel,
        measured: &FootMeasurement,
        weight: f64,
        config: &EstimatorConfig,
        time_s: f64,
        out: &mut FootEstimate,
    ) {
        let least = NOISE_DEVIATIONS * config.foot_force_noise;
        let (on, off) = ((config.load_on * weight).max(least), (config.load_off * weight).max(0.5 * least));
        let (above, below) = match &measured.wrench_s {
            Some(wrench) => {
                out.load_n = wrench.force.z;
                let point = Vector2::new(-wrench.torque.y, wrench.torque.x) / wrench.force.z;
                let flat = foot.polygon.len() >= 3;
                if flat && wrench.force.z > off && point.iter().all(|x| x.is_finite()) {
                    (out.pressure_point, out.margin) = clamp_to(&foot.polygon, point);
                }
                (wrench.force.z > on, wrench.force.z < off)
            }
            None => {
                out.load_n = 0.0;
                (measured.touches, !measured.touches)
            }
        };
        let contradicts = if out.loaded { below } else { above };
        if !self.started {
            self.started = true;
            out.loaded = above;
            return;
        }
        if !contradicts {
            self.contradicted_s = None;
            return;
        }
        let since = *self.contradicted_s.get_or_insert(time_s);
        if time_s - since >= config.debounce_s {
            out.loaded = !out.loaded;
            self.contradicted_s = None;
        }
    }
}

/// Velocity of a foot that has just been set down, m/s.
const SETTLING: f64 = 0.05;
/// Time in which it is forgotten, and in which the variance of a shaking foot is measured, s.
const SHAKE_S: f64 = 0.1;
/// By chance the variance over that time is larger than the expected one by this factor, and nothing shakes.
const CHANCE: f64 = 2.0;
/// Time over which the mean is taken about which a foot shakes, s.
const MEAN_S: f64 = 0.05;

/// How much a loaded contact point shakes, by the innovations of its velocity: the ground gives, the sole rocks. What is steady in them is
/// not the foot's but the base's, and is left to the filter.
///
/// ```text
/// m += (ν - m) t/T_m        s += ((ν - m)² - s) t/T_s        noise of the row gains max(0, s - 2 its own variance)
/// ```
///
/// Source: R. Mehra, *On the identification of variances and adaptive Kalman filtering*, IEEE TAC 15, 1970 (innovation variance).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shake {
    mean: [f64; 3],
    square: [f64; 3],
}

impl Default for Shake {
    fn default() -> Self {
        Self { mean: [0.0; 3], square: [SETTLING * SETTLING; 3] }
    }
}

impl Shake {
    /// Variance of the shaking, the axes' largest, (m/s)².
    pub fn variance(&self) -> f64 {
        self.square.iter().fold(0.0, |largest, square| square.max(largest))
    }

    /// Takes the innovation of an axis in; returns what its variance `expected` is short of.
    pub fn update(&mut self, axis: usize, innovation: f64, expected: f64, duration: f64) -> f64 {
        let (mean, square) = (&mut self.mean[axis], &mut self.square[axis]);
        let about = innovation - *mean;
        *mean += about * (duration / MEAN_S).min(1.0);
        *square += (about * about - *square) * (duration / SHAKE_S).min(1.0);
        (*square - CHANCE * expected).max(0.0)
    }
}

/// The nearest point of a convex polygon (counter-clockwise), and the distance of `point` from its edge, negative outside.
pub fn clamp_to(polygon: &[[f64; 2]], point: Vector2<f64>) -> (Vector2<f64>, f64) {
    if polygon.len() < 3 {
        return (Vector2::zeros(), f64::INFINITY);
    }
    let mut margin = f64::INFINITY;
    let mut nearest = (f64::INFINITY, point);
    for (k, a) in polygon.iter().enumerate() {
        let (a, b) = (Vector2::from(*a), Vector2::from(polygon[(k + 1) % polygon.len()]));
        let edge = b - a;
        let length = edge.norm();
        if length == 0.0 {
            continue;
        }
        let away = point - a;
        margin = margin.min((edge.x * away.y - edge.y * away.x) / length);
        let along = (edge.dot(&away) / (length * length)).clamp(0.0, 1.0);
        let candidate = a + edge * along;
        let distance = (point - candidate).norm();
        if distance < nearest.0 {
            nearest = (distance, candidate);
        }
    }
    if margin >= 0.0 { (point, margin) } else { (nearest.1, margin) }
}

#[cfg(test)]
mod tests {
    use delmpc_mechanics::spatial::Wrench;
    use nalgebra::Vector3;
    use std::vec;
    use std::vec::Vec;

    use super::*;

    fn foot() -> FootModel {
        let polygon = vec![[-0.1, -0.05], [0.1, -0.05], [0.1, 0.05], [-0.1, 0.05]];
        FootModel { body: 0, sole: RigidTransform::identity(), polygon }
    }

    #[test]
    fn load_switches_with_hysteresis_and_after_the_debounce_time() {
        let (config, foot) = (EstimatorConfig { debounce_s: 0.002, ..EstimatorConfig::default() }, foot());
        let (mut switch, mut out) = (ContactSwitch::default(), FootEstimate::default());
        // Of a weight of 1000 N: on above 50, off below 20.
        let loads = [0.0, 60.0, 0.0, 60.0, 60.0, 60.0, 30.0, 30.0, 30.0, 10.0, 10.0, 60.0, 10.0, 10.0, 10.0];
        let seen: Vec<bool> = loads
            .iter()
            .enumerate()
            .map(|(k, load)| {
                let wrench_s = Some(Wrench::new(Vector3::zeros(), Vector3::new(0.0, 0.0, *load)));
                let measured = FootMeasurement { wrench_s, touches: false };
                switch.update(&foot, &measured, 1000.0, &config, 1e-3 * k as f64, &mut out);
                out.loaded
            })
            .collect();
        let on: Vec<usize> = (0..seen.len()).filter(|&k| seen[k]).collect();
        assert_eq!(on, [5, 6, 7, 8, 9, 10, 11, 12, 13]);
    }

    #[test]
    fn a_pressure_point_outside_is_led_back_to_the_edge() {
        let polygon = foot().polygon;
        assert_eq!(clamp_to(&polygon, Vector2::new(0.02, 0.03)), (Vector2::new(0.02, 0.03), 0.05 - 0.03));
        let (point, margin) = clamp_to(&polygon, Vector2::new(0.12, 0.0));
        assert!((point - Vector2::new(0.1, 0.0)).norm() < 1e-15 && (margin + 0.02).abs() < 1e-15);
        let (corner, _) = clamp_to(&polygon, Vector2::new(0.2, 0.2));
        assert!((corner - Vector2::new(0.1, 0.05)).norm() < 1e-15);
    }
}
