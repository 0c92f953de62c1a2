//! The rules values must keep. Each names the key, the value, the rule and a remedy.

use crate::{ControllerSettings, FaultKind, FaultSettings, FaultTarget, Scenario, TimingSettings};

/// A broken rule.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Violation {
    pub(crate) key: String,
    pub(crate) value: String,
    pub(crate) rule: String,
    pub(crate) remedy: String,
}

/// The rules that are broken.
#[derive(Debug, Default)]
struct Broken {
    rules: Vec<Violation>,
}

/// A control cycle may differ from a whole number of plant steps by this part of a step: round-off of the two decimal numbers.
const WHOLE_STEPS: f64 = 1e-6;

/// Weights beyond this cannot be told from an infinite one in double precision.
const LARGEST_WEIGHT: f64 = 1e9;

/// Bytes of a name; with the time of the run it stays far below what file systems allow.
const LONGEST_NAME: usize = 100;

/// All rules, in the order of the keys: those that are broken.
pub(crate) fn check(scenario: &Scenario) -> Vec<Violation> {
    let mut broken = Broken::default();
    check_run(&mut broken, scenario);
    check_ground(&mut broken, scenario);
    check_sensors(&mut broken, scenario);
    check_controller(&mut broken, scenario);
    check_events(&mut broken, scenario);
    check_success(&mut broken, scenario);
    broken.rules
}

fn check_run(broken: &mut Broken, scenario: &Scenario) {
    let Scenario { duration_s, robot, plant, process, .. } = scenario;
    broken.check_name(&scenario.name);
    broken.within("seed", scenario.seed as f64, 0.0, i64::MAX as f64);
    broken.positive("duration_s", *duration_s, 3600.0);
    broken.named("robot.urdf", &robot.urdf, "a URDF file, for example configs/robots/atlas.urdf");

    broken.within("plant.step_s", plant.step_s, 1e-5, 1e-3);
    broken.within("plant.friction", plant.friction, 0.0, 10.0);
    broken.within("plant.mass_scale", plant.mass_scale, 0.1, 10.0);
    broken.within("plant.inertia_scale", plant.inertia_scale, 0.1, 10.0);
    broken.each("plant.com_shift_m", &plant.com_shift_m, 1.0);
    broken.within("plant.actuator_delay_s", plant.actuator_delay_s, 0.0, 0.1);
    broken.whole("duration_s", *duration_s, "plant.step_s", *duration_s / plant.step_s);
    broken.within("process.priority", f64::from(process.priority), 0.0, 99.0);
    broken.within("process.hang_s", process.hang_s, 0.1, 3600.0);
}

fn check_sensors(broken: &mut Broken, scenario: &Scenario) {
    let sensors = &scenario.sensors;
    broken.within("sensors.noise_scale", sensors.noise_scale, 0.0, 100.0);
    broken.within("sensors.delay_s", sensors.delay_s, 0.0, 0.1);
    for (key, value) in [
        ("sensors.position_noise_rad", sensors.position_noise_rad),
        ("sensors.position_bias_rad", sensors.position_bias_rad),
        ("sensors.position_resolution_rad", sensors.position_resolution_rad),
        ("sensors.velocity_noise_rad_s", sensors.velocity_noise_rad_s),
        ("sensors.velocity_resolution_rad_s", sensors.velocity_resolution_rad_s),
        ("sensors.base_position_noise_m", sensors.base_position_noise_m),
        ("sensors.base_orientation_noise_rad", sensors.base_orientation_noise_rad),
        ("sensors.base_velocity_noise_m_s", sensors.base_velocity_noise_m_s),
        ("sensors.base_angular_velocity_noise_rad_s", sensors.base_angular_velocity_noise_rad_s),
        ("sensors.gyro_noise_rad_s", sensors.gyro_noise_rad_s),
        ("sensors.gyro_bias_rad_s", sensors.gyro_bias_rad_s),
        ("sensors.gyro_bias_walk_rad_s", sensors.gyro_bias_walk_rad_s),
        ("sensors.gyro_resolution_rad_s", sensors.gyro_resolution_rad_s),
    ] {
        broken.within(key, value, 0.0, 1.0);
    }
    for (key, value) in [
        ("sensors.accelerometer_noise_m_s2", sensors.accelerometer_noise_m_s2),
        ("sensors.accelerometer_bias_m_s2", sensors.accelerometer_bias_m_s2),
        ("sensors.accelerometer_bias_walk_m_s2", sensors.accelerometer_bias_walk_m_s2),
        ("sensors.accelerometer_resolution_m_s2", sensors.accelerometer_resolution_m_s2),
    ] {
        broken.within(key, value, 0.0, 10.0);
    }
    broken.each("sensors.imu_position_m", &sensors.imu_position_m, 10.0);
    broken.each("sensors.imu_rpy_rad", &sensors.imu_rpy_rad, 7.0);
    broken.each("sensors.imu_misalignment_rad", &sensors.imu_misalignment_rad, 0.5);
    broken.within("sensors.foot_force_noise_n", sensors.foot_force_noise_n, 0.0, 1e4);
    broken.within("sensors.foot_torque_noise_nm", sensors.foot_torque_noise_nm, 0.0, 1e4);
}

