//! What can go wrong in the plant, as values.

use delmpc_mechanics::errors::{ModelError, StepError};

/// Why a plant could not be built, or a step could not be taken. After a failed step the plant's state is as before it.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PlantError {
    /// The integrator did not take the step.
    #[error("the integrator did not take the step at t = {time} s: {cause}")]
    Step {
        /// Time of the start of the step, s.
        time: f64,
        /// What the integrator says.
        cause: StepError,
    },
    /// The model was refused.
    #[error("the robot's model is unusable: {0}")]
    Model(#[from] ModelError),
    /// The servo's configuration was refused.
    #[error(transparent)]
    Servo(#[from] delmpc_servo::error::ServoError),
    /// A number of the configuration is outside its range.
    #[error("{quantity} is {value}, it must be {rule}")]
    Configuration {
        /// Which quantity.
        quantity: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        rule: &'static str,
    },
    /// A list of the configuration has the wrong length or points at something that does not exist.
    #[error("{quantity}: {got} given, {expected} expected")]
    Shape {
        /// Which quantity.
        quantity: &'static str,
        /// What was given.
        got: usize,
        /// What is needed, or the number of things that exist.
        expected: usize,
    },
    /// The cone solver could not be set up.
    #[error("the contact solver for {contacts} contacts could not be set up")]
    ConeSolver {
        /// Number of contacts.
        contacts: usize,
    },
}

/// `Ok` when `accept` holds.
pub(crate) fn require(
    accept: bool,
    quantity: &'static str,
    value: f64,
    rule: &'static str,
) -> Result<(), PlantError> {
    if accept { Ok(()) } else { Err(PlantError::Configuration { quantity, value, rule }) }
}

pub(crate) fn require_length(quantity: &'static str, got: usize, expected: usize) -> Result<(), PlantError> {
    if got == expected { Ok(()) } else { Err(PlantError::Shape { quantity, got, expected }) }
}
