//! What can be wrong with a servo's configuration.

/// Why a servo could not be made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ServoError {
    /// A time is outside its range.
    #[error("watchdog time is {seconds}, it must be in [0, 1e9) s")]
    Time {
        /// What was given, s.
        seconds: f64,
    },
    /// A list has the wrong length.
    #[error("{quantity}: {got} given, {expected} expected")]
    Length {
        /// Which list.
        quantity: &'static str,
        /// Entries given.
        got: usize,
        /// Entries needed.
        expected: usize,
    },
}
