//! A planned motion of a robot with feet that are spheres, as its controller follows it: base and mass centre over time, and the steps.
//!
//! A foot swings where the plan moves it: the stages in which it changes its place or leaves the ground, one after the other, are a step from
//! the place before to the place after. A foot that merely carries nothing for a while stands.
//!
//! LittleDog follows a plan over level ground to its end in two of three seeds. Where a plan has it on one foot or on none for a stage it falls: a foot that lands
//! late leaves no time to wait for it.
//!
//! The plan is told in the world of the posture; the controller's is that of the stance frame at the start ([`crate::start`]).

use delmpc_horizon::contact_schedule::Foothold;
use delmpc_horizon::planned_base::{BaseNode, PlannedBase};
use delmpc_horizon::step_plan::Step;
use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_planner::plan_file::Plan;
use delmpc_robots::RobotModel;
use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::setup::Setup;
use crate::start::levelled;

/// A foot that moves by less in a stage stands, m.
const STILL_M: f64 = 2e-3;
/// A step that goes less far and less high than this is none: the foot stands where it was, m.
const SMALLEST_STEP_M: f64 = 0.012;
/// A swing begins later and ends earlier by this part of it, at most by so much, s.
const OVERLAP_PART: f64 = 0.15;
const OVERLAP_S: f64 = 0.03;
/// Step of the difference quotient of the mass centre, s.
const DIFFERENCE_S: f64 = 1e-5;
/// Rest before a plan begins, s.
pub const BEGIN_S: f64 = 0.5;

/// The coordinates of a plan in the order of the robot.
struct Coordinates {
    /// x, y, z, yaw, pitch, roll.
    base: [usize; 6],
    joints: Vec<usize>,
}

/// Base and mass centre over the time of the run, and the steps, in the order of lift-off.
///
/// # Errors
/// In words: a plan of another robot, or one whose feet are not spheres, each its own sole.
pub fn planned_walk(plan: &Plan, setup: &Setup) -> Result<(PlannedBase, Vec<Step>), String> {
    let robot = &setup.robot;
    let coordinates = Coordinates::of(plan, robot)?;
    let mut kinematics = Kinematics::new(&robot.tree);
    let begin_s = BEGIN_S - plan.t.first().copied().unwrap_or(0.0);
    let refuse = |error: ModelError| format!("plan {}: {error}", plan.name);
    let feet = feet_of(robot, plan)?;
    let mut nodes = Vec::with_capacity(plan.t.len());
    let mut places: Vec<Vec<Vector3<f64>>> = vec![Vec::new(); feet.len()];
    let mut from_world = None;
    for ((t, q), v) in plan.t.iter().zip(&plan.q).zip(&plan.v) {
        let mut mass_centre = |along_s: f64| -> Result<Vector3<f64>, ModelError> {
            let moved: Vec<f64> = q.iter().zip(v).map(|(q, v)| q + along_s * v).collect();
            coordinates.update(&moved, robot, &mut kinematics)?;
            Ok(kinematics.mass_centre_of_tree_w(&robot.tree))
        };
        let (before, after) =
            (mass_centre(-DIFFERENCE_S).map_err(refuse)?, mass_centre(DIFFERENCE_S).map_err(refuse)?);
        let here = mass_centre(0.0).map_err(refuse)?;
        let from_world = from_world.get_or_insert_with(|| stance_frame(setup, &kinematics).inverse());
        let [yaw, pitch, roll] = [3, 4, 5].map(|k| q[coordinates.base[k]]);
        let (orientation, spin_b) = attitude([yaw, pitch, roll], [3, 4, 5].map(|k| v[coordinates.base[k]]));
        nodes.push(BaseNode {
            time_s: t + begin_s,
            mass_centre_w: from_world.transform_point(&here),
            mass_centre_velocity_w: from_world.rotation * (after - before) / (2.0 * DIFFERENCE_S),
            orientation: from_world.rotation * orientation,
            spin_b,
            q: coordinates.joints.iter().map(|k| q[*k]).collect(),
            rate: coordinates.joints.iter().map(|k| v[*k]).collect(),
        });
        for (foot, places) in feet.iter().zip(&mut places) {
            let centre = kinematics.link_poses_w()[foot.body].transform_point(&foot.centre);
            places.push(from_world.transform_point(&Vector3::new(
                centre.x,
                centre.y,
                centre.z - foot.radius,
            )));
        }
    }
    let times: Vec<f64> = plan.t.iter().map(|t| t + begin_s).collect();
    let base = PlannedBase::new(nodes).ok_or_else(|| format!("plan {}: its times do not rise", plan.name))?;
    let mut steps: Vec<Step> =
        places.iter().enumerate().flat_map(|(foot, places)| steps_of(foot, places, &times)).collect();
    steps.sort_by(|a, b| a.lift_s.total_cmp(&b.lift_s));
    Ok((base, steps))
}

