//! The phases of the test, one after the other, and the figures of each.

use std::path::Path;

use delmpc_controller_process::records::{CycleRecord, StepRecord};
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::FallbackLevel;
use delmpc_scenario::{ProcessSettings, Scenario};
use serde::Serialize;

use crate::setup::Setup;
use crate::supervisor::Course;
use crate::timing::again::{Again, compute_again};
use crate::timing::attribution::{
    Account, Cause, Evidence, LongCycle, Miss, Stage, Witness, accounts, longest_undisturbed, misses,
};
use crate::timing::co_load::{CoLoad, LoadDone};
use crate::timing::figures::{Bar, Figures, Times};
use crate::timing::floor::{
    FloorRun, FloorSettings, FloorThread, FloorTick, Work, deadlines, missed_deadlines, stalls,
};
use crate::timing::loop_phase::{LoopRun, cores_of, run_loop};
use crate::verdict::Failure;

/// A quantity with its figures and histogram.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Quantity {
    /// Its key in the JSON report.
    pub key: String,
    /// As a person reads it.
    pub name: String,
    /// The figures; nothing when it never occurred.
    pub figures: Option<Figures>,
    /// The histogram.
    pub bars: Vec<Bar>,
}

impl Quantity {
    fn new(key: &str, name: &str, times_ns: impl IntoIterator<Item = u64>) -> Self {
        Self::of(key, name, &Times::of(times_ns))
    }

    /// Of times.
    pub fn of(key: &str, name: &str, times: &Times) -> Self {
        Self { key: key.to_owned(), name: name.to_owned(), figures: times.figures(), bars: times.bars() }
    }
}

/// What one thread of the floor saw.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FloorFigures {
    /// Its core.
    pub core: usize,
    /// Whether the co-load ran.
    pub loaded: bool,
    /// Usual time of its fixed work at each tick (s).
    pub work_s: f64,
    /// Time between its ticks (s).
    pub period_s: f64,
    /// Wake-up latency.
    pub wake_up: Quantity,
    /// All its times.
    #[serde(skip)]
    pub late: Times,
    /// Ticks that were late by `event_s` or more.
    pub events: u64,
    /// Deadlines it had.
    pub deadlines: u64,
    /// Deadlines it missed: ticks not done a period later, and ticks slept through.
    pub missed: u64,
    /// Whether it had a real-time priority.
    pub realtime: bool,
}

impl FloorFigures {
    /// Part of the deadlines it missed.
    pub fn missed_share(&self) -> f64 {
        self.missed as f64 / self.deadlines.max(1) as f64
    }
}

/// What the loop did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LoopFigures {
    /// Whether the co-load ran.
    pub loaded: bool,
    /// How it broke off, if it did.
    pub fault: Option<String>,
    /// Cycles.
    pub cycles: u64,
    /// Wake-up latencies of the controller.
    #[serde(skip)]
    pub late: Times,
    /// The times that `compute_spread` is of.
    #[serde(skip)]
    pub computing: Times,
    /// All times.
    pub quantities: Vec<Quantity>,
    /// Wake-up latency of the witnesses of each core, and the time of their fixed work.
    pub witnesses: Vec<Quantity>,
    /// Cycles in which the machine took the core for `event_s` or more, woke the thread up that late, or was slow, also when only the same cycle
    /// again shows it.
    pub disturbed_cycles: u64,
    /// 99.9 % over the median of the time that cycles take of themselves: of those computed again the least, otherwise of those in which the
    /// machine did not visibly interfere.
    pub compute_spread: Option<f64>,
    /// The same of the times of this run alone, in cycles in which the machine did not visibly interfere.
    pub compute_spread_seen: Option<f64>,
    /// The cycles computed again; nothing when they did not come out the same.
    pub again: Option<AgainFigures>,
    /// The longest cycles that were not disturbed.
    pub longest_undisturbed: Vec<LongCycle>,
    /// The longest a cycle itself computed (s).
    pub own_time_max_s: f64,
    /// Deadlines: cycles, and ticks that were slept through.
    pub deadlines: u64,
    /// Deadlines missed.
    pub missed: u64,
    /// Of these, in the order of [`Cause::ALL`].
    pub missed_by: [u64; 5],
    /// Every one of them, the first ones if there are many.
    pub misses: Vec<Miss>,
    /// Counts of the controller's cycles.
    pub controller_counts: Counts,
    /// Counts of the plant's steps.
    pub plant_counts: Counts,
    /// Most heap allocations of one cycle.
    pub allocations_per_cycle_max: u32,
    /// Times the plant was held up for so long that the simulated world paused.
    pub plant_pauses: u64,
    /// Worst rung of the controller's fallback ladder.
    pub fallback_level_max: u32,
    /// Worst level of the plant's watchdog.
    pub watchdog_level_max: u32,
    /// Whether the robot fell.
    pub fell: bool,
    /// What the co-load did.
    pub load: Option<LoadDone>,
}

