//! Forward kinematics: against a direct product of transforms, finite differences, and the definition of the Jacobians.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_tree;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_link_pose, base_pose_from_link};
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::{Base, KinematicTree};
use nalgebra::Vector3;
use proptest::prelude::*;
use random_tree::{Random, State, difference, multiply, size};

/// Round-off of products along branches of up to 30 joints.
const ROUND_OFF: f64 = 1e-11;
/// Truncation of central differences with a step of 1e-5 and speeds up to tens of metres per second.
const DIFFERENCE: f64 = 1e-5;
const STEP: f64 = 1e-5;

fn link_poses_by_definition(tree: &KinematicTree, state: &State) -> Vec<RigidTransform> {
    let mut poses: Vec<RigidTransform> = Vec::new();
    for (i, body) in tree.bodies().iter().enumerate() {
        if i == 0 && tree.base() == Base::Floating {
            poses.push(state.base_pose_w * RigidTransform::from_translation(-body.inertia.com));
            continue;
        }
        let parent = body.parent.map_or_else(RigidTransform::identity, |p| poses[p]);
        let q = state.q[i - tree.first_joint_body()];
        poses.push(parent * body.joint.placement * body.joint.motion(q));
    }
    poses
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn poses_are_the_product_of_placements_and_joint_motions(seed: u64, joints in 1usize..30, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let kinematics = state.kinematics(&tree);
        for (i, expected) in link_poses_by_definition(&tree, &state).iter().enumerate() {
            let got = &kinematics.link_poses_w()[i];
            prop_assert!((got.rotation - expected.rotation).amax() < ROUND_OFF);
            prop_assert!((got.translation - expected.translation).amax() < ROUND_OFF);
            let com = tree.bodies()[i].inertia.com;
            prop_assert!((kinematics.mass_centres_w()[i] - expected.transform_point(&com)).amax() < ROUND_OFF);
        }
    }

    #[test]
    fn velocities_are_the_rate_of_the_positions(seed: u64, joints in 1usize..20, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let point = random.vector(0.3);
        let now = state.kinematics(&tree);
        let (before, after) = (state.after(-STEP).kinematics(&tree), state.after(STEP).kinematics(&tree));
        for body in 0..tree.body_count() {
            let rate = (after.point_w(body, &point) - before.point_w(body, &point)) / (2.0 * STEP);
            prop_assert!((rate - now.point_velocity_w(body, &point)).amax() < DIFFERENCE);
        }
        let rate = (after.mass_centre_of_tree_w(&tree) - before.mass_centre_of_tree_w(&tree)) / (2.0 * STEP);
        prop_assert!((rate - now.mass_centre_velocity_w(&tree)).amax() < DIFFERENCE);
    }

    #[test]
    fn jacobians_map_generalised_velocity_to_point_velocity(seed: u64, joints in 1usize..30, floating: bool) {
        let random = &mut Random::new(seed);
        let tree = random.tree(joints, floating);
        let state = State::random(random, &tree);
        let point = random.vector(0.3);
        let kinematics = state.kinematics(&tree);
        let velocity = state.generalised_velocity(&tree);
        let dof = tree.dof();
        let (mut jacobian, mut frame) = (vec![f64::NAN; 3 * dof], vec![f64::NAN; 6 * dof]);
        for body in 0..tree.body_count() {
            kinematics.point_jacobian_into(&tree, body, &point, &mut jacobian).unwrap();
            kinematics.frame_jacobian_into(&tree, body, &point, &mut frame).unwrap();
            let linear = kinematics.point_velocity_w(body, &point);
            let scale = 1.0 + linear.amax();
            prop_assert!(difference(&multiply(&jacobian, &velocity), linear.as_slice()) < ROUND_OFF * scale);
            prop_assert_eq!(&frame[3 * dof..], &jacobian[..]);
            let angular = kinematics.velocities_w()[body].angular;
            prop_assert!(difference(&multiply(&frame[..3 * dof], &velocity), angular.as_slice()) < ROUND_OFF * scale);
        }
        kinematics.mass_centre_jacobian_into(&tree, &mut jacobian).unwrap();
        let linear = kinematics.mass_centre_velocity_w(&tree);
        let got = multiply(&jacobian, &velocity);
        prop_assert!(difference(&got, linear.as_slice()) < ROUND_OFF * (1.0 + size(&got)));
    }
}

#[test]
fn base_pose_moves_between_link_frame_and_mass_centre() {
    let random = &mut Random::new(7);
    let tree = random.tree(3, true);
    let link = random.pose();
    let base = base_pose_from_link(&tree, &link);
    let back = base_link_pose(&tree, &base);
    assert!((back.translation - link.translation).amax() < 1e-15 && back.rotation == link.rotation);
    let mut kinematics = Kinematics::new(&tree);
    kinematics.update_positions(&tree, &Configuration::floating(base, &[0.1, 0.2, 0.3])).unwrap();
    assert!((kinematics.link_poses_w()[0].translation - link.translation).amax() < 1e-15);
    assert_eq!(kinematics.mass_centre_pose_w(0), base);
}

#[test]
fn wrong_lengths_and_bodies_are_refused_by_name() {
    let tree = Random::new(1).tree(4, true);
    let mut kinematics = Kinematics::new(&tree);
    let error = kinematics.update_positions(&tree, &Configuration::fixed(&[0.0; 3])).unwrap_err();
    assert_eq!(error, ModelError::Length { quantity: "q", got: 3, expected: 4 });
    let mut jacobian = [0.0; 30];
    let error = kinematics.point_jacobian_into(&tree, 5, &Vector3::zeros(), &mut jacobian).unwrap_err();
    assert!(matches!(error, ModelError::Unsupported { body: 5, .. }));
    let error = kinematics.point_jacobian_into(&tree, 4, &Vector3::zeros(), &mut jacobian[1..]).unwrap_err();
    assert!(matches!(error, ModelError::Length { got: 29, expected: 30, .. }));
    let other = Random::new(1).tree(5, true);
    assert!(kinematics.update_positions(&other, &Configuration::fixed(&[0.0; 5])).is_err());
}
