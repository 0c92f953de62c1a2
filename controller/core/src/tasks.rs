//! What the robot should do, as weighted squares, and their Gauss-Newton model at a node.
//!
//! A task is a residual `r(q, q̇)` with weights; its cost rate is `½ Σ w_i r_i²`, the cost of a stage that rate times the stage's
//! length. Around a node, `r ≈ r̄ + J x` and the stage cost gains `Q += Δt J' w J`, `q += Δt J' w r̄`.
//!
//! | task | residual | weight's unit (times 1/s) |
//! |---|---|---|
//! | posture | `q - q_ref` | 1/rad² (or 1/m²) |
//! | joint speed | `q̇ - q̇_ref` | 1/(rad/s)² |
//! | torque | `u - g(q̄)`, over the joint's effort limit | 1 |
//! | mass centre | `c - c_ref`, per axis of {0} | 1/m² |
//! | mass-centre velocity | `ċ` less that of its reference | 1/(m/s)² |
//! | spin | angular momentum about the mass centre | 1/(N·m·s)² |
//! | hand | position, velocity of a point | 1/m², 1/(m/s)² |
//! | swing foot | position of a point, rotation from the reference | 1/m², 1/rad² |
//!
//! The torque is counted from the one that carries the nominal posture, so that standing still costs nothing.
//!
//! Source: A. E. Bryson, Y.-C. Ho, *Applied Optimal Control*, 1975 (weights one over the largest acceptable square).

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::spatial::log_rotation;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::{Matrix3, Vector3};

use crate::model::BodyPoint;
use crate::node_kinematics::NodeKinematics;
use delmpc_lq::lq_stage::{Residuals, StageCost};

/// Weights of all tasks; zero switches one off. Cost rates: see the table of the module.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskWeights {
    /// Every joint's posture, 1/rad².
    pub posture: f64,
    /// Every joint's speed, 1/(rad/s)².
    pub joint_speed: f64,
    /// Every joint's torque over its effort limit.
    pub torque: f64,
    /// Mass centre along x, y, z, 1/m².
    pub com: [f64; 3],
    /// Velocity of the mass centre along x, y, z, 1/(m/s)².
    pub com_velocity: [f64; 3],
    /// Angular momentum about the mass centre, 1/(N·m·s)².
    pub spin: [f64; 3],
    /// Hand position while it reaches, 1/m².
    pub hand: f64,
    /// Hand velocity while it reaches, 1/(m/s)².
    pub hand_velocity: f64,
    /// Swing-foot position along x, y, z, 1/m².
    pub swing_foot: [f64; 3],
    /// Swing-foot rotation, 1/rad².
    pub swing_foot_rotation: f64,
}

impl Default for TaskWeights {
    /// Bryson-style: 0.22 rad of posture, 1.4 rad/s, 2 cm of the mass centre, 7 cm/s, 1 cm of the hand, 3 cm of the swing
    /// foot's height count 1 each; full effort
    /// 500, so that gains stay below what sole and servo delay allow.
    fn default() -> Self {
        Self {
            posture: 20.0,
            joint_speed: 0.5,
            torque: 500.0,
            com: [2000.0, 2000.0, 0.0],
            com_velocity: [200.0, 200.0, 0.0],
            spin: [0.0; 3],
            hand: 10_000.0,
            hand_velocity: 10.0,
            swing_foot: [0.0, 0.0, 1000.0],
            swing_foot_rotation: 5.0,
        }
    }
}

/// What the tasks aim at, at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskTargets {
    /// Joint coordinates.
    pub posture: Vec<f64>,
    /// Joint rates.
    pub posture_rate: Vec<f64>,
    /// Joint torques beyond those that hold the posture against gravity, mean over a stage, N m or N.
    pub torque: Vec<f64>,
    /// Mass centre in {0}, m.
    pub com: Vector3<f64>,
    /// Its velocity, m/s.
    pub com_velocity: Vector3<f64>,
    /// Hand point in {0}, m.
    pub hand: Vector3<f64>,
    /// Its velocity, m/s.
    pub hand_velocity: Vector3<f64>,
    /// Factor on the hand's weights, 0 to 1.
    pub hand_activity: f64,
    /// Swing-foot point in {0}, m.
    pub swing_foot: Vector3<f64>,
    /// Rotation of the swing foot's link in {0}.
    pub swing_foot_rotation: Matrix3<f64>,
}

impl TaskTargets {
    /// Of `n` joints, all zero.
    pub fn new(n: usize) -> Self {
        Self {
            posture: vec![0.0; n],
            posture_rate: vec![0.0; n],
            torque: vec![0.0; n],
            com: Vector3::zeros(),
            com_velocity: Vector3::zeros(),
            hand: Vector3::zeros(),
            hand_velocity: Vector3::zeros(),
            hand_activity: 0.0,
            swing_foot: Vector3::zeros(),
            swing_foot_rotation: Matrix3::identity(),
        }
    }
}

/// Most scalar residuals beside posture and speed.
pub const MAX_RESIDUALS: usize = 24;

/// The tasks of a robot.
#[derive(Clone, Debug)]
pub struct Tasks {
    /// Weights; may be changed at any time.
    pub weights: TaskWeights,
    hand: Option<BodyPoint>,
    swing_foot: Option<BodyPoint>,
    n: usize,
}

