//! Optimality of the Riccati recursion and of the projected QP on random problems.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_problem;

use delmpc_controller_core::active_set_dual::ActiveSetDual;
use delmpc_controller_core::dare::solve_dare;
use delmpc_controller_core::dual_qp::QpSolver;
use delmpc_controller_core::lq_problem::{LqProblem, LqSize};
use delmpc_controller_core::projected_qp::{ProjectedQp, ProjectedQpOptions, ProjectedQpReport};
use delmpc_controller_core::riccati::{Riccati, Trajectory};
use random_problem::{Limits, Random, problem, start};

const SIZE: LqSize = LqSize { states: 8, inputs: 3, stages: 12, rows: 4 };

fn solve(
    problem: &LqProblem,
    x0: &[f64],
    backend: &mut dyn QpSolver,
    options: ProjectedQpOptions,
) -> (Trajectory, ProjectedQpReport) {
    let mut riccati = Riccati::new(problem.size());
    riccati.factorise(problem).unwrap();
    let mut trajectory = Trajectory::new(problem.size());
    trajectory.x.col_as_slice_mut(0).copy_from_slice(x0);
    let mut qp = ProjectedQp::new(problem.size(), options);
    let report = qp.solve(problem, &riccati, backend, &mut trajectory).unwrap();
    (trajectory, report)
}

/// Gradient of the cost along the dynamics, by the adjoint: must vanish at the unconstrained optimum.
fn cost_gradient(problem: &LqProblem, t: &Trajectory) -> (f64, Vec<f64>) {
    let LqSize { states, inputs, stages, .. } = problem.size();
    let symmetric = |m: &faer::Mat<f64>, i: usize, j: usize| if i >= j { m[(i, j)] } else { m[(j, i)] };
    let mut cost = 0.0;
    let mut adjoint: Vec<f64> = (0..states)
        .map(|i| {
            let x = t.x.col_as_slice(stages);
            let hx: f64 = (0..states).map(|j| symmetric(&problem.terminal_hessian, i, j) * x[j]).sum();
            cost += 0.5 * x[i] * hx + problem.terminal_gradient[i] * x[i];
            hx + problem.terminal_gradient[i]
        })
        .collect();
    let mut gradient = vec![0.0; inputs * stages];
    for k in (0..stages).rev() {
        let stage = &problem.stages[k];
        let z: Vec<f64> = t.u.col_as_slice(k).iter().chain(t.x.col_as_slice(k)).copied().collect();
        let g: Vec<f64> = (0..inputs + states)
            .map(|i| {
                let hz: f64 = (0..z.len()).map(|j| symmetric(&stage.hessian, i, j) * z[j]).sum();
                cost += z[i] * (0.5 * hz + stage.gradient[i]);
                let through: f64 = (0..states).map(|r| stage.transition[(r, i)] * adjoint[r]).sum();
                hz + stage.gradient[i] + through
            })
            .collect();
        gradient[k * inputs..(k + 1) * inputs].copy_from_slice(&g[..inputs]);
        adjoint.copy_from_slice(&g[inputs..]);
    }
    (cost, gradient)
}

fn dynamics_defect(problem: &LqProblem, t: &Trajectory) -> f64 {
    let LqSize { states, stages, .. } = problem.size();
    let mut worst: f64 = 0.0;
    for k in 0..stages {
        let stage = &problem.stages[k];
        let z: Vec<f64> = t.u.col_as_slice(k).iter().chain(t.x.col_as_slice(k)).copied().collect();
        for i in 0..states {
            let next: f64 = (0..z.len()).map(|j| stage.transition[(i, j)] * z[j]).sum();
            worst = worst.max((next + stage.defect[i] - t.x[(i, k + 1)]).abs());
        }
    }
    worst
}

#[test]
fn riccati_rollout_satisfies_the_optimality_conditions() {
    for seed in 0..20 {
        let problem = problem(seed, SIZE, Limits::NONE);
        let mut riccati = Riccati::new(SIZE);
        riccati.factorise(&problem).unwrap();
        let mut t = Trajectory::new(SIZE);
        t.x.col_as_slice_mut(0).copy_from_slice(&start(seed, SIZE.states, 1.0));
        riccati.rollout(&problem, None, &mut t);
        let (_, gradient) = cost_gradient(&problem, &t);
        let worst = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        assert!(worst < 1e-11, "seed {seed}: gradient {worst:e}");
        assert!(dynamics_defect(&problem, &t) < 1e-12);
    }
}

