//! The pass over the bodies: composite blocks of subtrees, dead loads, terms of the bodies themselves.
//!
//! Letters and equations: [`super`].

use super::pairs::{MAX_GROUPS, base_columns, base_pairs, joint_base_terms, joint_pairs};
use super::{DeadLanes, DelHessian, GeneralLanes, GeneralTerms};
use crate::del_residual::{DelWorkspace, load_arm};
use crate::floating_base::{BaseLanes, base_project};
use crate::gravity_hessian::gravity_column;
use crate::kinetic_hessian::{CompositeLanes, own_inertia};
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Quad, Simd, add, cross, dot3, dot6, dual_bracket, halves, join, load,
    load_strided, mat_tr_vec, outer, scale, splat, store, sub,
};
use crate::tree::{KinematicTree, NO_PARENT};

pub(super) struct Assemble<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) del: &'a DelWorkspace,
    pub(super) hessian: &'a mut DelHessian,
}

impl Kernel for Assemble<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // With constant arguments the loops over nodes unroll.
        match (self.hessian.s, self.hessian.groups) {
            (1, 1) if S::SPECIALISE => assemble::<S, 1>(simd, self, 1, 1),
            (2, 1) if S::SPECIALISE => assemble::<S, 1>(simd, self, 2, 1),
            (3, 1) if S::SPECIALISE => assemble::<S, 1>(simd, self, 3, 1),
            (s, groups) => assemble::<S, MAX_GROUPS>(simd, self, s, groups),
        }
    }
}

#[inline(always)]
pub(super) fn assemble<S: Simd, const G: usize>(simd: S, work: Assemble<'_>, s: usize, groups: usize) {
    let Assemble { tree, del, hessian } = work;
    for i in tree.first_joint_body()..tree.body_count() {
        joint_pairs::<S, G>(simd, tree, del, hessian, i, s, groups);
    }
}

pub(super) struct Composites<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) del: &'a DelWorkspace,
    pub(super) hessian: &'a mut DelHessian,
}

impl Kernel for Composites<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, del, hessian } = self;
        let groups = hessian.groups;
        composites(simd, tree, del, hessian, groups);
        if tree.is_floating() {
            for g in 0..groups {
                base_columns(simd, &del.base[g], hessian, groups, g);
                for i in tree.first_joint_body()..tree.body_count() {
                    joint_base_terms(simd, tree, del, hessian, i, g);
                }
            }
        }
    }
}

pub(super) struct BasePairs<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) del: &'a DelWorkspace,
    pub(super) hessian: &'a mut DelHessian,
}

impl Kernel for BasePairs<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, del, hessian } = self;
        let (s, groups) = (hessian.s, hessian.groups);
        // With constant arguments the loops over nodes unroll.
        match (s, groups) {
            (1, 1) if S::SPECIALISE => base_pairs::<S, 1>(simd, tree, del, hessian, 1, 1),
            (2, 1) if S::SPECIALISE => base_pairs::<S, 1>(simd, tree, del, hessian, 2, 1),
            (3, 1) if S::SPECIALISE => base_pairs::<S, 1>(simd, tree, del, hessian, 3, 1),
            (s, groups) => base_pairs::<S, MAX_GROUPS>(simd, tree, del, hessian, s, groups),
        }
        if !hessian.general.is_empty() {
            for i in 0..tree.body_count() {
                impulse_by_rate(simd, tree, del, hessian, i);
            }
        }
        project_on_base(simd, del, hessian);
    }
}

/// `S^0ᵀ` of the shift rows and `S^sᵀ` of the impulse columns.
#[inline(always)]
pub(super) fn project_on_base<S: Simd>(simd: S, del: &DelWorkspace, hessian: &mut DelHessian) {
    let s = hessian.s;
    let [start, end] = [0, s].map(|alpha| {
        let base = &del.base[alpha / LANES];
        let spread = |quad: &Quad| Quad::splat(quad.0[alpha % LANES]);
        let (z, position) = (base.z.each_ref().map(spread), base.position.each_ref().map(spread));
        BaseLanes { z, position, ..*base }
    });
    for (shift, on_base) in hessian.shift_rows.iter().zip(&mut hessian.shifts_on_base) {
        *on_base = store(base_project(simd, &start, load(simd, shift)));
    }
    for (impulse, on_base) in hessian.impulse_columns.iter().zip(&mut hessian.impulses_on_base) {
        *on_base = store(base_project(simd, &end, load(simd, impulse)));
    }
}

