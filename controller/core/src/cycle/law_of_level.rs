//! The law a command carries on every level of the fallback ladder, and its way into the command.
//!
//! | level | torque | gain | reference |
//! |---|---|---|---|
//! | fresh solution, shifted plan | of the plan's stage | of the stage | the plan, moving; fresh: within the bounds of the pressure point |
//! | static LQR | that carries the home posture | of the infinite horizon | home posture |
//! | gravity hold | that carries the present posture | damping | present posture |
//! | damping only | 0 | damping | |
//! | zero torque | 0 | 0 | |

use delmpc_mechanics::inverse_dynamics::gravity_force_into;
use delmpc_messages::{FallbackLevel, LARGEST_EFFORT, PlantState};

use super::{Controller, to_ns};
use crate::config::ControllerKind;
use crate::estimator::Estimate;
use crate::feedback_law::{bound_by_pressure_point, write_law};

/// Part of effort over velocity limit that damps a joint on the last rungs.
const DAMPING_FRACTION: f64 = 0.1;
/// From the best to the last.
const LEVELS: [FallbackLevel; 6] = [
    FallbackLevel::FreshSolution,
    FallbackLevel::ShiftedPlan,
    FallbackLevel::StaticLqr,
    FallbackLevel::GravityHold,
    FallbackLevel::DampingOnly,
    FallbackLevel::ZeroTorque,
];

impl Controller {
    /// Forms the law of a level and writes it out; a law with a number that is not plausible gives way to the next level.
    pub(super) fn write_command(&mut self, level: FallbackLevel, state: &PlantState, now_ns: u64) {
        let n = self.model.tree.dof();
        let start_ns = match self.last_state_ns {
            Some(last) => now_ns.max(last + to_ns(self.config.delay_s)),
            None => now_ns,
        };
        self.command.state_sequence = self.last_sequence.max(u64::from(self.last_state_ns.is_some()));
        self.command.state_time_ns = self.last_state_ns.unwrap_or(state.time_ns);
        self.command.valid_from_ns = start_ns;
        self.command.valid_until_ns = start_ns + to_ns(self.config.command_life_s);
        for level in LEVELS.into_iter().filter(|candidate| *candidate >= level) {
            self.form_law(level, self.run_time_s(start_ns));
            self.command.fallback_level = level as u32;
            write_law(&self.law, &self.model.message_joint, &mut self.command);
            if self.command.validate(self.model.joint_set_hash, n).is_ok() {
                if level > self.ladder.level() {
                    self.ladder.descend_to(level);
                }
                self.past_laws.push(self.run_time_s(start_ns), &self.law);
                return;
            }
        }
    }

    /// The law of a level at a time of the run.
    fn form_law(&mut self, level: FallbackLevel, time_s: f64) {
        let n = self.model.tree.dof();
        let law = &mut self.law;
        for (j, limit) in self.model.limits.iter().enumerate() {
            let effort = limit.effort.min(LARGEST_EFFORT);
            (law.lower[j], law.upper[j]) = (-effort, effort);
        }
        law.acceleration.fill(0.0);
        let effective = match (self.config.kind, level) {
            (ControllerKind::Off, _) => FallbackLevel::ZeroTorque,
            (ControllerKind::StaticLqr, FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan) => {
                FallbackLevel::StaticLqr
            }
            _ => level,
        };
        match effective {
            FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan => {
                let stage = self.plan.stage_at(time_s);
                law.torque.copy_from_slice(self.plan.values.u(stage));
                // The law holds for a period, over which its reference goes from the plan's rates to the plan's rates.
                let period_s = self.config.period_s;
                self.plan.state_at(time_s + period_s, &mut self.scratch[..2 * n]);
                self.plan.state_at(time_s, &mut law.reference);
                for j in 0..n {
                    law.acceleration[j] = (self.scratch[n + j] - law.reference[n + j]) / period_s;
                }
                // The factors may be those of a later start already.
                let factors_stage = self.plan.stage_after(time_s - self.factors_start_s);
                law.gain.copy_from(self.riccati.gain(factors_stage));
                if level == FallbackLevel::FreshSolution {
                    bound_by_pressure_point(&self.horizon, stage, &self.solution, &self.force_change, law);
                }
            }
            FallbackLevel::StaticLqr => {
                law.torque.copy_from_slice(&self.static_law.torque);
                law.reference.copy_from_slice(&self.static_law.reference);
                law.gain.copy_from(&self.static_law.gain);
            }
            FallbackLevel::GravityHold | FallbackLevel::DampingOnly | FallbackLevel::ZeroTorque => {
                law.torque.fill(0.0);
                law.reference.fill(0.0);
                law.gain.fill(0.0);
                let Estimate { q, .. } = self.estimator.estimate();
                law.reference[..n].copy_from_slice(q);
                if effective != FallbackLevel::ZeroTorque {
                    for (j, limit) in self.model.limits.iter().enumerate() {
                        let damping = DAMPING_FRACTION * limit.effort / limit.velocity;
                        law.gain[(j, n + j)] = if damping.is_finite() { -damping } else { -1.0 };
                    }
                }
                if effective == FallbackLevel::GravityHold {
                    self.scratch[..n].fill(0.0);
                    let node = &mut self.node;
                    let held = node.update(&self.model.tree, q, &self.scratch[..n]).and_then(|()| {
                        let kinematics = node.kinematics();
                        gravity_force_into(&self.model.tree, kinematics, &mut self.gravity, &mut law.torque)
                    });
                    if held.is_err() {
                        law.torque.fill(0.0);
                    }
                }
            }
        }
        for (j, u) in law.torque.iter_mut().enumerate() {
            *u = u.max(law.lower[j]).min(law.upper[j]);
        }
    }
}
