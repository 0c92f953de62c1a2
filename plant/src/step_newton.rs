//! Newton's method for one step, with factors kept from step to step.
//!
//! As in [`delmpc_mechanics::step`]: the interpolation polynomial of the step before is extrapolated, and the iteration stops on the change of
//! the nodes, never on the residual. Different from there: the factorisation of the Newton matrix `J` outlives the step, because `J` changes
//! little in a millisecond; it is renewed after 20 steps, or when the iteration contracts badly. The solution does not depend on it.

use delmpc_mechanics::branch_lu::BranchLu;
use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::errors::{ModelError, StepError};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::newton_direction::NewtonDirection;
use delmpc_mechanics::spatial::exp_rotation;
use delmpc_mechanics::state::State;
use delmpc_mechanics::tree::{JointKind, KinematicTree};
use nalgebra::Vector3;

use crate::dense::largest;

/// The next change of the nodes is predicted below this (times `1 + max|q|`): converged.
const PREDICTED_CHANGE: f64 = 1e-14;
/// A change below this (times `1 + max|q|`) is converged without prediction.
const SMALL_CHANGE: f64 = 1e-13;
/// A change below this (times `1 + max|q|`) is round-off: the nodes stay as they were evaluated.
const NO_CHANGE: f64 = 1e-15;
/// Below this the iteration may stop when it no longer shrinks.
const STAGNATION_CHANGE: f64 = 1e-9;
/// Contraction above which the Newton matrix is renewed.
const RENEW_CONTRACTION: f64 = 0.1;
/// Newton iterations per round after which a step fails.
const MAX_ITERATIONS: usize = 30;
/// A revolute joint that ends further (rad) from its guess is a spurious solution.
const TURN_LIMIT: f64 = 1.0;
/// Steps after which the factors are renewed.
const MAX_FACTOR_AGE: usize = 20;
/// Contraction in a step after which they are renewed for the next one.
const AGED_CONTRACTION: f64 = 0.02;

/// Nodes, factors and memory of the last step.
#[derive(Clone, Debug)]
pub(crate) struct StepNewton {
    pub del: DelWorkspace,
    pub solver: BranchLu,
    /// Newton iterations and factorisations of this step.
    pub iterations: usize,
    pub factorizations: usize,
    /// Factorisations ever made: names the present one.
    pub generation: u64,
    previous_nodes: Vec<f64>,
    /// `l_β(1 + c_α)`, row α.
    extrapolation: Vec<f64>,
    guessed_end: Vec<f64>,
    direction: Vec<f64>,
    /// Contraction seen in this step.
    contraction: f64,
    /// Steps since the factorisation.
    factor_age: usize,
}

impl StepNewton {
    pub fn new(
        tree: &KinematicTree,
        rule: &LobattoRule,
        time_step: f64,
        forces: ForceCapacity,
    ) -> Result<Self, ModelError> {
        let del = DelWorkspace::new(tree, rule, time_step, forces)?;
        let nodes = rule.nodes().len();
        let extrapolation = rule
            .nodes()
            .iter()
            .flat_map(|c| (0..nodes).map(|beta| rule.lagrange(beta, 1.0 + c)).collect::<Vec<_>>())
            .collect();
        Ok(Self {
            solver: BranchLu::new(tree, &del),
            iterations: 0,
            factorizations: 0,
            generation: 0,
            previous_nodes: vec![0.0; nodes * tree.dof()],
            extrapolation,
            guessed_end: vec![0.0; tree.dof()],
            direction: vec![0.0; rule.unknown_nodes() * tree.dof()],
            contraction: 1.0,
            factor_age: MAX_FACTOR_AGE,
            del,
        })
    }

    /// The factors are not to be used again.
    pub fn forget(&mut self) {
        self.factor_age = MAX_FACTOR_AGE;
    }

    /// First solve of a step that was begun in `del`: from the nodes of the last step if it `continues` there, else from `rate`.
    ///
    /// # Errors
    /// As [`StepNewton::iterate`].
    pub fn solve_first(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        rate: &[f64],
        continues: bool,
    ) -> Result<(), StepError> {
        (self.iterations, self.factorizations) = (0, 0);
        self.contraction = 1.0;
        self.factor_age = if continues { self.factor_age + 1 } else { MAX_FACTOR_AGE };
        let solved = continues && {
            self.guess_by_extrapolation(tree);
            self.iterate(tree, self.factor_age < MAX_FACTOR_AGE).is_ok()
        };
        if !solved {
            self.guess_by_velocity(tree, state, rate);
            self.iterate(tree, false)?;
        }
        if self.contraction > AGED_CONTRACTION && self.contraction < 1.0 {
            self.factor_age = MAX_FACTOR_AGE;
        }
        Ok(())
    }

    /// Stores the nodes for the next step.
    pub fn keep_nodes(&mut self, tree: &KinematicTree) {
        let count = self.del.unknown_nodes() + 1;
        for dof in 0..tree.dof() {
            for alpha in 0..count {
                self.previous_nodes[dof * count + alpha] = self.del.node(alpha, dof);
            }
        }
    }

