//! Broken files: every error names the file, the line, the link or joint, the rule and the remedy.
#![allow(clippy::expect_used, reason = "a broken file that loads is a failed test")]

use delmpc_mechanics::errors::ModelError;
use delmpc_robots::{ImpossibleInertia, LoadOptions, RobotError, Rule, Subject, load_str, load_with};

const LIMIT: &str = r#"<limit lower="-1" upper="1" effort="5" velocity="6"/>"#;

fn inertial(mass: f64, ixx: f64, iyy: f64, izz: f64) -> String {
    format!(
        r#"<inertial><mass value="{mass}"/><inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>"#
    )
}

fn link(name: &str) -> String {
    format!("<link name=\"{name}\">{}</link>\n", inertial(1.0, 0.1, 0.1, 0.1))
}

fn joint(name: &str, kind: &str, parent: &str, child: &str, rest: &str) -> String {
    format!(
        r#"<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>"#
    ) + "\n"
}

fn robot(parts: &[String]) -> String {
    format!("<robot name=\"r\">\n{}</robot>", parts.concat())
}

/// `a -j-> b`, with the joint as given.
fn with_joint(kind: &str, rest: &str) -> String {
    robot(&[link("a"), link("b"), joint("j", kind, "a", "b", rest)])
}

/// `a -j-> b`, with the content of link b as given.
fn with_link(content: &str) -> String {
    let b = format!("<link name=\"b\">{content}</link>\n");
    robot(&[link("a"), b, joint("j", "revolute", "a", "b", LIMIT)])
}

fn load(urdf: &str) -> Result<(), RobotError> {
    load_str("dir/broken.urdf", urdf, None, &LoadOptions::default()).map(|_| ())
}

#[track_caller]
fn refused(urdf: &str, line: impl Into<Option<u32>>, subject: Subject, rule: impl Fn(&Rule) -> bool) {
    let error = load(urdf).expect_err(urdf);
    let text = error.to_string();
    assert!(rule(error.rule()), "{text}");
    assert_eq!(error.subject(), &subject, "{text}");
    assert_eq!(error.line(), line.into(), "{text}");
    assert!(text.starts_with("dir/broken.urdf") && text.contains(". Remedy: "), "{text}");
    if let Subject::Link(name) | Subject::Joint(name) = subject {
        assert!(text.contains(&format!("`{name}`")), "{text}");
    }
}

fn b() -> Subject {
    Subject::Link("b".to_owned())
}

fn j() -> Subject {
    Subject::Joint("j".to_owned())
}

#[test]
fn the_frame_of_these_tests_is_accepted() {
    load(&with_joint("revolute", LIMIT)).unwrap();
    load(&with_link(&inertial(1.0, 0.1, 0.1, 0.1))).unwrap();
}

#[test]
fn malformed_files() {
    let file = Subject::File;
    refused("", 1, file.clone(), |rule| matches!(rule, Rule::Xml(_)));
    refused("not xml", 1, file.clone(), |rule| matches!(rule, Rule::Xml(_)));
    refused("<robot><link></robot>", 1, file.clone(), |rule| matches!(rule, Rule::Xml(_)));
    refused("<sdf/>", 1, file.clone(), |rule| matches!(rule, Rule::NotARobot { .. }));
    refused("<robot name='r'/>", 1, file.clone(), |rule| matches!(rule, Rule::Missing { what: "a <link>" }));
    refused("<robot>\n<link/></robot>", 2, file.clone(), |rule| matches!(rule, Rule::Missing { .. }));
    let xacro = "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'><xacro:macro/><link name='a'/></robot>";
    refused(xacro, 1, file.clone(), |rule| matches!(rule, Rule::Xml(text) if text.contains("xacro")));
    let doctype = "<!DOCTYPE r [<!ENTITY a 'aaaa'>]>\n<robot/>";
    refused(doctype, 1, file, |rule| matches!(rule, Rule::DocumentType));
}

