//! What the integrator keeps: momenta exactly, time reversal to the solver's tolerance, energy without drift.
//!
//! Symplecticity of a step is tested with its linearisation in `linearize.rs`.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod sample_robots;

use delmpc_mechanics::energy::total_momentum_w;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::prelude::*;
use sample_robots::{
    Forces, GRAVITY, WEIGHTLESS, arms, brick, difference, exact_integrator, integrator, moving_state,
    pendulum, quadruped, spatial_chain, spread,
};

/// A step forth and back: two solves to a predicted change below 1e-14, and round-off of momenta of a few N·m·s.
const REVERSAL: f64 = 1e-12;
/// The bar on all six momentum components over 1000 tumbling steps.
const TUMBLING: f64 = 1e-11;
/// Exact invariants, relative to their size: round-off summed over some hundred steps.
const EXACT: f64 = 1e-13;
/// Momenta of joints that the motion keeps, over some hundred steps: the step solves for them. Exact Newton leaves round-off (1.2e-13
/// measured), the default what its stopping rule leaves (5e-12 measured): a change of the nodes predicted below 1e-16, times the
/// Newton matrix (about 1e4 here).
const BY_EXACT_NEWTON: f64 = 1e-12;
/// See [`BY_EXACT_NEWTON`].
const BY_SOLVER: f64 = 2e-11;

fn trees_without_dissipation() -> Vec<(&'static str, KinematicTree, State)> {
    let chain = spatial_chain(GRAVITY, Forces::Springs);
    let one = brick(GRAVITY, Forces::None);
    let two = arms(GRAVITY, Forces::Springs);
    let four = quadruped(GRAVITY, Forces::Springs);
    let with_state = |name, tree: KinematicTree, spin| {
        let state = moving_state(&tree, spin, 1.0);
        (name, tree, state)
    };
    vec![
        with_state("chain", chain, 0.0),
        with_state("brick", one, 5.0),
        with_state("arms", two, 3.0),
        with_state("quadruped", four, 3.0),
    ]
}

fn distance(a: &State, b: &State) -> f64 {
    let turn = (a.base_pose.rotation - b.base_pose.rotation).amax();
    let place = (a.base_pose.translation - b.base_pose.translation).amax();
    turn.max(place).max(difference(&a.q, &b.q)).max(difference(&a.p, &b.p))
}

fn flip(state: &mut State) {
    state.p.iter_mut().for_each(|p| *p = -*p);
}

#[test]
fn a_step_with_flipped_momenta_goes_back_to_where_it_came_from() {
    for (name, tree, start) in trees_without_dissipation() {
        let torque = spread(tree.joint_count(), 0.5);
        for s in 1..=4 {
            let mut integrator = integrator(&tree, s, 0.01);
            let mut state = start.clone();
            integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap();
            assert!(distance(&state, &start) > 1e-3, "{name}: it moved");
            flip(&mut state);
            integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap();
            flip(&mut state);
            let defect = distance(&state, &start);
            println!("{name} s = {s}: {defect:.1e} after one step forth and back");
            assert!(defect <= REVERSAL, "{name} s = {s}: {defect:.2e}");
        }
    }
}

#[test]
fn fifty_steps_with_flipped_momenta_retrace_the_whole_motion() {
    // The motion stretches neighbouring states apart by about 1e2 in this time, and round-off with them.
    const RETRACE: f64 = 1e-10;
    for (name, tree, start) in trees_without_dissipation() {
        let torque = spread(tree.joint_count(), 0.5);
        for s in 1..=3 {
            let mut integrator = integrator(&tree, s, 0.01);
            let mut state = start.clone();
            let forces = StepForces::held(&torque);
            (0..50).for_each(|_| _ = integrator.step(&tree, &mut state, &forces).unwrap());
            flip(&mut state);
            (0..50).for_each(|_| _ = integrator.step(&tree, &mut state, &forces).unwrap());
            flip(&mut state);
            let defect = distance(&state, &start);
            println!("{name} s = {s}: {defect:.1e} after 50 steps forth and back");
            assert!(defect <= RETRACE, "{name} s = {s}: {defect:.2e}");
        }
    }
}

