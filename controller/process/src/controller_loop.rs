//! The loop of the controller process.
//!
//! | clock | one turn |
//! |---|---|
//! | realtime | wait for the tick, take the latest state, cycle, send |
//! | lockstep | wait for the next state, cycle, send |
//!
//! The first state is sent by a plant that waits for its answer: that is how both know of each other. In real time, cycles follow each
//! other tick by tick from the second state on, whether a new state came or not.

use std::thread::sleep;
use std::time::Duration;

use delmpc_messages::{Command, PlantState, ProcessState, Verdict, status};
use delmpc_scenario::{Clock, Scenario};
use delmpc_transport::{LinkError, Publisher, Subscriber};

use crate::clock::{Tick, Ticker, monotonic_ns};
use crate::figures::{CycleFigure, CycleFigures};
use crate::membership::{Attendance, Order};
use crate::records::{CycleRecord, Records};
use crate::refusals::Refusals;
use crate::usage::Usage;

/// What computes a command from a state.
pub trait Controller {
    /// One control cycle. Fills in all of `command` but its header and which state it answers. `now_ns` is the present time by
    /// the plant's clock.
    fn cycle(&mut self, state: &PlantState, now_ns: u64, command: &mut Command);

    /// What can be done for the next cycle before its state is there; called after a command was sent. The times it took belong in
    /// the report of the cycle it is for, in the total too.
    fn prepare(&mut self) {}

    /// What a reason of its own, from 100 on, stands for ([`Command::reason`]).
    fn reason_in_words(&self, _reason: u32) -> &'static str {
        "a reason of the controller's own"
    }
}

/// How a loop ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// All is done.
    Finished,
    /// Something else came first.
    Ordered(Order),
}

/// Sleep while there is nothing to do. Short against a cycle, long against the cost of looking.
const PAUSE: Duration = Duration::from_micros(50);

/// Cycles before the first answer in real time.
pub const WARM_UP_CYCLES: u32 = 10;

/// The loop and its ends of the links.
#[derive(Debug)]
pub struct ControllerLoop<'a, S, P> {
    scenario: &'a Scenario,
    states: S,
    commands: P,
    /// The latest state; sequence 0: none yet.
    state: Box<PlantState>,
    command: Box<Command>,
    /// Age of a measurement when it is sent.
    delay_ns: u64,
    /// Counts the heap allocations of this process so far.
    allocations: Option<fn() -> u64>,
    figures: CycleFigures,
    /// Every cycle with its times, when somebody wants them.
    records: Records<CycleRecord>,
    refusals: Refusals,
}

impl<'a, S: Subscriber<PlantState>, P: Publisher<Command>> ControllerLoop<'a, S, P> {
    /// A loop for a scenario. `blank` is a command with run, joint set and joint count filled in.
    pub fn new(scenario: &'a Scenario, states: S, commands: P, blank: &Command) -> Self {
        Self {
            scenario,
            states,
            commands,
            state: Box::new(PlantState::new(0, 0, 0)),
            command: Box::new(*blank),
            delay_ns: (scenario.sensors.delay_s * 1e9).round() as u64,
            allocations: None,
            figures: CycleFigures::new(),
            records: Records::none(),
            refusals: Refusals::default(),
        }
    }

    /// Keeps a record of every cycle.
    #[must_use]
    pub fn recording(mut self) -> Self {
        // Half as much again as the run needs: states may be slow to come.
        let cycles = 1.5 * self.scenario.duration_s * self.scenario.controller.mpc_rate_hz;
        self.records = Records::with_capacity(cycles as usize + 1000);
        self
    }

    /// Counts the heap allocations of every cycle, by a function that counts those of the process so far.
    #[must_use]
    pub fn counting(mut self, allocations: fn() -> u64) -> Self {
        self.allocations = Some(allocations);
        self
    }

    /// Runs to the end.
    ///
    /// # Errors
    /// When a link breaks.
    pub fn run(
        mut self,
        controller: &mut impl Controller,
        membership: &mut impl Attendance,
    ) -> Result<(Ending, CycleFigures, Records<CycleRecord>), LinkError> {
        let ending = match self.scenario.clock {
            Clock::Realtime => self.run_by_the_clock(controller, membership)?,
            Clock::Lockstep => self.run_state_by_state(controller, membership)?,
        };
        membership.announce(ProcessState::Finished)?;
        Ok((ending, self.figures, self.records))
    }

