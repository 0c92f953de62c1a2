//! The command as a person calls it: exit status, messages, and the numbers of `delmpc model`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use nalgebra::{Matrix3, Rotation3};
use serde_json::{Value, json};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn delmpc(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
    command.args(arguments).current_dir(ROOT).stdin(Stdio::null()).output().unwrap()
}

/// Runs the command, which must be refused with exit status 2 and say all of `texts`.
fn assert_refused(arguments: &[&str], texts: &[&str]) {
    let output = delmpc(arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {errors}");
    for text in texts {
        assert!(errors.contains(text), "{arguments:?}: no {text:?} in {errors}");
    }
}

/// Runs the command in lockstep with results in a folder of its own; exit status and summary.
fn run(name: &str, more: &[&str]) -> (Option<i32>, Value, String) {
    let folder = scratch(name);
    let out = folder.to_str().unwrap();
    let arguments = [&["run", "--json", "--set", "clock=lockstep", "--out", out], more].concat();
    let output = delmpc(&arguments);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    let summary = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{errors}"));
    let in_file: Value =
        serde_json::from_slice(&std::fs::read(folder.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary, in_file);
    std::fs::remove_dir_all(folder).unwrap();
    (output.status.code(), summary, errors)
}

fn scratch(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("delmpc-command-{}-{name}", std::process::id()))
}

#[test]
fn what_is_not_understood_is_refused_with_status_2() {
    assert_refused(&["fly"], &["fly"]);
    assert_refused(&["run", "--fly"], &["--fly"]);
    assert_refused(&["run", "nowhere.toml"], &["nowhere.toml", "cannot be read"]);
    assert_refused(
        &["run", "--set", "plant.frictoin=1"],
        &["plant.frictoin", "did you mean `plant.friction`?"],
    );
    assert_refused(&["run", "--set", "plant.friction"], &["key=value"]);
    assert_refused(
        &["run", "--set", "plant.friction=-1"],
        &["`plant.friction` = -1", "nearest allowed value is 0"],
    );
    assert_refused(&["run", "--set", "robot.urdf=none.urdf"], &["none.urdf"]);
    assert_refused(&["run", "--set", "robot.stance=middle"], &["`robot.stance`", "right, left"]);
    assert_refused(&["run", "--set", "robot.posture=handstand"], &["`robot.posture`", "one_foot_right"]);
    assert_refused(&["run", "--set", "push.link=tail"], &["`push.link`", "utorso"]);
    assert_refused(&["run", "--set", "reach.hand=tail"], &["`reach.hand`", "l_hand_point"]);
    assert_refused(&["run", "--one-process"], &["--set clock=lockstep"]);
    assert_refused(&["plant", "configs/scenarios/atlas_one_foot.toml", "--run-id", "7"], &["--run-id"]);
    assert_refused(&["run", "--out", "/proc/none"], &["--out /proc/none"]);
}

#[test]
fn a_robot_that_stands_is_a_success() {
    let (status, summary, errors) = run("stands", &["--set", "duration_s=0.5"]);
    assert_eq!(status, Some(0), "{summary} {errors}");
    assert_eq!((&summary["success"], &summary["failure"]), (&json!(true), &Value::Null));
    assert_eq!((&summary["steps"], &summary["cycles"]), (&json!(500), &json!(100)));
    assert_eq!(summary["cycle_time_p50_s"], Value::Null, "lockstep knows no wall clock");
}

#[test]
fn without_a_controller_the_robot_falls_and_the_command_says_so() {
    let (status, summary, errors) = run("falls", &["--set", "controller.kind=off", "--set", "duration_s=4"]);
    assert_eq!(status, Some(1), "{summary} {errors}");
    assert_eq!((&summary["success"], &summary["fell"]), (&json!(false), &json!(true)));
    assert!(summary["failure"].as_str().unwrap().starts_with("the robot fell at"), "{summary}");
}

#[test]
fn the_summary_has_every_key() {
    let keys = "scenario, seed, success, failure, duration_s, clock, steps, fell, fall_time_s, min_com_height_m, \
        max_stance_slip_m, max_stance_tilt_rad, min_cop_margin_m, max_friction_use, max_torque_ratio, \
        hand_error_at_deadline_m, hand_error_hold_max_m, push_impulse_ns, push_direction, recovered, settle_time_s, cycles, \
        cycle_period_s, cycle_time_p50_s, cycle_time_p99_s, cycle_time_p999_s, cycle_time_max_s, linearize_p50_s, \
        riccati_p50_s, qp_p50_s, qp_solves, qp_iterations_max, deadline_misses, fallback_level_max, \
        state_to_command_age_p50_s, state_to_command_age_p999_s, allocations_per_cycle_max, plant_step_p50_s, \
        plant_real_time_factor, energy_balance_error";
    let (_, summary, _) = run("keys", &["--one-process", "--set", "duration_s=0.1"]);
    for key in keys.split(", ") {
        assert!(summary.get(key.trim()).is_some(), "{key} is not in {summary}");
    }
}

#[test]
fn a_run_folder_runs_again_by_itself() {
    let folder = scratch("again");
    let out = folder.to_str().unwrap();
    let first = delmpc(&[
        "run",
        "--json",
        "--one-process",
        "--set",
        "clock=lockstep",
        "--set",
        "duration_s=0.1",
        "--out",
        out,
    ]);
    assert_eq!(first.status.code(), Some(0), "{}", String::from_utf8_lossy(&first.stderr));
    let scenario = folder.join("scenario.toml");
    let again = scratch("again-2");
    let again_out = again.to_str().unwrap();
    let second = delmpc(&["run", scenario.to_str().unwrap(), "--json", "--one-process", "--out", again_out]);
    assert_eq!(first.stdout, second.stdout);
    let log = |folder: &Path| std::fs::read(folder.join("log.mcap")).unwrap();
    assert!(log(&folder) == log(&again));
    std::fs::remove_dir_all(folder).unwrap();
    std::fs::remove_dir_all(again).unwrap();
}

#[test]
fn a_model_is_printed_as_a_table() {
    let output = delmpc(&["model", "configs/robots/atlas.urdf"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0));
    for part in ["floating base, 30 joints", "175.1180 kg", "r_leg_kny", "one_foot_right"] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    assert_refused(&["model", "configs/robots/none.urdf"], &["none.urdf"]);
    assert_refused(&["model", "configs/robots/atlas.urdf", "--base", "flying"], &["fixed:NAME"]);
    assert_refused(&["model", "configs/robots/atlas.urdf", "--base", "fixed:tail"], &["tail"]);
}

fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(list) => list.iter().flat_map(numbers).collect(),
        other => vec![other.as_f64().unwrap_or_else(|| panic!("{other}"))],
    }
}

