//! `delmpc push-map`: the largest push survived in every direction, by bisection in lockstep.
//!
//! Each trial is a whole run of the scenario in one thread: rest, one push, time to recover. A trial is survived when the robot does not
//! fall, keeps its other foot off the ground, keeps slip and tilt of the stance sole within the scenario's limits and comes to rest.
//!
//! Survival is not monotone near its end: one seed of the noise may take 45 N·s where another one does not take 42. So every impulse
//! is tried with several seeds, and the figure is the largest one below which all of them survive, as far as it has been looked at: all
//! survive the figure itself and 95, 90 and 80 % of it. Beside it stand the shares that survive at 90, 100 and 110 %.
//!
//! Beside each figure stands the capture limit of the linear inverted pendulum: an impulse `J` gives a point mass `m` at height `h` above
//! the sole the speed `J/m`; with ankles alone it can be stopped while the capture point `c + v √(h/g)` stays over the sole, so
//!
//! ```text
//! J_max = m √(g/h) · (distance from the mass centre to the edge of the sole in the direction of the push)
//! ```
//!
//! Arms, trunk and the free leg can do better: they change the angular momentum.
//!
//! Source: J. Pratt et al., *Capture point: a step toward humanoid push recovery*, IEEE-RAS Humanoids 2006.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use delmpc_controller_process::stop::StopFlag;
use delmpc_scenario::{Clock, PushSettings};
use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::Vector2;
use serde::Serialize;

use crate::log::Log;
use crate::one_process::{Simulated, simulate};
use crate::output::{line, print};
use crate::output_file;
use crate::run_folder::claim_or;
use crate::setup::{Setup, scenario_file};
use crate::summary::Summary;
use crate::support::Support;
use crate::verdict::{Ended, Failure};

mod plot;

use plot::polar_plot;

/// Rest before the push (s).
const REST_S: f64 = 0.5;
/// Largest impulse tried (N s).
const MOST_NS: f64 = 400.0;
/// Longest push and longest time after it (s), most directions and most seeds that can be meant.
const MOST_S: f64 = 600.0;
const MOST_DIRECTIONS: f64 = 3600.0;
const MOST_SEEDS: f64 = 1e6;
/// Parts of a limit that have to be survived too.
const BELOW: [f64; 3] = [0.8, 0.9, 0.95];
/// Parts of a limit at which shares are told.
const SHARES_AT: [f64; 3] = [0.9, 1.0, 1.1];

/// Arguments of `delmpc push-map`.
#[derive(Debug, Clone, clap::Args)]
pub struct PushMapArguments {
    /// Scenario file [default: configs/scenarios/atlas_one_foot.toml]; its reach and its own pushes are left out
    pub scenario: Option<PathBuf>,
    /// Override a key of the scenario, for example --set sensors.noise_scale=5
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Controllers to compare: mpc, static-lqr
    #[arg(long, value_name = "KIND", value_delimiter = ',', default_value = "mpc")]
    pub controller: Vec<String>,
    /// Links that are pushed, at their mass centres [default: that of the scenario's first push, else the heaviest]
    #[arg(long, value_name = "LINK", value_delimiter = ',')]
    pub link: Vec<String>,
    /// Directions, evenly spread, from straight ahead to the left
    #[arg(long, default_value_t = 8)]
    pub directions: usize,
    /// Length of a push, s
    #[arg(long, default_value_t = 0.1)]
    pub push_s: f64,
    /// Time after the push in which the robot has to come to rest, s
    #[arg(long, default_value_t = 3.5)]
    pub recovery_s: f64,
    /// The bisection ends at this width, N s
    #[arg(long, default_value_t = 1.0)]
    pub resolution_ns: f64,
    /// Seeds of the noise every impulse is tried with, from the scenario's on; all of them have to survive
    #[arg(long, default_value_t = 6)]
    pub seeds: u64,
    /// Runs at the same time [default: as many as there are cores]
    #[arg(long)]
    pub jobs: Option<usize>,
    /// Folder for push_map.json and push_map.svg [default: runs/push-map]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Print the result as JSON and nothing else
    #[arg(long)]
    pub json: bool,
}

/// A limit to be found.
#[derive(Debug, Clone)]
struct Search {
    controller: String,
    link: String,
    angle_rad: f64,
}

