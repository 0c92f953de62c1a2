//! Scenario files as people write them, right and wrong.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::result_large_err)]

use delmpc_scenario::{Clock, ControllerKind, Document, Place, Scenario, ScenarioError};

const SMALL: &str = "\
seed = 7
clock = \"lockstep\"
duration_s = 2

[robot]
urdf = \"atlas.urdf\"
";

fn small() -> Document {
    Document::parse("small.toml", SMALL).unwrap()
}

/// The message a text is refused with.
fn refused(text: &str) -> String {
    let document = Document::parse("wrong.toml", text);
    document.and_then(|document| document.scenario()).unwrap_err().to_string()
}

/// The message the small file is refused with after an override.
fn refused_with(change: &str) -> String {
    let mut document = small();
    document.set(change).and_then(|()| document.scenario()).unwrap_err().to_string()
}

#[test]
fn a_few_keys_are_enough() {
    let scenario = small().scenario().unwrap();
    let expected = Scenario {
        seed: 7,
        clock: Clock::Lockstep,
        duration_s: 2.0,
        robot: delmpc_scenario::RobotSettings { urdf: "atlas.urdf".to_owned(), ..Default::default() },
        ..Scenario::default()
    };
    assert_eq!(scenario, expected);
    assert_eq!((scenario.steps(), scenario.steps_per_cycle()), (2000, 5));
}

#[test]
fn every_scenario_of_the_project_is_valid_and_survives_a_round_trip() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/scenarios");
    let mut count = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let scenario = Document::read(&path).unwrap().scenario().unwrap();
        assert_eq!(scenario.name, path.file_stem().unwrap().to_str().unwrap());
        let again = Document::parse("effective", &scenario.to_toml()).unwrap().scenario().unwrap();
        assert_eq!(again, scenario, "{}", path.display());
        assert_eq!(scenario.warnings(), Vec::<String>::new(), "{}", path.display());
        count += 1;
    }
    assert!(count > 0);
}

#[test]
fn an_effective_configuration_is_complete_and_reads_back() {
    let mut document = small();
    for change in
        ["push.link=utorso", "push.impulse_ns=15", "reach.hand=l_hand_point", "process.plant_core=0"]
    {
        document.set(change).unwrap();
    }
    let scenario = document.scenario().unwrap();
    let text = scenario.to_toml();
    assert_eq!(Document::parse("effective", &text).unwrap().scenario().unwrap(), scenario);
    for key in ["mass_scale = 1.0", "[push]", "direction = [0.0, 1.0, 0.0]", "no_fall = true"] {
        assert!(text.contains(key), "{key} in\n{text}");
    }
    assert_eq!(Scenario { seed: 8, ..scenario }.to_toml(), text.replace("seed = 7", "seed = 8"));
}

#[test]
fn an_unknown_key_is_refused_with_its_line() {
    let message = refused("seed = 1\n\n[plant]\nfriction = 0.5\nfrictoin = 0.6\n");
    assert_eq!(message, "wrong.toml: line 5: unknown key `plant.frictoin`: did you mean `plant.friction`?");
    let message = refused("[sensors]\ncolour = 1\n");
    let keys = "sensors.accelerometer_bias_m_s2, sensors.accelerometer_bias_walk_m_s2";
    assert!(
        message.starts_with(&format!(
            "wrong.toml: line 2: unknown key `sensors.colour`: the keys here are {keys}"
        )),
        "{message}"
    );
    assert!(refused("duration = 3\n").contains("line 1: unknown key `duration`: did you mean `duration_s`?"));
    assert!(refused("[plnat]\n").contains("line 1: unknown key `plnat`: did you mean `plant`?"));
    assert!(
        refused("[[push]]\nlink = \"a\"\n[[push]]\nimpulse = 1\n")
            .contains("line 4: unknown key `push[1].impulse`")
    );
    assert!(
        refused("plant = { step_s = 0.001,\n  frction = 1 }\n")
            .contains("line 2: unknown key `plant.frction`")
    );
}