/// Total momentum as the sum over the bodies, from the velocity `M⁻¹(P, p_j)`, and the energy.
fn momentum_and_energy(
    integrator: &mut Integrator,
    tree: &KinematicTree,
    state: &State,
) -> (Vector6<f64>, f64) {
    let mut velocity = vec![0.0; tree.dof()];
    integrator.velocities().velocity_into(tree, state, &mut velocity).unwrap();
    let mut kinematics = Kinematics::new(tree);
    let base = Twist::from_vector(&Vector6::from_column_slice(&velocity[..6]));
    kinematics.update(tree, &Configuration::of(state), &Velocity::floating(base, &velocity[6..])).unwrap();
    let (kinetic, potential) = integrator.velocities().energy(tree, state).unwrap();
    (total_momentum_w(tree, &kinematics).to_vector(), kinetic + potential)
}

fn rows(matrix: &[f64], x: &[f64], count: usize) -> Vec<f64> {
    let row = |r: usize| matrix[r * x.len()..].iter().zip(x).map(|(m, x)| m * x).sum();
    (0..count).map(row).collect()
}

#[test]
fn six_momenta_of_a_tumbling_robot_stay_within_1e_minus_11_over_1000_steps() {
    let robots = [
        ("brick", brick(WEIGHTLESS, Forces::None), 0.02),
        ("arms", arms(WEIGHTLESS, Forces::Springs), 0.01),
        ("quadruped", quadruped(WEIGHTLESS, Forces::Springs), 0.01),
    ];
    for (name, tree, time_step) in robots {
        let start = moving_state(&tree, 5.0, 0.0);
        let torque = vec![0.0; tree.joint_count()];
        for s in 1..=3 {
            let mut integrator = integrator(&tree, s, time_step);
            let mut state = start.clone();
            let (first, energy) = momentum_and_energy(&mut integrator, &tree, &state);
            let (mut by_bodies, mut by_matrix, mut stored, mut steepest) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
            let (mut begin, mut end) = (0.0f64, 0.0f64);
            for step in 0..1000 {
                integrator
                    .step(&tree, &mut state, &StepForces::held(&torque))
                    .unwrap_or_else(|e| panic!("{name} s = {s} step {step}: {e}"));
                let (momentum, now) = momentum_and_energy(&mut integrator, &tree, &state);
                by_bodies = by_bodies.max((momentum - first).amax());
                let mut velocity = vec![0.0; tree.dof()];
                integrator.velocities().velocity_into(&tree, &state, &mut velocity).unwrap();
                let product = rows(integrator.velocities().mass_matrix(), &velocity, 6);
                by_matrix = by_matrix.max(difference(&product, first.as_slice()));
                stored = stored.max(difference(&state.p[..6], &start.p[..6]));
                steepest = steepest.max(state.base_pose.rotation[(2, 0)].abs());
                if step < 100 {
                    begin = begin.max((now - energy).abs() / energy);
                }
                if step >= 900 {
                    end = end.max((now - energy).abs() / energy);
                }
            }
            println!(
                "{name} s = {s}: momenta by bodies {by_bodies:.1e}, by mass matrix {by_matrix:.1e}, stored {stored:.1e}; \
                 |sin pitch| up to {steepest:.4}; energy off by {begin:.0e} in the first tenth, {end:.0e} in the last"
            );
            assert!(by_bodies.max(by_matrix) <= TUMBLING, "{name} s = {s}: {by_bodies:.2e}, {by_matrix:.2e}");
            assert_eq!(
                stored, 0.0,
                "{name} s = {s}: without external wrench the stored momentum is bit-exact"
            );
            assert!(steepest > 0.9, "{name} s = {s}: it should tumble through all orientations");
        }
    }
}

/// Inner forces of any kind, dissipative ones and motor torques included, leave the total momentum alone.
#[test]
fn torques_springs_and_joint_damping_do_not_touch_the_total_momentum() {
    let tree = {
        // The arms with everything except what acts from outside.
        let full = arms(WEIGHTLESS, Forces::All);
        let mut builder = TreeBuilder::floating_base(Vector3::zeros(), full.bodies()[0].inertia);
        for body in &full.bodies()[1..] {
            builder.add(Body::new(body.parent, body.joint, body.inertia));
        }
        builder.build().unwrap()
    };
    let start = moving_state(&tree, 4.0, 1.0);
    for s in 1..=3 {
        let mut integrator = integrator(&tree, s, 0.01);
        let mut state = start.clone();
        for step in 0..1000 {
            let torque: Vec<f64> = (0..4).map(|k| (0.01 * f64::from(step) + f64::from(k)).sin()).collect();
            integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap();
        }
        let (momentum, _) = momentum_and_energy(&mut integrator, &tree, &state);
        let change = difference(momentum.as_slice(), &start.p[..6]);
        println!("s = {s}: {change:.1e}");
        assert!(change <= TUMBLING && state.p[..6] == start.p[..6], "s = {s}: {change:.2e}");
    }
}

