//! Section 5 of the paper as one command: its figures 1 to 3 and table 1 against real rivals, and beyond.
//!
//! ```text
//! cargo run --release -p paper              # all of it, some ten minutes on one core; writes runs/paper/
//! cargo run --release -p paper -- --quick   # a small version of everything, under a minute
//! ```
//!
//! | module | what |
//! |---|---|
//! | [`figure1`] | trapezoidal steps: Newton against quasi-Newton |
//! | [`figure2`] | evaluation, Newton direction, linearisation against automatic differentiation |
//! | [`figure3`] | Simpson against Hermite-Simpson; beyond: all orders against Runge-Kutta methods |
//! | [`table1`] | variables and equations of the transcriptions, counted on built problems |
//! | [`energy`], [`constrained`] | beyond: energy over 100 s; orders with the tip pinned |
//! | problems | [`pendulum`], [`one_step`], [`trajectory`] |
//! | rivals | [`quasi_newton`], [`automatic`], [`hermite_simpson`], [`runge_kutta`] on [`articulated_body`], [`inverse_dynamics_derivatives`] |
//! | their tools | [`rigid_bodies`], [`pivoted_lu`] |
//! | ours | [`exact_newton`] and the integrators of `delmpc-mechanics` |
//! | output | [`plot`], [`results`], [`stopwatch`] |
//!
//! Everything runs on one core, in one process, rivals and integrator in turn. `paper.json` holds every claim with its bar and whether it
//! is met; exit status 0 says that the campaign ran, not that all bars are met.
// Nodes, coordinates and links are indices of the formulas.
#![allow(clippy::needless_range_loop)]

mod articulated_body;
mod automatic;
mod constrained;
mod energy;
mod exact_newton;
mod figure1;
mod figure2;
mod figure3;
mod hermite_simpson;
mod inverse_dynamics_derivatives;
mod one_step;
mod pendulum;
mod pivoted_lu;
mod plot;
mod quasi_newton;
mod results;
mod rigid_bodies;
mod runge_kutta;
mod stopwatch;
mod table1;
mod trajectory;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Map, Value, json};

use crate::plot::Figure;
use crate::results::{Claim, Part, Side};