#[test]
fn broken_toml_is_refused_with_its_line() {
    let message = refused("seed = 1\nclock = \n");
    assert!(message.starts_with("wrong.toml: line 2: not valid TOML"), "{message}");
    let message = refused("seed = 1\nseed = 2\n");
    assert!(message.starts_with("wrong.toml: line 2: not valid TOML"), "{message}");
}

#[test]
fn values_have_the_type_of_their_key() {
    let cases = [
        ("seed = \"one\"", "line 1: `seed` is the text \"one\", must be a whole number"),
        ("seed = -1", "line 1: `seed` is the whole number -1, must be a whole number from 0 on"),
        ("seed = 1.5", "line 1: `seed` is the number 1.5, must be a whole number"),
        (
            "clock = \"sundial\"",
            "line 1: `clock` is the text \"sundial\", must be \"realtime\" or \"lockstep\"",
        ),
        ("[reach]\nball_m = [1, 2]", "line 2: `reach.ball_m` is a list of 2, must be a list of 3 numbers"),
        (
            "[reach]\nball_m = [1, 2, \"x\"]",
            "line 2: `reach.ball_m` is a list of 3, must be a list of 3 numbers",
        ),
        ("plant = 3", "line 1: `plant` is the whole number 3, must be a table of keys"),
        ("[success]\nno_fall = 1", "line 2: `success.no_fall` is the whole number 1, must be true or false"),
        ("push = [1]", "line 1: `push[0]` is the whole number 1, must be a table of keys"),
    ];
    for (text, expected) in cases {
        assert_eq!(refused(text), format!("wrong.toml: {expected}"));
    }
}

#[test]
fn values_out_of_range_are_refused_with_key_rule_and_remedy() {
    let message = refused(&format!("{SMALL}[plant]\nfriction = -0.1\n"));
    let expected = "line 8: `plant.friction` = -0.1: must lie in 0 .. 10; the nearest allowed value is 0";
    assert_eq!(message, format!("wrong.toml: {expected}"));
    assert!(
        refused("seed = 1").contains("not in the file: `robot.urdf` = \"\": is missing; name a URDF file")
    );

    for change in [
        "duration_s=0",
        "duration_s=nan",
        "duration_s=inf",
        "duration_s=1.0005",
        "robot.urdf=''",
        "plant.step_s=0.002",
        "plant.friction=nan",
        "plant.mass_scale=0",
        "sensors.noise_scale=-1",
        "sensors.delay_s=1",
        "controller.mpc_rate_hz=300",
        "controller.mpc_rate_hz=0",
        "controller.servo_rate_hz=100",
        "controller.servo_rate_hz=1100",
        "controller.horizon_s=-1",
        "controller.stages=1",
        "controller.delay_cycles=11",
        "process.priority=100",
        "process.hang_s=0",
        "reach.ball_m=[1,2,nan]",
        "push.impulse_ns=15",
        "success.settle_time_s=-1",
    ] {
        let message = refused_with(change);
        let key = change.split('=').next().unwrap();
        // A half-given reach or push is refused for what is missing first.
        let key = match key.split('.').next() {
            Some("reach") => "reach.hand",
            Some("push") => "push.link",
            _ => key,
        };
        assert!(message.contains(&format!("`{key}` = ")), "{change}: {message}");
        assert!(message.contains("; "), "{change}: no remedy in {message}");
    }
    assert!(refused_with("plant.step_s=1").contains("--set plant.step_s=1: `plant.step_s` = 1: must lie in"));
}

#[test]
fn a_push_needs_a_direction() {
    let mut document = small();
    document.set("push.link=utorso").unwrap();
    document.set("push.direction=[0, 0, 0]").unwrap();
    let message = document.scenario().unwrap_err().to_string();
    assert!(message.contains("--set push.direction=[0, 0, 0]: `push.direction`"), "{message}");
}

