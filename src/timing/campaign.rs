//! `delmpc timing --faults`: every fault of a scenario in a run of its own, and what became of the robot.
//!
//! | faults of | run | clock |
//! |---|---|---|
//! | messages | both loops in this process, over the in-process link | lockstep: the same every time |
//! | processes | the two real processes under their supervisor | realtime |
//!
//! No fault may yield a torque that is no number, a hang, or anything left in shared memory; and the robot must stand where the scenario says so.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::Duration;

use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::{FallbackLevel, Role};
use delmpc_scenario::{Clock, FaultKind, FaultSettings, FaultTarget};
use delmpc_transport::{RunId, SplitMix64, runtime_folder};
use rustix::process::{Pid, Signal, kill_process};
use rustix::time::{ClockId, Timespec, clock_gettime, clock_settime};
use serde::Serialize;

use crate::log::Log;
use crate::one_process::{Simulated, simulate};
use crate::run_folder::RunFolder;
use crate::setup::Setup;
use crate::summary::{PlantPart, Summary};
use crate::supervisor::{Course, ProcessIds, Program, Supervision, fresh_run};
use crate::timing::loop_phase::{path_text, take_parts};
use crate::verdict::Failure;

/// How long the wall clock stays wrong.
const CLOCK_WRONG: Duration = Duration::from_millis(300);
/// A run that is killed lives at most this long (ms): somewhere between its first file and its middle.
const LONGEST_LIFE_MS: u64 = 1500;

/// A fault and its consequences.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Trial {
    /// The fault in words.
    pub fault: String,
    /// How it was run.
    pub run: &'static str,
    /// Why it was not run.
    pub skipped: Option<String>,
    /// Worst rung of the controller's ladder.
    pub fallback_level_max: Option<u32>,
    /// Worst level of the plant's watchdog.
    pub watchdog_level_max: Option<u32>,
    /// Cycles whose state was refused.
    pub states_refused: Option<u64>,
    /// Commands the plant refused.
    pub commands_refused: Option<u64>,
    /// Steps with a torque that was no number.
    pub non_finite_torques: Option<u64>,
    /// Least distance of the pressure point from the edge of the sole (m).
    pub min_cop_margin_m: Option<f64>,
    /// What became of the robot.
    pub fate: String,
    /// Files that were left in shared memory.
    pub leftovers: usize,
    /// What must not be; nothing: all is as it should be.
    pub wrong: Option<String>,
}

/// Runs every fault of the scenario.
///
/// # Errors
/// When a run cannot be made. `None`: interrupted.
pub fn campaign(
    setup: &Setup,
    folder: &Path,
    stop: &StopFlag,
    clock_may_jump: bool,
    mut tell: impl FnMut(&Trial),
) -> Result<Option<Vec<Trial>>, Failure> {
    let mut trials = Vec::new();
    for (index, fault) in setup.scenario.fault.iter().enumerate() {
        let trial = match fault.kind {
            kind if kind.is_of_messages() => message_trial(setup, fault, stop)?,
            FaultKind::ClockJump if !clock_may_jump => skipped(fault, "allow it with --clock-jump"),
            _ => process_trial(setup, fault, &folder.join(format!("fault-{index}")), stop)?,
        };
        if stop.is_set() {
            return Ok(None);
        }
        tell(&trial);
        trials.push(trial);
    }
    Ok(Some(trials))
}

/// A fault of messages, in this process and in lockstep.
///
/// # Errors
/// When the run cannot be made.
pub fn message_trial(setup: &Setup, fault: &FaultSettings, stop: &StopFlag) -> Result<Trial, Failure> {
    let mut setup = setup.clone();
    setup.scenario.clock = Clock::Lockstep;
    setup.scenario.fault = vec![fault.clone()];
    let mut trial = Trial::new(fault, "one process, lockstep");
    match simulate(&setup, Log::none(), stop)? {
        Simulated::Fault(why) => {
            trial.fate = format!("broke off: {why}");
            trial.wrong = Some("the run broke off".to_owned());
        }
        Simulated::Ended { plant, figures } => {
            trial.take(&plant);
            trial.fallback_level_max = Some(figures.fallback_level_max);
            trial.states_refused = Some(figures.states_refused);
        }
    }
    trial.judge(fault);
    Ok(trial)
}

