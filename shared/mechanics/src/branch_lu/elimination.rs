//! Leaf-to-root elimination of the panels.

use super::{BranchLu, panel_quads};
use crate::lanes::{Kernel, LANES, Lane, Quad, Simd};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::small_inverse::invert;

/// Factorises the loaded panels; otherwise the coordinate whose pivot block is singular, and the size of the pivot.
pub(super) struct Eliminate<'a> {
    pub lu: &'a mut BranchLu,
}

impl Kernel for Eliminate<'_> {
    type Output = Result<(), (usize, f64)>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Self::Output {
        match self.lu.s {
            1 if S::SPECIALISE => eliminate::<S, 1>(simd, self.lu, 1),
            2 if S::SPECIALISE => eliminate::<S, 2>(simd, self.lu, 2),
            3 if S::SPECIALISE => eliminate::<S, 3>(simd, self.lu, 3),
            s => eliminate::<S, MAX_UNKNOWN_NODES>(simd, self.lu, s),
        }
    }
}

#[inline(always)]
fn eliminate<S: Simd, const N: usize>(simd: S, lu: &mut BranchLu, s: usize) -> Result<(), (usize, f64)> {
    let block_size = s * s;
    for dof in (0..lu.ancestor_starts.len() - 1).rev() {
        let pairs = lu.ancestor_starts[dof]..lu.ancestor_starts[dof + 1];
        let ancestors = &lu.ancestors[pairs.clone()];
        let (earlier_rows, own_rows) = lu.rows.split_at_mut(lu.row_starts[dof]);
        let (earlier_columns, own_columns) = lu.columns.split_at_mut(lu.column_starts[dof]);
        let diagonal = ancestors.len() * s;
        let mut block = [[0.0; N]; N];
        for (alpha, row) in block.iter_mut().enumerate().take(s) {
            for (k, entry) in row.iter_mut().enumerate().take(s) {
                let at = diagonal + k;
                *entry = own_rows[at / LANES * s + alpha].0[at % LANES];
            }
        }
        let inverse = invert(block, s).map_err(|pivot| (dof, pivot))?;
        for alpha in 0..s {
            let at = dof * block_size + alpha * s;
            lu.pivots[at..at + s].copy_from_slice(&inverse[alpha][..s]);
        }
        let own_rows = &mut own_rows[..s * panel_quads(ancestors.len(), s)];
        let own_columns = &own_columns[..own_rows.len()];
        scale_rows(simd, own_rows, &inverse, s);
        if !diagonal.is_multiple_of(LANES) {
            // What stands behind the ancestors must not reach the scalar products of the solves.
            let last = own_rows.len() - s;
            for quad in &mut own_rows[last..] {
                quad.0[diagonal % LANES..].fill(0.0);
            }
        }
        let above = &mut lu.above[pairs.start * block_size..pairs.end * block_size];
        let below = &mut lu.below[pairs.start * block_size..pairs.end * block_size];
        unpack_negated(own_rows, above, s, false);
        unpack_negated(own_columns, below, s, true);
        let blocks = above.chunks_exact(block_size).zip(below.chunks_exact(block_size));
        // The parent first: its pivot is wanted next.
        for (place, (&a, (above, below))) in ancestors.iter().zip(blocks).enumerate().rev() {
            let a = a as usize;
            let size = s * panel_quads(place + 1, s);
            let rows = &mut earlier_rows[lu.row_starts[a]..lu.row_starts[a] + size];
            add_rank::<S, N>(simd, rows, own_rows, below, [s, 1], s);
            let size = s * panel_quads(place, s);
            let columns = &mut earlier_columns[lu.column_starts[a]..lu.column_starts[a] + size];
            add_rank::<S, N>(simd, columns, own_columns, above, [1, s], s);
        }
    }
    Ok(())
}

/// `J_ib := D_i J_ib` for all b.
#[inline(always)]
fn scale_rows<S: Simd, const N: usize>(simd: S, rows: &mut [Quad], inverse: &[[f64; N]; N], s: usize) {
    for quads in rows.chunks_exact_mut(s) {
        let mut x = [Lane::splat(simd, 0.0); N];
        for k in 0..s {
            x[k] = Lane::load(simd, &quads[k]);
        }
        for alpha in 0..s {
            let mut sum = Lane::splat(simd, inverse[alpha][0]) * x[0];
            for k in 1..s {
                sum = Lane::splat(simd, inverse[alpha][k]).mul_add(x[k], sum);
            }
            quads[alpha] = sum.quad();
        }
    }
}

/// Copies the blocks of a panel, negated, to a list of s x s blocks, row-major; transposed for the column panels.
#[inline(always)]
fn unpack_negated(panel: &[Quad], blocks: &mut [f64], s: usize, transposed: bool) {
    let place_of = |row: usize, k: usize| if transposed { k * s + row } else { row * s + k };
    for (quads, four) in panel.chunks(s * s).zip(blocks.chunks_mut(LANES * s * s)) {
        if quads.len() == s * s && four.len() == LANES * s * s {
            for place in 0..LANES {
                for row in 0..s {
                    for k in 0..s {
                        let at = place * s + k;
                        four[place * s * s + place_of(row, k)] = -quads[at / LANES * s + row].0[at % LANES];
                    }
                }
            }
        } else {
            for (place, block) in four.chunks_exact_mut(s * s).enumerate() {
                for row in 0..s {
                    for k in 0..s {
                        let at = place * s + k;
                        block[place_of(row, k)] = -quads[at / LANES * s + row].0[at % LANES];
                    }
                }
            }
        }
    }
}

/// `target_α += Σ_k factors[α,k] source_k` over the length of `target`; `strides` of the factors by α and by k.
#[inline(always)]
fn add_rank<S: Simd, const N: usize>(
    simd: S,
    target: &mut [Quad],
    source: &[Quad],
    factors: &[f64],
    strides: [usize; 2],
    s: usize,
) {
    let factor = |alpha: usize, k: usize| Lane::splat(simd, factors[alpha * strides[0] + k * strides[1]]);
    if s < N {
        // Not one of the unrolled sizes: factors stay in memory.
        for (target, source) in target.chunks_exact_mut(s).zip(source.chunks_exact(s)) {
            for (alpha, target) in target.iter_mut().enumerate() {
                let mut sum = Lane::load(simd, target);
                for (k, source) in source.iter().enumerate() {
                    sum = factor(alpha, k).mul_add(Lane::load(simd, source), sum);
                }
                *target = sum.quad();
            }
        }
        return;
    }
    let zero = Lane::splat(simd, 0.0);
    let mut spread = [[zero; N]; N];
    for alpha in 0..N {
        for k in 0..N {
            spread[alpha][k] = factor(alpha, k);
        }
    }
    for (target, source) in target.chunks_exact_mut(s).zip(source.chunks_exact(s)) {
        let mut x = [zero; N];
        for k in 0..N {
            x[k] = Lane::load(simd, &source[k]);
        }
        for alpha in 0..N {
            let mut sum = Lane::load(simd, &target[alpha]);
            for k in 0..N {
                sum = spread[alpha][k].mul_add(x[k], sum);
            }
            target[alpha] = sum.quad();
        }
    }
}
