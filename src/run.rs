//! `delmpc run`: a scenario from beginning to end.

use std::io::{IsTerminal, Write};
use std::path::Path;
use std::sync::PoisonError;

use delmpc_controller_process::stop::StopFlag;
use delmpc_scenario::{Clock, FaultTarget};
use delmpc_transport::{RunId, remove_dead_runs};

use crate::cli::{RunArguments, RunOptions};
use crate::colour::Colour;
use crate::connection::Connection;
use crate::foreign_controller::CommandCounter;
use crate::foreign_plant::Listener;
use crate::one_process::run_in_one_process;
use crate::output::{line, print, say};
use crate::part::summarize;
use crate::plan_source;
use crate::robot_controller::RobotController;
use crate::run_folder::RunFolder;
use crate::setup::{Setup, scenario_file};
use crate::simulated_robot::SimulatedRobot;
use crate::status_line::StatusLine;
use crate::summary_table::summary_table;
use crate::supervisor::{Course, Program, Supervision, TIDY_UP, fresh_run};
use crate::verdict::{Ended, Failure};
use crate::view::View;

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] before anything runs, [`Failure::Fault`] when the run broke off.
pub fn run(arguments: &RunArguments) -> Result<Ended, Failure> {
    let options = &arguments.options;
    let file = scenario_file(arguments.scenario.as_deref())?;
    let mut setup = Setup::read(&file, &options.set)?;
    plan_source::provide(&mut setup, options.quiet || options.json)?;
    let scenario = &setup.scenario;
    if options.one_process && scenario.clock != Clock::Lockstep {
        return Err(Failure::Input(
            "--one-process needs the lockstep clock: add --set clock=lockstep".to_owned(),
        ));
    }
    let talkative = !options.quiet && !options.json;
    if !options.quiet {
        for warning in setup.notes.iter().cloned().chain(scenario.warnings()) {
            say(&format!("warning: {warning}"));
        }
    }
    if !options.one_process {
        // What either process would refuse is refused here, before anything is overwritten or started.
        if options.controller.is_none() {
            RobotController::new(&setup)?;
        }
        match &options.plant {
            None => drop(SimulatedRobot::new(&setup)?),
            Some(_) => warn_of_what_is_the_plants(&setup),
        }
    }
    let folder = RunFolder::create(options.out.as_deref(), &scenario.name)?;
    folder.write_inputs(&setup)?;
    let stop = StopFlag::on_signals().map_err(Failure::fault)?;

    let mut view = None;
    let course = if options.one_process {
        run_in_one_process(&setup, &folder, &stop)?
    } else {
        run_in_two_processes(&setup, &folder, &stop, options, &mut view)?
    };
    let fault = match course {
        Course::Finished => None,
        Course::Interrupted => Some("interrupted".to_owned()),
        Course::Fault(ref why) => Some(why.clone()),
    };
    let finished = fault.is_none();
    let summary = summarize(&setup, &folder, fault)?;
    let broke_off = !finished || summary.plant.is_none() || summary.controller.is_none();
    if let Some(view) = view {
        view.finish(summary.success, summary.failure.as_deref());
    }
    let mut report = None;
    if !options.no_report {
        // A run is not worse because it cannot be drawn.
        match crate::report::write(folder.path()) {
            Ok(page) => report = Some(page),
            Err(failure) if options.quiet => drop(failure),
            Err(failure) => say(&format!("warning: no report: {failure}")),
        }
    }

    if options.json {
        line(summary.to_json())?;
    } else if talkative {
        let feet = setup.robot.soles.len();
        print(&summary_table(&summary, scenario, feet, Colour::of(&std::io::stdout())))?;
        line(report.as_deref().unwrap_or(folder.path()).display())?;
    }
    match (course, summary.failure) {
        (Course::Interrupted, _) => Ok(Ended::Interrupted),
        (_, Some(failure)) if broke_off => Err(Failure::Fault(failure)),
        (_, Some(failure)) => {
            if options.quiet && !options.json {
                say(&failure);
            }
            Ok(Ended::CriterionMissed)
        }
        (_, None) => Ok(Ended::Well),
    }
}

