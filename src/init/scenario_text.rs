//! The scenario that `delmpc init` writes: how long, on which feet, what it is pushed with, and what is scaled by the robot's size.

use std::fmt::Write as _;

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_robots::RobotModel;
use nalgebra::{Vector2, Vector3};

use crate::init::feet::hull;
use crate::init::files::{in_comment, list, quoted};
use crate::init::posture::Standing;

/// What a robot stands on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Support<'a> {
    /// The sole of that name.
    Sole(&'a str),
    /// All its feet.
    AllFeet,
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
    /// Of a robot that stands in the posture `stand` of its table.
    pub fn of(robot: &RobotModel, support: Support<'_>, standing: &Standing) -> Self {
        let mass = robot.tree.total_mass();
        let polygon = match support {
            Support::Sole(sole) => robot.sole(sole).map(|sole| sole.polygon.clone()).unwrap_or_default(),
            Support::AllFeet => support_polygon(robot),
        };
        // Distance of the mass centre, which is over the origin, from the edge in a direction.
        let reach = |direction: Vector2<f64>| {
            let edges = polygon.iter().zip(polygon.iter().cycle().skip(1));
            let crossings = edges.filter_map(|(a, b)| {
                let (from, along) = (a - standing.com.xy(), b - a);
                let (cross, part) = (direction.perp(&along), from.perp(&direction));
                let at = part / cross;
                (cross.abs() > 1e-12 && (0.0..=1.0).contains(&at)).then(|| from.perp(&along) / cross)
            });
            crossings.fold(0.0, f64::max)
        };
        let to_edge = [reach(Vector2::x()), reach(Vector2::y()).min(reach(-Vector2::y()))];
        Self { mass, height: standing.com.z, to_edge }
    }

    /// What an inverted pendulum on this support survives at most when pushed forward, N s.
    pub fn capture_limit_forward(&self) -> f64 {
        self.mass * (9.81 / self.height).sqrt() * self.to_edge[0]
    }
}

/// Hull of all feet on the ground in the posture `stand`, counter-clockwise.
fn support_polygon(robot: &RobotModel) -> Vec<Vector2<f64>> {
    let posture = robot.posture("stand");
    let Some((posture, base)) = posture.and_then(|posture| Some((posture, robot.base_pose_w(posture)?)))
    else {
        return Vec::new();
    };
    let mut kinematics = Kinematics::new(&robot.tree);
    if kinematics.update_positions(&robot.tree, &Configuration::floating(base, &posture.q)).is_err() {
        return Vec::new();
    }
    let corner = |index: &usize| -> Option<Vector3<f64>> {
        let contact = &robot.contacts[*index];
        Some(kinematics.link_poses_w()[contact.body?].transform_point(&contact.position))
    };
    let corners = robot.soles.iter().flat_map(|sole| sole.contacts.iter().filter_map(corner));
    hull(&corners.map(|corner| corner.xy()).collect::<Vec<_>>())
}

/// The scenario; the ball with the hand that fetches it.
pub fn scenario_text(
    robot: &RobotModel,
    stem: &str,
    support: Support<'_>,
    size: &Size,
    ball: Option<(&str, [f64; 3])>,
) -> String {
    let Support::Sole(sole) = support else { return on_feet(robot, stem, size) };
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
    push(&mut text, robot, size, "sole", 5.0);
    text
}

/// The scenario of a robot on all its feet.
fn on_feet(robot: &RobotModel, stem: &str, size: &Size) -> String {
    let mut text = format!(
        "# {} stands on all its feet, takes a push, and stays up. Written by `delmpc init`; change it as you like.\n\
         # A key that is not here has a default: `delmpc run` leaves all of them in scenario.toml of the run's folder.\n",
        in_comment(&robot.name)
    );
    let urdf = quoted(&format!("{stem}.urdf"));
    keys(&mut text, "", &[("seed", "1", "of everything random"), ("duration_s", "6.0", "of the run, s")]);
    let keys_of_robot = [
        ("urdf", urdf.as_str(), "its companion table lies beside it"),
        ("stance", "\"all\"", "all soles of that table; or a list of names"),
        ("posture", "\"stand\"", "posture of that table that it begins and rests in"),
    ];
    keys(&mut text, "robot", &keys_of_robot);
    sensors(&mut text, size);
    let keys_of_controller = [
        ("mpc_rate_hz", "100.0", "control cycles per second"),
        ("horizon_s", "0.8", "how far it looks ahead, s"),
        ("stages", "20", "that the horizon is cut into"),
    ];
    keys(&mut text, "controller", &keys_of_controller);
    push(&mut text, robot, size, "feet", 1.0);
    text
}

fn push(text: &mut String, robot: &RobotModel, size: &Size, support: &str, start_s: f64) {
    let _ = write!(
        text,
        "\n# Half of what an inverted pendulum on the {support} survives when it is pushed forward."
    );
    let link = quoted(robot.body_names.first().map_or("", String::as_str));
    let impulse = three_digits(0.5 * size.capture_limit_forward());
    let start = format!("{start_s:?}");
    let keys_of_push = [
        ("link", link.as_str(), "pushed at its mass centre"),
        ("direction", "[1.0, 0.0, 0.0]", "in the frame of the (first) sole"),
        ("impulse_ns", impulse.as_str(), "force times duration, N s"),
        ("start_s", start.as_str(), "when it begins"),
        ("duration_s", "0.1", "how long it lasts"),
    ];
    keys(text, "push", &keys_of_push);
}

/// Sensor noise of its size.
fn sensors(text: &mut String, size: &Size) {
    let noise = size.mass * 9.81 / REFERENCE_WEIGHT_N;
    let force = three_digits(2.0 * noise);
    let torque = three_digits(0.2 * noise * size.height / REFERENCE_HEIGHT_M);
    let keys_of_sensors = [
        ("foot_force_noise_n", force.as_str(), "standard deviation, in proportion to its weight"),
        ("foot_torque_noise_nm", torque.as_str(), "the same times its height"),
    ];
    keys(text, "sensors", &keys_of_sensors);
}

/// Sensor noise, weights and constraints of its size.
fn scaled(text: &mut String, size: &Size) {
    sensors(text, size);
    let scale = REFERENCE_HEIGHT_M / size.height;
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