#[test]
fn under_gravity_linear_momentum_follows_the_weight_and_vertical_angular_momentum_stays() {
    let gravity = Vector3::from(GRAVITY);
    let robots = [
        ("brick", brick(GRAVITY, Forces::None)),
        ("arms", arms(GRAVITY, Forces::Springs)),
        ("quadruped", quadruped(GRAVITY, Forces::Springs)),
    ];
    for (name, tree) in robots {
        let start = moving_state(&tree, 5.0, 0.5);
        let torque = spread(tree.joint_count(), 0.3);
        for s in 1..=3 {
            let mut integrator = integrator(&tree, s, 0.01);
            let mut state = start.clone();
            let steps = 100;
            (0..steps)
                .for_each(|_| _ = integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap());
            let (momentum, _) = momentum_and_energy(&mut integrator, &tree, &state);
            let expected = Vector3::from_column_slice(&start.p[3..6])
                + gravity * tree.total_mass() * 0.01 * f64::from(steps);
            let linear = (momentum.fixed_rows::<3>(3) - expected).amax() / expected.amax();
            let size = momentum.fixed_rows::<3>(0).amax().max(1.0);
            let vertical = (momentum[2] - start.p[2]).abs() / size;
            println!("{name} s = {s}: linear {linear:.1e}, vertical angular {vertical:.1e} (relative)");
            assert!(linear <= EXACT, "{name} s = {s}: linear momentum off by {linear:.2e}");
            assert!(vertical <= EXACT, "{name} s = {s}: vertical angular momentum off by {vertical:.2e}");
        }
    }
}

/// Three slides carry a chain: its linear momentum is that of the slides' coordinates.
#[test]
fn linear_momentum_of_a_chain_on_three_slides_is_exact_and_grows_with_the_weight() {
    let arm = spatial_chain(WEIGHTLESS, Forces::Springs);
    let gravity = Vector3::new(1.0, -2.0, -9.81);
    let mut builder = TreeBuilder::fixed_base(gravity);
    let mut parent = None;
    for axis in [Vector3::x(), Vector3::y(), Vector3::z()] {
        let slide = Joint::prismatic(axis, RigidTransform::identity());
        parent = Some(builder.add(Body::new(parent, slide, LinkInertia::massless())));
    }
    for body in arm.bodies() {
        parent = Some(builder.add(Body { parent, ..*body }));
    }
    let tree = builder.build().unwrap();
    let start = moving_state(&tree, 0.0, 1.5);
    let mut worst = [0.0f64; 2];
    for (s, exact) in (1..=3).flat_map(|s| [(s, true), (s, false)]) {
        let mut integrator =
            if exact { exact_integrator(&tree, s, 0.01) } else { integrator(&tree, s, 0.01) };
        let mut state = start.clone();
        for step in 1..=300 {
            // No force on the slides, any on the chain.
            let wave = (0.05 * f64::from(step)).sin();
            let torque = [0.0, 0.0, 0.0, wave, -wave, 0.5 * wave];
            integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap();
        }
        let momentum = Vector3::from_column_slice(&start.p[..3]) + gravity * (tree.total_mass() * 3.0);
        let change = difference(&state.p[..3], momentum.as_slice()) / momentum.amax();
        println!("s = {s}, exact Newton {exact}: {change:.1e} (relative)");
        worst[usize::from(exact)] = worst[usize::from(exact)].max(change);
    }
    assert!(
        worst[1] <= BY_EXACT_NEWTON && worst[0] <= BY_SOLVER,
        "exact Newton {:.2e}, default {:.2e}",
        worst[1],
        worst[0]
    );
}

