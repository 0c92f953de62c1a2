//! What a motor board links: the law between two commands, the queue of commands, the watchdog for when none comes.
//!
//! `no_std`, allocation in constructors only. It knows messages, and neither robot nor solver: the plant of the simulation, a firmware
//! and another simulator use the same one. Start at [`servo::Servo`]; [`wire`] has frames for a board that is reached over a line.
//!
//! ```
//! use delmpc_messages::{Command, ServoReadings};
//! use delmpc_servo::prelude::*;
//! // A joint that nobody controls yet, held at 0.3 rad by a spring and a damper.
//! let law = AffineLaw::joint_stiffness(&[0.0], &[0.3], &[20.0], &[1.0]);
//! let config = WatchdogConfig { law: Some(law), ..WatchdogConfig::default() };
//! let mut servo = Servo::new(1, 7, config)?;
//! let mut torque = [0.0];
//! servo.torque_into(0, &ServoReadings::joints(&[0.2], &[0.0]), &mut torque);
//! assert!((torque[0] - 2.0).abs() < 1e-12);
//! # Ok::<(), ServoError>(())
//! ```

#![no_std]
#![forbid(unsafe_code)]

extern crate alloc;
#[cfg(test)]
extern crate std;

pub mod error;
pub mod servo;
pub mod wire;

/// What most users need.
pub mod prelude {
    pub use crate::error::ServoError;
    pub use crate::servo::{AffineLaw, CommandRefused, Servo, WatchdogConfig};
}
