//! Times of the mechanics on one core: Atlas rooted at its foot (30 joints) and planar chains.
//!
//! `cargo bench -p delmpc-mechanics --bench speed`. Every figure is the least of eleven medians; inputs are built and seeded outside
//! the loop. Times depend on the machine: quote them with it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/oracle/mod.rs"]
mod oracle;

use std::hint::black_box;
use std::time::Instant;

use delmpc_mechanics::del_hessian::DelHessian;
use delmpc_mechanics::linearize::{InputHold, Linearizer, StateCoordinates};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::step::NewtonVariant;

/// Time of one call, µs: the least of eleven medians. Batches are short and medians come from stretches of a few milliseconds, so that
/// at least one stretch passes without another process on the core.
fn time(mut call: impl FnMut()) -> f64 {
    let mut repeat = 1;
    loop {
        let start = Instant::now();
        (0..repeat).for_each(|_| call());
        if start.elapsed().as_secs_f64() > 1e-4 {
            break;
        }
        repeat *= 2;
    }
    let mut best = f64::INFINITY;
    for _ in 0..11 {
        let mut batches: Vec<f64> = (0..51)
            .map(|_| {
                let start = Instant::now();
                (0..repeat).for_each(|_| call());
                start.elapsed().as_secs_f64() / f64::from(repeat) * 1e6
            })
            .collect();
        batches.sort_by(f64::total_cmp);
        best = best.min(batches[batches.len() / 2]);
    }
    best
}

fn chain(n: usize) -> KinematicTree {
    let rod = LinkInertia::new(
        1.0,
        Vector3::new(0.0, 0.0, -0.5),
        Matrix3::from_diagonal(&Vector3::new(1.0 / 12.0, 1.0 / 12.0, 1e-3)),
    );
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let mut parent = None;
    for i in 0..n {
        let z = if i == 0 { 0.0 } else { -1.0 };
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, z));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(Vector3::y(), placement), rod)));
    }
    builder.build().unwrap()
}

fn pseudo_random(n: usize, scale: f64) -> Vec<f64> {
    (0..n).map(|k| scale * ((k as f64 + 1.0) * 12.9898).sin()).collect()
}

fn report(name: &str, tree: &KinematicTree, s: usize, dt: f64, q: &[f64], torque: &[f64]) {
    let rule = LobattoRule::new(s).unwrap();
    let n = tree.dof();
    println!("{name}, n = {n}, s = {s}, Δt = {dt} s");
    let forces = StepForces::held(torque);
    for method in [NewtonMethod::BranchLu, NewtonMethod::Recursive] {
        let options = StepOptions { method: Some(method), ..StepOptions::default() };
        let mut integrator = Integrator::new(tree, &rule, dt, options).unwrap();
        let mut state = State::zeros(tree);
        state.q.copy_from_slice(q);
        integrator.velocities().set_velocity(tree, &mut state, &pseudo_random(n, 0.2)).unwrap();
        let begun = state.clone();
        for _ in 0..4 {
            integrator.step(tree, &mut state, &forces).unwrap();
        }
        let mut del = integrator.del().clone();
        let mut solver = NewtonSolver::new(method, tree, &del);
        let mut hessian = DelHessian::new(tree, &del);
        let mut residual = vec![0.0; s * n];
        let evaluate = time(|| {
            del.evaluate(tree, &[]);
            del.residual_into(tree, &mut residual);
            black_box(&residual);
        });
        let assemble = time(|| hessian.evaluate(tree, black_box(&del)));
        let factor = time(|| solver.factor(tree, black_box(&del)).unwrap());
        let solve = time(|| {
            residual.fill(1.0);
            solver.solve(tree, &mut residual);
            black_box(&residual);
        });
        println!(
            "  {method:?}: residual {evaluate:.2}, Hessian {assemble:.2}, factor {factor:.2}, solve {solve:.2}, direction {:.2} µs",
            factor + solve
        );
        for variant in [NewtonVariant::Exact, NewtonVariant::Simplified, NewtonVariant::Broyden] {
            let options = StepOptions { method: Some(method), variant, ..StepOptions::default() };
            let mut integrator = Integrator::new(tree, &rule, dt, options).unwrap();
            let mut state = begun.clone();
            let (mut steps, mut iterations, mut factorizations) = (0, 0, 0);
            let warm = time(|| {
                // A short stretch of motion, again and again, so that every step is a warm one of the same kind.
                if steps % 50 == 0 {
                    state.copy_from(&begun);
                    integrator.forget();
                }
                let report = integrator.step(tree, &mut state, &forces).unwrap();
                steps += 1;
                iterations += report.iterations;
                factorizations += report.factorizations;
            });
            println!(
                "    step {variant:?}: {warm:.2} µs ({:.2} iterations, {:.2} factorisations)",
                iterations as f64 / f64::from(steps),
                factorizations as f64 / f64::from(steps)
            );
        }
        for coordinates in [StateCoordinates::Momentum, StateCoordinates::Velocity] {
            let mut work = Linearizer::new(tree, &integrator, coordinates, InputHold::Held).unwrap();
            let mut state = begun.clone();
            integrator.forget();
            integrator.step(tree, &mut state, &forces).unwrap();
            let solved = time(|| {
                work.linearize(tree, &mut integrator).unwrap();
            });
            let (mut steps, mut iterations, mut factorizations) = (0, 0, 0);
            let unsolved = time(|| {
                if steps % 50 == 0 {
                    state.copy_from(&begun);
                    integrator.forget();
                }
                let report = integrator.step(tree, &mut state, &forces).unwrap();
                work.linearize(tree, &mut integrator).unwrap();
                steps += 1;
                iterations += report.iterations;
                factorizations += report.factorizations;
            });
            println!(
                "    A, B in {coordinates:?}: solved step {solved:.2}, unsolved step {unsolved:.2} µs ({:.2} iterations, {:.2} factorisations before)",
                iterations as f64 / f64::from(steps),
                factorizations as f64 / f64::from(steps)
            );
        }
        let mut work =
            Linearizer::new(tree, &integrator, StateCoordinates::Momentum, InputHold::Held).unwrap();
        let recursion = time(|| {
            work.linearize_by_recursion(tree, &mut integrator).unwrap();
        });
        println!("    A, B by recursion: {recursion:.2} µs");
        if tree.dof() > 60 {
            let strict = time(|| {
                work.linearize_by_tangent(tree, &mut integrator).unwrap();
            });
            println!("    A, B by tangent: {strict:.2} µs");
        }
    }
}

/// `-- atlas`, `-- 64`: only that robot, only that chain.
fn main() {
    let only: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let wanted = |name: &str| only.is_empty() || only.iter().any(|o| o == name);
    let case = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let hold = pseudo_random(30, 1.0);
    for dt in [0.001, 0.005].into_iter().filter(|_| wanted("atlas")) {
        report("Atlas, foot-rooted", &case.tree, 2, dt, &case.state.q, &hold);
    }
    for n in [16, 32, 64, 128].into_iter().filter(|n| wanted(&n.to_string())) {
        report("chain", &chain(n), 2, 0.005, &pseudo_random(n, 0.3), &vec![0.0; n]);
    }
}
