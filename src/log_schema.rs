//! The records of the log in words: a message definition per channel, as readers of MCAP know them.

pub(crate) const SEPARATOR: &str =
    "================================================================================\n";

pub(crate) const HEADER_FIELDS: &str = "\
uint32 magic
uint32 version
uint64 joint_set_hash
uint64 run_id
uint64 sequence
uint64 sent_at_ns
";

pub(crate) const PLANT_STATE_FIELDS: &str = "\
delmpc_msgs/Header header
uint64 time_ns
uint64 applied_command_sequence
uint32 clock
uint32 n_joints
uint32 n_feet
uint32 sensors
uint32 status_flags
uint32 watchdog_level
float64[32] position
float64[32] velocity
float64[32] applied_torque
float64[3] imu_angle
float64[3] imu_velocity
float64[3] imu_angular_velocity
float64[3] imu_specific_force
delmpc_msgs/FootReading[8] feet
float64[3] base_position_w
float64[4] base_orientation_w
float64[3] base_angular_velocity_b
float64[3] base_linear_velocity_b
";

pub(crate) const FOOT_READING_FIELDS: &str = "\
uint32 flags
uint32 reserved
float64[3] torque_s
float64[3] force_s
";

pub(crate) const STATE_ESTIMATE_FIELDS: &str = "\
uint32 known
uint32 feet_loaded
float64[4] base_orientation_w
float64[3] base_angular_velocity_b
float64[3] base_linear_velocity_b
float64[3] gyro_bias
float64[3] accelerometer_bias
";

/// Lists have a number per joint.
pub(crate) const SEGMENT_FIELDS: &str = "\
uint64 begin_ns
float64[<=32] torque
float64[<=32] torque_lower
float64[<=32] torque_upper
float64[<=32] position_ref
float64[<=32] velocity_ref
float64[<=32] acceleration_ref
float64[3] imu_angle_ref
float64[3] imu_rate_ref
float64[3] imu_acceleration_ref
";

/// As [`crate::log_command`] packs it. The gain has a row per joint: first positions, then velocities; that of the inertial unit six numbers a row.
pub(crate) const COMMAND_FIELDS: &str = "\
delmpc_msgs/Header header
uint64 state_sequence
uint64 state_time_ns
uint64 valid_from_ns
uint64 valid_until_ns
uint32 n_joints
uint32 verdict
uint32 fallback_level
uint32 reason
uint32 n_segments
uint32 rate_samples
delmpc_msgs/Segment[<=8] segments
float64[<=2048] gain
float64[<=192] imu_gain
float64[3] imu_rate_bias
uint32[32] load_foot
float64[8] full_load_n
float64[<=32] unloaded_stiffness
float64[<=32] unloaded_damping
delmpc_msgs/CycleReport report
delmpc_msgs/StateEstimate estimate
";

pub(crate) const CYCLE_REPORT_FIELDS: &str = "\
uint64 state_in_ns
uint64 shift_ns
uint64 linearize_ns
uint64 riccati_ns
uint64 qp_ns
uint64 publish_ns
uint64 total_ns
float64 worst_violation
uint32 worst_constraint
uint32 worst_stage
uint32 worst_row
uint32 qp_solves
uint32 qp_iterations
uint32 active_rows
uint32 dropped_rows
uint32 allocations
";

pub(crate) const TRUTH_FIELDS: &str = "\
uint64 time_ns
uint32 n_joints
uint32 contact_flags
uint32 status_flags
uint32 watchdog_level
float64[32] position
float64[32] velocity
float64[32] torque
float64[3] base_position_w
float64[4] base_orientation_w
float64[3] base_angular_velocity_b
float64[3] base_linear_velocity_b
float64[3] com_w
float64[3] com_velocity_w
uint32 n_feet
uint32 feet_touching
float64[24] foot_position_w
float64[8] foot_slip_m
float64[3] sole_position_w
float64 stance_slip_m
float64 sole_tilt_rad
float64[3] stance_torque_b
float64[3] stance_force_b
float64 cop_margin_m
float64 friction_use
float64 torque_ratio
float64[3] hand_w
float64[3] push_force_w
float64 energy_balance_error
";

pub(crate) const PULL_FIELDS: &str = "\
uint64 time_ns
uint32 body
uint32 acts
float64[3] point_b
float64[3] force_w
";

pub(crate) fn plant_state_schema() -> String {
    format!(
        "{PLANT_STATE_FIELDS}{SEPARATOR}MSG: delmpc_msgs/Header\n{HEADER_FIELDS}\
         {SEPARATOR}MSG: delmpc_msgs/FootReading\n{FOOT_READING_FIELDS}"
    )
}

pub(crate) fn command_schema() -> String {
    let parts = [
        ("Header", HEADER_FIELDS),
        ("Segment", SEGMENT_FIELDS),
        ("CycleReport", CYCLE_REPORT_FIELDS),
        ("StateEstimate", STATE_ESTIMATE_FIELDS),
    ];
    let part = |(name, fields)| format!("{SEPARATOR}MSG: delmpc_msgs/{name}\n{fields}");
    std::iter::once(COMMAND_FIELDS.to_owned()).chain(parts.map(part)).collect()
}
