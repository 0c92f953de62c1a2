//! Algorithms 1, 2 and 3 at one node, on a generic scalar.
//!
//! | letter | here | meaning |
//! |---|---|---|
//! | `S_i`, `Ṡ_i` | `twist`, `twist_rate` | joint twist in frame {0} and its rate, `Ṡ_i = ad_{v_i} S_i` |
//! | `v_i, μ_i` | `velocity`, `momentum` | spatial velocity; momentum of the body and all it carries |
//! | `𝓜_i` | `first_moment`, `rotational` | composite inertia about the origin of {0} |
//! | `A_i = 𝓜_i S_i`, `B_i = 𝓜_i Ṡ_i - ad^D_{μ_i} S_i` | | Algorithm 2 |
//! | `σA_i = g × (σm_i n_i - σp_i × s_i)` | | Algorithm 3 |
//!
//! ```text
//! L_q̇[i] = S_iᵀ μ_i                      L_q[i] = Ṡ_iᵀ μ_i + S_iᵀ Γ_i        Γ_i = Σ_subtree [m p × g; m g]
//! for j on the branch of i:  L_q̇q̇ = S_jᵀ A_i   L_q̇iqj = Ṡ_jᵀ A_i   L_q̇jqi = S_jᵀ B_i   L_qq = Ṡ_jᵀ B_i - s_jᵀ σA_i
//! ```
//!
//! On [`crate::scalar::Dual`] numbers at `(q + ε η, q̇ + ε ν)` the ε-part of the pairs is the Hessian of the directional
//! derivative `η·L_q + ν·L_q̇`: with `η = y_β`, `ν = Σ_α b^{βα} y_α / Δt` and the quadrature weights, of `y·DEL`.
//!
//! Cost: O(Σ depth) per lane. Checked against the SIMD kernels of `delmpc_mechanics` and by differences.
//!
//! Source: the paper, Algorithms 1 to 3 (with the errata that `delmpc_mechanics` lists).

use delmpc_mechanics::tree::{JointKind, KinematicTree};
use nalgebra::Matrix3;

use crate::error::PlanError;
use crate::scalar::{Scalar, cross, difference, dot, rotate_constant, sum, times, times_constant};

/// Constants of one body; lengths from link origins, in the axes named.
#[derive(Clone, Debug)]
struct BodyConstants {
    parent: Option<usize>,
    revolute: bool,
    /// Rotation to the parent's axes is `e0 + sin q e1 + (1 - cos q) e2`, row-major.
    e0: [f64; 9],
    e1: [f64; 9],
    e2: [f64; 9],
    /// Joint axis, parent's axes.
    axis: [f64; 3],
    /// Joint origin from the parent's link origin, parent's axes.
    origin: [f64; 3],
    /// Mass centre, own axes.
    com: [f64; 3],
    mass: f64,
    subtree_mass: f64,
    /// About the mass centre, own axes, row-major.
    inertia: [f64; 9],
}

/// The constants of a tree as the node recursions use them.
#[derive(Clone, Debug)]
pub struct NodeModel {
    bodies: Vec<BodyConstants>,
    branches: Vec<Vec<usize>>,
    pair_starts: Vec<usize>,
    gravity: [f64; 3],
    /// Viscous damping of every coordinate.
    pub damping: Vec<f64>,
    /// Spring stiffness of every coordinate.
    pub stiffness: Vec<f64>,
    /// Rest position of every spring.
    pub rest: Vec<f64>,
    total_mass: f64,
}

