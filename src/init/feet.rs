//! Soles from shapes: the flat underside of the bodies on which a robot stands when all its joints are at zero.
//!
//! A foot is a body that carries no other body and reaches the ground. Its sole is the convex hull of the points of its shapes (collision
//! shapes, else those that are drawn) that are on the ground, with few corners, none of them outside the hull. A foot without a flat sole
//! stands on its [`Tip`].

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{Geometry, RobotModel, ShapeRole};
use nalgebra::{Matrix3, Vector2, Vector3};

use crate::init::tip::{Tip, tip};
use crate::mesh_file;

/// A body reaches the ground when its lowest point is within this part of the robot's height above the lowest of all.
const NEAR_GROUND: f64 = 0.06;
/// Heights above the lowest point that may belong to a sole, m: the first one that makes a surface of it is taken.
const SOLE_DEPTH_M: [f64; 5] = [5e-4, 2e-3, 5e-3, 1e-2, 1.5e-2];
/// The sole has at least this part of the rectangle around the foot.
const SOLE_PART: f64 = 0.4;
/// Corners of a sole are left out as long as it loses no more than this part of its area.
const LOST_AREA: f64 = 0.04;
const MOST_CORNERS: usize = 8;
/// Soles whose middles are nearer to their ankles than this part of their length say nothing of where the front is.
const NO_HEADING: f64 = 0.1;
/// Points around a round shape.
const AROUND: usize = 16;

/// Fewest feet without a flat sole that a robot can stand on.
const FEWEST_TIPS: usize = 3;

/// A foot: with a flat sole, or on a tip.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundFoot {
    /// `right`, `left`, or `foot` where there is one; `front_left` and so on where there are four.
    pub name: String,
    /// Link that carries it.
    pub link: String,
    /// The sole's frame in that link: origin in the middle of the sole, or where the tip touches the ground; x forward, z up.
    pub frame: RigidTransform,
    /// Corners in that frame, counter-clockwise from above, m; none of a tip.
    pub corners: Vec<Vector2<f64>>,
    /// The end of a foot without a flat sole, in the axes of that link.
    pub tip: Option<Tip>,
    /// What the corners come from, in words.
    pub from: &'static str,
}

/// Why there is no sole.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NoFeet {
    /// No body has shapes, and no mesh file was found.
    #[error(
        "no link has a shape whose file is there, so nothing says where the soles are: give <collision> boxes to the feet, or put the mesh files where the URDF names them"
    )]
    NoShapes,
    /// Feet without a flat sole, too few to stand on.
    #[error(
        "{count} feet without a flat sole ({links}): a robot stands on one flat sole, or on three tips and more"
    )]
    Points {
        /// How many.
        count: usize,
        /// Links that carry them.
        links: String,
    },
    /// The robot is fixed to the world, or stands on its root link.
    #[error("this robot has no feet: it is bolted down and needs no sole")]
    Fixed,
    /// The tree cannot be posed.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// The lowest points of a robot with all joints at zero, by body.
struct Cloud {
    body: usize,
    points_w: Vec<Vector3<f64>>,
    /// Centres and radii of round ends.
    spheres_w: Vec<Tip>,
    from: &'static str,
}

