//! Whether the controller knows what the plant will do, and whether the summary says what happened.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::{Path, PathBuf};
use std::process::Command as Process;

use delmpc::log::{TRUTH, read_record};
use delmpc::metrics::Metrics;
use delmpc::plant_process::Plant;
use delmpc::robot_controller::RobotController;
use delmpc::setup::{MAIN_SCENARIO, Setup};
use delmpc::simulated_robot::SimulatedRobot;
use delmpc::truth::Truth;
use delmpc_controller_core::contact_wrench::mean_wrench;
use delmpc_controller_core::node_kinematics::NodeKinematics;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_messages::{Command, PlantState};
use serde_json::Value;

fn setup(overrides: &[&str]) -> Setup {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(MAIN_SCENARIO);
    let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
    Setup::read(&file, &overrides).unwrap()
}

/// What a plan says about one stage.
struct Prediction {
    begin_ns: u64,
    end_ns: u64,
    /// `(q, q̇)` at the end, in the order of the foot-rooted tree.
    state: Vec<f64>,
    /// Mean of torque and force of the ground about the sole's origin.
    wrench: [f64; 6],
}

/// Without noise, while the robot reaches for the ball: the state `(q, q̇)` one stage ahead within 1e-3 of its length, the ground's wrench
/// within 2 % of the largest. The stage is the first one, which is as long as a command holds; the servo works on it meanwhile.
#[test]
fn the_plan_says_where_the_plant_will_be() {
    let setup = setup(&[
        "sensors.noise_scale=0",
        "sensors.motion_capture=true",
        "clock=lockstep",
        "reach.start_s=0.2",
    ]);
    let hash = setup.joint_set_hash();
    let joints = setup.robot.joint_names.len();
    let mut plant = SimulatedRobot::new(&setup).unwrap();
    let mut controller = RobotController::new(&setup).unwrap();
    let mut state = PlantState::new(1, hash, joints as u32);
    let mut command = Command::new(1, hash, joints as u32);
    let mut truth = Truth::new(joints as u32);
    let cycle_steps = u64::from(setup.scenario.steps_per_cycle());
    let mut queue: Vec<Command> = Vec::new();
    let mut predictions: Vec<Prediction> = Vec::new();
    let mut history: Vec<Truth> = Vec::new();

    for step in 0..1600_u64 {
        plant.truth(&mut truth);
        history.push(truth);
        if step % cycle_steps == 0 {
            plant.measure(&mut state);
            state.header.sequence += 1;
            controller.cycle(&state, state.time_ns, &mut command);
            command.header.sequence += 1;
            command.state_sequence = state.header.sequence;
            if step == 0 {
                command.valid_from_ns = 0;
            }
            queue.push(command);
            if step >= 300 {
                predictions.push(first_stage(&controller));
            }
        }
        while queue.first().is_some_and(|command| command.valid_from_ns <= truth.time_ns) {
            assert!(plant.accept(&queue.remove(0)));
        }
        plant.step().unwrap();
    }

    let model = controller.one_foot().unwrap().model();
    let at = |time_ns: u64| history.iter().position(|truth| truth.time_ns == time_ns);
    let (mut checked, mut worst_q, mut worst_state, mut worst_wrench) = (0, 0.0_f64, 0.0_f64, 0.0_f64);
    let mut wrench_scale = [0.0_f64; 2];
    let mut wrench_errors = Vec::new();
    for prediction in &predictions {
        let (Some(begin), Some(end)) = (at(prediction.begin_ns), at(prediction.end_ns)) else { continue };
        checked += 1;
        let n = model.message_joint.len();
        let truth = &history[end];
        let q = (0..n).map(|i| prediction.state[i] - truth.position[model.message_joint[i]]);
        let rate = (0..n).map(|i| prediction.state[n + i] - truth.velocity[model.message_joint[i]]);
        worst_q = worst_q.max(norm(q.clone()) / norm(truth.position[..n].iter().copied()));
        worst_state = worst_state.max(norm(q.chain(rate)) / norm(prediction.state.iter().copied()));

        // Of a truth the wrench is that of the step that ended then; the predicted one is the mean over the stage.
        let steps = &history[begin + 1..=end];
        let mean = |i: usize| {
            let of =
                |truth: &Truth| if i < 3 { truth.stance_torque_b[i] } else { truth.stance_force_b[i - 3] };
            steps.iter().map(of).sum::<f64>() / steps.len() as f64
        };
        let mean: [f64; 6] = std::array::from_fn(mean);
        for (part, range) in [0..3, 3..6].into_iter().enumerate() {
            wrench_scale[part] = wrench_scale[part].max(norm(mean[range].iter().copied()));
        }
        let error: [f64; 6] = std::array::from_fn(|i| mean[i] - prediction.wrench[i]);
        wrench_errors.push(error);
    }
    for error in &wrench_errors {
        for (part, range) in [0..3, 3..6].into_iter().enumerate() {
            worst_wrench = worst_wrench.max(norm(error[range].iter().copied()) / wrench_scale[part]);
        }
    }
    println!("{checked} stages: q {worst_q:.1e}, state {worst_state:.1e}, wrench {worst_wrench:.1e}");
    assert!(checked > 200);
    assert!(worst_q <= 1e-5 && worst_state <= 1e-3, "q {worst_q:.2e}, state {worst_state:.2e}");
    assert!(worst_wrench <= 0.02, "wrench {worst_wrench:.3e}");
}

