//! Numbers of any size: a step that is taken ends in numbers, any other one is refused and leaves the state alone.
#![allow(clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod sample_robots;

use delmpc_mechanics::constraints::{ConstrainedIntegrator, Constraint, ConstraintKind};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::prelude::*;
use sample_robots::{Forces, GRAVITY, arms, brick, integrator, moving_state, pendulum, spatial_chain};

/// From the ordinary to the edge of double precision.
const SIZES: [f64; 9] = [1.0, 1e10, 1e77, 1e120, 1e153, 1e200, 1e300, 1e307, f64::MAX];

fn is_finite(state: &State) -> bool {
    let pose = &state.base_pose;
    let numbers = state.q.iter().chain(&state.p).chain(pose.rotation.iter()).chain(pose.translation.iter());
    numbers.copied().all(f64::is_finite)
}

/// The states of a tree with one kind of number of a size.
fn absurd(tree: &KinematicTree, size: f64) -> Vec<State> {
    let mut list = Vec::new();
    for kind in 0..4 {
        for sign in [1.0, -1.0] {
            let mut state = moving_state(tree, 0.1, 0.2);
            match kind {
                0 => state.p.iter_mut().for_each(|p| *p = sign * size),
                1 => state.q.iter_mut().for_each(|q| *q = sign * size),
                2 => state.base_pose.translation *= sign * size,
                _ => state.p.iter_mut().chain(&mut state.q).enumerate().for_each(|(i, x)| {
                    *x = if i % 2 == 0 { sign * size } else { -size };
                }),
            }
            list.push(state);
        }
    }
    list
}

#[test]
fn a_step_that_is_taken_ends_in_numbers() {
    let forces = Forces::None;
    let trees =
        [pendulum(3, 0.7), spatial_chain(GRAVITY, forces), brick(GRAVITY, forces), arms(GRAVITY, forces)];
    let (mut taken, mut refused) = (0, 0);
    for tree in &trees {
        let torque = vec![0.0; tree.joint_count()];
        for order in 1..=4 {
            for time_step in [1e-300, 1e-12, 1e-3, 1.0, 1e9, 1e300] {
                let mut integrator = integrator(tree, order, time_step);
                for size in SIZES {
                    for mut state in absurd(tree, size) {
                        let before = state.clone();
                        // Twice: the second step goes another way.
                        for _ in 0..2 {
                            match integrator.step(tree, &mut state, &StepForces::held(&torque)) {
                                Ok(_) => {
                                    taken += 1;
                                    assert!(
                                        is_finite(&state),
                                        "s = {order}, {time_step:e} s: {before:?} to {state:?}"
                                    );
                                }
                                Err(_) => refused += 1,
                            }
                        }
                    }
                }
            }
        }
    }
    assert!(taken > 100 && refused > 100, "{taken} taken, {refused} refused");
}

#[test]
fn a_constrained_step_that_is_taken_ends_in_numbers() {
    let tree = pendulum(3, 0.7);
    let torque = [0.0; 3];
    let tip =
        ConstraintKind::Point { body: 2, point: Vector3::zeros(), target_w: Vector3::new(0.3, 0.2, 0.0) };
    for order in 1..=3 {
        for time_step in [1e-12, 1e-3, 1.0, 1e300] {
            let rule = LobattoRule::new(order).unwrap();
            let constraints = [Constraint::new(tip).rows(&[0])];
            let mut integrator =
                ConstrainedIntegrator::new(&tree, &constraints, &rule, time_step, None, Default::default())
                    .unwrap();
            for size in SIZES {
                for mut state in absurd(&tree, size) {
                    let before = state.clone();
                    if integrator.step(&tree, &mut state, &StepForces::held(&torque)).is_ok() {
                        assert!(is_finite(&state), "s = {order}, {time_step:e} s: {before:?} to {state:?}");
                    }
                }
            }
        }
    }
}
