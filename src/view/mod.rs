//! The live page of `delmpc run --view`: the report's page on this machine's loopback, fed while the run goes on.
//!
//! | file | what it does |
//! |---|---|
//! | [`feed`] | makes a row of the page's tables from what the two processes say to each other |
//! | [`server`] | serves page and rows, hears what a person wishes |
//!
//! The plant stays the authority: what a person does in the page goes through the supervisor's pipe to the plant
//! ([`crate::steering`]), which acts on it, or does not, and logs what it did. The page shows what the plant said.
//!
//! Only this machine can reach the page, and only the page itself may steer: requests that name another host, and connections that come
//! from a page of another origin, are refused.

use std::io::Write;
use std::sync::{Arc, PoisonError};

use delmpc_transport::RunId;
use serde_json::json;

use crate::report::page::{assemble, description};
use crate::setup::Setup;
use crate::supervisor::PlantPipe;
use crate::verdict::Failure;

pub mod feed;
pub mod server;

use feed::Feed;
use server::Server;

/// The live page of a run.
#[derive(Debug)]
pub struct View {
    server: Arc<Server>,
    pipe: PlantPipe,
}

impl View {
    /// Serves the page; the run waits until somebody opens it.
    ///
    /// # Errors
    /// [`Failure::Input`] when the port is taken.
    pub fn new(setup: &Setup, port: u16) -> Result<Self, Failure> {
        let mut data = description(setup);
        data["live"] = json!(true);
        let page = assemble(&setup.scenario.name, &data)?;
        let pipe = PlantPipe::default();
        let server = Arc::new(Server::start(port, page, pipe.clone())?);
        Ok(Self { server, pipe })
    }

    /// Address of the page.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/", self.server.port())
    }

    /// The way to the plant, for its supervisor.
    pub fn pipe(&self) -> PlantPipe {
        self.pipe.clone()
    }

    /// Listens to the run. Drop it before the run's shared memory is tidied up.
    ///
    /// # Errors
    /// [`Failure::Fault`] when shared memory is unusable.
    pub fn watch(&self, setup: &Setup, run: RunId) -> Result<Watch, Failure> {
        let feed = Feed::new(setup, run)?;
        Ok(Watch { server: self.server.clone(), feed, pipe: self.pipe.clone(), begun: false })
    }

    /// Tells the page how the run ended, and waits a moment until it has heard.
    pub fn finish(&self, success: bool, failure: Option<&str>) {
        self.server.publish(json!({"end": {"success": success, "failure": failure}}).to_string());
        self.server.finish();
    }
}

/// Passes on what happens in a run.
pub struct Watch {
    server: Arc<Server>,
    feed: Feed,
    pipe: PlantPipe,
    begun: bool,
}

impl Watch {
    /// Sends what is new. Call it again and again while the run goes on.
    pub fn look(&mut self) {
        if !self.begun && self.server.has_been_opened() {
            self.begun = send_line(&self.pipe, "resume");
        }
        if let Some(row) = self.feed.next(self.server.pull_w()) {
            self.server.publish(row);
        }
    }
}

/// A line to the plant; `false` when there is no plant (yet).
fn send_line(pipe: &PlantPipe, line: &str) -> bool {
    let mut pipe = pipe.lock().unwrap_or_else(PoisonError::into_inner);
    pipe.as_mut().is_some_and(|plant| writeln!(plant, "{line}").and_then(|()| plant.flush()).is_ok())
}
