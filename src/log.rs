//! The log of a run: every state, command and truth, in one MCAP file with self-describing channels.
//!
//! Messages are ROS 2 CDR: the structs as they lie in memory behind a header of four bytes. All their fields are naturally aligned, so the
//! two forms are the same, bit for bit; the schemas in this file say what the bytes are, and any MCAP tool reads them.
//!
//! Beside them, in JSON, what makes viewers show the robot: [`crate::log_viewer`]. Scenario and robot are attached as files.
//!
//! The loop only puts records into a bounded queue. A thread of ordinary priority writes them; when it cannot keep up, records are
//! dropped and counted in real time, and waited for in lockstep.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;

use bytemuck::bytes_of;
use delmpc_messages::{Command, PlantState};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, WriteOptions, Writer};

use crate::log_viewer::{self, LogViewer};
use crate::steering::Pull;
use crate::truth::Truth;
use crate::verdict::Failure;

/// Records on their way to the file. A record has the size of a command, 17 kB.
const QUEUE: usize = 1024;
/// Little-endian CDR, no options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Channels of the log.
pub const STATE: &str = "/plant/state";
/// Commands as the plant received them; each holds the report of its cycle.
pub const COMMAND: &str = "/controller/command";
/// Pulls of a person: from when on, where, how strong.
pub const PULL: &str = "/plant/pull";
/// What really happened.
pub const TRUTH: &str = "/plant/truth";

/// What a log begins with.
#[derive(Debug, Clone, Default)]
pub struct LogHead {
    /// Metadata of the run.
    pub about: BTreeMap<String, String>,
    /// Files that belong to it: name, media type, content.
    pub files: Vec<(String, &'static str, Vec<u8>)>,
    /// What shows the robot to viewers, if anything.
    pub viewer: Option<LogViewer>,
}

#[allow(clippy::large_enum_variant, reason = "the loop must not allocate")]
enum Record {
    State(PlantState),
    Command(Command),
    Truth(Truth),
    Pull(Pull),
}

/// The loop's end of the log.
pub struct Log {
    queue: Option<SyncSender<(u64, Record)>>,
    writer: Option<JoinHandle<Result<(), mcap::McapError>>>,
    waits: bool,
    dropped: u64,
}

impl Log {
    /// Opens the file and starts the writer. `waits`: when the queue is full, wait, do not drop.
    ///
    /// Make it before raising the priority: the writer is an ordinary thread.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path, head: LogHead, waits: bool) -> Result<Self, Failure> {
        let cannot = |error: &dyn std::fmt::Display| Failure::Fault(format!("{}: {error}", path.display()));
        let file = File::create(path).map_err(|error| cannot(&error))?;
        let mut writer = WriteOptions::new()
            .compression(Some(Compression::Lz4))
            .profile("ros2")
            .create(BufWriter::new(file))
            .map_err(|error| cannot(&error))?;
        let metadata = Metadata { name: "run".to_owned(), metadata: head.about };
        writer.write_metadata(&metadata).map_err(|error| cannot(&error))?;
        for (name, media_type, content) in head.files {
            // Without a date: logs of lockstep runs are the same bytes.
            let (media_type, data) = (media_type.to_owned(), Cow::from(content));
            let file = Attachment { log_time: 0, create_time: 0, name, media_type, data };
            writer.attach(&file).map_err(|error| cannot(&error))?;
        }
        let viewer = head.viewer;
        let channels = Channels::add(&mut writer, viewer.is_some()).map_err(|error| cannot(&error))?;
        let (queue, records) = sync_channel(QUEUE);
        let writer = std::thread::spawn(move || write_all(writer, channels, viewer, &records));
        Ok(Self { queue: Some(queue), writer: Some(writer), waits, dropped: 0 })
    }

    /// No log at all.
    pub fn none() -> Self {
        Self { queue: None, writer: None, waits: false, dropped: 0 }
    }

    /// Logs a state as sent, at a time of the plant's clock.
    pub fn state(&mut self, time_ns: u64, state: &PlantState) {
        self.put(time_ns, || Record::State(*state));
    }

    /// Logs a command as received.
    pub fn command(&mut self, time_ns: u64, command: &Command) {
        self.put(time_ns, || Record::Command(*command));
    }

    /// Logs the truth at the end of a step.
    pub fn truth(&mut self, truth: &Truth) {
        self.put(truth.time_ns, || Record::Truth(*truth));
    }

    /// Logs a pull that begins, changes or ends.
    pub fn pull(&mut self, pull: &Pull) {
        self.put(pull.time_ns, || Record::Pull(*pull));
    }

