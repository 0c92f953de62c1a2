//! Whatever comes in, a valid command goes out, and the ladder is climbed back.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;
mod random;

use std::cell::Cell;

use atlas::{WeldedPlant, atlas};
use delmpc_controller_core::cycle::reason;
use delmpc_controller_core::prelude::*;
use delmpc_messages::{FallbackLevel, PlantState, Verdict};
use random::Random;

const PERIOD_NS: u64 = 5_000_000;

#[test]
fn bad_states_are_refused_by_name_and_the_ladder_is_climbed_back() {
    let atlas = atlas();
    let mut plant = WeldedPlant::new(&atlas);
    let n = plant.rate.len();
    let mut controller = Controller::new(atlas.controller_model(), ControllerConfig::default()).unwrap();
    let good = plant.measure();
    let mut cycle = |change: &dyn Fn(&mut PlantState), k: u64, now_after_ns: u64| {
        let mut state = good;
        state.time_ns = k * PERIOD_NS;
        change(&mut state);
        let command = *controller.cycle(&state, k * PERIOD_NS + now_after_ns, &StoppedClock);
        command.validate(plant.model.joint_set_hash, n).unwrap();
        (command.fallback_level().unwrap(), command.reason, command.verdict().unwrap())
    };
    let fresh = (FallbackLevel::FreshSolution, 0, Verdict::Ok);
    assert_eq!(cycle(&|_| {}, 1, 0), fresh);
    // NaN: 5. The plan of the last cycle serves, then the LQR.
    assert_eq!(
        cycle(&|s| s.position[3] = f64::NAN, 2, 0),
        (FallbackLevel::ShiftedPlan, 5, Verdict::BadState)
    );
    assert_eq!(cycle(&|s| s.n_joints = 7, 10, 0).1, 4);
    assert_eq!(cycle(&|s| s.header.joint_set_hash ^= 1, 11, 0).1, 3);
    assert_eq!(cycle(&|s| s.base_orientation_w = [1.0; 4], 12, 0).1, 7);
    assert_eq!(cycle(&|s| s.time_ns = 1, 13, 0).1, reason::STALE);
    assert_eq!(cycle(&|_| {}, 230, 60_000_000), (FallbackLevel::StaticLqr, reason::STALE, Verdict::BadState));
    for k in 231..235 {
        assert_eq!(cycle(&|_| {}, k, 0), (FallbackLevel::StaticLqr, 0, Verdict::Ok));
    }
    assert_eq!(cycle(&|_| {}, 235, 0), fresh);
    // A state from the past, though not too old.
    assert_eq!(cycle(&|s| s.time_ns -= 2 * PERIOD_NS, 236, 0).1, reason::OUT_OF_ORDER);
    // One from the future, which must not make the true ones after it look old.
    assert_eq!(cycle(&|s| s.time_ns += 1_000_000_000, 237, 0).1, reason::AHEAD);
    assert_eq!(cycle(&|_| {}, 238, 0).1, 0);
}

/// The time a controller is told may come from the state itself: one damaged time must not make all true states look old for ever.
#[test]
fn a_time_that_ran_ahead_is_forgotten_and_times_at_the_end_of_all_numbers_are_refused() {
    let atlas = atlas();
    let plant = &mut WeldedPlant::new(&atlas);
    let n = plant.rate.len();
    let good = plant.measure();
    let mut controller = Controller::new(atlas.controller_model(), ControllerConfig::default()).unwrap();
    let mut cycle = |time_ns: u64, now_ns: u64| {
        let mut state = good;
        state.time_ns = time_ns;
        let command = *controller.cycle(&state, now_ns, &StoppedClock);
        controller.prepare(&StoppedClock);
        command
    };
    assert_eq!(cycle(PERIOD_NS, PERIOD_NS).reason, 0);
    let hour_ns = 3_600_000_000_000;
    assert_eq!(cycle(hour_ns, hour_ns).reason, 0, "nothing says that it is wrong");
    let reasons: Vec<u32> = (2..9).map(|k| cycle(k * PERIOD_NS, k * PERIOD_NS).reason).collect();
    assert_eq!(reasons[..4], [reason::OUT_OF_ORDER; 4]);
    assert_eq!(reasons[4..], [0; 3]);
    for time_ns in [u64::MAX, u64::MAX - 1, 1 << 63, (1 << 62) + 1] {
        assert!(cycle(time_ns, time_ns).reason != 0, "{time_ns}");
        cycle(9 * PERIOD_NS, u64::MAX);
    }
    for k in 10..20 {
        let command = cycle(k * PERIOD_NS, k * PERIOD_NS);
        command.validate(plant.model.joint_set_hash, n).unwrap();
        assert_eq!(command.reason, 0);
    }
}

