//! URDF text to a checked description: links, joints, and the tree they form.
//!
//! Values come from `urdf-rs`. Presence and form come from the XML itself, read first, because `urdf-rs` takes what is missing
//! for zero (mass, limits, effort) and skips words that are not numbers.

use std::collections::HashMap;
use std::path::Path;

use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::LinkInertia;
use nalgebra::{Matrix3, Vector3};
use roxmltree::Node;
use urdf_rs::JointType;

use crate::document::{Document, elements};
use crate::error::{RobotError, Rule, Subject, shorten};
use crate::model::{Geometry, JointLimits, ShapeRole};

/// A robot as its URDF describes it; the joints form a tree rooted at `root`.
pub(crate) struct Description {
    pub name: String,
    pub links: Vec<Link>,
    pub joints: Vec<Joint>,
    pub root: usize,
    /// Joints that leave every link, in the order of the file.
    pub children: Vec<Vec<usize>>,
    pub warnings: Vec<String>,
}

pub(crate) struct Link {
    pub name: String,
    pub line: u32,
    /// In the link frame; `None` when the file has no `<inertial>`.
    pub inertia: Option<LinkInertia>,
    pub shapes: Vec<LinkShape>,
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

impl Description {
    pub(crate) fn read(file: &Path, text: &str) -> Result<Self, RobotError> {
        let document = Document::parse(file, text)?;
        let facts = Facts::check(&document)?;
        let robot = urdf_rs::read_from_string(text).map_err(|error| {
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

/// What the XML says by being there.
struct Facts {
    links: Vec<LinkFacts>,
    joints: Vec<JointFacts>,
}

struct LinkFacts {
    name: String,
    line: u32,
    inertial: bool,
}

struct JointFacts {
    name: String,
    line: u32,
    limit: bool,
}

impl Facts {
    fn check(document: &Document<'_>) -> Result<Self, RobotError> {
        let root = document.root();
        let has_xacro = root
            .descendants()
            .any(|node| node.tag_name().namespace().is_some_and(|uri| uri.contains("xacro")));
        if has_xacro {
            let rule = Rule::Xml("it still has xacro elements".to_owned());
            return Err(document.error(root, Subject::File, rule));
        }
        let unlimited_by_default = version(root) >= (1, 2);
        let mut facts = Self { links: Vec::new(), joints: Vec::new() };
        for node in elements(root, "link") {
            facts.links.push(check_link(document, node)?);
        }
        if facts.links.is_empty() {
            return Err(document.error(root, Subject::File, Rule::Missing { what: "a <link>" }));
        }
        for node in elements(root, "joint") {
            facts.joints.push(check_joint(document, node, unlimited_by_default)?);
        }
        Ok(facts)
    }
}

fn version(root: Node<'_, '_>) -> (u32, u32) {
    let parse = |text: &str| {
        let (major, minor) = text.trim().split_once('.')?;
        Some((major.parse().ok()?, minor.parse().ok()?))
    };
    root.attribute("version").and_then(parse).unwrap_or((1, 0))
}

fn check_link<'i>(document: &Document<'i>, node: Node<'_, 'i>) -> Result<LinkFacts, RobotError> {
    let name = document.text(node, "name", "the name of a link", &Subject::File)?.to_owned();
    let subject = Subject::Link(name.clone());
    let inertial = document.child(node, "inertial", &subject)?;
    if let Some(inertial) = inertial {
        check_origin(document, inertial, &subject)?;
        let mass = document.required(inertial, "mass", "<mass> of <inertial>", &subject)?;
        document.text(mass, "value", "the value of <mass>", &subject)?;
        document.finite::<1>(mass, "value", &subject)?;
        let inertia = document.required(inertial, "inertia", "<inertia> of <inertial>", &subject)?;
        for (attribute, what) in [
            ("ixx", "ixx of <inertia>"),
            ("ixy", "ixy of <inertia>"),
            ("ixz", "ixz of <inertia>"),
            ("iyy", "iyy of <inertia>"),
            ("iyz", "iyz of <inertia>"),
            ("izz", "izz of <inertia>"),
        ] {
            document.text(inertia, attribute, what, &subject)?;
            document.finite::<1>(inertia, attribute, &subject)?;
        }
    }
    for role in ["visual", "collision"] {
        for shape in elements(node, role) {
            check_origin(document, shape, &subject)?;
            let geometry = document.required(shape, "geometry", "<geometry> of a shape", &subject)?;
            check_geometry(document, geometry, &subject)?;
            if let Some(material) = document.child(shape, "material", &subject)? {
                document.text(material, "name", "the name of <material>", &subject)?;
                check_material(document, material, &subject)?;
            }
        }
    }
    Ok(LinkFacts { name, line: document.line(node), inertial: inertial.is_some() })
}

fn check_material<'i>(
    document: &Document<'i>,
    node: Node<'_, 'i>,
    subject: &Subject,
) -> Result<(), RobotError> {
    if let Some(color) = document.child(node, "color", subject)? {
        document.text(color, "rgba", "rgba of <color>", subject)?;
        document.finite::<4>(color, "rgba", subject)?;
    }
    Ok(())
}

fn check_origin<'i>(
    document: &Document<'i>,
    parent: Node<'_, 'i>,
    subject: &Subject,
) -> Result<(), RobotError> {
    if let Some(origin) = document.child(parent, "origin", subject)? {
        document.finite::<3>(origin, "xyz", subject)?;
        document.finite::<3>(origin, "rpy", subject)?;
        document.finite::<4>(origin, "quat_xyzw", subject)?;
    }
    Ok(())
}

fn check_geometry<'i>(
    document: &Document<'i>,
    node: Node<'_, 'i>,
    subject: &Subject,
) -> Result<(), RobotError> {
    let what = "one of <box>, <cylinder>, <capsule>, <sphere>, <mesh> in <geometry>";
    let mut shapes = node.children().filter(Node::is_element);
    let (Some(shape), None) = (shapes.next(), shapes.next()) else {
        return Err(document.error(node, subject.clone(), Rule::Missing { what }));
    };
    let length = |attribute: &'static str, what| {
        document.text(shape, attribute, what, subject)?;
        document.finite::<1>(shape, attribute, subject)
    };
    match shape.tag_name().name() {
        "box" => {
            document.text(shape, "size", "the size of <box>", subject)?;
            document.finite::<3>(shape, "size", subject)?;
        }
        "cylinder" | "capsule" => {
            length("radius", "the radius of a shape")?;
            length("length", "the length of a shape")?;
        }
        "sphere" => {
            length("radius", "the radius of a shape")?;
        }
        "mesh" => {
            document.text(shape, "filename", "the filename of <mesh>", subject)?;
            document.finite::<3>(shape, "scale", subject)?;
        }
        _ => return Err(document.error(node, subject.clone(), Rule::Missing { what })),
    }
    Ok(())
}

