//! A plant that is not ours: another simulator, a robot. It talks the messages; log, figures and verdict are made here.
//!
//! A thread of the supervisor listens: to the truth, which the plant tells after every step without noise, to its states and to the commands.
//! A plant that tells no truth is judged by its states. What a plant has to do is in `shared/messages/WIRE.md`.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{JoinHandle, sleep};
use std::time::Duration;

use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::durations::Durations;
use delmpc_messages::{Command, PlantState, sensor};
use delmpc_scenario::Clock;
use delmpc_transport::{Channel, Payload, RunId, RunNode, SharedSubscriber};

use crate::foreign_truth::ForeignTruth;
use crate::log::{Log, LogHead};
use crate::log_viewer::LogViewer;
use crate::metrics::{Metrics, RobotFigures};
use crate::output::say;
use crate::part::{leave_part, message_run_id};
use crate::run_folder::PLANT_PART;
use crate::setup::Setup;
use crate::summary::PlantPart;
use crate::truth::Truth;
use crate::verdict::Failure;

/// Sleep while there is nothing to hear: short against the time between two messages of a channel.
const PAUSE: Duration = Duration::from_micros(50);
/// States whose sending times are remembered, for the ages of their answers.
const REMEMBERED: usize = 64;

/// What became of the listening.
pub type Outcome = Arc<Mutex<Result<(), String>>>;

/// Listens to a run whose plant is somebody else's, until it is dropped: then log and figures are in the run's folder.
#[derive(Debug)]
pub struct Listener {
    thread: Option<JoinHandle<Result<(), String>>>,
    stop: Arc<AtomicBool>,
    outcome: Outcome,
}

impl Listener {
    /// Begins to listen: when this returns, nothing the plant says will be missed.
    ///
    /// # Errors
    /// [`Failure::Fault`] when shared memory or the log's file cannot be had.
    pub fn begin(setup: &Setup, run: RunId, command: &str, folder: &Path) -> Result<Self, Failure> {
        let stop = Arc::new(AtomicBool::new(false));
        let (ready, is_ready) = channel();
        let (setup, command, folder) = (setup.clone(), command.to_owned(), folder.to_owned());
        let stopped = stop.clone();
        let thread = std::thread::Builder::new()
            .name("judge".to_owned())
            .spawn(move || {
                let mut ear = match Ear::new(&setup, run, &command, folder) {
                    Ok(ear) => ear,
                    Err(failure) => return Err(failure.to_string()),
                };
                let _ = ready.send(());
                ear.listen(&stopped).and_then(|()| ear.leave()).map_err(|failure| failure.to_string())
            })
            .map_err(Failure::fault)?;
        let listener = Self { thread: Some(thread), stop, outcome: Arc::new(Mutex::new(Ok(()))) };
        let outcome = listener.outcome();
        match is_ready.recv() {
            Ok(()) => Ok(listener),
            Err(_) => {
                drop(listener);
                let said = outcome.lock().unwrap_or_else(PoisonError::into_inner).clone();
                Err(Failure::Fault(said.err().unwrap_or_else(|| "nobody listens to the plant".to_owned())))
            }
        }
    }

    /// Where it is told how the listening went, once it is over.
    pub fn outcome(&self) -> Outcome {
        self.outcome.clone()
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let ended = thread.join().unwrap_or_else(|_| Err("who judges the run broke down".to_owned()));
            *self.outcome.lock().unwrap_or_else(PoisonError::into_inner) = ended;
        }
    }
}

/// The oldest message of each kind that was heard and not taken yet.
#[derive(Default)]
struct Heard {
    truth: Option<PlantState>,
    state: Option<PlantState>,
    command: Option<Command>,
}

fn hear<T: Payload>(held: &mut Option<T>, from: &mut SharedSubscriber<T>) -> Result<(), Failure> {
    if held.is_none() {
        *held = from.receive_next().map_err(Failure::fault)?.copied();
    }
    Ok(())
}

