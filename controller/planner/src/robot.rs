//! A robot as the planner sees it: a tree in joint coordinates, its contact points, its legs' outlines, its limits.
//!
//! A floating base becomes six virtual joints (x, y, z, then yaw, pitch, roll about z, y', x'') on massless bodies. For a
//! plan this is as good as the chart-free base of `delmpc_mechanics`: the pitch of a plan is bounded far from the chart's
//! singularity at π/2, the boundary momenta are of the same order, and states are plain vectors that can be interpolated,
//! bounded and differenced. A planar base is part of the tree already; a tree rooted at a foot needs none.

use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use delmpc_robots::{JointLimits, RobotModel};
use nalgebra::{Matrix3, Vector3};

use crate::error::PlanError;

/// Names of the virtual joints of a floating base.
pub const FLOATING_BASE: [&str; 6] = ["base_x", "base_y", "base_z", "base_yaw", "base_pitch", "base_roll"];

/// A point fixed to a body.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyPoint {
    /// Name.
    pub name: String,
    /// Body (and coordinate) it moves with.
    pub body: usize,
    /// Position in the link frame, m.
    pub point: [f64; 3],
    /// Radius of the sphere around it, m.
    pub radius: f64,
}

/// A robot for planning.
#[derive(Clone, Debug)]
pub struct PlanRobot {
    /// Name.
    pub name: String,
    /// The tree, fixed base, one coordinate per body.
    pub tree: KinematicTree,
    /// Name of every coordinate.
    pub coordinates: Vec<String>,
    /// Coordinates that are driven.
    pub actuated: Vec<usize>,
    /// Limits of every coordinate.
    pub limits: Vec<JointLimits>,
    /// Coordinates of the base (0: rooted at a foot).
    pub base_coordinates: usize,
    /// Whether it moves in the xz plane.
    pub planar: bool,
    /// Contact points.
    pub contacts: Vec<BodyPoint>,
    /// Foot that each contact point belongs to: points of one body are one foot.
    pub foot_of_contact: Vec<usize>,
    /// Named postures.
    pub postures: Vec<(String, Vec<f64>)>,
    /// Named frames: origins only.
    pub frames: Vec<BodyPoint>,
}

impl PlanRobot {
    /// Takes a robot as loaded.
    ///
    /// # Errors
    /// [`PlanError::Mechanics`] when the tree with virtual joints is refused.
    pub fn new(model: &RobotModel) -> Result<Self, PlanError> {
        let floating = model.tree.is_floating();
        let offset = if floating { 5 } else { 0 };
        let tree = if floating { with_virtual_joints(&model.tree)? } else { model.tree.clone() };
        let mut coordinates: Vec<String> = Vec::new();
        let mut limits = Vec::new();
        if floating {
            coordinates.extend(FLOATING_BASE.map(str::to_owned));
            limits.extend([JointLimits::NONE; 6]);
        }
        coordinates.extend(model.joint_names.iter().cloned());
        limits.extend(model.limits.iter().copied());
        let base_coordinates = coordinates.iter().take_while(|name| name.starts_with("base_")).count();
        let planar = base_coordinates == 3;
        let first_joint = if floating { 6 } else { 0 };
        let actuated = (0..model.actuated.len()).filter(|&j| model.actuated[j]).map(|j| j + first_joint);
        let contacts: Vec<BodyPoint> = model
            .contacts
            .iter()
            .filter_map(|contact| {
                Some(BodyPoint {
                    name: contact.name.clone(),
                    body: contact.body? + offset,
                    point: contact.position.into(),
                    radius: contact.radius,
                })
            })
            .collect();
        let mut feet: Vec<usize> = Vec::new();
        let foot_of_contact = contacts
            .iter()
            .map(|contact| {
                feet.iter().position(|&body| body == contact.body).unwrap_or_else(|| {
                    feet.push(contact.body);
                    feet.len() - 1
                })
            })
            .collect();
        let frames = model
            .frames
            .iter()
            .filter_map(|frame| {
                Some(BodyPoint {
                    name: frame.name.clone(),
                    body: frame.attachment.body? + offset,
                    point: frame.attachment.pose.translation.into(),
                    radius: 0.0,
                })
            })
            .collect();
        let postures = model
            .postures
            .iter()
            .map(|posture| {
                let mut q = Vec::new();
                if floating {
                    let pose = posture.base_link_pose_w.unwrap_or_else(RigidTransform::identity);
                    q.extend(base_coordinates_of(&pose));
                }
                q.extend(posture.q.iter().copied());
                (posture.name.clone(), q)
            })
            .collect();
        Ok(Self {
            name: model.name.clone(),
            tree,
            actuated: actuated.collect(),
            coordinates,
            limits,
            base_coordinates,
            planar,
            contacts,
            foot_of_contact,
            postures,
            frames,
        })
    }

