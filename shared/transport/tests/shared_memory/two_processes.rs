//! Both ends in real processes: this test binary starts itself again as the peer.

use std::path::PathBuf;
use std::process::{Child, Command as Process, Stdio};
use std::thread::sleep;
use std::time::{Duration, SystemTime};

use bytemuck::bytes_of;
use delmpc_messages::{Command, PlantState};
use delmpc_transport::{
    Channel, PeerWatch, Publisher, RunNode, SplitMix64, Subscriber, remove_dead_runs, remove_leftovers,
};

use crate::support::{HASH, TestRun, next, serve_until, wait_for};

const RUN: &str = "DELMPC_TEST_RUN";
const ROLE: &str = "DELMPC_TEST_ROLE";

/// A peer process; killed at the latest when it goes out of scope.
struct Peer(Child);

impl Peer {
    fn start(run: &TestRun, role: &str) -> Self {
        let child = Process::new(std::env::current_exe().unwrap())
            .args(["--exact", "two_processes::peer", "--ignored", "--nocapture"])
            .env(RUN, run.0.to_string())
            .env(ROLE, role)
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Self(child)
    }

    fn kill_9(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }

    fn wait_for_success(mut self) {
        let status = wait_for("the peer to end", || self.0.try_wait().unwrap());
        assert!(status.success(), "{status}");
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Not a test of its own: what the other process does.
#[test]
#[ignore = "started by the other tests as their peer process"]
fn peer() {
    let (Ok(run), Ok(role)) = (std::env::var(RUN), std::env::var(ROLE)) else { return };
    let run = std::mem::ManuallyDrop::new(TestRun(run.parse().unwrap())); // the parent removes leftovers
    let node = RunNode::open(run.0, HASH).unwrap();
    match role.as_str() {
        "answer states until state 0" => answer_states(&run, &node),
        "publish states" => publish_states(&run, &node),
        other => panic!("unknown role {other}"),
    }
}

fn answer_states(run: &TestRun, node: &RunNode) {
    let mut states = node.subscriber::<PlantState>(Channel::State).unwrap();
    let mut commands = node.publisher::<Command>(Channel::Command).unwrap();
    loop {
        let mut state = None;
        serve_until(&mut commands, "a state", || {
            state = states.receive_latest().unwrap().copied();
            state.is_some()
        });
        match state.unwrap().header.sequence {
            0 => return,
            sequence => commands.send(&run.command(sequence)).unwrap(),
        }
    }
}

/// Counts from 1 until killed; the watchdog ends it if nobody does.
fn publish_states(run: &TestRun, node: &RunNode) {
    let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut sequence = 0;
    wait_for("being killed", || -> Option<()> {
        sequence += 1;
        states.send(&run.state(sequence)).unwrap();
        None
    });
}

#[test]
fn states_and_commands_cross_between_processes_bit_by_bit() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut commands = node.subscriber::<Command>(Channel::Command).unwrap();
    let peer = Peer::start(&run, "answer states until state 0");
    for sequence in 1..=500 {
        states.send(&run.state(sequence)).unwrap();
        let mut answer = None;
        serve_until(&mut states, "the answer of the peer", || {
            answer = commands.receive_latest().unwrap().copied();
            answer.is_some()
        });
        assert_eq!(bytes_of(&answer.unwrap()), bytes_of(&run.command(sequence)));
    }
    states.send(&run.state(0)).unwrap();
    peer.wait_for_success();
}

#[test]
fn the_same_subscriber_goes_on_after_kill_9_and_restart_of_the_publisher() {
    const KILLS: u32 = 5;
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.subscriber::<PlantState>(Channel::State).unwrap();
    let mut watch = PeerWatch::new(1, 0);
    let mut files = 0;
    for life in 1..=KILLS {
        let mut peer = Peer::start(&run, "publish states");
        // Restarted publishers count from 1 again; wait until this one has gone some way.
        let first = next(&mut states);
        assert_eq!(bytes_of(&first), bytes_of(&run.state(first.header.sequence)));
        watch.saw(first.header.sequence, u64::from(life) * 10);
        wait_for("more states", || {
            let state = states.receive_latest().unwrap().copied();
            state.filter(|s| s.header.sequence > first.header.sequence + 20).map(|s| {
                watch.saw(s.header.sequence, u64::from(life) * 10);
            })
        });
        peer.kill_9();
        let _ = states.receive_latest().unwrap(); // what was on its way
        assert_eq!(states.receive_latest().unwrap(), None, "a dead publisher sends nothing");
        assert!(!watch.is_alive(u64::from(life) * 10 + 2));
        files = if life == 1 { run.files().len() } else { files };
        assert!(run.files().len() <= files, "leftovers pile up: {:?}", run.files());
    }
    assert_eq!(watch.restarts(), KILLS - 1);
}

#[test]
fn a_publisher_goes_on_when_its_subscriber_is_killed_and_started_again() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.publisher::<PlantState>(Channel::State).unwrap();
    let mut commands = node.subscriber::<Command>(Channel::Command).unwrap();
    let mut sequence = 0;
    for _life in 0..3 {
        let mut peer = Peer::start(&run, "answer states until state 0");
        sequence += 1;
        states.send(&run.state(sequence)).unwrap();
        serve_until(&mut states, "the answer", || {
            let answer = commands.receive_latest().unwrap();
            answer.is_some_and(|command| command.state_sequence == sequence)
        });
        peer.kill_9();
        for _ in 0..50 {
            sequence += 1;
            states.send(&run.state(sequence)).unwrap();
        }
    }
}

