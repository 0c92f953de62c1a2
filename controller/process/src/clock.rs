//! The machine's monotonic clock and a timer that does not drift.

use rustix::thread::{ClockId, Timespec, clock_nanosleep_absolute};
use rustix::time::clock_gettime;

const SECOND_NS: u64 = 1_000_000_000;

/// Nanoseconds of the machine's monotonic clock, the same for all processes.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * SECOND_NS + now.tv_nsec as u64
}

/// Sleeps until the monotonic clock shows `time_ns`; returns at once when it does already.
pub fn sleep_until(time_ns: u64) {
    let until = Timespec { tv_sec: (time_ns / SECOND_NS) as i64, tv_nsec: (time_ns % SECOND_NS) as _ };
    while monotonic_ns() < time_ns {
        // Interrupted by a signal: the loop sleeps on.
        if let Err(rustix::io::Errno::INVAL) = clock_nanosleep_absolute(ClockId::Monotonic, &until) {
            return;
        }
    }
}

/// Ticks at multiples of a period from a start, whatever happens between them. A tick that was slept through is left out.
#[derive(Debug, Clone)]
pub struct Ticker {
    period_ns: u64,
    next_ns: u64,
}

/// How a tick came.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tick {
    /// When it was due.
    pub due_ns: u64,
    /// How much later we woke up.
    pub late_ns: u64,
    /// Ticks left out before this one.
    pub missed: u64,
}

impl Ticker {
    /// First tick at `start_ns`.
    pub fn new(start_ns: u64, period_ns: u64) -> Self {
        Self { period_ns: period_ns.max(1), next_ns: start_ns }
    }

    /// Sleeps until the next tick.
    pub fn wait(&mut self) -> Tick {
        let missed = self.leave_out(monotonic_ns());
        let due_ns = self.next_ns;
        sleep_until(due_ns);
        self.next_ns += self.period_ns;
        Tick { due_ns, late_ns: monotonic_ns().saturating_sub(due_ns), missed }
    }

    /// Steps over ticks that are a whole period or more in the past.
    fn leave_out(&mut self, now_ns: u64) -> u64 {
        let missed = now_ns.saturating_sub(self.next_ns) / self.period_ns;
        self.next_ns += missed * self.period_ns;
        missed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_stay_on_their_grid() {
        let start = monotonic_ns();
        let mut ticker = Ticker::new(start, 200_000);
        for _ in 0..20 {
            let tick = ticker.wait();
            assert_eq!((tick.due_ns - start) % 200_000, 0);
            assert!(monotonic_ns() >= tick.due_ns);
        }
    }

    #[test]
    fn a_late_tick_comes_and_older_ones_do_not() {
        let mut ticker = Ticker::new(1_000, 100);
        assert_eq!(ticker.leave_out(1_099), 0, "less than a period late");
        assert_eq!(ticker.leave_out(1_350), 3);
        assert_eq!(ticker.next_ns, 1_300);
        assert_eq!(ticker.leave_out(500), 0);
    }
}
