//! A command as it is in the log: joints and segments in use, and nothing else.
//!
//! | bytes | content |
//! |---|---|
//! | up to [`Command::segments`] | as in memory |
//! | list | segments in use: begin, then six lists of a number per joint, then the references of the inertial unit |
//! | list | gain row by row: a row per joint, first positions, then velocities |
//! | list | gain on the inertial unit, six numbers a joint |
//! | up to the lists | bias of the gyroscope, feet of the joints, loads, as in memory |
//! | two lists | stiffness and damping of an unloaded leg |
//! | the rest | report and estimate, as in memory |
//!
//! A list is its length as 32-bit number, padding to eight bytes, its entries: CDR, as the schema of the channel says.

use std::mem::{offset_of, size_of};

use bytemuck::{bytes_of, cast_slice};
use delmpc_messages::{Command, CycleReport, MAX_JOINTS, MAX_SEGMENTS, Segment, StateEstimate};

/// Bytes of the largest command.
pub const MOST_BYTES: usize = size_of::<Command>() + 40 + MAX_SEGMENTS * 6 * 8;

const HEAD: usize = offset_of!(Command, segments);

/// Appends a command to `bytes`. No allocation when there is room for [`MOST_BYTES`].
pub fn pack(command: &Command, bytes: &mut Vec<u8>) {
    let n = (command.n_joints as usize).min(MAX_JOINTS);
    let segments = &command.segments[..(command.n_segments as usize).min(MAX_SEGMENTS)];
    bytes.extend_from_slice(&bytes_of(command)[..HEAD]);
    put_length(bytes, segments.len());
    for segment in segments {
        bytes.extend_from_slice(&segment.begin_ns.to_le_bytes());
        for list in lists(segment) {
            put_length(bytes, n);
            bytes.extend_from_slice(cast_slice(&list[..n]));
        }
        for list in [&segment.imu_angle_ref, &segment.imu_rate_ref, &segment.imu_acceleration_ref] {
            bytes.extend_from_slice(cast_slice(list));
        }
    }
    put_length(bytes, 2 * n * n);
    for row in &command.gain[..n] {
        bytes.extend_from_slice(cast_slice(&row[..n]));
        bytes.extend_from_slice(cast_slice(&row[MAX_JOINTS..MAX_JOINTS + n]));
    }
    put_length(bytes, 6 * n);
    for row in &command.imu_gain[..n] {
        bytes.extend_from_slice(cast_slice(row));
    }
    bytes.extend_from_slice(cast_slice(&command.imu_rate_bias));
    bytes.extend_from_slice(cast_slice(&command.load_foot));
    bytes.extend_from_slice(cast_slice(&command.full_load_n));
    for list in [&command.unloaded_stiffness, &command.unloaded_damping] {
        put_length(bytes, n);
        bytes.extend_from_slice(cast_slice(&list[..n]));
    }
    bytes.extend_from_slice(bytes_of(&command.report));
    bytes.extend_from_slice(bytes_of(&command.estimate));
}

/// The command in the bytes; what it does not use is as in a new command. `None` when they are not those of a command.
pub fn unpack(bytes: &[u8]) -> Option<Command> {
    let mut rest = Rest(bytes);
    let mut command = Command::new(0, 0, 0);
    bytemuck::bytes_of_mut(&mut command)[..HEAD].copy_from_slice(rest.take(HEAD)?);
    let n = command.n_joints as usize;
    let count = rest.length()?;
    if n > MAX_JOINTS || count > MAX_SEGMENTS || count != (command.n_segments as usize).min(MAX_SEGMENTS) {
        return None;
    }
    for segment in &mut command.segments[..count] {
        segment.begin_ns = rest.word()?;
        let Segment {
            torque, torque_lower, torque_upper, position_ref, velocity_ref, acceleration_ref, ..
        } = segment;
        for list in [torque, torque_lower, torque_upper, position_ref, velocity_ref, acceleration_ref] {
            rest.length().filter(|length| *length == n)?;
            rest.numbers(&mut list[..n])?;
        }
        let Segment { imu_angle_ref, imu_rate_ref, imu_acceleration_ref, .. } = segment;
        for list in [imu_angle_ref, imu_rate_ref, imu_acceleration_ref] {
            rest.numbers(list)?;
        }
    }
    rest.length().filter(|length| *length == 2 * n * n)?;
    for row in &mut command.gain[..n] {
        let (positions, velocities) = row.split_at_mut(MAX_JOINTS);
        rest.numbers(&mut positions[..n])?;
        rest.numbers(&mut velocities[..n])?;
    }
    rest.length().filter(|length| *length == 6 * n)?;
    for row in &mut command.imu_gain[..n] {
        rest.numbers(row)?;
    }
    rest.numbers(&mut command.imu_rate_bias)?;
    let feet = rest.take(size_of_val(&command.load_foot))?;
    bytemuck::cast_slice_mut(&mut command.load_foot).copy_from_slice(feet);
    rest.numbers(&mut command.full_load_n)?;
    for list in [&mut command.unloaded_stiffness, &mut command.unloaded_damping] {
        rest.length().filter(|length| *length == n)?;
        rest.numbers(&mut list[..n])?;
    }
    command.report = bytemuck::try_pod_read_unaligned(rest.take(size_of::<CycleReport>())?).ok()?;
    command.estimate = bytemuck::try_pod_read_unaligned(rest.take(size_of::<StateEstimate>())?).ok()?;
    rest.0.is_empty().then_some(command)
}

