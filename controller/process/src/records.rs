//! Every cycle of the controller and every step of the plant with its times: plain data, kept in memory that is there before the run.
//!
//! All times are of the monotonic clock (ns), the same for both processes.

use bytemuck::{Pod, Zeroable};
use delmpc_messages::{Command, CycleReport, PlantState};

use crate::usage::Usage;

/// One control cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct CycleRecord {
    /// When its tick was due.
    pub due_ns: u64,
    /// When the thread woke up.
    pub woke_ns: u64,
    /// When the state was there and the cycle began.
    pub begin_ns: u64,
    /// When the command was computed.
    pub computed_ns: u64,
    /// When it was sent.
    pub sent_ns: u64,
    /// When the cycle was over: the next one prepared as far as it can be.
    pub done_ns: u64,
    /// Time on the core from beginning to end.
    pub cpu_ns: u64,
    /// When the plant sent the state.
    pub state_sent_ns: u64,
    /// Stage: state in.
    pub state_in_ns: u64,
    /// Stage: shift and simulate; for the next cycle, where it is prepared ahead.
    pub shift_ns: u64,
    /// Stage: linearise; for the next cycle, where it is prepared ahead.
    pub linearize_ns: u64,
    /// Stage: Riccati recursion; for the next cycle, where it is prepared ahead.
    pub riccati_ns: u64,
    /// Stage: constrained QP.
    pub qp_ns: u64,
    /// Which state was answered.
    pub state_sequence: u64,
    /// Ticks that were slept through before this one.
    pub missed_ticks: u32,
    /// Page faults without the disk.
    pub minor_faults: u32,
    /// Page faults with it.
    pub major_faults: u32,
    /// Context switches because the thread waited.
    pub voluntary_switches: u32,
    /// Context switches because something else was given the core.
    pub involuntary_switches: u32,
    /// Heap allocations of the cycle.
    pub allocations: u32,
    /// Rung of the fallback ladder.
    pub fallback_level: u32,
    /// How the cycle ended, as in the command.
    pub verdict: u32,
    /// QP solves.
    pub qp_solves: u32,
    /// Nothing.
    pub padding: u32,
}

impl CycleRecord {
    /// `times`: due, woke up, begun, computed, sent, done.
    pub(crate) fn new(
        times: [u64; 6],
        missed_ticks: u64,
        state: &PlantState,
        command: &Command,
        used: &Usage,
    ) -> Self {
        let [due_ns, woke_ns, begin_ns, computed_ns, sent_ns, done_ns] = times;
        let report = &command.report;
        Self {
            due_ns,
            woke_ns,
            begin_ns,
            computed_ns,
            sent_ns,
            done_ns,
            cpu_ns: used.cpu_ns,
            state_sent_ns: state.header.sent_at_ns,
            state_in_ns: report.state_in_ns,
            shift_ns: report.shift_ns,
            linearize_ns: report.linearize_ns,
            riccati_ns: report.riccati_ns,
            qp_ns: report.qp_ns,
            state_sequence: state.header.sequence,
            missed_ticks: missed_ticks as u32,
            minor_faults: used.minor_faults as u32,
            major_faults: used.major_faults as u32,
            voluntary_switches: used.voluntary_switches as u32,
            involuntary_switches: used.involuntary_switches as u32,
            allocations: report.allocations,
            fallback_level: command.fallback_level,
            verdict: command.verdict,
            qp_solves: report.qp_solves,
            padding: 0,
        }
    }
}

impl Records<CycleRecord> {
    /// Moves the stages that a report names as done ahead to the cycle in which they were: the last one.
    pub(crate) fn credit_preparation(&mut self, report: &CycleReport) {
        if let Some(last) = self.list.last_mut() {
            last.shift_ns = report.shift_ns;
            last.linearize_ns = report.linearize_ns;
            last.riccati_ns = report.riccati_ns;
        }
    }
}

/// One step of the plant.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct StepRecord {
    /// When the step was due.
    pub due_ns: u64,
    /// When the thread woke up.
    pub woke_ns: u64,
    /// When the command had been looked for and the step began.
    pub begin_ns: u64,
    /// When the step was computed.
    pub end_ns: u64,
    /// When its state was sent.
    pub sent_ns: u64,
    /// Time on the core from waking up to sent.
    pub cpu_ns: u64,
    /// The plant's clock after the step.
    pub time_ns: u64,
    /// When the command that came before the step had been sent; 0: none came.
    pub command_sent_ns: u64,
    /// From the measurement to the arrival of its command; 0: none came.
    pub age_ns: u64,
    /// Distance of the pressure point from the edge of the sole (m).
    pub cop_margin_m: f64,
    /// Level of the plant's watchdog.
    pub watchdog_level: u32,
    /// Status bits of the plant.
    pub status_flags: u32,
    /// Page faults without the disk.
    pub minor_faults: u32,
    /// Page faults with it.
    pub major_faults: u32,
    /// Context switches because the thread waited, other than for the step's time.
    pub voluntary_switches: u32,
    /// Context switches because something else was given the core.
    pub involuntary_switches: u32,
}

/// Records of a run. Keeping one takes no allocation and touches no fresh page; beyond the capacity they are counted only.
#[derive(Debug, Clone, Default)]
pub struct Records<R> {
    list: Vec<R>,
    lost: u64,
}

impl<R: Pod> Records<R> {
    /// None are kept.
    pub fn none() -> Self {
        Self { list: Vec::new(), lost: 0 }
    }

    /// Room for `capacity` records, every page of it touched.
    pub fn with_capacity(capacity: usize) -> Self {
        // Not zeros: those the operating system would give without giving memory.
        let mut list = Vec::with_capacity(capacity);
        let mut one = R::zeroed();
        bytemuck::bytes_of_mut(&mut one).fill(0xff);
        list.resize(capacity, one);
        list.clear();
        Self { list, lost: 0 }
    }

    /// Whether records are kept at all.
    pub fn are_kept(&self) -> bool {
        self.list.capacity() > 0
    }

    /// Keeps a record, if there is room.
    pub fn keep(&mut self, record: R) {
        if self.list.len() < self.list.capacity() {
            self.list.push(record);
        } else {
            self.lost += 1;
        }
    }

    /// Forgets all records.
    pub fn clear(&mut self) {
        self.list.clear();
        self.lost = 0;
    }

    /// The records.
    pub fn list(&self) -> &[R] {
        &self.list
    }

    /// Records for which there was no room.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// The records as bytes, as [`read_records`] takes them.
    pub fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.list)
    }
}

/// Records from their bytes; `None` when it is no whole number of records.
pub fn read_records<R: Pod>(bytes: &[u8]) -> Option<Vec<R>> {
    let chunks = bytes.chunks_exact(size_of::<R>());
    chunks.remainder().is_empty().then(|| chunks.map(bytemuck::pod_read_unaligned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_read_back_and_what_has_no_room_is_counted() {
        let mut records = Records::with_capacity(3);
        for due_ns in 0..5 {
            records.keep(CycleRecord { due_ns, ..CycleRecord::default() });
        }
        assert_eq!((records.list().len(), records.lost()), (3, 2));
        assert_eq!(read_records::<CycleRecord>(records.bytes()).unwrap(), records.list());
        assert_eq!(read_records::<CycleRecord>(&records.bytes()[1..]), None);
        assert!(!Records::<StepRecord>::none().are_kept());
    }
}
