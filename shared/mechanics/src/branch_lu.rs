//! Branch-sparse block LU of the Newton matrix, O(s³ Σ depth²): the practical choice for robots.
//!
//! The block `J_ij` (s x s) is non-zero only when `i` and `j` lie on one branch. Eliminating leaves first creates no fill-in,
//! because all coordinates that meet a leaf's row or column lie on its own branch:
//!
//! ```text
//! factor  for i = n..1:   D_i = J_ii⁻¹;   J_ib := D_i J_ib  (b in anc i);   J_ab -= J_ai J_ib  (a, b in anc i)
//! solve   for i = n..1:   y_i = D_i y_i;  y_a -= J_ai y_i      then for i = 1..n:  y_i -= Σ_b J_ib y_b
//! Jᵀ      for i = n..1:   y_b -= J_ibᵀ y_i                     then for i = 1..n:  y_i = D_iᵀ (y_i - Σ_a J_aiᵀ y_a)
//! ```
//!
//! Storage: for every coordinate a *row panel* (its block row along its branch, root first) and a *column panel* (its block
//! column, transposed). The branch of an ancestor is a prefix of the branch of its descendant, so every update is a
//! contiguous rank-s update. A floating base is the common root: its `6 s` rows and columns are eliminated last, by dense
//! LU with pivoting.
//!
//! The pivots `D_i` are those of Algorithm B.1 ([`crate::recursive_newton`]): both perform the same elimination.
//! Source: sparsity along branches, R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 6.5 (there LᵀL of the
//! mass matrix); block form for `s > 1`: ours.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::dense_lu::DenseLu;
use crate::errors::FactorError;
use crate::lanes::{Instructions, Kernel, LANES, Lane, Quad, Simd, WIDE, WideLane};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::newton_direction::{BaseEntry, NewtonDirection, jacobian_column_rule};
use crate::row_matrix::RowMatrix;
use crate::small_inverse::invert;
use crate::tree::KinematicTree;

/// Factorisation workspace. Build it once per tree and rule.
#[derive(Clone, Debug)]
pub struct BranchLu {
    instructions: Instructions,
    s: usize,
    hessian: DelHessian,
    row_starts: Vec<usize>,
    row_quads: Vec<usize>,
    column_starts: Vec<usize>,
    column_quads: Vec<usize>,
    /// Row panels: `s` rows per coordinate.
    rows: Vec<Quad>,
    /// Transposed column panels: `s` rows per coordinate.
    columns: Vec<Quad>,
    /// `D_i`, row-major.
    pivots: Vec<f64>,
    base: DenseLu,
    base_rhs: Vec<f64>,
    /// The same factors in the order in which solves of many columns read them.
    many: ManyColumns,
}

/// Blocks for many right-hand sides: every row block gathers from its descendants (leaves to root), then from its ancestors.
#[derive(Clone, Debug)]
struct ManyColumns {
    /// Descendants of every coordinate.
    descendants: Vec<u32>,
    descendant_starts: Vec<usize>,
    /// First pair (coordinate, place on its branch) of every joint coordinate; the coordinate itself left out.
    pair_starts: Vec<usize>,
    /// Where a pair stands in `descendants`.
    places: Vec<u32>,
    /// `J_ai` for the descendants i of a, s x s row-major.
    from_descendants: Vec<f64>,
    /// `D_i J_ib` for the ancestors b of i, s x s row-major.
    from_ancestors: Vec<f64>,
    /// Coordinates with non-zero rows in the columns at hand.
    occupied: Vec<bool>,
}

