//! One control cycle: state in, command out, always.
//!
//! ```text
//! take the state in -> shift the nominal -> linearise every stage -> Riccati -> constrained QP -> command
//! ```
//!
//! Whatever fails, a command goes out: from the best rung of the ladder ([`crate::fallback`]) that can be formed, and the report
//! says what happened. Time is an argument; figures of time come from a [`Clock`] of the caller.
//!
//! Source: M. Diehl, H. G. Bock, J. P. Schlöder, *A real-time iteration scheme for nonlinear optimization in optimal feedback
//! control*, SIAM J. Control Optim. 43, 2005: one linearisation and one QP per cycle, warm-started by the shifted solution.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_messages::{Command, CycleReport, FallbackLevel, LARGEST_EFFORT, PlantState, Verdict};
use faer::{Mat, MatRef};
use nalgebra::Vector3;

use crate::config::{ControllerConfig, ControllerKind};
use crate::contact_wrench::{FlatFoot, StageWrench, WrenchCone};
use crate::dare::solve_dare;
use crate::dual_qp::QpSolver;
use crate::errors::ControlError;
use crate::estimator::{Estimate, Estimator};
use crate::fallback::{Attempt, FallbackLadder, Situation};
use crate::feedback_law::{Law, bound_by_pressure_point, write_law};
use crate::horizon_dynamics::HorizonDynamics;
use crate::kernels::{all_finite, gemv};
use crate::lq_problem::{LqProblem, LqSize, LqStage};
use crate::model::ControllerModel;
use crate::node_kinematics::NodeKinematics;
use crate::plan::Plan;
use crate::posture_goal::{posture_goal, reach_posture};
use crate::projected_qp::{ProjectedQp, ProjectedQpReport, default_backend};
use crate::reference::{Reach, Reference};
use crate::riccati::{Riccati, Trajectory};
use crate::stage_dynamics::StageDynamics;
use crate::stop_watch::StopWatch;
pub use crate::stop_watch::{Clock, StoppedClock};
use crate::tasks::{TaskTargets, Tasks};

/// Reasons for refusing a state that are the controller's own ([`Command::reason`]); below 100 they are the message's.
pub mod reason {
    /// The measurement is too old.
    pub const STALE: u32 = 100;
    /// The measurement is from before the last one.
    pub const OUT_OF_ORDER: u32 = 101;
    /// The estimator refused it.
    pub const ESTIMATOR: u32 = 102;
    /// The measurement is from a time that has not come: believed, it would make all true ones look old.
    pub const AHEAD: u32 = 103;
    /// The prediction to the time of the command failed.
    pub const PREDICTION: u32 = 110;
    /// A stage of the horizon could not be simulated.
    pub const STAGE: u32 = 111;
    /// The Riccati recursion broke down.
    pub const RICCATI: u32 = 112;
    /// The constrained QP gave nothing usable.
    pub const QP: u32 = 113;
    /// The plan is farther from the nominal than a linearisation reaches.
    pub const FAR: u32 = 114;
}

/// A violation beyond this part of a constraint's scale is reported as [`Verdict::Infeasible`].
const GAVE_WAY: f64 = 1e-3;
/// A plan that moves a node by more than this (rad, m) is not believed.
const LARGEST_MOVE: f64 = 2.0;
/// Cycles in a row with a large innovation before [`Verdict::ModelMismatch`].
const MISMATCH_CYCLES: u32 = 5;
/// Part of effort over velocity limit that damps a joint on the last rungs.
const DAMPING_FRACTION: f64 = 0.1;
/// Distance of any joint from the home posture up to which the static LQR is trusted, rad or m.
const LQR_REACH: f64 = 0.6;

/// The controller: everything it needs for a cycle, allocated once.
#[derive(Debug)]
pub struct Controller {
    model: ControllerModel,
    config: ControllerConfig,
    lengths: Vec<f64>,

    estimator: Estimator,
    ladder: FallbackLadder,
    reference: Reference,
    targets: TaskTargets,
    tasks: Tasks,
    torque_weight: Vec<f64>,
    cone: Option<WrenchCone>,

    dynamics: StageDynamics,
    horizon: HorizonDynamics,
    nodes: Vec<NodeKinematics>,
    gravity: InverseDynamicsWorkspace,
    wrench: StageWrench,

