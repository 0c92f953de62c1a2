//! Atlas in the plant: standing, pushed, without torque; determinism.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;
mod common;

use std::time::Instant;

use delmpc_messages::{FallbackLevel, PlantState, status};
use delmpc_plant::prelude::*;
use nalgebra::Vector3;

#[test]
fn a_standing_robot_creeps_less_than_a_tenth_of_a_millimetre_in_ten_seconds() {
    let robot = atlas::load();
    let mut plant = atlas::standing(&robot, PlantConfig::default());
    for _ in 0..1000 {
        plant.step().unwrap();
    }
    let feet =
        |plant: &Plant| -> Vec<Vector3<f64>> { plant.contact().results().iter().map(|r| r.end_w).collect() };
    let start = feet(&plant);
    let mut times = Vec::with_capacity(10_000);
    let (mut rounds, mut iterations, mut factorizations, mut cones) = (0, 0, 0, 0);
    for _ in 0..10_000 {
        let before = Instant::now();
        let step = plant.step().unwrap();
        times.push(before.elapsed().as_secs_f64());
        rounds += step.contact.rounds;
        iterations += step.contact.iterations;
        factorizations += step.contact.factorizations;
        cones += step.contact.cone_solves;
    }
    let creep = feet(&plant).iter().zip(&start).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    times.sort_unstable_by(f64::total_cmp);
    let totals = plant.monitor().totals();
    println!(
        "creep {creep:.1e} m; penetration {:.1e} m; step p50 {:.0} us, p99 {:.0} us; per step {:.2} rounds, {:.2} \
         iterations, {:.2} factorisations, {:.3} cone programs",
        totals.max_penetration,
        times[5000] * 1e6,
        times[9900] * 1e6,
        rounds as f64 / 1e4,
        iterations as f64 / 1e4,
        factorizations as f64 / 1e4,
        f64::from(cones) / 1e4
    );
    println!("{totals:?}, balance {:.1e} J", totals.energy_balance_error());
    assert!(creep < 1e-4);
    assert!(totals.max_penetration <= 1e-4);
    assert!(totals.fall.is_none());
    assert_eq!(totals.unconverged_steps, 0);
}

#[test]
fn the_feet_carry_the_weight() {
    let robot = atlas::load();
    let mut plant = atlas::standing(&robot, PlantConfig::default());
    for _ in 0..2000 {
        plant.step().unwrap();
    }
    let weight = plant.tree().total_mass() * common::GRAVITY;
    let load: f64 = plant.monitor().reports().iter().map(|foot| foot.wrench.force.z).sum();
    assert!((load / weight - 1.0).abs() < 1e-4, "{load} of {weight}");
    for foot in plant.monitor().reports() {
        assert!(foot.touching && foot.pressure_margin.unwrap() > 0.0 && foot.touch_downs == 1);
        assert!(foot.friction_use < 0.5 && foot.tilt < 1e-3 && foot.slip < 1e-4);
    }
    assert_eq!(plant.monitor().contact_flags(), 0b11);
}

#[test]
fn without_torque_the_robot_falls() {
    let robot = atlas::load();
    let state = atlas::posture(&robot, "double_support");
    let config = PlantConfig { watchdog: WatchdogConfig::zero_torque(), ..PlantConfig::default() };
    let mut plant = Plant::new(&atlas::model(&robot, 0.8), &config, &state).unwrap();
    let mut failures = 0;
    for _ in 0..3000 {
        failures += u32::from(plant.step().is_err());
        if plant.monitor().totals().fall.is_some() {
            break;
        }
    }
    println!("{:?}, {failures} failed steps", plant.monitor().totals());
    assert_eq!(failures, 0);
    let (time, _) = plant.monitor().totals().fall.unwrap();
    assert!(time > 0.2 && time < 2.0);
    let mut message = PlantState::new(1, 2, 30);
    plant.fill_state(&mut message);
    assert!(message.has_status(status::FELL));
}

/// The largest angle a joint is beyond its range in three seconds without torque, rad; largest error of the energy balance, J.
fn beyond_the_range(robot: &delmpc_robots::RobotModel, joint_ranges: Vec<[f64; 2]>) -> (f64, f64) {
    let model = atlas::model(robot, 0.8);
    let state = atlas::posture(robot, "double_support");
    let config =
        PlantConfig { joint_ranges, watchdog: WatchdogConfig::zero_torque(), ..PlantConfig::default() };
    let mut plant = Plant::new(&model, &config, &state).unwrap();
    let (mut beyond, mut worst) = (0.0, (0, 0));
    for step in 0..3000 {
        plant.step().unwrap();
        for (joint, (q, limit)) in plant.state().q.iter().zip(&robot.limits).enumerate() {
            let now = (q - limit.upper).max(limit.lower - q);
            if now > beyond {
                (beyond, worst) = (now, (joint, step));
            }
        }
    }
    println!("{} at {} ms", robot.joint_names[worst.0], worst.1);
    let totals = plant.monitor().totals();
    println!("{beyond:.3} rad, balance {:.1e} J, {totals:?}", totals.energy_balance_error());
    assert!(totals.fall.is_some());
    (beyond, totals.energy_balance_error().abs() / totals.energy_moved)
}

