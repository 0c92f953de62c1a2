//! `delmpc keys`: every key of scenarios and companion tables, from the types that read them: a page, or a JSON schema with which an editor
//! completes and checks.

use std::fmt::Write as _;

use delmpc_scenario::Scenario;
use schemars::Schema;
use serde_json::Value;

use crate::output::print;
use crate::verdict::{Ended, Failure};

/// Arguments of `delmpc keys`.
#[derive(Debug, clap::Args)]
pub struct KeysArguments {
    /// Only keys that begin like this, for example controller.legged
    pub prefix: Option<String>,
    /// Those of a robot's companion table instead of a scenario's
    #[arg(long)]
    pub companion: bool,
    /// The JSON schema instead of the page
    #[arg(long, conflicts_with = "prefix")]
    pub schema: bool,
}

/// A key.
#[derive(Debug, Clone, PartialEq)]
pub struct Key {
    /// Its full name; of a list of tables `list[].name`.
    pub name: String,
    /// What it takes, in words.
    pub takes: String,
    /// What it is without being given, as TOML; empty: nothing.
    pub default: String,
    /// What it means.
    pub meaning: String,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Fault`] when it cannot be written.
pub fn keys(arguments: &KeysArguments) -> Result<Ended, Failure> {
    let of = if arguments.companion { Format::Companion } else { Format::Scenario };
    if arguments.schema {
        print(&of.schema_text())?;
        return Ok(Ended::Well);
    }
    let prefix = arguments.prefix.as_deref().unwrap_or_default();
    let found: Vec<Key> = of.keys().into_iter().filter(|key| key.name.starts_with(prefix)).collect();
    if found.is_empty() {
        return Err(Failure::Input(format!("no key begins with `{prefix}`: delmpc keys lists all of them")));
    }
    print(&of.page(&found))?;
    Ok(Ended::Well)
}

/// A file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Scenario files.
    Scenario,
    /// Companion tables of robots.
    Companion,
}

impl Format {
    fn schema(self) -> Schema {
        match self {
            Self::Scenario => schemars::schema_for!(Scenario),
            Self::Companion => delmpc_robots::companion_schema(),
        }
    }

    /// Its JSON schema.
    pub fn schema_text(self) -> String {
        serde_json::to_string_pretty(self.schema().as_value()).unwrap_or_default() + "\n"
    }

    /// All its keys, section by section.
    pub fn keys(self) -> Vec<Key> {
        let schema = self.schema();
        let mut keys = Vec::new();
        collect(schema.as_value(), schema.as_value(), "", &mut keys);
        keys
    }

    /// The page: a table for every section.
    pub fn page(self, keys: &[Key]) -> String {
        let (title, command) = match self {
            Self::Scenario => ("a scenario", "delmpc keys"),
            Self::Companion => ("a companion table", "delmpc keys --companion"),
        };
        let text = format!(
            "# Keys of {title}\n\nWritten by `{command}` from the types that read them. `name[].key` is a key of a list of tables, `[[name]]`, \
             or of one table, `[name]`.\n"
        );
        tables(text, keys)
    }
}

/// A table for every section.
fn tables(mut text: String, keys: &[Key]) -> String {
    let mut section = None;
    for key in keys {
        let of = key.name.rsplit_once('.').map_or("", |(section, _)| section);
        if section != Some(of) {
            let title = if of.is_empty() { "At the top" } else { of };
            let _ = write!(text, "\n## {title}\n\n| key | takes | default | meaning |\n|---|---|---|---|\n");
            section = Some(of);
        }
        let code = |text: &str| if text.is_empty() { String::new() } else { format!("`{text}`") };
        let cell = |text: &str| text.replace('|', "\\|").replace('\n', " ");
        let name = code(key.name.rsplit('.').next().unwrap_or_default());
        let _ = writeln!(
            text,
            "| {name} | {} | {} | {} |",
            cell(&key.takes),
            cell(&code(&key.default)),
            cell(&key.meaning)
        );
    }
    text
}

/// Keys of an object and of the objects in it; those with a value of their own first.
fn collect(root: &Value, schema: &Value, prefix: &str, keys: &mut Vec<Key>) {
    let Some(properties) = schema.get("properties").and_then(Value::as_object) else { return };
    let mut inner = Vec::new();
    for (name, property) in properties {
        let full = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        match object(root, property) {
            Some((table, is_list)) => inner.push((if is_list { format!("{full}[]") } else { full }, table)),
            None => keys.push(Key {
                name: full,
                takes: takes(root, property),
                default: property.get("default").map_or_else(String::new, value_text),
                meaning: meaning(root, property),
            }),
        }
    }
    for (name, table) in inner {
        collect(root, table, &name, keys);
    }
}

/// What a reference stands for.
fn resolved<'a>(root: &'a Value, schema: &'a Value) -> &'a Value {
    let target = schema
        .get("$ref")
        .and_then(Value::as_str)
        .and_then(|path| root.pointer(path.trim_start_matches('#')));
    target.unwrap_or(schema)
}

/// Alternatives of a schema, references resolved; itself when there are none.
fn alternatives<'a>(root: &'a Value, schema: &'a Value) -> Vec<&'a Value> {
    let schema = resolved(root, schema);
    let of = ["anyOf", "oneOf"].iter().find_map(|key| schema.get(*key)).and_then(Value::as_array);
    match of {
        Some(list) => list.iter().flat_map(|one| alternatives(root, one)).collect(),
        None => vec![schema],
    }
}

/// The table behind a key, and whether there may be several.
fn object<'a>(root: &'a Value, schema: &'a Value) -> Option<(&'a Value, bool)> {
    let all = alternatives(root, schema);
    let list = all.iter().filter_map(|one| one.get("items")).map(|items| resolved(root, items));
    let is_table = |one: &&'a Value| one.get("properties").is_some();
    let table = all.iter().copied().find(is_table).or_else(|| list.clone().find(is_table))?;
    Some((table, list.into_iter().any(|items| is_table(&items))))
}

fn takes(root: &Value, schema: &Value) -> String {
    let mut words: Vec<String> = Vec::new();
    for one in alternatives(root, schema) {
        let kinds: Vec<&str> = match one.get("type") {
            Some(Value::String(kind)) => vec![kind],
            Some(Value::Array(kinds)) => kinds.iter().filter_map(Value::as_str).collect(),
            _ => Vec::new(),
        };
        if let Some(word) = one.get("const") {
            words.push(format!("`{word}`"));
        } else if let Some(list) = one.get("enum").and_then(Value::as_array) {
            words.extend(list.iter().map(|word| format!("`{word}`")));
        } else {
            words.extend(kinds.iter().filter(|kind| **kind != "null").map(|kind| match *kind {
                "array" => match one.get("minItems").and_then(Value::as_u64) {
                    Some(count) => format!("list of {count} numbers"),
                    None => "list of names".to_owned(),
                },
                "string" => "text".to_owned(),
                "integer" => "whole number".to_owned(),
                "boolean" => "`true` or `false`".to_owned(),
                "object" => "table of numbers by name".to_owned(),
                kind => kind.to_owned(),
            }));
        }
    }
    words.dedup();
    words.join(", ")
}

fn meaning(root: &Value, schema: &Value) -> String {
    let own = schema.get("description").or_else(|| resolved(root, schema).get("description"));
    let mut text = own.and_then(Value::as_str).unwrap_or_default().to_owned();
    // What the words mean.
    let words = alternatives(root, schema).into_iter().filter_map(|one| {
        let (word, what) = (one.get("const")?.as_str()?, one.get("description")?.as_str()?);
        Some(format!("`{word}`: {what}"))
    });
    let words: Vec<String> = words.collect();
    if !words.is_empty() {
        let _ = write!(text, " {}", words.join(" "));
    }
    text.trim().to_owned()
}

fn value_text(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::Array(list) => {
            format!("[{}]", list.iter().map(value_text).collect::<Vec<_>>().join(", "))
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use delmpc_scenario::{Document, ScenarioError};

    use super::*;

    /// Every key that the reader knows, found by asking it for one that nobody knows in every table.
    fn known(table: &str, names: &mut BTreeSet<String>) {
        let text = if table.is_empty() { "zzz = 1".to_owned() } else { format!("[{table}]\nzzz = 1") };
        let Err(ScenarioError::UnknownKey { known: keys, .. }) = Document::parse("keys.toml", &text) else {
            names.insert(table.to_owned());
            return;
        };
        for key in keys {
            known(&key, names);
        }
    }

    #[test]
    fn the_page_has_every_key_that_is_read_and_no_other() {
        let mut read = BTreeSet::new();
        known("", &mut read);
        let read: BTreeSet<String> =
            read.into_iter().map(|name| name.trim_end_matches(".*").to_owned()).collect();
        let told: BTreeSet<String> =
            Format::Scenario.keys().into_iter().map(|key| key.name.replace("[]", "")).collect();
        assert!(read.len() > 150, "{}", read.len());
        let missing: Vec<&String> = read.difference(&told).collect();
        let more: Vec<&String> = told.difference(&read).collect();
        assert!(missing.is_empty() && more.is_empty(), "missing {missing:?}, too many {more:?}");
    }

    #[test]
    fn the_keys_of_a_companion_table_are_those_it_is_read_with() {
        let told: BTreeSet<String> = Format::Companion.keys().into_iter().map(|key| key.name).collect();
        // A table with a key that nobody knows is refused with the names of those that are known.
        for (table, start) in [
            ("", ""),
            ("contact[].", "[[contact]]"),
            ("frame[].", "[[frame]]"),
            ("sole[].", "[[sole]]"),
            ("spring[].", "[[spring]]"),
            ("posture[].", "[[posture]]"),
        ] {
            let text = if table.is_empty() {
                "zzz = 1\nformat = 1\n".to_owned()
            } else {
                format!("format = 1\n{start}\nzzz = 1\n")
            };
            let error = delmpc_robots::load_str(
                "it.urdf",
                "<robot name='a'/>",
                Some(&text),
                &delmpc_robots::LoadOptions::default(),
            );
            let said = error.unwrap_err().to_string();
            let known: Vec<&str> = said.split('`').skip(3).step_by(2).collect();
            assert!(known.len() >= 3, "{said}");
            for key in known {
                let is_table =
                    start.is_empty() && told.iter().any(|told| told.starts_with(&format!("{key}[].")));
                let is_alias = ["stiffness_n_per_m", "rest_m"].contains(&key);
                assert!(
                    is_table || is_alias || told.contains(&format!("{table}{key}")),
                    "{table}{key} is not told"
                );
            }
        }
    }

    #[test]
    fn every_key_says_what_it_takes_and_means() {
        for key in [Format::Scenario, Format::Companion].into_iter().flat_map(Format::keys) {
            assert!(!key.takes.is_empty() && !key.meaning.is_empty(), "{key:?}");
        }
    }

    #[test]
    fn page_and_schema_that_are_shipped_are_those_of_the_types() {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
        let page = |of: Format| of.page(&of.keys());
        for (file, text, command) in [
            ("scenario_keys.md", page(Format::Scenario), "delmpc keys"),
            ("scenario.schema.json", Format::Scenario.schema_text(), "delmpc keys --schema"),
            ("companion_keys.md", page(Format::Companion), "delmpc keys --companion"),
            ("companion.schema.json", Format::Companion.schema_text(), "delmpc keys --companion --schema"),
        ] {
            let shipped = std::fs::read_to_string(configs.join(file)).unwrap_or_default();
            assert!(shipped == text, "configs/{file} is not up to date: {command} > configs/{file}");
        }
    }
}
