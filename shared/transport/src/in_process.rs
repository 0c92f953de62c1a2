//! A link within one process: one cell that holds the latest message.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use delmpc_messages::Message;

use crate::{LinkError, Publisher, Subscriber};

/// The latest message and how many were sent so far.
#[derive(Debug)]
struct Cell<T> {
    message: T,
    sent: u64,
}

type SharedCell<T> = Arc<Mutex<Cell<T>>>;

/// A link whose ends are in one process, on one thread or two. The cell is locked for the time of one copy of a message.
pub fn in_process_link<T: Message>() -> (InProcessPublisher<T>, InProcessSubscriber<T>) {
    let cell = Arc::new(Mutex::new(Cell { message: T::zeroed(), sent: 0 }));
    let subscriber = InProcessSubscriber { cell: cell.clone(), received: Box::new(T::zeroed()), seen: 0 };
    (InProcessPublisher { cell }, subscriber)
}

/// The sending end of an [`in_process_link`].
#[derive(Debug)]
pub struct InProcessPublisher<T> {
    cell: SharedCell<T>,
}

/// The receiving end of an [`in_process_link`]. A clone receives every message too, on its own.
#[derive(Debug, Clone)]
pub struct InProcessSubscriber<T> {
    cell: SharedCell<T>,
    received: Box<T>,
    seen: u64,
}

impl<T: Message> Publisher<T> for InProcessPublisher<T> {
    fn send(&mut self, message: &T) -> Result<(), LinkError> {
        let mut cell = lock(&self.cell);
        cell.message = *message;
        cell.sent += 1;
        Ok(())
    }

    fn serve_newcomers(&mut self) -> Result<(), LinkError> {
        Ok(()) // the cell keeps the latest message for everybody
    }
}

impl<T: Message> Subscriber<T> for InProcessSubscriber<T> {
    fn receive_latest(&mut self) -> Result<Option<&T>, LinkError> {
        let cell = lock(&self.cell);
        if cell.sent == self.seen {
            return Ok(None);
        }
        self.seen = cell.sent;
        *self.received = cell.message;
        Ok(Some(&self.received))
    }
}

/// The cell holds plain data, complete after every copy, so a thread that panicked elsewhere leaves nothing broken in it.
fn lock<T>(cell: &SharedCell<T>) -> MutexGuard<'_, Cell<T>> {
    cell.lock().unwrap_or_else(PoisonError::into_inner)
}
