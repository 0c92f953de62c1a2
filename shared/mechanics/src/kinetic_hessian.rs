//! Algorithm 2: second derivatives of the kinetic energy, O(Σ depth) per node.
//!
//! | letter | field | meaning (frame {0}, per node) |
//! |---|---|---|
//! | `𝓜_i` | `first_moment`, `rotational` | composite inertia of body i and all it carries: `[J, h^; -h^, m 1]` |
//! | `μ_i` | | articulated momentum, from [`crate::del_residual`] |
//! | `A_i` | `a` | `𝓜_i S_i` |
//! | `B_i` | `b` | `𝓜_i Ṡ_i - ad^D_{μ_i} S_i` |
//!
//! ```text
//! for j in anc(i) + {i}:   K_q̇q̇[i,j] = K_q̇q̇[j,i] = S_jᵀ A_i          K_qq[i,j] = K_qq[j,i] = Ṡ_jᵀ B_i
//!                          ∂²K/∂q̇_i∂q_j = Ṡ_jᵀ A_i                    ∂²K/∂q̇_j∂q_i = S_jᵀ B_i
//! ```
//!
//! Source: the paper, Algorithm 2, with `Ad_{g_i}⁻ᵀ M_i Ad_{g_i}⁻¹` in line 4 (the print lacks the inverse of the first
//! factor).

use alloc::vec;
use alloc::vec::Vec;

use crate::del_residual::{BodyLanes, DelWorkspace, ForceCapacity};
use crate::errors::ModelError;
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Lane9, Quad, Simd, add, cross, cross_add, dot6, dual_bracket, halves,
    join, load, mat_mul, scale, splat, store, sub, sym_vec,
};
use crate::lobatto::LobattoRule;
use crate::spatial::Wrench;
use crate::tree::{BodyConstants, KinematicTree, NO_PARENT};

/// Composite inertia of a subtree about the origin of {0}; its mass is a constant of the model.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CompositeLanes {
    /// `h = Σ m p`.
    pub first_moment: [Quad; 3],
    /// `J` about the origin: xx, yy, zz, xy, xz, yz.
    pub rotational: [Quad; 6],
}

/// Inertia of one body about the origin of {0}: `J = R I Rᵀ - m p^p^`, `h = m p`.
#[inline(always)]
pub(crate) fn own_inertia<S: Simd>(
    simd: S,
    constants: &BodyConstants,
    body: &BodyLanes,
) -> (Lane3<S>, Lane6<S>) {
    let rotation: Lane9<S> = load(simd, &body.rotation);
    let position: Lane3<S> = load(simd, &body.position);
    let h = scale(Lane::splat(simd, constants.mass), position);
    let i: Lane6<S> = splat(simd, &constants.inertia);
    let full = [i[0], i[3], i[4], i[3], i[1], i[5], i[4], i[5], i[2]];
    let ri = mat_mul(&rotation, &full);
    let row = |m: &Lane9<S>, r: usize| [m[3 * r], m[3 * r + 1], m[3 * r + 2]];
    let entry = |r: usize, c: usize| crate::lanes::dot3(row(&ri, r), row(&rotation, c));
    // -m p^p^ = m (|p|² 1 - p pᵀ)
    let [x, y, z] = position;
    let [hx, hy, hz] = h;
    let (xx, yy, zz) = (hx * x, hy * y, hz * z);
    (
        h,
        [
            entry(0, 0) + yy + zz,
            entry(1, 1) + xx + zz,
            entry(2, 2) + xx + yy,
            hx.neg_mul_add(y, entry(0, 1)),
            hx.neg_mul_add(z, entry(0, 2)),
            hy.neg_mul_add(z, entry(1, 2)),
        ],
    )
}

