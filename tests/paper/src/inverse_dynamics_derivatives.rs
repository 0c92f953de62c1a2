//! Inverse dynamics `τ = ID(q, q̇, q̈)` in O(n) and its analytic derivatives in O(n depth).
//!
//! | letter | meaning |
//! |---|---|
//! | `S, Ṡ = ad_v S` | joint twist, its rate |
//! | `v, a` | link twist, its rate (with `-g` at the root, so that weight is inertia) |
//! | `F` | wrench on the subtree |
//! | `I` | composite inertia, `İ - ad^D_h = [W 0; -2p^ 0]` with the momentum `h = [L; p]`, `W = İ_rot - L^` |
//!
//! ```text
//! A_j = ad_{a_j} S_j + ad_{v_j} Ṡ_j,     B x = [W x_ω; -2 p×x_ω]
//! ∂τ_i/∂q_j = S_iᵀ (I_j A_j + B_j Ṡ_j - ad^D_{F_j} S_j)       ∂τ_j/∂q_i = (I_j S_j)ᵀ A_i + (B_jᵀ S_j)ᵀ Ṡ_i
//! ∂τ_i/∂q̇_j = S_iᵀ (2 I_j Ṡ_j + B_j S_j)                      ∂τ_j/∂q̇_i = 2 (I_j S_j)ᵀ Ṡ_i + (B_jᵀ S_j)ᵀ S_i
//! ∂τ_i/∂q̈_j = S_iᵀ I_j S_j = ∂τ_j/∂q̈_i                       (i on the branch of j)
//! ```
//!
//! The first column of a line holds for `i` at or above `j`, the second for `i` above `j`. About 45 multiply-adds per pair.
//!
//! Source: J. Carpentier, N. Mansard, *Analytical derivatives of rigid body dynamics algorithms*, RSS 2018; S. Singh, R. P. Russell, P. M.
//! Wensing, *Efficient analytical derivatives of rigid-body dynamics using spatial vector algebra*, IEEE RA-L 2022. Derived anew here with the
//! co-moving variations of the integrator; the shape of `B` is theirs.

use delmpc_mechanics::prelude::KinematicTree;

use crate::rigid_bodies::{
    Inertia, Pose, RigidBodies, RivalError, V6, add6, array, axpy6, bracket, cross, cross_wrench, dot6,
    halves, join, rotate, vectorized,
};

/// Workspace for one tree.
#[derive(Clone, Debug)]
pub struct InverseDynamics {
    bodies: RigidBodies,
    arch: pulp::Arch,
    poses: Vec<Pose>,
    velocities: Vec<V6>,
    accelerations: Vec<V6>,
    rates: Vec<V6>,
    wrenches: Vec<V6>,
    inertias: Vec<Inertia>,
    /// `W` by rows, `p`.
    w: Vec<[f64; 9]>,
    p: Vec<[f64; 3]>,
    /// `A`.
    seconds: Vec<V6>,
    /// `∂τ/∂q`, `∂τ/∂q̇`, `∂τ/∂q̈`, row by row.
    pub by_q: Vec<f64>,
    /// See [`Self::by_q`].
    pub by_v: Vec<f64>,
    /// See [`Self::by_q`].
    pub by_a: Vec<f64>,
}

