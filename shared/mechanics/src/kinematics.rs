//! Forward kinematics: where every link is, how it moves, and the Jacobians of points on it.
//!
//! ```text
//! X_i = X_parent · placement_i · joint_i(q_i)        S_i = [s_i; o_i × s_i] or [0; s_i]        v_i = v_parent + S_i q̇_i
//! velocity of a point x of body i:   ẋ = v_i.linear + v_i.angular × x
//! ```
//!
//! Everything is in frame {0} (suffix `_w`); twists are *spatial*: their linear part is the velocity of the body point that
//! passes through the origin of {0}. Generalised velocities of a floating tree are `(V_w; q̇)` with the base's spatial twist
//! `V_w` (angular first), those of a fixed tree are `q̇` in the order of the bodies.
//!
//! **Pose of a floating base.** [`Configuration::base_pose_w`] is the paper's frame {i}: axes of the base's link frame,
//! origin at its *mass centre*. [`base_pose_from_link`] and [`base_link_pose`] convert from and to the link frame.
//!
//! Cost: O(n) for the poses and velocities, O(depth) per Jacobian. Reading order: [`Configuration`], [`Kinematics`].
//!
//! Source: the paper, section 2.1; R. M. Murray, Z. Li, S. S. Sastry, *A Mathematical Introduction to Robotic Manipulation*,
//! 1994, chapter 3.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3};

use crate::errors::ModelError;
use crate::real::sin_cos;
use crate::spatial::{RigidTransform, SpatialInertia, Twist};
use crate::state::State;
use crate::tree::{KinematicTree, NO_PARENT};

/// A configuration: pose of the floating base (if any) and one coordinate per joint.
#[derive(Clone, Copy, Debug)]
pub struct Configuration<'a> {
    /// Pose of the floating base in {0}: link axes, origin at the mass centre of body 0. Not read for a fixed base.
    pub base_pose_w: RigidTransform,
    /// Joint coordinates in the order of the bodies, rad or m; length [`KinematicTree::joint_count`].
    pub q: &'a [f64],
}

impl<'a> Configuration<'a> {
    /// Of a tree with a fixed base.
    pub fn fixed(q: &'a [f64]) -> Self {
        Self { base_pose_w: RigidTransform::identity(), q }
    }

    /// Of a tree with a floating base whose mass-centre frame is at `base_pose_w`.
    pub fn floating(base_pose_w: RigidTransform, q: &'a [f64]) -> Self {
        Self { base_pose_w, q }
    }

    /// Of a state of the integrator, with either base.
    pub fn of(state: &'a State) -> Self {
        Self { base_pose_w: state.base_pose, q: &state.q }
    }
}

/// A generalised velocity, or acceleration: `(V_w; q̇)` or `(V̇_w; q̈)`.
#[derive(Clone, Copy, Debug)]
pub struct Velocity<'a> {
    /// Spatial twist of the floating base in {0}, rad/s and m/s. Not read for a fixed base.
    pub base_twist_w: Twist,
    /// Joint rates in the order of the bodies, rad/s or m/s; length [`KinematicTree::joint_count`].
    pub q_dot: &'a [f64],
}

impl<'a> Velocity<'a> {
    /// Of a tree with a fixed base.
    pub fn fixed(q_dot: &'a [f64]) -> Self {
        Self { base_twist_w: Twist::default(), q_dot }
    }

    /// Of a tree with a floating base.
    pub fn floating(base_twist_w: Twist, q_dot: &'a [f64]) -> Self {
        Self { base_twist_w, q_dot }
    }
}

/// Pose of the base's mass-centre frame (what the library uses) from the pose of its link frame.
pub fn base_pose_from_link(tree: &KinematicTree, link_pose_w: &RigidTransform) -> RigidTransform {
    let com = tree.bodies()[0].inertia.com;
    RigidTransform { rotation: link_pose_w.rotation, translation: link_pose_w.transform_point(&com) }
}

