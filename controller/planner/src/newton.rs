//! Newton's method on the augmented-Lagrangian barrier function `Φ` of a whole plan.
//!
//! ```text
//! N1 per stage: J_k, H_k with the curvature multipliers l, A_k = H_k + J_kᵀ D J_k; bounds add to the diagonal
//! N2 factorise the chain (crate::chain)
//! N3 a Cholesky fails: add reg diag(scale^-2), reg := 6 reg, repeat; after success keep reg/4
//! N4 step cap: no position, angle or 3 m/s above 0.5; non-monotone Armijo
//! N5 full step refused: up to 3 second-order corrections with the same factors, then half the step, then 10 reg
//! N6 after an accepted step: l := l + α (l̂ - l) with what the linearised rows say, l̂ = ŷ - D J dx
//! ```
//!
//! N6 decides: with the multipliers of the penalty (`c/δ`) in `H` the curvature is wild far from feasibility.

use crate::barrier::Barrier;
use crate::chain::Chain;
use crate::contact_derivatives::ContactSupport;
use crate::contact_law::Homotopy;
use crate::error::PlanError;
use crate::problem::Problem;
use crate::stage::{Engine, StageValues};
use crate::stage_derivatives::StageDerivatives;

mod views;

/// Largest scaled change of a position, an angle or a velocity in one step.
const STEP_CAP: f64 = 0.5;
/// Sufficient decrease.
const ARMIJO: f64 = 1e-4;
/// Values that the non-monotone search remembers.
const MEMORY: usize = 3;
/// Largest regularisation tried.
const MOST_REGULARISATION: f64 = 1e14;
/// Whole line searches refused in a row, each repeated with a hundred times the regularisation, before a minimisation gives up.
const MOST_REFUSALS: usize = 4;
/// Regularisations tried at one point before a minimisation gives up.
const MOST_ATTEMPTS: usize = 12;
/// Of these, how many with the halvings that are asked for.
const PATIENT_ATTEMPTS: usize = 9;
/// Most halvings of a step.
pub const MOST_HALVINGS: usize = 12;
/// Largest curvature multiplier.
const MOST_CURVATURE: f64 = 1e6;

/// How the Hessian of the DEL rows enters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Curvature {
    /// Exactly, by dual numbers.
    #[default]
    Exact,
    /// Not at all: Gauss-Newton in the DEL rows (contact and clearance curvature kept).
    GaussNewton,
}

/// Effort so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    /// Newton iterations.
    pub iterations: u64,
    /// Evaluations of all rows without derivatives.
    pub evaluations: u64,
    /// Factorisations of the chain.
    pub factorisations: u64,
    /// Steps that a second-order correction saved.
    pub corrections: u64,
}

/// How one minimisation ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Descent {
    /// Largest scaled entry of `∇Φ`.
    pub gradient: f64,
    /// Whether the tolerance was met.
    pub converged: bool,
}

/// A plan under minimisation.
#[derive(Debug)]
pub struct Minimiser<'a> {
    /// The problem.
    pub problem: &'a Problem,
    /// The plan vector.
    pub x: Vec<f64>,
    /// Rows of every stage at `x`.
    pub values: Vec<StageValues>,
    /// Multiplier estimates of the rows.
    pub estimates: Vec<Vec<f64>>,
    /// Multiplier estimates of the lower and upper bounds.
    pub bound_estimates: Vec<[f64; 2]>,
    /// How curvature enters.
    pub curvature: Curvature,
    /// Halvings of a step before it is repeated with more regularisation.
    pub halvings: usize,
    /// Effort so far.
    pub effort: Effort,
    pub(crate) engine: Engine,
    pub(crate) supports: Vec<ContactSupport>,
    pub(crate) derivatives: Vec<StageDerivatives>,
    curvatures: Vec<Vec<f64>>,
    no_curvature: Vec<f64>,
    multipliers: Vec<Vec<f64>>,
    weights: Vec<Vec<f64>>,
    bound_multipliers: Vec<[f64; 2]>,
    trial_values: Vec<StageValues>,
    trial: Vec<f64>,
    gradient: Vec<f64>,
    corrected: Vec<f64>,
    step: Vec<f64>,
    diagonal: Vec<f64>,
    bound_diagonal: Vec<f64>,
    scale: Vec<f64>,
    pub(crate) fixed: Vec<bool>,
    regularisation: f64,
    /// δ of the last minimisation since the multipliers were forgotten.
    pub(crate) last_penalty: f64,
    pub(crate) chain: Chain,
    pub(crate) z: Vec<f64>,
    pub(crate) rows: Vec<f64>,
    scratch: Vec<f64>,
}

