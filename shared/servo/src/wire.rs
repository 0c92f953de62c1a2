//! Frames between a motor board and whoever has the robot: readings one way, torques the other. For a serial line, a socket, a bus.
//!
//! ```text
//! frame     = "DM" kind:u8 0:u8 length:u16 payload checksum:u16     little-endian; checksum: CRC-16 (CCITT, FALSE) of kind to payload
//! readings  = time_ns:u64 sequence:u64 joints:u16 feet:u16 sensors:u32 position[] velocity[] [inertial unit: 12] feet[]: flags:u32 torque[3] force[3]
//! answer    = time_ns:u64 sequence:u64 figures[8]:u32 joints:u16 cycled:u16 torque[] [cycled: feed-forward[] gain[][2]]
//! ```
//!
//! Numbers are `f64`: a board computes with what the host measured, to the last bit. A damaged frame is skipped; the next one begins
//! at the next "DM" ([`Receiver`]).

use delmpc_messages::{Command, FootReading, MAX_FEET, MAX_JOINTS, PlantState, sensor};

const MAGIC: [u8; 2] = *b"DM";
const HEAD: usize = 6;
const TAIL: usize = 2;

/// What a frame carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum FrameKind {
    /// Readings of the robot's sensors.
    Readings = 1,
    /// The board's answer.
    Answer = 2,
}

/// Largest frame, bytes.
pub const FRAME_CAPACITY: usize = {
    let readings = 24 + 8 * (2 * MAX_JOINTS + 12) + MAX_FEET * 52;
    let answer = 52 + 8 * MAX_JOINTS * (2 + 2 * MAX_JOINTS);
    HEAD + TAIL + if readings > answer { readings } else { answer }
};

/// What a board says of itself beside its torques.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BoardFigures {
    /// Level of the servo: `delmpc_messages::FallbackLevel`.
    pub level: u32,
    /// Verdict of the last cycle: `delmpc_messages::Verdict`.
    pub verdict: u32,
    /// Reason of the last cycle.
    pub reason: u32,
    /// Iterations of the QP in the last cycle.
    pub iterations: u32,
    /// Active rows in the last cycle.
    pub active_rows: u32,
    /// Memory requests after the start: 0, or something is wrong.
    pub allocations: u32,
    /// Most bytes of stack so far.
    pub stack_bytes: u32,
    /// Bytes of heap in use.
    pub heap_bytes: u32,
}

/// An answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// Time of the readings it answers, ns.
    pub time_ns: u64,
    /// Their sequence.
    pub sequence: u64,
    /// Figures of the board.
    pub figures: BoardFigures,
    /// Joints in use.
    pub joints: usize,
    /// Whether there was a control cycle, and the next two fields are its command's.
    pub cycled: bool,
    /// Torque of every joint, N m or N.
    pub torque: [f64; MAX_JOINTS],
    /// Feed-forward torque of the command's first segment.
    pub feed_forward: [f64; MAX_JOINTS],
    /// Gain rows: on positions, then on velocities.
    pub gain: [[f64; 2 * MAX_JOINTS]; MAX_JOINTS],
}

/// Writes a frame's payload, field by field; what does not fit is left out, and the frame is none then.
struct Writer<'a> {
    bytes: &'a mut [u8],
    used: usize,
    fits: bool,
}

impl<'a> Writer<'a> {
    fn new(bytes: &'a mut [u8], kind: FrameKind) -> Self {
        let mut writer = Self { bytes, used: 0, fits: true };
        writer.put(&MAGIC);
        writer.put(&[kind as u8, 0, 0, 0]);
        writer
    }

    fn put(&mut self, bytes: &[u8]) {
        match self.bytes.get_mut(self.used..self.used + bytes.len()) {
            Some(place) => place.copy_from_slice(bytes),
            None => self.fits = false,
        }
        self.used += bytes.len();
    }

    fn floats(&mut self, values: &[f64]) {
        for value in values {
            self.put(&value.to_le_bytes());
        }
    }

