//! Right-hand sides `-[r | R_x | R_u]` of a lifted stage and the force columns `𝒜`.
//!
//! ```text
//! ε    joint rows S_i^T 𝒴_i η̄;  base r^α: S^αT 𝒴 η̄,  r^0 also S^sT Σ_{α<s} 𝒴^α η̄          (η̄ = Ad_g0 ε; P moves along, DP = 0)
//! q    H[α,0], base r^0: H[0,0] - H[s,0] + S^sT ∂G/∂q^0;  and the momenta at fixed velocity
//! v    momenta 𝓜 δv: joint rows of node 0, base r^0: (S^0 + S^s)^T δP
//! u    w_α Δt
//! λ^α  r^α: C^αT;  base r^0: S^sT C^αT;  only α = 0 in the joint rows of node 0
//! ```
//!
//! Letters: [`super`].

use nalgebra::{Matrix6, Vector6};

use super::ContactStage;
use crate::del_residual::DelWorkspace;
use crate::lanes::LANES;
use crate::newton_direction::{NewtonDirection, base_matrix};
use crate::spatial::{Twist, Wrench};
use crate::tree::KinematicTree;

impl ContactStage {
    /// `-[r | R_x | R_u]`, then `𝒜`.
    pub(super) fn fill_columns(&mut self, tree: &KinematicTree) {
        let (nv, s) = (tree.dof(), self.del.unknown_nodes());
        let first = self.map_columns();
        self.columns.reshape(s * nv, first + s * self.active.len());
        for (row, value) in self.residual.iter().enumerate() {
            self.columns.set(row, 0, -value);
        }
        self.fill_pose_columns(tree);
        self.fill_joint_columns(tree);
        self.fill_momentum_columns(tree);
        for joint in 0..nv - 6 {
            for alpha in 0..s {
                let step = self.del.rule.weights()[alpha] * self.del.time_step;
                self.columns.set((6 + joint) * s + alpha, 1 + 2 * nv + joint, -step);
            }
        }
        self.fill_force_columns(tree, first);
    }

    /// Only `-r` and `𝒜`: a Newton iteration.
    pub(super) fn fill_newton_columns(&mut self, tree: &KinematicTree) {
        let (nv, s) = (tree.dof(), self.del.unknown_nodes());
        self.columns.reshape(s * nv, 1 + s * self.active.len());
        for (row, value) in self.residual.iter().enumerate() {
            self.columns.set(row, 0, -value);
        }
        self.fill_force_columns(tree, 1);
    }

    fn fill_pose_columns(&mut self, tree: &KinematicTree) {
        let Self { del, solver, columns, start, .. } = self;
        let Some(hessian) = solver.hessian() else { return };
        let s = del.unknown_nodes();
        let pose = start.base_pose_w();
        for dof in 0..tree.dof() {
            for alpha in 0..s {
                let row = Wrench::from_vector(&hessian.shift_row(dof, alpha).into());
                let row = pose.inverse_transform_wrench(&row).to_vector();
                for k in 0..6 {
                    columns.add(dof * s + alpha, 1 + k, -row[k]);
                }
            }
        }
        let mut gain = Matrix6::zeros();
        for alpha in 0..s {
            gain += shift_gain(del, hessian, alpha);
        }
        let rows = base_matrix(del, s).tr_mul(&gain) * pose.adjoint();
        for k in 0..6 {
            for l in 0..6 {
                columns.add(k * s, 1 + l, -rows[(k, l)]);
            }
        }
    }

    fn fill_joint_columns(&mut self, tree: &KinematicTree) {
        let Self { del, solver, columns, .. } = self;
        let Some(hessian) = solver.hessian() else { return };
        let s = del.unknown_nodes();
        for i in 1..tree.body_count() {
            let dof = tree.joint_dof(i);
            for (block, &j) in hessian.body_pairs(i, s).zip(tree.branch(i)).skip(6) {
                let j = j as usize;
                for alpha in 0..s {
                    columns.set(j * s + alpha, 1 + dof, -block.mirrored(alpha, 0));
                    columns.set(dof * s + alpha, 1 + j, -block.entry(alpha, 0));
                }
            }
            let joint = hessian.joint_and_base(i, dof, s, hessian.groups);
            for k in 0..6 {
                for alpha in 0..s {
                    columns.set(k * s + alpha, 1 + dof, -joint.base_row(k, alpha, 0));
                }
            }
        }
    }