impl<'a> Minimiser<'a> {
    /// Creates a minimiser at a guess, with all multipliers zero. Fixed unknowns are set to their values.
    pub fn new(problem: &'a Problem, guess: &[f64]) -> Self {
        let layout = problem.layout;
        let stages = problem.stages;
        let engine = Engine::new(problem);
        let supports: Vec<_> = (0..problem.contacts.len()).map(|i| ContactSupport::new(problem, i)).collect();
        let values = StageValues::new(problem);
        let rows = vec![0.0; problem.row_count()];
        let size = layout.plan(stages);
        let mut scale = vec![1.0; size];
        for k in 0..stages {
            let (inner, ends) = problem.scale.split_at(layout.inner);
            scale[layout.inner_at(k)..layout.inner_at(k + 1)].copy_from_slice(inner);
            let at = layout.boundary_at(stages, k);
            scale[at..at + 2 * layout.boundary].copy_from_slice(ends);
        }
        let fixed: Vec<bool> = (0..size).map(|i| problem.is_fixed(i)).collect();
        let mut x = guess.to_vec();
        for i in 0..size {
            if fixed[i] {
                x[i] = problem.lower[i];
            }
        }
        let widest = supports.iter().map(|s| s.columns.len()).max().unwrap_or(0).max(layout.n);
        Self {
            problem,
            values: vec![values.clone(); stages],
            estimates: vec![rows.clone(); stages],
            bound_estimates: vec![[0.0; 2]; size],
            curvature: Curvature::Exact,
            halvings: MOST_HALVINGS,
            effort: Effort::default(),
            derivatives: vec![StageDerivatives::new(problem, &supports); stages],
            curvatures: vec![rows.clone(); stages],
            no_curvature: rows.clone(),
            multipliers: vec![rows.clone(); stages],
            weights: vec![rows.clone(); stages],
            bound_multipliers: vec![[0.0; 2]; size],
            trial_values: vec![values; stages],
            trial: x.clone(),
            x,
            gradient: vec![0.0; size],
            corrected: vec![0.0; size],
            step: vec![0.0; size],
            diagonal: vec![0.0; size],
            bound_diagonal: vec![0.0; size],
            scale,
            fixed,
            regularisation: 1e-7,
            last_penalty: f64::INFINITY,
            chain: Chain::new(engine.arch, layout, stages),
            z: vec![0.0; layout.stage],
            rows,
            scratch: vec![0.0; widest * widest],
            engine,
            supports,
        }
    }

    /// Sets all multipliers to zero.
    pub fn forget_multipliers(&mut self) {
        for list in self.estimates.iter_mut().chain(&mut self.curvatures) {
            list.fill(0.0);
        }
        self.bound_estimates.fill([0.0; 2]);
        self.last_penalty = f64::INFINITY;
        self.regularisation = 1e-7;
    }

    /// Takes the multipliers of the penalty over as estimates (the update of the augmented Lagrangian).
    pub fn update_multipliers(&mut self) {
        for (estimates, multipliers) in self.estimates.iter_mut().zip(&self.multipliers) {
            estimates.copy_from_slice(multipliers);
        }
        self.bound_estimates.copy_from_slice(&self.bound_multipliers);
    }

    /// Evaluates all rows at `x`.
    pub fn evaluate(&mut self, homotopy: Homotopy) {
        let stages = self.problem.stages;
        for k in 0..stages {
            self.problem.layout.gather(stages, k, &self.x, &mut self.z);
            self.engine.values(self.problem, homotopy, &self.z, k + 1 == stages, &mut self.values[k]);
        }
    }

    /// Largest violation of a row or bound at the last evaluation.
    pub fn violation(&self) -> f64 {
        let equalities = self.problem.equalities();
        let mut worst: f64 = 0.0;
        for values in &self.values {
            for (r, &value) in values.rows.iter().enumerate() {
                let violation = if r < equalities { value.abs() } else { -value };
                worst = worst.max(if violation.is_nan() { f64::INFINITY } else { violation });
            }
        }
        for i in 0..self.x.len() {
            worst = worst.max(self.problem.lower[i] - self.x[i]).max(self.x[i] - self.problem.upper[i]);
        }
        worst
    }

