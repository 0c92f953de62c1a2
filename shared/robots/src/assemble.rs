//! From the description to the tree: groups of fixed links become bodies, joints become coordinates.
//!
//! ```text
//! link pose in its body:  X_link = X_parent_link · origin(fixed joint)
//! body inertia:           Σ over its links, moved to the body's link frame
//! planar joint:           slide(e1) · slide(e2) · turn(n), massless bodies between
//! ```
//!
//! Planar joints with the normal along a coordinate axis slide along the other two (normal y: x, then z) and their coordinates
//! are called `joint_x`, `joint_z`, `joint_pitch`; for any other normal they are `joint_1`, `joint_2`, `joint_angle`.

use std::path::Path;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::spatial::{RigidTransform, SpatialInertia};
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::Vector3;
use urdf_rs::JointType;

use crate::companion::CompanionFile;
use crate::document::Warning;
use crate::error::{RobotError, Rule, Subject};
use crate::inertia;
use crate::limits::MAX_COORDINATES;
use crate::load::{BaseChoice, ImpossibleInertia, LoadOptions};
use crate::mimic::{CoordinateMap, Follower};
use crate::model::{Attachment, JointLimits, Mesh, NamedLink, RobotModel, Shape};
use crate::urdf::{Description, Joint as UrdfJoint};

/// A body in the making. Group 0 is the root link with all that is fixed to it.
struct Group {
    parent: usize,
    joint: Joint,
    name: String,
    coordinate: Option<Coordinate>,
    /// First link of the group; `None` for the massless bodies inside a planar joint.
    link: Option<usize>,
    inertia: SpatialInertia,
    /// Kept as given when the group is one link with its frame at the body's.
    single: Option<LinkInertia>,
    has_inertial: bool,
}

struct Coordinate {
    name: String,
    joint: usize,
    limits: JointLimits,
    actuated: bool,
}

struct Assembly<'a> {
    file: &'a Path,
    description: &'a Description,
    options: &'a LoadOptions,
    groups: Vec<Group>,
    /// Group and pose of every link.
    placed: Vec<Option<(usize, RigidTransform)>>,
    warnings: Vec<String>,
    /// Whether some body has an inertia that no body has.
    accept_unreal: bool,
}

/// Builds the model.
pub(crate) fn assemble(
    file: &Path,
    description: &Description,
    companion: Option<&CompanionFile>,
    options: &LoadOptions,
) -> Result<RobotModel, RobotError> {
    let mut assembly = Assembly {
        file,
        description,
        options,
        groups: Vec::new(),
        placed: vec![None; description.links.len()],
        warnings: in_words(&description.warnings),
        accept_unreal: false,
    };
    let floating_from_world = assembly.collect()?;
    let massive_root = assembly.groups[0].inertia.mass > 0.0;
    let root = &description.links[description.root];
    // The convention of the format's users: a root link of this name is the world.
    let anchored = massive_root && !floating_from_world && root.name == "world" && root.inertia.is_none();
    if anchored && options.base == BaseChoice::Auto {
        assembly.warnings.push(format!(
            "{}:{}: link `world`: a root link of this name is the world, so the robot is fixed to it (base `floating` lets it float)",
            file.display(),
            root.line
        ));
    }
    let floats = match &options.base {
        BaseChoice::Auto => (massive_root && !anchored) || floating_from_world,
        BaseChoice::Floating => true,
        BaseChoice::Fixed(name) => {
            let link = description.links.iter().position(|link| link.name == *name);
            link.and_then(|link| assembly.placed[link]).is_some_and(|(group, _)| group != 0)
        }
    };
    assembly.check_inertias(usize::from(!floats))?;
    let refuse_base = |wanted: String| Err(assembly.refuse_file(Rule::Base { wanted }));
    match &options.base {
        BaseChoice::Auto => assembly.finish(companion, floats, None),
        BaseChoice::Floating if massive_root || floating_from_world => assembly.finish(companion, true, None),
        BaseChoice::Floating => refuse_base("floating: its root link has no mass".to_owned()),
        BaseChoice::Fixed(name) => {
            let link = description.links.iter().position(|link| link.name == *name);
            let Some((group, pose)) = link.and_then(|link| assembly.placed[link]) else {
                return refuse_base(format!("fixed at `{name}`: there is no such link"));
            };
            if group == 0 {
                assembly.finish(companion, false, Some(pose))
            } else if massive_root || floating_from_world {
                Ok(assembly.finish(companion, true, None)?.rooted_at(name)?.model)
            } else {
                refuse_base(format!(
                    "fixed at `{name}`: the root link is empty, so the robot is fixed there already"
                ))
            }
        }
    }
}

