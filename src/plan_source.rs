//! The plan that a run follows: that of `plan.file`, or else one that is planned on first use and kept in `runs/plans`.
//!
//! A plan that was kept is of the same `[plan]`, `[robot]`, seed and robot, to the byte, and of the same version of this program: its name has
//! a hash of all these.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use delmpc_controller_core::prelude::JointMotion;
use delmpc_messages::JointSetHasher;
use delmpc_planner::check::Bounds;
use delmpc_planner::error::PlanError;
use delmpc_planner::plan_file::Plan;
use delmpc_planner::planner::{Planned, Search, plan as search_plan};
use delmpc_planner::task::Task;
use delmpc_scenario::{PlanSettings, ReachSettings, Scenario};
use indicatif::{ProgressBar, ProgressStyle};

use crate::output::say;
use crate::plan_task::task_of;
use crate::setup::Setup;
use crate::verdict::Failure;

/// Where plans are kept.
const FOLDER: &str = "runs/plans";
/// A ball and the target of a plan nearer to each other than this are the same, m; likewise times, s.
const SAME: f64 = 1e-6;
/// Rest before a planned reach begins, how long the hand stays and how long it takes back, where the scenario does not say, s.
const START_S: f64 = 1.0;
const HOLD_S: f64 = 1.0;
const RETURN_S: f64 = 1.5;

/// Searches the plan of a task as the settings have it, with a progress bar on a terminal.
///
/// # Errors
/// As [`search_plan`].
pub fn search(
    task: &Task,
    scenario: &Scenario,
    settings: &PlanSettings,
    guesses: Option<usize>,
    quiet: bool,
) -> Result<Planned, PlanError> {
    let search = Search {
        guesses: guesses.unwrap_or(settings.guesses),
        seed: scenario.seed,
        refine_to: (settings.refine_stages > 0).then_some(settings.refine_stages),
        budget: (settings.budget_s > 0.0).then(|| Duration::from_secs_f64(settings.budget_s)),
        ..Search::of(task)
    };
    let bar = progress_bar(quiet);
    let planned = search_plan(task, &scenario.name, &search, |report| {
        let p = &report.progress;
        bar.set_position((1000.0 * p.done) as u64);
        let what = if report.refinement { "refining".to_owned() } else { format!("guess {}", report.guess) };
        bar.set_message(format!(
            "{what}   κ {:.1e}   violation {:.1e}   cost {:.3}   {} iterations",
            p.kappa, p.violation, p.cost, p.effort.iterations
        ));
        true
    });
    bar.finish_and_clear();
    planned
}

fn progress_bar(quiet: bool) -> ProgressBar {
    use std::io::IsTerminal;
    if quiet || !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{elapsed:>5} {bar:20} {msg}") {
        bar.set_style(style);
    }
    bar
}

/// Reads the plan of `plan.file`, which is relative to the scenario's file or to the working folder.
///
/// # Errors
/// In words: a file that is no plan.
pub fn read(scenario_file: &Path, name: &str) -> Result<Plan, String> {
    let file = crate::setup::find_robot(scenario_file, name);
    Plan::read(&file).map_err(|error| format!("`plan.file`: {error}"))
}

/// Makes sure that a scenario with a section `[plan]` has its plan: planned now, or kept from an earlier time.
///
/// # Errors
/// [`Failure::Input`] for a task that cannot be planned; [`Failure::Fault`] for a folder that cannot be written.
pub fn provide(setup: &mut Setup, quiet: bool) -> Result<(), Failure> {
    let Some(settings) = setup.scenario.plan.clone().filter(|_| setup.plan.is_none()) else { return Ok(()) };
    let file = kept_in(setup, &settings);
    if !file.is_file() {
        let refused = |error: PlanError| Failure::Input(format!("{}: {error}", setup.scenario.name));
        let task = task_of(&setup.urdf, &setup.scenario, &settings).map_err(refused)?;
        if !quiet {
            say(&format!("planning {}: kept in {} for the next time", setup.scenario.name, file.display()));
        }
        let planned = search(&task, &setup.scenario, &settings, None, quiet).map_err(refused)?;
        if !(planned.converged && planned.findings.passes(&Bounds::default())) {
            return Err(Failure::Input(format!(
                "{}: `[plan]`: no plan was found that keeps to its bounds; `delmpc plan` says what was reached: more guesses \
                 (plan.guesses), more time (plan.horizon_s) or stages may help",
                setup.scenario.name
            )));
        }
        keep(&file, &planned.plan)?;
    }
    setup.plan = Some(Plan::read(&file).map_err(Failure::input)?);
    Ok(())
}