impl NodeModel {
    /// Takes the constants of a fixed-base tree (a floating base as virtual joints: [`crate::robot`]).
    ///
    /// # Errors
    /// [`PlanError::Unsupported`] for a chart-free floating base, body drag or body wrenches.
    pub fn new(tree: &KinematicTree) -> Result<Self, PlanError> {
        if tree.is_floating() {
            return Err(PlanError::Unsupported {
                what: "a chart-free floating base: give it virtual joints",
            });
        }
        let count = tree.body_count();
        let mut subtree_mass: Vec<f64> = tree.bodies().iter().map(|body| body.inertia.mass).collect();
        let mut bodies = Vec::with_capacity(count);
        for i in (0..count).rev() {
            if let Some(parent) = tree.bodies()[i].parent {
                subtree_mass[parent] += subtree_mass[i];
            }
        }
        for (i, body) in tree.bodies().iter().enumerate() {
            if body.drag.amax() > 0.0 || body.constant_wrench_b.to_vector().amax() > 0.0 {
                return Err(PlanError::Unsupported { what: "drag or a constant wrench on a body" });
            }
            let joint = &body.joint;
            let rotation = joint.placement.rotation;
            let axis = joint.axis;
            let hat = Matrix3::new(0.0, -axis.z, axis.y, axis.z, 0.0, -axis.x, -axis.y, axis.x, 0.0);
            let row_major = |m: Matrix3<f64>| {
                let mut out = [0.0; 9];
                out.copy_from_slice(m.transpose().as_slice());
                // Round-off of a rotation given in radians would cost a multiplication each.
                out.map(|x: f64| if x.abs() < 1e-15 { 0.0 } else { x })
            };
            bodies.push(BodyConstants {
                parent: body.parent,
                revolute: joint.kind == JointKind::Revolute,
                e0: row_major(rotation),
                e1: row_major(rotation * hat),
                e2: row_major(rotation * hat * hat),
                axis: (rotation * axis).into(),
                origin: joint.placement.translation.into(),
                com: body.inertia.com.into(),
                mass: body.inertia.mass,
                subtree_mass: subtree_mass[i],
                inertia: row_major(body.inertia.inertia),
            });
        }
        let branches: Vec<Vec<usize>> =
            (0..count).map(|i| tree.branch(i).iter().map(|&j| j as usize).collect()).collect();
        let mut pair_starts = vec![0];
        for branch in &branches {
            pair_starts.push(pair_starts[pair_starts.len() - 1] + branch.len());
        }
        let of_joints = |f: fn(&delmpc_mechanics::tree::Joint) -> f64| {
            tree.bodies().iter().map(|body| f(&body.joint)).collect()
        };
        Ok(Self {
            bodies,
            branches,
            pair_starts,
            gravity: (*tree.gravity_w()).into(),
            damping: of_joints(|joint| joint.damping),
            stiffness: of_joints(|joint| joint.stiffness),
            rest: of_joints(|joint| joint.rest),
            total_mass: tree.total_mass(),
        })
    }

    /// Number of coordinates.
    pub fn dof(&self) -> usize {
        self.bodies.len()
    }

    /// Coordinates on the branch of a body, root first, its own last.
    pub fn branch(&self, body: usize) -> &[usize] {
        &self.branches[body]
    }

    /// Mass of the robot, kg.
    pub fn total_mass(&self) -> f64 {
        self.total_mass
    }

    /// Magnitude of gravity, m/s².
    pub fn gravity(&self) -> f64 {
        self.gravity.iter().map(|x| x * x).sum::<f64>().sqrt()
    }
}

/// What is known of a body at the nodes.
#[derive(Clone, Copy, Debug)]
pub struct BodyState<T> {
    /// Link axes, row-major.
    pub rotation: [T; 9],
    /// Link origin.
    pub origin: [T; 3],
    /// `S_i`, angular and linear part.
    pub twist: ([T; 3], [T; 3]),
    twist_rate: ([T; 3], [T; 3]),
    velocity: ([T; 3], [T; 3]),
    momentum: ([T; 3], [T; 3]),
    first_moment: [T; 3],
    rotational: [T; 6],
}

/// Second derivatives of `L` for coordinate `i` and a coordinate `j` of its branch.
#[derive(Clone, Copy, Debug)]
pub struct Pair<T> {
    /// `∂²L/∂q̇_i∂q̇_j`.
    pub rates: T,
    /// `∂²L/∂q̇_i∂q_j`.
    pub own_rate: T,
    /// `∂²L/∂q̇_j∂q_i`.
    pub other_rate: T,
    /// `∂²L/∂q_i∂q_j`.
    pub positions: T,
}

/// Results of the recursions; allocated once.
#[derive(Clone, Debug)]
pub struct NodeWork<T> {
    /// Every body.
    pub bodies: Vec<BodyState<T>>,
    /// `L_q`.
    pub by_position: Vec<T>,
    /// `L_q̇`, the momentum.
    pub by_rate: Vec<T>,
    pairs: Vec<Pair<T>>,
    pair_starts: Vec<usize>,
}

