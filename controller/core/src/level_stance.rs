//! The stance foot taken to be level and at rest: what its ankle would read then, and the law told without its encoders.
//!
//! The model of the horizon is the robot fixed at a level, resting sole. A real sole stands on a slope, sinks, rocks on an edge, or hangs
//! a little above the ground, and the encoder of the ankle says both: how the robot leans and how the foot does. Only the first moves
//! the mass. So the state has the ankle where it would be if the foot were level and the robot leaned as it does:
//!
//! | letter | meaning |
//! |---|---|
//! | `R(q)` | axes of the link with the inertial unit in {0} of the foot-rooted tree; {0} is level there |
//! | `z_i` | the vertical in the axes of that link, measured |
//! | `ω` | its angular velocity in its axes, measured |
//! | `a_j` | axes of the joints between foot and that link, in {0}; `a`: those of the two ankle joints, `r`: the others |
//! | `M` | inverse of the horizontal part of the ankle's axes, `[a_a]_xy⁻¹` |
//! | `Θ` | angle summed up by the gyroscope |
//! | `X(q)` | pose of that link in {0} |
//! | `S` | pose of the real sole in {0} |
//!
//! ```text
//! R(q_a, q_r) z_i = e_z                                   solved for q_a by Newton's method, ∂/∂q_j = a_j × e_z
//! Σ_a [a_a]_xy q̇_a = [R ω]_xy - Σ_r [a_r]_xy q̇_r
//! δq_a = M ( [R δΘ]_xy - Σ_r [a_r]_xy δq_r )               so K_a δq_a becomes a gain on Θ and on the other joints
//! ```
//!
//! The real sole is where the encoders have it relative to that link, `S = X(q levelled) X(q read)⁻¹`: turned about the ankle, so downhill
//! of the levelled one (1.3 mm a degree for an ankle 76 mm above it), and turned in heading where the ankle's axes are not level. Its
//! corners and its normal make the wrench cone ([`crate::contact_wrench::SoleCone`]), its heading the direction of goals.
//!
//! The law of a command is told in these terms ([`LevelStance::write`]): between two commands the servo feels the robot lean by the
//! gyroscope, and an ankle's chatter is not taken for a push.
//!
//! Source: own derivation; the horizon's own coordinates do not change.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::spatial::{RigidTransform, log_rotation};
use delmpc_mechanics::tree::{JointKind, KinematicTree};
use delmpc_messages::{Command, MAX_JOINTS};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use crate::feedback_law::Law;

/// Least sine between the horizontal parts of two axes that make an ankle.
const LEAST_SINE: f64 = 0.5;
/// Newton's iterations; the second one is at round-off for leans of a tenth of a radian.
const ITERATIONS: usize = 4;
/// Lean at which they end, rad.
const CONVERGED: f64 = 1e-12;

/// Time over which the turning of the reference is differenced, s.
const MOMENT_S: f64 = 1e-3;

/// Ankle and chain of one foot, with the axes of the last measurement.
#[derive(Clone, Debug)]
pub(crate) struct LevelStance {
    kinematics: Kinematics,
    /// Body of the foot-rooted tree whose attitude is measured.
    body: usize,
    /// Joints from the foot to it, the nearest to the foot first.
    chain: Vec<usize>,
    ankle: [usize; 2],
    /// `a_j` by joint of the tree, zero off the chain.
    axes: Vec<Vector3<f64>>,
    inverse: Matrix2<f64>,
    /// `R` at the levelled state.
    rotation: Matrix3<f64>,
    /// Where the real sole is in {0}, when what it carries is where the levelled foot has it.
    sole_pose: RigidTransform,
    /// By how much the encoders of the ankle differ from the levelled state: what the foot leans.
    lean: Vector2<f64>,
    /// The same of their rates.
    lean_rate: Vector2<f64>,
    /// A state a moment later.
    later: Vec<f64>,
}

