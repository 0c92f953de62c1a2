//! Newton's method with the exact Jacobian of the DEL equations, plain and with a limit on the change.
//!
//! ```text
//! J δq = -r,      q^1 += δq min(1, Δ / max|δq|)
//! ```
//!
//! The limit `Δ` is the whole globalisation: a trust region of fixed size in the largest angle, without a merit function. Where `J` is
//! nearly singular the plain change leaves the region where the equations say anything; the limited iteration stays near and finds
//! one of the roots. It costs nothing while changes are small.
//!
//! Measured alternatives at 20, 40, 60 ms on the 32-link chain of rods (400 initial conditions, success; as it is now, with 1000, in figure
//! 1: 0.99, 0.90, 0.75): plain 0.92, 0.53, 0.24; affine-invariant damping (P. Deuflhard, *Newton Methods for Nonlinear Problems*, Springer 2011, NLEQ-ERR)
//! 0.88, 0.43, 0.21; continuation in the time step 0.97, 0.66, 0.38 at up to nine times the time; every angle limited by itself 0.90,
//! 0.53, 0.25; plain from a Runge-Kutta step 0.87, 0.45, 0.21.
//!
//! `J` is factorised anew where its factors would not do: where the change was limited, and where the contraction of the last iteration, once
//! more, would not come near the tolerance. In between [`delmpc_mechanics::broyden`] makes the best of the factors, as in the integrator.
//! The plain method and the second attempt factorise always.

use delmpc_mechanics::broyden::Broyden;
use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};

use crate::one_step::{OneStep, Outcome, Progress, TOLERANCE};

/// Iterations of the limited method from the start.
const MAX_ITERATIONS: usize = 60;
/// Iterations at half the step, and at the whole one from there. Sixty find two per cent more roots at 60 ms, at a higher price for each;
/// thirty from the start too would lose one of a thousand at 10 ms.
const MAX_ITERATIONS_AGAIN: usize = 30;
/// Iterations of the plain one: beyond, successes are accidents.
const MAX_PLAIN_ITERATIONS: usize = 30;
/// rad; best of 0.15, 0.2, 0.3, 0.4, 0.5.
pub const CHANGE_LIMIT: f64 = 0.3;
/// N m s: the residual to be expected at which the factors are kept; with Broyden's method ten times the tolerance is as good as the tolerance.
const KEEP: f64 = 10.0 * TOLERANCE;

/// Workspace of the method with one factorisation.
#[derive(Clone, Debug)]
pub struct ExactNewton {
    solver: NewtonSolver,
    change: Vec<f64>,
    broyden: Broyden,
    limit: f64,
}

impl ExactNewton {
    /// With the given factorisation; `limit` in rad, infinite for the plain method.
    pub fn new(method: NewtonMethod, problem: &OneStep, limit: f64) -> Self {
        Self {
            solver: NewtonSolver::new(method, &problem.tree, &problem.del),
            change: vec![0.0; problem.tree.dof()],
            broyden: Broyden::new(problem.tree.dof()),
            limit,
        }
    }

    /// Solves a step that has begun; if that fails, once more by way of half the step. No allocation.
    pub fn solve(&mut self, problem: &mut OneStep) -> Outcome {
        if self.limit.is_infinite() {
            return self.iterate(problem, 0, MAX_PLAIN_ITERATIONS, false);
        }
        match self.iterate(problem, 0, MAX_ITERATIONS, true) {
            Outcome::Failed => self.continue_from_half(problem),
            solved => solved,
        }
    }

    /// Continuation in the time step, in one go: half the step, then the whole from there.
    fn continue_from_half(&mut self, problem: &mut OneStep) -> Outcome {
        if !problem.halve() {
            return Outcome::Failed;
        }
        let half = self.iterate(problem, MAX_ITERATIONS, MAX_ITERATIONS_AGAIN, false);
        match half {
            Outcome::Solved(before) if problem.restore() => {
                self.iterate(problem, before, MAX_ITERATIONS_AGAIN, false)
            }
            _ => {
                problem.restore();
                Outcome::Failed
            }
        }
    }

    /// `thrifty`: keeps factors where it may; otherwise every iteration has its own.
    fn iterate(&mut self, problem: &mut OneStep, before: usize, most: usize, thrifty: bool) -> Outcome {
        let mut last = f64::INFINITY;
        let mut limited = true;
        for iteration in 0..most {
            match problem.evaluate() {
                Progress::Root => return problem.accept(before + iteration),
                Progress::Lost => return Outcome::Failed,
                Progress::Open => {}
            }
            let size = problem.residual_size;
            if !thrifty || limited || size * (size / last) > KEEP {
                if self.solver.factor(&problem.tree, &problem.del).is_err() {
                    return Outcome::Failed;
                }
                self.broyden.forget();
            }
            last = size;
            for (x, r) in self.change.iter_mut().zip(&problem.residual) {
                *x = -r;
            }
            self.solver.solve(&problem.tree, &mut self.change);
            self.broyden.improve(&mut self.change);
            let largest = self.change.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            limited = largest > self.limit;
            problem.step((self.limit / largest).min(1.0), &self.change);
        }
        Outcome::Failed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pendulum::{Links, initial_conditions, pendulum};
    use crate::quasi_newton::QuasiNewton;
    use delmpc_mechanics::prelude::*;

    /// All methods find the step of the integrator, which is exact to round-off.
    #[test]
    fn all_methods_find_the_step_of_the_integrator() {
        for links in [Links::Rods, Links::UnitInertia] {
            let tree = pendulum(links, 32).unwrap();
            let time_step = 2e-3;
            let mut problem = OneStep::new(&tree, time_step).unwrap();
            let options = StepOptions { max_iterations: 40, ..StepOptions::default() };
            let rule = LobattoRule::new(1).unwrap();
            let mut integrator = Integrator::new(&tree, &rule, time_step, options).unwrap();
            let mut quasi = QuasiNewton::new(&tree).unwrap();
            let mut exact = [
                ExactNewton::new(NewtonMethod::Recursive, &problem, f64::INFINITY),
                ExactNewton::new(NewtonMethod::Recursive, &problem, CHANGE_LIMIT),
                ExactNewton::new(NewtonMethod::BranchLu, &problem, CHANGE_LIMIT),
            ];
            for initial in initial_conditions(32, 10, std::f64::consts::FRAC_PI_2, 11) {
                let mut state = State::zeros(&tree);
                state.q.copy_from_slice(&initial.q);
                integrator.velocities().set_velocity(&tree, &mut state, &initial.v).unwrap();
                integrator.solve(&tree, &state, &StepForces::held(&[0.0; 32])).unwrap();
                let expected = integrator.next_state().q.clone();
                problem.begin(&state, &initial).unwrap();
                let check = |problem: &OneStep, outcome: Outcome| {
                    assert!(outcome.is_solved());
                    for (i, q) in expected.iter().enumerate() {
                        // The residual tolerance over the smallest inertia (a light tip), times Δt.
                        assert!((problem.del.node(1, i) - q).abs() < 1e-8, "joint {i}");
                    }
                };
                let outcome = quasi.solve(&mut problem, &initial);
                check(&problem, outcome);
                for method in &mut exact {
                    problem.restart();
                    let outcome = method.solve(&mut problem);
                    check(&problem, outcome);
                }
            }
        }
    }
}
