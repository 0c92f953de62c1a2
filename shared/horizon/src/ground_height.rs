//! How far the ground is from where it was planned to be, by the feet that stand on it.
//!
//! A plan has heights of footholds; the estimate of the base drifts, its vertical is off by a milliradian, the ground is not level. What
//! counts is the ground under the feet now: the next foothold is as much higher than the last one as planned, and the mass centre is as
//! high above the feet.

use alloc::vec;
use alloc::vec::Vec;

use crate::contact_schedule::{ContactSchedule, FootPhase};
use crate::retiming::FootState;

/// Time in which a new height is believed, s.
const BELIEVED_S: f64 = 0.1;

/// The height of the ground against that of the plan.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundHeight {
    /// Planned height of the foothold a foot is on, or swings to.
    planned: Vec<f64>,
    swinging: Vec<bool>,
    offset_m: f64,
}

impl GroundHeight {
    /// For feet that stand where `schedule` has them.
    pub fn new(schedule: &ContactSchedule) -> Self {
        let feet = schedule.foot_count();
        let height =
            |foot: usize| schedule.stances(foot).first().map_or(0.0, |stance| stance.place.position_w.z);
        Self { planned: (0..feet).map(height).collect(), swinging: vec![false; feet], offset_m: 0.0 }
    }

    /// The ground is so much higher than planned, m.
    pub fn offset_m(&self) -> f64 {
        self.offset_m
    }

    /// Takes in where the feet are at `now_s`, `period_s` after the last time, and moves the footholds of those that lift off.
    pub fn update(&mut self, schedule: &mut ContactSchedule, feet: &[FootState], now_s: f64, period_s: f64) {
        let (mut sum, mut count) = (0.0, 0.0);
        for (k, foot) in feet.iter().enumerate() {
            if foot.loaded && schedule.stands(k, now_s) {
                sum += foot.place.position_w.z - self.planned[k];
                count += 1.0;
            }
        }
        if count > 0.0 {
            self.offset_m += (sum / count - self.offset_m) * (period_s / BELIEVED_S).min(1.0);
        }
        for k in 0..self.planned.len() {
            let FootPhase::Swing(swing) = schedule.phase(k, now_s) else {
                self.swinging[k] = false;
                continue;
            };
            if !core::mem::replace(&mut self.swinging[k], true) {
                self.planned[k] = swing.to.position_w.z;
                let mut to = swing.to;
                to.position_w.z += self.offset_m;
                schedule.aim(k, now_s, to);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::contact_schedule::Foothold;

    #[test]
    fn the_next_foothold_is_as_much_higher_as_planned() {
        let at = |x: f64, z: f64| Foothold::level(Vector3::new(x, 0.0, z), 0.0);
        let mut schedule = ContactSchedule::standing(&[at(0.0, 0.0), at(0.0, 0.0)], 4);
        schedule.step(0, 1.0, 1.5, at(0.3, 0.05));
        let mut height = GroundHeight::new(&schedule);
        let feet = [0.01, 0.01].map(|z| FootState { loaded: true, place: at(0.0, z) });
        for k in 0..100 {
            height.update(&mut schedule, &feet, 0.005 * f64::from(k), 0.005);
        }
        assert!((height.offset_m() - 0.01).abs() < 1e-4);
        height.update(&mut schedule, &feet, 1.0, 0.005);
        let FootPhase::Swing(swing) = schedule.phase(0, 1.0) else { panic!("stands") };
        assert!((swing.to.position_w.z - 0.06).abs() < 1e-4);
        height.update(&mut schedule, &feet, 1.005, 0.005);
        let FootPhase::Swing(again) = schedule.phase(0, 1.1) else { panic!("stands") };
        assert_eq!(again.to, swing.to);
    }
}
