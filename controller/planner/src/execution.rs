//! Whether a plan can be carried out: every stage integrated finely from its own start.
//!
//! A DEL residual of 1e-14 says nothing about that: order 4 holds for short stages, and a stage that spans several time
//! constants of a robot on its toes misses its own end. Here each stage is integrated with the classical Runge-Kutta method
//! and many small steps, with its torque held and its loaded contacts held at the ground; at its end the contacts that the
//! plan loads there take their inelastic impact. What counts is the distance from the plan's next boundary, and the motion
//! *before* the impact, which no row on the boundary state sees.

use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, bias_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use nalgebra::{DMatrix, DVector, Vector3};
use serde::Serialize;

use crate::check::{SoleUse, robot_of};
use crate::error::PlanError;
use crate::plan_file::{LOADED, Plan};
use crate::robot::PlanRobot;

/// Runge-Kutta steps per stage.
const STEPS: usize = 60;
/// Slip over a stage above which a loaded contact counts as sliding, m.
const SLIDES_M: f64 = 1e-3;
/// Regularisation of the contact equations, relative: heel and toe of one foot are redundant.
const REDUNDANT: f64 = 1e-9;

/// What the fine integration found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Execution {
    /// Largest distance of a coordinate from the plan at the end of a stage, rad or m.
    pub position: f64,
    /// Largest distance of a rate from the plan at the end of a stage, rad/s or m/s.
    pub rate: f64,
    /// The stage of the largest distance of a rate.
    pub worst_stage: usize,
    /// Stages off by more than 0.01 rad or 0.3 rad/s.
    pub stages_off: Vec<usize>,
    /// Fastest approach of a contact point just before its impact, m/s.
    pub touchdown_m_s: f64,
    /// Fastest driven joint just before an impact, rad/s.
    pub rate_before_impact: f64,
    /// Distances per stage: position, rate.
    pub per_stage: Vec<[f64; 2]>,
    /// What the sole of a standing robot takes at every fine step; none for robots with contact points.
    pub sole: Option<SoleUse>,
}

/// Accuracy at which a stage is accepted: position (rad or m), rate (rad/s or m/s).
pub const ACCEPTED: [f64; 2] = [0.01, 0.3];

/// Integrates every stage of a plan finely.
///
/// # Errors
/// [`PlanError::PlanFile`] when the plan is of another robot, [`PlanError::Mechanics`] when the mechanics refuse it.
pub fn execute(plan: &Plan, robot: &PlanRobot) -> Result<Execution, PlanError> {
    let robot = robot_of(plan, robot)?;
    let mut simulation = Simulation::new(plan, &robot);
    let mut out = Execution::default();
    for k in 0..plan.stages {
        let (q, before) = simulation.stage(k)?;
        let touching: Vec<usize> =
            (0..plan.contacts.len()).filter(|&i| plan.normal(k, i, 2) > LOADED).collect();
        let after = simulation.impact(&q, &before, &touching)?;
        let n = robot.dof();
        let far = |a: &[f64], b: &[f64]| (0..n).fold(0.0f64, |worst, j| worst.max((a[j] - b[j]).abs()));
        let (position, rate) = (far(&q, &plan.q[k + 1]), far(&after, &plan.v[k + 1]));
        out.per_stage.push([position, rate]);
        out.sole = simulation.sole;
        out.position = out.position.max(position);
        if rate > out.rate {
            (out.rate, out.worst_stage) = (rate, k);
        }
        if position > ACCEPTED[0] || rate > ACCEPTED[1] || !rate.is_finite() {
            out.stages_off.push(k);
        }
        let landing: Vec<usize> = touching.into_iter().filter(|&i| !plan.is_loaded(k, i)).collect();
        if !landing.is_empty() {
            let speeds = simulation.normal_speeds(&q, &before, &landing)?;
            out.touchdown_m_s = speeds.into_iter().fold(out.touchdown_m_s, |worst, v| worst.max(-v));
            for &j in &robot.actuated {
                out.rate_before_impact = out.rate_before_impact.max(before[j].abs());
            }
        }
    }
    Ok(out)
}

struct Simulation<'a> {
    plan: &'a Plan,
    robot: &'a PlanRobot,
    kinematics: Kinematics,
    mass: MassMatrixWorkspace,
    inverse: InverseDynamicsWorkspace,
    jacobian: Vec<f64>,
    /// What the sole took so far, for a robot that stands on one.
    sole: Option<SoleUse>,
}

fn mechanics(error: impl std::fmt::Display) -> PlanError {
    PlanError::Mechanics(error.to_string())
}

