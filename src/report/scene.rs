//! What of a robot is drawn: its tree with joint axes, its primitive shapes, its soles.
//!
//! A viewer poses the shapes by itself: the pose of body `i` is that of its parent, times the placement of its joint, times the motion of
//! the joint; that of a floating base comes with every frame.

use delmpc_mechanics::prelude::{JointKind, KinematicTree, RigidTransform};
use delmpc_robots::{Attachment, Geometry, RobotModel, Shape, ShapeRole};
use nalgebra::{Rotation3, Vector3};
use serde::Serialize;

/// Radius of the bones of a robot without shapes (m).
const BONE_RADIUS_M: f64 = 0.02;

/// A pose as rows of the rotation matrix, then the translation.
pub type Pose = [f64; 12];

/// A robot as a viewer needs it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scene {
    /// Name of the robot.
    pub name: String,
    /// Whether the first body floats.
    pub floating: bool,
    /// Bodies, parents first.
    pub bodies: Vec<DrawnBody>,
    /// Shapes.
    pub shapes: Vec<DrawnShape>,
    /// Joints, in the order of the joint coordinates.
    pub joints: Vec<DrawnJoint>,
    /// Soles.
    pub soles: Vec<DrawnSole>,
    /// Total mass, kg.
    pub mass_kg: f64,
}

/// A body of the tree.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnBody {
    /// Name of its link.
    pub name: String,
    /// Its parent; nothing: the world.
    pub parent: Option<usize>,
    /// Index of its joint coordinate; nothing: the floating base.
    pub joint: Option<usize>,
    /// Whether the joint slides.
    pub slides: bool,
    /// Placement of the joint in the parent.
    pub placement: Pose,
    /// Axis of the joint.
    pub axis: [f64; 3],
    /// Mass centre in the link frame.
    pub com: [f64; 3],
}

/// A primitive.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnShape {
    /// Its body; nothing: the world.
    pub body: Option<usize>,
    /// Name of its link.
    pub link: String,
    /// Its pose in the body.
    pub pose: Pose,
    /// `box`, `cylinder`, `capsule`, `sphere`.
    pub kind: &'static str,
    /// Edges of a box; radius and length of a cylinder; radius, and distance of the caps, of a capsule; radius of a sphere.
    pub size: Vec<f64>,
    /// Red, green, blue in 0..1; nothing: not said.
    pub colour: Option<[f64; 3]>,
}

/// A joint.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnJoint {
    /// Name.
    pub name: String,
    /// Largest torque; nothing: no limit.
    pub effort: Option<f64>,
    /// Whether a motor drives it.
    pub actuated: bool,
}

/// A sole.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DrawnSole {
    /// Name.
    pub name: String,
    /// Its body.
    pub body: Option<usize>,
    /// Its frame in the body.
    pub pose: Pose,
    /// Corners, counter-clockwise.
    pub polygon: Vec<[f64; 2]>,
}

impl Scene {
    /// The scene of a robot.
    pub fn new(robot: &RobotModel) -> Self {
        let tree = &robot.tree;
        let first = tree.first_joint_body();
        let bodies =
            tree.bodies().iter().zip(&robot.body_names).enumerate().map(|(index, (body, name))| DrawnBody {
                name: name.clone(),
                parent: body.parent,
                joint: index.checked_sub(first),
                slides: body.joint.kind == JointKind::Prismatic,
                placement: pose(&body.joint.placement),
                axis: body.joint.axis.into(),
                com: body.inertia.com.into(),
            });
        let joints = robot.joint_names.iter().zip(&robot.limits).zip(&robot.actuated);
        let soles = robot.soles.iter().filter_map(|sole| {
            let frame = robot.frame(&sole.frame)?;
            let polygon = sole.polygon.iter().map(|corner| (*corner).into()).collect();
            Some(DrawnSole { name: sole.name.clone(), body: frame.body, pose: pose(&frame.pose), polygon })
        });
        Self {
            name: robot.name.clone(),
            floating: tree.is_floating(),
            bodies: bodies.collect(),
            shapes: shapes(robot).iter().map(drawn_shape).collect(),
            joints: joints
                .map(|((name, limit), &actuated)| DrawnJoint {
                    name: name.clone(),
                    effort: limit.effort.is_finite().then_some(limit.effort),
                    actuated,
                })
                .collect(),
            soles: soles.collect(),
            mass_kg: tree.total_mass(),
        }
    }
}

/// The shapes to draw: of each link the visual ones, else the collision ones; bones where a robot has no shapes at all.
pub fn shapes(robot: &RobotModel) -> Vec<Shape> {
    let is_visual = |shape: &&Shape| shape.role == ShapeRole::Visual;
    let has_visual = |link: &str| robot.shapes.iter().filter(is_visual).any(|shape| shape.link == link);
    let drawn =
        robot.shapes.iter().filter(|shape| shape.role == ShapeRole::Visual || !has_visual(&shape.link));
    let drawn: Vec<Shape> = drawn.cloned().collect();
    if drawn.is_empty() { bones(&robot.tree, &robot.body_names) } else { drawn }
}

/// From every joint to the joints it carries; a ball at the joints that carry none.
fn bones(tree: &KinematicTree, names: &[String]) -> Vec<Shape> {
    let shape = |body: Option<usize>, pose: RigidTransform, geometry: Geometry| Shape {
        link: body.and_then(|body| names.get(body)).cloned().unwrap_or_default(),
        attachment: Attachment { body, pose },
        role: ShapeRole::Visual,
        geometry,
        rgba: None,
    };
    let first = tree.first_joint_body();
    let to_children = tree.bodies().iter().skip(first).map(|body| {
        let along = body.joint.placement.translation;
        let length = along.norm();
        // Half a turn about x where z has no unique way to its opposite.
        let half_turn = || Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let rotation = Rotation3::rotation_between(&Vector3::z(), &along).unwrap_or_else(half_turn);
        let pose = RigidTransform { rotation: rotation.into_inner(), translation: along / 2.0 };
        shape(body.parent, pose, Geometry::Capsule { radius: BONE_RADIUS_M, length })
    });
    let at_joints = (0..tree.body_count()).map(|body| {
        shape(Some(body), RigidTransform::identity(), Geometry::Sphere { radius: 1.5 * BONE_RADIUS_M })
    });
    to_children.chain(at_joints).collect()
}

fn drawn_shape(shape: &Shape) -> DrawnShape {
    let (kind, size) = match shape.geometry {
        Geometry::Box { size } => ("box", size.as_slice().to_vec()),
        Geometry::Cylinder { radius, length } => ("cylinder", vec![radius, length]),
        Geometry::Capsule { radius, length } => ("capsule", vec![radius, length]),
        Geometry::Sphere { radius } => ("sphere", vec![radius]),
    };
    DrawnShape {
        body: shape.attachment.body,
        link: shape.link.clone(),
        pose: pose(&shape.attachment.pose),
        kind,
        size,
        colour: shape.rgba.map(|[red, green, blue, _]| [red, green, blue]),
    }
}

/// A pose as twelve numbers.
pub fn pose(transform: &RigidTransform) -> Pose {
    let (r, t) = (&transform.rotation, &transform.translation);
    std::array::from_fn(|i| if i < 9 { r[(i / 3, i % 3)] } else { t[i - 9] })
}
