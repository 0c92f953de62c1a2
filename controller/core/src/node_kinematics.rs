//! Kinematics, mass centre and total momentum at one node of the horizon, with their derivatives.
//!
//! ```text
//! P = Σ M_i v_i        ∂P/∂q̇_j = 𝓜_j S_j        ∂P/∂q_j = 𝓜_j Ṡ_j - ad^D_{μ_j} S_j        Ṡ_j = ad_{v_j} S_j
//! ```
//!
//! with the composite inertia `𝓜_j` and momentum `μ_j` of everything beyond joint j, all about the origin of {0}. The second one is
//! the change of a body's momentum `M v` when the body is displaced by the twist `η` and its velocity changes by `ν` on the moved body,
//! `δ(M v) = M ν - ad^D_{M v} η`, summed over the subtree with `η = S_j`, `ν = Ṡ_j`. Mass centre: `m ċ` is the linear part of `P`, so `∂c/∂q = ∂ċ/∂q̇` is that of `𝓜_j S_j / m`.
//!
//! A node is evaluated by itself ([`NodeKinematics::update`]) or taken from a stage-parallel linearisation, which has all of this at
//! hand ([`NodeKinematics::take_all`]).
//!
//! Cost: O(n), no allocation after [`NodeKinematics::new`]. Fixed base.
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 2.13 for composite momenta; own derivation.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::spatial::{Momentum, RigidTransform, SpatialInertia, Twist};
use delmpc_mechanics::stage_batch::{StageBatch, StartKinematics};
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;

/// Everything tasks and contact wrench need to know of one node.
#[derive(Clone, Debug)]
pub struct NodeKinematics {
    kinematics: Kinematics,
    /// Together per body, as they are written and read.
    bodies: Vec<StartKinematics>,
    composite: Vec<SpatialInertia>,
    subtree_momentum: Vec<Momentum>,
    momentum: Momentum,
    com: Vector3<f64>,
    per_mass: f64,
}

impl NodeKinematics {
    /// Room for a tree with a fixed base.
    pub fn new(tree: &KinematicTree) -> Self {
        let n = tree.body_count();
        Self {
            kinematics: Kinematics::new(tree),
            bodies: vec![StartKinematics::default(); n],
            composite: vec![SpatialInertia::default(); n],
            subtree_momentum: vec![Momentum::default(); n],
            momentum: Momentum::default(),
            com: Vector3::zeros(),
            per_mass: 1.0 / tree.total_mass(),
        }
    }

    /// Evaluates at `(q, q̇)`.
    ///
    /// # Errors
    /// [`ModelError::Length`] when a slice does not fit the tree.
    pub fn update(&mut self, tree: &KinematicTree, q: &[f64], q_dot: &[f64]) -> Result<(), ModelError> {
        self.kinematics.update(tree, &Configuration::fixed(q), &Velocity::fixed(q_dot))?;
        for i in 0..tree.body_count() {
            let inertia = self.kinematics.inertia_w(tree, i);
            self.subtree_momentum[i] = inertia.mul_twist(&self.kinematics.velocities_w()[i]);
            self.composite[i] = inertia;
        }
        self.momentum = Momentum::default();
        for i in (0..tree.body_count()).rev() {
            let (inertia, momentum) = (self.composite[i], self.subtree_momentum[i]);
            match tree.bodies()[i].parent {
                Some(parent) => {
                    self.composite[parent] += inertia;
                    self.subtree_momentum[parent] += momentum;
                }
                None => self.momentum += momentum,
            }
            let twist = self.kinematics.joint_twists_w()[i];
            let twist_rate = self.kinematics.velocities_w()[i].bracket(&twist);
            self.bodies[i] = StartKinematics {
                link_pose_w: self.kinematics.link_poses_w()[i],
                joint_twist_w: twist,
                velocity_w: self.kinematics.velocities_w()[i],
                d_momentum_d_rate: inertia.mul_twist(&twist),
                d_momentum_d_q: inertia.mul_twist(&twist_rate) - momentum.dual_bracket(&twist),
            };
        }
        self.com = self.kinematics.mass_centre_of_tree_w(tree);
        Ok(())
    }

