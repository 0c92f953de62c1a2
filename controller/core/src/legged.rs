//! The control cycle of a robot on any set of feet: stand, gait, steps.
//!
//! ```text
//! PlantState -> base and feet -> schedule (switches as felt, strides ahead) -> grid cut at the switches -> aims
//!            -> the last plan on that grid -> every stage linearised with its contacts -> Riccati -> projected QP -> Command
//! ```
//!
//! The robot is the floating tree; its feet are contacts that come and go ([`delmpc_horizon`]). One linear-quadratic solution a cycle,
//! about the last plan read where the new grid has its boundaries; the first boundary is the state predicted for when the command takes
//! effect. The servo gets the part of the first gain on the joints: over a cycle the base changes little, and its part is in the plan.
//!
//! Like [`crate::cycle::Controller`], it always answers; the levels are those of [`crate::fallback`], without the static LQR.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use delmpc_horizon::base_path::BasePath;
use delmpc_horizon::contact_schedule::{ContactSchedule, Foothold};
use delmpc_horizon::gait::GaitWalk;
use delmpc_horizon::ground_plane::GroundPlane;
use delmpc_horizon::legged_model::FootShape;
use delmpc_horizon::legged_problem::LeggedProblem;
use delmpc_horizon::motion_plan::MotionPlan;
use delmpc_horizon::motion_reference::MotionReference;
use delmpc_horizon::retiming::Retiming;
use delmpc_horizon::stage_grid::StageGrid;
use delmpc_horizon::step_plan::{lay_out, mass_centre_over};
use delmpc_lq::dual_qp::QpSolver;
use delmpc_lq::kernels::largest;
use delmpc_lq::projected_qp::{ProjectedQp, default_backend};
use delmpc_lq::riccati::Riccati;
use delmpc_lq::trajectory::Trajectory;
use delmpc_mechanics::contact_stage::BoundaryState;
use delmpc_messages::{
    Command, CycleReport, FallbackLevel, MAX_JOINTS, MAX_RATE_SAMPLES, PlantState, Verdict, sensor,
};
use nalgebra::{Vector2, Vector3};

use crate::config::ControllerKind;
use crate::cycle::reason;
use crate::errors::ControlError;
use crate::fallback::{Attempt, FallbackLadder, Situation};
use crate::feedback_law::Law;
use crate::stop_watch::{Clock, StopWatch};
use crate::telling::tell_constraints;

mod base_feedback;
mod config;
mod law;
mod light_feet;
mod prediction;
mod sensing;

use base_feedback::BaseFeedback;
pub use config::{GaitCommand, LeggedConfig, LeggedRobot, Motion};
use light_feet::LightFeet;
use prediction::StatePrediction;
use sensing::LeggedSensing;

/// A plan that moves a boundary by more than this (rad, m) is not believed.
const LARGEST_MOVE: f64 = 1.0;
/// Stances of a foot there is room for: those of a horizon, and the steps of a walk.
const STANCES: usize = 64;
/// Depths of a crouch that are tried, up to this part of the height of the mass centre.
const CROUCHES: usize = 12;
const DEEPEST_CROUCH: f64 = 0.12;
/// An error of a foot (m, rad) counts as so much room of a joint (rad).
const UNREACHED: f64 = 100.0;
/// States in a row that are older than the newest one are right, and the newest one was wrong.
const OLDER_STATES: u32 = 5;

/// The controller: everything it needs for a cycle. Memory is taken in [`LeggedController::new`], and in the first good cycle, which
/// places feet and steps where the robot has been measured.
#[derive(Debug)]
pub struct LeggedController {
    robot: LeggedRobot,
    config: LeggedConfig,
    sensing: LeggedSensing,
    ladder: FallbackLadder,
    schedule: ContactSchedule,
    grid: StageGrid,
    reference: MotionReference,
    walk: Option<GaitWalk>,
    retiming: Retiming,
    ground: GroundPlane,
    /// Whether a foot is flat.
    flat: Vec<bool>,
    /// Height of the mass centre above the planned ground, m.
    height_m: f64,
    /// Whether schedule and reference are those of a measured robot.
    placed: bool,
    problem: LeggedProblem,
    riccati: Riccati,
    qp: ProjectedQp,
    backend: Box<dyn QpSolver + Send>,
    solution: Trajectory,
    plan: MotionPlan,
    nominal: MotionPlan,
    has_plan: bool,
    /// The last plan is out of reach: the next problem is one about the aim.
    is_astray: bool,
    prediction: StatePrediction,
    measured: BoundaryState,
    predicted: BoundaryState,
    scratch: BoundaryState,
    later: BoundaryState,
    /// Local coordinates of a state.
    way: Vec<f64>,
    law: Law,
    base_feedback: BaseFeedback,
    light_feet: LightFeet,
    command: Command,
    blank_report: CycleReport,
    origin_ns: u64,
    last_state_ns: Option<u64>,
    /// Sum of the gyroscope at that state.
    imu_angle: Option<Vector3<f64>>,
    older_states: u32,
    last_sequence: u64,
}

