//! The keys of a scenario. Field names are the key names.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{
    BoxSettings, FaultSettings, GaitSettings, GapSettings, LeggedSettings, PlanSettings, RobotSettings,
    StartSettings, StepSettings, TerrainSettings, TimingSettings,
};

/// Everything that decides a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Scenario {
    /// Name in figures and folders; the file's name when not given.
    pub name: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Which clock the run follows.
    pub clock: Clock,
    /// Length of the run, s.
    pub duration_s: f64,
    /// The robot and how it stands.
    pub robot: RobotSettings,
    /// The simulation.
    pub plant: PlantSettings,
    /// What lies on the ground or is missing in it.
    #[serde(skip_serializing_if = "TerrainSettings::is_empty")]
    pub terrain: TerrainSettings,
    /// The sensors.
    pub sensors: SensorSettings,
    /// The controller.
    pub controller: ControllerSettings,
    /// The operating system's part: priority, memory, cores.
    pub process: ProcessSettings,
    /// A ball to fetch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reach: Option<ReachSettings>,
    /// Pushes: one table `[push]` or a list `[[push]]`.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<PushSettings>")]
    pub push: Vec<PushSettings>,
    /// Faults on purpose: one table `[fault]` or a list `[[fault]]`.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<FaultSettings>")]
    pub fault: Vec<FaultSettings>,
    /// A gait on four feet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gait: Option<GaitSettings>,
    /// Single steps: a list `[[step]]`.
    #[serde(with = "crate::list", skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "crate::list::OneOrMany<StepSettings>")]
    pub step: Vec<StepSettings>,
    /// A motion to be planned through contact.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plan: Option<PlanSettings>,
    /// What counts as success.
    pub success: SuccessSettings,
    /// What counts as timing kept: `delmpc timing`.
    pub timing: TimingSettings,
}

/// Which clock a run follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Clock {
    /// The wall clock; a late command is a late command.
    Realtime,
    /// One state, one command, as fast as it goes; the same seed gives the same bytes.
    Lockstep,
}

/// The simulation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlantSettings {
    /// Time step, s.
    pub step_s: f64,
    /// Coefficient of friction between robot and ground.
    pub friction: f64,
    /// The plant's masses and inertias are those of the model times this.
    pub mass_scale: f64,
    /// The inertias about the mass centres are further multiplied by this.
    pub inertia_scale: f64,
    /// The mass centres of the plant's links are this far from those of the model, in each link's frame, m.
    pub com_shift_m: [f64; 3],
    /// Time from a torque asked to the torque given, s; rounded to whole steps.
    pub actuator_delay_s: f64,
    /// Whether the actuators keep to the torque limits of the URDF.
    pub torque_limits: bool,
    /// How the ground is tilted about the world's x and y axes, rad. The robot starts on it with its posture turned along.
    pub slope_rad: [f64; 2],
    /// How far the ground sinks under the robot's weight on its stance foot at rest, m; 0: rigid.
    pub ground_sink_m: f64,
    /// Damping of ground that sinks, relative to the critical one of the robot's mass on it.
    pub ground_damping_ratio: f64,
}

/// The sensors. Their noise is given at `noise_scale = 1`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorSettings {
    /// Multiplies all noise and bias; 0 switches these and the resolutions off.
    pub noise_scale: f64,
    /// Age of a measurement when it is sent, s; rounded to whole steps.
    pub delay_s: f64,
    /// Noise of joint positions (rad or m). Noise is a standard deviation, new in every step.
    pub position_noise_rad: f64,
    /// Bias of joint positions (rad or m). Bias is a standard deviation, drawn once.
    pub position_bias_rad: f64,
    /// Smallest step of joint positions (rad or m).
    pub position_resolution_rad: f64,
    /// Noise of joint velocities (rad/s or m/s).
    pub velocity_noise_rad_s: f64,
    /// Smallest step of joint velocities (rad/s or m/s).
    pub velocity_resolution_rad_s: f64,
    /// Whether there is an inertial unit.
    pub inertial_unit: bool,
    /// Link it sits on; the root link when not given.
    pub imu_link: String,
    /// Its origin in the link's frame, m.
    pub imu_position_m: [f64; 3],
    /// Its axes in the link's frame: roll, pitch, yaw, rad.
    pub imu_rpy_rad: [f64; 3],
    /// What nobody knows of: it is further turned by this, roll, pitch, yaw in its own axes, rad.
    pub imu_misalignment_rad: [f64; 3],
    /// Noise of the gyroscope (rad/s).
    pub gyro_noise_rad_s: f64,
    /// Bias of the gyroscope at the start (rad/s).
    pub gyro_bias_rad_s: f64,
    /// Walk of that bias in a second (rad/s).
    pub gyro_bias_walk_rad_s: f64,
    /// Smallest step of the gyroscope (rad/s).
    pub gyro_resolution_rad_s: f64,
    /// Noise of the accelerometer (m/s²).
    pub accelerometer_noise_m_s2: f64,
    /// Bias of the accelerometer at the start (m/s²).
    pub accelerometer_bias_m_s2: f64,
    /// Walk of that bias in a second (m/s²).
    pub accelerometer_bias_walk_m_s2: f64,
    /// Smallest step of the accelerometer (m/s²).
    pub accelerometer_resolution_m_s2: f64,
    /// Whether motion capture sees the base: then it is measured, not estimated.
    pub motion_capture: bool,
    /// Noise of the base position seen by motion capture (m).
    pub base_position_noise_m: f64,
    /// Noise of the base orientation about each axis (rad).
    pub base_orientation_noise_rad: f64,
    /// Noise of the base's linear velocity (m/s).
    pub base_velocity_noise_m_s: f64,
    /// Noise of the base's angular velocity (rad/s).
    pub base_angular_velocity_noise_rad_s: f64,
    /// Whether every foot has a force and torque sensor.
    pub foot_wrench: bool,
    /// Noise of the foot's force sensor (N).
    pub foot_force_noise_n: f64,
    /// Noise of the foot's torque sensor (N m).
    pub foot_torque_noise_nm: f64,
}

