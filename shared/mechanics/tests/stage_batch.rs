//! Stage-parallel lifted linearisation: against the step and its linearisation, against dense linear algebra, between
//! instruction sets; numbers of the start nodes; bad input.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod oracle;
mod random_tree;
mod sample_robots;

use delmpc_mechanics::del_hessian::DelHessian;
use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::kinetic_hessian::KineticHessian;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::stage_batch::{InstructionSet, StageBatch, StageInput, TransitionSlice};
use delmpc_mechanics::velocity::VelocityWorkspace;
use nalgebra::{DMatrix, DVector};
use random_tree::Random;
use sample_robots::{Forces, GRAVITY, exact_integrator, pendulum, quadruped, spatial_chain};

const SETS: [InstructionSet; 3] = [InstructionSet::Portable, InstructionSet::Avx2, InstructionSet::Avx512];
/// Not a multiple of any number of lanes.
const STAGES: usize = 11;

fn simpson() -> LobattoRule {
    LobattoRule::new(2).unwrap()
}

/// The same tree without drag and constant body wrenches.
fn without_wrenches(tree: &KinematicTree) -> KinematicTree {
    let mut builder = TreeBuilder::fixed_base(*tree.gravity_w());
    builder.accept_unreal_inertia();
    for body in tree.bodies() {
        builder.add(Body::new(body.parent, body.joint, body.inertia));
    }
    builder.build().unwrap()
}

/// Atlas on its foot, a chain, a planar pendulum, and random trees with springs, damping, slides and several roots.
fn trees() -> Vec<(String, KinematicTree)> {
    let atlas = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json")).tree;
    let mut all = vec![
        ("atlas".into(), atlas),
        ("chain".into(), without_wrenches(&spatial_chain(GRAVITY, Forces::All))),
        ("pendulum".into(), pendulum(12, 0.3)),
    ];
    for seed in 0..8 {
        let mut random = Random::new(seed);
        let joints = 1 + random.below(20);
        all.push((format!("random {seed}"), without_wrenches(&random.tree(joints, false))));
    }
    all
}

/// A stage that owns its numbers.
#[derive(Clone)]
struct Stage {
    nodes: [Vec<f64>; 3],
    rate: Vec<f64>,
    force: Vec<f64>,
    time_step: f64,
}

impl Stage {
    fn input(&self) -> StageInput<'_> {
        let [a, b, c] = &self.nodes;
        StageInput { nodes: [a, b, c], rate: &self.rate, force: &self.force, time_step: self.time_step }
    }
}

/// Joint forces that carry the weight.
fn gravity(tree: &KinematicTree, kinematics: &Kinematics) -> Vec<f64> {
    let mut force = vec![0.0; tree.dof()];
    gravity_force_into(tree, kinematics, &mut InverseDynamicsWorkspace::new(tree), &mut force).unwrap();
    force
}

/// Start states, forces (about what carries the weight) and time steps, all different; the interior and end nodes on a
/// straight line.
fn stages(tree: &KinematicTree, seed: u64) -> Vec<Stage> {
    let mut random = Random::new(seed);
    let n = tree.dof();
    (0..STAGES)
        .map(|k| {
            let (q, rate) = (random.values(n, 0.6), random.values(n, 0.5));
            let mut kinematics = Kinematics::new(tree);
            kinematics.update_positions(tree, &Configuration::fixed(&q)).unwrap();
            let push = random.values(n, 0.2);
            let force = gravity(tree, &kinematics).iter().zip(push).map(|(g, push)| g + push).collect();
            let time_step = 0.008 + 0.002 * k as f64;
            let ahead = |c: f64| q.iter().zip(&rate).map(|(q, v)| q + c * time_step * v).collect();
            let (middle, end) = (ahead(0.5), ahead(1.0));
            Stage { nodes: [q, middle, end], rate, force, time_step }
        })
        .collect()
}

/// The state `(q, M q̇)` at the start of a stage.
fn start(tree: &KinematicTree, stage: &Stage) -> State {
    let mut state = State::zeros(tree);
    state.q.copy_from_slice(&stage.nodes[0]);
    VelocityWorkspace::new(tree).set_velocity(tree, &mut state, &stage.rate).unwrap();
    state
}

struct Answer {
    batch: StageBatch,
    /// Column-major `[B A]` of every stage.
    transitions: Vec<DMatrix<f64>>,
    ends: Vec<Vec<f64>>,
}

