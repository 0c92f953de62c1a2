//! The command `delmpc`: parse, call, report how it ended.

use std::alloc::System;
use std::io::ErrorKind;
use std::process::ExitCode;

use clap::Parser;
use delmpc::cli::{Cli, Command, RunArguments};
use delmpc::verdict::{Ended, Failure, exit_code};
use delmpc_controller_process::stop::StopFlag;
use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

/// Counts allocations: a control cycle should make none of its own.
#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

fn main() -> ExitCode {
    StopFlag::outlive_file_limits();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(usage) => return exit_code(say_usage(&usage)),
    };
    let command = cli.command.unwrap_or(Command::Run(RunArguments { scenario: None, options: cli.options }));
    exit_code(match command {
        Command::Run(arguments) => delmpc::run::run(&arguments),
        Command::Plant(arguments) => delmpc::plant::plant(&arguments),
        Command::Controller(arguments) => delmpc::controller::controller(&arguments, allocations),
        Command::Check(arguments) => delmpc::check::check(&arguments),
        Command::Keys(arguments) => delmpc::keys::keys(&arguments),
        Command::PlantCheck(arguments) => delmpc::plant_check::plant_check(&arguments),
        Command::Wire(arguments) => delmpc::wire::wire(&arguments),
        Command::Init(arguments) => delmpc::init::init(&arguments),
        Command::Model(arguments) => delmpc::model::model(&arguments),
        Command::PushMap(arguments) => delmpc::push_map::push_map(&arguments),
        Command::Replay(arguments) => delmpc::replay::replay(&arguments),
        Command::Completions(arguments) => delmpc::completions::completions(&arguments),
        Command::Timing(arguments) => delmpc::timing::timing(&arguments),
        Command::TransportPeer(arguments) => delmpc::timing::transport::transport_peer(&arguments),
        Command::Plan(arguments) => delmpc::plan::plan(&arguments),
        Command::Report(arguments) => delmpc::report::report(&arguments),
    })
}

/// Help and version on standard output, what is wrong with the arguments on standard error.
fn say_usage(usage: &clap::Error) -> Result<Ended, Failure> {
    match usage.print() {
        // A reader that has gone away has seen enough.
        Err(error) if !usage.use_stderr() && error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Fault(format!("standard output cannot be written: {error}")))
        }
        _ if usage.use_stderr() => Ok(Ended::Misused),
        _ => Ok(Ended::Well),
    }
}

/// Heap allocations of this process so far.
fn allocations() -> u64 {
    let stats = ALLOCATOR.stats();
    (stats.allocations + stats.reallocations) as u64
}
