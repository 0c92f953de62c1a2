//! The texts that `delmpc init` writes: companion table and scenario, with a word on every key.

use std::fmt::Write as _;
use std::path::PathBuf;

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::{JointKind, RigidTransform};
use delmpc_robots::RobotModel;
use nalgebra::{Rotation3, Vector3};

use crate::init::feet::FoundFoot;
use crate::init::posture::{Standing, leg_joints};

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
            text.push_str(&posture_text("stand", standing, joints));
        }
        text
    }
}

/// A posture as an entry of a companion table.
pub fn posture_text(name: &str, standing: &Standing, joints: &[String]) -> String {
    let rotation = Rotation3::from_matrix_unchecked(standing.base_link.rotation);
    let (roll, pitch, yaw) = rotation.euler_angles();
    let mut text = format!(
        "\n# Where it stands at rest: the root link in a world whose origin is the middle of the sole, x forward, z up. The mass centre\n\
         # is over the middle of the sole. Solved by inverse kinematics; joints that are not named are at 0.\n\
         [[posture]]\nname = {}\nbase_position_m = {}\nbase_rpy_rad = {}\n[posture.joints]\n",
        quoted(name),
        exact(standing.base_link.translation.iter()),
        exact([roll, pitch, yaw].iter())
    );
    for (name, value) in joints.iter().zip(&standing.q).filter(|(_, value)| **value != 0.0) {
        let _ = writeln!(text, "{} = {value:?}", quoted(name));
    }
    text
}