    /// Takes over the start nodes of all linearised stages, and the node behind the last one.
    ///
    /// Body by body for all stages that lie together in memory: so each cache line is read once.
    pub fn take_all(nodes: &mut [Self], batch: &StageBatch) {
        let together = batch.stages_in_vector();
        for (vector, nodes) in nodes.chunks_mut(together).enumerate() {
            let first = vector * together;
            for body in 0..batch.dof() {
                batch.visit_start(first, body, |lane, start| {
                    if let Some(node) = nodes.get_mut(lane) {
                        node.bodies[body] = *start;
                    }
                });
            }
            for (lane, node) in nodes.iter_mut().enumerate() {
                node.momentum = batch.momentum_w(first + lane);
                node.com = batch.com_w(first + lane);
            }
        }
    }

    /// Kinematics of the last [`NodeKinematics::update`].
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Pose of a body's link frame in {0}.
    pub fn link_pose_w(&self, body: usize) -> &RigidTransform {
        &self.bodies[body].link_pose_w
    }

    /// Joint twist `S_j` in {0}.
    pub fn joint_twist_w(&self, joint: usize) -> &Twist {
        &self.bodies[joint].joint_twist_w
    }

    /// Total momentum about the origin of {0}.
    pub fn momentum(&self) -> Momentum {
        self.momentum
    }

    /// `∂P/∂q̇_j`.
    pub fn d_momentum_d_rate(&self, joint: usize) -> Momentum {
        self.bodies[joint].d_momentum_d_rate
    }

    /// `∂P/∂q_j`.
    pub fn d_momentum_d_q(&self, joint: usize) -> Momentum {
        self.bodies[joint].d_momentum_d_q
    }

    /// Mass centre, mass welded to the ground included, m.
    pub fn com(&self) -> Vector3<f64> {
        self.com
    }

    /// Velocity of the mass centre, m/s.
    pub fn com_velocity(&self) -> Vector3<f64> {
        self.momentum.force * self.per_mass
    }

    /// `∂c/∂q_j`.
    pub fn d_com_d_q(&self, joint: usize) -> Vector3<f64> {
        self.bodies[joint].d_momentum_d_rate.force * self.per_mass
    }

    /// `∂ċ/∂q_j`.
    pub fn d_com_velocity_d_q(&self, joint: usize) -> Vector3<f64> {
        self.bodies[joint].d_momentum_d_q.force * self.per_mass
    }

    /// Position in {0} and velocity of a point of a body (link frame).
    pub fn point(&self, body: usize, point: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let (pose, twist) = (&self.bodies[body].link_pose_w, &self.bodies[body].velocity_w);
        let position = pose.rotation * point + pose.translation;
        (position, twist.linear + twist.angular.cross(&position))
    }

    /// Derivatives of a point's position and velocity by `q_j`, for `j` on the branch of the point's body. The derivative of the
    /// velocity by `q̇_j` is that of the position by `q_j`.
    ///
    /// The body's twist varies by `δv = ad_{v_j - v} S_j` ((I2) with `η = S_j`, `ν = Ṡ_j`).
    pub fn d_point_d_q(
        &self,
        body: usize,
        point_w: &Vector3<f64>,
        joint: usize,
    ) -> (Vector3<f64>, Vector3<f64>) {
        let twist = self.bodies[joint].joint_twist_w;
        let velocity = self.bodies[body].velocity_w;
        let moved = twist.linear + twist.angular.cross(point_w);
        let relative: Twist = self.bodies[joint].velocity_w - velocity;
        let change = relative.bracket(&twist);
        let rate = change.linear + change.angular.cross(point_w) + velocity.angular.cross(&moved);
        (moved, rate)
    }
}
