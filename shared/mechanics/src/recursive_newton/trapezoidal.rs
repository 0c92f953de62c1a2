//! Steps 1 to 7 of Algorithm B.1 for one unknown node, the trapezoidal rule; letters as in [`super`].
//!
//! With `s = 1` there is no `η` and no `DΓ` (node 0 is given, node 1 acts only on row s), so that `ζ = (ν^0, ν^1)`, `y = (Dμ^0, Dμ^1)` and every
//! `Y_i` is 12 x 12. The interface has the components outermost: a quad holds two components at both nodes, which is what
//! two quads of Algorithm 1 have in their low halves. `Y_i` is read and written once for steps 1, 3 and 5, and once for step 7:
//!
//! ```text
//! Y_i = Σ_chd Ŷ_j + diag(M_i^0, M_i^1)      K_i = C_iᵀ Y_i + E_i,  Y_i B_i      row by row
//! D_i = K_i B_i + T_i,   W_i = K_i / D_i,   U_i = Y_i B_i - P_i
//! Ŷ_i = Y_i - U_i W_i                                                             row by row
//! ```

use super::RecursiveNewton;
use super::elimination::two_slots;
use crate::del_residual::{BodyLanes, DelWorkspace};
use crate::errors::FactorError;
use crate::kinetic_hessian::own_inertia;
use crate::lanes::{Lane, Lane6, Quad, Simd, dual_bracket, load};
use crate::small_inverse::invert;
use crate::tree::{BodyConstants, KinematicTree, NO_PARENT};

/// Rows of `Y`: six components at two nodes.
const ROWS: usize = 12;
/// Quads of a row.
const QUADS: usize = 3;
const SIZE: usize = ROWS * QUADS;

/// What a joint brings to its elimination, rows of the interface.
struct Joint<S: Simd> {
    /// `Bᵀ`, `Cᵀ`.
    b: [Lane<S>; QUADS],
    c: [Quad; QUADS],
    /// `E`, `Pᵀ`.
    e: [Lane<S>; QUADS],
    p: [Lane<S>; QUADS],
}

/// Bodies from the leaves to the root; the base of a floating tree only collects.
///
/// # Errors
/// [`FactorError::SingularPivot`].
#[inline(always)]
pub(super) fn factor<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
) -> Result<(), FactorError> {
    work.has_child.fill(false);
    for i in (0..tree.body_count()).rev() {
        let (constants, body) = (&tree.constants()[i], &del.bodies[i]);
        let own = own_rows(simd, constants, body);
        let start = work.slot_of[i] * SIZE;
        let y = &mut work.slots[start..start + SIZE];
        if !work.has_child[i] {
            y.fill(Quad::ZERO);
        }
        if tree.is_base(i) {
            add_own(simd, &own, y);
            continue;
        }
        let joint = joint_rows(simd, del, body);
        let (k, products) = add_own_and_multiply(simd, &own, &joint, y);

        let [k0, k1, k2] = core::array::from_fn(|q| k[q] + joint.e[q]);
        let [b0, b1, b2] = joint.b;
        let damping = constants.damping * del.rule.derivative(0, 1) / del.time_step;
        let product = k0.mul_add(b0, k1.mul_add(b1, k2 * b2)).total().first();
        let pivot = product - del.rule.weights()[0] * del.time_step * damping;
        let [[inverse]] =
            invert([[pivot]], 1).map_err(|pivot| FactorError::SingularPivot { body: i, pivot })?;
        let scale = Lane::splat(simd, inverse);
        let w = [k0 * scale, k1 * scale, k2 * scale];
        let mut u = [Quad::ZERO; QUADS];
        for q in 0..QUADS {
            u[q] = (products[q] - joint.p[q]).quad();
            work.w[i * QUADS + q] = w[q].quad();
            work.b[i * QUADS + q] = joint.b[q].quad();
        }
        work.c[i * QUADS..(i + 1) * QUADS].copy_from_slice(&joint.c);
        work.u[i * QUADS..(i + 1) * QUADS].copy_from_slice(&u);
        work.pivots[i] = inverse;

        if constants.parent != NO_PARENT {
            let to = work.slot_of[constants.parent] * SIZE;
            let (from, to) = two_slots(&mut work.slots, start, to);
            let (from, to) = (&from[..SIZE], &mut to[..SIZE]);
            if core::mem::replace(&mut work.has_child[constants.parent], true) {
                pass_up::<S, true>(simd, from, &u, &w, to);
            } else {
                pass_up::<S, false>(simd, from, &u, &w, to);
            }
        }
    }
    Ok(())
}

