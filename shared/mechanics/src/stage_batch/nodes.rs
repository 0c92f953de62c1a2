//! Algorithm 1 of a vector of stages: nodes, both ends, residual, velocity at the end.
//!
//! Every body's inertia is taken about the origin of {0}, so that momenta, composites and their products with twists are plain
//! sums. With the composite inertias `𝓜_i` and `A_i = 𝓜_i S_i = [·; l_i]` known,
//!
//! ```text
//! μ_i = 𝓜_i v_par + Σ_{k = i and beyond} A_k q̇_k        joint force of gravity: g·l_i        column of Algorithm 3: c_i = l_i × g
//! ```
//!
//! because joint k moves all it carries as one body: no momenta of single bodies, no recursion for gravity.

use super::memory::{Batch, END, NODE_OF, START, Scratch};
use super::plan::Plan;
use super::{DERIVATIVE, NODES, WEIGHTS};
use crate::lanes::{
    add, bracket, cross, cross_add, dot3, dot6, dual_bracket, halves, join, mat_mul, mat_vec, row, scale,
    scale_add, sub, sym_vec,
};
use crate::stage_lanes::{
    StageKernel, StageMemory, StageSimd, Stages, Stages3, Stages6, load, sin_cos, splat, store,
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
        for alpha in (0..NODES).rev() {
            poses(simd, plan, &batch.nodes[alpha], scratch, alpha);
        }
        for v in 0..END {
            motion(simd, plan, batch, scratch, v);
        }
        for (i, rows) in scratch.rows.iter().enumerate() {
            let [first, middle, end] = load(simd, rows);
            store(&mut batch.residual[i], [first, middle]);
            scratch.end_momentum[i] = end.store();
        }
        if full {
            keep_start(simd, plan, batch, scratch);
            end_velocity(simd, plan, batch, scratch);
            motion(simd, plan, batch, scratch, END);
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
        store(&mut scratch.rows[i], [Stages::splat(simd, 0.0); NODES]);
    }
}

