//! The two ends of a channel in shared memory.

use iceoryx2::port::LoanError;
use iceoryx2::port::publisher::Publisher as PublisherPort;
use iceoryx2::port::subscriber::Subscriber as SubscriberPort;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;

use crate::{LinkError, Payload, Publisher, Subscriber};

/// The sending end of a channel; made by [`crate::RunNode::publisher`].
#[derive(Debug)]
pub struct SharedPublisher<T: Payload> {
    /// Memory for the next message, found after the last one was sent, when nobody waits for it any more. Declared before `port`, so that it
    /// is given back first.
    next: Option<SampleMut<ipc::Service, T, ()>>,
    port: PublisherPort<ipc::Service, T, ()>,
    channel: &'static str,
}

/// The receiving end of a channel; made by [`crate::RunNode::subscriber`]. Gives out the message where it lies in shared memory, without
/// a copy; the sender cannot touch it until the next call.
#[derive(Debug)]
pub struct SharedSubscriber<T: Payload> {
    /// The messages given out last; the latest is before `next_place`. Declared before `port`, so that they are given back first.
    held: [Option<Sample<ipc::Service, T, ()>>; RETURNED_TOGETHER],
    next_place: usize,
    port: SubscriberPort<ipc::Service, T, ()>,
    /// Number of the message given out last.
    sequence: u64,
    channel: &'static str,
}

/// Messages given back at a time. To give one back is to write where the sender looks before it sends: its next message then waits for that
/// cache line to come over. Three of four do not.
const RETURNED_TOGETHER: usize = 4;

/// Messages a subscriber has at most: those not given back yet, and the one being looked at.
pub const MOST_BORROWED: usize = RETURNED_TOGETHER + 1;

/// Messages looked at per call. A publisher has no more than one waiting; there may be two when one was started anew after the other. Then
/// the numbers have a gap: only after one is there a second look, for who polls wants an answer at once.
const MOST_WAITING: usize = 4;

impl<T: Payload> SharedPublisher<T> {
    /// The budget of heap allocations per send, all of it within iceoryx2 0.10: a reference count for the loan of the memory slot, 48
    /// bytes, freed by the next send. Its blackboard needs none, but locks out the successor of a killed writer.
    pub const ALLOCATIONS_PER_SEND: u64 = 1;

    pub(crate) fn new(port: PublisherPort<ipc::Service, T, ()>, channel: &'static str) -> Self {
        Self { next: None, port, channel }
    }

    /// Memory for a message, with the message in it: its cache lines then are this core's.
    fn loan(&self, message: &T) -> Result<SampleMut<ipc::Service, T, ()>, LoanError> {
        Ok(self.port.loan_uninit()?.write_payload(*message))
    }
}

impl<T: Payload> SharedSubscriber<T> {
    pub(crate) fn new(port: SubscriberPort<ipc::Service, T, ()>, channel: &'static str) -> Self {
        Self { held: [const { None }; RETURNED_TOGETHER], next_place: 0, port, sequence: 0, channel }
    }

    /// The oldest message that was not given out yet: of a channel that keeps more than the latest one.
    ///
    /// # Errors
    /// When shared memory is broken.
    pub fn receive_next(&mut self) -> Result<Option<&T>, LinkError> {
        self.receive(1)
    }

    /// Looks at up to `most` messages, up to one that follows the last one by its number.
    fn receive(&mut self, most: usize) -> Result<Option<&T>, LinkError> {
        if self.next_place == RETURNED_TOGETHER {
            self.held = [const { None }; RETURNED_TOGETHER];
            self.next_place = 0;
        }
        let place = &mut self.held[self.next_place];
        for _ in 0..most {
            let received = self.port.receive();
            match received.map_err(|source| LinkError::Receive { channel: self.channel, source })? {
                Some(sample) => {
                    let sequence = sample.payload().header().sequence;
                    let next = sequence == self.sequence.wrapping_add(1);
                    self.sequence = sequence;
                    *place = Some(sample);
                    if next {
                        break;
                    }
                }
                None => break,
            }
        }
        self.next_place += usize::from(place.is_some());
        Ok(place.as_ref().map(|sample| sample.payload()))
    }
}

impl<T: Payload> Publisher<T> for SharedPublisher<T> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        let failed = |source| LinkError::Send { channel: self.channel, source };
        let sample = match self.next.take() {
            Some(mut sample) => {
                *sample.payload_mut() = *message;
                sample
            }
            None => self.loan(message).map_err(|source| failed(source.into()))?,
        };
        sample.send().map_err(failed)?;
        // What fails now is tried again, and told, when it is needed.
        self.next = self.loan(message).ok();
        Ok(())
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        self.port.update_connections().map_err(|source| LinkError::Update { channel: self.channel, source })
    }
}

impl<T: Payload> Subscriber<T> for SharedSubscriber<T> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        self.receive(MOST_WAITING)
    }
}
