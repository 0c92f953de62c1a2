//! `delmpc model`: check a robot model; print its table, or everything computed from it at a given state.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use delmpc_mechanics::energy::{kinetic_energy, potential_energy};
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{base_link_pose, base_pose_from_link};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::prelude::{
    InputHold, Integrator, KinematicTree, Linearizer, LobattoRule, RigidTransform, State, StateCoordinates,
    StepForces, StepOptions, Twist,
};
use delmpc_mechanics::velocity::VelocityWorkspace;
use delmpc_robots::{BaseChoice, ImpossibleInertia, LoadOptions, RobotModel, load_with};
use delmpc_scenario::Scenario;
use nalgebra::{DMatrix, DVector, Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::board_robot::BoardRobot;
use crate::drawing::drawing;
use crate::init::files::posture_text;
use crate::init::posture::stand_on;
use crate::input_file::read_answerable;
use crate::model_table::table;
use crate::output::{line, print, printable};
use crate::output_file;
use crate::setup::Setup;
use crate::verdict::{Ended, Failure};

/// Largest file of `--at`, bytes.
const MOST_QUESTION: u64 = 16 << 20;

/// Arguments of `delmpc model`.
#[derive(Debug, clap::Args)]
pub struct ModelArguments {
    /// Robot description; the companion table `ROBOT.toml` beside it is read too
    pub urdf: PathBuf,
    /// `floating`, or `fixed:NAME` with a link or a frame of the companion table
    #[arg(long, value_name = "BASE")]
    pub base: Option<String>,
    /// State and step as JSON; the answer is one JSON object
    #[arg(long, value_name = "FILE.json")]
    pub at: Option<PathBuf>,
    /// Take inertias that no body has as they are and hold joints that carry no mass, with a warning; the same key is in the companion table
    #[arg(long)]
    pub accept_impossible_inertia: bool,
    /// Refuse what is read with a warning: decoration that cannot be read, values that are missing
    #[arg(long)]
    pub strict: bool,
    /// Solve for a posture on that sole of the companion table and print it as TOML, to be added there
    #[arg(long, value_name = "SOLE", conflicts_with_all = ["at", "svg"])]
    pub stand: Option<String>,
    /// Print the robot as constants for a `no_std` build: tree, limits, soles, posture, weights, watchdog
    #[arg(long, value_name = "LANGUAGE", conflicts_with_all = ["at", "svg", "stand", "base"])]
    pub emit: Option<Language>,
    /// Scenario that says stance, posture, weights, horizon and sensors of `--emit` [default: first sole and posture, default values]
    #[arg(long, value_name = "SCENARIO.toml", requires = "emit")]
    pub scenario: Option<PathBuf>,
    /// Override a key of that scenario
    #[arg(long, value_name = "KEY=VALUE", requires = "scenario")]
    pub set: Vec<String>,
    /// Draw the robot in its postures
    #[arg(long, value_name = "FILE.svg", conflicts_with = "at")]
    pub svg: Option<PathBuf>,
}

/// A language of `--emit`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Language {
    /// Rust.
    Rust,
}

/// The robot as source: of the scenario, or of the URDF alone.
fn emit(arguments: &ModelArguments) -> Result<String, Failure> {
    let setup = match &arguments.scenario {
        Some(file) => {
            let setup = Setup::read(file, &arguments.set)?;
            let same =
                |a: &Path, b: &Path| matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b);
            if !same(&setup.urdf, &arguments.urdf) {
                return Err(Failure::Input(format!(
                    "--scenario {}: its robot is {}, not {}",
                    file.display(),
                    setup.urdf.display(),
                    arguments.urdf.display()
                )));
            }
            setup
        }
        None => {
            let robot = load_robot(arguments, None, None)?;
            let mut scenario = Scenario { name: robot.name.clone(), ..Scenario::default() };
            let missing = |what: &str| {
                Failure::Input(format!("{}: no {what} in its companion table", arguments.urdf.display()))
            };
            let sole = robot.soles.first().ok_or_else(|| missing("sole"))?;
            scenario.robot.stance = sole.name.as_str().into();
            scenario.robot.posture = robot.postures.first().ok_or_else(|| missing("posture"))?.name.clone();
            Setup { scenario, robot, urdf: arguments.urdf.clone(), plan: None, notes: Vec::new() }
        }
    };
    Ok(BoardRobot::new(&setup)?.rust())
}

