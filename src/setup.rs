//! Scenario and robot, read from their files and checked against each other.

use std::path::{Path, PathBuf};

use delmpc_messages::{JointSetHasher, MAX_JOINTS, joint_set_hash};
use delmpc_robots::{RobotModel, load};
use delmpc_scenario::{Document, Scenario};

use crate::verdict::Failure;

/// The scenario that runs when none is named.
pub const MAIN_SCENARIO: &str = "configs/scenarios/atlas_one_foot.toml";
/// The scenario whose faults are tried when none is named.
pub const FAULT_SCENARIO: &str = "configs/scenarios/atlas_faults.toml";

/// What a run is about.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The scenario, overrides included.
    pub scenario: Scenario,
    /// The robot, floating.
    pub robot: RobotModel,
    /// Where the robot was found.
    pub urdf: PathBuf,
}

impl Setup {
    /// Reads a scenario, applies overrides and loads its robot.
    ///
    /// # Errors
    /// [`Failure::Input`] with file, key and remedy.
    pub fn read(file: &Path, overrides: &[String]) -> Result<Self, Failure> {
        let mut document = Document::read(file).map_err(Failure::input)?;
        for change in overrides {
            document.set(change).map_err(Failure::input)?;
        }
        let scenario = document.scenario().map_err(Failure::input)?;
        let urdf = find_robot(file, &scenario.robot.urdf);
        let robot = load(&urdf).map_err(Failure::input)?;
        let setup = Self { scenario, robot, urdf };
        setup.check_names().map_err(|error| Failure::Input(format!("{}: {error}", file.display())))?;
        Ok(setup)
    }

    /// The hash by which processes recognise that they have the same joints.
    pub fn joint_set_hash(&self) -> u64 {
        let names: Vec<&str> = self.robot.joint_names.iter().map(String::as_str).collect();
        joint_set_hash(&names)
    }

    /// The files the robot came from, as they are now: name in the run's folder, media type, content.
    pub fn robot_files(&self) -> Vec<(String, &'static str, Vec<u8>)> {
        let companion = self.urdf.with_extension("toml");
        let files = [
            (self.urdf.as_path(), "robot.urdf", "application/xml"),
            (&companion, "robot.toml", "application/toml"),
        ];
        let content = |(path, name, kind): (&Path, &str, &'static str)| {
            std::fs::read(path).ok().map(|content| (name.to_owned(), kind, content))
        };
        files.into_iter().filter_map(content).collect()
    }

    /// A number that stands for the robot's files, every byte of them: FNV-1a, as for joint sets.
    pub fn model_hash(&self) -> u64 {
        let texts = self
            .robot_files()
            .into_iter()
            .map(|(.., content)| String::from_utf8_lossy(&content).into_owned());
        texts.fold(JointSetHasher::new(), |hash, text| hash.joint(&text)).finish()
    }

    /// The frame of the sole the robot stands on.
    pub fn stance_frame(&self) -> &str {
        self.robot.sole(&self.scenario.robot.stance).map_or("", |sole| sole.frame.as_str())
    }

    /// Every name of the scenario that the robot must know.
    fn check_names(&self) -> Result<(), String> {
        let Self { scenario, robot, .. } = self;
        if !robot.tree.is_floating() {
            return Err(
                "`robot.urdf`: this robot is fixed to the world; a plant needs one that can fall".to_owned()
            );
        }
        let joints = robot.joint_names.len();
        if joints > MAX_JOINTS {
            return Err(format!("`robot.urdf`: {joints} joints, but a message has room for {MAX_JOINTS}"));
        }
        if let Some(why) = crate::stance::undriven(robot).into_iter().next() {
            return Err(format!("`robot.urdf`: {why}"));
        }
        let soles = robot.soles.iter().map(|sole| sole.name.as_str());
        one_of("robot.stance", "sole", &scenario.robot.stance, soles)?;
        let postures = robot.postures.iter().map(|posture| posture.name.as_str());
        one_of("robot.posture", "posture", &scenario.robot.posture, postures)?;
        let links = || robot.links.iter().map(|link| link.name.as_str());
        if let Some(reach) = &scenario.reach {
            let frames = robot.frames.iter().map(|frame| frame.name.as_str());
            one_of("reach.hand", "frame or link", &reach.hand, frames.chain(links()))?;
        }
        for push in &scenario.push {
            one_of("push.link", "link", &push.link, links())?;
        }
        Ok(())
    }
}

/// The named scenario file, or the main one: in the working folder, else in the folder the program was built in.
///
/// # Errors
/// When the main scenario cannot be found.
pub fn scenario_file(named: Option<&Path>) -> Result<PathBuf, Failure> {
    scenario_file_or(named, MAIN_SCENARIO)
}

/// The same with another file where none is named.
///
/// # Errors
/// When that file cannot be found.
pub fn scenario_file_or(named: Option<&Path>, usual: &str) -> Result<PathBuf, Failure> {
    if let Some(file) = named {
        return Ok(file.to_owned());
    }
    let here = PathBuf::from(usual);
    if here.is_file() {
        return Ok(here);
    }
    let program = std::env::current_exe().unwrap_or_default();
    let beside = program.ancestors().skip(1).map(|folder| folder.join(usual));
    beside.into_iter().find(|file| file.is_file()).ok_or_else(|| {
        let advice = "run it in the project's folder, or name a scenario: delmpc run FILE";
        Failure::Input(format!("{usual} is neither here nor above the program: {advice}"))
    })
}

/// The robot file: relative to the scenario, or else to the working folder.
pub(crate) fn find_robot(scenario: &Path, urdf: &str) -> PathBuf {
    let beside = scenario.parent().unwrap_or(Path::new("")).join(urdf);
    let here = PathBuf::from(urdf);
    if !beside.is_file() && here.is_file() { here } else { beside }
}

fn one_of<'a>(key: &str, kind: &str, name: &str, known: impl Iterator<Item = &'a str>) -> Result<(), String> {
    let known: Vec<&str> = known.collect();
    if known.contains(&name) {
        return Ok(());
    }
    Err(format!("`{key}` = \"{name}\": the robot has no such {kind}; it has {}", known.join(", ")))
}
