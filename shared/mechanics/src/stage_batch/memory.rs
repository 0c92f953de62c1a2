//! What a vector of stages owns, and what all of them share while one is worked on.

use alloc::vec;
use alloc::vec::Vec;

use super::NODES;
use super::column_plan::{SIDE, Sides};
use crate::stage_lanes::StageMemory;

/// Joints whose finished rows are turned from vectors of stages to stages at a time: what the first-level cache holds easily.
pub(crate) const JOINTS_AT_ONCE: usize = 2;

/// One vector of stages: inputs and results.
#[derive(Clone, Debug)]
pub(crate) struct Batch<M> {
    /// `q^0, q^1, q^2`.
    pub nodes: [Vec<M>; NODES],
    /// `q̇_k`.
    pub start_rate: Vec<M>,
    /// `u`.
    pub force: Vec<M>,
    /// `Δt`.
    pub time_step: M,
    /// At the start: body frames, joint twists, body velocities, columns of the momentum.
    pub start: Vec<StartBody<M>>,
    pub momentum: [M; 6],
    /// `Σ m p` of the moving bodies at the start.
    pub first_moment: [M; 3],
    /// `r^0, r^1`.
    pub residual: Vec<[M; 2]>,
    /// Newton correction of `q^1`, `q^2` and `q̇_{k+1}`.
    pub correction: Vec<[M; 3]>,
    /// `M(q^2)⁻¹ p^2` at the nodes.
    pub end_rate: Vec<M>,
    /// Per joint: determinant of the pivot block, one of its two products, pivot of the mass matrix, its diagonal.
    pub pivots: Vec<[M; 4]>,
    /// `∂q^1/∂(u, q, q̇)`: `[column n + joint]`.
    pub interior: Vec<M>,
    /// `(δu, δq, δq̇)` of the last [`super::StageBatch::set_deviation`].
    pub deviation: Vec<M>,
}

/// One body of one vector of stages at the start of the stage.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct StartBody<M> {
    pub rotation: [M; 9],
    pub position: [M; 3],
    pub twist: [M; 6],
    pub velocity: [M; 6],
    /// `∂P/∂q̇`.
    pub by_rate: [M; 6],
    /// `∂P/∂q`.
    pub by_q: [M; 6],
    /// Joint force that carries the weight.
    pub gravity: M,
}

impl<M: StageMemory> Batch<M> {
    pub fn new(n: usize) -> Self {
        let zeros = || vec![M::default(); n];
        Self {
            nodes: core::array::from_fn(|_| zeros()),
            start_rate: zeros(),
            force: zeros(),
            // Lanes without a stage must stay regular.
            time_step: M::fill(0.01),
            start: vec![StartBody::default(); n],
            momentum: [M::default(); 6],
            first_moment: [M::default(); 3],
            residual: vec![[M::default(); 2]; n],
            correction: vec![[M::default(); 3]; n],
            end_rate: zeros(),
            pivots: vec![[M::default(); 4]; n],
            interior: vec![M::default(); 3 * n * n],
            deviation: vec![M::default(); 3 * n],
        }
    }
}

/// Motions: through the nodes with the rates of the interpolation polynomial, then with the true velocities at both ends.
pub(crate) const MOTIONS: usize = 5;
/// Node of every motion.
pub(crate) const NODE_OF: [usize; MOTIONS] = [0, 1, 2, 0, 2];
/// The motion with `q̇_k`.
pub(crate) const START: usize = 3;
/// The motion with `q̇_{k+1}`.
pub(crate) const END: usize = 4;

/// A block column of a body along its branch: what a solve needs going from the leaves to the root.
/// `J[a,i]` (2 x 2, row-major), row of velocities, unscaled `M[a,i]`.
pub(crate) type ForwardPanel<M> = [M; 7];
/// A block row of a body along its branch, scaled: `J⁻¹J`, row of velocities, `M[i,i]⁻¹M[i,b]`. For the body itself
/// `J_ii⁻¹`, unscaled row of velocities, `M_ii⁻¹`.
pub(crate) type BackwardPanel<M> = [M; 7];

/// Working memory shared by all vectors of stages.
#[derive(Clone, Debug)]
pub(crate) struct Scratch<M> {
    /// Body frames at the node last evaluated, which is the first one.
    pub rotations: Vec<[M; 9]>,
    pub positions: Vec<[M; 3]>,
    /// `𝓜` about the origin of {0} at every node: `h`, then `J` (xx, yy, zz, xy, xz, yz).
    pub composites: [Vec<[M; 9]>; NODES],
    /// `S`.
    pub twists: [Vec<[M; 6]>; NODES],
    /// `A = 𝓜 S`.
    pub a: [Vec<[M; 6]>; NODES],
    pub rates: [Vec<M>; MOTIONS],
    /// `Ṡ`.
    pub twist_rates: [Vec<[M; 6]>; MOTIONS],
    /// `B = 𝓜 Ṡ - ad^D_μ S`.
    pub b: [Vec<[M; 6]>; MOTIONS],
    /// Velocities and momenta of the bodies in the motion last evaluated.
    pub velocities: Vec<[M; 6]>,
    pub momenta: Vec<[M; 6]>,
    /// `r^0, r^1, p^2` as they grow.
    pub rows: Vec<[M; NODES]>,
    /// `p^2` at the nodes.
    pub end_momentum: Vec<M>,
    /// Terms of the pairs of one body, by position on its branch.
    pub terms: Vec<[M; 16]>,
    pub forward: Vec<ForwardPanel<M>>,
    pub backward: Vec<BackwardPanel<M>>,
    /// Right-hand sides, [`super::column_plan::Sides`].
    pub sides: Vec<[M; SIDE]>,
    /// Blocks of columns, one after the other, each `[(joint 3 + row) columns + column]`.
    pub columns: Vec<M>,
    /// Finished rows of some joints, all columns, stage by stage in squares.
    pub transposed: Vec<M>,
}

impl<M: StageMemory> Scratch<M> {
    /// `columns` with the padding of the blocks, `places` with that of the squares.
    pub fn new(n: usize, depth: usize, pairs: usize, (columns, places): (usize, usize)) -> Self {
        let zeros = || vec![M::default(); n];
        let twists = || vec![[M::default(); 6]; n];
        Self {
            rotations: vec![[M::default(); 9]; n],
            positions: vec![[M::default(); 3]; n],
            composites: core::array::from_fn(|_| vec![[M::default(); 9]; n]),
            twists: core::array::from_fn(|_| twists()),
            a: core::array::from_fn(|_| twists()),
            rates: core::array::from_fn(|_| zeros()),
            twist_rates: core::array::from_fn(|_| twists()),
            b: core::array::from_fn(|_| twists()),
            velocities: twists(),
            momenta: twists(),
            rows: vec![[M::default(); NODES]; n],
            end_momentum: zeros(),
            terms: vec![[M::default(); 16]; depth],
            forward: vec![[M::default(); 7]; pairs],
            backward: vec![[M::default(); 7]; pairs],
            sides: vec![[M::default(); SIDE]; Sides { pairs }.groups(n)],
            columns: vec![M::default(); 3 * n * columns],
            transposed: vec![M::default(); 2 * JOINTS_AT_ONCE * places],
        }
    }
}
