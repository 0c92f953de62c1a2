//! The Newton matrix and its solutions: the three factorisations, the tangent, differences of the residual.

use delmpc_mechanics::del_hessian::DelHessian;
use delmpc_mechanics::del_residual::DelWorkspace;
use delmpc_mechanics::dense_lu::DenseNewton;
use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonSolver};
use delmpc_mechanics::row_matrix::RowMatrix;
use delmpc_mechanics::tangent::TangentWorkspace;
use nalgebra::DMatrix;
use proptest::test_runner::TestCaseError;

use crate::random_tree::{self, size};
use crate::robot::{Robot, on_random_robots, relative, within};
use crate::{DIFFERENCES, METHODS, SAME_MATRIX, derivative};

/// `|Jx - b|` over `|J||x| + |b|`: block elimination without pivoting between blocks may lose a few digits of 16.
const BACKWARD: f64 = 1e-11;

fn newton_matrix(robot: &Robot, del: &DelWorkspace) -> DMatrix<f64> {
    let order = robot.s * robot.tree.dof();
    DMatrix::from_row_slice(order, order, DenseNewton::new(&robot.tree, del).assemble(&robot.tree, del))
}

/// Largest entry of `Jx - b` over that of `|J||x| + |b|`.
fn backward_error(matrix: &DMatrix<f64>, x: &[f64], b: &[f64]) -> f64 {
    let (mut worst, mut scale) = (0.0f64, 0.0f64);
    for (row, b) in matrix.row_iter().zip(b) {
        let (mut sum, mut terms) = (-b, b.abs());
        for (entry, x) in row.iter().zip(x) {
            sum += entry * x;
            terms += (entry * x).abs();
        }
        worst = worst.max(sum.abs());
        scale = scale.max(terms);
    }
    worst / scale.max(f64::MIN_POSITIVE)
}

#[test]
fn recursion_branch_lu_and_dense_lu_solve_the_same_newton_equations() {
    on_random_robots("backward error of the Newton direction", 64, |mut robot| {
        let del = robot.unsolved();
        let matrix = newton_matrix(&robot, &del);
        let transposed = matrix.transpose();
        let right = robot.random.values(matrix.nrows(), 1.0);
        let mut worst = 0.0f64;
        for method in METHODS {
            let mut solver = NewtonSolver::new(method, &robot.tree, &del);
            solver.factor(&robot.tree, &del).map_err(|e| TestCaseError::fail(format!("{method:?}: {e}")))?;
            let mut x = right.clone();
            solver.solve(&robot.tree, &mut x);
            worst =
                worst.max(within(&format!("{method:?} J"), backward_error(&matrix, &x, &right), BACKWARD)?);
            let mut y = right.clone();
            solver.solve_transposed(&robot.tree, &mut y);
            worst = worst.max(within(
                &format!("{method:?} Jt"),
                backward_error(&transposed, &y, &right),
                BACKWARD,
            )?);
            let mut many = RowMatrix::zeros(right.len(), 5);
            for (row, value) in right.iter().enumerate() {
                (0..5).for_each(|c| many.set(row, c, if c == row % 5 { *value } else { 0.0 }));
            }
            let columns = many.clone();
            solver.solve_many(&robot.tree, &mut many);
            for c in 0..5 {
                let x: Vec<f64> = (0..right.len()).map(|r| many.get(r, c)).collect();
                let b: Vec<f64> = (0..right.len()).map(|r| columns.get(r, c)).collect();
                let error = backward_error(&matrix, &x, &b);
                worst = worst.max(within(&format!("{method:?} column {c}"), error, BACKWARD)?);
            }
        }
        Ok(worst)
    });
}

