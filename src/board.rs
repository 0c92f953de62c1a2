//! A board in the place of the controller: the real plant on this machine, control cycle and servo on a processor at the other end of a
//! socket, and the same task on this side to hold every answer against.
//!
//! ```text
//! delmpc plant -- PlantState --> this process -- readings --> board: servo every step, cycle every period
//!             <-- Command, one torque --       <-- answer --
//! ```
//!
//! The board's servo is what drives the robot: the command that goes to the plant carries its torque and no gain, and lasts a few steps.
//! So plant and line have a command for every plant step and no delay of their own: `--set controller.mpc_rate_hz=1000 --set
//! controller.delay_cycles=0` for a plant step of a millisecond. The board's constants, and those of its twin here, are the scenario
//! file's without any `--set`: `delmpc model ROBOT.urdf --emit rust --scenario FILE` wrote them.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use delmpc_controller_core::control_task::ControlTask;
use delmpc_controller_core::cycle::StoppedClock;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_messages::{Command, FallbackLevel, MAX_JOINTS, PlantState, Verdict};
use delmpc_scenario::Clock;
use delmpc_servo::wire::{
    Answer, BoardFigures, FRAME_CAPACITY, FrameKind, Receiver, read_answer, write_readings,
};
use serde::Serialize;

use crate::board_robot::BoardRobot;
use crate::output::{printable, say};
use crate::part::leave_part;
use crate::setup::Setup;
use crate::verdict::{Ended, Failure};

/// Longest time to the first answer of a board, and to every other, s: an emulated one is slow.
const PATIENCE: Duration = Duration::from_secs(60);
/// How long a torque lasts when no other comes, in steps of the plant.
const LIFE_STEPS: f64 = 4.0;
/// Largest difference between an answer of the board and the library's, relative where the number is larger than 1.
pub const LARGEST_DIFFERENCE: f64 = 1e-9;
/// Most characters kept of what a board says.
const MOST_SAID: usize = 4000;
/// What is left in the run's folder.
pub const BOARD_PART: &str = "board.json";

/// What a run with a board showed.
#[derive(Debug, Clone, Default, Serialize)]
pub struct BoardSummary {
    /// Answers, each to the readings of a plant step.
    pub answers: u64,
    /// Control cycles among them.
    pub cycles: u64,
    /// Largest difference of a torque from that of this machine's task, N m.
    pub torque_difference_max: f64,
    /// The same of a feed-forward torque or a gain of a command, relative where it is larger than 1.
    pub command_difference_max: f64,
    /// Memory requests on the board after its start.
    pub allocations: u32,
    /// Most stack used on the board, bytes.
    pub stack_bytes: u32,
    /// Heap of the board, bytes.
    pub heap_bytes: u32,
    /// Most iterations of the board's QP in a cycle.
    pub qp_iterations_max: u32,
    /// Most active rows in a cycle.
    pub active_rows_max: u32,
    /// Cycles with active rows.
    pub constrained_cycles: u64,
    /// Worst level of the board's servo.
    pub fallback_level_max: u32,
}

/// A controller that asks a board.
#[derive(Debug)]
pub struct BoardController {
    line: TcpStream,
    receiver: Box<Receiver>,
    frame: Box<[u8; FRAME_CAPACITY]>,
    twin: ControlTask,
    life_ns: u64,
    summary: BoardSummary,
    /// What it says beside its frames: words, at the start and when it stops.
    said: String,
    /// What broke, first.
    broken: Option<String>,
}

impl BoardController {
    /// Reaches the board at an address, and makes its twin as the scenario `file` has it.
    ///
    /// # Errors
    /// [`Failure::Input`] for a scenario no board can be run in, [`Failure::Fault`] when nobody listens there.
    pub fn connect(setup: &Setup, file: &Path, address: &str) -> Result<Self, Failure> {
        let scenario = &setup.scenario;
        if scenario.clock != Clock::Lockstep
            || scenario.steps_per_cycle() != 1
            || scenario.controller.delay_cycles != 0
        {
            return Err(Failure::Input(format!(
                "{}: --board needs clock = \"lockstep\", controller.mpc_rate_hz = 1 / plant.step_s and controller.delay_cycles = 0",
                scenario.name
            )));
        }
        let twin = BoardRobot::new(&Setup::read(file, &[])?)?.task()?;
        let line = reach(address)?;
        let ready = line.set_nodelay(true).and_then(|()| line.set_read_timeout(Some(PATIENCE)));
        ready.map_err(|error| Failure::Fault(format!("--board {address}: {error}")))?;
        Ok(Self {
            line,
            receiver: Box::default(),
            frame: Box::new([0; FRAME_CAPACITY]),
            twin,
            life_ns: (LIFE_STEPS * scenario.plant.step_s * 1e9).round() as u64,
            summary: BoardSummary::default(),
            said: String::new(),
            broken: None,
        })
    }

