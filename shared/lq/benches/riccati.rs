//! Time of the Riccati recursion and of its parts for Atlas' sizes: 60 states, 30 inputs, 20 stages.
//!
//! `cargo bench -p delmpc-lq --bench riccati`. Median and least of many calls; times depend on the machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/random_problem/mod.rs"]
mod random_problem;

use std::hint::black_box;
use std::time::Instant;

use delmpc_lq::lq_problem::LqSize;
use delmpc_lq::riccati::Riccati;
use delmpc_lq::trajectory::Trajectory;
use random_problem::{Limits, problem};

/// Median and least time of a call, µs.
fn time(mut call: impl FnMut()) -> (f64, f64) {
    let mut calls: Vec<f64> = (0..400)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    calls.sort_by(f64::total_cmp);
    (calls[calls.len() / 2], calls[0])
}

fn main() {
    println!("stages  factorise µs (least)   GFLOP/s   rollout µs");
    for stages in [5, 10, 20, 40] {
        let size = LqSize { states: 60, inputs: 30, stages, outputs: 0, rows: 0, residuals: 15, squares: 0 };
        let problem = problem(1, size, Limits::NONE);
        let mut riccati = Riccati::new(size);
        let mut trajectory = Trajectory::new(size);
        let (factorise, least) = time(|| riccati.factorise(black_box(&problem)).unwrap());
        let (rollout, _) = time(|| riccati.rollout(black_box(&problem), None, &mut trajectory));
        // Products with P and of both triangles, the factor, two triangular solves.
        let flops = 2.0 * 60.0 * 60.0 * 90.0
            + 90.0 * 91.0 * 60.0
            + 30f64.powi(3) / 3.0
            + 2.0 * 30.0 * 30.0 * 60.0
            + 60.0 * 61.0 * 30.0;
        println!(
            "{stages:6} {factorise:12.0} ({least:6.0}) {:10.1} {rollout:12.1}",
            flops * stages as f64 / factorise * 1e-3
        );
    }
}
