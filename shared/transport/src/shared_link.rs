//! The two ends of a channel in shared memory.

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::publisher::Publisher as PublisherPort;
use iceoryx2::port::subscriber::Subscriber as SubscriberPort;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;

use crate::{LinkError, Payload, Publisher, Subscriber};

/// The sending end of a channel; made by [`crate::RunNode::publisher`].
#[derive(Debug)]
pub struct SharedPublisher<T: Payload> {
    port: PublisherPort<ipc::Service, T, ()>,
    channel: &'static str,
}

/// The receiving end of a channel; made by [`crate::RunNode::subscriber`]. Gives out the message where it lies in shared memory, without
/// a copy; the sender cannot touch it until the next call.
#[derive(Debug)]
pub struct SharedSubscriber<T: Payload> {
    /// The message given out. Declared before `port`, so that it is given back first.
    held: Option<Sample<ipc::Service, T, ()>>,
    port: SubscriberPort<ipc::Service, T, ()>,
    /// Who sent the message given out last.
    origin: Option<UniquePublisherId>,
    channel: &'static str,
}

/// Messages looked at per call. One is normal, and a publisher has no more than one waiting. Only when it is from another publisher than
/// the last one may there be two, for one that was started anew: looking again costs as much as the message itself.
const MOST_WAITING: usize = 4;

impl<T: Payload> SharedPublisher<T> {
    /// The budget of heap allocations per send, all of it within iceoryx2 0.10: a reference count for the loan of the memory slot, 48
    /// bytes, freed before the send returns. Its blackboard needs none, but locks out the successor of a killed writer.
    pub const ALLOCATIONS_PER_SEND: u64 = 1;

    pub(crate) fn new(port: PublisherPort<ipc::Service, T, ()>, channel: &'static str) -> Self {
        Self { port, channel }
    }
}

impl<T: Payload> SharedSubscriber<T> {
    pub(crate) fn new(port: SubscriberPort<ipc::Service, T, ()>, channel: &'static str) -> Self {
        Self { held: None, port, origin: None, channel }
    }
}

impl<T: Payload> Publisher<T> for SharedPublisher<T> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        let sent = self.port.send_copy(*message);
        sent.map(|_receivers| ()).map_err(|source| LinkError::Send { channel: self.channel, source })
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        self.port.update_connections().map_err(|source| LinkError::Update { channel: self.channel, source })
    }
}

impl<T: Payload> Subscriber<T> for SharedSubscriber<T> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        self.held = None;
        for _ in 0..MOST_WAITING {
            let received = self.port.receive();
            match received.map_err(|source| LinkError::Receive { channel: self.channel, source })? {
                Some(sample) => {
                    let origin = Some(sample.header().publisher_id());
                    let same = self.origin == origin;
                    self.origin = origin;
                    self.held = Some(sample);
                    if same {
                        break;
                    }
                }
                None => break,
            }
        }
        Ok(self.held.as_ref().map(|sample| sample.payload()))
    }
}
