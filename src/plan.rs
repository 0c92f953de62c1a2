//! `delmpc plan`: plan a motion through contact, or check a plan file.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::Duration;

use delmpc_planner::check::{Bounds, Findings, check};
use delmpc_planner::execution::{Execution, execute};
use delmpc_planner::outline::leg_outline;
use delmpc_planner::plan_file::Plan;
use delmpc_planner::planner::{Planned, Search, plan as search_plan};
use delmpc_planner::robot::PlanRobot;
use delmpc_planner::task::{BaseBounds, ExecutionLimits, PlanWeights, Standing, Task};
use delmpc_planner::terrain::{Gap, Obstacle, Step, Terrain};
use delmpc_robots::{load, load_with};
use delmpc_scenario::{Document, PlanSettings, PlanWeightSettings, Scenario};
use indicatif::{ProgressBar, ProgressStyle};

use crate::colour::Colour;
use crate::output_file;
use crate::plan_page;
use crate::verdict::{Ended, Failure};

/// Arguments of `delmpc plan`.
#[derive(Debug, clap::Args)]
pub struct PlanArguments {
    /// Scenario with a section `[plan]`
    #[arg(required_unless_present = "check")]
    pub scenario: Option<PathBuf>,
    /// Where the plan goes; its page goes beside it as .html [default: runs/SCENARIO.plan.json]
    #[arg(long, value_name = "PLAN")]
    pub out: Option<PathBuf>,
    /// Override a key of the scenario, for example --set plan.stages=36; may be given several times
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Guesses, the cheapest plan is kept [default: plan.guesses]
    #[arg(long, value_name = "K")]
    pub guesses: Option<usize>,
    /// Check a plan file instead: every residual recomputed with the mechanics alone
    #[arg(long, value_name = "PLAN", conflicts_with_all = ["scenario", "out", "set", "guesses"])]
    pub check: Option<PathBuf>,
    /// Robot of the checked plan [default: configs/robots/NAME.urdf with the plan's robot name]
    #[arg(long, value_name = "URDF", requires = "check")]
    pub robot: Option<PathBuf>,
    /// Write the page of the checked plan here
    #[arg(long, value_name = "HTML", requires = "check")]
    pub page: Option<PathBuf>,
    /// Print one JSON object with every figure and nothing else
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// A scenario, robot or plan that cannot be used; a file that cannot be written.
pub fn plan(arguments: &PlanArguments) -> Result<Ended, Failure> {
    match (&arguments.check, &arguments.scenario) {
        (Some(file), _) => check_plan(file, arguments),
        (None, Some(scenario)) => make_plan(scenario, arguments),
        (None, None) => Err(Failure::Input("name a scenario, or a plan with --check".to_owned())),
    }
}

fn check_plan(file: &Path, arguments: &PlanArguments) -> Result<Ended, Failure> {
    let plan = Plan::read(file).map_err(Failure::input)?;
    let urdf = match &arguments.robot {
        Some(urdf) => urdf.clone(),
        None => PathBuf::from("configs/robots").join(&plan.robot).with_extension("urdf"),
    };
    if !urdf.is_file() {
        return Err(Failure::Input(format!(
            "{}: the robot of {} is not there; say where with --robot",
            urdf.display(),
            file.display()
        )));
    }
    let model = load(&urdf).map_err(Failure::input)?;
    let robot = match &plan.standing {
        Some(sole) => PlanRobot::standing(&model, sole),
        None => PlanRobot::new(&model),
    }
    .map_err(Failure::input)?;
    let findings = check(&plan, &robot).map_err(Failure::input)?;
    let found = execute(&plan, &robot).ok();
    say(&plan, &findings, found.as_ref(), arguments.json)?;
    if let Some(page) = &arguments.page {
        let html = plan_page::page(&plan, &robot, &findings, found.as_ref())?;
        output_file::write_named(page, html).map_err(|error| Failure::Fault(format!("{}: {error}", page.display())))?;
    }
    let holds = findings.passes(&Bounds::default());
    Ok(if holds { Ended::Well } else { Ended::CriterionMissed })
}

fn make_plan(file: &Path, arguments: &PlanArguments) -> Result<Ended, Failure> {
    let mut document = Document::read(file).map_err(Failure::input)?;
    for change in &arguments.set {
        document.set(change).map_err(Failure::input)?;
    }
    let scenario = document.scenario().map_err(Failure::input)?;
    let settings = scenario
        .plan
        .as_ref()
        .ok_or_else(|| Failure::Input(format!("{}: no section `[plan]`: nothing to plan", file.display())))?;
    let name =
        |error: delmpc_planner::error::PlanError| Failure::Input(format!("{}: {error}", file.display()));
    let task = task_of(file, &scenario, settings).map_err(name)?;
    let search = Search {
        guesses: arguments.guesses.unwrap_or(settings.guesses),
        seed: scenario.seed,
        refine_to: (settings.refine_stages > 0).then_some(settings.refine_stages),
        budget: (settings.budget_s > 0.0).then(|| Duration::from_secs_f64(settings.budget_s)),
        ..Search::of(&task)
    };
    let bar = progress_bar(arguments.json);
    let planned = search_plan(&task, &scenario.name, &search, |report| {
        let p = &report.progress;
        bar.set_position((1000.0 * p.done) as u64);
        let what = if report.refinement { "refining".to_owned() } else { format!("guess {}", report.guess) };
        bar.set_message(format!(
            "{what}   κ {:.1e}   violation {:.1e}   cost {:.3}   {} iterations",
            p.kappa, p.violation, p.cost, p.effort.iterations
        ));
        true
    })
    .map_err(name)?;
    bar.finish_and_clear();
    let out = match &arguments.out {
        Some(out) => out.clone(),
        None => {
            std::fs::create_dir_all("runs").map_err(|error| Failure::Fault(format!("runs: {error}")))?;
            PathBuf::from("runs").join(format!("{}.plan.json", scenario.name))
        }
    };
    let text = planned.plan.to_json().map_err(Failure::fault)?;
    output_file::write_named(&out, text).map_err(|error| Failure::Fault(format!("{}: {error}", out.display())))?;
    let found = execute(&planned.plan, &task.robot).ok();
    let page = out.with_extension("html");
    let html = plan_page::page(&planned.plan, &task.robot, &planned.findings, found.as_ref())?;
    output_file::write_named(&page, html).map_err(|error| Failure::Fault(format!("{}: {error}", page.display())))?;
    say(&planned.plan, &planned.findings, found.as_ref(), arguments.json)?;
    if !arguments.json {
        say_attempts(&planned);
        println!("{}\n{}", out.display(), page.display());
    }
    let done = planned.converged && planned.findings.passes(&Bounds::default());
    Ok(if done { Ended::Well } else { Ended::CriterionMissed })
}

/// The task of a scenario.
fn task_of(
    file: &Path,
    scenario: &Scenario,
    settings: &PlanSettings,
) -> Result<Task, delmpc_planner::error::PlanError> {
    let urdf = crate::setup::find_robot(file, &scenario.robot.urdf);
    let options = crate::setup::load_options(scenario);
    let model = load_with(&urdf, &options).map_err(|error| delmpc_planner::error::PlanError::PlanFile {
        file: urdf.display().to_string(),
        what: error.to_string(),
    })?;
    let springs: Vec<(&str, f64, f64)> = settings
        .spring
        .iter()
        .map(|spring| (spring.joint.as_str(), spring.stiffness_nm_per_rad, spring.rest_rad))
        .collect();
    let reaches = !settings.hand.is_empty();
    let robot = if reaches {
        PlanRobot::standing(&model, scenario.robot.stance.first())?
    } else {
        PlanRobot::new(&model)?
    };
    let robot = robot.with_springs(&springs)?;
    let standing = if reaches { Some(standing_of(&model, scenario, settings)) } else { None };
    let reach = if reaches { Some((robot.frame(&settings.hand)?.clone(), settings.target_m)) } else { None };
    let start = robot.posture(&scenario.robot.posture)?.to_vec();
    let mut bounds = Vec::new();
    for bound in &settings.bound {
        bounds.push((robot.coordinate(&bound.coordinate)?, bound.min, bound.max));
    }
    let [sole, shank] = settings.outline_points;
    let clearance = if sole + shank > 0 {
        leg_outline(&robot, sole, shank)?
    } else {
        // Spheres must not dip under the ground between the nodes.
        robot.contacts.iter().filter(|contact| contact.radius > 0.0).cloned().collect()
    };
    Ok(Task {
        terrain: terrain_of(settings),
        stages: settings.stages,
        horizon_s: settings.horizon_s,
        distance_m: settings.distance_m,
        speed_m_s: (settings.start_speed_m_s, settings.end_speed_m_s),
        start,
        friction: settings.friction,
        torque_fraction: settings.torque_fraction,
        torque_limit_nm: settings.torque_limit_nm,
        rate_limit: settings.rate_limit_rad_s,
        bounds,
        base: BaseBounds {
            attitude_rad: settings.base_attitude_rad,
            height_m: (settings.base_height_m[0], settings.base_height_m[1]),
        },
        clearance,
        weights: weights_of(&settings.weights),
        alike: alike(&robot),
        execution: settings.execution.then_some(ExecutionLimits {
            touchdown_speed_m_s: settings.touchdown_speed_m_s,
            impact_impulse_ns: settings.impact_impulse_ns,
        }),
        standing,
        reach,
        guess_lift_m: settings.guess_lift_m,
        robot,
    })
}

/// The sole's bounding box less the margin.
fn standing_of(model: &delmpc_robots::RobotModel, scenario: &Scenario, settings: &PlanSettings) -> Standing {
    let polygon = model.sole(scenario.robot.stance.first()).map_or(&[][..], |sole| sole.polygon.as_slice());
    let range = |axis: usize| {
        let values = polygon.iter().map(|corner| corner[axis]);
        let (low, high) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        [low + settings.cop_margin_m, high - settings.cop_margin_m]
    };
    Standing {
        sole: scenario.robot.stance.first().to_owned(),
        pressure_m: [range(0), range(1)],
        yaw_arm_m: settings.yaw_arm_m,
    }
}

fn terrain_of(settings: &PlanSettings) -> Terrain {
    let obstacle = |o: &delmpc_scenario::PlanObstacle| Obstacle {
        x_m: o.x_m,
        height_m: o.height_m,
        thickness_m: o.thickness_m,
    };
    Terrain {
        obstacles: settings.obstacle.iter().map(obstacle).collect(),
        gaps: settings.gap.iter().map(|gap| Gap { from_m: gap.from_m, to_m: gap.to_m }).collect(),
        steps: settings.step.iter().map(|step| Step { x_m: step.x_m, rise_m: step.rise_m }).collect(),
        edge_margin_m: settings.edge_margin_m,
        obstacle_margin_m: settings.obstacle_margin_m,
        ground_slack_m: 0.0,
        tails_m: 0.0,
    }
}

fn weights_of(w: &PlanWeightSettings) -> PlanWeights {
    PlanWeights {
        torque_nm: w.torque_nm,
        joint_rate: w.joint_rate_s2_per_rad2,
        legs_alike: w.legs_alike_per_rad2,
        steady_speed: w.steady_speed_s2_per_m2,
        base_attitude: w.base_attitude_per_rad2,
        base_height: w.base_height_per_m2,
        posture: w.posture_per_rad2,
        impulse: w.impulse,
        end_base: w.end_base,
        end_joints: w.end_joints_per_rad2,
        end_base_rate: w.end_base_rate,
        end_joint_rate: w.end_joint_rate_s2_per_rad2,
    }
}

/// Coordinates of the right and the left that have the same name otherwise.
fn alike(robot: &PlanRobot) -> Vec<(usize, usize)> {
    let pair = |(a, name): (usize, &String)| {
        let other = name.strip_prefix("right_").map(|rest| format!("left_{rest}"))?;
        Some((a, robot.coordinates.iter().position(|known| *known == other)?))
    };
    robot.coordinates.iter().enumerate().filter_map(pair).collect()
}

fn progress_bar(quiet: bool) -> ProgressBar {
    if quiet || !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(1000);
    if let Ok(style) = ProgressStyle::with_template("{elapsed:>5} {bar:20} {msg}") {
        bar.set_style(style);
    }
    bar
}

fn say(plan: &Plan, findings: &Findings, found: Option<&Execution>, json: bool) -> Result<(), Failure> {
    let bounds = Bounds::default();
    if json {
        let value = serde_json::json!({
            "name": plan.name, "robot": plan.robot, "note": plan.note, "stages": plan.stages,
            "passes": findings.passes(&bounds), "findings": findings, "execution": found, "contact_sets": plan.sets(),
            "provenance": plan.provenance,
        });
        println!("{}", serde_json::to_string(&value).map_err(Failure::fault)?);
        return Ok(());
    }
    let colour = Colour::of(&std::io::stdout());
    println!("{} ({}, {} stages, {} s)", plan.name, plan.robot, plan.stages, plan.horizon_s);
    for (name, value, bound, unit, holds) in findings.judged(&bounds) {
        let mark = if holds { colour.good("✓") } else { colour.bad("✗") };
        println!("  {mark} {name:<24} {value:>10.2e}   bound {bound:.1e} {unit}");
    }
    println!(
        "    mean speed {:.3} m/s, longest flight {:.3} s",
        findings.mean_speed_m_s, findings.longest_flight_s
    );
    println!(
        "    torque {:.1} N m, joint rate {:.1} rad/s, touchdown {:.2} m/s, impact {:.2} S, longest stage {:.0} ms",
        findings.torque_nm,
        findings.rate,
        findings.touchdown_m_s,
        findings.impact_s,
        1e3 * findings.longest_stage_s
    );
    if let Some(sole) = &findings.sole {
        let [[x0, x1], [y0, y1]] = sole.pressure_m.map(|range| range.map(|x| 1e3 * x));
        println!(
            "    pressure point x {x0:.1} .. {x1:.1} mm, y {y0:.1} .. {y1:.1} mm, friction {:.2}",
            sole.friction
        );
    } else {
        println!("    lowest point between nodes {:.1} mm", 1e3 * findings.lowest_m);
    }
    if let Some(hand) = findings.hand_m {
        println!("    hand to target {:.2} mm", 1e3 * hand);
    }
    // Stages integrated finely say whether the plan can be carried out; a plan that breaks apart there has no figures.
    if let Some(found) = found {
        println!(
            "    stages integrated finely: off by {:.1e} rad, {:.1e} rad/s; {} of {} beyond 0.01 rad or 0.3 rad/s",
            found.position,
            found.rate,
            found.stages_off.len(),
            plan.stages
        );
        println!(
            "    before impacts: {:.2} m/s down, {:.1} rad/s",
            found.touchdown_m_s, found.rate_before_impact
        );
    }
    if let Some(edge) = findings.edge_m {
        println!("    footholds to edges {:.1} mm", 1e3 * edge);
    }
    for (contact, set) in plan.contacts.iter().zip(plan.sets()) {
        println!("    {contact:<20} {set}");
    }
    Ok(())
}

fn say_attempts(planned: &Planned) {
    for attempt in &planned.attempts {
        let how = if attempt.converged { "converged" } else { attempt.trouble.as_str() };
        println!(
            "  guess {} with {} stages: cost {:.3}, violation {:.1e}, {} iterations, {:.1} s: {how}",
            attempt.guess,
            attempt.stages,
            attempt.cost,
            attempt.violation,
            attempt.iterations,
            attempt.time_s
        );
    }
}
