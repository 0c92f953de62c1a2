//! Every rule a model or a step can break: refused with a typed error that names the body (or index) and the rule.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod sample_robots;

use delmpc_mechanics::del_residual::ForceCapacity;
use delmpc_mechanics::errors::{FactorError, ModelError, StepError};
use delmpc_mechanics::forces::{BodySample, WrenchSample};
use delmpc_mechanics::lobatto::MAX_UNKNOWN_NODES;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::SpatialInertia;
use delmpc_mechanics::velocity::VelocityWorkspace;
use nalgebra::Matrix6;
use sample_robots::{Forces, GRAVITY, arms, integrator, moving_state, spatial_chain};

const NAN: f64 = f64::NAN;

fn sound_body(parent: Option<usize>) -> Body {
    let inertia = LinkInertia::new(
        2.0,
        Vector3::new(0.1, 0.0, -0.2),
        Matrix3::from_diagonal(&Vector3::new(0.1, 0.2, 0.25)),
    );
    Body::new(parent, Joint::revolute(Vector3::z(), RigidTransform::identity()), inertia)
}

/// A chain of four bodies whose body 2 is spoilt.
fn build_with(spoil: impl Fn(&mut Body)) -> Result<KinematicTree, ModelError> {
    let mut builder = TreeBuilder::fixed_base(Vector3::from(GRAVITY));
    for index in 0..4usize {
        let mut body = sound_body(index.checked_sub(1));
        if index == 2 {
            spoil(&mut body);
        }
        builder.add(body);
    }
    builder.build()
}

/// One broken rule of the model: what it is, how to break it, the error's variant, a word of its message.
type Rule = (&'static str, fn(&mut Body), fn(&ModelError) -> bool, &'static str);

