//! What can go wrong.

use thiserror::Error;

/// Why a plan cannot be made, read or checked.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum PlanError {
    /// The planner has no equations for this.
    #[error("the planner does not handle {what}")]
    Unsupported {
        /// What it is.
        what: &'static str,
    },
    /// A name of the task is none of the robot's.
    #[error("{kind} `{name}`: the robot has none of that name; it has {known}")]
    UnknownName {
        /// What the name is of.
        kind: &'static str,
        /// The name.
        name: String,
        /// Names there are.
        known: String,
    },
    /// A number of the task is out of its range.
    #[error("{key} = {value}: {rule}")]
    OutOfRange {
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// The rule.
        rule: &'static str,
    },
    /// The mechanics refused the model or a step.
    #[error("mechanics: {0}")]
    Mechanics(String),
    /// A plan file that cannot be used.
    #[error("{file}: {what}")]
    PlanFile {
        /// The file.
        file: String,
        /// What is wrong and what to do.
        what: String,
    },
    /// No convexification made a stage positive definite.
    #[error(
        "the Newton matrix stayed indefinite up to a regularisation of {regularisation:.0e} (stage {stage})"
    )]
    Indefinite {
        /// Largest regularisation tried.
        regularisation: f64,
        /// The stage.
        stage: usize,
    },
}
