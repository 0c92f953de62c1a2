//! Room in shared memory, made sure of before it is touched: where a page cannot be had, touching it ends the process with SIGBUS.

use std::fs::{self, OpenOptions, Permissions};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;

use delmpc_messages::{Command, Heartbeat, PlantState, Role};
use rustix::fs::{FallocateFlags, OFlags, fallocate, statvfs};
use rustix::io::Errno;

use crate::abandoned::{SHARED_MEMORY, shared_memory_files};
use crate::shared_link::MOST_BORROWED;
use crate::{Channel, LinkError, RunId};

/// Messages on their way beside those that subscribers keep and hold: lent to the publisher, and its history.
const ON_THEIR_WAY: usize = 8;
/// What a run takes in shared memory, bytes: a channel of states, one of commands, three of heartbeats, and some pages of bookkeeping.
pub(crate) const NEEDED: u64 = room::<PlantState>(Channel::State)
    + room::<Command>(Channel::Command)
    + 3 * room::<Heartbeat>(Channel::Heartbeat(Role::Plant))
    + (256 << 10);

/// The messages of a channel, bytes: as many as all its subscribers may keep and hold at a time.
const fn room<T>(channel: Channel) -> u64 {
    let of_one = channel.buffer_size() + MOST_BORROWED;
    ((channel.max_subscribers() * of_one + ON_THEIR_WAY) * size_of::<T>()) as u64
}

/// Refuses a shared memory with less room than that. Where there is none to ask, nothing is refused.
pub(crate) fn check_free(needed: u64) -> Result<(), LinkError> {
    let Ok(found) = statvfs(SHARED_MEMORY) else { return Ok(()) };
    let free = found.f_bavail.saturating_mul(found.f_frsize);
    if free < needed { Err(LinkError::SharedMemoryFull { free, needed }) } else { Ok(()) }
}

/// Takes every page of the run's files from the file system.
pub(crate) fn reserve(run: RunId) -> Result<(), LinkError> {
    for path in shared_memory_files(&run.prefix()) {
        let flags = OFlags::NOFOLLOW.bits() as i32;
        let Ok(file) = OpenOptions::new().read(true).write(true).custom_flags(flags).open(&path) else {
            continue; // gone already, or not finished yet: its maker reserves it
        };
        let length = file.metadata().map_or(0, |file| file.len());
        if length > 0
            && let Err(Errno::NOSPC) = fallocate(&file, FallocateFlags::empty(), 0, length)
        {
            let free = statvfs(SHARED_MEMORY).map_or(0, |found| found.f_bavail * found.f_frsize);
            return Err(LinkError::SharedMemoryFull { free, needed: length });
        }
    }
    Ok(())
}

/// iceoryx2 makes its bookkeeping of nodes for everybody to write; here it is for one user.
pub(crate) fn keep_to_ourselves(run: RunId) {
    for path in shared_memory_files(&run.prefix()) {
        let open_to_others =
            |path: &Path| fs::symlink_metadata(path).is_ok_and(|file| file.permissions().mode() & 0o077 != 0);
        if open_to_others(&path) {
            let _ = fs::set_permissions(&path, Permissions::from_mode(0o600));
        }
    }
}
