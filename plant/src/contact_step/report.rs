//! What goes into a contact step and what it tells: points, options, results.
//!
//! Letters and equations: [`super`].

use super::*;

/// A point of the robot, or a small sphere around it, that may touch the ground.
///
/// A sphere touches with its lowest point, so it rolls: that point is found anew at the begin of every step and held over it, an error
/// of the radius times the square of the angle turned in a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactPoint {
    /// Body index.
    pub body: usize,
    /// Point in the body's link frame, m.
    pub point: Vector3<f64>,
    /// Radius of the sphere around it, m; 0: the point itself touches.
    pub radius: f64,
    /// Friction coefficient of point and ground.
    pub friction: f64,
}

/// What is fixed when a [`ContactStep`] is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactOptions {
    /// Unknown nodes per step: 2 is Simpson's rule.
    pub unknown_nodes: usize,
    /// `β`: share of a penetration that is removed in a step.
    pub correction: f64,
    /// Regularisation of the impulses.
    pub regularisation: Regularisation,
    /// Rounds of Newton's method and contact law.
    pub max_rounds: usize,
    /// Change of the velocities, relative, at which the rounds end.
    pub tolerance: f64,
    /// Most contacts that may touch at the same time; beyond it the deepest ones count.
    pub max_candidates: usize,
    /// Most point forces (pushes) in a step.
    pub max_pushes: usize,
    /// How the ground gives.
    pub ground: GroundGive,
}

/// Spring and damper of the ground under every contact point, along the normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundGive {
    /// `k`, N/m; infinite: rigid.
    pub stiffness: f64,
    /// `d`, N s/m.
    pub damping: f64,
}

impl GroundGive {
    /// Ground that does not give.
    pub const RIGID: Self = Self { stiffness: f64::INFINITY, damping: 0.0 };

    pub(super) fn is_rigid(&self) -> bool {
        self.stiffness == f64::INFINITY
    }
}

impl Default for ContactOptions {
    fn default() -> Self {
        Self {
            unknown_nodes: 2,
            correction: 0.1,
            regularisation: Regularisation::default(),
            max_rounds: 8,
            tolerance: 1e-7,
            max_candidates: 16,
            max_pushes: 4,
            ground: GroundGive::RIGID,
        }
    }
}

/// What happened at one contact in the last step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContactResult {
    /// Whether the contact took part in the contact law.
    pub candidate: bool,
    /// Whether it carries load: normal impulse above `1e-6 m g Δt`.
    pub touching: bool,
    /// Gap at the start, m; infinite without ground.
    pub gap: f64,
    /// Rows: tangents and normal of the ground, in {0}.
    pub frame: Matrix3<f64>,
    /// Impulse of the ground on the robot, in {0}, N·s.
    pub impulse_w: Vector3<f64>,
    /// Its normal part, N·s.
    pub normal_impulse: f64,
    /// `Σ_α w_α x^α`: where the impulse acts in the balance of momentum, m.
    pub mean_point_w: Vector3<f64>,
    /// Place of the point at the start and at the end, in {0}, m.
    pub start_w: Vector3<f64>,
    /// Place at the end, m.
    pub end_w: Vector3<f64>,
    /// Velocity at the end of the step, in {0}, m/s.
    pub velocity_w: Vector3<f64>,
}

/// What a step took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContactReport {
    /// Contacts in the contact law.
    pub candidates: usize,
    /// Rounds of Newton's method and contact law (1 without candidates).
    pub rounds: usize,
    /// Newton iterations in all.
    pub iterations: usize,
    /// Factorisations of the Newton matrix.
    pub factorizations: usize,
    /// Rounds in which all contacts stuck.
    pub stick_solves: u32,
    /// Rounds solved by Newton's method on the law.
    pub newton_solves: u32,
    /// Cone programs solved.
    pub cone_solves: u32,
    /// Interior-point iterations in all.
    pub cone_iterations: u32,
    /// Residual of the contact law of the last round, relative.
    pub law_residual: f64,
    /// Largest change of a contact velocity the last round still wanted, m/s.
    pub velocity_change: f64,
    /// Whether rounds and law converged. If not, the last iterate was kept.
    pub converged: bool,
}