/// Pose of the base's link frame from the pose of its mass-centre frame; the inverse of [`base_pose_from_link`].
///
/// The twist of the base in Pinocchio's convention (link axes, at the link's origin; there linear first) is
/// `base_link_pose(..).inverse_transform_twist(&base_twist_w)`.
pub fn base_link_pose(tree: &KinematicTree, base_pose_w: &RigidTransform) -> RigidTransform {
    let com = tree.bodies()[0].inertia.com;
    RigidTransform { rotation: base_pose_w.rotation, translation: base_pose_w.transform_point(&-com) }
}

/// Poses, joint twists and velocities of every body at one configuration. Allocates in [`Kinematics::new`] only.
///
/// | field of every body | written by | meaning |
/// |---|---|---|
/// | link pose, mass centre, joint twist | [`Kinematics::update_positions`] | `X_i`, `c_i`, `S_i` |
/// | velocity | [`Kinematics::update_velocities`] | `v_i` |
#[derive(Clone, Debug)]
pub struct Kinematics {
    link_pose_w: Vec<RigidTransform>,
    mass_centre_w: Vec<Vector3<f64>>,
    joint_twist_w: Vec<Twist>,
    velocity_w: Vec<Twist>,
}

impl Kinematics {
    /// Room for `tree`, everything at the identity and at rest.
    pub fn new(tree: &KinematicTree) -> Self {
        let count = tree.body_count();
        Self {
            link_pose_w: vec![RigidTransform::identity(); count],
            mass_centre_w: vec![Vector3::zeros(); count],
            joint_twist_w: vec![Twist::default(); count],
            velocity_w: vec![Twist::default(); count],
        }
    }

    /// Poses and velocities. Cost: O(n), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] when a slice does not fit the tree.
    pub fn update(
        &mut self,
        tree: &KinematicTree,
        configuration: &Configuration<'_>,
        velocity: &Velocity<'_>,
    ) -> Result<(), ModelError> {
        self.update_positions(tree, configuration)?;
        self.update_velocities(tree, velocity)
    }

    /// Poses, mass centres and joint twists. The velocities are left as they are. Cost: O(n), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] when `q`, or this workspace, does not fit the tree.
    pub fn update_positions(
        &mut self,
        tree: &KinematicTree,
        configuration: &Configuration<'_>,
    ) -> Result<(), ModelError> {
        self.check_tree(tree)?;
        check_length("q", configuration.q.len(), tree.joint_count())?;
        if tree.is_floating() {
            self.link_pose_w[0] = base_link_pose(tree, &configuration.base_pose_w);
            self.mass_centre_w[0] = configuration.base_pose_w.translation;
            self.joint_twist_w[0] = Twist::default();
        }
        let first = tree.first_joint_body();
        for ((i, constants), &q) in tree.constants().iter().enumerate().skip(first).zip(configuration.q) {
            let (parent_rotation, parent_mass_centre) = match constants.parent {
                NO_PARENT => (Matrix3::identity(), Vector3::zeros()),
                parent => (self.link_pose_w[parent].rotation, self.mass_centre_w[parent]),
            };
            let mut local_rotation = Matrix3::from_row_slice(&constants.e0);
            let axis_w = parent_rotation * Vector3::from(constants.axis);
            let mut origin_w = parent_mass_centre + parent_rotation * Vector3::from(constants.joint_origin);
            if constants.revolute {
                let (sin, cos) = sin_cos(q);
                local_rotation += Matrix3::from_row_slice(&constants.e1) * sin;
                local_rotation += Matrix3::from_row_slice(&constants.e2) * (1.0 - cos);
                self.joint_twist_w[i] = Twist::new(axis_w, origin_w.cross(&axis_w));
            } else {
                origin_w += axis_w * q;
                self.joint_twist_w[i] = Twist::new(Vector3::zeros(), axis_w);
            }
            let rotation = parent_rotation * local_rotation;
            self.link_pose_w[i] = RigidTransform { rotation, translation: origin_w };
            self.mass_centre_w[i] = origin_w + rotation * Vector3::from(constants.com);
        }
        Ok(())
    }

