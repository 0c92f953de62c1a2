//! The plan of a floating robot: boundary states, inputs and mean contact forces over the stages of a grid, read at any time.
//!
//! Between boundaries positions are cubic (Hermite) polynomials, those of the base in the chart at the middle of the stage; velocities
//! are linear. So a plan is read where the next cycle has its boundaries, and nothing is simulated.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::contact_stage::BoundaryState;
use delmpc_mechanics::spatial::{exp_rotation, log_rotation};
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::Vector3;

/// States, inputs and forces.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionPlan {
    /// Times of the boundaries, one more than stages, s.
    pub times: Vec<f64>,
    /// States there.
    pub states: Vec<BoundaryState>,
    joints: usize,
    rows: usize,
    inputs: Vec<f64>,
    forces: Vec<f64>,
}

impl MotionPlan {
    /// Room for `stages` stages and contacts with `rows` rows in all. Allocates.
    pub fn new(tree: &KinematicTree, stages: usize, rows: usize) -> Self {
        let joints = tree.joint_count();
        Self {
            times: vec![0.0; stages + 1],
            states: vec![BoundaryState::zeros(tree); stages + 1],
            joints,
            rows,
            inputs: vec![0.0; stages * joints],
            forces: vec![0.0; stages * rows],
        }
    }

    /// Number of stages.
    pub fn stages(&self) -> usize {
        self.times.len() - 1
    }

    /// When it begins, s.
    pub fn start_s(&self) -> f64 {
        self.times[0]
    }

    /// When it ends, s.
    pub fn end_s(&self) -> f64 {
        self.times[self.stages()]
    }

    /// Joint torques of a stage.
    pub fn input(&self, stage: usize) -> &[f64] {
        &self.inputs[stage * self.joints..(stage + 1) * self.joints]
    }

    /// The same, to write.
    pub fn input_mut(&mut self, stage: usize) -> &mut [f64] {
        &mut self.inputs[stage * self.joints..(stage + 1) * self.joints]
    }

    /// Mean contact forces of a stage, rows of all contacts.
    pub fn force(&self, stage: usize) -> &[f64] {
        &self.forces[stage * self.rows..(stage + 1) * self.rows]
    }

    /// The same, to write.
    pub fn force_mut(&mut self, stage: usize) -> &mut [f64] {
        &mut self.forces[stage * self.rows..(stage + 1) * self.rows]
    }

    /// The stage a time lies in, clamped to the plan.
    pub fn stage_at(&self, time_s: f64) -> usize {
        (1..self.stages()).take_while(|&k| self.times[k] <= time_s + 1e-9).count()
    }

    /// The state at a time; before the start and after the end that there.
    pub fn state_at(&self, time_s: f64, state: &mut BoundaryState) {
        let k = self.stage_at(time_s);
        let (start, end) = (&self.states[k], &self.states[k + 1]);
        let length = self.times[k + 1] - self.times[k];
        let c = ((time_s - self.times[k]) / length).clamp(0.0, 1.0);
        // Hermite polynomials of the value at the end and of both slopes.
        let value = c * c * (3.0 - 2.0 * c);
        let slopes = [length * c * (1.0 - c) * (1.0 - c), length * c * c * (c - 1.0)];
        let half = log_rotation(&start.orientation.tr_mul(&end.orientation)) * 0.5;
        let middle = start.orientation * exp_rotation(&half);
        let spin =
            |state: &BoundaryState| -> Vector3<f64> { state.base_velocity_b.fixed_rows::<3>(0).into() };
        let turn = half * (2.0 * value - 1.0) + spin(start) * slopes[0] + spin(end) * slopes[1];
        let linear = |state: &BoundaryState| state.orientation * state.base_velocity_b.fixed_rows::<3>(3);
        state.orientation = middle * exp_rotation(&turn);
        state.position_w = start.position_w * (1.0 - value)
            + end.position_w * value
            + linear(start) * slopes[0]
            + linear(end) * slopes[1];
        for j in 0..self.joints {
            state.q[j] = start.q[j] * (1.0 - value)
                + end.q[j] * value
                + start.rate[j] * slopes[0]
                + end.rate[j] * slopes[1];
            state.rate[j] = start.rate[j] * (1.0 - c) + end.rate[j] * c;
        }
        state.base_velocity_b = start.base_velocity_b * (1.0 - c) + end.base_velocity_b * c;
    }
}

#[cfg(test)]
mod tests {
    use delmpc_mechanics::prelude::{Joint, LinkInertia, RigidTransform, TreeBuilder};
    use delmpc_mechanics::tree::Body;
    use nalgebra::{Matrix3, Vector6};

    use super::*;

    #[test]
    fn boundaries_are_met_and_the_state_moves_at_its_velocity() {
        let inertia = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.1);
        let mut builder = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), inertia);
        builder.add(Body::new(Some(0), Joint::revolute(Vector3::x(), RigidTransform::identity()), inertia));
        let tree = builder.build().unwrap();
        let mut plan = MotionPlan::new(&tree, 2, 0);
        plan.times.copy_from_slice(&[1.0, 1.02, 1.05]);
        let twist = Vector6::new(0.4, -0.3, 0.6, 0.5, 0.1, -0.2);
        for k in 0..3 {
            let t = plan.times[k] - 1.0;
            let state = &mut plan.states[k];
            state.orientation = exp_rotation(&(Vector3::new(0.4, -0.3, 0.6) * t));
            state.position_w = Vector3::new(0.3, 0.0, 0.1) * t;
            state.q[0] = 0.2 * t;
            state.rate[0] = 0.2;
            state.base_velocity_b = twist;
            let linear = state.orientation.transpose() * Vector3::new(0.3, 0.0, 0.1);
            state.base_velocity_b.fixed_rows_mut::<3>(3).copy_from(&linear);
        }
        let mut state = BoundaryState::zeros(&tree);
        for k in 0..3 {
            plan.state_at(plan.times[k], &mut state);
            assert!((state.position_w - plan.states[k].position_w).norm() < 1e-12);
        }
        plan.state_at(1.013, &mut state);
        let expected = exp_rotation(&(Vector3::new(0.4, -0.3, 0.6) * 0.013));
        assert!((state.orientation - expected).norm() < 1e-9);
        assert!((state.position_w - Vector3::new(0.3, 0.0, 0.1) * 0.013).norm() < 1e-9);
        assert!((state.q[0] - 0.2 * 0.013).abs() < 1e-12);
    }
}
