//! The ground-reaction wrench of the stance foot over a stage, and the cone it must stay in.
//!
//! **Wrench.** The robot hangs on {0} by a foot that does not move. Euler's laws for everything above the ground, about the origin of
//! {0} (the sole's centre): `Ṗ = W + [c × m g; m g]`. The mean over a stage of length `Δt` is exact up to the mean of `c`:
//!
//! ```text
//! W = (P(x_{k+1}) - P(x_k))/Δt - m [c̄ × g; g]          c̄ = (c_k + c_{k+1})/2 + Δt (ċ_k - ċ_{k+1})/12      (cubic Hermite mean)
//! ```
//!
//! `P` and `c` count the foot too (it has no momentum but weight). Linearised with `x_{k+1} = A x_k + B u_k + d`, this is
//! `W = W_0 + W_z z`, `z = (u, x)`. Joint forces are internal and do not appear.
//!
//! **Cone of a flat foot** with sole polygon in the plane z = 0, friction μ, normal z: with `W = (τ, f)`
//!
//! | rows | |
//! |---|---|
//! | unilateral | `-f_z <= -f_min` |
//! | friction, m sides inscribed in the cone | `cos θ_i f_x + sin θ_i f_y <= μ cos(π/m) f_z` |
//! | pressure point, one per edge with outward normal `(a, b)` and distance `c` | `-a τ_y + b τ_x <= (c - margin) f_z` |
//! | yaw torque about the middle of the sole | `|τ_z| <= κ f_z` |
//!
//! (pressure point `p = (-τ_y, τ_x)/f_z`).
//!
//! Source: M. Vukobratović, B. Borovac, *Zero-moment point*, 2004; S. Caron, Q.-C. Pham, Y. Nakamura, *Stability of surface
//! contacts for humanoid robots*, ICRA 2015, for the shape of the cone.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::spatial::Wrench;
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::ConstraintKind;
use nalgebra::Vector3;

use crate::errors::ControlError;
use crate::node_kinematics::NodeKinematics;
use delmpc_lq::lq_problem::{LqStage, OutputRow, RowTag};
use delmpc_lq::panel::Panel;

/// What a flat foot can transmit.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatFoot {
    /// Corners of the sole in its own frame, counter-clockwise from above, m.
    pub polygon: Vec<[f64; 2]>,
    /// Distance the pressure point keeps from every edge, m.
    pub margin_m: f64,
    /// Coefficient of friction the controller counts on.
    pub friction: f64,
    /// Sides of the friction pyramid.
    pub friction_sides: usize,
    /// Yaw torque per normal force, m.
    pub yaw_arm_m: f64,
    /// Least normal force, N.
    pub min_force_n: f64,
}

/// One row `coefficients · (τ, f) <= bound`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConeRow {
    /// On torque, then force.
    pub coefficients: [f64; 6],
    /// Right-hand side.
    pub bound: f64,
    /// What the row is.
    pub tag: RowTag,
}

/// The rows of a flat foot.
#[derive(Clone, Debug)]
pub struct WrenchCone {
    rows: Vec<ConeRow>,
}

impl WrenchCone {
    /// The cone of `foot` for a robot of `weight` (N). `penalty` is the cost per N of force rows; moment rows count a lever arm
    /// of 0.1 m.
    ///
    /// # Errors
    /// [`ControlError::Value`] for a degenerate polygon or a number out of range.
    pub fn flat_foot(foot: &FlatFoot, weight: f64, penalty: f64) -> Result<Self, ControlError> {
        let check = |quantity, value: f64, good: bool, rule| {
            if good && value.is_finite() {
                Ok(())
            } else {
                Err(ControlError::Value { quantity, index: 0, value, rule })
            }
        };
        check("friction", foot.friction, foot.friction > 0.0, "must be positive")?;
        check("yaw arm", foot.yaw_arm_m, foot.yaw_arm_m > 0.0, "must be positive")?;
        check("least normal force", foot.min_force_n, foot.min_force_n >= 0.0, "must not be negative")?;
        check("weight", weight, weight > 0.0, "must be positive")?;
        check("constraint penalty", penalty, penalty > 0.0, "must be positive")?;
        let sides = foot.friction_sides;
        check("friction sides", sides as f64, (3..=32).contains(&sides), "must be 3 to 32")?;
        check("sole corners", foot.polygon.len() as f64, foot.polygon.len() >= 3, "must be at least 3")?;

        const LEVER: f64 = 0.1;
        let force = |kind: ConstraintKind, row: usize| RowTag {
            label: kind as u32,
            row: row as u32,
            penalty,
            scale: weight,
        };
        let moment = |kind: ConstraintKind, row: usize| RowTag {
            label: kind as u32,
            row: row as u32,
            penalty: penalty / LEVER,
            scale: weight * LEVER,
        };
        let mut rows = vec![ConeRow {
            coefficients: [0.0, 0.0, 0.0, 0.0, 0.0, -1.0],
            bound: -foot.min_force_n,
            tag: force(ConstraintKind::Unilateral, 0),
        }];
        let inscribed = libm::cos(core::f64::consts::PI / sides as f64);
        for i in 0..sides {
            let angle = 2.0 * core::f64::consts::PI * i as f64 / sides as f64;
            rows.push(ConeRow {
                coefficients: [0.0, 0.0, 0.0, libm::cos(angle), libm::sin(angle), -foot.friction * inscribed],
                bound: 0.0,
                tag: force(ConstraintKind::Friction, i),
            });
        }
        for (i, p) in foot.polygon.iter().enumerate() {
            let next = foot.polygon[(i + 1) % foot.polygon.len()];
            let (dx, dy) = (next[0] - p[0], next[1] - p[1]);
            let length = libm::sqrt(dx * dx + dy * dy);
            check("sole edge", length, length > 1e-6, "must have a length")?;
            let (a, b) = (dy / length, -dx / length);
            let reach = a * p[0] + b * p[1] - foot.margin_m;
            check(
                "pressure point margin",
                foot.margin_m,
                reach > 0.0,
                "must leave the sole's centre inside",
            )?;
            rows.push(ConeRow {
                coefficients: [b, -a, 0.0, 0.0, 0.0, -reach],
                bound: 0.0,
                tag: moment(ConstraintKind::CentreOfPressure, i),
            });
        }
        for (i, sign) in [1.0, -1.0].into_iter().enumerate() {
            rows.push(ConeRow {
                coefficients: [0.0, 0.0, sign, 0.0, 0.0, -foot.yaw_arm_m],
                bound: 0.0,
                tag: moment(ConstraintKind::YawTorque, i),
            });
        }
        Ok(Self { rows })
    }

