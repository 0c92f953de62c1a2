//! Stage-parallel lifted linearisation of many Simpson steps of one tree: every SIMD lane is a stage of the horizon.
//!
//! A multiple-shooting controller linearises all stages of its horizon at once, each an independent step of the same tree from
//! its own nodes, with its own input and time step. The index structure (parents, branches, elimination order) is shared, so with
//! one lane per stage (`stage_lanes`) the recursions need no shuffles. The stages are never simulated: Newton's method is
//! *lifted* into the controller's own iteration.
//!
//! | letter | meaning |
//! |---|---|
//! | `q^0, q^1, q^2`, `q̇`, `u`, `Δt` | nodes of a stage, velocity at its start, held joint force, time step |
//! | `r^0, r^1`, `p^2` | DEL residual at the nodes with `p = M(q^0) q̇`, momentum at the end, [`crate::del_residual`] |
//! | `H[α,γ]`, `K_q̇q`, `M` | [`crate::del_hessian`], [`crate::kinetic_hessian`] at the start and at the end |
//! | `X = (q^1, q^2, q̇')` | unknowns of a stage, `q̇' = M(q^2)⁻¹ p^2` the velocity at its end |
//!
//! ```text
//! [ H01   H02            0  ]        [ r^0 ]   [ H00 + K_q̇q(q^0, q̇)   M(q^0)   w_0 Δt ] [ δq ]
//! [ H11   H12            0  ] δX = - [ r^1 ] - [ H10                   0        w_1 Δt ] [ δq̇ ]
//! [ -H21  K_q̇q' - H22    M' ]        [  0  ]   [ -H20                  0       -w_2 Δt ] [ δu ]
//! ```
//!
//! The last row is `δ(M' q̇') = δp^2`. The part of `δX` without `δq, δq̇, δu` is the Newton correction: added to `(q^2, q̇')` it
//! predicts the end of the stage, so that `end - next node` is the defect of the lifted problem; for nodes that solve the step it
//! is the step itself. The other part holds `[B A]` in its rows `(q^2, q̇')` and the sensitivity of the interior node in `q^1`.
//!
//! All three rows of a joint form one 3 x 3 block per pair of joints on a branch, non-zero only there; leaves first, the
//! elimination has no fill ([`crate::branch_lu`]). Velocities come out of the same pass: no product with `H[2,γ]`, no separate
//! solve with the mass matrix.
//!
//! | phase | multiply-adds per stage, `d` depth of a joint |
//! |---|---|
//! | nodes and momenta | about 900 n |
//! | blocks | 160 Σ d |
//! | elimination | 15 Σ d² |
//! | columns | 42 n Σ d, less the zeros of the way from the leaves to the root |
//!
//! Forces: gravity, joint damping and springs, held joint forces; fixed base. Everything else is refused.
//!
//! Source: J. Albersmeyer, M. Diehl, *The lifted Newton method and its application in optimization*, SIAM J. Optim. 20, 2010;
//! mechanics: the paper, Algorithms 1 to 3 and section 3.4; elimination along branches: R. Featherstone, *Rigid Body Dynamics
//! Algorithms*, 2008, section 6.5.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3};

mod blocks;
mod column_plan;
mod elimination;
mod engine;
mod memory;
mod nodes;
mod outcome;
mod plan;

use crate::errors::{ModelError, StepError};
use crate::lobatto::LobattoRule;
use crate::spatial::{Momentum, RigidTransform, Twist, Wrench};
use crate::stage_lanes::{StageMemory, StageSimd};
use crate::tree::KinematicTree;
use engine::{Engine, at_stage, available, block_columns, place, read, with_work, write};
use plan::Plan;