const RULES: &[Rule] = &[
    (
        "mass NaN",
        |b| b.inertia.mass = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "mass" }),
        "mass",
    ),
    (
        "mass infinite",
        |b| b.inertia.mass = f64::INFINITY,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "mass" }),
        "not finite",
    ),
    (
        "mass centre NaN",
        |b| b.inertia.com.y = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "mass centre" }),
        "mass centre",
    ),
    (
        "inertia NaN",
        |b| b.inertia.inertia[(0, 1)] = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "inertia" }),
        "inertia",
    ),
    (
        "axis NaN",
        |b| b.joint.axis.x = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "joint axis" }),
        "joint axis",
    ),
    (
        "placement rotation NaN",
        |b| b.joint.placement.rotation[(1, 1)] = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "placement rotation" }),
        "placement",
    ),
    (
        "placement translation infinite",
        |b| b.joint.placement.translation.z = f64::NEG_INFINITY,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "placement translation" }),
        "placement",
    ),
    (
        "damping NaN",
        |b| b.joint.damping = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "joint damping" }),
        "damping",
    ),
    (
        "stiffness NaN",
        |b| b.joint.stiffness = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "joint spring" }),
        "spring",
    ),
    (
        "rest NaN",
        |b| b.joint.rest = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "joint spring" }),
        "spring",
    ),
    (
        "drag NaN",
        |b| b.drag[4] = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "drag" }),
        "drag",
    ),
    (
        "constant wrench NaN",
        |b| b.constant_wrench_b.force.x = NAN,
        |e| matches!(e, ModelError::NotFinite { body: 2, quantity: "constant wrench" }),
        "wrench",
    ),
    (
        "axis of length 2",
        |b| b.joint.axis *= 2.0,
        |e| matches!(e, ModelError::AxisNotUnit { body: 2, length } if *length == 2.0),
        "axis",
    ),
    (
        "axis of length 0",
        |b| b.joint.axis *= 0.0,
        |e| matches!(e, ModelError::AxisNotUnit { body: 2, length } if *length == 0.0),
        "axis",
    ),
    (
        "placement scaled",
        |b| b.joint.placement.rotation *= 1.1,
        |e| matches!(e, ModelError::PlacementNotRotation { body: 2, defect } if (defect - 0.21).abs() < 1e-9),
        "orthonormal",
    ),
    (
        "placement mirrored",
        |b| b.joint.placement.rotation *= -1.0,
        |e| matches!(e, ModelError::PlacementNotRotation { body: 2, defect } if defect.is_infinite()),
        "mirrored",
    ),
    (
        "negative mass",
        |b| b.inertia.mass = -1.5,
        |e| matches!(e, ModelError::NegativeMass { body: 2, mass } if *mass == -1.5),
        "mass -1.5 kg",
    ),
    (
        "inertia not symmetric",
        |b| b.inertia.inertia[(0, 1)] = 0.01,
        |e| matches!(e, ModelError::InertiaNotSymmetric { body: 2, defect } if (defect - 0.01).abs() < 1e-12),
        "not symmetric",
    ),
    (
        "negative moment of inertia",
        |b| b.inertia.inertia = Matrix3::from_diagonal(&Vector3::new(-0.1, 0.2, 0.2)),
        |e| matches!(e, ModelError::InertiaNotPositive { body: 2, moment } if (moment + 0.1).abs() < 1e-12),
        "negative",
    ),
    (
        "triangle inequality broken",
        |b| b.inertia.inertia = Matrix3::from_diagonal(&Vector3::new(0.1, 0.1, 0.3)),
        |e| matches!(e, ModelError::InertiaTriangle { body: 2, excess } if (excess - 0.1).abs() < 1e-12),
        "triangle inequality",
    ),
    (
        "inertia without mass",
        |b| b.inertia.mass = 0.0,
        |e| matches!(e, ModelError::InertiaWithoutMass { body: 2 }),
        "no mass",
    ),
    (
        "negative damping",
        |b| b.joint.damping = -0.1,
        |e| matches!(e, ModelError::NegativeDamping { body: 2, damping } if *damping == -0.1),
        "damping -0.1",
    ),
    (
        "negative drag",
        |b| b.drag[5] = -0.2,
        |e| matches!(e, ModelError::NegativeDrag { body: 2, coefficient } if *coefficient == -0.2),
        "drag coefficient -0.2",
    ),
    (
        "parent after child",
        |b| b.parent = Some(3),
        |e| matches!(e, ModelError::ParentAfterChild { body: 2, parent: 3 }),
        "parent 3",
    ),
    (
        "own parent",
        |b| b.parent = Some(2),
        |e| matches!(e, ModelError::ParentAfterChild { body: 2, parent: 2 }),
        "before its child",
    ),
    (
        "parent that does not exist",
        |b| b.parent = Some(99),
        |e| matches!(e, ModelError::ParentAfterChild { body: 2, parent: 99 }),
        "parent 99",
    ),
];

#[test]
fn every_broken_rule_of_a_body_is_refused_with_body_and_rule() {
    assert!(build_with(|_| ()).is_ok());
    for (what, spoil, expected, word) in RULES {
        let error = build_with(spoil).expect_err(what);
        assert!(expected(&error), "{what}: {error:?}");
        let message = error.to_string();
        assert!(message.contains("body 2") && message.contains(word), "{what}: {message}");
    }
}

#[test]
fn the_same_rules_hold_for_a_floating_base() {
    let build = |spoil: &dyn Fn(&mut LinkInertia)| {
        let mut inertia = sound_body(None).inertia;
        spoil(&mut inertia);
        TreeBuilder::floating_base(Vector3::zeros(), inertia).build()
    };
    assert!(build(&|_| ()).is_ok());
    assert_eq!(build(&|i| i.mass = -1.0).unwrap_err(), ModelError::NegativeMass { body: 0, mass: -1.0 });
    assert_eq!(
        build(&|i| i.com.x = NAN).unwrap_err(),
        ModelError::NotFinite { body: 0, quantity: "mass centre" }
    );
    assert!(matches!(
        build(&|i| i.inertia *= -1.0).unwrap_err(),
        ModelError::InertiaNotPositive { body: 0, .. }
    ));
    assert!(matches!(
        build(&|i| *i = LinkInertia::massless()).unwrap_err(),
        ModelError::MasslessSubtree { body: 0 }
    ));
    let mut builder = TreeBuilder::floating_base(Vector3::zeros(), sound_body(None).inertia);
    builder.set_base_wrenches(Vector6::new(0.0, 0.0, -1.0, 0.0, 0.0, 0.0), Wrench::default());
    assert_eq!(builder.build().unwrap_err(), ModelError::NegativeDrag { body: 0, coefficient: -1.0 });
}

