//! What the stage with contacts must keep: feet that stay, order, symplecticity, impacts, momentum, identities of `A`, quadratic
//! convergence of the lifted horizon.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod contact_robots;
mod oracle;
mod sample_robots;

use contact_robots::{Robot, a, arms_on_a_foot, atlas, b, canonical, local, moved, quadruped_on, relative};
use delmpc_mechanics::contact_stage::{BoundaryKinematics, BoundaryState, Contact, ContactStage};
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::spatial::{exp_rotation, log_rotation};
use nalgebra::{DMatrix, DVector};
use sample_robots::{Forces, difference};

const ALL: [bool; 4] = [true; 4];
const DIAGONAL: [bool; 4] = [true, false, false, true];

fn robots() -> Vec<(&'static str, Robot)> {
    vec![
        ("four points", quadruped_on(&ALL, Forces::None)),
        ("two points", quadruped_on(&DIAGONAL, Forces::Springs)),
        ("two feet", atlas().robot),
    ]
}

#[test]
fn feet_stay_on_their_leaf_for_a_second_at_any_stage_length() {
    let mut robot = quadruped_on(&ALL, Forces::Springs);
    robot.start.base_velocity_b *= 0.3;
    robot.start.rate.fill(0.0);
    robot.start = robot.projected(&robot.start);
    robot.u = robot.static_forces();
    let before = robot.points(&robot.start);
    for dt in [0.005, 0.01, 0.02, 0.04] {
        let mut stage = robot.stage(2);
        let mut state = robot.start.clone();
        for _ in 0..(1.0 / dt) as usize {
            state = robot.solve(&mut stage, dt, &state).1;
        }
        let drift = difference(&robot.points(&state), &before);
        println!("dt {dt}: drift {drift:.1e} m");
        assert!(drift < 1e-12, "dt {dt}: {drift:e}");
        assert!(local(&robot.start, &state).iter().any(|x| x.abs() > 1e-2), "the robot has not moved");
    }
}

/// Largest errors of pose and velocity after `time`.
fn error(robot: &Robot, time: f64, steps: usize, reference: &BoundaryState) -> [f64; 2] {
    let x = local(reference, &run(robot, 2, time, steps));
    let nv = robot.tree.dof();
    [&x[..nv], &x[nv..]].map(|part| part.iter().fold(0.0f64, |m, v| m.max(v.abs())))
}

fn run(robot: &Robot, s: usize, time: f64, steps: usize) -> BoundaryState {
    let mut stage = robot.stage(s);
    let mut state = robot.start.clone();
    for _ in 0..steps {
        state = robot.solve(&mut stage, time / steps as f64, &state).1;
    }
    state
}

#[test]
fn the_stage_has_order_four() {
    for (name, robot, time, steps) in [
        ("four points", quadruped_on(&ALL, Forces::Springs), 0.2, 20),
        ("two points", quadruped_on(&DIAGONAL, Forces::Springs), 0.1, 20),
        ("two feet", atlas().robot, 0.08, 8),
    ] {
        let reference = run(&robot, 4, time, 4 * steps);
        let (coarse, fine) =
            (error(&robot, time, steps, &reference), error(&robot, time, 2 * steps, &reference));
        for (what, (coarse, fine)) in ["pose", "velocity"].iter().zip(coarse.into_iter().zip(fine)) {
            let order = (coarse / fine).log2();
            println!("{name}, {what}: order {order:.2} ({coarse:.1e}, {fine:.1e})");
            assert!(order >= 3.5, "{name}, {what}: order {order}");
        }
    }
}

/// A basis of the kernel of the rows.
fn kernel(rows: &DMatrix<f64>) -> DMatrix<f64> {
    let n = rows.ncols();
    let mut square = DMatrix::zeros(n, n);
    square.rows_mut(0, rows.nrows()).copy_from(rows);
    let svd = square.svd(false, true);
    let v = svd.v_t.unwrap().transpose();
    let limit = 1e-9 * svd.singular_values.amax();
    let free: Vec<usize> = (0..n).filter(|&k| svd.singular_values[k] < limit).collect();
    DMatrix::from_fn(n, free.len(), |r, c| v[(r, free[c])])
}

