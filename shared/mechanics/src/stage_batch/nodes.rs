//! Algorithm 1 of a vector of stages: nodes, both ends, residual, velocity at the end.
//!
//! Every body's inertia is taken about the origin of {0}, so that momenta, composites and their products with twists are plain
//! sums. Gravity needs no recursion: with `A_i = 𝓜_i S_i = [·; l_i]`, its joint force is `g·l_i`, and Algorithm 3's column is
//! `c_i = l_i × g`.

use super::memory::{Batch, END, NODE_OF, Pose, START, Scratch};
use super::{DERIVATIVE, NODES, Plan, WEIGHTS};
use crate::stage_lanes::{
    StageKernel, StageMemory, StageSimd, Stages, Stages3, Stages6, add, bracket, cross, cross_add, dot3,
    dot6, dual_bracket, halves, join, load, mat_mul, mat_vec, row, scale, scale_add, sin_cos, splat, store,
    sub, sym_vec,
};
use crate::tree::{BodyConstants, NO_PARENT};

/// Evaluates nodes and residual; with `full` also the kinematics at the start and the velocity at the end.
pub(crate) struct Evaluate<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a mut Batch<M>,
    pub scratch: &'a mut Scratch<M>,
    pub full: bool,
}

impl<M: StageMemory> StageKernel<M> for Evaluate<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch, full } = self;
        interpolate(simd, plan, batch, scratch);
        for alpha in 0..NODES {
            poses(simd, plan, &batch.nodes[alpha], &mut scratch.poses[alpha]);
        }
        for v in 0..END {
            motion(simd, plan, scratch, v);
        }
        rows(simd, plan, batch, scratch);
        if full {
            keep_start(simd, plan, batch, scratch);
            end_velocity(simd, plan, batch, scratch);
            motion(simd, plan, scratch, END);
        }
    }
}

/// `q̇^α = (1/Δt) Σ_β b^{αβ} (q^β - q^0)`.
#[inline(always)]
fn interpolate<S: StageSimd>(
    simd: S,
    plan: &Plan,
    batch: &Batch<S::Memory>,
    scratch: &mut Scratch<S::Memory>,
) {
    let per_step = Stages::splat(simd, 1.0) / Stages::load(simd, &batch.time_step);
    for i in 0..plan.n {
        let origin = Stages::load(simd, &batch.nodes[0][i]);
        let middle = (Stages::load(simd, &batch.nodes[1][i]) - origin) * per_step;
        let end = (Stages::load(simd, &batch.nodes[2][i]) - origin) * per_step;
        for alpha in 0..NODES {
            let sum = middle.times(DERIVATIVE[alpha][1]) + end.times(DERIVATIVE[alpha][2]);
            scratch.rates[alpha][i] = sum.store();
        }
        scratch.rates[START][i] = batch.start_rate[i];
    }
}

