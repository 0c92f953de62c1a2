//! One step of the variational integrator: Newton's method on the DEL equations.
//!
//! | letter | meaning |
//! |---|---|
//! | `q^1..q^s` | unknown nodes of the step (a floating base: chart coordinates `ξ^1..ξ^s`) |
//! | `r` | DEL residual, [`crate::del_residual`] |
//! | `J` | Newton matrix, [`crate::newton_direction`] |
//! | `θ` | contraction: size of a change relative to the one before |
//!
//! **Start.** The interpolation polynomial of the step before is extrapolated, `q^α := Σ_β l_β(1 + c_α) q_prev^β`, when the step
//! continues where the last one ended (a floating base: in the chart of the last step, then moved to the new one). What the last
//! extrapolation missed is added: it changes little from step to step, so that the guess gains an order; and where it has changed
//! steadily, its trend, for another order. Else
//! `q^α = q^0 + c_α Δt M⁻¹p`; if Newton fails from there, `q^α = q^0`.
//!
//! **Iteration.** `J` is factorised once and kept while the iteration contracts (simplified Newton), also over the steps that
//! continue the motion and after a linearisation: it changes by `O(Δt)` from step to step, and a factorisation costs as much as
//! two or three iterations. When old factors take more iterations than new ones are worth, the next step makes new ones; when
//! they do not contract (light links at high accelerations), the next sixteen do. Broyden's update on top of the factors costs a few scalar products and saves about one iteration. `J`
//! is renewed when `θ` exceeds 0.1. A change may be limited to [`StepOptions::change_limit`] in the largest angle, a trust region
//! without a merit function: on a 32-link chain at steps of 40 ms (trapezoidal, random states, `tests/paper`) it raises the share of
//! solved steps from 0.5 to 0.9.
//!
//! **Stop.** On the change, never on the residual: its floor `~10 ε max|a^{αβ} Sᵀμ|` grows with the length of the chain. Done
//! when the next change is predicted below [`StepOptions::accuracy`] times `1 + max|q|`, by default 1e-16: what is left of it accumulates in the momenta over many steps
//! (stopping at 1e-14 left 1e-10 in an exactly conserved momentum after 500 steps). With old factors the prediction is linear in the
//! change, and when round-off hides a contraction, those before it count; with the factors of the guess the second change is as the square of the first, and their ratio in an earlier step, times ten
//! for safety, may end the iteration at the first. Or when the change is below `1e-8` and no longer shrinks: round-off.
//!
//! **End.** `p^1` is row s plus what is left of the residual, which is `p^0` plus all impulses: an error `δq` of the nodes reaches it as
//! `Δt δq` instead of `δq/Δt`.
//!
//! Source: the paper, section 3.2 (there `δq = -J r`; the inverse is missing in print); Broyden's method in the form of
//! C. T. Kelley, *Iterative Methods for Linear and Nonlinear Equations*, SIAM 1995, section 7.3.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use crate::broyden::Broyden;
use crate::del_residual::{DelWorkspace, ForceCapacity};
use crate::dense_lu::DenseNewton;
use crate::errors::{FactorError, ModelError, StepError};
use crate::floating_base::MAX_HALF_ROTATION;
use crate::forces::StepForces;
use crate::inertial_newton::InertialNewton;
use crate::lobatto::LobattoRule;
use crate::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use crate::real::sqrt;
use crate::spatial::{RigidTransform, exp_rotation, log_rotation};
use crate::state::State;
use crate::tree::{JointKind, KinematicTree};
use crate::velocity::VelocityWorkspace;