impl LeggedController {
    /// Checks robot and configuration, takes all memory.
    ///
    /// # Errors
    /// [`ControlError`]: the first thing found wrong.
    pub fn new(robot: LeggedRobot, config: LeggedConfig) -> Result<Self, ControlError> {
        let model = &robot.model;
        let joints = model.tree.joint_count();
        if joints > MAX_JOINTS {
            return Err(ControlError::Model { reason: "a message has no room for this number of joints" });
        }
        if config.stage_lengths.iter().any(|length| !(*length > 0.0 && *length <= 0.2)) {
            let (quantity, rule) = ("stage length", "must be positive and at most 0.2 s");
            return Err(ControlError::Value { quantity, index: 0, value: f64::NAN, rule });
        }
        let grid = StageGrid::new(config.stage_lengths.clone());
        let problem = LeggedProblem::new(model, grid.stages(), config.weights.clone(), &config.limits)?;
        let places = sensing::home_places(model)?;
        let reference = MotionReference::new(model, grid.stages(), config.swing, &places)?;
        let schedule = ContactSchedule::standing(&places, STANCES);
        let flat: Vec<bool> = model.feet.iter().map(FootShape::is_flat).collect();
        let size = problem.problem.size();
        let plan = MotionPlan::new(&model.tree, grid.stages(), problem.contact_rows());
        let mut command = Command::new(0, robot.joint_set_hash, joints as u32);
        command.fallback_level = FallbackLevel::ZeroTorque as u32;
        let samples = libm::round(config.rate_mean_s / config.servo_period_s) as usize;
        command.rate_samples = samples.clamp(1, MAX_RATE_SAMPLES) as u32;
        let (imu_body, imu) = (robot.estimator.imu_body, &robot.estimator.imu_mounting);
        let base_feedback = BaseFeedback::new(&model.tree, imu_body, imu.rotation);
        Ok(Self {
            sensing: LeggedSensing::new(&robot)?,
            ladder: FallbackLadder::new(config.fallback),
            retiming: Retiming::new(&flat),
            ground: GroundPlane::new(&places, &flat),
            flat,
            height_m: reference.aim().height_m,
            schedule,
            walk: None,
            placed: false,
            riccati: Riccati::new(size),
            qp: ProjectedQp::new(size, config.qp),
            backend: default_backend(config.qp.capacity)
                .map_err(|_| ControlError::Model { reason: "the QP solver refused its set-up" })?,
            solution: Trajectory::new(size),
            nominal: plan.clone(),
            plan,
            has_plan: false,
            is_astray: false,
            prediction: StatePrediction::new(model)?,
            measured: model.posture.clone(),
            predicted: model.posture.clone(),
            scratch: model.posture.clone(),
            later: model.posture.clone(),
            way: vec![0.0; 2 * model.tree.dof()],
            law: Law::new(joints),
            base_feedback,
            light_feet: LightFeet::new(model, config.servo_period_s)?,
            blank_report: command.report,
            command,
            origin_ns: 0,
            last_state_ns: None,
            imu_angle: None,
            older_states: 0,
            last_sequence: 0,
            grid,
            reference,
            problem,
            robot,
            config,
        })
    }

    /// One cycle; as [`crate::cycle::Controller::cycle`].
    pub fn cycle(&mut self, state: &PlantState, now_ns: u64, clock: &dyn Clock) -> &Command {
        let begin = clock.now_ns();
        self.command.report = self.blank_report;
        self.command.reason = 0;
        self.command.verdict = Verdict::Ok as u32;
        let outcome = match self.attempt(state, now_ns, clock) {
            Ok(()) => Attempt::Solved,
            Err(reason) => {
                self.command.reason = reason;
                if reason < reason::PREDICTION { Attempt::NoState } else { Attempt::NoSolution }
            }
        };
        match outcome {
            Attempt::Solved => {}
            Attempt::NoState => self.command.verdict = Verdict::BadState as u32,
            Attempt::NoSolution => self.command.verdict = Verdict::Infeasible as u32,
        }
        let now_s = self.run_time_s(now_ns);
        let level = self.ladder.advance(&Situation {
            attempt: outcome,
            plan_age_s: self.has_plan.then_some(now_s - self.plan.start_s()),
            near_posture: false,
            blind_s: self.last_state_ns.map_or(0.0, |last| now_s - self.run_time_s(last)),
        });
        self.write_command(level, state, now_ns);
        let spent_ns = clock.now_ns().saturating_sub(begin);
        self.command.report.total_ns = spent_ns;
        if spent_ns as f64 * 1e-9 > self.config.budget_s && self.command.verdict == Verdict::Ok as u32 {
            self.command.verdict = Verdict::Late as u32;
        }
        &self.command
    }

