//! `delmpc init`: a companion table and a scenario for a robot that has none.
//!
//! | file | what it does |
//! |---|---|
//! | [`feet`], [`tip`] | soles and tips of feet from shapes |
//! | [`posture`], [`feet_posture`], [`arm_posture`] | a posture on one sole, on several feet, bolted down |
//! | [`gauss_newton`] | what solves for it |
//! | [`files`], [`mod@scenario_text`] | the texts of the two files |
//!
//! What `init` writes runs as it is; the files are the user's from then on.

pub mod arm_posture;
pub mod feet;
pub mod feet_posture;
pub mod files;
pub mod gauss_newton;
pub mod posture;
pub mod scenario_text;
pub mod tip;

use std::path::{Path, PathBuf};

use delmpc_messages::MAX_JOINTS;
use delmpc_robots::limits::MAX_URDF_BYTES;
use delmpc_robots::{
    BaseChoice, Companion, ImpossibleInertia, LoadOptions, RobotError, RobotModel, Rule, load_str, load_with,
};

use crate::check::weightless_joints;
use crate::init::feet::{FoundFoot, NoFeet, find_feet};
use crate::init::files::Table;
use crate::init::scenario_text::{Size, Support, scenario_text};
use crate::input_file;
use crate::output::{line, say};
use crate::output_file;
use crate::robot_controller::RobotController;
use crate::setup::Setup;
use crate::verdict::{Ended, Failure};

/// How far the hand reaches out in the scenario, m.
const REACH_M: f64 = 0.1;
/// A hand that stays this near to its ball in the balanced posture reaches it, m.
const REACHED_M: f64 = 2e-3;

/// Which feet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Stand {
    /// The right one.
    Right,
    /// The left one.
    Left,
    /// The two of a robot that has two.
    Both,
    /// All it has.
    All,
}

/// Arguments of `delmpc init`.
#[derive(Debug, clap::Args)]
pub struct InitArguments {
    /// Robot description
    pub urdf: PathBuf,
    /// Feet it stands on [default: right; all of more than two]
    #[arg(long, value_enum)]
    pub stand: Option<Stand>,
    /// Folder for the robot, its table and its scenario [default: the name of the URDF]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Overwrite files that are there
    #[arg(long)]
    pub force: bool,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a robot that cannot be made to stand, with the reason; files that are there already.
pub fn init(arguments: &InitArguments) -> Result<Ended, Failure> {
    let urdf = &arguments.urdf;
    let stem = urdf.file_stem().and_then(|stem| stem.to_str()).unwrap_or("robot");
    let folder = arguments.out.clone().unwrap_or_else(|| PathBuf::from(stem));
    let place = |name: String| folder.join(name);
    let (robot_file, table_file) = (place(format!("{stem}.urdf")), place(format!("{stem}.toml")));
    let scenario_file = place("stand.toml".to_owned());
    if stem == "stand" {
        return Err(Failure::Input(format!(
            "{}: the scenario is called stand.toml: rename the robot",
            urdf.display()
        )));
    }
    let same =
        |file: &Path| file.canonicalize().ok().is_some_and(|file| urdf.canonicalize().ok() == Some(file));
    for file in [&robot_file, &table_file, &scenario_file] {
        if file.exists() && !arguments.force && !same(file) {
            return Err(Failure::Input(format!(
                "{}: is there already: give another folder with --out, or --force",
                file.display()
            )));
        }
    }
    let text = input_file::read_text(urdf, MAX_URDF_BYTES as u64).map_err(|error| {
        Failure::Input(format!("{}: cannot be read ({error}): give a URDF file", urdf.display()))
    })?;
    let made = make(urdf, &text, arguments.stand)?;

    let write = |file: &Path, text: &str| {
        output_file::write_named(file, text)
            .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))
    };
    std::fs::create_dir_all(&folder)
        .map_err(|error| Failure::Fault(format!("{}: {error}", folder.display())))?;
    if !same(&robot_file) {
        write(&robot_file, &text)?;
    }
    write(&table_file, &made.table)?;
    let scenario = with_a_ball(&made, &scenario_file, stem, write)?;
    write(&scenario_file, &scenario)?;
    for warning in &made.warnings {
        say(&format!("warning: {warning}"));
    }
    for file in [&robot_file, &table_file, &scenario_file] {
        line(file.display())?;
    }
    Ok(Ended::Well)
}

/// A robot that stands.
struct Made {
    robot: RobotModel,
    table: String,
    stands: Stands,
    size: Size,
    warnings: Vec<String>,
}

/// What it stands on.
enum Stands {
    OnSole(String),
    OnAllFeet,
    /// Bolted down; its hand.
    Bolted(arm_posture::Hand),
}

