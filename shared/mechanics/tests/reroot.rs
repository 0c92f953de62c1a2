//! Re-rooting: the same robot, the same energies, seen from another body.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod random_tree;

use delmpc_mechanics::energy::{kinetic_energy, potential_energy};
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::Kinematics;
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::reroot::Rerooted;
use delmpc_mechanics::spatial::{RigidTransform, SpatialInertia, Twist};
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use proptest::prelude::*;
use random_tree::{Random, State, size};

/// Round-off of products along two branches of up to 30 joints.
const ROUND_OFF: f64 = 1e-11;

/// The floating state of a robot whose root frame stands at `frame_pose_w`, from the state of the rooted tree.
fn floating_state(
    rerooted: &Rerooted,
    rooted: &State,
    frame_pose_w: &RigidTransform,
    frame_twist_w: &Twist,
) -> State {
    let kinematics = rooted.kinematics(rerooted.tree());
    let (mut q, mut q_dot) = (rooted.q.clone(), rooted.q_dot.clone());
    assert_eq!(rerooted.joints_to_floating(&rooted.q, &mut q), Ok(()));
    assert_eq!(rerooted.joints_to_floating(&rooted.q_dot, &mut q_dot), Ok(()));
    State {
        base_pose_w: rerooted.base_pose_w(&kinematics, frame_pose_w),
        base_twist_w: rerooted.base_twist_w(&kinematics, frame_pose_w, frame_twist_w),
        q,
        q_dot,
    }
}

fn mass_matrix(tree: &KinematicTree, kinematics: &Kinematics) -> DMatrix<f64> {
    let mut matrix = vec![0.0; tree.dof() * tree.dof()];
    let done = mass_matrix_into(tree, kinematics, &mut MassMatrixWorkspace::new(tree), &mut matrix);
    assert_eq!(done, Ok(()));
    DMatrix::from_row_slice(tree.dof(), tree.dof(), &matrix)
}

fn gravity(tree: &KinematicTree, kinematics: &Kinematics) -> DVector<f64> {
    let mut force = vec![0.0; tree.dof()];
    let done = gravity_force_into(tree, kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut force);
    assert_eq!(done, Ok(()));
    DVector::from_vec(force)
}

struct Case {
    tree: KinematicTree,
    rerooted: Rerooted,
    root: usize,
}

/// A random floating tree rooted at a body from which every reversed joint carries mass.
fn case(random: &mut Random, joints: usize) -> Case {
    let tree = random.tree(joints, true);
    loop {
        let root = random.below(tree.body_count());
        if let Ok(rerooted) = Rerooted::new(&tree, root, &random.pose()) {
            return Case { tree, rerooted, root };
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn there_and_back(seed: u64, joints in 1usize..30) {
        let random = &mut Random::new(seed);
        let Case { tree, rerooted, root } = case(random, joints);
        let state = State::random(random, &tree);
        let floating = state.kinematics(&tree);
        let (frame_pose, frame_twist) = (rerooted.frame_pose_w(&floating), rerooted.frame_twist_w(&floating));

        let mut rooted = State { base_pose_w: RigidTransform::identity(), base_twist_w: Twist::default(), ..state.clone() };
        rerooted.joints_to_rooted(&state.q, &mut rooted.q).unwrap();
        rerooted.joints_to_rooted(&state.q_dot, &mut rooted.q_dot).unwrap();
        let kinematics = rooted.kinematics(rerooted.tree());
        let back = floating_state(&rerooted, &rooted, &frame_pose, &frame_twist);
        prop_assert_eq!(&back.q, &state.q);
        prop_assert!((back.base_pose_w.translation - state.base_pose_w.translation).amax() < ROUND_OFF);
        prop_assert!((back.base_pose_w.rotation - state.base_pose_w.rotation).amax() < ROUND_OFF);
        prop_assert!((back.base_twist_w - state.base_twist_w).to_vector().amax() < ROUND_OFF * 100.0);

        // Every point of every body is where it was, and moves as it did.
        let point = random.vector(0.4);
        for body in 0..tree.body_count() {
            let (new, moved) = rerooted.point(body, &point);
            let in_frame = new.map_or(moved, |new| kinematics.point_w(new, &moved));
            let got = frame_pose.transform_point(&in_frame);
            prop_assert!((got - floating.point_w(body, &point)).amax() < ROUND_OFF);
            prop_assert_eq!(new.is_none(), body == root);
            prop_assert_eq!(new.map(|new| rerooted.old_bodies()[new]).unwrap_or(root), body);
        }
        prop_assert!((rerooted.tree().total_mass() - tree.total_mass()).abs() < 1e-12 * tree.total_mass());
        let mass_centre = frame_pose.transform_point(&kinematics.mass_centre_of_tree_w(rerooted.tree()));
        prop_assert!((mass_centre - floating.mass_centre_of_tree_w(&tree)).amax() < ROUND_OFF);
    }

    #[test]
    fn energies_and_projected_matrices_agree(seed: u64, joints in 1usize..20) {
        let random = &mut Random::new(seed);
        let Case { tree, rerooted, root: _ } = case(random, joints);
        let rooted_tree = rerooted.tree();
        let rooted = State::random(random, rooted_tree);
        let identity = RigidTransform::identity();
        let state = floating_state(&rerooted, &rooted, &identity, &Twist::default());
        let (old, new) = (state.kinematics(&tree), rooted.kinematics(rooted_tree));

        let energy = kinetic_energy(rooted_tree, &new);
        prop_assert!((energy - kinetic_energy(&tree, &old)).abs() < ROUND_OFF * (1.0 + energy));
        let energy = potential_energy(rooted_tree, &new, &rooted.q).unwrap();
        prop_assert!((energy - potential_energy(&tree, &old, &state.q).unwrap()).abs() < ROUND_OFF * (1.0 + energy.abs()));

        // v_old = N q̇_new, column by column.
        let mut projection = DMatrix::<f64>::zeros(tree.dof(), rooted_tree.dof());
        for column in 0..rooted_tree.dof() {
            let mut unit = rooted.clone();
            unit.q_dot.fill(0.0);
            unit.q_dot[column] = 1.0;
            let velocity = floating_state(&rerooted, &unit, &identity, &Twist::default()).generalised_velocity(&tree);
            projection.set_column(column, &DVector::from_vec(velocity));
        }
        let full = mass_matrix(&tree, &old);
        let error = projection.transpose() * &full * &projection - mass_matrix(rooted_tree, &new);
        let scale = size(full.as_slice()) * (1.0 + projection.amax()).powi(2);
        prop_assert!(error.amax() < ROUND_OFF * scale);
        let error = projection.transpose() * gravity(&tree, &old) - gravity(rooted_tree, &new);
        prop_assert!(error.amax() < ROUND_OFF * scale * 10.0);
    }
}

fn brick() -> LinkInertia {
    LinkInertia::new(1.0, Vector3::new(0.0, 0.0, 0.1), Matrix3::identity() * 0.01)
}

/// Base, upper leg, foot along -z; an arm on the base.
fn robot() -> KinematicTree {
    let mut builder = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), brick());
    let down = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.4));
    let leg = builder.add(Body::new(Some(0), Joint::revolute(Vector3::y(), down).with_damping(0.3), brick()));
    let up = RigidTransform::from_translation(Vector3::new(0.0, 0.1, 0.3));
    builder.add(Body::new(Some(0), Joint::revolute(Vector3::x(), up), brick()));
    builder.add(Body::new(Some(leg), Joint::prismatic(Vector3::z(), down).with_damping(0.7), brick()));
    builder.build().unwrap_or_else(|e| unreachable!("{e}"))
}

