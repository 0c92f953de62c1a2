//! Reasons for refusing a state that are the controller's own (`Command::reason`); below 100 they are the message's.

/// The measurement is too old.
pub const STALE: u32 = 100;
/// The measurement is from before the last one.
pub const OUT_OF_ORDER: u32 = 101;
/// The estimator refused it.
pub const ESTIMATOR: u32 = 102;
/// The measurement is from a time that has not come: believed, it would make all true ones look old.
pub const AHEAD: u32 = 103;
/// The prediction to the time of the command failed.
pub const PREDICTION: u32 = 110;
/// A stage of the horizon could not be simulated.
pub const STAGE: u32 = 111;
/// The Riccati recursion broke down.
pub const RICCATI: u32 = 112;
/// The constrained QP gave nothing usable: no finite numbers, or torque limits and contact rows it could not keep.
pub const QP: u32 = 113;
/// The plan is farther from the nominal than a linearisation reaches.
pub const FAR: u32 = 114;
