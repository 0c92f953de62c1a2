//! The log of a run: every state, command and truth, in one MCAP file with self-describing channels.
//!
//! Messages are ROS 2 CDR: the structs as they lie in memory behind a header of four bytes. All their fields are naturally aligned, so the
//! two forms are the same, bit for bit; commands are packed to what they use ([`crate::log_command`]). The schemas in this file say what the
//! bytes are, and any MCAP tool reads them.
//!
//! Beside them what makes viewers show the robot, in ROS 2's own types and in JSON: [`crate::log_viewer`]. Scenario and robot are attached as files.
//!
//! The loop only copies records into a ring of memory that is there before the run ([`crate::log_queue`]). A thread of its own writes
//! them ([`crate::log_file`]), so that a killed process loses what is younger than 50 ms: in real time it goes before ordinary programs,
//! which would keep it from the cores for longer than that, and after plant and controller. When it cannot keep up for seconds, records are
//! refused and counted in real time, and waited for in lockstep. Messages are numbered by the loop: what is missing shows.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::thread::JoinHandle;

use bytemuck::bytes_of;
use delmpc_controller_process::machine::go_before_ordinary_programs;
use delmpc_messages::{Command, PlantState};

use crate::log_command;
use crate::log_file::LogFile;
use crate::log_queue::{Head, Receiver, Sender, queue};
use crate::log_ros::{self, ENCAPSULATION};
use crate::log_schema::{PULL_FIELDS, TRUTH_FIELDS, command_schema, plant_state_schema};
use crate::log_viewer::{self, LogViewer};
use crate::steering::Pull;
use crate::truth::Truth;
use crate::verdict::Failure;

/// Room for records on their way to the file: some seconds of a large robot in real time, where nothing waits ...
const REALTIME_RING: usize = 64 << 20;
/// ... and enough to keep the writer busy where the loop waits.
const LOCKSTEP_RING: usize = 2 << 20;

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

/// Kinds of records, in the order of their channels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    State,
    Command,
    Truth,
    Pull,
}

const KINDS: usize = 4;

/// The loop's end of the log.
#[derive(Debug)]
pub struct Log {
    sender: Option<Sender>,
    writer: Option<JoinHandle<io::Result<()>>>,
    waits: bool,
    packed: Vec<u8>,
    /// Records of each kind so far.
    numbers: [u32; KINDS],
    dropped: u64,
}

impl Log {
    /// Opens the file and starts the writer. `waits`: when the ring is full, wait, do not drop. `first`: the writer goes before ordinary
    /// programs, where that is permitted.
    ///
    /// Make it before raising the priority: the writer would inherit it.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(path: &Path, head: LogHead, waits: bool, first: bool) -> Result<Self, Failure> {
        let cannot = |error: io::Error| Failure::Fault(format!("{}: {error}", path.display()));
        let room = if waits { LOCKSTEP_RING } else { REALTIME_RING };
        let (sender, receiver) = queue(room).map_err(|error| {
            Failure::Fault(format!("no memory for the log, {} MB are needed: {error}", room >> 20))
        })?;
        let (file, channels) = begin(path, &head).map_err(cannot)?;
        let viewer = head.viewer;
        let writer = std::thread::Builder::new()
            .name("log".to_owned())
            .spawn(move || {
                if first {
                    go_before_ordinary_programs();
                }
                write_all(file, channels, viewer, receiver)
            })
            .map_err(cannot)?;
        Ok(Self {
            sender: Some(sender),
            writer: Some(writer),
            waits,
            packed: Vec::with_capacity(log_command::MOST_BYTES),
            numbers: [0; KINDS],
            dropped: 0,
        })
    }

    /// No log at all.
    pub fn none() -> Self {
        Self { sender: None, writer: None, waits: false, packed: Vec::new(), numbers: [0; KINDS], dropped: 0 }
    }

    /// Logs a state as sent, at a time of the plant's clock.
    pub fn state(&mut self, time_ns: u64, state: &PlantState) {
        self.put(time_ns, Kind::State, bytes_of(state));
    }

    /// Logs a command as received.
    pub fn command(&mut self, time_ns: u64, command: &Command) {
        if self.sender.is_none() {
            return;
        }
        let mut packed = std::mem::take(&mut self.packed);
        packed.clear();
        log_command::pack(command, &mut packed);
        self.put(time_ns, Kind::Command, &packed);
        self.packed = packed;
    }

    /// Logs the truth at the end of a step.
    pub fn truth(&mut self, truth: &Truth) {
        self.put(truth.time_ns, Kind::Truth, bytes_of(truth));
    }

    /// Logs a pull that begins, changes or ends.
    pub fn pull(&mut self, pull: &Pull) {
        self.put(pull.time_ns, Kind::Pull, bytes_of(pull));
    }

    fn put(&mut self, time_ns: u64, kind: Kind, bytes: &[u8]) {
        let Some(sender) = &mut self.sender else { return };
        let number = &mut self.numbers[kind as usize];
        let head = Head { time_ns, sequence: *number, kind: kind as u32, length: 0 };
        *number = number.wrapping_add(1);
        let sent = match self.waits {
            true => sender.send_waiting(head, &[bytes]),
            false => sender.send(head, &[bytes]),
        };
        self.dropped += u64::from(!sent);
    }

    /// Waits until everything is in the file; says how many records were dropped.
    ///
    /// # Errors
    /// When the file could not be written.
    pub fn finish(mut self) -> Result<u64, Failure> {
        self.sender = None; // the writer ends when it has written what is left
        if let Some(writer) = self.writer.take() {
            let written =
                writer.join().map_err(|_| Failure::Fault("the log's writer broke down".to_owned()))?;
            written.map_err(|error| {
                Failure::Fault(format!("the log cannot be written: {error}; it ends where that happened"))
            })?;
        }
        Ok(self.dropped)
    }
}

