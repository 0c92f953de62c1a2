//! Faults that are injected on purpose.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What goes wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// Messages do not arrive. Commands lost in a row are control cycles dropped.
    Lost,
    /// The message before comes again instead.
    Repeated,
    /// The times in the message are `size_s` too old.
    Stale,
    /// The times in the message are `size_s` ahead.
    Future,
    /// A number is NaN.
    NotANumber,
    /// A number is infinite.
    Infinite,
    /// A number is 1e300.
    Huge,
    /// It is no message of this type.
    WrongType,
    /// It has another version.
    WrongVersion,
    /// It is about other joints.
    WrongJoints,
    /// It is about one joint more.
    WrongJointCount,
    /// The process is stopped (SIGSTOP) for `size_s`.
    Stop,
    /// The process is killed (SIGKILL). A controller is started again, within the same run; a plant ends it.
    Kill,
    /// The whole run is killed at a random moment and started anew, `count` times.
    KillRun,
    /// The process starts `size_s` after the other one.
    LateStart,
    /// The wall clock, which nothing should go by, is moved by `size_s` and back.
    ClockJump,
}

/// All kinds by their words, in the order of [`FaultKind`].
pub(crate) const FAULT_KINDS: [&str; 16] = [
    "lost",
    "repeated",
    "stale",
    "future",
    "not-a-number",
    "infinite",
    "huge",
    "wrong-type",
    "wrong-version",
    "wrong-joints",
    "wrong-joint-count",
    "stop",
    "kill",
    "kill-run",
    "late-start",
    "clock-jump",
];

impl FaultKind {
    /// Whether it happens to messages, not to processes.
    pub fn is_of_messages(self) -> bool {
        !matches!(self, Self::Stop | Self::Kill | Self::KillRun | Self::LateStart | Self::ClockJump)
    }

    /// Its word in a scenario file.
    pub fn word(self) -> &'static str {
        FAULT_KINDS[self as usize]
    }
}

/// What a fault happens to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FaultTarget {
    /// States on their way to the controller.
    State,
    /// Commands on their way to the plant.
    Command,
    /// The plant process.
    Plant,
    /// The controller process.
    Controller,
    /// Everything.
    Machine,
}

impl FaultTarget {
    /// Its word in a scenario file.
    pub fn word(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Command => "command",
            Self::Plant => "plant",
            Self::Controller => "controller",
            Self::Machine => "machine",
        }
    }
}

/// A fault: in every run those of messages, in `delmpc timing --faults` each in a run of its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FaultSettings {
    /// What goes wrong.
    pub kind: FaultKind,
    /// What with.
    pub target: FaultTarget,
    /// When it begins, s; for messages in whole control cycles.
    pub start_s: f64,
    /// Messages in a row, or runs.
    pub count: u32,
    /// Part of these messages that is struck, at random; 0: all of them.
    pub probability: f64,
    /// How late, how early, how long, how far, s.
    pub size_s: f64,
    /// Whether the robot must stand it.
    pub must_stand: bool,
}

impl Default for FaultSettings {
    fn default() -> Self {
        Self {
            kind: FaultKind::Lost,
            target: FaultTarget::Command,
            start_s: 0.5,
            count: 1,
            probability: 0.0,
            size_s: 1.0,
            must_stand: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_are_those_of_the_kinds() {
        for word in FAULT_KINDS {
            let text = format!("kind = \"{word}\"");
            let settings: FaultSettings = toml::from_str(&text).unwrap();
            assert_eq!(settings.kind.word(), word);
        }
    }
}
