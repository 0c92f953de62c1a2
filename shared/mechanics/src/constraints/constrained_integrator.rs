//! C-RATTLE on a set of constraints: step, projection, linearisation on the manifold.
//!
//! Letters and equations: [`super`].

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use super::{Constraint, ConstraintSet, DEPENDENT_ROW, MAX_ITERATIONS};
use crate::del_residual::{DeadLoad, DelWorkspace, ForceCapacity};
use crate::dense_lu::DenseLu;
use crate::errors::{ModelError, StepError};
use crate::forces::StepForces;
use crate::kinetic_hessian::KineticHessian;
use crate::lanes::LANES;
use crate::lobatto::LobattoRule;
use crate::newton_direction::{NewtonDirection, NewtonMethod, NewtonSolver};
use crate::row_matrix::RowMatrix;
use crate::state::State;
use crate::step::StepReport;
use crate::tree::KinematicTree;
use crate::velocity::VelocityWorkspace;

/// The variational integrator of a constrained fixed-base tree.
#[derive(Clone, Debug)]
pub struct ConstrainedIntegrator {
    pub(super) set: ConstraintSet,
    pub(super) del: DelWorkspace,
    pub(super) solver: NewtonSolver,
    pub(super) velocities: VelocityWorkspace,
    /// Index of the first constraint load in the workspace of the step.
    pub(super) first_load: usize,
    /// `λ^0..λ^s`, row α of m.
    pub(super) multipliers: Vec<f64>,
    /// `G` at node α: `m x n` each.
    pub(super) jacobians: Vec<f64>,
    pub(super) residual: Vec<f64>,
    pub(super) defects: Vec<f64>,
    /// `[X_r | X_𝒜]`, or the columns of the linearisation behind `X_𝒜`.
    pub(super) columns: RowMatrix,
    pub(super) schur: DenseLu,
    pub(super) shift: Vec<f64>,
    pub(super) rate: Vec<f64>,
    pub(super) projection: Projection,
    pub(super) next: State,
}

/// `(G M⁻¹ Gᵀ)` and `M⁻¹Gᵀ` at one configuration.
#[derive(Clone, Debug)]
pub(super) struct Projection {
    /// `M⁻¹Gᵀ`, row k holds the column of constraint row k.
    pub(super) inverse: Vec<f64>,
    pub(super) gram: DenseLu,
    pub(super) multiplier: Vec<f64>,
}

impl ConstrainedIntegrator {
    /// For steps of `time_step` (s) of `tree` by `rule` under `constraints`; `method` `None` takes the fastest factorisation.
    ///
    /// # Errors
    /// As [`ConstraintSet::new`] and [`DelWorkspace::new`].
    pub fn new(
        tree: &KinematicTree,
        constraints: &[Constraint],
        rule: &LobattoRule,
        time_step: f64,
        method: Option<NewtonMethod>,
        forces: ForceCapacity,
    ) -> Result<Self, ModelError> {
        let set = ConstraintSet::new(tree, constraints)?;
        let (n, s, m) = (tree.dof(), rule.unknown_nodes(), set.row_count());
        let del =
            DelWorkspace::with_loads(tree, rule, time_step, forces, forces.points + set.features.len())?;
        let method = method.unwrap_or_else(|| NewtonMethod::fastest(tree, s));
        Ok(Self {
            solver: NewtonSolver::new(method, tree, &del),
            velocities: VelocityWorkspace::new(tree),
            first_load: 0,
            multipliers: vec![0.0; (s + 1) * m],
            jacobians: vec![0.0; (s + 1) * m * n],
            residual: vec![0.0; s * n],
            defects: vec![0.0; s * m],
            columns: RowMatrix::zeros(s * n, 1 + s * m),
            schur: DenseLu::new(s * m),
            shift: vec![0.0; s * m],
            rate: vec![0.0; n],
            projection: Projection {
                inverse: vec![0.0; m * n],
                gram: DenseLu::new(m),
                multiplier: vec![0.0; m],
            },
            next: State::zeros(tree),
            set,
            del,
        })
    }

