//! A leg on springs: order while it sticks, order in flight, response matrix of a floating tree, landing.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::{GRAVITY, relative_error};
use delmpc_mechanics::branch_lu::BranchLu;
use delmpc_mechanics::del_residual::ForceCapacity;
use delmpc_mechanics::load_response::{BoundaryMotion, LoadPoint, LoadResponse};
use delmpc_mechanics::newton_direction::NewtonDirection;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::velocity::VelocityWorkspace;
use delmpc_plant::contact_step::{ContactOptions, ContactPoint, ContactStep};
use delmpc_plant::terrain::Terrain;

const POSTURE: [f64; 3] = [-0.18, 0.408, -0.238];

fn foot() -> LinkInertia {
    let inertia = Matrix3::from_diagonal(&Vector3::new(0.002, 0.006, 0.006));
    LinkInertia::new(1.5, Vector3::new(0.03, 0.0, 0.03), inertia)
}

fn rod(mass: f64, length: f64) -> LinkInertia {
    let across = mass * length * length / 12.0;
    let inertia = Matrix3::from_diagonal(&Vector3::new(across, across, 0.1 * across));
    LinkInertia::new(mass, Vector3::new(0.0, 0.0, 0.5 * length), inertia)
}

/// Ankle, knee and hip on springs about the posture.
fn add_links(builder: &mut TreeBuilder, parent: Option<usize>, stiffness: f64) {
    let mut parent = parent;
    for (i, (mass, length, at)) in
        [(3.0, 0.4, 0.08), (6.0, 0.4, 0.4), (25.0, 0.5, 0.4)].into_iter().enumerate()
    {
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, at));
        let joint =
            Joint::revolute(Vector3::y(), placement).with_damping(0.1).with_spring(stiffness, POSTURE[i]);
        parent = Some(builder.add(Body::new(parent, joint, rod(mass, length))));
    }
}

fn gravity() -> Vector3<f64> {
    Vector3::new(0.0, 0.0, -GRAVITY)
}

fn floating_leg(stiffness: f64) -> KinematicTree {
    let mut builder = TreeBuilder::floating_base(gravity(), foot());
    add_links(&mut builder, Some(0), stiffness);
    builder.build().unwrap()
}

fn rooted_leg(stiffness: f64) -> KinematicTree {
    let mut builder = TreeBuilder::fixed_base(gravity());
    add_links(&mut builder, None, stiffness);
    builder.build().unwrap()
}

fn sole(friction: f64) -> Vec<ContactPoint> {
    let corner = |x, y| ContactPoint { body: 0, point: Vector3::new(x, y, 0.0), radius: 0.0, friction };
    vec![corner(-0.08, -0.05), corner(-0.08, 0.05), corner(0.16, -0.05), corner(0.16, 0.05)]
}

fn standing(tree: &KinematicTree, height: f64) -> State {
    let mut state = State::zeros(tree);
    state.base_pose.translation = foot().com + Vector3::z() * height;
    state.q.copy_from_slice(&POSTURE);
    state
}

const SPRING: f64 = 3000.0;
const TIME: f64 = 0.2;

