//! A log as it comes, piece by piece: in bounded memory, whatever its length and whatever is wrong with it.
//!
//! A log whose writer was killed, or whose disk was full, ends somewhere. Everything up to its last whole chunk is read, and then it is
//! said that the log is cut. Records that the writer had no room for leave a hole in the numbers of their channel.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use mcap::McapError;
use mcap::records::{Metadata, Record};
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
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(LARGEST_RECORD);
        let events = Events(LinearReader::new_with_options(options));
        Self { input, events, channels: BTreeMap::new(), end: None }
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
                Ok(LinearReadEvent::Record { opcode, data }) => match mcap::parse_record(opcode, data) {
                    Err(error) => self.end = Some(End::Cut(in_words(&error))),
                    Ok(Record::DataEnd(_)) => self.end = Some(End::Whole),
                    Ok(record) => {
                        let item = match note(record, &mut self.channels) {
                            Ok(item) => item,
                            Err(why) => {
                                self.end = Some(End::Cut(why.to_owned()));
                                break;
                            }
                        };
                        let goes_on = match item {
                            Noted::Nothing => true,
                            Noted::About(about) => take(Item::About(about))?,
                            Noted::Message { channel, time_ns, missing, at } => {
                                let topic = self.channels.get(&channel).map_or("", |channel| &channel.topic);
                                take(Item::Message {
                                    topic,
                                    time_ns,
                                    missing,
                                    data: data.get(at..).unwrap_or_default(),
                                })?
                            }
                        };
                        if !goes_on {
                            return Ok(None);
                        }
                    }
                },
            }
        }
        Ok(self.end.clone())
    }
}

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
