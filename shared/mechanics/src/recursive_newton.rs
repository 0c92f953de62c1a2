//! Algorithm B.1: the exact Newton direction by recursion over the tree, O(s³ n).
//!
//! The paper announces this algorithm and does not print it. Derivation, in the variations of [`crate::tangent`]:
//!
//! | letter | size | meaning |
//! |---|---|---|
//! | `ζ = (η_ω^1..η_ω^{s-1}, ν^0..ν^s)` | `ni` | what a body tells its children (input interface) |
//! | `y = (Dμ^0..Dμ^s, DΓ^1..DΓ^{s-1})` | `no` | what a body tells its parent (output interface) |
//! | `Y_i`, `y0_i` | `no x ni`, `no` | affine response `y_i = Y_i ζ_i + y0_i` once all descendants are eliminated |
//! | `D_i` | `s x s` | pivot block of body i |
//!
//! `η^0 = 0` (node 0 is given) and `η^s` acts only on row s, which is not part of the Newton matrix; with forces of fixed
//! direction only the angular part of `η` matters. With wrenches that depend on pose or velocity in other ways the
//! interface grows to the full `η` and `DΓ^0`. Joint matrices (columns γ = 1..s, rows α = 0..s-1):
//!
//! ```text
//! B_i: row block η^γ:  S^γ in column γ (γ < s)          row block ν^β:  (b^{βγ}/Δt) S^β in column γ, plus Ṡ^β in column β
//! C_i: row block Dμ^β: a^{αβ} S^β in column α, plus w_α Δt Ṡ^α for β = α          row block DΓ^α: S^α in column α
//! E_i: row α, block ν^α: -w_α Δt (ad^D_μ S^α)ᵀ
//! P_i: column γ: ad^D_μ S^γ in block Dμ^γ, ad^D_Γ S^γ in block DΓ^γ
//! T_i: w_α Δt (∂Q/∂q δ_{αγ} + ∂Q/∂q̇ b^{αγ}/Δt)
//!
//! factor, leaves to root                         solve J x = ρ
//! 1 Y_i  = own M_i, F_η, F_ν                      8 i = n..1: g_i = D_i⁻¹(ρ_i - C_iᵀ y0_i);  y0_par += y0_i + U_i g_i
//! 2 Y_i += Σ_chd Ŷ_j                              9 i = 1..n: x_i = g_i - W_i ζ_par;  ζ_i = ζ_par + B_i x_i
//! 3 K_i  = C_iᵀ Y_i + E_i                         Jᵀ x = ρ is the adjoint of the two sweeps, in reverse:
//! 4 D_i  = K_i B_i + T_i                            i = n..1: g_i = ρ_i + B_iᵀ ζ̄_i;  ζ̄_par += ζ̄_i - W_iᵀ g_i
//! 5 U_i  = Y_i B_i - P_i                            i = 1..n: x_i = D_i⁻ᵀ(g_i + U_iᵀ ȳ_par);  ȳ_i = ȳ_par - C_i x_i
//! 6 W_i  = D_i⁻¹ K_i
//! 7 Ŷ_i  = Y_i - U_i W_i
//! ```
//!
//! Why it is exact: (L) of [`crate::tangent`] is `δr_i = C_iᵀ y_i + E_i ζ_i + T_i x_i` with `ζ_i = ζ_par + B_i x_i` and, by the
//! inward recursion, `y_par = ... + y_i - P_i x_i`. Inserting `y_i = Y_i ζ_i + y0_i` gives row 8 with `D_i`, and step 7.
//! `D_i` equals the pivot of the leaf-to-root block LU. A floating base is the root with `6 s` columns
//! ([`crate::floating_base`]); only steps 1-4 and 8-9 apply to it.
//!
//! Flops per body for s = 1, 2, 3, 4 (factor and one solve): 1.7k, 6.8k, 17k, 34k.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Matrix6;

use crate::del_hessian::DelHessian;
use crate::del_residual::{DelWorkspace, load_arm};
use crate::dense_lu::DenseLu;
use crate::errors::FactorError;
use crate::kinetic_hessian::own_inertia;
use crate::lanes::{
    Instructions, Kernel, LANES, Lane, Lane3, Lane6, Quad, Simd, dot3, dual_bracket, load, outer, splat,
    store,
};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::newton_direction::{NewtonDirection, base_matrix, held_rows_matrix, second_order_matrix};
use crate::recursive_linearize::{BodyFactors, Responses};
use crate::row_matrix::RowMatrix;
use crate::small_inverse::invert;
use crate::spatial::{Twist, Wrench};
use crate::tree::{KinematicTree, NO_PARENT};

pub(crate) const MAX_NODES: usize = MAX_UNKNOWN_NODES + 1;

/// Where the blocks of the interface vectors are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Interface {
    pub s: usize,
    /// Rows of one `η` block: 3, or 6 with general wrenches.
    pub eta: usize,
    /// First node with a `DΓ` block: 1, or 0 with general wrenches.
    pub first_impulse: usize,
    /// Also `η^0` and `DΓ^s`, which the linearisation needs ([`crate::recursive_linearize`]); not with general wrenches.
    pub whole_step: bool,
}

