//! `delmpc check`: scenario, companion table and model together, everything that `run` would refuse, all at once.
//!
//! | file | what is checked |
//! |---|---|
//! | a scenario | its keys, each and against each other; its robot; names that the robot must know; posture, torques, controller, plant |
//! | a URDF, or its companion table | what `delmpc model` checks |

use std::path::{Path, PathBuf};

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::prelude::{JointKind, KinematicTree, RigidTransform};
use delmpc_robots::limits::MAX_COMPANION_BYTES;
use delmpc_robots::{LoadOptions, RobotModel, load_with};
use nalgebra::DMatrix;

use crate::input_file;
use crate::output::{line, say};
use crate::robot_controller::RobotController;
use crate::setup::Setup;
use crate::simulated_robot::SimulatedRobot;
use crate::verdict::{Ended, Failure};

/// No motor gives this many times the torque that holds the whole robot out at its full size, nor this many times its weight as a force.
const PLACEHOLDER: f64 = 10.0;

/// Arguments of `delmpc check`.
#[derive(Debug, clap::Args)]
pub struct CheckArguments {
    /// Scenarios, URDFs or companion tables
    #[arg(required = true)]
    pub files: Vec<PathBuf>,
    /// Override a key of the scenarios, for example --set sensors.delay_s=0.01; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Take warnings for errors
    #[arg(long)]
    pub strict: bool,
}

/// What was found: errors keep a scenario from being run, warnings do not.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Findings {
    /// What `run` refuses, each a sentence with file, key or joint, rule and remedy.
    pub errors: Vec<String>,
    /// What `run` says and goes on.
    pub warnings: Vec<String>,
}

impl Findings {
    /// All errors as one failure, if there are any.
    ///
    /// # Errors
    /// [`Failure::Input`], one line for each.
    pub fn refuse(&self) -> Result<(), Failure> {
        match self.errors.as_slice() {
            [] => Ok(()),
            errors => Err(Failure::Input(errors.join("\n"))),
        }
    }
}

/// Runs the command: errors and warnings on standard error, one line a file on standard output.
///
/// # Errors
/// [`Failure::Fault`] when standard output cannot be written.
pub fn check(arguments: &CheckArguments) -> Result<Ended, Failure> {
    let mut refused = false;
    for file in &arguments.files {
        let mut found = findings(file, &arguments.set, arguments.strict);
        if arguments.strict {
            found.errors.append(&mut found.warnings);
        }
        for error in &found.errors {
            say(&format!("error: {error}"));
        }
        for warning in &found.warnings {
            say(&format!("warning: {warning}"));
        }
        let count = |count: usize, what: &str| match count {
            0 => format!("no {what}s"),
            1 => format!("1 {what}"),
            _ => format!("{count} {what}s"),
        };
        let (errors, warnings) = (found.errors.len(), found.warnings.len());
        line(format!("{}: {}, {}", file.display(), count(errors, "error"), count(warnings, "warning")))?;
        refused |= errors > 0;
    }
    Ok(if refused { Ended::Misused } else { Ended::Well })
}

/// Everything about one file.
fn findings(file: &Path, overrides: &[String], strict: bool) -> Findings {
    let extension = file.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
    let beside = file.with_extension("urdf");
    let is_table = extension == "toml"
        && beside.is_file()
        && input_file::read_text(file, MAX_COMPANION_BYTES as u64).is_ok_and(|text| {
            text.lines().any(|line| line.split('=').next().is_some_and(|key| key.trim() == "format"))
        });
    match (extension, is_table) {
        ("urdf" | "xml", _) => of_robot(file, strict),
        (_, true) => of_robot(&beside, strict),
        _ => of_scenario(file, overrides),
    }
}

fn of_robot(urdf: &Path, strict: bool) -> Findings {
    let mut found = Findings::default();
    match load_with(urdf, &LoadOptions { strict, ..LoadOptions::default() }) {
        Err(error) => found.errors.push(error.to_string()),
        Ok(robot) => {
            found.warnings.extend(robot.warnings.iter().cloned());
            match crate::stance::stances(&robot) {
                Ok((_, warnings)) => {
                    found
                        .warnings
                        .extend(warnings.iter().map(|warning| format!("{}: {warning}", urdf.display())));
                }
                Err(error) => found.errors.push(format!("{}: {error}", urdf.display())),
            }
        }
    }
    found
}

