//! The links of a run.

use delmpc_messages::Role;

/// One link of a run, by what it carries. Each has one publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Channel {
    /// [`delmpc_messages::PlantState`], plant to controller.
    State,
    /// [`delmpc_messages::Command`], controller to plant.
    Command,
    /// [`delmpc_messages::Heartbeat`] of one role, to everybody.
    Heartbeat(Role),
    /// [`delmpc_messages::PlantState`] without noise and delay, after every step: what a plant of somebody else's tells whoever judges the
    /// run. The controller does not listen.
    Truth,
}

/// Places for subscribers of a channel.
const MAX_SUBSCRIBERS: usize = 8;
/// Steps of a plant that who judges the run may be late.
const TRUTHS_KEPT: usize = 1024;
/// States and commands that who writes a log may be late; plant and controller themselves ask for the latest one.
const MESSAGES_KEPT: usize = 16;
/// Who judges the run, and somebody who watches.
const TRUTH_SUBSCRIBERS: usize = 2;

impl Channel {
    /// The name of the channel within its run.
    pub fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Command => "command",
            Self::Heartbeat(Role::Plant) => "heartbeat-plant",
            Self::Heartbeat(Role::Controller) => "heartbeat-controller",
            Self::Heartbeat(Role::Supervisor) => "heartbeat-supervisor",
            Self::Truth => "truth",
        }
    }

    /// Whether both ends must have the same joint set to connect. Heartbeats connect anyway, so that the supervisor can say who differs.
    pub fn needs_same_joint_set(self) -> bool {
        !matches!(self, Self::Heartbeat(_))
    }

    /// Messages a subscriber may have waiting at most: of the truth all that a plant makes in a second.
    pub const fn buffer_size(self) -> usize {
        match self {
            Self::Truth => TRUTHS_KEPT,
            Self::State | Self::Command => MESSAGES_KEPT,
            Self::Heartbeat(_) => 1,
        }
    }

    /// Places for subscribers.
    pub const fn max_subscribers(self) -> usize {
        if matches!(self, Self::Truth) { TRUTH_SUBSCRIBERS } else { MAX_SUBSCRIBERS }
    }
}
