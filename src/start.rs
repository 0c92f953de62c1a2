//! How the robot stands at the start, and the frame its goals are given in.
//!
//! | frame | origin | axes |
//! |---|---|---|
//! | world | of the scenario; the ground is tilted about it | z up |
//! | stance frame | origin of the stance sole at the start | z up, x where the sole's x axis points horizontally |
//!
//! The stance frame of a robot that is bolted down is the frame of its root link, which is the world's too.
//!
//! Balls and pushes are given in the stance frame: turning or moving the whole robot changes nothing for it.

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_mechanics::spatial::exp_rotation;
use delmpc_robots::Posture;
use delmpc_scenario::Scenario;
use nalgebra::{Matrix3, Vector3};

use crate::setup::Setup;
use crate::verdict::Failure;

/// The start of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// Mass-centre pose of the base in the world, as the floating tree has it.
    pub base_pose_w: RigidTransform,
    /// Joint positions.
    pub q: Vec<f64>,
    /// The stance frame in the world.
    pub stance_frame_w: RigidTransform,
}

impl Start {
    /// The posture turned with the ground, and as far from it as the scenario says.
    ///
    /// # Errors
    /// [`Failure::Input`] for a posture without base pose.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let Setup { robot, scenario, .. } = setup;
        let posture = robot.posture(&scenario.robot.posture);
        if let (Some(posture), false) = (posture, robot.tree.is_floating()) {
            return Ok(Self::bolted(setup, posture));
        }
        let standing = posture.and_then(|posture| Some((posture, robot.base_pose_w(posture)?)));
        let (posture, base_pose) = standing.ok_or_else(|| {
            let name = &scenario.robot.posture;
            Failure::Input(format!("{}: `robot.posture`: the posture {name} has no base pose", scenario.name))
        })?;
        let refused = |error: ModelError| Failure::Input(format!("{}: {error}", scenario.name));
        let mut kinematics = Kinematics::new(&robot.tree);
        let mut sole = |base, q: &[f64]| {
            kinematics.update_positions(&robot.tree, &Configuration::floating(base, q)).map_err(refused)?;
            Ok::<_, Failure>(robot.frame(setup.stance_frame()).map_or(RigidTransform::identity(), |frame| {
                match frame.body {
                    Some(body) => kinematics.link_poses_w()[body] * frame.pose,
                    None => frame.pose,
                }
            }))
        };
        let turned_about = sole(base_pose, &posture.q)?.translation;
        let start = &scenario.robot.start;
        let turn = RigidTransform::from_xyz_rpy(
            Vector3::zeros(),
            Vector3::new(start.roll_rad, start.pitch_rad, start.yaw_rad),
        );
        let [x, y] = start.position_m;
        let moved = RigidTransform::from_translation(turned_about + Vector3::new(x, y, start.height_m));
        let ground = RigidTransform { rotation: slope(scenario), translation: Vector3::zeros() };
        let base_pose_w = ground * moved * turn * RigidTransform::from_translation(-turned_about) * base_pose;
        let mut q = posture.q.clone();
        offset_joints(setup, &mut q);
        let stance_frame_w = levelled(&sole(base_pose_w, &q)?);
        Ok(Self { base_pose_w, q, stance_frame_w })
    }
}

impl Start {
    /// Of a robot that is bolted to the world: only its joints may begin elsewhere.
    fn bolted(setup: &Setup, posture: &Posture) -> Self {
        let still = RigidTransform::identity();
        let mut q = posture.q.clone();
        offset_joints(setup, &mut q);
        Self { base_pose_w: still, q, stance_frame_w: still }
    }
}

/// Adds the scenario's offsets of joints.
fn offset_joints(setup: &Setup, q: &mut [f64]) {
    for (name, offset) in &setup.scenario.robot.start.joint_offset {
        if let Some(joint) = setup.robot.joint(name) {
            q[joint] += offset;
        }
    }
}

/// From the axes of the ground to the world's.
pub fn slope(scenario: &Scenario) -> Matrix3<f64> {
    let [about_x, about_y] = scenario.plant.slope_rad;
    exp_rotation(&Vector3::new(about_x, about_y, 0.0))
}

/// The same origin and heading, z up.
pub fn levelled(sole: &RigidTransform) -> RigidTransform {
    let forward: Vector3<f64> = sole.rotation.column(0).into();
    let heading = forward.y.atan2(forward.x);
    RigidTransform { rotation: exp_rotation(&Vector3::new(0.0, 0.0, heading)), translation: sole.translation }
}
