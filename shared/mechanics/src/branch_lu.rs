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
//! Storage: for every coordinate a *row panel* (its block row along its branch, root first, itself last) and a *column panel* (its
//! block column, transposed, itself left out). The branch of an ancestor is a prefix of the branch of its descendant, so every update
//! is a contiguous rank-s update: quad `q` of row α of a panel stands at `q s + α`, and a prefix of the branch is a prefix of the
//! panel. The six coordinates of a floating base are the root of every branch and are eliminated like joints.
//!
//! The pivots `D_i` are those of Algorithm B.1 ([`crate::recursive_newton`]): both perform the same elimination.
//! Source: sparsity along branches, R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 6.5 (there LᵀL of the
//! mass matrix); block form for `s > 1`: ours.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::FactorError;
use crate::lanes::{Instructions, LANES, Quad};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::newton_direction::{NewtonDirection, base_block};
use crate::row_matrix::RowMatrix;
use crate::tree::KinematicTree;

mod elimination;
mod panels;
mod solve_many;
mod solve_one;

use elimination::Eliminate;
use panels::{JointPanels, fill_joint_panels};
use solve_many::{BackwardMany, ForwardMany, Relatives};
use solve_one::{Branches, SolveOne};

/// Factorisation workspace. Build it once per tree and rule.
#[derive(Clone, Debug)]
pub struct BranchLu {
    instructions: Instructions,
    s: usize,
    hessian: DelHessian,
    /// Coordinates on the branch of every coordinate, root first, itself left out: `ancestor_starts[i]..ancestor_starts[i + 1]`.
    ancestors: Vec<u32>,
    ancestor_starts: Vec<usize>,
    /// First quad of every coordinate's row panel, and of its column panel.
    row_starts: Vec<usize>,
    column_starts: Vec<usize>,
    /// Row panels, `s` rows each.
    rows: Vec<Quad>,
    /// Transposed column panels, `s` rows each.
    columns: Vec<Quad>,
    /// `D_i`, row-major.
    pivots: Vec<f64>,
    /// `-D_i J_ib` of the pairs (i, b in anc i), in the order of `ancestors`, s x s row-major.
    above: Vec<f64>,
    /// `-J_bi` of the same pairs.
    below: Vec<f64>,
    branches: Branches,
    relatives: Relatives,
}

/// Quads that hold `blocks` blocks of `s` columns.
#[inline(always)]
fn panel_quads(blocks: usize, s: usize) -> usize {
    (blocks * s).div_ceil(LANES)
}

impl BranchLu {
    /// For the steps of `del`.
    pub fn new(tree: &KinematicTree, del: &DelWorkspace) -> Self {
        let (s, n) = (del.unknown_nodes(), tree.dof());
        let (mut ancestors, mut ancestor_starts) = (Vec::new(), vec![0]);
        let (mut row_starts, mut column_starts) = (vec![0], vec![0]);
        for dof in 0..n {
            if dof < tree.base_dof() {
                ancestors.extend(0..dof as u32);
            } else {
                let branch = tree.branch(dof - tree.base_dof() + tree.first_joint_body());
                ancestors.extend_from_slice(&branch[..branch.len() - 1]);
            }
            let depth = ancestors.len() - ancestor_starts[dof];
            ancestor_starts.push(ancestors.len());
            row_starts.push(row_starts[dof] + s * panel_quads(depth + 1, s));
            column_starts.push(column_starts[dof] + s * panel_quads(depth, s));
        }
        let pairs = ancestors.len();
        Self {
            instructions: del.instructions,
            s,
            hessian: DelHessian::new(tree, del),
            rows: vec![Quad::ZERO; row_starts[n]],
            columns: vec![Quad::ZERO; column_starts[n]],
            pivots: vec![0.0; n * s * s],
            above: vec![0.0; pairs * s * s],
            below: vec![0.0; pairs * s * s],
            branches: Branches::new(&ancestors, &ancestor_starts, s),
            relatives: Relatives::new(&ancestors, &ancestor_starts),
            ancestors,
            ancestor_starts,
            row_starts,
            column_starts,
        }
    }

    /// The inverse pivot block `D_i` of a coordinate (s x s, row-major).
    pub fn inverse_pivot(&self, dof: usize) -> &[f64] {
        &self.pivots[dof * self.s * self.s..(dof + 1) * self.s * self.s]
    }

    /// Coordinates on the branch of `dof`, root first, itself left out.
    #[inline(always)]
    fn ancestors(&self, dof: usize) -> &[u32] {
        &self.ancestors[self.ancestor_starts[dof]..self.ancestor_starts[dof + 1]]
    }

