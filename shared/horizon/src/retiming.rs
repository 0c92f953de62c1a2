//! Switch times by what the feet feel: each foot for itself, not its points.
//!
//! | seen | done |
//! |---|---|
//! | a foot that has left the ground and is past 0.7 of its swing carries load | it stands, from now on and where it is |
//! | a foot shall touch down before the next cycle and carries none | it goes on down: the switch moves by a cycle, or by the time the rest takes |
//! | a foot that stands | the schedule has it where it is |
//! | a foot that shall stand has carried nothing for 30 ms | it bounced, or never landed: it is in the air, on its way down |
//! | a foot shall lift off while another one is late | it waits for that one, up to half of its own swing |
//!
//! What comes later stays as it was planned. The last two rows are for points, which graze the ground and slide off it; a flat foot that has
//! landed stays in the plan, and one that is late stretches its swing: over the long step of a walker the mass centre cannot wait.

use alloc::vec;
use alloc::vec::Vec;

use nalgebra::Vector3;

use crate::contact_schedule::{ContactSchedule, FootPhase, Foothold};
use crate::legged_model::axes_on;

/// Speed at which a foot that is late goes down, m/s.
pub const SEARCH_SPEED_M_S: f64 = 0.15;
/// Farthest below where it was to stand that a late foot is looked for, m.
const DEEPEST_M: f64 = 0.2;

/// What is known of a foot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootState {
    /// Whether it carries load, debounced.
    pub loaded: bool,
    /// Its sole.
    pub place: Foothold,
}

/// Part of a swing after which a load is a landing: before, it is a stumble.
const LANDS_FROM: f64 = 0.7;
const FLAT_LANDS_FROM: f64 = 0.5;
/// A foot that shall stand and carries nothing for so long is in the air, s.
const UNLOADED_S: f64 = 0.03;
/// A lift-off waits for a late foot up to this part of its swing.
const WAITS: f64 = 0.5;

/// What has been felt of the feet so far.
#[derive(Clone, Debug, PartialEq)]
pub struct Retiming {
    /// The foot has been without load in its present swing.
    lifted: Vec<bool>,
    /// How long a foot that shall stand has carried nothing, s.
    unloaded_s: Vec<f64>,
    late: Vec<bool>,
    flat: Vec<bool>,
}

impl Retiming {
    /// For feet that are flat, or points.
    pub fn new(flat: &[bool]) -> Self {
        let feet = flat.len();
        let (lifted, late) = (vec![false; feet], vec![false; feet]);
        Self { lifted, unloaded_s: vec![0.0; feet], late, flat: flat.to_vec() }
    }

    /// Moves the switches of a cycle at `now_s`, the next one after `period_s`; what is decided acts `delay_s` later. Returns a bit for
    /// every foot whose switch has moved. No allocation.
    pub fn update(
        &mut self,
        schedule: &mut ContactSchedule,
        feet: &[FootState],
        now_s: f64,
        (period_s, delay_s): (f64, f64),
    ) -> u32 {
        let mut moved = 0;
        let ahead_s = period_s + delay_s;
        for (k, foot) in feet.iter().enumerate().take(self.late.len()) {
            self.late[k] = false;
            match schedule.phase(k, now_s) {
                FootPhase::Stance(stance) => {
                    self.lifted[k] = false;
                    if foot.loaded {
                        self.unloaded_s[k] = 0.0;
                        schedule.place(k, now_s, foot.place);
                    } else {
                        self.unloaded_s[k] += period_s;
                        let bounced = !self.flat[k] && self.unloaded_s[k] >= UNLOADED_S;
                        if bounced && stance.end_s > now_s + 2.0 * ahead_s {
                            self.late[k] = true;
                            let gap = (foot.place.position_w.z - stance.place.position_w.z).max(0.0);
                            let rest = (gap / SEARCH_SPEED_M_S).max(period_s);
                            (self.lifted[k], self.unloaded_s[k]) = (true, 0.0);
                            schedule.lift_again(k, now_s, now_s + ahead_s + rest);
                            moved |= 1 << k;
                        }
                    }
                }
                FootPhase::Swing(swing) => {
                    self.unloaded_s[k] = 0.0;
                    self.lifted[k] |= !foot.loaded;
                    let from = if self.flat[k] { FLAT_LANDS_FROM } else { LANDS_FROM };
                    let lands_s = swing.begin_s + from * (swing.end_s - swing.begin_s);
                    let lands = !lands_s.is_finite() || now_s > lands_s;
                    if foot.loaded && self.lifted[k] && lands {
                        schedule.move_touchdown(k, now_s, now_s);
                        schedule.place(k, now_s, foot.place);
                        moved |= 1 << k;
                    } else if !foot.loaded && swing.end_s < now_s + ahead_s {
                        self.late[k] = !self.flat[k];
                        let gap = (foot.place.position_w.z - swing.to.position_w.z).max(0.0);
                        let rest =
                            (gap / SEARCH_SPEED_M_S).max(if self.flat[k] { ahead_s } else { period_s });
                        let mut to = swing.to;
                        let touch_s = now_s + ahead_s + rest;
                        let near = gap < SEARCH_SPEED_M_S * ahead_s;
                        if near && swing.from.position_w.z - to.position_w.z < DEEPEST_M {
                            // The ground is lower than it was thought to be.
                            let longer_s =
                                if self.flat[k] { ahead_s } else { (touch_s - swing.end_s).max(0.0) };
                            to.position_w.z -= SEARCH_SPEED_M_S * longer_s;
                            schedule.aim(k, now_s, to);
                        }
                        schedule.move_touchdown(k, now_s, touch_s);
                        if self.flat[k] {
                            schedule.plan_touchdown(k, now_s, touch_s);
                        }
                        moved |= 1 << k;
                    }
                }
            }
        }
        if self.late.contains(&true) {
            moved |= self.wait(schedule, now_s, period_s, ahead_s);
        }
        moved
    }

