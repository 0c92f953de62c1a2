//! Re-rooting: the same robot with a fixed base at any of its bodies, for instance the stance foot.
//!
//! The joints between the old base and the new root are walked in the other direction. With `P` the old parent and `C` the old
//! child of such a joint (placement `(R, t)`, axis `a`),
//!
//! ```text
//! X_C = X_P (R, t) joint_a(q)     =>     X_P (1, t) = X_C (Rᵀ, 0) joint_(-Ra)(q)
//! ```
//!
//! so `P` hangs on `C` by a joint with the negated axis: every coordinate keeps its value and its sign. The link frame of `P`
//! moves to the joint's origin and keeps its axes, hence inertia, drag and wrenches in link axes are untouched.
//!
//! | old | new |
//! |---|---|
//! | body `b` that becomes the root | no body: its mass is [`KinematicTree::ground_inertia_w`], {0} is the frame given on it |
//! | bodies from the parent of `b` to the old base | bodies 0, 1, .. in that order, each with the (reversed) joint of its old child |
//! | all others | after them, in the old order, joints unchanged |
//!
//! Generalised velocities follow `(V_w; q̇)_old = N q̇_new`, and mass matrix and gravity force as `Nᵀ H N` and `Nᵀ g`.
//!
//! Cost: constructor O(n) with allocation; conversions of a state O(n) without.
//!
//! Source: own derivation; the numbers of Atlas on its right foot are checked against Pinocchio in `shared/robots`.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use crate::errors::ModelError;
use crate::kinematics::{Kinematics, check_body, check_length};
use crate::spatial::{RigidTransform, SpatialInertia, Twist};
use crate::tree::{Body, KinematicTree, TreeBuilder};

/// A floating tree seen from one of its bodies, and the maps between the two.
#[derive(Clone, Debug)]
pub struct Rerooted {
    tree: KinematicTree,
    root_body: usize,
    frame: RigidTransform,
    /// New body of every old body; `None` for the root.
    new_body: Vec<Option<usize>>,
    /// Old body of every new body.
    old_body: Vec<usize>,
    /// Old body whose joint is the joint of every new body.
    old_joint_body: Vec<usize>,
    /// Origin of the new link frame in the old one, by old body, m.
    link_shift: Vec<Vector3<f64>>,
    /// Mass centre of the old base in its link frame, m.
    base_com: Vector3<f64>,
}

impl Rerooted {
    /// Fixes `body` of the floating `tree` to the world; {0} is the frame at `frame` in its link frame (a sole, say).
    ///
    /// Gravity keeps its components: the frame is taken to stand as {0} stood. Otherwise use
    /// [`KinematicTree::with_gravity`] on the result.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for a tree with a fixed base, a body that does not exist or mass welded to the ground;
    /// [`ModelError::MasslessSubtree`] when a reversed joint would carry no mass;
    /// [`ModelError::Empty`] when the tree is a single body; [`ModelError::PlacementNotRotation`] for a bad `frame`.
    pub fn new(tree: &KinematicTree, body: usize, frame: &RigidTransform) -> Result<Self, ModelError> {
        check_body(tree, body)?;
        if !tree.is_floating() {
            return Err(ModelError::Unsupported { body, reason: "only a floating tree can be re-rooted" });
        }
        if *tree.ground_inertia_w() != SpatialInertia::default() {
            return Err(ModelError::Unsupported {
                body,
                reason: "a tree with mass welded to the ground cannot be re-rooted",
            });
        }
        let defect = (frame.rotation.tr_mul(&frame.rotation) - nalgebra::Matrix3::identity()).amax();
        let rigid = defect <= 1e-9 && frame.rotation.determinant() > 0.0;
        if !rigid || !frame.translation.iter().all(|x| x.is_finite()) {
            return Err(ModelError::PlacementNotRotation { body, defect });
        }

        let bodies = tree.bodies();
        let count = bodies.len();
        let mut builder = TreeBuilder::fixed_base(*tree.gravity_w());
        if tree.accepts_unreal_inertia() {
            builder.accept_unreal_inertia();
        }
        let mut new_body = vec![None; count];
        let mut old_body = Vec::with_capacity(count - 1);
        let mut old_joint_body = Vec::with_capacity(count - 1);
        let mut link_shift = vec![Vector3::zeros(); count];
        // Pose of the old link frame in the new one, for the bodies on the path; the root's is that in {0}.
        let mut old_link_in_new = vec![RigidTransform::identity(); count];
        old_link_in_new[body] = frame.inverse();
        let mut on_path = vec![false; count];
        on_path[body] = true;

        builder.set_ground_inertia(bodies[body].inertia.spatial().transformed(&old_link_in_new[body]));
        let mut child = body;
        while let Some(parent) = bodies[child].parent {
            let mut joint = bodies[child].joint;
            let shift = joint.placement.translation;
            let inverse_rotation = RigidTransform {
                rotation: joint.placement.rotation.transpose(),
                translation: Vector3::zeros(),
            };
            joint.axis = -(joint.placement.rotation * joint.axis);
            joint.placement = old_link_in_new[child] * inverse_rotation;
            let mut reversed = Body { parent: new_body[child], joint, ..bodies[parent] };
            reversed.inertia.com -= shift;
            new_body[parent] = Some(builder.add(reversed));
            old_body.push(parent);
            old_joint_body.push(child);
            link_shift[parent] = shift;
            old_link_in_new[parent] = RigidTransform::from_translation(-shift);
            on_path[parent] = true;
            child = parent;
        }
        for (old, body) in bodies.iter().enumerate() {
            if on_path[old] {
                continue;
            }
            let mut moved = *body;
            if let Some(parent) = body.parent {
                moved.parent = new_body[parent];
                moved.joint.placement = old_link_in_new[parent] * body.joint.placement;
            }
            new_body[old] = Some(builder.add(moved));
            old_body.push(old);
            old_joint_body.push(old);
        }
        Ok(Self {
            tree: builder.build()?,
            root_body: body,
            frame: *frame,
            new_body,
            old_body,
            old_joint_body,
            link_shift,
            base_com: bodies[0].inertia.com,
        })
    }