fn of_scenario(file: &Path, overrides: &[String]) -> Findings {
    let (setup, mut found) = match Setup::inspect(file, overrides) {
        Ok(inspected) => inspected,
        Err(failure) => return Findings { errors: vec![failure.to_string()], ..Findings::default() },
    };
    let Some(setup) = setup.filter(|_| found.errors.is_empty()) else { return found };
    match RobotController::new(&setup) {
        Err(failure) => found.errors.push(failure.to_string()),
        Ok(controller) => {
            // More than the posture's own accuracy.
            if let Some(left) = controller.out_of_reach_m().filter(|left| *left > 1e-3) {
                found.warnings.push(format!(
                    "{}: `reach.ball_m`: no balanced posture brings the hand nearer to the ball than {left:.3} m",
                    file.display()
                ));
            }
        }
    }
    if let Err(failure) = SimulatedRobot::new(&setup) {
        found.errors.push(failure.to_string());
    }
    found
}

/// Lowers efforts that no motor of such a robot gives: exporters write huge numbers where they know none, and with them a torque weighs
/// nothing. Returns what was lowered, in words.
pub fn clamp_efforts(robot: &mut RobotModel) -> Vec<String> {
    let (torque, force) = largest_efforts(&robot.tree);
    let mut warnings = Vec::new();
    let bodies = robot.tree.bodies().iter().skip(robot.tree.first_joint_body());
    for ((limit, name), body) in robot.limits.iter_mut().zip(&robot.joint_names).zip(bodies) {
        let (largest, unit) = match body.joint.kind {
            JointKind::Revolute => (torque, "N m"),
            JointKind::Prismatic => (force, "N"),
        };
        if limit.effort.is_finite() && limit.effort > largest && largest > 0.0 {
            warnings.push(format!(
                "joint `{name}`: effort {} {unit} is no motor's for a robot of {:.1} kg: {largest:.0} {unit} is used; give the motor's own",
                limit.effort,
                robot.tree.total_mass()
            ));
            limit.effort = largest;
        }
    }
    warnings
}

/// A joint turns next to nothing below this part of the robot's mass times the square of its size.
const NEXT_TO_NOTHING: f64 = 1e-9;
/// Eigenvalues of a matrix with ones on its diagonal are no smaller than this by round-off.
const ROUND_OFF: f64 = 1e-15;

/// Joints that, with all joints at zero, turn next to no inertia when all others are free to give way, and how much, kg m²: point masses on
/// their own axis, or one of several joints that together turn nothing. No motor's torque says anything of their motion. The least one is
/// found first and taken for locked before the next.
pub fn weightless_joints(robot: &RobotModel) -> Vec<(usize, f64)> {
    let tree = &robot.tree;
    let zeros = vec![0.0; tree.joint_count()];
    let configuration = match tree.is_floating() {
        true => Configuration::floating(RigidTransform::identity(), &zeros),
        false => Configuration::fixed(&zeros),
    };
    let dof = tree.dof();
    let mut kinematics = Kinematics::new(tree);
    let mut matrix = vec![0.0; dof * dof];
    let computed = kinematics
        .update_positions(tree, &configuration)
        .and_then(|()| mass_matrix_into(tree, &kinematics, &mut MassMatrixWorkspace::new(tree), &mut matrix));
    if computed.is_err() {
        return Vec::new();
    }
    let (torque, _) = largest_efforts(tree);
    let weight = tree.total_mass() * tree.gravity_w().norm().max(1.0);
    let size = torque / (PLACEHOLDER * weight);
    let nothing = NEXT_TO_NOTHING * tree.total_mass() * size * size;
    let first = dof - tree.joint_count();
    let matrix = DMatrix::from_row_slice(dof, dof, &matrix);
    let mut moving: Vec<usize> = (0..dof).collect();
    let mut found = Vec::new();
    while let Some((coordinate, inertia)) =
        least_inertia(&matrix, &moving, first).filter(|(_, i)| *i < nothing)
    {
        found.push((coordinate - first, inertia));
        moving.retain(|other| *other != coordinate);
    }
    found.sort_by_key(|(joint, _)| *joint);
    found
}

