//! What a run leaves behind, and how it goes away.
//!
//! Processes that end cleanly take their shared memory with them, except for one small file per run that iceoryx2 keeps; killed ones leave
//! everything. Both are removed here, by the supervisor at the end of a run.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use iceoryx2::node::{DeadNodeView, Node, NodeListFailure, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, LogLevel, ipc, set_log_level};

use crate::abandoned::{
    SHARED_MEMORY, files, is_older_than, shared_memory_files, without_waiting_for_the_lost,
};
use crate::private_root::runtime_folder;
use crate::run_node::config_of;
use crate::sweep::{open_folder, remove_all, remove_strange};
use crate::{LinkError, RunId};

/// A run with a younger file may be about to start.
const YOUNG: Duration = Duration::from_secs(10);
/// Another process may be cleaning up the same dead one; wait that long for it.
const CLEANUP_PATIENCE: Duration = Duration::from_secs(1);
/// How often the caller is asked whether to go on.
const LOOK: Duration = Duration::from_millis(20);

/// Removes everything a run has left in shared memory and in the user's private folder. Call it when all processes of the run have
/// ended and this process has dropped its own [`crate::RunNode`], publishers and subscribers. Returns the number of files removed; 0 when
/// there was nothing. No link is followed, nothing of another user is touched.
///
/// # Errors
/// [`LinkError::StillInUse`] while a process of the run lives: then only what dead processes left is removed.
/// [`LinkError::Leftover`] for a file that cannot be removed; [`LinkError::NotPrivate`], [`LinkError::NoRuntimeFolder`].
pub fn remove_leftovers(run: RunId) -> Result<usize, LinkError> {
    set_log_level(LogLevel::Fatal);
    let folder = runtime_folder()?;
    let leftover = |path: &Path| {
        let path = path.to_owned();
        move |source: io::Error| LinkError::Leftover { run, path, source }
    };
    let root = run.root_path()?;
    if let Some(opened) = open_folder(&root).map_err(leftover(&root))? {
        remove_strange(opened.as_fd()).map_err(leftover(&root))?;
        without_waiting_for_the_lost(run, || bury_dead_processes(run))?;
    }
    let mut removed = 0;
    let shared_memory = Path::new(SHARED_MEMORY);
    for (within, names) in
        [(shared_memory, shared_memory_files(&run.prefix())), (&folder, vec![root.clone()])]
    {
        let Some(opened) = open_folder(within).map_err(leftover(within))? else { continue };
        for path in names {
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            removed += remove_all(opened.as_fd(), name).map_err(leftover(&path))?;
        }
    }
    Ok(removed)
}

/// Removes what may be in the place of a run's folder, or in it, and would lead elsewhere or block whoever opens it.
pub(crate) fn clear_the_way(run: RunId) -> Result<(), LinkError> {
    let (folder, root) = (runtime_folder()?, run.root_path()?);
    let cleared = match open_folder(&root) {
        Ok(Some(opened)) => remove_strange(opened.as_fd()),
        Ok(None) => match open_folder(&folder) {
            Ok(Some(opened)) => remove_all(opened.as_fd(), &run.to_string()).map(drop),
            other => other.map(drop),
        },
        Err(error) => Err(error),
    };
    cleared.map_err(|source| LinkError::Leftover { run, path: root, source })
}

/// Removes what earlier runs of this user have left whose processes, the supervisor among them, were all killed. Runs that live or that
/// may be about to start are not touched. Returns the runs removed.
///
/// It is a courtesy, so it ends after `patience`, or as soon as `stop` says so, even if a file system does not answer.
pub fn remove_dead_runs(patience: Duration, stop: impl Fn() -> bool) -> Vec<RunId> {
    let until = Instant::now() + patience;
    let cancelled = Arc::new(AtomicBool::new(false));
    let (tell, told) = channel();
    let seen_by_worker = cancelled.clone();
    // Not joined: it may never come back.
    let worker = thread::Builder::new().spawn(move || {
        for run in known_runs() {
            if seen_by_worker.load(Ordering::Relaxed) {
                return;
            }
            if !is_young(run)
                && !is_elsewhere(run)
                && remove_leftovers(run).is_ok()
                && tell.send(run).is_err()
            {
                return;
            }
        }
    });
    let mut removed = Vec::new();
    while worker.is_ok() && !stop() && Instant::now() < until {
        match told.recv_timeout(LOOK) {
            Ok(run) => removed.push(run),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    cancelled.store(true, Ordering::Relaxed);
    removed
}

/// Every run of which there is anything.
fn known_runs() -> BTreeSet<RunId> {
    let name = |path: PathBuf| path.file_name()?.to_str().map(str::to_owned);
    let folders = runtime_folder().map(|folder| files(&folder)).unwrap_or_default();
    let mut runs: BTreeSet<RunId> =
        folders.into_iter().filter_map(name).filter_map(|name| name.parse().ok()).collect();
    runs.extend(
        shared_memory_files("").into_iter().filter_map(name).filter_map(|name| RunId::of_file(&name)),
    );
    runs
}

/// Removes the resources of killed processes; fails if one lives.
fn bury_dead_processes(run: RunId) -> Result<(), LinkError> {
    let mut living = None;
    let mut dead: Vec<DeadNodeView<ipc::Service>> = Vec::new();
    let listed = Node::<ipc::Service>::list(&config_of(run)?, |state| {
        match state {
            NodeState::Alive(node) => living = Some(process_id(&node)),
            NodeState::Inaccessible(_) => living = Some(0),
            NodeState::Dead(node) => dead.push(node),
            NodeState::Undefined(_) => {}
        }
        CallbackProgression::Continue
    });
    // Any other failure is that of a run killed while it was being set up: nothing in it lives.
    if listed == Err(NodeListFailure::InsufficientPermissions) {
        living = Some(0);
    }
    for node in dead {
        // What cannot be removed in order is removed file by file afterwards.
        let _ = node.blocking_remove_stale_resources(CLEANUP_PATIENCE);
    }
    match living {
        Some(pid) => Err(LinkError::StillInUse { run, pid }),
        None => Ok(()),
    }
}

fn process_id(node: &impl NodeView) -> u32 {
    let pid = node.details().as_ref().map(|details| details.process_id().value());
    pid.and_then(|pid| u32::try_from(pid).ok()).unwrap_or(0)
}

/// Whether a run has its folder in another place, for a login with another runtime folder, and lives: then a process of this user has its
/// shared memory mapped.
fn is_elsewhere(run: RunId) -> bool {
    if run.root_path().is_ok_and(|root| root.symlink_metadata().is_ok()) {
        return false; // its folder says who lives
    }
    let name = run.prefix();
    let processes = files(Path::new("/proc")).into_iter();
    processes
        .filter_map(|process| fs::read(process.join("maps")).ok())
        .any(|maps| maps.windows(name.len()).any(|window| window == name.as_bytes()))
}

/// Whether anything of the run was made or changed a moment ago.
fn is_young(run: RunId) -> bool {
    let mut paths = shared_memory_files(&run.prefix());
    paths.extend(run.root_path());
    let metadata = paths.into_iter().flat_map(fs::symlink_metadata);
    metadata.into_iter().any(|file| !is_older_than(YOUNG, &file))
}