    fn put(&mut self, time_ns: u64, record: impl FnOnce() -> Record) {
        let Some(queue) = &self.queue else { return };
        let sent = match self.waits {
            true => queue.send((time_ns, record())).is_ok(),
            false => match queue.try_send((time_ns, record())) {
                Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => false,
                Ok(()) => true,
            },
        };
        self.dropped += u64::from(!sent);
    }

    /// Waits until everything is in the file; says how many records were dropped.
    ///
    /// # Errors
    /// When the file could not be written.
    pub fn finish(mut self) -> Result<u64, Failure> {
        self.queue = None; // the writer ends when it has written what is left
        if let Some(writer) = self.writer.take() {
            let written =
                writer.join().map_err(|_| Failure::Fault("the log's writer broke down".to_owned()))?;
            written.map_err(|error| Failure::Fault(format!("the log cannot be written: {error}")))?;
        }
        Ok(self.dropped)
    }
}

/// Channel numbers of the file.
struct Channels {
    state: u16,
    command: u16,
    truth: u16,
    pull: u16,
    viewer: BTreeMap<&'static str, u16>,
}

impl Channels {
    fn add(writer: &mut Writer<BufWriter<File>>, with_viewer: bool) -> Result<Self, mcap::McapError> {
        let mut viewer = BTreeMap::new();
        if with_viewer {
            let (transforms, scene) = (log_viewer::transforms_schema(), log_viewer::scene_schema());
            for (topic, schema) in [
                (log_viewer::TRANSFORMS, &transforms),
                (log_viewer::ROBOT, &scene),
                (log_viewer::FORCES, &scene),
            ] {
                let name = schema["title"].as_str().unwrap_or_default();
                let schema = writer.add_schema(name, "jsonschema", schema.to_string().as_bytes())?;
                viewer.insert(topic, writer.add_channel(schema, topic, "json", &BTreeMap::new())?);
            }
        }
        let mut add = |topic: &str, name: &str, schema: &str| {
            let schema = writer.add_schema(name, "ros2msg", schema.as_bytes())?;
            writer.add_channel(schema, topic, "cdr", &BTreeMap::new())
        };
        Ok(Self {
            state: add(STATE, "delmpc_msgs/msg/PlantState", &plant_state_schema())?,
            command: add(COMMAND, "delmpc_msgs/msg/Command", &command_schema())?,
            truth: add(TRUTH, "delmpc_msgs/msg/Truth", TRUTH_FIELDS)?,
            pull: add(PULL, "delmpc_msgs/msg/Pull", PULL_FIELDS)?,
            viewer,
        })
    }
}

fn write_all(
    mut writer: Writer<BufWriter<File>>,
    channels: Channels,
    mut viewer: Option<LogViewer>,
    records: &Receiver<(u64, Record)>,
) -> Result<(), mcap::McapError> {
    let mut sequences = BTreeMap::<u16, u32>::new();
    let mut write = |channel_id: u16, time_ns: u64, bytes: &[u8]| {
        let sequence = sequences.entry(channel_id).or_default();
        let header =
            MessageHeader { channel_id, sequence: *sequence, log_time: time_ns, publish_time: time_ns };
        *sequence += 1;
        writer.write_to_known_channel(&header, bytes)
    };
    let mut bytes = Vec::new();
    for (time_ns, record) in records {
        let (channel_id, content) = match &record {
            Record::State(state) => (channels.state, bytes_of(state)),
            Record::Command(command) => (channels.command, bytes_of(command)),
            Record::Truth(truth) => (channels.truth, bytes_of(truth)),
            Record::Pull(pull) => (channels.pull, bytes_of(pull)),
        };
        bytes.clear();
        bytes.extend_from_slice(&ENCAPSULATION);
        bytes.extend_from_slice(content);
        write(channel_id, time_ns, &bytes)?;
        if let (Some(viewer), Record::Truth(truth)) = (&mut viewer, &record) {
            for (topic, message) in viewer.messages(truth) {
                if let Some(&channel_id) = channels.viewer.get(topic) {
                    write(channel_id, time_ns, message.to_string().as_bytes())?;
                }
            }
        }
    }
    writer.finish()?;
    Ok(())
}

/// The message in a record of the log; `None` when it has another size.
pub fn read_record<T: bytemuck::AnyBitPattern>(data: &[u8]) -> Option<T> {
    bytemuck::try_pod_read_unaligned(data.get(ENCAPSULATION.len()..)?).ok()
}

const SEPARATOR: &str = "================================================================================\n";

const HEADER_FIELDS: &str = "\
uint32 magic
uint32 version
uint64 joint_set_hash
uint64 run_id
uint64 sequence
uint64 sent_at_ns
";

const PLANT_STATE_FIELDS: &str = "\
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

