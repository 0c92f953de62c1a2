//! The ground under the feet against that of the plan: a plane, by the feet that stand on it.
//!
//! A plan has heights of footholds; the estimate of the base drifts, its vertical is off by a milliradian, the ground leans. What counts
//! is the ground under the feet now: the next foothold is as high above it as planned above level ground, it leans as the ground does,
//! and the mass centre is as high above it.
//!
//! ```text
//! z(x, y) = z_plan + o + g·((x, y) - c)        c, o: middle of the feet that stand, and their mean height beyond the plan's
//! ```
//!
//! The gradient `g` is that of flat soles, or of the plane through the last places of three feet and more.

use alloc::vec;
use alloc::vec::Vec;

use nalgebra::{Matrix2, Vector2, Vector3};

use crate::contact_schedule::{ContactSchedule, FootPhase, Foothold};
use crate::legged_model::axes_on;
use crate::retiming::FootState;

/// Time in which a new ground is believed, s.
const BELIEVED_S: f64 = 0.1;
/// The same of how it leans, s: a sole rocks when it lands.
const LEAN_BELIEVED_S: f64 = 1.0;
/// Steepest gradient that is believed.
const STEEPEST: f64 = 0.5;
/// Least spread of the feet for a plane through them, m.
const LEAST_SPREAD_M: f64 = 0.02;

/// The plane.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundPlane {
    /// Planned height of the foothold a foot is on, or swings to.
    planned: Vec<f64>,
    swinging: Vec<bool>,
    /// Where every foot stood last.
    places: Vec<Vector3<f64>>,
    flat: Vec<bool>,
    middle: Vector2<f64>,
    offset_m: f64,
    gradient: Vector2<f64>,
}

impl GroundPlane {
    /// For feet that stand at `places`, on ground that was planned to be level at height 0; `flat` of every foot.
    pub fn new(places: &[Foothold], flat: &[bool]) -> Self {
        let count = places.len().max(1) as f64;
        let mut plane = Self {
            planned: vec![0.0; places.len()],
            swinging: vec![false; places.len()],
            places: places.iter().map(|place| place.position_w).collect(),
            flat: flat.to_vec(),
            middle: places.iter().map(|place| place.position_w.xy()).sum::<Vector2<f64>>() / count,
            offset_m: places.iter().map(|place| place.position_w.z).sum::<f64>() / count,
            gradient: Vector2::zeros(),
        };
        let flat = places.iter().zip(flat).filter(|(_, flat)| **flat);
        let normal: Vector3<f64> = flat.map(|(place, _)| place.axes_w.column(2).into_owned()).sum();
        plane.gradient = plane.gradient_of(&normal).unwrap_or_default();
        plane
    }

    /// By the normals of flat soles, else by the places of the feet.
    fn gradient_of(&self, normal: &Vector3<f64>) -> Option<Vector2<f64>> {
        let gradient = match normal.z > 0.0 {
            true => Some(-normal.xy() / normal.z),
            false => self.gradient_of_places(),
        };
        gradient.filter(|gradient| gradient.norm() < STEEPEST)
    }

    /// How much higher the ground is at a place than planned, m.
    pub fn offset_m(&self, place: &Vector2<f64>) -> f64 {
        self.offset_m + self.gradient.dot(&(place - self.middle))
    }

    /// Its gradient.
    pub fn gradient(&self) -> &Vector2<f64> {
        &self.gradient
    }

    /// Takes in where the feet are at `now_s`, `period_s` after the last time, and moves the footholds of those that lift off.
    pub fn update(&mut self, schedule: &mut ContactSchedule, feet: &[FootState], now_s: f64, period_s: f64) {
        let share = (period_s / BELIEVED_S).min(1.0);
        let (mut normal, mut middle, mut above, mut count) = (Vector3::zeros(), Vector2::zeros(), 0.0, 0.0);
        for (k, foot) in feet.iter().enumerate() {
            if foot.loaded && schedule.stands(k, now_s) {
                self.places[k] = foot.place.position_w;
                middle += foot.place.position_w.xy();
                above += foot.place.position_w.z - self.planned[k];
                count += 1.0;
                if self.flat[k] {
                    normal += foot.place.axes_w.column(2);
                }
            }
        }
        if count > 0.0 {
            if let Some(gradient) = self.gradient_of(&normal) {
                self.gradient += (gradient - self.gradient) * (period_s / LEAN_BELIEVED_S).min(1.0);
            }
            let (middle, above) = (middle / count, above / count);
            // The same plane, told from another middle.
            let there = self.offset_m(&middle);
            (self.middle, self.offset_m) = (middle, there + (above - there) * share);
        }
        for k in 0..self.planned.len() {
            let FootPhase::Swing(swing) = schedule.phase(k, now_s) else {
                self.swinging[k] = false;
                continue;
            };
            if !core::mem::replace(&mut self.swinging[k], true) {
                self.planned[k] = swing.to.position_w.z;
                schedule.aim(k, now_s, self.on_ground(&swing.to));
            }
        }
    }