    /// The constraint rows.
    pub fn constraints(&self) -> &ConstraintSet {
        &self.set
    }

    /// The nodes of the last step.
    pub fn del(&self) -> &DelWorkspace {
        &self.del
    }

    /// Multipliers `λ^α` of the last step: impulses, one per row. The reaction at an interior node is `λ^α/(w_α Δt)`; at a
    /// boundary it is the last multiplier of one step plus the first of the next over `(w_s + w_0) Δt`.
    pub fn multipliers(&self, alpha: usize) -> &[f64] {
        let m = self.set.row_count();
        &self.multipliers[alpha * m..(alpha + 1) * m]
    }

    /// Velocities, momenta and energies of states.
    pub fn velocities(&mut self) -> &mut VelocityWorkspace {
        &mut self.velocities
    }

    /// Makes a state consistent: `q` onto `h = 0` (Newton with `M⁻¹Gᵀ` directions), `p` onto `G M⁻¹ p = 0`.
    ///
    /// # Errors
    /// [`StepError::RedundantConstraint`] naming a dependent row; [`StepError::NotConverged`] when `h = 0` is out of reach.
    pub fn project(&mut self, tree: &KinematicTree, state: &mut State) -> Result<(), StepError> {
        let (n, m) = (tree.dof(), self.set.row_count());
        let zeros = vec![0.0; n];
        self.next.copy_from(state);
        for iteration in 0..=MAX_ITERATIONS {
            self.del.begin(tree, &self.next, &StepForces::held(&zeros))?;
            self.del.evaluate(tree, &[]);
            let mut h = vec![0.0; m];
            self.set.residual_into(&self.del, 0, &mut h);
            let jacobian = &mut self.jacobians[..m * n];
            self.set.jacobian_into(tree, &self.del, 0, jacobian);
            let jacobian = &self.jacobians[..m * n];
            self.projection.factor(tree, &mut self.velocities, &self.next, jacobian)?;
            let defect = h.iter().fold(0.0f64, |a, x| a.max(x.abs()));
            if defect < 1e-15 || (iteration > 3 && defect < 1e-13) {
                break;
            }
            if iteration == MAX_ITERATIONS || !defect.is_finite() {
                return Err(StepError::NotConverged {
                    residual: defect,
                    change: defect,
                    iterations: iteration,
                });
            }
            self.projection.gram.solve(&mut h);
            for (k, factor) in h.iter().enumerate() {
                for i in 0..n {
                    self.next.q[i] -= factor * self.projection.inverse[k * n + i];
                }
            }
        }
        let jacobian = &self.jacobians[..m * n];
        self.projection.project_momentum(jacobian, &mut self.next.p);
        state.copy_from(&self.next);
        Ok(())
    }

    /// Advances a consistent state by one step; on an error the state is untouched. No allocation.
    ///
    /// # Errors
    /// As [`crate::step::Integrator::step`], and [`StepError::RedundantConstraint`].
    pub fn step(
        &mut self,
        tree: &KinematicTree,
        state: &mut State,
        forces: &StepForces<'_>,
    ) -> Result<StepReport, StepError> {
        let report = self.solve(tree, state, forces)?;
        state.copy_from(&self.next);
        Ok(report)
    }

    /// Solves one step without advancing the state.
    ///
    /// # Errors
    /// As [`ConstrainedIntegrator::step`].
    pub fn solve(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        forces: &StepForces<'_>,
    ) -> Result<StepReport, StepError> {
        let (n, s) = (tree.dof(), self.del.unknown_nodes());
        self.del.begin(tree, state, forces)?;
        self.first_load = self.del.loads.len();
        for feature in &self.set.features {
            self.del.push_load(DeadLoad {
                body: feature.body,
                arm_b: feature.arm_b.into(),
                couple: feature.is_arm,
            });
        }
        self.multipliers.fill(0.0);
        self.velocities.velocity_into(tree, state, &mut self.rate)?;
        for alpha in 1..=s {
            let c = self.del.rule().nodes()[alpha] * self.del.time_step();
            for dof in 0..n {
                self.del.move_node(alpha, dof, c * self.rate[dof]);
            }
        }
        let report = self.newton(tree, forces)?;
        self.end_multiplier(tree, forces)?;
        Ok(report)
    }

