//! The real command with its two real processes: what happens when one is killed, stopped, late, or told to end.
//!
//! Nothing here asserts how long something takes; a watchdog ends what hangs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::fs;

use rustix::process::Signal;
use support::{Delmpc, Folder, Member, children, main_scenario, member, shared_memory_of, wait_for};

/// Long enough to be disturbed, and reproducible whatever the machine does.
const LONG: [&str; 4] = ["--set", "clock=lockstep", "--set", "duration_s=600"];
const SHORT: [&str; 4] = ["--set", "clock=lockstep", "--set", "duration_s=0.2"];

/// A run whose two processes work.
fn running(folder: &Folder, more: &[&str]) -> Delmpc {
    let run = Delmpc::run(folder, &[&LONG, more].concat());
    wait_for("both processes to work", || {
        let messages = fs::metadata(folder.path().join("log.mcap")).map_or(0, |file| file.len());
        (children(run.pid()).len() == 2 && messages > 200_000).then_some(())
    });
    run
}

/// The run ends by a fault: it says why, nobody is left, nothing is left.
fn assert_fault(run: Delmpc, family: &[Member], folder: &Folder, why: &str) {
    let ended = run.wait();
    assert_eq!(ended.status, Some(3), "{}", ended.errors);
    assert!(ended.errors.contains(why), "{why:?} is not in {:?}", ended.errors);
    assert_nothing_left(family);
    let summary = folder.summary();
    assert_eq!(summary["success"], false);
    assert!(summary["failure"].as_str().unwrap().contains(why), "{summary}");
}

fn assert_nothing_left(family: &[Member]) {
    for member in family {
        assert!(!support::is_alive(member.pid), "{member:?} still lives");
        assert_eq!(shared_memory_of(&member.run_id), Vec::<String>::new());
    }
}

#[test]
fn a_short_run_ends_well_and_leaves_nothing_behind() {
    let folder = Folder::new("short");
    let run = Delmpc::run(&folder, &SHORT);
    let family = wait_for("both processes", || Some(children(run.pid())).filter(|family| family.len() == 2));
    let ended = run.wait();
    assert_eq!(ended.status, Some(0), "{}\n{}", ended.errors, folder.summary());
    assert_nothing_left(&family);
    for file in ["scenario.toml", "robot.urdf", "robot.toml", "summary.json", "log.mcap", "messages.txt"] {
        assert!(folder.path().join(file).is_file(), "{file}");
    }
    assert_eq!(folder.summary()["steps"], 200);
    let messages = fs::read_to_string(folder.path().join("messages.txt")).unwrap();
    let (plant, controller) = (member(&family, "plant").pid, member(&family, "controller").pid);
    let line = format!("run: plant process {plant}, controller process {controller}");
    assert!(messages.contains(&line), "{messages}");
}

#[test]
fn a_killed_plant_is_a_fault() {
    let folder = Folder::new("kill-plant");
    let run = running(&folder, &[]);
    let family = children(run.pid());
    let plant = member(&family, "plant").pid;
    support::signal(plant, Signal::KILL);
    assert_fault(run, &family, &folder, &format!("the plant process (pid {plant}) was killed (signal 9)"));
}

#[test]
fn a_killed_controller_is_a_fault() {
    let folder = Folder::new("kill-controller");
    let run = running(&folder, &[]);
    let family = children(run.pid());
    let controller = member(&family, "controller").pid;
    support::signal(controller, Signal::KILL);
    assert_fault(
        run,
        &family,
        &folder,
        &format!("the controller process (pid {controller}) was killed (signal 9)"),
    );
}

#[test]
fn a_process_that_stops_for_good_is_a_fault() {
    for role in ["plant", "controller"] {
        let folder = Folder::new(&format!("hang-{role}"));
        // In lockstep it may be in a debugger.
        let run = running(&folder, &["--set", "process.hang_s=0.5", "--set", "clock=realtime"]);
        let family = children(run.pid());
        let pid = member(&family, role).pid;
        support::signal(pid, Signal::STOP);
        assert_fault(run, &family, &folder, &format!("the {role} process (pid {pid}) hangs"));
    }
}

