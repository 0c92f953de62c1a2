//! The fallback ladder: which law commands the robot when the best one is not to be had.
//!
//! | level | law | taken when |
//! |---|---|---|
//! | 0 | fresh solution | this cycle solved |
//! | 1 | shifted plan with its own gains | no solution, or no usable state, and a plan younger than `plan_age_s` |
//! | 2 | static LQR about the posture | no such plan, last state near the posture |
//! | 3 | gravity hold and damping | no such plan, last state far from the posture; or 2 lasted longer than `lqr_s` without a state |
//! | 4 | damping | no usable state for `hold_s` |
//! | 5 | no torque | no usable state for `damping_s` |
//!
//! Down the ladder (worse) at once; up (better) only after `good_cycles` cycles in a row that allow it. The plant's watchdog uses
//! the same levels by itself: a dead controller cannot act.

use delmpc_messages::FallbackLevel;

/// When to leave a level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FallbackConfig {
    /// Cycles in a row that allow a better level before it is taken.
    pub good_cycles: u32,
    /// Oldest plan that may be followed, s. The servo feeds back what it measures itself: a plan is good while nothing new has happened
    /// to the robot, and mostly better than a law for another posture.
    pub plan_age_s: f64,
    /// Longest time on the static LQR without a usable state, s.
    pub lqr_s: f64,
    /// Longest time without a usable state before the gravity torque goes, s.
    pub hold_s: f64,
    /// Longest time without a usable state before all torque goes, s.
    pub damping_s: f64,
}

impl Default for FallbackConfig {
    fn default() -> Self {
        Self { good_cycles: 5, plan_age_s: 1.0, lqr_s: 1.3, hold_s: 2.0, damping_s: 4.0 }
    }
}

/// How a cycle's attempt at a solution ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attempt {
    /// It solved.
    Solved,
    /// The state was good, but there is no solution.
    NoSolution,
    /// The state was refused or is missing.
    NoState,
}

/// What the ladder may count on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Situation {
    /// How the attempt ended.
    pub attempt: Attempt,
    /// Age of the last plan, s; `None`: there is none.
    pub plan_age_s: Option<f64>,
    /// Whether the last good state is where the static LQR may be trusted.
    pub near_posture: bool,
    /// Time since the last usable state, s.
    pub blind_s: f64,
}

/// The ladder's memory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FallbackLadder {
    config: FallbackConfig,
    level: FallbackLevel,
    good: u32,
}

impl FallbackLadder {
    /// On level 0.
    pub fn new(config: FallbackConfig) -> Self {
        Self { config, level: FallbackLevel::FreshSolution, good: 0 }
    }

    /// The level in force.
    pub fn level(&self) -> FallbackLevel {
        self.level
    }

    /// The level of this cycle.
    pub fn advance(&mut self, situation: &Situation) -> FallbackLevel {
        let possible = self.possible(situation);
        if possible >= self.level {
            self.level = possible;
            self.good = 0;
        } else {
            self.good += 1;
            if self.good >= self.config.good_cycles {
                self.level = possible;
                self.good = 0;
            }
        }
        self.level
    }

    /// Goes down to `level` when a law could not be formed.
    pub fn descend_to(&mut self, level: FallbackLevel) {
        self.level = self.level.max(level);
        self.good = 0;
    }

    /// The best level this situation allows.
    fn possible(&self, situation: &Situation) -> FallbackLevel {
        let config = &self.config;
        let blind_s = match situation.attempt {
            Attempt::Solved => return FallbackLevel::FreshSolution,
            Attempt::NoSolution => 0.0,
            Attempt::NoState => situation.blind_s,
        };
        if situation.plan_age_s.is_some_and(|age| age <= config.plan_age_s) {
            FallbackLevel::ShiftedPlan
        } else if blind_s > config.damping_s {
            FallbackLevel::ZeroTorque
        } else if blind_s > config.hold_s {
            FallbackLevel::DampingOnly
        } else if blind_s > config.lqr_s || !situation.near_posture {
            FallbackLevel::GravityHold
        } else {
            FallbackLevel::StaticLqr
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use FallbackLevel::*;

    fn ladder() -> FallbackLadder {
        FallbackLadder::new(FallbackConfig { good_cycles: 3, ..FallbackConfig::default() })
    }

    fn blind(seconds: f64) -> Situation {
        Situation {
            attempt: Attempt::NoState,
            plan_age_s: Some(seconds),
            near_posture: true,
            blind_s: seconds,
        }
    }

    const SOLVED: Situation =
        Situation { attempt: Attempt::Solved, plan_age_s: Some(0.0), near_posture: true, blind_s: 0.0 };

    #[test]
    fn every_level_is_reached_in_order_while_no_state_comes() {
        let mut ladder = ladder();
        let seen: std::vec::Vec<FallbackLevel> =
            [0.01, 1.1, 1.5, 2.5, 10.0].map(|s| ladder.advance(&blind(s))).to_vec();
        assert_eq!(seen, [ShiftedPlan, StaticLqr, GravityHold, DampingOnly, ZeroTorque]);
    }

    #[test]
    fn a_level_is_left_after_enough_good_cycles_in_a_row() {
        let mut ladder = ladder();
        ladder.advance(&blind(1.5));
        assert_eq!(ladder.level(), GravityHold);
        assert_eq!([0; 2].map(|_| ladder.advance(&SOLVED)), [GravityHold; 2]);
        // A bad cycle in between starts the count again.
        assert_eq!(ladder.advance(&blind(1.5)), GravityHold);
        assert_eq!([0; 3].map(|_| ladder.advance(&SOLVED)), [GravityHold, GravityHold, FreshSolution]);
    }

    #[test]
    fn one_failed_solve_follows_the_plan_and_does_not_end_at_the_lqr() {
        let mut ladder = ladder();
        assert_eq!(ladder.advance(&SOLVED), FreshSolution);
        let failed = Situation { attempt: Attempt::NoSolution, plan_age_s: Some(0.005), ..SOLVED };
        assert_eq!(ladder.advance(&failed), ShiftedPlan);
    }

    #[test]
    fn without_a_plan_the_posture_decides() {
        let failed = Situation { attempt: Attempt::NoSolution, plan_age_s: None, ..SOLVED };
        assert_eq!(ladder().advance(&failed), StaticLqr);
        assert_eq!(ladder().advance(&Situation { near_posture: false, ..failed }), GravityHold);
    }

    #[test]
    fn it_only_gets_better_by_counting() {
        let mut ladder = ladder();
        ladder.descend_to(ZeroTorque);
        ladder.descend_to(StaticLqr);
        assert_eq!(ladder.level(), ZeroTorque);
    }
}
