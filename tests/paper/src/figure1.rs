//! Figure 1: the trapezoidal step of a 32-link pendulum, Newton's method against the quasi-Newton method.
//!
//! Random initial conditions for every time step; time, iterations and success rate. All methods solve the same equations from the same
//! start to the same tolerance ([`crate::one_step`]), in turn on the same sample, so that the machine's moods hit all of them.
//! Time of a sample: the least of the repeats. Two averages: over the solved samples, and all time spent (failures included) per solved one.

use std::f64::consts::FRAC_PI_2;

use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::velocity::VelocityWorkspace;
use serde_json::{Value, json};

use crate::exact_newton::{CHANGE_LIMIT, ExactNewton};
use crate::one_step::{OneStep, Outcome};
use crate::pendulum::{Links, initial_conditions, pendulum};
use crate::plot::{Figure, Legend, Line, Panel, Scale, Style};
use crate::quasi_newton::QuasiNewton;
use crate::results::{Claim, Part, Table, number};
use crate::stopwatch::once;
use crate::{Campaign, Failure};

const LINKS: usize = 32;
/// s.
pub const TIME_STEPS: [f64; 9] = [0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06];
/// From here on Newton's method has to be twice as fast (s).
const TWICE_FROM: f64 = 0.01;
/// From here on the limit has to raise the success rate (s).
const HARD_FROM: f64 = 0.02;

const QUASI: usize = 0;
const PLAIN: usize = 1;
const NEWTON: usize = 2;
const METHODS: [(&str, &str); 4] = [
    ("quasi_newton", "quasi-Newton (RIQN)"),
    ("newton_plain", "Newton, B.1, plain"),
    ("newton", "Newton, B.1"),
    ("newton_branch_lu", "Newton, branch LU"),
];

/// Success rates of the quasi-Newton authors' own program (its own discretisation) on the same chains, measured once on another occasion:
/// time step (s), rate.
const AUTHORS_RODS: [(f64, f64); 7] = [
    (0.005, 1.000),
    (0.01, 0.993),
    (0.02, 0.896),
    (0.03, 0.734),
    (0.04, 0.576),
    (0.05, 0.453),
    (0.06, 0.365),
];
const AUTHORS_UNIT: [(f64, f64); 2] = [(0.02, 0.992), (0.06, 0.688)];

fn authors(links: Links) -> &'static [(f64, f64)] {
    match links {
        Links::Rods => &AUTHORS_RODS,
        Links::UnitInertia => &AUTHORS_UNIT,
    }
}

/// One method at one time step.
#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    samples: usize,
    solved: usize,
    iterations: usize,
    /// s, solved samples.
    solved_time: f64,
    /// s, all samples.
    all_time: f64,
    /// s, samples that the quasi-Newton method and Newton's both solve.
    common_time: f64,
    common: usize,
}

impl Cell {
    fn success(&self) -> f64 {
        self.solved as f64 / self.samples as f64
    }
    fn mean_iterations(&self) -> f64 {
        self.iterations as f64 / self.solved as f64
    }
    fn mean_time(&self) -> f64 {
        self.solved_time / self.solved as f64
    }
    fn time_per_solved(&self) -> f64 {
        self.all_time / self.solved as f64
    }
    fn mean_common_time(&self) -> f64 {
        self.common_time / self.common as f64
    }
}

