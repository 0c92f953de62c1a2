//! Atlas: the expected numbers of `tests/vectors/robots`, floating and on its right foot.

mod common;

use common::*;
use delmpc_mechanics::kinematics::base_link_pose;
use delmpc_mechanics::spatial::{RigidTransform, Twist};
use delmpc_robots::{BaseChoice, LoadOptions, load_with};
use nalgebra::{DMatrix, DVector, Vector2, Vector3};

#[test]
fn floating_robot_at_the_zero_posture() {
    check_zero_posture(&robot("atlas"), &vectors("atlas_floating"));
}

#[test]
fn floating_robot_at_the_seeded_posture() {
    check_seeded_posture(&robot("atlas"), &vectors("atlas_floating")["seeded_posture"]);
}

#[test]
fn rooted_at_the_right_sole_at_the_zero_posture() {
    let rooted = robot("atlas").rooted_at("r_sole_centre").unwrap();
    check_zero_posture(&rooted.model, &vectors("atlas_foot_rooted_zero"));
}

#[test]
fn rooted_at_the_right_sole_standing_on_it() {
    let atlas = robot("atlas");
    let expected = vectors("atlas_one_foot_right");
    let rooted = atlas.rooted_at("r_sole_centre").unwrap();
    let model = &rooted.model;
    assert_eq!(model.joint_names, names(&expected["joint_order"]));
    assert!(!model.tree.is_floating());
    let q = numbers(&expected["q"]);
    assert_eq!(model.posture("one_foot_right").unwrap().q, q);
    let identity = RigidTransform::identity();
    let got = Evaluation::new(&model.tree, identity, Twist::default(), &q, &numbers(&expected["v"]));
    let mass_matrix = matrix(&expected["mass_matrix"]);
    assert_close("mass matrix", got.mass_matrix.as_slice(), mass_matrix.as_slice(), 1e-12);
    let (_, eigenvalues) = spectrum(&got.mass_matrix);
    assert_close("eigenvalues", &eigenvalues, &numbers(&expected["mass_matrix_eigenvalues"]), 1e-12);
    assert_close("gravity", got.gravity.as_slice(), &numbers(&expected["gravity_torque"]), 1e-12);
    assert_close("bias", got.bias.as_slice(), &numbers(&expected["bias_coriolis_plus_gravity"]), 1e-12);
    assert_close("kinetic", &[got.kinetic], &[number(&expected["kinetic_energy"])], 1e-12);
    assert_close("potential", &[got.potential], &[number(&expected["potential_energy_all_links"])], 1e-12);
    assert_close("mass centre", got.com.as_slice(), &numbers(&expected["com_all_links"]), 1e-12);
    assert_close("mass", &[model.tree.total_mass()], &[number(&expected["total_mass"])], 1e-14);

    for (frame, key) in
        [("l_sole_centre", "left_sole_in_world"), ("l_hand_point", "left_hand_point_in_world")]
    {
        let frame = model.frame(frame).unwrap();
        let position = got.kinematics.point_w(frame.body.unwrap(), &frame.pose.translation);
        assert_close(key, position.as_slice(), &numbers(&expected[key]), 1e-12);
    }
    let pelvis = model.link("pelvis").unwrap();
    let pose = got.kinematics.link_poses_w()[pelvis.body.unwrap()] * pelvis.pose;
    let pelvis = numbers(&expected["pelvis_xyz_rpy"]);
    let expected_pose = RigidTransform::from_xyz_rpy(
        Vector3::from_column_slice(&pelvis[..3]),
        Vector3::from_column_slice(&pelvis[3..]),
    );
    assert!((pose.translation - expected_pose.translation).amax() < 1e-12);
    assert!((pose.rotation - expected_pose.rotation).amax() < 1e-12);
}

