//! Why a message was refused.

use crate::MAX_JOINTS;

/// A message that cannot be used. Each text says which message, where in it, how much, and what to do.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The first word is not that of the expected message type.
    #[error(
        "{message}: first word is {found:#010x}, expected {expected:#010x}: this is another message or damaged memory; \
         check that both ends of the link use the same message type"
    )]
    WrongMagic {
        /// The expected message.
        message: &'static str,
        /// The word found.
        found: u32,
        /// The word of the expected message.
        expected: u32,
    },
    /// Another version of the same message.
    #[error("{message}: version {found}, expected {expected}: build both processes from the same source")]
    WrongVersion {
        /// The expected message.
        message: &'static str,
        /// The version found.
        found: u32,
        /// The version of this build.
        expected: u32,
    },
    /// The sender has other joints, or the same joints in another order.
    #[error(
        "{message}: joint set {found:#018x}, expected {expected:#018x}: the sender has other joints or another order; \
         give both processes the same robot file"
    )]
    WrongJointSet {
        /// The expected message.
        message: &'static str,
        /// The hash in the message.
        found: u64,
        /// The hash of our joint set.
        expected: u64,
    },
    /// The number of joints differs from ours or exceeds the capacity.
    #[error(
        "{message}: {found} joints, expected {expected} (at most {MAX_JOINTS} fit); give both processes the same robot file"
    )]
    WrongJointCount {
        /// The expected message.
        message: &'static str,
        /// Joints in the message.
        found: usize,
        /// Joints of our robot.
        expected: usize,
    },
    /// A value is NaN or infinite.
    #[error(
        "{message}: {field}[{index}] = {value} is not finite; look at the sender, nothing was taken over from this message"
    )]
    NotFinite {
        /// The refused message.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Index in the field; a gain counts row by row.
        index: usize,
        /// The value.
        value: f64,
    },
    /// A value is finite but beyond anything a robot does.
    #[error(
        "{message}: {field}[{index}] = {value:e} is beyond {limit:e}; look at the sender, nothing was taken over from this message"
    )]
    Implausible {
        /// The refused message.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Index in the field; a gain counts row by row.
        index: usize,
        /// The value.
        value: f64,
        /// The largest magnitude accepted.
        limit: f64,
    },
    /// A quaternion is not of unit length.
    #[error(
        "{message}: {field} has squared length {squared_norm}, expected 1 within {tolerance:e}; normalise it before sending"
    )]
    NotUnit {
        /// The refused message.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// Its squared length.
        squared_norm: f64,
        /// The tolerance on the squared length.
        tolerance: f64,
    },
    /// A code that stands for nothing.
    #[error("{message}: {field} = {value} is no known code; build both processes from the same source")]
    UnknownCode {
        /// The refused message.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// The code.
        value: u32,
    },
    /// A command without segments, or with more than fit.
    #[error(
        "{message}: {found} segments, expected 1 to {capacity}; build both processes from the same source"
    )]
    WrongSegmentCount {
        /// The refused message.
        message: &'static str,
        /// Segments in the message.
        found: usize,
        /// Segments that fit.
        capacity: usize,
    },
    /// Segments that do not follow each other in time.
    #[error(
        "{message}: segment {index} begins after {begin_ns} ns, expected {} {earliest_ns} ns; look at the sender",
        if *.index == 0 { "exactly" } else { "not before" }
    )]
    SegmentOutOfOrder {
        /// The refused message.
        message: &'static str,
        /// The segment.
        index: usize,
        /// When it says it begins, after the begin of the command.
        begin_ns: u64,
        /// The earliest time it may; for the first one the only time.
        earliest_ns: u64,
    },
    /// A command that ends before it begins.
    #[error(
        "{message}: valid from {from_ns} ns until {until_ns} ns, an empty interval; look at the clock of the sender"
    )]
    EmptyInterval {
        /// The refused message.
        message: &'static str,
        /// Begin of the interval.
        from_ns: u64,
        /// End of the interval.
        until_ns: u64,
    },
    /// A time no clock shows.
    #[error("{message}: {field} = {time_ns} ns is beyond {limit_ns} ns; look at the clock of the sender")]
    TimeBeyond {
        /// The refused message.
        message: &'static str,
        /// The field.
        field: &'static str,
        /// The time.
        time_ns: u64,
        /// The latest time accepted.
        limit_ns: u64,
    },
    /// A command that would be valid for too long.
    #[error(
        "{message}: valid from {from_ns} ns until {until_ns} ns, longer than {limit_ns} ns; shorten the life of commands"
    )]
    ValidTooLong {
        /// The refused message.
        message: &'static str,
        /// Begin of the interval.
        from_ns: u64,
        /// End of the interval.
        until_ns: u64,
        /// The longest time accepted.
        limit_ns: u64,
    },
    /// The message belongs to another run.
    #[error(
        "{message}: of run {found:016x}, this is run {expected:016x}; give both processes the same run id and seed"
    )]
    WrongRun {
        /// The expected message.
        message: &'static str,
        /// The run in the message.
        found: u64,
        /// Our run.
        expected: u64,
    },
    /// Bounds with nothing between them.
    #[error(
        "{message}: torque_lower[{index}] = {lower:e} is above torque_upper[{index}] = {upper:e}; look at the sender, nothing was \
         taken over from this message"
    )]
    EmptyBounds {
        /// The refused message.
        message: &'static str,
        /// The joint; counts segment by segment.
        index: usize,
        /// The lower bound.
        lower: f64,
        /// The upper bound.
        upper: f64,
    },
    /// More feet than fit, or a joint on the load of a foot that does not exist.
    #[error("{message}: foot {found}, but there is room for {capacity}; look at the sender")]
    TooManyFeet {
        /// The refused message.
        message: &'static str,
        /// Feet in the message, or the foot asked for.
        found: usize,
        /// Feet that fit.
        capacity: usize,
    },
    /// A slice handed in by the caller has another length than the message has joints.
    #[error(
        "{message}: argument {argument} has length {found}, expected {expected}, the joints of this message"
    )]
    WrongLength {
        /// The message.
        message: &'static str,
        /// The argument.
        argument: &'static str,
        /// Its length.
        found: usize,
        /// The length needed.
        expected: usize,
    },
}

