//! Which columns are solved together, and what their zeros spare.
//!
//! A column of `q_j` or `q̇_j` has a right-hand side only on the branch and in the subtree of j, one of `u_j` only at j; going
//! from the leaves to the root nothing else fills. Columns of neighbouring joints share that support and go in one block.

use alloc::vec;
use alloc::vec::Vec;

use crate::tree::KinematicTree;

/// A column of the linearisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Column {
    Force(usize),
    Position(usize),
    Rate(usize),
}

impl Column {
    /// Place in `(u, q, q̇)`.
    pub fn index(self, n: usize) -> usize {
        match self {
            Self::Force(j) => j,
            Self::Position(j) => n + j,
            Self::Rate(j) => 2 * n + j,
        }
    }
}

/// A row of the pass from the leaves to the root; its sources are a range of [`Block::sources`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row {
    pub joint: u32,
    pub first: u32,
    pub end: u32,
}

/// A joint that has been eliminated before, and the panel that couples it to the row.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Source {
    pub joint: u32,
    pub pair: u32,
}

/// Numbers of a pair among the right-hand sides: rows 0, 1, velocity of row body, column branch; the same mirrored; `-M(q^0)` and
/// two zeros. So the side of every column in every row is three numbers on end.
pub(crate) const SIDE: usize = 9;

/// Where right-hand sides lie: those of the pairs; then three zeros; those of a force; the negative residuals, joint by joint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sides {
    pub pairs: usize,
}

impl Sides {
    /// Groups of [`SIDE`] numbers for `n` joints.
    pub fn groups(self, n: usize) -> usize {
        self.pairs + (6 + 3 * n).div_ceil(SIDE)
    }

    pub fn zero(self) -> usize {
        SIDE * self.pairs
    }

    pub fn force(self) -> usize {
        self.zero() + 3
    }

    pub fn residual(self, joint: usize) -> usize {
        self.zero() + 6 + 3 * joint
    }

    /// Of `column` in the row of `joint`.
    fn of(self, tree: &KinematicTree, pair: impl Fn(usize) -> usize, column: Column, joint: usize) -> usize {
        let place = |i: usize| tree.branch(i).len() - 1;
        let (by_body, by_branch, j) = match column {
            Column::Force(j) if j == joint => return self.force(),
            Column::Force(_) => return self.zero(),
            Column::Position(j) => (0, 3, j),
            Column::Rate(j) => (6, 6, j),
        };
        if tree.branch(joint).contains(&(j as u32)) {
            SIDE * (pair(joint) + place(j)) + by_body
        } else if tree.branch(j).contains(&(joint as u32)) {
            SIDE * (pair(j) + place(joint)) + by_branch
        } else {
            self.zero()
        }
    }
}

/// Columns that are solved together.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    pub columns: Vec<Column>,
    /// Joints where a right-hand side may be non-zero after the first pass.
    pub support: Vec<bool>,
    /// The support, leaves first.
    pub rows: Vec<Row>,
    pub sources: Vec<Source>,
    /// Per row and column the place of the right-hand side, see [`Sides`].
    pub origins: Vec<u32>,
}

impl Block {
    /// The residual as one column.
    pub fn residual<'a>(
        tree: &KinematicTree,
        sides: Sides,
        pair: impl Fn(usize) -> usize,
        subtree: impl Fn(usize) -> &'a [u32],
    ) -> Self {
        let everywhere = (0..tree.dof()).map(Column::Position).collect();
        let mut block = Self::new(tree, everywhere, 0, sides, pair, subtree);
        block.origins = block.rows.iter().map(|row| sides.residual(row.joint as usize) as u32).collect();
        block
    }

    /// For these columns, up to `size`; `pair(i)` is the first pair of body i, `subtree(j)` holds j and all beyond.
    pub fn new<'a>(
        tree: &KinematicTree,
        columns: Vec<Column>,
        size: usize,
        sides: Sides,
        pair: impl Fn(usize) -> usize,
        subtree: impl Fn(usize) -> &'a [u32],
    ) -> Self {
        let mut support = vec![false; tree.dof()];
        for column in &columns {
            let (Column::Force(j) | Column::Position(j) | Column::Rate(j)) = *column;
            tree.branch(j).iter().for_each(|&a| support[a as usize] = true);
            if !matches!(column, Column::Force(_)) {
                subtree(j).iter().for_each(|&i| support[i as usize] = true);
            }
        }
        let (mut rows, mut sources) = (Vec::new(), Vec::new());
        for joint in (0..tree.dof()).rev().filter(|&joint| support[joint]) {
            let first = sources.len() as u32;
            let place = tree.branch(joint).len() - 1;
            for &k in subtree(joint).iter().filter(|&&k| k as usize != joint && support[k as usize]) {
                sources.push(Source { joint: k, pair: (pair(k as usize) + place) as u32 });
            }
            rows.push(Row { joint: joint as u32, first, end: sources.len() as u32 });
        }
        let mut origins = Vec::new();
        for row in &rows {
            let columns = columns.iter().take(size);
            let of_columns = columns.map(|column| sides.of(tree, &pair, *column, row.joint as usize) as u32);
            origins.extend(of_columns.chain(core::iter::repeat(sides.zero() as u32)).take(size));
        }
        Self { columns, support, rows, sources, origins }
    }
}

/// All columns in blocks of `size`, joints depth-first.
pub(crate) fn columns_in_blocks(depth_first: &[u32], size: usize) -> Vec<Vec<Column>> {
    let joints = || depth_first.iter().map(|&j| j as usize);
    let forces = joints().map(Column::Force);
    let states = joints().flat_map(|j| [Column::Position(j), Column::Rate(j)]);
    let all: Vec<Column> = forces.chain(states).collect();
    all.chunks(size).map(<[Column]>::to_vec).collect()
}
