//! The derivative of the DEL equations by the nodes of the step: the blocks `H[α,γ]`, O(s² Σ depth).
//!
//! For a pair of coordinates `(i, j)`, `j` on the branch of `i` (all other pairs are zero),
//!
//! ```text
//! H[α,γ] = δ_{αγ} w_α Δt (K_qq - V_qq + τ_q)^α + w_α b^{αγ} (K_qq̇ + τ_q̇)^α + w_γ b^{γα} (K_q̇q)^γ + (1/Δt) Σ_β w_β b^{βα} b^{βγ} K_q̇q̇^β
//! K_q̇q[i,j] = ∂²K/∂q̇_i∂q_j,  K_qq̇ = K_q̇qᵀ
//! ```
//!
//! with Algorithms 2 and 3 ([`crate::kinetic_hessian`], [`crate::gravity_hessian`]) at every node. Without dissipation or
//! body wrenches `H[α,γ] = H[γ,α]ᵀ`, so one block serves `(i,j)` and `(j,i)`. The Newton matrix is
//! `J[α,γ] = H[α,γ]`, `α = 0..s-1`, `γ = 1..s`; row `s` and column 0 belong to the linearisation.
//!
//! Wrenches that follow the body or depend on its velocity (drag, constant body wrenches, laws) add, with
//! `G_i, 𝒴_i, 𝒵_i` the sums of `F, F_η, F_ν` over the subtree of i and `τ_i = S_iᵀ G_i`:
//!
//! ```text
//! ∂τ_i/∂q_j = S_iᵀ(𝒵_i Ṡ_j + 𝒴_i S_j)     ∂τ_i/∂q̇_j = S_iᵀ 𝒵_i S_j                                   j in anc(i) + {i}
//! ∂τ_j/∂q_i = S_jᵀ(𝒵_i Ṡ_i + 𝒴_i S_i - ad^D_{G_i} S_i)     ∂τ_j/∂q̇_i = S_jᵀ 𝒵_i S_i
//! ```
//!
//! # Floating base
//!
//! The six chart coordinates `ξ` enter like six coordinates with the columns of `S, Ṡ` ([`crate::floating_base`]); the
//! base-base block has the extra terms `K_ξ̇ξ += N(μ)`, `K_ξξ += Sᵀ ad^D_μ Ṡ + Ṅ(μ)`, `τ_ξ += N(Γ)`. The Newton matrix then needs the
//! response to a rigid shift (`shift_row`: `S_iᵀ𝒴_i`) and the change of the total impulse (`impulse_column`):
//!
//! ```text
//! J[α,γ] = H[α,γ];  base columns of γ = s:  += -H[α,0](:,base) + H̄[α] S^0                     (α >= 1, and joint rows of α = 0)
//! base rows of α = 0:  J[0,γ] = H[0,γ] - H[s,γ] + S^sᵀ δP^1, same column rule with H̄[0] - H̄[s];
//!                      base columns of γ = s also  S^sᵀ ad^D_{P^1}(S^s + S^0) + N^s(P^1) - N^0(P^0)
//! δP^1: joint i, node γ: 𝒴_i S_i - ad^D_{Γ_i} S_i (and 𝒵 terms);  chart, node γ: the same with S;
//!      γ = s also the rigid shift Σ_α (𝒴 - ad^D_Γ)^α S^0, and minus the column of node 0
//! ```

use alloc::vec;
use alloc::vec::Vec;

use crate::del_residual::DelWorkspace;
use crate::kinetic_hessian::CompositeLanes;
use crate::lanes::{LANES, Lane6, Quad, Simd};
use crate::tree::KinematicTree;

mod composites;
mod entries;
mod pairs;
mod skew;

use composites::{Assemble, BasePairs, Composites};
pub(crate) use entries::{JointAndBase, PairBlock};
use entries::{lane, skew};

/// What a column coordinate (a joint or one base coordinate) brings to its pairs.
#[derive(Clone, Copy, Debug, Default)]
struct ColumnLanes {
    twist: [Quad; 6],
    rate: [Quad; 6],
}

/// What a joint brings to the pairs with the coordinates on its branch.
#[derive(Clone, Copy, Debug, Default)]
struct RowLanes {
    a: [Quad; 6],
    b: [Quad; 6],
    /// Force of fixed direction: `∂τ_i/∂q_j = s_jᵀ c`.
    c: [Quad; 3],
}

