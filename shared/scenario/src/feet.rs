//! The keys of a robot on its feet: on which it stands, a gait, single steps, and what the controller trades in them.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The soles a robot stands on at the start.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Stance {
    /// One, or `all` that the robot has.
    One(String),
    /// Some.
    Some(Vec<String>),
}

impl Stance {
    /// The word for all soles.
    pub const ALL: &'static str = "all";

    /// The names.
    pub fn names(&self) -> &[String] {
        match self {
            Self::One(name) => std::slice::from_ref(name),
            Self::Some(names) => names,
        }
    }

    /// The first one: its sole is the origin of the stance frame.
    pub fn first(&self) -> &str {
        self.names().first().map_or("", String::as_str)
    }

    /// Whether all are meant, whatever their names.
    pub fn is_all(&self) -> bool {
        matches!(self, Self::One(name) if name == Self::ALL)
    }
}

impl Default for Stance {
    fn default() -> Self {
        Self::One(String::new())
    }
}

impl From<&str> for Stance {
    fn from(name: &str) -> Self {
        Self::One(name.to_owned())
    }
}

impl fmt::Display for Stance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.names().join(", "))
    }
}

/// Going on two or four feet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GaitSettings {
    /// Which feet go together.
    pub kind: GaitKind,
    /// Forward, m/s.
    pub speed_m_s: f64,
    /// To the left, m/s.
    pub side_speed_m_s: f64,
    /// Turning to the left, rad/s.
    pub yaw_rate_rad_s: f64,
    /// Time from one lift-off of a foot to the next, s; 0: by the robot's size.
    pub period_s: f64,
    /// Part of it on the ground.
    pub duty: f64,
    /// First lift-off, s.
    pub start_s: f64,
    /// When the robot has stopped, s; beyond the run: never.
    pub stop_s: f64,
    /// How long it takes to be at speed, s.
    pub ramp_s: f64,
}

/// Which feet go together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum GaitKind {
    /// Diagonal pairs.
    Trot,
    /// One after the other.
    Walk,
    /// The two of a side.
    Pace,
    /// The front ones and the back ones.
    Bound,
    /// Diagonal pairs, with times in the air: a duty below one half.
    FlyingTrot,
    /// All at once, on the spot or ahead.
    Jump,
}

/// The words for [`GaitKind`].
pub(crate) const GAIT_KINDS: [&str; 6] = ["trot", "walk", "pace", "bound", "flying-trot", "jump"];

impl Default for GaitSettings {
    fn default() -> Self {
        Self {
            kind: GaitKind::Trot,
            speed_m_s: 0.0,
            side_speed_m_s: 0.0,
            yaw_rate_rad_s: 0.0,
            period_s: 0.0,
            duty: 0.6,
            start_s: 0.5,
            stop_s: 1e6,
            ramp_s: 0.6,
        }
    }
}

/// A step of one foot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StepSettings {
    /// The sole that steps.
    pub foot: String,
    /// Lift-off, s.
    pub time_s: f64,
    /// Time in the air, s.
    pub swing_s: f64,
    /// Where the sole's origin lands, in the stance frame, m.
    pub position_m: [f64; 3],
    /// Its heading there, rad.
    pub yaw_rad: f64,
}

impl Default for StepSettings {
    fn default() -> Self {
        Self { foot: String::new(), time_s: 0.0, swing_s: 0.6, position_m: [0.0; 3], yaw_rad: 0.0 }
    }
}

/// What the controller of a robot on several feet, or on its way, trades against each other: one over the square of the deviation that
/// counts 1. Forces count relative to the robot's weight.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LeggedSettings {
    /// Rotation of the base, 1/rad².
    pub base_rotation_per_rad2: f64,
    /// Its angular velocity, 1/(rad/s)².
    pub base_spin_s2_per_rad2: f64,
    /// Mass centre along x, y, z, 1/m².
    pub com_per_m2: [f64; 3],
    /// Its velocity, 1/(m/s)².
    pub com_velocity_s2_per_m2: [f64; 3],
    /// Every joint, 1/rad².
    pub posture_per_rad2: f64,
    /// Every joint's speed, 1/(rad/s)².
    pub joint_speed_s2_per_rad2: f64,
    /// Joints of a leg in the air count so many times.
    pub swing_leg: f64,
    /// A foot in the air, 1/m².
    pub swing_foot_per_m2: f64,
    /// Its rotation, 1/rad².
    pub swing_foot_rotation_per_rad2: f64,
    /// Every joint's torque, per square of its limit.
    pub torque_per_limit2: f64,
    /// Tangential force of a foot, per square of the weight.
    pub tangential_force_per_weight2: f64,
    /// Normal force of a foot, per square of the weight.
    pub normal_force_per_weight2: f64,
    /// Torque of a sole, per square of the weight times 0.1 m.
    pub sole_torque_per_weight2: f64,
    /// How long the aim is held after the horizon, s.
    pub terminal_s: f64,
    /// Lift of a foot in the middle of its swing, m; 0: by the robot's size.
    pub swing_lift_m: f64,
    /// How far below the ground a swing ends, m; 0: by the robot's size.
    pub swing_depth_m: f64,
    /// How far the mass centre goes down before the first step, m; 0: by the reach of the legs.
    pub crouch_m: f64,
    /// Least normal force of a foot that stands, as a part of the weight.
    pub min_force_fraction: f64,
    /// Time over which the servo takes the mean of velocities, s.
    pub rate_mean_s: f64,
}

