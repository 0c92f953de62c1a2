//! `delmpc completions`: what a shell needs to complete the words of this command.

use clap::CommandFactory;
use clap_complete::{Shell, generate};

use crate::cli::Cli;
use crate::output::print;
use crate::verdict::{Ended, Failure};

/// Arguments of `delmpc completions`.
#[derive(Debug, clap::Args)]
pub struct CompletionsArguments {
    /// The shell
    pub shell: Shell,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Fault`] when it cannot be written.
pub fn completions(arguments: &CompletionsArguments) -> Result<Ended, Failure> {
    let mut script = Vec::new();
    generate(arguments.shell, &mut Cli::command(), "delmpc", &mut script);
    print(&String::from_utf8_lossy(&script))?;
    Ok(Ended::Well)
}