fn sweep(campaign: &Campaign, links: Links, time_step: f64) -> Result<[Cell; 4], Failure> {
    let (count, repeats) = if campaign.quick { (40, 1) } else { (1000, 6) };
    let tree = pendulum(links, LINKS)?;
    let mut problem = OneStep::new(&tree, time_step)?;
    let mut quasi = QuasiNewton::new(&tree)?;
    let mut newton = [
        ExactNewton::new(NewtonMethod::Recursive, &problem, f64::INFINITY),
        ExactNewton::new(NewtonMethod::Recursive, &problem, CHANGE_LIMIT),
        ExactNewton::new(NewtonMethod::BranchLu, &problem, CHANGE_LIMIT),
    ];
    let mut velocities = VelocityWorkspace::new(&tree);
    let mut state = State::zeros(&tree);
    let mut cells = [Cell::default(); 4];
    for (k, initial) in initial_conditions(LINKS, count, FRAC_PI_2, campaign.seed).iter().enumerate() {
        state.q.copy_from_slice(&initial.q);
        velocities.set_velocity(&tree, &mut state, &initial.v)?;
        problem.begin(&state, initial)?;
        let mut times = [f64::INFINITY; 4];
        let mut outcomes = [Outcome::Failed; 4];
        // The first sample also warms up.
        for _ in 0..repeats + usize::from(k == 0) {
            for method in 0..METHODS.len() {
                problem.restart();
                let (time, outcome) = match method {
                    QUASI => once(|| quasi.solve(&mut problem, initial)),
                    other => once(|| newton[other - 1].solve(&mut problem)),
                };
                times[method] = times[method].min(time);
                outcomes[method] = outcome;
            }
        }
        let common = outcomes[QUASI].is_solved() && outcomes[NEWTON].is_solved();
        for (method, cell) in cells.iter_mut().enumerate() {
            cell.samples += 1;
            cell.all_time += times[method];
            if let Outcome::Solved(iterations) = outcomes[method] {
                cell.solved += 1;
                cell.iterations += iterations;
                cell.solved_time += times[method];
            }
            if common && outcomes[method].is_solved() {
                cell.common += 1;
                cell.common_time += times[method];
            }
        }
        campaign.tick(1.0 / count as f64);
    }
    Ok(cells)
}

/// Cells of the campaign.
pub const CELLS: usize = 2 * TIME_STEPS.len();

/// Runs it.
///
/// # Errors
/// A model that does not build; a picture that cannot be drawn.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    let mut part = Part { key: "figure_1", ..Part::default() };
    let mut table = Table::new(&[
        "pendulum",
        "time_step_s",
        "method",
        "samples",
        "success_rate",
        "iterations",
        "time_us",
        "time_per_solved_us",
        "common_time_us",
    ]);
    let mut panels = Vec::new();
    let mut facts = serde_json::Map::new();
    for links in [Links::Rods, Links::UnitInertia] {
        let mut rows = Vec::new();
        for time_step in TIME_STEPS {
            campaign.say(&format!("figure 1: {}, {:.0} ms", links.key(), time_step * 1e3));
            let cells = sweep(campaign, links, time_step)?;
            for (method, cell) in cells.iter().enumerate() {
                table.push(vec![
                    links.key().into(),
                    number(time_step),
                    METHODS[method].0.into(),
                    cell.samples.to_string(),
                    number(cell.success()),
                    number(cell.mean_iterations()),
                    number(cell.mean_time() * 1e6),
                    number(cell.time_per_solved() * 1e6),
                    number(cell.mean_common_time() * 1e6),
                ]);
            }
            rows.push((time_step, cells));
        }
        part.claims.extend(claims(links, &rows));
        facts.insert(links.key().into(), row_facts(links, &rows));
        panels.extend(panels_of(links, &rows));
    }
    part.facts = Value::Object(facts);
    part.files.push(("figure_1.csv".into(), table.csv()));
    campaign.draw("figure_1", &Figure { columns: 3, panels })?;
    Ok(part)
}

