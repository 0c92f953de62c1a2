//! Every field that can be wrong is refused by name; unused entries are not looked at; the feedback law is the documented one.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // helpers of tests, too

use delmpc_messages::{
    ClockKind, Command, ConstraintKind, FallbackLevel, FootReading, Heartbeat, LATEST_TIME_NS,
    LONGEST_VALIDITY_NS, MAX_FEET, MAX_JOINTS, Message, MessageError, PlantState, ProcessState, RateMean,
    Role, Segment, ServoReadings, Verdict, foot, joint_set_hash, sensor, status,
};

const N: usize = 3;
const HASH: u64 = joint_set_hash(&["hip", "knee", "ankle"]);
const RUN: u64 = 7;

/// With all the sensors there can be, and one foot.
fn state() -> PlantState {
    let mut state = PlantState::new(RUN, HASH, N as u32);
    state.sensors = sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS | sensor::MOTION_CAPTURE;
    state.n_feet = 1;
    state.feet[0].flags = foot::WRENCH;
    state
}

fn command() -> Command {
    let mut command = Command::new(RUN, HASH, N as u32);
    command.valid_from_ns = 1_000;
    command.valid_until_ns = 2_000;
    command
}

fn state_error(damage: impl FnOnce(&mut PlantState)) -> MessageError {
    let mut state = state();
    damage(&mut state);
    state.validate(HASH, N).expect_err("the damage must be refused")
}

fn command_error(damage: impl FnOnce(&mut Command)) -> MessageError {
    let mut command = command();
    damage(&mut command);
    command.validate(HASH, N).expect_err("the damage must be refused")
}

/// Field, index, "NaN", "infinite" or "huge" of a numeric refusal.
fn place(error: MessageError) -> (&'static str, usize, &'static str) {
    match error {
        MessageError::NotFinite { field, index, value, .. } if value.is_nan() => (field, index, "NaN"),
        MessageError::NotFinite { field, index, .. } => (field, index, "infinite"),
        MessageError::Implausible { field, index, .. } => (field, index, "huge"),
        other => panic!("not a numeric refusal: {other}"),
    }
}

const BAD: [(f64, &str); 4] =
    [(f64::NAN, "NaN"), (f64::INFINITY, "infinite"), (f64::NEG_INFINITY, "infinite"), (-1e300, "huge")];

#[test]
fn new_messages_are_valid() {
    assert_eq!(state().validate(HASH, N), Ok(()));
    assert_eq!(command().validate(HASH, N), Ok(()));
    assert_eq!(Heartbeat::new(RUN, HASH, Role::Plant, 1).validate(HASH), Ok(()));
    assert_eq!(Heartbeat::new(RUN, 0, Role::Supervisor, 1).validate(0), Ok(()));
}

#[test]
fn another_message_type_is_refused() {
    let expected = PlantState::MAGIC;
    let error = state_error(|s| s.header.magic = Command::MAGIC);
    assert_eq!(
        error,
        MessageError::WrongMagic { message: PlantState::NAME, found: Command::MAGIC, expected }
    );
    assert!(matches!(command_error(|c| c.header.magic = 0), MessageError::WrongMagic { found: 0, .. }));
}

#[test]
fn another_version_is_refused() {
    let error = state_error(|s| s.header.version = 1);
    assert_eq!(error, MessageError::WrongVersion { message: PlantState::NAME, found: 1, expected: 2 });
    assert_eq!(
        error.to_string(),
        "delmpc/PlantState/v2: version 1, expected 2: build both processes from the same source"
    );
    assert!(matches!(command_error(|c| c.header.version = 9), MessageError::WrongVersion { found: 9, .. }));
}

#[test]
fn another_joint_set_is_refused() {
    let other = joint_set_hash(&["knee", "hip", "ankle"]);
    let error = state_error(|s| s.header.joint_set_hash = other);
    assert_eq!(
        error,
        MessageError::WrongJointSet { message: PlantState::NAME, found: other, expected: HASH }
    );
    assert!(error.to_string().contains("the same robot file"), "{error}");
    assert!(matches!(
        command_error(|c| c.header.joint_set_hash = other),
        MessageError::WrongJointSet { message: Command::NAME, .. }
    ));
}