    /// Feet that are about to lift off wait for those that are late.
    fn wait(&self, schedule: &mut ContactSchedule, now_s: f64, period_s: f64, ahead_s: f64) -> u32 {
        let mut moved = 0;
        for k in (0..self.late.len()).filter(|k| !self.late[*k]) {
            let FootPhase::Stance(stance) = schedule.phase(k, now_s) else { continue };
            let lifts = stance.end_s < now_s + ahead_s;
            if lifts && schedule.move_lift_off(k, now_s, stance.end_s + period_s, WAITS) {
                moved |= 1 << k;
            }
        }
        moved
    }
}

/// The foothold of a measured sole: a flat foot's axes are those of the ground it lies on, a point's ground is level.
pub fn measured_foothold(
    position_w: Vector3<f64>,
    sole_z_w: &Vector3<f64>,
    sole_x_w: &Vector3<f64>,
    flat: bool,
) -> Foothold {
    let normal = if flat { *sole_z_w } else { Vector3::z() };
    Foothold { position_w, axes_w: axes_on(&normal, sole_x_w) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, z: f64) -> Foothold {
        Foothold::level(Vector3::new(x, 0.0, z), 0.0)
    }

    fn swinging() -> ContactSchedule {
        let mut schedule = ContactSchedule::standing(&[at(0.0, 0.0)], 4);
        schedule.step(0, 1.0, 1.4, at(0.3, 0.0));
        schedule
    }

    const TIMES: (f64, f64) = (0.01, 0.0);

    fn foot(loaded: bool, x: f64, z: f64) -> [FootState; 1] {
        [FootState { loaded, place: at(x, z) }]
    }

    #[test]
    fn an_early_foot_stands_where_it_is() {
        let (mut schedule, mut retiming) = (swinging(), Retiming::new(&[false]));
        let scuffs = foot(true, 0.28, 0.01);
        assert_eq!(retiming.update(&mut schedule, &scuffs, 1.1, TIMES), 0, "it has not left the ground");
        assert_eq!(retiming.update(&mut schedule, &foot(false, 0.1, 0.05), 1.15, TIMES), 0);
        assert_eq!(retiming.update(&mut schedule, &scuffs, 1.2, TIMES), 0, "a stumble");
        assert_eq!(retiming.update(&mut schedule, &scuffs, 1.35, TIMES), 1);
        let FootPhase::Stance(stance) = schedule.phase(0, 1.35) else { panic!("swings") };
        assert_eq!((stance.begin_s, stance.place), (1.35, at(0.28, 0.01)));
    }

    #[test]
    fn a_late_foot_goes_on_down() {
        let (mut schedule, mut retiming) = (swinging(), Retiming::new(&[false]));
        let high = foot(false, 0.3, 0.015);
        assert_eq!(retiming.update(&mut schedule, &high, 1.38, TIMES), 0);
        assert_eq!(retiming.update(&mut schedule, &high, 1.395, TIMES), 1);
        assert!(!schedule.stands(0, 1.49) && schedule.stands(0, 1.51));
        retiming.update(&mut schedule, &foot(false, 0.3, 0.0), 1.5, TIMES);
        let FootPhase::Swing(swing) = schedule.phase(0, 1.5) else { panic!("stands") };
        assert!(swing.to.position_w.z < -0.001 && swing.end_s > 1.51);
    }

    #[test]
    fn a_foot_that_bounced_lands_again() {
        let (mut schedule, mut retiming) = (swinging(), Retiming::new(&[false]));
        retiming.update(&mut schedule, &foot(false, 0.2, 0.03), 1.3, TIMES);
        retiming.update(&mut schedule, &foot(true, 0.28, 0.0), 1.36, TIMES);
        let up = foot(false, 0.28, 0.003);
        let moved: Vec<u32> =
            (0..3).map(|k| retiming.update(&mut schedule, &up, 1.37 + 0.01 * f64::from(k), TIMES)).collect();
        assert_eq!(moved, [0, 0, 1]);
        assert!(!schedule.stands(0, 1.4) && schedule.stands(0, 1.421));
        assert_eq!(retiming.update(&mut schedule, &foot(true, 0.28, 0.0), 1.4, TIMES), 1);
        assert!(schedule.stands(0, 1.401));
    }

    #[test]
    fn a_lift_off_waits_for_a_late_foot() {
        let mut schedule = ContactSchedule::standing(&[at(0.0, 0.0), at(0.0, 0.0)], 4);
        schedule.step(0, 1.0, 1.4, at(0.3, 0.0));
        schedule.step(1, 1.4, 1.8, at(0.3, 0.0));
        let mut retiming = Retiming::new(&[false; 2]);
        let feet = [foot(false, 0.3, 0.01)[0], foot(true, 0.0, 0.0)[0]];
        assert_eq!(retiming.update(&mut schedule, &feet, 1.395, TIMES), 3);
        assert!(schedule.stands(1, 1.405) && !schedule.stands(1, 1.411));
        // Not for ever.
        for k in 0..100 {
            retiming.update(&mut schedule, &feet, 1.4 + 0.01 * f64::from(k), TIMES);
        }
        assert!(schedule.stances(1)[0].end_s <= 1.6 + 1e-9);
    }
}
