//! What control cycles cost: collected in the loop without allocation, evaluated at the end.

use delmpc_messages::{Command, CycleReport, FallbackLevel, Verdict};

/// Figures kept of each cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CycleFigure {
    /// Everything computed for the command, what was prepared ahead included, from the tick on (ns).
    pub total_ns: u64,
    /// From the tick to the command sent (ns).
    pub feedback_ns: u64,
    /// Linearising (ns).
    pub linearize_ns: u64,
    /// Riccati recursion (ns).
    pub riccati_ns: u64,
    /// Constrained QP (ns).
    pub qp_ns: u64,
    /// From the measurement to the command sent, by the monotonic clock (ns).
    pub age_ns: u64,
}

/// All cycles of a run.
#[derive(Debug, Clone, Default)]
pub struct CycleFigures {
    cycles: Vec<CycleFigure>,
    /// Cycles whose command was not out one period after their tick, and ticks that were slept through.
    pub deadline_misses: u64,
    /// QP solves, over all cycles.
    pub qp_solves: u64,
    /// Most interior-point iterations of one cycle.
    pub qp_iterations_max: u32,
    /// Worst rung of the fallback ladder.
    pub fallback_level_max: u32,
    /// Most heap allocations of one cycle.
    pub allocations_max: u32,
    /// Cycles of each verdict.
    pub verdicts: [u64; 5],
    /// States that were refused.
    pub states_refused: u64,
}

impl CycleFigures {
    /// Room for `capacity` cycles; more are counted, but not in the percentiles.
    pub fn with_capacity(capacity: usize) -> Self {
        Self { cycles: Vec::with_capacity(capacity), ..Self::default() }
    }

    /// Takes in a cycle.
    pub fn add(&mut self, command: &Command, figure: CycleFigure) {
        if self.cycles.len() < self.cycles.capacity() {
            self.cycles.push(figure);
        }
        let report: &CycleReport = &command.report;
        self.qp_solves += u64::from(report.qp_solves);
        self.qp_iterations_max = self.qp_iterations_max.max(report.qp_iterations);
        self.allocations_max = self.allocations_max.max(report.allocations);
        self.fallback_level_max = self.fallback_level_max.max(command.fallback_level);
        let verdict = command.verdict().unwrap_or(Verdict::BadState);
        self.verdicts[verdict as usize] += 1;
        self.states_refused += u64::from(verdict == Verdict::BadState);
    }

    /// Cycles there is room for.
    pub fn capacity(&self) -> usize {
        self.cycles.capacity()
    }

    /// Cycles.
    pub fn count(&self) -> u64 {
        self.verdicts.iter().sum()
    }

    /// The worst rung of the ladder, by name of its code.
    pub fn fallback_level(&self) -> Option<FallbackLevel> {
        FallbackLevel::from_code(self.fallback_level_max)
    }

    /// Percentiles (0..1) of one figure, s; `None` without cycles.
    pub fn percentiles_s<const N: usize>(
        &self,
        figure: impl Fn(&CycleFigure) -> u64,
        at: [f64; N],
    ) -> [Option<f64>; N] {
        let mut values: Vec<u64> = self.cycles.iter().map(figure).collect();
        values.sort_unstable();
        at.map(|part| percentile(&values, part).map(|ns| ns as f64 * 1e-9))
    }
}

/// Nearest-rank percentile of sorted values.
pub fn percentile(sorted: &[u64], part: f64) -> Option<u64> {
    let rank = (part * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.clamp(1, sorted.len().max(1)) - 1).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_values_that_occurred() {
        let values: Vec<u64> = (1..=1000).collect();
        assert_eq!(percentile(&values, 0.5), Some(500));
        assert_eq!(percentile(&values, 0.999), Some(999));
        assert_eq!(percentile(&values, 1.0), Some(1000));
        assert_eq!(percentile(&[7], 0.0), Some(7));
        assert_eq!(percentile(&[], 0.5), None);
    }
}
