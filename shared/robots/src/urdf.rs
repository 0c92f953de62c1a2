//! URDF text to a checked description: links, joints, and the tree they form.
//!
//! Values come from `urdf-rs`. Presence and form come from the XML itself, read first: see `facts`.

use std::collections::HashMap;
use std::path::Path;

use delmpc_mechanics::spatial::{RigidTransform, exp_rotation};
use delmpc_mechanics::tree::LinkInertia;
use nalgebra::{Matrix3, Vector3};
use urdf_rs::JointType;

use crate::document::{Document, Warning, without_dashes};
use crate::error::{RobotError, Rule, Subject, shorten};
use crate::facts::{Facts, LinkFacts};
use crate::inertia::without_round_off;
use crate::model::{Geometry, JointLimits, ShapeRole};

/// A robot as its URDF describes it; the joints form a tree rooted at `root`.
pub(crate) struct Description {
    pub name: String,
    pub links: Vec<Link>,
    pub joints: Vec<Joint>,
    pub root: usize,
    /// Joints that leave every link, in the order of the file.
    pub children: Vec<Vec<usize>>,
    /// What was read all the same.
    pub warnings: Vec<Warning>,
}

pub(crate) struct Link {
    pub name: String,
    pub line: u32,
    /// In the link frame; `None` when the file has no `<inertial>`.
    pub inertia: Option<LinkInertia>,
    pub shapes: Vec<LinkShape>,
    pub meshes: Vec<LinkMesh>,
}

/// A mesh, never opened here.
pub(crate) struct LinkMesh {
    pub pose: RigidTransform,
    pub role: ShapeRole,
    pub file: String,
    pub scale: Vector3<f64>,
    pub rgba: Option<[f64; 4]>,
}

pub(crate) struct LinkShape {
    pub pose: RigidTransform,
    pub role: ShapeRole,
    pub geometry: Geometry,
    pub rgba: Option<[f64; 4]>,
}

pub(crate) struct Joint {
    pub name: String,
    pub line: u32,
    pub kind: JointType,
    pub origin: RigidTransform,
    pub parent: usize,
    pub child: usize,
    /// Unit vector.
    pub axis: Vector3<f64>,
    pub limits: JointLimits,
    pub damping: f64,
    pub friction: f64,
    /// Joint followed, multiplier, offset.
    pub mimic: Option<(usize, f64, f64)>,
}

impl Joint {
    /// Makes it a fixed joint where it stands at a coordinate. `Err` names a kind that has not one coordinate.
    pub(crate) fn hold_at(&mut self, value: f64) -> Result<(), &'static str> {
        let motion = match self.kind {
            JointType::Fixed => return Ok(()),
            JointType::Revolute | JointType::Continuous => {
                RigidTransform { rotation: exp_rotation(&(self.axis * value)), translation: Vector3::zeros() }
            }
            JointType::Prismatic => RigidTransform::from_translation(self.axis * value),
            JointType::Planar => return Err("locked planar"),
            JointType::Floating => return Err("locked floating"),
            JointType::Spherical => return Err("locked spherical"),
        };
        self.origin = self.origin * motion;
        self.kind = JointType::Fixed;
        self.mimic = None;
        Ok(())
    }
}

impl Description {
    /// Mass of every link and of all it carries.
    pub(crate) fn subtree_masses(&self) -> Vec<f64> {
        let of_link = |link: &Link| link.inertia.map_or(0.0, |inertia| inertia.mass);
        self.over_subtrees(self.links.iter().map(of_link).collect(), |sum, carried| sum + carried)
    }

    /// Whether a link or one that it carries has `<inertial>`.
    pub(crate) fn subtrees_with_inertial(&self) -> Vec<bool> {
        let of_link = |link: &Link| link.inertia.is_some();
        self.over_subtrees(self.links.iter().map(of_link).collect(), |here, carried| here || carried)
    }

    /// Values of links joined with those of all they carry, from the leaves to the root.
    fn over_subtrees<T: Copy>(&self, mut values: Vec<T>, join: impl Fn(T, T) -> T) -> Vec<T> {
        let mut order = vec![self.root];
        let mut next = 0;
        while let Some(&link) = order.get(next) {
            order.extend(self.children[link].iter().map(|&joint| self.joints[joint].child));
            next += 1;
        }
        for &link in order.iter().rev() {
            for &joint in &self.children[link] {
                values[link] = join(values[link], values[self.joints[joint].child]);
            }
        }
        values
    }

