//! Projection of a plan on DEL = 0: a weighted minimum-norm Newton step, repeated.
//!
//! ```text
//! min ½ dxᵀ W dx   subject to   J dx = -c          method of multipliers on the stage chain:
//! ( W + JᵀJ/δ ) dx = -Jᵀ( c/δ + λ ),   λ := λ + ( J dx + c )/δ
//! ```
//!
//! `W⁻¹` is the freedom of an unknown: torques 25, velocities 4, positions 1e-2, impulses the square of the contact's normal
//! impulse (so that a free contact stays free and cones keep), times and slip bounds none. Products change by the size of
//! the residual that is removed: project only after the violation is small.

use crate::contact_law::Homotopy;
use crate::dense::rank_update;
use crate::error::PlanError;
use crate::newton::Minimiser;

/// Penalty of the method of multipliers.
const PENALTY: f64 = 1e-9;
/// Rounds of the method of multipliers in each Newton step.
const ROUNDS: usize = 6;
/// Freedom of torques, velocities, positions.
const FREEDOM: [f64; 3] = [25.0, 4.0, 1e-2];
/// Least freedom of what may move at all.
const LEAST_FREEDOM: f64 = 1e-14;

impl Minimiser<'_> {
    /// Projects `x`; returns the largest DEL row afterwards (scaled as the problem scales its rows).
    ///
    /// # Errors
    /// [`PlanError::Indefinite`] when the rows of a stage are dependent beyond the weights.
    pub fn project(&mut self, homotopy: Homotopy, steps: usize) -> Result<f64, PlanError> {
        for _ in 0..steps {
            self.projection_step(homotopy)?;
        }
        self.evaluate(homotopy);
        let equalities = self.problem.equalities();
        let rows = self.values.iter().flat_map(|values| &values.rows[..equalities]);
        Ok(rows.fold(0.0f64, |worst, row| worst.max(row.abs())))
    }

    fn projection_step(&mut self, homotopy: Homotopy) -> Result<(), PlanError> {
        let problem = self.problem;
        let (stages, layout, equalities) = (problem.stages, problem.layout, problem.equalities());
        let size = self.x.len();
        let (freedom, held) = self.freedom();
        let none = vec![0.0; problem.row_count()];
        for k in 0..stages {
            layout.gather(stages, k, &self.x, &mut self.z);
            let (values, derivatives) = (&mut self.values[k], &mut self.derivatives[k]);
            let last = k + 1 == stages;
            self.engine.derivatives(
                problem,
                &self.supports,
                homotopy,
                &self.z,
                &none,
                last,
                values,
                derivatives,
            );
            derivatives.hessian.fill(0.0);
            let (ld, arch) = (derivatives.ld, self.engine.arch);
            let (hessian, panel) = (&mut derivatives.hessian, &derivatives.panel);
            rank_update(arch, hessian, ld, layout.stage, panel, equalities, 1.0 / PENALTY);
        }
        let diagonal: Vec<f64> = freedom.iter().map(|f| 1.0 / f.max(LEAST_FREEDOM)).collect();
        let derivatives = &self.derivatives;
        self.chain
            .factorise(|k| derivatives[k].hessian.as_slice(), &diagonal, &held)
            .map_err(|stage| PlanError::Indefinite { regularisation: 0.0, stage })?;
        let mut total = vec![0.0; size];
        let mut multipliers = vec![0.0; stages * equalities];
        for round in 0..ROUNDS {
            // The step that remains: gradient W dx + Jᵀ(λ + (c + J dx)/δ).
            let mut right: Vec<f64> = total.iter().zip(&diagonal).map(|(dx, w)| -dx * w).collect();
            for k in 0..stages {
                let lambda = &mut multipliers[k * equalities..(k + 1) * equalities];
                layout.gather(stages, k, &total, &mut self.z);
                self.rows.fill(0.0);
                self.derivatives[k].product(problem, &self.supports, &self.z, &mut self.rows);
                self.rows[equalities..].fill(0.0);
                for r in 0..equalities {
                    let pull = (self.rows[r] + self.values[k].rows[r]) / PENALTY;
                    if round > 0 {
                        lambda[r] += pull;
                    }
                    self.rows[r] = -(lambda[r] + pull);
                }
                self.z.fill(0.0);
                self.derivatives[k].transposed(problem, &self.supports, &self.rows, &mut self.z);
                layout.scatter_add(stages, k, &self.z, &mut right);
            }
            for i in 0..size {
                if held[i] {
                    right[i] = 0.0;
                }
            }
            self.chain.solve(&mut right);
            for (dx, step) in total.iter_mut().zip(&right) {
                *dx += step;
            }
        }
        for (x, dx) in self.x.iter_mut().zip(&total) {
            *x += dx;
        }
        Ok(())
    }

    /// `W⁻¹`, and what does not move.
    fn freedom(&self) -> (Vec<f64>, Vec<bool>) {
        let problem = self.problem;
        let (layout, law) = (problem.layout, &problem.law);
        let mut freedom = vec![0.0; self.x.len()];
        for k in 0..=problem.stages {
            let at = problem.boundary(k);
            freedom[at..at + layout.n].fill(FREEDOM[2]);
            freedom[at + layout.n..at + 2 * layout.n].fill(FREEDOM[1]);
            if k == problem.stages {
                break;
            }
            let at = layout.inner_at(k);
            freedom[at..at + layout.n].fill(FREEDOM[2]);
            freedom[at + layout.n..at + layout.n + layout.inputs].fill(FREEDOM[0]);
            freedom[at + layout.sole(0)..at + layout.sole(0) + layout.wrench].fill(1.0);
            for i in 0..layout.contacts {
                let at = at + layout.contact(i);
                for node in 0..3 {
                    let normal = at + law.normal(node) - law.first_impulse();
                    let free = self.x[normal] * self.x[normal];
                    freedom[normal] = free;
                    for t in 0..law.tangents {
                        freedom[at + law.tangential(node) + t - law.first_impulse()] = free;
                    }
                }
            }
        }
        let held = (0..self.x.len()).map(|i| self.fixed[i] || freedom[i] == 0.0).collect();
        (freedom, held)
    }
}
