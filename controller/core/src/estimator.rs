//! From a measurement to the state of the foot-rooted model.
//!
//! The joints of the foot-rooted tree are the measured joints in another order (see `delmpc_mechanics::reroot`). Base and feet come from
//! `delmpc_estimation`; what they say of how the robot leans replaces what the stance ankle's encoders say (`level_stance.rs`).
//! A robot without an inertial unit, or one bolted to the ground, has its encoders only, and its stance foot is taken to be level.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_estimation::prelude::{
    BaseEstimate, EstimationError, Estimator as BaseEstimator, FootEstimate, FootMeasurement, Inertial,
    Measurement,
};
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::spatial::{RigidTransform, Twist, Wrench, exp_rotation, log_rotation};
use delmpc_messages::{Command, MAX_FEET, PlantState, foot, sensor};
use nalgebra::{Quaternion, UnitQuaternion, Vector2, Vector3};

use crate::errors::ControlError;
use crate::feedback_law::Law;
use crate::level_stance::LevelStance;
use crate::model::ControllerModel;

/// Time in which the lean of a firmly loaded foot becomes that of the ground, s.
const GROUND_LEAN_S: f64 = 0.2;
/// A foot is firmly loaded when its pressure point is farther than this from its edge, m.
const FIRM_MARGIN_M: f64 = 0.01;

/// The state the controller believes in.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// Joint coordinates in the order of the foot-rooted tree; the stance ankle's are those of a level foot.
    pub q: Vec<f64>,
    /// Joint rates.
    pub q_dot: Vec<f64>,
    /// How far the sole has moved from where it first was, in the plane, m.
    pub slip_m: f64,
    /// How far it has tilted from where it first was, rad.
    pub tilt_rad: f64,
    /// Wrench of the ground on the stance foot about the origin of the level {0}, in its axes; `None`: not measured.
    pub stance_wrench: Option<Wrench>,
    /// Whether the stance foot carries load.
    pub stance_loaded: bool,
    /// Encoders of the ankle joints less those of the level foot, as they are when the foot lies on the ground, rad.
    pub ground_lean: Vector2<f64>,
    /// Pose of the sole in the level {0}, as it is when the foot lies on the ground: identity on level ground.
    pub sole_pose: RigidTransform,
}

/// Workspace of the estimator.
#[derive(Debug)]
pub struct Estimator {
    estimate: Estimate,
    base: Option<BaseEstimator>,
    level: Option<LevelStance>,
    /// Whether the state was levelled at the last measurement.
    levelled: bool,
    first_sole_w: Option<RigidTransform>,
    last_s: Option<f64>,
    imu_angle: Option<Vector3<f64>>,
}

impl Estimator {
    /// For a model.
    ///
    /// # Errors
    /// [`ControlError`] when the parts of its sensing do not fit each other.
    pub fn new(model: &ControllerModel) -> Result<Self, ControlError> {
        let n = model.tree.dof();
        let (mut base, mut level) = (None, None);
        if let Some(sensing) = &model.sensing {
            let estimator = BaseEstimator::new(sensing.estimator.clone(), sensing.config);
            base = Some(estimator.map_err(|_| ControlError::Model {
                reason: "a foot or the inertial unit is on a body the floating tree does not have",
            })?);
            if let Some(body) = sensing.rerooted.new_body(sensing.estimator.imu_body) {
                level = LevelStance::new(&model.tree, body, &model.posture)?;
            }
        }
        Ok(Self {
            estimate: Estimate {
                q: vec![0.0; n],
                q_dot: vec![0.0; n],
                slip_m: 0.0,
                tilt_rad: 0.0,
                stance_wrench: None,
                stance_loaded: true,
                ground_lean: Vector2::zeros(),
                sole_pose: RigidTransform::identity(),
            },
            base,
            level,
            levelled: false,
            first_sole_w: None,
            last_s: None,
            imu_angle: None,
        })
    }

    /// Takes a validated measurement in. No allocation.
    ///
    /// # Errors
    /// [`EstimationError`] when the model's parts do not fit each other, or the filter diverged.
    pub fn update(&mut self, model: &ControllerModel, state: &PlantState) -> Result<(), EstimationError> {
        for (i, &joint) in model.message_joint.iter().enumerate() {
            self.estimate.q[i] = state.position[joint];
            self.estimate.q_dot[i] = state.velocity[joint];
        }
        self.levelled = false;
        self.imu_angle = state
            .has_sensor(sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS)
            .then(|| Vector3::from(state.imu_angle));
        let (Some(sensing), Some(base)) = (&model.sensing, &mut self.base) else { return Ok(()) };
        let stance = sensing.stance_foot;
        let reading = state.feet().get(stance).filter(|reading| reading.flags & foot::WRENCH != 0);
        self.estimate.stance_wrench =
            reading.map(|reading| Wrench::new(reading.torque_s.into(), reading.force_s.into()));

        let mut feet = [FootMeasurement::default(); MAX_FEET];
        for (out, reading) in feet.iter_mut().zip(state.feet()) {
            let wrench = || Wrench::new(reading.torque_s.into(), reading.force_s.into());
            out.wrench_s = (reading.flags & foot::WRENCH != 0).then(wrench);
            out.touches = reading.flags & foot::TOUCHES != 0;
        }
        let count = sensing.estimator.tree.joint_count();
        base.update(&Measurement {
            time_s: state.time_ns as f64 * 1e-9,
            position: &state.position[..count],
            velocity: &state.velocity[..count],
            inertial: inertial(state),
            feet: &feet[..state.feet().len()],
            motion_capture: motion_capture(state),
        })?;
        self.level_stance(model)?;
        self.observe_sole(model, state.time_ns as f64 * 1e-9);
        Ok(())
    }

