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
}

impl Channel {
    /// The name of the channel within its run.
    pub fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Command => "command",
            Self::Heartbeat(Role::Plant) => "heartbeat-plant",
            Self::Heartbeat(Role::Controller) => "heartbeat-controller",
            Self::Heartbeat(Role::Supervisor) => "heartbeat-supervisor",
        }
    }

    /// Whether both ends must have the same joint set to connect. Heartbeats connect anyway, so that the supervisor can say who differs.
    pub(crate) fn needs_same_joint_set(self) -> bool {
        matches!(self, Self::State | Self::Command)
    }
}