/// Sums over a subtree of the loads with fixed direction: `F_η η = [A η_ω; f×η_ω]` (gravity not included).
#[derive(Clone, Copy, Debug, Default)]
struct DeadLanes {
    arm_cross: [Quad; 9],
    force: [Quad; 3],
}

/// Sums over a subtree of the wrenches of [`crate::del_residual::GainLanes`].
#[derive(Clone, Copy, Debug)]
struct GeneralLanes {
    wrench: [Quad; 6],
    eta: [Quad; 36],
    nu: [Quad; 36],
}

impl GeneralLanes {
    const ZERO: Self = Self { wrench: [Quad::ZERO; 6], eta: [Quad::ZERO; 36], nu: [Quad::ZERO; 36] };
}

/// The general part of a joint's row and column.
#[derive(Clone, Copy)]
struct GeneralTerms<S: Simd> {
    /// `𝒴ᵀ S_i`, `𝒵ᵀ S_i`.
    row_pose: Lane6<S>,
    row_rate: Lane6<S>,
    /// `𝒵 Ṡ_i + 𝒴 S_i - ad^D_G S_i`, `𝒵 S_i`.
    column_pose: Lane6<S>,
    column_rate: Lane6<S>,
}

/// Workspace and result: the Hessian blocks of one evaluation.
#[derive(Clone, Debug)]
pub struct DelHessian {
    pub(crate) groups: usize,
    pub(crate) s: usize,
    time_step: f64,
    /// `(1/Δt) w_β b^{βα} b^{βγ}`, lanes over γ: `[(β (s+1) + α) groups + g]`.
    mass_table: Vec<Quad>,
    /// `w_α b^{αγ}`, lanes over γ: `[α groups + g]`.
    row_table: Vec<Quad>,
    /// `w_γ b^{γα}`, lanes over γ: `[α groups + g]`.
    column_table: Vec<Quad>,
    /// 1 in lane α: `[α groups + g]`.
    unit_table: Vec<Quad>,
    composites: Vec<CompositeLanes>,
    dead: Vec<DeadLanes>,
    general: Vec<GeneralLanes>,
    columns: Vec<ColumnLanes>,
    /// First pair of every body: pairs of body i are its branch, root first, itself last.
    pub(crate) pair_starts: Vec<usize>,
    /// `H_ij`, `[(pair (s+1) + α) groups + g]`, lanes over γ.
    blocks: Vec<Quad>,
    /// `H_ji`, likewise; empty when `H_ji[α,γ] = H_ij[γ,α]`.
    mirror: Vec<Quad>,
    /// `w_α Δt s_i·(τ×s_j)` of the torques held in {0} on the subtree of i (lanes over α): what `H_ji[α,α]` has less than `H_ij[α,α]`;
    /// `[pair groups + g]`, empty without such torques.
    skew: Vec<Quad>,
    /// Base-base blocks, pairs `k * 6 + l`.
    base_blocks: Vec<Quad>,
    /// `S_iᵀ 𝒴_i w_α Δt` of every body with a joint, then six rows of the base: `[row groups + g]`.
    shift_rows: Vec<[Quad; 6]>,
    /// Change of the total impulse by coordinate `dof` at node γ (lanes): `[dof groups + g]`.
    impulse_columns: Vec<[Quad; 6]>,
    /// Columns of `(𝒴 - ad^D_Γ) w_α Δt` of the base, the change of the total impulse by a rigid shift at node α (lanes): `[k groups + g]`.
    rigid_columns: Vec<[Quad; 6]>,
    /// `S^0ᵀ` of the shift rows, lanes over α, and `S^sᵀ` of the impulse columns, lanes over γ: `[dof groups + g]`.
    shifts_on_base: Vec<[Quad; 6]>,
    impulses_on_base: Vec<[Quad; 6]>,
}

