//! `delmpc replay`: a run again from its log, compared bit by bit.
//!
//! The records of the log are in the order in which things happened. The plant is made anew and given every logged command where it came;
//! each state and truth must come out as logged. In lockstep the controller is given every logged state, and each command must come out as
//! logged; in real time its answers depend on the wall clock, and are only taken from the log.
//!
//! | what is wrong with the log | what is said |
//! |---|---|
//! | it ends in the middle: a killed process, a full disk | to when it is whole; that much is compared |
//! | records are missing: the writer could not keep up | where the hole is; what is before it is compared |
//! | it is of another scenario or robot than the folder | which line or file is another one; nothing is compared |

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use delmpc_controller_process::controller_loop::{Controller, address};
use delmpc_messages::{Command, PlantState, status};
use delmpc_scenario::Clock;

use crate::faults::{FaultyController, FaultyPlant};
use crate::log::{COMMAND, PULL, STATE, TRUTH, read_command, read_record};
use crate::log_command;
use crate::log_reader::{End, Item, LogReader};
use crate::output::{line, printable};
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

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a folder without a log, or with that of another configuration.
pub fn replay(arguments: &ReplayArguments) -> Result<Ended, Failure> {
    let folder = &arguments.run;
    let setup = Setup::read(&folder.join("scenario.toml"), &[])?;
    let file = folder.join("log.mcap");
    let mut log = LogReader::open(&file)?;
    let mut replay = Replay::new(&setup, &file)?;
    let end = log.each(|item| replay.take(item))?;
    if replay.counts.truths == 0 {
        let why = match end {
            Some(End::Cut(why)) => format!("the log is cut before its first step: {why}"),
            _ => "the log holds no motion".to_owned(),
        };
        return Err(Failure::Input(format!("{}: {why}", file.display())));
    }
    if let Some(difference) = replay.difference {
        line(printable(&format!("{difference}{}", replay.writer)))?;
        return Ok(Ended::CriterionMissed);
    }
    let Counts { states, truths, commands } = replay.counts;
    line(format!("the same bits: {truths} steps, {states} states, {commands} commands"))?;
    if replay.foreign {
        line("the plant was not ours: its states were taken from the log, not computed again")?;
    }
    let until_s = replay.truth.time_s();
    if let Some(hole) = replay.hole {
        line(format!("compared up to {until_s:.4} s: {hole}"))?;
    } else if let Some(End::Cut(why)) = end {
        let duration_s = setup.scenario.duration_s;
        line(format!(
            "compared up to {until_s:.4} s of {duration_s} s: the log is cut there: {}",
            printable(&why)
        ))?;
    }
    if setup.scenario.clock == Clock::Realtime {
        line("commands of a real-time run were taken from the log, not computed again")?;
    }
    Ok(Ended::Well)
}

/// What was compared.
#[derive(Debug, Default)]
struct Counts {
    states: u64,
    truths: u64,
    commands: u64,
}

/// A run that happens again.
struct Replay<'a> {
    setup: &'a Setup,
    file: &'a Path,
    plant: FaultyPlant<SimulatedRobot>,
    /// In lockstep.
    controller: Option<FaultyController<RobotController>>,
    delay_ns: u64,
    queue: CommandQueue,
    state: PlantState,
    truth: Truth,
    /// The controller's answer to the last state.
    command: Option<Command>,
    packed: [Vec<u8>; 2],
    /// The log said what it is about.
    introduced: bool,
    /// The plant was not ours: what it did is taken from the log.
    foreign: bool,
    /// Who wrote the log, if it was not us.
    writer: String,
    counts: Counts,
    hole: Option<String>,
    difference: Option<String>,
    /// After a difference: no later command, no later pull has been seen yet.
    cause_unknown: [bool; 2],
}

