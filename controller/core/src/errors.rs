//! Why a controller could not be made.

use delmpc_horizon::errors::HorizonError;
use delmpc_lq::errors::LqError;
use delmpc_mechanics::errors::{ModelError, StepError};

/// Why a [`crate::cycle::Controller`] could not be made. Belongs to start-up only: a cycle always answers.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// A quantity has the wrong number of entries.
    #[error("{quantity} has {found} entries, expected {expected}")]
    Length {
        /// Which quantity.
        quantity: &'static str,
        /// Its length.
        found: usize,
        /// The length needed.
        expected: usize,
    },
    /// A number of the model or the configuration is not usable.
    #[error("{quantity} is {value} at index {index}: {rule}")]
    Value {
        /// Which quantity.
        quantity: &'static str,
        /// Index in it.
        index: usize,
        /// The value found.
        value: f64,
        /// What it must be.
        rule: &'static str,
    },
    /// More joints than a message has room for, or a tree that does not fit the controller.
    #[error("the model is not usable: {reason}")]
    Model {
        /// What is wrong.
        reason: &'static str,
    },
    /// The linear-quadratic problem has no solution.
    #[error(transparent)]
    Lq(#[from] LqError),
    /// Feet, limits or cones are not usable.
    #[error(transparent)]
    Horizon(#[from] HorizonError),
    /// The mechanics refused the model.
    #[error(transparent)]
    Mechanics(#[from] ModelError),
    /// The mechanics could not take a step at the goal posture.
    #[error(transparent)]
    Step(#[from] StepError),
}