/// The part of `∂P^1/∂q^γ` that acts through the rates: `Σ_β w_β 𝒵^β S^β b^{βγ}`.
#[inline(always)]
pub(super) fn impulse_by_rate<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
) {
    let (groups, s) = (hessian.groups, hessian.s);
    let dofs = if tree.is_base(i) { 0..6 } else { tree.joint_dof(i)..tree.joint_dof(i) + 1 };
    for dof in dofs {
        for g_beta in 0..groups {
            let column = &hessian.columns[dof * groups + g_beta];
            let general = &hessian.general[i * groups + g_beta];
            let dragged = matrix_times(simd, &general.nu, load(simd, &column.twist));
            let dragged = scale(Lane::load(simd, &del.weights[g_beta]), dragged);
            for gamma in 0..=s {
                let table = Lane::load(simd, &del.derivative[gamma * groups + g_beta]);
                let target = &mut hessian.impulse_columns[dof * groups + gamma / LANES];
                for (t, x) in target.iter_mut().zip(store(scale(table, dragged))) {
                    t.0[gamma % LANES] += x.0.iter().sum::<f64>();
                }
            }
        }
    }
}

/// Sums over subtrees, leaves to root; column twists of the joints.
#[inline(always)]
pub(super) fn composites<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    groups: usize,
) {
    for (i, constants) in tree.constants().iter().enumerate() {
        for g in 0..groups {
            let at = i * groups + g;
            let (h, j) = own_inertia(simd, constants, &del.bodies[at]);
            hessian.composites[at] = CompositeLanes { first_moment: store(h), rotational: store(j) };
            if !tree.is_base(i) {
                // By registers: the compiler calls a function to copy structures of this size.
                let column = &mut hessian.columns[tree.joint_dof(i) * groups + g];
                column.twist = store(load(simd, &del.bodies[at].joint_twist));
                column.rate = store(load(simd, &del.bodies[at].joint_twist_rate));
            }
        }
    }
    if del.has_dead_loads() {
        own_dead_loads(simd, del, hessian, groups);
    }
    for (at, gain) in del.gains.iter().enumerate() {
        hessian.general[at] = GeneralLanes { wrench: gain.wrench, eta: gain.eta, nu: gain.nu };
    }
    for i in (tree.first_joint_body()..tree.body_count()).rev() {
        let parent = tree.constants()[i].parent;
        if parent == NO_PARENT {
            continue;
        }
        for g in 0..groups {
            let (at, to) = (i * groups + g, parent * groups + g);
            let (parents, own) = hessian.composites.split_at_mut(at);
            accumulate(simd, &mut parents[to].first_moment, &own[0].first_moment);
            accumulate(simd, &mut parents[to].rotational, &own[0].rotational);
            if del.has_dead_loads() {
                let own = hessian.dead[at];
                accumulate(simd, &mut hessian.dead[to].arm_cross, &own.arm_cross);
                accumulate(simd, &mut hessian.dead[to].force, &own.force);
            }
            if !hessian.general.is_empty() {
                let own = hessian.general[at];
                accumulate(simd, &mut hessian.general[to].wrench, &own.wrench);
                accumulate(simd, &mut hessian.general[to].eta, &own.eta);
                accumulate(simd, &mut hessian.general[to].nu, &own.nu);
            }
        }
    }
}

#[inline(always)]
pub(super) fn accumulate<S: Simd, const N: usize>(simd: S, target: &mut [Quad; N], term: &[Quad; N]) {
    for (t, x) in target.iter_mut().zip(term) {
        *t = (Lane::load(simd, t) + Lane::load(simd, x)).quad();
    }
}

