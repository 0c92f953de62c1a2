//! `delmpc check`: everything that `run` would refuse, all at once; and `run` refuses the same.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::{Path, PathBuf};
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const NECK: &str = "lower=\"-1.2\" upper=\"1.2\" effort=\"12\"";
const PROGRAM: &str = env!("CARGO_BIN_EXE_delmpc");

/// The lamp in a folder of its own, with changes to its files: file, from, to.
fn lamp(name: &str, changes: &[(&str, &str, &str)]) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("check-{name}"));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    for file in ["lamp.urdf", "lamp.toml", "reach.toml"] {
        let mut text =
            std::fs::read_to_string(Path::new(ROOT).join("configs/examples/lamp").join(file)).unwrap();
        for (_, from, to) in changes.iter().filter(|change| change.0 == file) {
            assert!(text.contains(from), "{file}: {from}");
            text = text.replace(from, to);
        }
        std::fs::write(folder.join(file), text).unwrap();
    }
    folder
}

/// Exit status, standard output and standard error.
fn delmpc(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(PROGRAM).args(arguments).current_dir(folder).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[track_caller]
fn says(text: &str, lines: usize, kind: &str, words: &[&str]) {
    assert_eq!(text.lines().filter(|line| line.starts_with(kind)).count(), lines, "{text}");
    for word in words {
        assert!(text.contains(word), "`{word}` is not in\n{text}");
    }
}

#[test]
fn every_scenario_of_ours_is_well() {
    for file in std::fs::read_dir(Path::new(ROOT).join("configs/scenarios")).unwrap() {
        let file = file.unwrap().path();
        // Plans of walking robots are for `delmpc plan`.
        if std::fs::read_to_string(&file).unwrap().contains("[plan]") {
            continue;
        }
        let (status, out, err) = delmpc(Path::new(ROOT), &["check", file.to_str().unwrap()]);
        assert_eq!((status, err.as_str()), (Some(0), ""), "{}", file.display());
        assert!(out.ends_with("no errors, no warnings\n"), "{out}");
    }
}

#[test]
fn all_that_is_wrong_is_told_at_once_and_run_refuses_the_same() {
    let folder = lamp(
        "many",
        &[
            ("reach.toml", "hand = \"bulb\"", "hand = \"blub\"\nheight = 3"),
            ("reach.toml", "duration_s = 6.0", "duration_s = 6.0\nduraton_s = 5.0"),
            ("lamp.urdf", NECK, "lower=\"0\" upper=\"0\" effort=\"12\""),
        ],
    );
    let sets =
        ["--set", "sensors.delay_s=0.06", "--set", "controller.stages=2", "--set", "plant.friction=-1"];
    let told = [
        "unknown key `duraton_s`: did you mean `duration_s`?",
        "unknown key `reach.height`",
        "--set sensors.delay_s=0.06: `sensors.delay_s` = 0.06",
        "`controller.max_state_age_s` = 0.05",
        "`plant.friction` = -1",
        "`controller.horizon_s` = 1 and `controller.stages` = 2 do not fit together",
        "the joint neck_roll has no range",
        "[locked] neck_roll = 0.0",
        "has no such frame or link; it has sole_centre, bulb",
    ];
    let (status, out, err) = delmpc(&folder, &[&["check", "reach.toml"], &sets[..]].concat());
    assert_eq!(status, Some(2), "{err}");
    assert!(out.starts_with("reach.toml: ") && out.contains(" errors, "), "{out}");
    for word in told {
        assert!(err.contains(word), "`{word}` is not in\n{err}");
    }
    let (status, _, err) = delmpc(&folder, &[&["run", "reach.toml", "--out", "run"], &sets[..]].concat());
    assert_eq!(status, Some(2), "{err}");
    for word in told {
        assert!(err.contains(word), "`{word}` is not in\n{err}");
    }
    assert!(!folder.join("run").exists(), "something was started");
}

#[test]
fn locking_a_joint_is_a_remedy() {
    let folder = lamp("locked", &[("lamp.urdf", NECK, "lower=\"0\" upper=\"0\" effort=\"12\"")]);
    let table = std::fs::read_to_string(folder.join("lamp.toml")).unwrap();
    std::fs::write(folder.join("lamp.toml"), format!("{table}\n[locked]\nneck_roll = 0.0\n")).unwrap();
    let (status, _, err) = delmpc(&folder, &["check", "reach.toml"]);
    assert_eq!(status, Some(0), "{err}");
}

#[test]
fn an_impossible_inertia_can_be_accepted_for_every_command() {
    let urdf = std::fs::read_to_string(Path::new(ROOT).join("configs/examples/lamp/lamp.urdf")).unwrap();
    // The last link's, made a needle that is longer than it is thick in all directions.
    let last = urdf.rfind("ixx=\"").unwrap();
    let inertia = &urdf[last..last + urdf[last..].find(' ').unwrap()];
    let folder = lamp("impossible", &[("lamp.urdf", inertia, "ixx=\"0.5\"")]);
    let (status, _, err) = delmpc(&folder, &["check", "reach.toml"]);
    assert_eq!(status, Some(2), "{err}");
    says(&err, 1, "error: ", &["triangle inequality", "--set robot.accept_impossible_inertia=true"]);
    let accept = ["--set", "robot.accept_impossible_inertia=true"];
    let (status, _, err) = delmpc(&folder, &[&["check", "reach.toml"], &accept[..]].concat());
    assert_eq!(status, Some(0), "{err}");
    says(&err, 1, "warning: ", &["lamp.urdf:", "used all the same"]);
    let table = std::fs::read_to_string(folder.join("lamp.toml")).unwrap();
    let table = table.replacen("format = 1", "format = 1\naccept_impossible_inertia = true", 1);
    std::fs::write(folder.join("lamp.toml"), table).unwrap();
    let (status, _, err) = delmpc(&folder, &["check", "reach.toml"]);
    assert_eq!(status, Some(0), "{err}");
}

#[test]
fn a_placeholder_for_an_effort_is_lowered_and_the_robot_stands() {
    let folder = lamp("effort", &[("lamp.urdf", "effort=\"20\"", "effort=\"1e6\"")]);
    let (status, _, err) = delmpc(&folder, &["check", "reach.toml"]);
    assert_eq!(status, Some(0), "{err}");
    says(&err, 1, "warning: ", &["joint `swivel`: effort 1000000 N m is no motor's", "N m is used"]);
    let run = ["run", "reach.toml", "--set", "clock=lockstep", "--no-report", "--out", "run", "--json"];
    let (status, out, err) = delmpc(&folder, &run);
    assert_eq!(status, Some(0), "{out}{err}");
    assert!(err.contains("is no motor's"), "{err}");
}

#[test]
fn tables_and_robots_are_checked_too() {
    let changes = [
        ("lamp.urdf", "</robot>", "<material/></robot>"),
        ("lamp.toml", "hip_pitch = -0.5", "hip_pitch = -1.3"),
    ];
    let folder = lamp("table", &changes);
    for file in ["lamp.urdf", "lamp.toml"] {
        let (status, out, err) = delmpc(&folder, &["check", file]);
        assert_eq!(status, Some(0), "{err}");
        assert!(out.starts_with(file), "{out}");
        assert!(err.contains("the name of <material>") && err.contains("joint `hip_pitch` at -1.3"), "{err}");
    }
    let (status, _, err) = delmpc(&folder, &["check", "lamp.urdf", "--strict"]);
    assert_eq!(status, Some(2), "{err}");
    says(&err, 1, "error: ", &["lamp.urdf:", "<material>", "Remedy"]);
    let (status, ..) = delmpc(&folder, &["check", "nowhere.toml"]);
    assert_eq!(status, Some(2));
}
