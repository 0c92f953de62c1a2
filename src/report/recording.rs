//! The log of a run as columns over time, at the rate of an animation.
//!
//! Frames are [`FRAME_S`] apart, or farther in long runs. What happens between two frames must not get lost in a plot: columns that have a
//! limit also hold their extremes over the steps since the frame before. The log is read piece by piece, and what is kept of it is bounded,
//! whatever its length.

use std::collections::BTreeMap;
use std::path::Path;

use delmpc_messages::Command;

use crate::log::{COMMAND, TRUTH, read_command, read_record};
use crate::log_reader::{End, Item, LogReader};
use crate::setup::Setup;
use crate::sole::pressure_point;
use crate::truth::Truth;
use crate::verdict::Failure;

/// Time between two frames (s).
pub const FRAME_S: f64 = 0.01;
/// Most frames; longer runs have fewer frames per second.
const MAX_FRAMES: f64 = 4000.0;
/// Most frames of a log that is longer than its scenario says.
const MOST_ROWS: usize = 20_000;
/// Most cycles; longer runs show the worst of each group.
const MAX_CYCLES: usize = 6000;

/// Rows of equal width.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Column {
    /// Numbers per row.
    pub width: usize,
    /// All rows, one after the other.
    pub values: Vec<f32>,
}

impl Column {
    fn new(width: usize) -> Self {
        Self { width, values: Vec::new() }
    }

    fn push(&mut self, row: impl IntoIterator<Item = f64>) {
        self.values.extend(row.into_iter().map(|value| value as f32));
    }

    /// Rows.
    pub fn rows(&self) -> usize {
        self.values.len() / self.width.max(1)
    }

    /// One number of a row.
    pub fn at(&self, row: usize, index: usize) -> f64 {
        self.values.get(row * self.width + index).copied().map_or(f64::NAN, f64::from)
    }
}

/// Columns by name, all with the same number of rows.
pub type Table = BTreeMap<&'static str, Column>;

/// A run as it is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// What the log says about its run.
    pub about: BTreeMap<String, String>,
    /// Time between two frames, s.
    pub frame_s: f64,
    /// The motion: SI units.
    pub frames: Table,
    /// The control cycles: times in ms.
    pub cycles: Table,
    /// Why the log ends early, if it does.
    pub damage: Option<String>,
}

impl Recording {
    /// Reads a log. What can be read of a damaged one is kept.
    ///
    /// # Errors
    /// [`Failure::Input`] when there is no log, or nothing in it.
    pub fn read(setup: &Setup, file: &Path) -> Result<Self, Failure> {
        let broken = |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", file.display()));
        let other_version = || broken(&"a record has the wrong size: another version wrote this log");
        let mut frames = FrameBuilder::new(setup);
        let mut cycles = Cycles::default();
        let mut about = None;
        let (mut missing_records, mut last_ns) = (0_u64, 0);
        let end = LogReader::open(file)?.each(|item| {
            match item {
                Item::About(pairs) => {
                    about.get_or_insert(pairs);
                }
                Item::Message { topic: TRUTH, missing, data, time_ns } => {
                    if missing > 0 {
                        missing_records += u64::from(missing);
                        frames.leave_hole();
                    }
                    last_ns = time_ns;
                    frames.observe(&read_record(data).ok_or_else(other_version)?);
                }
                Item::Message { topic: COMMAND, missing, data, .. } => {
                    missing_records += u64::from(missing);
                    let command = read_command(data).ok_or_else(other_version)?;
                    if command.header.sequence > 0 {
                        cycles.add(Cycle::new(&command));
                    }
                }
                Item::Message { missing, .. } => missing_records += u64::from(missing),
            }
            Ok(frames.rows() < MOST_ROWS)
        })?;
        let (frame_s, frames) = frames.finish();
        let until_s = last_ns as f64 * 1e-9;
        let mut damage = match end {
            Some(End::Whole) => None,
            Some(End::Cut(why)) => {
                let duration_s = setup.scenario.duration_s;
                Some(format!("the log is cut after {until_s:.3} s of {duration_s} s: {why}"))
            }
            None => Some(format!("the log is longer than its scenario; it is drawn up to {until_s:.3} s")),
        };
        if missing_records > 0 {
            let hole = format!("the log has holes: {missing_records} records are missing");
            damage = Some(damage.map_or_else(|| hole.clone(), |cut| format!("{cut}; {hole}")));
        }
        if frames["time"].rows() == 0 {
            return Err(broken(&damage.as_deref().unwrap_or("the log holds no motion")));
        }
        Ok(Self { about: about.unwrap_or_default(), frame_s, frames, cycles: cycles.table(), damage })
    }
}

/// Collects frames from the truth of every step.
#[derive(Debug, Clone)]
pub struct FrameBuilder {
    stride: u64,
    frame_s: f64,
    joints: usize,
    ball: Option<[f64; 3]>,
    feet: Vec<u32>,
    table: Table,
    steps: u64,
    last: Option<Box<Truth>>,
    since: Extremes,
}

