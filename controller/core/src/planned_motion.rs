//! A motion planned beforehand, to be followed: joint positions and rates at given times, and what belongs to them.
//!
//! Between two times positions are cubic Hermite polynomials of both ends, error O(Δt⁴) as between the nodes of
//! [`crate::plan`]; points follow by the same polynomial of their own, rotations along the shortest turn. The forward
//! kinematics of all times is done once, in [`PlannedMotion::new`].

use alloc::vec;
use alloc::vec::Vec;

use delmpc_horizon::hermite::Hermite;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, gravity_force_into};
use delmpc_mechanics::spatial::{exp_rotation, log_rotation};
use nalgebra::Vector3;

use crate::errors::ControlError;
use crate::model::ControllerModel;
use crate::node_kinematics::NodeKinematics;
use crate::posture_goal::goal_at;
use crate::reference::PostureGoal;
use crate::tasks::TaskTargets;

/// Joint positions and rates at times from 0 on, and the torques between them, in the order of the controller's joints: `N + 1` times,
/// positions and rates, `N` torques, a row of all joints each.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct JointMotion {
    /// Times, from 0, s.
    pub times: Vec<f64>,
    /// Joint positions at them, rad or m.
    pub q: Vec<Vec<f64>>,
    /// Joint rates at them, rad/s or m/s.
    pub rate: Vec<Vec<f64>>,
    /// Joint torques held between them, one row less, N m or N.
    pub torque: Vec<Vec<f64>>,
}

/// One time of the motion.
#[derive(Clone, Debug, PartialEq)]
struct Node {
    time_s: f64,
    at: PostureGoal,
    rate: Vec<f64>,
    com_velocity: Vector3<f64>,
    hand_velocity: Vector3<f64>,
    swing_foot_velocity: Vector3<f64>,
}

/// The motion with its points.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedMotion {
    nodes: Vec<Node>,
    /// Torque between two nodes beyond what holds the posture in the middle.
    torque: Vec<Vec<f64>>,
}

impl PlannedMotion {
    /// Checks the motion against the robot and does its kinematics. Allocates.
    ///
    /// # Errors
    /// [`ControlError::Model`] for times that do not begin at 0 and rise, for rows that do not fit the robot, and for values
    /// that are not finite.
    pub fn new(model: &ControllerModel, motion: &JointMotion) -> Result<Self, ControlError> {
        let n = model.tree.dof();
        let refuse = |reason| Err(ControlError::Model { reason });
        let JointMotion { times, q, rate, torque } = motion;
        let stages = times.len().saturating_sub(1);
        if stages == 0 || q.len() != times.len() || rate.len() != times.len() || torque.len() != stages {
            return refuse(
                "a planned motion needs two times or more, positions and rates for each, torques between them",
            );
        }
        if times[0] != 0.0 || times.windows(2).any(|pair| pair[1] - pair[0] < 1e-6) {
            return refuse("the times of a planned motion begin at 0 and rise");
        }
        let mut rows = q.iter().chain(rate).chain(torque);
        if rows.any(|row| row.len() != n || row.iter().any(|x| !x.is_finite())) {
            return refuse("a planned motion has a finite position, rate and torque for every joint");
        }
        let mut kinematics = NodeKinematics::new(&model.tree);
        let mut nodes = Vec::with_capacity(times.len());
        for ((time_s, q), rate) in times.iter().zip(q).zip(rate) {
            kinematics.update(&model.tree, q, rate)?;
            let velocity = |point: Option<crate::model::BodyPoint>| {
                point.map_or_else(Vector3::zeros, |p| kinematics.point(p.body, &p.position).1)
            };
            nodes.push(Node {
                time_s: *time_s,
                at: goal_at(model, &kinematics, q),
                rate: rate.clone(),
                com_velocity: kinematics.com_velocity(),
                hand_velocity: velocity(model.hand),
                swing_foot_velocity: velocity(model.swing_foot),
            });
        }
        let mut beyond = torque.clone();
        let mut gravity = InverseDynamicsWorkspace::new(&model.tree);
        let (mut middle, mut holding) = (vec![0.0; n], vec![0.0; n]);
        for (k, row) in beyond.iter_mut().enumerate() {
            middle.iter_mut().zip(&q[k]).zip(&q[k + 1]).for_each(|((m, a), b)| *m = 0.5 * (a + b));
            kinematics.update(&model.tree, &middle, &rate[k])?;
            gravity_force_into(&model.tree, kinematics.kinematics(), &mut gravity, &mut holding)?;
            row.iter_mut().zip(&holding).for_each(|(torque, holds)| *torque -= holds);
        }
        Ok(Self { nodes, torque: beyond })
    }

