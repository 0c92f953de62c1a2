//! C-RATTLE against the oracle vectors, its orders of convergence, symplecticity on the manifold, refusals.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;

use delmpc_mechanics::constraints::{ConstrainedIntegrator, Constraint, ConstraintKind};
use delmpc_mechanics::errors::{ModelError, StepError};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::prelude::*;
use oracle::{assert_close, cases, flat, matrix3, model, vector3};
use serde_json::Value;

const METHODS: [NewtonMethod; 3] = [NewtonMethod::Dense, NewtonMethod::BranchLu, NewtonMethod::Recursive];

fn constraint(spec: &Value) -> Constraint {
    let body = |key: &str| spec[key].as_u64().unwrap() as usize - 1;
    let kind = match spec["type"].as_str().unwrap() {
        "point" => ConstraintKind::Point {
            body: body("body"),
            point: vector3(&spec["point"]),
            target_w: vector3(&spec["target"]),
        },
        "loop" => ConstraintKind::Loop {
            first: (body("body"), vector3(&spec["point"])),
            second: (body("body2"), vector3(&spec["point2"])),
        },
        "weld" => ConstraintKind::Weld {
            body: body("body"),
            rotation_w: matrix3(&spec["R"]),
            position_w: vector3(&spec["t"]),
        },
        other => panic!("constraint {other}"),
    };
    match spec.get("rows") {
        Some(rows) => {
            let rows: Vec<usize> =
                rows.as_array().unwrap().iter().map(|r| r.as_u64().unwrap() as usize).collect();
            Constraint::new(kind).rows(&rows)
        }
        None => Constraint::new(kind),
    }
}

struct Setup {
    tree: KinematicTree,
    integrator: ConstrainedIntegrator,
    state: State,
    torque: Vec<f64>,
}

fn setup(case: &Value, method: NewtonMethod, s: usize, dt: f64) -> Setup {
    let tree = model(case);
    let constraints: Vec<Constraint> =
        case["constraints"].as_array().unwrap().iter().map(constraint).collect();
    let rule = LobattoRule::new(s).unwrap();
    let integrator =
        ConstrainedIntegrator::new(&tree, &constraints, &rule, dt, Some(method), Default::default()).unwrap();
    let mut state = State::zeros(&tree);
    state.q = flat(&case["q0"]);
    state.p = flat(&case["p0"]);
    Setup { tree, integrator, state, torque: flat(&case["u"]) }
}

fn times(matrix: &[f64], basis: &[f64], size: usize) -> Vec<f64> {
    let columns = basis.len() / size;
    (0..size * columns)
        .map(|k| (0..size).map(|i| matrix[k / columns * size + i] * basis[i * columns + k % columns]).sum())
        .collect()
}

#[test]
fn steps_multipliers_and_linearisation_match_the_vectors() {
    for (name, case) in cases(|n| n.contains("constrained")) {
        for method in METHODS {
            let name = format!("{name} {method:?}");
            let s = case["s"].as_u64().unwrap() as usize;
            let Setup { tree, mut integrator, mut state, torque } =
                setup(&case, method, s, case["dt"].as_f64().unwrap());
            let n = tree.dof();
            let forces = StepForces::held(&torque);
            integrator.solve(&tree, &state, &forces).unwrap();
            let solution = &case["solution"];
            let multipliers: Vec<f64> = (0..=s).flat_map(|a| integrator.multipliers(a).to_vec()).collect();
            assert_close(&format!("{name} λ"), &multipliers, &flat(&solution["lambda_nodes"]), 1e-10);

            let start = &case["constraint_at_q0"];
            let set = integrator.constraints();
            let m = set.row_count();
            let (mut g, mut curvature, mut rate) = (vec![0.0; m * n], vec![0.0; n * n], vec![0.0; m * n]);
            let mut h = vec![0.0; m];
            set.residual_into(integrator.del(), 0, &mut h);
            assert!(h.iter().all(|x| x.abs() < 1e-14), "{name} h");
            set.jacobian_into(&tree, integrator.del(), 0, &mut g);
            assert_close(&format!("{name} G"), &g, &flat(&start["G"]), 1e-13);
            let lambda = flat(&start["lambda_test"]);
            set.curvature_into(&tree, integrator.del(), 0, &lambda, &mut curvature);
            assert_close(&format!("{name} d2h"), &curvature, &flat(&start["d2_lambda_h"]), 1e-13);
            set.jacobian_rate_into(&tree, integrator.del(), 0, &flat(&case["qd0"]), &mut rate);
            assert_close(&format!("{name} dGqd"), &rate, &flat(&start["d_Gqd_dq"]), 1e-12);

            let linear = &case["linearisation_ambient"];
            let (a, b) = integrator.linearize(&tree).unwrap();
            let on_tangent = times(&a, &flat(&linear["tangent_basis_at_0"]), 2 * n);
            assert_close(&format!("{name} A"), &on_tangent, &flat(&linear["A_on_tangent"]), 1e-10);
            assert_close(&format!("{name} B"), &b, &flat(&linear["B"]), 1e-10);

            integrator.step(&tree, &mut state, &forces).unwrap();
            let nodes = flat(&solution["qbar"]);
            assert_close(&format!("{name} q"), &state.q, &nodes[s * n..], 1e-12);
            assert_close(&format!("{name} p"), &state.p, &flat(&solution["p1"]), 1e-12);
            for _ in 1..case["trajectory"]["steps"].as_u64().unwrap() {
                integrator.step(&tree, &mut state, &forces).unwrap();
            }
            let tolerance = case["trajectory"]["tolerance"].as_f64().unwrap();
            assert_close(&format!("{name} end q"), &state.q, &flat(&case["trajectory"]["q"]), tolerance);
            assert_close(&format!("{name} end p"), &state.p, &flat(&case["trajectory"]["p"]), tolerance);
        }
    }
}

