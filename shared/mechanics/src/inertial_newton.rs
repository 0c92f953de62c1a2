//! The inertia part of the Newton matrix as its stand-in, `J ≈ M(q) ⊗ A`: for high orders.
//!
//! | letter | meaning |
//! |---|---|
//! | `M` | mass matrix in the middle of the step |
//! | `A` | what the rule makes of an inertia: `A^{αγ} = (1/Δt) Σ_β a^{αβ} b^{βγ}`, `α = 0..s-1`, `γ = 1..s` |
//!
//! ```text
//! J[α,γ] = Σ_β a^{αβ} m^β b^{βγ}/Δt + O(1) of velocity products + O(Δt) of forces ≈ M A^{αγ},     J⁻¹ ≈ M⁻¹ ⊗ A⁻¹
//! ```
//!
//! What it leaves out is O(Δt) of what it keeps, so that the iteration contracts linearly with a factor O(Δt), faster with Broyden's
//! updates. It takes the mass matrix and its factor, O(Σ depth²), where a factorisation of `J` takes O(s³ Σ depth²): from s = 4 on the
//! latter costs more than the iterations it saves. A solve takes O(s Σ depth + s² n).
//!
//! Source: simplified Newton iterations for implicit Runge-Kutta methods on the Kronecker structure of constant coefficients, J. C.
//! Butcher, *On the implementation of implicit Runge-Kutta methods*, BIT 16, 1976; E. Hairer, G. Wanner, *Solving Ordinary Differential
//! Equations II*, 2nd ed., section IV.8.

use alloc::vec;
use alloc::vec::Vec;

use crate::lanes::{Instructions, Kernel, LANES, Lane, Quad, Simd};
use crate::lobatto::{LobattoRule, MAX_UNKNOWN_NODES};
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::small_inverse::invert;

/// `(Δt A)⁻¹` of one rule, and room for a right-hand side with nodes as lanes.
#[derive(Clone, Debug)]
pub(crate) struct InertialNewton {
    instructions: Instructions,
    s: usize,
    /// Quads of a coordinate.
    groups: usize,
    /// Columns: `[α * groups + g]`, lanes over `γ - 1`.
    inverse: Vec<Quad>,
    /// `[dof * groups + g]`.
    nodes: Vec<Quad>,
}

impl InertialNewton {
    /// For the steps of `rule` of a tree of `dof` coordinates. Allocates.
    pub fn new(rule: &LobattoRule, dof: usize, instructions: Instructions) -> Option<Self> {
        let s = rule.unknown_nodes();
        let groups = s.div_ceil(LANES);
        let mut matrix = [[0.0; MAX_UNKNOWN_NODES]; MAX_UNKNOWN_NODES];
        for (alpha, row) in matrix.iter_mut().enumerate().take(s) {
            for (k, entry) in row.iter_mut().enumerate().take(s) {
                *entry = (0..=s)
                    .map(|beta| rule.weighted_derivative(alpha, beta) * rule.derivative(beta, k + 1))
                    .sum();
            }
        }
        let of = invert(matrix, s).ok()?;
        let mut inverse = vec![Quad::ZERO; s * groups];
        for alpha in 0..s {
            for k in 0..s {
                inverse[alpha * groups + k / LANES].0[k % LANES] = of[k][alpha];
            }
        }
        Some(Self { instructions, s, groups, inverse, nodes: vec![Quad::ZERO; dof * groups] })
    }

    /// `rhs := (M⁻¹ ⊗ A⁻¹) rhs`, coordinate-major as everywhere. No allocation.
    pub fn solve(&mut self, mass: &MassMatrixFactor, time_step: f64, rhs: &mut [f64]) {
        let instructions = self.instructions;
        instructions.dispatch(Solve { work: self, mass, time_step, rhs });
    }
}

struct Solve<'a> {
    work: &'a mut InertialNewton,
    mass: &'a MassMatrixFactor,
    time_step: f64,
    rhs: &'a mut [f64],
}

impl Kernel for Solve<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // With a constant number of groups they stay in registers.
        match self.work.groups {
            1 => solve::<S, 1>(simd, self),
            2 => solve::<S, 2>(simd, self),
            _ => solve::<S, { MAX_UNKNOWN_NODES.div_ceil(LANES) }>(simd, self),
        }
    }
}

