//! Outlines of legs: points of soles and shanks that keep clear of ground and obstacles.

use crate::error::PlanError;
use crate::robot::{BodyPoint, PlanRobot};

/// Points of an outline closer together than the thinnest obstacle: along the sole between two contact points of a body, and
/// along the shank, which is the link that carries it.
///
/// # Errors
/// None today; the signature leaves room for robots without soles.
pub fn leg_outline(
    robot: &PlanRobot,
    sole_points: usize,
    shank_points: usize,
) -> Result<Vec<BodyPoint>, PlanError> {
    let mut outline = Vec::new();
    let mut seen: Vec<usize> = Vec::new();
    for contact in &robot.contacts {
        if seen.contains(&contact.body) {
            continue;
        }
        seen.push(contact.body);
        let of_foot: Vec<&BodyPoint> =
            robot.contacts.iter().filter(|other| other.body == contact.body).collect();
        let (first, last) = (of_foot[0], of_foot[of_foot.len() - 1]);
        for k in 0..sole_points {
            let s = if sole_points > 1 { k as f64 / (sole_points - 1) as f64 } else { 0.5 };
            outline.push(BodyPoint {
                name: format!("{} sole {k}", robot.coordinates[contact.body]),
                body: contact.body,
                point: [0, 1, 2].map(|a| (1.0 - s) * first.point[a] + s * last.point[a]),
                radius: contact.radius,
            });
        }
        let foot = &robot.tree.bodies()[contact.body];
        if let Some(shank) = foot.parent {
            let ankle = foot.joint.placement.translation;
            for k in 0..shank_points {
                let s = k as f64 / shank_points as f64;
                outline.push(BodyPoint {
                    name: format!("{} {k}", robot.coordinates[shank]),
                    body: shank,
                    point: [0, 1, 2].map(|a| (1.0 - s) * ankle[a]),
                    radius: 0.0,
                });
            }
        }
    }
    Ok(outline)
}
