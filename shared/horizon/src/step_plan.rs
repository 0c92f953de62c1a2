//! A walk of single steps: a list of footholds with times, and the way of the mass centre over them.

use alloc::vec::Vec;

use nalgebra::Vector2;

use crate::contact_schedule::{ContactSchedule, Foothold};
use crate::mass_centre_plan::MassCentrePlan;

/// A step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Which foot.
    pub foot: usize,
    /// Where to.
    pub to: Foothold,
    /// Lift-off, s.
    pub lift_s: f64,
    /// Touchdown, s.
    pub touch_s: f64,
}

/// Lays steps out; `false`: one does not fit.
pub fn lay_out(steps: &[Step], schedule: &mut ContactSchedule) -> bool {
    steps.iter().all(|step| schedule.step(step.foot, step.lift_s, step.touch_s, step.to))
}

/// How long the weight takes to get over the first foot that stands alone, and back from the last one, s.
const SHIFT_S: f64 = 0.6;

/// The way of the mass centre for steps: over the feet that stand while one is in the air, from there to there while all stand; from
/// `first` over the middle of the feet to the same over where they end. Ends at rest. Allocates.
///
/// `places`: where the feet stand before the first step; `height_m` of the mass centre above them.
pub fn mass_centre_over(
    steps: &[Step],
    places: &[Foothold],
    first: Vector2<f64>,
    height_m: f64,
    gravity: f64,
) -> MassCentrePlan {
    let mut feet: Vec<Vector2<f64>> = places.iter().map(|place| place.position_w.xy()).collect();
    let middle = |feet: &[Vector2<f64>], but: Option<usize>| {
        let standing = || feet.iter().enumerate().filter(|(k, _)| Some(*k) != but);
        standing().map(|(_, place)| *place).sum::<Vector2<f64>>() / standing().count().max(1) as f64
    };
    let offset = first - middle(&feet, None);
    let (Some(begin), Some(end)) = (steps.first(), steps.last()) else {
        return MassCentrePlan::new(0.0, 0.0, height_m, gravity, |_| first);
    };
    let mut knots = alloc::vec![(begin.lift_s - SHIFT_S, first)];
    for step in steps {
        let over = middle(&feet, Some(step.foot));
        knots.extend([(step.lift_s, over), (step.touch_s, over)]);
        if let Some(foot) = feet.get_mut(step.foot) {
            *foot = step.to.position_w.xy();
        }
    }
    knots.push((end.touch_s + SHIFT_S, middle(&feet, None) + offset));
    let (start_s, end_s) = (begin.lift_s - 2.0 * SHIFT_S, end.touch_s + 2.0 * SHIFT_S);
    MassCentrePlan::new(start_s, end_s, height_m, gravity, |time_s| {
        let after = knots.iter().take_while(|(t, _)| *t <= time_s).count();
        let (Some(last), Some(next)) = (after.checked_sub(1).map(|k| knots[k]), knots.get(after)) else {
            return knots[after.min(knots.len() - 1)].1;
        };
        last.1 + (next.1 - last.1) * ((time_s - last.0) / (next.0 - last.0))
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_walk_ends_side_by_side_with_the_mass_centre_in_between() {
        let place = |y: f64| Foothold::level(Vector3::new(0.0, y, 0.0), 0.0);
        let places = [place(0.1), place(-0.1)];
        let lengths = [0.3, 0.6, 0.9, 1.2, 1.2];
        let steps: Vec<Step> = (0..5)
            .map(|k| {
                let mut to = places[k % 2];
                to.position_w.x = lengths[k];
                let lift_s = 1.0 + 0.8 * k as f64;
                Step { foot: k % 2, to, lift_s, touch_s: lift_s + 0.6 }
            })
            .collect();
        let mut schedule = ContactSchedule::standing(&places, 8);
        assert!(lay_out(&steps, &mut schedule));
        let last = |foot: usize| schedule.stances(foot).last().unwrap().place.position_w.x;
        assert!(
            (last(0) - last(1)).abs() < 1e-12 && (last(0) - 1.2).abs() < 1e-12,
            "{} {}",
            last(0),
            last(1)
        );
        let plan = mass_centre_over(&steps, &places, Vector2::new(0.02, 0.0), 0.9, 9.81);
        assert!((plan.at(plan.end_s() + 1.0)[0] - Vector2::new(1.22, 0.0)).norm() < 1e-9);
        // While the left foot swings the zero-moment point is in the right one.
        let [place, _, acceleration] = plan.at(1.3);
        assert!((place.y - 0.9 / 9.81 * acceleration.y + 0.1).abs() < 0.02);
    }
}
