//! Joint stops: a spring and a damper at either end of a joint's range, which only push back.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `q_l`, `q_u` | range | rad |
//! | `I` | `1/(M⁻¹)_jj` of the floating robot: what the joint moves when nothing else is held | kg m² |
//! | `k`, `d` | stiffness and damping of a stop | N m/rad, N m s/rad |
//!
//! ```text
//! x = q + Δt q̇ - q_u        u = -max(0, k x + d q̇)    for x > 0        (and the mirror image at q_l)
//! k = κ I/Δt²        d = δ I/Δt        κ = 1/4, δ = 1/2
//! ```
//!
//! held over the step. With the position at its end in the spring this is the symplectic Euler step of a damped oscillator: a mode of the
//! robot in which the stops see `λ` times the inverse inertia they are made for is stable while `(3κ + 2δ) λ < 4`, up to `λ = 2.28`: several
//! stops reached at once, and postures other than the start's, may go together. `I` is the least inertia the joint can meet, for an ankle
//! that of a foot in the air; where the foot stands on the ground and the whole robot falls on that ankle, its stop gives by up to 0.2 rad.
//!
//! (m, N/m and so on for prismatic joints.)
//!
//! Source: stability of the sampled oscillator: E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2006, section I.1.4.

use delmpc_mechanics::state::State;
use delmpc_mechanics::tree::KinematicTree;

use crate::error::{PlantError, require, require_length};
use crate::watchdog_gains::joint_inverse_inertia;

/// `κ`.
const STIFFNESS: f64 = 0.25;
/// `δ`.
const DAMPING: f64 = 0.5;

/// The stops of all joints.
#[derive(Clone, Debug)]
pub struct JointStops {
    time_step: f64,
    ranges: Vec<[f64; 2]>,
    stiffness: Vec<f64>,
    damping: Vec<f64>,
    torque: Vec<f64>,
}

impl JointStops {
    /// Stops at `ranges` (lower, upper; infinite: none), stiff for steps of `time_step` (s) of `tree` about `state`. No ranges: no stops.
    ///
    /// # Errors
    /// [`PlantError`] for another number of ranges than joints, a range without inside, or a mass matrix that is singular.
    pub fn new(
        tree: &KinematicTree,
        state: &State,
        time_step: f64,
        ranges: &[[f64; 2]],
    ) -> Result<Self, PlantError> {
        let joints = tree.joint_count();
        let ranges = if ranges.is_empty() {
            vec![[f64::NEG_INFINITY, f64::INFINITY]; joints]
        } else {
            ranges.to_vec()
        };
        require_length("joint ranges", ranges.len(), joints)?;
        for [lower, upper] in &ranges {
            require(lower <= upper, "range of a joint", upper - lower, "at least 0")?;
        }
        let inverse = joint_inverse_inertia(tree, state)?;
        let inertia = |joint: usize| 1.0 / inverse[(joint, joint)];
        Ok(Self {
            time_step,
            ranges,
            stiffness: (0..joints).map(|j| STIFFNESS * inertia(j) / (time_step * time_step)).collect(),
            damping: (0..joints).map(|j| DAMPING * inertia(j) / time_step).collect(),
            torque: vec![0.0; joints],
        })
    }

    /// Computes the torques of the stops for the next step, N m, from positions and rates. No allocation.
    pub fn update(&mut self, q: &[f64], rate: &[f64]) -> &[f64] {
        let Self { time_step, ranges, stiffness, damping, torque } = self;
        for (j, torque) in torque.iter_mut().enumerate() {
            let [lower, upper] = ranges[j];
            let end = q[j] + *time_step * rate[j];
            let push = |beyond: f64, outwards: f64| (stiffness[j] * beyond + damping[j] * outwards).max(0.0);
            *torque = if end > upper {
                -push(end - upper, rate[j])
            } else if end < lower {
                push(lower - end, -rate[j])
            } else {
                0.0
            };
        }
        torque
    }

    /// The torques of the last step, N m.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }
}

#[cfg(test)]
mod tests {
    use delmpc_mechanics::prelude::*;

    use super::*;
    use crate::prelude::*;

