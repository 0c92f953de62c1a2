//! How long a message is on its way between two processes that both look for it without pause, beside a bare flag in shared memory.
//!
//! The peer is this program again, on the other core. It answers every message at once, and its answer says when it was sent: with one clock
//! for both, that gives the way back by itself.

use std::path::PathBuf;
use std::process::{Child, Command as Process, Stdio};
use std::sync::atomic::Ordering;
use std::thread::sleep;
use std::time::Duration;

use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::machine::prepare;
use delmpc_messages::{Command, PlantState};
use delmpc_scenario::ProcessSettings;
use delmpc_transport::{Channel, Payload, Publisher, RunId, RunNode, Subscriber, remove_leftovers};
use serde::Serialize;

use crate::supervisor::fresh_run;
use crate::timing::figures::Times;
use crate::timing::phases::Quantity;
use crate::timing::raw_flag::RawFlag;
use crate::verdict::{Ended, Failure};

/// Rounds of all measurements, one after the other, in memory of their own: where a page lies decides how far apart two cores are, and a
/// machine may change its pace meanwhile.
const ROUNDS: u32 = 5;
/// Messages exchanged before the first that counts.
const WARM_UP: u64 = 1_000;
/// The peer gives up when it has not been asked for so long (ns).
const PATIENCE_NS: u64 = 10_000_000_000;
/// Looks between two looks at the clock.
const LOOKS: u32 = 1 << 12;

/// Arguments of the peer.
#[derive(Debug, Clone, clap::Args)]
pub struct TransportPeerArguments {
    /// The run to join
    #[arg(long)]
    run_id: String,
    /// Core
    #[arg(long)]
    core: usize,
    /// Real-time priority
    #[arg(long)]
    priority: u8,
    /// How many questions will come
    #[arg(long)]
    messages: u64,
    /// What the answer is: flag, state or command
    #[arg(long)]
    answer: String,
}

/// What was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TransportReport {
    /// Round trip of a flag: the floor.
    pub flag_round_trip: Quantity,
    /// Round trip of a state answered by a state, 1000 bytes each way.
    pub state_round_trip: Quantity,
    /// One way of a state.
    pub state_one_way: Quantity,
    /// Round trip of a state answered by a command.
    pub command_round_trip: Quantity,
    /// One way of a command, 28 928 bytes.
    pub command_one_way: Quantity,
    /// Median round trip of a state over that of the flag.
    pub ratio_to_flag: Option<f64>,
}

/// How the two sides run.
#[derive(Debug, Clone)]
pub struct TransportSettings {
    /// Our core and the peer's.
    pub cores: [usize; 2],
    /// Priority and memory.
    pub process: ProcessSettings,
    /// Messages each measurement exchanges in a round.
    pub messages: u64,
}

/// Measures, on threads of its own: the calling one should have no core and no priority of its own, for the peer inherits them.
///
/// # Errors
/// When shared memory or the peer break.
pub fn measure(settings: &TransportSettings) -> Result<TransportReport, Failure> {
    let (mut flag, mut state, mut command) = (Vec::new(), Ways::default(), Ways::default());
    for _ in 0..ROUNDS {
        flag.extend(beside_a_peer(settings, "flag", |run| measure_flag(settings, run))?);
        state.add(beside_a_peer(settings, "state", |run| measure_messages::<PlantState>(settings, run))?);
        command.add(beside_a_peer(settings, "command", |run| measure_messages::<Command>(settings, run))?);
    }
    let flag = Times::of(flag);
    let [state, state_way, command, command_way] =
        [state.round_trips, state.back, command.round_trips, command.back].map(Times::of);
    let median = |times: &Times| times.at_ns(0.5).map(|ns| ns as f64);
    let ratio = median(&state).zip(median(&flag)).map(|(state, flag)| state / flag);
    Ok(TransportReport {
        flag_round_trip: Quantity::of("flag_round_trip", "flag in shared memory, round trip: floor", &flag),
        state_round_trip: Quantity::of("state_round_trip", "state and state, round trip", &state),
        state_one_way: Quantity::of("state_one_way", "state, one way", &state_way),
        command_round_trip: Quantity::of("command_round_trip", "state and command, round trip", &command),
        command_one_way: Quantity::of("command_one_way", "command, one way", &command_way),
        ratio_to_flag: ratio,
    })
}

