//! The ground-reaction wrench of the stance foot over a stage; the cone it must stay in: [`delmpc_horizon::foot_cone`].
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

use delmpc_lq::lq_problem::LqStage;
use delmpc_lq::panel::Panel;
use delmpc_mechanics::spatial::Wrench;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;

use crate::node_kinematics::NodeKinematics;

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