    pub(super) fn newton(
        &mut self,
        tree: &KinematicTree,
        forces: &StepForces<'_>,
    ) -> Result<StepReport, StepError> {
        let (n, s, m) = (tree.dof(), self.del.unknown_nodes(), self.set.row_count());
        let mut report = StepReport::default();
        let mut last_change = f64::INFINITY;
        let mut largest = f64::INFINITY;
        for iteration in 0..MAX_ITERATIONS {
            self.apply_multipliers();
            self.del.evaluate(tree, forces.laws);
            self.evaluate_constraints(tree);
            self.del.residual_into(tree, &mut self.residual);
            largest = self.residual.iter().fold(0.0, |a: f64, x| a.max(x.abs()));
            if let Some(index) = self.residual.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity: "DEL residual (coordinate * s + node)", index });
            }
            self.solver.factor(tree, &self.del)?;
            report.factorizations += 1;
            report.iterations += 1;
            self.columns.clear();
            for (row, value) in self.residual.iter().enumerate() {
                self.columns.set(row, 0, -value);
            }
            fill_constraint_columns(&mut self.columns, 1, &self.jacobians, n, s, m);
            self.solver.solve_many(tree, &mut self.columns);
            self.factor_schur(n, s, m, 1)?;
            for alpha in 1..=s {
                for k in 0..m {
                    let sum: f64 = (0..n)
                        .map(|i| self.jacobian(alpha, k, i, n) * self.columns.get(i * s + alpha - 1, 0))
                        .sum();
                    let at = (alpha - 1) * m + k;
                    self.shift[at] = self.defects[at] + sum;
                }
            }
            self.schur.solve(&mut self.shift);
            let (mut change, mut size) = (0.0f64, 1.0f64);
            for dof in 0..n {
                for alpha in 1..=s {
                    let row = dof * s + alpha - 1;
                    let pulled: f64 = (0..s * m).map(|c| self.columns.get(row, 1 + c) * self.shift[c]).sum();
                    let delta = self.columns.get(row, 0) - pulled;
                    self.del.move_node(alpha, dof, delta);
                    change = change.max(delta.abs());
                    size = size.max(1.0 + self.del.node(alpha, dof).abs());
                }
            }
            for (value, shift) in self.multipliers.iter_mut().zip(&self.shift) {
                *value += shift;
            }
            report.last_change = change;
            if !change.is_finite() {
                break;
            }
            let contraction = change / last_change;
            if iteration > 0 && change <= 1e-14 * size
                || (change < 1e-8 * size && contraction > 0.5)
                || (iteration > 1
                    && change * contraction * contraction <= 1e-15 * size
                    && change <= 1e-10 * size)
            {
                return Ok(report);
            }
            last_change = change;
        }
        Err(StepError::NotConverged {
            residual: largest,
            change: report.last_change,
            iterations: report.iterations,
        })
    }

    /// C4: the multiplier of the end node, and the state it gives.
    pub(super) fn end_multiplier(
        &mut self,
        tree: &KinematicTree,
        forces: &StepForces<'_>,
    ) -> Result<(), StepError> {
        let (n, s, m) = (tree.dof(), self.del.unknown_nodes(), self.set.row_count());
        self.apply_multipliers();
        self.del.evaluate(tree, forces.laws);
        self.evaluate_constraints(tree);
        self.del.next_state_into(tree, &mut self.next);
        let jacobian = &self.jacobians[s * m * n..(s + 1) * m * n];
        self.projection.factor(tree, &mut self.velocities, &self.next, jacobian)?;
        self.projection.project_momentum(jacobian, &mut self.next.p);
        self.next.check_finite()?;
        self.multipliers[s * m..].copy_from_slice(&self.projection.multiplier);
        self.apply_multipliers();
        self.del.evaluate(tree, forces.laws);
        Ok(())
    }

    /// Forces of the constraint loads at the nodes: `Σ_k λ_k^α d_k / (w_α Δt)`.
    pub(super) fn apply_multipliers(&mut self) {
        let (s, m, groups) = (self.del.unknown_nodes(), self.set.row_count(), self.del.groups);
        for feature in 0..self.set.features.len() {
            let at = (self.first_load + feature) * groups;
            for alpha in 0..=s {
                let scale = 1.0 / (self.del.rule.weights()[alpha] * self.del.time_step);
                let mut force = Vector3::zeros();
                for term in self.set.terms.iter().filter(|term| term.feature == feature) {
                    force += term.direction_w * (self.multipliers[alpha * m + term.row] * scale);
                }
                for c in 0..3 {
                    self.del.load_forces[at + alpha / LANES][c].0[alpha % LANES] = force[c];
                }
            }
        }
    }

    pub(super) fn evaluate_constraints(&mut self, tree: &KinematicTree) {
        let (n, s, m) = (tree.dof(), self.del.unknown_nodes(), self.set.row_count());
        for alpha in 0..=s {
            let jacobian = &mut self.jacobians[alpha * m * n..(alpha + 1) * m * n];
            self.set.jacobian_into(tree, &self.del, alpha, jacobian);
            if alpha > 0 {
                self.set.residual_into(&self.del, alpha, &mut self.defects[(alpha - 1) * m..alpha * m]);
            }
        }
    }

    #[inline]
    pub(super) fn jacobian(&self, alpha: usize, row: usize, dof: usize, n: usize) -> f64 {
        self.jacobians[(alpha * self.set.row_count() + row) * n + dof]
    }

    /// Factorises `𝒢 X_𝒜`, the columns of `X_𝒜` starting at `first`.
    pub(super) fn factor_schur(
        &mut self,
        n: usize,
        s: usize,
        m: usize,
        first: usize,
    ) -> Result<(), StepError> {
        for alpha in 1..=s {
            for k in 0..m {
                for c in 0..s * m {
                    let sum: f64 = (0..n)
                        .map(|i| {
                            self.jacobians[(alpha * m + k) * n + i]
                                * self.columns.get(i * s + alpha - 1, first + c)
                        })
                        .sum();
                    self.schur.entries_mut()[((alpha - 1) * m + k) * s * m + c] = sum;
                }
            }
        }
        self.schur.factor().map_err(|(index, pivot)| StepError::RedundantConstraint { row: index % m, pivot })
    }

    /// `A` (`2n x 2n`) and `B` (`2n x n`, input held over the step) of the step just solved, row-major, in ambient `(q, p)`:
    /// meaningful on the tangent space of `{h = 0, G M⁻¹ p = 0}`. Allocates: for analysis and set-up, not for a control cycle.
    ///
    /// # Errors
    /// As [`ConstrainedIntegrator::step`].
    pub fn linearize(&mut self, tree: &KinematicTree) -> Result<(Vec<f64>, Vec<f64>), StepError> {
        let (n, s, m) = (tree.dof(), self.del.unknown_nodes(), self.set.row_count());
        let total = 3 * n;
        let mut hessian = crate::del_hessian::DelHessian::new(tree, &self.del);
        hessian.evaluate(tree, &self.del);
        self.solver.factor(tree, &self.del)?;
        let mut block = vec![0.0; n * n];
        let step = |del: &DelWorkspace, alpha: usize| del.rule.weights()[alpha] * del.time_step;
        let mut columns = RowMatrix::zeros(s * n, total + s * m);
        for alpha in 0..s {
            hessian.dense_block_into(tree, alpha, 0, &mut block);
            for i in 0..n {
                for j in 0..n {
                    columns.set(i * s + alpha, j, -block[i * n + j]);
                }
                columns.set(i * s + alpha, 2 * n + i, -step(&self.del, alpha));
            }
        }
        for i in 0..n {
            columns.set(i * s, n + i, -1.0);
        }
        fill_constraint_columns(&mut columns, total, &self.jacobians, n, s, m);
        self.solver.solve_many(tree, &mut columns);
        self.columns = columns;
        self.factor_schur(n, s, m, total)?;
        let mut z = vec![0.0; s * n * total];
        for column in 0..total {
            for alpha in 1..=s {
                for k in 0..m {
                    self.shift[(alpha - 1) * m + k] = (0..n)
                        .map(|i| self.jacobian(alpha, k, i, n) * self.columns.get(i * s + alpha - 1, column))
                        .sum();
                }
            }
            self.schur.solve(&mut self.shift);
            for row in 0..s * n {
                let pulled: f64 = (0..s * m).map(|c| self.columns.get(row, total + c) * self.shift[c]).sum();
                z[row * total + column] = self.columns.get(row, column) - pulled;
            }
        }
        self.columns = RowMatrix::zeros(s * n, 1 + s * m);

        // Rows of the end: δq^s, and δp_raw with W^s δq^s, which H[s,s] holds.
        let mut out = vec![0.0; 2 * n * total];
        for i in 0..n {
            let row = (i * s + s - 1) * total;
            out[i * total..(i + 1) * total].copy_from_slice(&z[row..row + total]);
        }
        for gamma in 0..=s {
            hessian.dense_block_into(tree, s, gamma, &mut block);
            for i in 0..n {
                for j in 0..n {
                    let entry = block[i * n + j];
                    if gamma == 0 {
                        out[(n + i) * total + j] += entry;
                    } else {
                        for c in 0..total {
                            out[(n + i) * total + c] += entry * z[(j * s + gamma - 1) * total + c];
                        }
                    }
                }
            }
        }
        for i in 0..n {
            out[(n + i) * total + 2 * n + i] += step(&self.del, s);
        }
        self.project_momentum_rows(tree, &mut out, total)?;

        let (mut a, mut b) = (vec![0.0; 4 * n * n], vec![0.0; 2 * n * n]);
        for row in 0..2 * n {
            a[row * 2 * n..(row + 1) * 2 * n].copy_from_slice(&out[row * total..row * total + 2 * n]);
            b[row * n..(row + 1) * n].copy_from_slice(&out[row * total + 2 * n..(row + 1) * total]);
        }
        Ok((a, b))
    }

    /// Adds `Gᵀ δλ^s` to the rows of `p`.
    pub(super) fn project_momentum_rows(
        &mut self,
        tree: &KinematicTree,
        out: &mut [f64],
        total: usize,
    ) -> Result<(), StepError> {
        let (n, s, m) = (tree.dof(), self.del.unknown_nodes(), self.set.row_count());
        let tangent = self.tangent_rows(tree, s)?;
        let jacobian = &self.jacobians[s * m * n..(s + 1) * m * n];
        for column in 0..total {
            let lambda = &mut self.projection.multiplier;
            for (k, value) in lambda.iter_mut().enumerate() {
                *value = -(0..2 * n).map(|i| tangent[k * 2 * n + i] * out[i * total + column]).sum::<f64>();
            }
            self.projection.gram.solve(lambda);
            for (k, value) in lambda.iter().enumerate() {
                for i in 0..n {
                    out[(n + i) * total + column] += jacobian[k * n + i] * value;
                }
            }
        }
        Ok(())
    }

    /// `[∂(Gv)/∂q - G M⁻¹ ∂(Mv)/∂q, G M⁻¹]` at the end of the step, `m x 2n`: with `[G, 0]` on top its kernel is the tangent space
    /// of the constrained states.
    pub(super) fn tangent_rows(&mut self, tree: &KinematicTree, alpha: usize) -> Result<Vec<f64>, StepError> {
        let (n, m) = (tree.dof(), self.set.row_count());
        self.velocities.velocity_into(tree, &self.next, &mut self.rate)?;
        let mut kinetic = KineticHessian::new(tree)?;
        kinetic.evaluate(tree, &[(&self.next.q, &self.rate)])?;
        let (mut mass, mut mixed, mut config) = (vec![0.0; n * n], vec![0.0; n * n], vec![0.0; n * n]);
        kinetic.dense_into(tree, 0, &mut mass, &mut mixed, &mut config);
        let mut rate = vec![0.0; m * n];
        self.set.jacobian_rate_into(tree, &self.del, alpha, &self.rate, &mut rate);
        let jacobian = &self.jacobians[alpha * m * n..(alpha + 1) * m * n];
        self.projection.factor(tree, &mut self.velocities, &self.next, jacobian)?;
        let mut rows = vec![0.0; m * 2 * n];
        for k in 0..m {
            for j in 0..n {
                let carried: f64 =
                    (0..n).map(|i| self.projection.inverse[k * n + i] * mixed[i * n + j]).sum();
                rows[k * 2 * n + j] = rate[k * n + j] - carried;
                rows[k * 2 * n + n + j] = self.projection.inverse[k * n + j];
            }
        }
        Ok(rows)
    }
}