    /// The finished frame; `None`: the buffer is too small.
    fn finish(mut self) -> Option<usize> {
        let length = u16::try_from(self.used.checked_sub(HEAD)?).ok()?;
        self.bytes.get_mut(4..6)?.copy_from_slice(&length.to_le_bytes());
        let checksum = checksum(self.bytes.get(2..self.used)?);
        self.put(&checksum.to_le_bytes());
        self.fits.then_some(self.used)
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (front, rest) = self.bytes.split_first_chunk::<N>()?;
        self.bytes = rest;
        Some(*front)
    }

    fn u16(&mut self) -> Option<usize> {
        self.take().map(u16::from_le_bytes).map(usize::from)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn floats(&mut self, values: &mut [f64]) -> Option<()> {
        for value in values {
            *value = f64::from_le_bytes(self.take()?);
        }
        Some(())
    }
}

/// CRC-16/CCITT-FALSE, bit by bit: a frame is short.
fn checksum(bytes: &[u8]) -> u16 {
    let mut crc = 0xffff_u16;
    for byte in bytes {
        crc ^= u16::from(*byte) << 8;
        for _ in 0..8 {
            crc = if crc & 0x8000 == 0 { crc << 1 } else { (crc << 1) ^ 0x1021 };
        }
    }
    crc
}

/// Writes readings into `frame` ([`FRAME_CAPACITY`] is enough); returns the length of the frame. `None`: it does not fit.
pub fn write_readings(state: &PlantState, frame: &mut [u8]) -> Option<usize> {
    let n = (state.n_joints as usize).min(MAX_JOINTS);
    let mut out = Writer::new(frame, FrameKind::Readings);
    out.put(&state.time_ns.to_le_bytes());
    out.put(&state.header.sequence.to_le_bytes());
    out.put(&(n as u16).to_le_bytes());
    out.put(&(state.feet().len() as u16).to_le_bytes());
    // What motion capture sees does not go over the line.
    let sensors = state.sensors & (sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS);
    out.put(&sensors.to_le_bytes());
    out.floats(&state.position[..n]);
    out.floats(&state.velocity[..n]);
    if sensors != 0 {
        for values in
            [state.imu_angle, state.imu_velocity, state.imu_angular_velocity, state.imu_specific_force]
        {
            out.floats(&values);
        }
    }
    for reading in state.feet() {
        out.put(&reading.flags.to_le_bytes());
        out.floats(&reading.torque_s);
        out.floats(&reading.force_s);
    }
    out.finish()
}

/// Reads the payload of a [`FrameKind::Readings`] into a state whose joint set is set already. `None`, and a state that is not to be used:
/// it is cut, or of another robot.
pub fn read_readings(payload: &[u8], state: &mut PlantState) -> Option<()> {
    let mut from = Reader { bytes: payload };
    state.time_ns = from.u64()?;
    state.header.sequence = from.u64()?;
    let (n, feet) = (from.u16()?, from.u16()?);
    if n != state.n_joints as usize || n > MAX_JOINTS || feet > MAX_FEET {
        return None;
    }
    state.n_feet = feet as u32;
    state.sensors = from.u32()?;
    from.floats(&mut state.position[..n])?;
    from.floats(&mut state.velocity[..n])?;
    if state.sensors != 0 {
        from.floats(&mut state.imu_angle)?;
        from.floats(&mut state.imu_velocity)?;
        from.floats(&mut state.imu_angular_velocity)?;
        from.floats(&mut state.imu_specific_force)?;
    }
    for reading in &mut state.feet[..feet] {
        *reading = FootReading { flags: from.u32()?, reserved: 0, torque_s: [0.0; 3], force_s: [0.0; 3] };
        from.floats(&mut reading.torque_s)?;
        from.floats(&mut reading.force_s)?;
    }
    from.bytes.is_empty().then_some(())
}

/// Writes an answer to `readings` into `frame`; `command` where the tick had a control cycle. Returns the length of the frame.
pub fn write_answer(
    readings: &PlantState,
    figures: &BoardFigures,
    torque: &[f64],
    command: Option<&Command>,
    frame: &mut [u8],
) -> Option<usize> {
    let n = torque.len().min(MAX_JOINTS);
    let mut out = Writer::new(frame, FrameKind::Answer);
    out.put(&readings.time_ns.to_le_bytes());
    out.put(&readings.header.sequence.to_le_bytes());
    let BoardFigures {
        level,
        verdict,
        reason,
        iterations,
        active_rows,
        allocations,
        stack_bytes,
        heap_bytes,
    } = *figures;
    for word in [level, verdict, reason, iterations, active_rows, allocations, stack_bytes, heap_bytes] {
        out.put(&word.to_le_bytes());
    }
    out.put(&(n as u16).to_le_bytes());
    out.put(&u16::from(command.is_some()).to_le_bytes());
    out.floats(&torque[..n]);
    if let Some(command) = command {
        out.floats(&command.segments[0].torque[..n]);
        for row in &command.gain[..n] {
            out.floats(&row[..n]);
            out.floats(&row[MAX_JOINTS..MAX_JOINTS + n]);
        }
    }
    out.finish()
}

/// Reads the payload of a [`FrameKind::Answer`]. `None`: it is cut.
pub fn read_answer(payload: &[u8]) -> Option<Answer> {
    let mut from = Reader { bytes: payload };
    let (time_ns, sequence) = (from.u64()?, from.u64()?);
    let figures = BoardFigures {
        level: from.u32()?,
        verdict: from.u32()?,
        reason: from.u32()?,
        iterations: from.u32()?,
        active_rows: from.u32()?,
        allocations: from.u32()?,
        stack_bytes: from.u32()?,
        heap_bytes: from.u32()?,
    };
    let (joints, cycled) = (from.u16()?, from.u16()? != 0);
    if joints > MAX_JOINTS {
        return None;
    }
    let none = [0.0; MAX_JOINTS];
    let gain = [[0.0; 2 * MAX_JOINTS]; MAX_JOINTS];
    let mut answer =
        Answer { time_ns, sequence, figures, joints, cycled, torque: none, feed_forward: none, gain };
    from.floats(&mut answer.torque[..joints])?;
    if cycled {
        from.floats(&mut answer.feed_forward[..joints])?;
        for row in &mut answer.gain[..joints] {
            from.floats(&mut row[..joints])?;
            from.floats(&mut row[MAX_JOINTS..MAX_JOINTS + joints])?;
        }
    }
    from.bytes.is_empty().then_some(answer)
}

/// Finds frames in a stream of bytes.
#[derive(Clone, Debug)]
pub struct Receiver {
    frame: [u8; FRAME_CAPACITY],
    used: usize,
}

impl Default for Receiver {
    fn default() -> Self {
        Self::new()
    }
}

impl Receiver {
    /// With nothing received yet.
    pub const fn new() -> Self {
        Self { frame: [0; FRAME_CAPACITY], used: 0 }
    }

