/* The messages between plant and controller, little-endian. Written by `delmpc wire --c` from the Rust types.
 * What they mean and what a plant has to do: shared/messages/WIRE.md. */
#ifndef DELMPC_H
#define DELMPC_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
#define DELMPC_ASSERT(what) static_assert(what, #what)
#else
#define DELMPC_ASSERT(what) _Static_assert(what, #what)
#endif

#define DELMPC_MAX_JOINTS 32
#define DELMPC_MAX_FEET 8
#define DELMPC_MAX_SEGMENTS 8
#define DELMPC_MAX_RATE_SAMPLES 8

#define DELMPC_PLANT_STATE_PAYLOAD "delmpc/PlantState/v2"
#define DELMPC_PLANT_STATE_MAGIC 0x53504d44u
#define DELMPC_PLANT_STATE_VERSION 2u
#define DELMPC_COMMAND_PAYLOAD "delmpc/Command/v4"
#define DELMPC_COMMAND_MAGIC 0x4f434d44u
#define DELMPC_COMMAND_VERSION 4u
#define DELMPC_HEARTBEAT_PAYLOAD "delmpc/Heartbeat/v1"
#define DELMPC_HEARTBEAT_MAGIC 0x42484d44u
#define DELMPC_HEARTBEAT_VERSION 1u

/* clock */
#define DELMPC_CLOCK_SIMULATED 0u /* Simulated time from 0, advanced step by step (`lockstep`). */
#define DELMPC_CLOCK_MONOTONIC 1u /* The machine's monotonic clock (`realtime`). */

/* sensors */
#define DELMPC_SENSORS_INERTIAL_UNIT 1u /* There is an inertial unit: `imu_angular_velocity` and `imu_specific_force`. */
#define DELMPC_SENSORS_INERTIAL_SUMS 2u /* It sums up its samples: `imu_angle` and `imu_velocity`. */
#define DELMPC_SENSORS_MOTION_CAPTURE 4u /* The base is seen from outside: `base_position_w` to `base_linear_velocity_b`. */

/* feet.flags */
#define DELMPC_FEET_FLAGS_WRENCH 1u /* The foot has a force and torque sensor, and `torque_s` and `force_s` are what it says. */
#define DELMPC_FEET_FLAGS_TOUCHES 2u /* A contact switch is closed. Where there is a wrench it decides, not the switch. */

/* status_flags */
#define DELMPC_STATUS_FLAGS_FELL 1u /* The robot fell. Stays set until the end of the run. */
#define DELMPC_STATUS_FLAGS_FINISHED 2u /* The plant has reached the end of the run and sends no further state. */
#define DELMPC_STATUS_FLAGS_WATCHDOG 4u /* The plant's watchdog ignored the controller in the last step, since its commands were late, missing or refused. */
#define DELMPC_STATUS_FLAGS_SATURATED 8u /* At least one actuator was at its limit in the last step. */
#define DELMPC_STATUS_FLAGS_DISTURBED 16u /* A disturbance acted in the last step. */

/* watchdog_level */
#define DELMPC_WATCHDOG_LEVEL_FRESH_SOLUTION 0u /* A solution of this cycle. */
#define DELMPC_WATCHDOG_LEVEL_SHIFTED_PLAN 1u /* The last plan, shifted in time, with its own gains. */
#define DELMPC_WATCHDOG_LEVEL_STATIC_LQR 2u /* Static LQR about the posture. */
#define DELMPC_WATCHDOG_LEVEL_GRAVITY_HOLD 3u /* Gravity compensation and damping. */
#define DELMPC_WATCHDOG_LEVEL_DAMPING_ONLY 4u /* Damping only. */
#define DELMPC_WATCHDOG_LEVEL_ZERO_TORQUE 5u /* No torque. */

/* verdict */
#define DELMPC_VERDICT_OK 0u /* A fresh solution within its time. */
#define DELMPC_VERDICT_LATE 1u /* The cycle exceeded its time. */
#define DELMPC_VERDICT_INFEASIBLE 2u /* The constrained problem had no solution. */
#define DELMPC_VERDICT_MODEL_MISMATCH 3u /* The plant did not move as the model predicted. */
#define DELMPC_VERDICT_BAD_STATE 4u /* The state was refused; see `Command::reason`. */

