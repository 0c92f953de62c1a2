//! What a process killed in the middle of making a channel leaves: a half-made file that everybody else waits for.
//!
//! iceoryx2 marks a file as finished by its permissions: its shared memory becomes readable, its service files become read-only. A file that
//! is old and not finished has lost its maker. Finished files of dead processes are not touched here: iceoryx2 removes those by itself.

use std::fs::{self, Metadata};
use std::os::fd::AsFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use crate::RunId;
use crate::sweep::{is_our_file, open_folder};

/// Where Linux keeps named shared memory. Elsewhere there is no such folder, and nothing is found in it.
pub(crate) const SHARED_MEMORY: &str = "/dev/shm";

/// Making a file takes far less than a millisecond; a process may be stopped meanwhile, but hardly that long.
const LOST: Duration = Duration::from_secs(1);
/// How often to look. Work that waits for nobody is done before the first look.
const PERIOD: Duration = Duration::from_millis(50);

const OWNER_MAY_READ: u32 = 0o400;
const OWNER_MAY_WRITE: u32 = 0o200;

/// Does work that may wait for a half-made file, and removes the files whose makers are lost meanwhile.
///
/// iceoryx2 0.10 waits without end for shared memory whose maker was killed before it got a size. Without this, a process killed at that
/// moment would hang everybody who joins its run later.
pub(crate) fn without_waiting_for_the_lost<R>(run: RunId, work: impl FnOnce() -> R) -> R {
    let done = AtomicBool::new(false);
    thread::scope(|scope| {
        let janitor = thread::Builder::new().spawn_scoped(scope, || {
            while !done.load(Ordering::Acquire) {
                thread::park_timeout(PERIOD);
                if !done.load(Ordering::Acquire) {
                    remove_abandoned(run);
                }
            }
        });
        let _dismissed_at_the_end = Dismiss { done: &done, janitor: janitor.ok() };
        work()
    })
}

/// Ends the janitor, also when the work panics.
struct Dismiss<'scope, 'done> {
    done: &'done AtomicBool,
    janitor: Option<thread::ScopedJoinHandle<'scope, ()>>,
}

impl Drop for Dismiss<'_, '_> {
    fn drop(&mut self) {
        self.done.store(true, Ordering::Release);
        if let Some(janitor) = &self.janitor {
            janitor.thread().unpark();
        }
    }
}

/// Removes the half-made files of a run whose makers are lost.
fn remove_abandoned(run: RunId) {
    let memory = shared_memory_files(&run.prefix()).into_iter();
    let root = run.root_path().map(|root| files(&root.join("services"))).unwrap_or_default();
    let services = root.into_iter();
    let unfinished_memory = memory.filter(|path| is_lost(path, |mode| mode & OWNER_MAY_READ == 0));
    let unfinished_services = services.filter(|path| is_lost(path, |mode| mode & OWNER_MAY_WRITE != 0));
    for path in unfinished_memory.chain(unfinished_services) {
        let _ = fs::remove_file(path); // if somebody else was faster, so much the better
    }
}

/// The plain files of this user in shared memory whose name begins with `prefix`. What others have put there is not ours to open or remove.
pub(crate) fn shared_memory_files(prefix: &str) -> Vec<PathBuf> {
    let Ok(Some(folder)) = open_folder(Path::new(SHARED_MEMORY)) else { return Vec::new() };
    let ours = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str());
        name.is_some_and(|name| name.starts_with(prefix) && is_our_file(folder.as_fd(), name))
    };
    files(Path::new(SHARED_MEMORY)).into_iter().filter(ours).collect()
}

/// What a folder contains; nothing when there is no such folder.
pub(crate) fn files(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

/// Whether a file was last changed longer than `age` ago.
pub(crate) fn is_older_than(age: Duration, file: &Metadata) -> bool {
    file.modified().is_ok_and(|time| time.elapsed().is_ok_and(|elapsed| elapsed > age))
}

fn is_lost(path: &Path, unfinished: fn(u32) -> bool) -> bool {
    let file = fs::symlink_metadata(path).ok().filter(Metadata::is_file);
    file.is_some_and(|file| unfinished(file.permissions().mode()) && is_older_than(LOST, &file))
}
