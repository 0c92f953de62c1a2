//! A process's part in a run: its signs of life, its supervisor's orders, the wish to stop.

use delmpc_messages::{ProcessState, Role};
use delmpc_transport::{LinkError, RunId, RunNode};
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

use crate::presence::{Peer, Presence};
use crate::stop::StopFlag;

/// Silence after which it is worth asking whether a peer's process is still there, s.
const LOOK_FOR_PEER_S: f64 = 0.1;

/// What a process is to do now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Be ready, but do not begin.
    Wait,
    /// Run.
    Run,
    /// End cleanly: somebody wants it.
    Stop,
    /// End cleanly: the supervisor is gone.
    SupervisorLost,
    /// End cleanly: the other process was there and is gone.
    PeerLost,
}

impl Order {
    /// Whether to end.
    pub fn ends(self) -> bool {
        !matches!(self, Self::Wait | Self::Run)
    }
}

/// What a loop must do now and then while it works, and whom it tells how it stands.
pub trait Attendance {
    /// Gives a sign of life when one is due and hears the others. Call it in every turn of the loop.
    ///
    /// # Errors
    /// When shared memory breaks.
    fn attend(&mut self) -> Result<Order, LinkError>;

    /// Announces a change of state.
    ///
    /// # Errors
    /// When shared memory breaks.
    fn announce(&mut self, state: ProcessState) -> Result<(), LinkError>;

    /// Whether the other process has said that it is done.
    fn peer_is_done(&self) -> bool;
}

/// Attendance of a loop that shares its process with everybody it has to do with.
#[derive(Debug, Clone)]
pub struct Alone(pub StopFlag);

impl Attendance for Alone {
    fn attend(&mut self) -> Result<Order, LinkError> {
        Ok(if self.0.is_set() { Order::Stop } else { Order::Run })
    }

    fn announce(&mut self, _state: ProcessState) -> Result<(), LinkError> {
        Ok(())
    }

    fn peer_is_done(&self) -> bool {
        true
    }
}

/// Membership in a run.
#[derive(Debug)]
pub struct Membership {
    node: RunNode,
    presence: Presence,
    supervisor: Option<Peer>,
    /// The controller to the plant and the plant to the controller.
    peer: Peer,
    stop: StopFlag,
    /// The process that started a supervised one.
    parent: Option<Pid>,
    hang_s: Option<f64>,
}

impl Membership {
    /// Joins a run. A supervised process follows its supervisor's heartbeat; one on its own runs at once and ends by a signal. A peer that
    /// is silent for `hang_s` is lost; without a limit, and while it starts, only one whose process is gone.
    ///
    /// # Errors
    /// When shared memory is unusable, or a living process already plays this role in this run.
    pub fn join(
        run: RunId,
        joint_set_hash: u64,
        role: Role,
        supervised: bool,
        hang_s: Option<f64>,
    ) -> Result<Self, LinkError> {
        let stop = if supervised { StopFlag::on_termination_only() } else { StopFlag::on_signals() };
        // Without handlers a signal ends the process at once, and the supervisor tidies up.
        let stop = stop.unwrap_or_else(|_| StopFlag::never());
        if supervised {
            // For the case that the supervisor is killed; its silence says so too, but later.
            let _ = set_parent_process_death_signal(Some(Signal::TERM));
        }
        let node = RunNode::open(run, joint_set_hash)?;
        let presence = Presence::new(&node, joint_set_hash, role)?;
        let supervisor = if supervised { Some(Peer::new(&node, Role::Supervisor)?) } else { None };
        let other = if role == Role::Plant { Role::Controller } else { Role::Plant };
        let peer = Peer::new(&node, other)?.with_joint_set(joint_set_hash);
        let parent = supervised.then(getppid).flatten();
        Ok(Self { node, presence, supervisor, peer, stop, parent, hang_s })
    }

    /// Whether the other process was there and is gone.
    fn peer_is_lost(&self) -> bool {
        let (Some(state), silent_s) = (self.peer.state(), self.peer.silent_s()) else { return false };
        if self.peer_is_done() || silent_s < LOOK_FOR_PEER_S {
            return false;
        }
        match self.hang_s.filter(|_| state != ProcessState::Starting) {
            Some(hang_s) => silent_s > hang_s,
            None => self.peer.is_gone(),
        }
    }

    /// What connecting a channel gave; that the others do not fit is told to them before we go.
    pub fn connected<T>(&mut self, channel: Result<T, LinkError>) -> Result<T, LinkError> {
        let short_of_memory = matches!(channel, Err(LinkError::SharedMemoryFull { .. }));
        if channel.is_err() && !short_of_memory {
            // A broken link leaves our own words.
            let _ = self.presence.announce_refusal();
        }
        channel
    }

    /// The run's shared memory.
    pub fn node(&self) -> &RunNode {
        &self.node
    }
}

impl Attendance for Membership {
    fn attend(&mut self) -> Result<Order, LinkError> {
        self.presence.beat()?;
        self.peer.listen()?;
        if self.stop.is_set() {
            return Ok(Order::Stop);
        }
        let order = match &mut self.supervisor {
            None => Order::Run,
            Some(supervisor) => {
                supervisor.listen()?;
                match supervisor.state() {
                    Some(ProcessState::Stopping) => Order::Stop,
                    // A supervisor that the machine keeps from its core is silent too.
                    _ if getppid() != self.parent => Order::SupervisorLost,
                    Some(ProcessState::Running) => Order::Run,
                    _ => Order::Wait,
                }
            }
        };
        // A supervisor sees sooner and more, and says why.
        let lost = self.supervisor.is_none() && !order.ends() && self.peer_is_lost();
        Ok(if lost { Order::PeerLost } else { order })
    }

    fn announce(&mut self, state: ProcessState) -> Result<(), LinkError> {
        self.presence.announce(state)
    }

    fn peer_is_done(&self) -> bool {
        matches!(self.peer.state(), Some(ProcessState::Finished | ProcessState::Fault))
    }
}
