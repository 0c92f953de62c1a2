//! What a run leaves behind, and how it goes away.
//!
//! Processes that end cleanly take their shared memory with them, except for one small file per run that iceoryx2 keeps; killed ones leave
//! everything. Both are removed here, by the supervisor at the end of a run.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;

use iceoryx2::node::{DeadNodeView, Node, NodeListFailure, NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, LogLevel, ipc, set_log_level};

use crate::abandoned::{
    SHARED_MEMORY, files, is_older_than, shared_memory_files, without_waiting_for_the_lost,
};
use crate::run_node::config_of;
use crate::{LinkError, RunId};

/// A run with a younger file may be about to start.
const YOUNG: Duration = Duration::from_secs(10);
/// Another process may be cleaning up the same dead one; wait that long for it.
const CLEANUP_PATIENCE: Duration = Duration::from_secs(1);

/// Removes everything a run has left in shared memory and in the folder for temporary files. Call it when all processes of the run have
/// ended and this process has dropped its own [`crate::RunNode`], publishers and subscribers. Returns the number of files removed; 0 when
/// there was nothing.
///
/// # Errors
/// [`LinkError::StillInUse`] while a process of the run lives: then only what dead processes left is removed.
/// [`LinkError::Leftover`] for a file that cannot be removed.
pub fn remove_leftovers(run: RunId) -> Result<usize, LinkError> {
    set_log_level(LogLevel::Fatal);
    let root = run.root_path();
    if root.exists() {
        without_waiting_for_the_lost(run, || bury_dead_processes(run))?;
    }
    let mut removed = 0;
    for path in shared_memory_files(&run.prefix()) {
        removed += usize::from(remove(run, &path, |path| fs::remove_file(path))?);
    }
    removed += count_files(&root);
    remove(run, &root, |path| fs::remove_dir_all(path))?;
    Ok(removed)
}

/// Removes what earlier runs have left whose processes, the supervisor among them, were all killed. Runs that live, that may be about to
/// start, or that belong to somebody else are not touched. Returns the runs removed.
pub fn remove_dead_runs() -> Vec<RunId> {
    let mut runs = BTreeSet::new();
    for folder in [PathBuf::from(SHARED_MEMORY), std::env::temp_dir()] {
        let names =
            files(&folder).into_iter().filter_map(|path| path.file_name()?.to_str().map(str::to_owned));
        runs.extend(names.filter_map(|name| RunId::of_file(&name)));
    }
    runs.retain(|run| !is_young(*run) && remove_leftovers(*run).is_ok());
    runs.into_iter().collect()
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

fn count_files(folder: &Path) -> usize {
    files(folder).into_iter().map(|path| if path.is_dir() { count_files(&path) } else { 1 }).sum()
}

/// Removes one file or folder; says whether it was there.
fn remove(run: RunId, path: &Path, how: fn(&Path) -> io::Result<()>) -> Result<bool, LinkError> {
    match how(path) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(source) => Err(LinkError::Leftover { run, path: path.to_owned(), source }),
    }
}

/// Whether anything of the run was made or changed a moment ago.
fn is_young(run: RunId) -> bool {
    let mut paths = shared_memory_files(&run.prefix());
    paths.push(run.root_path());
    let metadata = paths.into_iter().flat_map(fs::metadata);
    metadata.into_iter().any(|file| !is_older_than(YOUNG, &file))
}
