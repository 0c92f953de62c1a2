//! Starts the two processes of a run, watches them, ends them.
//!
//! | what happens | what the supervisor does |
//! |---|---|
//! | both say they are ready | lets the run begin |
//! | the plant finishes | waits for the controller, then all is well |
//! | the controller is killed, and may be restarted | starts another one, while the plant's watchdog holds the robot |
//! | a process ends too early | says so and why, ends the other one: fault |
//! | a process falls silent in real time, other than to write its log | says so, ends both: fault |
//! | Ctrl-C, SIGTERM | ends both: interrupted |
//!
//! A process is asked to end by the supervisor's heartbeat and by SIGTERM, and killed if it does not. Afterwards nothing of the run is left
//! in shared memory.

use std::fs::File;
use std::io::{BufRead, BufReader, IsTerminal, Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{JoinHandle, sleep};
use std::time::Duration;

use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::presence::{Peer, Presence};
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::{ProcessState, Role};
use delmpc_transport::{RunId, RunNode, remove_leftovers};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};

use crate::output::{self, printable};
use crate::output_file;
use crate::verdict::Failure;

/// Time between two looks at the processes.
const LOOK: Duration = Duration::from_millis(5);
/// A process may take this long to load, connect and warm up (s). Far beyond a healthy start on a busy machine.
const START_PATIENCE_S: f64 = 60.0;
/// Looking for what earlier runs have left takes no longer than this.
pub const TIDY_UP: Duration = Duration::from_secs(3);
/// Unit of the times a process had on a core, as Linux counts them for everybody (s).
const TICK_S: f64 = 0.01;
/// Silence that is none: the time between two signs of life, and some more (s).
const SILENCE_S: f64 = 0.05;
/// A process that has announced its end may take this long to write what it has (s).
const FINISH_PATIENCE_S: f64 = 300.0;
/// A process that was asked to end is killed after this (s).
const END_PATIENCE_S: f64 = 3.0;

/// The way to a plant that is steered; empty until it is started.
pub type PlantPipe = Arc<Mutex<Option<ChildStdin>>>;

/// Who plays a role.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Program {
    /// `delmpc plant`, `delmpc controller`.
    Ours,
    /// A command of somebody else's, run by the shell.
    Foreign {
        /// The command.
        command: String,
        /// What it is told in its environment.
        environment: Vec<(&'static str, String)>,
    },
}

/// One run's two processes, and how to start them.
#[derive(Debug)]
pub struct Supervision {
    /// The run.
    pub run: RunId,
    /// Our program.
    pub program: PathBuf,
    /// Who plays the plant.
    pub plant: Program,
    /// Who plays the controller.
    pub controller: Program,
    /// Arguments of each process after its role's name.
    pub arguments: Vec<String>,
    /// Where what the processes say is kept.
    pub messages: PathBuf,
    /// Whether it is shown too.
    pub show_messages: bool,
    /// Where the plant's standard input goes when somebody steers it.
    pub steering: Option<PlantPipe>,
    /// A process that is silent for this long has failed, s.
    pub hang_s: f64,
    /// In lockstep the wall clock decides nothing: a process that somebody has stopped is waited for.
    pub lockstep: bool,
    /// How often a controller that was killed is started again, within the same run.
    pub restarts: u32,
    /// A process that is started later than the other one, and by how much, s.
    pub late: Option<(Role, f64)>,
}

/// How the processes ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Course {
    /// Both did all they had to.
    Finished,
    /// Somebody wanted it to end.
    Interrupted,
    /// A process failed: why.
    Fault(String),
}

/// A run nobody else has.
///
/// # Errors
/// When the operating system has no random numbers.
pub fn fresh_run() -> Result<RunId, Failure> {
    RunId::random().map_err(Failure::fault)
}

/// The numbers by which the operating system knows the processes, and how far they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProcessIds {
    /// The plant.
    pub plant: u32,
    /// The controller.
    pub controller: u32,
    /// Whether the run has begun.
    pub running: bool,
}

/// What one process is to its supervisor.
struct Watched {
    role: Role,
    child: Child,
    peer: Peer,
    ended: Option<ExitStatus>,
    listener: Option<JoinHandle<()>>,
    /// The line it said last.
    said: Arc<Mutex<String>>,
    /// Time it had on a core when it gave its last sign of life, s.
    used_s: f64,
    /// It is a shell with a command of somebody else's.
    foreign: bool,
    /// Somebody has stopped it, and that was said.
    paused: bool,
}

