//! Recording and replay: the same bits again, in the same calls, and damage is told.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests, too

use bytemuck::bytes_of;
use delmpc_messages::{Command, Heartbeat, Message, PlantState, Role};
use delmpc_transport::{
    Delay, InProcessPublisher, LinkError, Lossy, Publisher, Record, Replay, Schedule, Subscriber,
    in_process_link,
};

const HASH: u64 = 2;
const N: usize = 30;

fn state(sequence: u64) -> PlantState {
    let mut state = PlantState::new(1, HASH, N as u32);
    state.header.sequence = sequence;
    state.time_ns = 10_000_000_000 + sequence;
    state.velocity[29] = sequence as f64;
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

/// Records 200 calls over a lossy, late, jittery link; gives what each call received and the recording.
fn recorded() -> (Vec<Option<PlantState>>, Vec<u8>) {
    let (mut publisher, subscriber) = in_process_link();
    let link = Delay::in_cycles(Lossy::new(subscriber, Schedule::random(0.3, 9)), 1).with_jitter(2, 4);
    let mut recorded = Record::new(link, Vec::new());
    let mut received = Vec::new();
    for sequence in 1..=200 {
        publisher.send(&state(sequence)).unwrap();
        received.push(recorded.receive_latest().unwrap().copied());
    }
    (received, recorded.finish().unwrap().1)
}

#[test]
fn a_replay_gives_every_call_bit_by_bit_what_was_recorded_also_nothing() {
    let (received, file) = recorded();
    assert!(received.iter().any(Option::is_none) && received.iter().any(Option::is_some));
    let mut replay = Replay::<PlantState, _>::new(file.as_slice()).unwrap();
    for original in &received {
        let replayed = replay.receive_latest().unwrap();
        assert_eq!(replayed.map(bytes_of), original.as_ref().map(bytes_of));
    }
    assert!(replay.is_finished());
    assert_eq!(replay.receive_latest().unwrap(), None);
}

#[test]
fn a_recording_of_a_replay_is_the_same_file() {
    let (received, file) = recorded();
    let replay = Replay::<PlantState, _>::new(file.as_slice()).unwrap();
    let mut again = Record::new(replay, Vec::new());
    for _ in &received {
        again.receive_latest().unwrap();
    }
    assert_eq!(again.finish().unwrap().1, file);
}

#[test]
fn not_a_number_is_replayed_as_the_same_bits() {
    let (mut publisher, subscriber) = in_process_link();
    let mut recorded = Record::new(subscriber, Vec::new());
    let mut odd = state(1);
    odd.position[0] = f64::from_bits(0x7ff8_dead_beef_0001);
    publisher.send(&odd).unwrap();
    recorded.receive_latest().unwrap();
    let file = recorded.finish().unwrap().1;
    let mut replay = Replay::<PlantState, _>::new(file.as_slice()).unwrap();
    assert_eq!(bytes_of(replay.receive_latest().unwrap().unwrap()), bytes_of(&odd));
}

#[test]
fn the_sending_end_can_be_recorded_too() {
    let (publisher, mut subscriber) = in_process_link();
    let mut recorded = Record::<PlantState, _, _>::new(publisher, Vec::new());
    recorded.send(&state(1)).unwrap();
    recorded.send(&state(2)).unwrap();
    assert_eq!(subscriber.receive_latest().unwrap(), Some(&state(2)));
    let file = recorded.finish().unwrap().1;
    let mut replay = Replay::<PlantState, _>::new(file.as_slice()).unwrap();
    assert_eq!(replay.receive_latest().unwrap(), Some(&state(1)));
    assert_eq!(replay.receive_latest().unwrap(), Some(&state(2)));
}

#[test]
fn the_file_format_is_the_documented_one() {
    let (mut publisher, subscriber) = in_process_link();
    let mut recorded = Record::new(subscriber, Vec::new());
    let heartbeat = Heartbeat::new(1, 0, Role::Plant, 1);
    recorded.receive_latest().unwrap();
    publisher.send(&heartbeat).unwrap();
    recorded.receive_latest().unwrap();
    let file = recorded.finish().unwrap().1;
    let mut expected = b"DELMPCR1".to_vec();
    expected.extend(Heartbeat::MAGIC.to_le_bytes());
    expected.extend(1_u32.to_le_bytes());
    expected.extend(64_u64.to_le_bytes());
    expected.extend(1_u64.to_le_bytes()); // the second call
    expected.extend(bytes_of(&heartbeat));
    assert_eq!(file, expected);
}

fn replay_error<T: Message>(file: &[u8]) -> String {
    let Err(error) = Replay::<T, _>::new(file) else { panic!("must be refused") };
    error.to_string()
}

#[test]
fn what_is_no_recording_of_this_message_is_refused() {
    let (_, file) = recorded();
    assert!(replay_error::<Command>(&file).contains("another message"));
    assert!(replay_error::<PlantState>(b"no recording at all, only text").contains("not a recording"));
    assert!(replay_error::<PlantState>(&file[..10]).contains("delmpc/PlantState/v2"));
    let mut newer = file;
    newer[12] = 3;
    assert!(replay_error::<PlantState>(&newer).contains("another version (3)"));
}

#[test]
fn a_recording_that_breaks_off_gives_all_whole_messages_and_then_says_so() {
    let (mut publisher, subscriber) = in_process_link();
    let mut recorded = Record::new(subscriber, Vec::new());
    run(&mut publisher, &mut recorded, 3);
    let file = recorded.finish().unwrap().1;
    let mut replay = Replay::<PlantState, _>::new(&file[..file.len() - 1]).unwrap();
    assert_eq!(replay.receive_latest().unwrap(), Some(&state(1)));
    assert_eq!(replay.receive_latest().unwrap(), Some(&state(2)));
    assert!(!replay.is_finished());
    let error = replay.receive_latest().unwrap_err();
    assert!(matches!(error, LinkError::RecordingNotReadable { record: 2, .. }), "{error}");
    assert!(error.to_string().contains("breaks off"), "{error}");
    assert!(replay.is_finished());
    assert_eq!(replay.receive_latest().unwrap(), None);
}

/// A disk with room for some bytes.
struct SmallDisk(usize);

impl std::io::Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 = self.0.checked_sub(bytes.len()).ok_or(std::io::ErrorKind::StorageFull)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn a_full_disk_does_not_disturb_the_link_and_is_told_at_the_end() {
    let (mut publisher, subscriber) = in_process_link();
    let mut recorded = Record::new(subscriber, SmallDisk(2_000));
    let received = run(&mut publisher, &mut recorded, 4);
    assert_eq!(received, [Some(1), Some(2), Some(3), Some(4)]);
    let Err(error) = recorded.finish() else { panic!("the failure must be told") };
    assert!(matches!(error, LinkError::RecordingNotWritten { .. }), "{error}");
}