#[test]
fn the_stage_is_symplectic_on_the_manifold() {
    for ((name, robot), s) in robots().into_iter().flat_map(|robot| [1, 2, 3].map(|s| (robot.clone(), s))) {
        let nv = robot.tree.dof();
        let (lifted, _, end) = robot.linear(&mut robot.stage(s), 0.01, &robot.start);
        let (g, gradient) = robot.rows(&robot.start);
        let m = g.nrows();
        let mut rows = DMatrix::zeros(2 * m, 2 * nv);
        rows.view_mut((0, 0), (m, nv)).copy_from(&g);
        rows.view_mut((m, 0), (m, nv)).copy_from(&gradient);
        rows.view_mut((m, nv), (m, nv)).copy_from(&g);
        let basis = kernel(&rows);
        assert_eq!(basis.ncols(), 2 * (nv - m), "{name}");
        let mut omega = DMatrix::zeros(2 * nv, 2 * nv);
        for k in 0..nv {
            omega[(k, nv + k)] = 1.0;
            omega[(nv + k, k)] = -1.0;
        }
        let before = canonical(&robot.tree, &robot.start) * &basis;
        let after = canonical(&robot.tree, &end) * a(&lifted) * &basis;
        let (before, after) = (before.transpose() * &omega * &before, after.transpose() * &omega * &after);
        let defect = (&after - &before).amax() / before.amax();
        println!("{name}, s = {s}: {defect:.1e}");
        assert!(defect < 1e-11, "{name}, s = {s}: {defect:e}");
    }
}

#[test]
fn impacts_vanish_and_feet_and_their_velocities_are_kept_by_a() {
    for (name, robot) in robots() {
        let nv = robot.tree.dof();
        let (lifted, _, end) = robot.linear(&mut robot.stage(2), 0.02, &robot.start);
        let a = a(&lifted);
        let (g, _) = robot.rows(&robot.start);
        let (g_end, gradient) = robot.rows(&end);
        let m = g.nrows();
        let mass = DMatrix::from_row_slice(nv, nv, robot.boundary(&robot.start).mass_matrix());
        let impacts = mass.lu().solve(&g.transpose()).unwrap();
        let killed = a.columns(nv, nv) * &impacts;
        let mut y = DMatrix::zeros(m, 2 * nv);
        y.columns_mut(0, nv).copy_from(&gradient);
        y.columns_mut(nv, nv).copy_from(&g_end);
        let slipping = y * &a;
        let mut leaf = &g_end * a.rows(0, nv);
        for column in 0..nv {
            for row in 0..m {
                leaf[(row, column)] -= g[(row, column)];
            }
        }
        for (what, defect) in [
            ("A [0; M^-1 G']", killed.amax() / (a.amax() * impacts.amax())),
            ("Y A", slipping.amax() / a.amax()),
            ("G A - G", leaf.amax()),
        ] {
            println!("{name}: {what} {defect:.1e}");
            assert!(defect < 1e-11, "{name}: {what} {defect:e}");
        }
    }
}

/// The robot with a velocity that its contacts do not allow.
fn touching_down(mut robot: Robot) -> Robot {
    robot.start.base_velocity_b += Vector6::new(0.1, 0.2, -0.1, 0.1, 0.05, -0.3);
    robot
}

#[test]
fn a_touchdown_is_the_impact_and_the_step_after_it() {
    for (name, robot) in robots() {
        let robot = touching_down(robot);
        let mut stage = robot.stage(2);
        let (nominal, end) = robot.solve(&mut stage, 0.01, &robot.start);
        let after = robot.projected(&robot.start);
        let (of_after, end_of_after) = robot.solve(&mut stage, 0.01, &after);
        let size = |x: &[f64]| x.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        let away = size(&local(&end_of_after, &end)) / (1.0 + size(&end.rate));
        let mut projection = robot.projection(&robot.start);
        let mut velocity = robot.boundary(&robot.start).velocity().to_vec();
        let impulse = projection.project(&mut velocity).unwrap();
        let rows: Vec<usize> =
            (0..robot.contacts.len()).filter(|c| robot.active[*c]).flat_map(|c| stage.rows_of(c)).collect();
        let jump: Vec<f64> = rows.iter().map(|&r| nominal.multipliers[r] - of_after.multipliers[r]).collect();
        let scale = impulse.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        let difference = difference(&jump, impulse) / scale;
        println!("{name}: state {away:.1e}, impulse {difference:.1e}");
        assert!(away < 1e-11 && difference < 1e-11, "{name}: {away:e} {difference:e}");
    }
}

