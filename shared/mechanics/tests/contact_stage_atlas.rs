//! The stage with contacts on Atlas: the same physics as the tree rooted at the foot, and eight points instead of two feet.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod contact_robots;
mod oracle;
mod sample_robots;

use contact_robots::{Atlas, a, atlas, b, relative};
use delmpc_mechanics::contact_stage::{BoundaryState, ContactStage};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::*;
use nalgebra::DMatrix;
use sample_robots::{difference, spread};

/// Entries of a matrix or vector of the rooted tree in the order of the floating one's joints.
fn order(atlas: &Atlas) -> Vec<usize> {
    let joints: Vec<f64> = (0..30).map(|k| k as f64).collect();
    let mut order = joints.clone();
    atlas.rooted.joints_to_floating(&joints, &mut order).unwrap();
    order.into_iter().map(|k| k as usize).collect()
}

/// `A`, `B` in the joints of the floating tree, and the joints at the end: by the contact stage, and by the tree on its foot.
struct Both {
    floating: (DMatrix<f64>, DMatrix<f64>, Vec<f64>),
    rooted: (DMatrix<f64>, DMatrix<f64>, Vec<f64>),
}

fn both(dt: f64) -> Both {
    let mut atlas = atlas();
    atlas.robot.active = vec![true, false];
    let order = order(&atlas);
    let rooted_tree = atlas.rooted.tree().clone();
    let mut kinematics = Kinematics::new(&rooted_tree);
    let q = atlas.robot.start.q.clone();
    let mut q_rooted = q.clone();
    atlas.rooted.joints_to_rooted(&q, &mut q_rooted).unwrap();
    kinematics.update_positions(&rooted_tree, &Configuration::fixed(&q_rooted)).unwrap();
    let pose = atlas.rooted.base_pose_w(&kinematics, &RigidTransform::identity());
    let robot = &mut atlas.robot;
    robot.start.orientation = pose.rotation;
    robot.start.position_w = pose.translation;
    robot.start.rate = spread(30, 0.3);
    robot.start.base_velocity_b = Vector6::zeros();
    // The base velocity that keeps the foot still: G_b V = -G_j q̇.
    let (g, _) = robot.rows(&robot.start);
    let base = g.columns(0, 6).into_owned().lu();
    let rate = DMatrix::from_column_slice(30, 1, &robot.start.rate);
    let velocity = base.solve(&(g.columns(6, 30) * &rate * -1.0)).unwrap();
    robot.start.base_velocity_b = Vector6::from_column_slice(velocity.as_slice());
    let (lifted, _, end) = robot.linear(&mut robot.stage(2), dt, &robot.start);

    // T_k: base from the joints, at fixed foot and without velocity of the foot.
    let (_, gradient) = robot.rows(&robot.start);
    let of_joints = -base.solve(&g.columns(6, 30).into_owned()).unwrap();
    let mut tangent = DMatrix::zeros(72, 60);
    tangent.view_mut((0, 0), (6, 30)).copy_from(&of_joints);
    tangent.view_mut((6, 0), (30, 30)).fill_with_identity();
    let moved = &gradient * tangent.view((0, 0), (36, 30));
    tangent.view_mut((36, 0), (6, 30)).copy_from(&-base.solve(&moved).unwrap());
    tangent.view_mut((36, 30), (6, 30)).copy_from(&of_joints);
    tangent.view_mut((42, 30), (30, 30)).fill_with_identity();
    let pick = |r: usize| if r < 30 { 6 + r } else { 12 + r };
    let full = a(&lifted) * tangent;
    let a_floating = DMatrix::from_fn(60, 60, |r, c| full[(pick(r), c)]);
    let of_force = b(&lifted);
    let b_floating = DMatrix::from_fn(60, 30, |r, c| of_force[(pick(r), c)]);

    let mut integrator = sample_robots::exact_integrator(&rooted_tree, 2, dt);
    let mut state = State::zeros(&rooted_tree);
    state.q = q_rooted;
    let into_rooted = |values: &[f64]| {
        let mut out = values.to_vec();
        atlas.rooted.joints_to_rooted(values, &mut out).unwrap();
        out
    };
    let (rate, torque) = (into_rooted(&robot.start.rate), into_rooted(&robot.u));
    integrator.velocities().set_velocity(&rooted_tree, &mut state, &rate).unwrap();
    integrator.solve(&rooted_tree, &state, &StepForces::held(&torque)).unwrap();
    let q_end = order.iter().map(|&k| integrator.next_state().q[k]).collect();
    let mut work =
        Linearizer::new(&rooted_tree, &integrator, StateCoordinates::Velocity, InputHold::Held).unwrap();
    let linear = work.linearize(&rooted_tree, &mut integrator).unwrap();
    let at = |r: usize| if r < 30 { order[r] } else { 30 + order[r - 30] };
    Both {
        floating: (a_floating, b_floating, end.q),
        rooted: (
            DMatrix::from_fn(60, 60, |r, c| linear.a(at(r), at(c))),
            DMatrix::from_fn(60, 30, |r, c| linear.b(at(r), order[c])),
            q_end,
        ),
    }
}

