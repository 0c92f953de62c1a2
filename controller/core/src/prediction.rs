//! Where the robot will be when a command takes effect: the measured state moved on under the laws that are in force until then.
//!
//! It goes in the steps of the servo, which holds its torque over each and whose gains are too stiff for longer ones. With the mass matrix
//! `M`, bias force `c` (gravity included), joint damping `D` and springs `κ`, one step is
//!
//! ```text
//! (M(q') + ½ Δt D) q̈ = u - c(q', q̇) - D q̇ - κ (q' - q_rest)        q' = q + ½ Δt q̇
//! q⁺ = q + Δt q̇ + ½ Δt² q̈        q̇⁺ = q̇ + Δt q̈
//! ```
//!
//! The laws see velocities as the servo does, as means over its last samples; those before the measurement are the ones predicted then.
//!
//! Midpoint rule in position and damping, which may be strong; explicit in the velocity that `c` depends on, of first order there. Over
//! some milliseconds that costs less accuracy than sensors have, and a third of the time of variational steps. The plan itself is made of
//! those.
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapter 6 (composite rigid bodies, factorisation along branches).

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, bias_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::mass_matrix_factor::MassMatrixFactor;
use delmpc_mechanics::tree::KinematicTree;

use crate::feedback_law::LawHistory;

/// Memory of the steps.
#[derive(Debug)]
pub(crate) struct Prediction {
    servo_period_s: f64,
    kinematics: Kinematics,
    composites: MassMatrixWorkspace,
    bias: InverseDynamicsWorkspace,
    mass_matrix: Vec<f64>,
    factor: MassMatrixFactor,
    /// `x - x_ref`, then `c` and `q'`.
    error: Vec<f64>,
    /// Torque, then acceleration.
    acceleration: Vec<f64>,
    /// The last velocities, those of the servo's mean: rows of a ring, the newest at `newest`.
    velocities: Vec<f64>,
    newest: usize,
    /// Time of the newest one, s of the run.
    newest_s: f64,
    /// The state as a law sees it.
    seen: Vec<f64>,
}

impl Prediction {
    /// For a tree with a fixed base.
    pub fn new(tree: &KinematicTree, servo_period_s: f64, rate_samples: u32) -> Self {
        let n = tree.dof();
        Self {
            servo_period_s,
            kinematics: Kinematics::new(tree),
            composites: MassMatrixWorkspace::new(tree),
            bias: InverseDynamicsWorkspace::new(tree),
            mass_matrix: vec![0.0; n * n],
            factor: MassMatrixFactor::new(tree),
            error: vec![0.0; 2 * n],
            acceleration: vec![0.0; n],
            velocities: vec![0.0; n * rate_samples.max(1) as usize],
            newest: 0,
            newest_s: f64::NEG_INFINITY,
            seen: vec![0.0; 2 * n],
        }
    }

    /// Moves `x = (q, q̇)` at `from_s` (of the run) on by `duration_s`. Cost: O(n d) a step, `d` the depth of the tree, and the gain's
    /// n². No allocation.
    ///
    /// # Errors
    /// When the mass matrix is singular or not finite.
    pub fn advance(
        &mut self,
        tree: &KinematicTree,
        laws: &LawHistory,
        from_s: f64,
        duration_s: f64,
        x: &mut [f64],
    ) -> Result<(), StepError> {
        let steps = libm::ceil(duration_s / self.servo_period_s - 1e-9).max(1.0);
        let time_step = duration_s / steps;
        let n = self.acceleration.len();
        if (from_s - self.newest_s).abs() > 0.5 * self.servo_period_s {
            // Nothing is known of the samples before this one.
            for row in self.velocities.chunks_exact_mut(n) {
                row.copy_from_slice(&x[n..]);
            }
        }
        self.velocities[self.newest * n..(self.newest + 1) * n].copy_from_slice(&x[n..]);
        for step in 0..steps as usize {
            let (elapsed_s, law) = laws.at(from_s + step as f64 * time_step);
            self.see(x);
            law.torque_at(elapsed_s, &self.seen, &mut self.error, &mut self.acceleration);
            self.step(tree, time_step, x)?;
            self.newest = (self.newest + 1) % (self.velocities.len() / n);
            self.velocities[self.newest * n..(self.newest + 1) * n].copy_from_slice(&x[n..]);
        }
        self.newest_s = from_s + duration_s;
        Ok(())
    }

