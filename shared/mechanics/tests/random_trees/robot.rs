//! A random tree in a random state, with everything that acts on it.

use std::cell::Cell;

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::forces::{BodySample, WrenchSample};
use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::skew;
use delmpc_mechanics::step::NewtonVariant;
use delmpc_mechanics::velocity::VelocityWorkspace;
use nalgebra::Matrix6;
use proptest::prelude::*;
use proptest::test_runner::{RngSeed, TestCaseError, TestRunner};

use crate::random_tree::{self, Random, size};

const JOINTS: std::ops::RangeInclusive<usize> = 1..=60;

#[derive(Clone, Copy)]
struct Traits(u8);

impl Traits {
    fn has(self, bit: u8) -> bool {
        self.0 >> bit & 1 == 1
    }
    const DAMPING: u8 = 0;
    const SPRINGS: u8 = 1;
    const DRAG: u8 = 2;
    const WRENCHES: u8 = 3;
    const MASSLESS: u8 = 4;
    const DEEP: u8 = 5;
    const OUTER_FORCES: u8 = 6;
    const PER_NODE: u8 = 7;
}

/// A spring and damper from the point of a body at the world's anchor when the law was made, to that anchor:
/// `f = -k (x - x0) - c ẋ` at the body point `x`.
///
/// With `δx = η_v + η_ω × x` and `δẋ = ν_v + ν_ω × x + η_ω × ẋ` the co-moving variation is `D F = [x × φ; φ]` with
/// `φ = -k (η_v + η_ω × x0) - c (ν_v + ν_ω × x)`.
pub struct Anchor {
    body: usize,
    point_b: Vector3<f64>,
    anchor_w: Vector3<f64>,
    stiffness: f64,
    damping: f64,
}

impl WrenchLaw for Anchor {
    fn body(&self) -> usize {
        self.body
    }
    fn evaluate(&self, sample: &BodySample) -> WrenchSample {
        let x = sample.pose_w.transform_point(&self.point_b);
        let rate = sample.velocity_w.linear + sample.velocity_w.angular.cross(&x);
        let force = (x - self.anchor_w) * -self.stiffness - rate * self.damping;
        let at_point = |angular: Matrix3<f64>, linear: f64| {
            let mut gain = Matrix6::zeros();
            gain.fixed_view_mut::<3, 3>(3, 0).copy_from(&angular);
            gain.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * linear));
            let moments = skew(&x) * gain.fixed_view::<3, 6>(3, 0);
            gain.fixed_view_mut::<3, 6>(0, 0).copy_from(&moments);
            gain
        };
        WrenchSample {
            wrench_w: Wrench::new(x.cross(&force), force),
            d_pose: at_point(skew(&self.anchor_w) * self.stiffness, -self.stiffness),
            d_velocity: at_point(skew(&x) * self.damping, -self.damping),
        }
    }
}

/// A random tree with a state and everything that acts on it.
pub struct Robot {
    pub tree: KinematicTree,
    pub state: State,
    pub torques: Vec<f64>,
    pub hold: InputHold,
    pub points: Vec<PointForce>,
    pub anchors: Vec<Anchor>,
    pub s: usize,
    pub random: Random,
}

impl Robot {
    pub fn new(seed: u64, joints: usize, floating: bool, s: usize, traits: u8) -> Self {
        let mut random = Random::new(seed);
        let traits = Traits(traits);
        let tree = random_robot(&mut random, joints, floating, traits);
        let mut state = State::zeros(&tree);
        state.base_pose = if floating { random.pose() } else { RigidTransform::identity() };
        state.q = random.values(joints, 1.5);
        let mut velocity = random.values(tree.dof(), 0.5);
        if floating {
            // The base turns about its own place.
            let omega = Vector3::from_column_slice(&velocity[..3]);
            let own = Vector3::from_column_slice(&velocity[3..6]) - omega.cross(&state.base_pose.translation);
            velocity[3..6].copy_from_slice(own.as_slice());
        }
        VelocityWorkspace::new(&tree).set_velocity(&tree, &mut state, &velocity).unwrap();
        let hold = if traits.has(Traits::PER_NODE) { InputHold::PerNode } else { InputHold::Held };
        let sets = if hold == InputHold::PerNode { s + 1 } else { 1 };
        let torques = random.values(joints * sets, 1.0);
        let (mut points, mut anchors) = (Vec::new(), Vec::new());
        if traits.has(Traits::OUTER_FORCES) {
            for _ in 0..2 {
                let body = random.below(tree.body_count());
                points.push(PointForce { body, point_b: random.vector(0.3), force_w: random.vector(3.0) });
                let body = random.below(tree.body_count());
                let (point_b, anchor_w) = (random.vector(0.3), random.vector(2.0));
                let (stiffness, damping) = (random.range(1.0, 20.0), random.range(0.0, 1.0));
                anchors.push(Anchor { body, point_b, anchor_w, stiffness, damping });
            }
        }
        Self { tree, state, torques, hold, points, anchors, s, random }
    }

    pub fn laws(&self) -> Vec<&dyn WrenchLaw> {
        self.anchors.iter().map(|a| a as &dyn WrenchLaw).collect()
    }

