//! Elapsed time of the steps of a cycle, ns, by a clock of the caller: this crate has none of its own.

/// Tells elapsed time, for the report, and for how far ahead the next cycle has to be prepared.
pub trait Clock {
    /// Monotonic time, ns.
    fn now_ns(&self) -> u64;
}

/// A clock that stands still: for reproducible runs.
#[derive(Clone, Copy, Debug, Default)]
pub struct StoppedClock;

impl Clock for StoppedClock {
    fn now_ns(&self) -> u64 {
        0
    }
}

/// Times the steps of a cycle.
pub(crate) struct StopWatch<'a> {
    clock: &'a dyn Clock,
    last: u64,
}

impl<'a> StopWatch<'a> {
    pub fn start(clock: &'a dyn Clock) -> Self {
        Self { clock, last: clock.now_ns() }
    }

    /// Time since the last call, ns.
    pub fn lap(&mut self) -> u64 {
        let now = self.clock.now_ns();
        let lap = now.saturating_sub(self.last);
        self.last = now;
        lap
    }
}