    /// Takes a robot that stands on one sole and stays there: rooted at the sole's frame, which is {0}.
    ///
    /// The foot hangs on six virtual joints that a plan holds at zero: their DEL rows are the momentum balance of the whole
    /// robot, and what holds them is the wrench of the ground on the sole. The robot has no contact points then.
    ///
    /// # Errors
    /// [`PlanError::UnknownName`] for a sole that the robot does not have, [`PlanError::Mechanics`] when the tree is refused.
    pub fn standing(model: &RobotModel, sole: &str) -> Result<Self, PlanError> {
        let frame =
            model.sole(sole).map(|sole| sole.frame.clone()).ok_or_else(|| PlanError::UnknownName {
                kind: "sole",
                name: sole.to_owned(),
                known: model.soles.iter().map(|sole| sole.name.as_str()).collect::<Vec<_>>().join(", "),
            })?;
        let rooted = model.rooted_at(&frame).map_err(|error| PlanError::Mechanics(error.to_string()))?.model;
        let mut robot = Self::new(&rooted)?;
        robot.tree = on_a_held_foot(&rooted.tree)?;
        robot.coordinates =
            FLOATING_BASE.iter().map(|&name| name.to_owned()).chain(robot.coordinates).collect();
        robot.limits = [JointLimits::NONE; 6].into_iter().chain(robot.limits).collect();
        robot.base_coordinates = 6;
        robot.contacts.clear();
        robot.foot_of_contact.clear();
        for index in &mut robot.actuated {
            *index += 6;
        }
        for frame in &mut robot.frames {
            frame.body += 6;
        }
        for (_, q) in &mut robot.postures {
            q.splice(0..0, [0.0; 6]);
        }
        Ok(robot)
    }

    /// Number of coordinates.
    pub fn dof(&self) -> usize {
        self.coordinates.len()
    }

    /// Index of a coordinate.
    ///
    /// # Errors
    /// [`PlanError::UnknownName`] with the names there are.
    pub fn coordinate(&self, name: &str) -> Result<usize, PlanError> {
        self.coordinates.iter().position(|known| known == name).ok_or_else(|| PlanError::UnknownName {
            kind: "coordinate",
            name: name.to_owned(),
            known: self.coordinates.join(", "),
        })
    }

    /// A frame by name.
    ///
    /// # Errors
    /// [`PlanError::UnknownName`] with the names there are.
    pub fn frame(&self, name: &str) -> Result<&BodyPoint, PlanError> {
        self.frames.iter().find(|frame| frame.name == name).ok_or_else(|| PlanError::UnknownName {
            kind: "frame",
            name: name.to_owned(),
            known: self.frames.iter().map(|frame| frame.name.as_str()).collect::<Vec<_>>().join(", "),
        })
    }