/// The first stage of the last plan.
fn first_stage(controller: &RobotController) -> Prediction {
    let controller = controller.one_foot().unwrap();
    let tree = &controller.model().tree;
    let plan = controller.plan().unwrap();
    let ns = |s: f64| (s * 1e9).round() as u64;
    let length = plan.offsets()[1];
    let n = tree.dof();
    let nodes = [0, 1].map(|k| {
        let (q, rate) = plan.values.x(k).split_at(n);
        let mut node = NodeKinematics::new(tree);
        node.update(tree, q, rate).unwrap();
        node
    });
    let wrench = mean_wrench(tree, &nodes[0], &nodes[1], length);
    Prediction {
        begin_ns: ns(plan.start_s),
        end_ns: ns(plan.start_s + length),
        state: plan.values.x(1).to_vec(),
        wrench: wrench.to_vector().into(),
    }
}

fn norm(values: impl Iterator<Item = f64>) -> f64 {
    values.map(|x| x * x).sum::<f64>().sqrt()
}

/// Every figure of the robot in `summary.json` again from the log, by the records anyone can read.
#[test]
fn the_summary_is_what_the_log_says() {
    let folder = std::env::temp_dir().join(format!("delmpc-summary-{}", std::process::id()));
    let mut run = Process::new(env!("CARGO_BIN_EXE_delmpc"));
    run.args(["run", "--one-process", "--quiet", "--out"]).arg(&folder);
    for change in
        ["clock=lockstep", "duration_s=1.6", "reach.start_s=0.1", "reach.deadline_s=0.6", "reach.hold_s=0.2"]
    {
        run.args(["--set", change]);
    }
    run.args(["--set", "push.start_s=1.2"]).current_dir(env!("CARGO_MANIFEST_DIR"));
    let output = run.output().unwrap();
    // Missed criteria are figures like others.
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", String::from_utf8_lossy(&output.stderr));

    let setup = Setup::read(&folder.join("scenario.toml"), &[]).unwrap();
    let mut metrics = Metrics::new(&setup.scenario).in_stance_frame(&setup.start().unwrap().stance_frame_w);
    let (mut steps, mut commands) = (0, 0_u64);
    let log = std::fs::read(folder.join("log.mcap")).unwrap();
    for message in mcap::MessageStream::new(&log).unwrap() {
        let message = message.unwrap();
        if message.channel.topic == TRUTH {
            metrics.observe(&read_record::<Truth>(&message.data).unwrap());
            steps += 1;
        } else if message.channel.topic == delmpc::log::COMMAND {
            metrics.observe_estimate(&delmpc::log::read_command(&message.data).unwrap());
            commands += 1;
        }
    }
    let summary: Value = read_json(&folder.join("summary.json"));
    let again = serde_json::to_value(metrics.figures()).unwrap();
    for (key, value) in again.as_object().unwrap() {
        assert_eq!(&summary[key], value, "{key}");
    }
    assert_eq!(steps, 1601, "the beginning and 1600 steps");
    assert_eq!(summary["cycles"], commands);
    assert!(summary["hand_error_at_deadline_m"].is_f64());
    std::fs::remove_dir_all(folder).unwrap();
}

fn read_json(file: &PathBuf) -> Value {
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}
