//! The tangent path: per column one Algorithm T, one solve and one Algorithm T; and the floating base.

use super::{InputHold, LinearStep, Linearizer, StateCoordinates};
use crate::del_residual::DelWorkspace;
use crate::errors::{ModelError, StepError};
use crate::newton_direction::{NewtonDirection, NewtonSolver};
use crate::spatial::{RigidTransform, Twist, Wrench};
use crate::step::Integrator;
use crate::tangent::StartVariation;
use crate::tree::KinematicTree;

impl Linearizer {
    /// The strict O(n²) path: per column one Algorithm T, one solve, one Algorithm T. Fixed base in `(q, p)`, floating base in
    /// `(ε, δq, δπ, δp_j)`.
    ///
    /// # Errors
    /// [`StepError::Singular`] when the factorisation fails; [`ModelError::Unsupported`] for velocity coordinates.
    pub fn linearize_by_tangent(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
    ) -> Result<&LinearStep, StepError> {
        if self.coordinates == StateCoordinates::Velocity {
            let reason = "the tangent path gives momentum coordinates";
            return Err(ModelError::Unsupported { body: 0, reason }.into());
        }
        let (del, solver) = integrator.factor_solution(tree)?;
        let n = tree.dof();
        for column in 0..self.step.matrix.columns() {
            self.tangent_column(tree, del, solver, column, n);
        }
        Ok(&self.step)
    }

    fn tangent_column(
        &mut self,
        tree: &KinematicTree,
        del: &DelWorkspace,
        solver: &mut NewtonSolver,
        column: usize,
        n: usize,
    ) {
        let (s, base) = (self.s, tree.base_dof());
        let start_pose = del.start.base_pose;
        self.tangent.clear();
        let mut start = StartVariation::default();
        if column < base {
            start.base_twist_w = start_pose.transform_twist(&unit_twist(column));
            let momentum = del.start_momentum();
            start.base_momentum_w = momentum.dual_bracket(&start.base_twist_w) * -0.5;
        } else if column < n {
            self.tangent.set(0, column, 1.0);
        } else if column < n + base {
            start.base_momentum_w = start_pose.transform_wrench(&unit_wrench(column - n));
        }
        self.tangent.set_start(start);
        self.tangent.evaluate(tree, del);
        self.tangent.residual_into(tree, del, &mut self.column);
        if (n + base..2 * n).contains(&column) {
            self.column[(column - n) * s] += 1.0;
        }
        let joints = tree.joint_count();
        let input = (column >= 2 * n).then(|| {
            let index = column - 2 * n;
            (index % joints + base, index / joints)
        });
        let step = |alpha: usize| del.rule.weights()[alpha] * del.time_step;
        if let Some((dof, node)) = input {
            for alpha in 0..s {
                if self.hold == InputHold::Held || alpha == node {
                    self.column[dof * s + alpha] += step(alpha);
                }
            }
        }
        for x in &mut self.column {
            *x = -*x;
        }
        solver.solve(tree, &mut self.column);
        for dof in 0..n {
            for gamma in 1..=s {
                self.tangent.set(gamma, dof, self.column[dof * s + gamma - 1]);
            }
        }
        self.tangent.evaluate(tree, del);
        self.tangent.next_momentum_into(tree, del, &mut self.momentum);
        if let Some((dof, node)) = input
            && (self.hold == InputHold::Held || node == s)
        {
            self.momentum[dof] += step(s);
        }
        self.write_column(tree, del, column, n);
    }

    fn write_column(&mut self, tree: &KinematicTree, del: &DelWorkspace, column: usize, n: usize) {
        let (s, base) = (self.s, tree.base_dof());
        let out = &mut self.step.matrix;
        if base > 0 {
            let end_pose: RigidTransform = del.body_pose(0, s);
            let eta = self.tangent.body_variation(0, s);
            let change = Wrench::from_vector(&nalgebra::Vector6::from_column_slice(&self.momentum[..6]));
            let (_, impulse) = del.body_momentum_and_impulse(0, s);
            let momentum = del.base_momentum_before_end() + impulse;
            let pose_error = end_pose.inverse_transform_twist(&eta).to_vector();
            let momentum_error =
                end_pose.inverse_transform_wrench(&(change + momentum.dual_bracket(&eta) * 0.5)).to_vector();
            for k in 0..6 {
                out.set(k, column, pose_error[k]);
                out.set(n + k, column, momentum_error[k]);
            }
        }
        for dof in base..n {
            out.set(dof, column, self.column[dof * s + s - 1]);
            out.set(n + dof, column, self.momentum[dof]);
        }
    }
}

fn unit_twist(k: usize) -> Twist {
    Twist::from_vector(&nalgebra::Vector6::ith(k, 1.0))
}

fn unit_wrench(k: usize) -> Wrench {
    Wrench::from_vector(&nalgebra::Vector6::ith(k, 1.0))
}
