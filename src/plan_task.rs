//! The task of the planner that a scenario's `[plan]` asks for.

use std::path::Path;

use delmpc_planner::error::PlanError;
use delmpc_planner::outline::leg_outline;
use delmpc_planner::robot::PlanRobot;
use delmpc_planner::task::{BaseBounds, ExecutionLimits, PlanWeights, Standing, Task};
use delmpc_planner::terrain::{Gap, Obstacle, Step, Terrain};
use delmpc_robots::load_with;
use delmpc_scenario::{PlanSettings, PlanWeightSettings, Scenario};

/// The task of a scenario whose robot is in `urdf`.
///
/// # Errors
/// A robot that cannot be read or planned for; a hand, joint or coordinate that it does not have.
pub fn task_of(urdf: &Path, scenario: &Scenario, settings: &PlanSettings) -> Result<Task, PlanError> {
    let options = crate::setup::load_options(scenario);
    let model = load_with(urdf, &options)
        .map_err(|error| PlanError::PlanFile { file: urdf.display().to_string(), what: error.to_string() })?;
    let springs: Vec<(&str, f64, f64)> = settings
        .spring
        .iter()
        .map(|spring| (spring.joint.as_str(), spring.stiffness_nm_per_rad, spring.rest_rad))
        .collect();
    let reaches = !settings.hand.is_empty();
    let robot = if reaches {
        PlanRobot::standing(&model, scenario.robot.stance.first())?
    } else {
        PlanRobot::new(&model)?
    };
    let robot = robot.with_springs(&springs)?;
    let standing = if reaches { Some(standing_of(&model, scenario, settings)) } else { None };
    let reach = if reaches { Some((robot.frame(&settings.hand)?.clone(), settings.target_m)) } else { None };
    let start = robot.posture(&scenario.robot.posture)?.to_vec();
    let mut bounds = Vec::new();
    for bound in &settings.bound {
        bounds.push((robot.coordinate(&bound.coordinate)?, bound.min, bound.max));
    }
    let [sole, shank] = settings.outline_points;
    let clearance = if sole + shank > 0 {
        leg_outline(&robot, sole, shank)?
    } else {
        // Spheres must not dip under the ground between the nodes.
        robot.contacts.iter().filter(|contact| contact.radius > 0.0).cloned().collect()
    };
    Ok(Task {
        terrain: terrain_of(settings),
        stages: settings.stages,
        horizon_s: settings.horizon_s,
        distance_m: settings.distance_m,
        speed_m_s: (settings.start_speed_m_s, settings.end_speed_m_s),
        start,
        friction: settings.friction,
        sliding: settings.sliding,
        range_margin: settings.range_margin,
        torque_fraction: settings.torque_fraction,
        torque_limit_nm: settings.torque_limit_nm,
        rate_limit: settings.rate_limit_rad_s,
        rate_fraction: settings.rate_fraction,
        point_load: (settings.point_load > 0.0).then_some(settings.point_load),
        bounds,
        base: BaseBounds {
            attitude_rad: settings.base_attitude_rad,
            height_m: (settings.base_height_m[0], settings.base_height_m[1]),
        },
        clearance,
        weights: weights_of(&settings.weights),
        alike: alike(&robot),
        execution: settings.execution.then_some(ExecutionLimits {
            touchdown_speed_m_s: settings.touchdown_speed_m_s,
            impact_impulse_ns: settings.impact_impulse_ns,
        }),
        standing,
        reach,
        guess_lift_m: settings.guess_lift_m,
        robot,
    })
}

/// The sole's bounding box less the margin.
fn standing_of(model: &delmpc_robots::RobotModel, scenario: &Scenario, settings: &PlanSettings) -> Standing {
    let polygon = model.sole(scenario.robot.stance.first()).map_or(&[][..], |sole| sole.polygon.as_slice());
    let range = |axis: usize| {
        let values = polygon.iter().map(|corner| corner[axis]);
        let (low, high) =
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        [low + settings.cop_margin_m, high - settings.cop_margin_m]
    };
    Standing {
        sole: scenario.robot.stance.first().to_owned(),
        pressure_m: [range(0), range(1)],
        yaw_arm_m: settings.yaw_arm_m,
    }
}

fn terrain_of(settings: &PlanSettings) -> Terrain {
    let obstacle = |o: &delmpc_scenario::PlanObstacle| Obstacle {
        x_m: o.x_m,
        height_m: o.height_m,
        thickness_m: o.thickness_m,
    };
    Terrain {
        obstacles: settings.obstacle.iter().map(obstacle).collect(),
        gaps: settings.gap.iter().map(|gap| Gap { from_m: gap.from_m, to_m: gap.to_m }).collect(),
        steps: settings.step.iter().map(|step| Step { x_m: step.x_m, rise_m: step.rise_m }).collect(),
        edge_margin_m: settings.edge_margin_m,
        obstacle_margin_m: settings.obstacle_margin_m,
        ground_slack_m: 0.0,
        tails_m: 0.0,
    }
}

fn weights_of(w: &PlanWeightSettings) -> PlanWeights {
    PlanWeights {
        torque_nm: w.torque_nm,
        joint_rate: w.joint_rate_s2_per_rad2,
        legs_alike: w.legs_alike_per_rad2,
        steady_speed: w.steady_speed_s2_per_m2,
        base_attitude: w.base_attitude_per_rad2,
        base_height: w.base_height_per_m2,
        posture: w.posture_per_rad2,
        impulse: w.impulse,
        end_base: w.end_base,
        end_joints: w.end_joints_per_rad2,
        end_base_rate: w.end_base_rate,
        end_joint_rate: w.end_joint_rate_s2_per_rad2,
    }
}

/// Coordinates of the right and the left that have the same name otherwise.
fn alike(robot: &PlanRobot) -> Vec<(usize, usize)> {
    let pair = |(a, name): (usize, &String)| {
        let other = name.strip_prefix("right_").map(|rest| format!("left_{rest}"))?;
        Some((a, robot.coordinates.iter().position(|known| *known == other)?))
    };
    robot.coordinates.iter().enumerate().filter_map(pair).collect()
}