fn check_controller(broken: &mut Broken, scenario: &Scenario) {
    let Scenario { plant, sensors, controller, .. } = scenario;
    broken.within("controller.mpc_rate_hz", controller.mpc_rate_hz, 1.0, 1000.0);
    let cycle = 1.0 / (controller.mpc_rate_hz * plant.step_s);
    broken.whole("controller.mpc_rate_hz", controller.mpc_rate_hz, "plant.step_s", cycle);
    let servo = controller.servo_rate_hz;
    let off = (servo * plant.step_s - 1.0).abs();
    if off > WHOLE_STEPS || off.is_nan() {
        let rule = "the servo acts in every plant step";
        let remedy = format!("give 1 / `plant.step_s` = {}", 1.0 / plant.step_s);
        broken.push(violation("controller.servo_rate_hz", servo.to_string(), rule, &remedy));
    }
    broken.within("controller.horizon_s", controller.horizon_s, 0.02, 5.0);
    broken.within("controller.stages", controller.stages as f64, 2.0, 64.0);
    broken.within("controller.delay_cycles", f64::from(controller.delay_cycles), 0.0, 10.0);

    broken.within("controller.max_state_age_s", controller.max_state_age_s, 1e-3, 10.0);
    broken.within("controller.command_life_s", controller.command_life_s, 1e-3, 10.0);
    let oldest = controller.max_state_age_s;
    if sensors.delay_s >= oldest {
        let rule =
            format!("every measurement is older than `controller.max_state_age_s` = {oldest} and refused");
        let remedy = "give a shorter delay, or a larger `controller.max_state_age_s`";
        broken.push(violation("sensors.delay_s", sensors.delay_s.to_string(), &rule, remedy));
    }
    let period = 1.0 / controller.mpc_rate_hz;
    let needed = (1.0 + f64::from(controller.delay_cycles)) * period;
    let life = controller.command_life_s;
    if life < needed * (1.0 - WHOLE_STEPS) {
        let rule = format!(
            "a command has to last for `controller.delay_cycles` and one cycle of `controller.mpc_rate_hz`: {needed} s"
        );
        broken.push(violation("controller.command_life_s", life.to_string(), &rule, "give a longer life"));
    }
    check_weights(broken, controller);
    for (key, value, least, most) in controller.legged.ranges() {
        broken.within(key, value, least, most);
    }
}

