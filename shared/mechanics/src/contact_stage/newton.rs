//! The solved step: Newton's method on nodes and multipliers, and the end projection.
//!
//! Letters and equations: [`super`].

use nalgebra::Vector6;

use super::{BoundaryState, ContactStage, StageNominal};
use crate::errors::StepError;
use crate::floating_base::MAX_HALF_ROTATION;
use crate::forces::StepForces;
use crate::kinematics::check_length;
use crate::real::sqrt;
use crate::spatial::Wrench;
use crate::step::StepReport;
use crate::tree::KinematicTree;

const MAX_ITERATIONS: usize = 40;
/// A change below this (times `1 + max|q|`) is the last one.
const SMALL_CHANGE: f64 = 1e-15;
/// Below this the iteration may stop when it no longer shrinks: round-off.
const STAGNATION_CHANGE: f64 = 1e-9;

impl ContactStage {
    /// Solves the stage from `start` under held joint forces `u` with the given contacts: nodes and multipliers go to `nominal` (what it
    /// held is not used), the state at the end to `end`. A start that violates the contacts gives the inelastic impact and the step
    /// after it. Without active contacts it is the step of [`crate::step::Integrator`]. No allocation.
    ///
    /// # Errors
    /// As [`ContactStage::linearize`]; [`StepError::NotConverged`]; [`StepError::SpuriousSolution`] for a base that turns by more than
    /// half a turn.
    #[allow(clippy::too_many_arguments)]
    pub fn solve(
        &mut self,
        tree: &KinematicTree,
        time_step: f64,
        active: &[bool],
        start: &BoundaryState,
        u: &[f64],
        nominal: &mut StageNominal,
        end: &mut BoundaryState,
    ) -> Result<StepReport, StepError> {
        check_length("joint coordinates q at the end", end.q.len(), tree.joint_count())?;
        check_length("joint rates at the end", end.rate.len(), tree.joint_count())?;
        nominal.check(self.del.unknown_nodes(), tree.joint_count(), self.row_count())?;
        self.begin(tree, time_step, active, start, u)?;
        if self.active.is_empty() {
            return self.fly(tree, time_step, u, nominal, end);
        }
        self.projection.factor(tree, &self.start, &self.contacts, active, self.regularisation)?;
        self.guess(tree, time_step, start, nominal, end)?;
        self.place_nodes(tree, nominal)?;
        let report = self.newton(tree, nominal)?;
        let s = self.del.unknown_nodes();
        let half = sqrt((0..3).map(|k| self.del.node(s, k) * self.del.node(s, k)).sum());
        if half > MAX_HALF_ROTATION {
            let limit = 2.0 * MAX_HALF_ROTATION;
            return Err(StepError::SpuriousSolution { dof: 0, change: 2.0 * half, limit });
        }
        self.end_of_solution(tree, active, nominal, end)?;
        Ok(report)
    }

    /// Nodes of a uniform motion with the velocities that the contacts allow.
    fn guess(
        &mut self,
        tree: &KinematicTree,
        time_step: f64,
        start: &BoundaryState,
        nominal: &mut StageNominal,
        end: &mut BoundaryState,
    ) -> Result<(), StepError> {
        let nv = tree.dof();
        self.change.copy_from_slice(self.start.velocity());
        self.projection.project(&mut self.change)?;
        end.copy_from(start);
        for k in 0..6 {
            end.base_velocity_b[k] = self.change[k];
        }
        end.rate.copy_from_slice(&self.change[6..]);
        for value in &mut self.change {
            *value *= time_step;
        }
        end.retract(&self.change[..nv]);
        nominal.multipliers.fill(0.0);
        let middle = |k: usize| 0.5 * self.change[k];
        for alpha in 1..=self.del.unknown_nodes() {
            let c = self.del.rule().nodes()[alpha];
            for k in 0..6 {
                nominal.xi[(alpha - 1) * 6 + k] = (2.0 * c - 1.0) * middle(k);
            }
            for joint in 0..nv - 6 {
                nominal.q[(alpha - 1) * (nv - 6) + joint] = start.q[joint] + c * self.change[6 + joint];
            }
        }
        Ok(())
    }

