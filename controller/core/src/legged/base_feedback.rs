//! The base's part of the gain, told to a servo that has no base to read: by gyroscope and by the legs that stand.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `θ`, `p` | deviation of the base: rotation, mass centre of the base body, both in its axes | rad, m |
//! | `ω`, `v` | deviation of its angular and linear velocity, in its axes; `ω₀`: angular velocity in the plan | rad/s, m/s |
//! | `φ`, `ω_i` | deviation of the gyroscope's sum and of its rate, in the axes of the inertial unit | rad, rad/s |
//! | `M`, `a_j` | axes of the inertial unit in those of the base; axes of the joints between the two | |
//! | `r`, `J = ∂r/∂q`, `J̇` | a standing foot from the base's mass centre, in the base's axes | m, m/rad |
//! | `s` | share of the feet in the weight, as planned, of those that are flat and felt to carry something; their sum is 1 | |
//! | `K_θ`, `K_p`, `K_ω`, `K_v` | columns of the gain on the base, three each | N m per unit of the above |
//!
//! ```text
//! θ = M φ - Σ_j a_j δq_j                          ω = M ω_i - Σ_j a_j δq̇_j + Σ_j a_j × (ω₀ + Σ_{k ≤ j} a_k q̇_k) δq_j
//! p = Σ s ( r × θ - J δq )                        v = Σ s ( r × ω - (ω₀× J + J̇) δq - J δq̇ )
//! K_θ θ + K_p p + K_ω ω + K_v v                   so gains on gyroscope and joints
//! ```
//!
//! The second line is a foot that stays where it is, differentiated. The joints' columns of the gain alone are no law: with them
//! the robot stands as long as a new command comes every cycle.
//!
//! Source: own derivation; [`crate::level_stance`] is its relative for a robot on one foot.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_estimation::prelude::BaseEstimate;
use delmpc_horizon::legged_model::LeggedModel;
use delmpc_mechanics::contact_stage::BoundaryState;
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity, base_pose_from_link};
use delmpc_mechanics::spatial::{RigidTransform, Twist, log_rotation};
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::{Command, MAX_JOINTS, MAX_SEGMENTS};
use faer::{Mat, MatRef};
use nalgebra::{Matrix3, RowVector3, Vector3};

/// Time over which turning and Jacobians are differenced, s.
pub(crate) const MOMENT_S: f64 = 1e-3;
/// A stage whose feet carry less than this part of the weight tells nothing of the base's place.
const LEAST_SHARE: f64 = 0.05;

/// How the inertial unit turns where a segment begins.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Turning {
    /// Axes of the inertial unit in {0}.
    pub rotation_w: Matrix3<f64>,
    /// Its angular velocity, rad/s, and its derivative, rad/s², in its axes.
    pub rate: Vector3<f64>,
    pub acceleration: Vector3<f64>,
}

/// Gains on the base, and what is needed to tell them.
#[derive(Debug)]
pub(crate) struct BaseFeedback {
    kinematics: Kinematics,
    imu_body: usize,
    mounting: Matrix3<f64>,
    /// Joints between the base and the inertial unit.
    chain: Vec<usize>,
    /// `K_θ K_p K_ω K_v`: joints x 12.
    gain: Mat<f64>,
    turnings: [Turning; MAX_SEGMENTS],
    /// `J` and `J̇ + ω₀×J` of the feet's mean, three rows of joints each.
    jacobian: [Vec<Vector3<f64>>; 2],
    later: Vec<f64>,
    /// Axes of the joints of the chain in the base's axes, and how they turn.
    axes: Vec<(Vector3<f64>, Vector3<f64>)>,
}

impl BaseFeedback {
    /// For an inertial unit on `imu_body`, whose axes are the columns of `mounting` in that body's link axes. No gain yet.
    pub fn new(tree: &KinematicTree, imu_body: usize, mounting: Matrix3<f64>) -> Self {
        let joints = tree.joint_count();
        let branch = tree.branch(imu_body).iter().filter(|dof| **dof >= 6);
        Self {
            kinematics: Kinematics::new(tree),
            imu_body,
            mounting,
            chain: branch.map(|dof| *dof as usize - 6).collect(),
            gain: Mat::zeros(joints, 12),
            turnings: [Turning::default(); MAX_SEGMENTS],
            jacobian: [vec![Vector3::zeros(); joints], vec![Vector3::zeros(); joints]],
            later: vec![0.0; joints],
            axes: vec![(Vector3::zeros(), Vector3::zeros()); joints],
        }
    }

    /// A law without feedback on the base.
    pub fn clear(&mut self) {
        self.gain.fill(0.0);
    }

