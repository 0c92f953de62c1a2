//! Newton-Euler against the mass matrix, and against derivatives of the energies.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_tree;

use delmpc_mechanics::energy::{
    centroidal_momentum_w, generalised_momentum_into, gravity_energy, kinetic_energy, potential_energy,
    spring_energy, total_momentum_w,
};
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::inverse_dynamics::{
    InverseDynamicsWorkspace, bias_force_into, gravity_force_into, inverse_dynamics_into,
};
use delmpc_mechanics::kinematics::Velocity;
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::spatial::Wrench;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;
use proptest::prelude::*;
use random_tree::{Random, State, difference, dot, multiply, size};

/// Round-off of sums over up to 40 bodies, relative to the size of the result.
const ROUND_OFF: f64 = 1e-11;
const STEP: f64 = 1e-5;
/// Truncation of central differences with [`STEP`], relative.
const DIFFERENCE: f64 = 1e-5;

fn bias(tree: &KinematicTree, state: &State) -> Vec<f64> {
    let mut force = vec![f64::NAN; tree.dof()];
    let workspace = &mut InverseDynamicsWorkspace::new(tree);
    let done = bias_force_into(tree, &state.kinematics(tree), workspace, &mut force);
    assert_eq!(done, Ok(()));
    force
}

fn gravity(tree: &KinematicTree, state: &State) -> Vec<f64> {
    let mut force = vec![f64::NAN; tree.dof()];
    let workspace = &mut InverseDynamicsWorkspace::new(tree);
    let done = gravity_force_into(tree, &state.kinematics(tree), workspace, &mut force);
    assert_eq!(done, Ok(()));
    force
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn is_mass_matrix_times_acceleration_plus_bias(seed: u64, joints in 1usize..40, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let kinematics = state.kinematics(&tree);
        let dof = tree.dof();
        let (base, joints) = (random.twist(5.0), random.values(tree.joint_count(), 5.0));
        let workspace = &mut InverseDynamicsWorkspace::new(&tree);
        let mut force = vec![0.0; dof];
        inverse_dynamics_into(&tree, &kinematics, &Velocity::floating(base, &joints), &[], workspace, &mut force)
            .unwrap();
        let mut matrix = vec![0.0; dof * dof];
        mass_matrix_into(&tree, &kinematics, &mut MassMatrixWorkspace::new(&tree), &mut matrix).unwrap();
        let mut acceleration = Vec::new();
        if floating {
            acceleration.extend_from_slice(base.to_vector().as_slice());
        }
        acceleration.extend_from_slice(&joints);
        let mut expected = multiply(&matrix, &acceleration);
        for (sum, bias) in expected.iter_mut().zip(bias(&tree, &state)) {
            *sum += bias;
        }
        prop_assert!(difference(&force, &expected) < ROUND_OFF * (1.0 + size(&matrix)) * dof as f64);
    }

    #[test]
    fn external_wrenches_act_through_the_jacobian(seed: u64, joints in 1usize..25, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let kinematics = state.kinematics(&tree);
        let dof = tree.dof();
        let body = random.below(tree.body_count());
        let (point, force_w) = (random.vector(0.3), random.vector(50.0));
        let mut external = vec![Wrench::default(); tree.body_count()];
        external[body] = Wrench::new(kinematics.point_w(body, &point).cross(&force_w), force_w);
        let rest = vec![0.0; tree.joint_count()];
        let workspace = &mut InverseDynamicsWorkspace::new(&tree);
        let mut force = vec![0.0; dof];
        inverse_dynamics_into(&tree, &kinematics, &Velocity::fixed(&rest), &external, workspace, &mut force).unwrap();
        let mut jacobian = vec![0.0; 3 * dof];
        kinematics.point_jacobian_into(&tree, body, &point, &mut jacobian).unwrap();
        let bias = bias(&tree, &state);
        for column in 0..dof {
            let pulled: f64 = (0..3).map(|row| jacobian[row * dof + column] * force_w[row]).sum();
            prop_assert!((force[column] - (bias[column] - pulled)).abs() < ROUND_OFF * (100.0 + size(&bias)) * dof as f64);
        }
    }

    #[test]
    fn gravity_force_is_the_gradient_of_the_weight(seed: u64, joints in 1usize..25, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let power = dot(&gravity(&tree, &state), &state.generalised_velocity(&tree));
        let weight = |t: f64| gravity_energy(&tree, &state.after(t).kinematics(&tree));
        let rate = (weight(STEP) - weight(-STEP)) / (2.0 * STEP);
        prop_assert!((power - rate).abs() < DIFFERENCE * (1.0 + size(&gravity(&tree, &state))));
        let mut still = state.clone();
        still.base_twist_w = Default::default();
        still.q_dot.fill(0.0);
        let bias_at_rest = bias(&tree, &still);
        let gravity = gravity(&tree, &state);
        prop_assert!(difference(&bias_at_rest, &gravity) < ROUND_OFF * (1.0 + size(&gravity)) * 10.0);
    }

    #[test]
    fn bias_follows_from_lagranges_equations(seed: u64, joints in 1usize..12) {
        // c_j = Σ_k ∂(p_j)/∂q_k q̇_k - ∂T/∂q_j for a fixed base, at constant rates.
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, false);
        let state = State::random(random, &tree);
        let dof = tree.dof();
        let momentum = |state: &State| {
            let mut p = vec![0.0; dof];
            generalised_momentum_into(&tree, &state.kinematics(&tree), &mut p).unwrap();
            p
        };
        let (before, after) = (momentum(&state.after(-STEP)), momentum(&state.after(STEP)));
        let gravity = gravity(&tree, &state);
        let bias = bias(&tree, &state);
        let scale = 1.0 + size(&bias) + size(&before);
        for j in 0..dof {
            let kinetic = |change: f64| {
                let mut moved = state.clone();
                moved.q[j] += change;
                kinetic_energy(&tree, &moved.kinematics(&tree))
            };
            let gradient = (kinetic(STEP) - kinetic(-STEP)) / (2.0 * STEP);
            let expected = (after[j] - before[j]) / (2.0 * STEP) - gradient + gravity[j];
            prop_assert!((bias[j] - expected).abs() < 10.0 * DIFFERENCE * scale, "{} {}", bias[j], expected);
        }
    }

    #[test]
    fn base_wrench_is_the_rate_of_the_total_momentum(seed: u64, joints in 1usize..20) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, true);
        let state = State::random(random, &tree);
        let momentum = |t: f64| total_momentum_w(&tree, &state.after(t).kinematics(&tree)).to_vector();
        let rate = (momentum(STEP) - momentum(-STEP)) / (2.0 * STEP);
        let (bias, gravity) = (bias(&tree, &state), gravity(&tree, &state));
        let expected: Vec<f64> = rate.iter().zip(&gravity).map(|(rate, gravity)| rate + gravity).collect();
        prop_assert!(difference(&bias[..6], &expected) < 10.0 * DIFFERENCE * (1.0 + size(&bias)));
        let kinematics = state.kinematics(&tree);
        let linear = centroidal_momentum_w(&tree, &kinematics).force / tree.total_mass();
        prop_assert!((linear - kinematics.mass_centre_velocity_w(&tree)).amax() < ROUND_OFF * 100.0);
    }
}

