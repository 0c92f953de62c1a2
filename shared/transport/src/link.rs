//! The two ends of a link.

use delmpc_messages::Message;
use iceoryx2::prelude::ZeroCopySend;

use crate::LinkError;

/// A message that may also travel through shared memory. Every [`Message`] of `delmpc-messages` does.
pub trait Payload: Message + ZeroCopySend {}

impl<T: Message + ZeroCopySend> Payload for T {}

/// The sending end of a link.
pub trait Publisher<T> {
    /// Makes `message` the latest one. Never waits; replaces a message that nobody has received yet.
    ///
    /// # Errors
    /// When the link itself is broken. That nobody listens is no error.
    fn send(&mut self, message: &T) -> Result<(), LinkError>;

    /// Hands the latest message to subscribers that joined after it was sent. [`Self::send`] does so too; only a sender that falls
    /// silent and waits for an answer, as in lockstep, needs to call this while it waits.
    ///
    /// # Errors
    /// When the link itself is broken.
    fn serve_newcomers(&mut self) -> Result<(), LinkError>;
}

/// The receiving end of a link.
pub trait Subscriber<T> {
    /// The latest message, if one arrived since the last call. Never waits. The content is not checked: call its `validate`.
    ///
    /// # Errors
    /// When the link itself is broken. That nobody sends is no error: see [`crate::PeerWatch`].
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError>;
}

impl<T, S: Subscriber<T> + ?Sized> Subscriber<T> for &mut S {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        (**self).receive_latest()
    }
}

impl<T, P: Publisher<T> + ?Sized> Publisher<T> for Box<P> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        (**self).send(message)
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        (**self).serve_newcomers()
    }
}

impl<T, S: Subscriber<T> + ?Sized> Subscriber<T> for Box<S> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        (**self).receive_latest()
    }
}
