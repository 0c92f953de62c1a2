//! Where Newton's method starts; in words: [`super`].

use nalgebra::Vector3;

use super::Integrator;
use crate::del_residual::DelWorkspace;
use crate::errors::StepError;
use crate::spatial::{RigidTransform, exp_rotation, log_rotation};
use crate::state::State;
use crate::tree::KinematicTree;

impl Integrator {
    pub(super) fn guess_by_extrapolation(&mut self, tree: &KinematicTree) {
        let count = self.del.unknown_nodes() + 1;
        for dof in 0..tree.dof() {
            let nodes = &self.previous_nodes[dof * count..(dof + 1) * count];
            for alpha in 1..count {
                let row = &self.extrapolation[alpha * count..(alpha + 1) * count];
                let value = row.iter().zip(nodes).map(|(l, q)| l * q).sum();
                self.del.set_node(alpha, dof, value);
            }
        }
        if tree.is_floating() {
            self.move_guess_to_new_chart();
        }
        let s = count - 1;
        self.missed.expected_into(&mut self.direction);
        for dof in 0..tree.dof() {
            for alpha in 1..=s {
                let at = dof * s + alpha - 1;
                self.extrapolated[at] = self.del.node(alpha, dof);
                self.del.move_node(alpha, dof, self.direction[at]);
            }
        }
    }

    /// Learns from what the extrapolation has missed of the solution.
    pub(super) fn remember_missed(&mut self, tree: &KinematicTree) {
        let s = self.del.unknown_nodes();
        for dof in 0..tree.dof() {
            for alpha in 1..=s {
                let at = dof * s + alpha - 1;
                self.extrapolated[at] = self.del.node(alpha, dof) - self.extrapolated[at];
            }
        }
        self.missed.remember(&mut self.extrapolated);
    }

    /// The guess of a floating base is in the chart of the last step: the same poses in the chart of this step.
    fn move_guess_to_new_chart(&mut self) {
        let s = self.del.unknown_nodes();
        let start = self.del.start.base_pose;
        let vector = |del: &DelWorkspace, alpha: usize, at: usize| {
            Vector3::new(del.node(alpha, at), del.node(alpha, at + 1), del.node(alpha, at + 2))
        };
        let pose = |del: &DelWorkspace, alpha: usize| {
            let motion = RigidTransform {
                rotation: exp_rotation(&vector(del, alpha, 0)),
                translation: vector(del, alpha, 3),
            };
            self.previous_center * motion
        };
        let end = pose(&self.del, s);
        let turn = log_rotation(&start.rotation.tr_mul(&end.rotation)) * 0.5;
        let center = RigidTransform {
            rotation: start.rotation * exp_rotation(&turn),
            translation: (start.translation + end.translation) * 0.5,
        };
        for alpha in 1..=s {
            let motion = center.inverse() * pose(&self.del, alpha);
            let omega = log_rotation(&motion.rotation);
            for k in 0..3 {
                self.del.set_node(alpha, k, omega[k]);
                self.del.set_node(alpha, 3 + k, motion.translation[k]);
            }
        }
    }

    pub(super) fn guess_by_velocity(&mut self, tree: &KinematicTree, state: &State) -> Result<(), StepError> {
        self.velocities.velocity_into(tree, state, &mut self.rate)?;
        let step = self.del.time_step();
        for alpha in 1..=self.del.unknown_nodes() {
            let c = self.del.rule().nodes()[alpha];
            for joint in 0..tree.joint_count() {
                let dof = tree.base_dof() + joint;
                self.del.set_node(alpha, dof, state.q[joint] + c * step * self.rate[dof]);
            }
            if tree.is_floating() {
                let half = self.half_motion(state);
                for (k, value) in half.iter().enumerate() {
                    self.del.set_node(alpha, k, (2.0 * c - 1.0) * value);
                }
            }
        }
        Ok(())
    }

    /// Half a step of the base at constant body velocity, in the chart centred in the middle of the step.
    fn half_motion(&self, state: &State) -> [f64; 6] {
        let vector = |at: usize| Vector3::new(self.rate[at], self.rate[at + 1], self.rate[at + 2]);
        let (omega, linear) = (vector(0), vector(3));
        let pose = &state.base_pose;
        let half = 0.5 * self.del.time_step();
        let turn = pose.rotation.tr_mul(&omega) * half;
        let center = pose.rotation * exp_rotation(&turn);
        let travel = center.tr_mul(&(linear + omega.cross(&pose.translation))) * half;
        [turn.x, turn.y, turn.z, travel.x, travel.y, travel.z]
    }

    pub(super) fn guess_at_rest(&mut self, tree: &KinematicTree) {
        for alpha in 1..=self.del.unknown_nodes() {
            for dof in 0..tree.dof() {
                let value = if dof < tree.base_dof() { 0.0 } else { self.del.node(0, dof) };
                self.del.set_node(alpha, dof, value);
            }
        }
    }
}
