//! Who made a deadline be missed: the machine, or the software and which stage of it.
//!
//! Three signs say what part of a cycle the machine took: the thread's time on its core against the wall clock (a preemption, or time a
//! hypervisor gave to others), the witness thread of the same core that was due and did not run either, and the wake-up latency. What
//! remains is the time the cycle computed:
//!
//! ```text
//! due ...... woke up | receive | cycle .... | sent | the next one prepared
//!     late           |   own time + time taken                           |
//! ```
//!
//! A core can also be slow without being taken away, when strangers use the arithmetic units, caches and memory it shares. The proof is the
//! cycle itself: computed *again* on the same inputs ([`crate::timing::again`]) it takes less. Where that was not possible, two signs must
//! agree: the *slowness*, the longest the witness's fixed work took during the cycle, and the *pace*, the time of those stages of the cycle
//! whose work is the same every time (linearise, Riccati), both relative to their medians over the run.
//!
//! | cause | when |
//! |---|---|
//! | the machine, by taking the core | the own time is within the budget, and at least `event_s` was taken |
//! | the machine, by being slow | the own time exceeds the budget, and the same cycle again does not; or the slowness is at least [`SLOW`], and the own time over the pace is within the budget |
//! | as the cycle before | that one was still under way at the tick |
//! | the plant, on a shared core | the own time is within the budget, and the plant had the core for longer than the machine took it |
//! | the software | everything else, also where nothing explains it |

use delmpc_controller_process::records::{CycleRecord, StepRecord};
use serde::Serialize;

use crate::timing::figures::Times;
use crate::timing::floor::{FloorTick, overlap, ticks_in};

/// The parts of a cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// From waking up to having the state.
    Receive,
    /// Validation, coordinates, prediction.
    StateIn,
    /// The last plan in new time.
    Shift,
    /// Linearising every stage.
    Linearize,
    /// Riccati recursion.
    Riccati,
    /// Constrained QP.
    Qp,
    /// Everything of the cycle that is in no other stage.
    Rest,
    /// Sending the command.
    Publish,
}

impl Stage {
    /// All, in the order of the cycle.
    pub const ALL: [Self; 8] = [
        Self::Receive,
        Self::StateIn,
        Self::Shift,
        Self::Linearize,
        Self::Riccati,
        Self::Qp,
        Self::Rest,
        Self::Publish,
    ];

    /// As a person reads it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Receive => "receive",
            Self::StateIn => "state in, prediction",
            Self::Shift => "shift",
            Self::Linearize => "linearise",
            Self::Riccati => "Riccati",
            Self::Qp => "constrained QP",
            Self::Rest => "rest of the cycle",
            Self::Publish => "publish",
        }
    }

    /// Its time in a cycle (ns).
    pub fn time_ns(self, cycle: &CycleRecord) -> u64 {
        match self {
            Self::Receive => cycle.begin_ns.saturating_sub(cycle.woke_ns),
            Self::StateIn => cycle.state_in_ns,
            Self::Shift => cycle.shift_ns,
            Self::Linearize => cycle.linearize_ns,
            Self::Riccati => cycle.riccati_ns,
            Self::Qp => cycle.qp_ns,
            Self::Rest => {
                let stages =
                    cycle.state_in_ns + cycle.shift_ns + cycle.linearize_ns + cycle.riccati_ns + cycle.qp_ns;
                let publish = cycle.sent_ns.saturating_sub(cycle.computed_ns);
                (cycle.done_ns.saturating_sub(cycle.begin_ns)).saturating_sub(stages + publish)
            }
            Self::Publish => cycle.sent_ns.saturating_sub(cycle.computed_ns),
        }
    }
}

/// Who is to blame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// The core was taken away, or the thread was woken up late.
    Machine,
    /// The core was there, but slow: the same cycle again was faster, or the fixed work of the witness took longer too.
    SlowMachine,
    /// The plant had the core that both share.
    SharedCore,
    /// The cycle computed longer than its budget.
    Software,
    /// Nothing seen explains it. Counts as the software's.
    Unexplained,
}

impl Cause {
    /// All.
    pub const ALL: [Self; 5] =
        [Self::Machine, Self::SlowMachine, Self::SharedCore, Self::Software, Self::Unexplained];

    /// Whether the machine is to blame.
    pub fn is_the_machines(self) -> bool {
        matches!(self, Self::Machine | Self::SlowMachine)
    }

