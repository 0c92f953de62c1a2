//! What the joints of the stance leg do while its foot carries nothing: they wait for the ground where they are.
//!
//! ```text
//! I_j = S_jᵀ (everything on the foot's side of joint j) S_j        k = I_j w²        d = 2 ζ I_j w
//! ```
//!
//! `S_j` is the joint's axis in the home posture. In the air nothing else holds the foot, so its own inertia is what stiffness and
//! damping act on: `w` times the servo's period is far below the 2 at which a sampled damper becomes unstable, whatever the robot weighs.
//! The ankle is held where the sole lies parallel to the ground it last lay on.
//!
//! Source: own formulation. Sampled stiffness and damping: K. Åström, B. Wittenmark, *Computer-Controlled Systems*, 1997, chapter 3.

use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::Command;

use crate::level_stance::LevelStance;

/// `w`, rad/s; less where the servo is slow.
const FREQUENCY: f64 = 30.0;
/// `ζ`.
const DAMPING_RATIO: f64 = 0.8;
/// Largest `w` times the servo's period.
const LARGEST_STEP: f64 = 0.1;
/// Part of the weight on the foot from which on the leg has its full torque.
const FULL_LOAD: f64 = 0.2;

/// Gains of the leg's joints.
#[derive(Clone, Debug)]
pub(crate) struct UnloadedLeg {
    foot: usize,
    full_load_n: f64,
    /// Joint, stiffness, damping.
    joints: Vec<(usize, f64, f64)>,
}

impl UnloadedLeg {
    /// For the joints between the foot that {0} of `tree` is fixed at, foot `foot` of the messages, and `base`.
    pub fn new(
        tree: &KinematicTree,
        foot: usize,
        base: usize,
        posture: &[f64],
        servo_period_s: f64,
    ) -> Result<Self, ModelError> {
        let mut kinematics = Kinematics::new(tree);
        kinematics.update_positions(tree, &Configuration::fixed(posture))?;
        let frequency = FREQUENCY.min(LARGEST_STEP / servo_period_s);
        let joints = tree.branch(base).iter().map(|joint| {
            let joint = *joint as usize;
            let mut inertia = *tree.ground_inertia_w();
            let on_foot_side = |body: &usize| !tree.branch(*body).iter().any(|j| *j as usize == joint);
            for body in (0..tree.body_count()).filter(on_foot_side) {
                inertia += kinematics.inertia_w(tree, body);
            }
            let axis = kinematics.joint_twists_w()[joint];
            let about_axis = inertia.mul_twist(&axis).dot(&axis);
            (joint, about_axis * frequency * frequency, 2.0 * DAMPING_RATIO * about_axis * frequency)
        });
        let full_load_n = FULL_LOAD * tree.total_mass() * tree.gravity_w().norm();
        Ok(Self { foot, full_load_n, joints: joints.collect() })
    }

    /// Writes the gains, and for a levelled ankle where the sole is parallel to the ground: `x` is the levelled state, `lean` that of the
    /// ground.
    pub fn write(
        &self,
        level: Option<&LevelStance>,
        x: &[f64],
        lean: [f64; 2],
        message_joint: &[usize],
        command: &mut Command,
    ) {
        command.load_foot.fill(0);
        let Some(full_load) = command.full_load_n.get_mut(self.foot) else { return };
        *full_load = self.full_load_n;
        for &(joint, stiffness, damping) in &self.joints {
            let at = message_joint[joint];
            command.load_foot[at] = 1 + self.foot as u32;
            command.unloaded_stiffness[at] = stiffness;
            command.unloaded_damping[at] = damping;
        }
        let Some(level) = level else { return };
        for (joint, lean) in level.ankle().into_iter().zip(lean) {
            let at = message_joint[joint];
            for segment in &mut command.segments {
                segment.position_ref[at] = x[joint] + lean;
                segment.velocity_ref[at] = 0.0;
                segment.acceleration_ref[at] = 0.0;
            }
        }
    }
}
