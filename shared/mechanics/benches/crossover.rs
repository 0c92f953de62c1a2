//! Where the O(n) factorisation overtakes the branch-sparse one, and the O(n²) linearisation the matrix path.
//!
//! `cargo bench -p delmpc-mechanics --bench crossover` prints two tables over trees of growing depth; the constants `CROSSOVER_DEPTH` of
//! `newton_direction.rs` and `CROSSOVER_LINEARIZATION` of `linearize.rs` are read off them. Depth is the root mean square (first table)
//! or the mean (second table) of the lengths of the branches. Every figure is the least of several medians, µs; both columns of a row
//! are measured in turns.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/oracle/mod.rs"]
mod oracle;

use std::hint::black_box;
use std::time::Instant;

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::newton_direction::NewtonSolver;
use delmpc_mechanics::prelude::*;

const TIME_STEP: f64 = 0.005;

/// Least medians of two calls measured in turns, µs.
fn times(mut first: impl FnMut(), mut second: impl FnMut()) -> [f64; 2] {
    let mut best = [f64::INFINITY; 2];
    let mut samples = [0.0; 15];
    for _ in 0..9 {
        for (k, best) in best.iter_mut().enumerate() {
            for sample in &mut samples {
                let start = Instant::now();
                if k == 0 {
                    first()
                } else {
                    second()
                }
                *sample = start.elapsed().as_secs_f64() * 1e6;
            }
            samples.sort_by(f64::total_cmp);
            *best = best.min(samples[samples.len() / 2]);
        }
    }
    best
}

/// `branches` equal chains of `length` links that share the first link.
fn star(branches: usize, length: usize) -> KinematicTree {
    let inertia = Matrix3::from_diagonal(&Vector3::new(0.01, 0.01, 0.001));
    let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.05), inertia);
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let placement = |z: f64| RigidTransform::from_translation(Vector3::new(0.0, 0.0, z));
    let root = builder.add(Body::new(None, Joint::revolute(Vector3::y(), placement(0.0)), rod));
    for _ in 0..branches {
        let mut parent = root;
        for _ in 1..length {
            parent =
                builder.add(Body::new(Some(parent), Joint::revolute(Vector3::y(), placement(-0.1)), rod));
        }
    }
    builder.build().unwrap()
}

fn spread(n: usize, size: f64) -> Vec<f64> {
    (0..n).map(|k| size * ((k as f64 + 1.0) * 12.9898).sin()).collect()
}

fn place(tree: &KinematicTree, rule: &LobattoRule, del: &mut DelWorkspace, q: &[f64]) {
    let mut state = State::zeros(tree);
    state.q.copy_from_slice(q);
    let torque = vec![0.0; tree.dof()];
    del.begin(tree, &state, &StepForces::held(&torque)).unwrap();
    for (dof, rate) in spread(tree.dof(), 0.2).into_iter().enumerate() {
        for alpha in 1..=rule.unknown_nodes() {
            del.set_node(alpha, dof, q[dof] + rate * rule.nodes()[alpha] * TIME_STEP);
        }
    }
    del.evaluate(tree, &[]);
}

fn depths(tree: &KinematicTree) -> (f64, f64) {
    let lengths = (0..tree.body_count()).map(|i| tree.branch(i).len() as f64);
    let n = tree.body_count() as f64;
    (lengths.clone().map(|l| l * l / n).sum::<f64>().sqrt(), lengths.sum::<f64>() / n)
}

fn main() {
    let atlas = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let mut trees = vec![("Atlas on its foot".to_owned(), atlas.tree.clone(), atlas.state.q.clone())];
    for (branches, lengths) in [(1, vec![8, 12, 16, 20, 24, 32, 48, 64]), (4, vec![6, 8, 12, 16, 20, 24, 32])]
    {
        for length in lengths {
            let tree = star(branches, length);
            let q = spread(tree.dof(), 0.3);
            trees.push((format!("{branches} x {length}"), tree, q));
        }
    }
    println!("factor + solve, µs: branch LU / Algorithm B.1\n");
    println!("| tree | n | rms depth | s = 1 | s = 2 | s = 3 | s = 4 |\n|---|---|---|---|---|---|---|");
    for (name, tree, q) in &trees {
        let mut cells = Vec::new();
        for s in 1..=4 {
            let rule = LobattoRule::new(s).unwrap();
            let mut del = DelWorkspace::new(tree, &rule, TIME_STEP, ForceCapacity::default()).unwrap();
            place(tree, &rule, &mut del, q);
            let mut solvers = [NewtonMethod::BranchLu, NewtonMethod::Recursive]
                .map(|method| NewtonSolver::new(method, tree, &del));
            let mut vectors = [vec![0.0; s * tree.dof()], vec![0.0; s * tree.dof()]];
            let run = |solver: &mut NewtonSolver, vector: &mut [f64]| {
                solver.factor(tree, black_box(&del)).unwrap();
                vector.fill(1.0);
                solver.solve(tree, vector);
                black_box(vector);
            };
            let ([lu, recursive], [one, two]) = (&mut solvers, &mut vectors);
            let [a, b] = times(|| run(lu, one), || run(recursive, two));
            cells.push(format!("{a:.1} / {b:.1}"));
        }
        println!("| {name} | {} | {:.1} | {} |", tree.dof(), depths(tree).0, cells.join(" | "));
    }
    println!("\nA and B of a solved step in (q, p), µs: matrix path / recursion over columns\n");
    println!("| tree | n | mean depth | s = 1 | s = 2 | s = 3 |\n|---|---|---|---|---|---|");
    for (name, tree, q) in &trees {
        let mut cells = Vec::new();
        for s in 1..=3 {
            let rule = LobattoRule::new(s).unwrap();
            let options = StepOptions {
                method: Some(NewtonMethod::BranchLu),
                dense_fallback: 0,
                ..StepOptions::default()
            };
            let mut integrators = [0, 1].map(|_| {
                let mut integrator = Integrator::new(tree, &rule, TIME_STEP, options).unwrap();
                place(tree, &rule, integrator.del_and_solver().0, q);
                let coordinates = StateCoordinates::Momentum;
                let work = Linearizer::new(tree, &integrator, coordinates, InputHold::Held).unwrap();
                (integrator, work)
            });
            let [one, two] = &mut integrators;
            let [a, b] = times(
                || {
                    black_box(one.1.linearize_by_matrix(tree, &mut one.0).unwrap());
                },
                || {
                    black_box(two.1.linearize_by_recursion(tree, &mut two.0).unwrap());
                },
            );
            cells.push(format!("{a:.0} / {b:.0}"));
        }
        println!("| {name} | {} | {:.1} | {} |", tree.dof(), depths(tree).1, cells.join(" | "));
    }
}
