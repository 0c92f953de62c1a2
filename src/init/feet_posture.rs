//! A posture on several feet by inverse kinematics: least squares on the pose of the root link and the joints.
//!
//! | residual | scale that counts 1 |
//! |---|---|
//! | height of every foot over the ground | 1 mm |
//! | lean of every flat foot | 3 mrad |
//! | heading of every flat foot | 0.03 rad |
//! | every foot from its place relative to the others' middle: that with all joints at zero, humanoids' feet side by side | 1 cm |
//! | mass centre from the middle of the support, x and y | 3 mm |
//! | root link from upright | 0.1 rad |
//! | its height from that of bent legs | 5 cm |
//! | every joint from where it would rather be | 3 rad (or m) |
//!
//! Where joints would rather be: as on one foot ([`crate::init::posture`]), and the joints of a leg bent as legs bend that have no stops to
//! tell: knees behind the hips.

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, base_pose_from_link};
use delmpc_mechanics::prelude::{JointKind, RigidTransform};
use delmpc_mechanics::spatial::exp_rotation;
use delmpc_robots::RobotModel;
use nalgebra::{DVector, Matrix3, Vector2, Vector3};

use crate::init::feet::{FoundFoot, centroid, hull};
use crate::init::gauss_newton::least_squares;
use crate::init::posture::{LEG_MARGIN, OTHER_MARGIN, Standing, kept, lean};

const FOOT_HEIGHT: f64 = 1000.0;
const FOOT_LEAN: f64 = 300.0;
const FOOT_HEADING: f64 = 30.0;
const FOOT_PLACE: f64 = 100.0;
const COM: f64 = 300.0;
const UPRIGHT: f64 = 10.0;
const HEIGHT: f64 = 20.0;
const STAY: f64 = 0.3;
/// Height of a leg's first joint over its foot, as a part of that with all joints at zero: on soles, on tips.
const BENT: f64 = 0.95;
const BENT_ON_TIPS: f64 = 0.75;
/// How far a knee is bent, where it may be: on soles, on tips, rad.
const KNEE: f64 = 0.6;
const KNEE_ON_TIPS: f64 = 1.2;
/// The middle of a knee's range is this part of it away from straight: it bends to that side.
const ONE_SIDED: f64 = 0.25;
/// An axis this near to the lateral one turns the leg forward and back.
const LATERAL: f64 = 0.8;
/// Off by this much (m, rad) is not standing.
const GOOD_M: f64 = 1e-4;
const GOOD_COM_M: f64 = 0.005;

/// A foot of the problem.
struct Foot {
    body: usize,
    /// Sole frame, or centre of the tip, in the axes of the body.
    in_body: RigidTransform,
    /// Of a tip; 0 of a sole.
    radius: f64,
    is_flat: bool,
    /// Where it is with all joints at zero, from the middle of all.
    place: Vector2<f64>,
}

struct Problem<'a> {
    robot: &'a RobotModel,
    feet: Vec<Foot>,
    /// Where the root link is at first; its height is where it should be.
    start: Vector3<f64>,
    /// The middle of the support, from the middle of the feet.
    support: Vector2<f64>,
    rather: DVector<f64>,
    /// Rotation of the root link when it is upright and the feet point ahead.
    upright: Matrix3<f64>,
    kinematics: Kinematics,
}

/// Solves for a posture on these feet of the robot, the others in the air where they come to be. The world's origin is the middle of the
/// support on the ground, x forward, z up.
///
/// # Errors
/// In words: feet that do not come to the ground, a mass centre that does not come over them.
pub fn stand_on_feet(robot: &RobotModel, feet: &[FoundFoot]) -> Result<Standing, String> {
    let mut problem = Problem::new(robot, feet).map_err(|error| error.to_string())?;
    let (lower, upper) = problem.bounds();
    let mut start = DVector::zeros(6 + robot.joint_names.len());
    start.rows_mut(0, 3).copy_from(&problem.start);
    start.rows_mut(6, robot.joint_names.len()).copy_from(&problem.rather);
    let solved = least_squares(|x| problem.residual(x), &start, &lower, &upper);
    problem.check(&solved)?;
    let (base_link, com) = problem.pose(&solved);
    let origin = Vector3::new(problem.support.x, problem.support.y, 0.0);
    let moved = RigidTransform { translation: base_link.translation - origin, ..base_link };
    Ok(Standing {
        q: solved.rows(6, robot.joint_names.len()).iter().copied().collect(),
        base_link: moved,
        com: com - origin,
    })
}

