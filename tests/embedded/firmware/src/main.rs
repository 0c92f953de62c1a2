//! The board's shell: start, heap, serial line, the loop that never ends. What controls the robot is `ControlTask`, which knows no board.
//!
//! ```text
//! reset -> heap, model, controller (all memory) -> seal the heap -> loop: readings from the line -> tick -> answer on the line
//! ```
//!
//! The loop is that of a simulation in lockstep: a line instead of encoders and motors, readings instead of a timer. What a real board has
//! in their place is in the guide, ../README.md.
#![no_std]
#![no_main]

extern crate alloc;

mod count;
mod line;
mod memory;
mod robot;
mod stack;

use core::panic::PanicInfo;

use cortex_m_rt::{ExceptionFrame, entry, exception};
use cortex_m_semihosting::{debug, hprintln};
use delmpc_controller_core::control_task::ControlTask;
use delmpc_controller_core::cycle::StoppedClock;
use delmpc_messages::PlantState;
use delmpc_servo::wire::{
    BoardFigures, FRAME_CAPACITY, FrameKind, Receiver, read_readings, write_answer,
};

use line::Line;
use memory::ConstructorsOnly;

#[global_allocator]
static HEAP: ConstructorsOnly = ConstructorsOnly::new();

/// Readings between two looks at how deep the stack has been: looking is slow.
const LOOK_EVERY: u32 = 500;

#[entry]
fn main() -> ! {
    // SAFETY: the first thing that happens, once.
    unsafe { HEAP.start() };
    stack::paint();
    let Some(mut task) = task() else { stop("the robot's constants were refused") };
    HEAP.seal();
    hprintln!("ready: {} bytes of heap, {} of stack in the constructors", HEAP.needed(), stack::deepest());
    stack::paint();
    count::start();
    let Some(line) = Line::open() else { stop("there is no line") };
    run(&mut task, line)
}

/// The task of the robot this firmware is for. Not inlined: what its constructors take of the stack is given back.
#[inline(never)]
fn task() -> Option<ControlTask> {
    let model = robot::ROBOT.model().ok()?;
    ControlTask::with_active_set(model, robot::config(), robot::watchdog()).ok()
}

fn run(task: &mut ControlTask, mut line: Line) -> ! {
    let joints = robot::ROBOT.joints();
    let mut readings = PlantState::new(0, robot::ROBOT.joint_set_hash, joints as u32);
    let (mut receiver, mut frame) = (Receiver::new(), [0; FRAME_CAPACITY]);
    let mut figures = BoardFigures { heap_bytes: HEAP.needed() as u32, ..BoardFigures::default() };
    let mut ticks = 0_u32;
    loop {
        receive(&mut line, &mut receiver, &mut readings);
        let begin = count::now();
        task.tick(&readings, &StoppedClock);
        count::tell(begin, task.cycled());
        let command = task.cycled().then(|| task.command());
        if ticks.is_multiple_of(LOOK_EVERY) {
            figures.stack_bytes = stack::deepest() as u32;
        }
        ticks = ticks.wrapping_add(1);
        figures.level = task.level() as u32;
        figures.allocations = HEAP.late();
        if let Some(command) = command {
            figures.verdict = command.verdict;
            figures.reason = command.reason;
            figures.iterations = command.report.qp_iterations;
            figures.active_rows = command.report.active_rows;
        }
        let Some(length) = write_answer(&readings, &figures, task.torque(), command, &mut frame) else {
            stop("an answer does not fit into its frame")
        };
        line.write(&frame[..length]);
    }
}

/// Waits for readings: a real board waits for its timer and reads its encoders.
fn receive(line: &mut Line, receiver: &mut Receiver, readings: &mut PlantState) {
    let mut bytes = [0; 512];
    loop {
        let wanted = receiver.missing().min(bytes.len());
        let count = line.read(&mut bytes[..wanted]);
        if count == 0 {
            // The other end hung up: the run is over.
            loop {
                debug::exit(debug::EXIT_SUCCESS);
            }
        }
        for byte in &bytes[..count] {
            if let Some((FrameKind::Readings, payload)) = receiver.take(*byte)
                && read_readings(payload, readings).is_some()
            {
                return;
            }
        }
    }
}

/// A real board takes the voltage from its motors here, and lets its hardware watchdog reset it.
fn stop(why: &str) -> ! {
    hprintln!("stopped: {}", why);
    loop {
        debug::exit(debug::EXIT_FAILURE);
    }
}

#[panic_handler]
fn panic(info: &PanicInfo<'_>) -> ! {
    hprintln!("{}", info);
    stop("panic")
}

#[exception]
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    hprintln!("{:?}", frame);
    stop("hard fault")
}
