//! How a robot stands in its postures: which soles are on the ground, where the mass centre is over them, what the motors must hold.

use std::fmt::Write as _;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{Posture, RobotModel, Sole};
use nalgebra::Vector3;

use crate::output::name_in_table;
use crate::setup::Setup;
use crate::sole::cop_margin_m;

/// A sole counts as on the ground up to this height of its frame (m) ...
const ON_GROUND_M: f64 = 1e-3;
/// ... and this lean (rad).
const FLAT_RAD: f64 = 2e-3;

/// A sole in a posture; the ground is z = 0.
struct Stance<'a> {
    posture: &'a str,
    sole: &'a Sole,
    height_m: f64,
    lean_rad: f64,
    /// The robot's mass centre in the frame of the sole.
    com_m: Vector3<f64>,
}

impl Stance<'_> {
    fn stands(&self) -> bool {
        self.height_m.abs() <= ON_GROUND_M && self.lean_rad <= FLAT_RAD
    }

    fn margin_m(&self) -> f64 {
        cop_margin_m(&self.sole.polygon, &self.com_m.xy())
    }
}

/// The table of the postures and their soles, and what in it keeps a scenario from standing like that. Both are empty for a robot
/// that is fixed to the world.
///
/// # Errors
/// When a posture does not fit the tree.
pub fn stances(robot: &RobotModel) -> Result<(String, Vec<String>), ModelError> {
    if !robot.tree.is_floating() {
        return Ok((String::new(), Vec::new()));
    }
    let (mut text, mut warnings) = (String::new(), undriven(robot));
    warnings.extend(crate::check::clamp_efforts(&mut robot.clone()));
    warnings.extend(weightless(robot));
    if robot.soles.is_empty() || robot.postures.is_empty() {
        let table = robot.file.with_extension("toml");
        let missing = if robot.soles.is_empty() { "sole" } else { "posture" };
        warnings.push(format!(
            "no {missing}, and a scenario needs one to stand: write it into the companion table {}",
            table.display()
        ));
        return Ok((text, warnings));
    }
    let width = |names: Vec<usize>| names.into_iter().max().unwrap_or(0).max(7);
    let first =
        width(robot.postures.iter().map(|posture| name_in_table(&posture.name).chars().count()).collect());
    let second = width(robot.soles.iter().map(|sole| name_in_table(&sole.name).chars().count()).collect());
    let _ = writeln!(
        text,
        "{:first$}  {:second$}  {:>10}  {:>9}  {:>22}  {:>10}  largest holding torque",
        "posture", "sole", "height", "lean", "mass centre in sole", "its margin"
    );
    for posture in &robot.postures {
        let Some(base) = robot.base_pose_w(posture) else {
            warnings.push(format!(
                "posture `{0}` has no base pose, so no scenario can begin in it: give it base_position_m",
                posture.name
            ));
            continue;
        };
        let soles = soles_in(robot, posture, base)?;
        let standing: Vec<&Stance> = soles.iter().filter(|stance| stance.stands()).collect();
        for stance in &soles {
            let height = format!("{:.1} mm", tidy(1e3 * stance.height_m, 1));
            let lean = format!("{:.2} deg", stance.lean_rad.to_degrees());
            let _ = write!(
                text,
                "{:first$}  {:second$}  {height:>10}  {lean:>9}",
                name_in_table(stance.posture),
                name_in_table(&stance.sole.name)
            );
            if stance.stands() {
                let [x, y]: [f64; 2] = stance.com_m.xy().map(|value| tidy(1e3 * value, 1)).into();
                let (com, edge) =
                    (format!("{x:.1}, {y:.1} mm"), format!("{:.1} mm", 1e3 * stance.margin_m()));
                let held = holding(robot, posture, stance.sole)?;
                let _ = write!(text, "  {com:>22}  {edge:>10}  {}", held.text);
                // With two feet on the ground each one holds a part only.
                if standing.len() == 1 {
                    warnings.extend(held.warning);
                    if stance.margin_m() < 0.0 {
                        warnings.push(tips_over(stance));
                    }
                }
            }
            text.push('\n');
        }
        if standing.is_empty() {
            warnings
                .extend(soles.iter().min_by(|a, b| a.height_m.total_cmp(&b.height_m)).map(no_sole_stands));
        }
    }
    Ok((text, warnings))
}