    problem: LqProblem,
    riccati: Riccati,
    qp: ProjectedQp,
    backend: Box<dyn QpSolver + Send>,
    solution: Trajectory,
    /// The last plan, and the one under construction.
    plan: Plan,
    nominal: Plan,
    has_plan: bool,

    /// State predicted for the time of the command.
    predicted: Vec<f64>,
    predicted_for_s: f64,
    has_prediction: bool,
    surprising_cycles: u32,
    innovation_rate: f64,
    scratch: Vec<f64>,

    static_law: Law,
    terminal_cost: Mat<f64>,
    /// The law in the last command.
    law: Law,
    command: Command,
    blank_report: CycleReport,

    origin_ns: Option<u64>,
    last_state_ns: Option<u64>,
    last_sequence: u64,
}

impl Controller {
    /// Checks model and configuration, solves the infinite-horizon problem at the home posture, takes all memory.
    ///
    /// # Errors
    /// [`ControlError`]: the first thing found wrong, with index and rule.
    pub fn new(model: ControllerModel, config: ControllerConfig) -> Result<Self, ControlError> {
        model.check()?;
        config.check()?;
        let tree = &model.tree;
        let n = tree.dof();
        let lengths = config.stage_lengths();
        let cone = if model.sole.is_empty() {
            None
        } else {
            let weight = tree.total_mass() * tree.gravity_w().norm();
            let c = &config.constraints;
            let foot = FlatFoot {
                polygon: model.sole.clone(),
                margin_m: c.cop_margin_m,
                friction: c.friction,
                friction_sides: c.friction_sides,
                yaw_arm_m: c.yaw_arm_m,
                min_force_n: c.min_force_fraction * weight,
            };
            Some(WrenchCone::flat_foot(&foot, weight, c.contact_penalty)?)
        };
        let rows = cone.as_ref().map_or(0, |cone| cone.rows().len());
        let size = LqSize { states: 2 * n, inputs: n, stages: lengths.len(), rows };
        let mut problem = LqProblem::new(size);
        for j in 0..n {
            problem.input_tags[j].scale = model.limits[j].effort.min(1e9);
            problem.state_tags[j].penalty = config.constraints.position_penalty;
            problem.state_tags[n + j].penalty = config.constraints.velocity_penalty;
            problem.state_tags[n + j].scale = model.limits[j].velocity.min(1e9);
        }
        let home = posture_goal(&model, &model.posture)?;
        let backend = default_backend(config.qp.capacity)
            .map_err(|_| ControlError::Model { reason: "the QP solver refused its set-up" })?;
        let torque_weight = model
            .limits
            .iter()
            .map(|limit| {
                // Without a limit, 100 N·m stands for one.
                let effort = if limit.effort.is_finite() { limit.effort } else { 100.0 };
                config.weights.torque / (effort * effort)
            })
            .collect();
        let mut command = Command::new(0, model.joint_set_hash, n as u32);
        command.fallback_level = FallbackLevel::ZeroTorque as u32;
        let plan = Plan::new(Trajectory::new(size), &lengths);
        let mut controller = Self {
            estimator: Estimator::new(&model),
            ladder: FallbackLadder::new(config.fallback),
            reference: Reference { home, reach: None },
            targets: TaskTargets::new(n),
            tasks: Tasks::new(n, config.weights.clone(), model.hand, model.swing_foot),
            torque_weight,
            cone,
            dynamics: StageDynamics::new(tree)?,
            horizon: HorizonDynamics::new(tree, lengths.len())?,
            nodes: vec![NodeKinematics::new(tree); lengths.len() + 1],
            gravity: InverseDynamicsWorkspace::new(tree),
            wrench: StageWrench::new(n),
            problem,
            riccati: Riccati::new(size),
            qp: ProjectedQp::new(size, config.qp),
            backend,
            solution: Trajectory::new(size),
            nominal: plan.clone(),
            plan,
            has_plan: false,
            predicted: vec![0.0; 2 * n],
            predicted_for_s: 0.0,
            has_prediction: false,
            surprising_cycles: 0,
            innovation_rate: 0.0,
            scratch: vec![0.0; 4 * n],
            static_law: Law::new(n),
            terminal_cost: Mat::zeros(2 * n, 2 * n),
            law: Law::new(n),
            blank_report: command.report,
            command,
            origin_ns: None,
            last_state_ns: None,
            last_sequence: 0,
            lengths,
            model,
            config,
        };
        controller.solve_infinite_horizon()?;
        if let Some(reach) = controller.config.reach {
            controller.set_reach(Some(reach))?;
        }
        Ok(controller)
    }

