//! What comes out of shared memory, and out of a log.

use bytemuck::Zeroable;
use delmpc::log::{read_command, read_record};
use delmpc::log_reader::{Item, LogReader};
use delmpc::truth::Truth;
use delmpc_messages::{
    Command, FallbackLevel, FootReading, Heartbeat, MAX_JOINTS, PlantState, ServoReadings,
};
use delmpc_servo::servo::{Servo, WatchdogConfig};

use crate::numbers::Numbers;

const HASH: u64 = 9;
const JOINTS: usize = 3;
const MS: u64 = 1_000_000;

/// A log.
pub fn mcap(data: &[u8]) {
    let Some(content) = data.strip_prefix(b"\x89MCAP0\r\n") else {
        return mcap_of(data);
    };
    mcap_of(content);
}

fn mcap_of(content: &[u8]) {
    let mut reader = LogReader::new(content);
    let mut items = 0_u64;
    let end = reader.each(|item| {
        if let Item::Message { data, .. } = item {
            let _ = (read_command(data), read_record::<PlantState>(data), read_record::<Truth>(data));
        }
        items += 1;
        Ok(items < 1_000_000)
    });
    assert!(end.is_ok(), "a slice can always be read");
}

/// A good command with some bytes of another.
fn damaged<T: bytemuck::Pod>(good: T, numbers: &mut Numbers<'_>) -> T {
    let mut message = good;
    let bytes = bytemuck::bytes_of_mut(&mut message);
    for _ in 0..1 + numbers.up_to(6) {
        let place = numbers.word() as usize % bytes.len();
        // Fields of the head more often than the thousands of gains.
        let place = if numbers.byte() % 2 == 0 { place % 120.min(bytes.len()) } else { place };
        let place = place / 8 * 8;
        let value = match numbers.byte() % 4 {
            0 => u64::MAX,
            1 => numbers.number().to_bits(),
            2 => numbers.word(),
            _ => u64::from(numbers.byte()),
        };
        let end = (place + 8).min(bytes.len());
        bytes[place..end].copy_from_slice(&value.to_le_bytes()[..end - place]);
    }
    message
}

fn good(sequence: u64, now_ns: u64) -> Command {
    let mut command = Command::new(1, HASH, JOINTS as u32);
    command.header.sequence = sequence;
    (command.valid_from_ns, command.valid_until_ns) = (now_ns, now_ns + 10 * MS);
    command.fallback_level = FallbackLevel::FreshSolution as u32;
    command.segments[0].torque[0] = 5.0;
    command.gain[0][0] = -1.0;
    command
}

/// Commands of any content at a plant, with a good one after each; states and signs of life of any content.
pub fn messages(data: &[u8]) {
    let mut numbers = Numbers(data);
    let Ok(mut servo) = Servo::new(JOINTS, HASH, WatchdogConfig::default()) else { return };
    let mut torque = [0.0_f64; JOINTS];
    let feet = [FootReading { force_s: [1.0, 2.0, 300.0], ..FootReading::zeroed() }; 2];
    // All that a servo may read, so that every term of the law is computed.
    let readings = ServoReadings {
        imu: Some(([0.1; 3], [0.2; 3])),
        feet: &feet,
        ..ServoReadings::joints(&[0.1; JOINTS], &[0.2; JOINTS])
    };
    let mut now_ns = 0;
    for _ in 0..16 {
        if numbers.is_over() {
            break;
        }
        let hostile = damaged(good(servo.applied_sequence() + 1, now_ns), &mut numbers);
        let taken = servo.accept(&hostile, now_ns).is_ok();
        assert!(!taken || hostile.validate(HASH, JOINTS).is_ok());
        for later_ns in [0, MS, 9 * MS] {
            servo.torque_into(now_ns + later_ns, &readings, &mut torque);
            assert!(torque.iter().all(|torque| torque.is_finite()), "a torque that is no number");
        }
        now_ns += 10 * MS;
        // What a controller that hears the plant sends next.
        let next = good(servo.applied_sequence() + 1, now_ns);
        servo.accept(&next, now_ns).expect("the next good command is taken");
        servo.torque_into(now_ns, &readings, &mut torque);
        assert_eq!(servo.applied_sequence(), next.header.sequence, "the next good command acts");
        now_ns += MS;

        let state = damaged(PlantState::new(1, HASH, JOINTS as u32), &mut numbers);
        if state.validate(HASH, JOINTS).is_ok() {
            assert!(state.position[..JOINTS].iter().all(|q| q.is_finite()));
        }
        let _ = hostile.segment_at(numbers.word());
        let _ = hostile.is_valid_at(numbers.word());
        let slices = [[0.1; MAX_JOINTS]; 2];
        let n = (hostile.n_joints as usize).min(MAX_JOINTS);
        let joints = ServoReadings { position: &slices[0][..n], velocity: &slices[1][..n], ..readings };
        let _ = hostile.torque_into(now_ns, &joints, &mut [0.0; MAX_JOINTS][..n]);
        let _ = damaged(Heartbeat::zeroed(), &mut numbers).validate(HASH);
    }
    let mut packed = Vec::new();
    delmpc::log_command::pack(&damaged(good(1, 0), &mut numbers), &mut packed);
    let _ = delmpc::log_command::unpack(&packed);
    let _ = delmpc::log_command::unpack(data);
}
