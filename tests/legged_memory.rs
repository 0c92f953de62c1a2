//! A cycle of a robot on several feet takes no memory. Alone in its process: the counter is that of all threads.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;

use delmpc::plant_process::Plant;
use delmpc::robot_controller::RobotController;
use delmpc::setup::Setup;
use delmpc::simulated_robot::SimulatedRobot;
use delmpc_controller_process::controller_loop::Controller;
use delmpc_messages::{Command, PlantState};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<std::alloc::System> = &INSTRUMENTED_SYSTEM;

fn setup(scenario: &str) -> Setup {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("configs/scenarios/{scenario}.toml"));
    Setup::read(&file, &["clock=lockstep".to_owned()]).unwrap()
}

#[test]
fn a_cycle_takes_no_memory() {
    for scenario in ["atlas_walk", "littledog_trot"] {
        let setup = setup(scenario);
        let mut robot = SimulatedRobot::new(&setup).unwrap();
        let mut controller = RobotController::new(&setup).unwrap();
        let joints = setup.robot.joint_names.len() as u32;
        let mut state = Box::new(PlantState::new(0, setup.joint_set_hash(), joints));
        let mut command = Box::new(Command::new(0, setup.joint_set_hash(), joints));
        let mut with_backend = 0;
        for cycle in 0..150_u64 {
            robot.measure(&mut state);
            state.header.sequence = cycle + 1;
            state.time_ns = cycle * 10_000_000;
            let region = Region::new(ALLOCATOR);
            controller.cycle(&state, state.time_ns, &mut command);
            let taken = region.change().allocations;
            // The first cycles place the feet. Clarabel takes memory when it is called, which is seldom.
            if cycle >= 3 && taken > 0 {
                with_backend += 1;
                assert_eq!(command.reason, 0, "{scenario}: no solution in cycle {cycle}");
                assert!(command.report.qp_solves > 0, "{scenario}: {taken} allocations in cycle {cycle}");
            }
            command.header.sequence = cycle + 1;
            // It acts a cycle after its measurement.
            for _ in 0..10 {
                robot.step().unwrap();
            }
            robot.accept(&command);
        }
        assert!(with_backend <= 15, "{scenario}: {with_backend} cycles with the backend");
    }
}
