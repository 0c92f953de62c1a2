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

use crate::del_residual::{DelWorkspace, load_arm};
use crate::floating_base::{BaseLanes, base_project, base_project_both, second_order, second_order_rate};
use crate::gravity_hessian::gravity_column;
use crate::kinetic_hessian::{CompositeLanes, composite_times, kinetic_columns, own_inertia};
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Quad, Simd, add, cross, dot3, dot6, dual_bracket, halves, join, load,
    load_strided, mat_tr_vec, outer, scale, splat, store, sub,
};
use crate::tree::{KinematicTree, NO_PARENT};

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
        pairs.map(move |(own, mirror)| PairBlock { own, mirror, symmetric, groups })
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
            self.entry(pair, gamma, alpha)
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
        }
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

/// One node of a 6-vector.
#[inline(always)]
fn lane(quads: &[Quad; 6], node: usize) -> [f64; 6] {
    let mut out = [0.0; 6];
    for k in 0..6 {
        out[k] = quads[k].0[node % LANES];
    }
    out
}

/// `H` of one pair of coordinates.
#[derive(Clone, Copy)]
pub(crate) struct PairBlock<'a> {
    own: &'a [Quad],
    mirror: &'a [Quad],
    symmetric: bool,
    groups: usize,
}

impl PairBlock<'_> {
    /// `H[α,γ]` with the joint of the body as row.
    #[inline(always)]
    pub fn entry(&self, alpha: usize, gamma: usize) -> f64 {
        self.own[alpha * self.groups + gamma / LANES].0[gamma % LANES]
    }

    /// `H[α,γ]` with the branch coordinate as row.
    #[inline(always)]
    pub fn mirrored(&self, alpha: usize, gamma: usize) -> f64 {
        if self.symmetric {
            return self.entry(gamma, alpha);
        }
        self.mirror[alpha * self.groups + gamma / LANES].0[gamma % LANES]
    }
}

/// The Newton matrix between a joint and the base: `H` with the column rule of the module doc.
#[derive(Clone, Copy)]
pub(crate) struct JointAndBase<'a> {
    blocks: &'a [Quad],
    mirror: &'a [Quad],
    shifts: &'a [[Quad; 6]],
    impulses: &'a [[Quad; 6]],
    s: usize,
    groups: usize,
}

