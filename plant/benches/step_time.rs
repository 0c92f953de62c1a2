//! Time of one plant step of Atlas on both feet, and of its parts: `cargo bench -p delmpc-plant`.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "../tests/atlas/mod.rs"]
mod atlas;
#[path = "../tests/common/mod.rs"]
mod common;

use std::hint::black_box;
use std::time::Instant;

use delmpc_mechanics::branch_lu::BranchLu;
use delmpc_mechanics::load_response::{BoundaryMotion, LoadPoint, LoadResponse};
use delmpc_mechanics::newton_direction::NewtonDirection;
use delmpc_plant::contact_law::{ContactLaw, ContactProblem};
use delmpc_plant::prelude::*;

/// Quantiles over many calls, µs: a shared machine makes the mean meaningless.
fn time(what: &str, calls: usize, mut call: impl FnMut()) {
    let mut times: Vec<f64> = (0..calls)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    times.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| times[((calls - 1) as f64 * share) as usize];
    println!("{what:<44} p10 {:8.1}  p50 {:8.1}  p99 {:8.1} us", at(0.1), at(0.5), at(0.99));
}

/// Keeps the optimiser from leaving a call out.
fn ignore<T>(value: T) {
    let _ = black_box(value);
}

fn warm(plant: &mut Plant) {
    for _ in 0..2000 {
        ignore(plant.step());
    }
}

fn main() {
    let robot = atlas::load();
    let mut plant = atlas::standing(&robot, PlantConfig::default());
    warm(&mut plant);
    time("step, both feet, at rest", 4000, || ignore(plant.step()));
    let noisy = PlantConfig { sensors: SensorConfig::default(), ..PlantConfig::default() };
    let mut plant = atlas::standing(&robot, noisy);
    warm(&mut plant);
    let (mut rounds, mut iterations, mut factorizations, mut stick, mut cones) = (0, 0, 0, 0, 0);
    time("step, both feet, noisy servo", 4000, || {
        let report = plant.step().map(|step| step.contact).unwrap_or_default();
        rounds += report.rounds;
        iterations += report.iterations;
        factorizations += report.factorizations;
        stick += report.stick_solves;
        cones += report.cone_solves;
    });
    let each = |count: usize| count as f64 / 4000.0;
    println!(
        "  per step: {:.2} rounds, {:.2} iterations, {:.2} factorisations, {:.2} sticking, {:.3} cone programs",
        each(rounds),
        each(iterations),
        each(factorizations),
        each(stick as usize),
        each(cones as usize)
    );
    parts(&robot, &plant);
}

fn parts(robot: &delmpc_robots::RobotModel, plant: &Plant) {
    let tree = &robot.tree;
    let mut del = plant.contact().del().clone();
    let mut lu = BranchLu::new(tree, &del);
    let mut motion = BoundaryMotion::new(tree);
    let state = plant.state();
    time("DEL evaluation", 2000, || del.evaluate(tree, &[]));
    time("factorisation", 2000, || ignore(lu.factor(tree, &del)));
    let mut rhs = vec![1.0; 2 * tree.dof()];
    time("solve", 2000, || lu.solve(tree, black_box(&mut rhs)));
    time("motion at the boundary", 2000, || ignore(motion.update(tree, state)));
    let contacts = plant.contact().contacts();
    for m in [4, 8] {
        let loads: Vec<LoadPoint> = contacts[..m]
            .iter()
            .map(|c| LoadPoint { body: c.body, point_b: c.point - tree.bodies()[c.body].inertia.com })
            .collect();
        let mut response = LoadResponse::new(tree, &del, &lu, m);
        time(&format!("response of {m} contacts: solve"), 2000, || {
            ignore(response.solve(tree, &del, &mut lu, &loads));
        });
        let mut w = vec![0.0; 9 * m * m];
        // The momentum columns are used up by each call; their values do not matter for the time.
        time(&format!("response of {m} contacts: velocities"), 2000, || {
            ignore(response.velocity_response_into(tree, &mut motion, 2, &loads, &mut w));
        });
        let _ = response.solve(tree, &del, &mut lu, &loads);
        let _ = response.velocity_response_into(tree, &mut motion, 2, &loads, &mut w);
        let mut law = ContactLaw::new(m, Regularisation::default()).unwrap_or_else(|e| panic!("{e}"));
        let mut free = vec![0.0; 3 * m];
        let impulse: Vec<f64> = (0..3 * m).map(|k| if k % 3 == 2 { 1.7 / m as f64 } else { 0.0 }).collect();
        for (r, c) in free.iter_mut().enumerate() {
            *c = -(0..3 * m).map(|k| w[r * 3 * m + k] * impulse[k]).sum::<f64>();
        }
        let friction = vec![0.8; m];
        let problem = ContactProblem {
            response: &w,
            free_velocity: &free,
            friction: &friction,
            last_impulse: &impulse,
        };
        let mut found = impulse.clone();
        time(&format!("contact law of {m} contacts, sticking"), 2000, || {
            found.copy_from_slice(&impulse);
            black_box(law.solve(&problem, &mut found));
        });
    }
}
