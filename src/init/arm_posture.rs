//! A posture of an arm that is bolted down: of many, the one from which its end moves best in all directions.
//!
//! Postures are tried in the inner half of the joints' ranges, evenly spread (Halton's sequence, the same in every run). The best one has
//! the largest least singular value of the Jacobian of the arm's end, relative to its length, less the part of the efforts that gravity
//! takes and how far the joints are from their middles. The end is well above the mount, and no link below it.
//!
//! Source: T. Yoshikawa, Int. J. Robotics Research 4, 1985 (manipulability); J. H. Halton, Numer. Math. 2, 1960.

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::{JointKind, RigidTransform};
use delmpc_robots::RobotModel;
use nalgebra::{DMatrix, Vector3};

use crate::init::posture::Standing;

const TRIED: u32 = 3000;
/// What counts against a posture: gravity's part of an effort, distance from the middles as a part of the ranges.
const GRAVITY: f64 = 0.3;
const AWAY: f64 = 0.2;
/// Least height of the end over the mount, as a part of the arm's length.
const END_HEIGHT: f64 = 0.15;
/// Joints without stops turn so far to either side, rad.
const FREE_RAD: f64 = 2.5;

/// The end of an arm: its name, the link and the point in its axes.
pub type Hand = (String, String, Vector3<f64>);

/// The body farthest down the longest chain of joints, at the mass centre of its link; `None` for a robot without joints.
pub fn hand(robot: &RobotModel) -> Option<Hand> {
    let tree = &robot.tree;
    let turning = |body: usize| {
        let up = std::iter::successors(Some(body), |body| tree.bodies()[*body].parent);
        up.filter(|body| tree.bodies()[*body].joint.kind == JointKind::Revolute).count()
    };
    let carries = |body: usize| tree.bodies().iter().any(|other| other.parent == Some(body));
    let ends = (0..tree.body_count()).filter(|body| !carries(*body));
    let end = ends.max_by_key(|body| (turning(*body), std::cmp::Reverse(*body)))?;
    let link = robot.body_names.get(end)?.clone();
    Some(("hand".to_owned(), link, tree.bodies()[end].inertia.com))
}

/// The best posture of a robot that is bolted down.
///
/// # Errors
/// In words: no joints, or a tree that cannot be posed.
pub fn bolted(robot: &RobotModel, hand: &Hand) -> Result<Standing, String> {
    let body = robot.link(&hand.1).and_then(|link| link.body).ok_or("no joint carries the hand")?;
    let ranges: Vec<(f64, f64)> =
        robot.limits.iter().map(|limit| (limit.lower.max(-FREE_RAD), limit.upper.min(FREE_RAD))).collect();
    let middle: Vec<f64> = ranges.iter().map(|(lower, upper)| 0.5 * (lower + upper)).collect();
    let mut arm = Arm::new(robot, body, hand.2);
    let (length, _) = arm.stretch(&middle).map_err(|error| error.to_string())?;
    let mut best: Option<(f64, Vec<f64>)> = None;
    for index in 1..=TRIED {
        let part = |joint: usize| 0.5 * (halton(index, PRIMES[joint % PRIMES.len()]) - 0.5);
        let q: Vec<f64> = (0..ranges.len())
            .map(|joint| middle[joint] + part(joint) * (ranges[joint].1 - ranges[joint].0))
            .collect();
        let away = (0..q.len()).map(|joint| part(joint).powi(2)).sum::<f64>() / q.len().max(1) as f64;
        let value = arm.value(&q, length).map_err(|error| error.to_string())?;
        let value = value.map(|value| value - AWAY * away.sqrt());
        if let Some(value) = value.filter(|value| best.as_ref().is_none_or(|(most, _)| value > most)) {
            best = Some((value, q));
        }
    }
    let q = best.map_or(middle, |(_, q)| q);
    let (_, com) = arm.stretch(&q).map_err(|error| error.to_string())?;
    Ok(Standing { q, base_link: RigidTransform::identity(), com })
}

const PRIMES: [u32; 12] = [2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37];

/// The digits of `index` in that base, mirrored at the point: 0 to 1.
fn halton(mut index: u32, base: u32) -> f64 {
    let (mut value, mut unit) = (0.0, 1.0);
    while index > 0 {
        unit /= f64::from(base);
        value += unit * f64::from(index % base);
        index /= base;
    }
    value
}

struct Arm<'a> {
    robot: &'a RobotModel,
    body: usize,
    point: Vector3<f64>,
    kinematics: Kinematics,
    dynamics: InverseDynamicsWorkspace,
    torque: Vec<f64>,
}