/// Columns of `𝒜`: `G(q^α)ᵀ` in the rows α.
pub(super) fn fill_constraint_columns(
    columns: &mut RowMatrix,
    first: usize,
    jacobians: &[f64],
    n: usize,
    s: usize,
    m: usize,
) {
    for alpha in 0..s {
        for k in 0..m {
            for i in 0..n {
                columns.set(i * s + alpha, first + alpha * m + k, jacobians[(alpha * m + k) * n + i]);
            }
        }
    }
}

impl Projection {
    pub(super) fn factor(
        &mut self,
        tree: &KinematicTree,
        velocities: &mut VelocityWorkspace,
        state: &State,
        jacobian: &[f64],
    ) -> Result<(), StepError> {
        let n = tree.dof();
        let m = self.multiplier.len();
        velocities.factor_at(tree, state)?;
        self.inverse.copy_from_slice(jacobian);
        for row in self.inverse.chunks_exact_mut(n) {
            velocities.factor().solve_in_place(row)?;
        }
        self.refuse_dependent_rows(jacobian, n)?;
        for k in 0..m {
            for l in 0..m {
                self.gram.entries_mut()[k * m + l] =
                    (0..n).map(|i| jacobian[k * n + i] * self.inverse[l * n + i]).sum();
            }
        }
        self.gram.factor().map_err(|(row, pivot)| StepError::RedundantConstraint { row, pivot })
    }

