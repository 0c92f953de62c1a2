//! Row s of the Hessian, in the order in which the last rows of `A` and `B` read it.

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::kinetic_hessian::KineticHessian;
use crate::tree::KinematicTree;

/// Row s of the Hessian, `H[s,γ]` for γ = 1..s, row by row: every coordinate with all that share a branch with it.
#[derive(Clone, Debug)]
pub(super) struct EndBlocks {
    pub related: Vec<u32>,
    pub starts: Vec<usize>,
    /// Where pair `(i, j)`, j on the branch of i, stands in row i and in row j.
    pub places: Vec<[u32; 2]>,
    /// `s` entries for every one of `related`.
    pub entries: Vec<f64>,
}

impl EndBlocks {
    /// Fixed base; empty for a floating one.
    pub fn new(tree: &KinematicTree, s: usize) -> Self {
        let n = if tree.is_floating() { 0 } else { tree.dof() };
        let mut starts = vec![0; n + 1];
        for i in 0..n {
            for &j in tree.branch(i) {
                starts[i + 1] += 1;
                if j as usize != i {
                    starts[j as usize + 1] += 1;
                }
            }
        }
        for i in 0..n {
            starts[i + 1] += starts[i];
        }
        let mut next = starts.clone();
        let mut related = vec![0; starts[n]];
        let mut take = |row: usize, column: usize| {
            let place = next[row];
            related[place] = column as u32;
            next[row] += 1;
            place as u32
        };
        let mut places = Vec::new();
        for i in 0..n {
            for &j in tree.branch(i) {
                let j = j as usize;
                let own = take(i, j);
                places.push([own, if i == j { own } else { take(j, i) }]);
            }
        }
        Self { entries: vec![0.0; related.len() * s], related, starts, places }
    }

    /// Copies the entries; in velocity coordinates less `K_q̇q` of the end at γ = s.
    pub fn fill(
        &mut self,
        tree: &KinematicTree,
        hessian: &DelHessian,
        kinetic: Option<&KineticHessian>,
        s: usize,
    ) {
        // With constant arguments the loops over nodes unroll.
        match s {
            1 => self.fill_entries(tree, hessian, 1),
            2 => self.fill_entries(tree, hessian, 2),
            3 => self.fill_entries(tree, hessian, 3),
            s => self.fill_entries(tree, hessian, s),
        }
        let Some(kinetic) = kinetic else { return };
        for i in 0..self.starts.len() - 1 {
            let first = hessian.pair_starts[i];
            for position in 0..tree.branch(i).len() {
                let [own, other] = self.places[first + position].map(|place| place as usize * s);
                let terms = kinetic.pair(i, position);
                if own != other {
                    self.entries[other + s - 1] -= terms[2].0[1];
                }
                self.entries[own + s - 1] -= terms[1].0[1];
            }
        }
    }

    #[inline(always)]
    fn fill_entries(&mut self, tree: &KinematicTree, hessian: &DelHessian, s: usize) {
        for i in 0..self.starts.len() - 1 {
            let pairs = hessian.pair_starts[i]..hessian.pair_starts[i + 1];
            for (block, &places) in hessian.body_pairs(i, s).zip(&self.places[pairs]) {
                let [own, other] = places.map(|place| place as usize * s);
                let entries = &mut self.entries[other..other + s];
                for gamma in 1..=s {
                    entries[gamma - 1] = block.mirrored(s, gamma);
                }
                let entries = &mut self.entries[own..own + s];
                for gamma in 1..=s {
                    entries[gamma - 1] = block.entry(s, gamma);
                }
            }
        }
        debug_assert_eq!(tree.dof() + 1, self.starts.len());
    }
}