fn fill(batch: &mut StageBatch, stages: &[Stage]) {
    for (k, stage) in stages.iter().enumerate() {
        batch.set_stage(k, &stage.input()).unwrap();
    }
}

fn linearize(mut batch: StageBatch) -> Answer {
    let n = batch.dof();
    // Rows further apart than they are long, and their parts too, as in padded matrices.
    let (first_state, row) = (n + 2, 3 * n + 5);
    let stage = 2 * n * row;
    let mut values = vec![f64::NAN; STAGES * stage];
    batch
        .linearize(&mut TransitionSlice {
            values: &mut values,
            stage_stride: stage,
            row_stride: row,
            first_state,
        })
        .unwrap();
    let transitions = values
        .chunks(stage)
        .map(|one| {
            assert!(
                one.chunks(row)
                    .all(|r| r[n..first_state].iter().chain(&r[first_state + 2 * n..]).all(|x| x.is_nan())),
                "wrote into the padding"
            );
            DMatrix::from_fn(2 * n, 3 * n, |r, c| one[r * row + if c < n { c } else { c - n + first_state }])
        })
        .collect();
    let ends = (0..STAGES)
        .map(|k| {
            let mut end = vec![0.0; 2 * n];
            batch.end_state_into(k, &mut end).unwrap();
            end
        })
        .collect();
    Answer { batch, transitions, ends }
}

fn run(tree: &KinematicTree, set: InstructionSet, stages: &[Stage]) -> Option<Answer> {
    let mut batch = StageBatch::with_instructions(tree, &simpson(), STAGES, set).ok()?;
    fill(&mut batch, stages);
    Some(linearize(batch))
}

/// Largest difference relative to the largest number wanted.
fn relative(got: impl Iterator<Item = f64>, want: &[f64]) -> f64 {
    let got: Vec<f64> = got.collect();
    assert_eq!(got.len(), want.len());
    let size = want.iter().fold(1e-3f64, |m, x| m.max(x.abs()));
    got.iter().zip(want).fold(0.0, |m: f64, (g, w)| {
        let error = (g - w).abs() / size;
        if error.is_nan() { f64::INFINITY } else { m.max(error) }
    })
}

#[test]
fn converged_stages_give_the_step_and_its_linearisation() {
    for (name, tree) in trees() {
        let n = tree.dof();
        let mut stages = stages(&tree, 5);
        let mut expected = Vec::new();
        for stage in &mut stages {
            let mut integrator = exact_integrator(&tree, 2, stage.time_step);
            let state = start(&tree, stage);
            integrator.solve(&tree, &state, &StepForces::held(&stage.force)).unwrap();
            for alpha in 1..=2 {
                stage.nodes[alpha] = (0..n).map(|i| integrator.del().node(alpha, i)).collect();
            }
            let next = integrator.next_state().clone();
            let mut end = next.q.clone();
            end.resize(2 * n, 0.0);
            integrator.velocities().velocity_into(&tree, &next, &mut end[n..]).unwrap();
            let mut linearizer =
                Linearizer::new(&tree, &integrator, StateCoordinates::Velocity, InputHold::Held).unwrap();
            let step = linearizer.linearize(&tree, &mut integrator).unwrap();
            let b = DMatrix::from_fn(2 * n, n, |r, c| step.b(r, c));
            let a = DMatrix::from_fn(2 * n, 2 * n, |r, c| step.a(r, c));
            expected.push((end, a, b));
        }
        for set in SETS {
            let Some(answer) = run(&tree, set, &stages) else { continue };
            for (k, (end, a, b)) in expected.iter().enumerate() {
                let report = answer.batch.outcome(k).unwrap();
                assert!(report.change < 1e-11, "{name} {set:?} stage {k}: {report:?}");
                let got = &answer.transitions[k];
                let errors = [
                    relative(got.columns(n, 2 * n).iter().copied(), a.as_slice()),
                    relative(got.columns(0, n).iter().copied(), b.as_slice()),
                    relative(answer.ends[k].iter().copied(), end),
                ];
                assert!(errors.iter().all(|e| *e < 1e-9), "{name} {set:?} stage {k}: A, B, end {errors:?}");
            }
        }
    }
}

