//! A warm cycle allocates nothing, other than Clarabel: once per solve.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;

use std::alloc::System;

use atlas::{WeldedPlant, atlas};
use delmpc_controller_core::prelude::*;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Cycles that do not count.
const WARM_UP: usize = 12;

#[test]
fn a_warm_cycle_allocates_only_inside_clarabel() {
    let atlas = atlas();
    let mut plant = WeldedPlant::new(&atlas);
    let mut controller = Controller::new(atlas.controller_model(), ControllerConfig::default()).unwrap();
    let mut solves_seen = 0;
    for cycle in 0..40 {
        let mut state = plant.measure();
        if cycle % 4 == 3 {
            // A jolt, to and fro: constraints become active.
            state.velocity[2] += if cycle % 8 == 3 { 0.4 } else { -0.4 };
        }
        let region = Region::new(ALLOCATOR);
        let command = *controller.cycle(&state, state.time_ns, &StoppedClock);
        let change = region.change();
        let solves = command.report.qp_solves as usize;
        // The first solves find out how much memory the kernels of the dense products want.
        if cycle > WARM_UP {
            let count = change.allocations + change.reallocations;
            println!("cycle {cycle}: {count} allocations, {solves} solves");
            assert!(count <= solves, "cycle {cycle}: {count} allocations, {solves} solves");
            solves_seen += solves;
        }
        plant.command = Some(command);
        for _ in 0..5 {
            plant.step();
        }
    }
    assert!(solves_seen > 0, "the QP was solved");
}