impl<'a> Arm<'a> {
    fn new(robot: &'a RobotModel, body: usize, point: Vector3<f64>) -> Self {
        let (kinematics, dynamics) =
            (Kinematics::new(&robot.tree), InverseDynamicsWorkspace::new(&robot.tree));
        Self { robot, body, point, kinematics, dynamics, torque: vec![0.0; robot.joint_names.len()] }
    }

    /// Bodies from the mount to the hand.
    fn chain(&self) -> Vec<usize> {
        let bodies = self.robot.tree.bodies();
        std::iter::successors(Some(self.body), |body| bodies[*body].parent).collect()
    }

    /// Length of the chain of joints, and the mass centre.
    fn stretch(&mut self, q: &[f64]) -> Result<(f64, Vector3<f64>), ModelError> {
        let tree = &self.robot.tree;
        self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
        let poses = self.kinematics.link_poses_w();
        let mut places: Vec<Vector3<f64>> = vec![poses[self.body].transform_point(&self.point)];
        places.extend(self.chain().into_iter().map(|body| poses[body].translation));
        let length = places.windows(2).map(|pair| (pair[0] - pair[1]).norm()).sum::<f64>();
        Ok((length.max(1e-3), self.kinematics.mass_centre_of_tree_w(tree)))
    }

    /// How good a posture is; `None` when it is below the mount.
    fn value(&mut self, q: &[f64], length: f64) -> Result<Option<f64>, ModelError> {
        let tree = &self.robot.tree;
        self.kinematics.update_positions(tree, &Configuration::fixed(q))?;
        let poses = self.kinematics.link_poses_w();
        let end = poses[self.body].transform_point(&self.point);
        let lowest = poses.iter().map(|pose| pose.translation.z).fold(f64::INFINITY, f64::min);
        let mount = poses.first().map_or(0.0, |pose| pose.translation.z).min(0.0);
        if end.z < END_HEIGHT * length || lowest < mount - 1e-3 {
            return Ok(None);
        }
        let chain = self.chain();
        let turning = || chain.iter().filter(|body| tree.bodies()[**body].joint.kind == JointKind::Revolute);
        let columns = turning().map(|body| {
            let axis = poses[*body].rotation * tree.bodies()[*body].joint.axis;
            axis.cross(&(end - poses[*body].translation)) / length
        });
        let columns: Vec<Vector3<f64>> = columns.collect();
        let jacobian = DMatrix::from_fn(3, columns.len(), |row, column| columns[column][row]);
        let least = jacobian.singular_values().iter().copied().fold(f64::INFINITY, f64::min);
        gravity_force_into(tree, &self.kinematics, &mut self.dynamics, &mut self.torque)?;
        let loads =
            self.torque.iter().zip(&self.robot.limits).map(|(torque, limit)| torque.abs() / limit.effort);
        Ok(Some(least - GRAVITY * loads.fold(0.0, f64::max)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sequence_is_haltons() {
        assert_eq!([1, 2, 3, 4].map(|index| halton(index, 2)), [0.5, 0.25, 0.75, 0.125]);
        assert!((halton(5, 3) - (2.0 / 3.0 + 1.0 / 9.0)).abs() < 1e-15);
    }

    #[test]
    fn an_arm_of_two_bends_its_elbow_by_a_right_angle() {
        let link = |name: &str, mass: f64| {
            format!(
                "<link name='{name}'><inertial><origin xyz='0 0 0.5'/><mass value='{mass}'/><inertia ixx='0.01' ixy='0' ixz='0' iyy='0.01' iyz='0' izz='0.01'/></inertial></link>"
            )
        };
        let joint = |name: &str, parent: &str, child: &str, axis: &str, z: f64| {
            format!(
                "<joint name='{name}' type='revolute'><origin xyz='0 0 {z}'/><parent link='{parent}'/><child link='{child}'/><axis xyz='{axis}'/><limit lower='-2.5' upper='2.5' effort='100' velocity='3'/></joint>"
            )
        };
        let urdf = [
            "<robot name='arm'><link name='world'/><joint name='m' type='fixed'><parent link='world'/><child link='mount'/></joint>".to_owned(),
            link("mount", 1.0),
            joint("turn", "mount", "post", "0 0 1", 0.1),
            link("post", 0.1),
            joint("shoulder", "post", "upper", "0 1 0", 0.0),
            link("upper", 0.1),
            joint("elbow", "upper", "lower", "0 1 0", 0.5),
            link("lower", 0.1),
            "</robot>".to_owned(),
        ]
        .concat();
        let robot =
            delmpc_robots::load_str("arm.urdf", &urdf, None, &delmpc_robots::LoadOptions::default()).unwrap();
        let hand = hand(&robot).unwrap();
        assert_eq!(hand.1, "lower");
        let posture = bolted(&robot, &hand).unwrap();
        let elbow = posture.q[robot.joint("elbow").unwrap()].abs();
        assert!((0.7..2.2).contains(&elbow), "{elbow}");
    }
}
