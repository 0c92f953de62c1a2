//! Folders of results: nothing of the user's is overwritten, two runs never share one.

use std::fs;
use std::process::{Command, Stdio};

use crate::support::{PROGRAM, SHORT, Scratch, delmpc, finish, run, wait};

#[test]
fn nothing_of_the_users_is_overwritten() {
    let scratch = Scratch::with_lamp("mine");
    fs::rename(scratch.file("reach.toml"), scratch.file("scenario.toml")).unwrap();
    let before = fs::read(scratch.file("scenario.toml")).unwrap();
    for out in [".", "./", scratch.path().to_str().unwrap()] {
        for command in ["run", "plant", "controller"] {
            let mut process = Command::new(PROGRAM);
            process.current_dir(scratch.path()).args([command, "scenario.toml", "--out", out]);
            finish(process).assert(2, &["not of a run"]);
        }
        for arguments in
            [&["timing", "--duration", "1", "--one-core"][..], &["push-map", "--link", "upper_arm"]]
        {
            let mut process = Command::new(PROGRAM);
            process.current_dir(scratch.path()).args(arguments).args(["scenario.toml", "--out", out]);
            finish(process).assert(2, &["not of a run"]);
        }
    }
    assert_eq!(fs::read(scratch.file("scenario.toml")).unwrap(), before);
    assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 3);
    // A link in the place of the marker leads nowhere.
    let linked = Scratch::new("linked");
    std::os::unix::fs::symlink(scratch.file("scenario.toml"), linked.file(".delmpc")).unwrap();
    run(&linked, &scratch.file("scenario.toml"), &["--out", linked.path().to_str().unwrap()]);
    assert_eq!(fs::read(scratch.file("scenario.toml")).unwrap(), before);
}

#[test]
fn two_runs_never_share_a_folder() {
    let scratch = Scratch::with_lamp("shared");
    let (scenario, out) = (scratch.file("reach.toml"), scratch.file("out"));
    let long = [
        "run",
        &scenario,
        "--out",
        &out,
        "--set",
        "duration_s=4",
        "--set",
        "process.priority=0",
        "--no-report",
        "--quiet",
    ];
    let mut first = Command::new(PROGRAM).args(long).stdin(Stdio::null()).spawn().unwrap();
    while fs::metadata(scratch.file("out/log.mcap")).map_or(0, |file| file.len()) < 100_000 {
        assert!(first.try_wait().unwrap().is_none(), "it ended early");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    run(&scratch, &scenario, &[]).assert(2, &["another run is writing"]);
    delmpc(&["plant", &scenario, "--out", &out]).assert(2, &["is writing into it"]);
    let status = wait(&mut first);
    assert!(matches!(status, Some(0 | 1)), "{status:?}");
    delmpc(&["replay", &out, "--verify"]).assert(0, &[]);
    // Afterwards the folder serves again.
    run(&scratch, &scenario, &[]).assert(0, &[]);
}

#[test]
fn names_lead_nowhere() {
    let scratch = Scratch::with_lamp("names");
    fs::create_dir_all(scratch.path().join("a/b")).unwrap();
    for name in ["../../evil", "/tmp/evil", "..", "a/../../evil", "evil\\u0000", "x\\ny"] {
        let mut process = Command::new(PROGRAM);
        process.current_dir(scratch.path().join("a/b"));
        process
            .args([&["run", "../../reach.toml", "--set", &format!("name=\"{name}\"")], &SHORT[..]].concat());
        finish(process).assert(2, &["`name`"]);
    }
    assert_eq!(fs::read_dir(scratch.path().join("a/b")).unwrap().count(), 0);
    assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 4);
}

/// Every name a run or its report writes.
const WRITTEN: [&str; 11] = [
    ".delmpc-plant",
    ".plant.json",
    "controller.json",
    "log.mcap",
    "messages.txt",
    "plant.json",
    "plots",
    "report.html",
    "robot.toml",
    "robot.urdf",
    "scenario.toml",
];

/// A folder that says it is one of a run, with something in the place of a result.
fn disguised(scratch: &Scratch, name: &str, make: impl Fn(&str)) -> String {
    let _ = fs::remove_dir_all(scratch.file("out"));
    fs::create_dir(scratch.file("out")).unwrap();
    scratch.write("out/.delmpc", "");
    make(&scratch.file(&format!("out/{name}")));
    scratch.file("out")
}

fn run_and_report(scratch: &Scratch, out: &str) {
    let scenario = scratch.file("reach.toml");
    let short = ["--set", "clock=lockstep", "--set", "duration_s=0.05", "--quiet"];
    delmpc(&[&["run", &scenario, "--out", out], &short[..]].concat()).assert(0, &[]);
    delmpc(&["report", out]).assert(0, &[]);
}

#[test]
fn links_in_the_place_of_results_lead_nowhere() {
    let scratch = Scratch::with_lamp("links");
    fs::create_dir(scratch.file("mine")).unwrap();
    for name in WRITTEN {
        let mine = scratch.write("mine/precious", "precious");
        for kind in ["symbolic", "hard", "dangling"] {
            if kind != "symbolic" && name.starts_with(".delmpc") {
                continue; // a lock, which is not written to
            }
            let out = disguised(&scratch, name, |place| match (kind, name) {
                ("symbolic", "plots") => std::os::unix::fs::symlink(scratch.file("mine"), place).unwrap(),
                ("symbolic", _) => std::os::unix::fs::symlink(&mine, place).unwrap(),
                ("hard", "plots") => {}
                ("hard", _) => fs::hard_link(&mine, place).unwrap(),
                _ => std::os::unix::fs::symlink(scratch.file("mine/new"), place).unwrap(),
            });
            run_and_report(&scratch, &out);
            assert_eq!(fs::read_to_string(&mine).unwrap(), "precious", "{kind} link {name}");
            assert_eq!(fs::read_dir(scratch.file("mine")).unwrap().count(), 1, "{kind} link {name}");
        }
    }
}

#[test]
fn pipes_in_the_place_of_results_are_not_waited_for() {
    let scratch = Scratch::with_lamp("pipes-out");
    for name in WRITTEN {
        let out = disguised(&scratch, name, |place| {
            assert!(Command::new("mkfifo").arg(place).status().unwrap().success());
        });
        run_and_report(&scratch, &out);
    }
    // A report again, of a run whose files have become pipes since.
    for name in ["summary.json", "report.html", "messages.txt"] {
        let place = scratch.file(&format!("out/{name}"));
        fs::remove_file(&place).unwrap();
        assert!(Command::new("mkfifo").arg(&place).status().unwrap().success());
        delmpc(&["report", &scratch.file("out")]).assert(0, &[]);
    }
    let pipe = scratch.file("named");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    delmpc(&["model", &scratch.file("lamp.urdf"), "--svg", &pipe]).assert(2, &["a pipe that nobody reads"]);
}

#[test]
fn what_the_user_has_under_runs_stays() {
    let scratch = Scratch::with_lamp("runs");
    let run = || {
        let mut process = Command::new(PROGRAM);
        process.current_dir(scratch.path()).args([&["run", "reach.toml"], &SHORT[..]].concat());
        finish(process).assert(0, &[]);
    };
    fs::create_dir(scratch.file("runs")).unwrap();
    let mine = scratch.write("runs/latest", "precious");
    run();
    assert_eq!(fs::read_to_string(&mine).unwrap(), "precious");
    fs::remove_file(&mine).unwrap();
    run();
    assert!(fs::symlink_metadata(&mine).unwrap().is_symlink());
}