    /// Takes the base's columns of a gain on all of `(θ, p, q, ω, v, q̇)`.
    pub fn take_gain(&mut self, gain: MatRef<'_, f64>) {
        let nv = gain.ncols() / 2;
        for i in 0..self.gain.nrows() {
            for k in 0..6 {
                self.gain[(i, k)] = gain[(i, k)];
                self.gain[(i, 6 + k)] = gain[(i, nv + k)];
            }
        }
    }

    /// `K` on a deviation of the base: torque of joint `i` for `(θ, p)` and `(ω, v)`.
    pub fn torque(&self, i: usize, place: &[f64], velocity: &[f64]) -> f64 {
        (0..6).map(|k| self.gain[(i, k)] * place[k] + self.gain[(i, 6 + k)] * velocity[k]).sum()
    }

    /// How the inertial unit turns where segment `segment` begins, from the states there and [`MOMENT_S`] later. Two passes over the
    /// tree, no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a state of another robot.
    pub fn take_turning(
        &mut self,
        tree: &KinematicTree,
        segment: usize,
        now: &BoundaryState,
        later: &BoundaryState,
    ) -> Result<(), ModelError> {
        let (rotation_w, rate) = self.turning(tree, now)?;
        let acceleration = (self.turning(tree, later)?.1 - rate) / MOMENT_S;
        self.turnings[segment] = Turning { rotation_w, rate, acceleration };
        Ok(())
    }

    fn turning(
        &mut self,
        tree: &KinematicTree,
        state: &BoundaryState,
    ) -> Result<(Matrix3<f64>, Vector3<f64>), ModelError> {
        self.kinematics.update_positions(tree, &Configuration::floating(state.base_pose_w(), &state.q))?;
        let velocity = Velocity::floating(state.base_twist_w(), &state.rate);
        self.kinematics.update_velocities(tree, &velocity)?;
        let rotation_w = self.kinematics.link_poses_w()[self.imu_body].rotation * self.mounting;
        let rate_w = self.kinematics.velocities_w()[self.imu_body].angular;
        Ok((rotation_w, rotation_w.tr_mul(&rate_w)))
    }

    /// Tells the gain: adds to those on the joints, sets those on the inertial unit and its reference. `start` is the state at which
    /// the command begins, `shares` the feet's parts of the weight (one each, 0: it tells nothing), `angle` the gyroscope's sum (rad)
    /// and `measured` the base at the measurement, `q` the joints there, `since_s` the time from there to the command's begin. Three
    /// passes over the tree and O(n²), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a state of another robot.
    #[allow(clippy::too_many_arguments)]
    pub fn write(
        &mut self,
        model: &LeggedModel,
        start: &BoundaryState,
        shares: &[f64],
        (angle, measured, q): (&Vector3<f64>, &BaseEstimate, &[f64]),
        since_s: f64,
        command: &mut Command,
    ) -> Result<(), ModelError> {
        let tree = &model.tree;
        let pose = base_pose_from_link(tree, &measured.base_link_pose_w);
        self.kinematics.update_positions(tree, &Configuration::floating(pose, q))?;
        let measured_w = self.kinematics.link_poses_w()[self.imu_body].rotation * self.mounting;
        let segments = command.n_segments as usize;
        for (out, turning) in command.segments.iter_mut().zip(&self.turnings).take(segments) {
            let begin_s = since_s + out.begin_ns as f64 * 1e-9;
            let way = log_rotation(&measured_w.tr_mul(&turning.rotation_w));
            out.imu_angle_ref = (angle + way + measured.gyro_bias * begin_s).into();
            out.imu_rate_ref = turning.rate.into();
            out.imu_acceleration_ref = turning.acceleration.into();
        }
        command.imu_rate_bias = measured.gyro_bias.into();
        let (from_base, to_base) = self.lever_of_standing_feet(model, start, shares)?;
        let row = |i: usize, first: usize| {
            RowVector3::new(self.gain[(i, first)], self.gain[(i, first + 1)], self.gain[(i, first + 2)])
        };
        for i in 0..self.gain.nrows() {
            let (on_p, on_v) = (row(i, 3), row(i, 9));
            let mut on_turn = row(i, 0);
            let mut on_spin = row(i, 6);
            if let Some(from_base) = from_base {
                on_turn += on_p * from_base.cross_matrix();
                on_spin += on_v * from_base.cross_matrix();
                for (j, (jacobian, rate)) in self.jacobian[0].iter().zip(&self.jacobian[1]).enumerate() {
                    command.gain[i][j] -= (on_p * jacobian + on_v * rate).x;
                    command.gain[i][MAX_JOINTS + j] -= (on_v * jacobian).x;
                }
            }
            for &j in &self.chain {
                let (axis, rate) = self.axes[j];
                command.gain[i][j] += (on_spin * rate - on_turn * axis).x;
                command.gain[i][MAX_JOINTS + j] -= (on_spin * axis).x;
            }
            command.imu_gain[i][..3].copy_from_slice((on_turn * to_base).as_slice());
            command.imu_gain[i][3..].copy_from_slice((on_spin * to_base).as_slice());
        }
        Ok(())
    }

