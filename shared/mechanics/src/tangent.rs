//! Algorithm T: the tangent of Algorithm 1, O(s n) per direction.
//!
//! Not in the printed paper; every derivative of the integrator is checked against it, and the strict O(n²) linearisation
//! ([`crate::linearize`]) is made of it.
//!
//! | letter | field | meaning (frame {0}, per node) |
//! |---|---|---|
//! | `δq`, `δq̇` | `dq`, `dq_dot` | variation of the nodes and their rates |
//! | `η_i` | `eta` | spatial variation of the pose, `δg = η^ g` |
//! | `ν_i` | `nu` | variation of the velocity without its transport, `δv = ν - ad_v η` |
//! | `Dμ, DΓ` | `d_momentum`, `d_impulse` | co-moving variations `DX = δX + ad^D_X η` |
//!
//! In frame {0} variations add up without any change of frame, and the co-moving form removes every bias term:
//!
//! ```text
//! outward  η_i = η_par + S δq      ν_i = ν_par + Ṡ δq + S δq̇
//! inward   Dμ_i = M_i ν_i + Σ_chd (Dμ_j - ad^D_{μ_j} S_j δq_j)
//!          DΓ_i = w_α Δt (F_η η_i + F_ν ν_i) + Σ_chd (DΓ_j - ad^D_{Γ_j} S_j δq_j)
//! rows     δr^α = w_α Δt [Sᵀ ad^D_μ ν + Ṡᵀ Dμ + ∂Q/∂q δq + ∂Q/∂q̇ δq̇] + Sᵀ DΓ + Σ_β a^{αβ} S^βᵀ Dμ^β            (L)
//! ```
//!
//! Proof sketch. `δS = ad_η S`, `δv = ν - ad_v η` and `δM = -ad_ηᵀ M - M ad_η` give `δ(Mv) = Mν - ad_ηᵀ Mv`, that is
//! `D(Mv) = Mν`; the Jacobi identity gives `δṠ = ad_ν S + ad_η Ṡ`; hence `δ(Sᵀμ) = Sᵀ Dμ` and
//! `δ(Ṡᵀμ) = Sᵀ ad^D_μ ν + Ṡᵀ Dμ`. The sum over children moves each wrench from `η_j` to `η_i = η_j - S_j δq_j`.
//! The floating base adds the terms `N, Ṅ` of [`crate::floating_base`]:
//!
//! ```text
//! δR^α = w_α Δt [Sᵀ ad^D_μ ν + Ṡᵀ Dμ + Ṅ(μ) δξ + N(μ) δξ̇] + Sᵀ DΓ + N(Γ) δξ + Σ_β a^{αβ} [Sᵀ Dμ + N(μ) δξ]^β
//! δr^0 = δR^0 + S^0ᵀ(δP^0 + ad^D_{P^0} η^0) + N^0(P^0) δξ^0 - δR^s|without Γ + S^sᵀ(δG + ad^D_G η^s) + N^s(G) δξ^s
//! δG   = δP^0 + Σ_{α<s} (DΓ^α - ad^D_{Γ^α} η^α)      δP^1 likewise with α <= s      η̄ = η^0 + S^0 δξ^s, δξ^0 = -δξ^s
//! ```

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use crate::del_residual::{DelWorkspace, load_arm, own_momentum, rates, weighted_sum};
use crate::floating_base::{
    apply_second_order, base_project, base_project_rate, base_twist, base_twist_rate, second_order,
    second_order_rate,
};
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Quad, Simd, add, cross, dot6, dual_bracket, halves, join, load,
    load_strided, scale, scale_add, store, sub,
};
use crate::spatial::{Twist, Wrench};
use crate::tree::{KinematicTree, NO_PARENT};

#[derive(Clone, Copy, Debug, Default)]
struct VariationLanes {
    eta: [Quad; 6],
    nu: [Quad; 6],
    d_momentum: [Quad; 6],
    d_impulse: [Quad; 6],
}

/// Direction in which the step is varied besides its nodes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StartVariation {
    /// Spatial variation `η^0` of the floating base at node 0, frame {0}.
    pub base_twist_w: Twist,
    /// Variation `δP^0` of the total spatial momentum, frame {0}.
    pub base_momentum_w: Wrench,
}

