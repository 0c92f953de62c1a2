//! Algorithm B.1 for a whole step: `A` and `B` of a fixed tree in O(s² n) per column, sixteen columns at a time.
//!
//! A column of `[A | B]` is a solve of the Newton matrix whose right-hand side starts at one body `d`, and one row of momenta.
//! Everything such a column needs is an affine response of [`crate::recursive_newton`] once the interface covers the whole step:
//! `ζ` also has `η^0` (node 0 moves with `δq^0`), `y` also has `DΓ^s` (row s needs it). `η^s` acts on row s alone.
//!
//! | letter | size | meaning |
//! |---|---|---|
//! | `c_i^α` | 3 | `w_α Δt` times the angular part of `𝒴_iᵀ S_i`: row α by `η^α`, forces of fixed direction |
//! | `Γ̃_i^α` | 6 | change of the impulse on the parent by `δq_i^α`: `w_α Δt 𝒴_i S_i - ad^D_Γ S_i` |
//! | `K_i^s` | `ni` | row s by `ζ_i`: `C_i^sᵀ Y_i + E_i^s`, as step 3 of B.1 for one more row |
//! | `b_j^0`, `v_j` | `ni`, `no` | what `δq_j^0` adds to `ζ_j`; `v_j = Y_j b_j^0 - P_j^0` |
//!
//! ```text
//! start at body d   q_d:  g = -(W_d b_d^0 + D_d⁻¹ T_d^0),  y0_par += v_d       p_d:  g = -D_d⁻¹ e_0       u_d:  g = -D_d⁻¹ (w_α Δt)_α
//! inward, i <= d    g_i = -D_i⁻¹ (C_iᵀ y0_i + e_0 S_i^0ᵀ Γ̃_d^0)      y0_par += y0_i + U_i g_i
//! outward           x_i = g_i - W_i ζ_par     ζ_i = ζ_par + B_i x_i (+ b_d^0 at d)     η_i^s = η_par^s + s_i^s x_i^s
//!                   δp_i = K_i^s ζ_i + c_i^s·η_i^s + C_i^sᵀ y0_i + T_i^s x_i      (+ direct terms at d)
//! ```
//!
//! Below `d` nothing but `ζ` carries the column, because `η^0` is part of it: the inward sweep runs from `d` to the root only. At
//! s = 2 a column takes 187 multiply-adds per body of a chain. Columns are SIMD lanes; the responses are broadcast.
//!
//! Source: ours; O(n²) for `A`, `B` is announced in the paper, section 3.4, without the solves.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_residual::{DelWorkspace, load_arm};
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Quad, Simd, WIDE, WideLane, add, cross, dual_bracket, halves, join,
    load, mat_tr_vec, mat_vec, scale, splat, store, sub,
};
use crate::linearize::InputHold;
use crate::recursive_newton::{Interface, JointNodes, MAX_NODES, arm_cross_force, assign_slots, dot};
use crate::row_matrix::RowMatrix;
use crate::tree::{KinematicTree, NO_PARENT};

/// The factors of one body, as Algorithm B.1 has just left them.
pub(crate) struct BodyFactors<'a> {
    pub y: &'a [Quad],
    pub b: &'a [Quad],
    pub w: &'a [Quad],
    pub c: &'a [Quad],
    pub u: &'a [Quad],
    pub inverse: &'a [f64],
}

/// Responses of every body, in the order in which the sweeps read them.
#[derive(Clone, Debug)]
pub(crate) struct Responses {
    shape: Interface,
    groups: usize,
    /// Forces of fixed direction on a subtree: `Σ x^ f^` (9), `Σ f` (3).
    fixed_directions: Vec<[Quad; 12]>,
    /// `c_i` and `Γ̃_i` at the nodes.
    rows: Vec<[Quad; 3]>,
    impulses: Vec<[Quad; 6]>,
    inward: Vec<f64>,
    outward: Vec<f64>,
    starts: Vec<f64>,
}

/// Lengths of the three records of a body.
#[derive(Clone, Copy)]
struct Lengths {
    inward: usize,
    outward: usize,
    start: usize,
}