impl Interface {
    /// First node with an `η` block.
    #[inline(always)]
    fn first_eta(&self) -> usize {
        usize::from(!self.whole_step)
    }
    #[inline(always)]
    pub fn inputs(&self) -> usize {
        self.eta * (self.s - self.first_eta()) + 6 * (self.s + 1)
    }
    #[inline(always)]
    pub fn outputs(&self) -> usize {
        6 * (self.s + 1) + 6 * (self.s + usize::from(self.whole_step) - self.first_impulse)
    }
    #[inline(always)]
    pub fn eta_at(&self, gamma: usize) -> usize {
        self.eta * (gamma - self.first_eta())
    }
    #[inline(always)]
    pub fn nu_at(&self, beta: usize) -> usize {
        self.eta * (self.s - self.first_eta()) + 6 * beta
    }
    #[inline(always)]
    pub fn momentum_at(&self, beta: usize) -> usize {
        6 * beta
    }
    #[inline(always)]
    pub fn impulse_at(&self, alpha: usize) -> usize {
        6 * (self.s + 1) + 6 * (alpha - self.first_impulse)
    }
}

/// Factorisation workspace of Algorithm B.1.
#[derive(Clone, Debug)]
pub struct RecursiveNewton {
    instructions: Instructions,
    shape: Interface,
    /// Quads of an input row and of an output row.
    input_quads: usize,
    output_quads: usize,
    /// Transient `Y` matrices, one slot per open branch.
    slots: Vec<Quad>,
    slot_of: Vec<usize>,
    /// Per body, `s` rows each: `Bᵀ`, `W` (input rows), `Cᵀ`, `Uᵀ` (output rows).
    b: Vec<Quad>,
    w: Vec<Quad>,
    c: Vec<Quad>,
    u: Vec<Quad>,
    /// `D_i⁻¹`, row-major.
    pivots: Vec<f64>,
    /// `K_i` of the body at hand.
    k: Vec<Quad>,
    /// `ζ_i` and `y0_i` of the solve.
    inputs: Vec<Quad>,
    outputs: Vec<Quad>,
    zero: Vec<Quad>,
    base: BaseRoot,
    column: Vec<f64>,
    responses: Option<Responses>,
}

/// The root block of a floating tree.
#[derive(Clone, Debug)]
struct BaseRoot {
    lu: DenseLu,
    /// `C_1ᵀ`: `6 s` output rows; `B_1ᵀ`: `6 s` input rows; scalar, row-major.
    c: Vec<f64>,
    b: Vec<f64>,
    rhs: Vec<f64>,
}

impl RecursiveNewton {
    /// For the steps of `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let s = del.unknown_nodes();
        let general = !del.gains.is_empty();
        let (eta, first_impulse) = if general { (6, 0) } else { (3, 1) };
        Self::with_interface(tree, del, Interface { s, eta, first_impulse, whole_step: false })
    }

    /// With the interface of the linearisation and its responses, for fixed trees without general wrenches.
    pub(crate) fn for_whole_step(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let s = del.unknown_nodes();
        let shape = Interface { s, eta: 3, first_impulse: 1, whole_step: true };
        let mut work = Self::with_interface(tree, del, shape);
        work.responses = Some(Responses::new(tree, del, &shape));
        work
    }

    fn with_interface(tree: &KinematicTree, del: &DelWorkspace, shape: Interface) -> Self {
        let s = shape.s;
        let input_quads = shape.inputs().div_ceil(LANES);
        let output_quads = shape.outputs().div_ceil(LANES);
        let (slot_of, slot_count) = assign_slots(tree);
        let bodies = tree.body_count();
        let base = 6 * s * usize::from(tree.is_floating());
        Self {
            instructions: del.instructions,
            shape,
            input_quads,
            output_quads,
            slots: vec![Quad::ZERO; slot_count * shape.outputs() * input_quads],
            slot_of,
            b: vec![Quad::ZERO; bodies * s * input_quads],
            w: vec![Quad::ZERO; bodies * s * input_quads],
            c: vec![Quad::ZERO; bodies * s * output_quads],
            u: vec![Quad::ZERO; bodies * s * output_quads],
            pivots: vec![0.0; bodies * s * s],
            k: vec![Quad::ZERO; s * input_quads],
            inputs: vec![Quad::ZERO; bodies * input_quads],
            outputs: vec![Quad::ZERO; bodies * output_quads],
            zero: vec![Quad::ZERO; input_quads.max(output_quads)],
            base: BaseRoot {
                lu: DenseLu::new(base),
                c: vec![0.0; base * shape.outputs()],
                b: vec![0.0; base * shape.inputs()],
                rhs: vec![0.0; base],
            },
            column: vec![0.0; s * tree.dof()],
            responses: None,
        }
    }

    pub(crate) fn shape(&self) -> &Interface {
        &self.shape
    }

    /// What the linearisation takes from the factorisation, for a workspace made for whole steps.
    pub(crate) fn responses(&self) -> Option<&Responses> {
        self.responses.as_ref()
    }

    /// The inverse pivot block `D_i⁻¹` of a body with a joint (s x s, row-major).
    pub fn inverse_pivot(&self, body: usize) -> &[f64] {
        let s = self.shape.s;
        &self.pivots[body * s * s..(body + 1) * s * s]
    }

    /// Numbers in the input and output interface of a body.
    pub fn interface_sizes(&self) -> (usize, usize) {
        (self.shape.inputs(), self.shape.outputs())
    }
}