#[test]
fn a_floating_tree_has_one_root() {
    let mut builder = TreeBuilder::floating_base(Vector3::zeros(), sound_body(None).inertia);
    builder.add(sound_body(Some(0)));
    builder.add(sound_body(None));
    let error = builder.build().unwrap_err();
    assert!(matches!(error, ModelError::Unsupported { body: 2, .. }), "{error:?}");
    assert!(error.to_string().contains("one root") && error.to_string().contains("body 2"), "{error}");
}

#[test]
fn a_joint_that_carries_no_mass_is_refused() {
    // The second of two massless bodies at the end of a chain, and both.
    for (massless, named) in [(vec![3], 3), (vec![2, 3], 2), (vec![0, 1, 2, 3], 0)] {
        let mut builder = TreeBuilder::fixed_base(Vector3::zeros());
        for index in 0..4usize {
            let mut body = sound_body(index.checked_sub(1));
            if massless.contains(&index) {
                body.inertia = LinkInertia::massless();
            }
            builder.add(body);
        }
        let error = builder.build().unwrap_err();
        assert_eq!(error, ModelError::MasslessSubtree { body: named });
        assert!(error.to_string().contains(&format!("body {named}")), "{error}");
    }
    assert!(build_with(|b| b.inertia = LinkInertia::massless()).is_ok(), "between masses it is legal");
}

#[test]
fn a_tree_without_bodies_and_gravity_that_is_not_finite_are_refused() {
    assert_eq!(TreeBuilder::fixed_base(Vector3::zeros()).build().unwrap_err(), ModelError::Empty);
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, NAN, 0.0));
    builder.add(sound_body(None));
    let error = builder.build().unwrap_err();
    assert!(matches!(error, ModelError::NotFinite { quantity: "gravity", .. }), "{error:?}");
}

#[test]
fn an_unreal_inertia_passes_only_on_request() {
    let unreal = Matrix3::from_diagonal(&Vector3::new(0.1, 0.1, 0.3));
    let mut builder = TreeBuilder::fixed_base(Vector3::zeros());
    let mut body = sound_body(None);
    body.inertia.inertia = unreal;
    builder.add(body);
    assert!(builder.clone().build().is_err());
    builder.accept_unreal_inertia();
    assert!(builder.build().is_ok());
}

#[test]
fn orders_and_time_steps_out_of_range_are_refused() {
    for s in [0, MAX_UNKNOWN_NODES + 1, usize::MAX] {
        let error = LobattoRule::new(s).unwrap_err();
        assert_eq!(error, ModelError::UnsupportedOrder { unknown_nodes: s, limit: MAX_UNKNOWN_NODES });
        assert!(error.to_string().contains(&s.to_string()), "{error}");
    }
    let tree = spatial_chain(GRAVITY, Forces::None);
    let rule = LobattoRule::new(2).unwrap();
    for time_step in [0.0, -0.0, -0.01, NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let error = Integrator::new(&tree, &rule, time_step, StepOptions::default()).unwrap_err();
        assert!(matches!(error, ModelError::TimeStep { .. }), "{time_step}: {error:?}");
        let mut sound = integrator(&tree, 2, 0.01);
        assert!(sound.set_time_step(time_step).is_err(), "{time_step}");
        assert_eq!(sound.del().time_step(), 0.01, "a refused time step changes nothing");
    }
}

/// A law without effect on body `0`.
struct NoWrench(usize);

impl WrenchLaw for NoWrench {
    fn body(&self) -> usize {
        self.0
    }
    fn evaluate(&self, _: &BodySample) -> WrenchSample {
        WrenchSample { wrench_w: Wrench::default(), d_pose: Matrix6::zeros(), d_velocity: Matrix6::zeros() }
    }
}

/// A law that answers NaN.
struct NanWrench;