impl ManyColumns {
    fn new(tree: &KinematicTree, s: usize) -> Self {
        let (n, base) = (tree.dof(), tree.base_dof());
        let ancestors = |dof: usize| match tree.branch(body_of(tree, dof)) {
            [ancestors @ .., _] => ancestors,
            [] => &[],
        };
        let mut descendant_starts = vec![0; n + 1];
        let mut pair_starts = vec![0; n + 1];
        for dof in 0..n {
            let own = if dof < base { &[] } else { ancestors(dof) };
            pair_starts[dof + 1] = pair_starts[dof] + own.len();
            for &a in own {
                descendant_starts[a as usize + 1] += 1;
            }
        }
        for a in 0..n {
            descendant_starts[a + 1] += descendant_starts[a];
        }
        let pairs = pair_starts[n];
        let mut next = descendant_starts.clone();
        let (mut descendants, mut places) = (vec![0; pairs], Vec::with_capacity(pairs));
        for dof in base..n {
            for &a in ancestors(dof) {
                descendants[next[a as usize]] = dof as u32;
                places.push(next[a as usize] as u32);
                next[a as usize] += 1;
            }
        }
        Self {
            descendants,
            descendant_starts,
            pair_starts,
            places,
            from_descendants: vec![0.0; pairs * s * s],
            from_ancestors: vec![0.0; pairs * s * s],
            occupied: vec![false; n],
        }
    }
}

