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
//! Flops per body for s = 1, 2, 3, 4 (factor and one solve): 1.6k, 6.8k, 17k, 34k.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::FactorError;
use crate::lanes::{Instructions, LANES, Quad};
use crate::newton_direction::NewtonDirection;
use crate::recursive_linearize::Responses;
use crate::row_matrix::RowMatrix;
use crate::tree::{KinematicTree, NO_PARENT};

mod base_root;
mod elimination;
mod interface;
mod own_response;
mod sweeps;
mod trapezoidal;

use base_root::BaseRoot;
use elimination::{Factor, TurnedLanes};
use sweeps::{Solve, SolveTransposed};

pub(crate) use elimination::{JointNodes, add_scaled, dot};
pub(crate) use interface::{Interface, MAX_NODES};
pub(crate) use own_response::arm_cross_force;

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
    /// Whether a child's `Ŷ` stands in the slot of the body.
    has_child: Vec<bool>,
    /// Of the body at hand, a group each.
    turned: Vec<TurnedLanes>,
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
            has_child: vec![false; bodies],
            turned: vec![TurnedLanes::ZERO; del.groups],
            b: vec![Quad::ZERO; bodies * s * input_quads],
            w: vec![Quad::ZERO; bodies * s * input_quads],
            c: vec![Quad::ZERO; bodies * s * output_quads],
            u: vec![Quad::ZERO; bodies * s * output_quads],
            pivots: vec![0.0; bodies * s * s],
            k: vec![Quad::ZERO; s * input_quads],
            inputs: vec![Quad::ZERO; bodies * input_quads],
            outputs: vec![Quad::ZERO; bodies * output_quads],
            zero: vec![Quad::ZERO; input_quads.max(output_quads)],
            base: BaseRoot::new(base, &shape),
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