/// Finds the feet: right before left; of four, front before back and left before right.
///
/// # Errors
/// [`NoFeet`].
pub fn find_feet(robot: &RobotModel) -> Result<Vec<FoundFoot>, NoFeet> {
    if !robot.tree.is_floating() {
        return Err(NoFeet::Fixed);
    }
    let mut kinematics = Kinematics::new(&robot.tree);
    let zeros = vec![0.0; robot.joint_names.len()];
    // The base's link frame is at the origin, so z of the world is z of the root link.
    let base = delmpc_mechanics::kinematics::base_pose_from_link(&robot.tree, &RigidTransform::identity());
    kinematics.update_positions(&robot.tree, &Configuration::floating(base, &zeros))?;
    let poses = kinematics.link_poses_w();
    let carries = |body: usize| robot.tree.bodies().iter().any(|other| other.parent == Some(body));
    let first = robot.tree.first_joint_body();
    let leaves = (first..robot.tree.body_count()).filter(|body| !carries(*body));
    let clouds: Vec<Cloud> = leaves.filter_map(|body| cloud(robot, body, &poses[body])).collect();
    let heights = || clouds.iter().flat_map(|cloud| cloud.points_w.iter().map(|point| point.z));
    let lowest = heights().fold(f64::INFINITY, f64::min);
    let highest = poses.iter().map(|pose| pose.translation.z).chain(heights()).fold(lowest, f64::max);
    // An arm stands on its root link: nothing of it is lower, whatever shapes its other links lack.
    let root_points = cloud(robot, 0, &poses[0]).map(|root| root.points_w).unwrap_or_default();
    let root_lowest = root_points.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
    let on_root = root_lowest < lowest && poses.iter().all(|pose| pose.translation.z >= root_lowest);
    let centre = |body: usize| poses[body].transform_point(&robot.tree.bodies()[body].inertia.com).z;
    let is_lowest = (0..poses.len()).all(|body| centre(body) >= centre(0));
    // Or hangs on it: one limb that outweighs it.
    let leaves = (first..poses.len()).filter(|body| !carries(*body)).count();
    let is_limb = leaves == 1 && 2.0 * robot.tree.bodies()[0].inertia.mass < robot.tree.total_mass();
    if on_root || is_lowest || is_limb {
        return Err(NoFeet::Fixed);
    }
    if clouds.is_empty() {
        return Err(NoFeet::NoShapes);
    }
    let on_ground = |cloud: &&Cloud| {
        cloud.points_w.iter().any(|point| point.z - lowest <= NEAR_GROUND * (highest - lowest))
    };
    let standing: Vec<&Cloud> = clouds.iter().filter(on_ground).collect();
    // Small feet on a mesh are flat to a few millimetres, round as they are.
    let is_round = |cloud: &&Cloud| tip(&cloud.points_w, &cloud.spheres_w).radius > 0.0;
    if standing.len() >= FEWEST_TIPS && standing.iter().all(is_round) {
        return tips(robot, &standing, poses);
    }
    let soles: Vec<(&Cloud, Sole)> =
        standing.iter().filter_map(|cloud| Some((*cloud, sole(cloud)?))).collect();
    // Where most feet have no sole, the flat ones are so by chance.
    if soles.len() < FEWEST_TIPS.min(standing.len() - soles.len()) || soles.is_empty() {
        return tips(robot, &standing, poses);
    }
    // Toes are farther from the ankle than heels, and the sides of two feet cancel each other.
    let ahead: Vector2<f64> =
        soles.iter().map(|(cloud, sole)| sole.middle - poses[cloud.body].translation.xy()).sum();
    let long: f64 = soles.iter().map(|(_, sole)| sole.longest()).sum();
    let forward = heading(&ahead, NO_HEADING * long);
    let mut feet: Vec<(Vector2<f64>, FoundFoot)> = soles
        .iter()
        .filter_map(|(cloud, sole)| {
            Some((sole.middle, foot(robot, cloud, sole, &forward, &poses[cloud.body])?))
        })
        .collect();
    name_feet(&mut feet, &forward);
    Ok(feet.into_iter().map(|(_, foot)| foot).collect())
}

