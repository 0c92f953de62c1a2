//! `delmpc timing`: certifies the timing of the loop on two cores, and says whether the machine or the software was at fault.
//!
//! | phase | what runs | what it tells |
//! |---|---|---|
//! | floor | an idle thread on an absolute timer on each core, alone and beside a co-load | how late this machine wakes anybody up |
//! | loop | plant and controller as two processes, each on its core, watched by a witness thread | every latency, every missed deadline and its cause |
//! | stress | the same beside memory, cache and system-call load of ordinary priority | the same |
//! | again | every cycle of the loop once more from its inputs, several times | which part of its time is the software's |
//! | occupied floor | a thread whose fixed work takes as long as a cycle | the share of deadlines this machine makes anybody miss |
//! | transport | two processes that poll, beside a bare flag | what the link costs |
//!
//! With `--faults` it runs every fault of a scenario instead ([`campaign`]).
//!
//! Files: [`floor`], [`co_load`], [`transport`] measure; [`loop_phase`] runs the processes, [`again`] computes their cycles again;
//! [`attribution`] finds who missed a deadline; [`phases`] makes figures, [`mod@criteria`] judges by what [`chance`] allows, [`mod@table`] and [`pictures`] show. What the
//! operating system refuses is a warning, and the thresholds relative to the floor still hold.

pub mod again;
pub mod attribution;
pub mod campaign;
pub mod chance;
pub mod co_load;
pub mod criteria;
pub mod figures;
pub mod floor;
pub mod loop_phase;
pub mod machine_facts;
pub mod phases;
pub mod pictures;
pub mod probe;
pub mod raw_flag;
pub mod table;
pub mod transport;

use std::path::{Path, PathBuf};

use delmpc_controller_process::machine::available_cores;
use delmpc_controller_process::stop::StopFlag;
use delmpc_scenario::{Clock, Scenario};
use delmpc_transport::remove_dead_runs;
use serde::Serialize;

use crate::output::{line, print};
use crate::output_file;
use crate::run_folder::claim_or;
use crate::setup::{FAULT_SCENARIO, Setup, scenario_file, scenario_file_or};
use crate::supervisor::TIDY_UP;
use crate::timing::criteria::{Criterion, Measured, criteria};
use crate::timing::machine_facts::MachineFacts;
use crate::timing::phases::{FloorFigures, LoopFigures, Phases, without_privileges};
use crate::timing::transport::{TransportReport, TransportSettings, measure};
use crate::verdict::{Ended, Failure};

/// Messages of each transport measurement in each of its rounds.
const MESSAGES: u64 = 10_000;

/// Arguments of `delmpc timing`.
#[derive(Debug, Clone, clap::Args)]
pub struct TimingArguments {
    /// Scenario file [default: configs/scenarios/atlas_one_foot.toml; with --faults configs/scenarios/atlas_faults.toml]; its table `timing` has
    /// the thresholds
    pub scenario: Option<PathBuf>,
    /// Override a key of the scenario, for example --set timing.compute_spread=2
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Length of each phase with the loop, s; the phases of the floor are a quarter or a half of it
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0)]
    pub duration: f64,
    /// Core of the plant and core of the controller
    #[arg(long, value_name = "PLANT,CONTROLLER", value_delimiter = ',', num_args = 1..=2, default_values_t = [0, 1])]
    pub cores: Vec<usize>,
    /// Both processes on the first of the cores
    #[arg(long)]
    pub one_core: bool,
    /// Ask for no real-time priority and no locked memory
    #[arg(long)]
    pub no_rt: bool,
    /// Leave out the phases with co-load
    #[arg(long)]
    pub no_load: bool,
    /// Run every fault of the scenario instead, each in a run of its own: ladder levels and the robot's fate
    #[arg(long, conflicts_with_all = ["duration", "one_core", "no_load"])]
    pub faults: bool,
    /// With --faults: the fault that moves the machine's wall clock for a moment may do so
    #[arg(long, requires = "faults")]
    pub clock_jump: bool,
    /// Folder for timing.json, the histograms (PNG, SVG) and the results of the runs [default: runs/timing, with --faults runs/faults]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Print the report as JSON and nothing else
    #[arg(long)]
    pub json: bool,
}