/// A change below this (times `1 + max|q|`) is converged without prediction.
const SMALL_CHANGE: f64 = 1e-14;
/// Below this the iteration may stop when it no longer shrinks: round-off.
const STAGNATION_CHANGE: f64 = 1e-8;
/// Contraction above which the Newton matrix is renewed.
const RENEW_CONTRACTION: f64 = 0.1;
/// Contraction above which the inertia part of the Newton matrix gives way to the whole of it.
const INERTIAL_CONTRACTION: f64 = 0.5;
/// Iterations that cost as much as a factorisation: the factors of an earlier step may take this many more than new ones.
const FACTOR_ITERATIONS: usize = 2;
/// When they do not contract, this many steps begin with new factors before old ones are tried again; when they only take more
/// iterations, one.
const REUSE_PAUSE: u32 = 16;
/// The ratio of the last step may have grown by this much when it predicts the second change of this one.
const SAFETY: f64 = 10.0;

/// How the Newton matrix is used from one iteration to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NewtonVariant {
    /// Factorised anew in every iteration.
    Exact,
    /// Factorised once, renewed when the contraction is poor.
    Simplified,
    /// As `Simplified`, with Broyden's rank-one updates.
    Broyden,
    /// Its inertia part stands in for it, `J ≈ M(q) ⊗ A` with the mass matrix in the middle of the step, with Broyden's updates; the
    /// whole of it only in steps where that contracts too slowly. Twice as fast as `Broyden` for s >= 5 on chains of some ten links, no
    /// gain below s = 4. A floating base takes `Broyden`.
    Inertial,
}

/// What is fixed when an [`Integrator`] is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepOptions {
    /// Factorisation; `None` takes [`NewtonMethod::fastest`].
    pub method: Option<NewtonMethod>,
    /// Use of the Newton matrix.
    pub variant: NewtonVariant,
    /// Iterations after which the step fails.
    pub max_iterations: usize,
    /// The iteration ends when the next change of a coordinate is predicted below this, times `1 + max|q|`. At 1e-16, the default,
    /// invariants hold over many steps; a prediction over a few steps needs less.
    pub accuracy: f64,
    /// A revolute joint may end a step this far (rad) from where the guess put it; solutions beyond are refused as spurious.
    pub turn_limit: f64,
    /// Largest change of a revolute joint in one iteration (rad): a longer change is shortened as a whole; infinite (the default): no
    /// limit. Without effect while changes are small. 0.3 helps long chains at steps so long that `J` is nearly singular on the way;
    /// a tree whose way to the root is longer than that may need more iterations with it than without.
    pub change_limit: f64,
    /// Room for forces outside the model.
    pub forces: ForceCapacity,
    /// Coordinates times nodes up to which a dense LU stands by for states where a leaf-to-root pivot is singular.
    pub dense_fallback: usize,
}

impl Default for StepOptions {
    fn default() -> Self {
        Self {
            method: None,
            variant: NewtonVariant::Broyden,
            max_iterations: 40,
            accuracy: 1e-16,
            turn_limit: 1.0,
            change_limit: f64::INFINITY,
            forces: ForceCapacity::default(),
            dense_fallback: 128,
        }
    }
}

/// What a step took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Newton iterations (residual evaluations with a solve).
    pub iterations: usize,
    /// Factorisations of the Newton matrix.
    pub factorizations: usize,
    /// Largest absolute entry of the last change.
    pub last_change: f64,
}

