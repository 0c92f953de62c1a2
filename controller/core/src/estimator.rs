//! From a measurement to the state of the foot-rooted model.
//!
//! The joints of the foot-rooted tree are the measured joints in another order (see `delmpc_mechanics::reroot`), so `(q, q̇)` is a
//! permutation. The measured base pose says, through the floating kinematics, where the stance sole is: its change since the first
//! measurement is slip and tilt, which the model takes to be zero and the report does not hide.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::spatial::{RigidTransform, log_rotation};
use delmpc_messages::PlantState;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::model::ControllerModel;

/// The state the controller believes in.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// Joint coordinates in the order of the foot-rooted tree.
    pub q: Vec<f64>,
    /// Joint rates.
    pub q_dot: Vec<f64>,
    /// How far the sole has moved from where it first was, in the plane, m.
    pub slip_m: f64,
    /// How far it has tilted from where it first was, rad.
    pub tilt_rad: f64,
}

/// Workspace of the estimator.
#[derive(Clone, Debug)]
pub struct Estimator {
    estimate: Estimate,
    floating: Option<Kinematics>,
    first_sole_w: Option<RigidTransform>,
}

impl Estimator {
    /// For a model.
    pub fn new(model: &ControllerModel) -> Self {
        let n = model.tree.dof();
        Self {
            estimate: Estimate { q: vec![0.0; n], q_dot: vec![0.0; n], slip_m: 0.0, tilt_rad: 0.0 },
            floating: model.stance.as_ref().map(|stance| Kinematics::new(&stance.floating)),
            first_sole_w: None,
        }
    }

    /// Takes a validated measurement in.
    ///
    /// # Errors
    /// [`ModelError::Length`] when the model's parts do not fit each other.
    pub fn update(&mut self, model: &ControllerModel, state: &PlantState) -> Result<(), ModelError> {
        let Estimate { q, q_dot, slip_m, tilt_rad } = &mut self.estimate;
        for (i, &joint) in model.message_joint.iter().enumerate() {
            q[i] = state.position[joint];
            q_dot[i] = state.velocity[joint];
        }
        if let (Some(stance), Some(kinematics)) = (&model.stance, &mut self.floating) {
            let [x, y, z, w] = state.base_orientation_w;
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let link = RigidTransform {
                rotation: rotation.to_rotation_matrix().into_inner(),
                translation: Vector3::from(state.base_position_w),
            };
            let base = base_pose_from_link(&stance.floating, &link);
            let joints = &state.position[..stance.floating.joint_count()];
            kinematics.update_positions(&stance.floating, &Configuration::floating(base, joints))?;
            let sole = stance.rerooted.frame_pose_w(kinematics);
            let first = self.first_sole_w.get_or_insert(sole);
            let moved = sole.translation - first.translation;
            *slip_m = libm::sqrt(moved.x * moved.x + moved.y * moved.y);
            let turned = log_rotation(&(sole.rotation * first.rotation.transpose()));
            *tilt_rad = libm::sqrt(turned.x * turned.x + turned.y * turned.y);
        }
        Ok(())
    }

    /// The last estimate.
    pub fn estimate(&self) -> &Estimate {
        &self.estimate
    }
}
