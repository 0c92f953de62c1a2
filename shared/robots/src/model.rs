//! What a robot is to the rest of the program: plain data.

use std::path::PathBuf;

use delmpc_mechanics::kinematics::base_pose_from_link;
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::{Vector2, Vector3};

use crate::mimic::CoordinateMap;

/// A robot: its tree, and everything known about it by name.
///
/// Vectors over joints are in the order of [`RobotModel::joint_names`], which is the order of the tree's joint coordinates.
#[derive(Clone, Debug)]
pub struct RobotModel {
    /// Name of the robot.
    pub name: String,
    /// The file it came from.
    pub file: PathBuf,
    /// The tree. Link frames are the URDF's link frames (joint frame of the joint that carries the link).
    pub tree: KinematicTree,
    /// Name of every body: the link that its joint carries, or the coordinate for massless bodies inside a planar joint.
    pub body_names: Vec<String>,
    /// Name of every joint coordinate; what a joint-set hash is taken over.
    pub joint_names: Vec<String>,
    /// Limits of every joint coordinate.
    pub limits: Vec<JointLimits>,
    /// Whether a motor drives the coordinate: not those of a planar base, of passive or of mimic joints.
    pub actuated: Vec<bool>,
    /// Viscous damping of every joint coordinate (also in the tree), N·m·s/rad or N·s/m.
    pub damping: Vec<f64>,
    /// Dry friction given in the URDF, N·m or N. Not simulated.
    pub friction: Vec<f64>,
    /// Every link of the URDF, merged ones included, and where it is.
    pub links: Vec<NamedLink>,
    /// Shapes for drawing.
    pub shapes: Vec<Shape>,
    /// Meshes, by the names of their files. They are not opened.
    pub meshes: Vec<Mesh>,
    /// Folder that their names are relative to, where it is not that of the URDF.
    pub mesh_folder: Option<PathBuf>,
    /// Contact points.
    pub contacts: Vec<ContactPoint>,
    /// Named frames: soles, hand points.
    pub frames: Vec<NamedFrame>,
    /// Support polygons.
    pub soles: Vec<Sole>,
    /// Named postures.
    pub postures: Vec<Posture>,
    /// Mimic joints as a map of coordinates.
    pub coordinate_map: CoordinateMap,
    /// What was accepted but should be known.
    pub warnings: Vec<String>,
}

/// Where something is fixed: on a body, or on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Attachment {
    /// Body of the tree; `None` when it is fixed to {0}.
    pub body: Option<usize>,
    /// Pose in the body's link frame, or in {0}.
    pub pose: RigidTransform,
}

/// A link of the URDF by name.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedLink {
    /// Link name.
    pub name: String,
    /// Its frame.
    pub attachment: Attachment,
}

/// A frame of the companion file.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedFrame {
    /// Frame name.
    pub name: String,
    /// The URDF link it is on.
    pub link: String,
    /// Where it is.
    pub attachment: Attachment,
}

/// A point (or small sphere) that may touch the ground.
#[derive(Clone, Debug, PartialEq)]
pub struct ContactPoint {
    /// Point name.
    pub name: String,
    /// The URDF link it is on.
    pub link: String,
    /// Body; `None` when the link is fixed to {0}.
    pub body: Option<usize>,
    /// Position in the body's link frame (or in {0}), m.
    pub position: Vector3<f64>,
    /// Radius of the sphere around it, m; 0 for a point.
    pub radius: f64,
}

/// The support polygon of a foot.
#[derive(Clone, Debug, PartialEq)]
pub struct Sole {
    /// Name, for example `right`.
    pub name: String,
    /// The frame whose xy plane it lies in.
    pub frame: String,
    /// Corners in that frame, counter-clockwise from above, m.
    pub polygon: Vec<Vector2<f64>>,
    /// The contact points that are the corners, as indices into [`RobotModel::contacts`].
    pub contacts: Vec<usize>,
}

/// Limits of a joint coordinate; infinite where there are none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Lowest position, rad or m.
    pub lower: f64,
    /// Highest position, rad or m.
    pub upper: f64,
    /// Largest torque or force, N·m or N.
    pub effort: f64,
    /// Largest speed, rad/s or m/s.
    pub velocity: f64,
}

impl JointLimits {
    /// No limits at all.
    pub const NONE: Self = Self {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        effort: f64::INFINITY,
        velocity: f64::INFINITY,
    };
}

/// A named posture.
#[derive(Clone, Debug, PartialEq)]
pub struct Posture {
    /// Name.
    pub name: String,
    /// Pose of the base's *link frame* in the world, where the posture has one and the base floats.
    pub base_link_pose_w: Option<RigidTransform>,
    /// Joint coordinates, rad or m.
    pub q: Vec<f64>,
}

/// What a shape is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ShapeRole {
    /// `<visual>`.
    Visual,
    /// `<collision>`.
    Collision,
}

/// A primitive of the URDF. Cylinders and capsules lie along the z axis of their frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Geometry {
    /// Edge lengths, m.
    Box {
        /// Along x, y, z.
        size: Vector3<f64>,
    },
    /// Radius and length, m.
    Cylinder {
        /// Radius.
        radius: f64,
        /// Length.
        length: f64,
    },
    /// Radius, and distance between the centres of the caps, m.
    Capsule {
        /// Radius.
        radius: f64,
        /// Length.
        length: f64,
    },
    /// Radius, m.
    Sphere {
        /// Radius.
        radius: f64,
    },
}

/// A primitive shape and where it is. Meshes are not among them.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// The URDF link it belongs to.
    pub link: String,
    /// Where it is.
    pub attachment: Attachment,
    /// Visual or collision.
    pub role: ShapeRole,
    /// The primitive.
    pub geometry: Geometry,
    /// Red, green, blue, alpha in 0..1, where the file gives a colour.
    pub rgba: Option<[f64; 4]>,
}

/// A mesh of the URDF and where it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// The URDF link it belongs to.
    pub link: String,
    /// Where it is.
    pub attachment: Attachment,
    /// Visual or collision.
    pub role: ShapeRole,
    /// Its file as the URDF names it: a path, `package://…` or `file://…`.
    pub file: String,
    /// Factors along its x, y, z.
    pub scale: Vector3<f64>,
    /// Red, green, blue, alpha in 0..1, where the file gives a colour.
    pub rgba: Option<[f64; 4]>,
}

impl RobotModel {
    /// Index of a joint coordinate by name.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joint_names.iter().position(|joint| joint == name)
    }

    /// A link of the URDF by name.
    pub fn link(&self, name: &str) -> Option<&Attachment> {
        self.links.iter().find(|link| link.name == name).map(|link| &link.attachment)
    }

    /// A frame by name: one of the companion file, else a link frame.
    pub fn frame(&self, name: &str) -> Option<&Attachment> {
        let named = self.frames.iter().find(|frame| frame.name == name).map(|frame| &frame.attachment);
        named.or_else(|| self.link(name))
    }

    /// A posture by name.
    pub fn posture(&self, name: &str) -> Option<&Posture> {
        self.postures.iter().find(|posture| posture.name == name)
    }

    /// A sole by name.
    pub fn sole(&self, name: &str) -> Option<&Sole> {
        self.soles.iter().find(|sole| sole.name == name)
    }

    /// Pose of the floating base as [`delmpc_mechanics`] takes it (origin at the mass centre) for a posture with a base pose.
    pub fn base_pose_w(&self, posture: &Posture) -> Option<RigidTransform> {
        posture.base_link_pose_w.map(|pose| base_pose_from_link(&self.tree, &pose))
    }
}
