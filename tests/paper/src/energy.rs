//! Energy over a hundred seconds: all orders of the variational integrator against Hermite-Simpson, RK4 and Gauss-Legendre 4.
//!
//! The 12-link pendulum from small random initial conditions. Energy at every step, relative to what the motion has above rest,
//! `E_0 - E_rest`. Figures per method and time step: the largest error over all initial conditions, and the trend: the mean error of the
//! second half minus that of the first, as a share of the largest error of the motion, mean over the initial conditions. The motion
//! is chaotic: a fast flip of a link may shift the energy once and for all, up or down. A secular trend is one that initial conditions
//! agree on: more than three standard errors from zero.

use std::f64::consts::PI;

use delmpc_mechanics::prelude::*;
use delmpc_mechanics::velocity::VelocityWorkspace;
use serde_json::json;

use crate::hermite_simpson::{HermiteSimpson, Layout};
use crate::pendulum::{Initial, Links, initial_conditions, pendulum};
use crate::plot::{Figure, Legend, Line, Panel, Scale, Style};
use crate::results::{Claim, Part, Table, number};
use crate::runge_kutta::{ClassicalRk4, GaussLegendre4};
use crate::trajectory::Method;
use crate::{Campaign, Failure};

const LINKS: usize = 12;
/// s; the second one carries the bars.
const TIME_STEPS: [f64; 3] = [0.02, 0.01, 0.005];
const BAR_STEP: f64 = 0.01;
const METHODS: [Method; 8] = [
    Method::Variational(1),
    Method::Variational(2),
    Method::Variational(3),
    Method::Variational(4),
    Method::Variational(6),
    Method::HermiteSimpson,
    Method::Rk4,
    Method::Gauss4,
];
/// All iterations end at round-off (rad).
const ROUND_OFF_CHANGE: f64 = 1e-18;
/// Errors below are round-off, which wanders.
const ROUND_OFF: f64 = 1e-11;
/// Standard errors.
const SIGNIFICANT: f64 = 3.0;
/// Points of a plotted line.
const PLOTTED: usize = 400;

/// Energy of states given by rates or momenta.
struct Meter {
    tree: KinematicTree,
    velocities: VelocityWorkspace,
    state: State,
    start: f64,
    rest: f64,
}

impl Meter {
    fn new(tree: &KinematicTree, initial: &Initial) -> Result<Self, Failure> {
        let mut velocities = VelocityWorkspace::new(tree);
        let state = State::zeros(tree);
        let (_, rest) = velocities.energy(tree, &state)?;
        let mut meter = Self { tree: tree.clone(), velocities, state, start: 0.0, rest };
        meter.start = meter.of_rates(&initial.q, &initial.v)?;
        Ok(meter)
    }

    fn of_rates(&mut self, q: &[f64], v: &[f64]) -> Result<f64, Failure> {
        self.state.q.copy_from_slice(q);
        self.velocities.set_velocity(&self.tree, &mut self.state, v)?;
        let (kinetic, potential) = self.velocities.energy(&self.tree, &self.state)?;
        Ok(kinetic + potential)
    }

    fn relative(&self, energy: f64) -> f64 {
        (energy - self.start) / (self.start - self.rest)
    }
}

/// `(E - E_0)/(E_0 - E_rest)` after every step.
fn errors(
    tree: &KinematicTree,
    method: Method,
    time_step: f64,
    duration: f64,
    initial: &Initial,
) -> Result<Vec<f64>, Failure> {
    let mut meter = Meter::new(tree, initial)?;
    let steps = (duration / time_step).round() as usize;
    let mut list = Vec::with_capacity(steps);
    match method {
        Method::Variational(s) => {
            let rule = LobattoRule::new(s)?;
            let mut integrator = Integrator::new(tree, &rule, time_step, StepOptions::default())?;
            let mut state = State::zeros(tree);
            state.q.copy_from_slice(&initial.q);
            integrator.velocities().set_velocity(tree, &mut state, &initial.v)?;
            let zero = vec![0.0; tree.dof()];
            for _ in 0..steps {
                integrator.step(tree, &mut state, &StepForces::held(&zero))?;
                let (kinetic, potential) = meter.velocities.energy(tree, &state)?;
                list.push(meter.relative(kinetic + potential));
            }
        }
        Method::HermiteSimpson => {
            let mut work = HermiteSimpson::new(tree, time_step, Layout::Reduced, ROUND_OFF_CHANGE)?;
            work.begin(&initial.q, &initial.v);
            for _ in 0..steps {
                work.step()?;
                let energy = meter.of_rates(&work.q, &work.v)?;
                list.push(meter.relative(energy));
            }
        }
        Method::Gauss4 => {
            let mut work = GaussLegendre4::new(tree, time_step, ROUND_OFF_CHANGE)?;
            work.begin(&initial.q, &initial.v);
            for _ in 0..steps {
                if !work.step() {
                    return Err(Failure::FixedPoint { time_step });
                }
                let energy = meter.of_rates(work.q(), work.v())?;
                list.push(meter.relative(energy));
            }
        }
        _ => {
            let mut work = ClassicalRk4::new(tree, time_step)?;
            work.begin(&initial.q, &initial.v);
            for _ in 0..steps {
                work.step();
                let energy = meter.of_rates(work.q(), work.v())?;
                list.push(meter.relative(energy));
            }
        }
    }
    Ok(list)
}

/// Largest error and trend of a motion.
fn summary(errors: &[f64]) -> (f64, f64) {
    let largest = errors.iter().fold(0.0f64, |m, e| if e.is_nan() { f64::NAN } else { m.max(e.abs()) });
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (first, second) = errors.split_at(errors.len() / 2);
    (largest, (mean(second) - mean(first)) / largest.max(ROUND_OFF))
}

