//! Links that carry the latest message from one end to the other, and wrappers that make a link late, lossy, wrong or recorded.
//!
//! A link is a pair of a [`Publisher`] and a [`Subscriber`] with **latest-value** semantics: a message not yet received is replaced by
//! the next one, and each message is received at most once. Neither end ever waits. After the first exchange nothing allocates, with one
//! exception: iceoryx2 allocates 48 bytes in each send and frees them before it returns ([`SharedPublisher::ALLOCATIONS_PER_SEND`]).
//!
//! | link | made by | between |
//! |---|---|---|
//! | shared memory (iceoryx2) | [`RunNode::publisher`], [`RunNode::subscriber`] | processes of one run |
//! | in process | [`in_process_link`] | two parts of one process, deterministic |
//! | replay | [`Replay`] | a recording and one part |
//!
//! | wrapper | what it does to the link it wraps |
//! |---|---|
//! | [`Delay`] | holds each message back for some cycles or some time, with seeded jitter |
//! | [`Lossy`] | loses messages by a [`Schedule`] |
//! | [`FaultInjector`] | delivers damaged messages by a [`Schedule`] |
//! | [`Record`] | writes what passes to a file that [`Replay`] reads back bit by bit |
//!
//! Both ends may start in either order, and either may be killed and started again. A living peer gets no error when the other one dies:
//! it notices by the age of the last message ([`PeerWatch`]). A run's [`RunId`] is part of every name in shared memory, so that runs in
//! parallel never meet; whoever supervises a run calls [`remove_leftovers`] at its end, and [`remove_dead_runs`] before a new one.
//!
//! Nothing here reads a clock to decide something: time is an argument. The link is polled; whoever polls owns the timer.
//!
//! # Example
//! ```
//! use delmpc_messages::PlantState;
//! use delmpc_transport::{Publisher, Subscriber, in_process_link};
//!
//! let (mut plant, mut controller) = in_process_link::<PlantState>();
//! assert!(controller.receive_latest()?.is_none());
//! let mut state = PlantState::new(1, 2, 30);
//! for sequence in 1..=3 {
//!     state.header.sequence = sequence;
//!     plant.send(&state)?;
//! }
//! assert_eq!(controller.receive_latest()?.map(|s| s.header.sequence), Some(3)); // the latest
//! assert!(controller.receive_latest()?.is_none()); // and only once
//! # Ok::<(), delmpc_transport::LinkError>(())
//! ```

mod abandoned;
mod channel;
mod corrupt;
mod delay;
mod error;
mod fault_injector;
mod in_process;
mod leftovers;
mod link;
mod lossy;
mod memory;
mod peer_watch;
mod private_root;
mod record;
mod replay;
mod run_id;
mod run_node;
mod schedule;
mod seeded;
mod shared_link;
mod sweep;

pub use channel::Channel;
pub use corrupt::Corrupt;
pub use delay::Delay;
pub use error::LinkError;
pub use fault_injector::{Fault, FaultInjector};
pub use in_process::{InProcessPublisher, InProcessSubscriber, in_process_link};
pub use leftovers::{remove_dead_runs, remove_leftovers};
pub use link::{Payload, Publisher, Subscriber};
pub use lossy::Lossy;
pub use peer_watch::{PeerStatus, PeerWatch};
pub use private_root::runtime_folder;
pub use record::Record;
pub use replay::Replay;
pub use run_id::RunId;
pub use run_node::{JOINT_SET, MAX_PROCESSES, RunNode};
pub use schedule::Schedule;
pub use seeded::SplitMix64;
pub use shared_link::{MOST_BORROWED, SharedPublisher, SharedSubscriber};
