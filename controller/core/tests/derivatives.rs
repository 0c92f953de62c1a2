//! Task Jacobians, contact-wrench map and stage dynamics against central differences, on Atlas in motion.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;
mod random;

use atlas::atlas;
use delmpc_controller_core::contact_wrench::{StageWrench, mean_wrench};
use delmpc_controller_core::model::ControllerModel;
use delmpc_controller_core::node_kinematics::NodeKinematics;
use delmpc_controller_core::stage_dynamics::StageDynamics;
use delmpc_controller_core::tasks::{MAX_RESIDUALS, TaskTargets, TaskWeights, Tasks};
use delmpc_horizon::foot_cone::{FlatFoot, WrenchCone};
use delmpc_lq::lq_problem::{LqProblem, LqSize};
use delmpc_lq::lq_stage::Residuals;
use nalgebra::Vector3;
use random::Random;

/// Central differences with this step: truncation and round-off meet near 1e-9 relative.
const STEP: f64 = 1e-5;
const TOLERANCE: f64 = 1e-6;

fn moving_state(model: &ControllerModel) -> Vec<f64> {
    let mut random = Random::new(4);
    let mut x: Vec<f64> = model.posture.iter().map(|q| q + 0.1 * random.signed()).collect();
    x.extend((0..model.posture.len()).map(|_| 0.8 * random.signed()).collect::<Vec<_>>());
    x
}

#[test]
fn task_jacobians_are_the_derivatives_of_the_residuals() {
    let model = atlas().controller_model();
    let n = model.posture.len();
    let weights = TaskWeights {
        com: [3.0, 2.0, 1.0],
        com_velocity: [1.5, 2.5, 0.5],
        spin: [0.3, 0.2, 0.1],
        hand: 2.0,
        hand_velocity: 0.7,
        swing_foot: [1.2, 0.8, 1.0],
        swing_foot_rotation: 0.9,
        ..TaskWeights::default()
    };
    let tasks = Tasks::new(n, weights, model.hand, model.swing_foot);
    let mut targets = TaskTargets::new(n);
    targets.hand = Vector3::new(0.5, 0.3, 0.6);
    targets.hand_velocity = Vector3::new(0.1, -0.2, 0.3);
    targets.hand_activity = 1.0;
    let x = moving_state(&model);
    let mut node = NodeKinematics::new(&model.tree);
    node.update(&model.tree, &x[..n], &x[n..]).unwrap();
    // The rotation residual's Jacobian is exact at the reference only.
    targets.swing_foot_rotation = node.link_pose_w(model.swing_foot.unwrap().body).rotation;
    let mut residuals = Residuals::new(2 * n, MAX_RESIDUALS);
    tasks.linearize(&model.tree, &node, &targets, 1.0, &mut residuals);
    let jacobian = residuals.clone();
    assert_eq!(jacobian.len(), 21);
    for i in 0..2 * n {
        let mut at = |sign: f64| -> Vec<f64> {
            let mut moved = x.clone();
            moved[i] += sign * STEP;
            node.update(&model.tree, &moved[..n], &moved[n..]).unwrap();
            tasks.linearize(&model.tree, &node, &targets, 1.0, &mut residuals);
            (0..residuals.len()).map(|r| residuals.value(r)).collect()
        };
        let (plus, minus) = (at(1.0), at(-1.0));
        for r in 0..plus.len() {
            let slope = (plus[r] - minus[r]) / (2.0 * STEP);
            let error = (slope - jacobian.row(r)[i]).abs();
            assert!(
                error < TOLERANCE * (1.0 + slope.abs()),
                "x {i}, residual {r}: {slope} {}",
                jacobian.row(r)[i]
            );
        }
    }
}

