//! Algorithm 3: second derivatives of the gravitational potential, O(Σ depth) per node.
//!
//! | letter | meaning (frame {0}, per node) |
//! |---|---|
//! | `σm_i`, `σp_i` | mass and first moment `Σ m p` of body i and all it carries |
//! | `s_i`, `n_i` | angular and linear part of the joint twist `S_i` |
//! | `σA_i` | `g^(σm_i n_i - σp_i^ s_i)` |
//!
//! ```text
//! V_g = -Σ m g·p        ∂²V_g/∂q_i∂q_j = s_jᵀ σA_i        for j in anc(i) + {i}
//! ```
//!
//! The same form covers every force whose direction is fixed in {0}: with the composite gain
//! `F_η η = [A η_ω; f×η_ω]` of a subtree, `∂(S_iᵀ F)/∂q_j = s_jᵀ (Aᵀ s_i - f×n_i)`; gravity has `A = σp^ g^`, `f = σm g`.
//!
//! Source: the paper, Algorithm 3, with the angular part `s_jᵀ` in line 10 (the print has the whole twist).

use crate::lanes::{Lane, Lane3, Lane6, Simd, cross, halves, scale, splat, sub};

/// `-σA_i`, the gravity part of `∂τ_i/∂q = s_jᵀ(...)`.
#[inline(always)]
pub(crate) fn gravity_column<S: Simd>(
    simd: S,
    gravity: &[f64; 3],
    subtree_mass: f64,
    first_moment: Lane3<S>,
    twist: Lane6<S>,
) -> Lane3<S> {
    let (s, n) = halves(twist);
    let moved = sub(scale(Lane::splat(simd, subtree_mass), n), cross(first_moment, s));
    cross(moved, splat(simd, gravity))
}
