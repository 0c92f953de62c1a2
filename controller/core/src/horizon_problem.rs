//! The linear-quadratic problem of a horizon about its nominal: linearised dynamics, tasks, limits and contact wrench in one place.
//!
//! Per stage of length `Δt`, all in deviations from the nominal `(x̄_k, ū_k)`:
//!
//! ```text
//! transition   A, B, d     one lifted Simpson step                                  (crate::horizon_dynamics)
//! cost         Δt · (torque from the one that carries the posture, posture, speed, Cartesian tasks)   (crate::tasks)
//! bounds       torque, position and velocity limits less the nominal
//! outputs      the mean wrench of the ground on the stance foot, inside its cone     (crate::contact_wrench)
//! ```
//!
//! Terminal cost: that of standing at the home posture for ever ([`delmpc_lq::dare`]).

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::ConstraintKind;
use faer::{Accum, Mat};
use nalgebra::Vector3;

use crate::config::ControllerConfig;
use crate::contact_wrench::{SoleCone, StageWrench};
use crate::errors::ControlError;
use crate::horizon_dynamics::HorizonDynamics;
use crate::model::ControllerModel;
use crate::node_kinematics::NodeKinematics;
use crate::plan::Plan;
use crate::reference::Reference;
use crate::tasks::{MAX_RESIDUALS, TaskTargets, Tasks};
use delmpc_horizon::foot_cone::WrenchCone;
use delmpc_lq::dare::{InfiniteHorizon, solve_dare};
use delmpc_lq::kernels::gemv;
use delmpc_lq::lq_problem::{BoxBounds, LqProblem, LqSize, LqStage};
use delmpc_lq::trajectory::Trajectory;

/// The problem and what filling it takes.
#[derive(Debug)]
pub(crate) struct HorizonProblem {
    lengths: Vec<f64>,
    dynamics: HorizonDynamics,
    nodes: Vec<NodeKinematics>,
    wrench: Option<StageWrench>,
    cone: Option<SoleCone>,
    tasks: Tasks,
    targets: TaskTargets,
    torque_weight: Vec<f64>,
    terminal_cost: Mat<f64>,
    terminal_error: Vec<f64>,
    pub problem: LqProblem,
}

impl HorizonProblem {
    /// Takes all memory. `cone`: none when the model stands on nothing.
    pub fn new(
        model: &ControllerModel,
        config: &ControllerConfig,
        cone: Option<&WrenchCone>,
    ) -> Result<Self, ControlError> {
        let tree = &model.tree;
        let n = tree.dof();
        let lengths = config.stage_lengths();
        let mut problem = LqProblem::new(LqSize {
            states: 2 * n,
            inputs: n,
            stages: lengths.len(),
            outputs: if cone.is_some() { 6 } else { 0 },
            rows: cone.map_or(0, |cone| cone.rows().len()),
            residuals: MAX_RESIDUALS,
            squares: 0,
        });
        for j in 0..n {
            problem.input_tags[j].label = ConstraintKind::Torque as u32;
            problem.state_tags[j].label = ConstraintKind::JointPosition as u32;
            problem.state_tags[n + j].label = ConstraintKind::JointVelocity as u32;
            problem.state_tags[n + j].row = j as u32;
            problem.input_tags[j].scale = model.limits[j].effort.min(1e9);
            problem.state_tags[j].penalty = config.constraints.position_penalty;
            problem.state_tags[n + j].penalty = config.constraints.velocity_penalty;
            problem.state_tags[n + j].scale = model.limits[j].velocity.min(1e9);
        }
        if let Some(cone) = cone {
            problem.output_rows = cone.output_rows().collect();
            for stage in &mut problem.stages {
                stage.row_bounds.iter_mut().zip(cone.rows()).for_each(|(bound, row)| *bound = row.bound);
            }
        }
        // Without a limit, 100 N·m stands for one.
        let effort = |limit: f64| if limit.is_finite() { limit } else { 100.0 };
        let torque_weight = model
            .limits
            .iter()
            .map(|limit| {
                let effort = effort(limit.effort);
                config.weights.torque / (effort * effort)
            })
            .collect();
        Ok(Self {
            dynamics: HorizonDynamics::new(tree, lengths.len())?,
            nodes: vec![NodeKinematics::new(tree); lengths.len() + 1],
            wrench: cone.map(|_| StageWrench::new(n)),
            cone: cone.map(SoleCone::new),
            tasks: Tasks::new(n, config.weights.clone(), model.hand, model.swing_foot),
            targets: TaskTargets::new(n),
            torque_weight,
            terminal_cost: Mat::zeros(2 * n, 2 * n),
            terminal_error: vec![0.0; 2 * n],
            problem,
            lengths,
        })
    }

    /// Says where the stance sole is in {0}, from the next [`Self::linearise`] on.
    pub fn place_sole(&mut self, sole_pose: &RigidTransform) {
        if let Some(cone) = &self.cone {
            cone.place(sole_pose, &mut self.problem.output_rows);
        }
    }

