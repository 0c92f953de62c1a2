//! The composite-rigid-body algorithm against the definition of the kinetic energy, and its branch-sparse factors against
//! a dense solver.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_tree;

use delmpc_mechanics::energy::{generalised_momentum_into, kinetic_energy, total_momentum_w};
use delmpc_mechanics::errors::{FactorError, ModelError, StepError};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::mass_matrix_factor::MassMatrixFactor;
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::{DMatrix, DVector, Vector3};
use proptest::prelude::*;
use random_tree::{Random, State, difference, dot, multiply, size};

/// Round-off of sums over up to 60 bodies, relative to the largest entry.
const ROUND_OFF: f64 = 1e-12;

fn mass_matrix(tree: &KinematicTree, state: &State) -> Result<Vec<f64>, ModelError> {
    let mut matrix = vec![f64::NAN; tree.dof() * tree.dof()];
    let workspace = &mut MassMatrixWorkspace::new(tree);
    mass_matrix_into(tree, &state.kinematics(tree), workspace, &mut matrix)?;
    Ok(matrix)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn is_the_sum_of_the_links_jacobians(seed: u64, joints in 1usize..40, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let kinematics = state.kinematics(&tree);
        let dof = tree.dof();
        let mut expected = DMatrix::<f64>::zeros(dof, dof);
        let mut jacobian = vec![0.0; 6 * dof];
        for (i, body) in tree.bodies().iter().enumerate() {
            kinematics.frame_jacobian_into(&tree, i, &body.inertia.com, &mut jacobian).unwrap();
            let jacobian = DMatrix::from_row_slice(6, dof, &jacobian);
            let (angular, linear) = (jacobian.rows(0, 3), jacobian.rows(3, 3));
            let rotation = kinematics.link_poses_w()[i].rotation;
            let inertia = rotation * body.inertia.inertia * rotation.transpose();
            expected += angular.transpose() * inertia * angular + linear.transpose() * linear * body.inertia.mass;
        }
        let got = mass_matrix(&tree, &state)?;
        let got = DMatrix::from_row_slice(dof, dof, &got);
        prop_assert!((&got - &expected).amax() < ROUND_OFF * expected.amax());
    }

    #[test]
    fn is_symmetric_positive_definite_and_gives_energy_and_momentum(
        seed: u64, joints in 1usize..60, floating: bool,
    ) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let kinematics = state.kinematics(&tree);
        let dof = tree.dof();
        let matrix = mass_matrix(&tree, &state)?;
        for row in 0..dof {
            for column in 0..dof {
                prop_assert_eq!(matrix[row * dof + column], matrix[column * dof + row]);
            }
        }
        let velocity = state.generalised_velocity(&tree);
        let momentum = multiply(&matrix, &velocity);
        let energy = 0.5 * dot(&momentum, &velocity);
        prop_assert!(energy > 0.0);
        prop_assert!((energy - kinetic_energy(&tree, &kinematics)).abs() < ROUND_OFF * size(&matrix) * dof as f64);

        let mut factor = MassMatrixFactor::new(&tree);
        factor.factorise(&matrix).unwrap();
        prop_assert!(factor.pivots().iter().all(|&pivot| pivot > 0.0));

        let mut by_sums = vec![0.0; dof];
        generalised_momentum_into(&tree, &kinematics, &mut by_sums).unwrap();
        prop_assert!(difference(&by_sums, &momentum) < ROUND_OFF * size(&matrix) * dof as f64);
        if floating {
            let total = total_momentum_w(&tree, &kinematics).to_vector();
            prop_assert!(difference(total.as_slice(), &by_sums[..6]) < ROUND_OFF * size(&matrix) * dof as f64);
        }
    }

    #[test]
    fn branch_sparse_factors_solve_as_a_dense_solver(seed: u64, joints in 1usize..60, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let dof = tree.dof();
        let matrix = mass_matrix(&tree, &state)?;
        let right = random.values(dof, 1.0);
        let mut solution = right.clone();
        let mut factor = MassMatrixFactor::new(&tree);
        factor.factorise(&matrix).unwrap();
        factor.solve_in_place(&mut solution).unwrap();
        let dense = DMatrix::from_row_slice(dof, dof, &matrix);
        let expected = dense.clone().cholesky().unwrap().solve(&DVector::from_column_slice(&right));
        // Both are backward stable: they agree as far as the condition of the matrix lets them.
        let moments = dense.symmetric_eigenvalues();
        let condition = moments.max() / moments.min();
        let error = difference(&solution, expected.as_slice());
        prop_assert!(error < 1e-14 * condition * size(expected.as_slice()) * dof as f64, "{error:e}");
    }
}