/// A fault of processes, with the real ones.
///
/// # Errors
/// When the run cannot be made.
pub fn process_trial(
    setup: &Setup,
    fault: &FaultSettings,
    folder: &Path,
    stop: &StopFlag,
) -> Result<Trial, Failure> {
    let mut setup = setup.clone();
    setup.scenario.clock = Clock::Realtime;
    setup.scenario.fault = vec![fault.clone()];
    let folder = RunFolder::create(Some(folder), &setup.scenario.name)?;
    folder.write_inputs(&setup)?;
    if fault.kind == FaultKind::KillRun {
        return kill_runs(&setup, fault, &folder, stop);
    }
    let mut trial = Trial::new(fault, "two processes, realtime");
    let supervision = supervision(&setup, &folder, fault)?;
    let mut injector = Injector::new(fault);
    let course = supervision.supervise(stop, |ids| injector.look(ids))?;
    trial.leftovers = leftovers(supervision.run).len();
    let (plant, controller) = take_parts(&folder);
    let fault_text = match &course {
        Course::Finished => None,
        Course::Interrupted => Some("interrupted".to_owned()),
        Course::Fault(why) => Some(why.clone()),
    };
    if let Some(plant) = &plant {
        trial.take(plant);
    }
    if let Some(controller) = &controller {
        trial.fallback_level_max = Some(controller.fallback_level_max);
        trial.states_refused = Some(controller.verdicts_bad_state);
    }
    let expected_end = fault.kind == FaultKind::Kill && fault.target == FaultTarget::Plant;
    match &fault_text {
        Some(why) => trial.fate = format!("the run ended: {why}"),
        None if !injector.done => trial.wrong = Some("the fault did not happen".to_owned()),
        None => {}
    }
    if fault_text.is_some() != expected_end {
        trial.wrong = Some("the run should end by the fault, and only by a fault that ends it".to_owned());
    }
    if let Some(why) = injector.refused {
        return Ok(skipped(fault, &why));
    }
    let summary = Summary::new(&setup.scenario, plant, controller, fault_text);
    let _ = summary.write(&folder.file("summary.json"));
    trial.judge(fault);
    Ok(trial)
}

/// Kills runs at random moments, one after the other, and looks for what they leave.
fn kill_runs(
    setup: &Setup,
    fault: &FaultSettings,
    folder: &RunFolder,
    stop: &StopFlag,
) -> Result<Trial, Failure> {
    let mut trial = Trial::new(fault, "two processes, realtime");
    let mut random = SplitMix64::new(setup.scenario.seed);
    let (mut killed, mut began) = (0, 0);
    for _ in 0..fault.count {
        if stop.is_set() {
            break;
        }
        let supervision = supervision(setup, folder, fault)?;
        let life_ns = 1_000_000 * random.up_to(LONGEST_LIFE_MS);
        let victims = random.up_to(2);
        let begin_ns = monotonic_ns();
        let (mut done, mut running) = (false, false);
        let course = supervision.supervise(stop, |ids| {
            running |= ids.running;
            if !done && monotonic_ns() >= begin_ns + life_ns {
                done = true;
                // One of them, or both.
                if victims != 1 {
                    send_signal(ids.plant, Signal::KILL);
                }
                if victims != 0 {
                    send_signal(ids.controller, Signal::KILL);
                }
            }
        })?;
        killed += u32::from(matches!(&course, Course::Fault(why) if why.contains("signal 9")));
        began += u32::from(running);
        trial.leftovers += leftovers(supervision.run).len();
    }
    trial.fate = format!("{killed} of {} runs killed, {began} of them under way", fault.count);
    if killed != fault.count {
        trial.wrong = Some("a run was not killed, or ended otherwise".to_owned());
    }
    trial.judge(fault);
    Ok(trial)
}

fn supervision(setup: &Setup, folder: &RunFolder, fault: &FaultSettings) -> Result<Supervision, Failure> {
    let role = if fault.target == FaultTarget::Plant { Role::Plant } else { Role::Controller };
    Ok(Supervision {
        run: fresh_run()?,
        program: delmpc_program()?,
        plant: Program::Ours,
        controller: Program::Ours,
        arguments: vec![
            path_text(&folder.file("scenario.toml"))?,
            "--out".to_owned(),
            path_text(folder.path())?,
        ],
        messages: folder.file("messages.txt"),
        steering: None,
        show_messages: false,
        hang_s: setup.scenario.process.hang_s,
        lockstep: setup.scenario.clock == Clock::Lockstep,
        restarts: u32::from(fault.kind == FaultKind::Kill),
        late: (fault.kind == FaultKind::LateStart).then_some((role, fault.size_s)),
    })
}

