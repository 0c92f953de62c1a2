//! What every message begins with, and the trait that names a message type.

use core::fmt::Debug;

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::MessageError;

/// The first 40 bytes of every message: what it is, whose it is, and which one of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Header/v1"))]
pub struct Header {
    /// Which message this is: [`Message::MAGIC`].
    pub magic: u32,
    /// Which layout it has: [`Message::VERSION`].
    pub version: u32,
    /// Hash of the ordered joint names: [`crate::joint_set_hash`]. 0 in a heartbeat of a process that loads no robot.
    pub joint_set_hash: u64,
    /// The run it belongs to.
    pub run_id: u64,
    /// Counts the sender's messages of this type from 1. 0 means "none yet".
    pub sequence: u64,
    /// Monotonic time of sending (ns), for timing figures only: nothing is decided by it. 0 in lockstep, where runs must be
    /// reproducible bit by bit.
    pub sent_at_ns: u64,
}

impl Header {
    /// The header of a message of type `M`, with sequence 0.
    pub fn new<M: Message>(run_id: u64, joint_set_hash: u64) -> Self {
        Self { magic: M::MAGIC, version: M::VERSION, joint_set_hash, run_id, sequence: 0, sent_at_ns: 0 }
    }

    /// Checks type, version and joint set of a header that arrived as a message of type `M`.
    ///
    /// # Errors
    /// [`MessageError::WrongMagic`], [`MessageError::WrongVersion`], [`MessageError::WrongJointSet`].
    pub fn validate<M: Message>(&self, expected_joint_set_hash: u64) -> Result<(), MessageError> {
        let message = M::NAME;
        if self.magic != M::MAGIC {
            return Err(MessageError::WrongMagic { message, found: self.magic, expected: M::MAGIC });
        }
        if self.version != M::VERSION {
            return Err(MessageError::WrongVersion { message, found: self.version, expected: M::VERSION });
        }
        if self.joint_set_hash != expected_joint_set_hash {
            return Err(MessageError::WrongJointSet {
                message,
                found: self.joint_set_hash,
                expected: expected_joint_set_hash,
            });
        }
        Ok(())
    }

    /// Checks that a header belongs to a run. Whoever is in a run checks it beside [`Self::validate`].
    ///
    /// # Errors
    /// [`MessageError::WrongRun`].
    pub fn validate_run<M: Message>(&self, expected_run_id: u64) -> Result<(), MessageError> {
        if self.run_id == expected_run_id {
            return Ok(());
        }
        Err(MessageError::WrongRun { message: M::NAME, found: self.run_id, expected: expected_run_id })
    }
}

/// A payload type: fixed size, plain data, with a [`Header`] first.
pub trait Message: Pod + Debug {
    /// Name and version, by which the shared memory tells types apart.
    const NAME: &'static str;
    /// First word of the header; different for every message type.
    const MAGIC: u32;
    /// Version of layout and meaning, also the last part of [`Self::NAME`].
    const VERSION: u32;

    /// The message's header.
    fn header(&self) -> &Header;
    /// The message's header, to number, stamp or damage it.
    fn header_mut(&mut self) -> &mut Header;
}

/// Writes `Message` for a type whose field `header` is its [`Header`].
macro_rules! message {
    ($type:ty, $name:literal, $magic:literal, $version:literal) => {
        impl crate::Message for $type {
            const NAME: &'static str = $name;
            const MAGIC: u32 = u32::from_le_bytes(*$magic);
            const VERSION: u32 = $version;

            fn header(&self) -> &crate::Header {
                &self.header
            }

            fn header_mut(&mut self) -> &mut crate::Header {
                &mut self.header
            }
        }
    };
}
pub(crate) use message;
