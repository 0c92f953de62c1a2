//! Plants that are not ours: any command in the place of our plant, the duties it has, another language, another simulator.
//!
//! Tests that need packages of Python say so when they skip: numpy, and for MuJoCo `mujoco` and `iceoryx2`. DELMPC_PYTHON names another
//! interpreter than python3.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const DELMPC: &str = env!("CARGO_BIN_EXE_delmpc");

fn folder(name: &str) -> PathBuf {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("foreign-{name}"));
    let _ = fs::remove_dir_all(&folder);
    folder
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(DELMPC);
    command.args(arguments).current_dir(ROOT).stdin(Stdio::null());
    command
}

fn delmpc(arguments: &[&str]) -> Output {
    command(arguments).output().unwrap()
}

fn words(output: &Output) -> String {
    String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned()
}

/// Our own plant, as somebody else would start it.
fn our_plant() -> String {
    format!("exec '{DELMPC}' plant \"$DELMPC_SCENARIO\" --run-id \"$DELMPC_RUN_ID\" --supervised")
}

fn python() -> String {
    std::env::var("DELMPC_PYTHON").unwrap_or_else(|_| "python3".to_owned())
}

/// Whether Python has these packages; says so when it has not.
fn python_has(packages: &str) -> bool {
    let asked = Command::new(python()).args(["-c", &format!("import {packages}")]).output();
    let has = asked.is_ok_and(|output| output.status.success());
    if !has {
        println!("skipped: {} without the packages {packages}", python());
    }
    has
}

#[test]
fn our_own_plant_does_every_duty() {
    let output = delmpc(&["plant-check", &our_plant(), "--json"]);
    let duties: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let missed: Vec<&Value> = duties.iter().filter(|duty| duty["met"] == false).collect();
    assert!(duties.len() > 20 && missed.is_empty(), "{missed:#?}\n{}", words(&output));
    assert_eq!(output.status.code(), Some(0));
}

#[test]
fn a_plant_without_duties_misses_them() {
    let output = delmpc(&["plant-check", "echo 'no licence for this simulator' >&2; exit 7"]);
    let said = words(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("✗ sends an initial state") && said.contains("no licence"), "{said}");
}

