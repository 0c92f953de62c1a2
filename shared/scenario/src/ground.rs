//! The keys of the ground and of how the robot begins on it.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The robot and how it stands at the beginning.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RobotSettings {
    /// URDF file, relative to the scenario file; its companion table lies beside it.
    pub urdf: String,
    /// Whether its root link floats, or is bolted to the world: then nothing is asked of soles.
    pub base: Base,
    /// Soles it stands on, by their names in the companion table: one, a list, or "all".
    pub stance: crate::Stance,
    /// Posture it begins and rests in, by its name in the companion table.
    pub posture: String,
    /// Whether inertias that no body has are taken as they are, and joints that carry no mass are held; as the key of the companion table.
    pub accept_impossible_inertia: bool,
    /// How it begins beside that posture.
    pub start: StartSettings,
}

/// What the root link does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Base {
    /// It floats.
    #[default]
    Floating,
    /// It is bolted to the world: its frame is the world's and the stance frame.
    Fixed,
}

/// How the start differs from the posture on its ground: the whole robot moved, and turned about the origin of its stance sole. A robot
/// that starts like that has half a second to land before tilt and pressure point of its foot are judged.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct StartSettings {
    /// Above the ground, along its normal, m.
    pub height_m: f64,
    /// Turned about the stance sole's x axis, rad.
    pub roll_rad: f64,
    /// Then about its y axis, rad.
    pub pitch_rad: f64,
    /// Then about the ground's normal, rad.
    pub yaw_rad: f64,
    /// Moved along the ground, m.
    pub position_m: [f64; 2],
    /// Joints that begin elsewhere, by name, rad or m beside the posture.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub joint_offset: BTreeMap<String, f64>,
}

/// Boxes on the ground and gaps in it, in the axes of the ground: x, y along it, z up from it, its origin where the world's is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainSettings {
    /// Boxes: a list `[[terrain.box]]`.
    #[serde(rename = "box", with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<BoxSettings>")]
    pub boxes: Vec<BoxSettings>,
    /// Gaps: a list `[[terrain.gap]]`.
    #[serde(rename = "gap", with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<GapSettings>")]
    pub gaps: Vec<GapSettings>,
}

impl TerrainSettings {
    /// Whether the ground is plain.
    pub fn is_empty(&self) -> bool {
        self.boxes.is_empty() && self.gaps.is_empty()
    }
}

/// A box on the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BoxSettings {
    /// Its centre, m.
    pub center_m: [f64; 3],
    /// Half of its length, width and height, m.
    pub half_size_m: [f64; 3],
    /// How it is turned about the ground's normal, rad.
    pub yaw_rad: f64,
}

/// A rectangle without ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GapSettings {
    /// Smallest x and y, m.
    pub min_m: [f64; 2],
    /// Largest x and y, m.
    pub max_m: [f64; 2],
}

impl Default for BoxSettings {
    fn default() -> Self {
        Self { center_m: [0.0; 3], half_size_m: [0.1; 3], yaw_rad: 0.0 }
    }
}

impl Default for GapSettings {
    fn default() -> Self {
        Self { min_m: [0.0; 2], max_m: [0.1; 2] }
    }
}
