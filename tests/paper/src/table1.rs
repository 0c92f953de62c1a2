//! Table 1: variables and equations of a trajectory of `N` steps, `n` joints and `m` inputs per node, counted on problems that are built.
//!
//! | transcription | variables | equations |
//! |---|---|---|
//! | variational Simpson: `q` at all nodes, `p` at the boundaries, inputs | `(3N+2) n + (2N+1) m` | `3N n` |
//! | Hermite-Simpson, explicit dynamics: `q, q̇` at all nodes, inputs | `(4N+2) n + (2N+1) m` | `4N n` |
//! | Hermite-Simpson, implicit dynamics: `q, q̇, q̈` at all nodes, inputs | `(6N+3) n + (2N+1) m` | `(6N+1) n` |
//!
//! Every problem is a function from its vector of variables to its vector of equations. It is built, fed with a motion of its own
//! integrator, and has to vanish there; its sizes are then what was really used.

use std::f64::consts::PI;

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::prelude::*;
use serde_json::json;

use crate::articulated_body::ArticulatedBody;
use crate::hermite_simpson::{HermiteSimpson, Layout};
use crate::inverse_dynamics_derivatives::InverseDynamics;
use crate::pendulum::{Links, initial_conditions, pendulum};
use crate::results::{Claim, Part, Table, number};
use crate::{Campaign, Failure};

/// s.
const TIME_STEP: f64 = 0.01;
const TRANSCRIPTIONS: [&str; 3] =
    ["variational Simpson", "Hermite-Simpson, explicit", "Hermite-Simpson, implicit"];

/// Sizes and the largest equation at the motion.
#[derive(Clone, Copy, Debug)]
struct Built {
    variables: usize,
    equations: usize,
    residual: f64,
}

/// By the formulas of the table.
fn formula(transcription: usize, steps: usize, n: usize, m: usize) -> [usize; 2] {
    let inputs = (2 * steps + 1) * m;
    match transcription {
        0 => [(3 * steps + 2) * n + inputs, 3 * steps * n],
        1 => [(4 * steps + 2) * n + inputs, 4 * steps * n],
        _ => [(6 * steps + 3) * n + inputs, (6 * steps + 1) * n],
    }
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0f64, |m, x| m.max(x.abs()))
}

/// Equations of the variational transcription: rows `α = 0, 1` and the momentum at the end of every step. Variables: `q` node by node,
/// `p` boundary by boundary, inputs node by node.
fn variational_equations(tree: &KinematicTree, steps: usize, variables: &[f64]) -> Result<Vec<f64>, Failure> {
    let n = tree.dof();
    let (q, rest) = variables.split_at((2 * steps + 1) * n);
    let (p, inputs) = rest.split_at((steps + 1) * n);
    let mut del = DelWorkspace::new(tree, &LobattoRule::new(2)?, TIME_STEP, ForceCapacity::default())?;
    let mut equations = Vec::new();
    let mut rows = vec![0.0; 2 * n];
    let mut momentum = vec![0.0; n];
    let mut state = State::zeros(tree);
    for k in 0..steps {
        state.q.copy_from_slice(&q[2 * k * n..(2 * k + 1) * n]);
        state.p.copy_from_slice(&p[k * n..(k + 1) * n]);
        // The step reads the inputs of its three nodes; the boundaries are shared.
        del.begin(tree, &state, &StepForces::per_node(&inputs[2 * k * n..(2 * k + 3) * n]))?;
        for alpha in 1..=2 {
            for i in 0..n {
                del.set_node(alpha, i, q[(2 * k + alpha) * n + i]);
            }
        }
        del.evaluate(tree, &[]);
        del.residual_into(tree, &mut rows);
        del.next_momentum_into(tree, &mut momentum);
        equations.extend_from_slice(&rows);
        equations.extend(momentum.iter().zip(&p[(k + 1) * n..]).map(|(a, b)| a - b));
    }
    Ok(equations)
}

