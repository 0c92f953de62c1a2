//! What the robot aims at over time: home posture, and a reach to a ball and back.
//!
//! ```text
//! s(τ) = 10 τ³ - 15 τ⁴ + 6 τ⁵      minimum jerk between rest and rest, 0 <= τ <= 1
//! rest -> s: 0..1 from start to deadline -> hold at 1 -> s: 1..0 in the return time -> rest
//! posture = home + s (goal - home)     hand = p_home + s (ball - p_home)     mass centre likewise
//! ```
//!
//! The goal posture ([`crate::posture_goal`]) balances with the hand at the ball, so posture, hand and terminal cost do not pull
//! against each other. The hand's weight grows with `s²`: on the way the whole body may choose, at the ball it may not.
//!
//! Source: T. Flash, N. Hogan, *The coordination of arm movements*, J. Neuroscience 5, 1985.

use alloc::vec::Vec;

use delmpc_mechanics::spatial::{RigidTransform, exp_rotation};
use nalgebra::{Matrix3, Vector3};

use crate::planned_motion::PlannedMotion;
use crate::tasks::TaskTargets;

/// A reach to a ball and back. Times in seconds of the run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Ball in {0}, m.
    pub ball_m: [f64; 3],
    /// When the hand leaves, s.
    pub start_s: f64,
    /// When it must be there, s after the start.
    pub deadline_s: f64,
    /// How long it stays, s.
    pub hold_s: f64,
    /// How long it takes back, s.
    pub return_s: f64,
}

impl Reach {
    /// `(s, ṡ, activity)` at a time of the run.
    pub fn progress(&self, time_s: f64) -> (f64, f64, f64) {
        let there = self.start_s + self.deadline_s;
        let leaves = there + self.hold_s;
        if time_s <= self.start_s {
            (0.0, 0.0, 0.0)
        } else if time_s < there {
            let (s, rate) = minimum_jerk((time_s - self.start_s) / self.deadline_s);
            (s, rate / self.deadline_s, s * s)
        } else if time_s <= leaves {
            (1.0, 0.0, 1.0)
        } else if time_s < leaves + self.return_s {
            let (s, rate) = minimum_jerk((time_s - leaves) / self.return_s);
            (1.0 - s, -rate / self.return_s, 0.0)
        } else {
            (0.0, 0.0, 0.0)
        }
    }
}

/// `(s, ds/dτ)` of the minimum-jerk profile; τ outside 0..1 is clamped.
pub fn minimum_jerk(tau: f64) -> (f64, f64) {
    let t = tau.clamp(0.0, 1.0);
    let (t2, t3) = (t * t, t * t * t);
    (t3 * (10.0 - 15.0 * t + 6.0 * t2), 30.0 * t2 * (1.0 - t) * (1.0 - t))
}

/// A posture and what belongs to it.
#[derive(Clone, Debug, PartialEq)]
pub struct PostureGoal {
    /// Joint coordinates.
    pub q: Vec<f64>,
    /// Mass centre in {0}, m.
    pub com: Vector3<f64>,
    /// Hand point in {0}, m.
    pub hand: Vector3<f64>,
    /// Swing-foot point in {0}, m.
    pub swing_foot: Vector3<f64>,
    /// Rotation of the swing foot's link in {0}.
    pub swing_foot_rotation: Matrix3<f64>,
}

/// The reference over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    /// Where the robot rests.
    pub home: PostureGoal,
    /// The reach and the posture it ends in.
    pub reach: Option<(Reach, PostureGoal)>,
    /// The way there, where it was planned beforehand; it begins with the reach.
    pub planned: Option<PlannedMotion>,
    /// By how much the mass centre is to be elsewhere than the model says, in {0}, m.
    pub com_shift: Vector3<f64>,
    /// By how much the ball is elsewhere in {0} than the reach has it, m.
    pub ball_shift: Vector3<f64>,
}

impl Reference {
    /// Reference at rest at `home`, as the model has it.
    pub fn at(home: PostureGoal) -> Self {
        Self { home, reach: None, planned: None, com_shift: Vector3::zeros(), ball_shift: Vector3::zeros() }
    }