impl Stands {
    fn support(&self) -> Support<'_> {
        match self {
            Self::OnSole(sole) => Support::Sole(sole),
            Self::OnAllFeet => Support::AllFeet,
            Self::Bolted(_) => Support::Bolted,
        }
    }
}

fn make(urdf: &Path, text: &str, stand: Option<Stand>) -> Result<Made, Failure> {
    let named = |why: String| Failure::Input(format!("{}: {why}", urdf.display()));
    let mut table = Table::default();
    let bare = load_bare(urdf, &mut table)?;
    // Where the meshes are, for the copy of the URDF.
    let folder = urdf.parent().map(|folder| if folder == Path::new("") { Path::new(".") } else { folder });
    table.mesh_folder = folder.and_then(|folder| folder.canonicalize().ok());
    let options = LoadOptions::default();
    let load = |table: &Table| load_str(urdf, text, Some(&table.text()), &options).map_err(Failure::input);
    lock_joints(&bare, &mut table);
    let robot = load(&table)?;
    table.feet = match find_feet(&robot) {
        Ok(feet) => feet,
        Err(NoFeet::Fixed) => return bolted(urdf, text, stand, table, &robot),
        Err(why) => return Err(named(why.to_string())),
    };
    lock_most(&robot, &mut table);
    let sole = stance(&table.feet, stand).map_err(named)?;
    let robot = load(&table)?;
    table.hands = files::hands(&robot);
    let standing = match &sole {
        Some(sole) => posture::stand_on(&robot, sole),
        None => feet_posture::stand_on_feet(&robot, &table.feet),
    };
    let standing = standing.map_err(named)?;
    feet_posture::place_tips(&robot, &standing, &mut table.feet).map_err(|error| named(error.to_string()))?;
    table.posture = Some((standing.clone(), robot.joint_names.clone()));
    let robot = load(&table)?;
    let stands = sole.map_or(Stands::OnAllFeet, Stands::OnSole);
    let size = Size::of(&robot, stands.support(), &standing);
    let mut warnings = robot.warnings.clone();
    warnings.extend(table.notes.iter().cloned());
    Ok(Made { table: table.text(), robot, stands, size, warnings })
}

/// A robot without feet.
fn bolted(
    urdf: &Path,
    text: &str,
    stand: Option<Stand>,
    mut table: Table,
    found: &RobotModel,
) -> Result<Made, Failure> {
    let named = |why: String| Failure::Input(format!("{}: {why}", urdf.display()));
    if stand.is_some() {
        return Err(named(format!("--stand: {}", NoFeet::Fixed)));
    }
    let base = match found.tree.is_floating() {
        true => BaseChoice::Fixed(found.body_names.first().cloned().unwrap_or_default()),
        false => BaseChoice::Auto,
    };
    let options = LoadOptions { base, ..LoadOptions::default() };
    lock_most(found, &mut table);
    let load = |table: &Table| load_str(urdf, text, Some(&table.text()), &options).map_err(Failure::input);
    let robot = load(&table)?;
    let hand = arm_posture::hand(&robot).ok_or_else(|| named("it has no joint that moves".to_owned()))?;
    table.is_bolted = true;
    table.hands = vec![hand.clone()];
    let standing = arm_posture::bolted(&robot, &hand).map_err(named)?;
    table.posture = Some((standing.clone(), robot.joint_names.clone()));
    let robot = load(&table)?;
    let size = Size::of_arm(&robot, &hand.0, &standing);
    let mut warnings = robot.warnings.clone();
    warnings.extend(table.notes.iter().cloned());
    Ok(Made { table: table.text(), robot, stands: Stands::Bolted(hand), size, warnings })
}

/// Without a table, with impossible inertias accepted where it has to be.
fn load_bare(urdf: &Path, table: &mut Table) -> Result<RobotModel, Failure> {
    let options = LoadOptions { companion: Companion::None, ..LoadOptions::default() };
    let refused: RobotError = match load_with(urdf, &options) {
        Ok(robot) => return Ok(robot),
        Err(error) => error,
    };
    if !matches!(refused.rule(), Rule::Physics(_) | Rule::MissingInertial) {
        return Err(Failure::input(refused));
    }
    let accept = LoadOptions { impossible_inertia: ImpossibleInertia::Accept, ..options };
    let robot = load_with(urdf, &accept).map_err(|_| Failure::input(&refused))?;
    table.accept_impossible_inertia = true;
    table.notes.push(format!("{refused} It is accepted: accept_impossible_inertia"));
    Ok(robot)
}