/// Poses, joint twists and inertias of all bodies at one node; composites; `A`.
#[inline(always)]
fn poses<S: StageSimd>(
    simd: S,
    plan: &Plan,
    q: &[S::Memory],
    scratch: &mut Scratch<S::Memory>,
    alpha: usize,
) {
    let Scratch { rotations, positions, composites, twists, a, .. } = scratch;
    let (composites, twists, a) = (&mut composites[alpha], &mut twists[alpha], &mut a[alpha]);
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
            let turn = load(simd, &rotations[constants.parent]);
            rotation = mat_mul(&turn, &e);
            origin = add(load(simd, &positions[constants.parent]), mat_vec(&turn, origin));
            axis = mat_vec(&turn, axis);
        }
        let mut position = add(origin, mat_vec(&rotation, splat(simd, &constants.com)));
        let twist = if constants.revolute {
            join(axis, cross(origin, axis))
        } else {
            position = scale_add(q, axis, position);
            join([zero; 3], axis)
        };
        store(&mut composites[i], inertia(simd, constants, &rotation, position));
        store(&mut rotations[i], rotation);
        store(&mut positions[i], position);
        store(&mut twists[i], twist);
    }
    for i in (0..plan.n).rev() {
        let constants = &plan.tree.constants()[i];
        let composite = load(simd, &composites[i]);
        if constants.parent != NO_PARENT {
            let target = &mut composites[constants.parent];
            store(target, add(load(simd, target), composite));
        }
        store(&mut a[i], times(simd, constants.subtree_mass, &composite, load(simd, &twists[i])));
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

/// Velocities, `Ṡ`, `B` and the rows of one motion.
#[inline(always)]
fn motion<S: StageSimd>(
    simd: S,
    plan: &Plan,
    batch: &Batch<S::Memory>,
    scratch: &mut Scratch<S::Memory>,
    v: usize,
) {
    let node = NODE_OF[v];
    let Scratch { composites, twists, a, rates, twist_rates, b, velocities, momenta, rows, .. } = scratch;
    let (composites, twists, a, rates) = (&composites[node], &twists[node], &a[node], &rates[v]);
    let (twist_rates, b) = (&mut twist_rates[v], &mut b[v]);
    let zero = Stages::splat(simd, 0.0);
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let twist: Stages6<S> = load(simd, &twists[i]);
        let rate = Stages::load(simd, &rates[i]);
        let (carried, twist_rate) = if constants.parent == NO_PARENT {
            ([zero; 6], [zero; 6])
        } else {
            let carried = load(simd, &velocities[constants.parent]);
            // ad_{v_i} S_i = ad_{v_par} S_i, because S_i commutes with itself.
            (carried, bracket(carried, twist))
        };
        store(&mut velocities[i], scale_add(rate, twist, carried));
        store(&mut twist_rates[i], twist_rate);
        store(&mut momenta[i], scale(rate, load(simd, &a[i])));
    }
    let step = Stages::load(simd, &batch.time_step);
    let gravity = splat(simd, &plan.gravity);
    for i in (0..plan.n).rev() {
        let constants = &plan.tree.constants()[i];
        let mut momentum: Stages6<S> = load(simd, &momenta[i]);
        let (twist, twist_rate): (Stages6<S>, Stages6<S>) =
            (load(simd, &twists[i]), load(simd, &twist_rates[i]));
        let mut moved = [zero; 6];
        if constants.parent != NO_PARENT {
            let target = &mut momenta[constants.parent];
            store(target, add(load(simd, target), momentum));
            let composite = load(simd, &composites[i]);
            let carried = load(simd, &velocities[constants.parent]);
            momentum = add(momentum, times(simd, constants.subtree_mass, &composite, carried));
            moved = times(simd, constants.subtree_mass, &composite, twist_rate);
        }
        store(&mut b[i], sub(moved, dual_bracket(momentum, twist)));
        let projected = dot6(twist, momentum);
        let row = &mut rows[i];
        if v < NODES {
            for alpha in 0..NODES {
                let weight = Stages::splat(simd, WEIGHTS[v] * DERIVATIVE[v][alpha]);
                row[alpha] = projected.mul_add(weight, Stages::load(simd, &row[alpha])).store();
            }
            let stretch = Stages::load(simd, &batch.nodes[v][i]) - Stages::splat(simd, constants.rest);
            let mut force = Stages::load(simd, &batch.force[i]);
            force = Stages::splat(simd, constants.damping).neg_mul_add(Stages::load(simd, &rates[i]), force);
            force = Stages::splat(simd, constants.stiffness).neg_mul_add(stretch, force);
            force = force + dot3(halves(load(simd, &a[i])).1, gravity) + dot6(twist_rate, momentum);
            row[v] = step.times(WEIGHTS[v]).mul_add(force, Stages::load(simd, &row[v])).store();
        } else if v == START {
            row[0] = (Stages::load(simd, &row[0]) + projected).store();
        }
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
        if constants.parent == NO_PARENT {
            momentum = add(momentum, load(simd, &scratch.momenta[i]));
            let [x, y, z, ..]: [Stages<S>; 9] = load(simd, &scratch.composites[0][i]);
            first_moment = add(first_moment, [x, y, z]);
        }
        let a = load(simd, &scratch.a[0][i]);
        let kept = &mut batch.start[i];
        store(&mut kept.rotation, load(simd, &scratch.rotations[i]));
        store(&mut kept.position, load(simd, &scratch.positions[i]));
        store(&mut kept.twist, load(simd, &scratch.twists[0][i]));
        store(&mut kept.velocity, load(simd, &scratch.velocities[i]));
        store(&mut kept.by_rate, a);
        store(&mut kept.by_q, load(simd, &scratch.b[START][i]));
        kept.gravity = (-dot3(halves(a).1, gravity)).store();
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
    let (twists, columns) = (&scratch.twists[2], &scratch.a[2]);
    let (forward, backward) = (&mut scratch.forward, &mut scratch.backward);
    for i in 0..plan.n {
        let a: Stages6<S> = load(simd, &columns[i]);
        for (place, &j) in plan.tree.branch(i).iter().enumerate() {
            forward[plan.pair(i) + place][6] = dot6(load(simd, &twists[j as usize]), a).store();
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
