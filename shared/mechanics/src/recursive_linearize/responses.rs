//! What the columns need of every body, recorded while Algorithm B.1 eliminates it; letters as in [`super`].

use alloc::vec;
use alloc::vec::Vec;

use crate::del_residual::{DelWorkspace, load_arm};
use crate::lanes::{
    LANES, Lane, Lane3, Lane6, Quad, Simd, add, cross, dual_bracket, halves, join, load, mat_tr_vec, mat_vec,
    scale, splat, store, sub,
};
use crate::recursive_newton::{Interface, JointNodes, MAX_NODES, add_scaled, arm_cross_force, dot};
use crate::tree::{KinematicTree, NO_PARENT};

/// The factors of one body, as Algorithm B.1 has just left them.
pub(crate) struct BodyFactors<'a> {
    pub y: &'a [Quad],
    pub b: &'a [Quad],
    pub w: &'a [Quad],
    pub c: &'a [Quad],
    pub u: &'a [Quad],
    pub inverse: &'a [f64],
}

/// Responses of every body, in the order in which the sweeps read them.
#[derive(Clone, Debug)]
pub(crate) struct Responses {
    pub(super) shape: Interface,
    groups: usize,
    /// Forces of fixed direction on a subtree: `Σ x^ f^` (9), `Σ f` (3).
    fixed_directions: Vec<[Quad; 12]>,
    /// `c_i` and `Γ̃_i` at the nodes.
    rows: Vec<[Quad; 3]>,
    impulses: Vec<[Quad; 6]>,
    pub(super) inward: Vec<f64>,
    pub(super) outward: Vec<f64>,
    pub(super) starts: Vec<f64>,
}

/// Lengths of the three records of a body.
#[derive(Clone, Copy)]
pub(super) struct Lengths {
    pub inward: usize,
    pub outward: usize,
    pub start: usize,
}

impl Lengths {
    #[inline(always)]
    pub fn new(shape: &Interface) -> Self {
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        Self {
            // (C, C^s) of the momenta, S^1..S^s, S^0, D⁻¹, U
            inward: 6 * (s + 1) * (s + 1) + 6 * s + 6 + s * s + no * s,
            // (W, K^s), c^s, row s by x, S^1..S^s (angular), B of the velocities
            outward: ni * (s + 1) + 3 + s + 3 * s + 6 * (s + 1) * s,
            // g, v, Γ̃^0, b^0, row s
            start: s + no + 6 + ni + 1,
        }
    }
}

/// Appends numbers to a record.
struct Writer<'a>(core::slice::IterMut<'a, f64>);

impl Writer<'_> {
    #[inline(always)]
    fn push(&mut self, value: f64) {
        if let Some(slot) = self.0.next() {
            *slot = value;
        }
    }
}

#[inline(always)]
fn at(row: &[Quad], k: usize) -> f64 {
    row[k / LANES].0[k % LANES]
}

impl Responses {
    pub fn new(tree: &KinematicTree, del: &DelWorkspace, shape: &Interface) -> Self {
        let (bodies, groups, lengths) = (tree.body_count(), del.groups, Lengths::new(shape));
        Self {
            shape: *shape,
            groups,
            fixed_directions: vec![[Quad::ZERO; 12]; bodies * groups],
            rows: vec![[Quad::ZERO; 3]; bodies * groups],
            impulses: vec![[Quad::ZERO; 6]; bodies * groups],
            inward: vec![0.0; bodies * lengths.inward],
            outward: vec![0.0; bodies * lengths.outward],
            starts: vec![0.0; bodies * lengths.start],
        }
    }

    pub fn clear(&mut self) {
        self.fixed_directions.fill([Quad::ZERO; 12]);
    }

