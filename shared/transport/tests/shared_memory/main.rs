//! Links over shared memory, within one process and between real processes. No test asserts a time; each has a watchdog.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests, too

mod leftovers;
mod one_process;
mod support;
mod two_processes;