/// The cycles of the run computed again.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AgainFigures {
    /// Times all of them were computed.
    pub passes: u32,
    /// Least time of every cycle (s).
    pub least: Quantity,
    /// Part of the jitter of the computing time that repeats: deviations of the least times from their median, over these and what the run
    /// took above them.
    pub software_share_of_jitter: f64,
}

/// Page faults and context switches.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Counts {
    /// Page faults without the disk.
    pub minor_faults: u64,
    /// Page faults with it.
    pub major_faults: u64,
    /// Switches because the thread waited in the middle of its work.
    pub voluntary_switches: u64,
    /// Switches because something else was given the core.
    pub involuntary_switches: u64,
}

/// Misses kept one by one in the report.
const MISSES_KEPT: usize = 1000;
/// Long cycles that are reported.
const LONGEST_KEPT: usize = 5;

/// What all phases work with.
#[derive(Debug)]
pub struct Phases<'a> {
    /// The scenario, its cores set, and its robot.
    pub setup: &'a Setup,
    /// Ends everything.
    pub stop: &'a StopFlag,
    /// What was refused, each once.
    pub warnings: Vec<String>,
}

impl Phases<'_> {
    fn scenario(&self) -> &Scenario {
        &self.setup.scenario
    }

    fn warn(&mut self, who: &str, warnings: &[String]) {
        for warning in warnings {
            let text = if who.is_empty() { warning.clone() } else { format!("{who}: {warning}") };
            if !self.warnings.contains(&text) {
                self.warnings.push(text);
            }
        }
    }

    /// An idle thread on each core at the period of the loop's part there.
    ///
    /// # Errors
    /// When a thread cannot be started.
    pub fn idle_floor(&mut self, duration_s: f64, loaded: bool) -> Result<Vec<FloorFigures>, Failure> {
        let scenario = self.scenario();
        let [plant, controller] = cores_of(scenario);
        let (step_s, period_s) = (scenario.plant.step_s, 1.0 / scenario.controller.mpc_rate_hz);
        let mut threads = vec![(plant, step_s, 0.0), (controller, period_s, 0.0)];
        if plant == controller {
            threads.remove(0);
        }
        self.floor(&threads, duration_s, loaded)
    }

    /// A thread on the controller's core whose fixed work takes as long as a cycle.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn occupied_floor(
        &mut self,
        duration_s: f64,
        work_s: f64,
        loaded: bool,
    ) -> Result<Vec<FloorFigures>, Failure> {
        let [_, controller] = cores_of(self.scenario());
        let period_s = 1.0 / self.scenario().controller.mpc_rate_hz;
        self.floor(&[(controller, period_s, work_s)], duration_s, loaded)
    }

    fn floor(
        &mut self,
        threads: &[(usize, f64, f64)],
        duration_s: f64,
        loaded: bool,
    ) -> Result<Vec<FloorFigures>, Failure> {
        let scenario = self.scenario().clone();
        let load = loaded.then(|| CoLoad::start(&cores_of(&scenario))).transpose()?;
        let start = |&(core, period_s, work_s): &(usize, f64, f64)| {
            let thread = FloorThread::start(FloorSettings {
                core: Some(core),
                process: scenario.process.clone(),
                period_ns: ns(period_s),
                work: if work_s > 0.0 { Work::Occupied(ns(work_s)) } else { Work::Nothing },
                duration_ns: ns(duration_s),
            })?;
            Ok((core, period_s, work_s, thread))
        };
        let started: Vec<_> = threads.iter().map(start).collect::<Result<_, Failure>>()?;
        let mut figures = Vec::new();
        for (core, period_s, work_s, thread) in started {
            let run = thread.join()?;
            self.warn("floor", &run.warnings);
            figures.push(floor_figures(&scenario, &run, core, period_s, work_s, loaded));
        }
        if let Some(load) = load {
            load.finish();
        }
        Ok(figures)
    }

    /// The real loop.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn run_loop(&mut self, folder: &Path, loaded: bool) -> Result<LoopDone, Failure> {
        let setup = self.setup;
        let load = loaded.then(|| CoLoad::start(&cores_of(&setup.scenario))).transpose()?;
        let run = run_loop(setup, folder, self.stop);
        let load = load.map(CoLoad::finish);
        let run = run?;
        self.warn("", &run.warnings);
        for (_, witness) in &run.witnesses {
            self.warn("witness", &witness.warnings);
            if !witness.realtime {
                let what = "it can be held up by the loop: what it cannot prove counts as the software's";
                self.warn("witness", &[what.to_owned()]);
            }
        }
        Ok(LoopDone { run, load })
    }

    /// The figures of a loop, for which its cycles are computed again. `None`: interrupted.
    ///
    /// # Errors
    /// When that cannot be done.
    pub fn loop_figures(&mut self, done: LoopDone) -> Result<Option<LoopFigures>, Failure> {
        let LoopDone { run, load } = done;
        let scenario = self.scenario();
        let (budget_ns, spread_most) = (budget_ns(scenario), scenario.timing.compute_spread);
        let settled = |least_ns: &[u64]| {
            let times = Times::of(least_ns.iter().copied());
            spread(&times).is_none_or(|spread| spread <= spread_most)
                && least_ns.iter().all(|time_ns| *time_ns <= budget_ns)
        };
        let again = compute_again(self.setup, &run.tape, run.cycles.len(), settled, self.stop)?;
        let Some(again) = again else { return Ok(None) };
        // A tape that ran out of room has not the last cycles; one with bad states on purpose has others than the loop received.
        let fits = run.tape.inputs.last().map(|input| input.state.header.sequence)
            == run.cycles.last().map(|cycle| cycle.state_sequence);
        let again = Some(again).filter(|again| fits && again.different == 0);
        if again.is_none() {
            let what = "no cycles that gave the same commands: what the witness cannot prove counts as the software's";
            self.warn("again", &[what.to_owned()]);
        }
        Ok(Some(loop_figures(self.scenario(), &run, load, again.as_ref())))
    }
}