/// What the operating system knows of a process.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Activity {
    /// Its state as one letter.
    state: char,
    /// Time it had on a core, s.
    used_s: f64,
}

impl Activity {
    fn of(pid: u32) -> Self {
        let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
        // Behind the name, which may hold anything.
        let fields: Vec<&str> = text.rsplit(") ").next().unwrap_or_default().split(' ').collect();
        let ticks = |index: usize| fields.get(index).and_then(|field| field.parse::<u64>().ok()).unwrap_or(0);
        let state = fields.first().and_then(|field| field.chars().next()).unwrap_or('?');
        Self { state, used_s: (ticks(11) + ticks(12)) as f64 * TICK_S }
    }

    /// Whether a silent process hangs, or is only kept from its core: then it is ready to run, or waits for a disk, and has not had much of
    /// a core since its last sign of life.
    fn hangs(&self, used_s: f64, hang_s: f64, lockstep: bool) -> bool {
        match self.state {
            // In lockstep the clock of the robot stands still with it: somebody looks at it with a debugger.
            _ if lockstep => false,
            'T' | 't' => true,
            'R' | 'D' => self.used_s - used_s > 0.5 * hang_s,
            _ => true,
        }
    }
}

impl Watched {
    /// What the process does: the one that speaks, when a shell has started it.
    fn activity(&self) -> Activity {
        Activity::of(self.peer.pid().filter(|_| self.foreign).unwrap_or_else(|| self.child.id()))
    }

    /// Says once that the run waits for a process that somebody has stopped.
    fn tell_of_a_pause(&mut self, activity: &Activity) {
        let stopped = matches!(activity.state, 'T' | 't');
        if stopped && !self.paused {
            let (name, pid) = (self.role.name(), self.child.id());
            output::say(&format!("run: the {name} process (pid {pid}) is stopped; the run waits for it"));
        }
        self.paused = stopped;
    }

    /// Sends a signal; to everybody whom a command of somebody else's has started.
    fn signal(&self, signal: Signal) {
        if let Some(pid) = Pid::from_raw(self.child.id() as i32) {
            let _ = if self.foreign { kill_process_group(pid, signal) } else { kill_process(pid, signal) };
        }
    }

    /// What a process that has ended said last, if that was why.
    fn last_words(&mut self) -> String {
        if let Some(listener) = self.listener.take() {
            let _ = listener.join();
        }
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        let why = said.strip_prefix("delmpc: ").or_else(|| self.foreign.then_some(said.as_str()));
        why.filter(|why| !why.is_empty()).map_or(String::new(), |why| format!(": {why}"))
    }
}

impl Supervision {
    /// Runs both processes to their end. `look` is called again and again while they run.
    ///
    /// # Errors
    /// [`Failure::Fault`] when the processes cannot be started or shared memory is unusable.
    pub fn supervise(&self, stop: &StopFlag, look: impl FnMut(ProcessIds)) -> Result<Course, Failure> {
        let course = self.supervise_in_shared_memory(stop, look);
        // Whatever happened, nothing stays.
        let tidied = remove_leftovers(self.run).map_err(Failure::fault);
        course.and_then(|course| tidied.map(|_| course))
    }