fn variational(tree: &KinematicTree, steps: usize, q0: &[f64], v0: &[f64]) -> Result<Built, Failure> {
    let n = tree.dof();
    let zero = vec![0.0; n];
    let rule = LobattoRule::new(2)?;
    let mut integrator = Integrator::new(tree, &rule, TIME_STEP, StepOptions::default())?;
    let mut state = State::zeros(tree);
    state.q.copy_from_slice(q0);
    integrator.velocities().set_velocity(tree, &mut state, v0)?;
    let (mut q, mut p) = (q0.to_vec(), state.p.clone());
    for _ in 0..steps {
        integrator.step(tree, &mut state, &StepForces::held(&zero))?;
        for alpha in 1..=2 {
            q.extend((0..n).map(|i| integrator.del().node(alpha, i)));
        }
        p.extend_from_slice(&state.p);
    }
    let mut variables = q;
    variables.append(&mut p);
    variables.extend(std::iter::repeat_n(0.0, (2 * steps + 1) * n));
    let equations = variational_equations(tree, steps, &variables)?;
    Ok(Built { variables: variables.len(), equations: equations.len(), residual: largest(&equations) })
}

/// Equations of Hermite-Simpson collocation. Variables: `q`, then `q̇`, then (implicit) `q̈`, then inputs, each node by node.
fn collocation_equations(
    tree: &KinematicTree,
    steps: usize,
    variables: &[f64],
    implicit: bool,
) -> Result<Vec<f64>, Failure> {
    let (n, nodes, h) = (tree.dof(), 2 * steps + 1, TIME_STEP);
    let size = nodes * n;
    let (q, v) = (&variables[..size], &variables[size..2 * size]);
    let inputs = &variables[variables.len() - size..];
    let mut equations = Vec::new();
    let mut accelerations = vec![0.0; size];
    if implicit {
        accelerations.copy_from_slice(&variables[2 * size..3 * size]);
        let mut dynamics = InverseDynamics::new(tree)?;
        let mut torque = vec![0.0; n];
        for k in 0..nodes {
            let at = k * n..(k + 1) * n;
            dynamics.torque_into(&q[at.clone()], &v[at.clone()], &accelerations[at.clone()], &mut torque);
            equations.extend(torque.iter().zip(&inputs[at]).map(|(t, u)| t - u));
        }
    } else {
        let mut dynamics = ArticulatedBody::new(tree)?;
        for k in 0..nodes {
            let at = k * n..(k + 1) * n;
            // q̈ = q̈(u = 0) + M⁻¹ u.
            let mut driven = inputs[at.clone()].to_vec();
            dynamics.acceleration_into(&q[at.clone()], &v[at.clone()], &mut accelerations[at.clone()]);
            dynamics.factor(&q[at.clone()]);
            dynamics.solve(&mut driven);
            for (a, d) in accelerations[at].iter_mut().zip(&driven) {
                *a += d;
            }
        }
    }
    for (x, rate) in [(q, v), (v, accelerations.as_slice())] {
        for k in 0..steps {
            for i in 0..n {
                let node = |values: &[f64], alpha: usize| values[(2 * k + alpha) * n + i];
                let middle = 0.5 * (node(x, 0) + node(x, 2)) + h / 8.0 * (node(rate, 0) - node(rate, 2));
                let simpson = h / 6.0 * (node(rate, 0) + 4.0 * node(rate, 1) + node(rate, 2));
                equations.push(node(x, 1) - middle);
                equations.push(node(x, 2) - node(x, 0) - simpson);
            }
        }
    }
    Ok(equations)
}

