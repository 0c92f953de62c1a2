//! Algorithm 2: second derivatives of the kinetic energy, O(Σ depth) per node.
//!
//! | letter | field | meaning (frame {0}, per node) |
//! |---|---|---|
//! | `𝓜_i` | `first_moment`, `rotational` | composite inertia of body i and all it carries: `[J, h^; -h^, m 1]` |
//! | `μ_i` | | articulated momentum, from [`crate::del_residual`] |
//! | `A_i` | `a` | `𝓜_i S_i` |
//! | `B_i` | `b` | `𝓜_i Ṡ_i - ad^D_{μ_i} S_i` |
//!
//! ```text
//! for j in anc(i) + {i}:   K_q̇q̇[i,j] = K_q̇q̇[j,i] = S_jᵀ A_i          K_qq[i,j] = K_qq[j,i] = Ṡ_jᵀ B_i
//!                          ∂²K/∂q̇_i∂q_j = Ṡ_jᵀ A_i                    ∂²K/∂q̇_j∂q_i = S_jᵀ B_i
//! ```
//!
//! Source: the paper, Algorithm 2, with `Ad_{g_i}⁻ᵀ M_i Ad_{g_i}⁻¹` in line 4 (the print lacks the inverse of the first
//! factor).

use crate::del_residual::BodyLanes;
use crate::lanes::{
    Lane, Lane3, Lane6, Lane9, Quad, Simd, cross, cross_add, dual_bracket, halves, join, load, mat_mul,
    scale, splat, sub, sym_vec,
};
use crate::tree::BodyConstants;

/// Composite inertia of a subtree about the origin of {0}; its mass is a constant of the model.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CompositeLanes {
    /// `h = Σ m p`.
    pub first_moment: [Quad; 3],
    /// `J` about the origin: xx, yy, zz, xy, xz, yz.
    pub rotational: [Quad; 6],
}

/// Inertia of one body about the origin of {0}: `J = R I Rᵀ - m p^p^`, `h = m p`.
#[inline(always)]
pub(crate) fn own_inertia<S: Simd>(
    simd: S,
    constants: &BodyConstants,
    body: &BodyLanes,
) -> (Lane3<S>, Lane6<S>) {
    let rotation: Lane9<S> = load(simd, &body.rotation);
    let position: Lane3<S> = load(simd, &body.position);
    let h = scale(Lane::splat(simd, constants.mass), position);
    let i: Lane6<S> = splat(simd, &constants.inertia);
    let full = [i[0], i[3], i[4], i[3], i[1], i[5], i[4], i[5], i[2]];
    let ri = mat_mul(&rotation, &full);
    let row = |m: &Lane9<S>, r: usize| [m[3 * r], m[3 * r + 1], m[3 * r + 2]];
    let entry = |r: usize, c: usize| crate::lanes::dot3(row(&ri, r), row(&rotation, c));
    // -m p^p^ = m (|p|² 1 - p pᵀ)
    let [x, y, z] = position;
    let [hx, hy, hz] = h;
    let (xx, yy, zz) = (hx * x, hy * y, hz * z);
    (
        h,
        [
            entry(0, 0) + yy + zz,
            entry(1, 1) + xx + zz,
            entry(2, 2) + xx + yy,
            hx.neg_mul_add(y, entry(0, 1)),
            hx.neg_mul_add(z, entry(0, 2)),
            hy.neg_mul_add(z, entry(1, 2)),
        ],
    )
}

/// `𝓜 x = [J s + h×n; m n - h×s]`.
#[inline(always)]
pub(crate) fn composite_times<S: Simd>(
    simd: S,
    mass: f64,
    composite: &CompositeLanes,
    x: Lane6<S>,
) -> Lane6<S> {
    let (s, n) = halves(x);
    let h = load(simd, &composite.first_moment);
    let upper = cross_add(h, n, sym_vec(&load(simd, &composite.rotational), s));
    join(upper, sub(scale(Lane::splat(simd, mass), n), cross(h, s)))
}

/// `(A_i, B_i)`.
#[inline(always)]
pub(crate) fn kinetic_columns<S: Simd>(
    simd: S,
    mass: f64,
    composite: &CompositeLanes,
    body: &BodyLanes,
) -> (Lane6<S>, Lane6<S>) {
    let twist: Lane6<S> = load(simd, &body.joint_twist);
    let a = composite_times(simd, mass, composite, twist);
    let carried = composite_times(simd, mass, composite, load(simd, &body.joint_twist_rate));
    (a, sub(carried, dual_bracket(load(simd, &body.momentum), twist)))
}