/// Poses, joint twists and inertias of all bodies at one node; composites; `A`.
#[inline(always)]
fn poses<S: StageSimd>(simd: S, plan: &Plan, q: &[S::Memory], poses: &mut [Pose<S::Memory>]) {
    let zero = Stages::splat(simd, 0.0);
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let q = Stages::load(simd, &q[i]);
        let mut e = splat(simd, &constants.e0);
        if constants.revolute {
            let (sine, cosine) = sin_cos(simd, q);
            let versine = Stages::splat(simd, 1.0) - cosine;
            e = scale_add(
                sine,
                splat(simd, &constants.e1),
                scale_add(versine, splat(simd, &constants.e2), e),
            );
        }
        let mut origin = splat(simd, &constants.joint_origin);
        let mut axis = splat(simd, &constants.axis);
        let mut rotation = e;
        if constants.parent != NO_PARENT {
            let parent = &poses[constants.parent];
            let turn = load(simd, &parent.rotation);
            rotation = mat_mul(&turn, &e);
            origin = add(load(simd, &parent.position), mat_vec(&turn, origin));
            axis = mat_vec(&turn, axis);
        }
        let mut position = add(origin, mat_vec(&rotation, splat(simd, &constants.com)));
        let twist = if constants.revolute {
            join(axis, cross(origin, axis))
        } else {
            position = scale_add(q, axis, position);
            join([zero; 3], axis)
        };
        let own = inertia(simd, constants, &rotation, position);
        let pose = &mut poses[i];
        store(&mut pose.rotation, rotation);
        store(&mut pose.position, position);
        store(&mut pose.twist, twist);
        store(&mut pose.own, own);
        store(&mut pose.composite, own);
    }
    for i in (0..plan.n).rev() {
        let constants = &plan.tree.constants()[i];
        let composite = load(simd, &poses[i].composite);
        if constants.parent != NO_PARENT {
            let target = &mut poses[constants.parent].composite;
            store(target, add(load(simd, target), composite));
        }
        let a = times(simd, constants.subtree_mass, &composite, load(simd, &poses[i].twist));
        store(&mut poses[i].a, a);
    }
}

/// `h = m p` and `J = R I Rᵀ - m p^p^` of one body.
#[inline(always)]
fn inertia<S: StageSimd>(
    simd: S,
    constants: &BodyConstants,
    rotation: &[Stages<S>; 9],
    position: Stages3<S>,
) -> [Stages<S>; 9] {
    let i: Stages6<S> = splat(simd, &constants.inertia);
    let full = [i[0], i[3], i[4], i[3], i[1], i[5], i[4], i[5], i[2]];
    let ri = mat_mul(rotation, &full);
    let [x, y, z] = position;
    let [hx, hy, hz] = scale(Stages::splat(simd, constants.mass), position);
    let (r0, r1, r2) = (row(rotation, 0), row(rotation, 1), row(rotation, 2));
    [
        hx,
        hy,
        hz,
        hz.mul_add(z, hy.mul_add(y, dot3(row(&ri, 0), r0))),
        hz.mul_add(z, hx.mul_add(x, dot3(row(&ri, 1), r1))),
        hy.mul_add(y, hx.mul_add(x, dot3(row(&ri, 2), r2))),
        hx.neg_mul_add(y, dot3(row(&ri, 0), r1)),
        hx.neg_mul_add(z, dot3(row(&ri, 0), r2)),
        hy.neg_mul_add(z, dot3(row(&ri, 1), r2)),
    ]
}

/// `𝓜 x = [J s + h×n; m n - h×s]`.
#[inline(always)]
fn times<S: StageSimd>(simd: S, mass: f64, inertia: &[Stages<S>; 9], x: Stages6<S>) -> Stages6<S> {
    let (s, n) = halves(x);
    let [hx, hy, hz, xx, yy, zz, xy, xz, yz] = *inertia;
    let h = [hx, hy, hz];
    let mass = Stages::splat(simd, mass);
    let upper = cross_add(h, n, sym_vec(&[xx, yy, zz, xy, xz, yz], s));
    join(upper, sub(scale(mass, n), cross(h, s)))
}