impl<T: Scalar> NodeWork<T> {
    /// Creates the workspace of a model.
    pub fn new(model: &NodeModel) -> Self {
        let zero = ([T::ZERO; 3], [T::ZERO; 3]);
        let body = BodyState {
            rotation: [T::ZERO; 9],
            origin: [T::ZERO; 3],
            twist: zero,
            twist_rate: zero,
            velocity: zero,
            momentum: zero,
            first_moment: [T::ZERO; 3],
            rotational: [T::ZERO; 6],
        };
        let pair = Pair { rates: T::ZERO, own_rate: T::ZERO, other_rate: T::ZERO, positions: T::ZERO };
        let count = model.bodies.len();
        Self {
            bodies: vec![body; count],
            by_position: vec![T::ZERO; count],
            by_rate: vec![T::ZERO; count],
            pairs: vec![pair; model.pair_starts[count]],
            pair_starts: model.pair_starts.clone(),
        }
    }

    /// Second derivatives of coordinate `i` with the coordinates of its branch, in the order of [`NodeModel::branch`].
    #[inline(always)]
    pub fn pairs(&self, i: usize) -> &[Pair<T>] {
        &self.pairs[self.pair_starts[i]..self.pair_starts[i + 1]]
    }

    /// Poses and joint twists at `q`, velocities at `q̇`; `L_q`, `L_q̇`; with `second` also the pairs.
    #[inline(always)]
    pub fn evaluate(&mut self, model: &NodeModel, q: &[T], q_dot: &[T], second: bool) {
        self.outward(model, q, q_dot);
        self.inward(model, second);
        for i in 0..model.bodies.len() {
            let body = &self.bodies[i];
            let (s, n) = body.twist;
            let (ds, dn) = body.twist_rate;
            let (angular, linear) = body.momentum;
            self.by_rate[i] = dot(s, angular) + dot(n, linear);
            let (torque, force) = gravity_wrench(model, i, body.first_moment);
            let weight = dot(s, torque) + dot(n, force);
            self.by_position[i] = dot(ds, angular) + dot(dn, linear) + weight;
            if second {
                self.fill_pairs(model, i);
            }
        }
    }

    #[inline(always)]
    fn outward(&mut self, model: &NodeModel, q: &[T], q_dot: &[T]) {
        for (i, constants) in model.bodies.iter().enumerate() {
            let mut axis = [T::ZERO; 3];
            let mut origin = [T::ZERO; 3];
            let mut velocity = ([T::ZERO; 3], [T::ZERO; 3]);
            let mut local = [T::ZERO; 9];
            let (sin, cos) = if constants.revolute { q[i].sin_cos() } else { (T::ZERO, T::constant(1.0)) };
            let versine = T::constant(1.0) - cos;
            for k in 0..9 {
                local[k] = T::constant(constants.e0[k]);
                if constants.revolute {
                    local[k] += sin.scale(constants.e1[k]) + versine.scale(constants.e2[k]);
                }
            }
            let rotation = match constants.parent {
                None => {
                    for k in 0..3 {
                        axis[k] = T::constant(constants.axis[k]);
                        origin[k] = T::constant(constants.origin[k]);
                    }
                    local
                }
                Some(parent) => {
                    let parent = &self.bodies[parent];
                    axis = rotate_constant(&parent.rotation, &constants.axis);
                    origin = sum(parent.origin, rotate_constant(&parent.rotation, &constants.origin));
                    velocity = parent.velocity;
                    if constants.revolute {
                        let mut product = times_constant(&parent.rotation, &constants.e0);
                        let by_sin = times_constant(&parent.rotation, &constants.e1);
                        let by_versine = times_constant(&parent.rotation, &constants.e2);
                        for k in 0..9 {
                            product[k] += sin * by_sin[k] + versine * by_versine[k];
                        }
                        product
                    } else {
                        times_constant(&parent.rotation, &constants.e0)
                    }
                }
            };
            let body = &mut self.bodies[i];
            if constants.revolute {
                body.twist = (axis, cross(origin, axis));
            } else {
                origin = sum(origin, times(axis, q[i]));
                body.twist = ([T::ZERO; 3], axis);
            }
            let (s, n) = body.twist;
            velocity = (sum(velocity.0, times(s, q_dot[i])), sum(velocity.1, times(n, q_dot[i])));
            let (w, v) = velocity;
            body.twist_rate = (cross(w, s), sum(cross(v, s), cross(w, n)));
            (body.rotation, body.origin, body.velocity) = (rotation, origin, velocity);
            own_inertia(constants, body);
        }
    }