#[test]
fn links_without_usable_inertia() {
    let missing = |what: &'static str| move |rule: &Rule| *rule == Rule::Missing { what };
    refused(&with_link("<inertial/>"), 3, b(), missing("<mass> of <inertial>"));
    refused(
        &with_link("<inertial>\n<mass value='1'/></inertial>"),
        3,
        b(),
        missing("<inertia> of <inertial>"),
    );
    let no_izz = "<inertial><mass value='1'/>\n<inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0'/></inertial>";
    refused(&with_link(no_izz), 4, b(), missing("izz of <inertia>"));
    let twice = inertial(1.0, 1.0, 1.0, 1.0).repeat(2);
    refused(&with_link(&twice), 3, b(), |rule| matches!(rule, Rule::Repeated { .. }));
    for text in ["", "one", "NaN", "inf", "1 2"] {
        let content = inertial(1.0, 1.0, 1.0, 1.0).replace("value=\"1\"", &format!("value=\"{text}\""));
        refused(&with_link(&content), 3, b(), |rule| {
            matches!(rule, Rule::NotNumbers { attribute: "value", .. } | Rule::Missing { .. })
        });
    }
    let physics = |content: String, rule: fn(&ModelError) -> bool| {
        refused(&with_link(&content), 3, b(), |found| matches!(found, Rule::Physics(error) if rule(error)));
    };
    physics(inertial(-1.0, 1.0, 1.0, 1.0), |error| matches!(error, ModelError::NegativeMass { .. }));
    physics(inertial(1.0, 1.0, 1.0, 3.0), |error| matches!(error, ModelError::InertiaTriangle { .. }));
    physics(inertial(1.0, -1.0, 1.0, 1.0), |error| matches!(error, ModelError::InertiaNotPositive { .. }));
    physics(inertial(0.0, 1.0, 1.0, 1.0), |error| matches!(error, ModelError::InertiaWithoutMass { .. }));
    physics(inertial(0.0, 0.0, 0.0, 0.0), |error| matches!(error, ModelError::MasslessSubtree { .. }));
}

#[test]
fn an_impossible_inertia_can_be_repaired_with_a_warning() {
    let urdf = with_link(&inertial(1.0, 1.0, 1.0, 3.0));
    let options = LoadOptions { impossible_inertia: ImpossibleInertia::Repair, ..LoadOptions::default() };
    let model = load_str("broken.urdf", &urdf, None, &options).unwrap();
    assert_eq!(model.warnings.len(), 1);
    assert!(model.warnings[0].contains("link `b`"), "{}", model.warnings[0]);
    let moments = model.tree.bodies()[1].inertia.inertia.diagonal();
    assert!((moments.x - 4.0 / 3.0).abs() < 1e-12 && (moments.z - 8.0 / 3.0).abs() < 1e-12);
    let accept = LoadOptions { impossible_inertia: ImpossibleInertia::Accept, ..LoadOptions::default() };
    let model = load_str("broken.urdf", &urdf, None, &accept).unwrap();
    assert_eq!(model.tree.bodies()[1].inertia.inertia.diagonal().z, 3.0);
    assert!(model.warnings[0].contains("used all the same"), "{}", model.warnings[0]);
    // A negative mass is not a matter of round-off.
    let urdf = with_link(&inertial(-1.0, 1.0, 1.0, 1.0));
    assert!(load_str("broken.urdf", &urdf, None, &options).is_err());
    assert!(load_str("broken.urdf", &urdf, None, &accept).is_err());
}

