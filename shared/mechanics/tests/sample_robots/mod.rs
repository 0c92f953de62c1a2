//! Small robots with round numbers for the tests of orders, invariants and memory, and the states they start from.
#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(clippy::unwrap_used, reason = "test helper: a model that does not build is a failed test")]

use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::exp_rotation;
use delmpc_mechanics::step::NewtonVariant;

pub const GRAVITY: [f64; 3] = [0.0, 0.0, -9.81];
pub const WEIGHTLESS: [f64; 3] = [0.0, 0.0, 0.0];

fn at(x: f64, y: f64, z: f64) -> RigidTransform {
    RigidTransform::from_translation(Vector3::new(x, y, z))
}

/// A rod of 1 kg from its joint to `tip`.
fn rod(tip: Vector3<f64>) -> LinkInertia {
    let thickness = Matrix3::identity() * 2e-3;
    let slender = (Matrix3::identity() * tip.norm_squared() - tip * tip.transpose()) / 12.0;
    LinkInertia::new(1.0, tip * 0.5, slender + thickness)
}

/// Which forces besides gravity a sample robot feels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Forces {
    None,
    Springs,
    /// Springs, joint damping, body drag and a constant body wrench.
    All,
}

impl Forces {
    fn joint(self, joint: Joint, index: usize) -> Joint {
        let index = index as f64;
        match self {
            Self::None => joint,
            Self::Springs => joint.with_spring(8.0, 0.1 * index),
            Self::All => joint.with_spring(4.0 + index, 0.1 * index).with_damping(0.2 + 0.1 * index),
        }
    }

    fn body(self, mut body: Body, index: usize) -> Body {
        body.joint = self.joint(body.joint, index);
        if self == Self::All {
            (body.drag, body.constant_wrench_b) = wrenches();
        }
        body
    }
}

fn wrenches() -> (Vector6<f64>, Wrench) {
    let drag = Vector6::new(0.05, 0.02, 0.04, 0.3, 0.2, 0.4);
    (drag, Wrench::new(Vector3::new(0.1, -0.2, 0.15), Vector3::new(0.5, 0.3, -0.4)))
}

/// Three links of 0.5 m that turn about y, a tilted axis and x.
pub fn spatial_chain(gravity: [f64; 3], forces: Forces) -> KinematicTree {
    let tip = Vector3::new(0.1, 0.05, -0.5);
    let axes = [Vector3::y(), Vector3::new(0.6, 0.0, 0.8), Vector3::x()];
    let mut builder = TreeBuilder::fixed_base(Vector3::from(gravity));
    let mut parent = None;
    for (index, axis) in axes.into_iter().enumerate() {
        let placement =
            parent.map_or_else(RigidTransform::identity, |_| RigidTransform::from_translation(tip));
        let body = Body::new(parent, Joint::revolute(axis, placement), rod(tip));
        parent = Some(builder.add(forces.body(body, index)));
    }
    builder.build().unwrap()
}

/// A planar pendulum of rods.
pub fn pendulum(links: usize, length: f64) -> KinematicTree {
    let tip = Vector3::new(0.0, 0.0, -length);
    let mut builder = TreeBuilder::fixed_base(Vector3::from(GRAVITY));
    let mut parent = None;
    for _ in 0..links {
        let placement =
            parent.map_or_else(RigidTransform::identity, |_| RigidTransform::from_translation(tip));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(Vector3::y(), placement), rod(tip))));
    }
    builder.build().unwrap()
}

fn brick_inertia() -> LinkInertia {
    let moments = Matrix3::from_diagonal(&Vector3::new(0.05, 0.08, 0.1));
    let turn = exp_rotation(&Vector3::new(0.3, -0.2, 0.4));
    LinkInertia::new(3.0, Vector3::new(0.05, -0.03, 0.02), turn * moments * turn.transpose())
}

fn floating(gravity: [f64; 3], forces: Forces) -> TreeBuilder {
    let mut builder = TreeBuilder::floating_base(Vector3::from(gravity), brick_inertia());
    if forces == Forces::All {
        let (drag, wrench) = wrenches();
        builder.set_base_wrenches(drag, wrench);
    }
    builder
}

/// One floating body.
pub fn brick(gravity: [f64; 3], forces: Forces) -> KinematicTree {
    floating(gravity, forces).build().unwrap()
}