/// What `model` warns of in the posture of a scenario. Two soles on the ground are refused: the controller stands on one.
///
/// # Errors
/// In words, with key and remedy.
pub fn check_scenario(setup: &Setup) -> Result<Vec<String>, String> {
    let Setup { robot, scenario, .. } = setup;
    let in_words = |error: ModelError| error.to_string();
    let posture = robot.posture(&scenario.robot.posture);
    let Some((posture, base)) = posture.and_then(|posture| Some((posture, robot.base_pose_w(posture)?)))
    else {
        return Ok(Vec::new());
    };
    let soles = soles_in(robot, posture, base).map_err(in_words)?;
    let standing: Vec<&Stance> = soles.iter().filter(|stance| stance.stands()).collect();
    let names = || standing.iter().map(|stance| stance.sole.name.as_str()).collect::<Vec<_>>().join(" and ");
    let asked = scenario.robot.stance.names();
    if setup.is_legged() {
        return check_feet(&soles, asked);
    }
    if standing.len() > 1 {
        return Err(format!(
            "`robot.posture` = \"{}\": the robot stands on {}, and `robot.stance` = \"{}\" names one: take a posture in which only it is on the ground, \
             or name all of them, robot.stance = [...] or \"all\"",
            posture.name,
            names(),
            scenario.robot.stance
        ));
    }
    let mut warnings = Vec::new();
    let stance = soles.iter().find(|stance| stance.sole.name == scenario.robot.stance.first());
    if let Some(stance) = stance {
        if !stance.stands() {
            warnings.push(no_sole_stands(stance));
        }
        if stance.margin_m() < 0.0 {
            warnings.push(tips_over(stance));
        }
        warnings.extend(holding(robot, posture, stance.sole).map_err(in_words)?.warning);
    }
    Ok(warnings)
}

/// What is to be said of a robot on several feet.
fn check_feet(soles: &[Stance<'_>], asked: &[String]) -> Result<Vec<String>, String> {
    let names: Vec<&str> = soles.iter().map(|stance| stance.sole.name.as_str()).collect();
    if let Some(missing) = names.iter().find(|name| !asked.iter().any(|asked| asked == *name)) {
        return Err(format!(
            "`robot.stance`: a robot on several feet, or on its way, begins on all of them, and {missing} is not named: \
             robot.stance = \"all\""
        ));
    }
    let off = soles.iter().filter(|stance| stance.height_m.abs() > ON_GROUND_M);
    Ok(off.map(no_sole_stands).collect())
}

/// Every sole in a posture.
fn soles_in<'a>(
    robot: &'a RobotModel,
    posture: &'a Posture,
    base: RigidTransform,
) -> Result<Vec<Stance<'a>>, ModelError> {
    let mut kinematics = Kinematics::new(&robot.tree);
    kinematics.update_positions(&robot.tree, &Configuration::floating(base, &posture.q))?;
    let com = kinematics.mass_centre_of_tree_w(&robot.tree);
    let placed = robot.soles.iter().filter_map(|sole| Some((sole, robot.frame(&sole.frame)?)));
    let stances = placed.map(|(sole, frame)| {
        let body = frame.body.map_or_else(RigidTransform::identity, |body| kinematics.link_poses_w()[body]);
        let pose = body * frame.pose;
        Stance {
            posture: &posture.name,
            sole,
            height_m: pose.translation.z,
            lean_rad: pose.rotation.column(2).xy().norm().atan2(pose.rotation[(2, 2)]),
            com_m: pose.inverse().transform_point(&com),
        }
    });
    Ok(stances.collect())
}

