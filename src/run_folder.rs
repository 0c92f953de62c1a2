//! The folder a run leaves behind.
//!
//! | file | content |
//! |---|---|
//! | `scenario.toml` | effective configuration; runs again by itself: `delmpc run DIR/scenario.toml` |
//! | `robot.urdf`, `robot.toml` | the robot |
//! | `summary.json` | the figures of the run |
//! | `log.mcap` | what was measured, commanded and true |
//! | `messages.txt` | what the processes said |
//! | `report.html`, `plots/` | the run to look at, and its key plots as PNG |

use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use delmpc_scenario::Scenario;

use crate::setup::Setup;
use crate::verdict::Failure;

/// Files of an earlier run that would be taken for results of this one.
const RESULTS: [&str; 6] =
    ["summary.json", "log.mcap", "messages.txt", REPORT_FILE, PLANT_PART, CONTROLLER_PART];
/// The robot.
pub const ROBOT_FILE: &str = "robot.urdf";
/// The run to look at.
pub const REPORT_FILE: &str = "report.html";
/// Folder of the report's key plots as pictures.
pub const PLOTS_FOLDER: &str = "plots";
/// What the plant process found out; part of the summary.
pub const PLANT_PART: &str = "plant.json";
/// What the controller process found out; part of the summary.
pub const CONTROLLER_PART: &str = "controller.json";
/// Times of every cycle, left by the controller process for the timing report.
pub const CYCLE_RECORDS: &str = "cycles.records";
/// What entered every cycle, left by the controller process for the timing report.
pub const CYCLE_INPUTS: &str = "inputs.records";
/// Readings of the controller's clock, left by the controller process for the timing report.
pub const CLOCK_READINGS: &str = "readings.records";
/// Times of every step, left by the plant process for the timing report.
pub const STEP_RECORDS: &str = "steps.records";

/// A run's folder.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// Makes the folder: the named one, or a new one under `runs/`, to which `runs/latest` then points.
    ///
    /// # Errors
    /// [`Failure::Input`] when it cannot be made.
    #[allow(clippy::disallowed_methods, reason = "a name for people, by their clock")]
    pub fn create(named: Option<&Path>, scenario: &str) -> Result<Self, Failure> {
        match named {
            Some(path) => {
                let cannot = |error| Failure::Input(format!("--out {}: {error}", path.display()));
                fs::create_dir_all(path).map_err(cannot)?;
                for file in RESULTS {
                    match fs::remove_file(path.join(file)) {
                        Err(error) if error.kind() != ErrorKind::NotFound => return Err(cannot(error)),
                        _ => {}
                    }
                }
                Ok(Self { path: path.to_owned() })
            }
            None => {
                Self::create_new(Path::new("runs"), &format!("{scenario}-{}", time_stamp(SystemTime::now())))
            }
        }
    }

    fn create_new(runs: &Path, name: &str) -> Result<Self, Failure> {
        let cannot =
            |error| Failure::Input(format!("{}: {error}; name another folder with --out", runs.display()));
        fs::create_dir_all(runs).map_err(cannot)?;
        let mut folder = name.to_owned();
        for attempt in 2.. {
            match fs::create_dir(runs.join(&folder)) {
                Ok(()) => break,
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                    folder = format!("{name}-{attempt}")
                }
                Err(error) => return Err(cannot(error)),
            }
        }
        // Made aside and moved, so that the link always points to a run. That it cannot be made is no reason not to run.
        let aside = runs.join(format!(".latest-{folder}"));
        if symlink(&folder, &aside).is_ok() && fs::rename(&aside, runs.join("latest")).is_err() {
            let _ = fs::remove_file(&aside);
        }
        Ok(Self { path: runs.join(folder) })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path of a file in it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Writes configuration and robot into it.
    ///
    /// # Errors
    /// [`Failure::Input`] when they cannot be written.
    pub fn write_inputs(&self, setup: &Setup) -> Result<(), Failure> {
        let cannot = |error| Failure::Input(format!("{}: {error}", self.path.display()));
        let mut scenario: Scenario = setup.scenario.clone();
        scenario.robot.urdf = ROBOT_FILE.to_owned();
        fs::write(self.file("scenario.toml"), scenario.to_toml()).map_err(cannot)?;
        copy(&setup.urdf, &self.file(ROBOT_FILE)).map_err(cannot)?;
        let companion = setup.urdf.with_extension("toml");
        if companion.is_file() {
            copy(&companion, &self.file("robot.toml")).map_err(cannot)?;
        }
        Ok(())
    }
}

/// Copies content, not permissions; a file onto itself stays.
fn copy(from: &Path, to: &Path) -> std::io::Result<()> {
    let content = fs::read(from)?;
    fs::write(to, content)
}

/// `20260131T094501Z`.
fn time_stamp(time: SystemTime) -> String {
    let seconds = time.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    let (year, month, day) = civil_from_days(days);
    format!("{year:04}{month:02}{day:02}T{:02}{:02}{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

/// Year, month and day of a number of days since 1970-01-01.
///
/// Source: H. Hinnant, "chrono-compatible low-level date algorithms", `civil_from_days`.
fn civil_from_days(days: u64) -> (u64, u64, u64) {
    let shifted = days + 719_468;
    let (era, day_of_era) = (shifted / 146_097, shifted % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    (era * 400 + year_of_era + u64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn time_stamps_are_dates() {
        for (seconds, expected) in [
            (0, "19700101T000000Z"),
            (951_827_696, "20000229T123456Z"),
            (1_709_251_199, "20240229T235959Z"),
            (1_709_251_200, "20240301T000000Z"),
            (4_107_542_399, "21000228T235959Z"),
        ] {
            assert_eq!(time_stamp(UNIX_EPOCH + Duration::from_secs(seconds)), expected);
        }
    }

    #[test]
    fn two_runs_of_the_same_second_have_two_folders_and_latest_is_the_last() {
        let runs = std::env::temp_dir().join(format!("delmpc-run-folder-{}", std::process::id()));
        let first = RunFolder::create_new(&runs, "a-1").unwrap();
        let second = RunFolder::create_new(&runs, "a-1").unwrap();
        assert_eq!((first.path(), second.path()), (runs.join("a-1").as_path(), runs.join("a-1-2").as_path()));
        assert_eq!(fs::read_link(runs.join("latest")).unwrap(), Path::new("a-1-2"));
        fs::remove_dir_all(&runs).unwrap();
    }
}
