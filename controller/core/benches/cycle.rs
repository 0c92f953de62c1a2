//! Time of one control cycle and of its parts: Atlas, 20 stages over 1 s, all constraints, one core.
//!
//! `cargo bench -p delmpc-controller-core --bench cycle`, numbers of stages as arguments. The robot stands on a welded foot, is pushed, and recovers; cycles with and
//! without active constraints are counted apart. `riccati` includes the rows that were active before, `total` what was prepared ahead, `feedback` does not. Medians in
//! µs; times depend on the machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/atlas/mod.rs"]
mod atlas;

use std::time::Instant;

use atlas::{WeldedPlant, atlas};
use delmpc_controller_core::prelude::*;
use delmpc_mechanics::forces::PointForce;
use nalgebra::Vector3;

struct Wall(Instant);

impl Clock for Wall {
    fn now_ns(&self) -> u64 {
        self.0.elapsed().as_nanos() as u64
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn main() {
    println!(
        "stages  constraints   cycles   state in    shift  linearise   riccati       qp   feedback    total (least)   active rows"
    );
    let atlas = atlas();
    let asked: Vec<usize> = std::env::args().filter_map(|argument| argument.parse().ok()).collect();
    for stages in if asked.is_empty() { vec![10, 20, 40] } else { asked } {
        let config = ControllerConfig {
            stages: ControllerConfig::stages_for(1.0, stages, 0.005),
            ..ControllerConfig::default()
        };
        let mut controller = Controller::new(atlas.controller_model(), config).unwrap();
        let mut plant = WeldedPlant::new(&atlas);
        let torso = atlas.rooted.model.link("utorso").unwrap().body.unwrap();
        let clock = Wall(Instant::now());
        let mut cycles: [Vec<[f64; 8]>; 2] = Default::default();
        for cycle in 0..400 {
            let state = plant.measure();
            let command = *controller.cycle(&state, state.time_ns, &clock);
            let report = command.report;
            let times = [
                report.state_in_ns,
                report.shift_ns,
                report.linearize_ns,
                report.riccati_ns,
                report.qp_ns,
                report.total_ns - report.shift_ns - report.linearize_ns - report.riccati_ns,
                report.total_ns,
            ];
            controller.prepare(&clock);
            let mut row = [0.0; 8];
            for (cell, ns) in row.iter_mut().zip(times) {
                *cell = ns as f64 * 1e-3;
            }
            row[7] = f64::from(report.active_rows);
            if cycle >= 20 {
                cycles[usize::from(report.active_rows > 0)].push(row);
            }
            plant.command = Some(command);
            // A push of 28 N·s to the left every second.
            let pushed = cycle % 200 >= 50 && cycle % 200 < 70;
            plant.push = pushed.then(|| PointForce {
                body: torso,
                point_b: Vector3::zeros(),
                force_w: Vector3::new(0.0, 280.0, 0.0),
            });
            for _ in 0..5 {
                plant.step();
            }
        }
        for (kind, rows) in ["inactive", "active"].iter().zip(&cycles) {
            let mut columns: Vec<Vec<f64>> =
                (0..8).map(|c| rows.iter().map(|row| row[c]).collect()).collect();
            let m: Vec<f64> = columns.iter_mut().map(|column| median(column)).collect();
            let least = columns[6].first().copied().unwrap_or(f64::NAN);
            println!(
                "{stages:6}  {kind:11} {:8} {:10.0} {:8.0} {:10.0} {:9.0} {:8.0} {:10.0} {:8.0} ({least:5.0}) {:10.0}",
                rows.len(),
                m[0],
                m[1],
                m[2],
                m[3],
                m[4],
                m[5],
                m[6],
                m[7]
            );
        }
    }
}
