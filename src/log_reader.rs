//! A log as it comes, piece by piece: in bounded memory, whatever its length and whatever is wrong with it.
//!
//! A log whose writer was killed, or whose disk was full, ends somewhere. Everything up to its last whole chunk is read, and then it is
//! said that the log is cut. Records that the writer had no room for leave a hole in the numbers of their channel.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use mcap::McapError;
use mcap::records::{Metadata, Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::input_file::open_plain;
use crate::verdict::Failure;

/// Largest record and largest chunk, compressed or not, that are believed: ours are of one or two megabytes.
const LARGEST_RECORD: usize = 8 << 20;
/// Most channels that are believed; ours are seven.
const MOST_CHANNELS: usize = 1000;

/// Something in a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Item<'a> {
    /// What the run is about.
    About(BTreeMap<String, String>),
    /// A message.
    Message {
        /// Its channel.
        topic: &'a str,
        /// Time of the plant's clock (ns).
        time_ns: u64,
        /// Messages of the same channel that are missing before it.
        missing: u32,
        /// Its content.
        data: &'a [u8],
    },
}

/// How a log ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum End {
    /// With its end.
    Whole,
    /// In the middle: why.
    Cut(String),
}

/// What a channel is, and how far it has come.
#[derive(Debug)]
struct Channel {
    topic: String,
    next: u32,
}

/// Reads a log from its beginning.
#[derive(Debug)]
pub struct LogReader<R> {
    input: R,
    events: Events,
    channels: BTreeMap<u16, Channel>,
    /// Records of the chunk being read.
    chunk: Vec<u8>,
    end: Option<End>,
}

/// The reader of the container; it is not `Debug` itself.
struct Events(LinearReader);

impl std::fmt::Debug for Events {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Events")
    }
}

impl LogReader<File> {
    /// Opens a log.
    ///
    /// # Errors
    /// [`Failure::Input`] when it cannot be read or is no MCAP file.
    pub fn open(file: &Path) -> Result<Self, Failure> {
        let broken = |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", file.display()));
        let mut input = open_plain(file).map_err(|error| broken(&error))?;
        let mut magic = [0; mcap::MAGIC.len()];
        input.read_exact(&mut magic).map_err(|_| broken(&"it is no log: shorter than the head of one"))?;
        if magic != *mcap::MAGIC {
            return Err(broken(&"it is no log: MCAP files begin otherwise"));
        }
        Ok(Self::new(input))
    }
}

impl<R: Read> LogReader<R> {
    /// Reads a log whose eight bytes of magic have been read.
    pub fn new(input: R) -> Self {
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_emit_chunks(true)
            .with_record_length_limit(LARGEST_RECORD);
        let events = Events(LinearReader::new_with_options(options));
        Self { input, events, channels: BTreeMap::new(), chunk: Vec::new(), end: None }
    }