/// What happens in a run.
fn check_events(broken: &mut Broken, scenario: &Scenario) {
    let plant = &scenario.plant;
    if let Some(reach) = &scenario.reach {
        broken.named("reach.hand", &reach.hand, "a frame of the robot, for example l_hand_point");
        broken.each("reach.ball_m", &reach.ball_m, 100.0);
        broken.within("reach.start_s", reach.start_s, 0.0, 3600.0);
        broken.positive("reach.deadline_s", reach.deadline_s, 3600.0);
        broken.within("reach.hold_s", reach.hold_s, 0.0, 3600.0);
        broken.positive("reach.return_s", reach.return_s, 3600.0);
    }
    for (index, push) in scenario.push.iter().enumerate() {
        let key = |name: &str| match scenario.push.len() {
            1 => format!("push.{name}"),
            _ => format!("push[{index}].{name}"),
        };
        broken.named(&key("link"), &push.link, "a link of the robot, for example utorso");
        broken.each(&key("direction"), &push.direction, 1e6);
        if push.direction.iter().all(|x| *x == 0.0) {
            let value = format!("{:?}", push.direction);
            broken.push(violation(
                &key("direction"),
                value,
                "it has no direction",
                "take for example [0, 1, 0] for left",
            ));
        }
        broken.within(&key("impulse_ns"), push.impulse_ns, 0.0, 1e4);
        broken.within(&key("start_s"), push.start_s, 0.0, 3600.0);
        broken.within(&key("duration_s"), push.duration_s, plant.step_s, 3600.0);
    }

    for (key, value, least, most) in scenario.gait.iter().flat_map(crate::GaitSettings::ranges) {
        broken.within(key, value, least, most);
    }
    for (index, step) in scenario.step.iter().enumerate() {
        let key = |name: &str| format!("step[{index}].{name}");
        broken.within(&key("time_s"), step.time_s, 0.0, 3600.0);
        broken.within(&key("swing_s"), step.swing_s, 0.05, 10.0);
        broken.each(&key("position_m"), &step.position_m, 100.0);
        broken.within(&key("yaw_rad"), step.yaw_rad, -7.0, 7.0);
    }
    for (key, value, least, most) in scenario.plan.iter().flat_map(crate::PlanSettings::ranges) {
        broken.within(key, value, least, most);
    }

    for (index, fault) in scenario.fault.iter().enumerate() {
        check_fault(broken, fault, index, scenario.fault.len());
    }
}

fn check_success(broken: &mut Broken, scenario: &Scenario) {
    let success = &scenario.success;
    for (key, value) in [
        ("success.hand_error_at_deadline_m", success.hand_error_at_deadline_m),
        ("success.hand_error_hold_max_m", success.hand_error_hold_max_m),
        ("success.max_stance_slip_m", success.max_stance_slip_m),
        ("success.max_stance_tilt_rad", success.max_stance_tilt_rad),
        ("success.max_torque_ratio", success.max_torque_ratio),
        ("success.settle_time_s", success.settle_time_s),
        ("success.min_real_time_factor", success.min_real_time_factor),
    ] {
        broken.within(key, value, 0.0, f64::MAX);
    }
    broken.within("success.min_cop_margin_m", success.min_cop_margin_m, -10.0, 10.0);
    check_timing(broken, &scenario.timing);
}

/// The ground, and how the robot begins on it.
fn check_ground(broken: &mut Broken, scenario: &Scenario) {
    let Scenario { robot, plant, terrain, .. } = scenario;
    let start = &robot.start;
    broken.within("robot.start.height_m", start.height_m, -0.1, 10.0);
    for (key, value) in [
        ("robot.start.roll_rad", start.roll_rad),
        ("robot.start.pitch_rad", start.pitch_rad),
        ("robot.start.yaw_rad", start.yaw_rad),
    ] {
        broken.within(key, value, -7.0, 7.0);
    }
    broken.each("robot.start.position_m", &start.position_m, 1000.0);
    for (joint, offset) in &start.joint_offset {
        broken.within(&format!("robot.start.joint_offset.{joint}"), *offset, -7.0, 7.0);
    }
    broken.each("plant.slope_rad", &plant.slope_rad, 0.7);
    broken.within("plant.ground_sink_m", plant.ground_sink_m, 0.0, 0.1);
    broken.within("plant.ground_damping_ratio", plant.ground_damping_ratio, 0.0, 100.0);
    let key = |list: &str, index: usize, count: usize, name: &str| match count {
        1 => format!("terrain.{list}.{name}"),
        _ => format!("terrain.{list}[{index}].{name}"),
    };
    for (index, block) in terrain.boxes.iter().enumerate() {
        let key = |name: &str| key("box", index, terrain.boxes.len(), name);
        broken.each(&key("center_m"), &block.center_m, 1000.0);
        for half in block.half_size_m {
            broken.positive(&key("half_size_m"), half, 1000.0);
        }
        broken.within(&key("yaw_rad"), block.yaw_rad, -7.0, 7.0);
    }
    for (index, gap) in terrain.gaps.iter().enumerate() {
        let key = |name: &str| key("gap", index, terrain.gaps.len(), name);
        broken.each(&key("min_m"), &gap.min_m, 1000.0);
        for (axis, (min, max)) in gap.min_m.iter().zip(&gap.max_m).enumerate() {
            let name = ["x", "y"][axis];
            if min >= max {
                let rule = format!("the gap is empty along {name}: `min_m` is {min}");
                return broken.push(violation(&key("max_m"), max.to_string(), &rule, "give a larger one"));
            }
        }
        broken.each(&key("max_m"), &gap.max_m, 1000.0);
    }
}

