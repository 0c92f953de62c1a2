//! The end of a foot without a flat sole: a sphere among its shapes, else the round one that fits the lowest points of its meshes.

use delmpc_mechanics::prelude::RigidTransform;
use nalgebra::{Matrix3, Vector2, Vector3};

use crate::init::feet::hull;

/// A sphere that ends this much above the lowest point is the foot all the same: shanks are drawn into their feet, m.
const SUNK_M: f64 = 0.015;
/// Heights above the lowest point that may belong to the tip, m: the first ones that a sphere fits.
const DEPTH_M: [f64; 4] = [0.004, 0.008, 0.016, 0.03];
/// A circle fits that is off by no more than this part of its radius (root mean square) ...
const FITS: f64 = 0.05;
/// ... and is no larger, m.
const LARGEST_M: f64 = 0.1;
/// Fewer points of an outline are corners, not a circle.
const FEWEST_POINTS: usize = 5;

/// A sphere that touches the ground; a point where the radius is 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tip {
    /// Centre, m.
    pub centre: Vector3<f64>,
    /// Radius, m.
    pub radius: f64,
}

impl Tip {
    /// Where it touches level ground, with the axes of the world it is given in.
    pub fn touching(&self) -> RigidTransform {
        RigidTransform::from_translation(self.centre - self.radius * Vector3::z())
    }

    fn bottom(&self) -> f64 {
        self.centre.z - self.radius
    }
}

/// The lowest sphere, the sphere or lateral cylinder that fits the lowest points, or else the lowest point itself.
pub fn tip(points_w: &[Vector3<f64>], spheres_w: &[Tip]) -> Tip {
    let lowest_point = points_w.iter().min_by(|a, b| a.z.total_cmp(&b.z)).copied().unwrap_or_default();
    let lowest = spheres_w.iter().min_by(|a, b| a.bottom().total_cmp(&b.bottom()));
    if let Some(sphere) = lowest.filter(|sphere| sphere.bottom() - lowest_point.z <= SUNK_M) {
        return *sphere;
    }
    let near = |depth: f64| -> Vec<Vector3<f64>> {
        points_w.iter().filter(|point| point.z - lowest_point.z <= depth).copied().collect()
    };
    let fitted = DEPTH_M.iter().find_map(|depth| round(&near(*depth)));
    fitted.unwrap_or(Tip { centre: lowest_point, radius: 0.0 })
}

/// The sphere, or the cylinder across the direction of walking, whose outline from the side is that of the points. Of the points only the
/// outline counts: feet have rounded edges.
fn round(points: &[Vector3<f64>]) -> Option<Tip> {
    let outline = hull(&points.iter().map(Vector3::xz).collect::<Vec<_>>());
    // Not the chord above.
    let top = outline.iter().map(|point| point.y).fold(f64::NEG_INFINITY, f64::max);
    let bottom = outline.iter().map(|point| point.y).fold(f64::INFINITY, f64::min);
    let below: Vec<Vector2<f64>> =
        outline.into_iter().filter(|point| point.y <= bottom + 0.999 * (top - bottom)).collect();
    let (centre, radius) = circle(&below)?;
    let sides = || points.iter().map(|point| point.y);
    let middle = 0.5 * (sides().fold(f64::INFINITY, f64::min) + sides().fold(f64::NEG_INFINITY, f64::max));
    Some(Tip { centre: Vector3::new(centre.x, middle, centre.y), radius })
}

/// Centre and radius of the circle through points, `|p|² = 2 c.p + k` in the least squares (Kåsa's fit), if it fits.
fn circle(points: &[Vector2<f64>]) -> Option<(Vector2<f64>, f64)> {
    if points.len() < FEWEST_POINTS {
        return None;
    }
    // About their middle, where the numbers are of the size of the foot.
    let middle = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for point in points.iter().map(|point| point - middle) {
        let row = (2.0 * point).push(1.0);
        normal += row * row.transpose();
        right += row * point.norm_squared();
    }
    let solved = normal.lu().solve(&right)?;
    let centre = solved.xy() + middle;
    let radius = (solved.z + solved.xy().norm_squared()).sqrt();
    let square = |point: &Vector2<f64>| ((point - centre).norm() - radius).powi(2);
    let error = (points.iter().map(square).sum::<f64>() / points.len() as f64).sqrt();
    let fits = radius <= LARGEST_M && error <= FITS * radius && centre.y > middle.y;
    fits.then_some((centre, radius))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball(radius: f64, centre: Vector3<f64>) -> Vec<Vector3<f64>> {
        let at = |i: u32, j: u32| {
            let (a, b) = (0.3 * f64::from(i), std::f64::consts::PI * f64::from(j) / 20.0);
            centre + radius * Vector3::new(b.sin() * a.cos(), b.sin() * a.sin(), -b.cos())
        };
        (0..21).flat_map(|i| (0..21).map(move |j| at(i, j))).collect()
    }

    #[test]
    fn a_sphere_is_found_in_its_mesh() {
        let centre = Vector3::new(0.2, -0.1, -0.4);
        let found = tip(&ball(0.02, centre), &[]);
        // From the side the facets, 0.3 rad wide, are up to r (1 - cos 0.15) within the sphere.
        let sag = 0.02 * (1.0 - 0.15_f64.cos());
        assert!((found.centre - centre).norm() < sag && (found.radius - 0.02).abs() < sag, "{found:?}");
        assert!((found.touching().translation.z + 0.42).abs() < sag);
    }

    #[test]
    fn a_wheel_across_is_found_too() {
        let rim = |i: u32, y: f64| {
            let angle = 0.1 * f64::from(i);
            Vector3::new(0.03 * angle.cos(), y, 0.5 + 0.03 * angle.sin())
        };
        let points: Vec<_> = (0..63).flat_map(|i| [-0.02, 0.0, 0.02].map(|y| rim(i, y))).collect();
        let found = tip(&points, &[]);
        assert!((found.centre - Vector3::new(0.0, 0.0, 0.5)).norm() < 1e-3, "{found:?}");
        assert!((found.radius - 0.03).abs() < 1e-3);
    }

    #[test]
    fn a_sphere_among_the_shapes_wins_over_the_shank_drawn_into_it() {
        let sphere = Tip { centre: Vector3::new(0.0, 0.0, 0.03), radius: 0.02 };
        assert_eq!(tip(&[Vector3::zeros()], &[sphere]), sphere);
        let high = Tip { centre: Vector3::new(0.0, 0.0, 0.1), radius: 0.02 };
        assert_eq!(tip(&[Vector3::zeros()], &[high]).radius, 0.0);
    }
}
