//! The end of a lifted stage: distance from the next boundary state, velocities there, end projection.
//!
//! ```text
//! ε    = ε_e + Ad_gs⁻¹ (η^0 + (S^0 + S^s) δξ^s)          δq = q^s - q_{k+1} + δq^s
//! Π    = Π_Φ - Π_{k+1} + Ad_gs^T δP^1 + N ε',  N = ½(ad^D_{Π_Φ} + ad^D_{Π_{k+1}}),  ε' = ε - ε_e         (DP^1 in base axes)
//! p_j  = row s of the joints
//! 𝓜 (δV; δq̇) = (Π; p_j) - ∂(momenta)/∂q δq               at the next boundary state
//! δλ^s = -W⁻¹ (y + Y x'_raw)
//! ```
//!
//! Letters: [`super`].

use alloc::vec::Vec;
use nalgebra::{Matrix6, Vector6};

use super::right_hand_sides::{joint_twist, shift_gain};
use super::row_product::{AddDense, AddProduct, SolveRows, SparseRows};
use super::{BoundaryState, ContactStage, LiftedStage, StageNominal};
use crate::del_hessian::DelHessian;
use crate::errors::StepError;
use crate::lanes::LANES;
use crate::linearize::SolveMass;
use crate::newton_direction::{NewtonDirection, base_matrix};
use crate::row_matrix::RowMatrix;
use crate::spatial::{RigidTransform, Twist, Wrench, log_rotation};
use crate::tree::KinematicTree;

/// A joint that shares a branch with another.
#[derive(Clone, Copy, Debug)]
pub(super) struct Relative {
    /// Coordinate of the other joint.
    dof: u32,
    /// Their pair of the Hessian, and whether the other one is the body of the pair.
    pair: u32,
    mirrored: bool,
}

/// The relatives of every joint, itself included.
#[derive(Clone, Debug)]
pub(super) struct Relatives {
    list: Vec<Relative>,
    starts: Vec<usize>,
}

impl Relatives {
    pub(super) fn new(tree: &KinematicTree) -> Self {
        let mut list = Vec::new();
        let mut starts = Vec::from([0]);
        for own in 1..tree.body_count() {
            let own_dof = tree.joint_dof(own) as u32;
            let mut pair = 0;
            for body in 1..tree.body_count() {
                for &dof in tree.branch(body) {
                    let body_dof = tree.joint_dof(body) as u32;
                    if body == own && dof >= 6 {
                        list.push(Relative { dof, pair, mirrored: false });
                    } else if body != own && dof == own_dof {
                        list.push(Relative { dof: body_dof, pair, mirrored: true });
                    }
                    pair += 1;
                }
            }
            starts.push(list.len());
        }
        Self { list, starts }
    }

    pub(super) fn len(&self) -> usize {
        self.list.len()
    }

    fn of(&self, joint: usize) -> &[Relative] {
        &self.list[self.starts[joint]..self.starts[joint + 1]]
    }
}

impl Relative {
    /// `H[α,γ]` with the own joint as row.
    #[inline(always)]
    fn entry(&self, hessian: &DelHessian, pair: usize, alpha: usize, gamma: usize) -> f64 {
        if self.mirrored { hessian.mirrored(pair, alpha, gamma) } else { hessian.entry(pair, alpha, gamma) }
    }
}

/// The places of the products of [`ContactStage::end_rows`] with the nodes: rows of `ε`, `δq`, `Π`, `p_j`.
pub(super) fn end_pattern(relatives: &Relatives, nv: usize, s: usize) -> SparseRows {
    let mut rows = SparseRows::new(2 * nv, 36 + nv + s * (12 * nv + relatives.len()));
    for _ in 0..6 {
        for l in 0..6 {
            rows.push(l * s + s - 1, 0.0);
        }
        rows.end_row();
    }
    for dof in 6..nv {
        rows.push(dof * s + s - 1, 0.0);
        rows.end_row();
    }
    for _ in 0..6 {
        for source in 0..nv * s {
            rows.push(source, 0.0);
        }
        rows.end_row();
    }
    for joint in 0..nv - 6 {
        for source in 0..6 * s {
            rows.push(source, 0.0);
        }
        for relative in relatives.of(joint) {
            for gamma in 0..s {
                rows.push(relative.dof as usize * s + gamma, 0.0);
            }
        }
        rows.end_row();
    }
    rows
}