    fn ask(&mut self, state: &PlantState) -> Result<Answer, String> {
        let in_words = |error: std::io::Error| format!("the line to the board broke: {error}");
        let length =
            write_readings(state, &mut self.frame[..]).ok_or("the readings do not fit into a frame")?;
        self.line.write_all(&self.frame[..length]).map_err(in_words)?;
        let mut bytes = [0; 4096];
        loop {
            let wanted = self.receiver.missing().min(bytes.len());
            let count = self.line.read(&mut bytes[..wanted]).map_err(in_words)?;
            if count == 0 {
                return Err(format!("the board hung up; it said: {}", printable(&self.said)));
            }
            for byte in &bytes[..count] {
                if let Some((FrameKind::Answer, payload)) = self.receiver.take(*byte) {
                    let answer = read_answer(payload).ok_or("the board sent an answer that is cut")?;
                    if answer.sequence == state.header.sequence {
                        return Ok(answer);
                    }
                } else if self.receiver.is_idle() && self.said.len() < MOST_SAID {
                    self.said.push(char::from(*byte));
                }
            }
        }
    }

    /// Holds an answer against what this machine's task gives for the same readings.
    fn compare(&mut self, state: &PlantState, answer: &Answer) {
        let expected = self.twin.tick(state, &StoppedClock);
        let n = expected.len();
        let apart = |a: &[f64], b: &[f64]| {
            a.iter().zip(b).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs() / b.abs().max(1.0)))
        };
        let summary = &mut self.summary;
        let torque = if answer.joints == n { apart(&answer.torque[..n], expected) } else { f64::INFINITY };
        summary.torque_difference_max = summary.torque_difference_max.max(torque);
        summary.answers += 1;
        let BoardFigures { level, iterations, active_rows, allocations, stack_bytes, heap_bytes, .. } =
            answer.figures;
        summary.allocations = allocations;
        summary.stack_bytes = summary.stack_bytes.max(stack_bytes);
        summary.heap_bytes = heap_bytes;
        summary.fallback_level_max = summary.fallback_level_max.max(level);
        if answer.cycled != self.twin.cycled() {
            summary.command_difference_max = f64::INFINITY;
        } else if answer.cycled {
            let command = self.twin.command();
            let mut most = apart(&answer.feed_forward[..n], &command.segments[0].torque[..n]);
            for (got, row) in answer.gain.iter().zip(&command.gain).take(n) {
                most = most.max(apart(&got[..n], &row[..n]));
                most = most.max(apart(&got[MAX_JOINTS..][..n], &row[MAX_JOINTS..][..n]));
            }
            summary.command_difference_max = summary.command_difference_max.max(most);
            summary.cycles += 1;
            summary.constrained_cycles += u64::from(active_rows > 0);
            summary.active_rows_max = summary.active_rows_max.max(active_rows);
            summary.qp_iterations_max = summary.qp_iterations_max.max(iterations);
        }
    }

    /// Leaves the figures in the run's folder and says how it went.
    ///
    /// # Errors
    /// [`Failure::Fault`] when the board fell silent, [`Failure::Input`] when the folder cannot be written.
    pub fn finish(self, folder: Option<&Path>, ended: Ended) -> Result<Ended, Failure> {
        let summary = &self.summary;
        leave_part(folder, BOARD_PART, summary)?;
        if let Some(broken) = self.broken {
            return Err(Failure::Fault(broken));
        }
        say(&format!(
            "board: {} answers, {} cycles ({} constrained, up to {} rows, {} iterations); beside the library: torque {:.1e} N m, command \
             {:.1e}; stack {} bytes, heap {} bytes, {} memory requests after the start",
            summary.answers,
            summary.cycles,
            summary.constrained_cycles,
            summary.active_rows_max,
            summary.qp_iterations_max,
            summary.torque_difference_max,
            summary.command_difference_max,
            summary.stack_bytes,
            summary.heap_bytes,
            summary.allocations
        ));
        let same = summary.torque_difference_max.max(summary.command_difference_max) <= LARGEST_DIFFERENCE;
        Ok(if same && summary.allocations == 0 { ended } else { Ended::CriterionMissed })
    }
}

/// Connects, for as long as the other end may need to start.
fn reach(address: &str) -> Result<TcpStream, Failure> {
    let begin = Instant::now();
    loop {
        match TcpStream::connect(address) {
            Ok(line) => return Ok(line),
            Err(error) if begin.elapsed() > PATIENCE => {
                return Err(Failure::Fault(format!("--board {address}: {error}")));
            }
            Err(_) => std::thread::sleep(Duration::from_millis(50)),
        }
    }
}

impl Controller for BoardController {
    fn cycle(&mut self, state: &PlantState, now_ns: u64, command: &mut Command) {
        let (header, joints) = (command.header, command.n_joints);
        *command = Command::new(header.run_id, header.joint_set_hash, joints);
        command.header = header;
        command.valid_from_ns = now_ns;
        command.valid_until_ns = now_ns + self.life_ns;
        command.verdict = Verdict::BadState as u32;
        command.fallback_level = FallbackLevel::ZeroTorque as u32;
        if self.broken.is_some() {
            return;
        }
        match self.ask(state) {
            Ok(answer) => {
                self.compare(state, &answer);
                let n = answer.joints.min(joints as usize);
                command.segments[0].torque[..n].copy_from_slice(&answer.torque[..n]);
                command.verdict = answer.figures.verdict;
                command.fallback_level = answer.figures.level;
                command.report.qp_iterations = answer.figures.iterations;
                command.report.active_rows = answer.figures.active_rows;
            }
            Err(broken) => self.broken = Some(broken),
        }
    }
}