/// Workspace of Algorithm T. Set `dq` with [`TangentWorkspace::set`], run [`TangentWorkspace::evaluate`], read the rows.
#[derive(Clone, Debug)]
pub struct TangentWorkspace {
    groups: usize,
    s: usize,
    dq: Vec<Quad>,
    dq_dot: Vec<Quad>,
    bodies: Vec<VariationLanes>,
    rows: Vec<Quad>,
    projections: Vec<[Quad; 6]>,
    start: StartVariation,
}

impl TangentWorkspace {
    /// A workspace for steps of the same tree and rule as `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let groups = del.groups;
        Self {
            groups,
            s: del.unknown_nodes(),
            dq: vec![Quad::ZERO; tree.dof() * groups],
            dq_dot: vec![Quad::ZERO; tree.dof() * groups],
            bodies: vec![VariationLanes::default(); tree.body_count() * groups],
            rows: vec![Quad::ZERO; tree.dof() * groups],
            projections: vec![[Quad::ZERO; 6]; groups],
            start: StartVariation::default(),
        }
    }

    /// Sets every variation to zero.
    pub fn clear(&mut self) {
        self.dq.fill(Quad::ZERO);
        self.start = StartVariation::default();
    }

    /// Varies coordinate `dof` at node `alpha` (joints: 0..=s; base chart: 1..=s, node 0 follows).
    #[inline]
    pub fn set(&mut self, alpha: usize, dof: usize, value: f64) {
        self.dq[dof * self.groups + alpha / LANES].0[alpha % LANES] = value;
    }

    /// Varies where a floating base starts.
    pub fn set_start(&mut self, start: StartVariation) {
        self.start = start;
    }

    /// Algorithm T around the nodes last evaluated in `del`. O(s n), no allocation.
    pub fn evaluate(&mut self, tree: &KinematicTree, del: &DelWorkspace) {
        if tree.is_floating() {
            for k in 0..6 {
                let last = self.dq[k * self.groups + self.s / LANES].0[self.s % LANES];
                self.set(0, k, -last);
            }
        }
        del.instructions.dispatch(Tangent { tree, del, work: self });
    }

    /// `δr^α`, `α < s`, coordinate-major (`dof * s + α`), for joint forces and joint momenta held fixed.
    pub fn residual_into(&self, tree: &KinematicTree, del: &DelWorkspace, out: &mut [f64]) {
        let s = self.s;
        for dof in 0..tree.dof() {
            for alpha in 0..s {
                out[dof * s + alpha] = self.row(dof, alpha);
            }
        }
        if !tree.is_floating() {
            return;
        }
        let before_end = del.base_momentum_before_end();
        let d_before_end = self.start.base_momentum_w + self.impulse_change(del, s);
        let momentum = del.start_momentum();
        let first = self.project_variation(del, 0, &momentum, &self.start.base_momentum_w);
        let last = self.project_variation(del, s, &before_end, &d_before_end);
        for k in 0..6 {
            out[k * s] += first[k] + last[k] - self.row(k, s);
        }
    }

    /// Variation of the momenta at the end of the step: row s of the joints, `δP^1` of a floating base.
    pub fn next_momentum_into(&self, tree: &KinematicTree, del: &DelWorkspace, out: &mut [f64]) {
        for (dof, p) in out.iter_mut().enumerate().take(tree.dof()) {
            *p = self.row(dof, self.s);
        }
        if tree.is_floating() {
            let total = self.start.base_momentum_w + self.impulse_change(del, self.s + 1);
            out[..6].copy_from_slice(total.to_vector().as_slice());
        }
    }

    /// Spatial variation `η_i` of a body's pose at node `alpha`, frame {0}.
    pub fn body_variation(&self, body: usize, alpha: usize) -> Twist {
        let eta = &self.bodies[body * self.groups + alpha / LANES].eta;
        let at = |k: usize| eta[k].0[alpha % LANES];
        Twist { angular: Vector3::new(at(0), at(1), at(2)), linear: Vector3::new(at(3), at(4), at(5)) }
    }

    #[inline]
    fn row(&self, dof: usize, alpha: usize) -> f64 {
        self.rows[dof * self.groups + alpha / LANES].0[alpha % LANES]
    }

    /// `Σ_{α<count} (DΓ^α - ad^D_{Γ^α} η^α)` of the base.
    fn impulse_change(&self, del: &DelWorkspace, count: usize) -> Wrench {
        let mut total = Wrench::default();
        for alpha in 0..count {
            let lanes = &self.bodies[alpha / LANES];
            let at = |k: usize| lanes.d_impulse[k].0[alpha % LANES];
            let change = Wrench {
                torque: Vector3::new(at(0), at(1), at(2)),
                force: Vector3::new(at(3), at(4), at(5)),
            };
            let impulse = del.body_momentum_and_impulse(0, alpha).1;
            total += change - impulse.dual_bracket(&self.body_variation(0, alpha));
        }
        total
    }

    /// `δ(S^αᵀ X) = Sᵀ(δX + ad^D_X η) + N(X) δξ` of the base.
    fn project_variation(&self, del: &DelWorkspace, alpha: usize, x: &Wrench, dx: &Wrench) -> [f64; 6] {
        let moved = *dx + x.dual_bracket(&self.body_variation(0, alpha));
        let mut out = del.project_base(alpha, &moved);
        let curved = del.instructions.dispatch(SecondOrderAt { del, alpha, wrench: *x, dq: &self.dq });
        for k in 0..6 {
            out[k] += curved[k];
        }
        out
    }
}