/// Our program; that of a test lies one folder below it.
fn delmpc_program() -> Result<PathBuf, Failure> {
    let ours = std::env::current_exe().map_err(Failure::fault)?;
    let beside = ours.parent().and_then(Path::parent).map(|folder| folder.join("delmpc"));
    match beside {
        Some(program) if ours.file_name() != Some("delmpc".as_ref()) && program.is_file() => Ok(program),
        _ => Ok(ours),
    }
}

/// Does to the processes what the fault says, once.
struct Injector<'a> {
    fault: &'a FaultSettings,
    begin_ns: Option<u64>,
    done: bool,
    /// Why the operating system did not let us.
    refused: Option<String>,
}

impl<'a> Injector<'a> {
    fn new(fault: &'a FaultSettings) -> Self {
        // A late start is over when the run begins.
        Self { fault, begin_ns: None, done: fault.kind == FaultKind::LateStart, refused: None }
    }

    fn look(&mut self, ids: ProcessIds) {
        if self.done || !ids.running {
            return;
        }
        let begin_ns = *self.begin_ns.get_or_insert_with(monotonic_ns);
        if monotonic_ns() < begin_ns + (self.fault.start_s * 1e9) as u64 {
            return;
        }
        self.done = true;
        let victim = if self.fault.target == FaultTarget::Plant { ids.plant } else { ids.controller };
        match self.fault.kind {
            FaultKind::Stop => {
                send_signal(victim, Signal::STOP);
                sleep(Duration::from_secs_f64(self.fault.size_s));
                send_signal(victim, Signal::CONT);
            }
            FaultKind::Kill => send_signal(victim, Signal::KILL),
            FaultKind::ClockJump => self.refused = jump(self.fault.size_s).err(),
            _ => {}
        }
    }
}

/// Moves the wall clock forward for a while and back.
fn jump(size_s: f64) -> Result<(), String> {
    let refused = |error: rustix::io::Errno| format!("the wall clock cannot be set: {error}");
    shift_wall_clock(size_s).map_err(refused)?;
    sleep(CLOCK_WRONG);
    shift_wall_clock(-size_s).map_err(refused)
}

fn shift_wall_clock(by_s: f64) -> rustix::io::Result<()> {
    const SECOND_NS: i64 = 1_000_000_000;
    let now = clock_gettime(ClockId::Realtime);
    let nanoseconds = now.tv_nsec as i64 + (by_s * 1e9) as i64;
    let (seconds, rest) = (nanoseconds.div_euclid(SECOND_NS), nanoseconds.rem_euclid(SECOND_NS));
    clock_settime(ClockId::Realtime, Timespec { tv_sec: now.tv_sec + seconds, tv_nsec: rest as _ })
}

fn send_signal(pid: u32, signal: Signal) {
    if let Some(pid) = Pid::from_raw(pid as i32) {
        let _ = kill_process(pid, signal);
    }
}

/// What a run has left in shared memory and in the user's private folder.
fn leftovers(run: RunId) -> Vec<PathBuf> {
    let mut left = Vec::new();
    for folder in runtime_folder().into_iter().chain([PathBuf::from("/dev/shm")]) {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        left.extend(entries.map(|entry| entry.path()).filter(|path| {
            path.file_name().is_some_and(|name| name.to_string_lossy().contains(&run.to_string()))
        }));
    }
    left
}

fn skipped(fault: &FaultSettings, why: &str) -> Trial {
    let mut trial = Trial::new(fault, "not run");
    trial.skipped = Some(why.to_owned());
    trial.fate = format!("not run: {why}");
    trial
}

impl Trial {
    fn new(fault: &FaultSettings, run: &'static str) -> Self {
        Self {
            fault: in_words(fault),
            run,
            skipped: None,
            fallback_level_max: None,
            watchdog_level_max: None,
            states_refused: None,
            commands_refused: None,
            non_finite_torques: None,
            min_cop_margin_m: None,
            fate: String::new(),
            leftovers: 0,
            wrong: None,
        }
    }

    fn take(&mut self, plant: &PlantPart) {
        self.watchdog_level_max = Some(plant.watchdog_level_max);
        self.commands_refused = Some(plant.commands_refused);
        self.non_finite_torques = Some(plant.robot.steps_with_non_finite_torque);
        self.min_cop_margin_m = plant.robot.min_cop_margin_m;
        self.fate = match plant.robot.fall_time_s {
            Some(time_s) => format!("fell at {time_s:.2} s"),
            None => format!("stood for {:.2} s", plant.robot.duration_s),
        };
    }

