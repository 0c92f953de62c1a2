//! From text and overrides to a [`Scenario`].

use std::collections::BTreeMap;
use std::path::Path;

use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use crate::fault::FAULT_KINDS;
use crate::feet::GAIT_KINDS;
use crate::range::check;
use crate::{Place, Scenario, ScenarioError};

/// Larger files are no scenarios.
const LARGEST_FILE: u64 = 1 << 20;

/// Keys that hold one table or a list of tables.
const LISTS: [&str; 10] = [
    "push",
    "step",
    "fault",
    "terrain.box",
    "terrain.gap",
    "plan.obstacle",
    "plan.gap",
    "plan.step",
    "plan.spring",
    "plan.bound",
];

/// Keys that hold a name or a list of names.
const NAME_LISTS: [&str; 1] = ["robot.stance"];

/// In the catalogue, the name that stands for all names.
pub(crate) const ANY_NAME: &str = "*";

/// A scenario file, with overrides, and where each key came from.
#[derive(Debug, Clone)]
pub struct Document {
    file: String,
    table: Table,
    places: BTreeMap<String, Place>,
    catalogue: Value,
    notes: Vec<String>,
    /// Keys that were left out because of these.
    passed_over: Vec<ScenarioError>,
}

impl Document {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ScenarioError::Unreadable`], and those of [`Self::parse`].
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ScenarioError> {
        Self::lenient(path)?.strict()
    }

    /// Reads a file past keys that nobody knows and values of another type: [`Self::faults`] has them all.
    ///
    /// # Errors
    /// [`ScenarioError::Unreadable`], [`ScenarioError::Syntax`].
    pub fn lenient(path: impl AsRef<Path>) -> Result<Self, ScenarioError> {
        let path = path.as_ref();
        let file = path.display().to_string();
        let unreadable = |cause: String| ScenarioError::Unreadable { file: file.clone(), cause };
        let metadata = std::fs::metadata(path).map_err(|error| unreadable(error.to_string()))?;
        if !metadata.is_file() {
            return Err(unreadable("not a regular file".to_owned()));
        }
        if metadata.len() > LARGEST_FILE {
            return Err(unreadable(format!("larger than {LARGEST_FILE} bytes")));
        }
        let text = std::fs::read_to_string(path).map_err(|error| unreadable(error.to_string()))?;
        let mut document = Self::parse_lenient(&file, &text)?;
        if let Some(stem) = path.file_stem().and_then(|stem| stem.to_str()) {
            let name = Value::String(stem.to_owned());
            document.table.entry("name").or_insert(name);
        }
        Ok(document)
    }

    /// Takes a text; `file` names it in messages. Checks that it is TOML and that every key is known and of the right type.
    ///
    /// # Errors
    /// [`ScenarioError::Syntax`], [`ScenarioError::UnknownKey`], [`ScenarioError::WrongType`].
    pub fn parse(file: &str, text: &str) -> Result<Self, ScenarioError> {
        Self::parse_lenient(file, text)?.strict()
    }

    /// As it is where nothing was passed over.
    fn strict(self) -> Result<Self, ScenarioError> {
        match self.passed_over.first() {
            Some(fault) => Err(fault.clone()),
            None => Ok(self),
        }
    }

    fn parse_lenient(file: &str, text: &str) -> Result<Self, ScenarioError> {
        let syntax = |error: toml::de::Error| ScenarioError::Syntax {
            file: file.to_owned(),
            line: line_of(text, error.span().map_or(0, |span| span.start)),
            what: error.message().to_owned(),
        };
        let spanned = DeTable::parse(text).map_err(syntax)?;
        let catalogue = Value::try_from(Scenario::catalogue()).unwrap_or(Value::Table(Table::new()));
        let mut document = Self {
            file: file.to_owned(),
            table: Table::new(),
            places: BTreeMap::new(),
            catalogue,
            notes: Vec::new(),
            passed_over: Vec::new(),
        };
        document.note_places("", spanned.get_ref(), text);
        let table: Table = toml::from_str(text).map_err(syntax)?;
        let mut passed_over = Vec::new();
        document.table = document.typed_table("", table, &document.catalogue, &mut passed_over);
        document.passed_over = passed_over;
        Ok(document)
    }

    /// Overrides a key: `key=value`, with the value as in TOML; strings may go without quotes. One of a list is named as in messages:
    /// `push[1].impulse_ns`, counted from 0. `push.…` means the first push, `fault.…` the first fault.
    ///
    /// # Errors
    /// [`ScenarioError::MalformedOverride`], [`ScenarioError::UnknownKey`], [`ScenarioError::WrongType`],
    /// [`ScenarioError::NoSuchEntry`].
    pub fn set(&mut self, text: &str) -> Result<(), ScenarioError> {
        let malformed = || ScenarioError::MalformedOverride { text: text.to_owned() };
        let (key, value) = text.split_once('=').ok_or_else(malformed)?;
        let (key, value) = (key.trim(), value.trim());
        if key.is_empty() || value.is_empty() {
            return Err(malformed());
        }
        let bare = || Value::String(value.to_owned());
        let value = toml::from_str::<Table>(&format!("value = {value}"))
            .ok()
            .filter(|table| table.len() == 1)
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(bare);
        if let Some((list, index, name)) = entry(key) {
            return self.set_entry(text, list, index, name, value);
        }
        for list in LISTS {
            let entries = self.table.get(list).and_then(Value::as_array).map_or(0, Vec::len);
            if entries > 1 && key.strip_prefix(list).is_some_and(|rest| rest.starts_with('.')) {
                let name = &key[list.len()..];
                let last = entries - 1;
                self.notes.push(format!(
                    "--set {key}: there are {entries}, and it changes the first one: name {list}[0]{name} .. {list}[{last}]{name}"
                ));
            }
        }
        // Checked as if it were alone in a file, then put into ours.
        let mut wrapped = value;
        for part in key.rsplit('.') {
            wrapped = Value::Table(Table::from_iter([(part.to_owned(), wrapped)]));
        }
        let place = Place::Override(text.to_owned());
        for list in LISTS {
            if let Some(name) = key.strip_prefix(list).and_then(|rest| rest.strip_prefix('.')) {
                self.places.insert(format!("{list}[0].{name}"), place.clone());
            }
        }
        self.places.insert(key.to_owned(), place);
        let wrapped = self.typed("", wrapped, &self.catalogue)?;
        if let Value::Table(changes) = wrapped {
            merge(&mut self.table, changes);
        }
        Ok(())
    }

    /// Overrides a key of one entry of a list.
    fn set_entry(
        &mut self,
        text: &str,
        list: &str,
        index: usize,
        name: &str,
        value: Value,
    ) -> Result<(), ScenarioError> {
        let key = format!("{list}[{index}]");
        let mut wrapped = value;
        for part in name.rsplit('.') {
            wrapped = Value::Table(Table::from_iter([(part.to_owned(), wrapped)]));
        }
        self.places.insert(format!("{key}.{name}"), Place::Override(text.to_owned()));
        if let (0, Some(Value::Table(_))) = (index, self.table.get(list)) {
            self.places.insert(format!("{list}.{name}"), Place::Override(text.to_owned()));
        }
        let pattern = self.catalogue.get(list).cloned().unwrap_or(Value::Table(Table::new()));
        let typed = self.typed(&key, wrapped, &pattern)?;
        let entries = match self.table.get(list) {
            Some(Value::Array(entries)) => entries.len(),
            Some(_) => 1,
            None => 0,
        };
        let place = match self.table.get_mut(list) {
            Some(Value::Array(entries)) => entries.get_mut(index),
            Some(only) if index == 0 => Some(only),
            _ => None,
        };
        match (place, typed) {
            (Some(Value::Table(old)), Value::Table(change)) => {
                merge(old, change);
                Ok(())
            }
            _ => Err(ScenarioError::NoSuchEntry {
                file: self.file.clone(),
                text: text.to_owned(),
                list: list.to_owned(),
                entries,
            }),
        }
    }

    /// What should be known of the overrides so far.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The scenario, with defaults filled in and all ranges checked.
    ///
    /// # Errors
    /// The first of [`Self::faults`].
    pub fn scenario(&self) -> Result<Scenario, ScenarioError> {
        match self.faults().into_iter().next() {
            Some(fault) => Err(fault),
            None => self.unchecked(),
        }
    }

    /// The scenario with defaults filled in, whatever is wrong with its values.
    ///
    /// # Errors
    /// [`ScenarioError::WrongType`] for a word that is none of the allowed ones.
    pub fn unchecked(&self) -> Result<Scenario, ScenarioError> {
        self.table.clone().try_into().map_err(|error: toml::de::Error| {
            let message = error.message().to_owned();
            let (file, place) = (self.file.clone(), Place::Absent);
            ScenarioError::WrongType {
                file,
                place,
                key: "?".to_owned(),
                found: message,
                expected: "?".to_owned(),
            }
        })
    }

    /// Everything that is wrong: keys that nobody knows and values of another type, as far as [`Self::lenient`] went past them, then
    /// [`ScenarioError::OutOfRange`].
    pub fn faults(&self) -> Vec<ScenarioError> {
        let mut faults = self.passed_over.clone();
        match self.unchecked() {
            Err(error) => faults.push(error),
            Ok(scenario) => {
                faults.extend(check(&scenario).into_iter().map(|violation| ScenarioError::OutOfRange {
                    file: self.file.clone(),
                    place: self.place(&violation.key),
                    key: violation.key,
                    value: violation.value,
                    rule: violation.rule,
                    remedy: violation.remedy,
                }));
            }
        }
        faults
    }

    /// The value brought to the types of the catalogue (whole numbers become floating ones where the key is one).
    fn typed(&self, key: &str, value: Value, pattern: &Value) -> Result<Value, ScenarioError> {
        let wrong = |found: &Value, expected: String| {
            Err(ScenarioError::WrongType {
                file: self.file.clone(),
                place: self.place(key),
                key: key.to_owned(),
                found: describe(found),
                expected,
            })
        };
        match (value, pattern) {
            (Value::Table(table), Value::Table(_)) => {
                let mut faults = Vec::new();
                let typed = self.typed_table(key, table, pattern, &mut faults);
                faults.into_iter().next().map_or(Ok(Value::Table(typed)), Err)
            }
            (Value::Array(list), Value::Table(_)) if LISTS.contains(&key) => {
                let each = |(index, value)| self.typed(&format!("{key}[{index}]"), value, pattern);
                Ok(Value::Array(list.into_iter().enumerate().map(each).collect::<Result<_, _>>()?))
            }
            (Value::Array(list), Value::Array(known)) => {
                let numbers = list.iter().all(|value| matches!(value, Value::Float(_) | Value::Integer(_)));
                if list.len() != known.len() || !numbers {
                    return wrong(&Value::Array(list), format!("a list of {} numbers", known.len()));
                }
                let each = |(value, pattern)| self.typed(key, value, pattern);
                Ok(Value::Array(list.into_iter().zip(known).map(each).collect::<Result<_, _>>()?))
            }
            (Value::Array(list), Value::String(_)) if NAME_LISTS.contains(&key) => {
                if list.is_empty() || !list.iter().all(Value::is_str) {
                    return wrong(&Value::Array(list), "a name, or a list of names".to_owned());
                }
                Ok(Value::Array(list))
            }
            (Value::Integer(value), Value::Float(_)) => Ok(Value::Float(value as f64)),
            (Value::Integer(value), Value::Integer(_)) if value < 0 => {
                wrong(&Value::Integer(value), "a whole number from 0 on".to_owned())
            }
            (Value::String(value), Value::String(_)) => match words(key) {
                Some(words) if !words.contains(&value.as_str()) => {
                    let quoted: Vec<String> = words.iter().map(|word| format!("\"{word}\"")).collect();
                    wrong(&Value::String(value), quoted.join(" or "))
                }
                _ => Ok(Value::String(value)),
            },
            (value, pattern) if value.same_type(pattern) => Ok(value),
            (value, pattern) => wrong(&value, expected_type(pattern)),
        }
    }

    /// As much of a table as the catalogue knows, and what it does not.
    fn typed_table(
        &self,
        key: &str,
        table: Table,
        pattern: &Value,
        faults: &mut Vec<ScenarioError>,
    ) -> Table {
        let mut typed = Table::new();
        let Value::Table(known) = pattern else { return typed };
        for (name, value) in table {
            let inner = join(key, &name);
            // One pattern for keys of any name.
            let Some(pattern) = known.get(&name).or_else(|| known.get(ANY_NAME)) else {
                faults.push(self.unknown(key, &inner, &name, known));
                continue;
            };
            match (value, pattern) {
                (Value::Table(table), Value::Table(_)) => {
                    let table = self.typed_table(&inner, table, pattern, faults);
                    typed.insert(name, Value::Table(table));
                }
                (value, pattern) => match self.typed(&inner, value, pattern) {
                    Ok(value) => {
                        typed.insert(name, value);
                    }
                    Err(fault) => faults.push(fault),
                },
            }
        }
        typed
    }

    fn unknown(&self, table: &str, key: &str, name: &str, known: &Table) -> ScenarioError {
        let nearest = known
            .keys()
            .map(|candidate| {
                (edit_distance(name, candidate), name.len().abs_diff(candidate.len()), candidate)
            })
            .filter(|(distance, _, candidate)| {
                *distance <= 3.min(candidate.len() / 2).max(1) || starts_alike(name, candidate)
            })
            .min()
            .map(|(.., candidate)| join(table, candidate));
        ScenarioError::UnknownKey {
            file: self.file.clone(),
            place: self.place(key),
            key: key.to_owned(),
            nearest,
            known: known.keys().map(|name| join(table, name)).collect(),
        }
    }

    /// Where a key was given.
    fn place(&self, key: &str) -> Place {
        self.places.get(key).cloned().unwrap_or(Place::Absent)
    }

    fn note_places(&mut self, table: &str, content: &DeTable<'_>, text: &str) {
        for (name, value) in content {
            let key = join(table, name.get_ref());
            self.places.insert(key.clone(), Place::Line(line_of(text, name.span().start)));
            self.note_values(&key, value, text);
        }
    }

    fn note_values(&mut self, key: &str, value: &Spanned<DeValue<'_>>, text: &str) {
        match value.get_ref() {
            DeValue::Table(inner) => self.note_places(key, inner, text),
            DeValue::Array(list) => {
                for (index, value) in list.iter().enumerate() {
                    let key = format!("{key}[{index}]");
                    self.places.insert(key.clone(), Place::Line(line_of(text, value.span().start)));
                    self.note_values(&key, value, text);
                }
            }
            _ => {}
        }
    }
}

impl Scenario {
    /// The effective configuration as a scenario file: every key.
    pub fn to_toml(&self) -> String {
        let body = toml::to_string(self).unwrap_or_default();
        format!("# Effective configuration: every key with the value that was used.\n{body}")
    }
}

/// List, index and name of `list[index].name`.
fn entry(key: &str) -> Option<(&'static str, usize, &str)> {
    LISTS.into_iter().find_map(|list| {
        let (index, name) = key.strip_prefix(list)?.strip_prefix('[')?.split_once("].")?;
        Some((list, index.parse().ok()?, name))
    })
}

/// Puts `changes` into `table`; where `table` has a list of tables and `changes` one table, into the first of the list.
fn merge(table: &mut Table, changes: Table) {
    for (name, change) in changes {
        match (table.get_mut(&name), change) {
            (Some(Value::Table(old)), Value::Table(change)) => merge(old, change),
            (Some(Value::Array(list)), Value::Table(change)) => match list.first_mut() {
                Some(Value::Table(first)) => merge(first, change),
                _ => list.push(Value::Table(change)),
            },
            (_, change) => {
                table.insert(name, change);
            }
        }
    }
}

/// The allowed words of a key that takes one of a few.
fn words(key: &str) -> Option<&'static [&'static str]> {
    // In a list too: `fault[3].kind`.
    let of_list =
        key.split_once('[').zip(key.split_once("].")).map(|((list, _), (_, name))| join(list, name));
    match of_list.as_deref().unwrap_or(key) {
        "fault.kind" => Some(&FAULT_KINDS),
        "fault.target" => Some(&["state", "command", "plant", "controller", "machine"]),
        "gait.kind" => Some(&GAIT_KINDS),
        "clock" => Some(&["realtime", "lockstep"]),
        "robot.base" => Some(&["floating", "fixed"]),
        "controller.kind" => Some(&["mpc", "static-lqr", "off"]),
        _ => None,
    }
}

fn describe(value: &Value) -> String {
    match value {
        Value::String(text) => format!("the text \"{text}\""),
        Value::Integer(number) => format!("the whole number {number}"),
        Value::Float(number) => format!("the number {number}"),
        Value::Boolean(yes) => format!("the truth value {yes}"),
        Value::Datetime(time) => format!("the time {time}"),
        Value::Array(list) => format!("a list of {}", list.len()),
        Value::Table(_) => "a table".to_owned(),
    }
}

fn expected_type(pattern: &Value) -> String {
    match pattern {
        Value::String(_) => "a text in quotes",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a time",
        Value::Array(list) => return format!("a list of {} numbers", list.len()),
        Value::Table(_) => "a table of keys",
    }
    .to_owned()
}

fn join(table: &str, name: &str) -> String {
    if table.is_empty() { name.to_owned() } else { format!("{table}.{name}") }
}

fn line_of(text: &str, offset: usize) -> usize {
    1 + text.bytes().take(offset).filter(|byte| *byte == b'\n').count()
}

/// One is the other with something after it, as `duration` and `duration_s`: a forgotten unit.
fn starts_alike(a: &str, b: &str) -> bool {
    a.len() >= 3 && b.starts_with(a) || b.len() >= 3 && a.starts_with(b)
}

/// Fewest insertions, deletions and replacements from one word to the other.
fn edit_distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let cost = if x == *y { diagonal } else { 1 + diagonal.min(row[j]).min(row[j + 1]) };
            diagonal = row[j + 1];
            row[j + 1] = cost;
        }
    }
    row[b.len()]
}