/// `𝓜 x = [J s + h×n; m n - h×s]`.
#[inline(always)]
pub(crate) fn composite_times<S: Simd>(
    simd: S,
    mass: f64,
    composite: &CompositeLanes,
    x: Lane6<S>,
) -> Lane6<S> {
    let (s, n) = halves(x);
    let h = load(simd, &composite.first_moment);
    let upper = cross_add(h, n, sym_vec(&load(simd, &composite.rotational), s));
    join(upper, sub(scale(Lane::splat(simd, mass), n), cross(h, s)))
}

/// `(A_i, B_i)`.
#[inline(always)]
pub(crate) fn kinetic_columns<S: Simd>(
    simd: S,
    mass: f64,
    composite: &CompositeLanes,
    body: &BodyLanes,
) -> (Lane6<S>, Lane6<S>) {
    let twist: Lane6<S> = load(simd, &body.joint_twist);
    let a = composite_times(simd, mass, composite, twist);
    let carried = composite_times(simd, mass, composite, load(simd, &body.joint_twist_rate));
    (a, sub(carried, dual_bracket(load(simd, &body.momentum), twist)))
}

/// Second derivatives of the kinetic energy, and the total momentum with its derivatives, of a fixed-base tree at one or
/// several states `(q, q̇)` at once (lanes; at most [`KineticHessian::STATES`]).
///
/// The columns `A_i, B_i` of Algorithm 2 are the derivatives of the total spatial momentum about the origin of {0}:
/// `∂P/∂q̇_i = 𝓜_i S_i`, `∂P/∂q_i = 𝓜_i Ṡ_i - ad^D_{μ_i} S_i` (the inward recursion of [`crate::tangent`] at the root, where
/// `η = 0`).
#[derive(Clone, Debug)]
pub struct KineticHessian {
    del: DelWorkspace,
    composites: Vec<CompositeLanes>,
    a: Vec<[Quad; 6]>,
    b: Vec<[Quad; 6]>,
    pair_starts: Vec<usize>,
    /// `K_q̇q̇`, `∂²K/∂q̇_i∂q_j`, `∂²K/∂q̇_j∂q_i`, `K_qq` of every pair.
    pairs: Vec<[Quad; 4]>,
    momentum: [Quad; 6],
}

impl KineticHessian {
    /// States evaluated in one pass.
    pub const STATES: usize = LANES;

    /// Workspace for a fixed-base tree.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for a floating base.
    pub fn new(tree: &KinematicTree) -> Result<Self, ModelError> {
        if tree.is_floating() {
            return Err(ModelError::Unsupported {
                body: 0,
                reason: "the kinetic Hessian in joint coordinates needs a fixed base",
            });
        }
        let del = DelWorkspace::new(tree, &LobattoRule::new(1)?, 1.0, ForceCapacity::default())?;
        let n = tree.body_count();
        let mut pair_starts = vec![0];
        for i in 0..n {
            pair_starts.push(pair_starts[i] + tree.branch(i).len());
        }
        Ok(Self {
            del,
            composites: vec![CompositeLanes::default(); n],
            a: vec![[Quad::ZERO; 6]; n],
            b: vec![[Quad::ZERO; 6]; n],
            pairs: vec![[Quad::ZERO; 4]; pair_starts[n]],
            pair_starts,
            momentum: [Quad::ZERO; 6],
        })
    }

    /// Evaluates at the given states `(q, q̇)` (rad or m, and per s). O(Σ depth), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] for too many states or slices that do not fit the tree.
    pub fn evaluate(&mut self, tree: &KinematicTree, states: &[(&[f64], &[f64])]) -> Result<(), ModelError> {
        let length = |quantity, got: usize, expected: usize| {
            if got == expected { Ok(()) } else { Err(ModelError::Length { quantity, got, expected }) }
        };
        length("bodies of the workspace", self.a.len(), tree.body_count())?;
        if states.len() > Self::STATES {
            return Err(ModelError::Length { quantity: "states", got: states.len(), expected: Self::STATES });
        }
        for (q, q_dot) in states {
            length("q", q.len(), tree.dof())?;
            length("q_dot", q_dot.len(), tree.dof())?;
        }
        self.del.evaluate_states(tree, states);
        self.del.instructions.dispatch(Evaluate { tree, work: self });
        Ok(())
    }