/// What was found for it.
#[derive(Debug, Clone, Default)]
struct Found {
    /// Largest impulse below which all seeds survive, N s.
    limit_ns: f64,
    /// Shares of the seeds that survive [`SHARES_AT`] of it.
    shares: [f64; 3],
    failure: Option<String>,
}

/// One line of the map.
#[derive(Debug, Clone, Serialize)]
pub struct Limit {
    /// Controller.
    pub controller: String,
    /// Link that was pushed.
    pub link: String,
    /// Direction of the push, from straight ahead to the left.
    pub angle_rad: f64,
    /// Seeds every impulse was tried with.
    pub seeds: u64,
    /// Largest impulse below which every seed survives.
    pub least_ns: f64,
    /// Share of the seeds that survive 90 % of it.
    pub share_at_90_percent: f64,
    /// Share that survive it: all, or nothing was survived.
    pub share_at_100_percent: f64,
    /// Share that survive 110 % of it.
    pub share_at_110_percent: f64,
    /// Limit of the linear inverted pendulum.
    pub capture_limit_ns: f64,
    /// `least_ns / capture_limit_ns`.
    pub ratio: f64,
    /// What ended the smallest push that was not survived.
    pub failure: Option<String>,
}

/// Runs the command.
///
/// # Errors
/// [`Failure::Input`] when the scenario cannot be run, [`Failure::Fault`] when results cannot be written.
pub fn push_map(arguments: &PushMapArguments) -> Result<Ended, Failure> {
    let setup = trial_setup(arguments)?;
    let searches = searches(arguments, &setup)?;
    let (folder, _lock) = claim_or(arguments.out.as_deref(), "runs/push-map")?;
    let stop = StopFlag::on_signals().map_err(Failure::fault)?;
    let found = search_all(arguments, &setup, &searches, &stop)?;
    if stop.is_set() {
        return Ok(Ended::Interrupted);
    }
    let limits = gather(&setup, arguments.seeds, &searches, found);
    let write = |name: &str, text: &str| {
        let file = folder.join(name);
        output_file::write(&file, text)
            .map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))
    };
    let json = serde_json::to_string_pretty(&limits).map_err(Failure::fault)?;
    write("push_map.json", &json)?;
    write("push_map.svg", &polar_plot(&limits))?;
    if arguments.json {
        line(&json)?;
    } else {
        print(&table(&limits))?;
        line(folder.display())?;
    }
    Ok(Ended::Well)
}

/// The scenario of every trial, but for push, controller and seed.
fn trial_setup(arguments: &PushMapArguments) -> Result<Setup, Failure> {
    let file = scenario_file(arguments.scenario.as_deref())?;
    let mut setup = Setup::read(&file, &arguments.set)?;
    crate::plan_source::provide(&mut setup, false)?;
    let scenario = &mut setup.scenario;
    scenario.clock = Clock::Lockstep;
    scenario.reach = None;
    scenario.duration_s = REST_S + arguments.push_s + arguments.recovery_s;
    scenario.success.settle_time_s = scenario.duration_s;
    // The edge of the sole may be used to the full.
    scenario.success.min_cop_margin_m = -1.0;
    for (name, value, least, most) in [
        ("--push-s", arguments.push_s, 1e-3, MOST_S),
        ("--recovery-s", arguments.recovery_s, 1e-3, MOST_S),
        ("--resolution-ns", arguments.resolution_ns, 1e-6, MOST_NS),
        ("--directions", arguments.directions as f64, 1.0, MOST_DIRECTIONS),
        ("--seeds", arguments.seeds as f64, 1.0, MOST_SEEDS),
    ] {
        if !(least..=most).contains(&value) {
            return Err(Failure::Input(format!("{name} {value}: must lie in {least} .. {most}")));
        }
    }
    Ok(setup)
}

