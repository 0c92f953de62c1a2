//! What a legged robot is to do at a boundary, as weighted squares of `x = (ε, δq, δV, δq̇)`.
//!
//! ```text
//! base rotation    log(R_refᵀ R) + ε_ω           spin      ω - ω_ref + δω          (body axes; diagonal)
//! joints           q - q_ref + δq                rates     q̇ - q̇_ref + δq̇           (diagonal)
//! mass centre      c - c_ref + J_c (ε, δq)       velocity  J_c v - ċ_ref + J_c (δV, δq̇)
//! foot in the air  p - p_ref + J_p (ε, δq)       rotation  log(R R_refᵀ) + J_ω (ε, δq)
//! ```
//!
//! The change of `J_c` in the velocity of the mass centre is left out: second order at the speeds the weights ask for.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_lq::lq_stage::StageCost;
use delmpc_mechanics::contact_stage::{BoundaryKinematics, BoundaryState};
use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::spatial::log_rotation;
use nalgebra::Vector3;

use crate::errors::HorizonError;
use crate::legged_model::LeggedModel;
use crate::motion_reference::Target;

/// Weights of the tasks; see the module.
#[derive(Clone, Debug, PartialEq)]
pub struct LeggedWeights {
    /// Rotation of the base, 1/rad².
    pub base_rotation: f64,
    /// Its angular velocity, 1/(rad/s)².
    pub base_spin: f64,
    /// Mass centre along x, y, z, 1/m².
    pub mass_centre: [f64; 3],
    /// Its velocity, 1/(m/s)².
    pub mass_centre_velocity: [f64; 3],
    /// Every joint, 1/rad².
    pub posture: f64,
    /// Every joint's speed from that of the aim, 1/(rad/s)².
    pub joint_speed: f64,
    /// Joints of a leg in the air count so many times.
    pub swing_leg: f64,
    /// A foot in the air, 1/m².
    pub swing_foot: f64,
    /// Its rotation, 1/rad².
    pub swing_foot_rotation: f64,
    /// Every joint's torque, per square of its limit.
    pub torque: f64,
    /// Tangential forces of a foot, per square of the robot's weight.
    pub tangential_force: f64,
    /// Normal force of a foot, the same.
    pub normal_force: f64,
    /// Torques of a sole, per square of the weight times 0.1 m.
    pub sole_torque: f64,
    /// How long the aim is held after the end, s.
    pub terminal_s: f64,
}

impl Default for LeggedWeights {
    fn default() -> Self {
        Self {
            base_rotation: 400.0,
            base_spin: 6.0,
            mass_centre: [3e3, 3e3, 1e4],
            mass_centre_velocity: [150.0; 3],
            posture: 30.0,
            joint_speed: 0.1,
            swing_leg: 4.0,
            swing_foot: 3e4,
            swing_foot_rotation: 100.0,
            torque: 70.0,
            tangential_force: 200.0,
            normal_force: 8.0,
            sole_torque: 200.0,
            terminal_s: 0.5,
        }
    }
}

/// The tasks and their memory.
#[derive(Clone, Debug)]
pub struct LeggedTasks {
    weights: LeggedWeights,
    kinematics: BoundaryKinematics,
    /// For every joint, the foot whose leg it is of.
    leg_of: Vec<Option<usize>>,
    /// `3 x nv`.
    jacobian: Vec<f64>,
}

impl LeggedTasks {
    /// Takes all memory.
    ///
    /// # Errors
    /// When the mechanics refuse the model.
    pub fn new(model: &LeggedModel, weights: LeggedWeights) -> Result<Self, HorizonError> {
        let mut leg_of = vec![None; model.tree.joint_count()];
        for foot in 0..model.feet.len() {
            for joint in model.leg(foot) {
                leg_of[joint] = Some(foot);
            }
        }
        Ok(Self {
            weights,
            kinematics: BoundaryKinematics::new(&model.tree)?,
            leg_of,
            jacobian: vec![0.0; 3 * model.tree.dof()],
        })
    }

    /// Most residuals of a boundary.
    pub fn residuals(model: &LeggedModel) -> usize {
        6 + 6 * model.feet.len()
    }