/// Puts the frames of tips where they touch the ground in a posture, upright.
///
/// # Errors
/// When the posture does not fit the tree.
pub fn place_tips(robot: &RobotModel, standing: &Standing, feet: &mut [FoundFoot]) -> Result<(), ModelError> {
    let mut kinematics = Kinematics::new(&robot.tree);
    let base = base_pose_from_link(&robot.tree, &standing.base_link);
    kinematics.update_positions(&robot.tree, &Configuration::floating(base, &standing.q))?;
    for foot in feet {
        let link = robot.link(&foot.link).and_then(|link| Some((link.body?, link.pose)));
        if let (Some(tip), Some((body, pose))) = (&foot.tip, link) {
            let link_w = kinematics.link_poses_w()[body] * pose;
            let tip_w = crate::init::tip::Tip { centre: link_w.transform_point(&tip.centre), ..*tip };
            foot.frame = link_w.inverse() * tip_w.touching();
        }
    }
    Ok(())
}

impl<'a> Problem<'a> {
    fn new(robot: &'a RobotModel, found: &[FoundFoot]) -> Result<Self, ModelError> {
        let tree = &robot.tree;
        let zeros = vec![0.0; robot.joint_names.len()];
        let mut kinematics = Kinematics::new(tree);
        let base = base_pose_from_link(tree, &RigidTransform::identity());
        kinematics.update_positions(tree, &Configuration::floating(base, &zeros))?;
        let poses = kinematics.link_poses_w().to_vec();
        let feet = found.iter().filter_map(|foot| {
            let link = robot.link(&foot.link)?;
            let body = link.body?;
            let (in_link, radius) = match foot.tip {
                Some(tip) => (RigidTransform::from_translation(tip.centre), tip.radius),
                None => (foot.frame, 0.0),
            };
            let in_body = link.pose * in_link;
            let place = (poses[body] * in_body).translation.xy();
            let is_flat = foot.tip.is_none();
            Some(Foot { body, in_body, radius, is_flat, place })
        });
        let mut feet: Vec<Foot> = feet.collect();
        // The root link's axes at zero have x forward only if the feet say so: headings are those of the soles.
        let heading = feet
            .iter()
            .find(|foot| foot.is_flat)
            .map_or_else(Matrix3::identity, |foot| (poses[foot.body] * foot.in_body).rotation);
        let turn = heading.fixed_view::<2, 2>(0, 0).transpose();
        let middle = feet.iter().map(|foot| foot.place).sum::<Vector2<f64>>() / feet.len().max(1) as f64;
        for foot in &mut feet {
            foot.place = turn * (foot.place - middle);
        }
        // Two feet side by side.
        if let [right, left] = feet.as_mut_slice() {
            (right.place.x, left.place.x) = (0.0, 0.0);
        }
        let lowest = |foot: &Foot| (poses[foot.body] * foot.in_body).translation.z - foot.radius;
        let ground = feet.iter().map(lowest).fold(f64::INFINITY, f64::min);
        let on_tips = feet.iter().any(|foot| !foot.is_flat);
        let legs = legs(robot, &feet);
        let hips = legs.iter().filter_map(|leg| leg.first()).map(|body| poses[*body].translation.z - ground);
        let hip = hips.fold(0.0, f64::max);
        let bent = if on_tips { BENT_ON_TIPS } else { BENT };
        let mut problem = Self {
            robot,
            start: (-turn * middle).push(-ground - (1.0 - bent) * hip),
            upright: heading.transpose(),
            support: Vector2::zeros(),
            rather: DVector::from_vec(rather(robot, &legs, &poses, &heading, on_tips)),
            kinematics,
            feet,
        };
        let corners = |foot: &Foot, found: &FoundFoot| -> Vec<Vector2<f64>> {
            match foot.is_flat {
                true => found.corners.iter().map(|corner| foot.place + corner).collect(),
                false => vec![foot.place],
            }
        };
        let support =
            hull(&problem.feet.iter().zip(found).flat_map(|(f, s)| corners(f, s)).collect::<Vec<_>>());
        problem.support = if support.len() >= 3 { centroid(&support) } else { Vector2::zeros() };
        Ok(problem)
    }

    fn bounds(&self) -> (DVector<f64>, DVector<f64>) {
        let ranges: Vec<(f64, f64)> =
            self.robot.limits.iter().map(|limits| kept(limits, LEG_MARGIN)).collect();
        let bound = |base: f64, of: fn(&(f64, f64)) -> f64| {
            DVector::from_iterator(
                6 + ranges.len(),
                std::iter::repeat_n(base, 6).chain(ranges.iter().map(of)),
            )
        };
        (bound(-10.0, |range| range.0), bound(10.0, |range| range.1))
    }

    /// Pose of the root link, and the mass centre; the kinematics are those of `x` afterwards.
    fn pose(&mut self, x: &DVector<f64>) -> (RigidTransform, Vector3<f64>) {
        let turn = Vector3::new(x[3], x[4], x[5]);
        let translation = Vector3::new(x[0], x[1], x[2]);
        let base_link = RigidTransform { rotation: exp_rotation(&turn) * self.upright, translation };
        let tree = &self.robot.tree;
        let configuration =
            Configuration::floating(base_pose_from_link(tree, &base_link), &x.as_slice()[6..]);
        // Lengths fit: the vector is made for this tree.
        let _ = self.kinematics.update_positions(tree, &configuration);
        (base_link, self.kinematics.mass_centre_of_tree_w(tree))
    }