/// Written under another name first: another run may look for it, or this one may be ended.
fn keep(file: &Path, plan: &Plan) -> Result<(), Failure> {
    let cannot = |error: std::io::Error| Failure::Fault(format!("{}: {error}", file.display()));
    let text = plan.to_json().map_err(Failure::fault)?;
    fs::create_dir_all(FOLDER).map_err(cannot)?;
    let begun = file.with_extension(format!("{}.part", std::process::id()));
    fs::write(&begun, text).map_err(cannot)?;
    fs::rename(&begun, file).map_err(cannot)
}

fn kept_in(setup: &Setup, settings: &PlanSettings) -> PathBuf {
    let scenario = &setup.scenario;
    // Only what the plan depends on.
    let asked = Scenario {
        name: String::new(),
        seed: scenario.seed,
        robot: scenario.robot.clone(),
        plan: Some(settings.clone()),
        ..Scenario::default()
    };
    let hash = [env!("CARGO_PKG_VERSION"), env!("DELMPC_GIT_REVISION"), &asked.to_toml()]
        .into_iter()
        .fold(JointSetHasher::new(), |hash, text| hash.joint(text))
        .joint(&format!("{:016x}", setup.model_hash()))
        .finish();
    Path::new(FOLDER).join(format!("{}-{hash:016x}.plan.json", scenario.name))
}

/// The reach that a plan with a hand is: given by the scenario, or derived from the plan. What is wrong with it, in words.
///
/// # Errors
/// A scenario whose `[reach]` says something else than its `[plan]`.
pub fn reach_of_plan(scenario: &mut Scenario) -> Result<(), String> {
    let Some(plan) = scenario.plan.as_ref().filter(|plan| !plan.hand.is_empty()) else { return Ok(()) };
    let Some(reach) = &scenario.reach else {
        scenario.reach = Some(ReachSettings {
            hand: plan.hand.clone(),
            ball_m: plan.target_m,
            start_s: START_S,
            deadline_s: plan.horizon_s,
            hold_s: HOLD_S,
            return_s: RETURN_S,
        });
        return Ok(());
    };
    let far = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).any(|(a, b)| (a - b).abs() > SAME);
    if reach.hand != plan.hand {
        return Err(format!(
            "`reach.hand` = \"{}\" and `plan.hand` = \"{}\" are to be the same",
            reach.hand, plan.hand
        ));
    }
    if far(&reach.ball_m, &plan.target_m) {
        return Err("`reach.ball_m` and `plan.target_m` are to be the same".to_owned());
    }
    if (reach.deadline_s - plan.horizon_s).abs() > SAME {
        return Err("`reach.deadline_s` and `plan.horizon_s` are to be the same".to_owned());
    }
    Ok(())
}

/// The joints of a plan, in the robot's order.
///
/// # Errors
/// In words: a joint that the plan has not.
pub fn joint_motion(plan: &Plan, joints: &[String]) -> Result<JointMotion, String> {
    let places = joints
        .iter()
        .map(|joint| {
            let place = plan.coordinates.iter().position(|coordinate| coordinate == joint);
            place.ok_or_else(|| {
                format!("plan {}: it has no joint `{joint}`: it is of another robot", plan.name)
            })
        })
        .collect::<Result<Vec<usize>, String>>()?;
    let begin_s = plan.t.first().copied().unwrap_or(0.0);
    JointMotion {
        times: plan.t.iter().map(|t| t - begin_s).collect(),
        q: plan.q.clone(),
        rate: plan.v.clone(),
        torque: inputs(plan),
    }
    .in_order(&places)
    .map_err(|error| format!("plan {}: {error}", plan.name))
}

/// Torques of all coordinates; those that nothing drives have none.
fn inputs(plan: &Plan) -> Vec<Vec<f64>> {
    let driven = |coordinate: &String| plan.actuated.iter().position(|name| name == coordinate);
    let places: Vec<Option<usize>> = plan.coordinates.iter().map(driven).collect();
    let row = |u: &Vec<f64>| places.iter().map(|place| place.map_or(0.0, |k| u[k])).collect();
    plan.u.iter().map(row).collect()
}