    /// Spatial velocities at the poses of the last [`Kinematics::update_positions`]. Cost: O(n), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] when `q_dot`, or this workspace, does not fit the tree.
    pub fn update_velocities(
        &mut self,
        tree: &KinematicTree,
        velocity: &Velocity<'_>,
    ) -> Result<(), ModelError> {
        self.check_tree(tree)?;
        check_length("q_dot", velocity.q_dot.len(), tree.joint_count())?;
        if tree.is_floating() {
            self.velocity_w[0] = velocity.base_twist_w;
        }
        let first = tree.first_joint_body();
        for ((i, constants), &rate) in tree.constants().iter().enumerate().skip(first).zip(velocity.q_dot) {
            let parent = match constants.parent {
                NO_PARENT => Twist::default(),
                parent => self.velocity_w[parent],
            };
            self.velocity_w[i] = parent + self.joint_twist_w[i] * rate;
        }
        Ok(())
    }

    /// Pose of every link frame in {0}.
    pub fn link_poses_w(&self) -> &[RigidTransform] {
        &self.link_pose_w
    }

    /// Mass centre of every body in {0}, m.
    pub fn mass_centres_w(&self) -> &[Vector3<f64>] {
        &self.mass_centre_w
    }

    /// Pose of the paper's frame {i}: link axes, origin at the mass centre of `body`.
    pub fn mass_centre_pose_w(&self, body: usize) -> RigidTransform {
        RigidTransform { rotation: self.link_pose_w[body].rotation, translation: self.mass_centre_w[body] }
    }

    /// `S_i`: spatial twist of every body per unit rate of its joint (zero for a floating base).
    pub fn joint_twists_w(&self) -> &[Twist] {
        &self.joint_twist_w
    }

    /// `v_i`: spatial velocity of every body, rad/s and m/s.
    pub fn velocities_w(&self) -> &[Twist] {
        &self.velocity_w
    }

    /// `M_i`: inertia of `body` about the origin of {0}, axes of {0}.
    pub fn inertia_w(&self, tree: &KinematicTree, body: usize) -> SpatialInertia {
        let inertia = &tree.bodies()[body].inertia;
        let rotation = &self.link_pose_w[body].rotation;
        let com = &self.mass_centre_w[body];
        // J = R I Rᵀ + m (c·c 1 - c cᵀ)
        let first_moment = com * inertia.mass;
        let mut rotational = rotation * inertia.inertia * rotation.transpose();
        let square = first_moment.dot(com);
        for row in 0..3 {
            for column in 0..3 {
                rotational[(row, column)] -= first_moment[row] * com[column];
            }
            rotational[(row, row)] += square;
        }
        SpatialInertia { mass: inertia.mass, first_moment, rotational }
    }

    /// A point given in the link frame of `body`, in {0}, m.
    pub fn point_w(&self, body: usize, point: &Vector3<f64>) -> Vector3<f64> {
        self.link_pose_w[body].transform_point(point)
    }

    /// Velocity in {0} of a point given in the link frame of `body`, m/s.
    pub fn point_velocity_w(&self, body: usize, point: &Vector3<f64>) -> Vector3<f64> {
        let velocity = &self.velocity_w[body];
        velocity.linear + velocity.angular.cross(&self.point_w(body, point))
    }

    /// Jacobian of the velocity of a point of `body` (given in its link frame): `ẋ_w = J (V_w; q̇)`.
    ///
    /// `jacobian` is row-major, 3 x dof, m per unit of each coordinate. Cost: O(dof), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a wrong slice, [`ModelError::Unsupported`] for a body that does not exist.
    pub fn point_jacobian_into(
        &self,
        tree: &KinematicTree,
        body: usize,
        point: &Vector3<f64>,
        jacobian: &mut [f64],
    ) -> Result<(), ModelError> {
        self.check_tree(tree)?;
        check_body(tree, body)?;
        check_length("jacobian", jacobian.len(), 3 * tree.dof())?;
        jacobian.fill(0.0);
        self.add_linear_rows(tree, body, &self.point_w(body, point), 1.0, jacobian);
        Ok(())
    }