impl Tasks {
    /// For `n` joints and the given points.
    pub fn new(
        n: usize,
        weights: TaskWeights,
        hand: Option<BodyPoint>,
        swing_foot: Option<BodyPoint>,
    ) -> Self {
        Self { weights, hand, swing_foot, n }
    }

    /// Writes the cost of the state tasks over `duration` (s) around the node to the state part of `cost`. Torque is not among them.
    pub fn quadratise(
        &self,
        tree: &KinematicTree,
        node: &NodeKinematics,
        (q, q_dot): (&[f64], &[f64]),
        targets: &TaskTargets,
        duration: f64,
        cost: &mut StageCost,
    ) {
        let n = self.n;
        let (position, speed) = (self.weights.posture * duration, self.weights.joint_speed * duration);
        cost.state_weight[..n].fill(position);
        cost.state_weight[n..].fill(speed);
        for j in 0..n {
            cost.state_gradient[j] = position * (q[j] - targets.posture[j]);
            cost.state_gradient[n + j] = speed * (q_dot[j] - targets.posture_rate[j]);
        }
        self.linearize(tree, node, targets, duration, &mut cost.residuals);
    }

    /// Residuals and Jacobians of all Cartesian tasks, times the root of weight and duration (s).
    pub fn linearize(
        &self,
        tree: &KinematicTree,
        node: &NodeKinematics,
        targets: &TaskTargets,
        duration: f64,
        residuals: &mut Residuals,
    ) {
        residuals.clear();
        let n = self.n;
        let TaskWeights {
            com, com_velocity, spin, hand, hand_velocity, swing_foot, swing_foot_rotation, ..
        } = self.weights.clone();

        let residual = node.com() - targets.com;
        push(
            residuals,
            com.map(|w| w * duration),
            &residual,
            |j| (node.d_com_d_q(j), Vector3::zeros()),
            0..n,
        );
        let residual = node.com_velocity() - targets.com_velocity;
        push(
            residuals,
            com_velocity.map(|w| w * duration),
            &residual,
            |j| (node.d_com_velocity_d_q(j), node.d_com_d_q(j)),
            0..n,
        );
        let (c, momentum) = (node.com(), node.momentum());
        let spin_now = momentum.torque - c.cross(&momentum.force);
        let d_spin = |j: usize| {
            let (by_q, by_rate) = (node.d_momentum_d_q(j), node.d_momentum_d_rate(j));
            let q = by_q.torque - node.d_com_d_q(j).cross(&momentum.force) - c.cross(&by_q.force);
            (q, by_rate.torque - c.cross(&by_rate.force))
        };
        push(residuals, spin.map(|w| w * duration), &spin_now, d_spin, 0..n);

        if let Some(point) = self.hand.filter(|_| targets.hand_activity > 0.0) {
            let (position, velocity) = node.point(point.body, &point.position);
            let branch = || tree.branch(point.body).iter().map(|j| *j as usize);
            let weight = [hand * targets.hand_activity * duration; 3];
            let d_position = |j| (node.d_point_d_q(point.body, &position, j).0, Vector3::zeros());
            push(residuals, weight, &(position - targets.hand), d_position, branch());
            let weight = [hand_velocity * targets.hand_activity * duration; 3];
            let d_velocity = |j| {
                let (by_rate, by_q) = node.d_point_d_q(point.body, &position, j);
                (by_q, by_rate)
            };
            push(residuals, weight, &(velocity - targets.hand_velocity), d_velocity, branch());
        }
        if let Some(point) = self.swing_foot {
            let (position, _) = node.point(point.body, &point.position);
            let branch = || tree.branch(point.body).iter().map(|j| *j as usize);
            let d_position = |j| (node.d_point_d_q(point.body, &position, j).0, Vector3::zeros());
            let weight = swing_foot.map(|w| w * duration);
            push(residuals, weight, &(position - targets.swing_foot), d_position, branch());
            // R = exp(r^) R_ref: to first order in r its derivative is the spatial angular velocity.
            let rotation = node.link_pose_w(point.body).rotation;
            let residual = log_rotation(&(rotation * targets.swing_foot_rotation.transpose()));
            let d_rotation = |j: usize| (node.joint_twist_w(j).angular, Vector3::zeros());
            push(residuals, [swing_foot_rotation * duration; 3], &residual, d_rotation, branch());
        }
    }
}

/// Appends the three components of a residual whose weight is not zero.
fn push(
    residuals: &mut Residuals,
    weight: [f64; 3],
    value: &Vector3<f64>,
    derivative: impl Fn(usize) -> (Vector3<f64>, Vector3<f64>),
    joints: impl Iterator<Item = usize>,
) {
    let first = residuals.len();
    let root = weight.map(libm::sqrt);
    for axis in 0..3 {
        if weight[axis] > 0.0 {
            residuals.push(root[axis] * value[axis]);
        }
    }
    let count = residuals.len() - first;
    if count == 0 {
        return;
    }
    for j in joints {
        let (by_q, by_rate) = derivative(j);
        let axes = (0..3).filter(|&axis| weight[axis] > 0.0);
        for (residual, axis) in (first..first + count).zip(axes) {
            let row = residuals.row_mut(residual);
            let n = row.len() / 2;
            row[j] = root[axis] * by_q[axis];
            row[n + j] = root[axis] * by_rate[axis];
        }
    }
}
