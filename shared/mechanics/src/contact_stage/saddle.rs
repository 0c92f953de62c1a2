//! The saddle system of a stage: nodes and multipliers together.
//!
//! Letters and equations: [`super`].

use super::ContactStage;
use super::right_hand_sides::joint_twist;
use super::row_product::{AddDense, AddProduct, SolveRows};
use crate::errors::StepError;
use crate::newton_direction::NewtonDirection;
use crate::tree::KinematicTree;

impl ContactStage {
    /// `δΞ` in the columns before `𝒜`, `δΛ` in the rows of `multipliers`. `lifted`: with the columns of `x` (else one of `-[r; h]`).
    pub(super) fn solve_saddle(&mut self, tree: &KinematicTree, lifted: bool) -> Result<(), StepError> {
        let (s, m) = (self.del.unknown_nodes(), self.active.len());
        self.solver.solve_many(tree, &mut self.columns);
        let size = s * m;
        let columns = self.columns.columns();
        self.multipliers.reshape(size, columns);
        if m == 0 {
            return Ok(());
        }
        let first = columns - size;
        self.fill_gradient(tree);
        let instructions = self.del.instructions;
        instructions.dispatch_wide(AddProduct {
            matrix: &self.gradient,
            source: &self.columns,
            target: &mut self.multipliers,
            first: 0,
        });
        self.schur.set_order(size);
        let scale = self.regularisation * self.projection.mean_gram * self.del.time_step;
        for (r, row) in self.schur.entries_mut().chunks_exact_mut(size).enumerate() {
            self.multipliers.copy_part(r, first, row);
            row[r] -= scale;
        }
        self.schur
            .factor()
            .map_err(|(index, pivot)| StepError::RedundantConstraint { row: index % m, pivot })?;
        self.add_defects(tree, lifted);
        instructions.dispatch_wide(SolveRows { lu: &self.schur, rows: &mut self.multipliers });
        let rows = self.columns.rows();
        for (r, response) in self.responses.chunks_exact_mut(size).take(rows).enumerate() {
            self.columns.copy_part(r, first, response);
        }
        instructions.dispatch_wide(AddDense {
            block: &self.responses[..rows * size],
            columns: size,
            sign: -1.0,
            source: &self.multipliers,
            target: &mut self.columns,
            first: 0,
        });
        Ok(())
    }

    /// `𝒢`: `C_h^γ` on node γ, and on the rigid shift of the chart by `ξ^s`.
    fn fill_gradient(&mut self, tree: &KinematicTree) {
        let Self { del, gradient, active, contacts, placements, .. } = self;
        let s = del.unknown_nodes();
        gradient.clear();
        for gamma in 1..=s {
            for active in active.iter() {
                let contact = &contacts[active.contact];
                let placement = &placements[gamma * contacts.len() + active.contact];
                let wrench = placement.gradient_row(contact, &placements[active.contact], active.row);
                let own = del.project_base(gamma, &wrench);
                let rigid = del.project_base(0, &wrench);
                for k in 0..6 {
                    if gamma == s {
                        gradient.push(k * s + s - 1, own[k] + rigid[k]);
                    } else {
                        gradient.push(k * s + gamma - 1, own[k]);
                        gradient.push(k * s + s - 1, rigid[k]);
                    }
                }
                for &dof in &tree.branch(contact.body)[6..] {
                    let twist = joint_twist(del, dof as usize - 5, gamma);
                    gradient.push(dof as usize * s + gamma - 1, wrench.dot(&twist));
                }
                gradient.end_row();
            }
        }
    }

    /// `h`, and `H_x`: `C_h^γ η^0 - C_h0^γ (η^0 + Σ S_i^0 δq_i)`.
    fn add_defects(&mut self, tree: &KinematicTree, lifted: bool) {
        let Self { del, start, multipliers, active, contacts, placements, .. } = self;
        let (s, m) = (del.unknown_nodes(), active.len());
        for gamma in 1..=s {
            for (index, active) in active.iter().enumerate() {
                let row = (gamma - 1) * m + index;
                let contact = &contacts[active.contact];
                let (first, node) =
                    (&placements[active.contact], &placements[gamma * contacts.len() + active.contact]);
                multipliers.add(row, 0, node.defect(contact, first, active.row));
                if !lifted {
                    continue;
                }
                let at_node = node.gradient_row(contact, first, active.row);
                let at_start = first.start_gradient_row(contact, node, active.row);
                let pose = start.base_pose_w();
                let shift = pose.inverse_transform_wrench(&(at_node - at_start)).to_vector();
                for k in 0..6 {
                    multipliers.add(row, 1 + k, shift[k]);
                }
                for &dof in &tree.branch(contact.body)[6..] {
                    let twist = joint_twist(del, dof as usize - 5, 0);
                    multipliers.add(row, 1 + dof as usize, -at_start.dot(&twist));
                }
            }
        }
    }
}