    /// The state as the servo's law sees it: positions of now, velocities as means.
    fn see(&mut self, x: &[f64]) {
        let n = self.acceleration.len();
        let (positions, rates) = self.seen.split_at_mut(n);
        positions.copy_from_slice(&x[..n]);
        rates.fill(0.0);
        let part = n as f64 / self.velocities.len() as f64;
        for row in self.velocities.chunks_exact(n) {
            for (mean, rate) in rates.iter_mut().zip(row) {
                *mean += part * rate;
            }
        }
    }

    /// One step under the torque in `acceleration`.
    fn step(&mut self, tree: &KinematicTree, time_step: f64, x: &mut [f64]) -> Result<(), StepError> {
        let n = tree.dof();
        let (q, q_dot) = x.split_at_mut(n);
        let (bias, middle) = self.error.split_at_mut(n);
        for ((middle, q), rate) in middle.iter_mut().zip(q.iter()).zip(q_dot.iter()) {
            *middle = q + 0.5 * time_step * rate;
        }
        self.kinematics.update(tree, &Configuration::fixed(middle), &Velocity::fixed(q_dot))?;
        mass_matrix_into(tree, &self.kinematics, &mut self.composites, &mut self.mass_matrix)?;
        bias_force_into(tree, &self.kinematics, &mut self.bias, bias)?;
        for (j, body) in tree.bodies().iter().enumerate() {
            let joint = &body.joint;
            self.mass_matrix[j * n + j] += 0.5 * time_step * joint.damping;
            let passive = joint.damping * q_dot[j] + joint.stiffness * (middle[j] - joint.rest);
            self.acceleration[j] -= bias[j] + passive;
        }
        self.factor.factorise(&self.mass_matrix)?;
        self.factor.solve_in_place(&mut self.acceleration)?;
        for ((q, rate), acceleration) in q.iter_mut().zip(q_dot).zip(&self.acceleration) {
            let change = time_step * acceleration;
            *q += time_step * (*rate + 0.5 * change);
            *rate += change;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use delmpc_mechanics::prelude::*;

    use super::*;
    use crate::feedback_law::Law;

    /// Two rods in fast motion, one joint strongly damped, the other on a spring.
    fn pendulum() -> KinematicTree {
        let inertia = Matrix3::from_diagonal(&Vector3::new(0.09, 0.09, 0.002));
        let rod = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.5), inertia);
        let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
        let shoulder = Joint::revolute(Vector3::y(), RigidTransform::identity()).with_spring(30.0, 0.4);
        let upper = builder.add(Body::new(None, shoulder, rod));
        let elbow = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -1.0));
        let elbow = Joint::revolute(Vector3::x(), elbow).with_damping(5.0);
        builder.add(Body::new(Some(upper), elbow, rod));
        builder.build().unwrap()
    }

    #[test]
    fn it_follows_the_variational_integrator_to_first_order_in_the_servo_period() {
        let tree = pendulum();
        let (start, torque) = ([0.6, -0.3, 3.0, -4.0], [5.0, -2.0]);
        let mut laws = LawHistory::new(2, 0.005, 0.005);
        let mut law = Law::new(2);
        let segment = law.restart();
        segment.torque.copy_from_slice(&torque);
        segment.lower.fill(-100.0);
        segment.upper.fill(100.0);
        laws.push(0.0, &law);

        let mut integrator =
            Integrator::new(&tree, &LobattoRule::new(2).unwrap(), 0.001, StepOptions::default()).unwrap();
        let mut state = State::zeros(&tree);
        state.q.copy_from_slice(&start[..2]);
        integrator.velocities().set_velocity(&tree, &mut state, &start[2..]).unwrap();
        for _ in 0..5 {
            integrator.step(&tree, &mut state, &StepForces::held(&torque)).unwrap();
        }
        let mut end = state.q.clone();
        end.extend([0.0; 2]);
        integrator.velocities().velocity_into(&tree, &state, &mut end[2..]).unwrap();

        let error = |servo_period_s: f64| {
            let mut x = start;
            Prediction::new(&tree, servo_period_s, 1).advance(&tree, &laws, 0.0, 0.005, &mut x).unwrap();
            let part =
                |range: core::ops::Range<usize>| range.map(|i| (x[i] - end[i]).abs()).fold(0.0, f64::max);
            (part(0..2), part(2..4))
        };
        let (coarse, fine) = (error(0.001), error(0.0005));
        assert!(coarse.0 < 1e-6 && coarse.1 < 5e-4, "{coarse:?}");
        let orders = [(coarse.0 / fine.0).log2(), (coarse.1 / fine.1).log2()];
        assert!(orders.iter().all(|order| *order > 0.9), "{orders:?}");
    }
}