/// The variational integrator of one tree, rule and time step, with all its memory.
///
/// # Example
/// ```
/// use delmpc_mechanics::prelude::*;
/// let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.5), Matrix3::from_diagonal(&Vector3::new(0.09, 0.09, 0.002)));
/// let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
/// let upper = builder.add(Body::new(None, Joint::revolute(Vector3::y(), RigidTransform::identity()), rod));
/// let elbow = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -1.0));
/// builder.add(Body::new(Some(upper), Joint::revolute(Vector3::y(), elbow), rod));
/// let tree = builder.build()?;
/// let mut integrator = Integrator::new(&tree, &LobattoRule::new(2)?, 0.01, StepOptions::default())?;
/// let mut state = State::zeros(&tree);
/// state.q = vec![0.6, -0.3];
/// for _ in 0..100 {
///     integrator.step(&tree, &mut state, &StepForces::held(&[0.0, 0.0]))?;
/// }
/// # let (kinetic, potential) = integrator.velocities().energy(&tree, &state)?;
/// # assert!((kinetic + potential + 9.81 * (1.5 * 0.6f64.cos() + 0.5 * 0.3f64.cos())).abs() < 1e-5);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Integrator {
    del: DelWorkspace,
    solver: NewtonSolver,
    dense: Option<DenseNewton>,
    use_dense: bool,
    inertial: Option<InertialNewton>,
    use_inertial: bool,
    velocities: VelocityWorkspace,
    options: StepOptions,
    direction: Vec<f64>,
    rate: Vec<f64>,
    next: State,
    /// `l_β(1 + c_α)`, row α.
    extrapolation: Vec<f64>,
    /// Nodes of the last step, coordinate-major, and the state it ended in.
    previous_nodes: Vec<f64>,
    previous_end: State,
    /// Chart centre of a floating base in the last step.
    previous_center: RigidTransform,
    has_previous: bool,
    /// Nodes as extrapolated, and what the last extrapolation missed: `dof * s + α - 1`.
    extrapolated: Vec<f64>,
    missed: Vec<f64>,
    /// What the extrapolation before that missed.
    missed_before: Vec<f64>,
    /// How many of the two are known, and whether their trend told the last one better than the one before it.
    known_missed: usize,
    follows_trend: bool,
    /// The solver holds the factors of a Newton matrix of this motion.
    factored: bool,
    /// Iterations of the last step with new factors and a full guess; zero before the first one.
    new_factor_iterations: usize,
    /// Steps until old factors are tried again.
    reuse_pause: u32,
    /// Second change over the square of the first, with the factors of the guess, the last time that there were two.
    quadratic: f64,
    /// `x^1..x^s` of a floating base where it was made.
    factored_travel: Vec<Vector3<f64>>,
    /// Where the guess put node s.
    guessed_end: Vec<f64>,
    broyden: Broyden,
}

impl Integrator {
    /// For steps of `time_step` (s) of `tree` by `rule`.
    ///
    /// # Errors
    /// [`ModelError::TimeStep`] for a step that is not positive and finite.
    pub fn new(
        tree: &KinematicTree,
        rule: &LobattoRule,
        time_step: f64,
        options: StepOptions,
    ) -> Result<Self, ModelError> {
        let del = DelWorkspace::new(tree, rule, time_step, options.forces)?;
        let s = rule.unknown_nodes();
        let order = s * tree.dof();
        let method = options.method.unwrap_or_else(|| NewtonMethod::fastest(tree, s));
        let dense = (order <= options.dense_fallback && method != NewtonMethod::Dense)
            .then(|| DenseNewton::new(tree, &del));
        let mut extrapolation = vec![0.0; (s + 1) * (s + 1)];
        for (alpha, &c) in rule.nodes().iter().enumerate() {
            for beta in 0..=s {
                extrapolation[alpha * (s + 1) + beta] = rule.lagrange(beta, 1.0 + c);
            }
        }
        Ok(Self {
            solver: NewtonSolver::new(method, tree, &del),
            dense,
            use_dense: false,
            inertial: (options.variant == NewtonVariant::Inertial && !tree.is_floating())
                .then(|| InertialNewton::new(rule, tree.dof(), del.instructions))
                .flatten(),
            use_inertial: false,
            velocities: VelocityWorkspace::new(tree),
            options,
            direction: vec![0.0; order],
            rate: vec![0.0; tree.dof()],
            next: State::zeros(tree),
            extrapolation,
            previous_nodes: vec![0.0; (s + 1) * tree.dof()],
            previous_end: State::zeros(tree),
            previous_center: RigidTransform::identity(),
            has_previous: false,
            extrapolated: vec![0.0; order],
            missed: vec![0.0; order],
            missed_before: vec![0.0; order],
            known_missed: 0,
            follows_trend: false,
            factored: false,
            new_factor_iterations: 0,
            reuse_pause: 0,
            quadratic: f64::INFINITY,
            factored_travel: vec![Vector3::zeros(); if tree.is_floating() { s } else { 0 }],
            guessed_end: vec![0.0; tree.dof()],
            broyden: Broyden::new(order),
            del,
        })
    }