impl BranchLu {
    /// For the steps of `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let s = del.unknown_nodes();
        let (mut row_starts, mut row_quads) = (vec![0], Vec::new());
        let (mut column_starts, mut column_quads) = (vec![0], Vec::new());
        for dof in 0..tree.dof() {
            let (row, column) = if dof < tree.base_dof() {
                (6, 0)
            } else {
                let depth = tree.branch(body_of(tree, dof)).len();
                (depth, depth - 1)
            };
            row_quads.push((row * s).div_ceil(LANES));
            column_quads.push((column * s).div_ceil(LANES));
            row_starts.push(row_starts[dof] + s * row_quads[dof]);
            column_starts.push(column_starts[dof] + s * column_quads[dof]);
        }
        Self {
            instructions: del.instructions,
            s,
            hessian: DelHessian::new(tree, del),
            rows: vec![Quad::ZERO; row_starts[tree.dof()]],
            columns: vec![Quad::ZERO; column_starts[tree.dof()]],
            row_starts,
            row_quads,
            column_starts,
            column_quads,
            pivots: vec![0.0; tree.dof() * s * s],
            base: DenseLu::new(tree.base_dof() * s),
            base_rhs: vec![0.0; tree.base_dof() * s],
            many: ManyColumns::new(tree, s),
        }
    }

    /// The inverse pivot block `D_i` of a joint coordinate (s x s, row-major).
    pub fn inverse_pivot(&self, dof: usize) -> &[f64] {
        &self.pivots[dof * self.s * self.s..(dof + 1) * self.s * self.s]
    }

    /// Copies the Hessian blocks into the panels.
    fn load(&mut self, tree: &KinematicTree, del: &DelWorkspace) {
        match self.s {
            1 => self.load_panels(tree, 1),
            2 => self.load_panels(tree, 2),
            3 => self.load_panels(tree, 3),
            s => self.load_panels(tree, s),
        }
        if tree.is_floating() {
            let s = self.s;
            let (rows, columns) = (&mut self.rows, &mut self.columns);
            let (row_starts, row_quads) = (&self.row_starts, &self.row_quads);
            let (column_starts, column_quads) = (&self.column_starts, &self.column_quads);
            jacobian_column_rule(tree, del, &self.hessian, |[row_dof, alpha], [column_dof, gamma], entry| {
                let (row, column) = (row_dof * s + alpha, column_dof * s + gamma);
                // Joint column of a base row: in the column panel; everything else: in the row panel.
                let target = if column_dof >= 6 {
                    let quad = column_starts[column_dof] + gamma * column_quads[column_dof] + row / LANES;
                    &mut columns[quad].0[row % LANES]
                } else {
                    let quad = row_starts[row_dof] + alpha * row_quads[row_dof] + column / LANES;
                    &mut rows[quad].0[column % LANES]
                };
                match entry {
                    BaseEntry::Set(value) => *target = value,
                    BaseEntry::Add(value) => *target += value,
                }
            });
        }
    }

    #[inline(always)]
    fn load_panels(&mut self, tree: &KinematicTree, s: usize) {
        for i in tree.first_joint_body()..tree.body_count() {
            let dof = tree.joint_dof(i);
            let depth = tree.branch(i).len();
            let pair = self.hessian.pair_starts[i];
            for alpha in 0..s {
                let start = self.row_starts[dof] + alpha * self.row_quads[dof];
                let row = &mut self.rows[start..start + self.row_quads[dof]];
                for position in 0..depth {
                    for gamma in 0..s {
                        let at = position * s + gamma;
                        row[at / LANES].0[at % LANES] = self.hessian.entry(pair + position, alpha, gamma + 1);
                    }
                }
            }
            for gamma in 0..s {
                let start = self.column_starts[dof] + gamma * self.column_quads[dof];
                let column = &mut self.columns[start..start + self.column_quads[dof]];
                for position in 0..depth - 1 {
                    for alpha in 0..s {
                        let at = position * s + alpha;
                        column[at / LANES].0[at % LANES] =
                            self.hessian.mirrored(pair + position, alpha, gamma + 1);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn row(&self, dof: usize, alpha: usize, at: usize) -> f64 {
        self.rows[self.row_starts[dof] + alpha * self.row_quads[dof] + at / LANES].0[at % LANES]
    }

    #[inline(always)]
    fn column(&self, dof: usize, gamma: usize, at: usize) -> f64 {
        self.columns[self.column_starts[dof] + gamma * self.column_quads[dof] + at / LANES].0[at % LANES]
    }

    fn factor_base(&mut self) -> Result<(), FactorError> {
        let (s, order) = (self.s, 6 * self.s);
        for k in 0..6 {
            for alpha in 0..s {
                for at in 0..order {
                    let value = self.row(k, alpha, at);
                    self.base.entries_mut()[(k * s + alpha) * order + at] = value;
                }
            }
        }
        self.base.factor().map_err(|(_, pivot)| FactorError::SingularPivot { body: 0, pivot })
    }
}

#[inline(always)]
fn body_of(tree: &KinematicTree, dof: usize) -> usize {
    dof - tree.base_dof() + tree.first_joint_body()
}

impl NewtonDirection for BranchLu {
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError> {
        self.hessian.evaluate(tree, del);
        self.load(tree, del);
        let instructions = self.instructions;
        instructions.dispatch(Eliminate { tree, lu: self })?;
        if tree.is_floating() { self.factor_base() } else { Ok(()) }
    }

    fn solve(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        let instructions = self.instructions;
        instructions.dispatch(SolveOne { tree, lu: self, rhs, forward: true });
        if tree.is_floating() {
            self.base.solve(&mut rhs[..6 * self.s]);
        }
        instructions.dispatch(SolveOne { tree, lu: self, rhs, forward: false });
    }

    fn solve_transposed(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        let s = self.s;
        for dof in (tree.base_dof()..tree.dof()).rev() {
            let branch = tree.branch(body_of(tree, dof));
            for (position, &b) in branch[..branch.len() - 1].iter().enumerate() {
                for k in 0..s {
                    let sum: f64 = (0..s)
                        .map(|alpha| self.row(dof, alpha, position * s + k) * rhs[dof * s + alpha])
                        .sum();
                    rhs[b as usize * s + k] -= sum;
                }
            }
        }
        if tree.is_floating() {
            self.base.solve_transposed(&mut rhs[..6 * s]);
        }
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for dof in tree.base_dof()..tree.dof() {
            let branch = tree.branch(body_of(tree, dof));
            for k in 0..s {
                let mut sum = 0.0;
                for (position, &a) in branch[..branch.len() - 1].iter().enumerate() {
                    for alpha in 0..s {
                        sum += self.column(dof, k, position * s + alpha) * rhs[a as usize * s + alpha];
                    }
                }
                reduced[k] = rhs[dof * s + k] - sum;
            }
            let inverse = self.inverse_pivot(dof);
            for k in 0..s {
                rhs[dof * s + k] = (0..s).map(|alpha| inverse[alpha * s + k] * reduced[alpha]).sum();
            }
        }
    }

    fn solve_many(&mut self, tree: &KinematicTree, rhs: &mut RowMatrix) {
        let instructions = self.instructions;
        instructions.dispatch_wide(ForwardMany { tree, lu: self, rhs });
        if tree.is_floating() {
            for c in 0..rhs.columns() {
                for (r, x) in self.base_rhs.iter_mut().enumerate() {
                    *x = rhs.get(r, c);
                }
                self.base.solve(&mut self.base_rhs);
                for (r, x) in self.base_rhs.iter().enumerate() {
                    rhs.set(r, c, *x);
                }
            }
        }
        instructions.dispatch_wide(BackwardMany { tree, lu: self, rhs });
    }

    fn hessian(&self) -> Option<&DelHessian> {
        Some(&self.hessian)
    }
}

struct Eliminate<'a> {
    tree: &'a KinematicTree,
    lu: &'a mut BranchLu,
}

impl Kernel for Eliminate<'_> {
    type Output = Result<(), FactorError>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        match self.lu.s {
            1 if S::SPECIALISE => eliminate::<S, 1>(simd, self.tree, self.lu, 1),
            2 if S::SPECIALISE => eliminate::<S, 2>(simd, self.tree, self.lu, 2),
            3 if S::SPECIALISE => eliminate::<S, 3>(simd, self.tree, self.lu, 3),
            s => eliminate::<S, MAX_UNKNOWN_NODES>(simd, self.tree, self.lu, s),
        }
    }
}

#[inline(always)]
fn eliminate<S: Simd, const N: usize>(
    simd: S,
    tree: &KinematicTree,
    lu: &mut BranchLu,
    s: usize,
) -> Result<(), FactorError> {
    let zero = Lane::splat(simd, 0.0);
    for dof in (tree.base_dof()..tree.dof()).rev() {
        let body = body_of(tree, dof);
        let branch = tree.branch(body);
        let ancestors = &branch[..branch.len() - 1];
        let own_quads = lu.row_quads[dof];
        let diagonal = ancestors.len() * s;
        let mut block = [[0.0; N]; N];
        for (alpha, row) in block.iter_mut().enumerate().take(s) {
            for (k, entry) in row.iter_mut().enumerate().take(s) {
                *entry = lu.row(dof, alpha, diagonal + k);
            }
        }
        let inverse = invert(block, s).map_err(|pivot| FactorError::SingularPivot { body, pivot })?;
        for alpha in 0..s {
            let at = dof * s * s + alpha * s;
            lu.pivots[at..at + s].copy_from_slice(&inverse[alpha][..s]);
        }
        let (earlier, own) = lu.rows.split_at_mut(lu.row_starts[dof]);
        let own = &mut own[..s * own_quads];
        let column_quads = lu.column_quads[dof];
        for q in 0..column_quads {
            let mut x = [zero; N];
            for k in 0..s {
                x[k] = Lane::load(simd, &own[k * own_quads + q]);
            }
            for alpha in 0..s {
                let mut sum = Lane::splat(simd, inverse[alpha][0]) * x[0];
                for k in 1..s {
                    sum = Lane::splat(simd, inverse[alpha][k]).mul_add(x[k], sum);
                }
                own[alpha * own_quads + q] = sum.quad();
            }
        }
        let (earlier_columns, own_columns) = lu.columns.split_at_mut(lu.column_starts[dof]);
        let own_columns = &own_columns[..s * column_quads];
        for (position, &a) in ancestors.iter().enumerate() {
            let a = a as usize;
            let quads = lu.row_quads[a];
            let rows = &mut earlier[lu.row_starts[a]..lu.row_starts[a] + s * quads];
            let mut factors = [[zero; N]; N];
            for alpha in 0..s {
                for k in 0..s {
                    let at = position * s + alpha;
                    let value = own_columns[k * column_quads + at / LANES].0[at % LANES];
                    factors[alpha][k] = Lane::splat(simd, value);
                }
            }
            subtract_rank(simd, rows, quads, own, own_quads, &factors, s);
            let quads = lu.column_quads[a];
            if quads == 0 {
                continue;
            }
            let columns = &mut earlier_columns[lu.column_starts[a]..lu.column_starts[a] + s * quads];
            for gamma in 0..s {
                for k in 0..s {
                    let at = position * s + gamma;
                    factors[gamma][k] = Lane::splat(simd, own[k * own_quads + at / LANES].0[at % LANES]);
                }
            }
            subtract_rank(simd, columns, quads, own_columns, column_quads, &factors, s);
        }
    }
    Ok(())
}

/// `target_α -= Σ_k factors[α][k] source_k` over the first `quads` quads of every row.
#[inline(always)]
fn subtract_rank<S: Simd, const N: usize>(
    simd: S,
    target: &mut [Quad],
    quads: usize,
    source: &[Quad],
    source_stride: usize,
    factors: &[[Lane<S>; N]; N],
    s: usize,
) {
    let zero = Lane::splat(simd, 0.0);
    for q in 0..quads {
        let mut x = [zero; N];
        for k in 0..s {
            x[k] = Lane::load(simd, &source[k * source_stride + q]);
        }
        for alpha in 0..s {
            let cell = &mut target[alpha * quads + q];
            let mut sum = Lane::load(simd, cell);
            for k in 0..s {
                sum = factors[alpha][k].neg_mul_add(x[k], sum);
            }
            *cell = sum.quad();
        }
    }
}

/// Copies the factors into the order of [`ManyColumns`].
#[inline(always)]
fn gather_factors(lu: &mut BranchLu, base: usize, s: usize) {
    let many = &mut lu.many;
    for dof in base..many.pair_starts.len() - 1 {
        let (quads, column_quads) = (lu.row_quads[dof], lu.column_quads[dof]);
        let rows = &lu.rows[lu.row_starts[dof]..lu.row_starts[dof] + s * quads];
        let columns = &lu.columns[lu.column_starts[dof]..lu.column_starts[dof] + s * column_quads];
        let first = many.pair_starts[dof];
        for pair in first..many.pair_starts[dof + 1] {
            let place = many.places[pair] as usize;
            let above = &mut many.from_ancestors[pair * s * s..(pair + 1) * s * s];
            let below = &mut many.from_descendants[place * s * s..(place + 1) * s * s];
            for alpha in 0..s {
                for k in 0..s {
                    let (row, column) = ((pair - first) * s + alpha, (pair - first) * s + k);
                    below[alpha * s + k] = columns[k * column_quads + row / LANES].0[row % LANES];
                    above[alpha * s + k] = rows[alpha * quads + column / LANES].0[column % LANES];
                }
            }
        }
    }
}

struct ForwardMany<'a> {
    tree: &'a KinematicTree,
    lu: &'a mut BranchLu,
    rhs: &'a mut RowMatrix,
}

