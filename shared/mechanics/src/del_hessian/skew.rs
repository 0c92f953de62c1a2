//! The asymmetric part of the Hessian under torques that keep their direction in {0}.
//!
//! The gain of such a torque is `τ×η_ω`: `∂(s_iᵀτ)/∂q_j = s_i·(τ×s_j)` for j above i and zero for j below, so the mirror image of a pair
//! has less by this, node by node. Base coordinates count with the angular part of their twist; between them the terms `N(Γ)` of
//! [`crate::floating_base`] make up the same difference (`N^T - N = S^T ad^D S`).

use super::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::lanes::{LANES, Quad};
use crate::tree::{KinematicTree, NO_PARENT};

/// A 3-vector at the nodes of one lane group.
type Lanes3 = [Quad; 3];

impl DelHessian {
    pub(super) fn evaluate_skew(&mut self, tree: &KinematicTree, del: &DelWorkspace) {
        self.skew.fill(Quad::ZERO);
        let groups = self.groups;
        for held in del.dead_torques() {
            for g in 0..groups {
                let torque = &held.torque_w[g];
                let weight = &del.weights[g];
                let mut i = held.body;
                while i != NO_PARENT && !tree.is_base(i) {
                    let own = joint_axis(del, i, g);
                    for (place, &dof) in tree.branch(i).iter().enumerate() {
                        let dof = dof as usize;
                        let axis = if dof >= tree.base_dof() {
                            joint_axis(del, dof - tree.base_dof() + tree.first_joint_body(), g)
                        } else if dof < 3 {
                            base_axis(del, dof, g)
                        } else {
                            continue;
                        };
                        let at = (self.pair_starts[i] + place) * groups + g;
                        add_triple_product(&mut self.skew[at], weight, own, torque, axis);
                    }
                    i = tree.constants()[i].parent;
                }
                if tree.is_floating() {
                    self.correct_base_block(del, torque, g);
                }
            }
        }
    }

    /// Images `(l, k)`, `l < k`, of the base-base block at equal nodes.
    fn correct_base_block(&mut self, del: &DelWorkspace, torque: &Lanes3, g: usize) {
        for k in 1..3 {
            for l in 0..k {
                let mut less = Quad::ZERO;
                let (own, axis) = (base_axis(del, k, g), base_axis(del, l, g));
                add_triple_product(&mut less, &del.weights[g], own, torque, axis);
                for lane in 0..LANES {
                    let alpha = g * LANES + lane;
                    if alpha <= self.s {
                        let at = ((6 * l + k) * (self.s + 1) + alpha) * self.groups + g;
                        self.base_blocks[at].0[lane] -= less.0[lane];
                    }
                }
            }
        }
    }
}

fn joint_axis(del: &DelWorkspace, body: usize, g: usize) -> Lanes3 {
    let twist = &del.bodies[body * del.groups + g].joint_twist;
    [twist[0], twist[1], twist[2]]
}

/// Column k of `Z`.
fn base_axis(del: &DelWorkspace, k: usize, g: usize) -> Lanes3 {
    let z = &del.base[g].z;
    [z[k], z[3 + k], z[6 + k]]
}

/// `target += weight a·(τ×b)`.
fn add_triple_product(target: &mut Quad, weight: &Quad, a: Lanes3, torque: &Lanes3, b: Lanes3) {
    for lane in 0..LANES {
        let at = |v: &Lanes3, k: usize| v[k].0[lane];
        let mut sum = 0.0;
        for k in 0..3 {
            let (l, m) = ((k + 1) % 3, (k + 2) % 3);
            sum += at(&a, k) * (at(torque, l) * at(&b, m) - at(torque, m) * at(&b, l));
        }
        target.0[lane] += weight.0[lane] * sum;
    }
}