    /// The posture it ends in.
    pub fn end(&self) -> &PostureGoal {
        &self.nodes[self.nodes.len() - 1].at
    }

    /// How long it takes, s.
    pub fn duration_s(&self) -> f64 {
        self.nodes[self.nodes.len() - 1].time_s
    }

    /// Mean torque beyond what holds the posture over a span of times after its begin (s); none before and after the motion.
    pub fn mean_torque(&self, (from_s, to_s): (f64, f64), torque: &mut [f64]) {
        torque.fill(0.0);
        for (k, held) in self.torque.iter().enumerate() {
            let (begin_s, end_s) = (self.nodes[k].time_s, self.nodes[k + 1].time_s);
            let part = (to_s.min(end_s) - from_s.max(begin_s)) / (to_s - from_s);
            if part > 0.0 {
                torque.iter_mut().zip(held).for_each(|(mean, value)| *mean += part * value);
            }
        }
    }

    /// Fills posture, mass centre, hand and swing foot for a time after its begin (s), clamped to the motion. Leaves the hand's
    /// activity alone. No allocation.
    pub fn sample(&self, time_s: f64, targets: &mut TaskTargets) {
        let after = self.nodes.partition_point(|node| node.time_s <= time_s);
        let k = after.clamp(1, self.nodes.len() - 1);
        let (a, b) = (&self.nodes[k - 1], &self.nodes[k]);
        let length = b.time_s - a.time_s;
        let t = ((time_s - a.time_s) / length).clamp(0.0, 1.0);
        let cubic = Hermite::new(t, length);
        for (j, (posture, rate)) in targets.posture.iter_mut().zip(&mut targets.posture_rate).enumerate() {
            let ends = ((a.at.q[j], a.rate[j]), (b.at.q[j], b.rate[j]));
            (*posture, *rate) = (cubic.value(ends), cubic.rate(ends));
        }
        let com = ((a.at.com, a.com_velocity), (b.at.com, b.com_velocity));
        (targets.com, targets.com_velocity) = (cubic.value(com), cubic.rate(com));
        let hand = ((a.at.hand, a.hand_velocity), (b.at.hand, b.hand_velocity));
        (targets.hand, targets.hand_velocity) = (cubic.value(hand), cubic.rate(hand));
        let foot = |node: &Node| (node.at.swing_foot, node.swing_foot_velocity);
        targets.swing_foot = cubic.value((foot(a), foot(b)));
        let (from, to) = (&a.at.swing_foot_rotation, &b.at.swing_foot_rotation);
        targets.swing_foot_rotation = from * exp_rotation(&(log_rotation(&from.tr_mul(to)) * t));
    }
}

impl JointMotion {
    /// The same motion in another order of joints: joint `k` of the result is `from[k]` of this one.
    ///
    /// # Errors
    /// [`ControlError::Model`] when a row has no such joint.
    pub fn in_order(&self, from: &[usize]) -> Result<Self, ControlError> {
        let reorder = |rows: &[Vec<f64>]| {
            let row =
                |row: &Vec<f64>| from.iter().map(|j| row.get(*j).copied()).collect::<Option<Vec<f64>>>();
            rows.iter().map(row).collect::<Option<Vec<_>>>()
        };
        match (reorder(&self.q), reorder(&self.rate), reorder(&self.torque)) {
            (Some(q), Some(rate), Some(torque)) => Ok(Self { times: self.times.clone(), q, rate, torque }),
            _ => Err(ControlError::Model { reason: "a planned motion has too few joints" }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_change_their_order_and_a_missing_one_is_refused() {
        let motion = JointMotion {
            times: vec![0.0, 1.0],
            q: vec![vec![1.0, 2.0, 3.0], vec![4.0, 5.0, 6.0]],
            rate: vec![vec![0.0, 0.1, 0.2]; 2],
            torque: vec![vec![7.0, 8.0, 9.0]],
        };
        let turned = motion.in_order(&[2, 0]).unwrap();
        assert_eq!(turned.q, [[3.0, 1.0], [6.0, 4.0]]);
        assert_eq!(turned.rate[0], [0.2, 0.0]);
        assert_eq!(turned.torque, [[9.0, 7.0]]);
        assert!(motion.in_order(&[3]).is_err());
    }
}