    pub(crate) fn read(file: &Path, text: &str) -> Result<Self, RobotError> {
        let (text, dashed) = without_dashes(text);
        let document = Document::parse(file, &text)?;
        for line in dashed {
            let rule = Rule::Xml("two dashes in a comment, which XML does not allow".to_owned());
            document.warn(RobotError::new(file, Some(line), Subject::File, rule), "it is read all the same");
        }
        let facts = Facts::check(&document)?;
        let robot = urdf_rs::read_from_string(&facts.text).map_err(|error| {
            RobotError::new(file, None, Subject::File, Rule::Xml(shorten(&error.to_string())))
        })?;
        let same = robot.links.len() == facts.links.len()
            && robot.joints.len() == facts.joints.len()
            && robot.links.iter().zip(&facts.links).all(|(link, fact)| link.name == fact.name)
            && robot.joints.iter().zip(&facts.joints).all(|(joint, fact)| joint.name == fact.name);
        if !same {
            let rule = Rule::Xml("links and joints are not plain children of <robot>".to_owned());
            return Err(RobotError::new(file, None, Subject::File, rule));
        }
        describe(&document, &robot, &facts)
    }
}

fn describe(
    document: &Document<'_>,
    robot: &urdf_rs::Robot,
    facts: &Facts,
) -> Result<Description, RobotError> {
    let error = |line, subject, rule| RobotError::new(document.file, Some(line), subject, rule);
    let mut link_index = HashMap::new();
    for (index, fact) in facts.links.iter().enumerate() {
        if link_index.insert(fact.name.as_str(), index).is_some() {
            return Err(error(fact.line, Subject::Link(fact.name.clone()), Rule::DuplicateName));
        }
    }
    let mut joint_index = HashMap::new();
    for (index, fact) in facts.joints.iter().enumerate() {
        if joint_index.insert(fact.name.as_str(), index).is_some() {
            return Err(error(fact.line, Subject::Joint(fact.name.clone()), Rule::DuplicateName));
        }
    }

    let colors: HashMap<&str, [f64; 4]> = robot
        .materials
        .iter()
        .filter_map(|material| Some((material.name.as_str(), material.color.as_ref()?.rgba.0)))
        .collect();
    let links = robot
        .links
        .iter()
        .zip(&facts.links)
        .map(|(link, fact)| described(link, fact, &colors))
        .collect::<Vec<_>>();

    let mut joints = Vec::with_capacity(robot.joints.len());
    let mut children = vec![Vec::new(); links.len()];
    let mut carried_by: Vec<Option<usize>> = vec![None; links.len()];
    for (index, (joint, fact)) in robot.joints.iter().zip(&facts.joints).enumerate() {
        let refuse = |rule| error(fact.line, Subject::Joint(fact.name.clone()), rule);
        let find_link = |name: &str| {
            link_index
                .get(name)
                .copied()
                .ok_or_else(|| refuse(Rule::Unknown { kind: "link", name: shorten(name) }))
        };
        let (parent, child) = (find_link(&joint.parent.link)?, find_link(&joint.child.link)?);
        let mimic = joint.mimic.as_ref().and_then(|mimic| {
            let Some(&followed) = joint_index.get(mimic.joint.as_str()) else {
                let unknown = refuse(Rule::Unknown { kind: "joint", name: shorten(&mimic.joint) });
                document.warn(unknown, "it moves by itself");
                return None;
            };
            Some((followed, mimic.multiplier.unwrap_or(1.0), mimic.offset.unwrap_or(0.0)))
        });
        if let Some(first) = carried_by[child] {
            let rule =
                Rule::TwoParents { first: facts.joints[first].name.clone(), second: fact.name.clone() };
            return Err(error(facts.links[child].line, Subject::Link(links[child].name.clone()), rule));
        }
        carried_by[child] = Some(index);
        children[parent].push(index);
        let (damping, friction) =
            joint.dynamics.as_ref().map_or((0.0, 0.0), |dynamics| (dynamics.damping, dynamics.friction));
        joints.push(Joint {
            name: fact.name.clone(),
            line: fact.line,
            kind: joint.joint_type.clone(),
            origin: turned(pose(&joint.origin), fact.rotation),
            parent,
            child,
            axis: axis(joint).ok_or_else(|| refuse(Rule::ZeroAxis))?,
            limits: limits(joint, fact.limit).map_err(refuse)?,
            damping,
            friction,
            mimic,
        });
    }

    let root = find_root(document, &links, &carried_by, &children, &joints)?;
    let warnings = document.take_warnings();
    Ok(Description { name: robot.name.clone(), links, joints, root, children, warnings })
}

/// A link with its shapes.
fn described(link: &urdf_rs::Link, fact: &LinkFacts, colors: &HashMap<&str, [f64; 4]>) -> Link {
    let visual = link.visual.iter().zip(&fact.visual_rotations).map(|(visual, &rotation)| {
        let material = visual.material.as_ref();
        let own = material.and_then(|m| m.color.as_ref()).map(|color| color.rgba.0);
        let rgba = own.or_else(|| material.and_then(|m| colors.get(m.name.as_str()).copied()));
        (ShapeRole::Visual, turned(pose(&visual.origin), rotation), &visual.geometry, rgba)
    });
    let collision = link.collision.iter().zip(&fact.collision_rotations).map(|(collision, &rotation)| {
        (ShapeRole::Collision, turned(pose(&collision.origin), rotation), &collision.geometry, None)
    });
    let (mut shapes, mut meshes) = (Vec::new(), Vec::new());
    for (role, pose, geometry, rgba) in visual.chain(collision) {
        if let Some(geometry) = primitive(geometry) {
            shapes.push(LinkShape { pose, role, geometry, rgba });
        } else if let urdf_rs::Geometry::Mesh { filename, scale } = geometry {
            let scale = scale.map_or(Vector3::repeat(1.0), |scale| Vector3::from(scale.0));
            meshes.push(LinkMesh { pose, role, file: filename.clone(), scale, rgba });
        }
    }
    let inertia = fact.inertial.then(|| link_inertia(&link.inertial, fact.inertial_rotation));
    Link { name: fact.name.clone(), line: fact.line, inertia, shapes, meshes }
}

