//! Figure 2: Simpson, pendulums of 4 to 256 links: DEL evaluation, Newton direction and linearisation against automatic differentiation.
//!
//! A sample is a set of nodes on the straight line of a random initial condition. Nothing in the work depends on the values, so every
//! time is the least over samples and calls: the work without what else the machine does. The steep rivals run on fewer samples, as
//! many as fit a fixed time, at least one; the longest chains only where that takes seconds, not minutes. Every size also compares the
//! numbers of the two sides.

use std::f64::consts::FRAC_PI_2;

use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod};
use delmpc_mechanics::prelude::*;
use serde_json::json;

use crate::automatic::{Automatic, Depth};
use crate::pendulum::{Initial, Links, initial_conditions, pendulum};
use crate::plot::{Figure, Legend, Line, Panel, Scale, Style};
use crate::results::{Claim, Part, Table, number};
use crate::stopwatch::{batched, exponent, least, once};
use crate::{Campaign, Failure};

const SIZES: [usize; 7] = [4, 8, 16, 32, 64, 128, 256];
/// Where the paper's bars are measured.
const MIDDLE: usize = 32;
/// s.
const TIME_STEP: f64 = 0.001;
/// Rates are differences of angles over the step: `ε/Δt` is 2e-13, a sum of 256 of them ten times that.
const RATE_ROUNDING: f64 = 1e-11;
/// Simpson.
const UNKNOWN_NODES: usize = 2;

const OURS: usize = 0;
const AD: usize = 1;
const STRONG: usize = 2;
const BRANCH: usize = 3;
const RIVALS: [(&str, &str); 4] = [
    ("ours", "O(n) recursions"),
    ("ad_lagrangian", "AD of the Lagrangian"),
    ("ad_gradient", "AD of Algorithm 1"),
    ("branch_lu", "branch LU, matrix path"),
];
const TASKS: [(&str, &str); 3] = [
    ("evaluation", "DEL evaluation"),
    ("newton_direction", "Newton direction"),
    ("linearization", "Linearisation A, B"),
];

/// Times (s) of one size: task, rival.
type Times = [[Option<f64>; 4]; 3];

struct Size {
    links: usize,
    times: Times,
    /// Largest relative difference between ours and the strongest rival: residual, direction, linearisation.
    differences: [f64; 3],
}

/// Cells of the campaign.
pub const CELLS: usize = SIZES.len();

/// Whether a rival takes seconds, not minutes, on a chain.
fn affordable(campaign: &Campaign, rival: usize, task: usize, links: usize) -> bool {
    let most = match (rival, task) {
        (AD, 0) => 256,
        (AD, _) => 128,
        _ => 256,
    };
    links <= if campaign.quick { most.min(MIDDLE) } else { most }
}

/// One integrator with its nodes on a sample, for one factorisation.
struct Ours {
    tree: KinematicTree,
    integrator: Integrator,
    linearizer: Linearizer,
    residual: Vec<f64>,
    direction: Vec<f64>,
}

impl Ours {
    fn new(tree: &KinematicTree, method: NewtonMethod) -> Result<Self, Failure> {
        let rule = LobattoRule::new(UNKNOWN_NODES)?;
        let options = StepOptions { method: Some(method), dense_fallback: 0, ..StepOptions::default() };
        let integrator = Integrator::new(tree, &rule, TIME_STEP, options)?;
        let coordinates = StateCoordinates::Momentum;
        let order = UNKNOWN_NODES * tree.dof();
        Ok(Self {
            linearizer: Linearizer::new(tree, &integrator, coordinates, InputHold::Held)?,
            tree: tree.clone(),
            integrator,
            residual: vec![0.0; order],
            direction: vec![0.0; order],
        })
    }

    fn set(&mut self, points: &[Vec<f64>], state: &State) -> Result<(), Failure> {
        let zero = vec![0.0; self.tree.dof()];
        let (del, _) = self.integrator.del_and_solver();
        del.begin(&self.tree, state, &StepForces::held(&zero))?;
        for (alpha, point) in points.iter().enumerate().skip(1) {
            for (i, q) in point.iter().enumerate() {
                del.set_node(alpha, i, *q);
            }
        }
        self.evaluate();
        self.newton()?;
        Ok(())
    }

    fn evaluate(&mut self) {
        let (del, _) = self.integrator.del_and_solver();
        del.evaluate(&self.tree, &[]);
        del.residual_into(&self.tree, &mut self.residual);
    }

    fn newton(&mut self) -> Result<(), Failure> {
        let (del, solver) = self.integrator.del_and_solver();
        solver.factor(&self.tree, del)?;
        for (x, r) in self.direction.iter_mut().zip(&self.residual) {
            *x = -r;
        }
        solver.solve(&self.tree, &mut self.direction);
        Ok(())
    }

