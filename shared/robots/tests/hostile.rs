//! Hostile files end in an error (or a model) within a second and 64 MB, whatever they hold.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use delmpc_robots::limits::{MAX_COMPANION_BYTES, MAX_DEPTH, MAX_ELEMENTS, MAX_URDF_BYTES};
use delmpc_robots::{LoadOptions, RobotModel, Rule, load_str};

const INERTIAL: &str =
    "<inertial><mass value='1'/><inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/></inertial>";

fn load(urdf: &str, companion: Option<&str>) -> Result<RobotModel, String> {
    let started = Instant::now();
    let result = load_str("hostile.urdf", urdf, companion, &LoadOptions::default());
    let elapsed = started.elapsed();
    assert!(elapsed < Duration::from_secs(1), "{elapsed:?} for {}", &urdf[..urdf.len().min(80)]);
    result.map_err(|error| {
        let text = error.to_string();
        assert!(text.len() < 1000, "{text}");
        text
    })
}

fn chain(links: usize, kind: &str, content: &str) -> String {
    let mut text = "<robot name='r'><link name='l0'/>".to_owned();
    for i in 1..links {
        let parent = i - 1;
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            "<link name='l{i}'>{content}</link><joint name='j{i}' type='{kind}'><parent link='l{parent}'/><child link='l{i}'/></joint>"
        );
    }
    text + "</robot>"
}

/// What it is, and how to make it.
type Case = (&'static str, fn() -> String);

/// Texts are made one by one: only the loader's memory is to be seen.
const HOSTILE: &[Case] = &[
    ("deep nesting", || "<a>".repeat(MAX_URDF_BYTES / 4)),
    ("deep nesting inside links", || in_robot(&"<link name='a'>".repeat(MAX_DEPTH + 2))),
    ("too large", || " ".repeat(MAX_URDF_BYTES + 1)),
    ("many elements", || in_robot(&"<a/>".repeat(MAX_URDF_BYTES / 5))),
    ("many links", || in_robot(&"<link name='a'/>".repeat(MAX_ELEMENTS - 2))),
    ("many attributes", || format!("<robot {}/>", "a='' ".repeat(MAX_URDF_BYTES / 6))),
    ("most attributes", || {
        let mut tag = String::from("<a ");
        (0..60).for_each(|i| tag += &format!("b{i}='' "));
        in_robot(&(tag + "/>").repeat(3_500))
    }),
    ("many namespaces", || {
        let mut tag = String::from("<robot ");
        (0..MAX_URDF_BYTES / 16).for_each(|i| tag += &format!("xmlns:a{i}='u' "));
        tag + "/>"
    }),
    ("one endless name", || format!("<robot name='{}'/>", "x".repeat(MAX_URDF_BYTES - 100))),
    ("one endless text", || in_robot(&"x".repeat(MAX_URDF_BYTES - 100))),
    ("many lines", || in_robot(&"\n".repeat(MAX_URDF_BYTES - 100))),
    ("one endless comment", || format!("<!--{}", "-".repeat(MAX_URDF_BYTES - 100))),
    ("many comments", || in_robot(&"<!---->".repeat(MAX_URDF_BYTES / 8))),
    ("many instructions", || in_robot(&"<?a b?>".repeat(MAX_URDF_BYTES / 8))),
    ("open brackets", || "<".repeat(MAX_URDF_BYTES)),
    ("quotes", || format!("<a b='{}", "\"".repeat(MAX_URDF_BYTES - 100))),
    ("character references", || in_robot(&"&#65;".repeat(MAX_URDF_BYTES / 6))),
    ("entity bomb", || {
        let bomb = "<!DOCTYPE l [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'>]>";
        bomb.to_owned() + "<robot>&b;</robot>"
    }),
    ("external entity", || {
        "<!DOCTYPE l [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><robot name='&a;'/>".to_owned()
    }),
    ("long chain without mass", || chain(4_900, "continuous", "")),
    ("long chain of bodies", || chain(1_900, "continuous", INERTIAL)),
    ("long chain of fixed links without mass", || chain(3_900, "fixed", "")),
    ("long ring", || {
        let closing = "<joint name='x' type='fixed'><parent link='l3899'/><child link='l0'/></joint></robot>";
        chain(3_900, "fixed", "").replace("</robot>", closing)
    }),
    ("random bytes", || {
        let mut state = 1u64;
        let text = (0..MAX_URDF_BYTES - 100).map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            char::from(b" <>/='\"&;!?-[]abc0"[(state >> 33) as usize % 18])
        });
        in_robot(&text.collect::<String>())
    }),
];

fn in_robot(text: &str) -> String {
    format!("<robot name='r'>{text}</robot>")
}

/// Peak resident memory of this process, bytes, where the system tells.
fn peak_memory() -> Option<usize> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<usize>().ok().map(|kilobytes| kilobytes * 1024)
}

// One test: memory is that of the whole process.
#[test]
fn time_and_memory_are_bounded() {
    for (what, make) in HOSTILE {
        assert!(load(&make(), None).is_err(), "{what}");
    }
    // The largest robot that is accepted.
    let robot = load(&chain(1_000, "continuous", INERTIAL), None);
    assert_eq!(robot.map(|robot| robot.tree.dof()), Ok(999));

    let arm = chain(3, "continuous", INERTIAL);
    let arm = |companion: &str| load(&arm, Some(companion));
    assert!(arm("format = 1").is_ok());
    for companion in [
        "[".repeat(MAX_COMPANION_BYTES),
        format!("a = {}", "[".repeat(MAX_COMPANION_BYTES - 10)),
        format!("a = {}", "{a=".repeat(MAX_COMPANION_BYTES / 4)),
        " ".repeat(MAX_COMPANION_BYTES + 1),
        format!("format = 1\npassive = [{}\"x\"]", "\"j1\", ".repeat(MAX_COMPANION_BYTES / 8)),
        format!("format = 1\n{}", "[[contact]]\n".repeat(MAX_COMPANION_BYTES / 16)),
        format!("format = 1\n{}", "a.".repeat(MAX_COMPANION_BYTES / 4)),
    ] {
        assert!(arm(&companion).is_err());
    }
    let mut contacts = String::from("format = 1\n");
    for i in 0.. {
        let _ = write!(contacts, "[[contact]]\nname='c{i}'\nlink='l1'\nposition_m=[0,0,0]\n");
        if contacts.len() > MAX_COMPANION_BYTES - 100 {
            break;
        }
    }
    assert!(arm(&contacts).is_ok());

    if let Some(peak) = peak_memory() {
        println!("peak memory {} MB", peak >> 20);
        assert!(peak < 64 << 20, "{} MB", peak >> 20);
    }
}

#[test]
fn caps_are_named() {
    let deep = load_str("h.urdf", &"<a>".repeat(MAX_DEPTH + 1), None, &LoadOptions::default()).unwrap_err();
    assert!(matches!(deep.rule(), Rule::TooMany { limit: MAX_DEPTH, .. }), "{deep}");
    let large = " ".repeat(MAX_URDF_BYTES + 1);
    let large = load_str("h.urdf", &large, None, &LoadOptions::default()).unwrap_err();
    assert!(matches!(large.rule(), Rule::TooLarge { limit: MAX_URDF_BYTES }), "{large}");
}