impl Assembly<'_> {
    fn refuse_file(&self, rule: Rule) -> RobotError {
        RobotError::new(self.file, None, Subject::File, rule)
    }

    fn refuse_joint(&self, joint: &UrdfJoint, rule: Rule) -> RobotError {
        RobotError::new(self.file, Some(joint.line), Subject::Joint(joint.name.clone()), rule)
    }

    fn refuse_link(&self, link: usize, rule: Rule) -> RobotError {
        let link = &self.description.links[link];
        RobotError::new(self.file, Some(link.line), Subject::Link(link.name.clone()), rule)
    }

    /// Walks the tree depth-first and fills `groups` and `placed`. Returns whether an empty root carries a floating robot.
    fn collect(&mut self) -> Result<bool, RobotError> {
        let description = self.description;
        let root = description.root;
        let mut start = root;
        if let ([joint], None) = (&description.children[root][..], &description.links[root].inertia) {
            let joint = &description.joints[*joint];
            if joint.kind == JointType::Floating {
                start = joint.child;
            }
        }
        self.groups.push(Group {
            parent: 0,
            joint: Joint::revolute(Vector3::x(), RigidTransform::identity()),
            name: description.links[start].name.clone(),
            coordinate: None,
            link: Some(start),
            inertia: SpatialInertia::default(),
            single: None,
            has_inertial: false,
        });
        self.place(start, 0, RigidTransform::identity())?;
        let masses = description.subtree_masses();
        let inertial = description.subtrees_with_inertial();
        let accept = self.options.impossible_inertia == ImpossibleInertia::Accept;
        let mut held = Vec::new();
        let mut open: Vec<usize> = description.children[start].iter().rev().copied().collect();
        while let Some(index) = open.pop() {
            let joint = &description.joints[index];
            let Some((group, pose)) = self.placed[joint.parent] else { continue };
            let placement = pose * joint.origin;
            match joint.kind {
                JointType::Fixed => self.place(joint.child, group, placement)?,
                // Nothing can be computed of it, and nothing is lost: a frame that was given a joint, or a joint that by its file cannot move.
                _ if masses[joint.child] == 0.0
                    && (accept || !inertial[joint.child] || joint.limits.velocity == 0.0) =>
                {
                    let error = match inertial[joint.child] {
                        true => self
                            .refuse_link(joint.child, Rule::Physics(ModelError::MasslessSubtree { body: 0 })),
                        false => self.refuse_link(joint.child, Rule::MissingInertial),
                    };
                    if self.options.strict {
                        return Err(error);
                    }
                    held.push((error, joint.name.as_str()));
                    self.place(joint.child, group, placement)?;
                }
                _ => {
                    let group = self.add_joint(index, group, placement)?;
                    self.place(joint.child, group, RigidTransform::identity())?;
                }
            }
            open.extend(description.children[joint.child].iter().rev());
        }
        for (error, joint) in held {
            self.warnings.push(format!("{}: its joint `{joint}` is held at 0", error.fault()));
        }
        let mut massless = Vec::new();
        for group in &self.groups[1..] {
            if let (Some(link), false) = (group.link, group.has_inertial) {
                let error = self.refuse_link(link, Rule::MissingInertial);
                // Inside the tree it is a joint of several axes; at its end it is a mistake.
                if masses[link] == 0.0 || self.options.strict {
                    return Err(error);
                }
                massless.push(Warning { error, instead: "here too, as it carries links with mass" });
            }
        }
        self.warnings.extend(in_words(&massless));
        Ok(start != root)
    }

    /// Every body that moves, from the group `first` on: the links of a group together. A dummy of a milligram on a trunk does no harm,
    /// whatever its inertia says, nor does a pedestal.
    fn check_inertias(&mut self, first: usize) -> Result<(), RobotError> {
        for index in first..self.groups.len() {
            let group = &self.groups[index];
            let Some(link) = group.link else { continue };
            let given = group.given_inertia();
            let Err(error) = inertia::check(&given) else { continue };
            let refused = self.refuse_link(link, Rule::Physics(error));
            let warning = |instead| Warning { error: refused.clone(), instead };
            let (used, said) = match (self.options.impossible_inertia, error) {
                _ if inertia::is_round_off(&given) => (given, "that is round-off, and it is used as it is"),
                (ImpossibleInertia::Repair, error) if is_repairable(&error) => {
                    (inertia::repair(&given), "the nearest possible inertia is used")
                }
                // Only the triangle inequality is a property of real bodies alone; the rest the mathematics needs as well.
                (ImpossibleInertia::Accept, ModelError::InertiaTriangle { .. }) => {
                    (given, "it is used all the same")
                }
                (ImpossibleInertia::Accept, error) if is_repairable(&error) => {
                    (inertia::repair(&given), "the nearest possible inertia is used")
                }
                _ => return Err(refused),
            };
            if self.options.strict {
                return Err(refused);
            }
            let warning = warning(said);
            self.warnings.push(warning.to_string());
            self.groups[index].single = Some(used);
            self.accept_unreal = true;
        }
        Ok(())
    }

    /// Puts a link into a group, with its inertia.
    fn place(&mut self, link: usize, group: usize, pose: RigidTransform) -> Result<(), RobotError> {
        self.placed[link] = Some((group, pose));
        let Some(given) = self.description.links[link].inertia else { return Ok(()) };
        if let Err(error @ (ModelError::NegativeMass { .. } | ModelError::NotFinite { .. })) =
            inertia::check(&given)
        {
            return Err(self.refuse_link(link, Rule::Physics(error)));
        }
        let group = &mut self.groups[group];
        let alone = !group.has_inertial && pose == RigidTransform::identity();
        group.single = alone.then_some(given);
        group.has_inertial = true;
        group.inertia += given.spatial().transformed(&pose);
        Ok(())
    }

    /// Adds the bodies of a moving joint; returns the group its child link belongs to.
    fn add_joint(
        &mut self,
        index: usize,
        parent: usize,
        placement: RigidTransform,
    ) -> Result<usize, RobotError> {
        let joint = &self.description.joints[index];
        let child = &self.description.links[joint.child].name;
        let unsupported = |kind| Err(self.refuse_joint(joint, Rule::UnsupportedJoint { kind }));
        let steps: Vec<(Joint, String)> = match joint.kind {
            JointType::Revolute | JointType::Continuous => {
                vec![(Joint::revolute(joint.axis, placement), joint.name.clone())]
            }
            JointType::Prismatic => vec![(Joint::prismatic(joint.axis, placement), joint.name.clone())],
            JointType::Planar if joint.mimic.is_some() => return unsupported("mimicking planar"),
            JointType::Planar => {
                let ([first, second], names) = plane(&joint.axis);
                let [first_name, second_name, angle] = names.map(|name| format!("{}_{name}", joint.name));
                let here = RigidTransform::identity();
                vec![
                    (Joint::prismatic(first, placement), first_name),
                    (Joint::prismatic(second, here), second_name),
                    (Joint::revolute(joint.axis, here), angle),
                ]
            }
            JointType::Floating => return unsupported("floating"),
            JointType::Spherical => return unsupported("spherical"),
            JointType::Fixed => return unsupported("fixed"),
        };
        let last = steps.len() - 1;
        let mut parent = parent;
        for (step, (kinematics, name)) in steps.into_iter().enumerate() {
            if self.groups.len() > MAX_COORDINATES {
                let rule = Rule::TooMany { what: "joint coordinates", limit: MAX_COORDINATES };
                return Err(self.refuse_joint(joint, rule));
            }
            self.groups.push(Group {
                parent,
                joint: kinematics.with_damping(joint.damping),
                name: if step == last { child.clone() } else { name.clone() },
                coordinate: Some(Coordinate {
                    name,
                    joint: index,
                    limits: joint.limits,
                    actuated: joint.kind != JointType::Planar && joint.mimic.is_none(),
                }),
                link: (step == last).then_some(joint.child),
                inertia: SpatialInertia::default(),
                single: None,
                has_inertial: false,
            });
            parent = self.groups.len() - 1;
        }
        Ok(parent)
    }

    /// Builds tree and model; `fixed_frame` is the pose of the fixed link's frame in the root group.
    fn finish(
        mut self,
        companion: Option<&CompanionFile>,
        floating: bool,
        fixed_frame: Option<RigidTransform>,
    ) -> Result<RobotModel, RobotError> {
        let coordinates = || self.groups.iter().filter_map(|group| group.coordinate.as_ref());
        let joint_names: Vec<String> = coordinates().map(|coordinate| coordinate.name.clone()).collect();
        let (passive, springs) = match companion {
            Some(companion) => companion.joints(&joint_names)?,
            None => (vec![false; joint_names.len()], joint_names.iter().map(|_| None).collect()),
        };
        self.check_names(&joint_names)?;
        let limits: Vec<JointLimits> = coordinates().map(|coordinate| coordinate.limits).collect();
        let of_joint = |value: fn(&UrdfJoint) -> f64| -> Vec<f64> {
            coordinates().map(|coordinate| value(&self.description.joints[coordinate.joint])).collect()
        };
        let (damping, friction) = (of_joint(|joint| joint.damping), of_joint(|joint| joint.friction));
        let actuated = coordinates()
            .zip(&passive)
            .map(|(coordinate, passive)| coordinate.actuated && !passive)
            .collect();
        let coordinate_map = self.coordinate_map()?;

        for (group, spring) in self.groups[1..].iter_mut().zip(springs) {
            if let Some(spring) = spring {
                group.joint = group.joint.with_spring(spring.stiffness, spring.rest);
            }
        }
        let ground = fixed_frame.unwrap_or_default().inverse();
        let tree = self.build_tree(floating, &ground)?;
        let attachment = |group: usize, pose: &RigidTransform| match group {
            0 if !floating => Attachment { body: None, pose: ground * *pose },
            _ => Attachment { body: Some(group - usize::from(!floating)), pose: *pose },
        };
        let links: Vec<NamedLink> = self
            .description
            .links
            .iter()
            .zip(&self.placed)
            .map(|(link, placed)| {
                // The empty root of a floating robot is the world itself.
                let world = Attachment { body: None, pose: RigidTransform::identity() };
                let attachment = placed.as_ref().map_or(world, |(group, pose)| attachment(*group, pose));
                NamedLink { name: link.name.clone(), attachment }
            })
            .collect();
        let (shapes, meshes) = placed_shapes(self.description, &links);
        if friction.iter().any(|&friction| friction != 0.0) {
            self.warnings.push("dry joint friction is not simulated".to_owned());
        }
        let first = usize::from(!floating);
        let mut model = RobotModel {
            name: self.description.name.clone(),
            file: self.file.to_owned(),
            tree,
            body_names: self.groups[first..].iter().map(|group| group.name.clone()).collect(),
            joint_names,
            limits,
            actuated,
            damping,
            friction,
            links,
            shapes,
            meshes,
            mesh_folder: None,
            contacts: Vec::new(),
            frames: Vec::new(),
            soles: Vec::new(),
            postures: Vec::new(),
            coordinate_map,
            warnings: self.warnings,
        };
        if let Some(companion) = companion {
            companion.complete(&mut model)?;
        }
        Ok(model)
    }

    /// The coordinates of a planar joint must not take the name of another joint.
    fn check_names(&self, names: &[String]) -> Result<(), RobotError> {
        let mut seen = std::collections::HashSet::new();
        let coordinates = self.groups.iter().filter_map(|group| group.coordinate.as_ref());
        for (name, coordinate) in names.iter().zip(coordinates) {
            if !seen.insert(name) {
                return Err(
                    self.refuse_joint(&self.description.joints[coordinate.joint], Rule::DuplicateName)
                );
            }
        }
        Ok(())
    }

    fn coordinate_map(&self) -> Result<CoordinateMap, RobotError> {
        let description = self.description;
        let mut coordinate_of_joint = vec![None; description.joints.len()];
        let coordinates: Vec<&Coordinate> =
            self.groups.iter().filter_map(|group| group.coordinate.as_ref()).collect();
        for (place, coordinate) in coordinates.iter().enumerate() {
            coordinate_of_joint[coordinate.joint] = Some(place);
        }
        let mut followers = Vec::new();
        for (place, coordinate) in coordinates.iter().enumerate() {
            let joint = &description.joints[coordinate.joint];
            let Some((followed, multiplier, offset)) = joint.mimic else { continue };
            let kind = match description.joints[followed].kind {
                JointType::Revolute | JointType::Continuous | JointType::Prismatic => None,
                JointType::Planar => Some("planar-mimicking"),
                JointType::Floating => Some("floating-mimicking"),
                _ => Some("fixed-mimicking"),
            };
            let source = match (kind, coordinate_of_joint[followed]) {
                (None, Some(source)) => source,
                (kind, _) => {
                    let kind = kind.unwrap_or("fixed-mimicking");
                    return Err(self.refuse_joint(joint, Rule::UnsupportedJoint { kind }));
                }
            };
            followers.push(Follower { joint: place, source, multiplier, offset });
        }
        if followers.is_empty() {
            return Ok(CoordinateMap::identity(coordinates.len()));
        }
        CoordinateMap::new(coordinates.len(), &followers).map_err(|(joint, through)| {
            let through = coordinates[through].name.clone();
            self.refuse_joint(&description.joints[coordinates[joint].joint], Rule::MimicCycle { through })
        })
    }

    fn build_tree(&self, floating: bool, ground: &RigidTransform) -> Result<KinematicTree, RobotError> {
        let gravity_w = self.options.gravity_w;
        let mut builder = if floating {
            TreeBuilder::floating_base(gravity_w, self.groups[0].given_inertia())
        } else {
            let mut builder = TreeBuilder::fixed_base(gravity_w);
            builder.set_ground_inertia(self.groups[0].inertia.transformed(ground));
            builder
        };
        if self.accept_unreal {
            builder.accept_unreal_inertia();
        }
        for group in &self.groups[1..] {
            let mut joint = group.joint;
            let parent = match group.parent {
                0 if !floating => {
                    joint.placement = *ground * joint.placement;
                    None
                }
                parent => Some(parent - usize::from(!floating)),
            };
            builder.add(Body::new(parent, joint, group.given_inertia()));
        }
        builder.build().map_err(|error| match body_of(&error) {
            Some(body) => {
                let group = &self.groups[body + usize::from(!floating)];
                match (&group.coordinate, group.link) {
                    (Some(coordinate), _) if matches!(error, ModelError::NegativeDamping { .. }) => {
                        self.refuse_joint(&self.description.joints[coordinate.joint], Rule::Physics(error))
                    }
                    (_, Some(link)) => self.refuse_link(link, Rule::Physics(error)),
                    (Some(coordinate), None) => {
                        self.refuse_joint(&self.description.joints[coordinate.joint], Rule::Physics(error))
                    }
                    (None, None) => self.refuse_file(Rule::Physics(error)),
                }
            }
            None => self.refuse_file(Rule::Physics(error)),
        })
    }
}

