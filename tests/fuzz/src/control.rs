//! The control cycle and its small dual problem.

use std::cell::RefCell;

use delmpc_controller_core::prelude::*;
use delmpc_lq::active_set_dual::ActiveSetDual;
use delmpc_lq::clarabel_dual::ClarabelDual;
use delmpc_lq::dual_qp::{QpSolver, dual_residual};
use delmpc_mechanics::prelude::*;
use delmpc_messages::PlantState;
use faer::Mat;

use crate::numbers::Numbers;

const HASH: u64 = 7;
/// Largest miss of the optimality conditions, relative to the largest slack: what an interior-point method leaves of a degenerate row.
const TOLERANCE: f64 = 1e-3;
const MOST_ROWS: usize = 16;

fn controller() -> Option<Controller> {
    let ankle = RigidTransform::from_translation(Vector3::new(0.0, 0.0, 0.1));
    let talus = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.005);
    let rest = LinkInertia::new(39.0, Vector3::new(0.08, 0.0, 0.7), Matrix3::identity());
    let mut tree = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let roll = tree.add(Body::new(None, Joint::revolute(Vector3::x(), ankle), talus));
    tree.add(Body::new(Some(roll), Joint::revolute(Vector3::y(), RigidTransform::identity()), rest));
    let limits = JointLimits { lower: -0.5, upper: 0.5, effort: 150.0, velocity: 6.0 };
    let sole = vec![[-0.08, -0.06], [0.17, -0.06], [0.17, 0.06], [-0.08, 0.06]];
    let model = ControllerModel::standing(tree.build().ok()?, HASH, vec![limits; 2], sole, vec![0.0, -0.05]);
    let config = ControllerConfig {
        stages: ControllerConfig::stages_for(0.2, 6, 0.005),
        delay_s: 0.0,
        ..ControllerConfig::default()
    };
    Controller::new(model, config).ok()
}

thread_local! {
    static CONTROLLER: RefCell<Option<Controller>> = RefCell::new(controller());
    static SOLVERS: RefCell<Vec<Box<dyn QpSolver>>> = RefCell::new(solvers());
}

/// States of any content: a valid command always comes out, and from good ones a good one after a while.
pub fn cycle(data: &[u8]) {
    CONTROLLER.with_borrow_mut(|controller| {
        let Some(controller) = controller else { return };
        let mut numbers = Numbers(data);
        let mut time_ns = 1_000_000_000;
        let step = |controller: &mut Controller, state: &PlantState, now_ns: u64, valid: bool| {
            let command = *controller.cycle(state, now_ns, &StoppedClock);
            controller.prepare(&StoppedClock);
            if valid {
                let checked = command.validate(HASH, 2);
                assert!(checked.is_ok(), "{checked:?}");
            }
            command.reason
        };
        for _ in 0..6 {
            if numbers.is_over() {
                break;
            }
            time_ns += 5_000_000;
            let mut state = PlantState::new(1, HASH, 2);
            state.time_ns = time_ns;
            for value in state.position[..2].iter_mut().chain(&mut state.velocity[..2]) {
                *value = 0.1 * numbers.ordinary();
            }
            for _ in 0..numbers.up_to(3) {
                let bytes = bytemuck::bytes_of_mut(&mut state);
                let place = numbers.word() as usize % (bytes.len() / 8) * 8;
                bytes[place..place + 8].copy_from_slice(&numbers.number().to_bits().to_le_bytes());
            }
            let now_ns = if numbers.byte() < 200 { time_ns } else { numbers.word() };
            // A command of a time that no clock shows has no valid times.
            step(controller, &state, now_ns, now_ns < 1 << 61 && state.time_ns < 1 << 61);
        }
        let mut reasons = Vec::new();
        for _ in 0..12 {
            time_ns += 5_000_000;
            let mut state = PlantState::new(1, HASH, 2);
            state.time_ns = time_ns;
            state.position[1] = -0.05;
            reasons.push(step(controller, &state, time_ns, true));
        }
        assert_eq!(reasons.last(), Some(&0), "good states are refused: {reasons:?}");
    });
}

fn solvers() -> Vec<Box<dyn QpSolver>> {
    let mut solvers: Vec<Box<dyn QpSolver>> = vec![Box::new(ActiveSetDual::new(MOST_ROWS))];
    if let Ok(clarabel) = ClarabelDual::new(MOST_ROWS, 1e-8) {
        solvers.push(Box::new(clarabel));
    }
    solvers
}

/// A dual problem of any content, then a good one.
pub fn qp(data: &[u8]) {
    let mut numbers = Numbers(data);
    let rows = 1 + numbers.up_to(MOST_ROWS - 1);
    let kind = numbers.byte();
    let any = |numbers: &mut Numbers<'_>| if kind % 4 == 0 { numbers.number() } else { numbers.ordinary() };
    let mut gram = Mat::zeros(rows, rows);
    if kind % 3 == 0 {
        for i in 0..rows {
            for j in 0..=i {
                let value = any(&mut numbers);
                (gram[(i, j)], gram[(j, i)]) = (value, value);
            }
        }
    } else {
        let rank = 1 + numbers.up_to(rows - 1);
        let g = Mat::from_fn(rows, rank, |_, _| any(&mut numbers));
        gram = &g * g.transpose();
    }
    let slack: Vec<f64> = (0..rows).map(|_| any(&mut numbers)).collect();
    let upper: Vec<f64> =
        (0..rows).map(|_| if numbers.byte() % 2 == 0 { f64::INFINITY } else { any(&mut numbers) }).collect();
    SOLVERS.with_borrow_mut(|solvers| {
        for solver in solvers {
            let mut y = vec![0.0; rows];
            if solver.solve(gram.as_ref(), &slack, &upper, &mut y).is_ok() {
                let scale = slack.iter().fold(0.0f64, |m, h| m.max(h.abs()));
                let residual = dual_residual(gram.as_ref(), &slack, &upper, &y);
                assert!(y.iter().all(|y| y.is_finite() && *y >= 0.0), "{y:?}");
                assert!(residual <= TOLERANCE * scale, "residual {residual:e} of {scale:e}");
            }
            let good = Mat::<f64>::identity(rows, rows);
            let solved = solver.solve(good.as_ref(), &vec![-1.0; rows], &vec![2.0; rows], &mut y);
            assert!(solved.is_ok(), "a good problem is refused: {solved:?}");
            assert!(y.iter().all(|y| (y - 1.0).abs() < TOLERANCE), "{y:?}");
        }
    });
}
