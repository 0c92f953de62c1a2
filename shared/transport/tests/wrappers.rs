//! Delay, loss and faults: each does what it says, and the same again with the same seed.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests, too

use bytemuck::bytes_of;
use delmpc_messages::{Command, MessageError, PlantState, foot, sensor};
use delmpc_transport::{
    Corrupt, Delay, Fault, FaultInjector, InProcessPublisher, InProcessSubscriber, Lossy, Publisher,
    Schedule, Subscriber, in_process_link,
};

const HASH: u64 = 2;
const N: usize = 30;

fn state(sequence: u64) -> PlantState {
    let mut state = PlantState::new(1, HASH, N as u32);
    state.header.sequence = sequence;
    state.time_ns = 10_000_000_000 + sequence;
    state.velocity[29] = sequence as f64;
    state.sensors = sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS;
    state.n_feet = 1;
    state.feet[0].flags = foot::WRENCH;
    state
}

/// Sends states 1, 2, ... one before each call, and gives the sequence each call received.
fn run<S: Subscriber<PlantState>>(
    publisher: &mut InProcessPublisher<PlantState>,
    subscriber: &mut S,
    calls: u64,
) -> Vec<Option<u64>> {
    let mut received = Vec::new();
    for sequence in 1..=calls {
        publisher.send(&state(sequence)).unwrap();
        received.push(subscriber.receive_latest().unwrap().map(|s| s.header.sequence));
    }
    received
}

#[test]
fn the_in_process_link_gives_the_latest_message_once_and_to_every_subscriber() {
    let (mut publisher, mut subscriber) = in_process_link();
    let mut other = subscriber.clone();
    assert_eq!(subscriber.receive_latest().unwrap(), None);
    publisher.send(&state(1)).unwrap();
    publisher.send(&state(2)).unwrap();
    assert_eq!(bytes_of(subscriber.receive_latest().unwrap().unwrap()), bytes_of(&state(2)));
    assert_eq!(subscriber.receive_latest().unwrap(), None);
    assert_eq!(other.receive_latest().unwrap(), Some(&state(2)));
}

#[test]
fn the_in_process_link_works_between_threads_and_as_a_trait_object() {
    let (mut states_out, states_in) = in_process_link::<PlantState>();
    let (commands_out, mut commands_in) = in_process_link::<Command>();
    let peer = std::thread::spawn(move || {
        let mut states: Box<dyn Subscriber<PlantState>> = Box::new(states_in);
        let mut commands: Box<dyn Publisher<Command>> = Box::new(commands_out);
        let mut command = Command::new(1, HASH, N as u32);
        while command.state_sequence < 1_000 {
            if let Some(state) = states.receive_latest().unwrap() {
                command.state_sequence = state.header.sequence;
                commands.send(&command).unwrap();
            }
        }
    });
    for sequence in 1..=1_000 {
        states_out.send(&state(sequence)).unwrap();
        let answer = loop {
            if let Some(command) = commands_in.receive_latest().unwrap() {
                break command.state_sequence;
            }
        };
        assert_eq!(answer, sequence);
    }
    peer.join().unwrap();
}

#[test]
fn a_delay_in_cycles_is_exact() {
    let (mut publisher, subscriber) = in_process_link();
    let mut delayed = Delay::in_cycles(subscriber, 3);
    let received = run(&mut publisher, &mut delayed, 6);
    assert_eq!(received, [None, None, None, Some(1), Some(2), Some(3)]);
    let after: Vec<_> =
        (0..4).map(|_| delayed.receive_latest().unwrap().map(|s| s.header.sequence)).collect();
    assert_eq!(after, [Some(4), Some(5), Some(6), None], "what is on its way still arrives");
}

#[test]
fn no_delay_is_no_change() {
    let (mut publisher, subscriber) = in_process_link();
    let received = run(&mut publisher, &mut Delay::in_cycles(subscriber, 0), 3);
    assert_eq!(received, [Some(1), Some(2), Some(3)]);
}