impl<'a> Simulation<'a> {
    fn new(plan: &'a Plan, robot: &'a PlanRobot) -> Self {
        Self {
            plan,
            robot,
            kinematics: Kinematics::new(&robot.tree),
            mass: MassMatrixWorkspace::new(&robot.tree),
            inverse: InverseDynamicsWorkspace::new(&robot.tree),
            jacobian: vec![0.0; 3 * robot.dof()],
            sole: plan.standing.is_some().then_some(SoleUse::NONE),
        }
    }

    /// Rows of the held directions of contacts: all for sticking ones, the normal for sliding ones.
    fn rows(&mut self, q: &[f64], contacts: &[(usize, bool)]) -> Result<DMatrix<f64>, PlanError> {
        let (n, tree) = (self.robot.dof(), &self.robot.tree);
        self.kinematics.update_positions(tree, &Configuration::fixed(q)).map_err(mechanics)?;
        let axes: &[usize] = if self.robot.planar { &[0, 2] } else { &[0, 1, 2] };
        let mut rows: Vec<f64> = Vec::new();
        for &(i, sticks) in contacts {
            let contact = &self.robot.contacts[i];
            let point = Vector3::from(contact.point);
            self.kinematics
                .point_jacobian_into(tree, contact.body, &point, &mut self.jacobian)
                .map_err(mechanics)?;
            for &axis in axes.iter().filter(|&&axis| sticks || axis == 2) {
                rows.extend_from_slice(&self.jacobian[axis * n..(axis + 1) * n]);
            }
        }
        Ok(DMatrix::from_row_slice(rows.len() / n, n, &rows))
    }

    fn mass_matrix(&mut self, q: &[f64]) -> Result<DMatrix<f64>, PlanError> {
        let (n, tree) = (self.robot.dof(), &self.robot.tree);
        self.kinematics.update_positions(tree, &Configuration::fixed(q)).map_err(mechanics)?;
        let mut matrix = vec![0.0; n * n];
        mass_matrix_into(tree, &self.kinematics, &mut self.mass, &mut matrix).map_err(mechanics)?;
        Ok(DMatrix::from_row_slice(n, n, &matrix))
    }

    /// Acceleration with a generalised force and held contacts.
    fn acceleration(
        &mut self,
        q: &[f64],
        v: &[f64],
        force: &DVector<f64>,
        contacts: &[(usize, bool)],
    ) -> Result<DVector<f64>, PlanError> {
        let (n, tree) = (self.robot.dof(), &self.robot.tree);
        self.kinematics.update(tree, &Configuration::fixed(q), &Velocity::fixed(v)).map_err(mechanics)?;
        let mut bias = vec![0.0; n];
        bias_force_into(tree, &self.kinematics, &mut self.inverse, &mut bias).map_err(mechanics)?;
        let mut right = force.clone();
        for (j, body) in tree.bodies().iter().enumerate() {
            let joint = &body.joint;
            right[j] -= bias[j] + joint.damping * v[j] + joint.stiffness * (q[j] - joint.rest);
        }
        let factor =
            self.mass_matrix(q)?.cholesky().ok_or_else(|| mechanics("the mass matrix is singular"))?;
        let free = factor.solve(&right);
        if self.sole.is_some() {
            return self.held_base(&free, &factor.inverse());
        }
        if contacts.is_empty() {
            return Ok(free);
        }
        let rows = self.rows(q, contacts)?;
        // Ġ v by a central difference along v.
        let h = 1e-6;
        let moved = |sign: f64| -> Vec<f64> { (0..n).map(|j| q[j] + sign * h * v[j]).collect() };
        let (ahead, behind) = (self.rows(&moved(1.0), contacts)?, self.rows(&moved(-1.0), contacts)?);
        let rate = DVector::from_column_slice(v);
        let drift = (ahead - behind) * &rate / (2.0 * h);
        let target = -(&rows * &free) - drift;
        let response = factor.solve(&rows.transpose());
        Ok(&free + &response * solve_redundant(&rows * &response, &target)?)
    }

    /// Acceleration with the base held by the sole; the wrench that holds it is noted.
    fn held_base(&mut self, free: &DVector<f64>, inverse: &DMatrix<f64>) -> Result<DVector<f64>, PlanError> {
        let block = inverse.view((0, 0), (6, 6)).into_owned();
        let target = -free.rows(0, 6).into_owned();
        let wrench = solve_redundant(block, &target)?;
        let mass: f64 = self.robot.tree.bodies().iter().map(|body| body.inertia.mass).sum();
        let [fx, fy, fz, mz, my, mx] = [0, 1, 2, 3, 4, 5].map(|j| wrench[j]);
        if let Some(sole) = &mut self.sole {
            sole.add(&[fx, fy, fz, mx, my, mz], mass * self.plan.gravity);
        }
        Ok(free + inverse.columns(0, 6) * wrench)
    }