#[test]
fn a_run_with_our_plant_as_a_foreign_one_is_judged_as_with_it_as_ours() {
    let (ours, foreign) = (folder("ours"), folder("other"));
    let settings = ["--set", "clock=lockstep", "--set", "duration_s=0.4", "--no-report", "--json", "--quiet"];
    let figures = |folder: &PathBuf, more: &[&str]| {
        let output = delmpc(&[&["run", "--out", folder.to_str().unwrap()], &settings[..], more].concat());
        assert_eq!(output.status.code(), Some(0), "{}", words(&output));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let (ours_found, found) = (figures(&ours, &[]), figures(&foreign, &["--plant", &our_plant()]));
    for key in
        ["fell", "cycles", "qp_solves", "log_records_dropped", "commands_refused", "other_foot_touched"]
    {
        assert_eq!(found[key], ours_found[key], "{key}");
    }
    assert!((found["duration_s"].as_f64().unwrap() - 0.4).abs() < 1e-9);
    // The other one tells its state, with noise, every cycle: that is what it is judged by.
    let margin = |of: &Value| of["min_cop_margin_m"].as_f64().unwrap();
    assert!(
        (margin(&found) - margin(&ours_found)).abs() < 3e-3,
        "{} {}",
        margin(&found),
        margin(&ours_found)
    );

    let replayed = delmpc(&["replay", foreign.to_str().unwrap(), "--verify"]);
    let said = words(&replayed);
    assert_eq!(replayed.status.code(), Some(0), "{said}");
    assert!(said.contains("81 states, 80 commands") && said.contains("the plant was not ours"), "{said}");
    fs::remove_dir_all(ours).unwrap();
    fs::remove_dir_all(foreign).unwrap();
}

#[test]
fn what_a_foreign_plant_says_last_is_why_the_run_broke_off() {
    let out = folder("broken");
    let output = delmpc(&[
        "run",
        "--quiet",
        "--no-report",
        "--out",
        out.to_str().unwrap(),
        "--plant",
        "echo 'no licence for this simulator' >&2; exit 7",
    ]);
    let said = words(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("exit status 7: no licence for this simulator"), "{said}");
    fs::remove_dir_all(out).unwrap();
}

/// A debugger's pause is a pause: much longer than what counts as a hang in real time.
#[test]
fn in_lockstep_a_plant_that_was_stopped_goes_on() {
    let out = folder("stopped");
    let run = command(&["run", "--no-report", "--set", "clock=lockstep", "--set", "duration_s=0.6"])
        .args(["--set", "process.hang_s=0.3", "--out", out.to_str().unwrap()])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let plant = loop {
        let messages = fs::read_to_string(out.join("messages.txt")).unwrap_or_default();
        let pid =
            messages.split("plant process ").nth(1).and_then(|rest| rest.split(',').next()?.parse().ok());
        if let Some(pid) = pid {
            break Pid::from_raw(pid).unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    // Once it has begun: a log that grows.
    while fs::metadata(out.join("log.mcap")).map_or(0, |log| log.len()) < 200_000 {
        std::thread::sleep(Duration::from_millis(5));
    }
    kill_process(plant, Signal::STOP).unwrap();
    std::thread::sleep(Duration::from_secs(2));
    kill_process(plant, Signal::CONT).unwrap();
    let output = run.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", words(&output));
    fs::remove_dir_all(out).unwrap();
}

#[test]
fn a_run_that_somebody_named_is_found_by_that_name() {
    let scenario = "configs/scenarios/atlas_one_foot.toml";
    let described = delmpc(&["wire", "--connection", scenario, "--run-id", "bench-3"]);
    let connection: Value = serde_json::from_slice(&described.stdout).unwrap();
    // FNV-1a of "bench-3" and a byte 0xff, by another program.
    assert_eq!(connection["run_id"], "5976d8699b458526");
    assert_eq!(connection["robot"]["joints"].as_array().unwrap().len(), 30);
    let refused = delmpc(&["wire", "--connection", scenario, "--run-id", "two words"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(words(&refused).contains("16 hexadecimal digits are expected, or a name"));
}

#[test]
fn the_header_for_c_is_one() {
    for (compiler, standard) in [("cc", "-std=c11"), ("c++", "-std=c++11")] {
        let language = if compiler == "cc" { "c" } else { "c++" };
        let checked = Command::new(compiler)
            .args([
                "-x",
                language,
                standard,
                "-Wall",
                "-Wextra",
                "-Werror",
                "-fsyntax-only",
                "shared/messages/delmpc.h",
            ])
            .current_dir(ROOT)
            .output();
        match checked {
            Ok(output) => assert!(output.status.success(), "{compiler}: {}", words(&output)),
            Err(error) => println!("skipped: {compiler}: {error}"),
        }
    }
}

#[test]
fn the_python_package_has_the_servo_of_rust() {
    if python_has("numpy") {
        let output =
            Command::new(python()).arg("python/tests/test_delmpc.py").current_dir(ROOT).output().unwrap();
        assert!(output.status.success(), "{}", words(&output));
    }
}

#[test]
fn mujoco_is_the_plant_of_every_kind_of_scenario() {
    if !python_has("numpy, iceoryx2, mujoco") {
        return;
    }
    for scenario in ["atlas_one_foot", "littledog_trot"] {
        let out = folder(scenario);
        let file = format!("configs/scenarios/{scenario}.toml");
        let plant = format!("exec {} examples/mujoco/plant.py", python());
        let output = command(&["run", &file, "--plant", &plant, "--no-report", "--json", "--quiet"])
            .args(["--set", "clock=lockstep", "--set", "duration_s=0.4", "--out", out.to_str().unwrap()])
            .env("PYTHONPATH", format!("{ROOT}/python"))
            .output()
            .unwrap();
        let figures: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        assert_eq!(figures["fell"], false, "{scenario}: {}", words(&output));
        // The truth of every step is heard, and every state.
        assert_eq!(
            (&figures["steps"], &figures["log_records_dropped"]),
            (&400.into(), &0.into()),
            "{scenario}"
        );
        assert!(figures["max_stance_slip_m"].as_f64().unwrap() < 5e-3, "{figures:#}");
        if python_has("mcap") {
            let output = Command::new(python())
                .args(["python/tests/read_run.py", out.to_str().unwrap()])
                .current_dir(ROOT)
                .output()
                .unwrap();
            assert!(output.status.success(), "{}", words(&output));
        }
        fs::remove_dir_all(out).unwrap();
    }
}

#[test]
fn a_controller_of_somebody_else_holds_our_plant() {
    if !python_has("numpy, iceoryx2") {
        return;
    }
    let out = folder("controller");
    let controller = format!("exec {} examples/external_controller/controller.py", python());
    let output = command(&["run", "configs/scenarios/littledog_trot.toml", "--controller", &controller])
        .args(["--no-report", "--json", "--quiet", "--set", "clock=lockstep", "--set", "duration_s=0.4"])
        .args(["--out", out.to_str().unwrap()])
        .env("PYTHONPATH", format!("{ROOT}/python"))
        .output()
        .unwrap();
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    assert_eq!((&figures["fell"], &figures["cycles"]), (&false.into(), &40.into()), "{}", words(&output));
    assert_eq!(
        (&figures["commands_refused"], &figures["watchdog_level_max"]),
        (&0.into(), &0.into()),
        "{figures:#}"
    );
    assert!(figures["max_stance_slip_m"].as_f64().unwrap() < 1e-3, "{figures:#}");
    fs::remove_dir_all(out).unwrap();
}
