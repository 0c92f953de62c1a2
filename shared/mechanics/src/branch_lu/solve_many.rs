//! Many right-hand sides: every row block gathers from its descendants (leaves to root), then from its ancestors, sixteen columns at
//! a time.

use alloc::vec;
use alloc::vec::Vec;

use super::BranchLu;
use crate::lanes::{Kernel, Quad, Simd, WIDE, WideLane};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::row_matrix::RowMatrix;

/// Who gathers from whom.
#[derive(Clone, Debug)]
pub(super) struct Relatives {
    /// Descendants of every coordinate, and the number of the pair (descendant, ancestor) in the list of ancestors.
    descendants: Vec<[u32; 2]>,
    starts: Vec<usize>,
    /// Coordinates with non-zero rows in the columns at hand.
    occupied: Vec<bool>,
}

impl Relatives {
    pub fn new(ancestors: &[u32], ancestor_starts: &[usize]) -> Self {
        let n = ancestor_starts.len() - 1;
        let mut starts = vec![0; n + 1];
        for &a in ancestors {
            starts[a as usize + 1] += 1;
        }
        for a in 0..n {
            starts[a + 1] += starts[a];
        }
        let mut next = starts.clone();
        let mut descendants = vec![[0; 2]; ancestors.len()];
        for (dof, range) in ancestor_starts.windows(2).enumerate() {
            for pair in range[0]..range[1] {
                let a = ancestors[pair] as usize;
                descendants[next[a]] = [dof as u32, pair as u32];
                next[a] += 1;
            }
        }
        Self { descendants, starts, occupied: vec![false; n] }
    }
}

pub(super) struct ForwardMany<'a> {
    pub lu: &'a mut BranchLu,
    pub rhs: &'a mut RowMatrix,
}

impl Kernel for ForwardMany<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { lu, rhs } = self;
        match lu.s {
            1 if S::SPECIALISE => forward::<S, 1>(simd, lu, rhs, 1),
            2 if S::SPECIALISE => forward::<S, 2>(simd, lu, rhs, 2),
            3 if S::SPECIALISE => forward::<S, 3>(simd, lu, rhs, 3),
            s => forward::<S, MAX_UNKNOWN_NODES>(simd, lu, rhs, s),
        }
    }
}

/// Leaves to root. Columns of the linearisation are zero outside a subtree: those rows are skipped.
#[inline(always)]
fn forward<S: Simd, const N: usize>(simd: S, lu: &mut BranchLu, rhs: &mut RowMatrix, s: usize) {
    let stride = rhs.stride() / WIDE;
    let data = rhs.pieces_mut();
    let Relatives { descendants, starts, occupied } = &mut lu.relatives;
    for at in 0..stride {
        for dof in (0..occupied.len()).rev() {
            let mut sums = start_sums::<S, N, 1>(simd, data, dof * s * stride + at, stride, s);
            let mut empty = true;
            for &[i, pair] in &descendants[starts[dof]..starts[dof + 1]] {
                if occupied[i as usize] {
                    empty = false;
                    let block = &lu.below[pair as usize * s * s..(pair as usize + 1) * s * s];
                    add_block(simd, &mut sums, block, data, i as usize * s * stride + at, stride, s);
                }
            }
            let x = total(simd, &sums, s);
            if empty {
                for [row] in x.iter().take(s) {
                    empty &= row.is_zero();
                }
            }
            occupied[dof] = !empty;
            if empty {
                continue;
            }
            let inverse = &lu.pivots[dof * s * s..(dof + 1) * s * s];
            for alpha in 0..s {
                let mut y = WideLane::splat(simd, 0.0);
                for k in 0..s {
                    y = WideLane::splat(simd, inverse[alpha * s + k]).mul_add(x[k][0], y);
                }
                data[(dof * s + alpha) * stride + at] = y.quads();
            }
        }
    }
}