/// A robot in a motion that no torque within the limits can lead back, and a dual with room for two rows: what comes out is not sent.
#[test]
fn a_plan_beyond_torque_limits_and_contact_rows_is_no_solution() {
    let atlas = atlas();
    let plant = &mut WeldedPlant::new(&atlas);
    let mut config = ControllerConfig::default();
    config.qp.capacity = 2;
    let mut controller = Controller::new(atlas.controller_model(), config).unwrap();
    let mut state = plant.measure();
    state.time_ns = PERIOD_NS;
    assert_eq!(controller.cycle(&state, state.time_ns, &StoppedClock).reason, 0);
    state.time_ns = 2 * PERIOD_NS;
    for &joint in &plant.model.message_joint {
        state.velocity[joint] += 1.5;
    }
    let command = controller.cycle(&state, state.time_ns, &StoppedClock);
    assert!(command.report.dropped_rows > 0, "{:?}", command.report);
    assert_eq!(command.reason, reason::QP);
    assert_eq!(command.fallback_level(), Some(FallbackLevel::ShiftedPlan));
    assert_eq!(command.verdict(), Some(Verdict::Infeasible));
}

#[test]
fn garbage_gives_finite_commands() {
    let atlas = atlas();
    let mut plant = WeldedPlant::new(&atlas);
    let n = plant.rate.len();
    let mut controller = Controller::new(atlas.controller_model(), ControllerConfig::default()).unwrap();
    let good = plant.measure();
    let mut random = Random::new(77);
    for k in 1..60u64 {
        let mut state = good;
        state.time_ns = k * PERIOD_NS;
        let size = 10f64.powf(5.0 * random.signed());
        for i in 0..n {
            state.position[i] += size * random.signed();
            state.velocity[i] += size * random.signed();
        }
        if k % 5 == 0 {
            state.velocity[(k % 30) as usize] = [f64::NAN, f64::INFINITY, 1e300][(k % 3) as usize];
        }
        let command = controller.cycle(&state, state.time_ns, &StoppedClock);
        command.validate(plant.model.joint_set_hash, n).unwrap();
        let limits = plant.model.message_joint.iter().zip(&plant.model.limits);
        assert!(limits.clone().all(|(&j, limit)| command.segments[0].torque[j].abs() <= limit.effort));
    }
}

#[test]
fn the_baseline_is_a_fixed_gain_about_the_posture_and_off_is_off() {
    let atlas = atlas();
    let mut plant = WeldedPlant::new(&atlas);
    let state = plant.measure();
    let with = |kind| {
        let config = ControllerConfig { kind, ..ControllerConfig::default() };
        let mut controller = Controller::new(atlas.controller_model(), config).unwrap();
        *controller.cycle(&state, 0, &StoppedClock)
    };
    let lqr = with(ControllerKind::StaticLqr);
    let (joint, home) = (plant.model.message_joint[0], plant.model.posture[0]);
    assert_eq!(lqr.segments[0].position_ref[joint], home);
    assert!(lqr.gain[joint][joint] < -100.0, "{}", lqr.gain[joint][joint]);
    let off = with(ControllerKind::Off);
    assert!(off.segments[0].torque.iter().all(|u| *u == 0.0) && off.gain.iter().flatten().all(|k| *k == 0.0));
}

