//! The folder a run leaves behind.
//!
//! | file | content |
//! |---|---|
//! | `scenario.toml` | effective configuration; runs again by itself: `delmpc run DIR/scenario.toml` |
//! | `robot.urdf`, `robot.toml` | the robot |
//! | `plan.json` | the plan that was followed, if there was one |
//! | `summary.json` | the figures of the run |
//! | `log.mcap` | what was measured, commanded and true |
//! | `messages.txt` | what the processes said |
//! | `report.html`, `plots/` | the run to look at, and its key plots as PNG |
//! | `.delmpc` | says that the folder is one of a run; locked while somebody writes into it |
//!
//! A folder that is named has to be new, empty, or that of an earlier run: nothing else is overwritten. While a run writes into a folder, a
//! second one is refused. Plant and controller started by themselves share one: the first prepares it, the last one puts the results
//! together.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::ErrorKind;
use std::os::unix::fs::{OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use delmpc_messages::Role;
use delmpc_scenario::Scenario;
use rustix::fs::OFlags;

use crate::input_file::{self, open_plain};
use crate::output_file;
use crate::setup::Setup;
use crate::verdict::Failure;

/// Files of an earlier run that would be taken for results of this one.
const RESULTS: [&str; 6] =
    ["summary.json", "log.mcap", "messages.txt", REPORT_FILE, PLANT_PART, CONTROLLER_PART];
/// Says that a folder is ours, and is locked by who writes into it.
const MARKER: &str = ".delmpc";
/// How often and how long to wait for somebody who just prepares a folder.
const LOCK_ATTEMPTS: u32 = 100;
const LOCK_PAUSE: Duration = Duration::from_millis(20);
/// Files named when a folder is refused.
const MOST_NAMED: usize = 3;
/// Most bytes of a scenario, of a summary and of its parts.
pub const MOST_TEXT: u64 = 1 << 20;
/// The robot.
pub const ROBOT_FILE: &str = "robot.urdf";
/// The plan that was followed.
pub const PLAN_FILE: &str = "plan.json";
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

/// A run's folder, locked for us until the last copy is dropped.
#[derive(Debug, Clone)]
pub struct RunFolder {
    path: PathBuf,
    /// Held for their locks: the folder's, and for a lone process that of its role.
    locks: Arc<[File]>,
}

/// Claims a folder for results: makes it, and refuses one that holds other things than those of an earlier command of ours, or into which
/// another one is writing.
///
/// # Errors
/// [`Failure::Input`] when it cannot be had.
pub fn claim(path: &Path) -> Result<File, Failure> {
    lock(path, marked(path)?)
}

/// Claims a folder for results that was named, or else a usual one under `runs/`, which is ours whatever is in it.
///
/// # Errors
/// [`Failure::Input`] when it cannot be had.
pub fn claim_or(named: Option<&Path>, usual: &str) -> Result<(PathBuf, File), Failure> {
    let path = named.unwrap_or(Path::new(usual)).to_owned();
    if named.is_none() {
        fs::create_dir_all(&path).map_err(|error| unusable(&path, &error))?;
        open_lock(&path.join(MARKER)).map_err(|error| unusable(&path, &error))?;
    }
    let lock = claim(&path)?;
    Ok((path, lock))
}

fn lock(path: &Path, marker: File) -> Result<File, Failure> {
    match marker.try_lock() {
        Ok(()) => Ok(marker),
        Err(TryLockError::WouldBlock) => Err(busy(path)),
        Err(TryLockError::Error(error)) => Err(unusable(path, &error)),
    }
}

/// Makes a folder with a marker, unless it holds what is not ours.
fn marked(path: &Path) -> Result<File, Failure> {
    fs::create_dir_all(path).map_err(|error| unusable(path, &error))?;
    let marker = path.join(MARKER);
    if !marker.is_file() && !is_of_earlier_run(path) {
        let entries = fs::read_dir(path).map_err(|error| unusable(path, &error))?;
        let names = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned());
        let mut names: Vec<String> = names.filter(|name| name != MARKER).take(MOST_NAMED).collect();
        names.sort();
        if !names.is_empty() {
            let names = names.join(", ");
            return Err(Failure::Input(format!(
                "--out {}: it holds files that are not of a run ({names}): name a new or an empty folder",
                path.display()
            )));
        }
    }
    open_lock(&marker).map_err(|error| unusable(path, &error))
}

/// Opens a file that serves as a lock; makes it. No link is followed, no pipe waited for.
fn open_lock(path: &Path) -> std::io::Result<File> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
    OpenOptions::new().read(true).write(true).create(true).truncate(false).custom_flags(flags).open(path)
}

/// Runs of versions that left no marker left a log beside a scenario.
fn is_of_earlier_run(path: &Path) -> bool {
    let magic = open_plain(&path.join("log.mcap")).and_then(|mut log| {
        let mut magic = [0; mcap::MAGIC.len()];
        std::io::Read::read_exact(&mut log, &mut magic).map(|()| magic)
    });
    magic.is_ok_and(|magic| magic == *mcap::MAGIC) && path.join("messages.txt").is_file()
}

fn busy(path: &Path) -> Failure {
    Failure::Input(format!("--out {}: another run is writing into it: name another folder", path.display()))
}

fn unusable(path: &Path, error: &std::io::Error) -> Failure {
    Failure::Input(format!("--out {}: {error}", path.display()))
}

