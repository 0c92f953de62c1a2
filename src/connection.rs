//! What a process that is not ours needs to know of a run: `connection.json` in the run's folder, and the same in environment variables.
//!
//! `shared/messages/WIRE.md` says what to do with it.

use std::path::{Path, PathBuf};

use delmpc_messages::{Command, Heartbeat, Message, PlantState, Role};
use delmpc_plant::prelude::{AffineLaw, WatchdogConfig};
use delmpc_scenario::Clock;
use delmpc_transport::{Channel, JOINT_SET, MAX_PROCESSES, MOST_BORROWED, RunId};
use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde_json::{Value, json};

use crate::part::message_run_id;
use crate::plant_process::CommandQueue;
use crate::setup::Setup;
use crate::simulated_robot::{pushes, watchdog};
use crate::start::slope;
use crate::verdict::Failure;

/// Name and version of the description.
pub const FORMAT: &str = "delmpc/connection/v1";
/// Its file in the folder of a run.
pub const FILE: &str = "connection.json";

/// The description of a run, and where its files are.
#[derive(Debug, Clone)]
pub struct Connection {
    run: RunId,
    message_run_id: u64,
    clock: &'static str,
    joint_set_hash: u64,
    root: PathBuf,
    scenario: PathBuf,
    description: Value,
}

impl Connection {
    /// Of a run of the scenario in a file.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be held in its posture; [`Failure::Fault`] without a private folder for shared memory.
    pub fn new(setup: &Setup, run: RunId, scenario_file: &Path) -> Result<Self, Failure> {
        let scenario = &setup.scenario;
        let absolute = |path: &Path| std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let (root, scenario_file) = (run.root_path().map_err(Failure::fault)?, absolute(scenario_file));
        let message_run_id = message_run_id(run, scenario);
        let joint_set_hash = setup.joint_set_hash();
        let clock = match scenario.clock {
            Clock::Realtime => "realtime",
            Clock::Lockstep => "lockstep",
        };
        let hex = |number: u64| format!("{number:016x}");
        let ns = |seconds: f64| (seconds * 1e9).round() as u64;
        let description = json!({
            "format": FORMAT,
            "program": concat!("delmpc ", env!("CARGO_PKG_VERSION")),
            "run_id": run.to_string(),
            "message_run_id": hex(message_run_id),
            "joint_set_hash": hex(joint_set_hash),
            "clock": clock,
            "seed": scenario.seed,
            "scenario": scenario_file,
            "urdf": absolute(&setup.urdf),
            "companion": absolute(&setup.urdf.with_extension("toml")),
            "shared_memory": { "root": root, "prefix": run.prefix() },
            "services": services(run, joint_set_hash),
            "time": {
                "step_ns": ns(scenario.plant.step_s),
                "steps": scenario.steps(),
                "steps_per_cycle": scenario.steps_per_cycle(),
                "cycle_ns": ns(1.0 / scenario.controller.mpc_rate_hz),
                "sensor_delay_ns": ns(scenario.sensors.delay_s),
                "longest_lead_ns": CommandQueue::new(scenario).longest_lead_ns(),
            },
            "robot": robot(setup)?,
            "watchdog": watchdog_of(&watchdog(setup)?),
            "pushes": pushes_of(setup)?,
            "ground": {
                "friction": scenario.plant.friction,
                "orientation_w": xyzw(&slope(scenario)),
                "boxes": scenario.terrain.boxes.iter().map(|block| json!({
                    "center_m": block.center_m, "half_size_m": block.half_size_m, "yaw_rad": block.yaw_rad,
                })).collect::<Vec<_>>(),
            },
            "sensors": serde_json::to_value(&scenario.sensors).unwrap_or_default(),
            "plant": serde_json::to_value(&scenario.plant).unwrap_or_default(),
        });
        Ok(Self { run, message_run_id, clock, joint_set_hash, root, scenario: scenario_file, description })
    }

    /// The description.
    pub fn description(&self) -> &Value {
        &self.description
    }

    /// Writes `connection.json` into a folder.
    ///
    /// # Errors
    /// [`Failure::Fault`] when it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<PathBuf, Failure> {
        let file = folder.join(FILE);
        let text = serde_json::to_string_pretty(&self.description).map_err(Failure::fault)?;
        let written = std::fs::write(&file, text + "\n");
        written.map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))?;
        Ok(std::fs::canonicalize(&file).unwrap_or(file))
    }

    /// The environment of a process that is started for the run; `file` is the written description.
    pub fn environment(&self, file: &Path) -> Vec<(&'static str, String)> {
        let path = |path: &Path| path.to_string_lossy().into_owned();
        vec![
            ("DELMPC_CONNECTION", path(file)),
            ("DELMPC_RUN_ID", self.run.to_string()),
            ("DELMPC_MESSAGE_RUN_ID", format!("{:016x}", self.message_run_id)),
            ("DELMPC_JOINT_SET_HASH", format!("{:016x}", self.joint_set_hash)),
            ("DELMPC_SCENARIO", path(&self.scenario)),
            ("DELMPC_CLOCK", self.clock.to_owned()),
            ("DELMPC_SHM_ROOT", path(&self.root)),
            ("DELMPC_SHM_PREFIX", self.run.prefix()),
            ("DELMPC_SERVICES", format!("delmpc/{}/", self.run)),
        ]
    }
}

