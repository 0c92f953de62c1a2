//! The law a command carries: the plan's torques and joints, the first gain, damping where there is no plan.

use delmpc_messages::{Command, FallbackLevel, LARGEST_EFFORT, MAX_FEET, MAX_JOINTS, PlantState};

use super::LeggedController;
use super::base_feedback::MOMENT_S;
use crate::config::ControllerKind;
use crate::feedback_law::{LawSegment, write_law};
use crate::telling::state_estimate;

/// Part of effort over velocity limit that damps a joint on the last levels.
const DAMPING_FRACTION: f64 = 0.1;

impl LeggedController {
    /// Forms the law of a level and writes it out; a law with a number that is not plausible gives way to one without torque.
    pub(super) fn write_command(&mut self, level: FallbackLevel, state: &PlantState, now_ns: u64) {
        let start_ns = match self.last_state_ns {
            Some(last) => now_ns.max(last.saturating_add(nanoseconds(self.config.delay_s))),
            None => now_ns,
        };
        let command = &mut self.command;
        command.state_sequence = self.last_sequence.max(u64::from(self.last_state_ns.is_some()));
        command.state_time_ns = self.last_state_ns.unwrap_or(state.time_ns);
        command.valid_from_ns = start_ns;
        command.valid_until_ns = start_ns.saturating_add(nanoseconds(self.config.command_life_s));
        self.tell_estimate();
        let joints = self.robot.model.tree.joint_count();
        for level in [level, FallbackLevel::DampingOnly, FallbackLevel::ZeroTorque] {
            self.form_law(level, self.run_time_s(start_ns));
            self.command.fallback_level = level as u32;
            let begin_s = self.run_time_s(start_ns);
            write(&self.law, &mut self.command);
            self.tell_base(begin_s);
            self.allow_for_means();
            let Self { command, light_feet, schedule, .. } = self;
            light_feet.write(|foot| schedule.stands(foot, begin_s), command);
            if command.validate(self.robot.joint_set_hash, joints).is_ok() {
                if level > self.ladder.level() {
                    self.ladder.descend_to(level);
                }
                return;
            }
        }
    }

    fn tell_estimate(&mut self) {
        if self.last_state_ns.is_some() {
            let loaded = self.sensing.feet().iter().map(|foot| foot.loaded);
            self.command.estimate = state_estimate(self.sensing.base(), loaded);
        }
    }

    /// The base's part of the law, where there is a gyroscope.
    fn tell_base(&mut self, begin_s: f64) {
        let (Some(angle), Some(last_ns)) = (self.imu_angle, self.last_state_ns) else { return };
        let since_s = begin_s - self.run_time_s(last_ns);
        self.plan.state_at(begin_s, &mut self.scratch);
        let stage = self.plan.stage_at(begin_s);
        let Self { robot, plan, sensing, schedule, base_feedback, command, scratch, .. } = self;
        let mut shares = [0.0; MAX_FEET];
        let mut row = 0;
        for (foot, shape) in robot.model.feet.iter().enumerate() {
            row += shape.contact().row_count();
            // A point rolls, rubs and bounces: where it is says less of the base than the plan does.
            if shape.is_flat() && schedule.stands(foot, begin_s) && sensing.feet()[foot].loaded {
                shares[foot] = plan.force(stage)[row - 1].max(0.0) / robot.model.weight_n();
            }
        }
        let feet = robot.model.feet.len();
        let measured = (&angle, sensing.base(), sensing.joints());
        if base_feedback.write(&robot.model, scratch, &shares[..feet], measured, since_s, command).is_err() {
            // Never of a plan of this model; the joints' columns hold for one cycle.
            command.imu_gain = Default::default();
        }
    }

    fn form_law(&mut self, level: FallbackLevel, time_s: f64) {
        let follows = matches!(level, FallbackLevel::FreshSolution | FallbackLevel::ShiftedPlan);
        match (self.config.kind, follows && self.has_plan) {
            (ControllerKind::Off, _) => self.form_passive_law(FallbackLevel::ZeroTorque),
            (_, true) => self.form_law_of_plan(time_s),
            (_, false) => self.form_passive_law(level),
        }
        for segment in self.law.segments_mut() {
            for (j, limit) in self.robot.model.limits.iter().enumerate() {
                let effort = limit.effort.min(LARGEST_EFFORT);
                (segment.lower[j], segment.upper[j]) = (-effort, effort);
            }
        }
        self.law.segments_mut().iter_mut().for_each(LawSegment::clamp);
    }

