//! Right-hand sides of the linearisation and the rows of the end momenta, in lanes.
//!
//! Letters and equations: [`super`].

use super::InputHold;
use super::end_blocks::EndBlocks;
use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::kinetic_hessian::KineticHessian;
use crate::lanes::{Kernel, Quad, Simd, WIDE, WideLane};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::row_matrix::RowMatrix;
use crate::tree::KinematicTree;

pub(super) fn fill_right_hand_sides(
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &DelHessian,
    hold: InputHold,
    kinetic: Option<&KineticHessian>,
    z: &mut RowMatrix,
) {
    let (n, s) = (tree.dof(), del.unknown_nodes());
    z.clear();
    // With constant arguments the loops over nodes unroll.
    match s {
        1 => fill_start_columns(tree, hessian, z, 1),
        2 => fill_start_columns(tree, hessian, z, 2),
        3 => fill_start_columns(tree, hessian, z, 3),
        s => fill_start_columns(tree, hessian, z, s),
    }
    for i in 0..n {
        if let Some(kinetic) = kinetic {
            for (position, &j) in tree.branch(i).iter().enumerate() {
                let j = j as usize;
                let [mass, own_rate, other_rate, _] = kinetic.pair(i, position).map(|q| q.0[0]);
                z.add(i * s, j, -own_rate);
                z.set(i * s, n + j, -mass);
                if i != j {
                    z.add(j * s, i, -other_rate);
                    z.set(j * s, n + i, -mass);
                }
            }
        } else {
            z.set(i * s, n + i, -1.0);
        }
        for alpha in 0..s {
            let column = match hold {
                InputHold::Held => 2 * n + i,
                InputHold::PerNode => 2 * n + alpha * n + i,
            };
            z.set(i * s + alpha, column, -del.rule.weights()[alpha] * del.time_step);
        }
    }
}

/// `-H[α,0]`.
#[inline(always)]
pub(super) fn fill_start_columns(tree: &KinematicTree, hessian: &DelHessian, z: &mut RowMatrix, s: usize) {
    for i in 0..tree.dof() {
        for (block, &j) in hessian.body_pairs(i, s).zip(tree.branch(i)) {
            let j = j as usize;
            for alpha in 0..s {
                z.set(j * s + alpha, i, -block.mirrored(alpha, 0));
                z.set(i * s + alpha, j, -block.entry(alpha, 0));
            }
        }
    }
}

/// Rows of `q_{k+1}` (copied) and of `p_{k+1}`: `Σ_γ H[s,γ] Z^γ`, minus `K_q̇q Z^s` in velocity coordinates.
pub(super) struct EndRows<'a> {
    pub(super) blocks: &'a EndBlocks,
    pub(super) z: &'a RowMatrix,
    pub(super) out: &'a mut RowMatrix,
    pub(super) s: usize,
}

impl Kernel for EndRows<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        match self.s {
            1 if S::SPECIALISE => end_rows::<S, 1>(simd, &mut self, 1),
            2 if S::SPECIALISE => end_rows::<S, 2>(simd, &mut self, 2),
            s => end_rows::<S, MAX_UNKNOWN_NODES>(simd, &mut self, s),
        }
    }
}