#[test]
fn the_cost_to_go_is_the_cost_that_follows() {
    let problem = problem(3, SIZE, Limits::NONE);
    let mut riccati = Riccati::new(SIZE);
    riccati.factorise(&problem).unwrap();
    let value = |x0: &[f64]| {
        let mut t = Trajectory::new(SIZE);
        t.x.col_as_slice_mut(0).copy_from_slice(x0);
        riccati.rollout(&problem, None, &mut t);
        cost_gradient(&problem, &t).0
    };
    let x = start(1, SIZE.states, 1.0);
    let quadratic: f64 = (0..SIZE.states)
        .map(|i| {
            let px: f64 = (0..SIZE.states).map(|j| riccati.cost_to_go(0)[(i, j)] * x[j]).sum();
            x[i] * (0.5 * px + riccati.cost_to_go_gradient(0)[i])
        })
        .sum();
    let difference = value(&x) - value(&[0.0; SIZE.states]);
    assert!((difference - quadratic).abs() < 1e-11 * (1.0 + quadratic.abs()));
}

#[test]
fn updating_the_gradients_equals_factorising_again() {
    let mut changed = problem(5, SIZE, Limits::NONE);
    let mut riccati = Riccati::new(SIZE);
    riccati.factorise(&changed).unwrap();
    for stage in &mut changed.stages {
        stage.defect[1] += 0.2;
        stage.gradient[4] -= 0.1;
    }
    riccati.update_gradients(&changed);
    let mut fresh = Riccati::new(SIZE);
    fresh.factorise(&changed).unwrap();
    for k in 0..SIZE.stages {
        for (a, b) in riccati.feed_forward(k).iter().zip(fresh.feed_forward(k)) {
            assert!((a - b).abs() < 1e-13);
        }
    }
}

#[test]
fn doubling_solves_the_infinite_horizon_equation() {
    let problem = problem(7, SIZE, Limits::NONE);
    let stage = &problem.stages[0];
    let solution = solve_dare(stage.transition.as_ref(), stage.hessian.as_ref(), SIZE.inputs).unwrap();
    // One stage of the recursion must leave it as it is.
    let mut one = LqProblem::new(LqSize { stages: 1, ..SIZE });
    one.stages[0].transition.copy_from(&stage.transition);
    one.stages[0].hessian.copy_from(&stage.hessian);
    one.terminal_hessian.copy_from(&solution.cost_to_go);
    let mut riccati = Riccati::new(one.size());
    riccati.factorise(&one).unwrap();
    for i in 0..SIZE.states {
        for j in 0..SIZE.states {
            let difference = riccati.cost_to_go(0)[(i, j)] - solution.cost_to_go[(i, j)];
            assert!(difference.abs() < 1e-10, "{difference:e}");
        }
    }
}

#[test]
fn a_mode_without_control_has_no_infinite_horizon_cost() {
    let mut one = problem(7, SIZE, Limits::NONE);
    let stage = &mut one.stages[0];
    for j in 0..SIZE.inputs + SIZE.states {
        stage.transition[(0, j)] = if j == SIZE.inputs { 1.1 } else { 0.0 };
    }
    assert!(solve_dare(stage.transition.as_ref(), stage.hessian.as_ref(), SIZE.inputs).is_err());
}

#[test]
fn without_an_active_constraint_the_answer_is_the_lqr_s() {
    let limits = Limits { input: 50.0, row: 500.0, state: 100.0, penalty: 1e3 };
    let problem = problem(11, SIZE, limits);
    let x0 = start(11, SIZE.states, 1.0);
    let (t, report) = solve(&problem, &x0, &mut ActiveSetDual::new(64), ProjectedQpOptions::default());
    assert_eq!(report.solves, 0);
    let mut riccati = Riccati::new(SIZE);
    riccati.factorise(&problem).unwrap();
    let mut lqr = Trajectory::new(SIZE);
    lqr.x.col_as_slice_mut(0).copy_from_slice(&x0);
    riccati.rollout(&problem, None, &mut lqr);
    assert!((0..SIZE.stages).all(|k| t.u.col_as_slice(k) == lqr.u.col_as_slice(k)));
}

#[cfg(feature = "clarabel")]
mod against_the_oracle {
    use super::*;
    use delmpc_controller_core::clarabel_dual::ClarabelDual;
    use delmpc_controller_core::sparse_qp::solve_sparse;

    const TIGHT: ProjectedQpOptions =
        ProjectedQpOptions { capacity: 64, rows_per_round: 24, max_rounds: 20, tolerance: 1e-10 };