fn searches(arguments: &PushMapArguments, setup: &Setup) -> Result<Vec<Search>, Failure> {
    let usual: Vec<String> = usual_link(setup).into_iter().collect();
    let links = if arguments.link.is_empty() { &usual } else { &arguments.link };
    for link in links {
        if setup.robot.link(link).and_then(|link| link.body).is_none() {
            return Err(Failure::Input(format!("--link {link}: the robot has no such moving link")));
        }
    }
    for controller in &arguments.controller {
        controller_kind(controller)?;
    }
    let mut searches = Vec::new();
    for controller in &arguments.controller {
        for link in links {
            for direction in 0..arguments.directions {
                let angle_rad = std::f64::consts::TAU * direction as f64 / arguments.directions as f64;
                searches.push(Search { controller: controller.clone(), link: link.clone(), angle_rad });
            }
        }
    }
    Ok(searches)
}

fn controller_kind(name: &str) -> Result<delmpc_scenario::ControllerKind, Failure> {
    use delmpc_scenario::ControllerKind::{Mpc, Off, StaticLqr};
    match name {
        "mpc" => Ok(Mpc),
        "static-lqr" => Ok(StaticLqr),
        "off" => Ok(Off),
        _ => Err(Failure::Input(format!("--controller {name}: must be mpc, static-lqr or off"))),
    }
}

fn search_all(
    arguments: &PushMapArguments,
    setup: &Setup,
    searches: &[Search],
    stop: &StopFlag,
) -> Result<Vec<Found>, Failure> {
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let jobs = arguments.jobs.unwrap_or(cores).clamp(1, searches.len());
    let bar = if arguments.json { ProgressBar::hidden() } else { ProgressBar::new(searches.len() as u64) };
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} directions, {eta} left  {msg}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let next = AtomicUsize::new(0);
    let found = Mutex::new(vec![Found::default(); searches.len()]);
    let broken = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                while let Some((index, search)) = take_next(&next, searches) {
                    let trials = |impulse_ns: f64, seed: u64| {
                        trial(
                            arguments,
                            setup,
                            search,
                            impulse_ns,
                            setup.scenario.seed.wrapping_add(seed),
                            stop,
                        )
                    };
                    let first_ns = capture_limit(setup, search.angle_rad);
                    match find(arguments, first_ns, &trials, stop) {
                        Ok(limit) => {
                            bar.set_message(format!("last: {:.0} N·s", limit.limit_ns));
                            lock(&found)[index] = limit;
                        }
                        Err(failure) => {
                            lock(&broken).get_or_insert(failure);
                            break;
                        }
                    }
                    bar.inc(1);
                    if stop.is_set() {
                        break;
                    }
                }
            });
        }
    });
    bar.finish_and_clear();
    match lock(&broken).take() {
        Some(failure) => Err(failure),
        None => Ok(lock(&found).clone()),
    }
}