#[test]
fn overrides_are_typed_like_the_key() {
    let mut document = small();
    for change in [
        "seed=11",
        "clock=realtime",
        " duration_s = 3 ",
        "robot.urdf=\"other.urdf\"",
        "controller.kind=static-lqr",
        "plant.torque_limits=false",
        "push.link=utorso",
        "push.direction=[0,-1,0]",
        "seed=12",
    ] {
        document.set(change).unwrap();
    }
    let scenario = document.scenario().unwrap();
    assert_eq!((scenario.seed, scenario.clock, scenario.duration_s), (12, Clock::Realtime, 3.0));
    assert_eq!((scenario.robot.urdf.as_str(), scenario.plant.torque_limits), ("other.urdf", false));
    assert_eq!(scenario.controller.kind, ControllerKind::StaticLqr);
    assert_eq!((scenario.push[0].link.as_str(), scenario.push[0].direction), ("utorso", [0.0, -1.0, 0.0]));
}

#[test]
fn overrides_nobody_understands_are_refused() {
    let set = |change: &str| small().set(change).unwrap_err();
    assert!(matches!(set("seed"), ScenarioError::MalformedOverride { .. }));
    assert!(matches!(set("=3"), ScenarioError::MalformedOverride { .. }));
    assert!(matches!(set("seed="), ScenarioError::MalformedOverride { .. }));
    match set("plant.fricton=1") {
        ScenarioError::UnknownKey { place, nearest, .. } => {
            assert_eq!(place, Place::Override("plant.fricton=1".to_owned()));
            assert_eq!(nearest.as_deref(), Some("plant.friction"));
        }
        other => panic!("{other}"),
    }
    assert!(
        set("seed=abc").to_string().starts_with("small.toml: --set seed=abc: `seed` is the text \"abc\"")
    );
    assert!(set("plant.step_s.x=1").to_string().contains("`plant.step_s` is a table"));
    assert!(set("plant..step_s=1").to_string().contains("unknown key"));
    assert!(set("seed=1\nclock='lockstep'").to_string().contains("must be a whole number"));
}

#[test]
fn of_several_pushes_overrides_mean_the_first() {
    let list =
        "[[push]]\nlink = \"a\"\nimpulse_ns = 5\n[[push]]\nlink = \"b\"\nimpulse_ns = 6\nstart_s = 1\n";
    let mut document = Document::parse("two.toml", &format!("{SMALL}{list}")).unwrap();
    document.set("push.impulse_ns=9").unwrap();
    let scenario = document.scenario().unwrap();
    assert_eq!(scenario.push.iter().map(|push| push.impulse_ns).collect::<Vec<_>>(), [9.0, 6.0]);
    let again = Document::parse("effective", &scenario.to_toml()).unwrap().scenario().unwrap();
    assert_eq!(again, scenario);

    document.set("push.impulse_ns=-9").unwrap();
    let message = document.scenario().unwrap_err().to_string();
    assert!(message.contains("--set push.impulse_ns=-9: `push[0].impulse_ns` = -9"), "{message}");
}

#[test]
fn what_will_not_happen_is_a_warning() {
    let mut document = small();
    for change in ["push.link=a", "push.impulse_ns=1", "push.start_s=2", "reach.hand=h", "duration_s=2"] {
        document.set(change).unwrap();
    }
    assert_eq!(document.scenario().unwrap().warnings().len(), 2);
}

#[test]
fn files_that_are_none_are_refused() {
    let refused = |path: &str| Document::read(path).unwrap_err().to_string();
    assert!(refused("/nowhere/at/all.toml").contains("/nowhere/at/all.toml: cannot be read"));
    assert!(refused("/dev/zero").contains("not a regular file"));
    assert!(refused(env!("CARGO_MANIFEST_DIR")).contains("not a regular file"));
}

#[test]
fn faults_are_a_list_whose_words_and_targets_are_checked() {
    let list = |text: &str| format!("{SMALL}\n[[fault]]\n{text}\n[[fault]]\nkind = \"lost\"\ncount = 3\n");
    let two = list("kind = \"stop\"\ntarget = \"plant\"\nsize_s = 0.05");
    let scenario = Document::parse("faults.toml", &two).unwrap().scenario().unwrap();
    assert_eq!((scenario.fault.len(), scenario.fault[1].count), (2, 3));
    let again = Document::parse("effective", &scenario.to_toml()).unwrap().scenario().unwrap();
    assert_eq!(again, scenario);
    for (text, expected) in [
        ("kind = \"explode\"", "\"lost\" or"),
        ("knd = \"lost\"", "did you mean `fault[0].kind`"),
        ("kind = \"stop\"", "does not happen to it"),
        ("probability = 2.0", "fault[0].probability"),
    ] {
        let message = refused(&list(text));
        assert!(message.contains(expected), "{text}: {message}");
    }
    let mut document = small();
    document.set("fault.kind=not-a-number").unwrap();
    document.set("fault.target=state").unwrap();
    assert_eq!(document.scenario().unwrap().fault[0].kind.word(), "not-a-number");
    assert!(document.set("fault.kind=explode").is_err());
}