/// A slot for every body such that bodies whose `Y` is open at the same time differ.
pub(crate) fn assign_slots(tree: &KinematicTree) -> (Vec<usize>, usize) {
    let n = tree.body_count();
    let mut slot_of = vec![usize::MAX; n];
    let mut free: Vec<usize> = Vec::new();
    let mut count = 0;
    let mut take = |free: &mut Vec<usize>| {
        free.pop().unwrap_or_else(|| {
            count += 1;
            count - 1
        })
    };
    for i in (0..n).rev() {
        if slot_of[i] == usize::MAX {
            slot_of[i] = take(&mut free);
        }
        let parent = tree.constants()[i].parent;
        if parent != NO_PARENT && slot_of[parent] == usize::MAX {
            slot_of[parent] = take(&mut free);
        }
        free.push(slot_of[i]);
    }
    (slot_of, count)
}

impl NewtonDirection for RecursiveNewton {
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError> {
        self.slots.fill(Quad::ZERO);
        if let Some(responses) = &mut self.responses {
            responses.clear();
        }
        let instructions = self.instructions;
        instructions.dispatch(Factor { tree, del, work: self })?;
        if tree.is_floating() { self.factor_base(del) } else { Ok(()) }
    }

    fn solve(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        let instructions = self.instructions;
        instructions.dispatch(Solve { tree, work: self, rhs });
    }

    fn solve_transposed(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        let instructions = self.instructions;
        instructions.dispatch(SolveTransposed { tree, work: self, rhs });
    }

    fn solve_many(&mut self, tree: &KinematicTree, rhs: &mut RowMatrix) {
        let mut column = core::mem::take(&mut self.column);
        for c in 0..rhs.columns() {
            for (r, x) in column.iter_mut().enumerate() {
                *x = rhs.get(r, c);
            }
            self.solve(tree, &mut column);
            for (r, x) in column.iter().enumerate() {
                rhs.set(r, c, *x);
            }
        }
        self.column = column;
    }

    fn hessian(&self) -> Option<&DelHessian> {
        None
    }
}

/// What steps 3 to 6 need of a joint, node by node.
pub(crate) struct JointNodes {
    pub twist: [[f64; 6]; MAX_NODES],
    pub rate: [[f64; 6]; MAX_NODES],
    /// `ad^D_μ S`, `ad^D_Γ S`.
    pub turned_momentum: [[f64; 6]; MAX_NODES],
    pub turned_impulse: [[f64; 6]; MAX_NODES],
}

struct Factor<'a> {
    tree: &'a KinematicTree,
    del: &'a DelWorkspace,
    work: &'a mut RecursiveNewton,
}

impl Kernel for Factor<'_> {
    type Output = Result<(), FactorError>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        // With constant arguments the loops over nodes and rows unroll (reduced interface: 12, 21 inputs).
        let shape = self.work.shape;
        match (shape.s, shape.eta, shape.whole_step) {
            (1, 3, false) if S::SPECIALISE => {
                factor(simd, self, Interface { s: 1, eta: 3, first_impulse: 1, whole_step: false })
            }
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
    let input_quads = shape.inputs().div_ceil(LANES);
    let size = shape.outputs() * input_quads;
    for i in (0..tree.body_count()).rev() {
        own_response(simd, tree, del, work, i, &shape);
        if tree.is_base(i) {
            continue;
        }
        let nodes = joint_nodes(simd, del, i);
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
            pass_up(simd, work, i, own, work.slot_of[parent] * size, &shape);
        }
        work.slots[own..own + size].fill(Quad::ZERO);
    }
    Ok(())
}

