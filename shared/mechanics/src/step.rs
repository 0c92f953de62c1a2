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
//! continues where the last one ended (a floating base: in the chart of the last step, then moved to the new one). What that is
//! expected to miss, going by the last steps (`missed.rs`), is added. Else `q^α = q^0 + c_α Δt M⁻¹p`; if Newton fails from there,
//! `q^α = q^0`.
//!
//! **Iteration.** `J` is factorised once and kept while the iteration contracts (simplified Newton), also over the steps that
//! continue the motion and after a linearisation: it changes by `O(Δt)` from step to step, and a factorisation costs as much as
//! two or three iterations. When old factors take more iterations than new ones are worth, the next step makes new ones; when
//! they do not contract (light links at high accelerations), the next sixteen do. Broyden's update on top of the factors, and what the
//! step before tells about them ([`crate::broyden`]), cost a few scalar products and save one or two iterations. `J`
//! is renewed when `θ` exceeds 0.1. A change may be limited to [`StepOptions::change_limit`] in the largest angle, a trust region
//! without a merit function: on a 32-link chain at steps of 40 ms (trapezoidal, random states, `tests/paper`) it raises the share of
//! solved steps from 0.5 to 0.9.
//!
//! **Stop.** On the change, never on the residual: its floor `~10 ε max|a^{αβ} Sᵀμ|` grows with the length of the chain. Done
//! when the next change is predicted below [`StepOptions::accuracy`] times `1 + max|q|`, by default 1e-16: what is left of it accumulates in the momenta over many steps
//! (stopping at 1e-14 left 1e-10 in an exactly conserved momentum after 500 steps). With old factors the prediction is linear in the
//! change, and when round-off hides a contraction, those before it count; with the factors of the guess the second change is as the square of the first, and their ratio in an earlier step, times ten
//! for safety, may end the iteration at the first. Or when the change is below `1e-8` and no longer shrinks: round-off. With old factors
//! a change of 1e-14 is the last but one, and none below 1e-13 says that they do not contract.
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
use crate::del_residual::DelWorkspace;
use crate::dense_lu::DenseNewton;
use crate::errors::{FactorError, ModelError, StepError};
use crate::forces::StepForces;
use crate::inertial_newton::InertialNewton;
use crate::lobatto::LobattoRule;
use crate::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use crate::spatial::RigidTransform;
use crate::state::State;
use crate::tree::KinematicTree;
use crate::velocity::VelocityWorkspace;

mod guess;
mod iteration;
mod missed;
mod options;

use missed::Missed;

pub use options::{NewtonVariant, StepOptions, StepReport};

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
    /// Nodes as extrapolated, `dof * s + α - 1`, and what that missed.
    extrapolated: Vec<f64>,
    missed: Missed,
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
            missed: Missed::new(order),
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
        self.missed.forget();
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
        // The equations may hold at nodes whose momenta overflow.
        self.next.check_finite()?;
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