    /// Advances `state` by one step. On an error the state is untouched. No allocation.
    ///
    /// # Errors
    /// [`StepError`]: not converged, singular Newton matrix, input not finite, spurious solution, wrong lengths.
    pub fn step(
        &mut self,
        tree: &KinematicTree,
        state: &mut State,
        forces: &StepForces<'_>,
    ) -> Result<StepReport, StepError> {
        let report = self.solve(tree, state, forces)?;
        state.copy_from(&self.next);
        Ok(report)
    }

    /// Solves the DEL equations of one step from `state` without advancing it: the nodes are in [`Integrator::del`], the new
    /// state is [`Integrator::next_state`].
    ///
    /// # Errors
    /// As [`Integrator::step`].
    pub fn solve(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        forces: &StepForces<'_>,
    ) -> Result<StepReport, StepError> {
        self.del.begin(tree, state, forces)?;
        self.use_dense = false;
        let continues = self.has_previous && *state == self.previous_end;
        self.has_previous = false;
        let mut report = StepReport::default();
        self.use_inertial = self.inertial.is_some();
        if continues {
            if self.use_inertial || self.reuse_pause > 0 || self.new_factor_iterations == 0 {
                self.reuse_pause = self.reuse_pause.saturating_sub(1);
                self.factored = false;
            }
            self.guess_by_extrapolation(tree);
            if self.newton(tree, forces, &mut report).is_ok() && self.accept(tree).is_ok() {
                self.remember_missed(tree);
                return self.keep(tree, report);
            }
        }
        self.known_missed = 0;
        self.factored = false;
        self.guess_by_velocity(tree, state)?;
        let mut outcome = self.newton(tree, forces, &mut report).and_then(|()| self.accept(tree));
        if outcome.is_err() {
            self.factored = false;
            self.guess_at_rest(tree);
            let retry = self.newton(tree, forces, &mut report).and_then(|()| self.accept(tree));
            outcome = if retry.is_ok() { retry } else { outcome };
        }
        outcome?;
        self.keep(tree, report)
    }

    /// Forgets the last step: the next one starts from the velocity, with a new factorisation.
    pub fn forget(&mut self) {
        self.has_previous = false;
        self.factored = false;
        self.quadratic = f64::INFINITY;
    }

    /// Changes the time step (s).
    ///
    /// # Errors
    /// [`ModelError::TimeStep`] unless positive and finite.
    pub fn set_time_step(&mut self, time_step: f64) -> Result<(), ModelError> {
        self.forget();
        self.del.set_time_step(time_step)
    }

    /// The nodes of the last step and everything evaluated at them.
    pub fn del(&self) -> &DelWorkspace {
        &self.del
    }

    /// State at the end of the last solved step.
    pub fn next_state(&self) -> &State {
        &self.next
    }

    /// The factorisation in use. The next step makes a new one.
    pub fn solver(&mut self) -> &mut NewtonSolver {
        self.factored = false;
        &mut self.solver
    }

    /// Nodes and factorisation together, for work on a solved step. The next step makes a new factorisation.
    pub fn del_and_solver(&mut self) -> (&mut DelWorkspace, &mut NewtonSolver) {
        self.factored = false;
        (&mut self.del, &mut self.solver)
    }

    /// Factorises the Newton matrix at the solution of the last step; the next step starts with these factors.
    pub(crate) fn factor_solution(
        &mut self,
        tree: &KinematicTree,
    ) -> Result<(&mut DelWorkspace, &mut NewtonSolver), FactorError> {
        self.factored = false;
        self.solver.factor(tree, &self.del)?;
        self.keep_factors();
        Ok((&mut self.del, &mut self.solver))
    }

