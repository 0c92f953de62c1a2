//! Every process to its supervisor and peers: I am here, and this is how I am.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::header::message;
use crate::{Header, Message, MessageError, check};

/// A sign of life. Sent at start, at every change of state, and regularly in between.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Heartbeat/v1"))]
pub struct Heartbeat {
    /// Type, joint set (0 from a process that loads no robot), run, sequence.
    pub header: Header,
    /// Monotonic time of the machine (ns).
    pub time_ns: u64,
    /// Who sends: [`Role`].
    pub role: u32,
    /// Its process id.
    pub pid: u32,
    /// What it is doing: [`ProcessState`].
    pub state: u32,
    /// Why it stopped when `state` is [`ProcessState::Fault`]: [`FAULT_REFUSED`], or a number of the process's own; otherwise 0.
    pub fault_code: u32,
}

/// [`Heartbeat::fault_code`] of a process that could not connect: its payloads, their versions or the settings of its services differ.
pub const FAULT_REFUSED: u32 = 1;

message!(Heartbeat, "delmpc/Heartbeat/v1", b"DMHB", 1);

/// The parts a process can play in a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
pub enum Role {
    /// Simulates the robot.
    Plant = 0,
    /// Computes the commands.
    Controller = 1,
    /// Starts, watches and ends the other two.
    Supervisor = 2,
}

impl Role {
    /// All roles, in the order of their codes.
    pub const ALL: [Self; 3] = [Self::Plant, Self::Controller, Self::Supervisor];

    /// The role with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|role| *role as u32 == code)
    }

    /// The role as one lower-case word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plant => "plant",
            Self::Controller => "controller",
            Self::Supervisor => "supervisor",
        }
    }
}

/// What a process is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ProcessState {
    /// Reading files, connecting, warming up.
    Starting = 0,
    /// Waiting for the run to begin.
    Ready = 1,
    /// In the run. From the supervisor: run.
    Running = 2,
    /// Asked to end, still tidying up. From the supervisor: end now.
    Stopping = 3,
    /// Done; nothing more will be sent.
    Finished = 4,
    /// Ended by a fault; see [`Heartbeat::fault_code`].
    Fault = 5,
}

impl ProcessState {
    const ALL: [Self; 6] =
        [Self::Starting, Self::Ready, Self::Running, Self::Stopping, Self::Finished, Self::Fault];

    /// The state with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|state| *state as u32 == code)
    }
}

impl Heartbeat {
    /// The sign of life of a process that has just begun, with sequence 0.
    pub fn new(run_id: u64, joint_set_hash: u64, role: Role, pid: u32) -> Self {
        let header = Header::new::<Self>(run_id, joint_set_hash);
        let (role, state) = (role as u32, ProcessState::Starting as u32);
        Self { header, time_ns: 0, role, pid, state, fault_code: 0 }
    }

    /// Checks type, version, joint set and codes. A supervisor, which may not know the joint set, passes
    /// `self.header.joint_set_hash`.
    ///
    /// # Errors
    /// The first thing found wrong, by name.
    pub fn validate(&self, expected_joint_set_hash: u64) -> Result<(), MessageError> {
        self.header.validate::<Self>(expected_joint_set_hash)?;
        check::known(Self::NAME, "role", self.role, self.role())?;
        check::known(Self::NAME, "state", self.state, self.state())?;
        Ok(())
    }

    /// Who sends, if the code is known.
    pub fn role(&self) -> Option<Role> {
        Role::from_code(self.role)
    }

    /// What it is doing, if the code is known.
    pub fn state(&self) -> Option<ProcessState> {
        ProcessState::from_code(self.state)
    }
}
