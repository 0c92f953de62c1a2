//! Algorithm 1, from the root outward: poses, rates and momenta of the bodies at all nodes.
//!
//! Letters and equations: [`super`].

use super::DelWorkspace;
use crate::floating_base::base_kinematics;
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Lane9, Quad, Simd, cross, cross_add, halves, join, load, mat_mul,
    mat_tr_vec, mat_vec, mat_vec_add, scale, splat, store, sub, sym_vec,
};
use crate::real::sin_cos;
use crate::tree::{BodyConstants, KinematicTree, NO_PARENT};

/// A1.1: rates, poses, velocities, and each body's own momentum.
pub(super) struct Outward<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) workspace: &'a mut DelWorkspace,
    /// Take the rates from the nodes; otherwise they are given.
    pub(super) interpolate: bool,
}

impl Kernel for Outward<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, workspace, interpolate } = self;
        let groups = workspace.groups;
        let s = workspace.rule.unknown_nodes();
        if interpolate {
            rates(simd, &workspace.derivative, groups, s, &workspace.q, &mut workspace.q_dot);
        }
        for g in 0..groups {
            if tree.is_floating() {
                base_outward(simd, tree, workspace, g);
            }
            for i in tree.first_joint_body()..tree.body_count() {
                joint_outward(simd, tree, workspace, i, g);
            }
        }
    }
}

/// `q̇^α = (1/Δt) Σ_β b^{αβ} (q^β - q^0)`: the rows of `b` sum to zero.
#[inline(always)]
pub(crate) fn rates<S: Simd>(
    simd: S,
    derivative: &[Quad],
    groups: usize,
    s: usize,
    q: &[Quad],
    q_dot: &mut [Quad],
) {
    for (q, q_dot) in q.chunks_exact(groups).zip(q_dot.chunks_exact_mut(groups)) {
        for (g, rate) in q_dot.iter_mut().enumerate() {
            let mut sum = Lane::splat(simd, 0.0);
            for beta in 1..=s {
                let change = q[beta / LANES].0[beta % LANES] - q[0].0[0];
                let column = Lane::load(simd, &derivative[beta * groups + g]);
                sum = column.mul_add(Lane::splat(simd, change), sum);
            }
            *rate = sum.quad();
        }
    }
}

#[inline(always)]
pub(super) fn base_outward<S: Simd>(simd: S, tree: &KinematicTree, workspace: &mut DelWorkspace, g: usize) {
    let groups = workspace.groups;
    let xi: [Quad; 6] = core::array::from_fn(|k| workspace.q[k * groups + g]);
    let xi_dot: [Quad; 6] = core::array::from_fn(|k| workspace.q_dot[k * groups + g]);
    let rotation = workspace.center.rotation.transpose();
    let mut center = [0.0; 9];
    center.copy_from_slice(rotation.as_slice());
    let position: [f64; 3] = workspace.center.translation.into();
    let (r, p, v) = base_kinematics(simd, xi, xi_dot, &center, &position, &mut workspace.base[g]);
    let body = &mut workspace.bodies[g];
    body.rotation = store(r);
    body.position = store(p);
    body.velocity = store(v);
    body.momentum = store(own_momentum(simd, &tree.constants()[0], &r, p, v));
}

#[inline(always)]
pub(super) fn joint_outward<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    workspace: &mut DelWorkspace,
    i: usize,
    g: usize,
) {
    let groups = workspace.groups;
    let constants = &tree.constants()[i];
    let dof = tree.joint_dof(i) * groups + g;
    let start_q = workspace.start.q[tree.joint_dof(i) - tree.base_dof()];
    let change = &workspace.q[dof];
    let q_dot = Lane::load(simd, &workspace.q_dot[dof]);

    let mut e: Lane9<S> = splat(simd, &constants.e0);
    if constants.revolute {
        let start = workspace.start_sin_cos[tree.joint_dof(i) - tree.base_dof()];
        let (sin, versine) = sin_versine(simd, start_q, start, change);
        for k in 0..9 {
            let bend = versine.mul_add(Lane::splat(simd, constants.e2[k]), e[k]);
            e[k] = sin.mul_add(Lane::splat(simd, constants.e1[k]), bend);
        }
    }
    let joint_origin = splat(simd, &constants.joint_origin);
    let axis = splat(simd, &constants.axis);
    let com = splat(simd, &constants.com);
    let zero = Lane::splat(simd, 0.0);
    let (rotation, origin, axis, parent_velocity) = if constants.parent == NO_PARENT {
        (e, joint_origin, axis, [zero; 6])
    } else {
        let parent = &workspace.bodies[constants.parent * groups + g];
        let parent_rotation = load(simd, &parent.rotation);
        (
            mat_mul(&parent_rotation, &e),
            mat_vec_add(&parent_rotation, joint_origin, load(simd, &parent.position)),
            mat_vec(&parent_rotation, axis),
            load(simd, &parent.velocity),
        )
    };
    let mut position = mat_vec_add(&rotation, com, origin);
    let joint_twist = if constants.revolute {
        join(axis, cross(origin, axis))
    } else {
        let travel = Lane::load(simd, change) + Lane::splat(simd, start_q);
        position = crate::lanes::scale_add(travel, axis, position);
        join([zero; 3], axis)
    };
    let velocity = crate::lanes::scale_add(q_dot, joint_twist, parent_velocity);
    let momentum = own_momentum(simd, constants, &rotation, position, velocity);
    let body = &mut workspace.bodies[i * groups + g];
    body.rotation = store(rotation);
    body.position = store(position);
    body.joint_twist = store(joint_twist);
    // ad_{v_i} S_i = ad_{v_par} S_i, because S_i commutes with itself.
    body.joint_twist_rate = store(crate::lanes::bracket(parent_velocity, joint_twist));
    body.velocity = store(velocity);
    body.momentum = store(momentum);
}

