//! The controller of a scenario.

use delmpc_controller_core::config::{ConstraintConfig, ControllerConfig};
use delmpc_controller_core::cycle::Clock as CycleClock;
use delmpc_controller_core::errors::ControlError;
use delmpc_controller_core::legged::LeggedController;
use delmpc_controller_core::prelude as core;
use delmpc_controller_core::prelude::{BodyPoint, ControllerModel, JointLimits, Reach, Sensing, TaskWeights};
use delmpc_controller_process::clock::monotonic_ns;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_estimation::prelude::{EstimatorConfig, EstimatorModel, FootModel};
use delmpc_lq::errors::LqError;
use delmpc_mechanics::reroot::Rerooted;
use delmpc_messages::{Command, PlantState};
use delmpc_planner::plan_file::Plan;
use delmpc_robots::RobotModel;
use delmpc_scenario::{Clock, ControllerKind, Scenario};

use crate::legged_robot;
use crate::plan_source::joint_motion;
use crate::setup::Setup;
use crate::verdict::Failure;

/// The cycle, and what times its steps.
#[derive(Debug)]
pub struct RobotController<K = RunClock> {
    cycle: Cycle,
    clock: K,
}

/// The cycle of a robot on one foot, or on any set of feet.
#[derive(Debug)]
enum Cycle {
    OneFoot(Box<core::Controller>),
    Legged(Box<LeggedController>),
}

/// The clock of an ordinary run.
#[derive(Debug, Clone, Copy)]
pub enum RunClock {
    /// The machine's.
    Machine,
    /// In lockstep nothing that depends on a clock enters the command.
    Stopped,
}

impl CycleClock for RunClock {
    fn now_ns(&self) -> u64 {
        match self {
            Self::Machine => monotonic_ns(),
            Self::Stopped => 0,
        }
    }
}

impl RobotController {
    /// For a scenario.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be controlled like that.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let clock = match setup.scenario.clock {
            Clock::Realtime => RunClock::Machine,
            Clock::Lockstep => RunClock::Stopped,
        };
        Self::with_clock(setup, clock)
    }
}

impl<K> RobotController<K> {
    /// For a scenario, by a clock of the caller's.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be controlled like that.
    pub fn with_clock(setup: &Setup, clock: K) -> Result<Self, Failure> {
        let refused =
            |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", setup.scenario.name));
        if setup.is_legged() {
            let robot = legged_robot::robot(setup).map_err(|error| refused(&error))?;
            let config = legged_robot::config(setup, &robot.model).map_err(|error| refused(&error))?;
            let controller = LeggedController::new(robot, config).map_err(|error| refused(&error))?;
            return Ok(Self { cycle: Cycle::Legged(Box::new(controller)), clock });
        }
        let model = model(setup).map_err(|error| refused(&error))?;
        let joints = model.message_joint.clone();
        let mut controller = core::Controller::new(model, config(setup))
            .map_err(|error| refused(&with_joint(&setup.robot, &joints, &error)))?;
        if let Some(plan) = &setup.plan {
            follow(&mut controller, plan, setup).map_err(|error| refused(&error))?;
        }
        controller.set_origin_ns(0);
        Ok(Self { cycle: Cycle::OneFoot(Box::new(controller)), clock })
    }

    /// How far from the ball the hand is in the posture in which the reach ends, m: not 0 when the ball cannot be reached in balance.
    pub fn out_of_reach_m(&self) -> Option<f64> {
        let controller = self.one_foot()?;
        controller.reference().reach.as_ref().map(|_| controller.hand_distance_left_m())
    }

    /// The controller of a robot on one foot: its plan, its model, its problem.
    pub fn one_foot(&self) -> Option<&core::Controller> {
        match &self.cycle {
            Cycle::OneFoot(controller) => Some(controller),
            Cycle::Legged(_) => None,
        }
    }

    /// The controller of a robot on any set of feet.
    pub fn legged(&self) -> Option<&LeggedController> {
        match &self.cycle {
            Cycle::OneFoot(_) => None,
            Cycle::Legged(controller) => Some(controller),
        }
    }

    /// The command of the last cycle.
    pub fn command(&self) -> &Command {
        match &self.cycle {
            Cycle::OneFoot(controller) => controller.command(),
            Cycle::Legged(controller) => controller.command(),
        }
    }

    /// What timed the steps.
    pub fn into_clock(self) -> K {
        self.clock
    }
}

impl<K: CycleClock> Controller for RobotController<K> {
    fn cycle(&mut self, state: &PlantState, now_ns: u64, command: &mut Command) {
        let (header, publish_ns) = (command.header, command.report.publish_ns);
        *command = match &mut self.cycle {
            Cycle::OneFoot(controller) => *controller.cycle(state, now_ns, &self.clock),
            Cycle::Legged(controller) => *controller.cycle(state, now_ns, &self.clock),
        };
        command.header = header;
        command.report.publish_ns = publish_ns;
    }