impl Lengths {
    #[inline(always)]
    fn new(shape: &Interface) -> Self {
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        Self {
            // (C, C^s) of the momenta, S^1..S^s, S^0, D⁻¹, U
            inward: 6 * (s + 1) * (s + 1) + 6 * s + 6 + s * s + no * s,
            // (W, K^s), c^s, row s by x, S^1..S^s (angular), B of the velocities
            outward: ni * (s + 1) + 3 + s + 3 * s + 6 * (s + 1) * s,
            // g, v, Γ̃^0, b^0, row s
            start: s + no + 6 + ni + 1,
        }
    }
}

/// Appends numbers to a record.
struct Writer<'a>(core::slice::IterMut<'a, f64>);

impl Writer<'_> {
    #[inline(always)]
    fn push(&mut self, value: f64) {
        if let Some(slot) = self.0.next() {
            *slot = value;
        }
    }
}

#[inline(always)]
fn at(row: &[Quad], k: usize) -> f64 {
    row[k / LANES].0[k % LANES]
}

impl Responses {
    pub fn new(tree: &KinematicTree, del: &DelWorkspace, shape: &Interface) -> Self {
        let (bodies, groups, lengths) = (tree.body_count(), del.groups, Lengths::new(shape));
        Self {
            shape: *shape,
            groups,
            fixed_directions: vec![[Quad::ZERO; 12]; bodies * groups],
            rows: vec![[Quad::ZERO; 3]; bodies * groups],
            impulses: vec![[Quad::ZERO; 6]; bodies * groups],
            inward: vec![0.0; bodies * lengths.inward],
            outward: vec![0.0; bodies * lengths.outward],
            starts: vec![0.0; bodies * lengths.start],
        }
    }

    pub fn clear(&mut self) {
        self.fixed_directions.fill([Quad::ZERO; 12]);
    }