/// Times of messages (ns).
#[derive(Debug, Default)]
struct Ways {
    round_trips: Vec<u64>,
    /// Of the answers.
    back: Vec<u64>,
}

impl Ways {
    fn add(&mut self, other: Self) {
        self.round_trips.extend(other.round_trips);
        self.back.extend(other.back);
    }
}

/// Starts a peer and does work on a thread of its own; afterwards nothing of their run is left.
fn beside_a_peer<R: Send>(
    settings: &TransportSettings,
    answer: &str,
    work: impl FnOnce(RunId) -> Result<R, Failure> + Send,
) -> Result<R, Failure> {
    let run = fresh_run()?;
    let done = std::thread::scope(|scope| {
        // Held until the work is over, and ended before the run is tidied up.
        let _peer = Peer::start(settings, run, answer)?;
        let thread = scope.spawn(|| work(run));
        thread.join().unwrap_or_else(|_| Err(Failure::Fault("the measuring thread broke down".to_owned())))
    });
    remove_leftovers(run).map_err(Failure::fault)?;
    done
}

/// Asks for core and priority; memory is not locked for a measurement of some milliseconds.
fn take_core(process: &ProcessSettings, core: usize) {
    let process = ProcessSettings { lock_memory: false, ..process.clone() };
    let _ = prepare(&process, Some(core));
}

fn measure_flag(settings: &TransportSettings, run: RunId) -> Result<Vec<u64>, Failure> {
    let flag = RawFlag::create(&flag_path(run)).map_err(Failure::fault)?;
    let mut times = Vec::with_capacity(settings.messages as usize);
    let mut watch = Patience::new();
    for number in 1..=WARM_UP + settings.messages {
        let begin_ns = monotonic_ns();
        flag.out().store(number, Ordering::Release);
        while flag.back().load(Ordering::Acquire) != number {
            if watch.is_over() {
                return Err(silent());
            }
            wait(number);
        }
        watch.renew();
        if number == 1 {
            take_core(&settings.process, settings.cores[0]);
        }
        if number > WARM_UP {
            times.push(monotonic_ns() - begin_ns);
        }
    }
    Ok(times)
}

/// A look without pause, but for the first answer: the peer is still on its way, and may need our core for it.
fn wait(number: u64) {
    if number == 1 {
        sleep(Duration::from_micros(100));
    } else {
        std::hint::spin_loop();
    }
}

fn silent() -> Failure {
    Failure::Fault("the peer of the transport measurement is silent".to_owned())
}

/// What a state is answered by.
trait Answer: Payload {
    fn blank() -> Box<Self>;
}

impl Answer for PlantState {
    fn blank() -> Box<Self> {
        Box::new(Self::new(0, 0, 0))
    }
}

impl Answer for Command {
    fn blank() -> Box<Self> {
        Box::new(Self::new(0, 0, 0))
    }
}

/// Round trips, and the ways of the answers.
fn measure_messages<A: Answer>(settings: &TransportSettings, run: RunId) -> Result<Ways, Failure> {
    let node = RunNode::open(run, 0).map_err(Failure::fault)?;
    let mut questions = node.publisher::<PlantState>(Channel::State).map_err(Failure::fault)?;
    let mut answers = node.subscriber::<A>(Channel::Command).map_err(Failure::fault)?;
    let mut state = PlantState::new(run.0, 0, 0);
    let room = settings.messages as usize;
    let mut ways = Ways { round_trips: Vec::with_capacity(room), back: Vec::with_capacity(room) };
    let mut watch = Patience::new();
    for number in 1..=WARM_UP + settings.messages {
        state.header.sequence = number;
        let begin_ns = monotonic_ns();
        questions.send(&state).map_err(Failure::fault)?;
        let answer_sent_ns = loop {
            if let Some(answer) = answers.receive_latest().map_err(Failure::fault)? {
                break answer.header().sent_at_ns;
            }
            if watch.is_over() {
                return Err(silent());
            }
            if number == 1 {
                questions.serve_newcomers().map_err(Failure::fault)?;
            }
            wait(number);
        };
        let end_ns = monotonic_ns();
        watch.renew();
        if number == 1 {
            take_core(&settings.process, settings.cores[0]);
        }
        if number > WARM_UP {
            ways.round_trips.push(end_ns - begin_ns);
            ways.back.push(end_ns.saturating_sub(answer_sent_ns));
        }
    }
    Ok(ways)
}

