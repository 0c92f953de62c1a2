//! Plant and controller, each started by itself, as their help says.

use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::support::{PROGRAM, Scratch, delmpc, wait};

fn start(role: &str, scratch: &Scratch, more: &[&str]) -> std::process::Child {
    let (scenario, out) = (scratch.file("reach.toml"), scratch.file("new/folder"));
    Command::new(PROGRAM)
        .args([&[role, &scenario, "--out", &out, "--set", "process.priority=0"], more].concat())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn both_leave_a_run_that_can_be_reported_and_replayed() {
    for (number, clock) in ["lockstep", "realtime"].into_iter().enumerate() {
        for roles in [["plant", "controller"], ["controller", "plant"]] {
            let scratch = Scratch::with_lamp(&format!("apart-{clock}-{}", roles[0]));
            let seed = format!("seed={}", 1000 * std::process::id() as usize + number);
            let more = ["--set", &format!("clock={clock}"), "--set", "duration_s=0.5", "--set", &seed];
            let mut first = start(roles[0], &scratch, &more);
            std::thread::sleep(Duration::from_millis(400));
            let mut second = start(roles[1], &scratch, &more);
            let ends = [wait(&mut first), wait(&mut second)];
            assert!(ends.iter().all(|status| matches!(status, Some(0 | 1))), "{clock}, {roles:?}: {ends:?}");
            let out = scratch.file("new/folder");
            for file in
                ["summary.json", "scenario.toml", "robot.urdf", "robot.toml", "log.mcap", "report.html"]
            {
                assert!(std::path::Path::new(&out).join(file).is_file(), "{clock}, {roles:?}: no {file}");
            }
            let summary = fs::read_to_string(scratch.file("new/folder/summary.json")).unwrap();
            assert!(summary.contains("\"steps\": 500") && !summary.contains("left no figures"), "{summary}");
            delmpc(&["report", &out]).assert(0, &[]);
            let replayed = delmpc(&["replay", &out, "--verify"]);
            replayed.assert(0, &[]);
            assert!(replayed.out.starts_with("the same bits: 501 steps"), "{replayed:?}");
        }
    }
}

/// The other one is of another configuration, or does not come, or goes: nobody waits for ever.
#[test]
fn nobody_waits_for_who_is_gone() {
    let scratch = Scratch::with_lamp("gone");
    let seed = format!("seed={}", 1000 * std::process::id() + 77);
    for clock in ["lockstep", "realtime"] {
        let more = ["--set", &format!("clock={clock}"), "--set", "duration_s=30", "--set", &seed];
        for killed in ["plant", "controller"] {
            let mut plant = start("plant", &scratch, &more);
            let mut controller = start("controller", &scratch, &more);
            let log = scratch.file("new/folder/log.mcap");
            while fs::metadata(&log).map_or(0, |file| file.len()) < 200_000 {
                std::thread::sleep(Duration::from_millis(10));
            }
            let (dead, left) =
                if killed == "plant" { (&mut plant, &mut controller) } else { (&mut controller, &mut plant) };
            dead.kill().unwrap();
            dead.wait().unwrap();
            assert_eq!(wait(left), Some(3), "{clock}, {killed} killed");
            fs::remove_file(&log).unwrap();
        }
    }
}

#[test]
fn two_of_a_role_or_another_scenario_are_refused() {
    let scratch = Scratch::with_lamp("twice");
    let seed = format!("seed={}", 1000 * std::process::id() + 99);
    let mut first = start("plant", &scratch, &["--set", "clock=lockstep", "--set", &seed]);
    while !std::path::Path::new(&scratch.file("new/folder/log.mcap")).exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    let (scenario, out) = (scratch.file("reach.toml"), scratch.file("new/folder"));
    let set = ["--set", "process.priority=0", "--set", "clock=lockstep", "--set", &seed];
    delmpc(&[&["plant", &scenario, "--out", &out], &set[..]].concat()).assert(2, &["another plant"]);
    let other =
        ["controller", &scenario, "--out", &out, "--set", "clock=lockstep", "--set", "plant.friction=0.4"];
    delmpc(&other).assert(2, &["another scenario"]);
    first.kill().unwrap();
    first.wait().unwrap();
}