/// The module's 3n x 3n system of one stage, by dense linear algebra.
struct Dense {
    /// `∂(q^1, q^2, q̇')` by `(u, q, q̇)`.
    columns: DMatrix<f64>,
    correction: DVector<f64>,
    end_rate: Vec<f64>,
    residual: f64,
}

fn dense(tree: &KinematicTree, stage: &Stage) -> Dense {
    let n = tree.dof();
    let h = stage.time_step;
    let rule = simpson();
    let state = start(tree, stage);
    let mut del = DelWorkspace::new(tree, &rule, h, ForceCapacity::default()).unwrap();
    del.begin(tree, &state, &StepForces::held(&stage.force)).unwrap();
    for alpha in 1..=2 {
        for i in 0..n {
            del.set_node(alpha, i, stage.nodes[alpha][i]);
        }
    }
    del.evaluate(tree, &[]);
    let mut residual = vec![0.0; 2 * n];
    del.residual_into(tree, &mut residual);
    let mut momentum = vec![0.0; n];
    del.next_momentum_into(tree, &mut momentum);
    let mut hessian = DelHessian::new(tree, &del);
    hessian.evaluate(tree, &del);
    let block = |alpha, gamma| {
        let mut out = vec![0.0; n * n];
        hessian.dense_block_into(tree, alpha, gamma, &mut out);
        DMatrix::from_row_slice(n, n, &out)
    };
    let end = State { q: stage.nodes[2].clone(), p: momentum, ..state.clone() };
    let mut end_rate = vec![0.0; n];
    VelocityWorkspace::new(tree).velocity_into(tree, &end, &mut end_rate).unwrap();
    let mut kinetic = KineticHessian::new(tree).unwrap();
    kinetic.evaluate(tree, &[(&stage.nodes[0], &stage.rate), (&end.q, &end_rate)]).unwrap();
    let matrices = |at| {
        let (mut m, mut k, mut scratch) = (vec![0.0; n * n], vec![0.0; n * n], vec![0.0; n * n]);
        kinetic.dense_into(tree, at, &mut m, &mut k, &mut scratch);
        (DMatrix::from_row_slice(n, n, &m), DMatrix::from_row_slice(n, n, &k))
    };
    let ((mass, mixed), (end_mass, end_mixed)) = (matrices(0), matrices(1));
    let mut system = DMatrix::zeros(3 * n, 3 * n);
    let mut sides = DMatrix::zeros(3 * n, 3 * n + 1);
    let one = DMatrix::<f64>::identity(n, n);
    let w = rule.weights();
    for alpha in 0..2 {
        for gamma in 1..=2 {
            system.view_mut((alpha * n, (gamma - 1) * n), (n, n)).copy_from(&block(alpha, gamma));
        }
        sides.view_mut((alpha * n, 0), (n, n)).copy_from(&(&one * (-w[alpha] * h)));
        sides.view_mut((alpha * n, n), (n, n)).copy_from(&-block(alpha, 0));
        for i in 0..n {
            sides[(alpha * n + i, 3 * n)] = -residual[2 * i + alpha];
        }
    }
    system.view_mut((2 * n, 0), (n, n)).copy_from(&-block(2, 1));
    system.view_mut((2 * n, n), (n, n)).copy_from(&(end_mixed - block(2, 2)));
    system.view_mut((2 * n, 2 * n), (n, n)).copy_from(&end_mass);
    sides.view_mut((2 * n, 0), (n, n)).copy_from(&(&one * (w[2] * h)));
    sides.view_mut((2 * n, n), (n, n)).copy_from(&block(2, 0));
    let position = -block(0, 0) - mixed;
    sides.view_mut((0, n), (n, n)).copy_from(&position);
    sides.view_mut((0, 2 * n), (n, n)).copy_from(&-mass);
    let solution = system.lu().solve(&sides).unwrap();
    Dense {
        columns: solution.columns(0, 3 * n).into_owned(),
        correction: solution.column(3 * n).into_owned(),
        end_rate,
        residual: residual.iter().fold(0.0, |m, r| m.max(r.abs())),
    }
}