#[test]
fn a_fallen_robot_does_not_bend_beyond_its_stops() {
    let robot = atlas::load();
    let ranges = robot.limits.iter().map(|limit| [limit.lower, limit.upper]).collect();
    let (free, _) = beyond_the_range(&robot, Vec::new());
    let (stopped, balance) = beyond_the_range(&robot, ranges);
    assert!(free > 0.5, "nothing to stop: {free}");
    // The ankle of the foot that the whole robot falls on; all others stay within some hundredths.
    assert!(stopped < 0.25, "{stopped}");
    assert!(balance < 1e-3, "{balance}");
}

fn push(robot: &delmpc_robots::RobotModel, impulse: f64) -> Push {
    let torso = robot.link("utorso").unwrap();
    Push {
        body: torso.body.unwrap(),
        point: torso.pose.transform_point(&Vector3::new(0.0, 0.0, 0.3)),
        direction_w: Vector3::y(),
        impulse,
        start: 0.5,
        duration: 0.1,
    }
}

#[test]
fn a_push_gives_its_impulse_and_energy_is_accounted_for() {
    let robot = atlas::load();
    let config = PlantConfig { pushes: vec![push(&robot, 5.0)], ..PlantConfig::default() };
    let mut plant = atlas::standing(&robot, config);
    let mut disturbed = 0;
    for _ in 0..1500 {
        disturbed += u32::from(plant.step().unwrap().disturbed);
    }
    let totals = plant.monitor().totals();
    println!("{totals:?}, balance {:.1e} J", totals.energy_balance_error());
    assert_eq!(disturbed, 100);
    assert!(totals.push_work.abs() > 1e-3);
    assert!(totals.energy_balance_error().abs() < 1e-3 * totals.energy_moved.max(1.0));
}

#[test]
fn a_hard_push_knocks_the_robot_over() {
    let robot = atlas::load();
    let config = PlantConfig {
        pushes: vec![push(&robot, 120.0)],
        actuators: ActuatorConfig { limits: atlas::limits(&robot), ..ActuatorConfig::default() },
        ..PlantConfig::default()
    };
    let mut plant = atlas::standing(&robot, config);
    for _ in 0..4000 {
        plant.step().unwrap();
        if plant.monitor().totals().fall.is_some() {
            break;
        }
    }
    let totals = plant.monitor().totals();
    println!(
        "{:?}; {} unconverged, penetration {:.1e} m, feet {:?}",
        totals.fall,
        totals.unconverged_steps,
        totals.max_penetration,
        plant.monitor().reports().iter().map(|foot| (foot.touch_downs, foot.slip)).collect::<Vec<_>>()
    );
    let (time, _) = totals.fall.unwrap();
    assert!(time > 0.6);
    assert!(totals.max_penetration < 1e-4);
}

fn run(seed: u64) -> (Vec<u64>, Vec<u8>) {
    let robot = atlas::load();
    let config = PlantConfig {
        sensors: SensorConfig { delay: 2e-3, ..SensorConfig::default() },
        actuators: ActuatorConfig { limits: atlas::limits(&robot), delay: 1e-3, ..ActuatorConfig::default() },
        pushes: vec![Push { start: 0.05, ..push(&robot, 10.0) }],
        seed,
        ..PlantConfig::default()
    };
    let mut plant = atlas::standing(&robot, config);
    let mut message = PlantState::new(1, 2, 30);
    let mut bytes = Vec::new();
    for _ in 0..300 {
        plant.step().unwrap();
        plant.fill_state(&mut message);
        bytes.extend_from_slice(bytemuck::bytes_of(&message));
    }
    (plant.state().p.iter().map(|p| p.to_bits()).collect(), bytes)
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let first = run(7);
    assert!(first == run(7));
    assert!(first.1 != run(8).1);
}

#[test]
fn the_message_is_valid_and_tells_what_the_sensors_tell() {
    let robot = atlas::load();
    let mut plant = atlas::standing(&robot, PlantConfig::default());
    for _ in 0..50 {
        plant.step().unwrap();
    }
    let hash = atlas::model(&robot, 0.8).joint_set_hash;
    let mut message = PlantState::new(1, hash, 30);
    plant.fill_state(&mut message);
    message.validate(hash, 30).unwrap();
    assert_eq!(message.time_ns, 50_000_000);
    assert_eq!(message.watchdog_level, FallbackLevel::StaticLqr as u32);
    assert!(message.has_status(status::WATCHDOG) && !message.has_status(status::FELL));
    assert_eq!(message.position[..30], plant.state().q);
    let pelvis = robot.posture("double_support").unwrap().base_link_pose_w.unwrap();
    let moved = Vector3::from(message.base_position_w) - pelvis.translation;
    assert!(moved.norm() < 1e-2);
}

#[test]
fn a_heavier_plant_weighs_more() {
    let robot = atlas::load();
    let errors = ModelErrors { mass_scale: 1.05, body_mass_scale: vec![(0, 1.1)], ..ModelErrors::default() };
    let tree = errors.apply(&robot.tree).unwrap();
    let base = robot.tree.bodies()[0].inertia.mass;
    let expected = 1.05 * (robot.tree.total_mass() + 0.1 * base);
    assert!((tree.total_mass() / expected - 1.0).abs() < 1e-12);
}
