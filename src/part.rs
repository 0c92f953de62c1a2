//! What `delmpc plant` and `delmpc controller` have in common.

use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use bytemuck::Pod;
use delmpc_controller_process::awake::Awake;
use delmpc_controller_process::controller_loop::Ending;
use delmpc_controller_process::machine::prepare;
use delmpc_controller_process::membership::Order;
use delmpc_controller_process::records::Records;
use delmpc_messages::Role;
use delmpc_scenario::{Clock, Scenario};
use delmpc_transport::{RunId, remove_leftovers};
use rustix::process::{Pid, getppid};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::cli::PartArguments;
use crate::colour::Colour;
use crate::output::{line, print, say};
use crate::run_folder::{CONTROLLER_PART, MOST_TEXT, PLANT_PART, RunFolder};
use crate::setup::Setup;
use crate::summary::Summary;
use crate::summary_table::summary_table;
use crate::verdict::{Ended, Failure};
use crate::{input_file, output_file};

/// The run a process belongs to: the named one, or one made from the scenario, so that two processes of the same scenario meet.
///
/// # Errors
/// When the name is none of a run.
pub fn run_id(arguments: &PartArguments, setup: &Setup) -> Result<RunId, Failure> {
    run_id_of(arguments.run_id.as_deref(), setup)
}

/// The run of a name, or the one made from a scenario.
///
/// # Errors
/// As [`run_id`].
pub fn run_id_of(named: Option<&str>, setup: &Setup) -> Result<RunId, Failure> {
    match named {
        Some(text) => text.parse().map_err(|error| Failure::Input(format!("--run-id: {error}"))),
        None => RunId::of_text(&setup.scenario.to_toml()).map_err(Failure::fault),
    }
}

/// The number of the run in every message: that of the run, or in lockstep the seed, so that runs are reproducible.
pub fn message_run_id(run: RunId, scenario: &Scenario) -> u64 {
    match scenario.clock {
        Clock::Realtime => run.0,
        Clock::Lockstep => scenario.seed,
    }
}

/// Asks the operating system for what the scenario wants, and says what it refused. Lockstep asks for nothing. The process's core, if it has
/// one, stays awake as long as what is returned lives.
pub fn prepare_machine(role: Role, scenario: &Scenario) -> Option<Awake> {
    if scenario.clock == Clock::Lockstep {
        return None;
    }
    let mut process = scenario.process.clone();
    let core = match role {
        Role::Plant => process.plant_core,
        _ => process.controller_core,
    };
    // Rate-monotonic, for the case that both share a core. Source: Liu, Layland, "Scheduling algorithms for multiprogramming in a
    // hard-real-time environment", J. ACM 20, 1973.
    if role == Role::Plant && process.priority > 0 {
        process.priority = (process.priority + 1).min(99);
    }
    // Before the priority is raised: its thread would inherit that.
    let awake = Awake::keep(&process, core);
    for warning in prepare(&process, core) {
        say(&format!("warning: {warning}"));
    }
    awake
}

/// How long the other process may be silent before it counts as lost; nothing: as long as it lives.
pub fn lost_after_s(scenario: &Scenario) -> Option<f64> {
    (scenario.clock == Clock::Realtime).then_some(scenario.process.hang_s)
}

/// Tidies up as [`Supervisor::stand_in`] when it is dropped, however the process came to its end. Make it before what belongs to the run, so
/// that it is dropped after that.
#[derive(Debug)]
pub struct StandIn(pub Supervisor, pub RunId);

impl Drop for StandIn {
    fn drop(&mut self) {
        self.0.stand_in(self.1);
    }
}

/// Times a process looks whether it is the last one, and tidies up.
const STAND_IN_ATTEMPTS: u32 = 10;
const STAND_IN_PAUSE: Duration = Duration::from_millis(20);

/// Who supervises this process, as long as it lives.
#[derive(Debug, Clone, Copy)]
pub struct Supervisor(Option<Pid>);

impl Supervisor {
    /// The parent of a supervised process.
    pub fn of(arguments: &PartArguments) -> Self {
        Self(arguments.supervised.then(getppid).flatten())
    }

    /// Does the last duty of a supervisor where there is none, or none any more: removes what the run left. Call it when all that belongs to
    /// the run is dropped; the last process to do so succeeds.
    pub fn stand_in(self, run: RunId) {
        if self.0.is_none() || getppid() != self.0 {
            // The other process may be ending too, and be seen to live still.
            for _ in 0..STAND_IN_ATTEMPTS {
                if remove_leftovers(run).is_ok() {
                    break;
                }
                sleep(STAND_IN_PAUSE);
            }
        }
    }
}

/// The folder of the results of a process that is nobody's child, if it has one.
#[derive(Debug)]
pub struct PartFolder(Option<RunFolder>);

