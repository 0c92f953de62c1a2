//! Steps 2 to 7 of Algorithm B.1: bodies are eliminated from the leaves to the root; letters as in [`super`].

use super::own_response::own_response;
use super::{Interface, RecursiveNewton, trapezoidal};
use crate::del_residual::{BodyLanes, DelWorkspace};
use crate::errors::FactorError;
use crate::lanes::{Kernel, LANES, Lane, Lane6, Quad, Simd, dual_bracket, load, store};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::recursive_linearize::BodyFactors;
use crate::small_inverse::invert;
use crate::tree::{KinematicTree, NO_PARENT};

/// `ad^D_μ S`, `ad^D_Γ S` of a joint.
#[derive(Clone, Copy, Debug)]
pub(super) struct TurnedLanes {
    pub momentum: [Quad; 6],
    pub impulse: [Quad; 6],
}

impl TurnedLanes {
    pub const ZERO: Self = Self { momentum: [Quad::ZERO; 6], impulse: [Quad::ZERO; 6] };
}

/// What steps 3 to 6 need of a joint: component `k` at node `alpha`.
#[derive(Clone, Copy)]
pub(crate) struct JointNodes<'a> {
    bodies: &'a [BodyLanes],
    turned: &'a [TurnedLanes],
}

impl JointNodes<'_> {
    #[inline(always)]
    pub fn twist(&self, alpha: usize, k: usize) -> f64 {
        self.bodies[alpha / LANES].joint_twist[k].0[alpha % LANES]
    }
    #[inline(always)]
    pub fn rate(&self, alpha: usize, k: usize) -> f64 {
        self.bodies[alpha / LANES].joint_twist_rate[k].0[alpha % LANES]
    }
    #[inline(always)]
    pub fn turned_momentum(&self, alpha: usize, k: usize) -> f64 {
        self.turned[alpha / LANES].momentum[k].0[alpha % LANES]
    }
    #[inline(always)]
    pub fn turned_impulse(&self, alpha: usize, k: usize) -> f64 {
        self.turned[alpha / LANES].impulse[k].0[alpha % LANES]
    }
}

pub(super) struct Factor<'a> {
    pub tree: &'a KinematicTree,
    pub del: &'a DelWorkspace,
    pub work: &'a mut RecursiveNewton,
}

impl Kernel for Factor<'_> {
    type Output = Result<(), FactorError>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        // With constant arguments the loops over nodes and rows unroll.
        let shape = self.work.shape;
        match (shape.s, shape.eta, shape.whole_step) {
            (1, 3, false) => trapezoidal::factor(simd, self.tree, self.del, self.work),
            (2, 3, false) if S::SPECIALISE => {
                factor(simd, self, Interface { s: 2, eta: 3, first_impulse: 1, whole_step: false })
            }
            (2, 3, true) if S::SPECIALISE => {
                factor(simd, self, Interface { s: 2, eta: 3, first_impulse: 1, whole_step: true })
            }
            _ => factor(simd, self, shape),
        }
    }
}

#[inline(always)]
fn factor<S: Simd>(simd: S, work: Factor<'_>, shape: Interface) -> Result<(), FactorError> {
    let Factor { tree, del, work } = work;
    let mut turned = core::mem::take(&mut work.turned);
    let outcome = eliminate_all(simd, tree, del, work, &mut turned, shape);
    work.turned = turned;
    outcome
}

#[inline(always)]
fn eliminate_all<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    turned: &mut [TurnedLanes],
    shape: Interface,
) -> Result<(), FactorError> {
    work.has_child.fill(false);
    let input_quads = shape.inputs().div_ceil(LANES);
    let size = shape.outputs() * input_quads;
    for i in (0..tree.body_count()).rev() {
        if !work.has_child[i] {
            let start = work.slot_of[i] * size;
            work.slots[start..start + size].fill(Quad::ZERO);
        }
        own_response(simd, tree, del, work, i, &shape);
        if tree.is_base(i) {
            continue;
        }
        let nodes = joint_nodes(simd, del, i, turned);
        joint_matrices(del, work, i, &nodes, &shape);
        if shape.whole_step
            && let Some(responses) = &mut work.responses
        {
            responses.add_fixed_directions(simd, tree, del, i);
        }
        eliminate(simd, tree, del, work, i, &nodes, &shape)?;
        if shape.whole_step
            && let Some(responses) = &mut work.responses
        {
            let (ni, no) = (input_quads, shape.outputs().div_ceil(LANES));
            let s = shape.s;
            let factors = BodyFactors {
                y: &work.slots[work.slot_of[i] * size..][..size],
                b: &work.b[i * s * ni..][..s * ni],
                w: &work.w[i * s * ni..][..s * ni],
                c: &work.c[i * s * no..][..s * no],
                u: &work.u[i * s * no..][..s * no],
                inverse: &work.pivots[i * s * s..][..s * s],
            };
            responses.record(simd, tree, del, i, &nodes, &factors, &shape);
        }
        let parent = tree.constants()[i].parent;
        let own = work.slot_of[i] * size;
        if parent != NO_PARENT {
            let to = work.slot_of[parent] * size;
            if core::mem::replace(&mut work.has_child[parent], true) {
                pass_up::<S, true>(simd, work, i, own, to, &shape);
            } else {
                pass_up::<S, false>(simd, work, i, own, to, &shape);
            }
        }
    }
    Ok(())
}

