//! The layout of every payload, pinned. When a test here fails, the layout changed: bump `VERSION` and the version in `NAME` (and in
//! `type_name`), then write the new numbers down.

use std::mem::{align_of, offset_of, size_of};

use delmpc_messages::{
    Command, CycleReport, FootReading, Header, Heartbeat, MAX_FEET, MAX_JOINTS, MAX_SEGMENTS, Message,
    PlantState, Segment, StateEstimate,
};

#[test]
fn header_v1() {
    assert_eq!((size_of::<Header>(), align_of::<Header>()), (40, 8));
    assert_eq!(offset_of!(Header, magic), 0);
    assert_eq!(offset_of!(Header, version), 4);
    assert_eq!(offset_of!(Header, joint_set_hash), 8);
    assert_eq!(offset_of!(Header, run_id), 16);
    assert_eq!(offset_of!(Header, sequence), 24);
    assert_eq!(offset_of!(Header, sent_at_ns), 32);
}

#[test]
fn plant_state_v2() {
    assert_eq!(PlantState::VERSION, 2);
    assert_eq!((MAX_JOINTS, MAX_FEET), (32, 8));
    assert_eq!((size_of::<PlantState>(), align_of::<PlantState>()), (1496, 8));
    assert_eq!(offset_of!(PlantState, header), 0);
    assert_eq!(offset_of!(PlantState, time_ns), 40);
    assert_eq!(offset_of!(PlantState, applied_command_sequence), 48);
    assert_eq!(offset_of!(PlantState, clock), 56);
    assert_eq!(offset_of!(PlantState, n_joints), 60);
    assert_eq!(offset_of!(PlantState, n_feet), 64);
    assert_eq!(offset_of!(PlantState, sensors), 68);
    assert_eq!(offset_of!(PlantState, status_flags), 72);
    assert_eq!(offset_of!(PlantState, watchdog_level), 76);
    assert_eq!(offset_of!(PlantState, position), 80);
    assert_eq!(offset_of!(PlantState, velocity), 336);
    assert_eq!(offset_of!(PlantState, applied_torque), 592);
    assert_eq!(offset_of!(PlantState, imu_angle), 848);
    assert_eq!(offset_of!(PlantState, imu_velocity), 872);
    assert_eq!(offset_of!(PlantState, imu_angular_velocity), 896);
    assert_eq!(offset_of!(PlantState, imu_specific_force), 920);
    assert_eq!(offset_of!(PlantState, feet), 944);
    assert_eq!(offset_of!(PlantState, base_position_w), 1392);
    assert_eq!(offset_of!(PlantState, base_orientation_w), 1416);
    assert_eq!(offset_of!(PlantState, base_angular_velocity_b), 1448);
    assert_eq!(offset_of!(PlantState, base_linear_velocity_b), 1472);
}

#[test]
fn foot_reading_v1() {
    assert_eq!((size_of::<FootReading>(), align_of::<FootReading>()), (56, 8));
    assert_eq!(offset_of!(FootReading, flags), 0);
    assert_eq!(offset_of!(FootReading, torque_s), 8);
    assert_eq!(offset_of!(FootReading, force_s), 32);
}

#[test]
fn segment_v2() {
    assert_eq!((size_of::<Segment>(), align_of::<Segment>()), (1616, 8));
    assert_eq!(offset_of!(Segment, begin_ns), 0);
    assert_eq!(offset_of!(Segment, torque), 8);
    assert_eq!(offset_of!(Segment, torque_lower), 264);
    assert_eq!(offset_of!(Segment, torque_upper), 520);
    assert_eq!(offset_of!(Segment, position_ref), 776);
    assert_eq!(offset_of!(Segment, velocity_ref), 1032);
    assert_eq!(offset_of!(Segment, acceleration_ref), 1288);
    assert_eq!(offset_of!(Segment, imu_angle_ref), 1544);
    assert_eq!(offset_of!(Segment, imu_rate_ref), 1568);
    assert_eq!(offset_of!(Segment, imu_acceleration_ref), 1592);
}

