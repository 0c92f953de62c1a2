//! The servo between commands, and the plant's own watchdog.
//!
//! The servo applies the law of the latest command (`servo_law` of `delmpc_messages`: joints, inertial unit, load of the foot, velocities as
//! means) at the plant's rate, segment after segment of its plan when no other command comes. A dead controller cannot act, so the plant keeps the fallback ladder too:
//!
//! | level | rule | for |
//! |---|---|---|
//! | 0, 1, .. | the command's own level, while it is valid | until `valid_until` |
//! | 1 | the last command's gains about the end of its reference | `hold_gains` after it ran out |
//! | 2 | a static law about a posture, where one was given | `static_law` |
//! | 3 | the last feed-forward torque, stiffness and damping about the last reference | `gravity_hold` |
//! | 4 | damping only | `damping` |
//! | 5 | zero torque | |
//!
//! Before the first command the static law holds, if there is one; else nothing does. Levels 2 and below are left after a number
//! of good commands in a row.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use delmpc_messages::{Command, FallbackLevel, MessageError, RateMean, ServoReadings, Verdict};

use crate::error::ServoError;

/// `u = torque + gain [q - q_ref; q̇]`: a law that holds a posture.
#[derive(Clone, Debug, PartialEq)]
pub struct AffineLaw {
    /// Feed-forward torque.
    pub torque: Vec<f64>,
    /// The posture.
    pub position_ref: Vec<f64>,
    /// Row-major, joints x (2 joints): positions, then velocities.
    pub gain: Vec<f64>,
}

impl AffineLaw {
    /// `torque` at the posture `position`, with stiffness (N·m/rad) and damping (N·m·s/rad) per joint.
    pub fn joint_stiffness(torque: &[f64], position: &[f64], stiffness: &[f64], damping: &[f64]) -> Self {
        let n = torque.len();
        let mut gain = vec![0.0; 2 * n * n];
        for i in 0..n {
            gain[i * 2 * n + i] = -stiffness[i];
            gain[i * 2 * n + n + i] = -damping[i];
        }
        Self { torque: torque.to_vec(), position_ref: position.to_vec(), gain }
    }

    /// The torque at a measured state. O(n²), no allocation.
    pub fn torque_into(&self, position: &[f64], velocity: &[f64], torque: &mut [f64]) {
        let n = self.torque.len();
        for (i, out) in torque.iter_mut().enumerate() {
            let row = &self.gain[i * 2 * n..(i + 1) * 2 * n];
            let mut sum = self.torque[i];
            for j in 0..n {
                sum += row[j] * (position[j] - self.position_ref[j]) + row[n + j] * velocity[j];
            }
            *out = sum;
        }
    }

    fn check(&self, joints: usize) -> Result<(), ServoError> {
        for list in [&self.torque, &self.position_ref] {
            require_length("static law", list.len(), joints)?;
        }
        require_length("gain of the static law", self.gain.len(), 2 * joints * joints)
    }
}

/// How long each rung of the ladder holds, s.
#[derive(Clone, Debug, PartialEq)]
pub struct WatchdogConfig {
    /// Level 1.
    pub hold_gains: f64,
    /// Level 2 (skipped without a static law).
    pub static_law: f64,
    /// Level 3.
    pub gravity_hold: f64,
    /// Level 4.
    pub damping_only: f64,
    /// The law of level 2 and of the time before the first command.
    pub law: Option<AffineLaw>,
    /// Stiffness of level 3 per joint, N·m/rad; empty for none.
    pub stiffness: Vec<f64>,
    /// Damping of levels 3 and 4 per joint, N·m·s/rad; empty for none.
    pub damping: Vec<f64>,
    /// Good commands in a row before level 2 or below is left.
    pub good_commands: u32,
}

impl Default for WatchdogConfig {
    fn default() -> Self {
        Self {
            hold_gains: 1.0,
            static_law: 0.5,
            gravity_hold: 0.5,
            damping_only: 1.0,
            law: None,
            stiffness: Vec::new(),
            damping: Vec::new(),
            good_commands: 3,
        }
    }
}