    fn residual(&mut self, x: &DVector<f64>) -> DVector<f64> {
        let (base, com) = self.pose(x);
        let mut values = vec![
            COM * (com.x - self.support.x),
            COM * (com.y - self.support.y),
            HEIGHT * (base.translation.z - self.start.z),
            UPRIGHT * x[3],
            UPRIGHT * x[4],
            UPRIGHT * x[5],
        ];
        for foot in &self.feet {
            let pose = self.kinematics.link_poses_w()[foot.body] * foot.in_body;
            let place = pose.translation.xy() - foot.place;
            values.push(FOOT_HEIGHT * (pose.translation.z - foot.radius));
            values.extend(place.iter().map(|x| FOOT_PLACE * x));
            if foot.is_flat {
                let [roll, pitch, yaw] = lean(&pose.rotation);
                values.extend([FOOT_LEAN * roll, FOOT_LEAN * pitch, FOOT_HEADING * yaw]);
            }
        }
        values.extend((x.rows(6, self.rather.len()) - &self.rather).iter().map(|x| STAY * x));
        DVector::from_vec(values)
    }

    fn check(&mut self, x: &DVector<f64>) -> Result<(), String> {
        let (_, com) = self.pose(x);
        let height = |foot: &Foot| {
            let pose = self.kinematics.link_poses_w()[foot.body] * foot.in_body;
            let leans = if foot.is_flat { pose.rotation.column(2).xy().norm() } else { 0.0 };
            ((pose.translation.z - foot.radius).abs()).max(leans)
        };
        let off = self.feet.iter().map(height).fold(0.0, f64::max);
        if off > GOOD_M {
            return Err(format!(
                "no posture brings all feet to the ground: {:.1} mm or mrad are left",
                1e3 * off
            ));
        }
        let off = (com.xy() - self.support).norm();
        if off > GOOD_COM_M {
            return Err(format!(
                "no posture brings the mass centre over the feet: {:.0} mm are left",
                1e3 * off
            ));
        }
        Ok(())
    }
}

/// Bodies from the trunk to every foot that carry no other foot, the one at the trunk first.
fn legs(robot: &RobotModel, feet: &[Foot]) -> Vec<Vec<usize>> {
    let first = robot.tree.first_joint_body();
    let way = |foot: &Foot| -> Vec<usize> {
        let up = std::iter::successors(Some(foot.body), |body| robot.tree.bodies()[*body].parent);
        up.filter(|body| *body >= first).collect()
    };
    let ways: Vec<Vec<usize>> = feet.iter().map(way).collect();
    let own = |(index, way): (usize, &Vec<usize>)| {
        let carries_others =
            |body: &usize| ways.iter().enumerate().any(|(other, way)| other != index && way.contains(body));
        way.iter().rev().filter(|body| !carries_others(body)).copied().collect()
    };
    ways.iter().enumerate().map(own).collect()
}

/// Where the joints would rather be.
fn rather(
    robot: &RobotModel,
    legs: &[Vec<usize>],
    poses: &[RigidTransform],
    heading: &Matrix3<f64>,
    on_tips: bool,
) -> Vec<f64> {
    let first = robot.tree.first_joint_body();
    let is_leg = |joint: usize| legs.iter().any(|leg| leg.contains(&(joint + first)));
    let ranges: Vec<(f64, f64)> = robot
        .limits
        .iter()
        .enumerate()
        .map(|(joint, limits)| kept(limits, if is_leg(joint) { LEG_MARGIN } else { OTHER_MARGIN }))
        .collect();
    let mut rather: Vec<f64> = ranges.iter().map(|(lower, upper)| 0.0_f64.clamp(*lower, *upper)).collect();
    let knee = if on_tips { KNEE_ON_TIPS } else { KNEE };
    for leg in legs {
        // Positive about this axis of the joint turns the leg's end back.
        let back = |body: usize| {
            let joint = &robot.tree.bodies()[body].joint;
            let axis_w = poses[body].rotation * joint.axis;
            let along = axis_w.dot(&heading.column(1).into_owned());
            (joint.kind == JointKind::Revolute && along.abs() > LATERAL)
                .then_some((body - first, along.signum()))
        };
        let pitch: Vec<(usize, f64)> = leg.iter().filter_map(|body| back(*body)).collect();
        let [(hip, hip_sign), (bend, bend_sign), ..] = pitch[..] else { continue };
        let (lower, upper) = ranges[bend];
        // Stops tell how it bends; without them the knee goes behind the hip on tips, and before it on soles, as people's do.
        let side = match (lower + upper).abs() > ONE_SIDED * (upper - lower) {
            true => (lower + upper).signum(),
            false if on_tips => -bend_sign,
            false => bend_sign,
        };
        rather[bend] = (side * knee).clamp(lower, upper);
        let (lower, upper) = ranges[hip];
        rather[hip] = (-0.5 * rather[bend] * bend_sign * hip_sign).clamp(lower, upper);
    }
    rather
}
