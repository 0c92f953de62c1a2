//! The robot this firmware is for: constants that `delmpc model --emit rust` wrote, one file per feature.

#[cfg(feature = "lamp")]
#[path = "../robots/lamp.rs"]
mod table;

pub use table::{ROBOT, config, watchdog};