    /// The most violated rows: stage, row, violation.
    pub fn worst_rows(&self, count: usize) -> Vec<(usize, usize, f64)> {
        let equalities = self.problem.equalities();
        let mut all: Vec<(usize, usize, f64)> = Vec::new();
        for (k, values) in self.values.iter().enumerate() {
            for (r, &value) in values.rows.iter().enumerate() {
                let violation = if r < equalities { value.abs() } else { -value };
                if violation > 0.0 {
                    all.push((k, r, violation));
                }
            }
        }
        all.sort_by(|a, b| b.2.total_cmp(&a.2));
        all.truncate(count);
        all
    }

    /// Cost of the plan at the last evaluation.
    pub fn cost(&self) -> f64 {
        self.values.iter().map(|values| values.cost).sum()
    }

    /// Minimises `Φ` from `x`.
    ///
    /// # Errors
    /// [`PlanError::Indefinite`] when no regularisation helps.
    pub fn minimise(
        &mut self,
        homotopy: Homotopy,
        barrier: Barrier,
        most_iterations: usize,
    ) -> Result<Descent, PlanError> {
        let tolerance = 1e-2 * (1e-3 / barrier.delta).min(1.0);
        let mut remembered = Vec::with_capacity(MEMORY);
        let mut refusals = 0;
        let mut descent = Descent { gradient: f64::INFINITY, converged: false };
        for iteration in 0..=most_iterations {
            let value = self.linearise(homotopy, barrier);
            descent.gradient = self.gradient_norm();
            descent.converged = descent.gradient < tolerance;
            if descent.converged || iteration == most_iterations {
                break;
            }
            if remembered.len() == MEMORY {
                remembered.remove(0);
            }
            remembered.push(value);
            self.effort.iterations += 1;
            let bound = remembered.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            match self.step_within(homotopy, barrier, bound)? {
                Some(fraction) => {
                    refusals = 0;
                    self.adapt_regularisation(fraction);
                }
                // After a whole line search: once more, also with what the search remembers moved on.
                None if self.halvings == MOST_HALVINGS && refusals < MOST_REFUSALS => refusals += 1,
                None => break,
            }
        }
        Ok(descent)
    }

    /// One step: a full or half one, or one with more regularisation. Shortening a step by a line search shortens the stiff
    /// directions with the flat ones; regularisation shortens the flat ones only. Returns the fraction taken.
    fn step_within(
        &mut self,
        homotopy: Homotopy,
        barrier: Barrier,
        bound: f64,
    ) -> Result<Option<f64>, PlanError> {
        let whole_search = self.halvings == MOST_HALVINGS;
        let attempts = if whole_search { 1 } else { MOST_ATTEMPTS };
        for attempt in 0..attempts {
            self.factorise()?;
            for i in 0..self.x.len() {
                self.step[i] = if self.fixed[i] { 0.0 } else { -self.gradient[i] };
            }
            self.chain.solve(&mut self.step);
            let halvings = if attempt < PATIENT_ATTEMPTS { self.halvings } else { MOST_HALVINGS };
            if let Some(fraction) = self.search(homotopy, barrier, bound, halvings) {
                return Ok(Some(fraction));
            }
            self.regularisation = if whole_search {
                100.0 * self.regularisation
            } else {
                (10.0 * self.regularisation).max(1e-5)
            };
        }
        Ok(None)
    }

    /// Rows, derivatives, gradient and matrix at `x`; returns `Φ`.
    fn linearise(&mut self, homotopy: Homotopy, barrier: Barrier) -> f64 {
        let problem = self.problem;
        let (stages, layout) = (problem.stages, problem.layout);
        self.gradient.fill(0.0);
        let mut total = 0.0;
        for k in 0..stages {
            layout.gather(stages, k, &self.x, &mut self.z);
            let mut used = &self.curvatures[k];
            if self.curvature == Curvature::GaussNewton {
                self.no_curvature.copy_from_slice(used);
                self.no_curvature[..problem.equalities()].fill(0.0);
                used = &self.no_curvature;
            }
            let (values, derivatives) = (&mut self.values[k], &mut self.derivatives[k]);
            self.engine.derivatives(
                problem,
                &self.supports,
                homotopy,
                &self.z,
                used,
                k + 1 == stages,
                values,
                derivatives,
            );
            total += values.cost;
            let equalities = problem.equalities();
            for r in 0..self.rows.len() {
                let (value, estimate) = (values.rows[r], self.estimates[k][r]);
                let term = if r < equalities {
                    barrier.equation(value, estimate)
                } else {
                    barrier.inequality(value, estimate)
                };
                total += term.value;
                self.multipliers[k][r] = term.multiplier;
                self.weights[k][r] = term.weight;
                self.rows[r] = -term.multiplier;
            }
            self.z.copy_from_slice(&derivatives.cost_gradient);
            derivatives.transposed(problem, &self.supports, &self.rows, &mut self.z);
            layout.scatter_add(stages, k, &self.z, &mut self.gradient);
            let arch = self.engine.arch;
            derivatives.add_penalty(problem, &self.supports, arch, &self.weights[k], &mut self.scratch);
        }
        total + self.linearise_bounds(barrier)
    }