/// Of the coordinates from `first` on, the one with the least `1 / (M⁻¹)_ii`, and that; `M` over the moving coordinates.
fn least_inertia(matrix: &DMatrix<f64>, moving: &[usize], first: usize) -> Option<(usize, f64)> {
    let own = |coordinate: usize| matrix[(coordinate, coordinate)].max(f64::MIN_POSITIVE);
    // With ones on the diagonal: what is small then is small for its kind.
    let scaled = DMatrix::from_fn(moving.len(), moving.len(), |row, column| {
        matrix[(moving[row], moving[column])] / (own(moving[row]) * own(moving[column])).sqrt()
    });
    let modes = scaled.symmetric_eigen();
    let inertia = |place: usize| {
        let parts = modes.eigenvalues.iter().enumerate();
        let inverse: f64 =
            parts.map(|(mode, value)| modes.eigenvectors[(place, mode)].powi(2) / value.max(ROUND_OFF)).sum();
        own(moving[place]) / inverse
    };
    let joints = (0..moving.len()).filter(|place| moving[*place] >= first);
    joints.map(|place| (moving[place], inertia(place))).min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Torque and force that no joint of the robot needs.
fn largest_efforts(tree: &KinematicTree) -> (f64, f64) {
    let zeros = vec![0.0; tree.joint_count()];
    let configuration = match tree.is_floating() {
        true => Configuration::floating(RigidTransform::identity(), &zeros),
        false => Configuration::fixed(&zeros),
    };
    let mut kinematics = Kinematics::new(tree);
    if kinematics.update_positions(tree, &configuration).is_err() {
        return (f64::INFINITY, f64::INFINITY);
    }
    let poses = kinematics.link_poses_w();
    let start = (poses.first().map_or_else(nalgebra::Vector3::zeros, |pose| pose.translation), 0.0);
    let size = poses.iter().fold(start, |(from, size): (nalgebra::Vector3<f64>, f64), pose| {
        (from, size.max((pose.translation - from).norm()))
    });
    let weight = tree.total_mass() * tree.gravity_w().norm();
    (PLACEHOLDER * weight * 2.0 * size.1.max(0.05), 10.0 * PLACEHOLDER * weight)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two joints on one axis with next to nothing between them: each turns the lever, both against each other turn nothing.
    #[test]
    fn joints_that_together_turn_nothing_are_found() {
        let link = |name: &str, mass: f64, size: f64| {
            format!(
                "<link name='{name}'><inertial><origin xyz='0 0.2 0'/><mass value='{mass}'/><inertia ixx='{size}' ixy='0' ixz='0' iyy='{size}' iyz='0' izz='{size}'/></inertial></link>"
            )
        };
        let joint = |name: &str, parent: &str, child: &str| {
            format!(
                "<joint name='{name}' type='revolute'><parent link='{parent}'/><child link='{child}'/><axis xyz='1 0 0'/><limit lower='-1' upper='1' effort='5' velocity='5'/></joint>"
            )
        };
        let robot = |between: f64| {
            let text = [
                "<robot name='a'>".to_owned(),
                link("base", 5.0, 0.05),
                joint("first", "base", "ring"),
                link("ring", between, 0.01 * between),
                joint("second", "ring", "lever"),
                link("lever", 1.0, 0.01),
                "</robot>".to_owned(),
            ];
            delmpc_robots::load_str("a.urdf", &text.concat(), None, &LoadOptions::default()).unwrap()
        };
        assert_eq!(weightless_joints(&robot(0.1)), []);
        let found = weightless_joints(&robot(1e-12));
        assert_eq!(found.len(), 1, "the other one turns the lever when this one is locked: {found:?}");
        assert!(found[0].1 < 1e-10, "{found:?}");
    }
}