/// What is heard, and what is made of it.
struct Ear {
    heard: Heard,
    truths: SharedSubscriber<PlantState>,
    states: SharedSubscriber<PlantState>,
    commands: SharedSubscriber<Command>,
    maker: ForeignTruth,
    metrics: Metrics,
    log: Log,
    truth: Box<Truth>,
    folder: PathBuf,
    joint_set_hash: u64,
    joints: usize,
    run_id: u64,
    realtime: bool,
    step_ns: u64,
    /// From a measurement to its sending.
    delay_ns: u64,
    /// The plant tells the truth beside its states.
    tells_truth: bool,
    any: bool,
    sent: [(u64, u64); REMEMBERED],
    ages: Durations,
    /// Sequence of the last truth, state, command, and how many of each were missed.
    last: [u64; 3],
    missed: [u64; 3],
    refused: u64,
    watchdog_level_max: u32,
    /// Wall clock of the first step after the start and of the last one.
    wall_ns: Option<(u64, u64, u64)>,
    saw_fall: bool,
    complained: bool,
}

impl Ear {
    fn new(setup: &Setup, run: RunId, command: &str, folder: PathBuf) -> Result<Self, Failure> {
        let scenario = &setup.scenario;
        let node = RunNode::open(run, setup.joint_set_hash()).map_err(Failure::fault)?;
        let joints = setup.robot.joint_names.len();
        let mut about = crate::plant::about(setup, Some(run));
        about.insert("plant_command".to_owned(), command.to_owned());
        about.remove("plant_pid");
        let files = crate::plant::log_head(setup, run).files;
        let head = LogHead { about, files, viewer: Some(LogViewer::new(setup)) };
        let lockstep = scenario.clock == Clock::Lockstep;
        Ok(Self {
            heard: Heard::default(),
            truths: node.recorder(Channel::Truth).map_err(Failure::fault)?,
            states: node.recorder(Channel::State).map_err(Failure::fault)?,
            commands: node.recorder(Channel::Command).map_err(Failure::fault)?,
            step_ns: ((scenario.plant.step_s * 1e9).round() as u64).max(1),
            delay_ns: (scenario.sensors.delay_s * 1e9).round() as u64,
            maker: ForeignTruth::new(setup)?,
            metrics: Metrics::judged_for(setup)?,
            log: Log::create(&folder.join("log.mcap"), head, lockstep, !lockstep)?,
            truth: Box::new(Truth::new(joints as u32)),
            folder,
            joint_set_hash: setup.joint_set_hash(),
            joints,
            run_id: message_run_id(run, scenario),
            realtime: !lockstep,
            tells_truth: false,
            any: false,
            sent: [(0, 0); REMEMBERED],
            ages: Durations::new(),
            last: [0; 3],
            missed: [0; 3],
            refused: 0,
            watchdog_level_max: 0,
            wall_ns: None,
            saw_fall: false,
            complained: false,
        })
    }

    /// Hears and keeps everything in the order in which it happened: the truth of a step, the state that was sent at its end, its answer.
    fn listen(&mut self, stop: &AtomicBool) -> Result<(), Failure> {
        loop {
            // Asked first: what was sent before is then heard below.
            let last = stop.load(Ordering::Acquire);
            if !self.take_next()? {
                if last {
                    return Ok(());
                }
                sleep(PAUSE);
            }
        }
    }

    /// Takes what happened first of all that was heard; `false`: there is nothing.
    fn take_next(&mut self) -> Result<bool, Failure> {
        // In this order: what was sent before a truth is heard when the truth is.
        let Heard { truth, state, command } = &mut self.heard;
        hear(truth, &mut self.truths)?;
        hear(state, &mut self.states)?;
        hear(command, &mut self.commands)?;
        let [_, state_sequence, _] = self.last;
        if let Some(command) = command.take_if(|command| command.state_sequence <= state_sequence) {
            self.take_command(&command);
            return Ok(true);
        }
        let until_ns = state.as_ref().map_or(u64::MAX, |state| state.time_ns.saturating_add(self.delay_ns));
        if let Some(truth) = truth.take_if(|truth| truth.time_ns <= until_ns) {
            self.tells_truth = true;
            self.take_truth(&truth);
        } else if let Some(state) = state.take() {
            self.take_state(&state);
        } else {
            return Ok(false);
        }
        Ok(true)
    }

