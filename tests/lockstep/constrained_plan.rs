//! The constrained problem of cycles that really occur, solved in two ways: by projection with its small dual, as the controller does,
//! and as one sparse problem over the whole horizon in Clarabel.
//!
//! The robot takes a push to the left at which the pressure point, the torques and the joints meet their limits.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;

use delmpc::plant_process::Plant;
use delmpc::robot_controller::RobotController;
use delmpc::setup::{MAIN_SCENARIO, Setup};
use delmpc::simulated_robot::SimulatedRobot;
use delmpc_controller_core::prelude as core;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_lq::lq_problem::RowId;
use delmpc_lq::riccati::Riccati;
use delmpc_lq::sparse_qp::solve_sparse;
use delmpc_lq::trajectory::Trajectory;
use delmpc_messages::{Command, PlantState};

const PUSH: [&str; 6] = [
    "clock=lockstep",
    "reach.start_s=50",
    "push.start_s=0.2",
    "push.direction=[0, 1, 0]",
    "push.impulse_ns=36",
    "push.duration_s=0.1",
];

/// Calls `visit` with the controller after each of `cycles` cycles, each answered at the next one.
fn drive(cycles: usize, mut visit: impl FnMut(usize, &RobotController)) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(MAIN_SCENARIO);
    let setup = Setup::read(&file, &PUSH.map(String::from)).unwrap();
    let (hash, joints) = (setup.joint_set_hash(), setup.robot.joint_names.len() as u32);
    let mut plant = SimulatedRobot::new(&setup).unwrap();
    let mut controller = RobotController::new(&setup).unwrap();
    let mut state = PlantState::new(1, hash, joints);
    let mut command = Command::new(1, hash, joints);
    for cycle in 0..cycles {
        plant.measure(&mut state);
        state.header.sequence += 1;
        let last = command;
        controller.cycle(&state, state.time_ns, &mut command);
        command.header.sequence += 1;
        command.state_sequence = state.header.sequence;
        visit(cycle, &controller);
        if cycle == 0 {
            command.valid_from_ns = 0;
            assert!(plant.accept(&command));
        } else {
            plant.accept(&last);
        }
        for _ in 0..setup.scenario.steps_per_cycle() {
            plant.step().unwrap();
        }
    }
}

/// Largest difference of the torque of the first stage, relative to the largest torque of the command.
fn difference(command: &[f64], a: &Trajectory, b: &Trajectory) -> f64 {
    let largest = |values: &[f64]| values.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
    let errors: Vec<f64> = a.u(0).iter().zip(b.u(0)).map(|(a, b)| a - b).collect();
    largest(&errors) / largest(command)
}

/// Violation of the optimality conditions of a plan with its multipliers, each relative to the size of its terms: stationarity in
/// every input, rows that hold (or pay their penalty), complementarity.
///
/// The multipliers `λ` of the dynamics may be chosen. `λ_k = Q x + q + A'λ_{k+1} + (rows) + K'g` with the violation `g` of stationarity
/// in the input leaves `K'g` in the state; the recursion with `A'` alone would amplify round-off like the robot a disturbance.
fn optimality(core: &core::Controller, multipliers: &[(RowId, f64)]) -> f64 {
    let (problem, plan) = (core.problem(), core.solution());
    let size = problem.size();
    let stages = size.stages;
    let mut worst = 0.0_f64;
    let mut adjoint: Vec<f64> = (0..size.states)
        .map(|i| {
            let row = |j: usize| problem.terminal_hessian[(i.max(j), i.min(j))];
            let product: f64 = (0..size.states).map(|j| row(j) * plan.x(stages)[j]).sum();
            product + problem.terminal_gradient[i]
        })
        .collect();
    let mut coefficients = vec![0.0; size.inputs + size.states];
    for k in (0..=stages).rev() {
        coefficients.fill(0.0);
        for &(row, multiplier) in multipliers.iter().filter(|(row, _)| usize::from(row.stage) == k) {
            problem.add_row(row, multiplier, &mut coefficients);
        }
        let (by_input, by_state) = coefficients.split_at(size.inputs);
        if k == stages {
            adjoint.iter_mut().zip(by_state).for_each(|(a, c)| *a += c);
            continue;
        }
        let stage = &problem.stages[k];
        let (a, b) = (stage.a(), stage.b());
        let through_a = |i: usize| (0..size.states).map(|row| a[(row, i)] * adjoint[row]).sum::<f64>();
        let through_b = |j: usize| (0..size.states).map(|row| b[(row, j)] * adjoint[row]).sum::<f64>();
        let mut scale = 0.0_f64;
        let gradient: Vec<f64> = (0..size.inputs)
            .map(|j| {
                let cost = stage.cost.input_weight[j] * plan.u(k)[j] + stage.cost.input_gradient[j];
                let carried = through_b(j);
                scale = scale.max(cost.abs()).max(carried.abs()).max(by_input[j].abs());
                cost + carried + by_input[j]
            })
            .collect();
        worst = gradient.iter().fold(worst, |worst, g| worst.max(g.abs() / scale));
        let (hessian, linear) = (stage.cost.state_hessian(), stage.cost.state_linear_term());
        let gain = core.gain(k);
        adjoint = (0..size.states)
            .map(|i| {
                let product: f64 = (0..size.states).map(|j| hessian[(i, j)] * plan.x(k)[j]).sum();
                let closed: f64 = (0..size.inputs).map(|j| gain[(j, i)] * gradient[j]).sum();
                product + linear[i] + through_a(i) + by_state[i] + closed
            })
            .collect();
    }
    let largest = multipliers.iter().fold(f64::MIN_POSITIVE, |m, (_, multiplier)| m.max(*multiplier));
    for &(row, multiplier) in multipliers {
        coefficients.fill(0.0);
        problem.add_row(row, 1.0, &mut coefficients);
        let k = usize::from(row.stage);
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let (by_input, by_state) = coefficients.split_at(size.inputs);
        let value = if k < stages { dot(by_input, plan.u(k)) } else { 0.0 } + dot(by_state, plan.x(k));
        let (tag, violation) = (problem.tag(row), value - problem.bound(row));
        assert!(multiplier >= 0.0 && multiplier <= tag.penalty * (1.0 + 1e-9), "{tag:?}: {multiplier}");
        // Broken and not paid for, or paid for and not broken: the less of the two, each relative to its size.
        let relative = violation.abs() / tag.scale;
        let most = if tag.penalty.is_finite() { tag.penalty } else { largest };
        let unpaid = if violation > 0.0 { (tag.penalty - multiplier) / most } else { multiplier / most };
        worst = worst.max(relative.min(unpaid));
    }
    worst
}