    /// `c_i^α`.
    #[inline(always)]
    pub fn fixed_direction_row(&self, body: usize, alpha: usize) -> [f64; 3] {
        self.rows[body * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `Γ̃_i^α`.
    #[inline(always)]
    pub fn moved_impulse(&self, body: usize, alpha: usize) -> [f64; 6] {
        self.impulses[body * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `c_i`, `Γ̃_i` of a body whose children are done; its forces of fixed direction go to its parent.
    #[inline(always)]
    pub fn add_fixed_directions<S: Simd>(
        &mut self,
        simd: S,
        tree: &KinematicTree,
        del: &DelWorkspace,
        i: usize,
    ) {
        let constants = &tree.constants()[i];
        let gravity: [f64; 3] = (*tree.gravity_w()).into();
        let weight: Lane3<S> = splat(simd, &gravity.map(|x| x * constants.mass));
        for g in 0..self.groups {
            let body = &del.bodies[i * self.groups + g];
            let mut sum: [Lane<S>; 12] = load(simd, &self.fixed_directions[i * self.groups + g]);
            add_force(&mut sum, load(simd, &body.position), weight, false);
            for (index, dead) in del.loads.iter().enumerate().filter(|(_, dead)| dead.body == i) {
                let (force, arm) = load_arm(simd, dead, &del.load_forces[index * self.groups + g], body);
                add_force(&mut sum, arm, force, dead.couple);
            }
            let arm_cross = [sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], sum[6], sum[7], sum[8]];
            let force = [sum[9], sum[10], sum[11]];
            let step = Lane::load(simd, &del.weights[g]);
            let twist: Lane6<S> = load(simd, &body.joint_twist);
            let (angular, linear) = halves(twist);
            let row = sub(mat_tr_vec(&arm_cross, angular), cross(force, linear));
            self.rows[i * self.groups + g] = store(scale(step, row));
            let gain = join(mat_vec(&arm_cross, angular), cross(force, angular));
            let turned = dual_bracket(load(simd, &body.impulse), twist);
            self.impulses[i * self.groups + g] = store(sub(scale(step, gain), turned));
            if constants.parent != NO_PARENT {
                let target = &mut self.fixed_directions[constants.parent * self.groups + g];
                *target = store(add(load(simd, target), sum));
            }
        }
    }

    /// The records of a body.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    pub fn record<S: Simd>(
        &mut self,
        simd: S,
        tree: &KinematicTree,
        del: &DelWorkspace,
        i: usize,
        nodes: &JointNodes,
        factors: &BodyFactors<'_>,
        shape: &Interface,
    ) {
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let (nq, oq) = (ni.div_ceil(LANES), no.div_ceil(LANES));
        let lengths = Lengths::new(shape);
        let rule = &del.rule;
        let constants = &tree.constants()[i];
        let row = |m: &'_ [Quad], quads: usize, r: usize, k: usize| at(&m[r * quads..(r + 1) * quads], k);
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        let slope = |alpha: usize, gamma: usize| rule.derivative(alpha, gamma) / del.time_step;
        let (end_row, end_impulse) = (self.fixed_direction_row(i, s), self.moved_impulse(i, 0));
        // Momentum blocks of C^s; its block DΓ^s is S^s.
        let end_column = |beta: usize, k: usize| {
            let rate = if beta == s { step(s) * nodes.rate[s][k] } else { 0.0 };
            rule.weighted_derivative(s, beta) * nodes.twist[beta][k] + rate
        };

        // K^s and b^0, as rows of inputs.
        const QUADS: usize = (3 * MAX_NODES + 6 * MAX_NODES) / LANES + 1;
        let mut end = [Quad::ZERO; QUADS];
        let mut moved = [Quad::ZERO; QUADS];
        let end = &mut end[..nq];
        for beta in 0..=s {
            for k in 0..6 {
                let factor = end_column(beta, k);
                let source = &factors.y[(shape.momentum_at(beta) + k) * nq..][..nq];
                crate::recursive_newton::add_scaled(simd, end, factor, source);
            }
        }
        for k in 0..6 {
            let source = &factors.y[(shape.impulse_at(s) + k) * nq..][..nq];
            crate::recursive_newton::add_scaled(simd, end, nodes.twist[s][k], source);
            let slot = shape.nu_at(s) + k;
            end[slot / LANES].0[slot % LANES] -= step(s) * nodes.turned_momentum[s][k];
        }
        let moved = &mut moved[..nq];
        let mut set = |k: usize, value: f64| moved[k / LANES].0[k % LANES] = value;
        for k in 0..3 {
            set(shape.eta_at(0) + k, nodes.twist[0][k]);
        }
        for beta in 0..=s {
            for k in 0..6 {
                let rate = if beta == 0 { nodes.rate[0][k] } else { 0.0 };
                set(shape.nu_at(beta) + k, slope(beta, 0) * nodes.twist[beta][k] + rate);
            }
        }

        let mut inward = Writer(self.inward[i * lengths.inward..(i + 1) * lengths.inward].iter_mut());
        for beta in 0..=s {
            for k in 0..6 {
                for alpha in 0..s {
                    inward.push(row(factors.c, oq, alpha, shape.momentum_at(beta) + k));
                }
                inward.push(end_column(beta, k));
            }
        }
        for alpha in (1..=s).chain(0..1) {
            nodes.twist[alpha].iter().for_each(|x| inward.push(*x));
        }
        factors.inverse.iter().for_each(|x| inward.push(*x));
        for k in 0..no {
            for column in 0..s {
                inward.push(row(factors.u, oq, column, k));
            }
        }

        let mut outward = Writer(self.outward[i * lengths.outward..(i + 1) * lengths.outward].iter_mut());
        for k in 0..ni {
            for alpha in 0..s {
                outward.push(row(factors.w, nq, alpha, k));
            }
            outward.push(at(end, k));
        }
        end_row.iter().for_each(|x| outward.push(*x));
        for column in 0..s {
            let gamma = column + 1;
            let mut value = dot(simd, end, &factors.b[column * nq..(column + 1) * nq]);
            value -= step(s) * constants.damping * slope(s, gamma);
            if gamma == s {
                value -= step(s) * constants.stiffness;
                value += (0..3).map(|k| end_row[k] * nodes.twist[s][k]).sum::<f64>();
            }
            outward.push(value);
        }
        for gamma in 1..=s {
            nodes.twist[gamma][..3].iter().for_each(|x| outward.push(*x));
        }
        for k in shape.nu_at(0)..ni {
            for column in 0..s {
                outward.push(row(factors.b, nq, column, k));
            }
        }

        let mut start = Writer(self.starts[i * lengths.start..(i + 1) * lengths.start].iter_mut());
        for alpha in 0..s {
            let mut g = -dot(simd, &factors.w[alpha * nq..(alpha + 1) * nq], moved);
            for k in 0..s {
                let stiffness = if k == 0 { constants.stiffness } else { 0.0 };
                g += factors.inverse[alpha * s + k] * step(k) * (stiffness + constants.damping * slope(k, 0));
            }
            start.push(g);
        }
        for k in 0..no {
            let turned = if k < 6 { nodes.turned_momentum[0][k] } else { 0.0 };
            start.push(dot(simd, &factors.y[k * nq..(k + 1) * nq], moved) - turned);
        }
        end_impulse.iter().for_each(|x| start.push(*x));
        for k in 0..ni {
            start.push(at(moved, k));
        }
        start.push(dot(simd, end, moved) - step(s) * constants.damping * slope(s, 0));
    }
}

/// Adds a force of fixed direction to the sums of a subtree.
#[inline(always)]
fn add_force<S: Simd>(sum: &mut [Lane<S>; 12], arm: Lane3<S>, force: Lane3<S>, couple: bool) {
    let product = arm_cross_force(arm, force);
    for k in 0..9 {
        sum[k] = sum[k] + product[k];
    }
    if !couple {
        for k in 0..3 {
            sum[9 + k] = sum[9 + k] + force[k];
        }
    }
}

/// Sixteen columns of one quantity.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Tile([Quad; WIDE]);

impl Tile {
    const COLUMNS: usize = WIDE * LANES;
    const ZERO: Self = Self([Quad::ZERO; WIDE]);

    #[inline(always)]
    fn add_to_lane(&mut self, lane: usize, value: f64) {
        self.0[lane / LANES].0[lane % LANES] += value;
    }
}

#[inline(always)]
fn get<S: Simd>(simd: S, tile: &Tile) -> WideLane<S> {
    WideLane::of(simd, &tile.0)
}

#[inline(always)]
fn put<S: Simd>(value: WideLane<S>) -> Tile {
    Tile(value.quads())
}

/// `factor x + y`.
#[inline(always)]
fn mul_add<S: Simd>(simd: S, factor: f64, x: WideLane<S>, y: WideLane<S>) -> WideLane<S> {
    WideLane::splat(simd, factor).mul_add(x, y)
}

/// What a column varies, and where.
#[derive(Clone, Copy, Debug)]
enum Start {
    Coordinate,
    Momentum,
    /// Joint force at all nodes, or at one.
    Held,
    Node(usize),
}

const NONE: usize = usize::MAX;

/// Memory of the sweeps.
#[derive(Clone, Debug)]
pub(crate) struct ColumnSweeps {
    /// `y0`, one slot per open branch, handed from child to parent; the last six rows of a slot are `Γ̃^0`.
    outputs: Vec<Tile>,
    output_slot: Vec<usize>,
    free: Vec<usize>,
    /// `ζ` and `η^s`, one slot per body whose children are still to come. Slot 0 is the ground: zero.
    inputs: Vec<Tile>,
    input_slot: Vec<usize>,
    /// `g_i` and `C_i^sᵀ y0_i`.
    pending: Vec<Tile>,
    /// Whether the inward sweep has reached a body.
    reached: Vec<bool>,
    /// Lanes that start at a body: head of the list, and the next lane of a lane.
    first_lane: Vec<usize>,
    next_lane: [usize; Tile::COLUMNS],
}

impl ColumnSweeps {
    pub fn new(tree: &KinematicTree, shape: &Interface) -> Self {
        let bodies = tree.body_count();
        let output_slots = assign_slots(tree).1;
        let (input_slot, input_slots) = assign_input_slots(tree);
        Self {
            outputs: vec![Tile::ZERO; output_slots * (shape.outputs() + 6)],
            output_slot: vec![NONE; bodies],
            free: (0..output_slots).collect(),
            inputs: vec![Tile::ZERO; input_slots * (shape.inputs() + 3)],
            input_slot,
            pending: vec![Tile::ZERO; bodies * (shape.s + 1)],
            reached: vec![false; bodies],
            first_lane: vec![NONE; bodies],
            next_lane: [NONE; Tile::COLUMNS],
        }
    }
}

/// A slot per body with children; the last child takes over the slot of its parent.
fn assign_input_slots(tree: &KinematicTree) -> (Vec<usize>, usize) {
    let bodies = tree.body_count();
    let mut last_child = vec![NONE; bodies];
    for (i, constants) in tree.constants().iter().enumerate().filter(|(_, c)| c.parent != NO_PARENT) {
        last_child[constants.parent] = i;
    }
    let mut slot_of = vec![NONE; bodies];
    let mut free: Vec<usize> = Vec::new();
    let mut count = 1;
    for (i, constants) in tree.constants().iter().enumerate() {
        if constants.parent != NO_PARENT && last_child[constants.parent] == i {
            if last_child[i] == NONE {
                free.push(slot_of[constants.parent]);
            } else {
                slot_of[i] = slot_of[constants.parent];
            }
        } else if last_child[i] != NONE {
            slot_of[i] = free.pop().unwrap_or_else(|| {
                count += 1;
                count - 1
            });
        }
    }
    (slot_of, count)
}

/// All columns of `[A | B]` in `(q, p)` from the responses of a factorised step.
pub(crate) struct AllColumns<'a> {
    pub tree: &'a KinematicTree,
    pub del: &'a DelWorkspace,
    pub hold: InputHold,
    pub responses: &'a Responses,
    pub sweeps: &'a mut ColumnSweeps,
    pub out: &'a mut RowMatrix,
}

impl Kernel for AllColumns<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let shape = self.responses.shape;
        match shape.s {
            2 if S::SPECIALISE => all_columns::<S, 3>(
                simd,
                self,
                Interface { s: 2, eta: 3, first_impulse: 1, whole_step: true },
            ),
            _ => all_columns::<S, MAX_NODES>(simd, self, shape),
        }
    }
}