    /// The tree with the fixed base.
    pub fn tree(&self) -> &KinematicTree {
        &self.tree
    }

    /// The old index of the body that is fixed now.
    pub fn root_body(&self) -> usize {
        self.root_body
    }

    /// Pose of the new {0} in the old link frame of the root body.
    pub fn frame(&self) -> &RigidTransform {
        &self.frame
    }

    /// New index of an old body; `None` for the root body, and for one that does not exist.
    pub fn new_body(&self, old_body: usize) -> Option<usize> {
        self.new_body.get(old_body).copied().flatten()
    }

    /// Old index of every new body.
    pub fn old_bodies(&self) -> &[usize] {
        &self.old_body
    }

    /// For every new body: the old body whose joint (and coordinate) it moves on.
    pub fn old_joint_bodies(&self) -> &[usize] {
        &self.old_joint_body
    }

    /// Origin of the new link frame of an old body in its old link frame, m (axes are the same).
    ///
    /// Zero for bodies that kept their joint; not used for the root body, see [`Rerooted::point`].
    pub fn link_shift(&self, old_body: usize) -> Vector3<f64> {
        self.link_shift[old_body]
    }

    /// A point of an old body (old link frame): the new body and the point in its link frame, or `None` and the point
    /// in {0} when it is on the root body.
    pub fn point(&self, old_body: usize, point: &Vector3<f64>) -> (Option<usize>, Vector3<f64>) {
        match self.new_body(old_body) {
            Some(new) => (Some(new), point - self.link_shift[old_body]),
            None => (None, self.frame.inverse().transform_point(point)),
        }
    }

    /// Joint values (coordinates, rates, torques) from the old order (old bodies 1, 2, ..) to the new one.
    ///
    /// # Errors
    /// [`ModelError::Length`] unless both have one entry per joint.
    pub fn joints_to_rooted(&self, old: &[f64], new: &mut [f64]) -> Result<(), ModelError> {
        check_length("joint values", old.len(), self.old_joint_body.len())?;
        check_length("joint values", new.len(), self.old_joint_body.len())?;
        for (value, &joint) in new.iter_mut().zip(&self.old_joint_body) {
            *value = old[joint - 1];
        }
        Ok(())
    }

    /// Joint values from the new order to the old one; the inverse of [`Rerooted::joints_to_rooted`].
    ///
    /// # Errors
    /// [`ModelError::Length`] unless both have one entry per joint.
    pub fn joints_to_floating(&self, new: &[f64], old: &mut [f64]) -> Result<(), ModelError> {
        check_length("joint values", new.len(), self.old_joint_body.len())?;
        check_length("joint values", old.len(), self.old_joint_body.len())?;
        for (value, &joint) in new.iter().zip(&self.old_joint_body) {
            old[joint - 1] = *value;
        }
        Ok(())
    }

    /// Where the root's frame is in the world of the floating tree, from that tree's kinematics.
    ///
    /// For a robot that stands as assumed it does not change; its change is slip, lift or tilt of the foot.
    pub fn frame_pose_w(&self, floating: &Kinematics) -> RigidTransform {
        floating.link_poses_w()[self.root_body] * self.frame
    }

    /// Spatial twist of the root's frame in the world of the floating tree; zero while the foot stands.
    pub fn frame_twist_w(&self, floating: &Kinematics) -> Twist {
        floating.velocities_w()[self.root_body]
    }

    /// Pose of the floating base (its mass-centre frame) in the world, from the kinematics of the rooted tree and where the
    /// root's frame is in the world.
    pub fn base_pose_w(&self, rooted: &Kinematics, frame_pose_w: &RigidTransform) -> RigidTransform {
        let in_frame = match self.new_body[0] {
            Some(new) => rooted.mass_centre_pose_w(new),
            None => self.frame.inverse() * RigidTransform::from_translation(self.base_com),
        };
        *frame_pose_w * in_frame
    }

    /// Spatial twist of the floating base in the world, from the kinematics of the rooted tree and pose and twist of the
    /// root's frame in the world.
    pub fn base_twist_w(
        &self,
        rooted: &Kinematics,
        frame_pose_w: &RigidTransform,
        frame_twist_w: &Twist,
    ) -> Twist {
        let in_frame = self.new_body[0].map_or_else(Twist::default, |new| rooted.velocities_w()[new]);
        frame_pose_w.transform_twist(&in_frame) + *frame_twist_w
    }
}
