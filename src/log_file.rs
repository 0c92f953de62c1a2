//! The file of a log: an MCAP container that is whole up to its last chunk at every moment, written in memory that does not grow.
//!
//! A library would keep an index of every chunk until the end, and chunks are short here: what lies in an open one is lost when the process
//! is killed. So the index goes to a file of its own without a name, and is copied behind the data when the log is finished. A chunk and
//! its index are written in one go.
//!
//! Source: MCAP format specification, version 0.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

use mcap::MAGIC;
use mcap::records::op;

use crate::output_file;

/// Simulated time that a chunk spans at most (ns): so much is lost, beside what has not been handed over yet, when the process is killed.
const CHUNK_NS: u64 = 20_000_000;
/// Bytes after which a chunk ends whatever its time.
const CHUNK_BYTES: usize = 1 << 20;
/// How chunks are compressed.
const COMPRESSION: &str = "lz4";

/// A log that is being written. Errors leave a file that can be read up to its last whole chunk.
#[derive(Debug)]
pub struct LogFile {
    file: File,
    /// Where the next record begins.
    offset: u64,
    /// Messages of the open chunk.
    chunk: Vec<u8>,
    /// Its first and last time (ns).
    times: Option<[u64; 2]>,
    /// Entries of its index, by channel: time and place in the chunk.
    entries: Vec<Vec<(u64, u64)>>,
    /// Records of schemas and channels, which are repeated at the end.
    declared: [Vec<u8>; 2],
    /// Index of attachments and metadata, which goes to the end.
    attached: Vec<u8>,
    metadata: Vec<u8>,
    counts: Counts,
    /// Index of chunks, which goes to the end: a file without a name.
    spool: File,
    buffer: Vec<u8>,
}

/// What the statistics at the end say.
#[derive(Debug, Default)]
struct Counts {
    schemas: u16,
    attachments: u32,
    metadata: u32,
    chunks: u32,
    first_ns: Option<u64>,
    last_ns: u64,
    /// By channel.
    messages: Vec<u64>,
}

impl LogFile {
    /// Makes the file and writes its head.
    ///
    /// # Errors
    /// When the file, or one beside it for the index, cannot be made.
    pub fn create(path: &Path) -> io::Result<Self> {
        let file = output_file::create(path)?;
        let mut log = Self {
            file,
            offset: 0,
            chunk: Vec::with_capacity(CHUNK_BYTES + (1 << 16)),
            times: None,
            entries: Vec::new(),
            declared: Default::default(),
            attached: Vec::new(),
            metadata: Vec::new(),
            counts: Counts::default(),
            spool: nameless(path)?,
            buffer: Vec::new(),
        };
        log.write(MAGIC)?;
        let mut header = Vec::new();
        put_text(&mut header, "ros2");
        put_text(&mut header, concat!("delmpc ", env!("CARGO_PKG_VERSION")));
        log.write_record(op::HEADER, &header)?;
        Ok(log)
    }

