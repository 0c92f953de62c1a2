//! Faults of messages on purpose: what the scenario wants to go wrong between plant and controller.
//!
//! They strike between a loop and what it works for, after the link: the loops themselves go on undisturbed, in real time as in lockstep,
//! and the controller and the plant get what they would get over a bad link.

use delmpc_controller_process::controller_loop::Controller;
use delmpc_messages::{Command, PlantState};
use delmpc_scenario::{Clock, FaultKind, FaultSettings, FaultTarget, Scenario};
use delmpc_transport::{
    Corrupt, Fault, FaultInjector, InProcessPublisher, Lossy, Publisher, Schedule, Subscriber,
    in_process_link,
};

use crate::plant_process::Plant;
use crate::steering::Pull;
use crate::truth::Truth;

/// All faults of one kind of message, one link after the other; without faults nothing is copied.
struct BadLink<T> {
    faults: Option<(InProcessPublisher<T>, Box<dyn Subscriber<T>>)>,
}

impl<T: Corrupt + 'static> BadLink<T> {
    fn new(scenario: &Scenario, target: FaultTarget) -> Self {
        let struck = || scenario.fault.iter().filter(|fault| fault.target == target);
        if struck().count() == 0 {
            return Self { faults: None };
        }
        let (sender, receiver) = in_process_link::<T>();
        let mut link: Box<dyn Subscriber<T>> = Box::new(receiver);
        for (index, fault) in struck().enumerate() {
            let seed = scenario.seed.wrapping_add(index as u64);
            let schedule = schedule(fault, scenario, seed);
            link = match injected(fault) {
                None => Box::new(Lossy::new(link, schedule)),
                Some(injected) => Box::new(FaultInjector::new(link, injected, schedule, seed)),
            };
        }
        Self { faults: Some((sender, link)) }
    }

    /// What is left of a message; `None`: nothing.
    fn pass<'a>(&'a mut self, message: &'a T) -> Option<&'a T> {
        match &mut self.faults {
            None => Some(message),
            Some((sender, link)) => {
                // A link within the process does not break.
                sender.send(message).ok()?;
                link.receive_latest().ok()?
            }
        }
    }
}

fn schedule(fault: &FaultSettings, scenario: &Scenario, seed: u64) -> Schedule {
    // One message of each kind per cycle; in real time the first cycles of all are repeated to warm up.
    let first = (fault.start_s * scenario.controller.mpc_rate_hz).round() as u64;
    let warm_up = match (scenario.clock, fault.target) {
        (Clock::Realtime, FaultTarget::State) => delmpc_controller_process::controller_loop::WARM_UP_CYCLES,
        _ => 0,
    };
    let (first, count) = (first + u64::from(warm_up), u64::from(fault.count));
    match fault.probability {
        0.0 => Schedule::in_a_row(first, count),
        probability => Schedule::random_among(first, count, probability, seed),
    }
}

/// The damage; `None`: the message is lost. Faults of processes do not come here.
fn injected(fault: &FaultSettings) -> Option<Fault> {
    let shift_ns = (fault.size_s * 1e9) as u32;
    match fault.kind {
        FaultKind::Repeated => Some(Fault::Repeated),
        FaultKind::Stale => Some(Fault::Stale { age_ns: shift_ns }),
        FaultKind::Future => Some(Fault::Future { ahead_ns: shift_ns }),
        FaultKind::NotANumber => Some(Fault::NotANumber),
        FaultKind::Infinite => Some(Fault::Infinite),
        FaultKind::Huge => Some(Fault::Huge),
        FaultKind::WrongType => Some(Fault::WrongMagic),
        FaultKind::WrongVersion => Some(Fault::WrongVersion),
        FaultKind::WrongJoints => Some(Fault::WrongJointSet),
        FaultKind::WrongJointCount => Some(Fault::WrongJointCount),
        _ => None,
    }
}

/// A controller that gets the states of a bad link.
pub struct FaultyController<C> {
    controller: C,
    link: BadLink<PlantState>,
    /// The state that came last: it is what a controller has when the next one is lost.
    last: Box<PlantState>,
}

impl<C> FaultyController<C> {
    /// With the faults of a scenario.
    pub fn new(controller: C, scenario: &Scenario) -> Self {
        let link = BadLink::new(scenario, FaultTarget::State);
        Self { controller, link, last: Box::new(PlantState::new(0, 0, 0)) }
    }

    /// The controller.
    pub fn into_inner(self) -> C {
        self.controller
    }
}

impl<C: Controller> Controller for FaultyController<C> {
    fn cycle(&mut self, state: &PlantState, now_ns: u64, command: &mut Command) {
        if self.link.faults.is_none() {
            return self.controller.cycle(state, now_ns, command);
        }
        if let Some(state) = self.link.pass(state) {
            *self.last = *state;
        }
        self.controller.cycle(&self.last, now_ns, command);
    }