/// Velocities, articulated momenta and `B` of one motion.
#[inline(always)]
fn motion<S: StageSimd>(simd: S, plan: &Plan, scratch: &mut Scratch<S::Memory>, v: usize) {
    let poses = &scratch.poses[NODE_OF[v]];
    let motions = &mut scratch.motions[v];
    let screws = &mut scratch.screws[v];
    let zero = [Stages::splat(simd, 0.0); 6];
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let twist: Stages6<S> = load(simd, &poses[i].twist);
        let rate = Stages::load(simd, &scratch.rates[v][i]);
        let (carried, twist_rate) = if constants.parent == NO_PARENT {
            (zero, zero)
        } else {
            let carried = load(simd, &motions[constants.parent].velocity);
            // ad_{v_i} S_i = ad_{v_par} S_i, because S_i commutes with itself.
            (carried, bracket(carried, twist))
        };
        let velocity = scale_add(rate, twist, carried);
        let momentum = times(simd, constants.mass, &load(simd, &poses[i].own), velocity);
        let motion = &mut motions[i];
        store(&mut motion.velocity, velocity);
        store(&mut screws[i], both(twist, twist_rate));
        store(&mut motion.momentum, momentum);
    }
    for i in (0..plan.n).rev() {
        let constants = &plan.tree.constants()[i];
        let momentum = load(simd, &motions[i].momentum);
        if constants.parent != NO_PARENT {
            let target = &mut motions[constants.parent].momentum;
            store(target, add(load(simd, target), momentum));
        }
        let (twist, twist_rate) = split(simd, &screws[i]);
        let moved = times(simd, constants.subtree_mass, &load(simd, &poses[i].composite), twist_rate);
        let bracket = dual_bracket(momentum, twist);
        store(&mut motions[i].b, sub(moved, bracket));
    }
}

/// `S` and `Ṡ` side by side.
#[inline(always)]
fn both<S: StageSimd>(twist: Stages6<S>, rate: Stages6<S>) -> [Stages<S>; 12] {
    let ([a, b, c, d, e, f], [g, h, i, j, k, l]) = (twist, rate);
    [a, b, c, d, e, f, g, h, i, j, k, l]
}

/// `S` and `Ṡ` from side by side.
#[inline(always)]
pub(super) fn split<S: StageSimd>(simd: S, screws: &[S::Memory; 12]) -> (Stages6<S>, Stages6<S>) {
    let [a, b, c, d, e, f, g, h, i, j, k, l] = load(simd, screws);
    ([a, b, c, d, e, f], [g, h, i, j, k, l])
}

/// The rows `r^0, r^1` and `p^2`.
#[inline(always)]
fn rows<S: StageSimd>(simd: S, plan: &Plan, batch: &mut Batch<S::Memory>, scratch: &mut Scratch<S::Memory>) {
    let step = Stages::load(simd, &batch.time_step);
    let gravity = splat(simd, &plan.gravity);
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let held = Stages::load(simd, &batch.force[i]);
        let start: Stages6<S> = load(simd, &scratch.motions[START][i].momentum);
        let zero = Stages::splat(simd, 0.0);
        let mut rows = [dot6(load(simd, &scratch.poses[0][i].twist), start), zero, zero];
        for beta in 0..NODES {
            let (pose, motion) = (&scratch.poses[beta][i], &scratch.motions[beta][i]);
            let momentum = load(simd, &motion.momentum);
            let (twist, twist_rate) = split(simd, &scratch.screws[beta][i]);
            let projected = dot6(twist, momentum);
            for alpha in 0..NODES {
                let weight = Stages::splat(simd, WEIGHTS[beta] * DERIVATIVE[beta][alpha]);
                rows[alpha] = projected.mul_add(weight, rows[alpha]);
            }
            let rate = Stages::load(simd, &scratch.rates[beta][i]);
            let stretch = Stages::load(simd, &batch.nodes[beta][i]) - Stages::splat(simd, constants.rest);
            let mut force = Stages::splat(simd, constants.damping).neg_mul_add(rate, held);
            force = Stages::splat(simd, constants.stiffness).neg_mul_add(stretch, force);
            force = force + dot3(halves(load(simd, &pose.a)).1, gravity);
            force = force + dot6(twist_rate, momentum);
            rows[beta] = step.times(WEIGHTS[beta]).mul_add(force, rows[beta]);
        }
        store(&mut batch.residual[i], [rows[0], rows[1]]);
        scratch.end_momentum[i] = rows[2].store();
    }
}

