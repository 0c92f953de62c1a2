//! Why a robot was refused: file, line, link or joint, rule, remedy.

use std::fmt;
use std::path::{Path, PathBuf};

use delmpc_mechanics::errors::ModelError;

/// What an error is about.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Subject {
    /// The file as a whole.
    File,
    /// A link of the URDF.
    Link(String),
    /// A joint of the URDF, or one of its coordinates.
    Joint(String),
    /// An entry of the companion file, for example ``contact `toe` ``.
    Entry(String),
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => Ok(()),
            Self::Link(name) => write!(f, "link `{}`: ", shorten(name)),
            Self::Joint(name) => write!(f, "joint `{}`: ", shorten(name)),
            Self::Entry(name) => write!(f, "{}: ", shorten(name)),
        }
    }
}

/// The rule that was broken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Rule {
    /// The file cannot be read.
    #[error("it cannot be read: {0}")]
    Unreadable(String),
    /// The file is larger than the cap.
    #[error("it is larger than {limit} bytes")]
    TooLarge {
        /// The cap, bytes.
        limit: usize,
    },
    /// More of something than the cap.
    #[error("more than {limit} {what}")]
    TooMany {
        /// What there is too much of.
        what: &'static str,
        /// The cap.
        limit: usize,
    },
    /// The file is not UTF-8.
    #[error("it is not UTF-8 text")]
    NotText,
    /// A document type declaration, which may define entities.
    #[error("a document type declaration is not accepted")]
    DocumentType,
    /// Malformed XML, or XML that is not a URDF.
    #[error("{0}")]
    Xml(String),
    /// The root element is not `<robot>`.
    #[error("the root element is <{found}>, not <robot>")]
    NotARobot {
        /// The root element found.
        found: String,
    },
    /// An element or attribute that must be there is not.
    #[error("{what} is missing")]
    Missing {
        /// What is missing.
        what: &'static str,
    },
    /// An element that may be there once is there twice.
    #[error("<{element}> is there more than once")]
    Repeated {
        /// Element name.
        element: String,
    },
    /// An attribute that is not the right number of usable numbers.
    #[error("{attribute}=\"{text}\" of <{element}> is not {expected}")]
    NotNumbers {
        /// Element name.
        element: String,
        /// Attribute name.
        attribute: &'static str,
        /// What it says.
        text: String,
        /// What it should be.
        expected: &'static str,
    },
    /// Two things of the same name.
    #[error("its name is used twice")]
    DuplicateName,
    /// A reference to something that does not exist.
    #[error("it refers to the {kind} `{name}`, which does not exist")]
    Unknown {
        /// Kind of thing.
        kind: &'static str,
        /// The name given.
        name: String,
    },
    /// A link that is the child of two joints.
    #[error("joints `{first}` and `{second}` both carry it")]
    TwoParents {
        /// One joint.
        first: String,
        /// The other.
        second: String,
    },
    /// A closed loop of joints.
    #[error("it is part of, or hangs on, a closed loop of joints")]
    Cycle,
    /// More than one link that hangs on no joint.
    #[error("it hangs on no joint, and neither does link `{other}`")]
    TwoRoots {
        /// The first root.
        other: String,
    },
    /// A link that moves and has no `<inertial>`.
    #[error("it moves but has no <inertial>; readers silently take that for zero mass")]
    MissingInertial,
    /// Mass properties that no body has, or that cannot be simulated.
    #[error("{}", without_body(.0))]
    Physics(ModelError),
    /// A joint of a kind that is not supported, or not there.
    #[error("a {kind} joint is not supported here")]
    UnsupportedJoint {
        /// The URDF type.
        kind: &'static str,
    },
    /// An axis of no length.
    #[error("its axis has no length")]
    ZeroAxis,
    /// Limits that contradict each other or are negative.
    #[error("limits lower={lower} upper={upper} effort={effort} velocity={velocity} contradict themselves")]
    Limits {
        /// Lower position limit.
        lower: f64,
        /// Upper position limit.
        upper: f64,
        /// Effort limit.
        effort: f64,
        /// Velocity limit.
        velocity: f64,
    },
    /// Mimic joints that follow each other in a ring.
    #[error("it mimics itself by way of `{through}`")]
    MimicCycle {
        /// The joint it follows.
        through: String,
    },
    /// A base that the file cannot have.
    #[error("the base cannot be {wanted}")]
    Base {
        /// What was asked for.
        wanted: String,
    },
    /// Malformed TOML, an unknown key, or a value of the wrong type.
    #[error("{0}")]
    Toml(String),
    /// A number of the companion file that is not finite, or negative where it must not be.
    #[error("{key} is not a usable number")]
    BadNumber {
        /// Key in the companion file.
        key: &'static str,
    },
    /// Sole corners that are not a convex counter-clockwise polygon in the frame's plane, on the frame's link.
    #[error(
        "its corners are neither one contact of its frame's link nor a convex polygon, counter-clockwise from above, on the link and in the plane of its frame"
    )]
    SolePolygon,
}