    /// Writes what the run is about.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn metadata<'a>(
        &mut self,
        name: &str,
        pairs: impl IntoIterator<Item = (&'a String, &'a String)>,
    ) -> io::Result<()> {
        let mut content = Vec::new();
        put_text(&mut content, name);
        put_list(&mut content, |list| {
            for (key, value) in pairs {
                put_text(list, key);
                put_text(list, value);
            }
        });
        let (at, length) = self.write_record(op::METADATA, &content)?;
        let mut index = Vec::new();
        index.extend(at.to_le_bytes());
        index.extend(length.to_le_bytes());
        put_text(&mut index, name);
        put_record(&mut self.metadata, op::METADATA_INDEX, &index);
        self.counts.metadata += 1;
        Ok(())
    }

    /// Attaches a file. Without a date: logs of lockstep runs are the same bytes.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn attach(&mut self, name: &str, media_type: &str, data: &[u8]) -> io::Result<()> {
        let mut content = vec![0; 16];
        put_text(&mut content, name);
        put_text(&mut content, media_type);
        content.extend((data.len() as u64).to_le_bytes());
        content.extend(data);
        content.extend(crc32fast::hash(&content).to_le_bytes());
        let (at, length) = self.write_record(op::ATTACHMENT, &content)?;
        let mut index = Vec::new();
        for number in [at, length, 0, 0, data.len() as u64] {
            index.extend(number.to_le_bytes());
        }
        put_text(&mut index, name);
        put_text(&mut index, media_type);
        put_record(&mut self.attached, op::ATTACHMENT_INDEX, &index);
        self.counts.attachments += 1;
        Ok(())
    }

    /// Declares a schema; returns its number.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn schema(&mut self, name: &str, encoding: &str, text: &str) -> io::Result<u16> {
        self.counts.schemas += 1;
        let id = self.counts.schemas;
        let mut content = id.to_le_bytes().to_vec();
        for part in [name, encoding, text] {
            put_text(&mut content, part);
        }
        self.write_record(op::SCHEMA, &content)?;
        put_record(&mut self.declared[0], op::SCHEMA, &content);
        Ok(id)
    }

    /// Declares a channel; returns its number.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn channel(&mut self, schema: u16, topic: &str, encoding: &str) -> io::Result<u16> {
        let id = self.entries.len() as u16;
        let mut content = id.to_le_bytes().to_vec();
        content.extend(schema.to_le_bytes());
        put_text(&mut content, topic);
        put_text(&mut content, encoding);
        put_list(&mut content, |_| {});
        self.write_record(op::CHANNEL, &content)?;
        put_record(&mut self.declared[1], op::CHANNEL, &content);
        self.entries.push(Vec::new());
        self.counts.messages.push(0);
        Ok(id)
    }

    /// Writes a message; the chunk before it when that is full.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn message(&mut self, channel: u16, sequence: u32, time_ns: u64, data: &[&[u8]]) -> io::Result<()> {
        let first_ns = self.times.map_or(time_ns, |[first_ns, _]| first_ns);
        if time_ns.saturating_sub(first_ns) >= CHUNK_NS || self.chunk.len() >= CHUNK_BYTES {
            self.end_chunk()?;
        }
        let place = self.chunk.len() as u64;
        let length: usize = 22 + data.iter().map(|part| part.len()).sum::<usize>();
        self.chunk.push(op::MESSAGE);
        self.chunk.extend((length as u64).to_le_bytes());
        self.chunk.extend(channel.to_le_bytes());
        self.chunk.extend(sequence.to_le_bytes());
        self.chunk.extend(time_ns.to_le_bytes());
        self.chunk.extend(time_ns.to_le_bytes());
        data.iter().for_each(|part| self.chunk.extend_from_slice(part));
        let [first_ns, last_ns] = self.times.unwrap_or([time_ns; 2]);
        self.times = Some([first_ns.min(time_ns), last_ns.max(time_ns)]);
        if let Some(entries) = self.entries.get_mut(usize::from(channel)) {
            entries.push((time_ns, place));
            self.counts.messages[usize::from(channel)] += 1;
        }
        Ok(())
    }

    /// Writes the open chunk, so that all messages so far are in the file.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn end_chunk(&mut self) -> io::Result<()> {
        let Some([first_ns, last_ns]) = self.times.take() else { return Ok(()) };
        // The chunk has a checksum of its own.
        let builder = &mut lz4::EncoderBuilder::new();
        let mut encoder =
            builder.block_checksum(lz4::liblz4::BlockChecksum::NoBlockChecksum).build(Vec::new())?;
        encoder.write_all(&self.chunk)?;
        let (records, ended) = encoder.finish();
        ended?;
        let mut out = std::mem::take(&mut self.buffer);
        out.clear();
        let head_length = 8 + 8 + 8 + 4 + 4 + COMPRESSION.len() + 8;
        out.push(op::CHUNK);
        out.extend(((head_length + records.len()) as u64).to_le_bytes());
        for number in [first_ns, last_ns, self.chunk.len() as u64] {
            out.extend(number.to_le_bytes());
        }
        out.extend(crc32fast::hash(&self.chunk).to_le_bytes());
        put_text(&mut out, COMPRESSION);
        out.extend((records.len() as u64).to_le_bytes());
        out.extend(&records);
        let chunk_length = out.len() as u64;

        let mut offsets = Vec::new();
        for (channel, entries) in self.entries.iter_mut().enumerate().filter(|(_, list)| !list.is_empty()) {
            let id = (channel as u16).to_le_bytes();
            offsets.extend(id);
            offsets.extend((self.offset + out.len() as u64).to_le_bytes());
            let mut index = id.to_vec();
            put_list(&mut index, |list| {
                for (time_ns, place) in entries.drain(..) {
                    list.extend(time_ns.to_le_bytes());
                    list.extend(place.to_le_bytes());
                }
            });
            put_record(&mut out, op::MESSAGE_INDEX, &index);
        }
        let mut index = Vec::new();
        for number in [first_ns, last_ns, self.offset, chunk_length] {
            index.extend(number.to_le_bytes());
        }
        put_list(&mut index, |list| list.extend(&offsets));
        index.extend((out.len() as u64 - chunk_length).to_le_bytes());
        put_text(&mut index, COMPRESSION);
        for number in [records.len() as u64, self.chunk.len() as u64] {
            index.extend(number.to_le_bytes());
        }
        let mut record = Vec::new();
        put_record(&mut record, op::CHUNK_INDEX, &index);
        self.spool.write_all(&record)?;
        self.chunk.clear();
        self.counts.chunks += 1;
        self.counts.first_ns = Some(self.counts.first_ns.map_or(first_ns, |ns| ns.min(first_ns)));
        self.counts.last_ns = self.counts.last_ns.max(last_ns);
        let written = self.write(&out);
        self.buffer = out;
        written
    }

    /// Writes what is left, the index and the end.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.end_chunk()?;
        self.write_record(op::DATA_END, &0_u32.to_le_bytes())?;
        let summary_start = self.offset;
        let mut crc = crc32fast::Hasher::new();
        let mut groups = Vec::new();
        let statistics = self.statistics();
        let declared = std::mem::take(&mut self.declared);
        let [attached, metadata] = [std::mem::take(&mut self.attached), std::mem::take(&mut self.metadata)];
        let parts = [
            (op::SCHEMA, &declared[0]),
            (op::CHANNEL, &declared[1]),
            (op::STATISTICS, &statistics),
            (op::ATTACHMENT_INDEX, &attached),
            (op::METADATA_INDEX, &metadata),
        ];
        for (code, records) in parts {
            let start = self.offset;
            self.write_hashed(records, &mut crc)?;
            put_group(&mut groups, code, start, self.offset);
        }
        let start = self.offset;
        self.spool.seek(SeekFrom::Start(0))?;
        let mut block = vec![0; 1 << 16];
        loop {
            let length = self.spool.read(&mut block)?;
            if length == 0 {
                break;
            }
            self.write_hashed(&block[..length], &mut crc)?;
        }
        put_group(&mut groups, op::CHUNK_INDEX, start, self.offset);
        let groups_start = self.offset;
        self.write_hashed(&groups, &mut crc)?;
        let mut footer = vec![op::FOOTER];
        footer.extend(20_u64.to_le_bytes());
        footer.extend(summary_start.to_le_bytes());
        footer.extend(groups_start.to_le_bytes());
        self.write_hashed(&footer, &mut crc)?;
        self.write(&crc.finalize().to_le_bytes())?;
        self.write(MAGIC)
    }

    fn statistics(&self) -> Vec<u8> {
        let Counts { schemas, attachments, metadata, chunks, first_ns, last_ns, ref messages } = self.counts;
        let mut content = messages.iter().sum::<u64>().to_le_bytes().to_vec();
        content.extend(schemas.to_le_bytes());
        for number in [messages.len() as u32, attachments, metadata, chunks] {
            content.extend(number.to_le_bytes());
        }
        content.extend(first_ns.unwrap_or(0).to_le_bytes());
        content.extend(last_ns.to_le_bytes());
        put_list(&mut content, |list| {
            for (channel, count) in messages.iter().enumerate() {
                list.extend((channel as u16).to_le_bytes());
                list.extend(count.to_le_bytes());
            }
        });
        let mut record = Vec::new();
        put_record(&mut record, op::STATISTICS, &content);
        record
    }

    /// Writes a record; returns where it is and how long.
    fn write_record(&mut self, code: u8, content: &[u8]) -> io::Result<(u64, u64)> {
        let at = self.offset;
        let mut record = Vec::with_capacity(9 + content.len());
        put_record(&mut record, code, content);
        self.write(&record)?;
        Ok((at, record.len() as u64))
    }

    fn write_hashed(&mut self, bytes: &[u8], crc: &mut crc32fast::Hasher) -> io::Result<()> {
        crc.update(bytes);
        self.write(bytes)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)?;
        self.offset += bytes.len() as u64;
        Ok(())
    }
}

