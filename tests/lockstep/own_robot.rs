//! The worked example `configs/examples/lamp/README.md`, done as its text says: its commands are run, its files are written from the text,
//! and what it shows is compared with what comes. And what a model says when it cannot stand.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use std::path::{Path, PathBuf};
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const PROGRAM: &str = env!("CARGO_BIN_EXE_delmpc");

/// A fenced block of a text: what stands behind its fence, and what is in it.
struct Block {
    label: String,
    text: String,
}

fn blocks(text: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut open: Option<Block> = None;
    for line in text.lines() {
        match (open.as_mut(), line.strip_prefix("```")) {
            (None, Some(label)) => open = Some(Block { label: label.to_owned(), text: String::new() }),
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(block), None) => block.text += &format!("{line}\n"),
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "a block is not closed");
    blocks
}

/// A folder in which the project's `configs` are found, as in a clone of it.
fn clone_of_configs(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("own-robot-{name}"));
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    std::os::unix::fs::symlink(Path::new(ROOT).join("configs"), folder.join("configs")).unwrap();
    folder
}

/// Words without spaces between them and with every number as `#`: figures may differ in their last digit on another machine.
fn shape(line: &str) -> String {
    let line: String =
        line.chars().map(|letter| if letter.is_ascii_digit() { '#' } else { letter }).collect();
    let words: Vec<&str> = line.split_whitespace().collect();
    let mut text = words.join(" ");
    while text.contains("##") {
        text = text.replace("##", "#");
    }
    text
}