#[test]
fn another_joint_count_is_refused_also_beyond_the_capacity() {
    let error = state_error(|s| s.n_joints = 4);
    assert_eq!(error, MessageError::WrongJointCount { message: PlantState::NAME, found: 4, expected: 3 });
    assert!(matches!(command_error(|c| c.n_joints = 0), MessageError::WrongJointCount { found: 0, .. }));

    let mut too_many = state();
    too_many.n_joints = 33;
    assert!(matches!(too_many.validate(HASH, 33), Err(MessageError::WrongJointCount { .. })));
}

type StateField = (&'static str, usize, fn(&mut PlantState) -> &mut [f64]);
type CommandField = (&'static str, usize, fn(&mut Command) -> &mut f64);
type SegmentField = (&'static str, fn(&mut Segment) -> &mut [f64]);

#[test]
fn every_number_of_a_state_is_checked_by_name_and_index() {
    let fields: [StateField; 13] = [
        ("position", N, |s| &mut s.position),
        ("velocity", N, |s| &mut s.velocity),
        ("applied_torque", N, |s| &mut s.applied_torque),
        ("base_position_w", 3, |s| &mut s.base_position_w),
        ("base_orientation_w", 4, |s| &mut s.base_orientation_w),
        ("base_angular_velocity_b", 3, |s| &mut s.base_angular_velocity_b),
        ("base_linear_velocity_b", 3, |s| &mut s.base_linear_velocity_b),
        ("imu_angle", 3, |s| &mut s.imu_angle),
        ("imu_velocity", 3, |s| &mut s.imu_velocity),
        ("imu_angular_velocity", 3, |s| &mut s.imu_angular_velocity),
        ("imu_specific_force", 3, |s| &mut s.imu_specific_force),
        ("feet.torque_s", 3, |s| &mut s.feet[0].torque_s),
        ("feet.force_s", 3, |s| &mut s.feet[0].force_s),
    ];
    for (name, length, field) in fields {
        for index in 0..length {
            for (value, kind) in BAD {
                let error = state_error(|s| field(s)[index] = value);
                assert_eq!(place(error), (name, index, kind));
            }
        }
    }
}

#[test]
fn every_number_of_a_command_is_checked_by_name_and_index() {
    let fields: [SegmentField; 6] = [
        ("torque", |s| &mut s.torque),
        ("torque_lower", |s| &mut s.torque_lower),
        ("torque_upper", |s| &mut s.torque_upper),
        ("position_ref", |s| &mut s.position_ref),
        ("velocity_ref", |s| &mut s.velocity_ref),
        ("acceleration_ref", |s| &mut s.acceleration_ref),
    ];
    for (value, kind) in BAD {
        for (name, field) in fields {
            for (segment, joint) in [(0, 0), (0, 1), (0, 2), (1, 0), (2, 2)] {
                let error = command_error(|c| {
                    (c.n_segments, c.segments[1].begin_ns, c.segments[2].begin_ns) = (3, 5, 6);
                    field(&mut c.segments[segment])[joint] = value;
                });
                assert_eq!(place(error), (name, segment * MAX_JOINTS + joint, kind));
            }
        }
        for (row, column) in [(0, 0), (2, 2), (1, MAX_JOINTS), (2, MAX_JOINTS + 2)] {
            let error = command_error(|c| c.gain[row][column] = value);
            assert_eq!(place(error), ("gain", row * 2 * MAX_JOINTS + column, kind));
        }
    }
    let fields: [CommandField; 8] = [
        ("imu_gain", 7, |c| &mut c.imu_gain[1][1]),
        ("imu_rate_bias", 2, |c| &mut c.imu_rate_bias[2]),
        ("full_load_n", 1, |c| &mut c.full_load_n[1]),
        ("unloaded_stiffness", 2, |c| &mut c.unloaded_stiffness[2]),
        ("unloaded_damping", 0, |c| &mut c.unloaded_damping[0]),
        ("imu_angle_ref", 2, |c| &mut c.segments[0].imu_angle_ref[2]),
        ("imu_rate_ref", 0, |c| &mut c.segments[0].imu_rate_ref[0]),
        ("estimate.gyro_bias", 1, |c| &mut c.estimate.gyro_bias[1]),
    ];
    for (name, index, field) in fields {
        for (value, kind) in BAD {
            let error = command_error(|c| *field(c) = value);
            assert_eq!(place(error), (name, index, kind));
        }
    }
    let error = command_error(|c| c.report.worst_violation = f64::NAN);
    assert_eq!(place(error), ("report.worst_violation", 0, "NaN"));
}

#[test]
fn unused_entries_are_not_looked_at() {
    let mut state = state();
    state.position[N] = f64::NAN;
    state.feet[1].force_s[0] = f64::NAN;
    assert_eq!(state.validate(HASH, N), Ok(()));
    // Nor are sensors that are not there.
    (state.sensors, state.feet[0].flags) = (0, foot::TOUCHES);
    state.imu_angle[0] = f64::NAN;
    state.imu_specific_force[1] = f64::NAN;
    state.feet[0].torque_s[2] = f64::NAN;
    state.base_orientation_w = [f64::NAN; 4];
    assert_eq!(state.validate(HASH, N), Ok(()));

    let mut command = command();
    command.segments[0].torque[N] = f64::NAN;
    command.segments[1].torque[0] = f64::NAN;
    command.gain[N][0] = f64::NAN;
    command.gain[0][N] = f64::NAN;
    command.gain[0][MAX_JOINTS + N] = f64::NAN;
    assert_eq!(command.validate(HASH, N), Ok(()));
}

#[test]
fn a_quaternion_off_unit_length_is_refused() {
    let error = state_error(|s| s.base_orientation_w = [0.0, 0.0, 0.0, 1.01]);
    assert!(matches!(error, MessageError::NotUnit { field: "base_orientation_w", .. }), "{error}");
    let error = state_error(|s| s.base_orientation_w = [0.0; 4]);
    assert!(matches!(error, MessageError::NotUnit { squared_norm: 0.0, .. }), "{error}");
}

#[test]
fn unknown_codes_are_refused_by_name() {
    let unknown = |error| match error {
        MessageError::UnknownCode { field, value: 77, .. } => field,
        other => panic!("not an unknown code: {other}"),
    };
    assert_eq!(unknown(state_error(|s| s.clock = 77)), "clock");
    assert_eq!(unknown(state_error(|s| s.watchdog_level = 77)), "watchdog_level");
    assert_eq!(unknown(command_error(|c| c.verdict = 77)), "verdict");
    assert_eq!(unknown(command_error(|c| c.fallback_level = 77)), "fallback_level");
    assert_eq!(unknown(command_error(|c| c.report.worst_constraint = 77)), "report.worst_constraint");

    let mut heartbeat = Heartbeat::new(RUN, HASH, Role::Plant, 1);
    heartbeat.role = 77;
    assert_eq!(unknown(heartbeat.validate(HASH).unwrap_err()), "role");
    let mut heartbeat = Heartbeat::new(RUN, HASH, Role::Plant, 1);
    heartbeat.state = 77;
    assert_eq!(unknown(heartbeat.validate(HASH).unwrap_err()), "state");
}

#[test]
fn a_command_that_ends_before_it_begins_is_refused() {
    let error = command_error(|c| c.valid_until_ns = 999);
    assert_eq!(error, MessageError::EmptyInterval { message: Command::NAME, from_ns: 1_000, until_ns: 999 });
}

#[test]
fn a_command_is_valid_from_its_begin_up_to_but_not_at_its_end() {
    let command = command();
    assert!(!command.is_valid_at(999));
    assert!(command.is_valid_at(1_000));
    assert!(command.is_valid_at(1_999));
    assert!(!command.is_valid_at(2_000));
    assert!(!Command::new(RUN, HASH, N as u32).is_valid_at(0), "a new command is valid at no time");
}

#[test]
fn every_code_reads_back_as_itself_and_the_next_one_is_unknown() {
    for verdict in
        [Verdict::Ok, Verdict::Late, Verdict::Infeasible, Verdict::ModelMismatch, Verdict::BadState]
    {
        assert_eq!(Verdict::from_code(verdict as u32), Some(verdict));
    }
    assert_eq!(Verdict::from_code(5), None);
    for level in 0..=5 {
        assert_eq!(FallbackLevel::from_code(level).map(|l| l as u32), Some(level));
    }
    assert_eq!(FallbackLevel::from_code(6), None);
    for kind in 0..=7 {
        assert_eq!(ConstraintKind::from_code(kind).map(|k| k as u32), Some(kind));
    }
    assert_eq!(ConstraintKind::from_code(8), None);
    for state in 0..=5 {
        assert_eq!(ProcessState::from_code(state).map(|s| s as u32), Some(state));
    }
    assert_eq!(ProcessState::from_code(6), None);
    for role in Role::ALL {
        assert_eq!(Role::from_code(role as u32), Some(role));
    }
    assert_eq!(Role::from_code(3), None);
    assert_eq!(ClockKind::from_code(1), Some(ClockKind::Monotonic));
    assert_eq!(ClockKind::from_code(2), None);
}

#[test]
fn the_feedback_law_is_feed_forward_plus_gain_times_error() {
    let mut command = command();
    command.segments[0].torque[..N].copy_from_slice(&[1.0, 2.0, 3.0]);
    command.segments[0].position_ref[..N].copy_from_slice(&[0.1, 0.2, 0.3]);
    command.segments[0].velocity_ref[..N].copy_from_slice(&[-1.0, 0.0, 1.0]);
    command.gain[0][1] = 10.0;
    command.gain[2][MAX_JOINTS] = -4.0;
    let mut torque = [0.0; N];
    command.torque_into(0, &ServoReadings::joints(&[0.1, 0.7, 0.3], &[1.0, 0.0, 1.0]), &mut torque).unwrap();
    assert_eq!(torque, [1.0 + 10.0 * (0.7 - 0.2), 2.0, 3.0 - 4.0 * 2.0]);

    // Half a second on the reference has moved, and at the end of its time it stops.
    (command.valid_from_ns, command.valid_until_ns) = (1_000_000_000, 3_000_000_000);
    command.segments[0].velocity_ref[1] = 2.0;
    command.segments[0].acceleration_ref[..N].copy_from_slice(&[4.0, 8.0, 0.0]);
    command
        .torque_into(1_500_000_000, &ServoReadings::joints(&[0.1, 0.7, 0.3], &[1.0, 0.0, 1.0]), &mut torque)
        .unwrap();
    let moved = 0.5 * 2.0 + 0.125 * 8.0;
    assert_eq!(torque, [1.0 + 10.0 * (0.7 - 0.2 - moved), 2.0, 3.0 - 4.0 * (1.0 - (-1.0) - 0.5 * 4.0)]);
    let mut late = [0.0; N];
    command
        .torque_into(3_000_000_000, &ServoReadings::joints(&[0.1, 0.7, 0.3], &[1.0, 0.0, 1.0]), &mut torque)
        .unwrap();
    command
        .torque_into(9_000_000_000, &ServoReadings::joints(&[0.1, 0.7, 0.3], &[1.0, 0.0, 1.0]), &mut late)
        .unwrap();
    assert_eq!(torque, late);
    command.segments[0].torque_upper[0] = -3.0;
    command.torque_into(0, &ServoReadings::joints(&[0.1, 0.7, 0.3], &[1.0, 0.0, 1.0]), &mut torque).unwrap();
    assert_eq!(torque[0], -3.0);
}

#[test]
fn a_later_segment_takes_over_at_its_time_and_the_last_one_holds_to_the_end() {
    let mut command = command();
    (command.valid_from_ns, command.valid_until_ns, command.n_segments) = (1_000, 9_000, 3);
    for (k, begin_ns) in [0, 2_000, 5_000].into_iter().enumerate() {
        command.segments[k].begin_ns = begin_ns;
        command.segments[k].torque[0] = k as f64;
        command.segments[k].position_ref[0] = 10.0 * k as f64;
        command.segments[k].velocity_ref[0] = 1e9;
    }
    command.segments[3].torque[0] = f64::NAN;
    command.gain[0][0] = 1.0;
    let at = |time_ns| {
        let mut torque = [0.0; N];
        command.torque_into(time_ns, &ServoReadings::joints(&[0.0; N], &[0.0; N]), &mut torque).unwrap();
        torque[0]
    };
    // Feed-forward of the segment, less where its reference has gone since it began.
    let expected = [(0, 0.0), (2_500, -1_500.0), (2_999, -1_999.0), (3_000, 1.0 - 10.0), (6_000, 2.0 - 20.0)];
    for (time_ns, torque) in expected.into_iter().chain([(9_000, -18.0 - 3_000.0), (99_000, -18.0 - 3_000.0)])
    {
        assert!((at(time_ns) - torque).abs() < 1e-6, "{time_ns} ns: {} instead of {torque}", at(time_ns));
    }
    assert_eq!(command.segment_at(4_000).0.begin_ns, 2_000);

    // The reference that stands has no speed either.
    command.gain[0] = [0.0; 2 * MAX_JOINTS];
    command.gain[0][MAX_JOINTS] = 1.0;
    let mut torque = [0.0; N];
    for (time_ns, expected) in [(8_999, 2.0 - 1e9), (9_000, 2.0)] {
        command.torque_into(time_ns, &ServoReadings::joints(&[0.0; N], &[0.0; N]), &mut torque).unwrap();
        assert_eq!(torque[0], expected);
    }
}

#[test]
fn feet_are_counted() {
    let error = state_error(|s| s.n_feet = 1 + MAX_FEET as u32);
    assert_eq!(error, MessageError::TooManyFeet { message: PlantState::NAME, found: 9, capacity: MAX_FEET });
    let error = command_error(|c| c.load_foot[1] = 9);
    assert_eq!(error, MessageError::TooManyFeet { message: Command::NAME, found: 9, capacity: MAX_FEET });
    for samples in [0, 9] {
        let error = command_error(|c| c.rate_samples = samples);
        assert!(matches!(error, MessageError::UnknownCode { field: "rate_samples", .. }), "{error}");
    }
}

#[test]
fn the_law_feels_the_inertial_unit_and_its_bias_goes_on_beyond_the_command() {
    let mut command = command();
    (command.valid_from_ns, command.valid_until_ns) = (1_000_000_000, 2_000_000_000);
    let segment = &mut command.segments[0];
    (segment.imu_angle_ref[0], segment.imu_rate_ref[0], segment.imu_acceleration_ref[0]) = (0.3, 2.0, 4.0);
    command.imu_rate_bias[0] = 0.5;
    command.imu_gain[1] = [10.0, 0.0, 0.0, 100.0, 0.0, 0.0];
    let at = |time_ns, imu| {
        let mut torque = [0.0; N];
        let readings = ServoReadings { imu, ..ServoReadings::joints(&[0.0; N], &[0.0; N]) };
        command.torque_into(time_ns, &readings, &mut torque).unwrap();
        assert_eq!((torque[0], torque[2]), (0.0, 0.0));
        torque[1]
    };
    let imu = Some(([1.0, 7.0, 7.0], [3.0, 7.0, 7.0]));
    assert_eq!(at(1_500_000_000, None), 0.0, "without the unit its term is left out");
    let angle = 1.0 - 0.3 - (0.5 * 2.0 + 0.125 * 4.0) - 0.5 * 0.5;
    let rate = 3.0 - (2.0 + 0.5 * 4.0) - 0.5;
    assert!((at(1_500_000_000, imu) - (10.0 * angle + 100.0 * rate)).abs() < 1e-12);
    // Half a second after the end: the reference stands where it ended, the sum of the bias does not.
    let angle = 1.0 - 0.3 - (2.0 + 0.5 * 4.0) - 0.5 * 1.5;
    assert!((at(2_500_000_000, imu) - (10.0 * angle + 100.0 * (3.0 - 0.5))).abs() < 1e-12);
}

#[test]
fn what_a_foot_carries_decides_how_much_of_the_law_its_joints_get() {
    let mut command = command();
    command.segments[0].torque[..N].fill(8.0);
    command.segments[0].position_ref[..N].fill(0.1);
    (command.load_foot[1], command.full_load_n[1]) = (2, 200.0);
    (command.unloaded_stiffness[1], command.unloaded_damping[1]) = (5.0, 2.0);
    let mut feet =
        [FootReading { flags: foot::WRENCH, reserved: 0, torque_s: [0.0; 3], force_s: [0.0; 3] }; 2];
    let mut at = |load: f64, flags| {
        (feet[1].force_s[2], feet[1].flags) = (load, flags);
        let mut torque = [0.0; N];
        let readings = ServoReadings { feet: &feet, ..ServoReadings::joints(&[0.3; N], &[1.0; N]) };
        command.torque_into(0, &readings, &mut torque).unwrap();
        assert_eq!((torque[0], torque[2]), (8.0, 8.0));
        torque[1]
    };
    let held = -5.0 * (0.3 - 0.1) - 2.0;
    assert!((at(0.0, foot::WRENCH) - held).abs() < 1e-12);
    assert!((at(50.0, foot::WRENCH) - (0.25 * 8.0 + 0.75 * held)).abs() < 1e-12);
    assert_eq!((at(900.0, foot::WRENCH), at(0.0, foot::TOUCHES)), (8.0, 8.0));
    assert!((at(-30.0, foot::WRENCH) - held).abs() < 1e-12);
}

#[test]
fn rates_are_means_over_the_samples_asked_for() {
    let mut mean = RateMean::default();
    let mut take = |value: f64, samples| {
        let (velocity, rate) = mean.take(&[value, -value], &[0.0, 0.0, 2.0 * value], samples);
        assert_eq!((velocity[1], rate[2]), (-velocity[0], 2.0 * velocity[0]));
        velocity[0]
    };
    assert_eq!(
        [take(1.0, 4), take(3.0, 4), take(5.0, 1), take(7.0, 4), take(9.0, 4)],
        [1.0, 2.0, 5.0, 4.0, 6.0]
    );
    for k in 0..20 {
        take(f64::from(k), 8);
    }
    assert_eq!(take(20.0, 8), 16.5);
}

#[test]
fn segments_are_counted_and_in_order() {
    let error = command_error(|c| c.n_segments = 0);
    assert!(matches!(error, MessageError::WrongSegmentCount { found: 0, .. }));
    let error = command_error(|c| c.n_segments = 9);
    assert_eq!(
        error.to_string(),
        "delmpc/Command/v4: 9 segments, expected 1 to 8; build both processes from the same source"
    );
    let error = command_error(|c| c.segments[0].begin_ns = 1);
    assert!(error.to_string().contains("expected exactly 0 ns"), "{error}");
    let error = command_error(|c| {
        (c.n_segments, c.segments[1].begin_ns, c.segments[2].begin_ns) = (3, 70, 70);
    });
    assert!(error.to_string().contains("segment 2 begins after 70 ns, expected not before 71 ns"), "{error}");
}

#[test]
fn the_feedback_law_refuses_slices_of_another_length_and_counts_beyond_the_capacity() {
    let mut command = command();
    let mut torque = [5.0; N];
    let error =
        command.torque_into(0, &ServoReadings::joints(&[0.0; 2], &[0.0; N]), &mut torque).unwrap_err();
    assert!(matches!(error, MessageError::WrongLength { argument: "position", found: 2, expected: 3, .. }));
    assert_eq!(torque, [5.0; N], "a refused call changes nothing");

    command.n_joints = 1_000;
    let readings = ServoReadings::joints(&[0.0; 1_000], &[0.0; 1_000]);
    assert!(command.torque_into(0, &readings, &mut [0.0; 1_000]).is_err());
}

#[test]
fn status_flags_are_single_bits() {
    let all = [status::FELL, status::FINISHED, status::WATCHDOG, status::SATURATED, status::DISTURBED];
    assert_eq!(all.iter().sum::<u32>(), all.iter().fold(0, |bits, flag| bits | flag));
    let mut state = state();
    state.status_flags = status::FELL | status::SATURATED;
    assert!(state.has_status(status::FELL) && state.has_status(status::FELL | status::SATURATED));
    assert!(!state.has_status(status::FELL | status::FINISHED));
}

#[test]
fn codes_of_refusals_are_never_zero() {
    assert_eq!(state_error(|s| s.header.magic = 0).code(), 1);
    let known = |code: u32| MessageError::CODES.iter().filter(|(_, known)| *known == code).count();
    assert!((1..=MessageError::CODES.len() as u32).all(|code| known(code) == 1));
    assert_eq!(state_error(|s| s.position[0] = f64::NAN).code(), 5);
    assert_eq!(state_error(|s| s.position[0] = 1e300).code(), 6);
}

#[test]
fn times_at_the_end_of_all_numbers_and_lives_without_end_are_refused() {
    let beyond = LATEST_TIME_NS + 1;
    for (change, field) in [
        ((|c, t| c.state_time_ns = t) as fn(&mut Command, u64), "state_time_ns"),
        (|c, t| (c.valid_from_ns, c.valid_until_ns) = (t, t), "valid_from_ns"),
        (|c, t| c.valid_until_ns = t, "valid_until_ns"),
    ] {
        for time_ns in [beyond, u64::MAX] {
            let error = command_error(|c| change(c, time_ns));
            let limit_ns = LATEST_TIME_NS;
            assert_eq!(error, MessageError::TimeBeyond { message: Command::NAME, field, time_ns, limit_ns });
        }
    }
    let limit_ns = LONGEST_VALIDITY_NS;
    let error = command_error(|c| c.valid_until_ns = c.valid_from_ns + limit_ns + 1);
    assert!(matches!(error, MessageError::ValidTooLong { .. }), "{error}");
    let mut command = command();
    command.valid_until_ns = command.valid_from_ns + limit_ns;
    command.validate(HASH, N).unwrap();

    let mut state = state();
    state.time_ns = u64::MAX;
    assert!(matches!(state.validate(HASH, N), Err(MessageError::TimeBeyond { field: "time_ns", .. })));
}

#[test]
fn a_segment_at_the_end_of_all_times_is_out_of_order_or_never_in_force() {
    let error = command_error(|c| {
        c.n_segments = 3;
        (c.segments[1].begin_ns, c.segments[2].begin_ns) = (u64::MAX, u64::MAX - 1);
    });
    assert!(matches!(error, MessageError::SegmentOutOfOrder { index: 2, .. }), "{error}");
    let mut command = command();
    (command.n_segments, command.segments[1].begin_ns) = (2, u64::MAX);
    command.validate(HASH, N).unwrap();
    assert_eq!(command.segment_at(u64::MAX).0.begin_ns, 0);
}

#[test]
fn messages_of_another_run_are_told_apart() {
    let state = state();
    let run = state.header.run_id;
    state.header.validate_run::<PlantState>(run).unwrap();
    let error = state.header.validate_run::<PlantState>(run + 1).unwrap_err();
    let message = PlantState::NAME;
    assert_eq!(error, MessageError::WrongRun { message, found: run, expected: run + 1 });
}
