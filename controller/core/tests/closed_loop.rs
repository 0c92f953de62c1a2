//! The loop closed on a plant whose foot cannot move. The ground wrench is watched, not enforced.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod atlas;

use atlas::{Atlas, STEP_NS, WeldedPlant, atlas};
use delmpc_controller_core::prelude::*;
use delmpc_mechanics::forces::PointForce;
use delmpc_messages::{Command, FallbackLevel};
use nalgebra::Vector3;
use std::time::Instant;

struct WallClock(Instant);

impl Clock for WallClock {
    fn now_ns(&self) -> u64 {
        self.0.elapsed().as_nanos() as u64
    }
}

#[derive(Debug, Default)]
struct Run {
    worst_com: f64,
    final_com: f64,
    final_rate: f64,
    /// Largest part of the sole used by the pressure point, x and y.
    cop: [f64; 2],
    hand_error_at_deadline: f64,
    hand_error_hold: f64,
    lowest_foot: f64,
    torque_ratio: f64,
    worst_level: u32,
    solves: u32,
    active: u32,
    dropped: u32,
    times_us: [Vec<u64>; 6],
}

struct Push {
    impulse: Vector3<f64>,
    start_s: f64,
}

fn run(atlas: &Atlas, config: ControllerConfig, seconds: f64, push: Option<Push>, verbose: bool) -> Run {
    let period_ns = (config.period_s * 1e9).round() as u64;
    let reach = config.reach;
    let model = atlas.controller_model();
    let torso = atlas.rooted.model.link("utorso").unwrap().body.unwrap();
    let mut plant = WeldedPlant::new(atlas);
    let mut controller = Controller::new(model, config).unwrap();
    let mut pending: Option<Command> = None;
    let mut out = Run { lowest_foot: f64::INFINITY, ..Run::default() };
    let clock = WallClock(Instant::now());
    let mut momentum = plant.momentum();
    let weight = 9.81 * plant.model.tree.total_mass();
    let origin = plant.com().0;
    for tick in 0..(seconds * 1e9) as u64 / STEP_NS {
        let now = tick * STEP_NS;
        let time = now as f64 * 1e-9;
        if now.is_multiple_of(period_ns) {
            if let Some(command) = pending.take() {
                plant.command = Some(command);
            }
            let state = plant.measure();
            let command = *controller.cycle(&state, now, &clock);
            let report = &command.report;
            for (times, ns) in out.times_us.iter_mut().zip([
                report.state_in_ns,
                report.shift_ns,
                report.linearize_ns,
                report.riccati_ns,
                report.qp_ns,
                report.total_ns,
            ]) {
                times.push(ns / 1000);
            }
            out.worst_level = out.worst_level.max(command.fallback_level);
            out.solves = out.solves.max(report.qp_solves);
            out.active = out.active.max(report.active_rows);
            out.dropped = out.dropped.max(report.dropped_rows);
            if verbose && (tick % 100 == 0 || command.reason != 0) {
                let (com, com_velocity) = plant.com();
                println!(
                    "{time:.3} level {} reason {} verdict {} com {:.4} {:.4} {:.4} v {:.3} {:.3} solves {} it {} active {} dropped {} worst {:?} {:.3} innovation {:.4} hand {:?}",
                    command.fallback_level,
                    command.reason,
                    command.verdict,
                    com.x,
                    com.y,
                    com.z,
                    com_velocity.x,
                    com_velocity.y,
                    report.qp_solves,
                    report.qp_iterations,
                    report.active_rows,
                    report.dropped_rows,
                    report.worst_constraint(),
                    report.worst_violation,
                    controller.innovation_rate(),
                    plant.hand().as_slice(),
                );
            }
            if plant.command.is_none() {
                plant.command = Some(command);
            }
            pending = Some(command);
        }
        plant.push = push
            .as_ref()
            .filter(|p| time >= p.start_s && time < p.start_s + 0.1)
            .map(|p| PointForce { body: torso, point_b: Vector3::zeros(), force_w: p.impulse / 0.1 });
        let pushing = plant.push.map_or(Vector3::zeros(), |p| p.force_w);
        plant.step();
        let (com, _) = plant.com();
        let next = plant.momentum();
        let mut torque = (next.torque - momentum.torque) / 1e-3;
        let mut force = (next.force - momentum.force) / 1e-3;
        momentum = next;
        torque -= com.cross(&Vector3::new(0.0, 0.0, -weight));
        force -= Vector3::new(0.0, 0.0, -weight) + pushing;
        torque -= Vector3::new(0.0, 0.0, 1.4).cross(&pushing);
        if pushing.norm() == 0.0 {
            out.cop[0] = out.cop[0].max((torque.y / force.z).abs() / 0.1302);
            out.cop[1] = out.cop[1].max((torque.x / force.z).abs() / 0.0643);
        }
        let offset = (com - origin).xy().norm();
        out.worst_com = out.worst_com.max(offset);
        out.final_com = offset;
        out.lowest_foot = out.lowest_foot.min(plant.swing_foot().z);
        if let Some(reach) = reach {
            let error = (plant.hand() - Vector3::from(reach.ball_m)).norm();
            let there = reach.start_s + reach.deadline_s;
            if (time - there).abs() < 1e-6 {
                out.hand_error_at_deadline = error;
            }
            if time >= there && time <= there + reach.hold_s {
                out.hand_error_hold = out.hand_error_hold.max(error);
            }
        }
        if offset > 0.5 {
            break;
        }
    }
    out.final_rate = plant.rate.iter().fold(0.0, |m: f64, r| m.max(r.abs()));
    out.torque_ratio = plant.worst_torque_ratio;
    for times in &mut out.times_us {
        times.sort_unstable();
    }
    let median: Vec<u64> = out.times_us.iter().map(|t| t[t.len() / 2]).collect();
    println!(
        "com {:.4} (final {:.5}) rate {:.4} cop {:.2?} hand {:.4} / {:.4} foot {:.3} torque {:.2} level {} solves {} active {} dropped {}; us in/shift/lin/ric/qp/total {median:?}, max {}",
        out.worst_com,
        out.final_com,
        out.final_rate,
        out.cop,
        out.hand_error_at_deadline,
        out.hand_error_hold,
        out.lowest_foot,
        out.torque_ratio,
        out.worst_level,
        out.solves,
        out.active,
        out.dropped,
        out.times_us[5].last().unwrap(),
    );
    out
}

