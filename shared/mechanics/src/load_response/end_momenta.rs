//! How loads change the momenta at the end of a step, and the velocities of points, in lanes.
//!
//! Letters and equations: [`super`].

use nalgebra::{Matrix6, Vector6};

use super::boundary_motion::BoundaryMotion;
use super::{BodyColumns, LoadPoint};
use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::lanes::{
    Kernel, Lane, Lane3, Lane6, Simd, add, bracket, cross, cross_add, dot6, dual_bracket, halves, join, load,
    load_strided, scale, scale_add, splat, store, sub, sym_vec,
};
use crate::newton_direction::base_matrix;
use crate::row_matrix::RowMatrix;
use crate::spatial::{SpatialInertia, Twist, Wrench};
use crate::tree::{KinematicTree, NO_PARENT};

/// `Σ_γ H[s,γ] X^γ` of the joint rows and `Σ_γ ∂P^1/∂q^γ X^γ` (without the rigid shift) of the base rows.
pub(super) struct EndMomenta<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) hessian: &'a DelHessian,
    pub(super) nodes: &'a RowMatrix,
    pub(super) ends: &'a mut RowMatrix,
}

impl Kernel for EndMomenta<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, hessian, nodes, ends } = self;
        let s = hessian.s;
        let stride = nodes.stride();
        ends.clear();
        for i in tree.first_joint_body()..tree.body_count() {
            let dof = tree.joint_dof(i);
            let first_pair = hessian.pair_starts[i];
            for (position, &column) in tree.branch(i).iter().enumerate() {
                let j = column as usize;
                let pair = first_pair + position;
                for gamma in 1..=s {
                    let mut entry = hessian.entry(pair, s, gamma);
                    if j < tree.base_dof() && gamma == s {
                        entry -= hessian.entry(pair, s, 0);
                    }
                    accumulate(simd, nodes, j * s + gamma - 1, entry, ends, dof, stride);
                    if j >= tree.base_dof() && j != dof {
                        let entry = hessian.mirrored(pair, s, gamma);
                        accumulate(simd, nodes, dof * s + gamma - 1, entry, ends, j, stride);
                    }
                }
            }
            if tree.is_floating() {
                for gamma in 1..=s {
                    let impulse = hessian.impulse_column(dof, gamma);
                    for (row, factor) in impulse.into_iter().enumerate() {
                        accumulate(simd, nodes, dof * s + gamma - 1, factor, ends, row, stride);
                    }
                }
            }
        }
    }
}

#[inline(always)]
pub(super) fn accumulate<S: Simd>(
    simd: S,
    source: &RowMatrix,
    from: usize,
    factor: f64,
    target: &mut RowMatrix,
    to: usize,
    stride: usize,
) {
    let factor = Lane::splat(simd, factor);
    let source = &source.quads()[from * stride..(from + 1) * stride];
    let target = &mut target.quads_mut()[to * stride..(to + 1) * stride];
    for (t, x) in target.iter_mut().zip(source) {
        *t = factor.mul_add(Lane::load(simd, x), Lane::load(simd, t)).quad();
    }
}