    #[inline(always)]
    fn inward(&mut self, model: &NodeModel, second: bool) {
        for i in (0..model.bodies.len()).rev() {
            if let Some(parent) = model.bodies[i].parent {
                let (head, tail) = self.bodies.split_at_mut(i);
                let (parent, body) = (&mut head[parent], &tail[0]);
                parent.momentum =
                    (sum(parent.momentum.0, body.momentum.0), sum(parent.momentum.1, body.momentum.1));
                parent.first_moment = sum(parent.first_moment, body.first_moment);
                if second {
                    for k in 0..6 {
                        parent.rotational[k] += body.rotational[k];
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn fill_pairs(&mut self, model: &NodeModel, i: usize) {
        let body = &self.bodies[i];
        let mass = model.bodies[i].subtree_mass;
        let (s, n) = body.twist;
        let (a_torque, a_force) = composite_times(mass, body, body.twist);
        let (mut b_torque, mut b_force) = composite_times(mass, body, body.twist_rate);
        let (angular, linear) = body.momentum;
        b_torque = difference(b_torque, sum(cross(angular, s), cross(linear, n)));
        b_force = difference(b_force, cross(linear, s));
        let g = model.gravity.map(T::constant);
        let sigma = cross(g, difference(times(n, T::constant(mass)), cross(body.first_moment, s)));
        let start = self.pair_starts[i];
        for (position, &j) in model.branches[i].iter().enumerate() {
            let other = &self.bodies[j];
            let (sj, nj) = other.twist;
            let (dsj, dnj) = other.twist_rate;
            self.pairs[start + position] = Pair {
                rates: dot(sj, a_torque) + dot(nj, a_force),
                own_rate: dot(dsj, a_torque) + dot(dnj, a_force),
                other_rate: dot(sj, b_torque) + dot(nj, b_force),
                positions: dot(dsj, b_torque) + dot(dnj, b_force) - dot(sj, sigma),
            };
        }
    }
}

/// `Γ_i = [σp × g; σm g]`.
#[inline(always)]
fn gravity_wrench<T: Scalar>(model: &NodeModel, i: usize, first_moment: [T; 3]) -> ([T; 3], [T; 3]) {
    let g = model.gravity;
    let force = g.map(|x| T::constant(x * model.bodies[i].subtree_mass));
    (cross(first_moment, g.map(T::constant)), force)
}

/// `𝓜 x = [J s + h × n; m n - h × s]`.
#[inline(always)]
fn composite_times<T: Scalar>(mass: f64, body: &BodyState<T>, (s, n): ([T; 3], [T; 3])) -> ([T; 3], [T; 3]) {
    let j = &body.rotational;
    let js = [
        j[0] * s[0] + j[3] * s[1] + j[4] * s[2],
        j[3] * s[0] + j[1] * s[1] + j[5] * s[2],
        j[4] * s[0] + j[5] * s[1] + j[2] * s[2],
    ];
    let h = body.first_moment;
    (sum(js, cross(h, n)), difference(times(n, T::constant(mass)), cross(h, s)))
}

/// Inertia of the body itself about the origin of {0} (xx, yy, zz, xy, xz, yz) and its momentum.
#[inline(always)]
fn own_inertia<T: Scalar>(constants: &BodyConstants, body: &mut BodyState<T>) {
    if constants.mass == 0.0 {
        body.momentum = ([T::ZERO; 3], [T::ZERO; 3]);
        body.first_moment = [T::ZERO; 3];
        body.rotational = [T::ZERO; 6];
        return;
    }
    let r = &body.rotation;
    let c = sum(body.origin, rotate_constant(r, &constants.com));
    let h = c.map(|x| x.scale(constants.mass));
    let ri = times_constant(r, &constants.inertia);
    let entry = |a: usize, b: usize| {
        ri[3 * a] * r[3 * b] + ri[3 * a + 1] * r[3 * b + 1] + ri[3 * a + 2] * r[3 * b + 2]
    };
    let (xx, yy, zz) = (h[0] * c[0], h[1] * c[1], h[2] * c[2]);
    body.first_moment = h;
    body.rotational = [
        entry(0, 0) + yy + zz,
        entry(1, 1) + xx + zz,
        entry(2, 2) + xx + yy,
        entry(0, 1) - h[0] * c[1],
        entry(0, 2) - h[0] * c[2],
        entry(1, 2) - h[1] * c[2],
    ];
    body.momentum = composite_times(constants.mass, body, body.velocity);
}
