//! The whole plant: servo, actuators, contact step, sensors, monitor. One call is one step; time is counted, never read.

use delmpc_mechanics::energy::{gravity_energy, spring_energy};
use delmpc_mechanics::forces::PointForce;
use delmpc_mechanics::kinematics::base_link_pose;
use delmpc_mechanics::load_response::BoundaryMotion;
use delmpc_mechanics::spatial::Twist;
use delmpc_mechanics::state::State;
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::{
    Command, FallbackLevel, FootReading, MAX_FEET, MAX_JOINTS, PlantState, ServoReadings, foot, sensor,
    status,
};
use nalgebra::{DMatrix, Rotation3, UnitQuaternion, Vector3};

use crate::actuators::{ActuatorConfig, Actuators};
use crate::contact_step::{ContactOptions, ContactPoint, ContactReport, ContactStep};
use crate::disturbances::{ModelErrors, Push};
use crate::error::{PlantError, require, require_length};
use crate::inertial_unit::InertialUnit;
use crate::joint_stops::JointStops;
use crate::monitor::{Foot, Monitor, MonitorConfig, StepWork};
use crate::sensors::{Readings, SensorConfig, Sensors};
use crate::terrain::Terrain;
use crate::watchdog_gains::{joint_inverse_inertia, spectral_radius};
use delmpc_servo::prelude::{CommandRefused, Servo, WatchdogConfig};

/// The robot as its builders describe it.
#[derive(Clone, Debug)]
pub struct PlantModel {
    /// Floating tree.
    pub tree: KinematicTree,
    /// Points that may touch the ground.
    pub contacts: Vec<ContactPoint>,
    /// Feet made of them.
    pub feet: Vec<Foot>,
    /// Hash of the joint names in order ([`delmpc_messages::joint_set_hash`]).
    pub joint_set_hash: u64,
}

/// Everything else, as a scenario gives it.
#[derive(Clone, Debug)]
pub struct PlantConfig {
    /// Step, s.
    pub time_step: f64,
    /// Ground.
    pub terrain: Terrain,
    /// Contact solver.
    pub contact: ContactOptions,
    /// How the plant differs from the model.
    pub errors: ModelErrors,
    /// Actuators.
    pub actuators: ActuatorConfig,
    /// Ranges of the joints, at whose ends they meet a stop (rad or m; infinite: none); empty: no stops.
    pub joint_ranges: Vec<[f64; 2]>,
    /// Sensors.
    pub sensors: SensorConfig,
    /// Pushes.
    pub pushes: Vec<Push>,
    /// Watchdog.
    pub watchdog: WatchdogConfig,
    /// When the robot counts as fallen, and on which foot it stands.
    pub monitor: MonitorConfig,
    /// Seed of all noise.
    pub seed: u64,
}

impl Default for PlantConfig {
    fn default() -> Self {
        Self {
            time_step: 1e-3,
            terrain: Terrain::default(),
            contact: ContactOptions::default(),
            errors: ModelErrors::default(),
            actuators: ActuatorConfig::default(),
            joint_ranges: Vec::new(),
            sensors: SensorConfig::PERFECT,
            pushes: Vec::new(),
            watchdog: WatchdogConfig::default(),
            monitor: MonitorConfig::default(),
            seed: 0,
        }
    }
}

/// What one step did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlantStep {
    /// The contact solver's account.
    pub contact: ContactReport,
    /// Rung of the fallback ladder the servo was on.
    pub level: FallbackLevel,
    /// Whether an actuator was at a limit.
    pub saturated: bool,
    /// Whether a push acted.
    pub disturbed: bool,
}

/// A simulated robot.
#[derive(Debug)]
pub struct Plant {
    tree: KinematicTree,
    step_ns: u64,
    steps: u64,
    state: State,
    contact: ContactStep,
    servo: Servo,
    actuators: Actuators,
    stops: JointStops,
    /// Torques of actuators and stops in this step.
    torque: Vec<f64>,
    sensors: Sensors,
    inertial_unit: InertialUnit,
    foot_readings: [FootReading; MAX_FEET],
    monitor: Monitor,
    pushes: Vec<Push>,
    pull: Option<PointForce>,
    acting: Vec<PointForce>,
    asked: Vec<f64>,
    velocity: Vec<f64>,
    truth: Readings,
    last: PlantStep,
}