impl WrenchLaw for NanWrench {
    fn body(&self) -> usize {
        1
    }
    fn evaluate(&self, _: &BodySample) -> WrenchSample {
        let wrench_w = Wrench::new(Vector3::zeros(), Vector3::new(NAN, 0.0, 0.0));
        WrenchSample { wrench_w, d_pose: Matrix6::zeros(), d_velocity: Matrix6::zeros() }
    }
}

fn bits(state: &State) -> Vec<u64> {
    let pose = state.base_pose.rotation.iter().chain(state.base_pose.translation.iter());
    pose.chain(&state.q).chain(&state.p).map(|x| x.to_bits()).collect()
}

/// Tries a step that must fail, checks that the state is untouched to the bit, and that the integrator still works afterwards.
fn refused(
    integrator: &mut Integrator,
    tree: &KinematicTree,
    state: &State,
    forces: &StepForces<'_>,
    expected: impl Fn(&StepError) -> bool,
    words: &[&str],
) {
    let mut tried = state.clone();
    let error = integrator.step(tree, &mut tried, forces).unwrap_err();
    assert!(expected(&error), "{error:?}");
    assert_eq!(bits(&tried), bits(state), "{error}: the state was touched");
    let message = error.to_string();
    for word in words {
        assert!(message.contains(word), "'{message}' does not say '{word}'");
    }
}

/// The integrator with room for one point force and laws.
fn roomy(tree: &KinematicTree) -> Integrator {
    let forces = ForceCapacity { points: 1, laws: true };
    let options = StepOptions { forces, ..StepOptions::default() };
    Integrator::new(tree, &LobattoRule::new(2).unwrap(), 0.01, options).unwrap()
}