/// What was found over some cycles.
#[derive(Debug, Default)]
struct Findings {
    cycles: usize,
    constrained: usize,
    most_active_rows: usize,
    worst_difference: f64,
    worst_optimality: f64,
    worst_lqr_difference: f64,
}

/// Compares every `stride`th cycle.
fn compare(cycles: usize, stride: usize) -> Findings {
    let mut findings = Findings::default();
    let mut riccati = None;
    drive(cycles, |cycle, controller| {
        if cycle == 0 || cycle % stride != 0 {
            return;
        }
        let core = controller.one_foot().unwrap();
        let (problem, plan) = (core.problem(), core.solution());
        let torque = core.plan().unwrap().values.u(0);
        let multipliers: Vec<(RowId, f64)> =
            core.constrained().multipliers().filter(|(_, multiplier)| *multiplier > 0.0).collect();
        findings.cycles += 1;
        let optimality = optimality(core, &multipliers);
        findings.worst_optimality = findings.worst_optimality.max(optimality);
        let mut other = plan.clone();
        if multipliers.is_empty() {
            let riccati = riccati.get_or_insert_with(|| Riccati::new(problem.size()));
            riccati.factorise(problem).unwrap();
            riccati.rollout(problem, None, &mut other);
            findings.worst_lqr_difference =
                findings.worst_lqr_difference.max(difference(torque, plan, &other));
        } else {
            findings.constrained += 1;
            findings.most_active_rows = findings.most_active_rows.max(multipliers.len());
        }
        solve_sparse(problem, &mut other, 1e-10).unwrap();
        let difference = difference(torque, plan, &other);
        findings.worst_difference = findings.worst_difference.max(difference);
        if optimality > 1e-6 || difference > 1e-6 {
            println!(
                "cycle {cycle}, {} active rows: difference {difference:.1e}, optimality {optimality:.1e}",
                multipliers.len()
            );
        }
    });
    println!("{findings:?}");
    findings
}

fn agree(findings: &Findings) {
    assert!(findings.worst_optimality <= 1e-6, "{findings:?}");
    assert!(findings.worst_lqr_difference <= 1e-9, "{findings:?}");
    assert!(findings.worst_difference <= 1e-6, "{findings:?}");
}

#[test]
fn both_forms_give_the_same_command_while_the_robot_is_pushed() {
    let findings = compare(90, 9);
    agree(&findings);
    assert!(findings.constrained >= 3, "{findings:?}");
}

#[test]
#[ignore = "a campaign: 1000 sparse problems, some minutes"]
fn both_forms_give_the_same_command_in_a_thousand_cycles() {
    let findings = compare(1001, 1);
    agree(&findings);
    assert!(findings.cycles == 1000 && findings.constrained >= 100, "{findings:?}");
}
