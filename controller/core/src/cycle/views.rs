//! What a cycle left behind, to look at: plan, problem, solution, estimate. Nothing is computed here.

use super::*;

impl Controller {
    /// Where the robot aims.
    pub fn reference(&self) -> &Reference {
        &self.reference
    }

    /// The plan of the last solved cycle.
    pub fn plan(&self) -> Option<&Plan> {
        self.has_plan.then_some(&self.plan)
    }

    /// Gain of the stage of the last factorisation.
    pub fn gain(&self, stage: usize) -> MatRef<'_, f64> {
        self.riccati.gain(stage)
    }

    /// The LQ problem of the last cycle.
    pub fn problem(&self) -> &LqProblem {
        &self.horizon.problem
    }

    /// Deviations from the nominal that solve the problem of the last cycle.
    pub fn solution(&self) -> &Trajectory {
        &self.solution
    }

    /// The constrained solve of the last cycle: its active rows and multipliers.
    pub fn constrained(&self) -> &ProjectedQp {
        &self.qp
    }

    /// State `(q, q̇)` predicted for the time the last command takes effect.
    pub fn predicted_state(&self) -> &[f64] {
        &self.predicted
    }

    /// Estimate from the last good measurement.
    pub fn estimate(&self) -> &Estimate {
        self.estimator.estimate()
    }

    /// What is believed of base and feet.
    pub fn estimator(&self) -> &Estimator {
        &self.estimator
    }

    /// Root mean square of the last innovation of the joint rates, rad/s.
    pub fn innovation_rate(&self) -> f64 {
        self.innovation_rate
    }

    /// What was chosen for it.
    pub fn config(&self) -> &ControllerConfig {
        &self.config
    }

    /// The model.
    pub fn model(&self) -> &ControllerModel {
        &self.model
    }
}
