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

/// A reason in words; what is not the controller's own is the message's.
pub fn words(reason: u32) -> &'static str {
    match reason {
        STALE => "the measurement is too old",
        OUT_OF_ORDER => "the measurement is from before the last one",
        ESTIMATOR => "the estimator refused it",
        AHEAD => {
            "the measurement is from a time that has not come: believed, it would make all true ones look old"
        }
        PREDICTION => "the prediction to the time of the command failed",
        STAGE => "a stage of the horizon could not be simulated",
        RICCATI => "the Riccati recursion broke down",
        QP => {
            "the constrained QP gave nothing usable: no finite numbers, or torque limits and contact rows it could not keep"
        }
        FAR => "the plan is farther from the nominal than a linearisation reaches",
        _ => "the message is damaged, or of another robot or version",
    }
}