/// Every channel as a service of iceoryx2.
fn services(run: RunId, joint_set_hash: u64) -> Vec<Value> {
    let heartbeat = (Heartbeat::NAME, size_of::<Heartbeat>());
    let state = (PlantState::NAME, size_of::<PlantState>());
    let command = (Command::NAME, size_of::<Command>());
    let channels = [
        (Channel::State, state, "plant"),
        (Channel::Command, command, "controller"),
        (Channel::Truth, state, "plant"),
        (Channel::Heartbeat(Role::Plant), heartbeat, "plant"),
        (Channel::Heartbeat(Role::Controller), heartbeat, "controller"),
        (Channel::Heartbeat(Role::Supervisor), heartbeat, "supervisor"),
    ];
    let described = channels.into_iter().map(|(channel, (payload, size), publisher)| {
        let mut service = service_settings(channel);
        if let Some(service) = service.as_object_mut() {
            service.insert("name".to_owned(), run.service_name(channel).into());
            service.insert("payload".to_owned(), payload.into());
            service.insert("size".to_owned(), size.into());
            service.insert("published_by".to_owned(), publisher.into());
            let attributes = match channel.needs_same_joint_set() {
                true => json!({ JOINT_SET: format!("{joint_set_hash:016x}") }),
                false => json!({}),
            };
            service.insert("attributes".to_owned(), attributes);
        }
        service
    });
    described.collect()
}

/// What both ends of a channel must ask for.
pub fn service_settings(channel: Channel) -> Value {
    json!({
        "channel": channel.name(),
        "enable_safe_overflow": true,
        "history_size": 1,
        "subscriber_max_buffer_size": channel.buffer_size(),
        "subscriber_max_borrowed_samples": MOST_BORROWED,
        "max_publishers": 1,
        "max_subscribers": channel.max_subscribers(),
        "max_nodes": MAX_PROCESSES,
    })
}

fn robot(setup: &Setup) -> Result<Value, Failure> {
    let robot = &setup.robot;
    let start = setup.start()?;
    let base = robot.tree.is_floating().then(|| {
        // The start is told for the mass centre of the base, messages for its link frame.
        let com = robot.tree.bodies().first().map_or(Vector3::zeros(), |body| body.inertia.com);
        let rotation = &start.base_pose_w.rotation;
        (start.base_pose_w.translation - rotation * com, *rotation)
    });
    let (body, mounting) = setup.inertial_unit().map_err(Failure::Input)?;
    let place = |v: &Vector3<f64>| [v.x, v.y, v.z];
    let limits = |of: fn(&delmpc_robots::JointLimits) -> f64| {
        // What has no limit is null.
        robot.limits.iter().map(of).map(|limit| limit.is_finite().then_some(limit)).collect::<Vec<_>>()
    };
    Ok(json!({
        "joints": robot.joint_names,
        "effort_limit": limits(|limit| limit.effort),
        "velocity_limit": limits(|limit| limit.velocity),
        "position_lower": limits(|limit| limit.lower),
        "position_upper": limits(|limit| limit.upper),
        "torque_limits_apply": setup.scenario.plant.torque_limits,
        "base_link": robot.body_names.first(),
        "feet": robot.soles.iter().map(|sole| json!({ "name": sole.name, "frame": sole.frame })).collect::<Vec<_>>(),
        "stance_foot": setup.stance_foot(),
        "start": {
            "position": start.q,
            "base_position_w": base.as_ref().map(|(position, _)| place(position)),
            "base_orientation_w": base.as_ref().map(|(_, rotation)| xyzw(rotation)),
        },
        "stance_frame_w": {
            "position": place(&start.stance_frame_w.translation),
            "orientation": xyzw(&start.stance_frame_w.rotation),
        },
        "inertial_unit": {
            "link": robot.body_names.get(body),
            "position": place(&mounting.translation),
            "orientation": xyzw(&mounting.rotation),
        },
    }))
}

fn watchdog_of(watchdog: &WatchdogConfig) -> Value {
    let WatchdogConfig { hold_gains, static_law, gravity_hold, damping_only, .. } = watchdog;
    json!({
        "hold_gains_s": hold_gains,
        "static_law_s": static_law,
        "gravity_hold_s": gravity_hold,
        "damping_only_s": damping_only,
        "good_commands": watchdog.good_commands,
        "stiffness": watchdog.stiffness,
        "damping": watchdog.damping,
        "law": watchdog.law.as_ref().map(law_of),
    })
}

fn law_of(law: &AffineLaw) -> Value {
    let row_length = 2 * law.torque.len().max(1);
    json!({
        "torque": law.torque,
        "position_ref": law.position_ref,
        "gain": law.gain.chunks(row_length).collect::<Vec<_>>(),
    })
}

fn pushes_of(setup: &Setup) -> Result<Vec<Value>, Failure> {
    let names = setup.scenario.push.iter().filter(|push| push.impulse_ns > 0.0);
    let made = pushes(setup)?;
    let described = names.zip(&made).map(|(named, push)| {
        json!({
            "link": setup.robot.body_names.get(push.body).unwrap_or(&named.link),
            "point_b": [push.point.x, push.point.y, push.point.z],
            "direction_w": <[f64; 3]>::from(push.direction_w.normalize()),
            "impulse_ns": push.impulse,
            "start_s": push.start,
            "duration_s": push.duration,
        })
    });
    Ok(described.collect())
}

/// A rotation as quaternion x, y, z, w.
fn xyzw(rotation: &Matrix3<f64>) -> [f64; 4] {
    UnitQuaternion::from_matrix(rotation).coords.into()
}