/// Everything that was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TimingReport {
    /// The scenario.
    pub scenario: String,
    /// Its seed.
    pub seed: u64,
    /// Whether all thresholds are kept.
    pub kept: bool,
    /// Length of each phase with the loop (s).
    pub duration_s: f64,
    /// Cores of plant and controller.
    pub cores: [usize; 2],
    /// The plant's period (s).
    pub step_s: f64,
    /// The controller's period (s).
    pub period_s: f64,
    /// The machine.
    pub machine: MachineFacts,
    /// What the operating system refused.
    pub warnings: Vec<String>,
    /// Idle threads.
    pub idle_floor: Vec<FloorFigures>,
    /// Threads as busy as the controller.
    pub occupied_floor: Vec<FloorFigures>,
    /// The loop, alone and under co-load.
    pub loops: Vec<LoopFigures>,
    /// The links; nothing on one core, where nobody can poll.
    pub transport: Option<TransportReport>,
    /// The thresholds.
    pub criteria: Vec<Criterion>,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] before anything runs; [`Failure::Fault`] when a threshold is broken or a phase broke off.
pub fn timing(arguments: &TimingArguments) -> Result<Ended, Failure> {
    if arguments.faults {
        return faults(arguments);
    }
    let setup = timing_setup(arguments)?;
    let (folder, _lock) = claim_or(arguments.out.as_deref(), "runs/timing")?;
    let stop = StopFlag::on_signals().map_err(Failure::fault)?;
    remove_dead_runs(TIDY_UP, || stop.is_set());
    let Some(report) = all_phases(arguments, &setup, &folder, &stop)? else {
        return Ok(Ended::Interrupted);
    };
    let json = serde_json::to_string_pretty(&report).map_err(Failure::fault)?;
    let file = folder.join("timing.json");
    output_file::write(&file, &json)
        .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))?;
    pictures::write(&report, &folder)?;
    if arguments.json {
        line(&json)?;
    } else {
        print(&table::table(&report))?;
        line(folder.display())?;
    }
    verdict(&report)
}

/// Runs every fault of the scenario.
fn faults(arguments: &TimingArguments) -> Result<Ended, Failure> {
    let file = scenario_file_or(arguments.scenario.as_deref(), FAULT_SCENARIO)?;
    let mut setup = Setup::read(&file, &arguments.set)?;
    crate::plan_source::provide(&mut setup, false)?;
    if setup.scenario.fault.is_empty() {
        return Err(Failure::Input(format!("{}: it has no [[fault]]", file.display())));
    }
    set_cores(arguments, &mut setup.scenario);
    check_cores(&setup.scenario)?;
    let (folder, _lock) = claim_or(arguments.out.as_deref(), "runs/faults")?;
    let stop = StopFlag::on_signals().map_err(Failure::fault)?;
    remove_dead_runs(TIDY_UP, || stop.is_set());
    if !arguments.json {
        line(campaign::head())?;
    }
    let tell = |trial: &campaign::Trial| {
        if !arguments.json {
            let _ = line(campaign::line(trial));
        }
    };
    let trials = campaign::campaign(&setup, &folder, &stop, arguments.clock_jump, tell)?;
    let Some(trials) = trials else { return Ok(Ended::Interrupted) };
    let json = serde_json::to_string_pretty(&trials).map_err(Failure::fault)?;
    let file = folder.join("faults.json");
    output_file::write(&file, &json)
        .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))?;
    if arguments.json {
        line(&json)?;
    } else {
        line(file.display())?;
    }
    let wrong: Vec<&str> = trials.iter().filter(|t| t.wrong.is_some()).map(|t| t.fault.as_str()).collect();
    if wrong.is_empty() {
        return Ok(Ended::Well);
    }
    Err(Failure::Fault(format!("faults with consequences they must not have: {}", wrong.join("; "))))
}

/// The scenario with its processes on their cores.
fn timing_setup(arguments: &TimingArguments) -> Result<Setup, Failure> {
    let file = scenario_file(arguments.scenario.as_deref())?;
    let mut setup = Setup::read(&file, &arguments.set)?;
    crate::plan_source::provide(&mut setup, false)?;
    let scenario = &mut setup.scenario;
    let steps = (arguments.duration / scenario.plant.step_s).round();
    if !(1.0..=3600.0).contains(&arguments.duration) {
        return Err(Failure::Input("--duration: must lie in 1 .. 3600 s".to_owned()));
    }
    scenario.clock = Clock::Realtime;
    scenario.duration_s = steps * scenario.plant.step_s;
    set_cores(arguments, scenario);
    check_cores(scenario)?;
    Ok(setup)
}

