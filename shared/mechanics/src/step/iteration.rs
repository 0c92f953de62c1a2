//! Newton's method of one step: factors, changes and when to stop; in words: [`super`].

use nalgebra::Vector3;

use super::{Integrator, NewtonVariant, StepReport};
use crate::errors::{FactorError, StepError};
use crate::floating_base::MAX_HALF_ROTATION;
use crate::forces::StepForces;
use crate::newton_direction::NewtonDirection;
use crate::real::sqrt;
use crate::tree::{JointKind, KinematicTree};

/// A change below this (times `1 + max|q|`) is round-off: with the factors of the guess it is the last one.
const SMALL_CHANGE: f64 = 1e-14;
/// A change above this (times `1 + max|q|`) tells how the iteration contracts; below, it may be round-off.
const CLEAN_CHANGE: f64 = 1e-13;
/// Below this the iteration may stop when it no longer shrinks: round-off.
const STAGNATION_CHANGE: f64 = 1e-8;
/// Contraction above which the Newton matrix is renewed.
const RENEW_CONTRACTION: f64 = 0.1;
/// Contraction above which the inertia part of the Newton matrix gives way to the whole of it.
const INERTIAL_CONTRACTION: f64 = 0.5;
/// Iterations that cost as much as a factorisation: the factors of an earlier step may take this many more than new ones.
const FACTOR_ITERATIONS: usize = 2;
/// When they do not contract, this many steps begin with new factors before old ones are tried again; when they only take more
/// iterations, one.
const REUSE_PAUSE: u32 = 16;
/// The ratio of the last step may have grown by this much when it predicts the second change of this one.
const SAFETY: f64 = 10.0;

impl Integrator {
    /// Makes the Newton matrix at the present nodes, whose residual `direction` holds.
    fn factor(&mut self, tree: &KinematicTree, report: &mut StepReport) -> Result<(), FactorError> {
        let s = self.del.unknown_nodes();
        for (alpha, row) in self.del.held_rows.iter_mut().enumerate() {
            *row = core::array::from_fn(|k| self.direction[k * s + alpha]);
        }
        let outcome = self.factor_or_fall_back(tree, report);
        self.del.held_rows.fill([0.0; 6]);
        outcome
    }

    fn factor_or_fall_back(
        &mut self,
        tree: &KinematicTree,
        report: &mut StepReport,
    ) -> Result<(), FactorError> {
        report.factorizations += 1;
        if self.use_inertial && self.factor_inertia(tree).is_ok() {
            self.broyden.forget();
            return Ok(());
        }
        self.use_inertial = false;
        self.keep_factors();
        if !self.use_dense {
            let outcome = self.solver.factor(tree, &self.del);
            self.factored = outcome.is_ok();
            match (outcome, &self.dense) {
                (Ok(()), _) => return Ok(()),
                (Err(error), None) => return Err(error),
                // The leaf-to-root pivots fail where pivoting over the whole matrix need not.
                (Err(_), Some(_)) => self.use_dense = true,
            }
        }
        self.factored = false;
        match &mut self.dense {
            Some(dense) => dense.factor(tree, &self.del),
            None => self.solver.factor(tree, &self.del),
        }
    }

    /// The mass matrix at the node nearest to the middle of the step.
    fn factor_inertia(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        let middle = self.del.unknown_nodes().div_ceil(2);
        for (dof, q) in self.next.q.iter_mut().enumerate() {
            *q = self.del.node(middle, dof);
        }
        self.velocities.factor_at(tree, &self.next)
    }

    pub(super) fn keep_factors(&mut self) {
        self.factored = true;
        self.broyden.forget();
        for (k, travel) in self.factored_travel.iter_mut().enumerate() {
            *travel = Vector3::from_fn(|r, _| self.del.node(k + 1, 3 + r));
        }
    }

    /// Takes the change of a floating base for one of `R_b x`, at the `x` where `J` was made, instead of `x`.
    ///
    /// The axes of `x` turn with the unknown `ω^s`. The momentum of the whole robot goes with `R_b ẋ`, the light base turns under it:
    /// in `x`, what a step or an iteration adds to the velocity changes `J` by a hundred times more than in `R_b x`. To first order
    /// in the turn `δω^s`: `δx += δω^s × (x_J - x - δx)`.
    fn turn_travel_with_chart(&mut self) {
        let s = self.del.unknown_nodes();
        let direction = &mut self.direction;
        let turn = Vector3::from_fn(|k, _| direction[k * s + s - 1]);
        for (alpha, factored) in self.factored_travel.iter().enumerate() {
            let travel =
                Vector3::from_fn(|k, _| self.del.node(alpha + 1, 3 + k) + direction[(3 + k) * s + alpha]);
            let bend = turn.cross(&(factored - travel));
            for k in 0..3 {
                direction[(3 + k) * s + alpha] += bend[k];
            }
        }
    }

