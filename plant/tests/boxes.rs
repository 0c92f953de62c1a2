//! A box on the ground: rest, friction, impact, tipping, rocking. What is checked has a closed form; tolerances allow for the compliance
//! of the ground and one step of time.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::{BoxWorld, FLAT_BOX, GRAVITY, TALL_BOX, corners};
use delmpc_mechanics::prelude::*;
use delmpc_plant::contact_step::{ContactOptions, ContactStep};
use delmpc_plant::random::Random;
use delmpc_plant::terrain::{Terrain, TerrainBox};

const MASS: f64 = 10.0;

#[test]
fn a_resting_box_stays_for_ten_seconds_without_the_cone_solver() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.6, 1e-3, false);
    let start = world.state.base_pose.translation;
    let (mut height, mut late_solves, mut rounds, mut iterations) = (0.0f64, 0, 0, 0);
    for step in 0..10_000 {
        let report = world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        assert!(report.converged);
        height = height.max((world.state.base_pose.translation.z - start.z).abs());
        if step >= 5 {
            late_solves += report.cone_solves + report.newton_solves;
            rounds += report.rounds;
            iterations += report.iterations;
        }
    }
    let slip = (world.state.base_pose.translation - start).xy().norm();
    let (angular, linear) = world.velocity();
    let speed = angular.norm().max(linear.norm());
    println!(
        "height {height:.1e} m, slip {slip:.1e} m, speed {speed:.1e} m/s, {:.3} rounds, {:.2} iterations",
        f64::from(rounds as u32) / 9995.0,
        f64::from(iterations as u32) / 9995.0
    );
    assert!(height < 1e-8 && slip < 1e-9 && speed < 1e-9);
    assert_eq!(late_solves, 0);
}

/// Displacement along x after `seconds` under a horizontal push at the centre, as a share of the friction limit.
fn pushed(share: f64, seconds: f64) -> f64 {
    let mut world = BoxWorld::new(FLAT_BOX, 0.6, 1e-3, false);
    for _ in 0..200 {
        world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
    }
    let start = world.state.base_pose.translation.x;
    let push = world.push(Vector3::x() * (share * 0.6 * MASS * GRAVITY), Vector3::zeros());
    for _ in 0..(seconds / 1e-3).round() as usize {
        world.contact.step(&world.tree, &mut world.state, &[], &[push]).unwrap();
    }
    world.state.base_pose.translation.x - start
}

#[test]
fn the_friction_limit_is_sharp() {
    let below = pushed(0.99, 2.0);
    let above = pushed(1.01, 2.0);
    let expected = 0.5 * 0.01 * 0.6 * GRAVITY * 4.0;
    println!(
        "at 0.99: {below:.1e} m; at 1.01: {above} m, expected {expected} m ({:.1e})",
        above / expected - 1.0
    );
    assert!(below.abs() < 5e-8);
    assert!((above / expected - 1.0).abs() < 1e-3);
}

#[test]
fn a_sliding_box_stops_where_coulomb_says_and_is_not_lifted() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.5, 1e-3, false);
    world.set_velocity(Vector3::zeros(), Vector3::x());
    let (mut lift, mut residual, mut cone, mut newton) = (0.0f64, 0.0f64, 0, 0);
    for _ in 0..400 {
        let report = world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        lift = lift.max((world.state.base_pose.translation.z - 0.1).abs());
        residual = residual.max(report.law_residual);
        cone += report.cone_solves;
        newton += report.newton_solves;
    }
    let expected = 1.0 / (2.0 * 0.5 * GRAVITY);
    let error = world.state.base_pose.translation.x / expected - 1.0;
    println!(
        "distance {error:.1e}, lift {lift:.1e} m, residual {residual:.1e}, {cone} cone, {newton} Newton"
    );
    assert!(error.abs() < 1e-4 && lift < 1e-6 && residual < 1e-8);
    let (_, linear) = world.velocity();
    assert!(linear.norm() < 1e-9);
}

#[test]
fn a_spinning_sliding_box_is_not_lifted() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.5, 1e-3, false);
    world.set_velocity(Vector3::z() * 3.0, Vector3::new(1.0, 0.4, 0.0));
    let (mut lift, mut unconverged) = (0.0f64, 0);
    for _ in 0..600 {
        let report = world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        lift = lift.max((world.state.base_pose.translation.z - 0.1).abs());
        unconverged += u32::from(!report.converged);
    }
    println!("lift {lift:.1e} m, {unconverged} steps not converged");
    assert!(lift < 1e-6 && unconverged < 5);
    let (angular, linear) = world.velocity();
    assert!(angular.norm() < 1e-8 && linear.norm() < 1e-8);
}

