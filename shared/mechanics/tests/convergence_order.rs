//! Orders of the integrator, measured: `2s` at the step boundaries, fixed and floating base, with and without dissipation.
//!
//! The reference is the same trajectory by `s = 6` (order 12) with small steps; a second reference with half the steps shows that
//! it has converged far below every error it is used for. Every step is solved to round-off (exact Newton). The order is the slope of `log(error)` over `log(steps)`.
#![allow(clippy::panic, clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod sample_robots;

use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::log_rotation;
use sample_robots::{
    Forces, GRAVITY, arms, brick, difference, exact_integrator, moving_state, quadruped, spatial_chain,
    spread,
};

/// Length of the motion, s.
const DURATION: f64 = 0.4;
/// Errors are the largest of this many times: one alone may sit where the leading error term changes its sign.
const QUARTERS: usize = 4;
/// How far a measured order may be from `2s` (the bar): the next term of the error still shows at these steps.
const ORDER_TOLERANCE: f64 = 0.15;
/// Nodes and steps of the reference.
const REFERENCE: (usize, usize) = (6, 96);
/// Exact quantities: round-off of some hundred steps, relative to the size of the quantity.
const ROUND_OFF: f64 = 2e-13;
/// The reference may be uncertain by this part of an error: it then moves a measured order by a third of the tolerance at most.
const REFERENCE_DOUBT: f64 = 0.1;

/// The states at each quarter of the motion.
fn run(tree: &KinematicTree, start: &State, torque: &[f64], s: usize, steps: usize) -> Vec<State> {
    assert!(steps.is_multiple_of(QUARTERS));
    let mut integrator = exact_integrator(tree, s, DURATION / steps as f64);
    let mut state = start.clone();
    let mut quarters = Vec::with_capacity(QUARTERS);
    for step in 1..=steps {
        integrator
            .step(tree, &mut state, &StepForces::held(torque))
            .unwrap_or_else(|e| panic!("s = {s}, step {step} of {steps}: {e}"));
        if step.is_multiple_of(steps / QUARTERS) {
            quarters.push(state.clone());
        }
    }
    quarters
}

/// Errors of a state by quantity: name, absolute error, size of the quantity.
fn state_errors(tree: &KinematicTree, got: &State, want: &State) -> Vec<(&'static str, f64, f64)> {
    let size = |x: &[f64]| x.iter().fold(1.0f64, |m, x| m.max(x.abs()));
    let mut all = Vec::new();
    let base = tree.base_dof();
    if base > 0 {
        let turn = log_rotation(&want.base_pose.rotation.tr_mul(&got.base_pose.rotation)).amax();
        all.push(("R", turn, 1.0));
        let place = want.base_pose.translation;
        all.push(("p", (got.base_pose.translation - place).amax(), size(place.as_slice())));
        all.push(("P", difference(&got.p[..6], &want.p[..6]), size(&want.p[..6])));
    }
    if tree.joint_count() > 0 {
        all.push(("q", difference(&got.q, &want.q), size(&want.q)));
        all.push(("p_j", difference(&got.p[base..], &want.p[base..]), size(&want.p[base..])));
    }
    all
}

/// The same, largest over the quarters of the motion.
fn errors(tree: &KinematicTree, got: &[State], want: &[State]) -> Vec<(&'static str, f64, f64)> {
    let mut all: Vec<_> = got.iter().zip(want).map(|(got, want)| state_errors(tree, got, want)).collect();
    let mut worst = all.pop().unwrap();
    for quarter in all {
        for (worst, other) in worst.iter_mut().zip(quarter) {
            *worst = (worst.0, worst.1.max(other.1), worst.2.max(other.2));
        }
    }
    worst
}

/// Least-squares slope of `-log(error)` over `log(steps)`.
fn order(steps: &[usize], errors: &[f64]) -> f64 {
    let x: Vec<f64> = steps.iter().map(|&n| (n as f64).ln()).collect();
    let y: Vec<f64> = errors.iter().map(|e| -e.ln()).collect();
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mx, my) = (mean(&x), mean(&y));
    let cross: f64 = x.iter().zip(&y).map(|(x, y)| (x - mx) * (y - my)).sum();
    cross / x.iter().map(|x| (x - mx) * (x - mx)).sum::<f64>()
}

