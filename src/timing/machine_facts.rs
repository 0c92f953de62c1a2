//! The machine the figures are from: what has to stand beside any figure of time.

use std::fs;

use serde::Serialize;

/// What the operating system says of its machine. Nothing where it does not say.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MachineFacts {
    /// Model of the processor.
    pub processor: Option<String>,
    /// Cores in use.
    pub cores: usize,
    /// Whether a hypervisor is between us and the machine.
    pub virtual_machine: bool,
    /// Version of the kernel.
    pub kernel: Option<String>,
    /// Source of the clock.
    pub clock_source: Option<String>,
    /// Time per second real-time threads may have a core, if it is bounded (µs).
    pub realtime_budget_us: Option<i64>,
    /// Whether the kernel counts time that a hypervisor gives to others.
    pub steal_seen: bool,
}

impl MachineFacts {
    /// Asks.
    pub fn read() -> Self {
        let processor = text("/proc/cpuinfo");
        let field = |name: &str| {
            let line = processor.as_ref()?.lines().find(|line| line.starts_with(name))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        };
        Self {
            cores: std::thread::available_parallelism().map_or(0, usize::from),
            virtual_machine: field("flags").is_some_and(|flags| flags.contains(" hypervisor")),
            processor: field("model name"),
            kernel: text("/proc/sys/kernel/osrelease"),
            clock_source: text("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
            realtime_budget_us: text("/proc/sys/kernel/sched_rt_runtime_us").and_then(|t| t.parse().ok()),
            steal_seen: steal_ticks().is_some_and(|ticks| ticks > 0),
        }
    }

    /// As one line.
    pub fn line(&self) -> String {
        let mut parts = vec![
            self.processor.clone().unwrap_or_else(|| "unknown processor".to_owned()),
            format!("{} cores", self.cores),
        ];
        if self.virtual_machine {
            let steal = if self.steal_seen { "steal time is seen" } else { "no steal time seen" };
            parts.push(format!("virtual machine ({steal})"));
        }
        parts.extend(self.kernel.iter().map(|kernel| format!("kernel {kernel}")));
        parts.extend(self.clock_source.iter().map(|source| format!("clock {source}")));
        if let Some(budget) = self.realtime_budget_us.filter(|budget| *budget > 0) {
            parts.push(format!("real-time threads have at most {:.0} % of a core", budget as f64 / 1e4));
        }
        parts.join(", ")
    }
}

/// Time given to others, all cores together, in ticks of the kernel.
fn steal_ticks() -> Option<u64> {
    let stat = text("/proc/stat")?;
    stat.lines().next()?.split_whitespace().nth(8)?.parse().ok()
}

fn text(path: &str) -> Option<String> {
    fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_what_is_known() {
        let facts = MachineFacts {
            processor: Some("P".to_owned()),
            cores: 2,
            virtual_machine: true,
            realtime_budget_us: Some(950_000),
            ..MachineFacts::default()
        };
        let expected =
            "P, 2 cores, virtual machine (no steal time seen), real-time threads have at most 95 % of a core";
        assert_eq!(facts.line(), expected);
        assert!(MachineFacts::read().cores > 0);
    }
}