impl Plant {
    /// A plant at rest or in motion at `state`, at time 0.
    ///
    /// # Errors
    /// [`PlantError`] for whatever is wrong in model or configuration.
    pub fn new(model: &PlantModel, config: &PlantConfig, state: &State) -> Result<Self, PlantError> {
        let dt = config.time_step;
        require(dt.is_finite() && (1e-5..=0.05).contains(&dt), "time step", dt, "in [1e-5, 0.05] s")?;
        let tree = config.errors.apply(&model.tree)?;
        let joints = tree.joint_count();
        if joints > MAX_JOINTS {
            return Err(PlantError::Shape { quantity: "joints", got: joints, expected: MAX_JOINTS });
        }
        if model.feet.len() > MAX_FEET {
            return Err(PlantError::Shape { quantity: "feet", got: model.feet.len(), expected: MAX_FEET });
        }
        let unit = &config.sensors.inertial_unit;
        if unit.body >= tree.body_count() {
            let (got, expected) = (unit.body, tree.body_count());
            return Err(PlantError::Shape { quantity: "body of the inertial unit", got, expected });
        }
        require_length("joint coordinates", state.q.len(), joints)?;
        require_length("momenta", state.p.len(), tree.dof())?;
        for push in &config.pushes {
            push.check(&tree, dt)?;
        }
        let mut contacts = model.contacts.clone();
        for contact in &mut contacts {
            contact.friction *= config.errors.friction_scale;
        }
        let options = ContactOptions {
            max_pushes: config.contact.max_pushes.max(config.pushes.len() + 1), // and the pull
            ..config.contact
        };
        let contact = ContactStep::new(&tree, dt, &contacts, config.terrain.clone(), options)?;
        let mut plant = Self {
            step_ns: (dt * 1e9).round() as u64,
            steps: 0,
            state: state.clone(),
            contact,
            servo: Servo::new(joints, model.joint_set_hash, config.watchdog.clone())?,
            actuators: Actuators::new(joints, dt, &config.actuators)?,
            stops: JointStops::new(&tree, state, dt, &config.joint_ranges)?,
            torque: vec![0.0; joints],
            sensors: Sensors::new(joints, model.feet.len(), dt, &config.sensors, config.seed)?,
            inertial_unit: InertialUnit::new(unit, config.sensors.noise_scale, config.seed),
            foot_readings: [FootReading { flags: 0, reserved: 0, torque_s: [0.0; 3], force_s: [0.0; 3] };
                MAX_FEET],
            monitor: Monitor::new(&tree, &contacts, &model.feet, config.monitor)?,
            acting: Vec::with_capacity(config.pushes.len() + 1),
            pull: None,
            pushes: config.pushes.clone(),
            asked: vec![0.0; joints],
            velocity: vec![0.0; tree.dof()],
            truth: Readings::zeros(joints, model.feet.len()),
            last: PlantStep {
                contact: ContactReport::default(),
                level: FallbackLevel::ZeroTorque,
                saturated: false,
                disturbed: false,
            },
            tree,
        };
        plant.start()?;
        plant.check_watchdog(&config.watchdog)?;
        Ok(plant)
    }

    /// Refuses a watchdog that would shake the robot: every rung's law, sampled at the plant's rate, on the robot with a free base.
    fn check_watchdog(&self, config: &WatchdogConfig) -> Result<(), PlantError> {
        let n = self.tree.joint_count();
        if n == 0 {
            return Ok(());
        }
        let diagonal = |values: &[f64]| {
            let value = |i: usize| values.get(i).copied().unwrap_or(0.0);
            DMatrix::from_fn(n, n, |row, column| if row == column { value(row) } else { 0.0 })
        };
        let none = DMatrix::zeros(n, n);
        let damping = diagonal(&config.damping);
        let mut laws = vec![
            ("spectral radius of the watchdog's gravity hold", diagonal(&config.stiffness), damping.clone()),
            ("spectral radius of the watchdog's damping", none, damping),
        ];
        if let Some(law) = &config.law {
            let part = |first: usize| DMatrix::from_fn(n, n, |row, j| -law.gain[row * 2 * n + first + j]);
            laws.push(("spectral radius of the watchdog's static law", part(0), part(n)));
        }
        let inverse = joint_inverse_inertia(&self.tree, &self.state)?;
        for (quantity, stiffness, damping) in laws {
            let radius = spectral_radius(&inverse, &stiffness, &damping, self.contact.time_step());
            // Without any gain every mode stays as it is.
            require(radius <= 1.0 + 1e-9, quantity, radius, "at most 1: lower its stiffness and damping")?;
        }
        Ok(())
    }

