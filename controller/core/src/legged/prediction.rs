//! Where the robot will be when the command takes effect: by the stage of the plan in between, under the law that is in force.
//!
//! The deviation from the plan goes through one lifted stage, `x⁺ = A x + B u + d`, with the torque the servo adds for the deviation
//! half way, `u = K (x + x⁺)/2`, by two rounds of substitution.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_horizon::contact_schedule::ContactSchedule;
use delmpc_horizon::legged_model::LeggedModel;
use delmpc_horizon::motion_plan::MotionPlan;
use delmpc_mechanics::contact_stage::{BoundaryState, ContactStage, LiftedStage, StageNominal};
use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::lobatto::LobattoRule;

use super::base_feedback::BaseFeedback;
use crate::errors::ControlError;
use crate::feedback_law::Law;

/// Rounds of substitution.
const ROUNDS: usize = 2;

/// Memory of the prediction.
#[derive(Debug)]
pub(crate) struct StatePrediction {
    rule: LobattoRule,
    stage: ContactStage,
    lifted: LiftedStage,
    nominal: StageNominal,
    active: Vec<bool>,
    start: BoundaryState,
    end: BoundaryState,
    deviation: Vec<f64>,
    later: Vec<f64>,
    input: Vec<f64>,
}

impl StatePrediction {
    pub fn new(model: &LeggedModel) -> Result<Self, ControlError> {
        let rule = LobattoRule::new(2)?;
        let stage = ContactStage::new(&model.tree, &rule, &model.contacts())?;
        let states = 2 * model.tree.dof();
        Ok(Self {
            rule,
            lifted: stage.lifted(),
            nominal: stage.nominal(),
            stage,
            active: vec![false; model.feet.len()],
            start: model.posture.clone(),
            end: model.posture.clone(),
            deviation: vec![0.0; states],
            later: vec![0.0; states],
            input: vec![0.0; model.tree.joint_count()],
        })
    }

    /// Moves `measured` from one time to another into `predicted`. No allocation.
    ///
    /// # Errors
    /// When the stage cannot be linearised.
    #[allow(clippy::too_many_arguments)]
    pub fn advance(
        &mut self,
        model: &LeggedModel,
        plan: &MotionPlan,
        schedule: &ContactSchedule,
        (law, base_feedback): (&Law, &BaseFeedback),
        (from_s, to_s): (f64, f64),
        measured: &BoundaryState,
        predicted: &mut BoundaryState,
    ) -> Result<(), StepError> {
        let (duration, middle) = (to_s - from_s, 0.5 * (from_s + to_s));
        // The plan may begin a little later than the measurement was taken.
        plan.state_at(from_s, &mut self.start);
        plan.state_at(to_s, &mut self.end);
        for (foot, active) in self.active.iter_mut().enumerate() {
            *active = schedule.stands(foot, middle);
        }
        let at = plan.stage_at(middle);
        self.nominal.interpolate(&self.rule, duration, &self.start, &self.end, plan.force(at));
        let Self { stage, lifted, nominal, active, start, end, .. } = self;
        stage.linearize(&model.tree, duration, active, start, nominal, plan.input(at), end, lifted)?;
        start.local(measured, &mut self.deviation);
        self.later.copy_from_slice(&self.deviation);
        let joints = self.input.len();
        let nv = 6 + joints;
        for _ in 0..ROUNDS {
            let mean = |at: usize| 0.5 * (self.deviation[at] + self.later[at]);
            let place: [f64; 6] = core::array::from_fn(mean);
            let velocity: [f64; 6] = core::array::from_fn(|k| mean(nv + k));
            for (i, input) in self.input.iter_mut().enumerate() {
                *input = base_feedback.torque(i, &place, &velocity);
                for j in 0..joints {
                    *input += law.gain[(i, j)] * mean(6 + j) + law.gain[(i, joints + j)] * mean(nv + 6 + j);
                }
                let limit = model.limits[i].effort;
                let planned = plan.input(at)[i];
                *input = (planned + *input).clamp(-limit, limit) - planned;
            }
            for row in 0..2 * nv {
                let mut sum = self.lifted.d(row);
                let (_, map) = self.lifted.transition_row(row).split_at(1);
                sum += map[..2 * nv].iter().zip(&self.deviation).map(|(a, x)| a * x).sum::<f64>();
                sum += map[2 * nv..].iter().zip(&self.input).map(|(b, u)| b * u).sum::<f64>();
                self.later[row] = sum;
            }
        }
        predicted.copy_from(&self.end);
        predicted.retract(&self.later);
        Ok(())
    }
}