#[test]
fn the_three_directions_agree_as_far_as_the_condition_of_the_newton_matrix_lets_them() {
    // Forward error over condition, and the few digits of BACKWARD.
    const FORWARD_OVER_CONDITION: f64 = 1e-13;
    on_random_robots("difference of the directions over condition", 24, |mut robot| {
        let del = robot.unsolved();
        let matrix = newton_matrix(&robot, &del);
        let norm = |m: &DMatrix<f64>| {
            m.row_iter().map(|r| r.iter().map(|x| x.abs()).sum::<f64>()).fold(0.0, f64::max)
        };
        let inverse = matrix.clone().try_inverse().ok_or_else(|| TestCaseError::fail("singular"))?;
        let condition = norm(&matrix) * norm(&inverse);
        let right = robot.random.values(matrix.nrows(), 1.0);
        let directions: Vec<Vec<f64>> = METHODS
            .iter()
            .map(|&method| {
                let mut solver = NewtonSolver::new(method, &robot.tree, &del);
                solver.factor(&robot.tree, &del).unwrap();
                let mut x = right.clone();
                solver.solve(&robot.tree, &mut x);
                x
            })
            .collect();
        let lu = relative(&directions[1], &directions[0]) / condition;
        let recursion = relative(&directions[2], &directions[0]) / condition;
        within("branch LU", lu, FORWARD_OVER_CONDITION)?;
        within("recursion", recursion, FORWARD_OVER_CONDITION)?;
        Ok(lu.max(recursion))
    });
}

#[test]
fn the_newton_matrix_and_the_hessian_are_the_columns_of_the_tangent() {
    on_random_robots("matrix against tangent", 64, |mut robot| {
        let del = robot.unsolved();
        let (n, s) = (robot.tree.dof(), robot.s);
        let matrix = newton_matrix(&robot, &del);
        let mut tangent = TangentWorkspace::new(&robot.tree, &del);
        let (mut rows, mut last) = (vec![0.0; s * n], vec![0.0; n]);
        let mut hessian = DelHessian::new(&robot.tree, &del);
        hessian.evaluate(&robot.tree, &del);
        let mut blocks = vec![vec![0.0; n * n]; (s + 1) * (s + 1)];
        if !robot.tree.is_floating() {
            for (at, block) in blocks.iter_mut().enumerate() {
                hessian.dense_block_into(&robot.tree, at / (s + 1), at % (s + 1), block);
            }
        }
        let scale = matrix.amax();
        let mut worst = 0.0f64;
        for gamma in 0..=s {
            for j in 0..n {
                tangent.clear();
                tangent.set(gamma, j, 1.0);
                tangent.evaluate(&robot.tree, &del);
                tangent.residual_into(&robot.tree, &del, &mut rows);
                tangent.next_momentum_into(&robot.tree, &del, &mut last);
                if gamma > 0 {
                    let column = matrix.column(j * s + gamma - 1);
                    let error = random_tree::difference(column.as_slice(), &rows) / size(&rows);
                    worst = worst.max(within(&format!("column of {j} at node {gamma}"), error, SAME_MATRIX)?);
                }
                if !robot.tree.is_floating() {
                    for i in 0..n {
                        for alpha in 0..=s {
                            let want = if alpha < s { rows[i * s + alpha] } else { last[i] };
                            let got = blocks[alpha * (s + 1) + gamma][i * n + j];
                            let error = (got - want).abs() / scale;
                            worst = worst.max(within(
                                &format!("H[{alpha},{gamma}]({i},{j})"),
                                error,
                                SAME_MATRIX,
                            )?);
                        }
                    }
                }
            }
        }
        Ok(worst)
    });
}

#[test]
fn the_newton_matrix_is_the_difference_quotient_of_the_residual_with_every_force() {
    on_random_robots("matrix against differences", 32, |mut robot| {
        let mut del = robot.unsolved();
        let (n, s) = (robot.tree.dof(), robot.s);
        let matrix = newton_matrix(&robot, &del);
        let laws = robot.laws();
        let mut worst = 0.0f64;
        for j in 0..n {
            for gamma in 1..=s {
                let kept = del.node(gamma, j);
                let column = derivative(|h| {
                    del.set_node(gamma, j, kept + h);
                    del.evaluate(&robot.tree, &laws);
                    let mut rows = vec![0.0; s * n];
                    del.residual_into(&robot.tree, &mut rows);
                    rows
                });
                del.set_node(gamma, j, kept);
                let error = relative(matrix.column(j * s + gamma - 1).as_slice(), &column);
                worst = worst.max(within(&format!("column of {j} at node {gamma}"), error, DIFFERENCES)?);
            }
        }
        Ok(worst)
    });
}