impl MessageError {
    /// Every kind by its name, with its number.
    pub const CODES: [(&'static str, u32); 17] = [
        ("WrongMagic", 1),
        ("WrongVersion", 2),
        ("WrongJointSet", 3),
        ("WrongJointCount", 4),
        ("NotFinite", 5),
        ("Implausible", 6),
        ("NotUnit", 7),
        ("UnknownCode", 8),
        ("EmptyInterval", 9),
        ("WrongLength", 10),
        ("EmptyBounds", 11),
        ("WrongSegmentCount", 12),
        ("SegmentOutOfOrder", 13),
        ("TimeBeyond", 14),
        ("ValidTooLong", 15),
        ("WrongRun", 16),
        ("TooManyFeet", 17),
    ];

    /// A number for [`crate::Command::reason`], never 0. It stays the same from version to version.
    pub fn code(&self) -> u32 {
        match self {
            Self::WrongMagic { .. } => 1,
            Self::WrongVersion { .. } => 2,
            Self::WrongJointSet { .. } => 3,
            Self::WrongJointCount { .. } => 4,
            Self::NotFinite { .. } => 5,
            Self::Implausible { .. } => 6,
            Self::NotUnit { .. } => 7,
            Self::UnknownCode { .. } => 8,
            Self::EmptyInterval { .. } => 9,
            Self::WrongLength { .. } => 10,
            Self::EmptyBounds { .. } => 11,
            Self::WrongSegmentCount { .. } => 12,
            Self::SegmentOutOfOrder { .. } => 13,
            Self::TimeBeyond { .. } => 14,
            Self::ValidTooLong { .. } => 15,
            Self::WrongRun { .. } => 16,
            Self::TooManyFeet { .. } => 17,
        }
    }
}
