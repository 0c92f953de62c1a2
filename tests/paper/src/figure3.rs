//! Figure 3 and beyond: error against time on a 12-link pendulum over ten seconds.
//!
//! Figure 3 is the variational Simpson integrator against implicit Hermite-Simpson collocation on random small initial conditions. Beyond
//! the paper: the variational integrators of all orders against Runge-Kutta methods on articulated bodies. Error: the largest angle
//! difference to the reference at the end, median over the initial conditions; time: the least of the repeats, median likewise. All
//! methods take every initial condition in turn, so that the machine's moods hit all of them. Implicit methods stop iterating at
//! [`matched_accuracy`].
//!
//! Reference: eight unknown nodes (order 16), compared with Runge-Kutta-Fehlberg 7(8) at a tolerance near round-off.

use std::f64::consts::PI;

use delmpc_mechanics::prelude::*;
use serde_json::{Map, Value, json};

use crate::pendulum::{Initial, Links, initial_conditions, pendulum};
use crate::plot::{Figure, Legend, Line, Panel, Scale, Style};
use crate::results::{Claim, Part, Table, number};
use crate::stopwatch::{exponent, median};
use crate::trajectory::{Method, ROUND_OFF, distance, matched_accuracy, run as integrate};
use crate::{Campaign, Failure};

const LINKS: usize = 12;
/// rad, rad/s.
const SPREAD: f64 = PI / 12.0;
/// s.
const REFERENCE_STEP: f64 = 0.01;
/// Unknown nodes of the reference.
const REFERENCE_NODES: usize = 8;

/// One method at one parameter.
#[derive(Clone, Copy, Debug)]
struct Point {
    parameter: f64,
    /// rad.
    error: f64,
    /// s.
    time: f64,
    failures: usize,
}

struct Curve {
    method: Method,
    points: Vec<Point>,
}

struct Problem {
    tree: KinematicTree,
    initial: Vec<Initial>,
    reference: Vec<Vec<f64>>,
    /// Largest distance of the two references, median.
    uncertainty: f64,
    duration: f64,
    repeats: usize,
}

impl Problem {
    pub fn new(
        campaign: &Campaign,
        samples: usize,
        compared: usize,
        repeats: usize,
    ) -> Result<Self, Failure> {
        let tree = pendulum(Links::Rods, LINKS)?;
        let duration = if campaign.quick { 1.0 } else { 10.0 };
        let initial = initial_conditions(LINKS, samples, SPREAD, campaign.seed);
        let method = Method::Variational(REFERENCE_NODES);
        let mut reference = Vec::new();
        let mut apart = Vec::new();
        for (k, initial) in initial.iter().enumerate() {
            let end = integrate(&tree, method, REFERENCE_STEP, initial, duration, ROUND_OFF)?;
            if k < compared {
                let other = integrate(&tree, Method::Fehlberg, 1e-14, initial, duration, ROUND_OFF)?;
                apart.push(distance(&end.q, &other.q));
            }
            reference.push(end.q);
        }
        Ok(Self { tree, initial, reference, uncertainty: median(apart), duration, repeats })
    }

    /// The curves of methods at their parameters. `share`: of the campaign's bar.
    fn curves(
        &self,
        campaign: &Campaign,
        plans: &[(Method, Vec<f64>)],
        share: f64,
    ) -> Result<Vec<Curve>, Failure> {
        let mut cells: Vec<Vec<Cell>> =
            plans.iter().map(|(_, parameters)| vec![Cell::default(); parameters.len()]).collect();
        for (initial, reference) in self.initial.iter().zip(&self.reference) {
            for ((method, parameters), cells) in plans.iter().zip(&mut cells) {
                for (parameter, cell) in parameters.iter().zip(cells) {
                    self.run(*method, *parameter, initial, reference, cell)?;
                }
            }
            campaign.tick(share / self.initial.len() as f64);
        }
        let curves = plans.iter().zip(cells).map(|((method, parameters), cells)| {
            let points = parameters.iter().zip(cells).map(|(parameter, cell)| cell.point(*parameter));
            Curve { method: *method, points: points.collect() }
        });
        Ok(curves.collect())
    }

