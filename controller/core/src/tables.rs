//! A robot as constants: what a firmware compiles in instead of reading a URDF, and what other languages hand over.
//!
//! Everything is an array or a reference to one, so that a table can be a `const` in flash: `delmpc model ROBOT.urdf --emit rust` writes
//! it. [`RobotTable::model`] makes the [`ControllerModel`] of it, once, at the start; the joints of all lists are in the order of the
//! bodies, which is that of the messages.

use alloc::vec::Vec;

use delmpc_estimation::prelude::{EstimatorConfig, EstimatorModel, FootModel};
use delmpc_mechanics::reroot::Rerooted;
use delmpc_mechanics::spatial::RigidTransform;
use delmpc_mechanics::tree::{Body, Joint, JointKind, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::{Matrix3, Vector3};

use crate::errors::ControlError;
use crate::model::{BodyPoint, ControllerModel, JointLimits, Sensing};

/// A pose as numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseTable {
    /// Rotation, row by row.
    pub rotation: [[f64; 3]; 3],
    /// Translation, m.
    pub translation: [f64; 3],
}

impl PoseTable {
    /// No motion.
    pub const IDENTITY: Self =
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

    /// The numbers of a pose.
    pub fn of(pose: &RigidTransform) -> Self {
        Self { rotation: rows(&pose.rotation), translation: pose.translation.into() }
    }

    fn pose(&self) -> RigidTransform {
        RigidTransform { rotation: matrix(&self.rotation), translation: self.translation.into() }
    }
}

/// A body, and the joint it hangs on. The joint of a floating base is not looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyTable {
    /// Index of the parent, below the body's own; `None`: it hangs on the ground, or is the floating base.
    pub parent: Option<usize>,
    /// Whether the joint translates; otherwise it turns.
    pub prismatic: bool,
    /// Unit axis in the joint frame.
    pub axis: [f64; 3],
    /// Joint frame in the parent's link frame at coordinate 0.
    pub placement: PoseTable,
    /// Viscous damping, N m s/rad or N s/m.
    pub damping: f64,
    /// Spring stiffness, N m/rad or N/m.
    pub stiffness: f64,
    /// Coordinate at which the spring is relaxed, rad or m.
    pub rest: f64,
    /// Mass, kg.
    pub mass: f64,
    /// Mass centre in the link frame, m.
    pub com: [f64; 3],
    /// Inertia about the mass centre in link axes, row by row, kg m².
    pub inertia: [[f64; 3]; 3],
}

impl BodyTable {
    /// The numbers of a body; drag and constant wrenches have no place in a table.
    pub fn of(body: &Body) -> Self {
        let Body { parent, joint, inertia, .. } = body;
        Self {
            parent: *parent,
            prismatic: joint.kind == JointKind::Prismatic,
            axis: joint.axis.into(),
            placement: PoseTable::of(&joint.placement),
            damping: joint.damping,
            stiffness: joint.stiffness,
            rest: joint.rest,
            mass: inertia.mass,
            com: inertia.com.into(),
            inertia: rows(&inertia.inertia),
        }
    }

    fn link_inertia(&self) -> LinkInertia {
        LinkInertia::new(self.mass, self.com.into(), matrix(&self.inertia))
    }

    fn body(&self) -> Body {
        let kind = if self.prismatic { JointKind::Prismatic } else { JointKind::Revolute };
        let (axis, placement) = (self.axis.into(), self.placement.pose());
        let Self { damping, stiffness, rest, .. } = *self;
        let joint = Joint { kind, axis, placement, damping, stiffness, rest };
        Body::new(self.parent, joint, self.link_inertia())
    }
}

/// A point of a body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointTable {
    /// Body of the table.
    pub body: usize,
    /// Position in its link frame, m.
    pub position: [f64; 3],
}

/// A sole.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoleTable<'a> {
    /// Body of the table.
    pub body: usize,
    /// Sole frame in its link frame: x forward, z out of the ground.
    pub frame: PoseTable,
    /// Corners in that frame, counter-clockwise from above, m.
    pub polygon: &'a [[f64; 2]],
}

/// How a floating robot stands and feels that it does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StanceTable<'a> {
    /// The soles, in the order of the messages.
    pub soles: &'a [SoleTable<'a>],
    /// Which one it stands on.
    pub stance: usize,
    /// Body of the inertial unit.
    pub imu_body: usize,
    /// Its axes and origin in that body's link frame.
    pub imu_mounting: PoseTable,
    /// How good the sensors are.
    pub sensors: EstimatorConfig,
}