/// Channel numbers of the file.
struct Channels {
    /// By kind.
    records: [u16; KINDS],
    viewer: BTreeMap<&'static str, u16>,
}

/// Makes the file with all that comes before the first record.
fn begin(path: &Path, head: &LogHead) -> io::Result<(LogFile, Channels)> {
    let mut file = LogFile::create(path)?;
    file.metadata("run", &head.about)?;
    for (name, media_type, content) in &head.files {
        file.attach(name, media_type, content)?;
    }
    let mut viewer = BTreeMap::new();
    if head.viewer.is_some() {
        let scene = log_viewer::scene_schema();
        for topic in [log_viewer::ROBOT, log_viewer::FORCES] {
            let name = scene["title"].as_str().unwrap_or_default();
            let schema = file.schema(name, "jsonschema", &scene.to_string())?;
            viewer.insert(topic, file.channel(schema, topic, "json")?);
        }
        for (topic, name, definition) in [
            (log_viewer::TRANSFORMS, log_ros::TF_NAME, log_ros::TF_SCHEMA),
            (log_viewer::JOINTS, log_ros::JOINT_STATE_NAME, log_ros::JOINT_STATE_SCHEMA),
        ] {
            let schema = file.schema(name, "ros2msg", definition)?;
            viewer.insert(topic, file.channel(schema, topic, "cdr")?);
        }
    }
    let mut records = [0; KINDS];
    for (kind, topic, name, fields) in [
        (Kind::State, STATE, "PlantState", plant_state_schema()),
        (Kind::Command, COMMAND, "Command", command_schema()),
        (Kind::Truth, TRUTH, "Truth", TRUTH_FIELDS.to_owned()),
        (Kind::Pull, PULL, "Pull", PULL_FIELDS.to_owned()),
    ] {
        let schema = file.schema(&format!("delmpc_msgs/msg/{name}"), "ros2msg", &fields)?;
        records[kind as usize] = file.channel(schema, topic, "cdr")?;
    }
    Ok((file, Channels { records, viewer }))
}

fn write_all(
    mut file: LogFile,
    channels: Channels,
    mut viewer: Option<LogViewer>,
    mut records: Receiver,
) -> io::Result<()> {
    let mut shown = BTreeMap::<u16, u32>::new();
    let mut content = Vec::with_capacity(log_command::MOST_BYTES);
    while let Some(Head { time_ns, sequence, kind, .. }) = records.next(&mut content) {
        let Some(&channel) = channels.records.get(kind as usize) else { continue };
        file.message(channel, sequence, time_ns, &[&ENCAPSULATION, &content])?;
        if kind != Kind::Truth as u32 {
            continue;
        }
        if let (Some(viewer), Ok(truth)) = (&mut viewer, bytemuck::try_pod_read_unaligned(&content)) {
            for (topic, message) in viewer.messages(&truth) {
                if let Some(&channel) = channels.viewer.get(topic) {
                    let number = shown.entry(channel).or_default();
                    file.message(channel, *number, time_ns, &[&message])?;
                    *number += 1;
                }
            }
        }
    }
    file.finish()
}

/// The command in a record of the log; `None` when it is none.
pub fn read_command(data: &[u8]) -> Option<Command> {
    log_command::unpack(data.get(ENCAPSULATION.len()..)?)
}

/// The message in a record of the log; `None` when it has another size.
pub fn read_record<T: bytemuck::AnyBitPattern>(data: &[u8]) -> Option<T> {
    bytemuck::try_pod_read_unaligned(data.get(ENCAPSULATION.len()..)?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log_schema::*;
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
                // In memory there is always room for as many as there may be.
                Some((kind, count)) => {
                    (kind, count.trim_end_matches(']').trim_start_matches("<=").parse().unwrap())
                }
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
                n_feet,
                feet_touching,
                foot_position_w,
                foot_slip_m,
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

    /// A process that is killed takes what is not in the file with it.
    #[test]
    fn of_what_is_handed_over_all_but_50_ms_gets_into_the_file_without_an_end() {
        let path = std::env::temp_dir().join(format!("delmpc-log-open-{}.mcap", std::process::id()));
        let mut log = Log::create(&path, LogHead::default(), false, true).unwrap();
        let last_ns = || {
            let mut last_ns = 0;
            // The file may end anywhere while it is being written.
            let read = crate::log_reader::LogReader::open(&path).and_then(|mut reader| {
                reader.each(|item| {
                    if let crate::log_reader::Item::Message { time_ns, .. } = item {
                        last_ns = last_ns.max(time_ns);
                    }
                    Ok(true)
                })
            });
            read.map_or(0, |_| last_ns)
        };
        for turn in 1..=5 {
            for k in 0..200 {
                let mut truth = Truth::new(3);
                truth.time_ns = (200 * turn + k) * 1_000_000;
                log.truth(&truth);
            }
            let handed_over_ns = (200 * turn + 199) * 1_000_000;
            let begin = std::time::Instant::now();
            while last_ns() + 50_000_000 < handed_over_ns {
                assert!(begin.elapsed().as_secs() < 60, "{} of {handed_over_ns} ns", last_ns());
                std::thread::sleep(std::time::Duration::from_millis(5));
            }
        }
        assert_eq!(log.finish().unwrap(), 0);
        std::fs::remove_file(path).unwrap();
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
                false,
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