/// `Bᵀ, Cᵀ, E, Pᵀ` of a joint.
#[inline(always)]
fn joint_rows<S: Simd>(simd: S, del: &DelWorkspace, body: &BodyLanes) -> Joint<S> {
    let lanes = |first: f64, last: f64| Lane::load(simd, &Quad([first, last, 0.0, 0.0]));
    let rule = &del.rule;
    let step = rule.weights()[0] * del.time_step;
    let slopes = lanes(rule.derivative(0, 1) / del.time_step, rule.derivative(1, 1) / del.time_step);
    let factors = lanes(rule.weighted_derivative(0, 0), rule.weighted_derivative(0, 1));
    let (at_end, start_step) = (lanes(0.0, 1.0), lanes(step, 0.0));

    let twist: Lane6<S> = load(simd, &body.joint_twist);
    let rate: Lane6<S> = load(simd, &body.joint_twist_rate);
    let turned = dual_bracket(load(simd, &body.momentum), twist);
    let zero = Lane::splat(simd, 0.0);
    let mut b = twist;
    let mut c = twist;
    let mut e = twist;
    let mut p = twist;
    for k in 0..6 {
        b[k] = slopes.mul_add(twist[k], at_end * rate[k]);
        c[k] = factors.mul_add(twist[k], start_step * rate[k]);
        e[k] = start_step.neg_mul_add(turned[k], zero);
        p[k] = at_end * turned[k];
    }
    Joint { b: pairs(b), c: pairs(c).map(Lane::quad), e: pairs(e), p: pairs(p) }
}

/// Six components in lanes of nodes as a row of the interface.
#[inline(always)]
fn pairs<S: Simd>([a, b, c, d, e, f]: Lane6<S>) -> [Lane<S>; QUADS] {
    [a.low_halves(b), c.low_halves(d), e.low_halves(f)]
}

/// `M_i` at both nodes: entry `[r][q]` has `M[r][2q]` and `M[r][2q+1]`, both nodes of each.
#[inline(always)]
fn own_rows<S: Simd>(simd: S, constants: &BodyConstants, body: &BodyLanes) -> [[Lane<S>; QUADS]; 6] {
    let ([hx, hy, hz], [xx, yy, zz, xy, xz, yz]) = own_inertia(simd, constants, body);
    let (o, m) = (Lane::splat(simd, 0.0), Lane::splat(simd, constants.mass));
    let rows = [
        [xx, xy, xz, o, -hz, hy],
        [xy, yy, yz, hz, o, -hx],
        [xz, yz, zz, -hy, hx, o],
        [o, hz, -hy, m, o, o],
        [-hz, o, hx, o, m, o],
        [hy, -hx, o, o, o, m],
    ];
    rows.map(pairs)
}

/// Lanes of node 0 and of node 1 in a pair of components.
#[inline(always)]
fn node_masks<S: Simd>(simd: S) -> [Lane<S>; 2] {
    [Lane::load(simd, &Quad([1.0, 0.0, 1.0, 0.0])), Lane::load(simd, &Quad([0.0, 1.0, 0.0, 1.0]))]
}

/// Step 1 alone.
#[inline(always)]
fn add_own<S: Simd>(simd: S, own: &[[Lane<S>; QUADS]; 6], y: &mut [Quad]) {
    let masks = node_masks(simd);
    for (pair, own) in y.chunks_exact_mut(2 * QUADS).zip(own) {
        for (row, mask) in pair.chunks_exact_mut(QUADS).zip(masks) {
            for (y, own) in row.iter_mut().zip(own) {
                *y = own.mul_add(mask, Lane::load(simd, y)).quad();
            }
        }
    }
}

/// Step 1; returns `C_iᵀ Y_i` and `Y_i B_i`.
#[inline(always)]
fn add_own_and_multiply<S: Simd>(
    simd: S,
    own: &[[Lane<S>; QUADS]; 6],
    joint: &Joint<S>,
    y: &mut [Quad],
) -> ([Lane<S>; QUADS], [Lane<S>; QUADS]) {
    let zero = Lane::splat(simd, 0.0);
    let masks = node_masks(simd);
    // One sum for each node: two independent chains of multiply-adds.
    let mut sums = [[zero; QUADS]; 2];
    let mut products = [zero; QUADS];
    for q in 0..QUADS {
        let mut rows = [zero; 4];
        for r in 0..4 {
            let (component, node) = (2 * q + r / 2, r % 2);
            let c = Lane::splat(simd, joint.c[q].0[r]);
            let at = (4 * q + r) * QUADS;
            let mut row = [zero; QUADS];
            for j in 0..QUADS {
                row[j] = own[component][j].mul_add(masks[node], Lane::load(simd, &y[at + j]));
                y[at + j] = row[j].quad();
                sums[node][j] = c.mul_add(row[j], sums[node][j]);
            }
            rows[r] = row[0].mul_add(joint.b[0], row[1].mul_add(joint.b[1], row[2] * joint.b[2]));
        }
        products[q] = Lane::sums(rows);
    }
    let [first, last] = sums;
    ([first[0] + last[0], first[1] + last[1], first[2] + last[2]], products)
}

/// Step 7; the first child of its parent (`ADD` false) overwrites what an earlier use has left.
#[inline(always)]
fn pass_up<S: Simd, const ADD: bool>(
    simd: S,
    from: &[Quad],
    u: &[Quad; QUADS],
    w: &[Lane<S>; QUADS],
    to: &mut [Quad],
) {
    for r in 0..ROWS {
        let u = Lane::splat(simd, u[r / 4].0[r % 4]);
        for q in 0..QUADS {
            let at = r * QUADS + q;
            let mut sum = u.neg_mul_add(w[q], Lane::load(simd, &from[at]));
            if ADD {
                sum = sum + Lane::load(simd, &to[at]);
            }
            to[at] = sum.quad();
        }
    }
}
