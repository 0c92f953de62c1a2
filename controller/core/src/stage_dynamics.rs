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

use crate::lq_problem::LqStage;

/// Unknown nodes of the controller's integrator: Simpson, fourth order.
const UNKNOWN_NODES: usize = 2;

/// Integrator and linearisation for stages of any length.
#[derive(Clone, Debug)]
pub struct StageDynamics {
    integrator: Integrator,
    linearizer: Linearizer,
    time_step: f64,
    state: State,
    rate: Vec<f64>,
}

impl StageDynamics {
    /// For a tree with a fixed base.
    ///
    /// # Errors
    /// When the mechanics refuse the tree.
    pub fn new(tree: &KinematicTree) -> Result<Self, ModelError> {
        let time_step = 0.01;
        let rule = LobattoRule::new(UNKNOWN_NODES)?;
        let integrator = Integrator::new(tree, &rule, time_step, StepOptions::default())?;
        let linearizer = Linearizer::new(tree, &integrator, StateCoordinates::Velocity, InputHold::Held)?;
        Ok(Self { integrator, linearizer, time_step, state: State::zeros(tree), rate: vec![0.0; tree.dof()] })
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
        let n = tree.dof();
        if time_step != self.time_step {
            self.integrator.set_time_step(time_step)?;
            self.time_step = time_step;
        }
        let (q, q_dot) = x.split_at(n);
        self.state.q.copy_from_slice(q);
        self.integrator.velocities().set_velocity(tree, &mut self.state, q_dot)?;
        self.integrator.solve(tree, &self.state, &StepForces::held(u))?;
        self.state.copy_from(self.integrator.next_state());
        self.integrator.velocities().velocity_into(tree, &self.state, &mut self.rate)?;
        next[..n].copy_from_slice(&self.state.q);
        next[n..].copy_from_slice(&self.rate);
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
        let mut end = core::mem::take(&mut stage.defect);
        let outcome = self.simulate(tree, x, u, time_step, &mut end);
        stage.defect = end;
        outcome?;
        for (d, node) in stage.defect.iter_mut().zip(next_node) {
            *d -= node;
        }
        let step = self.linearizer.linearize(tree, &mut self.integrator)?;
        for column in 0..n {
            let target = stage.transition.col_as_slice_mut(column);
            for (row, entry) in target.iter_mut().enumerate() {
                *entry = step.b(row, column);
            }
        }
        for column in 0..2 * n {
            let target = stage.transition.col_as_slice_mut(n + column);
            for (row, entry) in target.iter_mut().enumerate() {
                *entry = step.a(row, column);
            }
        }
        Ok(())
    }
}