fn claims(links: Links, rows: &[(f64, [Cell; 4])]) -> Vec<Claim> {
    let name = links.title();
    let least = |from: f64, to: f64, value: &dyn Fn(&[Cell; 4]) -> f64| {
        rows.iter()
            .filter(|(step, _)| (from..=to).contains(step))
            .map(|(_, cells)| value(cells))
            // A ratio without a denominator (nobody solved anything) is not a success.
            .fold(f64::INFINITY, |m, x| if x.is_nan() { m } else { m.min(x) })
    };
    let margin = rows
        .iter()
        .flat_map(|(step, cells)| {
            let published = authors(links).iter().filter(move |(s, _)| s == step);
            published.map(|(_, rate)| cells[NEWTON].success() - rate)
        })
        .fold(f64::INFINITY, f64::min);
    let hard = rows.iter().filter(|(step, _)| *step >= HARD_FROM);
    let gain: Vec<f64> = hard.map(|(_, cells)| cells[NEWTON].success() - cells[PLAIN].success()).collect();
    let mean_gain = gain.iter().sum::<f64>() / gain.len() as f64;
    let all = f64::INFINITY;
    let by_mean = |c: &[Cell; 4]| c[QUASI].mean_time() / c[NEWTON].mean_time();
    let by_solved = |c: &[Cell; 4]| c[QUASI].time_per_solved() / c[NEWTON].time_per_solved();
    let by_common = |c: &[Cell; 4]| c[QUASI].mean_common_time() / c[NEWTON].mean_common_time();
    vec![
        Claim::at_least(
            format!("{name}: success, Newton minus quasi-Newton, least over time steps"),
            least(0.0, all, &|c| c[NEWTON].success() - c[QUASI].success()),
            0.0,
        ),
        Claim::at_least(
            format!(
                "{name}: success minus that of the quasi-Newton authors' own program, least over time steps"
            ),
            margin,
            0.0,
        ),
        Claim::at_least(
            format!("{name}: success of Newton up to 10 ms"),
            least(0.0, TWICE_FROM, &|c| c[NEWTON].success()),
            1.0,
        ),
        Claim::at_least(
            format!("{name}: success gained by the limit on the change, least over 20 to 60 ms"),
            gain.iter().copied().fold(f64::INFINITY, f64::min),
            0.0,
        ),
        Claim::at_least(
            format!("{name}: success gained by the limit on the change, mean over 20 to 60 ms"),
            mean_gain,
            0.1,
        ),
        Claim::at_least(
            format!("{name}: time per solved step, quasi-Newton over Newton, least over time steps"),
            least(0.0, all, &by_solved),
            1.0,
        ),
        Claim::at_least(
            format!("{name}: time per solved step, quasi-Newton over Newton, least from 10 ms on"),
            least(TWICE_FROM, all, &by_solved),
            2.0,
        ),
        Claim::at_least(
            format!("{name}: the same without the time of failed attempts, least over time steps"),
            least(0.0, all, &by_mean),
            1.0,
        ),
        Claim::at_least(
            format!("{name}: the same without the time of failed attempts, least from 10 ms on"),
            least(TWICE_FROM, all, &by_mean),
            2.0,
        ),
        Claim::at_least(
            format!("{name}: the same over the steps both solve, least from 10 ms on"),
            least(TWICE_FROM, all, &by_common),
            2.0,
        ),
    ]
}

fn row_facts(links: Links, rows: &[(f64, [Cell; 4])]) -> Value {
    let methods: Vec<Value> = METHODS
        .iter()
        .enumerate()
        .map(|(method, (key, _))| {
            let column = |value: &dyn Fn(&Cell) -> f64| -> Vec<f64> {
                rows.iter().map(|(_, cells)| value(&cells[method])).collect()
            };
            json!({
                "method": key,
                "success_rate": column(&Cell::success),
                "iterations": column(&Cell::mean_iterations),
                "time_us": column(&|c| c.mean_time() * 1e6),
                "time_per_solved_us": column(&|c| c.time_per_solved() * 1e6),
            })
        })
        .collect();
    json!({
        "links": LINKS,
        "samples": rows.first().map_or(0, |(_, cells)| cells[0].samples),
        "time_step_s": TIME_STEPS,
        "methods": methods,
        "authors_success_rate": authors(links),
    })
}

fn panels_of(links: Links, rows: &[(f64, [Cell; 4])]) -> Vec<Panel> {
    let lines = |value: &dyn Fn(&Cell) -> f64| -> Vec<Line> {
        METHODS
            .iter()
            .enumerate()
            .map(|(method, (_, title))| Line {
                title: (*title).into(),
                style: [Style::Mark, Style::Dashed, Style::Mark, Style::Mark][method],
                colour: [1, 3, 0, 2][method],
                points: rows
                    .iter()
                    .map(|(step, cells)| (step * 1e3, value(&cells[method])))
                    .filter(|(_, y)| y.is_finite())
                    .collect(),
            })
            .collect()
    };
    let panel = |what: &str, y_label: &str, y: Scale, lines: Vec<Line>| Panel {
        title: format!("{what}: {}", links.title()),
        x_label: "time step (ms)".into(),
        y_label: y_label.into(),
        x: Scale::Linear,
        y,
        x_range: None,
        y_range: None,
        lines,
        legend: Legend::Corner,
    };
    let mut success = lines(&Cell::success);
    success.push(Line {
        title: "authors' own program".into(),
        style: Style::Points,
        colour: 4,
        points: authors(links).iter().map(|(step, rate)| (step * 1e3, *rate)).collect(),
    });
    let mut success = panel("Success", "share of solved steps", Scale::Linear, success);
    success.y_range = Some((0.0, 1.05));
    vec![
        panel("Time", "time of a solved step (µs)", Scale::Log, lines(&|c| c.mean_time() * 1e6)),
        panel("Iterations", "iterations of a solved step", Scale::Log, lines(&Cell::mean_iterations)),
        success,
    ]
}
