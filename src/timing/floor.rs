//! The machine's floor: threads on an absolute timer that do nothing, or fixed work, beside which the loop is judged.
//!
//! | thread | what it tells |
//! |---|---|
//! | idle, at the loop's period | how late this machine wakes somebody up |
//! | witness, every millisecond, above the loop's priority, with a little fixed work | when a core was taken away from everybody, and when it computed slowly, also while the loop computed |
//! | occupied: fixed work that takes as long as a cycle | which share of deadlines the machine makes anybody miss |
//!
//! A witness whose due time passes while its core is taken away notes both times: an interval in which nothing of ours ran. It costs about
//! two per cent of its core; that is known, and no blame of the machine.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};

use delmpc_controller_process::awake::Awake;
use delmpc_controller_process::clock::{Ticker, monotonic_ns};
use delmpc_controller_process::machine::{is_realtime, prepare};
use delmpc_controller_process::records::Records;
use delmpc_controller_process::usage::Usage;
use delmpc_scenario::ProcessSettings;

use bytemuck::{Pod, Zeroable};

use crate::timing::probe::Probe;
use crate::verdict::Failure;

/// Period of a witness (ns).
pub const WITNESS_NS: u64 = 1_000_000;

/// What a floor thread does and where.
#[derive(Debug, Clone)]
pub struct FloorSettings {
    /// Its core; any when not given.
    pub core: Option<usize>,
    /// Priority and memory, as for the loop's processes.
    pub process: ProcessSettings,
    /// Time between two ticks (ns).
    pub period_ns: u64,
    /// What it does at each tick.
    pub work: Work,
    /// For how long at most (ns).
    pub duration_ns: u64,
}

/// What a floor thread does at each tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Nothing.
    Nothing,
    /// A little fixed work, always the same.
    Probe,
    /// Fixed work that takes this long as a rule (ns).
    Occupied(u64),
}

/// Units of a witness's work: some microseconds.
const PROBE_UNITS: u32 = 60;
/// Rounds in which an occupied thread finds out how much work takes how long.
const CALIBRATION_ROUNDS: usize = 101;

/// One tick of a floor thread, by the monotonic clock.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct FloorTick {
    /// When it was due (ns).
    pub due_ns: u64,
    /// When the thread woke up (ns).
    pub woke_ns: u64,
    /// When its work was done (ns).
    pub done_ns: u64,
    /// Ticks slept through before this one.
    pub missed: u64,
}

impl FloorTick {
    /// How late it came (ns).
    pub fn late_ns(&self) -> u64 {
        self.woke_ns.saturating_sub(self.due_ns)
    }
}

/// What a floor thread saw.
#[derive(Debug, Clone, Default)]
pub struct FloorRun {
    /// All ticks.
    pub ticks: Vec<FloorTick>,
    /// What the operating system refused.
    pub warnings: Vec<String>,
    /// Whether it had a real-time priority: only then nothing of ours held it up.
    pub realtime: bool,
    /// Time on its core per tick (ns).
    pub cpu_per_tick_ns: u64,
}

/// A running floor thread.
#[derive(Debug)]
pub struct FloorThread {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<FloorRun>,
}

impl FloorThread {
    /// Starts one.
    ///
    /// # Errors
    /// When there can be no further thread.
    pub fn start(settings: FloorSettings) -> Result<Self, Failure> {
        let stop = Arc::new(AtomicBool::new(false));
        let flag = stop.clone();
        let thread = Builder::new().name("floor".to_owned());
        let thread = thread.spawn(move || run(&settings, &flag)).map_err(Failure::fault)?;
        Ok(Self { stop, thread })
    }

    /// Ends it and says what it saw.
    ///
    /// # Errors
    /// When the thread broke down.
    pub fn finish(self) -> Result<FloorRun, Failure> {
        self.stop.store(true, Ordering::Relaxed);
        self.join()
    }

    /// Waits until its time is over.
    ///
    /// # Errors
    /// When the thread broke down.
    pub fn join(self) -> Result<FloorRun, Failure> {
        self.thread.join().map_err(|_| Failure::Fault("a thread of the floor broke down".to_owned()))
    }
}

fn run(settings: &FloorSettings, stop: &AtomicBool) -> FloorRun {
    let _awake = Awake::keep(&settings.process, settings.core);
    let warnings = prepare(&settings.process, settings.core);
    let mut probe = Probe::new();
    let units = match settings.work {
        Work::Nothing => 0,
        Work::Probe => PROBE_UNITS,
        Work::Occupied(time_ns) => (time_ns as f64 / unit_ns(&mut probe)) as u32,
    };
    let mut records = Records::with_capacity((settings.duration_ns / settings.period_ns) as usize + 1000);
    let begin_ns = monotonic_ns() + settings.period_ns;
    let mut ticker = Ticker::new(begin_ns, settings.period_ns);
    let before = Usage::now();
    while !stop.load(Ordering::Relaxed) {
        let tick = ticker.wait();
        let woke_ns = tick.due_ns + tick.late_ns;
        probe.work(units);
        let done_ns = if units > 0 { monotonic_ns() } else { woke_ns };
        records.keep(FloorTick { due_ns: tick.due_ns, woke_ns, done_ns, missed: tick.missed });
        if done_ns >= begin_ns + settings.duration_ns {
            break;
        }
    }
    let cpu_ns = Usage::now().since(&before).cpu_ns;
    let ticks = records.list().to_vec();
    let cpu_per_tick_ns = cpu_ns / (ticks.len() as u64).max(1);
    FloorRun { ticks, warnings, realtime: is_realtime(), cpu_per_tick_ns }
}