    /// The momenta at the start: by `q` at fixed velocity, and by the velocity.
    fn fill_momentum_columns(&mut self, tree: &KinematicTree) {
        let Self { del, columns, start, .. } = self;
        let (nv, s) = (tree.dof(), del.unknown_nodes());
        let on_base = base_momentum_rows(del);
        let joints = nv - 6;
        let (mass, gradient) = (start.mass_matrix(), start.momentum_gradient());
        for column in 0..nv {
            let rows = on_base * Vector6::from_fn(|r, _| mass[r * nv + column]);
            for k in 0..6 {
                columns.add(k * s, 1 + nv + column, -rows[k]);
            }
        }
        for joint in 0..joints {
            let rows = on_base * Vector6::from_fn(|r, _| gradient[r * joints + joint]);
            for k in 0..6 {
                columns.add(k * s, 7 + joint, -rows[k]);
            }
        }
        for i in 1..tree.body_count() {
            let dof = tree.joint_dof(i);
            for &j in tree.branch(i) {
                let j = j as usize;
                let value = -mass[dof * nv + j];
                columns.set(dof * s, 1 + nv + j, value);
                if j >= 6 {
                    columns.set(j * s, 1 + nv + dof, value);
                    columns.add(dof * s, 1 + j, -gradient[dof * joints + j - 6]);
                    if j != dof {
                        columns.add(j * s, 1 + dof, -gradient[j * joints + dof - 6]);
                    }
                }
            }
        }
    }

    fn fill_force_columns(&mut self, tree: &KinematicTree, first: usize) {
        let Self { del, columns, active, contacts, placements, .. } = self;
        let (s, m) = (del.unknown_nodes(), active.len());
        for alpha in 0..s {
            for (index, active) in active.iter().enumerate() {
                let column = first + alpha * m + index;
                let contact = &contacts[active.contact];
                let placement = &placements[alpha * contacts.len() + active.contact];
                let wrench = placement.force_row(contact, active.row);
                let own = del.project_base(alpha, &wrench);
                let last = del.project_base(s, &wrench);
                for k in 0..6 {
                    columns.add(k * s + alpha, column, own[k]);
                    columns.add(k * s, column, last[k]);
                }
                for &dof in &tree.branch(contact.body)[6..] {
                    let twist = joint_twist(del, dof as usize - 5, alpha);
                    columns.set(dof as usize * s + alpha, column, wrench.dot(&twist));
                }
            }
        }
    }
}

/// `𝒴^α w_α Δt` of the whole robot: the change of its impulse, moving along, by a rigid shift.
pub(super) fn shift_gain(
    del: &DelWorkspace,
    hessian: &crate::del_hessian::DelHessian,
    alpha: usize,
) -> Matrix6<f64> {
    let (_, impulse) = del.body_momentum_and_impulse(0, alpha);
    let mut gain = Matrix6::zeros();
    for k in 0..6 {
        let turned = impulse.dual_bracket(&Twist::from_vector(&Vector6::ith(k, 1.0))).to_vector();
        gain.set_column(k, &(Vector6::from(hessian.rigid_column(k, alpha)) + turned));
    }
    gain
}

/// Base rows of node 0 per momentum in base axes at the start: `(S^0 + S^s)^T Ad_g0⁻ᵀ`.
fn base_momentum_rows(del: &DelWorkspace) -> Matrix6<f64> {
    let s = del.unknown_nodes();
    let pose = del.start.base_pose;
    let mut rows = Matrix6::zeros();
    for k in 0..6 {
        let wrench = pose.transform_wrench(&Wrench::from_vector(&Vector6::ith(k, 1.0)));
        let (first, last) = (del.project_base(0, &wrench), del.project_base(s, &wrench));
        rows.set_column(k, &(Vector6::from(first) + Vector6::from(last)));
    }
    rows
}

/// `S_i^α` of a joint.
pub(super) fn joint_twist(del: &DelWorkspace, body: usize, alpha: usize) -> Twist {
    let lanes = &del.bodies[body * del.groups + alpha / LANES];
    Twist::from_vector(&Vector6::from(lanes.joint_twist.map(|q| q.0[alpha % LANES])))
}
