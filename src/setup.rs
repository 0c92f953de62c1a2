//! Scenario and robot, read from their files and checked against each other.

use std::path::{Path, PathBuf};

use delmpc_controller_core::config::ControllerConfig;
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_messages::{JointSetHasher, MAX_JOINTS, joint_set_hash};
use delmpc_planner::plan_file::Plan;
use delmpc_robots::{BaseChoice, ImpossibleInertia, LoadOptions, RobotError, RobotModel, load_with};
use delmpc_scenario::{Base, Document, Scenario, Stance};

use crate::check::Findings;
use crate::plan_source;
use crate::run_folder::PLAN_FILE;
use crate::start::Start;
use crate::verdict::Failure;

/// The scenario that runs when none is named.
pub const MAIN_SCENARIO: &str = "configs/scenarios/atlas_one_foot.toml";
/// The scenario whose faults are tried when none is named.
pub const FAULT_SCENARIO: &str = "configs/scenarios/atlas_faults.toml";

/// Longest stage of a horizon (s), as the controller has it.
const LONGEST_STAGE_S: f64 = 0.2;

/// What a run is about.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The scenario, overrides included.
    pub scenario: Scenario,
    /// The robot, floating.
    pub robot: RobotModel,
    /// Where the robot was found.
    pub urdf: PathBuf,
    /// The plan it follows, if it has been read or made ([`crate::plan_source`]).
    pub plan: Option<Plan>,
    /// What should be known of the overrides.
    pub notes: Vec<String>,
}

impl Setup {
    /// Reads a scenario, applies overrides and loads its robot.
    ///
    /// # Errors
    /// [`Failure::Input`] with everything that is wrong: file, key and remedy, a line each.
    pub fn read(file: &Path, overrides: &[String]) -> Result<Self, Failure> {
        let (setup, findings) = Self::inspect(file, overrides)?;
        findings.refuse()?;
        let mut setup = setup.ok_or_else(|| Failure::Input(format!("{}: no robot", file.display())))?;
        setup.notes.extend(findings.warnings);
        Ok(setup)
    }

    /// Reads a scenario and its robot as far as they can be read, and everything that is wrong with them, alone and together.
    ///
    /// # Errors
    /// [`Failure::Input`] when the scenario cannot be read at all, or an override names nothing.
    pub fn inspect(file: &Path, overrides: &[String]) -> Result<(Option<Self>, Findings), Failure> {
        let mut document = Document::lenient(file).map_err(Failure::input)?;
        for change in overrides {
            document.set(change).map_err(Failure::input)?;
        }
        let mut findings = Findings::default();
        findings.errors.extend(document.faults().iter().map(ToString::to_string));
        let scenario = match document.unchecked() {
            Ok(scenario) if !scenario.robot.urdf.is_empty() => scenario,
            _ => return Ok((None, findings)),
        };
        let urdf = find_robot(file, &scenario.robot.urdf);
        let mut robot = match load_robot(&urdf, &scenario) {
            Ok(robot) => robot,
            Err(error) => {
                findings.errors.push(error.to_string());
                return Ok((None, findings));
            }
        };
        findings.warnings.extend(robot.warnings.iter().cloned());
        let mut clamped = crate::check::clamp_efforts(&mut robot);
        clamped.extend(crate::stance::weightless(&robot));
        findings.warnings.extend(clamped.into_iter().map(|warning| format!("{}: {warning}", urdf.display())));
        let mut setup = Self { scenario, robot, urdf, plan: None, notes: document.notes().to_vec() };
        setup.name_all_soles();
        let of_file = |fault: String| format!("{}: {fault}", file.display());
        let mut wrong: Vec<String> =
            plan_source::reach_of_plan(&mut setup.scenario).err().into_iter().collect();
        wrong.extend(setup.check_names());
        if let Some(named) =
            setup.scenario.plan.as_ref().map(|plan| &plan.file).filter(|file| !file.is_empty())
        {
            match plan_source::read(file, named) {
                Ok(plan) => setup.plan = Some(plan),
                Err(fault) => wrong.push(fault),
            }
        }
        match crate::stance::check_scenario(&setup) {
            Ok(warnings) => findings.warnings.extend(warnings),
            Err(fault) => wrong.push(fault),
        }
        findings.errors.extend(wrong.into_iter().map(of_file));
        Ok((Some(setup), findings))
    }

