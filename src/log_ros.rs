//! Messages of ROS 2 that viewers and tools of that world know: transforms and joint states, in CDR behind a header of four bytes.
//!
//! Source: OMG, *DDS for eXtremely Large Data Types / CDR* encoding as ROS 2 uses it (little-endian, alignment from behind the header);
//! definitions of the packages `tf2_msgs`, `geometry_msgs`, `sensor_msgs`, `std_msgs`, `builtin_interfaces`.

use delmpc_mechanics::prelude::RigidTransform;
use nalgebra::UnitQuaternion;

/// Bytes before the content of every message: little-endian CDR, no options.
pub const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Name of the transforms' type.
pub const TF_NAME: &str = "tf2_msgs/msg/TFMessage";
/// Its definition.
pub const TF_SCHEMA: &str = "\
geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
/// Name of the joint states' type.
pub const JOINT_STATE_NAME: &str = "sensor_msgs/msg/JointState";
/// Its definition.
pub const JOINT_STATE_SCHEMA: &str = "\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

/// A message that is being written.
struct Cdr(Vec<u8>);

impl Cdr {
    fn new() -> Self {
        Self(ENCAPSULATION.to_vec())
    }

    fn align(&mut self, to: usize) {
        let content = self.0.len() - ENCAPSULATION.len();
        self.0.resize(ENCAPSULATION.len() + content.next_multiple_of(to), 0);
    }

    fn word(&mut self, value: u32) {
        self.align(4);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.word(text.len() as u32 + 1);
        self.0.extend_from_slice(text.as_bytes());
        self.0.push(0);
    }

    fn numbers(&mut self, values: &[f64]) {
        self.align(8);
        values.iter().for_each(|value| self.0.extend_from_slice(&value.to_le_bytes()));
    }

    fn list(&mut self, values: &[f64]) {
        self.word(values.len() as u32);
        if !values.is_empty() {
            self.numbers(values);
        }
    }

    fn header(&mut self, time_ns: u64, frame: &str) {
        self.word((time_ns / 1_000_000_000) as u32);
        self.word((time_ns % 1_000_000_000) as u32);
        self.text(frame);
    }
}

/// `tf2_msgs/TFMessage`: parent, child, and the child's pose in it.
pub fn transforms<'a>(
    time_ns: u64,
    poses: impl ExactSizeIterator<Item = (&'a str, &'a str, RigidTransform)>,
) -> Vec<u8> {
    let mut message = Cdr::new();
    message.word(poses.len() as u32);
    for (parent, child, pose) in poses {
        message.header(time_ns, parent);
        message.text(child);
        message.numbers(pose.translation.as_slice());
        message.numbers(UnitQuaternion::from_matrix(&pose.rotation).coords.as_slice());
    }
    message.0
}

/// `sensor_msgs/JointState`.
pub fn joint_state(time_ns: u64, names: &[String], values: [&[f64]; 3]) -> Vec<u8> {
    let mut message = Cdr::new();
    message.header(time_ns, "");
    message.word(names.len() as u32);
    names.iter().for_each(|name| message.text(name));
    values.iter().for_each(|list| message.list(list));
    message.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_follows_a_text_is_aligned_from_behind_the_header() {
        let pose = RigidTransform::from_translation(nalgebra::Vector3::new(1.0, 2.0, 3.0));
        let bytes = transforms(1_500_000_000, [("world", "leg", pose)].into_iter());
        // Header 4, length 4, stamp 8, "world" 4 + 6, padding 2, "leg" 4 + 4, seven numbers.
        assert_eq!(bytes.len(), 4 + 4 + 8 + 10 + 2 + 8 + 7 * 8);
        assert_eq!(&bytes[bytes.len() - 56..bytes.len() - 48], &1.0_f64.to_le_bytes());
        assert_eq!((bytes[8], &bytes[12..16]), (1, &500_000_000_u32.to_le_bytes()[..]));
    }

    #[test]
    fn an_empty_list_is_its_length() {
        let bytes = joint_state(0, &[], [&[], &[], &[]]);
        assert_eq!(bytes.len(), 4 + 8 + 4 + 1 + 3 + 4 + 3 * 4);
    }
}