impl WatchdogConfig {
    /// No watchdog: zero torque as soon as there is no valid command.
    pub fn zero_torque() -> Self {
        Self { hold_gains: 0.0, static_law: 0.0, gravity_hold: 0.0, damping_only: 0.0, ..Self::default() }
    }
}

/// Most commands between two that are taken. A controller at 1 kHz counts as far in two hours and a half, and whatever sequence is in force,
/// the next command of a controller that hears the plant is above it.
pub const LARGEST_JUMP: u64 = 10_000_000;
/// Longest time from the arrival of a command to the begin of its validity, ns.
pub const LONGEST_LEAD_NS: u64 = 20_000_000_000;

/// Why a command was not taken.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CommandRefused {
    /// The message is damaged, or for another robot.
    #[error(transparent)]
    Message(#[from] MessageError),
    /// Its sequence number is not larger than that of the command before.
    #[error("command {sequence} came after command {newest}")]
    OutOfOrder {
        /// Its sequence number.
        sequence: u64,
        /// The newest one taken.
        newest: u64,
    },
    /// Its sequence number is farther ahead than any controller can have counted.
    #[error(
        "command {sequence} came after command {newest}, more than {LARGEST_JUMP} ahead: a damaged number"
    )]
    JumpAhead {
        /// Its sequence number.
        sequence: u64,
        /// The newest one taken.
        newest: u64,
    },
    /// It is meant for a time that is too far away.
    #[error("command {sequence} is valid from {valid_from_ns} ns on and came at {now_ns} ns: too far ahead")]
    TooEarly {
        /// Its sequence number.
        sequence: u64,
        /// Begin of its validity, ns.
        valid_from_ns: u64,
        /// Plant time, ns.
        now_ns: u64,
    },
    /// It ran out before it came.
    #[error("command {sequence} was valid until {valid_until_ns} ns and came at {now_ns} ns")]
    Expired {
        /// Its sequence number.
        sequence: u64,
        /// End of its validity, ns.
        valid_until_ns: u64,
        /// Plant time, ns.
        now_ns: u64,
    },
}

fn require_length(quantity: &'static str, got: usize, expected: usize) -> Result<(), ServoError> {
    if got == expected { Ok(()) } else { Err(ServoError::Length { quantity, got, expected }) }
}

#[derive(Clone, Debug)]
struct Slot {
    command: Command,
    level: FallbackLevel,
    good: bool,
}

/// Servo and watchdog of all joints.
#[derive(Clone, Debug)]
pub struct Servo {
    joints: usize,
    joint_set_hash: u64,
    config: WatchdogConfig,
    active: Option<usize>,
    pending: Option<usize>,
    slots: Box<[Slot; 2]>,
    level: FallbackLevel,
    worst_level: FallbackLevel,
    good_in_a_row: u32,
    recovering: bool,
    refused: u64,
    taken: u64,
    newest_sequence: u64,
    rates: RateMean,
}

impl Servo {
    /// For `joints` joints with the given joint-set hash.
    ///
    /// # Errors
    /// [`ServoError`] for times out of range or lists of the wrong length.
    pub fn new(joints: usize, joint_set_hash: u64, config: WatchdogConfig) -> Result<Self, ServoError> {
        for time in [config.hold_gains, config.static_law, config.gravity_hold, config.damping_only] {
            if !(0.0..1e9).contains(&time) {
                return Err(ServoError::Time { seconds: time });
            }
        }
        let mut config = config;
        for list in [&mut config.stiffness, &mut config.damping] {
            if list.is_empty() {
                list.resize(joints, 0.0);
            }
            require_length("stiffness or damping of the watchdog", list.len(), joints)?;
        }
        if let Some(law) = &config.law {
            law.check(joints)?;
        }
        let command = Command::new(0, joint_set_hash, joints as u32);
        let slot = Slot { command, level: FallbackLevel::ZeroTorque, good: false };
        let level = if config.law.is_some() { FallbackLevel::StaticLqr } else { FallbackLevel::ZeroTorque };
        Ok(Self {
            joints,
            joint_set_hash,
            config,
            active: None,
            pending: None,
            slots: Box::new([slot.clone(), slot]),
            level,
            worst_level: FallbackLevel::FreshSolution,
            good_in_a_row: 0,
            recovering: false,
            refused: 0,
            taken: 0,
            newest_sequence: 0,
            rates: RateMean::default(),
        })
    }

