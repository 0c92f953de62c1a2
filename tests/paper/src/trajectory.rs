//! All integrators behind one face: from an initial condition to the end of a time span.
//!
//! The implicit ones stop iterating at an accuracy that their caller gives. [`matched_accuracy`] follows the error of the discretisation, so
//! that a comparison of errors pays for no digits that the method does not have.

use delmpc_mechanics::prelude::*;
use delmpc_mechanics::step::NewtonVariant;

use crate::Failure;
use crate::hermite_simpson::{HermiteSimpson, Layout};
use crate::pendulum::Initial;
use crate::runge_kutta::{Adaptive, ClassicalRk4, GaussLegendre4, Pair};
use crate::stopwatch::once;

/// An integrator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// The variational integrator with `s` unknown nodes.
    Variational(usize),
    /// Hermite-Simpson collocation, reduced to accelerations.
    HermiteSimpson,
    /// Hermite-Simpson collocation, all unknowns kept.
    HermiteSimpsonFull,
    /// Classical Runge-Kutta.
    Rk4,
    /// Gauss-Legendre of order 4.
    Gauss4,
    /// Dormand-Prince 5(4), adaptive.
    DormandPrince,
    /// Runge-Kutta-Fehlberg 7(8), adaptive.
    Fehlberg,
}

impl Method {
    /// Order of an implicit method; `None` for the explicit ones, which do not iterate.
    fn implicit_order(self) -> Option<i32> {
        match self {
            Self::Variational(s) => Some(2 * s as i32),
            Self::HermiteSimpson | Self::HermiteSimpsonFull | Self::Gauss4 => Some(4),
            Self::Rk4 | Self::DormandPrince | Self::Fehlberg => None,
        }
    }

    /// Name in files.
    pub fn key(self) -> String {
        match self {
            Self::Variational(s) => format!("variational_s{s}"),
            Self::HermiteSimpson => "hermite_simpson".into(),
            Self::HermiteSimpsonFull => "hermite_simpson_full".into(),
            Self::Rk4 => "rk4".into(),
            Self::Gauss4 => "gauss_legendre_4".into(),
            Self::DormandPrince => "dormand_prince_54".into(),
            Self::Fehlberg => "fehlberg_78".into(),
        }
    }

    /// Name in plots.
    pub fn title(self) -> String {
        match self {
            Self::Variational(1) => "trapezoidal (s = 1)".into(),
            Self::Variational(2) => "Simpson (s = 2)".into(),
            Self::Variational(s) => format!("s = {s}"),
            Self::HermiteSimpson => "Hermite-Simpson, reduced".into(),
            Self::HermiteSimpsonFull => "Hermite-Simpson, full".into(),
            Self::Rk4 => "RK4".into(),
            Self::Gauss4 => "Gauss-Legendre 4".into(),
            Self::DormandPrince => "Dormand-Prince 5(4)".into(),
            Self::Fehlberg => "Fehlberg 7(8)".into(),
        }
    }
}

/// The end of a run.
#[derive(Clone, Debug)]
pub struct Run {
    /// Angles, rad.
    pub q: Vec<f64>,
    /// Time of the stepping, s.
    pub seconds: f64,
}

/// The accuracy of round-off, rad.
pub const ROUND_OFF: f64 = 1e-16;
/// Largest matched accuracy, rad.
const COARSEST: f64 = 1e-9;
/// Accuracy (rad) where the error of 12 links after 10 s is 1e-6 rad: it changes this error by a few per cent at most. What is left of
/// the angles reaches the momenta of the integrator times the time step, but the rates of the others divided by it: they need more
/// (at the integrator's accuracy the error of Hermite-Simpson doubles).
const AT_A_MICRORADIAN: f64 = 1e-11;
const RIVALS_AT_A_MICRORADIAN: f64 = 1e-13;
/// Time steps (s) where methods of order 2, 4, 6, ... have that error.
const MICRORADIAN_STEPS: [f64; 7] = [1e-5, 1.6e-3, 6e-3, 12.5e-3, 20e-3, 27e-3, 33e-3];

/// The accuracy (rad) at which a method stops iterating in steps of `time_step` (s): as the local error `Δt^(order + 1)`, far below it.
pub fn matched_accuracy(method: Method, time_step: f64) -> f64 {
    let Some(order) = method.implicit_order() else { return ROUND_OFF };
    let place = (order as usize / 2 - 1).min(MICRORADIAN_STEPS.len() - 1);
    let share = (time_step / MICRORADIAN_STEPS[place]).powi(order + 1);
    let own = matches!(method, Method::Variational(_));
    let at_a_microradian = if own { AT_A_MICRORADIAN } else { RIVALS_AT_A_MICRORADIAN };
    (at_a_microradian * share).clamp(ROUND_OFF, COARSEST)
}

