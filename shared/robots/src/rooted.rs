//! A robot seen from one of its frames: the model that a controller of a standing robot works with.

use delmpc_mechanics::reroot::Rerooted;

use crate::error::{RobotError, Rule, Subject};
use crate::model::{Attachment, ContactPoint, Mesh, NamedFrame, NamedLink, Posture, RobotModel, Shape};

/// The robot with a fixed base at a frame, and the maps from and to the floating robot.
#[derive(Clone, Debug)]
pub struct RootedModel {
    /// The robot, {0} at the frame; names, limits and the rest in the order of the new tree. What is on the rooted link is
    /// attached to {0}. Postures keep their joint coordinates and have no base pose.
    pub model: RobotModel,
    /// Maps of bodies, joints and states between the floating tree and this one.
    pub rerooted: Rerooted,
}

impl RobotModel {
    /// Fixes the robot to the world at a frame (of the companion file, or a link).
    ///
    /// Every joint keeps its name, its value and its sign; the order changes to the way from the frame outwards.
    ///
    /// # Errors
    /// [`Rule::Unknown`] for a frame that does not exist, [`Rule::Base`] when the robot does not float,
    /// [`Rule::Physics`] when a joint on the way would carry no mass.
    pub fn rooted_at(&self, frame: &str) -> Result<RootedModel, RobotError> {
        let refuse = |rule| RobotError::new(&self.file, None, Subject::File, rule);
        let attachment = self
            .frame(frame)
            .ok_or_else(|| refuse(Rule::Unknown { kind: "frame or link", name: frame.to_owned() }))?;
        let (true, Some(body)) = (self.tree.is_floating(), attachment.body) else {
            let wanted = format!("fixed at `{frame}`: this robot's base is fixed already");
            return Err(refuse(Rule::Base { wanted }));
        };
        let rerooted = Rerooted::new(&self.tree, body, &attachment.pose)
            .map_err(|error| refuse(Rule::Physics(error)))?;

        let old_joints: Vec<usize> = rerooted.old_joint_bodies().iter().map(|body| body - 1).collect();
        let moved = |old: &Attachment| move_attachment(&rerooted, old);
        let model = RobotModel {
            name: self.name.clone(),
            file: self.file.clone(),
            tree: rerooted.tree().clone(),
            body_names: rerooted.old_bodies().iter().map(|&body| self.body_names[body].clone()).collect(),
            joint_names: permute(&self.joint_names, &old_joints),
            limits: permute(&self.limits, &old_joints),
            actuated: permute(&self.actuated, &old_joints),
            damping: permute(&self.damping, &old_joints),
            friction: permute(&self.friction, &old_joints),
            links: self
                .links
                .iter()
                .map(|link| NamedLink { attachment: moved(&link.attachment), ..link.clone() })
                .collect(),
            shapes: self
                .shapes
                .iter()
                .map(|shape| Shape { attachment: moved(&shape.attachment), ..shape.clone() })
                .collect(),
            mesh_folder: self.mesh_folder.clone(),
            meshes: self
                .meshes
                .iter()
                .map(|mesh| Mesh { attachment: moved(&mesh.attachment), ..mesh.clone() })
                .collect(),
            contacts: self
                .contacts
                .iter()
                .map(|contact| match contact.body {
                    Some(body) => {
                        let (body, position) = rerooted.point(body, &contact.position);
                        ContactPoint { body, position, ..contact.clone() }
                    }
                    None => contact.clone(),
                })
                .collect(),
            frames: self
                .frames
                .iter()
                .map(|frame| NamedFrame { attachment: moved(&frame.attachment), ..frame.clone() })
                .collect(),
            soles: self.soles.clone(),
            postures: self
                .postures
                .iter()
                .map(|posture| Posture {
                    name: posture.name.clone(),
                    base_link_pose_w: None,
                    q: permute(&posture.q, &old_joints),
                })
                .collect(),
            coordinate_map: self.coordinate_map.permuted(&old_joints),
            warnings: self.warnings.clone(),
        };
        Ok(RootedModel { model, rerooted })
    }
}

fn permute<T: Clone>(old: &[T], old_joints: &[usize]) -> Vec<T> {
    old_joints.iter().map(|&joint| old[joint].clone()).collect()
}

fn move_attachment(rerooted: &Rerooted, old: &Attachment) -> Attachment {
    let Some(body) = old.body else { return *old };
    let (body, translation) = rerooted.point(body, &old.pose.translation);
    // Link axes stay, except that the ground's are those of the frame.
    let rotation = match body {
        Some(_) => old.pose.rotation,
        None => rerooted.frame().rotation.tr_mul(&old.pose.rotation),
    };
    Attachment { body, pose: delmpc_mechanics::spatial::RigidTransform { rotation, translation } }
}
