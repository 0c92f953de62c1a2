//! What really happened in a step, as opposed to what the sensors said: one record of the log, and what the figures are made of.

use bytemuck::{Pod, Zeroable};
use delmpc_messages::{MAX_FEET, MAX_JOINTS};

/// The truth at the end of one plant step. Plain data without padding, like the messages; frames and order are theirs too.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Truth {
    /// Time, by the plant's clock (ns).
    pub time_ns: u64,
    /// Joints in use, the first ones of each array.
    pub n_joints: u32,
    /// Bit i is set while contact point i of the robot's table touches the ground.
    pub contact_flags: u32,
    /// Bits of [`delmpc_messages::status`].
    pub status_flags: u32,
    /// Level of the plant's watchdog.
    pub watchdog_level: u32,
    /// Joint positions (rad or m).
    pub position: [f64; MAX_JOINTS],
    /// Joint velocities (rad/s or m/s).
    pub velocity: [f64; MAX_JOINTS],
    /// Torques the actuators gave (N m or N).
    pub torque: [f64; MAX_JOINTS],
    /// Origin of the base link frame in the world (m).
    pub base_position_w: [f64; 3],
    /// Orientation of the base link frame: unit quaternion x, y, z, w.
    pub base_orientation_w: [f64; 4],
    /// Angular velocity of the base link in its own axes (rad/s).
    pub base_angular_velocity_b: [f64; 3],
    /// Velocity of the origin of the base link frame, in its axes (m/s).
    pub base_linear_velocity_b: [f64; 3],
    /// Mass centre (m).
    pub com_w: [f64; 3],
    /// Its velocity (m/s).
    pub com_velocity_w: [f64; 3],
    /// Feet in use, the first ones of each array.
    pub n_feet: u32,
    /// Bit i is set while foot i touches the ground.
    pub feet_touching: u32,
    /// Origins of all soles (m).
    pub foot_position_w: [[f64; 3]; MAX_FEET],
    /// Paths of their contact patches along the ground since they touched down (m).
    pub foot_slip_m: [f64; MAX_FEET],
    /// Origin of the stance sole (m).
    pub sole_position_w: [f64; 3],
    /// Path of the sole's contact patch along the ground since it touched down (m).
    pub stance_slip_m: f64,
    /// Angle between the sole's normal and the ground's (rad).
    pub sole_tilt_rad: f64,
    /// Torque of the ground on the stance foot about the sole's origin, in its axes (N m).
    pub stance_torque_b: [f64; 3],
    /// Force of the ground on the stance foot, in the axes of the sole (N).
    pub stance_force_b: [f64; 3],
    /// Distance of the pressure point from the nearest edge of the sole, negative outside (m); NaN in the air.
    pub cop_margin_m: f64,
    /// Horizontal force over friction times vertical force; NaN in the air.
    pub friction_use: f64,
    /// Largest torque relative to its limit.
    pub torque_ratio: f64,
    /// Hand that reaches for the ball (m); NaN without a ball.
    pub hand_w: [f64; 3],
    /// Force of pushes (N).
    pub push_force_w: [f64; 3],
    /// Change of energy that no work explains, relative to the kinetic and potential range seen; NaN when unknown.
    pub energy_balance_error: f64,
}

impl Truth {
    /// Everything zero, on the ground, without a ball.
    pub fn new(n_joints: u32) -> Self {
        Self {
            n_joints,
            base_orientation_w: [0.0, 0.0, 0.0, 1.0],
            cop_margin_m: f64::NAN,
            friction_use: f64::NAN,
            hand_w: [f64::NAN; 3],
            energy_balance_error: f64::NAN,
            ..Self::zeroed()
        }
    }

    /// Time, s.
    pub fn time_s(&self) -> f64 {
        self.time_ns as f64 / 1e9
    }
}
