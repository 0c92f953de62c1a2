//! The scenario that `delmpc init` writes: how long, on which feet, what it is pushed with, and what is scaled by the robot's size.

use std::fmt::Write as _;

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_robots::RobotModel;
use nalgebra::Vector2;

use crate::init::files::{in_comment, list, quoted};
use crate::init::posture::Standing;

/// What a robot stands on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Support<'a> {
    /// The sole of that name.
    Sole(&'a str),
    /// All its feet.
    AllFeet,
    /// Nothing: it is bolted down.
    Bolted,
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
    /// Of an arm that is bolted down: its hand in the frame of its root link, m.
    pub hand: [f64; 3],
}

/// The robot whose weights are the defaults: Atlas.
const REFERENCE_HEIGHT_M: f64 = 1.0;
const REFERENCE_WEIGHT_N: f64 = 1717.0;

/// Weight of the hand of an arm of 1 m, 1/m².
const HAND_OF_ARM: f64 = 30_000.0;
/// Whole plant steps.
const RATES_HZ: [f64; 4] = [100.0, 125.0, 200.0, 250.0];
/// Farthest a foot may slip, as a part of the height of the mass centre.
const SLIP_PART: f64 = 0.05;

impl Size {
    /// Of a robot that stands in the posture `stand` of its table.
    pub fn of(robot: &RobotModel, support: Support<'_>, standing: &Standing) -> Self {
        let all: Vec<String> = robot.soles.iter().map(|sole| sole.name.clone()).collect();
        let soles = match support {
            Support::Sole(sole) => vec![sole.to_owned()],
            Support::AllFeet => all,
            Support::Bolted => Vec::new(),
        };
        let ground = crate::support::Support::new(robot, "stand", &soles);
        let reach = |direction| ground.as_ref().and_then(|ground| ground.reach(direction)).unwrap_or(0.0);
        let to_edge = [reach(Vector2::x()), reach(Vector2::y()).min(reach(-Vector2::y()))];
        Self { mass: robot.tree.total_mass(), height: standing.com.z, to_edge, hand: [0.0; 3] }
    }

    /// Of a robot that is bolted down: its length counts, how far its hand is from the mount.
    pub fn of_arm(robot: &RobotModel, hand: &str, standing: &Standing) -> Self {
        let mut kinematics = Kinematics::new(&robot.tree);
        let posed = kinematics.update_positions(&robot.tree, &Configuration::fixed(&standing.q)).is_ok();
        let frame = robot.frame(hand).filter(|_| posed);
        let place =
            frame.and_then(|frame| Some((kinematics.link_poses_w()[frame.body?] * frame.pose).translation));
        let place = place.unwrap_or_default();
        let mass = robot.tree.total_mass();
        Self { mass, height: place.norm().max(0.05), to_edge: [0.0; 2], hand: place.into() }
    }

    /// What an inverted pendulum on this support survives at most when pushed forward, N s.
    pub fn capture_limit_forward(&self) -> f64 {
        self.mass * (9.81 / self.height).sqrt() * self.to_edge[0]
    }
}

/// The scenario; the ball with the hand that fetches it.
pub fn scenario_text(
    robot: &RobotModel,
    stem: &str,
    support: Support<'_>,
    size: &Size,
    ball: Option<(&str, [f64; 3])>,
) -> String {
    let sole = match support {
        Support::Sole(sole) => sole,
        Support::AllFeet => return on_feet(robot, stem, size),
        Support::Bolted => return bolted(stem, robot, size, ball),
    };
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
        reach(&mut text, hand, &at, "sole");
    }
    push(&mut text, robot, size, "sole", 5.0);
    text
}

