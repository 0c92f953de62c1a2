//! The pressure point and its distance from the edge of the sole.

use nalgebra::Vector2;

/// Vertical force below which a foot is in the air (N).
const IN_THE_AIR_N: f64 = 1.0;

/// Where the ground's force acts in the plane of the sole, from its torque about the sole's origin and its force, both in the axes of the
/// sole; `None` in the air.
pub fn pressure_point(torque_b: &[f64; 3], force_b: &[f64; 3]) -> Option<Vector2<f64>> {
    (force_b[2] > IN_THE_AIR_N).then(|| Vector2::new(-torque_b[1], torque_b[0]) / force_b[2])
}

/// Distance of a point from the nearest edge of a convex polygon given counter-clockwise; negative outside (m).
pub fn cop_margin_m(polygon: &[Vector2<f64>], point: &Vector2<f64>) -> f64 {
    let next = polygon.iter().cycle().skip(1);
    let margins = polygon.iter().zip(next).map(|(a, b)| {
        let edge = b - a;
        edge.perp(&(point - a)) / edge.norm()
    });
    margins.fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn margins_are_distances_to_edges() {
        let sole = [[-0.1, -0.05], [0.2, -0.05], [0.2, 0.05], [-0.1, 0.05]].map(Vector2::from);
        let margin = |x, y| cop_margin_m(&sole, &Vector2::new(x, y));
        assert!((margin(0.0, 0.0) - 0.05).abs() < 1e-12);
        assert!((margin(0.19, 0.0) - 0.01).abs() < 1e-12);
        assert!((margin(0.0, 0.06) + 0.01).abs() < 1e-12);
    }

    #[test]
    fn the_pressure_point_is_where_a_single_force_would_act() {
        // A force (0, 0, 10) at (0.1, 0.02, 0) has the torque (0.2, -1, 0).
        let point = pressure_point(&[0.2, -1.0, 0.0], &[0.0, 0.0, 10.0]).unwrap();
        assert!((point - Vector2::new(0.1, 0.02)).norm() < 1e-12);
        assert_eq!(pressure_point(&[0.0; 3], &[5.0, 0.0, 0.0]), None);
    }
}
