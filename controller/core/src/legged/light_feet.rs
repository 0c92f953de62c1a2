//! What the ankles do while their foot carries little: they hold the foot where the plan has it.
//!
//! ```text
//! I_j = S_jᵀ (everything beyond joint j) S_j        k = I_j w²        d = 2 ζ I_j w
//! ```
//!
//! The gains of a plan in which a foot stands move the robot about it. On a foot that has just landed, or is about to lift off, nothing but
//! its own small inertia is beyond the ankle: the same gains would spin it about its edge. So the servo blends from the plan's law to
//! these by the load the foot carries. `w` times the servo's period is far below the 2 at which a sampled damper becomes unstable.
//!
//! Source: own formulation; as `unloaded_robot.rs` for a robot on one foot.

use alloc::vec::Vec;

use delmpc_horizon::legged_model::LeggedModel;
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_messages::Command;

/// `w`, rad/s; less where the servo is slow.
const FREQUENCY: f64 = 40.0;
/// `ζ`.
const DAMPING_RATIO: f64 = 0.8;
/// Largest `w` times the servo's period.
const LARGEST_STEP: f64 = 0.1;
/// Part of the weight on a foot from which on its ankle has its full torque.
const FULL_LOAD: f64 = 0.1;
/// Joints of a leg, counted from the foot, that are its ankle.
const ANKLE_JOINTS: usize = 2;

/// An ankle joint.
#[derive(Clone, Copy, Debug)]
struct AnkleJoint {
    foot: usize,
    joint: usize,
    stiffness: f64,
    damping: f64,
}

/// Gains of all ankles.
#[derive(Clone, Debug)]
pub(crate) struct LightFeet {
    full_load_n: f64,
    joints: Vec<AnkleJoint>,
}

impl LightFeet {
    /// For the flat feet of a robot.
    pub fn new(model: &LeggedModel, servo_period_s: f64) -> Result<Self, ModelError> {
        let (tree, home) = (&model.tree, &model.posture);
        let mut kinematics = Kinematics::new(tree);
        kinematics.update_positions(tree, &Configuration::floating(home.base_pose_w(), &home.q))?;
        let frequency = FREQUENCY.min(LARGEST_STEP / servo_period_s);
        let mut joints = Vec::new();
        for foot in (0..model.feet.len()).filter(|foot| model.feet[*foot].is_flat()) {
            for &joint in model.leg(foot).iter().rev().take(ANKLE_JOINTS) {
                let dof = joint + 6;
                let beyond = |body: &usize| tree.branch(*body).iter().any(|at| *at as usize == dof);
                let axis = kinematics.joint_twists_w()[joint + 1];
                let inertia: f64 = (0..tree.body_count())
                    .filter(beyond)
                    .map(|body| kinematics.inertia_w(tree, body).mul_twist(&axis).dot(&axis))
                    .sum();
                joints.push(AnkleJoint {
                    foot,
                    joint,
                    stiffness: inertia * frequency * frequency,
                    damping: 2.0 * DAMPING_RATIO * inertia * frequency,
                });
            }
        }
        Ok(Self { full_load_n: FULL_LOAD * model.weight_n(), joints })
    }

    /// Writes the gains of the feet that stand in the plan.
    pub fn write(&self, stands: impl Fn(usize) -> bool, command: &mut Command) {
        command.load_foot.fill(0);
        for ankle in self.joints.iter().filter(|ankle| stands(ankle.foot)) {
            if let Some(full_load) = command.full_load_n.get_mut(ankle.foot) {
                *full_load = self.full_load_n;
            }
            command.load_foot[ankle.joint] = 1 + ankle.foot as u32;
            command.unloaded_stiffness[ankle.joint] = ankle.stiffness;
            command.unloaded_damping[ankle.joint] = ankle.damping;
        }
    }
}
