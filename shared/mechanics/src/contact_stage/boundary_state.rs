//! State of a floating robot at a stage boundary, as a controller has it: on the manifold, with velocities.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3, Vector6};

use crate::spatial::{RigidTransform, Twist, exp_rotation, log_rotation};
use crate::tree::KinematicTree;

/// State `(R, p, q, V_body, q̇)` of a floating robot.
///
/// Its local coordinates are `x = (ε 6, δq, δV_body 6, δq̇)`, `2 nv` numbers with `nv = 6 + joints`: `R exp(ε_ω^)`, `p + R ε_v`, the rest
/// by addition.
#[derive(Clone, Debug, PartialEq)]
pub struct BoundaryState {
    /// Orientation `R` of the base: link axes in {0}.
    pub orientation: Matrix3<f64>,
    /// Mass centre `p` of the base in {0}, m.
    pub position_w: Vector3<f64>,
    /// Joint coordinates, rad or m.
    pub q: Vec<f64>,
    /// `V_body`: angular velocity, and velocity of the base's mass centre, in base axes.
    pub base_velocity_b: Vector6<f64>,
    /// Joint rates.
    pub rate: Vec<f64>,
}

impl BoundaryState {
    /// The base at the origin, all coordinates and velocities zero.
    pub fn zeros(tree: &KinematicTree) -> Self {
        Self {
            orientation: Matrix3::identity(),
            position_w: Vector3::zeros(),
            q: vec![0.0; tree.joint_count()],
            base_velocity_b: Vector6::zeros(),
            rate: vec![0.0; tree.joint_count()],
        }
    }

    /// Copies another state of the same tree without allocating.
    pub fn copy_from(&mut self, other: &Self) {
        self.orientation = other.orientation;
        self.position_w = other.position_w;
        self.q.copy_from_slice(&other.q);
        self.base_velocity_b = other.base_velocity_b;
        self.rate.copy_from_slice(&other.rate);
    }

    /// Number of local coordinates, `2 nv`.
    pub fn coordinates(&self) -> usize {
        12 + 2 * self.q.len()
    }

    /// Pose of the base: link axes, origin at the mass centre.
    pub fn base_pose_w(&self) -> RigidTransform {
        RigidTransform { rotation: self.orientation, translation: self.position_w }
    }

    /// Spatial twist of the base in {0}.
    pub fn base_twist_w(&self) -> Twist {
        self.base_pose_w().transform_twist(&Twist::from_vector(&self.base_velocity_b))
    }

    /// Moves the state by local coordinates `x` (those beyond its length count as zero).
    pub fn retract(&mut self, x: &[f64]) {
        let joints = self.q.len();
        let at = |k: usize| x.get(k).copied().unwrap_or(0.0);
        let vector = |k: usize| Vector3::new(at(k), at(k + 1), at(k + 2));
        self.position_w += self.orientation * vector(3);
        let turned = self.orientation * exp_rotation(&vector(0));
        // One Newton step towards the nearest rotation: no drift over many moves.
        self.orientation = turned * (Matrix3::identity() * 3.0 - turned.tr_mul(&turned)) * 0.5;
        for (k, (q, rate)) in self.q.iter_mut().zip(&mut self.rate).enumerate() {
            *q += at(6 + k);
            *rate += at(12 + joints + k);
        }
        for k in 0..6 {
            self.base_velocity_b[k] += at(6 + joints + k);
        }
    }

    /// Local coordinates of `other` at this state: `self.retract(x)` gives `other`. Fills what `x` has room for.
    pub fn local(&self, other: &Self, x: &mut [f64]) {
        let turn = log_rotation(&self.orientation.tr_mul(&other.orientation));
        let travel = self.orientation.tr_mul(&(other.position_w - self.position_w));
        let spin = other.base_velocity_b - self.base_velocity_b;
        let base = turn.iter().chain(&travel).copied();
        let joints = self.q.iter().zip(&other.q).map(|(a, b)| b - a);
        let rates = self.rate.iter().zip(&other.rate).map(|(a, b)| b - a);
        let all = base.chain(joints).chain(spin.iter().copied()).chain(rates);
        for (value, target) in all.zip(x) {
            *target = value;
        }
    }
}
