//! `delmpc wire`: the messages as a page for people, as JSON for programs in other languages, and the description of a run.
//!
//! Layouts come from the types ([`layout`]); the prose around the tables is in `src/wire/page.md`.

pub mod c_header;
pub mod layout;
#[cfg(test)]
mod servo_vectors;

use std::fmt::Write as _;
use std::path::PathBuf;

use delmpc_controller_core::cycle::reason;
use delmpc_controller_process::presence::PERIOD_NS;
use delmpc_messages::{
    ClockKind, Command, ConstraintKind, FallbackLevel, Heartbeat, LARGEST_COORDINATE, LARGEST_EFFORT,
    LATEST_TIME_NS, LONGEST_VALIDITY_NS, MAX_FEET, MAX_JOINTS, MAX_RATE_SAMPLES, MAX_SEGMENTS, Message,
    MessageError, PlantState, ProcessState, Role, Verdict, foot, sensor, status,
};
use delmpc_servo::servo::{LARGEST_JUMP, LONGEST_LEAD_NS};
use delmpc_transport::{Channel, RunId};
use serde_json::{Map, Value, json};

use crate::connection::{Connection, service_settings};
use crate::output::print;
use crate::part::run_id_of;
use crate::setup::Setup;
use crate::verdict::{Ended, Failure};
use c_header::c_header;
use layout::{Layout, comment_above, layouts};

