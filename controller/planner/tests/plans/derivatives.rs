//! Derivatives of the stage and of the barrier function against differences; the chain against a dense solve.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

use crate::common;

use delmpc_planner::barrier::Barrier;
use delmpc_planner::contact_law::Homotopy;
use delmpc_planner::newton::Minimiser;
use delmpc_planner::problem::Problem;
use delmpc_planner::task::{ExecutionLimits, Task};

/// A point with everything off zero.
fn point(task: &Task, problem: &Problem) -> Vec<f64> {
    let mut next = common::random(3);
    let mut x = task.guess(problem, |_, _| 0.0);
    let scale = if task.robot.planar { 0.1 } else { 0.02 };
    for (i, value) in x.iter_mut().enumerate() {
        *value += if problem.is_fixed(i) { 0.0 } else { scale * next() };
    }
    for k in 0..=problem.stages {
        x[problem.boundary(k) + 2 * problem.layout.n] = task.horizon_s * k as f64 / problem.stages as f64;
    }
    x
}

fn check(mut task: Task, execution: bool) {
    task.execution =
        execution.then_some(ExecutionLimits { touchdown_speed_m_s: 1.5, impact_impulse_ns: 5.0 });
    let problem = task.problem().unwrap();
    let homotopy = Homotopy { kappa: 0.3, sigma: 0.7 };
    let barrier = Barrier { mu: 0.05, delta: 0.1 };
    let x = point(&task, &problem);
    let mut minimiser = Minimiser::new(&problem, &x);
    let mut next = common::random(5);
    for list in &mut minimiser.estimates {
        list.iter_mut().for_each(|y| *y = next().abs());
    }
    // With the penalty's own multipliers the matrix is the Hessian of Φ.
    minimiser.value_and_gradient(homotopy, barrier);
    let multipliers = minimiser.penalty_multipliers().to_vec();
    minimiser.set_curvature_multipliers(|k, r| multipliers[k][r]);
    let size = x.len();
    for trial in 0..4 {
        let mut next = common::random(11 + trial);
        let direction: Vec<f64> = (0..size).map(|i| if problem.is_fixed(i) { 0.0 } else { next() }).collect();
        let at = |minimiser: &mut Minimiser, h: f64| {
            for i in 0..size {
                minimiser.x[i] = x[i] + h * direction[i];
                if problem.is_fixed(i) {
                    minimiser.x[i] = problem.lower[i];
                }
            }
            let (value, gradient) = minimiser.value_and_gradient(homotopy, barrier);
            (value, gradient.to_vec())
        };
        let h = 1e-6;
        let (low, low_gradient) = at(&mut minimiser, -h);
        let (high, high_gradient) = at(&mut minimiser, h);
        let (_, gradient) = at(&mut minimiser, 0.0);
        let product = minimiser.matrix_times(&direction);
        let slope: f64 = gradient.iter().zip(&direction).map(|(g, d)| g * d).sum();
        let difference = (high - low) / (2.0 * h);
        assert!((slope - difference).abs() < 1e-6 * (1.0 + slope.abs()), "{slope} {difference}");
        let largest = product.iter().fold(0.0f64, |a, b| a.max(b.abs()));
        for i in 0..size {
            if problem.is_fixed(i) {
                continue;
            }
            let difference = (high_gradient[i] - low_gradient[i]) / (2.0 * h);
            assert!(
                (product[i] - difference).abs() < 1e-6 * largest,
                "unknown {i}: {} against {difference}, largest {largest}",
                product[i]
            );
        }
        // The rows without derivatives are the rows with them.
        let with: Vec<_> = minimiser.values.iter().map(|v| (v.rows.clone(), v.cost)).collect();
        minimiser.evaluate(homotopy);
        for ((rows, cost), values) in with.iter().zip(&minimiser.values) {
            assert!((cost - values.cost).abs() < 1e-12 * (1.0 + cost.abs()));
            for (a, b) in rows.iter().zip(&values.rows) {
                assert!((a - b).abs() < 1e-12 * (1.0 + a.abs()), "{a} {b}");
            }
        }
    }
}

#[test]
fn flamingo() {
    check(common::flamingo_jump(4), false);
}

#[test]
fn flamingo_with_execution_rows() {
    check(common::flamingo_jump(3), true);
}

#[test]
fn littledog() {
    check(common::littledog_gaps(3), false);
}

#[test]
fn atlas_on_one_foot() {
    check(common::atlas_pick([0.8, 0.3, 0.5], 1.3, 3), false);
}
