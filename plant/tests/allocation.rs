//! A warm plant step allocates nothing but what Clarabel takes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;
mod common;

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use common::{BoxWorld, FLAT_BOX};
use delmpc_plant::prelude::*;
use nalgebra::Vector3;

struct Counting;

static COUNT: AtomicU64 = AtomicU64::new(0);

#[allow(unsafe_code)]
// SAFETY: every call is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        COUNT.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        COUNT.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations Clarabel makes per cone program (404 bytes each).
const PER_CONE_PROGRAM: u64 = 1;

// One test: the counter is shared by all threads of the process.
#[test]
fn warm_steps_allocate_only_inside_clarabel() {
    let robot = atlas::load();
    let config = PlantConfig {
        sensors: SensorConfig::default(),
        actuators: ActuatorConfig { limits: atlas::limits(&robot), delay: 1e-3, ..ActuatorConfig::default() },
        ..PlantConfig::default()
    };
    let mut plant = atlas::standing(&robot, config);
    for _ in 0..200 {
        plant.step().unwrap();
    }
    let mut message = delmpc_messages::PlantState::new(1, 2, 30);
    let (before, mut cones) = (COUNT.load(Ordering::Relaxed), 0);
    for _ in 0..1000 {
        cones += u64::from(plant.step().unwrap().contact.cone_solves);
        plant.fill_state(&mut message);
    }
    let standing = COUNT.load(Ordering::Relaxed) - before;
    println!("standing: {standing} allocations, {cones} cone programs in 1000 steps");
    assert!(standing <= cones * PER_CONE_PROGRAM);

    // The first run warms the solvers of all sizes up.
    let tumble = || {
        let mut world = BoxWorld::new(FLAT_BOX, 0.5, 1e-3, true);
        let turn = Vector3::new(0.3, 0.2, 0.0);
        world.state.base_pose.rotation = delmpc_mechanics::spatial::exp_rotation(&turn);
        world.state.base_pose.translation.z = 0.3;
        world.set_velocity(Vector3::new(0.5, 1.0, 2.0), Vector3::new(1.0, 0.0, 0.0));
        world
    };
    let mut world = tumble();
    let (start, mut cones, mut before) = (world.state.clone(), 0, 0);
    for step in 0..3000 {
        if step == 1500 {
            world.state.copy_from(&start);
            (cones, before) = (0, COUNT.load(Ordering::Relaxed));
        }
        let report = world.contact.step(&world.tree, &mut world.state, &[], &[]).unwrap();
        cones += u64::from(report.cone_solves);
    }
    let tumbling = COUNT.load(Ordering::Relaxed) - before;
    println!("tumbling box: {tumbling} allocations, {cones} cone programs in 1500 steps");
    assert!(tumbling <= cones * PER_CONE_PROGRAM);
}