/// Step 1: the body's own inertia and wrench gains, added to what its children have left in its slot.
#[inline(always)]
fn own_response<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    i: usize,
    shape: &Interface,
) {
    let constants = &tree.constants()[i];
    let groups = del.groups;
    let gravity: [f64; 3] = (*tree.gravity_w()).into();
    let stride = shape.inputs().div_ceil(LANES);
    let size = shape.outputs() * stride;
    let start = work.slot_of[i] * size;
    let y = &mut work.slots[start..start + size];
    let mut put = |row: usize, column: usize, value: f64| {
        y[row * stride + column / LANES].0[column % LANES] += value;
    };
    for g in 0..groups {
        let body = &del.bodies[i * groups + g];
        let (h, j) = own_inertia(simd, constants, body);
        let (h, j) = (store(h), store(j));
        let weight: Lane3<S> = splat(simd, &gravity.map(|x| x * constants.mass));
        let gain = store(arm_cross_force(load(simd, &body.position), weight));
        for lane in 0..LANES {
            let alpha = g * LANES + lane;
            if alpha > shape.s {
                break;
            }
            let (row, column) = (shape.momentum_at(alpha), shape.nu_at(alpha));
            let h = h.map(|q| q.0[lane]);
            let j = j.map(|q| q.0[lane]);
            let inertia = [[j[0], j[3], j[4]], [j[3], j[1], j[5]], [j[4], j[5], j[2]]];
            let cross = [[0.0, -h[2], h[1]], [h[2], 0.0, -h[0]], [-h[1], h[0], 0.0]];
            for r in 0..3 {
                for c in 0..3 {
                    put(row + r, column + c, inertia[r][c]);
                    if r != c {
                        put(row + r, column + 3 + c, cross[r][c]);
                        put(row + 3 + r, column + c, -cross[r][c]);
                    }
                }
                put(row + 3 + r, column + 3 + r, constants.mass);
            }
            if alpha >= 1 && alpha < shape.s {
                let step = del.weights[g].0[lane];
                let f = gravity.map(|x| x * constants.mass * step);
                put_dead_load(&mut put, shape, alpha, gain.map(|q| q.0[lane] * step), f);
            }
        }
    }
    for (index, dead) in del.loads.iter().enumerate().filter(|(_, dead)| dead.body == i) {
        for g in 0..groups {
            let (force, arm) =
                load_arm(simd, dead, &del.load_forces[index * groups + g], &del.bodies[i * groups + g]);
            let (gain, force) = (store(arm_cross_force(arm, force)), store(force));
            for lane in 0..LANES {
                let alpha = g * LANES + lane;
                if alpha >= 1 && alpha < shape.s {
                    let step = del.weights[g].0[lane];
                    let f = if dead.couple { [0.0; 3] } else { force.map(|q| q.0[lane] * step) };
                    put_dead_load(&mut put, shape, alpha, gain.map(|q| q.0[lane] * step), f);
                }
            }
        }
    }
    if del.gains.is_empty() {
        return;
    }
    for alpha in 0..shape.s {
        let (g, lane) = (alpha / LANES, alpha % LANES);
        let gain = &del.gains[i * groups + g];
        let step = del.weights[g].0[lane];
        for r in 0..6 {
            for c in 0..6 {
                let at = 6 * r + c;
                put(shape.impulse_at(alpha) + r, shape.nu_at(alpha) + c, step * gain.nu[at].0[lane]);
                if alpha >= 1 {
                    put(shape.impulse_at(alpha) + r, shape.eta_at(alpha) + c, step * gain.eta[at].0[lane]);
                }
            }
        }
    }
}

/// `x^ f^` of an arm and a force, row-major.
#[inline(always)]
pub(crate) fn arm_cross_force<S: Simd>(arm: Lane3<S>, force: Lane3<S>) -> [Lane<S>; 9] {
    let along = dot3(arm, force);
    let mut product = outer(force, arm);
    for k in 0..3 {
        product[4 * k] = product[4 * k] - along;
    }
    product
}

/// `F_η η = [A η_ω; f×η_ω]` in the block `(DΓ^α, η^α)`.
#[inline(always)]
fn put_dead_load(
    put: &mut impl FnMut(usize, usize, f64),
    shape: &Interface,
    alpha: usize,
    gain: [f64; 9],
    f: [f64; 3],
) {
    let (row, column) = (shape.impulse_at(alpha), shape.eta_at(alpha));
    let cross = [0.0, -f[2], f[1], f[2], 0.0, -f[0], -f[1], f[0], 0.0];
    for r in 0..3 {
        for c in 0..3 {
            put(row + r, column + c, gain[3 * r + c]);
            if r != c {
                put(row + 3 + r, column + c, cross[3 * r + c]);
            }
        }
    }
}

#[inline(always)]
fn joint_nodes<S: Simd>(simd: S, del: &DelWorkspace, i: usize) -> JointNodes {
    let mut nodes = JointNodes {
        twist: [[0.0; 6]; MAX_NODES],
        rate: [[0.0; 6]; MAX_NODES],
        turned_momentum: [[0.0; 6]; MAX_NODES],
        turned_impulse: [[0.0; 6]; MAX_NODES],
    };
    for g in 0..del.groups {
        let body = &del.bodies[i * del.groups + g];
        let twist: Lane6<S> = load(simd, &body.joint_twist);
        let turned_momentum = store(dual_bracket(load(simd, &body.momentum), twist));
        let turned_impulse = store(dual_bracket(load(simd, &body.impulse), twist));
        for lane in 0..LANES {
            let alpha = g * LANES + lane;
            if alpha >= MAX_NODES {
                break;
            }
            for k in 0..6 {
                nodes.twist[alpha][k] = body.joint_twist[k].0[lane];
                nodes.rate[alpha][k] = body.joint_twist_rate[k].0[lane];
                nodes.turned_momentum[alpha][k] = turned_momentum[k].0[lane];
                nodes.turned_impulse[alpha][k] = turned_impulse[k].0[lane];
            }
        }
    }
    nodes
}