    /// The steps of a cycle; an error is a reason code.
    fn attempt(&mut self, state: &PlantState, now_ns: u64, clock: &dyn Clock) -> Result<(), u32> {
        let mut watch = StopWatch::start(clock);
        let measured_s = self.take_state(state, now_ns)?;
        self.command.report.state_in_ns = watch.lap();
        if self.config.kind != ControllerKind::Mpc {
            return Ok(());
        }
        let start_s = (measured_s + self.config.delay_s).max(self.run_time_s(now_ns));
        self.look_ahead(measured_s, start_s)?;
        self.command.report.shift_ns = watch.lap();
        let Self { problem, robot, grid, schedule, reference, nominal, .. } = self;
        problem.linearise(&robot.model, grid, schedule, reference, nominal).map_err(|_| reason::STAGE)?;
        self.command.report.linearize_ns = watch.lap();
        self.riccati.factorise(&self.problem.problem).map_err(|_| reason::RICCATI)?;
        self.qp.prepare(&self.problem.problem, &self.riccati);
        self.command.report.riccati_ns = watch.lap();
        self.solution.x_mut(0).fill(0.0);
        let problem = &self.problem.problem;
        let solved = self.qp.solve(problem, &self.riccati, self.backend.as_mut(), &mut self.solution);
        self.command.report.qp_ns = watch.lap();
        let report = solved.map_err(|_| reason::QP)?;
        self.adopt_plan()?;
        tell_constraints(&report, &mut self.command);
        Ok(())
    }

