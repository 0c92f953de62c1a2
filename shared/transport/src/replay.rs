//! A recording as the receiving end of a link.

use std::io::{ErrorKind, Read};

use delmpc_messages::Message;

use crate::record::SIGNATURE;
use crate::{LinkError, Subscriber};

/// Gives, call by call, what the recorded end of the link got. See [`crate::Record`] for the file format.
#[derive(Debug)]
pub struct Replay<T, R> {
    reader: R,
    /// Calls so far.
    calls: u64,
    /// Records read so far.
    records: u64,
    /// The call the message in `next` belongs to; `None` at the end of the recording.
    next_call: Option<u64>,
    next: Box<T>,
    delivered: Box<T>,
    /// Why the message after `delivered` could not be read.
    failure: Option<LinkError>,
}

impl<T: Message, R: Read> Replay<T, R> {
    /// Opens a recording of messages of type `T`. Give it a buffered reader: it reads in small pieces.
    ///
    /// # Errors
    /// [`LinkError::RecordingNotReadable`] when it is no recording, or one of another message or version.
    pub fn new(reader: R) -> Result<Self, LinkError> {
        let mut replay = Self {
            reader,
            calls: 0,
            records: 0,
            next_call: None,
            next: Box::new(T::zeroed()),
            delivered: Box::new(T::zeroed()),
            failure: None,
        };
        replay.check_header()?;
        replay.read_record()?;
        Ok(replay)
    }

    /// Whether every message, and a failure to read on, has been given out.
    pub fn is_finished(&self) -> bool {
        self.next_call.is_none() && self.failure.is_none()
    }

    fn check_header(&mut self) -> Result<(), LinkError> {
        let mut signature = [0; 8];
        let mut words = [[0; 4]; 2];
        let mut size = [0; 8];
        for part in [&mut signature[..], words.as_flattened_mut(), &mut size] {
            self.reader.read_exact(part).map_err(|error| self.unreadable(&format!("{error}")))?;
        }
        let [magic, version] = words.map(u32::from_le_bytes);
        if signature != SIGNATURE {
            return Err(self.unreadable("not a recording: the file does not begin with DELMPCR1"));
        }
        if magic != T::MAGIC {
            return Err(self.unreadable(&format!("another message (magic {magic:#010x})")));
        }
        if version != T::VERSION || u64::from_le_bytes(size) != size_of::<T>() as u64 {
            return Err(self.unreadable(&format!("another version ({version})")));
        }
        Ok(())
    }

    /// Reads the next record, or notes the end.
    fn read_record(&mut self) -> Result<(), LinkError> {
        self.next_call = None;
        let mut call = [0; 8];
        let Some(first) = self.read_first_byte()? else {
            return Ok(());
        };
        call[0] = first;
        let read = self.reader.read_exact(&mut call[1..]);
        let read = read.and_then(|()| self.reader.read_exact(bytemuck::bytes_of_mut(self.next.as_mut())));
        read.map_err(|error| match error.kind() {
            ErrorKind::UnexpectedEof => self.unreadable("the recording breaks off"),
            _ => self.unreadable(&format!("{error}")),
        })?;
        let call = u64::from_le_bytes(call);
        if call < self.calls {
            return Err(self.unreadable("call numbers out of order"));
        }
        self.next_call = Some(call);
        self.records += 1;
        Ok(())
    }

    /// The first byte of a record; `None` at a clean end of the file.
    fn read_first_byte(&mut self) -> Result<Option<u8>, LinkError> {
        let mut byte = [0];
        loop {
            match self.reader.read(&mut byte) {
                Ok(0) => return Ok(None),
                Ok(_) => return Ok(Some(byte[0])),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(self.unreadable(&format!("{error}"))),
            }
        }
    }

    fn unreadable(&self, what: &str) -> LinkError {
        LinkError::RecordingNotReadable { message: T::NAME, what: what.to_owned(), record: self.records }
    }
}

impl<T: Message, R: Read> Subscriber<T> for Replay<T, R> {
    /// As recorded; nothing after the end.
    ///
    /// # Errors
    /// [`LinkError::RecordingNotReadable`], once, after the last message before the place where the recording breaks off.
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        let call = self.calls;
        self.calls += 1;
        if self.next_call != Some(call) {
            return Ok(None);
        }
        std::mem::swap(&mut self.delivered, &mut self.next);
        self.failure = self.read_record().err();
        Ok(Some(&self.delivered))
    }
}
