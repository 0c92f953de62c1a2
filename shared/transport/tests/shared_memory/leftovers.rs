//! Nothing stays behind.

use delmpc_messages::PlantState;
use delmpc_transport::{Channel, LinkError, Publisher, RunId, RunNode, remove_leftovers};

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
