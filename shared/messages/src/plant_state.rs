//! Plant to controller: what the sensors say and what the actuators did.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::header::message;
use crate::{
    FallbackLevel, Header, LARGEST_COORDINATE, LARGEST_EFFORT, MAX_JOINTS, Message, MessageError, check,
};

/// One measurement of the whole robot.
///
/// | field | meaning | unit | frame |
/// |---|---|---|---|
/// | `position`, `velocity` | joints, in the order of the joint set | rad or m, per s | joint |
/// | `applied_torque` | torque the actuators gave during the step before `time_ns` | N m or N | joint |
/// | `imu_angular_velocity`, `imu_specific_force` | gyroscope and accelerometer: `Rᵀ (a - g)`, upwards 9.8 at rest | rad/s, m/s² | inertial unit |
/// | `imu_angle`, `imu_velocity` | sums of all their samples times the time between them, since the start: what happened between two messages is not lost | rad, m/s | inertial unit |
/// | `feet` | wrench of the ground *on* each foot, torque about the origin of its sole frame | N m, N | sole |
/// | `base_position_w`, `base_orientation_w` | motion capture: origin and axes of the base link frame (the root link, the pelvis of Atlas) | m, 1 | world |
/// | `base_angular_velocity_b`, `base_linear_velocity_b` | motion capture: velocity of the base link frame and of its origin | rad/s, m/s | base link |
///
/// All of it is of the same moment, `time_ns`: a gyroscope half a millisecond behind the encoders costs a tenth of the push a robot
/// survives.
///
/// Which of the sensors there are is said by [`sensor`] bits; a controller does not look at a field without its bit. (A simulation may
/// fill in the base all the same, for those who watch.) Where the inertial unit sits on
/// the robot is not in the message: both sides take it from the scenario.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/PlantState/v2"))]
pub struct PlantState {
    /// Type, joint set, run, sequence.
    pub header: Header,
    /// Time at which the measured values were true, by the plant's clock (ns).
    pub time_ns: u64,
    /// Sequence of the [`crate::Command`] applied last; 0: none yet.
    pub applied_command_sequence: u64,
    /// Which clock `time_ns` is read from: [`ClockKind`].
    pub clock: u32,
    /// Joints in use, the first ones of each array.
    pub n_joints: u32,
    /// Feet in use, the first ones of `feet`: the soles of the robot's companion table in their order.
    pub n_feet: u32,
    /// Which sensors there are: bits of [`sensor`].
    pub sensors: u32,
    /// What happened so far: bits of [`status`].
    pub status_flags: u32,
    /// Level of the plant's own watchdog: [`FallbackLevel`].
    pub watchdog_level: u32,
    /// Joint positions.
    pub position: [f64; MAX_JOINTS],
    /// Joint velocities.
    pub velocity: [f64; MAX_JOINTS],
    /// Joint torques applied last.
    pub applied_torque: [f64; MAX_JOINTS],
    /// Sum of the gyroscope's samples times their time, since the start.
    pub imu_angle: [f64; 3],
    /// Sum of the accelerometer's samples times their time, since the start.
    pub imu_velocity: [f64; 3],
    /// Last sample of the gyroscope.
    pub imu_angular_velocity: [f64; 3],
    /// Last sample of the accelerometer.
    pub imu_specific_force: [f64; 3],
    /// The feet.
    pub feet: [FootReading; MAX_FEET],
    /// Origin of the base link frame in the world.
    pub base_position_w: [f64; 3],
    /// Orientation of the base link frame in the world: unit quaternion x, y, z, w.
    pub base_orientation_w: [f64; 4],
    /// Angular velocity of the base link, in its own axes.
    pub base_angular_velocity_b: [f64; 3],
    /// Velocity of the origin of the base link frame, in the axes of the base link.
    pub base_linear_velocity_b: [f64; 3],
}

/// Feet a message has room for.
pub const MAX_FEET: usize = 8;

/// What is measured at one foot.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/FootReading/v1"))]
pub struct FootReading {
    /// Bits of [`foot`].
    pub flags: u32,
    /// Zero.
    pub reserved: u32,
    /// Torque of the ground on the foot about the origin of the sole frame, in the axes of the sole (N m).
    pub torque_s: [f64; 3],
    /// Force of the ground on the foot, in the axes of the sole (N).
    pub force_s: [f64; 3],
}

/// Bits of [`FootReading::flags`].
pub mod foot {
    /// The foot has a force and torque sensor, and `torque_s` and `force_s` are what it says.
    pub const WRENCH: u32 = 1 << 0;
    /// A contact switch is closed. Where there is a wrench it decides, not the switch.
    pub const TOUCHES: u32 = 1 << 1;
}