    fn prepare(&mut self) {
        if let Cycle::OneFoot(controller) = &mut self.cycle {
            controller.prepare(&self.clock);
        }
    }

    fn reason_in_words(&self, reason: u32) -> &'static str {
        delmpc_controller_core::cycle::reason::words(reason)
    }
}

/// The reach goes the way of a plan.
fn follow(controller: &mut core::Controller, plan: &Plan, setup: &Setup) -> Result<(), String> {
    let motion = joint_motion(plan, &setup.robot.joint_names)?;
    let motion = motion.in_order(&controller.model().message_joint).map_err(|error| error.to_string())?;
    controller.follow(&motion).map_err(|error| format!("plan {}: {error}", plan.name))
}

/// An error of the controller, with the joint that its index stands for: `joints` has the robot's joint for every one of the controller's.
fn with_joint(robot: &RobotModel, joints: &[usize], error: &ControlError) -> String {
    let index = match error {
        // States are positions, then velocities.
        ControlError::Lq(LqError::NoStabilisingSolution { state, .. }) => Some(state % joints.len().max(1)),
        ControlError::Value {
            quantity: "effort limit" | "velocity limit" | "position limit" | "posture",
            index,
            ..
        } => Some(*index),
        _ => None,
    };
    let joint = index.and_then(|index| joints.get(index)).copied();
    let Some((joint, limit)) = joint.and_then(|joint| Some((joint, robot.limits.get(joint)?))) else {
        return error.to_string();
    };
    let first = robot.tree.first_joint_body();
    let mass = robot.tree.bodies().get(first + joint).map_or(0.0, |body| body.inertia.mass);
    format!(
        "{error}; that is joint `{}`, with effort {} and a link of {mass} kg",
        robot.joint_names.get(joint).map_or("?", String::as_str),
        limit.effort
    )
}

/// The robot fixed at its stance sole.
fn model(setup: &Setup) -> Result<ControllerModel, String> {
    let (robot, scenario) = (&setup.robot, &setup.scenario);
    if !robot.tree.is_floating() {
        return bolted(setup);
    }
    let rooted = robot.rooted_at(setup.stance_frame()).map_err(|error| error.to_string())?;
    let standing = &rooted.model;
    let posture = standing.posture(&scenario.robot.posture).ok_or("the posture is missing")?;
    let sole = standing.sole(scenario.robot.stance.first()).ok_or("the sole is missing")?;
    let other = standing.soles.iter().find(|sole| sole.name != scenario.robot.stance.first());
    Ok(ControllerModel {
        tree: standing.tree.clone(),
        message_joint: ControllerModel::message_joints(&rooted.rerooted),
        joint_set_hash: setup.joint_set_hash(),
        limits: joint_limits(standing),
        sole: sole.polygon.iter().map(|corner| (*corner).into()).collect(),
        hand: scenario.reach.as_ref().and_then(|reach| point(standing, &reach.hand)),
        swing_foot: other.and_then(|sole| point(standing, &sole.frame)),
        posture: posture.q.clone(),
        sensing: Some(sensing(setup, rooted.rerooted)?),
    })
}

/// A robot that is bolted to the world: no sole, nothing to feel of it, no other foot.
fn bolted(setup: &Setup) -> Result<ControllerModel, String> {
    let (robot, scenario) = (&setup.robot, &setup.scenario);
    let posture = robot.posture(&scenario.robot.posture).ok_or("the posture is missing")?;
    let (hash, limits) = (setup.joint_set_hash(), joint_limits(robot));
    let hand = scenario.reach.as_ref().and_then(|reach| point(robot, &reach.hand));
    let standing = ControllerModel::standing(robot.tree.clone(), hash, limits, Vec::new(), posture.q.clone());
    Ok(ControllerModel { hand, ..standing })
}

/// What the robot feels of its base and feet.
fn sensing(setup: &Setup, rerooted: Rerooted) -> Result<Sensing, String> {
    let stance_foot = setup.stance_foot();
    let (estimator, config) = (estimator_model(setup)?, estimator_config(&setup.scenario));
    Ok(Sensing { estimator, config, stance_foot, rerooted })
}

/// The robot as the estimator has it, its feet in the order of the messages.
///
/// # Errors
/// In words: a sole or an inertial unit on no link.
pub fn estimator_model(setup: &Setup) -> Result<EstimatorModel, String> {
    let robot = &setup.robot;
    let feet: Vec<FootModel> = robot
        .soles
        .iter()
        .map(|sole| {
            let frame = robot.frame(&sole.frame);
            let on_body = frame.and_then(|frame| Some((frame.body?, frame.pose)));
            let (body, sole_pose) = on_body.ok_or_else(|| format!("sole {} is on no link", sole.name))?;
            let polygon = sole.polygon.iter().map(|corner| (*corner).into()).collect();
            Ok(FootModel { body, sole: sole_pose, polygon })
        })
        .collect::<Result<_, String>>()?;
    let (imu_body, imu_mounting) = setup.inertial_unit()?;
    Ok(EstimatorModel {
        imu_body,
        imu_mounting,
        reference_foot: setup.stance_foot(),
        ..EstimatorModel::new(robot.tree.clone(), feet)
    })
}

