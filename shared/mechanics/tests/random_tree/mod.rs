//! Random trees and states from one seed, for the property tests of the rigid-body algorithms.
#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(clippy::unwrap_used, reason = "test helper: a model that does not build is a failed test")]

use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::spatial::{RigidTransform, Twist, exp_rotation};
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::{Matrix3, Vector3};

/// SplitMix64 (G. Steele, D. Lea, C. Flood, 2014).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `[low, high)`.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in `0..count`.
    pub fn below(&mut self, count: usize) -> usize {
        (self.next() % count as u64) as usize
    }

    pub fn vector(&mut self, size: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.range(-size, size))
    }

    pub fn pose(&mut self) -> RigidTransform {
        RigidTransform { rotation: exp_rotation(&self.vector(2.0)), translation: self.vector(0.5) }
    }

    pub fn twist(&mut self, size: f64) -> Twist {
        Twist::new(self.vector(size), self.vector(size))
    }

    pub fn values(&mut self, count: usize, size: f64) -> Vec<f64> {
        (0..count).map(|_| self.range(-size, size)).collect()
    }

    /// Of 1 to 4 kg, with the inertia of four point masses and a little more.
    pub fn inertia(&mut self) -> LinkInertia {
        let mut inertia = Matrix3::identity() * 1e-3;
        for _ in 0..4 {
            let r = self.vector(0.3);
            inertia += Matrix3::identity() * r.norm_squared() - r * r.transpose();
        }
        LinkInertia::new(self.range(1.0, 4.0), self.vector(0.3), inertia)
    }

    /// A joint of either kind, anywhere, with damping and a spring.
    pub fn joint(&mut self) -> Joint {
        let axis = exp_rotation(&self.vector(2.0)) * Vector3::z();
        let placement = self.pose();
        let joint = if self.below(3) == 0 {
            Joint::prismatic(axis, placement)
        } else {
            Joint::revolute(axis, placement)
        };
        joint.with_damping(self.range(0.0, 1.0)).with_spring(self.range(0.0, 5.0), self.range(-1.0, 1.0))
    }

    /// A tree with `joints` joints, bodies in random (parent-first) order, some of them without mass.
    pub fn tree(&mut self, joints: usize, floating: bool) -> KinematicTree {
        let gravity_w = self.vector(10.0);
        let mut builder = if floating {
            let base = self.inertia();
            TreeBuilder::floating_base(gravity_w, base)
        } else {
            TreeBuilder::fixed_base(gravity_w)
        };
        let first = usize::from(floating);
        let parents: Vec<Option<usize>> = (first..first + joints)
            .map(|body| match body {
                0 => None,
                _ if !floating && self.below(8) == 0 => None,
                _ => Some(self.below(body)),
            })
            .collect();
        let mut massless = vec![false; first + joints];
        for (place, &parent) in parents.iter().enumerate() {
            // At most two joints between masses: four slides in a row, say, would make the mass matrix singular.
            let has_child = parents.contains(&Some(first + place));
            let between_masses = has_child && !parent.is_some_and(|parent| massless[parent]);
            massless[first + place] = between_masses && self.below(5) == 0;
            let inertia = if massless[first + place] { LinkInertia::massless() } else { self.inertia() };
            let mut body = Body::new(parent, self.joint(), inertia);
            body.drag.fill(self.range(0.0, 1.0));
            builder.add(body);
        }
        builder.build().unwrap()
    }
}

/// A state, with slices that live as long as it.
#[derive(Clone, Debug)]
pub struct State {
    pub base_pose_w: RigidTransform,
    pub base_twist_w: Twist,
    pub q: Vec<f64>,
    pub q_dot: Vec<f64>,
}

impl State {
    pub fn random(random: &mut Random, tree: &KinematicTree) -> Self {
        let joints = tree.joint_count();
        Self {
            base_pose_w: random.pose(),
            base_twist_w: random.twist(2.0),
            q: random.values(joints, 1.5),
            q_dot: random.values(joints, 2.0),
        }
    }

    pub fn kinematics(&self, tree: &KinematicTree) -> Kinematics {
        let mut kinematics = Kinematics::new(tree);
        kinematics.update(tree, &self.configuration(), &self.velocity()).unwrap();
        kinematics
    }

    pub fn configuration(&self) -> Configuration<'_> {
        Configuration::floating(self.base_pose_w, &self.q)
    }

    pub fn velocity(&self) -> Velocity<'_> {
        Velocity::floating(self.base_twist_w, &self.q_dot)
    }

    /// `(V_w; q̇)`, or `q̇` for a fixed base.
    pub fn generalised_velocity(&self, tree: &KinematicTree) -> Vec<f64> {
        let mut all = Vec::new();
        if tree.is_floating() {
            all.extend_from_slice(self.base_twist_w.to_vector().as_slice());
        }
        all.extend_from_slice(&self.q_dot);
        all
    }

    /// The state a time `t` later at constant generalised velocity.
    pub fn after(&self, t: f64) -> Self {
        let rotation = exp_rotation(&(self.base_twist_w.angular * t));
        // A constant spatial twist moves everything by its exponential; to second order in t here.
        let linear = self.base_twist_w.linear * t
            + self.base_twist_w.angular.cross(&self.base_twist_w.linear) * (0.5 * t * t);
        let motion = RigidTransform { rotation, translation: linear };
        let q = self.q.iter().zip(&self.q_dot).map(|(q, v)| q + v * t).collect();
        Self { base_pose_w: motion * self.base_pose_w, q, ..self.clone() }
    }
}

pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Row-major matrix times vector.
pub fn multiply(matrix: &[f64], vector: &[f64]) -> Vec<f64> {
    matrix.chunks_exact(vector.len()).map(|row| dot(row, vector)).collect()
}

/// Largest absolute difference.
pub fn difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |worst, (a, b)| f64::max(worst, (a - b).abs()))
}

/// Largest absolute entry.
pub fn size(a: &[f64]) -> f64 {
    a.iter().fold(0.0, |worst, a| f64::max(worst, a.abs()))
}