/// Largest difference relative to the largest expected entry.
#[track_caller]
fn assert_close(what: &str, got: &Value, expected: &Value, tolerance: f64) {
    let (got, expected) = (numbers(got), numbers(expected));
    assert_eq!(got.len(), expected.len(), "{what}");
    let size = expected.iter().fold(1e-300, |size: f64, x| size.max(x.abs()));
    let worst = got.iter().zip(&expected).fold(0.0, |worst: f64, (a, b)| worst.max((a - b).abs()));
    assert!(worst <= tolerance * size, "{what}: off by {worst:e} of {size:e}");
}

fn vector_file(name: &str) -> Value {
    let file = Path::new(ROOT).join("tests/vectors").join(name);
    serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
}

/// Asks `delmpc model --at`.
fn ask(urdf: &str, question: &Value) -> Value {
    static COUNT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let file = scratch(&format!("at-{}.json", COUNT.fetch_add(1, std::sync::atomic::Ordering::Relaxed)));
    std::fs::write(&file, question.to_string()).unwrap();
    let at = file.to_str().unwrap();
    let output = delmpc(&["model", urdf, "--at", at, "--accept-impossible-inertia"]);
    std::fs::remove_file(file).unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A URDF of a model table of the test vectors. Link 0 is the ground.
fn urdf_of(model: &Value) -> String {
    let vector = |value: &Value| {
        let words: Vec<String> = numbers(value).iter().map(|x| format!("{x:?}")).collect();
        words.join(" ")
    };
    let mut text = String::from("<robot name=\"vector\">\n<link name=\"ground\"/>\n");
    for (index, body) in model["bodies"].as_array().unwrap().iter().enumerate() {
        let name = format!("j{}", index + 1);
        let parent = match body["parent"].as_u64().unwrap() {
            0 => "ground".to_owned(),
            parent => format!("l{parent}"),
        };
        let r = numbers(&body["placement"]["R"]);
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_row_slice(&r));
        let (roll, pitch, yaw) = rotation.euler_angles();
        let inertia = numbers(&body["inertia"]);
        let kind = if body["joint"] == "revolute" { "continuous" } else { "prismatic" };
        let damping = body.get("damping").and_then(Value::as_f64).unwrap_or(0.0);
        let _ = write!(
            text,
            "<link name=\"l{0}\"><inertial><origin xyz=\"{1}\"/><mass value=\"{2:?}\"/><inertia ixx=\"{3:?}\" \
             ixy=\"{4:?}\" ixz=\"{5:?}\" iyy=\"{6:?}\" iyz=\"{7:?}\" izz=\"{8:?}\"/></inertial></link>\n\
             <joint name=\"{name}\" type=\"{kind}\"><parent link=\"{parent}\"/><child link=\"l{0}\"/>\
             <origin xyz=\"{9}\" rpy=\"{roll:?} {pitch:?} {yaw:?}\"/><axis xyz=\"{10}\"/>\
             <limit lower=\"-9\" upper=\"9\" effort=\"9\" velocity=\"9\"/><dynamics damping=\"{damping:?}\"/></joint>\n",
            index + 1,
            vector(&body["com"]),
            body["mass"].as_f64().unwrap(),
            inertia[0],
            inertia[1],
            inertia[2],
            inertia[4],
            inertia[5],
            inertia[8],
            vector(&body["placement"]["t"]),
            vector(&body["axis"]),
        );
    }
    text + "</robot>\n"
}

