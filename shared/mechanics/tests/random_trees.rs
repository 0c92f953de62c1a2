//! The integrator on random trees of up to 60 joints, fixed and floating: every algorithm against every other and against finite
//! differences.
//!
//! A tree is drawn from a seed: revolute and prismatic joints mixed, parents at random (bodies are numbered parent-first, not
//! depth-first), wide or deep; joint damping, springs, drag, constant wrenches, massless intermediate bodies, point forces and wrench
//! laws as the bits of `traits` say. The cases are the same on every run; a failure prints its input.
#![allow(clippy::panic, clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod random_tree;

use std::cell::Cell;

use delmpc_mechanics::del_hessian::DelHessian;
use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::dense_lu::DenseNewton;
use delmpc_mechanics::forces::{BodySample, WrenchSample};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::row_matrix::RowMatrix;
use delmpc_mechanics::spatial::{exp_rotation, skew};
use delmpc_mechanics::step::NewtonVariant;
use delmpc_mechanics::tangent::TangentWorkspace;
use delmpc_mechanics::velocity::VelocityWorkspace;
use nalgebra::{DMatrix, Matrix6};
use proptest::prelude::*;
use proptest::test_runner::{RngSeed, TestCaseError, TestRunner};
use random_tree::{Random, size};

const METHODS: [NewtonMethod; 3] = [NewtonMethod::Dense, NewtonMethod::BranchLu, NewtonMethod::Recursive];
const JOINTS: std::ops::RangeInclusive<usize> = 1..=60;

