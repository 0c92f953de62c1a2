//! Tells the program the revision it is built from.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let revision = git(&["rev-parse", "--short=12", "HEAD"]).unwrap_or_else(|| "unknown".to_owned());
    println!("cargo::rustc-env=DELMPC_GIT_REVISION={revision}");
    // Grows with every commit and checkout.
    if let Some(file) = git(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|file| Path::new(file).exists())
    {
        println!("cargo::rerun-if-changed={file}");
    }
}

/// What git answers; nothing without git or outside a repository.
fn git(arguments: &[&str]) -> Option<String> {
    let output =
        Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    Some(String::from_utf8(output.stdout).ok()?.trim().to_owned())
}