    /// The ankle of a level foot, and the wrench in level axes.
    fn level_stance(&mut self, model: &ControllerModel) -> Result<(), EstimationError> {
        let (Some(sensing), Some(base), Some(level)) = (&model.sensing, &self.base, &mut self.level) else {
            return Ok(());
        };
        let believed = base.estimate();
        if !believed.attitude_is_measured {
            return Ok(());
        }
        let mounting = &sensing.estimator.imu_mounting.rotation;
        // Axes of the link the unit sits on.
        let link_w = believed.imu_rotation_w * mounting.transpose();
        let rate = mounting * base.imu_rate();
        let up = link_w.row(2).transpose();
        let Estimate { q, q_dot, stance_wrench, .. } = &mut self.estimate;
        self.levelled = level.level(&model.tree, &up, &rate, q, q_dot)?;
        if let Some(wrench) = stance_wrench.as_mut().filter(|_| self.levelled) {
            *wrench = level.sole_pose().transform_wrench(wrench);
        }
        Ok(())
    }

    /// Slip, tilt and load of the sole, and how the ground under it leans.
    fn observe_sole(&mut self, model: &ControllerModel, time_s: f64) {
        let (Some(sensing), Some(base)) = (&model.sensing, &self.base) else { return };
        let Some(foot) = base.feet().get(sensing.stance_foot) else { return };
        let estimate = &mut self.estimate;
        let first = self.first_sole_w.get_or_insert(foot.sole_pose_w);
        let moved = foot.sole_pose_w.translation - first.translation;
        estimate.slip_m = libm::hypot(moved.x, moved.y);
        let (up, was): (Vector3<f64>, Vector3<f64>) =
            (foot.sole_pose_w.rotation.column(2).into(), first.rotation.column(2).into());
        estimate.tilt_rad = libm::atan2(up.cross(&was).norm(), up.dot(&was));
        estimate.stance_loaded = foot.loaded || estimate.stance_wrench.is_none();
        if let Some(level) = self.level.as_ref().filter(|_| self.levelled) {
            match self.last_s {
                None => (estimate.ground_lean, estimate.sole_pose) = (level.lean(), *level.sole_pose()),
                Some(last_s) if foot.loaded && foot.margin > FIRM_MARGIN_M => {
                    let share = ((time_s - last_s) / GROUND_LEAN_S).clamp(0.0, 1.0);
                    estimate.ground_lean += (level.lean() - estimate.ground_lean) * share;
                    estimate.sole_pose = between(&estimate.sole_pose, level.sole_pose(), share);
                }
                Some(_) => {}
            }
        }
        self.last_s = Some(time_s);
    }

    /// The last estimate.
    pub fn estimate(&self) -> &Estimate {
        &self.estimate
    }

    /// Base and biases; `None` without sensing.
    pub fn base(&self) -> Option<&BaseEstimate> {
        self.base.as_ref().map(BaseEstimator::estimate)
    }

    /// The feet in the order of the messages; empty without sensing.
    pub fn feet(&self) -> &[FootEstimate] {
        self.base.as_ref().map_or(&[], BaseEstimator::feet)
    }

    /// Tells the law, which has been written in terms of the levelled ankle, in terms of what the servo feels: by the gyroscope, or by
    /// encoders as they are while the foot moves on as it does. `since_s`: from the measurement to the begin of the command.
    ///
    /// # Errors
    /// [`ModelError`] when the law does not fit the model.
    pub(crate) fn tell_law(
        &mut self,
        model: &ControllerModel,
        law: &Law,
        since_s: f64,
        command: &mut Command,
    ) -> Result<(), ModelError> {
        let joints = &model.message_joint;
        let Some(level) = self.level.as_mut().filter(|_| self.levelled) else { return Ok(()) };
        let (Some(angle), Some(sensing)) = (self.imu_angle, &model.sensing) else {
            level.write_encoders(joints, command);
            return Ok(());
        };
        let mounting = &sensing.estimator.imu_mounting.rotation;
        let bias = self.base.as_ref().map(|base| base.estimate().gyro_bias).unwrap_or_default();
        level.write(&model.tree, law, joints, (mounting, &angle, &bias), since_s, command)
    }

    /// The levelled stance foot, when the law is told by the gyroscope.
    pub(crate) fn told_by_gyroscope(&self) -> Option<&LevelStance> {
        self.level.as_ref().filter(|_| self.levelled && self.imu_angle.is_some())
    }
}

/// A `share` of the way from one pose to another one near it.
fn between(from: &RigidTransform, to: &RigidTransform, share: f64) -> RigidTransform {
    let turn = log_rotation(&(to.rotation * from.rotation.transpose())) * share;
    RigidTransform {
        rotation: exp_rotation(&turn) * from.rotation,
        translation: from.translation + (to.translation - from.translation) * share,
    }
}

pub(crate) fn inertial(state: &PlantState) -> Option<Inertial> {
    state.has_sensor(sensor::INERTIAL_UNIT).then(|| Inertial {
        angular_velocity: state.imu_angular_velocity.into(),
        specific_force: state.imu_specific_force.into(),
        sums: state
            .has_sensor(sensor::INERTIAL_SUMS)
            .then(|| (state.imu_angle.into(), state.imu_velocity.into())),
    })
}

pub(crate) fn motion_capture(state: &PlantState) -> Option<(RigidTransform, Twist)> {
    state.has_sensor(sensor::MOTION_CAPTURE).then(|| {
        let [x, y, z, w] = state.base_orientation_w;
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let pose = RigidTransform {
            rotation: rotation.to_rotation_matrix().into_inner(),
            translation: Vector3::from(state.base_position_w),
        };
        let twist = Twist::new(state.base_angular_velocity_b.into(), state.base_linear_velocity_b.into());
        (pose, twist)
    })
}
