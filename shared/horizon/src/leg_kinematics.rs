//! Legs by inverse kinematics: joints that put every foot where it shall be, for a given base.
//!
//! Newton's method in every leg for itself, `δq = Jᵀ (J Jᵀ + ε 1)⁻¹ e`, from the last solution. The error `e` of a flat foot is six
//! numbers, of a point three. A foot out of reach ends as near as the damping lets it.
//!
//! Source: Y. Nakamura, H. Hanafusa, *Inverse kinematic solutions with singularity robustness for robot manipulator control*, 1986.

use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::spatial::{RigidTransform, log_rotation};
use nalgebra::{Matrix6, Vector3, Vector6};

use crate::contact_schedule::Foothold;
use crate::legged_model::LeggedModel;

/// Damping `ε` relative to the mean square of a foot's Jacobian.
const DAMPING: f64 = 1e-6;
/// Error at which it ends, m or rad.
const CLOSE: f64 = 1e-8;
/// Largest change of a joint in one iteration, rad or m.
const LARGEST_CHANGE: f64 = 0.3;

/// Memory of the solver.
#[derive(Clone, Debug)]
pub struct LegKinematics {
    kinematics: Kinematics,
    legs: Vec<Vec<usize>>,
}

impl LegKinematics {
    /// For a robot. Allocates.
    pub fn new(model: &LeggedModel) -> Self {
        let legs = (0..model.feet.len()).map(|foot| model.leg(foot)).collect();
        Self { kinematics: Kinematics::new(&model.tree), legs }
    }

    /// Joints of a leg.
    pub fn leg(&self, foot: usize) -> &[usize] {
        self.legs.get(foot).map_or(&[], Vec::as_slice)
    }

    /// Moves the joints of all legs in `q` until the feet are at `places` for a base (mass-centre pose) at `base_pose_w`; returns the
    /// largest error that is left, m or rad. Cost: kinematics O(n) an iteration. No allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] when `q` does not fit the tree.
    pub fn solve(
        &mut self,
        model: &LeggedModel,
        base_pose_w: &RigidTransform,
        places: &[Foothold],
        q: &mut [f64],
        iterations: usize,
    ) -> Result<f64, ModelError> {
        let mut worst: f64 = 0.0;
        for iteration in 0..=iterations {
            self.kinematics.update_positions(&model.tree, &Configuration::floating(*base_pose_w, q))?;
            worst = 0.0;
            for foot in 0..self.legs.len().min(places.len()) {
                let error = self.error(model, foot, &places[foot]);
                worst = worst.max(error.amax());
                if iteration < iterations {
                    self.improve(model, foot, &error, q);
                }
            }
            if worst < CLOSE {
                break;
            }
        }
        Ok(worst)
    }

    /// The sole of a foot as the last solution has it.
    pub fn sole_w(&self, model: &LeggedModel, foot: usize) -> RigidTransform {
        let shape = &model.feet[foot];
        self.kinematics.link_poses_w()[shape.body] * shape.sole
    }

    /// Mass centre as the last solution has it, m.
    pub fn mass_centre_w(&self, model: &LeggedModel) -> Vector3<f64> {
        self.kinematics.mass_centre_of_tree_w(&model.tree)
    }

    fn error(&self, model: &LeggedModel, foot: usize, place: &Foothold) -> Vector6<f64> {
        let sole = self.sole_w(model, foot);
        let turn = match model.feet[foot].is_flat() {
            true => log_rotation(&(place.axes_w * sole.rotation.transpose())),
            false => Vector3::zeros(),
        };
        let way = place.position_w - sole.translation;
        Vector6::new(turn.x, turn.y, turn.z, way.x, way.y, way.z)
    }

    fn improve(&self, model: &LeggedModel, foot: usize, error: &Vector6<f64>, q: &mut [f64]) {
        let flat = model.feet[foot].is_flat();
        let point = self.sole_w(model, foot).translation;
        let column = |joint: usize| {
            let twist = self.kinematics.joint_twists_w()[joint + 1];
            let linear = twist.linear + twist.angular.cross(&point);
            let angular = if flat { twist.angular } else { Vector3::zeros() };
            Vector6::new(angular.x, angular.y, angular.z, linear.x, linear.y, linear.z)
        };
        let mut square = Matrix6::zeros();
        for &joint in &self.legs[foot] {
            let j = column(joint);
            square += j * j.transpose();
        }
        let damping = DAMPING * square.trace() / 6.0 + f64::MIN_POSITIVE;
        for k in 0..6 {
            // Rows a point does not have get a diagonal of their own.
            square[(k, k)] += if !flat && k < 3 { 1.0 } else { damping };
        }
        let Some(inverse) = square.try_inverse() else { return };
        let weights = inverse * error;
        for &joint in &self.legs[foot] {
            let limit = &model.limits[joint];
            let change = column(joint).dot(&weights).clamp(-LARGEST_CHANGE, LARGEST_CHANGE);
            q[joint] = (q[joint] + change).max(limit.lower).min(limit.upper);
        }
    }
}
