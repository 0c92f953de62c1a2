//! Robots on the ground for the tests of the stage with contacts: a quadruped on points, Atlas on flat feet.
#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(clippy::unwrap_used, reason = "test helper: a model that does not build is a failed test")]

use delmpc_mechanics::contact_stage::{
    BoundaryKinematics, BoundaryState, Contact, ContactProjection, ContactStage, LiftedStage, StageNominal,
};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::reroot::Rerooted;
use delmpc_mechanics::spatial::exp_rotation;
use nalgebra::DMatrix;

use crate::oracle;
use crate::sample_robots::{Forces, GRAVITY, arms, quadruped, spread};

/// A robot, its contacts, and a start that moves on the active ones.
#[derive(Clone)]
pub struct Robot {
    pub tree: KinematicTree,
    pub contacts: Vec<Contact>,
    pub active: Vec<bool>,
    pub start: BoundaryState,
    pub u: Vec<f64>,
}

/// The quadruped of rods with point feet at the ends of its shanks; some stand.
pub fn quadruped_on(active: &[bool], forces: Forces) -> Robot {
    let tree = quadruped(GRAVITY, forces);
    let contacts = (0..4).map(|leg| Contact::point(9 + leg, Vector3::new(0.0, 0.0, -0.25))).collect();
    let mut start = BoundaryState::zeros(&tree);
    start.orientation = exp_rotation(&Vector3::new(0.05, -0.08, 0.3));
    start.position_w = Vector3::new(0.1, -0.2, 0.5);
    for leg in 0..4 {
        start.q[leg] = 0.05;
        start.q[4 + leg] = 0.5;
        start.q[8 + leg] = -1.0;
    }
    start.base_velocity_b = Vector6::new(0.3, -0.2, 0.4, 0.3, 0.1, -0.2);
    start.rate = spread(12, 0.5);
    let u = spread(12, 1.0);
    let mut robot = Robot { tree, contacts, active: active.to_vec(), start, u };
    robot.start = robot.projected(&robot.start);
    robot
}

/// Two arms on a base with springs, dampers, body drag and body wrenches; the end of one arm stands as a flat foot on a slope.
pub fn arms_on_a_foot() -> Robot {
    let tree = arms(GRAVITY, Forces::All);
    let sole = exp_rotation(&Vector3::new(0.2, -0.1, 0.3));
    let slope = exp_rotation(&Vector3::new(0.1, 0.2, -0.3));
    let contacts = vec![Contact::foot(3, Vector3::new(0.02, 0.03, -0.2), sole).on(slope)];
    let mut start = BoundaryState::zeros(&tree);
    start.orientation = exp_rotation(&Vector3::new(0.2, -0.1, 0.4));
    start.q = spread(4, 0.4);
    start.base_velocity_b = Vector6::new(0.3, -0.2, 0.4, 0.3, 0.1, -0.2);
    start.rate = spread(4, 0.5);
    Robot { tree, contacts, active: vec![true], start, u: spread(4, 1.0) }
}

/// Atlas on its pelvis (36 coordinates), a flat foot on each leg, and the same robot rooted at its right foot.
pub struct Atlas {
    pub robot: Robot,
    pub rooted: Rerooted,
    /// The sole frame in the link frame of the foot that `rooted` stands on.
    pub sole: RigidTransform,
    /// Sole corners of both feet.
    pub corners: Vec<Contact>,
}

/// The floating tree of a tree that is fixed at the body with `base`.
fn floating(fixed: &KinematicTree, base: LinkInertia) -> KinematicTree {
    let mut builder = TreeBuilder::floating_base(*fixed.gravity_w(), base);
    for body in fixed.bodies() {
        builder.add(Body { parent: Some(body.parent.map_or(0, |parent| parent + 1)), ..*body });
    }
    builder.build().unwrap()
}