    /// Hands every item to `take` until it says `false` or the log ends; says how the log ends, or `None` when it was not read so far.
    ///
    /// # Errors
    /// When the file cannot be read, or by `take`.
    pub fn each(
        &mut self,
        mut take: impl FnMut(Item<'_>) -> Result<bool, Failure>,
    ) -> Result<Option<End>, Failure> {
        while self.end.is_none() {
            let Some(event) = self.events.0.next_event() else {
                self.end = Some(End::Whole);
                break;
            };
            match event {
                Err(error) => self.end = Some(End::Cut(in_words(&error))),
                Ok(LinearReadEvent::ReadRequest(need)) => {
                    let length = read(&mut self.input, self.events.0.insert(need)).map_err(Failure::fault)?;
                    self.events.0.notify_read(length);
                }
                Ok(LinearReadEvent::Record { opcode: op::DATA_END, .. }) => self.end = Some(End::Whole),
                Ok(LinearReadEvent::Record { opcode: op::CHUNK, data }) => {
                    match open_chunk(data, &mut self.chunk) {
                        Err(why) => self.end = Some(End::Cut(why)),
                        Ok(()) => {
                            let mut rest = self.chunk.as_slice();
                            while !rest.is_empty() {
                                let Some((opcode, data)) = next_record(&mut rest) else {
                                    self.end = Some(End::Cut(
                                        "a record in a chunk is longer than the chunk".to_owned(),
                                    ));
                                    break;
                                };
                                match hand_over(opcode, data, &mut self.channels, &mut take)? {
                                    Handed::GoOn => {}
                                    Handed::Enough => return Ok(None),
                                    Handed::Bad(why) => {
                                        self.end = Some(End::Cut(why));
                                        break;
                                    }
                                }
                            }
                        }
                    }
                }
                Ok(LinearReadEvent::Record { opcode, data }) => {
                    match hand_over(opcode, data, &mut self.channels, &mut take)? {
                        Handed::GoOn => {}
                        Handed::Enough => return Ok(None),
                        Handed::Bad(why) => self.end = Some(End::Cut(why)),
                    }
                }
            }
        }
        Ok(self.end.clone())
    }
}

/// What came of a record.
enum Handed {
    GoOn,
    /// Nobody wants more.
    Enough,
    /// It is not what it says.
    Bad(String),
}

fn hand_over(
    opcode: u8,
    data: &[u8],
    channels: &mut BTreeMap<u16, Channel>,
    take: &mut impl FnMut(Item<'_>) -> Result<bool, Failure>,
) -> Result<Handed, Failure> {
    // Of other records nothing is needed, and the library (0.26) slices beyond the end of an attachment that is too short.
    if ![op::METADATA, op::CHANNEL, op::MESSAGE].contains(&opcode) {
        return Ok(Handed::GoOn);
    }
    let noted = mcap::parse_record(opcode, data).map_err(|error| in_words(&error));
    let goes_on = match noted.and_then(|record| note(record, channels).map_err(str::to_owned)) {
        Err(why) => return Ok(Handed::Bad(why)),
        Ok(Noted::Nothing) => true,
        Ok(Noted::About(about)) => take(Item::About(about))?,
        Ok(Noted::Message { channel, time_ns, missing, at }) => {
            let topic = channels.get(&channel).map_or("", |channel| &channel.topic);
            take(Item::Message { topic, time_ns, missing, data: data.get(at..).unwrap_or_default() })?
        }
    };
    Ok(if goes_on { Handed::GoOn } else { Handed::Enough })
}

/// Puts the records of a chunk into `records`, as far as they are believed: of the size and with the checksum it says.
///
/// Not by the library: 0.26 overflows on a record in a chunk that is longer than the chunk.
fn open_chunk(data: &[u8], records: &mut Vec<u8>) -> Result<(), String> {
    let (header, packed) = match mcap::parse_record(op::CHUNK, data) {
        Ok(Record::Chunk { header, data }) => (header, data),
        Ok(_) => return Err("a chunk is none".to_owned()),
        Err(error) => return Err(in_words(&error)),
    };
    let size = usize::try_from(header.uncompressed_size).unwrap_or(usize::MAX);
    if size > LARGEST_RECORD {
        return Err(format!("a chunk says that it holds {} bytes", header.uncompressed_size));
    }
    records.clear();
    let most = size as u64 + 1;
    let unpacked = match header.compression.as_str() {
        "" => packed.as_ref().take(most).read_to_end(records),
        "lz4" => {
            lz4::Decoder::new(packed.as_ref()).and_then(|decoder| decoder.take(most).read_to_end(records))
        }
        other => return Err(format!("a chunk is compressed by {other:?}, which is not read")),
    };
    unpacked.map_err(|error| format!("a chunk cannot be decompressed: {error}"))?;
    if records.len() != size {
        return Err("a chunk has another size than it says".to_owned());
    }
    if header.uncompressed_crc != 0 && crc32fast::hash(records) != header.uncompressed_crc {
        return Err("the checksum of a chunk is another one".to_owned());
    }
    Ok(())
}

/// Takes the next record from the content of a chunk; `None`: it is longer than what is left.
fn next_record<'a>(rest: &mut &'a [u8]) -> Option<(u8, &'a [u8])> {
    let (head, behind) = rest.split_at_checked(RECORD_HEAD)?;
    let length = u64::from_le_bytes(head[1..].try_into().ok()?);
    let (data, behind) = behind.split_at_checked(usize::try_from(length).ok()?)?;
    *rest = behind;
    Some((head[0], data))
}

/// Bytes of a record before its content: what it is, and how long.
const RECORD_HEAD: usize = 9;

/// What a record means.
enum Noted {
    Nothing,
    About(BTreeMap<String, String>),
    Message { channel: u16, time_ns: u64, missing: u32, at: usize },
}

/// Bytes of a message record before its content.
const MESSAGE_HEAD: usize = 22;

fn note(record: Record<'_>, channels: &mut BTreeMap<u16, Channel>) -> Result<Noted, &'static str> {
    Ok(match record {
        Record::Metadata(Metadata { metadata, .. }) => Noted::About(metadata),
        Record::Channel(channel) => {
            if channels.len() >= MOST_CHANNELS {
                return Err("it has more channels than any log of ours");
            }
            channels.entry(channel.id).or_insert(Channel { topic: channel.topic, next: 0 });
            Noted::Nothing
        }
        Record::Message { header, .. } => {
            let Some(channel) = channels.get_mut(&header.channel_id) else {
                return Err("a message is of a channel that was not declared");
            };
            let missing = header.sequence.checked_sub(channel.next);
            let missing = missing.ok_or("the messages of a channel are not in order")?;
            channel.next = header.sequence.checked_add(1).ok_or("a message has the last of all numbers")?;
            Noted::Message { channel: header.channel_id, time_ns: header.log_time, missing, at: MESSAGE_HEAD }
        }
        _ => Noted::Nothing,
    })
}

/// As much as there is; a signal is no reason to stop.
fn read(input: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    loop {
        match input.read(buffer) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            other => return other,
        }
    }
}

/// Why a log is cut.
fn in_words(error: &McapError) -> String {
    match error {
        McapError::UnexpectedEof => "the file ends in the middle of it".to_owned(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(code: u8, content: &[u8]) -> Vec<u8> {
        [&[code][..], &(content.len() as u64).to_le_bytes(), content].concat()
    }

    /// A chunk whose content is `records`.
    fn chunk(size: u64, records: &[u8]) -> Vec<u8> {
        let numbers = [[0; 16].to_vec(), size.to_le_bytes().to_vec(), vec![0; 8]].concat();
        record(
            op::CHUNK,
            &[numbers, (records.len() as u64).to_le_bytes().to_vec(), records.to_vec()].concat(),
        )
    }

    fn end_of(content: &[u8]) -> Option<End> {
        LogReader::new(content).each(|_| Ok(true)).unwrap()
    }

    #[test]
    fn a_record_that_is_longer_than_its_chunk_is_where_the_log_is_cut() {
        for length in [10, 1 << 32, u64::MAX / 2, u64::MAX - 8, u64::MAX] {
            let inner = [&[op::MESSAGE][..], &length.to_le_bytes(), b"short"].concat();
            let end = end_of(&chunk(inner.len() as u64, &inner));
            assert!(
                matches!(&end, Some(End::Cut(why)) if why.contains("longer than the chunk")),
                "{length}: {end:?}"
            );
        }
        for size in [0, 3, 1 << 40, u64::MAX] {
            assert!(matches!(end_of(&chunk(size, b"1234")), Some(End::Cut(_))), "{size}");
        }
        for length in 0..60 {
            let parts = [
                op::ATTACHMENT,
                op::SCHEMA,
                op::STATISTICS,
                op::CHUNK_INDEX,
                op::MESSAGE,
                op::CHANNEL,
                op::METADATA,
            ];
            for code in parts {
                end_of(&record(code, &vec![0; length]));
                let inner = record(code, &vec![0; length]);
                end_of(&chunk(inner.len() as u64, &inner));
            }
        }
        let whole = [chunk(0, b""), record(op::DATA_END, &[0; 4])].concat();
        assert_eq!(end_of(&whole), Some(End::Whole));
    }
}