    /// Elimination without pivoting of the positive `G M⁻¹ Gᵀ`: the first pivot that vanishes belongs to the first row that
    /// depends on those before it.
    pub(super) fn refuse_dependent_rows(&mut self, jacobian: &[f64], n: usize) -> Result<(), StepError> {
        let m = self.multiplier.len();
        let gram = self.gram.entries_mut();
        for k in 0..m {
            for l in 0..m {
                gram[k * m + l] = (0..n).map(|i| jacobian[k * n + i] * self.inverse[l * n + i]).sum();
            }
        }
        for k in 0..m {
            let scale: f64 = (0..n).map(|i| jacobian[k * n + i] * self.inverse[k * n + i]).sum();
            let pivot = gram[k * m + k];
            if pivot <= DEPENDENT_ROW * scale || pivot.is_nan() {
                return Err(StepError::RedundantConstraint { row: k, pivot: pivot / scale });
            }
            for r in k + 1..m {
                let factor = gram[r * m + k] / pivot;
                for c in k..m {
                    gram[r * m + c] -= factor * gram[k * m + c];
                }
            }
        }
        Ok(())
    }

    /// `p += Gᵀλ` with `G M⁻¹ p = 0` afterwards; keeps `λ`.
    pub(super) fn project_momentum(&mut self, jacobian: &[f64], p: &mut [f64]) {
        let n = p.len();
        for (k, value) in self.multiplier.iter_mut().enumerate() {
            *value = -(0..n).map(|i| self.inverse[k * n + i] * p[i]).sum::<f64>();
        }
        self.gram.solve(&mut self.multiplier);
        for (k, value) in self.multiplier.iter().enumerate() {
            for i in 0..n {
                p[i] += jacobian[k * n + i] * value;
            }
        }
    }
}