impl Group {
    /// Of all its links together.
    fn given_inertia(&self) -> LinkInertia {
        if let Some(single) = self.single {
            return single;
        }
        let inertia = &self.inertia.rotational;
        if self.inertia.mass <= 0.0 {
            return LinkInertia::new(0.0, Vector3::zeros(), (inertia + inertia.transpose()) * 0.5);
        }
        let (com, inertia) = self.inertia.to_central();
        let symmetric = (inertia + inertia.transpose()) * 0.5;
        inertia::without_round_off(LinkInertia::new(self.inertia.mass, com, symmetric))
    }
}

/// Whether the nearest possible inertia is a way out.
fn is_repairable(error: &ModelError) -> bool {
    matches!(
        error,
        ModelError::InertiaNotPositive { .. }
            | ModelError::InertiaTriangle { .. }
            | ModelError::InertiaWithoutMass { .. }
    )
}

/// The shapes and meshes of every link, on the body that carries it.
fn placed_shapes(description: &Description, links: &[NamedLink]) -> (Vec<Shape>, Vec<Mesh>) {
    let (mut shapes, mut meshes) = (Vec::new(), Vec::new());
    for (link, NamedLink { name, attachment }) in description.links.iter().zip(links) {
        let at = |pose: RigidTransform| Attachment { body: attachment.body, pose: attachment.pose * pose };
        shapes.extend(link.shapes.iter().map(|shape| Shape {
            link: name.clone(),
            attachment: at(shape.pose),
            role: shape.role,
            geometry: shape.geometry,
            rgba: shape.rgba,
        }));
        meshes.extend(link.meshes.iter().map(|mesh| Mesh {
            link: name.clone(),
            attachment: at(mesh.pose),
            role: mesh.role,
            file: mesh.file.clone(),
            scale: mesh.scale,
            rgba: mesh.rgba,
        }));
    }
    (shapes, meshes)
}

