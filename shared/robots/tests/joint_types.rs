//! What each kind of joint and base becomes.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "test helpers: a file that does not load is a failed test"
)]

mod common;

use common::assert_close;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::spatial::{RigidTransform, exp_rotation};
use delmpc_mechanics::tree::JointKind;
use delmpc_robots::{BaseChoice, Geometry, LoadOptions, RobotModel, Rule, load_str};
use nalgebra::{Matrix3, Vector3};

const INERTIAL: &str = "<inertial><origin xyz='0.1 0 0'/><mass value='2'/>\
    <inertia ixx='0.1' ixy='0' ixz='0' iyy='0.2' iyz='0' izz='0.2'/></inertial>";
const LIMIT: &str = "<limit lower='-1' upper='2' effort='5' velocity='6'/>";

fn load(body: &str) -> RobotModel {
    with_base(body, BaseChoice::Auto).unwrap_or_else(|error| panic!("{error}"))
}

fn with_base(body: &str, base: BaseChoice) -> Result<RobotModel, delmpc_robots::RobotError> {
    let text =
        format!("<robot name='r'>{}</robot>", body.replace("INERTIAL", INERTIAL).replace("LIMIT", LIMIT));
    load_str("test.urdf", &text, None, &LoadOptions { base, ..LoadOptions::default() })
}

fn kinematics(model: &RobotModel, q: &[f64]) -> Kinematics {
    let mut kinematics = Kinematics::new(&model.tree);
    kinematics.update_positions(&model.tree, &Configuration::fixed(q)).unwrap();
    kinematics
}

#[test]
fn fixed_joints_merge_inertia_shapes_and_frames() {
    let model = load(
        "<link name='world'/><link name='a'>INERTIAL</link><link name='tool'>INERTIAL
           <visual><origin xyz='0 0 1'/><geometry><sphere radius='0.1'/></geometry></visual></link><link name='tip'/>
         <joint name='j' type='continuous'><parent link='world'/><child link='a'/><axis xyz='0 0 2'/></joint>
         <joint name='f' type='fixed'><origin xyz='0 1 0' rpy='0 0 1.5707963267948966'/><parent link='a'/><child link='tool'/></joint>
         <joint name='g' type='fixed'><origin xyz='1 0 0'/><parent link='tool'/><child link='tip'/></joint>",
    );
    assert_eq!((model.tree.dof(), model.tree.total_mass()), (1, 4.0));
    assert_eq!(model.body_names, ["a"]);
    let inertia = &model.tree.bodies()[0].inertia;
    // Mass centres (0.1, 0, 0) and (0, 1.1, 0).
    assert!((inertia.com - Vector3::new(0.05, 0.55, 0.0)).amax() < 1e-15);
    let turned = exp_rotation(&Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2));
    let own = Matrix3::from_diagonal(&Vector3::new(0.1, 0.2, 0.2));
    let mut expected = own + turned * own * turned.transpose();
    for offset in [Vector3::new(0.05, -0.55, 0.0), Vector3::new(-0.05, 0.55, 0.0)] {
        expected += (Matrix3::identity() * offset.norm_squared() - offset * offset.transpose()) * 2.0;
    }
    assert!((inertia.inertia - expected).amax() < 1e-14);
    assert_eq!(model.tree.bodies()[0].joint.axis, Vector3::z());
    let tip = model.link("tip").unwrap();
    assert_eq!(tip.body, Some(0));
    assert!((tip.pose.translation - Vector3::new(0.0, 2.0, 0.0)).amax() < 1e-15);
    assert_eq!(model.shapes[0].geometry, Geometry::Sphere { radius: 0.1 });
    assert!((model.shapes[0].attachment.pose.translation - Vector3::new(0.0, 1.0, 1.0)).amax() < 1e-15);
    assert_eq!(model.limits[0], delmpc_robots::JointLimits::NONE);
}

