//! Controller to plant: torque, feedback gain, reference point, and how the cycle went.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "shared_memory")]
use iceoryx2::prelude::ZeroCopySend;

use crate::header::message;
use crate::{
    ConstraintKind, CycleReport, Header, LARGEST_COORDINATE, LARGEST_EFFORT, MAX_JOINTS, Message,
    MessageError, check,
};

/// The answer to one [`crate::PlantState`]: an affine feedback law with a time span in which it holds.
///
/// The plant applies, at its own rate, `u = torque + gain [q - q_ref(t); q_dot - q_dot_ref(t)]` between `torque_lower`
/// and `torque_upper` ([`Self::torque_into`]), then its limits. From `valid_from` on the reference moves with constant acceleration, so
/// that a robot on its way is not held back by where it was. The bounds keep what the feedback adds between two commands within what the controller
/// found admissible: those of the stance ankle keep the pressure point in the sole while the robot is being pushed.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[cfg_attr(feature = "shared_memory", derive(ZeroCopySend), type_name("delmpc/Command/v2"))]
pub struct Command {
    /// Type, joint set, run, sequence.
    pub header: Header,
    /// Sequence of the state this command answers; 0: none arrived.
    pub state_sequence: u64,
    /// Time of that state, by the plant's clock (ns).
    pub state_time_ns: u64,
    /// First time at which the command may be applied, by the plant's clock (ns).
    pub valid_from_ns: u64,
    /// Time from which on it may no longer be applied, by the plant's clock (ns).
    pub valid_until_ns: u64,
    /// Joints in use, the first ones of each array.
    pub n_joints: u32,
    /// Outcome of the cycle: [`Verdict`].
    pub verdict: u32,
    /// Rung of the fallback ladder that produced the torque: [`FallbackLevel`].
    pub fallback_level: u32,
    /// Why a state was refused: [`MessageError::code`], or a code of the controller from 100 on; 0: not refused.
    pub reason: u32,
    /// Feed-forward joint torque at the reference point (N m or N).
    pub torque: [f64; MAX_JOINTS],
    /// Least joint torque (N m or N).
    pub torque_lower: [f64; MAX_JOINTS],
    /// Largest joint torque (N m or N).
    pub torque_upper: [f64; MAX_JOINTS],
    /// Reference joint position at `valid_from_ns` (rad or m).
    pub position_ref: [f64; MAX_JOINTS],
    /// Reference joint velocity at `valid_from_ns` (rad/s or m/s).
    pub velocity_ref: [f64; MAX_JOINTS],
    /// Reference joint acceleration (rad/s² or m/s²).
    pub acceleration_ref: [f64; MAX_JOINTS],
    /// Gain rows, one per joint. Column `j` multiplies the position error of joint j, column `MAX_JOINTS + j` its velocity error,
    /// whatever `n_joints` is.
    pub gain: [[f64; 2 * MAX_JOINTS]; MAX_JOINTS],
    /// How the cycle went.
    pub report: CycleReport,
}

message!(Command, "delmpc/Command/v2", b"DMCO", 2);

/// Outcome of a control cycle.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Verdict {
    /// A fresh solution within its time.
    Ok = 0,
    /// The cycle exceeded its time.
    Late = 1,
    /// The constrained problem had no solution.
    Infeasible = 2,
    /// The plant did not move as the model predicted.
    ModelMismatch = 3,
    /// The state was refused; see [`Command::reason`].
    BadState = 4,
}

impl Verdict {
    const ALL: [Self; 5] = [Self::Ok, Self::Late, Self::Infeasible, Self::ModelMismatch, Self::BadState];

    /// The verdict with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|verdict| *verdict as u32 == code)
    }
}

/// The fallback ladder, best first. Controller and plant watchdog use the same levels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u32)]
pub enum FallbackLevel {
    /// A solution of this cycle.
    FreshSolution = 0,
    /// The last plan, shifted in time, with its own gains.
    ShiftedPlan = 1,
    /// Static LQR about the posture.
    StaticLqr = 2,
    /// Gravity compensation and damping.
    GravityHold = 3,
    /// Damping only.
    DampingOnly = 4,
    /// No torque.
    ZeroTorque = 5,
}

impl FallbackLevel {
    const ALL: [Self; 6] = [
        Self::FreshSolution,
        Self::ShiftedPlan,
        Self::StaticLqr,
        Self::GravityHold,
        Self::DampingOnly,
        Self::ZeroTorque,
    ];

    /// The level with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|level| *level as u32 == code)
    }
}

impl Command {
    /// A command of zero torque and zero gain without bounds, with sequence 0, on the last rung of the ladder, valid at no time.
    pub fn new(run_id: u64, joint_set_hash: u64, n_joints: u32) -> Self {
        Self {
            header: Header::new::<Self>(run_id, joint_set_hash),
            n_joints,
            fallback_level: FallbackLevel::ZeroTorque as u32,
            torque_lower: [-LARGEST_EFFORT; MAX_JOINTS],
            torque_upper: [LARGEST_EFFORT; MAX_JOINTS],
            ..Self::zeroed()
        }
    }

