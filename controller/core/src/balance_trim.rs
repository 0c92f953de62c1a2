//! The trim of the balance: an integral of the error of the pressure point.
//!
//! A controller whose model has its masses in the wrong place stands off balance by a constant amount, and a push finds less sole on one
//! side. What stands still has its pressure point below its mass centre, wherever the model thinks that is; so the reference of the mass
//! centre is shifted until the measured pressure point is where the mass centre should be:
//!
//! ```text
//! p = (-τ_y, τ_x) / f_z        ṫ = clamp(c_ref - p, ±e_max) / T        |t| <= t_max        mass centre aimed at: c_ref + t
//! ```
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `τ`, `f` | wrench of the ground on the stance foot about the origin of {0}, in {0} | N·m, N |
//! | `p` | pressure point | m |
//! | `c_ref` | mass centre of the reference | m |
//! | `t` | trim | m |
//! | `T` | time constant | s |
//!
//! While the joints move, the pressure point is where the motion needs it, not below the mass centre: nothing is learned from a push or a
//! reach. The clamp is for what remains.
//!
//! Source: own formulation of integral action; for its place among the offset-free methods: G. Pannocchia, J. B. Rawlings, *Disturbance
//! models for offset-free model-predictive control*, AIChE Journal 49, 2003.

use nalgebra::{Vector2, Vector3};

/// `e_max`, m.
const LARGEST_ERROR_M: f64 = 0.02;
/// `t_max`, m.
const LARGEST_TRIM_M: f64 = 0.06;
/// Joint rates (root mean square, rad/s or m/s) up to which the robot stands; the noise of good encoders is far below.
const STANDING_RATE: f64 = 0.05;
/// A foot that carries less than this, in N, has no pressure point to speak of.
const LEAST_FORCE_N: f64 = 50.0;

/// The integral.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct BalanceTrim {
    time_constant_s: f64,
    trim: Vector2<f64>,
}

impl BalanceTrim {
    /// With time constant `T` (s); 0: no trim.
    pub fn new(time_constant_s: f64) -> Self {
        Self { time_constant_s, trim: Vector2::zeros() }
    }

    /// `duration_s` more with the mass centre's reference, the measured wrench, and the joint rates; a force of zero is one that is not
    /// measured.
    pub fn update(
        &mut self,
        com_ref: &Vector3<f64>,
        torque: &Vector3<f64>,
        force: &Vector3<f64>,
        rates: &[f64],
        duration_s: f64,
    ) {
        let squares: f64 = rates.iter().map(|rate| rate * rate).sum();
        if force.z < LEAST_FORCE_N || squares > STANDING_RATE * STANDING_RATE * rates.len() as f64 {
            return;
        }
        let pressure = Vector2::new(-torque.y, torque.x) / force.z;
        let error = (com_ref.xy() - pressure).map(|e| e.clamp(-LARGEST_ERROR_M, LARGEST_ERROR_M));
        let trim = self.trim + error * (duration_s / self.time_constant_s);
        if trim.iter().all(|t| t.is_finite()) {
            self.trim = trim.map(|t| t.clamp(-LARGEST_TRIM_M, LARGEST_TRIM_M));
        }
    }

    /// `t`, in {0}.
    pub fn shift(&self) -> Vector3<f64> {
        self.trim.push(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A robot that stands where it is told, off by 15 mm, and its scales.
    fn stand(trim: &mut BalanceTrim, seconds: f64) -> f64 {
        let (com_ref, weight) = (Vector3::new(0.03, 0.01, 1.0), 1000.0);
        for _ in 0..(seconds * 100.0) as usize {
            let com = com_ref + trim.shift() + Vector3::new(0.015, 0.0, 0.0);
            let force = Vector3::new(0.0, 0.0, weight);
            trim.update(&com_ref, &com.cross(&force), &force, &[0.01], 0.01);
        }
        trim.shift().x + 0.015
    }

    #[test]
    fn what_stands_off_balance_is_led_back_within_some_time_constants() {
        let mut trim = BalanceTrim::new(0.5);
        assert!((stand(&mut trim, 0.5) - 0.015 * (-1.0f64).exp()).abs() < 1e-4);
        assert!(stand(&mut trim, 5.0).abs() < 1e-5);
    }

    #[test]
    fn neither_motion_nor_a_hovering_foot_nor_a_time_constant_of_zero_is_learned() {
        let mut trim = BalanceTrim::new(1.0);
        let (com_ref, force, off) =
            (Vector3::zeros(), Vector3::new(0.0, 0.0, 1e3), Vector3::new(300.0, 0.0, 0.0));
        trim.update(&com_ref, &off, &force, &[0.04, 0.0], 0.1);
        let learned = Vector3::new(0.0, -0.1 * LARGEST_ERROR_M, 0.0);
        assert!((trim.shift() - learned).norm() < 1e-12, "no more than the clamp");
        trim.update(&com_ref, &off, &force, &[0.08, 0.0], 1.0);
        trim.update(&com_ref, &off, &Vector3::zeros(), &[0.0; 2], 1.0);
        trim.update(&com_ref, &off, &Vector3::new(0.0, 0.0, f64::NAN), &[0.0; 2], 1.0);
        assert!((trim.shift() - learned).norm() < 1e-12);
        let mut none = BalanceTrim::new(0.0);
        none.update(&com_ref, &off, &force, &[0.0], 0.01);
        assert_eq!(none.shift(), Vector3::zeros());
    }
}
