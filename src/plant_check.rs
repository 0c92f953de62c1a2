//! `delmpc plant-check`: does a plant of somebody else's do its duties? Start, answers, bounds, commands that must be refused, silence, the
//! watchdog, another version, the end. The duties are those of `shared/messages/WIRE.md`.

mod bench;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use delmpc_messages::{Command, MAX_JOINTS, PlantState, ProcessState, status};
use delmpc_scenario::Clock;
use rustix::process::Signal;
use serde::Serialize;

use crate::colour::Colour;
use crate::output::{line, print, printable};
use crate::run_folder::RunFolder;
use crate::setup::{Setup, scenario_file};
use crate::verdict::{Ended, Failure};
use bench::{Bench, Obstacle};

/// Arguments of `delmpc plant-check`.
#[derive(Debug, clap::Args)]
pub struct PlantCheckArguments {
    /// The plant, run by /bin/sh as `delmpc run --plant` does
    pub plant: String,
    /// Scenario file [default: configs/scenarios/atlas_one_foot.toml]
    pub scenario: Option<PathBuf>,
    /// Override a key of the scenario
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print the duties as one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
}

/// A duty, and whether it is met.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Duty {
    /// What a plant has to do.
    pub duty: &'static str,
    /// Whether it does; nothing: it need not.
    pub met: Option<bool>,
    /// What was seen.
    pub seen: String,
}

/// A plant may take so long to load.
const START: Duration = Duration::from_secs(60);
/// An answer to a message may take so long.
const ANSWER: Duration = Duration::from_secs(10);
/// Who does not go on within this does not go on.
const STILL: Duration = Duration::from_millis(400);
/// A process has so long to end.
const END: Duration = Duration::from_secs(5);
/// Simulated time in which the watchdog is watched, s.
const WATCHDOG_S: f64 = 3.0;

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a scenario that cannot be run, [`Failure::Fault`] when the plant cannot be started.
pub fn plant_check(arguments: &PlantCheckArguments) -> Result<Ended, Failure> {
    let file = scenario_file(arguments.scenario.as_deref())?;
    let mut setup = Setup::read(&file, &arguments.set)?;
    // Nothing here depends on how fast a machine is.
    setup.scenario.clock = Clock::Lockstep;
    setup.scenario.fault.clear();
    let path = std::env::temp_dir().join(format!("delmpc-plant-check-{}", std::process::id()));
    let folder = RunFolder::create(Some(&path), &setup.scenario.name)?;
    let checked = check(&setup, &folder, &arguments.plant);
    drop(folder);
    // What cannot be removed is in a folder for temporary files.
    let _ = std::fs::remove_dir_all(&path);
    let duties = checked?;
    let met = duties.iter().all(|duty| duty.met != Some(false));
    if arguments.json {
        line(serde_json::to_string(&duties).map_err(Failure::fault)?)?;
    } else {
        print(&table(&duties, Colour::of(&std::io::stdout())))?;
    }
    Ok(if met { Ended::Well } else { Ended::CriterionMissed })
}

/// All duties of a plant.
///
/// # Errors
/// As [`plant_check`].
pub fn check(setup: &Setup, folder: &RunFolder, plant: &str) -> Result<Vec<Duty>, Failure> {
    let mut duties = Vec::new();
    let long = with_duration(setup, 10.0);
    folder.write_inputs(&long)?;
    session(Bench::start(&long, folder, plant, Obstacle::None)?, &mut duties)?;
    let short = with_duration(setup, 4.0 / setup.scenario.controller.mpc_rate_hz);
    folder.write_inputs(&short)?;
    to_the_end(Bench::start(&short, folder, plant, Obstacle::None)?, &mut duties)?;
    folder.write_inputs(&long)?;
    let mut bench = Bench::start(&long, folder, plant, Obstacle::None)?;
    let stopped = bench.state(START)?.is_some() && bench.order(ProcessState::Stopping).is_ok();
    let ended = bench.ended(END)?;
    duties.push(duty("ends when the supervisor says so", stopped && ended.is_some(), how(ended, &bench)));
    for (obstacle, name) in [
        (Obstacle::Version, "refuses a controller of another version, in words"),
        (Obstacle::Joints, "refuses a controller with other joints, in words"),
    ] {
        let mut bench = Bench::start(&long, folder, plant, obstacle)?;
        let ended = bench.ended(START)?;
        let refused = ended.is_some_and(|status| status != 0) && !bench.said().is_empty();
        duties.push(duty(name, refused, how(ended, &bench)));
    }
    Ok(duties)
}

