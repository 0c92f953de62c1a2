//! The ground-reaction wrench of the stance foot over a stage, and the cone it must stay in where the sole is not level; the rows of the
//! cone: [`delmpc_horizon::foot_cone`].
//!
//! **Wrench.** The robot hangs on {0} by a foot that does not move. Euler's laws for everything above the ground, about the origin of
//! {0} (the sole's centre): `Ṗ = W + [c × m g; m g]`. The mean over a stage of length `Δt` is exact up to the mean of `c`:
//!
//! ```text
//! W = (P(x_{k+1}) - P(x_k))/Δt - m [c̄ × g; g]          c̄ = (c_k + c_{k+1})/2 + Δt (ċ_k - ċ_{k+1})/12      (cubic Hermite mean)
//! ```
//!
//! **Cone.** Its rows `a·τ_s + b·f_s <= e` hold for the wrench about the middle of the real sole in its axes. With that sole at `(R, o)`
//! in {0} they read, on the wrench about the origin of {0},
//!
//! ```text
//! (R a)·τ + (R b - R a × o)·f <= e
//! ```
//!
//! so edges, normal and friction are those of the real sole.
//!
//! `P` and `c` count the foot too (it has no momentum but weight). Linearised with `x_{k+1} = A x_k + B u_k + d`, this is
//! `W = W_0 + W_z z`, `z = (u, x)`. Joint forces are internal and do not appear.

use alloc::vec::Vec;

use delmpc_horizon::foot_cone::WrenchCone;
use delmpc_lq::lq_problem::{LqStage, OutputRow};
use delmpc_lq::panel::Panel;
use delmpc_mechanics::spatial::{RigidTransform, Wrench};
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

/// The rows of the wrench cone of the stance sole, for wherever that is in {0}.
#[derive(Clone, Debug)]
pub(crate) struct SoleCone {
    /// On the wrench about the sole's middle, in its axes: torque, then force.
    rows: Vec<[Vector3<f64>; 2]>,
}

impl SoleCone {
    /// The rows of `cone`.
    pub fn new(cone: &WrenchCone) -> Self {
        let vector = |c: &[f64]| Vector3::new(c[0], c[1], c[2]);
        let rows = cone.rows().iter().map(|row| {
            let (torque, force) = row.coefficients.split_at(3);
            [vector(torque), vector(force)]
        });
        Self { rows: rows.collect() }
    }

    /// Writes the coefficients on the wrench about the origin of {0} for a sole at `sole_pose`. No allocation.
    pub fn place(&self, sole_pose: &RigidTransform, rows: &mut [OutputRow]) {
        for (out, [on_torque, on_force]) in rows.iter_mut().zip(&self.rows) {
            let torque = sole_pose.rotation * on_torque;
            let force = sole_pose.rotation * on_force - torque.cross(&sole_pose.translation);
            for (target, value) in out.coefficients.iter_mut().zip(torque.iter().chain(force.iter())) {
                *target = *value;
            }
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

#[cfg(test)]
mod tests {
    use delmpc_horizon::foot_cone::FlatFoot;
    use delmpc_lq::lq_problem::RowTag;
    use delmpc_mechanics::spatial::exp_rotation;

    use super::*;

    fn cone() -> WrenchCone {
        let foot = FlatFoot {
            polygon: [[0.12, -0.06], [0.12, 0.06], [-0.1, 0.06], [-0.1, -0.06]].to_vec(),
            margin_m: 0.003,
            friction: 0.6,
            friction_sides: 8,
            yaw_arm_m: 0.06,
            min_force_n: 100.0,
        };
        WrenchCone::flat_foot(&foot, 1000.0, 1.0).unwrap()
    }

    fn placed(pose: &RigidTransform) -> Vec<OutputRow> {
        let cone = cone();
        let blank = OutputRow { coefficients: [0.0; 6].to_vec(), tag: RowTag::default() };
        let mut rows: Vec<OutputRow> = cone.rows().iter().map(|_| blank.clone()).collect();
        SoleCone::new(&cone).place(pose, &mut rows);
        rows
    }

    #[test]
    fn a_level_sole_has_the_rows_of_the_flat_foot_to_the_bit() {
        for (row, flat) in placed(&RigidTransform::identity()).iter().zip(cone().rows()) {
            assert_eq!(row.coefficients, flat.coefficients);
        }
    }

    /// A sole turned about an ankle 76 mm above it: whatever wrench its own axes allow or forbid, the rows on {0} say the same.
    #[test]
    fn a_tilted_sole_has_its_own_edges_and_its_own_normal() {
        let rotation = exp_rotation(&Vector3::new(0.07, -0.03, 0.02));
        let ankle = Vector3::new(-0.01, 0.0, 0.076);
        let pose = RigidTransform { rotation, translation: ankle - rotation * ankle };
        assert!(pose.translation.norm() > 0.005, "downhill of the level one");
        let rows = placed(&pose);
        for corner in [[0.117, -0.057], [0.117, 0.057], [-0.097, 0.057], [-0.097, -0.057]] {
            let [x, y] = corner;
            let force_s = Vector3::new(120.0, -80.0, 900.0);
            let point = Vector3::new(x, y, 0.0);
            let in_sole = Wrench::new(point.cross(&force_s), force_s);
            let in_level = pose.transform_wrench(&in_sole);
            let value = |row: &[f64], wrench: &Wrench| -> f64 {
                row.iter().zip(wrench.to_vector().iter()).map(|(a, b)| a * b).sum()
            };
            let mut at_edge = 0;
            for (row, own) in rows.iter().zip(cone().rows()) {
                let (here, there) = (value(&row.coefficients, &in_level), value(&own.coefficients, &in_sole));
                assert!((here - there).abs() < 1e-10, "{here} {there}");
                let edge = own.tag.label == delmpc_messages::ConstraintKind::CentreOfPressure as u32;
                at_edge += usize::from(edge && there.abs() < 1e-10);
            }
            assert_eq!(at_edge, 2, "a corner is on two edges");
        }
    }
}
