//! From a task to a plan: guesses, passes, refinement, projection, check.

use std::time::Duration;

use serde::Serialize;
use serde_json::json;

use crate::check::{Findings, check};
use crate::contact_law::Homotopy;
use crate::error::PlanError;
use crate::homotopy::{Budget, Outcome, Progress, Schedule, second_pass, two_passes};
use crate::newton::{Curvature, Minimiser};
use crate::plan_file::Plan;
use crate::problem::Problem;
use crate::refine::refine;
use crate::task::Task;

/// Largest violation from which a plan is projected on DEL = 0.
const PROJECTABLE: f64 = 1e-4;

/// Where the barrier of a robot without contact points begins, as a relaxation.
const KAPPA_STANDING: f64 = 1e-2;

/// How a plan is looked for.
#[derive(Clone, Debug)]
pub struct Search {
    /// Settings of the homotopy.
    pub schedule: Schedule,
    /// Guesses: the first is the plain one, the others are shifted by seeded sines. The cheapest plan is kept.
    pub guesses: usize,
    /// Seed of the shifted guesses.
    pub seed: u64,
    /// Size of the shifts of angles, rad; of the base, a third of it in m.
    pub noise_rad: f64,
    /// The kept plan is cut into this many stages (a multiple of the task's), by doubling where that divides, and solved again.
    pub refine_to: Option<usize>,
    /// Time after which the search ends with what it has.
    pub budget: Option<Duration>,
    /// How curvature enters.
    pub curvature: Curvature,
}

impl Search {
    /// The search for a task: the schedule of its kind, everything else by default.
    pub fn of(task: &Task) -> Self {
        let schedule = if task.standing.is_some() || (task.robot.planar && task.execution.is_none()) {
            Schedule::planar()
        } else if task.robot.planar {
            Schedule::one_pass()
        } else {
            Schedule::spatial()
        };
        Self { schedule, ..Self::default() }
    }
}

impl Default for Search {
    fn default() -> Self {
        Self {
            schedule: Schedule::default(),
            guesses: 1,
            seed: 0,
            noise_rad: 0.15,
            refine_to: None,
            budget: None,
            curvature: Curvature::Exact,
        }
    }
}

/// How one guess ended.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Attempt {
    /// Number of the guess; 0 is the plain one.
    pub guess: usize,
    /// Stages.
    pub stages: usize,
    /// Whether it reached the last relaxation within the tolerance.
    pub converged: bool,
    /// Largest violation.
    pub violation: f64,
    /// Last relaxation, S m.
    pub kappa: f64,
    /// Cost.
    pub cost: f64,
    /// Newton iterations.
    pub iterations: u64,
    /// Time, s.
    pub time_s: f64,
    /// What kept it from converging, in words; empty when it did.
    pub trouble: String,
}

/// A plan and how it came about.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The plan.
    pub plan: Plan,
    /// Its check with the mechanics alone.
    pub findings: Findings,
    /// Whether the plan reached the last relaxation within the tolerance.
    pub converged: bool,
    /// All attempts, the refinement last.
    pub attempts: Vec<Attempt>,
}

/// What a watcher is told.
#[derive(Clone, Debug)]
pub struct Report {
    /// Number of the guess.
    pub guess: usize,
    /// Whether this is the refinement.
    pub refinement: bool,
    /// Where the homotopy is.
    pub progress: Progress,
}

/// Plans a task. `watch` sees every round and may stop the search.
///
/// # Errors
/// [`PlanError`] for a task that cannot be posed. A search that does not converge is no error: see [`Planned::converged`].
pub fn plan(
    task: &Task,
    name: &str,
    search: &Search,
    mut watch: impl FnMut(&Report) -> bool,
) -> Result<Planned, PlanError> {
    let budget = Budget::start(search.budget);
    let problem = task.problem()?;
    let mut attempts = Vec::new();
    let mut best: Option<(Vec<f64>, Attempt)> = None;
    for guess in 0..search.guesses.max(1) {
        let start = task.guess(&problem, shift(task, search, guess));
        let mut minimiser = Minimiser::new(&problem, &start);
        minimiser.curvature = search.curvature;
        let began = budget.spent();
        let mut watcher = |progress: &Progress| {
            watch(&Report { guess, refinement: false, progress: progress.clone() }) && budget.is_left()
        };
        let outcome = if problem.contacts.is_empty() {
            // Without contact unknowns there is nothing to relax: only the barrier goes to zero.
            second_pass(&mut minimiser, &search.schedule, KAPPA_STANDING, &mut watcher)
        } else {
            two_passes(&mut minimiser, &search.schedule, &mut watcher)
        };
        let attempt = attempt_of(&problem, guess, &outcome, budget.spent() - began);
        let better = best.as_ref().is_none_or(|(_, other)| is_better(&attempt, other));
        attempts.push(attempt.clone());
        if better {
            best = Some((minimiser.x.clone(), attempt));
        }
        if !budget.is_left() {
            break;
        }
    }
    let Some((mut x, mut kept)) = best else {
        return Err(PlanError::OutOfRange { key: "guesses", value: 0.0, rule: "at least 1" });
    };
    let mut problem = problem;
    for stages in levels(task.stages, search.refine_to)? {
        let fine = Task { stages, ..task.clone() }.problem()?;
        let Some(start) = refine(&problem, &x, &fine) else { break };
        let mut minimiser = Minimiser::new(&fine, &start);
        minimiser.curvature = search.curvature;
        let began = budget.spent();
        let guess = kept.guess;
        let schedule = &search.schedule;
        let outcome = second_pass(&mut minimiser, schedule, schedule.kappa_refined, &mut |progress| {
            watch(&Report { guess, refinement: true, progress: progress.clone() }) && budget.is_left()
        });
        kept = attempt_of(&fine, guess, &outcome, budget.spent() - began);
        attempts.push(kept.clone());
        x = minimiser.x;
        problem = fine;
        if !budget.is_left() {
            break;
        }
    }
    finish(task, name, search, &problem, &x, &kept, attempts)
}

