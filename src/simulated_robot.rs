//! The plant of a scenario: the robot with its feet, actuators, sensors and disturbances, standing in its posture.

use delmpc_controller_process::refusals::Refusals;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::prelude::{KinematicTree, RigidTransform, State};
use delmpc_messages::{ClockKind, Command, PlantState};
use delmpc_plant::prelude as simulation;
use delmpc_plant::prelude::{
    ActuatorConfig, ActuatorLimits, AffineLaw, CommandRefused, ContactOptions, ContactPoint, FallCause, Foot,
    FootReport, GroundGive, HoldingGains, InertialUnitConfig, ModelErrors, MonitorConfig, PlantConfig,
    PlantModel, SensorConfig, Terrain, TerrainBox, TerrainGap, WatchdogConfig,
};
use delmpc_robots::{Geometry, RobotModel, ShapeRole};
use delmpc_scenario::{Base, Clock, PushSettings, Scenario};
use nalgebra::Vector3;

use crate::legged_robot;
use crate::observer::{Motion, Observer};
use crate::plant_process::Plant;
use crate::setup::Setup;
use crate::start::{Start, slope};
use crate::steering::Pull;
use crate::truth::Truth;
use crate::verdict::Failure;

/// The simulation, and what it takes to tell the truth about it.
#[derive(Debug)]
pub struct SimulatedRobot {
    plant: simulation::Plant,
    observer: Observer,
    pushes: Vec<simulation::Push>,
    pull_w: Vector3<f64>,
    clock: ClockKind,
    body_names: Vec<String>,
    /// On several feet, or on its way.
    is_legged: bool,
    refusals: Refusals,
}

impl SimulatedRobot {
    /// For a scenario, at rest in its posture.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be simulated like that.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let (robot, scenario) = (&setup.robot, &setup.scenario);
        let refused = |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", scenario.name));
        let start = setup.start()?;
        let mut state = State::zeros(&robot.tree);
        state.base_pose = start.base_pose_w;
        state.q.copy_from_slice(&start.q);

        let holding = Holding::new(setup, &state).map_err(|error| refused(&error))?;
        let model = model(setup)?;
        let config = config(setup, &holding, &start)?;
        let mut plant = simulation::Plant::new(&model, &config, &state).map_err(|error| refused(&error))?;
        plant.preset_torque(&holding.torque).map_err(|error| refused(&error))?;
        let clock = match scenario.clock {
            Clock::Realtime => ClockKind::Monotonic,
            Clock::Lockstep => ClockKind::Simulated,
        };
        Ok(Self {
            plant,
            observer: Observer::new(setup)?,
            pushes: config.pushes,
            pull_w: Vector3::zeros(),
            clock,
            body_names: robot.body_names.clone(),
            is_legged: setup.is_legged(),
            refusals: Refusals::default(),
        })
    }
}

impl Plant for SimulatedRobot {
    fn accept(&mut self, command: &Command) -> bool {
        let taken = self.plant.accept(command);
        if let Err(error) = &taken {
            let kind = match error {
                CommandRefused::Message(error) => error.code(),
                CommandRefused::OutOfOrder { .. } => 100,
                CommandRefused::JumpAhead { .. } => 101,
                CommandRefused::TooEarly { .. } => 102,
                _ => 103,
            };
            self.refusals.tell(kind, || format!("a command is refused: {error}"));
        }
        taken.is_ok()
    }

    fn step(&mut self) -> Result<(), String> {
        self.plant.step().map(|_| ()).map_err(|error| error.to_string())
    }

    fn pull(&mut self, pull: &Pull) {
        let acts = pull.acts != 0;
        self.pull_w = if acts { pull.force_w.into() } else { Vector3::zeros() };
        self.plant.set_pull(acts.then(|| (pull.body as usize, pull.point_b.into(), self.pull_w)));
    }

    fn fall_cause(&self) -> Option<String> {
        let (_, cause) = self.plant.monitor().totals().fall?;
        Some(match cause {
            FallCause::MassCentreHeight => "the mass centre came down to half its height".to_owned(),
            FallCause::BaseTilt => "the base leans more than a radian from its start".to_owned(),
            FallCause::BodyContact { body } => {
                format!("{} touched the ground", self.body_names.get(body).map_or("a link", String::as_str))
            }
            FallCause::NoStep => "the integrator found no further step".to_owned(),
            FallCause::NotFinite => "the motion is no number".to_owned(),
        })
    }

