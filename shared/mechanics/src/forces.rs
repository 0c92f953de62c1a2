//! The forces of the paper's Assumption 1: gravity, joint forces, body wrenches, and wrench laws of the caller's own.
//!
//! | force | where it is given | dependence |
//! |---|---|---|
//! | gravity, joint damping, joint springs, body drag, constant body wrench | the model ([`crate::tree`]) | built in |
//! | actuation | [`JointForces`] | held over the step, or one value per node |
//! | force with a fixed direction in frame {0} at a body point | [`PointForce`] | constant over the step |
//! | anything else on a body | [`WrenchLaw`] | pose and velocity of that body |
//!
//! The derivative of a wrench is its *co-moving* variation `D F := δF + ad^D_F η` with the spatial variation `η` of the pose
//! and `ν` of the velocity: `D F = F_η η + F_ν ν`. For a law `F_b(g, v_b)` given in the body frame, `F = Ad_g⁻ᵀ F_b`,
//!
//! ```text
//! F_η = Ad_g⁻ᵀ (∂F_b/∂g) Ad_g⁻¹      F_ν = Ad_g⁻ᵀ (∂F_b/∂v_b) Ad_g⁻¹      (∂g taken in the body frame, δg = g σ^)
//! ```
//!
//! because `δv = ν - ad_v η` and the change of frame cancel exactly. A wrench that is constant in the body frame has neither;
//! a force `f` constant in {0} at the point `x` has `F_η η = [x×(f×η_ω); f×η_ω]`.

use nalgebra::{Matrix6, Vector3};

use crate::spatial::{RigidTransform, Twist, Wrench};

/// Joint forces (N·m or N) of one step, in joint order.
#[derive(Clone, Copy, Debug)]
pub enum JointForces<'a> {
    /// One value per joint, held over the step (zero-order hold).
    Held(&'a [f64]),
    /// One value per node and joint, node-major: `(s + 1) x joints`.
    PerNode(&'a [f64]),
}

/// A force of fixed direction in frame {0} at a fixed point of a body, held over the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointForce {
    /// Body index.
    pub body: usize,
    /// Point from the body's mass centre, link axes, m.
    pub point_b: Vector3<f64>,
    /// Force in frame {0}, N.
    pub force_w: Vector3<f64>,
}

/// What a [`WrenchLaw`] may look at.
#[derive(Clone, Copy, Debug)]
pub struct BodySample {
    /// Pose of the body frame: link axes, origin at the mass centre.
    pub pose_w: RigidTransform,
    /// Spatial velocity in frame {0}.
    pub velocity_w: Twist,
    /// Time since the start of the step, s.
    pub time: f64,
}

/// What a [`WrenchLaw`] answers.
#[derive(Clone, Copy, Debug)]
pub struct WrenchSample {
    /// Wrench on the body in frame {0}, about the origin of {0}.
    pub wrench_w: Wrench,
    /// Gain `F_η` of the co-moving variation (6 x 6, frame {0}).
    pub d_pose: Matrix6<f64>,
    /// Gain `F_ν` of the co-moving variation (6 x 6, frame {0}).
    pub d_velocity: Matrix6<f64>,
}

/// A wrench that acts on one body and depends on that body's pose and velocity (the paper's Assumption 1).
pub trait WrenchLaw {
    /// The body it acts on.
    fn body(&self) -> usize;
    /// Wrench and gains at one node.
    fn evaluate(&self, sample: &BodySample) -> WrenchSample;
}

/// All forces of one step that are not part of the model.
#[derive(Clone, Copy)]
pub struct StepForces<'a> {
    /// Joint forces.
    pub joints: JointForces<'a>,
    /// Point forces; at most as many as the workspace was made for.
    pub points: &'a [PointForce],
    /// Wrench laws.
    pub laws: &'a [&'a dyn WrenchLaw],
}

impl<'a> StepForces<'a> {
    /// Joint forces held over the step (N·m or N, joint order), nothing else.
    pub fn held(joints: &'a [f64]) -> Self {
        Self { joints: JointForces::Held(joints), points: &[], laws: &[] }
    }

    /// One set of joint forces per node (node-major), nothing else.
    pub fn per_node(joints: &'a [f64]) -> Self {
        Self { joints: JointForces::PerNode(joints), points: &[], laws: &[] }
    }

    /// The same with point forces.
    pub fn with_points(self, points: &'a [PointForce]) -> Self {
        Self { points, ..self }
    }

    /// The same with wrench laws.
    pub fn with_laws(self, laws: &'a [&'a dyn WrenchLaw]) -> Self {
        Self { laws, ..self }
    }
}

impl core::fmt::Debug for StepForces<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("StepForces")
            .field("joints", &self.joints)
            .field("points", &self.points)
            .field("laws", &self.laws.len())
            .finish()
    }
}
