//! What solved steps and mass matrices must fulfil: round-off, symmetry, definiteness.

use delmpc_mechanics::del_residual::DelWorkspace;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::step::NewtonVariant;
use delmpc_mechanics::velocity::VelocityWorkspace;
use nalgebra::DMatrix;
use proptest::prelude::*;

use crate::random_tree::{self, size};
use crate::robot::{Robot, on_random_robots, relative, within};
use crate::{METHODS, SAME_MATRIX};

/// Residual of a step solved to round-off, relative to the largest momentum term in it.
const RESIDUAL_FLOOR: f64 = 1e-14;
/// The same by the default stopping rule: a change of the nodes predicted below 1e-16, times the Newton matrix.
const RESIDUAL_DEFAULT: f64 = 1e-11;

/// Largest term `|a^{αβ}| Sᵀ|μ|` of the residual, joints only: what cancels in it when the step is solved.
fn largest_momentum_term(robot: &Robot, del: &DelWorkspace) -> f64 {
    let mut kinematics = Kinematics::new(&robot.tree);
    let base = robot.tree.base_dof();
    let mut worst = 0.0f64;
    for beta in 0..=robot.s {
        let q: Vec<f64> = (0..robot.tree.joint_count()).map(|j| del.node(beta, base + j)).collect();
        let pose = if base > 0 { del.body_pose(0, beta) } else { RigidTransform::identity() };
        kinematics.update_positions(&robot.tree, &Configuration::floating(pose, &q)).unwrap();
        let weight = (0..=robot.s).fold(0.0f64, |m, a| m.max(del.rule().weighted_derivative(a, beta).abs()));
        for body in robot.tree.first_joint_body()..robot.tree.body_count() {
            let (momentum, _) = del.body_momentum_and_impulse(body, beta);
            let twist = &kinematics.joint_twists_w()[body];
            let terms = momentum.to_vector().component_mul(&twist.to_vector()).abs().sum();
            worst = worst.max(weight * terms);
        }
    }
    worst
}

#[test]
fn the_residual_of_a_solved_step_is_round_off_of_its_largest_momentum_term() {
    for (variant, bar) in [(NewtonVariant::Exact, RESIDUAL_FLOOR), (NewtonVariant::Broyden, RESIDUAL_DEFAULT)]
    {
        on_random_robots(&format!("residual over momentum term, {variant:?}"), 48, |robot| {
            let mut worst = 0.0f64;
            for method in METHODS {
                let integrator = robot.solved(method, variant);
                let del = integrator.del();
                let mut residual = vec![0.0; robot.s * robot.tree.dof()];
                del.residual_into(&robot.tree, &mut residual);
                let floor = size(&residual) / largest_momentum_term(&robot, del);
                worst = worst.max(within(&format!("{method:?}"), floor, bar)?);
            }
            Ok(worst)
        });
    }
}

#[test]
fn the_mass_matrix_is_symmetric_positive_definite() {
    on_random_robots("asymmetry of the mass matrix", 64, |robot| {
        let mut work = VelocityWorkspace::new(&robot.tree);
        work.factor_at(&robot.tree, &robot.state).unwrap();
        let n = robot.tree.dof();
        let matrix = DMatrix::from_row_slice(n, n, work.mass_matrix());
        let asymmetry = (&matrix - matrix.transpose()).amax();
        prop_assert_eq!(asymmetry, 0.0);
        prop_assert!(matrix.clone().cholesky().is_some(), "not positive definite");
        prop_assert!(work.factor().pivots().iter().all(|pivot| *pivot > 0.0));
        // And p = M q̇ comes back from the velocity.
        let mut velocity = vec![0.0; n];
        work.velocity_into(&robot.tree, &robot.state, &mut velocity).unwrap();
        let product = random_tree::multiply(work.mass_matrix(), &velocity);
        within("M M⁻¹p - p", relative(&product, &robot.state.p), SAME_MATRIX)?;
        Ok(asymmetry)
    });
}