#[test]
fn while_it_sticks_the_leg_follows_the_rooted_tree_with_order_two() {
    let rooted = rooted_leg(SPRING);
    let rule = LobattoRule::new(2).unwrap();
    let fine = 1e-4;
    let mut integrator = Integrator::new(&rooted, &rule, fine, StepOptions::default()).unwrap();
    let mut truth = State::zeros(&rooted);
    truth.q.copy_from_slice(&POSTURE);
    let start_rates = [0.05, -0.08, 0.05];
    VelocityWorkspace::new(&rooted).set_velocity(&rooted, &mut truth, &start_rates).unwrap();
    for _ in 0..(TIME / fine).round() as usize {
        integrator.step(&rooted, &mut truth, &StepForces::held(&[0.0; 3])).unwrap();
    }
    let mut truth_rates = [0.0; 3];
    VelocityWorkspace::new(&rooted).velocity_into(&rooted, &truth, &mut truth_rates).unwrap();

    let tree = floating_leg(SPRING);
    let mut errors = Vec::new();
    for dt in [1e-3, 5e-4, 2.5e-4] {
        let options = ContactOptions::default();
        let mut contact = ContactStep::new(&tree, dt, &sole(0.7), Terrain::plane(0.0), options).unwrap();
        let mut state = standing(&tree, 0.0);
        let mut rates = vec![0.0; tree.dof()];
        rates[6..].copy_from_slice(&start_rates);
        VelocityWorkspace::new(&tree).set_velocity(&tree, &mut state, &rates).unwrap();
        let start = state.base_pose.translation;
        let mut drift = 0.0f64;
        let mut stuck = true;
        for _ in 0..(TIME / dt).round() as usize {
            let report = contact.step(&tree, &mut state, &[0.0; 3], &[]).unwrap();
            if !report.converged {
                println!("{dt} {report:?}");
            }
            stuck &= contact.results().iter().all(|result| result.touching);
            drift = drift.max((state.base_pose.translation - start).norm());
        }
        assert!(stuck, "the sole must carry load at all corners");
        let velocity = contact.end_motion().velocity();
        let q = state.q.iter().zip(&truth.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let v = velocity[6..].iter().zip(&truth_rates).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        println!("dt {dt}: q {q:.2e} rad, velocity {v:.2e} rad/s, foot drift {drift:.2e} m");
        errors.push((q, v, drift));
    }
    for pair in errors.windows(2) {
        let (q, v) = ((pair[0].0 / pair[1].0).log2(), (pair[0].1 / pair[1].1).log2());
        println!("order of q {q:.2}, of the velocity {v:.2}");
        assert!(q > 1.9 && v > 1.9);
    }
    assert!(errors[0].2 < 3e-5);
}

fn thrown(dt: f64) -> State {
    let tree = floating_leg(300.0);
    let options = ContactOptions::default();
    let mut contact = ContactStep::new(&tree, dt, &sole(0.7), Terrain::plane(0.0), options).unwrap();
    let mut state = standing(&tree, 1.0);
    let mut rates = vec![0.5, 2.0, -1.0, 1.0, 0.0, 3.0, 1.0, -2.0, 1.5];
    rates[3] += 0.3;
    VelocityWorkspace::new(&tree).set_velocity(&tree, &mut state, &rates).unwrap();
    for _ in 0..(0.4 / dt).round() as usize {
        let report = contact.step(&tree, &mut state, &[0.5, -0.2, 0.1], &[]).unwrap();
        assert_eq!(report.candidates, 0);
    }
    state
}

#[test]
fn in_flight_the_order_is_four() {
    let truth = thrown(2.5e-4);
    let error = |dt| {
        let state = thrown(dt);
        let q = state.q.iter().zip(&truth.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        q.max((state.base_pose.rotation - truth.base_pose.rotation).amax())
    };
    let (coarse, fine) = (error(5e-3), error(2.5e-3));
    let order = (coarse / fine).log2();
    println!("errors {coarse:.1e}, {fine:.1e}: order {order:.2}");
    assert!(order > 3.8);
}

#[test]
fn the_response_matrix_of_a_floating_tree_is_that_of_differences() {
    let tree = floating_leg(200.0);
    let rule = LobattoRule::new(2).unwrap();
    let dt = 2e-3;
    let options = StepOptions { forces: ForceCapacity { points: 3, laws: false }, ..StepOptions::default() };
    let mut state = standing(&tree, 0.3);
    state.base_pose.rotation = delmpc_mechanics::spatial::exp_rotation(&Vector3::new(0.3, -0.5, 0.8));
    let rates = [0.7, 2.0, -1.0, 1.0, 0.4, -1.5, 1.0, -2.0, 1.5];
    VelocityWorkspace::new(&tree).set_velocity(&tree, &mut state, &rates).unwrap();
    let points = [
        LoadPoint { body: 0, point_b: Vector3::new(0.1, 0.05, -0.03) },
        LoadPoint { body: 2, point_b: Vector3::new(0.0, -0.1, 0.2) },
        LoadPoint { body: 3, point_b: Vector3::new(0.2, 0.0, 0.3) },
    ];
    let impulse = [0.1, -0.2, 0.6, 0.05, 0.1, 0.2, -0.1, 0.3, 0.2];
    let solve = |impulse: &[f64]| {
        let mut integrator = Integrator::new(&tree, &rule, dt, options).unwrap();
        let forces: Vec<PointForce> = points
            .iter()
            .zip(impulse.chunks_exact(3))
            .map(|(p, i)| PointForce {
                body: p.body,
                point_b: p.point_b,
                force_w: Vector3::from_column_slice(i) / dt,
            })
            .collect();
        integrator.solve(&tree, &state, &StepForces::held(&[3.0, -5.0, 2.0]).with_points(&forces)).unwrap();
        let mut motion = BoundaryMotion::new(&tree);
        motion.update(&tree, integrator.next_state()).unwrap();
        (integrator, motion)
    };
    let velocities = |motion: &BoundaryMotion| -> Vec<f64> {
        let velocity = |p: &LoadPoint| motion.velocity_at_w(p.body, &motion.point_w(p));
        points.iter().flat_map(|p| <[f64; 3]>::from(velocity(p))).collect()
    };
    let (integrator, mut motion) = solve(&impulse);
    let mut lu = BranchLu::new(&tree, integrator.del());
    lu.factor(&tree, integrator.del()).unwrap();
    let mut response = LoadResponse::new(&tree, integrator.del(), &lu, 3);
    response.solve(&tree, integrator.del(), &mut lu, &points).unwrap();
    let mut w = vec![0.0; 81];
    response.velocity_response_into(&tree, &mut motion, 2, &points, &mut w).unwrap();
    let mut differences = vec![0.0; 81];
    for c in 0..9 {
        let h = 1e-3;
        let shifted = |sign: f64| {
            let mut impulse = impulse;
            impulse[c] += sign * h;
            velocities(&solve(&impulse).1)
        };
        let (ahead, behind) = (shifted(1.0), shifted(-1.0));
        let (far_ahead, far_behind) = (shifted(2.0), shifted(-2.0));
        for r in 0..9 {
            let near = (ahead[r] - behind[r]) / (2.0 * h);
            let far = (far_ahead[r] - far_behind[r]) / (4.0 * h);
            differences[9 * r + c] = (4.0 * near - far) / 3.0;
        }
    }
    let error = relative_error(&w, &differences);
    println!("W against differences: {error:.1e}");
    assert!(error < 1e-7);
}

#[test]
fn the_general_factorisations_give_the_same_response() {
    let tree = floating_leg(200.0);
    let rule = LobattoRule::new(2).unwrap();
    let mut integrator = Integrator::new(&tree, &rule, 2e-3, StepOptions::default()).unwrap();
    let state = standing(&tree, 0.3);
    integrator.solve(&tree, &state, &StepForces::held(&[3.0, -5.0, 2.0])).unwrap();
    let points = [LoadPoint { body: 3, point_b: Vector3::new(0.2, 0.0, 0.3) }];
    let del = integrator.del();
    let matrices = [NewtonMethod::BranchLu, NewtonMethod::Recursive, NewtonMethod::Dense].map(|method| {
        let mut solver = delmpc_mechanics::newton_direction::NewtonSolver::new(method, &tree, del);
        solver.factor(&tree, del).unwrap();
        let mut response = LoadResponse::new(&tree, del, &solver, 1);
        response.solve(&tree, del, &mut solver, &points).unwrap();
        let mut motion = BoundaryMotion::new(&tree);
        motion.update(&tree, integrator.next_state()).unwrap();
        let mut w = vec![0.0; 9];
        response.velocity_response_into(&tree, &mut motion, 2, &points, &mut w).unwrap();
        w
    });
    assert!(relative_error(&matrices[1], &matrices[0]) < 1e-9);
    assert!(relative_error(&matrices[2], &matrices[0]) < 1e-9);
}

/// Deepest penetration (m), largest gain of energy in a step (J) and unconverged steps of a leg that lands flat at 2 m/s.
fn land(stiffness: f64, dt: f64) -> (f64, f64, u32) {
    let tree = floating_leg(stiffness);
    let options = ContactOptions::default();
    let mut contact = ContactStep::new(&tree, dt, &sole(0.7), Terrain::plane(0.0), options).unwrap();
    let mut state = standing(&tree, 0.02);
    let mut rates = vec![0.0; tree.dof()];
    rates[5] = -2.0;
    let mut workspace = VelocityWorkspace::new(&tree);
    workspace.set_velocity(&tree, &mut state, &rates).unwrap();
    let mut energy = f64::INFINITY;
    let (mut gain, mut penetration, mut unconverged) = (0.0f64, 0.0f64, 0);
    for _ in 0..(0.1 / dt) as usize {
        let report = contact.step(&tree, &mut state, &[0.0; 3], &[]).unwrap();
        unconverged += u32::from(!report.converged);
        let (kinetic, potential) = workspace.energy(&tree, &state).unwrap();
        gain = gain.max(kinetic + potential - energy);
        energy = kinetic + potential;
        for result in contact.results() {
            penetration = penetration.max(-result.end_w.z);
        }
    }
    (penetration, gain, unconverged)
}

#[test]
fn a_leg_lands_without_penetration_or_energy() {
    for (stiffness, dt) in [(30.0, 1e-3), (300.0, 1e-3), (3000.0, 2e-3), (3000.0, 1e-3), (3000.0, 5e-4)] {
        let (penetration, gain, unconverged) = land(stiffness, dt);
        println!(
            "{stiffness} N m/rad, {dt} s: penetration {penetration:.1e} m, gain {gain:.1e} J, {unconverged} unconverged"
        );
    }
    let (penetration, gain, unconverged) = land(300.0, 1e-3);
    assert!(penetration < 1e-4 && gain < 1e-3 && unconverged == 0);
}
