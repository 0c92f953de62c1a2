//! Which foot stands where and when: past, now and to come.
//!
//! A foot is a list of stances in the order of time; between two of them it swings from the one place to the other. Switch times are
//! stage boundaries of the horizon ([`crate::stage_grid`]), and they are moved when a foot touches the ground earlier or later than
//! planned ([`crate::retiming`]).

use alloc::vec::Vec;

use nalgebra::{Matrix3, Vector3};

/// Most feet of a robot.
pub const MAX_FEET: usize = 8;

/// Where a foot stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Foothold {
    /// The sole's origin in {0}, m.
    pub position_w: Vector3<f64>,
    /// Axes of the sole in {0} (columns), z out of the ground.
    pub axes_w: Matrix3<f64>,
}

impl Foothold {
    /// On level ground, turned by `yaw` (rad).
    pub fn level(position_w: Vector3<f64>, yaw: f64) -> Self {
        let (s, c) = (libm::sin(yaw), libm::cos(yaw));
        Self { position_w, axes_w: Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0) }
    }

    /// Heading of its x axis, rad.
    pub fn yaw(&self) -> f64 {
        libm::atan2(self.axes_w[(1, 0)], self.axes_w[(0, 0)])
    }
}

/// A time in which a foot stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stance {
    /// Touchdown, s.
    pub begin_s: f64,
    /// Touchdown as it was planned, s.
    pub touch_planned_s: f64,
    /// Lift-off, s; infinite: none planned.
    pub end_s: f64,
    /// Lift-off as it was planned, s.
    pub lift_planned_s: f64,
    /// Where.
    pub place: Foothold,
}

/// A time in which a foot is in the air.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Swing {
    /// Lift-off, s.
    pub begin_s: f64,
    /// Touchdown, s.
    pub end_s: f64,
    /// Touchdown as it was planned: a foot that is late has made its way, s.
    pub planned_end_s: f64,
    /// From where.
    pub from: Foothold,
    /// To where.
    pub to: Foothold,
}

/// What a foot does at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FootPhase {
    /// It stands.
    Stance(Stance),
    /// It is in the air.
    Swing(Swing),
}

/// Stances of every foot.
#[derive(Clone, Debug, PartialEq)]
pub struct ContactSchedule {
    feet: Vec<Vec<Stance>>,
}

/// Switches nearer to each other than this are one, s.
pub const SAME_TIME_S: f64 = 1e-6;

impl ContactSchedule {
    /// All feet stand where they are, from ever on for ever. `room`: stances a foot may have at a time.
    pub fn standing(places: &[Foothold], room: usize) -> Self {
        let foot = |place: &Foothold| {
            let mut stances = Vec::with_capacity(room.max(2));
            let (begin_s, end_s) = (f64::NEG_INFINITY, f64::INFINITY);
            let (touch_planned_s, lift_planned_s) = (begin_s, end_s);
            stances.push(Stance { begin_s, touch_planned_s, end_s, lift_planned_s, place: *place });
            stances
        };
        Self { feet: places.iter().map(foot).collect() }
    }

    /// Feet.
    pub fn foot_count(&self) -> usize {
        self.feet.len()
    }

    /// Stances of a foot, in the order of time.
    pub fn stances(&self, foot: usize) -> &[Stance] {
        self.feet.get(foot).map_or(&[], Vec::as_slice)
    }

    /// What a foot does from `time_s` on. A foot that does not exist swings for ever on the spot.
    pub fn phase(&self, foot: usize, time_s: f64) -> FootPhase {
        let stances = self.stances(foot);
        let at = stances.iter().take_while(|stance| stance.begin_s <= time_s + SAME_TIME_S).count();
        let nowhere = Foothold::level(Vector3::zeros(), 0.0);
        let Some(last) = at.checked_sub(1).map(|k| stances[k]) else {
            let to = stances.first().map_or(nowhere, |stance| stance.place);
            let end_s = stances.first().map_or(f64::INFINITY, |stance| stance.begin_s);
            let (begin_s, planned_end_s) = (f64::NEG_INFINITY, end_s);
            return FootPhase::Swing(Swing { begin_s, end_s, planned_end_s, from: to, to });
        };
        if time_s + SAME_TIME_S < last.end_s {
            return FootPhase::Stance(last);
        }
        let next = stances.get(at);
        FootPhase::Swing(Swing {
            begin_s: last.end_s,
            end_s: next.map_or(f64::INFINITY, |stance| stance.begin_s),
            planned_end_s: next.map_or(f64::INFINITY, |stance| stance.touch_planned_s),
            from: last.place,
            to: next.map_or(last.place, |stance| stance.place),
        })
    }