    /// Velocities, momenta and energies of states.
    pub fn velocities(&mut self) -> &mut VelocityWorkspace {
        &mut self.velocities
    }

    fn guess_by_extrapolation(&mut self, tree: &KinematicTree) {
        let count = self.del.unknown_nodes() + 1;
        for dof in 0..tree.dof() {
            let nodes = &self.previous_nodes[dof * count..(dof + 1) * count];
            for alpha in 1..count {
                let row = &self.extrapolation[alpha * count..(alpha + 1) * count];
                let value = row.iter().zip(nodes).map(|(l, q)| l * q).sum();
                self.del.set_node(alpha, dof, value);
            }
        }
        if tree.is_floating() {
            self.move_guess_to_new_chart();
        }
        let s = count - 1;
        for dof in 0..tree.dof() {
            for alpha in 1..=s {
                let at = dof * s + alpha - 1;
                self.extrapolated[at] = self.del.node(alpha, dof);
                if self.known_missed > 0 {
                    let trend =
                        if self.follows_trend { self.missed[at] - self.missed_before[at] } else { 0.0 };
                    self.del.move_node(alpha, dof, self.missed[at] + trend);
                }
            }
        }
    }

    /// Keeps what the extrapolation missed, and finds out whether to follow its trend: the order it gains is lost where inputs jump.
    fn remember_missed(&mut self, tree: &KinematicTree) {
        let s = self.del.unknown_nodes();
        let (mut without, mut with) = (0.0f64, 0.0f64);
        for dof in 0..tree.dof() {
            for alpha in 1..=s {
                let at = dof * s + alpha - 1;
                let missed = self.del.node(alpha, dof) - self.extrapolated[at];
                let change = missed - self.missed[at];
                without = without.max(change.abs());
                with = with.max((change - (self.missed[at] - self.missed_before[at])).abs());
                self.missed_before[at] = self.missed[at];
                self.missed[at] = missed;
            }
        }
        self.follows_trend = self.known_missed == 2 && with < without;
        self.known_missed = (self.known_missed + 1).min(2);
    }

    /// The guess of a floating base is in the chart of the last step: the same poses in the chart of this step.
    fn move_guess_to_new_chart(&mut self) {
        let s = self.del.unknown_nodes();
        let start = self.del.start.base_pose;
        let vector = |del: &DelWorkspace, alpha: usize, at: usize| {
            Vector3::new(del.node(alpha, at), del.node(alpha, at + 1), del.node(alpha, at + 2))
        };
        let pose = |del: &DelWorkspace, alpha: usize| {
            let motion = RigidTransform {
                rotation: exp_rotation(&vector(del, alpha, 0)),
                translation: vector(del, alpha, 3),
            };
            self.previous_center * motion
        };
        let end = pose(&self.del, s);
        let turn = log_rotation(&start.rotation.tr_mul(&end.rotation)) * 0.5;
        let center = RigidTransform {
            rotation: start.rotation * exp_rotation(&turn),
            translation: (start.translation + end.translation) * 0.5,
        };
        for alpha in 1..=s {
            let motion = center.inverse() * pose(&self.del, alpha);
            let omega = log_rotation(&motion.rotation);
            for k in 0..3 {
                self.del.set_node(alpha, k, omega[k]);
                self.del.set_node(alpha, 3 + k, motion.translation[k]);
            }
        }
    }