    fn run_by_the_clock(
        &mut self,
        controller: &mut impl Controller,
        membership: &mut impl Attendance,
    ) -> Result<Ending, LinkError> {
        let period_ns = (1e9 / self.scenario.controller.mpc_rate_hz).round() as u64;
        let mut ticker = Ticker::new(monotonic_ns() + period_ns, period_ns);
        let mut running = false;
        loop {
            let tick = ticker.wait();
            let order = membership.attend()?;
            if order.ends() {
                return Ok(Ending::Ordered(order));
            }
            let news = self.receive()?;
            if self.plant_is_done() || (!news && membership.peer_is_done()) {
                return Ok(Ending::Finished);
            }
            if !running && self.state.header.sequence > 1 {
                running = true;
                // Without a first answer of ours: the run is under way, and we take over from one that is gone.
                membership.announce(ProcessState::Ready)?;
            }
            if !news && !running {
                self.commands.serve_newcomers()?;
                continue;
            }
            if !running {
                self.warm_up(controller);
            }
            let sent_ns = self.cycle(controller, tick)?;
            if running {
                let missed = u64::from(sent_ns > tick.due_ns + period_ns);
                self.figures.deadline_misses += missed + tick.missed;
            } else {
                self.first_answer_given(membership)?;
            }
        }
    }

    fn run_state_by_state(
        &mut self,
        controller: &mut impl Controller,
        membership: &mut impl Attendance,
    ) -> Result<Ending, LinkError> {
        loop {
            let order = membership.attend()?;
            if order.ends() {
                return Ok(Ending::Ordered(order));
            }
            if !self.receive()? {
                // It said so without us having seen its last state.
                if membership.peer_is_done() {
                    return Ok(Ending::Finished);
                }
                self.commands.serve_newcomers()?;
                sleep(PAUSE);
                continue;
            }
            if self.plant_is_done() {
                return Ok(Ending::Finished);
            }
            self.cycle(controller, Tick::default())?;
            if self.state.header.sequence == 1 {
                membership.announce(ProcessState::Ready)?;
            }
        }
    }

    /// Answers the next state if it is there: one turn of the lockstep loop, for a caller that has a loop of its own.
    ///
    /// # Errors
    /// When a link breaks.
    pub fn answer(&mut self, controller: &mut impl Controller) -> Result<(), LinkError> {
        if self.receive()? && !self.plant_is_done() {
            self.cycle(controller, Tick::default())?;
        }
        Ok(())
    }

    /// The figures of the cycles so far.
    pub fn figures(&self) -> &CycleFigures {
        &self.figures
    }

    /// Takes the latest state; says whether it is a new one. One of another run is none.
    fn receive(&mut self) -> Result<bool, LinkError> {
        let run_id = self.command.header.run_id;
        match self.states.receive_latest()? {
            Some(state) if state.header.validate_run::<PlantState>(run_id).is_ok() => {
                *self.state = *state;
                Ok(true)
            }
            Some(state) => {
                if let Err(error) = state.header.validate_run::<PlantState>(run_id) {
                    self.refusals.tell(error.code(), || format!("a state is refused: {error}"));
                }
                Ok(false)
            }
            None => Ok(false),
        }
    }

    fn plant_is_done(&self) -> bool {
        self.state.has_status(status::FINISHED)
    }

    fn first_answer_given(&mut self, membership: &mut impl Attendance) -> Result<(), LinkError> {
        // What the first cycles cost is not what a cycle costs.
        self.figures = CycleFigures::new();
        self.records.clear();
        membership.announce(ProcessState::Ready)
    }

    /// The present time by the plant's clock, when the latest state was sent `age_ns` ago.
    fn now_ns(&self, age_ns: u64) -> u64 {
        self.state.time_ns.saturating_add(self.delay_ns).saturating_add(age_ns)
    }

    /// Cycles nobody hears of, so that the first ones that count find caches, pages and branch predictors as all others do.
    fn warm_up(&mut self, controller: &mut impl Controller) {
        let now_ns = self.now_ns(0);
        for _ in 0..WARM_UP_CYCLES {
            controller.cycle(&self.state, now_ns, &mut self.command);
            controller.prepare();
        }
    }

