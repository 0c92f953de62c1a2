//! What of a robot is drawn: its tree with joint axes, its primitive shapes, its soles.
//!
//! A viewer poses the shapes by itself: the pose of body `i` is that of its parent, times the placement of its joint, times the motion of
//! the joint; that of a floating base comes with every frame.

use delmpc_mechanics::prelude::{JointKind, KinematicTree, RigidTransform};
use delmpc_mechanics::tree::LinkInertia;
use delmpc_robots::{Attachment, Geometry, Mesh, RobotModel, Shape, ShapeRole};
use nalgebra::{Rotation3, Vector3};
use serde::Serialize;

use crate::mesh_file::{self, Triangles};

/// Triangles of all meshes together, so that a page stays small.
const MOST_TRIANGLES: usize = 40_000;
/// Mesh files of a robot that are opened.
const MOST_MESHES: usize = 500;
/// Largest radius of the bones of a body without shapes (m).
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
    /// `box`, `cylinder`, `capsule`, `sphere`, `mesh`.
    pub kind: &'static str,
    /// Edges of a box, or of that around a mesh; radius and length of a cylinder; radius, and distance of the caps, of a capsule; radius of
    /// a sphere.
    pub size: Vec<f64>,
    /// Corners of a mesh, x y z, in tenths of a millimetre.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<i32>,
    /// Its triangles, three corners each.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub faces: Vec<usize>,
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
            shapes: drawn_shapes(robot),
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

/// What of a robot is drawn.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Drawn {
    /// Primitives.
    pub shapes: Vec<Shape>,
    /// Meshes.
    pub meshes: Vec<DrawnSurface>,
}

/// The surface of a mesh file.
#[derive(Debug, Clone, PartialEq)]
pub struct DrawnSurface {
    /// Its body; nothing: the world.
    pub body: Option<usize>,
    /// Name of its link.
    pub link: String,
    /// In the axes of the body.
    pub surface: Triangles,
    /// Red, green, blue, alpha in 0..1; nothing: not said.
    pub rgba: Option<[f64; 4]>,
}

/// The shapes to draw: of each link the visual ones, else the collision ones. A body without any gets bones to the joints it carries and
/// a box that has its inertia.
pub fn shapes(robot: &RobotModel) -> Vec<Shape> {
    drawn(robot, 0).shapes
}

/// The same with the meshes whose files are there, of at most that many triangles in all.
pub fn drawn(robot: &RobotModel, triangles: usize) -> Drawn {
    let mut meshes: Vec<(&Mesh, Triangles)> = Vec::new();
    if triangles > 0 {
        let named = || robot.meshes.iter().take(MOST_MESHES);
        let most = triangles / robot.meshes.len().max(1);
        let read = |mesh| Some((mesh, mesh_file::read(robot, mesh)?.simplified(most.max(12))));
        meshes.extend(named().filter(|mesh| mesh.role == ShapeRole::Visual).filter_map(read));
        let has_visual = |link: &str| {
            let is_visual = |shape: &Shape| shape.link == link && shape.role == ShapeRole::Visual;
            robot.shapes.iter().any(is_visual) || meshes.iter().any(|(mesh, _)| mesh.link == link)
        };
        let of_collision = named().filter(|mesh| mesh.role == ShapeRole::Collision);
        let others: Vec<(&Mesh, Triangles)> =
            of_collision.filter(|mesh| !has_visual(&mesh.link)).filter_map(read).collect();
        meshes.extend(others);
    }
    let has_visual = |link: &str| {
        let is_visual = |shape: &Shape| shape.link == link && shape.role == ShapeRole::Visual;
        robot.shapes.iter().any(is_visual) || meshes.iter().any(|(mesh, _)| mesh.link == link)
    };
    let is_drawn = |shape: &&Shape| shape.role == ShapeRole::Visual || !has_visual(&shape.link);
    let mut shapes: Vec<Shape> = robot.shapes.iter().filter(is_drawn).cloned().collect();
    let is_bare = |body: usize| {
        let bodies = shapes.iter().map(|shape| shape.attachment.body);
        bodies.chain(meshes.iter().map(|(mesh, _)| mesh.attachment.body)).all(|at| at != Some(body))
    };
    let bare: Vec<bool> = (0..robot.tree.body_count()).map(is_bare).collect();
    shapes.extend(bones(&robot.tree, &robot.body_names, &bare));
    let meshes = meshes.into_iter().map(|(mesh, surface)| DrawnSurface {
        body: mesh.attachment.body,
        link: mesh.link.clone(),
        surface,
        rgba: mesh.rgba,
    });
    Drawn { shapes, meshes: meshes.collect() }
}