    /// As a person reads it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Machine => "core taken away",
            Self::SlowMachine => "core slow",
            Self::SharedCore => "plant on the core",
            Self::Software => "SOFTWARE",
            Self::Unexplained => "UNEXPLAINED",
        }
    }
}

/// Where the time of a cycle went (ns).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Account {
    /// From the tick to waking up; 0 when the cycle before was still under way at the tick.
    pub late_ns: u64,
    /// From the tick to the end of the cycle before, if that was still under way.
    pub backlog_ns: u64,
    /// From waking up to the command sent and the next cycle prepared.
    pub wall_ns: u64,
    /// Of that: without the core, and not because of the plant.
    pub taken_ns: u64,
    /// Of that: the plant had the core.
    pub plant_ns: u64,
    /// Longest time of the witness's fixed work meanwhile over its median; 1 where the witness did not look.
    pub slowness: f64,
    /// Time of the stages that do the same work every time over its median.
    pub pace: f64,
    /// Least time the same cycle took when it was computed again, receiving and sending as long as usual (ns); `None`: it was not.
    pub again_ns: Option<u64>,
}

/// Slowness from which on a core is said to be slow. Between calm cores the fixed work varies by less.
pub const SLOW: f64 = 1.5;
/// The same while a cycle is still behind because of a slow core.
const STILL_SLOW: f64 = 1.2;
/// A cycle that took this many times as long as the same one again was disturbed.
const DISTURBED: f64 = 1.25;

impl Account {
    /// Time the cycle itself computed.
    pub fn own_ns(&self) -> u64 {
        self.wall_ns.saturating_sub(self.taken_ns + self.plant_ns)
    }

    /// Time without what the plant had of the core: that is no disturbance, but not the cycle's either.
    pub fn computing_ns(&self) -> u64 {
        self.wall_ns.saturating_sub(self.plant_ns)
    }

    /// The least this cycle is known to take (ns): of its own time, and that of the same cycle again.
    pub fn software_ns(&self) -> u64 {
        self.again_ns.map_or(self.own_ns(), |again_ns| again_ns.min(self.own_ns()))
    }

    /// Whether the machine visibly interfered: took the core for `event_ns`, woke the thread up that late, or was slow to the witness.
    pub fn is_seen_disturbed(&self, event_ns: u64) -> bool {
        self.taken_ns >= event_ns || self.late_ns >= event_ns || self.slowness >= SLOW
    }

    /// Whether the machine interfered, visibly or not: the same cycle again took less.
    pub fn is_disturbed(&self, event_ns: u64) -> bool {
        self.is_seen_disturbed(event_ns) || self.own_ns() as f64 > DISTURBED * self.software_ns() as f64
    }
}

/// A missed deadline.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Miss {
    /// When the tick was due, from the first cycle on.
    pub time_s: f64,
    /// Deadlines missed in a row, those that were slept through included.
    pub deadlines: u64,
    /// How long after its deadline the command was sent.
    pub overrun_s: f64,
    /// Who is to blame.
    pub cause: Cause,
    /// The stage that took most above its median, with what the machine took.
    pub stage: Stage,
    /// Where the time went.
    pub account: Account,
    /// Involuntary context switches in the cycle.
    pub involuntary_switches: u32,
    /// Page faults in the cycle.
    pub page_faults: u32,
    /// What the robot did about it.
    pub robot: Option<RobotThen>,
}

/// The robot from a missed deadline to a tenth of a second later.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RobotThen {
    /// Worst level of the plant's watchdog.
    pub watchdog_level: u32,
    /// Pressure point to the edge of the sole before.
    pub cop_margin_before_m: f64,
    /// The least after.
    pub cop_margin_least_m: f64,
}

/// A cycle that took long though nothing of the machine's interfered.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LongCycle {
    /// When its tick was due, from the first cycle on.
    pub time_s: f64,
    /// The stage that took most above its median.
    pub stage: Stage,
    /// By how much.
    pub excess_s: f64,
    /// Solves of the constrained QP.
    pub qp_solves: u32,
    /// Where the time went.
    pub account: Account,
}