    /// Says where the real sole is in {0} and how the mass centre is trimmed there. A ball is given from the middle of the real sole
    /// with its heading, z up, and the mass centre belongs over it.
    pub fn stand_on(&mut self, sole_pose: &RigidTransform, trim: &Vector3<f64>) {
        let middle = &sole_pose.translation;
        self.com_shift = trim + Vector3::new(middle.x, middle.y, 0.0);
        if let Some((reach, _)) = &self.reach {
            let ball = Vector3::from(reach.ball_m);
            let heading = libm::atan2(sole_pose.rotation[(1, 0)], sole_pose.rotation[(0, 0)]);
            self.ball_shift = middle + exp_rotation(&Vector3::new(0.0, 0.0, heading)) * ball - ball;
        }
    }

    /// Fills the targets for a time of the run (s).
    pub fn sample(&self, time_s: f64, targets: &mut TaskTargets) {
        let home = &self.home;
        targets.swing_foot = home.swing_foot;
        targets.swing_foot_rotation = home.swing_foot_rotation;
        let Some((reach, goal)) = &self.reach else {
            targets.posture.copy_from_slice(&home.q);
            targets.posture_rate.fill(0.0);
            targets.com = home.com + self.com_shift;
            targets.com_velocity = Vector3::zeros();
            targets.hand_activity = 0.0;
            return;
        };
        let (s, rate, activity) = reach.progress(time_s);
        targets.hand_activity = activity;
        let since_s = time_s - reach.start_s;
        if let Some(planned) = self.planned.as_ref().filter(|_| (0.0..reach.deadline_s).contains(&since_s)) {
            planned.sample(since_s, targets);
            targets.com += self.com_shift;
            targets.hand += self.ball_shift * s;
            return;
        }
        for (i, (from, to)) in home.q.iter().zip(&goal.q).enumerate() {
            targets.posture[i] = from + s * (to - from);
            targets.posture_rate[i] = rate * (to - from);
        }
        targets.com = home.com + (goal.com - home.com) * s + self.com_shift;
        targets.com_velocity = (goal.com - home.com) * rate;
        let way = Vector3::from(reach.ball_m) + self.ball_shift - home.hand;
        targets.hand = home.hand + way * s;
        targets.hand_velocity = way * rate;
        targets.swing_foot = home.swing_foot + (goal.swing_foot - home.swing_foot) * s;
    }

    /// Fills the torques beyond those of rest for a span of the run (s): those of the planned motion, else none.
    pub fn sample_torque(&self, (from_s, to_s): (f64, f64), targets: &mut TaskTargets) {
        targets.torque.fill(0.0);
        if let (Some((reach, _)), Some(planned)) = (&self.reach, &self.planned) {
            planned.mean_torque((from_s - reach.start_s, to_s - reach.start_s), &mut targets.torque);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REACH: Reach =
        Reach { ball_m: [1.0, 0.0, 0.0], start_s: 1.0, deadline_s: 1.3, hold_s: 1.0, return_s: 1.5 };

    #[test]
    fn minimum_jerk_starts_and_ends_at_rest_and_its_rate_is_its_derivative() {
        for (tau, s) in [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.0, 1.0), (-1.0, 0.0)] {
            assert!((minimum_jerk(tau).0 - s).abs() < 1e-15);
        }
        assert_eq!((minimum_jerk(0.0).1, minimum_jerk(1.0).1), (0.0, 0.0));
        let step = 1e-6;
        for tau in [0.1, 0.4, 0.77] {
            let slope = (minimum_jerk(tau + step).0 - minimum_jerk(tau - step).0) / (2.0 * step);
            assert!((slope - minimum_jerk(tau).1).abs() < 1e-8);
        }
    }

    #[test]
    fn the_hand_is_at_the_ball_from_the_deadline_to_the_end_of_the_hold() {
        assert_eq!(REACH.progress(0.5), (0.0, 0.0, 0.0));
        assert_eq!(REACH.progress(2.3).0, 1.0);
        assert_eq!(REACH.progress(3.3), (1.0, 0.0, 1.0));
        assert!(REACH.progress(3.4).0 < 1.0 && REACH.progress(3.4).1 < 0.0);
        assert_eq!(REACH.progress(9.0), (0.0, 0.0, 0.0));
    }
}