    /// `c_i^α`.
    #[inline(always)]
    pub fn fixed_direction_row(&self, body: usize, alpha: usize) -> [f64; 3] {
        self.rows[body * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `Γ̃_i^α`.
    #[inline(always)]
    pub fn moved_impulse(&self, body: usize, alpha: usize) -> [f64; 6] {
        self.impulses[body * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `c_i`, `Γ̃_i` of a body whose children are done; its forces of fixed direction go to its parent.
    #[inline(always)]
    pub fn add_fixed_directions<S: Simd>(
        &mut self,
        simd: S,
        tree: &KinematicTree,
        del: &DelWorkspace,
        i: usize,
    ) {
        let constants = &tree.constants()[i];
        let gravity: [f64; 3] = (*tree.gravity_w()).into();
        let weight: Lane3<S> = splat(simd, &gravity.map(|x| x * constants.mass));
        for g in 0..self.groups {
            let body = &del.bodies[i * self.groups + g];
            let mut sum: [Lane<S>; 12] = load(simd, &self.fixed_directions[i * self.groups + g]);
            add_force(&mut sum, load(simd, &body.position), weight, false);
            for (index, dead) in del.loads.iter().enumerate().filter(|(_, dead)| dead.body == i) {
                let (force, arm) = load_arm(simd, dead, &del.load_forces[index * self.groups + g], body);
                add_force(&mut sum, arm, force, dead.couple);
            }
            let arm_cross = [sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], sum[6], sum[7], sum[8]];
            let force = [sum[9], sum[10], sum[11]];
            let step = Lane::load(simd, &del.weights[g]);
            let twist: Lane6<S> = load(simd, &body.joint_twist);
            let (angular, linear) = halves(twist);
            let row = sub(mat_tr_vec(&arm_cross, angular), cross(force, linear));
            self.rows[i * self.groups + g] = store(scale(step, row));
            let gain = join(mat_vec(&arm_cross, angular), cross(force, angular));
            let turned = dual_bracket(load(simd, &body.impulse), twist);
            self.impulses[i * self.groups + g] = store(sub(scale(step, gain), turned));
            if constants.parent != NO_PARENT {
                let target = &mut self.fixed_directions[constants.parent * self.groups + g];
                *target = store(add(load(simd, target), sum));
            }
        }
    }

    /// The records of a body.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn record<S: Simd>(
        &mut self,
        simd: S,
        tree: &KinematicTree,
        del: &DelWorkspace,
        i: usize,
        nodes: &JointNodes<'_>,
        factors: &BodyFactors<'_>,
        shape: &Interface,
    ) {
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let (nq, oq) = (ni.div_ceil(LANES), no.div_ceil(LANES));
        let lengths = Lengths::new(shape);
        let momenta = 6 * (s + 1);
        let rule = &del.rule;
        let constants = &tree.constants()[i];
        let row = |m: &'_ [Quad], quads: usize, r: usize, k: usize| at(&m[r * quads..(r + 1) * quads], k);
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        let slope = |alpha: usize, gamma: usize| rule.derivative(alpha, gamma) / del.time_step;
        let (end_row, end_impulse) = (self.fixed_direction_row(i, s), self.moved_impulse(i, 0));
        // Momentum blocks of C^s; its block DΓ^s is S^s.
        let end_column = |beta: usize, k: usize| {
            let rate = if beta == s { step(s) * nodes.rate(s, k) } else { 0.0 };
            rule.weighted_derivative(s, beta) * nodes.twist(beta, k) + rate
        };

        // K^s and b^0, as rows of inputs.
        const QUADS: usize = (3 * MAX_NODES + 6 * MAX_NODES) / LANES + 1;
        let mut end = [Quad::ZERO; QUADS];
        let mut moved = [Quad::ZERO; QUADS];
        let end = &mut end[..nq];
        for beta in 0..=s {
            for k in 0..6 {
                let factor = end_column(beta, k);
                let source = &factors.y[shape.momentum_at(beta, k) * nq..][..nq];
                add_scaled(simd, end, factor, source);
            }
        }
        for k in 0..6 {
            let source = &factors.y[(shape.impulse_at(s) + k) * nq..][..nq];
            add_scaled(simd, end, nodes.twist(s, k), source);
            let slot = shape.nu_at(s, k);
            end[slot / LANES].0[slot % LANES] -= step(s) * nodes.turned_momentum(s, k);
        }
        let moved = &mut moved[..nq];
        let mut set = |k: usize, value: f64| moved[k / LANES].0[k % LANES] = value;
        for k in 0..3 {
            set(shape.eta_at(0) + k, nodes.twist(0, k));
        }
        for beta in 0..=s {
            for k in 0..6 {
                let rate = if beta == 0 { nodes.rate(0, k) } else { 0.0 };
                set(shape.nu_at(beta, k), slope(beta, 0) * nodes.twist(beta, k) + rate);
            }
        }

        let mut inward = Writer(self.inward[i * lengths.inward..(i + 1) * lengths.inward].iter_mut());
        for k in 0..6 {
            for beta in 0..=s {
                for alpha in 0..s {
                    inward.push(row(factors.c, oq, alpha, shape.momentum_at(beta, k)));
                }
                inward.push(end_column(beta, k));
            }
        }
        for alpha in (1..=s).chain(0..1) {
            (0..6).for_each(|k| inward.push(nodes.twist(alpha, k)));
        }
        factors.inverse.iter().for_each(|x| inward.push(*x));
        for k in 0..no {
            for column in 0..s {
                inward.push(row(factors.u, oq, column, k));
            }
        }

        let mut outward = Writer(self.outward[i * lengths.outward..(i + 1) * lengths.outward].iter_mut());
        for k in 0..ni {
            for alpha in 0..s {
                outward.push(row(factors.w, nq, alpha, k));
            }
            outward.push(at(end, k));
        }
        end_row.iter().for_each(|x| outward.push(*x));
        for column in 0..s {
            let gamma = column + 1;
            let mut value = dot(simd, end, &factors.b[column * nq..(column + 1) * nq]);
            value -= step(s) * constants.damping * slope(s, gamma);
            if gamma == s {
                value -= step(s) * constants.stiffness;
                value += (0..3).map(|k| end_row[k] * nodes.twist(s, k)).sum::<f64>();
            }
            outward.push(value);
        }
        for gamma in 1..=s {
            (0..3).for_each(|k| outward.push(nodes.twist(gamma, k)));
        }
        for k in shape.nu_at(0, 0)..ni {
            for column in 0..s {
                outward.push(row(factors.b, nq, column, k));
            }
        }

        let mut start = Writer(self.starts[i * lengths.start..(i + 1) * lengths.start].iter_mut());
        for alpha in 0..s {
            let mut g = -dot(simd, &factors.w[alpha * nq..(alpha + 1) * nq], moved);
            for k in 0..s {
                let stiffness = if k == 0 { constants.stiffness } else { 0.0 };
                g += factors.inverse[alpha * s + k] * step(k) * (stiffness + constants.damping * slope(k, 0));
            }
            start.push(g);
        }
        let first_momentum = |row: usize| row < momenta && row.is_multiple_of(s + 1);
        for r in 0..no {
            let turned = if first_momentum(r) { nodes.turned_momentum(0, r / (s + 1)) } else { 0.0 };
            start.push(dot(simd, &factors.y[r * nq..(r + 1) * nq], moved) - turned);
        }
        end_impulse.iter().for_each(|x| start.push(*x));
        for k in 0..ni {
            start.push(at(moved, k));
        }
        start.push(dot(simd, end, moved) - step(s) * constants.damping * slope(s, 0));
    }
}

/// Adds a force of fixed direction to the sums of a subtree.
#[inline(always)]
fn add_force<S: Simd>(sum: &mut [Lane<S>; 12], arm: Lane3<S>, force: Lane3<S>, couple: bool) {
    let product = arm_cross_force(arm, force);
    for k in 0..9 {
        sum[k] = sum[k] + product[k];
    }
    if !couple {
        for k in 0..3 {
            sum[9 + k] = sum[9 + k] + force[k];
        }
    }
}
