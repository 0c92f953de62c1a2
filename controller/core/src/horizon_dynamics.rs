//! All stages of the horizon at once: lifted linearisation about the nominal, every SIMD lane a stage.
//!
//! Multiple shooting over Simpson steps whose interior nodes are unknowns too, eliminated by one Newton correction per cycle:
//!
//! ```text
//! q^0 = q_k      q^1 = (q_k + q_{k+1})/2 + Δt (q̇_k - q̇_{k+1})/8      q^2 = q_{k+1}
//! x_{k+1} = A_k x_k + B_k u_k + d_k        d_k = (end of the step, Newton correction included) - x̄_{k+1}
//! ```
//!
//! The interior node starts from the cubic through the ends (error O(Δt⁴)); what is left is corrected to second order, as in
//! one iteration of the lifted Newton method. Nothing is simulated.
//!
//! Source: J. Albersmeyer, M. Diehl, *The lifted Newton method and its application in optimization*, SIAM J. Optim. 20, 2010;
//! H. G. Bock, K. J. Plitt, *A multiple shooting algorithm for direct solution of optimal control problems*, IFAC 1984.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::{ModelError, StepError};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::stage_batch::{StageBatch, StageInput, TransitionOutput, TransitionRows};
use delmpc_mechanics::tree::KinematicTree;

use delmpc_lq::lq_stage::{LqStage, TransitionRowsMut};
use delmpc_lq::trajectory::Trajectory;

/// Workspace of the horizon's linearisation.
#[derive(Clone, Debug)]
pub struct HorizonDynamics {
    batch: StageBatch,
    middle: Vec<f64>,
    end: Vec<f64>,
}

/// The transitions of an LQ problem, to be written.
struct Transitions<'a>(&'a mut [LqStage]);

impl TransitionOutput for Transitions<'_> {
    fn transition(&mut self, stage: usize) -> TransitionRows<'_> {
        let TransitionRowsMut { values, row_stride, first_state } = self.0[stage].transition_rows();
        TransitionRows { values, row_stride, first_state }
    }
}

impl HorizonDynamics {
    /// For a tree with a fixed base and a number of stages.
    ///
    /// # Errors
    /// When the mechanics refuse the tree.
    pub fn new(tree: &KinematicTree, stages: usize) -> Result<Self, ModelError> {
        let batch = StageBatch::new(tree, &LobattoRule::new(2)?, stages)?.without_interior_sensitivities();
        Ok(Self { batch, middle: vec![0.0; tree.dof()], end: vec![0.0; 2 * tree.dof()] })
    }

    /// Linearises every stage about the nodes `(q, q̇)` and inputs of `nominal`, with these lengths (s): fills transition and defect
    /// of every stage.
    ///
    /// # Errors
    /// The first stage that is not finite or singular.
    pub fn linearise(
        &mut self,
        nominal: &Trajectory,
        lengths: &[f64],
        stages: &mut [LqStage],
    ) -> Result<(), StepError> {
        let n = self.middle.len();
        for (k, &time_step) in lengths.iter().enumerate() {
            let (q, rate) = nominal.x(k).split_at(n);
            let (next_q, next_rate) = nominal.x(k + 1).split_at(n);
            for (j, middle) in self.middle.iter_mut().enumerate() {
                *middle = 0.5 * (q[j] + next_q[j]) + 0.125 * time_step * (rate[j] - next_rate[j]);
            }
            let nodes = [q, &self.middle, next_q];
            self.batch.set_stage(k, &StageInput { nodes, rate, force: nominal.u(k), time_step })?;
        }
        let (q, rate) = nominal.x(lengths.len()).split_at(n);
        self.batch.set_end_node(q, rate)?;
        self.batch.linearize(&mut Transitions(stages))?;
        for (k, stage) in stages.iter_mut().enumerate() {
            self.batch.outcome(k)?;
            self.batch.end_state_into(k, &mut self.end)?;
            for (i, (end, node)) in self.end.iter().zip(nominal.x(k + 1)).enumerate() {
                stage.set_defect(i, end - node);
            }
        }
        Ok(())
    }

    /// Kinematics, momenta and gravity at all nodes of the last linearisation.
    pub fn batch(&self) -> &StageBatch {
        &self.batch
    }
}
