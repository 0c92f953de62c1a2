//! Steps 8 and 9 of Algorithm B.1 for one right-hand side, and their adjoint.

use super::{RecursiveNewton, add_scaled, dot};
use crate::lanes::{Kernel, Quad, Simd};
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
        let Self { tree, work, rhs } = self;
        let s = work.shape.s;
        let (ni, no) = (work.input_quads, work.output_quads);
        work.outputs.fill(Quad::ZERO);
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let at = tree.joint_dof(i) * s;
            let (earlier, own) = work.outputs.split_at_mut(i * no);
            let own = &own[..no];
            for alpha in 0..s {
                let c = &work.c[(i * s + alpha) * no..][..no];
                reduced[alpha] = rhs[at + alpha] - dot(simd, c, own);
            }
            let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
            for alpha in 0..s {
                rhs[at + alpha] = (0..s).map(|k| inverse[alpha * s + k] * reduced[k]).sum();
            }
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let target = &mut earlier[parent * no..(parent + 1) * no];
                add_scaled(simd, target, 1.0, own);
                for k in 0..s {
                    add_scaled(simd, target, rhs[at + k], &work.u[(i * s + k) * no..][..no]);
                }
            }
        }
        if tree.is_floating() {
            work.solve_base(rhs);
        }
        for i in tree.first_joint_body()..tree.body_count() {
            let at = tree.joint_dof(i) * s;
            let parent = tree.constants()[i].parent;
            let (earlier, own) = work.inputs.split_at_mut(i * ni);
            let from = if parent == NO_PARENT { &work.zero[..ni] } else { &earlier[parent * ni..][..ni] };
            let own = &mut own[..ni];
            own.copy_from_slice(from);
            for alpha in 0..s {
                rhs[at + alpha] -= dot(simd, &work.w[(i * s + alpha) * ni..][..ni], from);
            }
            for k in 0..s {
                add_scaled(simd, own, rhs[at + k], &work.b[(i * s + k) * ni..][..ni]);
            }
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
        work.inputs.fill(Quad::ZERO);
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let at = tree.joint_dof(i) * s;
            let (earlier, own) = work.inputs.split_at_mut(i * ni);
            let own = &own[..ni];
            for k in 0..s {
                rhs[at + k] += dot(simd, &work.b[(i * s + k) * ni..][..ni], own);
            }
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let target = &mut earlier[parent * ni..(parent + 1) * ni];
                add_scaled(simd, target, 1.0, own);
                for k in 0..s {
                    add_scaled(simd, target, -rhs[at + k], &work.w[(i * s + k) * ni..][..ni]);
                }
            }
        }
        if tree.is_floating() {
            work.solve_base_transposed(rhs);
        }
        let mut reduced = [0.0; MAX_UNKNOWN_NODES];
        for i in tree.first_joint_body()..tree.body_count() {
            let at = tree.joint_dof(i) * s;
            let parent = tree.constants()[i].parent;
            let (earlier, own) = work.outputs.split_at_mut(i * no);
            let from = if parent == NO_PARENT { &work.zero[..no] } else { &earlier[parent * no..][..no] };
            let own = &mut own[..no];
            for k in 0..s {
                let pushed = if parent == NO_PARENT {
                    0.0
                } else {
                    dot(simd, &work.u[(i * s + k) * no..][..no], from)
                };
                reduced[k] = rhs[at + k] + pushed;
            }
            let inverse = &work.pivots[i * s * s..(i + 1) * s * s];
            for k in 0..s {
                rhs[at + k] = (0..s).map(|alpha| inverse[alpha * s + k] * reduced[alpha]).sum();
            }
            own.copy_from_slice(from);
            for k in 0..s {
                add_scaled(simd, own, -rhs[at + k], &work.c[(i * s + k) * no..][..no]);
            }
        }
    }
}