    fn guess_by_extrapolation(&mut self, tree: &KinematicTree) {
        let count = self.del.unknown_nodes() + 1;
        for dof in 0..tree.dof() {
            let nodes = &self.previous_nodes[dof * count..(dof + 1) * count];
            for alpha in 1..count {
                let value = if dof < tree.base_dof() {
                    // The chart moves with the body: the same rotation and travel once more.
                    nodes[alpha]
                } else {
                    let row = &self.extrapolation[alpha * count..(alpha + 1) * count];
                    row.iter().zip(nodes).map(|(l, q)| l * q).sum()
                };
                self.del.set_node(alpha, dof, value);
            }
        }
    }

    fn guess_by_velocity(&mut self, tree: &KinematicTree, state: &State, rate: &[f64]) {
        let dt = self.del.time_step();
        let mut half = [0.0; 6];
        if tree.is_floating() {
            let omega = Vector3::new(rate[0], rate[1], rate[2]);
            let linear = Vector3::new(rate[3], rate[4], rate[5]);
            let pose = &state.base_pose;
            let turn = pose.rotation.tr_mul(&omega) * (0.5 * dt);
            let center = pose.rotation * exp_rotation(&turn);
            let travel = center.tr_mul(&(linear + omega.cross(&pose.translation))) * (0.5 * dt);
            half = [turn.x, turn.y, turn.z, travel.x, travel.y, travel.z];
        }
        for alpha in 1..=self.del.unknown_nodes() {
            let c = self.del.rule().nodes()[alpha];
            for dof in 0..tree.dof() {
                let value = if dof < tree.base_dof() {
                    (2.0 * c - 1.0) * half[dof]
                } else {
                    state.q[dof - tree.base_dof()] + c * dt * rate[dof]
                };
                self.del.set_node(alpha, dof, value);
            }
        }
    }

    /// Newton's method from the nodes in `del`, which it leaves evaluated at the solution.
    ///
    /// # Errors
    /// [`StepError`]: not converged, singular, not finite, spurious.
    pub fn iterate(&mut self, tree: &KinematicTree, keep_factors: bool) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        for (dof, end) in self.guessed_end.iter_mut().enumerate() {
            *end = self.del.node(s, dof);
        }
        let mut renew = !keep_factors;
        let (mut residual, mut last_change) = (f64::INFINITY, f64::INFINITY);
        for iteration in 0..MAX_ITERATIONS {
            self.del.evaluate(tree, &[]);
            self.del.residual_into(tree, &mut self.direction);
            residual = largest(&self.direction);
            if let Some(index) = self.direction.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity: "DEL residual (coordinate * s + node)", index });
            }
            if renew {
                self.factor_age = MAX_FACTOR_AGE;
                self.solver.factor(tree, &self.del)?;
                self.factor_age = 0;
                self.generation += 1;
                self.factorizations += 1;
                self.contraction = 1.0;
            }
            self.solver.solve(tree, &mut self.direction);
            self.iterations += 1;
            let change = largest(&self.direction);
            if !change.is_finite() {
                return Err(StepError::NotConverged { residual, change, iterations: self.iterations });
            }
            let size = 1.0 + self.largest_joint_node(tree);
            if change <= NO_CHANGE * size {
                return self.accept(tree);
            }
            for dof in 0..tree.dof() {
                for alpha in 1..=s {
                    self.del.move_node(alpha, dof, -self.direction[dof * s + alpha - 1]);
                }
            }
            let contraction = change / last_change;
            if iteration > 0 {
                self.contraction = contraction.max(1e-8);
            }
            if change <= SMALL_CHANGE * size
                || change * self.contraction <= PREDICTED_CHANGE * size
                || (change <= STAGNATION_CHANGE * size && iteration > 0 && contraction > 0.5)
            {
                self.del.evaluate(tree, &[]);
                return self.accept(tree);
            }
            renew = iteration > 0 && contraction > RENEW_CONTRACTION;
            last_change = change;
        }
        Err(StepError::NotConverged { residual, change: last_change, iterations: self.iterations })
    }

    fn largest_joint_node(&self, tree: &KinematicTree) -> f64 {
        let s = self.del.unknown_nodes();
        (tree.base_dof()..tree.dof()).map(|dof| self.del.node(s, dof).abs()).fold(0.0, f64::max)
    }

    /// Refuses solutions that are not the continuation of the motion.
    fn accept(&self, tree: &KinematicTree) -> Result<(), StepError> {
        let s = self.del.unknown_nodes();
        if tree.is_floating() {
            let half = (0..3).map(|k| self.del.node(s, k).powi(2)).sum::<f64>().sqrt();
            let limit = core::f64::consts::FRAC_PI_2;
            if half > limit {
                return Err(StepError::SpuriousSolution { dof: 0, change: 2.0 * half, limit: 2.0 * limit });
            }
        }
        for (body, spec) in tree.bodies().iter().enumerate().skip(tree.first_joint_body()) {
            if spec.joint.kind == JointKind::Revolute {
                let dof = tree.joint_dof(body);
                let change = (self.del.node(s, dof) - self.guessed_end[dof]).abs();
                if change > TURN_LIMIT {
                    return Err(StepError::SpuriousSolution { dof, change, limit: TURN_LIMIT });
                }
            }
        }
        Ok(())
    }
}