/// Every vector of a fixed robot that a URDF can describe (no springs, no drag), through the command.
#[test]
fn model_at_gives_the_numbers_of_the_test_vectors() {
    for (name, order) in [
        ("pendulum2_s2", "simpson"),
        ("pendulum2_s3", "lobatto3"),
        ("pendulum2_s4", "lobatto4"),
        ("pendulum5_spatial_s1", "trapezoidal"),
        ("tree8_s3", "lobatto3"),
        ("atlas_v4_rfoot_s2", "simpson"),
    ] {
        let case = vector_file(&format!("{name}.json"));
        let model = match case.get("model_ref") {
            Some(file) => vector_file(file.as_str().unwrap()),
            None => case["model"].clone(),
        };
        let bodies = model["bodies"].as_array().unwrap();
        let beyond_urdf =
            |body: &Value| ["stiffness", "drag", "wrench_body"].iter().any(|key| body.get(key).is_some());
        assert!(!bodies.iter().any(beyond_urdf), "{name} is nothing a URDF can say");
        let urdf = scratch(&format!("{name}.urdf"));
        std::fs::write(&urdf, urdf_of(&model)).unwrap();

        // The vectors number the joints by body; the command by branch.
        let by_name = |key: &str| -> Value {
            let values = case[key].as_array().unwrap().iter().enumerate();
            values
                .map(|(i, value)| (format!("j{}", i + 1), value.clone()))
                .collect::<serde_json::Map<_, _>>()
                .into()
        };
        let question = json!({
            "q": by_name("q0"), "qdot": by_name("qd0"), "u": by_name("u"), "dt": case["dt"], "order": order,
            "gravity": model["gravity"],
        });
        let answer = ask(urdf.to_str().unwrap(), &question);
        std::fs::remove_file(urdf).unwrap();
        let order: Vec<usize> = answer["joints"]
            .as_array()
            .unwrap()
            .iter()
            .map(|joint| joint.as_str().unwrap()[1..].parse::<usize>().unwrap() - 1)
            .collect();
        let n = order.len();
        let reordered = |value: &Value| -> Value { order.iter().map(|&i| value[i].clone()).collect() };
        let twice: Vec<usize> = order.iter().copied().chain(order.iter().map(|i| n + i)).collect();
        let matrix = |value: &Value, columns: &[usize]| -> Value {
            twice.iter().map(|&i| columns.iter().map(|&j| value[i][j].clone()).collect::<Value>()).collect()
        };
        let solution = &case["solution"];
        let last = solution["qbar"].as_array().unwrap().last().unwrap();
        assert_close(&format!("{name} p"), &answer["p"], &reordered(&case["p0"]), 1e-12);
        assert_close(&format!("{name} K"), &answer["kinetic_energy"], &case["energy"]["K0"], 1e-12);
        assert_close(&format!("{name} V"), &answer["potential_energy"], &case["energy"]["V0"], 1e-12);
        assert_close(&format!("{name} q_next"), &answer["q_next"], &reordered(last), 1e-10);
        assert_close(&format!("{name} p_next"), &answer["p_next"], &reordered(&solution["p1"]), 1e-10);
        assert_close(&format!("{name} qdot_next"), &answer["qdot_next"], &reordered(&solution["qd1"]), 1e-10);
        assert_close(&format!("{name} A"), &answer["A"], &matrix(&case["linearisation"]["A"], &twice), 1e-10);
        assert_close(&format!("{name} B"), &answer["B"], &matrix(&case["linearisation"]["B"], &order), 1e-10);
        let m = case["alg23_at_q0"]["K_qdqd"].clone();
        let m: Value = order.iter().map(|&i| reordered(&m[i])).collect();
        assert_close(&format!("{name} M"), &answer["mass_matrix"], &m, 1e-12);
    }
}