#[test]
fn dropped_boxes_gain_no_energy_and_come_to_rest() {
    let mut random = Random::new(20, 0);
    let (mut worst_penetration, mut worst_gain, mut worst_speed, mut worst_residual) =
        (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let (mut solves, mut steps, mut unconverged, mut rounds) = (0, 0, 0, 0);
    for case in 0..20 {
        let mut world = BoxWorld::new(FLAT_BOX, 0.6, 1e-3, true);
        let turn = Vector3::from_fn(|_, _| random.between(-0.4, 0.4));
        world.state.base_pose.rotation = delmpc_mechanics::spatial::exp_rotation(&turn);
        world.state.base_pose.translation.z = 0.264;
        let energy_start = MASS * GRAVITY * 0.264;
        let mut energy = world.energy();
        for _ in 0..1800 {
            let report = world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
            let next = world.energy();
            worst_gain = worst_gain.max((next - energy) / energy_start);
            energy = next;
            worst_penetration = worst_penetration.max(-world.lowest_corner());
            worst_residual = worst_residual.max(report.law_residual);
            solves += report.cone_solves;
            rounds += report.rounds;
            unconverged += u32::from(!report.converged);
            steps += 1;
        }
        let (angular, linear) = world.velocity();
        let speed = angular.norm().max(linear.norm());
        worst_speed = worst_speed.max(speed);
        assert!(speed < 1e-8, "case {case}: {speed}");
    }
    println!(
        "penetration {worst_penetration:.1e} m, gain {worst_gain:.1e} of E0, speed {worst_speed:.1e} m/s, residual \
         {worst_residual:.1e}; {:.2} rounds, {solves} cone programs and {unconverged} unconverged in {steps} steps",
        rounds as f64 / f64::from(steps)
    );
    assert!(worst_penetration < 5e-6 && worst_gain < 5e-6);
    assert!(unconverged * 100 < steps);
}

/// Whether a tall box tips within a second under a constant push at its centre.
fn tips(share: f64, dt: f64) -> bool {
    let mut world = BoxWorld::new(TALL_BOX, 0.6, dt, false);
    let force = share * MASS * GRAVITY * 0.1 / 0.3;
    for _ in 0..(1.0 / dt).round() as usize {
        let push = world.push(Vector3::x() * force, Vector3::zeros());
        world.contact.step(&world.tree, &mut world.state, &[], &[push]).unwrap();
        if world.state.base_pose.rotation[(2, 2)] < (0.05f64).cos() {
            return true;
        }
    }
    world.state.base_pose.rotation[(0, 2)].abs() > 1e-3
}

#[test]
fn the_tipping_threshold_is_that_of_statics() {
    for dt in [1e-3, 5e-3] {
        let (mut low, mut high) = (0.98, 1.02);
        assert!(!tips(low, dt) && tips(high, dt));
        while high - low > 1e-4 {
            let middle = 0.5 * (low + high);
            if tips(middle, dt) { high = middle } else { low = middle }
        }
        println!("dt {dt}: tips at {high:.4} of the static limit");
        assert!((high - 1.0).abs() < 2e-3);
    }
}

/// Share of the kinetic energy that the first impact of a rocking box leaves.
fn rocking_ratio(dt: f64) -> f64 {
    let mut world = BoxWorld::new(TALL_BOX, 1.0, dt, false);
    // Standing on the edge x = +0.1, tilted by 0.1 rad.
    let tilt = 0.1f64;
    let rotation = delmpc_mechanics::spatial::exp_rotation(&(Vector3::y() * tilt));
    world.state.base_pose.rotation = rotation;
    world.state.base_pose.translation = Vector3::new(0.1, 0.0, 0.0) - rotation * Vector3::new(0.1, 0.0, -0.3);
    let level = MASS * GRAVITY * 0.3;
    let mut before = world.energy() - level;
    let mut impact = None;
    for step in 0..(1.0 / dt) as usize {
        world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        let other_edge = world.contact.results()[..2].iter().any(|result| result.touching);
        match impact {
            None if other_edge => impact = Some(step),
            None => before = world.energy() - level,
            Some(at) if step as f64 * dt > at as f64 * dt + 0.02 => return (world.energy() - level) / before,
            Some(_) => {}
        }
    }
    panic!("no impact");
}

#[test]
fn a_rocking_box_loses_what_housner_says() {
    let slimness = (0.1f64 / 0.3).atan();
    let expected = (1.0 - 1.5 * slimness.sin().powi(2)).powi(2);
    let errors = [1e-3, 5e-4, 2.5e-4].map(|dt| 1.0 - rocking_ratio(dt) / expected);
    println!("energy kept in the first impact against {expected:.4}: {errors:.4?}");
    assert!(errors[0].abs() < 0.04);
    assert!((0.3..0.75).contains(&(errors[1] / errors[0])) && (0.3..0.75).contains(&(errors[2] / errors[1])));
}

#[test]
fn the_pressure_point_is_that_of_statics() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.6, 1e-3, false);
    let push = world.push(Vector3::new(20.0, 10.0, 0.0), Vector3::new(0.0, 0.0, 0.05));
    for _ in 0..100 {
        world.contact.step(&world.tree, &mut world.state, &[], &[push]).unwrap();
    }
    let wrench = world.contact.wrench_w(&[0, 1, 2, 3]);
    let point = [-wrench.torque.y / wrench.force.z, wrench.torque.x / wrench.force.z];
    let expected = [20.0 * 0.15 / (MASS * GRAVITY), 10.0 * 0.15 / (MASS * GRAVITY)];
    let error = (point[0] - expected[0]).hypot(point[1] - expected[1]);
    println!("pressure point off by {error:.1e} m, force by {:.1e} N", wrench.force.z - MASS * GRAVITY);
    assert!(error < 1e-7);
}