/// Shapes of bodies that have none of their own: bones to the joints they carry, a ball at their own joint, and a box with their inertia.
fn bones(tree: &KinematicTree, names: &[String], bare: &[bool]) -> Vec<Shape> {
    let shape = |body: Option<usize>, pose: RigidTransform, geometry: Geometry| Shape {
        link: body.and_then(|body| names.get(body)).cloned().unwrap_or_default(),
        attachment: Attachment { body, pose },
        role: ShapeRole::Visual,
        geometry,
        rgba: None,
    };
    let is_bare = |body: Option<usize>| body.map_or(bare.iter().all(|bare| *bare), |body| bare[body]);
    let first = tree.first_joint_body();
    // As thick as fits the longest bone.
    let lengths = tree.bodies().iter().skip(first).map(|body| body.joint.placement.translation.norm());
    let radius = BONE_RADIUS_M.min(0.06 * lengths.fold(0.0, f64::max)).max(1e-4);
    let carried = tree.bodies().iter().skip(first).filter(|body| is_bare(body.parent));
    let to_children = carried.filter_map(|body| {
        let along = body.joint.placement.translation;
        let length = along.norm();
        // Half a turn about x where z has no unique way to its opposite.
        let half_turn = || Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let rotation = Rotation3::rotation_between(&Vector3::z(), &along).unwrap_or_else(half_turn);
        let pose = RigidTransform { rotation: rotation.into_inner(), translation: along / 2.0 };
        (length > radius).then(|| shape(body.parent, pose, Geometry::Capsule { radius, length }))
    });
    // The bodies inside a joint of several axes are nothing to see.
    let bare_bodies =
        || (0..tree.body_count()).filter(|&at| bare[at] && tree.bodies()[at].inertia.mass > 0.0);
    let at_joints = bare_bodies()
        .map(|body| shape(Some(body), RigidTransform::identity(), Geometry::Sphere { radius: 1.5 * radius }));
    let boxes = bare_bodies().filter_map(|body| {
        let (pose, size) = inertia_box(&tree.bodies()[body].inertia)?;
        Some(shape(Some(body), pose, Geometry::Box { size }))
    });
    to_children.chain(at_joints).chain(boxes).collect()
}

/// The solid box of even density that has this mass and inertia; `None` for a body without extent.
fn inertia_box(inertia: &LinkInertia) -> Option<(RigidTransform, Vector3<f64>)> {
    if inertia.mass <= 0.0 {
        return None;
    }
    let eigen = inertia.inertia.symmetric_eigen();
    let moments = eigen.eigenvalues;
    let edge = |axis: usize| (6.0 * (moments.sum() - 2.0 * moments[axis]).max(0.0) / inertia.mass).sqrt();
    let size = Vector3::new(edge(0), edge(1), edge(2));
    let mut rotation = eigen.eigenvectors;
    if rotation.determinant() < 0.0 {
        rotation.set_column(2, &-rotation.column(2));
    }
    // What exporters write for nothing, or for an inertia about another point, is no shape.
    let plausible = (1e-3..1.5).contains(&size.max());
    let size = size.map(|edge| edge.max(0.05 * size.max()));
    plausible.then_some((RigidTransform { rotation, translation: inertia.com }, size))
}

