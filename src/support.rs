//! What a robot stands on: the hull of its stance feet, and where its mass centre is over it.

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_robots::{RobotModel, Sole};
use nalgebra::{Vector2, Vector3};

use crate::init::feet::hull;

/// The support of a posture, in axes with z up whose x axis points where that of the first sole does; origin at that sole's.
#[derive(Debug, Clone, PartialEq)]
pub struct Support {
    /// Corners, counter-clockwise from above, m.
    pub polygon: Vec<Vector2<f64>>,
    /// The mass centre, its height above the ground, m.
    pub com: Vector3<f64>,
}

impl Support {
    /// Of a robot on these soles in one of its postures; `None` without such a posture or sole, or for a robot that is fixed to the world.
    pub fn new(robot: &RobotModel, posture: &str, soles: &[String]) -> Option<Self> {
        let posture = robot.posture(posture)?;
        let base = robot.base_pose_w(posture)?;
        let mut kinematics = Kinematics::new(&robot.tree);
        kinematics.update_positions(&robot.tree, &Configuration::floating(base, &posture.q)).ok()?;
        let soles: Vec<&Sole> = soles.iter().filter_map(|name| robot.sole(name)).collect();
        let first = robot.frame(&soles.first()?.frame)?;
        let first_w = kinematics.link_poses_w()[first.body?] * first.pose;
        let ahead = first_w.rotation.column(0).xy().try_normalize(1e-9)?;
        let to_stance = |point: &Vector3<f64>| {
            let way = point - first_w.translation;
            Vector3::new(ahead.dot(&way.xy()), ahead.perp(&way.xy()), way.z)
        };
        let corner = |index: &usize| -> Option<Vector2<f64>> {
            let contact = robot.contacts.get(*index)?;
            let place = kinematics.link_poses_w()[contact.body?].transform_point(&contact.position);
            Some(to_stance(&place).xy())
        };
        let corners: Vec<Vector2<f64>> =
            soles.iter().flat_map(|sole| sole.contacts.iter().filter_map(corner)).collect();
        let com = to_stance(&kinematics.mass_centre_of_tree_w(&robot.tree));
        Some(Self { polygon: hull(&corners), com })
    }

    /// Distance of the mass centre from the edge in a direction, m; `None` when it is outside.
    pub fn reach(&self, direction: Vector2<f64>) -> Option<f64> {
        let corners = self.polygon.iter().zip(self.polygon.iter().cycle().skip(1));
        let distances = corners.filter_map(|(a, b)| {
            let outward = Vector2::new(b.y - a.y, a.x - b.x);
            let speed = outward.dot(&direction);
            (speed > 1e-12).then(|| outward.dot(&(a - self.com.xy())) / speed)
        });
        distances.min_by(f64::total_cmp).filter(|distance| *distance > 0.0)
    }

    /// Impulse (N s) after which the capture point of an inverted pendulum is at the edge.
    pub fn capture_limit(&self, robot: &RobotModel, direction: Vector2<f64>) -> Option<f64> {
        let frequency = (robot.tree.gravity_w().norm() / self.com.z).sqrt();
        let limit = robot.tree.total_mass() * frequency * self.reach(direction)?;
        limit.is_finite().then_some(limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_to_the_edge_is_along_the_direction() {
        let sole: Vec<Vector2<f64>> = [(0.1, -0.05), (0.1, 0.05), (-0.1, 0.05), (-0.1, -0.05)]
            .map(|(x, y)| Vector2::new(x, y))
            .to_vec();
        let support = Support { polygon: sole, com: Vector3::new(0.02, 0.01, 1.0) };
        let distance = |x: f64, y: f64| support.reach(Vector2::new(x, y)).unwrap();
        assert!((distance(1.0, 0.0) - 0.08).abs() < 1e-12);
        assert!((distance(0.0, -1.0) - 0.06).abs() < 1e-12);
        assert!((distance(-1.0, 0.0) - 0.12).abs() < 1e-12);
        let diagonal = distance(0.5_f64.sqrt(), 0.5_f64.sqrt());
        assert!((diagonal - 0.04 * 2.0_f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn the_support_of_several_feet_is_their_hull() {
        let robots = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/robots");
        let dog = delmpc_robots::load(robots.join("littledog.urdf")).unwrap();
        let names: Vec<String> = dog.soles.iter().map(|sole| sole.name.clone()).collect();
        let support = Support::new(&dog, "stand", &names).unwrap();
        assert_eq!(support.polygon.len(), 4);
        // The mass centre is over the middle of the feet.
        let (ahead, back) = (support.reach(Vector2::x()).unwrap(), support.reach(-Vector2::x()).unwrap());
        assert!((ahead - back).abs() < 0.02 * ahead, "{ahead} {back}");
        assert!((0.1..0.2).contains(&support.com.z));
        assert!(Support::new(&dog, "stand", &["tail".to_owned()]).is_none());
    }
}