    /// A posture by name.
    ///
    /// # Errors
    /// [`PlanError::UnknownName`] with the names there are.
    pub fn posture(&self, name: &str) -> Result<&[f64], PlanError> {
        let found = self.postures.iter().find(|(known, _)| known == name);
        found.map(|(_, q)| q.as_slice()).ok_or_else(|| PlanError::UnknownName {
            kind: "posture",
            name: name.to_owned(),
            known: self.postures.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", "),
        })
    }

    /// The same robot with other springs: stiffness and rest position of named coordinates.
    ///
    /// # Errors
    /// [`PlanError::UnknownName`]; [`PlanError::Mechanics`] when the tree refuses the values.
    pub fn with_springs(&self, springs: &[(&str, f64, f64)]) -> Result<Self, PlanError> {
        let mut bodies = self.tree.bodies().to_vec();
        for &(name, stiffness, rest) in springs {
            let joint = &mut bodies[self.coordinate(name)?].joint;
            (joint.stiffness, joint.rest) = (stiffness, rest);
        }
        self.with_bodies(bodies)
    }

    /// The same robot with the damping (N m s/rad) and the spring (N m/rad, rad) of every coordinate.
    ///
    /// # Errors
    /// [`PlanError::Mechanics`] when the tree refuses the values.
    pub fn with_joint_laws(&self, damping: &[f64], springs: &[[f64; 2]]) -> Result<Self, PlanError> {
        let mut bodies = self.tree.bodies().to_vec();
        for ((body, &damping), &[stiffness, rest]) in bodies.iter_mut().zip(damping).zip(springs) {
            let joint = &mut body.joint;
            (joint.damping, joint.stiffness, joint.rest) = (damping, stiffness, rest);
        }
        self.with_bodies(bodies)
    }

    fn with_bodies(&self, bodies: Vec<Body>) -> Result<Self, PlanError> {
        let mut builder = TreeBuilder::fixed_base(*self.tree.gravity_w());
        builder.accept_unreal_inertia();
        for body in bodies {
            builder.add(body);
        }
        let tree = builder.build().map_err(|error| PlanError::Mechanics(error.to_string()))?;
        Ok(Self { tree, ..self.clone() })
    }

    /// The tree in which the planner's foot-rooted robots stand: every coordinate of the base at rest.
    pub fn is_foot_rooted(&self) -> bool {
        self.base_coordinates == 0
    }
}

/// `(x, y, z, yaw, pitch, roll)` of a pose.
pub fn base_coordinates_of(pose: &RigidTransform) -> [f64; 6] {
    let r = &pose.rotation;
    let t = &pose.translation;
    let yaw = r[(1, 0)].atan2(r[(0, 0)]);
    let pitch = (-r[(2, 0)]).atan2(r[(2, 1)].hypot(r[(2, 2)]));
    let roll = r[(2, 1)].atan2(r[(2, 2)]);
    [t.x, t.y, t.z, yaw, pitch, roll]
}

/// A tree fixed at its foot, the foot on six virtual joints with what is welded to {0} as its mass.
fn on_a_held_foot(tree: &KinematicTree) -> Result<KinematicTree, PlanError> {
    let ground = tree.ground_inertia_w();
    let mass = ground.mass;
    let com = if mass > 0.0 { ground.first_moment / mass } else { Vector3::zeros() };
    let central = ground.rotational - (Matrix3::identity() * com.dot(&com) - com * com.transpose()) * mass;
    let foot = LinkInertia { mass, com, inertia: 0.5 * (central + central.transpose()) };
    let mut builder = TreeBuilder::fixed_base(*tree.gravity_w());
    builder.accept_unreal_inertia();
    add_virtual_joints(&mut builder, foot);
    for body in tree.bodies() {
        builder.add(Body { parent: Some(body.parent.map_or(5, |parent| parent + 6)), ..*body });
    }
    builder.build().map_err(|error| PlanError::Mechanics(error.to_string()))
}

/// The floating base as six virtual joints; bodies keep their order after them.
fn with_virtual_joints(tree: &KinematicTree) -> Result<KinematicTree, PlanError> {
    let mut builder = TreeBuilder::fixed_base(*tree.gravity_w());
    builder.accept_unreal_inertia();
    add_virtual_joints(&mut builder, tree.bodies()[0].inertia);
    for body in &tree.bodies()[1..] {
        builder.add(Body { parent: body.parent.map(|parent| parent + 5), ..*body });
    }
    builder.build().map_err(|error| PlanError::Mechanics(error.to_string()))
}

fn add_virtual_joints(builder: &mut TreeBuilder, last: LinkInertia) {
    let massless = LinkInertia { mass: 0.0, com: Vector3::zeros(), inertia: Matrix3::zeros() };
    let here = RigidTransform::identity();
    let joints = [
        Joint::prismatic(Vector3::x(), here),
        Joint::prismatic(Vector3::y(), here),
        Joint::prismatic(Vector3::z(), here),
        Joint::revolute(Vector3::z(), here),
        Joint::revolute(Vector3::y(), here),
        Joint::revolute(Vector3::x(), here),
    ];
    for (index, joint) in joints.into_iter().enumerate() {
        let inertia = if index == 5 { last } else { massless };
        builder.add(Body::new(index.checked_sub(1), joint, inertia));
    }
}