    /// One cycle. `now_ns` is the present time by the plant's clock; `clock` only times the steps for the report.
    ///
    /// The command has everything but its sequence, the time of sending and the run's identity. No allocation, other than the QP
    /// backend's.
    pub fn cycle(&mut self, state: &PlantState, now_ns: u64, clock: &dyn Clock) -> &Command {
        let begin = clock.now_ns();
        self.command.report = self.blank_report;
        self.command.reason = 0;
        self.command.verdict = Verdict::Ok as u32;

        let attempt = self.attempt(state, now_ns, clock);
        let outcome = match attempt {
            Ok(()) => Attempt::Solved,
            Err(reason) => {
                self.command.reason = reason;
                if reason < reason::PREDICTION { Attempt::NoState } else { Attempt::NoSolution }
            }
        };
        if outcome == Attempt::NoState {
            self.command.verdict = Verdict::BadState as u32;
        } else if outcome == Attempt::NoSolution {
            self.command.verdict = Verdict::Infeasible as u32;
        }
        let situation = self.situation(outcome, now_ns);
        let level = self.ladder.advance(&situation);
        self.write_command(level, state, now_ns);

        let total_ns = clock.now_ns().saturating_sub(begin);
        self.command.report.total_ns = total_ns;
        let late = total_ns as f64 * 1e-9 > self.config.budget_s;
        if late && self.command.verdict == Verdict::Ok as u32 {
            self.command.verdict = Verdict::Late as u32;
        }
        &self.command
    }

    /// The steps of a cycle; an error is a reason code.
    fn attempt(&mut self, state: &PlantState, now_ns: u64, clock: &dyn Clock) -> Result<(), u32> {
        let mut watch = StopWatch::start(clock);
        let start_s = self.take_state(state, now_ns)?;
        self.command.report.state_in_ns = watch.lap();
        if self.config.kind != ControllerKind::Mpc {
            return Ok(());
        }
        self.shift_nominal(start_s);
        self.command.report.shift_ns = watch.lap();
        let linearised = self.linearise_stages();
        self.command.report.linearize_ns = watch.lap();
        linearised?;
        let factorised = self.riccati.factorise(&self.problem);
        self.command.report.riccati_ns = watch.lap();
        factorised.map_err(|_| reason::RICCATI)?;
        let solved = self.solve_constrained();
        self.command.report.qp_ns = watch.lap();
        let report = solved?;
        self.adopt_plan()?;
        self.report_constraints(&report);
        Ok(())
    }

    /// Validates and converts the measurement, and predicts the state at which the command takes effect; returns that time.
    fn take_state(&mut self, state: &PlantState, now_ns: u64) -> Result<f64, u32> {
        let n = self.model.tree.dof();
        state.validate(self.model.joint_set_hash, n).map_err(|error| error.code())?;
        if now_ns.saturating_sub(state.time_ns) as f64 * 1e-9 > self.config.max_state_age_s {
            return Err(reason::STALE);
        }
        if state.time_ns > now_ns {
            return Err(reason::AHEAD);
        }
        if self.last_state_ns.is_some_and(|last| state.time_ns < last) {
            return Err(reason::OUT_OF_ORDER);
        }
        self.estimator.update(&self.model, state).map_err(|_| reason::ESTIMATOR)?;
        self.origin_ns.get_or_insert(state.time_ns);
        self.last_state_ns = Some(state.time_ns);
        self.last_sequence = state.header.sequence;

        let measured_s = self.run_time_s(state.time_ns);
        self.test_innovation(measured_s);
        let Estimate { q, q_dot, .. } = self.estimator.estimate();
        self.predicted[..n].copy_from_slice(q);
        self.predicted[n..].copy_from_slice(q_dot);
        let start_s = (measured_s + self.config.delay_s).max(self.run_time_s(now_ns));
        self.predict(start_s - measured_s).map_err(|()| reason::PREDICTION)?;
        self.predicted_for_s = start_s;
        self.has_prediction = true;
        Ok(start_s)
    }