/* reason */
#define DELMPC_REASON_WRONG_MAGIC 1u /* The first word is not that of the expected message type. */
#define DELMPC_REASON_WRONG_VERSION 2u /* Another version of the same message. */
#define DELMPC_REASON_WRONG_JOINT_SET 3u /* The sender has other joints, or the same joints in another order. */
#define DELMPC_REASON_WRONG_JOINT_COUNT 4u /* The number of joints differs from ours or exceeds the capacity. */
#define DELMPC_REASON_NOT_FINITE 5u /* A value is NaN or infinite. */
#define DELMPC_REASON_IMPLAUSIBLE 6u /* A value is finite but beyond anything a robot does. */
#define DELMPC_REASON_NOT_UNIT 7u /* A quaternion is not of unit length. */
#define DELMPC_REASON_UNKNOWN_CODE 8u /* A code that stands for nothing. */
#define DELMPC_REASON_EMPTY_INTERVAL 9u /* A command that ends before it begins. */
#define DELMPC_REASON_WRONG_LENGTH 10u /* A slice handed in by the caller has another length than the message has joints. */
#define DELMPC_REASON_EMPTY_BOUNDS 11u /* Bounds with nothing between them. */
#define DELMPC_REASON_WRONG_SEGMENT_COUNT 12u /* A command without segments, or with more than fit. */
#define DELMPC_REASON_SEGMENT_OUT_OF_ORDER 13u /* Segments that do not follow each other in time. */
#define DELMPC_REASON_TIME_BEYOND 14u /* A time no clock shows. */
#define DELMPC_REASON_VALID_TOO_LONG 15u /* A command that would be valid for too long. */
#define DELMPC_REASON_WRONG_RUN 16u /* The message belongs to another run. */
#define DELMPC_REASON_TOO_MANY_FEET 17u /* More feet than fit, or a joint on the load of a foot that does not exist. */
#define DELMPC_REASON_STALE 100u /* The measurement is too old. */
#define DELMPC_REASON_OUT_OF_ORDER 101u /* The measurement is from before the last one. */
#define DELMPC_REASON_ESTIMATOR 102u /* The estimator refused it. */
#define DELMPC_REASON_AHEAD 103u /* The measurement is from a time that has not come: believed, it would make all true ones look old. */
#define DELMPC_REASON_PREDICTION 110u /* The prediction to the time of the command failed. */
#define DELMPC_REASON_STAGE 111u /* A stage of the horizon could not be simulated. */
#define DELMPC_REASON_RICCATI 112u /* The Riccati recursion broke down. */
#define DELMPC_REASON_QP 113u /* The constrained QP gave nothing usable: no finite numbers, or torque limits and contact rows it could not keep. */
#define DELMPC_REASON_FAR 114u /* The plan is farther from the nominal than a linearisation reaches. */

/* report.worst_constraint */
#define DELMPC_REPORT_WORST_CONSTRAINT_NONE 0u /* No constraint. */
#define DELMPC_REPORT_WORST_CONSTRAINT_TORQUE 1u /* Torque limit of a joint (N m or N). */
#define DELMPC_REPORT_WORST_CONSTRAINT_UNILATERAL 2u /* The ground can only push (N). */
#define DELMPC_REPORT_WORST_CONSTRAINT_FRICTION 3u /* Friction at the stance foot (N). */
#define DELMPC_REPORT_WORST_CONSTRAINT_CENTRE_OF_PRESSURE 4u /* Centre of pressure inside the sole (N m). */
#define DELMPC_REPORT_WORST_CONSTRAINT_YAW_TORQUE 5u /* Yaw torque at the stance foot (N m). */
#define DELMPC_REPORT_WORST_CONSTRAINT_JOINT_POSITION 6u /* Position limit of a joint (rad or m). */
#define DELMPC_REPORT_WORST_CONSTRAINT_JOINT_VELOCITY 7u /* Velocity limit of a joint (rad/s or m/s). */

/* role */
#define DELMPC_ROLE_PLANT 0u /* Simulates the robot. */
#define DELMPC_ROLE_CONTROLLER 1u /* Computes the commands. */
#define DELMPC_ROLE_SUPERVISOR 2u /* Starts, watches and ends the other two. */