pub fn atlas() -> Atlas {
    let case = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let left_foot = *case.tree.bodies().last().unwrap();
    // From the right foot to the pelvis and back: the model file stands on the right foot.
    let on_foot = floating(&case.tree, left_foot.inertia);
    let pelvis = 6;
    let at_pelvis = Rerooted::new(&on_foot, pelvis, &RigidTransform::identity()).unwrap();
    let tree = floating(at_pelvis.tree(), on_foot.bodies()[pelvis].inertia);
    let foot = |old: usize, point: Vector3<f64>| {
        let (body, point_l) = at_pelvis.point(old, &point);
        Contact::foot(body.unwrap() + 1, point_l, Matrix3::identity())
    };
    let sole_point = Vector3::new(0.048, 0.0, -0.076);
    let feet = [0, on_foot.body_count() - 1];
    let contacts: Vec<Contact> = feet.iter().map(|&old| foot(old, sole_point)).collect();
    let corners = feet
        .iter()
        .flat_map(|&old| {
            [(0.13, 0.06), (0.13, -0.06), (-0.13, 0.06), (-0.13, -0.06)].map(|(x, y)| {
                let contact = foot(old, sole_point + Vector3::new(x, y, 0.0));
                Contact::point(contact.body, contact.point_l)
            })
        })
        .collect();
    let sole = RigidTransform::from_translation(contacts[0].point_l);
    let rooted = Rerooted::new(&tree, contacts[0].body, &sole).unwrap();
    let mut start = BoundaryState::zeros(&tree);
    // Bent knees, soles level; arms beside the body. In the order of the model file, then of the pelvis tree.
    let mut posture = vec![0.0; 30];
    for (ankle, knee, hip) in [(1, 2, 3), (28, 27, 26)] {
        (posture[ankle], posture[knee], posture[hip]) = (-0.4, 0.8, -0.4);
    }
    (posture[9], posture[10], posture[17], posture[18]) = (0.3, -1.2, -0.3, 1.2);
    (posture[11], posture[12], posture[19], posture[20]) = (0.4, 0.6, 0.4, -0.6);
    start.q = posture.clone();
    at_pelvis.joints_to_rooted(&posture, &mut start.q).unwrap();
    start.position_w = Vector3::new(0.0, 0.0, 0.9);
    start.base_velocity_b = Vector6::new(0.1, -0.15, 0.2, 0.1, 0.05, -0.1);
    start.rate = spread(30, 0.3);
    let mut robot = Robot { tree, contacts, active: vec![true, true], start, u: Vec::new() };
    robot.start = robot.projected(&robot.start);
    robot.u = robot.static_forces().iter().zip(spread(30, 0.5)).map(|(hold, push)| hold + push).collect();
    Atlas { robot, rooted, sole, corners }
}

impl Robot {
    pub fn boundary(&self, state: &BoundaryState) -> BoundaryKinematics {
        let mut boundary = BoundaryKinematics::new(&self.tree).unwrap();
        boundary.update(&self.tree, state).unwrap();
        boundary
    }

    pub fn projection(&self, state: &BoundaryState) -> ContactProjection {
        let mut projection = ContactProjection::new(&self.tree, &self.contacts);
        let boundary = self.boundary(state);
        projection.factor(&self.tree, &boundary, &self.contacts, &self.active, 0.0).unwrap();
        projection
    }

    /// The state with the velocity that the active contacts allow.
    pub fn projected(&self, state: &BoundaryState) -> BoundaryState {
        let mut velocity = self.boundary(state).velocity().to_vec();
        self.projection(state).project(&mut velocity).unwrap();
        let mut out = state.clone();
        out.base_velocity_b = Vector6::from_row_slice(&velocity[..6]);
        out.rate = velocity[6..].to_vec();
        out
    }

    /// Joint forces that hold the posture when the active contacts share the weight (what does not balance is left to the contacts).
    pub fn static_forces(&self) -> Vec<f64> {
        let standing: Vec<Contact> =
            self.contacts.iter().zip(&self.active).filter(|(_, active)| **active).map(|(c, _)| *c).collect();
        let weight = self.tree.total_mass() * 9.81 / standing.len() as f64;
        let force: Vec<f64> = standing
            .iter()
            .flat_map(|contact| {
                let mut rows = vec![0.0; contact.row_count()];
                *rows.last_mut().unwrap() = weight;
                rows
            })
            .collect();
        let mut u = vec![0.0; self.tree.joint_count()];
        let boundary = self.boundary(&self.start);
        boundary.static_torques_into(&self.tree, &standing, &force, &mut u).unwrap();
        u
    }

    pub fn stage(&self, s: usize) -> ContactStage {
        ContactStage::new(&self.tree, &LobattoRule::new(s).unwrap(), &self.contacts).unwrap()
    }