    /// The stages of the plan from a time on, for as long as a command lives.
    fn form_law_of_plan(&mut self, time_s: f64) {
        let Self { law, plan, scratch, later, base_feedback, robot, .. } = self;
        let joints = scratch.q.len();
        let mut segments = 0;
        let end_s = time_s + self.config.command_life_s;
        let (first, stages) = (plan.stage_at(time_s), plan.stages());
        let mut from_s = time_s;
        for stage in first..stages {
            if stage > first && from_s >= end_s {
                break;
            }
            let mut until_s = plan.times[stage + 1];
            if stage + 1 == stages {
                until_s = until_s.max(from_s + self.config.period_s);
            }
            let length_s = until_s - from_s;
            if length_s < 1e-6 {
                continue;
            }
            let segment = match from_s == time_s {
                true => Some(law.restart()),
                false => law.append(from_s - time_s),
            };
            let Some(segment) = segment else { break };
            segment.torque.copy_from_slice(plan.input(stage));
            plan.state_at(until_s, scratch);
            segment.acceleration.copy_from_slice(&scratch.rate);
            plan.state_at(from_s, scratch);
            segment.reference[..joints].copy_from_slice(&scratch.q);
            segment.reference[joints..].copy_from_slice(&scratch.rate);
            for j in 0..joints {
                segment.acceleration[j] = (segment.acceleration[j] - scratch.rate[j]) / length_s;
            }
            plan.state_at(from_s + MOMENT_S, later);
            // Never an error for states of this model; without its turning a segment has the last one's.
            let _ = base_feedback.take_turning(&robot.model.tree, segments, scratch, later);
            segments += 1;
            from_s = until_s;
        }
        let gain = self.riccati.gain(first);
        base_feedback.take_gain(gain);
        let nv = 6 + joints;
        for i in 0..joints {
            for j in 0..joints {
                law.gain[(i, j)] = gain[(i, 6 + j)];
                law.gain[(i, joints + j)] = gain[(i, nv + 6 + j)];
            }
        }
    }

    /// The servo's velocities are means over its last samples: in a motion they are behind the reference by half of their time.
    fn allow_for_means(&mut self) {
        let samples = self.command.rate_samples.saturating_sub(1);
        let lag_s = 0.5 * f64::from(samples) * self.config.servo_period_s;
        let Self { command, robot, .. } = self;
        let (gain, imu_gain) = (&command.gain, &command.imu_gain);
        for segment in &mut command.segments[..command.n_segments as usize] {
            for (i, limit) in robot.model.limits.iter().enumerate() {
                let on_rate = &gain[i][MAX_JOINTS..];
                let joints = on_rate.iter().zip(&segment.acceleration_ref).map(|(k, a)| k * a).sum::<f64>();
                let imu = imu_gain[i][3..].iter().zip(&segment.imu_acceleration_ref).map(|(k, a)| k * a);
                let effort = limit.effort.min(LARGEST_EFFORT);
                let torque = segment.torque[i] + lag_s * (joints + imu.sum::<f64>());
                segment.torque[i] = torque.clamp(-effort, effort);
            }
        }
    }

    /// The torque that carries the aim, with damping; damping; nothing.
    fn form_passive_law(&mut self, level: FallbackLevel) {
        let Self { law, reference, robot, measured, base_feedback, .. } = self;
        let joints = measured.q.len();
        let segment = law.restart();
        segment.torque.fill(0.0);
        segment.reference.fill(0.0);
        segment.reference[..joints].copy_from_slice(&measured.q);
        if level < FallbackLevel::DampingOnly {
            segment.torque.copy_from_slice(&reference.target(0).torque);
        }
        law.gain.fill(0.0);
        base_feedback.clear();
        if level != FallbackLevel::ZeroTorque {
            for (j, limit) in robot.model.limits.iter().enumerate() {
                let damping = DAMPING_FRACTION * limit.effort / limit.velocity;
                law.gain[(j, joints + j)] = if damping.is_finite() { -damping } else { -1.0 };
            }
        }
    }
}

/// The joints of a floating tree are in the order of the messages.
fn write(law: &crate::feedback_law::Law, command: &mut Command) {
    let mut order = [0; delmpc_messages::MAX_JOINTS];
    let joints = law.first().torque.len();
    for (j, joint) in order.iter_mut().enumerate() {
        *joint = j;
    }
    write_law(law, &order[..joints], command);
    command.imu_gain = Default::default();
}

fn nanoseconds(seconds: f64) -> u64 {
    libm::round(seconds * 1e9) as u64
}