#[test]
fn the_path_comes_first_and_axes_are_negated() {
    let rerooted =
        Rerooted::new(&robot(), 3, &RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.05))).unwrap();
    assert_eq!(rerooted.old_bodies(), [1, 0, 2]);
    assert_eq!(rerooted.old_joint_bodies(), [3, 1, 2]);
    assert_eq!(rerooted.new_body(3), None);
    let bodies = rerooted.tree().bodies();
    assert_eq!(bodies[0].joint.axis, -Vector3::z());
    assert_eq!(bodies[0].joint.damping, 0.7);
    assert_eq!(bodies[1].joint.axis, -Vector3::y());
    assert_eq!(bodies[1].joint.damping, 0.3);
    assert_eq!(bodies[2].joint.axis, Vector3::x());
    assert_eq!(bodies[2].parent, Some(1));
    // The foot's mass is in the ground, seen from the sole.
    let ground = rerooted.tree().ground_inertia_w();
    assert_eq!(ground.mass, 1.0);
    assert!((ground.first_moment.z - 0.15).abs() < 1e-15);
    // Standing straight the base link is 0.85 m above the sole.
    let state = State {
        base_pose_w: RigidTransform::identity(),
        base_twist_w: Twist::default(),
        q: vec![0.0; 3],
        q_dot: vec![0.0; 3],
    };
    let base = rerooted.base_pose_w(&state.kinematics(rerooted.tree()), &RigidTransform::identity());
    assert!((base.translation - Vector3::new(0.0, 0.0, 0.95)).amax() < 1e-15);
}

#[test]
fn what_cannot_be_rerooted_is_refused() {
    let tree = robot();
    let identity = RigidTransform::identity();
    assert!(matches!(Rerooted::new(&tree, 4, &identity), Err(ModelError::Unsupported { body: 4, .. })));
    let mut mirrored = identity;
    mirrored.rotation[(0, 0)] = -1.0;
    assert!(matches!(Rerooted::new(&tree, 1, &mirrored), Err(ModelError::PlacementNotRotation { .. })));
    let mut shifted = identity;
    shifted.translation.x = f64::NAN;
    assert!(matches!(Rerooted::new(&tree, 1, &shifted), Err(ModelError::PlacementNotRotation { .. })));
    let rerooted = Rerooted::new(&tree, 3, &identity).unwrap();
    assert!(matches!(Rerooted::new(rerooted.tree(), 0, &identity), Err(ModelError::Unsupported { .. })));

    let mut welded = TreeBuilder::floating_base(Vector3::zeros(), brick());
    welded.set_ground_inertia(SpatialInertia::from_central(1.0, &Vector3::zeros(), &Matrix3::zeros()));
    assert!(matches!(
        Rerooted::new(&welded.build().unwrap(), 0, &identity),
        Err(ModelError::Unsupported { .. })
    ));
    let single = TreeBuilder::floating_base(Vector3::zeros(), brick()).build().unwrap();
    assert_eq!(Rerooted::new(&single, 0, &identity).unwrap_err(), ModelError::Empty);

    let mut light_base = TreeBuilder::floating_base(Vector3::zeros(), LinkInertia::massless());
    light_base.add(Body::new(Some(0), Joint::revolute(Vector3::x(), identity), brick()));
    let light_base = light_base.build().unwrap();
    assert!(matches!(Rerooted::new(&light_base, 1, &identity), Err(ModelError::MasslessSubtree { body: 0 })));
}