/// A loop that has run.
#[derive(Debug)]
pub struct LoopDone {
    run: LoopRun,
    load: Option<LoadDone>,
}

/// Time a cycle may compute (ns).
fn budget_ns(scenario: &Scenario) -> u64 {
    ns(scenario.timing.compute_budget / scenario.controller.mpc_rate_hz)
}

/// 99.9 % over the median.
fn spread(times: &Times) -> Option<f64> {
    times.at_ns(0.999).zip(times.at_ns(0.5)).map(|(high, median)| high as f64 / median as f64)
}

/// Settings without any privilege.
pub fn without_privileges(process: &mut ProcessSettings) {
    process.priority = 0;
    process.lock_memory = false;
}

fn floor_figures(
    scenario: &Scenario,
    run: &FloorRun,
    core: usize,
    period_s: f64,
    work_s: f64,
    loaded: bool,
) -> FloorFigures {
    let event_ns = ns(scenario.timing.event_s);
    let events = run.ticks.iter().filter(|tick| tick.late_ns() >= event_ns).count() as u64;
    let late = Times::of(run.ticks.iter().map(FloorTick::late_ns));
    let what = if work_s > 0.0 { "occupied" } else { "idle" };
    let with = if loaded { ", co-load" } else { "" };
    let name = format!("{what} thread, core {core}{with}");
    FloorFigures {
        core,
        loaded,
        work_s,
        period_s,
        wake_up: Quantity::of("wake_up", &name, &late),
        late,
        events,
        deadlines: deadlines(&run.ticks),
        missed: missed_deadlines(&run.ticks, ns(period_s)),
        realtime: run.realtime,
    }
}