/// Fourth-order central difference.
fn difference_quotient(h: f64, mut value: impl FnMut(f64) -> Vec<f64>) -> DVector<f64> {
    let mut at = |change: f64| DVector::from_vec(value(change));
    let (near, far) = (at(h) - at(-h), at(2.0 * h) - at(-2.0 * h));
    (near * 8.0 - far) / (12.0 * h)
}

#[test]
fn a_and_b_of_a_touchdown_match_differences() {
    let dragged = ("arms with drag on a foot", arms_on_a_foot());
    for (name, robot) in robots().into_iter().chain([dragged]) {
        let mut robot = touching_down(robot);
        // Wide: the hands of Atlas hardly have an inertia about their axes, their rates carry 1e-11 of round-off.
        let (dt, h, n) = (0.01, 1e-3, 2 * robot.tree.dof());
        let mut stage = robot.stage(2);
        let (lifted, _, end) = robot.linear(&mut stage, dt, &robot.start);
        let (mut by_state, mut by_force) =
            (DMatrix::zeros(n, n), DMatrix::zeros(n, robot.tree.joint_count()));
        for column in 0..n {
            let slope = difference_quotient(h, |change| {
                let mut x = vec![0.0; n];
                x[column] = change;
                local(&end, &robot.solve(&mut stage, dt, &moved(&robot.start, &x)).1)
            });
            by_state.set_column(column, &slope);
        }
        for column in 0..robot.tree.joint_count() {
            let held = robot.u[column];
            let slope = difference_quotient(10.0 * h, |change| {
                robot.u[column] = held + change;
                local(&end, &robot.solve(&mut stage, dt, &robot.start).1)
            });
            robot.u[column] = held;
            by_force.set_column(column, &slope);
        }
        let errors = [relative(&a(&lifted), &by_state), relative(&b(&lifted), &by_force)];
        println!("{name}: A {:.1e}, B {:.1e}", errors[0], errors[1]);
        assert!(errors.iter().all(|e| *e < 1e-7), "{name}: {errors:?}");
    }
}

#[test]
fn momentum_changes_by_weight_and_contact_impulses() {
    for (name, robot) in robots() {
        let (dt, s) = (0.02, 2);
        let mut stage = robot.stage(s);
        let (nominal, end) = robot.solve(&mut stage, dt, &robot.start);
        let rule = LobattoRule::new(s).unwrap();
        let part = |alpha: usize, at: usize| {
            let xi = &nominal.xi[(alpha - 1) * 6 + at..][..3];
            Vector3::new(xi[0], xi[1], xi[2])
        };
        let center = robot.start.orientation * exp_rotation(&part(s, 0));
        let middle = robot.start.position_w + center * part(s, 3);
        let mut change = Wrench::default();
        for alpha in 0..=s {
            let mut node = robot.start.clone();
            if alpha > 0 {
                node.orientation = center * exp_rotation(&part(alpha, 0));
                node.position_w = middle + center * part(alpha, 3);
                let joints = robot.tree.joint_count();
                node.q = nominal.q[(alpha - 1) * joints..alpha * joints].to_vec();
            }
            let boundary = robot.boundary(&node);
            let weight = *robot.tree.gravity_w() * (robot.tree.total_mass() * rule.weights()[alpha] * dt);
            change += Wrench::new(boundary.mass_centre_w(&robot.tree).cross(&weight), weight);
            for (index, contact) in robot.contacts.iter().enumerate().filter(|(c, _)| robot.active[*c]) {
                let x = boundary.placement(&robot.tree, contact).point_w;
                let first = alpha * nominal.rows();
                let values = &nominal.multipliers[first..][stage.rows_of(index)];
                let at = values.len() - 3;
                let force = contact.axes_w * Vector3::from_row_slice(&values[at..]);
                let torque = if at == 3 {
                    contact.axes_w * Vector3::from_row_slice(&values[..3])
                } else {
                    Vector3::zeros()
                };
                change += Wrench::new(torque + x.cross(&force), force);
            }
        }
        let gained = robot.boundary(&end).momentum_w() - robot.boundary(&robot.start).momentum_w();
        let defect = (gained - change).to_vector().amax() / change.to_vector().amax();
        println!("{name}: {defect:.1e}");
        assert!(defect < 1e-11, "{name}: {defect:e}");
    }
}

