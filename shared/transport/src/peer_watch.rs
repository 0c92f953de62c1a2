//! Is the other side still there?

/// Judges a peer by the age of its last *new* message. Shared memory gives no sign when a peer dies; a sequence that stands still does.
///
/// Time is an argument, from any clock that never goes back.
///
/// # Example
/// ```
/// use delmpc_transport::{PeerStatus, PeerWatch};
/// let mut watch = PeerWatch::new(50_000_000, 0); // 50 ms
/// watch.saw(1, 1_000_000);
/// assert!(watch.is_alive(40_000_000));
/// watch.saw(1, 60_000_000); // the same message again is no sign of life
/// assert_eq!(watch.status(60_000_000), PeerStatus::Lost { age_ns: 59_000_000, last_sequence: 1 });
/// watch.saw(2, 61_000_000);
/// assert!(watch.is_alive(61_000_000));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PeerWatch {
    timeout_ns: u64,
    since_ns: u64,
    last_sequence: Option<u64>,
    restarts: u32,
}

/// What is known about a peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PeerStatus {
    /// It has not appeared yet.
    NotSeen {
        /// Time since the watch began.
        waited_ns: u64,
    },
    /// Its last new message is recent.
    Alive {
        /// Age of that message.
        age_ns: u64,
    },
    /// Its last new message is older than the timeout.
    Lost {
        /// Age of that message.
        age_ns: u64,
        /// Sequence of that message.
        last_sequence: u64,
    },
}

impl PeerWatch {
    /// A watch that begins at `now_ns` and gives the peer up after `timeout_ns` without a new message.
    pub fn new(timeout_ns: u64, now_ns: u64) -> Self {
        Self { timeout_ns, since_ns: now_ns, last_sequence: None, restarts: 0 }
    }

    /// Notes a message of the peer. Any change of sequence is a sign of life; a sequence that fell means the peer started again.
    pub fn saw(&mut self, sequence: u64, now_ns: u64) {
        if self.last_sequence == Some(sequence) {
            return;
        }
        if self.last_sequence.is_some_and(|last| sequence < last) {
            self.restarts = self.restarts.saturating_add(1);
        }
        self.last_sequence = Some(sequence);
        self.since_ns = now_ns;
    }

    /// What is known about the peer at `now_ns`.
    pub fn status(&self, now_ns: u64) -> PeerStatus {
        let age_ns = now_ns.saturating_sub(self.since_ns);
        match self.last_sequence {
            None => PeerStatus::NotSeen { waited_ns: age_ns },
            Some(_) if age_ns <= self.timeout_ns => PeerStatus::Alive { age_ns },
            Some(last_sequence) => PeerStatus::Lost { age_ns, last_sequence },
        }
    }

    /// Whether the peer's last new message is recent.
    pub fn is_alive(&self, now_ns: u64) -> bool {
        matches!(self.status(now_ns), PeerStatus::Alive { .. })
    }

    /// How often the peer began counting again.
    pub fn restarts(&self) -> u32 {
        self.restarts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_never_seen_is_not_lost() {
        let watch = PeerWatch::new(10, 100);
        assert_eq!(watch.status(1_000), PeerStatus::NotSeen { waited_ns: 900 });
        assert!(!watch.is_alive(100));
    }

    #[test]
    fn the_timeout_itself_is_still_alive() {
        let mut watch = PeerWatch::new(10, 0);
        watch.saw(1, 5);
        assert_eq!(watch.status(15), PeerStatus::Alive { age_ns: 10 });
        assert_eq!(watch.status(16), PeerStatus::Lost { age_ns: 11, last_sequence: 1 });
        assert_eq!(watch.status(0), PeerStatus::Alive { age_ns: 0 }, "a clock a little behind is no harm");
    }

    #[test]
    fn a_sequence_that_falls_is_a_restart() {
        let mut watch = PeerWatch::new(10, 0);
        for sequence in [7, 8, 1, 1, 2] {
            watch.saw(sequence, 20);
        }
        assert_eq!(watch.restarts(), 1);
        assert!(watch.is_alive(20));
    }
}
