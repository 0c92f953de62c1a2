//! The loop of the plant process.
//!
//! | clock | one turn |
//! |---|---|
//! | realtime | wait for the step's time, take the latest command, step, send the state |
//! | lockstep | send the state, wait for its command, take the steps of one cycle |
//!
//! Before either begins, the plant sends its initial state (sequence 1) and waits for the answer: then a controller is there, it has the
//! same joints, and it is warm.
//!
//! In real time the plant follows the wall clock; commands that come late are late. When the plant process itself was held up, by up to
//! [`MOST_CATCH_UP_NS`], it catches up; when longer, the simulated world has paused: a robot does not run away from its controller because
//! its simulation was stopped. Pauses are counted, and show in the real-time factor.

use std::collections::VecDeque;
use std::thread::sleep;
use std::time::Duration;

use delmpc_controller_process::clock::{monotonic_ns, sleep_until};
use delmpc_controller_process::controller_loop::Ending;
use delmpc_controller_process::durations::Durations;
use delmpc_controller_process::membership::{Attendance, Order};
use delmpc_controller_process::records::{Records, StepRecord};
use delmpc_controller_process::usage::Usage;
use delmpc_messages::{Command, PlantState, ProcessState, status};
use delmpc_scenario::{Clock, Scenario};
use delmpc_transport::{LinkError, Publisher, Subscriber};

use crate::log::Log;
use crate::metrics::Metrics;
use crate::setup::Setup;
use crate::steering::{Pull, Steering};
use crate::summary::PlantPart;
use crate::truth::Truth;
use crate::verdict::Failure;

/// Longest hold-up after which the plant catches up with the wall clock.
pub const MOST_CATCH_UP_NS: u64 = 20_000_000;
/// Simulated time after a fall (s): enough to see it.
const AFTER_FALL_S: f64 = 1.0;
/// Sleep while there is nothing to do.
const PAUSE: Duration = Duration::from_micros(50);
/// How long a finished plant waits for the controller to notice (ns).
const FAREWELL_NS: u64 = 1_000_000_000;

/// What is simulated.
pub trait Plant {
    /// A command has come and may act from now on. `false`: it was refused.
    fn accept(&mut self, command: &Command) -> bool;
    /// One step.
    ///
    /// # Errors
    /// When the step could not be computed, in words.
    fn step(&mut self) -> Result<(), String>;
    /// A person pulls at a link from now on, or lets go.
    fn pull(&mut self, pull: &Pull);
    /// Fills in what the sensors say now; the loop fills in the header.
    fn measure(&mut self, state: &mut PlantState);
    /// Why the robot fell, in words, if it did.
    fn fall_cause(&self) -> Option<String> {
        None
    }
    /// Fills in everything that is true now.
    fn truth(&mut self, truth: &mut Truth);
}

/// Periods beyond the scenario's delays that a command may lie ahead: a plan prepared for a later tick, a tick that was missed.
const MOST_PERIODS_AHEAD: f64 = 10.0;

/// Commands whose time has not come.
#[derive(Debug)]
pub struct CommandQueue {
    waiting: VecDeque<Command>,
    /// A command that begins later than this after it came is of no controller of ours (ns).
    longest_lead_ns: u64,
}

impl CommandQueue {
    /// For a scenario.
    pub fn new(scenario: &Scenario) -> Self {
        let (controller, sensors) = (&scenario.controller, &scenario.sensors);
        let periods = f64::from(controller.delay_cycles) + MOST_PERIODS_AHEAD;
        let lead_s = periods / controller.mpc_rate_hz
            + sensors.delay_s
            + scenario.plant.actuator_delay_s
            + controller.max_state_age_s;
        Self {
            waiting: VecDeque::with_capacity(controller.delay_cycles as usize + 4),
            longest_lead_ns: (lead_s * 1e9).round() as u64,
        }
    }

    /// A command that begins later than this after it came is refused, ns.
    pub fn longest_lead_ns(&self) -> u64 {
        self.longest_lead_ns
    }