#[test]
fn states_and_forces_that_do_not_fit_or_are_not_finite_are_refused_with_their_index() {
    for tree in [spatial_chain(GRAVITY, Forces::All), arms(GRAVITY, Forces::All)] {
        let state = moving_state(&tree, 2.0, 0.5);
        let joints = tree.joint_count();
        let integrator = &mut roomy(&tree);
        let torque = vec![0.1; joints];
        let held = StepForces::held(&torque);
        let quantity = |name: &'static str, at: usize| move |e: &StepError| matches!(e, StepError::NonFinite { quantity, index } if *quantity == name && *index == at);
        let length = |name: &'static str| move |e: &StepError| matches!(e, StepError::Argument(ModelError::Length { quantity, .. }) if *quantity == name);
        let spoilt = |spoil: &dyn Fn(&mut State)| {
            let mut copy = state.clone();
            spoil(&mut copy);
            copy
        };

        refused(integrator, &tree, &spoilt(&|s| s.q[1] = NAN), &held, quantity("q", 1), &["q", "index 1"]);
        let last = tree.dof() - 1;
        let bad = spoilt(&|s| s.p[last] = f64::INFINITY);
        refused(integrator, &tree, &bad, &held, quantity("p", last), &[&format!("index {last}")]);
        let bad = spoilt(&|s| s.base_pose.rotation[(1, 0)] = NAN);
        refused(integrator, &tree, &bad, &held, quantity("base rotation", 1), &["rotation"]);
        let bad = spoilt(&|s| s.base_pose.translation.z = NAN);
        refused(integrator, &tree, &bad, &held, quantity("base position", 2), &["position"]);
        let bad = spoilt(&|s| s.q.push(0.0));
        refused(
            integrator,
            &tree,
            &bad,
            &held,
            length("joint coordinates q"),
            &[&format!("{joints} are needed")],
        );
        let bad = spoilt(&|s| s.p.truncate(1));
        refused(integrator, &tree, &bad, &held, length("momenta p"), &["1 entries"]);

        let forces = StepForces::held(&torque[1..]);
        refused(integrator, &tree, &state, &forces, length("held joint forces"), &["held joint forces"]);
        let forces = StepForces::per_node(&torque);
        refused(integrator, &tree, &state, &forces, length("joint forces per node"), &["per node"]);
        let mut broken = torque.clone();
        broken[2] = NAN;
        refused(
            integrator,
            &tree,
            &state,
            &StepForces::held(&broken),
            quantity("joint force", 2),
            &["index 2"],
        );
        let mut nodes = vec![0.0; 3 * joints];
        nodes[2 * joints + 1] = f64::NEG_INFINITY;
        let at = 2 * joints + 1;
        refused(
            integrator,
            &tree,
            &state,
            &StepForces::per_node(&nodes),
            quantity("joint force", at),
            &["not finite"],
        );

        let push = PointForce { body: 1, point_b: Vector3::zeros(), force_w: Vector3::x() };
        let two = [push, push];
        let forces = held.with_points(&two);
        refused(
            integrator,
            &tree,
            &state,
            &forces,
            length("point forces (capacity of the workspace)"),
            &["2 entries", "1 are needed"],
        );
        let nowhere = [PointForce { body: 77, ..push }];
        let unsupported = |at: usize| move |e: &StepError| matches!(e, StepError::Argument(ModelError::Unsupported { body, .. }) if *body == at);
        refused(
            integrator,
            &tree,
            &state,
            &held.with_points(&nowhere),
            unsupported(77),
            &["body 77", "point force"],
        );
        let broken = [PointForce { force_w: Vector3::new(0.0, NAN, 0.0), ..push }];
        refused(
            integrator,
            &tree,
            &state,
            &held.with_points(&broken),
            quantity("point force", 1),
            &["point force"],
        );
        let broken = [PointForce { point_b: Vector3::new(0.0, 0.0, NAN), ..push }];
        let expected = quantity("point of a point force", 2);
        refused(integrator, &tree, &state, &held.with_points(&broken), expected, &["index 2"]);

        let laws: [&dyn WrenchLaw; 1] = [&NoWrench(77)];
        refused(integrator, &tree, &state, &held.with_laws(&laws), unsupported(77), &["body 77", "law"]);
        let laws: [&dyn WrenchLaw; 1] = [&NanWrench];
        let residual = |e: &StepError| matches!(e, StepError::NonFinite { quantity, .. } if quantity.contains("residual"));
        refused(integrator, &tree, &state, &held.with_laws(&laws), residual, &["residual"]);
        let laws: [&dyn WrenchLaw; 1] = [&NoWrench(1)];
        let without_room = &mut sample_robots::integrator(&tree, 2, 0.01);
        refused(without_room, &tree, &state, &held.with_laws(&laws), unsupported(1), &["without room"]);

        let mut copy = state.clone();
        integrator.step(&tree, &mut copy, &held.with_laws(&laws)).unwrap();
        assert_ne!(bits(&copy), bits(&state), "after all these refusals a sound step goes through");
    }
}

#[test]
fn a_workspace_of_another_tree_is_refused() {
    let (small, large) = (spatial_chain(GRAVITY, Forces::None), arms(GRAVITY, Forces::None));
    let state = moving_state(&large, 1.0, 0.5);
    let torque = vec![0.0; large.joint_count()];
    let length = |e: &StepError| matches!(e, StepError::Argument(ModelError::Length { .. }));
    refused(&mut integrator(&small, 2, 0.01), &large, &state, &StepForces::held(&torque), length, &["tree"]);
    let mut velocity = vec![0.0; large.dof()];
    assert!(VelocityWorkspace::new(&small).velocity_into(&large, &state, &mut velocity).is_err());
}

#[test]
fn velocities_of_the_wrong_length_are_refused() {
    let tree = arms(GRAVITY, Forces::None);
    let state = moving_state(&tree, 1.0, 0.5);
    let mut work = VelocityWorkspace::new(&tree);
    let mut copy = state.clone();
    assert!(work.set_velocity(&tree, &mut copy, &[0.0; 9]).is_err());
    let short = State { q: vec![0.0; 2], ..state };
    assert!(work.velocity_into(&tree, &short, &mut [0.0; 10]).is_err());
}

#[test]
fn a_velocity_buffer_of_the_wrong_length_is_refused() {
    let tree = arms(GRAVITY, Forces::None);
    let state = moving_state(&tree, 1.0, 0.5);
    let mut work = VelocityWorkspace::new(&tree);
    assert!(work.velocity_into(&tree, &state, &mut [0.0; 4]).is_err());
}