    /// A foothold that was planned on level ground.
    pub fn on_ground(&self, planned: &Foothold) -> Foothold {
        let mut position_w = planned.position_w;
        position_w.z += self.offset_m(&position_w.xy());
        let normal = Vector3::new(-self.gradient.x, -self.gradient.y, 1.0);
        Foothold { position_w, axes_w: axes_on(&normal, &planned.axes_w.column(0).into()) }
    }

    /// Of the plane nearest to the last places of the feet, relative to the planned heights; none for feet on a line.
    fn gradient_of_places(&self) -> Option<Vector2<f64>> {
        let count = self.places.len() as f64;
        let middle = self.places.iter().map(|place| place.xy()).sum::<Vector2<f64>>() / count;
        let above = |k: usize| self.places[k].z - self.planned[k];
        let mean = (0..self.places.len()).map(above).sum::<f64>() / count;
        let (mut matrix, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for k in 0..self.places.len() {
            let arm = self.places[k].xy() - middle;
            matrix += arm * arm.transpose();
            right += arm * (above(k) - mean);
        }
        let least = count * LEAST_SPREAD_M * LEAST_SPREAD_M;
        (matrix.determinant() > least * least).then(|| matrix.try_inverse().map(|inverse| inverse * right))?
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64, z: f64) -> Foothold {
        Foothold::level(Vector3::new(x, y, z), 0.0)
    }

    #[test]
    fn the_next_foothold_is_as_much_higher_as_planned() {
        let places = [at(0.0, 0.1, 0.0), at(0.0, -0.1, 0.0)];
        let mut schedule = ContactSchedule::standing(&places, 4);
        schedule.step(0, 1.0, 1.5, at(0.3, 0.1, 0.05));
        let mut ground = GroundPlane::new(&places, &[true, true]);
        // Ground that leans by a tenth ahead and is a centimetre higher.
        let axes_w = axes_on(&Vector3::new(-0.1, 0.0, 1.0), &Vector3::x());
        let feet = [0.1, -0.1].map(|y| FootState {
            loaded: true,
            place: Foothold { position_w: Vector3::new(0.0, y, 0.01), axes_w },
        });
        for k in 0..2000 {
            ground.update(&mut schedule, &feet, 4e-4 * f64::from(k), 0.005);
        }
        assert!((ground.gradient() - Vector2::new(0.1, 0.0)).norm() < 1e-3);
        ground.update(&mut schedule, &feet, 1.0, 0.005);
        let FootPhase::Swing(swing) = schedule.phase(0, 1.0) else { panic!("stands") };
        assert!((swing.to.position_w.z - 0.09).abs() < 1e-3, "{}", swing.to.position_w.z);
        assert!((swing.to.axes_w.column(2) - axes_w.column(2)).norm() < 1e-3);
        ground.update(&mut schedule, &feet, 1.005, 0.005);
        let FootPhase::Swing(again) = schedule.phase(0, 1.1) else { panic!("stands") };
        assert_eq!(again.to, swing.to);
    }

    #[test]
    fn points_give_a_plane_by_their_places() {
        let corners = [(0.1, 0.1), (0.1, -0.1), (-0.1, 0.1), (-0.1, -0.1)];
        let places = corners.map(|(x, y)| at(x, y, 0.0));
        let mut schedule = ContactSchedule::standing(&places, 4);
        let mut ground = GroundPlane::new(&places, &[false; 4]);
        let feet =
            corners.map(|(x, y)| FootState { loaded: true, place: at(x, y, 0.2 * x - 0.1 * y + 0.03) });
        for k in 0..2000 {
            ground.update(&mut schedule, &feet, 4e-4 * f64::from(k), 0.005);
        }
        assert!((ground.gradient() - Vector2::new(0.2, -0.1)).norm() < 1e-3);
        assert!((ground.offset_m(&Vector2::new(0.1, 0.0)) - 0.05).abs() < 1e-3);
    }
}