impl JointAndBase<'_> {
    /// Row α of the joint, column γ of base coordinate `k`.
    #[inline(always)]
    pub fn joint_row(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        let plain = self.plain(k, alpha, gamma);
        if gamma < self.s {
            return plain;
        }
        plain + (self.shifts[alpha / LANES][k].0[alpha % LANES] - self.plain(k, alpha, 0))
    }

    /// Row α of base coordinate `k`, column γ of the joint.
    #[inline(always)]
    pub fn base_row(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        let plain = self.mirrored(k, alpha, gamma);
        if alpha > 0 {
            return plain;
        }
        plain + (self.impulses[gamma / LANES][k].0[gamma % LANES] - self.mirrored(k, self.s, gamma))
    }

    #[inline(always)]
    fn plain(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        self.blocks[(k * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }

    #[inline(always)]
    fn mirrored(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        if self.mirror.is_empty() {
            return self.plain(k, gamma, alpha);
        }
        self.mirror[(k * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }
}

struct Assemble<'a> {
    tree: &'a KinematicTree,
    del: &'a DelWorkspace,
    hessian: &'a mut DelHessian,
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
fn assemble<S: Simd, const G: usize>(simd: S, work: Assemble<'_>, s: usize, groups: usize) {
    let Assemble { tree, del, hessian } = work;
    for i in tree.first_joint_body()..tree.body_count() {
        joint_pairs::<S, G>(simd, tree, del, hessian, i, s, groups);
    }
}

struct Composites<'a> {
    tree: &'a KinematicTree,
    del: &'a DelWorkspace,
    hessian: &'a mut DelHessian,
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

struct BasePairs<'a> {
    tree: &'a KinematicTree,
    del: &'a DelWorkspace,
    hessian: &'a mut DelHessian,
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
fn project_on_base<S: Simd>(simd: S, del: &DelWorkspace, hessian: &mut DelHessian) {
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
fn impulse_by_rate<S: Simd>(
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
fn composites<S: Simd>(
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
    if !del.loads.is_empty() {
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
            if !del.loads.is_empty() {
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
fn accumulate<S: Simd, const N: usize>(simd: S, target: &mut [Quad; N], term: &[Quad; N]) {
    for (t, x) in target.iter_mut().zip(term) {
        *t = (Lane::load(simd, t) + Lane::load(simd, x)).quad();
    }
}

#[inline(always)]
fn own_dead_loads<S: Simd>(simd: S, del: &DelWorkspace, hessian: &mut DelHessian, groups: usize) {
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
}

/// `c` of a twist: `∂(Xᵀ F)/∂q_j = s_jᵀ c` for the subtree's forces of fixed direction.
#[inline(always)]
fn fixed_direction_row<S: Simd>(
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
    if !del.loads.is_empty() {
        let (s, n) = halves(twist);
        let dead = &hessian.dead[at];
        let loaded = sub(mat_tr_vec(&load(simd, &dead.arm_cross), s), cross(load(simd, &dead.force), n));
        c = add(c, loaded);
    }
    c
}

/// `𝒴 x` for the subtree's forces of fixed direction, gravity included.
#[inline(always)]
fn fixed_direction_gain<S: Simd>(
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
    if !del.loads.is_empty() {
        let dead = &hessian.dead[at];
        let s = halves(x).0;
        let upper = crate::lanes::mat_vec(&load(simd, &dead.arm_cross), s);
        gain = add(gain, join(upper, cross(load(simd, &dead.force), s)));
    }
    gain
}

#[inline(always)]
fn matrix_times<S: Simd>(simd: S, m: &[Quad; 36], x: Lane6<S>) -> Lane6<S> {
    let mut out = x;
    for r in 0..6 {
        out[r] = dot6(load_strided(simd, m, 6 * r, 1), x);
    }
    out
}

#[inline(always)]
fn matrix_tr_times<S: Simd>(simd: S, m: &[Quad; 36], x: Lane6<S>) -> Lane6<S> {
    let mut out = x;
    for c in 0..6 {
        out[c] = dot6(load_strided(simd, m, c, 6), x);
    }
    out
}

#[inline(always)]
fn general_terms<S: Simd>(
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

/// Lanes of the pair terms, per group, before the nodes are mixed.
#[derive(Clone, Copy)]
struct PairTerms<const G: usize> {
    /// `K_q̇q̇`.
    mass: [Quad; G],
    /// `w_α Δt (K_qq - V_qq + τ_q)`.
    stiffness: [Quad; G],
    /// `K_qq̇ + τ_q̇` of the row's own node.
    row: [Quad; G],
    /// `K_q̇q`.
    column: [Quad; G],
}

impl<const G: usize> PairTerms<G> {
    const ZERO: Self = Self {
        mass: [Quad::ZERO; G],
        stiffness: [Quad::ZERO; G],
        row: [Quad::ZERO; G],
        column: [Quad::ZERO; G],
    };
}

const MAX_GROUPS: usize = (crate::lobatto::MAX_UNKNOWN_NODES + LANES) / LANES;

/// Mixes the nodes: the formula of the module doc for one pair.
#[inline(always)]
fn mix<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    out: &mut [Quad],
) {
    for alpha in 0..=s {
        for g in 0..groups {
            let at = alpha * groups + g;
            let mut sum = mixed_momenta(simd, tables, terms, s, groups, alpha, g);
            sum = Lane::load(simd, &terms.column[g]).mul_add(Lane::load(simd, &tables.column[at]), sum);
            sum = Lane::load(simd, &terms.stiffness[g]).mul_add(Lane::load(simd, &tables.unit[at]), sum);
            out[at] = sum.quad();
        }
    }
}

/// [`mix`] of a pair without stiffness and `K_q̇q`.
#[inline(always)]
fn mix_momenta<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    out: &mut [Quad],
) {
    for alpha in 0..=s {
        for g in 0..groups {
            out[alpha * groups + g] = mixed_momenta(simd, tables, terms, s, groups, alpha, g).quad();
        }
    }
}

#[inline(always)]
fn mixed_momenta<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    alpha: usize,
    g: usize,
) -> Lane<S> {
    let row = Lane::splat(simd, terms.row[alpha / LANES].0[alpha % LANES]);
    let mut sum = row * Lane::load(simd, &tables.row[alpha * groups + g]);
    for beta in 0..=s {
        let mass = Lane::splat(simd, terms.mass[beta / LANES].0[beta % LANES]);
        let table = &tables.mass[(beta * (s + 1) + alpha) * groups + g];
        sum = mass.mul_add(Lane::load(simd, table), sum);
    }
    sum
}

struct Tables<'a> {
    mass: &'a [Quad],
    row: &'a [Quad],
    column: &'a [Quad],
    unit: &'a [Quad],
}

#[inline(always)]
fn joint_pairs<S: Simd, const G: usize>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    s: usize,
    groups: usize,
) {
    let constants = &tree.constants()[i];
    let own = tree.joint_dof(i);
    let mass = constants.subtree_mass;
    let mut rows = [RowLanes::default(); G];
    for g in 0..groups {
        let at = i * groups + g;
        let body = &del.bodies[at];
        let (a, b) = kinetic_columns(simd, mass, &hessian.composites[at], body);
        let twist = load(simd, &body.joint_twist);
        let c = fixed_direction_row(simd, tree, del, hessian, i, at, twist);
        rows[g] = RowLanes { a: store(a), b: store(b), c: store(c) };
    }
    let tables = Tables {
        mass: &hessian.mass_table,
        row: &hessian.row_table,
        column: &hessian.column_table,
        unit: &hessian.unit_table,
    };
    let block = (s + 1) * groups;
    let first_pair = hessian.pair_starts[i];
    // Six columns at once, unless wrenches without a potential ask for all terms.
    let mut done = 0;
    if tree.is_floating() && hessian.general.is_empty() {
        let at = first_pair * block..(first_pair + 6) * block;
        base_pairs_of_joint::<S, G>(simd, del, &rows, &tables, s, groups, &mut hessian.blocks[at]);
        done = 6;
    }
    for (position, &dof) in tree.branch(i).iter().enumerate().skip(done) {
        let j = dof as usize;
        let (mut terms, mut mirror) = (PairTerms::<G>::ZERO, PairTerms::<G>::ZERO);
        for g in 0..groups {
            let column = &hessian.columns[j * groups + g];
            let twist: Lane6<S> = load(simd, &column.twist);
            let rate: Lane6<S> = load(simd, &column.rate);
            let row = &rows[g];
            let (a, b): (Lane6<S>, Lane6<S>) = (load(simd, &row.a), load(simd, &row.b));
            let step = Lane::load(simd, &del.weights[g]);
            let mut stiffness = dot6(rate, b) + dot3(halves(twist).0, load(simd, &row.c));
            let (mut k_row, k_column) = (dot6(twist, b), dot6(rate, a));
            terms.column[g] = k_column.quad();
            terms.mass[g] = dot6(twist, a).quad();
            if j == own {
                stiffness = stiffness - Lane::splat(simd, constants.stiffness);
            }
            if let Some(general) = hessian.general.get(i * groups + g) {
                let body = &del.bodies[i * groups + g];
                let own_twist = load(simd, &body.joint_twist);
                let force = general_terms(simd, general, own_twist, load(simd, &body.joint_twist_rate));
                mirror.mass[g] = terms.mass[g];
                mirror.stiffness[g] = (step * (stiffness + dot6(twist, force.column_pose))).quad();
                mirror.row[g] = (k_column + dot6(twist, force.column_rate)).quad();
                mirror.column[g] = k_row.quad();
                stiffness = stiffness + dot6(rate, force.row_rate) + dot6(twist, force.row_pose);
                k_row = k_row + dot6(twist, force.row_rate);
            }
            if j == own {
                k_row = k_row - Lane::splat(simd, constants.damping);
            }
            terms.stiffness[g] = (step * stiffness).quad();
            terms.row[g] = k_row.quad();
        }
        let at = (first_pair + position) * block;
        mix(simd, &tables, &terms, s, groups, &mut hessian.blocks[at..at + block]);
        if !hessian.mirror.is_empty() {
            mix(simd, &tables, &mirror, s, groups, &mut hessian.mirror[at..at + block]);
        }
    }
}

/// The pairs of a joint with the six base coordinates: products with the columns of `S` and `Ṡ` are projections on the base. Columns of a
/// travel of the chart have no angular part and no rate: only `K_q̇q̇` and `K_qq̇` are left of them.
#[inline(always)]
fn base_pairs_of_joint<S: Simd, const G: usize>(
    simd: S,
    del: &DelWorkspace,
    rows: &[RowLanes; G],
    tables: &Tables<'_>,
    s: usize,
    groups: usize,
    blocks: &mut [Quad],
) {
    let mut terms = [PairTerms::<G>::ZERO; 6];
    for g in 0..groups {
        let base = &del.base[g];
        let (a, b): (Lane6<S>, Lane6<S>) = (load(simd, &rows[g].a), load(simd, &rows[g].b));
        let (mass, mass_rate) = base_project_both(simd, base, a);
        let (row, rate) = base_project_both(simd, base, b);
        let fixed = mat_tr_vec(&load(simd, &base.z), load(simd, &rows[g].c));
        let step = Lane::load(simd, &del.weights[g]);
        for k in 0..6 {
            terms[k].mass[g] = mass[k].quad();
            terms[k].row[g] = row[k].quad();
        }
        for k in 0..3 {
            terms[k].column[g] = mass_rate[k].quad();
            terms[k].stiffness[g] = (step * (rate[k] + fixed[k])).quad();
        }
    }
    let block = (s + 1) * groups;
    for (k, out) in blocks.chunks_exact_mut(block).enumerate() {
        if k < 3 {
            mix(simd, tables, &terms[k], s, groups, out);
        } else {
            mix_momenta(simd, tables, &terms[k], s, groups, out);
        }
    }
}

/// Shift row and impulse column of a joint of a floating tree.
#[inline(always)]
fn joint_base_terms<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    g: usize,
) {
    let groups = hessian.groups;
    let body = &del.bodies[i * groups + g];
    let twist = load(simd, &body.joint_twist);
    let rate = load(simd, &body.joint_twist_rate);
    let dof = tree.joint_dof(i);
    shift_and_impulse(simd, tree, del, hessian, i, g, dof, twist, rate);
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn shift_and_impulse<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    g: usize,
    dof: usize,
    twist: Lane6<S>,
    rate: Lane6<S>,
) {
    let groups = hessian.groups;
    let at = i * groups + g;
    let step = Lane::load(simd, &del.weights[g]);
    let zero = Lane::splat(simd, 0.0);
    let c = fixed_direction_row(simd, tree, del, hessian, i, at, twist);
    let mut shift = join(c, [zero; 3]);
    let mut gain = fixed_direction_gain(simd, tree, del, hessian, i, at, twist);
    if let Some(general) = hessian.general.get(at) {
        shift = add(shift, matrix_tr_times(simd, &general.eta, twist));
        gain = add(gain, matrix_times(simd, &general.eta, twist));
        gain = add(gain, matrix_times(simd, &general.nu, rate));
    }
    hessian.shift_rows[dof * groups + g] = store(scale(step, shift));
    let turned = dual_bracket(load(simd, &del.bodies[at].impulse), twist);
    hessian.impulse_columns[dof * groups + g] = store(sub(scale(step, gain), turned));
}

/// Columns of `S, Ṡ` of the base.
#[inline(always)]
fn base_columns<S: Simd>(simd: S, base: &BaseLanes, hessian: &mut DelHessian, groups: usize, g: usize) {
    let zero = Lane::splat(simd, 0.0);
    for k in 0..6 {
        let mut unit = [zero; 6];
        unit[k] = Lane::splat(simd, 1.0);
        hessian.columns[k * groups + g] = ColumnLanes {
            twist: store(crate::floating_base::base_twist(simd, base, unit)),
            rate: store(crate::floating_base::base_twist_rate(simd, base, unit)),
        };
    }
}

/// Base-base blocks, and the shift rows and impulse columns of the base.
#[inline(always)]
fn base_pairs<S: Simd, const G: usize>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    s: usize,
    groups: usize,
) {
    for g in 0..groups {
        for k in 0..6 {
            let column = hessian.columns[k * groups + g];
            let (twist, rate) = (load(simd, &column.twist), load(simd, &column.rate));
            shift_and_impulse(simd, tree, del, hessian, 0, g, k, twist, rate);
            rigid_column(simd, tree, del, hessian, g, k);
        }
    }
    let tables = Tables {
        mass: &hessian.mass_table,
        row: &hessian.row_table,
        column: &hessian.column_table,
        unit: &hessian.unit_table,
    };
    let mass = tree.constants()[0].subtree_mass;
    let block = (s + 1) * groups;
    // N(μ), Ṅ(μ), N(Γ) of every group.
    let mut curved = [[[Quad::ZERO; 18]; 3]; G];
    for g in 0..groups {
        let (base, body) = (&del.base[g], &del.bodies[g]);
        let momentum = load(simd, &body.momentum);
        curved[g] = [
            store(second_order(simd, base, momentum)),
            store(second_order_rate(simd, base, momentum)),
            store(second_order(simd, base, load(simd, &body.impulse))),
        ];
    }
    // What a column brings to all its rows: 𝓜S, 𝓜Ṡ, ad^D_μ Ṡ + 𝒴S + 𝒵Ṡ, 𝒵S.
    let mut carried = [[[Quad::ZERO; 6]; 6]; G];
    let mut carried_rates = [[[Quad::ZERO; 6]; 6]; G];
    let mut forces = [[[Quad::ZERO; 6]; 6]; G];
    let mut drags = [[[Quad::ZERO; 6]; 6]; G];
    for g in 0..groups {
        let momentum: Lane6<S> = load(simd, &del.bodies[g].momentum);
        for l in 0..6 {
            let column = &hessian.columns[l * groups + g];
            let (twist, rate): (Lane6<S>, Lane6<S>) = (load(simd, &column.twist), load(simd, &column.rate));
            carried[g][l] = store(composite_times(simd, mass, &hessian.composites[g], twist));
            carried_rates[g][l] = store(composite_times(simd, mass, &hessian.composites[g], rate));
            let mut force = add(
                dual_bracket(momentum, rate),
                fixed_direction_gain(simd, tree, del, hessian, 0, g, twist),
            );
            if let Some(general) = hessian.general.get(g) {
                force = add(force, matrix_times(simd, &general.nu, rate));
                force = add(force, matrix_times(simd, &general.eta, twist));
                drags[g][l] = store(matrix_times(simd, &general.nu, twist));
            }
            forces[g][l] = store(force);
        }
    }
    // Without general wrenches the entries behind the diagonal are mirror images.
    let symmetric = hessian.general.is_empty();
    for k in 0..6 {
        for l in 0..if symmetric { k + 1 } else { 6 } {
            let mut terms = PairTerms::<G>::ZERO;
            for g in 0..groups {
                let row = &hessian.columns[k * groups + g];
                let (row_twist, row_rate): (Lane6<S>, Lane6<S>) =
                    (load(simd, &row.twist), load(simd, &row.rate));
                let twist: Lane6<S> = load(simd, &hessian.columns[l * groups + g].twist);
                let carried_rate: Lane6<S> = load(simd, &carried_rates[g][l]);
                let step = Lane::load(simd, &del.weights[g]);
                let stiffness = dot6(row_rate, carried_rate) + dot6(row_twist, load(simd, &forces[g][l]));
                // K_ξ̇_l ξ_k for the row's own node is its mirror image.
                let mut k_row = dot6(twist, load(simd, &carried_rates[g][k]));
                let mut k_column = dot6(row_twist, carried_rate);
                if !hessian.general.is_empty() {
                    k_row = k_row + dot6(row_twist, load(simd, &drags[g][l]));
                }
                let mut scaled = step * stiffness;
                let [n, n_rate, n_impulse] = &curved[g];
                if l < 3 {
                    let at = 3 * k + l;
                    k_column = k_column + Lane::load(simd, &n[at]);
                    scaled = step.mul_add(Lane::load(simd, &n_rate[at]), scaled);
                    scaled = scaled + Lane::load(simd, &n_impulse[at]);
                }
                if k < 3 {
                    k_row = k_row + Lane::load(simd, &n[3 * l + k]);
                }
                terms.mass[g] = dot6(row_twist, load(simd, &carried[g][l])).quad();
                terms.stiffness[g] = scaled.quad();
                terms.row[g] = k_row.quad();
                terms.column[g] = k_column.quad();
            }
            let at = (6 * k + l) * block;
            mix(simd, &tables, &terms, s, groups, &mut hessian.base_blocks[at..at + block]);
            if symmetric && l < k {
                let image = (6 * l + k) * block;
                for alpha in 0..=s {
                    for gamma in 0..=s {
                        hessian.base_blocks[image + gamma * groups + alpha / LANES].0[alpha % LANES] =
                            hessian.base_blocks[at + alpha * groups + gamma / LANES].0[gamma % LANES];
                    }
                }
            }
        }
    }
}

/// Change of the total impulse by the unit twist `k` of all that the base carries.
#[inline(always)]
fn rigid_column<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    g: usize,
    k: usize,
) {
    let mut twist = [Lane::splat(simd, 0.0); 6];
    twist[k] = Lane::splat(simd, 1.0);
    let mut gain = fixed_direction_gain(simd, tree, del, hessian, 0, g, twist);
    if let Some(general) = hessian.general.get(g) {
        gain = add(gain, matrix_times(simd, &general.eta, twist));
    }
    let turned = dual_bracket(load(simd, &del.bodies[g].impulse), twist);
    let step = Lane::load(simd, &del.weights[g]);
    hessian.rigid_columns[k * hessian.groups + g] = store(sub(scale(step, gain), turned));
}