    /// Validates the measurement and lets the estimator have it; returns its time, s of the run.
    fn take_state(&mut self, state: &PlantState, now_ns: u64) -> Result<f64, u32> {
        let joints = self.robot.model.tree.joint_count();
        state.validate(self.robot.joint_set_hash, joints).map_err(|error| error.code())?;
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
            (self.last_state_ns, self.has_plan) = (None, false);
        }
        self.older_states = 0;
        self.sensing.update(&self.robot.model, state).map_err(|_| reason::ESTIMATOR)?;
        self.last_state_ns = Some(state.time_ns);
        self.last_sequence = state.header.sequence;
        let sums = state.has_sensor(sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS);
        self.imu_angle = sums.then(|| state.imu_angle.into());
        if !self.placed {
            self.place(self.run_time_s(state.time_ns)).map_err(|_| reason::ESTIMATOR)?;
        }
        Ok(self.run_time_s(state.time_ns))
    }

    /// Schedule and aims of a robot that stands where it has been measured.
    fn place(&mut self, measured_s: f64) -> Result<(), ControlError> {
        let model = &self.robot.model;
        let places: Vec<Foothold> = self.sensing.feet().iter().map(|foot| foot.place).collect();
        self.schedule = ContactSchedule::standing(&places, STANCES);
        self.reference = MotionReference::new(model, self.grid.stages(), self.config.swing, &places)?;
        self.sensing.settle(model, &self.schedule, measured_s, &mut self.measured)?;
        self.reference.begin_at(model, &self.measured, measured_s)?;
        let aim = self.reference.aim_mut();
        match &self.config.motion {
            Motion::Stand => {}
            Motion::Gait(command) => {
                aim.path = BasePath {
                    velocity: Vector2::from(command.velocity),
                    yaw_rate: command.yaw_rate,
                    start_s: command.start_s,
                    stop_s: command.stop_s,
                    ramp_s: command.ramp_s,
                    ..aim.path
                };
                self.walk = Some(GaitWalk::new(command.gait.clone(), aim.path, &places));
            }
            Motion::Planned(base, steps) => {
                if !lay_out(steps, &mut self.schedule) {
                    return Err(ControlError::Model {
                        reason: "the planned steps do not fit one after the other",
                    });
                }
                aim.planned = Some(base.clone());
            }
            Motion::Steps(steps) => {
                if !lay_out(steps, &mut self.schedule) {
                    return Err(ControlError::Model { reason: "the steps do not fit one after the other" });
                }
                let first_s = steps.first().map_or(0.0, |step| step.lift_s);
                aim.crouched_s = first_s;
                let ground = places.iter().map(|place| place.position_w.z).sum::<f64>() / places.len() as f64;
                let (height, gravity) = (aim.height_m - ground, model.tree.gravity_w().norm());
                aim.mass_centre = Some(mass_centre_over(steps, &places, aim.path.origin, height, gravity));
            }
        }
        self.ground = GroundPlane::new(&places, &self.flat);
        if matches!(self.config.motion, Motion::Steps(_)) {
            self.crouch(measured_s)?;
        }
        let aim = self.reference.aim();
        self.height_m = aim.height_m - self.ground.offset_m(&aim.path.origin);
        self.placed = true;
        Ok(())
    }

    /// Lowers the mass centre by what is asked, or by what leaves the joints of the legs the most room at all lift-offs and touchdowns: high up a leg
    /// has to stretch, low down an ankle has to bend.
    fn crouch(&mut self, measured_s: f64) -> Result<(), ControlError> {
        let model = &self.robot.model;
        if self.config.crouch_m > 0.0 {
            self.reference.aim_mut().crouch_m = self.config.crouch_m;
            return Ok(());
        }
        let mut schedule = self.schedule.clone();
        schedule.map_later(measured_s, |place| self.ground.on_ground(place));
        let height_m = self.reference.aim().height_m;
        let home = self.reference.target(0).state.q.clone();
        let mut best = (f64::NEG_INFINITY, 0.0);
        for part in 0..=CROUCHES {
            let crouch_m = DEEPEST_CROUCH * height_m * part as f64 / CROUCHES as f64;
            self.reference.aim_mut().crouch_m = crouch_m;
            let mut room = f64::INFINITY;
            for time_s in schedule.switches() {
                let (error, margin) = self.reference.reach(model, &schedule, time_s)?;
                room = room.min(margin - UNREACHED * error);
            }
            self.reference.restore_joints(&home);
            if room > best.0 {
                best = (room, crouch_m);
            }
        }
        self.reference.aim_mut().crouch_m = best.1;
        Ok(())
    }

    /// Switches, grid, aims and nominal of a horizon that begins at `start_s`.
    fn look_ahead(&mut self, measured_s: f64, start_s: f64) -> Result<(), u32> {
        let Self { schedule, grid, reference, walk, sensing, robot, ground, .. } = self;
        let model = &robot.model;
        let times = (self.config.period_s, start_s - measured_s);
        self.retiming.update(schedule, sensing.feet(), measured_s, times);
        ground.update(schedule, sensing.feet(), measured_s, self.config.period_s);
        let aim = reference.aim_mut();
        let [place, ..] = aim.mass_centre_at(measured_s);
        aim.height_m = self.height_m + ground.offset_m(&place.xy());
        aim.lean(place.xy(), *ground.gradient());
        schedule.forget_before(measured_s - 1.0);
        if let Some(walk) = walk {
            let horizon_s: f64 = self.config.stage_lengths.iter().sum();
            walk.extend(schedule, start_s + 1.5 * horizon_s);
        }
        grid.cut(start_s, |time_s| schedule.next_switch(time_s));
        reference.update(model, grid, schedule).map_err(|_| reason::STAGE)?;
        sensing.settle(model, schedule, measured_s, &mut self.measured).map_err(|_| reason::ESTIMATOR)?;
        let usable = self.has_plan
            && start_s >= self.plan.start_s() - 1e-9
            && start_s < self.plan.end_s() - self.config.period_s;
        self.has_plan = usable;
        self.predict(measured_s, start_s).map_err(|_| reason::PREDICTION)?;
        self.resample();
        Ok(())
    }

    /// Moves the measured state on to when the command takes effect.
    fn predict(&mut self, measured_s: f64, start_s: f64) -> Result<(), ControlError> {
        self.predicted.copy_from(&self.measured);
        if !self.has_plan || start_s - measured_s < 1e-6 {
            return Ok(());
        }
        let Self { prediction, robot, plan, law, base_feedback, schedule, measured, predicted, .. } = self;
        let feedback = (&*law, &*base_feedback);
        prediction.advance(
            &robot.model,
            plan,
            schedule,
            feedback,
            (measured_s, start_s),
            measured,
            predicted,
        )?;
        Ok(())
    }

    /// The last plan on the new grid, its first boundary where the robot will be; what lies beyond it is the aim. Without a plan to
    /// follow, a way from there to the aim.
    fn resample(&mut self) {
        let follows = self.has_plan && !self.is_astray;
        let Self { plan, nominal, grid, reference, problem, predicted, scratch, way, .. } = self;
        let stages = grid.stages();
        nominal.times.copy_from_slice(grid.times());
        for k in 0..=stages {
            let (time_s, target) = (grid.times()[k], reference.target(k));
            let state = &mut nominal.states[k];
            if follows && time_s <= plan.end_s() {
                plan.state_at(time_s, scratch);
                state.copy_from(scratch);
            } else if follows {
                state.copy_from(&target.state);
            } else {
                let part = k as f64 / stages as f64;
                predicted.local(&target.state, way);
                way.iter_mut().for_each(|x| *x *= part * part * (3.0 - 2.0 * part));
                state.copy_from(predicted);
                state.retract(way);
            }
        }
        nominal.states[0].copy_from(predicted);
        let stage = problem.contact_stage();
        for k in 0..stages {
            let (middle, target) = (0.5 * (grid.times()[k] + grid.times()[k + 1]), reference.target(k));
            let known = follows && middle < plan.end_s();
            let of = plan.stage_at(middle);
            let source = if known { plan.input(of) } else { &target.torque };
            nominal.input_mut(k).copy_from_slice(source);
            for foot in 0..stage.contacts().len() {
                let rows = stage.rows_of(foot);
                let carried = known && plan.force(of)[rows.clone()].iter().any(|f| *f != 0.0);
                let source = if carried { plan.force(of) } else { &target.force };
                nominal.force_mut(k)[rows.clone()].copy_from_slice(&source[rows]);
            }
        }
    }

    /// The solution becomes the plan, unless its first part is out of reach of the linearisation; what is so later on is shortened.
    fn adopt_plan(&mut self) -> Result<(), u32> {
        let positions = 6 + self.robot.model.tree.joint_count();
        let stages = self.solution.stages();
        for k in 0..=stages {
            let x = self.solution.x_mut(k);
            let size = largest(&x[..positions]);
            if size > LARGEST_MOVE {
                if k <= stages / 2 {
                    self.is_astray = true;
                    return Err(reason::FAR);
                }
                x.iter_mut().for_each(|x| *x *= LARGEST_MOVE / size);
            }
        }
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        for k in 0..=stages {
            self.nominal.states[k].retract(self.solution.x(k));
        }
        for k in 0..stages {
            let (u, x) = (self.solution.u(k), self.solution.x(k));
            self.nominal.input_mut(k).iter_mut().zip(u).for_each(|(input, u)| *input += u);
            let stage = &self.problem.problem.stages[k];
            for (row, force) in self.nominal.force_mut(k).iter_mut().enumerate() {
                let (by_input, by_state, constant) = stage.output(row);
                *force = constant + dot(by_input, u) + dot(by_state, x);
            }
        }
        core::mem::swap(&mut self.plan, &mut self.nominal);
        (self.has_plan, self.is_astray) = (true, false);
        Ok(())
    }

    /// Sets the plant time that counts as zero of the run.
    pub fn set_origin_ns(&mut self, origin_ns: u64) {
        self.origin_ns = origin_ns;
    }

    /// The command of the last cycle.
    pub fn command(&self) -> &Command {
        &self.command
    }

    /// The plan of the last solved cycle.
    pub fn plan(&self) -> Option<&MotionPlan> {
        self.has_plan.then_some(&self.plan)
    }

    /// Where the feet stand, and will.
    pub fn schedule(&self) -> &ContactSchedule {
        &self.schedule
    }

    /// What the robot aims at.
    pub fn reference(&self) -> &MotionReference {
        &self.reference
    }

    /// State from the last good measurement.
    pub fn measured(&self) -> &BoundaryState {
        &self.measured
    }

    /// State predicted for the time the last command takes effect.
    pub fn predicted(&self) -> &BoundaryState {
        &self.predicted
    }

    /// The robot.
    pub fn robot(&self) -> &LeggedRobot {
        &self.robot
    }

    /// The problem of the last cycle.
    pub fn problem(&self) -> &LeggedProblem {
        &self.problem
    }

    fn run_time_s(&self, time_ns: u64) -> f64 {
        time_ns.abs_diff(self.origin_ns) as f64 * 1e-9 * if time_ns >= self.origin_ns { 1.0 } else { -1.0 }
    }
}

/// No places yet.
pub(crate) fn no_places(count: usize) -> Vec<Foothold> {
    vec![Foothold::level(Default::default(), 0.0); count]
}
