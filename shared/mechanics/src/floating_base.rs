//! The chart-free floating base: all six momenta exact, no singularity, order `2s`.
//!
//! Body 0 is the base; bodies 1.. hang on it by joints with one coordinate. The paper suggests six virtual joints instead;
//! their Euler angles are singular and conserve angular momentum only to `O(Δt^{2s})`. Here the base moves in a chart that
//! is centred in every step at the step's own mid pose, which makes the discrete Lagrangian left invariant under SE(3):
//! the total spatial momentum `P` is a state variable and is conserved to the last bit when no external wrench acts.
//!
//! | letter | meaning |
//! |---|---|
//! | `R^α, p^α` | orientation and mass centre of the base at node α |
//! | `ξ = (ω; x)` | chart coordinates of the base, a polynomial of degree s through `ξ^0..ξ^s` |
//! | `R_b, p_b` | chart centre |
//! | `P = [angular about the origin of {0}; linear]` | total spatial momentum, state |
//! | `S, Ṡ` | 6 x 6 motion subspace of the base in {0} and its rate |
//! | `W` | right-invariant differential of `exp`: the angular velocity is `R_b W ω̇` |
//!
//! # Construction
//!
//! ```text
//! R^α = R_b exp(ω^α^)     p^α = p_b + R_b x^α
//! mid-centred: ξ^0 := -ξ^s,  R_b = R^0 exp(ω^s^),  p_b = p^0 + R_b x^s     (node 0 is exactly the given pose; unknowns ξ^1..ξ^s)
//! ```
//!
//! The definition is unchanged when the step is read backwards (`ξ^α → ξ^{s-α}`), so the method is self-adjoint. With `q̂ = |ω|²`
//! and the entire series (no trigonometry, no small-angle branch)
//!
//! ```text
//! a = Σ(-q̂)^k/(2k+1)!   b = Σ(-q̂)^k/(2k+2)!   c = Σ(-q̂)^k/(2k+3)!   ' = d/dq̂
//! exp ω^ = 1 + a ω^ + b ω^ω^     W = a 1 + b ω^ + c ωωᵀ     Ẇ = 2(ω·ω̇) W' + b ω̇^ + c(ω̇ωᵀ + ωω̇ᵀ)
//! Z = R_b W:   S = [Z 0; p^Z R_b]     Ṡ = [Ż 0; ṗ^Z + p^Ż  0]     v = S ξ̇ = [Z ω̇; p×(Z ω̇) + R_b ẋ]
//! ```
//!
//! (`Ṡ` is *not* `ad_v S`.)
//!
//! # Rows
//!
//! Free variations are a rigid shift `η̄` of the chart centre (the same twist at every node, `ν = 0`: the exact symmetry) and
//! `δξ^α`. With the raw rows of Algorithm 1, `R^α = w_α Δt Ṡᵀμ + SᵀΓ + Σ_β a^{αβ} S^βᵀμ^β` (6 each),
//! `δL_d = (Σ_α Γ^α)ᵀ η̄ + Σ_α R^αᵀ δξ^α`, where `η^0 = η̄ - S^0 δξ^s` and `η^s = η̄ + S^s δξ^s`. Eliminating `η̄` gives
//! both discrete Legendre transforms:
//!
//! ```text
//! P^1 = P^0 + Σ_{α=0..s} Γ^α                                                    (Γ: total external impulse at a node)
//! r^0 = S^0ᵀP^0 + R^0 + S^sᵀG - R^s|without Γ      G = P^0 + Σ_{α<s} Γ^α        (SᵀΓ of node s cancels)
//! r^α = R^α,  α = 1..s-1                            joint rows: Algorithm 1, unchanged
//! ```
//!
//! # Second-order terms
//!
//! For a wrench or momentum `X` at a node let `n = R_bᵀ(τ - p×f)` and `m_f = R_bᵀ f`, `ṅ = m_f×ẋ`. `S(ξ)` obeys the
//! Maurer-Cartan equation, so the variations of `SᵀX` and `Ṡᵀμ` get two extra matrices with 3 non-zero columns (those of `δω`):
//!
//! ```text
//! N(X)  = [ 2ω(W'ᵀn)ᵀ - b n^ + c(nωᵀ + (n·ω)1) ;  -m_f^ W ]                     δ(SᵀX)  = Sᵀ DX + N(X) δξ
//! Ṅ(X)  = [ 2ω̇(W'ᵀn)ᵀ + 2ω(Ẇ'ᵀn + W'ᵀṅ)ᵀ - ḃ n^ - b ṅ^ + ċ(nωᵀ + (n·ω)1) + c(ṅωᵀ + nω̇ᵀ + (ṅ·ω + n·ω̇)1) ;  -m_f^ Ẇ ]
//!                                                 δ(Ṡᵀμ) = Sᵀ ad^D_μ ν + Ṡᵀ Dμ + Ṅ(μ) δξ + N(μ) δξ̇
//! test: N(X)ᵀ - N(X) = Sᵀ ad^D_X S  (Maurer-Cartan, as 6 x 6 matrices)
//! ```
//!
//! # Newton's method
//!
//! The rows are components of a wrench along the axes of the chart, about its origin: `r = (n; m)`, `m = R_bᵀ f`,
//! `n = R_bᵀ(τ - p_b×f)`. The chart moves with the unknowns `ξ^s`, by `δω` and, in its axes, by `δω×x^s + δx^s`; under a wrench `(τ, f)`
//! held in {0} the rows change by
//!
//! ```text
//! K(r) δξ^s = (n×δω + m×(δω×x^s + δx^s);  m×δω)                  K = [ n^ - m^x^   m^ ;  m^   0 ]
//! ```
//!
//! That part of `J` is what is left of the residual; at the solution it is zero. With `J - K(r)` in the base columns of `ξ^s`, Newton's
//! method solves for the wrench in {0}, where its equations are nearly linear: the second change falls to a fiftieth (from `10` to `0.2`
//! times the square of the first, free-floating Atlas, s = 1). The unknown `x^α` has a like remedy in [`crate::step`].
//!
//! Limits: the rotation of one step must stay below a half turn each way (`|ω^s| <= π/2` is enforced); put {0} near the robot,
//! because `P` is about the origin of {0} and its rounding error grows with the distance.
//!
//! Derivation: ours, from the discrete Lagrangian; related to left-invariant Lie-group Galerkin integrators
//! (M. Leok, T. Shingel, *General techniques for constructing variational integrators*, 2012).

