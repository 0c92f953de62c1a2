//! What the controller aims at: the posture with its infinite-horizon law, and a reach. Start-up and changes on demand; allocates.

use alloc::vec;

use delmpc_mechanics::inverse_dynamics::gravity_force_into;
use delmpc_messages::LARGEST_EFFORT;
use nalgebra::Vector3;

use super::Controller;
use crate::errors::ControlError;
use crate::horizon_dynamics::HorizonDynamics;
use crate::planned_motion::{JointMotion, PlannedMotion};
use crate::posture_goal::{posture_goal, reach_posture};
use crate::reference::Reach;

/// A goal farther than this from where the hand is in the balanced posture nearest to it is moved there, m.
const UNREACHABLE_M: f64 = 0.01;
/// Times nearer to each other than this are the same, s.
const SAME_TIME_S: f64 = 1e-6;

impl Controller {
    /// Cost and gain of standing still for ever, at the home posture.
    pub(super) fn solve_infinite_horizon(&mut self) -> Result<(), ControlError> {
        let tree = &self.model.tree;
        let n = tree.dof();
        let mut x = vec![0.0; 2 * n];
        x[..n].copy_from_slice(&self.model.posture);
        self.node.update(tree, &x[..n], &x[n..])?;
        let mut torque = vec![0.0; n];
        gravity_force_into(tree, self.node.kinematics(), &mut self.gravity, &mut torque)?;
        let last = self.config.stage_lengths().last().copied().unwrap_or(self.config.period_s);
        let mut dynamics = HorizonDynamics::new(tree, 1)?;
        let mut stand_still = |duration| {
            self.horizon.stand_still(tree, &mut dynamics, &self.reference, (&x, &torque), duration)
        };
        let (coarse, fine) = (stand_still(last)?, stand_still(self.config.period_s)?);
        self.horizon.set_terminal_cost(&coarse.cost_to_go);
        self.static_law.gain.copy_from(&fine.gain);
        let law = self.static_law.restart();
        law.torque.copy_from_slice(&torque);
        law.reference.copy_from_slice(&x);
        for (j, limit) in self.model.limits.iter().enumerate() {
            let effort = limit.effort.min(LARGEST_EFFORT);
            (law.lower[j], law.upper[j]) = (-effort, effort);
        }
        law.clamp();
        Ok(())
    }

    /// Stands in another posture from now on: solves the infinite-horizon problem there, for the terminal cost and the static law, and
    /// gives a reach its new end. A new posture far from the old one is gone to in one go; go there in steps. Allocates.
    ///
    /// # Errors
    /// [`ControlError`] for a posture that does not fit the model, or without a law that holds it; the old one stays then.
    pub fn set_posture(&mut self, posture: &[f64]) -> Result<(), ControlError> {
        let old = core::mem::replace(&mut self.model.posture, posture.to_vec());
        let outcome = self.model.check().and_then(|()| self.stand_in_posture());
        if outcome.is_err() {
            self.model.posture = old;
            // It had a law before.
            self.stand_in_posture()?;
        }
        outcome
    }

    fn stand_in_posture(&mut self) -> Result<(), ControlError> {
        self.prepared = None;
        self.reference.home = posture_goal(&self.model, &self.model.posture)?;
        self.solve_infinite_horizon()?;
        self.set_reach(self.asked_reach)
    }

    /// How far from the goal the hand ends in the balanced posture nearest to it, m: beyond a centimetre the goal is moved there.
    pub fn hand_distance_left_m(&self) -> f64 {
        self.hand_distance_left_m
    }

    /// Sets or clears the reach and computes the posture it ends in. A goal that no balanced posture reaches is moved to the nearest one
    /// ([`Self::hand_distance_left_m`]). Allocates.
    ///
    /// # Errors
    /// [`ControlError::Model`] when the model has no hand, [`ControlError::Mechanics`] when it does not fit.
    pub fn set_reach(&mut self, reach: Option<Reach>) -> Result<(), ControlError> {
        self.asked_reach = reach;
        self.reference.planned = None;
        let Some(reach) = reach else {
            self.hand_distance_left_m = 0.0;
            self.reference.reach = None;
            return Ok(());
        };
        if self.model.hand.is_none() {
            return Err(ControlError::Model { reason: "a reach needs a hand point" });
        }
        let ball = Vector3::from(reach.ball_m);
        let goal = reach_posture(&self.model, &self.reference.home, &ball, &self.config.weights)?;
        self.hand_distance_left_m = (goal.hand - ball).norm();
        let mut reach = reach;
        if self.hand_distance_left_m > UNREACHABLE_M {
            // A hand that is drawn to where no balanced posture brings it draws the robot over: it goes as far as that posture.
            reach.ball_m = goal.hand.into();
        }
        self.reference.reach = Some((reach, goal));
        Ok(())
    }

    /// The reach goes the way of a planned motion, which begins with it and takes as long as it has; hold and return are those of the reach.
    /// A new reach or posture ends this. Allocates.
    ///
    /// # Errors
    /// [`ControlError::Model`] without a reach, for a motion that does not fit the robot, and for one that takes another time.
    pub fn follow(&mut self, motion: &JointMotion) -> Result<(), ControlError> {
        let Some((reach, goal)) = &mut self.reference.reach else {
            return Err(ControlError::Model {
                reason: "a planned motion needs a reach: when it begins, and its ball",
            });
        };
        let planned = PlannedMotion::new(&self.model, motion)?;
        if (planned.duration_s() - reach.deadline_s).abs() > SAME_TIME_S {
            return Err(ControlError::Model {
                reason: "a planned motion takes as long as the reach has until its deadline",
            });
        }
        goal.clone_from(planned.end());
        self.hand_distance_left_m = (goal.hand - Vector3::from(reach.ball_m)).norm();
        self.reference.planned = Some(planned);
        Ok(())
    }
}
