//! Starts the real command, watches it, cleans up after it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use delmpc_transport::runtime_folder;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

/// Far beyond any healthy machine: reaching it means something hangs.
const WATCHDOG: Duration = Duration::from_secs(300);

pub fn main_scenario() -> String {
    concat!(env!("CARGO_MANIFEST_DIR"), "/configs/scenarios/atlas_one_foot.toml").to_owned()
}

/// A folder of a test's own, removed at its end.
pub struct Folder {
    path: PathBuf,
    number: u64,
}

impl Folder {
    pub fn new(name: &str) -> Self {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let number = (u64::from(std::process::id()) << 16) + COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("delmpc-test-{number:x}-{name}"));
        fs::create_dir_all(&path).unwrap();
        Self { path, number }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// A number no other test has.
    pub fn number(&self) -> u64 {
        self.number
    }

    pub fn summary(&self) -> Value {
        let text = fs::read_to_string(self.path.join("summary.json")).unwrap();
        serde_json::from_str(&text).unwrap()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.path);
    }
}

/// A started command; killed when it is dropped.
pub struct Delmpc(Option<Child>);

/// How a command ended.
pub struct Ended {
    pub status: Option<i32>,
    pub errors: String,
}

impl Ended {
    /// The run a lone process said it belongs to.
    pub fn run_id(&self) -> String {
        let after = self.errors.split("run ").nth(1).unwrap_or_default();
        after.chars().take(16).collect()
    }
}

impl Delmpc {
    /// The main scenario with results in `folder`.
    pub fn run(folder: &Folder, more: &[&str]) -> Self {
        let out = folder.path().to_str().unwrap();
        Self::start(&[&["run", &main_scenario(), "--quiet", "--out", out], more].concat())
    }

    pub fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
        command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        Self(Some(command.spawn().unwrap()))
    }

    pub fn pid(&self) -> u32 {
        self.0.as_ref().unwrap().id()
    }

    /// Waits for the end.
    pub fn wait(mut self) -> Ended {
        let mut child = self.0.take().unwrap();
        let mut errors = child.stderr.take().unwrap();
        let reader = std::thread::spawn(move || {
            let mut text = String::new();
            let _ = std::io::Read::read_to_string(&mut errors, &mut text);
            text
        });
        let begin = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break status;
            }
            if begin.elapsed() > WATCHDOG {
                let _ = child.kill();
                panic!("watchdog: the command hangs");
            }
            sleep(Duration::from_millis(2));
        };
        Ended { status: status.code(), errors: reader.join().unwrap() }
    }
}

impl Drop for Delmpc {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// A process of a run.
#[derive(Debug, Clone)]
pub struct Member {
    pub pid: u32,
    pub role: String,
    pub run_id: String,
}

/// The processes a supervisor has started.
pub fn children(supervisor: u32) -> Vec<Member> {
    let mut members = Vec::new();
    for task in fs::read_dir(format!("/proc/{supervisor}/task")).into_iter().flatten().flatten() {
        let list = fs::read_to_string(task.path().join("children")).unwrap_or_default();
        for pid in list.split_whitespace().filter_map(|pid| pid.parse().ok()) {
            let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let words: Vec<String> = line
                .split(|byte| *byte == 0)
                .map(|word| String::from_utf8_lossy(word).into_owned())
                .collect();
            let run_id = words.iter().skip_while(|word| *word != "--run-id").nth(1).cloned();
            if let (Some(role), Some(run_id)) = (words.get(1), run_id) {
                members.push(Member { pid, role: role.clone(), run_id });
            }
        }
    }
    members
}

pub fn member<'a>(family: &'a [Member], role: &str) -> &'a Member {
    family.iter().find(|member| member.role == role).unwrap()
}

pub fn signal(pid: u32, signal: Signal) {
    let _ = kill_process(Pid::from_raw(pid as i32).unwrap(), signal);
}

/// Zombies do not live.
pub fn is_alive(pid: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit(") ").next().is_some_and(|rest| !rest.is_empty() && !rest.starts_with(['Z', 'X']))
}

/// Names of what a run has in shared memory and in the user's private folder.
pub fn shared_memory_of(run_id: &str) -> Vec<String> {
    assert_eq!(run_id.len(), 16, "{run_id:?}");
    let mut names = Vec::new();
    for folder in [PathBuf::from("/dev/shm"), runtime_folder().unwrap()] {
        for entry in fs::read_dir(folder).unwrap().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.contains(run_id) {
                names.push(name);
            }
        }
    }
    names
}

/// Asks again and again until there is an answer.
pub fn wait_for<R>(what: &str, mut ask: impl FnMut() -> Option<R>) -> R {
    let begin = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(begin.elapsed() < WATCHDOG, "watchdog: waited in vain for {what}");
        sleep(Duration::from_millis(5));
    }
}