    /// `∂²K/∂q̇_i∂q̇_j`, the mass matrix, for `j` on the branch of `i` at the given position.
    #[inline(always)]
    pub(crate) fn pair(&self, i: usize, position: usize) -> &[Quad; 4] {
        &self.pairs[self.pair_starts[i] + position]
    }

    /// The dense matrices at one state, row-major `n x n`: mass matrix `∂²K/∂q̇²`, `∂²K/∂q̇∂q` (row q̇, column q), `∂²K/∂q²`.
    pub fn dense_into(
        &self,
        tree: &KinematicTree,
        state: usize,
        dqd_dqd: &mut [f64],
        dqd_dq: &mut [f64],
        dq_dq: &mut [f64],
    ) {
        let n = tree.dof();
        for matrix in [&mut *dqd_dqd, &mut *dqd_dq, &mut *dq_dq] {
            matrix.fill(0.0);
        }
        for i in 0..n {
            for (position, &j) in tree.branch(i).iter().enumerate() {
                let j = j as usize;
                let [mass, own_rate, other_rate, config] = self.pair(i, position).map(|q| q.0[state]);
                dqd_dqd[i * n + j] = mass;
                dqd_dqd[j * n + i] = mass;
                dqd_dq[j * n + i] = other_rate;
                dqd_dq[i * n + j] = own_rate;
                dq_dq[i * n + j] = config;
                dq_dq[j * n + i] = config;
            }
        }
    }

    /// Total spatial momentum `P` of the moving bodies at one state, about the origin of {0}.
    pub fn momentum_w(&self, state: usize) -> Wrench {
        wrench(&self.momentum, state)
    }

    /// `(∂P/∂q̇_i, ∂P/∂q_i)` at one state.
    pub fn momentum_columns_w(&self, joint: usize, state: usize) -> (Wrench, Wrench) {
        (wrench(&self.a[joint], state), wrench(&self.b[joint], state))
    }
}

fn wrench(lanes: &[Quad; 6], state: usize) -> Wrench {
    let v = lanes.map(|q| q.0[state]);
    Wrench::from_vector(&v.into())
}

struct Evaluate<'a> {
    tree: &'a KinematicTree,
    work: &'a mut KineticHessian,
}

impl Kernel for Evaluate<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, work } = self;
        for (i, constants) in tree.constants().iter().enumerate() {
            let (h, j) = own_inertia(simd, constants, &work.del.bodies[i]);
            work.composites[i] = CompositeLanes { first_moment: store(h), rotational: store(j) };
        }
        work.momentum = [Quad::ZERO; 6];
        for i in (0..tree.body_count()).rev() {
            let constants = &tree.constants()[i];
            let own = work.composites[i];
            let body = &work.del.bodies[i];
            if constants.parent == NO_PARENT {
                work.momentum = store(add(load(simd, &work.momentum), load(simd, &body.momentum)));
            } else {
                let parent = &mut work.composites[constants.parent];
                parent.first_moment =
                    store(add(load(simd, &parent.first_moment), load(simd, &own.first_moment)));
                parent.rotational = store(add(load(simd, &parent.rotational), load(simd, &own.rotational)));
            }
            let (a, b) = kinetic_columns(simd, constants.subtree_mass, &own, body);
            work.a[i] = store(a);
            work.b[i] = store(b);
            for (position, &j) in tree.branch(i).iter().enumerate() {
                let column = &work.del.bodies[j as usize];
                let twist = load(simd, &column.joint_twist);
                let rate = load(simd, &column.joint_twist_rate);
                work.pairs[work.pair_starts[i] + position] =
                    [dot6(twist, a), dot6(rate, a), dot6(twist, b), dot6(rate, b)].map(Lane::quad);
            }
        }
    }
}