/// `N^α(X) δξ^α` at one node.
struct SecondOrderAt<'a> {
    del: &'a DelWorkspace,
    alpha: usize,
    wrench: Wrench,
    dq: &'a [Quad],
}

impl Kernel for SecondOrderAt<'_> {
    type Output = [f64; 6];
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f64; 6] {
        let (g, lane) = (self.alpha / LANES, self.alpha % LANES);
        let wrench: [f64; 6] = self.wrench.to_vector().into();
        let n = second_order(simd, &self.del.base[g], crate::lanes::splat(simd, &wrench));
        let dq: Lane6<S> = load_strided(simd, self.dq, g, self.del.groups);
        store(apply_second_order(&n, dq)).map(|q| q.0[lane])
    }
}

struct Tangent<'a> {
    tree: &'a KinematicTree,
    del: &'a DelWorkspace,
    work: &'a mut TangentWorkspace,
}

impl Kernel for Tangent<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, del, work } = self;
        let groups = work.groups;
        rates(simd, &del.derivative, groups, work.s, &work.dq, &mut work.dq_dot);
        for g in 0..groups {
            if tree.is_floating() {
                base_variation(simd, del, work, g);
            }
            for i in tree.first_joint_body()..tree.body_count() {
                joint_variation(simd, tree, del, work, i, g);
            }
        }
        for i in 0..tree.body_count() {
            own_variations(simd, tree, del, work, i);
        }
        load_variations(simd, del, work);
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            inward(simd, tree, del, work, i);
        }
        if tree.is_floating() {
            base_rows(simd, del, work);
        }
    }
}

#[inline(always)]
fn base_variation<S: Simd>(simd: S, del: &DelWorkspace, work: &mut TangentWorkspace, g: usize) {
    let groups = work.groups;
    let s = work.s;
    // η̄ = η^0 + S^0 δξ^s = η^0 - S^0 δξ^0: the same twist at every node.
    let node_zero: Lane6<S> =
        core::array::from_fn(|k| Lane::splat(simd, -work.dq[k * groups + s / LANES].0[s % LANES]));
    let shift = base_twist(simd, &del.base[0], node_zero);
    let start: [f64; 6] = work.start.base_twist_w.to_vector().into();
    let rigid: Lane6<S> = core::array::from_fn(|k| Lane::splat(simd, start[k] - shift[k].quad().0[0]));
    let dxi: Lane6<S> = load_strided(simd, &work.dq, g, groups);
    let dxi_dot: Lane6<S> = load_strided(simd, &work.dq_dot, g, groups);
    let base = &del.base[g];
    let lanes = &mut work.bodies[g];
    lanes.eta = store(add(rigid, base_twist(simd, base, dxi)));
    lanes.nu = store(add(base_twist_rate(simd, base, dxi), base_twist(simd, base, dxi_dot)));
}