    fn measure(&mut self, state: &mut PlantState) {
        self.plant.fill_state(state);
        state.clock = self.clock as u32;
    }

    fn truth(&mut self, truth: &mut Truth) {
        let readings = self.plant.truth();
        let motion = Motion {
            base_link_pose_w: &readings.base_pose_w,
            base_twist_b: &readings.base_twist_b,
            position: &readings.position,
            velocity: &readings.velocity,
            torque: &readings.applied_torque,
        };
        self.observer.observe(&motion, truth);

        let mut message = PlantState::new(0, 0, 0);
        self.plant.fill_state(&mut message);
        truth.time_ns = self.plant.time_ns();
        truth.status_flags = message.status_flags;
        truth.watchdog_level = message.watchdog_level;
        truth.contact_flags = self.plant.monitor().contact_flags();
        let monitor = self.plant.monitor();
        if let Some(foot) = monitor.reports().get(monitor.stance_foot()) {
            truth.stance_torque_b = foot.wrench.torque.into();
            truth.stance_force_b = foot.wrench.force.into();
            truth.stance_slip_m = foot.slip;
            truth.sole_tilt_rad = foot.tilt;
            truth.cop_margin_m = foot.pressure_margin.unwrap_or(f64::NAN);
            truth.friction_use = foot.pressure_margin.map_or(f64::NAN, |_| foot.friction_use);
        }
        truth.feet_touching = 0;
        for (k, foot) in monitor.reports().iter().take(truth.foot_slip_m.len()).enumerate() {
            truth.foot_slip_m[k] = foot.slip;
            truth.feet_touching |= u32::from(foot.touching) << k;
            if self.is_legged {
                judge_foot(foot, k == 0, truth);
            }
        }
        let totals = monitor.totals();
        // Relative to the energy moved; the first joule counts as a joule.
        truth.energy_balance_error = totals.energy_balance_error().abs() / totals.energy_moved.max(1.0);
        truth.push_force_w = (self.push_force_w(truth.time_ns) + self.pull_w).into();
    }
}

/// Of several feet the worst one that carries load counts: tilt, pressure point, friction.
fn judge_foot(foot: &FootReport, is_first: bool, truth: &mut Truth) {
    if is_first {
        (truth.sole_tilt_rad, truth.stance_slip_m) = (0.0, 0.0);
        (truth.cop_margin_m, truth.friction_use) = (f64::NAN, f64::NAN);
    }
    truth.stance_slip_m = truth.stance_slip_m.max(foot.slip);
    if foot.pressure_point.is_none() {
        return;
    }
    truth.friction_use = truth.friction_use.max(foot.friction_use);
    if let Some(margin) = foot.pressure_margin {
        truth.sole_tilt_rad = truth.sole_tilt_rad.max(foot.tilt);
        truth.cop_margin_m = truth.cop_margin_m.min(margin);
    }
}

impl SimulatedRobot {
    /// Force of all pushes in the step that ended at `time_ns`.
    fn push_force_w(&self, time_ns: u64) -> Vector3<f64> {
        let step_s = self.plant.contact().time_step();
        let begin_s = time_ns as f64 * 1e-9 - step_s;
        self.pushes.iter().map(|push| push.force_over(begin_s, step_s)).sum()
    }
}

/// What it takes to hold the posture, per joint of the floating robot: for a robot that stands still on its stance sole.
struct Holding {
    torque: Vec<f64>,
    gains: HoldingGains,
}

impl Holding {
    fn new(setup: &Setup, state: &State) -> Result<Self, String> {
        let robot = &setup.robot;
        if !robot.tree.is_floating() {
            return Self::bolted(setup, state);
        }
        let rooted = robot.rooted_at(setup.stance_frame()).map_err(|error| error.to_string())?;
        let tree = &rooted.model.tree;
        let posture = rooted.model.posture(&setup.scenario.robot.posture).ok_or("no posture")?;
        let joints = tree.joint_count();
        let (gravity, inertia) = weight_and_inertia(tree, &posture.q)?;
        let floating = |rooted_values: &[f64]| {
            let mut values = vec![0.0; joints];
            rooted
                .rerooted
                .joints_to_floating(rooted_values, &mut values)
                .map_err(|error| error.to_string())?;
            Ok::<_, String>(values)
        };
        let period = setup.scenario.plant.step_s;
        let gains = HoldingGains::new(&robot.tree, state, &floating(&inertia)?, period);
        let torque =
            if setup.is_legged() { legged_robot::holding_torque(setup)? } else { floating(&gravity)? };
        Ok(Self { torque, gains: gains.map_err(|error| error.to_string())? })
    }
}