/// Runs the command.
///
/// # Errors
/// A model or a state file that cannot be used.
pub fn model(arguments: &ModelArguments) -> Result<Ended, Failure> {
    if arguments.emit == Some(Language::Rust) {
        print(&emit(arguments)?)?;
        return Ok(Ended::Well);
    }
    match &arguments.at {
        Some(file) => {
            let question = read_question(file)?;
            let base = arguments.base.clone().or_else(|| question.base.clone());
            let robot = load_robot(arguments, base.as_deref(), question.gravity)?;
            let answer = answer(&robot, &question)
                .map_err(|error| Failure::Input(format!("{}: {error}", file.display())))?;
            line(
                in_numbers(&answer)
                    .map_err(|error| Failure::Input(format!("{}: {error}", file.display())))?,
            )?;
        }
        None => {
            let robot = load_robot(arguments, arguments.base.as_deref(), None)?;
            if let Some(sole) = &arguments.stand {
                let standing = stand_on(&robot, sole)
                    .map_err(|error| Failure::Input(format!("{}: {error}", arguments.urdf.display())))?;
                let taken = |name: &String| robot.posture(name).is_some();
                let names = (1..).map(|n| if n == 1 { "stand".to_owned() } else { format!("stand_{n}") });
                let name = names.take(100).find(|name| !taken(name)).unwrap_or_default();
                print(&posture_text(&name, &standing, &robot.joint_names, true))?;
                return Ok(Ended::Well);
            }
            print(&printable(&table(&robot)?))?;
            if let Some(file) = &arguments.svg {
                let svg = drawing(&robot).map_err(Failure::input)?;
                output_file::write_named(file, svg)
                    .map_err(|error| Failure::Input(format!("--svg {}: {error}", file.display())))?;
            }
        }
    }
    Ok(Ended::Well)
}

/// A state and a step: the file given to `--at`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Question {
    q: BTreeMap<String, f64>,
    qdot: BTreeMap<String, f64>,
    u: Option<BTreeMap<String, f64>>,
    u_nodes: Option<Vec<BTreeMap<String, f64>>>,
    dt: Option<f64>,
    order: Order,
    gravity: Option<[f64; 3]>,
    base: Option<String>,
    base_pose: BasePose,
    base_twist: BaseTwist,
}

/// Nodes of the integrator.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Order {
    Trapezoidal,
    #[default]
    Simpson,
    Lobatto3,
    Lobatto4,
}

/// Pose of the base link frame in the world.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct BasePose {
    xyz: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

impl Default for BasePose {
    fn default() -> Self {
        Self { xyz: [0.0; 3], quaternion_xyzw: [0.0, 0.0, 0.0, 1.0] }
    }
}

/// Velocity of the base link and of its origin, in the axes of the base link.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct BaseTwist {
    angular: [f64; 3],
    linear: [f64; 3],
}

/// Everything computed. Vectors and matrices are over the joints; those of a floating base begin with six coordinates of the base link:
/// angular, then linear, in its own axes at its origin.
#[derive(Debug, Default, Serialize)]
struct Answer {
    joints: Vec<String>,
    floating: bool,
    total_mass: f64,
    com: [f64; 3],
    mass_matrix: Vec<Vec<f64>>,
    gravity_torque: Vec<f64>,
    kinetic_energy: f64,
    potential_energy: f64,
    p: Vec<f64>,
    #[serde(flatten)]
    step: Option<StepAnswer>,
}

/// What one step gives.
#[derive(Debug, Serialize)]
struct StepAnswer {
    q_next: Vec<f64>,
    p_next: Vec<f64>,
    qdot_next: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_pose_next: Option<BasePoseAnswer>,
    newton_iterations: usize,
    #[serde(rename = "A")]
    a: Vec<Vec<f64>>,
    #[serde(rename = "B")]
    b: Vec<Vec<f64>>,
}