    fn prepare(&mut self) {
        self.controller.prepare();
    }

    fn reason_in_words(&self, reason: u32) -> &'static str {
        self.controller.reason_in_words(reason)
    }
}

/// A plant that gets the commands of a bad link.
pub struct FaultyPlant<P> {
    plant: P,
    link: BadLink<Command>,
}

impl<P> FaultyPlant<P> {
    /// With the faults of a scenario.
    pub fn new(plant: P, scenario: &Scenario) -> Self {
        Self { plant, link: BadLink::new(scenario, FaultTarget::Command) }
    }
}

impl<P: Plant> Plant for FaultyPlant<P> {
    fn accept(&mut self, command: &Command) -> bool {
        // What does not arrive is not refused.
        self.link.pass(command).is_none_or(|command| self.plant.accept(command))
    }

    fn step(&mut self) -> Result<(), String> {
        self.plant.step()
    }

    fn pull(&mut self, pull: &Pull) {
        self.plant.pull(pull);
    }

    fn measure(&mut self, state: &mut PlantState) {
        self.plant.measure(state);
    }

    fn truth(&mut self, truth: &mut Truth) {
        self.plant.truth(truth);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Answers with the position it saw.
    struct Echo;

    impl Controller for Echo {
        fn cycle(&mut self, state: &PlantState, _now_ns: u64, command: &mut Command) {
            command.segments[0].torque[0] = state.position[0];
            command.state_time_ns = state.time_ns;
        }
    }

    fn scenario(faults: &[FaultSettings]) -> Scenario {
        Scenario { clock: Clock::Lockstep, fault: faults.to_vec(), ..Scenario::default() }
    }

    /// What a controller saw in each of 6 cycles of states 0, 1, ... at 200 Hz.
    fn seen(faults: &[FaultSettings]) -> Vec<(f64, u64)> {
        let mut controller = FaultyController::new(Echo, &scenario(faults));
        let look = |k: u64| {
            let mut state = PlantState::new(1, 2, 1);
            state.position[0] = k as f64;
            state.velocity[0] = k as f64;
            state.time_ns = 1_000 * k;
            let mut command = Command::new(1, 2, 1);
            controller.cycle(&state, 0, &mut command);
            (command.segments[0].torque[0], command.state_time_ns)
        };
        (0..6).map(look).collect()
    }

    fn fault(kind: FaultKind, target: FaultTarget, start_s: f64, count: u32) -> FaultSettings {
        FaultSettings { kind, target, start_s, count, size_s: 1e-6, ..FaultSettings::default() }
    }

    #[test]
    fn without_faults_everything_passes() {
        let all = [(0.0, 0), (1.0, 1000), (2.0, 2000), (3.0, 3000), (4.0, 4000), (5.0, 5000)];
        assert_eq!(seen(&[]), all);
        assert_eq!(seen(&[fault(FaultKind::Lost, FaultTarget::Command, 0.0, 9)]), all, "of commands only");
    }

    #[test]
    fn lost_states_leave_the_last_one_and_faults_add_up() {
        let lost = fault(FaultKind::Lost, FaultTarget::State, 0.01, 2);
        let times = |faults: &[FaultSettings]| seen(faults).iter().map(|seen| seen.1).collect::<Vec<_>>();
        assert_eq!(times(std::slice::from_ref(&lost)), [0, 1000, 1000, 1000, 4000, 5000]);
        let future = fault(FaultKind::Future, FaultTarget::State, 0.02, 1);
        // The second link counts the messages that come to it.
        assert_eq!(times(&[future, lost]), [0, 1000, 1000, 1000, 5000, 5000]);
    }

    #[test]
    fn lost_commands_are_not_refused_and_do_not_come() {
        struct Count(u32);
        impl Plant for Count {
            fn accept(&mut self, _command: &Command) -> bool {
                self.0 += 1;
                false
            }
            fn step(&mut self) -> Result<(), String> {
                Ok(())
            }
            fn pull(&mut self, _pull: &Pull) {}
            fn measure(&mut self, _state: &mut PlantState) {}
            fn truth(&mut self, _truth: &mut Truth) {}
        }
        let mut plant =
            FaultyPlant::new(Count(0), &scenario(&[fault(FaultKind::Lost, FaultTarget::Command, 0.005, 3)]));
        let accepted: Vec<bool> = (0..5).map(|_| plant.accept(&Command::new(1, 2, 1))).collect();
        assert_eq!((accepted, plant.plant.0), (vec![false, true, true, true, false], 2));
    }
}