const FOOT_READING_FIELDS: &str = "\
uint32 flags
uint32 reserved
float64[3] torque_s
float64[3] force_s
";

const STATE_ESTIMATE_FIELDS: &str = "\
uint32 known
uint32 feet_loaded
float64[4] base_orientation_w
float64[3] base_angular_velocity_b
float64[3] base_linear_velocity_b
float64[3] gyro_bias
float64[3] accelerometer_bias
";

const SEGMENT_FIELDS: &str = "\
uint64 begin_ns
float64[32] torque
float64[32] torque_lower
float64[32] torque_upper
float64[32] position_ref
float64[32] velocity_ref
float64[32] acceleration_ref
float64[3] imu_angle_ref
float64[3] imu_rate_ref
float64[3] imu_acceleration_ref
";

/// The gain is the row-major 32 x 64 matrix, that of the inertial unit 32 x 6.
const COMMAND_FIELDS: &str = "\
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
delmpc_msgs/Segment[8] segments
float64[2048] gain
float64[192] imu_gain
float64[3] imu_rate_bias
uint32[32] load_foot
float64[8] full_load_n
float64[32] unloaded_stiffness
float64[32] unloaded_damping
delmpc_msgs/CycleReport report
delmpc_msgs/StateEstimate estimate
";

const CYCLE_REPORT_FIELDS: &str = "\
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

const TRUTH_FIELDS: &str = "\
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

const PULL_FIELDS: &str = "\
uint64 time_ns
uint32 body
uint32 acts
float64[3] point_b
float64[3] force_w
";

fn plant_state_schema() -> String {
    format!(
        "{PLANT_STATE_FIELDS}{SEPARATOR}MSG: delmpc_msgs/Header\n{HEADER_FIELDS}\
         {SEPARATOR}MSG: delmpc_msgs/FootReading\n{FOOT_READING_FIELDS}"
    )
}