use crate::lanes::{
    Lane, Lane3, Lane6, Lane9, Quad, Simd, add, cross, cross_add, dot3, halves, join, load, mat_mul,
    mat_tr_vec, mat_vec, outer, scale, scale_add, splat, store,
};

/// Largest chart rotation `|ω^s|` accepted for a step, rad: half of the rotation of the step.
pub(crate) const MAX_HALF_ROTATION: f64 = core::f64::consts::FRAC_PI_2;

/// Terms of the series; exact to round-off for `|ω| <= π`.
const TERMS: usize = 15;

/// `[a, b, c]` series coefficients, lowest power of `q̂` first.
const SERIES: [[f64; TERMS]; 3] = {
    let mut table = [[0.0; TERMS]; 3];
    let mut row = 0;
    while row < 3 {
        // 1/(row+1)!, then divide by the next two factors and change the sign.
        let mut value = 1.0;
        let mut k = 2;
        while k <= row + 1 {
            value /= k as f64;
            k += 1;
        }
        let mut term = 0;
        while term < TERMS {
            table[row][term] = value;
            value = -value / ((2 * term + row + 2) as f64 * (2 * term + row + 3) as f64);
            term += 1;
        }
        row += 1;
    }
    table
};

/// The base at all nodes of one lane group.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct BaseLanes {
    /// `Z = R_b W`, row-major.
    pub z: [Quad; 9],
    /// `Ż = R_b Ẇ`.
    pub z_dot: [Quad; 9],
    /// `R_b`, the same in every lane.
    pub center: [Quad; 9],
    /// Mass centre `p` of the base.
    pub position: [Quad; 3],
    /// `ṗ = R_b ẋ`.
    pub position_dot: [Quad; 3],
    /// `ω, x` of the chart.
    pub xi: [Quad; 6],
    /// Their rates.
    pub xi_dot: [Quad; 6],
    /// `W` and `Ẇ`, row-major.
    pub w: [Quad; 9],
    pub w_dot: [Quad; 9],
    /// `a, b, c`, their first and second derivatives by `q̂`.
    pub series: [[Quad; 3]; 3],
}