/// In lockstep the wall clock decides nothing: a process that is stopped again and again, for much longer than a hang together, goes on.
#[test]
fn in_lockstep_a_process_that_gets_its_core_now_and_then_is_never_given_up() {
    let folder = Folder::new("starved");
    let more =
        ["--set", "clock=lockstep", "--set", "duration_s=0.5", "--set", "process.hang_s=0.4", "--no-report"];
    let run = Delmpc::run(&folder, &more);
    let family = wait_for("both processes", || Some(children(run.pid())).filter(|family| family.len() == 2));
    for turn in 0..8 {
        let pid = member(&family, ["plant", "controller"][turn % 2]).pid;
        support::signal(pid, Signal::STOP);
        std::thread::sleep(std::time::Duration::from_millis(200));
        support::signal(pid, Signal::CONT);
    }
    let ended = run.wait();
    assert_eq!(ended.status, Some(0), "{}", ended.errors);
}

#[test]
fn a_process_that_stops_for_50_ms_is_not() {
    let folder = Folder::new("pause");
    let run = Delmpc::run(&folder, &["--set", "clock=lockstep", "--set", "duration_s=1"]);
    let family = wait_for("both processes", || Some(children(run.pid())).filter(|family| family.len() == 2));
    for role in ["plant", "controller"] {
        let pid = member(&family, role).pid;
        support::signal(pid, Signal::STOP);
        std::thread::sleep(std::time::Duration::from_millis(50));
        support::signal(pid, Signal::CONT);
    }
    let ended = run.wait();
    assert_eq!(ended.status, Some(0), "{}\n{}", ended.errors, folder.summary());
}

#[test]
fn an_interrupt_ends_both() {
    for signal in [Signal::INT, Signal::TERM] {
        let folder = Folder::new("interrupt");
        let run = running(&folder, &[]);
        let family = children(run.pid());
        support::signal(run.pid(), signal);
        let ended = run.wait();
        assert_eq!(ended.status, Some(130), "{}", ended.errors);
        assert_nothing_left(&family);
        assert_eq!(folder.summary()["failure"], "interrupted");
    }
}

#[test]
fn when_the_supervisor_is_killed_its_processes_end() {
    let folder = Folder::new("orphans");
    let run = running(&folder, &[]);
    let family = children(run.pid());
    support::signal(run.pid(), Signal::KILL);
    run.wait();
    wait_for("the processes to end", || {
        family.iter().all(|child| !support::is_alive(child.pid)).then_some(())
    });
    assert_nothing_left(&family);
}