    /// Takes a command. O(n²), no allocation.
    ///
    /// # Errors
    /// [`CommandRefused`]; the command before stays in force.
    pub fn accept(&mut self, command: &Command, now_ns: u64) -> Result<(), CommandRefused> {
        let checked = self.check(command, now_ns);
        if checked.is_err() {
            self.refused += 1;
            self.good_in_a_row = 0;
            return checked;
        }
        self.taken += 1;
        self.newest_sequence = command.header.sequence;
        let at = match (self.active, self.pending) {
            (_, Some(pending)) => pending,
            (Some(active), None) => 1 - active,
            (None, None) => 0,
        };
        let slot = &mut self.slots[at];
        slot.command = *command;
        slot.level = command.fallback_level().unwrap_or(FallbackLevel::ZeroTorque);
        slot.good = command.verdict() == Some(Verdict::Ok);
        self.good_in_a_row = if slot.good { self.good_in_a_row.saturating_add(1) } else { 0 };
        self.pending = Some(at);
        self.promote(now_ns);
        Ok(())
    }

    fn check(&self, command: &Command, now_ns: u64) -> Result<(), CommandRefused> {
        command.validate(self.joint_set_hash, self.joints)?;
        let sequence = command.header.sequence;
        let (valid_from_ns, newest) = (command.valid_from_ns, self.newest_sequence);
        // A command that waits for its time, whatever its number, does not keep out one that acts as soon.
        let overtakes =
            self.pending.is_some_and(|at| valid_from_ns <= self.slots[at].command.valid_from_ns.max(now_ns));
        if sequence <= self.applied_sequence() || (sequence <= newest && !overtakes) {
            return Err(CommandRefused::OutOfOrder { sequence, newest });
        }
        if sequence.saturating_sub(newest) > LARGEST_JUMP {
            return Err(CommandRefused::JumpAhead { sequence, newest });
        }
        if valid_from_ns.saturating_sub(now_ns) > LONGEST_LEAD_NS {
            return Err(CommandRefused::TooEarly { sequence, valid_from_ns, now_ns });
        }
        let valid_until_ns = command.valid_until_ns;
        if valid_until_ns <= now_ns {
            return Err(CommandRefused::Expired { sequence, valid_until_ns, now_ns });
        }
        Ok(())
    }

    fn promote(&mut self, now_ns: u64) {
        if let Some(pending) = self.pending
            && self.slots[pending].command.valid_from_ns <= now_ns
        {
            self.active = Some(pending);
            self.pending = None;
        }
    }

    /// The torque asked for at plant time `now_ns`, for what is measured then. O(n²), no allocation.
    pub fn torque_into(&mut self, now_ns: u64, readings: &ServoReadings<'_>, torque: &mut [f64]) {
        let ServoReadings { position, velocity, .. } = *readings;
        let joints = self.joints.min(velocity.len());
        let samples = self.active.map_or(1, |at| self.slots[at].command.rate_samples);
        let rate = readings.imu.map_or([0.0; 3], |(_, rate)| rate);
        let (velocities, rate) = self.rates.take(velocity, &rate, samples);
        let (velocities, rate) = (*velocities, *rate);
        let smooth = ServoReadings {
            velocity: &velocities[..joints],
            imu: readings.imu.map(|(angle, _)| (angle, rate)),
            ..*readings
        };
        self.promote(now_ns);
        self.level = self.level_at(now_ns);
        if self.active.is_some() {
            self.worst_level = self.worst_level.max(self.level);
        }
        let slot = self.active.map(|at| &self.slots[at]);
        match (self.level, slot, &self.config.law) {
            (FallbackLevel::ZeroTorque, None, _) => torque.fill(0.0),
            (level, Some(slot), _) if self.follows(level, now_ns) => {
                if slot.command.torque_into(now_ns, &smooth, torque).is_err() {
                    // Of another number of joints than this servo: no torque is right for it.
                    torque.fill(0.0);
                }
            }
            (FallbackLevel::StaticLqr, _, Some(law)) => law.torque_into(position, velocity, torque),
            (FallbackLevel::GravityHold, Some(slot), _) => {
                let (last, _) = slot.command.segment_at(slot.command.valid_until_ns);
                for (i, out) in torque.iter_mut().enumerate() {
                    *out = last.torque[i]
                        - self.config.stiffness[i] * (position[i] - last.position_ref[i])
                        - self.config.damping[i] * velocity[i];
                }
            }
            (FallbackLevel::DampingOnly | FallbackLevel::GravityHold, _, _) => {
                for (i, out) in torque.iter_mut().enumerate() {
                    *out = -self.config.damping[i] * velocity[i];
                }
            }
            _ => torque.fill(0.0),
        }
    }