    /// How many bytes the frame under way still needs at least: so many may be waited for at once.
    pub fn missing(&self) -> usize {
        self.length().unwrap_or(HEAD).saturating_sub(self.used).max(1)
    }

    /// Whether the last byte was part of no frame, or the end of one.
    pub fn is_idle(&self) -> bool {
        self.used == 0
    }

    fn length(&self) -> Option<usize> {
        (self.used >= HEAD)
            .then(|| HEAD + usize::from(u16::from_le_bytes([self.frame[4], self.frame[5]])) + TAIL)
    }

    /// Takes the next byte; returns kind and payload when it ends a good frame.
    pub fn take(&mut self, byte: u8) -> Option<(FrameKind, &[u8])> {
        self.frame[self.used] = byte;
        self.used += 1;
        if (self.used == 1 && byte != MAGIC[0]) || (self.used == 2 && byte != MAGIC[1]) {
            // The second byte may be the first one of the frame that comes.
            self.frame[0] = byte;
            self.used = usize::from(byte == MAGIC[0]);
            return None;
        }
        let length = self.length()?;
        if length > FRAME_CAPACITY {
            self.used = 0;
            return None;
        }
        if self.used < length {
            return None;
        }
        self.used = 0;
        let (body, sum) = self.frame[..length].split_at(length - TAIL);
        let kind = match body[2] {
            1 => FrameKind::Readings,
            2 => FrameKind::Answer,
            _ => return None,
        };
        (checksum(&body[2..]).to_le_bytes() == *sum).then_some((kind, &body[HEAD..]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> PlantState {
        let mut state = PlantState::new(1, 9, 2);
        state.header.sequence = 7;
        state.time_ns = 1_234_567;
        state.position[..2].copy_from_slice(&[0.1, -2.0]);
        state.velocity[..2].copy_from_slice(&[f64::MIN_POSITIVE, 3.5]);
        state.sensors = sensor::INERTIAL_UNIT | sensor::INERTIAL_SUMS;
        state.imu_specific_force = [0.0, 0.1, 9.81];
        state.n_feet = 1;
        state.feet[0] =
            FootReading { flags: 1, reserved: 0, torque_s: [1.0, 2.0, 3.0], force_s: [4.0, 5.0, 6.0] };
        state
    }

    fn received(bytes: &[u8]) -> Option<std::vec::Vec<u8>> {
        let mut receiver = Receiver::new();
        bytes.iter().find_map(|byte| receiver.take(*byte).map(|(_, payload)| payload.to_vec()))
    }

    #[test]
    fn the_checksum_is_the_published_one() {
        // CRC-16/CCITT-FALSE of "123456789": the check value of its catalogue entry.
        assert_eq!(checksum(b"123456789"), 0x29b1);
    }

    #[test]
    fn readings_and_answers_arrive_as_they_were_sent() {
        let (sent, mut frame) = (state(), [0; FRAME_CAPACITY]);
        let length = write_readings(&sent, &mut frame).unwrap();
        let mut got = PlantState::new(1, 9, 2);
        read_readings(&received(&frame[..length]).unwrap(), &mut got).unwrap();
        assert_eq!(got, sent);
        let mut command = Command::new(1, 9, 2);
        command.segments[0].torque[1] = 4.0;
        command.gain[1][MAX_JOINTS] = 5.0;
        let figures = BoardFigures { level: 1, stack_bytes: 99, ..BoardFigures::default() };
        let length = write_answer(&sent, &figures, &[0.5, 0.25], Some(&command), &mut frame).unwrap();
        let answer = read_answer(&received(&frame[..length]).unwrap()).unwrap();
        assert_eq!((answer.sequence, answer.joints, answer.figures), (7, 2, figures));
        assert_eq!((answer.torque[..2].to_vec(), answer.cycled), (std::vec![0.5, 0.25], true));
        assert_eq!((answer.feed_forward[1], answer.gain[1][MAX_JOINTS]), (4.0, 5.0));
    }

    #[test]
    fn a_damaged_frame_is_skipped_and_the_next_one_is_found() {
        let (sent, mut frame) = (state(), [0; FRAME_CAPACITY]);
        let length = write_readings(&sent, &mut frame).unwrap();
        for at in 0..length {
            let mut stream = frame[..length].to_vec();
            stream[at] ^= 0x10;
            let damaged = received(&stream);
            assert!(damaged.is_none(), "byte {at}");
            // A length that is damaged may swallow frames, but not for ever.
            for _ in 0..200 {
                stream.extend_from_slice(&frame[..length]);
            }
            assert!(received(&stream).is_some(), "byte {at}");
        }
        assert!(write_readings(&sent, &mut frame[..20]).is_none());
        assert!(read_readings(&frame[6..length - 3], &mut PlantState::new(1, 9, 2)).is_none());
        assert!(read_readings(&frame[6..length - 2], &mut PlantState::new(1, 9, 3)).is_none());
    }
}