#[test]
fn springs_store_energy_and_lengths_are_checked() {
    let random = &mut Random::new(11);
    let tree = random.tree(2, false);
    let state = State::random(random, &tree);
    let kinematics = state.kinematics(&tree);
    let expected: f64 = tree
        .bodies()
        .iter()
        .zip(&state.q)
        .map(|(b, q)| 0.5 * b.joint.stiffness * (q - b.joint.rest).powi(2))
        .sum();
    assert!((spring_energy(&tree, &state.q).unwrap() - expected).abs() < 1e-14);
    let both = potential_energy(&tree, &kinematics, &state.q).unwrap();
    assert!((both - expected - gravity_energy(&tree, &kinematics)).abs() < 1e-12);
    assert!(matches!(spring_energy(&tree, &[0.0]), Err(ModelError::Length { got: 1, expected: 2, .. })));
    let workspace = &mut InverseDynamicsWorkspace::new(&tree);
    let error = gravity_force_into(&tree, &kinematics, workspace, &mut [0.0; 3]).unwrap_err();
    assert_eq!(error, ModelError::Length { quantity: "generalised force", got: 3, expected: 2 });
    let wrenches = [Wrench::new(Vector3::x(), Vector3::x())];
    let rest = Velocity::fixed(&[0.0; 2]);
    assert!(inverse_dynamics_into(&tree, &kinematics, &rest, &wrenches, workspace, &mut [0.0; 2]).is_err());
}
