//! Controller to plant: torque, feedback gain, reference point, and how the cycle went.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::header::message;
use crate::{
    ConstraintKind, CycleReport, Header, LARGEST_COORDINATE, LARGEST_EFFORT, LONGEST_VALIDITY_NS, MAX_FEET,
    MAX_JOINTS, MAX_RATE_SAMPLES, Message, MessageError, check,
};

/// Capacity for the segments of a [`Command`].
pub const MAX_SEGMENTS: usize = 8;

/// Feed-forward, reference and bounds of a [`Command`] over a part of its time: up to the next segment, the last one to the end.
///
/// A segment is one stage of the plan. The reference moves with constant acceleration from where it is at `begin_ns`, so that a robot
/// on its way is not held back by where it was.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Segment/v2"))]
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
    /// Reference of [`crate::PlantState::imu_angle`] at `begin_ns` (rad).
    pub imu_angle_ref: [f64; 3],
    /// Reference of the gyroscope less its bias at `begin_ns` (rad/s).
    pub imu_rate_ref: [f64; 3],
    /// Rate of change of `imu_rate_ref` (rad/s²).
    pub imu_acceleration_ref: [f64; 3],
}

/// The answer to one [`crate::PlantState`]: an affine feedback law along a piece of the plan.
///
/// The plant evaluates it at its own rate, with the sensors it reads at that rate ([`Self::torque_into`] says how), then keeps to its own
/// limits. A command is meant for the time up to the next one, mostly within its first segment. The segments after that are what the
/// controller would do if no other came: a torque that is right for 5 ms throws the robot over when it is held for 20, and commands do
/// come late. The bounds keep what the feedback adds between two commands within what the controller found admissible: those of the
/// stance ankle keep the pressure point in the sole while the robot is being pushed.
///
/// The ankle of a foot on the ground is told by the inertial unit, not by its encoder: an encoder there says how the foot rocks as much
/// as how the robot leans. And what the ankle may do depends on what the foot carries: `load_foot` and the three fields after it.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Command/v4"))]
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
    /// How many of the servo's last samples the velocities of the law are means of: 1 to [`crate::MAX_RATE_SAMPLES`].
    pub rate_samples: u32,
    /// What to do when, in the order of time.
    pub segments: [Segment; MAX_SEGMENTS],
    /// Gain rows, one per joint. Column `j` multiplies the position error of joint j, column `MAX_JOINTS + j` its velocity error,
    /// whatever `n_joints` is.
    pub gain: [[f64; 2 * MAX_JOINTS]; MAX_JOINTS],
    /// Gain rows on the inertial unit, one per joint: three columns on the error of `imu_angle`, three on that of the gyroscope.
    pub imu_gain: [[f64; 6]; MAX_JOINTS],
    /// Bias of the gyroscope (rad/s).
    pub imu_rate_bias: [f64; 3],
    /// For every joint, 1 + the foot whose load its torque needs; 0: none.
    pub load_foot: [u32; MAX_JOINTS],
    /// Normal force at which such a joint has its full torque, by foot (N).
    pub full_load_n: [f64; MAX_FEET],
    /// Stiffness with which such a joint holds `position_ref` while its foot carries nothing (N m/rad).
    pub unloaded_stiffness: [f64; MAX_JOINTS],
    /// Damping of the same (N m s/rad).
    pub unloaded_damping: [f64; MAX_JOINTS],
    /// How the cycle went.
    pub report: CycleReport,
    /// What the controller believes of the base at `state_time_ns`.
    pub estimate: StateEstimate,
}

message!(Command, "delmpc/Command/v4", b"DMCO", 4);

/// What a controller believes of base and feet: for logs and figures, nobody acts on it.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/StateEstimate/v1"))]
pub struct StateEstimate {
    /// 1: there is an estimate; 0: the controller has none.
    pub known: u32,
    /// Bit i: foot i is believed to carry load.
    pub feet_loaded: u32,
    /// Orientation of the base link frame in a level frame: quaternion x, y, z, w.
    pub base_orientation_w: [f64; 4],
    /// Angular velocity of the base link in its own axes (rad/s).
    pub base_angular_velocity_b: [f64; 3],
    /// Velocity of the origin of the base link frame in the axes of the base link (m/s).
    pub base_linear_velocity_b: [f64; 3],
    /// Bias of the gyroscope in its axes (rad/s).
    pub gyro_bias: [f64; 3],
    /// Bias of the accelerometer in its axes (m/s²).
    pub accelerometer_bias: [f64; 3],
}

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
        for (field, values) in [
            ("imu_angle_ref", &self.imu_angle_ref),
            ("imu_rate_ref", &self.imu_rate_ref),
            ("imu_acceleration_ref", &self.imu_acceleration_ref),
        ] {
            for (axis, &value) in values.iter().enumerate() {
                check::plausible_one(message, field, 3 * index + axis, value, LARGEST_EFFORT)?;
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
            rate_samples: 1,
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
        let samples = self.rate_samples as usize;
        let known = (1..=MAX_RATE_SAMPLES).contains(&samples).then_some(());
        check::known(message, "rate_samples", self.rate_samples, known)?;
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

        for (row, gain) in self.imu_gain[..n].iter().enumerate() {
            for (column, &value) in gain.iter().enumerate() {
                check::plausible_one(message, "imu_gain", 6 * row + column, value, LARGEST_EFFORT)?;
            }
        }
        if let Some(&foot) = self.load_foot[..n].iter().find(|foot| **foot as usize > MAX_FEET) {
            return Err(MessageError::TooManyFeet { message, found: foot as usize, capacity: MAX_FEET });
        }
        check::plausible(message, "imu_rate_bias", &self.imu_rate_bias, LARGEST_COORDINATE)?;
        check::plausible(message, "full_load_n", &self.full_load_n, LARGEST_EFFORT)?;
        check::plausible(message, "unloaded_stiffness", &self.unloaded_stiffness[..n], LARGEST_EFFORT)?;
        check::plausible(message, "unloaded_damping", &self.unloaded_damping[..n], LARGEST_EFFORT)?;

        let report = &self.report;
        let estimate = &self.estimate;
        for (field, values) in [
            ("estimate.base_angular_velocity_b", &estimate.base_angular_velocity_b),
            ("estimate.base_linear_velocity_b", &estimate.base_linear_velocity_b),
            ("estimate.gyro_bias", &estimate.gyro_bias),
            ("estimate.accelerometer_bias", &estimate.accelerometer_bias),
        ] {
            check::plausible(message, field, values, LARGEST_COORDINATE)?;
        }
        check::plausible(message, "estimate.base_orientation_w", &estimate.base_orientation_w, 2.0)?;
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