#[test]
fn the_base_follows_from_the_root() {
    let chain = "<joint name='j' type='revolute'><parent link='a'/><child link='b'/>LIMIT</joint><link name='b'>INERTIAL</link>";
    let massive = format!("<link name='a'>INERTIAL</link>{chain}");
    let empty = format!("<link name='a'/>{chain}");
    assert_eq!(load(&massive).tree.dof(), 7);
    assert_eq!(load(&empty).tree.dof(), 1);
    // A dummy root on a massive body, as ROS likes it.
    let dummy = format!(
        "<link name='r'/><joint name='f' type='fixed'><origin xyz='0 0 1'/><parent link='r'/><child link='a'/></joint>{massive}"
    );
    let model = load(&dummy);
    assert_eq!(model.tree.dof(), 7);
    assert_eq!(model.link("a").unwrap().pose.translation.z, 1.0);
    assert_eq!(model.body_names, ["r", "b"]);
    let fixed = with_base(&dummy, BaseChoice::Fixed("a".to_owned())).unwrap();
    assert_eq!((fixed.tree.dof(), fixed.tree.total_mass()), (1, 4.0));
    assert_eq!(fixed.link("a").unwrap().pose, RigidTransform::identity());
    assert_eq!(fixed.link("r").unwrap().pose.translation.z, -1.0);
    assert_eq!(kinematics(&fixed, &[0.0]).link_poses_w()[0], RigidTransform::identity());
    // A floating joint from an empty world.
    let world = format!(
        "<link name='world'/><joint name='f' type='floating'><parent link='world'/><child link='a'/></joint>{massive}"
    );
    let model = load(&world);
    assert_eq!((model.tree.is_floating(), model.joint_names.len()), (true, 1));
    assert_eq!((model.link("world").unwrap().body, model.link("a").unwrap().body), (None, Some(0)));
    // Choices the file cannot have.
    for (text, base) in [
        (&empty, BaseChoice::Floating),
        (&empty, BaseChoice::Fixed("b".to_owned())),
        (&massive, BaseChoice::Fixed("x".to_owned())),
    ] {
        let error = with_base(text, base).unwrap_err();
        assert!(matches!(error.rule(), Rule::Base { .. }), "{error}");
    }
    let reversed = with_base(&massive, BaseChoice::Fixed("b".to_owned())).unwrap();
    assert_eq!((reversed.tree.dof(), &reversed.body_names[..]), (1, &["a".to_owned()][..]));
}

#[test]
fn planar_joints_are_two_slides_and_a_turn() {
    for (axis, names) in [
        ("1 0 0", ["p_y", "p_z", "p_roll"]),
        ("0 -1 0", ["p_x", "p_z", "p_pitch"]),
        ("0 0 3", ["p_x", "p_y", "p_yaw"]),
        ("1 1 1", ["p_1", "p_2", "p_angle"]),
    ] {
        let model = load(&format!(
            "<link name='w'/><link name='a'>INERTIAL</link><joint name='p' type='planar'><origin xyz='0 0 1'/>
             <parent link='w'/><child link='a'/><axis xyz='{axis}'/><dynamics damping='0.5'/></joint>"
        ));
        assert_eq!(model.joint_names, names);
        assert_eq!(model.body_names[2], "a");
        assert_eq!(model.damping, [0.5; 3]);
        assert_eq!(model.actuated, [false; 3]);
        let bodies = model.tree.bodies();
        assert_eq!(bodies[0].joint.kind, JointKind::Prismatic);
        assert_eq!((bodies[0].inertia.mass, bodies[2].inertia.mass), (0.0, 2.0));
        let normal = bodies[2].joint.axis;
        let q = [0.3, -0.7, 0.4];
        let pose = kinematics(&model, &q).link_poses_w()[2];
        let moved = pose.translation - Vector3::new(0.0, 0.0, 1.0);
        assert!(moved.dot(&normal).abs() < 1e-15 && (moved.norm() - 0.3f64.hypot(0.7)).abs() < 1e-15);
        assert!((pose.rotation - exp_rotation(&(normal * 0.4))).amax() < 1e-15);
    }
}

