//! Step 1 of Algorithm B.1: what a body answers by itself, `M_i` and the gains `F_η`, `F_ν` of its wrenches.

use super::{Interface, RecursiveNewton};
use crate::del_residual::{DelWorkspace, load_arm};
use crate::kinetic_hessian::own_inertia;
use crate::lanes::{LANES, Lane, Lane3, Simd, dot3, load, outer, splat, store};
use crate::tree::KinematicTree;

/// Step 1: the body's own inertia and wrench gains, added to what its children have left in its slot.
#[inline(always)]
pub(super) fn own_response<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    i: usize,
    shape: &Interface,
) {
    let constants = &tree.constants()[i];
    let groups = del.groups;
    let gravity: [f64; 3] = (*tree.gravity_w()).into();
    let stride = shape.inputs().div_ceil(LANES);
    let size = shape.outputs() * stride;
    let start = work.slot_of[i] * size;
    let y = &mut work.slots[start..start + size];
    let mut put = |row: usize, column: usize, value: f64| {
        y[row * stride + column / LANES].0[column % LANES] += value;
    };
    for g in 0..groups {
        let body = &del.bodies[i * groups + g];
        let (h, j) = own_inertia(simd, constants, body);
        let (h, j) = (store(h), store(j));
        let weight: Lane3<S> = splat(simd, &gravity.map(|x| x * constants.mass));
        let gain = store(arm_cross_force(load(simd, &body.position), weight));
        for lane in 0..LANES {
            let alpha = g * LANES + lane;
            if alpha > shape.s {
                break;
            }
            let h = h.map(|q| q.0[lane]);
            let j = j.map(|q| q.0[lane]);
            let inertia = [[j[0], j[3], j[4]], [j[3], j[1], j[5]], [j[4], j[5], j[2]]];
            let cross = [[0.0, -h[2], h[1]], [h[2], 0.0, -h[0]], [-h[1], h[0], 0.0]];
            let mut own = |r: usize, c: usize, value: f64| {
                put(shape.momentum_at(alpha, r), shape.nu_at(alpha, c), value)
            };
            for r in 0..3 {
                for c in 0..3 {
                    own(r, c, inertia[r][c]);
                    if r != c {
                        own(r, 3 + c, cross[r][c]);
                        own(3 + r, c, -cross[r][c]);
                    }
                }
                own(3 + r, 3 + r, constants.mass);
            }
            if alpha >= 1 && alpha < shape.s {
                let step = del.weights[g].0[lane];
                let f = gravity.map(|x| x * constants.mass * step);
                put_dead_load(&mut put, shape, alpha, gain.map(|q| q.0[lane] * step), f);
            }
        }
    }
    for (index, dead) in del.loads.iter().enumerate().filter(|(_, dead)| dead.body == i) {
        for g in 0..groups {
            let (force, arm) =
                load_arm(simd, dead, &del.load_forces[index * groups + g], &del.bodies[i * groups + g]);
            let (gain, force) = (store(arm_cross_force(arm, force)), store(force));
            for lane in 0..LANES {
                let alpha = g * LANES + lane;
                if alpha >= 1 && alpha < shape.s {
                    let step = del.weights[g].0[lane];
                    let f = if dead.couple { [0.0; 3] } else { force.map(|q| q.0[lane] * step) };
                    put_dead_load(&mut put, shape, alpha, gain.map(|q| q.0[lane] * step), f);
                }
            }
        }
    }
    if del.gains.is_empty() {
        return;
    }
    for alpha in 0..shape.s {
        let (g, lane) = (alpha / LANES, alpha % LANES);
        let gain = &del.gains[i * groups + g];
        let step = del.weights[g].0[lane];
        for r in 0..6 {
            for c in 0..6 {
                let at = 6 * r + c;
                put(shape.impulse_at(alpha) + r, shape.nu_at(alpha, c), step * gain.nu[at].0[lane]);
                if alpha >= 1 {
                    put(shape.impulse_at(alpha) + r, shape.eta_at(alpha) + c, step * gain.eta[at].0[lane]);
                }
            }
        }
    }
}

/// `x^ f^` of an arm and a force, row-major.
#[inline(always)]
pub(crate) fn arm_cross_force<S: Simd>(arm: Lane3<S>, force: Lane3<S>) -> [Lane<S>; 9] {
    let along = dot3(arm, force);
    let mut product = outer(force, arm);
    for k in 0..3 {
        product[4 * k] = product[4 * k] - along;
    }
    product
}

/// `F_η η = [A η_ω; f×η_ω]` in the block `(DΓ^α, η^α)`.
#[inline(always)]
fn put_dead_load(
    put: &mut impl FnMut(usize, usize, f64),
    shape: &Interface,
    alpha: usize,
    gain: [f64; 9],
    f: [f64; 3],
) {
    let (row, column) = (shape.impulse_at(alpha), shape.eta_at(alpha));
    let cross = [0.0, -f[2], f[1], f[2], 0.0, -f[0], -f[1], f[0], 0.0];
    for r in 0..3 {
        for c in 0..3 {
            put(row + r, column + c, gain[3 * r + c]);
            if r != c {
                put(row + 3 + r, column + c, cross[3 * r + c]);
            }
        }
    }
}
