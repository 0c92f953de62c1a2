//! The robot as a horizon with contacts sees it: a floating tree, its feet, limits, a standing posture.

use alloc::vec::Vec;

use delmpc_mechanics::contact_stage::{BoundaryState, Contact};
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::{Matrix3, Vector3};

use crate::contact_schedule::MAX_FEET;
use crate::errors::HorizonError;
use crate::limits::JointLimits;

/// A foot.
#[derive(Clone, Debug, PartialEq)]
pub struct FootShape {
    /// Body of the floating tree.
    pub body: usize,
    /// Sole frame in the body's link frame: z out of the ground, x forward.
    pub sole: RigidTransform,
    /// Corners of the sole in its frame, counter-clockwise from above, m; fewer than three: a point at the sole's origin.
    pub polygon: Vec<[f64; 2]>,
}

impl FootShape {
    /// Whether it is flat.
    pub fn is_flat(&self) -> bool {
        self.polygon.len() >= 3
    }

    /// The contact of the mechanics, on level ground.
    pub fn contact(&self) -> Contact {
        match self.is_flat() {
            true => Contact::foot(self.body, self.sole.translation, self.sole.rotation),
            false => Contact::point(self.body, self.sole.translation),
        }
    }
}

/// The robot. Vectors over joints are in the order of the floating tree.
#[derive(Clone, Debug)]
pub struct LeggedModel {
    /// Floating tree.
    pub tree: KinematicTree,
    /// Its feet.
    pub feet: Vec<FootShape>,
    /// Limits of its joints.
    pub limits: Vec<JointLimits>,
    /// How it stands, at rest, on level ground at height 0.
    pub posture: BoundaryState,
}

impl LeggedModel {
    /// Checks sizes and numbers.
    ///
    /// # Errors
    /// [`HorizonError`]: the first thing found wrong.
    pub fn check(&self) -> Result<(), HorizonError> {
        let joints = self.tree.joint_count();
        let length = |quantity, found, expected| Err(HorizonError::Length { quantity, found, expected });
        if self.limits.len() != joints {
            return length("joint limits", self.limits.len(), joints);
        }
        if self.posture.q.len() != joints {
            return length("posture", self.posture.q.len(), joints);
        }
        if self.feet.is_empty() || self.feet.len() > MAX_FEET {
            return length("feet", self.feet.len(), MAX_FEET);
        }
        for (index, foot) in self.feet.iter().enumerate() {
            if foot.body == 0 || foot.body >= self.tree.body_count() {
                let (quantity, value) = ("body of a foot", foot.body as f64);
                let rule = "must be a body of the tree other than the base";
                return Err(HorizonError::Value { quantity, index, value, rule });
            }
        }
        for (index, limit) in self.limits.iter().enumerate() {
            if limit.effort.is_nan() || limit.effort <= 0.0 || !limit.lower.le(&limit.upper) {
                let (quantity, value) = ("limit of a joint", limit.effort);
                let rule = "effort must be positive and the range must not be empty";
                return Err(HorizonError::Value { quantity, index, value, rule });
            }
        }
        Ok(())
    }

    /// The contacts of all feet, on level ground.
    pub fn contacts(&self) -> Vec<Contact> {
        self.feet.iter().map(FootShape::contact).collect()
    }

    /// Weight, N.
    pub fn weight_n(&self) -> f64 {
        self.tree.total_mass() * self.tree.gravity_w().norm()
    }

    /// Joints between the base and a foot, the nearest to the base first: those that move no other foot.
    pub fn leg(&self, foot: usize) -> Vec<usize> {
        let branch = |foot: &FootShape| -> Vec<usize> {
            self.tree.branch(foot.body).iter().filter(|dof| **dof >= 6).map(|dof| *dof as usize - 6).collect()
        };
        let own = branch(&self.feet[foot]);
        let others: Vec<usize> =
            (0..self.feet.len()).filter(|k| *k != foot).flat_map(|k| branch(&self.feet[k])).collect();
        own.into_iter().filter(|joint| !others.contains(joint)).collect()
    }
}

/// Axes with the z axis `normal` and the x axis in the direction of `forward`.
pub fn axes_on(normal: &Vector3<f64>, forward: &Vector3<f64>) -> Matrix3<f64> {
    let z = normal.normalize();
    let y = z.cross(forward);
    let size = y.norm();
    let y = if size > 1e-6 { y / size } else { z.cross(&Vector3::y()).normalize() };
    Matrix3::from_columns(&[y.cross(&z), y, z])
}
