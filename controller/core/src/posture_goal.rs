//! The posture in which the robot balances with its hand at a point: damped Gauss-Newton on the static tasks.
//!
//! ```text
//! min ½ Σ w r(q)²     r: posture (weak), mass centre, hand (strong), swing foot       lower <= q <= upper
//! step: (J'WJ + μ 1) δ = -J'W r,   q := clamp(q + δ);   μ smaller after a success, larger after a failure
//! ```
//!
//! Allocates; used at construction and when a reach is set.
//!
//! Source: K. Levenberg, Quart. Appl. Math. 2, 1944; D. W. Marquardt, J. SIAM 11, 1963.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::ModelError;
use nalgebra::{Matrix3, Vector3};

use crate::model::ControllerModel;
use crate::node_kinematics::NodeKinematics;
use crate::reference::PostureGoal;
use crate::tasks::{MAX_RESIDUALS, TaskTargets, TaskWeights, Tasks};
use delmpc_lq::kernels::{CholeskyScratch, factor, solve_factored};
use delmpc_lq::lq_stage::{Residuals, StageCost};

/// Steps of the iteration.
const MAX_STEPS: usize = 200;
/// Part of the joint range kept free at either end.
const RANGE_MARGIN: f64 = 0.02;

/// What belongs to a posture.
///
/// # Errors
/// [`ModelError::Length`] when the posture does not fit the tree.
pub fn posture_goal(model: &ControllerModel, q: &[f64]) -> Result<PostureGoal, ModelError> {
    let tree = &model.tree;
    let mut node = NodeKinematics::new(tree);
    node.update(tree, q, &vec![0.0; tree.dof()])?;
    Ok(goal_at(model, &node, q))
}

/// The same where the kinematics of `q` are known.
pub(crate) fn goal_at(model: &ControllerModel, node: &NodeKinematics, q: &[f64]) -> PostureGoal {
    let point = |p: Option<crate::model::BodyPoint>| {
        p.map_or_else(Vector3::zeros, |p| node.point(p.body, &p.position).0)
    };
    let rotation = model.swing_foot.map_or_else(Matrix3::identity, |p| node.link_pose_w(p.body).rotation);
    PostureGoal {
        q: q.to_vec(),
        com: node.com(),
        hand: point(model.hand),
        swing_foot: point(model.swing_foot),
        swing_foot_rotation: rotation,
    }
}

/// The balanced posture nearest to `home` with the hand at `ball`.
///
/// # Errors
/// [`ModelError::Length`] when `home` does not fit the tree.
pub fn reach_posture(
    model: &ControllerModel,
    home: &PostureGoal,
    ball: &Vector3<f64>,
    weights: &TaskWeights,
) -> Result<PostureGoal, ModelError> {
    let tree = &model.tree;
    let n = tree.dof();
    let still = vec![0.0; n];
    let static_weights = TaskWeights {
        posture: weights.posture.max(1e-3),
        // The hand shall be there, not near there.
        hand: 100.0 * weights.hand.max(100.0),
        joint_speed: 0.0,
        com_velocity: [0.0; 3],
        spin: [0.0; 3],
        hand_velocity: 0.0,
        ..weights.clone()
    };
    let tasks = Tasks::new(n, static_weights, model.hand, model.swing_foot);
    let mut targets = TaskTargets::new(n);
    targets.posture.copy_from_slice(&home.q);
    targets.com = home.com;
    targets.hand = *ball;
    targets.hand_activity = 1.0;
    targets.swing_foot = home.swing_foot;
    targets.swing_foot_rotation = home.swing_foot_rotation;

    let mut node = NodeKinematics::new(tree);
    let value =
        |q: &[f64], residuals: &mut Residuals, node: &mut NodeKinematics| -> Result<f64, ModelError> {
            node.update(tree, q, &still)?;
            let posture: f64 = q.iter().zip(&home.q).map(|(a, b)| (a - b) * (a - b)).sum();
            tasks.linearize(tree, node, &targets, 1.0, residuals);
            let cartesian: f64 = (0..residuals.len()).map(|r| residuals.value(r) * residuals.value(r)).sum();
            Ok(tasks.weights.posture * posture + cartesian)
        };
    let mut q = home.q.clone();
    let mut cost = StageCost::new(n, 2 * n, MAX_RESIDUALS, 0);
    let mut best = value(&q, &mut cost.residuals, &mut node)?;
    let mut damping = 1.0;
    let mut scratch = CholeskyScratch::new(n);
    for _ in 0..MAX_STEPS {
        node.update(tree, &q, &still)?;
        tasks.quadratise(tree, &node, (&q, &still), &targets, 1.0, &mut cost);
        let mut block = cost.state_hessian().as_ref().submatrix(0, 0, n, n).to_owned();
        let gradient = cost.state_linear_term();
        let mut step: Vec<f64> = gradient[..n].iter().map(|g| -g).collect();
        for j in 0..n {
            block[(j, j)] += damping;
            // A joint at its limit that wants further out does not move.
            let limit = &model.limits[j];
            let margin = range_margin(limit);
            let blocked = (q[j] <= limit.lower + margin && step[j] < 0.0)
                || (q[j] >= limit.upper - margin && step[j] > 0.0);
            if blocked {
                block[(j, j)] *= 1e12;
                step[j] = 0.0;
            }
        }
        if factor(block.as_mut(), &mut scratch).is_none() {
            damping *= 10.0;
            continue;
        }
        solve_factored(block.as_ref(), &mut step);
        let moved: Vec<f64> = (0..n)
            .map(|j| {
                let limit = &model.limits[j];
                let margin = range_margin(limit);
                let (low, high) = (limit.lower + margin, limit.upper - margin);
                // A home posture beyond the margin may stay, not go further.
                (q[j] + step[j]).clamp(low.min(q[j]), high.max(q[j]))
            })
            .collect();
        let candidate = value(&moved, &mut cost.residuals, &mut node)?;
        if candidate < best {
            let gain = best - candidate;
            (q, best, damping) = (moved, candidate, (damping * 0.3).max(1e-9));
            if gain < 1e-12 * best {
                break;
            }
        } else {
            damping *= 5.0;
            if damping > 1e12 {
                break;
            }
        }
    }
    posture_goal(model, &q)
}

fn range_margin(limit: &crate::model::JointLimits) -> f64 {
    let range = limit.upper - limit.lower;
    if range.is_finite() { RANGE_MARGIN * range } else { 0.0 }
}