    /// Fills the problem around the nominal.
    ///
    /// # Errors
    /// The first stage that cannot be linearised.
    pub fn linearise(
        &mut self,
        model: &ControllerModel,
        config: &ControllerConfig,
        reference: &Reference,
        nominal: &Plan,
    ) -> Result<(), StepError> {
        let tree = &model.tree;
        let n = tree.dof();
        self.dynamics.linearise(&nominal.values, &self.lengths, &mut self.problem.stages)?;
        NodeKinematics::take_all(&mut self.nodes, self.dynamics.batch());
        for (k, &duration) in self.lengths.iter().enumerate() {
            let (x, u) = (nominal.values.x(k), nominal.values.u(k));
            let stage = &mut self.problem.stages[k];
            let time_s = nominal.start_s + nominal.offsets()[k];
            reference.sample(time_s, &mut self.targets);
            reference.sample_torque((time_s, time_s + duration), &mut self.targets);
            for (j, u) in u.iter().enumerate() {
                let weight = self.torque_weight[j] * duration;
                let aim = self.dynamics.batch().gravity_force(k, j) + self.targets.torque[j];
                stage.cost.input_weight[j] = weight;
                stage.cost.input_gradient[j] = weight * (u - aim);
            }
            let node = &self.nodes[k];
            self.tasks.quadratise(tree, node, x.split_at(n), &self.targets, duration, &mut stage.cost);
            bound_inputs(model, config.constraints.torque_fraction, u, stage);
            bound_state(model, x, &mut stage.state);
            if let Some(wrench) = &mut self.wrench {
                wrench.linearize(tree, node, &self.nodes[k + 1], duration, stage);
            }
        }
        self.terminal(model, reference, nominal);
        Ok(())
    }

    /// Cost and bounds of the last node.
    fn terminal(&mut self, model: &ControllerModel, reference: &Reference, nominal: &Plan) {
        let n = model.tree.dof();
        let x = nominal.values.x(self.lengths.len());
        reference.sample(nominal.start_s + nominal.horizon_s(), &mut self.targets);
        for j in 0..n {
            self.terminal_error[j] = x[j] - self.targets.posture[j];
            self.terminal_error[n + j] = x[n + j] - self.targets.posture_rate[j];
        }
        let gradient = &mut self.problem.terminal_gradient;
        gemv(gradient, Accum::Replace, self.terminal_cost.as_ref(), &self.terminal_error, 1.0);
        bound_state(model, x, &mut self.problem.terminal_state);
    }

    /// Force of the ground on the stance foot, mean over a stage, on a trajectory of deviations; in {0}, N.
    pub fn force(&self, stage: usize, trajectory: &Trajectory) -> Option<Vector3<f64>> {
        self.wrench.as_ref()?;
        let stage_problem = self.problem.stages.get(stage)?;
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        Some(Vector3::from_fn(|axis, _| {
            let (by_input, by_state, constant) = stage_problem.output(3 + axis);
            dot(by_input, trajectory.u(stage)) + dot(by_state, trajectory.x(stage)) + constant
        }))
    }

    /// The point of a joint's axis nearest to the origin of {0}, at the start of a stage; the origin for a slide.
    pub fn axis_point(&self, stage: usize, joint: usize) -> Vector3<f64> {
        let twist = self.nodes[stage].joint_twist_w(joint);
        let square = twist.angular.norm_squared();
        if square > 0.0 { twist.angular.cross(&twist.linear) / square } else { Vector3::zeros() }
    }

    /// Terminal cost of every problem from now on.
    pub fn set_terminal_cost(&mut self, cost: &Mat<f64>) {
        self.terminal_cost.copy_from(cost);
        self.problem.terminal_hessian.copy_from(cost);
    }

    /// Standing at rest at `x` for ever in stages of `duration` (s), under the torque that carries it. Allocates.
    ///
    /// # Errors
    /// When the step has no solution, or the problem none.
    pub fn stand_still(
        &mut self,
        tree: &KinematicTree,
        dynamics: &mut HorizonDynamics,
        reference: &Reference,
        (x, torque): (&[f64], &[f64]),
        duration: f64,
    ) -> Result<InfiniteHorizon, ControlError> {
        let n = tree.dof();
        let size = LqSize { states: 2 * n, inputs: n, residuals: MAX_RESIDUALS, ..LqSize::default() };
        // At rest under the torque that carries it every node of the step is the posture, and so is its end.
        let mut rest = Trajectory::new(LqSize { stages: 1, ..size });
        rest.x_mut(0).copy_from_slice(x);
        rest.x_mut(1).copy_from_slice(x);
        rest.u_mut(0).copy_from_slice(torque);
        let mut stages = [LqStage::new(size)];
        dynamics.linearise(&rest, &[duration], &mut stages)?;
        let [mut stage] = stages;
        for (target, weight) in stage.cost.input_weight.iter_mut().zip(&self.torque_weight) {
            *target = weight * duration;
        }
        let node = &mut self.nodes[0];
        node.update(tree, &x[..n], &x[n..])?;
        reference.sample(f64::NEG_INFINITY, &mut self.targets);
        self.tasks.quadratise(tree, node, x.split_at(n), &self.targets, duration, &mut stage.cost);
        Ok(solve_dare(&stage)?)
    }
}

/// Torque limits as bounds on the deviation from the nominal torque.
fn bound_inputs(model: &ControllerModel, fraction: f64, nominal: &[f64], stage: &mut LqStage) {
    for (j, limit) in model.limits.iter().enumerate() {
        stage.input.upper[j] = fraction * limit.effort - nominal[j];
        stage.input.lower[j] = -fraction * limit.effort - nominal[j];
    }
}

/// Position and velocity limits as bounds on the deviation from a nominal state.
fn bound_state(model: &ControllerModel, nominal: &[f64], bounds: &mut BoxBounds) {
    let n = model.limits.len();
    for (j, limit) in model.limits.iter().enumerate() {
        bounds.lower[j] = limit.lower - nominal[j];
        bounds.upper[j] = limit.upper - nominal[j];
        bounds.lower[n + j] = -limit.velocity - nominal[n + j];
        bounds.upper[n + j] = limit.velocity - nominal[n + j];
    }
}