/// Nodes of a Simpson step.
const NODES: usize = 3;
/// `w_α` of the Simpson rule.
const WEIGHTS: [f64; NODES] = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0];
/// `b^{αβ}` of the Simpson rule.
const DERIVATIVE: [[f64; NODES]; NODES] = [[-3.0, 4.0, -1.0], [-1.0, 0.0, 1.0], [1.0, -4.0, 3.0]];
/// One stage as the controller has it.
#[derive(Clone, Copy, Debug)]
pub struct StageInput<'a> {
    /// `q^0, q^1, q^2`: configuration at start, middle and end, rad or m.
    pub nodes: [&'a [f64]; 3],
    /// `q̇` at the start, rad/s or m/s.
    pub rate: &'a [f64],
    /// Joint force held over the stage, N·m or N.
    pub force: &'a [f64],
    /// Length of the stage, s.
    pub time_step: f64,
}

/// One body at the start of a stage, in {0}.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StartKinematics {
    /// Pose of the link frame.
    pub link_pose_w: RigidTransform,
    /// Joint twist `S_j`.
    pub joint_twist_w: Twist,
    /// Spatial velocity.
    pub velocity_w: Twist,
    /// `∂P/∂q̇_j` of the total momentum about the origin.
    pub d_momentum_d_rate: Momentum,
    /// `∂P/∂q_j`.
    pub d_momentum_d_q: Momentum,
}

/// How far the nodes of a stage are from a solution of the step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageReport {
    /// Largest absolute entry of the DEL residual at the nodes, N·m·s or N·s.
    pub residual: f64,
    /// Largest absolute Newton correction of the nodes, rad or m.
    pub change: f64,
}

/// Where `[B A]` of the stages goes.
pub trait TransitionOutput {
    /// Room for the rows of stage `stage`.
    fn transition(&mut self, stage: usize) -> TransitionRows<'_>;
}

/// Rows of `[B A]` of one stage, first those of `q`, then those of `q̇`.
///
/// Row-major, because a controller multiplies by `[B A]'`: its columns are then contiguous.
#[derive(Debug)]
pub struct TransitionRows<'a> {
    /// The numbers; those between the parts of a row are left alone.
    pub values: &'a mut [f64],
    /// Distance of rows.
    pub row_stride: usize,
    /// Where the part of `(q, q̇)` begins in a row; that of `u` begins at 0. At least `n`.
    pub first_state: usize,
}

impl TransitionRows<'_> {
    /// The last place that is written, plus one.
    fn needed(&self, n: usize) -> usize {
        (2 * n).saturating_sub(1) * self.row_stride + self.first_state + 2 * n
    }
}

/// All `[B A]` in one slice, stage after stage.
#[derive(Debug)]
pub struct TransitionSlice<'a> {
    /// The numbers.
    pub values: &'a mut [f64],
    /// Distance of stages.
    pub stage_stride: usize,
    /// Distance of rows, at least `3n`.
    pub row_stride: usize,
    /// Where `(q, q̇)` begins in a row, at least `n`.
    pub first_state: usize,
}

impl TransitionOutput for TransitionSlice<'_> {
    fn transition(&mut self, stage: usize) -> TransitionRows<'_> {
        let start = (stage * self.stage_stride).min(self.values.len());
        let end = (start + self.stage_stride).min(self.values.len());
        TransitionRows {
            values: &mut self.values[start..end],
            row_stride: self.row_stride,
            first_state: self.first_state,
        }
    }
}

/// Instructions of the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// What every processor has; four stages at a time.
    Portable,
    /// AVX2 and FMA; four stages at a time.
    Avx2,
    /// AVX-512; eight stages at a time.
    Avx512,
}