fn command_schema() -> String {
    let parts = [
        ("Header", HEADER_FIELDS),
        ("Segment", SEGMENT_FIELDS),
        ("CycleReport", CYCLE_REPORT_FIELDS),
        ("StateEstimate", STATE_ESTIMATE_FIELDS),
    ];
    let part = |(name, fields)| format!("{SEPARATOR}MSG: delmpc_msgs/{name}\n{fields}");
    std::iter::once(COMMAND_FIELDS.to_owned()).chain(parts.map(part)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use delmpc_messages::{CycleReport, Header, Segment};
    use delmpc_messages::{FootReading, StateEstimate};
    use std::mem::offset_of;

    /// Offset of every field as CDR lays it out, and the size of the whole.
    fn layout(fields: &str) -> (BTreeMap<&str, usize>, usize) {
        let mut offset: usize = 0;
        let mut offsets = BTreeMap::new();
        for line in fields.lines() {
            let (kind, name) = line.split_once(' ').unwrap();
            let (kind, count) = match kind.split_once('[') {
                Some((kind, count)) => (kind, count.trim_end_matches(']').parse().unwrap()),
                None => (kind, 1),
            };
            let (size, alignment) = match kind {
                "uint32" => (4, 4),
                "uint64" | "float64" => (8, 8),
                "delmpc_msgs/Header" => (layout(HEADER_FIELDS).1, 4),
                "delmpc_msgs/Segment" => (layout(SEGMENT_FIELDS).1, 8),
                "delmpc_msgs/CycleReport" => (layout(CYCLE_REPORT_FIELDS).1, 8),
                "delmpc_msgs/FootReading" => (layout(FOOT_READING_FIELDS).1, 8),
                "delmpc_msgs/StateEstimate" => (layout(STATE_ESTIMATE_FIELDS).1, 8),
                other => panic!("{other}"),
            };
            offset = offset.next_multiple_of(alignment);
            offsets.insert(name, offset);
            offset += size * count;
        }
        (offsets, offset)
    }

    macro_rules! assert_layout {
        ($type:ty, $fields:expr, [$($field:ident),+ $(,)?]) => {
            let (offsets, size) = layout($fields);
            assert_eq!(size, size_of::<$type>(), stringify!($type));
            let ours = [$((stringify!($field), offset_of!($type, $field))),+];
            assert_eq!(offsets, BTreeMap::from(ours), stringify!($type));
        };
    }

    #[test]
    fn schemas_describe_the_bytes() {
        assert_layout!(Header, HEADER_FIELDS, [magic, version, joint_set_hash, run_id, sequence, sent_at_ns]);
        assert_layout!(
            PlantState,
            PLANT_STATE_FIELDS,
            [
                header,
                time_ns,
                applied_command_sequence,
                clock,
                n_joints,
                n_feet,
                sensors,
                status_flags,
                watchdog_level,
                position,
                velocity,
                applied_torque,
                imu_angle,
                imu_velocity,
                imu_angular_velocity,
                imu_specific_force,
                feet,
                base_position_w,
                base_orientation_w,
                base_angular_velocity_b,
                base_linear_velocity_b,
            ]
        );
        assert_layout!(
            Command,
            COMMAND_FIELDS,
            [
                header,
                state_sequence,
                state_time_ns,
                valid_from_ns,
                valid_until_ns,
                n_joints,
                verdict,
                fallback_level,
                reason,
                n_segments,
                rate_samples,
                segments,
                gain,
                imu_gain,
                imu_rate_bias,
                load_foot,
                full_load_n,
                unloaded_stiffness,
                unloaded_damping,
                report,
                estimate,
            ]
        );
        assert_layout!(
            Segment,
            SEGMENT_FIELDS,
            [
                begin_ns,
                torque,
                torque_lower,
                torque_upper,
                position_ref,
                velocity_ref,
                acceleration_ref,
                imu_angle_ref,
                imu_rate_ref,
                imu_acceleration_ref,
            ]
        );
        assert_layout!(FootReading, FOOT_READING_FIELDS, [flags, reserved, torque_s, force_s]);
        assert_layout!(
            StateEstimate,
            STATE_ESTIMATE_FIELDS,
            [
                known,
                feet_loaded,
                base_orientation_w,
                base_angular_velocity_b,
                base_linear_velocity_b,
                gyro_bias,
                accelerometer_bias,
            ]
        );
        assert_layout!(
            CycleReport,
            CYCLE_REPORT_FIELDS,
            [
                state_in_ns,
                shift_ns,
                linearize_ns,
                riccati_ns,
                qp_ns,
                publish_ns,
                total_ns,
                worst_violation,
                worst_constraint,
                worst_stage,
                worst_row,
                qp_solves,
                qp_iterations,
                active_rows,
                dropped_rows,
                allocations,
            ]
        );
        assert_layout!(Pull, PULL_FIELDS, [time_ns, body, acts, point_b, force_w]);
        assert_layout!(
            Truth,
            TRUTH_FIELDS,
            [
                time_ns,
                n_joints,
                contact_flags,
                status_flags,
                watchdog_level,
                position,
                velocity,
                torque,
                base_position_w,
                base_orientation_w,
                base_angular_velocity_b,
                base_linear_velocity_b,
                com_w,
                com_velocity_w,
                sole_position_w,
                stance_slip_m,
                sole_tilt_rad,
                stance_torque_b,
                stance_force_b,
                cop_margin_m,
                friction_use,
                torque_ratio,
                hand_w,
                push_force_w,
                energy_balance_error,
            ]
        );
    }

    #[test]
    fn what_is_logged_is_read_back_bit_by_bit_and_the_file_is_reproducible() {
        let folder = std::env::temp_dir();
        let write = |name: &str| {
            let path = folder.join(format!("delmpc-log-{name}-{}.mcap", std::process::id()));
            let mut log = Log::create(
                &path,
                LogHead { about: [("seed".into(), "1".into())].into(), ..LogHead::default() },
                true,
            )
            .unwrap();
            for k in 0..3000 {
                let mut truth = Truth::new(3);
                truth.time_ns = k * 1_000_000;
                truth.com_w = [k as f64, -0.0, f64::NAN];
                let mut state = PlantState::new(1, 2, 3);
                state.header.sequence = k;
                log.state(truth.time_ns, &state);
                if k % 100 == 0 {
                    log.command(truth.time_ns, &Command::new(1, 2, 3));
                }
                log.truth(&truth);
            }
            assert_eq!(log.finish().unwrap(), 0);
            let bytes = std::fs::read(&path).unwrap();
            std::fs::remove_file(&path).unwrap();
            bytes
        };
        let bytes = write("a");
        assert_eq!(bytes, write("b"));

        let mut counts = BTreeMap::<String, u64>::new();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            let count = counts.entry(message.channel.topic.clone()).or_default();
            if message.channel.topic == TRUTH {
                let truth: Truth = read_record(&message.data).unwrap();
                assert_eq!(truth.time_ns, *count * 1_000_000);
                assert_eq!(truth.com_w[0], *count as f64);
                assert!(truth.com_w[1].is_sign_negative() && truth.com_w[2].is_nan());
            }
            *count += 1;
        }
        let expected = [(STATE, 3000), (COMMAND, 30), (TRUTH, 3000)];
        assert_eq!(counts, expected.map(|(topic, count)| (topic.to_owned(), count)).into());
    }
}