    fn linearize(&mut self, by_matrix: bool) -> Result<(), Failure> {
        if by_matrix {
            self.linearizer.linearize_by_matrix(&self.tree, &mut self.integrator)?;
        } else {
            self.linearizer.linearize_by_recursion(&self.tree, &mut self.integrator)?;
        }
        Ok(())
    }
}

/// Least time of as many samples as fit `budget` (s).
fn sampled(
    samples: usize,
    budget: f64,
    mut time: impl FnMut(usize) -> Result<f64, Failure>,
) -> Result<f64, Failure> {
    let mut times = Vec::new();
    let mut spent = 0.0;
    for k in 0..samples {
        let (seconds, value) = once(|| time(k));
        times.push(value?);
        spent += seconds;
        if spent > budget {
            break;
        }
    }
    Ok(times.into_iter().fold(f64::INFINITY, f64::min))
}

fn measure(campaign: &Campaign, links: usize) -> Result<Size, Failure> {
    let (samples, budget) = if campaign.quick { (5, 0.15) } else { (100, 3.0) };
    let tree = pendulum(Links::Rods, links)?;
    let rule = LobattoRule::new(UNKNOWN_NODES)?;
    let mut recursive = Ours::new(&tree, NewtonMethod::Recursive)?;
    let mut branch = Ours::new(&tree, NewtonMethod::BranchLu)?;
    let mut automatic = Automatic::new(&tree, &rule, TIME_STEP)?;
    let initial = initial_conditions(links, samples, FRAC_PI_2, campaign.seed);
    let points = |initial: &Initial| -> Vec<Vec<f64>> {
        let at = |c: &f64| initial.q.iter().zip(&initial.v).map(|(q, v)| q + c * TIME_STEP * v).collect();
        rule.nodes().iter().map(at).collect()
    };
    let mut velocities = delmpc_mechanics::velocity::VelocityWorkspace::new(&tree);
    let states: Vec<State> = initial
        .iter()
        .map(|initial| {
            let mut state = State::zeros(&tree);
            state.q.copy_from_slice(&initial.q);
            velocities.set_velocity(&tree, &mut state, &initial.v).map(|()| state)
        })
        .collect::<Result<_, _>>()?;
    let mut times: Times = Default::default();
    // Batches long enough for the clock; single calls are long from here on.
    let short = if campaign.quick { 2e-5 } else { 5e-5 };
    times[0][OURS] = Some(sampled(samples, budget, |k| {
        recursive.set(&points(&initial[k]), &states[k])?;
        Ok(batched(short, || recursive.evaluate()))
    })?);
    for (column, work) in [(OURS, &mut recursive), (BRANCH, &mut branch)] {
        times[1][column] = Some(sampled(samples, budget, |k| {
            work.set(&points(&initial[k]), &states[k])?;
            Ok(batched(short, || work.newton().is_ok()))
        })?);
        times[2][column] = Some(sampled(samples, budget, |k| {
            work.set(&points(&initial[k]), &states[k])?;
            work.linearize(column == BRANCH)?;
            Ok(least(3, || work.linearize(column == BRANCH).is_ok()))
        })?);
    }
    for (column, depth) in [(AD, Depth::Lagrangian), (STRONG, Depth::Gradient)] {
        for task in 0..TASKS.len() {
            // The gradient by hand is Algorithm 1 itself: nothing to differentiate.
            if (column, task) == (STRONG, 0) || !affordable(campaign, column, task, links) {
                continue;
            }
            times[task][column] = Some(sampled(samples, budget, |k| {
                automatic.set(&points(&initial[k]), &states[k].p);
                let residual = automatic.residual(Depth::Gradient);
                Ok(least(2, || match task {
                    0 => drop(automatic.residual(depth)),
                    1 => drop(automatic.newton_direction(depth, &residual)),
                    _ => drop(automatic.linearization(depth)),
                }))
            })?);
        }
        campaign.tick(0.5);
    }
    let differences = compare(&mut recursive, &mut automatic, &points(&initial[0]), &states[0])?;
    Ok(Size { links, times, differences })
}

/// Largest differences relative to the largest entry.
fn compare(
    ours: &mut Ours,
    automatic: &mut Automatic,
    points: &[Vec<f64>],
    state: &State,
) -> Result<[f64; 3], Failure> {
    ours.set(points, state)?;
    automatic.set(points, &state.p);
    let relative = |pairs: &mut dyn Iterator<Item = (f64, f64)>| {
        let (worst, size) =
            pairs.fold((0.0f64, 0.0f64), |(d, m), (a, b)| (d.max((a - b).abs()), m.max(a.abs())));
        worst / size
    };
    let residual = automatic.residual(Depth::Lagrangian);
    // Momenta cancel in the residual: what counts is its size beside them.
    let largest = state.p.iter().fold(0.0f64, |m, p| m.max(p.abs()));
    let error = ours.residual.iter().zip(&residual).fold(0.0f64, |m, (a, b)| m.max((a - b).abs())) / largest;
    let direction = automatic.newton_direction(Depth::Gradient, &ours.residual);
    let direction =
        direction.map_or(f64::NAN, |x| relative(&mut ours.direction.iter().copied().zip(x.iter().copied())));
    ours.linearize(false)?;
    let n = ours.tree.dof();
    let matrix = ours.linearizer.linear_step().matrix();
    let linear = automatic.linearization(Depth::Gradient).map_or(f64::NAN, |ab| {
        relative(
            &mut (0..2 * n)
                .flat_map(|r| (0..3 * n).map(move |c| (r, c)))
                .map(|(r, c)| (matrix.get(r, c), ab[(r, c)])),
        )
    });
    Ok([error, direction, linear])
}