#[inline(always)]
fn joint_variation<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut TangentWorkspace,
    i: usize,
    g: usize,
) {
    let groups = work.groups;
    let dof = tree.joint_dof(i) * groups + g;
    let (dq, dq_dot) = (Lane::load(simd, &work.dq[dof]), Lane::load(simd, &work.dq_dot[dof]));
    let body = &del.bodies[i * groups + g];
    let twist: Lane6<S> = load(simd, &body.joint_twist);
    let rate: Lane6<S> = load(simd, &body.joint_twist_rate);
    let zero = [Lane::splat(simd, 0.0); 6];
    let parent = tree.constants()[i].parent;
    let (eta, nu) = if parent == NO_PARENT {
        (zero, zero)
    } else {
        let lanes = &work.bodies[parent * groups + g];
        (load(simd, &lanes.eta), load(simd, &lanes.nu))
    };
    let lanes = &mut work.bodies[i * groups + g];
    lanes.eta = store(scale_add(dq, twist, eta));
    lanes.nu = store(scale_add(dq_dot, twist, scale_add(dq, rate, nu)));
}

/// `M_i ν_i` and the gravity, drag and law part of `w_α Δt (F_η η + F_ν ν)`.
#[inline(always)]
fn own_variations<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut TangentWorkspace,
    i: usize,
) {
    let constants = &tree.constants()[i];
    let gravity: [f64; 3] = (*tree.gravity_w()).into();
    let weight: Lane3<S> = crate::lanes::splat(simd, &gravity.map(|x| x * constants.mass));
    for g in 0..work.groups {
        let at = i * work.groups + g;
        let body = &del.bodies[at];
        let (eta, nu): (Lane6<S>, Lane6<S>) =
            (load(simd, &work.bodies[at].eta), load(simd, &work.bodies[at].nu));
        let position = load(simd, &body.position);
        let mut change = dead_load_gain(position, weight, eta, false);
        if let Some(gain) = del.gains.get(at) {
            for r in 0..6 {
                change[r] = change[r]
                    + dot6(load_strided(simd, &gain.eta, 6 * r, 1), eta)
                    + dot6(load_strided(simd, &gain.nu, 6 * r, 1), nu);
            }
        }
        let step = Lane::load(simd, &del.weights[g]);
        let lanes = &mut work.bodies[at];
        lanes.d_impulse = store(scale(step, change));
        let rotation = load(simd, &body.rotation);
        lanes.d_momentum = store(own_momentum(simd, constants, &rotation, position, nu));
    }
}

/// `F_η η = [x×(f×η_ω); f×η_ω]` of a force that keeps its direction in {0}; a couple lacks the lower half.
#[inline(always)]
fn dead_load_gain<S: Simd>(arm: Lane3<S>, force: Lane3<S>, eta: Lane6<S>, couple: bool) -> Lane6<S> {
    let turned = cross(force, halves(eta).0);
    let lower = if couple { sub(turned, turned) } else { turned };
    join(cross(arm, turned), lower)
}

#[inline(always)]
fn load_variations<S: Simd>(simd: S, del: &DelWorkspace, work: &mut TangentWorkspace) {
    let groups = work.groups;
    for (index, dead) in del.loads.iter().enumerate() {
        for g in 0..groups {
            let at = dead.body * groups + g;
            let (force, arm) = load_arm(simd, dead, &del.load_forces[index * groups + g], &del.bodies[at]);
            let lanes = &mut work.bodies[at];
            let change = dead_load_gain(arm, force, load(simd, &lanes.eta), dead.couple);
            let step = Lane::load(simd, &del.weights[g]);
            lanes.d_impulse = store(scale_add(step, change, load(simd, &lanes.d_impulse)));
        }
    }
    for held in del.dead_torques() {
        for g in 0..groups {
            let lanes = &mut work.bodies[held.body * groups + g];
            let turned = cross(load(simd, &held.torque_w[g]), halves(load(simd, &lanes.eta)).0);
            let step = Lane::load(simd, &del.weights[g]);
            for k in 0..3 {
                lanes.d_impulse[k] = step.mul_add(turned[k], Lane::load(simd, &lanes.d_impulse[k])).quad();
            }
        }
    }
}