/// Copies what the caller may ask about the start.
#[inline(always)]
fn keep_start<S: StageSimd>(
    simd: S,
    plan: &Plan,
    batch: &mut Batch<S::Memory>,
    scratch: &Scratch<S::Memory>,
) {
    let gravity = splat(simd, &plan.gravity);
    let zero = Stages::splat(simd, 0.0);
    let (mut momentum, mut first_moment) = ([zero; 6], [zero; 3]);
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let (pose, motion) = (&scratch.poses[0][i], &scratch.motions[START][i]);
        if constants.parent == NO_PARENT {
            momentum = add(momentum, load(simd, &motion.momentum));
            let [x, y, z, ..]: [Stages<S>; 9] = load(simd, &pose.composite);
            first_moment = add(first_moment, [x, y, z]);
        }
        let kept = &mut batch.start[i];
        store(&mut kept.rotation, load(simd, &pose.rotation));
        store(&mut kept.position, load(simd, &pose.position));
        store(&mut kept.twist, load(simd, &pose.twist));
        store(&mut kept.velocity, load(simd, &motion.velocity));
        store(&mut kept.by_rate, load(simd, &pose.a));
        store(&mut kept.by_q, load(simd, &motion.b));
        kept.gravity = (-dot3(halves(load(simd, &pose.a)).1, gravity)).store();
    }
    store(&mut batch.momentum, momentum);
    store(&mut batch.first_moment, first_moment);
}

/// Mass matrix at the end, its branch-sparse factor, and `q̇_{k+1} = M⁻¹ p^2`.
#[inline(always)]
fn end_velocity<S: StageSimd>(
    simd: S,
    plan: &Plan,
    batch: &mut Batch<S::Memory>,
    scratch: &mut Scratch<S::Memory>,
) {
    let poses = &scratch.poses[2];
    let (forward, backward) = (&mut scratch.forward, &mut scratch.backward);
    for i in 0..plan.n {
        let a: Stages6<S> = load(simd, &poses[i].a);
        for (place, &j) in plan.tree.branch(i).iter().enumerate() {
            forward[plan.pair(i) + place][6] = dot6(load(simd, &poses[j as usize].twist), a).store();
        }
        batch.pivots[i][3] = forward[plan.own_pair(i)][6];
    }
    let one = Stages::splat(simd, 1.0);
    for i in (0..plan.n).rev() {
        let (first, own) = (plan.pair(i), plan.own_pair(i));
        let pivot = Stages::load(simd, &forward[own][6]);
        let inverse = one / pivot;
        batch.pivots[i][2] = pivot.store();
        backward[own][6] = inverse.store();
        for (place, &a) in plan.ancestors(i).iter().enumerate() {
            let factor = Stages::load(simd, &forward[first + place][6]) * inverse;
            backward[first + place][6] = factor.store();
            let target = plan.pair(a as usize);
            for k in 0..=place {
                let mass = Stages::load(simd, &forward[first + k][6]);
                let cell = &mut forward[target + k][6];
                *cell = factor.neg_mul_add(mass, Stages::load(simd, cell)).store();
            }
        }
    }
    let x = &mut batch.end_rate;
    x.copy_from_slice(&scratch.end_momentum);
    for i in (0..plan.n).rev() {
        let value = Stages::load(simd, &x[i]);
        for (place, &a) in plan.ancestors(i).iter().enumerate() {
            let factor = Stages::load(simd, &backward[plan.pair(i) + place][6]);
            let cell = &mut x[a as usize];
            *cell = factor.neg_mul_add(value, Stages::load(simd, cell)).store();
        }
    }
    for i in 0..plan.n {
        let mut value = Stages::load(simd, &x[i]) * Stages::load(simd, &backward[plan.own_pair(i)][6]);
        for (place, &a) in plan.ancestors(i).iter().enumerate() {
            let factor = Stages::load(simd, &backward[plan.pair(i) + place][6]);
            value = factor.neg_mul_add(Stages::load(simd, &x[a as usize]), value);
        }
        x[i] = value.store();
    }
    scratch.rates[END].copy_from_slice(x);
}
