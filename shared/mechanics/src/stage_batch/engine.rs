//! What a batch does with its memory in one instruction set: kernels in their order, a vector of stages at a time.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3};

use super::memory::{Batch, Scratch, StartBody};
use super::outcome::{Examine, Marks, judge};
use super::plan::Plan;
use super::{
    InstructionSet, StageInput, StageReport, StartKinematics, TransitionOutput, blocks, elimination, nodes,
};
use crate::errors::StepError;
#[cfg(target_arch = "x86_64")]
use crate::lanes::Quad;
use crate::spatial::{RigidTransform, Twist, Wrench};
#[cfg(target_arch = "x86_64")]
use crate::stage_lanes::Oct;
use crate::stage_lanes::{ScalarStages, StageMemory, StageSimd};
use crate::tree::KinematicTree;

/// Vectors of stages with the memory layout of one instruction set.
#[derive(Clone, Debug)]
pub(crate) struct Work<M> {
    pub batches: Vec<Batch<M>>,
    pub scratch: Scratch<M>,
    marks: Marks<M>,
}

/// The memory of all stages and the instructions that work on it.
#[derive(Clone, Debug)]
pub(crate) enum Engine {
    Portable(Work<<ScalarStages as StageSimd>::Memory>),
    #[cfg(target_arch = "x86_64")]
    Avx2(pulp::x86::V3, Work<Quad>),
    #[cfg(target_arch = "x86_64")]
    Avx512(pulp::x86::V4, Work<Oct>),
}

/// Scalar code.
#[cfg(feature = "compact")]
pub(crate) const SCALAR: ScalarStages = crate::stage_lanes::OneStage;
#[cfg(not(feature = "compact"))]
pub(crate) const SCALAR: ScalarStages = crate::lanes::Portable;

/// `$body` with `$work` bound to the memory, whatever its layout, and `$simd` to the instructions.
macro_rules! with_work {
    ($engine:expr, $simd:ident, $work:ident => $body:expr) => {
        match $engine {
            Engine::Portable($work) => {
                let $simd = crate::stage_batch::engine::SCALAR;
                $body
            }
            #[cfg(target_arch = "x86_64")]
            Engine::Avx2($simd, $work) => {
                let $simd = *$simd;
                $body
            }
            #[cfg(target_arch = "x86_64")]
            Engine::Avx512($simd, $work) => {
                let $simd = *$simd;
                $body
            }
        }
    };
}
pub(crate) use with_work;

/// `$body` with `$batch` and `$lane` bound to the place of a stage.
macro_rules! at_stage {
    ($self:expr, $stage:expr, $batch:ident, $lane:ident => $body:expr) => {
        with_work!(&$self.engine, _simd, work => {
            let ($batch, $lane) = place(&work.batches, $stage);
            $body
        })
    };
}
pub(crate) use at_stage;

pub(crate) fn place<M: StageMemory>(batches: &[Batch<M>], stage: usize) -> (&Batch<M>, usize) {
    (&batches[stage / M::COUNT], stage % M::COUNT)
}

#[inline(always)]
pub(crate) fn read<M: StageMemory, const N: usize>(memory: &[M; N], lane: usize) -> [f64; N] {
    core::array::from_fn(|k| memory[k].lanes()[lane])
}

pub(crate) fn write<M: StageMemory>(memory: &mut [M], lane: usize, values: &[f64]) {
    for (cell, x) in memory.iter_mut().zip(values) {
        cell.lanes_mut()[lane] = *x;
    }
}

impl<M: StageMemory> StartBody<M> {
    #[inline(always)]
    pub fn visit(&self, first: usize, com: Vector3<f64>, mut visit: impl FnMut(usize, &StartKinematics)) {
        for lane in first..M::COUNT {
            let rotation = Matrix3::from_row_slice(&read(&self.rotation, lane));
            let position = Vector3::from(read(&self.position, lane));
            let kinematics = StartKinematics {
                link_pose_w: RigidTransform { rotation, translation: position - rotation * com },
                joint_twist_w: Twist::from_vector(&read(&self.twist, lane).into()),
                velocity_w: Twist::from_vector(&read(&self.velocity, lane).into()),
                d_momentum_d_rate: Wrench::from_vector(&read(&self.by_rate, lane).into()),
                d_momentum_d_q: Wrench::from_vector(&read(&self.by_q, lane).into()),
            };
            visit(lane - first, &kinematics);
        }
    }
}

/// Columns solved together: as many as the registers hold.
pub(crate) fn block_columns(count: usize) -> usize {
    if count == 8 { 6 } else { 3 }
}

