//! `delmpc plan`: plan a motion through contact, or check a plan file.

use std::path::{Path, PathBuf};

use delmpc_planner::check::{Bounds, Findings, check};
use delmpc_planner::execution::{Execution, execute};
use delmpc_planner::plan_file::Plan;
use delmpc_planner::planner::Planned;
use delmpc_planner::robot::PlanRobot;
use delmpc_robots::load;
use delmpc_scenario::Document;

use crate::colour::Colour;
use crate::output_file;
use crate::plan_page;
use crate::plan_source::search;
use crate::plan_task::task_of;
use crate::setup::find_robot;
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
        output_file::write_named(page, html)
            .map_err(|error| Failure::Fault(format!("{}: {error}", page.display())))?;
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
    let task = task_of(&find_robot(file, &scenario.robot.urdf), &scenario, settings).map_err(name)?;
    let planned = search(&task, &scenario, settings, arguments.guesses, arguments.json).map_err(name)?;
    let out = match &arguments.out {
        Some(out) => out.clone(),
        None => {
            std::fs::create_dir_all("runs").map_err(|error| Failure::Fault(format!("runs: {error}")))?;
            PathBuf::from("runs").join(format!("{}.plan.json", scenario.name))
        }
    };
    let text = planned.plan.to_json().map_err(Failure::fault)?;
    output_file::write_named(&out, text)
        .map_err(|error| Failure::Fault(format!("{}: {error}", out.display())))?;
    let found = execute(&planned.plan, &task.robot).ok();
    let page = out.with_extension("html");
    let html = plan_page::page(&planned.plan, &task.robot, &planned.findings, found.as_ref())?;
    output_file::write_named(&page, html)
        .map_err(|error| Failure::Fault(format!("{}: {error}", page.display())))?;
    say(&planned.plan, &planned.findings, found.as_ref(), arguments.json)?;
    if !arguments.json {
        say_attempts(&planned);
        println!("{}\n{}", out.display(), page.display());
    }
    let done = planned.converged && planned.findings.passes(&Bounds::default());
    Ok(if done { Ended::Well } else { Ended::CriterionMissed })
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
