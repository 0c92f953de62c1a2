//! Why a scenario was refused: file, place, key, rule, remedy.

use std::fmt;

/// Where in the input the trouble is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Place {
    /// A line of the file, counted from 1.
    Line(usize),
    /// A `key=value` override.
    Override(String),
    /// The key is not in the file and its default does not do.
    Absent,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Line(line) => write!(f, "line {line}"),
            Self::Override(text) => write!(f, "--set {text}"),
            Self::Absent => write!(f, "not in the file"),
        }
    }
}

/// A scenario that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ScenarioError {
    /// The file cannot be read.
    #[error(
        "{file}: cannot be read ({cause}): give the path of a scenario file, for example configs/scenarios/atlas_one_foot.toml"
    )]
    Unreadable {
        /// The file.
        file: String,
        /// The cause.
        cause: String,
    },
    /// Not TOML.
    #[error("{file}: line {line}: not valid TOML: {what}")]
    Syntax {
        /// The file.
        file: String,
        /// The line.
        line: usize,
        /// What is wrong.
        what: String,
    },
    /// A key nobody understands.
    #[error("{file}: {place}: unknown key `{key}`{}", remedy(.nearest, .known))]
    UnknownKey {
        /// The file.
        file: String,
        /// Where.
        place: Place,
        /// The key with the tables it is in.
        key: String,
        /// The known key it resembles most, if it resembles one.
        nearest: Option<String>,
        /// The keys of that table.
        known: Vec<String>,
    },
    /// A value of another type than the key's.
    #[error("{file}: {place}: `{key}` is {found}, must be {expected}")]
    WrongType {
        /// The file.
        file: String,
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// The type found.
        found: String,
        /// The type of the key.
        expected: String,
    },
    /// A value outside its range.
    #[error("{file}: {place}: `{key}` = {value}: {rule}; {remedy}")]
    OutOfRange {
        /// The file.
        file: String,
        /// Where.
        place: Place,
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// The rule it breaks.
        rule: String,
        /// What to do.
        remedy: String,
    },
    /// An override of an entry that is not in its list.
    #[error(
        "{file}: --set {text}: there are {entries} of `{list}`, counted from 0: write the others into the file"
    )]
    NoSuchEntry {
        /// The file.
        file: String,
        /// The override.
        text: String,
        /// The list.
        list: String,
        /// Entries it has.
        entries: usize,
    },
    /// An override that is not `key=value`.
    #[error(
        "--set {text}: not of the form key=value: write for example --set seed=7 or --set push.direction=[0,-1,0]"
    )]
    MalformedOverride {
        /// The text.
        text: String,
    },
}

fn remedy(nearest: &Option<String>, known: &[String]) -> String {
    match nearest {
        Some(nearest) => format!(": did you mean `{nearest}`?"),
        None => format!(": the keys here are {}", known.join(", ")),
    }
}
