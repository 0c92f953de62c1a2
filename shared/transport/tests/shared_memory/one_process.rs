//! Both ends in one process, each through a node of its own.

use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::{Pod, Zeroable, bytes_of};
use delmpc_messages::{Command, Header, Heartbeat, Message, PlantState, Role};
use delmpc_transport::{Channel, LinkError, Publisher, RunNode, SharedSubscriber, Subscriber};
use iceoryx2::prelude::ZeroCopySend;

use crate::support::{HASH, N, TestRun, next, serve_until};

#[test]
fn what_is_sent_arrives_bit_by_bit_and_once() {
    let run = TestRun::new();
    let (plant, controller) = (RunNode::open(run.0, HASH).unwrap(), RunNode::open(run.0, HASH).unwrap());
    let mut states_out = plant.publisher::<PlantState>(Channel::State).unwrap();
    let mut states_in = controller.subscriber::<PlantState>(Channel::State).unwrap();
    let mut commands_out = controller.publisher::<Command>(Channel::Command).unwrap();
    let mut commands_in = plant.subscriber::<Command>(Channel::Command).unwrap();

    assert_eq!(states_in.receive_latest().unwrap(), None, "nothing was sent yet");
    for sequence in 1..=100 {
        let (state, command) = (run.state(sequence), run.command(sequence));
        states_out.send(&state).unwrap();
        let received = states_in.receive_latest().unwrap().unwrap();
        assert_eq!(bytes_of(received), bytes_of(&state));
        received.validate(HASH, N as usize).unwrap();
        assert_eq!(states_in.receive_latest().unwrap(), None, "a message arrives once");

        commands_out.send(&command).unwrap();
        let received = commands_in.receive_latest().unwrap().unwrap();
        assert_eq!(bytes_of(received), bytes_of(&command));
        received.validate(HASH, N as usize).unwrap();
    }
}

#[test]
fn only_the_latest_message_arrives() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
    for sequence in 1..=1_000 {
        publisher.send(&run.state(sequence)).unwrap();
    }
    assert_eq!(subscriber.receive_latest().unwrap().map(|s| s.header.sequence), Some(1_000));
    assert_eq!(subscriber.receive_latest().unwrap(), None);
}

#[test]
fn a_message_given_out_is_not_overwritten_by_later_ones() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
    publisher.send(&run.state(1)).unwrap();
    let held = subscriber.receive_latest().unwrap().unwrap();
    for sequence in 2..=100 {
        publisher.send(&run.state(sequence)).unwrap();
        assert_eq!(bytes_of(held), bytes_of(&run.state(1)));
    }
}

/// A subscriber gives messages back some at a time; whatever it skips in between, the sender never runs out of memory for the next one.
#[test]
fn the_latest_message_arrives_however_many_are_skipped() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut subscribers = [0; 3].map(|_| node.subscriber::<PlantState>(Channel::State).unwrap());
    let mut sequence = 0;
    for turn in 0..200 {
        for _ in 0..=turn % 7 {
            sequence += 1;
            states.send(&run.state(sequence)).unwrap();
        }
        for (k, subscriber) in subscribers.iter_mut().enumerate() {
            if turn % (k + 1) == 0 {
                let given = subscriber.receive_latest().unwrap().unwrap();
                assert_eq!(bytes_of(given), bytes_of(&run.state(sequence)));
            }
        }
    }
}

/// Then there is often one more message at the second look.
#[test]
fn a_subscriber_keeps_up_with_a_sender_that_never_rests() {
    const MESSAGES: u64 = 50_000;
    let run = TestRun::new();
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let node = RunNode::open(run.0, HASH).unwrap();
            let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
            for sequence in 1..=MESSAGES {
                states.send(&run.state(sequence)).unwrap();
            }
            serve_until(&mut states, "the other thread", || done.load(Ordering::Acquire));
        });
        let node = RunNode::open(run.0, HASH).unwrap();
        let mut subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
        let mut last = 0;
        while last < MESSAGES {
            let state = next(&mut subscriber);
            assert!(state.header.sequence > last, "{} after {last}", state.header.sequence);
            last = state.header.sequence;
            assert_eq!(bytes_of(&state), bytes_of(&run.state(last)));
        }
        done.store(true, Ordering::Release);
    });
}

#[test]
fn the_order_of_joining_does_not_matter() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut early = node.subscriber::<PlantState>(Channel::State).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    publisher.send(&run.state(1)).unwrap();
    let mut late = node.subscriber::<PlantState>(Channel::State).unwrap();
    assert_eq!(next(&mut early).header.sequence, 1);
    publisher.serve_newcomers().unwrap();
    assert_eq!(next(&mut late).header.sequence, 1, "a newcomer gets the latest message");
    assert_eq!(early.receive_latest().unwrap(), None, "who had it does not get it again");
}