/// What a judge needs besides the cycles.
#[derive(Debug, Clone, Copy)]
pub struct Evidence<'a> {
    /// Steps of the plant.
    pub steps: &'a [StepRecord],
    /// The witness of the controller's core.
    pub witness: Witness<'a>,
    /// Whether the plant works on the same core.
    pub one_core: bool,
    /// The controller's period (ns).
    pub period_ns: u64,
    /// Time a cycle may compute (ns).
    pub budget_ns: u64,
    /// Loss of the core from which on the machine interfered (ns).
    pub event_ns: u64,
    /// Least time of each cycle computed again (ns).
    pub again_ns: Option<&'a [u64]>,
}

/// What the witness of a core says.
#[derive(Debug, Clone, Copy, Default)]
pub struct Witness<'a> {
    /// Intervals in which it was due and did not run, in the order of time; none when it could be held up by the loop itself.
    pub stalls: &'a [[u64; 2]],
    /// Its ticks.
    pub ticks: &'a [FloorTick],
    /// What each of these takes from the loop (ns).
    pub cost_ns: u64,
}

/// How long after a missed deadline the robot is looked at (ns).
const AFTER_NS: u64 = 100_000_000;

/// The account of every cycle.
pub fn accounts(cycles: &[CycleRecord], evidence: &Evidence<'_>) -> Vec<Account> {
    let busy: Vec<[u64; 2]> = match evidence.one_core {
        true => evidence.steps.iter().map(|step| [step.woke_ns, step.sent_ns]).collect(),
        false => Vec::new(),
    };
    let work_ns = evidence.witness.ticks.iter().map(|tick| tick.done_ns - tick.woke_ns);
    let usual_ns = Times::of(work_ns).at_ns(0.5).unwrap_or(0).max(1) as f64;
    let fixed_ns = |cycle: &CycleRecord| cycle.linearize_ns + cycle.riccati_ns;
    let usual_fixed_ns = Times::of(cycles.iter().map(fixed_ns)).at_ns(0.5).unwrap_or(0).max(1) as f64;
    let usual_ns_of =
        |stage: Stage| Times::of(cycles.iter().map(|cycle| stage.time_ns(cycle))).at_ns(0.5).unwrap_or(0);
    let links_ns = usual_ns_of(Stage::Receive) + usual_ns_of(Stage::Publish);
    let mut last_done_ns = 0;
    let account = |(index, cycle): (usize, &CycleRecord)| {
        let in_cycle = [cycle.begin_ns, cycle.done_ns];
        let plant_ns = overlap(&busy, in_cycle);
        let witness = &evidence.witness;
        let looks = ticks_in(witness.ticks, in_cycle);
        let ours_ns = plant_ns + witness.cost_ns * looks.len() as u64;
        let slowest_ns = looks.iter().map(|tick| tick.done_ns - tick.woke_ns).max();
        let off_core_ns = (cycle.done_ns - cycle.begin_ns).saturating_sub(cycle.cpu_ns + ours_ns);
        let stalled_ns = overlap(witness.stalls, [cycle.woke_ns, cycle.done_ns]);
        let (late_ns, backlog_ns) = match last_done_ns > cycle.due_ns {
            true => (0, last_done_ns - cycle.due_ns),
            false => (cycle.woke_ns - cycle.due_ns, 0),
        };
        last_done_ns = cycle.done_ns;
        let taken_ns = off_core_ns.max(stalled_ns);
        Account {
            late_ns,
            backlog_ns,
            wall_ns: cycle.done_ns - cycle.woke_ns,
            taken_ns,
            plant_ns,
            slowness: slowest_ns.map_or(1.0, |slowest_ns| slowest_ns as f64 / usual_ns),
            // As if all that was taken had been taken from them.
            pace: fixed_ns(cycle).saturating_sub(taken_ns + plant_ns) as f64 / usual_fixed_ns,
            again_ns: evidence
                .again_ns
                .and_then(|again| again.get(index))
                .map(|again_ns| again_ns + links_ns),
        }
    };
    cycles.iter().enumerate().map(account).collect()
}