/// How good the sensors are.
pub fn estimator_config(scenario: &Scenario) -> EstimatorConfig {
    let s = &scenario.sensors;
    // Never better than a good sensor, however little noise the scenario has.
    let scaled = |value: f64, least: f64| (s.noise_scale * value).max(least);
    EstimatorConfig {
        sample_s: scenario.plant.step_s,
        gyro_noise: scaled(s.gyro_noise_rad_s, 1e-4),
        gyro_bias: scaled(s.gyro_bias_rad_s, 1e-3),
        gyro_bias_walk: scaled(s.gyro_bias_walk_rad_s, 1e-6),
        accelerometer_noise: scaled(s.accelerometer_noise_m_s2, 1e-3),
        accelerometer_bias: scaled(s.accelerometer_bias_m_s2, 1e-3),
        accelerometer_bias_walk: scaled(s.accelerometer_bias_walk_m_s2, 1e-5),
        position_noise: scaled(s.position_noise_rad.max(0.3 * s.position_resolution_rad), 1e-6),
        velocity_noise: scaled(s.velocity_noise_rad_s.max(0.3 * s.velocity_resolution_rad_s), 1e-4),
        foot_force_noise: s.noise_scale * s.foot_force_noise_n,
        ..EstimatorConfig::default()
    }
}

/// Limits of a robot's joints.
pub fn joint_limits(robot: &RobotModel) -> Vec<JointLimits> {
    let limit = |limit: &delmpc_robots::JointLimits| JointLimits {
        lower: limit.lower,
        upper: limit.upper,
        effort: limit.effort,
        velocity: limit.velocity,
    };
    robot.limits.iter().map(limit).collect()
}

/// What the plan keeps to.
pub fn constraints(scenario: &Scenario) -> ConstraintConfig {
    let limits = &scenario.controller.constraints;
    ConstraintConfig {
        torque_fraction: limits.torque_fraction,
        friction: limits.friction,
        cop_margin_m: limits.cop_margin_m,
        yaw_arm_m: limits.yaw_arm_m,
        ..ConstraintConfig::default()
    }
}

/// A frame's origin as a point of its body; `None` when it is fixed to the ground.
fn point(robot: &RobotModel, frame: &str) -> Option<BodyPoint> {
    let frame = robot.frame(frame)?;
    Some(BodyPoint { body: frame.body?, position: frame.pose.translation })
}

/// What is chosen for the controller of a robot on one foot, or on none.
pub fn config(setup: &Setup) -> ControllerConfig {
    let scenario = &setup.scenario;
    // Where the mass centre of a robot is that cannot fall counts for nothing.
    let balances = f64::from(u8::from(setup.robot.tree.is_floating()));
    let settings = &scenario.controller;
    let period_s = 1.0 / settings.mpc_rate_hz;
    let weights = &settings.weights;
    let delays_s = scenario.sensors.delay_s + scenario.plant.actuator_delay_s;
    ControllerConfig {
        kind: match settings.kind {
            ControllerKind::Mpc => core::ControllerKind::Mpc,
            ControllerKind::StaticLqr => core::ControllerKind::StaticLqr,
            ControllerKind::Off => core::ControllerKind::Off,
        },
        period_s,
        servo_period_s: 1.0 / settings.servo_rate_hz,
        delay_s: f64::from(settings.delay_cycles) * period_s + delays_s,
        stages: ControllerConfig::stages_for(settings.horizon_s, settings.stages, period_s),
        weights: TaskWeights {
            posture: weights.posture_per_rad2,
            joint_speed: weights.joint_speed_s2_per_rad2,
            torque: weights.torque_per_limit2,
            com: weights.com_per_m2.map(|weight| balances * weight),
            com_velocity: weights.com_velocity_s2_per_m2.map(|weight| balances * weight),
            spin: weights.spin_per_n2m2s2.map(|weight| balances * weight),
            hand: weights.hand_per_m2,
            hand_velocity: weights.hand_velocity_s2_per_m2,
            swing_foot: weights.swing_foot_per_m2,
            swing_foot_rotation: weights.swing_foot_rotation_per_rad2,
        },
        constraints: constraints(scenario),
        reach: scenario.reach.as_ref().map(|reach| Reach {
            ball_m: reach.ball_m,
            start_s: reach.start_s,
            deadline_s: reach.deadline_s,
            hold_s: reach.hold_s,
            return_s: reach.return_s,
        }),
        max_state_age_s: settings.max_state_age_s,
        command_life_s: settings.command_life_s,
        budget_s: period_s,
        ..ControllerConfig::default()
    }
}