fn with_duration(setup: &Setup, duration_s: f64) -> Setup {
    let mut setup = setup.clone();
    setup.scenario.duration_s = duration_s;
    setup
}

fn duty(duty: &'static str, met: bool, seen: impl Into<String>) -> Duty {
    Duty { duty, met: Some(met), seen: seen.into() }
}

/// How a process ended, and what it said last.
fn how(ended: Option<i32>, bench: &Bench) -> String {
    let said = bench.said();
    match ended {
        None => "it did not end".to_owned(),
        Some(-1) if said.is_empty() => "ended by a signal, no words".to_owned(),
        Some(-1) => format!("ended by a signal: {said}"),
        Some(status) if said.is_empty() => format!("exit status {status}, no words"),
        Some(status) => format!("exit status {status}: {said}"),
    }
}

/// Start, run, bad commands, silence, watchdog, SIGTERM: one process.
fn session(mut bench: Bench, duties: &mut Vec<Duty>) -> Result<(), Failure> {
    let Some(first) = bench.state(START)? else {
        let seen = format!("no state within {} s; it said: {}", START.as_secs(), bench.said());
        duties.push(duty("sends an initial state", false, seen));
        return Ok(());
    };
    let valid = bench.validate(&first);
    let initial = first.header.sequence == 1 && first.time_ns == 0 && valid.is_ok();
    let seen = match valid {
        Err(error) => error.to_string(),
        Ok(()) => format!("sequence {}, time {} ns", first.header.sequence, first.time_ns),
    };
    duties.push(duty("sends an initial state: sequence 1, time 0, valid", initial, seen));
    let beats = bench.peer_state();
    duties.push(duty(
        "gives signs of life from its start on",
        beats == Some(ProcessState::Starting),
        format!("{beats:?}"),
    ));
    let early = bench.state(STILL)?;
    duties.push(duty("waits for the answer to it", early.is_none(), still(early.as_ref())));
    let answer = bench.holding(&first);
    bench.send(&answer)?;
    let ready = bench.peer_becomes(ProcessState::Ready, ANSWER)?;
    let early = bench.state(STILL)?;
    let seen = format!("{:?}; {}", bench.peer_state(), still(early.as_ref()));
    duties.push(duty(
        "is Ready then, and waits for the supervisor's Running",
        ready && early.is_none(),
        seen,
    ));
    bench.order(ProcessState::Running)?;
    let Some(state) = bench.state(ANSWER)? else {
        duties.push(duty("runs", false, format!("no second state; it said: {}", bench.said())));
        return Ok(());
    };
    let cycle_ns = bench.cycle_ns();
    let goes = state.header.sequence == 2 && state.time_ns == cycle_ns && bench.validate(&state).is_ok();
    let seen = format!("sequence {}, time {} ns", state.header.sequence, state.time_ns);
    duties.push(duty("sends a state every cycle", goes, seen));
    let applied = state.applied_command_sequence == answer.header.sequence;
    let seen = format!("applied_command_sequence {}", state.applied_command_sequence);
    duties.push(duty("applies the command and says which", applied, seen));
    let truths = bench.truths()?;
    let seen = if truths == 0 {
        "no: it is judged by its states".to_owned()
    } else {
        format!("{truths} truths so far")
    };
    duties.push(Duty { duty: "tells the truth of every step (need not)", met: None, seen });

    let Some(state) = torque_duties(&mut bench, state, duties)? else { return broke_off(&bench, duties) };
    let Some(state) = refusals(&mut bench, state, duties)? else { return broke_off(&bench, duties) };
    let Some(state) = silence(&mut bench, state, duties)? else { return broke_off(&bench, duties) };
    watchdog(&mut bench, state, duties)?;
    bench.signal(Signal::TERM);
    let ended = bench.ended(END)?;
    duties.push(duty("ends on SIGTERM", ended.is_some(), how(ended, &bench)));
    Ok(())
}

