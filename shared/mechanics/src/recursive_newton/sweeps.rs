//! Steps 8 and 9 of Algorithm B.1 for one right-hand side, and their adjoint.
//!
//! A sweep is one chain of dependent operations from body to body; what it takes is their latency. Scalars of the chain therefore stay
//! in all lanes of a register.

use super::RecursiveNewton;
use crate::lanes::{Kernel, Lane, Quad, Simd};
use crate::lobatto::MAX_UNKNOWN_NODES;
use crate::tree::{KinematicTree, NO_PARENT};

pub(super) struct Solve<'a> {
    pub tree: &'a KinematicTree,
    pub work: &'a mut RecursiveNewton,
    pub rhs: &'a mut [f64],
}

impl Kernel for Solve<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        // With constant arguments the loops over nodes and quads unroll (interface of 12 and 12, 21 and 24 numbers).
        match (self.work.shape.s, self.work.input_quads, self.work.output_quads) {
            (1, 3, 3) if S::SPECIALISE => solve::<S, 1>(simd, self, 1, 3, 3),
            (2, 6, 6) if S::SPECIALISE => solve::<S, 2>(simd, self, 2, 6, 6),
            (s, ni, no) => solve::<S, MAX_UNKNOWN_NODES>(simd, self, s, ni, no),
        }
    }
}

/// `ni`, `no`: quads of an input and an output row.
#[inline(always)]
fn solve<S: Simd, const N: usize>(simd: S, sweep: Solve<'_>, s: usize, ni: usize, no: usize) {
    let Solve { tree, work, rhs } = sweep;
    let zero = Lane::splat(simd, 0.0);
    work.outputs.fill(Quad::ZERO);
    for i in (tree.first_joint_body()..tree.body_count()).rev() {
        let rhs = &mut rhs[tree.joint_dof(i) * s..][..s];
        let (earlier, own) = work.outputs.split_at_mut(i * no);
        let own = &own[..no];
        let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
        let mut pushed = [zero; N];
        for alpha in 0..s {
            pushed[alpha] = total(simd, &work.c[(i * s + alpha) * no..][..no], own);
        }
        let mut g = [zero; N];
        for alpha in 0..s {
            let inverse = &inverse[alpha * s..(alpha + 1) * s];
            g[alpha] = Lane::splat(simd, (0..s).map(|k| inverse[k] * rhs[k]).sum());
            for k in 0..s {
                g[alpha] = Lane::splat(simd, inverse[k]).neg_mul_add(pushed[k], g[alpha]);
            }
        }
        for alpha in 0..s {
            rhs[alpha] = g[alpha].first();
        }
        let parent = tree.constants()[i].parent;
        if parent != NO_PARENT {
            let target = &mut earlier[parent * no..(parent + 1) * no];
            let u = &work.u[i * s * no..(i + 1) * s * no];
            for q in 0..no {
                let sum = Lane::load(simd, &target[q]) + Lane::load(simd, &own[q]);
                target[q] = combine(simd, sum, &g[..s], u, no, q).quad();
            }
        }
    }
    if tree.is_floating() {
        work.solve_base(rhs);
    }
    for i in tree.first_joint_body()..tree.body_count() {
        let rhs = &mut rhs[tree.joint_dof(i) * s..][..s];
        let parent = tree.constants()[i].parent;
        let (earlier, own) = work.inputs.split_at_mut(i * ni);
        let from = if parent == NO_PARENT { &work.zero[..ni] } else { &earlier[parent * ni..][..ni] };
        let mut x = [zero; N];
        for alpha in 0..s {
            x[alpha] =
                Lane::splat(simd, rhs[alpha]) - total(simd, &work.w[(i * s + alpha) * ni..][..ni], from);
            rhs[alpha] = x[alpha].first();
        }
        let b = &work.b[i * s * ni..(i + 1) * s * ni];
        for q in 0..ni {
            own[q] = combine(simd, Lane::load(simd, &from[q]), &x[..s], b, ni, q).quad();
        }
    }
}

pub(super) struct SolveTransposed<'a> {
    pub tree: &'a KinematicTree,
    pub work: &'a mut RecursiveNewton,
    pub rhs: &'a mut [f64],
}

impl Kernel for SolveTransposed<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, work, rhs } = self;
        let s = work.shape.s;
        let (ni, no) = (work.input_quads, work.output_quads);
        let zero = Lane::splat(simd, 0.0);
        work.inputs.fill(Quad::ZERO);
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let rhs = &mut rhs[tree.joint_dof(i) * s..][..s];
            let (earlier, own) = work.inputs.split_at_mut(i * ni);
            let own = &own[..ni];
            let mut g = [zero; MAX_UNKNOWN_NODES];
            for k in 0..s {
                g[k] = Lane::splat(simd, rhs[k]) + total(simd, &work.b[(i * s + k) * ni..][..ni], own);
                rhs[k] = g[k].first();
            }
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let target = &mut earlier[parent * ni..(parent + 1) * ni];
                let w = &work.w[i * s * ni..(i + 1) * s * ni];
                let pulled = g.map(|g| -g);
                for q in 0..ni {
                    let sum = Lane::load(simd, &target[q]) + Lane::load(simd, &own[q]);
                    target[q] = combine(simd, sum, &pulled[..s], w, ni, q).quad();
                }
            }
        }
        if tree.is_floating() {
            work.solve_base_transposed(rhs);
        }
        for i in tree.first_joint_body()..tree.body_count() {
            let rhs = &mut rhs[tree.joint_dof(i) * s..][..s];
            let parent = tree.constants()[i].parent;
            let (earlier, own) = work.outputs.split_at_mut(i * no);
            let from = if parent == NO_PARENT { &work.zero[..no] } else { &earlier[parent * no..][..no] };
            let mut reduced = [0.0; MAX_UNKNOWN_NODES];
            for k in 0..s {
                reduced[k] = rhs[k];
                if parent != NO_PARENT {
                    reduced[k] += total(simd, &work.u[(i * s + k) * no..][..no], from).first();
                }
            }
            let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
            let mut pushed = [zero; MAX_UNKNOWN_NODES];
            for k in 0..s {
                rhs[k] = (0..s).map(|alpha| inverse[alpha * s + k] * reduced[alpha]).sum();
                pushed[k] = Lane::splat(simd, -rhs[k]);
            }
            let c = &work.c[i * s * no..(i + 1) * s * no];
            for q in 0..no {
                own[q] = combine(simd, Lane::load(simd, &from[q]), &pushed[..s], c, no, q).quad();
            }
        }
    }
}

/// The scalar product in all lanes, from two partial sums.
#[inline(always)]
fn total<S: Simd>(simd: S, a: &[Quad], b: &[Quad]) -> Lane<S> {
    let mut sums = [Lane::splat(simd, 0.0); 2];
    for (k, (x, y)) in a.iter().zip(b).enumerate() {
        sums[k % 2] = Lane::load(simd, x).mul_add(Lane::load(simd, y), sums[k % 2]);
    }
    (sums[0] + sums[1]).total()
}

/// `sum + Σ_k factor_k row_k[q]` of rows of `quads`.
#[inline(always)]
fn combine<S: Simd>(
    simd: S,
    mut sum: Lane<S>,
    factors: &[Lane<S>],
    rows: &[Quad],
    quads: usize,
    q: usize,
) -> Lane<S> {
    for (k, factor) in factors.iter().enumerate() {
        sum = factor.mul_add(Lane::load(simd, &rows[k * quads + q]), sum);
    }
    sum
}