/// A robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotTable<'a> {
    /// Hash of the joint names: `delmpc_messages::joint_set_hash`.
    pub joint_set_hash: u64,
    /// Gravity, m/s².
    pub gravity_w: [f64; 3],
    /// The bodies, parents first. With a stance the first one is the floating base, without every body has a joint.
    pub bodies: &'a [BodyTable],
    /// Limits of the joints.
    pub limits: &'a [JointLimits],
    /// Home posture.
    pub posture: &'a [f64],
    /// What it stands on; `None`: it is bolted to the ground.
    pub stance: Option<StanceTable<'a>>,
    /// The point that reaches.
    pub hand: Option<PointTable>,
    /// The other foot.
    pub swing_foot: Option<PointTable>,
}

impl RobotTable<'_> {
    /// Number of joints.
    pub fn joints(&self) -> usize {
        self.bodies.len().saturating_sub(usize::from(self.stance.is_some()))
    }

    /// The model of a controller. Allocates; O(n).
    ///
    /// # Errors
    /// [`ControlError`]: the first rule of the mechanics or of the controller that the table breaks.
    pub fn model(&self) -> Result<ControllerModel, ControlError> {
        let joints = self.joints();
        for (quantity, found) in [("joint limits", self.limits.len()), ("posture", self.posture.len())] {
            if found != joints {
                return Err(ControlError::Length { quantity, found, expected: joints });
            }
        }
        let tree = self.tree()?;
        let Some(table) = &self.stance else {
            let (limits, posture) = (self.limits.to_vec(), self.posture.to_vec());
            let mut model = ControllerModel::standing(tree, self.joint_set_hash, limits, Vec::new(), posture);
            let point = |table: PointTable| BodyPoint { body: table.body, position: table.position.into() };
            model.hand = self.hand.map(point);
            model.swing_foot = self.swing_foot.map(point);
            return Ok(model);
        };
        let missing = ControlError::Model { reason: "the table has no sole with the number of its stance" };
        let sole = table.soles.get(table.stance).ok_or(missing)?;
        let rerooted = Rerooted::new(&tree, sole.body, &sole.frame.pose())?;
        let message_joint = ControllerModel::message_joints(&rerooted);
        let point = |table: PointTable| {
            let (body, position) = rerooted.point(table.body, &table.position.into());
            Some(BodyPoint { body: body?, position })
        };
        Ok(ControllerModel {
            tree: rerooted.tree().clone(),
            joint_set_hash: self.joint_set_hash,
            limits: message_joint.iter().map(|&joint| self.limits[joint]).collect(),
            posture: message_joint.iter().map(|&joint| self.posture[joint]).collect(),
            message_joint,
            sole: sole.polygon.to_vec(),
            hand: self.hand.and_then(point),
            swing_foot: self.swing_foot.and_then(point),
            sensing: Some(Sensing {
                estimator: EstimatorModel {
                    imu_body: table.imu_body,
                    imu_mounting: table.imu_mounting.pose(),
                    reference_foot: table.stance,
                    ..EstimatorModel::new(tree, feet(table.soles))
                },
                config: table.sensors,
                stance_foot: table.stance,
                rerooted,
            }),
        })
    }

    fn tree(&self) -> Result<KinematicTree, ControlError> {
        let gravity_w = Vector3::from(self.gravity_w);
        let (mut builder, jointed) = match (&self.stance, self.bodies.split_first()) {
            (Some(_), Some((base, jointed))) => {
                (TreeBuilder::floating_base(gravity_w, base.link_inertia()), jointed)
            }
            _ => (TreeBuilder::fixed_base(gravity_w), self.bodies),
        };
        for table in jointed {
            builder.add(table.body());
        }
        Ok(builder.build()?)
    }
}

fn feet(soles: &[SoleTable<'_>]) -> Vec<FootModel> {
    let foot = |sole: &SoleTable<'_>| FootModel {
        body: sole.body,
        sole: sole.frame.pose(),
        polygon: sole.polygon.to_vec(),
    };
    soles.iter().map(foot).collect()
}

fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    core::array::from_fn(|row| core::array::from_fn(|column| matrix[(row, column)]))
}

fn matrix(rows: &[[f64; 3]; 3]) -> Matrix3<f64> {
    Matrix3::from_fn(|row, column| rows[row][column])
}
