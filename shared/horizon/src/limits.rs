//! What joints and contacts may do: limits of the robot, and what the plan keeps of them.

/// Limits of one joint; infinite where there is none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Lowest position, rad or m.
    pub lower: f64,
    /// Highest position, rad or m.
    pub upper: f64,
    /// Largest torque, N·m or N.
    pub effort: f64,
    /// Largest speed, rad/s or m/s.
    pub velocity: f64,
}

/// The constraints of the horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConstraintConfig {
    /// Part of the effort limit the plan may use.
    pub torque_fraction: f64,
    /// Coefficient of friction counted on.
    pub friction: f64,
    /// Sides of the friction pyramid.
    pub friction_sides: usize,
    /// Distance of the pressure point from the sole's edges, m.
    pub cop_margin_m: f64,
    /// Yaw torque per normal force, m.
    pub yaw_arm_m: f64,
    /// Least normal force as a part of the weight.
    pub min_force_fraction: f64,
    /// Cost per N of a contact force beyond its cone (moments: per 0.1 N·m).
    pub contact_penalty: f64,
    /// Cost per rad of a joint beyond its position limit.
    pub position_penalty: f64,
    /// Cost per rad/s of a joint beyond its velocity limit.
    pub velocity_penalty: f64,
}

impl Default for ConstraintConfig {
    fn default() -> Self {
        Self {
            torque_fraction: 0.98,
            friction: 0.6,
            friction_sides: 8,
            cop_margin_m: 0.003,
            yaw_arm_m: 0.06,
            min_force_fraction: 0.1,
            contact_penalty: 1.0,
            position_penalty: 1e4,
            velocity_penalty: 1e3,
        }
    }
}
