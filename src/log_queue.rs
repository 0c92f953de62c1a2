//! Records of any length on their way from a loop to the writer of the log, through memory that is there before the run.
//!
//! The loop copies a record into a ring and goes on: no lock, no system call, no allocation. When the ring is full, the record is refused,
//! or waited for.

use std::collections::TryReserveError;
use std::thread::sleep;
use std::time::Duration;

use bytemuck::{Pod, Zeroable};
use rtrb::{Consumer, Producer, RingBuffer};

/// Time between two looks of whoever waits.
const LOOK: Duration = Duration::from_millis(1);

/// What goes before a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Head {
    /// Time of the record (ns).
    pub time_ns: u64,
    /// Number of the record among those of its kind; refused ones count.
    pub sequence: u32,
    /// Kind of the record.
    pub kind: u32,
    /// Bytes that follow.
    pub length: u64,
}

/// The loop's end.
#[derive(Debug)]
pub struct Sender(Producer<u8>);

/// The writer's end.
#[derive(Debug)]
pub struct Receiver(Consumer<u8>);

/// Makes a ring of `capacity` bytes, every page of it touched.
///
/// # Errors
/// When there is not so much memory.
pub fn queue(capacity: usize) -> Result<(Sender, Receiver), TryReserveError> {
    // Asked first: a ring that cannot be made ends the process.
    Vec::<u8>::new().try_reserve_exact(capacity)?;
    let (mut sender, mut receiver) = RingBuffer::new(capacity);
    // Once round the ring: what is written later touches no fresh page.
    if let Ok(chunk) = sender.write_chunk(capacity) {
        chunk.commit_all();
    }
    if let Ok(chunk) = receiver.read_chunk(capacity) {
        chunk.commit_all();
    }
    Ok((Sender(sender), Receiver(receiver)))
}

impl Sender {
    /// Hands over a record in parts; `false`: there is no room. A record larger than the ring never has any.
    pub fn send(&mut self, head: Head, parts: &[&[u8]]) -> bool {
        let length = parts.iter().map(|part| part.len()).sum::<usize>();
        if self.0.slots() < size_of::<Head>() + length {
            return false;
        }
        let head = Head { length: length as u64, ..head };
        // There is room: only this end takes it.
        let _ = self.0.push_partial_slice(bytemuck::bytes_of(&head));
        for part in parts {
            let _ = self.0.push_partial_slice(part);
        }
        true
    }

    /// The same, but waits for room while there is a writer.
    pub fn send_waiting(&mut self, head: Head, parts: &[&[u8]]) -> bool {
        loop {
            if self.send(head, parts) {
                return true;
            }
            if self.0.is_abandoned() {
                return false;
            }
            sleep(LOOK);
        }
    }
}

impl Receiver {
    /// Waits for the next record and puts its content into `content`; `None`: there will be no other.
    pub fn next(&mut self, content: &mut Vec<u8>) -> Option<Head> {
        let mut head = Head::zeroed();
        self.fill(bytemuck::bytes_of_mut(&mut head))?;
        content.resize(head.length as usize, 0);
        self.fill(content)?;
        Some(head)
    }

    fn fill(&mut self, mut bytes: &mut [u8]) -> Option<()> {
        while !bytes.is_empty() {
            // Asked before: what was sent before the end is still taken.
            let ended = self.0.is_abandoned();
            let (filled, rest) = self.0.pop_partial_slice(bytes);
            let none = filled.is_empty();
            bytes = rest;
            if none {
                if ended {
                    return None;
                }
                sleep(LOOK);
            }
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(sequence: u32) -> Head {
        Head { time_ns: u64::from(sequence), sequence, kind: 3, length: 0 }
    }

    #[test]
    fn records_of_any_length_come_out_in_order_and_whole_and_the_end_is_told() {
        let (mut sender, mut receiver) = queue(1000).unwrap();
        let writer = std::thread::spawn(move || {
            let mut content = Vec::new();
            let mut seen = 0;
            while let Some(head) = receiver.next(&mut content) {
                assert_eq!((head.sequence, head.kind, head.length as usize), (seen, 3, content.len()));
                assert_eq!(content.len(), seen as usize * 7 % 900);
                assert!(content.iter().all(|byte| *byte == seen as u8));
                seen += 1;
            }
            seen
        });
        for k in 0..500_u32 {
            let content = vec![k as u8; k as usize * 7 % 900];
            let (a, b) = content.split_at(content.len() / 3);
            assert!(sender.send_waiting(head(k), &[a, b]));
        }
        drop(sender);
        assert_eq!(writer.join().unwrap(), 500);
    }

    #[test]
    fn what_has_no_room_is_refused_whole_and_what_can_never_come_is_not_waited_for() {
        let (mut sender, receiver) = queue(100).unwrap();
        assert!(sender.send(head(0), &[&[1; 60]]));
        assert!(!sender.send(head(1), &[&[1; 60]]));
        assert!(!sender.send(head(1), &[&[1; 600]]));
        drop(receiver);
        assert!(!sender.send_waiting(head(1), &[&[1; 60]]));
    }
}