impl Kernel for ForwardMany<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, lu, rhs } = self;
        let base = tree.base_dof();
        match lu.s {
            1 if S::SPECIALISE => forward_many::<S, 1>(simd, base, lu, rhs, 1),
            2 if S::SPECIALISE => forward_many::<S, 2>(simd, base, lu, rhs, 2),
            3 if S::SPECIALISE => forward_many::<S, 3>(simd, base, lu, rhs, 3),
            s => forward_many::<S, MAX_UNKNOWN_NODES>(simd, base, lu, rhs, s),
        }
    }
}

/// Leaves to root, sixteen columns at a time. Columns of the linearisation are zero outside a subtree: those rows are skipped.
#[inline(always)]
fn forward_many<S: Simd, const N: usize>(
    simd: S,
    base: usize,
    lu: &mut BranchLu,
    rhs: &mut RowMatrix,
    s: usize,
) {
    gather_factors(lu, base, s);
    let stride = rhs.stride();
    let data = rhs.quads_mut();
    let many = &mut lu.many;
    for at in (0..stride).step_by(WIDE) {
        for dof in (0..many.occupied.len()).rev() {
            let range = many.descendant_starts[dof]..many.descendant_starts[dof + 1];
            let factors = &many.from_descendants[range.start * s * s..range.end * s * s];
            let mut sums = start_sums::<S, N>(simd, data, dof * s * stride + at, stride, s);
            let mut empty = true;
            for (&i, block) in many.descendants[range].iter().zip(factors.chunks_exact(s * s)) {
                if many.occupied[i as usize] {
                    empty = false;
                    subtract_block(simd, &mut sums, block, data, i as usize * s * stride + at, stride, s);
                }
            }
            let x = total(simd, &sums, s);
            if empty {
                for row in x.iter().take(s) {
                    empty &= row.is_zero();
                }
            }
            many.occupied[dof] = !empty;
            if empty {
                continue;
            }
            let inverse = &lu.pivots[dof * s * s..(dof + 1) * s * s];
            for alpha in 0..s {
                let mut y = x[alpha];
                if dof >= base {
                    y = WideLane::splat(simd, 0.0);
                    for k in 0..s {
                        y = WideLane::splat(simd, inverse[alpha * s + k]).mul_add(x[k], y);
                    }
                }
                y.store(data, (dof * s + alpha) * stride + at);
            }
        }
    }
}