/// Runs it.
///
/// # Errors
/// A model that does not build; a picture that cannot be drawn.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    let mut sizes = Vec::new();
    for links in SIZES {
        campaign.say(&format!("figure 2: {links} links"));
        sizes.push(measure(campaign, links)?);
    }
    let mut part = Part { key: "figure_2", ..Part::default() };
    let mut table = Table::new(&["links", "task", "rival", "time_us"]);
    for size in &sizes {
        for (task, (key, _)) in TASKS.iter().enumerate() {
            for (rival, (name, _)) in RIVALS.iter().enumerate() {
                if let Some(time) = size.times[task][rival] {
                    table.push(vec![
                        size.links.to_string(),
                        (*key).into(),
                        (*name).into(),
                        number(time * 1e6),
                    ]);
                }
            }
        }
    }
    let ratio = |task: usize, rival: usize| {
        let middle = sizes.iter().find(|size| size.links == MIDDLE)?;
        Some(middle.times[task][rival]? / middle.times[task][OURS]?)
    };
    let slope = |task: usize, rival: usize| {
        let long = sizes.iter().filter(|size| size.links >= MIDDLE);
        let points: Vec<(f64, f64)> =
            long.filter_map(|size| Some((size.links as f64, size.times[task][rival]?))).collect();
        exponent(&points)
    };
    let bars = [(5.0, 1.1), (50.0, 1.1), (50.0, 2.1)];
    for (task, (faster, steepness)) in bars.into_iter().enumerate() {
        let title = TASKS[task].1;
        part.claims.push(Claim::at_least(
            format!("{title}, 32 links: times faster than automatic differentiation of the Lagrangian"),
            ratio(task, AD).unwrap_or(f64::NAN),
            faster,
        ));
        part.claims.push(Claim::at_most(
            format!("{title}: exponent of the time over 32 to 256 links"),
            slope(task, OURS),
            steepness,
        ));
    }
    let worst = |what: usize| sizes.iter().map(|size| size.differences[what]).fold(0.0, f64::max);
    part.claims.push(Claim::at_most(
        "automatic differentiation gives the same residuals (relative to the momenta), all sizes",
        worst(0),
        RATE_ROUNDING,
    ));
    part.claims.push(Claim::at_most(
        "automatic differentiation gives the same Newton direction, relative, all sizes",
        worst(1),
        1e-6,
    ));
    part.claims.push(Claim::at_most(
        "automatic differentiation gives the same A and B, relative, all sizes",
        worst(2),
        1e-6,
    ));
    let exponents: Vec<_> = (0..3)
        .map(|task| json!({ "task": TASKS[task].0, "ours": slope(task, OURS), "ad_gradient": slope(task, STRONG) }))
        .collect();
    part.facts = json!({
        "times_faster_than_ad_of_algorithm_1_at_32_links": {
            "newton_direction": ratio(1, STRONG),
            "linearization": ratio(2, STRONG),
        },
        "exponents_32_to_256": exponents,
        "links": SIZES,
        "differences": sizes.iter().map(|size| size.differences).collect::<Vec<_>>(),
        "samples": if campaign.quick { 5 } else { 100 },
    });
    part.files.push(("figure_2.csv".into(), table.csv()));
    campaign.draw("figure_2", &figure(&sizes))?;
    Ok(part)
}

fn figure(sizes: &[Size]) -> Figure {
    let panels = TASKS
        .iter()
        .enumerate()
        .map(|(task, (_, title))| Panel {
            title: (*title).into(),
            x_label: "links".into(),
            y_label: "time (µs)".into(),
            x: Scale::Log,
            y: Scale::Log,
            x_range: None,
            y_range: None,
            legend: Legend::Corner,
            lines: RIVALS
                .iter()
                .enumerate()
                .map(|(rival, (_, name))| Line {
                    title: (*name).into(),
                    style: if rival == BRANCH { Style::Dashed } else { Style::Mark },
                    colour: [0, 1, 3, 2][rival],
                    points: sizes
                        .iter()
                        .filter_map(|size| Some((size.links as f64, size.times[task][rival]? * 1e6)))
                        .collect(),
                })
                .filter(|line| !line.points.is_empty())
                .collect(),
        })
        .collect();
    Figure { columns: 3, panels }
}