#[test]
fn a_delay_in_time_goes_by_the_time_it_is_given() {
    let (mut publisher, subscriber) = in_process_link();
    let mut delayed = Delay::in_time(subscriber, 100, 8);
    let mut at = |now, delayed: &mut Delay<PlantState, InProcessSubscriber<PlantState>>, send| {
        if send > 0 {
            publisher.send(&state(send)).unwrap();
        }
        delayed.set_time(now);
        delayed.receive_latest().unwrap().map(|s| s.header.sequence)
    };
    assert_eq!(at(1_000, &mut delayed, 1), None);
    assert_eq!(at(1_050, &mut delayed, 2), None);
    assert_eq!(at(1_099, &mut delayed, 0), None);
    assert_eq!(at(1_100, &mut delayed, 0), Some(1));
    assert_eq!(at(1_100, &mut delayed, 3), None);
    assert_eq!(at(2_000, &mut delayed, 0), Some(3), "of several due messages the latest is delivered");
    assert_eq!(at(3_000, &mut delayed, 0), None);
}

#[test]
fn a_full_queue_drops_its_oldest_message() {
    let (mut publisher, subscriber) = in_process_link();
    let mut delayed = Delay::in_time(subscriber, 100, 2);
    assert_eq!(run(&mut publisher, &mut delayed, 3), [None; 3]);
    delayed.set_time(100);
    assert_eq!(delayed.receive_latest().unwrap().map(|s| s.header.sequence), Some(3));
}

#[test]
fn jitter_repeats_with_its_seed_stays_in_bounds_and_never_goes_back() {
    let with_seed = |seed| {
        let (mut publisher, subscriber) = in_process_link();
        let mut delayed = Delay::in_cycles(subscriber, 2).with_jitter(3, seed);
        run(&mut publisher, &mut delayed, 500)
    };
    let received = with_seed(5);
    assert_eq!(received, with_seed(5));
    assert_ne!(received, with_seed(6));
    let mut last = 0;
    for (call, sequence) in received.iter().enumerate() {
        let Some(sequence) = *sequence else { continue };
        let delay = call as u64 + 1 - sequence;
        assert!((2..=5).contains(&delay), "delay {delay}");
        assert!(sequence > last, "{sequence} after {last}");
        last = sequence;
    }
    assert!(last > 490);
}

#[test]
fn losses_follow_the_schedule_on_either_end() {
    let (mut publisher, subscriber) = in_process_link();
    let mut lossy = Lossy::new(subscriber, Schedule::in_a_row(2, 3));
    let received = run(&mut publisher, &mut lossy, 7);
    assert_eq!(received, [Some(1), Some(2), None, None, None, Some(6), Some(7)]);
    assert_eq!(lossy.lost(), 3);

    let (publisher, mut subscriber) = in_process_link();
    let mut lossy = Lossy::new(publisher, Schedule::in_a_row(1, 1));
    let mut arrived = Vec::new();
    for sequence in 1..=3 {
        lossy.send(&state(sequence)).unwrap();
        arrived.push(subscriber.receive_latest().unwrap().map(|s| s.header.sequence));
    }
    assert_eq!((arrived, lossy.lost()), (vec![Some(1), None, Some(3)], 1));
}

#[test]
fn random_losses_repeat_with_their_seed() {
    let with_seed = |seed| {
        let (mut publisher, subscriber) = in_process_link();
        run(&mut publisher, &mut Lossy::new(subscriber, Schedule::random(0.1, seed)), 1_000)
    };
    assert_eq!(with_seed(1), with_seed(1));
    assert_ne!(with_seed(1), with_seed(2));
}

#[test]
fn silence_counts_as_no_message() {
    let (mut publisher, subscriber) = in_process_link();
    let mut lossy = Lossy::new(subscriber, Schedule::in_a_row(0, 1));
    for _ in 0..5 {
        assert_eq!(lossy.receive_latest().unwrap(), None);
    }
    publisher.send(&state(1)).unwrap();
    assert_eq!(lossy.receive_latest().unwrap(), None, "the first message is lost");
    publisher.send(&state(2)).unwrap();
    assert!(lossy.receive_latest().unwrap().is_some());
}