/// Every missed deadline with its cause.
pub fn misses(cycles: &[CycleRecord], accounts: &[Account], evidence: &Evidence<'_>) -> Vec<Miss> {
    let medians = stage_medians(cycles);
    let origin_ns = cycles.first().map_or(0, |cycle| cycle.due_ns);
    let mut list: Vec<Miss> = Vec::new();
    // Cause of the last cycle, if it was still under way at the end of its period.
    let mut before: Option<Cause> = None;
    for (cycle, account) in cycles.iter().zip(accounts) {
        let deadline_ns = cycle.due_ns + evidence.period_ns;
        let overran = cycle.sent_ns > deadline_ns;
        // Ticks are slept through when the cycle before ends late.
        if let (true, Some(last)) = (cycle.missed_ticks > 0, list.last_mut()) {
            last.deadlines += u64::from(cycle.missed_ticks);
        }
        let inherited = before.filter(|_| account.backlog_ns > 0);
        let cause = cause_of(account, inherited, evidence);
        // A command in time does not mean that the cycle was over in time.
        before = (cycle.done_ns > deadline_ns).then_some(cause);
        if !overran {
            continue;
        }
        list.push(Miss {
            time_s: (cycle.due_ns - origin_ns) as f64 * 1e-9,
            deadlines: 1,
            overrun_s: (cycle.sent_ns - deadline_ns) as f64 * 1e-9,
            cause,
            stage: most_above(&medians, cycle).0,
            account: *account,
            involuntary_switches: cycle.involuntary_switches,
            page_faults: cycle.minor_faults + cycle.major_faults,
            robot: robot_then(evidence.steps, cycle.due_ns),
        });
    }
    list
}

/// The longest cycles in which the machine did not interfere, at most `count`, the longest first.
pub fn longest_undisturbed(
    cycles: &[CycleRecord],
    accounts: &[Account],
    evidence: &Evidence<'_>,
    count: usize,
) -> Vec<LongCycle> {
    let medians = stage_medians(cycles);
    let origin_ns = cycles.first().map_or(0, |cycle| cycle.due_ns);
    let undisturbed = cycles.iter().zip(accounts);
    let mut found: Vec<_> =
        undisturbed.filter(|(_, account)| !account.is_disturbed(evidence.event_ns)).collect();
    found.sort_by_key(|(_, account)| core::cmp::Reverse(account.computing_ns()));
    let long = |(cycle, account): (&CycleRecord, &Account)| {
        let (stage, excess_ns) = most_above(&medians, cycle);
        LongCycle {
            time_s: (cycle.due_ns - origin_ns) as f64 * 1e-9,
            stage,
            excess_s: excess_ns as f64 * 1e-9,
            qp_solves: cycle.qp_solves,
            account: *account,
        }
    };
    found.into_iter().take(count).map(long).collect()
}

fn stage_medians(cycles: &[CycleRecord]) -> [u64; 8] {
    Stage::ALL.map(|stage| Times::of(cycles.iter().map(|cycle| stage.time_ns(cycle))).at_ns(0.5).unwrap_or(0))
}

/// The stage of a cycle that took most above its median, and by how much (ns).
fn most_above(medians: &[u64; 8], cycle: &CycleRecord) -> (Stage, u64) {
    let excess = |(stage, median): (Stage, &u64)| (stage, stage.time_ns(cycle).saturating_sub(*median));
    let worst = Stage::ALL.into_iter().zip(medians).map(excess).max_by_key(|(_, excess)| *excess);
    worst.unwrap_or((Stage::Rest, 0))
}

fn cause_of(account: &Account, inherited: Option<Cause>, evidence: &Evidence<'_>) -> Cause {
    let taken_ns = account.taken_ns + account.late_ns;
    // A slow stretch ends gradually.
    let slow = if inherited == Some(Cause::SlowMachine) { STILL_SLOW } else { SLOW };
    if account.own_ns() > evidence.budget_ns {
        let at_usual_speed_ns = account.own_ns() as f64 / account.pace.max(1.0);
        let slow = match account.again_ns {
            Some(again_ns) => again_ns <= evidence.budget_ns,
            None => account.slowness >= slow && at_usual_speed_ns <= evidence.budget_ns as f64,
        };
        if slow { Cause::SlowMachine } else { Cause::Software }
    } else if let Some(cause) = inherited {
        cause
    } else if taken_ns >= evidence.event_ns && taken_ns >= account.plant_ns {
        Cause::Machine
    } else if account.plant_ns >= evidence.event_ns {
        Cause::SharedCore
    } else {
        Cause::Unexplained
    }
}

