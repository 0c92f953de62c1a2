//! The controller of a scenario with several feet on the ground, a gait, or steps.

use delmpc_controller_core::legged::{GaitCommand, LeggedConfig, LeggedRobot, Motion};
use delmpc_controller_core::prelude as core;
use delmpc_horizon::contact_schedule::{ContactSchedule, Foothold};
use delmpc_horizon::gait::Gait;
use delmpc_horizon::legged_model::{FootShape, LeggedModel};
use delmpc_horizon::legged_tasks::LeggedWeights;
use delmpc_horizon::limits::ConstraintConfig;
use delmpc_horizon::motion_reference::{MotionReference, SwingShape};
use delmpc_horizon::stage_grid::StageGrid;
use delmpc_horizon::step_plan::Step;
use delmpc_mechanics::contact_stage::BoundaryState;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_scenario::{ControllerKind, GaitKind, GaitSettings};
use nalgebra::Vector3;

use crate::planned_walk::planned_walk;
use crate::robot_controller::{constraints, estimator_config, estimator_model, joint_limits};
use crate::setup::Setup;

/// Lift of a swing foot, flat or a point, and where it ends below the ground, as parts of the height of the mass centre.
const LIFT_PART: f64 = 0.08;
const POINT_LIFT_PART: f64 = 0.2;
const DEPTH_PART: f64 = 0.004;
/// Periods of gaits on two and on four feet, in units of the time `√(height / g)` in which an inverted pendulum of the robot's size falls.
const PERIOD_ON_TWO: f64 = 4.2;
const PERIOD_ON_FOUR: f64 = 4.4;
/// m/s².
const GRAVITY: f64 = 9.81;

/// The robot as the horizon has it.
///
/// # Errors
/// In words, when something is missing.
pub fn model(setup: &Setup) -> Result<LeggedModel, String> {
    let (robot, scenario) = (&setup.robot, &setup.scenario);
    let posture = robot.posture(&scenario.robot.posture).ok_or("the posture is missing")?;
    let base = posture.base_link_pose_w.ok_or("the posture has no base pose")?;
    let pose = base_pose_from_link(&robot.tree, &base);
    let home = BoundaryState {
        orientation: pose.rotation,
        position_w: pose.translation,
        q: posture.q.clone(),
        ..BoundaryState::zeros(&robot.tree)
    };
    let feet = estimator_model(setup)?.feet;
    Ok(LeggedModel {
        tree: robot.tree.clone(),
        feet: feet
            .into_iter()
            .map(|foot| FootShape { body: foot.body, sole: foot.sole, polygon: foot.polygon })
            .collect(),
        limits: joint_limits(robot),
        posture: home,
    })
}

/// Robot and sensors.
///
/// # Errors
/// As [`model`].
pub fn robot(setup: &Setup) -> Result<LeggedRobot, String> {
    Ok(LeggedRobot {
        model: model(setup)?,
        estimator: estimator_model(setup)?,
        sensors: estimator_config(&setup.scenario),
        joint_set_hash: setup.joint_set_hash(),
    })
}

/// Everything that is chosen.
///
/// # Errors
/// In words: a gait that the robot's number of feet does not have.
pub fn config(setup: &Setup, model: &LeggedModel) -> Result<LeggedConfig, String> {
    let scenario = &setup.scenario;
    let settings = &scenario.controller;
    let legged = &settings.legged;
    let period_s = 1.0 / settings.mpc_rate_hz;
    let height = mass_centre_height(model)?;
    let or = |value: f64, part: f64| if value > 0.0 { value } else { part * height };
    let lift = if model.feet.iter().any(FootShape::is_flat) { LIFT_PART } else { POINT_LIFT_PART };
    let core_config = core::ControllerConfig::default();
    Ok(LeggedConfig {
        kind: match settings.kind {
            ControllerKind::Off => core::ControllerKind::Off,
            _ => core::ControllerKind::Mpc,
        },
        period_s,
        servo_period_s: 1.0 / settings.servo_rate_hz,
        delay_s: f64::from(settings.delay_cycles) * period_s
            + scenario.sensors.delay_s
            + scenario.plant.actuator_delay_s,
        stage_lengths: stage_lengths(settings.horizon_s, settings.stages, period_s),
        weights: LeggedWeights {
            base_rotation: legged.base_rotation_per_rad2,
            base_spin: legged.base_spin_s2_per_rad2,
            mass_centre: legged.com_per_m2,
            mass_centre_velocity: legged.com_velocity_s2_per_m2,
            posture: legged.posture_per_rad2,
            joint_speed: legged.joint_speed_s2_per_rad2,
            swing_leg: legged.swing_leg,
            swing_foot: legged.swing_foot_per_m2,
            swing_foot_rotation: legged.swing_foot_rotation_per_rad2,
            torque: legged.torque_per_limit2,
            tangential_force: legged.tangential_force_per_weight2,
            normal_force: legged.normal_force_per_weight2,
            sole_torque: legged.sole_torque_per_weight2,
            terminal_s: legged.terminal_s,
        },
        limits: ConstraintConfig { min_force_fraction: legged.min_force_fraction, ..constraints(scenario) },
        swing: SwingShape {
            lift_m: or(legged.swing_lift_m, lift),
            depth_m: or(legged.swing_depth_m, DEPTH_PART),
        },
        crouch_m: legged.crouch_m,
        motion: motion(setup, model, height)?,
        qp: core_config.qp,
        fallback: core_config.fallback,
        max_state_age_s: settings.max_state_age_s,
        command_life_s: settings.command_life_s,
        budget_s: period_s,
        rate_mean_s: legged.rate_mean_s,
    })
}