/// What the rows of the end share.
struct EndFrame {
    pose: RigidTransform,
    /// `Ad_gs⁻¹ (S^0 + S^s)`.
    twist: Matrix6<f64>,
    /// `Ad_gs⁻¹ Ad_g0`.
    carry: Matrix6<f64>,
    /// `N`.
    turn: Matrix6<f64>,
    momentum_b: Vector6<f64>,
}

impl ContactStage {
    /// `x_{k+1}` in `ends`, `-δλ^s` in `end_multipliers`.
    pub(super) fn end_rows(&mut self, tree: &KinematicTree, end: &BoundaryState) -> Result<(), StepError> {
        let nv = tree.dof();
        self.ends.reshape(2 * nv, self.map_columns());
        let frame = self.end_frame();
        self.fill_end_of_nodes(tree, &frame);
        let instructions = self.del.instructions;
        instructions.dispatch_wide(AddProduct {
            matrix: &self.end_of_nodes,
            source: &self.columns,
            target: &mut self.ends,
            first: 0,
        });
        self.fill_end_of_multipliers(&frame);
        instructions.dispatch_wide(AddProduct {
            matrix: &self.end_of_multipliers,
            source: &self.multipliers,
            target: &mut self.ends,
            first: nv,
        });
        self.add_direct_terms(tree, &frame);
        self.add_defect(tree, &frame, end);
        instructions.dispatch_wide(SolveMass { factor: self.end.factor(), out: &mut self.ends });
        self.project_end(tree)
    }

    fn end_frame(&self) -> EndFrame {
        let del = &self.del;
        let s = del.unknown_nodes();
        let pose = del.body_pose(0, s);
        let inverse = pose.inverse().adjoint();
        let (_, impulse) = del.body_momentum_and_impulse(0, s);
        let momentum = pose.inverse_transform_wrench(&(del.base_momentum_before_end() + impulse));
        let target = self.end.base_pose_w().inverse_transform_wrench(&self.end.momentum_w());
        let mut turn = Matrix6::zeros();
        for k in 0..6 {
            let unit = Twist::from_vector(&Vector6::ith(k, 1.0));
            let both = momentum.dual_bracket(&unit) + target.dual_bracket(&unit);
            turn.set_column(k, &(both.to_vector() * 0.5));
        }
        EndFrame {
            pose,
            twist: inverse * (base_matrix(del, 0) + base_matrix(del, s)),
            carry: inverse * del.start.base_pose.adjoint(),
            turn,
            momentum_b: momentum.to_vector(),
        }
    }

    /// Products with `δΞ`, in the order of [`end_pattern`].
    fn fill_end_of_nodes(&mut self, tree: &KinematicTree, frame: &EndFrame) {
        let Self { del, solver, end_of_nodes: rows, end, impulses, relatives, .. } = self;
        let momentum_gradient = end.momentum_gradient();
        let Some(hessian) = solver.hessian() else { return };
        let (nv, s) = (tree.dof(), del.unknown_nodes());
        let joints = nv - 6;
        rows.rewind();
        for k in 0..6 {
            for l in 0..6 {
                rows.refill(frame.twist[(k, l)]);
            }
        }
        for _ in 6..nv {
            rows.refill(1.0);
        }
        let start_twists = base_matrix(del, 0);
        let mut rigid = Matrix6::zeros();
        for alpha in 0..=s {
            rigid += Matrix6::from_fn(|r, k| hessian.rigid_column(k, alpha)[r]);
        }
        let to_base = frame.pose.adjoint().transpose();
        for dof in 0..nv {
            for gamma in 0..=s {
                impulses[dof * (s + 1) + gamma] = to_base * Vector6::from(hessian.impulse_column(dof, gamma));
            }
        }
        let shifted = to_base * rigid * start_twists + frame.turn * frame.twist;
        for k in 0..6 {
            for (dof, impulse) in impulses.chunks_exact(s + 1).enumerate() {
                for gamma in 1..s {
                    rows.refill(impulse[gamma][k]);
                }
                rows.refill(if dof < 6 {
                    impulse[s][k] - impulse[0][k] + shifted[(k, dof)]
                } else {
                    impulse[s][k] - momentum_gradient[k * joints + dof - 6]
                });
            }
        }
        for joint in 0..joints {
            let first = hessian.pair_starts[joint + 1];
            let shift = start_twists.tr_mul(&Vector6::from(hessian.shift_row(joint + 6, s)));
            for l in 0..6 {
                for gamma in 1..s {
                    rows.refill(hessian.entry(first + l, s, gamma));
                }
                rows.refill(hessian.entry(first + l, s, s) - hessian.entry(first + l, s, 0) + shift[l]);
            }
            let gradient = &momentum_gradient[(6 + joint) * joints..(7 + joint) * joints];
            for relative in relatives.of(joint) {
                let pair = relative.pair as usize;
                for gamma in 1..s {
                    rows.refill(relative.entry(hessian, pair, s, gamma));
                }
                rows.refill(relative.entry(hessian, pair, s, s) - gradient[relative.dof as usize - 6]);
            }
        }
    }