/// Measures the order of every quantity with the given numbers of steps for `s = 1, 2, ..`; `exact` names quantities that must come
/// out exact instead.
fn check_orders(name: &str, tree: &KinematicTree, start: &State, steps: &[&[usize]], exact: &[&str]) {
    let torque = spread(tree.joint_count(), 0.5);
    let reference = run(tree, start, &torque, REFERENCE.0, REFERENCE.1);
    let doubt = errors(tree, &run(tree, start, &torque, REFERENCE.0, REFERENCE.1 / 2), &reference);
    let mut wrong = Vec::new();
    for (index, counts) in steps.iter().enumerate() {
        let s = index + 1;
        let runs: Vec<_> =
            counts.iter().map(|&n| errors(tree, &run(tree, start, &torque, s, n), &reference)).collect();
        for (k, &(quantity, uncertain, size)) in doubt.iter().enumerate() {
            let series: Vec<f64> = runs.iter().map(|run| run[k].1).collect();
            let shown: Vec<String> = series.iter().map(|e| format!("{e:.1e}")).collect();
            let shown = format!("{name} s = {s} {quantity}: errors {} at {counts:?} steps", shown.join(" "));
            if exact.contains(&quantity) {
                println!("{shown}: exact");
                if series.iter().any(|e| *e > ROUND_OFF * size) {
                    wrong.push(format!("{shown}, should be exact"));
                }
                continue;
            }
            let measured = order(counts, &series);
            println!("{shown}, order {measured:.3} (reference known to {uncertain:.0e})");
            if (measured - 2.0 * s as f64).abs() > ORDER_TOLERANCE {
                wrong.push(format!("{shown}, order {measured:.3} instead of {}", 2 * s));
            }
            if series.iter().any(|e| uncertain > REFERENCE_DOUBT * e) {
                wrong.push(format!("{shown}: too close to the reference, known to {uncertain:.0e}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn a_spatial_chain_converges_with_order_two_four_six_and_eight() {
    let tree = spatial_chain(GRAVITY, Forces::None);
    let start = moving_state(&tree, 0.0, 1.5);
    let steps: [&[usize]; 4] = [&[64, 128, 256], &[32, 64, 128], &[8, 16, 32], &[4, 8, 12]];
    check_orders("chain", &tree, &start, &steps, &[]);
}

#[test]
fn a_spatial_chain_with_every_force_of_the_model_keeps_its_orders() {
    let tree = spatial_chain(GRAVITY, Forces::All);
    let start = moving_state(&tree, 0.0, 2.0);
    let steps: [&[usize]; 4] = [&[64, 128, 256], &[32, 64, 128], &[16, 32, 64], &[12, 16, 24]];
    check_orders("chain with forces", &tree, &start, &steps, &[]);
}

/// The chart of the base follows its mass centre: the parabola of a single body is exact.
#[test]
fn a_tumbling_brick_converges_with_order_two_four_and_six_and_flies_on_an_exact_parabola() {
    let tree = brick(GRAVITY, Forces::None);
    let start = moving_state(&tree, 4.0, 0.0);
    let steps: [&[usize]; 3] = [&[64, 128, 256], &[16, 32, 64], &[4, 8, 12]];
    check_orders("brick", &tree, &start, &steps, &["p", "P"]);
}

#[test]
fn a_brick_with_drag_and_a_constant_wrench_keeps_its_orders() {
    let tree = brick(GRAVITY, Forces::All);
    let start = moving_state(&tree, 4.0, 0.0);
    let steps: [&[usize]; 3] = [&[64, 128, 256], &[16, 32, 64], &[4, 8, 16]];
    check_orders("brick with forces", &tree, &start, &steps, &[]);
}

#[test]
fn a_base_with_arms_converges_with_order_two_four_and_six_in_pose_joints_and_momenta() {
    let tree = arms(GRAVITY, Forces::Springs);
    let start = moving_state(&tree, 3.0, 1.0);
    let steps: [&[usize]; 3] = [&[128, 256, 512], &[32, 64, 128], &[16, 32, 48]];
    check_orders("arms", &tree, &start, &steps, &[]);
}

#[test]
fn a_base_with_arms_keeps_its_orders_with_every_force_of_the_model() {
    let tree = arms(GRAVITY, Forces::All);
    let start = moving_state(&tree, 3.0, 1.0);
    let steps: [&[usize]; 3] = [&[128, 256, 512], &[32, 64, 128], &[16, 32, 48]];
    check_orders("arms with forces", &tree, &start, &steps, &[]);
}

#[test]
fn a_quadruped_converges_with_order_two_four_and_six() {
    let tree = quadruped(GRAVITY, Forces::All);
    let start = moving_state(&tree, 2.0, 1.0);
    let steps: [&[usize]; 3] = [&[128, 256, 512], &[32, 64, 128], &[48, 64, 96]];
    check_orders("quadruped", &tree, &start, &steps, &[]);
}