/// From this many unknown nodes on a factorisation of the Newton matrix costs more than the iterations it saves.
const INERTIAL_FROM: usize = 4;

/// Runs from `initial` over `duration` (s); `parameter` is the time step (s) or, for adaptive methods, the tolerance. `accuracy` (rad):
/// where implicit methods stop iterating.
///
/// # Errors
/// A step that fails.
pub fn run(
    tree: &KinematicTree,
    method: Method,
    parameter: f64,
    initial: &Initial,
    duration: f64,
    accuracy: f64,
) -> Result<Run, Failure> {
    let steps = (duration / parameter).round() as usize;
    let (seconds, q) = match method {
        Method::Variational(s) => {
            let rule = LobattoRule::new(s)?;
            let variant = if s < INERTIAL_FROM { NewtonVariant::Broyden } else { NewtonVariant::Inertial };
            let options = StepOptions { accuracy, variant, ..StepOptions::default() };
            let mut integrator = Integrator::new(tree, &rule, parameter, options)?;
            let mut state = State::zeros(tree);
            state.q.copy_from_slice(&initial.q);
            integrator.velocities().set_velocity(tree, &mut state, &initial.v)?;
            let zero = vec![0.0; tree.dof()];
            let forces = StepForces::held(&zero);
            let (seconds, outcome) =
                once(|| (0..steps).try_for_each(|_| integrator.step(tree, &mut state, &forces).map(|_| ())));
            outcome?;
            (seconds, state.q)
        }
        Method::HermiteSimpson | Method::HermiteSimpsonFull => {
            let layout = if method == Method::HermiteSimpson { Layout::Reduced } else { Layout::Full };
            let mut work = HermiteSimpson::new(tree, parameter, layout, accuracy)?;
            work.begin(&initial.q, &initial.v);
            let (seconds, outcome) = once(|| (0..steps).try_for_each(|_| work.step()));
            outcome?;
            (seconds, work.q)
        }
        Method::Rk4 => {
            let mut work = ClassicalRk4::new(tree, parameter)?;
            work.begin(&initial.q, &initial.v);
            let (seconds, ()) = once(|| (0..steps).for_each(|_| work.step()));
            (seconds, work.q().to_vec())
        }
        Method::Gauss4 => {
            let mut work = GaussLegendre4::new(tree, parameter, accuracy)?;
            work.begin(&initial.q, &initial.v);
            let (seconds, converged) = once(|| (0..steps).fold(true, |all, _| work.step() && all));
            if !converged {
                return Err(Failure::FixedPoint { time_step: parameter });
            }
            (seconds, work.q().to_vec())
        }
        Method::DormandPrince | Method::Fehlberg => {
            let pair = if method == Method::Fehlberg { Pair::Fehlberg78 } else { Pair::DormandPrince54 };
            let mut work = Adaptive::new(tree, pair, parameter)?;
            let (seconds, outcome) = once(|| work.run(&initial.q, &initial.v, duration));
            outcome?;
            (seconds, work.q().to_vec())
        }
    };
    Ok(Run { q, seconds })
}

/// Largest absolute difference.
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0f64, |m, (x, y)| m.max((x - y).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pendulum::{Links, initial_conditions, pendulum};

    /// All methods come to the same end, each within its own error.
    #[test]
    fn all_methods_agree_with_the_integrator() {
        let tree = pendulum(Links::Rods, 6).unwrap();
        let initial = &initial_conditions(6, 1, 0.3, 2)[0];
        let end = run(&tree, Method::Variational(6), 5e-3, initial, 0.5, ROUND_OFF).unwrap().q;
        for (method, parameter, error) in [
            (Method::Variational(1), 5e-4, 1e-4),
            (Method::Variational(2), 2e-3, 1e-7),
            (Method::Variational(3), 5e-3, 1e-8),
            (Method::HermiteSimpson, 2e-3, 1e-7),
            (Method::HermiteSimpsonFull, 2e-3, 1e-7),
            (Method::Rk4, 1e-3, 1e-7),
            (Method::Gauss4, 2e-3, 1e-7),
            (Method::DormandPrince, 1e-11, 1e-8),
            (Method::Fehlberg, 1e-11, 1e-8),
        ] {
            let accuracy = matched_accuracy(method, parameter);
            let other = run(&tree, method, parameter, initial, 0.5, accuracy).unwrap().q;
            let apart = distance(&end, &other);
            assert!(apart < error, "{}: {apart:e}", method.key());
        }
    }
}
