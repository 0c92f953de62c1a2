//! `delmpc plant`: the plant process.

use std::collections::BTreeMap;
use std::io::BufReader;

use delmpc_controller_process::membership::Membership;
use delmpc_messages::{PlantState, Role};
use delmpc_scenario::Clock;
use delmpc_transport::{Channel, RunId};

use crate::cli::PartArguments;
use crate::faults::FaultyPlant;
use crate::log::{Log, LogHead};
use crate::log_viewer::LogViewer;
use crate::output::say;
use crate::part::{
    PartFolder, StandIn, Supervisor, ended, leave_part, leave_records, lost_after_s, message_run_id,
    prepare_machine, run_id,
};
use crate::plant_process::{PlantLoop, PlantRun};
use crate::run_folder::{PLANT_PART, STEP_RECORDS, effective};
use crate::setup::Setup;
use crate::simulated_robot::SimulatedRobot;
use crate::steering::Steering;
use crate::verdict::{Ended, Failure};

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] before anything runs, [`Failure::Fault`] when the run broke off.
pub fn plant(arguments: &PartArguments) -> Result<Ended, Failure> {
    let supervisor = Supervisor::of(arguments);
    let mut setup = Setup::read(&arguments.scenario, &arguments.set)?;
    crate::plan_source::provide(&mut setup, true)?;
    let scenario = &setup.scenario;
    let run = run_id(arguments, &setup)?;
    let mut robot = FaultyPlant::new(SimulatedRobot::new(&setup)?, scenario);
    let part = PartFolder::enter(arguments, Role::Plant, &setup)?;
    let log = match &arguments.out {
        Some(folder) if !arguments.timing => {
            let waits = scenario.clock == Clock::Lockstep;
            let first = !waits && scenario.process.priority > 0;
            Log::create(&folder.join("log.mcap"), log_head(&setup, run), waits, first)?
        }
        _ => Log::none(),
    };
    let _awake = prepare_machine(Role::Plant, scenario);

    let hash = setup.joint_set_hash();
    let _stand_in = StandIn(supervisor, run);
    let mut membership =
        Membership::join(run, hash, Role::Plant, arguments.supervised, lost_after_s(scenario))
            .map_err(Failure::fault)?;
    if !arguments.supervised {
        say(&format!("run {run}: the plant waits for a controller of the same scenario"));
    }
    // First the ear, then the mouth: the answer to the first state must not be missed.
    let commands = membership.node().subscriber(Channel::Command);
    let commands = membership.connected(commands).map_err(Failure::fault)?;
    let states = membership.node().publisher(Channel::State);
    let states = membership.connected(states).map_err(Failure::fault)?;
    let blank = PlantState::new(message_run_id(run, scenario), hash, setup.robot.joint_names.len() as u32);
    let steering = match arguments.steered {
        true => Steering::by_lines(BufReader::new(std::io::stdin()), setup.robot.tree.body_count()),
        false => Steering::none(),
    };
    let mut plant_loop =
        PlantLoop::new(scenario, states, commands, &blank, log).steered(steering).judged_for(&setup)?;
    if arguments.timing {
        plant_loop = plant_loop.recording();
    }
    let PlantRun { ending, part: mut figures, log, records } =
        plant_loop.run(&mut robot, &mut membership).map_err(Failure::fault)?;
    let logged = log.finish();
    figures.log_records_dropped = *logged.as_ref().unwrap_or(&0);
    if figures.log_records_dropped > 0 {
        let lost = figures.log_records_dropped;
        say(&format!(
            "warning: {lost} records of the log were lost: the machine could not write them in time"
        ));
    }
    drop(membership);
    let folder = arguments.out.as_deref();
    leave_records(folder, STEP_RECORDS, &records)?;
    leave_part(folder, PLANT_PART, &figures)?;
    logged?;
    part.leave(&setup, ended(ending, "controller")?)
}

/// What the log says about its run. In lockstep only what is the same in every run of the seed.
pub fn log_head(setup: &Setup, run: RunId) -> LogHead {
    let mut files = setup.robot_files();
    files
        .insert(0, ("scenario.toml".to_owned(), "application/toml", effective(setup).to_toml().into_bytes()));
    LogHead { about: about(setup, Some(run)), files, viewer: Some(LogViewer::new(setup)) }
}

/// What identifies a run; in real time, if `run` is given, also what is of this one only.
pub fn about(setup: &Setup, run: Option<RunId>) -> BTreeMap<String, String> {
    let scenario = effective(setup);
    let mut about = BTreeMap::from([
        ("program".to_owned(), concat!("delmpc ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("scenario".to_owned(), scenario.name.clone()),
        ("seed".to_owned(), scenario.seed.to_string()),
        ("configuration".to_owned(), scenario.to_toml()),
        ("joints".to_owned(), setup.robot.joint_names.join(" ")),
        ("joint_set_hash".to_owned(), format!("{:016x}", setup.joint_set_hash())),
        ("model_hash".to_owned(), format!("{:016x}", setup.model_hash())),
        ("git_revision".to_owned(), env!("DELMPC_GIT_REVISION").to_owned()),
    ]);
    if let Some(run) = run.filter(|_| scenario.clock == Clock::Realtime) {
        about.insert("run".to_owned(), run.to_string());
        about.insert("plant_pid".to_owned(), std::process::id().to_string());
    }
    about
}