    fn guess_by_velocity(&mut self, tree: &KinematicTree, state: &State) -> Result<(), StepError> {
        self.velocities.velocity_into(tree, state, &mut self.rate)?;
        let step = self.del.time_step();
        for alpha in 1..=self.del.unknown_nodes() {
            let c = self.del.rule().nodes()[alpha];
            for joint in 0..tree.joint_count() {
                let dof = tree.base_dof() + joint;
                self.del.set_node(alpha, dof, state.q[joint] + c * step * self.rate[dof]);
            }
            if tree.is_floating() {
                let half = self.half_motion(state);
                for (k, value) in half.iter().enumerate() {
                    self.del.set_node(alpha, k, (2.0 * c - 1.0) * value);
                }
            }
        }
        Ok(())
    }

    /// Half a step of the base at constant body velocity, in the chart centred in the middle of the step.
    fn half_motion(&self, state: &State) -> [f64; 6] {
        let vector = |at: usize| Vector3::new(self.rate[at], self.rate[at + 1], self.rate[at + 2]);
        let (omega, linear) = (vector(0), vector(3));
        let pose = &state.base_pose;
        let half = 0.5 * self.del.time_step();
        let turn = pose.rotation.tr_mul(&omega) * half;
        let center = pose.rotation * exp_rotation(&turn);
        let travel = center.tr_mul(&(linear + omega.cross(&pose.translation))) * half;
        [turn.x, turn.y, turn.z, travel.x, travel.y, travel.z]
    }

    fn guess_at_rest(&mut self, tree: &KinematicTree) {
        for alpha in 1..=self.del.unknown_nodes() {
            for dof in 0..tree.dof() {
                let value = if dof < tree.base_dof() { 0.0 } else { self.del.node(0, dof) };
                self.del.set_node(alpha, dof, value);
            }
        }
    }

    fn factor(&mut self, tree: &KinematicTree, report: &mut StepReport) -> Result<(), FactorError> {
        report.factorizations += 1;
        if self.use_inertial && self.factor_inertia(tree).is_ok() {
            return Ok(());
        }
        self.use_inertial = false;
        self.keep_factors();
        if !self.use_dense {
            let outcome = self.solver.factor(tree, &self.del);
            self.factored = outcome.is_ok();
            match (outcome, &self.dense) {
                (Ok(()), _) => return Ok(()),
                (Err(error), None) => return Err(error),
                // The leaf-to-root pivots fail where pivoting over the whole matrix need not.
                (Err(_), Some(_)) => self.use_dense = true,
            }
        }
        self.factored = false;
        match &mut self.dense {
            Some(dense) => dense.factor(tree, &self.del),
            None => self.solver.factor(tree, &self.del),
        }
    }

    /// The mass matrix at the node nearest to the middle of the step.
    fn factor_inertia(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        let middle = self.del.unknown_nodes().div_ceil(2);
        for (dof, q) in self.next.q.iter_mut().enumerate() {
            *q = self.del.node(middle, dof);
        }
        self.velocities.factor_at(tree, &self.next)
    }

    fn keep_factors(&mut self) {
        self.factored = true;
        for (k, travel) in self.factored_travel.iter_mut().enumerate() {
            *travel = Vector3::from_fn(|r, _| self.del.node(k + 1, 3 + r));
        }
    }

    /// Takes the change of a floating base for one of `R_b x`, at the `x` where `J` was made, instead of `x`.
    ///
    /// The axes of `x` turn with the unknown `ω^s`. The momentum of the whole robot goes with `R_b ẋ`, the light base turns under it:
    /// in `x`, what a step or an iteration adds to the velocity changes `J` by a hundred times more than in `R_b x`. To first order
    /// in the turn `δω^s`: `δx += δω^s × (x_J - x - δx)`.
    fn turn_travel_with_chart(&mut self) {
        let s = self.del.unknown_nodes();
        let direction = &mut self.direction;
        let turn = Vector3::from_fn(|k, _| direction[k * s + s - 1]);
        for (alpha, factored) in self.factored_travel.iter().enumerate() {
            let travel =
                Vector3::from_fn(|k, _| self.del.node(alpha + 1, 3 + k) + direction[(3 + k) * s + alpha]);
            let bend = turn.cross(&(factored - travel));
            for k in 0..3 {
                direction[(3 + k) * s + alpha] += bend[k];
            }
        }
    }