#[inline(always)]
pub(super) fn end_rows<S: Simd, const N: usize>(simd: S, work: &mut EndRows<'_>, s: usize) {
    let stride = work.z.stride() / WIDE;
    let mut at = 0;
    while S::WIDES == 2 && at + 2 <= stride {
        end_rows_at::<S, N, 2>(simd, work, at, s);
        at += 2;
    }
    for at in at..stride {
        end_rows_at::<S, N, 1>(simd, work, at, s);
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
pub(super) fn end_rows_at<S: Simd, const N: usize, const W: usize>(
    simd: S,
    work: &mut EndRows<'_>,
    at: usize,
    s: usize,
) {
    let stride = work.z.stride() / WIDE;
    let z = work.z.pieces();
    let out = work.out.pieces_mut();
    let blocks = work.blocks;
    let n = blocks.starts.len() - 1;
    let (zero, one) = (WideLane::splat(simd, 0.0), WideLane::splat(simd, 1.0));
    for i in 0..n {
        let last = (i * s + s - 1) * stride + at;
        out[i * stride + at..][..W].copy_from_slice(&z[last..last + W]);
        let range = blocks.starts[i]..blocks.starts[i + 1];
        let entries = &blocks.entries[range.start * s..range.end * s];
        // Sums of their own for every γ and for every second coordinate hide the latency of the multiply-add.
        let (mut even, mut odd) = ([[zero; W]; N], [[zero; W]; N]);
        let (pairs, last) = blocks.related[range].as_chunks::<2>();
        let (of_pairs, of_last) = entries.split_at(2 * s * pairs.len());
        for (&[first, second], entries) in pairs.iter().zip(of_pairs.chunks_exact(2 * s)) {
            add_products(simd, z, &mut even, first as usize * s * stride + at, stride, &entries[..s]);
            add_products(simd, z, &mut odd, second as usize * s * stride + at, stride, &entries[s..]);
        }
        for &last in last {
            add_products(simd, z, &mut even, last as usize * s * stride + at, stride, of_last);
        }
        for w in 0..W {
            let mut sum = zero;
            for k in 0..s {
                sum = one.mul_add(even[k][w], one.mul_add(odd[k][w], sum));
            }
            out[(n + i) * stride + at + w] = sum.quads();
        }
    }
}

/// `sums_k += entries_k z_k` for the rows from `first` on.
#[inline(always)]
pub(super) fn add_products<S: Simd, const N: usize, const W: usize>(
    simd: S,
    z: &[[Quad; WIDE]],
    sums: &mut [[WideLane<S>; W]; N],
    first: usize,
    stride: usize,
    entries: &[f64],
) {
    for (k, &entry) in entries.iter().enumerate() {
        let row = &z[first + k * stride..][..W];
        let entry = WideLane::splat(simd, entry);
        for w in 0..W {
            sums[k][w] = entry.mul_add(WideLane::of(simd, &row[w]), sums[k][w]);
        }
    }
}

/// Rows of `p` to rows of `q̇`: the branch-sparse factor of the mass matrix on all columns at once.
pub(crate) struct SolveMass<'a> {
    pub(crate) factor: &'a MassMatrixFactor,
    pub(crate) out: &'a mut RowMatrix,
}

impl Kernel for SolveMass<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) {
        let stride = self.out.stride() / WIDE;
        let mut at = 0;
        while S::WIDES == 2 && at + 2 <= stride {
            solve_mass_at::<S, 2>(simd, &mut self, at);
            at += 2;
        }
        for at in at..stride {
            solve_mass_at::<S, 1>(simd, &mut self, at);
        }
    }
}

/// `W` pieces of the columns from `at` on.
#[inline(always)]
fn solve_mass_at<S: Simd, const W: usize>(simd: S, work: &mut SolveMass<'_>, at: usize) {
    let factor = work.factor;
    let stride = work.out.stride() / WIDE;
    let n = factor.pivots().len();
    let out = work.out.pieces_mut();
    let zero = WideLane::splat(simd, 0.0);
    for k in (0..n).rev() {
        let mut own = [zero; W];
        for w in 0..W {
            own[w] = WideLane::of(simd, &out[(n + k) * stride + at + w]);
        }
        for &j in factor.ancestors(k) {
            let l = WideLane::splat(simd, factor.lower(k, j as usize));
            let target = &mut out[(n + j as usize) * stride + at..][..W];
            for w in 0..W {
                target[w] = l.neg_mul_add(own[w], WideLane::of(simd, &target[w])).quads();
            }
        }
    }
    for k in 0..n {
        let scale = WideLane::splat(simd, 1.0 / factor.pivots()[k]);
        let mut own = [zero; W];
        for w in 0..W {
            own[w] = scale.mul_add(WideLane::of(simd, &out[(n + k) * stride + at + w]), zero);
        }
        for &j in factor.ancestors(k) {
            let l = WideLane::splat(simd, factor.lower(k, j as usize));
            let source = &out[(n + j as usize) * stride + at..][..W];
            for w in 0..W {
                own[w] = l.neg_mul_add(WideLane::of(simd, &source[w]), own[w]);
            }
        }
        for w in 0..W {
            out[(n + k) * stride + at + w] = own[w].quads();
        }
    }
}