#[test]
fn leftovers_of_killed_processes_are_removed() {
    let run = TestRun::new();
    let mut publisher = Peer::start(&run, "publish states");
    let mut subscriber = Peer::start(&run, "answer states until state 0");
    {
        let node = RunNode::open(run.0, HASH).unwrap();
        let mut commands = node.subscriber::<Command>(Channel::Command).unwrap();
        next(&mut commands); // both are in the middle of their work
    }
    publisher.kill_9();
    assert!(remove_leftovers(run.0).is_err(), "the subscriber still lives");
    subscriber.kill_9();
    assert!(!run.files().is_empty(), "killed processes leave files");
    assert!(remove_leftovers(run.0).unwrap() > 0);
    assert_eq!(run.files(), Vec::<PathBuf>::new());
}

#[test]
#[allow(clippy::disallowed_methods, reason = "ages of files go by the wall clock")]
fn dead_runs_are_removed_and_living_or_young_ones_are_not() {
    let (dead, living, young) = (TestRun::new(), TestRun::new(), TestRun::new());
    for run in [&dead, &young] {
        let mut peer = Peer::start(run, "publish states");
        wait_for("the peer's files", || (run.files().len() > 3).then_some(()));
        peer.kill_9();
    }
    let _node = RunNode::open(living.0, HASH).unwrap();
    let long_ago = SystemTime::now() - Duration::from_secs(60);
    for file in dead.files().into_iter().chain(living.files()) {
        std::fs::File::open(file).unwrap().set_modified(long_ago).unwrap();
    }
    let removed = remove_dead_runs(Duration::from_secs(30), || false);
    assert!(removed.contains(&dead.0));
    assert!(!removed.contains(&living.0) && !removed.contains(&young.0));
    assert_eq!(dead.files(), Vec::<PathBuf>::new());
    assert!(!living.files().is_empty() && !young.files().is_empty());
}

/// A login with another folder for its runs, of the same user, goes on while this one tidies up.
#[test]
#[allow(clippy::disallowed_methods, reason = "ages of files go by the wall clock")]
fn a_run_of_another_login_that_lives_is_not_touched() {
    let run = TestRun::new();
    let elsewhere = std::env::temp_dir().join(format!("delmpc-elsewhere-{}", std::process::id()));
    std::fs::create_dir_all(&elsewhere).unwrap();
    std::fs::set_permissions(&elsewhere, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
    let mut peer = Peer(
        Process::new(std::env::current_exe().unwrap())
            .args(["--exact", "two_processes::peer", "--ignored", "--nocapture"])
            .env(RUN, run.0.to_string())
            .env(ROLE, "publish states")
            .env("XDG_RUNTIME_DIR", &elsewhere)
            .stdout(Stdio::null())
            .spawn()
            .unwrap(),
    );
    wait_for("the peer's files", || (run.files().len() > 1).then_some(()));
    sleep(Duration::from_millis(200));
    let long_ago = SystemTime::now() - Duration::from_secs(60);
    let files = run.files();
    for file in &files {
        std::fs::File::open(file).unwrap().set_modified(long_ago).unwrap();
    }
    assert!(!remove_dead_runs(Duration::from_secs(30), || false).contains(&run.0));
    assert_eq!(run.files(), files);
    peer.kill_9();
    assert!(remove_dead_runs(Duration::from_secs(30), || false).contains(&run.0));
    assert_eq!(run.files(), Vec::<PathBuf>::new());
    std::fs::remove_dir_all(&elsewhere).unwrap();
}

#[test]
fn a_process_killed_at_any_moment_of_its_start_does_not_block_the_next_one() {
    let run = TestRun::new();
    let mut random = SplitMix64::new(20);
    for _ in 0..20 {
        let mut peer = Peer::start(&run, "publish states");
        sleep(Duration::from_micros(random.up_to(15_000)));
        peer.kill_9();
    }
    let _peer = Peer::start(&run, "publish states");
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.subscriber::<PlantState>(Channel::State).unwrap();
    next(&mut states);
}

/// iceoryx2 by itself would wait for ever for the size of this file.
#[test]
fn shared_memory_of_a_process_killed_before_it_got_a_size_hangs_nobody() {
    let run = TestRun::new();
    let mut peer = Peer::start(&run, "publish states");
    let dynamic = wait_for("the peer's channel", || {
        run.files().into_iter().find(|file| file.extension().is_some_and(|suffix| suffix == "dynamic"))
    });
    peer.kill_9();
    let half_made = std::fs::File::create(dynamic).unwrap();
    half_made.set_permissions(std::os::unix::fs::PermissionsExt::from_mode(0o200)).unwrap();

    let _peer = Peer::start(&run, "publish states");
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut states = node.subscriber::<PlantState>(Channel::State).unwrap();
    next(&mut states);
}