/// `(S x)` of the base for a 6-vector `x` of chart coordinates.
#[inline(always)]
pub(crate) fn base_twist<S: Simd>(simd: S, base: &BaseLanes, x: Lane6<S>) -> Lane6<S> {
    let (omega, linear) = halves(x);
    let angular = mat_vec(&load(simd, &base.z), omega);
    let velocity = mat_vec(&load(simd, &base.center), linear);
    join(angular, cross_add(load(simd, &base.position), angular, velocity))
}

/// `(Ṡ x)` of the base.
#[inline(always)]
pub(crate) fn base_twist_rate<S: Simd>(simd: S, base: &BaseLanes, x: Lane6<S>) -> Lane6<S> {
    let (omega, _) = halves(x);
    let z_omega = mat_vec(&load(simd, &base.z), omega);
    let angular = mat_vec(&load(simd, &base.z_dot), omega);
    let moved = cross(load(simd, &base.position_dot), z_omega);
    join(angular, cross_add(load(simd, &base.position), angular, moved))
}

/// `Sᵀ X` of the base.
#[inline(always)]
pub(crate) fn base_project<S: Simd>(simd: S, base: &BaseLanes, wrench: Lane6<S>) -> Lane6<S> {
    let (torque, force) = halves(wrench);
    let central = crate::lanes::sub(torque, cross(load(simd, &base.position), force));
    join(mat_tr_vec(&load(simd, &base.z), central), mat_tr_vec(&load(simd, &base.center), force))
}

/// `Ṡᵀ X` of the base (its lower half is zero).
#[inline(always)]
pub(crate) fn base_project_rate<S: Simd>(simd: S, base: &BaseLanes, wrench: Lane6<S>) -> Lane3<S> {
    let (torque, force) = halves(wrench);
    let central = crate::lanes::sub(torque, cross(load(simd, &base.position), force));
    let moved = cross(load(simd, &base.position_dot), force);
    crate::lanes::sub(mat_tr_vec(&load(simd, &base.z_dot), central), mat_tr_vec(&load(simd, &base.z), moved))
}

/// `Sᵀ X` and the upper half of `Ṡᵀ X` of the base.
#[inline(always)]
pub(crate) fn base_project_both<S: Simd>(
    simd: S,
    base: &BaseLanes,
    wrench: Lane6<S>,
) -> (Lane6<S>, Lane3<S>) {
    let (torque, force) = halves(wrench);
    let central = crate::lanes::sub(torque, cross(load(simd, &base.position), force));
    let moved = cross(load(simd, &base.position_dot), force);
    let z = load(simd, &base.z);
    let rate = crate::lanes::sub(mat_tr_vec(&load(simd, &base.z_dot), central), mat_tr_vec(&z, moved));
    (join(mat_tr_vec(&z, central), mat_tr_vec(&load(simd, &base.center), force)), rate)
}

/// Fills `base` from chart coordinates and their rates around the chart centre; returns `(R, p, v)` of the base at the nodes.
#[inline(always)]
pub(crate) fn base_kinematics<S: Simd>(
    simd: S,
    xi: [Quad; 6],
    xi_dot: [Quad; 6],
    center_rotation: &[f64; 9],
    center_position: &[f64; 3],
    base: &mut BaseLanes,
) -> (Lane9<S>, Lane3<S>, Lane6<S>) {
    let center = splat(simd, center_rotation);
    let (omega, x) = halves(load(simd, &xi));
    let (omega_dot, x_dot) = halves(load(simd, &xi_dot));
    let q_hat = dot3(omega, omega);
    let q_hat_dot = dot3(omega, omega_dot);
    let q_hat_dot = q_hat_dot + q_hat_dot;
    let series = series_lanes(simd, q_hat);
    let [[a, b, c], first, _] = series;
    let w = w_matrix(a, b, c, omega);
    let mut w_dot = scale(q_hat_dot, w_matrix(first[0], first[1], first[2], omega));
    add_skew(&mut w_dot, b, omega_dot);
    let outer_rate = add(outer(omega_dot, omega), outer(omega, omega_dot));
    w_dot = scale_add(c, outer_rate, w_dot);

    // exp ω^ = (1 - b|ω|²) 1 + a ω^ + b ωω^T
    let one = Lane::splat(simd, 1.0);
    let mut exp = scale(b, outer(omega, omega));
    let diagonal = b.neg_mul_add(q_hat, one);
    for k in 0..3 {
        exp[4 * k] = exp[4 * k] + diagonal;
    }
    add_skew(&mut exp, a, omega);
    let rotation = mat_mul(&center, &exp);
    let z = mat_mul(&center, &w);
    let z_dot = mat_mul(&center, &w_dot);
    let position = crate::lanes::mat_vec_add(&center, x, splat(simd, center_position));
    let position_dot = mat_vec(&center, x_dot);
    let angular = mat_vec(&z, omega_dot);
    let velocity = join(angular, cross_add(position, angular, position_dot));
    *base = BaseLanes {
        z: store(z),
        z_dot: store(z_dot),
        center: store(center),
        position: store(position),
        position_dot: store(position_dot),
        xi,
        xi_dot,
        w: store(w),
        w_dot: store(w_dot),
        series: series.map(store),
    };
    (rotation, position, velocity)
}