fn foot_text(text: &mut String, foot: &FoundFoot) {
    let FoundFoot { name, link, frame, corners, from } = foot;
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

/// A text as TOML writes it.
fn quoted(text: &str) -> String {
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

fn list<'a>(values: impl Iterator<Item = &'a f64>) -> String {
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

/// What the scenario is scaled by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Size {
    /// Mass, kg.
    pub mass: f64,
    /// Height of the mass centre over the sole, m.
    pub height: f64,
    /// Distances of the mass centre from the front and from the outer edge of the sole, m.
    pub to_edge: [f64; 2],
}

/// The robot whose weights are the defaults: Atlas.
const REFERENCE_HEIGHT_M: f64 = 1.0;
const REFERENCE_WEIGHT_N: f64 = 1717.0;

impl Size {
    /// Of a robot on a sole.
    pub fn of(robot: &RobotModel, sole: &str, standing: &Standing) -> Self {
        let mass = robot.tree.total_mass();
        let polygon = robot.sole(sole).map_or(&[][..], |sole| sole.polygon.as_slice());
        let reach = |direction: [f64; 2]| {
            let along = polygon.iter().map(|corner| corner.x * direction[0] + corner.y * direction[1]);
            along.fold(0.0, f64::max)
        };
        let to_edge = [reach([1.0, 0.0]), reach([0.0, 1.0]).min(reach([0.0, -1.0]))];
        Self { mass, height: standing.com.z, to_edge }
    }

    /// What an inverted pendulum on the sole survives at most when pushed forward, N s.
    pub fn capture_limit_forward(&self) -> f64 {
        self.mass * (9.81 / self.height).sqrt() * self.to_edge[0]
    }
}

/// The scenario; the ball with the hand that fetches it.
pub fn scenario_text(
    robot: &RobotModel,
    stem: &str,
    sole: &str,
    size: &Size,
    ball: Option<(&str, [f64; 3])>,
) -> String {
    let fetches = if ball.is_some() { ", fetches a ball" } else { "" };
    let mut text = format!(
        "# {} stands on its sole `{sole}`{fetches}, takes a push, and stays up. Written by `delmpc init`; change it as you like.\n\
         # A key that is not here has a default: `delmpc run` leaves all of them in scenario.toml of the run's folder.\n",
        in_comment(&robot.name)
    );
    let quoted_sole = quoted(sole);
    let urdf = quoted(&format!("{stem}.urdf"));
    keys(&mut text, "", &[("seed", "1", "of everything random"), ("duration_s", "8.0", "of the run, s")]);
    let keys_of_robot = [
        ("urdf", urdf.as_str(), "its companion table lies beside it"),
        ("stance", quoted_sole.as_str(), "sole of that table that it stands on"),
        ("posture", "\"stand\"", "posture of that table that it begins and rests in"),
    ];
    keys(&mut text, "robot", &keys_of_robot);
    scaled(&mut text, size);
    if let Some((hand, at)) = ball {
        let (hand, at) = (quoted(hand), list(at.iter()));
        text.push_str("\n# A ball 10 cm from where the hand rests.");
        let keys_of_reach = [
            ("hand", hand.as_str(), "frame of the companion table, or link"),
            ("ball_m", at.as_str(), "in the frame of the sole: x forward, y left, z up"),
            ("start_s", "1.0", "when the motion begins"),
            ("deadline_s", "1.5", "how long it may take"),
            ("hold_s", "0.8", "how long the hand stays"),
            ("return_s", "1.2", "how long the way back takes"),
        ];
        keys(&mut text, "reach", &keys_of_reach);
    }
    text.push_str("\n# Half of what an inverted pendulum on this sole survives when it is pushed forward.");
    let link = quoted(robot.body_names.first().map_or("", String::as_str));
    let impulse = three_digits(0.5 * size.capture_limit_forward());
    let keys_of_push = [
        ("link", link.as_str(), "pushed at its mass centre"),
        ("direction", "[1.0, 0.0, 0.0]", "in the frame of the sole"),
        ("impulse_ns", impulse.as_str(), "force times duration, N s"),
        ("start_s", "5.0", "when it begins"),
        ("duration_s", "0.1", "how long it lasts"),
    ];
    keys(&mut text, "push", &keys_of_push);
    text
}

/// Sensor noise, weights and constraints of its size.
fn scaled(text: &mut String, size: &Size) {
    let scale = REFERENCE_HEIGHT_M / size.height;
    let noise = size.mass * 9.81 / REFERENCE_WEIGHT_N;
    let force = three_digits(2.0 * noise);
    let torque = three_digits(0.2 * noise / scale);
    let keys_of_sensors = [
        ("foot_force_noise_n", force.as_str(), "standard deviation, in proportion to its weight"),
        ("foot_torque_noise_nm", torque.as_str(), "the same times its height"),
    ];
    keys(text, "sensors", &keys_of_sensors);
    let all_axes = |value: f64| format!("[{0}, {0}, 0.0]", three_digits(value));
    let com = all_axes(2000.0 * scale * scale);
    let com_velocity = all_axes(200.0 * scale);
    let speed = three_digits(0.5 / scale);
    let posture = three_digits(20.0 * scale * scale);
    let hand = three_digits(10_000.0 * scale * scale);
    let foot = format!("[0.0, 0.0, {}]", three_digits(1000.0 * scale * scale));
    let _ = write!(
        text,
        "\n# Weights: one over the square of what counts 1. Lengths go with its height, {:.2} m to the mass centre.",
        size.height
    );
    let keys_of_weights = [
        ("com_per_m2", com.as_str(), "mass centre away from its place, x, y, z"),
        ("com_velocity_s2_per_m2", com_velocity.as_str(), "its velocity"),
        ("posture_per_rad2", posture.as_str(), "every joint away from the posture"),
        ("joint_speed_s2_per_rad2", speed.as_str(), "every joint's speed"),
        ("torque_per_limit2", "100.0", "every joint's torque beside what gravity asks, over its limit"),
        ("hand_per_m2", hand.as_str(), "hand away from its way to the ball"),
        ("swing_foot_per_m2", foot.as_str(), "the other foot away from where it hangs, x, y, z"),
    ];
    keys(text, "controller.weights", &keys_of_weights);
    let yaw_arm = three_digits(0.6 * 0.9 * size.to_edge[1]);
    let margin = three_digits((0.003_f64).min(0.05 * size.to_edge[1]));
    let keys_of_constraints = [
        ("yaw_arm_m", yaw_arm.as_str(), "yaw torque that the sole bears by friction, per vertical force"),
        ("cop_margin_m", margin.as_str(), "distance that the plan keeps from the edge of the sole"),
    ];
    keys(text, "controller.constraints", &keys_of_constraints);
}

/// A section: keys, values, and what they are.
fn keys(text: &mut String, section: &str, keys: &[(&str, &str, &str)]) {
    if !section.is_empty() {
        let _ = write!(text, "\n[{section}]\n");
    }
    let width = keys.iter().map(|(key, value, _)| key.len() + value.chars().count()).max().unwrap_or(0);
    for (key, value, what) in keys {
        let gap = width - key.len() - value.chars().count();
        let _ = writeln!(text, "{key} = {value}{:gap$}   # {what}", "");
    }
}

/// More digits are for nobody who changes them.
fn three_digits(value: f64) -> String {
    let unit = 10_f64.powf(2.0 - value.abs().max(1e-12).log10().floor());
    format!("{:?}", (value * unit).round() / unit)
}

/// A name in a comment: one line.
fn in_comment(name: &str) -> String {
    name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
