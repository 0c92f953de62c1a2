//! `delmpc push-map`: the largest push survived in every direction, by bisection in lockstep.
//!
//! Each trial is a whole run of the scenario in one thread: rest, one push, time to recover. A trial is survived when the robot does not
//! fall, keeps its other foot off the ground, keeps slip and tilt of the stance sole within the scenario's limits and comes to rest.
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
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_scenario::{Clock, PushSettings};
use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::Vector2;
use serde::Serialize;

use crate::log::Log;
use crate::one_process::{Simulated, simulate};
use crate::output::{line, print};
use crate::run_folder::claim_or;
use crate::setup::{Setup, scenario_file};
use crate::summary::Summary;
use crate::verdict::{Ended, Failure};

/// Rest before the push (s).
const REST_S: f64 = 0.5;
/// Largest impulse tried (N s).
const MOST_NS: f64 = 400.0;

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
    /// Links that are pushed, at their mass centres
    #[arg(long, value_name = "LINK", value_delimiter = ',', default_value = "utorso")]
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
    /// Seeds per direction; the table has the least, the mean and the largest of their limits
    #[arg(long, default_value_t = 1)]
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
    seed: u64,
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
    /// Largest impulse survived by every seed.
    pub least_ns: f64,
    /// Mean over the seeds.
    pub mean_ns: f64,
    /// Largest over the seeds.
    pub most_ns: f64,
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
    let limits = gather(&setup, &searches, &found);
    let write = |name: &str, text: &str| {
        let file = folder.join(name);
        std::fs::write(&file, text).map_err(|error| Failure::Fault(format!("{}: {error}", file.display())))
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
    let scenario = &mut setup.scenario;
    scenario.clock = Clock::Lockstep;
    scenario.reach = None;
    scenario.duration_s = REST_S + arguments.push_s + arguments.recovery_s;
    scenario.success.settle_time_s = scenario.duration_s;
    // The edge of the sole may be used to the full.
    scenario.success.min_cop_margin_m = -1.0;
    if !(arguments.push_s > 0.0 && arguments.recovery_s > 0.0 && arguments.resolution_ns > 0.0) {
        return Err(Failure::Input("--push-s, --recovery-s, --resolution-ns: must be positive".to_owned()));
    }
    if arguments.directions == 0 || arguments.seeds == 0 {
        return Err(Failure::Input("--directions, --seeds: at least 1".to_owned()));
    }
    Ok(setup)
}