impl<'a> Replay<'a> {
    fn new(setup: &'a Setup, file: &'a Path) -> Result<Self, Failure> {
        let scenario = &setup.scenario;
        let controller = match scenario.clock {
            Clock::Lockstep => Some(FaultyController::new(RobotController::new(setup)?, scenario)),
            Clock::Realtime => None,
        };
        Ok(Self {
            setup,
            file,
            plant: FaultyPlant::new(SimulatedRobot::new(setup)?, scenario),
            controller,
            delay_ns: (scenario.sensors.delay_s * 1e9).round() as u64,
            queue: CommandQueue::new(scenario),
            state: PlantState::new(0, 0, 0),
            truth: Truth::new(setup.robot.joint_names.len() as u32),
            command: None,
            packed: Default::default(),
            introduced: false,
            foreign: false,
            writer: String::new(),
            counts: Counts::default(),
            hole: None,
            difference: None,
            cause_unknown: [true; 2],
        })
    }

    fn broken(&self, error: impl std::fmt::Display) -> Failure {
        Failure::Input(format!("{}: {error}", self.file.display()))
    }

    /// Takes in the next item of the log; `false`: nothing after it can be compared.
    fn take(&mut self, item: Item<'_>) -> Result<bool, Failure> {
        match item {
            Item::About(about) => {
                if !self.introduced {
                    self.introduce(&about)?;
                }
                Ok(true)
            }
            Item::Message { topic, time_ns, missing, data } => {
                if ![TRUTH, STATE, PULL, COMMAND].contains(&topic) {
                    return Ok(true);
                }
                if !self.introduced {
                    return Err(self.broken("it does not say which run it is of: it is no log of delmpc"));
                }
                if self.difference.is_some() {
                    return Ok(self.look_for_the_cause(topic, time_ns, missing));
                }
                if missing > 0 {
                    return Ok(self.stop_at_hole(topic, time_ns, missing));
                }
                // Every step is logged before what is sent and received at its end.
                let step_ns = (self.setup.scenario.plant.step_s * 1e9).round() as u64;
                let steps = time_ns.saturating_sub(self.truth.time_ns) / step_ns.max(1);
                if topic != TRUTH && self.counts.truths > 0 && steps > 0 {
                    return Ok(self.stop_at_hole(TRUTH, time_ns, steps as u32));
                }
                let damaged = || self.broken("a record has the wrong size: another version wrote this log");
                match topic {
                    TRUTH => {
                        let logged = read_record(data).ok_or_else(damaged)?;
                        self.step(&logged);
                    }
                    STATE => {
                        let logged = read_record(data).ok_or_else(damaged)?;
                        self.measure(&logged);
                    }
                    PULL => {
                        let pull = read_record(data).ok_or_else(damaged)?;
                        self.plant.pull(&pull);
                    }
                    _ => {
                        let logged = read_command(data).ok_or_else(damaged)?;
                        // In lockstep it answers the last state; one that is not there was not given to the controller.
                        let missing = logged.state_sequence.saturating_sub(self.state.header.sequence);
                        if self.controller.is_some() && missing > 0 {
                            let missing = u32::try_from(missing).unwrap_or(u32::MAX);
                            return Ok(self.stop_at_hole(STATE, time_ns, missing));
                        }
                        self.answer(&logged);
                    }
                }
                Ok(true)
            }
        }
    }

    fn stop_at_hole(&mut self, topic: &str, time_ns: u64, missing: u32) -> bool {
        let time_s = time_ns as f64 * 1e-9;
        self.hole = Some(format!(
            "the log has a hole before {time_s:.4} s: {missing} records of {topic} are missing"
        ));
        false
    }

    /// A command or a pull that is missing shows in what the robot does before it shows in the numbers of its channel: a difference is
    /// none of ours when the next record of either tells of a hole.
    fn look_for_the_cause(&mut self, topic: &str, time_ns: u64, missing: u32) -> bool {
        let unknown = match topic {
            COMMAND => &mut self.cause_unknown[0],
            PULL => &mut self.cause_unknown[1],
            _ => return true,
        };
        if std::mem::take(unknown) && missing > 0 {
            self.difference = None;
            return self.stop_at_hole(topic, time_ns, missing);
        }
        self.cause_unknown.contains(&true)
    }