    pub fn forces<'a>(&'a self, torques: &'a [f64], laws: &'a [&'a dyn WrenchLaw]) -> StepForces<'a> {
        let joints = match self.hold {
            InputHold::Held => StepForces::held(torques),
            InputHold::PerNode => StepForces::per_node(torques),
        };
        joints.with_points(&self.points).with_laws(laws)
    }

    pub fn capacity(&self) -> ForceCapacity {
        ForceCapacity { points: self.points.len(), laws: !self.anchors.is_empty() }
    }

    /// Algorithm 1 at nodes that solve nothing.
    pub fn unsolved(&mut self) -> DelWorkspace {
        let rule = LobattoRule::new(self.s).unwrap();
        let mut del = DelWorkspace::new(&self.tree, &rule, 0.02, self.capacity()).unwrap();
        let laws = self.laws();
        del.begin(&self.tree, &self.state, &self.forces(&self.torques, &laws)).unwrap();
        drop(laws);
        for alpha in 1..=self.s {
            for dof in 0..self.tree.dof() {
                let value = del.node(0, dof) + self.random.range(-0.05, 0.05);
                del.set_node(alpha, dof, value);
            }
        }
        del.evaluate(&self.tree, &self.laws());
        del
    }

    /// An integrator whose last solved step starts at the state.
    pub fn solved(&self, method: NewtonMethod, variant: NewtonVariant) -> Integrator {
        let mut integrator = self.integrator(method, variant);
        let laws = self.laws();
        integrator.solve(&self.tree, &self.state, &self.forces(&self.torques, &laws)).unwrap();
        integrator
    }

    pub fn integrator(&self, method: NewtonMethod, variant: NewtonVariant) -> Integrator {
        let forces = self.capacity();
        let options = StepOptions { method: Some(method), variant, forces, ..StepOptions::default() };
        Integrator::new(&self.tree, &LobattoRule::new(self.s).unwrap(), 0.002, options).unwrap()
    }
}

fn random_robot(random: &mut Random, joints: usize, floating: bool, traits: Traits) -> KinematicTree {
    let gravity = random.vector(10.0);
    let mut builder = if floating {
        TreeBuilder::floating_base(gravity, random.inertia())
    } else {
        TreeBuilder::fixed_base(gravity)
    };
    let drag = |random: &mut Random| Vector6::from_fn(|_, _| random.range(0.0, 0.5));
    let wrench = |random: &mut Random| Wrench::new(random.vector(0.5), random.vector(0.5));
    if floating {
        let base_drag = if traits.has(Traits::DRAG) { drag(random) } else { Vector6::zeros() };
        let base_wrench = if traits.has(Traits::WRENCHES) { wrench(random) } else { Wrench::default() };
        builder.set_base_wrenches(base_drag, base_wrench);
    }
    let first = usize::from(floating);
    let parents: Vec<Option<usize>> = (first..first + joints)
        .map(|body| match body {
            0 => None,
            _ if !floating && random.below(10) == 0 => None,
            _ if traits.has(Traits::DEEP) => Some(body - 1 - random.below(body.min(3))),
            _ => Some(random.below(body)),
        })
        .collect();
    let mut massless = vec![false; first + joints];
    for (place, &parent) in parents.iter().enumerate() {
        let body = first + place;
        let between = parents.contains(&Some(body)) && !parent.is_some_and(|parent| massless[parent]);
        massless[body] = traits.has(Traits::MASSLESS) && between && random.below(4) == 0;
        let mut joint = Joint { damping: 0.0, stiffness: 0.0, rest: 0.0, ..random.joint() };
        if traits.has(Traits::DAMPING) {
            joint = joint.with_damping(random.range(0.0, 1.0));
        }
        if traits.has(Traits::SPRINGS) {
            joint = joint.with_spring(random.range(0.0, 20.0), random.range(-1.0, 1.0));
        }
        let inertia = if massless[body] { LinkInertia::massless() } else { random.inertia() };
        let mut spec = Body::new(parent, joint, inertia);
        if traits.has(Traits::DRAG) && random.below(2) == 0 {
            spec.drag = drag(random);
        }
        if traits.has(Traits::WRENCHES) && random.below(2) == 0 {
            spec.constant_wrench_b = wrench(random);
        }
        builder.add(spec);
    }
    builder.build().unwrap()
}

/// Runs a property over random robots and reports the largest figure it returned.
pub fn on_random_robots(what: &str, cases: u32, property: impl Fn(Robot) -> Result<f64, TestCaseError>) {
    let rng_seed = RngSeed::Fixed(20_240_607);
    let config = ProptestConfig { cases, failure_persistence: None, rng_seed, ..ProptestConfig::default() };
    let worst = Cell::new(0.0f64);
    let inputs = (any::<u64>(), JOINTS, any::<bool>(), 1usize..=4, any::<u8>());
    let outcome = TestRunner::new(config).run(&inputs, |(seed, joints, floating, s, traits)| {
        let figure = property(Robot::new(seed, joints, floating, s, traits))?;
        worst.set(worst.get().max(figure));
        Ok(())
    });
    println!("{what}: {:.1e} at most over {cases} robots", worst.get());
    if let Err(failure) = outcome {
        panic!("{failure}");
    }
}

/// Largest entry of `got - want` over the largest of `want`.
pub fn relative(got: &[f64], want: &[f64]) -> f64 {
    random_tree::difference(got, want) / size(want).max(f64::MIN_POSITIVE)
}

pub fn within(what: &str, figure: f64, bar: f64) -> Result<f64, TestCaseError> {
    prop_assert!(figure <= bar, "{what}: {figure:.2e} > {bar:.0e}");
    Ok(figure)
}
