//! Points on bodies: positions, gradients, and second derivatives contracted with forces.
//!
//! ```text
//! ∂_k x = s_k × x + n_k            ∂_j ∂_k x = s_j × ∂_k x          j on the branch of k
//! Σ_p f_p·∂_j ∂_k x_p = s_jᵀ X s_k - (s_j·s_k) tr X + (F × s_j)·n_k       X = Σ_p x_p f_pᵀ,  F = Σ_p f_p
//! ```
//!
//! so all points of a body cost one contraction. On dual numbers along `d` the ε-part of a contraction is the third
//! derivative in that direction: the curvature of `y·Gᵀλ` (`d = y`) and of `ρ·G v` (`d = v`).

use crate::node::{BodyState, NodeModel};
use crate::scalar::{Lanes, Scalar, cross, dot, rotate_constant, sum};

/// Position of a point of a body, at all lanes.
#[inline(always)]
pub fn position<T: Scalar>(body: &BodyState<T>, point: &[f64; 3]) -> [T; 3] {
    sum(body.origin, rotate_constant(&body.rotation, point))
}

/// `∂_k x` for a coordinate with the joint twist `(s, n)`.
#[inline(always)]
pub fn gradient<T: Scalar>(twist: &([T; 3], [T; 3]), x: [T; 3]) -> [T; 3] {
    sum(cross(twist.0, x), twist.1)
}

/// The values of a vector.
#[inline(always)]
pub fn values<T: Scalar>(v: &[T; 3]) -> [Lanes; 3] {
    [*v[0].value(), *v[1].value(), *v[2].value()]
}

/// Forces on the points of one body, summed: `X` and `F`.
#[derive(Clone, Copy, Debug)]
pub struct Contraction<T> {
    moment: [[T; 3]; 3],
    force: [T; 3],
}

impl<T: Scalar> Contraction<T> {
    /// No force.
    pub const NONE: Self = Self { moment: [[T::ZERO; 3]; 3], force: [T::ZERO; 3] };

    /// Adds a force at a point; the force is constant (has no ε-part).
    #[inline(always)]
    pub fn add(&mut self, x: [T; 3], force: [T; 3]) {
        for a in 0..3 {
            for b in 0..3 {
                self.moment[a][b] += x[a] * force[b];
            }
            self.force[a] += force[a];
        }
    }

    /// Calls `sink(j, k, Σ f·∂_j∂_k x)` for all coordinates `j` before or at `k` on the branch of `body`.
    #[inline(always)]
    pub fn pairs(
        &self,
        model: &NodeModel,
        bodies: &[BodyState<T>],
        body: usize,
        mut sink: impl FnMut(usize, usize, T),
    ) {
        let trace = self.moment[0][0] + self.moment[1][1] + self.moment[2][2];
        let branch = model.branch(body);
        for (position, &j) in branch.iter().enumerate() {
            let s = bodies[j].twist.0;
            // s_jᵀ X - s_j tr X, and F × s_j.
            let mut row = [T::ZERO; 3];
            for b in 0..3 {
                row[b] = s[0] * self.moment[0][b] + s[1] * self.moment[1][b] + s[2] * self.moment[2][b]
                    - s[b] * trace;
            }
            let arm = cross(self.force, s);
            for &k in &branch[position..] {
                let (sk, nk) = bodies[k].twist;
                sink(j, k, dot(row, sk) + dot(arm, nk));
            }
        }
    }
}