/// Fills `turned` (a quad group each).
#[inline(always)]
fn joint_nodes<'a, S: Simd>(
    simd: S,
    del: &'a DelWorkspace,
    i: usize,
    turned: &'a mut [TurnedLanes],
) -> JointNodes<'a> {
    let bodies = &del.bodies[i * del.groups..(i + 1) * del.groups];
    for (body, turned) in bodies.iter().zip(&mut *turned) {
        let twist: Lane6<S> = load(simd, &body.joint_twist);
        turned.momentum = store(dual_bracket(load(simd, &body.momentum), twist));
        turned.impulse = store(dual_bracket(load(simd, &body.impulse), twist));
    }
    JointNodes { bodies, turned }
}

/// `Bᵀ` and `Cᵀ` of a joint.
#[inline(always)]
fn joint_matrices(
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    i: usize,
    nodes: &JointNodes<'_>,
    shape: &Interface,
) {
    let s = shape.s;
    let (input_quads, output_quads) = (shape.inputs().div_ceil(LANES), shape.outputs().div_ceil(LANES));
    let rule = &del.rule;
    let inverse_step = 1.0 / del.time_step;
    for column in 0..s {
        let b = &mut work.b[(i * s + column) * input_quads..][..input_quads];
        b.fill(Quad::ZERO);
        let mut put = |at: usize, value: f64| b[at / LANES].0[at % LANES] = value;
        let gamma = column + 1;
        if gamma < s {
            for k in 0..shape.eta {
                put(shape.eta_at(gamma) + k, nodes.twist(gamma, k));
            }
        }
        for beta in 0..=s {
            let slope = rule.derivative(beta, gamma) * inverse_step;
            for k in 0..6 {
                let mut value = slope * nodes.twist(beta, k);
                if beta == gamma {
                    value += nodes.rate(beta, k);
                }
                put(shape.nu_at(beta, k), value);
            }
        }
        let c = &mut work.c[(i * s + column) * output_quads..][..output_quads];
        c.fill(Quad::ZERO);
        let mut put = |at: usize, value: f64| c[at / LANES].0[at % LANES] = value;
        let alpha = column;
        let step = rule.weights()[alpha] * del.time_step;
        for beta in 0..=s {
            let factor = rule.weighted_derivative(alpha, beta);
            for k in 0..6 {
                let mut value = factor * nodes.twist(beta, k);
                if beta == alpha {
                    value += step * nodes.rate(beta, k);
                }
                put(shape.momentum_at(beta, k), value);
            }
        }
        if alpha >= shape.first_impulse {
            for k in 0..6 {
                put(shape.impulse_at(alpha) + k, nodes.twist(alpha, k));
            }
        }
    }
}

#[inline(always)]
pub(crate) fn dot<S: Simd>(simd: S, a: &[Quad], b: &[Quad]) -> f64 {
    let mut sum = Lane::splat(simd, 0.0);
    for (x, y) in a.iter().zip(b) {
        sum = Lane::load(simd, x).mul_add(Lane::load(simd, y), sum);
    }
    sum.total().first()
}

/// `target += factor source`.
#[inline(always)]
pub(crate) fn add_scaled<S: Simd>(simd: S, target: &mut [Quad], factor: f64, source: &[Quad]) {
    let factor = Lane::splat(simd, factor);
    for (t, x) in target.iter_mut().zip(source) {
        *t = factor.mul_add(Lane::load(simd, x), Lane::load(simd, t)).quad();
    }
}