    fn linearise_bounds(&mut self, barrier: Barrier) -> f64 {
        let mut total = 0.0;
        for i in 0..self.x.len() {
            self.bound_diagonal[i] = 0.0;
            if self.fixed[i] {
                self.gradient[i] = 0.0;
                continue;
            }
            let (lower, upper) = (self.problem.lower[i], self.problem.upper[i]);
            for (side, (bound, sign)) in [(lower, 1.0), (upper, -1.0)].into_iter().enumerate() {
                if bound.is_finite() {
                    let term = barrier.inequality(sign * (self.x[i] - bound), self.bound_estimates[i][side]);
                    total += term.value;
                    self.bound_multipliers[i][side] = term.multiplier;
                    self.gradient[i] -= sign * term.multiplier;
                    self.bound_diagonal[i] += term.weight;
                }
            }
        }
        total
    }

    fn gradient_norm(&self) -> f64 {
        let scaled = self.gradient.iter().zip(&self.scale).map(|(g, scale)| (g * scale).abs());
        scaled.fold(0.0, |worst, x| if x.is_nan() { f64::INFINITY } else { worst.max(x) })
    }

    fn factorise(&mut self) -> Result<(), PlanError> {
        let mut regularisation = self.regularisation;
        loop {
            for i in 0..self.diagonal.len() {
                self.diagonal[i] = self.bound_diagonal[i] + regularisation / (self.scale[i] * self.scale[i]);
            }
            self.effort.factorisations += 1;
            let derivatives = &self.derivatives;
            let matrix = |k: usize| derivatives[k].hessian.as_slice();
            match self.chain.factorise(matrix, &self.diagonal, &self.fixed) {
                Ok(()) => break,
                Err(stage) => {
                    regularisation *= 6.0;
                    if regularisation > MOST_REGULARISATION || regularisation.is_nan() {
                        return Err(PlanError::Indefinite { regularisation, stage });
                    }
                }
            }
        }
        self.regularisation = regularisation;
        Ok(())
    }

    /// A full step says that less would do.
    fn adapt_regularisation(&mut self, fraction: f64) {
        let enough = if self.halvings < MOST_HALVINGS { 0.9 } else { 0.3 };
        let factor = if fraction >= enough {
            0.25
        } else if fraction >= 0.05 {
            1.0
        } else {
            6.0
        };
        self.regularisation = (factor * self.regularisation).max(1e-7);
    }

    /// `Φ` at the trial point, whose rows are left in `trial_values`.
    fn trial_value(&mut self, homotopy: Homotopy, barrier: Barrier) -> f64 {
        self.effort.evaluations += 1;
        let problem = self.problem;
        let (stages, equalities) = (problem.stages, problem.equalities());
        let mut total = 0.0;
        for k in 0..stages {
            problem.layout.gather(stages, k, &self.trial, &mut self.z);
            let values = &mut self.trial_values[k];
            self.engine.values(problem, homotopy, &self.z, k + 1 == stages, values);
            total += values.cost;
            let (equations, rest) = values.rows.split_at(equalities);
            let (y, z) = self.estimates[k].split_at(equalities);
            total += equations.iter().zip(y).map(|(&c, &y)| barrier.equation(c, y).value).sum::<f64>();
            total += rest.iter().zip(z).map(|(&g, &z)| barrier.inequality(g, z).value).sum::<f64>();
        }
        for i in 0..self.trial.len() {
            if self.fixed[i] {
                continue;
            }
            let (lower, upper) = (problem.lower[i], problem.upper[i]);
            for (side, (bound, sign)) in [(lower, 1.0), (upper, -1.0)].into_iter().enumerate() {
                if bound.is_finite() {
                    let gap = sign * (self.trial[i] - bound);
                    total += barrier.inequality(gap, self.bound_estimates[i][side]).value;
                }
            }
        }
        total
    }

