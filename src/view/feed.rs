//! Rows for the live page, from the messages the two processes send each other.
//!
//! What the page shows of the robot is what the sensors said. Mass centre, hand and pressure point are computed from it as those of the
//! log are from the truth.

use std::fmt::Write as _;

use delmpc_mechanics::prelude::{RigidTransform, Twist};
use delmpc_messages::{Command, PlantState, foot};
use delmpc_transport::{Channel, RunId, RunNode, SharedSubscriber, Subscriber};
use nalgebra::{Quaternion, UnitQuaternion, Vector2, Vector3};

use crate::observer::{Motion, Observer};
use crate::report::recording::{FrameBuilder, Table, cycle_table_of};
use crate::setup::Setup;
use crate::sole::{cop_margin_m, pressure_point};
use crate::truth::Truth;
use crate::verdict::Failure;

/// Simulated time between two rows (ns).
const PERIOD_NS: u64 = 25_000_000;

/// Listens to a run.
pub struct Feed {
    states: SharedSubscriber<PlantState>,
    commands: SharedSubscriber<Command>,
    observer: Observer,
    frames: FrameBuilder,
    polygon: Vec<Vector2<f64>>,
    pushes: Vec<(Vector3<f64>, f64, f64)>,
    stance_foot: usize,
    truth: Truth,
    command: Option<Box<Command>>,
    next_ns: u64,
}

impl Feed {
    /// For a run that is being started.
    ///
    /// # Errors
    /// [`Failure::Fault`] when shared memory is unusable.
    pub fn new(setup: &Setup, run: RunId) -> Result<Self, Failure> {
        let node = RunNode::open(run, setup.joint_set_hash()).map_err(Failure::fault)?;
        let stance_frame_w = setup.start()?.stance_frame_w;
        let pushes = setup.scenario.push.iter().filter(|push| push.impulse_ns > 0.0).map(|push| {
            let direction_w = stance_frame_w.rotation * Vector3::from(push.direction).normalize();
            let force = direction_w * (push.impulse_ns / push.duration_s);
            (force, push.start_s, push.start_s + push.duration_s)
        });
        let polygon = setup.robot.sole(setup.scenario.robot.stance.first()).map(|sole| sole.polygon.clone());
        Ok(Self {
            states: node.subscriber(Channel::State).map_err(Failure::fault)?,
            commands: node.subscriber(Channel::Command).map_err(Failure::fault)?,
            observer: Observer::new(setup)?,
            frames: FrameBuilder::new(setup),
            polygon: polygon.unwrap_or_default(),
            pushes: pushes.collect(),
            stance_foot: setup.stance_foot(),
            truth: Truth::new(setup.robot.joint_names.len() as u32),
            command: None,
            next_ns: 0,
        })
    }

    /// The next row as JSON, when there is a new state and it is time for one. `pull_w`: with what force a person pulls.
    pub fn next(&mut self, pull_w: [f64; 3]) -> Option<String> {
        if let Ok(Some(command)) = self.commands.receive_latest() {
            self.command = Some(Box::new(*command));
        }
        let state = *self.states.receive_latest().ok()??;
        if state.time_ns < self.next_ns {
            return None;
        }
        self.next_ns = state.time_ns + PERIOD_NS;
        self.observe(&state, pull_w);
        self.frames.put(&self.truth);
        let mut text = "{\"frame\":".to_owned();
        write_row(&mut text, &self.frames.take());
        if let Some(command) = self.command.as_deref().filter(|command| command.header.sequence > 0) {
            text.push_str(",\"cycle\":");
            write_row(&mut text, &cycle_table_of(command));
        }
        text.push('}');
        Some(text)
    }

    fn observe(&mut self, state: &PlantState, pull_w: [f64; 3]) {
        let joints = (state.n_joints as usize).min(state.position.len());
        let [x, y, z, w] = state.base_orientation_w;
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-6).unwrap_or_default();
        let rotation = rotation.to_rotation_matrix().into_inner();
        let base = RigidTransform { rotation, translation: state.base_position_w.into() };
        let twist = Twist::new(state.base_angular_velocity_b.into(), state.base_linear_velocity_b.into());
        let motion = Motion {
            base_link_pose_w: &base,
            base_twist_b: &twist,
            position: &state.position[..joints],
            velocity: &state.velocity[..joints],
            torque: &state.applied_torque[..joints],
        };
        let truth = &mut self.truth;
        self.observer.observe(&motion, truth);
        truth.time_ns = state.time_ns;
        truth.status_flags = state.status_flags;
        truth.watchdog_level = state.watchdog_level;
        let touching =
            state.feet().iter().enumerate().filter(|(_, reading)| reading.flags & foot::TOUCHES != 0);
        truth.contact_flags = self.frames.contacts_of_feet(touching.map(|(index, _)| 1 << index).sum());
        let stance = state.feet().get(self.stance_foot);
        truth.stance_torque_b = stance.map_or([0.0; 3], |reading| reading.torque_s);
        truth.stance_force_b = stance.map_or([0.0; 3], |reading| reading.force_s);
        truth.cop_margin_m = pressure_point(&truth.stance_torque_b, &truth.stance_force_b)
            .map_or(f64::NAN, |point| cop_margin_m(&self.polygon, &point));
        let time_s = truth.time_s();
        let acting = self.pushes.iter().filter(|(_, from_s, to_s)| (*from_s..*to_s).contains(&time_s));
        truth.push_force_w = acting.fold(Vector3::from(pull_w), |sum, (force, ..)| sum + force).into();
    }
}

/// The only row of a table as a JSON object; `null` for what is no number.
fn write_row(text: &mut String, table: &Table) {
    text.push('{');
    for (index, (name, column)) in table.iter().enumerate() {
        let comma = if index > 0 { "," } else { "" };
        let _ = write!(text, "{comma}\"{name}\":[");
        for (index, value) in column.values.iter().enumerate() {
            let comma = if index > 0 { "," } else { "" };
            let _ = match value.is_finite() {
                true => write!(text, "{comma}{value}"),
                false => write!(text, "{comma}null"),
            };
        }
        text.push(']');
    }
    text.push('}');
}