    /// Moves `predicted` forward under the law of the last command, in the steps of the servo: its gains are too stiff for longer ones.
    fn predict(&mut self, duration_s: f64) -> Result<(), ()> {
        if duration_s <= 0.0 || self.command.state_sequence == 0 {
            return Ok(());
        }
        let n = self.model.tree.dof();
        let steps = libm::ceil(duration_s / self.config.servo_period_s - 1e-9).max(1.0);
        let time_step = duration_s / steps;
        let (error, rest) = self.scratch.split_at_mut(2 * n);
        let (torque, _) = rest.split_at_mut(n);
        let mut elapsed_s = 0.0;
        for _ in 0..steps as usize {
            self.law.torque_at(elapsed_s, &self.predicted, error, torque);
            elapsed_s += time_step;
            let tree = &self.model.tree;
            self.dynamics.simulate(tree, &self.predicted, torque, time_step, error).map_err(|_| ())?;
            self.predicted.copy_from_slice(error);
        }
        if all_finite(&self.predicted) { Ok(()) } else { Err(()) }
    }

    /// Compares the measurement with what the last cycle predicted for its time.
    fn test_innovation(&mut self, measured_s: f64) {
        if !self.has_prediction || (measured_s - self.predicted_for_s).abs() > 1e-6 {
            return;
        }
        let n = self.model.tree.dof();
        let rates = self.estimator.estimate().q_dot.iter().zip(&self.predicted[n..]);
        let squares: f64 = rates.map(|(a, b)| (a - b) * (a - b)).sum();
        self.innovation_rate = libm::sqrt(squares / n as f64);
        if self.innovation_rate > self.config.mismatch_rate {
            self.surprising_cycles += 1;
        } else {
            self.surprising_cycles = 0;
        }
        if self.surprising_cycles >= MISMATCH_CYCLES {
            self.command.verdict = Verdict::ModelMismatch as u32;
        }
    }

    /// The last plan as it looks from `start_s` on; without a plan the reference at rest.
    fn shift_nominal(&mut self, start_s: f64) {
        let usable = self.has_plan
            && start_s >= self.plan.start_s - 1e-9
            && start_s < self.plan.start_s + self.config.fallback.plan_age_s.max(self.config.period_s);
        if usable {
            self.plan.shift_into(start_s, &mut self.nominal);
            return;
        }
        let n = self.model.tree.dof();
        self.nominal.start_s = start_s;
        for k in 0..=self.lengths.len() {
            self.reference.sample(start_s + self.nominal.offsets()[k], &mut self.targets);
            let x = self.nominal.values.x.col_as_slice_mut(k);
            x[..n].copy_from_slice(&self.targets.posture);
            x[n..].copy_from_slice(&self.targets.posture_rate);
            if k < self.lengths.len() {
                let u = self.nominal.values.u.col_as_slice_mut(k);
                u.copy_from_slice(&self.static_law.torque);
            }
        }
    }

    /// Fills the LQ problem around the nominal.
    fn linearise_stages(&mut self) -> Result<(), u32> {
        let tree = &self.model.tree;
        let n = tree.dof();
        let stages = self.lengths.len();
        let Trajectory { x: nodes, u: inputs } = &self.nominal.values;
        self.horizon
            .linearise(nodes.as_ref(), inputs.as_ref(), &self.lengths, &mut self.problem.stages)
            .map_err(|_| reason::STAGE)?;
        for (k, node) in self.nodes.iter_mut().enumerate() {
            node.take(self.horizon.batch(), k);
        }
        for k in 0..stages {
            let (x, u) = (nodes.col_as_slice(k), inputs.col_as_slice(k));
            let stage = &mut self.problem.stages[k];
            let duration = self.lengths[k];

            self.reference.sample(self.nominal.start_s + self.nominal.offsets()[k], &mut self.targets);
            stage.hessian.fill(0.0);
            stage.gradient.fill(0.0);
            for (j, u) in u.iter().enumerate() {
                let weight = self.torque_weight[j] * duration;
                stage.hessian[(j, j)] = weight;
                stage.gradient[j] = weight * (u - self.horizon.batch().gravity_force(k, j));
            }
            let hessian = stage.hessian.as_mut().submatrix_mut(n, n, 2 * n, 2 * n);
            let gradient = &mut stage.gradient[n..];
            let node = &self.nodes[k];
            self.tasks.quadratise(tree, node, x.split_at(n), &self.targets, duration, (hessian, gradient));

            bound_inputs(&self.model, self.config.constraints.torque_fraction, u, stage);
            bound_state(&self.model, x, &mut stage.state);
            if let Some(cone) = &self.cone {
                self.wrench.linearize(tree, node, &self.nodes[k + 1], duration, stage);
                self.wrench.write_rows(cone, stage);
            }
        }
        self.terminal(stages);
        Ok(())
    }