#[test]
fn broken_joints() {
    let missing = |rule: &Rule| matches!(rule, Rule::Missing { .. });
    refused(&with_joint("revolute", ""), 4, j(), missing);
    refused(&with_joint("prismatic", ""), 4, j(), missing);
    refused(&with_joint("revolute", "<limit lower='0' upper='1' velocity='1'/>"), 4, j(), missing);
    refused(&with_joint("revolute", "<limit lower='0' upper='1' effort='1'/>"), 4, j(), missing);
    let limits = |rule: &Rule| matches!(rule, Rule::Limits { .. });
    refused(&with_joint("revolute", "<limit lower='1' upper='0' effort='1' velocity='1'/>"), 4, j(), limits);
    refused(&with_joint("continuous", "<limit effort='-1' velocity='1'/>"), 4, j(), limits);
    let numbers = |rule: &Rule| matches!(rule, Rule::NotNumbers { .. });
    refused(&with_joint("revolute", "<limit lower='x' upper='0' effort='1' velocity='1'/>"), 4, j(), numbers);
    refused(
        &with_joint("revolute", "<limit lower='NaN' upper='0' effort='1' velocity='1'/>"),
        4,
        j(),
        numbers,
    );
    refused(&with_joint("continuous", "<origin xyz='0 0'/>"), 4, j(), numbers);
    // urdf-rs reads three numbers here.
    refused(&with_joint("continuous", "<origin xyz='0 zero 0 0'/>"), 4, j(), numbers);
    refused(&with_joint("continuous", "<origin rpy='0 inf 0'/>"), 4, j(), numbers);
    refused(&with_joint("continuous", "<axis xyz='0 NaN 0'/>"), 4, j(), numbers);
    refused(&with_joint("continuous", "<dynamics damping='strong'/>"), 4, j(), numbers);
    refused(&with_joint("continuous", "<axis xyz='0 0 0'/>"), 4, j(), |rule| matches!(rule, Rule::ZeroAxis));
    refused(&with_joint("continuous", "<axis/>"), 4, j(), missing);
    refused(&with_joint("continuous", "<origin/><origin/>"), 4, j(), |rule| {
        matches!(rule, Rule::Repeated { .. })
    });
    refused(&with_joint("continuous", "<dynamics damping='-1'/>"), 4, j(), |rule| {
        matches!(rule, Rule::Physics(ModelError::NegativeDamping { .. }))
    });
    refused(
        &with_joint("hinge", LIMIT),
        4,
        j(),
        |rule| matches!(rule, Rule::Xml(text) if text.contains("hinge")),
    );
    let unsupported = |rule: &Rule| matches!(rule, Rule::UnsupportedJoint { .. });
    refused(&with_joint("spherical", ""), 4, j(), unsupported);
    refused(&with_joint("floating", ""), 4, j(), unsupported);
    refused("<robot><link name='a'/><joint name='j' type='fixed'/></robot>", 1, j(), missing);
    refused("<robot><link name='a'/><joint name='j'/></robot>", 1, j(), missing);
}

#[test]
fn broken_trees() {
    let fixed = |name, parent, child| joint(name, "fixed", parent, child, "");
    let c = Subject::Link("c".to_owned());
    let (ab, bc) = (fixed("ab", "a", "b"), fixed("bc", "b", "c"));
    let links = [link("a"), link("b"), link("c")].concat();
    refused(&robot(&[links.clone(), ab.clone()]), 4, c.clone(), |rule| {
        *rule == Rule::TwoRoots { other: "a".to_owned() }
    });
    refused(
        &robot(&[links.clone(), ab.clone(), bc.clone(), fixed("ac", "a", "c")]),
        4,
        c.clone(),
        |rule| matches!(rule, Rule::TwoParents { first, second } if first == "bc" && second == "ac"),
    );
    let cycle = |rule: &Rule| matches!(rule, Rule::Cycle);
    let a = Subject::Link("a".to_owned());
    refused(&robot(&[links.clone(), ab.clone(), bc.clone(), fixed("ca", "c", "a")]), 2, a.clone(), cycle);
    refused(&robot(&[links.clone(), bc.clone(), fixed("cb", "c", "b")]), 3, b(), cycle);
    refused(&robot(&[link("a"), link("b"), fixed("j", "b", "b")]), 3, b(), cycle);
    let unknown = |rule: &Rule| matches!(rule, Rule::Unknown { kind: "link", name } if name == "x");
    refused(&robot(&[links.clone(), ab.clone(), fixed("j", "b", "x")]), 6, j(), unknown);
    refused(&robot(&[links.clone(), ab, fixed("j", "x", "c")]), 6, j(), unknown);
    let duplicate = |rule: &Rule| matches!(rule, Rule::DuplicateName);
    refused(&robot(&[link("a"), link("a")]), 3, a, duplicate);
    refused(&robot(&[links.clone(), fixed("j", "a", "b"), fixed("j", "b", "c")]), 6, j(), duplicate);
    // The coordinate of a planar joint and another joint of that name.
    let planar = joint("p", "planar", "a", "b", "<axis xyz='0 0 1'/>");
    let clash = joint("p_yaw", "continuous", "b", "c", "");
    refused(&robot(&[links, planar, clash]), 6, Subject::Joint("p_yaw".to_owned()), duplicate);
}

