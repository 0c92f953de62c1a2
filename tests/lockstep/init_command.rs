//! `delmpc init`: a robot without companion table and scenario gets both, and they run without a change. The robot is made up here: a biped
//! of 30 kg with boxes for feet.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::path::PathBuf;

use crate::made_up::{self, delmpc};

/// A link: mass, where its mass centre is below its joint, what it collides with.
fn link(text: &mut String, name: &str, mass: f64, below: f64, shape: &str) {
    made_up::link(text, name, mass, below, 0.004 * mass, shape);
}

/// A joint: parent, child, place, axis, range, effort.
fn joint(text: &mut String, ends: [&str; 2], at: [f64; 3], axis: &str, range: [f64; 2], effort: f64) {
    made_up::joint(text, ends, at, axis, range, [effort, 12.0]);
}

/// The biped, 1 m tall; `foot` is what its feet collide with.
fn biped(foot: &str) -> String {
    let mut text = String::from("<robot name='mini'>\n");
    link(&mut text, "pelvis", 14.0, -0.15, "");
    for (side, y) in [("r", -0.08), ("l", 0.08)] {
        let name = |part: &str| format!("{side}_{part}");
        let [hip_z, hip_x, thigh, shank, ankle, sole] =
            ["hip_z", "hip_x", "thigh", "shank", "ankle", "sole"].map(name);
        link(&mut text, &hip_z, 0.8, 0.0, "");
        link(&mut text, &hip_x, 0.8, 0.0, "");
        link(&mut text, &thigh, 2.0, 0.12, "");
        link(&mut text, &shank, 1.5, 0.12, "");
        link(&mut text, &ankle, 0.4, 0.0, "");
        link(&mut text, &sole, 0.8, 0.03, foot);
        joint(&mut text, ["pelvis", &hip_z], [0.0, y, 0.0], "0 0 1", [-1.0, 1.0], 60.0);
        joint(&mut text, [&hip_z, &hip_x], [0.0; 3], "1 0 0", [-0.7, 0.7], 120.0);
        joint(&mut text, [&hip_x, &thigh], [0.0; 3], "0 1 0", [-2.0, 1.0], 150.0);
        joint(&mut text, [&thigh, &shank], [0.0, 0.0, -0.28], "0 1 0", [0.0, 2.4], 150.0);
        joint(&mut text, [&shank, &ankle], [0.0, 0.0, -0.28], "0 1 0", [-1.2, 0.8], 80.0);
        joint(&mut text, [&ankle, &sole], [0.0; 3], "1 0 0", [-0.6, 0.6], 60.0);
        let [shoulder, arm, hand, finger] = ["shoulder", "arm", "hand", "finger"].map(name);
        link(&mut text, &shoulder, 0.5, 0.0, "");
        link(&mut text, &arm, 0.8, 0.1, "");
        link(&mut text, &hand, 0.6, 0.15, "");
        link(&mut text, &finger, 0.01, 0.02, "");
        joint(&mut text, ["pelvis", &shoulder], [0.0, 2.0 * y, 0.35], "0 1 0", [-2.5, 2.5], 40.0);
        let open = if y > 0.0 { [-0.2, 2.5] } else { [-2.5, 0.2] };
        joint(&mut text, [&shoulder, &arm], [0.0; 3], "1 0 0", open, 40.0);
        joint(&mut text, [&arm, &hand], [0.0, 0.0, -0.22], "0 1 0", [-2.2, 0.0], 30.0);
        joint(&mut text, [&hand, &finger], [0.0, 0.0, -0.22], "0 1 0", [-0.5, 0.5], 0.0);
    }
    text + "</robot>\n"
}

const BOX: &str =
    "<collision><origin xyz='0.03 0 -0.04'/><geometry><box size='0.2 0.09 0.02'/></geometry></collision>";

fn folder(name: &str, urdf: &str) -> PathBuf {
    made_up::folder(&format!("init-{name}"), "mini.urdf", urdf)
}