#[inline(always)]
fn all_columns<S: Simd, const N: usize>(simd: S, mut work: AllColumns<'_>, shape: Interface) {
    for first in (0..work.out.columns()).step_by(Tile::COLUMNS) {
        place_starts(&mut work, first);
        inward::<S, N>(simd, &mut work, first, &shape);
        outward::<S, N>(simd, &mut work, first, &shape);
    }
}

/// Body and kind of a column.
#[inline(always)]
fn start_of(work: &AllColumns<'_>, column: usize) -> (usize, Start) {
    let n = work.tree.dof();
    match (column / n, work.hold) {
        (0, _) => (column, Start::Coordinate),
        (1, _) => (column - n, Start::Momentum),
        (_, InputHold::Held) => (column - 2 * n, Start::Held),
        (block, InputHold::PerNode) => (column % n, Start::Node(block - 2)),
    }
}

#[inline(always)]
fn place_starts(work: &mut AllColumns<'_>, first: usize) {
    work.sweeps.first_lane.fill(NONE);
    work.sweeps.reached.fill(false);
    work.sweeps.output_slot.fill(NONE);
    for lane in 0..Tile::COLUMNS.min(work.out.columns() - first) {
        let (body, _) = start_of(work, first + lane);
        work.sweeps.next_lane[lane] = work.sweeps.first_lane[body];
        work.sweeps.first_lane[body] = lane;
        work.sweeps.reached[body] = true;
    }
}