/// The base's part of the end momenta, and its variation `η^s = (S^0 + S^s) δξ^s`.
pub(super) fn base_end(
    del: &DelWorkspace,
    hessian: &DelHessian,
    nodes: &RowMatrix,
    ends: &mut RowMatrix,
    base_twists: &mut RowMatrix,
    tree: &KinematicTree,
) {
    let s = del.unknown_nodes();
    let (start, end) = (base_matrix(del, 0), base_matrix(del, s));
    // Response of P^1 to δξ^γ; that of γ = s includes node 0 and the rigid shift S^0 δξ^s of the chart centre.
    let impulse_at = |gamma: usize| Matrix6::from_fn(|r, k| hessian.impulse_column(k, gamma)[r]);
    let mut shift = Matrix6::zeros();
    for alpha in 0..=s {
        let rows = Matrix6::from_fn(|k, c| hessian.shift_row(k, alpha)[c]);
        let gain = base_matrix(del, alpha).transpose().lu().solve(&rows).unwrap_or_else(Matrix6::zeros);
        let (_, impulse) = del.body_momentum_and_impulse(0, alpha);
        let turned = Matrix6::from_fn(|r, c| {
            impulse.dual_bracket(&Twist::from_vector(&Vector6::ith(c, 1.0))).to_vector()[r]
        });
        shift += gain - turned;
    }
    let last = impulse_at(s) - impulse_at(0) + shift * start;
    for c in 0..nodes.columns() {
        let mut change = Vector6::from_fn(|r, _| ends.get(r, c));
        for gamma in 1..=s {
            let xi = Vector6::from_fn(|k, _| nodes.get(k * s + gamma - 1, c));
            if gamma < s {
                change += impulse_at(gamma) * xi;
            } else {
                change += last * xi;
                let rigid = start * xi;
                let eta = rigid + end * xi;
                for r in 0..6 {
                    base_twists.set(r, c, eta[r]);
                }
                for i in 1..tree.body_count() {
                    let dof = tree.joint_dof(i);
                    let row = hessian.shift_row(dof, s);
                    let sum: f64 = row.iter().zip(rigid.iter()).map(|(a, b)| a * b).sum();
                    ends.add(dof, c, sum);
                }
            }
        }
        for r in 0..6 {
            ends.set(r, c, change[r]);
        }
    }
}

#[inline(always)]
pub(super) fn twist_lanes<S: Simd>(simd: S, twist: &Twist) -> Lane6<S> {
    join(splat(simd, &twist.angular.into()), splat(simd, &twist.linear.into()))
}

/// `ends -= κ`, and `η, ν` of all bodies, for one quad of columns.
pub(super) struct MomentumTransport<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) motion: &'a BoundaryMotion,
    pub(super) s: usize,
    pub(super) quad: usize,
    pub(super) nodes: &'a RowMatrix,
    pub(super) base_twists: &'a RowMatrix,
    pub(super) ends: &'a mut RowMatrix,
    pub(super) columns: &'a mut [BodyColumns],
}

impl Kernel for MomentumTransport<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, motion, s, quad, nodes, base_twists, ends, columns } = self;
        let stride = nodes.stride();
        let kinematics = &motion.kinematics;
        let zero = [Lane::splat(simd, 0.0); 6];
        if tree.is_floating() {
            let eta: Lane6<S> = load_strided(simd, base_twists.quads(), quad, stride);
            let velocity = twist_lanes(simd, &kinematics.velocities_w()[0]);
            columns[0].eta = store(eta);
            columns[0].nu = store(bracket(velocity, eta));
        }
        for i in tree.first_joint_body()..tree.body_count() {
            let parent = tree.constants()[i].parent;
            let (eta, nu) = if parent == NO_PARENT {
                (zero, zero)
            } else {
                (load(simd, &columns[parent].eta), load(simd, &columns[parent].nu))
            };
            let dof = tree.joint_dof(i);
            let dq = Lane::load(simd, &nodes.quads()[(dof * s + s - 1) * stride + quad]);
            let twist = twist_lanes(simd, &kinematics.joint_twists_w()[i]);
            let rate = kinematics.velocities_w()[i].bracket(&kinematics.joint_twists_w()[i]);
            columns[i].eta = store(scale_add(dq, twist, eta));
            columns[i].nu = store(scale_add(dq, twist_lanes(simd, &rate), nu));
        }
        for i in 0..tree.body_count() {
            let nu = load(simd, &columns[i].nu);
            columns[i].d_momentum = store(inertia_times(simd, &motion.inertias_w[i], nu));
        }
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let d_momentum: Lane6<S> = load(simd, &columns[i].d_momentum);
            let twist = twist_lanes(simd, &kinematics.joint_twists_w()[i]);
            let dof = tree.joint_dof(i);
            let target = &mut ends.quads_mut()[dof * stride + quad];
            *target = (Lane::load(simd, target) - dot6(twist, d_momentum)).quad();
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let dq = Lane::load(simd, &nodes.quads()[(dof * s + s - 1) * stride + quad]);
                let momentum = momentum_lanes(simd, &motion.momenta_w[i]);
                let moved = sub(d_momentum, dual_bracket(momentum, scale(dq, twist)));
                columns[parent].d_momentum = store(add(load(simd, &columns[parent].d_momentum), moved));
            }
        }
        if tree.is_floating() {
            let momentum = momentum_lanes(simd, &motion.momenta_w[0]);
            let eta = load(simd, &columns[0].eta);
            let change = sub(load(simd, &columns[0].d_momentum), dual_bracket(momentum, eta));
            for (k, change) in change.into_iter().enumerate() {
                let target = &mut ends.quads_mut()[k * stride + quad];
                *target = (Lane::load(simd, target) - change).quad();
            }
        }
    }
}