/// Feet that stand on their tips; x of the root link is forward.
fn tips(robot: &RobotModel, standing: &[&Cloud], poses: &[RigidTransform]) -> Result<Vec<FoundFoot>, NoFeet> {
    if standing.len() < FEWEST_TIPS {
        let links: Vec<&str> = standing.iter().map(|cloud| robot.body_names[cloud.body].as_str()).collect();
        return Err(NoFeet::Points { count: links.len(), links: links.join(", ") });
    }
    let of = |cloud: &&Cloud| {
        let tip_w = tip(&cloud.points_w, &cloud.spheres_w);
        let link = robot.body_names.get(cloud.body)?.clone();
        let link_w = poses[cloud.body] * robot.link(&link)?.pose;
        let in_link = Tip { centre: link_w.inverse().transform_point(&tip_w.centre), radius: tip_w.radius };
        let frame = link_w.inverse() * tip_w.touching();
        let (name, corners) = (String::new(), Vec::new());
        let foot = FoundFoot { name, link, frame, corners, tip: Some(in_link), from: cloud.from };
        Some((tip_w.centre.xy(), foot))
    };
    let mut feet: Vec<(Vector2<f64>, FoundFoot)> = standing.iter().filter_map(of).collect();
    name_feet(&mut feet, &Vector2::x());
    Ok(feet.into_iter().map(|(_, foot)| foot).collect())
}

/// Orders feet by where they are, and names them so.
fn name_feet(feet: &mut [(Vector2<f64>, FoundFoot)], forward: &Vector2<f64>) {
    let middle = feet.iter().map(|(place, _)| place).sum::<Vector2<f64>>() / feet.len().max(1) as f64;
    let ahead = |place: &Vector2<f64>| forward.dot(&(place - middle)) > 0.0;
    let left = |place: &Vector2<f64>| forward.perp(&(place - middle));
    feet.sort_by(|a, b| left(&a.0).total_cmp(&left(&b.0)));
    let count = feet.len();
    if count == 4 {
        // Front before back, and among those left before right.
        feet.sort_by_key(|(place, _)| (!ahead(place), left(place) <= 0.0));
    }
    let sides: Vec<(bool, bool)> = feet.iter().map(|(place, _)| (ahead(place), left(place) > 0.0)).collect();
    let on_four_sides = sides == [(true, true), (true, false), (false, true), (false, false)];
    for (index, (_, foot)) in feet.iter_mut().enumerate() {
        foot.name = match (count, index) {
            (1, _) => "foot".to_owned(),
            (2, 0) => "right".to_owned(),
            (2, _) => "left".to_owned(),
            _ if on_four_sides => ["front_left", "front_right", "back_left", "back_right"][index].to_owned(),
            _ => format!("foot_{index}"),
        };
    }
}

/// The axis of the root link nearest to a direction; x where it says little.
fn heading(ahead: &Vector2<f64>, little: f64) -> Vector2<f64> {
    if ahead.norm() < little {
        Vector2::x()
    } else if ahead.x.abs() >= ahead.y.abs() {
        Vector2::new(ahead.x.signum(), 0.0)
    } else {
        Vector2::new(0.0, ahead.y.signum())
    }
}

/// Points of the shapes of one body.
fn cloud(robot: &RobotModel, body: usize, pose_w: &RigidTransform) -> Option<Cloud> {
    let of = |role: ShapeRole| {
        let shapes = robot.shapes.iter().filter(|s| s.attachment.body == Some(body) && s.role == role);
        let mut points: Vec<Vector3<f64>> = shapes
            .flat_map(|shape| {
                let pose = *pose_w * shape.attachment.pose;
                underside(&shape.geometry, &pose)
            })
            .collect();
        let from_shapes = points.len();
        for mesh in robot.meshes.iter().filter(|m| m.attachment.body == Some(body) && m.role == role) {
            let triangles = mesh_file::read(robot, mesh).unwrap_or_default();
            points.extend(triangles.points.iter().map(|point| pose_w.transform_point(point)));
        }
        (points.len() > from_shapes, points)
    };
    let (mut meshes, mut points_w) = of(ShapeRole::Collision);
    let mut from = if meshes { "collision meshes" } else { "collision shapes" };
    let mut role = ShapeRole::Collision;
    if points_w.is_empty() {
        role = ShapeRole::Visual;
        (meshes, points_w) = of(role);
        from = if meshes { "drawn meshes" } else { "drawn shapes" };
    }
    let shapes = robot.shapes.iter().filter(|s| s.attachment.body == Some(body) && s.role == role);
    let spheres_w =
        shapes.flat_map(|shape| round_ends(&shape.geometry, &(*pose_w * shape.attachment.pose))).collect();
    (!points_w.is_empty()).then_some(Cloud { body, points_w, spheres_w, from })
}