    fn start(&mut self) -> Result<(), PlantError> {
        let mut motion = BoundaryMotion::new(&self.tree);
        motion.update(&self.tree, &self.state).map_err(|cause| PlantError::Step { time: 0.0, cause })?;
        self.velocity.copy_from_slice(motion.velocity());
        self.monitor.set_start_energy(energy(&self.tree, &self.state, &motion)?);
        self.monitor.set_start(&self.tree, &motion);
        self.observe(&motion);
        self.sensors.preset();
        Ok(())
    }

    /// One step. Allocates only inside Clarabel.
    ///
    /// # Errors
    /// [`PlantError::Step`] when the integrator does not take the step: state and time stay as they were, the failure is counted.
    pub fn step(&mut self) -> Result<PlantStep, PlantError> {
        let (now_ns, dt) = (self.time_ns(), self.contact.time_step());
        let time = self.time();
        let fresh = self.sensors.fresh();
        foot_readings(&self.sensors, fresh, &mut self.foot_readings);
        let imu = self.sensors.config().has_inertial_unit;
        let readings = ServoReadings {
            position: &fresh.position,
            velocity: &fresh.velocity,
            imu: imu.then(|| (fresh.inertial.angle.into(), fresh.inertial.angular_velocity.into())),
            feet: &self.foot_readings[..fresh.foot_wrench.len()],
        };
        self.servo.torque_into(now_ns, &readings, &mut self.asked);
        let base = self.tree.base_dof();
        self.actuators.apply(&self.asked, &self.velocity[base..]);
        self.acting.clear();
        self.acting.extend(self.pushes.iter().filter_map(|push| push.point_force(&self.tree, time, dt)));
        self.acting.extend(self.pull);

        let stops = self.stops.update(&self.state.q, &self.velocity[base..]);
        for ((torque, motor), stop) in self.torque.iter_mut().zip(self.actuators.torque()).zip(stops) {
            *torque = motor + stop;
        }
        let solved = self.contact.solve(&self.tree, &self.state, &self.torque, &self.acting);
        let contact = solved.map_err(|cause| {
            self.monitor.count_failure(time);
            PlantError::Step { time, cause }
        })?;
        let work = self.work();
        self.state.copy_from(self.contact.next_state());
        self.steps += 1;

        let motion = self.contact.end_motion();
        self.velocity.copy_from_slice(motion.velocity());
        let energy = energy(&self.tree, &self.state, motion)?;
        let end = self.time();
        self.monitor.update(&self.tree, &self.contact, end, contact.converged, energy, &work);
        Self::observe_motion(&self.tree, motion, &mut self.inertial_unit, dt, &mut self.truth);
        self.observe_rest();
        self.last = PlantStep {
            contact,
            level: self.servo.level(),
            saturated: self.actuators.saturated(),
            disturbed: !self.acting.is_empty(),
        };
        Ok(self.last)
    }

    /// A force in {0} on a point of a body's link frame (m) that acts in every step from now on, until it is set again; `None`: none. A
    /// body that does not exist is pulled by nothing. No allocation.
    pub fn set_pull(&mut self, pull: Option<(usize, Vector3<f64>, Vector3<f64>)>) {
        self.pull = pull.and_then(|(body, point, force_w)| {
            let point_b = point - self.tree.bodies().get(body)?.inertia.com;
            Some(PointForce { body, point_b, force_w })
        });
    }

    /// Takes a command of the controller. No allocation.
    ///
    /// # Errors
    /// [`CommandRefused`]: the command before stays in force.
    pub fn accept(&mut self, command: &Command) -> Result<(), CommandRefused> {
        self.servo.accept(command, self.time_ns())
    }