    /// The mean of the standing feet from the base, `None` when none stands, and the axes of the inertial unit, in the base's axes;
    /// the Jacobians and the axes of the chain along with them.
    fn lever_of_standing_feet(
        &mut self,
        model: &LeggedModel,
        start: &BoundaryState,
        shares: &[f64],
    ) -> Result<(Option<Vector3<f64>>, Matrix3<f64>), ModelError> {
        let tree = &model.tree;
        for ((later, q), rate) in self.later.iter_mut().zip(&start.q).zip(&start.rate) {
            *later = q + MOMENT_S * rate;
        }
        let total: f64 = shares.iter().sum();
        let stands = total >= LEAST_SHARE;
        let spin: Vector3<f64> = start.base_velocity_b.fixed_rows::<3>(0).into();
        let mut from_base = Vector3::zeros();
        for part in [1, 0] {
            let at = if part == 0 { &start.q } else { &self.later };
            self.kinematics
                .update_positions(tree, &Configuration::floating(RigidTransform::identity(), at))?;
            self.jacobian[part].fill(Vector3::zeros());
            for (foot, share) in model.feet.iter().zip(shares).filter(|_| stands) {
                let place = self.kinematics.link_poses_w()[foot.body].transform_point(&foot.sole.translation);
                if part == 0 {
                    from_base += place * (share / total);
                }
                for dof in tree.branch(foot.body).iter().map(|dof| *dof as usize).filter(|dof| *dof >= 6) {
                    let Twist { angular, linear } = self.kinematics.joint_twists_w()[dof - 5];
                    self.jacobian[part][dof - 6] += (linear + angular.cross(&place)) * (share / total);
                }
            }
        }
        let [jacobian, rate] = &mut self.jacobian;
        for (jacobian, rate) in jacobian.iter().zip(rate) {
            *rate = (*rate - jacobian) / MOMENT_S + spin.cross(jacobian);
        }
        let mut spin = spin;
        for &j in &self.chain {
            let axis = self.kinematics.joint_twists_w()[j + 1].angular;
            spin += axis * start.rate[j];
            self.axes[j] = (axis, axis.cross(&spin));
        }
        let to_base = self.kinematics.link_poses_w()[self.imu_body].rotation * self.mounting;
        Ok((stands.then_some(from_base), to_base))
    }
}

#[cfg(test)]
mod tests {
    use delmpc_horizon::legged_model::FootShape;
    use delmpc_horizon::limits::JointLimits;
    use delmpc_mechanics::kinematics::base_link_pose;
    use delmpc_mechanics::prelude::*;
    use delmpc_messages::ServoReadings;

    use super::*;