fn broke_off(bench: &Bench, duties: &mut Vec<Duty>) -> Result<(), Failure> {
    duties.push(duty("goes on", false, format!("no further state; it said: {}", bench.said())));
    Ok(())
}

fn still(state: Option<&PlantState>) -> String {
    state.map_or("it waits".to_owned(), |state| format!("it sent state {} unasked", state.header.sequence))
}

/// Feed-forward as it is, and bounds.
fn torque_duties(
    bench: &mut Bench,
    state: PlantState,
    duties: &mut Vec<Duty>,
) -> Result<Option<PlantState>, Failure> {
    let joints = bench.joints();
    let mut plain = bench.holding(&state);
    plain.gain = [[0.0; 2 * MAX_JOINTS]; MAX_JOINTS];
    let Some(after) = bench.exchange(&plain, ANSWER)? else { return Ok(None) };
    let wanted = &plain.segments[0].torque;
    let off = (0..joints).map(|joint| (after.applied_torque[joint] - wanted[joint]).abs());
    let off = off.fold(0.0, f64::max);
    duties.push(duty(
        "gives the feed-forward torque as it is",
        off < 1e-6,
        format!("off by {off:.1e} N m at most"),
    ));

    let mut bounded = bench.holding(&after);
    let bound = bench.small_torque();
    bounded.segments[0].torque[0] = 1e3 * bound;
    (bounded.segments[0].torque_lower[0], bounded.segments[0].torque_upper[0]) = (-bound, bound);
    let Some(after) = bench.exchange(&bounded, ANSWER)? else { return Ok(None) };
    let found = after.applied_torque[0];
    let seen = format!("{found:.3} N m within ±{bound:.3}");
    duties.push(duty("keeps to the command's torque bounds", (found - bound).abs() < 1e-6 * bound, seen));
    Ok(Some(after))
}

type Damage = fn(&mut Command, u64);

/// Commands that must not act.
fn refusals(
    bench: &mut Bench,
    mut state: PlantState,
    duties: &mut Vec<Duty>,
) -> Result<Option<PlantState>, Failure> {
    const BAD: [(&str, Damage); 7] = [
        ("refuses a command that was overtaken", |c, _| c.header.sequence -= 2),
        ("refuses a torque that is no number", |c, _| c.segments[0].torque[0] = f64::NAN),
        ("refuses a command of another version", |c, _| c.header.version += 1),
        ("refuses a command for other joints", |c, _| c.header.joint_set_hash ^= 1),
        ("refuses a command of another run", |c, _| c.header.run_id ^= 1),
        ("refuses a command that ran out before it came", |c, now| c.valid_until_ns = now.saturating_sub(1)),
        ("refuses bounds with nothing between them", |c, _| {
            (c.segments[0].torque_lower[0], c.segments[0].torque_upper[0]) = (1.0, -1.0);
        }),
    ];
    for (name, damage) in BAD {
        // A good one first, so that one is in force.
        let good = bench.holding(&state);
        let Some(before) = bench.exchange(&good, ANSWER)? else { return Ok(None) };
        let mut bad = bench.holding(&before);
        bad.gain = [[0.0; 2 * MAX_JOINTS]; MAX_JOINTS];
        bad.valid_from_ns = bad.valid_from_ns.min(before.time_ns.saturating_sub(2));
        damage(&mut bad, before.time_ns);
        bench.send(&bad)?;
        let after = match bench.state(STILL)? {
            Some(after) => after,
            // A plant may wait for one that it can use.
            None => {
                let good = bench.holding(&before);
                let Some(after) = bench.exchange(&good, ANSWER)? else { return Ok(None) };
                after
            }
        };
        let in_force = after.applied_command_sequence;
        let refused = in_force >= good.header.sequence && in_force != bad.header.sequence;
        let torques_are_numbers =
            after.applied_torque[..bench.joints()].iter().all(|torque| torque.is_finite());
        let seen = format!("command {in_force} is in force, sent was {}", bad.header.sequence);
        duties.push(duty(name, refused && torques_are_numbers, seen));
        state = after;
    }
    Ok(Some(state))
}