    /// Checks everything that can be checked without knowing the past: type, version, joint set and count, codes, the time span,
    /// every number finite and plausible.
    ///
    /// Cost: O(n²) for the gain, no allocation.
    ///
    /// # Errors
    /// The first thing found wrong, by name.
    pub fn validate(&self, expected_joint_set_hash: u64, n_joints: usize) -> Result<(), MessageError> {
        let message = Self::NAME;
        self.header.validate::<Self>(expected_joint_set_hash)?;
        let n = check::joint_count(message, self.n_joints, n_joints)?;
        check::known(message, "verdict", self.verdict, self.verdict())?;
        check::known(message, "fallback_level", self.fallback_level, self.fallback_level())?;
        if self.valid_from_ns > self.valid_until_ns {
            let (from_ns, until_ns) = (self.valid_from_ns, self.valid_until_ns);
            return Err(MessageError::EmptyInterval { message, from_ns, until_ns });
        }

        check::plausible(message, "torque", &self.torque[..n], LARGEST_EFFORT)?;
        check::plausible(message, "torque_lower", &self.torque_lower[..n], LARGEST_EFFORT)?;
        check::plausible(message, "torque_upper", &self.torque_upper[..n], LARGEST_EFFORT)?;
        for (index, (lower, upper)) in self.torque_lower[..n].iter().zip(&self.torque_upper).enumerate() {
            if lower > upper {
                return Err(MessageError::EmptyBounds { message, index, lower: *lower, upper: *upper });
            }
        }
        check::plausible(message, "position_ref", &self.position_ref[..n], LARGEST_COORDINATE)?;
        check::plausible(message, "velocity_ref", &self.velocity_ref[..n], LARGEST_COORDINATE)?;
        check::plausible(message, "acceleration_ref", &self.acceleration_ref[..n], LARGEST_EFFORT)?;
        for (row, gain) in self.gain[..n].iter().enumerate() {
            for column in (0..n).chain(MAX_JOINTS..MAX_JOINTS + n) {
                let index = row * 2 * MAX_JOINTS + column;
                check::plausible_one(message, "gain", index, gain[column], LARGEST_EFFORT)?;
            }
        }

        let report = &self.report;
        check::plausible(message, "report.worst_violation", &[report.worst_violation], f64::MAX)?;
        let kind: Option<ConstraintKind> = report.worst_constraint();
        check::known(message, "report.worst_constraint", report.worst_constraint, kind)?;
        Ok(())
    }

    /// The outcome of the cycle, if the code is known.
    pub fn verdict(&self) -> Option<Verdict> {
        Verdict::from_code(self.verdict)
    }

    /// The rung of the fallback ladder, if the code is known.
    pub fn fallback_level(&self) -> Option<FallbackLevel> {
        FallbackLevel::from_code(self.fallback_level)
    }

    /// Whether the command may be applied at a time of the plant's clock.
    pub fn is_valid_at(&self, plant_time_ns: u64) -> bool {
        (self.valid_from_ns..self.valid_until_ns).contains(&plant_time_ns)
    }

    /// The torque of the feedback law at a measured state: `u = torque + gain [q - q_ref(t); q_dot - q_dot_ref(t)]` within its bounds,
    /// `time_ns` by the plant's clock. Before and after its time the reference stands where it began and ended.
    ///
    /// Cost: O(n²), no allocation. Call it on a validated command.
    ///
    /// # Errors
    /// [`MessageError::WrongLength`] when a slice has another length than `n_joints`; `torque` is untouched then.
    pub fn torque_into(
        &self,
        time_ns: u64,
        position: &[f64],
        velocity: &[f64],
        torque: &mut [f64],
    ) -> Result<(), MessageError> {
        let n = check::joint_count(Self::NAME, self.n_joints, self.n_joints as usize)?;
        for (argument, found) in
            [("position", position.len()), ("velocity", velocity.len()), ("torque", torque.len())]
        {
            if found != n {
                return Err(MessageError::WrongLength { message: Self::NAME, argument, found, expected: n });
            }
        }
        let elapsed_ns = time_ns.min(self.valid_until_ns).saturating_sub(self.valid_from_ns);
        let elapsed_s = elapsed_ns as f64 * 1e-9;
        for (i, torque) in torque.iter_mut().enumerate() {
            let (position_gain, velocity_gain) = self.gain[i].split_at(MAX_JOINTS);
            *torque = self.torque[i];
            for j in 0..n {
                let (speed, acceleration) = (self.velocity_ref[j], self.acceleration_ref[j]);
                let way = elapsed_s * (speed + 0.5 * elapsed_s * acceleration);
                *torque += position_gain[j] * (position[j] - self.position_ref[j] - way);
                *torque += velocity_gain[j] * (velocity[j] - speed - elapsed_s * acceleration);
            }
            *torque = torque.max(self.torque_lower[i]).min(self.torque_upper[i]);
        }
        Ok(())
    }
}