#[inline(always)]
fn solve<S: Simd, const G: usize>(simd: S, task: Solve<'_>) {
    let Solve { work: InertialNewton { s, groups, inverse, nodes, .. }, mass, time_step, rhs } = task;
    let (s, groups) = (*s, if G < 3 { G } else { *groups });
    let zero = Lane::splat(simd, 0.0);
    for (own, nodes) in rhs.chunks_exact(s).zip(nodes.chunks_exact_mut(groups)) {
        let mut sums = [zero; G];
        for (value, column) in own.iter().zip(inverse.chunks_exact(groups)) {
            let value = Lane::splat(simd, time_step * value);
            for g in 0..groups {
                sums[g] = Lane::load(simd, &column[g]).mul_add(value, sums[g]);
            }
        }
        for g in 0..groups {
            nodes[g] = sums[g].quad();
        }
    }
    let dof = mass.pivots().len();
    for k in (0..dof).rev() {
        let (above, own) = nodes.split_at_mut(k * groups);
        for &j in mass.ancestors(k) {
            let factor = Lane::splat(simd, mass.lower(k, j as usize));
            let target = &mut above[j as usize * groups..(j as usize + 1) * groups];
            for g in 0..groups {
                let sum = factor.neg_mul_add(Lane::load(simd, &own[g]), Lane::load(simd, &target[g]));
                target[g] = sum.quad();
            }
        }
    }
    for k in 0..dof {
        let (above, own) = nodes.split_at_mut(k * groups);
        let scale = Lane::splat(simd, 1.0 / mass.pivots()[k]);
        let mut sums = [zero; G];
        for g in 0..groups {
            sums[g] = scale * Lane::load(simd, &own[g]);
        }
        for &j in mass.ancestors(k) {
            let factor = Lane::splat(simd, mass.lower(k, j as usize));
            let of = &above[j as usize * groups..(j as usize + 1) * groups];
            for g in 0..groups {
                sums[g] = factor.neg_mul_add(Lane::load(simd, &of[g]), sums[g]);
            }
        }
        for g in 0..groups {
            own[g] = sums[g].quad();
        }
        for (gamma, x) in rhs[k * s..(k + 1) * s].iter_mut().enumerate() {
            *x = own[gamma / LANES].0[gamma % LANES];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prelude::*;
    use crate::velocity::VelocityWorkspace;

    /// `(M ⊗ A)` times the solution is the right-hand side.
    #[test]
    fn inverts_the_inertia_part() {
        let link = LinkInertia::new(1.0, Vector3::new(0.2, 0.0, -0.3), Matrix3::identity() * 0.3);
        let mut builder = TreeBuilder::fixed_base(Vector3::zeros());
        let mut parent = None;
        for _ in 0..3 {
            let place = RigidTransform::from_translation(Vector3::new(0.0, 0.1, -0.6));
            parent = Some(builder.add(Body::new(parent, Joint::revolute(Vector3::y(), place), link)));
        }
        let tree = builder.build().unwrap();
        let mut state = State::zeros(&tree);
        state.q = vec![0.3, -0.7, 0.9];
        let mut velocities = VelocityWorkspace::new(&tree);
        velocities.factor_at(&tree, &state).unwrap();
        let mass = velocities.mass_matrix().to_vec();
        let (n, step) = (3, 0.01);
        for s in 1..=9 {
            let rule = LobattoRule::new(s).unwrap();
            let mut work = InertialNewton::new(&rule, n, Instructions::detect().unwrap()).unwrap();
            let wanted: Vec<f64> = (0..n * s).map(|k| (1.0 + k as f64).sin()).collect();
            let entry = |alpha: usize, k: usize| -> f64 {
                let terms = (0..=s).map(|b| rule.weighted_derivative(alpha, b) * rule.derivative(b, k + 1));
                terms.sum::<f64>() / step
            };
            let mut rhs = vec![0.0; n * s];
            for (i, row) in rhs.chunks_exact_mut(s).enumerate() {
                for (alpha, x) in row.iter_mut().enumerate() {
                    for j in 0..n {
                        let sum: f64 = (0..s).map(|k| entry(alpha, k) * wanted[j * s + k]).sum();
                        *x += mass[i * n + j] * sum;
                    }
                }
            }
            work.solve(velocities.factor(), step, &mut rhs);
            for (x, w) in rhs.iter().zip(&wanted) {
                assert!((x - w).abs() < 1e-11, "s = {s}: {x} instead of {w}");
            }
        }
    }
}
