//! The small dual problem by both solvers: what has no solution is refused, and a refusal leaves nothing behind.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_problem;

use delmpc_lq::active_set_dual::ActiveSetDual;
use delmpc_lq::dual_qp::{QpSolver, dual_residual};
use delmpc_lq::errors::QpError;
use faer::Mat;
use random_problem::Random;

/// What an interior-point method leaves of a degenerate row.
const TOLERANCE: f64 = 1e-3;
const HARD: f64 = f64::INFINITY;

/// `min ½ y'Γy + h'y, 0 <= y <= ρ`.
struct Dual {
    gram: Mat<f64>,
    slack: Vec<f64>,
    upper: Vec<f64>,
}

impl Dual {
    fn new<const N: usize>(gram: [[f64; N]; N], slack: [f64; N], upper: [f64; N]) -> Self {
        Self { gram: Mat::from_fn(N, N, |i, j| gram[i][j]), slack: slack.into(), upper: upper.into() }
    }

    /// `Γ = G G'` of random rows of unit length, `rank` of them independent.
    fn random(random: &mut Random, rows: usize, rank: usize, upper: f64) -> Self {
        let mut g = Mat::from_fn(rows, rank, |_, _| random.signed());
        for i in 0..rows {
            let norm = (0..rank).map(|j| g[(i, j)] * g[(i, j)]).sum::<f64>().sqrt();
            (0..rank).for_each(|j| g[(i, j)] /= norm);
        }
        let gram = &g * g.transpose();
        Self { gram, slack: (0..rows).map(|_| random.signed()).collect(), upper: vec![upper; rows] }
    }

    fn solve(&self, solver: &mut dyn QpSolver) -> Result<Vec<f64>, QpError> {
        let mut y = vec![0.0; self.slack.len()];
        solver.solve(self.gram.as_ref(), &self.slack, &self.upper, &mut y).map(|_| y)
    }

    fn residual(&self, y: &[f64]) -> f64 {
        dual_residual(self.gram.as_ref(), &self.slack, &self.upper, y)
    }
}

fn solvers() -> Vec<Box<dyn QpSolver>> {
    let mut solvers: Vec<Box<dyn QpSolver>> = vec![Box::new(ActiveSetDual::new(64))];
    #[cfg(feature = "clarabel")]
    solvers.push(Box::new(delmpc_lq::clarabel_dual::ClarabelDual::new(64, 1e-8).unwrap()));
    solvers
}

/// Problems without a solution: no minimum, no convexity, nothing between the bounds, no numbers.
fn unsolvable() -> Vec<(&'static str, Dual)> {
    let contradict = [[1.0, -1.0], [-1.0, 1.0]];
    vec![
        ("rows that contradict each other", Dual::new(contradict, [-1.0; 2], [HARD; 2])),
        ("rows that contradict each other a little", Dual::new(contradict, [-1.0, 0.99], [HARD; 2])),
        ("rows that contradict each other, much", Dual::new(contradict, [-1e9, 1e3], [HARD; 2])),
        ("a row of zeros that is violated", Dual::new([[0.0]], [-1.0], [HARD])),
        ("an indefinite matrix", Dual::new([[1.0, 3.0], [3.0, 1.0]], [-1.0; 2], [HARD; 2])),
        ("an indefinite matrix in a box", Dual::new([[1.0, 3.0], [3.0, 1.0]], [-1.0; 2], [5.0; 2])),
        (
            "an indefinite matrix of opposite rows",
            Dual::new([[1.0, -3.0], [-3.0, 1.0]], [-1.0; 2], [HARD; 2]),
        ),
        ("a negative diagonal", Dual::new([[-1.0, 0.0], [0.0, 1.0]], [-1.0; 2], [5.0; 2])),
        ("a bound below zero", Dual::new([[1.0]], [-1.0], [-1.0])),
        ("a slack that is no number", Dual::new([[1.0]], [f64::NAN], [HARD])),
        ("an infinite entry", Dual::new([[f64::INFINITY]], [-1.0], [HARD])),
    ]
}

#[test]
fn what_has_no_solution_is_refused_and_the_next_problem_is_solved() {
    let good = Dual::random(&mut Random::new(5), 8, 8, HARD);
    for mut solver in solvers() {
        for (what, dual) in unsolvable() {
            let answer = dual.solve(solver.as_mut());
            assert!(answer.is_err(), "{what}: {answer:?} by {solver:?}");
            for _ in 0..2 {
                let y = good.solve(solver.as_mut());
                let y = y.unwrap_or_else(|error| panic!("after {what}: {error} by {solver:?}"));
                assert!(good.residual(&y) < TOLERANCE, "after {what}: {:e}", good.residual(&y));
            }
        }
    }
}

/// Matrices that are nothing in particular, then a good problem of the same size; all sizes.
#[test]
fn a_solver_recovers_from_any_matrix() {
    let mut random = Random::new(9);
    for mut solver in solvers() {
        for round in 0..400 {
            let rows = 1 + round % 20;
            let mut wild = Dual::random(&mut random, rows, rows, if round % 2 == 0 { HARD } else { 3.0 });
            let size = 10f64.powf(150.0 * random.signed());
            for i in 0..rows {
                for j in 0..=i {
                    let value = size * random.signed();
                    (wild.gram[(i, j)], wild.gram[(j, i)]) = (value, value);
                }
            }
            if let Ok(y) = wild.solve(solver.as_mut()) {
                let scale = wild.slack.iter().fold(0.0f64, |m, h| m.max(h.abs()));
                assert!(
                    y.iter().all(|y| y.is_finite()) && wild.residual(&y) <= 1e-3 * scale,
                    "round {round}"
                );
            }
            let good = Dual::random(&mut random, rows, rows.max(3), 10.0);
            let y = good.solve(solver.as_mut()).unwrap_or_else(|error| panic!("round {round}: {error}"));
            assert!(good.residual(&y) < TOLERANCE, "round {round}: {:e}", good.residual(&y));
        }
    }
}

/// Dependent rows that do not contradict each other have a solution, and both solvers find one.
#[test]
fn dependent_rows_are_solved() {
    let mut random = Random::new(3);
    for mut solver in solvers() {
        for round in 0..200 {
            let (rows, rank) = (4 + round % 20, 2 + round % 5);
            let dual = Dual::random(&mut random, rows, rank, 10.0);
            let y = dual.solve(solver.as_mut()).unwrap_or_else(|error| panic!("round {round}: {error}"));
            assert!(dual.residual(&y) < TOLERANCE, "round {round}: {:e} by {solver:?}", dual.residual(&y));
        }
    }
}