/// Locks what no motor drives: followers, joints without torque, speed or range.
fn lock_joints(robot: &RobotModel, table: &mut Table) {
    let weightless: Vec<usize> = weightless_joints(robot).into_iter().map(|(joint, _)| joint).collect();
    for (joint, name) in robot.joint_names.iter().enumerate() {
        let limits = &robot.limits[joint];
        let why = if !robot.actuated[joint] {
            "it follows another joint or has no motor"
        } else if limits.effort <= 0.0 {
            "its effort is 0"
        } else if limits.velocity <= 0.0 {
            "its velocity is 0"
        } else if limits.lower >= limits.upper {
            "it has no range"
        } else if weightless.contains(&joint) {
            "it turns no inertia"
        } else {
            continue;
        };
        // A follower is where it is when the other joint is at 0.
        let (_, _, offset) = robot.coordinate_map.row(joint);
        let at = offset.clamp(limits.lower, limits.upper.max(limits.lower));
        table.locked.push((name.clone(), at, why));
    }
}

/// Locks the joints that carry the least until the others fit into a message; legs never.
fn lock_most(robot: &RobotModel, table: &mut Table) {
    let tree = &robot.tree;
    let first = tree.first_joint_body();
    let mut carried: Vec<f64> = tree.bodies().iter().map(|body| body.inertia.mass).collect();
    for body in (0..carried.len()).rev() {
        if let Some(parent) = tree.bodies()[body].parent {
            carried[parent] += carried[body];
        }
    }
    let on_the_way_to = |body: usize, mut leaf: Option<usize>| loop {
        match leaf {
            Some(at) if at == body => break true,
            Some(at) => leaf = tree.bodies()[at].parent,
            None => break false,
        }
    };
    let is_leg = |body: usize| {
        let foot = |foot: &FoundFoot| robot.link(&foot.link).and_then(|link| link.body);
        table.feet.iter().any(|found| on_the_way_to(body, foot(found)))
    };
    let mut joints: Vec<usize> =
        (0..robot.joint_names.len()).filter(|joint| !is_leg(joint + first)).collect();
    joints.sort_by(|a, b| carried[a + first].total_cmp(&carried[b + first]));
    let too_many = robot.joint_names.len().saturating_sub(MAX_JOINTS);
    for joint in joints.into_iter().take(too_many) {
        let limits = &robot.limits[joint];
        let at = 0.0_f64.clamp(limits.lower, limits.upper);
        table.locked.push((robot.joint_names[joint].clone(), at, "a message has no room for it"));
    }
}

/// The name of the one sole to stand on; nothing: on all of them.
fn stance(feet: &[FoundFoot], stand: Option<Stand>) -> Result<Option<String>, String> {
    let names = || feet.iter().map(|foot| foot.name.as_str()).collect::<Vec<_>>().join(", ");
    let wanted = match stand {
        None if feet.len() > 2 => return Ok(None),
        Some(Stand::All) if feet.len() > 1 => return Ok(None),
        Some(Stand::Both) if feet.len() == 2 => return Ok(None),
        Some(Stand::Both) => {
            return Err(format!(
                "--stand both: the robot has not two feet, but {} ({})",
                feet.len(),
                names()
            ));
        }
        Some(Stand::Left) => "left",
        None | Some(Stand::Right | Stand::All) => "right",
    };
    let only = (feet.len() == 1).then(|| feet.first()).flatten();
    let sole = only.or_else(|| feet.iter().find(|foot| foot.name == wanted));
    match sole {
        Some(foot) if foot.tip.is_none() => Ok(Some(foot.name.clone())),
        _ => Err(format!(
            "the robot has the feet {}, and no sole `{wanted}` to stand on alone: --stand all",
            names()
        )),
    }
}

/// The scenario with a ball that the robot can reach in balance, if it has a hand.
fn with_a_ball(
    made: &Made,
    file: &Path,
    stem: &str,
    write: impl Fn(&Path, &str) -> Result<(), Failure>,
) -> Result<String, Failure> {
    let Made { robot, stands, size, .. } = made;
    let support = stands.support();
    let without = scenario_text(robot, stem, support, size, None);
    let hands = match stands {
        Stands::OnSole(sole) => files::hands_at_home(robot, sole),
        // The controller has no task for hands there.
        Stands::OnAllFeet => Vec::new(),
        Stands::Bolted((hand, ..)) => vec![(hand.clone(), size.hand.into())],
    };
    for (hand, at) in hands {
        for direction in [[1.0, 0.0, 0.0], [0.7, 0.0, 0.7], [0.0, 0.0, 1.0], [0.7, 0.0, -0.7]] {
            let ball: [f64; 3] = std::array::from_fn(|axis| at[axis] + REACH_M * direction[axis]);
            let text = scenario_text(robot, stem, support, size, Some((&hand, ball)));
            write(file, &text)?;
            let setup = Setup::read(file, &[])?;
            let left = RobotController::new(&setup)?.out_of_reach_m();
            if left.is_some_and(|left| left <= REACHED_M) {
                return Ok(text);
            }
        }
    }
    write(file, &without)?;
    RobotController::new(&Setup::read(file, &[])?)?;
    Ok(without)
}