#[test]
fn two_processes_of_the_same_scenario_meet_whichever_starts_first() {
    for (first, second) in [("plant", "controller"), ("controller", "plant")] {
        let folder = Folder::new(&format!("{first}-first"));
        // The seed makes the run this test's own.
        let seed = format!("seed={}", folder.number());
        let out = folder.path().to_str().unwrap().to_owned();
        let scenario = main_scenario();
        let start = |role: &str| {
            let arguments = [&[role, &scenario, "--out", &out, "--set", &seed], &SHORT[..]].concat();
            Delmpc::start(&arguments)
        };
        let early = start(first);
        std::thread::sleep(std::time::Duration::from_millis(500));
        let late = start(second);
        let mut run_id = String::new();
        for process in [early, late] {
            let ended = process.wait();
            assert_eq!(ended.status, Some(0), "{first} first: {}", ended.errors);
            run_id = ended.run_id();
        }
        assert_eq!(shared_memory_of(&run_id), Vec::<String>::new());
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let result = |name: &str, more: &[&str]| {
        let folder = Folder::new(name);
        let ended = Delmpc::run(&folder, &[&SHORT, more].concat()).wait();
        assert_eq!(ended.status, Some(0), "{}", ended.errors);
        let read = |file: &str| fs::read(folder.path().join(file)).unwrap();
        (read("summary.json"), read("log.mcap"))
    };
    let first = result("same-a", &[]);
    assert!(first == result("same-b", &[]), "two runs of one seed differ");
    assert!(first == result("same-c", &["--one-process"]), "one process and two differ");
    assert!(first != result("other", &["--set", "seed=2"]), "the seed does nothing");
}

#[test]
fn in_real_time_both_processes_leave_figures() {
    let folder = Folder::new("realtime");
    let ended = Delmpc::run(&folder, &["--set", "duration_s=0.5"]).wait();
    // A busy machine may miss a criterion; that is no fault.
    assert!(matches!(ended.status, Some(0 | 1)), "{:?} {}", ended.status, ended.errors);
    let summary = folder.summary();
    assert!(summary["cycle_time_p50_s"].as_f64().unwrap() > 0.0, "{summary}");
    assert!(summary["state_to_command_age_p50_s"].as_f64().unwrap() > 0.0, "{summary}");
    assert!(summary["plant_real_time_factor"].as_f64().unwrap() <= 1.001, "{summary}");
}

#[test]
fn a_killed_controller_is_taken_over_within_its_run() {
    let folder = Folder::new("take-over");
    let fault = ["--set", "duration_s=2", "--set", "fault.target=controller", "--set", "fault.kind=kill"];
    let scenario = main_scenario();
    let out = folder.path().to_str().unwrap();
    let ended =
        Delmpc::start(&[&["timing", &scenario, "--faults", "--out", out], &fault[..]].concat()).wait();
    assert_eq!(ended.status, Some(0), "{}", ended.errors);
    let run = folder.path().join("fault-0");
    let messages = fs::read_to_string(run.join("messages.txt")).unwrap();
    assert!(messages.contains("takes over"), "{messages}");
    let text = fs::read_to_string(folder.path().join("faults.json")).unwrap();
    let trials: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!((&trials[0]["leftovers"], &trials[0]["non_finite_torques"]), (&0.into(), &0.into()), "{text}");
    // The one that took over works, and is heard.
    assert!(fs::read_to_string(run.join("summary.json")).unwrap().contains("\"cycles\""));
}

#[test]
fn processes_with_different_joints_do_not_meet() {
    let folder = Folder::new("other-joints");
    let robots = concat!(env!("CARGO_MANIFEST_DIR"), "/configs/robots");
    for file in ["atlas.urdf", "atlas.toml"] {
        let text = fs::read_to_string(format!("{robots}/{file}")).unwrap();
        assert!(text.contains("l_arm_ely"));
        fs::write(folder.path().join(file), text.replace("l_arm_ely", "l_arm_elbow")).unwrap();
    }
    let run_id = format!("{:016x}", folder.number());
    let urdf = format!("robot.urdf={}/atlas.urdf", folder.path().display());
    let scenario = main_scenario();
    let arguments = |role: &'static str| {
        let own: [&str; 4] = [role, &scenario, "--run-id", &run_id];
        [&own[..], &SHORT[..]].concat()
    };
    let plant = Delmpc::start(&arguments("plant"));
    wait_for("the plant's channels", || (shared_memory_of(&run_id).len() > 6).then_some(()));
    let controller = Delmpc::start(&[&arguments("controller")[..], &["--set", &urdf]].concat());
    let ended = controller.wait();
    assert_eq!(ended.status, Some(3), "{}", ended.errors);
    assert!(ended.errors.contains("the peer has joint set"), "{}", ended.errors);
    support::signal(plant.pid(), Signal::TERM);
    let ended = plant.wait();
    assert_eq!(ended.status, Some(130), "{}", ended.errors);
    assert_eq!(shared_memory_of(&run_id), Vec::<String>::new());
}