/// A file that is gone when it is closed, beside another one.
fn nameless(beside: &Path) -> io::Result<File> {
    let path = beside.with_extension("index");
    let file = output_file::create(&path)?;
    std::fs::remove_file(&path)?;
    Ok(file)
}

fn put_record(to: &mut Vec<u8>, code: u8, content: &[u8]) {
    to.push(code);
    to.extend((content.len() as u64).to_le_bytes());
    to.extend_from_slice(content);
}

fn put_text(to: &mut Vec<u8>, text: &str) {
    to.extend((text.len() as u32).to_le_bytes());
    to.extend(text.as_bytes());
}

/// A list behind its length in bytes.
fn put_list(to: &mut Vec<u8>, fill: impl FnOnce(&mut Vec<u8>)) {
    let at = to.len();
    to.extend([0; 4]);
    fill(to);
    let length = (to.len() - at - 4) as u32;
    to[at..at + 4].copy_from_slice(&length.to_le_bytes());
}

fn put_group(groups: &mut Vec<u8>, code: u8, start: u64, end: u64) {
    if end > start {
        let mut content = vec![code];
        content.extend(start.to_le_bytes());
        content.extend((end - start).to_le_bytes());
        put_record(groups, op::SUMMARY_OFFSET, &content);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn another_reader_finds_everything_by_order_and_by_index() {
        let path = std::env::temp_dir().join(format!("delmpc-log-file-{}.mcap", std::process::id()));
        let mut log = LogFile::create(&path).unwrap();
        let about = BTreeMap::from([("seed".to_owned(), "1".to_owned())]);
        log.metadata("run", &about).unwrap();
        log.attach("a.txt", "text/plain", b"content").unwrap();
        let schema = log.schema("s", "ros2msg", "uint32 x").unwrap();
        let channels = ["/a", "/b"].map(|topic| log.channel(schema, topic, "cdr").unwrap());
        for k in 0..1000_u32 {
            let data = [&k.to_le_bytes()[..], b"tail"];
            log.message(channels[k as usize % 2], k / 2, u64::from(k) * 1_000_000, &data).unwrap();
        }
        log.finish().unwrap();
        assert!(!path.with_extension("index").exists());
        let bytes = std::fs::read(&path).unwrap();
        std::fs::remove_file(&path).unwrap();

        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        assert_eq!((summary.chunk_indexes.len(), summary.channels.len(), summary.schemas.len()), (50, 2, 1));
        let statistics = summary.stats.as_ref().unwrap();
        assert_eq!((statistics.message_count, statistics.message_end_time), (1000, 999_000_000));
        assert_eq!(summary.attachment_indexes.len() + summary.metadata_indexes.len(), 2);
        let attached = mcap::read::attachment(&bytes, &summary.attachment_indexes[0]).unwrap();
        assert_eq!(&*attached.data, b"content");
        assert_eq!(mcap::read::metadata(&bytes, &summary.metadata_indexes[0]).unwrap().metadata, about);
        let mut indexed = 0;
        for chunk in &summary.chunk_indexes {
            for message in summary.stream_chunk(&bytes, chunk).unwrap() {
                message.unwrap();
                indexed += 1;
            }
            assert_eq!(summary.read_message_indexes(&bytes, chunk).unwrap().len(), 2);
        }
        let in_order = mcap::MessageStream::new(&bytes).unwrap();
        let found: Vec<_> = in_order.map(|message| message.unwrap().data[..4].to_vec()).collect();
        assert_eq!((indexed, found.len()), (1000, 1000));
        assert!(found.iter().enumerate().all(|(k, data)| data[..] == (k as u32).to_le_bytes()));
    }
}