#[test]
fn models_and_configurations_that_make_no_sense_are_refused() {
    let atlas = atlas();
    let refused = |change: &dyn Fn(&mut ControllerModel, &mut ControllerConfig)| {
        let (mut model, mut config) = (atlas.controller_model(), ControllerConfig::default());
        change(&mut model, &mut config);
        Controller::new(model, config).is_err()
    };
    assert!(refused(&|m, _| m.posture[4] = f64::NAN));
    assert!(refused(&|m, _| m.message_joint[0] = m.message_joint[1]));
    assert!(refused(&|m, _| m.limits.truncate(m.limits.len() - 1)));
    assert!(refused(&|m, _| m.limits[2].effort = 0.0));
    assert!(refused(&|m, _| m.sole.truncate(2)));
    assert!(refused(&|_, c| c.period_s = 0.0));
    assert!(refused(&|_, c| c.stages.clear()));
    assert!(refused(&|_, c| c.weights.torque = -1.0));
    assert!(refused(&|_, c| c.weights.com[0] = f64::NAN));
    assert!(refused(&|_, c| c.qp.capacity = 0));
    assert!(!refused(&|_, _| {}));
}

/// A clock that goes on by `step_ns` every time it is looked at.
#[derive(Default)]
struct Stepping {
    step_ns: Cell<u64>,
    now_ns: Cell<u64>,
}

impl Clock for Stepping {
    fn now_ns(&self) -> u64 {
        self.now_ns.set(self.now_ns.get() + self.step_ns.get());
        self.now_ns.get()
    }
}

#[test]
fn a_machine_that_is_too_slow_prepares_for_the_tick_it_can_meet() {
    let atlas = atlas();
    let good = WeldedPlant::new(&atlas).measure();
    let mut controller = Controller::new(atlas.controller_model(), ControllerConfig::default()).unwrap();
    let clock = Stepping::default();
    // A cycle of a state: whether what was prepared served, and when the command begins.
    let cycle = |controller: &mut Controller, time_ns: u64| {
        let mut state = good;
        state.time_ns = time_ns;
        let command = controller.cycle(&state, time_ns, &clock);
        (command.report.linearize_ns > 0, command.valid_from_ns)
    };
    let prepare = |controller: &mut Controller, slowness_ns: u64| {
        clock.step_ns.set(slowness_ns);
        controller.prepare(&clock);
        clock.step_ns.set(0);
    };
    cycle(&mut controller, 0);
    // Fast: the next tick.
    prepare(&mut controller, 100_000);
    assert_eq!(cycle(&mut controller, PERIOD_NS), (true, 2 * PERIOD_NS));
    // Suddenly slow: prepared for the next tick, met at the one after it, where the plan of what was prepared begins.
    for k in [3, 5, 7] {
        prepare(&mut controller, 1_500_000);
        assert_eq!(cycle(&mut controller, k * PERIOD_NS), (true, (k + 1) * PERIOD_NS));
    }
    // Now known to be slow: prepared for the tick after the next, and met there.
    prepare(&mut controller, 1_500_000);
    assert_eq!(cycle(&mut controller, 9 * PERIOD_NS), (true, 10 * PERIOD_NS));
    // Fast again, and so too early: the command begins when the plan does.
    prepare(&mut controller, 100_000);
    assert_eq!(cycle(&mut controller, 10 * PERIOD_NS), (true, 12 * PERIOD_NS));
    prepare(&mut controller, 100_000);
    assert_eq!(cycle(&mut controller, 11 * PERIOD_NS), (true, 12 * PERIOD_NS));
    // Some periods too late for what was prepared: it serves, for the time from now on.
    prepare(&mut controller, 100_000);
    assert_eq!(cycle(&mut controller, 17 * PERIOD_NS), (true, 18 * PERIOD_NS));
    // Half a horizon later no more: made again.
    prepare(&mut controller, 100_000);
    assert_eq!(cycle(&mut controller, 135 * PERIOD_NS), (false, 136 * PERIOD_NS));
}