/// Lifted linearisation of the stages of a horizon, with all its memory.
///
/// # Example
/// ```
/// use delmpc_mechanics::prelude::*;
/// use delmpc_mechanics::stage_batch::{StageBatch, StageInput, TransitionSlice};
/// # let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.5), Matrix3::from_diagonal(&Vector3::new(0.09, 0.09, 0.002)));
/// # let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
/// # builder.add(Body::new(None, Joint::revolute(Vector3::y(), RigidTransform::identity()), rod));
/// # let tree = builder.build()?;
/// # let (n, stages) = (1, 3);
/// let mut batch = StageBatch::new(&tree, &LobattoRule::new(2)?, stages)?;
/// for k in 0..stages {
///     let nodes = [&[0.1][..], &[0.11][..], &[0.12][..]];
///     batch.set_stage(k, &StageInput { nodes, rate: &[1.0], force: &[0.0], time_step: 0.02 })?;
/// }
/// let mut values = vec![0.0; stages * 2 * n * 3 * n];
/// let mut output =
///     TransitionSlice { values: &mut values, stage_stride: 6 * n * n, row_stride: 3 * n, first_state: n };
/// batch.linearize(&mut output)?;
/// let mut end = vec![0.0; 2 * n];
/// for k in 0..stages {
///     batch.outcome(k)?;
///     batch.end_state_into(k, &mut end)?; // less the next node: the defect
///     // ... and after the QP:
///     batch.set_deviation(k, &[0.0], &[1e-3], &[0.0])?;
/// }
/// batch.move_interior();
/// # assert!(batch.node(0, 1, 0) > 0.1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct StageBatch {
    plan: Plan,
    engine: Engine,
    stages: usize,
    /// Whether the node behind the last stage has been given.
    has_end: bool,
    outcomes: Vec<Result<StageReport, StepError>>,
}

impl StageBatch {
    /// For `stages` stages of a fixed-base tree, with the best instructions of the processor.
    ///
    /// # Errors
    /// [`ModelError::UnsupportedOrder`] for another rule than Simpson's; [`ModelError::Unsupported`] for a floating base and for
    /// body drag or constant body wrenches.
    pub fn new(tree: &KinematicTree, rule: &LobattoRule, stages: usize) -> Result<Self, ModelError> {
        for set in [InstructionSet::Avx512, InstructionSet::Avx2] {
            if available(set) {
                return Self::with_instructions(tree, rule, stages, set);
            }
        }
        Self::with_instructions(tree, rule, stages, InstructionSet::Portable)
    }

    /// The same with given instructions.
    ///
    /// # Errors
    /// As [`StageBatch::new`], and [`ModelError::Unsupported`] for instructions the processor does not have.
    pub fn with_instructions(
        tree: &KinematicTree,
        rule: &LobattoRule,
        stages: usize,
        instructions: InstructionSet,
    ) -> Result<Self, ModelError> {
        if rule.unknown_nodes() != NODES - 1 {
            let unknown_nodes = rule.unknown_nodes();
            return Err(ModelError::UnsupportedOrder { unknown_nodes, limit: NODES - 1 });
        }
        let refuse = |body, reason| Err(ModelError::Unsupported { body, reason });
        if tree.is_floating() {
            return refuse(0, "stages of a horizon need a fixed base");
        }
        let wrenches = |c: &crate::tree::BodyConstants| c.drag.is_some() || c.constant_wrench.is_some();
        if let Some(body) = tree.constants().iter().position(wrenches) {
            return refuse(body, "stages of a horizon know no body drag and no constant body wrench");
        }
        let Some(engine) = Engine::new(tree, stages, instructions) else {
            return refuse(0, "this processor does not have these instructions");
        };
        let (columns, count) =
            with_work!(&engine, _simd, work => (block_columns(work.count()), work.count()));
        Ok(Self {
            plan: Plan::new(tree, columns, count),
            engine,
            stages,
            has_end: false,
            outcomes: vec![Ok(StageReport::default()); stages],
        })
    }

    /// The same without the sensitivities of the interior nodes, a fifth of the memory that a linearisation writes: for those who
    /// place the interior nodes otherwise. [`StageBatch::move_interior`] then applies the Newton correction only.
    pub fn without_interior_sensitivities(mut self) -> Self {
        with_work!(&mut self.engine, _simd, work => {
            work.batches.iter_mut().for_each(|batch| batch.interior = Vec::new());
        });
        self
    }

    /// Number of stages.
    pub fn stages(&self) -> usize {
        self.stages
    }

    /// Stages in a vector: what lies together in memory.
    pub fn stages_in_vector(&self) -> usize {
        with_work!(&self.engine, _simd, work => work.count())
    }

    /// Number of joints `n`.
    pub fn dof(&self) -> usize {
        self.plan.n
    }

