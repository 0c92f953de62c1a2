//! Hessian blocks, tangent and the three factorisations against the oracle vectors.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;
mod random_tree;

use delmpc_mechanics::branch_lu::BranchLu;
use delmpc_mechanics::del_hessian::DelHessian;
use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::dense_lu::DenseNewton;
use delmpc_mechanics::forces::StepForces;
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use delmpc_mechanics::recursive_newton::RecursiveNewton;
use delmpc_mechanics::row_matrix::RowMatrix;
use delmpc_mechanics::state::State;
use delmpc_mechanics::tangent::TangentWorkspace;
use delmpc_mechanics::tree::{Base, Body, KinematicTree, TreeBuilder};
use oracle::{assert_close, flat, unconstrained};
use proptest::prelude::*;
use random_tree::{Random, difference, multiply, size};

const METHODS: [NewtonMethod; 3] = [NewtonMethod::Dense, NewtonMethod::BranchLu, NewtonMethod::Recursive];

#[test]
fn hessian_blocks_match_the_vectors() {
    for case in unconstrained().filter(|c| c.json["eval"]["H"].is_array()) {
        let del = case.evaluated();
        let mut hessian = DelHessian::new(&case.tree, &del);
        hessian.evaluate(&case.tree, &del);
        let n = case.tree.dof();
        let mut block = vec![0.0; n * n];
        let (mut got, mut want) = (Vec::new(), Vec::new());
        for alpha in 0..=case.s {
            for gamma in 0..=case.s {
                hessian.dense_block_into(&case.tree, alpha, gamma, &mut block);
                got.extend_from_slice(&block);
                want.extend(flat(&case.json["eval"]["H"][alpha][gamma]));
            }
        }
        assert_close(&format!("{} H", case.name), &got, &want, 1e-12);
    }
}

#[test]
fn tangent_gives_the_columns_of_the_hessian() {
    for case in unconstrained().filter(|c| c.json["eval"]["H"].is_array()) {
        let del = case.evaluated();
        let mut tangent = TangentWorkspace::new(&case.tree, &del);
        let (n, s) = (case.tree.dof(), case.s);
        let mut rows = vec![0.0; s * n];
        let mut last = vec![0.0; n];
        let (mut got, mut want) = (Vec::new(), Vec::new());
        for gamma in 0..=s {
            for j in 0..n {
                tangent.clear();
                tangent.set(gamma, j, 1.0);
                tangent.evaluate(&case.tree, &del);
                tangent.residual_into(&case.tree, &del, &mut rows);
                tangent.next_momentum_into(&case.tree, &del, &mut last);
                for i in 0..n {
                    for alpha in 0..=s {
                        got.push(if alpha < s { rows[i * s + alpha] } else { last[i] });
                        want.push(case.json["eval"]["H"][alpha][gamma][i][j].as_f64().unwrap());
                    }
                }
            }
        }
        assert_close(&format!("{} tangent", case.name), &got, &want, 1e-12);
    }
}

#[test]
fn every_factorisation_solves_the_vectors() {
    for case in unconstrained() {
        let del = case.evaluated();
        let eval = &case.json["eval"];
        let tolerance = if case.tree.dof() >= 30 { 1e-8 } else { 1e-10 };
        let residual: Vec<f64> = {
            let mut r = vec![0.0; case.s * case.tree.dof()];
            del.residual_into(&case.tree, &mut r);
            r.iter().map(|x| -x).collect()
        };
        for method in METHODS {
            let name = format!("{} {method:?}", case.name);
            let mut solver = NewtonSolver::new(method, &case.tree, &del);
            solver.factor(&case.tree, &del).unwrap();
            let mut x = residual.clone();
            solver.solve(&case.tree, &mut x);
            assert_close(&format!("{name} direction"), &x, &case.rows(&eval["newton_direction"]), tolerance);
            let rhs = case.rows(&eval["rhs"]);
            let mut x = rhs.clone();
            solver.solve(&case.tree, &mut x);
            assert_close(&format!("{name} J"), &x, &case.rows(&eval["J_solve_rhs"]), tolerance);
            let mut many = RowMatrix::zeros(rhs.len(), 11);
            for (r, value) in rhs.iter().enumerate() {
                for c in 0..11 {
                    many.set(r, c, value * (c as f64 - 3.0));
                }
            }
            solver.solve_many(&case.tree, &mut many);
            for c in 0..11 {
                let column: Vec<f64> = (0..rhs.len()).map(|r| many.get(r, c)).collect();
                let want: Vec<f64> = x.iter().map(|v| v * (c as f64 - 3.0)).collect();
                if c != 3 {
                    assert_close(&format!("{name} column {c}"), &column, &want, tolerance);
                }
            }
            let mut x = rhs.clone();
            solver.solve_transposed(&case.tree, &mut x);
            assert_close(&format!("{name} Jt"), &x, &case.rows(&eval["JT_solve_rhs"]), tolerance);
        }
    }
}

