//! One control cycle: state in, command out, always.
//!
//! ```text
//! prepare    shift the nominal -> linearise every stage -> Riccati -> rows that were active
//! feed back  take the state in -> constrained QP -> command
//! ```
//!
//! Nothing of the preparation needs the measurement: the nominal is the last plan, and the measured state enters as the first
//! deviation. So [`Controller::prepare`] may be called while the next state is waited for, and [`Controller::cycle`] is then the
//! short rest; without it the cycle does both.
//!
//! Whatever fails, a command goes out: from the best rung of the ladder ([`crate::fallback`]) that can be formed, and the report
//! says what happened. Time is an argument; figures of time come from a [`Clock`] of the caller.
//!
//! Source: M. Diehl, H. G. Bock, J. P. Schlöder, *A real-time iteration scheme for nonlinear optimization in optimal feedback
//! control*, SIAM J. Control Optim. 43, 2005: one linearisation and one QP per cycle, warm-started by the shifted solution.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::inverse_dynamics::InverseDynamicsWorkspace;
use delmpc_messages::{Command, CycleReport, FallbackLevel, MAX_RATE_SAMPLES, PlantState, Verdict};
use faer::MatRef;
use nalgebra::Vector3;

use crate::balance_trim::BalanceTrim;
use crate::config::{ControllerConfig, ControllerKind};
use crate::errors::ControlError;
use crate::estimator::{Estimate, Estimator};
use crate::fallback::{Attempt, FallbackLadder, Situation};
use crate::feedback_law::{Law, LawHistory};
use crate::horizon_problem::HorizonProblem;
use crate::model::ControllerModel;
use crate::node_kinematics::NodeKinematics;
use crate::plan::Plan;
use crate::posture_goal::posture_goal;
use crate::prediction::Prediction;
use crate::reference::{Reach, Reference};
use crate::stop_watch::StopWatch;
pub use crate::stop_watch::{Clock, StoppedClock};
use crate::tasks::TaskTargets;
use crate::telling::tell_constraints;
use crate::unloaded_robot::UnloadedRobot;
use delmpc_horizon::foot_cone::{FlatFoot, WrenchCone};
use delmpc_lq::dual_qp::QpSolver;
use delmpc_lq::kernels::all_finite;
use delmpc_lq::lq_problem::LqProblem;
use delmpc_lq::projected_qp::{ProjectedQp, ProjectedQpReport, default_backend};
use delmpc_lq::riccati::Riccati;
use delmpc_lq::trajectory::Trajectory;

mod goal;
mod law_of_level;
pub mod reason;
mod views;

/// So many states in a row that are older than the newest one are right, and the newest one was wrong.
const OLDER_STATES: u32 = 5;

/// Torques and contact forces of a plan may be beyond their limits by this part of their scale in the stages a command covers ...
const UNMET_NEAR: f64 = 0.05;
/// ... and by this later, where there is time for a better plan.
const UNMET_FAR: f64 = 0.5;
/// A plan that moves a node by more than this (rad, m) is not believed.
const LARGEST_MOVE: f64 = 2.0;
/// How much later than the nominal's start a state may be, in horizons: what comes after the cycle that was held up is fresh again.
const LATEST_HORIZONS: f64 = 0.5;
/// How much earlier than it was prepared for a state may be, in periods: the last command covers the time in between.
const EARLIEST_PERIODS: f64 = 2.0;
/// Cycles in a row with a large innovation before [`Verdict::ModelMismatch`].
const MISMATCH_CYCLES: u32 = 5;
/// Part of a new difference between planned and measured force that counts at once.
const FORCE_SMOOTHING: f64 = 0.5;
/// Time over which the servo takes the mean of velocities, s.
const RATE_MEAN_S: f64 = 0.004;
/// Distance of any joint from the home posture up to which the static LQR is trusted, rad or m.
const LQR_REACH: f64 = 0.6;

/// The controller: everything it needs for a cycle, allocated once.
#[derive(Debug)]
pub struct Controller {
    model: ControllerModel,
    config: ControllerConfig,