#[derive(Debug, Serialize)]
struct BasePoseAnswer {
    xyz: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

fn read_question(file: &Path) -> Result<Question, Failure> {
    let name = file.display();
    let text = read_answerable(file, MOST_QUESTION)
        .map_err(|error| Failure::Input(format!("{name}: cannot be read ({error}): give a JSON file")))?;
    serde_json::from_str(&text).map_err(|error| Failure::Input(format!("{name}: {error}")))
}

/// The answer to the text of a file of `--at`, as JSON; base and gravity are those of `robot`.
///
/// # Errors
/// What is wrong with the question, in words.
pub fn answer_to(robot: &RobotModel, text: &str) -> Result<String, String> {
    let question: Question = serde_json::from_str(text).map_err(|error| error.to_string())?;
    in_numbers(&answer(robot, &question)?)
}

/// An answer as JSON.
///
/// # Errors
/// When something in it is not finite, which JSON cannot say.
fn in_numbers(answer: &Answer) -> Result<String, String> {
    let value = serde_json::to_value(answer).map_err(|error| error.to_string())?;
    match not_a_number(&value) {
        None => serde_json::to_string(answer).map_err(|error| error.to_string()),
        Some(place) => Err(format!("`{place}` of the answer is not finite: some number given is too large")),
    }
}

/// Where in a value there is nothing.
fn not_a_number(value: &serde_json::Value) -> Option<String> {
    match value {
        serde_json::Value::Null => Some(String::new()),
        serde_json::Value::Array(list) => list
            .iter()
            .enumerate()
            .find_map(|(index, value)| not_a_number(value).map(|place| format!("[{index}]{place}"))),
        serde_json::Value::Object(map) => {
            map.iter().find_map(|(key, value)| not_a_number(value).map(|place| format!("{key}{place}")))
        }
        _ => None,
    }
}

/// Loads a robot with the base of the command line.
fn load_robot(
    arguments: &ModelArguments,
    base: Option<&str>,
    gravity: Option<[f64; 3]>,
) -> Result<RobotModel, Failure> {
    let urdf = arguments.urdf.as_path();
    let mut options = LoadOptions { strict: arguments.strict, ..LoadOptions::default() };
    if arguments.accept_impossible_inertia {
        options.impossible_inertia = ImpossibleInertia::Accept;
    }
    if let Some(gravity) = gravity {
        options.gravity_w = Vector3::from(gravity);
    }
    let fixed_at = match base {
        None => None,
        Some("floating") => {
            options.base = BaseChoice::Floating;
            None
        }
        Some(other) => match other.strip_prefix("fixed:").filter(|name| !name.is_empty()) {
            Some(name) => Some(name),
            None => {
                return Err(Failure::Input(format!(
                    "base `{other}`: write `floating` or `fixed:NAME` with the name of a link"
                )));
            }
        },
    };
    let Some(name) = fixed_at else {
        return load_with(urdf, &options).map_err(Failure::input);
    };
    options.base = BaseChoice::Fixed(name.to_owned());
    let as_link = load_with(urdf, &options);
    // A frame of the companion table, such as a sole.
    options.base = BaseChoice::Auto;
    match as_link {
        Ok(robot) => Ok(robot),
        Err(error) => {
            let floating = load_with(urdf, &options).map_err(|_| Failure::input(&error))?;
            Ok(floating.rooted_at(name).map_err(|_| Failure::input(&error))?.model)
        }
    }
}

fn answer(robot: &RobotModel, question: &Question) -> Result<Answer, String> {
    let tree = &robot.tree;
    let base = BaseFrame::new(tree, &question.base_pose)?;
    let mut state = State::zeros(tree);
    state.base_pose = base.pose_w;
    state.q = by_joint(robot, &question.q, "q")?;
    let joint_rates = by_joint(robot, &question.qdot, "qdot")?;
    let twist_b = Twist::new(question.base_twist.angular.into(), question.base_twist.linear.into());
    let twist_w = base.link_pose_w.transform_twist(&twist_b);

    let mut velocity = Vec::new();
    if tree.is_floating() {
        velocity.extend(twist_w.to_vector().iter());
    }
    velocity.extend(&joint_rates);
    let mut velocities = VelocityWorkspace::new(tree);
    velocities.set_velocity(tree, &mut state, &velocity).map_err(|error| error.to_string())?;

    let kinematics = velocities.kinematics();
    let dof = tree.dof();
    let mut mass_matrix = vec![0.0; dof * dof];
    mass_matrix_into(tree, kinematics, &mut MassMatrixWorkspace::new(tree), &mut mass_matrix)
        .map_err(|error| error.to_string())?;
    let mut gravity = vec![0.0; dof];
    gravity_force_into(tree, kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut gravity)
        .map_err(|error| error.to_string())?;
    let mass_matrix = DMatrix::from_row_slice(dof, dof, &mass_matrix);
    let map = base.velocity_map(tree);
    let mut answer = Answer {
        joints: robot.joint_names.clone(),
        floating: tree.is_floating(),
        total_mass: tree.total_mass(),
        com: kinematics.mass_centre_of_tree_w(tree).into(),
        mass_matrix: rows(&(map.transpose() * mass_matrix * &map)),
        gravity_torque: (map.transpose() * DVector::from_vec(gravity)).as_slice().to_vec(),
        kinetic_energy: kinetic_energy(tree, kinematics),
        potential_energy: potential_energy(tree, kinematics, &state.q).map_err(|error| error.to_string())?,
        p: (map.transpose() * DVector::from_column_slice(&state.p)).as_slice().to_vec(),
        step: None,
    };
    if let Some(dt) = question.dt {
        answer.step = Some(step(robot, question, dt, &state, &base)?);
    }
    Ok(answer)
}

fn step(
    robot: &RobotModel,
    question: &Question,
    dt: f64,
    state: &State,
    base: &BaseFrame,
) -> Result<StepAnswer, String> {
    let tree = &robot.tree;
    let nodes = match question.order {
        Order::Trapezoidal => 1,
        Order::Simpson => 2,
        Order::Lobatto3 => 3,
        Order::Lobatto4 => 4,
    };
    let rule = LobattoRule::new(nodes).map_err(|error| error.to_string())?;
    // Whoever asks about one step may ask about a wild one.
    let options = StepOptions { turn_limit: f64::INFINITY, ..StepOptions::default() };
    let mut integrator = Integrator::new(tree, &rule, dt, options).map_err(|error| error.to_string())?;
    let inputs: Vec<f64>;
    let forces = match (&question.u, &question.u_nodes) {
        (Some(_), Some(_)) => return Err("both `u` and `u_nodes`: give one".to_owned()),
        (_, Some(per_node)) if per_node.len() != nodes + 1 => {
            return Err(format!(
                "`u_nodes` has {} entries: this order has {} nodes",
                per_node.len(),
                nodes + 1
            ));
        }
        (_, Some(per_node)) => {
            let each = per_node.iter().map(|u| by_joint(robot, u, "u_nodes"));
            inputs = each.collect::<Result<Vec<_>, _>>()?.concat();
            StepForces::per_node(&inputs)
        }
        (u, None) => {
            inputs = by_joint(robot, u.as_ref().unwrap_or(&BTreeMap::new()), "u")?;
            StepForces::held(&inputs)
        }
    };
    let report = integrator.solve(tree, state, &forces).map_err(|error| error.to_string())?;
    let next = integrator.next_state().clone();
    let mut velocity = vec![0.0; tree.dof()];
    integrator.velocities().velocity_into(tree, &next, &mut velocity).map_err(|error| error.to_string())?;
    let mut linearizer = Linearizer::new(tree, &integrator, StateCoordinates::Momentum, InputHold::Held)
        .map_err(|error| error.to_string())?;
    let linear = linearizer.linearize(tree, &mut integrator).map_err(|error| error.to_string())?;

    let dof = tree.dof();
    let a = DMatrix::from_fn(2 * dof, 2 * dof, |row, column| linear.a(row, column));
    let b = DMatrix::from_fn(2 * dof, linear.inputs(), |row, column| linear.b(row, column));
    let (to_link, from_link) = base.error_map(tree);
    let after = BaseFrame::at(tree, next.base_pose);
    let map = after.velocity_map(tree);
    let joint_rates = DVector::from_vec(velocity);
    let qdot_next = map.clone().lu().solve(&joint_rates).ok_or("the base pose is not a rigid motion")?;
    Ok(StepAnswer {
        q_next: next.q.clone(),
        p_next: (map.transpose() * DVector::from_column_slice(&next.p)).as_slice().to_vec(),
        qdot_next: qdot_next.as_slice().to_vec(),
        base_pose_next: tree.is_floating().then(|| after.answer()),
        newton_iterations: report.iterations,
        a: rows(&(&to_link * a * from_link)),
        b: rows(&(to_link * b)),
    })
}

/// The base link frame, and the changes of coordinates from what the mechanics uses to it.
struct BaseFrame {
    /// What the mechanics takes: origin at the mass centre.
    pose_w: RigidTransform,
    link_pose_w: RigidTransform,
}

impl BaseFrame {
    fn new(tree: &KinematicTree, pose: &BasePose) -> Result<Self, String> {
        let [x, y, z, w] = pose.quaternion_xyzw;
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        if !tree.is_floating() {
            let identity = RigidTransform::identity();
            return Ok(Self { pose_w: identity, link_pose_w: identity });
        }
        if !(norm > 0.5 && norm < 2.0) {
            return Err(format!("`base_pose.quaternion_xyzw` has the length {norm}, must be 1"));
        }
        let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner();
        let link_pose_w = RigidTransform { rotation, translation: pose.xyz.into() };
        Ok(Self { pose_w: base_pose_from_link(tree, &link_pose_w), link_pose_w })
    }

