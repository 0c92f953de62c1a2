//! The O(n) quasi-Newton method for the DEL equations: recursive impulse-based quasi-Newton (RIQN).
//!
//! The Jacobian of `r` is replaced by `-M(q^0)/Δt`, which it approaches for small steps. Its inverse is applied without forming it: `r`
//! acts as an impulse on the articulated bodies at `q^0`, the change of velocity it causes, times `Δt`, is the change of `q^1`.
//! The articulated inertias are computed once per step.
//!
//! ```text
//! δq^1 = Δt M(q^0)⁻¹ r
//! ```
//!
//! Linear convergence, rate O(Δt). Cost: Algorithm 1 and an impulse response per iteration, the cheapest iteration there is.
//!
//! Source: J. Lee, C. K. Liu, F. C. Park, S. S. Srinivasa, *A linear-time variational integrator for multibody systems*, WAFR 2016, section 4,
//! and the authors' published experiments (articulated inertias at the start of the step; tolerance). Their own discretisation averages
//! velocities on SE(3); here the method solves the same trapezoidal equations as Newton's does.

use delmpc_mechanics::prelude::KinematicTree;

use crate::articulated_body::ArticulatedBody;
use crate::one_step::{OneStep, Outcome, Progress};
use crate::pendulum::Initial;
use crate::rigid_bodies::RivalError;

/// Generous: what converges takes some 20 to 100.
const MAX_ITERATIONS: usize = 200;

/// Workspace for one tree.
#[derive(Clone, Debug)]
pub struct QuasiNewton {
    bodies: ArticulatedBody,
    change: Vec<f64>,
}

impl QuasiNewton {
    /// For a tree of revolute joints.
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree) -> Result<Self, RivalError> {
        Ok(Self { bodies: ArticulatedBody::new(tree)?, change: vec![0.0; tree.dof()] })
    }

    /// Solves a step that has begun. No allocation.
    pub fn solve(&mut self, problem: &mut OneStep, initial: &Initial) -> Outcome {
        self.bodies.factor(&initial.q);
        let time_step = problem.del.time_step();
        for iteration in 0..MAX_ITERATIONS {
            match problem.evaluate() {
                Progress::Root => return problem.accept(iteration),
                Progress::Lost => return Outcome::Failed,
                Progress::Open => {}
            }
            self.change.copy_from_slice(&problem.residual);
            self.bodies.solve(&mut self.change);
            problem.step(time_step, &self.change);
        }
        Outcome::Failed
    }
}