    /// A trunk with a leg of three joints and a head that turns; the inertial unit is in the head.
    fn robot() -> LeggedModel {
        let link =
            |mass: f64| LinkInertia::new(mass, Vector3::new(0.02, -0.01, -0.1), Matrix3::identity() * 0.02);
        let at = |x: f64, y: f64, z: f64| RigidTransform::from_translation(Vector3::new(x, y, z));
        let mut tree = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), link(5.0));
        let hip = tree.add(Body::new(Some(0), Joint::revolute(Vector3::x(), at(0.05, 0.1, -0.1)), link(1.0)));
        let knee =
            tree.add(Body::new(Some(hip), Joint::revolute(Vector3::y(), at(0.0, 0.02, -0.3)), link(1.0)));
        let foot =
            tree.add(Body::new(Some(knee), Joint::revolute(Vector3::y(), at(0.0, 0.0, -0.3)), link(0.5)));
        tree.add(Body::new(Some(0), Joint::revolute(Vector3::z(), at(0.0, 0.0, 0.3)), link(0.5)));
        let tree = tree.build().unwrap();
        let posture = BoundaryState::zeros(&tree);
        let limit = JointLimits { lower: -3.0, upper: 3.0, velocity: 10.0, effort: 100.0 };
        let feet = vec![FootShape { body: foot, sole: at(0.03, 0.0, -0.05), polygon: vec![] }];
        LeggedModel { limits: vec![limit; 4], tree, feet, posture }
    }

    /// Where the foot is, and how fast.
    fn foot(model: &LeggedModel, state: &BoundaryState) -> (Vector3<f64>, Vector3<f64>) {
        let mut kinematics = Kinematics::new(&model.tree);
        kinematics
            .update_positions(&model.tree, &Configuration::floating(state.base_pose_w(), &state.q))
            .unwrap();
        let velocity = Velocity::floating(state.base_twist_w(), &state.rate);
        kinematics.update_velocities(&model.tree, &velocity).unwrap();
        let foot = &model.feet[0];
        let place = kinematics.link_poses_w()[foot.body].transform_point(&foot.sole.translation);
        let twist = kinematics.velocities_w()[foot.body];
        (place, twist.linear + twist.angular.cross(&place))
    }

    /// The same with the base where the foot is at `place_w`, and at rest.
    fn standing(model: &LeggedModel, mut state: BoundaryState, place_w: Vector3<f64>) -> BoundaryState {
        state.position_w += place_w - foot(model, &state).0;
        let slides = state.orientation.tr_mul(&foot(model, &state).1);
        let mut linear = state.base_velocity_b.fixed_rows_mut::<3>(3);
        linear -= slides;
        state
    }

    #[test]
    fn what_a_servo_reads_tells_it_all_of_the_gain_while_the_foot_stays() {
        let model = robot();
        let mut start = BoundaryState::zeros(&model.tree);
        let twenty = |k: usize| libm::sin(1.0 + 2.7 * k as f64);
        let x: Vec<f64> = (0..20).map(|k| 0.4 * twenty(k)).collect();
        start.retract(&x);
        let start = standing(&model, start, Vector3::zeros());
        let mut moved = start.clone();
        let step: Vec<f64> = (0..20).map(|k| 1e-4 * twenty(40 + k)).collect();
        moved.retract(&step);
        let moved = standing(&model, moved, Vector3::zeros());

        let mounting = exp(&Vector3::new(0.3, -0.5, 0.7));
        let mut feedback = BaseFeedback::new(&model.tree, 4, mounting);
        let gain = Mat::from_fn(4, 20, |i, j| 10.0 * twenty(7 * i + 3 * j));
        feedback.take_gain(gain.as_ref());
        let (now, later) = (start.clone(), start.clone());
        feedback.take_turning(&model.tree, 0, &now, &later).unwrap();
        let mut command = Command::new(0, 0, 4);
        command.n_segments = 1;
        command.valid_until_ns = 1;
        for (i, row) in command.gain.iter_mut().take(4).enumerate() {
            for j in 0..4 {
                row[j] = gain[(i, 6 + j)];
                row[MAX_JOINTS + j] = gain[(i, 16 + j)];
            }
        }
        let segment = &mut command.segments[0];
        segment.position_ref[..4].copy_from_slice(&start.q);
        segment.velocity_ref[..4].copy_from_slice(&start.rate);
        segment.torque_lower[..4].fill(-1e3);
        segment.torque_upper[..4].fill(1e3);
        let measured = BaseEstimate {
            base_link_pose_w: base_link_pose(&model.tree, &start.base_pose_w()),
            gyro_bias: Vector3::new(0.01, 0.02, -0.03),
            base_twist_b: Twist::default(),
            imu_rotation_w: Matrix3::identity(),
            accelerometer_bias: Vector3::zeros(),
            attitude_is_measured: true,
        };
        let angle = Vector3::new(5.0, -3.0, 1.0);
        feedback.write(&model, &start, &[1.0], (&angle, &measured, &start.q), 0.0, &mut command).unwrap();

        let (from_w, _) = feedback.turning(&model.tree, &start).unwrap();
        let (to_w, rate) = feedback.turning(&model.tree, &moved).unwrap();
        let turned = angle + log_rotation(&from_w.tr_mul(&to_w));
        let readings = ServoReadings {
            imu: Some((turned.into(), (rate + measured.gyro_bias).into())),
            ..ServoReadings::joints(&moved.q, &moved.rate)
        };
        let mut torque = [0.0; 4];
        command.torque_into(0, &readings, &mut torque).unwrap();
        let mut deviation = [0.0; 20];
        start.local(&moved, &mut deviation);
        for (i, torque) in torque.iter().enumerate() {
            let wanted: f64 = (0..20).map(|j| gain[(i, j)] * deviation[j]).sum();
            assert!((torque - wanted).abs() < 2e-6, "joint {i}: {torque} for {wanted}");
            assert!(wanted.abs() > 1e-4);
        }
        // Without the foot nothing tells where the base is: the leg's gains stay as they were.
        assert!((command.gain[0][0] - gain[(0, 6)]).abs() > 0.1);
        command.gain[0][0] = 1.0;
        feedback.write(&model, &start, &[0.0], (&angle, &measured, &start.q), 0.0, &mut command).unwrap();
        assert_eq!(command.gain[0][0], 1.0);
    }

    fn exp(turn: &Vector3<f64>) -> Matrix3<f64> {
        delmpc_mechanics::spatial::exp_rotation(turn)
    }
}