fn check_fault(broken: &mut Broken, fault: &FaultSettings, index: usize, faults: usize) {
    use FaultTarget::{Command, Controller, Machine, Plant, State};
    let key = |name: &str| match faults {
        1 => format!("fault.{name}"),
        _ => format!("fault[{index}].{name}"),
    };
    let targets: &[FaultTarget] = match fault.kind {
        kind if kind.is_of_messages() => &[State, Command],
        FaultKind::KillRun | FaultKind::ClockJump => &[Machine],
        _ => &[Plant, Controller],
    };
    if !targets.contains(&fault.target) {
        let words: Vec<&str> = targets.iter().map(|target| target.word()).collect();
        let rule = format!("a fault of kind \"{}\" does not happen to it", fault.kind.word());
        let remedy = format!("take {}", words.join(" or "));
        return broken.push(violation(
            &key("target"),
            format!("\"{}\"", fault.target.word()),
            &rule,
            &remedy,
        ));
    }
    broken.within(&key("start_s"), fault.start_s, 0.0, 3600.0);
    broken.within(&key("count"), f64::from(fault.count), 1.0, 1e6);
    broken.within(&key("probability"), fault.probability, 0.0, 1.0);
    // The times of a message are shifted by a whole number of nanoseconds, 32 bits of them.
    broken.within(&key("size_s"), fault.size_s, 0.0, if fault.kind.is_of_messages() { 4.0 } else { 60.0 })
}

fn check_timing(broken: &mut Broken, timing: &TimingSettings) {
    broken.within("timing.event_s", timing.event_s, 1e-6, 1.0);
    broken.within("timing.compute_budget", timing.compute_budget, 0.01, 1.0);
    broken.within("timing.compute_spread", timing.compute_spread, 1.0, 1e3);
    for (key, value) in [
        ("timing.misses_of_floor", Some(timing.misses_of_floor)),
        ("timing.wake_up_of_floor", Some(timing.wake_up_of_floor)),
        ("timing.round_trip_of_floor", Some(timing.round_trip_of_floor)),
        ("timing.max_wake_up_p99_s", timing.max_wake_up_p99_s),
        ("timing.max_cycle_p999_s", timing.max_cycle_p999_s),
        ("timing.max_age_p99_s", timing.max_age_p99_s),
    ] {
        broken.within(key, value.unwrap_or(0.0), 0.0, f64::MAX);
    }
}