impl Holding {
    /// Of a robot that is bolted to the world.
    fn bolted(setup: &Setup, state: &State) -> Result<Self, String> {
        let (torque, inertia) = weight_and_inertia(&setup.robot.tree, &state.q)?;
        let gains = HoldingGains::new(&setup.robot.tree, state, &inertia, setup.scenario.plant.step_s);
        Ok(Self { torque, gains: gains.map_err(|error| error.to_string())? })
    }
}

/// Of a fixed tree at rest: the torques that hold it, and what every joint turns (diagonal of the mass matrix).
fn weight_and_inertia(tree: &KinematicTree, q: &[f64]) -> Result<(Vec<f64>, Vec<f64>), String> {
    let mut kinematics = Kinematics::new(tree);
    let joints = tree.joint_count();
    let (mut gravity, mut mass_matrix) = (vec![0.0; joints], vec![0.0; joints * joints]);
    kinematics
        .update_positions(tree, &Configuration::fixed(q))
        .and_then(|()| {
            gravity_force_into(tree, &kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut gravity)
        })
        .and_then(|()| {
            mass_matrix_into(tree, &kinematics, &mut MassMatrixWorkspace::new(tree), &mut mass_matrix)
        })
        .map_err(|error| error.to_string())?;
    Ok((gravity, (0..joints).map(|joint| mass_matrix[joint * joints + joint]).collect()))
}

fn model(setup: &Setup) -> Result<PlantModel, Failure> {
    let (robot, scenario) = (&setup.robot, &setup.scenario);
    // What is bolted down touches nothing that moves.
    let floats = robot.tree.is_floating();
    let touching = robot.contacts.iter().filter(|contact| floats || contact.body.is_some());
    let contacts = touching.map(|contact| {
        let body = contact.body.ok_or_else(|| on_no_body(&contact.name))?;
        let (point, radius, friction) = (contact.position, contact.radius, scenario.plant.friction);
        Ok(ContactPoint { body, point, radius, friction })
    });
    let mut contacts = contacts.collect::<Result<Vec<_>, Failure>>()?;
    contacts.extend(body_contacts(setup));
    let soles = robot.soles.iter().filter(|_| floats);
    let feet = soles.map(|sole| {
        let frame = robot.frame(&sole.frame).ok_or_else(|| on_no_body(&sole.frame))?;
        Ok(Foot {
            body: frame.body.ok_or_else(|| on_no_body(&sole.frame))?,
            sole: frame.pose,
            contacts: sole.contacts.clone(),
            polygon: sole.polygon.iter().map(|corner| (*corner).into()).collect(),
        })
    });
    Ok(PlantModel {
        tree: robot.tree.clone(),
        contacts,
        feet: feet.collect::<Result<_, Failure>>()?,
        joint_set_hash: setup.joint_set_hash(),
    })
}

/// Points of the links' shapes, so that a robot that fell lies on the ground: of links without contact points of their own, collision
/// shapes where there are some, else those that are drawn.
fn body_contacts(setup: &Setup) -> Vec<ContactPoint> {
    let (robot, friction) = (&setup.robot, setup.scenario.plant.friction);
    let has_contacts = |body: usize| robot.contacts.iter().any(|contact| contact.body == Some(body));
    let has_collision = |link: &str| {
        robot.shapes.iter().any(|shape| shape.link == link && shape.role == ShapeRole::Collision)
    };
    let mut points = Vec::new();
    for shape in &robot.shapes {
        let Some(body) = shape.attachment.body.filter(|body| !has_contacts(*body)) else { continue };
        if shape.role == ShapeRole::Visual && has_collision(&shape.link) {
            continue;
        }
        // Half of the box around the shape.
        let half = match shape.geometry {
            Geometry::Box { size } => 0.5 * size,
            Geometry::Cylinder { radius, length } => Vector3::new(radius, radius, 0.5 * length),
            Geometry::Capsule { radius, length } => Vector3::new(radius, radius, 0.5 * length + radius),
            Geometry::Sphere { radius } => Vector3::repeat(radius),
        };
        let round = !matches!(shape.geometry, Geometry::Box { .. });
        for corner in 0..8 {
            let sign = |bit: usize| if corner >> bit & 1 == 0 { 1.0 } else { -1.0 };
            let mut at = Vector3::new(sign(0), sign(1), sign(2)).component_mul(&half);
            if round {
                // On the cylinder, not on the corners of its box.
                at.x *= std::f64::consts::FRAC_1_SQRT_2;
                at.y *= std::f64::consts::FRAC_1_SQRT_2;
            }
            let point = shape.attachment.pose.transform_point(&at);
            points.push(ContactPoint { body, point, radius: 0.0, friction });
        }
    }
    points
}

