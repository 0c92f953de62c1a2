//! The log of a run in the hands of others: replayed bit by bit by ourselves, read by an independent MCAP reader.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn run_of(name: &str, more: &[&str]) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("log-{name}"));
    let out = folder.to_str().unwrap();
    let arguments = ["run", "--quiet", "--set", "clock=lockstep", "--set", "duration_s=0.4", "--out", out];
    let output = delmpc(&[&arguments[..], more].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    folder
}

fn delmpc(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
    command.args(arguments).current_dir(ROOT).stdin(Stdio::null()).output().unwrap()
}

fn verify(folder: &Path) -> (Option<i32>, String) {
    let output = delmpc(&["replay", folder.to_str().unwrap(), "--verify"]);
    (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
}

#[test]
fn a_lockstep_run_is_replayed_bit_by_bit() {
    let folder = run_of("replay", &["--no-report"]);
    let (status, text) = verify(&folder);
    assert_eq!((status, text.as_str()), (Some(0), "the same bits: 401 steps, 81 states, 80 commands\n"));

    // Another world gives other bits, and the first difference is told.
    let scenario = folder.join("scenario.toml");
    let changed = std::fs::read_to_string(&scenario).unwrap().replace("seed = 1\n", "seed = 2\n");
    std::fs::write(&scenario, changed).unwrap();
    let (status, text) = verify(&folder);
    assert_eq!(status, Some(1), "{text}");
    assert!(text.starts_with("the state at 0.0000 s differs from the log"), "{text}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn the_mcap_package_reads_the_log() {
    let python = |arguments: &[&str]| Command::new("python3").args(arguments).stdin(Stdio::null()).output();
    let available =
        python(&["-c", "import mcap.reader, tomllib"]).is_ok_and(|output| output.status.success());
    if !available {
        // Past the capture of the test harness: who runs this should know.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED the_mcap_package_reads_the_log: needs python3 and `pip install mcap`"
        );
        return;
    }
    let folder = run_of("python", &["--no-report"]);
    let script = Path::new(ROOT).join("tests/log/check_log.py");
    let output = python(&[script.to_str().unwrap(), folder.to_str().unwrap()]).unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    std::fs::remove_dir_all(folder).unwrap();
}