    estimator: Estimator,
    unloaded_robot: Option<UnloadedRobot>,
    ladder: FallbackLadder,
    reference: Reference,
    /// The reach as it was asked for, and how far from its goal the hand ends, m.
    asked_reach: Option<Reach>,
    hand_distance_left_m: f64,
    trim: BalanceTrim,
    targets: TaskTargets,

    gravity: InverseDynamicsWorkspace,
    node: NodeKinematics,

    horizon: HorizonProblem,
    riccati: Riccati,
    qp: ProjectedQp,
    backend: Box<dyn QpSolver + Send>,
    solution: Trajectory,
    /// The last plan, and the one under construction.
    plan: Plan,
    nominal: Plan,
    has_plan: bool,
    /// Whether `nominal`, `horizon` and `riccati` are those of a solution to come, and what that took.
    prepared: Option<Preparation>,
    /// When the last cycle began, by the caller's clock, ns.
    cycle_began_ns: u64,
    /// How long the last preparations took, the latest one first, ns.
    preparations_ns: [u64; 3],
    /// Time of the first node the present factors belong to, s of the run.
    factors_start_s: f64,

    prediction: Prediction,
    /// State predicted for the time of the command.
    predicted: Vec<f64>,
    predicted_for_s: f64,
    has_prediction: bool,
    surprising_cycles: u32,
    innovation_rate: f64,
    scratch: Vec<f64>,
    /// Force on the stance foot in the first stage of the last plan, N.
    planned_force: Option<Vector3<f64>>,
    /// By how much the measured one differs, N.
    force_change: Vector3<f64>,

    static_law: Law,
    /// What the pressure point left of the torque in the last fresh plan: torque, lower and upper bounds.
    last_bounds: [Vec<f64>; 3],
    /// The law in the last command, and those before.
    law: Law,
    past_laws: LawHistory,
    command: Command,
    blank_report: CycleReport,

    origin_ns: Option<u64>,
    last_state_ns: Option<u64>,
    /// States in a row that were older than the newest one.
    older_states: u32,
    last_sequence: u64,
}

/// Times of a finished preparation, ns.
#[derive(Clone, Copy, Debug)]
struct Preparation {
    shift_ns: u64,
    linearize_ns: u64,
    riccati_ns: u64,
}

impl Controller {
    /// Checks model and configuration, solves the infinite-horizon problem at the home posture, takes all memory.
    ///
    /// # Errors
    /// [`ControlError`]: the first thing found wrong, with index and rule.
    pub fn new(model: ControllerModel, config: ControllerConfig) -> Result<Self, ControlError> {
        let backend = default_backend(config.qp.capacity)
            .map_err(|_| ControlError::Model { reason: "the QP solver refused its set-up" })?;
        Self::with_backend(model, config, backend)
    }