#[test]
fn a_lifted_step_from_other_nodes_is_the_first_order_correction() {
    for (name, tree) in trees() {
        let n = tree.dof();
        let mut stages = stages(&tree, 9);
        let mut random = Random::new(77);
        for stage in &mut stages {
            for alpha in 1..=2 {
                stage.nodes[alpha].iter_mut().for_each(|q| *q += random.range(-2e-3, 2e-3));
            }
        }
        let expected: Vec<Dense> = stages.iter().map(|stage| dense(&tree, stage)).collect();
        for set in SETS {
            let Some(mut answer) = run(&tree, set, &stages) else { continue };
            let mut moved = Vec::new();
            for (k, want) in expected.iter().enumerate() {
                let batch = &mut answer.batch;
                let report = batch.outcome(k).unwrap();
                assert!((report.residual - want.residual).abs() < 1e-10 * (1.0 + want.residual), "{name}");
                let end: Vec<f64> = (0..n)
                    .map(|i| stages[k].nodes[2][i] + want.correction[n + i])
                    .chain((0..n).map(|i| want.end_rate[i] + want.correction[2 * n + i]))
                    .collect();
                let sensitivity = (0..3 * n).flat_map(|c| (0..n).map(move |i| (i, c)));
                let deviation: Vec<f64> = random.values(3 * n, 1e-2);
                let change = want.columns.rows(0, n) * DVector::from_column_slice(&deviation);
                moved.push((0..n).map(|i| stages[k].nodes[1][i] + want.correction[i] + change[i]).collect());
                let errors = [
                    relative(
                        answer.transitions[k].iter().copied(),
                        want.columns.rows(n, 2 * n).into_owned().as_slice(),
                    ),
                    relative(answer.ends[k].iter().copied(), &end),
                    relative(
                        sensitivity.map(|(i, c)| batch.interior_sensitivity(k, i, c)),
                        want.columns.rows(0, n).into_owned().as_slice(),
                    ),
                    relative(
                        (0..n).map(|i| batch.interior_correction(k, i)),
                        &want.correction.as_slice()[..n],
                    ),
                ];
                assert!(errors.iter().all(|e| *e < 1e-9), "{name} {set:?} stage {k}: {errors:?}");
                batch.set_deviation(k, &deviation[..n], &deviation[n..2 * n], &deviation[2 * n..]).unwrap();
            }
            answer.batch.move_interior();
            for (k, want) in moved.iter().enumerate() {
                let want: &Vec<f64> = want;
                let mut got = vec![0.0; n];
                answer.batch.interior_node_into(k, &mut got).unwrap();
                assert!(relative(got.into_iter(), want) < 1e-11, "{name} {set:?} stage {k}");
            }
        }
    }
}

#[test]
fn newtons_method_on_all_stages_finds_the_steps() {
    for (name, tree) in trees() {
        let stages = stages(&tree, 21);
        for set in SETS {
            let Ok(mut batch) = StageBatch::with_instructions(&tree, &simpson(), STAGES, set) else {
                continue;
            };
            fill(&mut batch, &stages);
            batch.iterate(8);
            for (k, stage) in stages.iter().enumerate() {
                let report = batch.outcome(k).unwrap();
                assert!(report.change < 1e-10, "{name} {set:?} stage {k}: {report:?}");
                let mut integrator = exact_integrator(&tree, 2, stage.time_step);
                let state = start(&tree, stage);
                integrator.solve(&tree, &state, &StepForces::held(&stage.force)).unwrap();
                for alpha in 1..=2 {
                    let want: Vec<f64> = (0..tree.dof()).map(|i| integrator.del().node(alpha, i)).collect();
                    let got = (0..tree.dof()).map(|i| batch.node(k, alpha, i));
                    assert!(relative(got, &want) < 1e-10, "{name} {set:?} stage {k} node {alpha}");
                }
            }
        }
    }
}

/// Entries of the velocity rows are sums of terms of the size `M/Δt` that cancel, before `M⁻¹`: the order of the operations shows
/// as `ε cond(M)/Δt` at the most, which is 1e-8 for Atlas (light hands, 2 m from the origin of {0}) and 2e-10 for the pendulum.
#[test]
fn every_instruction_set_gives_the_same_numbers() {
    for (name, tree) in trees() {
        let mut stages = stages(&tree, 33);
        stages.iter_mut().for_each(|stage| stage.time_step += 0.02);
        let reference = run(&tree, InstructionSet::Portable, &stages).unwrap();
        for set in [InstructionSet::Avx2, InstructionSet::Avx512] {
            let Some(answer) = run(&tree, set, &stages) else { continue };
            let tolerance = match name.as_str() {
                "pendulum" => 1e-10,
                "atlas" => 1e-11,
                _ => 1e-12,
            };
            for k in 0..STAGES {
                let got = &answer.transitions[k];
                let error = relative(got.iter().copied(), reference.transitions[k].as_slice());
                assert!(error < tolerance, "{name} {set:?} stage {k}: {error:e}");
                let error = relative(answer.ends[k].iter().copied(), &reference.ends[k]);
                assert!(error < tolerance, "{name} {set:?} stage {k}: end {error:e}");
            }
        }
    }
}