#[test]
fn one_flat_foot_is_the_tree_rooted_at_the_foot() {
    let mut last: Option<[f64; 3]> = None;
    for dt in [0.02, 0.01] {
        let Both { floating, rooted } = both(dt);
        let errors = [
            relative(&floating.0, &rooted.0),
            relative(&floating.1, &rooted.1),
            difference(&floating.2, &rooted.2),
        ];
        println!("dt {dt}: A {:.1e}, B {:.1e}, q {:.1e}", errors[0], errors[1], errors[2]);
        match last {
            None => assert!(errors[0] < 3e-4, "dt {dt}: {errors:?}"),
            Some(coarse) => {
                for (what, (coarse, fine)) in ["A", "B", "q"].iter().zip(coarse.iter().zip(errors)) {
                    assert!(coarse / fine > 12.0, "{what}: {coarse:e} to {fine:e}");
                }
            }
        }
        last = Some(errors);
    }
}

#[test]
fn eight_points_with_regularisation_are_two_feet() {
    let atlas = atlas();
    let (robot, dt) = (&atlas.robot, 0.02);
    let (feet, _, end) = robot.linear(&mut robot.stage(2), dt, &robot.start);
    let rule = LobattoRule::new(2).unwrap();
    let mut stage = ContactStage::new(&robot.tree, &rule, &atlas.corners).unwrap().with_regularisation(1e-8);
    let (mut nominal, mut points_end): (_, BoundaryState) = (stage.nominal(), robot.start.clone());
    let active = [true; 8];
    stage.solve(&robot.tree, dt, &active, &robot.start, &robot.u, &mut nominal, &mut points_end).unwrap();
    let away = contact_robots::local(&end, &points_end).iter().fold(0.0f64, |m, x| m.max(x.abs()));
    let mut points = stage.lifted();
    stage
        .linearize(&robot.tree, dt, &active, &robot.start, &nominal, &robot.u, &points_end, &mut points)
        .unwrap();
    let errors = [relative(&a(&points), &a(&feet)), relative(&b(&points), &b(&feet))];
    println!("end {away:.1e}, A {:.1e}, B {:.1e}", errors[0], errors[1]);
    assert!(errors[0] < 1e-6 && errors[1] < 1e-8 && away < 1e-6, "{away:e} {errors:?}");

    // Without regularisation they are refused.
    let mut stage = ContactStage::new(&robot.tree, &rule, &atlas.corners).unwrap();
    let refused =
        stage.solve(&robot.tree, dt, &active, &robot.start, &robot.u, &mut nominal, &mut points_end);
    assert!(refused.is_err());
}