/// What keeps a controller from driving a joint, in words: one for every such joint.
pub fn undriven(robot: &RobotModel) -> Vec<String> {
    let joints = robot.joint_names.iter().zip(&robot.limits).zip(&robot.actuated);
    let why = joints.filter_map(|((name, limit), &actuated)| {
        if !actuated {
            Some(format!(
                "joint `{name}` has no motor, and the controller needs one on every joint: give it one, or lock it in the companion \
                 table, [locked] {name} = 0.0"
            ))
        } else if limit.effort <= 0.0 {
            Some(format!("joint `{name}` has effort 0, so no torque: give its <limit> the largest there is"))
        } else if limit.velocity <= 0.0 {
            Some(format!(
                "joint `{name}` has velocity 0, so it cannot move: give its <limit> the largest there is"
            ))
        } else if limit.lower >= limit.upper {
            Some(format!(
                "the joint {name} has no range ({} .. {}): make its type \"fixed\", or lock it in the companion table, [locked] {name} = \
                 {:?}",
                limit.lower, limit.upper, limit.lower
            ))
        } else {
            None
        }
    });
    why.collect()
}

/// Joints that turn next to nothing, in words.
pub fn weightless(robot: &RobotModel) -> Vec<String> {
    let in_words = |(joint, inertia): (usize, f64)| {
        let name = &robot.joint_names[joint];
        format!(
            "joint `{name}` turns an inertia of {inertia:.1e} kg m² only, so nothing can be computed of its motion: give its link an inertia, \
             or lock it in the companion table, [locked] {name} = 0.0"
        )
    };
    crate::check::weightless_joints(robot).into_iter().map(in_words).collect()
}

struct Holding {
    text: String,
    warning: Option<String>,
}

/// What gravity asks of the motors when the robot stands on a sole: the joint nearest to its limit.
fn holding(robot: &RobotModel, posture: &Posture, sole: &Sole) -> Result<Holding, ModelError> {
    let Ok(rooted) = robot.rooted_at(&sole.frame) else {
        return Ok(Holding { text: String::new(), warning: None });
    };
    let standing = &rooted.model;
    let tree = &standing.tree;
    let q = standing.posture(&posture.name).map_or(&[][..], |posture| &posture.q);
    let mut kinematics = Kinematics::new(tree);
    kinematics.update_positions(tree, &Configuration::fixed(q))?;
    let mut torque = vec![0.0; tree.joint_count()];
    gravity_force_into(tree, &kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut torque)?;
    // Of a joint without any torque something else is said.
    let loads = torque.iter().zip(&standing.limits).map(|(torque, limit)| match limit.effort > 0.0 {
        true => torque.abs() / limit.effort,
        false => 0.0,
    });
    let largest = loads.zip(&standing.joint_names).max_by(|a, b| a.0.total_cmp(&b.0));
    let (load, joint) = largest.map_or((0.0, "-"), |(load, joint)| (load, joint.as_str()));
    let percent = 100.0 * load;
    let warning = (load > 1.0).then(|| {
        format!(
            "posture `{}`: joint `{joint}` would need {percent:.0} % of its effort to hold it on sole `{}`",
            posture.name, sole.name
        )
    });
    Ok(Holding { text: format!("{percent:.0} % of {joint}"), warning })
}

fn tips_over(stance: &Stance) -> String {
    format!(
        "posture `{}`: the mass centre is {:.1} mm outside sole `{}`, so the robot tips over: change the joints until it is above it",
        stance.posture,
        -1e3 * stance.margin_m(),
        stance.sole.name
    )
}

/// In words what is wrong with the lowest sole of a posture in which none is on the ground.
fn no_sole_stands(stance: &Stance) -> String {
    let (posture, sole) = (stance.posture, &stance.sole.name);
    if stance.lean_rad > FLAT_RAD {
        return format!(
            "posture `{posture}`: the lowest sole, `{sole}`, leans by {:.2} deg: no scenario can begin on it",
            stance.lean_rad.to_degrees()
        );
    }
    let (height_mm, side) = (1e3 * stance.height_m, if stance.height_m > 0.0 { "above" } else { "below" });
    format!(
        "posture `{posture}`: the lowest sole, `{sole}`, is {:.1} mm {side} the ground: add {:.4} to z of base_position_m",
        height_mm.abs(),
        -stance.height_m
    )
}

/// Without the sign of a zero.
fn tidy(value: f64, decimals: i32) -> f64 {
    let unit = 10.0_f64.powi(decimals);
    (value * unit).round() / unit + 0.0
}