/// Extremes since the last frame.
#[derive(Debug, Clone)]
struct Extremes {
    torque: Vec<f64>,
    pressure_low: [f64; 2],
    pressure_high: [f64; 2],
    margin: f64,
    hand: f64,
    push: [f64; 3],
}

impl Extremes {
    fn none(joints: usize) -> Self {
        Self {
            torque: vec![0.0; joints],
            pressure_low: [f64::NAN; 2],
            pressure_high: [f64::NAN; 2],
            margin: f64::NAN,
            hand: f64::NAN,
            push: [0.0; 3],
        }
    }
}

impl FrameBuilder {
    /// For a robot and a scenario.
    pub fn new(setup: &Setup) -> Self {
        let scenario = &setup.scenario;
        let stride = (FRAME_S.max(scenario.duration_s / MAX_FRAMES) / scenario.plant.step_s).round().max(1.0);
        let joints = setup.robot.joint_names.len();
        let feet = setup.robot.soles.iter().map(|sole| {
            let bits = sole.contacts.iter().filter(|&&contact| contact < 32).map(|&contact| 1 << contact);
            bits.fold(0, |mask: u32, bit: u32| mask | bit)
        });
        let widths = [
            ("time", 1),
            ("base", 7),
            ("position", joints),
            ("torque", joints),
            ("com", 3),
            ("com_velocity", 3),
            ("force", 3),
            ("pressure", 2),
            ("pressure_low", 2),
            ("pressure_high", 2),
            ("margin", 1),
            ("hand", 3),
            ("hand_error", 1),
            ("push", 3),
            ("slip", 1),
            ("status", 1),
            ("watchdog", 1),
            ("feet", 1),
        ];
        Self {
            stride: stride as u64,
            frame_s: stride * scenario.plant.step_s,
            joints,
            ball: setup.ball_w().ok().flatten(),
            feet: feet.collect(),
            table: widths.map(|(name, width)| (name, Column::new(width))).into(),
            steps: 0,
            last: None,
            since: Extremes::none(joints),
        }
    }

    /// Takes in the truth at the end of a step; makes it a frame when it is time for one.
    pub fn observe(&mut self, truth: &Truth) {
        self.note(truth);
        if self.steps.is_multiple_of(self.stride) {
            self.put_frame(truth);
            self.last = None;
        } else {
            self.last = Some(Box::new(*truth));
        }
        self.steps += 1;
    }

    /// Makes the truth a frame, whatever the time.
    pub fn put(&mut self, truth: &Truth) {
        self.note(truth);
        self.put_frame(truth);
    }

    /// Says that steps are missing: an empty frame, at which every line breaks.
    fn leave_hole(&mut self) {
        let Some(last) = self.last.take() else {
            return self.put_nothing();
        };
        self.put_frame(&last);
        self.put_nothing();
    }

    fn put_nothing(&mut self) {
        let rows = self.rows();
        if rows == 0 {
            return;
        }
        for (name, column) in &mut self.table {
            // The pose stays: a robot has one.
            if ["time", "base", "position", "status", "watchdog", "feet"].contains(name) {
                let last = column.values[(rows - 1) * column.width..rows * column.width].to_vec();
                column.values.extend(last);
            } else {
                column.values.extend(std::iter::repeat_n(f32::NAN, column.width));
            }
        }
        self.since = Extremes::none(self.joints);
    }

    /// Frames so far.
    fn rows(&self) -> usize {
        self.table.get("time").map_or(0, Column::rows)
    }

    /// The frames so far; later ones begin anew.
    pub fn take(&mut self) -> Table {
        let empty = self.table.iter().map(|(name, column)| (*name, Column::new(column.width))).collect();
        std::mem::replace(&mut self.table, empty)
    }

    /// All contact points of the feet of which a bit is set.
    pub fn contacts_of_feet(&self, feet: u32) -> u32 {
        let touching = self.feet.iter().enumerate().filter(|&(foot, _)| foot < 32 && feet >> foot & 1 != 0);
        touching.fold(0, |points, (_, mask)| points | mask)
    }

    fn note(&mut self, truth: &Truth) {
        let since = &mut self.since;
        for (extreme, &torque) in since.torque.iter_mut().zip(&truth.torque) {
            if torque.abs() >= extreme.abs() {
                *extreme = torque;
            }
        }
        if let Some(point) = pressure_point(&truth.stance_torque_b, &truth.stance_force_b) {
            for axis in 0..2 {
                since.pressure_low[axis] = since.pressure_low[axis].min(point[axis]);
                since.pressure_high[axis] = since.pressure_high[axis].max(point[axis]);
            }
        }
        since.margin = since.margin.min(truth.cop_margin_m);
        since.hand = since.hand.max(self.ball.map_or(f64::NAN, |ball| distance(&truth.hand_w, &ball)));
        if length(&truth.push_force_w) > length(&since.push) {
            since.push = truth.push_force_w;
        }
    }