/// `Bᵀ` and `Cᵀ` of a joint.
#[inline(always)]
fn joint_matrices(
    del: &DelWorkspace,
    work: &mut RecursiveNewton,
    i: usize,
    nodes: &JointNodes,
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
                put(shape.eta_at(gamma) + k, nodes.twist[gamma][k]);
            }
        }
        for beta in 0..=s {
            let slope = rule.derivative(beta, gamma) * inverse_step;
            for k in 0..6 {
                let mut value = slope * nodes.twist[beta][k];
                if beta == gamma {
                    value += nodes.rate[beta][k];
                }
                put(shape.nu_at(beta) + k, value);
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
                let mut value = factor * nodes.twist[beta][k];
                if beta == alpha {
                    value += step * nodes.rate[beta][k];
                }
                put(shape.momentum_at(beta) + k, value);
            }
        }
        if alpha >= shape.first_impulse {
            for k in 0..6 {
                put(shape.impulse_at(alpha) + k, nodes.twist[alpha][k]);
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
    let [a, b, c, d] = sum.quad().0;
    (a + c) + (b + d)
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
    nodes: &JointNodes,
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
        for (c, turned) in nodes.turned_momentum[alpha].iter().enumerate() {
            let at = shape.nu_at(alpha) + c;
            k[at / LANES].0[at % LANES] -= step * turned;
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
        for row in 0..outputs {
            u[row / LANES].0[row % LANES] = dot(simd, &y[row * input_quads..(row + 1) * input_quads], b);
        }
        let mut subtract = |at: usize, value: f64| u[at / LANES].0[at % LANES] -= value;
        for k in 0..6 {
            subtract(shape.momentum_at(gamma) + k, nodes.turned_momentum[gamma][k]);
            if gamma < s {
                subtract(shape.impulse_at(gamma) + k, nodes.turned_impulse[gamma][k]);
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

/// Step 7: `Y_par += Y_i - U_i W_i`.
#[inline(always)]
fn pass_up<S: Simd>(
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
    let (source, target) = if own < parent {
        let (low, high) = work.slots.split_at_mut(parent);
        (&low[own..own + size], &mut high[..size])
    } else {
        let (low, high) = work.slots.split_at_mut(own);
        (&high[..size], &mut low[parent..parent + size])
    };
    let w = &work.w[i * s * input_quads..(i + 1) * s * input_quads];
    let u = &work.u[i * s * output_quads..(i + 1) * s * output_quads];
    for row in 0..outputs {
        let from = &source[row * input_quads..(row + 1) * input_quads];
        let to = &mut target[row * input_quads..(row + 1) * input_quads];
        for q in 0..input_quads {
            let mut sum = Lane::load(simd, &to[q]) + Lane::load(simd, &from[q]);
            for k in 0..s {
                let factor = Lane::splat(simd, u[k * output_quads + row / LANES].0[row % LANES]);
                sum = factor.neg_mul_add(Lane::load(simd, &w[k * input_quads + q]), sum);
            }
            to[q] = sum.quad();
        }
    }
}

struct Solve<'a> {
    tree: &'a KinematicTree,
    work: &'a mut RecursiveNewton,
    rhs: &'a mut [f64],
}

impl Kernel for Solve<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, work, rhs } = self;
        let s = work.shape.s;
        let (ni, no) = (work.input_quads, work.output_quads);
        work.outputs.fill(Quad::ZERO);
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let at = tree.joint_dof(i) * s;
            let (earlier, own) = work.outputs.split_at_mut(i * no);
            let own = &own[..no];
            for alpha in 0..s {
                let c = &work.c[(i * s + alpha) * no..][..no];
                reduced[alpha] = rhs[at + alpha] - dot(simd, c, own);
            }
            let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
            for alpha in 0..s {
                rhs[at + alpha] = (0..s).map(|k| inverse[alpha * s + k] * reduced[k]).sum();
            }
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let target = &mut earlier[parent * no..(parent + 1) * no];
                add_scaled(simd, target, 1.0, own);
                for k in 0..s {
                    add_scaled(simd, target, rhs[at + k], &work.u[(i * s + k) * no..][..no]);
                }
            }
        }
        if tree.is_floating() {
            work.solve_base(rhs);
        }
        for i in tree.first_joint_body()..tree.body_count() {
            let at = tree.joint_dof(i) * s;
            let parent = tree.constants()[i].parent;
            let (earlier, own) = work.inputs.split_at_mut(i * ni);
            let from = if parent == NO_PARENT { &work.zero[..ni] } else { &earlier[parent * ni..][..ni] };
            let own = &mut own[..ni];
            own.copy_from_slice(from);
            for alpha in 0..s {
                rhs[at + alpha] -= dot(simd, &work.w[(i * s + alpha) * ni..][..ni], from);
            }
            for k in 0..s {
                add_scaled(simd, own, rhs[at + k], &work.b[(i * s + k) * ni..][..ni]);
            }
        }
    }
}

