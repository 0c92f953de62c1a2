//! The end of a foot without a flat sole: a sphere among its shapes, else the one that fits the lowest points of its meshes.

use delmpc_mechanics::prelude::RigidTransform;
use nalgebra::{DMatrix, DVector, Vector2, Vector3};

/// A sphere that ends this much above the lowest point is the foot all the same: shanks are drawn into their feet, m.
const SUNK_M: f64 = 0.015;
/// Heights above the lowest point that may belong to the tip, m: the first ones that a sphere fits.
const DEPTH_M: [f64; 4] = [0.004, 0.008, 0.016, 0.03];
/// A sphere fits that is off by no more than this part of its radius (root mean square) ...
const FITS: f64 = 0.05;
/// ... and is no larger, m.
const LARGEST_M: f64 = 0.1;

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
    let fitted = DEPTH_M.iter().find_map(|depth| sphere(&near(*depth)).or_else(|| cylinder(&near(*depth))));
    fitted.unwrap_or(Tip { centre: lowest_point, radius: 0.0 })
}

/// The sphere through points: `|p|² = 2 c.p + k` in the least squares (Kåsa's fit).
fn sphere(points: &[Vector3<f64>]) -> Option<Tip> {
    let rows: Vec<Vec<f64>> = points.iter().map(|point| point.iter().copied().collect()).collect();
    let (centre, radius) = round(&rows)?;
    Some(Tip { centre: Vector3::new(centre[0], centre[1], centre[2]), radius })
}

/// The cylinder across the direction of walking.
fn cylinder(points: &[Vector3<f64>]) -> Option<Tip> {
    let rows: Vec<Vec<f64>> = points.iter().map(|point| vec![point.x, point.z]).collect();
    let (centre, radius) = round(&rows)?;
    let sides = points.iter().map(|point| point.y);
    let span = Vector2::new(sides.clone().fold(f64::INFINITY, f64::min), sides.fold(f64::NEG_INFINITY, f64::max));
    Some(Tip { centre: Vector3::new(centre[0], 0.5 * span.sum(), centre[1]), radius })
}

/// Centre and radius of a circle or sphere that fits, below its centre.
fn round(points: &[Vec<f64>]) -> Option<(Vec<f64>, f64)> {
    let (count, axes) = (points.len(), points.first()?.len());
    if count < 2 * axes + 2 {
        return None;
    }
    // About their middle, where the numbers are of the size of the foot.
    let middle: Vec<f64> =
        (0..axes).map(|axis| points.iter().map(|point| point[axis]).sum::<f64>() / count as f64).collect();
    let matrix = DMatrix::from_fn(count, axes + 1, |row, column| match column < axes {
        true => 2.0 * (points[row][column] - middle[column]),
        false => 1.0,
    });
    let squares = |point: &Vec<f64>| (0..axes).map(|axis| (point[axis] - middle[axis]).powi(2)).sum::<f64>();
    let right = DVector::from_iterator(count, points.iter().map(squares));
    let solved = matrix.svd(true, true).solve(&right, 1e-12).ok()?;
    let radius = (solved[axes] + (0..axes).map(|axis| solved[axis].powi(2)).sum::<f64>()).sqrt();
    let centre: Vec<f64> = (0..axes).map(|axis| solved[axis] + middle[axis]).collect();
    let off = |point: &Vec<f64>| {
        let distance = (0..axes).map(|axis| (point[axis] - centre[axis]).powi(2)).sum::<f64>().sqrt();
        (distance - radius).powi(2)
    };
    let error = (points.iter().map(off).sum::<f64>() / count as f64).sqrt();
    (radius.is_finite() && radius <= LARGEST_M && error <= FITS * radius && centre[axes - 1] > middle[axes - 1])
        .then_some((centre, radius))
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
        assert!((found.centre - centre).norm() < 1e-6 && (found.radius - 0.02).abs() < 1e-6, "{found:?}");
        assert!((found.touching().translation.z + 0.42).abs() < 1e-6);
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
