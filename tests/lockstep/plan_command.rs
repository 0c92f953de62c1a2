//! `delmpc plan`: checks of plan files and what is refused.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn delmpc(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_delmpc"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .output()
        .unwrap()
}

fn delivered() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("controller/planner/tests/vectors/flamingo_jump_24.json")
}

#[test]
fn a_delivered_plan_checks_and_a_changed_one_does_not() {
    let good = delmpc(&["plan", "--check", delivered().to_str().unwrap()]);
    let text = String::from_utf8_lossy(&good.stdout);
    assert_eq!(good.status.code(), Some(0), "{text}");
    assert!(text.contains("DEL rows") && text.contains("stages integrated finely"), "{text}");

    let mut plan: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(delivered()).unwrap()).unwrap();
    plan["u"][3][0] = serde_json::json!(1.5);
    let changed = std::env::temp_dir().join(format!("delmpc-changed-plan-{}.json", std::process::id()));
    std::fs::write(&changed, plan.to_string()).unwrap();
    let bad = delmpc(&["plan", "--json", "--check", changed.to_str().unwrap()]);
    assert_eq!(bad.status.code(), Some(1));
    let answer: serde_json::Value = serde_json::from_slice(&bad.stdout).unwrap();
    assert_eq!(answer["passes"], false);
    assert!(answer["findings"]["del_s"].as_f64().unwrap() > 1e-3);

    plan["format"] = serde_json::json!("contact-plan/9");
    std::fs::write(&changed, plan.to_string()).unwrap();
    let other = delmpc(&["plan", "--check", changed.to_str().unwrap()]);
    assert_eq!(other.status.code(), Some(2));
    let said = String::from_utf8_lossy(&other.stderr);
    assert!(said.contains("contact-plan/9") && said.contains("contact-plan/1"), "{said}");
    std::fs::remove_file(&changed).unwrap();
}

#[test]
fn what_cannot_be_planned_is_refused() {
    let none = delmpc(&["plan", "configs/scenarios/atlas_one_foot.toml"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&none.stderr).contains("no section `[plan]`"));
    let scenario = "configs/scenarios/flamingo_jump.toml";
    let range = delmpc(&["plan", scenario, "--set", "plan.friction=-1"]);
    assert_eq!(range.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&range.stderr).contains("plan.friction"));
    let coordinate = delmpc(&["plan", scenario, "--set", "plan.bound.coordinate=tail"]);
    assert_eq!(coordinate.status.code(), Some(2));
    let said = String::from_utf8_lossy(&coordinate.stderr);
    assert!(said.contains("`tail`") && said.contains("right_hip"), "{said}");
}
