//! The keys of `[plan]`: a motion to be planned through contact, `delmpc plan`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A motion to be planned. The robot and its start posture are those of `[robot]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanSettings {
    /// Plan that a run follows, relative to the scenario file; empty: planned on first use, and kept in `runs/plans`.
    pub file: String,
    /// Length of the motion, s.
    pub horizon_s: f64,
    /// Stages of the first plan; their lengths are free.
    pub stages: usize,
    /// Stages of the refined plan, a multiple of `stages`; 0: no refinement.
    pub refine_stages: usize,
    /// Guesses: the first is plain, the others are shifted by seeded sines; the cheapest plan is kept.
    pub guesses: usize,
    /// Time after which the search ends with what it has, s; 0: none.
    pub budget_s: f64,
    /// Way along x, m.
    pub distance_m: f64,
    /// Speed of the base along x at the start, m/s.
    pub start_speed_m_s: f64,
    /// Speed of the base along x asked for at the end, m/s.
    pub end_speed_m_s: f64,
    /// Coefficient of friction that the plan counts on.
    pub friction: f64,
    /// Whether a foot that carries may slide, against full friction.
    pub sliding: bool,
    /// Part of the joints' ranges that the plan keeps free at either end.
    pub range_margin: f64,
    /// Part of the torque limits that the plan may use.
    pub torque_fraction: f64,
    /// Torque limit of joints for which the URDF has none, N m.
    pub torque_limit_nm: f64,
    /// Rate limit of joints for which the URDF has none, rad/s.
    pub rate_limit_rad_s: f64,
    /// Largest part of the weight that a contact point carries in the mean of a stage; 0: any.
    pub point_load: f64,
    /// Part of the rate limits that the plan may use.
    pub rate_fraction: f64,
    /// Largest pitch, roll and yaw of the base, rad.
    pub base_attitude_rad: f64,
    /// Lowest and highest position of the base, m.
    pub base_height_m: [f64; 2],
    /// How far the base of the guess is raised, m.
    pub guess_lift_m: f64,
    /// Whether what happens before an impact is bounded too: speed of approach, joint rates, impulse.
    pub execution: bool,
    /// Largest speed of a contact point before it touches down, m/s (with `execution`).
    pub touchdown_speed_m_s: f64,
    /// Largest impulse of a contact at the end of a stage, N s (with `execution`).
    pub impact_impulse_ns: f64,
    /// Distance that footholds keep from edges, m.
    pub edge_margin_m: f64,
    /// Height by which legs clear obstacles, m.
    pub obstacle_margin_m: f64,
    /// Points of soles and of shanks that keep clear of ground and obstacles; 0: none.
    pub outline_points: [usize; 2],
    /// Frame that reaches for a target, for a robot that stands on its stance sole throughout; empty: none.
    pub hand: String,
    /// Where that frame should be at the end, in the frame of the stance sole, m.
    pub target_m: [f64; 3],
    /// Distance that the pressure point keeps from the edge of the sole, m (with `hand`).
    pub cop_margin_m: f64,
    /// Yaw torque that the sole takes per vertical force, m (with `hand`).
    pub yaw_arm_m: f64,
    /// Obstacles, cleared and never stood on: a table `[plan.obstacle]` or a list.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PlanObstacle>")]
    pub obstacle: Vec<PlanObstacle>,
    /// Gaps, across the whole way: a table `[plan.gap]` or a list.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PlanGap>")]
    pub gap: Vec<PlanGap>,
    /// Steps, across the whole way: a table `[plan.step]` or a list.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PlanStep>")]
    pub step: Vec<PlanStep>,
    /// Springs in joints, instead of the robot's: a table `[plan.spring]` or a list.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PlanSpring>")]
    pub spring: Vec<PlanSpring>,
    /// Bounds of coordinates, beside the robot's: a table `[plan.bound]` or a list.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PlanBound>")]
    pub bound: Vec<PlanBound>,
    /// What the plan trades against each other.
    pub weights: PlanWeightSettings,
}

