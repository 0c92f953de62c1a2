//! A link that is late.

use std::collections::VecDeque;

use delmpc_messages::Message;

use crate::{LinkError, SplitMix64, Subscriber};

/// Holds messages back at the receiving end, by cycles or by time, with seeded jitter.
///
/// Latest-value semantics stay: when several messages are due, the one sent last is delivered and the others are dropped, so a message
/// never arrives after one sent later. A full queue drops its oldest message.
#[derive(Debug)]
pub struct Delay<T, S> {
    link: S,
    /// Messages on their way, in the order they were sent, with the moment from which each may be delivered.
    queue: VecDeque<(u64, T)>,
    capacity: usize,
    delivered: Box<T>,
    unit: Unit,
    now: u64,
    delay: u64,
    jitter: u64,
    random: SplitMix64,
}

/// What `now`, `delay` and `jitter` are counted in.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Unit {
    /// Calls of `receive_latest`.
    Cycles,
    /// Nanoseconds given by `set_time`.
    Nanoseconds,
}

impl<T: Message, S: Subscriber<T>> Delay<T, S> {
    /// Delivers each message `cycles` calls of `receive_latest` later than it would have been.
    pub fn in_cycles(link: S, cycles: u32) -> Self {
        Self::new(link, Unit::Cycles, u64::from(cycles), cycles as usize + 1)
    }

    /// Delivers each message `delay_ns` later, by the time given to [`Self::set_time`]. At most `capacity` messages are on their way.
    pub fn in_time(link: S, delay_ns: u64, capacity: usize) -> Self {
        Self::new(link, Unit::Nanoseconds, delay_ns, capacity.max(1))
    }

    fn new(link: S, unit: Unit, delay: u64, capacity: usize) -> Self {
        Self {
            link,
            queue: VecDeque::with_capacity(capacity),
            capacity,
            delivered: Box::new(T::zeroed()),
            unit,
            now: 0,
            delay,
            jitter: 0,
            random: SplitMix64::new(0),
        }
    }

    /// Adds a random extra delay from 0 to `largest` (cycles or ns, whichever this delay counts), different for each message.
    #[must_use]
    pub fn with_jitter(mut self, largest: u32, seed: u64) -> Self {
        self.jitter = u64::from(largest);
        self.random = SplitMix64::new(seed);
        if self.unit == Unit::Cycles {
            self.capacity += largest as usize;
            self.queue.reserve_exact(self.capacity);
        }
        self
    }

    /// The present time, from whatever clock the caller goes by. Without effect when the delay is counted in cycles.
    pub fn set_time(&mut self, now_ns: u64) {
        if self.unit == Unit::Nanoseconds {
            self.now = now_ns;
        }
    }

    /// Puts what the link has into the queue.
    fn take_in(&mut self) -> Result<(), LinkError> {
        if let Some(message) = self.link.receive_latest()? {
            let due = self.now.saturating_add(self.delay).saturating_add(self.random.up_to(self.jitter));
            if self.queue.len() == self.capacity {
                self.queue.pop_front();
            }
            self.queue.push_back((due, *message));
        }
        Ok(())
    }
}

impl<T: Message, S: Subscriber<T>> Subscriber<T> for Delay<T, S> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        self.take_in()?;
        let now = self.now;
        if self.unit == Unit::Cycles {
            self.now += 1;
        }
        let Some(last_due) = self.queue.iter().rposition(|(due, _)| *due <= now) else {
            return Ok(None);
        };
        for (_, message) in self.queue.drain(..=last_due) {
            *self.delivered = message;
        }
        Ok(Some(&self.delivered))
    }
}