#[test]
fn start_nodes_have_the_momentum_and_its_derivatives() {
    for (name, tree) in trees() {
        let n = tree.dof();
        let stages = stages(&tree, 2);
        let end_node = (Random::new(8).values(n, 0.5), Random::new(9).values(n, 1.0));
        let mut kinetic = KineticHessian::new(&tree).unwrap();
        let mut kinematics = Kinematics::new(&tree);
        for set in SETS {
            let Ok(mut batch) = StageBatch::with_instructions(&tree, &simpson(), STAGES, set) else {
                continue;
            };
            fill(&mut batch, &stages);
            batch.set_end_node(&end_node.0, &end_node.1).unwrap();
            let batch = linearize(batch).batch;
            let states = stages.iter().map(|s| (&s.nodes[0], &s.rate)).chain([(&end_node.0, &end_node.1)]);
            for (k, (q, rate)) in states.enumerate() {
                kinetic.evaluate(&tree, &[(q, rate)]).unwrap();
                kinematics.update(&tree, &Configuration::fixed(q), &Velocity::fixed(rate)).unwrap();
                let check = |what: &str, got: &[f64], want: &[f64]| {
                    let error = relative(got.iter().copied(), want);
                    assert!(error < 1e-11, "{name} {set:?} node {k}: {what} {error:e}");
                };
                let columns = |pick: &dyn Fn(usize) -> Wrench| -> Vec<f64> {
                    (0..n).flat_map(|j| pick(j).to_vector().as_slice().to_vec()).collect()
                };
                let momentum = kinetic.momentum_w(0);
                check("P", batch.momentum_w(k).to_vector().as_slice(), momentum.to_vector().as_slice());
                check(
                    "∂P/∂q̇",
                    &columns(&|j| batch.d_momentum_d_rate(k, j)),
                    &columns(&|j| kinetic.momentum_columns_w(j, 0).0),
                );
                check(
                    "∂P/∂q",
                    &columns(&|j| batch.d_momentum_d_q(k, j)),
                    &columns(&|j| kinetic.momentum_columns_w(j, 0).1),
                );
                let com = kinematics.mass_centre_of_tree_w(&tree);
                check("c", batch.com_w(k).as_slice(), com.as_slice());
                let velocity = kinematics.mass_centre_velocity_w(&tree);
                check("ċ", batch.com_velocity_w(k).as_slice(), velocity.as_slice());
                let mut jacobian = vec![0.0; 3 * n];
                kinematics.mass_centre_jacobian_into(&tree, &mut jacobian).unwrap();
                let got: Vec<f64> = (0..3 * n).map(|at| batch.d_com_d_q(k, at % n)[at / n]).collect();
                check("∂c/∂q", &got, &jacobian);
                let got: Vec<f64> = (0..n).map(|j| batch.gravity_force(k, j)).collect();
                check("g", &got, &gravity(&tree, &kinematics));
                for body in 0..n {
                    let (got, want) = (batch.link_pose_w(k, body), kinematics.link_poses_w()[body]);
                    check("rotation", got.rotation.as_slice(), want.rotation.as_slice());
                    check("origin", got.translation.as_slice(), want.translation.as_slice());
                    let (got, want) = (batch.velocity_w(k, body), kinematics.velocities_w()[body]);
                    check("velocity", got.to_vector().as_slice(), want.to_vector().as_slice());
                    let (got, want) = (batch.joint_twist_w(k, body), kinematics.joint_twists_w()[body]);
                    check("twist", got.to_vector().as_slice(), want.to_vector().as_slice());
                }
            }
        }
    }
}

