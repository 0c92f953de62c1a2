//! `report.html`: a run to look at, in one file that needs nothing else; and the key plots as PNG beside it.
//!
//! | file | what it does |
//! |---|---|
//! | [`recording`] | reads the log of a run into columns at the rate of an animation |
//! | [`scene`] | what of the robot is drawn: its tree and its primitive shapes |
//! | [`criteria`] | the success criteria of the scenario, each with what was reached |
//! | [`page`] | puts data, style and script into the page |
//! | [`canvas`], [`pictures`] | the key plots as PNG |
//! | `template/` | the page itself: HTML, CSS, JavaScript without any library |
//!
//! Everything is made from the files of the run's folder, so `delmpc report RUN` can make it again at any time.

use std::path::{Path, PathBuf};

use crate::output::{line, say};
use crate::run_folder::{MOST_TEXT, PLOTS_FOLDER, REPORT_FILE};
use crate::setup::Setup;
use crate::verdict::{Ended, Failure};
use crate::{input_file, output_file};

pub mod canvas;
pub mod colours;
pub mod criteria;
pub mod page;
pub mod pictures;
pub mod recording;
pub mod scene;

/// Arguments of `delmpc report`.
#[derive(Debug, clap::Args)]
pub struct ReportArguments {
    /// Folder of the run
    #[arg(default_value = "runs/latest")]
    pub run: PathBuf,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] for a folder that holds no run.
pub fn report(arguments: &ReportArguments) -> Result<Ended, Failure> {
    line(write(&arguments.run)?.display())?;
    Ok(Ended::Well)
}

/// Writes page and pictures into the folder of a run; returns the path of the page.
///
/// # Errors
/// [`Failure::Input`] when the folder holds no run, [`Failure::Fault`] when the files cannot be written.
pub fn write(folder: &Path) -> Result<PathBuf, Failure> {
    let setup = Setup::read(&folder.join("scenario.toml"), &[])?;
    let log = folder.join("log.mcap");
    let recording = recording::Recording::read(&setup, &log)?;
    if let Some(damage) = &recording.damage {
        say(&format!("warning: {}: {damage}", log.display()));
    }
    // A run that broke off early may have no summary; what happened until then can still be looked at.
    let summary = input_file::read_text(&folder.join("summary.json"), MOST_TEXT).ok();
    let summary = summary.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default();
    let cannot =
        |file: &Path, error: &dyn std::fmt::Display| Failure::Fault(format!("{}: {error}", file.display()));

    let file = folder.join(REPORT_FILE);
    let page = page::page(&setup, &recording, &summary)?;
    output_file::write(&file, page).map_err(|error| cannot(&file, &error))?;

    let plots = folder.join(PLOTS_FOLDER);
    output_file::folder(&plots).map_err(|error| cannot(&plots, &error))?;
    for (name, picture) in pictures::all(&setup, &recording).map_err(Failure::fault)? {
        let file = plots.join(name);
        output_file::write(&file, picture.to_png()).map_err(|error| cannot(&file, &error))?;
    }
    Ok(file)
}
