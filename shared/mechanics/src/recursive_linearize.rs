//! Algorithm B.1 for a whole step: `A` and `B` of a fixed tree in O(s² n) per column, sixteen columns at a time.
//!
//! A column of `[A | B]` is a solve of the Newton matrix whose right-hand side starts at one body `d`, and one row of momenta.
//! Everything such a column needs is an affine response of [`crate::recursive_newton`] once the interface covers the whole step:
//! `ζ` also has `η^0` (node 0 moves with `δq^0`), `y` also has `DΓ^s` (row s needs it). `η^s` acts on row s alone.
//!
//! | letter | size | meaning |
//! |---|---|---|
//! | `c_i^α` | 3 | `w_α Δt` times the angular part of `𝒴_iᵀ S_i`: row α by `η^α`, forces of fixed direction |
//! | `Γ̃_i^α` | 6 | change of the impulse on the parent by `δq_i^α`: `w_α Δt 𝒴_i S_i - ad^D_Γ S_i` |
//! | `K_i^s` | `ni` | row s by `ζ_i`: `C_i^sᵀ Y_i + E_i^s`, as step 3 of B.1 for one more row |
//! | `b_j^0`, `v_j` | `ni`, `no` | what `δq_j^0` adds to `ζ_j`; `v_j = Y_j b_j^0 - P_j^0` |
//!
//! ```text
//! start at body d   q_d:  g = -(W_d b_d^0 + D_d⁻¹ T_d^0),  y0_par += v_d       p_d:  g = -D_d⁻¹ e_0       u_d:  g = -D_d⁻¹ (w_α Δt)_α
//! inward, i <= d    g_i = -D_i⁻¹ (C_iᵀ y0_i + e_0 S_i^0ᵀ Γ̃_d^0)      y0_par += y0_i + U_i g_i
//! outward           x_i = g_i - W_i ζ_par     ζ_i = ζ_par + B_i x_i (+ b_d^0 at d)     η_i^s = η_par^s + s_i^s x_i^s
//!                   δp_i = K_i^s ζ_i + c_i^s·η_i^s + C_i^sᵀ y0_i + T_i^s x_i      (+ direct terms at d)
//! ```
//!
//! Below `d` nothing but `ζ` carries the column, because `η^0` is part of it: the inward sweep runs from `d` to the root only. At
//! s = 2 a column takes 187 multiply-adds per body of a chain. Columns are SIMD lanes; the responses are broadcast.
//!
//! Source: ours; O(n²) for `A`, `B` is announced in the paper, section 3.4, without the solves.

mod column_sweeps;
mod responses;

pub(crate) use column_sweeps::{AllColumns, ColumnSweeps};
pub(crate) use responses::{BodyFactors, Responses};