/// The paper's comparisons: figures 1 to 3, table 1, and beyond.
#[derive(Debug, Parser)]
#[command(name = "paper")]
struct Arguments {
    /// A small version of everything.
    #[arg(long)]
    quick: bool,
    /// Where the results go.
    #[arg(long, default_value = "runs/paper")]
    out: PathBuf,
    /// Only these parts (figure1, figure2, figure3, table1, beyond, energy, constrained).
    #[arg(long, value_delimiter = ',')]
    only: Vec<String>,
    /// Seed of the initial conditions.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// What can end a campaign.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error(transparent)]
    Model(#[from] delmpc_mechanics::errors::ModelError),
    #[error(transparent)]
    Step(#[from] delmpc_mechanics::errors::StepError),
    #[error(transparent)]
    Factor(#[from] delmpc_mechanics::errors::FactorError),
    #[error(transparent)]
    Rival(#[from] rigid_bodies::RivalError),
    #[error(transparent)]
    Plot(#[from] plot::PlotError),
    #[error(transparent)]
    Collocation(#[from] hermite_simpson::NotConverged),
    #[error(transparent)]
    Adaptive(#[from] runge_kutta::StepTooSmall),
    #[error(
        "Gauss-Legendre with steps of {time_step} s: the fixed-point iteration does not converge; take smaller steps"
    )]
    FixedPoint { time_step: f64 },
    #[error("{path}: {error}; is the folder writable?")]
    Write { path: PathBuf, error: std::io::Error },
}

/// What all parts share.
struct Campaign {
    quick: bool,
    seed: u64,
    out: PathBuf,
    bar: ProgressBar,
}

/// Ticks of the bar per unit of a part.
const TICKS: f64 = 1000.0;

impl Campaign {
    /// Progress by a share of a cell.
    fn tick(&self, share: f64) {
        self.bar.inc((share * TICKS).round() as u64);
    }

    fn say(&self, what: &str) {
        self.bar.set_message(what.to_owned());
    }

    fn draw(&self, name: &str, figure: &Figure) -> Result<(), plot::PlotError> {
        plot::write(&self.out, name, figure)
    }
}

type Runner = fn(&Campaign) -> Result<Part, Failure>;

/// Parts with their share of the bar.
const PARTS: [(&str, usize, Runner); 7] = [
    ("figure1", figure1::CELLS, figure1::run),
    ("figure2", figure2::CELLS, figure2::run),
    ("figure3", figure3::CELLS[0], figure3::run),
    ("table1", 1, table1::run),
    ("beyond", figure3::CELLS[1], figure3::beyond),
    ("energy", energy::CELLS, energy::run),
    ("constrained", constrained::CELLS, constrained::run),
];

fn campaign(arguments: &Arguments) -> Result<Vec<Claim>, Failure> {
    let out = &arguments.out;
    std::fs::create_dir_all(out).map_err(|error| Failure::Write { path: out.clone(), error })?;
    let wanted: Vec<_> = PARTS
        .iter()
        .filter(|(name, ..)| arguments.only.is_empty() || arguments.only.iter().any(|only| only == name))
        .collect();
    let cells: usize = wanted.iter().map(|(_, cells, _)| cells).sum();
    let bar = ProgressBar::new((cells as f64 * TICKS) as u64);
    if let Ok(style) = ProgressStyle::with_template("{elapsed_precise} {wide_bar} {percent:>3}% {msg:<34}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(250));
    let campaign = Campaign { quick: arguments.quick, seed: arguments.seed, out: out.clone(), bar };
    let start = Instant::now();
    let mut claims = Vec::new();
    let mut facts = Map::new();
    let mut seconds = Map::new();
    for (name, _, run) in wanted {
        let begun = Instant::now();
        let part = run(&campaign)?;
        results::write_files(out, &part).map_err(|error| Failure::Write { path: out.clone(), error })?;
        seconds.insert((*name).to_owned(), json!(begun.elapsed().as_secs_f64()));
        facts.insert(part.key.to_owned(), json!({ "claims": part.claims, "figures": part.facts }));
        claims.extend(part.claims);
    }
    campaign.bar.finish_and_clear();
    let summary = json!({
        "machine": machine(),
        "quick": arguments.quick,
        "seed": arguments.seed,
        "seconds": start.elapsed().as_secs_f64(),
        "seconds_of_parts": Value::Object(seconds),
        "bars_met": claims.iter().filter(|c| c.met).count(),
        "bars": claims.len(),
        "parts": Value::Object(facts),
    });
    write_json(&out.join("paper.json"), &summary)?;
    Ok(claims)
}

fn write_json(path: &Path, value: &Value) -> Result<(), Failure> {
    let failed = |error| Failure::Write { path: path.to_owned(), error };
    let mut text = serde_json::to_string_pretty(value).map_err(|e| failed(e.into()))?;
    text.push('\n');
    std::fs::write(path, text).map_err(failed)
}

/// Model name of the processor, as the system tells.
fn machine() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    name.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}

fn print(claims: &[Claim], out: &Path) {
    for claim in claims {
        let sign = if claim.side == Side::AtLeast { "at least" } else { "at most" };
        let verdict = if claim.met { "met   " } else { "MISSED" };
        println!("{verdict}  {:>12.4e}  {sign} {:<10.4e}  {}", claim.value, claim.bar, claim.claim);
    }
    let met = claims.iter().filter(|c| c.met).count();
    println!("{met} of {} bars met; figures in {}", claims.len(), out.display());
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match campaign(&arguments) {
        Ok(claims) => {
            print(&claims, &arguments.out);
            ExitCode::SUCCESS
        }
        Err(failure) => {
            eprintln!("paper: {failure}");
            ExitCode::FAILURE
        }
    }
}
