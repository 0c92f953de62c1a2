//! How to damage a message.

use delmpc_messages::{Command, MAX_JOINTS, MAX_SEGMENTS, Message, PlantState};

/// A message that [`crate::FaultInjector`] can damage.
pub trait Corrupt: Message {
    /// Moves the times in the message by `shift_ns`.
    fn shift_time(&mut self, shift_ns: i64);

    /// Overwrites one of the numbers in use, chosen by `choice`.
    fn set_number(&mut self, choice: u64, value: f64);

    /// Says that the message has one joint more than it has.
    fn add_joint(&mut self);
}

impl Corrupt for PlantState {
    fn shift_time(&mut self, shift_ns: i64) {
        self.time_ns = self.time_ns.saturating_add_signed(shift_ns);
    }

    fn set_number(&mut self, choice: u64, value: f64) {
        let n = joints(self.n_joints);
        let numbers = [
            &mut self.position[..n],
            &mut self.velocity[..n],
            &mut self.imu_angle,
            &mut self.imu_velocity,
            &mut self.imu_angular_velocity,
            &mut self.imu_specific_force,
            &mut self.feet[0].torque_s,
            &mut self.feet[0].force_s,
        ];
        set_one(numbers, choice, value);
    }

    fn add_joint(&mut self) {
        self.n_joints = self.n_joints.wrapping_add(1);
    }
}

impl Corrupt for Command {
    fn shift_time(&mut self, shift_ns: i64) {
        for time in [&mut self.state_time_ns, &mut self.valid_from_ns, &mut self.valid_until_ns] {
            *time = time.saturating_add_signed(shift_ns);
        }
    }

    fn set_number(&mut self, choice: u64, value: f64) {
        let n = joints(self.n_joints);
        let row = choice as usize % n.max(1);
        let (position_gain, velocity_gain) = self.gain[row].split_at_mut(MAX_JOINTS);
        let used = (self.n_segments as usize).clamp(1, MAX_SEGMENTS);
        let segment = &mut self.segments[(choice >> 32) as usize % used];
        let numbers = [
            &mut segment.torque[..n],
            &mut segment.torque_lower[..n],
            &mut segment.torque_upper[..n],
            &mut segment.position_ref[..n],
            &mut segment.velocity_ref[..n],
            &mut segment.acceleration_ref[..n],
            &mut position_gain[..n],
            &mut velocity_gain[..n],
            &mut self.imu_gain[row][..if n == 0 { 0 } else { 6 }],
            &mut segment.imu_angle_ref,
            &mut segment.imu_rate_ref,
        ];
        set_one(numbers, choice, value);
    }

    fn add_joint(&mut self) {
        self.n_joints = self.n_joints.wrapping_add(1);
    }
}

fn joints(n_joints: u32) -> usize {
    (n_joints as usize).min(MAX_JOINTS)
}

/// Counts through the slices one after the other, and round again.
fn set_one<const FIELDS: usize>(numbers: [&mut [f64]; FIELDS], choice: u64, value: f64) {
    let total: usize = numbers.iter().map(|field| field.len()).sum();
    if total == 0 {
        return;
    }
    let chosen = (choice % total as u64) as usize;
    if let Some(number) = numbers.into_iter().flatten().nth(chosen) {
        *number = value;
    }
}