#[test]
fn it_stands_still() {
    let run = run(&atlas(), ControllerConfig::default(), 0.5, None, false);
    assert!(run.worst_com < 1e-4 && run.final_rate < 1e-2, "{run:?}");
    assert_eq!(run.worst_level, FallbackLevel::FreshSolution as u32);
}

#[test]
fn it_takes_a_push() {
    let push = Push { impulse: Vector3::new(0.0, 15.0, 0.0), start_s: 0.2 };
    let run = run(&atlas(), ControllerConfig::default(), 2.5, Some(push), true);
    assert!(run.final_com < 0.01, "{run:?}");
    assert!(run.cop[1] < 1.05);
}

#[test]
fn it_reaches_the_ball() {
    let reach = Reach { ball_m: [0.8, 0.3, 0.5], start_s: 0.2, deadline_s: 1.3, hold_s: 0.5, return_s: 1.5 };
    let config = ControllerConfig { reach: Some(reach), ..ControllerConfig::default() };
    let run = run(&atlas(), config, 4.0, None, true);
    assert!(run.hand_error_at_deadline < 0.02 && run.hand_error_hold < 0.03);
    assert!(run.cop[0] < 1.0 && run.cop[1] < 1.0);
}

/// Not a test of a claim: prints how far the welded-foot loop gets. `PUSH="0,34,0" RATE=500 cargo test --release ... --ignored`.
#[test]
#[ignore = "an experiment"]
fn it_survives_the_push_of_the_environment() {
    let numbers = |key: &str, default: &str| -> Vec<f64> {
        let text = std::env::var(key).unwrap_or_else(|_| default.to_owned());
        text.split(',').map(|x| x.trim().parse().unwrap()).collect()
    };
    let impulse = numbers("PUSH", "0,30,0");
    let period = 1.0 / numbers("RATE", "200")[0];
    let mut config = ControllerConfig { period_s: period, delay_s: period, ..ControllerConfig::default() };
    let horizon = numbers("HORIZON", "0")[0];
    if horizon > 0.0 {
        config.stages = ControllerConfig::stages_for(horizon, 20, 0.005);
    }
    let push = Push { impulse: Vector3::from_row_slice(&impulse), start_s: 0.2 };
    run(&atlas(), config, numbers("SECONDS_RUN", "2.5")[0], Some(push), std::env::var("VERBOSE").is_ok());
}

/// The law of another posture is that of a controller made for it, and a posture that is none changes nothing.
#[test]
fn a_controller_can_be_told_to_stand_otherwise() {
    let atlas = atlas();
    let config = ControllerConfig { kind: ControllerKind::StaticLqr, ..ControllerConfig::default() };
    let state = WeldedPlant::new(&atlas).measure();
    let mut bent = atlas.controller_model();
    bent.posture.iter_mut().for_each(|q| *q *= 0.9);
    let law = |controller: &mut Controller, k: u64| {
        let mut state = state;
        state.time_ns = 5_000_000 * k;
        let command = controller.cycle(&state, state.time_ns, &StoppedClock);
        (command.segments[0], command.gain)
    };
    let mut told = Controller::new(atlas.controller_model(), config.clone()).unwrap();
    let before = law(&mut told, 1);
    let mut beyond = bent.posture.clone();
    beyond[3] = f64::NAN;
    assert!(told.set_posture(&beyond).unwrap_err().to_string().contains("posture is NaN at index 3"));
    assert!(told.set_posture(&beyond[1..]).is_err());
    assert_eq!(law(&mut told, 2), before);
    told.set_posture(&bent.posture).unwrap();
    let mut made = Controller::new(bent, config).unwrap();
    let after = law(&mut told, 3);
    assert_ne!(after, before);
    assert_eq!(after, law(&mut made, 1));
}
