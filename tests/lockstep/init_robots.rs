//! `delmpc init` of robots that do not stand on soles: a dog on four tips, and an arm that is bolted down. Both are made up here.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::{Path, PathBuf};

use crate::made_up::{self, delmpc};

/// A link of a mass whose centre is so far below (above: negative) its joint, with a shape.
fn link(text: &mut String, name: &str, mass: f64, below: f64, size: f64, shape: &str) {
    made_up::link(text, name, mass, below, mass * size * size / 12.0, shape);
}

fn joint(text: &mut String, ends: [&str; 2], at: [f64; 3], axis: &str, range: [f64; 2], effort: f64) {
    made_up::joint(text, ends, at, axis, range, [effort, 15.0]);
}

/// A dog of 12 kg with legs of 0.4 m; `foot` is what the shanks collide with, `range` that of the knees.
fn dog(foot: &str, range: [f64; 2], effort: f64) -> String {
    let mut text = String::from("<robot name='dog'>\n");
    let trunk = "<collision><geometry><box size='0.4 0.2 0.1'/></geometry></collision>";
    link(&mut text, "trunk", 6.0, 0.0, 0.4, trunk);
    for (side, x, y) in [("fl", 0.18, 0.05), ("fr", 0.18, -0.05), ("hl", -0.18, 0.05), ("hr", -0.18, -0.05)] {
        let [hip, thigh, shank] = ["hip", "thigh", "shank"].map(|part| format!("{side}_{part}"));
        link(&mut text, &hip, 0.5, 0.0, 0.08, "");
        link(&mut text, &thigh, 0.8, 0.04, 0.15, "");
        link(&mut text, &shank, 0.2, 0.1, 0.2, foot);
        joint(&mut text, ["trunk", &hip], [x, y, 0.0], "1 0 0", [-0.8, 0.8], effort);
        joint(&mut text, [&hip, &thigh], [0.0, 0.8 * y, 0.0], "0 1 0", [-1.5, 3.0], effort);
        joint(&mut text, [&thigh, &shank], [0.0, 0.0, -0.2], "0 1 0", range, effort);
    }
    text + "</robot>\n"
}

const TIP: &str =
    "<collision><origin xyz='0 0 -0.2'/><geometry><sphere radius='0.02'/></geometry></collision>";

/// Six joints on a heavy foot.
fn arm() -> String {
    let mut text = String::from("<robot name='arm'>\n");
    let foot =
        "<collision><origin xyz='0 0 0.05'/><geometry><box size='0.2 0.2 0.1'/></geometry></collision>";
    link(&mut text, "foot", 4.0, -0.05, 0.2, foot);
    let mut parent = "foot".to_owned();
    for (name, z, axis, mass, effort) in [
        ("turn", 0.1, "0 0 1", 3.0, 150.0),
        ("shoulder", 0.1, "0 1 0", 4.0, 150.0),
        ("elbow", 0.4, "0 1 0", 2.0, 100.0),
        ("wrist_1", 0.35, "0 1 0", 0.8, 28.0),
        ("wrist_2", 0.08, "0 0 1", 0.6, 28.0),
        ("wrist_3", 0.08, "0 1 0", 0.3, 28.0),
    ] {
        let size = if z > 0.2 { 0.3 } else { 0.08 };
        let shape = "<collision><geometry><sphere radius='0.04'/></geometry></collision>";
        link(&mut text, name, mass, -0.1, size, shape);
        joint(&mut text, [&parent, name], [0.0, 0.0, z], axis, [-3.1, 3.1], effort);
        parent = name.to_owned();
    }
    text + "</robot>\n"
}

fn folder(name: &str, urdf: &str) -> PathBuf {
    made_up::folder(&format!("init-robots-{name}"), "it.urdf", urdf)
}

/// A run in lockstep that has to end well.
fn run(folder: &Path, changes: &[&str]) -> serde_json::Value {
    let run = ["run", "it/stand.toml", "--set", "clock=lockstep", "--json", "--out", "run"];
    let (status, said, errors) = delmpc(folder, &[&run[..], changes].concat());
    assert_eq!(status, Some(0), "{said}{errors}");
    serde_json::from_str(&said).unwrap()
}