/// Two stages of a period, then equal ones.
fn stage_lengths(horizon_s: f64, count: usize, period_s: f64) -> Vec<f64> {
    let first = count.min(2);
    let rest = (horizon_s - first as f64 * period_s) / (count - first).max(1) as f64;
    (0..count).map(|k| if k < first { period_s } else { rest.max(0.5 * period_s) }).collect()
}

fn mass_centre_height(model: &LeggedModel) -> Result<f64, String> {
    let mut kinematics = Kinematics::new(&model.tree);
    let home = &model.posture;
    let configuration = Configuration::floating(home.base_pose_w(), &home.q);
    kinematics.update_positions(&model.tree, &configuration).map_err(|error| error.to_string())?;
    Ok(kinematics.mass_centre_of_tree_w(&model.tree).z)
}

fn motion(setup: &Setup, model: &LeggedModel, height: f64) -> Result<Motion, String> {
    let scenario = &setup.scenario;
    if let Some(gait) = &scenario.gait {
        return Ok(Motion::Gait(GaitCommand {
            gait: self::gait(gait, model, height)?,
            velocity: [gait.speed_m_s, gait.side_speed_m_s],
            yaw_rate: gait.yaw_rate_rad_s,
            start_s: gait.start_s,
            stop_s: gait.stop_s,
            ramp_s: gait.ramp_s,
        }));
    }
    if let Some(plan) = &setup.plan {
        let (base, steps) = planned_walk(plan, setup)?;
        return Ok(Motion::Planned(base, steps));
    }
    if scenario.step.is_empty() {
        return Ok(Motion::Stand);
    }
    let mut steps: Vec<Step> = scenario
        .step
        .iter()
        .map(|step| Step {
            foot: setup.robot.soles.iter().position(|sole| sole.name == step.foot).unwrap_or(0),
            to: Foothold::level(Vector3::from(step.position_m), step.yaw_rad),
            lift_s: step.time_s,
            touch_s: step.time_s + step.swing_s,
        })
        .collect();
    steps.sort_by(|a, b| a.lift_s.total_cmp(&b.lift_s));
    Ok(Motion::Steps(steps))
}

/// The gait, its phases in the order of the robot's feet, by where they stand at home: of four feet front from back and left from right;
/// of two the right one first.
fn gait(settings: &GaitSettings, model: &LeggedModel, height: f64) -> Result<Gait, String> {
    let mut kinematics = Kinematics::new(&model.tree);
    let home = &model.posture;
    let configuration = Configuration::floating(home.base_pose_w(), &home.q);
    kinematics.update_positions(&model.tree, &configuration).map_err(|error| error.to_string())?;
    let soles: Vec<RigidTransform> =
        model.feet.iter().map(|foot| kinematics.link_poses_w()[foot.body] * foot.sole).collect();
    // From their middle, in the heading of the first: root links have axes of all kinds.
    let middle = soles.iter().map(|sole| sole.translation).sum::<Vector3<f64>>() / soles.len().max(1) as f64;
    let places = soles.iter().map(|sole| soles[0].rotation.tr_mul(&(sole.translation - middle)));
    let phase: Vec<f64> = match (soles.len(), settings.kind) {
        (4, kind) => {
            let of_four = match kind {
                GaitKind::Trot | GaitKind::FlyingTrot => Gait::TROT,
                GaitKind::Walk => Gait::WALK,
                GaitKind::Pace => Gait::PACE,
                GaitKind::Bound => Gait::BOUND,
                GaitKind::Jump => Gait::JUMP,
            };
            places.map(|place| of_four[2 * usize::from(place.x < 0.0) + usize::from(place.y < 0.0)]).collect()
        }
        (2, GaitKind::Walk) => places.map(|place| if place.y < 0.0 { 0.0 } else { 0.5 }).collect(),
        (2, GaitKind::Jump) => vec![0.0; 2],
        (count, _) => {
            return Err(format!(
                "`gait.kind`: two feet walk or jump, four feet have all gaits, and this robot has {count}: give it steps, [[step]]"
            ));
        }
    };
    let period_s = match settings.period_s {
        0.0 => (if soles.len() == 2 { PERIOD_ON_TWO } else { PERIOD_ON_FOUR }) * (height / GRAVITY).sqrt(),
        period_s => period_s,
    };
    Ok(Gait { period_s, swing_s: period_s * (1.0 - settings.duty), phase })
}

/// Joint torques that hold the robot on all its feet at the start.
///
/// # Errors
/// In words, when the mechanics refuse the posture.
pub fn holding_torque(setup: &Setup) -> Result<Vec<f64>, String> {
    let model = model(setup)?;
    let mut kinematics = Kinematics::new(&model.tree);
    let home = &model.posture;
    let configuration = Configuration::floating(home.base_pose_w(), &home.q);
    kinematics.update_positions(&model.tree, &configuration).map_err(|error| error.to_string())?;
    let places: Vec<Foothold> = model
        .feet
        .iter()
        .map(|foot| {
            let sole = kinematics.link_poses_w()[foot.body] * foot.sole;
            Foothold::level(sole.translation, sole.rotation[(1, 0)].atan2(sole.rotation[(0, 0)]))
        })
        .collect();
    let swing = SwingShape { lift_m: 0.0, depth_m: 0.0 };
    let mut reference = MotionReference::new(&model, 1, swing, &places).map_err(|error| error.to_string())?;
    let mut grid = StageGrid::new(vec![0.01]);
    grid.cut(0.0, |_| None);
    let schedule = ContactSchedule::standing(&places, 2);
    reference.update(&model, &grid, &schedule).map_err(|error| error.to_string())?;
    Ok(reference.target(0).torque.clone())
}