    fn judge(&mut self, fault: &FaultSettings) {
        let found = if self.non_finite_torques.is_some_and(|steps| steps > 0) {
            Some("a torque was no number")
        } else if self.leftovers > 0 {
            Some("files were left in shared memory")
        } else if fault.must_stand && !self.fate.starts_with("stood") {
            Some("the robot had to stand it")
        } else {
            None
        };
        self.wrong = self.wrong.take().or(found.map(str::to_owned));
    }
}

fn in_words(fault: &FaultSettings) -> String {
    let (kind, target) = (fault.kind.word(), fault.target.word());
    let mut text = format!("{target} {kind}");
    if fault.kind.is_of_messages() {
        let _ = match fault.probability {
            0.0 => write!(text, ", {} in a row", fault.count),
            part => write!(text, ", {:.0} % of {}", 100.0 * part, fault.count),
        };
    } else if fault.kind == FaultKind::KillRun {
        let _ = write!(text, ", {} times", fault.count);
    }
    match fault.kind {
        FaultKind::Stale
        | FaultKind::Future
        | FaultKind::LateStart
        | FaultKind::ClockJump
        | FaultKind::Stop => {
            let _ = write!(text, ", {} ms", (1e3 * fault.size_s).round());
        }
        _ => {}
    }
    text
}

/// One trial as a line of the table.
pub fn line(trial: &Trial) -> String {
    let number = |value: Option<u64>| value.map_or("-".to_owned(), |value| value.to_string());
    let level = |level: Option<u32>| level.map_or("-".to_owned(), level_name);
    let margin = trial.min_cop_margin_m.map_or("-".to_owned(), |margin| format!("{:.1}", 1e3 * margin));
    format!(
        "{:<38} {:<16} {:<16} {:>7} {:>8} {:>7} {:>5}  {}{}",
        trial.fault,
        level(trial.fallback_level_max),
        level(trial.watchdog_level_max),
        number(trial.states_refused),
        number(trial.commands_refused),
        margin,
        trial.leftovers,
        trial.fate,
        trial.wrong.as_ref().map_or(String::new(), |wrong| format!("   WRONG: {wrong}"))
    )
}

/// Head of the table.
pub fn head() -> String {
    format!(
        "{:<38} {:<16} {:<16} {:>7} {:>8} {:>7} {:>5}  fate of the robot",
        "fault", "controller level", "watchdog level", "states", "commands", "margin", "left"
    ) + &format!(
        "\n{:<38} {:<16} {:<16} {:>7} {:>8} {:>7} {:>5}",
        "", "", "", "refused", "refused", "mm", "files"
    )
}

fn level_name(code: u32) -> String {
    let name = match FallbackLevel::from_code(code) {
        Some(FallbackLevel::FreshSolution) => "fresh solution",
        Some(FallbackLevel::ShiftedPlan) => "shifted plan",
        Some(FallbackLevel::StaticLqr) => "static LQR",
        Some(FallbackLevel::GravityHold) => "gravity hold",
        Some(FallbackLevel::DampingOnly) => "damping",
        Some(FallbackLevel::ZeroTorque) => "zero torque",
        None => "?",
    };
    format!("{code} {name}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_is_said_in_words() {
        let fault = FaultSettings { count: 3, ..FaultSettings::default() };
        assert_eq!(in_words(&fault), "command lost, 3 in a row");
        let stop = FaultSettings {
            kind: FaultKind::Stop,
            target: FaultTarget::Plant,
            size_s: 0.05,
            ..FaultSettings::default()
        };
        assert_eq!(in_words(&stop), "plant stop, 50 ms");
    }

    #[test]
    fn what_must_not_be_is_wrong() {
        let fault = FaultSettings { must_stand: true, ..FaultSettings::default() };
        let judged = |change: fn(&mut Trial)| {
            let mut trial = Trial::new(&fault, "");
            trial.fate = "stood for 3.00 s".to_owned();
            change(&mut trial);
            trial.judge(&fault);
            trial.wrong
        };
        assert_eq!(judged(|_| {}), None);
        assert!(judged(|trial| trial.non_finite_torques = Some(1)).is_some());
        assert!(judged(|trial| trial.leftovers = 1).is_some());
        assert!(judged(|trial| trial.fate = "fell at 1.00 s".to_owned()).is_some());
    }
}
