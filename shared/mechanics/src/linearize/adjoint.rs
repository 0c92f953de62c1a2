//! Products with `Aᵀ` and `Bᵀ` by one transposed solve.

use super::{InputHold, Linearizer, StateCoordinates};
use crate::errors::{ModelError, StepError};
use crate::newton_direction::NewtonDirection;
use crate::step::Integrator;
use crate::tree::KinematicTree;

impl Linearizer {
    /// Adjoint products `Aᵀλ` (2n) and `Bᵀλ` (inputs) in `(q, p)` around the step that `integrator` has just solved, by one
    /// transposed solve: O(s² Σ depth) with a factorised Newton matrix. Fixed base. Use it for gradients instead of `A`, `B`.
    ///
    /// # Errors
    /// [`StepError::Singular`] when the factorisation fails; [`ModelError`] for a floating base, velocity coordinates or wrong
    /// lengths.
    pub fn adjoint_into(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
        lambda: &[f64],
        a_lambda: &mut [f64],
        b_lambda: &mut [f64],
    ) -> Result<(), StepError> {
        let (n, s) = (tree.dof(), self.s);
        if tree.is_floating() || self.coordinates == StateCoordinates::Velocity {
            let reason = "adjoint products are in (q, p) of a fixed base";
            return Err(ModelError::Unsupported { body: 0, reason }.into());
        }
        for (quantity, got, expected) in [
            ("lambda", lambda.len(), 2 * n),
            ("a_lambda", a_lambda.len(), 2 * n),
            ("b_lambda", b_lambda.len(), self.step.inputs()),
        ] {
            if got != expected {
                return Err(ModelError::Length { quantity, got, expected }.into());
            }
        }
        let (del, solver) = integrator.factor_solution(tree)?;
        if solver.hessian().is_none() {
            self.hessian.evaluate(tree, del);
        }
        let (lambda_q, lambda_p) = lambda.split_at(n);
        let y = &mut self.column;
        y.fill(0.0);
        a_lambda.fill(0.0);
        {
            let hessian = solver.hessian().unwrap_or(&self.hessian);
            for i in 0..n {
                y[i * s + s - 1] += lambda_q[i];
                for (position, &j) in tree.branch(i).iter().enumerate() {
                    let (j, pair) = (j as usize, hessian.pair_starts[i] + position);
                    for gamma in 1..=s {
                        y[j * s + gamma - 1] += hessian.entry(pair, s, gamma) * lambda_p[i];
                        if i != j {
                            y[i * s + gamma - 1] += hessian.mirrored(pair, s, gamma) * lambda_p[j];
                        }
                    }
                    a_lambda[j] += hessian.entry(pair, s, 0) * lambda_p[i];
                    if i != j {
                        a_lambda[i] += hessian.mirrored(pair, s, 0) * lambda_p[j];
                    }
                }
            }
        }
        solver.solve_transposed(tree, y);
        let hessian = solver.hessian().unwrap_or(&self.hessian);
        let step = |alpha: usize| del.rule.weights()[alpha] * del.time_step;
        b_lambda.fill(0.0);
        for i in 0..n {
            a_lambda[n + i] = -y[i * s];
            for alpha in 0..=s {
                let slot = match self.hold {
                    InputHold::Held => i,
                    InputHold::PerNode => alpha * n + i,
                };
                b_lambda[slot] += step(alpha) * if alpha < s { -y[i * s + alpha] } else { lambda_p[i] };
            }
            for (position, &j) in tree.branch(i).iter().enumerate() {
                let (j, pair) = (j as usize, hessian.pair_starts[i] + position);
                for alpha in 0..s {
                    a_lambda[j] -= hessian.entry(pair, alpha, 0) * y[i * s + alpha];
                    if i != j {
                        a_lambda[i] -= hessian.mirrored(pair, alpha, 0) * y[j * s + alpha];
                    }
                }
            }
        }
        Ok(())
    }
}