impl Default for LeggedSettings {
    fn default() -> Self {
        Self {
            base_rotation_per_rad2: 400.0,
            base_spin_s2_per_rad2: 6.0,
            com_per_m2: [3e3, 3e3, 1e4],
            com_velocity_s2_per_m2: [150.0; 3],
            posture_per_rad2: 30.0,
            joint_speed_s2_per_rad2: 0.1,
            swing_leg: 4.0,
            swing_foot_per_m2: 3e4,
            swing_foot_rotation_per_rad2: 100.0,
            torque_per_limit2: 70.0,
            tangential_force_per_weight2: 200.0,
            normal_force_per_weight2: 8.0,
            sole_torque_per_weight2: 200.0,
            terminal_s: 0.5,
            swing_lift_m: 0.0,
            swing_depth_m: 0.0,
            crouch_m: 0.0,
            min_force_fraction: 0.005,
            rate_mean_s: 0.002,
        }
    }
}

impl GaitSettings {
    /// Every number with its range: key, value, least, most.
    pub(crate) fn ranges(&self) -> Vec<(&'static str, f64, f64, f64)> {
        vec![
            ("gait.speed_m_s", self.speed_m_s, -10.0, 10.0),
            ("gait.side_speed_m_s", self.side_speed_m_s, -10.0, 10.0),
            ("gait.yaw_rate_rad_s", self.yaw_rate_rad_s, -10.0, 10.0),
            ("gait.period_s", self.period_s, if self.period_s == 0.0 { 0.0 } else { 0.05 }, 10.0),
            ("gait.duty", self.duty, 0.05, 0.98),
            ("gait.start_s", self.start_s, 0.0, 3600.0),
            ("gait.stop_s", self.stop_s, self.start_s, f64::MAX),
            ("gait.ramp_s", self.ramp_s, 0.01, 100.0),
        ]
    }
}

impl LeggedSettings {
    /// Every number with its range: key, value, least, most.
    pub(crate) fn ranges(&self) -> Vec<(&'static str, f64, f64, f64)> {
        let weights = [
            ("controller.legged.base_rotation_per_rad2", self.base_rotation_per_rad2),
            ("controller.legged.base_spin_s2_per_rad2", self.base_spin_s2_per_rad2),
            ("controller.legged.posture_per_rad2", self.posture_per_rad2),
            ("controller.legged.joint_speed_s2_per_rad2", self.joint_speed_s2_per_rad2),
            ("controller.legged.swing_leg", self.swing_leg),
            ("controller.legged.swing_foot_per_m2", self.swing_foot_per_m2),
            ("controller.legged.swing_foot_rotation_per_rad2", self.swing_foot_rotation_per_rad2),
            ("controller.legged.tangential_force_per_weight2", self.tangential_force_per_weight2),
            ("controller.legged.normal_force_per_weight2", self.normal_force_per_weight2),
            ("controller.legged.sole_torque_per_weight2", self.sole_torque_per_weight2),
        ];
        let axes = [
            ("controller.legged.com_per_m2", self.com_per_m2),
            ("controller.legged.com_velocity_s2_per_m2", self.com_velocity_s2_per_m2),
        ];
        let axes = axes.into_iter().flat_map(|(key, values)| values.map(|value| (key, value)));
        let mut ranges: Vec<_> =
            weights.into_iter().chain(axes).map(|(key, value)| (key, value, 0.0, 1e9)).collect();
        ranges.extend([
            ("controller.legged.torque_per_limit2", self.torque_per_limit2, 1e-6, 1e9),
            ("controller.legged.terminal_s", self.terminal_s, 0.0, 100.0),
            ("controller.legged.swing_lift_m", self.swing_lift_m, 0.0, 1.0),
            ("controller.legged.swing_depth_m", self.swing_depth_m, 0.0, 0.1),
            ("controller.legged.crouch_m", self.crouch_m, -1.0, 1.0),
            ("controller.legged.min_force_fraction", self.min_force_fraction, 0.0, 1.0),
            ("controller.legged.rate_mean_s", self.rate_mean_s, 0.0, 0.02),
        ]);
        ranges
    }
}
