//! The robot for viewers of logs: transforms of all links and joints as ROS 2 has them, shapes, forces and ball as JSON that describes itself.
//!
//! | channel | schema | when |
//! |---|---|---|
//! | `/tf` | `tf2_msgs/TFMessage`: every link in its parent | 30 Hz |
//! | `/joint_states` | `sensor_msgs/JointState`: positions, velocities, torques by name | 30 Hz |
//! | `/robot` | `foxglove.SceneUpdate`: the shapes, each fixed to its link; the ball | once |
//! | `/forces` | `foxglove.SceneUpdate`: ground reaction and push as arrows | 30 Hz |
//!
//! Of the scenes only the structure is the field's; their schemas are written here. Everything is computed from the truth by the log's
//! writer, never by the loop.

use delmpc_mechanics::prelude::{KinematicTree, RigidTransform};
use delmpc_robots::{Attachment, Geometry};
use nalgebra::{Quaternion, Rotation3, UnitQuaternion, Vector3};
use serde_json::{Value, json};

use crate::log_ros;
use crate::report::scene::shapes;
use crate::setup::Setup;
use crate::sole::pressure_point;
use crate::truth::Truth;

/// Time between two messages (ns).
const PERIOD_NS: u64 = 33_333_333;
/// Lengths of arrows: of the ground reaction for the robot's weight (m), of a push (m/N).
const WEIGHT_ARROW_M: f64 = 0.6;
const PUSH_ARROW_M_PER_N: f64 = 0.4 / 150.0;
const BALL_RADIUS_M: f64 = 0.035;

/// Channel of the links.
pub const TRANSFORMS: &str = "/tf";
/// Channel of the joints.
pub const JOINTS: &str = "/joint_states";
/// Channel of the shapes.
pub const ROBOT: &str = "/robot";
/// Channel of the forces.
pub const FORCES: &str = "/forces";