/// The three columns of `N(X)` that are not zero, as a 6 x 3 row-major matrix.
#[inline(always)]
pub(crate) fn second_order<S: Simd>(simd: S, base: &BaseLanes, wrench: Lane6<S>) -> [Lane<S>; 18] {
    let (n, m_f) = central_wrench(simd, base, wrench);
    let (omega, _) = halves(load(simd, &base.xi));
    let [[_, b, c], [a1, b1, c1]] = [0, 1].map(|d| load(simd, &base.series[d]));
    let upper = n_upper(a1, b1, c1, b, c, omega, n);
    let lower = neg_cross_matrix(m_f, &load(simd, &base.w));
    stack(upper, lower)
}

/// The three columns of `Ṅ(X)` that are not zero, as a 6 x 3 row-major matrix.
#[inline(always)]
pub(crate) fn second_order_rate<S: Simd>(simd: S, base: &BaseLanes, wrench: Lane6<S>) -> [Lane<S>; 18] {
    let (n, m_f) = central_wrench(simd, base, wrench);
    let (omega, _) = halves(load(simd, &base.xi));
    let (omega_dot, x_dot) = halves(load(simd, &base.xi_dot));
    let n_dot = cross(m_f, x_dot);
    let [[_, b, c], [a1, b1, c1], [a2, b2, c2]] = [0, 1, 2].map(|d| load(simd, &base.series[d]));
    let two = Lane::splat(simd, 2.0);
    let q_hat_dot = two * dot3(omega, omega_dot);
    let (b_dot, c_dot) = (b1 * q_hat_dot, c1 * q_hat_dot);

    let w1 = w_matrix(a1, b1, c1, omega);
    let mut w1_dot = scale(q_hat_dot, w_matrix(a2, b2, c2, omega));
    add_skew(&mut w1_dot, b1, omega_dot);
    w1_dot = scale_add(c1, add(outer(omega_dot, omega), outer(omega, omega_dot)), w1_dot);

    let g = mat_tr_vec(&w1, n);
    let g_dot = add(mat_tr_vec(&w1_dot, n), mat_tr_vec(&w1, n_dot));
    let mut upper = scale(two, add(outer(omega_dot, g), outer(omega, g_dot)));
    add_skew(&mut upper, -b_dot, n);
    add_skew(&mut upper, -b, n_dot);
    upper = scale_add(c_dot, outer(n, omega), upper);
    upper = scale_add(c, add(outer(n_dot, omega), outer(n, omega_dot)), upper);
    let diagonal = c_dot * dot3(n, omega) + c * (dot3(n_dot, omega) + dot3(n, omega_dot));
    for k in 0..3 {
        upper[4 * k] = upper[4 * k] + diagonal;
    }
    stack(upper, neg_cross_matrix(m_f, &load(simd, &base.w_dot)))
}

/// `N x` for the 6 x 3 matrices above and a 6-vector of chart coordinates.
#[inline(always)]
pub(crate) fn apply_second_order<S: Simd>(n: &[Lane<S>; 18], x: Lane6<S>) -> Lane6<S> {
    let x = [x[0], x[1], x[2]];
    let mut out = [x[0]; 6];
    for r in 0..6 {
        out[r] = dot3([n[3 * r], n[3 * r + 1], n[3 * r + 2]], x);
    }
    out
}

#[inline(always)]
fn central_wrench<S: Simd>(simd: S, base: &BaseLanes, wrench: Lane6<S>) -> (Lane3<S>, Lane3<S>) {
    let (torque, force) = halves(wrench);
    let center = load(simd, &base.center);
    let central = crate::lanes::sub(torque, cross(load(simd, &base.position), force));
    (mat_tr_vec(&center, central), mat_tr_vec(&center, force))
}