    /// Cost and bounds of the last node.
    fn terminal(&mut self, stages: usize) {
        let n = self.model.tree.dof();
        let x = self.nominal.values.x.col_as_slice(stages);
        self.reference.sample(self.nominal.start_s + self.nominal.horizon_s(), &mut self.targets);
        let error = &mut self.scratch[..2 * n];
        for j in 0..n {
            error[j] = x[j] - self.targets.posture[j];
            error[n + j] = x[n + j] - self.targets.posture_rate[j];
        }
        self.problem.terminal_hessian.copy_from(&self.terminal_cost);
        let gradient = &mut self.problem.terminal_gradient;
        gemv(gradient, faer::Accum::Replace, self.terminal_cost.as_ref(), error, 1.0);
        bound_state(&self.model, x, &mut self.problem.terminal_state);
    }

    fn solve_constrained(&mut self) -> Result<ProjectedQpReport, u32> {
        let first = self.solution.x.col_as_slice_mut(0);
        for ((d, x), node) in first.iter_mut().zip(&self.predicted).zip(self.nominal.values.x.col_as_slice(0))
        {
            *d = x - node;
        }
        let solved = self.qp.solve(&self.problem, &self.riccati, self.backend.as_mut(), &mut self.solution);
        solved.map_err(|_| reason::QP)
    }

    /// The solution becomes the plan, unless it is out of reach of the linearisation.
    fn adopt_plan(&mut self) -> Result<(), u32> {
        let n = self.model.tree.dof();
        let largest = |k: usize| crate::kernels::largest(&self.solution.x.col_as_slice(k)[..n]);
        if (0..=self.lengths.len()).any(|k| largest(k) > LARGEST_MOVE) {
            return Err(reason::FAR);
        }
        self.nominal.add(&self.solution);
        core::mem::swap(&mut self.plan, &mut self.nominal);
        self.has_plan = true;
        Ok(())
    }

    fn report_constraints(&mut self, report: &ProjectedQpReport) {
        let out = &mut self.command.report;
        out.qp_solves = report.solves;
        out.qp_iterations = report.iterations;
        out.active_rows = report.active_rows;
        out.dropped_rows = report.dropped_rows;
        if let Some(worst) = report.worst.filter(|worst| worst.amount > GAVE_WAY * worst.tag.scale) {
            out.worst_violation = worst.amount;
            out.worst_constraint = worst.tag.kind as u32;
            out.worst_stage = u32::from(worst.row.stage);
            out.worst_row = worst.tag.row;
            if self.command.verdict == Verdict::Ok as u32 {
                self.command.verdict = Verdict::Infeasible as u32;
            }
        }
    }

    fn situation(&self, attempt: Attempt, now_ns: u64) -> Situation {
        let now_s = self.run_time_s(now_ns);
        let blind_s = self.last_state_ns.map_or(0.0, |last| now_s - self.run_time_s(last));
        let estimate = self.estimator.estimate();
        let near_posture =
            estimate.q.iter().zip(&self.model.posture).all(|(q, home)| (q - home).abs() < LQR_REACH);
        Situation {
            attempt,
            plan_age_s: self.has_plan.then_some(now_s - self.plan.start_s),
            near_posture: self.last_state_ns.is_some() && near_posture,
            blind_s,
        }
    }

    /// Forms the law of a level and writes it out; a law with a number that is not plausible gives way to the next level.
    fn write_command(&mut self, level: FallbackLevel, state: &PlantState, now_ns: u64) {
        let n = self.model.tree.dof();
        let start_ns = match self.last_state_ns {
            Some(last) => now_ns.max(last + to_ns(self.config.delay_s)),
            None => now_ns,
        };
        self.command.state_sequence = self.last_sequence.max(u64::from(self.last_state_ns.is_some()));
        self.command.state_time_ns = self.last_state_ns.unwrap_or(state.time_ns);
        self.command.valid_from_ns = start_ns;
        self.command.valid_until_ns = start_ns + to_ns(self.config.command_life_s);
        for level in LEVELS.into_iter().filter(|candidate| *candidate >= level) {
            self.form_law(level, self.run_time_s(start_ns));
            self.command.fallback_level = level as u32;
            write_law(&self.law, &self.model.message_joint, &mut self.command);
            if self.command.validate(self.model.joint_set_hash, n).is_ok() {
                if level > self.ladder.level() {
                    self.ladder.descend_to(level);
                }
                return;
            }
        }
    }