    /// Copies the Hessian blocks into the panels.
    fn load(&mut self, tree: &KinematicTree, del: &DelWorkspace) {
        for i in tree.first_joint_body()..tree.body_count() {
            let dof = tree.joint_dof(i);
            let rows = &mut self.rows[self.row_starts[dof]..self.row_starts[dof + 1]];
            let columns = &mut self.columns[self.column_starts[dof]..self.column_starts[dof + 1]];
            fill_joint_panels(JointPanels { hessian: &self.hessian, body: i, rows, columns }, self.s);
        }
        if tree.is_floating() {
            match self.s {
                1 => self.load_base(tree, del, 1),
                2 => self.load_base(tree, del, 2),
                3 => self.load_base(tree, del, 3),
                s => self.load_base(tree, del, s),
            }
        }
    }

    /// The rows and columns of the base, whose coordinates are the first six places of every branch.
    #[inline(always)]
    fn load_base(&mut self, tree: &KinematicTree, del: &DelWorkspace, s: usize) {
        let (base, groups) = (tree.base_dof(), (s + LANES) / LANES);
        for i in tree.first_joint_body()..tree.body_count() {
            let dof = tree.joint_dof(i);
            let joint = self.hessian.joint_and_base(i, dof, s, groups);
            let rows = &mut self.rows[self.row_starts[dof]..self.row_starts[dof + 1]];
            let columns = &mut self.columns[self.column_starts[dof]..self.column_starts[dof + 1]];
            for k in 0..6 {
                for node in 0..s {
                    for other in 0..s {
                        let at = k * s + other;
                        rows[at / LANES * s + node].0[at % LANES] = joint.joint_row(k, node, other + 1);
                        columns[at / LANES * s + node].0[at % LANES] = joint.base_row(k, other, node + 1);
                    }
                }
            }
        }
        self.rows[..self.row_starts[base]].fill(Quad::ZERO);
        self.columns[..self.column_starts[base]].fill(Quad::ZERO);
        let (rows, columns) = (&mut self.rows, &mut self.columns);
        let (row_starts, column_starts) = (&self.row_starts, &self.column_starts);
        base_block(del, &self.hessian, s, |[row, alpha], [column, gamma], value| {
            if column > row {
                let at = row * s + alpha;
                columns[column_starts[column] + at / LANES * s + gamma].0[at % LANES] = value;
            } else {
                let at = column * s + gamma;
                rows[row_starts[row] + at / LANES * s + alpha].0[at % LANES] = value;
            }
        });
    }
}

impl NewtonDirection for BranchLu {
    fn factor(&mut self, tree: &KinematicTree, del: &DelWorkspace) -> Result<(), FactorError> {
        self.hessian.evaluate(tree, del);
        self.load(tree, del);
        let instructions = self.instructions;
        instructions.dispatch(Eliminate { lu: self }).map_err(|(dof, pivot)| {
            let base = tree.base_dof();
            let body = if dof < base { 0 } else { dof - base + tree.first_joint_body() };
            FactorError::SingularPivot { body, pivot }
        })
    }

    fn solve(&mut self, _tree: &KinematicTree, rhs: &mut [f64]) {
        let instructions = self.instructions;
        instructions.dispatch(SolveOne { lu: self, rhs });
    }

    fn solve_transposed(&mut self, tree: &KinematicTree, rhs: &mut [f64]) {
        let (s, n) = (self.s, tree.dof());
        let block = s * s;
        for dof in (0..n).rev() {
            let (before, own) = rhs.split_at_mut(dof * s);
            let above = &self.above[self.ancestor_starts[dof] * block..self.ancestor_starts[dof + 1] * block];
            for (&b, above) in self.ancestors(dof).iter().zip(above.chunks_exact(block)) {
                for k in 0..s {
                    let sum: f64 = (0..s).map(|alpha| above[alpha * s + k] * own[alpha]).sum();
                    before[b as usize * s + k] += sum;
                }
            }
        }
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for dof in 0..n {
            reduced[..s].copy_from_slice(&rhs[dof * s..(dof + 1) * s]);
            let below = &self.below[self.ancestor_starts[dof] * block..self.ancestor_starts[dof + 1] * block];
            for (&a, below) in self.ancestors(dof).iter().zip(below.chunks_exact(block)) {
                for alpha in 0..s {
                    let y = rhs[a as usize * s + alpha];
                    for k in 0..s {
                        reduced[k] += below[alpha * s + k] * y;
                    }
                }
            }
            let inverse = self.inverse_pivot(dof);
            for k in 0..s {
                rhs[dof * s + k] = (0..s).map(|alpha| inverse[alpha * s + k] * reduced[alpha]).sum();
            }
        }
    }

    fn solve_many(&mut self, _tree: &KinematicTree, rhs: &mut RowMatrix) {
        let instructions = self.instructions;
        instructions.dispatch_wide(ForwardMany { lu: self, rhs });
        instructions.dispatch_wide(BackwardMany { lu: self, rhs });
    }

    fn hessian(&self) -> Option<&DelHessian> {
        Some(&self.hessian)
    }
}