/// The scenario of an arm that is bolted down.
fn bolted(stem: &str, robot: &RobotModel, size: &Size, ball: Option<(&str, [f64; 3])>) -> String {
    let mut text = format!(
        "# {} is bolted down and reaches for a ball. Written by `delmpc init`; change it as you like.\n\
         # A key that is not here has a default: `delmpc run` leaves all of them in scenario.toml of the run's folder.\n",
        in_comment(&robot.name)
    );
    let urdf = quoted(&format!("{stem}.urdf"));
    keys(&mut text, "", &[("seed", "1", "of everything random"), ("duration_s", "5.0", "of the run, s")]);
    let keys_of_robot = [
        ("urdf", urdf.as_str(), "its companion table lies beside it"),
        ("base", "\"fixed\"", "its root link is bolted to the world"),
        ("posture", "\"stand\"", "posture of that table that it begins and rests in"),
    ];
    keys(&mut text, "robot", &keys_of_robot);
    let scale = (REFERENCE_HEIGHT_M / size.height).powi(2);
    let (hand, posture) = (three_digits(HAND_OF_ARM * scale), three_digits(5.0 * scale));
    let _ = write!(
        text,
        "\n# Weights: one over the square of what counts 1. Lengths go with its reach, {:.2} m to the hand.",
        size.height
    );
    let keys_of_weights = [
        ("posture_per_rad2", posture.as_str(), "every joint away from the posture"),
        ("torque_per_limit2", "10.0", "every joint's torque beside what gravity asks, over its limit"),
        ("hand_per_m2", hand.as_str(), "hand away from its way to the ball"),
    ];
    keys(&mut text, "controller.weights", &keys_of_weights);
    if let Some((hand, at)) = ball {
        reach(&mut text, hand, &at, "root link");
    }
    text
}

fn reach(text: &mut String, hand: &str, at: &[f64; 3], frame: &str) {
    let (hand, at) = (quoted(hand), list(at.iter()));
    let where_m = format!("in the frame of the {frame}: x forward, y left, z up");
    text.push_str("\n# A ball 10 cm from where the hand rests.");
    let keys_of_reach = [
        ("hand", hand.as_str(), "frame of the companion table, or link"),
        ("ball_m", at.as_str(), where_m.as_str()),
        ("start_s", "1.0", "when the motion begins"),
        ("deadline_s", "1.5", "how long it may take"),
        ("hold_s", "0.8", "how long the hand stays"),
        ("return_s", "1.2", "how long the way back takes"),
    ];
    keys(text, "reach", &keys_of_reach);
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
    let flat = robot.soles.iter().all(|sole| sole.contacts.len() > 1);
    // Small robots fall faster; feet that are points leave less to balance with between two cycles, and less to correct.
    let wanted_hz = if flat { 100.0 * (REFERENCE_HEIGHT_M / size.height).powf(1.5) } else { 0.0 };
    let rate_hz = RATES_HZ.into_iter().find(|rate| *rate >= wanted_hz).unwrap_or(RATES_HZ[3]);
    let rate = format!("{rate_hz:?}");
    let keys_of_controller = [
        ("mpc_rate_hz", rate.as_str(), "control cycles per second"),
        ("horizon_s", "0.8", "how far it looks ahead, s"),
        ("stages", "20", "that the horizon is cut into"),
    ];
    keys(&mut text, "controller", &keys_of_controller);
    push(&mut text, robot, size, "feet", 1.0);
    let slip = three_digits(SLIP_PART * size.height);
    keys(&mut text, "success", &[("max_stance_slip_m", slip.as_str(), "farthest a foot may slip, m")]);
    if matches!(robot.soles.len(), 2 | 4) {
        text.push_str(&gait(flat, robot.soles.len(), size));
    }
    text
}

/// How it would walk or trot, in comments.
fn gait(flat: bool, feet: usize, size: &Size) -> String {
    // A fraction of the speed √(g h) of a pendulum of its size.
    let (kind, part) = if feet == 2 { ("walk", 0.07) } else { ("trot", 0.18) };
    let speed = format!("{:.2}", part * (9.81 * size.height).sqrt());
    let mut text = format!(
        "\n# To have it {kind}: take the `# ` away from the following lines, and give the run more time, duration_s = 8.0.\n\
         # [gait]\n# kind = \"{kind}\"\n# speed_m_s = {speed}   # ahead\n# start_s = 2.5      # when it begins\n# stop_s = 7.0       # when it stands again\n"
    );
    if flat {
        text.push_str("# To be put into [success]: max_stance_tilt_rad = 0.2, min_cop_margin_m = -0.02\n");
    }
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