struct SolveTransposed<'a> {
    tree: &'a KinematicTree,
    work: &'a mut RecursiveNewton,
    rhs: &'a mut [f64],
}

impl Kernel for SolveTransposed<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, work, rhs } = self;
        let s = work.shape.s;
        let (ni, no) = (work.input_quads, work.output_quads);
        work.inputs.fill(Quad::ZERO);
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let at = tree.joint_dof(i) * s;
            let (earlier, own) = work.inputs.split_at_mut(i * ni);
            let own = &own[..ni];
            for k in 0..s {
                rhs[at + k] += dot(simd, &work.b[(i * s + k) * ni..][..ni], own);
            }
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let target = &mut earlier[parent * ni..(parent + 1) * ni];
                add_scaled(simd, target, 1.0, own);
                for k in 0..s {
                    add_scaled(simd, target, -rhs[at + k], &work.w[(i * s + k) * ni..][..ni]);
                }
            }
        }
        if tree.is_floating() {
            work.solve_base_transposed(rhs);
        }
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for i in tree.first_joint_body()..tree.body_count() {
            let at = tree.joint_dof(i) * s;
            let parent = tree.constants()[i].parent;
            let (earlier, own) = work.outputs.split_at_mut(i * no);
            let from = if parent == NO_PARENT { &work.zero[..no] } else { &earlier[parent * no..][..no] };
            let own = &mut own[..no];
            for k in 0..s {
                let pushed = if parent == NO_PARENT {
                    0.0
                } else {
                    dot(simd, &work.u[(i * s + k) * no..][..no], from)
                };
                reduced[k] = rhs[at + k] + pushed;
            }
            let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
            for k in 0..s {
                rhs[at + k] = (0..s).map(|alpha| inverse[alpha * s + k] * reduced[alpha]).sum();
            }
            own.copy_from_slice(from);
            for k in 0..s {
                add_scaled(simd, own, -rhs[at + k], &work.c[(i * s + k) * no..][..no]);
            }
        }
    }
}

/// The base as root: `6 s` columns, dense.
impl RecursiveNewton {
    fn factor_base(&mut self, del: &DelWorkspace) -> Result<(), FactorError> {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let order = 6 * s;
        let nodes = BaseNodes::new(del);
        nodes.fill_b(del, &shape, &mut self.base.b);
        nodes.fill_c(del, &shape, &mut self.base.c);
        let start = self.slot_of[0] * no * self.input_quads;
        let y = |row: usize, column: usize| {
            self.slots[start + row * self.input_quads + column / LANES].0[column % LANES]
        };
        let entries = self.base.lu.entries_mut();
        let mut k_row = [0.0; 12 * MAX_NODES];
        for row in 0..order {
            for (column, k) in k_row.iter_mut().enumerate().take(ni) {
                *k = (0..no).map(|r| self.base.c[row * no + r] * y(r, column)).sum();
            }
            nodes.add_e(del, &shape, row, &mut k_row);
            for column in 0..order {
                entries[row * order + column] =
                    (0..ni).map(|j| k_row[j] * self.base.b[column * ni + j]).sum();
            }
        }
        nodes.add_t(del, s, entries);
        for alpha in 0..s {
            let held = held_rows_matrix(del, alpha);
            for k in 0..6 {
                for l in 0..6 {
                    entries[(k * s + alpha) * order + l * s + s - 1] -= held[(k, l)];
                }
            }
        }
        self.base.lu.factor().map_err(|(_, pivot)| FactorError::SingularPivot { body: 0, pivot })
    }

    fn solve_base(&mut self, rhs: &mut [f64]) {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let root = &mut self.base;
        for row in 0..6 * s {
            let pushed: f64 =
                (0..no).map(|r| root.c[row * no + r] * self.outputs[r / LANES].0[r % LANES]).sum();
            root.rhs[row] = rhs[row] - pushed;
        }
        root.lu.solve(&mut root.rhs);
        rhs[..6 * s].copy_from_slice(&root.rhs);
        for j in 0..ni {
            self.inputs[j / LANES].0[j % LANES] =
                (0..6 * s).map(|column| root.b[column * ni + j] * root.rhs[column]).sum();
        }
    }