fn searches(arguments: &PushMapArguments, setup: &Setup) -> Result<Vec<Search>, Failure> {
    for link in &arguments.link {
        if setup.robot.link(link).and_then(|link| link.body).is_none() {
            return Err(Failure::Input(format!("--link {link}: the robot has no such moving link")));
        }
    }
    for controller in &arguments.controller {
        controller_kind(controller)?;
    }
    let mut searches = Vec::new();
    for controller in &arguments.controller {
        for link in &arguments.link {
            for direction in 0..arguments.directions {
                let angle_rad = std::f64::consts::TAU * direction as f64 / arguments.directions as f64;
                searches.extend((0..arguments.seeds).map(|seed| Search {
                    controller: controller.clone(),
                    link: link.clone(),
                    angle_rad,
                    seed: setup.scenario.seed + seed,
                }));
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

/// Limits in the order of the searches, each with what ended the smallest push not survived.
type Found = Vec<(f64, Option<String>)>;

fn search_all(
    arguments: &PushMapArguments,
    setup: &Setup,
    searches: &[Search],
    stop: &StopFlag,
) -> Result<Found, Failure> {
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let jobs = arguments.jobs.unwrap_or(cores).clamp(1, searches.len());
    let bar = if arguments.json { ProgressBar::hidden() } else { ProgressBar::new(searches.len() as u64) };
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} directions, {eta} left  {msg}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let next = AtomicUsize::new(0);
    let found = Mutex::new(vec![(f64::NAN, None); searches.len()]);
    let broken = Mutex::new(None);
    std::thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                while let Some((index, search)) = take_next(&next, searches) {
                    match bisect(arguments, setup, search, stop) {
                        Ok(limit) => {
                            bar.set_message(format!("last: {:.0} N·s", limit.0));
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

/// Largest impulse survived (N s), found from the capture limit outwards.
fn bisect(
    arguments: &PushMapArguments,
    setup: &Setup,
    search: &Search,
    stop: &StopFlag,
) -> Result<(f64, Option<String>), Failure> {
    let (mut survived, mut lost) = (0.0, f64::INFINITY);
    let mut failure = None;
    let mut impulse_ns = capture_limit(setup, search.angle_rad);
    while lost - survived > arguments.resolution_ns && survived < MOST_NS && !stop.is_set() {
        match trial(arguments, setup, search, impulse_ns, stop)? {
            None => survived = impulse_ns,
            Some(why) => (lost, failure) = (impulse_ns, Some(why)),
        }
        impulse_ns = if lost.is_finite() { 0.5 * (survived + lost) } else { 1.25 * survived };
    }
    Ok((survived, failure))
}

/// Why the push was not survived; `None`: it was.
fn trial(
    arguments: &PushMapArguments,
    setup: &Setup,
    search: &Search,
    impulse_ns: f64,
    stop: &StopFlag,
) -> Result<Option<String>, Failure> {
    let mut setup = setup.clone();
    let scenario = &mut setup.scenario;
    scenario.seed = search.seed;
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

/// Impulse (N s) after which the capture point is at the edge of the stance sole.
fn capture_limit(setup: &Setup, angle_rad: f64) -> f64 {
    let limit = || {
        let robot = &setup.robot;
        let posture = robot.posture(&setup.scenario.robot.posture)?;
        let sole = robot.sole(setup.scenario.robot.stance.first())?;
        let rooted = robot.rooted_at(&sole.frame).ok()?;
        let tree = &rooted.model.tree;
        let mut kinematics = Kinematics::new(tree);
        let q = &rooted.model.posture(&posture.name)?.q;
        kinematics.update_positions(tree, &Configuration::fixed(q)).ok()?;
        let com = kinematics.mass_centre_of_tree_w(tree);
        let direction = Vector2::new(angle_rad.cos(), angle_rad.sin());
        let distance = edge_distance(&sole.polygon, com.xy(), direction)?;
        let frequency = (tree.gravity_w().norm() / com.z).sqrt();
        Some(tree.total_mass() * frequency * distance)
    };
    limit().filter(|limit| limit.is_finite() && *limit > 0.0).unwrap_or(10.0)
}

/// Distance from a point inside a convex polygon to its edge in a direction.
fn edge_distance(polygon: &[Vector2<f64>], from: Vector2<f64>, direction: Vector2<f64>) -> Option<f64> {
    let corners = polygon.iter().zip(polygon.iter().cycle().skip(1));
    let distances = corners.filter_map(|(a, b)| {
        let outward = Vector2::new(b.y - a.y, a.x - b.x);
        let speed = outward.dot(&direction);
        (speed > 1e-12).then(|| outward.dot(&(a - from)) / speed)
    });
    distances.min_by(f64::total_cmp)
}

/// One line per controller, link and direction.
fn gather(setup: &Setup, searches: &[Search], found: &Found) -> Vec<Limit> {
    let mut limits: Vec<Limit> = Vec::new();
    let mut counts: Vec<f64> = Vec::new();
    for (search, (impulse_ns, failure)) in searches.iter().zip(found) {
        let same = |limit: &Limit| {
            limit.controller == search.controller
                && limit.link == search.link
                && limit.angle_rad == search.angle_rad
        };
        if !limits.last().is_some_and(same) {
            limits.push(Limit {
                controller: search.controller.clone(),
                link: search.link.clone(),
                angle_rad: search.angle_rad,
                least_ns: f64::INFINITY,
                mean_ns: 0.0,
                most_ns: 0.0,
                capture_limit_ns: capture_limit(setup, search.angle_rad),
                ratio: 0.0,
                failure: None,
            });
            counts.push(0.0);
        }
        if let (Some(limit), Some(count)) = (limits.last_mut(), counts.last_mut()) {
            if *impulse_ns < limit.least_ns {
                limit.least_ns = *impulse_ns;
                limit.failure.clone_from(failure);
            }
            limit.most_ns = limit.most_ns.max(*impulse_ns);
            limit.mean_ns = (limit.mean_ns * *count + impulse_ns) / (*count + 1.0);
            *count += 1.0;
            limit.ratio = limit.least_ns / limit.capture_limit_ns;
        }
    }
    limits
}

fn table(limits: &[Limit]) -> String {
    let mut text = String::from(
        "controller   link      direction   survived N·s (mean, most)   capture limit   ratio   ended by\n",
    );
    for limit in limits {
        let _ = writeln!(
            text,
            "{:12} {:9} {:6.0}°     {:6.1} ({:5.1}, {:5.1})        {:6.1}        {:5.2}   {}",
            limit.controller,
            limit.link,
            limit.angle_rad.to_degrees(),
            limit.least_ns,
            limit.mean_ns,
            limit.most_ns,
            limit.capture_limit_ns,
            limit.ratio,
            limit.failure.as_deref().unwrap_or("-"),
        );
    }
    text
}

/// Survived impulse over direction, straight ahead is up, with the capture limit.
fn polar_plot(limits: &[Limit]) -> String {
    const SIZE: f64 = 560.0;
    const COLOURS: [&str; 4] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7"];
    let most = limits.iter().map(|limit| limit.least_ns.max(limit.capture_limit_ns)).fold(1.0, f64::max);
    let ring = [5.0, 10.0, 20.0, 50.0, 100.0].into_iter().find(|ring| most / ring <= 5.0).unwrap_or(200.0);
    let rings = (most / ring).ceil();
    let scale = 0.40 * SIZE / (rings * ring);
    let centre = 0.5 * SIZE;
    let at = |angle: f64, radius: f64| {
        (centre - scale * radius * angle.sin(), centre - scale * radius * angle.cos())
    };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {SIZE} {SIZE}\" font-family=\"sans-serif\" \
         font-size=\"12\" fill=\"#333\">\n<rect width=\"{SIZE}\" height=\"{SIZE}\" fill=\"#fff\"/>\n\
         <text x=\"16\" y=\"24\" font-size=\"15\">Largest push survived, N·s</text>\n"
    );
    for k in 1..=rings as usize {
        let radius = k as f64 * ring;
        let _ = writeln!(
            svg,
            "<circle cx=\"{centre}\" cy=\"{centre}\" r=\"{:.1}\" fill=\"none\" stroke=\"#ddd\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#777\">{radius}</text>",
            scale * radius,
            centre + 3.0,
            centre - scale * radius - 3.0
        );
    }
    for (angle, name) in [(0.0, "forward"), (90.0, "left"), (180.0, "back"), (270.0, "right")] {
        let (x, y) = at(f64::to_radians(angle), rings * ring * 1.12);
        let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\">{name}</text>");
    }
    let curve = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let text: Vec<String> = points
            .map(|(angle, radius)| {
                let (x, y) = at(angle, radius);
                format!("{x:.1},{y:.1}")
            })
            .collect();
        text.join(" ")
    };
    let mut drawn: Vec<(&str, &str)> = Vec::new();
    for limit in limits {
        if drawn.contains(&(&limit.controller, &limit.link)) {
            continue;
        }
        let colour = COLOURS[drawn.len() % COLOURS.len()];
        let same = || limits.iter().filter(|l| l.controller == limit.controller && l.link == limit.link);
        if drawn.is_empty() {
            let points = curve(&mut same().map(|l| (l.angle_rad, l.capture_limit_ns)));
            let _ = writeln!(
                svg,
                "<polygon points=\"{points}\" fill=\"none\" stroke=\"#777\" stroke-dasharray=\"5 4\"/>\
                 <text x=\"16\" y=\"44\" fill=\"#777\">- - capture limit</text>"
            );
        }
        let points = curve(&mut same().map(|l| (l.angle_rad, l.least_ns)));
        let _ = writeln!(
            svg,
            "<polygon points=\"{points}\" fill=\"{colour}\" fill-opacity=\"0.12\" stroke=\"{colour}\" \
             stroke-width=\"2\"/><text x=\"16\" y=\"{}\" fill=\"{colour}\">{} at {}</text>",
            64 + 20 * drawn.len(),
            limit.controller,
            limit.link
        );
        drawn.push((&limit.controller, &limit.link));
    }
    svg.push_str("</svg>\n");
    svg
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn the_distance_to_the_edge_is_along_the_direction() {
        let sole: Vec<Vector2<f64>> = [(0.1, -0.05), (0.1, 0.05), (-0.1, 0.05), (-0.1, -0.05)]
            .map(|(x, y)| Vector2::new(x, y))
            .to_vec();
        let from = Vector2::new(0.02, 0.01);
        let distance = |x: f64, y: f64| edge_distance(&sole, from, Vector2::new(x, y)).unwrap();
        assert!((distance(1.0, 0.0) - 0.08).abs() < 1e-12);
        assert!((distance(0.0, -1.0) - 0.06).abs() < 1e-12);
        assert!((distance(-1.0, 0.0) - 0.12).abs() < 1e-12);
        let diagonal = distance(0.5_f64.sqrt(), 0.5_f64.sqrt());
        assert!((diagonal - 0.04 * 2.0_f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn the_least_of_the_seeds_counts() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(crate::setup::MAIN_SCENARIO);
        let setup = Setup::read(&file, &[]).unwrap();
        let search = |angle_rad: f64, seed: u64| Search {
            controller: "mpc".to_owned(),
            link: "utorso".to_owned(),
            angle_rad,
            seed,
        };
        let searches = [search(0.0, 1), search(0.0, 2), search(1.0, 1)];
        let found = vec![(40.0, None), (30.0, Some("the robot fell".to_owned())), (20.0, None)];
        let limits = gather(&setup, &searches, &found);
        assert_eq!(limits.len(), 2);
        assert_eq!((limits[0].least_ns, limits[0].mean_ns, limits[0].most_ns), (30.0, 35.0, 40.0));
        assert_eq!(limits[0].failure.as_deref(), Some("the robot fell"));
        assert!(table(&limits).contains("the robot fell") && polar_plot(&limits).contains("polygon"));
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