impl DelHessian {
    /// A workspace for the steps of `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let (groups, s) = (del.groups, del.unknown_nodes());
        let lanes = tree.body_count() * groups;
        let pair_starts: Vec<usize> = core::iter::once(0)
            .chain((0..tree.body_count()).scan(0, |sum, i| {
                if !tree.is_base(i) {
                    *sum += tree.branch(i).len();
                }
                Some(*sum)
            }))
            .collect();
        let pairs = pair_starts[tree.body_count()];
        let block = (s + 1) * groups;
        let floating = tree.is_floating();
        Self {
            groups,
            s,
            time_step: 0.0,
            mass_table: vec![Quad::ZERO; (s + 1) * block],
            row_table: vec![Quad::ZERO; block],
            column_table: vec![Quad::ZERO; block],
            unit_table: vec![Quad::ZERO; block],
            composites: vec![CompositeLanes::default(); lanes],
            dead: vec![DeadLanes::default(); lanes],
            general: vec![GeneralLanes::ZERO; del.gains.len()],
            columns: vec![ColumnLanes::default(); tree.dof() * groups],
            pair_starts,
            blocks: vec![Quad::ZERO; pairs * block],
            mirror: vec![Quad::ZERO; if del.gains.is_empty() { 0 } else { pairs * block }],
            skew: vec![Quad::ZERO; if del.dead_torques().is_empty() { 0 } else { pairs * groups }],
            base_blocks: vec![Quad::ZERO; if floating { 36 * block } else { 0 }],
            shift_rows: vec![[Quad::ZERO; 6]; if floating { tree.dof() * groups } else { 0 }],
            impulse_columns: vec![[Quad::ZERO; 6]; if floating { tree.dof() * groups } else { 0 }],
            rigid_columns: vec![[Quad::ZERO; 6]; if floating { 6 * groups } else { 0 }],
            shifts_on_base: vec![[Quad::ZERO; 6]; if floating { tree.dof() * groups } else { 0 }],
            impulses_on_base: vec![[Quad::ZERO; 6]; if floating { tree.dof() * groups } else { 0 }],
        }
    }

    /// Fills all blocks at the nodes last evaluated in `del`. O(s² Σ depth), no allocation.
    pub fn evaluate(&mut self, tree: &KinematicTree, del: &DelWorkspace) {
        if self.time_step != del.time_step {
            self.fill_tables(del);
        }
        del.instructions.dispatch(Composites { tree, del, hessian: self });
        del.instructions.dispatch(Assemble { tree, del, hessian: self });
        if tree.is_floating() {
            del.instructions.dispatch(BasePairs { tree, del, hessian: self });
        }
        if !self.skew.is_empty() {
            self.evaluate_skew(tree, del);
        }
    }

    fn fill_tables(&mut self, del: &DelWorkspace) {
        self.time_step = del.time_step;
        let (rule, groups, count) = (&del.rule, self.groups, self.s + 1);
        for alpha in 0..count {
            for gamma in 0..count {
                let (at, lane) = (alpha * groups + gamma / LANES, gamma % LANES);
                self.row_table[at].0[lane] = rule.weights()[alpha] * rule.derivative(alpha, gamma);
                self.column_table[at].0[lane] = rule.weights()[gamma] * rule.derivative(gamma, alpha);
                self.unit_table[at].0[lane] = if alpha == gamma { 1.0 } else { 0.0 };
                for beta in 0..count {
                    let value =
                        rule.weights()[beta] * rule.derivative(beta, alpha) * rule.derivative(beta, gamma);
                    self.mass_table[(beta * count + alpha) * groups + gamma / LANES].0[lane] =
                        value / del.time_step;
                }
            }
        }
    }

    /// Whether `H_ji[α,γ] = H_ij[γ,α]`: true without drag, body wrenches and laws.
    pub fn is_symmetric(&self) -> bool {
        self.mirror.is_empty()
    }

    /// Blocks of all pairs of a body, root first: `s + 1` rows of the lane groups each.
    #[inline(always)]
    pub(crate) fn body_blocks(&self, body: usize) -> &[Quad] {
        let block = (self.s + 1) * self.groups;
        &self.blocks[self.pair_starts[body] * block..self.pair_starts[body + 1] * block]
    }

    /// The blocks of a body's pairs, root first, itself last. `s` may be a constant.
    #[inline(always)]
    pub(crate) fn body_pairs(&self, body: usize, s: usize) -> impl Iterator<Item = PairBlock<'_>> {
        let groups = (s + LANES) / LANES;
        let block = (s + 1) * groups;
        let quads = self.pair_starts[body] * block..self.pair_starts[body + 1] * block;
        let symmetric = self.mirror.is_empty();
        let mirror = if symmetric { &self.blocks } else { &self.mirror };
        let pairs = self.blocks[quads.clone()].chunks_exact(block).zip(mirror[quads].chunks_exact(block));
        let first = self.pair_starts[body];
        pairs.enumerate().map(move |(place, (own, mirror))| {
            let skew = self.skew_of(first + place, 1, groups);
            PairBlock { own, mirror, symmetric, groups, skew }
        })
    }

    /// `H[α,γ]` for the joint coordinate of `body` (row) and coordinate `position` of its branch (column).
    #[inline(always)]
    pub(crate) fn entry(&self, pair: usize, alpha: usize, gamma: usize) -> f64 {
        self.blocks[(pair * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }

    /// `H[α,γ]` with the branch coordinate as row and the joint of the body as column.
    #[inline(always)]
    pub(crate) fn mirrored(&self, pair: usize, alpha: usize, gamma: usize) -> f64 {
        if self.mirror.is_empty() {
            self.entry(pair, gamma, alpha) - skew(self.skew_of(pair, 1, self.groups), alpha, gamma)
        } else {
            self.mirror[(pair * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
        }
    }

    /// `H[α,γ]` of base coordinates `k` (row) and `l` (column).
    #[inline(always)]
    pub(crate) fn base_entry(&self, k: usize, l: usize, alpha: usize, gamma: usize) -> f64 {
        self.base_blocks[((6 * k + l) * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }

    /// `S_iᵀ 𝒴_i w_α Δt` for coordinate `dof` at node `alpha`.
    #[inline]
    pub(crate) fn shift_row(&self, dof: usize, alpha: usize) -> [f64; 6] {
        self.shift_rows[dof * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `∂P^1/∂q^γ` for coordinate `dof`, without the rigid shift of the chart centre.
    #[inline]
    pub(crate) fn impulse_column(&self, dof: usize, gamma: usize) -> [f64; 6] {
        self.impulse_columns[dof * self.groups + gamma / LANES].map(|q| q.0[gamma % LANES])
    }

    /// `S^0ᵀ` of [`DelHessian::shift_row`].
    #[inline(always)]
    pub(crate) fn shift_on_base(&self, dof: usize, alpha: usize) -> [f64; 6] {
        lane(&self.shifts_on_base[dof * self.groups + alpha / LANES], alpha)
    }

    /// `S^sᵀ` of [`DelHessian::impulse_column`].
    #[inline(always)]
    pub(crate) fn impulse_on_base(&self, dof: usize, gamma: usize) -> [f64; 6] {
        lane(&self.impulses_on_base[dof * self.groups + gamma / LANES], gamma)
    }

    /// What a joint of a floating tree shares with the base. `s` and `groups` may be constants.
    #[inline(always)]
    pub(crate) fn joint_and_base(
        &self,
        body: usize,
        dof: usize,
        s: usize,
        groups: usize,
    ) -> JointAndBase<'_> {
        let block = (s + 1) * groups;
        let pairs = self.pair_starts[body] * block..(self.pair_starts[body] + 6) * block;
        JointAndBase {
            blocks: &self.blocks[pairs.clone()],
            mirror: if self.mirror.is_empty() { &[] } else { &self.mirror[pairs] },
            shifts: &self.shifts_on_base[dof * groups..(dof + 1) * groups],
            impulses: &self.impulses_on_base[dof * groups..(dof + 1) * groups],
            s,
            groups,
            skew: self.skew_of(self.pair_starts[body], 6, groups),
        }
    }

    /// The asymmetric parts of `count` pairs; empty without held torques.
    #[inline(always)]
    pub(crate) fn skew_of(&self, pair: usize, count: usize, groups: usize) -> &[Quad] {
        if self.skew.is_empty() { &[] } else { &self.skew[pair * groups..(pair + count) * groups] }
    }

    /// `(𝒴 - ad^D_Γ)^α e_k` of the base, times `w_α Δt`.
    #[inline]
    pub(crate) fn rigid_column(&self, k: usize, alpha: usize) -> [f64; 6] {
        self.rigid_columns[k * self.groups + alpha / LANES].map(|q| q.0[alpha % LANES])
    }

    /// `H[α,γ]` as a dense matrix of joint coordinates (row-major, `joints²`), fixed base. For tests and small models.
    pub fn dense_block_into(&self, tree: &KinematicTree, alpha: usize, gamma: usize, out: &mut [f64]) {
        let n = tree.joint_count();
        out.fill(0.0);
        for i in tree.first_joint_body()..tree.body_count() {
            let row = tree.joint_dof(i) - tree.base_dof();
            for (position, &dof) in tree.branch(i).iter().enumerate().skip(tree.base_dof()) {
                let column = dof as usize - tree.base_dof();
                let pair = self.pair_starts[i] + position;
                out[row * n + column] = self.entry(pair, alpha, gamma);
                if column != row {
                    out[column * n + row] = self.mirrored(pair, alpha, gamma);
                }
            }
        }
    }
}
