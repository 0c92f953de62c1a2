//! Trees, steps and states of any numbers.

use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::prelude::*;

use crate::numbers::Numbers;

const MOST_BODIES: usize = 6;

fn vector(numbers: &mut Numbers<'_>) -> Vector3<f64> {
    Vector3::from_fn(|_, _| numbers.number())
}

fn axis(numbers: &mut Numbers<'_>) -> Vector3<f64> {
    match numbers.byte() % 5 {
        0 => Vector3::x(),
        1 => Vector3::y(),
        2 => Vector3::z(),
        3 => {
            let any = Vector3::from_fn(|_, _| numbers.ordinary());
            if any.norm() > 0.0 { any.normalize() } else { any }
        }
        _ => vector(numbers),
    }
}

fn inertia(numbers: &mut Numbers<'_>) -> LinkInertia {
    match numbers.byte() % 4 {
        0 => LinkInertia::massless(),
        1 => LinkInertia::new(numbers.number(), vector(numbers), Matrix3::from_fn(|_, _| numbers.number())),
        _ => {
            let com = Vector3::from_fn(|_, _| 0.1 * numbers.ordinary());
            LinkInertia::new(0.1 + numbers.ordinary().abs(), com, Matrix3::identity() * 0.01)
        }
    }
}

fn body(index: usize, numbers: &mut Numbers<'_>) -> Body {
    let parent = match numbers.byte() {
        0..=8 => None,
        9..=12 => Some(numbers.up_to(2 * MOST_BODIES)),
        _ => index.checked_sub(1 + numbers.up_to(index)),
    };
    let placement = match numbers.byte() % 3 {
        0 => RigidTransform::identity(),
        1 => RigidTransform::from_translation(vector(numbers)),
        _ => RigidTransform {
            rotation: Matrix3::from_fn(|_, _| numbers.number()),
            translation: vector(numbers),
        },
    };
    let joint = match numbers.byte() % 3 {
        0 => Joint::prismatic(axis(numbers), placement),
        _ => Joint::revolute(axis(numbers), placement),
    };
    let joint = match numbers.byte() % 4 {
        0 => joint.with_damping(numbers.number()),
        1 => joint.with_spring(numbers.number(), numbers.number()),
        _ => joint,
    };
    Body::new(parent, joint, inertia(numbers))
}

fn tree(numbers: &mut Numbers<'_>) -> Option<KinematicTree> {
    let gravity = if numbers.byte() % 4 == 0 { vector(numbers) } else { Vector3::new(0.0, 0.0, -9.81) };
    let mut builder = match numbers.byte() % 2 {
        0 => TreeBuilder::fixed_base(gravity),
        _ => TreeBuilder::floating_base(gravity, inertia(numbers)),
    };
    if numbers.byte() % 4 == 0 {
        builder.accept_unreal_inertia();
    }
    for index in 0..numbers.up_to(MOST_BODIES) {
        builder.add(body(index, numbers));
    }
    builder.build().ok()
}

/// A tree, a step and a state of any numbers: a step that is taken ends in numbers.
pub fn mechanics(data: &[u8]) {
    let mut numbers = Numbers(data);
    let Some(tree) = tree(&mut numbers) else { return };
    let Ok(rule) = LobattoRule::new(numbers.up_to(9)) else { return };
    let time_step = if numbers.byte() % 4 == 0 { numbers.number() } else { 0.005 };
    let Ok(mut integrator) = Integrator::new(&tree, &rule, time_step, StepOptions::default()) else { return };
    let mut state = State::zeros(&tree);
    let calm = numbers.byte() % 2 == 0;
    for value in state.q.iter_mut().chain(&mut state.p) {
        *value = if calm { numbers.ordinary() } else { numbers.number() };
    }
    let torque: Vec<f64> = (0..tree.joint_count()).map(|_| numbers.number()).collect();
    for _ in 0..2 {
        let before = state.clone();
        match integrator.step(&tree, &mut state, &StepForces::held(&torque)) {
            Ok(_) => assert!(state.check_finite().is_ok(), "{state:?}"),
            Err(_) => assert!(same_bits(&state, &before), "a refused step changes the state"),
        }
    }
    let mut kinematics = Kinematics::new(&tree);
    let configuration = match tree.is_floating() {
        true => Configuration::floating(state.base_pose, &state.q),
        false => Configuration::fixed(&state.q),
    };
    if kinematics.update_positions(&tree, &configuration).is_ok() {
        let dof = tree.dof();
        let _ = mass_matrix_into(
            &tree,
            &kinematics,
            &mut MassMatrixWorkspace::new(&tree),
            &mut vec![0.0; dof * dof],
        );
        let _ = gravity_force_into(
            &tree,
            &kinematics,
            &mut InverseDynamicsWorkspace::new(&tree),
            &mut vec![0.0; dof],
        );
    }
}

fn same_bits(a: &State, b: &State) -> bool {
    let bits = |state: &State| -> Vec<u64> {
        let pose = &state.base_pose;
        let numbers =
            state.q.iter().chain(&state.p).chain(pose.rotation.iter()).chain(pose.translation.iter());
        numbers.map(|x| x.to_bits()).collect()
    };
    bits(a) == bits(b)
}