fn loop_figures(
    scenario: &Scenario,
    run: &LoopRun,
    load: Option<LoadDone>,
    again: Option<&Again>,
) -> LoopFigures {
    let [plant_core, controller_core] = cores_of(scenario);
    let period_ns = ns(1.0 / scenario.controller.mpc_rate_hz);
    let event_ns = ns(scenario.timing.event_s);
    let witness = run.witnesses.iter().find(|(core, witness)| *core == controller_core && witness.realtime);
    let stalled = witness.map(|(_, witness)| stalls(&witness.ticks, event_ns)).unwrap_or_default();
    let evidence = Evidence {
        steps: &run.steps,
        witness: witness.map_or_else(Witness::default, |(_, run)| Witness {
            stalls: &stalled,
            ticks: &run.ticks,
            cost_ns: run.cpu_per_tick_ns,
        }),
        one_core: plant_core == controller_core,
        period_ns,
        budget_ns: budget_ns(scenario),
        event_ns,
        again_ns: again.map(|again| &again.least_ns[..]),
    };
    let accounts = accounts(&run.cycles, &evidence);
    let mut misses = misses(&run.cycles, &accounts, &evidence);
    let missed_by = Cause::ALL.map(|cause| {
        misses.iter().filter(|miss| miss.cause == cause).map(|miss| miss.deadlines).sum::<u64>()
    });
    misses.truncate(MISSES_KEPT);
    let disturbed = |account: &&Account| account.is_disturbed(event_ns);
    let calm = accounts.iter().filter(|account| !account.is_seen_disturbed(event_ns));
    let seen = Times::of(calm.map(Account::computing_ns));
    let of_itself = Times::of(accounts.iter().map(Account::software_ns));
    let computing = if again.is_some() { of_itself.clone() } else { seen.clone() };
    let late = wake_ups(&accounts);
    let (plant, controller) = (run.summary.plant.as_ref(), run.summary.controller.as_ref());
    LoopFigures {
        loaded: load.is_some(),
        fault: (run.course != Course::Finished).then(|| run.summary.failure.clone()).flatten(),
        cycles: run.cycles.len() as u64,
        quantities: [
            controller_quantities(&run.cycles, &accounts, &late, period_ns),
            plant_quantities(&run.steps, ns(scenario.plant.step_s)),
        ]
        .concat(),
        witnesses: run
            .witnesses
            .iter()
            .flat_map(|(core, witness)| {
                let late = witness.ticks.iter().map(|tick| tick.late_ns());
                let work = witness.ticks.iter().map(|tick| tick.done_ns - tick.woke_ns);
                [
                    Quantity::new(
                        &format!("witness_{core}"),
                        &format!("witness, core {core}: latency"),
                        late,
                    ),
                    Quantity::new(
                        &format!("work_{core}"),
                        &format!("witness, core {core}: fixed work"),
                        work,
                    ),
                ]
            })
            .collect(),
        late,
        disturbed_cycles: accounts.iter().filter(disturbed).count() as u64,
        compute_spread: spread(&computing),
        computing,
        compute_spread_seen: spread(&seen),
        again: again.map(|again| AgainFigures {
            passes: again.passes,
            least: Quantity::of(
                "cycle_software",
                "controller: whole cycle, computed again, least",
                &of_itself,
            ),
            software_share_of_jitter: software_share_of_jitter(&accounts, of_itself.at_ns(0.5).unwrap_or(0)),
        }),
        longest_undisturbed: longest_undisturbed(&run.cycles, &accounts, &evidence, LONGEST_KEPT),
        own_time_max_s: accounts.iter().map(Account::own_ns).max().unwrap_or(0) as f64 * 1e-9,
        deadlines: run.cycles.iter().map(|cycle| 1 + u64::from(cycle.missed_ticks)).sum(),
        missed: missed_by.iter().sum(),
        missed_by,
        misses,
        controller_counts: run.cycles.iter().fold(Counts::default(), |sum, cycle| Counts {
            minor_faults: sum.minor_faults + u64::from(cycle.minor_faults),
            major_faults: sum.major_faults + u64::from(cycle.major_faults),
            voluntary_switches: sum.voluntary_switches + u64::from(cycle.voluntary_switches),
            involuntary_switches: sum.involuntary_switches + u64::from(cycle.involuntary_switches),
        }),
        plant_counts: run.steps.iter().fold(Counts::default(), |sum, step| Counts {
            minor_faults: sum.minor_faults + u64::from(step.minor_faults),
            major_faults: sum.major_faults + u64::from(step.major_faults),
            voluntary_switches: sum.voluntary_switches + u64::from(step.voluntary_switches),
            involuntary_switches: sum.involuntary_switches + u64::from(step.involuntary_switches),
        }),
        allocations_per_cycle_max: run.cycles.iter().map(|cycle| cycle.allocations).max().unwrap_or(0),
        plant_pauses: plant.and_then(|plant| plant.plant_pauses).unwrap_or(0),
        fallback_level_max: controller
            .map_or(FallbackLevel::ZeroTorque as u32, |part| part.fallback_level_max),
        watchdog_level_max: plant.map_or(FallbackLevel::ZeroTorque as u32, |part| part.watchdog_level_max),
        fell: plant.is_none_or(|plant| plant.robot.fell),
        load,
    }
}