/// From the starts to the root: `g_i`, `y0_i`.
#[inline(always)]
fn inward<S: Simd, const N: usize>(simd: S, work: &mut AllColumns<'_>, first: usize, shape: &Interface) {
    let (s, no) = (shape.s, shape.outputs());
    let lengths = Lengths::new(shape);
    let zero = WideLane::splat(simd, 0.0);
    let momenta = 6 * (s + 1);
    for i in (0..work.tree.body_count()).rev() {
        if !work.sweeps.reached[i] {
            continue;
        }
        let record = &work.responses.inward[i * lengths.inward..(i + 1) * lengths.inward];
        let (columns, record) = record.split_at(momenta * (s + 1));
        let (twists, record) = record.split_at(6 * (s + 1));
        let (inverse, u) = record.split_at(s * s);
        let parent = work.tree.constants()[i].parent;
        let slot = work.sweeps.output_slot[i];
        let mut sums = [zero; N];
        if slot != NONE {
            let y = &work.sweeps.outputs[slot * (no + 6)..(slot + 1) * (no + 6)];
            let mut odd = [zero; N];
            for (y, c) in y[..momenta].chunks_exact(2).zip(columns.chunks_exact(2 * (s + 1))) {
                let [first, second] = [get(simd, &y[0]), get(simd, &y[1])];
                for r in 0..=s {
                    sums[r] = mul_add(simd, c[r], first, sums[r]);
                    odd[r] = mul_add(simd, c[s + 1 + r], second, odd[r]);
                }
            }
            for r in 0..=s {
                sums[r] = mul_add(simd, 1.0, odd[r], sums[r]);
            }
            for (block, (y, twist)) in y[momenta..].chunks_exact(6).zip(twists.chunks_exact(6)).enumerate() {
                // Blocks DΓ^1..DΓ^s act on their own row, the last one (Γ̃^0) on row 0.
                let r = if block == s { 0 } else { block + 1 };
                for (y, x) in y.iter().zip(twist) {
                    sums[r] = mul_add(simd, *x, get(simd, y), sums[r]);
                }
            }
        }
        let pending = &mut work.sweeps.pending[i * (s + 1)..(i + 1) * (s + 1)];
        let mut g = [zero; N];
        for alpha in 0..s {
            for k in 0..s {
                g[alpha] = mul_add(simd, -inverse[alpha * s + k], sums[k], g[alpha]);
            }
            pending[alpha] = put(g[alpha]);
        }
        pending[s] = put(sums[s]);
        let mut lane = work.sweeps.first_lane[i];
        let starts = lane != NONE;
        while lane != NONE {
            let start = &work.responses.starts[i * lengths.start..(i + 1) * lengths.start];
            let kind = start_of(work, first + lane).1;
            let pending = &mut work.sweeps.pending[i * (s + 1)..(i + 1) * (s + 1)];
            for alpha in 0..s {
                let force = |k: usize| -inverse[alpha * s + k] * work.del.weights[k / LANES].0[k % LANES];
                let value = match kind {
                    Start::Coordinate => start[alpha],
                    Start::Momentum => -inverse[alpha * s],
                    Start::Held => (0..s).map(force).sum(),
                    Start::Node(node) if node < s => force(node),
                    Start::Node(_) => 0.0,
                };
                pending[alpha].add_to_lane(lane, value);
            }
            lane = work.sweeps.next_lane[lane];
        }
        if parent == NO_PARENT {
            if slot != NONE {
                work.sweeps.free.push(slot);
            }
            continue;
        }
        if starts {
            for alpha in 0..s {
                g[alpha] = get(simd, &work.sweeps.pending[i * (s + 1) + alpha]);
            }
        }
        let own = match slot {
            NONE => {
                let Some(new) = work.sweeps.free.pop() else { continue };
                work.sweeps.outputs[new * (no + 6)..(new + 1) * (no + 6)].fill(Tile::ZERO);
                new
            }
            slot => slot,
        };
        let y = &mut work.sweeps.outputs[own * (no + 6)..(own + 1) * (no + 6)];
        for (y, u) in y[..no].iter_mut().zip(u.chunks_exact(s)) {
            let mut sum = get(simd, y);
            for k in 0..s {
                sum = mul_add(simd, u[k], g[k], sum);
            }
            *y = put(sum);
        }
        let mut lane = work.sweeps.first_lane[i];
        while lane != NONE {
            if let Start::Coordinate = start_of(work, first + lane).1 {
                let start = &work.responses.starts[i * lengths.start + s..][..no + 6];
                let y = &mut work.sweeps.outputs[own * (no + 6)..(own + 1) * (no + 6)];
                for (y, value) in y.iter_mut().zip(start) {
                    y.add_to_lane(lane, *value);
                }
            }
            lane = work.sweeps.next_lane[lane];
        }
        work.sweeps.reached[parent] = true;
        let to = work.sweeps.output_slot[parent];
        if to == NONE {
            work.sweeps.output_slot[parent] = own;
            continue;
        }
        work.sweeps.free.push(own);
        for k in 0..no + 6 {
            let sum = get(simd, &work.sweeps.outputs[to * (no + 6) + k]);
            let sum = mul_add(simd, 1.0, get(simd, &work.sweeps.outputs[own * (no + 6) + k]), sum);
            work.sweeps.outputs[to * (no + 6) + k] = put(sum);
        }
    }
}