#[test]
fn without_active_contacts_it_is_the_step_of_the_integrator_bit_for_bit() {
    let robot = quadruped_on(&[false; 4], Forces::Springs);
    let mut stage = robot.stage(2);
    let (_, end) = robot.solve(&mut stage, 0.01, &robot.start);
    let mut state = State::zeros(&robot.tree);
    robot.boundary(&robot.start).state_into(&mut state).unwrap();
    let mut integrator = sample_robots::integrator(&robot.tree, 2, 0.01);
    integrator.step(&robot.tree, &mut state, &StepForces::held(&robot.u)).unwrap();
    assert_eq!(end.q, state.q);
    assert_eq!(end.base_pose_w(), state.base_pose);
    let mut momenta = State::zeros(&robot.tree);
    robot.boundary(&end).state_into(&mut momenta).unwrap();
    assert!(difference(&momenta.p, &state.p) < 1e-13);

    // A, B against the linearisation of the floating base, in its coordinates.
    let (lifted, _, end) = robot.linear(&mut stage, 0.01, &robot.start);
    let mut work =
        Linearizer::new(&robot.tree, &integrator, StateCoordinates::Momentum, InputHold::Held).unwrap();
    let mut start = State::zeros(&robot.tree);
    robot.boundary(&robot.start).state_into(&mut start).unwrap();
    integrator.forget();
    integrator.solve(&robot.tree, &start, &StepForces::held(&robot.u)).unwrap();
    let linear = work.linearize(&robot.tree, &mut integrator).unwrap();
    let n = 2 * robot.tree.dof();
    let want = DMatrix::from_fn(n, n, |r, c| linear.a(r, c));
    let back = canonical(&robot.tree, &robot.start).lu().try_inverse().unwrap();
    let got = canonical(&robot.tree, &end) * a(&lifted) * back;
    let want_b = DMatrix::from_fn(n, robot.tree.joint_count(), |r, c| linear.b(r, c));
    let errors = [relative(&got, &want), relative(&(canonical(&robot.tree, &end) * b(&lifted)), &want_b)];
    assert!(errors.iter().all(|e| *e < 1e-11), "{errors:?}");
}

#[test]
fn contacts_that_are_not_active_change_nothing() {
    let robot = quadruped_on(&DIAGONAL, Forces::Springs);
    let (with, _, end) = robot.linear(&mut robot.stage(2), 0.02, &robot.start);
    let mut fewer = quadruped_on(&DIAGONAL, Forces::Springs);
    fewer.contacts = vec![robot.contacts[0], robot.contacts[3]];
    fewer.active = vec![true; 2];
    let (without, _, same_end) = fewer.linear(&mut fewer.stage(2), 0.02, &robot.start);
    assert_eq!(end, same_end);
    assert_eq!(a(&with), a(&without));
    assert_eq!(b(&with), b(&without));
    for row in 0..with.row_count() {
        assert_eq!(with.force_row(row), without.force_row(row));
    }
    assert_eq!((with.first_row(1), with.first_row(3), without.first_row(1)), (None, Some(3), Some(3)));

    // A foot that is not active: its torque is in the workspace, without effect beyond round-off.
    let mut footed = quadruped_on(&DIAGONAL, Forces::Springs);
    footed.contacts.push(Contact::foot(10, Vector3::zeros(), Matrix3::identity()));
    footed.active.push(false);
    let (round, _, _) = footed.linear(&mut footed.stage(2), 0.02, &robot.start);
    assert!(relative(&a(&round), &a(&with)) < 1e-12);
}