#[test]
fn steps_without_a_solution_nearby_fail_and_leave_the_state_alone() {
    // A torque that would turn the first link by many turns within the step.
    let tree = spatial_chain(GRAVITY, Forces::None);
    let state = moving_state(&tree, 0.0, 0.5);
    let failed = |e: &StepError| {
        matches!(
            e,
            StepError::NotConverged { .. }
                | StepError::SpuriousSolution { .. }
                | StepError::Singular(FactorError::SingularPivot { .. })
        )
    };
    for torque in [1e5, 1e8, 1e200] {
        let integrator = &mut integrator(&tree, 2, 0.1);
        refused(
            integrator,
            &tree,
            &state,
            &StepForces::held(&[torque, 0.0, -torque]),
            failed_or_overflow(failed),
            &[],
        );
    }
    let floating = arms(GRAVITY, Forces::None);
    let spinning = moving_state(&floating, 200.0, 0.0);
    let integrator = &mut integrator(&floating, 2, 0.1);
    refused(integrator, &floating, &spinning, &StepForces::held(&[0.0; 4]), failed_or_overflow(failed), &[]);
}

/// Beyond the range of floating point the residual overflows instead.
fn failed_or_overflow(failed: impl Fn(&StepError) -> bool) -> impl Fn(&StepError) -> bool {
    move |e| failed(e) || matches!(e, StepError::NonFinite { .. })
}

#[test]
fn a_step_that_needs_more_iterations_than_allowed_says_how_far_it_came() {
    let tree = arms(GRAVITY, Forces::None);
    let state = moving_state(&tree, 3.0, 1.0);
    let options = StepOptions { max_iterations: 1, ..StepOptions::default() };
    let mut integrator = Integrator::new(&tree, &LobattoRule::new(2).unwrap(), 0.02, options).unwrap();
    let expected = |e: &StepError| {
        matches!(e, StepError::NotConverged { residual, change, iterations }
            if *iterations > 0 && residual.is_finite() && *residual > 0.0 && *change > 0.0)
    };
    refused(
        &mut integrator,
        &tree,
        &state,
        &StepForces::held(&[0.0; 4]),
        expected,
        &["iterations", "residual"],
    );
}

#[test]
fn linearisations_that_do_not_exist_are_refused() {
    let floating = arms(GRAVITY, Forces::None);
    let work = integrator(&floating, 2, 0.01);
    let error = Linearizer::new(&floating, &work, StateCoordinates::Velocity, InputHold::Held).unwrap_err();
    assert!(matches!(error, ModelError::Unsupported { .. }), "{error:?}");

    let tree = spatial_chain(GRAVITY, Forces::None);
    let mut work = integrator(&tree, 2, 0.01);
    let state = moving_state(&tree, 0.0, 0.5);
    work.solve(&tree, &state, &StepForces::held(&[0.0; 3])).unwrap();
    let mut velocity = Linearizer::new(&tree, &work, StateCoordinates::Velocity, InputHold::Held).unwrap();
    assert!(velocity.linearize_by_tangent(&tree, &mut work).is_err());
    let mut momentum = Linearizer::new(&tree, &work, StateCoordinates::Momentum, InputHold::Held).unwrap();
    for (lambda, a, b, name) in [(5, 6, 3, "lambda"), (6, 7, 3, "a_lambda"), (6, 6, 2, "b_lambda")] {
        let error = momentum
            .adjoint_into(&tree, &mut work, &vec![1.0; lambda], &mut vec![0.0; a], &mut vec![0.0; b])
            .unwrap_err();
        let named =
            matches!(error, StepError::Argument(ModelError::Length { quantity, .. }) if quantity == name);
        assert!(named, "{name}: {error:?}");
    }
}

#[test]
fn mass_welded_to_the_ground_is_not_part_of_the_motion() {
    let mut builder = TreeBuilder::fixed_base(Vector3::from(GRAVITY));
    builder.add(sound_body(None));
    builder.set_ground_inertia(SpatialInertia::from_central(5.0, &Vector3::zeros(), &Matrix3::identity()));
    assert_eq!(builder.build().unwrap().total_mass(), 7.0);
}
