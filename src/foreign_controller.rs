//! A controller that is not ours: its commands are counted here, as ours counts its own.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::thread::{JoinHandle, sleep};
use std::time::Duration;

use delmpc_controller_process::figures::{CycleFigure, CycleFigures};
use delmpc_messages::Command;
use delmpc_transport::{Channel, RunId, RunNode, SharedSubscriber};

use crate::controller::part;
use crate::output::say;
use crate::part::leave_part;
use crate::run_folder::CONTROLLER_PART;
use crate::setup::Setup;
use crate::verdict::Failure;

const PAUSE: Duration = Duration::from_micros(200);

/// Counts the commands of a run until it is dropped: then the controller's figures are in the run's folder.
#[derive(Debug)]
pub struct CommandCounter {
    thread: Option<JoinHandle<Result<(), Failure>>>,
    stop: Arc<AtomicBool>,
}

impl CommandCounter {
    /// Begins to count: when this returns, no command will be missed.
    ///
    /// # Errors
    /// [`Failure::Fault`] when shared memory cannot be had.
    pub fn begin(setup: &Setup, run: RunId, folder: &Path) -> Result<Self, Failure> {
        let stop = Arc::new(AtomicBool::new(false));
        let (ready, is_ready) = channel();
        let (setup, folder, stopped) = (setup.clone(), folder.to_owned(), stop.clone());
        let thread = std::thread::Builder::new().name("count".to_owned()).spawn(move || {
            let commands = RunNode::open(run, setup.joint_set_hash())
                .and_then(|node| node.recorder::<Command>(Channel::Command))
                .map_err(Failure::fault)?;
            let _ = ready.send(());
            count(&setup, commands, &stopped, folder)
        });
        let counter = Self { thread: Some(thread.map_err(Failure::fault)?), stop };
        match is_ready.recv() {
            Ok(()) => Ok(counter),
            Err(_) => Err(Failure::Fault(
                "nobody can listen to the controller: shared memory cannot be had".to_owned(),
            )),
        }
    }
}

fn count(
    setup: &Setup,
    mut commands: SharedSubscriber<Command>,
    stop: &AtomicBool,
    folder: PathBuf,
) -> Result<(), Failure> {
    let mut figures = CycleFigures::new();
    loop {
        let last = stop.load(Ordering::Acquire);
        let mut news = false;
        while let Some(command) = commands.receive_next().map_err(Failure::fault)? {
            news = true;
            let report = &command.report;
            let figure = CycleFigure {
                total_ns: report.total_ns,
                feedback_ns: report.total_ns,
                linearize_ns: report.linearize_ns,
                riccati_ns: report.riccati_ns,
                qp_ns: report.qp_ns,
            };
            figures.add(command, figure);
        }
        if last && !news {
            break;
        }
        if !news {
            sleep(PAUSE);
        }
    }
    if figures.count() == 0 {
        return Ok(()); // no controller ever spoke: there are no figures
    }
    leave_part(Some(&folder), CONTROLLER_PART, &part(&setup.scenario, &figures))
}

impl Drop for CommandCounter {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        let ended = self.thread.take().map(JoinHandle::join);
        if let Some(Ok(Err(failure))) = ended {
            say(&format!("warning: the controller's commands were not counted: {failure}"));
        }
    }
}