#[test]
fn a_lifted_horizon_converges_quadratically_to_the_stages_solved_one_by_one() {
    let robot = quadruped_on(&DIAGONAL, Forces::Springs);
    let (dt, stages, n) = (0.02, 12, 2 * robot.tree.dof());
    let u = vec![0.0; robot.tree.joint_count()];
    let rule = LobattoRule::new(2).unwrap();
    let mut stage = robot.stage(2);
    // A guess of constant velocity, forces that share the weight.
    let mut states = vec![robot.start.clone()];
    for k in 0..stages {
        let mut x = vec![0.0; n];
        let velocity = states[k].base_velocity_b.iter().chain(&states[k].rate);
        for (x, v) in x.iter_mut().zip(velocity) {
            *x = dt * v;
        }
        states.push(moved(&states[k], &x));
    }
    let mut force = vec![0.0; stage.row_count()];
    for contact in [0, 3] {
        force[3 * contact + 2] = robot.tree.total_mass() * 9.81 / 2.0;
    }
    let mut nominals = vec![stage.nominal(); stages];
    for k in 0..stages {
        nominals[k].interpolate(&rule, dt, &states[k], &states[k + 1], &force);
    }
    let mut sizes = Vec::new();
    for _ in 0..10 {
        let mut x = vec![0.0; n];
        let mut size = 0.0f64;
        for k in 0..stages {
            let mut lifted = stage.lifted();
            stage
                .linearize(
                    &robot.tree,
                    dt,
                    &robot.active,
                    &states[k],
                    &nominals[k],
                    &u,
                    &states[k + 1],
                    &mut lifted,
                )
                .unwrap();
            nominals[k].advance(&lifted, &x, &u);
            let mut next = vec![0.0; n];
            lifted.next_into(&x, &u, &mut next);
            if k > 0 {
                states[k].retract(&x);
            }
            x = next;
            size = x.iter().fold(size, |m, v| m.max(v.abs()));
        }
        states[stages].retract(&x);
        sizes.push(size);
    }
    println!("|dx| {sizes:?}");
    let small = sizes.iter().position(|size| *size < 1e-6).unwrap();
    assert!(small < 9 && sizes[small] < sizes[small - 1] * sizes[small - 1] && sizes[9] < 1e-11, "{sizes:?}");
    let mut state = robot.start.clone();
    let mut still = quadruped_on(&DIAGONAL, Forces::Springs);
    still.u = u;
    for k in 0..stages {
        state = still.solve(&mut stage, dt, &state).1;
        let away = local(&states[k + 1], &state).iter().fold(0.0f64, |m, v| m.max(v.abs()));
        assert!(away < 1e-10 * (1.0 + sizes[0]), "stage {k}: {away:e}");
    }
}

#[test]
fn bad_input_is_refused_with_its_name() {
    let robot = quadruped_on(&ALL, Forces::None);
    let mut stage = robot.stage(2);
    let (mut nominal, mut end) = (stage.nominal(), robot.start.clone());
    let fixed = sample_robots::spatial_chain(sample_robots::GRAVITY, Forces::None);
    assert!(ContactStage::new(&fixed, &LobattoRule::new(2).unwrap(), &[]).is_err());
    let nowhere = [Contact::point(99, Vector3::zeros())];
    assert!(ContactStage::new(&robot.tree, &LobattoRule::new(2).unwrap(), &nowhere).is_err());
    let mut solve = |dt, active: &[bool], start: &BoundaryState, u: &[f64]| {
        stage.solve(&robot.tree, dt, active, start, u, &mut nominal, &mut end).unwrap_err().to_string()
    };
    assert!(solve(0.01, &[true], &robot.start, &robot.u).contains("active contacts"));
    assert!(solve(-1.0, &ALL, &robot.start, &robot.u).contains("time step"));
    assert!(solve(0.01, &ALL, &robot.start, &[0.0]).contains("held joint forces"));
    let mut bad = robot.start.clone();
    bad.rate[3] = f64::NAN;
    assert!(solve(0.01, &ALL, &bad, &robot.u).contains("joint rate is not finite at index 3"));
    let other = quadruped_on(&ALL, Forces::None).stage(3);
    let mut wrong = other.nominal();
    let refused = stage.solve(&robot.tree, 0.01, &ALL, &robot.start, &robot.u, &mut wrong, &mut end);
    assert!(refused.unwrap_err().to_string().contains("nodes of the nominal"));
    let nominal = stage.nominal();
    let refused = stage.linearize(
        &robot.tree,
        0.01,
        &ALL,
        &robot.start,
        &nominal,
        &robot.u,
        &end,
        &mut ContactStage::new(&robot.tree, &LobattoRule::new(2).unwrap(), &[]).unwrap().lifted(),
    );
    assert!(refused.unwrap_err().to_string().contains("of the lifted stage"));
    let double = [robot.contacts[0], robot.contacts[0]];
    let mut stage = ContactStage::new(&robot.tree, &LobattoRule::new(2).unwrap(), &double).unwrap();
    let mut nominal = stage.nominal();
    let refused = stage.solve(&robot.tree, 0.01, &[true; 2], &robot.start, &robot.u, &mut nominal, &mut end);
    assert!(matches!(refused, Err(StepError::RedundantConstraint { row: 3, .. })), "{refused:?}");
}