/// Spheres of a primitive.
fn round_ends(geometry: &Geometry, pose_w: &RigidTransform) -> Vec<Tip> {
    match *geometry {
        Geometry::Sphere { radius } => vec![Tip { centre: pose_w.translation, radius }],
        Geometry::Capsule { radius, length } => [-0.5, 0.5]
            .map(|end| Tip { centre: pose_w.transform_point(&(end * length * Vector3::z())), radius })
            .to_vec(),
        _ => Vec::new(),
    }
}

/// Points of a primitive that can touch the ground below it.
fn underside(geometry: &Geometry, pose_w: &RigidTransform) -> Vec<Vector3<f64>> {
    let down = |centre: Vector3<f64>, radius: f64| centre - radius * Vector3::z();
    let ends = |length: f64| [-0.5, 0.5].map(|end| Vector3::new(0.0, 0.0, end * length));
    match *geometry {
        Geometry::Box { size } => {
            let sign = |corner: usize, bit: usize| if corner >> bit & 1 == 0 { -0.5 } else { 0.5 };
            let corner = |c: usize| Vector3::new(sign(c, 0), sign(c, 1), sign(c, 2)).component_mul(&size);
            (0..8).map(|index| pose_w.transform_point(&corner(index))).collect()
        }
        Geometry::Sphere { radius } => vec![down(pose_w.translation, radius)],
        Geometry::Capsule { radius, length } => {
            ends(length).map(|end| down(pose_w.transform_point(&end), radius)).to_vec()
        }
        Geometry::Cylinder { radius, length } => {
            let rim = |end: Vector3<f64>| {
                (0..AROUND).map(move |step| {
                    let angle = std::f64::consts::TAU * step as f64 / AROUND as f64;
                    end + radius * Vector3::new(angle.cos(), angle.sin(), 0.0)
                })
            };
            ends(length).into_iter().flat_map(rim).map(|point| pose_w.transform_point(&point)).collect()
        }
    }
}

/// The flat underside of a body, in the world.
struct Sole {
    corners: Vec<Vector2<f64>>,
    middle: Vector2<f64>,
    height: f64,
}

impl Sole {
    /// Distance of its farthest corners, m.
    fn longest(&self) -> f64 {
        let pairs = self.corners.iter().flat_map(|a| self.corners.iter().map(move |b| (a - b).norm()));
        pairs.fold(0.0, f64::max)
    }
}

fn sole(cloud: &Cloud) -> Option<Sole> {
    let height = cloud.points_w.iter().map(|point| point.z).fold(f64::INFINITY, f64::min);
    let within = |depth: f64| {
        let near = cloud.points_w.iter().filter(|point| point.z - height <= depth);
        hull(&near.map(Vector3::xy).collect::<Vec<_>>())
    };
    // What the foot covers up to a few centimetres above the ground.
    let around = within(0.03);
    let size = |axis: usize| {
        let values = || around.iter().map(|corner| corner[axis]);
        values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
    };
    let covered = size(0) * size(1);
    let mut soles = SOLE_DEPTH_M.iter().map(|depth| within(*depth));
    let sole = soles.find(|sole| sole.len() >= 3 && area(sole) >= SOLE_PART * covered)?;
    // A strip of a centimetre is an edge.
    if size(0).min(size(1)) < 0.01 {
        return None;
    }
    let corners = few_corners(sole);
    Some(Sole { middle: centroid(&corners), corners, height })
}

