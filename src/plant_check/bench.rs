//! A supervisor and a controller in one hand, with a plant at the other end.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::process::{Child, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use delmpc_controller_process::presence::{Peer, Presence};
use delmpc_messages::{Command, FallbackLevel, MAX_JOINTS, MessageError, PlantState, ProcessState, Role};
use delmpc_servo::prelude::AffineLaw;
use delmpc_transport::{
    Channel, Publisher, RunId, RunNode, SharedPublisher, SharedSubscriber, Subscriber, remove_leftovers,
};
use rustix::process::{Pid, Signal, kill_process_group};

use crate::connection::Connection;
use crate::part::message_run_id;
use crate::run_folder::RunFolder;
use crate::setup::Setup;
use crate::simulated_robot::watchdog;
use crate::verdict::Failure;

const LOOK: Duration = Duration::from_micros(200);
/// How long a command of the bench is valid, ns.
const VALID_NS: u64 = 500_000_000;

/// What stands in the plant's way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Obstacle {
    /// Nothing.
    None,
    /// The channel of commands carries another payload.
    Version,
    /// The channels are those of a robot with other joints.
    Joints,
}

/// The bench with a started plant.
pub struct Bench {
    run: RunId,
    ends: Option<Ends>,
    child: Child,
    said: Arc<Mutex<String>>,
    reader: Option<JoinHandle<()>>,
    law: AffineLaw,
    effort: f64,
    hash: u64,
    message_run_id: u64,
    joints: usize,
    cycle_ns: u64,
    sequence: u64,
    ended: Option<i32>,
}

/// All that lies in shared memory.
struct Ends {
    supervisor: Presence,
    controller: Presence,
    peer: Peer,
    states: SharedSubscriber<PlantState>,
    truths: SharedSubscriber<PlantState>,
    commands: Option<SharedPublisher<Command>>,
    beats: SharedSubscriber<delmpc_messages::Heartbeat>,
    beat: u64,
    truths_told: u64,
    /// Held for what it blocks.
    _obstacle: Option<SharedPublisher<PlantState>>,
}