    fn solve_base_transposed(&mut self, rhs: &mut [f64]) {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let root = &mut self.base;
        for column in 0..6 * s {
            let pulled: f64 =
                (0..ni).map(|j| root.b[column * ni + j] * self.inputs[j / LANES].0[j % LANES]).sum();
            root.rhs[column] = rhs[column] + pulled;
        }
        root.lu.solve_transposed(&mut root.rhs);
        rhs[..6 * s].copy_from_slice(&root.rhs);
        self.outputs[..self.output_quads].fill(Quad::ZERO);
        for r in 0..no {
            self.outputs[r / LANES].0[r % LANES] =
                -(0..6 * s).map(|row| root.c[row * no + r] * root.rhs[row]).sum::<f64>();
        }
    }
}

/// `S, Ṡ, N, Ṅ` and wrenches of the base at every node.
struct BaseNodes {
    twist: [Matrix6<f64>; MAX_NODES],
    rate: [Matrix6<f64>; MAX_NODES],
    momentum: [Wrench; MAX_NODES],
    impulse: [Wrench; MAX_NODES],
}

impl BaseNodes {
    fn new(del: &DelWorkspace) -> Self {
        let mut nodes = Self {
            twist: [Matrix6::zeros(); MAX_NODES],
            rate: [Matrix6::zeros(); MAX_NODES],
            momentum: [Wrench::default(); MAX_NODES],
            impulse: [Wrench::default(); MAX_NODES],
        };
        for alpha in 0..=del.unknown_nodes() {
            nodes.twist[alpha] = base_matrix(del, alpha);
            nodes.rate[alpha] = base_rate_matrix(del, alpha);
            (nodes.momentum[alpha], nodes.impulse[alpha]) = del.body_momentum_and_impulse(0, alpha);
        }
        nodes
    }

    /// `δξ^β = c X` for the column block γ.
    fn follow(beta: usize, gamma: usize, s: usize) -> f64 {
        let mut c = 0.0;
        if beta == gamma {
            c += 1.0;
        }
        if beta == 0 && gamma == s {
            c -= 1.0;
        }
        c
    }

    /// `δξ̇^β = d X` for the column block γ.
    fn slope(del: &DelWorkspace, beta: usize, gamma: usize) -> f64 {
        let mut d = del.rule.derivative(beta, gamma);
        if gamma == del.unknown_nodes() {
            d -= del.rule.derivative(beta, 0);
        }
        d / del.time_step
    }

    fn fill_b(&self, del: &DelWorkspace, shape: &Interface, b: &mut [f64]) {
        let (s, ni) = (shape.s, shape.inputs());
        b.fill(0.0);
        for k in 0..6 {
            for gamma in 1..=s {
                let row = &mut b[(k * s + gamma - 1) * ni..][..ni];
                for node in 1..s {
                    let mut column = self.twist[node].column(k) * Self::follow(node, gamma, s);
                    if gamma == s {
                        column += self.twist[0].column(k);
                    }
                    for r in 0..shape.eta {
                        row[shape.eta_at(node) + r] = column[r];
                    }
                }
                for beta in 0..=s {
                    let column = self.twist[beta].column(k) * Self::slope(del, beta, gamma)
                        + self.rate[beta].column(k) * Self::follow(beta, gamma, s);
                    for r in 0..6 {
                        row[shape.nu_at(beta) + r] = column[r];
                    }
                }
            }
        }
    }

    fn fill_c(&self, del: &DelWorkspace, shape: &Interface, c: &mut [f64]) {
        let (s, no) = (shape.s, shape.outputs());
        let rule = &del.rule;
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        c.fill(0.0);
        for k in 0..6 {
            for alpha in 0..s {
                let row = &mut c[(k * s + alpha) * no..][..no];
                for beta in 0..=s {
                    let mut factor = rule.weighted_derivative(alpha, beta);
                    let mut rate = if beta == alpha { step(alpha) } else { 0.0 };
                    if alpha == 0 {
                        factor -= rule.weighted_derivative(s, beta);
                        if beta == s {
                            rate -= step(s);
                        }
                    }
                    let column = self.twist[beta].column(k) * factor + self.rate[beta].column(k) * rate;
                    for r in 0..6 {
                        row[shape.momentum_at(beta) + r] = column[r];
                    }
                }
                for node in shape.first_impulse..s {
                    let mut column = self.twist[node].column(k) * f64::from(u8::from(node == alpha));
                    if alpha == 0 {
                        column += self.twist[s].column(k);
                    }
                    for r in 0..6 {
                        row[shape.impulse_at(node) + r] = column[r];
                    }
                }
            }
        }
    }

    fn add_e(&self, del: &DelWorkspace, shape: &Interface, row: usize, k_row: &mut [f64]) {
        let s = shape.s;
        let (k, alpha) = (row / s, row % s);
        let mut add = |node: usize, sign: f64| {
            let twist = Twist::from_vector(&self.twist[node].column(k).into_owned());
            let turned = self.momentum[node].dual_bracket(&twist).to_vector();
            let step = sign * del.rule.weights()[node] * del.time_step;
            for r in 0..6 {
                k_row[shape.nu_at(node) + r] += step * turned[r];
            }
        };
        add(alpha, -1.0);
        if alpha == 0 {
            add(s, 1.0);
        }
    }