    /// Whether a foot stands from `time_s` on.
    pub fn stands(&self, foot: usize, time_s: f64) -> bool {
        matches!(self.phase(foot, time_s), FootPhase::Stance(_))
    }

    /// The first switch of any foot after `time_s`, s.
    pub fn next_switch(&self, time_s: f64) -> Option<f64> {
        let times = self.feet.iter().flatten().flat_map(|stance| [stance.begin_s, stance.end_s]);
        let later = times.filter(|t| t.is_finite() && *t > time_s + SAME_TIME_S);
        later.min_by(f64::total_cmp)
    }

    /// A foot lifts off at `lift_s` and stands again at `to` from `touch_s` on. `false`: there is no room, or the times are not in order.
    pub fn step(&mut self, foot: usize, lift_s: f64, touch_s: f64, to: Foothold) -> bool {
        let Some(stances) = self.feet.get_mut(foot) else { return false };
        let full = stances.len() == stances.capacity();
        let Some(last) = stances.last_mut() else { return false };
        if full || !(lift_s > last.begin_s && touch_s > lift_s) {
            return false;
        }
        (last.end_s, last.lift_planned_s) = (lift_s, lift_s);
        let end_s = f64::INFINITY;
        let (begin_s, touch_planned_s, lift_planned_s) = (touch_s, touch_s, end_s);
        stances.push(Stance { begin_s, touch_planned_s, end_s, lift_planned_s, place: to });
        true
    }

    /// Forgets stances that ended before `time_s`, but for the last one of every foot.
    pub fn forget_before(&mut self, time_s: f64) {
        for stances in &mut self.feet {
            let ended = stances.iter().take_while(|stance| stance.end_s < time_s).count();
            let swings = stances.get(ended).is_none_or(|stance| stance.begin_s > time_s);
            stances.drain(..ended.saturating_sub(usize::from(swings)));
        }
    }

    /// A foot really stands at `place`: the stance at `time_s` gets it.
    pub fn place(&mut self, foot: usize, time_s: f64, place: Foothold) {
        if let Some(stance) = self.stance_at(foot, time_s) {
            stance.place = place;
        }
    }

    /// The foot of a swing at `time_s` touches the ground at `touch_s` instead of when it was to; the stance it begins keeps its end.
    pub fn move_touchdown(&mut self, foot: usize, time_s: f64, touch_s: f64) {
        let Some(stances) = self.feet.get_mut(foot) else { return };
        let next = stances.iter().position(|stance| stance.begin_s > time_s + SAME_TIME_S);
        if let Some(next) = next.filter(|next| *next > 0) {
            let earliest = stances[next - 1].end_s;
            let latest = stances[next].end_s;
            stances[next].begin_s = touch_s.max(earliest).min(latest);
        }
    }

    /// The swing at `time_s` is stretched to a touchdown at `touch_s`.
    pub fn plan_touchdown(&mut self, foot: usize, time_s: f64, touch_s: f64) {
        let Some(stances) = self.feet.get_mut(foot) else { return };
        if let Some(next) = stances.iter_mut().find(|stance| stance.begin_s > time_s + SAME_TIME_S) {
            next.touch_planned_s = touch_s;
        }
    }

    /// A foot that shall stand at `time_s` is in the air until `touch_s`.
    pub fn lift_again(&mut self, foot: usize, time_s: f64, touch_s: f64) {
        if let Some(stance) = self.stance_at(foot, time_s) {
            stance.begin_s = touch_s.min(stance.end_s);
        }
    }

    /// A foot that stands at `time_s` lifts off at `lift_s` instead, but keeps the part `1 - most` of its swing. `false`: that is over.
    pub fn move_lift_off(&mut self, foot: usize, time_s: f64, lift_s: f64, most: f64) -> bool {
        let Some(stances) = self.feet.get_mut(foot) else { return false };
        let now = stances.iter().rposition(|stance| stance.begin_s <= time_s + SAME_TIME_S);
        let Some(now) = now else { return false };
        let Some(touch_s) = stances.get(now + 1).map(|next| next.begin_s) else { return false };
        // The planned swing is what is left plus what has been waited for.
        let latest_s = touch_s - (1.0 - most) * (touch_s - stances[now].lift_planned_s);
        let moved = lift_s <= latest_s + SAME_TIME_S;
        if moved {
            stances[now].end_s = lift_s;
        }
        moved
    }

