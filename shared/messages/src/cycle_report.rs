//! How one control cycle went.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

/// Times, counts and the worst constraint of one control cycle. Travels inside every [`crate::Command`].
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/CycleReport/v1"))]
pub struct CycleReport {
    /// Taking the state in: receive, validate, change of coordinates (ns).
    pub state_in_ns: u64,
    /// Shifting the last solution in time (ns).
    pub shift_ns: u64,
    /// Linearising every stage (ns).
    pub linearize_ns: u64,
    /// Riccati recursion (ns).
    pub riccati_ns: u64,
    /// Constrained QP, all rounds (ns).
    pub qp_ns: u64,
    /// Publishing the *previous* command: that of this one is not known while it is being written (ns).
    pub publish_ns: u64,
    /// The whole cycle up to publishing (ns).
    pub total_ns: u64,
    /// Largest amount by which a softened constraint gave way, in that constraint's own unit; 0: none did.
    pub worst_violation: f64,
    /// Which constraint that was: [`ConstraintKind`].
    pub worst_constraint: u32,
    /// Its stage of the horizon.
    pub worst_stage: u32,
    /// Its row: the joint for joint and torque limits, otherwise the row within the constraint.
    pub worst_row: u32,
    /// QP solves in this cycle; 0 when no constraint was active.
    pub qp_solves: u32,
    /// Interior-point iterations, summed over the solves.
    pub qp_iterations: u32,
    /// Rows in the last QP that were active.
    pub active_rows: u32,
    /// Violated rows left out because the QP was full.
    pub dropped_rows: u32,
    /// Heap allocations during the cycle.
    pub allocations: u32,
}

impl CycleReport {
    /// The kind of the constraint that gave way most, if the code is known.
    pub fn worst_constraint(&self) -> Option<ConstraintKind> {
        ConstraintKind::from_code(self.worst_constraint)
    }
}

/// The constraints of the control problem.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ConstraintKind {
    /// No constraint.
    None = 0,
    /// Torque limit of a joint (N m or N).
    Torque = 1,
    /// The ground can only push (N).
    Unilateral = 2,
    /// Friction at the stance foot (N).
    Friction = 3,
    /// Centre of pressure inside the sole (N m).
    CentreOfPressure = 4,
    /// Yaw torque at the stance foot (N m).
    YawTorque = 5,
    /// Position limit of a joint (rad or m).
    JointPosition = 6,
    /// Velocity limit of a joint (rad/s or m/s).
    JointVelocity = 7,
}

impl ConstraintKind {
    const ALL: [Self; 8] = [
        Self::None,
        Self::Torque,
        Self::Unilateral,
        Self::Friction,
        Self::CentreOfPressure,
        Self::YawTorque,
        Self::JointPosition,
        Self::JointVelocity,
    ];

    /// The kind with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| *kind as u32 == code)
    }
}