impl RunFolder {
    /// Makes the folder: the named one, or a new one under `runs/`, to which `runs/latest` then points.
    ///
    /// # Errors
    /// [`Failure::Input`] when it cannot be made, holds files that are not of a run, or is being written to.
    #[allow(clippy::disallowed_methods, reason = "a name for people, by their clock")]
    pub fn create(named: Option<&Path>, scenario: &str) -> Result<Self, Failure> {
        match named {
            Some(path) => {
                let lock = claim(path)?;
                remove_results(path)?;
                Ok(Self { path: path.to_owned(), locks: Arc::new([lock]) })
            }
            None => {
                Self::create_new(Path::new("runs"), &format!("{scenario}-{}", time_stamp(SystemTime::now())))
            }
        }
    }

    /// Enters a folder that plant and controller share, each started by itself. The first one removes what an earlier run has left and
    /// writes configuration and robot; the other one has to be of the same.
    ///
    /// # Errors
    /// [`Failure::Input`] as for [`Self::create`], and when this role is taken or the folder is of another scenario.
    pub fn join(path: &Path, role: Role, setup: &Setup) -> Result<Self, Failure> {
        let marker = marked(path)?;
        let own = path.join(format!("{MARKER}-{}", role.name()));
        let own = open_lock(&own).map_err(|error| unusable(path, &error))?;
        if own.try_lock().is_err() {
            let role = role.name();
            return Err(Failure::Input(format!(
                "--out {}: another {role} is writing into it",
                path.display()
            )));
        }
        let first = marker.try_lock().is_ok();
        let folder = Self { path: path.to_owned(), locks: Arc::new([marker, own]) };
        if first {
            remove_results(path)?;
            folder.write_inputs(setup)?;
        }
        let mut attempts = 0;
        while let Err(error) = folder.locks[0].try_lock_shared() {
            attempts += 1;
            if attempts > LOCK_ATTEMPTS {
                return Err(match error {
                    TryLockError::WouldBlock => busy(path),
                    TryLockError::Error(error) => unusable(path, &error),
                });
            }
            sleep(LOCK_PAUSE);
        }
        let written = input_file::read_text(&folder.file("scenario.toml"), MOST_TEXT).unwrap_or_default();
        if written != effective(setup).to_toml() {
            return Err(Failure::Input(format!(
                "--out {}: a process of another scenario is writing into it: give both the same, --set included",
                path.display()
            )));
        }
        Ok(folder)
    }

    /// Leaves a folder that is shared; says whether we are the last one, and have it alone now.
    pub fn is_left_by_the_last(&self) -> bool {
        let marker = &self.locks[0];
        // First given up, then asked for: of two that end together, one gets it.
        marker.unlock().is_ok() && marker.try_lock().is_ok()
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
        let path = runs.join(&folder);
        let lock = claim(&path)?;
        // Made aside and moved, so that the link always points to a run. That it cannot be made is no reason not to run;
        // what is no link there is the user's.
        let aside = runs.join(format!(".latest-{folder}"));
        let latest = runs.join("latest");
        let is_a_link = fs::symlink_metadata(&latest).map_or(true, |there| there.is_symlink());
        if is_a_link && symlink(&folder, &aside).is_ok() && fs::rename(&aside, &latest).is_err() {
            let _ = fs::remove_file(&aside);
        }
        Ok(Self { path, locks: Arc::new([lock]) })
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
        output_file::write(&self.file("scenario.toml"), effective(setup).to_toml()).map_err(cannot)?;
        copy(&setup.urdf, &self.file(ROBOT_FILE)).map_err(cannot)?;
        let companion = setup.urdf.with_extension("toml");
        if companion.is_file() {
            copy(&companion, &self.file("robot.toml")).map_err(cannot)?;
        }
        if let Some(plan) = &setup.plan {
            fs::write(self.file(PLAN_FILE), plan.to_json().map_err(Failure::fault)?).map_err(cannot)?;
        }
        Ok(())
    }
}

/// The scenario as it is in the run's folder.
pub fn effective(setup: &Setup) -> Scenario {
    let mut scenario = setup.scenario.clone();
    scenario.robot.urdf = ROBOT_FILE.to_owned();
    if let Some(plan) = scenario.plan.as_mut().filter(|_| setup.plan.is_some()) {
        plan.file = PLAN_FILE.to_owned();
    }
    scenario
}

/// Removes what would be taken for results of the run that begins.
fn remove_results(path: &Path) -> Result<(), Failure> {
    for file in RESULTS {
        match fs::remove_file(path.join(file)) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(unusable(path, &error)),
            _ => {}
        }
    }
    Ok(())
}

/// Copies content, not permissions; a file onto itself stays.
fn copy(from: &Path, to: &Path) -> std::io::Result<()> {
    let content = fs::read(from)?;
    output_file::write(to, content)
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

    #[test]
    fn a_folder_of_the_user_s_is_refused_one_in_use_too_and_that_of_an_earlier_run_serves_again() {
        let scratch = std::env::temp_dir().join(format!("delmpc-run-claim-{}", std::process::id()));
        fs::create_dir_all(&scratch).unwrap();
        fs::write(scratch.join("scenario.toml"), "mine").unwrap();
        let refused = RunFolder::create(Some(&scratch), "a").unwrap_err().to_string();
        assert!(refused.contains("scenario.toml") && refused.contains("not of a run"), "{refused}");
        assert_eq!(fs::read_to_string(scratch.join("scenario.toml")).unwrap(), "mine");
        assert_eq!(fs::read_dir(&scratch).unwrap().count(), 1);

        let folder = scratch.join("run");
        let first = RunFolder::create(Some(&folder), "a").unwrap();
        fs::write(first.file("summary.json"), "{}").unwrap();
        let refused = RunFolder::create(Some(&folder), "a").unwrap_err().to_string();
        assert!(refused.contains("another run is writing"), "{refused}");
        assert!(first.file("summary.json").exists());
        drop(first);
        let second = RunFolder::create(Some(&folder), "a").unwrap();
        assert!(!second.file("summary.json").exists());
        fs::remove_dir_all(&scratch).unwrap();
    }
}