    /// One cycle; returns when its command was sent. In lockstep nothing that depends on a clock enters the command.
    fn cycle(&mut self, controller: &mut impl Controller, tick: Tick) -> Result<u64, LinkError> {
        let realtime = self.scenario.clock == Clock::Realtime;
        let usage = self.records.are_kept().then(Usage::now);
        let begin_ns = monotonic_ns();
        let measured_ns = self.state.header.sent_at_ns;
        // The plant's clock runs with ours; a state says what it showed when it was measured, and is sent `delay_s` later. It
        // stands still until the first answer.
        let runs = realtime && self.state.header.sequence > 1;
        let age_ns = if runs { begin_ns.saturating_sub(measured_ns) } else { 0 };
        let now_ns = self.now_ns(age_ns);
        let command = self.command.as_mut();
        let before = self.allocations.map_or(0, |count| count());
        controller.cycle(&self.state, now_ns, command);

        let after = self.allocations.map_or(0, |count| count());
        command.report.allocations = (after - before) as u32;
        address(command, &self.state);
        let computed_ns = monotonic_ns();
        let inside_ns = computed_ns - begin_ns;
        // What the controller had done ahead.
        let ahead_ns = command.report.total_ns.saturating_sub(inside_ns);
        if realtime {
            command.report.total_ns = inside_ns + ahead_ns;
            command.header.sent_at_ns = computed_ns;
        }
        self.commands.send(command)?;
        let sent_ns = monotonic_ns();
        if command.verdict() == Some(Verdict::BadState) {
            tell_why(&mut self.refusals, controller, &self.state, command);
        }
        let feedback_ns = computed_ns - if realtime { tick.due_ns.min(begin_ns) } else { begin_ns };
        let figure = CycleFigure {
            total_ns: feedback_ns + ahead_ns,
            feedback_ns,
            linearize_ns: command.report.linearize_ns,
            riccati_ns: command.report.riccati_ns,
            qp_ns: command.report.qp_ns,
        };
        self.figures.add(command, figure);
        command.report.publish_ns = if realtime { sent_ns - computed_ns } else { 0 };
        controller.prepare();
        if let Some(before) = usage {
            let woke_ns = tick.due_ns + tick.late_ns;
            let times = [tick.due_ns, woke_ns, begin_ns, computed_ns, sent_ns, monotonic_ns()];
            let used = Usage::now().since(&before);
            let mut record = CycleRecord::new(times, tick.missed, &self.state, command, &used);
            if ahead_ns > 0 {
                self.records.credit_preparation(&command.report);
                (record.shift_ns, record.linearize_ns, record.riccati_ns) = (0, 0, 0);
            }
            self.records.keep(record);
        }
        Ok(sent_ns)
    }
}

/// Says why a state was refused.
fn tell_why(refusals: &mut Refusals, controller: &impl Controller, state: &PlantState, command: &Command) {
    let (reason, sequence) = (command.reason, state.header.sequence);
    refusals.tell(reason, || {
        match state.validate(command.header.joint_set_hash, command.n_joints as usize) {
            Err(error) if error.code() == reason => format!("state {sequence} is refused: {error}"),
            _ => format!(
                "state {sequence} is refused: {} (reason {reason})",
                controller.reason_in_words(reason)
            ),
        }
    });
}

/// More than a controller counts in a run: a number of the plant's that is farther ahead than this is damaged.
const LARGEST_JUMP: u64 = 10_000_000;

/// Says which state a command answers, and numbers it: higher than all before, those of a controller that is gone included.
pub fn address(command: &mut Command, state: &PlantState) {
    let (ours, applied) = (command.header.sequence, state.applied_command_sequence);
    let believed = ours == 0 || applied.saturating_sub(ours) <= LARGEST_JUMP;
    command.header.sequence = if believed { ours.max(applied) } else { ours }.saturating_add(1);
    command.state_sequence = state.header.sequence;
    if state.header.sequence <= 1 {
        // The plant that waits for its first answer has had commands before, as far as the robot is concerned.
        command.valid_from_ns = state.time_ns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_successor_counts_on_and_a_damaged_number_is_not_believed() {
        let (mut command, mut state) = (Command::new(1, 2, 3), PlantState::new(1, 2, 3));
        state.header.sequence = 9;
        state.applied_command_sequence = 5_000;
        address(&mut command, &state);
        assert_eq!((command.header.sequence, command.state_sequence), (5_001, 9));
        state.applied_command_sequence = u64::MAX;
        address(&mut command, &state);
        assert_eq!(command.header.sequence, 5_002);
        state.applied_command_sequence = 6_000;
        address(&mut command, &state);
        assert_eq!(command.header.sequence, 6_001);
    }
}