fn lists(segment: &Segment) -> [&[f64; MAX_JOINTS]; 6] {
    let Segment { torque, torque_lower, torque_upper, position_ref, velocity_ref, acceleration_ref, .. } =
        segment;
    [torque, torque_lower, torque_upper, position_ref, velocity_ref, acceleration_ref]
}

fn put_length(bytes: &mut Vec<u8>, length: usize) {
    bytes.extend_from_slice(&(length as u64).to_le_bytes());
}

/// Bytes not taken yet.
struct Rest<'a>(&'a [u8]);

impl<'a> Rest<'a> {
    fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(taken)
    }

    fn word(&mut self) -> Option<u64> {
        self.take(8).and_then(|bytes| bytemuck::try_pod_read_unaligned(bytes).ok())
    }

    /// A length and its padding, which is zero.
    fn length(&mut self) -> Option<usize> {
        self.word().and_then(|word| u32::try_from(word).ok()).map(|length| length as usize)
    }

    fn numbers(&mut self, into: &mut [f64]) -> Option<()> {
        let bytes = self.take(8 * into.len())?;
        bytemuck::cast_slice_mut(into).copy_from_slice(bytes);
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use delmpc_transport::{Corrupt, SplitMix64};

    fn command(n: u32, segments: u32, random: &mut SplitMix64) -> Command {
        let mut command = Command::new(1, 2, n);
        (command.n_segments, command.header.sequence) = (segments, 7);
        for _ in 0..500 {
            command.set_number(random.next_u64(), random.next_u64() as f64);
        }
        command.report.qp_solves = 3;
        command
    }

    #[test]
    fn what_is_in_use_comes_back_bit_by_bit() {
        let mut random = SplitMix64::new(4);
        for (n, segments) in [(0, 1), (1, 1), (6, 3), (30, 8), (32, 8)] {
            let mut sent = command(n, segments, &mut random);
            if n > 0 {
                sent.set_number(5, f64::NAN);
            }
            let mut bytes = Vec::new();
            pack(&sent, &mut bytes);
            assert!(bytes.len() <= MOST_BYTES);
            let back = unpack(&bytes).unwrap();
            assert_eq!(bytes_of(&back), bytes_of(&sent), "{n} joints");
        }
    }

    #[test]
    fn small_robots_have_small_commands() {
        let mut bytes = Vec::new();
        pack(&command(6, 3, &mut SplitMix64::new(1)), &mut bytes);
        assert!(bytes.len() < size_of::<Command>() / 10, "{}", bytes.len());
    }

    #[test]
    fn damaged_bytes_are_no_command_or_another_one() {
        let mut random = SplitMix64::new(9);
        let mut bytes = Vec::new();
        pack(&command(6, 3, &mut random), &mut bytes);
        for length in 0..bytes.len() {
            assert!(unpack(&bytes[..length]).is_none());
        }
        for _ in 0..20_000 {
            let mut damaged = bytes.clone();
            let place = random.up_to(damaged.len() as u64 - 1) as usize;
            damaged[place] = random.next_u64() as u8;
            if let Some(command) = unpack(&damaged) {
                let mut again = Vec::new();
                pack(&command, &mut again);
                assert_eq!(again, damaged);
            }
        }
    }
}