    /// The place a foot swings to at `time_s` changes.
    pub fn aim(&mut self, foot: usize, time_s: f64, to: Foothold) {
        let Some(stances) = self.feet.get_mut(foot) else { return };
        if let Some(next) = stances.iter_mut().find(|stance| stance.begin_s > time_s + SAME_TIME_S) {
            next.place = to;
        }
    }

    /// Changes the places of all stances that begin after `time_s`.
    pub fn map_later(&mut self, time_s: f64, change: impl Fn(&Foothold) -> Foothold) {
        for stance in self.feet.iter_mut().flatten().filter(|stance| stance.begin_s > time_s) {
            stance.place = change(&stance.place);
        }
    }

    /// All switches, in no order, s.
    pub fn switches(&self) -> impl Iterator<Item = f64> + '_ {
        let times = self.feet.iter().flatten().flat_map(|stance| [stance.begin_s, stance.end_s]);
        times.filter(|time_s| time_s.is_finite())
    }

    fn stance_at(&mut self, foot: usize, time_s: f64) -> Option<&mut Stance> {
        let stances = self.feet.get_mut(foot)?;
        stances
            .iter_mut()
            .find(|stance| stance.begin_s <= time_s + SAME_TIME_S && time_s + SAME_TIME_S < stance.end_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64) -> Foothold {
        Foothold::level(Vector3::new(x, 0.0, 0.0), 0.0)
    }

    #[test]
    fn a_step_is_a_swing_between_two_stances() {
        let mut schedule = ContactSchedule::standing(&[at(0.0), at(1.0)], 4);
        assert_eq!(schedule.next_switch(0.0), None);
        assert!(schedule.step(0, 1.0, 1.5, at(0.3)));
        assert!(schedule.stands(0, 0.999) && !schedule.stands(0, 1.0) && schedule.stands(0, 1.5));
        assert!(schedule.stands(1, 1.2));
        assert_eq!([schedule.next_switch(0.0), schedule.next_switch(1.0)], [Some(1.0), Some(1.5)]);
        let FootPhase::Swing(swing) = schedule.phase(0, 1.2) else { panic!("stands") };
        assert_eq!((swing.from, swing.to), (at(0.0), at(0.3)));
        // Out of order, or no such foot.
        assert!(!schedule.step(0, 1.4, 1.6, at(0.4)) && !schedule.step(7, 2.0, 3.0, at(0.4)));
    }

    #[test]
    fn a_touchdown_moves_and_the_next_lift_off_stays() {
        let mut schedule = ContactSchedule::standing(&[at(0.0)], 4);
        schedule.step(0, 1.0, 1.5, at(0.3));
        schedule.step(0, 2.0, 2.5, at(0.6));
        schedule.move_touchdown(0, 1.2, 1.4);
        assert!(schedule.stands(0, 1.4) && !schedule.stands(0, 2.0));
        schedule.move_touchdown(0, 2.2, 2.6);
        assert!(!schedule.stands(0, 2.59) && schedule.stands(0, 2.6));
        // Nothing to move while it stands for good.
        let before = schedule.clone();
        schedule.move_touchdown(0, 3.0, 3.5);
        assert_eq!(schedule, before);
    }

    #[test]
    fn the_past_is_forgotten_and_the_present_is_kept() {
        let mut schedule = ContactSchedule::standing(&[at(0.0)], 3);
        schedule.step(0, 1.0, 1.5, at(0.3));
        schedule.step(0, 2.0, 2.5, at(0.6));
        assert!(!schedule.step(0, 3.0, 3.5, at(0.9)), "no room");
        schedule.forget_before(2.2);
        let FootPhase::Swing(swing) = schedule.phase(0, 2.2) else { panic!("stands") };
        assert_eq!((swing.from, swing.to, swing.begin_s), (at(0.3), at(0.6), 2.0));
        assert!(schedule.step(0, 3.0, 3.5, at(0.9)));
        schedule.forget_before(2.6);
        assert!(schedule.stands(0, 2.7));
        assert_eq!(schedule.stances(0).len(), 2);
    }
}