    /// Whether the active command's own law is in force.
    fn follows(&self, level: FallbackLevel, now_ns: u64) -> bool {
        let valid = self.active.is_some_and(|at| now_ns < self.slots[at].command.valid_until_ns);
        (valid && !self.recovering) || level == FallbackLevel::ShiftedPlan
    }

    fn level_at(&mut self, now_ns: u64) -> FallbackLevel {
        let Some(active) = self.active else {
            return if self.config.law.is_some() {
                FallbackLevel::StaticLqr
            } else {
                FallbackLevel::ZeroTorque
            };
        };
        let slot = &self.slots[active];
        let valid_until_ns = slot.command.valid_until_ns;
        if now_ns < valid_until_ns {
            if self.recovering && self.good_in_a_row < self.config.good_commands {
                return self.level;
            }
            self.recovering = false;
            return slot.level;
        }
        let mut left = now_ns.saturating_sub(valid_until_ns) as f64 * 1e-9;
        let rungs = [
            (FallbackLevel::ShiftedPlan, self.config.hold_gains),
            (FallbackLevel::StaticLqr, if self.config.law.is_some() { self.config.static_law } else { 0.0 }),
            (FallbackLevel::GravityHold, self.config.gravity_hold),
            (FallbackLevel::DampingOnly, self.config.damping_only),
        ];
        let mut level = FallbackLevel::ZeroTorque;
        for (rung, time) in rungs {
            if left < time {
                level = rung;
                break;
            }
            left -= time;
        }
        // Once down, only good commands lead up again.
        let floor = if self.recovering { self.level } else { level };
        if level > FallbackLevel::ShiftedPlan {
            self.recovering = true;
            self.good_in_a_row = 0;
        }
        level.max(floor)
    }

    /// The level of the last torque.
    pub fn level(&self) -> FallbackLevel {
        self.level
    }

    /// The worst level since the first command was taken.
    pub fn worst_level(&self) -> FallbackLevel {
        self.worst_level
    }

    /// Sequence of the command in force, 0 for none.
    pub fn applied_sequence(&self) -> u64 {
        self.active.map_or(0, |at| self.slots[at].command.header.sequence)
    }

    /// Whether the last torque was the watchdog's, not a valid command's.
    pub fn on_watchdog(&self, now_ns: u64) -> bool {
        self.recovering || self.active.is_none_or(|at| now_ns >= self.slots[at].command.valid_until_ns)
    }