#[test]
fn newton_matrix_is_the_tangent_for_a_floating_base() {
    for case in unconstrained().filter(|c| c.tree.is_floating()) {
        let del = case.evaluated();
        let mut tangent = TangentWorkspace::new(&case.tree, &del);
        let mut dense = delmpc_mechanics::dense_lu::DenseNewton::new(&case.tree, &del);
        let matrix = dense.assemble(&case.tree, &del).to_vec();
        let (n, s) = (case.tree.dof(), case.s);
        let order = n * s;
        let mut rows = vec![0.0; order];
        let mut want = vec![0.0; order * order];
        for j in 0..n {
            for gamma in 1..=s {
                tangent.clear();
                tangent.set(gamma, j, 1.0);
                tangent.evaluate(&case.tree, &del);
                tangent.residual_into(&case.tree, &del, &mut rows);
                for (r, value) in rows.iter().enumerate() {
                    want[r * order + j * s + gamma - 1] = *value;
                }
            }
        }
        if let Some(stored) = case.json["eval"].get("J") {
            // Base nodes first (6 s, node-major), then joints node-major.
            let stored = flat(stored);
            let joints = n - 6;
            let place = |dof: usize, node: usize| {
                if dof < 6 { node * 6 + dof } else { 6 * s + node * joints + dof - 6 }
            };
            let mut sorted = vec![0.0; order * order];
            for r in 0..order {
                for c in 0..order {
                    sorted[r * order + c] = stored[place(r / s, r % s) * order + place(c / s, c % s)];
                }
            }
            assert_close(&format!("{} tangent against J", case.name), &want, &sorted, 1e-12);
        }
        assert_close(&format!("{} assembled J", case.name), &matrix, &want, 1e-12);
    }
}

#[test]
fn pivots_of_the_recursion_are_those_of_the_branch_lu() {
    for case in unconstrained() {
        let del = case.evaluated();
        let mut lu = BranchLu::new(&case.tree, &del);
        let mut recursive = RecursiveNewton::new(&case.tree, &del);
        lu.factor(&case.tree, &del).unwrap();
        recursive.factor(&case.tree, &del).unwrap();
        for body in case.tree.first_joint_body()..case.tree.body_count() {
            let name = format!("{} body {body}", case.name);
            let tolerance = if case.tree.dof() >= 30 { 1e-7 } else { 1e-9 };
            let dof = case.tree.joint_dof(body);
            assert_close(&name, recursive.inverse_pivot(body), lu.inverse_pivot(dof), tolerance);
        }
    }
}

/// The tree with what acts on its bodies from outside, gravity excepted, taken away.
fn without_drag(tree: &KinematicTree) -> KinematicTree {
    let mut bodies = tree.bodies().iter();
    let mut builder = match tree.base() {
        Base::Fixed => TreeBuilder::fixed_base(*tree.gravity_w()),
        Base::Floating => TreeBuilder::floating_base(*tree.gravity_w(), bodies.next().unwrap().inertia),
    };
    for body in bodies {
        builder.add(Body::new(body.parent, body.joint, body.inertia));
    }
    builder.build().unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Branched trees, springs and damping in the joints, at nodes that solve nothing: `J x = b` and `Jᵀ x = b` against the assembled `J`.
    #[test]
    fn every_factorisation_solves_random_trees(
        seed: u64, joints in 1usize..14, floating: bool, drag: bool, s in 1usize..=3
    ) {
        let random = &mut Random::new(seed);
        let mut tree = random.tree(joints, floating);
        if !drag {
            tree = without_drag(&tree);
        }
        let rule = LobattoRule::new(s).unwrap();
        let mut del = DelWorkspace::new(&tree, &rule, 0.01, ForceCapacity::default()).unwrap();
        let mut state = State::zeros(&tree);
        state.q = random.values(joints, 1.5);
        state.p = random.values(tree.dof(), 1.0);
        state.base_pose = random.pose();
        let torques = random.values(joints, 5.0);
        del.begin(&tree, &state, &StepForces::held(&torques)).unwrap();
        for node in 1..=s {
            for dof in 0..tree.dof() {
                del.move_node(node, dof, random.range(-0.02, 0.02));
            }
        }
        del.evaluate(&tree, &[]);
        let order = s * tree.dof();
        let matrix = DenseNewton::new(&tree, &del).assemble(&tree, &del).to_vec();
        let transposed: Vec<f64> = (0..order * order).map(|at| matrix[(at % order) * order + at / order]).collect();
        let rhs = random.values(order, 1.0);
        for method in METHODS {
            let mut solver = NewtonSolver::new(method, &tree, &del);
            solver.factor(&tree, &del).unwrap();
            for (matrix, transpose) in [(&matrix, false), (&transposed, true)] {
                let mut x = rhs.clone();
                if transpose {
                    solver.solve_transposed(&tree, &mut x);
                } else {
                    solver.solve(&tree, &mut x);
                }
                let error = difference(&multiply(matrix, &x), &rhs) / (size(matrix) * size(&x) + 1.0);
                prop_assert!(error < 1e-11, "{method:?} {transpose}: {error:.1e}");
            }
        }
    }
}