#[test]
fn command_v4() {
    assert_eq!((Command::VERSION, MAX_SEGMENTS), (4, 8));
    assert_eq!((size_of::<Command>(), align_of::<Command>()), (31_904, 8));
    assert_eq!(offset_of!(Command, header), 0);
    assert_eq!(offset_of!(Command, state_sequence), 40);
    assert_eq!(offset_of!(Command, state_time_ns), 48);
    assert_eq!(offset_of!(Command, valid_from_ns), 56);
    assert_eq!(offset_of!(Command, valid_until_ns), 64);
    assert_eq!(offset_of!(Command, n_joints), 72);
    assert_eq!(offset_of!(Command, verdict), 76);
    assert_eq!(offset_of!(Command, fallback_level), 80);
    assert_eq!(offset_of!(Command, reason), 84);
    assert_eq!(offset_of!(Command, n_segments), 88);
    assert_eq!(offset_of!(Command, rate_samples), 92);
    assert_eq!(offset_of!(Command, segments), 96);
    assert_eq!(offset_of!(Command, gain), 13_024);
    assert_eq!(offset_of!(Command, imu_gain), 29_408);
    assert_eq!(offset_of!(Command, imu_rate_bias), 30_944);
    assert_eq!(offset_of!(Command, load_foot), 30_968);
    assert_eq!(offset_of!(Command, full_load_n), 31_096);
    assert_eq!(offset_of!(Command, unloaded_stiffness), 31_160);
    assert_eq!(offset_of!(Command, unloaded_damping), 31_416);
    assert_eq!(offset_of!(Command, report), 31_672);
    assert_eq!(offset_of!(Command, estimate), 31_768);
}

#[test]
fn state_estimate_v1() {
    assert_eq!((size_of::<StateEstimate>(), align_of::<StateEstimate>()), (136, 8));
    assert_eq!(offset_of!(StateEstimate, known), 0);
    assert_eq!(offset_of!(StateEstimate, feet_loaded), 4);
    assert_eq!(offset_of!(StateEstimate, base_orientation_w), 8);
    assert_eq!(offset_of!(StateEstimate, base_angular_velocity_b), 40);
    assert_eq!(offset_of!(StateEstimate, base_linear_velocity_b), 64);
    assert_eq!(offset_of!(StateEstimate, gyro_bias), 88);
    assert_eq!(offset_of!(StateEstimate, accelerometer_bias), 112);
}

#[test]
fn cycle_report_v1() {
    assert_eq!((size_of::<CycleReport>(), align_of::<CycleReport>()), (96, 8));
    assert_eq!(offset_of!(CycleReport, state_in_ns), 0);
    assert_eq!(offset_of!(CycleReport, shift_ns), 8);
    assert_eq!(offset_of!(CycleReport, linearize_ns), 16);
    assert_eq!(offset_of!(CycleReport, riccati_ns), 24);
    assert_eq!(offset_of!(CycleReport, qp_ns), 32);
    assert_eq!(offset_of!(CycleReport, publish_ns), 40);
    assert_eq!(offset_of!(CycleReport, total_ns), 48);
    assert_eq!(offset_of!(CycleReport, worst_violation), 56);
    assert_eq!(offset_of!(CycleReport, worst_constraint), 64);
    assert_eq!(offset_of!(CycleReport, worst_stage), 68);
    assert_eq!(offset_of!(CycleReport, worst_row), 72);
    assert_eq!(offset_of!(CycleReport, qp_solves), 76);
    assert_eq!(offset_of!(CycleReport, qp_iterations), 80);
    assert_eq!(offset_of!(CycleReport, active_rows), 84);
    assert_eq!(offset_of!(CycleReport, dropped_rows), 88);
    assert_eq!(offset_of!(CycleReport, allocations), 92);
}

#[test]
fn heartbeat_v1() {
    assert_eq!(Heartbeat::VERSION, 1);
    assert_eq!((size_of::<Heartbeat>(), align_of::<Heartbeat>()), (64, 8));
    assert_eq!(offset_of!(Heartbeat, header), 0);
    assert_eq!(offset_of!(Heartbeat, time_ns), 40);
    assert_eq!(offset_of!(Heartbeat, role), 48);
    assert_eq!(offset_of!(Heartbeat, pid), 52);
    assert_eq!(offset_of!(Heartbeat, state), 56);
    assert_eq!(offset_of!(Heartbeat, fault_code), 60);
}

#[test]
fn names_end_with_the_version_and_magic_words_differ() {
    fn check<M: Message>() -> u32 {
        assert!(M::NAME.ends_with(&format!("/v{}", M::VERSION)), "{} is version {}", M::NAME, M::VERSION);
        M::MAGIC
    }
    let magic = [check::<PlantState>(), check::<Command>(), check::<Heartbeat>()];
    assert!(magic[0] != magic[1] && magic[1] != magic[2] && magic[2] != magic[0]);
}

/// The name the shared memory knows must be the one the rest of the program knows.
#[cfg(feature = "shared_memory")]
#[test]
#[allow(unsafe_code)]
fn shared_memory_names_are_the_message_names() {
    use iceoryx2::prelude::ZeroCopySend;
    // SAFETY: `type_name` is unsafe only as a promise that equal names mean equal layouts; the tests above pin them.
    let names = unsafe {
        [
            <PlantState as ZeroCopySend>::type_name(),
            <Command as ZeroCopySend>::type_name(),
            <Heartbeat as ZeroCopySend>::type_name(),
        ]
    };
    assert_eq!(names, [PlantState::NAME, Command::NAME, Heartbeat::NAME]);
}