#[test]
fn two_threads_exchange_states_and_commands() {
    const EXCHANGES: u64 = 2_000;
    let run = TestRun::new();
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let node = RunNode::open(run.0, HASH).unwrap();
            let mut states = node.subscriber::<PlantState>(Channel::State).unwrap();
            let mut commands = node.publisher::<Command>(Channel::Command).unwrap();
            loop {
                let sequence = next(&mut states).header.sequence;
                commands.send(&run.command(sequence)).unwrap();
                if sequence == EXCHANGES {
                    break serve_until(&mut commands, "the other thread", || done.load(Ordering::Acquire));
                }
            }
        });
        let node = RunNode::open(run.0, HASH).unwrap();
        let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
        let mut commands = node.subscriber::<Command>(Channel::Command).unwrap();
        for sequence in 1..=EXCHANGES {
            states.send(&run.state(sequence)).unwrap();
            let mut answer = None;
            serve_until(&mut states, "the answer", || {
                answer = commands.receive_latest().unwrap().copied();
                answer.is_some()
            });
            assert_eq!(bytes_of(&answer.unwrap()), bytes_of(&run.command(sequence)));
        }
        done.store(true, Ordering::Release);
    });
}

#[test]
fn another_joint_set_is_refused_at_connect_with_both_hashes() {
    let run = TestRun::new();
    let (ours, theirs) = (RunNode::open(run.0, HASH).unwrap(), RunNode::open(run.0, 0xbad).unwrap());
    let _states = ours.publisher::<PlantState>(Channel::State).unwrap();
    let error = theirs.subscriber::<PlantState>(Channel::State).unwrap_err();
    assert!(
        matches!(error, LinkError::JointSetMismatch { channel: "state", found: HASH, ours: 0xbad }),
        "{error}"
    );
    assert!(error.to_string().contains("the same robot file"), "{error}");
}

#[test]
fn heartbeats_connect_whatever_the_joint_set() {
    let run = TestRun::new();
    let (plant, supervisor) = (RunNode::open(run.0, HASH).unwrap(), RunNode::open(run.0, 0).unwrap());
    let mut out = plant.publisher::<Heartbeat>(Channel::Heartbeat(Role::Plant)).unwrap();
    let mut heard = supervisor.subscriber::<Heartbeat>(Channel::Heartbeat(Role::Plant)).unwrap();
    out.send(&Heartbeat::new(run.0.0, HASH, Role::Plant, 4711)).unwrap();
    let heartbeat = next(&mut heard);
    assert_eq!((heartbeat.role(), heartbeat.pid), (Some(Role::Plant), 4711));
    assert_eq!(heartbeat.header.joint_set_hash, HASH);
}

#[test]
fn another_message_type_is_refused_by_name() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let _states = node.publisher::<PlantState>(Channel::State).unwrap();
    let error = node.subscriber::<Command>(Channel::State).unwrap_err();
    let LinkError::IncompatiblePayload { channel, found, ours } = &error else { panic!("{error}") };
    assert_eq!((*channel, found.as_str(), *ours), ("state", PlantState::NAME, Command::NAME));
}

/// A later version of [`PlantState`] with the same size.
#[derive(Debug, Clone, Copy, Pod, Zeroable, ZeroCopySend)]
#[repr(C)]
#[type_name("delmpc/PlantState/v3")]
struct PlantStateV3 {
    state: PlantState,
}

impl Message for PlantStateV3 {
    const NAME: &'static str = "delmpc/PlantState/v3";
    const MAGIC: u32 = PlantState::MAGIC;
    const VERSION: u32 = 3;

    fn header(&self) -> &Header {
        &self.state.header
    }

    fn header_mut(&mut self) -> &mut Header {
        &mut self.state.header
    }
}

#[test]
fn another_version_is_refused_by_name_even_with_the_same_size() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let _states = node.publisher::<PlantState>(Channel::State).unwrap();
    let result: Result<SharedSubscriber<PlantStateV3>, LinkError> = node.subscriber(Channel::State);
    let text = result.unwrap_err().to_string();
    assert!(text.contains("delmpc/PlantState/v2") && text.contains("delmpc/PlantState/v3"), "{text}");
}

#[test]
fn a_second_living_publisher_is_refused() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let first = node.publisher::<PlantState>(Channel::State).unwrap();
    let error = node.publisher::<PlantState>(Channel::State).unwrap_err();
    assert!(matches!(error, LinkError::Occupied { channel: "state", end: "publisher", .. }), "{error}");
    drop(first);
    node.publisher::<PlantState>(Channel::State).unwrap();
}

#[test]
fn parallel_runs_do_not_meet() {
    let (run, other) = (TestRun::new(), TestRun::new());
    let (node, other_node) = (RunNode::open(run.0, HASH).unwrap(), RunNode::open(other.0, 0xbad).unwrap());
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut other_publisher = other_node.publisher::<PlantState>(Channel::State).unwrap();
    let mut subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
    let mut other_subscriber = other_node.subscriber::<PlantState>(Channel::State).unwrap();

    publisher.send(&run.state(1)).unwrap();
    assert_eq!(other_subscriber.receive_latest().unwrap(), None);
    other_publisher.send(&other.state(2)).unwrap();
    assert_eq!(other_subscriber.receive_latest().unwrap(), Some(&other.state(2)));
    assert_eq!(subscriber.receive_latest().unwrap(), Some(&run.state(1)));
}

#[test]
fn ports_outlive_their_node() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
    drop(node);
    publisher.send(&run.state(1)).unwrap();
    assert_eq!(next(&mut subscriber), run.state(1));
}