    /// The rows.
    pub fn rows(&self) -> &[ConeRow] {
        &self.rows
    }

    /// The rows on the outputs of a stage, of which the wrench is the first six.
    pub fn output_rows(&self) -> impl Iterator<Item = OutputRow> + '_ {
        self.rows.iter().map(|row| OutputRow { coefficients: row.coefficients.to_vec(), tag: row.tag })
    }
}

/// Components of a wrench.
const COMPONENTS: usize = 6;

/// The wrench of a stage as an affine map of `z = (u, x)`: its outputs.
#[derive(Clone, Debug)]
pub struct StageWrench {
    /// By the state at the end and at the start: one state a column.
    at_end: Panel,
    at_start: Panel,
}

impl StageWrench {
    /// For `n` joints, which are also the inputs.
    pub fn new(n: usize) -> Self {
        Self { at_end: Panel::zeros(COMPONENTS, 2 * n), at_start: Panel::zeros(COMPONENTS, 2 * n) }
    }

    /// Linearises the mean wrench of a stage of `time_step` (s) from the node `start` to the node `end`, and writes it, torque
    /// first, to the first six outputs of `stage`, whose transition and defect it needs.
    pub fn linearize(
        &mut self,
        tree: &KinematicTree,
        start: &NodeKinematics,
        end: &NodeKinematics,
        time_step: f64,
        stage: &mut LqStage,
    ) {
        let n = tree.dof();
        let weight = tree.gravity_w() * tree.total_mass();
        for (node, sign, panel) in [(end, 1.0, &mut self.at_end), (start, -1.0, &mut self.at_start)] {
            for j in 0..n {
                let (by_q, by_rate) = derivative(&weight, node, j, time_step, sign);
                panel.column_mut(j)[..COMPONENTS].copy_from_slice(&by_q);
                panel.column_mut(n + j)[..COMPONENTS].copy_from_slice(&by_rate);
            }
        }
        stage.set_outputs_through_transition(&self.at_end);
        let columns = self.at_start.entries().chunks_exact(self.at_start.stride());
        for row in 0..COMPONENTS {
            let output = stage.output_mut(row);
            for (target, column) in output.by_state.iter_mut().zip(columns.clone()) {
                *target += column[row];
            }
        }
        let mean = mean_wrench(tree, start, end, time_step).to_vector();
        for (row, mean) in mean.iter().enumerate() {
            *stage.output_mut(row).value += mean;
        }
    }
}

/// `∂W/∂q_j` and `∂W/∂q̇_j` of a node, with the other one held; `weight` in N, `sign` 1 for the end of the stage, -1 for its start.
fn derivative(
    weight: &Vector3<f64>,
    node: &NodeKinematics,
    joint: usize,
    time_step: f64,
    sign: f64,
) -> ([f64; COMPONENTS], [f64; COMPONENTS]) {
    let twelfth = sign * time_step / 12.0;
    // Mean of the mass centre: by q half the mass centre, by velocity a twelfth of the step.
    let d_com = node.d_com_d_q(joint) * 0.5 - node.d_com_velocity_d_q(joint) * twelfth;
    let d_com_rate = node.d_com_d_q(joint) * -twelfth;
    let wrench = |d: Wrench, d_mean: Vector3<f64>| {
        let (mut torque, force) = (d.torque * (sign / time_step), d.force * (sign / time_step));
        torque -= d_mean.cross(weight);
        [torque.x, torque.y, torque.z, force.x, force.y, force.z]
    };
    (wrench(node.d_momentum_d_q(joint), d_com), wrench(node.d_momentum_d_rate(joint), d_com_rate))
}

/// The mean wrench of the ground on the robot over a stage between two nodes, about the origin of {0}.
pub fn mean_wrench(
    tree: &KinematicTree,
    start: &NodeKinematics,
    end: &NodeKinematics,
    time_step: f64,
) -> Wrench {
    let mean_com =
        (start.com() + end.com()) * 0.5 + (start.com_velocity() - end.com_velocity()) * (time_step / 12.0);
    let weight = tree.gravity_w() * tree.total_mass();
    let mut wrench = (end.momentum() - start.momentum()) * (1.0 / time_step);
    wrench.torque -= mean_com.cross(&weight);
    wrench.force -= weight;
    wrench
}
