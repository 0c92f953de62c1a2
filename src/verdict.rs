//! How a command ends.

use std::fmt::Display;
use std::process::ExitCode;

use crate::output::say;

/// Why a command did not do what it was asked. Success criteria that were missed are no failure of the command: see [`Ended`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Failure {
    /// Usage, configuration or model: nothing was run. Exit status 2.
    #[error("{0}")]
    Input(String),
    /// Something broke while running: a lost process, a broken link, a full disk. Exit status 3.
    #[error("{0}")]
    Fault(String),
}

impl Failure {
    /// An error in what was given.
    pub fn input(error: impl Display) -> Self {
        Self::Input(error.to_string())
    }

    /// An error while running.
    pub fn fault(error: impl Display) -> Self {
        Self::Fault(error.to_string())
    }

    /// Its exit status.
    pub fn status(&self) -> u8 {
        match self {
            Self::Input(_) => 2,
            Self::Fault(_) => 3,
        }
    }
}

/// How a command that did what it was asked ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// All is well. Exit status 0.
    Well,
    /// A success criterion was missed. Exit status 1.
    CriterionMissed,
    /// The arguments were wrong, and that was said. Exit status 2.
    Misused,
    /// Somebody ended it (Ctrl-C). Exit status 130, as shells have it.
    Interrupted,
}

impl Ended {
    /// Its exit status.
    pub fn status(self) -> u8 {
        match self {
            Self::Well => 0,
            Self::CriterionMissed => 1,
            Self::Misused => 2,
            Self::Interrupted => 130,
        }
    }
}

/// The exit status; a failure is said on standard error.
pub fn exit_code(outcome: Result<Ended, Failure>) -> ExitCode {
    match outcome {
        Ok(ended) => ExitCode::from(ended.status()),
        Err(failure) => {
            say(&format!("delmpc: {failure}"));
            ExitCode::from(failure.status())
        }
    }
}
