//! The contact-aided Kalman filter of the base: an error-state filter with the attitude error in {0}.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `R`, `v`, `p` | the inertial unit in {0}: axes, velocity, origin | 1, m/s, m |
//! | `b_ω`, `b_a` | biases of gyroscope and accelerometer | rad/s, m/s² |
//! | `d_i` | where the sole origin of foot i rests in {0} | m |
//! | `θ` | attitude error in {0}: true `R = exp(θ^) R̂` | rad |
//! | `Θ`, `V` | what gyroscope and accelerometer sum up between two measurements | rad, m/s |
//! | `r`, `ṙ` | a point of a foot in the axes of the unit, from its origin, and its velocity there by the joints | m, m/s |
//!
//! ```text
//! propagation     R := R exp((Θ - b_ω t)^)      a = R_mid (V - b_a t)      v := v + a + g t      p := p + (v_old + v) t / 2
//!                 δθ⁺ = θ - R t δb_ω            δv⁺ = δv - a^ θ - R t δb_a        δp⁺ = δp + t δv - ½ t a^ θ
//! foot rests      0 = d_i - p - R r_i           δ: δd_i - δp + (R r_i)^ θ
//! contact point   0 = v + R (ω × r_c + ṙ_c)     δ: δv - (R(..))^ θ + R r_c^ δb_ω       c: the pressure point
//! sole            0 = R (ω + ω_sole)            δ: -R δb_ω
//! ```
//!
//! A foot that rocks rests at its pressure point, not at its sole's origin: so the second row takes that point, and the first one counts
//! less the faster the sole turns. A place or turn whose innovation is beyond three standard deviations counts as that much less
//! certain: a foot that was moved does not pull the base along. A velocity is not judged like that, or a filter once wrong would stay so. Rows are taken one by one; their noise is that of the encoders through the leg, of the
//! gyroscope through the lever, and of the contact.
//!
//! Gravity's direction, the velocity and both biases of the gyroscope that tilt the base are observable on one foot at rest; the
//! accelerometer's horizontal bias is not told from a tilt, which its covariance says. Position and heading are those of the feet.
//!
//! Cost: O(N²) a row with `N = 15 + 3 feet`; some 6 to 9 rows a loaded foot. No allocation after [`BaseFilter::new`].
//!
//! Source: R. Hartley, M. Ghaffari, R. Eustice, J. Grizzle, *Contact-aided invariant extended Kalman filtering for robot state
//! estimation*, IJRR 39, 2020 (states and contact rows; its error lives in the group, ours is the attitude error in {0} with the others
//! additive); M. Bloesch et al., *State estimation for legged robots - consistent fusion of leg kinematics and IMU*, RSS 2012 (feet as
//! states).

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::spatial::{exp_rotation, skew};
use nalgebra::{Matrix3, Vector3};

use crate::model::EstimatorConfig;

/// Places of the parts in the error state.
const THETA: usize = 0;
const VELOCITY: usize = 3;
const POSITION: usize = 6;
const GYRO_BIAS: usize = 9;
const ACCELEROMETER_BIAS: usize = 12;
const FEET: usize = 15;
/// Innovation in standard deviations from which on a row counts less.
const GATE: f64 = 3.0;
/// Standard deviation of the place of a foot that does not rest, m.
const LOST_FOOT: f64 = 1.0;

/// A row of a measurement: what it is of the error state, what is left, and how certain it is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row {
    /// Blocks of three: place and coefficients; unused ones have coefficient zero.
    pub blocks: [(usize, Vector3<f64>); 3],
    /// Measured less expected.
    pub residual: f64,
    /// Variance of the noise.
    pub variance: f64,
    /// Innovation in standard deviations from which on it counts less.
    pub gate: f64,
}

/// The state with its covariance.
#[derive(Clone, Debug)]
pub struct BaseFilter {
    size: usize,
    pub(crate) rotation: Matrix3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) position: Vector3<f64>,
    pub(crate) gyro_bias: Vector3<f64>,
    pub(crate) accelerometer_bias: Vector3<f64>,
    feet: Vec<Vector3<f64>>,
    rests: Vec<bool>,
    covariance: Vec<f64>,
    correction: Vec<f64>,
    column: Vec<f64>,
    gravity: Vector3<f64>,
}