    /// Coordinates and rates at the end of a stage, before the impact there.
    fn stage(&mut self, k: usize) -> Result<(Vec<f64>, Vec<f64>), PlanError> {
        let (plan, n) = (self.plan, self.robot.dof());
        let dt = plan.t[k + 1] - plan.t[k];
        let loaded: Vec<usize> = (0..plan.contacts.len()).filter(|&i| plan.is_loaded(k, i)).collect();
        let place = |this: &mut Self, q: &[f64], i: usize| -> Result<Vector3<f64>, PlanError> {
            let contact = &this.robot.contacts[i];
            this.kinematics
                .update_positions(&this.robot.tree, &Configuration::fixed(q))
                .map_err(mechanics)?;
            Ok(this.kinematics.point_w(contact.body, &Vector3::from(contact.point)))
        };
        let mut contacts = Vec::new();
        let mut force = DVector::zeros(n);
        for (&j, &u) in self.robot.actuated.iter().zip(&plan.u[k]) {
            force[j] = u;
        }
        for i in loaded {
            let (from, to) = (place(self, &plan.q[k], i)?, place(self, &plan.q[k + 1], i)?);
            let slip = (to.x - from.x).hypot(to.y - from.y);
            contacts.push((i, slip < SLIDES_M));
            if slip >= SLIDES_M {
                // A sliding contact rubs with the mean of its planned friction.
                let contact = &self.robot.contacts[i];
                self.kinematics
                    .point_jacobian_into(
                        &self.robot.tree,
                        contact.body,
                        &Vector3::from(contact.point),
                        &mut self.jacobian,
                    )
                    .map_err(mechanics)?;
                for axis in 0..plan.dimension() - 1 {
                    let mean = (plan.impulse[k][i][0][axis] + plan.impulse[k][i][1][axis]) / dt;
                    for j in 0..n {
                        force[j] += self.jacobian[axis * n + j] * mean;
                    }
                }
            }
        }
        let h = dt / STEPS as f64;
        let mut q = DVector::from_column_slice(&plan.q[k]);
        let mut v = DVector::from_column_slice(&plan.v[k]);
        for _ in 0..STEPS {
            let a1 = self.acceleration(q.as_slice(), v.as_slice(), &force, &contacts)?;
            let (q2, v2) = (&q + &v * (0.5 * h), &v + &a1 * (0.5 * h));
            let a2 = self.acceleration(q2.as_slice(), v2.as_slice(), &force, &contacts)?;
            let (q3, v3) = (&q + &v2 * (0.5 * h), &v + &a2 * (0.5 * h));
            let a3 = self.acceleration(q3.as_slice(), v3.as_slice(), &force, &contacts)?;
            let (q4, v4) = (&q + &v3 * h, &v + &a3 * h);
            let a4 = self.acceleration(q4.as_slice(), v4.as_slice(), &force, &contacts)?;
            q += (&v + &v2 * 2.0 + &v3 * 2.0 + &v4) * (h / 6.0);
            v += (&a1 + &a2 * 2.0 + &a3 * 2.0 + &a4) * (h / 6.0);
        }
        Ok((q.as_slice().to_vec(), v.as_slice().to_vec()))
    }

    /// Rates after the inelastic impact of contacts.
    fn impact(&mut self, q: &[f64], v: &[f64], touching: &[usize]) -> Result<Vec<f64>, PlanError> {
        if touching.is_empty() {
            return Ok(v.to_vec());
        }
        let contacts: Vec<(usize, bool)> = touching.iter().map(|&i| (i, true)).collect();
        let rows = self.rows(q, &contacts)?;
        let factor =
            self.mass_matrix(q)?.cholesky().ok_or_else(|| mechanics("the mass matrix is singular"))?;
        let before = DVector::from_column_slice(v);
        let response = factor.solve(&rows.transpose());
        let impulse = solve_redundant(&rows * &response, &-(&rows * &before))?;
        Ok((before + response * impulse).as_slice().to_vec())
    }

    fn normal_speeds(&mut self, q: &[f64], v: &[f64], contacts: &[usize]) -> Result<Vec<f64>, PlanError> {
        let normals: Vec<(usize, bool)> = contacts.iter().map(|&i| (i, false)).collect();
        let rows = self.rows(q, &normals)?;
        Ok((rows * DVector::from_column_slice(v)).as_slice().to_vec())
    }
}

/// Solves a symmetric system that may be redundant.
fn solve_redundant(mut matrix: DMatrix<f64>, right: &DVector<f64>) -> Result<DVector<f64>, PlanError> {
    let size = matrix.nrows();
    let scale = (0..size).fold(0.0f64, |worst, i| worst.max(matrix[(i, i)]));
    for i in 0..size {
        matrix[(i, i)] += REDUNDANT * scale;
    }
    let factor =
        matrix.cholesky().ok_or_else(|| mechanics("the contacts of a stage contradict each other"))?;
    Ok(factor.solve(right))
}