    /// The hash by which processes recognise that they have the same joints.
    pub fn joint_set_hash(&self) -> u64 {
        let names: Vec<&str> = self.robot.joint_names.iter().map(String::as_str).collect();
        joint_set_hash(&names)
    }

    /// The files the robot and its plan came from, as they are now: name in the run's folder, media type, content.
    pub fn robot_files(&self) -> Vec<(String, &'static str, Vec<u8>)> {
        let companion = self.urdf.with_extension("toml");
        let files = [
            (self.urdf.as_path(), "robot.urdf", "application/xml"),
            (&companion, "robot.toml", "application/toml"),
        ];
        let content = |(path, name, kind): (&Path, &str, &'static str)| {
            std::fs::read(path).ok().map(|content| (name.to_owned(), kind, content))
        };
        let mut files: Vec<_> = files.into_iter().filter_map(content).collect();
        if let Some(text) = self.plan.as_ref().and_then(|plan| plan.to_json().ok()) {
            files.push((PLAN_FILE.to_owned(), "application/json", text.into_bytes()));
        }
        files
    }

    /// A number that stands for the robot's files, every byte of them: FNV-1a, as for joint sets.
    pub fn model_hash(&self) -> u64 {
        let texts = self
            .robot_files()
            .into_iter()
            .map(|(.., content)| String::from_utf8_lossy(&content).into_owned());
        texts.fold(JointSetHasher::new(), |hash, text| hash.joint(&text)).finish()
    }

    /// How the robot stands at the start.
    ///
    /// # Errors
    /// [`Failure::Input`] for a posture without base pose.
    pub fn start(&self) -> Result<Start, Failure> {
        Start::new(self)
    }