#[test]
fn transition_and_wrench_map_are_the_derivatives_of_the_simulated_stage() {
    let model = atlas().controller_model();
    let tree = &model.tree;
    let n = tree.dof();
    let mut random = Random::new(9);
    let x = moving_state(&model);
    let u: Vec<f64> = model.limits.iter().map(|limit| 0.01 * limit.effort * random.signed()).collect();
    let mut dynamics = StageDynamics::new(tree).unwrap();
    for time_step in [0.01, 0.05] {
        let mut problem =
            LqProblem::new(LqSize { states: 2 * n, inputs: n, stages: 1, outputs: 6, ..LqSize::default() });
        let stage = &mut problem.stages[0];
        let mut end = vec![0.0; 2 * n];
        dynamics.simulate(tree, &x, &u, time_step, &mut end).unwrap();
        dynamics.linearise(tree, &x, &u, time_step, &end, stage).unwrap();
        assert!((0..2 * n).all(|i| stage.defect(i).abs() < 1e-9), "the defect vanishes at the simulated end");
        let (mut first, mut second) = (NodeKinematics::new(tree), NodeKinematics::new(tree));
        first.update(tree, &x[..n], &x[n..]).unwrap();
        second.update(tree, &end[..n], &end[n..]).unwrap();
        let mut wrench = StageWrench::new(n);
        wrench.linearize(tree, &first, &second, time_step, stage);

        let mut simulate = |z: &[f64]| {
            let (u, x) = z.split_at(n);
            let mut end = vec![0.0; 2 * n];
            dynamics.simulate(tree, x, u, time_step, &mut end).unwrap();
            first.update(tree, &x[..n], &x[n..]).unwrap();
            second.update(tree, &end[..n], &end[n..]).unwrap();
            (end, mean_wrench(tree, &first, &second, time_step).to_vector())
        };
        let z: Vec<f64> = u.iter().chain(&x).copied().collect();
        let column = |i: usize| if i < n { stage.b().col(i) } else { stage.a().col(i - n) };
        let map = |row: usize, i: usize| {
            let (by_input, by_state, _) = stage.output(row);
            if i < n { by_input[i] } else { by_state[i - n] }
        };
        for i in 0..3 * n {
            let step = if i < n { 1e-3 } else { STEP };
            let mut at = |sign: f64| {
                let mut moved = z.clone();
                moved[i] += sign * step;
                simulate(&moved)
            };
            let ((plus, wrench_plus), (minus, wrench_minus)) = (at(1.0), at(-1.0));
            for r in 0..2 * n {
                let slope = (plus[r] - minus[r]) / (2.0 * step);
                let error = (slope - column(i)[r]).abs();
                assert!(error < 1e-5 * (1.0 + slope.abs()), "z {i}, x {r}: {slope} {}", column(i)[r]);
            }
            for r in 0..6 {
                let slope = (wrench_plus[r] - wrench_minus[r]) / (2.0 * step);
                let error = (slope - map(r, i)).abs();
                assert!(error < 1e-4 * (1.0 + slope.abs()), "z {i}, wrench {r}: {slope} {}", map(r, i));
            }
        }
    }
}

#[test]
fn a_standing_robot_presses_with_its_weight_below_its_mass_centre() {
    let model = atlas().controller_model();
    let tree = &model.tree;
    let mut node = NodeKinematics::new(tree);
    node.update(tree, &model.posture, &vec![0.0; tree.dof()]).unwrap();
    let wrench = mean_wrench(tree, &node, &node, 0.02);
    let weight = 9.81 * 175.11796399999994;
    assert!((wrench.force.z - weight).abs() < 1e-9 * weight);
    let pressure = [-wrench.torque.y / wrench.force.z, wrench.torque.x / wrench.force.z];
    assert!((pressure[0] - node.com().x).abs() < 1e-12 && (pressure[1] - node.com().y).abs() < 1e-12);
}

#[test]
fn the_cone_holds_what_a_flat_foot_can_do_and_nothing_else() {
    let foot = FlatFoot {
        polygon: vec![[-0.13, -0.06], [0.13, -0.06], [0.13, 0.06], [-0.13, 0.06]],
        margin_m: 0.01,
        friction: 0.6,
        friction_sides: 8,
        yaw_arm_m: 0.06,
        min_force_n: 100.0,
    };
    let cone = WrenchCone::flat_foot(&foot, 1700.0, 1.0).unwrap();
    assert_eq!(cone.rows().len(), 1 + 8 + 4 + 2);
    let inside = |w: [f64; 6]| {
        cone.rows().iter().all(|row| {
            let value: f64 = row.coefficients.iter().zip(&w).map(|(c, w)| c * w).sum();
            value <= row.bound + 1e-12
        })
    };
    let f = 1000.0;
    assert!(inside([0.0, 0.0, 0.0, 0.0, 0.0, f]));
    assert!(!inside([0.0, 0.0, 0.0, 0.0, 0.0, 99.0]), "the ground does not pull");
    // Pressure point p = (-τ_y, τ_x) / f.
    for (px, py, allowed) in
        [(0.119, 0.049, true), (0.121, 0.0, false), (-0.121, 0.0, false), (0.0, 0.051, false)]
    {
        assert_eq!(inside([py * f, -px * f, 0.0, 0.0, 0.0, f]), allowed, "{px} {py}");
    }
    for angle in 0..16 {
        let (sin, cos) = (angle as f64 * std::f64::consts::PI / 8.0).sin_cos();
        assert!(inside([0.0, 0.0, 0.0, 0.55 * f * cos, 0.55 * f * sin, f]));
        assert!(!inside([0.0, 0.0, 0.0, 0.601 * f * cos, 0.601 * f * sin, f]));
    }
    assert!(inside([0.0, 0.0, 59.0, 0.0, 0.0, f]) && !inside([0.0, 0.0, -61.0, 0.0, 0.0, f]));
    assert!(WrenchCone::flat_foot(&FlatFoot { margin_m: 0.07, ..foot }, 1700.0, 1.0).is_err());
}
