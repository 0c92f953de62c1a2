//! How the feet share a wrench: the least weighted contact forces that give it.
//!
//! ```text
//! min Σ_i f_i² / w_i     s.t.   A f = b        f = W Aᵀ (A W Aᵀ + ε 1)⁻¹ b
//! ```
//!
//! `b` is torque about the mass centre and force, what carries and accelerates the robot; rows of `f` are those of the contacts along
//! their ground axes. Normal forces are cheap, tangential ones and torques of a sole dear, so the load goes where the pressure point
//! asks for it. `ε` stands for what two points cannot give.
//!
//! Source: own formulation; the weighted pseudo-inverse: A. Ben-Israel, T. Greville, *Generalized Inverses*, 2003.

use delmpc_mechanics::contact_stage::ContactKind;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Weight of tangential forces against normal ones.
const TANGENTIAL: f64 = 0.3;
/// Weight of the torques of a sole, as a square of a lever (m²), about its tangential axes and its normal.
const SOLE: [f64; 3] = [3e-4, 3e-4, 3e-5];
/// Regularisation.
const EPSILON: f64 = 1e-7;

/// A foot that shares.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Share {
    /// Point or flat.
    pub kind: ContactKind,
    /// The sole's origin, m.
    pub position_w: Vector3<f64>,
    /// Ground axes (columns).
    pub axes_w: Matrix3<f64>,
    /// Part of a full foot, 0 to 1.
    pub part: f64,
}

impl Share {
    /// Torque about `centre_w` and force of a unit of row `row`, and the row's weight.
    fn column(&self, row: usize, centre_w: &Vector3<f64>) -> (Vector6<f64>, f64) {
        let offset = if self.kind == ContactKind::Foot { 3 } else { 0 };
        let join = |torque: Vector3<f64>, force: Vector3<f64>| {
            Vector6::new(torque.x, torque.y, torque.z, force.x, force.y, force.z)
        };
        if row < offset {
            return (join(self.axes_w.column(row).into(), Vector3::zeros()), SOLE[row] * self.part);
        }
        let axis: Vector3<f64> = self.axes_w.column(row - offset).into();
        let weight = if row - offset == 2 { 1.0 } else { TANGENTIAL };
        (join((self.position_w - centre_w).cross(&axis), axis), weight * self.part)
    }
}

/// Forces of all `shares`, row after row, that give `wrench` (torque about `centre_w`, then force). A `None` has no force: its rows,
/// as many as in `rows`, are zero.
pub fn share_load(
    shares: &[Option<Share>],
    rows: &[usize],
    centre_w: &Vector3<f64>,
    wrench: &Vector6<f64>,
    force: &mut [f64],
) {
    let mut matrix = Matrix6::zeros();
    for share in shares.iter().flatten() {
        for row in 0..share.kind.rows() {
            let (column, weight) = share.column(row, centre_w);
            matrix += column * column.transpose() * weight;
        }
    }
    let epsilon = EPSILON * matrix.trace() + f64::MIN_POSITIVE;
    for k in 0..6 {
        matrix[(k, k)] += epsilon;
    }
    let multipliers = matrix.try_inverse().map_or_else(Vector6::zeros, |inverse| inverse * wrench);
    let mut at = 0;
    for (share, rows) in shares.iter().zip(rows) {
        for row in 0..*rows {
            force[at] = share.as_ref().map_or(0.0, |share| {
                let (column, weight) = share.column(row, centre_w);
                weight * column.dot(&multipliers)
            });
            at += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn foot(kind: ContactKind, x: f64, y: f64) -> Option<Share> {
        Some(Share { kind, position_w: Vector3::new(x, y, 0.0), axes_w: Matrix3::identity(), part: 1.0 })
    }

    #[test]
    fn the_forces_give_the_wrench() {
        let centre = Vector3::new(0.02, 0.03, 0.9);
        let weight = Vector6::new(0.0, 0.0, 0.0, 30.0, -10.0, 1000.0);
        let shares = [foot(ContactKind::Foot, 0.0, 0.1), foot(ContactKind::Foot, 0.05, -0.1)];
        let mut force = [0.0; 12];
        share_load(&shares, &[6, 6], &centre, &weight, &mut force);
        let mut sum = Vector6::zeros();
        for (k, share) in shares.iter().flatten().enumerate() {
            for row in 0..6 {
                sum += share.column(row, &centre).0 * force[6 * k + row];
            }
        }
        assert!((sum - weight).norm() < 1e-2 * weight.norm(), "{sum}");
        assert!(force[5] > 0.0 && force[11] > 0.0);
    }

    #[test]
    fn the_nearer_foot_carries_more_and_one_in_the_air_nothing() {
        let weight = Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 100.0);
        let point = |x, y| foot(ContactKind::Point, x, y);
        let shares = [point(0.2, 0.1), None, point(-0.2, -0.1), point(0.2, -0.1)];
        let mut force = [1.0; 12];
        share_load(&shares, &[3; 4], &Vector3::new(0.05, -0.02, 0.15), &weight, &mut force);
        assert_eq!(force[3..6], [0.0; 3]);
        let total: f64 = force.chunks(3).map(|f| f[2]).sum();
        assert!((total - 100.0).abs() < 0.1, "{total}");
        // In the middle between two points each carries a half.
        share_load(
            &[point(0.2, 0.1), None, point(-0.2, -0.1), None],
            &[3; 4],
            &Vector3::new(0.0, 0.0, 0.15),
            &weight,
            &mut force,
        );
        assert!((force[2] - 50.0).abs() < 0.1 && (force[8] - 50.0).abs() < 0.1);
    }
}