    /// The law of a level at a time of the run.
    fn form_law(&mut self, level: FallbackLevel, time_s: f64) {
        let n = self.model.tree.dof();
        let law = &mut self.law;
        for (j, limit) in self.model.limits.iter().enumerate() {
            let effort = limit.effort.min(LARGEST_EFFORT);
            (law.lower[j], law.upper[j]) = (-effort, effort);
        }
        law.acceleration.fill(0.0);
        let effective = match (self.config.kind, level) {
            (ControllerKind::Off, _) => FallbackLevel::ZeroTorque,
            (ControllerKind::StaticLqr, FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan) => {
                FallbackLevel::StaticLqr
            }
            _ => level,
        };
        match effective {
            FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan => {
                let stage = self.plan.stage_at(time_s);
                law.torque.copy_from_slice(self.plan.values.u.col_as_slice(stage));
                // The law holds for a period, over which its reference goes from the plan's rates to the plan's rates.
                let period_s = self.config.period_s;
                self.plan.state_at(time_s + period_s, &mut self.scratch[..2 * n]);
                self.plan.state_at(time_s, &mut law.reference);
                for j in 0..n {
                    law.acceleration[j] = (self.scratch[n + j] - law.reference[n + j]) / period_s;
                }
                law.gain.copy_from(self.riccati.gain(stage));
                if level == FallbackLevel::FreshSolution {
                    let planned = (self.solution.u.as_ref(), self.solution.x.as_ref());
                    bound_by_pressure_point(&self.problem.stages[stage], stage, planned, law);
                }
            }
            FallbackLevel::StaticLqr => {
                law.torque.copy_from_slice(&self.static_law.torque);
                law.reference.copy_from_slice(&self.static_law.reference);
                law.gain.copy_from(&self.static_law.gain);
            }
            FallbackLevel::GravityHold | FallbackLevel::DampingOnly | FallbackLevel::ZeroTorque => {
                law.torque.fill(0.0);
                law.reference.fill(0.0);
                law.gain.fill(0.0);
                let Estimate { q, .. } = self.estimator.estimate();
                law.reference[..n].copy_from_slice(q);
                if effective != FallbackLevel::ZeroTorque {
                    for (j, limit) in self.model.limits.iter().enumerate() {
                        let damping = DAMPING_FRACTION * limit.effort / limit.velocity;
                        law.gain[(j, n + j)] = if damping.is_finite() { -damping } else { -1.0 };
                    }
                }
                if effective == FallbackLevel::GravityHold {
                    self.scratch[..n].fill(0.0);
                    let node = &mut self.nodes[0];
                    let held = node.update(&self.model.tree, q, &self.scratch[..n]).and_then(|()| {
                        let kinematics = node.kinematics();
                        gravity_force_into(&self.model.tree, kinematics, &mut self.gravity, &mut law.torque)
                    });
                    if held.is_err() {
                        law.torque.fill(0.0);
                    }
                }
            }
        }
        for (j, u) in law.torque.iter_mut().enumerate() {
            *u = u.max(law.lower[j]).min(law.upper[j]);
        }
    }

    /// Cost and gain of standing still for ever, at the home posture.
    fn solve_infinite_horizon(&mut self) -> Result<(), ControlError> {
        let tree = &self.model.tree;
        let n = tree.dof();
        let mut x = vec![0.0; 2 * n];
        x[..n].copy_from_slice(&self.model.posture);
        self.nodes[0].update(tree, &x[..n], &x[n..])?;
        let mut torque = vec![0.0; n];
        gravity_force_into(tree, self.nodes[0].kinematics(), &mut self.gravity, &mut torque)?;
        self.reference.sample(f64::NEG_INFINITY, &mut self.targets);

        let last = self.lengths.last().copied().unwrap_or(self.config.period_s);
        for (index, duration) in [last, self.config.period_s].into_iter().enumerate() {
            let mut stage = LqProblem::new(LqSize { states: 2 * n, inputs: n, stages: 1, rows: 0 });
            let stage = &mut stage.stages[0];
            self.dynamics.linearise(tree, &x, &torque, duration, &x, stage)?;
            for j in 0..n {
                stage.hessian[(j, j)] = self.torque_weight[j] * duration;
            }
            let hessian = stage.hessian.as_mut().submatrix_mut(n, n, 2 * n, 2 * n);
            let gradient = &mut stage.gradient[n..];
            let node = &self.nodes[0];
            self.tasks.quadratise(tree, node, x.split_at(n), &self.targets, duration, (hessian, gradient));
            let solution = solve_dare(stage.transition.as_ref(), stage.hessian.as_ref(), n)?;
            if index == 0 {
                self.terminal_cost.copy_from(&solution.cost_to_go);
            } else {
                self.static_law.gain.copy_from(&solution.gain);
            }
        }
        self.static_law.torque.copy_from_slice(&torque);
        self.static_law.reference.copy_from_slice(&x);
        Ok(())
    }

