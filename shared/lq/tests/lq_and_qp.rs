//! Optimality of the Riccati recursion and of the projected QP on random problems.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_problem;

use delmpc_lq::active_set_dual::ActiveSetDual;
use delmpc_lq::dare::solve_dare;
use delmpc_lq::dual_qp::QpSolver;
use delmpc_lq::errors::LqError;
use delmpc_lq::lq_problem::{LqProblem, LqSize};
use delmpc_lq::projected_qp::{ProjectedQp, ProjectedQpOptions, ProjectedQpReport};
use delmpc_lq::riccati::Riccati;
use delmpc_lq::trajectory::Trajectory;
use faer::MatRef;
use random_problem::{Limits, Random, problem, start};

const SIZE: LqSize =
    LqSize { states: 8, inputs: 3, stages: 12, outputs: 4, rows: 4, residuals: 9, squares: 3 };

fn solve(
    problem: &LqProblem,
    x0: &[f64],
    backend: &mut dyn QpSolver,
    options: ProjectedQpOptions,
) -> (Trajectory, ProjectedQpReport) {
    let mut riccati = Riccati::new(problem.size());
    riccati.factorise(problem).unwrap();
    let mut trajectory = Trajectory::new(problem.size());
    trajectory.x_mut(0).copy_from_slice(x0);
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
            let x = t.x(stages);
            let hx: f64 = (0..states).map(|j| symmetric(&problem.terminal_hessian, i, j) * x[j]).sum();
            cost += 0.5 * x[i] * hx + problem.terminal_gradient[i] * x[i];
            hx + problem.terminal_gradient[i]
        })
        .collect();
    let mut gradient = vec![0.0; inputs * stages];
    for k in (0..stages).rev() {
        let stage = &problem.stages[k];
        let (u, x) = (t.u(k), t.x(k));
        let through = |column: usize, of: MatRef<'_, f64>| -> f64 {
            (0..states).map(|r| of[(r, column)] * adjoint[r]).sum()
        };
        for j in 0..inputs {
            let (weight, linear) = (stage.cost.input_weight[j], stage.cost.input_gradient[j]);
            cost += u[j] * (0.5 * weight * u[j] + linear);
            gradient[k * inputs + j] = weight * u[j] + linear + through(j, stage.b());
        }
        let mut by_squares = vec![0.0; states];
        for s in 0..stage.cost.squares.len() {
            let (by_input, by_state, constant) = stage.cost.squares.row(s);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let value = dot(by_input, u) + dot(by_state, x) + constant;
            cost += 0.5 * value * value - 0.5 * constant * constant;
            by_input.iter().enumerate().for_each(|(j, c)| gradient[k * inputs + j] += c * value);
            by_squares.iter_mut().zip(by_state).for_each(|(g, c)| *g += c * value);
        }
        let (hessian, linear) = (stage.cost.state_hessian(), stage.cost.state_linear_term());
        let next: Vec<f64> = (0..states)
            .map(|i| {
                let hx: f64 = (0..states).map(|j| hessian[(i, j)] * x[j]).sum();
                cost += x[i] * (0.5 * hx + linear[i]);
                hx + linear[i] + by_squares[i] + through(i, stage.a())
            })
            .collect();
        adjoint = next;
    }
    (cost, gradient)
}