/// Mean, and its distance from zero in standard errors (0 for a single number).
fn significance(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    if values.len() < 2 {
        return (mean, 0.0);
    }
    let variance = values.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / (n - 1.0);
    (mean, mean.abs() / (variance / n).sqrt())
}

/// Largest error of every stretch of time, for the plot.
fn envelope(errors: &[f64], time_step: f64) -> Vec<(f64, f64)> {
    let stride = errors.len().div_ceil(PLOTTED);
    errors
        .chunks(stride)
        .enumerate()
        .map(|(k, part)| {
            let largest = part.iter().fold(0.0f64, |m, e| m.max(e.abs()));
            (((k + 1) * stride) as f64 * time_step, largest.max(1e-16))
        })
        .collect()
}

/// Cells of the campaign.
pub const CELLS: usize = TIME_STEPS.len() * METHODS.len();

/// Runs it.
///
/// # Errors
/// A model that does not build; a picture that cannot be drawn.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    let tree = pendulum(Links::Rods, LINKS)?;
    let (samples, duration) = if campaign.quick { (1, 2.0) } else { (8, 100.0) };
    let initial = initial_conditions(LINKS, samples, PI / 12.0, campaign.seed);
    let mut table = Table::new(&[
        "method",
        "time_step_s",
        "largest_error",
        "trend",
        "trend_in_standard_errors",
        "failed",
    ]);
    let mut lines = Vec::new();
    let mut bars = Vec::new();
    for time_step in TIME_STEPS {
        for (index, method) in METHODS.into_iter().enumerate() {
            campaign.say(&format!("energy: {}, {:.0} ms", method.key(), time_step * 1e3));
            let (mut largest, mut trends, mut failed) = (0.0f64, Vec::new(), 0usize);
            for (k, initial) in initial.iter().enumerate() {
                match errors(&tree, method, time_step, duration, initial) {
                    Ok(errors) => {
                        let (error, drift) = summary(&errors);
                        // A motion that is no longer a number stays the worst.
                        if error.is_nan() || error > largest {
                            largest = error;
                        }
                        trends.push(drift);
                        if k == 0 && time_step == BAR_STEP {
                            lines.push(Line {
                                title: method.title(),
                                style: if matches!(method, Method::Variational(_)) {
                                    Style::Line
                                } else {
                                    Style::Dashed
                                },
                                colour: [5, 0, 2, 3, 7, 6, 1, 4][index],
                                points: envelope(&errors, time_step),
                            });
                        }
                    }
                    Err(Failure::Step(_) | Failure::Collocation(_) | Failure::FixedPoint { .. }) => {
                        failed += 1
                    }
                    Err(other) => return Err(other),
                }
            }
            let (trend, certain) = significance(&trends);
            table.push(vec![
                method.key(),
                number(time_step),
                number(largest),
                number(trend),
                number(certain),
                failed.to_string(),
            ]);
            if time_step == BAR_STEP {
                bars.push((method, largest, trend, certain, failed));
            }
            campaign.tick(1.0);
        }
    }
    let mut part = Part { key: "energy", ..Part::default() };
    let best = bars
        .iter()
        .filter(|(method, _, _, _, failed)| matches!(method, Method::Variational(_)) && *failed == 0)
        .fold(f64::NAN, |m, (_, error, ..)| m.min(*error));
    let name = format!("12 links, 10 ms steps, {duration} s");
    part.claims.push(Claim::at_most(
        format!("energy error of the best variational order, {name}"),
        best,
        1e-6,
    ));
    for (method, _, _, certain, failed) in &bars {
        if matches!(method, Method::Variational(_)) {
            part.claims.push(Claim::at_most(
                format!("energy trend in standard errors, {}, {name}", method.title()),
                if *failed == 0 { *certain } else { f64::NAN },
                SIGNIFICANT,
            ));
        }
    }
    part.facts = json!({
        "samples": samples,
        "at_10_ms": bars
            .iter()
            .map(|(method, error, trend, certain, failed)| json!({
                "method": method.key(), "largest_error": error, "trend": trend, "trend_in_standard_errors": certain, "failed": failed,
            }))
            .collect::<Vec<_>>(),
    });
    part.files.push(("energy.csv".into(), table.csv()));
    let figure = Figure {
        columns: 1,
        panels: vec![Panel {
            title: "Energy error, 12 links, steps of 10 ms".into(),
            x_label: "time (s)".into(),
            y_label: "|E - E0| / (E0 - E_rest)".into(),
            x: Scale::Linear,
            y: Scale::Log,
            x_range: Some((0.0, duration)),
            y_range: None,
            lines,
            legend: Legend::Beside,
        }],
    };
    campaign.draw("energy", &figure)?;
    Ok(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A steady drift is found, a bounded error and single jumps of either sign are not.
    #[test]
    fn trends_are_told_from_jumps() {
        let drift = |k: usize| -> Vec<f64> {
            (0..1000).map(|i| 1e-6 * (i as f64 + 50.0 * ((i * (k + 3)) as f64).sin())).collect()
        };
        let jump = |k: usize| -> Vec<f64> {
            let size = if k.is_multiple_of(2) { 1e-4 } else { -1.2e-4 };
            (0..1000).map(|i| if i > 100 * k { size } else { 0.0 } + 1e-5 * (i as f64).sin()).collect()
        };
        let certain = |motion: &dyn Fn(usize) -> Vec<f64>| {
            let trends: Vec<f64> = (1..7).map(|k| summary(&motion(k)).1).collect();
            significance(&trends).1
        };
        assert!(certain(&drift) > 10.0 * SIGNIFICANT);
        assert!(certain(&jump) < SIGNIFICANT);
    }
}