/// Median time of a unit of work (ns).
fn unit_ns(probe: &mut Probe) -> f64 {
    let mut times: Vec<u64> = (0..CALIBRATION_ROUNDS)
        .map(|_| {
            let begin_ns = monotonic_ns();
            probe.work(10 * PROBE_UNITS);
            monotonic_ns() - begin_ns
        })
        .collect();
    times.sort_unstable();
    times[CALIBRATION_ROUNDS / 2].max(1) as f64 / f64::from(10 * PROBE_UNITS)
}

/// Intervals longer than `event_ns` in which a witness was due and did not run: somebody else had its core. In the order of time.
pub fn stalls(ticks: &[FloorTick], event_ns: u64) -> Vec<[u64; 2]> {
    let late = ticks.iter().filter(|tick| tick.late_ns() >= event_ns);
    late.map(|tick| [tick.due_ns, tick.woke_ns]).collect()
}

/// Ticks at which a witness came within an interval.
pub fn ticks_in(ticks: &[FloorTick], [begin, end]: [u64; 2]) -> &[FloorTick] {
    let before = |limit: u64| ticks.partition_point(|tick| tick.woke_ns < limit);
    &ticks[before(begin)..before(end.max(begin))]
}

/// Time that intervals in the order of time share with one interval (ns).
pub fn overlap(stalls: &[[u64; 2]], [begin, end]: [u64; 2]) -> u64 {
    let first = stalls.partition_point(|stall| stall[1] <= begin);
    let shared = stalls[first..].iter().take_while(|stall| stall[0] < end);
    shared.map(|stall| stall[1].min(end).saturating_sub(stall[0].max(begin))).sum()
}

/// Ticks, those slept through included.
pub fn deadlines(ticks: &[FloorTick]) -> u64 {
    ticks.iter().map(|tick| 1 + tick.missed).sum()
}

/// Ticks that were late by a whole period when their work was done, and those slept through.
pub fn missed_deadlines(ticks: &[FloorTick], period_ns: u64) -> u64 {
    ticks.iter().map(|tick| tick.missed + u64::from(tick.done_ns > tick.due_ns + period_ns)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(work: Work) -> FloorSettings {
        let process = ProcessSettings { priority: 0, lock_memory: false, ..ProcessSettings::default() };
        FloorSettings { core: None, process, period_ns: 1_000_000, work, duration_ns: 30_000_000 }
    }

    #[test]
    fn an_idle_thread_notes_every_tick_and_an_occupied_one_is_busy() {
        let idle = FloorThread::start(settings(Work::Nothing)).unwrap().join().unwrap();
        assert!(!idle.ticks.is_empty());
        assert!(idle.ticks.iter().all(|tick| tick.done_ns == tick.woke_ns && tick.woke_ns >= tick.due_ns));
        let busy = FloorThread::start(settings(Work::Occupied(200_000))).unwrap().join().unwrap();
        assert!(busy.ticks.iter().all(|tick| tick.done_ns > tick.woke_ns));
        let some = FloorThread::start(settings(Work::Probe)).unwrap().join().unwrap();
        assert!(some.ticks.iter().all(|tick| tick.done_ns > tick.woke_ns) && some.cpu_per_tick_ns > 0);
    }

    #[test]
    fn a_thread_that_is_told_to_ends_early() {
        let thread = FloorThread::start(FloorSettings {
            duration_ns: u64::MAX / 1_000_000,
            ..settings(Work::Nothing)
        });
        thread.unwrap().finish().unwrap();
    }

    #[test]
    fn what_stalls_and_an_interval_share() {
        let tick = |due_ns, woke_ns| FloorTick { due_ns, woke_ns, done_ns: woke_ns, missed: 0 };
        let ticks = [tick(100, 101), tick(200, 260), tick(300, 309), tick(400, 440)];
        let stalls = stalls(&ticks, 10);
        assert_eq!(stalls, [[200, 260], [400, 440]]);
        for (interval, shared) in [
            ([0, 200], 0),
            ([0, 210], 10),
            ([220, 420], 60),
            ([250, 255], 5),
            ([440, 900], 0),
            ([0, 900], 100),
        ] {
            assert_eq!(overlap(&stalls, interval), shared, "{interval:?}");
        }
    }

    #[test]
    fn ticks_in_an_interval_are_counted() {
        let ticks = [10, 20, 30].map(|woke_ns| FloorTick { woke_ns, ..FloorTick::default() });
        let counts = [[0, 10], [0, 11], [10, 30], [15, 99]].map(|interval| ticks_in(&ticks, interval).len());
        assert_eq!(counts, [0, 1, 2, 2]);
    }

    #[test]
    fn deadlines_of_a_thread_are_those_it_slept_through_and_those_it_overran() {
        let tick = |due_ns, done_ns, missed| FloorTick { due_ns, woke_ns: due_ns, done_ns, missed };
        let ticks = [tick(0, 50, 0), tick(100, 201, 0), tick(300, 310, 1)];
        assert_eq!((missed_deadlines(&ticks, 100), deadlines(&ticks)), (2, 4));
    }
}