#[test]
fn places_move_by_their_jacobians_and_forces_balance_by_virtual_work() {
    let h = 1e-6;
    for (name, robot) in robots() {
        let (tree, nv) = (&robot.tree, robot.tree.dof());
        let boundary = robot.boundary(&robot.start);
        let (body, point) = (robot.contacts[0].body, Vector3::new(0.1, -0.2, 0.05));
        let (mut of_point, mut of_turn) = (vec![0.0; 3 * nv], vec![0.0; 3 * nv]);
        let mut of_centre = vec![0.0; 3 * nv];
        boundary.point_jacobian_into(tree, body, &point, &mut of_point).unwrap();
        boundary.turn_jacobian_into(tree, body, &mut of_turn).unwrap();
        boundary.mass_centre_jacobian_into(tree, &mut of_centre).unwrap();
        for column in 0..nv {
            let [plus, minus] = [h, -h].map(|change| {
                let mut x = vec![0.0; nv];
                x[column] = change;
                robot.boundary(&moved(&robot.start, &x))
            });
            let slope = |value: &dyn Fn(&BoundaryKinematics) -> Vector3<f64>| {
                (value(&plus) - value(&minus)) / (2.0 * h)
            };
            let turn = log_rotation(
                &(plus.kinematics().link_poses_w()[body].rotation
                    * minus.kinematics().link_poses_w()[body].rotation.transpose()),
            ) / (2.0 * h);
            for (what, jacobian, want) in [
                ("point", &of_point, slope(&|b| b.kinematics().point_w(body, &point))),
                ("turn", &of_turn, turn),
                ("mass centre", &of_centre, slope(&|b| b.mass_centre_w(tree))),
            ] {
                for row in 0..3 {
                    let error = (jacobian[row * nv + column] - want[row]).abs();
                    assert!(error < 1e-8, "{name}, {what}, column {column}: {error:e}");
                }
            }
        }
        let mut map = vec![0.0; 6 * nv];
        boundary.centroidal_map_into(tree, &mut map).unwrap();
        let momentum = DMatrix::from_row_slice(6, nv, &map) * DVector::from_row_slice(boundary.velocity());
        let error = (momentum - boundary.centroidal_momentum_w(tree).to_vector()).amax();
        assert!(error < 1e-11, "{name}: centroidal momentum {error:e}");

        // u q̇ = springs - weight - contact forces for every velocity of the joints; the base keeps what is left.
        let standing: Vec<Contact> = robot
            .contacts
            .iter()
            .zip(&robot.active)
            .filter(|(_, active)| **active)
            .map(|(c, _)| *c)
            .collect();
        let (g, _) = robot.rows(&robot.start);
        let force = sample_robots::spread(g.nrows(), 20.0);
        let mut torque = vec![0.0; nv - 6];
        let left = boundary.static_torques_into(tree, &standing, &force, &mut torque).unwrap().to_vector();
        let weight = *tree.gravity_w() * tree.total_mass();
        let pushed = g.transpose() * DVector::from_row_slice(&force);
        for column in 0..nv {
            let lifted: f64 = (0..3).map(|row| of_centre[row * nv + column] * weight[row]).sum();
            let work = lifted + pushed[column];
            let balance = if column < 6 {
                left[column] - work
            } else {
                let joint = &tree.bodies()[column - 5].joint;
                torque[column - 6] + work - joint.stiffness * (robot.start.q[column - 6] - joint.rest)
            };
            assert!(balance.abs() < 1e-9, "{name}, column {column}: {balance:e}");
        }
    }
}