#[test]
fn explicitly_massless_links_may_move_and_prismatic_joints_slide() {
    let model = load(
        "<link name='w'/><link name='a'><inertial><mass value='0'/><inertia ixx='0' ixy='0' ixz='0' iyy='0' iyz='0' izz='0'/></inertial></link>
         <link name='b'>INERTIAL</link>
         <joint name='i' type='prismatic'><parent link='w'/><child link='a'/><axis xyz='0 1 0'/>LIMIT</joint>
         <joint name='j' type='revolute'><parent link='a'/><child link='b'/>LIMIT<dynamics friction='0.2'/></joint>",
    );
    assert_eq!(model.joint_names, ["i", "j"]);
    assert_eq!((model.limits[0].lower, model.limits[0].velocity), (-1.0, 6.0));
    // Without <axis> it is x.
    assert_eq!(model.tree.bodies()[1].joint.axis, Vector3::x());
    assert_eq!(kinematics(&model, &[0.7, 0.0]).link_poses_w()[1].translation, Vector3::new(0.0, 0.7, 0.0));
    assert_eq!(model.friction, [0.0, 0.2]);
    assert!(model.warnings[0].contains("friction"));
}

#[test]
fn joints_are_numbered_depth_first_in_the_order_of_the_file() {
    let joint = |name: &str, parent: &str, child: &str| {
        format!(
            "<link name='{child}'>INERTIAL</link><joint name='{name}' type='continuous'><parent link='{parent}'/><child link='{child}'/></joint>"
        )
    };
    let model = load(
        &[
            joint("d", "b", "l4"),
            "<link name='r'>INERTIAL</link>".to_owned(),
            joint("b", "r", "b"),
            joint("a", "r", "l3"),
            joint("c", "b", "l5"),
        ]
        .concat(),
    );
    assert_eq!(model.joint_names, ["b", "d", "c", "a"]);
}

/// A gripper whose second finger mimics the first: the reduced mass matrix is that of the jaw distance.
#[test]
fn mimic_joints_reduce_through_the_coordinate_map() {
    let model = load(
        "<link name='w'/><link name='a'>INERTIAL</link><link name='b'>INERTIAL</link>
         <joint name='left' type='prismatic'><parent link='w'/><child link='a'/><axis xyz='0 1 0'/>LIMIT</joint>
         <joint name='right' type='prismatic'><parent link='w'/><child link='b'/><axis xyz='0 1 0'/>LIMIT
           <mimic joint='left' multiplier='-1' offset='0.2'/></joint>",
    );
    let map = &model.coordinate_map;
    assert!(!map.is_identity());
    assert_eq!((map.full_len(), map.reduced_len(), map.independent_joints()), (2, 1, &[0][..]));
    assert_eq!(map.row(1), (0, -1.0, 0.2));
    assert_eq!(model.actuated, [true, false]);
    let mut q = [0.0; 2];
    map.expand_into(&[0.05], &mut q).unwrap();
    assert_close("full coordinates", &q, &[0.05, 0.15], 1e-16);
    let mut full = [0.0; 4];
    mass_matrix_into(
        &model.tree,
        &kinematics(&model, &q),
        &mut MassMatrixWorkspace::new(&model.tree),
        &mut full,
    )
    .unwrap();
    let mut reduced = [0.0];
    map.project_matrix_into(0, &full, &mut reduced).unwrap();
    assert_close("reduced mass", &reduced, &[4.0], 1e-15);
}

#[test]
fn utf8_marks_and_foreign_elements_are_no_obstacle() {
    let text = format!(
        "\u{feff}<?xml version='1.0' encoding='utf-8'?><!-- ü --><robot name='r' xmlns:g='http://g'><gazebo/><g:x/>
         <link name='a' kind='x'>{INERTIAL}<contact/></link><transmission name='t'><joint name='a'/></transmission></robot>"
    );
    let model = load_str("test.urdf", &text, None, &LoadOptions::default()).unwrap();
    assert_eq!((model.tree.dof(), model.tree.total_mass()), (6, 2.0));
}