#[inline(always)]
pub(super) fn own_dead_loads<S: Simd>(simd: S, del: &DelWorkspace, hessian: &mut DelHessian, groups: usize) {
    hessian.dead.fill(DeadLanes::default());
    for (index, load_) in del.loads.iter().enumerate() {
        for g in 0..groups {
            let at = load_.body * groups + g;
            let (force, arm) = load_arm(simd, load_, &del.load_forces[index * groups + g], &del.bodies[at]);
            // x^ f^ = f xᵀ - (x·f) 1
            let along = dot3(arm, force);
            let mut product = outer(force, arm);
            for k in 0..3 {
                product[4 * k] = product[4 * k] - along;
            }
            accumulate(simd, &mut hessian.dead[at].arm_cross, &store(product));
            if !load_.couple {
                accumulate(simd, &mut hessian.dead[at].force, &store(force));
            }
        }
    }
    for held in del.dead_torques() {
        for g in 0..groups {
            // τ^
            let arm_cross = &mut hessian.dead[held.body * groups + g].arm_cross;
            let [x, y, z] = load(simd, &held.torque_w[g]);
            for (at, value) in [(1, -z), (2, y), (3, z), (5, -x), (6, -y), (7, x)] {
                arm_cross[at] = (Lane::load(simd, &arm_cross[at]) + value).quad();
            }
        }
    }
}

/// `c` of a twist: `∂(Xᵀ F)/∂q_j = s_jᵀ c` for the subtree's forces of fixed direction.
#[inline(always)]
pub(super) fn fixed_direction_row<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &DelHessian,
    i: usize,
    at: usize,
    twist: Lane6<S>,
) -> Lane3<S> {
    let gravity: [f64; 3] = (*tree.gravity_w()).into();
    let mass = tree.constants()[i].subtree_mass;
    let h = load(simd, &hessian.composites[at].first_moment);
    let mut c = gravity_column(simd, &gravity, mass, h, twist);
    if del.has_dead_loads() {
        let (s, n) = halves(twist);
        let dead = &hessian.dead[at];
        let loaded = sub(mat_tr_vec(&load(simd, &dead.arm_cross), s), cross(load(simd, &dead.force), n));
        c = add(c, loaded);
    }
    c
}

/// `𝒴 x` for the subtree's forces of fixed direction, gravity included.
#[inline(always)]
pub(super) fn fixed_direction_gain<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &DelHessian,
    i: usize,
    at: usize,
    x: Lane6<S>,
) -> Lane6<S> {
    let gravity: Lane3<S> = splat(simd, &(*tree.gravity_w()).into());
    let turned = cross(gravity, halves(x).0);
    let h = load(simd, &hessian.composites[at].first_moment);
    let mass = Lane::splat(simd, tree.constants()[i].subtree_mass);
    let mut gain = join(cross(h, turned), scale(mass, turned));
    if del.has_dead_loads() {
        let dead = &hessian.dead[at];
        let s = halves(x).0;
        let upper = crate::lanes::mat_vec(&load(simd, &dead.arm_cross), s);
        gain = add(gain, join(upper, cross(load(simd, &dead.force), s)));
    }
    gain
}

#[inline(always)]
pub(super) fn matrix_times<S: Simd>(simd: S, m: &[Quad; 36], x: Lane6<S>) -> Lane6<S> {
    let mut out = x;
    for r in 0..6 {
        out[r] = dot6(load_strided(simd, m, 6 * r, 1), x);
    }
    out
}

#[inline(always)]
pub(super) fn matrix_tr_times<S: Simd>(simd: S, m: &[Quad; 36], x: Lane6<S>) -> Lane6<S> {
    let mut out = x;
    for c in 0..6 {
        out[c] = dot6(load_strided(simd, m, c, 6), x);
    }
    out
}

#[inline(always)]
pub(super) fn general_terms<S: Simd>(
    simd: S,
    general: &GeneralLanes,
    twist: Lane6<S>,
    rate: Lane6<S>,
) -> GeneralTerms<S> {
    let moved = add(matrix_times(simd, &general.nu, rate), matrix_times(simd, &general.eta, twist));
    GeneralTerms {
        row_pose: matrix_tr_times(simd, &general.eta, twist),
        row_rate: matrix_tr_times(simd, &general.nu, twist),
        column_pose: sub(moved, dual_bracket(load(simd, &general.wrench), twist)),
        column_rate: matrix_times(simd, &general.nu, twist),
    }
}