#[inline(always)]
fn inward<S: Simd>(simd: S, tree: &KinematicTree, del: &DelWorkspace, work: &mut TangentWorkspace, i: usize) {
    let groups = work.groups;
    let constants = &tree.constants()[i];
    let dof = tree.joint_dof(i);
    for g in 0..groups {
        let body = &del.bodies[i * groups + g];
        let lanes = &work.bodies[i * groups + g];
        let twist: Lane6<S> = load(simd, &body.joint_twist);
        let d_momentum: Lane6<S> = load(simd, &lanes.d_momentum);
        let d_impulse: Lane6<S> = load(simd, &lanes.d_impulse);
        work.projections[g][0] = dot6(twist, d_momentum).quad();
        if constants.parent != NO_PARENT {
            let travel = scale(Lane::load(simd, &work.dq[dof * groups + g]), twist);
            let left = sub(d_momentum, dual_bracket(load(simd, &body.momentum), travel));
            let pushed = sub(d_impulse, dual_bracket(load(simd, &body.impulse), travel));
            let parent = &mut work.bodies[constants.parent * groups + g];
            parent.d_momentum = store(add(load(simd, &parent.d_momentum), left));
            parent.d_impulse = store(add(load(simd, &parent.d_impulse), pushed));
        }
    }
    for g in 0..groups {
        let body = &del.bodies[i * groups + g];
        let lanes = &work.bodies[i * groups + g];
        let twist: Lane6<S> = load(simd, &body.joint_twist);
        let gyro = dual_bracket(load(simd, &body.momentum), load(simd, &lanes.nu));
        let mut held =
            dot6(twist, gyro) + dot6(load(simd, &body.joint_twist_rate), load(simd, &lanes.d_momentum));
        let at = dof * groups + g;
        held = Lane::splat(simd, constants.damping).neg_mul_add(Lane::load(simd, &work.dq_dot[at]), held);
        held = Lane::splat(simd, constants.stiffness).neg_mul_add(Lane::load(simd, &work.dq[at]), held);
        let row = Lane::load(simd, &del.weights[g]).mul_add(held, dot6(twist, load(simd, &lanes.d_impulse)));
        work.rows[at] = weighted_sum(simd, del, &work.projections, 0, g, row).quad();
    }
}

#[inline(always)]
fn base_rows<S: Simd>(simd: S, del: &DelWorkspace, work: &mut TangentWorkspace) {
    let groups = work.groups;
    let s = work.s;
    for g in 0..groups {
        let (base, body, lanes) = (&del.base[g], &del.bodies[g], &work.bodies[g]);
        let dxi: Lane6<S> = load_strided(simd, &work.dq, g, groups);
        let curved = apply_second_order(&second_order(simd, base, load(simd, &body.momentum)), dxi);
        let projected = base_project(simd, base, load(simd, &lanes.d_momentum));
        work.projections[g] = store(add(projected, curved));
    }
    for g in 0..groups {
        let (base, body, lanes) = (&del.base[g], &del.bodies[g], &work.bodies[g]);
        let dxi: Lane6<S> = load_strided(simd, &work.dq, g, groups);
        let dxi_dot: Lane6<S> = load_strided(simd, &work.dq_dot, g, groups);
        let momentum: Lane6<S> = load(simd, &body.momentum);
        let impulse: Lane6<S> = load(simd, &body.impulse);
        let mut held = base_project(simd, base, dual_bracket(momentum, load(simd, &lanes.nu)));
        let rate = base_project_rate(simd, base, load(simd, &lanes.d_momentum));
        for k in 0..3 {
            held[k] = held[k] + rate[k];
        }
        held = add(held, apply_second_order(&second_order_rate(simd, base, momentum), dxi));
        held = add(held, apply_second_order(&second_order(simd, base, momentum), dxi_dot));
        let mut mask = Quad::splat(1.0);
        if s / LANES == g {
            mask.0[s % LANES] = 0.0;
        }
        let pushed = add(
            base_project(simd, base, load(simd, &lanes.d_impulse)),
            apply_second_order(&second_order(simd, base, impulse), dxi),
        );
        let start =
            scale_add(Lane::load(simd, &del.weights[g]), held, scale(Lane::load(simd, &mask), pushed));
        for k in 0..6 {
            work.rows[k * groups + g] = weighted_sum(simd, del, &work.projections, k, g, start[k]).quad();
        }
    }
}