    fn at(tree: &KinematicTree, pose_w: RigidTransform) -> Self {
        let link_pose_w = if tree.is_floating() { base_link_pose(tree, &pose_w) } else { pose_w };
        Self { pose_w, link_pose_w }
    }

    fn answer(&self) -> BasePoseAnswer {
        let quaternion = UnitQuaternion::from_matrix(&self.link_pose_w.rotation);
        BasePoseAnswer { xyz: self.link_pose_w.translation.into(), quaternion_xyzw: quaternion.coords.into() }
    }

    /// From velocities in our coordinates to those of the mechanics: the twist of the link to the spatial one.
    fn velocity_map(&self, tree: &KinematicTree) -> DMatrix<f64> {
        let mut map = DMatrix::identity(tree.dof(), tree.dof());
        if tree.is_floating() {
            map.view_mut((0, 0), (6, 6)).copy_from(&self.link_pose_w.adjoint());
        }
        map
    }

    /// From state errors `(ε, δq, δπ, δp)` at the mass centre of the base to those at the link's origin, and back.
    fn error_map(&self, tree: &KinematicTree) -> (DMatrix<f64>, DMatrix<f64>) {
        let dof = tree.dof();
        let mut to_link = DMatrix::identity(2 * dof, 2 * dof);
        let mut from_link = to_link.clone();
        if tree.is_floating() {
            let link_in_body = delmpc_mechanics::spatial::RigidTransform {
                rotation: self.pose_w.rotation.tr_mul(&self.link_pose_w.rotation),
                translation: self
                    .pose_w
                    .rotation
                    .tr_mul(&(self.link_pose_w.translation - self.pose_w.translation)),
            };
            let (forward, backward) = (link_in_body.inverse().adjoint(), link_in_body.adjoint());
            to_link.view_mut((0, 0), (6, 6)).copy_from(&forward);
            from_link.view_mut((0, 0), (6, 6)).copy_from(&backward);
            to_link.view_mut((dof, dof), (6, 6)).copy_from(&backward.transpose());
            from_link.view_mut((dof, dof), (6, 6)).copy_from(&forward.transpose());
        }
        (to_link, from_link)
    }
}

/// Values by joint name as a vector in joint order; missing joints are 0.
fn by_joint(robot: &RobotModel, values: &BTreeMap<String, f64>, what: &str) -> Result<Vec<f64>, String> {
    let mut vector = vec![0.0; robot.joint_names.len()];
    for (name, value) in values {
        let joint = robot.joint(name).ok_or_else(|| {
            format!(
                "`{what}.{name}`: the robot has no such joint; its joints are {}",
                robot.joint_names.join(", ")
            )
        })?;
        vector[joint] = *value;
    }
    Ok(vector)
}

fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}