/// What computes the torques.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ControllerKind {
    /// Model-predictive control.
    Mpc,
    /// One linear-quadratic regulator about the posture, torques clamped.
    StaticLqr,
    /// No torque.
    Off,
}

/// The controller.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ControllerSettings {
    /// What computes the torques.
    pub kind: ControllerKind,
    /// Control cycles per second.
    pub mpc_rate_hz: f64,
    /// How often per second the feedback law of the last command is evaluated.
    pub servo_rate_hz: f64,
    /// How far the controller looks ahead, s.
    pub horizon_s: f64,
    /// Stages the horizon is cut into.
    pub stages: usize,
    /// Control cycles from a state to the first moment its command may act.
    pub delay_cycles: u32,
    /// Oldest measurement the controller believes, s.
    pub max_state_age_s: f64,
    /// How long a command may be applied, s.
    pub command_life_s: f64,
    /// What the controller trades against each other.
    pub weights: WeightSettings,
    /// What it must keep to.
    pub constraints: ConstraintSettings,
    /// The same trade on several feet, or on the way.
    pub legged: LeggedSettings,
}

/// Weights of the controller's tasks: one over the square of the deviation that counts 1. 0 switches a task off.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WeightSettings {
    /// Every joint away from its reference, 1/rad².
    pub posture_per_rad2: f64,
    /// Every joint's speed, 1/(rad/s)².
    pub joint_speed_s2_per_rad2: f64,
    /// Every joint's torque, per square of its limit.
    pub torque_per_limit2: f64,
    /// Mass centre along x, y, z, 1/m².
    pub com_per_m2: [f64; 3],
    /// Its velocity, 1/(m/s)².
    pub com_velocity_s2_per_m2: [f64; 3],
    /// Angular momentum about it, 1/(N m s)².
    pub spin_per_n2m2s2: [f64; 3],
    /// Hand away from its way to the ball, 1/m².
    pub hand_per_m2: f64,
    /// Its velocity, 1/(m/s)².
    pub hand_velocity_s2_per_m2: f64,
    /// Swing foot away from where it hangs, along x, y, z, 1/m².
    pub swing_foot_per_m2: [f64; 3],
    /// Its rotation, 1/rad².
    pub swing_foot_rotation_per_rad2: f64,
}

/// Constraints of the controller. Joint limits come from the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ConstraintSettings {
    /// Part of the torque limits the plan may use.
    pub torque_fraction: f64,
    /// Coefficient of friction the plan counts on.
    pub friction: f64,
    /// Distance the plan keeps the pressure point from the edge of the sole, m.
    pub cop_margin_m: f64,
    /// Yaw torque the plan counts on, per vertical force, m.
    pub yaw_arm_m: f64,
}

/// What is asked of the operating system. What it refuses is a warning, not an error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ProcessSettings {
    /// Real-time priority (SCHED_FIFO) of the controller, 1 to 99; the plant, whose period is shorter, has one more. 0: ordinary
    /// priority for both.
    pub priority: u8,
    /// Whether all memory is kept in RAM.
    pub lock_memory: bool,
    /// Whether the cores named below are kept from falling asleep between two ticks. Costs power.
    pub keep_awake: bool,
    /// Core of the plant process; any when not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub plant_core: Option<usize>,
    /// Core of the controller process; any when not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub controller_core: Option<usize>,
    /// A process without a sign of life for this long has failed, s.
    pub hang_s: f64,
}