#[test]
fn static_torques_of_the_one_foot_posture() {
    let rooted = robot("atlas").rooted_at("r_sole_centre").unwrap();
    let expected = &vectors("atlas_static_torques")["one_foot_right"];
    let zeros = [0.0; 30];
    let q = &rooted.model.posture("one_foot_right").unwrap().q;
    let got = Evaluation::new(&rooted.model.tree, RigidTransform::identity(), Twist::default(), q, &zeros);
    let expected: Vec<f64> = rooted.model.joint_names.iter().map(|joint| number(&expected[joint])).collect();
    assert_close("static torque", got.gravity.as_slice(), &expected, 1e-12);
    assert_close("bias at rest", got.bias.as_slice(), &expected, 1e-12);
}

/// `v_floating = N q̇` with the right foot at rest, in every posture of the table: `Nᵀ M36 N = M30`, `Nᵀ g36 = g30`.
#[test]
fn rerooted_matrices_are_the_projected_floating_ones() {
    let atlas = robot("atlas");
    let rooted = atlas.rooted_at("r_sole_centre").unwrap();
    let (tree, rerooted) = (&rooted.model.tree, &rooted.rerooted);
    let identity = RigidTransform::identity();
    for posture in &rooted.model.postures {
        let zeros = [0.0; 30];
        let small = Evaluation::new(tree, identity, Twist::default(), &posture.q, &zeros);
        let mut q = [0.0; 30];
        rerooted.joints_to_floating(&posture.q, &mut q).unwrap();
        let base = rerooted.base_pose_w(&small.kinematics, &identity);
        let large = Evaluation::new(&atlas.tree, base, Twist::default(), &q, &zeros);

        let mut map = DMatrix::zeros(36, 30);
        for column in 0..30 {
            let mut rate = [0.0; 30];
            rate[column] = 1.0;
            let moving = Evaluation::new(tree, identity, Twist::default(), &posture.q, &rate);
            let twist = rerooted.base_twist_w(&moving.kinematics, &identity, &Twist::default());
            let mut rates = [0.0; 30];
            rerooted.joints_to_floating(&rate, &mut rates).unwrap();
            map.set_column(
                column,
                &DVector::from_iterator(36, twist.to_vector().iter().chain(&rates).copied()),
            );
        }
        let projected = map.transpose() * &large.mass_matrix * &map;
        assert_close("mass matrix", projected.as_slice(), small.mass_matrix.as_slice(), 1e-13);
        let projected = map.transpose() * &large.gravity;
        assert_close("gravity", projected.as_slice(), small.gravity.as_slice(), 1e-13);
        assert_close("potential", &[large.potential], &[small.potential], 1e-13);
    }
}

#[test]
fn postures_stand_where_the_table_says() {
    let atlas = robot("atlas");
    let table = vectors("posture_residuals");
    assert_eq!(atlas.postures.len(), 7);
    for expected in table["atlas"].as_array().unwrap() {
        let posture = atlas.posture(expected["posture"].as_str().unwrap()).unwrap();
        let zeros = [0.0; 30];
        let base = atlas.base_pose_w(posture).unwrap();
        let got = Evaluation::new(&atlas.tree, base, Twist::default(), &posture.q, &zeros);
        let point = |prefix: &str| -> Vec<f64> {
            ["x", "y", "z"].iter().map(|axis| number(&expected[format!("{prefix}_{axis}_m")])).collect()
        };
        assert_close("mass centre", got.com.as_slice(), &point("com"), 1e-12);
        for (frame, prefix) in [("l_sole_centre", "left_sole"), ("l_hand_point", "left_hand")] {
            let frame = atlas.frame(frame).unwrap();
            let position = got.kinematics.point_w(frame.body.unwrap(), &frame.pose.translation);
            assert_close(prefix, position.as_slice(), &point(prefix), 1e-12);
        }
        // The world of the table is the right sole.
        let sole = atlas.frame("r_sole_centre").unwrap();
        let pose = got.kinematics.link_poses_w()[sole.body.unwrap()] * sole.pose;
        assert!(
            pose.translation.amax() < 1e-9
                && (pose.rotation - RigidTransform::identity().rotation).amax() < 1e-7
        );
        let margin = posture
            .q
            .iter()
            .zip(&atlas.limits)
            .fold(f64::INFINITY, |margin: f64, (q, l)| margin.min(q - l.lower).min(l.upper - q));
        assert_close("limits", &[margin], &[number(&expected["min_distance_to_joint_limit_rad"])], 1e-12);
    }
}