    fn compare(seed: u64, limits: Limits, backend: &mut dyn QpSolver) -> (f64, ProjectedQpReport) {
        let problem = problem(seed, SIZE, limits);
        let x0 = start(seed, SIZE.states, 1.0);
        let (t, report) = solve(&problem, &x0, backend, TIGHT);
        let mut oracle = Trajectory::new(SIZE);
        oracle.x.col_as_slice_mut(0).copy_from_slice(&x0);
        solve_sparse(&problem, &mut oracle, 1e-11).unwrap();
        let mut worst: f64 = 0.0;
        let mut size: f64 = 0.0;
        for k in 0..SIZE.stages {
            for (a, b) in t.u.col_as_slice(k).iter().zip(oracle.u.col_as_slice(k)) {
                worst = worst.max((a - b).abs());
                size = size.max(b.abs());
            }
        }
        (worst / size, report)
    }

    #[test]
    fn both_forms_give_the_same_inputs_with_hard_input_bounds() {
        let mut active = 0;
        for seed in 0..40 {
            let limits = Limits { input: 0.5, ..Limits::NONE };
            let (error, report) = compare(seed, limits, &mut ActiveSetDual::new(64));
            assert!(error < 1e-6, "seed {seed}: {error:e} {report:?}");
            active += report.active_rows;
        }
        assert!(active > 40, "constraints were active: {active}");
    }

    #[test]
    fn both_forms_give_the_same_inputs_with_soft_rows_and_states() {
        let mut gave_way = 0;
        for seed in 0..40 {
            for penalty in [0.05, 100.0] {
                let limits = Limits { input: 1.5, row: 1.2, state: 1.0, penalty };
                let (error, report) = compare(seed, limits, &mut ActiveSetDual::new(64));
                if report.dropped_rows > 0 {
                    continue;
                }
                assert!(error < 1e-6, "seed {seed}, penalty {penalty}: {error:e} {report:?}");
                gave_way += usize::from(report.worst.is_some());
            }
        }
        assert!(gave_way > 10, "soft rows gave way: {gave_way}");
    }

    #[test]
    fn the_clarabel_backend_agrees_with_the_oracle() {
        let mut backend = ClarabelDual::new(64, 1e-11).unwrap();
        for seed in 0..40 {
            let limits = Limits { input: 1.2, row: 1.5, state: 1.5, penalty: 10.0 };
            let (error, report) = compare(seed, limits, &mut backend);
            if report.dropped_rows > 0 {
                continue;
            }
            assert!(error < 1e-6, "seed {seed}: {error:e} {report:?}");
            assert_eq!(report.backend_failures, 0);
        }
    }
}

#[test]
fn hostile_problems_neither_panic_nor_answer_with_non_finite_numbers() {
    let size = LqSize { states: 4, inputs: 2, stages: 6, rows: 3 };
    let mut riccati = Riccati::new(size);
    let mut qp = ProjectedQp::new(size, ProjectedQpOptions { capacity: 16, ..Default::default() });
    let mut trajectory = Trajectory::new(size);
    let mut backends: Vec<Box<dyn QpSolver>> = vec![Box::new(ActiveSetDual::new(16))];
    #[cfg(feature = "clarabel")]
    backends.push(Box::new(delmpc_controller_core::clarabel_dual::ClarabelDual::new(16, 1e-8).unwrap()));
    let (mut solved, mut refused) = (0, 0);
    for seed in 0..4000u64 {
        let mut random = Random::new(seed);
        let scale = 10f64.powf(8.0 * random.signed());
        let limits = Limits {
            input: 10f64.powf(3.0 * random.signed()) - 0.5,
            row: scale * random.signed(),
            state: 10f64.powf(3.0 * random.signed()) - 0.1,
            penalty: 10f64.powf(6.0 * random.signed()),
        };
        let mut problem = problem(seed, size, limits);
        for stage in &mut problem.stages {
            match seed % 7 {
                1 => stage.transition[(1, 2)] *= scale,
                2 => stage.row_bound[0] = f64::NEG_INFINITY,
                3 => stage.rows.as_mut().subcols_mut(0, 2).fill(0.0),
                4 => {
                    for i in 0..6 {
                        stage.rows[(i, 1)] = stage.rows[(i, 0)];
                    }
                }
                5 if seed % 3 == 0 => stage.hessian[(3, 3)] = f64::NAN,
                6 if seed % 3 == 0 => stage.defect[0] = f64::INFINITY,
                _ => {}
            }
        }
        let x0 = start(seed, 4, scale.min(1e6));
        trajectory.x.col_as_slice_mut(0).copy_from_slice(&x0);
        if riccati.factorise(&problem).is_err() {
            refused += 1;
            continue;
        }
        for backend in &mut backends {
            trajectory.x.col_as_slice_mut(0).copy_from_slice(&x0);
            match qp.solve(&problem, &riccati, backend.as_mut(), &mut trajectory) {
                Ok(_) => {
                    solved += 1;
                    assert!(trajectory.is_finite(), "seed {seed}");
                }
                Err(_) => refused += 1,
            }
        }
    }
    assert!(solved > 4000, "solved {solved}, refused {refused}");
}
