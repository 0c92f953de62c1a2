//! Switch times by what the feet feel: each foot for itself, not its points.
//!
//! | seen | done |
//! |---|---|
//! | a foot past half of its swing carries load | it stands, from now on and where it is |
//! | a foot shall touch down before the next cycle and carries none | it goes on down: the switch moves by a cycle, or by the time the rest takes |
//! | a foot that stands | the schedule has it where it is |
//!
//! What comes later stays as it was planned.

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

/// Moves the switches of a cycle at `now_s`, the next one after `period_s`. Returns a bit for every foot that came early or late.
pub fn retime(schedule: &mut ContactSchedule, feet: &[FootState], now_s: f64, period_s: f64) -> u32 {
    let mut moved = 0;
    for (k, foot) in feet.iter().enumerate() {
        match schedule.phase(k, now_s) {
            FootPhase::Stance(_) => {
                if foot.loaded {
                    schedule.place(k, now_s, foot.place);
                }
            }
            FootPhase::Swing(swing) => {
                let half = 0.5 * (swing.begin_s + swing.end_s);
                if foot.loaded && now_s > half {
                    schedule.move_touchdown(k, now_s, now_s);
                    schedule.place(k, now_s, foot.place);
                    moved |= 1 << k;
                } else if !foot.loaded && swing.end_s < now_s + period_s {
                    let gap = (foot.place.position_w.z - swing.to.position_w.z).max(0.0);
                    let rest = (gap / SEARCH_SPEED_M_S).max(period_s);
                    let mut to = swing.to;
                    if gap < SEARCH_SPEED_M_S * period_s
                        && swing.from.position_w.z - to.position_w.z < DEEPEST_M
                    {
                        // The ground is lower than it was thought to be.
                        to.position_w.z -= SEARCH_SPEED_M_S * period_s;
                        schedule.aim(k, now_s, to);
                    }
                    schedule.move_touchdown(k, now_s, now_s + period_s + rest);
                    moved |= 1 << k;
                }
            }
        }
    }
    moved
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

    #[test]
    fn an_early_foot_stands_where_it_is() {
        let mut schedule = swinging();
        let feet = [FootState { loaded: true, place: at(0.28, 0.01) }];
        assert_eq!(retime(&mut schedule, &feet, 1.1, 0.01), 0, "still at its lift-off");
        assert_eq!(retime(&mut schedule, &feet, 1.35, 0.01), 1);
        let FootPhase::Stance(stance) = schedule.phase(0, 1.35) else { panic!("swings") };
        assert_eq!((stance.begin_s, stance.place), (1.35, at(0.28, 0.01)));
    }

    #[test]
    fn a_late_foot_goes_on_down() {
        let mut schedule = swinging();
        let mut feet = [FootState { loaded: false, place: at(0.3, 0.015) }];
        assert_eq!(retime(&mut schedule, &feet, 1.38, 0.01), 0);
        assert_eq!(retime(&mut schedule, &feet, 1.395, 0.01), 1);
        assert!(!schedule.stands(0, 1.49) && schedule.stands(0, 1.51));
        feet[0].place = at(0.3, 0.0);
        retime(&mut schedule, &feet, 1.5, 0.01);
        let FootPhase::Swing(swing) = schedule.phase(0, 1.5) else { panic!("stands") };
        assert!(swing.to.position_w.z < -0.001 && swing.end_s > 1.51);
    }
}