    /// The weights.
    pub fn weights(&self) -> &LeggedWeights {
        &self.weights
    }

    /// Writes the cost of a boundary state over `duration` (s). No allocation.
    ///
    /// # Errors
    /// When the state is none.
    pub fn fill(
        &mut self,
        model: &LeggedModel,
        state: &BoundaryState,
        target: &Target,
        duration: f64,
        swinging: &[bool],
        cost: &mut StageCost,
    ) -> Result<(), StepError> {
        self.kinematics.update(&model.tree, state)?;
        self.diagonal(state, target, duration, swinging, cost);
        cost.residuals.clear();
        let w = &self.weights;
        let Self { kinematics, jacobian, .. } = self;
        let nv = jacobian.len() / 3;
        kinematics.mass_centre_jacobian_into(&model.tree, jacobian)?;
        let error = kinematics.mass_centre_w(&model.tree) - target.mass_centre_w;
        for axis in 0..3 {
            let row = &jacobian[axis * nv..(axis + 1) * nv];
            push(cost, w.mass_centre[axis] * duration, error[axis], row, 0);
            let moving: f64 = row.iter().zip(kinematics.velocity()).map(|(a, b)| a * b).sum();
            let error = moving - target.mass_centre_velocity_w[axis];
            push(cost, w.mass_centre_velocity[axis] * duration, error, row, nv);
        }
        for (foot, shape) in model.feet.iter().enumerate().filter(|(foot, _)| swinging[*foot]) {
            let sole = kinematics.kinematics().link_poses_w()[shape.body] * shape.sole;
            let wanted = &target.feet[foot];
            kinematics.point_jacobian_into(&model.tree, shape.body, &shape.sole.translation, jacobian)?;
            let error = sole.translation - wanted.position_w;
            for axis in 0..3 {
                let row = &jacobian[axis * nv..(axis + 1) * nv];
                push(cost, w.swing_foot * duration, error[axis], row, 0);
            }
            if !shape.is_flat() {
                continue;
            }
            kinematics.turn_jacobian_into(&model.tree, shape.body, jacobian)?;
            let error = log_rotation(&(sole.rotation * wanted.axes_w.transpose()));
            for axis in 0..3 {
                let row = &jacobian[axis * nv..(axis + 1) * nv];
                push(cost, w.swing_foot_rotation * duration, error[axis], row, 0);
            }
        }
        Ok(())
    }

    fn diagonal(
        &self,
        state: &BoundaryState,
        target: &Target,
        duration: f64,
        swinging: &[bool],
        cost: &mut StageCost,
    ) {
        let w = &self.weights;
        let joints = state.q.len();
        let nv = 6 + joints;
        cost.state_weight.fill(0.0);
        cost.state_gradient.fill(0.0);
        let mut put = |at: usize, weight: f64, error: f64| {
            cost.state_weight[at] = weight * duration;
            cost.state_gradient[at] = weight * duration * error;
        };
        let turn: Vector3<f64> = log_rotation(&target.state.orientation.tr_mul(&state.orientation));
        for axis in 0..3 {
            put(axis, w.base_rotation, turn[axis]);
            let spin = state.base_velocity_b[axis] - target.state.base_velocity_b[axis];
            put(nv + axis, w.base_spin, spin);
        }
        for j in 0..joints {
            let in_air = self.leg_of[j].is_some_and(|foot| swinging[foot]);
            let factor = if in_air { w.swing_leg } else { 1.0 };
            put(6 + j, w.posture * factor, state.q[j] - target.state.q[j]);
            put(nv + 6 + j, w.joint_speed * factor, state.rate[j] - target.state.rate[j]);
        }
    }
}

/// Half of `weight (value + row x)²`, the row on the coordinates from `first` on.
fn push(cost: &mut StageCost, weight: f64, value: f64, row: &[f64], first: usize) {
    if weight <= 0.0 {
        return;
    }
    let root = libm::sqrt(weight);
    if let Some(target) = cost.residuals.push(root * value) {
        for (target, entry) in target[first..].iter_mut().zip(row) {
            *target = root * entry;
        }
    }
}