fn take_next<'a>(next: &AtomicUsize, searches: &'a [Search]) -> Option<(usize, &'a Search)> {
    let index = next.fetch_add(1, Ordering::Relaxed);
    searches.get(index).map(|search| (index, search))
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Why a push of an impulse (N s) was not survived with a seed, counted from the scenario's; `None`: it was.
type Trials<'a> = dyn Fn(f64, u64) -> Result<Option<String>, Failure> + 'a;

/// The largest impulse below which all seeds survive, found from `first_ns` outwards, and the shares about it.
fn find(
    arguments: &PushMapArguments,
    first_ns: f64,
    trials: &Trials<'_>,
    stop: &StopFlag,
) -> Result<Found, Failure> {
    let why_not = |impulse_ns: f64| -> Result<Option<String>, Failure> {
        for seed in 0..arguments.seeds {
            let why = trials(impulse_ns, seed)?;
            if why.is_some() || stop.is_set() {
                return Ok(why);
            }
        }
        Ok(None)
    };
    let (mut survived, mut lost, mut failure) = (0.0, f64::INFINITY, None);
    let mut impulse_ns = first_ns;
    loop {
        while lost - survived > arguments.resolution_ns && survived < MOST_NS && !stop.is_set() {
            match why_not(impulse_ns)? {
                None => survived = impulse_ns,
                Some(why) => (lost, failure) = (impulse_ns, Some(why)),
            }
            impulse_ns = if lost.is_finite() { 0.5 * (survived + lost) } else { 1.25 * survived };
        }
        // One that is lost below what is survived: the limit is below that.
        let (limit_ns, mut below_ns) = (survived, 0.0);
        for part in BELOW.into_iter().filter(|_| limit_ns > 0.0) {
            if stop.is_set() {
                break;
            }
            if let Some(why) = why_not(part * limit_ns)? {
                (survived, lost, failure) = (below_ns, part * limit_ns, Some(why));
                impulse_ns = 0.5 * (survived + lost);
                break;
            }
            below_ns = part * limit_ns;
        }
        if survived == limit_ns || stop.is_set() {
            break;
        }
    }
    let mut shares = [1.0; 3];
    for (share, part) in shares.iter_mut().zip(SHARES_AT) {
        // All survive the limit and what is below.
        if part > 1.0 || survived == 0.0 {
            *share = share_of(arguments.seeds, part * survived, trials, stop)?;
        }
    }
    Ok(Found { limit_ns: survived, shares, failure })
}

/// Share of the seeds that survive an impulse.
fn share_of(seeds: u64, impulse_ns: f64, trials: &Trials<'_>, stop: &StopFlag) -> Result<f64, Failure> {
    let mut count = 0;
    for seed in (0..seeds).take_while(|_| !stop.is_set()) {
        count += u64::from(trials(impulse_ns, seed)?.is_none());
    }
    Ok(count as f64 / seeds as f64)
}

/// Why the push was not survived; `None`: it was.
fn trial(
    arguments: &PushMapArguments,
    setup: &Setup,
    search: &Search,
    impulse_ns: f64,
    seed: u64,
    stop: &StopFlag,
) -> Result<Option<String>, Failure> {
    let mut setup = setup.clone();
    let scenario = &mut setup.scenario;
    scenario.seed = seed;
    scenario.controller.kind = controller_kind(&search.controller)?;
    scenario.push = vec![PushSettings {
        link: search.link.clone(),
        direction: [search.angle_rad.cos(), search.angle_rad.sin(), 0.0],
        impulse_ns,
        start_s: REST_S,
        duration_s: arguments.push_s,
    }];
    match simulate(&setup, Log::none(), stop)? {
        Simulated::Fault(why) => Ok(Some(why)),
        Simulated::Ended { plant, .. } => {
            // A criterion of the scenario decides: fall, touch-down, slip, tilt, rest.
            let summary = Summary::new(&setup.scenario, Some(*plant), None, None);
            Ok(summary.failure)
        }
    }
}

/// Impulse (N s) after which the capture point is at the edge of the support.
fn capture_limit(setup: &Setup, angle_rad: f64) -> f64 {
    let (robot, settings) = (&setup.robot, &setup.scenario.robot);
    let support = Support::new(robot, &settings.posture, settings.stance.names());
    let direction = Vector2::new(angle_rad.cos(), angle_rad.sin());
    support.and_then(|support| support.capture_limit(robot, direction)).unwrap_or(10.0)
}

/// The link that is pushed when none is named: that of the scenario's first push, else the heaviest.
fn usual_link(setup: &Setup) -> Option<String> {
    let robot = &setup.robot;
    if let Some(push) = setup.scenario.push.iter().find(|push| !push.link.is_empty()) {
        return Some(push.link.clone());
    }
    let bodies = robot.tree.bodies().iter().zip(&robot.body_names);
    bodies.max_by(|a, b| a.0.inertia.mass.total_cmp(&b.0.inertia.mass)).map(|(_, name)| name.clone())
}

/// One line per controller, link and direction.
fn gather(setup: &Setup, seeds: u64, searches: &[Search], found: Vec<Found>) -> Vec<Limit> {
    let limits = searches.iter().zip(found).map(|(search, found)| {
        let capture_limit_ns = capture_limit(setup, search.angle_rad);
        let [share_at_90_percent, share_at_100_percent, share_at_110_percent] = found.shares;
        Limit {
            controller: search.controller.clone(),
            link: search.link.clone(),
            angle_rad: search.angle_rad,
            seeds,
            least_ns: found.limit_ns,
            share_at_90_percent,
            share_at_100_percent,
            share_at_110_percent,
            capture_limit_ns,
            ratio: found.limit_ns / capture_limit_ns,
            failure: found.failure,
        }
    });
    limits.collect()
}

fn table(limits: &[Limit]) -> String {
    let mut text = String::from(
        "controller   link      direction   all survive N·s   share at 90, 100, 110 %   capture limit   ratio   ended by\n",
    );
    for limit in limits {
        let _ = writeln!(
            text,
            "{:12} {:9} {:6.0}°     {:11.1}       {:4.2}  {:4.2}  {:4.2}          {:6.1}        {:5.2}   {}",
            limit.controller,
            limit.link,
            limit.angle_rad.to_degrees(),
            limit.least_ns,
            limit.share_at_90_percent,
            limit.share_at_100_percent,
            limit.share_at_110_percent,
            limit.capture_limit_ns,
            limit.ratio,
            limit.failure.as_deref().unwrap_or("-"),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn arguments(seeds: u64) -> PushMapArguments {
        use clap::Parser;
        #[derive(Parser)]
        struct Line {
            #[command(flatten)]
            arguments: PushMapArguments,
        }
        let mut arguments = Line::parse_from(["push-map"]).arguments;
        assert_eq!(arguments.seeds, 6, "the default");
        arguments.seeds = seeds;
        arguments
    }

    /// Seed 0 falls from 40 on and, as survival is not monotone, between 35 and 37 too; seed 1 from 50 on.
    #[test]
    fn the_limit_is_what_all_seeds_survive_and_nothing_below_it_is_lost() {
        let fell = |impulse_ns: f64, seed: u64| {
            let lost = match seed {
                0 => impulse_ns > 40.0 || (35.0..37.0).contains(&impulse_ns),
                _ => impulse_ns > 50.0,
            };
            Ok(lost.then(|| format!("seed {seed}")))
        };
        let stop = StopFlag::never();
        let both = find(&arguments(2), 30.0, &fell, &stop).unwrap();
        assert!((34.0..=35.0).contains(&both.limit_ns), "{both:?}");
        assert_eq!(both.failure.as_deref(), Some("seed 0"));
        assert_eq!(both.shares, [1.0, 1.0, 1.0], "38 N s are survived again: {both:?}");
        let second = |impulse_ns: f64, _: u64| fell(impulse_ns, 1);
        let alone = find(&arguments(1), 30.0, &second, &stop).unwrap();
        assert!((49.0..=50.0).contains(&alone.limit_ns) && alone.shares == [1.0, 1.0, 0.0], "{alone:?}");
        let none = find(&arguments(2), 30.0, &|_, _| Ok(Some("fell".to_owned())), &stop).unwrap();
        assert_eq!((none.limit_ns, none.shares), (0.0, [0.0; 3]));
    }

    #[test]
    fn the_map_has_limits_shares_and_reasons() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(crate::setup::MAIN_SCENARIO);
        let setup = Setup::read(&file, &[]).unwrap();
        let search =
            |angle_rad| Search { controller: "mpc".to_owned(), link: "utorso".to_owned(), angle_rad };
        let found = Found { limit_ns: 30.0, shares: [1.0, 1.0, 0.5], failure: Some("it fell".to_owned()) };
        let limits = gather(&setup, 6, &[search(0.0), search(1.0)], vec![found, Found::default()]);
        let json = serde_json::to_value(&limits).unwrap();
        assert_eq!((&json[0]["least_ns"], &json[0]["seeds"]), (&30.0.into(), &6.into()));
        assert_eq!(
            (&json[0]["share_at_90_percent"], &json[0]["share_at_110_percent"]),
            (&1.0.into(), &0.5.into())
        );
        assert!((limits[0].ratio - 30.0 / limits[0].capture_limit_ns).abs() < 1e-12);
        let table = table(&limits);
        assert!(table.contains("it fell") && table.contains("1.00  1.00  0.50"), "{table}");
        assert!(polar_plot(&limits).contains("polygon"));
    }

    /// Figures of the design: lateral 33.1, sagittal 67.1.
    #[test]
    fn the_capture_limit_of_atlas() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(crate::setup::MAIN_SCENARIO);
        let setup = Setup::read(&file, &[]).unwrap();
        let left = capture_limit(&setup, std::f64::consts::FRAC_PI_2);
        assert!((left - 33.1).abs() < 1.5, "{left}");
        let forward = capture_limit(&setup, 0.0);
        assert!((forward - 67.1).abs() < 3.0, "{forward}");
    }
}