/// In the coordinates of the base link: p = M v, and the linear step is symplectic.
#[test]
fn model_at_speaks_of_the_base_link_of_a_floating_robot() {
    let urdf = "configs/robots/atlas.urdf";
    let twist = [0.3, -0.2, 0.5, 0.1, 0.7, -0.4];
    let question = json!({
        "q": {"r_leg_kny": 0.9, "back_bkx": 0.1}, "qdot": {"r_leg_kny": 1.5, "l_arm_shx": -2.0},
        "base_pose": {"xyz": [0.1, 0.2, 0.9], "quaternion_xyzw": [0.1, -0.2, 0.3, 0.927_361_849_549_570_4]},
        "base_twist": {"angular": twist[..3], "linear": twist[3..]},
    });
    let answer = ask(urdf, &question);
    assert!(answer.get("A").is_none() && answer.get("q_next").is_none());
    assert_eq!(answer["floating"], true);
    let mut velocity = twist.to_vec();
    velocity.extend(
        answer["joints"].as_array().unwrap().iter().map(|joint| {
            question["qdot"].get(joint.as_str().unwrap()).and_then(Value::as_f64).unwrap_or(0.0)
        }),
    );
    let rows: Vec<Vec<f64>> = answer["mass_matrix"].as_array().unwrap().iter().map(numbers).collect();
    let momentum: Vec<f64> =
        rows.iter().map(|row| row.iter().zip(&velocity).map(|(m, v)| m * v).sum()).collect();
    assert_close("p = M v", &answer["p"], &json!(momentum), 1e-12);
    let doubled: f64 = momentum.iter().zip(&velocity).map(|(p, v)| p * v).sum();
    assert_close("kinetic energy", &answer["kinetic_energy"], &json!(doubled / 2.0), 1e-12);
    // The linear momentum of the whole, in the axes of the base link, is mass times velocity of a point: the first-moment block.
    assert!((rows[3][3] - answer["total_mass"].as_f64().unwrap()).abs() < 1e-9);

    let mut with_step = question.clone();
    with_step["dt"] = json!(0.005);
    with_step["order"] = json!("simpson");
    let answer = ask(urdf, &with_step);
    let a: Vec<Vec<f64>> = answer["A"].as_array().unwrap().iter().map(numbers).collect();
    let n = a.len() / 2;
    // Joint damping is dissipation: look at the base, which has none of its own, only roughly.
    let form =
        |i: usize, j: usize| -> f64 { (0..n).map(|k| a[k][i] * a[n + k][j] - a[n + k][i] * a[k][j]).sum() };
    for i in 0..6 {
        for j in 0..6 {
            let expected = if i == j { 1.0 } else { 0.0 };
            assert!((form(i, n + j) - expected).abs() < 1e-3, "{i} {j}: {}", form(i, n + j));
        }
    }
    assert_eq!(answer["base_pose_next"]["xyz"].as_array().unwrap().len(), 3);
}

#[test]
fn model_at_refuses_what_it_does_not_understand() {
    let refuse = |question: Value, text: &str| {
        let file = scratch(&format!("wrong-{}.json", text.len()));
        std::fs::write(&file, question.to_string()).unwrap();
        assert_refused(&["model", "configs/robots/atlas.urdf", "--at", file.to_str().unwrap()], &[text]);
        std::fs::remove_file(file).unwrap();
    };
    refuse(json!({"q": {"tail": 1.0}}), "no such joint");
    refuse(json!({"speed": {}}), "unknown field `speed`");
    refuse(json!({"dt": -0.1}), "time step");
    refuse(json!({"dt": 0.01, "u_nodes": [{}]}), "this order has 3 nodes");
    refuse(json!({"base_pose": {"quaternion_xyzw": [0, 0, 0, 0]}}), "has the length 0, must be 1");
}