fn check_weights(broken: &mut Broken, controller: &ControllerSettings) {
    let (weights, limits) = (&controller.weights, &controller.constraints);
    let [com_x, com_y, com_z] = weights.com_per_m2;
    let [speed_x, speed_y, speed_z] = weights.com_velocity_s2_per_m2;
    let [spin_x, spin_y, spin_z] = weights.spin_per_n2m2s2;
    let [foot_x, foot_y, foot_z] = weights.swing_foot_per_m2;
    for (name, value) in [
        ("posture_per_rad2", weights.posture_per_rad2),
        ("joint_speed_s2_per_rad2", weights.joint_speed_s2_per_rad2),
        ("com_per_m2", com_x),
        ("com_per_m2", com_y),
        ("com_per_m2", com_z),
        ("com_velocity_s2_per_m2", speed_x),
        ("com_velocity_s2_per_m2", speed_y),
        ("com_velocity_s2_per_m2", speed_z),
        ("spin_per_n2m2s2", spin_x),
        ("spin_per_n2m2s2", spin_y),
        ("spin_per_n2m2s2", spin_z),
        ("hand_per_m2", weights.hand_per_m2),
        ("hand_velocity_s2_per_m2", weights.hand_velocity_s2_per_m2),
        ("swing_foot_per_m2", foot_x),
        ("swing_foot_per_m2", foot_y),
        ("swing_foot_per_m2", foot_z),
        ("swing_foot_rotation_per_rad2", weights.swing_foot_rotation_per_rad2),
    ] {
        broken.within(&format!("controller.weights.{name}"), value, 0.0, LARGEST_WEIGHT);
    }
    broken.within("controller.weights.torque_per_limit2", weights.torque_per_limit2, 1e-6, LARGEST_WEIGHT);
    broken.within("controller.constraints.torque_fraction", limits.torque_fraction, 0.01, 1.0);
    broken.within("controller.constraints.friction", limits.friction, 0.01, 10.0);
    broken.within("controller.constraints.cop_margin_m", limits.cop_margin_m, 0.0, 1.0);
    broken.within("controller.constraints.yaw_arm_m", limits.yaw_arm_m, 1e-4, 10.0)
}

fn violation(key: &str, value: String, rule: &str, remedy: &str) -> Violation {
    Violation { key: key.to_owned(), value, rule: rule.to_owned(), remedy: remedy.to_owned() }
}

impl Broken {
    fn push(&mut self, rule: Violation) {
        self.rules.push(rule);
    }

    /// A name becomes part of a folder's name.
    fn check_name(&mut self, name: &str) {
        let unfit = |c: char| c == '/' || c == '\\' || c.is_control();
        let rule = if name.chars().any(unfit) {
            "a name has no slashes, backslashes or control characters: it becomes part of a path"
        } else if name.starts_with('.') {
            "a name does not begin with a dot: it becomes the name of a folder"
        } else if name.len() > LONGEST_NAME {
            "a name has at most 100 bytes: it becomes part of a file's name"
        } else {
            return;
        };
        let shown: String = name.chars().take(LONGEST_NAME).collect();
        self.push(violation("name", format!("{shown:?}"), rule, "take a word, such as \"stand\""));
    }

    /// NaN is in no range.
    fn within(&mut self, key: &str, value: f64, least: f64, most: f64) {
        if (least..=most).contains(&value) {
            return;
        }
        let rule = match most {
            f64::MAX => format!("must be a number from {least} on"),
            _ => format!("must lie in {least} .. {most}"),
        };
        let nearest = if value > most { most } else { least };
        self.push(violation(
            key,
            value.to_string(),
            &rule,
            &format!("the nearest allowed value is {nearest}"),
        ));
    }

    fn positive(&mut self, key: &str, value: f64, most: f64) {
        if value > 0.0 && value <= most {
            return;
        }
        let rule = format!("must be above 0 and at most {most}");
        self.push(violation(key, value.to_string(), &rule, "give a time in that range"));
    }

    fn each(&mut self, key: &str, values: &[f64], largest: f64) {
        if values.iter().all(|value| value.abs() <= largest) {
            return;
        }
        let rule = format!("every component must be a number of at most {largest}");
        self.push(violation(key, format!("{values:?}"), &rule, "check the sign and the unit"));
    }

    /// `steps` plant steps must be a whole number of at least one.
    fn whole(&mut self, key: &str, value: f64, step_key: &str, steps: f64) {
        let nearest = steps.round().max(1.0);
        if (steps - nearest).abs() <= WHOLE_STEPS * nearest {
            return;
        }
        let rule = format!("must be a whole number of steps of `{step_key}`, not {steps}");
        let remedy = format!("take the value that gives {nearest} steps, or change `{step_key}`");
        self.push(violation(key, value.to_string(), &rule, &remedy));
    }

    fn named(&mut self, key: &str, value: &str, what: &str) {
        if !value.is_empty() {
            return;
        }
        self.push(violation(key, "\"\"".to_owned(), "is missing", &format!("name {what}")));
    }
}
