//! The same problem as one sparse multiple-shooting QP in Clarabel: the oracle of the tests, and a comparison.
//!
//! Unknowns `u_0..u_{N-1}, x_1..x_N`, one slack per soft row; the dynamics are equalities, `x_0` is substituted.
//! Two orders of magnitude slower than [`crate::projected_qp`] at n = 30, N = 20. Allocates.

use std::vec;
use std::vec::Vec;

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSolver, IPSolver, SolverStatus, SupportedConeT};

use crate::clarabel_dual::settings;
use crate::errors::QpError;
use crate::lq_problem::{LqProblem, LqSize, RowId};
use crate::trajectory::Trajectory;

/// Solves `problem` from the first node of `trajectory` to `tolerance` and fills the rest; returns the iterations.
///
/// # Errors
/// [`QpError`] when Clarabel refuses the data or does not reach a solution.
pub fn solve_sparse(
    problem: &LqProblem,
    trajectory: &mut Trajectory,
    tolerance: f64,
) -> Result<u32, QpError> {
    let LqSize { states, inputs, stages, .. } = problem.size();
    let u_at = |k: usize| k * inputs;
    let x_at = |k: usize| stages * inputs + (k - 1) * states;
    let mut unknowns = stages * (inputs + states);
    let start: Vec<f64> = trajectory.x(0).to_vec();

    // Inputs in units that make their weight 1: the solver's tolerances are absolute.
    let unit = |k: usize, j: usize| {
        let weight = problem.stages[k].cost.input_weight[j];
        if weight > 0.0 && weight.is_finite() { 1.0 / libm::sqrt(weight) } else { 1.0 }
    };
    let mut hessian = Triplets::default();
    let mut gradient = vec![0.0; unknowns];
    for (k, stage) in problem.stages.iter().enumerate() {
        for (j, (weight, linear)) in
            stage.cost.input_weight.iter().zip(&stage.cost.input_gradient).enumerate()
        {
            let unit = unit(k, j);
            hessian.add(u_at(k) + j, u_at(k) + j, unit * unit * weight);
            gradient[u_at(k) + j] += unit * linear;
        }
        for s in 0..stage.cost.squares.len() {
            // On all of (u, x): a row of the first stage has its state given.
            let (by_input, by_state, constant) = stage.cost.squares.row(s);
            let given: f64 = if k == 0 { by_state.iter().zip(&start).map(|(c, x)| c * x).sum() } else { 0.0 };
            let mut row: Vec<(usize, f64)> =
                by_input.iter().enumerate().map(|(j, c)| (u_at(k) + j, unit(k, j) * c)).collect();
            if k > 0 {
                row.extend(by_state.iter().enumerate().map(|(i, c)| (x_at(k) + i, *c)));
            }
            for (i, (at, c)) in row.iter().enumerate() {
                gradient[*at] += c * (constant + given);
                for (other, d) in &row[i..] {
                    hessian.add(*at, *other, c * d);
                }
            }
        }
        if k == 0 {
            continue;
        }
        let (state_hessian, linear) = (stage.cost.state_hessian(), stage.cost.state_linear_term());
        for column in 0..states {
            gradient[x_at(k) + column] += linear[column];
            for row in column..states {
                hessian.add(x_at(k) + column, x_at(k) + row, state_hessian[(row, column)]);
            }
        }
    }
    for column in 0..states {
        gradient[x_at(stages) + column] += problem.terminal_gradient[column];
        for row in column..states {
            hessian.add(x_at(stages) + column, x_at(stages) + row, problem.terminal_hessian[(row, column)]);
        }
    }

    let mut matrix = Triplets::default();
    let mut bound = Vec::new();
    for (k, stage) in problem.stages.iter().enumerate() {
        for row in 0..states {
            let mut right = -stage.defect(row);
            for j in 0..inputs {
                matrix.add(bound.len(), u_at(k) + j, unit(k, j) * stage.b()[(row, j)]);
            }
            for (j, x) in start.iter().enumerate() {
                let a = stage.a()[(row, j)];
                if k == 0 { right -= a * x } else { matrix.add(bound.len(), x_at(k) + j, a) }
            }
            matrix.add(bound.len(), x_at(k + 1) + row, -1.0);
            bound.push(right);
        }
    }
    let equalities = bound.len();

    let mut coefficients = vec![0.0; inputs + states];
    for node in 0..=stages {
        let rows = 2 * (inputs + states) + if node < stages { problem.output_rows.len() } else { 0 };
        for index in 0..rows {
            let is_state = (2 * inputs..2 * (inputs + states)).contains(&index);
            if (is_state && node == 0) || (index < 2 * inputs && node == stages) {
                continue;
            }
            let row = RowId { stage: node as u16, index: index as u16 };
            let mut right = problem.bound(row);
            if right == f64::INFINITY {
                continue;
            }
            let tag = problem.tag(row);
            coefficients.fill(0.0);
            // Comparable sizes for the solver: every row in units of its scale.
            problem.add_row(row, 1.0 / tag.scale, &mut coefficients);
            right /= tag.scale;
            for (i, &c) in coefficients.iter().enumerate().filter(|(_, c)| **c != 0.0) {
                if i < inputs {
                    matrix.add(bound.len(), u_at(node) + i, unit(node, i) * c);
                } else if node == 0 {
                    right -= c * start[i - inputs];
                } else {
                    matrix.add(bound.len(), x_at(node) + i - inputs, c);
                }
            }
            if tag.penalty.is_finite() {
                matrix.add(bound.len(), unknowns, -1.0);
                matrix.add(bound.len() + 1, unknowns, -1.0);
                gradient.push(tag.penalty * tag.scale);
                unknowns += 1;
                bound.push(right);
                bound.push(0.0);
            } else {
                bound.push(right);
            }
        }
    }

    let p = hessian.into_csc(unknowns, unknowns);
    let a = matrix.into_csc(bound.len(), unknowns);
    let cones =
        [SupportedConeT::ZeroConeT(equalities), SupportedConeT::NonnegativeConeT(bound.len() - equalities)];
    let mut settings = settings(tolerance, 200)?;
    settings.iterative_refinement_enable = true;
    let mut solver =
        DefaultSolver::new(&p, &gradient, &a, &bound, &cones, settings).map_err(|_| QpError::Refused)?;
    solver.solve();
    let iterations = solver.solution.iterations;
    if !matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved) {
        return Err(QpError::NotConverged { iterations });
    }
    for k in 0..stages {
        let x = &solver.solution.x;
        for (j, u) in trajectory.u_mut(k).iter_mut().enumerate() {
            *u = unit(k, j) * x[u_at(k) + j];
        }
        trajectory.x_mut(k + 1).copy_from_slice(&x[x_at(k + 1)..x_at(k + 1) + states]);
    }
    Ok(iterations)
}

/// A sparse matrix under construction.
#[derive(Default)]
struct Triplets {
    rows: Vec<usize>,
    columns: Vec<usize>,
    values: Vec<f64>,
}

impl Triplets {
    fn add(&mut self, row: usize, column: usize, value: f64) {
        if value != 0.0 {
            self.rows.push(row);
            self.columns.push(column);
            self.values.push(value);
        }
    }

    fn into_csc(self, rows: usize, columns: usize) -> CscMatrix<f64> {
        CscMatrix::new_from_triplets(rows, columns, self.rows, self.columns, self.values)
    }
}