    /// A base with an arm of two rods, all in free fall, whose joints run into their stops at 8 and 6 rad/s.
    fn arm(ranges: Vec<[f64; 2]>) -> Plant {
        let inertia = Matrix3::from_diagonal(&Vector3::new(0.02, 0.02, 0.001));
        let body = LinkInertia::new(8.0, Vector3::zeros(), Matrix3::identity() * 0.2);
        let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.2), inertia);
        let mut builder = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), body);
        let upper =
            builder.add(Body::new(Some(0), Joint::revolute(Vector3::y(), RigidTransform::identity()), rod));
        let elbow = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.4));
        builder.add(Body::new(Some(upper), Joint::revolute(Vector3::y(), elbow), rod));
        let tree = builder.build().unwrap();
        let mut state = State::zeros(&tree);
        state.base_pose.translation.z = 100.0;
        let rule = LobattoRule::new(2).unwrap();
        let mut integrator = Integrator::new(&tree, &rule, 1e-3, StepOptions::default()).unwrap();
        integrator
            .velocities()
            .set_velocity(&tree, &mut state, &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, 6.0])
            .unwrap();
        let model = PlantModel { contacts: vec![], feet: vec![], joint_set_hash: 0, tree };
        let config = PlantConfig { joint_ranges: ranges, ..PlantConfig::default() };
        Plant::new(&model, &config, &state).unwrap()
    }

    #[test]
    fn a_joint_that_runs_into_its_stop_stays_within_its_range_and_no_energy_comes_from_it() {
        let mut plant = arm(vec![[-0.5, 0.7], [-0.6, 0.4]]);
        let start = plant.monitor().totals().energy;
        let mut beyond: f64 = 0.0;
        for _ in 0..1500 {
            plant.step().unwrap();
            for (q, [lower, upper]) in plant.state().q.iter().zip([[-0.5, 0.7], [-0.6, 0.4]]) {
                beyond = beyond.max(q - upper).max(lower - q);
            }
        }
        let totals = plant.monitor().totals();
        assert!(beyond > 1e-3 && beyond < 0.02, "both stops were reached: {beyond} rad beyond");
        assert!(totals.stop_work < -1.0 && totals.energy < start, "{totals:?}");
        // The stops are in the balance: what the energy lost is their work, all else is free fall.
        let missed = totals.energy - start - totals.stop_work;
        assert!(missed.abs() < 1e-6 * start.abs(), "{missed} J of {}", totals.stop_work);
    }

    #[test]
    fn without_ranges_nothing_stops_it() {
        let mut plant = arm(vec![]);
        for _ in 0..500 {
            plant.step().unwrap();
        }
        assert!(plant.state().q[0] > 1.0, "{:?}", plant.state().q);
        assert_eq!(plant.monitor().totals().stop_work, 0.0);
    }

    /// `x⁺ = x + Δt q̇⁺`, `q̇⁺ = q̇ - λ u Δt/I`, without the sign's condition: what is left after 2000 steps of a mode.
    #[test]
    fn a_mode_decays_up_to_more_than_twice_the_inverse_inertia_the_stops_are_made_for() {
        for lambda in [0.01, 0.1, 0.5, 1.0, 1.5, 2.0, 2.2] {
            let (mut x, mut rate): (f64, f64) = (1.0, 0.0);
            for _ in 0..2000 {
                rate -= lambda * (STIFFNESS * (x + rate) + DAMPING * rate);
                x += rate;
            }
            let left = x.abs().max(rate.abs());
            assert!(left < 0.05, "{lambda}: {left}");
        }
    }

    #[test]
    fn ranges_that_make_no_sense_are_refused() {
        let plant = arm(vec![]);
        let tree = plant.tree();
        let state = plant.state();
        assert!(JointStops::new(tree, state, 1e-3, &[[0.0, 1.0]]).is_err());
        assert!(JointStops::new(tree, state, 1e-3, &[[0.0, 1.0], [1.0, 0.5]]).is_err());
        assert!(JointStops::new(tree, state, 1e-3, &[[0.0, f64::NAN], [0.0, 1.0]]).is_err());
    }
}