impl PartFolder {
    /// Makes or enters the folder.
    ///
    /// # Errors
    /// As [`RunFolder::join`].
    pub fn enter(arguments: &PartArguments, role: Role, setup: &Setup) -> Result<Self, Failure> {
        match &arguments.out {
            Some(path) if !arguments.supervised => Ok(Self(Some(RunFolder::join(path, role, setup)?))),
            _ => Ok(Self(None)),
        }
    }

    /// The process has left its part; the last one puts both together as `delmpc run` does: summary, report, table.
    ///
    /// # Errors
    /// [`Failure::Fault`] when the summary cannot be written.
    pub fn leave(self, setup: &Setup, ended: Ended) -> Result<Ended, Failure> {
        match self.0.filter(RunFolder::is_left_by_the_last) {
            None => Ok(ended),
            Some(folder) => {
                let interrupted = (ended == Ended::Interrupted).then(|| "interrupted".to_owned());
                let summary = summarize(setup, &folder, interrupted)?;
                let shown = match crate::report::write(folder.path()) {
                    Ok(page) => page,
                    Err(failure) => {
                        say(&format!("warning: no report: {failure}"));
                        folder.path().to_owned()
                    }
                };
                let feet = setup.robot.soles.len();
                let colour = Colour::of(&std::io::stdout());
                print(&summary_table(&summary, &setup.scenario, feet, colour))?;
                line(shown.display())?;
                match (ended, summary.success) {
                    (Ended::Well, false) => Ok(Ended::CriterionMissed),
                    _ => Ok(ended),
                }
            }
        }
    }
}

/// Puts the parts that two processes left in a folder together, and writes `summary.json`. `fault`: why the run broke off, if it did.
///
/// # Errors
/// [`Failure::Fault`] when the summary cannot be written.
pub fn summarize(setup: &Setup, folder: &RunFolder, fault: Option<String>) -> Result<Summary, Failure> {
    let (mut plant, mut controller, mut fault) = (None, None, fault);
    match (take_part(&folder.file(PLANT_PART)), take_part(&folder.file(CONTROLLER_PART))) {
        (Ok(plant_part), Ok(controller_part)) => (plant, controller) = (plant_part, controller_part),
        (Err(error), _) | (_, Err(error)) => fault = fault.or(Some(error)),
    }
    if plant.is_none() || controller.is_none() {
        fault = fault.or(Some("a process left no figures".to_owned()));
    }
    let summary = Summary::new(&setup.scenario, plant, controller, fault);
    let written = summary.write(&folder.file("summary.json"));
    written.map_err(|error| Failure::Fault(format!("summary.json: {error}")))?;
    Ok(summary)
}

/// Reads a process's part of the results and removes the file; `None` when the process left none.
fn take_part<T: DeserializeOwned>(file: &Path) -> Result<Option<T>, String> {
    let wrong = |error: &dyn std::fmt::Display| format!("{}: {error}", file.display());
    match input_file::read_text(file, MOST_TEXT) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(wrong(&error)),
        Ok(text) => {
            let part = serde_json::from_str(&text).map_err(|error| wrong(&error))?;
            std::fs::remove_file(file).map_err(|error| wrong(&error))?;
            Ok(Some(part))
        }
    }
}

/// Leaves a part of the results in the run's folder, or prints it when there is none.
///
/// # Errors
/// When the file cannot be written.
pub fn leave_part(folder: Option<&Path>, name: &str, part: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(part).map_err(Failure::fault)?;
    match folder {
        None => line(&text),
        Some(folder) => {
            let file = folder.join(name);
            // Whole or not at all: the supervisor may look at any time.
            let aside = folder.join(format!(".{name}"));
            let moved = output_file::write(&aside, text).and_then(|()| std::fs::rename(&aside, &file));
            moved.map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))
        }
    }
}

/// Leaves the records of a loop in the run's folder; nothing when none were kept.
///
/// # Errors
/// When the file cannot be written.
pub fn leave_records<R: Pod>(folder: Option<&Path>, name: &str, records: &Records<R>) -> Result<(), Failure> {
    let Some(folder) = folder.filter(|_| records.are_kept()) else { return Ok(()) };
    if records.lost() > 0 {
        say(&format!("warning: no room for {} of the records in {name}", records.lost()));
    }
    let file = folder.join(name);
    output_file::write(&file, records.bytes())
        .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))
}

/// What the ending of a loop means for the process.
///
/// # Errors
/// When somebody was lost.
pub fn ended(ending: Ending, other: &str) -> Result<Ended, Failure> {
    match ending {
        Ending::Finished => Ok(Ended::Well),
        Ending::Ordered(Order::SupervisorLost) => Err(Failure::Fault("the supervisor is gone".to_owned())),
        Ending::Ordered(Order::PeerLost) => Err(Failure::Fault(format!("the {other} process is gone"))),
        Ending::Ordered(_) => Ok(Ended::Interrupted),
    }
}
