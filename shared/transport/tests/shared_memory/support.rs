//! A run of its own for each test, a watchdog, and messages.

use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use delmpc_messages::{Command, PlantState, joint_set_hash};
use delmpc_transport::{Publisher, RunId, Subscriber, remove_leftovers, runtime_folder};

pub const HASH: u64 = joint_set_hash(&["hip", "knee", "ankle"]);
pub const N: u32 = 3;

/// Far beyond any healthy machine: reaching it means something hangs.
const WATCHDOG: Duration = Duration::from_secs(60);

/// A run no other test has; whatever it leaves is removed at the end.
pub struct TestRun(pub RunId);

impl TestRun {
    pub fn new() -> Self {
        Self(RunId::random().unwrap())
    }

    pub fn state(&self, sequence: u64) -> PlantState {
        let mut state = PlantState::new(self.0.0, HASH, N);
        state.header.sequence = sequence;
        state.time_ns = sequence * 1_000_000;
        state.position[0] = 0.1 * sequence as f64;
        state
    }

    pub fn command(&self, sequence: u64) -> Command {
        let mut command = Command::new(self.0.0, HASH, N);
        command.header.sequence = sequence;
        command.state_sequence = sequence;
        command.gain[2][34] = -0.3 * sequence as f64;
        command
    }

    /// Files of this run in /dev/shm and in its own folder.
    pub fn files(&self) -> Vec<PathBuf> {
        let id = self.0.to_string();
        let mut files = Vec::new();
        for folder in [PathBuf::from("/dev/shm"), runtime_folder().unwrap()] {
            for entry in std::fs::read_dir(folder).unwrap().flatten() {
                if entry.file_name().to_string_lossy().contains(&id) {
                    files.push(entry.path());
                }
            }
        }
        files
    }
}

impl Drop for TestRun {
    fn drop(&mut self) {
        let _ = remove_leftovers(self.0);
    }
}

/// Asks again and again until there is an answer.
pub fn wait_for<R>(what: &str, mut ask: impl FnMut() -> Option<R>) -> R {
    let begin = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(begin.elapsed() < WATCHDOG, "watchdog: waited in vain for {what}");
        sleep(Duration::from_micros(200));
    }
}

/// The next message, whenever it comes.
pub fn next<T: Copy>(subscriber: &mut impl Subscriber<T>) -> T {
    wait_for("a message", || subscriber.receive_latest().unwrap().copied())
}

/// Hands the latest message to whoever joins, until `done` says so.
pub fn serve_until<T>(publisher: &mut impl Publisher<T>, what: &str, mut done: impl FnMut() -> bool) {
    wait_for(what, || {
        publisher.serve_newcomers().unwrap();
        done().then_some(())
    });
}
