//! Arguments of the command.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::model::ModelArguments;
use crate::replay::ReplayArguments;
use crate::report::ReportArguments;

/// What `--help` shows at its end.
const EXAMPLES: &str = "\
Examples:
  delmpc                                        run the main scenario
  delmpc run --set seed=7 --set push.impulse_ns=20
  delmpc run configs/scenarios/atlas_one_foot.toml --set clock=lockstep --json
  delmpc model configs/robots/atlas.urdf
  delmpc replay runs/latest --verify

Exit status: 0 success; 1 a success criterion was missed; 2 usage, configuration or model error; 3 fault (a process
was lost, a link broke); 130 interrupted.";

/// Whole-body model-predictive control on a variational integrator.
///
/// Without a subcommand the main scenario is run: Atlas stands on one foot, fetches a ball and takes a push, with the plant and the
/// controller as two processes.
#[derive(Debug, Parser)]
#[command(name = "delmpc", version, args_conflicts_with_subcommands = true, after_help = EXAMPLES)]
pub struct Cli {
    /// What to do; nothing: `run`.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of `run`, for the call without a subcommand.
    #[command(flatten)]
    pub options: RunOptions,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a scenario: plant and controller as two processes, watched until they end
    Run(RunArguments),
    /// The plant process alone: simulates the robot, waits for a controller of the same scenario
    Plant(PartArguments),
    /// The controller process alone: waits for a plant of the same scenario
    Controller(PartArguments),
    /// Check a robot model; print its table or, with --at, everything computed from it
    Model(ModelArguments),
    /// Run again from the log of a run and compare bit by bit
    Replay(ReplayArguments),
    /// Make report.html and the plots of a run again from its files
    Report(ReportArguments),
}

/// Options of `delmpc run`.
#[derive(Debug, Clone, Default, Args)]
pub struct RunOptions {
    /// Folder of the run [default: runs/<scenario>-<time>, to which runs/latest then points]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Override a key of the scenario, for example --set plant.friction=0.4; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Print nothing but warnings and errors
    #[arg(long)]
    pub quiet: bool,
    /// Print the summary as one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
    /// Do not write report.html and the plots
    #[arg(long)]
    pub no_report: bool,
    /// Both parts in one process: deterministic, for debugging; needs the lockstep clock
    #[arg(long)]
    pub one_process: bool,
}

/// Arguments of `delmpc run`.
#[derive(Debug, Clone, Default, Args)]
pub struct RunArguments {
    /// Scenario file [default: configs/scenarios/atlas_one_foot.toml]
    pub scenario: Option<PathBuf>,
    /// Options.
    #[command(flatten)]
    pub options: RunOptions,
}

/// Arguments of one process alone.
#[derive(Debug, Clone, Args)]
pub struct PartArguments {
    /// Scenario file
    pub scenario: PathBuf,
    /// Override a key of the scenario; give both processes the same
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Run that the process belongs to, 16 hexadecimal digits [default: made from the scenario, the same for both]
    #[arg(long, value_name = "ID")]
    pub run_id: Option<String>,
    /// Folder for the process's part of the results
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// A supervisor starts, watches and ends this process
    #[arg(long, hide = true)]
    pub supervised: bool,
}
