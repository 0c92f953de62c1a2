//! The DEL equations, the Newton direction and the linearisation by automatic differentiation.
//!
//! The rival of figure 2. Forward mode with dual numbers of the library `num-dual`, at two depths:
//!
//! | what is differentiated | first derivatives | second derivatives |
//! |---|---|---|
//! | the Lagrangian, from forward kinematics ([`Depth::Lagrangian`]) | dual numbers | hyper-dual numbers |
//! | its gradient, a hand-written recursion ([`Depth::Gradient`]) | (the recursion itself) | dual numbers |
//!
//! The first is what "automatic differentiation" means in the paper: nothing is known but `L`. The second is the best forward mode can
//! do once somebody has written Algorithm 1. Both use the structure `L_d = Σ_α w_α Δt L(q^α, q̇^α)`: derivatives are taken by the 2n
//! arguments of `L` at every node, eight directions (hyper-dual: four by four) at a time, and assembled with the weights:
//!
//! ```text
//! r^α = δ_{α0} p + w_α Δt L_q^α + Σ_β w_β b^{βα} L_q̇^β
//! H[α,γ] = δ_{αγ} w_α Δt L_qq^α + w_α b^{αγ} L_qq̇^α + w_γ b^{γα} L_q̇q^γ + (1/Δt) Σ_β w_β b^{βα} b^{βγ} L_q̇q̇^β
//! ```
//!
//! Newton matrix and linearisation by dense LU (nalgebra). Cost: O(n²) and O(n³) (Lagrangian), O(n) and O(n²) (gradient), plus the LU.
//!
//! Source: J. A. Fike, J. J. Alonso, *The development of hyper-dual numbers for exact second-derivative calculations*, AIAA 2011-886.

use delmpc_mechanics::prelude::*;
use nalgebra::{DMatrix, DVector, Dyn, LU};
use num_dual::{DualNum, DualNumCopy, DualSVec64, HyperDualSVec64};

use crate::rigid_bodies::{RigidBodies, RivalError};

/// Directions of a dual number.
const WIDTH: usize = 8;
/// Directions of a hyper-dual number, either side.
const HYPER: usize = 4;

/// A number that may carry derivatives.
pub trait Number: DualNumCopy + DualNum<Primitive = f64> {}
impl<T: DualNumCopy + DualNum<Primitive = f64>> Number for T {}

/// What is differentiated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Depth {
    /// The Lagrangian.
    Lagrangian,
    /// Its gradient by a recursion.
    Gradient,
}

type V3<T> = [T; 3];