/* state */
#define DELMPC_STATE_STARTING 0u /* Reading files, connecting, warming up. */
#define DELMPC_STATE_READY 1u /* Waiting for the run to begin. */
#define DELMPC_STATE_RUNNING 2u /* In the run. From the supervisor: run. */
#define DELMPC_STATE_STOPPING 3u /* Asked to end, still tidying up. From the supervisor: end now. */
#define DELMPC_STATE_FINISHED 4u /* Done; nothing more will be sent. */
#define DELMPC_STATE_FAULT 5u /* Ended by a fault; see `Heartbeat::fault_code`. */

typedef struct delmpc_header {
    uint32_t magic;
    uint32_t version;
    uint64_t joint_set_hash;
    uint64_t run_id;
    uint64_t sequence;
    uint64_t sent_at_ns; /* ns, machine */
} delmpc_header;
DELMPC_ASSERT(offsetof(delmpc_header, magic) == 0);
DELMPC_ASSERT(offsetof(delmpc_header, version) == 4);
DELMPC_ASSERT(offsetof(delmpc_header, joint_set_hash) == 8);
DELMPC_ASSERT(offsetof(delmpc_header, run_id) == 16);
DELMPC_ASSERT(offsetof(delmpc_header, sequence) == 24);
DELMPC_ASSERT(offsetof(delmpc_header, sent_at_ns) == 32);
DELMPC_ASSERT(sizeof(delmpc_header) == 40);

typedef struct delmpc_foot_reading {
    uint32_t flags;
    uint32_t reserved;
    double torque_s[3]; /* N m, sole */
    double force_s[3]; /* N, sole */
} delmpc_foot_reading;
DELMPC_ASSERT(offsetof(delmpc_foot_reading, flags) == 0);
DELMPC_ASSERT(offsetof(delmpc_foot_reading, reserved) == 4);
DELMPC_ASSERT(offsetof(delmpc_foot_reading, torque_s) == 8);
DELMPC_ASSERT(offsetof(delmpc_foot_reading, force_s) == 32);
DELMPC_ASSERT(sizeof(delmpc_foot_reading) == 56);

typedef struct delmpc_plant_state {
    delmpc_header header;
    uint64_t time_ns; /* ns, plant */
    uint64_t applied_command_sequence;
    uint32_t clock;
    uint32_t n_joints;
    uint32_t n_feet;
    uint32_t sensors;
    uint32_t status_flags;
    uint32_t watchdog_level;
    double position[32]; /* rad, joint */
    double velocity[32]; /* rad/s, joint */
    double applied_torque[32]; /* N m, joint */
    double imu_angle[3]; /* rad, inertial unit */
    double imu_velocity[3]; /* m/s, inertial unit */
    double imu_angular_velocity[3]; /* rad/s, inertial unit */
    double imu_specific_force[3]; /* m/s², inertial unit */
    delmpc_foot_reading feet[8];
    double base_position_w[3]; /* m, world */
    double base_orientation_w[4]; /* 1, world */
    double base_angular_velocity_b[3]; /* rad/s, base link */
    double base_linear_velocity_b[3]; /* m/s, base link */
} delmpc_plant_state;
DELMPC_ASSERT(offsetof(delmpc_plant_state, header) == 0);
DELMPC_ASSERT(offsetof(delmpc_plant_state, time_ns) == 40);
DELMPC_ASSERT(offsetof(delmpc_plant_state, applied_command_sequence) == 48);
DELMPC_ASSERT(offsetof(delmpc_plant_state, clock) == 56);
DELMPC_ASSERT(offsetof(delmpc_plant_state, n_joints) == 60);
DELMPC_ASSERT(offsetof(delmpc_plant_state, n_feet) == 64);
DELMPC_ASSERT(offsetof(delmpc_plant_state, sensors) == 68);
DELMPC_ASSERT(offsetof(delmpc_plant_state, status_flags) == 72);
DELMPC_ASSERT(offsetof(delmpc_plant_state, watchdog_level) == 76);
DELMPC_ASSERT(offsetof(delmpc_plant_state, position) == 80);
DELMPC_ASSERT(offsetof(delmpc_plant_state, velocity) == 336);
DELMPC_ASSERT(offsetof(delmpc_plant_state, applied_torque) == 592);
DELMPC_ASSERT(offsetof(delmpc_plant_state, imu_angle) == 848);
DELMPC_ASSERT(offsetof(delmpc_plant_state, imu_velocity) == 872);
DELMPC_ASSERT(offsetof(delmpc_plant_state, imu_angular_velocity) == 896);
DELMPC_ASSERT(offsetof(delmpc_plant_state, imu_specific_force) == 920);
DELMPC_ASSERT(offsetof(delmpc_plant_state, feet) == 944);
DELMPC_ASSERT(offsetof(delmpc_plant_state, base_position_w) == 1392);
DELMPC_ASSERT(offsetof(delmpc_plant_state, base_orientation_w) == 1416);
DELMPC_ASSERT(offsetof(delmpc_plant_state, base_angular_velocity_b) == 1448);
DELMPC_ASSERT(offsetof(delmpc_plant_state, base_linear_velocity_b) == 1472);
DELMPC_ASSERT(sizeof(delmpc_plant_state) == 1496);