/// What message 2 of 3 becomes under a fault; 1 and 3 must pass untouched.
fn struck(fault: Fault, seed: u64) -> PlantState {
    let (mut publisher, subscriber) = in_process_link();
    let mut faulty = FaultInjector::new(subscriber, fault, Schedule::in_a_row(1, 1), seed);
    let mut received = Vec::new();
    for sequence in 1..=3 {
        publisher.send(&state(sequence)).unwrap();
        received.push(*faulty.receive_latest().unwrap().unwrap());
    }
    assert_eq!((received[0], received[2], faulty.injected()), (state(1), state(3), 1));
    received[1]
}

#[test]
fn every_fault_that_damages_a_message_is_refused_by_validation() {
    for seed in 0..50 {
        let refusal = |fault| struck(fault, seed).validate(HASH, N).unwrap_err();
        let nan = refusal(Fault::NotANumber);
        assert!(matches!(nan, MessageError::NotFinite { value, .. } if value.is_nan()), "{nan}");
        let infinite = refusal(Fault::Infinite);
        assert!(matches!(infinite, MessageError::NotFinite { value: f64::INFINITY, .. }), "{infinite}");
        let huge = refusal(Fault::Huge);
        assert!(matches!(huge, MessageError::Implausible { value: 1e300, .. }), "{huge}");
    }
    let refusal = |fault| struck(fault, 0).validate(HASH, N).unwrap_err();
    assert!(matches!(refusal(Fault::WrongMagic), MessageError::WrongMagic { .. }));
    assert!(matches!(refusal(Fault::WrongVersion), MessageError::WrongVersion { found: 3, .. }));
    assert!(matches!(refusal(Fault::WrongJointSet), MessageError::WrongJointSet { .. }));
    assert!(matches!(refusal(Fault::WrongJointCount), MessageError::WrongJointCount { found: 31, .. }));
}

#[test]
fn repeated_stale_and_future_messages_are_valid_but_not_fresh() {
    assert_eq!(struck(Fault::Repeated, 0), state(1));
    let stale = struck(Fault::Stale { age_ns: 7 }, 0);
    assert_eq!((stale.header.sequence, stale.time_ns), (2, state(2).time_ns - 7));
    let future = struck(Fault::Future { ahead_ns: 7 }, 0);
    assert_eq!((future.header.sequence, future.time_ns), (2, state(2).time_ns + 7));
    for message in [stale, future] {
        message.validate(HASH, N).unwrap();
    }
}

#[test]
fn a_repetition_before_the_first_message_is_silence() {
    let (mut publisher, subscriber) = in_process_link();
    let mut faulty = FaultInjector::new(subscriber, Fault::Repeated, Schedule::in_a_row(0, 2), 0);
    assert_eq!(run(&mut publisher, &mut faulty, 4), [None, None, Some(3), Some(4)]);
}

#[test]
fn the_damaged_number_follows_from_the_seed_and_any_number_can_be_hit() {
    let place = |seed| match struck(Fault::NotANumber, seed).validate(HASH, N).unwrap_err() {
        MessageError::NotFinite { field, index, .. } => (field, index),
        other => panic!("{other}"),
    };
    assert_eq!(place(1), place(1));
    let hit: std::collections::BTreeSet<_> = (0..2_000).map(place).collect();
    assert_eq!(hit.len(), 2 * N + 4 * 3 + 2 * 3);
}

#[test]
fn commands_can_be_damaged_too_and_damage_never_panics() {
    let mut command = Command::new(1, HASH, N as u32);
    for choice in 0..1_000 {
        let mut damaged = command;
        damaged.set_number(choice, f64::NAN);
        assert!(damaged.validate(HASH, N).is_err(), "choice {choice}");
    }
    command.shift_time(-5);
    assert_eq!(command.valid_until_ns, 0, "time does not wrap");
    for n_joints in [0, 33, u32::MAX] {
        command.n_joints = n_joints;
        command.set_number(u64::MAX, f64::NAN);
        command.add_joint();
    }
}

#[test]
fn all_faults_are_listed_once() {
    for (i, fault) in Fault::ALL.iter().enumerate() {
        assert!(!Fault::ALL[i + 1..].contains(fault));
    }
}