fn robot_then(steps: &[StepRecord], due_ns: u64) -> Option<RobotThen> {
    let first = steps.partition_point(|step| step.sent_ns < due_ns);
    let then = steps.get(first..)?.iter().take_while(|step| step.sent_ns <= due_ns + AFTER_NS);
    let level = then.clone().map(|step| step.watchdog_level).max()?;
    let least = then.map(|step| step.cop_margin_m).fold(f64::INFINITY, f64::min);
    let before = first.checked_sub(1).map_or(f64::NAN, |index| steps[index].cop_margin_m);
    Some(RobotThen { watchdog_level: level, cop_margin_before_m: before, cop_margin_least_m: least })
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Due at a multiple of 5 ms; woken up, begun and sent that much later, with time on the core in between (ms).
    fn cycle(index: u64, woke: u64, sent: u64, cpu: u64) -> CycleRecord {
        let due_ns = 5 * index * MS;
        CycleRecord {
            due_ns,
            woke_ns: due_ns + woke * MS,
            begin_ns: due_ns + woke * MS,
            computed_ns: due_ns + sent * MS,
            sent_ns: due_ns + sent * MS,
            done_ns: due_ns + sent * MS,
            cpu_ns: cpu * MS,
            ..CycleRecord::default()
        }
    }

    fn judge(cycles: &[CycleRecord], stalls: &[[u64; 2]], steps: &[StepRecord]) -> Vec<(Cause, u64)> {
        let one_core = !steps.is_empty();
        let evidence = Evidence {
            steps,
            witness: Witness { stalls, ..Witness::default() },
            one_core,
            period_ns: 5 * MS,
            budget_ns: 4 * MS,
            event_ns: MS / 10,
            again_ns: None,
        };
        let found = misses(cycles, &accounts(cycles, &evidence), &evidence);
        found.into_iter().map(|miss| (miss.cause, miss.deadlines)).collect()
    }

    #[test]
    fn what_takes_the_core_is_the_machine() {
        assert_eq!(judge(&[cycle(0, 0, 3, 3)], &[], &[]), []);
        assert_eq!(judge(&[cycle(0, 0, 6, 3)], &[], &[]), [(Cause::Machine, 1)], "off the core");
        let stall = [[MS, 4 * MS]];
        assert_eq!(
            judge(&[cycle(0, 0, 6, 6)], &stall, &[]),
            [(Cause::Machine, 1)],
            "the witness stalled too"
        );
        assert_eq!(judge(&[cycle(0, 4, 7, 3)], &[], &[]), [(Cause::Machine, 1)], "woken up late");
    }

    #[test]
    fn what_computes_too_long_is_the_software_even_if_the_machine_interfered() {
        assert_eq!(judge(&[cycle(0, 0, 6, 6)], &[], &[]), [(Cause::Software, 1)]);
        assert_eq!(judge(&[cycle(0, 1, 8, 5)], &[], &[]), [(Cause::Software, 1)]);
    }

    #[test]
    fn a_slow_core_is_told_from_slow_software_by_the_work_of_the_witness_and_its_own() {
        let usual = || (0..9).map(|k| CycleRecord { riccati_ns: 2 * MS, ..cycle(k, 0, 3, 3) });
        // The tenth cycle computes for 8 ms; the witness's work takes `work` then, and 10 otherwise.
        let cause = |work: u64, riccati_ns: u64| {
            let tick = |k: u64| FloorTick { woke_ns: k * MS, done_ns: k * MS + 10, ..FloorTick::default() };
            let mut ticks: Vec<FloorTick> = (0..60).map(tick).collect();
            ticks[48].done_ns = 48 * MS + work;
            let evidence = Evidence {
                steps: &[],
                witness: Witness { ticks: &ticks, ..Witness::default() },
                one_core: false,
                period_ns: 5 * MS,
                budget_ns: 4 * MS,
                event_ns: MS / 10,
                again_ns: None,
            };
            let cycles: Vec<_> = usual().chain([CycleRecord { riccati_ns, ..cycle(9, 0, 8, 8) }]).collect();
            misses(&cycles, &accounts(&cycles, &evidence), &evidence)[0].cause
        };
        assert_eq!(cause(20, 5 * MS), Cause::SlowMachine);
        assert_eq!(cause(10, 5 * MS), Cause::Software, "the witness was not slow");
        assert_eq!(cause(20, 2 * MS), Cause::Software, "the same work was not slow");
        assert_eq!(cause(20, 3 * MS), Cause::Software, "too little to explain it");
    }

    #[test]
    fn a_slow_core_is_told_from_slow_software_by_the_same_cycle_again() {
        let cycles: Vec<_> = (0..9).map(|k| cycle(k, 0, 3, 3)).chain([cycle(9, 0, 8, 8)]).collect();
        let judged = |again_ns: u64| {
            let mut again = vec![2 * MS; 9];
            again.push(again_ns);
            let evidence = Evidence {
                steps: &[],
                witness: Witness::default(),
                one_core: false,
                period_ns: 5 * MS,
                budget_ns: 4 * MS,
                event_ns: MS / 10,
                again_ns: Some(&again),
            };
            let accounts = accounts(&cycles, &evidence);
            let last = accounts[9];
            let cause = misses(&cycles, &accounts, &evidence)[0].cause;
            (cause, last.software_ns() / MS, last.is_disturbed(MS / 10), last.is_seen_disturbed(MS / 10))
        };
        assert_eq!(judged(2 * MS), (Cause::SlowMachine, 2, true, false));
        assert_eq!(judged(5 * MS), (Cause::Software, 5, true, false), "again over budget");
        assert_eq!(judged(7 * MS), (Cause::Software, 7, false, false), "again as long");
        assert_eq!(judged(9 * MS), (Cause::Software, 8, false, false), "again longer");
    }

    #[test]
    fn a_stage_is_to_blame() {
        let mut cycles: Vec<CycleRecord> =
            (0..9).map(|k| CycleRecord { riccati_ns: 2 * MS, ..cycle(k, 0, 3, 3) }).collect();
        cycles.push(CycleRecord { riccati_ns: 2 * MS, qp_ns: 4 * MS, ..cycle(9, 0, 6, 6) });
        let evidence = Evidence {
            steps: &[],
            witness: Witness::default(),
            one_core: false,
            period_ns: 5 * MS,
            budget_ns: 5 * MS,
            event_ns: MS / 10,
            again_ns: None,
        };
        let found = misses(&cycles, &accounts(&cycles, &evidence), &evidence);
        assert_eq!((found.len(), found[0].stage, found[0].cause), (1, Stage::Qp, Cause::Software));
        assert!((found[0].time_s - 0.045).abs() < 1e-12 && (found[0].overrun_s - 0.001).abs() < 1e-12);
    }

    #[test]
    fn the_cycle_after_a_stall_inherits_its_cause_and_ticks_slept_through_count() {
        // 9 ms away, so that the next cycle begins 6 ms late and the one after it 4 ms, with ticks left out.
        let mut cycles = [cycle(0, 0, 12, 3), cycle(2, 2, 6, 4), cycle(3, 1, 4, 3)];
        cycles[1].missed_ticks = 1;
        assert_eq!(judge(&cycles, &[], &[]), [(Cause::Machine, 2), (Cause::Machine, 1)]);
        cycles[0].cpu_ns = 12 * MS;
        assert_eq!(judge(&cycles, &[], &[]), [(Cause::Software, 2), (Cause::Software, 1)]);
        // Its command in time, and what it prepared for the next one held up.
        cycles[0].sent_ns = MS;
        assert_eq!(judge(&cycles, &[], &[]), [(Cause::Software, 1)]);
        cycles[0].cpu_ns = 3 * MS;
        assert_eq!(judge(&cycles, &[], &[]), [(Cause::Machine, 1)]);
    }

    #[test]
    fn on_one_core_the_plant_is_told_from_the_machine() {
        let step = |begin: u64, end: u64| StepRecord {
            woke_ns: begin * MS,
            sent_ns: end * MS,
            ..StepRecord::default()
        };
        assert_eq!(judge(&[cycle(0, 0, 6, 3)], &[], &[step(1, 4)]), [(Cause::SharedCore, 1)]);
        assert_eq!(judge(&[cycle(0, 0, 6, 3)], &[], &[step(1, 2)]), [(Cause::Machine, 1)]);
    }

    #[test]
    fn the_robot_is_looked_at_after_the_deadline() {
        let step = |ms: u64, margin: f64, level: u32| StepRecord {
            sent_ns: ms * MS,
            cop_margin_m: margin,
            watchdog_level: level,
            ..StepRecord::default()
        };
        let steps = [step(1, 0.04, 0), step(20, 0.03, 1), step(50, 0.01, 0), step(200, 0.0, 5)];
        let robot = robot_then(&steps, 10 * MS).unwrap();
        assert_eq!(
            (robot.watchdog_level, robot.cop_margin_before_m, robot.cop_margin_least_m),
            (1, 0.04, 0.01)
        );
        assert_eq!(robot_then(&steps, 300 * MS), None);
    }
}