impl LevelStance {
    /// For a foot-rooted tree with a measured attitude on `body`; `None` when no two joints between them can level the foot.
    pub fn new(tree: &KinematicTree, body: usize, posture: &[f64]) -> Result<Option<Self>, ModelError> {
        let mut kinematics = Kinematics::new(tree);
        kinematics.update_positions(tree, &Configuration::fixed(posture))?;
        let chain: Vec<usize> = tree
            .branch(body)
            .iter()
            .map(|joint| *joint as usize)
            .filter(|joint| tree.bodies()[*joint].joint.kind == JointKind::Revolute)
            .collect();
        let axis = |joint: usize| kinematics.joint_twists_w()[joint].angular;
        let pairs = chain
            .iter()
            .enumerate()
            .flat_map(|(k, second)| chain[..k].iter().map(move |first| [*first, *second]));
        let sine = |[first, second]: &[usize; 2]| {
            let (a, b) = (axis(*first).xy(), axis(*second).xy());
            (a.x * b.y - a.y * b.x).abs()
        };
        let Some(ankle) = pairs.into_iter().find(|pair| sine(pair) > LEAST_SINE) else { return Ok(None) };
        Ok(Some(Self {
            body,
            ankle,
            chain,
            axes: vec![Vector3::zeros(); tree.dof()],
            inverse: Matrix2::identity(),
            rotation: Matrix3::identity(),
            sole_pose: RigidTransform::identity(),
            lean: Vector2::zeros(),
            lean_rate: Vector2::zeros(),
            later: vec![0.0; 2 * tree.dof()],
            kinematics,
        }))
    }

    /// The two joints that level the foot, the one nearer to it first.
    pub fn ankle(&self) -> [usize; 2] {
        self.ankle
    }

    /// Pose of the real sole in the level {0}: turned about the ankle, so that it is not only tilted but also lies some millimetres
    /// downhill of the levelled one.
    pub fn sole_pose(&self) -> &RigidTransform {
        &self.sole_pose
    }

    /// Encoders of the ankle less their levelled values, rad.
    pub fn lean(&self) -> Vector2<f64> {
        self.lean
    }

    /// Levels `(q, q̇)` in place for the measured vertical and angular velocity of the body, both in its link's axes. `Ok(false)` when
    /// that cannot be done: the state is the encoders' then.
    ///
    /// # Errors
    /// [`ModelError::Length`] when a slice does not fit the tree.
    pub fn level(
        &mut self,
        tree: &KinematicTree,
        up: &Vector3<f64>,
        rate: &Vector3<f64>,
        q: &mut [f64],
        q_dot: &mut [f64],
    ) -> Result<bool, ModelError> {
        let [first, second] = self.ankle;
        let encoders = Vector2::new(q[first], q[second]);
        self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
        let read = self.kinematics.link_poses_w()[self.body];
        let mut converged = false;
        for _ in 0..ITERATIONS {
            self.take_axes();
            let lean = (self.rotation * up).xy();
            if lean.norm() < CONVERGED {
                converged = true;
                break;
            }
            // a × e_z = (a_y, -a_x): the lean is turned to a rotation about horizontal axes.
            let turn = self.inverse * Vector2::new(lean.y, -lean.x);
            q[first] += turn.x;
            q[second] += turn.y;
            self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
        }
        self.take_axes();
        let lean = (self.rotation * up).xy();
        let level = lean.norm() < 1e-6;
        if !converged && !level {
            (q[first], q[second]) = (encoders.x, encoders.y);
            self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
            self.take_axes();
            self.sole_pose = RigidTransform::identity();
            self.lean = Vector2::zeros();
            self.lean_rate = Vector2::zeros();
            return Ok(false);
        }
        let mut turning = (self.rotation * rate).xy();
        for &joint in self.chain.iter().filter(|joint| !self.ankle.contains(joint)) {
            turning -= self.axes[joint].xy() * q_dot[joint];
        }
        let ankle = self.inverse * turning;
        self.lean_rate = Vector2::new(q_dot[first], q_dot[second]) - ankle;
        (q_dot[first], q_dot[second]) = (ankle.x, ankle.y);
        self.sole_pose = self.kinematics.link_poses_w()[self.body] * read.inverse();
        self.lean = encoders - Vector2::new(q[first], q[second]);
        Ok(true)
    }

    fn take_axes(&mut self) {
        for &joint in &self.chain {
            self.axes[joint] = self.kinematics.joint_twists_w()[joint].angular;
        }
        self.rotation = self.kinematics.link_poses_w()[self.body].rotation;
        let [first, second] = self.ankle;
        let columns = Matrix2::from_columns(&[self.axes[first].xy(), self.axes[second].xy()]);
        self.inverse = columns.try_inverse().unwrap_or_else(Matrix2::zeros);
    }

