//! What a cycle tells about itself beside its law: how the constrained solve went, what is believed of base and feet.

use delmpc_estimation::prelude::BaseEstimate;
use delmpc_lq::projected_qp::ProjectedQpReport;
use delmpc_messages::{Command, StateEstimate, Verdict};
use nalgebra::{Rotation3, UnitQuaternion};

/// A violation beyond this part of a constraint's scale is reported as [`Verdict::Infeasible`].
const GAVE_WAY: f64 = 1e-3;

/// Writes the figures of the constrained solve, and the constraint that gave way most.
pub(crate) fn tell_constraints(report: &ProjectedQpReport, command: &mut Command) {
    let out = &mut command.report;
    out.qp_solves = report.solves;
    out.qp_iterations = report.iterations;
    out.active_rows = report.active_rows;
    out.dropped_rows = report.dropped_rows;
    if let Some(worst) = report.worst.filter(|worst| worst.amount > GAVE_WAY * worst.tag.scale) {
        out.worst_violation = worst.amount;
        out.worst_constraint = worst.tag.label;
        out.worst_stage = u32::from(worst.row.stage);
        out.worst_row = worst.tag.row;
        if command.verdict == Verdict::Ok as u32 {
            command.verdict = Verdict::Infeasible as u32;
        }
    }
}

/// The estimate of the base, and a bit for every foot that carries load, as a message has them.
pub(crate) fn state_estimate(base: &BaseEstimate, loaded: impl Iterator<Item = bool>) -> StateEstimate {
    let rotation = Rotation3::from_matrix_unchecked(base.base_link_pose_w.rotation);
    StateEstimate {
        known: 1,
        feet_loaded: loaded.enumerate().map(|(k, loaded)| u32::from(loaded) << k).sum(),
        base_orientation_w: UnitQuaternion::from_rotation_matrix(&rotation).coords.into(),
        base_angular_velocity_b: base.base_twist_b.angular.into(),
        base_linear_velocity_b: base.base_twist_b.linear.into(),
        gyro_bias: base.gyro_bias.into(),
        accelerometer_bias: base.accelerometer_bias.into(),
    }
}
