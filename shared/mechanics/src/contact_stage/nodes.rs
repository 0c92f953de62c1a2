//! Where a stage starts, its nodes and contact forces: evaluation of the residual.
//!
//! Letters and equations: [`super`].

use nalgebra::Vector3;

use super::contact::{angular_axis, point_axis};
use super::{ActiveRow, BoundaryState, ContactKind, ContactStage, Placement, StageNominal};
use crate::del_residual::DeadLoad;
use crate::errors::StepError;
use crate::forces::StepForces;
use crate::kinematics::check_length;
use crate::lanes::LANES;
use crate::newton_direction::NewtonDirection;
use crate::tree::KinematicTree;

impl ContactStage {
    /// Active rows, state and loads of a stage.
    pub(super) fn begin(
        &mut self,
        tree: &KinematicTree,
        time_step: f64,
        active: &[bool],
        start: &BoundaryState,
        u: &[f64],
    ) -> Result<(), StepError> {
        check_length("active contacts", active.len(), self.contacts.len())?;
        self.active.clear();
        for (index, contact) in self.contacts.iter().enumerate().filter(|(index, _)| active[*index]) {
            for (place, row) in contact.kept().enumerate() {
                self.active.push(ActiveRow { contact: index, row, of_all: self.first_rows[index] + place });
            }
        }
        // The end of one stage is most often the start of the next.
        if self.end.is_at(start) {
            core::mem::swap(&mut self.start, &mut self.end);
        } else if !self.start.is_at(start) {
            self.start.update(tree, start)?;
        }
        self.start.state_into(&mut self.state)?;
        if self.del.time_step() != time_step {
            self.del.set_time_step(time_step)?;
        }
        self.del.begin(tree, &self.state, &StepForces::held(u))?;
        for contact in self.contacts.iter().zip(active).filter(|(_, active)| **active).map(|(c, _)| c) {
            let arm_b = contact.point_b(tree).into();
            self.del.push_load(DeadLoad { body: contact.body, arm_b, couple: false });
        }
        Ok(())
    }

    /// Puts nodes and contact forces of `nominal` into the workspace and evaluates residual and placements.
    pub(super) fn place_nodes(
        &mut self,
        tree: &KinematicTree,
        nominal: &StageNominal,
    ) -> Result<(), StepError> {
        let (s, joints) = (self.del.unknown_nodes(), tree.joint_count());
        for alpha in 1..=s {
            for k in 0..6 {
                self.del.set_node(alpha, k, nominal.xi[(alpha - 1) * 6 + k]);
            }
            for joint in 0..joints {
                self.del.set_node(alpha, 6 + joint, nominal.q[(alpha - 1) * joints + joint]);
            }
        }
        self.apply_multipliers(&nominal.multipliers);
        self.evaluate(tree)
    }

    /// Residual and placements at the nodes in the workspace.
    pub(super) fn evaluate(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        self.del.evaluate(tree, &[]);
        self.del.residual_into(tree, &mut self.residual);
        if let Some(index) = self.residual.iter().position(|x| !x.is_finite()) {
            return Err(StepError::NonFinite { quantity: "DEL residual (coordinate * s + node)", index });
        }
        for alpha in 0..=self.del.unknown_nodes() {
            for (index, contact) in self.contacts.iter().enumerate() {
                let pose = self.del.body_pose(contact.body, alpha);
                self.placements[alpha * self.contacts.len() + index] = Placement::at(tree, contact, &pose);
            }
        }
        Ok(())
    }

    /// Contact forces `λ^α/(w_α Δt)` along the ground axes.
    pub(super) fn apply_multipliers(&mut self, multipliers: &[f64]) {
        let (all, groups) = (self.row_count(), self.del.groups);
        let (mut load, mut torque) = (0, 0);
        for index in 0..self.contacts.len() {
            let contact = self.contacts[index];
            let is_active = self.active.iter().any(|row| row.contact == index);
            let is_foot = contact.kind == ContactKind::Foot;
            for alpha in 0..=self.del.unknown_nodes() {
                let scale = 1.0 / (self.del.rule.weights()[alpha] * self.del.time_step);
                let (mut force_w, mut torque_w) = (Vector3::zeros(), Vector3::zeros());
                if is_active {
                    let first = alpha * all + self.first_rows[index];
                    for (place, row) in contact.kept().enumerate() {
                        let value = multipliers[first + place] * scale;
                        match angular_axis(&contact, row) {
                            Some(axis) => torque_w += contact.axes_w.column(axis) * value,
                            None => force_w += contact.axes_w.column(point_axis(&contact, row)) * value,
                        }
                    }
                }
                for c in 0..3 {
                    if is_active {
                        let lanes = &mut self.del.load_forces[load * groups + alpha / LANES];
                        lanes[c].0[alpha % LANES] = force_w[c];
                    }
                    if is_foot {
                        let lanes = &mut self.del.held_torques[torque].torque_w[alpha / LANES];
                        lanes[c].0[alpha % LANES] = torque_w[c];
                    }
                }
            }
            load += usize::from(is_active);
            torque += usize::from(is_foot);
        }
    }

    pub(super) fn solver_factor(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        Ok(self.solver.factor(tree, &self.del)?)
    }
}
