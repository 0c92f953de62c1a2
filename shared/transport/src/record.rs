//! A link that keeps a record of what passes.
//!
//! # File format
//! All integers are little-endian; payloads are the messages as they lie in memory (`repr(C)`, no padding).
//!
//! | bytes | content |
//! |---|---|
//! | 8 | `DELMPCR1` |
//! | 4 | magic word of the message type |
//! | 4 | version of the message type |
//! | 8 | size of one message |
//! | then, for each message: 8 | number of the call it passed in, counted from 0 |
//! | size of one message | the message |
//!
//! Calls in which nothing passed leave no record; the gap in the call numbers says how many there were. So a replay gives every cycle
//! exactly what it got, also when that was nothing.

use std::io::{self, Write};
use std::marker::PhantomData;

use delmpc_messages::Message;

use crate::{LinkError, Publisher, Subscriber};

/// First bytes of every recording.
pub(crate) const SIGNATURE: [u8; 8] = *b"DELMPCR1";

/// Writes every message that passes one end of a link to `W`; [`crate::Replay`] reads it back.
///
/// Recording never disturbs the link: when writing fails, messages pass on and the recording ends there. [`Self::finish`] says so.
#[derive(Debug)]
pub struct Record<T, L, W> {
    link: L,
    tape: Tape<W>,
    message: PhantomData<fn() -> T>,
}

/// The file being written, and the first thing that went wrong with it.
#[derive(Debug)]
struct Tape<W> {
    writer: W,
    calls: u64,
    failure: Option<io::Error>,
}

impl<T: Message, L, W: Write> Record<T, L, W> {
    /// Wraps one end of a link and writes the file's header. Give it a buffered writer: it writes in small pieces.
    pub fn new(link: L, writer: W) -> Self {
        let mut tape = Tape { writer, calls: 0, failure: None };
        tape.write(&[&SIGNATURE]);
        tape.write(&[&T::MAGIC.to_le_bytes(), &T::VERSION.to_le_bytes()]);
        tape.write(&[&(size_of::<T>() as u64).to_le_bytes()]);
        Self { link, tape, message: PhantomData }
    }

    /// Flushes the recording and gives the link and the writer back.
    ///
    /// # Errors
    /// [`LinkError::RecordingNotWritten`] with the first failure, if any.
    pub fn finish(mut self) -> Result<(L, W), LinkError> {
        let flushed = self.tape.writer.flush();
        match self.tape.failure.map_or(flushed, Err) {
            Ok(()) => Ok((self.link, self.tape.writer)),
            Err(source) => Err(LinkError::RecordingNotWritten { message: T::NAME, source }),
        }
    }
}

impl<W: Write> Tape<W> {
    /// Writes the parts one after the other, unless something failed before.
    fn write(&mut self, parts: &[&[u8]]) {
        for part in parts {
            if self.failure.is_none() {
                self.failure = self.writer.write_all(part).err();
            }
        }
    }

    /// Counts a call and writes the message that passed in it.
    fn call<T: Message>(&mut self, message: Option<&T>) {
        if let Some(message) = message {
            self.write(&[&self.calls.to_le_bytes(), bytemuck::bytes_of(message)]);
        }
        self.calls += 1;
    }
}

impl<T: Message, L: Subscriber<T>, W: Write> Subscriber<T> for Record<T, L, W> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        let received = self.link.receive_latest()?;
        self.tape.call(received);
        Ok(received)
    }
}

impl<T: Message, L: Publisher<T>, W: Write> Publisher<T> for Record<T, L, W> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        self.tape.call(Some(message));
        self.link.send(message)
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        self.link.serve_newcomers()
    }
}
