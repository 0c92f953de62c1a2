//! Entry points: files in, a [`RobotModel`] out.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use crate::assemble::assemble;
use crate::companion::CompanionFile;
use crate::error::{RobotError, Rule, Subject};
use crate::limits::{MAX_COMPANION_BYTES, MAX_URDF_BYTES};
use crate::model::RobotModel;
use crate::urdf::Description;

/// How the robot is attached to the world.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum BaseChoice {
    /// Floating when the root link (with what is fixed to it) has mass, or hangs on an empty root by a floating joint;
    /// else fixed at the root link.
    #[default]
    Auto,
    /// The root link floats.
    Floating,
    /// The named link is fixed and its frame is {0}. Joints on the way to it are reversed (values and signs stay).
    Fixed(String),
}

/// What to do with an inertia that no body can have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ImpossibleInertia {
    /// Refuse the robot.
    #[default]
    Refuse,
    /// Take the nearest possible inertia and say so in [`RobotModel::warnings`].
    Repair,
    /// Take it as it is and say so in [`RobotModel::warnings`]: the mathematics goes through, the robot is not of this world. A joint that
    /// carries no mass at all, which no mathematics moves, is held at 0.
    Accept,
}

/// Where the companion file is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Companion {
    /// `robot.toml` beside `robot.urdf`, if it is there.
    #[default]
    Beside,
    /// This file, which must be there.
    At(PathBuf),
    /// None is read.
    None,
}

/// Choices when loading a robot.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadOptions {
    /// Base.
    pub base: BaseChoice,
    /// Gravity in {0}, m/s².
    pub gravity_w: Vector3<f64>,
    /// Impossible inertias.
    pub impossible_inertia: ImpossibleInertia,
    /// Companion file.
    pub companion: Companion,
    /// Whether what is read all the same, with a warning, is an error: decoration that cannot be read, values that are missing.
    pub strict: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            base: BaseChoice::default(),
            gravity_w: Vector3::new(0.0, 0.0, -9.81),
            impossible_inertia: ImpossibleInertia::default(),
            companion: Companion::default(),
            strict: false,
        }
    }
}

/// Loads a URDF file and the companion file beside it, with the default [`LoadOptions`].
///
/// # Errors
/// The first rule broken, with file, line, link or joint and remedy.
pub fn load(path: impl AsRef<Path>) -> Result<RobotModel, RobotError> {
    load_with(path, &LoadOptions::default())
}

/// Loads a URDF file. Time and memory are bounded by [`crate::limits`] whatever the file holds.
///
/// # Errors
/// The first rule broken, with file, line, link or joint and remedy.
pub fn load_with(path: impl AsRef<Path>, options: &LoadOptions) -> Result<RobotModel, RobotError> {
    let path = path.as_ref();
    let text = read(path, MAX_URDF_BYTES)?;
    let companion = match &options.companion {
        Companion::None => None,
        Companion::At(file) => Some(file.clone()),
        Companion::Beside => Some(path.with_extension("toml")).filter(|file| file.exists() && file != path),
    };
    let companion = match companion {
        None => None,
        Some(file) => Some(CompanionFile::read(&file, &read(&file, MAX_COMPANION_BYTES)?)?),
    };
    build(path, &text, companion.as_ref(), options)
}

/// Loads a robot from texts; `path` names the URDF in messages, its `.toml` sibling the companion. No file is read.
///
/// # Errors
/// The first rule broken, with file, line, link or joint and remedy.
pub fn load_str(
    path: impl AsRef<Path>,
    urdf: &str,
    companion: Option<&str>,
    options: &LoadOptions,
) -> Result<RobotModel, RobotError> {
    let path = path.as_ref();
    check_size(path, urdf.len(), MAX_URDF_BYTES)?;
    let companion = match companion {
        None => None,
        Some(text) => {
            let file = path.with_extension("toml");
            check_size(&file, text.len(), MAX_COMPANION_BYTES)?;
            Some(CompanionFile::read(&file, text)?)
        }
    };
    build(path, urdf, companion.as_ref(), options)
}

fn build(
    path: &Path,
    urdf: &str,
    companion: Option<&CompanionFile>,
    options: &LoadOptions,
) -> Result<RobotModel, RobotError> {
    let urdf = urdf.trim_start_matches('\u{feff}');
    let mut description = Description::read(path, urdf)?;
    if let (true, Some(warning)) = (options.strict, description.warnings.first()) {
        return Err(warning.error.clone());
    }
    let mut options = options.clone();
    if let Some(companion) = companion {
        companion.lock(&mut description)?;
        if companion.accepts_impossible_inertia() && options.impossible_inertia == ImpossibleInertia::Refuse {
            options.impossible_inertia = ImpossibleInertia::Accept;
        }
    }
    assemble(path, &description, companion, &options)
}

fn check_size(path: &Path, size: usize, limit: usize) -> Result<(), RobotError> {
    if size <= limit {
        Ok(())
    } else {
        Err(RobotError::new(path, None, Subject::File, Rule::TooLarge { limit }))
    }
}

fn read(path: &Path, limit: usize) -> Result<String, RobotError> {
    let refuse = |rule| RobotError::new(path, None, Subject::File, rule);
    let unreadable = |error: std::io::Error| refuse(Rule::Unreadable(error.to_string()));
    // A device or pipe could block, in opening it already, or never end.
    if !std::fs::metadata(path).map_err(unreadable)?.is_file() {
        return Err(refuse(Rule::Unreadable("not a regular file".to_owned())));
    }
    let file = File::open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    file.take(limit as u64 + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    check_size(path, bytes.len(), limit)?;
    String::from_utf8(bytes).map_err(|_| refuse(Rule::NotText))
}