/// The frame of the first stance sole where the robot is, z up.
fn stance_frame(setup: &Setup, kinematics: &Kinematics) -> RigidTransform {
    let frame = setup.robot.frame(setup.stance_frame());
    let on_body = frame.and_then(|frame| Some(kinematics.link_poses_w()[frame.body?] * frame.pose));
    on_body.map_or_else(RigidTransform::identity, |sole| levelled(&sole))
}

impl Coordinates {
    fn of(plan: &Plan, robot: &RobotModel) -> Result<Self, String> {
        let find = |name: &str| {
            let place = plan.coordinates.iter().position(|coordinate| coordinate == name);
            place.ok_or_else(|| {
                format!("plan {}: it has no coordinate `{name}`: it is of another robot", plan.name)
            })
        };
        let mut base = [0; 6];
        for (at, name) in
            base.iter_mut().zip(["base_x", "base_y", "base_z", "base_yaw", "base_pitch", "base_roll"])
        {
            *at = find(name)?;
        }
        let joints = robot.joint_names.iter().map(|name| find(name)).collect::<Result<_, _>>()?;
        Ok(Self { base, joints })
    }

    fn update(&self, q: &[f64], robot: &RobotModel, kinematics: &mut Kinematics) -> Result<(), ModelError> {
        let [x, y, z, yaw, pitch, roll] = self.base.map(|k| q[k]);
        let link = RigidTransform::from_xyz_rpy(Vector3::new(x, y, z), Vector3::new(roll, pitch, yaw));
        let joints: Vec<f64> = self.joints.iter().map(|k| q[*k]).collect();
        let pose = base_pose_from_link(&robot.tree, &link);
        kinematics.update_positions(&robot.tree, &Configuration::floating(pose, &joints))
    }
}

/// Orientation of yaw, pitch, roll, and the angular velocity of their rates in the turned axes.
fn attitude(
    [yaw, pitch, roll]: [f64; 3],
    [yaw_rate, pitch_rate, roll_rate]: [f64; 3],
) -> (Matrix3<f64>, Vector3<f64>) {
    let about = |axis, angle| *Rotation3::from_axis_angle(&axis, angle).matrix();
    let (turn_y, turn_x) = (about(Vector3::y_axis(), pitch), about(Vector3::x_axis(), roll));
    let orientation = about(Vector3::z_axis(), yaw) * turn_y * turn_x;
    let spin_b = turn_x
        .tr_mul(&(turn_y.tr_mul(&Vector3::new(0.0, 0.0, yaw_rate)) + Vector3::new(0.0, pitch_rate, 0.0)))
        + Vector3::new(roll_rate, 0.0, 0.0);
    (orientation, spin_b)
}

/// A foot that is a sphere.
struct Foot {
    body: usize,
    centre: Vector3<f64>,
    radius: f64,
}