#[test]
fn the_constrained_map_is_symplectic_on_the_manifold() {
    for (name, case) in cases(|n| n.contains("constrained")) {
        let s = case["s"].as_u64().unwrap() as usize;
        let Setup { tree, mut integrator, state, torque } =
            setup(&case, NewtonMethod::BranchLu, s, case["dt"].as_f64().unwrap());
        if tree.bodies().iter().any(|b| b.joint.damping > 0.0) {
            continue;
        }
        integrator.solve(&tree, &state, &StepForces::held(&torque)).unwrap();
        let (a, _) = integrator.linearize(&tree).unwrap();
        let n = tree.dof();
        let basis = flat(&case["linearisation_ambient"]["tangent_basis_at_0"]);
        let columns = basis.len() / (2 * n);
        let moved = times(&a, &basis, 2 * n);
        let form = |v: &[f64], r: usize, c: usize| -> f64 {
            let at = |i: usize, k: usize| v[i * columns + k];
            (0..n).map(|i| at(i, r) * at(n + i, c) - at(n + i, r) * at(i, c)).sum()
        };
        for r in 0..columns {
            for c in 0..columns {
                let defect = (form(&moved, r, c) - form(&basis, r, c)).abs();
                assert!(defect <= 1e-11, "{name}: {defect:e}");
            }
        }
    }
}

/// Max-norm errors of `(q, p)` at `T = 0.4` for the pinned pendulum without torque.
fn errors(case: &Value, s: usize, steps: usize, reference: &State) -> (f64, f64) {
    let end = run(case, s, steps);
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs()));
    (distance(&end.q, &reference.q), distance(&end.p, &reference.p))
}

fn run(case: &Value, s: usize, steps: usize) -> State {
    let Setup { tree, mut integrator, mut state, .. } =
        setup(case, NewtonMethod::BranchLu, s, 0.4 / steps as f64);
    let zero = vec![0.0; tree.dof()];
    integrator.project(&tree, &mut state).unwrap();
    for _ in 0..steps {
        integrator.step(&tree, &mut state, &StepForces::held(&zero)).unwrap();
    }
    state
}

#[test]
fn c_rattle_has_order_two_and_four_in_position_and_momentum() {
    let case = oracle::read("pendulum5_pinned_constrained_s2.json");
    let reference = run(&case, 4, 80);
    for (s, steps, order) in [(1, 160, 2.0), (2, 40, 4.0)] {
        let (q_coarse, p_coarse) = errors(&case, s, steps, &reference);
        let (q_fine, p_fine) = errors(&case, s, 2 * steps, &reference);
        for (what, coarse, fine) in [("q", q_coarse, q_fine), ("p", p_coarse, p_fine)] {
            let measured = (coarse / fine).log2();
            println!("s = {s}, {what}: order {measured:.3} (errors {coarse:.1e}, {fine:.1e})");
            assert!((measured - order).abs() <= 0.15, "s = {s}, {what}: order {measured}");
        }
    }
}

#[test]
fn projection_makes_any_state_consistent() {
    let case = oracle::read("tree10_welded_constrained_s2.json");
    let Setup { tree, mut integrator, mut state, torque } = setup(&case, NewtonMethod::BranchLu, 2, 0.01);
    for (k, q) in state.q.iter_mut().enumerate() {
        *q += 0.02 * (k as f64).sin();
    }
    integrator.project(&tree, &mut state).unwrap();
    integrator.solve(&tree, &state, &StepForces::held(&torque)).unwrap();
    let mut h = vec![0.0; integrator.constraints().row_count()];
    for alpha in 0..=2 {
        integrator.constraints().residual_into(integrator.del(), alpha, &mut h);
        assert!(h.iter().all(|x| x.abs() < 1e-12), "node {alpha}: {h:?}");
    }
}

#[test]
fn dependent_rows_are_refused_by_index_and_leave_the_state_alone() {
    let case = oracle::read("loop5_planar_constrained_s1.json");
    let mut spec = case["constraints"][0].clone();
    // A planar mechanism: the row out of the plane depends on nothing that can move.
    spec["rows"] = serde_json::json!([0, 1, 2]);
    let mut full = case.clone();
    full["constraints"] = serde_json::json!([spec]);
    let Setup { tree, mut integrator, mut state, torque } = setup(&full, NewtonMethod::BranchLu, 1, 0.01);
    let before = state.clone();
    let refused = integrator.step(&tree, &mut state, &StepForces::held(&torque));
    assert!(matches!(refused, Err(StepError::RedundantConstraint { row: 1, .. })), "{refused:?}");
    assert_eq!(before, state);
}

#[test]
fn a_floating_base_and_unknown_bodies_are_refused() {
    let floating = TreeBuilder::floating_base(
        Vector3::zeros(),
        LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity()),
    )
    .build()
    .unwrap();
    let rule = LobattoRule::new(1).unwrap();
    let at = |tree: &KinematicTree, body| {
        let kind = ConstraintKind::Point { body, point: Vector3::zeros(), target_w: Vector3::zeros() };
        ConstrainedIntegrator::new(tree, &[Constraint::new(kind)], &rule, 0.01, None, Default::default())
            .map(|_| ())
    };
    assert!(matches!(at(&floating, 0), Err(ModelError::Unsupported { .. })));
    let fixed = model(&oracle::read("pendulum2_s1.json"));
    assert!(matches!(at(&fixed, 7), Err(ModelError::Unsupported { body: 7, .. })));
}