    /// Largest fraction of the step within the cap.
    fn cap(&self, step: &[f64]) -> f64 {
        let problem = self.problem;
        let (layout, stages) = (problem.layout, problem.stages);
        let mut worst: f64 = 0.0;
        for k in 0..stages {
            for j in 0..layout.n {
                worst = worst.max(step[layout.inner_at(k) + j].abs());
            }
        }
        for k in 0..=stages {
            for j in 0..2 * layout.n {
                let i = layout.boundary_at(stages, k) + j;
                worst = worst.max(step[i].abs() / self.scale[i]);
            }
        }
        if worst > STEP_CAP { STEP_CAP / worst } else { 1.0 }
    }

    /// Moves along the step; returns the fraction taken, none when no decrease was found.
    fn search(&mut self, homotopy: Homotopy, barrier: Barrier, bound: f64, halvings: usize) -> Option<f64> {
        let first = self.cap(&self.step);
        let slope: f64 = self.gradient.iter().zip(&self.step).map(|(g, d)| g * d).sum();
        let mut fraction = first;
        for halving in 0..=halvings {
            for i in 0..self.x.len() {
                self.trial[i] = self.x[i] + fraction * self.step[i];
            }
            let value = self.trial_value(homotopy, barrier);
            // The round-off of Φ hides decreases far below it.
            let slack = 1e-12 * (1.0 + bound.abs());
            if value <= bound + ARMIJO * fraction * slope + slack {
                self.accept(fraction);
                return Some(fraction / first);
            }
            if halving == 0 && self.correct(homotopy, barrier, bound, fraction, slope) {
                return Some(1.0);
            }
            fraction *= 0.5;
        }
        None
    }

    /// Second-order corrections: the rows at the trial point replace their linearisation; the same factors.
    fn correct(
        &mut self,
        homotopy: Homotopy,
        barrier: Barrier,
        bound: f64,
        fraction: f64,
        slope: f64,
    ) -> bool {
        let problem = self.problem;
        let (stages, layout) = (problem.stages, problem.layout);
        for _ in 0..3 {
            self.corrected.copy_from_slice(&self.gradient);
            for k in 0..stages {
                for (i, z) in self.z.iter_mut().enumerate() {
                    let index = if i < layout.inner {
                        layout.inner_at(k) + i
                    } else {
                        layout.boundary_at(stages, k) + i - layout.inner
                    };
                    *z = self.trial[index] - self.x[index];
                }
                let derivatives = &self.derivatives[k];
                derivatives.product(problem, &self.supports, &self.z, &mut self.rows);
                for r in 0..self.rows.len() {
                    let error = self.trial_values[k].rows[r] - self.values[k].rows[r] - self.rows[r];
                    self.rows[r] = self.weights[k][r] * error;
                }
                self.z.fill(0.0);
                derivatives.transposed(problem, &self.supports, &self.rows, &mut self.z);
                layout.scatter_add(stages, k, &self.z, &mut self.corrected);
            }
            for i in 0..self.x.len() {
                self.corrected[i] = if self.fixed[i] { 0.0 } else { -self.corrected[i] };
            }
            self.chain.solve(&mut self.corrected);
            let part = fraction.min(self.cap(&self.corrected));
            for i in 0..self.x.len() {
                self.trial[i] = self.x[i] + part * self.corrected[i];
            }
            let value = self.trial_value(homotopy, barrier);
            if value <= bound + ARMIJO * fraction * slope {
                self.effort.corrections += 1;
                self.accept(part);
                return true;
            }
            if part < fraction || value.is_nan() {
                return false;
            }
        }
        false
    }

    /// Takes the trial point; N6.
    fn accept(&mut self, fraction: f64) {
        let problem = self.problem;
        let (stages, layout) = (problem.stages, problem.layout);
        let equalities = problem.equalities();
        for k in 0..stages {
            layout.gather(stages, k, &self.step, &mut self.z);
            self.derivatives[k].product(problem, &self.supports, &self.z, &mut self.rows);
            for r in 0..self.rows.len() {
                let mut target = self.multipliers[k][r] - self.weights[k][r] * self.rows[r];
                if r >= equalities {
                    target = target.max(0.0);
                }
                let target = target.clamp(-MOST_CURVATURE, MOST_CURVATURE);
                let l = &mut self.curvatures[k][r];
                *l += fraction * (target - *l);
            }
        }
        self.x.copy_from_slice(&self.trial);
    }

    /// `Φ` and its gradient at `x` (for tests: the gradient is that of the free unknowns).
    pub fn value_and_gradient(&mut self, homotopy: Homotopy, barrier: Barrier) -> (f64, &[f64]) {
        let value = self.linearise(homotopy, barrier);
        (value, &self.gradient)
    }
}