    pub(super) fn newton(
        &mut self,
        tree: &KinematicTree,
        forces: &StepForces<'_>,
        report: &mut StepReport,
    ) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        for (dof, end) in self.guessed_end.iter_mut().enumerate() {
            *end = self.del.node(s, dof);
        }
        let (mut last_change, mut last_contraction) = (f64::INFINITY, 0.0f64);
        self.broyden.begin();
        let mut contracts = self.factored;
        let (old_factors, mut renewed) = (self.factored, false);
        let factorizations = report.factorizations;
        let mut residual = f64::INFINITY;
        for iteration in 0..self.options.max_iterations {
            self.del.evaluate(tree, forces.laws);
            self.del.residual_into(tree, &mut self.direction);
            residual = self.direction.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            if let Some(index) = self.direction.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity: "DEL residual (coordinate * s + node)", index });
            }
            if self.options.variant == NewtonVariant::Exact || !contracts {
                self.factor(tree, report)?;
                renewed = true;
            }
            match (&mut self.dense, &mut self.inertial) {
                (_, Some(inertial)) if self.use_inertial => {
                    inertial.solve(self.velocities.factor(), self.del.time_step(), &mut self.direction);
                }
                (Some(dense), _) if self.use_dense => dense.solve(tree, &mut self.direction),
                _ => self.solver.solve(tree, &mut self.direction),
            }
            for x in &mut self.direction {
                *x = -*x;
            }
            if matches!(self.options.variant, NewtonVariant::Broyden | NewtonVariant::Inertial) {
                self.broyden.improve(&mut self.direction);
            }
            if tree.is_floating() {
                self.turn_travel_with_chart();
            }
            report.iterations += 1;
            let limited = self.limit_change(tree);
            let mut size = 1.0f64;
            let mut change = 0.0f64;
            for dof in 0..tree.dof() {
                for alpha in 1..=s {
                    let delta = self.direction[dof * s + alpha - 1];
                    self.del.move_node(alpha, dof, delta);
                    size = size.max(1.0 + self.del.node(alpha, dof).abs());
                    change = change.max(delta.abs());
                }
            }
            report.last_change = change;
            if !change.is_finite() {
                return Err(StepError::NotConverged { residual, change, iterations: report.iterations });
            }
            let contraction = change / last_change;
            // Old factors contract unevenly: the worse of two contractions counts, and a poor one is no sign of round-off.
            let old = (old_factors && !renewed) || self.use_inertial;
            let rate = if old { contraction.max(last_contraction) } else { contraction };
            // What is left by the contractions before this one, should round-off hide how much this change is smaller than the last.
            let left = last_change * last_contraction * last_contraction;
            let hidden = old && iteration > 1 && change < STAGNATION_CHANGE * size;
            let small = if old { self.options.accuracy } else { SMALL_CHANGE.max(self.options.accuracy) };
            // Newton's method with the matrix of the guess: the second change is as the square of the first.
            let fresh =
                renewed && !limited && !self.use_inertial && report.factorizations == factorizations + 1;
            if fresh && iteration == 1 {
                let ratio = change / (last_change * last_change);
                self.quadratic = if change > CLEAN_CHANGE * size { ratio } else { self.quadratic.min(ratio) };
            }
            let predicted = SAFETY * self.quadratic * change * change;
            if change <= small * size
                || (fresh && iteration == 0 && predicted <= self.options.accuracy * size)
                || (iteration > 0 && change * rate <= self.options.accuracy * size)
                || (old && last_change <= SMALL_CHANGE * size)
                || (hidden && left <= self.options.accuracy * size)
                || (!old && change < STAGNATION_CHANGE * size && contraction > 0.5)
            {
                self.del.evaluate(tree, forces.laws);
                self.broyden.end();
                if !old_factors {
                    if self.missed.is_known() {
                        self.new_factor_iterations = iteration + 1;
                    }
                } else if renewed {
                    self.reuse_pause = REUSE_PAUSE;
                } else if iteration + 1 > self.new_factor_iterations + FACTOR_ITERATIONS {
                    self.reuse_pause = 1;
                }
                return Ok(());
            }
            let round_off = if old { CLEAN_CHANGE * size } else { 0.0 };
            contracts = if self.use_inertial {
                // The whole matrix, for the rest of the step.
                self.use_inertial = contraction < INERTIAL_CONTRACTION || iteration == 0;
                self.use_inertial
            } else {
                !limited && (change - round_off < RENEW_CONTRACTION * last_change || iteration == 0)
            };
            (last_change, last_contraction) = (change, contraction);
        }
        Err(StepError::NotConverged { residual, change: last_change, iterations: report.iterations })
    }

    /// Shortens a change that turns a joint by more than the limit.
    fn limit_change(&mut self, tree: &KinematicTree) -> bool {
        if self.options.change_limit.is_infinite() {
            return false;
        }
        let s = self.del.unknown_nodes();
        let mut turn = 0.0f64;
        for (body, spec) in tree.bodies().iter().enumerate().skip(tree.first_joint_body()) {
            if spec.joint.kind == JointKind::Revolute {
                let dof = tree.joint_dof(body);
                for delta in &self.direction[dof * s..(dof + 1) * s] {
                    turn = turn.max(delta.abs());
                }
            }
        }
        let limited = turn > self.options.change_limit;
        if limited {
            let scale = self.options.change_limit / turn;
            for x in &mut self.direction {
                *x *= scale;
            }
        }
        limited
    }

    /// Refuses solutions that are not the continuation of the motion.
    pub(super) fn accept(&self, tree: &KinematicTree) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        if tree.is_floating() {
            let half = sqrt((0..3).map(|k| self.del.node(s, k) * self.del.node(s, k)).sum());
            if half > MAX_HALF_ROTATION {
                let limit = 2.0 * MAX_HALF_ROTATION;
                return Err(StepError::SpuriousSolution { dof: 0, change: 2.0 * half, limit });
            }
        }
        for (body, spec) in tree.bodies().iter().enumerate().skip(tree.first_joint_body()) {
            if spec.joint.kind != JointKind::Revolute {
                continue;
            }
            let dof = tree.joint_dof(body);
            let change = (self.del.node(s, dof) - self.guessed_end[dof]).abs();
            let limit = self.options.turn_limit;
            if change > limit {
                return Err(StepError::SpuriousSolution { dof, change, limit });
            }
        }
        Ok(())
    }
}