    fn put_frame(&mut self, truth: &Truth) {
        let n = self.joints;
        let since = std::mem::replace(&mut self.since, Extremes::none(n));
        let pressure = pressure_point(&truth.stance_torque_b, &truth.stance_force_b);
        let feet = self.feet.iter().enumerate().filter(|&(_, mask)| truth.contact_flags & mask != 0);
        let feet: u32 = feet.map(|(foot, _)| 1 << foot).sum();
        let mut put = |name: &str, row: &[f64]| {
            if let Some(column) = self.table.get_mut(name) {
                column.push(row.iter().copied());
            }
        };
        put("time", &[truth.time_s()]);
        let [x, y, z] = truth.base_position_w;
        let [i, j, k, w] = truth.base_orientation_w;
        put("base", &[x, y, z, i, j, k, w]);
        put("position", &truth.position[..n]);
        put("torque", &since.torque);
        put("com", &truth.com_w);
        put("com_velocity", &truth.com_velocity_w);
        put("force", &truth.stance_force_b);
        put("pressure", &pressure.map_or([f64::NAN; 2], Into::into));
        put("pressure_low", &since.pressure_low);
        put("pressure_high", &since.pressure_high);
        put("margin", &[since.margin]);
        put("hand", &truth.hand_w);
        put("hand_error", &[since.hand]);
        put("push", &since.push);
        put("slip", &[truth.stance_slip_m]);
        put("status", &[f64::from(truth.status_flags)]);
        put("watchdog", &[f64::from(truth.watchdog_level)]);
        put("feet", &[f64::from(feet)]);
    }

    fn finish(mut self) -> (f64, Table) {
        if let Some(truth) = self.last.take() {
            self.put_frame(&truth);
        }
        (self.frame_s, self.table)
    }
}

/// Names of the columns of a cycle, in the order of [`Cycle`].
const CYCLE_COLUMNS: [&str; 17] = [
    "time",
    "state_in",
    "shift",
    "linearize",
    "riccati",
    "qp",
    "publish",
    "total",
    "active",
    "dropped",
    "solves",
    "iterations",
    "violation",
    "constraint",
    "verdict",
    "fallback",
    "allocations",
];

/// One control cycle: times in ms, then counts and codes.
struct Cycle([f64; CYCLE_COLUMNS.len()]);

impl Cycle {
    fn new(command: &Command) -> Self {
        let report = &command.report;
        let ms = |ns: u64| ns as f64 * 1e-6;
        Self([
            command.state_time_ns as f64 * 1e-9,
            ms(report.state_in_ns),
            ms(report.shift_ns),
            ms(report.linearize_ns),
            ms(report.riccati_ns),
            ms(report.qp_ns),
            ms(report.publish_ns),
            ms(report.total_ns),
            f64::from(report.active_rows),
            f64::from(report.dropped_rows),
            f64::from(report.qp_solves),
            f64::from(report.qp_iterations),
            report.worst_violation,
            f64::from(report.worst_constraint),
            f64::from(command.verdict),
            f64::from(command.fallback_level),
            f64::from(report.allocations),
        ])
    }
}

/// Cycles, of many the largest values of each group, at the time of its first one.
#[derive(Default)]
struct Cycles {
    groups: Vec<Cycle>,
    /// Cycles per group.
    size: u64,
    /// Cycles in the last group.
    filled: u64,
}

impl Cycles {
    fn add(&mut self, cycle: Cycle) {
        self.size = self.size.max(1);
        match self.groups.last_mut() {
            Some(group) if self.filled < self.size => {
                group.join(&cycle);
                self.filled += 1;
            }
            _ => {
                if self.groups.len() == MAX_CYCLES {
                    self.join_pairs();
                }
                self.groups.push(cycle);
                self.filled = 1;
            }
        }
    }

    /// Makes two groups one, all of them.
    fn join_pairs(&mut self) {
        let mut joined = Vec::with_capacity(MAX_CYCLES);
        let mut groups = self.groups.drain(..);
        while let Some(mut first) = groups.next() {
            if let Some(second) = groups.next() {
                first.join(&second);
            }
            joined.push(first);
        }
        drop(groups);
        self.groups = joined;
        self.size *= 2;
    }

    fn table(&self) -> Table {
        let mut table: Table = CYCLE_COLUMNS.map(|name| (name, Column::new(1))).into();
        for (index, name) in CYCLE_COLUMNS.iter().enumerate() {
            if let Some(column) = table.get_mut(name) {
                column.push(self.groups.iter().map(|cycle| cycle.0[index]));
            }
        }
        table
    }
}

impl Cycle {
    /// The largest values of both, at the earlier time.
    fn join(&mut self, other: &Self) {
        for (index, (ours, theirs)) in self.0.iter_mut().zip(other.0).enumerate() {
            *ours = if index == 0 { ours.min(theirs) } else { ours.max(theirs) };
        }
    }
}

/// One cycle as columns.
pub fn cycle_table_of(command: &Command) -> Table {
    Cycles { groups: vec![Cycle::new(command)], size: 1, filled: 1 }.table()
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    length(&[a[0] - b[0], a[1] - b[1], a[2] - b[2]])
}

fn length(x: &[f64; 3]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}
