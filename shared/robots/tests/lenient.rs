//! What the field writes beside the format: read with a warning that names file, line, element and what is done; `strict` makes it an error.
#![allow(clippy::panic, clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use delmpc_mechanics::errors::ModelError;
use delmpc_robots::{
    BaseChoice, ImpossibleInertia, LoadOptions, RobotError, RobotModel, Rule, Subject, load_str,
};

const BODY: &str =
    "<inertial><mass value='2'/><inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.1'/></inertial>";
const LIMIT: &str = "<limit lower='-1' upper='1' effort='5' velocity='6'/>";

/// Lines: 1 robot, 2 link hull, 3 link tail, 4 joint hinge, 5 what else there is.
fn fish(hull: &str, tail: &str, joint: &str, more: &str) -> String {
    format!(
        "<robot name='fish'>\n<link name='hull'>{hull}</link>\n<link name='tail'>{tail}</link>\n\
         <joint name='hinge' type='revolute'><parent link='hull'/><child link='tail'/>{joint}</joint>\n{more}</robot>"
    )
}

fn load(urdf: &str, options: &LoadOptions) -> Result<RobotModel, RobotError> {
    load_str("pond/fish.urdf", urdf, None, options)
}

/// Loads with exactly this warning, and not at all when it is strict.
#[track_caller]
fn warned(urdf: &str, line: u32, words: &[&str]) -> RobotModel {
    let model = load(urdf, &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    let place = format!("pond/fish.urdf:{line}: ");
    for word in words.iter().copied().chain([place.as_str()]) {
        assert!(model.warnings[0].contains(word), "`{word}` is not in {}", model.warnings[0]);
    }
    let strict = LoadOptions { strict: true, ..LoadOptions::default() };
    let error = load(urdf, &strict).unwrap_err();
    assert_eq!(error.line(), Some(line), "{error}");
    model
}

#[test]
fn decoration_never_refuses_a_robot() {
    let sphere = "<geometry><sphere radius='0.1'/></geometry>";
    let shape =
        |role: &str, content: &str| fish(&format!("{BODY}<{role}>{content}</{role}>"), BODY, LIMIT, "");
    for (urdf, words) in [
        (shape("collision", ""), ["<geometry>", "left out"]),
        (shape("collision", "<geometry/>"), ["<box>", "left out"]),
        (shape("visual", "<geometry><torus r='1'/></geometry>"), ["<box>", "left out"]),
        (shape("visual", "<geometry><box size='1 2'/></geometry>"), ["size", "left out"]),
        (shape("visual", "<geometry><mesh filename=' '/></geometry>"), ["filename", "left out"]),
        (shape("visual", &format!("<origin xyz='a b c'/>{sphere}")), ["xyz", "left out"]),
    ] {
        let model = warned(&urdf, 2, &["link `hull`", words[0], words[1]]);
        assert!(model.shapes.is_empty() && model.meshes.is_empty());
    }
    for (material, words, coloured) in [
        ("<material><color rgba='1 0 0 1'/></material>", ["name of <material>", "this place only"], true),
        ("<material name=''><color rgba='1 0 0 1'/></material>", ["name of <material>", "this place"], true),
        ("<material name='red'><color/></material>", ["rgba", "colour is left out"], false),
        ("<material name='red'><color rgba='1 0 0'/></material>", ["rgba", "colour is left out"], false),
        ("<material name='red'><texture/></material>", ["<texture>", "left out"], false),
    ] {
        let model = warned(&shape("visual", &format!("{sphere}{material}")), 2, &words);
        assert_eq!(model.shapes.len(), 1, "{material}");
        assert_eq!(model.shapes[0].rgba.is_some(), coloured, "{material}");
    }
    // A material of the whole robot.
    warned(&fish(BODY, BODY, LIMIT, "<material><color rgba='1 0 0 1'/></material>\n"), 5, &["<material>"]);
    let mesh = shape("visual", "<geometry><mesh filename='fin.stl' scale='0.5'/></geometry>");
    let model = warned(&mesh, 2, &["scale of <mesh>", "all three axes"]);
    assert_eq!((model.meshes[0].file.as_str(), model.meshes[0].scale.as_slice()), ("fin.stl", &[0.5; 3][..]));
}

#[test]
fn many_warnings_of_one_kind_are_one() {
    let shapes = "<visual><geometry/></visual>".repeat(7);
    let model = load(&fish(&format!("{BODY}{shapes}"), BODY, LIMIT, ""), &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings.len(), 1, "{:?}", model.warnings);
    assert!(model.warnings[0].ends_with("(and 6 more of this kind)"), "{}", model.warnings[0]);
}

#[test]
fn shapes_that_can_be_read_keep_their_order_and_places() {
    let shapes = "<visual><origin xyz='1 0 0'/><geometry><sphere radius='0.1'/></geometry></visual>\
                  <visual><origin xyz='2 0 0'/><geometry/></visual>\
                  <visual><origin xyz='3 0 0'/><geometry><sphere radius='0.3'/></geometry></visual>";
    let model = load(&fish(&format!("{BODY}{shapes}"), BODY, LIMIT, ""), &LoadOptions::default()).unwrap();
    let places: Vec<f64> = model.shapes.iter().map(|shape| shape.attachment.pose.translation.x).collect();
    assert_eq!(places, [1.0, 3.0]);
}

#[test]
fn rulers_of_dashes_in_comments_are_read() {
    let urdf = fish(BODY, BODY, LIMIT, "<!-- plain -->\n<!-- ---- tail ---- -->\n<!--- x --->\n");
    let model = load(&urdf, &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings.len(), 1);
    assert!(model.warnings[0].contains("fish.urdf:6: two dashes"), "{}", model.warnings[0]);
    assert!(model.warnings[0].contains("1 more"), "{}", model.warnings[0]);
    // Whatever stands in a comment stays one.
    let hidden = fish(BODY, BODY, LIMIT, "<!-- -- <joint name='x'> -- -->\n");
    assert_eq!(load(&hidden, &LoadOptions::default()).unwrap().joint_names, ["hinge"]);
    // Errors behind such comments have their line.
    let late = fish(BODY, BODY, LIMIT, "<!-- --\n--\n-- -->\n<link/>\n");
    assert_eq!(load(&late, &LoadOptions::default()).unwrap_err().line(), Some(8));
}

#[test]
fn limits_without_stops_and_stops_without_use() {
    let model = warned(
        &fish(BODY, BODY, "<limit effort='5' velocity='6'/>", ""),
        4,
        &["joint `hinge`", "lower and upper", "without stops"],
    );
    assert_eq!((model.limits[0].lower, model.limits[0].upper), (f64::NEG_INFINITY, f64::INFINITY));
    assert_eq!((model.limits[0].effort, model.limits[0].velocity), (5.0, 6.0));
    let continuous = fish(BODY, BODY, LIMIT, "").replace("revolute", "continuous");
    let model = warned(&continuous, 4, &["joint `hinge`", "no stops", "lower=-1 upper=1", "revolute"]);
    assert_eq!(model.limits[0].upper, f64::INFINITY);
}

#[test]
fn a_diagonal_inertia_is_enough() {
    let diagonal = "<inertial><mass value='1'/><inertia ixx='1' iyy='2' izz='2.5'/></inertial>";
    let model = load(&fish(diagonal, BODY, LIMIT, ""), &LoadOptions::default()).unwrap();
    assert_eq!(model.tree.bodies()[0].inertia.inertia.diagonal().as_slice(), [1.0, 2.0, 2.5]);
    assert!(model.warnings[0].contains("fish.urdf:2: link `hull`: ixy of <inertia>"), "{:?}", model.warnings);
    let no_diagonal = diagonal.replace("iyy='2' ", "");
    let error = load(&fish(&no_diagonal, BODY, LIMIT, ""), &LoadOptions::default()).unwrap_err();
    assert_eq!(error.rule(), &Rule::Missing { what: "iyy of <inertia>" });
}

#[test]
fn quaternions_are_used_from_version_1_1_on() {
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let turned = format!("<origin xyz='0 0 1' quat_xyzw='0 0 {half} {half}'/>{LIMIT}");
    let old = fish(BODY, BODY, &turned, "");
    let model = warned(&old, 4, &["joint `hinge`", "quat_xyzw", "version=\"1.1\""]);
    let rotation = |model: &RobotModel| model.tree.bodies()[1].joint.placement.rotation;
    assert_eq!(rotation(&model), nalgebra::Matrix3::identity());
    let new = old.replace("<robot name", "<robot version='1.1' name");
    let model = load(&new, &LoadOptions::default()).unwrap();
    assert_eq!(model.warnings, Vec::<String>::new());
    let expected = nalgebra::Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    assert!((rotation(&model) - expected).amax() < 1e-15);
    for bad in [
        new.replace("quat_xyzw", "rpy='0 0 1' quat_xyzw"),
        new.replace(&format!("0 0 {half} {half}"), "0 0 0 0"),
    ] {
        let error = load(&bad, &LoadOptions::default()).unwrap_err();
        assert_eq!(
            (error.line(), error.subject()),
            (Some(4), &Subject::Joint("hinge".to_owned())),
            "{error}"
        );
    }
}

/// An inertia that no body has, times a size.
fn impossible(mass: f64, size: f64) -> String {
    let entry = |name: &str| format!("{name}='{size:e}' ");
    let entries: String = ["ixx", "ixy", "ixz", "iyy", "iyz", "izz"].map(entry).concat();
    format!("<inertial><mass value='{mass}'/><inertia {entries}/></inertial>")
}

#[test]
fn inertias_are_judged_as_they_move() {
    // Fixed to a trunk the dummy does no harm, and with the trunk's mass it can be simulated.
    let fin = |content: &str| {
        format!(
            "<link name='fin'>{content}</link><joint name='f' type='fixed'><parent link='tail'/><child link='fin'/></joint>\n"
        )
    };
    for dummy in [impossible(1e-6, 1e-6), impossible(0.0, 1e-6)] {
        let model = load(&fish(BODY, BODY, LIMIT, &fin(&dummy)), &LoadOptions::default()).unwrap();
        assert_eq!(model.warnings, Vec::<String>::new(), "{dummy}");
        let inertia = model.tree.bodies()[1].inertia.inertia;
        assert!((inertia[(0, 1)] - 1e-6).abs() < 1e-15, "{inertia}");
    }
    // What moves must be possible, or be accepted; the remedy that is named works.
    let moving = fish(BODY, &impossible(1.0, 1.0), LIMIT, "");
    let error = load(&moving, &LoadOptions::default()).unwrap_err();
    assert_eq!(error.subject(), &Subject::Link("tail".to_owned()));
    assert!(error.to_string().contains("accept_impossible_inertia = true"), "{error}");
    let table = "format = 1\naccept_impossible_inertia = true\n";
    let model = load_str("pond/fish.urdf", &moving, Some(table), &LoadOptions::default()).unwrap();
    assert_eq!(model.tree.bodies()[1].inertia.inertia[(0, 1)], 1.0);
    assert!(model.warnings[0].contains("link `tail`") && model.warnings[0].contains("all the same"));
    assert!(model.rooted_at("tail").is_ok() && model.rooted_at("hull").is_ok());
    // Three digits of a thin plate are round-off.
    let plate = BODY.replace("izz='0.1'", "izz='0.2003'");
    let model = warned(&fish(BODY, &plate, LIMIT, ""), 3, &["link `tail`", "round-off"]);
    assert_eq!(model.tree.bodies()[1].inertia.inertia[(2, 2)], 0.2003);
}

#[test]
fn links_that_move_without_mass() {
    // Between two joints: a joint of two axes.
    let tip = |inertial: &str| {
        format!(
            "<link name='tip'>{inertial}</link><joint name='k' type='revolute'><parent link='tail'/><child link='tip'/>{LIMIT}</joint>\n"
        )
    };
    let model = warned(&fish(BODY, "", LIMIT, &tip(BODY)), 3, &["link `tail`", "no <inertial>"]);
    assert_eq!(model.joint_names, ["hinge", "k"]);
    // At the end of the tree nothing can move it: a frame that somebody gave a joint is held, and nothing else is guessed.
    let model =
        warned(&fish(BODY, BODY, LIMIT, &tip("")), 5, &["link `tip`", "no <inertial>", "`k` is held at 0"]);
    assert_eq!(model.joint_names, ["hinge"]);
    let still = tip(&impossible(0.0, 0.0)).replace("velocity='6'", "velocity='0'");
    let model = warned(&fish(BODY, BODY, LIMIT, &still), 5, &["link `tip`", "has mass", "`k` is held at 0"]);
    assert_eq!(model.joint_names, ["hinge"]);
    for (inertial, rule) in [
        (impossible(0.0, 0.0), ModelError::MasslessSubtree { body: 0 }),
        (impossible(0.0, 1e-3), ModelError::InertiaWithoutMass { body: 0 }),
    ] {
        let urdf = fish(BODY, BODY, LIMIT, &tip(&inertial));
        let error = load(&urdf, &LoadOptions::default()).unwrap_err();
        assert_eq!(error.subject(), &Subject::Link("tip".to_owned()));
        let Rule::Physics(found) = error.rule() else { panic!("{error}") };
        assert_eq!(std::mem::discriminant(found), std::mem::discriminant(&rule), "{error}");
        let accept = LoadOptions { impossible_inertia: ImpossibleInertia::Accept, ..LoadOptions::default() };
        let model = load(&urdf, &accept).unwrap();
        assert_eq!(model.joint_names, ["hinge"]);
        assert!(model.warnings.iter().any(|warning| warning.contains("`k` is held at 0")));
    }
}

#[test]
fn a_joint_that_follows_nobody_moves_by_itself() {
    let urdf = fish(BODY, BODY, &format!("<mimic joint='hing'/>{LIMIT}"), "");
    let model = warned(&urdf, 4, &["joint `hinge`", "the joint `hing`", "by itself"]);
    assert!(model.coordinate_map.is_identity() && model.actuated[0]);
}

#[test]
fn round_off_around_zero_is_zero() {
    let point = BODY.replace("'0.1'", "'-5.4e-20'");
    let model = load(&fish(BODY, &point, LIMIT, ""), &LoadOptions::default()).unwrap();
    assert_eq!(model.tree.bodies()[1].inertia.inertia, nalgebra::Matrix3::zeros());
}

#[test]
fn a_root_called_world_is_the_world() {
    let urdf = fish(BODY, BODY, LIMIT, "").replace(
        "<link name='hull'>",
        "<link name='world'/><joint name='w' type='fixed'><origin xyz='0 0 3'/><parent link='world'/><child link='hull'/></joint><link name='hull'>",
    );
    let model = load(&urdf, &LoadOptions::default()).unwrap();
    assert!(!model.tree.is_floating());
    assert_eq!(model.link("hull").unwrap().pose.translation.z, 3.0);
    assert!(model.warnings[0].contains("fish.urdf:2: link `world`"), "{:?}", model.warnings);
    // What does not move may have any inertia.
    let pedestal = urdf.replacen(BODY, &impossible(1.0, 1.0), 1);
    assert_eq!(load(&pedestal, &LoadOptions::default()).unwrap().warnings.len(), 1);
    let floating = LoadOptions { base: BaseChoice::Floating, ..LoadOptions::default() };
    assert!(load(&urdf, &floating).unwrap().tree.is_floating());
}

#[test]
fn joints_can_be_locked_by_the_companion_table() {
    let urdf = fish(BODY, BODY, &format!("<origin xyz='1 0 0'/><axis xyz='0 0 1'/>{LIMIT}"), "");
    let with = |table: &str| load_str("pond/fish.urdf", &urdf, Some(table), &LoadOptions::default());
    let locked = with("format = 1\n[locked]\nhinge = 0.5\n").unwrap();
    assert!(locked.joint_names.is_empty());
    let tail = locked.link("tail").unwrap();
    assert_eq!(tail.pose.translation.x, 1.0);
    assert!((tail.pose.rotation[(1, 0)] - 0.5_f64.sin()).abs() < 1e-15);
    let error = with("format = 1\n[locked]\nhinges = 0.5\n").unwrap_err();
    assert_eq!((error.line(), error.subject()), (Some(3), &Subject::Entry("locked `hinges`".to_owned())));
    assert!(with("format = 1\n[locked]\nhinge = nan\n").is_err());
}
