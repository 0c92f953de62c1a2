//! A process's part in a run: its signs of life, its supervisor's orders, the wish to stop.

use delmpc_messages::{ProcessState, Role};
use delmpc_transport::{LinkError, RunId, RunNode};
use rustix::process::{Signal, set_parent_process_death_signal};

use crate::presence::{Peer, Presence};
use crate::stop::StopFlag;

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
    hang_s: f64,
}

impl Membership {
    /// Joins a run. A supervised process follows its supervisor's heartbeat; one on its own runs at once and ends by a signal.
    ///
    /// # Errors
    /// When shared memory is unusable, or a living process already plays this role in this run.
    pub fn join(
        run: RunId,
        joint_set_hash: u64,
        role: Role,
        supervised: bool,
        hang_s: f64,
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
        let peer = Peer::new(&node, other)?;
        Ok(Self { node, presence, supervisor, peer, stop, hang_s })
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
                    Some(_) if supervisor.silent_s() > self.hang_s => Order::SupervisorLost,
                    Some(ProcessState::Running) => Order::Run,
                    _ => Order::Wait,
                }
            }
        };
        // A supervisor sees sooner and more, and says why.
        let lost = self.peer.state().is_some() && !self.peer_is_done() && self.peer.silent_s() > self.hang_s;
        Ok(if lost && !order.ends() && self.supervisor.is_none() { Order::PeerLost } else { order })
    }

    fn announce(&mut self, state: ProcessState) -> Result<(), LinkError> {
        self.presence.announce(state)
    }

    fn peer_is_done(&self) -> bool {
        matches!(self.peer.state(), Some(ProcessState::Finished | ProcessState::Fault))
    }
}