    /// Takes a command in that came at `now_ns`; a full queue gives up its oldest one. `false`: it is of another run, or lies too far
    /// ahead, and is refused: it would keep out those that come after it.
    pub fn push(&mut self, command: &Command, run_id: u64, now_ns: u64) -> bool {
        let ahead_ns = command.valid_from_ns.saturating_sub(now_ns);
        if command.header.validate_run::<Command>(run_id).is_err() || ahead_ns > self.longest_lead_ns {
            return false;
        }
        if self.waiting.len() == self.waiting.capacity() {
            self.waiting.pop_front();
        }
        self.waiting.push_back(*command);
        true
    }

    /// Gives the plant the commands whose time has come; says how many it refused.
    pub fn hand_over(&mut self, plant: &mut impl Plant, time_ns: u64) -> u64 {
        let mut refused = 0;
        while let Some(command) = self.waiting.pop_front_if(|command| command.valid_from_ns <= time_ns) {
            refused += u64::from(!plant.accept(&command));
        }
        refused
    }
}

/// Why a run broke off.
#[derive(Debug, thiserror::Error)]
pub enum PlantFault {
    /// A link broke.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// A step could not be computed.
    #[error("the simulation broke down at {time_s:.4} s: {what}")]
    Simulation {
        /// When.
        time_s: f64,
        /// What happened.
        what: String,
    },
}

/// The loop, its ends of the links, and what it collects.
pub struct PlantLoop<'a, P, S> {
    scenario: &'a Scenario,
    states: P,
    commands: S,
    log: Log,
    steering: Steering,
    pull: Pull,
    metrics: Metrics,
    state: Box<PlantState>,
    truth: Box<Truth>,
    queue: CommandQueue,
    step_ns: u64,
    time_ns: u64,
    /// When the plant's clock began, by the monotonic clock.
    start_ns: u64,
    timing: Timing,
    commands_refused: u64,
    watchdog_level_max: u32,
    /// Every step with its times, when somebody wants them.
    records: Records<StepRecord>,
    /// The command that came last: when it had been sent, and how old its measurement was when it came.
    arrival: (u64, u64),
}

/// What a run of the plant leaves behind.
pub struct PlantRun {
    /// How it ended.
    pub ending: Ending,
    /// The figures.
    pub part: PlantPart,
    /// The log, not yet finished.
    pub log: Log,
    /// Every step with its times, if they were wanted.
    pub records: Records<StepRecord>,
}

/// What the wall clock said.
#[derive(Debug, Default)]
struct Timing {
    steps: Durations,
    ages: Durations,
    pauses: u64,
    begin_ns: u64,
    end_ns: u64,
}

impl<'a, P: Publisher<PlantState>, S: Subscriber<Command>> PlantLoop<'a, P, S> {
    /// A loop for a scenario. `blank` is a state with run, joint set and joint count filled in.
    pub fn new(scenario: &'a Scenario, states: P, commands: S, blank: &PlantState, log: Log) -> Self {
        let step_ns = (scenario.plant.step_s * 1e9).round() as u64;
        Self {
            scenario,
            states,
            commands,
            log,
            steering: Steering::none(),
            pull: Pull::none(),
            metrics: Metrics::new(scenario),
            state: Box::new(*blank),
            truth: Box::new(Truth::new(blank.n_joints)),
            queue: CommandQueue::new(scenario),
            step_ns,
            time_ns: 0,
            start_ns: 0,
            timing: Timing { steps: Durations::new(), ages: Durations::new(), ..Timing::default() },
            commands_refused: 0,
            watchdog_level_max: 0,
            records: Records::none(),
            arrival: (0, 0),
        }
    }

    /// Keeps a record of every step.
    #[must_use]
    pub fn recording(mut self) -> Self {
        self.records = Records::with_capacity(self.scenario.steps() as usize);
        self
    }

    /// Judges what happens by a scenario with its robot: ball, pushes and footholds in the frame of the stance, the feet by their names.
    ///
    /// # Errors
    /// As [`Setup::start`].
    pub fn judged_for(mut self, setup: &Setup) -> Result<Self, Failure> {
        self.metrics = Metrics::judged_for(setup)?;
        Ok(self)
    }