/// Relative difference of two ways to form the same matrix: round-off of sums over 60 bodies.
const SAME_MATRIX: f64 = 1e-12;
/// `|Jx - b|` over `|J||x| + |b|`: block elimination without pivoting between blocks may lose a few digits of 16.
const BACKWARD: f64 = 1e-11;
/// Finite differences with Richardson extrapolation: truncation `h⁴` and round-off `ε|f|/h` with `h` below, relative to the column.
const DIFFERENCES: f64 = 2e-8;
/// Increment of the finite differences.
const INCREMENT: f64 = 1e-3;
/// Torques are varied by this much more: what a small torque does in one step drowns in the round-off of the momenta.
const TORQUE_SCALE: f64 = 1e3;
/// `A` and `B` by two paths, relative to the column: the condition of the Newton matrix (1e6 and more) times round-off.
const SAME_LINEARISATION: f64 = 1e-8;
/// Residual of a step solved to round-off, relative to the largest momentum term in it.
const RESIDUAL_FLOOR: f64 = 1e-14;
/// The same by the default stopping rule: a change of the nodes predicted below 1e-16, times the Newton matrix.
const RESIDUAL_DEFAULT: f64 = 1e-11;

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
struct Anchor {
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
struct Robot {
    tree: KinematicTree,
    state: State,
    torques: Vec<f64>,
    hold: InputHold,
    points: Vec<PointForce>,
    anchors: Vec<Anchor>,
    s: usize,
    random: Random,
}

impl Robot {
    fn new(seed: u64, joints: usize, floating: bool, s: usize, traits: u8) -> Self {
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

    fn laws(&self) -> Vec<&dyn WrenchLaw> {
        self.anchors.iter().map(|a| a as &dyn WrenchLaw).collect()
    }

    fn forces<'a>(&'a self, torques: &'a [f64], laws: &'a [&'a dyn WrenchLaw]) -> StepForces<'a> {
        let joints = match self.hold {
            InputHold::Held => StepForces::held(torques),
            InputHold::PerNode => StepForces::per_node(torques),
        };
        joints.with_points(&self.points).with_laws(laws)
    }

    fn capacity(&self) -> ForceCapacity {
        ForceCapacity { points: self.points.len(), laws: !self.anchors.is_empty() }
    }

    /// Algorithm 1 at nodes that solve nothing.
    fn unsolved(&mut self) -> DelWorkspace {
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
    fn solved(&self, method: NewtonMethod, variant: NewtonVariant) -> Integrator {
        let mut integrator = self.integrator(method, variant);
        let laws = self.laws();
        integrator.solve(&self.tree, &self.state, &self.forces(&self.torques, &laws)).unwrap();
        integrator
    }

    fn integrator(&self, method: NewtonMethod, variant: NewtonVariant) -> Integrator {
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
fn on_random_robots(what: &str, cases: u32, property: impl Fn(Robot) -> Result<f64, TestCaseError>) {
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
fn relative(got: &[f64], want: &[f64]) -> f64 {
    random_tree::difference(got, want) / size(want).max(f64::MIN_POSITIVE)
}

fn within(what: &str, figure: f64, bar: f64) -> Result<f64, TestCaseError> {
    prop_assert!(figure <= bar, "{what}: {figure:.2e} > {bar:.0e}");
    Ok(figure)
}

fn newton_matrix(robot: &Robot, del: &DelWorkspace) -> DMatrix<f64> {
    let order = robot.s * robot.tree.dof();
    DMatrix::from_row_slice(order, order, DenseNewton::new(&robot.tree, del).assemble(&robot.tree, del))
}

/// Largest entry of `Jx - b` over that of `|J||x| + |b|`.
fn backward_error(matrix: &DMatrix<f64>, x: &[f64], b: &[f64]) -> f64 {
    let (mut worst, mut scale) = (0.0f64, 0.0f64);
    for (row, b) in matrix.row_iter().zip(b) {
        let (mut sum, mut terms) = (-b, b.abs());
        for (entry, x) in row.iter().zip(x) {
            sum += entry * x;
            terms += (entry * x).abs();
        }
        worst = worst.max(sum.abs());
        scale = scale.max(terms);
    }
    worst / scale.max(f64::MIN_POSITIVE)
}

#[test]
fn recursion_branch_lu_and_dense_lu_solve_the_same_newton_equations() {
    on_random_robots("backward error of the Newton direction", 64, |mut robot| {
        let del = robot.unsolved();
        let matrix = newton_matrix(&robot, &del);
        let transposed = matrix.transpose();
        let right = robot.random.values(matrix.nrows(), 1.0);
        let mut worst = 0.0f64;
        for method in METHODS {
            let mut solver = NewtonSolver::new(method, &robot.tree, &del);
            solver.factor(&robot.tree, &del).map_err(|e| TestCaseError::fail(format!("{method:?}: {e}")))?;
            let mut x = right.clone();
            solver.solve(&robot.tree, &mut x);
            worst =
                worst.max(within(&format!("{method:?} J"), backward_error(&matrix, &x, &right), BACKWARD)?);
            let mut y = right.clone();
            solver.solve_transposed(&robot.tree, &mut y);
            worst = worst.max(within(
                &format!("{method:?} Jt"),
                backward_error(&transposed, &y, &right),
                BACKWARD,
            )?);
            let mut many = RowMatrix::zeros(right.len(), 5);
            for (row, value) in right.iter().enumerate() {
                (0..5).for_each(|c| many.set(row, c, if c == row % 5 { *value } else { 0.0 }));
            }
            let columns = many.clone();
            solver.solve_many(&robot.tree, &mut many);
            for c in 0..5 {
                let x: Vec<f64> = (0..right.len()).map(|r| many.get(r, c)).collect();
                let b: Vec<f64> = (0..right.len()).map(|r| columns.get(r, c)).collect();
                let error = backward_error(&matrix, &x, &b);
                worst = worst.max(within(&format!("{method:?} column {c}"), error, BACKWARD)?);
            }
        }
        Ok(worst)
    });
}

#[test]
fn the_three_directions_agree_as_far_as_the_condition_of_the_newton_matrix_lets_them() {
    // Forward error over condition, and the few digits of BACKWARD.
    const FORWARD_OVER_CONDITION: f64 = 1e-13;
    on_random_robots("difference of the directions over condition", 24, |mut robot| {
        let del = robot.unsolved();
        let matrix = newton_matrix(&robot, &del);
        let norm = |m: &DMatrix<f64>| {
            m.row_iter().map(|r| r.iter().map(|x| x.abs()).sum::<f64>()).fold(0.0, f64::max)
        };
        let inverse = matrix.clone().try_inverse().ok_or_else(|| TestCaseError::fail("singular"))?;
        let condition = norm(&matrix) * norm(&inverse);
        let right = robot.random.values(matrix.nrows(), 1.0);
        let directions: Vec<Vec<f64>> = METHODS
            .iter()
            .map(|&method| {
                let mut solver = NewtonSolver::new(method, &robot.tree, &del);
                solver.factor(&robot.tree, &del).unwrap();
                let mut x = right.clone();
                solver.solve(&robot.tree, &mut x);
                x
            })
            .collect();
        let lu = relative(&directions[1], &directions[0]) / condition;
        let recursion = relative(&directions[2], &directions[0]) / condition;
        within("branch LU", lu, FORWARD_OVER_CONDITION)?;
        within("recursion", recursion, FORWARD_OVER_CONDITION)?;
        Ok(lu.max(recursion))
    });
}

#[test]
fn the_newton_matrix_and_the_hessian_are_the_columns_of_the_tangent() {
    on_random_robots("matrix against tangent", 64, |mut robot| {
        let del = robot.unsolved();
        let (n, s) = (robot.tree.dof(), robot.s);
        let matrix = newton_matrix(&robot, &del);
        let mut tangent = TangentWorkspace::new(&robot.tree, &del);
        let (mut rows, mut last) = (vec![0.0; s * n], vec![0.0; n]);
        let mut hessian = DelHessian::new(&robot.tree, &del);
        hessian.evaluate(&robot.tree, &del);
        let mut blocks = vec![vec![0.0; n * n]; (s + 1) * (s + 1)];
        if !robot.tree.is_floating() {
            for (at, block) in blocks.iter_mut().enumerate() {
                hessian.dense_block_into(&robot.tree, at / (s + 1), at % (s + 1), block);
            }
        }
        let scale = matrix.amax();
        let mut worst = 0.0f64;
        for gamma in 0..=s {
            for j in 0..n {
                tangent.clear();
                tangent.set(gamma, j, 1.0);
                tangent.evaluate(&robot.tree, &del);
                tangent.residual_into(&robot.tree, &del, &mut rows);
                tangent.next_momentum_into(&robot.tree, &del, &mut last);
                if gamma > 0 {
                    let column = matrix.column(j * s + gamma - 1);
                    let error = random_tree::difference(column.as_slice(), &rows) / size(&rows);
                    worst = worst.max(within(&format!("column of {j} at node {gamma}"), error, SAME_MATRIX)?);
                }
                if !robot.tree.is_floating() {
                    for i in 0..n {
                        for alpha in 0..=s {
                            let want = if alpha < s { rows[i * s + alpha] } else { last[i] };
                            let got = blocks[alpha * (s + 1) + gamma][i * n + j];
                            let error = (got - want).abs() / scale;
                            worst = worst.max(within(
                                &format!("H[{alpha},{gamma}]({i},{j})"),
                                error,
                                SAME_MATRIX,
                            )?);
                        }
                    }
                }
            }
        }
        Ok(worst)
    });
}

/// Central differences of `f` at 0 along a curve, extrapolated: `(4 D(h/2) - D(h)) / 3`.
fn derivative(mut f: impl FnMut(f64) -> Vec<f64>) -> Vec<f64> {
    let mut central = |h: f64| -> Vec<f64> {
        let (ahead, behind) = (f(h), f(-h));
        ahead.iter().zip(&behind).map(|(a, b)| (a - b) / (2.0 * h)).collect()
    };
    let (coarse, fine) = (central(INCREMENT), central(0.5 * INCREMENT));
    fine.iter().zip(&coarse).map(|(fine, coarse)| (4.0 * fine - coarse) / 3.0).collect()
}

#[test]
fn the_newton_matrix_is_the_difference_quotient_of_the_residual_with_every_force() {
    on_random_robots("matrix against differences", 32, |mut robot| {
        let mut del = robot.unsolved();
        let (n, s) = (robot.tree.dof(), robot.s);
        let matrix = newton_matrix(&robot, &del);
        let laws = robot.laws();
        let mut worst = 0.0f64;
        for j in 0..n {
            for gamma in 1..=s {
                let kept = del.node(gamma, j);
                let column = derivative(|h| {
                    del.set_node(gamma, j, kept + h);
                    del.evaluate(&robot.tree, &laws);
                    let mut rows = vec![0.0; s * n];
                    del.residual_into(&robot.tree, &mut rows);
                    rows
                });
                del.set_node(gamma, j, kept);
                let error = relative(matrix.column(j * s + gamma - 1).as_slice(), &column);
                worst = worst.max(within(&format!("column of {j} at node {gamma}"), error, DIFFERENCES)?);
            }
        }
        Ok(worst)
    });
}

/// `P` of a floating base.
fn total_momentum(state: &State) -> Wrench {
    Wrench::from_vector(&Vector6::from_column_slice(&state.p[..6]))
}

/// One column of `[A | B]` by differences of the step map.
fn step_difference(robot: &Robot, integrator: &mut Integrator, end: &State, column: usize) -> Vec<f64> {
    let (n, base) = (robot.tree.dof(), robot.tree.base_dof());
    let start = &robot.state;
    let unit = |k: usize, h: f64| Vector6::ith(k, h);
    let mut column_of_step = derivative(|h| {
        let mut state = start.clone();
        let mut torques = robot.torques.clone();
        let pose = &start.base_pose;
        let total = if base > 0 { total_momentum(start) } else { Wrench::default() };
        let mut set_total = |change: Wrench| {
            for (p, change) in state.p.iter_mut().zip(change.to_vector().iter()) {
                *p += change;
            }
        };
        if column < base {
            // δg = g ε^ and δP = -½ ad^D_P η keep the canonical momentum error at zero.
            let epsilon = unit(column, h);
            let eta = pose.transform_twist(&Twist::from_vector(&epsilon));
            set_total(total.dual_bracket(&eta) * -0.5);
            let turn = exp_rotation(&epsilon.fixed_rows::<3>(0).into_owned());
            state.base_pose = RigidTransform {
                rotation: pose.rotation * turn,
                translation: pose.translation + pose.rotation * epsilon.fixed_rows::<3>(3),
            };
        } else if column < n {
            state.q[column - base] += h;
        } else if column < n + base {
            set_total(pose.transform_wrench(&Wrench::from_vector(&unit(column - n, h))));
        } else if column < 2 * n {
            state.p[column - n] += h;
        } else {
            torques[column - 2 * n] += h * TORQUE_SCALE;
        }
        let laws = robot.laws();
        integrator.forget();
        integrator.solve(&robot.tree, &state, &robot.forces(&torques, &laws)).unwrap();
        let next = integrator.next_state();
        let mut out = Vec::new();
        if base > 0 {
            let turn = end.base_pose.rotation.tr_mul(&next.base_pose.rotation);
            out.extend_from_slice(delmpc_mechanics::spatial::log_rotation(&turn).as_slice());
            let place = next.base_pose.translation - end.base_pose.translation;
            out.extend_from_slice(end.base_pose.rotation.tr_mul(&place).as_slice());
        }
        out.extend_from_slice(&next.q);
        out.extend_from_slice(&next.p);
        out
    });
    if column >= 2 * n {
        column_of_step.iter_mut().for_each(|x| *x /= TORQUE_SCALE);
    }
    if base > 0 {
        let eta = end
            .base_pose
            .transform_twist(&Twist::from_vector(&Vector6::from_column_slice(&column_of_step[..6])));
        let change = Wrench::from_vector(&Vector6::from_column_slice(&column_of_step[n..n + 6]));
        let total = total_momentum(end);
        let error = end.base_pose.inverse_transform_wrench(&(change + total.dual_bracket(&eta) * 0.5));
        column_of_step[n..n + 6].copy_from_slice(error.to_vector().as_slice());
    }
    column_of_step
}

#[test]
fn a_and_b_are_the_difference_quotients_of_the_step() {
    on_random_robots("A, B against differences", 24, |mut robot| {
        let n = robot.tree.dof();
        let mut exact = robot.solved(NewtonMethod::BranchLu, NewtonVariant::Exact);
        let end = exact.next_state().clone();
        let mut work = Linearizer::new(&robot.tree, &exact, StateCoordinates::Momentum, robot.hold).unwrap();
        let linear = work.linearize(&robot.tree, &mut exact).unwrap().clone();
        let columns = 2 * n + linear.inputs();
        let mut worst = 0.0f64;
        for _ in 0..16 {
            let column = robot.random.below(columns);
            let want = step_difference(&robot, &mut exact, &end, column);
            let got: Vec<f64> = (0..2 * n).map(|r| linear.matrix().get(r, column)).collect();
            let error = relative(&got, &want);
            worst = worst.max(within(&format!("column {column} of {columns}, n = {n}"), error, DIFFERENCES)?);
        }
        Ok(worst)
    });
}

#[test]
fn a_and_b_come_out_the_same_by_both_paths_and_every_factorisation() {
    on_random_robots("A, B by matrix and by tangent", 32, |robot| {
        let n = robot.tree.dof();
        let mut reference: Option<Vec<Vec<f64>>> = None;
        let mut worst = 0.0f64;
        for method in METHODS {
            let mut integrator = robot.solved(method, NewtonVariant::Exact);
            let mut work =
                Linearizer::new(&robot.tree, &integrator, StateCoordinates::Momentum, robot.hold).unwrap();
            let columns = |step: &LinearStep| -> Vec<Vec<f64>> {
                let column = |c: usize| (0..2 * n).map(|r| step.matrix().get(r, c)).collect();
                (0..2 * n + step.inputs()).map(column).collect()
            };
            let by_matrix = columns(work.linearize(&robot.tree, &mut integrator).unwrap());
            let by_tangent = columns(work.linearize_by_tangent(&robot.tree, &mut integrator).unwrap());
            // Refused for a floating base and for general wrenches.
            let by_recursion = work.linearize_by_recursion(&robot.tree, &mut integrator).map(columns);
            let want = reference.get_or_insert(by_tangent.clone());
            for (c, want) in want.iter().enumerate() {
                let matrix = relative(&by_matrix[c], want);
                let tangent = relative(&by_tangent[c], want);
                worst = worst.max(within(
                    &format!("{method:?} matrix path column {c}"),
                    matrix,
                    SAME_LINEARISATION,
                )?);
                worst = worst.max(within(
                    &format!("{method:?} tangent path column {c}"),
                    tangent,
                    SAME_LINEARISATION,
                )?);
                if let Ok(by_recursion) = &by_recursion {
                    worst = worst.max(within(
                        &format!("recursion column {c}"),
                        relative(&by_recursion[c], want),
                        SAME_LINEARISATION,
                    )?);
                }
            }
            if robot.tree.is_floating() {
                continue;
            }
            let lambda: Vec<f64> = (0..2 * n).map(|k| (1.0 + k as f64).sin()).collect();
            let (mut a, mut b) = (vec![0.0; 2 * n], vec![0.0; want.len() - 2 * n]);
            work.adjoint_into(&robot.tree, &mut integrator, &lambda, &mut a, &mut b).unwrap();
            a.extend(b);
            let products: Vec<f64> = want.iter().map(|column| random_tree::dot(column, &lambda)).collect();
            let adjoint = relative(&a, &products);
            worst = worst.max(within(&format!("{method:?} adjoint"), adjoint, SAME_LINEARISATION)?);
        }
        Ok(worst)
    });
}

/// Largest term `|a^{αβ}| Sᵀ|μ|` of the residual, joints only: what cancels in it when the step is solved.
fn largest_momentum_term(robot: &Robot, del: &DelWorkspace) -> f64 {
    let mut kinematics = Kinematics::new(&robot.tree);
    let base = robot.tree.base_dof();
    let mut worst = 0.0f64;
    for beta in 0..=robot.s {
        let q: Vec<f64> = (0..robot.tree.joint_count()).map(|j| del.node(beta, base + j)).collect();
        let pose = if base > 0 { del.body_pose(0, beta) } else { RigidTransform::identity() };
        kinematics.update_positions(&robot.tree, &Configuration::floating(pose, &q)).unwrap();
        let weight = (0..=robot.s).fold(0.0f64, |m, a| m.max(del.rule().weighted_derivative(a, beta).abs()));
        for body in robot.tree.first_joint_body()..robot.tree.body_count() {
            let (momentum, _) = del.body_momentum_and_impulse(body, beta);
            let twist = &kinematics.joint_twists_w()[body];
            let terms = momentum.to_vector().component_mul(&twist.to_vector()).abs().sum();
            worst = worst.max(weight * terms);
        }
    }
    worst
}

#[test]
fn the_residual_of_a_solved_step_is_round_off_of_its_largest_momentum_term() {
    for (variant, bar) in [(NewtonVariant::Exact, RESIDUAL_FLOOR), (NewtonVariant::Broyden, RESIDUAL_DEFAULT)]
    {
        on_random_robots(&format!("residual over momentum term, {variant:?}"), 48, |robot| {
            let mut worst = 0.0f64;
            for method in METHODS {
                let integrator = robot.solved(method, variant);
                let del = integrator.del();
                let mut residual = vec![0.0; robot.s * robot.tree.dof()];
                del.residual_into(&robot.tree, &mut residual);
                let floor = size(&residual) / largest_momentum_term(&robot, del);
                worst = worst.max(within(&format!("{method:?}"), floor, bar)?);
            }
            Ok(worst)
        });
    }
}

#[test]
fn the_mass_matrix_is_symmetric_positive_definite() {
    on_random_robots("asymmetry of the mass matrix", 64, |robot| {
        let mut work = VelocityWorkspace::new(&robot.tree);
        work.factor_at(&robot.tree, &robot.state).unwrap();
        let n = robot.tree.dof();
        let matrix = DMatrix::from_row_slice(n, n, work.mass_matrix());
        let asymmetry = (&matrix - matrix.transpose()).amax();
        prop_assert_eq!(asymmetry, 0.0);
        prop_assert!(matrix.clone().cholesky().is_some(), "not positive definite");
        prop_assert!(work.factor().pivots().iter().all(|pivot| *pivot > 0.0));
        // And p = M q̇ comes back from the velocity.
        let mut velocity = vec![0.0; n];
        work.velocity_into(&robot.tree, &robot.state, &mut velocity).unwrap();
        let product = random_tree::multiply(work.mass_matrix(), &velocity);
        within("M M⁻¹p - p", relative(&product, &robot.state.p), SAME_MATRIX)?;
        Ok(asymmetry)
    });
}