/// The one link on no joint, from which every link must be reached.
fn find_root(
    document: &Document<'_>,
    links: &[Link],
    carried_by: &[Option<usize>],
    children: &[Vec<usize>],
    joints: &[Joint],
) -> Result<usize, RobotError> {
    let refuse = |link: usize, rule| {
        Err(RobotError::new(
            document.file,
            Some(links[link].line),
            Subject::Link(links[link].name.clone()),
            rule,
        ))
    };
    let mut roots = (0..links.len()).filter(|&link| carried_by[link].is_none());
    let Some(root) = roots.next() else { return refuse(0, Rule::Cycle) };
    if let Some(second) = roots.next() {
        return refuse(second, Rule::TwoRoots { other: links[root].name.clone() });
    }
    let mut reached = vec![false; links.len()];
    let mut open = vec![root];
    while let Some(link) = open.pop() {
        reached[link] = true;
        open.extend(children[link].iter().map(|&joint| joints[joint].child));
    }
    match reached.iter().position(|&reached| !reached) {
        Some(link) => refuse(link, Rule::Cycle),
        None => Ok(root),
    }
}

fn pose(pose: &urdf_rs::Pose) -> RigidTransform {
    RigidTransform::from_xyz_rpy(Vector3::from(pose.xyz.0), Vector3::from(pose.rpy.0))
}

/// The pose with the rotation of a quaternion where there is one.
fn turned(pose: RigidTransform, rotation: Option<Matrix3<f64>>) -> RigidTransform {
    RigidTransform { rotation: rotation.unwrap_or(pose.rotation), ..pose }
}

fn link_inertia(inertial: &urdf_rs::Inertial, rotation: Option<Matrix3<f64>>) -> LinkInertia {
    let i = &inertial.inertia;
    let given = Matrix3::new(i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz);
    let origin = turned(pose(&inertial.origin), rotation);
    let inertia = if origin.rotation == Matrix3::identity() {
        given
    } else {
        let turned = origin.rotation * given * origin.rotation.transpose();
        (turned + turned.transpose()) * 0.5
    };
    without_round_off(LinkInertia::new(inertial.mass.value, origin.translation, inertia))
}

fn primitive(geometry: &urdf_rs::Geometry) -> Option<Geometry> {
    match *geometry {
        urdf_rs::Geometry::Box { size } => Some(Geometry::Box { size: Vector3::from(size.0) }),
        urdf_rs::Geometry::Cylinder { radius, length } => Some(Geometry::Cylinder { radius, length }),
        urdf_rs::Geometry::Capsule { radius, length } => Some(Geometry::Capsule { radius, length }),
        urdf_rs::Geometry::Sphere { radius } => Some(Geometry::Sphere { radius }),
        urdf_rs::Geometry::Mesh { .. } => None,
    }
}

/// Unit axis; `None` without a direction. Joints that have no axis get one nobody reads.
fn axis(joint: &urdf_rs::Joint) -> Option<Vector3<f64>> {
    let given = Vector3::from(joint.axis.xyz.0);
    match joint.joint_type {
        JointType::Fixed | JointType::Floating | JointType::Spherical => Some(Vector3::x()),
        _ => {
            // Scaled first: neither huge nor tiny vectors may leave the range of the norm.
            let largest = given.amax();
            let scaled = given / largest;
            (largest > 0.0).then(|| if given.norm() == 1.0 { given } else { scaled.normalize() })
        }
    }
}

fn limits(joint: &urdf_rs::Joint, given: bool) -> Result<JointLimits, Rule> {
    if !given {
        return Ok(JointLimits::NONE);
    }
    let &urdf_rs::JointLimit { lower, upper, effort, velocity, .. } = &joint.limit;
    let bounded = matches!(joint.joint_type, JointType::Revolute | JointType::Prismatic);
    let (lower, upper) = if bounded { (lower, upper) } else { (f64::NEG_INFINITY, f64::INFINITY) };
    if lower <= upper && effort >= 0.0 && velocity >= 0.0 {
        Ok(JointLimits { lower, upper, effort, velocity })
    } else {
        Err(Rule::Limits { lower, upper, effort, velocity })
    }
}