    /// Work of the step just solved; exact, because the forces are held.
    fn work(&mut self) -> StepWork {
        let mut work = StepWork::default();
        let (next, del) = (self.contact.next_state(), self.contact.del());
        let dt = self.contact.time_step();
        for (joint, torque) in self.actuators.torque().iter().enumerate() {
            let way = next.q[joint] - self.state.q[joint];
            work.torque += torque * way;
            work.stop += self.stops.torque()[joint] * way;
        }
        for push in &self.acting {
            let place = |alpha: usize| del.body_pose(push.body, alpha).transform_point(&push.point_b);
            work.push += push.force_w.dot(&(place(del.unknown_nodes()) - place(0)));
        }
        for result in self.contact.results().iter().filter(|result| result.candidate) {
            work.contact += result.impulse_w.dot(&(result.end_w - result.start_w)) / dt;
        }
        for body in self.tree.first_joint_body()..self.tree.body_count() {
            let damping = self.tree.bodies()[body].joint.damping;
            if damping > 0.0 {
                let dof = self.tree.joint_dof(body);
                for (alpha, weight) in del.rule().weights().iter().enumerate() {
                    work.damping += weight * dt * damping * del.node_rate(alpha, dof).powi(2);
                }
            }
        }
        work
    }

    /// Truth and sensors at the present time, from a motion that is not the contact step's own.
    fn observe(&mut self, motion: &BoundaryMotion) {
        let dt = self.contact.time_step();
        Self::observe_motion(&self.tree, motion, &mut self.inertial_unit, dt, &mut self.truth);
        self.observe_rest();
    }

    /// What the inertial unit feels.
    fn observe_motion(
        tree: &KinematicTree,
        motion: &BoundaryMotion,
        unit: &mut InertialUnit,
        time_step: f64,
        truth: &mut Readings,
    ) {
        let (body, mounting) = (unit.config().body, unit.config().mounting);
        let kinematics = motion.kinematics();
        let pose_w = kinematics.link_poses_w()[body] * mounting;
        let velocity_w = motion.velocity_at_w(body, &pose_w.translation);
        let angular_velocity_w = kinematics.velocities_w()[body].angular;
        truth.inertial = unit.sample(&pose_w, &velocity_w, &angular_velocity_w, tree.gravity_w(), time_step);
    }

    /// Everything else, and the sensors.
    fn observe_rest(&mut self) {
        let base = self.tree.base_dof();
        let truth = &mut self.truth;
        truth.time_ns = self.steps * self.step_ns;
        truth.position.copy_from_slice(&self.state.q);
        truth.velocity.copy_from_slice(&self.velocity[base..]);
        truth.applied_torque.copy_from_slice(self.actuators.torque());
        if self.tree.is_floating() {
            let twist_w = Twist {
                angular: Vector3::from_column_slice(&self.velocity[..3]),
                linear: Vector3::from_column_slice(&self.velocity[3..6]),
            };
            truth.base_pose_w = base_link_pose(&self.tree, &self.state.base_pose);
            truth.base_twist_b = truth.base_pose_w.inverse_transform_twist(&twist_w);
        }
        for (wrench, report) in truth.foot_wrench.iter_mut().zip(self.monitor.reports()) {
            *wrench = report.wrench;
        }
        truth.contact_flags = self.monitor.contact_flags();
        self.sensors.read(truth);
    }