fn foot(
    robot: &RobotModel,
    cloud: &Cloud,
    sole: &Sole,
    forward: &Vector2<f64>,
    body_w: &RigidTransform,
) -> Option<FoundFoot> {
    let rotation = Matrix3::new(forward.x, -forward.y, 0.0, forward.y, forward.x, 0.0, 0.0, 0.0, 1.0);
    let translation = Vector3::new(sole.middle.x, sole.middle.y, sole.height);
    let frame_w = RigidTransform { rotation, translation };
    // The link that the body's joint carries.
    let link = robot.body_names.get(cloud.body)?.clone();
    let frame = (*body_w * robot.link(&link)?.pose).inverse() * frame_w;
    let turn = rotation.fixed_view::<2, 2>(0, 0).transpose();
    let corners = sole.corners.iter().map(|corner| turn * (corner - sole.middle)).collect();
    Some(FoundFoot { name: String::new(), link, frame, corners, tip: None, from: cloud.from })
}

/// Convex hull, counter-clockwise, without corners on its edges (Andrew's monotone chain). O(n log n).
pub fn hull(points: &[Vector2<f64>]) -> Vec<Vector2<f64>> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    sorted.dedup();
    if sorted.len() < 3 {
        return sorted;
    }
    let half = |points: &mut dyn Iterator<Item = &Vector2<f64>>| {
        let mut chain: Vec<Vector2<f64>> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..] {
                // A micrometre of a metre is straight.
                if (b - a).perp(&(point - b)) > 1e-9 {
                    break;
                }
                chain.pop();
            }
            chain.push(*point);
        }
        chain.pop();
        chain
    };
    let mut lower = half(&mut sorted.iter());
    lower.extend(half(&mut sorted.iter().rev()));
    lower
}

/// Leaves corners out, always the one that costs the least area, never so that the polygon grows.
fn few_corners(mut polygon: Vec<Vector2<f64>>) -> Vec<Vector2<f64>> {
    let whole = area(&polygon);
    while polygon.len() > 4 {
        let count = polygon.len();
        let lost = |i: usize| {
            let (before, after) = (polygon[(i + count - 1) % count], polygon[(i + 1) % count]);
            0.5 * (polygon[i] - before).perp(&(after - before)).abs()
        };
        let Some(least) = (0..count).min_by(|&a, &b| lost(a).total_cmp(&lost(b))) else { break };
        let left = area(&polygon) - lost(least);
        if count <= MOST_CORNERS && left < (1.0 - LOST_AREA) * whole {
            break;
        }
        polygon.remove(least);
    }
    polygon
}

/// Area of a counter-clockwise polygon, m².
pub fn area(polygon: &[Vector2<f64>]) -> f64 {
    let next = polygon.iter().cycle().skip(1);
    0.5 * polygon.iter().zip(next).map(|(a, b)| a.perp(b)).sum::<f64>()
}

/// Middle of the area of a counter-clockwise polygon.
pub fn centroid(polygon: &[Vector2<f64>]) -> Vector2<f64> {
    let next = polygon.iter().cycle().skip(1);
    let moment: Vector2<f64> = polygon.iter().zip(next).map(|(a, b)| (a + b) * a.perp(b)).sum();
    moment / (6.0 * area(polygon))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hull_has_the_corners_and_nothing_else() {
        let mut points: Vec<Vector2<f64>> =
            (0..50).map(|i| Vector2::new(f64::from(i % 7) / 6.0, f64::from(i % 5) / 4.0)).collect();
        points.push(Vector2::new(0.5, 0.5));
        let corners = hull(&points);
        assert_eq!(corners.len(), 4);
        assert!((area(&corners) - 1.0).abs() < 1e-12);
        assert!((centroid(&corners) - Vector2::new(0.5, 0.5)).norm() < 1e-12);
        assert!(hull(&points[..1]).len() < 3);
    }

    #[test]
    fn few_corners_stay_inside() {
        let round: Vec<Vector2<f64>> = (0..60)
            .map(|i| {
                let angle = std::f64::consts::TAU * f64::from(i) / 60.0;
                Vector2::new(0.1 * angle.cos(), 0.05 * angle.sin())
            })
            .collect();
        let few = few_corners(hull(&round));
        assert!(few.len() <= MOST_CORNERS && few.iter().all(|corner| round.contains(corner)));
        assert!(area(&few) > 0.85 * area(&round));
    }
}