/// Warnings as lines; of many of one kind the first one, and how many there are.
fn in_words(warnings: &[Warning]) -> Vec<String> {
    let mut kinds: Vec<(&Warning, usize)> = Vec::new();
    for warning in warnings {
        let alike = |(first, _): &&mut (&Warning, usize)| {
            first.instead == warning.instead
                && std::mem::discriminant(first.error.rule()) == std::mem::discriminant(warning.error.rule())
        };
        match kinds.iter_mut().find(alike) {
            Some((_, count)) => *count += 1,
            None => kinds.push((warning, 1)),
        }
    }
    let line = |(first, count): &(&Warning, usize)| match count {
        1 => first.to_string(),
        count => format!("{first} (and {} more of this kind)", count - 1),
    };
    kinds.iter().map(line).collect()
}

/// Two directions in the plane with the given unit normal, and names for the three coordinates.
fn plane(normal: &Vector3<f64>) -> ([Vector3<f64>; 2], [&'static str; 3]) {
    let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
    if normal.x.abs() == 1.0 {
        ([y, z], ["y", "z", "roll"])
    } else if normal.y.abs() == 1.0 {
        ([x, z], ["x", "z", "pitch"])
    } else if normal.z.abs() == 1.0 {
        ([x, y], ["x", "y", "yaw"])
    } else {
        // The coordinate axis farthest from the normal, projected.
        let away = Vector3::ith(normal.iamin(), 1.0);
        let first = (away - normal * normal.dot(&away)).normalize();
        ([first, normal.cross(&first)], ["1", "2", "angle"])
    }
}

fn body_of(error: &ModelError) -> Option<usize> {
    match *error {
        ModelError::NotFinite { body, .. }
        | ModelError::AxisNotUnit { body, .. }
        | ModelError::PlacementNotRotation { body, .. }
        | ModelError::NegativeMass { body, .. }
        | ModelError::InertiaNotSymmetric { body, .. }
        | ModelError::InertiaNotPositive { body, .. }
        | ModelError::InertiaTriangle { body, .. }
        | ModelError::InertiaWithoutMass { body }
        | ModelError::MasslessSubtree { body }
        | ModelError::ParentAfterChild { body, .. }
        | ModelError::NegativeDamping { body, .. }
        | ModelError::NegativeDrag { body, .. }
        | ModelError::Unsupported { body, .. } => Some(body),
        _ => None,
    }
}