impl Bench {
    /// Opens a run of its own and starts the plant.
    pub fn start(
        setup: &Setup,
        folder: &RunFolder,
        plant: &str,
        obstacle: Obstacle,
    ) -> Result<Self, Failure> {
        let run = RunId::random().map_err(Failure::fault)?;
        let connection = Connection::new(setup, run, &folder.file("scenario.toml"))?;
        let file = connection.write(folder.path())?;
        let hash = setup.joint_set_hash();
        let held = watchdog(setup)?;
        let law =
            held.law.ok_or_else(|| Failure::Input("the robot cannot be held in its posture".to_owned()))?;
        let ends = Ends::open(run, hash, obstacle)?;
        let mut child = std::process::Command::new("/bin/sh")
            .args(["-c", plant])
            .envs(connection.environment(&file))
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| Failure::Fault(format!("cannot start the plant: {error}")))?;
        let said = Arc::new(Mutex::new(String::new()));
        let reader = child.stderr.take().map(|stream| {
            let said = said.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(stream).split(b'\n').map_while(Result::ok) {
                    *said.lock().unwrap_or_else(PoisonError::into_inner) =
                        String::from_utf8_lossy(&line).into_owned();
                }
            })
        });
        Ok(Self {
            run,
            ends: Some(ends),
            child,
            said,
            reader,
            law,
            effort: setup.robot.limits.first().map_or(1.0, |limit| limit.effort.min(1e3)),
            hash,
            message_run_id: message_run_id(run, &setup.scenario),
            joints: setup.robot.joint_names.len(),
            cycle_ns: (1e9 / setup.scenario.controller.mpc_rate_hz).round() as u64,
            sequence: 0,
            ended: None,
        })
    }

    pub fn joints(&self) -> usize {
        self.joints
    }

    pub fn cycle_ns(&self) -> u64 {
        self.cycle_ns
    }

    /// A torque that every motor can give, N m.
    pub fn small_torque(&self) -> f64 {
        0.05 * self.effort
    }

    /// The line the plant said last.
    pub fn said(&self) -> String {
        self.said.lock().unwrap_or_else(PoisonError::into_inner).trim().to_owned()
    }

    pub fn validate(&self, state: &PlantState) -> Result<(), MessageError> {
        state.validate(self.hash, self.joints)?;
        state.header.validate_run::<PlantState>(self.message_run_id)
    }

    /// Looks again and again until something is found, or for so long.
    fn until<R>(
        &mut self,
        patience: Duration,
        mut look: impl FnMut(&mut Self) -> Result<Option<R>, Failure>,
    ) -> Result<Option<R>, Failure> {
        let begin = Instant::now();
        loop {
            if let Some(ends) = &mut self.ends {
                ends.attend()?;
            }
            if let Some(found) = look(self)? {
                return Ok(Some(found));
            }
            if self.ended.is_none() {
                self.ended =
                    self.child.try_wait().map_err(Failure::fault)?.map(|status| status.code().unwrap_or(-1));
            }
            if begin.elapsed() > patience || self.ended.is_some() {
                return Ok(None);
            }
            sleep(LOOK);
        }
    }

    /// Waits for so long.
    pub fn wait(&mut self, time: Duration) -> Result<(), Failure> {
        self.until(time, |_| Ok(None::<()>)).map(drop)
    }

    /// The next state, if one comes in time.
    pub fn state(&mut self, patience: Duration) -> Result<Option<PlantState>, Failure> {
        self.until(patience, |bench| match &mut bench.ends {
            Some(ends) => Ok(ends.states.receive_latest().map_err(Failure::fault)?.copied()),
            None => Ok(None),
        })
    }

    /// Truths told so far.
    pub fn truths(&mut self) -> Result<u64, Failure> {
        let Some(ends) = &mut self.ends else { return Ok(0) };
        while ends.truths.receive_next().map_err(Failure::fault)?.is_some() {
            ends.truths_told += 1;
        }
        Ok(ends.truths_told)
    }

    /// What the plant says of itself.
    pub fn peer_state(&self) -> Option<ProcessState> {
        self.ends.as_ref().and_then(|ends| ends.peer.state())
    }

    /// Signs of life so far.
    pub fn beats(&self) -> u64 {
        self.ends.as_ref().map_or(0, |ends| ends.beat)
    }

    pub fn peer_becomes(&mut self, state: ProcessState, patience: Duration) -> Result<bool, Failure> {
        let became =
            self.until(patience, |bench| Ok(bench.peer_state().filter(|is| *is as u32 >= state as u32)))?;
        Ok(became == Some(state) || became.is_some_and(|is| state == ProcessState::Ready && is as u32 > 1))
    }

    /// The supervisor's order.
    pub fn order(&mut self, state: ProcessState) -> Result<(), Failure> {
        self.ends.as_mut().map_or(Ok(()), |ends| ends.supervisor.announce(state).map_err(Failure::fault))
    }

    pub fn controller_says(&mut self, state: ProcessState) -> Result<(), Failure> {
        self.ends.as_mut().map_or(Ok(()), |ends| ends.controller.announce(state).map_err(Failure::fault))
    }

    /// A command that holds the start, in answer to a state.
    pub fn holding(&mut self, state: &PlantState) -> Command {
        let n = self.joints;
        self.sequence += 1;
        let mut command = Command::new(self.message_run_id, self.hash, n as u32);
        command.header.sequence = self.sequence;
        command.state_sequence = state.header.sequence;
        (command.state_time_ns, command.valid_from_ns) = (state.time_ns, state.time_ns);
        command.valid_until_ns = state.time_ns + VALID_NS;
        command.fallback_level = FallbackLevel::FreshSolution as u32;
        command.segments[0].torque[..n].copy_from_slice(&self.law.torque);
        command.segments[0].position_ref[..n].copy_from_slice(&self.law.position_ref);
        for (row, gain) in command.gain[..n].iter_mut().zip(self.law.gain.chunks(2 * n)) {
            row[..n].copy_from_slice(&gain[..n]);
            row[MAX_JOINTS..MAX_JOINTS + n].copy_from_slice(&gain[n..]);
        }
        command
    }

    pub fn send(&mut self, command: &Command) -> Result<(), Failure> {
        match self.ends.as_mut().and_then(|ends| ends.commands.as_mut()) {
            Some(commands) => commands.send(command).map_err(Failure::fault),
            None => Ok(()),
        }
    }

    /// Sends a command and waits for the next state.
    pub fn exchange(&mut self, command: &Command, patience: Duration) -> Result<Option<PlantState>, Failure> {
        self.send(command)?;
        self.state(patience)
    }

    /// Sends a signal to the plant and all it has started.
    pub fn signal(&self, signal: Signal) {
        if let (None, Some(pid)) = (self.ended, Pid::from_raw(self.child.id() as i32)) {
            let _ = kill_process_group(pid, signal);
        }
    }

    pub fn stop_plant(&self, stopped: bool) {
        self.signal(if stopped { Signal::STOP } else { Signal::CONT });
    }

    /// How the plant ended, if it does in time.
    pub fn ended(&mut self, patience: Duration) -> Result<Option<i32>, Failure> {
        self.until(patience, |bench| Ok(bench.ended))?;
        if let (Some(_), Some(reader)) = (self.ended, self.reader.take()) {
            // What it has started and left may still hold the line.
            self.signal_group_anyway();
            let _ = reader.join();
        }
        Ok(self.ended)
    }

    fn signal_group_anyway(&self) {
        if let Some(pid) = Pid::from_raw(self.child.id() as i32) {
            let _ = kill_process_group(pid, Signal::KILL);
        }
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        self.signal(Signal::CONT);
        self.signal(Signal::KILL);
        let _ = self.child.wait();
        self.ends = None;
        let _ = remove_leftovers(self.run);
    }
}

