//! The wish of a person or a supervisor that a process should end.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag::register;

/// Set by SIGINT, SIGTERM or SIGHUP.
#[derive(Debug, Clone)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// A flag that all three signals set.
    ///
    /// # Errors
    /// When the operating system refuses a handler.
    pub fn on_signals() -> io::Result<Self> {
        let flag = Self::never();
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            register(signal, flag.0.clone())?;
        }
        Ok(flag)
    }

    /// A flag for a process that has a supervisor: a person's Ctrl-C reaches the supervisor too, and it decides.
    ///
    /// # Errors
    /// When the operating system refuses a handler.
    pub fn on_termination_only() -> io::Result<Self> {
        let flag = Self::never();
        register(SIGTERM, flag.0.clone())?;
        for signal in [SIGINT, SIGHUP] {
            register(signal, Arc::default())?;
        }
        Ok(flag)
    }

    /// Makes a write beyond the largest file allowed an error like any other, instead of the end of the process. Without handlers it stays
    /// that.
    pub fn outlive_file_limits() {
        let _ = register(SIGXFSZ, Arc::default());
    }

    /// A flag that nothing sets.
    pub fn never() -> Self {
        Self(Arc::default())
    }

    /// Sets it.
    pub fn set(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the process should end.
    pub fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