#[test]
fn what_init_writes_runs_without_a_change() {
    let folder = folder("runs", &biped(BOX));
    for (out, stand, swing) in [("right", "right", "left"), ("left", "left", "right")] {
        let (status, said, errors) = delmpc(&folder, &["init", "mini.urdf", "--stand", stand, "--out", out]);
        assert_eq!(status, Some(0), "{errors}");
        assert_eq!(said, format!("{out}/mini.urdf\n{out}/mini.toml\n{out}/stand.toml\n"));
        let table = std::fs::read_to_string(folder.join(out).join("mini.toml")).unwrap();
        assert!(table.contains("r_finger_joint\" = 0.0 # its effort is 0"), "{table}");
        let scenario = format!("{out}/stand.toml");
        let (status, said, errors) = delmpc(&folder, &["check", &scenario]);
        assert_eq!((status, errors.as_str()), (Some(0), ""), "{said}");
        let text = std::fs::read_to_string(folder.join(&scenario)).unwrap();
        assert!(text.contains(&format!("hand = \"{swing}_hand\"")), "{text}");
        let run = ["run", &scenario, "--set", "clock=lockstep", "--no-report", "--json", "--out", "run"];
        let (status, said, errors) = delmpc(&folder, &run);
        assert_eq!(status, Some(0), "{said}{errors}");
        let summary: serde_json::Value = serde_json::from_str(&said).unwrap();
        assert!(summary["push_impulse_ns"].as_f64().unwrap() > 3.0, "{said}");
        assert!(summary["hand_error_at_deadline_m"].as_f64().unwrap() < 0.01, "{said}");
        assert_eq!((&summary["fell"], &summary["recovered"]), (&false.into(), &true.into()), "{said}");
    }
    // Nothing of the user's is overwritten.
    let (status, _, errors) = delmpc(&folder, &["init", "mini.urdf", "--out", "right"]);
    assert_eq!(status, Some(2), "{errors}");
    assert!(errors.contains("--force"), "{errors}");
    // A posture for a table that is there.
    let (status, said, errors) = delmpc(&folder, &["model", "right/mini.urdf", "--stand", "left"]);
    assert_eq!(status, Some(0), "{errors}");
    let table = std::fs::read_to_string(folder.join("right/mini.toml")).unwrap();
    std::fs::write(folder.join("right/mini.toml"), table + &said).unwrap();
    let change = ["--set", "robot.stance=left", "--set", "robot.posture=stand_2"];
    let (status, _, errors) = delmpc(&folder, &[&["check", "right/stand.toml"], &change[..]].concat());
    assert_eq!((status, errors.as_str()), (Some(0), ""));
    let (status, _, errors) = delmpc(&folder, &["model", "right/mini.urdf", "--stand", "middle"]);
    assert_eq!(status, Some(2));
    assert!(errors.contains("no sole `middle`; it has right, left"), "{errors}");
}

#[test]
fn a_biped_stands_on_both_feet() {
    let folder = folder("both", &biped(BOX));
    for stand in ["both", "all"] {
        let (status, _, errors) = delmpc(&folder, &["init", "mini.urdf", "--stand", stand, "--out", stand]);
        assert_eq!(status, Some(0), "{errors}");
    }
    let robot = delmpc_robots::load(folder.join("both/mini.urdf")).unwrap();
    let posture = robot.posture("stand").unwrap();
    assert!(posture.q[robot.joint("r_shank_joint").unwrap()] > 0.3, "the knees are bent");
    let run = ["run", "both/stand.toml", "--set", "clock=lockstep", "--no-report", "--json", "--out", "run"];
    let (status, said, errors) = delmpc(&folder, &run);
    assert_eq!(status, Some(0), "{said}{errors}");
    let summary: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert!(summary["push_impulse_ns"].as_f64().unwrap() > 3.0, "{said}");
    assert_eq!(
        (&summary["recovered"], &summary["contact_sets_visited"]),
        (&true.into(), &1.into()),
        "{said}"
    );
}