impl Ends {
    fn open(run: RunId, hash: u64, obstacle: Obstacle) -> Result<Self, Failure> {
        let other = if obstacle == Obstacle::Joints { hash ^ 1 } else { hash };
        let node = RunNode::open(run, other).map_err(Failure::fault)?;
        let blocks = obstacle == Obstacle::Version;
        Ok(Self {
            supervisor: Presence::new(&node, 0, Role::Supervisor).map_err(Failure::fault)?,
            controller: Presence::new(&node, other, Role::Controller).map_err(Failure::fault)?,
            peer: Peer::new(&node, Role::Plant).map_err(Failure::fault)?,
            states: node.subscriber(Channel::State).map_err(Failure::fault)?,
            truths: node.recorder(Channel::Truth).map_err(Failure::fault)?,
            commands: (!blocks)
                .then(|| node.publisher(Channel::Command))
                .transpose()
                .map_err(Failure::fault)?,
            beats: node.subscriber(Channel::Heartbeat(Role::Plant)).map_err(Failure::fault)?,
            beat: 0,
            truths_told: 0,
            _obstacle: blocks
                .then(|| node.publisher(Channel::Command))
                .transpose()
                .map_err(Failure::fault)?,
        })
    }

    fn attend(&mut self) -> Result<(), Failure> {
        self.supervisor.beat().map_err(Failure::fault)?;
        self.controller.beat().map_err(Failure::fault)?;
        self.peer.listen().map_err(Failure::fault)?;
        if let Some(beat) = self.beats.receive_latest().map_err(Failure::fault)? {
            self.beat = beat.header.sequence;
        }
        if let Some(commands) = &mut self.commands {
            commands.serve_newcomers().map_err(Failure::fault)?;
        }
        Ok(())
    }
}