    /// One solved step.
    pub fn solve(
        &self,
        stage: &mut ContactStage,
        dt: f64,
        start: &BoundaryState,
    ) -> (StageNominal, BoundaryState) {
        let (mut nominal, mut end) = (stage.nominal(), start.clone());
        stage.solve(&self.tree, dt, &self.active, start, &self.u, &mut nominal, &mut end).unwrap();
        (nominal, end)
    }

    /// One solved step and its linearisation.
    pub fn linear(
        &self,
        stage: &mut ContactStage,
        dt: f64,
        start: &BoundaryState,
    ) -> (LiftedStage, StageNominal, BoundaryState) {
        let (nominal, end) = self.solve(stage, dt, start);
        let mut lifted = stage.lifted();
        stage.linearize(&self.tree, dt, &self.active, start, &nominal, &self.u, &end, &mut lifted).unwrap();
        (lifted, nominal, end)
    }

    /// `G` and `∂y/∂(ε, q)` of the active contacts, `m x nv`.
    pub fn rows(&self, state: &BoundaryState) -> (DMatrix<f64>, DMatrix<f64>) {
        let (nv, boundary) = (self.tree.dof(), self.boundary(state));
        let (mut rows, mut gradients) = (Vec::new(), Vec::new());
        for (contact, _) in self.contacts.iter().zip(&self.active).filter(|(_, active)| **active) {
            let m = contact.row_count();
            let (mut y, mut g, mut d) = (vec![0.0; m], vec![0.0; m * nv], vec![0.0; m * nv]);
            boundary.contact_rows_into(&self.tree, contact, &mut y, &mut g).unwrap();
            boundary.contact_velocity_gradient_into(&self.tree, contact, &mut d).unwrap();
            rows.extend(g);
            gradients.extend(d);
        }
        let m = rows.len() / nv;
        (DMatrix::from_row_slice(m, nv, &rows), DMatrix::from_row_slice(m, nv, &gradients))
    }

    /// Positions of the contact points in {0}, one after the other.
    pub fn points(&self, state: &BoundaryState) -> Vec<f64> {
        let boundary = self.boundary(state);
        let point = |c: &Contact| boundary.placement(&self.tree, c).point_w;
        self.contacts.iter().flat_map(|c| point(c).iter().copied().collect::<Vec<f64>>()).collect()
    }
}

/// `(ε, δq, δV, δq̇) -> (ε, δq, δπ, δp_j)`.
pub fn canonical(tree: &KinematicTree, state: &BoundaryState) -> DMatrix<f64> {
    let (nv, joints) = (tree.dof(), tree.joint_count());
    let mut boundary = BoundaryKinematics::new(tree).unwrap();
    boundary.update(tree, state).unwrap();
    let mut map = DMatrix::identity(2 * nv, 2 * nv);
    let gradient = boundary.momentum_gradient();
    let momentum = boundary.base_pose_w().inverse_transform_wrench(&boundary.momentum_w());
    for r in 0..nv {
        for c in 0..nv {
            map[(nv + r, nv + c)] = boundary.mass_matrix()[r * nv + c];
        }
        for j in 0..joints {
            map[(nv + r, 6 + j)] = gradient[r * joints + j];
        }
    }
    for k in 0..6 {
        let unit = Twist::from_vector(&Vector6::ith(k, 1.0));
        let half = momentum.dual_bracket(&unit).to_vector() * -0.5;
        for r in 0..6 {
            map[(nv + r, k)] = half[r];
        }
    }
    map
}

pub fn a(lifted: &LiftedStage) -> DMatrix<f64> {
    let n = 2 * lifted.dof();
    DMatrix::from_fn(n, n, |r, c| lifted.a(r, c))
}

pub fn b(lifted: &LiftedStage) -> DMatrix<f64> {
    DMatrix::from_fn(2 * lifted.dof(), lifted.inputs(), |r, c| lifted.b(r, c))
}

/// `x` with `start.retract(x) = end`.
pub fn local(start: &BoundaryState, end: &BoundaryState) -> Vec<f64> {
    let mut x = vec![0.0; start.coordinates()];
    start.local(end, &mut x);
    x
}

pub fn moved(state: &BoundaryState, x: &[f64]) -> BoundaryState {
    let mut out = state.clone();
    out.retract(x);
    out
}

/// Largest entry of a difference over the largest of what it should be.
pub fn relative(got: &DMatrix<f64>, want: &DMatrix<f64>) -> f64 {
    (got - want).amax() / want.amax()
}
