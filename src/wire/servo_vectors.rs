//! What the servo answers to a row of commands, good and bad, as numbers for other languages: `python/tests/servo_vectors.json`.

use delmpc_messages::{
    Command, FallbackLevel, FootReading, MAX_JOINTS, ServoReadings, Verdict, foot, joint_set_hash,
};
use delmpc_servo::prelude::{AffineLaw, Servo, WatchdogConfig};
use delmpc_transport::SplitMix64;
use serde_json::{Value, json};

const JOINTS: usize = 3;
const MS: u64 = 1_000_000;
const FILE: &str = "python/tests/servo_vectors.json";

/// A number between -1 and 1 with few digits.
fn number(random: &mut SplitMix64) -> f64 {
    (random.next_u64() % 2001) as f64 * 1e-3 - 1.0
}

fn command(random: &mut SplitMix64, sequence: u64, now_ns: u64) -> Command {
    let mut command = Command::new(5, joint_set_hash(&["a", "b", "c"]), JOINTS as u32);
    command.header.sequence = sequence;
    (command.valid_from_ns, command.valid_until_ns) = (now_ns + 2 * MS, now_ns + 12 * MS);
    command.fallback_level = FallbackLevel::FreshSolution as u32;
    command.n_segments = 3;
    command.rate_samples = 1 + (random.next_u64() % 5) as u32;
    for (index, segment) in command.segments[..3].iter_mut().enumerate() {
        segment.begin_ns = index as u64 * 4 * MS;
        for joint in 0..JOINTS {
            segment.torque[joint] = 20.0 * number(random);
            segment.torque_lower[joint] = -15.0 + number(random);
            segment.torque_upper[joint] = 15.0 + number(random);
            segment.position_ref[joint] = number(random);
            segment.velocity_ref[joint] = number(random);
            segment.acceleration_ref[joint] = 10.0 * number(random);
        }
        for axis in 0..3 {
            segment.imu_angle_ref[axis] = number(random);
            segment.imu_rate_ref[axis] = number(random);
            segment.imu_acceleration_ref[axis] = number(random);
        }
    }
    for joint in 0..JOINTS {
        for column in 0..JOINTS {
            command.gain[joint][column] = 5.0 * number(random);
            command.gain[joint][MAX_JOINTS + column] = number(random);
        }
        command.imu_gain[joint].iter_mut().for_each(|gain| *gain = 3.0 * number(random));
        command.unloaded_stiffness[joint] = 10.0 + number(random);
        command.unloaded_damping[joint] = 1.0 + number(random);
    }
    command.imu_rate_bias.iter_mut().for_each(|bias| *bias = 0.01 * number(random));
    command.load_foot[1] = 1;
    command.load_foot[2] = 2;
    command.full_load_n[0] = 50.0;
    command
}

/// Only what is used of a command.
fn told(command: &Command) -> Value {
    let gain = |row: &[f64; 2 * MAX_JOINTS]| [&row[..JOINTS], &row[MAX_JOINTS..MAX_JOINTS + JOINTS]].concat();
    json!({
        "sequence": command.header.sequence,
        "valid_from_ns": command.valid_from_ns,
        "valid_until_ns": command.valid_until_ns,
        "verdict": command.verdict,
        "fallback_level": command.fallback_level,
        "rate_samples": command.rate_samples,
        "segments": command.segments[..3].iter().map(|segment| json!({
            "begin_ns": segment.begin_ns,
            "torque": segment.torque[..JOINTS],
            "torque_lower": segment.torque_lower[..JOINTS],
            "torque_upper": segment.torque_upper[..JOINTS],
            "position_ref": segment.position_ref[..JOINTS],
            "velocity_ref": segment.velocity_ref[..JOINTS],
            "acceleration_ref": segment.acceleration_ref[..JOINTS],
            "imu_angle_ref": segment.imu_angle_ref,
            "imu_rate_ref": segment.imu_rate_ref,
            "imu_acceleration_ref": segment.imu_acceleration_ref,
        })).collect::<Vec<_>>(),
        "gain": command.gain[..JOINTS].iter().map(gain).collect::<Vec<_>>(),
        "imu_gain": command.imu_gain[..JOINTS],
        "imu_rate_bias": command.imu_rate_bias,
        "load_foot": command.load_foot[..JOINTS],
        "full_load_n": command.full_load_n,
        "unloaded_stiffness": command.unloaded_stiffness[..JOINTS],
        "unloaded_damping": command.unloaded_damping[..JOINTS],
    })
}