fn dynamics_defect(problem: &LqProblem, t: &Trajectory) -> f64 {
    let LqSize { states, stages, .. } = problem.size();
    let mut worst: f64 = 0.0;
    for k in 0..stages {
        let stage = &problem.stages[k];
        let (u, x) = (t.u(k), t.x(k));
        for i in 0..states {
            let by_input: f64 = (0..u.len()).map(|j| stage.b()[(i, j)] * u[j]).sum();
            let by_state: f64 = (0..states).map(|j| stage.a()[(i, j)] * x[j]).sum();
            worst = worst.max((by_input + by_state + stage.defect(i) - t.x(k + 1)[i]).abs());
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
        t.x_mut(0).copy_from_slice(&start(seed, SIZE.states, 1.0));
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
        t.x_mut(0).copy_from_slice(x0);
        riccati.rollout(&problem, None, &mut t);
        cost_gradient(&problem, &t).0
    };
    let x = start(1, SIZE.states, 1.0);
    let quadratic: f64 = (0..SIZE.states)
        .map(|i| {
            let px: f64 = (0..SIZE.states).map(|j| riccati.cost_to_go()[(i, j)] * x[j]).sum();
            x[i] * (0.5 * px + riccati.cost_to_go_gradient(i))
        })
        .sum();
    let difference = value(&x) - value(&[0.0; SIZE.states]);
    assert!((difference - quadratic).abs() < 1e-11 * (1.0 + quadratic.abs()));
}

#[test]
fn doubling_solves_the_infinite_horizon_equation() {
    let mut problem = problem(7, SIZE, Limits::NONE);
    assert_eq!(solve_dare(&problem.stages[0]).unwrap_err(), LqError::CrossTerms { count: SIZE.squares });
    problem.stages[0].cost.squares.clear();
    let stage = &problem.stages[0];
    let solution = solve_dare(stage).unwrap();
    // One stage of the recursion must leave it as it is.
    let mut one = LqProblem::new(LqSize { stages: 1, ..SIZE });
    one.stages[0].clone_from(stage);
    one.terminal_hessian.copy_from(&solution.cost_to_go);
    let mut riccati = Riccati::new(one.size());
    riccati.factorise(&one).unwrap();
    for i in 0..SIZE.states {
        for j in 0..SIZE.states {
            let difference = riccati.cost_to_go()[(i, j)] - solution.cost_to_go[(i, j)];
            assert!(difference.abs() < 1e-10, "{difference:e}");
        }
    }
}

/// States and inputs in units six decades apart: efforts of exporters, very light links. The gain is the same one in those units.
#[test]
fn the_infinite_horizon_does_not_depend_on_units() {
    let mut plain = problem(7, SIZE, Limits::NONE);
    plain.stages[0].cost.squares.clear();
    let expected = solve_dare(&plain.stages[0]).unwrap();
    let unit = |index: usize| 10_f64.powi((index * 5 % 7) as i32 - 3);
    let mut other = plain.clone();
    let stage = &mut other.stages[0];
    for row in 0..SIZE.states {
        for column in 0..SIZE.states {
            stage.a_mut()[(row, column)] *= unit(column) / unit(row);
        }
        for input in 0..SIZE.inputs {
            stage.b_mut()[(row, input)] *= unit(input + 2) / unit(row);
        }
    }
    for input in 0..SIZE.inputs {
        stage.cost.input_weight[input] *= unit(input + 2).powi(2);
    }
    for state in 0..SIZE.states {
        stage.cost.state_weight[state] *= unit(state).powi(2);
    }
    for residual in 0..stage.cost.residuals.len() {
        let row = stage.cost.residuals.row_mut(residual);
        row.iter_mut().enumerate().for_each(|(state, value)| *value *= unit(state));
    }
    let found = solve_dare(stage).unwrap();
    for input in 0..SIZE.inputs {
        let scale = (0..SIZE.states).map(|j| expected.gain[(input, j)].abs()).fold(0.0, f64::max);
        for state in 0..SIZE.states {
            let gain = found.gain[(input, state)] * unit(input + 2) / unit(state);
            let difference = (gain - expected.gain[(input, state)]).abs() / scale;
            assert!(difference < 1e-7, "{input} {state}: {difference:e}");
        }
    }
}

#[test]
fn a_mode_without_control_has_no_infinite_horizon_cost() {
    let mut one = problem(7, SIZE, Limits::NONE);
    let stage = &mut one.stages[0];
    for j in 0..SIZE.inputs {
        stage.b_mut()[(0, j)] = 0.0;
    }
    for j in 0..SIZE.states {
        stage.a_mut()[(0, j)] = if j == 0 { 1.1 } else { 0.0 };
    }
    stage.cost.squares.clear();
    assert!(matches!(solve_dare(stage), Err(LqError::NoStabilisingSolution { .. })));
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
    lqr.x_mut(0).copy_from_slice(&x0);
    riccati.rollout(&problem, None, &mut lqr);
    assert!((0..SIZE.stages).all(|k| t.u(k) == lqr.u(k)));
}

/// Joints that rest on their limits ask for a row at every node: more than the dual has room for.
#[test]
fn no_bound_of_a_state_takes_the_place_of_an_input_or_an_output() {
    let options =
        ProjectedQpOptions { capacity: 24, rows_per_round: 12, max_rounds: 20, ..Default::default() };
    let limits = Limits { input: 1.5, row: 1.2, state: 0.25, penalty: 100.0 };
    let mut crowded = 0;
    for seed in 0..40 {
        let problem = problem(seed, SIZE, limits);
        let mut riccati = Riccati::new(SIZE);
        riccati.factorise(&problem).unwrap();
        let mut t = Trajectory::new(SIZE);
        t.x_mut(0).copy_from_slice(&start(seed, SIZE.states, 1.0));
        let mut qp = ProjectedQp::new(SIZE, options);
        let report = qp.solve(&problem, &riccati, &mut ActiveSetDual::new(24), &mut t).unwrap();
        let states = qp.multipliers().filter(|(row, y)| problem.bounds_a_state(*row) && *y > 0.0).count();
        let unmet = (0..SIZE.stages).map(|k| qp.unmet(k)).fold(0.0, f64::max);
        if report.dropped_rows > 0 && states > 0 {
            crowded += 1;
            assert!(unmet < 1e-6, "seed {seed}: {unmet:e} with {states} rows of states, {report:?}");
        }
        // What it says is what the trajectory does.
        for k in 0..SIZE.stages {
            let beyond = t.u(k).iter().map(|u| u.abs() - limits.input).fold(0.0, f64::max);
            assert!(beyond <= qp.unmet(k) * (1.0 + 1e-12) + 1e-9, "seed {seed}, stage {k}: {beyond}");
        }
    }
    assert!(crowded > 10, "problems without room for all: {crowded}");
}

#[cfg(feature = "clarabel")]
mod against_the_oracle {
    use super::*;
    use delmpc_lq::clarabel_dual::ClarabelDual;
    use delmpc_lq::sparse_qp::solve_sparse;

    const TIGHT: ProjectedQpOptions =
        ProjectedQpOptions { capacity: 64, rows_per_round: 24, max_rounds: 20, tolerance: 1e-10, pivots: 12 };

    fn compare(
        seed: u64,
        limits: Limits,
        backend: &mut dyn QpSolver,
        options: ProjectedQpOptions,
    ) -> (f64, ProjectedQpReport) {
        let problem = problem(seed, SIZE, limits);
        let x0 = start(seed, SIZE.states, 1.0);
        let (t, report) = solve(&problem, &x0, backend, options);
        let mut oracle = Trajectory::new(SIZE);
        oracle.x_mut(0).copy_from_slice(&x0);
        solve_sparse(&problem, &mut oracle, 1e-11).unwrap();
        let mut worst: f64 = 0.0;
        let mut size: f64 = 0.0;
        for k in 0..SIZE.stages {
            for (a, b) in t.u(k).iter().zip(oracle.u(k)) {
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
            let (error, report) = compare(seed, limits, &mut ActiveSetDual::new(64), TIGHT);
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
                let (error, report) = compare(seed, limits, &mut ActiveSetDual::new(64), TIGHT);
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
            let (error, report) =
                compare(seed, limits, &mut backend, ProjectedQpOptions { pivots: 0, ..TIGHT });
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
    let solved = hostile(0..2000);
    assert!(solved > 2000, "solved {solved}");
}

#[test]
#[ignore = "a campaign: some minutes"]
fn a_hundred_thousand_hostile_problems() {
    let solved = hostile(0..100_000);
    assert!(solved > 100_000, "solved {solved}");
}

/// Infeasible, badly scaled, rank-deficient, not finite; returns how many were solved, each by every backend with and without pivoting
/// and twice: from the active rows of the problem before, and from its own.
fn hostile(seeds: std::ops::Range<u64>) -> u32 {
    let size = LqSize { states: 4, inputs: 2, stages: 6, outputs: 3, rows: 3, residuals: 5, squares: 0 };
    let mut riccati = Riccati::new(size);
    let options = |pivots| ProjectedQpOptions { capacity: 16, pivots, ..Default::default() };
    let mut qps = [12, 0].map(|pivots| ProjectedQp::new(size, options(pivots)));
    let mut trajectory = Trajectory::new(size);
    let mut backends: Vec<Box<dyn QpSolver>> = vec![Box::new(ActiveSetDual::new(16))];
    #[cfg(feature = "clarabel")]
    backends.push(Box::new(delmpc_lq::clarabel_dual::ClarabelDual::new(16, 1e-8).unwrap()));
    let (mut solved, mut refused) = (0, 0);
    for seed in seeds {
        let mut random = Random::new(seed);
        let scale = 10f64.powf(8.0 * random.signed());
        let limits = Limits {
            input: 10f64.powf(3.0 * random.signed()) - 0.5,
            row: scale * random.signed(),
            state: 10f64.powf(3.0 * random.signed()) - 0.1,
            penalty: 10f64.powf(6.0 * random.signed()),
        };
        let mut problem = problem(seed, size, limits);
        if seed % 7 == 2 {
            problem.stages.iter_mut().for_each(|stage| stage.row_bounds[0] = f64::NEG_INFINITY);
        }
        for stage in &mut problem.stages {
            match seed % 7 {
                1 => stage.a_mut()[(1, 2)] *= scale,
                3 => (0..2).for_each(|output| {
                    let output = stage.output_mut(output);
                    output.by_input.fill(0.0);
                    output.by_state.fill(0.0);
                }),
                4 => {
                    let (by_input, by_state, _) = stage.output(0);
                    let (by_input, by_state) = (by_input.to_vec(), by_state.to_vec());
                    let twin = stage.output_mut(1);
                    twin.by_input.copy_from_slice(&by_input);
                    twin.by_state.copy_from_slice(&by_state);
                }
                5 if seed % 3 == 0 => stage.cost.state_weight[3] = f64::NAN,
                6 if seed % 3 == 0 => stage.set_defect(0, f64::INFINITY),
                _ => {}
            }
        }
        let x0 = start(seed, 4, scale.min(1e6));
        trajectory.x_mut(0).copy_from_slice(&x0);
        if riccati.factorise(&problem).is_err() {
            refused += 1;
            continue;
        }
        for qp in &mut qps {
            for backend in &mut backends {
                for _ in 0..2 {
                    qp.prepare(&problem, &riccati);
                    trajectory.x_mut(0).copy_from_slice(&x0);
                    match qp.solve(&problem, &riccati, backend.as_mut(), &mut trajectory) {
                        Ok(_) => {
                            solved += 1;
                            assert!(trajectory.is_finite(), "seed {seed}");
                        }
                        Err(_) => refused += 1,
                    }
                }
            }
        }
    }
    println!("solved {solved}, refused {refused}");
    solved
}

#[test]
fn a_row_that_a_stage_has_lost_is_not_started_from() {
    let limits = Limits { input: 50.0, row: 0.3, state: 100.0, penalty: 1e3 };
    let mut problem = problem(5, SIZE, limits);
    let x0 = start(5, SIZE.states, 1.0);
    let mut riccati = Riccati::new(SIZE);
    riccati.factorise(&problem).unwrap();
    let mut backend = ActiveSetDual::new(64);
    let mut qp = ProjectedQp::new(SIZE, ProjectedQpOptions::default());
    let mut t = Trajectory::new(SIZE);
    t.x_mut(0).copy_from_slice(&x0);
    let first = qp.solve(&problem, &riccati, &mut backend, &mut t).unwrap();
    let of_outputs = 2 * (SIZE.inputs + SIZE.states);
    assert!(qp.multipliers().any(|(row, y)| usize::from(row.index) >= of_outputs && y > 0.0), "{first:?}");
    for stage in &mut problem.stages {
        stage.row_bounds.fill(f64::INFINITY);
    }
    qp.prepare(&problem, &riccati);
    let warm = qp.solve(&problem, &riccati, &mut backend, &mut t).unwrap();
    let (cold, report) = solve(&problem, &x0, &mut ActiveSetDual::new(64), ProjectedQpOptions::default());
    assert_eq!((warm.dropped_rows, warm.backend_failures), (0, 0));
    assert_eq!((warm.worst, report.worst), (None, None));
    for k in 0..SIZE.stages {
        assert!(t.u(k).iter().zip(cold.u(k)).all(|(a, b)| (a - b).abs() < 1e-8));
    }
}