/// Largest change of an angle (rad) for which the series below are exact to round-off.
pub(super) const SERIES_LIMIT: f64 = 0.5;
/// `(-1)^k / (2k+1)!`, k = 1..6, highest first: `sin d = d + d Σ ...`.
pub(super) const SINE: [f64; 6] =
    [1.0 / 6_227_020_800.0, -1.0 / 39_916_800.0, 1.0 / 362_880.0, -1.0 / 5_040.0, 1.0 / 120.0, -1.0 / 6.0];
/// `(-1)^k / (2k)!`, k = 1..7, highest first: `cos d - 1 = Σ ...`.
pub(super) const COSINE: [f64; 7] = [
    -1.0 / 87_178_291_200.0,
    1.0 / 479_001_600.0,
    -1.0 / 3_628_800.0,
    1.0 / 40_320.0,
    -1.0 / 720.0,
    1.0 / 24.0,
    -0.5,
];

/// `sin q` and `1 - cos q` at `q = start_q + change`, with `start = (sin, cos)` of `start_q`. Changes within a step are small: their series, added to the angle of the start by
/// the addition theorem, run in lanes; larger ones go one by one.
#[inline(always)]
pub(super) fn sin_versine<S: Simd>(
    simd: S,
    start_q: f64,
    start: (f64, f64),
    change: &Quad,
) -> (Lane<S>, Lane<S>) {
    if change.0.iter().all(|d| d.abs() <= SERIES_LIMIT) {
        let d = Lane::load(simd, change);
        let square = d * d;
        let (mut sine, mut cosine) = (Lane::splat(simd, SINE[0]), Lane::splat(simd, COSINE[0]));
        for k in 1..SINE.len() {
            sine = sine.mul_add(square, Lane::splat(simd, SINE[k]));
        }
        for k in 1..COSINE.len() {
            cosine = cosine.mul_add(square, Lane::splat(simd, COSINE[k]));
        }
        let sine = (sine * square).mul_add(d, d);
        let cosine = cosine * square;
        let (sin, cos) = (Lane::splat(simd, start.0), Lane::splat(simd, start.1));
        let versine = Lane::splat(simd, 1.0 - start.1);
        return (sin + sin.mul_add(cosine, cos * sine), versine + sin.mul_add(sine, -(cos * cosine)));
    }
    let (mut sin, mut versine) = (Quad::ZERO, Quad::ZERO);
    for lane in 0..LANES {
        let (s, c) = sin_cos(start_q + change.0[lane]);
        sin.0[lane] = s;
        versine.0[lane] = 1.0 - c;
    }
    (Lane::load(simd, &sin), Lane::load(simd, &versine))
}

/// `M_i v_i` of one body about the origin of {0}.
#[inline(always)]
pub(crate) fn own_momentum<S: Simd>(
    simd: S,
    constants: &BodyConstants,
    rotation: &Lane9<S>,
    position: Lane3<S>,
    velocity: Lane6<S>,
) -> Lane6<S> {
    let (omega, linear) = halves(velocity);
    let mass = Lane::splat(simd, constants.mass);
    let force = scale(mass, sub(linear, cross(position, omega)));
    let inertia: Lane6<S> = splat(simd, &constants.inertia);
    let spin = mat_vec(rotation, sym_vec(&inertia, mat_tr_vec(rotation, omega)));
    join(cross_add(position, force, spin), force)
}
