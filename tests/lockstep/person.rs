//! What a person looks at and types: the drawing of a robot, help, completions.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use std::path::Path;
use std::process::{Command, Output, Stdio};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn delmpc(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
    command.args(arguments).current_dir(ROOT).stdin(Stdio::null()).output().unwrap()
}

fn text(arguments: &[&str]) -> String {
    let output = delmpc(arguments);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn every_robot_is_drawn_in_its_postures() {
    for (robot, postures) in
        [("atlas", vec!["one_foot_right", "reach_floor"]), ("littledog", vec![]), ("spring_flamingo", vec![])]
    {
        let file = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{robot}.svg"));
        let table =
            text(&["model", &format!("configs/robots/{robot}.urdf"), "--svg", file.to_str().unwrap()]);
        assert!(table.starts_with(robot), "{table}");
        let drawing = std::fs::read_to_string(&file).unwrap();
        assert!(drawing.starts_with("<svg ") && drawing.ends_with("</svg>\n"));
        assert!(drawing.matches("<polygon ").count() > 100, "{robot}: hardly anything is drawn");
        assert!(!drawing.contains("NaN") && !drawing.contains("inf"), "{robot}");
        for posture in postures {
            assert!(drawing.contains(&format!(">{posture}</text>")), "{posture}");
        }
        std::fs::remove_file(file).unwrap();
    }
    let refused = delmpc(&["model", "configs/robots/atlas.urdf", "--svg", "/proc/none.svg"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--svg /proc/none.svg"));
}

#[test]
fn the_table_of_a_model_shows_its_tree() {
    let table = text(&["model", "configs/robots/atlas.urdf"]);
    let line = table.lines().find(|line| line.contains("r_leg_kny")).unwrap();
    assert_eq!(
        line.split_whitespace().take(5).collect::<Vec<_>>(),
        ["└", "r_lleg", "r_leg_kny", "revolute", "4.5150"]
    );
    assert!(table.contains("no warnings"));
}

#[test]
fn every_subcommand_has_help_with_its_examples() {
    for subcommand in ["run", "plant", "controller", "model", "completions"] {
        let help = text(&[subcommand, "--help"]);
        assert!(help.contains("Examples:\n  ") && help.contains(&format!("delmpc {subcommand}")), "{help}");
    }
}

#[test]
fn shells_learn_our_words() {
    for shell in ["bash", "zsh", "fish"] {
        let script = text(&["completions", shell]);
        for word in ["delmpc", "controller", "one-process", "svg"] {
            assert!(script.contains(word), "{shell}: {word}");
        }
    }
}
