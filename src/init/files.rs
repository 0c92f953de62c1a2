//! The companion table that `delmpc init` writes, with a word on every key.

use std::fmt::Write as _;
use std::path::PathBuf;

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::{JointKind, RigidTransform};
use delmpc_robots::RobotModel;
use nalgebra::{Rotation3, Vector3};

use crate::init::feet::FoundFoot;
use crate::init::posture::{Standing, leg_joints};
use crate::init::tip::Tip;

/// What the companion table says.
#[derive(Debug, Clone, Default)]
pub struct Table {
    /// Where the meshes of the URDF are.
    pub mesh_folder: Option<PathBuf>,
    /// Whether impossible inertias are accepted.
    pub accept_impossible_inertia: bool,
    /// Joints that do not move: name, place, why.
    pub locked: Vec<(String, f64, &'static str)>,
    /// Feet.
    pub feet: Vec<FoundFoot>,
    /// Hands: name, link, point in it.
    pub hands: Vec<(String, String, Vector3<f64>)>,
    /// Posture and the joints it is over.
    pub posture: Option<(Standing, Vec<String>)>,
    /// Whether it is bolted down: its posture has no base.
    pub is_bolted: bool,
    /// What should be known.
    pub notes: Vec<String>,
}

impl Table {
    /// The table as TOML.
    pub fn text(&self) -> String {
        let mut text = String::from(
            "# What the URDF beside it cannot say: soles, hands, a posture. Written by `delmpc init`; change it as you like.\n\
             # Lengths in m, angles in rad; points and frames are in the axes of their link.\n\
             format = 1\n",
        );
        if let Some(folder) = &self.mesh_folder {
            let folder = folder.display().to_string();
            let _ = writeln!(
                text,
                "\n# Where the names of its mesh files are relative to; they are only drawn.\nmesh_folder = {}",
                quoted(&folder)
            );
        }
        if self.accept_impossible_inertia {
            text.push_str("\n# It has inertias that no body has, or joints that carry no mass: they are taken as they are, and held.\naccept_impossible_inertia = true\n");
        }
        if !self.locked.is_empty() {
            text.push_str("\n# Joints that do not move, and where they stand.\n[locked]\n");
            for (name, at, why) in &self.locked {
                let _ = writeln!(text, "{} = {at:?} # {why}", quoted(name));
            }
        }
        for foot in &self.feet {
            foot_text(&mut text, foot);
        }
        for (name, link, at) in &self.hands {
            let _ = write!(
                text,
                "\n# The end of an arm: what a ball is fetched with.\n[[frame]]\nname = {}\nlink = {}\nposition_m = {}\n",
                quoted(name),
                quoted(link),
                list(at.iter())
            );
        }
        if let Some((standing, joints)) = &self.posture {
            text.push_str(&posture_text("stand", standing, joints, !self.is_bolted));
        }
        text
    }
}

/// A posture as an entry of a companion table.
pub fn posture_text(name: &str, standing: &Standing, joints: &[String], floats: bool) -> String {
    let rotation = Rotation3::from_matrix_unchecked(standing.base_link.rotation);
    let (roll, pitch, yaw) = rotation.euler_angles();
    let mut text = if floats {
        format!(
            "\n# Where it stands at rest: the root link in a world whose origin is the middle of the support, x forward, z up. The mass centre\n\
         # is over it. Solved by inverse kinematics; joints that are not named are at 0.\n\
         [[posture]]\nname = {}\nbase_position_m = {}\nbase_rpy_rad = {}\n[posture.joints]\n",
            quoted(name),
            exact(standing.base_link.translation.iter()),
            exact([roll, pitch, yaw].iter())
        )
    } else {
        format!(
            "\n# How it rests: where its hand moves well in all directions. Joints that are not named are at 0.\n\
             [[posture]]\nname = {}\n[posture.joints]\n",
            quoted(name)
        )
    };
    for (name, value) in joints.iter().zip(&standing.q).filter(|(_, value)| **value != 0.0) {
        let _ = writeln!(text, "{} = {value:?}", quoted(name));
    }
    text
}

fn foot_text(text: &mut String, foot: &FoundFoot) {
    let FoundFoot { name, link, frame, corners, from, tip } = foot;
    if let Some(tip) = tip {
        return tip_text(text, foot, tip);
    }
    let _ = write!(
        text,
        "\n# Sole `{name}`, found in the {from} of {}: points that touch the ground ...\n",
        in_comment(link)
    );
    for (index, corner) in corners.iter().enumerate() {
        let at = frame.transform_point(&Vector3::new(corner.x, corner.y, 0.0));
        let _ = write!(
            text,
            "[[contact]]\nname = \"{name}_{index}\"\nlink = {}\nposition_m = {}\n",
            quoted(link),
            exact(at.iter())
        );
    }
    let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(frame.rotation).euler_angles();
    let corners: Vec<String> = (0..corners.len()).map(|index| format!("\"{name}_{index}\"")).collect();
    let _ = write!(
        text,
        "# ... its frame: in the middle, x forward, z up ...\n[[frame]]\nname = \"{name}_sole\"\nlink = {}\nposition_m = {}\n\
         rpy_rad = {}\n# ... and its corners, counter-clockwise from above: the pressure point has to stay between them.\n\
         [[sole]]\nname = \"{name}\"\nframe = \"{name}_sole\"\ncorners = [{}]\n",
        quoted(link),
        exact(frame.translation.iter()),
        exact([roll, pitch, yaw].iter()),
        corners.join(", ")
    );
}

fn tip_text(text: &mut String, foot: &FoundFoot, tip: &Tip) {
    let FoundFoot { name, link, frame, from, .. } = foot;
    let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(frame.rotation).euler_angles();
    let _ = write!(
        text,
        "\n# Foot `{name}`, found in the {from} of {}: a sphere that touches the ground ...\n\
         [[contact]]\nname = \"{name}_tip\"\nlink = {}\nposition_m = {}\nradius_m = {:?}\n\
         # ... where it does so at rest, with z up and x forward there ...\n\
         [[frame]]\nname = \"{name}_sole\"\nlink = {}\nposition_m = {}\nrpy_rad = {}\n\
         # ... and a foot of one point.\n[[sole]]\nname = \"{name}\"\nframe = \"{name}_sole\"\ncorners = [\"{name}_tip\"]\n",
        in_comment(link),
        quoted(link),
        exact(tip.centre.iter()),
        tip.radius,
        quoted(link),
        exact(frame.translation.iter()),
        exact([roll, pitch, yaw].iter())
    );
}

/// A text as TOML writes it.
pub fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => {
                let _ = write!(out, "\\u{:04X}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

fn exact<'a>(values: impl Iterator<Item = &'a f64>) -> String {
    let words: Vec<String> = values.map(|value| format!("{:?}", value + 0.0)).collect();
    format!("[{}]", words.join(", "))
}

/// Numbers as TOML writes them, to a tenth of a millimetre.
pub fn list<'a>(values: impl Iterator<Item = &'a f64>) -> String {
    let words: Vec<String> = values.map(|value| format!("{:?}", (value * 1e4).round() / 1e4 + 0.0)).collect();
    format!("[{}]", words.join(", "))
}

/// Ends of arms: bodies that carry none, are no foot, and hang on a chain of at least three joints beside the legs. Left and right.
pub fn hands(robot: &RobotModel) -> Vec<(String, String, Vector3<f64>)> {
    let tree = &robot.tree;
    let legs = leg_joints(robot);
    let first = tree.first_joint_body();
    let carries = |body: usize| tree.bodies().iter().any(|other| other.parent == Some(body));
    let mut ends: Vec<(usize, f64, Vector3<f64>)> = Vec::new();
    let mut kinematics = Kinematics::new(tree);
    let zeros = vec![0.0; robot.joint_names.len()];
    let configuration = Configuration::floating(RigidTransform::identity(), &zeros);
    if kinematics.update_positions(tree, &configuration).is_err() {
        return Vec::new();
    }
    for body in (first..tree.body_count()).filter(|body| !carries(*body)) {
        // Turning joints on the way to the trunk, none of a leg.
        let (mut at, mut length) = (Some(body), 0);
        let mut shoulder = body;
        while let Some(here) =
            at.filter(|here| *here >= first && !legs.contains(&robot.joint_names[here - first]))
        {
            length += usize::from(tree.bodies()[here].joint.kind == JointKind::Revolute);
            shoulder = here;
            at = tree.bodies()[here].parent;
        }
        let poses = kinematics.link_poses_w();
        let com = tree.bodies()[body].inertia.com;
        let place = poses[body].transform_point(&com);
        let span = (place - poses[shoulder].translation).norm();
        // A head has two joints, an arm three or more. It does not stand on the ground.
        let is_foot =
            robot.soles.iter().any(|sole| robot.frame(&sole.frame).and_then(|f| f.body) == Some(body));
        if length >= 3 && !is_foot {
            ends.push((body, span, place));
        }
    }
    // Left is where the left of the soles is.
    let poses = kinematics.link_poses_w();
    let base = poses.first().copied().unwrap_or_default();
    let left_w = robot.soles.first().and_then(|sole| robot.frame(&sole.frame)).map_or_else(
        || base.rotation.column(1).into_owned(),
        |frame| {
            let body = frame.body.map_or_else(RigidTransform::identity, |body| poses[body]);
            (body * frame.pose).rotation.column(1).into_owned()
        },
    );
    let side = |end: &(usize, f64, Vector3<f64>)| left_w.dot(&(end.2 - base.translation));
    let mut hands = Vec::new();
    for (name, sign) in [("left_hand", 1.0), ("right_hand", -1.0)] {
        let longest = ends.iter().filter(|end| sign * side(end) > 0.02).max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((body, ..)) = longest {
            let link = robot.body_names[*body].clone();
            hands.push((name.to_owned(), link, tree.bodies()[*body].inertia.com));
        }
    }
    hands
}

/// The hands in the posture `stand`, in the frame of the sole; the one beside the standing leg last.
pub fn hands_at_home(robot: &RobotModel, sole: &str) -> Vec<(String, Vector3<f64>)> {
    let posture = robot.posture("stand");
    let Some((posture, base)) = posture.and_then(|posture| Some((posture, robot.base_pose_w(posture)?)))
    else {
        return Vec::new();
    };
    let mut kinematics = Kinematics::new(&robot.tree);
    if kinematics.update_positions(&robot.tree, &Configuration::floating(base, &posture.q)).is_err() {
        return Vec::new();
    }
    let mut hands: Vec<(String, Vector3<f64>)> = robot
        .frames
        .iter()
        .filter(|frame| frame.name.ends_with("_hand"))
        .filter_map(|frame| {
            let body = frame.attachment.body?;
            let pose = kinematics.link_poses_w()[body] * frame.attachment.pose;
            Some((frame.name.clone(), pose.translation))
        })
        .collect();
    hands.sort_by_key(|(name, _)| name.starts_with(sole));
    hands
}

/// A name in a comment: one line.
pub fn in_comment(name: &str) -> String {
    name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
