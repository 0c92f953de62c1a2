//! Time of the stage-parallel linearisation of a horizon: Atlas rooted at its foot (30 joints), 20 stages, one core.
//!
//! `cargo bench -p delmpc-mechanics --bench stage_batch [-- avx512|avx2|portable]`. Every figure is the median of many calls, in
//! brackets that of the fastest tenth (what the machine does when nobody else uses it); the scalar path (solve and linearise a
//! stage) is there for comparison. Times depend on the machine: quote them with it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/oracle/mod.rs"]
mod oracle;

use std::hint::black_box;
use std::time::Instant;

use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::stage_batch::{InstructionSet, StageBatch, StageInput, TransitionSlice};

const STAGES: usize = 20;

/// Median time of one call and that of the fastest tenth, µs.
fn time(mut call: impl FnMut()) -> String {
    let mut runs: Vec<f64> = (0..3000)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    runs.sort_by(f64::total_cmp);
    format!("{:.1} ({:.1})", runs[runs.len() / 2], runs[runs.len() / 20])
}

fn pseudo_random(n: usize, seed: usize, scale: f64) -> Vec<f64> {
    (0..n).map(|k| scale * (((seed * n + k) as f64 + 1.0) * 12.9898).sin()).collect()
}

fn main() {
    let case = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let tree = &case.tree;
    let n = tree.dof();
    let rule = LobattoRule::new(2).unwrap();
    let rates: Vec<Vec<f64>> = (0..STAGES).map(|k| pseudo_random(n, k, 0.3)).collect();
    let mut kinematics = Kinematics::new(tree);
    kinematics.update_positions(tree, &Configuration::fixed(&case.state.q)).unwrap();
    let mut weight = vec![0.0; n];
    gravity_force_into(tree, &kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut weight).unwrap();
    let forces: Vec<Vec<f64>> = (0..STAGES)
        .map(|k| weight.iter().zip(pseudo_random(n, k + 50, 0.1)).map(|(g, push)| g + push).collect())
        .collect();
    let time_step = |k: usize| 0.01 + 0.001 * k as f64;
    let node = |k: usize, c: f64| -> Vec<f64> {
        case.state.q.iter().zip(&rates[k]).map(|(q, v)| q + c * time_step(k) * v).collect()
    };
    let nodes: Vec<[Vec<f64>; 3]> = (0..STAGES).map(|k| [0.0, 0.5, 1.0].map(|c| node(k, c))).collect();
    // As the controller's transitions lie in memory.
    let row = 3 * n + 4;
    let stage = 2 * n * row;
    let mut values = vec![0.0; STAGES * stage];
    println!("Atlas, foot-rooted, n = {n}, µs for all {STAGES} stages");
    let only = std::env::args().skip(1).find(|arg| !arg.starts_with("--"));
    for set in [InstructionSet::Avx512, InstructionSet::Avx2, InstructionSet::Portable] {
        if only.as_ref().is_some_and(|only| *only != format!("{set:?}").to_lowercase()) {
            continue;
        }
        let Ok(mut batch) = StageBatch::with_instructions(tree, &rule, STAGES, set) else { continue };
        let set_all = |batch: &mut StageBatch| {
            for k in 0..STAGES {
                let [a, b, c] = &nodes[k];
                let input = StageInput {
                    nodes: [a, b, c],
                    rate: &rates[k],
                    force: &forces[k],
                    time_step: time_step(k),
                };
                batch.set_stage(k, &input).unwrap();
            }
        };
        let set_time = time(|| set_all(&mut batch));
        let linearize = time(|| {
            let mut output =
                TransitionSlice { values: &mut values, stage_stride: stage, row_stride: row, first_state: n };
            batch.linearize(&mut output).unwrap();
            black_box(&values);
        });
        (0..STAGES).for_each(|k| assert!(batch.outcome(k).is_ok()));
        let moved = time(|| {
            for k in 0..STAGES {
                batch.set_deviation(k, &forces[k], &rates[k], &rates[k]).unwrap();
            }
            batch.move_interior();
        });
        set_all(&mut batch);
        let iterate = time(|| batch.iterate(1));
        println!(
            "  {set:?}: linearise {linearize}, Newton iteration {iterate}, set {set_time}, move interior {moved}"
        );
    }
    if only.is_some() {
        return;
    }

    let mut integrator = Integrator::new(tree, &rule, 0.02, StepOptions::default()).unwrap();
    let mut linearizer =
        Linearizer::new(tree, &integrator, StateCoordinates::Velocity, InputHold::Held).unwrap();
    let mut state = State::zeros(tree);
    let scalar = time(|| {
        state.q.copy_from_slice(&nodes[0][0]);
        integrator.velocities().set_velocity(tree, &mut state, &rates[0]).unwrap();
        integrator.solve(tree, &state, &StepForces::held(&forces[0])).unwrap();
        black_box(linearizer.linearize(tree, &mut integrator).unwrap());
    });
    println!("  one stage solved and linearised by itself: {scalar}");
}