fn check_joint<'i>(
    document: &Document<'i>,
    node: Node<'_, 'i>,
    unlimited_by_default: bool,
) -> Result<JointFacts, RobotError> {
    let name = document.text(node, "name", "the name of a joint", &Subject::File)?.to_owned();
    let subject = Subject::Joint(name.clone());
    let kind = document.text(node, "type", "the type of the joint", &subject)?;
    let known =
        ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical"].contains(&kind);
    if !known {
        let rule = Rule::Xml(format!("`{}` is not a joint type", shorten(kind)));
        return Err(document.error(node, subject, rule));
    }
    check_origin(document, node, &subject)?;
    for (element, what, link) in
        [("parent", "<parent>", "the link of <parent>"), ("child", "<child>", "the link of <child>")]
    {
        let end = document.required(node, element, what, &subject)?;
        document.text(end, "link", link, &subject)?;
    }
    if let Some(axis) = document.child(node, "axis", &subject)? {
        document.text(axis, "xyz", "xyz of <axis>", &subject)?;
        document.finite::<3>(axis, "xyz", &subject)?;
    }
    if let Some(dynamics) = document.child(node, "dynamics", &subject)? {
        document.finite::<1>(dynamics, "damping", &subject)?;
        document.finite::<1>(dynamics, "friction", &subject)?;
    }
    if let Some(mimic) = document.child(node, "mimic", &subject)? {
        document.text(mimic, "joint", "the joint of <mimic>", &subject)?;
        document.finite::<1>(mimic, "multiplier", &subject)?;
        document.finite::<1>(mimic, "offset", &subject)?;
    }
    let limit = document.child(node, "limit", &subject)?;
    let missing = |at, what| Err(document.error(at, subject.clone(), Rule::Missing { what }));
    let bounded = kind == "revolute" || kind == "prismatic";
    match limit {
        None if bounded => {
            return missing(node, "<limit> (a turning joint without stops is of type continuous)");
        }
        None => {}
        Some(limit) => {
            let mut present = [false; 4];
            for (present, attribute) in present.iter_mut().zip(["lower", "upper", "effort", "velocity"]) {
                *present = document.limit(limit, attribute, &subject)?.is_some();
            }
            let [lower, upper, effort, velocity] = present;
            if !unlimited_by_default {
                if bounded && !lower && !upper {
                    return missing(limit, "lower and upper of <limit>");
                }
                if !effort {
                    return missing(limit, "effort of <limit> (readers take it for 0)");
                }
                if !velocity {
                    return missing(limit, "velocity of <limit>");
                }
            }
        }
    }
    Ok(JointFacts { name, line: document.line(node), limit: limit.is_some() })
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
    let mut meshes = 0;
    let mut links = Vec::with_capacity(robot.links.len());
    for (link, fact) in robot.links.iter().zip(&facts.links) {
        let visual = link.visual.iter().map(|visual| {
            let material = visual.material.as_ref();
            let own = material.and_then(|m| m.color.as_ref()).map(|color| color.rgba.0);
            let rgba = own.or_else(|| material.and_then(|m| colors.get(m.name.as_str()).copied()));
            (ShapeRole::Visual, &visual.origin, &visual.geometry, rgba)
        });
        let collision = link
            .collision
            .iter()
            .map(|collision| (ShapeRole::Collision, &collision.origin, &collision.geometry, None));
        let mut shapes = Vec::new();
        for (role, origin, geometry, rgba) in visual.chain(collision) {
            match primitive(geometry) {
                Some(geometry) => shapes.push(LinkShape { pose: pose(origin), role, geometry, rgba }),
                None => meshes += 1,
            }
        }
        links.push(Link {
            name: fact.name.clone(),
            line: fact.line,
            inertia: fact.inertial.then(|| link_inertia(&link.inertial)),
            shapes,
        });
    }

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
        let mimic = match &joint.mimic {
            None => None,
            Some(mimic) => {
                let followed = joint_index.get(mimic.joint.as_str()).copied();
                let followed = followed
                    .ok_or_else(|| refuse(Rule::Unknown { kind: "joint", name: shorten(&mimic.joint) }))?;
                Some((followed, mimic.multiplier.unwrap_or(1.0), mimic.offset.unwrap_or(0.0)))
            }
        };
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
            origin: pose(&joint.origin),
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
    let mut warnings = Vec::new();
    if meshes > 0 {
        warnings.push(format!("{meshes} mesh shapes are not drawn (meshes are never opened)"));
    }
    Ok(Description { name: robot.name.clone(), links, joints, root, children, warnings })
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

fn link_inertia(inertial: &urdf_rs::Inertial) -> LinkInertia {
    let i = &inertial.inertia;
    let given = Matrix3::new(i.ixx, i.ixy, i.ixz, i.ixy, i.iyy, i.iyz, i.ixz, i.iyz, i.izz);
    let origin = pose(&inertial.origin);
    let inertia = if inertial.origin.rpy.0 == [0.0; 3] {
        given
    } else {
        let turned = origin.rotation * given * origin.rotation.transpose();
        (turned + turned.transpose()) * 0.5
    };
    LinkInertia::new(inertial.mass.value, origin.translation, inertia)
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
