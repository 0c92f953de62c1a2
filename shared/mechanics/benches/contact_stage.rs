//! Time of the lifted linearisation of a stage with contacts beside that of the same robot rooted at its foot (in the stage batch).
//!
//! `cargo bench -p delmpc-mechanics --bench contact_stage [-- --profile atlas|quadruped]`; `--profile` only runs one stage on all feet,
//! for a profiler. Every figure is the median of many calls, in brackets the fastest tenth.
//! Times depend on the machine: quote the ratios.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/contact_robots/mod.rs"]
mod contact_robots;
#[path = "../tests/oracle/mod.rs"]
mod oracle;
#[path = "../tests/sample_robots/mod.rs"]
mod sample_robots;

use std::hint::black_box;
use std::time::Instant;

use contact_robots::{Robot, atlas, quadruped_on};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::stage_batch::{StageBatch, StageInput, TransitionSlice};
use sample_robots::{Forces, spread};

const STAGES: usize = 20;

/// Median and fastest tenth of one call, µs.
fn time(mut call: impl FnMut()) -> [f64; 2] {
    let mut runs: Vec<f64> = (0..2000)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    runs.sort_by(f64::total_cmp);
    [runs[runs.len() / 2], runs[runs.len() / 20]]
}

/// Per stage of a batch of the robot on its foot.
fn batch(tree: &KinematicTree) -> [f64; 2] {
    let n = tree.dof();
    let mut batch = StageBatch::new(tree, &LobattoRule::new(2).unwrap(), STAGES).unwrap();
    let q = spread(n, 0.3);
    for k in 0..STAGES {
        let input =
            StageInput { nodes: [&q; 3], rate: &spread(n, 0.3), force: &spread(n, 1.0), time_step: 0.02 };
        batch.set_stage(k, &input).unwrap();
    }
    let row = 3 * n + 4;
    let mut values = vec![0.0; STAGES * 2 * n * row];
    time(|| {
        let mut output = TransitionSlice {
            values: &mut values,
            stage_stride: 2 * n * row,
            row_stride: row,
            first_state: n,
        };
        batch.linearize(black_box(&mut output)).unwrap();
    })
    .map(|t| t / STAGES as f64)
}

fn contacts(name: &str, robot: &Robot, active: &[bool], of_batch: &[f64; 2]) {
    let mut stage = robot.stage(2);
    let (mut nominal, mut end) = (stage.nominal(), robot.start.clone());
    stage.solve(&robot.tree, 0.02, active, &robot.start, &robot.u, &mut nominal, &mut end).unwrap();
    let mut lifted = stage.lifted();
    let [median, fast] = time(|| {
        stage
            .linearize(&robot.tree, 0.02, active, &robot.start, &nominal, &robot.u, &end, &mut lifted)
            .unwrap();
        black_box(&lifted);
    });
    println!(
        "{name}, {} rows: {median:.1} ({fast:.1}) µs per stage, x{:.2} (x{:.2})",
        lifted.row_count(),
        median / of_batch[0],
        fast / of_batch[1]
    );
}

fn main() {
    let atlas = atlas();
    let quadruped = quadruped_on(&[true; 4], Forces::None);
    let arguments: Vec<String> = std::env::args().collect();
    if let Some(at) = arguments.iter().position(|a| a == "--profile") {
        let small = arguments.get(at + 1).is_some_and(|name| name == "quadruped");
        let robot = if small { &quadruped } else { &atlas.robot };
        return (0..10).for_each(|_| contacts("profile", robot, &robot.active, &[1.0; 2]));
    }
    let of_batch = batch(atlas.rooted.tree());
    println!("Atlas on its foot, in a batch: {:.1} ({:.1}) µs per stage", of_batch[0], of_batch[1]);
    for active in [[false, false], [true, false], [true, true]] {
        contacts("Atlas", &atlas.robot, &active, &of_batch);
    }
    for active in [[false; 4], [true, false, false, true], [true; 4]] {
        contacts("quadruped", &quadruped, &active, &of_batch);
    }
}