    /// One initial condition with all its repeats.
    fn run(
        &self,
        method: Method,
        parameter: f64,
        initial: &Initial,
        reference: &[f64],
        cell: &mut Cell,
    ) -> Result<(), Failure> {
        let accuracy = matched_accuracy(method, parameter);
        let mut time = f64::INFINITY;
        for repeat in 0..self.repeats {
            match integrate(&self.tree, method, parameter, initial, self.duration, accuracy) {
                Ok(end) => {
                    time = time.min(end.seconds);
                    if repeat == 0 {
                        cell.errors.push(distance(&end.q, reference));
                    }
                }
                // A step too long for the method: counted, not hidden.
                Err(Failure::Step(_) | Failure::Collocation(_) | Failure::FixedPoint { .. }) => {
                    cell.failures += 1;
                    return Ok(());
                }
                Err(other) => return Err(other),
            }
        }
        cell.times.push(time);
        Ok(())
    }
}

/// What a method at a parameter gave for the initial conditions so far.
#[derive(Clone, Debug, Default)]
struct Cell {
    errors: Vec<f64>,
    times: Vec<f64>,
    failures: usize,
}

impl Cell {
    fn point(self, parameter: f64) -> Point {
        let solved = !self.times.is_empty();
        let or_nan = |x: Vec<f64>| if solved { median(x) } else { f64::NAN };
        Point { parameter, error: or_nan(self.errors), time: or_nan(self.times), failures: self.failures }
    }
}

/// Time (s) at an error, on the straight lines of the doubly logarithmic plot; `None` outside the curve.
fn time_at(curve: &Curve, error: f64) -> Option<f64> {
    let logs: Vec<(f64, f64)> =
        curve.points.iter().filter(|p| p.failures == 0).map(|p| (p.error.ln(), p.time.ln())).collect();
    let target = error.ln();
    let crossings = logs.windows(2).filter(|pair| (pair[0].0 - target) * (pair[1].0 - target) <= 0.0);
    crossings
        .map(|pair| {
            let share = (target - pair[0].0) / (pair[1].0 - pair[0].0);
            (pair[0].1 + share * (pair[1].1 - pair[0].1)).exp()
        })
        .fold(None, |least: Option<f64>, time| Some(least.map_or(time, |l| l.min(time))))
}

/// Order over the points between round-off and the breakdown at long steps.
fn order(curve: &Curve, above: f64, below: f64) -> f64 {
    let points: Vec<(f64, f64)> = curve
        .points
        .iter()
        .filter(|p| p.error > above && p.error < below)
        .map(|p| (p.parameter, p.error))
        .collect();
    exponent(&points)
}

/// `first, first/2, first/4, ...`
fn halvings(first: f64, count: usize) -> Vec<f64> {
    (0..count).map(|k| first / (1u32 << k) as f64).collect()
}

/// `count` time steps from `first` to `last`, by about equal factors: whole parts of the duration.
fn between(first: f64, last: f64, count: usize, duration: f64) -> Vec<f64> {
    let factor = (last / first).powf(1.0 / (count - 1) as f64);
    (0..count).map(|k| duration / (duration / (first * factor.powi(k as i32))).round()).collect()
}

fn record(table: &mut Table, curves: &[Curve]) {
    for curve in curves {
        for point in &curve.points {
            table.push(vec![
                curve.method.key(),
                number(point.parameter),
                number(point.error),
                number(point.time * 1e3),
                point.failures.to_string(),
            ]);
        }
    }
}

const HEADER: [&str; 5] = ["method", "time_step_s_or_tolerance", "error_rad", "time_ms", "failures"];

fn lines(curves: &[Curve], colours: &[usize], xy: &dyn Fn(&Point) -> (f64, f64)) -> Vec<Line> {
    curves
        .iter()
        .zip(colours)
        .map(|(curve, colour)| Line {
            title: curve.method.title(),
            style: if matches!(curve.method, Method::Variational(_)) { Style::Mark } else { Style::Hollow },
            colour: *colour,
            points: curve.points.iter().map(xy).filter(|(x, y)| (x * y).is_finite()).collect(),
        })
        .collect()
}

fn panel(title: &str, x_label: &str, y_label: &str, lines: Vec<Line>) -> Panel {
    Panel {
        title: title.into(),
        x_label: x_label.into(),
        y_label: y_label.into(),
        x: Scale::Log,
        y: Scale::Log,
        x_range: None,
        y_range: None,
        lines,
        legend: Legend::Corner,
    }
}

/// Cells of the campaign: figure 3, beyond.
pub const CELLS: [usize; 2] = [12, 30];