#[test]
fn momentum_is_balanced_in_every_step() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.6, 1e-3, true);
    world.state.base_pose.rotation = delmpc_mechanics::spatial::exp_rotation(&Vector3::new(0.2, 0.3, 0.25));
    world.state.base_pose.translation.z = 0.25;
    world.set_velocity(Vector3::new(0.3, 1.0, -0.5), Vector3::new(0.5, 0.0, -1.0));
    let all: Vec<usize> = (0..8).collect();
    let mut worst = 0.0f64;
    for _ in 0..600 {
        let before = world.state.p.clone();
        world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        let wrench = world.contact.wrench_w(&all);
        let del = world.contact.del();
        let weight = Vector3::z() * (-MASS * GRAVITY);
        let mut torque = wrench.torque;
        for (alpha, w) in del.rule().weights().iter().enumerate() {
            torque += del.body_pose(0, alpha).translation.cross(&weight) * *w;
        }
        let force = wrench.force + weight;
        for k in 0..3 {
            worst = worst.max((world.state.p[k] - before[k] - torque[k] * 1e-3).abs());
            worst = worst.max((world.state.p[3 + k] - before[3 + k] - force[k] * 1e-3).abs());
        }
    }
    println!("momentum balance {worst:.1e} N s (m)");
    assert!(worst < 1e-10);
}

#[test]
fn a_box_rests_on_a_box_and_falls_into_a_gap() {
    let size = Vector3::from(FLAT_BOX);
    let tree = common::box_tree(MASS, size);
    let step =
        TerrainBox { center: Vector3::new(0.0, 0.0, 0.1), half_size: Vector3::new(1.0, 1.0, 0.1), yaw: 0.4 };
    let terrain = Terrain {
        plane_height: Some(0.0),
        boxes: vec![step],
        gaps: vec![delmpc_plant::terrain::TerrainGap { min: [4.0, -1.0], max: [6.0, 1.0] }],
        ..Terrain::default()
    };
    let points = corners(size, 0.6, false);
    for (x, landed) in [(0.0, Some(0.3)), (3.0, Some(0.1)), (5.0, None)] {
        let options = ContactOptions::default();
        let mut contact = ContactStep::new(&tree, 1e-3, &points, terrain.clone(), options).unwrap();
        let mut state = State::zeros(&tree);
        state.base_pose.translation = Vector3::new(x, 0.0, 0.35);
        for _ in 0..600 {
            contact.step(&tree, &mut state, &[], &[]).unwrap();
        }
        let z = state.base_pose.translation.z;
        match landed {
            Some(height) => assert!((z - height).abs() < 1e-6, "{x}: {z}"),
            None => assert!(z < -1.0, "{x}: {z}"),
        }
    }
}

#[test]
fn a_frictionless_box_keeps_its_speed() {
    let mut world = BoxWorld::new(FLAT_BOX, 0.0, 1e-3, false);
    world.set_velocity(Vector3::zeros(), Vector3::x());
    for _ in 0..500 {
        assert!(world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap().converged);
    }
    assert!((world.state.base_pose.translation.x - 0.5).abs() < 1e-9);
    assert!((world.state.base_pose.translation.z - 0.1).abs() < 1e-8);
}