    /// Is this log one of the scenario and the robot in the folder?
    fn introduce(&mut self, about: &BTreeMap<String, String>) -> Result<(), Failure> {
        let ours = crate::plant::about(self.setup, None);
        let get = |of: &BTreeMap<String, String>, key: &str| of.get(key).cloned().unwrap_or_default();
        if !about.contains_key("configuration") {
            return Err(self.broken("it does not say which run it is of: it is no log of delmpc"));
        }
        let (theirs, configuration) = (get(about, "configuration"), get(&ours, "configuration"));
        if theirs != configuration {
            let place = first_difference(&theirs, &configuration);
            return Err(self.broken(format!("the log is of another scenario than scenario.toml: {place}")));
        }
        if get(about, "joint_set_hash") != get(&ours, "joint_set_hash") {
            return Err(self.broken("the log is of a robot with other joints than robot.urdf"));
        }
        if get(about, "model_hash") != get(&ours, "model_hash") {
            return Err(
                self.broken("the log is of another robot.urdf or robot.toml: attached to it are its own")
            );
        }
        let version = |of: &BTreeMap<String, String>| {
            format!("{}, revision {}", get(of, "program"), get(of, "git_revision"))
        };
        if version(about) != version(&ours) {
            self.writer = format!("\nthe log was written by {}; this is {}", version(about), version(&ours));
        }
        self.foreign = about.contains_key("plant_command");
        self.introduced = true;
        Ok(())
    }

    fn step(&mut self, logged: &Truth) {
        if self.foreign {
            self.truth = *logged;
            self.counts.truths += 1;
            return;
        }
        if self.counts.truths > 0 {
            self.queue.hand_over(&mut self.plant, self.truth.time_ns);
            if let Err(error) = self.plant.step() {
                self.difference = Some(format!("at {:.4} s: {error}", self.truth.time_s()));
                return;
            }
        }
        self.plant.truth(&mut self.truth);
        self.difference =
            differs("truth", logged.time_ns, bytemuck::bytes_of(&self.truth), bytemuck::bytes_of(logged));
        self.counts.truths += 1;
    }

    fn measure(&mut self, logged: &PlantState) {
        if self.foreign {
            self.state = *logged;
        } else {
            self.plant.measure(&mut self.state);
            self.state.header = logged.header;
            self.state.status_flags |= logged.status_flags & status::FINISHED;
        }
        self.difference =
            differs("state", logged.time_ns, bytemuck::bytes_of(&self.state), bytemuck::bytes_of(logged));
        self.counts.states += 1;
        if let Some(controller) = &mut self.controller
            && !logged.has_status(status::FINISHED)
        {
            let setup = self.setup;
            let answer = self.command.get_or_insert_with(|| {
                let joints = setup.robot.joint_names.len() as u32;
                Command::new(logged.header.run_id, setup.joint_set_hash(), joints)
            });
            controller.cycle(logged, logged.time_ns.saturating_add(self.delay_ns), answer);
            controller.prepare();
            address(answer, logged);
        }
    }

    fn answer(&mut self, logged: &Command) {
        if let Some(answer) = &self.command {
            for (packed, command) in self.packed.iter_mut().zip([answer, logged]) {
                packed.clear();
                log_command::pack(command, packed);
            }
            self.difference = differs("command", logged.state_time_ns, &self.packed[0], &self.packed[1]);
            self.counts.commands += 1;
        }
        self.queue.push(logged, self.state.header.run_id, self.truth.time_ns);
    }
}

/// The first line in which two texts differ.
fn first_difference(log: &str, folder: &str) -> String {
    let (mut theirs, mut ours) = (log.lines(), folder.lines());
    loop {
        match (theirs.next(), ours.next()) {
            (None, None) => return "other line ends".to_owned(),
            (a, b) if a == b => {}
            (a, b) => {
                let quoted = |line: Option<&str>| {
                    line.map_or("nothing".to_owned(), |line| format!("`{}`", line.escape_debug()))
                };
                return format!("the log has {}, the file {}", quoted(a), quoted(b));
            }
        }
    }
}

/// Says what differs first, if anything.
fn differs(what: &str, time_ns: u64, ours: &[u8], logged: &[u8]) -> Option<String> {
    if ours == logged {
        return None;
    }
    let byte = ours.iter().zip(logged).position(|(a, b)| a != b).unwrap_or(ours.len().min(logged.len()));
    Some(format!("the {what} at {:.4} s differs from the log, first in byte {byte}", time_ns as f64 * 1e-9))
}