/// Nobody answers for a while; somebody stops the process.
fn silence(
    bench: &mut Bench,
    state: PlantState,
    duties: &mut Vec<Duty>,
) -> Result<Option<PlantState>, Failure> {
    let before = bench.beats();
    let early = bench.state(Duration::from_secs(1))?;
    let beats = bench.beats() - before;
    let seen = format!("{} signs of life in 1 s; {}", beats, still(early.as_ref()));
    duties.push(duty("waits for an answer, and gives signs of life", early.is_none() && beats >= 10, seen));
    bench.stop_plant(true);
    bench.wait(Duration::from_secs(1))?;
    bench.stop_plant(false);
    let good = bench.holding(&state);
    let after = bench.exchange(&good, ANSWER)?;
    duties.push(duty(
        "goes on after a pause of 1 s (SIGSTOP)",
        after.is_some(),
        if after.is_some() { "it did" } else { "no state" },
    ));
    Ok(after)
}

/// Commands cease to come: answers that are all the same command.
fn watchdog(bench: &mut Bench, state: PlantState, duties: &mut Vec<Duty>) -> Result<(), Failure> {
    let mut last = bench.holding(&state);
    last.valid_until_ns = last.valid_from_ns + bench.cycle_ns();
    let Some(mut state) = bench.exchange(&last, ANSWER)? else { return broke_off(bench, duties) };
    let until_ns = state.time_ns + (WATCHDOG_S * 1e9) as u64;
    let (mut levels, mut flagged) = (Vec::new(), true);
    while state.time_ns < until_ns && !state.has_status(status::FINISHED) {
        if state.time_ns > last.valid_until_ns {
            let level = state.watchdog_level;
            if levels.last() != Some(&level) {
                levels.push(level);
            }
            flagged &= state.has_status(status::WATCHDOG);
        }
        last.state_sequence = state.header.sequence;
        bench.send(&last)?;
        match bench.state(ANSWER)? {
            Some(next) => state = next,
            None => break,
        }
    }
    let down = levels.len() > 1 && levels.is_sorted() && levels.last().is_some_and(|level| *level >= 3);
    let fell = if state.has_status(status::FELL) { ", then it fell" } else { "" };
    let seen = format!("levels {levels:?}{fell}");
    duties.push(duty("goes down the watchdog's levels when commands cease", down, seen));
    duties.push(duty(
        "sets WATCHDOG in its status meanwhile",
        flagged && !levels.is_empty(),
        format!("{flagged}"),
    ));
    Ok(())
}

/// A run of four cycles.
fn to_the_end(mut bench: Bench, duties: &mut Vec<Duty>) -> Result<(), Failure> {
    bench.order(ProcessState::Running)?;
    let (mut states, mut finished) = (0, false);
    while let Some(state) = bench.state(if states == 0 { START } else { ANSWER })? {
        states += 1;
        finished = state.has_status(status::FINISHED);
        if finished {
            break;
        }
        let answer = bench.holding(&state);
        bench.send(&answer)?;
        bench.peer_becomes(ProcessState::Ready, STILL)?;
    }
    let seen = format!("{states} states, the last one with{} FINISHED", if finished { "" } else { "out" });
    duties.push(duty("says FINISHED after the last step", finished && states == 5, seen));
    bench.controller_says(ProcessState::Finished)?;
    let said = bench.peer_becomes(ProcessState::Finished, END)?;
    let ended = bench.ended(END)?;
    let seen = format!("{:?}, {}", bench.peer_state(), how(ended, &bench));
    duties.push(duty("says Finished and ends with exit status 0", said && ended == Some(0), seen));
    Ok(())
}

/// The duties as a person reads them.
pub fn table(duties: &[Duty], colour: Colour) -> String {
    let mut text = String::new();
    for Duty { duty, met, seen } in duties {
        let mark = match met {
            Some(true) => colour.good("✓"),
            Some(false) => colour.bad("✗"),
            None => colour.faint("·"),
        };
        let _ = writeln!(text, "  {mark} {duty:<60} {}", colour.faint(&printable(seen)));
    }
    let asked = duties.iter().filter(|duty| duty.met.is_some()).count();
    let met = duties.iter().filter(|duty| duty.met == Some(true)).count();
    let _ = writeln!(text, "{met} of {asked} duties met");
    text
}
