//! One right-hand side: along the branches, four entries at a time.
//!
//! Forward, a coordinate collects what its subtree subtracts from its whole branch and hands it to its parent with its own part;
//! backward, the solution along the branch at hand stands in one piece, as the row panels need it.

use alloc::vec;
use alloc::vec::Vec;

use super::{BranchLu, panel_quads};
use crate::lanes::{Kernel, LANES, Lane, Quad, Simd};
use crate::lobatto::MAX_UNKNOWN_NODES;

/// Scratch of the solves.
#[derive(Clone, Debug)]
pub(super) struct Branches {
    /// What the subtree of a coordinate subtracts from its branch, itself last: `starts[dof]..starts[dof + 1]`.
    collected: Vec<Quad>,
    starts: Vec<usize>,
    /// The solution along the branch at hand, and whose it is.
    path: Vec<Quad>,
    on_path: Vec<u32>,
}

impl Branches {
    pub fn new(ancestors: &[u32], ancestor_starts: &[usize], s: usize) -> Self {
        let (mut starts, mut deepest) = (vec![0], 0);
        for (dof, range) in ancestor_starts.windows(2).enumerate() {
            let depth = range[1] - range[0];
            deepest = deepest.max(depth + 1);
            starts.push(starts[dof] + panel_quads(depth + 1, s));
        }
        debug_assert_eq!(ancestors.len(), ancestor_starts.last().copied().unwrap_or(0));
        Self {
            collected: vec![Quad::ZERO; starts.last().copied().unwrap_or(0)],
            starts,
            path: vec![Quad::ZERO; panel_quads(deepest, s)],
            on_path: vec![0; deepest],
        }
    }
}

/// `rhs := J⁻¹ rhs`.
pub(super) struct SolveOne<'a> {
    pub lu: &'a mut BranchLu,
    pub rhs: &'a mut [f64],
}

impl Kernel for SolveOne<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { lu, rhs } = self;
        match lu.s {
            1 if S::SPECIALISE => solve::<S, 1>(simd, lu, rhs, 1),
            2 if S::SPECIALISE => solve::<S, 2>(simd, lu, rhs, 2),
            3 if S::SPECIALISE => solve::<S, 3>(simd, lu, rhs, 3),
            s => solve::<S, MAX_UNKNOWN_NODES>(simd, lu, rhs, s),
        }
    }
}

#[inline(always)]
fn solve<S: Simd, const N: usize>(simd: S, lu: &mut BranchLu, rhs: &mut [f64], s: usize) {
    forward::<S, N>(simd, lu, rhs, s);
    backward::<S, N>(simd, lu, rhs, s);
}

#[inline(always)]
fn forward<S: Simd, const N: usize>(simd: S, lu: &mut BranchLu, rhs: &mut [f64], s: usize) {
    let Branches { collected, starts, .. } = &mut lu.branches;
    collected.fill(Quad::ZERO);
    for dof in (0..lu.ancestor_starts.len() - 1).rev() {
        let ancestors = &lu.ancestors[lu.ancestor_starts[dof]..lu.ancestor_starts[dof + 1]];
        let depth = ancestors.len();
        let (before, own) = collected.split_at_mut(starts[dof]);
        let x = &mut rhs[dof * s..(dof + 1) * s];
        for alpha in 0..s {
            let at = depth * s + alpha;
            x[alpha] -= own[at / LANES].0[at % LANES];
        }
        let inverse = &lu.pivots[dof * s * s..(dof + 1) * s * s];
        let mut pivoted = [0.0; N];
        for alpha in 0..s {
            for k in 0..s {
                pivoted[alpha] += inverse[alpha * s + k] * x[k];
            }
        }
        x.copy_from_slice(&pivoted[..s]);
        let Some(&parent) = ancestors.last() else { continue };
        let mut spread = [Lane::splat(simd, 0.0); N];
        for k in 0..s {
            spread[k] = Lane::splat(simd, pivoted[k]);
        }
        let columns = &lu.columns[lu.column_starts[dof]..lu.column_starts[dof + 1]];
        let target = &mut before[starts[parent as usize]..];
        for ((target, own), column) in target.iter_mut().zip(&*own).zip(columns.chunks_exact(s)) {
            let mut sum = Lane::load(simd, target) + Lane::load(simd, own);
            for k in 0..s {
                sum = Lane::load(simd, &column[k]).mul_add(spread[k], sum);
            }
            *target = sum.quad();
        }
    }
}

#[inline(always)]
fn backward<S: Simd, const N: usize>(simd: S, lu: &mut BranchLu, rhs: &mut [f64], s: usize) {
    let Branches { path, on_path, .. } = &mut lu.branches;
    path.fill(Quad::ZERO);
    let mut length = 0;
    for dof in 0..lu.ancestor_starts.len() - 1 {
        let ancestors = &lu.ancestors[lu.ancestor_starts[dof]..lu.ancestor_starts[dof + 1]];
        let depth = ancestors.len();
        if let Some(&parent) = ancestors.last() {
            // A coordinate on the path has its whole branch there.
            if length < depth || on_path[depth - 1] != parent {
                for (place, &b) in ancestors.iter().enumerate() {
                    on_path[place] = b;
                    for alpha in 0..s {
                        let at = place * s + alpha;
                        path[at / LANES].0[at % LANES] = rhs[b as usize * s + alpha];
                    }
                }
            }
            let rows = &lu.rows[lu.row_starts[dof]..lu.row_starts[dof] + s * panel_quads(depth, s)];
            let mut sums = [Lane::splat(simd, 0.0); N];
            for (row, y) in rows.chunks_exact(s).zip(&*path) {
                let y = Lane::load(simd, y);
                for alpha in 0..s {
                    sums[alpha] = Lane::load(simd, &row[alpha]).mul_add(y, sums[alpha]);
                }
            }
            for alpha in 0..s {
                let sum = sums[alpha].quad().0;
                rhs[dof * s + alpha] -= (sum[0] + sum[2]) + (sum[1] + sum[3]);
            }
        }
        on_path[depth] = dof as u32;
        length = depth + 1;
        for alpha in 0..s {
            let at = depth * s + alpha;
            path[at / LANES].0[at % LANES] = rhs[dof * s + alpha];
        }
    }
}