typedef struct delmpc_segment {
    uint64_t begin_ns; /* ns, command */
    double torque[32]; /* N m, joint */
    double torque_lower[32]; /* N m, joint */
    double torque_upper[32]; /* N m, joint */
    double position_ref[32]; /* rad, joint */
    double velocity_ref[32]; /* rad/s, joint */
    double acceleration_ref[32]; /* rad/s², joint */
    double imu_angle_ref[3]; /* rad, inertial unit */
    double imu_rate_ref[3]; /* rad/s, inertial unit */
    double imu_acceleration_ref[3]; /* rad/s², inertial unit */
} delmpc_segment;
DELMPC_ASSERT(offsetof(delmpc_segment, begin_ns) == 0);
DELMPC_ASSERT(offsetof(delmpc_segment, torque) == 8);
DELMPC_ASSERT(offsetof(delmpc_segment, torque_lower) == 264);
DELMPC_ASSERT(offsetof(delmpc_segment, torque_upper) == 520);
DELMPC_ASSERT(offsetof(delmpc_segment, position_ref) == 776);
DELMPC_ASSERT(offsetof(delmpc_segment, velocity_ref) == 1032);
DELMPC_ASSERT(offsetof(delmpc_segment, acceleration_ref) == 1288);
DELMPC_ASSERT(offsetof(delmpc_segment, imu_angle_ref) == 1544);
DELMPC_ASSERT(offsetof(delmpc_segment, imu_rate_ref) == 1568);
DELMPC_ASSERT(offsetof(delmpc_segment, imu_acceleration_ref) == 1592);
DELMPC_ASSERT(sizeof(delmpc_segment) == 1616);

typedef struct delmpc_cycle_report {
    uint64_t state_in_ns; /* ns */
    uint64_t shift_ns; /* ns */
    uint64_t linearize_ns; /* ns */
    uint64_t riccati_ns; /* ns */
    uint64_t qp_ns; /* ns */
    uint64_t publish_ns; /* ns */
    uint64_t total_ns; /* ns */
    double worst_violation;
    uint32_t worst_constraint;
    uint32_t worst_stage;
    uint32_t worst_row;
    uint32_t qp_solves;
    uint32_t qp_iterations;
    uint32_t active_rows;
    uint32_t dropped_rows;
    uint32_t allocations;
} delmpc_cycle_report;
DELMPC_ASSERT(offsetof(delmpc_cycle_report, state_in_ns) == 0);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, shift_ns) == 8);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, linearize_ns) == 16);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, riccati_ns) == 24);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, qp_ns) == 32);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, publish_ns) == 40);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, total_ns) == 48);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, worst_violation) == 56);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, worst_constraint) == 64);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, worst_stage) == 68);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, worst_row) == 72);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, qp_solves) == 76);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, qp_iterations) == 80);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, active_rows) == 84);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, dropped_rows) == 88);
DELMPC_ASSERT(offsetof(delmpc_cycle_report, allocations) == 92);
DELMPC_ASSERT(sizeof(delmpc_cycle_report) == 96);