    fn take_truth(&mut self, told: &PlantState) {
        let valid = told
            .validate(self.joint_set_hash, self.joints)
            .and_then(|()| told.header.validate_run::<PlantState>(self.run_id));
        if let Err(error) = valid {
            self.refused += 1;
            if !std::mem::replace(&mut self.complained, true) {
                say(&format!("warning: the plant's truth is refused, and told so once: {error}"));
            }
            return;
        }
        let now_ns = monotonic_ns();
        if self.any && told.time_ns <= self.truth.time_ns {
            return; // told twice
        }
        self.count(0, told.header.sequence);
        self.wall_ns = match self.wall_ns {
            None if self.any => Some((now_ns, told.time_ns, now_ns)),
            Some((first_ns, time_ns, _)) => Some((first_ns, time_ns, now_ns)),
            None => None,
        };
        let begun = std::mem::replace(&mut self.any, true);
        self.maker.observe(told, self.tells_truth, &mut self.truth);
        self.metrics.observe(&self.truth);
        self.log.truth(&self.truth);
        if begun {
            // Before the first command somebody has to hold the start.
            self.watchdog_level_max = self.watchdog_level_max.max(self.truth.watchdog_level);
        }
        if let (false, Some(cause)) = (self.saw_fall, self.maker.fall_cause()) {
            self.saw_fall = true;
            self.metrics.set_fall_cause(Some(cause.to_owned()));
        }
    }

    fn take_state(&mut self, state: &PlantState) {
        if !self.tells_truth {
            let told = PlantState { sensors: state.sensors | known_base(state), ..*state };
            self.take_truth(&told);
        }
        self.count(1, state.header.sequence);
        let sequence = state.header.sequence;
        self.sent[sequence as usize % REMEMBERED] = (sequence, state.header.sent_at_ns);
        self.log.state(self.truth.time_ns, state);
    }

    fn take_command(&mut self, command: &Command) {
        self.log.command(self.truth.time_ns, command);
        self.metrics.observe_estimate(command);
        let answers = command.state_sequence;
        let (of, sent_ns) = self.sent[answers as usize % REMEMBERED];
        if self.realtime && answers > 1 && of == answers {
            self.ages.add(monotonic_ns().saturating_sub(sent_ns));
        }
        self.count(2, command.header.sequence);
    }

    /// Counts what lies between two messages of a channel that were heard.
    fn count(&mut self, channel: usize, sequence: u64) {
        let last = std::mem::replace(&mut self.last[channel], sequence);
        if last > 0 && sequence > last + 1 {
            self.missed[channel] += sequence - last - 1;
        }
    }

    fn leave(&mut self) -> Result<(), Failure> {
        let dropped = std::mem::replace(&mut self.log, Log::none()).finish()?;
        let missed: u64 = self.missed.iter().sum();
        if missed > 0 {
            let [truths, states, commands] = self.missed;
            say(&format!(
                "warning: {truths} truths, {states} states and {commands} commands were not heard: the machine gave who judges no time"
            ));
        }
        if !self.any {
            return Ok(()); // no plant ever spoke: there are no figures
        }
        let simulated_s = |from_ns: u64| self.truth.time_ns.saturating_sub(from_ns) as f64 * 1e-9;
        let factor = self.wall_ns.filter(|(first, _, last)| self.realtime && last > first);
        // A plant that tells only its states tells of every cycle, not of every step.
        let steps = self.truth.time_ns / self.step_ns;
        let part = PlantPart {
            robot: RobotFigures { steps, ..self.metrics.figures() },
            state_to_command_age_p50_s: self.ages.percentile_s(0.5),
            state_to_command_age_p999_s: self.ages.percentile_s(0.999),
            plant_step_p50_s: None,
            plant_real_time_factor: factor
                .map(|(first, time_ns, last)| simulated_s(time_ns) / ((last - first) as f64 * 1e-9)),
            plant_pauses: None,
            log_records_dropped: dropped + missed,
            commands_refused: self.refused,
            watchdog_level_max: self.watchdog_level_max,
        };
        leave_part(Some(&self.folder), PLANT_PART, &part)
    }
}

/// The base is told when its orientation is one.
fn known_base(state: &PlantState) -> u32 {
    let is_unit = (state.base_orientation_w.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-6;
    let is_placed = state.base_position_w != [0.0; 3];
    if is_unit && is_placed { sensor::MOTION_CAPTURE } else { 0 }
}