    /// Writes what the sensors tell into a message; header, clock and the bits other than this plant's own stay.
    pub fn fill_state(&self, message: &mut PlantState) {
        let told = self.sensors.told();
        let n = told.position.len();
        message.time_ns = told.time_ns;
        message.applied_command_sequence = self.servo.applied_sequence();
        message.n_joints = n as u32;
        message.n_feet = told.foot_wrench.len() as u32;
        let config = self.sensors.config();
        message.sensors = 0;
        for (bits, there) in [
            (sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS, config.has_inertial_unit),
            (sensor::MOTION_CAPTURE, config.has_motion_capture),
        ] {
            message.sensors |= if there { bits } else { 0 };
        }
        message.watchdog_level = self.servo.level() as u32;
        let watchdog = self.servo.on_watchdog(self.time_ns());
        for (bit, set) in [
            (status::FELL, self.monitor.totals().fall.is_some()),
            (status::WATCHDOG, watchdog),
            (status::SATURATED, self.last.saturated),
            (status::DISTURBED, self.last.disturbed),
        ] {
            if set {
                message.status_flags |= bit;
            } else {
                message.status_flags &= !bit;
            }
        }
        message.position[..n].copy_from_slice(&told.position);
        message.velocity[..n].copy_from_slice(&told.velocity);
        message.applied_torque[..n].copy_from_slice(&told.applied_torque);
        message.base_position_w = told.base_pose_w.translation.into();
        let rotation = Rotation3::from_matrix_unchecked(told.base_pose_w.rotation);
        let q = UnitQuaternion::from_rotation_matrix(&rotation);
        message.base_orientation_w = [q.i, q.j, q.k, q.w];
        message.base_angular_velocity_b = told.base_twist_b.angular.into();
        message.base_linear_velocity_b = told.base_twist_b.linear.into();
        message.imu_angle = told.inertial.angle.into();
        message.imu_velocity = told.inertial.velocity.into();
        message.imu_angular_velocity = told.inertial.angular_velocity.into();
        message.imu_specific_force = told.inertial.specific_force.into();
        foot_readings(&self.sensors, told, &mut message.feet);
    }

    /// Changes the friction coefficient of a contact point.
    ///
    /// # Errors
    /// [`PlantError`] for a negative coefficient or a contact that does not exist.
    pub fn set_friction(&mut self, contact: usize, friction: f64) -> Result<(), PlantError> {
        self.contact.set_friction(contact, friction)
    }

    /// Time, ns.
    pub fn time_ns(&self) -> u64 {
        self.steps * self.step_ns
    }

    /// Time, s.
    pub fn time(&self) -> f64 {
        self.steps as f64 * self.contact.time_step()
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// The true state.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The true generalised velocity: base twist in {0} (angular, linear), joints.
    pub fn velocity(&self) -> &[f64] {
        &self.velocity
    }

    /// The truth behind the sensors.
    pub fn truth(&self) -> &Readings {
        &self.truth
    }

    /// The plant's own model, errors included.
    pub fn tree(&self) -> &KinematicTree {
        &self.tree
    }

    /// Feet, falls, energy.
    pub fn monitor(&self) -> &Monitor {
        &self.monitor
    }

    /// Contacts of the last step.
    pub fn contact(&self) -> &ContactStep {
        &self.contact
    }

    /// Servo and watchdog.
    pub fn servo(&self) -> &Servo {
        &self.servo
    }

    /// Actuators.
    pub fn actuators(&self) -> &Actuators {
        &self.actuators
    }

    /// Starts as if this torque had been given for a long time. For robots that stand at the start.
    ///
    /// # Errors
    /// [`PlantError::Shape`] unless there is one torque per joint.
    pub fn preset_torque(&mut self, torque: &[f64]) -> Result<(), PlantError> {
        require_length("preset torques", torque.len(), self.tree.joint_count())?;
        self.actuators.preset(torque);
        self.truth.applied_torque.copy_from_slice(torque);
        Ok(())
    }

    /// What the sensors say now, without delay.
    pub fn fresh_readings(&self) -> &Readings {
        self.sensors.fresh()
    }
}

/// What is told of the feet.
fn foot_readings(sensors: &Sensors, told: &Readings, out: &mut [FootReading; MAX_FEET]) {
    let measured = if sensors.config().has_foot_wrench { foot::WRENCH } else { 0 };
    for (index, (reading, wrench)) in out.iter_mut().zip(&told.foot_wrench).enumerate() {
        let touches = if told.contact_flags & (1 << index) != 0 { foot::TOUCHES } else { 0 };
        *reading = FootReading {
            flags: measured | touches,
            reserved: 0,
            torque_s: wrench.torque.into(),
            force_s: wrench.force.into(),
        };
    }
}

/// Kinetic and potential energy, J.
fn energy(tree: &KinematicTree, state: &State, motion: &BoundaryMotion) -> Result<f64, PlantError> {
    let kinetic = 0.5 * state.p.iter().zip(motion.velocity()).map(|(p, v)| p * v).sum::<f64>();
    Ok(kinetic + gravity_energy(tree, motion.kinematics()) + spring_energy(tree, &state.q)?)
}