    /// Sets a stage. Numbers that are not finite are reported by [`StageBatch::outcome`] and touch no other stage.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a stage or slice that does not fit, [`ModelError::TimeStep`] unless positive and finite.
    pub fn set_stage(&mut self, stage: usize, input: &StageInput<'_>) -> Result<(), ModelError> {
        self.check_stage(stage, self.stages)?;
        for (slice, quantity) in [
            (input.nodes[0], "start node"),
            (input.nodes[1], "interior node"),
            (input.nodes[2], "end node"),
            (input.rate, "start velocity"),
            (input.force, "held joint force"),
        ] {
            self.check_length(quantity, slice.len(), self.plan.n)?;
        }
        let time_step = input.time_step;
        if !(time_step.is_finite() && time_step > 0.0) {
            return Err(ModelError::TimeStep { time_step });
        }
        with_work!(&mut self.engine, _simd, work => work.set(stage, input));
        Ok(())
    }

    /// Sets the node behind the last stage: the kinematics of a start node are then also there as those of stage
    /// [`StageBatch::stages`].
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices that do not fit.
    pub fn set_end_node(&mut self, q: &[f64], rate: &[f64]) -> Result<(), ModelError> {
        self.check_length("end node", q.len(), self.plan.n)?;
        self.check_length("end velocity", rate.len(), self.plan.n)?;
        self.has_end = true;
        // The step from there goes nowhere; only its start is looked at.
        let input = StageInput { nodes: [q; NODES], rate, force: &[], time_step: 0.01 };
        let stages = self.stages;
        with_work!(&mut self.engine, _simd, work => work.set(stages, &input));
        Ok(())
    }

    /// Newton's method on the interior and end nodes of all stages from where they are, `iterations` times. Afterwards
    /// [`StageBatch::outcome`] has the residual *before* the last iteration and the change it made.
    pub fn iterate(&mut self, iterations: usize) {
        let Self { plan, engine, outcomes, stages, .. } = self;
        with_work!(engine, simd, work => {
            for first in (0..*stages).step_by(work.count()) {
                for _ in 0..iterations {
                    work.newton(simd, plan, first);
                }
                work.judge(simd, plan, first, outcomes, false);
            }
        });
    }

    /// Linearises all stages at their nodes and writes `[B A]` to `output`. The nodes stay; the Newton correction is
    /// part of [`StageBatch::end_state_into`] and [`StageBatch::move_interior`]. No allocation.
    ///
    /// The transition of a stage whose [`StageBatch::outcome`] is an error is not to be used.
    ///
    /// # Errors
    /// [`ModelError::Length`] when the room for a stage is too short or its parts overlap.
    pub fn linearize(&mut self, output: &mut dyn TransitionOutput) -> Result<(), ModelError> {
        let Self { plan, engine, outcomes, stages, has_end, .. } = self;
        let nodes = *stages + usize::from(*has_end);
        let mut short = None;
        with_work!(engine, simd, work => {
            for first in (0..nodes).step_by(work.count()) {
                let end = (first + work.count()).min(*stages);
                work.linearize(simd, plan, first..end.max(first), output, &mut short);
                work.judge(simd, plan, first, outcomes, true);
            }
        });
        match short {
            None => Ok(()),
            Some((got, expected)) => {
                Err(ModelError::Length { quantity: "room for a transition", got, expected })
            }
        }
    }

    /// How the last [`StageBatch::linearize`] or [`StageBatch::iterate`] went for a stage.
    ///
    /// # Errors
    /// [`StepError::NonFinite`] naming the first input (or else result) that is NaN or infinite, [`StepError::Singular`] for a
    /// pivot that vanishes, [`StepError::Argument`] for an angle beyond 1e6 rad or a stage that does not exist.
    pub fn outcome(&self, stage: usize) -> Result<StageReport, StepError> {
        self.check_stage(stage, self.stages)?;
        self.outcomes[stage]
    }