impl Rule {
    /// What to do about it.
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Unreadable(_) => "check the path and the permissions",
            Self::TooLarge { .. } | Self::TooMany { .. } => {
                "this is far beyond any robot; give the file of one robot, with meshes in files of their own"
            }
            Self::NotText => "save it as UTF-8",
            Self::DocumentType => "delete the <!DOCTYPE ...> part and write entities out",
            Self::Xml(_) => "correct the XML at this place (run xacro first if it is a xacro file)",
            Self::NotARobot { .. } => "give a URDF file (SDF, MJCF and xacro are other formats)",
            Self::Missing { .. } => "add it",
            Self::Repeated { .. } => "keep one",
            Self::NotNumbers { .. } => "write plain decimal numbers, separated by blanks",
            Self::DuplicateName => "rename one of the two",
            Self::Unknown { .. } => "correct the name",
            Self::TwoParents { .. } => "a URDF is a tree: drop one joint and state the loop as a constraint",
            Self::Cycle => "a URDF is a tree: cut the loop and state it as a constraint",
            Self::TwoRoots { .. } => "join the parts by a joint, or put them in two files",
            Self::MissingInertial => {
                "give it <inertial> with mass and inertia, fix its joint, or have such joints held (accept_impossible_inertia = true in the companion table)"
            }
            Self::Physics(ModelError::MasslessSubtree { .. }) => {
                "give it or a link it carries a mass, lock its joint in the companion table, or have such joints held (accept_impossible_inertia = true there)"
            }
            Self::Physics(ModelError::NegativeMass { .. } | ModelError::NegativeDamping { .. }) => {
                "give a value that is not negative"
            }
            Self::Physics(_) => {
                "correct the inertia (about the mass centre, kg m^2), or have it accepted: accept_impossible_inertia = true in the companion table, or --set robot.accept_impossible_inertia=true for one run"
            }
            Self::UnsupportedJoint { .. } => {
                "use revolute, continuous, prismatic, planar or fixed joints; a floating joint only from an empty root link"
            }
            Self::ZeroAxis => "give <axis xyz=\"...\"/> a direction",
            Self::Limits { .. } => "give lower <= upper and effort, velocity >= 0",
            Self::MimicCycle { .. } => "let one of these joints be free",
            Self::Base { .. } => "choose a link that exists and a base that the file can have",
            Self::Toml(_) => "correct the key or value at this line",
            Self::BadNumber { .. } => "give a finite number (lengths and stiffnesses not negative)",
            Self::SolePolygon => {
                "list at least three contact points of the frame's link, counter-clockwise from above"
            }
        }
    }
}

/// The message of a model error without the body's index: the link's name stands in its place.
fn without_body(error: &ModelError) -> String {
    let text = error.to_string();
    match text.split_once(": ") {
        Some((body, rest)) if body.starts_with("body ") => rest.to_owned(),
        _ => text,
    }
}

/// A robot that was refused. Reads `file:line: subject: rule. Remedy: ...`.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotError {
    details: Box<Details>,
}

#[derive(Clone, Debug, PartialEq)]
struct Details {
    file: PathBuf,
    line: Option<u32>,
    subject: Subject,
    rule: Rule,
}

impl RobotError {
    pub(crate) fn new(file: &Path, line: Option<u32>, subject: Subject, rule: Rule) -> Self {
        Self { details: Box::new(Details { file: file.to_owned(), line, subject, rule }) }
    }

    /// The file with the fault.
    pub fn file(&self) -> &Path {
        &self.details.file
    }

    /// Line of the fault, from 1, where it has one.
    pub fn line(&self) -> Option<u32> {
        self.details.line
    }

    /// The link, joint or entry at fault.
    pub fn subject(&self) -> &Subject {
        &self.details.subject
    }

    /// The rule that was broken.
    pub fn rule(&self) -> &Rule {
        &self.details.rule
    }

    /// `file:line: subject: rule`, without the remedy.
    pub(crate) fn fault(&self) -> String {
        let Details { file, line, subject, rule } = &*self.details;
        let line = line.map_or_else(String::new, |line| format!(":{line}"));
        format!("{}{line}: {subject}{rule}", file.display())
    }
}

impl fmt::Display for RobotError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}. Remedy: {}", self.fault(), self.details.rule.remedy())
    }
}

impl std::error::Error for RobotError {}

/// Text from a file for a message: a hostile name must not flood the terminal.
pub(crate) fn shorten(text: &str) -> String {
    const LONGEST: usize = 60;
    let printable = |c: char| if c.is_control() { ' ' } else { c };
    if text.chars().nth(LONGEST).is_none() {
        text.chars().map(printable).collect()
    } else {
        text.chars().take(LONGEST).map(printable).chain("...".chars()).collect()
    }
}