/// A ball to fetch with a hand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReachSettings {
    /// Frame of the robot that must reach the ball.
    pub hand: String,
    /// The ball in the sole frame at the start, m.
    pub ball_m: [f64; 3],
    /// When the motion begins, s.
    pub start_s: f64,
    /// When the hand must be there, s after `start_s`.
    pub deadline_s: f64,
    /// How long it stays there, s.
    pub hold_s: f64,
    /// How long the way back takes, s.
    pub return_s: f64,
}

/// A push: a constant force on the mass centre of a link.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PushSettings {
    /// Link that is pushed.
    pub link: String,
    /// Direction in the sole frame at the start, of any length: x forward, y left, z up.
    pub direction: [f64; 3],
    /// Force times duration, N s.
    pub impulse_ns: f64,
    /// When it begins, s.
    pub start_s: f64,
    /// How long it lasts, s.
    pub duration_s: f64,
}

/// What counts as success. A criterion about something that does not happen in the run is fulfilled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SuccessSettings {
    /// The robot must not fall.
    pub no_fall: bool,
    /// A foot that is in the air at the start must not touch the ground.
    pub no_touch_down: bool,
    /// Largest distance of hand and ball at the deadline, m.
    pub hand_error_at_deadline_m: f64,
    /// Largest distance of hand and ball while holding, m.
    pub hand_error_hold_max_m: f64,
    /// Farthest the stance foot may slip, m.
    pub max_stance_slip_m: f64,
    /// Farthest the stance foot may tilt, rad.
    pub max_stance_tilt_rad: f64,
    /// Smallest distance of the pressure point from the edge of the sole, m.
    pub min_cop_margin_m: f64,
    /// Largest torque relative to its limit.
    pub max_torque_ratio: f64,
    /// Longest time from a push until the robot is at rest again, s.
    pub settle_time_s: f64,
    /// Realtime only: smallest speed of the simulation relative to the wall clock.
    pub min_real_time_factor: f64,
}

impl Default for Scenario {
    fn default() -> Self {
        Self {
            name: String::new(),
            seed: 1,
            clock: Clock::Realtime,
            duration_s: 10.0,
            robot: RobotSettings::default(),
            plant: PlantSettings::default(),
            terrain: TerrainSettings::default(),
            sensors: SensorSettings::default(),
            controller: ControllerSettings::default(),
            process: ProcessSettings::default(),
            reach: None,
            push: Vec::new(),
            fault: Vec::new(),
            gait: None,
            step: Vec::new(),
            plan: None,
            success: SuccessSettings::default(),
            timing: TimingSettings::default(),
        }
    }
}

impl Default for PlantSettings {
    fn default() -> Self {
        Self {
            step_s: 0.001,
            friction: 0.7,
            mass_scale: 1.0,
            inertia_scale: 1.0,
            com_shift_m: [0.0; 3],
            actuator_delay_s: 0.0,
            torque_limits: true,
            slope_rad: [0.0; 2],
            ground_sink_m: 0.0,
            ground_damping_ratio: 0.3,
        }
    }
}

impl Default for SensorSettings {
    /// Good encoders, a tactical inertial unit on the root link, strain gauges under the feet.
    fn default() -> Self {
        Self {
            noise_scale: 1.0,
            delay_s: 0.0,
            position_noise_rad: 2e-5,
            position_bias_rad: 0.0,
            position_resolution_rad: 1e-5,
            velocity_noise_rad_s: 2e-3,
            velocity_resolution_rad_s: 0.0,
            inertial_unit: true,
            imu_link: String::new(),
            imu_position_m: [0.0; 3],
            imu_rpy_rad: [0.0; 3],
            imu_misalignment_rad: [0.0; 3],
            gyro_noise_rad_s: 2e-3,
            gyro_bias_rad_s: 1e-3,
            gyro_bias_walk_rad_s: 1e-5,
            gyro_resolution_rad_s: 0.0,
            accelerometer_noise_m_s2: 0.02,
            accelerometer_bias_m_s2: 0.01,
            accelerometer_bias_walk_m_s2: 1e-4,
            accelerometer_resolution_m_s2: 0.0,
            motion_capture: false,
            base_position_noise_m: 1e-4,
            base_orientation_noise_rad: 1e-4,
            base_velocity_noise_m_s: 2e-3,
            base_angular_velocity_noise_rad_s: 2e-3,
            foot_wrench: true,
            foot_force_noise_n: 2.0,
            foot_torque_noise_nm: 0.2,
        }
    }
}

impl Default for ControllerSettings {
    fn default() -> Self {
        Self {
            kind: ControllerKind::Mpc,
            mpc_rate_hz: 200.0,
            servo_rate_hz: 1000.0,
            horizon_s: 1.0,
            stages: 20,
            delay_cycles: 1,
            max_state_age_s: 0.05,
            command_life_s: 0.1,
            weights: WeightSettings::default(),
            constraints: ConstraintSettings::default(),
            legged: LeggedSettings::default(),
        }
    }
}

