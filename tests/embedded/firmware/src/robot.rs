//! The robot this firmware is for: constants that `delmpc model --emit rust` wrote, one file per feature.

#[cfg_attr(feature = "lamp", path = "../robots/lamp.rs")]
#[cfg_attr(feature = "leg", path = "../robots/leg.rs")]
#[cfg_attr(feature = "littledog_leg", path = "../robots/littledog_leg.rs")]
#[cfg_attr(feature = "flamingo_leg", path = "../robots/flamingo_leg.rs")]
mod table;

pub use table::{ROBOT, config, watchdog};