    /// `Σ_{α<s} C^αT δλ^α` in base axes at the end.
    fn fill_end_of_multipliers(&mut self, frame: &EndFrame) {
        let Self { del, end_of_multipliers: rows, active, contacts, placements, .. } = self;
        let m = active.len();
        rows.clear();
        for k in 0..6 {
            for alpha in 0..del.unknown_nodes() {
                for (index, active) in active.iter().enumerate() {
                    let contact = &contacts[active.contact];
                    let placement = &placements[alpha * contacts.len() + active.contact];
                    let wrench = placement.force_row(contact, active.row);
                    rows.push(alpha * m + index, frame.pose.inverse_transform_wrench(&wrench).to_vector()[k]);
                }
            }
            rows.end_row();
        }
    }

    /// What `x` and `u` do to the end at fixed nodes and multipliers.
    fn add_direct_terms(&mut self, tree: &KinematicTree, frame: &EndFrame) {
        let Self { del, solver, ends, start, relatives, .. } = self;
        let Some(hessian) = solver.hessian() else { return };
        let (nv, s) = (tree.dof(), del.unknown_nodes());
        let joints = nv - 6;
        let to_base = frame.pose.adjoint().transpose();
        let start_pose = start.base_pose_w();
        let mut shift = Matrix6::zeros();
        for alpha in 0..=s {
            shift += shift_gain(del, hessian, alpha);
        }
        // -ad^D_{P^0} η - Σ ad^D_Γ η = -ad^D_{P^1} η: only the gains are left of DP^1.
        let end_momentum = Wrench::from_vector(&frame.momentum_b);
        let mut turned = Matrix6::zeros();
        for k in 0..6 {
            let unit = Twist::from_vector(&Vector6::ith(k, 1.0));
            turned.set_column(k, &end_momentum.dual_bracket(&unit).to_vector());
        }
        let of_pose = to_base * shift * start_pose.adjoint() + (frame.turn - turned) * frame.carry;
        for k in 0..6 {
            for l in 0..6 {
                ends.add(k, 1 + l, frame.carry[(k, l)]);
                ends.add(nv + k, 1 + l, of_pose[(k, l)]);
            }
        }
        // Momenta in base axes at the start, seen from the base at the end.
        let carry = to_base * start_pose.inverse().adjoint().transpose();
        let mass = start.mass_matrix();
        for column in 0..nv {
            let moved = carry * Vector6::from_fn(|r, _| mass[r * nv + column]);
            for k in 0..6 {
                ends.add(nv + k, 1 + nv + column, moved[k]);
            }
        }
        let momentum_gradient = start.momentum_gradient();
        for joint in 0..joints {
            let dof = 6 + joint;
            let moved = carry * Vector6::from_fn(|r, _| momentum_gradient[r * joints + joint]);
            let pushed = to_base * Vector6::from(hessian.impulse_column(dof, 0));
            for k in 0..6 {
                ends.add(nv + k, 1 + dof, moved[k] + pushed[k]);
            }
            let shift = Wrench::from_vector(&hessian.shift_row(dof, s).into());
            let shift = start_pose.inverse_transform_wrench(&shift).to_vector();
            for k in 0..6 {
                ends.add(nv + dof, 1 + k, shift[k]);
            }
            for relative in relatives.of(joint) {
                let pair = relative.pair as usize;
                let entry = relative.entry(hessian, pair, s, 0);
                ends.add(nv + dof, 1 + relative.dof as usize, entry);
            }
            let step = del.rule.weights()[s] * del.time_step;
            ends.add(nv + dof, 1 + 2 * nv + joint, step);
        }
    }