/// From the root to the leaves: `x_i`, `ζ_i`, `δp_i`.
#[inline(always)]
fn outward<S: Simd, const N: usize>(simd: S, work: &mut AllColumns<'_>, first: usize, shape: &Interface) {
    let (s, ni) = (shape.s, shape.inputs());
    let lengths = Lengths::new(shape);
    let zero = WideLane::splat(simd, 0.0);
    let (n, stride) = (work.tree.dof(), work.out.stride());
    let quad = first / LANES;
    for i in 0..work.tree.body_count() {
        let record = &work.responses.outward[i * lengths.outward..(i + 1) * lengths.outward];
        let (rows, record) = record.split_at(ni * (s + 1));
        let (end_row, record) = record.split_at(3);
        let (end_by_x, record) = record.split_at(s);
        let (twists, rates) = record.split_at(3 * s);
        let parent = work.tree.constants()[i].parent;
        let from = if parent == NO_PARENT { 0 } else { work.sweeps.input_slot[parent] * (ni + 3) };
        let mut sums = [zero; N];
        if parent != NO_PARENT {
            let inputs = &work.sweeps.inputs[from..from + ni + 3];
            // Two accumulators per row hide the latency of the multiply-add.
            let mut odd = [zero; N];
            let (pairs, rest) = inputs[..ni].split_at(ni - ni % 2);
            for (pair, row) in pairs.chunks_exact(2).zip(rows.chunks_exact(2 * (s + 1))) {
                let [first, second] = [get(simd, &pair[0]), get(simd, &pair[1])];
                for r in 0..=s {
                    sums[r] = mul_add(simd, row[r], first, sums[r]);
                    odd[r] = mul_add(simd, row[s + 1 + r], second, odd[r]);
                }
            }
            for (input, row) in rest.iter().zip(rows[(ni - ni % 2) * (s + 1)..].chunks_exact(s + 1)) {
                let input = get(simd, input);
                for r in 0..=s {
                    sums[r] = mul_add(simd, row[r], input, sums[r]);
                }
            }
            for r in 0..=s {
                sums[r] = mul_add(simd, 1.0, odd[r], sums[r]);
            }
            for (input, c) in inputs[ni..].iter().zip(end_row) {
                sums[s] = mul_add(simd, *c, get(simd, input), sums[s]);
            }
        }
        let mut x = [zero; N];
        let mut momentum = sums[s];
        if work.sweeps.reached[i] {
            let pending = &work.sweeps.pending[i * (s + 1)..(i + 1) * (s + 1)];
            for alpha in 0..s {
                x[alpha] = mul_add(simd, -1.0, sums[alpha], get(simd, &pending[alpha]));
            }
            momentum = mul_add(simd, 1.0, momentum, get(simd, &pending[s]));
        } else {
            for alpha in 0..s {
                x[alpha] = mul_add(simd, -1.0, sums[alpha], zero);
            }
        }
        for gamma in 0..s {
            momentum = mul_add(simd, end_by_x[gamma], x[gamma], momentum);
        }
        let out = work.out.quads_mut();
        x[s - 1].store(out, i * stride + quad);
        momentum.store(out, (n + i) * stride + quad);
        let slot = work.sweeps.input_slot[i];
        if slot != NONE {
            let own = slot * (ni + 3);
            let inputs = &mut work.sweeps.inputs;
            // The last child works in place, in the slot of its parent.
            for k in 0..shape.eta {
                let at = shape.eta_at(0) + k;
                inputs[own + at] = put(get(simd, &inputs[from + at]));
            }
            for (gamma, twist) in (1..=s).zip(twists.chunks_exact(3)) {
                let block = if gamma == s { ni } else { shape.eta_at(gamma) };
                for (k, factor) in twist.iter().enumerate() {
                    let eta = get(simd, &inputs[from + block + k]);
                    inputs[own + block + k] = put(mul_add(simd, *factor, x[gamma - 1], eta));
                }
            }
            for (k, factors) in rates.chunks_exact(s).enumerate() {
                let at = shape.nu_at(0) + k;
                let mut nu = get(simd, &inputs[from + at]);
                for gamma in 0..s {
                    nu = mul_add(simd, factors[gamma], x[gamma], nu);
                }
                inputs[own + at] = put(nu);
            }
        }
        let mut lane = work.sweeps.first_lane[i];
        while lane != NONE {
            let end_step = work.del.weights[s / LANES].0[s % LANES];
            match start_of(work, first + lane).1 {
                Start::Coordinate => {
                    let start = &work.responses.starts[i * lengths.start..(i + 1) * lengths.start];
                    let moved = &start[lengths.start - 1 - ni..];
                    if slot != NONE {
                        let own = &mut work.sweeps.inputs[slot * (ni + 3)..][..ni];
                        for (input, value) in own.iter_mut().zip(moved) {
                            input.add_to_lane(lane, *value);
                        }
                    }
                    work.out.add(n + i, first + lane, moved[ni]);
                }
                Start::Momentum => (),
                Start::Held => work.out.add(n + i, first + lane, end_step),
                Start::Node(node) if node == s => work.out.add(n + i, first + lane, end_step),
                Start::Node(_) => (),
            }
            lane = work.sweeps.next_lane[lane];
        }
    }
}
