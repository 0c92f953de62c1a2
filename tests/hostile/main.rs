//! The real command where somebody or something is against it: other users' files, short and full file systems, limits, closed outputs,
//! names and numbers that nobody would give on purpose. Whatever happens, it ends by itself, with one sentence and the right status, and
//! nothing of the user's is lost.
//!
//! File systems are mounted in a mount namespace of the test's own; where that is not permitted, the test says so and is skipped.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod apart;
mod file_systems;
mod folders;
mod input;
mod logs;
mod outputs;
mod support;
