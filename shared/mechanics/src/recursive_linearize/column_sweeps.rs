//! The two sweeps over sixteen columns at a time; letters as in [`super`].

use alloc::vec;
use alloc::vec::Vec;

use super::responses::{Lengths, Responses};
use crate::del_residual::DelWorkspace;
use crate::lanes::{Kernel, LANES, Quad, Simd, WIDE, WideLane};
use crate::linearize::InputHold;
use crate::recursive_newton::{Interface, MAX_NODES, assign_slots};
use crate::row_matrix::RowMatrix;
use crate::tree::{KinematicTree, NO_PARENT};

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
                let at = shape.nu_at(0, 0) + k;
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
