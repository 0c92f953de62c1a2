//! What needs no clock: the command as it is called, and runs in lockstep. One program, so that long runs go on side by side and the
//! libraries are linked once. What depends on real time, or counts memory, is a program of its own beside this folder.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on has failed"
)]

mod check_command;
mod command;
mod constrained_plan;
mod faults;
mod feeling;
mod init_command;
mod init_robots;
mod legged;
mod limits;
#[path = "../made_up/mod.rs"]
mod made_up;
mod own_robot;
mod person;
mod plan_command;
mod planned_motion;
mod prediction;
mod unsafe_code;
mod watchdog;