/// Coefficients of the derivatives of [`SERIES`] (terms below the order of the derivative are zero).
const DERIVATIVES: [[[f64; TERMS]; 3]; 3] = {
    let mut table = [SERIES; 3];
    let mut derivative = 0;
    while derivative < 3 {
        let mut row = 0;
        while row < 3 {
            let mut term = 0;
            while term < TERMS {
                let mut j = 0;
                while j < derivative {
                    table[derivative][row][term] *= term as f64 - j as f64;
                    j += 1;
                }
                term += 1;
            }
            row += 1;
        }
        derivative += 1;
    }
    table
};

#[inline(always)]
fn series_lanes<S: Simd>(simd: S, q_hat: Lane<S>) -> [Lane3<S>; 3] {
    let mut out = [[q_hat; 3]; 3];
    for derivative in 0..3 {
        for row in 0..3 {
            let mut sum = Lane::splat(simd, DERIVATIVES[derivative][row][TERMS - 1]);
            for term in (derivative..TERMS - 1).rev() {
                sum = sum.mul_add(q_hat, Lane::splat(simd, DERIVATIVES[derivative][row][term]));
            }
            out[derivative][row] = sum;
        }
    }
    out
}

/// `m += factor v^`.
#[inline(always)]
fn add_skew<S: Simd>(m: &mut Lane9<S>, factor: Lane<S>, v: Lane3<S>) {
    m[1] = factor.neg_mul_add(v[2], m[1]);
    m[2] = factor.mul_add(v[1], m[2]);
    m[3] = factor.mul_add(v[2], m[3]);
    m[5] = factor.neg_mul_add(v[0], m[5]);
    m[6] = factor.neg_mul_add(v[1], m[6]);
    m[7] = factor.mul_add(v[0], m[7]);
}

/// `a 1 + b ω^ + c ωωᵀ`.
#[inline(always)]
fn w_matrix<S: Simd>(a: Lane<S>, b: Lane<S>, c: Lane<S>, omega: Lane3<S>) -> Lane9<S> {
    let mut w = scale(c, outer(omega, omega));
    for k in 0..3 {
        w[4 * k] = w[4 * k] + a;
    }
    add_skew(&mut w, b, omega);
    w
}

#[inline(always)]
fn n_upper<S: Simd>(
    a1: Lane<S>,
    b1: Lane<S>,
    c1: Lane<S>,
    b: Lane<S>,
    c: Lane<S>,
    omega: Lane3<S>,
    n: Lane3<S>,
) -> Lane9<S> {
    let g = mat_tr_vec(&w_matrix(a1, b1, c1, omega), n);
    let mut upper = outer(add(omega, omega), g);
    add_skew(&mut upper, -b, n);
    upper = scale_add(c, outer(n, omega), upper);
    let diagonal = c * dot3(n, omega);
    for k in 0..3 {
        upper[4 * k] = upper[4 * k] + diagonal;
    }
    upper
}

/// `-m^ A`.
#[inline(always)]
fn neg_cross_matrix<S: Simd>(m: Lane3<S>, a: &Lane9<S>) -> Lane9<S> {
    let mut out = *a;
    for c in 0..3 {
        let column = cross([a[c], a[3 + c], a[6 + c]], m);
        for r in 0..3 {
            out[3 * r + c] = column[r];
        }
    }
    out
}

#[inline(always)]
fn stack<S: Simd>(upper: Lane9<S>, lower: Lane9<S>) -> [Lane<S>; 18] {
    let mut out = [upper[0]; 18];
    out[..9].copy_from_slice(&upper);
    out[9..].copy_from_slice(&lower);
    out
}

/// `N^α(X)` at one node as a 6 x 6 matrix.
pub(crate) struct SecondOrderMatrix<'a> {
    pub base: &'a [BaseLanes],
    pub alpha: usize,
    pub wrench: &'a crate::spatial::Wrench,
}

impl crate::lanes::Kernel for SecondOrderMatrix<'_> {
    type Output = nalgebra::Matrix6<f64>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> nalgebra::Matrix6<f64> {
        let (g, lane) = (self.alpha / crate::lanes::LANES, self.alpha % crate::lanes::LANES);
        let wrench: [f64; 6] = self.wrench.to_vector().into();
        let n = store(second_order(simd, &self.base[g], splat(simd, &wrench)));
        nalgebra::Matrix6::from_fn(|r, c| if c < 3 { n[3 * r + c].0[lane] } else { 0.0 })
    }
}