    /// The terms of `δr` that contain `δξ`, `δξ̇` or `η` explicitly.
    fn add_t(&self, del: &DelWorkspace, s: usize, entries: &mut [f64]) {
        let rule = &del.rule;
        let order = 6 * s;
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        let mut curved = [Matrix6::zeros(); MAX_NODES];
        let mut curved_rate = [Matrix6::zeros(); MAX_NODES];
        let mut curved_impulse = [Matrix6::zeros(); MAX_NODES];
        for alpha in 0..=s {
            curved[alpha] = second_order_matrix(del, alpha, &self.momentum[alpha]);
            curved_rate[alpha] = second_order_rate_matrix(del, alpha, &self.momentum[alpha]);
            curved_impulse[alpha] = second_order_matrix(del, alpha, &self.impulse[alpha]);
        }
        let before_end = del.base_momentum_before_end();
        let row_terms = |alpha: usize, gamma: usize, with_impulse: bool| {
            let follow = Self::follow(alpha, gamma, s);
            let mut block =
                (curved_rate[alpha] * follow + curved[alpha] * Self::slope(del, alpha, gamma)) * step(alpha);
            if with_impulse {
                block += curved_impulse[alpha] * follow;
            }
            for beta in 0..=s {
                block +=
                    curved[beta] * (rule.weighted_derivative(alpha, beta) * Self::follow(beta, gamma, s));
            }
            block
        };
        for gamma in 1..=s {
            for alpha in 0..s {
                let mut block = row_terms(alpha, gamma, true);
                if alpha == 0 {
                    block -= row_terms(s, gamma, false);
                    block += second_order_matrix(del, 0, &del.start_momentum()) * Self::follow(0, gamma, s);
                    block += second_order_matrix(del, s, &before_end) * Self::follow(s, gamma, s);
                    block += self.twist[s].tr_mul(&self.turned_impulses(&before_end, gamma, s));
                }
                for k in 0..6 {
                    for l in 0..6 {
                        entries[(k * s + alpha) * order + l * s + gamma - 1] += block[(k, l)];
                    }
                }
            }
        }
    }

    /// `ad^D_G η^s - Σ_{α<s} ad^D_{Γ^α} η^α` for the column block γ.
    fn turned_impulses(&self, before_end: &Wrench, gamma: usize, s: usize) -> Matrix6<f64> {
        let eta = |alpha: usize| {
            let mut twists = self.twist[alpha] * Self::follow(alpha, gamma, s);
            if gamma == s {
                twists += self.twist[0];
            }
            twists
        };
        let turn = |wrench: &Wrench, twists: Matrix6<f64>| {
            let mut out = Matrix6::zeros();
            for c in 0..6 {
                let twist = Twist::from_vector(&twists.column(c).into_owned());
                out.set_column(c, &wrench.dual_bracket(&twist).to_vector());
            }
            out
        };
        let mut total = turn(before_end, eta(s));
        for alpha in 0..s {
            total -= turn(&self.impulse[alpha], eta(alpha));
        }
        total
    }
}

/// `Ṡ^α` of the base.
fn base_rate_matrix(del: &DelWorkspace, alpha: usize) -> Matrix6<f64> {
    let base = &del.base[alpha / LANES];
    let lane = alpha % LANES;
    let z = nalgebra::Matrix3::from_fn(|r, c| base.z[3 * r + c].0[lane]);
    let z_dot = nalgebra::Matrix3::from_fn(|r, c| base.z_dot[3 * r + c].0[lane]);
    let position = nalgebra::Vector3::from_fn(|r, _| base.position[r].0[lane]);
    let velocity = nalgebra::Vector3::from_fn(|r, _| base.position_dot[r].0[lane]);
    let mut rate = Matrix6::zeros();
    rate.fixed_view_mut::<3, 3>(0, 0).copy_from(&z_dot);
    let lower = crate::spatial::skew(&velocity) * z + crate::spatial::skew(&position) * z_dot;
    rate.fixed_view_mut::<3, 3>(3, 0).copy_from(&lower);
    rate
}

/// `Ṅ^α(X)` of the base.
fn second_order_rate_matrix(del: &DelWorkspace, alpha: usize, x: &Wrench) -> Matrix6<f64> {
    struct Rate<'a>(&'a DelWorkspace, usize, &'a Wrench);
    impl Kernel for Rate<'_> {
        type Output = Matrix6<f64>;
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Matrix6<f64> {
            let Self(del, alpha, wrench) = self;
            let wrench: [f64; 6] = wrench.to_vector().into();
            let lanes =
                crate::floating_base::second_order_rate(simd, &del.base[alpha / LANES], splat(simd, &wrench));
            let n = store(lanes);
            Matrix6::from_fn(|r, c| if c < 3 { n[3 * r + c].0[alpha % LANES] } else { 0.0 })
        }
    }
    del.instructions.dispatch(Rate(del, alpha, x))
}
