//! The motion of base, mass centre and joints as a plan has it: read at any time between its boundaries.
//!
//! ```text
//! c(t), q(t)   cubic Hermite polynomials of mass centre and joints with their velocities at both ends, error O(Δt⁴)
//! R(t) = R_a exp(r(t))   r: the same through 0 and log(R_aᵀ R_b), with the spins at both ends (body axes) as its rates
//! ```
//!
//! The rate of `r` is the spin but for a term of the order of `r` times it, which is small between two boundaries of a plan.

use alloc::vec::Vec;

use delmpc_mechanics::spatial::{exp_rotation, log_rotation};
use nalgebra::{Matrix3, Vector3};

use crate::hermite::Hermite;

/// Base, mass centre and joints at a boundary of the plan.
#[derive(Clone, Debug, PartialEq)]
pub struct BaseNode {
    /// Time, s.
    pub time_s: f64,
    /// Mass centre, m.
    pub mass_centre_w: Vector3<f64>,
    /// Its velocity, m/s.
    pub mass_centre_velocity_w: Vector3<f64>,
    /// Orientation of the base, from its axes to those of the world.
    pub orientation: Matrix3<f64>,
    /// Angular velocity of the base in its axes, rad/s.
    pub spin_b: Vector3<f64>,
    /// Joints, rad or m, in the order of the robot.
    pub q: Vec<f64>,
    /// Their velocities, rad/s or m/s.
    pub rate: Vec<f64>,
}

/// Base and mass centre at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BasePoint {
    /// Place, velocity and acceleration of the mass centre, m.
    pub mass_centre_w: [Vector3<f64>; 3],
    /// Orientation of the base.
    pub orientation: Matrix3<f64>,
    /// Angular velocity in its axes, rad/s.
    pub spin_b: Vector3<f64>,
}

/// The motion; at rest before and after.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedBase {
    nodes: Vec<BaseNode>,
}

impl PlannedBase {
    /// Of two or more boundaries whose times rise, with as many joints each; `None` else.
    pub fn new(nodes: Vec<BaseNode>) -> Option<Self> {
        let rises = nodes.windows(2).all(|pair| pair[1].time_s - pair[0].time_s > 1e-6);
        let joints = nodes.first().map_or(0, |node| node.q.len());
        let fits = nodes.iter().all(|node| node.q.len() == joints && node.rate.len() == joints);
        (nodes.len() >= 2 && rises && fits).then_some(Self { nodes })
    }

    /// The first boundary.
    pub fn begin(&self) -> &BaseNode {
        &self.nodes[0]
    }

    /// The last boundary.
    pub fn end(&self) -> &BaseNode {
        &self.nodes[self.nodes.len() - 1]
    }

    /// Base and mass centre at a time (s). No allocation.
    pub fn at(&self, time_s: f64) -> BasePoint {
        let resting = |node: &BaseNode| BasePoint {
            mass_centre_w: [node.mass_centre_w, Vector3::zeros(), Vector3::zeros()],
            orientation: node.orientation,
            spin_b: Vector3::zeros(),
        };
        let (a, b) = match self.between(time_s) {
            Between::Rest(node) => return resting(node),
            Between::Nodes(a, b) => (a, b),
        };
        let cubic = a.cubic_to(b, time_s);
        let still = Vector3::zeros();
        let turn = log_rotation(&a.orientation.tr_mul(&b.orientation));
        let (turning, way) = (((still, a.spin_b), (turn, b.spin_b)), (a.way(), b.way()));
        BasePoint {
            mass_centre_w: [cubic.value(way), cubic.rate(way), cubic.change(way)],
            orientation: a.orientation * exp_rotation(&cubic.value(turning)),
            spin_b: cubic.rate(turning),
        }
    }
}

/// What a time lies between.
enum Between<'a> {
    /// Before the first boundary or after the last one.
    Rest(&'a BaseNode),
    /// Two boundaries.
    Nodes(&'a BaseNode, &'a BaseNode),
}

impl PlannedBase {
    fn between(&self, time_s: f64) -> Between<'_> {
        let after = self.nodes.partition_point(|node| node.time_s <= time_s);
        match (after.checked_sub(1).map(|k| &self.nodes[k]), self.nodes.get(after)) {
            (Some(a), Some(b)) => Between::Nodes(a, b),
            (None, _) => Between::Rest(self.begin()),
            _ => Between::Rest(self.end()),
        }
    }

    /// The joints at a time (s). No allocation.
    pub fn joints_at(&self, time_s: f64, q: &mut [f64]) {
        match self.between(time_s) {
            Between::Rest(node) => q.copy_from_slice(&node.q),
            Between::Nodes(a, b) => {
                let cubic = a.cubic_to(b, time_s);
                for (j, q) in q.iter_mut().enumerate() {
                    *q = cubic.value(((a.q[j], a.rate[j]), (b.q[j], b.rate[j])));
                }
            }
        }
    }
}

impl BaseNode {
    fn way(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.mass_centre_w, self.mass_centre_velocity_w)
    }

    fn cubic_to(&self, next: &Self, time_s: f64) -> Hermite {
        let length = next.time_s - self.time_s;
        Hermite::new((time_s - self.time_s) / length, length)
    }
}

#[cfg(test)]
mod tests {
    use alloc::vec;

    use super::*;

    fn node(t: f64) -> BaseNode {
        let axis = Vector3::new(0.1, -0.2, 0.3);
        BaseNode {
            time_s: t,
            mass_centre_w: Vector3::new(t * t * t, 1.0 - t, 0.2),
            mass_centre_velocity_w: Vector3::new(3.0 * t * t, -1.0, 0.0),
            orientation: exp_rotation(&(axis * t)),
            spin_b: axis,
            q: vec![t * t, 1.0],
            rate: vec![2.0 * t, 0.0],
        }
    }

    #[test]
    fn a_cubic_way_and_an_even_turn_are_followed_exactly() {
        let planned = PlannedBase::new(vec![node(1.0), node(1.3), node(2.0)]).unwrap();
        for t in [1.0, 1.1, 1.3, 1.77] {
            let (point, exact) = (planned.at(t), node(t));
            let [place, velocity, acceleration] = point.mass_centre_w;
            assert!((place - exact.mass_centre_w).norm() < 1e-14, "{t}");
            assert!((velocity - exact.mass_centre_velocity_w).norm() < 1e-13, "{t}");
            assert!((acceleration - Vector3::new(6.0 * t, 0.0, 0.0)).norm() < 1e-12, "{t}");
            assert!((point.orientation - exact.orientation).norm() < 1e-14, "{t}");
            assert!((point.spin_b - exact.spin_b).norm() < 1e-13, "{t}");
            let mut q = [0.0; 2];
            planned.joints_at(t, &mut q);
            assert!((q[0] - t * t).abs() < 1e-14 && (q[1] - 1.0).abs() < 1e-14, "{t}");
        }
    }

    #[test]
    fn it_rests_before_and_after_and_times_rise() {
        let planned = PlannedBase::new(vec![node(1.0), node(2.0)]).unwrap();
        for (t, end) in [(0.0, 1.0), (2.5, 2.0)] {
            let point = planned.at(t);
            assert_eq!(point.mass_centre_w, [node(end).mass_centre_w, Vector3::zeros(), Vector3::zeros()]);
            assert_eq!(point.spin_b, Vector3::zeros());
        }
        assert!(PlannedBase::new(vec![node(1.0)]).is_none());
        assert!(PlannedBase::new(vec![node(1.0), node(1.0)]).is_none());
    }
}