    /// The ball in the world, m.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn ball_w(&self) -> Result<Option<[f64; 3]>, Failure> {
        let start = self.start()?;
        let to_w = |ball_m: [f64; 3]| start.stance_frame_w.transform_point(&ball_m.into()).into();
        Ok(self.scenario.reach.as_ref().map(|reach| to_w(reach.ball_m)))
    }

    /// `robot.stance` = "all" by the names of the robot's soles.
    fn name_all_soles(&mut self) {
        if self.scenario.robot.stance.is_all() {
            let names = self.robot.soles.iter().map(|sole| sole.name.clone()).collect();
            self.scenario.robot.stance = Stance::Some(names);
        }
    }

    /// Whether the robot stands on several feet, or goes: then its controller has a contact schedule.
    pub fn is_legged(&self) -> bool {
        let scenario = &self.scenario;
        let goes = scenario.gait.is_some() || !scenario.step.is_empty();
        let planned = scenario.plan.as_ref().is_some_and(|plan| plan.hand.is_empty());
        scenario.robot.stance.names().len() > 1 || goes || planned
    }

    /// Index of the (first) stance foot among the soles of the robot.
    pub fn stance_foot(&self) -> usize {
        self.robot.soles.iter().position(|sole| sole.name == self.scenario.robot.stance.first()).unwrap_or(0)
    }

    /// Body and mounting of the inertial unit as everybody believes it to be.
    ///
    /// # Errors
    /// When its link is fixed to the world.
    pub fn inertial_unit(&self) -> Result<(usize, RigidTransform), String> {
        let sensors = &self.scenario.sensors;
        let in_link = RigidTransform::from_xyz_rpy(sensors.imu_position_m.into(), sensors.imu_rpy_rad.into());
        if sensors.imu_link.is_empty() {
            return Ok((0, in_link));
        }
        let link = self.robot.link(&sensors.imu_link);
        let on_body = link.and_then(|link| Some((link.body?, link.pose * in_link)));
        on_body.ok_or_else(|| format!("`sensors.imu_link`: {} is fixed to the world", sensors.imu_link))
    }

    /// The frame of the sole the robot stands on.
    pub fn stance_frame(&self) -> &str {
        self.robot.sole(self.scenario.robot.stance.first()).map_or("", |sole| sole.frame.as_str())
    }

    /// Keys that fit alone may not fit together.
    fn check_stages(&self) -> Result<(), String> {
        let settings = &self.scenario.controller;
        let (horizon_s, stages) = (settings.horizon_s, settings.stages);
        let config = ControllerConfig {
            stages: ControllerConfig::stages_for(horizon_s, stages, 1.0 / settings.mpc_rate_hz),
            ..ControllerConfig::default()
        };
        let lengths = config.stage_lengths();
        let longest_s = lengths.iter().copied().fold(0.0, f64::max);
        if lengths.iter().all(|length| *length > 0.0) && longest_s <= LONGEST_STAGE_S {
            return Ok(());
        }
        Err(format!(
            "`controller.horizon_s` = {horizon_s} and `controller.stages` = {stages} do not fit together: the longest stage would last \
             {longest_s:.3} s, allowed are {LONGEST_STAGE_S} s: give more stages or a shorter horizon"
        ))
    }

    /// What keeps this robot from being run like this: its joints, and every name of the scenario that it must know.
    fn check_names(&self) -> Vec<String> {
        let Self { scenario, robot, .. } = self;
        let mut wrong = Vec::new();
        if !robot.tree.is_floating() && scenario.robot.base == Base::Floating {
            wrong.push("`robot.urdf`: this robot is fixed to the world: robot.base = \"fixed\"".to_owned());
        }
        if !robot.tree.is_floating() && self.is_legged() {
            wrong.push("`robot.base` = \"fixed\": a robot that is bolted down neither steps nor stands on several feet".to_owned());
        }
        wrong.extend(self.check_stages().err());
        let joints = robot.joint_names.len();
        if joints > MAX_JOINTS {
            wrong.push(format!(
                "`robot.urdf`: {joints} joints, but a message has room for {MAX_JOINTS}: lock the others in the companion table, \
                 [locked] NAME = 0.0"
            ));
        }
        wrong.extend(crate::stance::undriven(robot).into_iter().map(|why| format!("`robot.urdf`: {why}")));
        let mut one_of = |key: &str, kind: &str, name: &str, known: Vec<&str>| {
            if !known.contains(&name) {
                let known = known.join(", ");
                wrong.push(format!("`{key}` = \"{name}\": the robot has no such {kind}; it has {known}"));
            }
        };
        let soles: Vec<&str> = robot.soles.iter().map(|sole| sole.name.as_str()).collect();
        // A robot that is bolted down stands on nothing.
        let asked = if robot.tree.is_floating() { scenario.robot.stance.names() } else { &[] };
        for name in asked {
            one_of("robot.stance", "sole", name, soles.clone());
        }
        for (index, step) in scenario.step.iter().enumerate() {
            one_of(&format!("step[{index}].foot"), "sole", &step.foot, soles.clone());
        }
        let postures = robot.postures.iter().map(|posture| posture.name.as_str()).collect();
        one_of("robot.posture", "posture", &scenario.robot.posture, postures);
        let links: Vec<&str> = robot.links.iter().map(|link| link.name.as_str()).collect();
        if let Some(reach) = &scenario.reach {
            let frames = robot.frames.iter().map(|frame| frame.name.as_str());
            one_of("reach.hand", "frame or link", &reach.hand, frames.chain(links.iter().copied()).collect());
        }
        if !scenario.sensors.imu_link.is_empty() {
            one_of("sensors.imu_link", "link", &scenario.sensors.imu_link, links.clone());
        }
        for joint in scenario.robot.start.joint_offset.keys() {
            let known = robot.joint_names.iter().map(String::as_str).collect();
            one_of("robot.start.joint_offset", "joint", joint, known);
        }
        for push in &scenario.push {
            one_of("push.link", "link", &push.link, links.clone());
        }
        wrong
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

/// How a scenario wants its robot read.
pub(crate) fn load_options(scenario: &Scenario) -> LoadOptions {
    let impossible_inertia = match scenario.robot.accept_impossible_inertia {
        true => ImpossibleInertia::Accept,
        false => ImpossibleInertia::Refuse,
    };
    LoadOptions { impossible_inertia, ..LoadOptions::default() }
}

/// The robot as its scenario wants it: floating, or bolted down at its root link.
pub(crate) fn load_robot(urdf: &Path, scenario: &Scenario) -> Result<RobotModel, RobotError> {
    let options = load_options(scenario);
    let robot = load_with(urdf, &options)?;
    match robot.body_names.first() {
        Some(root) if scenario.robot.base == Base::Fixed && robot.tree.is_floating() => {
            load_with(urdf, &LoadOptions { base: BaseChoice::Fixed(root.clone()), ..options })
        }
        _ => Ok(robot),
    }
}

/// The robot file: relative to the scenario, or else to the working folder.
pub(crate) fn find_robot(scenario: &Path, urdf: &str) -> PathBuf {
    let beside = scenario.parent().unwrap_or(Path::new("")).join(urdf);
    let here = PathBuf::from(urdf);
    if !beside.is_file() && here.is_file() { here } else { beside }
}