    fn supervise_in_shared_memory(
        &self,
        stop: &StopFlag,
        mut look: impl FnMut(ProcessIds),
    ) -> Result<Course, Failure> {
        let node = RunNode::open(self.run, 0).map_err(Failure::fault)?;
        let mut presence = Presence::new(&node, 0, Role::Supervisor).map_err(Failure::fault)?;
        let messages = output_file::create(&self.messages).map_err(Failure::fault)?;
        let messages = Arc::new(Mutex::new(messages));
        let mut processes = Vec::new();
        let mut roles = [Role::Plant, Role::Controller];
        if self.late.is_some_and(|(role, _)| role == Role::Plant) {
            roles.reverse();
        }
        for role in roles {
            if let Some((_, late_s)) = self.late.filter(|(late, _)| *late == role) {
                let until_ns = monotonic_ns() + (late_s * 1e9) as u64;
                while monotonic_ns() < until_ns && !stop.is_set() {
                    let _ = presence.beat();
                    sleep(LOOK);
                }
            }
            match self.start(&node, role, &messages) {
                Ok(process) => processes.push(process),
                Err(failure) => {
                    end_all(&mut processes, &mut presence);
                    return Err(failure);
                }
            }
        }
        processes.sort_by_key(|process| process.role as u32);
        let ids = ProcessIds {
            plant: processes[0].child.id(),
            controller: processes[1].child.id(),
            running: false,
        };
        say(&messages, &format!("run: plant process {}, controller process {}", ids.plant, ids.controller));
        let mut begin = monotonic_ns();
        let (mut running, mut restarts) = (false, self.restarts);
        let course = loop {
            if stop.is_set() {
                break Ok(Course::Interrupted);
            }
            if let Err(error) = presence.beat() {
                break Err(Failure::fault(error));
            }
            if running && restarts > 0 && is_killed(&mut processes[1]) {
                restarts -= 1;
                begin = monotonic_ns();
                match self.start(&node, Role::Controller, &messages) {
                    Ok(process) => processes[1] = process,
                    Err(failure) => break Err(failure),
                }
                say(&messages, &format!("run: controller process {} takes over", processes[1].child.id()));
            }
            match self.judge(&mut processes, begin) {
                Ok(None) => {}
                Ok(Some(course)) => break Ok(course),
                Err(failure) => break Err(failure),
            }
            let ready = |process: &Watched| process.peer.state() == Some(ProcessState::Ready);
            if processes.iter().all(ready) {
                running = true;
                if let Err(error) = presence.announce(ProcessState::Running) {
                    break Err(Failure::fault(error));
                }
            }
            look(ProcessIds { plant: ids.plant, controller: processes[1].child.id(), running });
            sleep(LOOK);
        };
        end_all(&mut processes, &mut presence);
        for process in &mut processes {
            if let Some(listener) = process.listener.take() {
                let _ = listener.join();
            }
        }
        course
    }

    fn start(&self, node: &RunNode, role: Role, messages: &Arc<Mutex<File>>) -> Result<Watched, Failure> {
        let peer = Peer::new(node, role).map_err(Failure::fault)?;
        let steering = self.steering.as_ref().filter(|_| role == Role::Plant);
        let mut child = self
            .command(role)
            .args(steering.map(|_| "--steered"))
            .stdin(if steering.is_some() { Stdio::piped() } else { Stdio::null() })
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|error| Failure::Fault(format!("cannot start the {} process: {error}", role.name())))?;
        let said = Arc::new(Mutex::new(String::new()));
        let listener = child.stderr.take().map(|stream| {
            let (messages, said, show) = (messages.clone(), said.clone(), self.show_messages);
            std::thread::Builder::new().spawn(move || pass_on(role, stream, &messages, &said, show))
        });
        let listener = match listener.transpose() {
            Ok(listener) => listener,
            Err(error) => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(Failure::Fault(format!(
                    "cannot start a thread for the {} process: {error}",
                    role.name()
                )));
            }
        };
        if let Some(pipe) = steering {
            *pipe.lock().unwrap_or_else(PoisonError::into_inner) = child.stdin.take();
        }
        let foreign = *self.program_of(role) != Program::Ours;
        Ok(Watched { role, child, peer, ended: None, listener, said, used_s: 0.0, foreign, paused: false })
    }

    fn program_of(&self, role: Role) -> &Program {
        if role == Role::Plant { &self.plant } else { &self.controller }
    }

    /// What to start for a role.
    fn command(&self, role: Role) -> Command {
        if let Program::Foreign { command, environment } = self.program_of(role) {
            let mut shell = Command::new("/bin/sh");
            shell.args(["-c", command]).envs(environment.iter().map(|(name, value)| (*name, value)));
            // So that whatever it starts ends with it; and so that Ctrl-C is for us to pass on.
            shell.process_group(0);
            return shell;
        }
        let mut command = Command::new(&self.program);
        command.arg(role.name()).args(&self.arguments);
        command.args(["--run-id", &self.run.to_string(), "--supervised"]);
        command
    }

    /// How the run stands; `None`: it goes on.
    fn judge(&self, processes: &mut [Watched], begin_ns: u64) -> Result<Option<Course>, Failure> {
        let mut finished = 0;
        for process in processes.iter_mut() {
            // The exit first: what it said before is then already there.
            if process.ended.is_none() {
                process.ended = process.child.try_wait().map_err(Failure::fault)?;
            }
            process.peer.listen().map_err(Failure::fault)?;
            let name = process.role.name();
            let pid = process.child.id();
            if let Some(status) = process.ended {
                if status.success() && process.peer.state() == Some(ProcessState::Finished) {
                    finished += 1;
                    continue;
                }
                let (how, why) = (describe(status), process.last_words());
                return Ok(Some(Course::Fault(format!("the {name} process (pid {pid}) {how}{why}"))));
            }
            let waited_s = (monotonic_ns() - begin_ns) as f64 * 1e-9;
            let silent_s = process.peer.silent_s();
            let state = process.peer.state();
            // Loading, connecting and warming up happen in one go.
            let starting = matches!(state, None | Some(ProcessState::Starting));
            if starting && waited_s > START_PATIENCE_S && !self.lockstep {
                let message =
                    format!("the {name} process (pid {pid}) did not start within {START_PATIENCE_S} s");
                return Ok(Some(Course::Fault(message)));
            }
            // Who has announced the end gives no further sign: what is left is to write the log.
            let ending = matches!(state, Some(ProcessState::Finished | ProcessState::Stopping));
            let patience_s = if ending { self.hang_s.max(FINISH_PATIENCE_S) } else { self.hang_s };
            let activity = process.activity();
            if silent_s < SILENCE_S {
                process.used_s = activity.used_s;
            }
            if self.lockstep && silent_s > self.hang_s {
                process.tell_of_a_pause(&activity);
            }
            if !starting
                && silent_s > patience_s
                && activity.hangs(process.used_s, self.hang_s, self.lockstep)
            {
                let message = format!(
                    "the {name} process (pid {pid}) hangs: no sign of life for {silent_s:.1} s (limit process.hang_s = {})",
                    self.hang_s
                );
                return Ok(Some(Course::Fault(message)));
            }
        }
        Ok((finished == processes.len()).then_some(Course::Finished))
    }
}