    /// Somebody pulls and pauses.
    #[must_use]
    pub fn steered(mut self, steering: Steering) -> Self {
        self.steering = steering;
        self
    }

    /// Runs to the end.
    ///
    /// # Errors
    /// When a link breaks, or a step cannot be computed while the robot stands.
    pub fn run(
        mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<PlantRun, PlantFault> {
        plant.truth(&mut self.truth);
        self.metrics.observe(&self.truth);
        self.log.truth(&self.truth);
        let mut ending = self.wait_for_the_first_answer(plant, membership)?;
        if ending == Ending::Finished {
            ending = match self.scenario.clock {
                Clock::Realtime => self.run_by_the_clock(plant, membership)?,
                Clock::Lockstep => self.run_cycle_by_cycle(plant, membership)?,
            };
        }
        self.say_farewell(plant, membership)?;
        let part = self.part();
        Ok(PlantRun { ending, part, log: self.log, records: self.records })
    }

    /// Sends the initial state until it is answered, and then until the run may begin.
    fn wait_for_the_first_answer(
        &mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<Ending, PlantFault> {
        self.send_state(plant, 0)?;
        let mut answered = false;
        loop {
            let order = membership.attend()?;
            if order.ends() {
                return Ok(Ending::Ordered(order));
            }
            answered |= self.receive()? == Some(1);
            if answered {
                membership.announce(ProcessState::Ready)?;
                if order == Order::Run {
                    break;
                }
            }
            self.states.serve_newcomers()?;
            sleep(PAUSE);
        }
        membership.announce(ProcessState::Running)?;
        Ok(Ending::Finished)
    }

    fn run_by_the_clock(
        &mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<Ending, PlantFault> {
        self.start_ns = monotonic_ns();
        self.timing.begin_ns = self.start_ns;
        for _ in 0..self.scenario.steps() {
            match self.steer(plant, membership)? {
                Err(order) => return Ok(Ending::Ordered(order)),
                Ok(stood_ns) => {
                    self.start_ns += stood_ns;
                    self.timing.begin_ns += stood_ns;
                }
            }
            let due_ns = self.start_ns + self.time_ns + self.step_ns;
            sleep_until(due_ns);
            let woke_ns = monotonic_ns();
            let usage = self.records.are_kept().then(Usage::now);
            let late_ns = woke_ns.saturating_sub(due_ns);
            if late_ns > MOST_CATCH_UP_NS {
                self.start_ns += late_ns;
                self.timing.pauses += 1;
            }
            let order = membership.attend()?;
            if order.ends() {
                return Ok(Ending::Ordered(order));
            }
            self.receive()?;
            let begin_ns = monotonic_ns();
            let goes_on = self.step(plant)?;
            let end_ns = monotonic_ns();
            self.timing.steps.add(end_ns - begin_ns);
            self.timing.end_ns = end_ns;
            if goes_on {
                self.send_state(plant, 0)?;
            }
            if let Some(before) = usage {
                self.record([due_ns, woke_ns, begin_ns, end_ns], &before);
            }
            if !goes_on {
                break;
            }
        }
        Ok(Ending::Finished)
    }

    fn run_cycle_by_cycle(
        &mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<Ending, PlantFault> {
        let steps_per_cycle = u64::from(self.scenario.steps_per_cycle());
        for index in 0..self.scenario.steps() {
            if let Err(order) = self.steer(plant, membership)? {
                return Ok(Ending::Ordered(order));
            }
            if index > 0 && index % steps_per_cycle == 0 {
                self.send_state(plant, 0)?;
                if let Some(order) = self.wait_for_the_answer(membership)? {
                    return Ok(Ending::Ordered(order));
                }
            }
            if !self.step(plant)? {
                break;
            }
        }
        Ok(Ending::Finished)
    }

    /// Hands the plant what a person wishes, and stands still while they wish that; says for how long (ns), or what ended it.
    fn steer(
        &mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<Result<u64, Order>, PlantFault> {
        let mut wish = self.steering.wish();
        let mut stood_ns = 0;
        if wish.paused {
            let begin_ns = monotonic_ns();
            while wish.paused {
                let order = membership.attend()?;
                if order.ends() {
                    return Ok(Err(order));
                }
                self.states.serve_newcomers()?;
                sleep(PAUSE);
                wish = self.steering.wish();
            }
            stood_ns = monotonic_ns() - begin_ns;
        }
        let pull = Pull { time_ns: self.pull.time_ns, ..wish.pull };
        if pull != self.pull {
            self.pull = Pull { time_ns: self.time_ns, ..pull };
            plant.pull(&self.pull);
            self.log.pull(&self.pull);
        }
        Ok(Ok(stood_ns))
    }

    fn wait_for_the_answer(&mut self, membership: &mut impl Attendance) -> Result<Option<Order>, PlantFault> {
        let sequence = self.state.header.sequence;
        loop {
            if self.receive()? == Some(sequence) {
                return Ok(None);
            }
            let order = membership.attend()?;
            if order.ends() {
                return Ok(Some(order));
            }
            if membership.peer_is_done() {
                // What it sent before its end is there by now.
                return Ok((self.receive()? != Some(sequence)).then_some(Order::PeerLost));
            }
            self.states.serve_newcomers()?;
            sleep(PAUSE);
        }
    }

    /// Takes the latest command into the queue; says which state it answers. One that is refused answers nothing.
    fn receive(&mut self) -> Result<Option<u64>, PlantFault> {
        let Some(command) = self.commands.receive_latest()? else {
            return Ok(None);
        };
        self.log.command(self.time_ns, command);
        if !self.queue.push(command, self.state.header.run_id, self.time_ns) {
            self.commands_refused += 1;
            return Ok(None);
        }
        let realtime = self.scenario.clock == Clock::Realtime;
        if realtime && command.state_sequence > 1 {
            let measured_ns = self.start_ns.saturating_add(command.state_time_ns);
            let age_ns = monotonic_ns().saturating_sub(measured_ns);
            self.arrival = (command.header.sent_at_ns, age_ns);
            self.timing.ages.add(age_ns);
        }
        self.metrics.observe_estimate(command);
        Ok(Some(command.state_sequence))
    }

    /// Gives the plant the commands whose time has come, steps, and looks. `false`: the run is over.
    fn step(&mut self, plant: &mut impl Plant) -> Result<bool, PlantFault> {
        self.commands_refused += self.queue.hand_over(plant, self.time_ns);
        let stepped = plant.step();
        if let Err(what) = stepped {
            // A robot that lies on the ground in a way nobody computes has fallen all the same.
            let fallen = self.truth.status_flags & status::FELL != 0;
            let time_s = self.time_ns as f64 * 1e-9;
            return if fallen { Ok(false) } else { Err(PlantFault::Simulation { time_s, what }) };
        }
        self.time_ns += self.step_ns;
        plant.truth(&mut self.truth);
        self.metrics.observe(&self.truth);
        self.log.truth(&self.truth);
        self.watchdog_level_max = self.watchdog_level_max.max(self.truth.watchdog_level);
        let fell_s = self.metrics.fall_time_s();
        if fell_s == Some(self.truth.time_s()) {
            self.metrics.set_fall_cause(plant.fall_cause());
        }
        Ok(fell_s.is_none_or(|fell_s| self.truth.time_s() < fell_s + AFTER_FALL_S))
    }

    /// Keeps the times of a step: due, woke up, begun, computed.
    fn record(&mut self, [due_ns, woke_ns, begin_ns, end_ns]: [u64; 4], before: &Usage) {
        let (command_sent_ns, age_ns) = std::mem::take(&mut self.arrival);
        let sent_ns = monotonic_ns();
        let used = Usage::now().since(before);
        self.records.keep(StepRecord {
            due_ns,
            woke_ns,
            begin_ns,
            end_ns,
            sent_ns,
            cpu_ns: used.cpu_ns,
            time_ns: self.time_ns,
            command_sent_ns,
            age_ns,
            cop_margin_m: self.truth.cop_margin_m,
            watchdog_level: self.truth.watchdog_level,
            status_flags: self.truth.status_flags,
            minor_faults: used.minor_faults as u32,
            major_faults: used.major_faults as u32,
            voluntary_switches: used.voluntary_switches as u32,
            involuntary_switches: used.involuntary_switches as u32,
        });
    }

    fn send_state(&mut self, plant: &mut impl Plant, extra_flags: u32) -> Result<(), PlantFault> {
        plant.measure(&mut self.state);
        self.state.status_flags |= extra_flags;
        self.state.header.sequence += 1;
        if self.scenario.clock == Clock::Realtime {
            self.state.header.sent_at_ns = monotonic_ns();
        }
        self.states.send(&self.state)?;
        self.log.state(self.time_ns, &self.state);
        Ok(())
    }

    /// Says that no further state will come, and waits a little for the controller to hear it.
    fn say_farewell(
        &mut self,
        plant: &mut impl Plant,
        membership: &mut impl Attendance,
    ) -> Result<(), PlantFault> {
        self.send_state(plant, status::FINISHED)?;
        let begin_ns = monotonic_ns();
        // In lockstep nothing is decided by the wall clock: whoever is gone or wants the end says so.
        let lockstep = self.scenario.clock == Clock::Lockstep;
        while !membership.peer_is_done() && (lockstep || monotonic_ns() < begin_ns + FAREWELL_NS) {
            if membership.attend()?.ends() {
                break;
            }
            self.states.serve_newcomers()?;
            sleep(PAUSE);
        }
        membership.announce(ProcessState::Finished)?;
        Ok(())
    }

    fn part(&self) -> PlantPart {
        let timing = &self.timing;
        let realtime = self.scenario.clock == Clock::Realtime;
        let wall_s = timing.end_ns.saturating_sub(timing.begin_ns) as f64 * 1e-9;
        let simulated_s = self.time_ns as f64 * 1e-9;
        PlantPart {
            robot: self.metrics.figures(),
            state_to_command_age_p50_s: timing.ages.percentile_s(0.5),
            state_to_command_age_p999_s: timing.ages.percentile_s(0.999),
            plant_step_p50_s: timing.steps.percentile_s(0.5),
            plant_real_time_factor: (wall_s > 0.0).then(|| simulated_s / wall_s),
            plant_pauses: realtime.then_some(timing.pauses),
            log_records_dropped: 0,
            commands_refused: self.commands_refused,
            watchdog_level_max: self.watchdog_level_max,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes everything.
    #[derive(Default)]
    struct Taken(Vec<u64>);

    impl Plant for Taken {
        fn accept(&mut self, command: &Command) -> bool {
            self.0.push(command.header.sequence);
            true
        }
        fn step(&mut self) -> Result<(), String> {
            Ok(())
        }
        fn pull(&mut self, _pull: &Pull) {}
        fn measure(&mut self, _state: &mut PlantState) {}
        fn truth(&mut self, _truth: &mut Truth) {}
    }

    #[test]
    fn commands_of_another_run_or_of_the_far_future_do_not_enter_the_queue_and_the_next_good_one_acts() {
        let mut queue = CommandQueue::new(&Scenario::default());
        let command = |run, sequence, valid_from_ns| {
            let mut command = Command::new(run, 2, 3);
            command.header.sequence = sequence;
            (command.valid_from_ns, command.valid_until_ns) = (valid_from_ns, valid_from_ns);
            command
        };
        let now_ns = 1_000_000_000;
        assert!(!queue.push(&command(8, 1, now_ns), 7, now_ns));
        for far_ns in [u64::MAX, now_ns + 5_000_000_000, 1 << 62] {
            assert!(!queue.push(&command(7, 2, far_ns), 7, now_ns), "{far_ns}");
        }
        assert!(queue.push(&command(7, 3, now_ns), 7, now_ns));
        let mut plant = Taken::default();
        assert_eq!(queue.hand_over(&mut plant, now_ns), 0);
        assert_eq!(plant.0, [3]);
    }
}
