//! One line about the running run, for a terminal.

use delmpc_controller_process::clock::monotonic_ns;
use delmpc_messages::{Command, FallbackLevel, PlantState, Verdict};
use delmpc_transport::{Channel, RunId, RunNode, SharedSubscriber, Subscriber};
use nalgebra::Vector2;

use crate::colour::Colour;
use crate::setup::Setup;
use crate::sole::{cop_margin_m, pressure_point};

/// Time between two lines (ns).
const PERIOD_NS: u64 = 100_000_000;

/// Listens to the run and says how it is.
#[derive(Debug)]
pub struct StatusLine {
    links: Option<Links>,
    polygon: Vec<Vector2<f64>>,
    duration_s: f64,
    period_s: f64,
    state: Option<Box<PlantState>>,
    command: Option<Box<Command>>,
    colour: Colour,
    next_ns: u64,
    stance_foot: usize,
}

#[derive(Debug)]
struct Links {
    states: SharedSubscriber<PlantState>,
    commands: SharedSubscriber<Command>,
}

impl StatusLine {
    /// For a run that is being started. A line that cannot listen stays empty: it is no part of the run.
    pub fn new(setup: &Setup, run: RunId) -> Self {
        let connect = || {
            let node = RunNode::open(run, setup.joint_set_hash()).ok()?;
            let states = node.subscriber(Channel::State).ok()?;
            let commands = node.subscriber(Channel::Command).ok()?;
            Some(Links { states, commands })
        };
        let polygon = setup.robot.sole(setup.scenario.robot.stance.first()).map(|sole| sole.polygon.clone());
        Self {
            links: connect(),
            polygon: polygon.unwrap_or_default(),
            stance_foot: setup.stance_foot(),
            duration_s: setup.scenario.duration_s,
            period_s: 1.0 / setup.scenario.controller.mpc_rate_hz,
            state: None,
            command: None,
            colour: Colour::of(&std::io::stderr()),
            next_ns: 0,
        }
    }

    /// The next line, when it is time for one.
    pub fn look(&mut self) -> Option<String> {
        let now = monotonic_ns();
        if now < self.next_ns {
            return None;
        }
        self.next_ns = now + PERIOD_NS;
        let links = self.links.as_mut()?;
        if let Ok(Some(state)) = links.states.receive_latest() {
            self.state = Some(Box::new(*state));
        }
        if let Ok(Some(command)) = links.commands.receive_latest() {
            self.command = Some(Box::new(*command));
        }
        let (Some(state), Some(command)) = (&self.state, &self.command) else {
            return Some("starting".to_owned());
        };
        let margin = (state.feet().get(self.stance_foot))
            .and_then(|reading| pressure_point(&reading.torque_s, &reading.force_s))
            .map(|point| cop_margin_m(&self.polygon, &point))
            .map_or("in the air".to_owned(), |margin| format!("{:+5.1} mm", 1e3 * margin));
        // The level is said when there is something to say.
        let said = format!("{} {}", verdict(command.verdict()), level(command.fallback_level()));
        let said = format!("{:<18}", said.trim_end());
        let well = command.verdict() == Some(Verdict::Ok)
            && command.fallback_level() == Some(FallbackLevel::FreshSolution);
        // In lockstep a cycle takes the time it takes.
        let cycle_ms = command.report.total_ns as f64 * 1e-6;
        let cycle = match command.report.total_ns {
            0 => String::new(),
            _ => format!("cycle {cycle_ms:5.2} of {:.2} ms   ", 1e3 * self.period_s),
        };
        Some(format!(
            "{:6.2} / {:.0} s   {cycle}pressure point to edge {margin}   {}",
            state.time_ns as f64 * 1e-9,
            self.duration_s,
            if well { self.colour.good(&said) } else { self.colour.bad(&said) },
        ))
    }
}

fn verdict(verdict: Option<Verdict>) -> &'static str {
    match verdict {
        Some(Verdict::Ok) => "ok",
        Some(Verdict::Late) => "late",
        Some(Verdict::Infeasible) => "infeasible",
        Some(Verdict::ModelMismatch) => "model mismatch",
        Some(Verdict::BadState) => "bad state",
        None => "?",
    }
}

fn level(level: Option<FallbackLevel>) -> &'static str {
    match level {
        Some(FallbackLevel::FreshSolution) => "",
        Some(FallbackLevel::ShiftedPlan) => "shifted plan",
        Some(FallbackLevel::StaticLqr) => "static LQR",
        Some(FallbackLevel::GravityHold) => "gravity hold",
        Some(FallbackLevel::DampingOnly) => "damping only",
        Some(FallbackLevel::ZeroTorque) => "no torque",
        None => "?",
    }
}