/// The rows at `first` as accumulators, one per row and column of a block: the products of a block do not wait for each other.
#[inline(always)]
fn start_sums<S: Simd, const N: usize>(
    simd: S,
    data: &[Quad],
    first: usize,
    stride: usize,
    s: usize,
) -> [[WideLane<S>; N]; N] {
    let mut sums = [[WideLane::splat(simd, 0.0); N]; N];
    for alpha in 0..s {
        sums[0][alpha] = WideLane::load(simd, data, first + alpha * stride);
    }
    sums
}

/// `sums -= block y` for the rows `y` at `from`.
#[inline(always)]
fn subtract_block<S: Simd, const N: usize>(
    simd: S,
    sums: &mut [[WideLane<S>; N]; N],
    block: &[f64],
    data: &[Quad],
    from: usize,
    stride: usize,
    s: usize,
) {
    for k in 0..s {
        let y = WideLane::load(simd, data, from + k * stride);
        for alpha in 0..s {
            sums[k][alpha] = WideLane::splat(simd, block[alpha * s + k]).neg_mul_add(y, sums[k][alpha]);
        }
    }
}

#[inline(always)]
fn total<S: Simd, const N: usize>(simd: S, sums: &[[WideLane<S>; N]; N], s: usize) -> [WideLane<S>; N] {
    let one = WideLane::splat(simd, 1.0);
    let mut out = sums[0];
    for k in 1..s {
        for alpha in 0..s {
            out[alpha] = one.mul_add(sums[k][alpha], out[alpha]);
        }
    }
    out
}

