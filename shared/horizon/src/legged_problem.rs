//! The linear-quadratic problem of a horizon with contacts about a nominal.
//!
//! Per stage of length `Δt`, in deviations `x = (ε, δq, δV, δq̇)` from the nominal boundary states and `u` from the nominal torques:
//!
//! ```text
//! transition   A, B, d    the lifted Simpson step with the stage's contacts        (delmpc_mechanics::contact_stage)
//! cost         Δt · (torque from the one that carries the aim, base, mass centre, joints, feet in the air,
//!              contact forces from the ones shared out)
//! outputs      mean contact forces, rows of all contacts
//! rows         the cone of every foot that stands, torque, joint ranges and speeds
//! ```
//!
//! Weights are one over the square of the deviation that counts 1, and second; forces are relative to the weight of the robot. The
//! terminal cost is that of standing at the aim for some time: a cost of infinite time in these coordinates would punish feet that are
//! not where they were planned, which nothing can change.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_lq::lq_problem::{LqProblem, LqSize};
use delmpc_lq::lq_stage::{BoxBounds, LqStage, StageCost};
use delmpc_mechanics::contact_stage::{BoundaryState, ContactKind, ContactStage, LiftedStage, StageNominal};
use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_messages::ConstraintKind;

use crate::contact_schedule::{ContactSchedule, FootPhase};
use crate::errors::HorizonError;
use crate::foot_cone::{FlatFoot, WrenchCone};
use crate::legged_model::LeggedModel;
use crate::legged_tasks::{LeggedTasks, LeggedWeights};
use crate::limits::ConstraintConfig;
use crate::motion_plan::MotionPlan;
use crate::motion_reference::{MotionReference, Target};
use crate::stage_grid::StageGrid;

/// The problem and what filling it takes.
#[derive(Debug)]
pub struct LeggedProblem {
    rule: LobattoRule,
    stage: ContactStage,
    lifted: LiftedStage,
    nominal: StageNominal,
    tasks: LeggedTasks,
    torque_fraction: f64,
    torque_weight: Vec<f64>,
    robot_weight_n: f64,
    /// Cone rows of every foot: the first among the rows of a stage, and their bounds.
    cones: Vec<(usize, Vec<f64>)>,
    active: Vec<bool>,
    swinging: Vec<bool>,
    scratch: Vec<f64>,
    terminal: StageCost,
    /// The problem.
    pub problem: LqProblem,
}

/// Lever by which torques of a sole are compared with forces, m.
const LEVER_M: f64 = 0.1;

impl LeggedProblem {
    /// Takes all memory.
    ///
    /// # Errors
    /// [`HorizonError`] for a model or limits that cannot be used.
    pub fn new(
        model: &LeggedModel,
        stages: usize,
        weights: LeggedWeights,
        limits: &ConstraintConfig,
    ) -> Result<Self, HorizonError> {
        model.check()?;
        let tree = &model.tree;
        let (nv, nu) = (tree.dof(), tree.joint_count());
        let rule = LobattoRule::new(2)?;
        let contacts = model.contacts();
        let stage = ContactStage::new(tree, &rule, &contacts)?;
        let rows = stage.row_count();
        let robot_weight_n = model.weight_n();
        let mut output_rows = Vec::new();
        let mut cones = Vec::new();
        for (k, shape) in model.feet.iter().enumerate() {
            let foot = FlatFoot {
                polygon: shape.polygon.clone(),
                margin_m: limits.cop_margin_m,
                friction: limits.friction,
                friction_sides: limits.friction_sides,
                yaw_arm_m: limits.yaw_arm_m,
                min_force_n: limits.min_force_fraction * robot_weight_n,
            };
            let (cone, offset) = match shape.is_flat() {
                true => (WrenchCone::flat_foot(&foot, robot_weight_n, limits.contact_penalty)?, 0),
                false => (WrenchCone::point(&foot, robot_weight_n, limits.contact_penalty)?, 3),
            };
            let first = stage.rows_of(k).start;
            cones.push((output_rows.len(), cone.rows().iter().map(|row| row.bound).collect()));
            output_rows.extend(cone.output_rows().map(|mut row| {
                let own = core::mem::replace(&mut row.coefficients, vec![0.0; rows]);
                row.coefficients[first..first + 6 - offset].copy_from_slice(&own[offset..]);
                row
            }));
        }
        let residuals = LeggedTasks::residuals(model);
        let mut problem = LqProblem::new(LqSize {
            states: 2 * nv,
            inputs: nu,
            stages,
            outputs: rows,
            rows: output_rows.len(),
            residuals,
            squares: rows,
        });
        problem.output_rows = output_rows;
        for (j, limit) in model.limits.iter().enumerate() {
            problem.input_tags[j].label = ConstraintKind::Torque as u32;
            problem.input_tags[j].scale = limit.effort.min(1e9);
            let position = &mut problem.state_tags[6 + j];
            (position.label, position.row) = (ConstraintKind::JointPosition as u32, j as u32);
            position.penalty = limits.position_penalty;
            let velocity = &mut problem.state_tags[nv + 6 + j];
            (velocity.label, velocity.row) = (ConstraintKind::JointVelocity as u32, j as u32);
            velocity.penalty = limits.velocity_penalty;
            velocity.scale = limit.velocity.min(1e9);
        }
        let torque_weight = model.limits.iter().map(|limit| {
            // Without a limit, 100 N·m stands for one.
            let effort = if limit.effort.is_finite() { limit.effort } else { 100.0 };
            weights.torque / (effort * effort)
        });
        Ok(Self {
            torque_weight: torque_weight.collect(),
            lifted: stage.lifted(),
            nominal: stage.nominal(),
            tasks: LeggedTasks::new(model, weights)?,
            stage,
            rule,
            torque_fraction: limits.torque_fraction,
            robot_weight_n,
            cones,
            active: vec![false; model.feet.len()],
            swinging: vec![false; model.feet.len()],
            scratch: Vec::with_capacity(2 * nv + nu),
            terminal: StageCost::new(0, 2 * nv, residuals, 0),
            problem,
        })
    }