/// Whether the processor has these instructions.
pub(crate) fn available(instructions: InstructionSet) -> bool {
    match instructions {
        InstructionSet::Portable => true,
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx2 => pulp::x86::V3::try_new().is_some(),
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx512 => pulp::x86::V4::try_new().is_some(),
        #[cfg(not(target_arch = "x86_64"))]
        _ => false,
    }
}

impl Engine {
    pub fn new(tree: &KinematicTree, stages: usize, instructions: InstructionSet) -> Option<Self> {
        match instructions {
            InstructionSet::Portable => Some(Self::Portable(Work::new(tree, stages))),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => {
                pulp::x86::V3::try_new().map(|simd| Self::Avx2(simd, Work::new(tree, stages)))
            }
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => {
                pulp::x86::V4::try_new().map(|simd| Self::Avx512(simd, Work::new(tree, stages)))
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => None,
        }
    }
}

impl<M: StageMemory> Work<M> {
    pub fn new(tree: &KinematicTree, stages: usize) -> Self {
        let n = tree.dof();
        let depths = || (0..n).map(|i| tree.branch(i).len());
        let (depth, pairs) = (depths().max().unwrap_or(0), depths().sum());
        // One more lane for the node behind the last stage.
        let vectors = (stages + 1).div_ceil(M::COUNT);
        let columns = (3 * n).next_multiple_of(block_columns(M::COUNT));
        let places = n.next_multiple_of(M::COUNT) + (2 * n).next_multiple_of(M::COUNT);
        Self {
            batches: vec![Batch::new(n); vectors],
            scratch: Scratch::new(n, depth, pairs, (columns, places)),
            marks: Marks::default(),
        }
    }

    pub fn count(&self) -> usize {
        M::COUNT
    }

    pub fn place_mut(&mut self, stage: usize) -> (&mut Batch<M>, usize) {
        (&mut self.batches[stage / M::COUNT], stage % M::COUNT)
    }

    pub fn set(&mut self, stage: usize, input: &StageInput<'_>) {
        let (batch, lane) = self.place_mut(stage);
        for (memory, q) in batch.nodes.iter_mut().zip(input.nodes) {
            write(memory, lane, q);
        }
        write(&mut batch.start_rate, lane, input.rate);
        write(&mut batch.force, lane, input.force);
        batch.time_step.lanes_mut()[lane] = input.time_step;
    }

    /// One Newton iteration of the vector that begins with stage `first`.
    pub fn newton<S: StageSimd<Memory = M>>(&mut self, simd: S, plan: &Plan, first: usize) {
        let (batch, scratch) = (&mut self.batches[first / M::COUNT], &mut self.scratch);
        simd.run(nodes::Evaluate { plan, batch, scratch, full: false });
        simd.run(blocks::Assemble { plan, batch, scratch, full: false });
        simd.run(elimination::Factor { plan, batch, scratch, full: false });
        simd.run(elimination::Correct { plan, batch, scratch, apply: true });
    }

    /// Linearises the vector that begins with stage `stages.start`. An empty range: only the kinematics of its first node.
    pub fn linearize<S: StageSimd<Memory = M>>(
        &mut self,
        simd: S,
        plan: &Plan,
        stages: core::ops::Range<usize>,
        output: &mut dyn TransitionOutput,
        short: &mut Option<(usize, usize)>,
    ) {
        let (batch, scratch) = (&mut self.batches[stages.start / M::COUNT], &mut self.scratch);
        simd.run(nodes::Evaluate { plan, batch, scratch, full: true });
        if stages.is_empty() {
            return;
        }
        simd.run(blocks::Assemble { plan, batch, scratch, full: true });
        simd.run(elimination::Factor { plan, batch, scratch, full: true });
        simd.run(elimination::Correct { plan, batch, scratch, apply: false });
        simd.run(elimination::Columns { plan, batch, scratch, output, stages, short });
    }

    /// Fills the outcomes of the vector that begins with stage `first`.
    pub fn judge<S: StageSimd<Memory = M>>(
        &mut self,
        simd: S,
        plan: &Plan,
        first: usize,
        outcomes: &mut [Result<StageReport, StepError>],
        full: bool,
    ) {
        let Self { batches, scratch, marks } = self;
        let batch = &batches[first / M::COUNT];
        simd.run(Examine { plan, batch, scratch, marks, full });
        judge(plan, batch, marks, outcomes.iter_mut().skip(first).take(M::COUNT), full);
    }
}
