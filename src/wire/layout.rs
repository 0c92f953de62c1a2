//! The layout of every payload: offsets, sizes and types from the compiler, what a field means from the comment above it, unit and frame from
//! the tables here.

use std::mem::offset_of;

use delmpc_messages::{
    Command, CycleReport, FootReading, Header, Heartbeat, PlantState, Segment, StateEstimate,
};
use serde::Serialize;

/// Where the comments are.
const SOURCES: [&str; 5] = [
    include_str!("../../shared/messages/src/header.rs"),
    include_str!("../../shared/messages/src/plant_state.rs"),
    include_str!("../../shared/messages/src/command.rs"),
    include_str!("../../shared/messages/src/cycle_report.rs"),
    include_str!("../../shared/messages/src/heartbeat.rs"),
];

/// A field of a payload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Field {
    /// Its name.
    pub name: &'static str,
    /// Bytes from the begin of its structure.
    pub offset: usize,
    /// Bytes.
    pub size: usize,
    /// `u32`, `u64`, `f64`, or the name of a structure.
    #[serde(rename = "type")]
    pub kind: &'static str,
    /// Lengths of an array, the outermost first; empty: a single value.
    pub shape: Vec<usize>,
    /// Unit of a joint that turns, where joints may be of either kind.
    pub unit: &'static str,
    /// Axes or point it is told in.
    pub frame: &'static str,
    /// What it means.
    pub meaning: String,
}

/// A structure of a payload, or a payload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Layout {
    /// Its name.
    pub name: &'static str,
    /// Bytes.
    pub size: usize,
    /// Its fields in order, without a gap.
    pub fields: Vec<Field>,
}

/// What a field may be made of.
trait Described {
    const KIND: &'static str;
    fn shape() -> Vec<usize> {
        Vec::new()
    }
}

