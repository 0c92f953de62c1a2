//! What can be wrong with a link.

use std::io;
use std::path::PathBuf;

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::{ReceiveError, SendError, update_connections::ConnectionFailure};

use crate::RunId;

/// A link that could not be made, used or removed. Each text says which link, what is wrong, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// The text is no run identity.
    #[error(
        "'{text}' is no run id: 16 hexadecimal digits are expected, or a name of up to 64 letters, digits, '.', '_' and '-', such as bench-3"
    )]
    InvalidRunId {
        /// The text.
        text: String,
    },
    /// The operating system gave no random numbers.
    #[error("no random numbers for a run id: /dev/urandom: {source}")]
    NoRandomness {
        /// The cause.
        source: io::Error,
    },
    /// The folder for the service files of all runs is not this user's alone.
    #[error(
        "{}: this folder has to be private, and {what}: remove it, or name another one in XDG_RUNTIME_DIR (a folder of yours of mode 0700)",
        folder.display()
    )]
    NotPrivate {
        /// The folder.
        folder: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The folder for the service files of all runs cannot be made or read.
    #[error(
        "{}: cannot keep the service files of runs there ({source}): set TMPDIR or XDG_RUNTIME_DIR to a folder of yours",
        folder.display()
    )]
    NoRuntimeFolder {
        /// The folder.
        folder: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The shared memory of the run could not be entered.
    #[error(
        "run {run}: shared memory is not available ({source:?}): /dev/shm and {} must be writable for this user",
        root.display()
    )]
    NoSharedMemory {
        /// The run.
        run: RunId,
        /// Its folder.
        root: PathBuf,
        /// The cause.
        source: NodeCreationFailure,
    },
    /// Shared memory is too short for a run.
    #[error(
        "/dev/shm has {} KiB left, {} KiB are needed: make it larger (for a container: --shm-size=64m) or remove what lies there",
        free / 1024,
        needed.div_ceil(1024)
    )]
    SharedMemoryFull {
        /// Bytes left.
        free: u64,
        /// Bytes needed.
        needed: u64,
    },
    /// The peer works with other joints, or the same joints in another order.
    #[error(
        "channel '{channel}': the peer has joint set {found:#018x}, ours is {ours:#018x}: \
         give plant and controller the same robot file"
    )]
    JointSetMismatch {
        /// The channel.
        channel: &'static str,
        /// The joint set hash of the peer.
        found: u64,
        /// Our joint set hash.
        ours: u64,
    },
    /// The channel carries another message type or version.
    #[error(
        "channel '{channel}': the peer carries {found}, we carry {ours}: build both processes from the same source"
    )]
    IncompatiblePayload {
        /// The channel.
        channel: &'static str,
        /// Name of the message type the channel was made for, or "another type".
        found: String,
        /// Name of our message type.
        ours: &'static str,
    },
    /// The channel has its one living publisher, or all its subscribers.
    #[error(
        "channel '{channel}' of run {run}: no room for another {end}: is the process running twice with the same run id?"
    )]
    Occupied {
        /// The run.
        run: RunId,
        /// The channel.
        channel: &'static str,
        /// `"publisher"` or `"subscriber"`.
        end: &'static str,
    },
    /// The channel could not be opened for another reason.
    #[error("channel '{channel}' of run {run}: cannot connect ({reason})")]
    Connect {
        /// The run.
        run: RunId,
        /// The channel.
        channel: &'static str,
        /// What the shared memory said.
        reason: String,
    },
    /// A message could not be sent.
    #[error("channel '{channel}': cannot send ({source:?})")]
    Send {
        /// The channel.
        channel: &'static str,
        /// The cause.
        source: SendError,
    },
    /// Newcomers could not be served.
    #[error("channel '{channel}': cannot serve newcomers ({source:?})")]
    Update {
        /// The channel.
        channel: &'static str,
        /// The cause.
        source: ConnectionFailure,
    },
    /// Messages could not be received.
    #[error("channel '{channel}': cannot receive ({source:?})")]
    Receive {
        /// The channel.
        channel: &'static str,
        /// The cause.
        source: ReceiveError,
    },
    /// Leftovers of a run cannot be removed while a process still uses it.
    #[error("run {run}: process {pid} still uses it: end that process first")]
    StillInUse {
        /// The run.
        run: RunId,
        /// The process; 0 when it belongs to somebody else and cannot be asked.
        pid: u32,
    },
    /// A leftover file could not be removed.
    #[error("run {run}: cannot remove {}: {source}", path.display())]
    Leftover {
        /// The run.
        run: RunId,
        /// The file or folder.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// A recording could not be written.
    #[error("recording of {message}: cannot write ({source}); the file is incomplete from here on")]
    RecordingNotWritten {
        /// The recorded message type.
        message: &'static str,
        /// The cause.
        source: io::Error,
    },
    /// A recording could not be read.
    #[error("recording of {message}: {what} in record {record}")]
    RecordingNotReadable {
        /// The expected message type.
        message: &'static str,
        /// What is wrong.
        what: String,
        /// Index of the record, from 0; 0 also stands for the file's header.
        record: u64,
    },
}