#[test]
fn the_worked_example_works_as_its_text_says() {
    let example = Path::new(ROOT).join("configs/examples/lamp");
    let text = std::fs::read_to_string(example.join("README.md")).unwrap();
    let folder = clone_of_configs("lamp");
    let path = format!(
        "{}:{}",
        Path::new(PROGRAM).parent().unwrap().display(),
        std::env::var("PATH").unwrap_or_default()
    );

    let (mut ran, mut shown) = (0, String::new());
    for Block { label, text } in blocks(&text) {
        match label.split_once(' ').unwrap_or((&label, "")) {
            // It is built already.
            ("sh", "") if text.starts_with("cargo build") => {}
            ("sh", "") => {
                let mut shell = Command::new("sh");
                let output = shell.args(["-e", "-c", &text]).env("PATH", &path).current_dir(&folder).output();
                let output = output.unwrap();
                shown = String::from_utf8(output.stdout).unwrap();
                let errors = String::from_utf8_lossy(&output.stderr);
                assert_eq!(output.status.code(), Some(0), "{text}{shown}{errors}");
                ran += 1;
            }
            ("toml", file) => {
                // The files that lie there are those of the text.
                let name = Path::new(file).file_name().unwrap();
                assert_eq!(std::fs::read_to_string(example.join(name)).unwrap(), text, "{file}");
                std::fs::write(folder.join(file), text).unwrap();
            }
            ("text", "") => {
                let lines: Vec<String> = shown.lines().map(shape).collect();
                for line in text.lines() {
                    assert!(lines.contains(&shape(line)), "`{line}` is not in\n{shown}");
                }
            }
            ("console", "") => {}
            other => panic!("what is a block {other:?}?"),
        }
    }
    assert_eq!(ran, 3, "commands of the text were not run");

    let summary = std::fs::read(folder.join("my_robot/run/summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&summary).unwrap();
    assert_eq!(summary["success"], true, "{summary}");
    assert_eq!((&summary["fell"], &summary["recovered"]), (&false.into(), &true.into()));
    assert_eq!(summary["fallback_level_max"], 0);
    let report = std::fs::read_to_string(folder.join("my_robot/run/report.html")).unwrap();
    assert!(report.contains("neck_roll"), "the report does not know the robot");
    let drawing = std::fs::read_to_string(folder.join("my_robot/lamp.svg")).unwrap();
    assert!(drawing.contains("stand") && drawing.matches("<polygon").count() > 100);
    std::fs::remove_dir_all(folder).unwrap();
}

/// What `delmpc model` says about the lamp with its companion table changed.
fn told(name: &str, from: &str, to: &str) -> String {
    let folder = clone_of_configs(name);
    let read = |file| std::fs::read_to_string(folder.join("configs/examples/lamp").join(file)).unwrap();
    let table = read("lamp.toml");
    assert!(table.contains(from), "{from}");
    std::fs::write(folder.join("lamp.urdf"), read("lamp.urdf")).unwrap();
    std::fs::write(folder.join("lamp.toml"), table.replace(from, to)).unwrap();
    let output = Command::new(PROGRAM).args(["model", "lamp.urdf"]).current_dir(&folder).output().unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_posture_that_cannot_stand_is_told_why() {
    let base = "base_position_m = [0.0, 0.0, 0.0]\n";
    for (name, from, to, said) in [
        ("leans-over", "hip_pitch = -0.5", "hip_pitch = 0.9", "outside sole `foot`, so the robot tips over"),
        ("high", base, "base_position_m = [0.0, 0.0, 0.03]\n", "30.0 mm above the ground: add -0.0300 to z"),
        ("low", base, "base_position_m = [0.0, 0.0, -0.01]\n", "10.0 mm below the ground: add 0.0100 to z"),
        ("slants", base, "base_rpy_rad = [0.1, 0.0, 0.0]\n", "`foot`, leans by 5.73 deg"),
        ("nowhere", base, "", "has no base pose"),
        ("far", "hip_pitch = -0.5", "hip_pitch = -1.3", "is outside its limits -1.2 to 1.2"),
    ] {
        let text = told(name, from, to);
        let warning = text.lines().find(|line| line.starts_with("warning: ") && line.contains(said));
        assert!(warning.is_some(), "{name}: `{said}` is not in\n{text}");
        assert!(!text.contains("no warnings"), "{name}\n{text}");
    }
}

/// Exit status and errors of a run of the lamp with a file changed.
fn run_changed(name: &str, file: &str, from: &str, to: &str) -> (Option<i32>, String) {
    let folder = clone_of_configs(name);
    for copied in ["lamp.urdf", "lamp.toml", "reach.toml"] {
        let text = std::fs::read_to_string(folder.join("configs/examples/lamp").join(copied)).unwrap();
        let changed = if copied == file { text.replacen(from, to, 1) } else { text.clone() };
        assert!(copied != file || changed != text, "{from}");
        std::fs::write(folder.join(copied), changed).unwrap();
    }
    let output = Command::new(PROGRAM)
        .args(["run", "reach.toml", "--set", "clock=lockstep"])
        .current_dir(&folder)
        .output()
        .unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn a_joint_that_cannot_be_driven_is_refused_before_anything_runs() {
    let passive = "format = 1\npassive = [\"elbow\"]";
    for (name, file, from, to, said) in [
        ("passive", "lamp.toml", "format = 1", passive, "joint `elbow` has no motor"),
        ("weak", "lamp.urdf", "effort=\"30\"", "effort=\"0\"", "joint `elbow` has effort 0"),
        ("stiff", "lamp.urdf", "velocity=\"8\"", "velocity=\"0\"", "joint `swivel` has velocity 0"),
        ("typo", "reach.toml", "hand = \"bulb\"", "hand = \"blub\"", "it has sole_centre, bulb"),
    ] {
        let (status, errors) = run_changed(name, file, from, to);
        assert_eq!(status, Some(2), "{name}: {errors}");
        assert!(errors.contains(said), "{name}: {errors}");
    }
}

#[test]
fn a_ball_out_of_reach_is_told_at_once() {
    let far = "ball_m = [3.0, 0.2, 0.4]";
    let (status, errors) = run_changed("far-ball", "reach.toml", "ball_m = [0.3, 0.2, 0.4]", far);
    assert_eq!(status, Some(1), "{errors}");
    assert!(errors.contains("no balanced posture brings the hand nearer to the ball than 2."), "{errors}");
}
