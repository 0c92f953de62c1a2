//! Why a horizon could not be made.

use delmpc_mechanics::errors::{ModelError, StepError};

/// Why a horizon could not be made, or a stage not be linearised.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HorizonError {
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
    /// A number is not usable.
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
    /// The mechanics refused the model.
    #[error(transparent)]
    Mechanics(#[from] ModelError),
    /// The mechanics could not linearise a stage.
    #[error(transparent)]
    Step(#[from] StepError),
}