    /// The same with a QP solver of the caller's.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_backend(
        model: ControllerModel,
        config: ControllerConfig,
        backend: Box<dyn QpSolver + Send>,
    ) -> Result<Self, ControlError> {
        model.check()?;
        config.check()?;
        let tree = &model.tree;
        let n = tree.dof();
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
        let horizon = HorizonProblem::new(&model, &config, cone.as_ref())?;
        let size = horizon.problem.size();
        let home = posture_goal(&model, &model.posture)?;
        let mut command = Command::new(0, model.joint_set_hash, n as u32);
        command.fallback_level = FallbackLevel::ZeroTorque as u32;
        let samples = libm::round(RATE_MEAN_S / config.servo_period_s) as usize;
        command.rate_samples = samples.clamp(1, MAX_RATE_SAMPLES) as u32;
        let plan = Plan::new(Trajectory::new(size), &config.stage_lengths());
        let unloaded_robot = match &model.sensing {
            Some(sensing) => {
                Some(UnloadedRobot::new(tree, sensing.stance_foot, &model.posture, config.servo_period_s)?)
            }
            None => None,
        };
        let mut controller = Self {
            estimator: Estimator::new(&model)?,
            unloaded_robot,
            ladder: FallbackLadder::new(config.fallback),
            reference: Reference::at(home),
            asked_reach: None,
            hand_distance_left_m: 0.0,
            trim: BalanceTrim::new(config.trim_s),
            targets: TaskTargets::new(n),
            gravity: InverseDynamicsWorkspace::new(tree),
            node: NodeKinematics::new(tree),
            horizon,
            riccati: Riccati::new(size),
            qp: ProjectedQp::new(size, config.qp),
            backend,
            solution: Trajectory::new(size),
            nominal: plan.clone(),
            plan,
            has_plan: false,
            prepared: None,
            cycle_began_ns: 0,
            preparations_ns: [0; 3],
            factors_start_s: 0.0,
            prediction: Prediction::new(tree, config.servo_period_s, command.rate_samples),
            predicted: vec![0.0; 2 * n],
            predicted_for_s: 0.0,
            has_prediction: false,
            surprising_cycles: 0,
            innovation_rate: 0.0,
            scratch: vec![0.0; 2 * n],
            planned_force: None,
            force_change: Vector3::zeros(),
            static_law: Law::new(n),
            last_bounds: [vec![0.0; n], vec![f64::NEG_INFINITY; n], vec![f64::INFINITY; n]],
            law: Law::new(n),
            past_laws: LawHistory::new(n, config.delay_s, config.period_s),
            blank_report: command.report,
            command,
            origin_ns: None,
            last_state_ns: None,
            older_states: 0,
            last_sequence: 0,
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
        self.cycle_began_ns = begin;
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

        let spent_ns = clock.now_ns().saturating_sub(begin);
        let total_ns = self.command.report.total_ns.saturating_add(spent_ns);
        self.command.report.total_ns = total_ns;
        let late = total_ns as f64 * 1e-9 > self.config.budget_s;
        if late && self.command.verdict == Verdict::Ok as u32 {
            self.command.verdict = Verdict::Late as u32;
        }
        &self.command
    }

    /// The command of the last cycle.
    pub fn command(&self) -> &Command {
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
        let prepared = match self.prepared.take() {
            Some(ahead) if start_s == self.nominal.start_s => {
                // Counts too: the machine has to do it once a period.
                self.command.report.total_ns = ahead.shift_ns + ahead.linearize_ns + ahead.riccati_ns;
                ahead
            }
            _ => self.prepare_for(start_s, &mut watch)?,
        };
        self.command.report.shift_ns = prepared.shift_ns;
        self.command.report.linearize_ns = prepared.linearize_ns;
        self.command.report.riccati_ns = prepared.riccati_ns;
        let solved = self.solve_constrained();
        self.command.report.qp_ns = watch.lap();
        tell_constraints(&solved?, &mut self.command);
        self.check_followable()?;
        self.adopt_plan()?;
        Ok(())
    }

    /// Makes ready for the next measurement, all that does not need it. To be called while waiting, with the clock of [`Self::cycle`].
    ///
    /// The next measurement is the one at the first whole period after the last that can still be met: on a machine that is too slow
    /// for the period, a problem that is always late would be thrown away and made again every time.
    ///
    /// Does nothing before the first good cycle. If it fails, or the measurement is of quite another time, the next cycle does the work.
    pub fn prepare(&mut self, clock: &dyn Clock) {
        self.prepared = None;
        if self.config.kind != ControllerKind::Mpc || !self.has_plan {
            return;
        }
        let Some(last_ns) = self.last_state_ns else { return };
        let begin_ns = clock.now_ns();
        // One that was held up says nothing about the next one.
        let usual_ns = self.preparations_ns.iter().copied().fold(u64::MAX, u64::min);
        let ready_s = begin_ns.saturating_sub(self.cycle_began_ns).saturating_add(usual_ns) as f64 * 1e-9;
        let periods = libm::ceil(ready_s / self.config.period_s).max(1.0);
        let next_ns = last_ns.saturating_add(to_ns(periods * self.config.period_s));
        let start_s = self.run_time_s(next_ns) + self.config.delay_s;
        self.prepared = self.prepare_for(start_s, &mut StopWatch::start(clock)).ok();
        self.preparations_ns.rotate_right(1);
        self.preparations_ns[0] = clock.now_ns().saturating_sub(begin_ns);
    }

    /// Nominal, linearisation, factors and warm rows of the problem that begins at `start_s`.
    fn prepare_for(&mut self, start_s: f64, watch: &mut StopWatch<'_>) -> Result<Preparation, u32> {
        self.shift_nominal(start_s);
        let shift_ns = watch.lap();
        self.horizon.place_sole(&self.estimator.estimate().sole_pose);
        self.horizon
            .linearise(&self.model, &self.config, &self.reference, &self.nominal)
            .map_err(|_| reason::STAGE)?;
        let linearize_ns = watch.lap();
        self.factors_start_s = start_s;
        self.riccati.factorise(&self.horizon.problem).map_err(|_| reason::RICCATI)?;
        self.qp.prepare(&self.horizon.problem, &self.riccati);
        Ok(Preparation { shift_ns, linearize_ns, riccati_ns: watch.lap() })
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
            self.older_states += 1;
            if self.older_states < OLDER_STATES {
                return Err(reason::OUT_OF_ORDER);
            }
            // It was the newest one whose time was wrong.
            (self.last_state_ns, self.has_plan, self.has_prediction) = (None, false, false);
            self.prepared = None;
        }
        self.older_states = 0;
        self.estimator.update(&self.model, state).map_err(|_| reason::ESTIMATOR)?;
        self.origin_ns.get_or_insert(state.time_ns);
        let since_last_s = self.last_state_ns.map_or(0.0, |last| (state.time_ns - last) as f64 * 1e-9);
        self.last_state_ns = Some(state.time_ns);
        self.last_sequence = state.header.sequence;

        let wrench = self.estimator.estimate().stance_wrench;
        let change = self.planned_force.zip(wrench).map(|(planned, wrench)| wrench.force - planned);
        let change = change.unwrap_or_default();
        self.force_change += FORCE_SMOOTHING * (change - self.force_change);

        let measured_s = self.run_time_s(state.time_ns);
        let sole_pose = self.estimator.estimate().sole_pose;
        self.reference.stand_on(&sole_pose, &Vector3::zeros());
        self.reference.sample(measured_s, &mut self.targets);
        if let Some(wrench) = wrench {
            let rates = &self.estimator.estimate().q_dot;
            self.trim.update(&self.targets.com, &wrench.torque, &wrench.force, rates, since_last_s);
        }
        self.reference.stand_on(&sole_pose, &self.trim.shift());
        self.test_innovation(measured_s);
        let Estimate { q, q_dot, .. } = self.estimator.estimate();
        self.predicted[..n].copy_from_slice(q);
        self.predicted[n..].copy_from_slice(q_dot);
        let mut start_s = (measured_s + self.config.delay_s).max(self.run_time_s(now_ns));
        let ahead_s = self.nominal.start_s;
        // A tick that was missed makes the state later than prepared for, but what was prepared is still good for a plan; so it is for one
        // that begins a little later than it could. Doing all of it again would miss the next tick too.
        let earliest_s = measured_s - LATEST_HORIZONS * self.nominal.horizon_s();
        let latest_s = start_s + EARLIEST_PERIODS * self.config.period_s;
        if self.prepared.is_some() && (earliest_s - 1e-9..=latest_s + 1e-9).contains(&ahead_s) {
            start_s = ahead_s;
        }
        self.has_prediction = start_s >= measured_s - 1e-9;
        if self.has_prediction {
            self.predict(measured_s, start_s - measured_s).map_err(|()| reason::PREDICTION)?;
        } else {
            self.carry_back(measured_s);
        }
        self.predicted_for_s = start_s;
        Ok(start_s)
    }

    /// Moves `predicted` back to the start of the nominal: the deviation from it then is taken to be the one measured now.
    fn carry_back(&mut self, measured_s: f64) {
        let passed = &mut self.scratch[..self.predicted.len()];
        self.nominal.state_at(measured_s, passed);
        for ((x, passed), first) in self.predicted.iter_mut().zip(passed).zip(self.nominal.values.x(0)) {
            *x += first - *passed;
        }
    }

    /// Moves `predicted` forward under the laws of the last commands.
    fn predict(&mut self, measured_s: f64, duration_s: f64) -> Result<(), ()> {
        if duration_s <= 0.0 || self.command.state_sequence == 0 {
            return Ok(());
        }
        let Self { prediction, model, past_laws, predicted, .. } = self;
        prediction.advance(&model.tree, past_laws, measured_s, duration_s, predicted).map_err(|_| ())?;
        if all_finite(predicted) { Ok(()) } else { Err(()) }
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
        for k in 0..=self.nominal.values.stages() {
            self.reference.sample(start_s + self.nominal.offsets()[k], &mut self.targets);
            let x = self.nominal.values.x_mut(k);
            x[..n].copy_from_slice(&self.targets.posture);
            x[n..].copy_from_slice(&self.targets.posture_rate);
            if k < self.nominal.values.stages() {
                let u = self.nominal.values.u_mut(k);
                u.copy_from_slice(&self.static_law.first().torque);
            }
        }
    }

    fn solve_constrained(&mut self) -> Result<ProjectedQpReport, u32> {
        let deviations = self.predicted.iter().zip(self.nominal.values.x(0));
        for (d, (x, node)) in self.solution.x_mut(0).iter_mut().zip(deviations) {
            *d = x - node;
        }
        let problem = &self.horizon.problem;
        let solved = self.qp.solve(problem, &self.riccati, self.backend.as_mut(), &mut self.solution);
        solved.map_err(|_| reason::QP)
    }

    /// A solution that leaves torque limits or contact rows out is none: sent to the robot, it would throw it.
    fn check_followable(&self) -> Result<(), u32> {
        let offsets = self.nominal.offsets();
        let followable = (0..self.solution.stages()).all(|k| {
            let allowed = if offsets[k] < self.config.command_life_s { UNMET_NEAR } else { UNMET_FAR };
            self.qp.unmet(k) <= allowed
        });
        if followable { Ok(()) } else { Err(reason::QP) }
    }

    /// The solution becomes the plan, unless it is out of reach of the linearisation.
    fn adopt_plan(&mut self) -> Result<(), u32> {
        let n = self.model.tree.dof();
        let largest = |k: usize| delmpc_lq::kernels::largest(&self.solution.x(k)[..n]);
        if (0..=self.solution.stages()).any(|k| largest(k) > LARGEST_MOVE) {
            return Err(reason::FAR);
        }
        self.planned_force = self.horizon.force(0, &self.solution);
        self.nominal.add(&self.solution);
        core::mem::swap(&mut self.plan, &mut self.nominal);
        self.has_plan = true;
        Ok(())
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

    /// Sets the plant time that counts as zero of the run; otherwise it is that of the first state.
    pub fn set_origin_ns(&mut self, origin_ns: u64) {
        self.origin_ns = Some(origin_ns);
    }

    /// Plant time of a time of the run.
    fn run_time_ns(&self, time_s: f64) -> u64 {
        self.origin_ns.unwrap_or(0).saturating_add_signed(libm::round(time_s * 1e9) as i64)
    }

    fn run_time_s(&self, time_ns: u64) -> f64 {
        let origin = self.origin_ns.unwrap_or(time_ns);
        if time_ns >= origin { (time_ns - origin) as f64 * 1e-9 } else { -((origin - time_ns) as f64 * 1e-9) }
    }
}

fn to_ns(seconds: f64) -> u64 {
    libm::round(seconds * 1e9) as u64
}
