//! Nothing stays behind.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::time::{Duration, Instant, SystemTime};

use delmpc_messages::PlantState;
use delmpc_transport::{
    Channel, LinkError, Publisher, RunId, RunNode, remove_dead_runs, remove_leftovers, runtime_folder,
};
use rustix::fs::{CWD, FileType, Mode, mknodat};

use crate::support::{HASH, TestRun};

#[test]
fn after_a_clean_end_nothing_is_left_once_removed() {
    let run = TestRun::new();
    assert_eq!(run.files(), Vec::<std::path::PathBuf>::new());
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let subscriber = node.subscriber::<PlantState>(Channel::State).unwrap();
    publisher.send(&run.state(1)).unwrap();
    assert!(!run.files().is_empty());
    drop((publisher, subscriber, node));
    remove_leftovers(run.0).unwrap();
    assert_eq!(run.files(), Vec::<std::path::PathBuf>::new());
    assert_eq!(remove_leftovers(run.0).unwrap(), 0, "a second time there is nothing to do");
}

#[test]
fn a_run_in_use_is_not_touched_and_the_process_is_named() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let mut publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let files = run.files();
    let error = remove_leftovers(run.0).unwrap_err();
    let pid_is_ours = matches!(error, LinkError::StillInUse { pid, .. } if pid == std::process::id());
    assert!(pid_is_ours, "{error}");
    assert_eq!(run.files(), files);
    publisher.send(&run.state(1)).unwrap();
}

#[test]
fn a_run_that_never_was_leaves_nothing_to_remove() {
    assert_eq!(remove_leftovers(RunId(0x0123_4567_89ab_cdef)).unwrap(), 0);
}

/// Whatever lies in the place of a run's folder, or in it, is removed as itself: no link is followed, nothing is opened that may block.
#[test]
fn links_and_pipes_in_the_way_lead_nowhere_and_block_nobody() {
    let victim = std::env::temp_dir().join(format!("delmpc-victim-{}", std::process::id()));
    fs::create_dir_all(&victim).unwrap();
    fs::write(victim.join("precious"), "1").unwrap();
    let long_ago = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000_000_000);

    let run = TestRun::new();
    let root = runtime_folder().unwrap().join(run.0.to_string());
    fs::create_dir(&root).unwrap();
    symlink(&victim, root.join("services")).unwrap();
    fs::create_dir(root.join("nodes")).unwrap();
    let pipe = root.join("nodes").join("pipe.details");
    mknodat(CWD, &pipe, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    fs::File::open(&root).unwrap().set_modified(long_ago).unwrap();
    let begin = Instant::now();
    assert!(remove_dead_runs(Duration::from_secs(20), || false).contains(&run.0));
    assert!(begin.elapsed() < Duration::from_secs(20), "something blocked");
    assert!(!root.exists());

    for in_the_way in ["a link", "a pipe inside"] {
        match in_the_way {
            "a link" => symlink(&victim, &root).unwrap(),
            _ => {
                fs::create_dir(&root).unwrap();
                mknodat(CWD, root.join("nodes"), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
            }
        }
        let node = RunNode::open(run.0, HASH).unwrap();
        let _publisher = node.publisher::<PlantState>(Channel::State).unwrap();
        assert!(root.symlink_metadata().unwrap().is_dir(), "{in_the_way}");
        drop((_publisher, node));
        remove_leftovers(run.0).unwrap();
    }
    assert_eq!(fs::read_dir(&victim).unwrap().count(), 1);
    assert_eq!(fs::read_to_string(victim.join("precious")).unwrap(), "1");
    fs::remove_dir_all(&victim).unwrap();
}

#[test]
fn looking_for_dead_runs_ends_at_once_when_somebody_wants_it() {
    let begin = Instant::now();
    remove_dead_runs(Duration::from_secs(60), || true);
    assert!(begin.elapsed() < Duration::from_secs(5));
}

#[test]
fn nothing_of_a_run_is_open_to_others() {
    let run = TestRun::new();
    let node = RunNode::open(run.0, HASH).unwrap();
    let _publisher = node.publisher::<PlantState>(Channel::State).unwrap();
    let root = runtime_folder().unwrap();
    assert_eq!(fs::metadata(&root).unwrap().permissions().mode() & 0o777, 0o700);
    for file in run.files().iter().filter(|file| !file.starts_with(&root)) {
        let mode = fs::metadata(file).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode & 0o077, 0, "{mode:o} {}", file.display());
    }
}