impl BaseFilter {
    /// For `feet` feet, with nothing known.
    pub fn new(feet: usize, gravity_w: Vector3<f64>) -> Self {
        let size = FEET + 3 * feet;
        Self {
            size,
            rotation: Matrix3::identity(),
            velocity: Vector3::zeros(),
            position: Vector3::zeros(),
            gyro_bias: Vector3::zeros(),
            accelerometer_bias: Vector3::zeros(),
            feet: vec![Vector3::zeros(); feet],
            rests: vec![false; feet],
            covariance: vec![0.0; size * size],
            correction: vec![0.0; size],
            column: vec![0.0; size],
            gravity: gravity_w,
        }
    }

    /// Starts at a pose, at rest within 0.1 m/s; the heading is by definition the one given.
    pub fn start(&mut self, rotation: Matrix3<f64>, position: Vector3<f64>, config: &EstimatorConfig) {
        (self.rotation, self.position) = (rotation, position);
        self.velocity = Vector3::zeros();
        self.gyro_bias = Vector3::zeros();
        self.accelerometer_bias = Vector3::zeros();
        self.rests.fill(false);
        self.covariance.fill(0.0);
        let tilt = config.first_tilt;
        for (place, deviation) in [
            (THETA, [tilt, tilt, 1e-3]),
            (VELOCITY, [0.1; 3]),
            (POSITION, [1e-3; 3]),
            (GYRO_BIAS, [config.gyro_bias; 3]),
            (ACCELEROMETER_BIAS, [config.accelerometer_bias; 3]),
        ] {
            for (k, deviation) in deviation.iter().enumerate() {
                self.set_variance(place + k, deviation * deviation);
            }
        }
        for k in FEET..self.size {
            self.set_variance(k, LOST_FOOT * LOST_FOOT);
        }
    }

    /// Whether all of the state is a number.
    pub fn is_finite(&self) -> bool {
        self.rotation.iter().all(|x| x.is_finite())
            && self.velocity.iter().chain(&self.position).all(|x| x.is_finite())
            && self.covariance.iter().all(|x| x.is_finite())
    }

    /// Moves on by `duration` (s) in which the unit summed up the angle `Θ` and the velocity `V`.
    pub fn propagate(
        &mut self,
        angle: &Vector3<f64>,
        velocity: &Vector3<f64>,
        duration: f64,
        config: &EstimatorConfig,
    ) {
        let turn = angle - self.gyro_bias * duration;
        let middle = self.rotation * exp_rotation(&(0.5 * turn));
        let gained = middle * (velocity - self.accelerometer_bias * duration);
        let old_rotation = self.rotation;
        self.rotation = orthonormal(&(self.rotation * exp_rotation(&turn)));
        let old_velocity = self.velocity;
        self.velocity += gained + self.gravity * duration;
        self.position += (old_velocity + self.velocity) * (0.5 * duration);

        // P := (1 + G) P (1 + G)ᵀ, the blocks of G by columns: rows first, then columns.
        let by_bias = -old_rotation * duration;
        let by_tilt = -skew(&gained);
        let blocks = [
            // Position first: it needs the old velocity and tilt.
            (POSITION, VELOCITY, Matrix3::identity() * duration),
            (POSITION, THETA, by_tilt * (0.5 * duration)),
            (VELOCITY, THETA, by_tilt),
            (VELOCITY, ACCELEROMETER_BIAS, by_bias),
            (THETA, GYRO_BIAS, by_bias),
        ];
        for transposed in [false, true] {
            for (to, from, block) in &blocks {
                self.add_product(*to, *from, block, transposed);
            }
        }
        self.add_process_noise(duration, config);
    }

    /// Rows (or columns) `to` of P gain `block` times rows (columns) `from`.
    fn add_product(&mut self, to: usize, from: usize, block: &Matrix3<f64>, transposed: bool) {
        let n = self.size;
        let at = |row: usize, column: usize| if transposed { column * n + row } else { row * n + column };
        for column in 0..n {
            let source = Vector3::from_fn(|k, _| self.covariance[at(from + k, column)]);
            let gain = block * source;
            for k in 0..3 {
                self.covariance[at(to + k, column)] += gain[k];
            }
        }
    }

