//! Plans, their checks and their derivatives. One program: the long searches go on side by side, and the libraries are linked once.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod atlas_pick;
#[path = "../common/mod.rs"]
mod common;
mod delivered_plans;
mod derivatives;
mod flamingo_jump;
mod littledog_gaps;