    fn newton(&mut self, tree: &KinematicTree, nominal: &mut StageNominal) -> Result<StepReport, StepError> {
        let (nv, s, m) = (tree.dof(), self.del.unknown_nodes(), self.active.len());
        let mut report = StepReport::default();
        let mut last_change = f64::INFINITY;
        for iteration in 0..MAX_ITERATIONS {
            self.solver_factor(tree)?;
            self.fill_newton_columns(tree);
            self.solve_saddle(tree, false)?;
            report.factorizations += 1;
            report.iterations += 1;
            let (mut change, mut size) = (0.0f64, 1.0f64);
            for dof in 0..nv {
                for alpha in 1..=s {
                    let delta = self.columns.get(dof * s + alpha - 1, 0);
                    self.del.move_node(alpha, dof, delta);
                    change = change.max(delta.abs());
                    size = size.max(1.0 + self.del.node(alpha, dof).abs());
                    if !delta.is_finite() {
                        change = f64::NAN;
                    }
                }
            }
            for alpha in 0..s {
                for (index, row) in self.active.iter().enumerate() {
                    let at = alpha * nominal.rows() + row.of_all;
                    nominal.multipliers[at] += self.multipliers.get(alpha * m + index, 0);
                }
            }
            report.last_change = change;
            self.apply_multipliers(&nominal.multipliers);
            if change.is_nan() {
                break;
            }
            self.evaluate(tree)?;
            let contraction = change / last_change;
            if (iteration > 0 && change <= SMALL_CHANGE * size)
                || (iteration > 0 && change < STAGNATION_CHANGE * size && contraction > 0.5)
                || (iteration > 1
                    && change * contraction * contraction <= 1e-17 * size
                    && change < 1e-9 * size)
            {
                return Ok(report);
            }
            last_change = change;
        }
        Err(StepError::NotConverged {
            residual: self.residual.iter().fold(0.0, |largest: f64, x| largest.max(x.abs())),
            change: report.last_change,
            iterations: report.iterations,
        })
    }

    /// Nodes into `nominal`; pose, coordinates and velocities at the end, with the multiplier that makes them consistent.
    fn end_of_solution(
        &mut self,
        tree: &KinematicTree,
        active: &[bool],
        nominal: &mut StageNominal,
        end: &mut BoundaryState,
    ) -> Result<(), StepError> {
        let (nv, s) = (tree.dof(), self.del.unknown_nodes());
        self.nodes_into(tree, nominal);
        self.del.next_state_into(tree, &mut self.state);
        // What is left of the residual goes to the momenta, as in [`crate::step`].
        for (dof, rows) in self.residual.chunks_exact(s).enumerate().skip(6) {
            self.state.p[dof] += rows.iter().sum::<f64>();
        }
        self.state.check_finite()?;
        self.velocities_at_end(tree, end)?;
        self.projection.factor(tree, &self.end, &self.contacts, active, self.regularisation)?;
        self.change.copy_from_slice(self.end.velocity());
        let impulse = self.projection.project(&mut self.change)?;
        let last = &mut nominal.multipliers[s * self.first_rows[self.contacts.len()]..];
        last.fill(0.0);
        for (row, impulse) in self.active.iter().zip(impulse) {
            last[row.of_all] = *impulse;
        }
        for k in 0..6 {
            end.base_velocity_b[k] = self.change[k];
        }
        end.rate.copy_from_slice(&self.change[6..nv]);
        Ok(())
    }

    fn nodes_into(&self, tree: &KinematicTree, nominal: &mut StageNominal) {
        let joints = tree.joint_count();
        for alpha in 1..=self.del.unknown_nodes() {
            for k in 0..6 {
                nominal.xi[(alpha - 1) * 6 + k] = self.del.node(alpha, k);
            }
            for joint in 0..joints {
                nominal.q[(alpha - 1) * joints + joint] = self.del.node(alpha, 6 + joint);
            }
        }
    }

    /// `(V_body; q̇) = 𝓜⁻¹ (Π; p_j)` of `state`.
    fn velocities_at_end(&mut self, tree: &KinematicTree, end: &mut BoundaryState) -> Result<(), StepError> {
        end.orientation = self.state.base_pose.rotation;
        end.position_w = self.state.base_pose.translation;
        end.q.copy_from_slice(&self.state.q);
        end.base_velocity_b = Vector6::zeros();
        end.rate.fill(0.0);
        self.end.update(tree, end)?;
        let momentum = Wrench::from_vector(&Vector6::from_column_slice(&self.state.p[..6]));
        let momentum_b = self.state.base_pose.inverse_transform_wrench(&momentum).to_vector();
        self.change.copy_from_slice(&self.state.p);
        self.change[..6].copy_from_slice(momentum_b.as_slice());
        self.end.factor().solve_in_place(&mut self.change)?;
        end.base_velocity_b = Vector6::from_column_slice(&self.change[..6]);
        end.rate.copy_from_slice(&self.change[6..]);
        self.end.update(tree, end)
    }

    /// The step without contacts.
    fn fly(
        &mut self,
        tree: &KinematicTree,
        time_step: f64,
        u: &[f64],
        nominal: &mut StageNominal,
        end: &mut BoundaryState,
    ) -> Result<StepReport, StepError> {
        self.flight.set_time_step(time_step)?;
        let report = self.flight.solve(tree, &self.state, &StepForces::held(u))?;
        nominal.multipliers.fill(0.0);
        let joints = tree.joint_count();
        let del = self.flight.del();
        for alpha in 1..=del.unknown_nodes() {
            for k in 0..6 {
                nominal.xi[(alpha - 1) * 6 + k] = del.node(alpha, k);
            }
            for joint in 0..joints {
                nominal.q[(alpha - 1) * joints + joint] = del.node(alpha, 6 + joint);
            }
        }
        self.state.copy_from(self.flight.next_state());
        self.velocities_at_end(tree, end)?;
        Ok(report)
    }
}
