//! What control cycles cost: collected in the loop without allocation, evaluated at the end.

use delmpc_messages::{Command, CycleReport, FallbackLevel, Verdict};

use crate::durations::Durations;

/// What one cycle took.
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
}

/// What all cycles of a run took.
#[derive(Debug, Clone, Default)]
pub struct CycleDurations {
    /// Of [`CycleFigure::total_ns`].
    pub total: Durations,
    /// Of [`CycleFigure::feedback_ns`].
    pub feedback: Durations,
    /// Of [`CycleFigure::linearize_ns`].
    pub linearize: Durations,
    /// Of [`CycleFigure::riccati_ns`].
    pub riccati: Durations,
    /// Of [`CycleFigure::qp_ns`].
    pub qp: Durations,
}

/// All cycles of a run. Its memory does not grow with them.
#[derive(Debug, Clone, Default)]
pub struct CycleFigures {
    durations: CycleDurations,
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
    /// Creates the figures of a run without any cycle.
    pub fn new() -> Self {
        let durations = CycleDurations {
            total: Durations::new(),
            feedback: Durations::new(),
            linearize: Durations::new(),
            riccati: Durations::new(),
            qp: Durations::new(),
        };
        Self { durations, ..Self::default() }
    }

    /// Takes in a cycle. No allocation.
    pub fn add(&mut self, command: &Command, figure: CycleFigure) {
        let CycleDurations { total, feedback, linearize, riccati, qp } = &mut self.durations;
        for (durations, time_ns) in [
            (total, figure.total_ns),
            (feedback, figure.feedback_ns),
            (linearize, figure.linearize_ns),
            (riccati, figure.riccati_ns),
            (qp, figure.qp_ns),
        ] {
            durations.add(time_ns);
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

    /// Cycles.
    pub fn count(&self) -> u64 {
        self.verdicts.iter().sum()
    }

    /// The worst rung of the ladder, by name of its code.
    pub fn fallback_level(&self) -> Option<FallbackLevel> {
        FallbackLevel::from_code(self.fallback_level_max)
    }

    /// What the cycles took.
    pub fn durations(&self) -> &CycleDurations {
        &self.durations
    }
}
