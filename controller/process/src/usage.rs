//! What the calling thread has used of the machine so far.

use nix::sys::resource::{UsageWho, getrusage};
use rustix::time::{ClockId, clock_gettime};

/// Counts of the calling thread since it began, or their difference.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Usage {
    /// Time on a core (ns). What a hypervisor takes away does not count where it says so (steal time).
    pub cpu_ns: u64,
    /// Page faults served without the disk.
    pub minor_faults: u64,
    /// Page faults that had to wait for the disk.
    pub major_faults: u64,
    /// Context switches because the thread waited.
    pub voluntary_switches: u64,
    /// Context switches because something else was given the core.
    pub involuntary_switches: u64,
}

impl Usage {
    /// Up to now; zero for what the operating system does not tell. Cost: two system calls, below a microsecond.
    pub fn now() -> Self {
        let cpu = clock_gettime(ClockId::ThreadCPUTime);
        let cpu_ns = cpu.tv_sec as u64 * 1_000_000_000 + cpu.tv_nsec as u64;
        match getrusage(UsageWho::RUSAGE_THREAD) {
            Err(_) => Self { cpu_ns, ..Self::default() },
            Ok(usage) => Self {
                cpu_ns,
                minor_faults: usage.minor_page_faults() as u64,
                major_faults: usage.major_page_faults() as u64,
                voluntary_switches: usage.voluntary_context_switches() as u64,
                involuntary_switches: usage.involuntary_context_switches() as u64,
            },
        }
    }

    /// What was used since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        Self {
            cpu_ns: self.cpu_ns.saturating_sub(before.cpu_ns),
            minor_faults: self.minor_faults.saturating_sub(before.minor_faults),
            major_faults: self.major_faults.saturating_sub(before.major_faults),
            voluntary_switches: self.voluntary_switches.saturating_sub(before.voluntary_switches),
            involuntary_switches: self.involuntary_switches.saturating_sub(before.involuntary_switches),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn a_thread_that_waits_uses_no_cpu_and_switches() {
        let before = Usage::now();
        std::thread::sleep(Duration::from_millis(20));
        let used = Usage::now().since(&before);
        assert!(used.voluntary_switches >= 1, "{used:?}");
        assert!(used.cpu_ns < 20_000_000, "{used:?}");
    }

    #[test]
    fn fresh_memory_faults() {
        let before = Usage::now();
        let memory = std::hint::black_box(vec![1_u8; 1 << 22]);
        let used = Usage::now().since(&before);
        assert_eq!(memory[4096], 1);
        assert!(used.minor_faults > 0 && used.cpu_ns > 0, "{used:?}");
    }
}