/// `W` pieces of the rows at `first` as accumulators, one per row and column of a block: the products of a block do not wait for each
/// other.
#[inline(always)]
fn start_sums<S: Simd, const N: usize, const W: usize>(
    simd: S,
    data: &[[Quad; WIDE]],
    first: usize,
    stride: usize,
    s: usize,
) -> [[[WideLane<S>; W]; N]; N] {
    let mut sums = [[[WideLane::splat(simd, 0.0); W]; N]; N];
    for alpha in 0..s {
        let row = &data[first + alpha * stride..][..W];
        for w in 0..W {
            sums[0][alpha][w] = WideLane::of(simd, &row[w]);
        }
    }
    sums
}

/// `sums += block y` for the rows `y` at `from`.
#[inline(always)]
fn add_block<S: Simd, const N: usize, const W: usize>(
    simd: S,
    sums: &mut [[[WideLane<S>; W]; N]; N],
    block: &[f64],
    data: &[[Quad; WIDE]],
    from: usize,
    stride: usize,
    s: usize,
) {
    for k in 0..s {
        let row = &data[from + k * stride..][..W];
        let mut y = [WideLane::splat(simd, 0.0); W];
        for w in 0..W {
            y[w] = WideLane::of(simd, &row[w]);
        }
        for alpha in 0..s {
            let factor = WideLane::splat(simd, block[alpha * s + k]);
            for w in 0..W {
                sums[k][alpha][w] = factor.mul_add(y[w], sums[k][alpha][w]);
            }
        }
    }
}

#[inline(always)]
fn total<S: Simd, const N: usize, const W: usize>(
    simd: S,
    sums: &[[[WideLane<S>; W]; N]; N],
    s: usize,
) -> [[WideLane<S>; W]; N] {
    let one = WideLane::splat(simd, 1.0);
    let mut out = sums[0];
    for k in 1..s {
        for alpha in 0..s {
            for w in 0..W {
                out[alpha][w] = one.mul_add(sums[k][alpha][w], out[alpha][w]);
            }
        }
    }
    out
}

pub(super) struct BackwardMany<'a> {
    pub lu: &'a BranchLu,
    pub rhs: &'a mut RowMatrix,
}

impl Kernel for BackwardMany<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { lu, rhs } = self;
        match lu.s {
            1 if S::SPECIALISE => backward::<S, 1>(simd, lu, rhs, 1),
            2 if S::SPECIALISE => backward::<S, 2>(simd, lu, rhs, 2),
            3 if S::SPECIALISE => backward::<S, 3>(simd, lu, rhs, 3),
            s => backward::<S, MAX_UNKNOWN_NODES>(simd, lu, rhs, s),
        }
    }
}

/// Root to leaves.
#[inline(always)]
fn backward<S: Simd, const N: usize>(simd: S, lu: &BranchLu, rhs: &mut RowMatrix, s: usize) {
    let stride = rhs.stride() / WIDE;
    let data = rhs.pieces_mut();
    let mut at = 0;
    while S::WIDES == 2 && at + 2 <= stride {
        backward_at::<S, N, 2>(simd, lu, data, at, stride, s);
        at += 2;
    }
    for at in at..stride {
        backward_at::<S, N, 1>(simd, lu, data, at, stride, s);
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
fn backward_at<S: Simd, const N: usize, const W: usize>(
    simd: S,
    lu: &BranchLu,
    data: &mut [[Quad; WIDE]],
    at: usize,
    stride: usize,
    s: usize,
) {
    for dof in 0..lu.ancestor_starts.len() - 1 {
        let pairs = lu.ancestor_starts[dof]..lu.ancestor_starts[dof + 1];
        let blocks = &lu.above[pairs.start * s * s..pairs.end * s * s];
        let mut sums = start_sums::<S, N, W>(simd, data, dof * s * stride + at, stride, s);
        for (&b, block) in lu.ancestors[pairs].iter().zip(blocks.chunks_exact(s * s)) {
            add_block(simd, &mut sums, block, data, b as usize * s * stride + at, stride, s);
        }
        for (alpha, row) in total(simd, &sums, s).into_iter().enumerate().take(s) {
            for (piece, y) in data[(dof * s + alpha) * stride + at..].iter_mut().zip(row) {
                *piece = y.quads();
            }
        }
    }
}