#[test]
fn names_limits_contacts_and_soles() {
    let atlas = robot("atlas");
    assert_eq!((atlas.body_names.len(), atlas.joint_names.len()), (31, 30));
    assert_eq!(atlas.body_names[0], "pelvis");
    let knee = atlas.joint("r_leg_kny").unwrap();
    assert_eq!(atlas.limits[knee].upper, 2.35637);
    assert_eq!(atlas.limits[knee].effort, 890.0);
    assert!(atlas.actuated.iter().all(|&actuated| actuated));
    assert!(atlas.damping.iter().all(|&damping| damping == 0.1));
    assert!(atlas.coordinate_map.is_identity());
    assert_eq!(atlas.warnings, Vec::<String>::new());
    assert_eq!(atlas.contacts.len(), 8);
    assert_eq!(atlas.shapes.len(), 65);
    assert!(
        atlas
            .shapes
            .iter()
            .all(|shape| shape.rgba.is_some() == (shape.role == delmpc_robots::ShapeRole::Visual))
    );
    let sole = atlas.sole("right").unwrap();
    let corners = [[-0.1302, -0.0643], [0.1302, -0.0643], [0.1302, 0.0643], [-0.1302, 0.0643]];
    for (corner, expected) in sole.polygon.iter().zip(corners) {
        assert!((corner - Vector2::from(expected)).amax() < 1e-15);
    }
    // On the foot the sole's corners are on the ground, still named and in place.
    let rooted = atlas.rooted_at("r_sole_centre").unwrap().model;
    let heel = &rooted.contacts[sole.contacts[0]];
    assert_eq!((heel.name.as_str(), heel.body), ("r_heel_right", None));
    assert!((heel.position - Vector3::new(-0.1302, -0.0643, 0.0)).amax() < 1e-15);
    assert_eq!(rooted.frame("r_sole_centre").unwrap().body, None);
    let knee = rooted.joint("r_leg_kny").unwrap();
    assert_eq!(
        (knee, rooted.limits[knee].upper, rooted.tree.bodies()[knee].joint.damping),
        (2, 2.35637, 0.1)
    );
    assert!(rooted.rooted_at("l_sole_centre").is_err());
}

#[test]
fn fixed_at_a_link_is_the_same_as_rooted_at_its_frame() {
    let file = root().join("configs/robots/atlas.urdf");
    let options = LoadOptions { base: BaseChoice::Fixed("l_foot".to_owned()), ..LoadOptions::default() };
    let fixed = load_with(&file, &options).unwrap();
    let rooted = robot("atlas").rooted_at("l_foot").unwrap().model;
    assert_eq!(fixed.joint_names, rooted.joint_names);
    assert_eq!(
        fixed.joint_names[..6],
        ["l_leg_akx", "l_leg_aky", "l_leg_kny", "l_leg_hpy", "l_leg_hpx", "l_leg_hpz"]
    );
    assert_eq!(fixed.tree.bodies(), rooted.tree.bodies());

    // Fixed at its own root: the pelvis is the ground.
    let options = LoadOptions { base: BaseChoice::Fixed("pelvis".to_owned()), ..LoadOptions::default() };
    let fixed = load_with(&file, &options).unwrap();
    assert_eq!((fixed.tree.dof(), fixed.tree.ground_inertia_w().mass), (30, 9.509));
    assert_eq!(fixed.link("pelvis").unwrap().body, None);
    let same = robot("atlas").rooted_at("pelvis").unwrap().model;
    assert_eq!(fixed.tree.bodies(), same.tree.bodies());
}

#[test]
fn base_link_frame_and_mass_centre_frame_convert() {
    let atlas = robot("atlas");
    let posture = atlas.posture("one_foot_right").unwrap();
    let base = atlas.base_pose_w(posture).unwrap();
    let link = posture.base_link_pose_w.unwrap();
    assert!((base.translation - link.transform_point(&Vector3::new(0.0111, 0.0, 0.0271))).amax() < 1e-15);
    assert!((base_link_pose(&atlas.tree, &base).translation - link.translation).amax() < 1e-15);
}