    /// Jacobian of a frame of `body` with its origin at `point` (link frame): `(ω_w; ẋ_w) = J (V_w; q̇)`.
    ///
    /// `jacobian` is row-major, 6 x dof: three angular rows, then the rows of [`Kinematics::point_jacobian_into`].
    ///
    /// # Errors
    /// As [`Kinematics::point_jacobian_into`].
    pub fn frame_jacobian_into(
        &self,
        tree: &KinematicTree,
        body: usize,
        point: &Vector3<f64>,
        jacobian: &mut [f64],
    ) -> Result<(), ModelError> {
        self.check_tree(tree)?;
        check_body(tree, body)?;
        let dof = tree.dof();
        check_length("jacobian", jacobian.len(), 6 * dof)?;
        jacobian.fill(0.0);
        let (angular, linear) = jacobian.split_at_mut(3 * dof);
        for &column in tree.branch(body) {
            let column = column as usize;
            let twist = self.column_twist_w(tree, column);
            for row in 0..3 {
                angular[row * dof + column] = twist.angular[row];
            }
        }
        self.add_linear_rows(tree, body, &self.point_w(body, point), 1.0, linear);
        Ok(())
    }

    /// Mass centre of the whole tree in {0}, m; mass welded to the ground counts.
    pub fn mass_centre_of_tree_w(&self, tree: &KinematicTree) -> Vector3<f64> {
        let mut first_moment = tree.ground_inertia_w().first_moment;
        for (body, position) in tree.bodies().iter().zip(&self.mass_centre_w) {
            first_moment += position * body.inertia.mass;
        }
        first_moment / tree.total_mass()
    }

    /// Velocity of the mass centre of the whole tree in {0}, m/s.
    pub fn mass_centre_velocity_w(&self, tree: &KinematicTree) -> Vector3<f64> {
        let mut momentum = Vector3::zeros();
        for (i, body) in tree.bodies().iter().enumerate() {
            let velocity = &self.velocity_w[i];
            let of_mass_centre = velocity.linear + velocity.angular.cross(&self.mass_centre_w[i]);
            momentum += of_mass_centre * body.inertia.mass;
        }
        momentum / tree.total_mass()
    }

    /// Jacobian of the mass centre of the whole tree: `ċ_w = J (V_w; q̇)`, row-major 3 x dof.
    ///
    /// Cost: O(Σ depth), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a wrong slice.
    pub fn mass_centre_jacobian_into(
        &self,
        tree: &KinematicTree,
        jacobian: &mut [f64],
    ) -> Result<(), ModelError> {
        self.check_tree(tree)?;
        check_length("jacobian", jacobian.len(), 3 * tree.dof())?;
        jacobian.fill(0.0);
        let total = tree.total_mass();
        for (i, body) in tree.bodies().iter().enumerate() {
            self.add_linear_rows(tree, i, &self.mass_centre_w[i], body.inertia.mass / total, jacobian);
        }
        Ok(())
    }

    /// Spatial twist of everything beyond coordinate `column`, per unit of its rate.
    pub(crate) fn column_twist_w(&self, tree: &KinematicTree, column: usize) -> Twist {
        let base_dof = tree.base_dof();
        if column >= base_dof {
            return self.joint_twist_w[column - base_dof + tree.first_joint_body()];
        }
        let mut twist = Twist::default();
        if column < 3 {
            twist.angular[column] = 1.0;
        } else {
            twist.linear[column - 3] = 1.0;
        }
        twist
    }

    fn add_linear_rows(
        &self,
        tree: &KinematicTree,
        body: usize,
        point_w: &Vector3<f64>,
        factor: f64,
        rows: &mut [f64],
    ) {
        let dof = tree.dof();
        for &column in tree.branch(body) {
            let column = column as usize;
            let twist = self.column_twist_w(tree, column);
            let linear = twist.linear + twist.angular.cross(point_w);
            for row in 0..3 {
                rows[row * dof + column] += factor * linear[row];
            }
        }
    }

    pub(crate) fn check_tree(&self, tree: &KinematicTree) -> Result<(), ModelError> {
        check_length("kinematics workspace", self.link_pose_w.len(), tree.body_count())
    }
}

pub(crate) fn check_length(quantity: &'static str, got: usize, expected: usize) -> Result<(), ModelError> {
    if got == expected { Ok(()) } else { Err(ModelError::Length { quantity, got, expected }) }
}

pub(crate) fn check_body(tree: &KinematicTree, body: usize) -> Result<(), ModelError> {
    if body < tree.body_count() {
        Ok(())
    } else {
        Err(ModelError::Unsupported { body, reason: "the tree has no body with this index" })
    }
}
