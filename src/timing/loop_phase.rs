//! The real loop: both processes on their cores, watched by witnesses, every cycle and step on record.

use std::fs;
use std::path::Path;

use bytemuck::Pod;
use delmpc_controller_process::records::{CycleRecord, StepRecord, read_records};
use delmpc_controller_process::stop::StopFlag;
use delmpc_scenario::{ProcessSettings, Scenario};

use crate::run_folder::{
    CLOCK_READINGS, CONTROLLER_PART, CYCLE_INPUTS, CYCLE_RECORDS, PLANT_PART, RunFolder, STEP_RECORDS,
};
use crate::setup::Setup;
use crate::summary::{ControllerPart, PlantPart, Summary};
use crate::supervisor::{Course, Program, Supervision, fresh_run};
use crate::timing::again::Tape;
use crate::timing::floor::{FloorRun, FloorSettings, FloorThread, WITNESS_NS, Work};
use crate::verdict::Failure;

/// What a run of the loop left behind.
#[derive(Debug)]
pub struct LoopRun {
    /// How it ended.
    pub course: Course,
    /// Every cycle.
    pub cycles: Vec<CycleRecord>,
    /// What entered the cycles.
    pub tape: Tape,
    /// Every step.
    pub steps: Vec<StepRecord>,
    /// The witness of each core, plant's first.
    pub witnesses: Vec<(usize, FloorRun)>,
    /// The figures of an ordinary run.
    pub summary: Summary,
    /// What the processes warned of.
    pub warnings: Vec<String>,
}

/// Runs the scenario of `setup` with its processes on the cores it names; the results are left in a folder.
///
/// # Errors
/// [`Failure::Fault`] when something cannot be started, [`Failure::Input`] when the folder cannot be made.
pub fn run_loop(setup: &Setup, folder: &Path, stop: &StopFlag) -> Result<LoopRun, Failure> {
    let scenario = &setup.scenario;
    let folder = RunFolder::create(Some(folder), &scenario.name)?;
    folder.write_inputs(setup)?;
    let witnesses = start_witnesses(scenario)?;
    let supervision = Supervision {
        run: fresh_run()?,
        program: std::env::current_exe().map_err(Failure::fault)?,
        plant: Program::Ours,
        controller: Program::Ours,
        arguments: vec![
            path_text(&folder.file("scenario.toml"))?,
            "--out".to_owned(),
            path_text(folder.path())?,
            "--timing".to_owned(),
        ],
        messages: folder.file("messages.txt"),
        steering: None,
        show_messages: false,
        hang_s: scenario.process.hang_s,
        lockstep: false,
        restarts: 0,
        late: None,
    };
    let course = supervision.supervise(stop, |_| {});
    let witnesses: Vec<_> = witnesses
        .into_iter()
        .map(|(core, witness)| Ok((core, witness.finish()?)))
        .collect::<Result<_, Failure>>()?;
    let course = course?;
    let messages = fs::read_to_string(folder.file("messages.txt")).unwrap_or_default();
    let warnings = messages.lines().filter(|line| line.contains("warning: "));
    let warnings: Vec<String> = warnings.map(|line| line.replacen("warning: ", "", 1)).collect();
    let fault = match &course {
        Course::Finished => None,
        Course::Interrupted => Some("interrupted".to_owned()),
        Course::Fault(why) => Some(why.clone()),
    };
    let (plant, controller) = take_parts(&folder);
    let cycles = take_records(&folder.file(CYCLE_RECORDS));
    let steps = take_records(&folder.file(STEP_RECORDS));
    let tape = Tape {
        inputs: take_records(&folder.file(CYCLE_INPUTS)),
        readings: take_records(&folder.file(CLOCK_READINGS)),
    };
    let summary = Summary::new(scenario, plant, controller, fault);
    summary
        .write(&folder.file("summary.json"))
        .map_err(|error| Failure::Fault(format!("summary.json: {error}")))?;
    Ok(LoopRun { course, cycles, tape, steps, witnesses, summary, warnings })
}

/// The cores of a scenario's processes: the plant's and the controller's.
pub fn cores_of(scenario: &Scenario) -> [usize; 2] {
    [scenario.process.plant_core.unwrap_or(0), scenario.process.controller_core.unwrap_or(1)]
}

fn start_witnesses(scenario: &Scenario) -> Result<Vec<(usize, FloorThread)>, Failure> {
    let mut cores = cores_of(scenario).to_vec();
    cores.dedup();
    // The loop's processes keep the cores awake.
    let mut process = ProcessSettings { keep_awake: false, ..scenario.process.clone() };
    // Above controller and plant: nothing of ours can hold it up.
    if process.priority > 0 {
        process.priority = (process.priority + 2).min(99);
    }
    let witness = |core: usize| {
        let settings = FloorSettings {
            core: Some(core),
            process: process.clone(),
            period_ns: WITNESS_NS,
            work: Work::Probe,
            // It is told when to end; there is room for a slow start and a run that paused.
            duration_ns: ((1.5 * scenario.duration_s + 20.0) * 1e9) as u64,
        };
        Ok((core, FloorThread::start(settings)?))
    };
    cores.into_iter().map(witness).collect()
}

/// A path as an argument.
///
/// # Errors
/// When it is no text.
pub fn path_text(path: &Path) -> Result<String, Failure> {
    let text = path.to_str().map(str::to_owned);
    text.ok_or_else(|| Failure::Input(format!("{}: the path is not UTF-8", path.display())))
}

/// What the processes found out, removed from the folder; `None` for one that left nothing.
pub fn take_parts(folder: &RunFolder) -> (Option<PlantPart>, Option<ControllerPart>) {
    (take_json(&folder.file(PLANT_PART)), take_json(&folder.file(CONTROLLER_PART)))
}

/// What a process left, removed from the folder; `None` when it left nothing that can be read.
fn take_json<T: serde::de::DeserializeOwned>(file: &Path) -> Option<T> {
    let text = fs::read_to_string(file).ok()?;
    let _ = fs::remove_file(file);
    serde_json::from_str(&text).ok()
}

fn take_records<R: Pod>(file: &Path) -> Vec<R> {
    let records = fs::read(file).ok().and_then(|bytes| read_records(&bytes)).unwrap_or_default();
    let _ = fs::remove_file(file);
    records
}