    /// `(q, q̇)` at the end of a stage, Newton correction included.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a stage or slice that does not fit.
    pub fn end_state_into(&self, stage: usize, end: &mut [f64]) -> Result<(), ModelError> {
        self.check_stage(stage, self.stages)?;
        self.check_length("end state", end.len(), 2 * self.plan.n)?;
        let (q, rate) = end.split_at_mut(self.plan.n);
        at_stage!(self, stage, batch, lane => {
            for (joint, (q, rate)) in q.iter_mut().zip(rate).enumerate() {
                let correction = &batch.correction[joint];
                *q = batch.nodes[2][joint].lanes()[lane] + correction[1].lanes()[lane];
                *rate = batch.end_rate[joint].lanes()[lane] + correction[2].lanes()[lane];
            }
        });
        Ok(())
    }

    /// Coordinate of a joint at node `alpha` (0, 1, 2) of a stage.
    pub fn node(&self, stage: usize, alpha: usize, joint: usize) -> f64 {
        at_stage!(self, stage, batch, lane => batch.nodes[alpha][joint].lanes()[lane])
    }

    /// Newton correction of the interior node.
    pub fn interior_correction(&self, stage: usize, joint: usize) -> f64 {
        at_stage!(self, stage, batch, lane => batch.correction[joint][0].lanes()[lane])
    }

    /// Derivative of the interior node `q^1` of a joint by column `column` of `(u, q, q̇)`; zero when they are not kept.
    pub fn interior_sensitivity(&self, stage: usize, joint: usize, column: usize) -> f64 {
        at_stage!(self, stage, batch, lane => {
            batch.interior.get(column * self.plan.n + joint).map_or(0.0, |cell| cell.lanes()[lane])
        })
    }

    /// The solution of the controller's problem for a stage, as deviation of `u`, `q` and `q̇` at its start; see
    /// [`StageBatch::move_interior`].
    ///
    /// # Errors
    /// [`ModelError::Length`] for a stage or slice that does not fit.
    pub fn set_deviation(
        &mut self,
        stage: usize,
        force: &[f64],
        q: &[f64],
        rate: &[f64],
    ) -> Result<(), ModelError> {
        self.check_stage(stage, self.stages)?;
        let n = self.plan.n;
        for (slice, quantity) in [(force, "change of force"), (q, "change of q"), (rate, "change of q_dot")] {
            self.check_length(quantity, slice.len(), n)?;
        }
        with_work!(&mut self.engine, _simd, work => {
            let (batch, lane) = work.place_mut(stage);
            write(&mut batch.deviation[..n], lane, force);
            write(&mut batch.deviation[n..2 * n], lane, q);
            write(&mut batch.deviation[2 * n..], lane, rate);
        });
        Ok(())
    }

    /// `q^1 += Newton correction + ∂q^1/∂(u, q, q̇) deviation`, for all stages: the lifted step of the interior nodes. 3 n² per
    /// stage. Read them with [`StageBatch::node`] or [`StageBatch::interior_node_into`].
    pub fn move_interior(&mut self) {
        let plan = &self.plan;
        with_work!(&mut self.engine, simd, work => {
            for batch in &mut work.batches {
                simd.run(elimination::MoveInterior { plan, batch, scratch: &mut work.scratch });
            }
        });
    }

    /// Copies the interior node of a stage.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a stage or slice that does not fit.
    pub fn interior_node_into(&self, stage: usize, q: &mut [f64]) -> Result<(), ModelError> {
        self.check_stage(stage, self.stages)?;
        self.check_length("interior node", q.len(), self.plan.n)?;
        at_stage!(self, stage, batch, lane => {
            q.iter_mut().zip(&batch.nodes[1]).for_each(|(q, node)| *q = node.lanes()[lane]);
        });
        Ok(())
    }

    /// Mass centre at the start of a stage in {0}, mass welded to the ground included, m.
    pub fn com_w(&self, stage: usize) -> Vector3<f64> {
        let moving = at_stage!(self, stage, batch, lane => read(&batch.first_moment, lane));
        let tree = &self.plan.tree;
        (Vector3::from(moving) + tree.ground_inertia_w().first_moment) / tree.total_mass()
    }

    /// Velocity of the mass centre at the start of a stage, m/s.
    pub fn com_velocity_w(&self, stage: usize) -> Vector3<f64> {
        self.momentum_w(stage).force / self.plan.tree.total_mass()
    }