    fn add_process_noise(&mut self, duration: f64, config: &EstimatorConfig) {
        // White noise of one sample, summed up over the samples in between.
        let per_sample = config.sample_s * duration;
        let square = |x: f64| x * x;
        let noise = [
            (THETA, square(config.gyro_noise) * per_sample),
            (VELOCITY, square(config.accelerometer_noise) * per_sample),
            (POSITION, square(0.5 * config.accelerometer_noise * duration) * per_sample),
            (GYRO_BIAS, square(config.gyro_bias_walk) * duration),
            (ACCELEROMETER_BIAS, square(config.accelerometer_bias_walk) * duration),
        ];
        for (place, variance) in noise {
            for k in place..place + 3 {
                self.covariance[k * self.size + k] += variance;
            }
        }
    }

    /// A foot is loaded (`place_w`: where kinematics has its sole's origin) or not. While it rests its place walks by the deviation
    /// `walk` (m) since the last call; one that was not resting is put where it is.
    pub fn set_foot(&mut self, foot: usize, loaded: bool, place_w: &Vector3<f64>, walk: f64) {
        let place = FEET + 3 * foot;
        if loaded && self.rests[foot] {
            for k in place..place + 3 {
                self.covariance[k * self.size + k] += walk * walk;
            }
            return;
        }
        self.rests[foot] = loaded;
        self.feet[foot] = *place_w;
        for k in place..place + 3 {
            self.set_variance(k, LOST_FOOT * LOST_FOOT);
        }
    }

    /// Row `axis` of the resting foot: `reach_w` is `R r`.
    pub(crate) fn foot_row(&self, foot: usize, axis: usize, reach_w: &Vector3<f64>, variance: f64) -> Row {
        let residual = -(self.feet[foot] - self.position - reach_w)[axis];
        let unit = unit(axis);
        let blocks =
            [(FEET + 3 * foot, unit), (POSITION, -unit), (THETA, skew(reach_w).row(axis).transpose())];
        Row { blocks, residual, variance, gate: GATE }
    }

    /// Row `axis` of the resting contact point: `reach` is `r_c`, `speed` is `ω × r_c + ṙ_c`, both in the axes of the unit.
    pub(crate) fn contact_row(
        &self,
        axis: usize,
        reach: &Vector3<f64>,
        speed: &Vector3<f64>,
        variance: f64,
    ) -> Row {
        let speed_w = self.rotation * speed;
        let blocks = [
            (VELOCITY, unit(axis)),
            (THETA, -skew(&speed_w).row(axis).transpose()),
            (GYRO_BIAS, (self.rotation * skew(reach)).row(axis).transpose()),
        ];
        Row { blocks, residual: -(self.velocity + speed_w)[axis], variance, gate: f64::INFINITY }
    }

    /// Row `axis` of a sole that does not turn: `rate` is its angular velocity in the axes of the unit.
    pub(crate) fn sole_row(&self, axis: usize, rate: &Vector3<f64>, variance: f64) -> Row {
        let blocks = [
            (GYRO_BIAS, -self.rotation.row(axis).transpose()),
            (THETA, Vector3::zeros()),
            (THETA, Vector3::zeros()),
        ];
        Row { blocks, residual: -(self.rotation * rate)[axis], variance, gate: GATE }
    }

    /// Row of gravity's direction felt at rest: `axis` 0 or 1 of `R (f - b_a) / g`.
    pub(crate) fn level_row(&self, axis: usize, specific_force: &Vector3<f64>, variance: f64) -> Row {
        let gravity = self.gravity.norm();
        let up_w = self.rotation * (specific_force - self.accelerometer_bias) / gravity;
        // True: e_z. 0 = up_w + θ × up_w - R δb_a / g along x and y.
        let blocks = [
            (THETA, -skew(&up_w).row(axis).transpose()),
            (ACCELEROMETER_BIAS, -self.rotation.row(axis).transpose() / gravity),
            (THETA, Vector3::zeros()),
        ];
        Row { blocks, residual: -up_w[axis], variance, gate: f64::INFINITY }
    }

