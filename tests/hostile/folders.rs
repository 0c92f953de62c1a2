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
