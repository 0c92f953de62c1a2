//! A posture on one sole by inverse kinematics: Gauss-Newton on the joints of the robot fixed at that sole.
//!
//! | residual | scale that counts 1 |
//! |---|---|
//! | mass centre from the middle of the sole, x and y | 3 mm |
//! | root link from upright (half its rotation's skew part) | 0.1 rad |
//! | its height from a little less than that of straight legs | 5 cm |
//! | the other sole from its place in the air | 1 cm, 0.03 rad |
//! | every joint from where it would rather be | 3 rad (or m) |
//!
//! Joints stay a part of their range away from their stops. Where they would rather be: 0 if that is well inside the range, else the nearest
//! place that is; knees are bent; joints that carry no leg keep a quarter of their range, so that elbows are bent and arms hang free of the trunk.

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{JointLimits, RobotModel};
use nalgebra::{DVector, Matrix3, Vector2, Vector3};

use crate::init::feet::centroid;
use crate::init::gauss_newton::least_squares;

/// Of the last solution; the first one looks at the mass centre less, so that it comes near from far away.
const COM: f64 = 300.0;
const COM_AT_FIRST: f64 = 50.0;
const UPRIGHT: f64 = 10.0;
const HEIGHT: f64 = 20.0;
const SWING: f64 = 100.0;
const SWING_TURN: f64 = 30.0;
const STAY: f64 = 0.3;
/// Part of a joint's range that one of a leg keeps from the stops.
pub const LEG_MARGIN: f64 = 0.05;
/// The same of another joint.
pub const OTHER_MARGIN: f64 = 0.25;
/// Height of the root link over the soles, as a part of that with all joints at zero.
const BENT: f64 = 0.95;
/// A joint of a leg that goes less than this beyond 0 to one side is a knee, and where it would rather be, rad.
const ONE_SIDED: f64 = 0.2;
const KNEE: f64 = 0.6;
/// How high the other foot hangs, as a part of that height.
const LIFT: f64 = 0.06;
/// Mass centre this near to where it should be, m, is good enough.
const GOOD_M: f64 = 0.005;

/// A posture in which the robot stands on one sole.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Joint coordinates, in the order of the floating robot.
    pub q: Vec<f64>,
    /// Pose of the root link in the frame of the sole.
    pub base_link: RigidTransform,
    /// Mass centre in the frame of the sole, m.
    pub com: Vector3<f64>,
}

/// The problem: the robot fixed at its sole.
struct Problem<'a> {
    standing: &'a RobotModel,
    root: String,
    com_weight: f64,
    /// Where the mass centre belongs, in the frame of the sole, m.
    middle: Vector2<f64>,
    /// Height of the root link over the sole, m.
    height: f64,
    /// Rotation of the root link with all joints at zero, when it is upright.
    upright: Matrix3<f64>,
    /// The other sole's frame and its place.
    swing: Option<(String, Vector3<f64>)>,
    lower: DVector<f64>,
    upper: DVector<f64>,
    rather: DVector<f64>,
    kinematics: Kinematics,
}

/// Solves for a posture on the sole of that name.
///
/// # Errors
/// In words: no such sole, a tree that cannot be rooted there, a mass centre that does not come over the sole.
pub fn stand_on(robot: &RobotModel, sole: &str) -> Result<Standing, String> {
    let Some(stance) = robot.sole(sole) else {
        let known: Vec<&str> = robot.soles.iter().map(|sole| sole.name.as_str()).collect();
        let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
        return Err(format!("the robot has no sole `{sole}`; it has {known}"));
    };
    let rooted = robot.rooted_at(&stance.frame).map_err(|error| error.rule().to_string())?;
    let mut problem = Problem::new(robot, &rooted.model, sole)?;
    let near = problem.solve(&problem.rather.clone());
    problem.com_weight = COM;
    let q = problem.solve(&near);
    let (com, base_link) = problem.stands(&q);
    let off = (com.xy() - problem.middle).norm();
    if off > GOOD_M {
        return Err(format!(
            "no posture on sole `{sole}` brings the mass centre over it: {:.0} mm are left",
            1e3 * off
        ));
    }
    let mut floating = vec![0.0; q.len()];
    for (name, value) in rooted.model.joint_names.iter().zip(&q) {
        if let Some(joint) = robot.joint(name) {
            floating[joint] = *value;
        }
    }
    Ok(Standing { q: floating, base_link, com })
}

/// Joints between the root link and the soles, by name.
pub fn leg_joints(robot: &RobotModel) -> Vec<String> {
    let first = robot.tree.first_joint_body();
    let mut names: Vec<String> = Vec::new();
    for sole in &robot.soles {
        let mut body = robot.frame(&sole.frame).and_then(|frame| frame.body);
        while let Some(at) = body {
            let name = at.checked_sub(first).and_then(|joint| robot.joint_names.get(joint));
            let new = name.filter(|name| !names.contains(name)).cloned();
            names.extend(new);
            body = robot.tree.bodies()[at].parent;
        }
    }
    names
}

