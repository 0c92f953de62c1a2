//! A robot model as a person reads it.

use std::fmt::Write as _;

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::{JointKind, KinematicTree, RigidTransform};
use delmpc_robots::RobotModel;

use crate::output::name_in_table;
use crate::stance::stances;
use crate::verdict::Failure;

/// A model as a person reads it: the tree with its joints, limits and masses, then names, how it stands, warnings.
pub fn table(robot: &RobotModel) -> Result<String, Failure> {
    let tree = &robot.tree;
    let mut text = String::new();
    let base = if tree.is_floating() { "floating base" } else { "fixed base" };
    let (joints, bodies, mass) = (tree.joint_count(), tree.body_count(), tree.total_mass());
    let _ = writeln!(text, "{}: {base}, {joints} joints, {bodies} bodies, {mass:.4} kg", robot.name);
    let mut kinematics = Kinematics::new(tree);
    let zeros = vec![0.0; joints];
    let at_zero = match tree.is_floating() {
        true => Configuration::floating(RigidTransform::identity(), &zeros),
        false => Configuration::fixed(&zeros),
    };
    if kinematics.update_positions(tree, &at_zero).is_ok() {
        let com = kinematics.mass_centre_of_tree_w(tree);
        let zero =
            if tree.is_floating() { "joints at zero, base body at the origin" } else { "joints at zero" };
        let _ = writeln!(text, "mass centre with {zero}: {:.4} {:.4} {:.4} m", com.x, com.y, com.z);
    }

    let branches = branches(tree);
    let names: Vec<String> = branches
        .iter()
        .zip(&robot.body_names)
        .map(|(branch, name)| format!("{branch}{}", name_in_table(name)))
        .collect();
    let joint_names: Vec<String> = robot.joint_names.iter().map(|name| name_in_table(name)).collect();
    let width = |names: &[String], least: usize| {
        names.iter().map(|name| name.chars().count()).max().unwrap_or(0).max(least)
    };
    let (body_width, joint_width) = (width(&names, 4), width(&joint_names, 5));
    let mut row = |[body, joint, kind, mass, range, effort, speed, damping]: [&str; 8]| {
        let line = format!(
            "{body:body_width$}  {joint:joint_width$}  {kind:9}  {mass:>9}  {range:>20}  {effort:>9}  {speed:>9}  {damping:>8}"
        );
        let _ = writeln!(text, "{}", line.trim_end());
    };
    row([""; 8]);
    row(["body", "joint", "kind", "mass", "position", "effort", "speed", "damping"]);
    row(["", "", "", "kg", "rad or m", "N m or N", "per s", "per s"]);
    let first = tree.first_joint_body();
    for (index, (body, name)) in tree.bodies().iter().zip(&names).enumerate() {
        let mass = format!("{:.4}", body.inertia.mass);
        let Some(joint) = index.checked_sub(first) else {
            row([name, "", "floating", &mass, "", "", "", ""]);
            continue;
        };
        let limit = &robot.limits[joint];
        let kind = match (robot.actuated[joint], body.joint.kind) {
            (true, JointKind::Revolute) => "revolute",
            (true, JointKind::Prismatic) => "prismatic",
            (false, _) => "passive",
        };
        let range = match limit.lower.is_finite() || limit.upper.is_finite() {
            true => format!("{:.4} .. {:7.4}", limit.lower, limit.upper),
            false => "free".to_owned(),
        };
        let bound = |value: f64| if value.is_finite() { format!("{value:.2}") } else { "-".to_owned() };
        let (effort, speed) = (bound(limit.effort), bound(limit.velocity));
        row([name, &joint_names[joint], kind, &mass, &range, &effort, &speed, &bound(robot.damping[joint])]);
    }
    let list = |names: Vec<&str>| if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    let soles: Vec<&str> = robot.soles.iter().map(|sole| sole.name.as_str()).collect();
    let postures: Vec<&str> = robot.postures.iter().map(|posture| posture.name.as_str()).collect();
    let frames: Vec<&str> = robot.frames.iter().map(|frame| frame.name.as_str()).collect();
    let contacts: Vec<&str> = robot.contacts.iter().map(|contact| contact.name.as_str()).collect();
    let _ = writeln!(text, "\nsoles:           {}\nframes:          {}", list(soles), list(frames));
    let _ = writeln!(text, "contact points:  {}\npostures:        {}", list(contacts), list(postures));
    let (stances, stance_warnings) = stances(robot).map_err(Failure::input)?;
    if !stances.is_empty() {
        let _ = write!(text, "\n{stances}");
    }
    text.push('\n');
    if robot.warnings.is_empty() && stance_warnings.is_empty() {
        let _ = writeln!(text, "no warnings");
    }
    for warning in robot.warnings.iter().chain(&stance_warnings) {
        let _ = writeln!(text, "warning: {warning}");
    }
    Ok(text)
}

/// What stands before the name of each body to draw the tree.
fn branches(tree: &KinematicTree) -> Vec<String> {
    let bodies = tree.bodies();
    let is_last =
        |index: usize| !bodies.iter().skip(index + 1).any(|other| other.parent == bodies[index].parent);
    let mark = |index: usize, own: bool| match (own, is_last(index)) {
        (true, true) => "└ ",
        (true, false) => "├ ",
        (false, true) => "  ",
        (false, false) => "│ ",
    };
    let branch = |index: usize| {
        let mut marks = Vec::new();
        let mut at = index;
        while let Some(parent) = bodies[at].parent {
            marks.push(mark(at, at == index));
            at = parent;
        }
        marks.into_iter().rev().collect()
    };
    (0..bodies.len()).map(branch).collect()
}