    /// Tells the law in terms of the ankle's encoders, as they are while the foot moves on as it does: for a robot that is seen from
    /// outside and has no gyroscope.
    pub fn write_encoders(&self, message_joint: &[usize], command: &mut Command) {
        for (k, joint) in self.ankle.into_iter().enumerate() {
            for segment in &mut command.segments {
                segment.position_ref[message_joint[joint]] += self.lean[k];
                segment.velocity_ref[message_joint[joint]] += self.lean_rate[k];
            }
        }
    }

    /// Tells the law in terms of gyroscope and other joints: what [`crate::feedback_law::write_law`] has written in terms of the levelled
    /// ankle. `angle` is the gyroscope's sum at the measurement, in the axes of the inertial unit, which `mounting` turns into the
    /// link's; `since_s` the time from the measurement to the begin of the command.
    ///
    /// # Errors
    /// [`ModelError::Length`] when the law does not fit the tree.
    pub fn write(
        &mut self,
        tree: &KinematicTree,
        law: &Law,
        message_joint: &[usize],
        (mounting, angle, bias): (&Matrix3<f64>, &Vector3<f64>, &Vector3<f64>),
        since_s: f64,
        command: &mut Command,
    ) -> Result<(), ModelError> {
        let n = message_joint.len();
        let to_w = self.rotation * mounting;
        for (segment, out) in law.segments().iter().zip(&mut command.segments) {
            // The link where the reference has it, and how it turns there, now and a moment later.
            let (q, rates) = segment.reference.split_at(n);
            let (reference, rate) = self.turning(tree, q, rates)?;
            for j in 0..n {
                self.later[j] = q[j] + MOMENT_S * (rates[j] + 0.5 * MOMENT_S * segment.acceleration[j]);
                self.later[n + j] = rates[j] + MOMENT_S * segment.acceleration[j];
            }
            let later = core::mem::take(&mut self.later);
            let turned = self.turning(tree, &later[..n], &later[n..]);
            self.later = later;
            let acceleration = (turned?.1 - rate) / MOMENT_S;
            let way = log_rotation(&self.rotation.tr_mul(&reference));
            out.imu_angle_ref = (angle + mounting.tr_mul(&way) + bias * (since_s + segment.begin_s)).into();
            out.imu_rate_ref = mounting.tr_mul(&rate).into();
            out.imu_acceleration_ref = mounting.tr_mul(&acceleration).into();
        }
        command.imu_rate_bias = (*bias).into();
        for (i, &row) in message_joint.iter().enumerate() {
            for (part, column) in [(0, 0), (n, MAX_JOINTS)] {
                let gain = self.ankle.map(|joint| law.gain[(i, part + joint)]);
                // `K_a M`: a gain on horizontal rotation in {0}.
                let on_turn = self.inverse.tr_mul(&Vector2::from(gain));
                for &joint in &self.chain {
                    if self.ankle.contains(&joint) {
                        command.gain[row][column + message_joint[joint]] = 0.0;
                    } else {
                        command.gain[row][column + message_joint[joint]] -=
                            on_turn.dot(&self.axes[joint].xy());
                    }
                }
                let on_imu = to_w.tr_mul(&on_turn.push(0.0));
                let first = if part == 0 { 0 } else { 3 };
                command.imu_gain[row][first..first + 3].copy_from_slice(on_imu.as_slice());
            }
        }
        Ok(())
    }

    /// Axes of the link in {0} at `q`, and its angular velocity in its own axes.
    fn turning(
        &mut self,
        tree: &KinematicTree,
        q: &[f64],
        rates: &[f64],
    ) -> Result<(Matrix3<f64>, Vector3<f64>), ModelError> {
        self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
        let twists = self.kinematics.joint_twists_w();
        let rate: Vector3<f64> = self.chain.iter().map(|joint| twists[*joint].angular * rates[*joint]).sum();
        let rotation = self.kinematics.link_poses_w()[self.body].rotation;
        Ok((rotation, rotation.tr_mul(&rate)))
    }
}
