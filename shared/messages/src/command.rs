//! Controller to plant: torque, feedback gain, reference point, and how the cycle went.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::header::message;
use crate::{
    ConstraintKind, CycleReport, Header, LARGEST_COORDINATE, LARGEST_EFFORT, LONGEST_VALIDITY_NS, MAX_JOINTS,
    Message, MessageError, check,
};

/// Capacity for the segments of a [`Command`].
pub const MAX_SEGMENTS: usize = 8;

/// Feed-forward, reference and bounds of a [`Command`] over a part of its time: up to the next segment, the last one to the end.
///
/// A segment is one stage of the plan. The reference moves with constant acceleration from where it is at `begin_ns`, so that a robot
/// on its way is not held back by where it was.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Segment/v1"))]
pub struct Segment {
    /// When it begins, after `valid_from_ns` of the command (ns); 0 for the first one.
    pub begin_ns: u64,
    /// Feed-forward joint torque at the reference point (N m or N).
    pub torque: [f64; MAX_JOINTS],
    /// Least joint torque (N m or N).
    pub torque_lower: [f64; MAX_JOINTS],
    /// Largest joint torque (N m or N).
    pub torque_upper: [f64; MAX_JOINTS],
    /// Reference joint position at `begin_ns` (rad or m).
    pub position_ref: [f64; MAX_JOINTS],
    /// Reference joint velocity at `begin_ns` (rad/s or m/s).
    pub velocity_ref: [f64; MAX_JOINTS],
    /// Reference joint acceleration (rad/s² or m/s²).
    pub acceleration_ref: [f64; MAX_JOINTS],
}

/// The answer to one [`crate::PlantState`]: an affine feedback law along a piece of the plan.
///
/// The plant applies, at its own rate, `u = torque + gain [q - q_ref(t); q_dot - q_dot_ref(t)]` between `torque_lower`
/// and `torque_upper` of the segment in force ([`Self::torque_into`]), then its limits. A command is meant for the time up to the next
/// one, mostly within its first segment. The segments after that are what the controller would do if no other came: a torque that is
/// right for 5 ms throws the robot over when it is held for 20, and commands do come late. The bounds keep what the feedback adds
/// between two commands within what the controller found admissible: those of the stance ankle keep the pressure point in the sole
/// while the robot is being pushed.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Command/v3"))]
pub struct Command {
    /// Type, joint set, run, sequence.
    pub header: Header,
    /// Sequence of the state this command answers; 0: none arrived.
    pub state_sequence: u64,
    /// Time of that state, by the plant's clock (ns).
    pub state_time_ns: u64,
    /// First time at which the command may be applied, by the plant's clock (ns).
    pub valid_from_ns: u64,
    /// Time from which on it may no longer be applied, by the plant's clock (ns).
    pub valid_until_ns: u64,
    /// Joints in use, the first ones of each array.
    pub n_joints: u32,
    /// Outcome of the cycle: [`Verdict`].
    pub verdict: u32,
    /// Rung of the fallback ladder that produced the torque: [`FallbackLevel`].
    pub fallback_level: u32,
    /// Why a state was refused: [`MessageError::code`], or a code of the controller from 100 on; 0: not refused.
    pub reason: u32,
    /// Segments in use, the first ones of `segments`, at least one.
    pub n_segments: u32,
    /// Zero.
    pub reserved: u32,
    /// What to do when, in the order of time.
    pub segments: [Segment; MAX_SEGMENTS],
    /// Gain rows, one per joint. Column `j` multiplies the position error of joint j, column `MAX_JOINTS + j` its velocity error,
    /// whatever `n_joints` is.
    pub gain: [[f64; 2 * MAX_JOINTS]; MAX_JOINTS],
    /// How the cycle went.
    pub report: CycleReport,
}

message!(Command, "delmpc/Command/v3", b"DMCO", 3);

/// Outcome of a control cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Verdict {
    /// A fresh solution within its time.
    Ok = 0,
    /// The cycle exceeded its time.
    Late = 1,
    /// The constrained problem had no solution.
    Infeasible = 2,
    /// The plant did not move as the model predicted.
    ModelMismatch = 3,
    /// The state was refused; see [`Command::reason`].
    BadState = 4,
}

impl Verdict {
    const ALL: [Self; 5] = [Self::Ok, Self::Late, Self::Infeasible, Self::ModelMismatch, Self::BadState];

    /// The verdict with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|verdict| *verdict as u32 == code)
    }
}