#[test]
fn broken_mimics() {
    let mimic = |name: &str, parent: &str, child: &str, of: &str| {
        joint(name, "continuous", parent, child, &format!("<mimic joint='{of}'/>"))
    };
    let links = [link("a"), link("b"), link("c")].concat();
    refused(&robot(&[links.clone(), mimic("j", "a", "b", "k"), mimic("k", "b", "c", "j")]), 5, j(), |rule| {
        matches!(rule, Rule::MimicCycle { .. })
    });
    refused(&robot(&[link("a"), link("b"), mimic("j", "a", "b", "j")]), 4, j(), |rule| {
        matches!(rule, Rule::MimicCycle { .. })
    });
    let fixed = joint("f", "fixed", "b", "c", "");
    refused(&robot(&[links, mimic("j", "a", "b", "f"), fixed]), 5, j(), |rule| {
        matches!(rule, Rule::UnsupportedJoint { .. })
    });
    refused(&with_joint("continuous", "<mimic multiplier='1'/>"), 4, j(), |rule| {
        matches!(rule, Rule::Missing { .. })
    });
}

#[test]
fn broken_companions() {
    let urdf = with_joint("revolute", LIMIT);
    let entry = |name: &str| Subject::Entry(name.to_owned());
    let contact = |name: &str, x: f64, y: f64| {
        format!("[[contact]]\nname = \"{name}\"\nlink = \"b\"\nposition_m = [{x:?}, {y:?}, 0.0]\n")
    };
    let triangle = contact("p", 0.0, 0.0) + &contact("q", 1.0, 0.0) + &contact("r", 0.0, 1.0);
    let sole = |corners: &str| {
        format!("format = 1\n{triangle}[[sole]]\nname = \"s\"\nframe = \"b\"\ncorners = {corners}\n")
    };
    let loaded = |text: &str| load_str("dir/broken.urdf", &urdf, Some(text), &LoadOptions::default());
    loaded(&sole("[\"p\", \"q\", \"r\"]")).unwrap();

    let toml = |rule: &Rule| matches!(rule, Rule::Toml(_));
    let unknown = |rule: &Rule| matches!(rule, Rule::Unknown { .. });
    let number = |rule: &Rule| matches!(rule, Rule::BadNumber { .. });
    let duplicate = |rule: &Rule| matches!(rule, Rule::DuplicateName);
    let polygon = |rule: &Rule| matches!(rule, Rule::SolePolygon);
    type Case<'a> = (String, u32, Subject, &'a dyn Fn(&Rule) -> bool);
    let cases: Vec<Case<'_>> = vec![
        ("format = ".to_owned(), 1, Subject::File, &toml),
        ("\nformat = 2".to_owned(), 2, entry("format"), &toml),
        ("format = 1\ncolour = 3".to_owned(), 2, Subject::File, &toml),
        (format!("format = 1\n{}radius = 2.0\n", contact("p", 0.0, 0.0)), 6, Subject::File, &toml),
        (
            format!("format = 1\n{}radius_m = -2.0\n", contact("p", 0.0, 0.0)),
            2,
            entry("contact `p`"),
            &number,
        ),
        (
            format!("format = 1\n{}", contact("p", f64::NAN, 0.0).replace("NaN", "nan")),
            2,
            entry("contact `p`"),
            &number,
        ),
        (format!("format = 1\n{triangle}{}", contact("q", 0.0, 0.0)), 14, entry("contact `q`"), &duplicate),
        (
            format!("format = 1\n{}", contact("p", 0.0, 0.0).replace("\"b\"", "\"x\"")),
            2,
            entry("contact `p`"),
            &unknown,
        ),
        ("format = 1\npassive = [\"j\",\n\"x\"]".to_owned(), 3, entry("passive"), &unknown),
        (
            "format = 1\n[[spring]]\njoint = \"x\"\nstiffness_nm_per_rad = 1".to_owned(),
            2,
            entry("spring on `x`"),
            &unknown,
        ),
        (
            "format = 1\n[[spring]]\njoint = \"j\"\nstiffness_nm_per_rad = -1".to_owned(),
            2,
            entry("spring on `j`"),
            &number,
        ),
        (
            "format = 1\n[[frame]]\nname = \"b\"\nlink = \"b\"\nposition_m = [0,0,0]".to_owned(),
            2,
            entry("frame `b`"),
            &duplicate,
        ),
        (sole("[\"p\", \"q\", \"x\"]"), 14, entry("sole `s`"), &unknown),
        (sole("[\"p\", \"r\", \"q\"]"), 14, entry("sole `s`"), &polygon),
        (sole("[\"p\", \"q\"]"), 14, entry("sole `s`"), &polygon),
        (
            "format = 1\n[[posture]]\nname = \"p\"\n[posture.joints]\nx = 1.0".to_owned(),
            2,
            entry("posture `p`"),
            &unknown,
        ),
        (
            "format = 1\n[[posture]]\nname = \"p\"\n[posture.joints]\nj = inf".to_owned(),
            2,
            entry("posture `p`"),
            &number,
        ),
    ];
    for (text, line, subject, rule) in cases {
        let error = loaded(&text).expect_err(&text);
        assert!(rule(error.rule()), "{error}");
        assert_eq!((error.line(), error.subject()), (Some(line), &subject), "{error}\n{text}");
        assert_eq!(error.file().to_str(), Some("dir/broken.toml"));
    }
    let error = loaded("format = 1\ncolour = 3").unwrap_err().to_string();
    assert!(error.contains("colour"), "{error}");
    let beyond = loaded("format = 1\n[[posture]]\nname = \"p\"\njoints.j = 2").unwrap();
    assert!(beyond.warnings[0].contains("outside its limits"), "{:?}", beyond.warnings);
}

#[test]
fn files_that_cannot_be_read() {
    for path in ["/nonexistent/robot.urdf", "/dev/zero", "/"] {
        let error = load_with(path, &LoadOptions::default()).unwrap_err();
        assert!(matches!(error.rule(), Rule::Unreadable(_)), "{error}");
        assert!(error.to_string().starts_with(path));
    }
}

#[test]
fn messages_stay_short() {
    let name = "x".repeat(100_000);
    let unknown = robot(&[link("a"), link("b"), joint("j", "fixed", "a", &name, "")]);
    assert!(load(&unknown).unwrap_err().to_string().len() < 500);
    let error = load(&with_joint("continuous", &format!("<origin xyz='{name}'/>"))).unwrap_err();
    assert!(error.to_string().len() < 500);
    let error = load(&robot(&[link(&name), link(&name)])).unwrap_err();
    assert!(error.to_string().len() < 500);
}