struct BackwardMany<'a> {
    tree: &'a KinematicTree,
    lu: &'a BranchLu,
    rhs: &'a mut RowMatrix,
}

impl Kernel for BackwardMany<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, lu, rhs } = self;
        match lu.s {
            1 if S::SPECIALISE => backward_many::<S, 1>(simd, tree, lu, rhs, 1),
            2 if S::SPECIALISE => backward_many::<S, 2>(simd, tree, lu, rhs, 2),
            3 if S::SPECIALISE => backward_many::<S, 3>(simd, tree, lu, rhs, 3),
            s => backward_many::<S, MAX_UNKNOWN_NODES>(simd, tree, lu, rhs, s),
        }
    }
}

/// Root to leaves, sixteen columns at a time.
#[inline(always)]
fn backward_many<S: Simd, const N: usize>(
    simd: S,
    tree: &KinematicTree,
    lu: &BranchLu,
    rhs: &mut RowMatrix,
    s: usize,
) {
    let stride = rhs.stride();
    let data = rhs.quads_mut();
    let many = &lu.many;
    for at in (0..stride).step_by(WIDE) {
        for dof in tree.base_dof()..tree.dof() {
            let range = many.pair_starts[dof]..many.pair_starts[dof + 1];
            let factors = &many.from_ancestors[range.start * s * s..range.end * s * s];
            let mut sums = start_sums::<S, N>(simd, data, dof * s * stride + at, stride, s);
            for (&b, block) in tree.branch(body_of(tree, dof)).iter().zip(factors.chunks_exact(s * s)) {
                subtract_block(simd, &mut sums, block, data, b as usize * s * stride + at, stride, s);
            }
            for (alpha, row) in total(simd, &sums, s).into_iter().enumerate().take(s) {
                row.store(data, (dof * s + alpha) * stride + at);
            }
        }
    }
}

