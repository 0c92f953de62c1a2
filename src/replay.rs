//! `delmpc replay`: a run again from its log, compared bit by bit.
//!
//! The records of the log are in the order in which things happened. The plant is made anew and given every logged command where it came;
//! each state and truth must come out as logged. In lockstep the controller is given every logged state, and each command must come out as
//! logged; in real time its answers depend on the wall clock, and are only taken from the log.

use std::path::{Path, PathBuf};

use delmpc_controller_process::controller_loop::{Controller, address};
use delmpc_messages::{Command, PlantState, status};
use delmpc_scenario::Clock;
use mcap::MessageStream;

use crate::faults::{FaultyController, FaultyPlant};
use crate::log::{COMMAND, PULL, STATE, TRUTH, read_record};
use crate::plant_process::{CommandQueue, Plant};
use crate::robot_controller::RobotController;
use crate::setup::Setup;
use crate::simulated_robot::SimulatedRobot;
use crate::truth::Truth;
use crate::verdict::{Ended, Failure};

/// Arguments of `delmpc replay`.
#[derive(Debug, clap::Args)]
pub struct ReplayArguments {
    /// Folder of the run
    #[arg(default_value = "runs/latest")]
    pub run: PathBuf,
    /// Compare with the log bit by bit; the exit status is 1 at the first difference
    #[arg(long, required = true)]
    pub verify: bool,
}

/// What was compared.
#[derive(Debug, Default)]
struct Compared {
    states: u64,
    truths: u64,
    commands: u64,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a folder that holds no complete run.
pub fn replay(arguments: &ReplayArguments) -> Result<Ended, Failure> {
    let folder = &arguments.run;
    let setup = Setup::read(&folder.join("scenario.toml"), &[])?;
    let file = folder.join("log.mcap");
    let log = std::fs::read(&file).map_err(|error| Failure::Input(format!("{}: {error}", file.display())))?;
    match compare(&setup, &log, &file)? {
        Ok(Compared { states, truths, commands }) => {
            println!("the same bits: {truths} steps, {states} states, {commands} commands");
            if setup.scenario.clock == Clock::Realtime {
                println!("commands of a real-time run were taken from the log, not computed again");
            }
            Ok(Ended::Well)
        }
        Err(difference) => {
            println!("{difference}");
            Ok(Ended::CriterionMissed)
        }
    }
}

/// Replays a log; the inner error is the first difference.
fn compare(setup: &Setup, log: &[u8], file: &Path) -> Result<Result<Compared, String>, Failure> {
    let broken = |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", file.display()));
    let scenario = &setup.scenario;
    let mut plant = FaultyPlant::new(SimulatedRobot::new(setup)?, scenario);
    let mut controller = match scenario.clock {
        Clock::Lockstep => Some(FaultyController::new(RobotController::new(setup)?, scenario)),
        Clock::Realtime => None,
    };
    let delay_ns = (scenario.sensors.delay_s * 1e9).round() as u64;
    let mut queue = CommandQueue::new(scenario);
    let mut compared = Compared::default();
    let mut state = PlantState::new(0, 0, 0);
    let mut truth = Truth::new(setup.robot.joint_names.len() as u32);
    let mut command: Option<Command> = None;
    let damaged = || broken(&"a record has the wrong size: another version wrote this log");
    for message in MessageStream::new(log).map_err(|error| broken(&error))? {
        let message = message.map_err(|error| broken(&error))?;
        match message.channel.topic.as_str() {
            TRUTH => {
                let logged: Truth = read_record(&message.data).ok_or_else(damaged)?;
                if compared.truths > 0 {
                    queue.hand_over(&mut plant, truth.time_ns);
                    if let Err(error) = plant.step() {
                        return Ok(Err(format!("at {:.4} s: {error}", truth.time_s())));
                    }
                }
                plant.truth(&mut truth);
                if let Some(difference) = differs("truth", logged.time_ns, &truth, &logged) {
                    return Ok(Err(difference));
                }
                compared.truths += 1;
            }
            STATE => {
                let logged: PlantState = read_record(&message.data).ok_or_else(damaged)?;
                if compared.states > 0 && logged.header.sequence != state.header.sequence + 1 {
                    return Err(broken(&"the log has gaps: records were dropped when it was written"));
                }
                plant.measure(&mut state);
                state.header = logged.header;
                state.status_flags |= logged.status_flags & status::FINISHED;
                if let Some(difference) = differs("state", logged.time_ns, &state, &logged) {
                    return Ok(Err(difference));
                }
                compared.states += 1;
                if let Some(controller) = &mut controller {
                    let answer = command.get_or_insert_with(|| {
                        let joints = setup.robot.joint_names.len() as u32;
                        Command::new(logged.header.run_id, setup.joint_set_hash(), joints)
                    });
                    if !logged.has_status(status::FINISHED) {
                        controller.cycle(&logged, logged.time_ns + delay_ns, answer);
                        controller.prepare();
                        address(answer, &logged);
                    }
                }
            }
            PULL => plant.pull(&read_record(&message.data).ok_or_else(damaged)?),
            COMMAND => {
                let logged: Command = read_record(&message.data).ok_or_else(damaged)?;
                if let Some(answer) = &command {
                    if let Some(difference) = differs("command", logged.state_time_ns, answer, &logged) {
                        return Ok(Err(difference));
                    }
                    compared.commands += 1;
                }
                queue.push(&logged, state.header.run_id, truth.time_ns);
            }
            _ => {}
        }
    }
    Ok(Ok(compared))
}

/// Says what differs first, if anything.
fn differs<T: bytemuck::Pod>(what: &str, time_ns: u64, ours: &T, logged: &T) -> Option<String> {
    let (ours, logged) = (bytemuck::bytes_of(ours), bytemuck::bytes_of(logged));
    let byte = ours.iter().zip(logged).position(|(a, b)| a != b)?;
    Some(format!("the {what} at {:.4} s differs from the log, first in byte {byte}", time_ns as f64 * 1e-9))
}
