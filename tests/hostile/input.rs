//! Robots, scenarios and states that nobody would give on purpose.

use std::process::Command;

use crate::support::{Scratch, atlas, delmpc, finish, lamp, run};

#[test]
fn names_of_any_length_are_shown_or_refused() {
    for length in [200, 65_534, 300_000] {
        let scratch = Scratch::with_lamp("long");
        let long = "x".repeat(length);
        scratch.change("lamp.urdf", "neck_roll", &long);
        let ended = delmpc(&["model", &scratch.file("lamp.urdf")]);
        assert!(matches!(ended.status, Some(0 | 2)), "{:?} {}", ended.status, ended.errors.len());
        let widest = ended.out.lines().map(|line| line.chars().count()).max().unwrap_or(0);
        assert!(length < 1000 || widest < 1000, "a table {widest} characters wide");
    }
}

#[test]
fn pipes_and_devices_are_refused_and_not_waited_for() {
    let scratch = Scratch::with_lamp("pipes");
    let pipe = scratch.file("pipe.urdf");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    delmpc(&["model", &pipe]).assert(2, &["not a regular file"]);
    delmpc(&["model", &lamp("lamp.urdf"), "--at", &pipe]).assert(2, &["no plain file"]);
    run(&scratch, &pipe, &[]).assert(2, &["not a regular file"]);
    run(&scratch, &scratch.file("reach.toml"), &["--set", &format!("robot.urdf={pipe}")])
        .assert(2, &["not a regular file"]);
    std::fs::remove_file(scratch.file("lamp.toml")).unwrap();
    assert!(Command::new("mkfifo").arg(scratch.file("lamp.toml")).status().unwrap().success());
    delmpc(&["model", &scratch.file("lamp.urdf")]).assert(2, &["not a regular file"]);
    delmpc(&["init", &pipe]).assert(2, &["it is no plain file"]);
    for command in ["check", "plan", "push-map", "timing"] {
        delmpc(&[command, &pipe]).assert(2, &["not a regular file"]);
    }
    delmpc(&["plan", "--check", &pipe, &scratch.file("lamp.urdf")]).assert(2, &[]);
    for command in ["model", "init", "check", "run"] {
        delmpc(&[command, "/dev/zero"]).assert(2, &[]);
    }
    delmpc(&["model", scratch.path().to_str().unwrap()]).assert(2, &[]);
    for name in ["scenario.toml", "log.mcap"] {
        let run = Scratch::new("pipe-run");
        assert!(Command::new("mkfifo").arg(run.file(name)).status().unwrap().success());
        delmpc(&["report", run.path().to_str().unwrap()]).assert(2, &[]);
        delmpc(&["replay", run.path().to_str().unwrap(), "--verify"]).assert(2, &[]);
    }
    // What a shell has opened is read.
    let mut command = Command::new("bash");
    command.args(["-c", "echo '{\"q\": {}}' | $DELMPC model $URDF --at /dev/stdin"]);
    command.env("DELMPC", crate::support::PROGRAM).env("URDF", lamp("lamp.urdf"));
    finish(command).assert(0, &[]);
}

#[test]
fn states_whose_numbers_are_too_large_are_an_error_and_never_null() {
    let scratch = Scratch::new("at");
    let mut refused = 0;
    for key in ["q", "qdot", "u"] {
        for size in ["1e10", "1e100", "1e155", "1e200", "1e300", "1e308"] {
            for step in [
                "",
                ", \"dt\": 0.01",
                ", \"dt\": 1e-300",
                ", \"dt\": 1e300",
                ", \"dt\": 0.01, \"order\": \"lobatto4\"",
            ] {
                let at = scratch.write("at.json", format!("{{\"{key}\": {{\"r_leg_kny\": {size}}}{step}}}"));
                let ended = delmpc(&["model", &atlas(), "--at", &at]);
                assert!(matches!(ended.status, Some(0 | 2)), "{key} {size} {step}: {ended:?}");
                assert!(!ended.out.contains("null"), "{key} {size} {step}: null");
                refused += u32::from(ended.status == Some(2));
            }
        }
    }
    assert!(refused > 10);
    for more in [
        "\"gravity\": [1e308, 1e308, 1e308]",
        "\"base_pose\": {\"xyz\": [1e308, 0, 0]}",
        "\"base_twist\": {\"angular\": [1e200, 0, 0]}, \"dt\": 0.1",
        "\"q\": {\"r_leg_kny\": 1e400}",
        "\"dt\": -1",
        "\"dt\": 0",
    ] {
        let at = scratch.write("at.json", format!("{{{more}}}"));
        delmpc(&["model", &atlas(), "--at", &at]).assert(2, &["at.json"]);
    }
}

/// What either process would refuse is refused before anything starts, by key or joint.
#[test]
fn keys_that_fit_alone_but_not_together_are_refused_at_once() {
    let scratch = Scratch::with_lamp("together");
    let scenario = scratch.file("reach.toml");
    for change in ["controller.stages=2", "controller.horizon_s=5"] {
        run(&scratch, &scenario, &["--set", change])
            .assert(2, &["controller.stages", "controller.horizon_s", "0.2 s"]);
        assert!(!scratch.path().join("out").exists(), "a folder was made");
    }
    let text = std::fs::read_to_string(scratch.file("lamp.urdf")).unwrap();
    for (range, word) in
        [("lower=\"0\" upper=\"0\"", "neck_roll"), ("lower=\"0.5\" upper=\"0.5\"", "neck_roll")]
    {
        let joint = text.find("joint name=\"neck_roll\"").unwrap();
        let from = joint + text[joint..].find("lower=").unwrap();
        let to = from + text[from..].find(" effort").or(text[from..].find(" velocity")).unwrap();
        scratch.write("lamp.urdf", [&text[..from], range, &text[to..]].concat());
        run(&scratch, &scenario, &[]).assert(2, &[word]);
    }
}

#[test]
fn counts_and_times_of_a_push_map_that_cannot_be_meant_are_refused() {
    for change in [
        ["--directions", "0"],
        ["--directions", "18446744073709551615"],
        ["--seeds", "0"],
        ["--seeds", "18446744073709551615"],
        ["--push-s", "inf"],
        ["--push-s", "nan"],
        ["--recovery-s", "1e300"],
        ["--resolution-ns", "1e-300"],
        ["--resolution-ns", "0"],
    ] {
        let scratch = Scratch::new("push-map");
        let out = scratch.file("map");
        delmpc(&[&["push-map", &lamp("reach.toml"), "--out", &out], &change[..]].concat())
            .assert(2, &[change[0], "must lie in"]);
        assert!(!std::path::Path::new(&out).exists());
    }
}

#[test]
fn a_push_map_with_many_seeds_ends_when_it_is_told_to() {
    let scratch = Scratch::new("push-map-stop");
    let ended = crate::support::shell(&format!(
        "$DELMPC push-map $REACH --seeds 1000000 --directions 1 --out {0}/map & sleep 2; kill -TERM $!; wait $!",
        scratch.path().display()
    ));
    assert_ne!(ended.status, Some(0), "{ended:?}");
}

#[test]
fn cores_that_are_not_there_are_refused_at_once() {
    let scratch = Scratch::new("cores");
    let out = scratch.file("t");
    let ended =
        delmpc(&["timing", &lamp("reach.toml"), "--duration", "1", "--cores", "0,1023", "--out", &out]);
    ended.assert(2, &["core 1023"]);
    assert!(!std::path::Path::new(&out).exists());
}