fn collocation(
    tree: &KinematicTree,
    steps: usize,
    q0: &[f64],
    v0: &[f64],
    implicit: bool,
) -> Result<Built, Failure> {
    let size = (2 * steps + 1) * tree.dof();
    let mut work = HermiteSimpson::new(tree, TIME_STEP, Layout::Reduced, 1e-16)?;
    work.begin(q0, v0);
    let mut nodes = [q0.to_vec(), v0.to_vec(), work.acceleration().to_vec()];
    for _ in 0..steps {
        work.step()?;
        for (list, values) in nodes.iter_mut().zip(work.step_nodes()) {
            list.extend_from_slice(&values);
        }
    }
    let kept = if implicit { 3 } else { 2 };
    let mut variables: Vec<f64> = nodes.iter().take(kept).flatten().copied().collect();
    variables.extend(std::iter::repeat_n(0.0, size));
    let equations = collocation_equations(tree, steps, &variables, implicit)?;
    Ok(Built { variables: variables.len(), equations: equations.len(), residual: largest(&equations) })
}

fn build(transcription: usize, steps: usize, n: usize) -> Result<Built, Failure> {
    let tree = pendulum(Links::Rods, n)?;
    let start = &initial_conditions(n, 1, PI / 12.0, 1)[0];
    match transcription {
        0 => variational(&tree, steps, &start.q, &start.v),
        1 => collocation(&tree, steps, &start.q, &start.v, false),
        _ => collocation(&tree, steps, &start.q, &start.v, true),
    }
}

/// Runs it.
///
/// # Errors
/// A model that does not build; a motion that fails.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    campaign.say("table 1");
    let mut part = Part { key: "table_1", ..Part::default() };
    let header = ["transcription", "steps", "joints", "inputs", "variables", "equations", "largest_equation"];
    let mut table = Table::new(&header);
    let (mut wrong, mut worst) = (0, 0.0f64);
    for (steps, n) in [(1, 2), (5, 4), (20, 12)] {
        for (transcription, name) in TRANSCRIPTIONS.iter().enumerate() {
            let built = build(transcription, steps, n)?;
            if formula(transcription, steps, n, n) != [built.variables, built.equations] {
                wrong += 1;
            }
            worst = worst.max(built.residual);
            table.push(vec![
                name.replace(", ", " "),
                steps.to_string(),
                n.to_string(),
                n.to_string(),
                built.variables.to_string(),
                built.equations.to_string(),
                number(built.residual),
            ]);
        }
    }
    part.claims = vec![
        Claim::at_most("table 1: problems whose sizes differ from the formulas", f64::from(wrong), 0.0),
        Claim::at_most(
            "table 1: largest equation at the motion of the own integrator (N m s, rad)",
            worst,
            1e-9,
        ),
    ];
    part.facts = json!({
        "variational_simpson": { "variables": "(3N+2)n + (2N+1)m", "equations": "3Nn" },
        "hermite_simpson_explicit": { "variables": "(4N+2)n + (2N+1)m", "equations": "4Nn" },
        "hermite_simpson_implicit": { "variables": "(6N+3)n + (2N+1)m", "equations": "(6N+1)n" },
    });
    part.files.push(("table_1.csv".into(), table.csv()));
    campaign.tick(1.0);
    Ok(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn problems_have_the_sizes_of_the_formulas_and_vanish_at_the_motion() {
        for (steps, n) in [(1, 1), (3, 2), (2, 5)] {
            for transcription in 0..3 {
                let built = build(transcription, steps, n).unwrap();
                assert_eq!([built.variables, built.equations], formula(transcription, steps, n, n));
                assert!(built.residual < 1e-10, "{}: {:e}", TRANSCRIPTIONS[transcription], built.residual);
            }
        }
    }

    /// The equations see a wrong motion.
    #[test]
    fn equations_do_not_vanish_elsewhere() {
        let tree = pendulum(Links::Rods, 2).unwrap();
        assert!(largest(&variational_equations(&tree, 1, &[0.1; 16]).unwrap()) > 1e-3);
        assert!(largest(&collocation_equations(&tree, 1, &[0.1; 18], false).unwrap()) > 1e-3);
        assert!(largest(&collocation_equations(&tree, 1, &[0.1; 24], true).unwrap()) > 1e-3);
    }
}