    fn newton(
        &mut self,
        tree: &KinematicTree,
        forces: &StepForces<'_>,
        report: &mut StepReport,
    ) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        for (dof, end) in self.guessed_end.iter_mut().enumerate() {
            *end = self.del.node(s, dof);
        }
        let (mut last_change, mut last_contraction) = (f64::INFINITY, 0.0f64);
        self.broyden.forget();
        let mut contracts = self.factored;
        let (old_factors, mut renewed) = (self.factored, false);
        let factorizations = report.factorizations;
        let mut residual = f64::INFINITY;
        for iteration in 0..self.options.max_iterations {
            self.del.evaluate(tree, forces.laws);
            self.del.residual_into(tree, &mut self.direction);
            residual = self.direction.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            if let Some(index) = self.direction.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity: "DEL residual (coordinate * s + node)", index });
            }
            if self.options.variant == NewtonVariant::Exact || !contracts {
                self.factor(tree, report)?;
                self.broyden.forget();
                renewed = true;
            }
            match (&mut self.dense, &mut self.inertial) {
                (_, Some(inertial)) if self.use_inertial => {
                    inertial.solve(self.velocities.factor(), self.del.time_step(), &mut self.direction);
                }
                (Some(dense), _) if self.use_dense => dense.solve(tree, &mut self.direction),
                _ => self.solver.solve(tree, &mut self.direction),
            }
            for x in &mut self.direction {
                *x = -*x;
            }
            if matches!(self.options.variant, NewtonVariant::Broyden | NewtonVariant::Inertial) {
                self.broyden.improve(&mut self.direction);
            }
            if tree.is_floating() {
                self.turn_travel_with_chart();
            }
            report.iterations += 1;
            let limited = self.limit_change(tree);
            let mut size = 1.0f64;
            let mut change = 0.0f64;
            for dof in 0..tree.dof() {
                for alpha in 1..=s {
                    let delta = self.direction[dof * s + alpha - 1];
                    self.del.move_node(alpha, dof, delta);
                    size = size.max(1.0 + self.del.node(alpha, dof).abs());
                    change = change.max(delta.abs());
                }
            }
            report.last_change = change;
            if !change.is_finite() {
                return Err(StepError::NotConverged { residual, change, iterations: report.iterations });
            }
            let contraction = change / last_change;
            // Old factors contract unevenly: the worse of two contractions counts, and a poor one is no sign of round-off.
            let old = (old_factors && !renewed) || self.use_inertial;
            let rate = if old { contraction.max(last_contraction) } else { contraction };
            // What is left by the contractions before this one, should round-off hide how much this change is smaller than the last.
            let left = last_change * last_contraction * last_contraction;
            let hidden = old && iteration > 1 && change < STAGNATION_CHANGE * size;
            let small = if old { self.options.accuracy } else { SMALL_CHANGE.max(self.options.accuracy) };
            // Newton's method with the matrix of the guess: the second change is as the square of the first.
            let fresh =
                renewed && !limited && !self.use_inertial && report.factorizations == factorizations + 1;
            if fresh && iteration == 1 {
                self.quadratic = change / (last_change * last_change);
            }
            let predicted = SAFETY * self.quadratic * change * change;
            if change <= small * size
                || (fresh && iteration == 0 && predicted <= self.options.accuracy * size)
                || (iteration > 0 && change * rate <= self.options.accuracy * size)
                || (hidden && left <= self.options.accuracy * size)
                || (!old && change < STAGNATION_CHANGE * size && contraction > 0.5)
            {
                self.del.evaluate(tree, forces.laws);
                if !old_factors {
                    if self.known_missed > 0 {
                        self.new_factor_iterations = iteration + 1;
                    }
                } else if renewed {
                    self.reuse_pause = REUSE_PAUSE;
                } else if iteration + 1 > self.new_factor_iterations + FACTOR_ITERATIONS {
                    self.reuse_pause = 1;
                }
                return Ok(());
            }
            contracts = if self.use_inertial {
                // The whole matrix, for the rest of the step.
                self.use_inertial = contraction < INERTIAL_CONTRACTION || iteration == 0;
                self.use_inertial
            } else {
                !limited && (contraction < RENEW_CONTRACTION || iteration == 0)
            };
            (last_change, last_contraction) = (change, contraction);
        }
        Err(StepError::NotConverged { residual, change: last_change, iterations: report.iterations })
    }

    /// Shortens a change that turns a joint by more than the limit.
    fn limit_change(&mut self, tree: &KinematicTree) -> bool {
        if self.options.change_limit.is_infinite() {
            return false;
        }
        let s = self.del.unknown_nodes();
        let mut turn = 0.0f64;
        for (body, spec) in tree.bodies().iter().enumerate().skip(tree.first_joint_body()) {
            if spec.joint.kind == JointKind::Revolute {
                let dof = tree.joint_dof(body);
                for delta in &self.direction[dof * s..(dof + 1) * s] {
                    turn = turn.max(delta.abs());
                }
            }
        }
        let limited = turn > self.options.change_limit;
        if limited {
            let scale = self.options.change_limit / turn;
            for x in &mut self.direction {
                *x *= scale;
            }
        }
        limited
    }

    /// Refuses solutions that are not the continuation of the motion.
    fn accept(&self, tree: &KinematicTree) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        if tree.is_floating() {
            let half = sqrt((0..3).map(|k| self.del.node(s, k) * self.del.node(s, k)).sum());
            if half > MAX_HALF_ROTATION {
                let limit = 2.0 * MAX_HALF_ROTATION;
                return Err(StepError::SpuriousSolution { dof: 0, change: 2.0 * half, limit });
            }
        }
        for (body, spec) in tree.bodies().iter().enumerate().skip(tree.first_joint_body()) {
            if spec.joint.kind != JointKind::Revolute {
                continue;
            }
            let dof = tree.joint_dof(body);
            let change = (self.del.node(s, dof) - self.guessed_end[dof]).abs();
            let limit = self.options.turn_limit;
            if change > limit {
                return Err(StepError::SpuriousSolution { dof, change, limit });
            }
        }
        Ok(())
    }

    /// `p^1 := row s + Σ_{α<s} r^α`. The columns of `a^{αβ}` sum to zero over all rows: this is `p^0` plus all impulses, without
    /// the `a^{sβ} Sᵀμ ~ M δq/Δt` that an error `δq` of the nodes leaves in row s. (The base's momentum is such a sum already.)
    fn add_residual_to_momentum(&mut self, tree: &KinematicTree) {
        let s = self.del.unknown_nodes();
        self.del.residual_into(tree, &mut self.direction);
        let rows = self.direction.chunks_exact(s).skip(tree.base_dof());
        for (p, row) in self.next.p[tree.base_dof()..].iter_mut().zip(rows) {
            *p += row.iter().sum::<f64>();
        }
    }

    fn keep(&mut self, tree: &KinematicTree, report: StepReport) -> Result<StepReport, StepError> {
        let count = self.del.unknown_nodes() + 1;
        self.del.next_state_into(tree, &mut self.next);
        self.add_residual_to_momentum(tree);
        for dof in 0..tree.dof() {
            for alpha in 0..count {
                self.previous_nodes[dof * count + alpha] = self.del.node(alpha, dof);
            }
        }
        self.previous_end.copy_from(&self.next);
        self.previous_center = self.del.center;
        self.has_previous = true;
        Ok(report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::mem::size_of;

    #[test]
    fn reports_stay_small() {
        assert!(size_of::<StepReport>() <= 24 && size_of::<StepError>() <= 64);
    }
}