/// The feet in the order of the robot's soles.
fn feet_of(robot: &RobotModel, plan: &Plan) -> Result<Vec<Foot>, String> {
    let of_sole = |sole: &delmpc_robots::Sole| {
        let single = (sole.contacts.len() == 1).then(|| robot.contacts.get(sole.contacts[0])).flatten();
        let foot = single.and_then(|contact| {
            Some(Foot { body: contact.body?, centre: contact.position, radius: contact.radius })
        });
        foot.ok_or_else(|| {
            format!(
                "plan {}: sole `{}` is not one sphere: plans of flat feet are not followed",
                plan.name, sole.name
            )
        })
    };
    robot.soles.iter().map(of_sole).collect()
}

/// How much later than planned a foot lifts off, and earlier it lands: a plan may have one foot land as another one lifts off, and a foot that
/// lands late would leave the robot in the air then.
fn overlap_s(swing_s: f64) -> f64 {
    (OVERLAP_PART * swing_s).min(OVERLAP_S)
}

/// The steps of a foot from its places at the plan's boundaries.
fn steps_of(foot: usize, places: &[Vector3<f64>], times: &[f64]) -> Vec<Step> {
    let still = |k: usize| {
        let (a, b) = (places[k], places[k + 1]);
        (b.xy() - a.xy()).norm() < STILL_M && a.z.abs().max(b.z.abs()) < STILL_M
    };
    let mut steps = Vec::new();
    let mut lifted: Option<usize> = None;
    for k in 0..places.len().saturating_sub(1) {
        match (still(k), lifted) {
            (false, None) => lifted = Some(k),
            (true, Some(from)) => {
                steps.push((from, k));
                lifted = None;
            }
            _ => {}
        }
    }
    steps.extend(lifted.map(|from| (from, places.len() - 1)));
    steps.retain(|&(from, to)| {
        let highest = places[from..=to].iter().fold(0.0, |highest: f64, place| highest.max(place.z));
        (places[to].xy() - places[from].xy()).norm().max(highest) > SMALLEST_STEP_M
    });
    let step = |(from, to): (usize, usize)| Step {
        foot,
        to: Foothold::level(Vector3::new(places[to].x, places[to].y, 0.0), 0.0),
        lift_s: times[from] + overlap_s(times[to] - times[from]),
        touch_s: times[to] - overlap_s(times[to] - times[from]),
    };
    steps.into_iter().map(step).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_foot_steps_where_it_moves() {
        let at = |x: f64, z: f64| Vector3::new(x, 0.1, z);
        let places = [at(0.0, 0.0), at(0.0, 0.0), at(0.05, 0.02), at(0.1, 0.0), at(0.1, 0.0), at(0.2, 0.0)];
        let steps = steps_of(3, &places, &[0.0, 0.1, 0.2, 0.3, 0.4, 0.5]);
        let told: Vec<_> = steps.iter().map(|s| (s.foot, s.to.position_w.x)).collect();
        assert_eq!(told, [(3, 0.1), (3, 0.2)]);
        // Each stands a little longer before and sooner after.
        for (step, [lift_s, touch_s]) in steps.iter().zip([[0.13, 0.27], [0.415, 0.485]]) {
            assert!(
                (step.lift_s - lift_s).abs() < 1e-12 && (step.touch_s - touch_s).abs() < 1e-12,
                "{step:?}"
            );
        }
    }

    #[test]
    fn the_angular_velocity_is_that_of_the_turning_axes() {
        let (angles, rates) = ([0.3, -0.2, 0.5], [0.7, -0.4, 1.1]);
        let (orientation, spin_b) = attitude(angles, rates);
        let h = 1e-6;
        let moved = |sign: f64| {
            let angles: Vec<f64> = angles.iter().zip(rates).map(|(a, r)| a + sign * h * r).collect();
            attitude([angles[0], angles[1], angles[2]], rates).0
        };
        let change = orientation.tr_mul(&((moved(1.0) - moved(-1.0)) / (2.0 * h)));
        let expected = Vector3::new(change[(2, 1)], change[(0, 2)], change[(1, 0)]);
        assert!((spin_b - expected).norm() < 1e-9, "{spin_b} {expected}");
    }
}
