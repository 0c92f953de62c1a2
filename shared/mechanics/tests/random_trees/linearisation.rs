//! `A` and `B`: against differences of the step, by every path and factorisation, and their adjoint products.

use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::exp_rotation;
use delmpc_mechanics::step::NewtonVariant;

use crate::random_tree;
use crate::robot::{Robot, on_random_robots, relative, within};
use crate::{DIFFERENCES, METHODS, derivative};

/// Torques are varied by this much more: what a small torque does in one step drowns in the round-off of the momenta.
const TORQUE_SCALE: f64 = 1e3;
/// `A` and `B` by two paths, relative to the column: the condition of the Newton matrix (1e6 and more) times round-off.
const SAME_LINEARISATION: f64 = 1e-8;

/// `P` of a floating base.
fn total_momentum(state: &State) -> Wrench {
    Wrench::from_vector(&Vector6::from_column_slice(&state.p[..6]))
}

/// One column of `[A | B]` by differences of the step map.
fn step_difference(robot: &Robot, integrator: &mut Integrator, end: &State, column: usize) -> Vec<f64> {
    let (n, base) = (robot.tree.dof(), robot.tree.base_dof());
    let start = &robot.state;
    let unit = |k: usize, h: f64| Vector6::ith(k, h);
    let mut column_of_step = derivative(|h| {
        let mut state = start.clone();
        let mut torques = robot.torques.clone();
        let pose = &start.base_pose;
        let total = if base > 0 { total_momentum(start) } else { Wrench::default() };
        let mut set_total = |change: Wrench| {
            for (p, change) in state.p.iter_mut().zip(change.to_vector().iter()) {
                *p += change;
            }
        };
        if column < base {
            // δg = g ε^ and δP = -½ ad^D_P η keep the canonical momentum error at zero.
            let epsilon = unit(column, h);
            let eta = pose.transform_twist(&Twist::from_vector(&epsilon));
            set_total(total.dual_bracket(&eta) * -0.5);
            let turn = exp_rotation(&epsilon.fixed_rows::<3>(0).into_owned());
            state.base_pose = RigidTransform {
                rotation: pose.rotation * turn,
                translation: pose.translation + pose.rotation * epsilon.fixed_rows::<3>(3),
            };
        } else if column < n {
            state.q[column - base] += h;
        } else if column < n + base {
            set_total(pose.transform_wrench(&Wrench::from_vector(&unit(column - n, h))));
        } else if column < 2 * n {
            state.p[column - n] += h;
        } else {
            torques[column - 2 * n] += h * TORQUE_SCALE;
        }
        let laws = robot.laws();
        integrator.forget();
        integrator.solve(&robot.tree, &state, &robot.forces(&torques, &laws)).unwrap();
        let next = integrator.next_state();
        let mut out = Vec::new();
        if base > 0 {
            let turn = end.base_pose.rotation.tr_mul(&next.base_pose.rotation);
            out.extend_from_slice(delmpc_mechanics::spatial::log_rotation(&turn).as_slice());
            let place = next.base_pose.translation - end.base_pose.translation;
            out.extend_from_slice(end.base_pose.rotation.tr_mul(&place).as_slice());
        }
        out.extend_from_slice(&next.q);
        out.extend_from_slice(&next.p);
        out
    });
    if column >= 2 * n {
        column_of_step.iter_mut().for_each(|x| *x /= TORQUE_SCALE);
    }
    if base > 0 {
        let eta = end
            .base_pose
            .transform_twist(&Twist::from_vector(&Vector6::from_column_slice(&column_of_step[..6])));
        let change = Wrench::from_vector(&Vector6::from_column_slice(&column_of_step[n..n + 6]));
        let total = total_momentum(end);
        let error = end.base_pose.inverse_transform_wrench(&(change + total.dual_bracket(&eta) * 0.5));
        column_of_step[n..n + 6].copy_from_slice(error.to_vector().as_slice());
    }
    column_of_step
}

#[test]
fn a_and_b_are_the_difference_quotients_of_the_step() {
    on_random_robots("A, B against differences", 24, |mut robot| {
        let n = robot.tree.dof();
        let mut exact = robot.solved(NewtonMethod::BranchLu, NewtonVariant::Exact);
        let end = exact.next_state().clone();
        let mut work = Linearizer::new(&robot.tree, &exact, StateCoordinates::Momentum, robot.hold).unwrap();
        let linear = work.linearize(&robot.tree, &mut exact).unwrap().clone();
        let columns = 2 * n + linear.inputs();
        let mut worst = 0.0f64;
        for _ in 0..16 {
            let column = robot.random.below(columns);
            let want = step_difference(&robot, &mut exact, &end, column);
            let got: Vec<f64> = (0..2 * n).map(|r| linear.matrix().get(r, column)).collect();
            let error = relative(&got, &want);
            worst = worst.max(within(&format!("column {column} of {columns}, n = {n}"), error, DIFFERENCES)?);
        }
        Ok(worst)
    });
}

#[test]
fn a_and_b_come_out_the_same_by_both_paths_and_every_factorisation() {
    on_random_robots("A, B by matrix and by tangent", 32, |robot| {
        let n = robot.tree.dof();
        let mut reference: Option<Vec<Vec<f64>>> = None;
        let mut worst = 0.0f64;
        for method in METHODS {
            let mut integrator = robot.solved(method, NewtonVariant::Exact);
            let mut work =
                Linearizer::new(&robot.tree, &integrator, StateCoordinates::Momentum, robot.hold).unwrap();
            let columns = |step: &LinearStep| -> Vec<Vec<f64>> {
                let column = |c: usize| (0..2 * n).map(|r| step.matrix().get(r, c)).collect();
                (0..2 * n + step.inputs()).map(column).collect()
            };
            let by_matrix = columns(work.linearize(&robot.tree, &mut integrator).unwrap());
            let by_tangent = columns(work.linearize_by_tangent(&robot.tree, &mut integrator).unwrap());
            // Refused for a floating base and for general wrenches.
            let by_recursion = work.linearize_by_recursion(&robot.tree, &mut integrator).map(columns);
            let want = reference.get_or_insert(by_tangent.clone());
            for (c, want) in want.iter().enumerate() {
                let matrix = relative(&by_matrix[c], want);
                let tangent = relative(&by_tangent[c], want);
                worst = worst.max(within(
                    &format!("{method:?} matrix path column {c}"),
                    matrix,
                    SAME_LINEARISATION,
                )?);
                worst = worst.max(within(
                    &format!("{method:?} tangent path column {c}"),
                    tangent,
                    SAME_LINEARISATION,
                )?);
                if let Ok(by_recursion) = &by_recursion {
                    worst = worst.max(within(
                        &format!("recursion column {c}"),
                        relative(&by_recursion[c], want),
                        SAME_LINEARISATION,
                    )?);
                }
            }
            if robot.tree.is_floating() {
                continue;
            }
            let lambda: Vec<f64> = (0..2 * n).map(|k| (1.0 + k as f64).sin()).collect();
            let (mut a, mut b) = (vec![0.0; 2 * n], vec![0.0; want.len() - 2 * n]);
            work.adjoint_into(&robot.tree, &mut integrator, &lambda, &mut a, &mut b).unwrap();
            a.extend(b);
            let products: Vec<f64> = want.iter().map(|column| random_tree::dot(column, &lambda)).collect();
            let adjoint = relative(&a, &products);
            worst = worst.max(within(&format!("{method:?} adjoint"), adjoint, SAME_LINEARISATION)?);
        }
        Ok(worst)
    });
}