/// The fallback ladder, best first. Controller and plant watchdog use the same levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum FallbackLevel {
    /// A solution of this cycle.
    FreshSolution = 0,
    /// The last plan, shifted in time, with its own gains.
    ShiftedPlan = 1,
    /// Static LQR about the posture.
    StaticLqr = 2,
    /// Gravity compensation and damping.
    GravityHold = 3,
    /// Damping only.
    DampingOnly = 4,
    /// No torque.
    ZeroTorque = 5,
}

impl FallbackLevel {
    const ALL: [Self; 6] = [
        Self::FreshSolution,
        Self::ShiftedPlan,
        Self::StaticLqr,
        Self::GravityHold,
        Self::DampingOnly,
        Self::ZeroTorque,
    ];

    /// The level with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|level| *level as u32 == code)
    }
}

impl Segment {
    /// Every number finite and plausible, no empty bounds; `index` is only reported: fields count segment by segment.
    fn validate(&self, index: usize, n: usize) -> Result<(), MessageError> {
        let message = Command::NAME;
        let fields: [(&'static str, &[f64; MAX_JOINTS], f64); 6] = [
            ("torque", &self.torque, LARGEST_EFFORT),
            ("torque_lower", &self.torque_lower, LARGEST_EFFORT),
            ("torque_upper", &self.torque_upper, LARGEST_EFFORT),
            ("position_ref", &self.position_ref, LARGEST_COORDINATE),
            ("velocity_ref", &self.velocity_ref, LARGEST_COORDINATE),
            ("acceleration_ref", &self.acceleration_ref, LARGEST_EFFORT),
        ];
        let place = |joint| index * MAX_JOINTS + joint;
        for (field, values, limit) in fields {
            for (joint, &value) in values[..n].iter().enumerate() {
                check::plausible_one(message, field, place(joint), value, limit)?;
            }
        }
        for (joint, (lower, upper)) in self.torque_lower[..n].iter().zip(&self.torque_upper).enumerate() {
            if lower > upper {
                let (index, lower, upper) = (place(joint), *lower, *upper);
                return Err(MessageError::EmptyBounds { message, index, lower, upper });
            }
        }
        Ok(())
    }
}

impl Command {
    /// A command of zero torque and zero gain without bounds, with sequence 0, on the last rung of the ladder, valid at no time.
    pub fn new(run_id: u64, joint_set_hash: u64, n_joints: u32) -> Self {
        let free = Segment {
            torque_lower: [-LARGEST_EFFORT; MAX_JOINTS],
            torque_upper: [LARGEST_EFFORT; MAX_JOINTS],
            ..Segment::zeroed()
        };
        Self {
            header: Header::new::<Self>(run_id, joint_set_hash),
            n_joints,
            fallback_level: FallbackLevel::ZeroTorque as u32,
            n_segments: 1,
            segments: [free; MAX_SEGMENTS],
            ..Self::zeroed()
        }
    }

    /// Checks everything that can be checked without knowing the past: type, version, joint set and count, codes, the time span,
    /// every number finite and plausible.
    ///
    /// Cost: O(n²) for the gain, no allocation.
    ///
    /// # Errors
    /// The first thing found wrong, by name.
    pub fn validate(&self, expected_joint_set_hash: u64, n_joints: usize) -> Result<(), MessageError> {
        let message = Self::NAME;
        self.header.validate::<Self>(expected_joint_set_hash)?;
        let n = check::joint_count(message, self.n_joints, n_joints)?;
        check::known(message, "verdict", self.verdict, self.verdict())?;
        check::known(message, "fallback_level", self.fallback_level, self.fallback_level())?;
        self.validate_times()?;

        let count = self.n_segments as usize;
        if !(1..=MAX_SEGMENTS).contains(&count) {
            return Err(MessageError::WrongSegmentCount { message, found: count, capacity: MAX_SEGMENTS });
        }
        let mut earliest_ns = 0;
        for (index, segment) in self.segments[..count].iter().enumerate() {
            let begin_ns = segment.begin_ns;
            if begin_ns < earliest_ns || (index == 0 && begin_ns != 0) {
                return Err(MessageError::SegmentOutOfOrder { message, index, begin_ns, earliest_ns });
            }
            earliest_ns = begin_ns.saturating_add(1);
            segment.validate(index, n)?;
        }
        for (row, gain) in self.gain[..n].iter().enumerate() {
            for column in (0..n).chain(MAX_JOINTS..MAX_JOINTS + n) {
                let index = row * 2 * MAX_JOINTS + column;
                check::plausible_one(message, "gain", index, gain[column], LARGEST_EFFORT)?;
            }
        }

        let report = &self.report;
        check::plausible(message, "report.worst_violation", &[report.worst_violation], f64::MAX)?;
        let kind: Option<ConstraintKind> = report.worst_constraint();
        check::known(message, "report.worst_constraint", report.worst_constraint, kind)?;
        Ok(())
    }

