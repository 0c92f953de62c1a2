//! A folder for each test, and the command with a watchdog.

use std::fs;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

pub const PROGRAM: &str = env!("CARGO_BIN_EXE_delmpc");
/// Far beyond any healthy machine: reaching it means something hangs.
const WATCHDOG: Duration = Duration::from_secs(120);
/// A short run of the lamp, reproducible.
pub const SHORT: [&str; 6] = ["--set", "clock=lockstep", "--set", "duration_s=0.1", "--no-report", "--quiet"];

pub fn lamp(file: &str) -> String {
    format!("{}/configs/examples/lamp/{file}", env!("CARGO_MANIFEST_DIR"))
}

pub fn atlas() -> String {
    concat!(env!("CARGO_MANIFEST_DIR"), "/configs/robots/atlas.urdf").to_owned()
}

/// A folder of a test's own, removed at its end.
pub struct Scratch(PathBuf);

impl Scratch {
    pub fn new(name: &str) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path =
            std::env::temp_dir().join(format!("delmpc-hostile-{}-{number}-{name}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    pub fn file(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().to_owned()
    }

    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        fs::write(self.0.join(name), content).unwrap();
        self.file(name)
    }

    /// The lamp with its table and its scenario, to be changed.
    pub fn with_lamp(name: &str) -> Self {
        let scratch = Self::new(name);
        for file in ["lamp.urdf", "lamp.toml", "reach.toml"] {
            fs::copy(lamp(file), scratch.0.join(file)).unwrap();
        }
        scratch
    }

    /// Replaces text in a file that has it.
    pub fn change(&self, name: &str, from: &str, to: &str) {
        let text = fs::read_to_string(self.0.join(name)).unwrap();
        assert!(text.contains(from), "{from:?} is not in {name}");
        self.write(name, text.replace(from, to));
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// How a command ended.
#[derive(Debug)]
pub struct Ended {
    pub status: Option<i32>,
    pub out: String,
    pub errors: String,
}

impl Ended {
    /// One or a few sentences, and this status; no panic.
    #[track_caller]
    pub fn assert(&self, status: i32, words: &[&str]) {
        assert_eq!(self.status, Some(status), "{self:?}");
        assert!(!self.errors.contains("panicked"), "{self:?}");
        for word in words {
            assert!(self.errors.contains(word), "{word:?} is not in {self:?}");
        }
    }
}

pub fn delmpc(arguments: &[&str]) -> Ended {
    let mut command = Command::new(PROGRAM);
    command.args(arguments);
    finish(command)
}

/// A run of a scenario into a folder of the scratch.
pub fn run(scratch: &Scratch, scenario: &str, more: &[&str]) -> Ended {
    let out = scratch.file("out");
    delmpc(&[&["run", scenario, "--out", &out], &SHORT[..], more].concat())
}

/// A command line of the shell.
pub fn shell(script: &str) -> Ended {
    let mut command = Command::new("bash");
    command.args(["-c", script]).env("DELMPC", PROGRAM).env("REACH", lamp("reach.toml"));
    finish(command)
}

/// The same where file systems can be mounted without anybody else seeing them; `None`: not permitted here.
pub fn in_private_mounts(test: &str, script: &str) -> Option<Ended> {
    let permitted = Command::new("unshare")
        .args(["-m", "bash", "-c", "mount -t tmpfs -o size=64k tmpfs /mnt"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !permitted {
        let _ =
            writeln!(std::io::stderr(), "SKIPPED {test}: no mount namespace of its own is permitted here");
        return None;
    }
    let mut command = Command::new("unshare");
    command.args(["-m", "bash", "-c", script]).env("DELMPC", PROGRAM).env("REACH", lamp("reach.toml"));
    Some(finish(command))
}

pub fn finish(mut command: Command) -> Ended {
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let (out, errors) = (drain(child.stdout.take()), drain(child.stderr.take()));
    let status = wait(&mut child);
    Ended { status, out: out.join().unwrap(), errors: errors.join().unwrap() }
}

/// Its exit status; a process that hangs is killed, and the test fails.
pub fn wait(child: &mut Child) -> Option<i32> {
    let begin = Instant::now();
    loop {
        if let Some(status) = child.try_wait().unwrap() {
            return status.code();
        }
        if begin.elapsed() > WATCHDOG {
            let _ = child.kill();
            panic!("watchdog: the command hangs");
        }
        sleep(Duration::from_millis(2));
    }
}

fn drain(stream: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<String> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut stream) = stream {
            let _ = stream.read_to_end(&mut bytes);
        }
        String::from_utf8_lossy(&bytes).into_owned()
    })
}