/// A box to clear.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanObstacle {
    /// Where its middle is along x, m.
    pub x_m: f64,
    /// Height, m.
    pub height_m: f64,
    /// Length along x, m.
    pub thickness_m: f64,
}

/// A stretch without ground.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanGap {
    /// Where it begins along x, m.
    pub from_m: f64,
    /// Where it ends, m.
    pub to_m: f64,
}

/// A change of the ground's height.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanStep {
    /// Where it is along x, m.
    pub x_m: f64,
    /// Rise, m; negative: fall.
    pub rise_m: f64,
}

/// A spring in a joint.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanSpring {
    /// Joint.
    pub joint: String,
    /// Stiffness, N m/rad.
    pub stiffness_nm_per_rad: f64,
    /// Rest position, rad.
    pub rest_rad: f64,
}

/// Bounds of a coordinate.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanBound {
    /// Coordinate: a joint, or `base_x` and so on.
    pub coordinate: String,
    /// Lowest value, rad or m.
    pub min: f64,
    /// Highest value, rad or m.
    pub max: f64,
}

/// Weights of a plan: one over the square of the deviation that counts 1, integrated over time where it is a rate of cost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanWeightSettings {
    /// Torque that counts 1 per second, N m.
    pub torque_nm: f64,
    /// Joint rates.
    pub joint_rate_s2_per_rad2: f64,
    /// Style: right and left legs alike.
    pub legs_alike_per_rad2: f64,
    /// Style: the base at the mean speed.
    pub steady_speed_s2_per_m2: f64,
    /// Style: the base's attitude as at the start.
    pub base_attitude_per_rad2: f64,
    /// Style: the base's height as at the start.
    pub base_height_per_m2: f64,
    /// Style: the joints as at the start.
    pub posture_per_rad2: f64,
    /// Impulses, in stages of weight.
    pub impulse: f64,
    /// End: base where it should be.
    pub end_base: f64,
    /// End: joints as at the start.
    pub end_joints_per_rad2: f64,
    /// End: velocity of the base.
    pub end_base_rate: f64,
    /// End: joint rates.
    pub end_joint_rate_s2_per_rad2: f64,
}

impl Default for PlanWeightSettings {
    fn default() -> Self {
        Self {
            torque_nm: 20.0,
            joint_rate_s2_per_rad2: 1e-3,
            legs_alike_per_rad2: 0.0,
            steady_speed_s2_per_m2: 0.0,
            base_attitude_per_rad2: 0.0,
            base_height_per_m2: 0.0,
            posture_per_rad2: 0.0,
            impulse: 1e-3,
            end_base: 50.0,
            end_joints_per_rad2: 5.0,
            end_base_rate: 2.0,
            end_joint_rate_s2_per_rad2: 0.05,
        }
    }
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self {
            file: String::new(),
            horizon_s: 2.0,
            stages: 24,
            refine_stages: 0,
            guesses: 1,
            budget_s: 0.0,
            distance_m: 0.0,
            start_speed_m_s: 0.0,
            end_speed_m_s: 0.0,
            friction: 0.5,
            sliding: true,
            range_margin: 0.0,
            torque_fraction: 0.75,
            torque_limit_nm: 60.0,
            rate_limit_rad_s: 15.0,
            point_load: 0.0,
            rate_fraction: 1.0,
            base_attitude_rad: 0.8,
            base_height_m: [0.0, 10.0],
            guess_lift_m: 0.05,
            execution: false,
            touchdown_speed_m_s: 1.5,
            impact_impulse_ns: 6.0,
            edge_margin_m: 0.015,
            obstacle_margin_m: 0.04,
            outline_points: [0, 0],
            hand: String::new(),
            target_m: [0.0; 3],
            cop_margin_m: 0.01,
            yaw_arm_m: 0.05,
            obstacle: Vec::new(),
            gap: Vec::new(),
            step: Vec::new(),
            spring: Vec::new(),
            bound: Vec::new(),
            weights: PlanWeightSettings::default(),
        }
    }
}