#[inline(always)]
fn cross<T: Number>(a: &V3<T>, b: &V3<T>) -> V3<T> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn cross_constant<T: Number>(a: &V3<T>, b: &[f64; 3]) -> V3<T> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn add<T: Number>(a: &V3<T>, b: &V3<T>) -> V3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
fn dot<T: Number>(a: &V3<T>, b: &V3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn dot_constant<T: Number>(a: &V3<T>, b: &[f64; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn constant<T: Number>(a: &[f64; 3]) -> V3<T> {
    a.map(T::from)
}

/// Rotation of a link in its parent's axes.
#[inline(always)]
fn turn<T: Number>(bodies: &RigidBodies, i: usize, q: T) -> [T; 9] {
    let link = &bodies.links[i];
    let (sin, cos) = q.sin_cos();
    core::array::from_fn(|k| sin * link.e2[k] + cos * link.e1[k] + link.e0[k])
}

/// `Rᵀ x`.
#[inline(always)]
fn back<T: Number>(r: &[T; 9], x: &V3<T>) -> V3<T> {
    core::array::from_fn(|k| r[k] * x[0] + r[3 + k] * x[1] + r[6 + k] * x[2])
}

/// `R x`.
#[inline(always)]
fn forth<T: Number>(r: &[T; 9], x: &V3<T>) -> V3<T> {
    core::array::from_fn(|k| r[3 * k] * x[0] + r[3 * k + 1] * x[1] + r[3 * k + 2] * x[2])
}

/// `I x` of a link about its mass centre, in link axes.
#[inline(always)]
fn inertia_times<T: Number>(bodies: &RigidBodies, i: usize, x: &V3<T>) -> V3<T> {
    let [xx, yy, zz, xy, xz, yz] = bodies.links[i].inertia;
    [dot_constant(x, &[xx, xy, xz]), dot_constant(x, &[xy, yy, yz]), dot_constant(x, &[xz, yz, zz])]
}

/// What the recursions carry from link to link, in link axes.
#[derive(Clone, Copy)]
struct Carried<T> {
    turn: [T; 9],
    /// Angular velocity, velocity of the joint origin, gravity.
    omega: V3<T>,
    velocity: V3<T>,
    gravity: V3<T>,
    /// `-g·x` of the joint origin.
    height: T,
}

#[inline(always)]
fn carry<T: Number>(bodies: &RigidBodies, i: usize, q: T, v: T, parent: Option<&Carried<T>>) -> Carried<T> {
    let link = &bodies.links[i];
    let turn = turn(bodies, i, q);
    let own: V3<T> = link.axis.map(|a| v * a);
    match parent {
        None => {
            let gravity = constant(&bodies.gravity);
            Carried {
                turn,
                omega: own,
                velocity: constant(&[0.0; 3]),
                gravity: back(&turn, &gravity),
                height: -dot_constant(&gravity, &link.origin),
            }
        }
        Some(parent) => {
            let velocity = add(&parent.velocity, &cross_constant(&parent.omega, &link.origin));
            Carried {
                turn,
                omega: add(&back(&turn, &parent.omega), &own),
                velocity: back(&turn, &velocity),
                gravity: back(&turn, &parent.gravity),
                height: parent.height - dot_constant(&parent.gravity, &link.origin),
            }
        }
    }
}

/// `L(q, q̇)` by forward kinematics; `memory` holds one entry per link.
fn lagrangian<T: Number>(bodies: &RigidBodies, q: &[T], v: &[T], memory: &mut Vec<Carried<T>>) -> T {
    memory.clear();
    let mut sum = T::from(0.0);
    for (i, link) in bodies.links.iter().enumerate() {
        let own = carry(bodies, i, q[i], v[i], memory.get(link.parent));
        let centre = add(&own.velocity, &cross_constant(&own.omega, &link.com));
        let spin = inertia_times(bodies, i, &own.omega);
        let kinetic = (dot(&own.omega, &spin) + dot(&centre, &centre) * link.mass) * 0.5;
        let potential = (own.height - dot_constant(&own.gravity, &link.com)) * link.mass;
        sum += kinetic - potential;
        memory.push(own);
    }
    sum
}

/// Momenta and forces handed to the parent, about its joint origin in its axes.
type Wrenches<T> = [V3<T>; 4];

/// `(L_q, L_q̇)` by one outward and one inward recursion: Algorithm 1 at one node, in link axes.
///
/// With `μ` the momentum of the subtree and `Γ` its weight, about the joint origin: `L_q̇ = a·μ_ω`, and, since turning the subtree
/// about the axis turns `v` against it, `L_q = a·(Γ_ω + μ_ω×ω' + μ_v×v)` with `ω'`, `v` the velocity handed on by the parent.
fn gradient<T: Number>(
    bodies: &RigidBodies,
    q: &[T],
    v: &[T],
    memory: &mut Vec<Carried<T>>,
    wrenches: &mut Vec<Wrenches<T>>,
    by_q: &mut [T],
    by_v: &mut [T],
) {
    memory.clear();
    for (i, link) in bodies.links.iter().enumerate() {
        let own = carry(bodies, i, q[i], v[i], memory.get(link.parent));
        memory.push(own);
    }
    wrenches.clear();
    wrenches.resize(bodies.dof(), [constant(&[0.0; 3]); 4]);
    for (i, link) in bodies.links.iter().enumerate().rev() {
        let own = &memory[i];
        let [mut spin, mut push, mut torque, mut weight] = wrenches[i];
        let centre = add(&own.velocity, &cross_constant(&own.omega, &link.com));
        let momentum: V3<T> = centre.map(|x| x * link.mass);
        let force: V3<T> = own.gravity.map(|x| x * link.mass);
        let com = constant(&link.com);
        push = add(&push, &momentum);
        spin = add(&spin, &add(&inertia_times(bodies, i, &own.omega), &cross(&com, &momentum)));
        weight = add(&weight, &force);
        torque = add(&torque, &cross(&com, &force));
        let own_turn: V3<T> = link.axis.map(|a| v[i] * a);
        let ahead: V3<T> = core::array::from_fn(|k| own.omega[k] - own_turn[k]);
        let bend = add(&torque, &add(&cross(&spin, &ahead), &cross(&push, &own.velocity)));
        by_q[i] = dot_constant(&bend, &link.axis);
        by_v[i] = dot_constant(&spin, &link.axis);
        if link.parent != usize::MAX {
            let arm = constant(&link.origin);
            let (push, weight) = (forth(&own.turn, &push), forth(&own.turn, &weight));
            let spin = add(&forth(&own.turn, &spin), &cross(&arm, &push));
            let torque = add(&forth(&own.turn, &torque), &cross(&arm, &weight));
            let handed = [spin, push, torque, weight];
            for (sum, x) in wrenches[link.parent].iter_mut().zip(&handed) {
                *sum = add(sum, x);
            }
        }
    }
}

/// The discrete mechanics of one tree and rule by automatic differentiation.
#[derive(Debug)]
pub struct Automatic {
    bodies: RigidBodies,
    rule: LobattoRule,
    time_step: f64,
    /// `q^α`, `q̇^α`: node by node, `2n` numbers.
    nodes: Vec<Vec<f64>>,
    momentum: Vec<f64>,
    gradients: Vec<Vec<f64>>,
    hessians: Vec<DMatrix<f64>>,
}

impl Automatic {
    /// For steps of `time_step` (s).
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree, rule: &LobattoRule, time_step: f64) -> Result<Self, RivalError> {
        let bodies = RigidBodies::new(tree)?;
        let (n, count) = (bodies.dof(), rule.nodes().len());
        Ok(Self {
            bodies,
            rule: rule.clone(),
            time_step,
            nodes: vec![vec![0.0; 2 * n]; count],
            momentum: vec![0.0; n],
            gradients: vec![vec![0.0; 2 * n]; count],
            hessians: vec![DMatrix::zeros(2 * n, 2 * n); count],
        })
    }

    /// Control points `q^0..q^s` and the momentum at the start.
    pub fn set(&mut self, points: &[Vec<f64>], momentum: &[f64]) {
        let n = self.bodies.dof();
        for (alpha, node) in self.nodes.iter_mut().enumerate() {
            for i in 0..n {
                node[i] = points[alpha][i];
                let sum: f64 =
                    points.iter().enumerate().map(|(beta, q)| self.rule.derivative(alpha, beta) * q[i]).sum();
                node[n + i] = sum / self.time_step;
            }
        }
        self.momentum.copy_from_slice(momentum);
    }

    /// `r^α` for `α = 0..s-1`, coordinate-major, as in the integrator.
    pub fn residual(&mut self, depth: Depth) -> Vec<f64> {
        let n = self.bodies.dof();
        for (node, gradient_of_node) in self.nodes.iter().zip(&mut self.gradients) {
            match depth {
                Depth::Lagrangian => forward_gradient(&self.bodies, node, gradient_of_node),
                Depth::Gradient => {
                    let (q, v) = node.split_at(n);
                    let (by_q, by_v) = gradient_of_node.split_at_mut(n);
                    gradient(&self.bodies, q, v, &mut Vec::new(), &mut Vec::new(), by_q, by_v);
                }
            }
        }
        let s = self.rule.unknown_nodes();
        let w = self.rule.weights();
        let mut rows = vec![0.0; s * n];
        for i in 0..n {
            for alpha in 0..s {
                let start = if alpha == 0 { self.momentum[i] } else { 0.0 };
                let moved: f64 = (0..=s)
                    .map(|beta| w[beta] * self.rule.derivative(beta, alpha) * self.gradients[beta][n + i])
                    .sum();
                rows[i * s + alpha] = start + w[alpha] * self.time_step * self.gradients[alpha][i] + moved;
            }
        }
        rows
    }

    /// Second derivatives of `L` at all nodes.
    fn differentiate_twice(&mut self, depth: Depth) {
        for (node, hessian) in self.nodes.iter().zip(&mut self.hessians) {
            match depth {
                Depth::Lagrangian => hyper_dual_hessian(&self.bodies, node, hessian),
                Depth::Gradient => dual_hessian(&self.bodies, node, hessian),
            }
        }
    }

    /// `H[α,γ]`, from the second derivatives at the nodes.
    fn block(&self, alpha: usize, gamma: usize) -> DMatrix<f64> {
        let n = self.bodies.dof();
        let w = self.rule.weights();
        let b = |i: usize, j: usize| self.rule.derivative(i, j);
        let part = |node: usize, row: usize, column: usize| self.hessians[node].view((row, column), (n, n));
        let mut sum = part(alpha, 0, n) * (w[alpha] * b(alpha, gamma));
        sum += part(gamma, n, 0) * (w[gamma] * b(gamma, alpha));
        if alpha == gamma {
            sum += part(alpha, 0, 0) * (w[alpha] * self.time_step);
        }
        for beta in 0..w.len() {
            sum += part(beta, n, n) * (w[beta] * b(beta, alpha) * b(beta, gamma) / self.time_step);
        }
        sum
    }

    /// `J` node-major, factorised.
    fn factor(&self) -> LU<f64, Dyn, Dyn> {
        let (n, s) = (self.bodies.dof(), self.rule.unknown_nodes());
        let mut jacobian = DMatrix::zeros(s * n, s * n);
        for alpha in 0..s {
            for gamma in 1..=s {
                let place = (alpha * n, (gamma - 1) * n);
                jacobian.view_mut(place, (n, n)).copy_from(&self.block(alpha, gamma));
            }
        }
        jacobian.lu()
    }

    /// `-J⁻¹ r` for a residual of [`Self::residual`]; `None` if `J` is singular.
    pub fn newton_direction(&mut self, depth: Depth, residual: &[f64]) -> Option<Vec<f64>> {
        self.differentiate_twice(depth);
        let (n, s) = (self.bodies.dof(), self.rule.unknown_nodes());
        let right = DVector::from_fn(s * n, |row, _| -residual[(row % n) * s + row / n]);
        let x = self.factor().solve(&right)?;
        Some((0..s * n).map(|k| x[(k % s) * n + k / s]).collect())
    }

    /// `[A | B]` of the step, `2n x 3n`, in `(q, p)` with held inputs; `None` if `J` is singular.
    pub fn linearization(&mut self, depth: Depth) -> Option<DMatrix<f64>> {
        self.differentiate_twice(depth);
        let (n, s) = (self.bodies.dof(), self.rule.unknown_nodes());
        let w = self.rule.weights();
        let mut right = DMatrix::zeros(s * n, 3 * n);
        for alpha in 0..s {
            right.view_mut((alpha * n, 0), (n, n)).copy_from(&-self.block(alpha, 0));
            for i in 0..n {
                if alpha == 0 {
                    right[(i, n + i)] = -1.0;
                }
                right[(alpha * n + i, 2 * n + i)] = -w[alpha] * self.time_step;
            }
        }
        let z = self.factor().solve(&right)?;
        let mut out = DMatrix::zeros(2 * n, 3 * n);
        out.view_mut((0, 0), (n, 3 * n)).copy_from(&z.view(((s - 1) * n, 0), (n, 3 * n)));
        let mut rows = DMatrix::zeros(n, 3 * n);
        rows.view_mut((0, 0), (n, n)).copy_from(&self.block(s, 0));
        for gamma in 1..=s {
            rows.gemm(1.0, &self.block(s, gamma), &z.view(((gamma - 1) * n, 0), (n, 3 * n)), 1.0);
        }
        for i in 0..n {
            rows[(i, 2 * n + i)] += w[s] * self.time_step;
        }
        out.view_mut((n, 0), (n, 3 * n)).copy_from(&rows);
        Some(out)
    }
}

fn forward_gradient(bodies: &RigidBodies, at: &[f64], out: &mut [f64]) {
    let n = bodies.dof();
    let mut memory = Vec::with_capacity(n);
    let mut x: Vec<DualSVec64<WIDTH>> = at.iter().map(|&v| v.into()).collect();
    for first in (0..2 * n).step_by(WIDTH) {
        let chunk = WIDTH.min(2 * n - first);
        for k in 0..chunk {
            x[first + k] = DualSVec64::from(at[first + k]).derivative(k);
        }
        let (q, v) = x.split_at(n);
        let eps = lagrangian(bodies, q, v, &mut memory).eps.0;
        for k in 0..chunk {
            out[first + k] = eps.map_or(0.0, |e| e[k]);
            x[first + k] = at[first + k].into();
        }
    }
}

fn hyper_dual_hessian(bodies: &RigidBodies, at: &[f64], out: &mut DMatrix<f64>) {
    type Hyper = HyperDualSVec64<HYPER, HYPER>;
    let n = bodies.dof();
    let mut memory = Vec::with_capacity(n);
    let mut x: Vec<Hyper> = at.iter().map(|&v| v.into()).collect();
    for first in (0..2 * n).step_by(HYPER) {
        let rows = HYPER.min(2 * n - first);
        for second in (first..2 * n).step_by(HYPER) {
            let columns = HYPER.min(2 * n - second);
            for k in 0..rows {
                x[first + k] = x[first + k].derivative1(k);
            }
            for k in 0..columns {
                x[second + k] = x[second + k].derivative2(k);
            }
            let (q, v) = x.split_at(n);
            let block = lagrangian(bodies, q, v, &mut memory).eps1eps2.0;
            for r in 0..rows {
                for c in 0..columns {
                    let value = block.map_or(0.0, |b| b[(r, c)]);
                    out[(first + r, second + c)] = value;
                    out[(second + c, first + r)] = value;
                }
            }
            for k in 0..HYPER.min(2 * n - first) {
                x[first + k] = at[first + k].into();
            }
            for k in 0..columns {
                x[second + k] = at[second + k].into();
            }
        }
    }
}

fn dual_hessian(bodies: &RigidBodies, at: &[f64], out: &mut DMatrix<f64>) {
    let n = bodies.dof();
    let mut memory = Vec::with_capacity(n);
    let mut wrenches = Vec::with_capacity(n);
    let mut x: Vec<DualSVec64<WIDTH>> = at.iter().map(|&v| v.into()).collect();
    let mut by = x.clone();
    for first in (0..2 * n).step_by(WIDTH) {
        let chunk = WIDTH.min(2 * n - first);
        for k in 0..chunk {
            x[first + k] = DualSVec64::from(at[first + k]).derivative(k);
        }
        let (q, v) = x.split_at(n);
        let (by_q, by_v) = by.split_at_mut(n);
        gradient(bodies, q, v, &mut memory, &mut wrenches, by_q, by_v);
        for row in 0..2 * n {
            for k in 0..chunk {
                out[(row, first + k)] = by[row].eps.0.map_or(0.0, |e| e[k]);
            }
        }
        for k in 0..chunk {
            x[first + k] = at[first + k].into();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pendulum::{Links, Uniform, pendulum};
    use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
    use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};

    fn largest(a: &[f64], b: &[f64]) -> f64 {
        let size = b.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        a.iter().zip(b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs())) / size
    }

    /// Residual, Newton direction and linearisation are those of the recursions, at both depths.
    #[test]
    fn both_depths_agree_with_the_recursions() {
        let (n, h) = (5, 0.02);
        let tree = pendulum(Links::Rods, n).unwrap();
        for s in [1, 2, 3] {
            let rule = LobattoRule::new(s).unwrap();
            let mut uniform = Uniform::new(5);
            let points: Vec<Vec<f64>> = (0..=s).map(|_| uniform.vector(n, 0.5)).collect();
            let momentum = uniform.vector(n, 2.0);
            let mut automatic = Automatic::new(&tree, &rule, h).unwrap();
            automatic.set(&points, &momentum);
            let options = StepOptions { method: Some(NewtonMethod::Recursive), ..StepOptions::default() };
            let mut integrator = Integrator::new(&tree, &rule, h, options).unwrap();
            let mut state = State::zeros(&tree);
            state.q.copy_from_slice(&points[0]);
            state.p.copy_from_slice(&momentum);
            let zero = vec![0.0; n];
            let mut del = DelWorkspace::new(&tree, &rule, h, ForceCapacity::default()).unwrap();
            for work in [&mut del, integrator.del_and_solver().0] {
                work.begin(&tree, &state, &StepForces::held(&zero)).unwrap();
                for alpha in 1..=s {
                    for i in 0..n {
                        work.set_node(alpha, i, points[alpha][i]);
                    }
                }
                work.evaluate(&tree, &[]);
            }
            let mut residual = vec![0.0; s * n];
            del.residual_into(&tree, &mut residual);
            let mut solver = NewtonSolver::new(NewtonMethod::Recursive, &tree, &del);
            solver.factor(&tree, &del).unwrap();
            let mut direction: Vec<f64> = residual.iter().map(|r| -r).collect();
            solver.solve(&tree, &mut direction);
            let mut work =
                Linearizer::new(&tree, &integrator, StateCoordinates::Momentum, InputHold::Held).unwrap();
            work.linearize_by_recursion(&tree, &mut integrator).unwrap();
            let linear = work.linear_step();
            for depth in [Depth::Lagrangian, Depth::Gradient] {
                let rows = automatic.residual(depth);
                assert!(largest(&rows, &residual) < 1e-13, "{depth:?} {s}");
                let step = automatic.newton_direction(depth, &rows).unwrap();
                assert!(largest(&step, &direction) < 1e-10, "{depth:?} {s}");
                let ab = automatic.linearization(depth).unwrap();
                let size = ab.amax();
                for r in 0..2 * n {
                    for c in 0..3 * n {
                        let ours = linear.matrix().get(r, c);
                        assert!((ab[(r, c)] - ours).abs() < 1e-10 * size, "{depth:?} {s}: {r} {c}");
                    }
                }
            }
        }
    }
}