#[test]
fn a_bad_stage_is_named_and_touches_no_other() {
    let tree = pendulum(5, 0.4);
    let good = stages(&tree, 3);
    for set in SETS {
        let Some(reference) = run(&tree, set, &good) else { continue };
        type Spoil = fn(&mut Stage);
        let cases: [(&str, Spoil); 6] = [
            ("start node", |s| s.nodes[0][1] = f64::NAN),
            ("interior node", |s| s.nodes[1][1] = f64::INFINITY),
            ("end node", |s| s.nodes[2][1] = f64::NAN),
            ("start velocity", |s| s.rate[1] = f64::NEG_INFINITY),
            ("held joint force", |s| s.force[1] = f64::NAN),
            ("DEL residual (joint)", |s| s.rate[1] = f64::MAX),
        ];
        for (name, spoil) in cases {
            for bad in [0, 6, STAGES - 1] {
                let mut stages = good.clone();
                spoil(&mut stages[bad]);
                let answer = run(&tree, set, &stages).unwrap();
                for k in 0..STAGES {
                    let outcome = answer.batch.outcome(k);
                    if k == bad {
                        let named =
                            matches!(outcome, Err(StepError::NonFinite { quantity, .. }) if quantity == name);
                        assert!(named, "{set:?} {name}: {outcome:?}");
                    } else {
                        assert_eq!(outcome, reference.batch.outcome(k), "{set:?} {name} stage {k}");
                        assert_eq!(
                            answer.transitions[k], reference.transitions[k],
                            "{set:?} {name} stage {k}"
                        );
                        assert_eq!(answer.ends[k], reference.ends[k]);
                    }
                }
            }
        }
        let mut stages = good.clone();
        stages[2].nodes[0][3] = 2e6;
        let outcome = run(&tree, set, &stages).unwrap().batch.outcome(2);
        assert!(
            matches!(outcome, Err(StepError::Argument(ModelError::Unsupported { body: 3, .. }))),
            "{outcome:?}"
        );
    }
}

#[test]
fn a_singular_mass_matrix_is_named() {
    // Two slides along the same axis, the first one without mass: nothing tells their motions apart at the first body.
    let mut builder = TreeBuilder::fixed_base(Vector3::zeros());
    let slide = Joint::prismatic(Vector3::x(), RigidTransform::identity());
    let first = builder.add(Body::new(None, slide, LinkInertia::massless()));
    let load = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.1);
    builder.add(Body::new(Some(first), slide, load));
    let tree = builder.build().unwrap();
    for set in SETS {
        let Some(answer) = run(&tree, set, &stages(&tree, 1)) else { continue };
        for k in 0..STAGES {
            let outcome = answer.batch.outcome(k);
            assert!(matches!(outcome, Err(StepError::Singular(_))), "{set:?}: {outcome:?}");
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let tree = pendulum(2, 0.4);
    let unsupported = |result: Result<StageBatch, ModelError>| {
        assert!(matches!(result, Err(ModelError::Unsupported { .. })), "{:?}", result.err());
    };
    unsupported(StageBatch::new(&quadruped(GRAVITY, Forces::None), &simpson(), 2));
    unsupported(StageBatch::new(&spatial_chain(GRAVITY, Forces::All), &simpson(), 2));
    let third = StageBatch::new(&tree, &LobattoRule::new(3).unwrap(), 2);
    assert!(matches!(third, Err(ModelError::UnsupportedOrder { unknown_nodes: 3, .. })));

    let mut batch = StageBatch::new(&tree, &simpson(), 2).unwrap();
    let two = [0.1, 0.2];
    let good = StageInput { nodes: [&two; 3], rate: &two, force: &two, time_step: 0.01 };
    batch.set_stage(0, &good).unwrap();
    let length = |result| assert!(matches!(result, Err(ModelError::Length { .. })), "{result:?}");
    length(batch.set_stage(2, &good));
    length(batch.set_stage(0, &StageInput { force: &[0.0], ..good }));
    length(batch.set_end_node(&two, &[0.0]));
    length(batch.set_deviation(0, &two, &two, &[0.0]));
    length(batch.end_state_into(0, &mut [0.0; 3]));
    for time_step in [0.0, -0.01, f64::NAN] {
        let refused = batch.set_stage(0, &StageInput { time_step, ..good });
        assert!(matches!(refused, Err(ModelError::TimeStep { .. })));
    }
    let mut short = [0.0; 47];
    let mut output = TransitionSlice { values: &mut short, stage_stride: 24, row_stride: 6, first_state: 2 };
    length(batch.linearize(&mut output));
    assert!(batch.outcome(0).is_ok() && batch.outcome(2).is_err());
}
