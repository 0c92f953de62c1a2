//! Files and arguments that people write.

use std::sync::LazyLock;

use delmpc_robots::{ImpossibleInertia, LoadOptions, RobotModel, load_str};
use delmpc_scenario::Document;

const LAMP: &str = include_str!("../../../configs/examples/lamp/lamp.urdf");
const LAMP_TABLE: &str = include_str!("../../../configs/examples/lamp/lamp.toml");
const SCENARIO: &str = include_str!("../../../configs/examples/lamp/reach.toml");

static ROBOT: LazyLock<Option<RobotModel>> =
    LazyLock::new(|| load_str("lamp.urdf", LAMP, Some(LAMP_TABLE), &LoadOptions::default()).ok());

fn text(data: &[u8]) -> Option<&str> {
    std::str::from_utf8(data).ok()
}

/// A robot description.
pub fn urdf(data: &[u8]) {
    let Some(text) = text(data) else { return };
    let impossible_inertia = if data.len() % 2 == 0 {
        ImpossibleInertia::Accept
    } else {
        LoadOptions::default().impossible_inertia
    };
    let options = LoadOptions { impossible_inertia, ..LoadOptions::default() };
    match load_str("fuzz.urdf", text, None, &options) {
        Ok(robot) => assert!(robot.tree.total_mass().is_finite(), "a mass that is no number"),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// A companion table of the lamp.
pub fn companion(data: &[u8]) {
    let Some(text) = text(data) else { return };
    if let Ok(robot) = load_str("lamp.urdf", LAMP, Some(text), &LoadOptions::default()) {
        assert!(robot.postures.iter().all(|posture| posture.q.iter().all(|q| q.is_finite())));
    }
}

/// A scenario file.
pub fn scenario(data: &[u8]) {
    let Some(text) = text(data) else { return };
    let Ok(document) = Document::parse("fuzz.toml", text) else { return };
    comes_back(&document);
}

/// Overrides, one a line, of a scenario.
pub fn overrides(data: &[u8]) {
    let Some(text) = text(data) else { return };
    let Ok(mut document) = Document::parse("fuzz.toml", SCENARIO) else { return };
    for line in text.lines().take(20) {
        let _ = document.set(line);
    }
    comes_back(&document);
}

/// What is taken can be written and read again.
fn comes_back(document: &Document) {
    if let Ok(scenario) = document.scenario() {
        let _ = scenario.warnings();
        let again =
            Document::parse("again.toml", &scenario.to_toml()).and_then(|document| document.scenario());
        assert_eq!(again.as_ref(), Ok(&scenario), "the effective configuration is another one");
    }
}

/// A state and a step of `model --at`.
pub fn at(data: &[u8]) {
    let (Some(text), Some(robot)) = (text(data), ROBOT.as_ref()) else { return };
    if let Ok(answer) = delmpc::model::answer_to(robot, text) {
        assert!(!answer.contains("null"), "an answer that is no number");
    }
}
