//! Solved steps and trajectories against the oracle vectors, through every factorisation and Newton variant.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;

use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::step::{Integrator, NewtonVariant, StepOptions};
use oracle::{assert_close, flat, unconstrained};

#[test]
fn solved_steps_and_trajectories_match_the_vectors() {
    let variants = [
        (NewtonMethod::Dense, NewtonVariant::Exact),
        (NewtonMethod::BranchLu, NewtonVariant::Exact),
        (NewtonMethod::BranchLu, NewtonVariant::Simplified),
        (NewtonMethod::BranchLu, NewtonVariant::Broyden),
        (NewtonMethod::BranchLu, NewtonVariant::Inertial),
        (NewtonMethod::Recursive, NewtonVariant::Exact),
        (NewtonMethod::Recursive, NewtonVariant::Broyden),
    ];
    for case in unconstrained() {
        let rule = LobattoRule::new(case.s).unwrap();
        let tree = &case.tree;
        let solution = &case.json["solution"];
        let tolerance = if tree.dof() >= 30 { 1e-10 } else { 1e-12 };
        for (method, variant) in variants {
            let name = format!("{} {method:?} {variant:?}", case.name);
            // Some vectors have torques far beyond the links' inertia: their joints turn by radians in one step.
            let turn_limit = f64::INFINITY;
            let options = StepOptions { method: Some(method), variant, turn_limit, ..StepOptions::default() };
            let mut integrator = Integrator::new(tree, &rule, case.dt, options).unwrap();
            let mut state = case.state.clone();
            integrator.step(tree, &mut state, &case.forces()).unwrap_or_else(|e| panic!("{name}: {e}"));
            let (q, p) = if tree.is_floating() {
                let q = flat(&solution["q"]);
                let mut p = flat(&solution["P1"]);
                p.extend(flat(&solution["pj1"]));
                let pose: Vec<f64> = state.base_pose.rotation.transpose().iter().copied().collect();
                assert_close(&format!("{name} R"), &pose, &flat(&solution["R1"]), tolerance);
                let place = state.base_pose.translation;
                assert_close(&format!("{name} p"), place.as_slice(), &flat(&solution["p1"]), tolerance);
                (q[q.len() - tree.joint_count()..].to_vec(), p)
            } else {
                let q = flat(&solution["qbar"]);
                (q[q.len() - tree.dof()..].to_vec(), flat(&solution["p1"]))
            };
            if tree.joint_count() > 0 {
                assert_close(&format!("{name} q"), &state.q, &q, tolerance);
            }
            assert_close(&format!("{name} p"), &state.p, &p, tolerance);
            let mut velocity = vec![0.0; tree.dof()];
            integrator.velocities().velocity_into(tree, &state, &mut velocity).unwrap();
            let mut want = solution.get("V1").map_or(vec![], flat);
            want.extend(flat(&solution["qd1"]));
            assert_close(&format!("{name} velocity"), &velocity, &want, 1e-9);

            let Some(trajectory) = case.json.get("trajectory") else { continue };
            let steps = trajectory["steps"].as_u64().unwrap();
            for _ in 1..steps {
                integrator.step(tree, &mut state, &case.forces()).unwrap_or_else(|e| panic!("{name}: {e}"));
            }
            // The README's tolerances are relative to the largest entry; a wrist of the Atlas vectors turns by 332 rad.
            let tolerance = trajectory["tolerance"].as_f64().unwrap();
            let close = |what: &str, got: &[f64], want: &[f64]| {
                let scale = want.iter().fold(1.0f64, |m, x| m.max(x.abs()));
                for (g, w) in got.iter().zip(want) {
                    assert!(
                        (g - w).abs() <= tolerance * scale,
                        "{name} trajectory {what}: {g} instead of {w}"
                    );
                }
            };
            close("q", &state.q, &flat(&trajectory["q"]));
            if tree.is_floating() {
                close("P", &state.p[..6], &flat(&trajectory["P"]));
                close("pj", &state.p[6..], &flat(&trajectory["pj"]));
                close("position", state.base_pose.translation.as_slice(), &flat(&trajectory["p"]));
            } else {
                close("p", &state.p, &flat(&trajectory["p"]));
            }
        }
    }
}
