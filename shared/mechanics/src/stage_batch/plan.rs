//! The tree with the index structure that all its stages share: pairs on a branch, columns in blocks.

use alloc::vec;
use alloc::vec::Vec;

use super::column_plan::{Block, Sides, columns_in_blocks};
use crate::tree::KinematicTree;

/// The tree and its index structure.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub tree: KinematicTree,
    pub n: usize,
    pub gravity: [f64; 3],
    /// First pair of every body; its pairs follow its branch, root first, itself last.
    pub pair_starts: Vec<usize>,
    pub blocks: Vec<Block>,
    /// One column with full support: the residual.
    pub everything: Block,
    pub sides: Sides,
    /// Where the columns of `u` and of `(q, q̇)` lie among the blocks, both padded to whole vectors of stages.
    pub places: Vec<u32>,
}

impl Plan {
    /// With blocks of `columns` columns and `count` stages in a vector.
    pub fn new(tree: &KinematicTree, columns: usize, count: usize) -> Self {
        let n = tree.dof();
        let mut pair_starts = vec![0];
        for i in 0..n {
            pair_starts.push(pair_starts[i] + tree.branch(i).len());
        }
        let (mut subtrees, mut subtree_starts) = (Vec::new(), vec![0]);
        for j in 0..n {
            subtrees.extend((j..n).filter(|&i| tree.branch(i).contains(&(j as u32))).map(|i| i as u32));
            subtree_starts.push(subtrees.len());
        }
        let mut depth_first: Vec<u32> = (0..n as u32).collect();
        // Branches in lexicographic order: every joint right before what it carries.
        depth_first.sort_by(|&a, &b| tree.branch(a as usize).cmp(tree.branch(b as usize)));
        let subtree = |j: usize| &subtrees[subtree_starts[j]..subtree_starts[j + 1]];
        let sides = Sides { pairs: pair_starts[n] };
        let pair = |i: usize| pair_starts[i];
        let block = |some| Block::new(tree, some, columns, sides, pair, subtree);
        let blocks: Vec<Block> = columns_in_blocks(&depth_first, columns).into_iter().map(block).collect();
        let first_state = n.next_multiple_of(count);
        let mut places = vec![0; first_state + (2 * n).next_multiple_of(count)];
        for (at, block) in blocks.iter().enumerate() {
            for (c, column) in block.columns.iter().enumerate() {
                let index = column.index(n);
                let place = if index < n { index } else { index - n + first_state };
                places[place] = (at * 3 * n * columns + c) as u32;
            }
        }
        let everything = Block::residual(tree, sides, pair, subtree);
        Self {
            tree: tree.clone(),
            n,
            gravity: (*tree.gravity_w()).into(),
            blocks,
            everything,
            sides,
            places,
            pair_starts,
        }
    }

    #[inline(always)]
    pub fn pair(&self, body: usize) -> usize {
        self.pair_starts[body]
    }

    /// The pair of a body with itself.
    #[inline(always)]
    pub fn own_pair(&self, body: usize) -> usize {
        self.pair_starts[body + 1] - 1
    }

    #[inline(always)]
    pub fn ancestors(&self, body: usize) -> &[u32] {
        let branch = self.tree.branch(body);
        &branch[..branch.len() - 1]
    }
}