fn software_share_of_jitter(accounts: &[Account], median_ns: u64) -> f64 {
    let sum = |time: &dyn Fn(&Account) -> u64| accounts.iter().map(time).sum::<u64>() as f64;
    let software = sum(&|account| account.software_ns().abs_diff(median_ns));
    let machine = sum(&|account| account.own_ns() - account.software_ns());
    if software + machine > 0.0 { software / (software + machine) } else { 0.0 }
}

fn wake_ups(accounts: &[Account]) -> Times {
    // Who was still at work at the tick was not woken up.
    let woken = accounts.iter().filter(|account| account.backlog_ns == 0);
    Times::of(woken.map(|account| account.late_ns))
}

fn controller_quantities(
    cycles: &[CycleRecord],
    accounts: &[Account],
    late: &Times,
    period_ns: u64,
) -> Vec<Quantity> {
    let mut list = vec![Quantity::of("wake_up", "controller: wake-up latency", late)];
    for stage in Stage::ALL {
        let key = format!("stage_{stage:?}").to_lowercase();
        let name = format!("controller: {}", stage.name());
        list.push(Quantity::new(&key, &name, cycles.iter().map(|cycle| stage.time_ns(cycle))));
    }
    let of_accounts = |key: &str, name: &str, time: fn(&Account) -> u64| {
        Quantity::new(key, name, accounts.iter().map(time))
    };
    list.push(of_accounts("cycle", "controller: whole cycle, by the clock", |account| account.wall_ns));
    list.push(of_accounts("cycle_own", "controller: whole cycle, its own time", Account::own_ns));
    list.push(Quantity::new(
        "response",
        "controller: tick to command sent",
        cycles.iter().map(|cycle| cycle.sent_ns - cycle.due_ns),
    ));
    list.push(Quantity::new(
        "jitter",
        "controller: period jitter",
        jitter(cycles.iter().map(|c| c.begin_ns), period_ns),
    ));
    // Each state once: a cycle without a new one answers an old one again.
    let fresh = cycles.windows(2).filter(|pair| pair[0].state_sequence != pair[1].state_sequence);
    let waited = fresh.map(|pair| pair[1].begin_ns.saturating_sub(pair[1].state_sent_ns));
    list.push(Quantity::new("state_waited", "state sent to cycle begun", waited));
    list
}

fn plant_quantities(steps: &[StepRecord], step_ns: u64) -> Vec<Quantity> {
    let of = |key: &str, name: &str, time: fn(&StepRecord) -> u64| {
        Quantity::new(key, name, steps.iter().map(time))
    };
    let woken = steps.iter().enumerate().filter(|(index, step)| {
        index.checked_sub(1).is_none_or(|before| steps[before].sent_ns <= step.due_ns)
    });
    let woken = woken.map(|(_, step)| step);
    let answered = || steps.iter().filter(|step| step.age_ns > 0);
    vec![
        Quantity::new(
            "plant_wake_up",
            "plant: wake-up latency",
            woken.map(|step| step.woke_ns - step.due_ns),
        ),
        of("plant_step", "plant: step", |step| step.end_ns - step.begin_ns),
        of("plant_publish", "plant: publish", |step| step.sent_ns - step.end_ns),
        Quantity::new(
            "plant_jitter",
            "plant: period jitter",
            jitter(steps.iter().map(|s| s.begin_ns), step_ns),
        ),
        Quantity::new(
            "command_waited",
            "command sent to step begun",
            answered().map(|step| step.begin_ns.saturating_sub(step.command_sent_ns)),
        ),
        Quantity::new("age", "state measured to its command", answered().map(|step| step.age_ns)),
    ]
}

/// How far the distances of moments are from the period.
fn jitter(moments: impl Iterator<Item = u64> + Clone, period_ns: u64) -> impl Iterator<Item = u64> {
    let next = moments.clone().skip(1);
    moments.zip(next).map(move |(now, next)| next.saturating_sub(now).abs_diff(period_ns))
}

/// s to ns.
pub fn ns(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}