    /// Distance of the end from the next boundary state.
    fn add_defect(&mut self, tree: &KinematicTree, frame: &EndFrame, end: &BoundaryState) {
        let (nv, s) = (tree.dof(), self.del.unknown_nodes());
        let joints = nv - 6;
        let turn = log_rotation(&end.orientation.tr_mul(&frame.pose.rotation));
        let travel = end.orientation.tr_mul(&(frame.pose.translation - end.position_w));
        let target = self.end.base_pose_w().inverse_transform_wrench(&self.end.momentum_w());
        let momentum = frame.momentum_b - target.to_vector();
        for k in 0..3 {
            self.ends.add(k, 0, turn[k]);
            self.ends.add(3 + k, 0, travel[k]);
        }
        for k in 0..6 {
            self.ends.add(nv + k, 0, momentum[k]);
        }
        self.del.next_momentum_into(tree, &mut self.change);
        for joint in 0..joints {
            let body = joint + 1;
            let away = self.del.node(s, 6 + joint) - end.q[joint];
            self.ends.add(6 + joint, 0, away);
            let target = self.end.joint_momentum(body);
            self.ends.add(nv + 6 + joint, 0, self.change[6 + joint] - target);
            for row in 0..nv {
                let gain = self.end.momentum_gradient()[row * joints + joint];
                if gain != 0.0 {
                    self.ends.add(nv + row, 0, -gain * away);
                }
            }
        }
    }

    /// `δλ^s`, and the velocities after it.
    fn project_end(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        let (nv, m) = (tree.dof(), self.active.len());
        self.end_multipliers.reshape(m, self.map_columns());
        if m == 0 {
            return Ok(());
        }
        self.end_of_multipliers.clear();
        let mut first = 0;
        while first < m {
            let contact = &self.contacts[self.active[first].contact];
            let count = contact.row_count();
            let gradient = &mut self.velocity_gradient[..count * nv];
            self.end.contact_velocity_gradient_into(tree, contact, gradient)?;
            for (row, gradient) in gradient.chunks_exact(nv).enumerate() {
                let g = &self.projection.rows()[(first + row) * nv..(first + row + 1) * nv];
                for &column in tree.branch(contact.body) {
                    let column = column as usize;
                    self.end_of_multipliers.push(column, gradient[column]);
                    self.end_of_multipliers.push(nv + column, g[column]);
                }
                self.end_of_multipliers.end_row();
                self.end_multipliers.add(first + row, 0, self.projection.velocities()[first + row]);
            }
            first += count;
        }
        let instructions = self.del.instructions;
        instructions.dispatch_wide(AddProduct {
            matrix: &self.end_of_multipliers,
            source: &self.ends,
            target: &mut self.end_multipliers,
            first: 0,
        });
        instructions.dispatch_wide(SolveRows { lu: &self.projection.gram, rows: &mut self.end_multipliers });
        for column in 0..nv {
            for row in 0..m {
                self.responses[column * m + row] = self.end_responses.get(nv + column, row);
            }
        }
        instructions.dispatch_wide(AddDense {
            block: &self.responses[..nv * m],
            columns: m,
            sign: -1.0,
            source: &self.end_multipliers,
            target: &mut self.ends,
            first: nv,
        });
        Ok(())
    }