/// A joint's mechanical stop is this far beyond the range its motor is allowed, rad (m): a controller that keeps the range to some
/// thousandths must not be hit by the stop, and builders leave such a margin.
const STOP_BEYOND_RAD: f64 = 0.05;

fn config(setup: &Setup, holding: &Holding, start: &Start) -> Result<PlantConfig, Failure> {
    let Setup { robot, scenario, .. } = setup;
    let plant = &scenario.plant;
    let limits = robot.limits.iter().map(|limit| match plant.torque_limits {
        true => ActuatorLimits { effort: limit.effort, velocity: limit.velocity, ..ActuatorLimits::NONE },
        false => ActuatorLimits::NONE,
    });
    let stance = robot.soles.iter().position(|sole| sole.name == scenario.robot.stance.first());
    Ok(PlantConfig {
        time_step: plant.step_s,
        errors: ModelErrors {
            mass_scale: plant.mass_scale,
            inertia_scale: plant.inertia_scale,
            com_shift: plant.com_shift_m.into(),
            ..ModelErrors::default()
        },
        actuators: ActuatorConfig {
            limits: limits.collect(),
            delay: plant.actuator_delay_s,
            ..ActuatorConfig::default()
        },
        joint_ranges: robot
            .limits
            .iter()
            .map(|limit| [limit.lower - STOP_BEYOND_RAD, limit.upper + STOP_BEYOND_RAD])
            .collect(),
        terrain: terrain(scenario),
        contact: ContactOptions { ground: ground(setup), ..ContactOptions::default() },
        sensors: sensors(setup)?,
        pushes: pushes(setup)?,
        watchdog: held_by(holding, &start.q),
        monitor: monitor(setup, stance.unwrap_or(0)),
        seed: scenario.seed,
    })
}

/// A robot that is bolted down cannot fall: its first link may turn and its mass centre sink as they like.
fn monitor(setup: &Setup, stance_foot: usize) -> MonitorConfig {
    let usual = MonitorConfig { stance_foot, ..MonitorConfig::default() };
    match setup.robot.tree.is_floating() {
        true => usual,
        false => MonitorConfig {
            min_com_height_share: f64::NEG_INFINITY,
            max_base_tilt: std::f64::consts::PI,
            ..usual
        },
    }
}

/// The watchdog of a robot that is held like that.
fn held_by(holding: &Holding, position: &[f64]) -> WatchdogConfig {
    let HoldingGains { stiffness, damping } = &holding.gains;
    WatchdogConfig {
        // Holds the start until there is a command; afterwards a plan that ran out is nearer to the robot than its start.
        law: Some(AffineLaw::joint_stiffness(&holding.torque, position, stiffness, damping)),
        static_law: 0.0,
        stiffness: stiffness.clone(),
        damping: damping.clone(),
        ..WatchdogConfig::default()
    }
}

/// The watchdog of a scenario's servo.
///
/// # Errors
/// [`Failure::Input`] when the robot cannot be held in its posture.
pub fn watchdog(setup: &Setup) -> Result<WatchdogConfig, Failure> {
    let start = setup.start()?;
    let mut state = State::zeros(&setup.robot.tree);
    state.base_pose = start.base_pose_w;
    state.q.copy_from_slice(&start.q);
    let holding = Holding::new(setup, &state);
    let holding = holding.map_err(|error| Failure::Input(format!("{}: {error}", setup.scenario.name)))?;
    Ok(held_by(&holding, &start.q))
}

fn terrain(scenario: &Scenario) -> Terrain {
    let boxes = scenario.terrain.boxes.iter().map(|block| TerrainBox {
        center: block.center_m.into(),
        half_size: block.half_size_m.into(),
        yaw: block.yaw_rad,
    });
    let gaps = scenario.terrain.gaps.iter().map(|gap| TerrainGap { min: gap.min_m, max: gap.max_m });
    // The height of the floor under a mount is nobody's to know.
    let plane_height = (scenario.robot.base == Base::Floating).then_some(0.0);
    Terrain { plane_height, boxes: boxes.collect(), gaps: gaps.collect(), slope: slope(scenario) }
}

