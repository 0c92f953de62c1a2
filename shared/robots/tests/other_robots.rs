//! LittleDog and Spring Flamingo: the expected numbers of `tests/vectors/robots`.

mod common;

use common::*;
use delmpc_mechanics::spatial::{RigidTransform, Twist};

#[test]
fn littledog_at_the_zero_and_the_seeded_posture() {
    let littledog = robot("littledog");
    let expected = vectors("littledog");
    check_zero_posture(&littledog, &expected["floating"]);
    check_seeded_posture(&littledog, &expected["floating_seeded_posture"]);
    assert_eq!(littledog.warnings, Vec::<String>::new());
}

#[test]
fn littledog_postures_put_the_feet_where_the_table_says() {
    let littledog = robot("littledog");
    let table = vectors("posture_residuals");
    for expected in table["littledog"].as_array().unwrap() {
        let posture = littledog.posture(expected["posture"].as_str().unwrap()).unwrap();
        let base = littledog.base_pose_w(posture).unwrap();
        let got = Evaluation::new(&littledog.tree, base, Twist::default(), &posture.q, &[0.0; 12]);
        let point = |prefix: &str| -> Vec<f64> {
            ["x", "y", "z"].iter().map(|axis| number(&expected[format!("{prefix}_{axis}_m")])).collect()
        };
        assert_close("mass centre", got.com.as_slice(), &point("com"), 1e-12);
        for contact in &littledog.contacts {
            assert_eq!(contact.radius, 0.0103);
            let position = got.kinematics.point_w(contact.body.unwrap(), &contact.position);
            assert_close(
                &contact.name,
                position.as_slice(),
                &point(&format!("{}_centre", contact.name)),
                1e-12,
            );
        }
    }
}

#[test]
fn spring_flamingo_at_the_zero_and_the_seeded_posture() {
    let flamingo = robot("spring_flamingo");
    let expected = vectors("spring_flamingo");
    check_zero_posture(&flamingo, &expected["primary"]);
    check_seeded_posture(&flamingo, &expected["primary_seeded_posture"]);
    assert_eq!(flamingo.warnings, Vec::<String>::new());
}

#[test]
fn spring_flamingo_is_planar_with_passive_sprung_ankles() {
    let flamingo = robot("spring_flamingo");
    assert!(!flamingo.tree.is_floating());
    assert_eq!(flamingo.joint_names[..3], ["base_x", "base_z", "base_pitch"]);
    assert_eq!(flamingo.actuated, [false, false, false, true, true, false, true, true, false]);
    for (joint, name) in flamingo.joint_names.iter().enumerate() {
        let ankle = name.ends_with("ankle");
        let in_tree = &flamingo.tree.bodies()[joint].joint;
        let expected = if ankle { (0.1, 0.1) } else { (0.0, 0.0) };
        assert_eq!((in_tree.stiffness, in_tree.damping), expected, "{name}");
    }
    let table = vectors("posture_residuals");
    for expected in table["spring_flamingo"].as_array().unwrap() {
        let posture = flamingo.posture(expected["posture"].as_str().unwrap()).unwrap();
        let got = Evaluation::new(
            &flamingo.tree,
            RigidTransform::identity(),
            Twist::default(),
            &posture.q,
            &[0.0; 9],
        );
        let com = [number(&expected["com_x_m"]), 0.0, number(&expected["com_z_m"])];
        assert_close("mass centre", got.com.as_slice(), &com, 1e-12);
        for contact in &flamingo.contacts {
            let position = got.kinematics.point_w(contact.body.unwrap(), &contact.position);
            let at = |axis: &str| number(&expected[format!("{}_{axis}_m", contact.name)]);
            assert_close(&contact.name, &[position.x, position.z], &[at("x"), at("z")], 1e-12);
        }
    }
}
