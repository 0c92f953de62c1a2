//! The messages plant, controller and supervisor exchange: plain fixed-size data, nothing else.
//!
//! | payload | from | to | content |
//! |---|---|---|---|
//! | [`PlantState`] | plant | controller | what the sensors say, what the actuators did |
//! | [`Command`] | controller | plant | torque, feedback gain, reference point, [`CycleReport`] |
//! | [`Heartbeat`] | every process | supervisor and peers | who is alive, in which state |
//!
//! Rules every payload keeps:
//!
//! - `repr(C)`, only `f64`, `u64`, `u32` and arrays of them, no padding, no pointer: any bit pattern is a value, so a damaged
//!   message is *detected* by [`PlantState::validate`] and [`Command::validate`], never undefined. `bytemuck::Pod` proves it at compile
//!   time, and gives each message as bytes for logs and bit-exact comparison.
//! - Capacity is fixed at [`MAX_JOINTS`]; entries from `n_joints` on are unused and not looked at.
//! - Each type has a name with a version ([`Message::NAME`], known to the shared memory) and a magic and version word in its
//!   [`Header`]. **Any change of layout or meaning bumps the version in both**; `tests/layout.rs` fails until it is done.
//! - Joints are in the order of the robot's joint set, whose hash ([`joint_set_hash`]) both sides compare.
//! - SI units. Times are nanoseconds. Frames: suffix `_w` is the world, `_b` the body the quantity belongs to. Angular before linear.
//!
//! The crate is `no_std`, needs no allocator and never panics. Feature `shared_memory` adds the marker trait of the shared-memory
//! transport; only `delmpc-transport` switches it on. Features `joints_4` and `joints_12` leave less room, for a microcontroller.
//!
//! Reading order: `header`, `joint_set`, `plant_state`, `command`, `servo_law`, `cycle_report`, `heartbeat`, `error`.

#![no_std]

mod check;
mod command;
mod cycle_report;
mod error;
mod header;
mod heartbeat;
mod joint_set;
mod plant_state;
mod servo_law;

pub use check::UNIT_TOLERANCE;
pub use command::{Command, FallbackLevel, MAX_SEGMENTS, Segment, StateEstimate, Verdict};
pub use cycle_report::{ConstraintKind, CycleReport};
pub use error::MessageError;
pub use header::{Header, Message};
pub use heartbeat::{FAULT_REFUSED, Heartbeat, ProcessState, Role};
pub use joint_set::{JointSetHasher, joint_set_hash};
pub use plant_state::{ClockKind, FootReading, MAX_FEET, PlantState, foot, sensor, status};
pub use servo_law::{MAX_RATE_SAMPLES, RateMean, ServoReadings};

/// Joints a message has room for. A larger robot needs a new version of [`PlantState`] and [`Command`].
pub const MAX_JOINTS: usize = if cfg!(feature = "joints_12") {
    12
} else if cfg!(feature = "joints_4") {
    4
} else {
    32
};

#[cfg(all(feature = "shared_memory", any(feature = "joints_4", feature = "joints_12")))]
compile_error!(
    "messages in shared memory have room for 32 joints: joints_4 and joints_12 are for microcontrollers"
);

/// Largest joint position, joint velocity or base coordinate taken for real (rad, m, rad/s, m/s).
pub const LARGEST_COORDINATE: f64 = 1e5;

/// Latest time taken for real (ns): 146 years. Sums of two times then fit into 64 bits.
pub const LATEST_TIME_NS: u64 = 1 << 62;

/// Longest time a command may be valid (ns). A plant that holds the command of a controller that is gone holds it no longer.
pub const LONGEST_VALIDITY_NS: u64 = 20_000_000_000;

/// Largest torque, force or feedback gain taken for real (N m, N, and those per rad, m, rad/s, m/s).
pub const LARGEST_EFFORT: f64 = 1e9;