/// Spring and damper under every contact such that the robot's weight on its stance sole sinks as far as the scenario says.
fn ground(setup: &Setup) -> GroundGive {
    let Setup { robot, scenario, .. } = setup;
    let sink = scenario.plant.ground_sink_m;
    if sink == 0.0 {
        return GroundGive::RIGID;
    }
    let mass = robot.tree.total_mass() * scenario.plant.mass_scale;
    let standing = scenario.robot.stance.names().iter().filter_map(|name| robot.sole(name));
    let points = standing.map(|sole| sole.contacts.len()).sum::<usize>().max(1) as f64;
    let stiffness = mass * robot.tree.gravity_w().norm() / (sink * points);
    let critical = 2.0 * (stiffness * mass / points).sqrt();
    GroundGive { stiffness, damping: scenario.plant.ground_damping_ratio * critical }
}

fn sensors(setup: &Setup) -> Result<SensorConfig, Failure> {
    let settings = &setup.scenario.sensors;
    let (body, believed) = setup.inertial_unit().map_err(Failure::Input)?;
    let misalignment = RigidTransform::from_xyz_rpy(Vector3::zeros(), settings.imu_misalignment_rad.into());
    let mounting = believed * misalignment;
    let there = SensorConfig {
        delay: settings.delay_s,
        has_inertial_unit: settings.inertial_unit && setup.robot.tree.is_floating(),
        inertial_unit: InertialUnitConfig { body, mounting, ..InertialUnitConfig::PERFECT },
        has_foot_wrench: settings.foot_wrench,
        has_motion_capture: settings.motion_capture,
        ..SensorConfig::PERFECT
    };
    if settings.noise_scale == 0.0 {
        return Ok(there);
    }
    Ok(SensorConfig {
        position_noise: settings.position_noise_rad,
        position_bias: settings.position_bias_rad,
        position_resolution: settings.position_resolution_rad,
        velocity_noise: settings.velocity_noise_rad_s,
        velocity_resolution: settings.velocity_resolution_rad_s,
        inertial_unit: InertialUnitConfig {
            body,
            mounting,
            gyro_noise: settings.gyro_noise_rad_s,
            gyro_bias: settings.gyro_bias_rad_s,
            gyro_bias_walk: settings.gyro_bias_walk_rad_s,
            gyro_resolution: settings.gyro_resolution_rad_s,
            accelerometer_noise: settings.accelerometer_noise_m_s2,
            accelerometer_bias: settings.accelerometer_bias_m_s2,
            accelerometer_bias_walk: settings.accelerometer_bias_walk_m_s2,
            accelerometer_resolution: settings.accelerometer_resolution_m_s2,
        },
        base_position_noise: settings.base_position_noise_m,
        base_orientation_noise: settings.base_orientation_noise_rad,
        base_angular_velocity_noise: settings.base_angular_velocity_noise_rad_s,
        base_linear_velocity_noise: settings.base_velocity_noise_m_s,
        force_noise: settings.foot_force_noise_n,
        torque_noise: settings.foot_torque_noise_nm,
        noise_scale: settings.noise_scale,
        ..there
    })
}

/// The pushes of a scenario, in the world.
///
/// # Errors
/// [`Failure::Input`] for a link that is fixed to the world.
pub fn pushes(setup: &Setup) -> Result<Vec<simulation::Push>, Failure> {
    let start = setup.start()?;
    let pushes = setup.scenario.push.iter().filter(|push| push.impulse_ns > 0.0);
    pushes.map(|push| made_push(&setup.robot, push, &start)).collect()
}

fn made_push(robot: &RobotModel, push: &PushSettings, start: &Start) -> Result<simulation::Push, Failure> {
    let body = robot.link(&push.link).and_then(|link| link.body).ok_or_else(|| on_no_body(&push.link))?;
    Ok(simulation::Push {
        body,
        point: robot.tree.bodies()[body].inertia.com,
        direction_w: start.stance_frame_w.rotation * Vector3::from(push.direction),
        impulse: push.impulse_ns,
        start: push.start_s,
        duration: push.duration_s,
    })
}

fn on_no_body(name: &str) -> Failure {
    Failure::Input(format!(
        "`{name}` of the robot is fixed to the world: a plant needs it on a body that moves"
    ))
}