/// Whether a process was ended by a signal.
fn is_killed(process: &mut Watched) -> bool {
    if process.ended.is_none() {
        process.ended = process.child.try_wait().unwrap_or(None);
    }
    process.ended.is_some_and(|status| status.signal().is_some())
}

/// Asks every living process to end, and kills it if it does not.
fn end_all(processes: &mut [Watched], presence: &mut Presence) {
    // A broken link leaves the signals.
    let _ = presence.announce(ProcessState::Stopping);
    for process in processes.iter().filter(|process| process.ended.is_none()) {
        process.signal(Signal::TERM);
        process.signal(Signal::CONT); // a stopped process hears nothing
    }
    let begin = monotonic_ns();
    loop {
        for process in processes.iter_mut().filter(|process| process.ended.is_none()) {
            process.ended = process.child.try_wait().unwrap_or(None);
        }
        let patient = (monotonic_ns() - begin) as f64 * 1e-9 < END_PATIENCE_S;
        if !patient || processes.iter().all(|process| process.ended.is_some()) {
            break;
        }
        let _ = presence.beat();
        sleep(LOOK);
    }
    for process in processes.iter_mut().filter(|process| process.ended.is_none()) {
        process.signal(Signal::KILL);
        let _ = process.child.kill();
        process.ended = process.child.wait().ok();
    }
}

/// Keeps a line with what the processes say.
fn say(messages: &Mutex<File>, line: &str) {
    let mut file = messages.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = writeln!(file, "{line}");
}

/// Keeps what a process says, line by line, and shows it.
fn pass_on(role: Role, stream: impl Read, messages: &Mutex<File>, said: &Mutex<String>, show: bool) {
    for line in BufReader::new(stream).split(b'\n').map_while(Result::ok) {
        let line = String::from_utf8_lossy(&line);
        let line = printable(&line);
        *said.lock().unwrap_or_else(PoisonError::into_inner) = line.clone().into_owned();
        say(messages, &format!("{}: {line}", role.name()));
        if show {
            let mut stderr = std::io::stderr();
            let clear = if stderr.is_terminal() { "\r\x1b[K" } else { "" };
            let _ = writeln!(stderr, "{clear}{}: {line}", role.name());
        }
    }
}

fn describe(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(9), _) => "was killed (signal 9)".to_owned(),
        (Some(signal), _) => format!("ended by signal {signal}"),
        (None, Some(0)) => "ended before its work was done".to_owned(),
        (None, code) => format!("ended with exit status {}", code.unwrap_or_default()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_kept_from_its_core_does_not_hang_and_one_that_spins_sleeps_or_was_stopped_does() {
        let hangs = |state, used_s, lockstep| Activity { state, used_s }.hangs(1.0, 2.0, lockstep);
        assert!(!hangs('R', 1.5, false) && !hangs('D', 1.0, false));
        assert!(hangs('R', 2.5, false) && hangs('S', 1.0, false) && hangs('T', 1.0, false));
        assert!(!hangs('R', 9.0, true) && !hangs('S', 1.0, true) && !hangs('T', 1.0, true));
        let own = Activity::of(std::process::id());
        assert!("RSD".contains(own.state) && own.used_s >= 0.0, "{own:?}");
    }
}
