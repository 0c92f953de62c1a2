//! Everything that enters the cycles of a controller, kept so that they can be computed again, bit by bit.
//!
//! A cycle depends on the cycles before it, the state and the time it is given, and on the readings of the clock by which the controller
//! judges how far ahead it has to prepare. With all of these on tape, a new controller goes through the same instructions on the same numbers
//! as the one of the run did, as often as wanted, at any speed. What differs then is the machine.

use std::cell::{Cell, RefCell};

use bytemuck::{Pod, Zeroable};
use delmpc_controller_core::cycle::Clock as CycleClock;
use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_controller_process::records::Records;
use delmpc_messages::{Command, PlantState};

use crate::robot_controller::RobotController;
use crate::setup::Setup;
use crate::verdict::Failure;

/// Readings of the clock per cycle, at most: a cycle and a preparation take seven each.
const READINGS_PER_CYCLE: usize = 16;

/// What entered a cycle, and what came out.
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub struct CycleInput {
    /// The state.
    pub state: PlantState,
    /// The present time by the plant's clock (ns).
    pub now_ns: u64,
    /// Checksum of the command.
    pub command: u64,
}

/// The machine's clock, whose readings are kept.
#[derive(Debug)]
pub struct TapedClock {
    readings: RefCell<Records<u64>>,
}

impl CycleClock for TapedClock {
    fn now_ns(&self) -> u64 {
        let now_ns = monotonic_ns();
        self.readings.borrow_mut().keep(now_ns);
        now_ns
    }
}

/// The clock of a tape: the readings of the run once more.
#[derive(Debug)]
pub struct RewoundClock<'a> {
    readings: &'a [u64],
    next: Cell<usize>,
}

impl<'a> RewoundClock<'a> {
    /// From the first reading on.
    pub fn new(readings: &'a [u64]) -> Self {
        Self { readings, next: Cell::new(0) }
    }
}

impl CycleClock for RewoundClock<'_> {
    /// Beyond the end of the tape: the last reading.
    fn now_ns(&self) -> u64 {
        let index = self.next.get();
        self.next.set(index + 1);
        self.readings.get(index).or(self.readings.last()).copied().unwrap_or(0)
    }
}

/// A robot's controller whose cycles are kept.
#[derive(Debug)]
pub struct TapedController {
    controller: RobotController<TapedClock>,
    /// What entered the cycle whose command is being sent.
    input: Box<CycleInput>,
    inputs: Records<CycleInput>,
}

impl TapedController {
    /// For a scenario in real time, with room for half as much again as the run needs.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be controlled like that.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let scenario = &setup.scenario;
        let cycles = 1.5 * scenario.duration_s * scenario.controller.mpc_rate_hz;
        let cycles = cycles as usize + 1000;
        let readings = Records::with_capacity(READINGS_PER_CYCLE * cycles);
        let clock = TapedClock { readings: RefCell::new(readings) };
        let controller = RobotController::with_clock(setup, clock)?;
        Ok(Self { controller, input: Box::new(CycleInput::zeroed()), inputs: Records::with_capacity(cycles) })
    }

    /// How far from the ball the hand ends, as [`RobotController::out_of_reach_m`].
    pub fn out_of_reach_m(&self) -> Option<f64> {
        self.controller.out_of_reach_m()
    }

    /// What entered every cycle, and every reading of the clock.
    pub fn into_tape(self) -> (Records<CycleInput>, Records<u64>) {
        (self.inputs, self.controller.into_clock().readings.into_inner())
    }
}

impl Controller for TapedController {
    fn cycle(&mut self, state: &PlantState, now_ns: u64, command: &mut Command) {
        self.controller.cycle(state, now_ns, command);
        (self.input.state, self.input.now_ns) = (*state, now_ns);
    }

    fn prepare(&mut self) {
        self.controller.prepare();
        // Not before the command is sent: its four thousand words take microseconds.
        self.input.command = checksum(self.controller.command());
        self.inputs.keep(*self.input);
    }

    fn reason_in_words(&self, reason: u32) -> &'static str {
        self.controller.reason_in_words(reason)
    }
}

/// Of all that the plant acts on.
pub fn checksum(command: &Command) -> u64 {
    let Command { valid_from_ns, valid_until_ns, verdict, fallback_level, segments, gain, .. } = command;
    let words = bytemuck::cast_slice::<_, u64>(segments).iter().chain(bytemuck::cast_slice(gain));
    let heads = [*valid_from_ns, *valid_until_ns, u64::from(*verdict), u64::from(*fallback_level)];
    heads.iter().chain(words).fold(0, |sum: u64, word| sum.rotate_left(5).wrapping_add(*word))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rewound_clock_gives_every_reading_again_and_then_the_last_one() {
        let clock = RewoundClock::new(&[3, 5, 5, 8]);
        assert_eq!([(); 6].map(|()| clock.now_ns()), [3, 5, 5, 8, 8, 8]);
        assert_eq!(RewoundClock::new(&[]).now_ns(), 0);
    }

    #[test]
    fn the_checksum_sees_every_number_and_its_place() {
        let blank = Command::new(1, 2, 3);
        let mut seen = vec![checksum(&blank)];
        for place in 0..3 {
            let mut command = blank;
            command.segments[1].torque[place] = 1.0;
            seen.push(checksum(&command));
            command.gain[place][7] = 1.0;
            seen.push(checksum(&command));
        }
        let mut command = blank;
        command.verdict = 3;
        seen.push(checksum(&command));
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen.len(), 8);
    }
}