/// A joint's range with a margin at both ends; joints without stops have three radians to either side.
pub fn kept(limits: &JointLimits, margin: f64) -> (f64, f64) {
    let (lower, upper) = (limits.lower.max(-3.0), limits.upper.min(3.0));
    // Stops that are far away on one side only.
    let (lower, upper) = (lower.min(upper), upper.max(lower));
    let keep = margin * (upper - lower);
    (lower + keep, upper - keep)
}

impl<'a> Problem<'a> {
    fn new(robot: &RobotModel, standing: &'a RobotModel, sole: &str) -> Result<Self, String> {
        let root = robot.body_names.first().cloned().unwrap_or_default();
        let legs = leg_joints(robot);
        let is_leg = |name: &String| legs.contains(name);
        let joints = || standing.joint_names.iter().zip(&standing.limits);
        let ranges: Vec<(f64, f64)> = joints().map(|(_, limits)| kept(limits, LEG_MARGIN)).collect();
        let rather = joints().map(|(name, limits)| {
            let (lower, upper) = kept(limits, if is_leg(name) { LEG_MARGIN } else { OTHER_MARGIN });
            // A knee: it bends to one side only, and a straight one does not know where to go.
            let bends = is_leg(name) && lower.max(-upper) > -ONE_SIDED;
            let bent = if lower + upper > 0.0 { KNEE } else { -KNEE };
            if bends { bent } else { 0.0_f64 }.clamp(lower, upper)
        });
        let mut problem = Self {
            standing,
            root,
            com_weight: COM_AT_FIRST,
            middle: standing.sole(sole).map_or_else(Vector2::zeros, |sole| centroid(&sole.polygon)),
            height: 0.0,
            upright: Matrix3::identity(),
            swing: None,
            lower: DVector::from_iterator(ranges.len(), ranges.iter().map(|range| range.0)),
            upper: DVector::from_iterator(ranges.len(), ranges.iter().map(|range| range.1)),
            rather: DVector::from_iterator(ranges.len(), rather),
            kinematics: Kinematics::new(&standing.tree),
        };
        // With all joints at zero: how high the root link is, and where the other foot.
        let zeros = DVector::zeros(ranges.len());
        let (_, base) = problem.stands(&zeros);
        problem.height = BENT * base.translation.z;
        problem.upright = base.rotation;
        let other = robot.soles.iter().find(|other| other.name != sole);
        problem.swing = other.map(|other| {
            let place = problem.pose(&other.frame).translation;
            (other.frame.clone(), Vector3::new(0.0, place.y, LIFT * base.translation.z))
        });
        Ok(problem)
    }

    /// Mass centre and root link in the frame of the sole.
    fn stands(&mut self, q: &DVector<f64>) -> (Vector3<f64>, RigidTransform) {
        let tree = &self.standing.tree;
        // Lengths fit: the vector is made for this tree.
        let _ = self.kinematics.update_positions(tree, &Configuration::fixed(q.as_slice()));
        (self.kinematics.mass_centre_of_tree_w(tree), self.pose(&self.root))
    }

    fn pose(&self, frame: &str) -> RigidTransform {
        let Some(frame) = self.standing.frame(frame) else { return RigidTransform::identity() };
        match frame.body {
            Some(body) => self.kinematics.link_poses_w()[body] * frame.pose,
            None => frame.pose,
        }
    }

    fn residual(&mut self, q: &DVector<f64>) -> DVector<f64> {
        let (com, base) = self.stands(q);
        let mut values = vec![
            self.com_weight * (com.x - self.middle.x),
            self.com_weight * (com.y - self.middle.y),
            HEIGHT * (base.translation.z - self.height),
        ];
        values.extend(lean(&(base.rotation * self.upright.transpose())).map(|angle| UPRIGHT * angle));
        if let Some((frame, place)) = &self.swing {
            let foot = self.pose(frame);
            values.extend((foot.translation - place).iter().map(|x| SWING * x));
            values.extend(lean(&foot.rotation).map(|angle| SWING_TURN * angle));
        }
        values.extend((q - &self.rather).iter().map(|x| STAY * x));
        DVector::from_vec(values)
    }

    fn solve(&mut self, q: &DVector<f64>) -> DVector<f64> {
        let (lower, upper) = (self.lower.clone(), self.upper.clone());
        least_squares(|q| self.residual(q), q, &lower, &upper)
    }
}

/// Half the skew part of a rotation: small angles about x, y, z.
pub fn lean(r: &Matrix3<f64>) -> [f64; 3] {
    [(r[(2, 1)] - r[(1, 2)]) / 2.0, (r[(0, 2)] - r[(2, 0)]) / 2.0, (r[(1, 0)] - r[(0, 1)]) / 2.0]
}