impl InverseDynamics {
    /// For a tree of revolute joints.
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree) -> Result<Self, RivalError> {
        let bodies = RigidBodies::new(tree)?;
        let n = bodies.dof();
        let zero = vec![[0.0; 6]; n];
        Ok(Self {
            bodies,
            arch: pulp::Arch::new(),
            poses: vec![Pose::default(); n],
            velocities: zero.clone(),
            accelerations: zero.clone(),
            rates: zero.clone(),
            wrenches: zero.clone(),
            inertias: vec![Inertia::default(); n],
            w: vec![[0.0; 9]; n],
            p: vec![[0.0; 3]; n],
            seconds: zero,
            by_q: vec![0.0; n * n],
            by_v: vec![0.0; n * n],
            by_a: vec![0.0; n * n],
        })
    }

    /// `τ`. O(n), no allocation.
    pub fn torque_into(&mut self, q: &[f64], v: &[f64], a: &[f64], out: &mut [f64]) {
        vectorized!(self.arch, (), (
            work: &'a mut InverseDynamics = self, q: &'a [f64] = q, v: &'a [f64] = v, a: &'a [f64] = a,
            out: &'a mut [f64] = out
        ) => work.torque(q, v, a, out));
    }

    /// Derivatives at the arguments of the last [`Self::torque_into`]. O(n depth), no allocation.
    pub fn differentiate(&mut self) {
        vectorized!(self.arch, (), (work: &'a mut InverseDynamics = self) => work.derivatives());
    }

    #[inline(always)]
    fn torque(&mut self, q: &[f64], v: &[f64], a: &[f64], out: &mut [f64]) {
        let gravity = array!(3, k => -self.bodies.gravity[k]);
        for i in 0..self.bodies.dof() {
            let parent = self.bodies.links[i].parent;
            let (pose, velocity, acceleration) = if parent == usize::MAX {
                (self.bodies.pose(i, q[i], None), [0.0; 6], join([0.0; 3], gravity))
            } else {
                let ahead = self.poses[parent];
                let pose = self.bodies.pose(i, q[i], Some(&ahead));
                (pose, self.velocities[parent], self.accelerations[parent])
            };
            // ad_v S does not see the own rate: ad_S S = 0.
            let rate = bracket(&velocity, &pose.twist);
            let velocity = axpy6(&velocity, v[i], &pose.twist);
            let acceleration = axpy6(&axpy6(&acceleration, a[i], &pose.twist), v[i], &rate);
            let inertia = self.bodies.inertia(i, &pose);
            let momentum = inertia.times(&velocity);
            self.wrenches[i] = add6(&inertia.times(&acceleration), &cross_wrench(&velocity, &momentum));
            self.poses[i] = pose;
            self.rates[i] = rate;
            self.velocities[i] = velocity;
            self.accelerations[i] = acceleration;
            self.inertias[i] = inertia;
        }
        for i in (0..self.bodies.dof()).rev() {
            out[i] = dot6(&self.poses[i].twist, &self.wrenches[i]);
            let parent = self.bodies.links[i].parent;
            if parent != usize::MAX {
                self.wrenches[parent] = add6(&self.wrenches[parent], &self.wrenches[i]);
            }
        }
    }

    #[inline(always)]
    fn derivatives(&mut self) {
        let n = self.bodies.dof();
        for i in 0..n {
            let (twist, rate) = (&self.poses[i].twist, &self.rates[i]);
            self.seconds[i] =
                add6(&bracket(&self.accelerations[i], twist), &bracket(&self.velocities[i], rate));
            (self.w[i], self.p[i]) = rate_of_inertia(&self.inertias[i], &self.velocities[i]);
        }
        for j in (0..n).rev() {
            let (twist, rate) = (self.poses[j].twist, self.rates[j]);
            let by_a = self.inertias[j].times(&twist);
            let moved = add6(&self.inertias[j].times(&self.seconds[j]), &self.forth(j, &rate));
            let by_q: V6 = {
                let carried = dual_bracket(&self.wrenches[j], &twist);
                array!(6, k => moved[k] - carried[k])
            };
            let by_v = axpy6(&self.forth(j, &twist), 2.0, &self.inertias[j].times(&rate));
            let back = self.back(j, &twist);
            self.by_q[j * n + j] = dot6(&twist, &by_q);
            self.by_v[j * n + j] = dot6(&twist, &by_v);
            self.by_a[j * n + j] = dot6(&twist, &by_a);
            let mut i = self.bodies.links[j].parent;
            let parent = i;
            while i != usize::MAX {
                let (above, above_rate) = (&self.poses[i].twist, &self.rates[i]);
                self.by_q[i * n + j] = dot6(above, &by_q);
                self.by_v[i * n + j] = dot6(above, &by_v);
                let inertia = dot6(above, &by_a);
                self.by_a[i * n + j] = inertia;
                self.by_a[j * n + i] = inertia;
                self.by_q[j * n + i] = dot6(&by_a, &self.seconds[i]) + dot3(&back, above_rate);
                self.by_v[j * n + i] = 2.0f64.mul_add(dot6(&by_a, above_rate), dot3(&back, above));
                i = self.bodies.links[i].parent;
            }
            if parent != usize::MAX {
                let own = self.inertias[j];
                self.inertias[parent].add(&own);
                for k in 0..9 {
                    self.w[parent][k] += self.w[j][k];
                }
                for k in 0..3 {
                    self.p[parent][k] += self.p[j][k];
                }
            }
        }
    }

    /// `B x`.
    #[inline(always)]
    fn forth(&self, j: usize, x: &V6) -> V6 {
        let (omega, _) = halves(x);
        {
            let turn = cross(self.p[j], omega);
            join(rotate(&self.w[j], omega), array!(3, k => -2.0 * turn[k]))
        }
    }

    /// Angular part of `Bᵀ S`, the rest is zero.
    #[inline(always)]
    fn back(&self, j: usize, twist: &V6) -> [f64; 3] {
        let (s, n) = halves(twist);
        let w = &self.w[j];
        let turn = cross(self.p[j], n);
        array!(3, k => w[k].mul_add(s[0], w[3 + k].mul_add(s[1], w[6 + k].mul_add(s[2], 2.0 * turn[k]))))
    }
}

/// `W` and `p` of one link.
#[inline(always)]
fn rate_of_inertia(inertia: &Inertia, velocity: &V6) -> ([f64; 9], [f64; 3]) {
    let ([x, y, z], [ux, uy, uz]) = halves(velocity);
    let [hx, hy, hz] = inertia.first_moment;
    let [xx, yy, zz, xy, xz, yz] = inertia.rotational;
    let (angular, linear) = halves(&inertia.times(velocity));
    // ω^J - Jω^ = ω^J + (ω^J)ᵀ.
    let j = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let turn = [x, y, z];
    let c = [cross(turn, j[0]), cross(turn, j[1]), cross(turn, j[2])];
    // -u^h^ - h^u^ = 2 u·h 1 - u hᵀ - h uᵀ.
    let (u, h) = ([ux, uy, uz], [hx, hy, hz]);
    let twice = 2.0 * (ux * hx + uy * hy + uz * hz);
    let [lx, ly, lz] = angular;
    let skew = [0.0, -lz, ly, lz, 0.0, -lx, -ly, lx, 0.0];
    let mut w = [0.0; 9];
    for a in 0..3 {
        for b in 0..3 {
            let spread = if a == b { twice } else { 0.0 };
            w[3 * a + b] = c[b][a] + c[a][b] + spread - u[a] * h[b] - h[a] * u[b] - skew[3 * a + b];
        }
    }
    (w, linear)
}

/// Scalar product with the angular part.
#[inline(always)]
fn dot3(a: &[f64; 3], x: &V6) -> f64 {
    a[0].mul_add(x[0], a[1].mul_add(x[1], a[2] * x[2]))
}

/// `ad^D_F x = [τ×x_ω + f×x_v; f×x_ω]`.
#[inline(always)]
fn dual_bracket(wrench: &V6, x: &V6) -> V6 {
    let (torque, force) = halves(wrench);
    let (omega, linear) = halves(x);
    let (a, b) = (cross(torque, omega), cross(force, linear));
    join(array!(3, k => a[k] + b[k]), cross(force, omega))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::articulated_body::ArticulatedBody;
    use crate::articulated_body::tests::tree;
    use crate::pendulum::initial_conditions;

    #[test]
    fn torques_of_free_motion_vanish() {
        let tree = tree();
        let n = tree.dof();
        let start = &initial_conditions(n, 1, 1.5, 3)[0];
        let mut acceleration = vec![0.0; n];
        ArticulatedBody::new(&tree).unwrap().acceleration_into(&start.q, &start.v, &mut acceleration);
        let mut torque = vec![0.0; n];
        InverseDynamics::new(&tree).unwrap().torque_into(&start.q, &start.v, &acceleration, &mut torque);
        assert!(torque.iter().all(|t| t.abs() < 1e-11), "{torque:?}");
    }

    /// Central differences of the torques by every argument; their error is 1e-10 of the torques.
    #[test]
    fn derivatives_are_those_of_the_torques() {
        let tree = tree();
        let n = tree.dof();
        let start = &initial_conditions(n, 1, 1.2, 5)[0];
        let acceleration = initial_conditions(n, 1, 2.0, 6)[0].v.clone();
        let mut work = InverseDynamics::new(&tree).unwrap();
        let mut torque = vec![0.0; n];
        work.torque_into(&start.q, &start.v, &acceleration, &mut torque);
        work.differentiate();
        let analytic = [work.by_q.clone(), work.by_v.clone(), work.by_a.clone()];
        let step = 1e-5;
        for argument in 0..3 {
            for j in 0..n {
                let mut at = |sign: f64| {
                    let mut x = [start.q.clone(), start.v.clone(), acceleration.clone()];
                    x[argument][j] += sign * step;
                    let mut torque = vec![0.0; n];
                    work.torque_into(&x[0], &x[1], &x[2], &mut torque);
                    torque
                };
                let (above, below) = (at(1.0), at(-1.0));
                for i in 0..n {
                    let difference = (above[i] - below[i]) / (2.0 * step);
                    let error = (analytic[argument][i * n + j] - difference).abs();
                    assert!(error < 1e-7, "argument {argument}, row {i}, column {j}: {error:e}");
                }
            }
        }
    }
}
