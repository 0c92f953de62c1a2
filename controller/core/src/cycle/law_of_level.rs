//! The law a command carries on every level of the fallback ladder, and its way into the command.
//!
//! | level | torque | gain | reference |
//! |---|---|---|---|
//! | fresh solution, shifted plan | of the plan's stages, one segment each | of the first stage | the plan, moving; fresh: within the bounds of the pressure point |
//! | static LQR | that carries the home posture | of the infinite horizon | home posture |
//! | gravity hold | that carries the present posture | damping | present posture |
//! | damping only | 0 | damping | |
//! | zero torque | 0 | 0 | |

use delmpc_mechanics::inverse_dynamics::gravity_force_into;
use delmpc_messages::{FallbackLevel, LARGEST_EFFORT, PlantState};

use super::{Controller, to_ns};
use crate::config::ControllerKind;
use crate::estimator::Estimate;
use crate::feedback_law::{LawSegment, bound_by_pressure_point, write_law};
use crate::telling::state_estimate;
use delmpc_lq::kernels::gemv;

/// Part of effort over velocity limit that damps a joint on the last rungs.
const DAMPING_FRACTION: f64 = 0.1;
/// A stage of which less than this is left is not worth a segment.
const SHORTEST_SEGMENT_S: f64 = 1e-6;
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
        let mut start_ns = match self.last_state_ns {
            Some(last) => now_ns.max(last.saturating_add(to_ns(self.config.delay_s))),
            None => now_ns,
        };
        if level == FallbackLevel::FreshSolution && self.config.kind == ControllerKind::Mpc {
            // A plan that was prepared for a later time begins then; up to there the last command goes on.
            start_ns = start_ns.max(self.run_time_ns(self.plan.start_s));
        }
        self.command.state_sequence = self.last_sequence.max(u64::from(self.last_state_ns.is_some()));
        self.command.state_time_ns = self.last_state_ns.unwrap_or(state.time_ns);
        self.command.valid_from_ns = start_ns;
        self.command.valid_until_ns = start_ns.saturating_add(to_ns(self.config.command_life_s));
        self.tell_estimate();
        for level in LEVELS.into_iter().filter(|candidate| *candidate >= level) {
            self.form_law(level, self.run_time_s(start_ns));
            self.command.fallback_level = level as u32;
            self.tell_law(start_ns);
            if self.command.validate(self.model.joint_set_hash, n).is_ok() {
                if level > self.ladder.level() {
                    self.ladder.descend_to(level);
                }
                self.past_laws.push(self.run_time_s(start_ns), &self.law);
                return;
            }
        }
    }

    /// What is believed of base and feet goes along.
    fn tell_estimate(&mut self) {
        let Some(base) = self.estimator.base() else { return };
        let loaded = self.estimator.feet().iter().map(|foot| foot.loaded);
        self.command.estimate = state_estimate(base, loaded);
    }

    /// Writes the law out: in terms of the encoders, and of the gyroscope where the stance foot was levelled.
    fn tell_law(&mut self, start_ns: u64) {
        let joints = &self.model.message_joint;
        write_law(&self.law, joints, &mut self.command);
        self.command.imu_gain = Default::default();
        let since_s = start_ns.saturating_sub(self.command.state_time_ns) as f64 * 1e-9;
        if self.estimator.tell_law(&self.model, &self.law, since_s, &mut self.command).is_err() {
            // Never of a law of this model; what has been written holds for a foot that rests.
            return;
        }
        if let Some(robot) = &self.unloaded_robot {
            let Estimate { q, ground_lean, .. } = self.estimator.estimate();
            let level = self.estimator.told_by_gyroscope();
            robot.write(level, q, (*ground_lean).into(), joints, &mut self.command);
        }
    }

    /// The law of a level at a time of the run.
    fn form_law(&mut self, level: FallbackLevel, time_s: f64) {
        let effective = match (self.config.kind, level) {
            (ControllerKind::Off, _) => FallbackLevel::ZeroTorque,
            (ControllerKind::StaticLqr, FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan) => {
                FallbackLevel::StaticLqr
            }
            _ => level,
        };
        match effective {
            FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan => self.form_law_of_plan(level, time_s),
            FallbackLevel::StaticLqr => {
                self.law.copy_from(&self.static_law);
                self.keep_last_bounds(false);
                self.law.segments_mut().iter_mut().for_each(LawSegment::clamp);
            }
            FallbackLevel::GravityHold | FallbackLevel::DampingOnly | FallbackLevel::ZeroTorque => {
                self.form_passive_law(effective);
            }
        }
    }

    /// The stages of the plan from a time on, for as long as a command lives.
    fn form_law_of_plan(&mut self, level: FallbackLevel, time_s: f64) {
        let n = self.model.tree.dof();
        let Self { law, plan, .. } = self;
        let end_s = time_s + self.config.command_life_s;
        let (first, stages) = (plan.stage_at(time_s), plan.values.stages());
        let mut from_s = time_s;
        for stage in first..stages {
            if stage > first && from_s >= end_s {
                break;
            }
            let mut until_s = plan.start_s + plan.offsets()[stage + 1];
            if stage + 1 == stages {
                // What is beyond the plan goes on as it ends.
                until_s = until_s.max(from_s + self.config.period_s);
            }
            let length_s = until_s - from_s;
            if length_s < SHORTEST_SEGMENT_S {
                continue;
            }
            let segment = match from_s == time_s {
                true => Some(law.restart()),
                false => law.append(from_s - time_s),
            };
            let Some(segment) = segment else { break };
            segment.torque.copy_from_slice(plan.values.u(stage));
            plan.state_at(until_s, &mut self.scratch[..2 * n]);
            plan.state_at(from_s, &mut segment.reference);
            for j in 0..n {
                segment.acceleration[j] = (self.scratch[n + j] - segment.reference[n + j]) / length_s;
            }
            from_s = until_s;
        }
        // The factors may be those of a later start already.
        law.gain.copy_from(self.riccati.gain(plan.stage_after(time_s - self.factors_start_s)));
        self.bound_law();
        if level == FallbackLevel::FreshSolution {
            self.keep_pressure_point(first);
        } else {
            self.keep_last_bounds(true);
        }
        self.law.segments_mut().iter_mut().for_each(LawSegment::clamp);
        self.allow_for_means();
    }

    /// The servo's velocities are means over its last samples, so in a motion they are behind the reference by half of their time: without
    /// its part of the gain in the torque the law would brake or push for that.
    fn allow_for_means(&mut self) {
        let n = self.model.tree.dof();
        let samples = self.command.rate_samples.saturating_sub(1);
        let lag_s = 0.5 * f64::from(samples) * self.config.servo_period_s;
        let Self { law, scratch, .. } = self;
        let (segments, gain) = law.segments_and_gain();
        let missing = &mut scratch[..2 * n];
        for segment in segments {
            missing[..n].fill(0.0);
            for (missing, acceleration) in missing[n..].iter_mut().zip(&segment.acceleration) {
                *missing = lag_s * acceleration;
            }
            gemv(&mut segment.torque, faer::Accum::Add, gain, missing, 1.0);
        }
    }

    /// Narrows the bounds of all segments to what the pressure point allows in the first one, in the plan's stage `stage`: what the
    /// feedback may add to the torque planned now, it may add later.
    fn keep_pressure_point(&mut self, stage: usize) {
        let Some((first, later)) = self.law.segments_mut().split_first_mut() else { return };
        bound_by_pressure_point(&self.horizon, stage, &self.solution, &self.force_change, first);
        for (kept, now) in self.last_bounds.iter_mut().zip([&first.torque, &first.lower, &first.upper]) {
            kept.copy_from_slice(now);
        }
        for segment in later {
            for j in 0..first.torque.len() {
                let shift = segment.torque[j] - first.torque[j];
                segment.lower[j] = segment.lower[j].max(first.lower[j] + shift).min(segment.upper[j]);
                segment.upper[j] = segment.upper[j].min(first.upper[j] + shift).max(segment.lower[j]);
            }
        }
    }

    /// Narrows the bounds of all segments to what the pressure point left in the last fresh plan: a law without room for it must not take
    /// the place of one with.
    fn keep_last_bounds(&mut self, moves: bool) {
        let [torque, lower, upper] = &self.last_bounds;
        for segment in self.law.segments_mut() {
            for j in 0..torque.len() {
                let (least, most) = (segment.lower[j], segment.upper[j]);
                // A plan that moves on takes its room along; a posture held has the room there was.
                let shift = if moves { segment.torque[j] - torque[j] } else { 0.0 };
                segment.lower[j] = (lower[j] + shift.min(0.0)).clamp(least, most);
                segment.upper[j] = (upper[j] + shift.max(0.0)).clamp(least, most);
            }
        }
    }

    /// Bounds of all segments: what the joints can.
    fn bound_law(&mut self) {
        for segment in self.law.segments_mut() {
            for (j, limit) in self.model.limits.iter().enumerate() {
                let effort = limit.effort.min(LARGEST_EFFORT);
                (segment.lower[j], segment.upper[j]) = (-effort, effort);
            }
        }
    }

    /// A law that needs no plan: gravity torque and damping, damping, nothing.
    fn form_passive_law(&mut self, level: FallbackLevel) {
        let n = self.model.tree.dof();
        let law = self.law.restart();
        law.torque.fill(0.0);
        law.reference.fill(0.0);
        let Estimate { q, .. } = self.estimator.estimate();
        law.reference[..n].copy_from_slice(q);
        if level == FallbackLevel::GravityHold {
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
        self.law.gain.fill(0.0);
        if level != FallbackLevel::ZeroTorque {
            for (j, limit) in self.model.limits.iter().enumerate() {
                let damping = DAMPING_FRACTION * limit.effort / limit.velocity;
                self.law.gain[(j, n + j)] = if damping.is_finite() { -damping } else { -1.0 };
            }
        }
        self.bound_law();
        self.keep_last_bounds(false);
        self.law.segments_mut().iter_mut().for_each(LawSegment::clamp);
    }
}