/// A chain on a vertical pivot: gravity and inner forces do not act on the pivot's coordinate.
#[test]
fn momentum_of_a_cyclic_coordinate_is_exact() {
    let arm = spatial_chain(GRAVITY, Forces::Springs);
    let mut builder = TreeBuilder::fixed_base(Vector3::from(GRAVITY));
    let pivot = Joint::revolute(Vector3::z(), RigidTransform::from_translation(Vector3::new(0.4, -0.3, 0.0)));
    let turntable = LinkInertia::new(2.0, Vector3::new(0.1, 0.0, 0.0), Matrix3::identity() * 0.05);
    let mut parent = Some(builder.add(Body::new(None, pivot, turntable)));
    for body in arm.bodies() {
        parent = Some(builder.add(Body { parent, ..*body }));
    }
    let tree = builder.build().unwrap();
    let start = moving_state(&tree, 0.0, 2.0);
    let mut worst = [0.0f64; 2];
    for (s, exact) in (1..=4).flat_map(|s| [(s, true), (s, false)]) {
        let mut integrator =
            if exact { exact_integrator(&tree, s, 0.01) } else { integrator(&tree, s, 0.01) };
        let mut state = start.clone();
        (0..500).for_each(|_| {
            _ = integrator.step(&tree, &mut state, &StepForces::held(&[0.0, 0.3, -0.2, 0.1])).unwrap();
        });
        let change = (state.p[0] - start.p[0]).abs() / start.p[0].abs().max(1.0);
        let turned = (state.q[0] - start.q[0]).abs();
        println!("s = {s}, exact Newton {exact}: {change:.1e} (relative), pivot turned by {turned:.1} rad");
        assert!(turned > 0.1);
        worst[usize::from(exact)] = worst[usize::from(exact)].max(change);
    }
    assert!(
        worst[1] <= BY_EXACT_NEWTON && worst[0] <= BY_SOLVER,
        "exact Newton {:.2e}, default {:.2e}",
        worst[1],
        worst[0]
    );
}

#[test]
fn energy_of_a_twelve_link_pendulum_is_bounded_without_drift_over_100_000_simpson_steps() {
    /// The last tenth may exceed the first by this factor: they are different pieces of a quasi-periodic error.
    const GROWTH: f64 = 1.5;
    /// The least-squares line over the whole run may change by this part of the error's amplitude.
    const TREND: f64 = 0.1;
    const STEPS: usize = 100_000;
    const STRIDE: usize = 10;
    let tree = pendulum(12, 0.25);
    let mut integrator = integrator(&tree, 2, 0.01);
    let mut state = State::zeros(&tree);
    // Regular motion: the chain swings as one, bent a little.
    state.q[0] = 0.3;
    state.q[6] = 0.1;
    let torque = vec![0.0; 12];
    let energy = |integrator: &mut Integrator, state: &State| {
        let (kinetic, potential) = integrator.velocities().energy(&tree, state).unwrap();
        kinetic + potential
    };
    let start = energy(&mut integrator, &state);
    let hanging = energy(&mut integrator, &State::zeros(&tree));
    let scale = start - hanging;
    let mut samples = Vec::with_capacity(STEPS / STRIDE);
    for step in 1..=STEPS {
        integrator
            .step(&tree, &mut state, &StepForces::held(&torque))
            .unwrap_or_else(|e| panic!("step {step}: {e}"));
        if step % STRIDE == 0 {
            samples.push((energy(&mut integrator, &state) - start) / scale);
        }
    }
    let largest = |part: &[f64]| part.iter().fold(0.0f64, |m, e| m.max(e.abs()));
    let tenth = samples.len() / 10;
    let (first, last) = (largest(&samples[..tenth]), largest(&samples[samples.len() - tenth..]));
    let middle = (samples.len() as f64 - 1.0) / 2.0;
    let mean = samples.iter().sum::<f64>() / samples.len() as f64;
    let (mut cross, mut square) = (0.0, 0.0);
    for (k, e) in samples.iter().enumerate() {
        let x = k as f64 - middle;
        cross += x * (e - mean);
        square += x * x;
    }
    let trend = cross / square * samples.len() as f64;
    println!(
        "energy error over the energy of the motion ({scale:.2} J): first tenth {first:.2e}, last tenth {last:.2e}, \
         least-squares change over the run {trend:.1e} ({:.1e} per step)",
        trend / STEPS as f64
    );
    assert!(last <= GROWTH * first, "first tenth {first:.2e}, last tenth {last:.2e}");
    assert!(trend.abs() <= TREND * first, "least-squares change {trend:.2e} of amplitude {first:.2e}");
}