fn run_in_two_processes(
    setup: &Setup,
    folder: &RunFolder,
    stop: &StopFlag,
    options: &RunOptions,
    view: &mut Option<View>,
) -> Result<Course, Failure> {
    let talkative = !options.quiet && !options.json;
    remove_dead_runs(TIDY_UP, || stop.is_set());
    let run = fresh_run()?;
    if options.view {
        let opened = view.insert(View::new(setup, options.port)?);
        let _ = writeln!(std::io::stderr(), "open {} to begin", opened.address());
    }
    let scenario = folder.file("scenario.toml");
    let programs = Programs::of(setup, run, options, folder)?;
    let mut ears = (programs.listener, programs.counter);
    let heard = ears.0.as_ref().map(Listener::outcome);
    let supervision = Supervision {
        run,
        program: std::env::current_exe().map_err(Failure::fault)?,
        plant: programs.plant,
        controller: programs.controller,
        arguments: vec![text(&scenario)?, "--out".to_owned(), text(folder.path())?],
        messages: folder.file("messages.txt"),
        steering: view.as_ref().map(View::pipe),
        show_messages: talkative,
        hang_s: setup.scenario.process.hang_s,
        lockstep: setup.scenario.clock == Clock::Lockstep,
        restarts: 0,
        late: None,
    };
    let show = talkative && std::io::stderr().is_terminal();
    let mut line = show.then(|| StatusLine::new(setup, run));
    let mut watch = view.as_ref().map(|view| view.watch(setup, run)).transpose()?;
    // What listens to the run goes into the closure, and ends with it: before the run is tidied up.
    let course = supervision.supervise(stop, move |_| {
        let _listen = &mut ears;
        if let Some(watch) = &mut watch {
            watch.look();
        }
        if let Some(text) = line.as_mut().and_then(StatusLine::look) {
            // Cut off where the terminal ends: what wraps could not be overwritten.
            let _ = write!(std::io::stderr(), "\r\x1b[K\x1b[?7l{text}\x1b[?7h");
        }
    });
    if show {
        let _ = write!(std::io::stderr(), "\r\x1b[K");
    }
    match heard.map(|heard| heard.lock().unwrap_or_else(PoisonError::into_inner).clone()) {
        Some(Err(why)) if course == Ok(Course::Finished) => Err(Failure::Fault(why)),
        _ => course,
    }
}

/// Who plays plant and controller; and who listens to those that are not ours.
struct Programs {
    plant: Program,
    controller: Program,
    listener: Option<Listener>,
    counter: Option<CommandCounter>,
}

impl Programs {
    fn of(setup: &Setup, run: RunId, options: &RunOptions, folder: &RunFolder) -> Result<Self, Failure> {
        let ours = Self { plant: Program::Ours, controller: Program::Ours, listener: None, counter: None };
        if options.plant.is_none() && options.controller.is_none() {
            return Ok(ours);
        }
        let connection = Connection::new(setup, run, &folder.file("scenario.toml"))?;
        let environment = connection.environment(&connection.write(folder.path())?);
        let program = |command: &Option<String>| match command {
            Some(command) => Program::Foreign { command: command.clone(), environment: environment.clone() },
            None => Program::Ours,
        };
        let listen = |command: &String| Listener::begin(setup, run, command, folder.path());
        let counts = options.controller.is_some();
        Ok(Self {
            plant: program(&options.plant),
            controller: program(&options.controller),
            listener: options.plant.as_ref().map(listen).transpose()?,
            counter: counts.then(|| CommandCounter::begin(setup, run, folder.path())).transpose()?,
        })
    }
}

/// Keys of the scenario that our plant would have acted on.
fn warn_of_what_is_the_plants(setup: &Setup) {
    if setup.scenario.fault.iter().any(|fault| fault.target == FaultTarget::Command) {
        say("warning: faults of commands strike within our plant: with --plant they are left out");
    }
}

fn text(path: &Path) -> Result<String, Failure> {
    let text = path.to_str().map(str::to_owned);
    text.ok_or_else(|| Failure::Input(format!("{}: the path is not UTF-8", path.display())))
}