/// Figure 3: the variational Simpson integrator against Hermite-Simpson collocation.
///
/// # Errors
/// A model that does not build; a reference that fails; a picture that cannot be drawn.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    campaign.say("figure 3: reference");
    let samples = if campaign.quick { 2 } else { 100 };
    let problem = Problem::new(campaign, samples, 3, 2)?;
    let levels = if campaign.quick { 4 } else { 5 };
    let first = if campaign.quick { 0.0125 } else { 0.025 };
    let plans = [Method::Variational(2), Method::HermiteSimpson, Method::HermiteSimpsonFull]
        .map(|m| (m, halvings(first, if m == Method::HermiteSimpsonFull { levels - 2 } else { levels })));
    campaign.say("figure 3: Simpson, Hermite-Simpson");
    let curves = problem.curves(campaign, &plans, CELLS[0] as f64)?;
    let errors: Vec<f64> = curves[0].points.iter().map(|p| p.error).collect();
    let ratio =
        |rival: usize, error: f64| Some(time_at(&curves[rival], error)? / time_at(&curves[0], error)?);
    // At every error that both curves cover, in steps of a fifth of a decade.
    let worst = |rival: usize| {
        let errors = (0..60).map(|k| 10f64.powf(-0.2 * f64::from(k)));
        errors.filter_map(|e| ratio(rival, e)).fold(f64::NAN, f64::min)
    };
    let mut part = Part { key: "figure_3", ..Part::default() };
    part.claims = vec![
        Claim::at_least(
            "Simpson, 12 links, 10 s: times faster than Hermite-Simpson at equal error, all unknowns kept (least)",
            worst(2),
            3.0,
        ),
        Claim::at_least(
            "Simpson, 12 links, 10 s: times faster than Hermite-Simpson at equal error, reduced to accelerations (least)",
            worst(1),
            3.0,
        ),
        Claim::at_least("order of the Simpson integrator", order(&curves[0], 1e-9, 1e-2), 3.8),
        Claim::at_least("order of Hermite-Simpson", order(&curves[1], 1e-9, 1e-2), 3.8),
        Claim::at_most("uncertainty of the reference (rad)", problem.uncertainty, 1e-8),
    ];
    part.facts = json!({
        "links": LINKS, "samples": samples, "duration_s": problem.duration,
        "simpson_error_rad": errors,
        "error_of_hermite_simpson_over_simpson_at_equal_step":
            curves[1].points.iter().zip(&errors).map(|(p, e)| p.error / e).collect::<Vec<_>>(),
    });
    let mut table = Table::new(&HEADER);
    record(&mut table, &curves);
    part.files.push(("figure_3.csv".into(), table.csv()));
    let colours = [0, 1, 3];
    let figure = Figure {
        columns: 3,
        panels: vec![
            panel(
                "Error",
                "time step (ms)",
                "error (rad)",
                lines(&curves, &colours, &|p| (p.parameter * 1e3, p.error)),
            ),
            panel(
                "Time",
                "time step (ms)",
                "time of 10 s (ms)",
                lines(&curves, &colours, &|p| (p.parameter * 1e3, p.time * 1e3)),
            ),
            panel(
                "Error against time",
                "time of 10 s (ms)",
                "error (rad)",
                lines(&curves, &colours, &|p| (p.time * 1e3, p.error)),
            ),
        ],
    };
    campaign.draw("figure_3", &figure)?;
    Ok(part)
}

/// Orders of the variational integrators, on a motion short enough that errors are still errors and not chaos.
fn orders(campaign: &Campaign) -> Result<Vec<(usize, f64)>, Failure> {
    let tree = pendulum(Links::Rods, LINKS)?;
    let initial = &initial_conditions(LINKS, 1, SPREAD, campaign.seed)[0];
    let reference =
        integrate(&tree, Method::Variational(REFERENCE_NODES), REFERENCE_STEP, initial, 1.0, ROUND_OFF)?.q;
    let mut list = Vec::new();
    for (s, steps) in [(1, 800.0), (2, 200.0), (3, 100.0), (4, 50.0)] {
        let mut points = Vec::new();
        for step in [1.0 / steps, 0.5 / steps] {
            let end = integrate(&tree, Method::Variational(s), step, initial, 1.0, ROUND_OFF)?;
            points.push((step, distance(&end.q, &reference)));
        }
        list.push((s, exponent(&points)));
    }
    Ok(list)
}

