//! From the true motion of the robot to what the figures need of it: mass centre, sole, hand.

use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity, base_pose_from_link};
use delmpc_mechanics::prelude::{KinematicTree, RigidTransform, Twist};
use delmpc_robots::Attachment;
use nalgebra::UnitQuaternion;

use crate::setup::Setup;
use crate::truth::Truth;
use crate::verdict::Failure;

/// The true motion of the robot and its torques.
#[derive(Debug, Clone, Copy)]
pub struct Motion<'a> {
    /// Base link frame in the world.
    pub base_link_pose_w: &'a RigidTransform,
    /// Its twist in its own axes, at its origin.
    pub base_twist_b: &'a Twist,
    /// Joint positions.
    pub position: &'a [f64],
    /// Joint velocities.
    pub velocity: &'a [f64],
    /// Joint torques.
    pub torque: &'a [f64],
}

/// Fills in [`Truth`]. No allocation after construction.
#[derive(Debug, Clone)]
pub struct Observer {
    tree: KinematicTree,
    kinematics: Kinematics,
    /// Of the sole it stands on, if it does not hang on the world.
    sole: Option<Attachment>,
    soles: Vec<Attachment>,
    hand: Option<Attachment>,
    effort: Vec<f64>,
}

impl Observer {
    /// For the robot and the scenario of a setup.
    ///
    /// # Errors
    /// [`Failure::Input`] for a sole that is on no link.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let (robot, scenario) = (&setup.robot, &setup.scenario);
        let missing = || Failure::Input(format!("`robot.stance`: {} is on no link", scenario.robot.stance));
        let sole = robot.sole(scenario.robot.stance.first()).and_then(|sole| robot.frame(&sole.frame));
        if sole.is_none() && robot.tree.is_floating() {
            return Err(missing());
        }
        Ok(Self {
            tree: robot.tree.clone(),
            kinematics: Kinematics::new(&robot.tree),
            sole: sole.copied(),
            soles: robot.soles.iter().filter_map(|sole| robot.frame(&sole.frame).copied()).collect(),
            hand: scenario.reach.as_ref().and_then(|reach| robot.frame(&reach.hand)).copied(),
            effort: robot.limits.iter().map(|limit| limit.effort).collect(),
        })
    }

    /// Fills in everything that follows from the motion; everything else is left as it is.
    pub fn observe(&mut self, motion: &Motion<'_>, truth: &mut Truth) {
        let joints = motion.position.len();
        truth.n_joints = joints as u32;
        truth.position[..joints].copy_from_slice(motion.position);
        truth.velocity[..joints].copy_from_slice(motion.velocity);
        truth.torque[..joints].copy_from_slice(motion.torque);
        truth.base_position_w = motion.base_link_pose_w.translation.into();
        truth.base_orientation_w = quaternion(motion.base_link_pose_w);
        truth.base_angular_velocity_b = motion.base_twist_b.angular.into();
        truth.base_linear_velocity_b = motion.base_twist_b.linear.into();
        let loads = motion.torque.iter().zip(&self.effort);
        truth.torque_ratio = loads.map(|(torque, effort)| torque.abs() / effort).fold(0.0, f64::max);

        let floats = self.tree.is_floating();
        let (configuration, velocity) = if floats {
            let base = base_pose_from_link(&self.tree, motion.base_link_pose_w);
            let twist_w = motion.base_link_pose_w.transform_twist(motion.base_twist_b);
            (Configuration::floating(base, motion.position), Velocity::floating(twist_w, motion.velocity))
        } else {
            (Configuration::fixed(motion.position), Velocity::fixed(motion.velocity))
        };
        // Only slices of a wrong length could be refused, and these are the tree's own.
        if self.kinematics.update(&self.tree, &configuration, &velocity).is_err() {
            return;
        }
        truth.com_w = self.kinematics.mass_centre_of_tree_w(&self.tree).into();
        truth.com_velocity_w = self.kinematics.mass_centre_velocity_w(&self.tree).into();
        if let Some(sole) = &self.sole {
            truth.sole_position_w = self.pose_w(sole).translation.into();
        }
        truth.n_feet = self.soles.len().min(truth.foot_position_w.len()) as u32;
        for (sole, place) in self.soles.iter().zip(&mut truth.foot_position_w) {
            *place = self.pose_w(sole).translation.into();
        }
        if let Some(hand) = &self.hand {
            truth.hand_w = self.pose_w(hand).translation.into();
        }
    }

    /// Whether the robot is free to move.
    pub fn floats(&self) -> bool {
        self.tree.is_floating()
    }

    /// Where a sole was in the world when the robot was observed last; `None` for a number that no sole has.
    pub fn sole_pose_w(&self, index: usize) -> Option<RigidTransform> {
        self.soles.get(index).map(|sole| self.pose_w(sole))
    }

    fn pose_w(&self, frame: &Attachment) -> RigidTransform {
        match frame.body {
            Some(body) => self.kinematics.link_poses_w()[body] * frame.pose,
            None => frame.pose,
        }
    }
}

/// Orientation as x, y, z, w.
fn quaternion(pose: &RigidTransform) -> [f64; 4] {
    UnitQuaternion::from_matrix(&pose.rotation).coords.into()
}