impl PlanSettings {
    /// Settings in which every key exists.
    pub(crate) fn catalogue() -> Self {
        Self {
            obstacle: vec![PlanObstacle::default()],
            gap: vec![PlanGap::default()],
            step: vec![PlanStep::default()],
            spring: vec![PlanSpring::default()],
            bound: vec![PlanBound::default()],
            ..Self::default()
        }
    }

    /// Every number with its range: key, value, least, most.
    pub(crate) fn ranges(&self) -> Vec<(&'static str, f64, f64, f64)> {
        let w = &self.weights;
        let weight = |key, value| (key, value, 0.0, 1e9);
        vec![
            ("plan.horizon_s", self.horizon_s, 1e-2, 60.0),
            ("plan.stages", self.stages as f64, 2.0, 1000.0),
            ("plan.refine_stages", self.refine_stages as f64, 0.0, 10_000.0),
            ("plan.guesses", self.guesses as f64, 1.0, 1000.0),
            ("plan.budget_s", self.budget_s, 0.0, 1e6),
            ("plan.distance_m", self.distance_m, -100.0, 100.0),
            ("plan.start_speed_m_s", self.start_speed_m_s, -10.0, 10.0),
            ("plan.end_speed_m_s", self.end_speed_m_s, -10.0, 10.0),
            ("plan.friction", self.friction, 0.01, 10.0),
            ("plan.point_load", self.point_load, 0.0, 100.0),
            ("plan.rate_fraction", self.rate_fraction, 0.01, 1.0),
            ("plan.range_margin", self.range_margin, 0.0, 0.4),
            ("plan.torque_fraction", self.torque_fraction, 0.01, 1.0),
            ("plan.torque_limit_nm", self.torque_limit_nm, 1e-3, 1e6),
            ("plan.rate_limit_rad_s", self.rate_limit_rad_s, 1e-2, 1e4),
            ("plan.base_attitude_rad", self.base_attitude_rad, 0.01, 1.4),
            ("plan.base_height_m", self.base_height_m[0], -100.0, 100.0),
            ("plan.base_height_m", self.base_height_m[1], self.base_height_m[0], 100.0),
            ("plan.guess_lift_m", self.guess_lift_m, 0.0, 10.0),
            ("plan.touchdown_speed_m_s", self.touchdown_speed_m_s, 0.01, 100.0),
            ("plan.impact_impulse_ns", self.impact_impulse_ns, 1e-3, 1e4),
            ("plan.edge_margin_m", self.edge_margin_m, 0.0, 1.0),
            ("plan.obstacle_margin_m", self.obstacle_margin_m, 0.0, 1.0),
            ("plan.outline_points", self.outline_points[0] as f64, 0.0, 100.0),
            ("plan.outline_points", self.outline_points[1] as f64, 0.0, 100.0),
            ("plan.target_m", self.target_m.iter().fold(0.0, |worst: f64, x| worst.max(x.abs())), 0.0, 100.0),
            ("plan.cop_margin_m", self.cop_margin_m, 0.0, 1.0),
            ("plan.yaw_arm_m", self.yaw_arm_m, 1e-4, 10.0),
            ("plan.weights.torque_nm", w.torque_nm, 1e-6, 1e9),
            weight("plan.weights.joint_rate_s2_per_rad2", w.joint_rate_s2_per_rad2),
            weight("plan.weights.legs_alike_per_rad2", w.legs_alike_per_rad2),
            weight("plan.weights.steady_speed_s2_per_m2", w.steady_speed_s2_per_m2),
            weight("plan.weights.base_attitude_per_rad2", w.base_attitude_per_rad2),
            weight("plan.weights.base_height_per_m2", w.base_height_per_m2),
            weight("plan.weights.posture_per_rad2", w.posture_per_rad2),
            weight("plan.weights.impulse", w.impulse),
            weight("plan.weights.end_base", w.end_base),
            weight("plan.weights.end_joints_per_rad2", w.end_joints_per_rad2),
            weight("plan.weights.end_base_rate", w.end_base_rate),
            weight("plan.weights.end_joint_rate_s2_per_rad2", w.end_joint_rate_s2_per_rad2),
        ]
    }
}
