//! A link that loses messages.

use crate::{LinkError, Publisher, Schedule, Subscriber};

/// Loses the messages its [`Schedule`] strikes, on either end of a link. Messages are counted as they pass; a call that receives nothing
/// counts as no message.
#[derive(Debug)]
pub struct Lossy<L> {
    link: L,
    schedule: Schedule,
    lost: u64,
}

impl<L> Lossy<L> {
    /// Wraps one end of a link.
    pub fn new(link: L, schedule: Schedule) -> Self {
        Self { link, schedule, lost: 0 }
    }

    /// Messages lost so far.
    pub fn lost(&self) -> u64 {
        self.lost
    }
}

impl<T, L: Publisher<T>> Publisher<T> for Lossy<L> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        if self.schedule.strikes() {
            self.lost += 1;
            return Ok(());
        }
        self.link.send(message)
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        self.link.serve_newcomers()
    }
}

impl<T, L: Subscriber<T>> Subscriber<T> for Lossy<L> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        let received = self.link.receive_latest()?;
        if received.is_some() && self.schedule.strikes() {
            self.lost += 1;
            return Ok(None);
        }
        Ok(received)
    }
}