    /// Sets or clears the reach and computes the posture it ends in. Allocates.
    ///
    /// # Errors
    /// [`ControlError::Model`] when the model has no hand, [`ControlError::Mechanics`] when it does not fit.
    pub fn set_reach(&mut self, reach: Option<Reach>) -> Result<(), ControlError> {
        let Some(reach) = reach else {
            self.reference.reach = None;
            return Ok(());
        };
        if self.model.hand.is_none() {
            return Err(ControlError::Model { reason: "a reach needs a hand point" });
        }
        let ball = Vector3::from(reach.ball_m);
        let goal = reach_posture(&self.model, &self.reference.home, &ball, &self.config.weights)?;
        self.reference.reach = Some((reach, goal));
        Ok(())
    }

    /// Sets the plant time that counts as zero of the run; otherwise it is that of the first state.
    pub fn set_origin_ns(&mut self, origin_ns: u64) {
        self.origin_ns = Some(origin_ns);
    }

    /// Where the robot aims.
    pub fn reference(&self) -> &Reference {
        &self.reference
    }

    /// The plan of the last solved cycle.
    pub fn plan(&self) -> Option<&Plan> {
        self.has_plan.then_some(&self.plan)
    }

    /// Gain of the stage of the last factorisation.
    pub fn gain(&self, stage: usize) -> MatRef<'_, f64> {
        self.riccati.gain(stage)
    }

    /// The LQ problem of the last cycle.
    pub fn problem(&self) -> &LqProblem {
        &self.problem
    }

    /// State `(q, q̇)` predicted for the time the last command takes effect.
    pub fn predicted_state(&self) -> &[f64] {
        &self.predicted
    }

    /// Estimate from the last good measurement.
    pub fn estimate(&self) -> &Estimate {
        self.estimator.estimate()
    }

    /// Root mean square of the last innovation of the joint rates, rad/s.
    pub fn innovation_rate(&self) -> f64 {
        self.innovation_rate
    }

    /// The model.
    pub fn model(&self) -> &ControllerModel {
        &self.model
    }

    fn run_time_s(&self, time_ns: u64) -> f64 {
        let origin = self.origin_ns.unwrap_or(time_ns);
        if time_ns >= origin { (time_ns - origin) as f64 * 1e-9 } else { -((origin - time_ns) as f64 * 1e-9) }
    }
}

const LEVELS: [FallbackLevel; 6] = [
    FallbackLevel::FreshSolution,
    FallbackLevel::ShiftedPlan,
    FallbackLevel::StaticLqr,
    FallbackLevel::GravityHold,
    FallbackLevel::DampingOnly,
    FallbackLevel::ZeroTorque,
];

/// Torque limits as bounds on the deviation from the nominal torque.
fn bound_inputs(model: &ControllerModel, fraction: f64, nominal: &[f64], stage: &mut LqStage) {
    for (j, limit) in model.limits.iter().enumerate() {
        stage.input.upper[j] = fraction * limit.effort - nominal[j];
        stage.input.lower[j] = -fraction * limit.effort - nominal[j];
    }
}

/// Position and velocity limits as bounds on the deviation from a nominal state.
fn bound_state(model: &ControllerModel, nominal: &[f64], bounds: &mut crate::lq_problem::BoxBounds) {
    let n = model.limits.len();
    for (j, limit) in model.limits.iter().enumerate() {
        bounds.lower[j] = limit.lower - nominal[j];
        bounds.upper[j] = limit.upper - nominal[j];
        bounds.lower[n + j] = -limit.velocity - nominal[n + j];
        bounds.upper[n + j] = limit.velocity - nominal[n + j];
    }
}

fn to_ns(seconds: f64) -> u64 {
    libm::round(seconds * 1e9) as u64
}