#[test]
fn thresholds_of_timing_have_ranges() {
    assert!(refused_with("timing.compute_budget=1.5").contains("timing.compute_budget"));
    assert!(refused_with("timing.event_s=0").contains("timing.event_s"));
    let mut document = small();
    document.set("timing.max_misses=0").unwrap();
    assert_eq!(document.scenario().unwrap().timing.max_misses, Some(0));
}

#[test]
fn one_of_a_list_is_named_in_overrides_as_in_messages() {
    let text = "robot.urdf = \"r.urdf\"\n[[push]]\nlink = \"a\"\n[[push]]\nlink = \"b\"\nstart_s = 2\n";
    let mut document = Document::parse("two.toml", text).unwrap();
    document.set("push[1].impulse_ns=7").unwrap();
    document.set("push[0].link=c").unwrap();
    let scenario = document.scenario().unwrap();
    let pushes: Vec<(&str, f64)> =
        scenario.push.iter().map(|push| (push.link.as_str(), push.impulse_ns)).collect();
    assert_eq!(pushes[1], ("b", 7.0));
    assert_eq!(pushes[0].0, "c");
    assert!(document.notes().is_empty());

    let refused = |text: &str| document.clone().set(text).unwrap_err().to_string();
    assert!(refused("push[2].impulse_ns=7").contains("there are 2 of `push`"));
    assert!(refused("push[1].impulse=7").contains("push[1].impulse_ns"), "{}", refused("push[1].impulse=7"));
    assert!(refused("push[1].impulse_ns=x").contains("push[1].impulse_ns"));
    assert!(refused("push[x].impulse_ns=7").contains("unknown key"));
    assert!(refused("fault[0].count=7").contains("there are 0 of `fault`"));
    // The same name in the message about its value.
    document.set("push[1].impulse_ns=1e6").unwrap();
    let error = document.scenario().unwrap_err().to_string();
    assert!(
        error.contains("--set push[1].impulse_ns=1e6") && error.contains("`push[1].impulse_ns`"),
        "{error}"
    );
    // Without an index it is the first one, and that is said.
    document.set("push[1].impulse_ns=1").unwrap();
    document.set("push.impulse_ns=3").unwrap();
    assert_eq!(document.scenario().unwrap().push[0].impulse_ns, 3.0);
    assert!(
        document.notes()[0].contains("push[0].impulse_ns .. push[1].impulse_ns"),
        "{:?}",
        document.notes()
    );

    let mut single = Document::parse("one.toml", "robot.urdf = \"r.urdf\"\n[push]\nlink = \"a\"\n").unwrap();
    single.set("push[0].impulse_ns=5").unwrap();
    single.set("push.start_s=1").unwrap();
    assert_eq!(single.scenario().unwrap().push[0].impulse_ns, 5.0);
    assert!(single.notes().is_empty());
}

#[test]
fn a_name_that_leads_elsewhere_is_refused() {
    for name in ["../../evil", "a/b", "/tmp/x", "..", ".hidden", "a\\\\b", "a\\u001bb", &"x".repeat(101)] {
        let text = format!("name = \"{name}\"\nrobot.urdf = \"r.urdf\"\n");
        let error = Document::parse("a.toml", &text).unwrap().scenario().unwrap_err().to_string();
        assert!(error.contains("`name`"), "{error}");
    }
    let text = "name = \"Füße 2-b_c.d\"\nrobot.urdf = \"r.urdf\"\n";
    Document::parse("a.toml", text).unwrap().scenario().unwrap();
}