macro_rules! described {
    ($($type:ty => $name:literal),+) => {
        $(impl Described for $type { const KIND: &'static str = $name; })+
    };
}
described!(u32 => "u32", u64 => "u64", f64 => "f64", Header => "Header", Segment => "Segment", CycleReport => "CycleReport",
    StateEstimate => "StateEstimate", FootReading => "FootReading");

impl<T: Described, const N: usize> Described for [T; N] {
    const KIND: &'static str = T::KIND;
    fn shape() -> Vec<usize> {
        [vec![N], T::shape()].concat()
    }
}

/// Type, lengths and size of what a projection leads to.
fn of<S, T: Described>(_: impl Fn(&S) -> &T) -> (&'static str, Vec<usize>, usize) {
    (T::KIND, T::shape(), size_of::<T>())
}

macro_rules! layout {
    ($type:ident, [$(($field:ident, $unit:literal, $frame:literal)),+ $(,)?]) => {{
        let fields = vec![$({
            let (kind, shape, size) = of(|whole: &$type| &whole.$field);
            let meaning = meaning(stringify!($type), stringify!($field));
            let (name, offset) = (stringify!($field), offset_of!($type, $field));
            Field { name, offset, size, kind, shape, unit: $unit, frame: $frame, meaning }
        }),+];
        Layout { name: stringify!($type), size: size_of::<$type>(), fields }
    }};
}

/// All structures, those that are parts of others first.
pub fn layouts() -> Vec<Layout> {
    vec![
        layout!(
            Header,
            [
                (magic, "", ""),
                (version, "", ""),
                (joint_set_hash, "", ""),
                (run_id, "", ""),
                (sequence, "", ""),
                (sent_at_ns, "ns", "machine"),
            ]
        ),
        layout!(
            FootReading,
            [(flags, "", ""), (reserved, "", ""), (torque_s, "N m", "sole"), (force_s, "N", "sole"),]
        ),
        plant_state(),
        segment(),
        cycle_report(),
        layout!(
            StateEstimate,
            [
                (known, "", ""),
                (feet_loaded, "", ""),
                (base_orientation_w, "1", "world"),
                (base_angular_velocity_b, "rad/s", "base link"),
                (base_linear_velocity_b, "m/s", "base link"),
                (gyro_bias, "rad/s", "inertial unit"),
                (accelerometer_bias, "m/s²", "inertial unit"),
            ]
        ),
        command(),
        layout!(
            Heartbeat,
            [
                (header, "", ""),
                (time_ns, "ns", "machine"),
                (role, "", ""),
                (pid, "", ""),
                (state, "", ""),
                (fault_code, "", ""),
            ]
        ),
    ]
}

fn plant_state() -> Layout {
    layout!(
        PlantState,
        [
            (header, "", ""),
            (time_ns, "ns", "plant"),
            (applied_command_sequence, "", ""),
            (clock, "", ""),
            (n_joints, "", ""),
            (n_feet, "", ""),
            (sensors, "", ""),
            (status_flags, "", ""),
            (watchdog_level, "", ""),
            (position, "rad", "joint"),
            (velocity, "rad/s", "joint"),
            (applied_torque, "N m", "joint"),
            (imu_angle, "rad", "inertial unit"),
            (imu_velocity, "m/s", "inertial unit"),
            (imu_angular_velocity, "rad/s", "inertial unit"),
            (imu_specific_force, "m/s²", "inertial unit"),
            (feet, "", ""),
            (base_position_w, "m", "world"),
            (base_orientation_w, "1", "world"),
            (base_angular_velocity_b, "rad/s", "base link"),
            (base_linear_velocity_b, "m/s", "base link"),
        ]
    )
}

fn segment() -> Layout {
    layout!(
        Segment,
        [
            (begin_ns, "ns", "command"),
            (torque, "N m", "joint"),
            (torque_lower, "N m", "joint"),
            (torque_upper, "N m", "joint"),
            (position_ref, "rad", "joint"),
            (velocity_ref, "rad/s", "joint"),
            (acceleration_ref, "rad/s²", "joint"),
            (imu_angle_ref, "rad", "inertial unit"),
            (imu_rate_ref, "rad/s", "inertial unit"),
            (imu_acceleration_ref, "rad/s²", "inertial unit"),
        ]
    )
}

fn cycle_report() -> Layout {
    layout!(
        CycleReport,
        [
            (state_in_ns, "ns", ""),
            (shift_ns, "ns", ""),
            (linearize_ns, "ns", ""),
            (riccati_ns, "ns", ""),
            (qp_ns, "ns", ""),
            (publish_ns, "ns", ""),
            (total_ns, "ns", ""),
            (worst_violation, "", ""),
            (worst_constraint, "", ""),
            (worst_stage, "", ""),
            (worst_row, "", ""),
            (qp_solves, "", ""),
            (qp_iterations, "", ""),
            (active_rows, "", ""),
            (dropped_rows, "", ""),
            (allocations, "", ""),
        ]
    )
}

fn command() -> Layout {
    layout!(
        Command,
        [
            (header, "", ""),
            (state_sequence, "", ""),
            (state_time_ns, "ns", "plant"),
            (valid_from_ns, "ns", "plant"),
            (valid_until_ns, "ns", "plant"),
            (n_joints, "", ""),
            (verdict, "", ""),
            (fallback_level, "", ""),
            (reason, "", ""),
            (n_segments, "", ""),
            (rate_samples, "", ""),
            (segments, "", ""),
            (gain, "N m/rad, N m s/rad", "joint"),
            (imu_gain, "N m/rad, N m s/rad", "inertial unit"),
            (imu_rate_bias, "rad/s", "inertial unit"),
            (load_foot, "", ""),
            (full_load_n, "N", "sole"),
            (unloaded_stiffness, "N m/rad", "joint"),
            (unloaded_damping, "N m s/rad", "joint"),
            (report, "", ""),
            (estimate, "", ""),
        ]
    )
}

/// The comment above a field.
fn meaning(structure: &str, field: &str) -> String {
    let begin = format!("pub struct {structure} {{");
    let body = SOURCES.iter().find_map(|source| source.split(&begin).nth(1)).unwrap_or_default();
    let body = body.split("\n}").next().unwrap_or_default();
    comment_above(body, &format!("pub {field}:"))
}

/// The documentation above a line that begins like this, in one line and without links. Attributes may stand between the two.
pub(super) fn comment_above(source: &str, begin: &str) -> String {
    let (mut comment, mut goes_on) = (Vec::new(), false);
    for line in source.lines().map(str::trim) {
        if let Some(text) = line.strip_prefix("///") {
            if !goes_on {
                comment.clear();
            }
            comment.push(text.trim().to_owned());
            goes_on = true;
        } else if line.starts_with(begin) {
            return plain(&comment.join(" "));
        } else {
            goes_on = false;
        }
    }
    String::new()
}

/// Names of links without their brackets and paths.
fn plain(text: &str) -> String {
    text.replace("[`crate::", "`").replace("[`Self::", "`").replace("[`", "`").replace("`]", "`")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_of_a_payload_belongs_to_a_field_with_a_meaning() {
        for layout in layouts() {
            let mut end = 0;
            for field in &layout.fields {
                assert_eq!(field.offset, end, "{}.{}", layout.name, field.name);
                assert!(!field.meaning.is_empty(), "{}.{}", layout.name, field.name);
                end += field.size;
            }
            assert_eq!(end, layout.size, "{}", layout.name);
        }
    }

    #[test]
    fn an_array_of_arrays_is_told_from_outside_to_inside() {
        let command = command();
        let gain = command.fields.iter().find(|field| field.name == "gain").unwrap();
        assert_eq!((gain.kind, gain.shape.as_slice()), ("f64", [32, 64].as_slice()));
    }
}