    /// Rows of all contacts.
    pub fn contact_rows(&self) -> usize {
        self.stage.row_count()
    }

    /// The mechanics of a stage.
    pub fn contact_stage(&self) -> &ContactStage {
        &self.stage
    }

    /// Fills the problem about the plan `nominal` on `grid`. No allocation.
    ///
    /// # Errors
    /// The first stage that cannot be linearised.
    pub fn linearise(
        &mut self,
        model: &LeggedModel,
        grid: &StageGrid,
        schedule: &ContactSchedule,
        reference: &MotionReference,
        nominal: &MotionPlan,
    ) -> Result<(), StepError> {
        for k in 0..grid.stages() {
            self.linearise_stage(model, (grid, schedule), nominal, k)?;
            let (duration, target) = (grid.length(k), reference.target(k));
            self.find_swinging(grid, schedule, k);
            let cost = &mut self.problem.stages[k].cost;
            self.tasks.fill(model, &nominal.states[k], target, duration, &self.swinging, cost)?;
            self.cost_of_torques(k, target, nominal.input(k), duration);
            self.cost_of_forces(k, target, duration);
            bound(model, self.torque_fraction, nominal, k, &mut self.problem.stages[k]);
        }
        let last = grid.stages();
        self.find_swinging(grid, schedule, last);
        let (state, target) = (&nominal.states[last], reference.target(last));
        let duration = self.tasks.weights().terminal_s;
        self.tasks.fill(model, state, target, duration, &self.swinging, &mut self.terminal)?;
        self.terminal_from_cost();
        bound_state(model, state, &mut self.problem.terminal_state);
        Ok(())
    }

    /// Transition, outputs and rows.
    fn linearise_stage(
        &mut self,
        model: &LeggedModel,
        (grid, schedule): (&StageGrid, &ContactSchedule),
        nominal: &MotionPlan,
        k: usize,
    ) -> Result<(), StepError> {
        let (duration, inside) = (grid.length(k), grid.inside(k));
        for foot in 0..self.active.len() {
            self.active[foot] = false;
            if let FootPhase::Stance(stance) = schedule.phase(foot, inside) {
                self.active[foot] = true;
                self.stage.set_axes(foot, stance.place.axes_w)?;
            }
        }
        let (start, end) = (&nominal.states[k], &nominal.states[k + 1]);
        self.nominal.interpolate(&self.rule, duration, start, end, nominal.force(k));
        let Self { stage, lifted, active, .. } = self;
        stage.linearize(
            &model.tree,
            duration,
            active,
            start,
            &self.nominal,
            nominal.input(k),
            end,
            lifted,
        )?;
        let states = 2 * lifted.dof();
        let out = &mut self.problem.stages[k];
        let rows = out.transition_rows();
        for row in 0..states {
            let (_, [x, u]) = parts(lifted.transition_row(row), states);
            let target = &mut rows.values[row * rows.row_stride..];
            target[..u.len()].copy_from_slice(u);
            target[rows.first_state..rows.first_state + states].copy_from_slice(x);
        }
        for row in 0..states {
            out.set_defect(row, lifted.d(row));
        }
        for row in 0..self.stage.row_count() {
            let output = out.output_mut(row);
            output.by_input.fill(0.0);
            output.by_state.fill(0.0);
            *output.value = 0.0;
        }
        for (row, &of_all) in lifted.row_of_all().iter().enumerate() {
            let (constant, [x, u]) = parts(lifted.force_row(row), states);
            let output = out.output_mut(of_all as usize);
            output.by_input.copy_from_slice(u);
            output.by_state.copy_from_slice(x);
            *output.value = constant;
        }
        for (active, (first, bounds)) in self.active.iter().zip(&self.cones) {
            for (bound, of_cone) in out.row_bounds[*first..].iter_mut().zip(bounds) {
                *bound = if *active { *of_cone } else { f64::INFINITY };
            }
        }
        Ok(())
    }