#[test]
fn soles_are_found_in_many_shapes() {
    let sphere = |x: f64, y: f64| {
        format!(
            "<collision><origin xyz='{x} {y} -0.04'/><geometry><sphere radius='0.01'/></geometry></collision>"
        )
    };
    let spheres =
        [sphere(-0.07, -0.04), sphere(0.13, -0.04), sphere(0.13, 0.04), sphere(-0.07, 0.04)].concat();
    let cylinder = "<collision><origin xyz='0.03 0 -0.04'/><geometry><cylinder radius='0.06' length='0.02'/></geometry></collision>";
    let drawn = BOX.replace("collision", "visual");
    // A pyramid on its base, in millimetres.
    let corner = |x: f64, y: f64, z: f64| format!("vertex {x} {y} {z}\n");
    let (a, b, c, d) = (
        corner(-70.0, -45.0, -50.0),
        corner(130.0, -45.0, -50.0),
        corner(130.0, 45.0, -50.0),
        corner(-70.0, 45.0, -50.0),
    );
    let top = corner(0.0, 0.0, 10.0);
    let mut stl = String::from("solid foot\n");
    for [p, q, r] in
        [[&a, &c, &b], [&a, &d, &c], [&a, &b, &top], [&b, &c, &top], [&c, &d, &top], [&d, &a, &top]]
    {
        stl += &format!("facet normal 0 0 0\nouter loop\n{p}{q}{r}endloop\nendfacet\n");
    }
    stl += "endsolid foot\n";
    let mesh = "<collision><geometry><mesh filename='package://mini/meshes/foot.STL' scale='0.001 0.001 0.001'/></geometry></collision>";
    for (name, foot, corners, length) in [
        ("box", BOX, 4, 0.2),
        ("spheres", &spheres, 4, 0.2),
        ("cylinder", cylinder, 8, 0.12),
        ("drawn", &drawn, 4, 0.2),
        ("mesh", mesh, 4, 0.2),
    ] {
        let folder = folder(&format!("sole-{name}"), &biped(foot));
        std::fs::create_dir_all(folder.join("meshes")).unwrap();
        std::fs::write(folder.join("meshes/foot.STL"), &stl).unwrap();
        let (status, _, errors) = delmpc(&folder, &["init", "mini.urdf"]);
        assert_eq!(status, Some(0), "{name}: {errors}");
        let robot = delmpc_robots::load(folder.join("mini/mini.urdf")).unwrap();
        for sole in ["right", "left"] {
            let polygon = &robot.sole(sole).unwrap().polygon;
            assert_eq!(polygon.len(), corners, "{name}");
            let x = || polygon.iter().map(|corner| corner.x);
            let found = x().fold(f64::MIN, f64::max) - x().fold(f64::MAX, f64::min);
            assert!((found - length).abs() < 0.01, "{name}: {found}");
            let frame = robot.frame(&format!("{sole}_sole")).unwrap();
            assert!((frame.pose.translation.z + 0.05).abs() < 1e-6, "{name}: {}", frame.pose.translation);
        }
    }
}

#[test]
fn what_cannot_stand_is_told_why() {
    let ball = "<collision><origin xyz='0 0 -0.04'/><geometry><sphere radius='0.01'/></geometry></collision>";
    let flat = biped(BOX);
    for (name, urdf, said) in [
        ("points", biped(ball), "2 feet without a flat sole (r_sole, l_sole)"),
        ("bare", biped(""), "no link has a shape whose file is there"),
        (
            "weak",
            flat.replace("lower='-0.7' upper='0.7'", "lower='-0.02' upper='0.02'")
                .replace("lower='-0.6' upper='0.6'", "lower='-0.02' upper='0.02'"),
            "brings the mass centre over it",
        ),
    ] {
        let folder = folder(&format!("not-{name}"), &urdf);
        let (status, _, errors) = delmpc(&folder, &["init", "mini.urdf"]);
        assert_eq!(status, Some(2), "{name}: {errors}");
        assert!(errors.contains(said), "{name}: {errors}");
        assert!(!folder.join("mini").exists(), "{name}: something was left behind");
    }
}