    /// `∂c/∂q_j`, which is also `∂ċ/∂q̇_j`.
    pub fn d_com_d_q(&self, stage: usize, joint: usize) -> Vector3<f64> {
        self.d_momentum_d_rate(stage, joint).force / self.plan.tree.total_mass()
    }

    /// `∂ċ/∂q_j`.
    pub fn d_com_velocity_d_q(&self, stage: usize, joint: usize) -> Vector3<f64> {
        self.d_momentum_d_q(stage, joint).force / self.plan.tree.total_mass()
    }

    /// Total spatial momentum at the start of a stage, about the origin of {0}.
    pub fn momentum_w(&self, stage: usize) -> Momentum {
        at_stage!(self, stage, batch, lane => Wrench::from_vector(&read(&batch.momentum, lane).into()))
    }

    /// `∂P/∂q̇_j`.
    pub fn d_momentum_d_rate(&self, stage: usize, joint: usize) -> Momentum {
        at_stage!(self, stage, batch, lane => {
            Wrench::from_vector(&read(&batch.start[joint].by_rate, lane).into())
        })
    }

    /// `∂P/∂q_j`.
    pub fn d_momentum_d_q(&self, stage: usize, joint: usize) -> Momentum {
        at_stage!(self, stage, batch, lane => Wrench::from_vector(&read(&batch.start[joint].by_q, lane).into()))
    }

    /// Joint force that carries the weight at the start of a stage, as
    /// [`crate::inverse_dynamics::gravity_force_into`], N·m or N.
    pub fn gravity_force(&self, stage: usize, joint: usize) -> f64 {
        at_stage!(self, stage, batch, lane => batch.start[joint].gravity.lanes()[lane])
    }

    /// Pose of a body's link frame at the start of a stage, in {0}.
    pub fn link_pose_w(&self, stage: usize, body: usize) -> RigidTransform {
        let (rotation, position) = at_stage!(self, stage, batch, lane => {
            let body = &batch.start[body];
            (read(&body.rotation, lane), read(&body.position, lane))
        });
        let rotation = Matrix3::from_row_slice(&rotation);
        let com = self.plan.tree.bodies()[body].inertia.com;
        RigidTransform { rotation, translation: Vector3::from(position) - rotation * com }
    }

    /// Joint twist `S_j` at the start of a stage, in {0}.
    pub fn joint_twist_w(&self, stage: usize, joint: usize) -> Twist {
        at_stage!(self, stage, batch, lane => Twist::from_vector(&read(&batch.start[joint].twist, lane).into()))
    }

    /// Spatial velocity of a body at the start of a stage, in {0}.
    pub fn velocity_w(&self, stage: usize, body: usize) -> Twist {
        at_stage!(self, stage, batch, lane => Twist::from_vector(&read(&batch.start[body].velocity, lane).into()))
    }

    /// Calls `visit` with the kinematics of one body for stage `first` and those behind it in the same vector, and with their distance
    /// from `first`: what lies together in memory is read together.
    #[inline]
    pub fn visit_start(&self, first: usize, body: usize, visit: impl FnMut(usize, &StartKinematics)) {
        let com = self.plan.tree.bodies()[body].inertia.com;
        at_stage!(self, first, batch, lane => batch.start[body].visit(lane, com, visit));
    }

    fn check_stage(&self, stage: usize, count: usize) -> Result<(), ModelError> {
        if stage < count {
            Ok(())
        } else {
            Err(ModelError::Length { quantity: "stages of the batch", got: count, expected: stage + 1 })
        }
    }

    fn check_length(&self, quantity: &'static str, got: usize, expected: usize) -> Result<(), ModelError> {
        if got == expected { Ok(()) } else { Err(ModelError::Length { quantity, got, expected }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_constants_are_simpsons() {
        let rule = LobattoRule::new(2).unwrap();
        for alpha in 0..NODES {
            assert!((rule.weights()[alpha] - WEIGHTS[alpha]).abs() < 1e-15);
            for beta in 0..NODES {
                assert!((rule.derivative(alpha, beta) - DERIVATIVE[alpha][beta]).abs() < 1e-14);
            }
        }
    }
}