/// Messages of one moment: channel and content.
pub type Messages = Vec<(&'static str, Vec<u8>)>;

/// Makes the messages of a run.
#[derive(Debug, Clone)]
pub struct LogViewer {
    tree: KinematicTree,
    names: Vec<String>,
    joint_names: Vec<String>,
    robot: Value,
    sole: Option<Attachment>,
    weight_n: f64,
    next_ns: u64,
    begun: bool,
}

impl LogViewer {
    /// For the robot and the ball of a setup.
    pub fn new(setup: &Setup) -> Self {
        let robot = &setup.robot;
        let sole = robot.sole(setup.scenario.robot.stance.first()).and_then(|sole| robot.frame(&sole.frame));
        Self {
            tree: robot.tree.clone(),
            names: robot.body_names.clone(),
            joint_names: robot.joint_names.clone(),
            robot: robot_scene(setup),
            sole: sole.copied(),
            weight_n: robot.tree.total_mass() * robot.tree.gravity_w().norm(),
            next_ns: 0,
            begun: false,
        }
    }

    /// The messages that are due at a moment; none for a motion that is no number.
    pub fn messages(&mut self, truth: &Truth) -> Messages {
        let joints = self.tree.joint_count();
        let base = [&truth.base_position_w[..], &truth.base_orientation_w].concat();
        let Some(position) = truth.position.get(..joints) else { return Messages::new() };
        if truth.time_ns < self.next_ns || !base.iter().chain(position).all(|x| x.is_finite()) {
            return Messages::new();
        }
        self.next_ns = truth.time_ns + PERIOD_NS;
        let mut messages = Messages::new();
        if !self.begun {
            self.begun = true;
            messages.push((ROBOT, self.robot.to_string().into_bytes()));
        }
        let links = self.links(truth, position);
        let poses = links.iter().zip(&self.names).map(|((parent, pose), name)| {
            (parent.map_or("world", |parent| self.names[parent].as_str()), name.as_str(), *pose)
        });
        messages.push((TRANSFORMS, log_ros::transforms(truth.time_ns, poses)));
        let values = [&truth.position, &truth.velocity, &truth.torque].map(|list| &list[..joints]);
        messages.push((JOINTS, log_ros::joint_state(truth.time_ns, &self.joint_names, values)));
        messages.push((FORCES, self.forces(truth, &links).to_string().into_bytes()));
        messages
    }

    /// Every link in its parent.
    fn links(&self, truth: &Truth, position: &[f64]) -> Vec<(Option<usize>, RigidTransform)> {
        let first = self.tree.first_joint_body();
        let [x, y, z, w] = truth.base_orientation_w;
        let orientation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let base = RigidTransform {
            rotation: orientation.to_rotation_matrix().into_inner(),
            translation: truth.base_position_w.into(),
        };
        let link = |(index, body): (usize, &delmpc_mechanics::prelude::Body)| match index.checked_sub(first) {
            None => (None, base),
            Some(joint) => (body.parent, body.joint.placement * body.joint.motion(position[joint])),
        };
        self.tree.bodies().iter().enumerate().map(link).collect()
    }

    fn forces(&self, truth: &Truth, links: &[(Option<usize>, RigidTransform)]) -> Value {
        let mut arrows = Vec::new();
        let point = pressure_point(&truth.stance_torque_b, &truth.stance_force_b);
        if let (Some(sole), Some(point)) = (&self.sole, point) {
            let pose = sole.body.map_or(sole.pose, |body| pose_w(links, body) * sole.pose);
            let from = pose.transform_point(&Vector3::new(point.x, point.y, 0.0));
            let force =
                pose.rotation * Vector3::from(truth.stance_force_b) * (WEIGHT_ARROW_M / self.weight_n);
            arrows.push(arrow(&from, &force, [0.0, 0.45, 0.7]));
        }
        let push = Vector3::from(truth.push_force_w) * PUSH_ARROW_M_PER_N;
        if push.norm() > 1e-3 {
            arrows.push(arrow(&(Vector3::from(truth.com_w) - push), &push, [0.84, 0.37, 0.0]));
        }
        let none: [Value; 0] = [];
        json!({"deletions": none, "entities": [entity("forces", "world", truth.time_ns, [("arrows", arrows)])]})
    }
}

fn pose_w(links: &[(Option<usize>, RigidTransform)], body: usize) -> RigidTransform {
    let (parent, pose) = links[body];
    parent.map_or(pose, |parent| pose_w(links, parent) * pose)
}

/// The shapes of every link, and the ball.
fn robot_scene(setup: &Setup) -> Value {
    let robot = &setup.robot;
    let mut entities = Vec::new();
    for (index, shape) in shapes(robot).iter().enumerate() {
        let frame = shape.attachment.body.map_or("world", |body| &robot.body_names[body]);
        let [red, green, blue, alpha] = shape.rgba.unwrap_or([0.5, 0.55, 0.6, 1.0]);
        let colour = json!({"r": red, "g": green, "b": blue, "a": alpha});
        let primitive = |size: Vector3<f64>, more: Value| {
            let mut value =
                json!({"pose": pose(&shape.attachment.pose), "size": vector(&size), "color": colour});
            if let (Value::Object(value), Value::Object(more)) = (&mut value, more) {
                value.extend(more);
            }
            value
        };
        let round = |radius: f64, height: f64| Vector3::new(2.0 * radius, 2.0 * radius, height);
        let whole = json!({"bottom_scale": 1.0, "top_scale": 1.0});
        let (kind, value) = match shape.geometry {
            Geometry::Box { size } => ("cubes", primitive(size, json!({}))),
            Geometry::Sphere { radius } => ("spheres", primitive(round(radius, 2.0 * radius), json!({}))),
            Geometry::Cylinder { radius, length } => ("cylinders", primitive(round(radius, length), whole)),
            // Viewers know no capsule: its straight part and half of its caps.
            Geometry::Capsule { radius, length } => {
                ("cylinders", primitive(round(radius, length + radius), whole))
            }
        };
        entities.push(entity(&format!("{}-{index}", shape.link), frame, 0, [(kind, vec![value])]));
    }
    if let Some(ball_w) = setup.ball_w().ok().flatten() {
        let place = pose(&RigidTransform::from_translation(ball_w.into()));
        let size = vector(&Vector3::repeat(2.0 * BALL_RADIUS_M));
        let ball = json!({"pose": place, "size": size, "color": {"r": 0.95, "g": 0.76, "b": 0.0, "a": 1.0}});
        entities.push(entity("ball", "world", 0, [("spheres", vec![ball])]));
    }
    let none: [Value; 0] = [];
    json!({"deletions": none, "entities": entities})
}

/// An entity with the given primitives and no others; it stays until it is replaced.
fn entity<const N: usize>(id: &str, frame: &str, time_ns: u64, primitives: [(&str, Vec<Value>); N]) -> Value {
    let none: [Value; 0] = [];
    let mut entity = json!({
        "timestamp": stamp(time_ns), "frame_id": frame, "id": id, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": true,
        "metadata": none,
    });
    for kind in PRIMITIVES {
        entity[kind] = json!(none);
    }
    for (kind, list) in primitives {
        entity[kind] = Value::Array(list);
    }
    entity
}

fn arrow(from: &Vector3<f64>, vector_w: &Vector3<f64>, [red, green, blue]: [f64; 3]) -> Value {
    let length = vector_w.norm();
    // Arrows of this schema point along x.
    let opposite = || Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
    let rotation = Rotation3::rotation_between(&Vector3::x(), vector_w).unwrap_or_else(opposite);
    let head = 0.06_f64.min(length / 2.0);
    json!({
        "pose": pose(&RigidTransform { rotation: rotation.into_inner(), translation: *from }),
        "shaft_length": rounded(length - head), "shaft_diameter": 0.02,
        "head_length": rounded(head), "head_diameter": 0.045,
        "color": {"r": red, "g": green, "b": blue, "a": 1.0},
    })
}

fn stamp(time_ns: u64) -> Value {
    json!({"sec": time_ns / 1_000_000_000, "nsec": time_ns % 1_000_000_000})
}

fn vector(v: &Vector3<f64>) -> Value {
    json!({"x": rounded(v.x), "y": rounded(v.y), "z": rounded(v.z)})
}

fn quaternion(pose: &RigidTransform) -> Value {
    let q = UnitQuaternion::from_matrix(&pose.rotation).coords;
    json!({"x": rounded(q.x), "y": rounded(q.y), "z": rounded(q.z), "w": rounded(q.w)})
}

fn pose(pose: &RigidTransform) -> Value {
    json!({"position": vector(&pose.translation), "orientation": quaternion(pose)})
}

/// A micrometre is enough to look at, and makes short text.
fn rounded(x: f64) -> f64 {
    (x * 1e6).round() / 1e6
}

const PRIMITIVES: [&str; 8] =
    ["arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models"];

/// JSON schema of [`ROBOT`] and [`FORCES`]. Primitives that are never sent are described as arrays of objects.
pub fn scene_schema() -> Value {
    let number = || json!({"type": "number"});
    let pose = || {
        object(&[("position", numbers(&["x", "y", "z"])), ("orientation", numbers(&["x", "y", "z", "w"]))])
    };
    let colour = || numbers(&["r", "g", "b", "a"]);
    let solid = || vec![("pose", pose()), ("size", numbers(&["x", "y", "z"])), ("color", colour())];
    let cylinder = [solid(), vec![("bottom_scale", number()), ("top_scale", number())]].concat();
    let arrow_numbers =
        ["shaft_length", "shaft_diameter", "head_length", "head_diameter"].map(|name| (name, number()));
    let arrow = [vec![("pose", pose()), ("color", colour())], arrow_numbers.to_vec()].concat();
    let other = || array(json!({"type": "object"}));
    let entity = object(&[
        ("timestamp", time_schema()),
        ("frame_id", json!({"type": "string"})),
        ("id", json!({"type": "string"})),
        ("lifetime", time_schema()),
        ("frame_locked", json!({"type": "boolean"})),
        ("metadata", other()),
        ("arrows", array(object(&arrow))),
        ("cubes", array(object(&solid()))),
        ("spheres", array(object(&solid()))),
        ("cylinders", array(object(&cylinder))),
        ("lines", other()),
        ("triangles", other()),
        ("texts", other()),
        ("models", other()),
    ]);
    titled("foxglove.SceneUpdate", object(&[("deletions", other()), ("entities", array(entity))]))
}

fn time_schema() -> Value {
    object(&[("sec", json!({"type": "integer"})), ("nsec", json!({"type": "integer"}))])
}

fn numbers(names: &[&str]) -> Value {
    object(&names.iter().map(|name| (*name, json!({"type": "number"}))).collect::<Vec<_>>())
}

fn array(items: Value) -> Value {
    json!({"type": "array", "items": items})
}

fn object(fields: &[(&str, Value)]) -> Value {
    let fields = fields.iter().map(|(name, schema)| ((*name).to_owned(), schema.clone()));
    json!({"type": "object", "properties": fields.collect::<serde_json::Map<_, _>>()})
}

fn titled(title: &str, mut schema: Value) -> Value {
    schema["title"] = json!(title);
    schema
}