    /// Feet that are in the air in the stage that begins at a boundary, or were in the one that ends there: a foot that lands is aimed
    /// at the ground until it is there.
    fn find_swinging(&mut self, grid: &StageGrid, schedule: &ContactSchedule, boundary: usize) {
        for (foot, swinging) in self.swinging.iter_mut().enumerate() {
            let stage = boundary.min(grid.stages() - 1);
            let before = boundary.checked_sub(1);
            *swinging = !schedule.stands(foot, grid.inside(stage))
                || before.is_some_and(|k| !schedule.stands(foot, grid.inside(k)));
        }
    }

    fn cost_of_torques(&mut self, k: usize, target: &Target, nominal: &[f64], duration: f64) {
        let cost = &mut self.problem.stages[k].cost;
        for (j, weight) in self.torque_weight.iter().enumerate() {
            let weight = weight * duration;
            cost.input_weight[j] = weight;
            cost.input_gradient[j] = weight * (nominal[j] - target.torque[j]);
        }
    }

    fn cost_of_forces(&mut self, k: usize, target: &Target, duration: f64) {
        let weights = self.tasks.weights();
        let scale = libm::sqrt(duration) / self.robot_weight_n;
        let normal = scale * libm::sqrt(weights.normal_force);
        let tangential = scale * libm::sqrt(weights.tangential_force);
        let torque = scale / LEVER_M * libm::sqrt(weights.sole_torque);
        let stage = &mut self.problem.stages[k];
        stage.cost.squares.clear();
        let mut squares = core::mem::take(&mut self.scratch);
        for foot in (0..self.active.len()).filter(|foot| self.active[*foot]) {
            let rows = self.stage.rows_of(foot);
            let flat = self.stage.contacts()[foot].kind == ContactKind::Foot;
            for (i, row) in rows.enumerate() {
                let weight = match (flat, i) {
                    (true, 0..=2) => torque,
                    (true, 5) | (false, 2) => normal,
                    _ => tangential,
                };
                let (by_input, by_state, value) = stage.output(row);
                squares.clear();
                squares.extend_from_slice(by_input);
                squares.extend_from_slice(by_state);
                let (by_input, by_state) = squares.split_at(by_input.len());
                stage.cost.squares.push(weight, (by_input, by_state, value - target.force[row]));
            }
        }
        self.scratch = squares;
    }

    fn terminal_from_cost(&mut self) {
        let Self { terminal, problem, .. } = self;
        let states = terminal.state_weight.len();
        let hessian = &mut problem.terminal_hessian;
        for column in 0..states {
            for row in column..states {
                hessian[(row, column)] = if row == column { terminal.state_weight[row] } else { 0.0 };
            }
            problem.terminal_gradient[column] = terminal.state_gradient[column];
        }
        for r in 0..terminal.residuals.len() {
            let (row, value) = (terminal.residuals.row(r), terminal.residuals.value(r));
            for (i, a) in row.iter().enumerate().filter(|(_, a)| **a != 0.0) {
                problem.terminal_gradient[i] += a * value;
                for (j, b) in row[..=i].iter().enumerate() {
                    hessian[(i, j)] += a * b;
                }
            }
        }
    }
}

/// Constant, and the parts on state and input, of a row `[1 | x | u]`.
fn parts(row: &[f64], states: usize) -> (f64, [&[f64]; 2]) {
    let (constant, rest) = row.split_first().map_or((0.0, row), |(constant, rest)| (*constant, rest));
    let (x, u) = rest.split_at(states.min(rest.len()));
    (constant, [x, u])
}

/// Torque limits as bounds on the deviation from the nominal torque; ranges and speeds of the joints on that from its state.
fn bound(model: &LeggedModel, fraction: f64, nominal: &MotionPlan, k: usize, stage: &mut LqStage) {
    for (j, limit) in model.limits.iter().enumerate() {
        stage.input.upper[j] = fraction * limit.effort - nominal.input(k)[j];
        stage.input.lower[j] = -fraction * limit.effort - nominal.input(k)[j];
    }
    bound_state(model, &nominal.states[k], &mut stage.state);
}

fn bound_state(model: &LeggedModel, nominal: &BoundaryState, bounds: &mut BoxBounds) {
    let nv = bounds.lower.len() / 2;
    for (j, limit) in model.limits.iter().enumerate() {
        bounds.lower[6 + j] = limit.lower - nominal.q[j];
        bounds.upper[6 + j] = limit.upper - nominal.q[j];
        bounds.lower[nv + 6 + j] = -limit.velocity - nominal.rate[j];
        bounds.upper[nv + 6 + j] = limit.velocity - nominal.rate[j];
    }
}