    /// Takes one row in; its correction waits for [`BaseFilter::correct`]. Returns the innovation in standard deviations.
    pub(crate) fn take(&mut self, row: &Row) -> f64 {
        let n = self.size;
        self.column.fill(0.0);
        for (place, coefficients) in &row.blocks {
            for (k, coefficient) in coefficients.iter().enumerate().filter(|(_, c)| **c != 0.0) {
                let source = &self.covariance[(place + k) * n..(place + k + 1) * n];
                for (sum, p) in self.column.iter_mut().zip(source) {
                    *sum += coefficient * p;
                }
            }
        }
        let dot = |values: &[f64]| -> f64 {
            row.blocks
                .iter()
                .map(|(place, coefficients)| {
                    coefficients.iter().enumerate().map(|(k, c)| c * values[place + k]).sum::<f64>()
                })
                .sum()
        };
        let predicted = dot(&self.column);
        let innovation = row.residual - dot(&self.correction);
        let mut variance = predicted + row.variance;
        let usable = variance > 0.0 && innovation.is_finite();
        if !usable {
            return f64::INFINITY;
        }
        let deviations = innovation.abs() / libm::sqrt(variance);
        if deviations > row.gate {
            // As uncertain as it takes for the innovation to be at the gate.
            variance *= (deviations / row.gate) * (deviations / row.gate);
        }
        let scale = innovation / variance;
        for (correction, column) in self.correction.iter_mut().zip(&self.column) {
            *correction += scale * column;
        }
        for i in 0..n {
            let gain = self.column[i] / variance;
            if gain == 0.0 {
                continue;
            }
            for (p, column) in self.covariance[i * n..(i + 1) * n].iter_mut().zip(&self.column) {
                *p -= gain * column;
            }
        }
        deviations
    }

    /// Applies what all rows since the last call have asked for.
    pub(crate) fn correct(&mut self) {
        let part = |place: usize| Vector3::from_column_slice(&self.correction[place..place + 3]);
        self.rotation = orthonormal(&(exp_rotation(&part(THETA)) * self.rotation));
        self.velocity += part(VELOCITY);
        self.position += part(POSITION);
        self.gyro_bias += part(GYRO_BIAS);
        self.accelerometer_bias += part(ACCELEROMETER_BIAS);
        for (k, foot) in self.feet.iter_mut().enumerate() {
            *foot += Vector3::from_column_slice(&self.correction[FEET + 3 * k..FEET + 3 * k + 3]);
        }
        self.correction.fill(0.0);
        // Round-off must not make it asymmetric or negative.
        let n = self.size;
        for i in 0..n {
            self.covariance[i * n + i] = self.covariance[i * n + i].max(1e-18);
            for j in 0..i {
                let mean = 0.5 * (self.covariance[i * n + j] + self.covariance[j * n + i]);
                self.covariance[i * n + j] = mean;
                self.covariance[j * n + i] = mean;
            }
        }
    }

    /// Covariance of attitude (its error in {0}) and velocity, with each other: rows and columns `θ`, `v`.
    pub fn covariance_of_motion(&self) -> nalgebra::Matrix6<f64> {
        nalgebra::Matrix6::from_fn(|i, j| self.covariance[i * self.size + j])
    }

    fn set_variance(&mut self, index: usize, variance: f64) {
        for k in 0..self.size {
            self.covariance[index * self.size + k] = 0.0;
            self.covariance[k * self.size + index] = 0.0;
        }
        self.covariance[index * self.size + index] = variance;
    }
}

fn unit(axis: usize) -> Vector3<f64> {
    let mut unit = Vector3::zeros();
    unit[axis] = 1.0;
    unit
}

/// One step of Newton's iteration for the polar factor: enough for what products of rotations lose.
fn orthonormal(rotation: &Matrix3<f64>) -> Matrix3<f64> {
    rotation * (Matrix3::identity() * 1.5 - rotation.tr_mul(rotation) * 0.5)
}