/// Refuses cores that are not there, or not ours: found out later, it would cost the time of the floor.
fn check_cores(scenario: &Scenario) -> Result<(), Failure> {
    let ours = available_cores();
    match loop_phase::cores_of(scenario).into_iter().find(|core| !ours.is_empty() && !ours.contains(core)) {
        None => Ok(()),
        Some(core) => {
            let list: Vec<String> = ours.iter().map(usize::to_string).collect();
            let list = list.join(", ");
            Err(Failure::Input(format!(
                "core {core} is not there, or not ours: those of this process are {list}; name two with --cores, or give --one-core"
            )))
        }
    }
}

fn set_cores(arguments: &TimingArguments, scenario: &mut Scenario) {
    let plant = arguments.cores.first().copied().unwrap_or(0);
    let controller = arguments.cores.get(1).copied().unwrap_or(plant);
    scenario.process.plant_core = Some(plant);
    scenario.process.controller_core = Some(if arguments.one_core { plant } else { controller });
    if arguments.no_rt {
        without_privileges(&mut scenario.process);
    }
}

/// One phase after the other; `None`: interrupted.
fn all_phases(
    arguments: &TimingArguments,
    setup: &Setup,
    folder: &Path,
    stop: &StopFlag,
) -> Result<Option<TimingReport>, Failure> {
    let scenario = &setup.scenario;
    let cores = loop_phase::cores_of(scenario);
    let duration_s = arguments.duration;
    let mut phases = Phases { setup, stop, warnings: Vec::new() };
    let loads: &[bool] = if arguments.no_load { &[false] } else { &[false, true] };
    let tell = |what: &str| {
        if !arguments.json {
            crate::output::say(what);
        }
    };
    let (mut idle_floor, mut occupied_floor, mut loops) = (Vec::new(), Vec::new(), Vec::new());
    for &loaded in loads {
        let with = if loaded { ", co-load" } else { "" };
        tell(&format!("machine's floor{with}"));
        idle_floor.extend(phases.idle_floor(duration_s / 4.0, loaded)?);
        if stop.is_set() {
            return Ok(None);
        }
    }
    for &loaded in loads {
        let (name, with) = if loaded { ("loop-load", ", co-load") } else { ("loop", "") };
        tell(&format!("loop{with}"));
        let done = phases.run_loop(&folder.join(name), loaded)?;
        if stop.is_set() {
            return Ok(None);
        }
        tell(&format!("the cycles of the loop again{with}"));
        let Some(figures) = phases.loop_figures(done)? else { return Ok(None) };
        loops.push(figures);
    }
    for (figures, &loaded) in loops.iter().zip(loads) {
        let with = if loaded { ", co-load" } else { "" };
        let own = figures.quantities.iter().find(|quantity| quantity.key == "cycle_own");
        let Some(own) = own.and_then(|quantity| quantity.figures) else { continue };
        tell(&format!("machine's floor as busy as the controller{with}"));
        occupied_floor.extend(phases.occupied_floor(duration_s / 2.0, own.p50_s, loaded)?);
        if stop.is_set() {
            return Ok(None);
        }
    }
    let transport = (cores[0] != cores[1]).then(|| {
        tell("transport");
        let process = scenario.process.clone();
        measure(&TransportSettings { cores, process, messages: MESSAGES })
    });
    let transport = transport.transpose()?;
    let criteria = criteria(
        &scenario.timing,
        &Measured {
            idle: &idle_floor,
            occupied: &occupied_floor,
            loops: &loops,
            transport: transport.as_ref(),
            controller_core: cores[1],
        },
    );
    let broke_off = loops.iter().any(|figures| figures.fault.is_some());
    Ok(Some(TimingReport {
        scenario: scenario.name.clone(),
        seed: scenario.seed,
        kept: !broke_off && criteria.iter().all(|criterion| criterion.kept),
        duration_s: scenario.duration_s,
        cores,
        step_s: scenario.plant.step_s,
        period_s: 1.0 / scenario.controller.mpc_rate_hz,
        machine: MachineFacts::read(),
        warnings: phases.warnings,
        idle_floor,
        occupied_floor,
        loops,
        transport,
        criteria,
    }))
}

/// A broken threshold is a fault.
fn verdict(report: &TimingReport) -> Result<Ended, Failure> {
    if report.kept {
        return Ok(Ended::Well);
    }
    let faults = report.loops.iter().filter_map(|figures| figures.fault.clone());
    let broken = report.criteria.iter().filter(|criterion| !criterion.kept);
    let broken = broken.map(|criterion| format!("{} ({})", criterion.what, criterion.key));
    let list: Vec<String> = faults.chain(broken).collect();
    Err(Failure::Fault(format!("timing broken: {}", list.join("; "))))
}
