//! What is chosen for a controller: times, weights, limits.

use alloc::vec::Vec;

pub use delmpc_horizon::limits::ConstraintConfig;
use delmpc_messages::LONGEST_VALIDITY_NS;

use crate::errors::ControlError;
use crate::fallback::FallbackConfig;
use crate::reference::Reach;
use crate::tasks::TaskWeights;
use delmpc_lq::projected_qp::ProjectedQpOptions;

/// Which law controls.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ControllerKind {
    /// Model-predictive control.
    #[default]
    Mpc,
    /// A fixed LQR about the home posture; torques are clamped by the plant. The baseline.
    StaticLqr,
    /// No torque.
    Off,
}

/// Some stages of equal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageBlock {
    /// How many.
    pub count: usize,
    /// Length of each, s.
    pub seconds: f64,
}

/// Everything that is chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct ControllerConfig {
    /// Which law.
    pub kind: ControllerKind,
    /// Time between cycles, s.
    pub period_s: f64,
    /// Time between two evaluations of the command's feedback law in the plant, s.
    pub servo_period_s: f64,
    /// From the time of a measurement to the time its command takes effect, s.
    pub delay_s: f64,
    /// The horizon, fine stages first.
    pub stages: Vec<StageBlock>,
    /// Weights of the tasks.
    pub weights: TaskWeights,
    /// Constraints.
    pub constraints: ConstraintConfig,
    /// The constrained QP.
    pub qp: ProjectedQpOptions,
    /// A reach, if any.
    pub reach: Option<Reach>,
    /// When to fall back.
    pub fallback: FallbackConfig,
    /// Oldest measurement that is used, s.
    pub max_state_age_s: f64,
    /// How long a command may be applied, s.
    pub command_life_s: f64,
    /// Time a cycle may take before it is called late, s.
    pub budget_s: f64,
    /// Time in which the mass centre is moved to where the measured pressure point says it should be, s; 0: never.
    pub trim_s: f64,
    /// Innovation of the joint rates (root mean square over joints, rad/s) that is called a model mismatch when it lasts.
    pub mismatch_rate: f64,
}

impl Default for ControllerConfig {
    /// 200 Hz, one cycle of delay, 20 stages over 1 s.
    fn default() -> Self {
        Self {
            kind: ControllerKind::Mpc,
            period_s: 0.005,
            servo_period_s: 0.001,
            delay_s: 0.005,
            stages: Self::stages_for(1.0, 20, 0.005),
            weights: TaskWeights::default(),
            constraints: ConstraintConfig::default(),
            qp: ProjectedQpOptions::default(),
            reach: None,
            fallback: FallbackConfig::default(),
            max_state_age_s: 0.05,
            command_life_s: 0.1,
            budget_s: 0.005,
            trim_s: 1.0,
            mismatch_rate: 1.0,
        }
    }
}

impl ControllerConfig {
    /// Stage lengths for a horizon of `horizon_s` in `count` stages: the first one as long as its torque is held, a period; then about
    /// a quarter fine (10 ms in a horizon of 1 s), a quarter twice as long, the rest equal and coarse.
    pub fn stages_for(horizon_s: f64, count: usize, period_s: f64) -> Vec<StageBlock> {
        let (fine, middle) = ((count * 3 / 10).saturating_sub(1), count / 4);
        let coarse = count.saturating_sub(1 + fine + middle).max(1);
        let unit = horizon_s;
        let first = period_s.min(0.5 * horizon_s);
        let rest = (horizon_s - first - unit * (0.01 * fine as f64 + 0.02 * middle as f64)).max(0.1 * unit);
        let blocks = [
            StageBlock { count: 1, seconds: first },
            StageBlock { count: fine, seconds: 0.01 * unit },
            StageBlock { count: middle, seconds: 0.02 * unit },
            StageBlock { count: coarse, seconds: rest / coarse as f64 },
        ];
        blocks.into_iter().filter(|block| block.count > 0).collect()
    }

    /// Length of every stage, s.
    pub fn stage_lengths(&self) -> Vec<f64> {
        self.stages.iter().flat_map(|block| core::iter::repeat_n(block.seconds, block.count)).collect()
    }

    /// Checks every number.
    ///
    /// # Errors
    /// The first one found unusable.
    pub fn check(&self) -> Result<(), ControlError> {
        let positive = |quantity, value: f64| {
            if value.is_finite() && value > 0.0 {
                Ok(())
            } else {
                Err(ControlError::Value { quantity, index: 0, value, rule: "must be positive and finite" })
            }
        };
        let not_negative = |quantity, value: f64| {
            if value.is_finite() && value >= 0.0 {
                Ok(())
            } else {
                Err(ControlError::Value {
                    quantity,
                    index: 0,
                    value,
                    rule: "must be finite and not negative",
                })
            }
        };
        positive("period", self.period_s)?;
        positive("servo period", self.servo_period_s)?;
        not_negative("delay", self.delay_s)?;
        not_negative("trim time", self.trim_s)?;
        positive("state age", self.max_state_age_s)?;
        positive("command life", self.command_life_s)?;
        let longest_s = LONGEST_VALIDITY_NS as f64 * 1e-9;
        if self.command_life_s > longest_s {
            let (quantity, value) = ("command life", self.command_life_s);
            return Err(ControlError::Value { quantity, index: 0, value, rule: "must be at most 20 s" });
        }
        positive("cycle budget", self.budget_s)?;
        positive("mismatch rate", self.mismatch_rate)?;
        let lengths = self.stage_lengths();
        if lengths.is_empty() || lengths.len() > 200 {
            let value = lengths.len() as f64;
            return Err(ControlError::Value {
                quantity: "stages",
                index: 0,
                value,
                rule: "must be 1 to 200",
            });
        }
        for (index, &value) in lengths.iter().enumerate() {
            if !(value.is_finite() && value > 0.0 && value <= 0.2) {
                let rule = "must be positive and at most 0.2 s";
                return Err(ControlError::Value { quantity: "stage length", index, value, rule });
            }
        }
        let c = &self.constraints;
        positive("torque fraction", c.torque_fraction)?;
        positive("contact penalty", c.contact_penalty)?;
        positive("position penalty", c.position_penalty)?;
        positive("velocity penalty", c.velocity_penalty)?;
        not_negative("pressure point margin", c.cop_margin_m)?;
        not_negative("least normal force", c.min_force_fraction)?;
        let w = &self.weights;
        for value in [w.posture, w.joint_speed, w.hand, w.hand_velocity, w.swing_foot_rotation]
            .into_iter()
            .chain(w.com)
            .chain(w.com_velocity)
            .chain(w.spin)
            .chain(w.swing_foot)
        {
            not_negative("task weight", value)?;
        }
        positive("torque weight", w.torque)?;
        if let Some(reach) = &self.reach {
            positive("reach deadline", reach.deadline_s)?;
            positive("reach return", reach.return_s)?;
            not_negative("reach hold", reach.hold_s)?;
            for value in reach.ball_m.into_iter().chain([reach.start_s]) {
                not_negative("reach", value.abs())?;
            }
        }
        let qp = &self.qp;
        if qp.capacity == 0 || qp.rows_per_round == 0 || qp.max_rounds == 0 {
            let rule = "needs room for rows, rows per round and rounds";
            return Err(ControlError::Value { quantity: "QP", index: 0, value: 0.0, rule });
        }
        positive("QP tolerance", qp.tolerance)
    }
}