/// Bits of [`PlantState::sensors`].
pub mod sensor {
    /// There is an inertial unit: `imu_angular_velocity` and `imu_specific_force`.
    pub const INERTIAL_UNIT: u32 = 1 << 0;
    /// It sums up its samples: `imu_angle` and `imu_velocity`.
    pub const INERTIAL_SUMS: u32 = 1 << 1;
    /// The base is seen from outside: `base_position_w` to `base_linear_velocity_b`.
    pub const MOTION_CAPTURE: u32 = 1 << 2;
}

message!(PlantState, "delmpc/PlantState/v2", b"DMPS", 2);

/// Bits of [`PlantState::status_flags`].
pub mod status {
    /// The robot fell. Stays set until the end of the run.
    pub const FELL: u32 = 1 << 0;
    /// The plant has reached the end of the run and sends no further state.
    pub const FINISHED: u32 = 1 << 1;
    /// The plant's watchdog ignored the controller in the last step, since its commands were late, missing or refused.
    pub const WATCHDOG: u32 = 1 << 2;
    /// At least one actuator was at its limit in the last step.
    pub const SATURATED: u32 = 1 << 3;
    /// A disturbance acted in the last step.
    pub const DISTURBED: u32 = 1 << 4;
}

/// What a plant's time is measured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ClockKind {
    /// Simulated time from 0, advanced step by step (`lockstep`).
    Simulated = 0,
    /// The machine's monotonic clock (`realtime`).
    Monotonic = 1,
}

impl ClockKind {
    /// The kind with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        [Self::Simulated, Self::Monotonic].into_iter().find(|kind| *kind as u32 == code)
    }
}

impl PlantState {
    /// A state at rest at the world's origin, with sequence 0 and `n_joints` joints at 0.
    pub fn new(run_id: u64, joint_set_hash: u64, n_joints: u32) -> Self {
        Self {
            header: Header::new::<Self>(run_id, joint_set_hash),
            n_joints,
            base_orientation_w: [0.0, 0.0, 0.0, 1.0],
            ..Self::zeroed()
        }
    }

    /// Checks everything that can be checked without knowing the past: type, version, joint set and count, time, codes, every number of a
    /// sensor that is there finite and plausible, the quaternion of unit length. Freshness is the receiver's business: it knows the last
    /// sequence and time.
    ///
    /// Cost: O(n), no allocation.
    ///
    /// # Errors
    /// The first thing found wrong, by name.
    pub fn validate(&self, expected_joint_set_hash: u64, n_joints: usize) -> Result<(), MessageError> {
        self.header.validate::<Self>(expected_joint_set_hash)?;
        let n = check::joint_count(Self::NAME, self.n_joints, n_joints)?;
        check::time(Self::NAME, "time_ns", self.time_ns)?;
        check::known(Self::NAME, "clock", self.clock, ClockKind::from_code(self.clock))?;
        let level = FallbackLevel::from_code(self.watchdog_level);
        check::known(Self::NAME, "watchdog_level", self.watchdog_level, level)?;

        let coordinate = |field, values| check::plausible(Self::NAME, field, values, LARGEST_COORDINATE);
        let effort = |field, values| check::plausible(Self::NAME, field, values, LARGEST_EFFORT);
        coordinate("position", &self.position[..n])?;
        coordinate("velocity", &self.velocity[..n])?;
        effort("applied_torque", &self.applied_torque[..n])?;
        let feet = self.n_feet as usize;
        if feet > MAX_FEET {
            let (found, capacity) = (feet, MAX_FEET);
            return Err(MessageError::TooManyFeet { message: Self::NAME, found, capacity });
        }
        if self.has_sensor(sensor::INERTIAL_UNIT) {
            coordinate("imu_angular_velocity", &self.imu_angular_velocity)?;
            coordinate("imu_specific_force", &self.imu_specific_force)?;
        }
        if self.has_sensor(sensor::INERTIAL_SUMS) {
            effort("imu_angle", &self.imu_angle)?;
            effort("imu_velocity", &self.imu_velocity)?;
        }
        for reading in self.feet[..feet].iter().filter(|reading| reading.flags & foot::WRENCH != 0) {
            effort("feet.torque_s", &reading.torque_s)?;
            effort("feet.force_s", &reading.force_s)?;
        }
        if self.has_sensor(sensor::MOTION_CAPTURE) {
            coordinate("base_position_w", &self.base_position_w)?;
            check::unit_quaternion(Self::NAME, "base_orientation_w", &self.base_orientation_w)?;
            coordinate("base_angular_velocity_b", &self.base_angular_velocity_b)?;
            coordinate("base_linear_velocity_b", &self.base_linear_velocity_b)?;
        }
        Ok(())
    }

    /// The feet in use.
    pub fn feet(&self) -> &[FootReading] {
        &self.feet[..(self.n_feet as usize).min(MAX_FEET)]
    }

    /// Whether all the given bits of [`sensor`] are set.
    pub fn has_sensor(&self, bits: u32) -> bool {
        self.sensors & bits == bits
    }

    /// Whether all the given bits of [`status`] are set.
    pub fn has_status(&self, flags: u32) -> bool {
        self.status_flags & flags == flags
    }
}