/// Arguments of `delmpc wire`.
#[derive(Debug, clap::Args)]
pub struct WireArguments {
    /// Every payload with field, offset, size, type, unit and frame, as JSON instead of the page
    #[arg(long)]
    pub json: bool,
    /// A header for C and C++ instead of the page
    #[arg(long, conflicts_with = "json")]
    pub c: bool,
    /// The description of a run of this scenario instead: connection.json, as `delmpc run --plant` gives it to the plant
    #[arg(long, value_name = "SCENARIO", conflicts_with_all = ["json", "c"])]
    pub connection: Option<PathBuf>,
    /// Override a key of that scenario
    #[arg(long, value_name = "KEY=VALUE", requires = "connection")]
    pub set: Vec<String>,
    /// The run that is described: 16 hexadecimal digits, or a name [default: made from the scenario]
    #[arg(long, value_name = "ID", requires = "connection")]
    pub run_id: Option<String>,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a scenario that cannot be run, [`Failure::Fault`] when nothing can be written.
pub fn wire(arguments: &WireArguments) -> Result<Ended, Failure> {
    if let Some(file) = &arguments.connection {
        let setup = Setup::read(file, &arguments.set)?;
        let run = run_id_of(arguments.run_id.as_deref(), &setup)?;
        let connection = Connection::new(&setup, run, file)?;
        print(&pretty(connection.description()))?;
    } else {
        print(&match (arguments.json, arguments.c) {
            (true, _) => description_text(),
            (_, true) => c_header(),
            _ => page(),
        })?;
    }
    Ok(Ended::Well)
}

fn pretty(value: &Value) -> String {
    serde_json::to_string_pretty(value).unwrap_or_default() + "\n"
}

/// The description as the committed files hold it.
pub fn description_text() -> String {
    pretty(&description())
}

/// Name, code, what it means.
type Code = (String, u32, String);

/// Sets of codes and bits by the field they are in.
fn codes() -> Vec<(&'static str, Vec<Code>)> {
    let command = include_str!("../shared/messages/src/command.rs");
    let report = include_str!("../shared/messages/src/cycle_report.rs");
    let heartbeat = include_str!("../shared/messages/src/heartbeat.rs");
    let state = include_str!("../shared/messages/src/plant_state.rs");
    let of = |source: &str, names: Vec<(String, u32)>| {
        let told = names.into_iter().map(|(name, code)| {
            let meaning = comment_above(source, &format!("{name} ="));
            (name, code, meaning)
        });
        told.collect::<Vec<Code>>()
    };
    macro_rules! all {
        ($source:expr, $type:ty) => {
            of(
                $source,
                (0..64).filter_map(|code| Some((format!("{:?}", <$type>::from_code(code)?), code))).collect(),
            )
        };
    }
    macro_rules! bits {
        ($module:ident, [$($name:ident),+]) => {
            vec![$((stringify!($name).to_owned(), $module::$name,
                comment_above(state, concat!("pub const ", stringify!($name), ":")))),+]
        };
    }
    vec![
        ("clock", all!(state, ClockKind)),
        ("sensors (bits)", bits!(sensor, [INERTIAL_UNIT, INERTIAL_SUMS, MOTION_CAPTURE])),
        ("feet.flags (bits)", bits!(foot, [WRENCH, TOUCHES])),
        ("status_flags (bits)", bits!(status, [FELL, FINISHED, WATCHDOG, SATURATED, DISTURBED])),
        ("watchdog_level, fallback_level", all!(command, FallbackLevel)),
        ("verdict", all!(command, Verdict)),
        ("reason", reasons()),
        ("report.worst_constraint", all!(report, ConstraintKind)),
        ("role", all!(heartbeat, Role)),
        ("state", all!(heartbeat, ProcessState)),
    ]
}

/// Reasons of refusals: those of a message, those of the controller.
fn reasons() -> Vec<Code> {
    let (errors, own_reasons) = (
        include_str!("../shared/messages/src/error.rs"),
        include_str!("../controller/core/src/cycle/reason.rs"),
    );
    let codes = MessageError::CODES
        .iter()
        .map(|(name, code)| ((*name).to_owned(), *code, comment_above(errors, &format!("{name} {{"))));
    macro_rules! own {
        ($($name:ident),+) => {
            [$((stringify!($name).to_owned(), reason::$name, comment_above(own_reasons, concat!("pub const ", stringify!($name), ":")))),+]
        };
    }
    let own = own!(STALE, OUT_OF_ORDER, ESTIMATOR, AHEAD, PREDICTION, STAGE, RICCATI, QP, FAR);
    codes.chain(own).collect()
}

/// Everything a program needs.
pub fn description() -> Value {
    let messages = [message::<PlantState>(), message::<Command>(), message::<Heartbeat>()];
    let mut all = Map::new();
    for (field, set) in codes() {
        let set: Map<String, Value> = set.into_iter().map(|(name, code, _)| (name, code.into())).collect();
        all.insert(field.split(" (").next().unwrap_or(field).to_owned(), Value::Object(set));
    }
    json!({
        "format": "delmpc/wire/v1",
        "byte_order": "little",
        "capacity": {
            "joints": MAX_JOINTS, "feet": MAX_FEET, "segments": MAX_SEGMENTS, "rate_samples": MAX_RATE_SAMPLES,
        },
        "limits": {
            "largest_coordinate": LARGEST_COORDINATE,
            "largest_effort": LARGEST_EFFORT,
            "latest_time_ns": LATEST_TIME_NS,
            "longest_validity_ns": LONGEST_VALIDITY_NS,
            "largest_sequence_jump": LARGEST_JUMP,
            "longest_lead_ns": LONGEST_LEAD_NS,
            "quaternion_tolerance": delmpc_messages::UNIT_TOLERANCE,
        },
        "heartbeat_period_ns": PERIOD_NS,
        "messages": messages,
        "types": layouts(),
        "codes": all,
        "services": CHANNELS.map(|(channel, payload)| {
            let mut settings = service_settings(channel);
            if let Some(settings) = settings.as_object_mut() {
                settings.insert("payload".to_owned(), payload.into());
                settings.insert("joint_set_attribute".to_owned(), channel.needs_same_joint_set().into());
            }
            settings
        }),
    })
}

const CHANNELS: [(Channel, &str); 6] = [
    (Channel::State, PlantState::NAME),
    (Channel::Command, Command::NAME),
    (Channel::Truth, PlantState::NAME),
    (Channel::Heartbeat(Role::Plant), Heartbeat::NAME),
    (Channel::Heartbeat(Role::Controller), Heartbeat::NAME),
    (Channel::Heartbeat(Role::Supervisor), Heartbeat::NAME),
];

fn message<M: Message>() -> Value {
    let name = M::NAME.split('/').nth(1).unwrap_or_default();
    json!({
        "name": name, "payload": M::NAME, "magic": M::MAGIC, "version": M::VERSION, "size": size_of::<M>(), "alignment": align_of::<M>(),
    })
}

/// The page: `src/wire/page.md` with its tables.
pub fn page() -> String {
    let mut page = include_str!("wire/page.md").to_owned();
    for (mark, text) in [
        ("{{messages}}", messages_table()),
        ("{{services}}", services_table()),
        ("{{layouts}}", layouts().iter().map(layout_table).collect()),
        ("{{codes}}", codes_tables()),
        ("{{limits}}", limits_table()),
        ("{{example_run}}", RunId(EXAMPLE_RUN).to_string()),
    ] {
        page = page.replace(mark, text.trim_end());
    }
    page
}

const EXAMPLE_RUN: u64 = 0x00c0_ffee_0000_0001;

fn messages_table() -> String {
    let mut text = "| payload | magic | version | bytes |\n|---|---|---|---|\n".to_owned();
    let row = |name: &str, magic: u32, version: u32, size: usize| {
        let letters: String = magic.to_le_bytes().map(char::from).iter().collect();
        format!("| `{name}` | `{magic:#010x}` (`{letters}`) | {version} | {size} |\n")
    };
    text += &row(PlantState::NAME, PlantState::MAGIC, PlantState::VERSION, size_of::<PlantState>());
    text += &row(Command::NAME, Command::MAGIC, Command::VERSION, size_of::<Command>());
    text += &row(Heartbeat::NAME, Heartbeat::MAGIC, Heartbeat::VERSION, size_of::<Heartbeat>());
    text
}

fn services_table() -> String {
    let mut text =
        "| service `delmpc/RUN/...` | payload | buffer | subscribers | attribute |\n|---|---|---|---|---|\n"
            .to_owned();
    for (channel, payload) in CHANNELS {
        let attribute = if channel.needs_same_joint_set() { "`joint_set_hash`" } else { "" };
        let (name, buffer, places) = (channel.name(), channel.buffer_size(), channel.max_subscribers());
        let _ = writeln!(text, "| `{name}` | `{payload}` | {buffer} | {places} | {attribute} |");
    }
    text
}

fn layout_table(layout: &Layout) -> String {
    let mut text = format!(
        "### {}, {} bytes\n\n| offset | size | type | field | unit | frame | meaning |\n|---|---|---|---|---|---|---|\n",
        layout.name, layout.size
    );
    for field in &layout.fields {
        let shape: String = field.shape.iter().map(|length| format!("[{length}]")).collect();
        let meaning = field.meaning.replace('|', "\\|");
        let _ = writeln!(
            text,
            "| {} | {} | {}{shape} | `{}` | {} | {} | {meaning} |",
            field.offset, field.size, field.kind, field.name, field.unit, field.frame
        );
    }
    text + "\n"
}

fn codes_tables() -> String {
    let mut text = String::new();
    for (field, set) in codes() {
        let _ = write!(text, "### {field}\n\n| code | name | meaning |\n|---|---|---|\n");
        for (name, code, meaning) in set {
            let _ = writeln!(text, "| {code} | {name} | {} |", meaning.replace('|', "\\|"));
        }
        text.push('\n');
    }
    text
}

fn limits_table() -> String {
    let mut text = "| limit | value |\n|---|---|\n".to_owned();
    let limits = description()["limits"].as_object().cloned().unwrap_or_default();
    for (name, value) in limits {
        let _ = writeln!(text, "| `{name}` | {value} |");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is committed is what is generated.
    #[test]
    fn the_files_are_those_of_this_program() {
        for (file, text, command) in [
            ("shared/messages/WIRE.md", page(), "delmpc wire"),
            ("shared/messages/wire.json", description_text(), "delmpc wire --json"),
            ("python/delmpc/wire.json", description_text(), "delmpc wire --json"),
            ("shared/messages/delmpc.h", c_header(), "delmpc wire --c"),
        ] {
            let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
            let found = std::fs::read_to_string(&path).unwrap_or_default();
            assert_eq!(found, text, "write it again: {command} > {file}");
        }
    }

    #[test]
    fn every_mark_of_the_page_is_replaced_and_every_code_has_a_meaning() {
        assert!(!page().contains("{{"));
        for (field, set) in codes() {
            assert!(!set.is_empty(), "{field}");
            for (name, code, meaning) in set {
                assert!(!meaning.is_empty(), "{field}: {name} = {code}");
            }
        }
    }
}