/// A floating base with two arms of two joints; the second joint of the second arm slides.
pub fn arms(gravity: [f64; 3], forces: Forces) -> KinematicTree {
    let mut builder = floating(gravity, forces);
    let tip = Vector3::new(0.0, 0.05, -0.3);
    let first = Joint::revolute(Vector3::y(), at(0.2, 0.1, 0.0));
    let second = Joint::revolute(Vector3::new(0.0, 0.6, 0.8), at(-0.2, -0.1, 0.05));
    let a = builder.add(forces.body(Body::new(Some(0), first, rod(tip)), 0));
    let b = builder.add(forces.body(Body::new(Some(0), second, rod(tip)), 1));
    let elbow = Joint::revolute(Vector3::x(), RigidTransform::from_translation(tip));
    let slide = Joint::prismatic(Vector3::new(0.0, 0.0, -1.0), at(0.0, 0.0, -0.1));
    builder.add(forces.body(Body::new(Some(a), elbow, rod(tip)), 2));
    builder.add(forces.body(Body::new(Some(b), slide, rod(tip)), 3));
    builder.build().unwrap()
}

/// A floating trunk with four legs of three joints.
pub fn quadruped(gravity: [f64; 3], forces: Forces) -> KinematicTree {
    let mut builder = floating(gravity, forces);
    let tip = Vector3::new(0.0, 0.0, -0.25);
    let mut hips = [0; 4];
    for (leg, hip) in hips.iter_mut().enumerate() {
        let x = if leg < 2 { 0.3 } else { -0.3 };
        let y = if leg % 2 == 0 { 0.15 } else { -0.15 };
        let joint = Joint::revolute(Vector3::x(), at(x, y, 0.0));
        *hip = builder.add(forces.body(Body::new(Some(0), joint, rod(Vector3::new(0.0, 0.2 * y, -0.1))), 0));
    }
    // Hips, then thighs, then shanks: not depth-first.
    let thighs = hips.map(|hip| {
        let joint = Joint::revolute(Vector3::y(), at(0.0, 0.0, -0.1));
        builder.add(forces.body(Body::new(Some(hip), joint, rod(tip)), 1))
    });
    for thigh in thighs {
        let joint = Joint::revolute(Vector3::y(), RigidTransform::from_translation(tip));
        builder.add(forces.body(Body::new(Some(thigh), joint, rod(tip)), 2));
    }
    builder.build().unwrap()
}

/// Numbers of a size, the same on every run.
pub fn spread(count: usize, size: f64) -> Vec<f64> {
    (0..count).map(|k| size * ((k as f64 + 1.0) * 12.9898).sin()).collect()
}

/// A generic state: base turned and displaced, turning at `spin` rad/s and drifting, joints bent and moving at up to `rate`.
pub fn moving_state(tree: &KinematicTree, spin: f64, rate: f64) -> State {
    let mut state = State::zeros(tree);
    state.q = spread(tree.joint_count(), 0.5);
    let mut velocity = Vec::new();
    if tree.is_floating() {
        state.base_pose = RigidTransform {
            rotation: exp_rotation(&Vector3::new(0.4, -0.3, 0.8)),
            translation: Vector3::new(0.3, -0.2, 0.5),
        };
        let omega = Vector3::new(0.48, 0.6, 0.64) * spin;
        let linear = Vector3::new(0.4, 0.3, -0.2) - omega.cross(&state.base_pose.translation);
        velocity.extend_from_slice(Twist::new(omega, linear).to_vector().as_slice());
    }
    velocity.extend(spread(tree.joint_count(), rate));
    let mut velocities = delmpc_mechanics::velocity::VelocityWorkspace::new(tree);
    velocities.set_velocity(tree, &mut state, &velocity).unwrap();
    state
}

/// The integrator of `s` unknown nodes with the default options.
pub fn integrator(tree: &KinematicTree, s: usize, time_step: f64) -> Integrator {
    Integrator::new(tree, &LobattoRule::new(s).unwrap(), time_step, StepOptions::default()).unwrap()
}

/// The same with the Newton matrix renewed in every iteration: solves to round-off instead of to the stopping rule.
pub fn exact_integrator(tree: &KinematicTree, s: usize, time_step: f64) -> Integrator {
    let options = StepOptions { variant: NewtonVariant::Exact, ..StepOptions::default() };
    Integrator::new(tree, &LobattoRule::new(s).unwrap(), time_step, options).unwrap()
}

/// Largest absolute difference of two vectors.
pub fn difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).fold(0.0, |worst, (a, b)| f64::max(worst, (a - b).abs()))
}