#[test]
fn off_branch_entries_are_exactly_zero() {
    let random = &mut Random::new(3);
    let tree = random.tree(25, true);
    let matrix = mass_matrix(&tree, &State::random(random, &tree)).unwrap();
    let dof = tree.dof();
    let mut zeros = 0;
    for i in 1..tree.body_count() {
        for j in 1..i {
            let (row, column) = (tree.joint_dof(i), tree.joint_dof(j));
            let related = tree.branch(i).contains(&(column as u32));
            assert_eq!(related, matrix[row * dof + column] != 0.0);
            zeros += usize::from(!related);
        }
    }
    assert!(zeros > 100);
}

#[test]
fn a_matrix_that_is_not_positive_is_refused_with_the_body() {
    let random = &mut Random::new(5);
    let tree = random.tree(6, true);
    let mut matrix = mass_matrix(&tree, &State::random(random, &tree)).unwrap();
    let dof = tree.dof();
    let mut factor = MassMatrixFactor::new(&tree);
    assert!(matches!(factor.factorise(&matrix[1..]), Err(StepError::Argument(_))));
    let row = tree.joint_dof(4);
    matrix[row * dof + row] = f64::NAN;
    let error = factor.factorise(&matrix).unwrap_err();
    assert!(matches!(error, StepError::Singular(FactorError::SingularPivot { body: 4, .. })), "{error}");
    matrix[row * dof + row] = 0.0;
    let error = factor.factorise(&matrix).unwrap_err();
    assert!(matches!(error, StepError::Singular(FactorError::SingularPivot { body: 4, .. })), "{error}");
}

/// The builder cannot see it (every joint carries mass), the factorisation does.
#[test]
fn four_slides_without_mass_between_are_singular() {
    let mut builder = TreeBuilder::fixed_base(Vector3::zeros());
    let brick = Random::new(2).inertia();
    let axes = [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::new(0.6, 0.0, 0.8)];
    for (i, axis) in axes.into_iter().enumerate() {
        let inertia = if i == 3 { brick } else { LinkInertia::massless() };
        let joint = Joint::prismatic(axis, RigidTransform::identity());
        builder.add(Body::new(i.checked_sub(1), joint, inertia));
    }
    let tree = builder.build().unwrap();
    let matrix = mass_matrix(&tree, &State::random(&mut Random::new(2), &tree)).unwrap();
    let error = MassMatrixFactor::new(&tree).factorise(&matrix).unwrap_err();
    assert!(matches!(error, StepError::Singular(FactorError::SingularPivot { body: 0, .. })), "{error}");
}

#[test]
fn mass_of_a_floating_body_is_the_translational_block() {
    let random = &mut Random::new(9);
    let tree = random.tree(8, true);
    let matrix = mass_matrix(&tree, &State::random(random, &tree)).unwrap();
    let dof = tree.dof();
    let direction = Vector3::new(0.3, -0.4, 0.5);
    for (row, d) in direction.iter().enumerate() {
        let got: f64 = (0..3).map(|c| matrix[(3 + row) * dof + 3 + c] * direction[c]).sum();
        assert!((got - tree.total_mass() * d).abs() < 1e-12);
    }
}
