//! One stage of the horizon: simulate from its node, linearise there.
//!
//! Multiple shooting: the stage starts at the nominal node `x̄_k`, whatever the stage before ended in; where it ends, less the next
//! node, is the defect `d_k`. The step and its derivatives come from the variational integrator, in `(q, q̇)`.
//!
//! ```text
//! x_{k+1} = A_k x_k + B_k u_k + d_k        d_k = Φ(x̄_k, ū_k) - x̄_{k+1}
//! ```
//!
//! Source: H. G. Bock, K. J. Plitt, *A multiple shooting algorithm for direct solution of optimal control problems*, IFAC 1984.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::{ModelError, StepError};
use delmpc_mechanics::forces::StepForces;
use delmpc_mechanics::linearize::{InputHold, Linearizer, StateCoordinates};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::state::State;
use delmpc_mechanics::step::{Integrator, StepOptions};
use delmpc_mechanics::tree::KinematicTree;

use delmpc_lq::lq_problem::LqStage;

/// Unknown nodes of the controller's integrator: Simpson, fourth order.
const UNKNOWN_NODES: usize = 2;

/// To what a step is solved, rad or m: far below what encoders tell.
const ACCURACY: f64 = 1e-9;

/// Integrator and linearisation for stages of any length.
#[derive(Clone, Debug)]
pub struct StageDynamics {
    integrator: Integrator,
    linearizer: Linearizer,
    time_step: f64,
    state: State,
    end: Vec<f64>,
}

impl StageDynamics {
    /// For a tree with a fixed base.
    ///
    /// # Errors
    /// When the mechanics refuse the tree.
    pub fn new(tree: &KinematicTree) -> Result<Self, ModelError> {
        let time_step = 0.01;
        let rule = LobattoRule::new(UNKNOWN_NODES)?;
        let options = StepOptions { accuracy: ACCURACY, ..StepOptions::default() };
        let integrator = Integrator::new(tree, &rule, time_step, options)?;
        let linearizer = Linearizer::new(tree, &integrator, StateCoordinates::Velocity, InputHold::Held)?;
        let (state, end) = (State::zeros(tree), vec![0.0; 2 * tree.dof()]);
        Ok(Self { integrator, linearizer, time_step, state, end })
    }

    /// Simulates one stage of `time_step` (s) from `x = (q, q̇)` under the held torque `u` and fills `next` with its end.
    ///
    /// # Errors
    /// When Newton's method does not converge, or an argument does not fit.
    pub fn simulate(
        &mut self,
        tree: &KinematicTree,
        x: &[f64],
        u: &[f64],
        time_step: f64,
        next: &mut [f64],
    ) -> Result<(), StepError> {
        if time_step != self.time_step {
            self.integrator.set_time_step(time_step)?;
            self.time_step = time_step;
        }
        let n = tree.dof();
        let (q, q_dot) = x.split_at(n);
        self.state.q.copy_from_slice(q);
        self.integrator.velocities().set_velocity(tree, &mut self.state, q_dot)?;
        self.integrator.solve(tree, &self.state, &StepForces::held(u))?;
        self.state.copy_from(self.integrator.next_state());
        let (q, q_dot) = next.split_at_mut(n);
        q.copy_from_slice(&self.state.q);
        self.integrator.velocities().velocity_into(tree, &self.state, q_dot)?;
        Ok(())
    }

    /// Simulates and linearises: fills `[B A]` and the defect against `next_node`.
    ///
    /// # Errors
    /// As [`StageDynamics::simulate`].
    pub fn linearise(
        &mut self,
        tree: &KinematicTree,
        x: &[f64],
        u: &[f64],
        time_step: f64,
        next_node: &[f64],
        stage: &mut LqStage,
    ) -> Result<(), StepError> {
        let n = tree.dof();
        let mut end = core::mem::take(&mut self.end);
        let outcome = self.simulate(tree, x, u, time_step, &mut end);
        for (i, (end, node)) in end.iter().zip(next_node).enumerate() {
            stage.set_defect(i, end - node);
        }
        self.end = end;
        outcome?;
        let step = self.linearizer.linearize(tree, &mut self.integrator)?;
        let mut b = stage.b_mut();
        for row in 0..2 * n {
            for column in 0..n {
                b[(row, column)] = step.b(row, column);
            }
        }
        let mut a = stage.a_mut();
        for row in 0..2 * n {
            for column in 0..2 * n {
                a[(row, column)] = step.a(row, column);
            }
        }
        Ok(())
    }
}