/// Steps 3 to 6.
#[inline(always)]
fn eliminate<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    i: usize,
    nodes: &JointNodes<'_>,
    shape: &Interface,
) -> Result<(), FactorError> {
    let s = shape.s;
    let outputs = shape.outputs();
    let (input_quads, output_quads) = (shape.inputs().div_ceil(LANES), outputs.div_ceil(LANES));
    let size = outputs * input_quads;
    let start = work.slot_of[i] * size;
    let y = &work.slots[start..start + size];
    let rule = &del.rule;

    for alpha in 0..s {
        let k = &mut work.k[alpha * input_quads..(alpha + 1) * input_quads];
        k.fill(Quad::ZERO);
        let c = &work.c[(i * s + alpha) * output_quads..][..output_quads];
        let momentum_rows = 6 * (s + 1);
        let impulse_rows = if alpha >= shape.first_impulse {
            shape.impulse_at(alpha)..shape.impulse_at(alpha) + 6
        } else {
            0..0
        };
        for row in (0..momentum_rows).chain(impulse_rows) {
            let factor = c[row / LANES].0[row % LANES];
            add_scaled(simd, k, factor, &y[row * input_quads..(row + 1) * input_quads]);
        }
        let step = rule.weights()[alpha] * del.time_step;
        for c in 0..6 {
            let at = shape.nu_at(alpha, c);
            k[at / LANES].0[at % LANES] -= step * nodes.turned_momentum(alpha, c);
        }
        if shape.whole_step
            && alpha == 0
            && let Some(responses) = &work.responses
        {
            for (c, change) in responses.fixed_direction_row(i, 0).into_iter().enumerate() {
                let at = shape.eta_at(0) + c;
                k[at / LANES].0[at % LANES] += change;
            }
        }
    }

    let constants = &tree.constants()[i];
    let mut block = [[0.0; MAX_UNKNOWN_NODES]; MAX_UNKNOWN_NODES];
    for alpha in 0..s {
        let k = &work.k[alpha * input_quads..(alpha + 1) * input_quads];
        let step = rule.weights()[alpha] * del.time_step;
        for column in 0..s {
            let gamma = column + 1;
            let b = &work.b[(i * s + column) * input_quads..][..input_quads];
            let mut joint = -constants.damping * rule.derivative(alpha, gamma) / del.time_step;
            if alpha == gamma {
                joint -= constants.stiffness;
            }
            block[alpha][column] = dot(simd, k, b) + step * joint;
        }
    }
    let inverse = invert(block, s).map_err(|pivot| FactorError::SingularPivot { body: i, pivot })?;
    for alpha in 0..s {
        let at = i * s * s + alpha * s;
        work.pivots[at..at + s].copy_from_slice(&inverse[alpha][..s]);
    }

    for column in 0..s {
        let gamma = column + 1;
        let b = &work.b[(i * s + column) * input_quads..][..input_quads];
        let u = &mut work.u[(i * s + column) * output_quads..][..output_quads];
        for (rows, u) in y.chunks(LANES * input_quads).zip(&mut *u) {
            let mut sums = [Lane::splat(simd, 0.0); LANES];
            for (row, sum) in rows.chunks_exact(input_quads).zip(&mut sums) {
                for (y, b) in row.iter().zip(b) {
                    *sum = Lane::load(simd, y).mul_add(Lane::load(simd, b), *sum);
                }
            }
            *u = Lane::sums(sums).quad();
        }
        let mut subtract = |at: usize, value: f64| u[at / LANES].0[at % LANES] -= value;
        for k in 0..6 {
            subtract(shape.momentum_at(gamma, k), nodes.turned_momentum(gamma, k));
            if gamma < s {
                subtract(shape.impulse_at(gamma) + k, nodes.turned_impulse(gamma, k));
            }
        }
        if shape.whole_step
            && gamma == s
            && let Some(responses) = &work.responses
        {
            for (k, change) in responses.moved_impulse(i, s).into_iter().enumerate() {
                subtract(shape.impulse_at(s) + k, -change);
            }
        }
    }
    for alpha in 0..s {
        let w = &mut work.w[(i * s + alpha) * input_quads..][..input_quads];
        w.fill(Quad::ZERO);
        for k in 0..s {
            add_scaled(simd, w, inverse[alpha][k], &work.k[k * input_quads..(k + 1) * input_quads]);
        }
    }
    Ok(())
}

/// The slots from `from` and from `to` on.
#[inline(always)]
pub(super) fn two_slots(slots: &mut [Quad], from: usize, to: usize) -> (&[Quad], &mut [Quad]) {
    if from < to {
        let (low, high) = slots.split_at_mut(to);
        (&low[from..], high)
    } else {
        let (low, high) = slots.split_at_mut(from);
        (high, &mut low[to..])
    }
}

/// Step 7: `Y_par += Y_i - U_i W_i`; the first child of its parent (`ADD` false) overwrites what an earlier use has left.
#[inline(always)]
fn pass_up<S: Simd, const ADD: bool>(
    simd: S,
    work: &mut RecursiveNewton,
    i: usize,
    own: usize,
    parent: usize,
    shape: &Interface,
) {
    let s = shape.s;
    let outputs = shape.outputs();
    let (input_quads, output_quads) = (shape.inputs().div_ceil(LANES), outputs.div_ceil(LANES));
    let size = outputs * input_quads;
    let (source, target) = two_slots(&mut work.slots, own, parent);
    let (source, target) = (&source[..size], &mut target[..size]);
    let w = &work.w[i * s * input_quads..(i + 1) * s * input_quads];
    let u = &work.u[i * s * output_quads..(i + 1) * s * output_quads];
    for row in 0..outputs {
        let from = &source[row * input_quads..(row + 1) * input_quads];
        let to = &mut target[row * input_quads..(row + 1) * input_quads];
        for q in 0..input_quads {
            let mut sum = Lane::load(simd, &from[q]);
            if ADD {
                sum = sum + Lane::load(simd, &to[q]);
            }
            for k in 0..s {
                let factor = Lane::splat(simd, u[k * output_quads + row / LANES].0[row % LANES]);
                sum = factor.neg_mul_add(Lane::load(simd, &w[k * input_quads + q]), sum);
            }
            to[q] = sum.quad();
        }
    }
}
