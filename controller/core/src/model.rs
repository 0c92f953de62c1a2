//! What the controller knows of the robot: plain data, checked once.

use alloc::vec::Vec;

pub use delmpc_horizon::limits::JointLimits;

use delmpc_estimation::prelude::{EstimatorConfig, EstimatorModel};
use delmpc_mechanics::reroot::Rerooted;
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::MAX_JOINTS;
use nalgebra::Vector3;

use crate::errors::ControlError;

/// A point of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyPoint {
    /// Body of the tree.
    pub body: usize,
    /// Position in its link frame, m.
    pub position: Vector3<f64>,
}

/// What the robot's sensors tell of its base and feet, and where they sit; without it the stance foot is taken to be level and at rest.
#[derive(Clone, Debug)]
pub struct Sensing {
    /// The floating robot, its inertial unit and its feet, in the order of the messages.
    pub estimator: EstimatorModel,
    /// How good the sensors are.
    pub config: EstimatorConfig,
    /// Which of the feet is the stance foot.
    pub stance_foot: usize,
    /// The robot fixed at the stance sole.
    pub rerooted: Rerooted,
}

/// The robot as the controller sees it. Vectors over joints are in the order of `tree` unless said otherwise.
#[derive(Clone, Debug)]
pub struct ControllerModel {
    /// The robot fixed at the stance sole: {0} is the sole frame, z up.
    pub tree: KinematicTree,
    /// For every joint of `tree`, its index in the messages.
    pub message_joint: Vec<usize>,
    /// Hash of the joint set of the messages.
    pub joint_set_hash: u64,
    /// Limits.
    pub limits: Vec<JointLimits>,
    /// Corners of the stance sole in {0}, counter-clockwise from above, m. Empty: a robot bolted to the ground.
    pub sole: Vec<[f64; 2]>,
    /// The point that reaches.
    pub hand: Option<BodyPoint>,
    /// The other foot.
    pub swing_foot: Option<BodyPoint>,
    /// Home posture.
    pub posture: Vec<f64>,
    /// What is felt of base and feet.
    pub sensing: Option<Sensing>,
}

impl ControllerModel {
    /// A robot that stands in a posture, and whose messages have the joints in the order of the tree. Nothing reaches, no other foot
    /// is watched, and the stance foot is taken to be where it was: fill in the fields for more.
    pub fn standing(
        tree: KinematicTree,
        joint_set_hash: u64,
        limits: Vec<JointLimits>,
        sole: Vec<[f64; 2]>,
        posture: Vec<f64>,
    ) -> Self {
        let message_joint = (0..tree.dof()).collect();
        let (hand, swing_foot, sensing) = (None, None, None);
        Self { tree, message_joint, joint_set_hash, limits, sole, hand, swing_foot, posture, sensing }
    }

    /// Message indices of the joints of a re-rooted tree.
    pub fn message_joints(rerooted: &Rerooted) -> Vec<usize> {
        rerooted.old_joint_bodies().iter().map(|body| body - 1).collect()
    }

    /// Checks sizes and numbers.
    ///
    /// # Errors
    /// The first thing found wrong.
    pub fn check(&self) -> Result<(), ControlError> {
        if self.tree.is_floating() {
            return Err(ControlError::Model {
                reason: "the controller's tree must be fixed at the stance foot",
            });
        }
        let n = self.tree.dof();
        if n == 0 || n > MAX_JOINTS {
            return Err(ControlError::Model { reason: "a message has no room for this number of joints" });
        }
        for (quantity, found) in [
            ("message joints", self.message_joint.len()),
            ("joint limits", self.limits.len()),
            ("posture", self.posture.len()),
        ] {
            if found != n {
                return Err(ControlError::Length { quantity, found, expected: n });
            }
        }
        let mut used = [false; MAX_JOINTS];
        for (index, &joint) in self.message_joint.iter().enumerate() {
            if joint >= n || used[joint] {
                let rule = "must name every joint of the message once";
                return Err(ControlError::Value {
                    quantity: "message joint",
                    index,
                    value: joint as f64,
                    rule,
                });
            }
            used[joint] = true;
        }
        for (index, limit) in self.limits.iter().enumerate() {
            let value = |quantity, value, rule| Err(ControlError::Value { quantity, index, value, rule });
            if limit.effort.is_nan() || limit.effort <= 0.0 {
                return value("effort limit", limit.effort, "must be positive");
            }
            if limit.velocity.is_nan() || limit.velocity <= 0.0 {
                return value("velocity limit", limit.velocity, "must be positive");
            }
            if limit.lower.is_nan() || limit.upper.is_nan() || limit.lower >= limit.upper {
                return value("position limit", limit.lower, "must be below the upper limit");
            }
            if !self.posture[index].is_finite() {
                return value("posture", self.posture[index], "must be finite");
            }
        }
        for point in [self.hand, self.swing_foot].into_iter().flatten() {
            if point.body >= self.tree.body_count() {
                return Err(ControlError::Model {
                    reason: "a task point is on a body the tree does not have",
                });
            }
        }
        Ok(())
    }
}