#[inline(always)]
pub(super) fn momentum_lanes<S: Simd>(simd: S, momentum: &Wrench) -> Lane6<S> {
    join(splat(simd, &momentum.torque.into()), splat(simd, &momentum.force.into()))
}

#[inline(always)]
pub(super) fn inertia_times<S: Simd>(simd: S, inertia: &SpatialInertia, x: Lane6<S>) -> Lane6<S> {
    let (omega, linear) = halves(x);
    let j = &inertia.rotational;
    let rotational: Lane6<S> =
        splat(simd, &[j[(0, 0)], j[(1, 1)], j[(2, 2)], j[(0, 1)], j[(0, 2)], j[(1, 2)]]);
    let h: Lane3<S> = splat(simd, &inertia.first_moment.into());
    let force = sub(scale(Lane::splat(simd, inertia.mass), linear), cross(h, omega));
    join(cross_add(h, linear, sym_vec(&rotational, omega)), force)
}

/// Velocities of the points, for one quad of columns.
pub(super) struct PointVelocities<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) motion: &'a BoundaryMotion,
    pub(super) quad: usize,
    pub(super) ends: &'a RowMatrix,
    pub(super) columns: &'a [BodyColumns],
    pub(super) points: &'a [LoadPoint],
    pub(super) response: &'a mut [f64],
}

impl Kernel for PointVelocities<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, motion, quad, ends, columns, points, response } = self;
        let stride = ends.stride();
        let width = 3 * points.len();
        let mut last_body = usize::MAX;
        let mut change = [Lane::splat(simd, 0.0); 6];
        for (index, point) in points.iter().enumerate() {
            let velocity = twist_lanes(simd, &motion.kinematics.velocities_w()[point.body]);
            let eta: Lane6<S> = load(simd, &columns[point.body].eta);
            if point.body != last_body {
                last_body = point.body;
                change = sub(load(simd, &columns[point.body].nu), bracket(velocity, eta));
                for &dof in tree.branch(point.body) {
                    let dof = dof as usize;
                    let twist = twist_lanes(simd, &motion.kinematics.column_twist_w(tree, dof));
                    let rate = Lane::load(simd, &ends.quads()[dof * stride + quad]);
                    change = scale_add(rate, twist, change);
                }
            }
            let x: Lane3<S> = splat(simd, &motion.point_w(point).into());
            let (turned, shifted) = halves(eta);
            let moved = cross_add(turned, x, shifted);
            let (spin, slide) = halves(change);
            let point_velocity = cross_add(halves(velocity).0, moved, cross_add(spin, x, slide));
            for (row, lanes) in point_velocity.into_iter().enumerate() {
                let values = lanes.quad().0;
                for (lane, value) in values.into_iter().enumerate() {
                    let c = 4 * quad + lane;
                    if c < width {
                        response[(3 * index + row) * width + c] = value;
                    }
                }
            }
        }
    }
}
