//! Signs of life: giving our own, following those of others.

use delmpc_messages::{FAULT_REFUSED, Heartbeat, ProcessState, Role};
use delmpc_transport::{
    Channel, LinkError, Publisher, RunNode, SharedPublisher, SharedSubscriber, Subscriber,
};

use rustix::io::Errno;
use rustix::process::{Pid, test_kill_process};

use crate::clock::monotonic_ns;
use crate::refusals::Refusals;

/// Time between signs of life.
pub const PERIOD_NS: u64 = 20_000_000;

/// Our own signs of life. They come from the loop that does the work, so that a loop that hangs falls silent.
#[derive(Debug)]
pub struct Presence {
    publisher: SharedPublisher<Heartbeat>,
    heartbeat: Heartbeat,
}

impl Presence {
    /// Announces a process that is starting.
    ///
    /// # Errors
    /// When the channel cannot be opened, for example since a living process plays this role.
    pub fn new(node: &RunNode, joint_set_hash: u64, role: Role) -> Result<Self, LinkError> {
        let publisher = node.publisher(Channel::Heartbeat(role))?;
        let heartbeat = Heartbeat::new(node.run().0, joint_set_hash, role, std::process::id());
        let mut presence = Self { publisher, heartbeat };
        presence.send()?;
        Ok(presence)
    }

    /// Gives a sign of life if the last one is old enough. Cheap: call it in every turn of the loop.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn beat(&mut self) -> Result<(), LinkError> {
        match monotonic_ns() >= self.heartbeat.time_ns + PERIOD_NS {
            true => self.send(),
            false => Ok(()),
        }
    }

    /// Announces a change of state at once.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn announce(&mut self, state: ProcessState) -> Result<(), LinkError> {
        if self.heartbeat.state == state as u32 {
            return self.beat();
        }
        self.heartbeat.state = state as u32;
        self.send()
    }

    /// Announces that we do not fit to the others and go.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn announce_refusal(&mut self) -> Result<(), LinkError> {
        self.heartbeat.fault_code = FAULT_REFUSED;
        self.announce(ProcessState::Fault)
    }

    fn send(&mut self) -> Result<(), LinkError> {
        self.heartbeat.header.sequence += 1;
        self.heartbeat.time_ns = monotonic_ns();
        self.heartbeat.header.sent_at_ns = self.heartbeat.time_ns;
        self.publisher.send(&self.heartbeat)
    }
}

/// Time between two looks that counts as silence at most: longer, it was us who slept.
const LONGEST_LOOK_NS: u64 = 200_000_000;

/// What another process says of itself.
#[derive(Debug)]
pub struct Peer {
    subscriber: SharedSubscriber<Heartbeat>,
    /// Only a process with these joints is meant.
    joint_set_hash: Option<u64>,
    latest: Option<Heartbeat>,
    looked_ns: u64,
    silent_ns: u64,
    role: Role,
    refusals: Refusals,
}

impl Peer {
    /// Follows the process that plays `role`.
    ///
    /// # Errors
    /// When the channel cannot be opened.
    pub fn new(node: &RunNode, role: Role) -> Result<Self, LinkError> {
        let subscriber = node.subscriber(Channel::Heartbeat(role))?;
        let refusals = Refusals::default();
        let looked_ns = monotonic_ns();
        Ok(Self { subscriber, joint_set_hash: None, latest: None, looked_ns, silent_ns: 0, role, refusals })
    }

    /// Follows it only with these joints: another one is refused by both, and neither its coming nor its going means anything.
    #[must_use]
    pub fn with_joint_set(mut self, joint_set_hash: u64) -> Self {
        self.joint_set_hash = Some(joint_set_hash);
        self
    }

    /// Takes in what is new. A sign of life that cannot be understood counts as none.
    ///
    /// # Errors
    /// When the channel is broken.
    pub fn listen(&mut self) -> Result<(), LinkError> {
        let now = monotonic_ns();
        self.silent_ns += (now - self.looked_ns).min(LONGEST_LOOK_NS);
        self.looked_ns = now;
        if let Some(heartbeat) = self.subscriber.receive_latest()? {
            let sequence = heartbeat.header.sequence;
            let news = self.latest.is_none_or(|latest| latest.header.sequence != sequence);
            let expected = self.joint_set_hash.unwrap_or(heartbeat.header.joint_set_hash);
            let name = self.role.name();
            if heartbeat.state() == Some(ProcessState::Fault) && heartbeat.fault_code == FAULT_REFUSED {
                // It never was one of us.
                self.latest = None;
                self.refusals.tell(FAULT_REFUSED, || {
                    format!("a {name} process could not connect: its messages are of another version, or its services have other settings")
                });
            } else if news {
                match heartbeat.validate(expected) {
                    Ok(()) => {
                        self.latest = Some(*heartbeat);
                        self.silent_ns = 0;
                    }
                    Err(error) => self
                        .refusals
                        .tell(100 + error.code(), || format!("a {name} process is refused: {error}")),
                }
            }
        }
        Ok(())
    }

    /// How long it has been silent, as far as we were awake to hear it (s).
    pub fn silent_s(&self) -> f64 {
        self.silent_ns as f64 * 1e-9
    }

    /// The state it announced last, if it was ever heard.
    pub fn state(&self) -> Option<ProcessState> {
        self.latest.and_then(|heartbeat| heartbeat.state())
    }

    /// Whether its process has ended: then it says nothing any more.
    pub fn is_gone(&self) -> bool {
        let pid = self.pid().and_then(|pid| i32::try_from(pid).ok()).and_then(Pid::from_raw);
        pid.is_some_and(|pid| test_kill_process(pid) == Err(Errno::SRCH))
    }

    /// Its process id, if it was ever heard.
    pub fn pid(&self) -> Option<u32> {
        self.latest.map(|heartbeat| heartbeat.pid)
    }
}