#[test]
fn a_dog_stands_on_its_tips_and_trots_by_keys_alone() {
    let folder = folder("dog", &dog(TIP, [-2.6, -0.9], 30.0));
    let (status, _, errors) = delmpc(&folder, &["init", "it.urdf"]);
    assert_eq!(status, Some(0), "{errors}");
    let robot = delmpc_robots::load(folder.join("it/it.urdf")).unwrap();
    let names: Vec<&str> = robot.soles.iter().map(|sole| sole.name.as_str()).collect();
    assert_eq!(names, ["front_left", "front_right", "back_left", "back_right"]);
    assert!(robot.contacts.iter().all(|contact| (contact.radius - 0.02).abs() < 1e-12));
    assert_eq!(robot.link("fl_shank").unwrap().body, robot.contacts[0].body);
    let stands = run(&folder, &[]);
    assert!(stands["push_impulse_ns"].as_f64().unwrap() > 4.0, "{stands}");
    assert_eq!((&stands["recovered"], &stands["steps_taken"]), (&true.into(), &0.into()), "{stands}");
    let trot = ["--set", "gait.kind=trot", "--set", "gait.speed_m_s=0.3", "--set", "push.impulse_ns=0"];
    let goes = run(&folder, &trot);
    assert!(goes["distance_m"].as_f64().unwrap() > 1.0, "{goes}");
    assert!(goes["base_error_rms_m"].as_f64().unwrap() < 0.02, "{goes}");
}

#[test]
fn a_dog_whose_knees_may_bend_either_way_and_whose_efforts_are_made_up() {
    let folder = folder("either", &dog(TIP, [-10.0, 10.0], 1e4));
    let (status, _, errors) = delmpc(&folder, &["init", "it.urdf"]);
    assert_eq!(status, Some(0), "{errors}");
    let robot = delmpc_robots::load(folder.join("it/it.urdf")).unwrap();
    let posture = robot.posture("stand").unwrap();
    for side in ["fl", "fr", "hl", "hr"] {
        let knee = posture.q[robot.joint(&format!("{side}_shank_joint")).unwrap()];
        assert!(knee < -0.8, "{side}: the knee is behind the hip, and the shank comes forward: {knee}");
    }
    run(&folder, &[]);
}

#[test]
fn an_arm_is_bolted_down_and_reaches() {
    let folder = folder("arm", &arm());
    let (status, _, errors) = delmpc(&folder, &["init", "it.urdf"]);
    assert_eq!(status, Some(0), "{errors}");
    let text = std::fs::read_to_string(folder.join("it/stand.toml")).unwrap();
    assert!(text.contains("base = \"fixed\"") && !text.contains("stance"), "{text}");
    let (status, _, errors) = delmpc(&folder, &["check", "it/stand.toml"]);
    assert_eq!((status, errors.as_str()), (Some(0), ""));
    let reached = run(&folder, &[]);
    assert!(reached["hand_error_at_deadline_m"].as_f64().unwrap() < 0.005, "{reached}");
    assert!(reached["hand_error_hold_max_m"].as_f64().unwrap() < 0.005, "{reached}");
    // Heavier than the controller knows by a tenth, and pushed.
    let push = [
        ["--set", "plant.mass_scale=1.1", "--set", "push.link=elbow", "--set", "push.impulse_ns=2"],
        ["--set", "push.start_s=5", "--set", "duration_s=8", "--set", "seed=2"],
    ]
    .concat();
    run(&folder, &push);
    // The same without the key: it stands on nothing.
    let (status, _, errors) = delmpc(&folder, &["check", "it/stand.toml", "--set", "robot.base=floating"]);
    assert_eq!(status, Some(2));
    assert!(errors.contains("robot.stance"), "{errors}");
    let (status, _, errors) = delmpc(&folder, &["init", "it.urdf", "--stand", "right", "--out", "other"]);
    assert_eq!(status, Some(2));
    assert!(errors.contains("no feet"), "{errors}");
}

#[test]
fn an_arm_on_a_world_link_needs_the_key() {
    let world = "<robot name='arm'><link name='world'/><joint name='mount' type='fixed'><parent link='world'/><child link='foot'/></joint>";
    let folder = folder("world", &arm().replace("<robot name='arm'>", world));
    let (status, _, errors) = delmpc(&folder, &["init", "it.urdf"]);
    assert_eq!(status, Some(0), "{errors}");
    run(&folder, &[]);
    let (status, _, errors) = delmpc(&folder, &["check", "it/stand.toml", "--set", "robot.base=floating"]);
    assert_eq!(status, Some(2));
    assert!(errors.contains("robot.base = \"fixed\""), "{errors}");
}