/// The peer's side.
///
/// # Errors
/// When it cannot join, or is left alone.
pub fn transport_peer(arguments: &TransportPeerArguments) -> Result<Ended, Failure> {
    let run: RunId = arguments.run_id.parse().map_err(Failure::input)?;
    let settings =
        ProcessSettings { priority: arguments.priority, lock_memory: false, ..ProcessSettings::default() };
    // Connecting is not what is measured, and takes helpers that should not be ours to delay.
    match arguments.answer.as_str() {
        "flag" => {
            let flag = opened(run)?;
            take_core(&settings, arguments.core);
            let mut watch = Patience::new();
            let answered = flag.echo(WARM_UP + arguments.messages, || watch.is_over());
            if answered { Ok(Ended::Well) } else { Err(alone()) }
        }
        "state" => answer_messages::<PlantState>(run, &settings, arguments),
        "command" => answer_messages::<Command>(run, &settings, arguments),
        other => Err(Failure::Input(format!("--answer {other}: must be flag, state or command"))),
    }
}

fn answer_messages<A: Answer>(
    run: RunId,
    settings: &ProcessSettings,
    arguments: &TransportPeerArguments,
) -> Result<Ended, Failure> {
    let node = RunNode::open(run, 0).map_err(Failure::fault)?;
    let mut answers = node.publisher::<A>(Channel::Command).map_err(Failure::fault)?;
    let mut questions = node.subscriber::<PlantState>(Channel::State).map_err(Failure::fault)?;
    take_core(settings, arguments.core);
    let mut answer = A::blank();
    let mut watch = Patience::new();
    loop {
        let Some(question) = questions.receive_latest().map_err(Failure::fault)? else {
            if watch.is_over() {
                return Err(alone());
            }
            continue;
        };
        let sequence = question.header.sequence;
        answer.header_mut().sequence = sequence;
        answer.header_mut().sent_at_ns = monotonic_ns();
        answers.send(&answer).map_err(Failure::fault)?;
        watch.renew();
        if sequence == WARM_UP + arguments.messages {
            return Ok(Ended::Well);
        }
    }
}

/// The flag, when the other side has made it.
fn opened(run: RunId) -> Result<RawFlag, Failure> {
    for _ in 0..500 {
        if let Ok(flag) = RawFlag::open(&flag_path(run)) {
            return Ok(flag);
        }
        sleep(Duration::from_millis(1));
    }
    RawFlag::open(&flag_path(run)).map_err(Failure::fault)
}

fn alone() -> Failure {
    Failure::Fault("nobody asks any more".to_owned())
}

/// Bounds the time without an answer; looks at the clock now and then only.
struct Patience {
    looks: u32,
    since_ns: u64,
}

impl Patience {
    fn new() -> Self {
        Self { looks: 0, since_ns: monotonic_ns() }
    }

    fn renew(&mut self) {
        self.looks = 0;
        self.since_ns = 0;
    }

    fn is_over(&mut self) -> bool {
        self.looks += 1;
        if !self.looks.is_multiple_of(LOOKS) {
            return false;
        }
        let now_ns = monotonic_ns();
        if self.since_ns == 0 {
            self.since_ns = now_ns;
        }
        now_ns > self.since_ns + PATIENCE_NS
    }
}

/// Where the flag of a run is; its name is one of the run's, so that it is removed with the run should all be killed.
fn flag_path(run: RunId) -> PathBuf {
    PathBuf::from("/dev/shm").join(format!("delmpc_{run}_flag"))
}

/// The other process; killed at the latest when it goes out of scope.
struct Peer(Child);

impl Peer {
    fn start(settings: &TransportSettings, run: RunId, answer: &str) -> Result<Self, Failure> {
        let program = std::env::current_exe().map_err(Failure::fault)?;
        let child = Process::new(program)
            .args(["transport-peer", "--run-id", &run.to_string(), "--answer", answer])
            .args(["--core", &settings.cores[1].to_string()])
            .args(["--priority", &settings.process.priority.to_string()])
            .args(["--messages", &settings.messages.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|error| Failure::Fault(format!("cannot start the peer process: {error}")))?;
        Ok(Self(child))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It ends by itself after the last answer; a moment for that.
        for _ in 0..100 {
            if matches!(self.0.try_wait(), Ok(Some(_))) {
                return;
            }
            sleep(Duration::from_millis(5));
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