    /// Times that a clock shows, and a time span that is neither empty nor for ever.
    fn validate_times(&self) -> Result<(), MessageError> {
        let message = Self::NAME;
        let (from_ns, until_ns) = (self.valid_from_ns, self.valid_until_ns);
        for (field, time_ns) in
            [("state_time_ns", self.state_time_ns), ("valid_from_ns", from_ns), ("valid_until_ns", until_ns)]
        {
            check::time(message, field, time_ns)?;
        }
        if from_ns > until_ns {
            return Err(MessageError::EmptyInterval { message, from_ns, until_ns });
        }
        let limit_ns = LONGEST_VALIDITY_NS;
        if until_ns - from_ns > limit_ns {
            return Err(MessageError::ValidTooLong { message, from_ns, until_ns, limit_ns });
        }
        Ok(())
    }

    /// The outcome of the cycle, if the code is known.
    pub fn verdict(&self) -> Option<Verdict> {
        Verdict::from_code(self.verdict)
    }

    /// The rung of the fallback ladder, if the code is known.
    pub fn fallback_level(&self) -> Option<FallbackLevel> {
        FallbackLevel::from_code(self.fallback_level)
    }

    /// Whether the command may be applied at a time of the plant's clock.
    pub fn is_valid_at(&self, plant_time_ns: u64) -> bool {
        (self.valid_from_ns..self.valid_until_ns).contains(&plant_time_ns)
    }

    /// The torque of the feedback law at a measured state: `u = torque + gain [q - q_ref(t); q_dot - q_dot_ref(t)]` within its bounds,
    /// `time_ns` by the plant's clock. Before its time the reference is where it began; from its end on it stands where it ended.
    ///
    /// Cost: O(n²), no allocation. Call it on a validated command.
    ///
    /// # Errors
    /// [`MessageError::WrongLength`] when a slice has another length than `n_joints`; `torque` is untouched then.
    pub fn torque_into(
        &self,
        time_ns: u64,
        position: &[f64],
        velocity: &[f64],
        torque: &mut [f64],
    ) -> Result<(), MessageError> {
        let n = check::joint_count(Self::NAME, self.n_joints, self.n_joints as usize)?;
        for (argument, found) in
            [("position", position.len()), ("velocity", velocity.len()), ("torque", torque.len())]
        {
            if found != n {
                return Err(MessageError::WrongLength { message: Self::NAME, argument, found, expected: n });
            }
        }
        let (segment, elapsed_s) = self.segment_at(time_ns);
        let moves = if time_ns < self.valid_until_ns { 1.0 } else { 0.0 };
        for (i, torque) in torque.iter_mut().enumerate() {
            let (position_gain, velocity_gain) = self.gain[i].split_at(MAX_JOINTS);
            *torque = segment.torque[i];
            for j in 0..n {
                let (speed, acceleration) = (segment.velocity_ref[j], segment.acceleration_ref[j]);
                let way = elapsed_s * (speed + 0.5 * elapsed_s * acceleration);
                *torque += position_gain[j] * (position[j] - segment.position_ref[j] - way);
                *torque += velocity_gain[j] * (velocity[j] - moves * (speed + elapsed_s * acceleration));
            }
            *torque = torque.max(segment.torque_lower[i]).min(segment.torque_upper[i]);
        }
        Ok(())
    }

    /// The segment in force at a time of the plant's clock, and how long it has been (s). Before and after the command's time those
    /// of its begin and its end.
    pub fn segment_at(&self, time_ns: u64) -> (&Segment, f64) {
        let elapsed_ns = time_ns.min(self.valid_until_ns).saturating_sub(self.valid_from_ns);
        let later = &self.segments[1..(self.n_segments as usize).clamp(1, MAX_SEGMENTS)];
        let begun = later.iter().take_while(|segment| segment.begin_ns <= elapsed_ns).last();
        let segment = begun.unwrap_or(&self.segments[0]);
        (segment, elapsed_ns.saturating_sub(segment.begin_ns) as f64 * 1e-9)
    }
}
