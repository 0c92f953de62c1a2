//! Gains with which a watchdog holds a posture without shaking the robot, and the proof that they do not.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `M` | mass matrix of the floating robot; `I_j = 1/(M⁻¹)_jj`: what joint j moves when nothing else is held | kg m² |
//! | `J_j` | diagonal of the mass matrix of the robot fixed at its stance sole: what joint j carries | kg m² |
//! | `w_h`, `w_m` | frequency a load is held with; the largest for a light link at the servo's rate | rad/s |
//! | `K`, `D` | stiffness and damping, diagonal | N m/rad, N m s/rad |
//!
//! ```text
//! k_j = min(J_j w_h², I_j w_m²)        d_j = 2 ζ min(J_j w_h, I_j w_m)        w_m = 0.1 / Δt
//! q⁺ = q + Δt q̇ + ½ Δt² a        q̇⁺ = q̇ + Δt a        a = -M⁻¹ (K q + D q̇)        held over a period of the servo
//! ```
//!
//! The joint of an unloaded foot moves the foot alone, whatever it carries when it stands; so the load decides what is wanted and the
//! lightest link what is possible. The second line, without gravity, is what the robot does between two samples: its spectral radius is
//! below 1 when no mode of the robot is driven by the law that is to calm it ([`spectral_radius`]).
//!
//! Source: K. Åström, B. Wittenmark, *Computer-Controlled Systems*, 1997, chapter 3 (sampling, zero-order hold).

use delmpc_mechanics::load_response::BoundaryMotion;
use delmpc_mechanics::state::State;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::DMatrix;

use crate::error::{PlantError, require_length};

/// `w_h`, rad/s.
const HOLDING_FREQUENCY: f64 = 12.0;
/// `w_m Δt`.
const LARGEST_STEP: f64 = 0.1;
/// `ζ`.
const DAMPING_RATIO: f64 = 0.7;

/// Stiffness and damping of every joint.
#[derive(Clone, Debug, PartialEq)]
pub struct HoldingGains {
    /// `K`, N m/rad.
    pub stiffness: Vec<f64>,
    /// `D`, N m s/rad.
    pub damping: Vec<f64>,
}

impl HoldingGains {
    /// For the floating `tree` in `state`; `carried` is `J` (kg m², joints in the order of the tree), `period` that of the servo (s).
    ///
    /// # Errors
    /// [`PlantError`] for lengths that do not fit, or a mass matrix that is singular.
    pub fn new(
        tree: &KinematicTree,
        state: &State,
        carried: &[f64],
        period: f64,
    ) -> Result<Self, PlantError> {
        require_length("carried inertias", carried.len(), tree.joint_count())?;
        let inverse = joint_inverse_inertia(tree, state)?;
        let largest = LARGEST_STEP / period;
        let light = |joint: usize| 1.0 / inverse[(joint, joint)];
        let gain = |joint: usize, power: i32| {
            (carried[joint] * HOLDING_FREQUENCY.powi(power)).min(light(joint) * largest.powi(power))
        };
        let joints = 0..carried.len();
        Ok(Self {
            stiffness: joints.clone().map(|joint| gain(joint, 2)).collect(),
            damping: joints.map(|joint| 2.0 * DAMPING_RATIO * gain(joint, 1)).collect(),
        })
    }
}

/// The joints' block of `M⁻¹` of the floating robot: what torques do to joints while the base is free, 1/(kg m²).
///
/// # Errors
/// [`PlantError::Step`] for a singular mass matrix.
pub fn joint_inverse_inertia(tree: &KinematicTree, state: &State) -> Result<DMatrix<f64>, PlantError> {
    let failed = |cause| PlantError::Step { time: 0.0, cause };
    let mut motion = BoundaryMotion::new(tree);
    motion.update(tree, state).map_err(failed)?;
    let (n, base) = (tree.joint_count(), tree.base_dof());
    let mut inverse = DMatrix::zeros(n, n);
    let mut column = vec![0.0; tree.dof()];
    for joint in 0..n {
        column.fill(0.0);
        column[base + joint] = 1.0;
        motion.factor().solve_in_place(&mut column)?;
        inverse.column_mut(joint).copy_from_slice(&column[base..]);
    }
    Ok(inverse)
}

/// Spectral radius of a robot under `u = -K q - D q̇`, held over `period` (s); `inverse` is `M⁻¹` of its joints. `K` and `D` are full, n x n.
/// Without stiffness the positions are left out: they stay where they come to rest.
pub fn spectral_radius(
    inverse: &DMatrix<f64>,
    stiffness: &DMatrix<f64>,
    damping: &DMatrix<f64>,
    period: f64,
) -> f64 {
    let n = inverse.nrows();
    let by_rate = -(inverse * damping);
    let unit = DMatrix::<f64>::identity(n, n);
    let matrix = if stiffness.iter().all(|k| *k == 0.0) {
        unit + by_rate * period
    } else {
        let by_position = -(inverse * stiffness);
        let half = 0.5 * period * period;
        let mut matrix = DMatrix::zeros(2 * n, 2 * n);
        matrix.view_mut((0, 0), (n, n)).copy_from(&(&unit + &by_position * half));
        matrix.view_mut((0, n), (n, n)).copy_from(&(&unit * period + &by_rate * half));
        matrix.view_mut((n, 0), (n, n)).copy_from(&(by_position * period));
        matrix.view_mut((n, n), (n, n)).copy_from(&(unit + by_rate * period));
        matrix
    };
    matrix.complex_eigenvalues().iter().map(|value| value.norm()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn diagonal(values: &[f64]) -> DMatrix<f64> {
        DMatrix::from_diagonal(&nalgebra::DVector::from_column_slice(values))
    }

    #[test]
    fn damping_beyond_two_inertias_a_period_shakes() {
        let none = diagonal(&[0.0]);
        for (damping, radius) in [(500.0, 0.5), (1500.0, 0.5), (2500.0, 1.5)] {
            let found = spectral_radius(&diagonal(&[1.0]), &none, &diagonal(&[damping]), 1e-3);
            assert!((found - radius).abs() < 1e-12, "{damping}: {found}");
        }
    }

    #[test]
    fn an_oscillator_decays_as_it_should() {
        // Of 1 rad/s, damped by 0.1, sampled finely.
        let found = spectral_radius(&diagonal(&[0.5]), &diagonal(&[2.0]), &diagonal(&[0.4]), 1e-3);
        assert!((found - (-0.1e-3_f64).exp()).abs() < 1e-6, "{found}");
    }
}