/// Beyond the paper: all orders against Runge-Kutta methods on articulated bodies.
///
/// # Errors
/// As [`run`].
pub fn beyond(campaign: &Campaign) -> Result<Part, Failure> {
    campaign.say("beyond: reference");
    let samples = if campaign.quick { 1 } else { 10 };
    let problem = Problem::new(campaign, samples, samples, if campaign.quick { 1 } else { 3 })?;
    let first = if campaign.quick { 0.025 } else { 0.05 };
    let levels = |full: usize| if campaign.quick { 2 } else { full };
    let tolerances: Vec<f64> =
        if campaign.quick { vec![1e-5, 1e-8] } else { (4..11).map(|k| 10f64.powi(-k)).collect() };
    let plans = [
        (Method::Variational(1), halvings(first, levels(6))),
        (Method::Variational(2), halvings(first, levels(6))),
        (Method::Variational(3), halvings(first, levels(5))),
        (Method::Variational(4), halvings(first, levels(4))),
        (Method::Variational(5), halvings(first, levels(4))),
        (Method::Variational(6), between(0.72 * first, first / 4.0, levels(6), problem.duration)),
        (Method::Variational(7), between(0.72 * first, first / 2.5, levels(5), problem.duration)),
        (Method::Rk4, halvings(first / 4.0, levels(6))),
        (Method::Gauss4, halvings(first / 4.0, levels(4))),
        (Method::DormandPrince, tolerances.clone()),
        (Method::Fehlberg, tolerances),
    ];
    campaign.say("beyond: all methods");
    let curves = problem.curves(campaign, &plans, CELLS[1] as f64)?;
    let target = if campaign.quick { 1e-8 } else { 1e-6 };
    let mut times = Map::new();
    for curve in &curves {
        times.insert(curve.method.key(), json!(time_at(curve, target).map(|t| t * 1e3)));
    }
    let least = |variational: bool| {
        curves
            .iter()
            .filter(|c| matches!(c.method, Method::Variational(_)) == variational)
            .filter_map(|c| time_at(c, target))
            .fold(f64::NAN, f64::min)
    };
    let of = |method: Method| {
        curves.iter().find(|c| c.method == method).and_then(|c| time_at(c, target)).unwrap_or(f64::NAN)
    };
    let mut part = Part { key: "beyond", ..Part::default() };
    let level = format!("{target:e} rad over {} s", problem.duration);
    for (name, time) in [
        ("RK4", of(Method::Rk4)),
        ("Dormand-Prince 5(4)", of(Method::DormandPrince)),
        ("Runge-Kutta-Fehlberg 7(8)", of(Method::Fehlberg)),
    ] {
        part.claims.push(Claim::at_least(
            format!("{name} over the best variational order: time at {level}"),
            time / least(true),
            1.0,
        ));
    }
    for (s, order) in orders(campaign)? {
        part.claims.push(Claim::at_least(
            format!("order of the variational integrator with s = {s}, over 1 s"),
            order,
            2.0 * s as f64 - 0.5,
        ));
    }
    part.facts = json!({
        "links": LINKS, "samples": samples, "duration_s": problem.duration,
        "time_ms_at_error_rad": { "error_rad": target, "time_ms": Value::Object(times) },
        "uncertainty_of_the_reference_rad": problem.uncertainty,
    });
    let mut table = Table::new(&HEADER);
    record(&mut table, &curves);
    part.files.push(("beyond.csv".into(), table.csv()));
    let colours = [5, 0, 2, 3, 6, 7, 4];
    let split = colours.len();
    let by_time = |p: &Point| (p.time * 1e3, p.error);
    let ours = lines(&curves[..split], &colours[..split], &by_time);
    let mut all = lines(&curves[1..split], &colours[1..split], &by_time);
    all.extend(lines(&curves[split..], &[1, 4, 5, 7], &by_time));
    let by_step = lines(&curves[..split], &colours[..split], &|p: &Point| (p.parameter * 1e3, p.error));
    let figure = Figure {
        columns: 3,
        panels: vec![
            Panel {
                legend: Legend::Beside,
                ..panel("Variational integrators", "time step (ms)", "error (rad)", by_step)
            },
            Panel {
                legend: Legend::Before,
                ..panel("Variational integrators", "time of 10 s (ms)", "error (rad)", ours)
            },
            Panel {
                legend: Legend::Beside,
                ..panel("Against Runge-Kutta methods", "time of 10 s (ms)", "error (rad)", all)
            },
        ],
    };
    campaign.draw("beyond", &figure)?;
    Ok(part)
}