/// The shapes with their meshes as a viewer needs them.
fn drawn_shapes(robot: &RobotModel) -> Vec<DrawnShape> {
    let drawn = drawn(robot, MOST_TRIANGLES);
    let meshes = drawn.meshes.iter().map(|DrawnSurface { body, link, surface, rgba }| {
        let (low, high) = surface.bounds();
        let middle = (low + high) / 2.0;
        let points = surface.points.iter().flat_map(|point| {
            let tenths = (point - middle) * 1e4;
            [tenths.x, tenths.y, tenths.z].map(|x| x.round() as i32)
        });
        DrawnShape {
            body: *body,
            link: link.clone(),
            pose: pose(&RigidTransform::from_translation(middle)),
            kind: "mesh",
            size: (high - low).as_slice().to_vec(),
            points: points.collect(),
            faces: surface.faces.concat(),
            colour: rgba.map(|[red, green, blue, _]| [red, green, blue]),
        }
    });
    drawn.shapes.iter().map(drawn_shape).chain(meshes).collect()
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
        points: Vec::new(),
        faces: Vec::new(),
        colour: shape.rgba.map(|[red, green, blue, _]| [red, green, blue]),
    }
}

/// A pose as twelve numbers.
pub fn pose(transform: &RigidTransform) -> Pose {
    let (r, t) = (&transform.rotation, &transform.translation);
    std::array::from_fn(|i| if i < 9 { r[(i / 3, i % 3)] } else { t[i - 9] })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
mod tests {
    use super::*;

    #[test]
    fn the_box_of_an_inertia_is_the_box_it_came_from() {
        let (mass, size) = (3.0, Vector3::new(0.1, 0.2, 0.4));
        let moment = |a: f64, b: f64| mass * (a * a + b * b) / 12.0;
        let moments = Vector3::new(moment(size.y, size.z), moment(size.x, size.z), moment(size.x, size.y));
        let turn = Rotation3::from_euler_angles(0.3, -0.5, 0.9).into_inner();
        let inertia = turn * nalgebra::Matrix3::from_diagonal(&moments) * turn.transpose();
        let com = Vector3::new(0.0, 0.1, 0.0);
        let (pose, found) =
            inertia_box(&LinkInertia::new(mass, com, (inertia + inertia.transpose()) / 2.0)).unwrap();
        let mut edges: [f64; 3] = found.into();
        edges.sort_by(f64::total_cmp);
        for (edge, expected) in edges.iter().zip(size.iter()) {
            assert!((edge - expected).abs() < 1e-9, "{found}");
        }
        // Its longest edge lies along the turned z axis.
        let along = pose.rotation.column(found.imax()).dot(&turn.column(2));
        assert!((along.abs() - 1.0).abs() < 1e-9 && pose.translation == com);
        assert_eq!(inertia_box(&LinkInertia::massless()), None);
    }

    #[test]
    fn links_without_shapes_are_drawn_among_others_that_have_some() {
        let body = "<inertial><mass value='1'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' iyz='0' izz='0.01'/></inertial>";
        let ball = "<visual><geometry><sphere radius='0.1'/></geometry></visual>";
        let joint = |name: &str, parent: &str, child: &str| {
            format!(
                "<joint name='{name}' type='continuous'><origin xyz='0 0 0.4'/><parent link='{parent}'/><child link='{child}'/></joint>"
            )
        };
        let urdf = format!(
            "<robot name='r'><link name='a'>{body}{ball}</link><link name='b'>{body}</link><link name='c'>{body}</link>{}{}</robot>",
            joint("j", "a", "b"),
            joint("k", "b", "c")
        );
        let robot =
            delmpc_robots::load_str("r.urdf", &urdf, None, &delmpc_robots::LoadOptions::default()).unwrap();
        let of =
            |body: usize| shapes(&robot).iter().filter(|shape| shape.attachment.body == Some(body)).count();
        // The ball; bone, joint and inertia; joint and inertia.
        assert_eq!([of(0), of(1), of(2)], [1, 3, 2]);
    }
}
