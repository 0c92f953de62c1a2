//! `A`, `B` and their adjoint products against the oracle vectors, by both paths and every factorisation; symplecticity.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;

use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::linearize::{InputHold, LinearStep, Linearizer, StateCoordinates};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::step::{Integrator, StepOptions};
use oracle::{Case, assert_close, flat, unconstrained};

const METHODS: [NewtonMethod; 3] = [NewtonMethod::Dense, NewtonMethod::BranchLu, NewtonMethod::Recursive];
/// The README's tolerance for A and B.
const TOLERANCE: f64 = 1e-10;

fn solved(case: &Case, method: NewtonMethod) -> Integrator {
    let rule = LobattoRule::new(case.s).unwrap();
    let options = StepOptions { method: Some(method), turn_limit: f64::INFINITY, ..StepOptions::default() };
    let mut integrator = Integrator::new(&case.tree, &rule, case.dt, options).unwrap();
    integrator.solve(&case.tree, &case.state, &case.forces()).unwrap();
    integrator
}

fn a(step: &LinearStep) -> Vec<f64> {
    let n = 2 * step.dof();
    (0..n * n).map(|k| step.a(k / n, k % n)).collect()
}

fn b(step: &LinearStep) -> Vec<f64> {
    let m = step.inputs();
    (0..2 * step.dof() * m).map(|k| step.b(k / m, k % m)).collect()
}

/// Largest entry of `AᵀΩA - Ω`, relative to the largest sum that cancels in it (1 for a short chain, 1e4 for 32 links).
fn symplectic_defect(a: &[f64], n: usize) -> f64 {
    let size = 2 * n;
    let (mut worst, mut scale) = (0.0f64, 1.0f64);
    for r in 0..size {
        for c in 0..size {
            let (mut sum, mut terms) = (0.0, 0.0);
            for k in 0..n {
                let (x, y) =
                    (a[k * size + r] * a[(n + k) * size + c], a[(n + k) * size + r] * a[k * size + c]);
                sum += x - y;
                terms += x.abs() + y.abs();
            }
            let omega = if c == r + n {
                1.0
            } else if r == c + n {
                -1.0
            } else {
                0.0
            };
            worst = worst.max((sum - omega).abs());
            scale = scale.max(terms);
        }
    }
    worst / scale
}

#[test]
fn a_and_b_match_the_vectors_by_every_path() {
    let mut recursions = 0;
    for case in unconstrained() {
        let stored = &case.json["linearisation"];
        for method in METHODS {
            let name = format!("{} {method:?}", case.name);
            let mut integrator = solved(&case, method);
            for hold in [InputHold::Held, InputHold::PerNode] {
                let mut work =
                    Linearizer::new(&case.tree, &integrator, StateCoordinates::Momentum, hold).unwrap();
                let key = if hold == InputHold::Held { "B" } else { "B_nodes" };
                let Some(want_b) = stored.get(key).map(flat) else { continue };
                let want_a = flat(&stored["A"]);
                let step = work.linearize(&case.tree, &mut integrator).unwrap();
                assert_close(&format!("{name} A"), &a(step), &want_a, TOLERANCE);
                assert_close(&format!("{name} {key}"), &b(step), &want_b, TOLERANCE);
                let step = work.linearize_by_tangent(&case.tree, &mut integrator).unwrap();
                assert_close(&format!("{name} A by tangent"), &a(step), &want_a, TOLERANCE);
                assert_close(&format!("{name} {key} by tangent"), &b(step), &want_b, TOLERANCE);
                match work.linearize_by_recursion(&case.tree, &mut integrator) {
                    Ok(step) => {
                        assert_close(&format!("{name} A by recursion"), &a(step), &want_a, TOLERANCE);
                        assert_close(&format!("{name} {key} by recursion"), &b(step), &want_b, TOLERANCE);
                        recursions += 1;
                    }
                    Err(error) => assert!(matches!(error, StepError::Argument(_)), "{name}: {error}"),
                }
            }
            if let Some(want_a) = stored.get("A_qqd").map(flat) {
                let coordinates = StateCoordinates::Velocity;
                let mut work =
                    Linearizer::new(&case.tree, &integrator, coordinates, InputHold::Held).unwrap();
                let step = work.linearize(&case.tree, &mut integrator).unwrap();
                assert_close(&format!("{name} A_qqd"), &a(step), &want_a, TOLERANCE);
                assert_close(&format!("{name} B_qqd"), &b(step), &flat(&stored["B_qqd"]), TOLERANCE);
            }
        }
    }
    assert!(recursions >= 20, "only {recursions} cases by recursion");
}

#[test]
fn adjoint_products_are_those_of_the_matrices() {
    for case in unconstrained().filter(|c| !c.tree.is_floating()) {
        for method in METHODS {
            let name = format!("{} {method:?}", case.name);
            let mut integrator = solved(&case, method);
            for hold in [InputHold::Held, InputHold::PerNode] {
                let mut work =
                    Linearizer::new(&case.tree, &integrator, StateCoordinates::Momentum, hold).unwrap();
                let step = work.linearize(&case.tree, &mut integrator).unwrap();
                let size = 2 * step.dof();
                let lambda: Vec<f64> = (0..size).map(|k| (1.0 + k as f64).sin()).collect();
                let times =
                    |entry: &dyn Fn(usize) -> f64| -> f64 { (0..size).map(|r| entry(r) * lambda[r]).sum() };
                let want_a: Vec<f64> = (0..size).map(|c| times(&|r| step.a(r, c))).collect();
                let want_b: Vec<f64> = (0..step.inputs()).map(|c| times(&|r| step.b(r, c))).collect();
                let (mut got_a, mut got_b) = (vec![0.0; size], vec![0.0; want_b.len()]);
                work.adjoint_into(&case.tree, &mut integrator, &lambda, &mut got_a, &mut got_b).unwrap();
                assert_close(&format!("{name} Atλ"), &got_a, &want_a, TOLERANCE);
                assert_close(&format!("{name} Btλ"), &got_b, &want_b, TOLERANCE);
            }
        }
    }
}

#[test]
fn the_step_is_symplectic_without_dissipation() {
    let mut checked = 0;
    for case in unconstrained().filter(|c| !c.name.contains("forces")) {
        let dissipative = case.tree.bodies().iter().any(|b| b.joint.damping > 0.0 || b.drag.amax() > 0.0);
        if dissipative {
            continue;
        }
        let mut integrator = solved(&case, NewtonMethod::BranchLu);
        let mut work =
            Linearizer::new(&case.tree, &integrator, StateCoordinates::Momentum, InputHold::Held).unwrap();
        let step = work.linearize(&case.tree, &mut integrator).unwrap();
        let defect = symplectic_defect(&a(step), step.dof());
        println!("{}: {defect:.1e}", case.name);
        assert!(defect <= 1e-11, "{}: AᵀΩA - Ω = {defect:.2e}", case.name);
        checked += 1;
    }
    assert!(checked >= 8, "only {checked} conservative cases");
}