/// Numbers of stages on the way to the refined plan: doubled as long as that divides it.
fn levels(stages: usize, refine_to: Option<usize>) -> Result<Vec<usize>, PlanError> {
    let Some(last) = refine_to.filter(|&last| last > stages) else { return Ok(Vec::new()) };
    if !last.is_multiple_of(stages) {
        return Err(PlanError::OutOfRange {
            key: "plan.refine_stages",
            value: last as f64,
            rule: "a multiple of plan.stages",
        });
    }
    let mut list = Vec::new();
    let mut now = stages;
    while now < last {
        now = if last.is_multiple_of(2 * now) { 2 * now } else { last };
        list.push(now);
    }
    Ok(list)
}

fn finish(
    task: &Task,
    name: &str,
    search: &Search,
    problem: &Problem,
    x: &[f64],
    kept: &Attempt,
    attempts: Vec<Attempt>,
) -> Result<Planned, PlanError> {
    let homotopy = Homotopy { kappa: kept.kappa, sigma: 1.0 };
    let mut minimiser = Minimiser::new(problem, x);
    // Removing a large residual would move everything else.
    if kept.violation < PROJECTABLE {
        minimiser.project(homotopy, 4)?;
    }
    minimiser.evaluate(homotopy);
    let mut plan = Plan::from_vector(problem, &minimiser.x, name, kept.kappa);
    plan.task = json!({
        "distance_m": task.distance_m,
        "speed_m_s": [task.speed_m_s.0, task.speed_m_s.1],
        "torque_fraction": task.torque_fraction,
        "execution": task.execution.is_some(),
    });
    plan.standing = task.standing.as_ref().map(|standing| standing.sole.clone());
    if let Some((hand, target)) = &task.reach {
        plan.task["hand"] = json!(hand.name);
        plan.task["target_m"] = json!(target);
    }
    let findings = check(&plan, &task.robot)?;
    plan.residual = match serde_json::to_value(&findings) {
        Ok(serde_json::Value::Object(map)) => map,
        _ => serde_json::Map::new(),
    };
    plan.note = if kept.converged {
        "converged, projected on DEL = 0".to_owned()
    } else {
        format!("NOT CONVERGED: {}", kept.trouble)
    };
    plan.provenance = json!({
        "program": concat!("delmpc-planner ", env!("CARGO_PKG_VERSION")),
        "seed": search.seed,
        "guess": kept.guess,
        "cost": minimiser.cost(),
        "attempts": attempts,
    });
    Ok(Planned { plan, findings, converged: kept.converged, attempts })
}

fn attempt_of(
    problem: &Problem,
    guess: usize,
    outcome: &Result<Outcome, PlanError>,
    time: Duration,
) -> Attempt {
    let mut attempt = Attempt {
        guess,
        stages: problem.stages,
        converged: false,
        violation: f64::INFINITY,
        kappa: 1.0,
        cost: f64::INFINITY,
        iterations: 0,
        time_s: time.as_secs_f64(),
        trouble: String::new(),
    };
    match outcome {
        Err(error) => attempt.trouble = error.to_string(),
        Ok(outcome) => {
            let progress = &outcome.progress;
            attempt.converged = outcome.converged;
            attempt.violation = progress.violation;
            attempt.kappa = progress.kappa;
            attempt.cost = progress.cost;
            attempt.iterations = progress.effort.iterations;
            if outcome.stopped {
                attempt.trouble = format!("stopped at κ = {:.1e}", progress.kappa);
            } else if !outcome.converged {
                let worst = progress.worst.first().map_or_else(String::new, |&(k, r, violation)| {
                    format!(": {} of stage {k} by {violation:.1e}", problem.row_name(r))
                });
                attempt.trouble = format!("violates its rows at the last relaxation{worst}");
            }
        }
    }
    attempt
}

fn is_better(new: &Attempt, old: &Attempt) -> bool {
    match (new.converged, old.converged) {
        (true, false) => true,
        (false, true) => false,
        (true, true) => new.cost < old.cost,
        (false, false) => (new.kappa, new.violation) < (old.kappa, old.violation),
    }
}

/// Shift of coordinate `j` at the time fraction `s` in a guess: four sine modes with seeded amplitudes.
fn shift(task: &Task, search: &Search, guess: usize) -> impl Fn(usize, f64) -> f64 {
    let mut state =
        search.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (guess as u64).wrapping_mul(0xd134_2543_de82_ef95);
    let mut next = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 11) as f64 / (1u64 << 53) as f64) * 2.0 - 1.0
    };
    let amplitudes: Vec<[f64; 4]> = task
        .robot
        .coordinates
        .iter()
        .map(|name| {
            let is_length = matches!(name.as_str(), "base_x" | "base_y" | "base_z");
            let size = if guess == 0 { 0.0 } else { search.noise_rad / if is_length { 3.0 } else { 1.0 } };
            [next() * size, next() * size, next() * size, next() * size]
        })
        .collect();
    move |j, s| {
        let modes = amplitudes[j].iter().enumerate();
        modes.map(|(m, a)| a * (std::f64::consts::PI * (m + 1) as f64 * s).sin()).sum()
    }
}