struct SolveOne<'a> {
    tree: &'a KinematicTree,
    lu: &'a BranchLu,
    rhs: &'a mut [f64],
    forward: bool,
}

impl Kernel for SolveOne<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, _simd: S) {
        let Self { tree, lu, rhs, forward } = self;
        match (forward, lu.s) {
            (true, 1) => forward_one(tree, lu, rhs, 1),
            (true, 2) => forward_one(tree, lu, rhs, 2),
            (true, 3) => forward_one(tree, lu, rhs, 3),
            (true, s) => forward_one(tree, lu, rhs, s),
            (false, 1) => backward_one(tree, lu, rhs, 1),
            (false, 2) => backward_one(tree, lu, rhs, 2),
            (false, 3) => backward_one(tree, lu, rhs, 3),
            (false, s) => backward_one(tree, lu, rhs, s),
        }
    }
}

#[inline(always)]
fn forward_one(tree: &KinematicTree, lu: &BranchLu, rhs: &mut [f64], s: usize) {
    let mut pivoted = [0.0; MAX_UNKNOWN_NODES];
    for dof in (tree.base_dof()..tree.dof()).rev() {
        let branch = tree.branch(body_of(tree, dof));
        let inverse = &lu.pivots[dof * s * s..(dof + 1) * s * s];
        let own = &mut rhs[dof * s..(dof + 1) * s];
        for alpha in 0..s {
            let mut sum = 0.0;
            for k in 0..s {
                sum += inverse[alpha * s + k] * own[k];
            }
            pivoted[alpha] = sum;
        }
        own.copy_from_slice(&pivoted[..s]);
        let quads = lu.column_quads[dof];
        let columns = &lu.columns[lu.column_starts[dof]..lu.column_starts[dof] + s * quads];
        for (position, &a) in branch[..branch.len() - 1].iter().enumerate() {
            let target = &mut rhs[a as usize * s..(a as usize + 1) * s];
            for alpha in 0..s {
                let entry = position * s + alpha;
                let mut sum = target[alpha];
                for k in 0..s {
                    sum -= columns[k * quads + entry / LANES].0[entry % LANES] * pivoted[k];
                }
                target[alpha] = sum;
            }
        }
    }
}

#[inline(always)]
fn backward_one(tree: &KinematicTree, lu: &BranchLu, rhs: &mut [f64], s: usize) {
    for dof in tree.base_dof()..tree.dof() {
        let branch = tree.branch(body_of(tree, dof));
        let quads = lu.row_quads[dof];
        let rows = &lu.rows[lu.row_starts[dof]..lu.row_starts[dof] + s * quads];
        let mut sums = [0.0; MAX_UNKNOWN_NODES];
        for (position, &b) in branch[..branch.len() - 1].iter().enumerate() {
            let from = &rhs[b as usize * s..(b as usize + 1) * s];
            for alpha in 0..s {
                for k in 0..s {
                    let entry = position * s + k;
                    sums[alpha] += rows[alpha * quads + entry / LANES].0[entry % LANES] * from[k];
                }
            }
        }
        for alpha in 0..s {
            rhs[dof * s + alpha] -= sums[alpha];
        }
    }
}