/// Commands every 5 ms; then bad ones, then silence down to the last level, then a controller that comes back.
fn vectors() -> Value {
    let mut random = SplitMix64::new(24);
    let law = AffineLaw::joint_stiffness(&[1.0, -2.0, 0.5], &[0.1, 0.2, -0.3], &[30.0; 3], &[2.0; 3]);
    let config = WatchdogConfig {
        hold_gains: 0.01,
        static_law: 0.02,
        gravity_hold: 0.03,
        damping_only: 0.04,
        law: Some(law),
        stiffness: vec![4.0, 5.0, 6.0],
        damping: vec![0.4, 0.5, 0.6],
        good_commands: 3,
    };
    let hash = joint_set_hash(&["a", "b", "c"]);
    let mut servo = Servo::new(JOINTS, hash, config).unwrap();
    let (mut steps, mut sequence) = (Vec::new(), 0);
    for ms in 0..260_u64 {
        let now_ns = ms * MS;
        let mut sent = None;
        let speaks = !(60..210).contains(&ms);
        if speaks && ms % 5 == 0 && ms > 0 {
            sequence += 1;
            let mut command = command(&mut random, sequence, now_ns);
            match ms {
                20 => command.header.sequence = 2,
                25 => command.segments[1].torque[2] = 1e12,
                30 => command.valid_until_ns = command.valid_from_ns - 1,
                35 => command.header.sequence += 20_000_000,
                40 => command.verdict = Verdict::Late as u32,
                45 => command.segments[1].begin_ns = 0,
                50 => command.segments[0].torque_lower[0] = 99.0,
                55 => {
                    (command.valid_from_ns, command.valid_until_ns) =
                        (now_ns + 30_000 * MS, now_ns + 30_001 * MS)
                }
                _ => {}
            }
            let taken = servo.accept(&command, now_ns).is_ok();
            sent = Some(json!({ "command": told(&command), "taken": taken }));
        }
        let position: Vec<f64> = (0..JOINTS).map(|_| number(&mut random)).collect();
        let velocity: Vec<f64> = (0..JOINTS).map(|_| number(&mut random)).collect();
        let angle = [0; 3].map(|_| number(&mut random));
        let rate = [0; 3].map(|_| number(&mut random));
        let load_n = 25.0 + 40.0 * number(&mut random);
        let reading =
            FootReading { flags: foot::WRENCH, reserved: 0, torque_s: [0.0; 3], force_s: [0.0, 0.0, load_n] };
        let readings = ServoReadings {
            position: &position,
            velocity: &velocity,
            imu: Some((angle, rate)),
            feet: &[reading],
        };
        let mut torque = [0.0; JOINTS];
        servo.torque_into(now_ns, &readings, &mut torque);
        steps.push(json!({
            "now_ns": now_ns, "sent": sent, "position": position, "velocity": velocity, "imu_angle": angle, "imu_rate": rate, "load_n": load_n,
            "torque": torque, "level": servo.level() as u32, "applied_sequence": servo.applied_sequence(),
            "on_watchdog": servo.on_watchdog(now_ns),
        }));
    }
    let (taken, refused) = servo.counts();
    json!({
        "joints": ["a", "b", "c"],
        "joint_set_hash": format!("{hash:016x}"),
        "message_run_id": 5,
        "watchdog": {
            "hold_gains_s": 0.01, "static_law_s": 0.02, "gravity_hold_s": 0.03, "damping_only_s": 0.04, "good_commands": 3,
            "stiffness": [4.0, 5.0, 6.0], "damping": [0.4, 0.5, 0.6],
            "law": {
                "torque": [1.0, -2.0, 0.5], "position_ref": [0.1, 0.2, -0.3],
                "gain": [[-30.0, 0.0, 0.0, -2.0, 0.0, 0.0], [0.0, -30.0, 0.0, 0.0, -2.0, 0.0], [0.0, 0.0, -30.0, 0.0, 0.0, -2.0]],
            },
        },
        "taken": taken, "refused": refused, "steps": steps,
    })
}

/// What is committed is what this servo answers. `DELMPC_WRITE_VECTORS=1 cargo test -p delmpc servo_vectors` writes it again.
#[test]
fn the_committed_vectors_are_those_of_this_servo() {
    let text = serde_json::to_string(&vectors()).unwrap() + "\n";
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(FILE);
    if std::env::var_os("DELMPC_WRITE_VECTORS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let found: Value =
        serde_json::from_str(&std::fs::read_to_string(&path).unwrap_or_default()).unwrap_or_default();
    assert_eq!(found["steps"].as_array().map(Vec::len), Some(260), "{FILE} is missing");
    let mut levels = std::collections::BTreeSet::new();
    let ours = vectors();
    for (found, ours) in found["steps"].as_array().unwrap().iter().zip(ours["steps"].as_array().unwrap()) {
        levels.insert(ours["level"].as_u64());
        for key in ["now_ns", "sent", "level", "applied_sequence", "on_watchdog"] {
            assert_eq!(found[key], ours[key], "{FILE}: {key} at {}", ours["now_ns"]);
        }
        for joint in 0..JOINTS {
            let (found, ours) =
                (found["torque"][joint].as_f64().unwrap(), ours["torque"][joint].as_f64().unwrap());
            assert!((found - ours).abs() <= 1e-12 * ours.abs().max(1.0), "{FILE}: {found} {ours}");
        }
    }
    assert_eq!(levels.len(), 6, "every level of the watchdog is in it");
    assert_eq!((&found["taken"], &found["refused"]), (&ours["taken"], &ours["refused"]));
}