impl Default for WeightSettings {
    /// Bryson's rule: 0.22 rad of posture, 1.4 rad/s, 2 cm of the mass centre, 7 cm/s, 1 cm of the hand count 1 each.
    fn default() -> Self {
        Self {
            posture_per_rad2: 20.0,
            joint_speed_s2_per_rad2: 0.5,
            torque_per_limit2: 500.0,
            com_per_m2: [2000.0, 2000.0, 0.0],
            com_velocity_s2_per_m2: [200.0, 200.0, 0.0],
            spin_per_n2m2s2: [0.0; 3],
            hand_per_m2: 10_000.0,
            hand_velocity_s2_per_m2: 10.0,
            swing_foot_per_m2: [0.0, 0.0, 1000.0],
            swing_foot_rotation_per_rad2: 5.0,
        }
    }
}

impl Default for ConstraintSettings {
    fn default() -> Self {
        Self { torque_fraction: 0.98, friction: 0.6, cop_margin_m: 0.003, yaw_arm_m: 0.06 }
    }
}

impl Default for ProcessSettings {
    fn default() -> Self {
        Self {
            priority: 50,
            lock_memory: true,
            keep_awake: true,
            plant_core: None,
            controller_core: None,
            hang_s: 2.0,
        }
    }
}

impl Default for ReachSettings {
    fn default() -> Self {
        Self {
            hand: String::new(),
            ball_m: [0.0; 3],
            start_s: 1.0,
            deadline_s: 1.3,
            hold_s: 1.0,
            return_s: 1.5,
        }
    }
}

impl Default for PushSettings {
    fn default() -> Self {
        Self {
            link: String::new(),
            direction: [0.0, 1.0, 0.0],
            impulse_ns: 0.0,
            start_s: 0.0,
            duration_s: 0.1,
        }
    }
}

impl Default for SuccessSettings {
    fn default() -> Self {
        Self {
            no_fall: true,
            no_touch_down: true,
            hand_error_at_deadline_m: 0.02,
            hand_error_hold_max_m: 0.03,
            max_stance_slip_m: 0.005,
            max_stance_tilt_rad: 1.0_f64.to_radians(),
            min_cop_margin_m: 0.0,
            max_torque_ratio: 1.0,
            settle_time_s: 2.5,
            min_real_time_factor: 0.9,
        }
    }
}

impl Scenario {
    /// A scenario in which every key exists, however few a file gives: the catalogue of keys and of their types.
    pub(crate) fn catalogue() -> Self {
        Self {
            process: ProcessSettings {
                plant_core: Some(0),
                controller_core: Some(1),
                ..ProcessSettings::default()
            },
            reach: Some(ReachSettings::default()),
            push: vec![PushSettings::default()],
            robot: RobotSettings {
                start: StartSettings {
                    joint_offset: [(crate::document::ANY_NAME.to_owned(), 0.0)].into(),
                    ..StartSettings::default()
                },
                ..RobotSettings::default()
            },
            terrain: TerrainSettings {
                boxes: vec![BoxSettings::default()],
                gaps: vec![GapSettings::default()],
            },
            fault: vec![FaultSettings::default()],
            gait: Some(GaitSettings::default()),
            step: vec![StepSettings::default()],
            plan: Some(PlanSettings::catalogue()),
            timing: TimingSettings {
                max_misses: Some(0),
                max_wake_up_p99_s: Some(0.0),
                max_cycle_p999_s: Some(0.0),
                max_age_p99_s: Some(0.0),
                ..TimingSettings::default()
            },
            ..Self::default()
        }
    }

    /// Plant steps per control cycle. The range checks make it a whole number.
    pub fn steps_per_cycle(&self) -> u32 {
        (1.0 / (self.controller.mpc_rate_hz * self.plant.step_s)).round() as u32
    }

    /// Plant steps of the whole run.
    pub fn steps(&self) -> u64 {
        (self.duration_s / self.plant.step_s).round() as u64
    }

    /// Things that are allowed but probably not meant.
    pub fn warnings(&self) -> Vec<String> {
        let end = self.duration_s;
        let mut warnings = Vec::new();
        if let Some(reach) = self.reach.as_ref().filter(|reach| reach.start_s + reach.deadline_s > end) {
            let deadline = reach.start_s + reach.deadline_s;
            warnings
                .push(format!("the ball's deadline at {deadline} s is after the end of the run at {end} s"));
        }
        for push in self.push.iter().filter(|push| push.impulse_ns > 0.0 && push.start_s >= end) {
            let start = push.start_s;
            warnings.push(format!("the push at {start} s is after the end of the run at {end} s"));
        }
        warnings
    }
}
