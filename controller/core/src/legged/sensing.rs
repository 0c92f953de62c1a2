//! Base and feet as the horizon wants them, from the messages.

use alloc::vec::Vec;

use delmpc_estimation::prelude::{BaseEstimate, EstimationError, Estimator, FootMeasurement, Measurement};
use delmpc_horizon::contact_schedule::{ContactSchedule, Foothold};
use delmpc_horizon::legged_model::LeggedModel;
use delmpc_horizon::retiming::{FootState, measured_foothold};
use delmpc_mechanics::contact_stage::{BoundaryKinematics, BoundaryState, Contact, ContactProjection};
use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_messages::{MAX_FEET, PlantState, foot};
use nalgebra::Vector3;

use super::LeggedRobot;
use crate::errors::ControlError;
use crate::estimator::{inertial, motion_capture};

/// Regularisation of the projection on contacts that may be redundant.
const REGULARISATION: f64 = 1e-8;

/// Estimator, and what it says of the feet.
#[derive(Debug)]
pub(crate) struct LeggedSensing {
    estimator: Estimator,
    feet: Vec<FootState>,
    kinematics: BoundaryKinematics,
    projection: ContactProjection,
    contacts: Vec<Contact>,
    resting: Vec<bool>,
    velocity: Vec<f64>,
    joints: (Vec<f64>, Vec<f64>),
}

impl LeggedSensing {
    pub fn new(robot: &LeggedRobot) -> Result<Self, ControlError> {
        let model = &robot.model;
        let contacts = model.contacts();
        let joints = model.tree.joint_count();
        let estimator = Estimator::new(robot.estimator.clone(), robot.sensors)
            .map_err(|_| ControlError::Model { reason: "the estimator refused the robot" })?;
        Ok(Self {
            estimator,
            feet: super::no_places(contacts.len())
                .into_iter()
                .map(|place| FootState { loaded: false, place })
                .collect(),
            kinematics: BoundaryKinematics::new(&model.tree)?,
            projection: ContactProjection::new(&model.tree, &contacts),
            resting: alloc::vec![false; contacts.len()],
            contacts,
            velocity: alloc::vec![0.0; model.tree.dof()],
            joints: (alloc::vec![0.0; joints], alloc::vec![0.0; joints]),
        })
    }

    /// Takes a measurement in.
    pub fn update(&mut self, model: &LeggedModel, state: &PlantState) -> Result<(), EstimationError> {
        let mut feet = [FootMeasurement::default(); MAX_FEET];
        for (out, reading) in feet.iter_mut().zip(state.feet()) {
            let wrench =
                || delmpc_mechanics::spatial::Wrench::new(reading.torque_s.into(), reading.force_s.into());
            out.wrench_s = (reading.flags & foot::WRENCH != 0).then(wrench);
            out.touches = reading.flags & foot::TOUCHES != 0;
        }
        let joints = model.tree.joint_count();
        self.joints.0.copy_from_slice(&state.position[..joints]);
        self.joints.1.copy_from_slice(&state.velocity[..joints]);
        self.estimator.update(&Measurement {
            time_s: state.time_ns as f64 * 1e-9,
            position: &state.position[..joints],
            velocity: &state.velocity[..joints],
            inertial: inertial(state),
            feet: &feet[..state.feet().len()],
            motion_capture: motion_capture(state),
        })?;
        for ((out, foot), shape) in self.feet.iter_mut().zip(self.estimator.feet()).zip(&model.feet) {
            let sole = &foot.sole_pose_w;
            let (x, z) = (sole.rotation.column(0).into(), sole.rotation.column(2).into());
            *out = FootState {
                loaded: foot.loaded,
                place: measured_foothold(sole.translation, &z, &x, shape.is_flat()),
            };
        }
        Ok(())
    }

    pub fn feet(&self) -> &[FootState] {
        &self.feet
    }

    /// Joints at the last measurement.
    pub fn joints(&self) -> &[f64] {
        &self.joints.0
    }

    pub fn base(&self) -> &BaseEstimate {
        self.estimator.estimate()
    }

    /// The measured state, its velocity brought onto the contacts that are measured and planned to rest: what is left there is noise,
    /// and would be an impact of the first stage.
    pub fn settle(
        &mut self,
        model: &LeggedModel,
        schedule: &ContactSchedule,
        time_s: f64,
        out: &mut BoundaryState,
    ) -> Result<(), StepError> {
        let base = self.estimator.estimate();
        let tree = &model.tree;
        let pose = base_pose_from_link(tree, &base.base_link_pose_w);
        out.orientation = pose.rotation;
        out.position_w = pose.translation;
        out.q.copy_from_slice(&self.joints.0);
        out.rate.copy_from_slice(&self.joints.1);
        let twist = &base.base_twist_b;
        let com = tree.bodies()[0].inertia.com;
        let linear = twist.linear + twist.angular.cross(&com);
        out.base_velocity_b.fixed_rows_mut::<3>(0).copy_from(&twist.angular);
        out.base_velocity_b.fixed_rows_mut::<3>(3).copy_from(&linear);
        for (k, resting) in self.resting.iter_mut().enumerate() {
            *resting = self.feet[k].loaded && schedule.stands(k, time_s);
            self.contacts[k].axes_w = self.feet[k].place.axes_w;
        }
        if !self.resting.contains(&true) {
            return Ok(());
        }
        self.kinematics.update(tree, out)?;
        self.projection.factor(tree, &self.kinematics, &self.contacts, &self.resting, REGULARISATION)?;
        self.velocity.copy_from_slice(self.kinematics.velocity());
        self.projection.project(&mut self.velocity)?;
        for k in 0..6 {
            out.base_velocity_b[k] = self.velocity[k];
        }
        out.rate.copy_from_slice(&self.velocity[6..]);
        Ok(())
    }
}

/// Where the feet are in the home posture.
pub(crate) fn home_places(model: &LeggedModel) -> Result<Vec<Foothold>, ControlError> {
    let mut kinematics = Kinematics::new(&model.tree);
    let home = &model.posture;
    kinematics.update_positions(&model.tree, &Configuration::floating(home.base_pose_w(), &home.q))?;
    let place = |pose: RigidTransform| {
        let forward: Vector3<f64> = pose.rotation.column(0).into();
        measured_foothold(pose.translation, &Vector3::z(), &forward, false)
    };
    Ok(model.feet.iter().map(|foot| place(kinematics.link_poses_w()[foot.body] * foot.sole)).collect())
}