    /// Rows `G`, `y` at the next boundary, `𝓜⁻¹G_s^T` with the contact wrenches at node s, and the factors of `W = G 𝓜⁻¹ G_s^T`: the
    /// impulse acts where the stage ends, the velocity is that of the next boundary.
    pub(super) fn factor_end_responses(
        &mut self,
        tree: &KinematicTree,
        active: &[bool],
    ) -> Result<(), StepError> {
        self.projection.update_rows(tree, &self.end, &self.contacts, active)?;
        let Self { del, projection, contacts, placements, end, end_responses, .. } = self;
        let (nv, s, m) = (tree.dof(), del.unknown_nodes(), self.active.len());
        if m == 0 {
            return Ok(());
        }
        let pose = del.body_pose(0, s);
        end_responses.reshape(2 * nv, m);
        for (column, active) in self.active.iter().enumerate() {
            let contact = &contacts[active.contact];
            let placement = &placements[s * contacts.len() + active.contact];
            let wrench = placement.force_row(contact, active.row);
            let base = pose.inverse_transform_wrench(&wrench).to_vector();
            for k in 0..6 {
                end_responses.set(nv + k, column, base[k]);
            }
            for &dof in &tree.branch(contact.body)[6..] {
                let dof = dof as usize;
                end_responses.set(nv + dof, column, wrench.dot(&joint_twist(del, dof - 5, s)));
            }
        }
        del.instructions.dispatch_wide(SolveMass { factor: end.factor(), out: end_responses });
        self.end_of_multipliers.clear();
        for (active, row) in self.active.iter().zip(projection.rows().chunks_exact(nv)) {
            for &dof in tree.branch(contacts[active.contact].body) {
                self.end_of_multipliers.push(nv + dof as usize, row[dof as usize]);
            }
            self.end_of_multipliers.end_row();
        }
        self.end_multipliers.reshape(m, m);
        del.instructions.dispatch_wide(AddProduct {
            matrix: &self.end_of_multipliers,
            source: end_responses,
            target: &mut self.end_multipliers,
            first: 0,
        });
        projection.factor_gram(self.regularisation, |row, column| self.end_multipliers.get(row, column))
    }

    /// Copies the maps.
    pub(super) fn write(&self, nominal: &StageNominal, out: &mut LiftedStage) {
        let (s, m, nv) = (self.del.unknown_nodes(), self.active.len(), self.change.len());
        let columns = self.map_columns();
        out.rows.clear();
        out.first_rows.fill(None);
        for (index, active) in self.active.iter().enumerate() {
            out.rows.push(active.of_all as u32);
            let first = &mut out.first_rows[active.contact];
            *first = first.or(Some(index as u32));
        }
        out.residual = self.residual.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
        copy_rows(&self.ends, 0, 2 * nv, &mut out.transition, columns);
        let maps = if out.nodes.is_empty() { 0 } else { s };
        for alpha in 1..=maps {
            for dof in 0..nv {
                let at = ((alpha - 1) * nv + dof) * columns;
                copy_rows(&self.columns, dof * s + alpha - 1, 1, &mut out.nodes[at..], columns);
            }
        }
        copy_rows(&self.multipliers, 0, s * m, &mut out.multipliers, columns);
        copy_rows(&self.end_multipliers, 0, m, &mut out.multipliers[s * m * columns..], columns);
        for value in &mut out.multipliers[s * m * columns..(s + 1) * m * columns] {
            *value = -*value;
        }
        let per_time = 1.0 / self.del.time_step;
        let forces = &mut out.forces[..m * columns];
        forces.fill(0.0);
        for alpha in 0..=s {
            for (index, active) in self.active.iter().enumerate() {
                forces[index * columns] +=
                    nominal.multipliers[alpha * nominal.rows() + active.of_all] * per_time;
            }
            let change = &out.multipliers[alpha * m * columns..(alpha + 1) * m * columns];
            for (force, change) in forces.iter_mut().zip(change) {
                *force += change * per_time;
            }
        }
    }
}

fn copy_rows(from: &RowMatrix, first: usize, count: usize, to: &mut [f64], columns: usize) {
    let stride = from.stride();
    let rows = from.quads()[first * stride..].chunks_exact(stride);
    for (row, target) in rows.zip(to.chunks_exact_mut(columns)).take(count) {
        let (fours, rest) = target.as_chunks_mut::<LANES>();
        for (four, quad) in fours.iter_mut().zip(row) {
            *four = quad.0;
        }
        if let Some(last) = row.get(fours.len()) {
            rest.copy_from_slice(&last.0[..rest.len()]);
        }
    }
}