    /// Commands taken and refused so far.
    pub fn counts(&self) -> (u64, u64) {
        (self.taken, self.refused)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use delmpc_messages::MAX_JOINTS;

    const MS: u64 = 1_000_000;

    fn command(sequence: u64, from: u64, until: u64, torque: f64) -> Command {
        let mut command = Command::new(1, 9, 2);
        command.header.sequence = sequence;
        command.valid_from_ns = from;
        command.valid_until_ns = until;
        command.fallback_level = FallbackLevel::FreshSolution as u32;
        command.segments[0].torque[0] = torque;
        command.gain[0][0] = -10.0;
        command.gain[1][MAX_JOINTS + 1] = -2.0;
        command
    }

    fn servo(law: bool) -> Servo {
        let law = law.then(|| AffineLaw::joint_stiffness(&[0.5, 0.0], &[0.0; 2], &[1.0; 2], &[0.0; 2]));
        let config = WatchdogConfig {
            hold_gains: 0.01,
            static_law: 0.02,
            gravity_hold: 0.03,
            damping_only: 0.04,
            law,
            stiffness: vec![4.0; 2],
            damping: vec![3.0; 2],
            good_commands: 2,
        };
        Servo::new(2, 9, config).unwrap()
    }

    fn torque(servo: &mut Servo, now: u64) -> [f64; 2] {
        let mut out = [f64::NAN; 2];
        servo.torque_into(now, &ServoReadings::joints(&[0.1, 0.2], &[1.0, 1.0]), &mut out);
        out
    }

    #[test]
    fn a_command_is_an_affine_law_between_its_times() {
        let mut servo = servo(false);
        assert_eq!(torque(&mut servo, 0), [0.0; 2]);
        servo.accept(&command(1, 2 * MS, 9 * MS, 7.0), 0).unwrap();
        assert_eq!(torque(&mut servo, MS), [0.0; 2]);
        assert_eq!(torque(&mut servo, 2 * MS), [6.0, -2.0]);
        assert_eq!((servo.level(), servo.applied_sequence()), (FallbackLevel::FreshSolution, 1));
        // A later one waits for its time; until then the old one acts.
        servo.accept(&command(2, 5 * MS, 9 * MS, 3.0), 3 * MS).unwrap();
        assert_eq!(torque(&mut servo, 4 * MS), [6.0, -2.0]);
        assert_eq!(torque(&mut servo, 5 * MS), [2.0, -2.0]);
    }

    #[test]
    fn the_ladder_is_climbed_down_rung_by_rung() {
        let mut servo = servo(true);
        assert_eq!(torque(&mut servo, 0), [0.4, -0.2]);
        assert_eq!(servo.worst_level(), FallbackLevel::FreshSolution);
        servo.accept(&command(1, 0, 5 * MS, 7.0), 0).unwrap();
        let expected = [
            (4, FallbackLevel::FreshSolution, [6.0, -2.0]),
            (5, FallbackLevel::ShiftedPlan, [6.0, -2.0]),
            (14, FallbackLevel::ShiftedPlan, [6.0, -2.0]),
            (15, FallbackLevel::StaticLqr, [0.4, -0.2]),
            (35, FallbackLevel::GravityHold, [7.0 - 0.4 - 3.0, -0.8 - 3.0]),
            (65, FallbackLevel::DampingOnly, [-3.0, -3.0]),
            (105, FallbackLevel::ZeroTorque, [0.0, 0.0]),
            (1000, FallbackLevel::ZeroTorque, [0.0, 0.0]),
        ];
        for (ms, level, out) in expected {
            let got = torque(&mut servo, ms * MS);
            assert!((got[0] - out[0]).abs() + (got[1] - out[1]).abs() < 1e-12, "{ms} ms: {got:?}");
            assert_eq!(servo.level(), level, "{ms} ms");
        }
        assert!(servo.on_watchdog(1000 * MS));
        assert_eq!(servo.worst_level(), FallbackLevel::ZeroTorque);
    }

    #[test]
    fn deep_rungs_are_left_after_good_commands_in_a_row() {
        let mut servo = servo(false);
        servo.accept(&command(1, 0, 5 * MS, 7.0), 0).unwrap();
        torque(&mut servo, 60 * MS);
        assert_eq!(servo.level(), FallbackLevel::DampingOnly);
        servo.accept(&command(2, 60 * MS, 90 * MS, 1.0), 61 * MS).unwrap();
        torque(&mut servo, 61 * MS);
        assert_eq!(servo.level(), FallbackLevel::DampingOnly);
        servo.accept(&command(3, 60 * MS, 90 * MS, 1.0), 62 * MS).unwrap();
        assert_eq!(torque(&mut servo, 62 * MS), [0.0, -2.0]);
        assert_eq!(servo.level(), FallbackLevel::FreshSolution);
        assert!(!servo.on_watchdog(62 * MS));
        // The first rung is left at once.
        torque(&mut servo, 95 * MS);
        assert_eq!(servo.level(), FallbackLevel::ShiftedPlan);
        servo.accept(&command(4, 90 * MS, 120 * MS, 1.0), 96 * MS).unwrap();
        torque(&mut servo, 96 * MS);
        assert_eq!(servo.level(), FallbackLevel::FreshSolution);
    }

    #[test]
    fn what_is_stale_damaged_or_foreign_is_refused_and_counted() {
        let mut servo = servo(false);
        servo.accept(&command(5, 0, 5 * MS, 7.0), 0).unwrap();
        let refused = [
            (command(5, 0, 5 * MS, 7.0), 0),
            (command(4, 0, 5 * MS, 7.0), 0),
            (command(6, 0, 5 * MS, 7.0), 5 * MS),
            (command(7, 0, 5 * MS, f64::NAN), 0),
            (Command::new(1, 8, 2), 0),
            (Command::new(1, 9, 3), 0),
        ];
        for (command, now) in &refused {
            assert!(servo.accept(command, *now).is_err());
        }
        assert_eq!(servo.counts(), (1, 6));
        assert_eq!(torque(&mut servo, MS), [6.0, -2.0]);
    }

    #[test]
    fn a_hostile_command_owns_nothing_and_the_next_good_one_acts() {
        let hour = 3600 * 1000 * MS;
        let hostile = |change: fn(&mut Command)| {
            let mut hostile = command(2, 0, 5 * MS, 99.0);
            change(&mut hostile);
            hostile
        };
        let refused: [fn(&mut Command); 7] = [
            |c| (c.header.sequence, c.valid_until_ns) = (u64::MAX, u64::MAX),
            |c| c.header.sequence = u64::MAX,
            |c| c.header.sequence = 1 << 40,
            |c| c.valid_until_ns = u64::MAX,
            |c| (c.valid_from_ns, c.valid_until_ns) = (u64::MAX, u64::MAX),
            |c| c.valid_until_ns = 3600 * 1000 * MS,
            |c| (c.valid_from_ns, c.valid_until_ns) = (3600 * 1000 * MS, 3600 * 1000 * MS + 5 * MS),
        ];
        for change in refused {
            let mut servo = servo(false);
            servo.accept(&command(1, 0, 5 * MS, 7.0), 0).unwrap();
            assert!(servo.accept(&hostile(change), MS).is_err());
            assert_eq!(torque(&mut servo, 2 * MS), [6.0, -2.0]);
            servo.accept(&command(2, 0, 5 * MS, 3.0), 3 * MS).unwrap();
            assert_eq!(torque(&mut servo, 3 * MS), [2.0, -2.0]);
            assert_eq!(torque(&mut servo, hour), [0.0; 2]);
        }
        // Within what a controller might do: one that waits, with a number far ahead.
        let mut servo = servo(false);
        servo.accept(&command(1, 0, 5 * MS, 7.0), 0).unwrap();
        servo.accept(&command(1_000_000, 9_000 * MS, 9_005 * MS, 99.0), MS).unwrap();
        servo.accept(&command(2, 2 * MS, 7 * MS, 3.0), 2 * MS).unwrap();
        assert_eq!(torque(&mut servo, 2 * MS), [2.0, -2.0]);
        // One that waits for the same time, with the number the next good one has.
        let mut waiting = super::tests::servo(false);
        waiting.accept(&command(1, 5 * MS, 15 * MS, 99.0), 0).unwrap();
        waiting.accept(&command(1, 5 * MS, 15 * MS, 3.0), 4 * MS).unwrap();
        // Or for a time just over, when nobody has asked for a torque since.
        waiting.accept(&command(1, 6 * MS, 15 * MS, 3.0), 6 * MS).unwrap();
        assert_eq!(torque(&mut waiting, 6 * MS), [2.0, -2.0]);
        // One that acts at once: the state says which one it was, and the next one is above it.
        servo.accept(&command(2_000_000, 0, 9_000 * MS, 99.0), 3 * MS).unwrap();
        servo.accept(&command(servo.applied_sequence() + 1, 0, 9 * MS, 3.0), 4 * MS).unwrap();
        assert_eq!(torque(&mut servo, 4 * MS), [2.0, -2.0]);
    }

    #[test]
    fn without_watchdog_a_lost_command_is_zero_torque() {
        let mut servo = Servo::new(2, 9, WatchdogConfig::zero_torque()).unwrap();
        servo.accept(&command(1, 0, 5 * MS, 7.0), 0).unwrap();
        assert_eq!(torque(&mut servo, 5 * MS), [0.0; 2]);
        assert_eq!(servo.level(), FallbackLevel::ZeroTorque);
    }
}