typedef struct delmpc_state_estimate {
    uint32_t known;
    uint32_t feet_loaded;
    double base_orientation_w[4]; /* 1, world */
    double base_angular_velocity_b[3]; /* rad/s, base link */
    double base_linear_velocity_b[3]; /* m/s, base link */
    double gyro_bias[3]; /* rad/s, inertial unit */
    double accelerometer_bias[3]; /* m/s², inertial unit */
} delmpc_state_estimate;
DELMPC_ASSERT(offsetof(delmpc_state_estimate, known) == 0);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, feet_loaded) == 4);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, base_orientation_w) == 8);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, base_angular_velocity_b) == 40);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, base_linear_velocity_b) == 64);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, gyro_bias) == 88);
DELMPC_ASSERT(offsetof(delmpc_state_estimate, accelerometer_bias) == 112);
DELMPC_ASSERT(sizeof(delmpc_state_estimate) == 136);

typedef struct delmpc_command {
    delmpc_header header;
    uint64_t state_sequence;
    uint64_t state_time_ns; /* ns, plant */
    uint64_t valid_from_ns; /* ns, plant */
    uint64_t valid_until_ns; /* ns, plant */
    uint32_t n_joints;
    uint32_t verdict;
    uint32_t fallback_level;
    uint32_t reason;
    uint32_t n_segments;
    uint32_t rate_samples;
    delmpc_segment segments[8];
    double gain[32][64]; /* N m/rad, N m s/rad, joint */
    double imu_gain[32][6]; /* N m/rad, N m s/rad, inertial unit */
    double imu_rate_bias[3]; /* rad/s, inertial unit */
    uint32_t load_foot[32];
    double full_load_n[8]; /* N, sole */
    double unloaded_stiffness[32]; /* N m/rad, joint */
    double unloaded_damping[32]; /* N m s/rad, joint */
    delmpc_cycle_report report;
    delmpc_state_estimate estimate;
} delmpc_command;
DELMPC_ASSERT(offsetof(delmpc_command, header) == 0);
DELMPC_ASSERT(offsetof(delmpc_command, state_sequence) == 40);
DELMPC_ASSERT(offsetof(delmpc_command, state_time_ns) == 48);
DELMPC_ASSERT(offsetof(delmpc_command, valid_from_ns) == 56);
DELMPC_ASSERT(offsetof(delmpc_command, valid_until_ns) == 64);
DELMPC_ASSERT(offsetof(delmpc_command, n_joints) == 72);
DELMPC_ASSERT(offsetof(delmpc_command, verdict) == 76);
DELMPC_ASSERT(offsetof(delmpc_command, fallback_level) == 80);
DELMPC_ASSERT(offsetof(delmpc_command, reason) == 84);
DELMPC_ASSERT(offsetof(delmpc_command, n_segments) == 88);
DELMPC_ASSERT(offsetof(delmpc_command, rate_samples) == 92);
DELMPC_ASSERT(offsetof(delmpc_command, segments) == 96);
DELMPC_ASSERT(offsetof(delmpc_command, gain) == 13024);
DELMPC_ASSERT(offsetof(delmpc_command, imu_gain) == 29408);
DELMPC_ASSERT(offsetof(delmpc_command, imu_rate_bias) == 30944);
DELMPC_ASSERT(offsetof(delmpc_command, load_foot) == 30968);
DELMPC_ASSERT(offsetof(delmpc_command, full_load_n) == 31096);
DELMPC_ASSERT(offsetof(delmpc_command, unloaded_stiffness) == 31160);
DELMPC_ASSERT(offsetof(delmpc_command, unloaded_damping) == 31416);
DELMPC_ASSERT(offsetof(delmpc_command, report) == 31672);
DELMPC_ASSERT(offsetof(delmpc_command, estimate) == 31768);
DELMPC_ASSERT(sizeof(delmpc_command) == 31904);

typedef struct delmpc_heartbeat {
    delmpc_header header;
    uint64_t time_ns; /* ns, machine */
    uint32_t role;
    uint32_t pid;
    uint32_t state;
    uint32_t fault_code;
} delmpc_heartbeat;
DELMPC_ASSERT(offsetof(delmpc_heartbeat, header) == 0);
DELMPC_ASSERT(offsetof(delmpc_heartbeat, time_ns) == 40);
DELMPC_ASSERT(offsetof(delmpc_heartbeat, role) == 48);
DELMPC_ASSERT(offsetof(delmpc_heartbeat, pid) == 52);
DELMPC_ASSERT(offsetof(delmpc_heartbeat, state) == 56);
DELMPC_ASSERT(offsetof(delmpc_heartbeat, fault_code) == 60);
DELMPC_ASSERT(sizeof(delmpc_heartbeat) == 64);

#endif
