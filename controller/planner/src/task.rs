//! A motion task in the words of its user, and the [`Problem`] it becomes.

use nalgebra::{DMatrix, DVector, Vector3};

use delmpc_mechanics::kinematics::{Configuration, Kinematics};

use crate::error::PlanError;
use crate::problem::{Blueprint, LinearRow, Problem, Square};
use crate::robot::{BodyPoint, PlanRobot};
use crate::stage::DERIVATIVE;
use crate::terrain::Terrain;

/// Weights of the cost; each is one over the square of the deviation that counts 1, per second where it is a rate of cost.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanWeights {
    /// Torque that counts 1 per second, N m.
    pub torque_nm: f64,
    /// Joint rates, per (rad/s)² and second.
    pub joint_rate: f64,
    /// Right and left legs alike, per rad² and second: legs move together.
    pub legs_alike: f64,
    /// Speed along x away from the mean, per (m/s)² and second.
    pub steady_speed: f64,
    /// Attitude of the base away from the start's, per rad² and second.
    pub base_attitude: f64,
    /// Height of the base away from the start's, per m² and second.
    pub base_height: f64,
    /// Joints away from the start posture, per rad² and second.
    pub posture: f64,
    /// Impulses squared (units of S): makes the split over redundant points unique.
    pub impulse: f64,
    /// End: position and attitude of the base, per m² or rad².
    pub end_base: f64,
    /// End: joints, per rad².
    pub end_joints: f64,
    /// End: velocity of the base, per (m/s)² or (rad/s)².
    pub end_base_rate: f64,
    /// End: joint rates, per (rad/s)².
    pub end_joint_rate: f64,
}

impl Default for PlanWeights {
    fn default() -> Self {
        Self {
            torque_nm: 20.0,
            joint_rate: 1e-3,
            legs_alike: 0.0,
            steady_speed: 0.0,
            base_attitude: 0.0,
            base_height: 0.0,
            posture: 0.0,
            impulse: 1e-3,
            end_base: 50.0,
            end_joints: 5.0,
            end_base_rate: 2.0,
            end_joint_rate: 0.05,
        }
    }
}

/// Rows that make a plan executable: what happens *before* an impact is bounded too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExecutionLimits {
    /// Largest speed of approach of a contact point at the end of a stage, m/s.
    pub touchdown_speed_m_s: f64,
    /// Largest impulse of a contact at the end of a stage, N s. Standing there needs a sixth of the stage's load.
    pub impact_impulse_ns: f64,
}

/// A flat sole on the ground, and how much of it a plan uses.
#[derive(Clone, Debug, PartialEq)]
pub struct Standing {
    /// The sole's name.
    pub sole: String,
    /// Box within the sole's polygon for the pressure point, in the sole's frame: least and largest x, y, m.
    pub pressure_m: [[f64; 2]; 2],
    /// Yaw torque per vertical force, m.
    pub yaw_arm_m: f64,
}

/// Weight of a hand away from its target, 1/m².
const REACH_WEIGHT: f64 = 2e4;

/// Base motion is bounded to this box around the start, so that the chart of the base stays regular.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaseBounds {
    /// Largest pitch, roll, yaw away from zero, rad.
    pub attitude_rad: f64,
    /// Lowest and highest base height, m.
    pub height_m: (f64, f64),
}

/// A task: from a posture to the same posture further on.
#[derive(Clone, Debug)]
pub struct Task {
    /// The robot.
    pub robot: PlanRobot,
    /// The ground.
    pub terrain: Terrain,
    /// Stages.
    pub stages: usize,
    /// Length of the motion, s.
    pub horizon_s: f64,
    /// Way along x, m.
    pub distance_m: f64,
    /// Speed of the base along x at the start and the end, m/s.
    pub speed_m_s: (f64, f64),
    /// Coordinates at the start.
    pub start: Vec<f64>,
    /// Coefficient of friction that the plan may use.
    pub friction: f64,
    /// Whether a foot that carries may slide.
    pub sliding: bool,
    /// Part of the joints' ranges that is kept free at either end.
    pub range_margin: f64,
    /// Part of the torque limits that the plan may use.
    pub torque_fraction: f64,
    /// Torque limit of joints without one, N m.
    pub torque_limit_nm: f64,
    /// Rate limit of driven joints without one, rad/s.
    pub rate_limit: f64,
    /// Largest part of the weight that a contact point carries in the mean of a stage; none: any. Below a half two or more feet stand.
    pub point_load: Option<f64>,
    /// Part of the rate limits that the plan may use.
    pub rate_fraction: f64,
    /// Bounds of single coordinates besides the robot's limits: coordinate, lowest, highest.
    pub bounds: Vec<(usize, f64, f64)>,
    /// Bounds of the base.
    pub base: BaseBounds,
    /// Points of the legs that keep clear of ground and obstacles.
    pub clearance: Vec<BodyPoint>,
    /// Weights.
    pub weights: PlanWeights,
    /// Pairs of coordinates that the weight `legs_alike` holds together.
    pub alike: Vec<(usize, usize)>,
    /// Rows for execution.
    pub execution: Option<ExecutionLimits>,
    /// The sole that it stands on ([`PlanRobot::standing`]); none for robots with contact points.
    pub standing: Option<Standing>,
    /// A point of the robot and where it should be at the end.
    pub reach: Option<(BodyPoint, [f64; 3])>,
    /// How far the base of the guess is raised above the start posture in the middle of the motion, m.
    pub guess_lift_m: f64,
}

impl Task {
    /// Mean speed along x, m/s.
    pub fn mean_speed(&self) -> f64 {
        self.distance_m / self.horizon_s
    }

    /// The problem.
    ///
    /// # Errors
    /// [`PlanError`] when the start does not fit the robot or a number is out of range.
    pub fn problem(&self) -> Result<Problem, PlanError> {
        let robot = self.robot.clone();
        let n = robot.dof();
        if self.start.len() != n {
            return Err(PlanError::OutOfRange {
                key: "plan.start",
                value: self.start.len() as f64,
                rule: "one value per coordinate of the robot",
            });
        }
        let mut problem = Problem::new(Blueprint {
            robot,
            terrain: self.terrain.clone(),
            friction: self.friction,
            sliding: self.sliding,
            stages: self.stages,
            horizon_s: self.horizon_s,
            clearance: self.clearance.clone(),
            touchdown_speed: self.execution.map(|limits| limits.touchdown_speed_m_s),
            standing: self.standing.is_some(),
        })?;
        self.scale_rows(&mut problem)?;
        self.add_bounds(&mut problem);
        self.add_cost(&mut problem);
        if let Some(load) = self.point_load {
            self.add_load_rows(&mut problem, load);
        }
        if let Some(limits) = self.execution {
            self.add_execution_rows(&mut problem, limits);
        }
        if let Some(standing) = &self.standing {
            self.add_sole_rows(&mut problem, standing);
        }
        problem.reach = self.reach.as_ref().map(|(point, target)| crate::problem::Reach {
            point: point.clone(),
            target: *target,
            weight: REACH_WEIGHT,
        });
        let velocity = self.start_velocity()?;
        problem.fix_start(&self.start, &velocity);
        Ok(problem)
    }

    /// Scale of the unknown torques: what counts 1 in steps and gradients.
    fn torque_scale(&self) -> f64 {
        0.5 * self.weights.torque_nm
    }

    /// DEL rows: row j × `sqrt(M_base / M_jj)`, at most 30, so that light links count.
    fn scale_rows(&self, problem: &mut Problem) -> Result<(), PlanError> {
        let n = problem.layout.n;
        let diagonal = mass_diagonal(&self.robot, &self.start)?;
        let mass = problem.model.total_mass();
        for j in 0..n {
            let factor = if self.robot.planar { 1.0 } else { (mass / diagonal[j]).sqrt().clamp(1.0, 30.0) };
            problem.row_scale[j] = factor / problem.unit_ns;
        }
        for input in 0..problem.layout.inputs {
            let at = problem.layout.input(input);
            problem.scale[at] = self.torque_scale();
        }
        Ok(())
    }

    fn add_bounds(&self, problem: &mut Problem) {
        let robot = &self.robot;
        for j in 0..robot.dof() {
            let limits = &robot.limits[j];
            if j >= robot.base_coordinates {
                let range = limits.upper - limits.lower;
                let margin = if range.is_finite() { self.range_margin * range } else { 0.0 };
                // A start beyond the margin may stay, not go further.
                let (lower, upper) = (limits.lower + margin, limits.upper - margin);
                problem.bound_position(j, lower.min(self.start[j]), upper.max(self.start[j]));
            }
            let name = robot.coordinates[j].as_str();
            match name {
                "base_pitch" | "base_roll" | "base_yaw" => {
                    problem.bound_position(j, -self.base.attitude_rad, self.base.attitude_rad);
                }
                "base_z" => problem.bound_position(j, self.base.height_m.0, self.base.height_m.1),
                _ => {}
            }
        }
        for &(j, low, high) in &self.bounds {
            problem.bound_position(j, low, high);
        }
        for (input, &j) in robot.actuated.iter().enumerate() {
            let limits = &robot.limits[j];
            let rate = if limits.velocity.is_finite() { limits.velocity } else { self.rate_limit };
            problem.bound_rate(j, self.rate_fraction * rate);
            let effort = if limits.effort.is_finite() { limits.effort } else { self.torque_limit_nm };
            problem.bound_input(input, self.torque_fraction * effort);
        }
    }

    fn add_cost(&self, problem: &mut Problem) {
        let (layout, robot, w) = (problem.layout, &self.robot, &self.weights);
        let cost = &mut problem.cost;
        let mut per_time = |form: Vec<(usize, f64)>, target: f64, weight: f64| {
            if weight > 0.0 {
                cost.push(Square { form, target, weight, per_time: true });
            }
        };
        for input in 0..layout.inputs {
            per_time(vec![(layout.input(input), 1.0)], 0.0, 1.0 / (w.torque_nm * w.torque_nm));
        }
        for j in robot.base_coordinates..robot.dof() {
            per_time(vec![(layout.v(1, j), 1.0)], 0.0, w.joint_rate);
            per_time(vec![(layout.q(1, j), 1.0)], self.start[j], w.posture);
        }
        for &(a, b) in &self.alike {
            per_time(vec![(layout.q(1, a), 1.0), (layout.q(1, b), -1.0)], 0.0, w.legs_alike);
        }
        for (j, name) in robot.coordinates.iter().enumerate() {
            match name.as_str() {
                "base_x" => per_time(vec![(layout.v(1, j), 1.0)], self.mean_speed(), w.steady_speed),
                "base_z" => per_time(vec![(layout.q(1, j), 1.0)], self.start[j], w.base_height),
                "base_pitch" | "base_roll" | "base_yaw" => {
                    per_time(vec![(layout.q(1, j), 1.0)], self.start[j], w.base_attitude);
                }
                _ => {}
            }
        }
        let law = problem.law;
        for i in 0..layout.contacts {
            for node in 0..3 {
                let weight = w.impulse / crate::stage::WEIGHTS[node];
                let first = layout.contact(i);
                let mut plain = |index: usize| {
                    problem.cost.push(Square {
                        form: vec![(first + index - law.first_impulse(), 1.0)],
                        target: 0.0,
                        weight,
                        per_time: false,
                    });
                };
                plain(law.normal(node));
                for t in 0..law.tangents {
                    plain(law.tangential(node) + t);
                }
            }
        }
        let goal = self.goal();
        if self.standing.is_some() {
            // A hand that reaches decides the posture; the robot comes to rest.
            for j in robot.base_coordinates..robot.dof() {
                let rest = Square {
                    form: vec![(layout.v(1, j), 1.0)],
                    target: 0.0,
                    weight: w.end_joint_rate,
                    per_time: false,
                };
                problem.terminal.push(rest);
            }
            return;
        }
        for j in 0..robot.dof() {
            let base = j < robot.base_coordinates;
            let speed = if robot.coordinates[j] == "base_x" { self.speed_m_s.1 } else { 0.0 };
            let weights = if base { (w.end_base, w.end_base_rate) } else { (w.end_joints, w.end_joint_rate) };
            let end = |at: usize, target: f64, weight: f64| Square {
                form: vec![(at, 1.0)],
                target,
                weight,
                per_time: false,
            };
            problem.terminal.push(end(layout.q(1, j), goal[j], weights.0));
            problem.terminal.push(end(layout.v(1, j), speed, weights.1));
        }
    }

    /// Wrench of the ground on the sole at every node: unilateral, friction, pressure point, yaw.
    fn add_sole_rows(&self, problem: &mut Problem, standing: &Standing) {
        let [[x_min, x_max], [y_min, y_max]] = standing.pressure_m;
        // Half of the square inscribed in the friction circle.
        let slope = self.friction * std::f64::consts::FRAC_1_SQRT_2;
        for node in 0..3 {
            let at = problem.layout.sole(node);
            // Order of the virtual joints: forces along x, y, z, torques about z, y, x.
            let (fx, fy, fz, mz, my, mx) = (at, at + 1, at + 2, at + 3, at + 4, at + 5);
            let mut row = |form: Vec<(usize, f64)>| problem.rows.push(LinearRow { form, constant: 0.0 });
            row(vec![(fz, 1.0)]);
            for sign in [1.0, -1.0] {
                row(vec![(fz, slope), (fx, sign)]);
                row(vec![(fz, slope), (fy, sign)]);
                row(vec![(fz, standing.yaw_arm_m), (mz, sign)]);
            }
            // Pressure point (-M_y, M_x)/f_z.
            row(vec![(fz, x_max), (my, 1.0)]);
            row(vec![(fz, -x_min), (my, -1.0)]);
            row(vec![(fz, y_max), (mx, -1.0)]);
            row(vec![(fz, -y_min), (mx, 1.0)]);
        }
    }

    /// Impact impulse and joint rates before an impact: `|q^0 - 4 q^½ + 3 q^1| <= limit Δt`.
    fn add_execution_rows(&self, problem: &mut Problem, limits: ExecutionLimits) {
        let layout = problem.layout;
        let law = problem.law;
        for k in 0..problem.stages {
            for i in 0..layout.contacts {
                let at = layout.inner_at(k) + layout.contact(i) + law.normal(2) - law.first_impulse();
                problem.upper[at] = limits.impact_impulse_ns / problem.unit_ns;
            }
        }
        for &j in &self.robot.actuated {
            let limit = &self.robot.limits[j];
            let rate = if limit.velocity.is_finite() { limit.velocity } else { self.rate_limit };
            for sign in [1.0, -1.0] {
                let mut form: Vec<(usize, f64)> =
                    (0..3).map(|alpha| (layout.node(alpha, j), -sign * DERIVATIVE[2][alpha])).collect();
                form.push((layout.t(1), rate));
                form.push((layout.t(0), -rate));
                problem.rows.push(LinearRow { form, constant: 0.0 });
            }
        }
    }

    /// `load m g Δt - S Σ_α n^α >= 0` for every contact.
    fn add_load_rows(&self, problem: &mut Problem, load: f64) {
        let (layout, law) = (problem.layout, problem.law);
        let per_second = load * self.stages as f64 / self.horizon_s;
        for i in 0..layout.contacts {
            let normal = |node: usize| (layout.contact(i) + law.normal(node) - law.first_impulse(), -1.0);
            let mut form: Vec<(usize, f64)> = (0..3).map(normal).collect();
            form.extend([(layout.t(1), per_second), (layout.t(0), -per_second)]);
            problem.rows.push(LinearRow { form, constant: 0.0 });
        }
    }

    /// The start posture moved along x.
    pub fn goal(&self) -> Vec<f64> {
        let mut goal = self.start.clone();
        if let Some(x) = self.robot.coordinates.iter().position(|name| name == "base_x") {
            goal[x] += self.distance_m;
        }
        goal
    }

    /// Rates at the start: the base moves with the given speed, contact points at the ground are still.
    ///
    /// # Errors
    /// [`PlanError::Mechanics`] when the kinematics refuse the robot.
    pub fn start_velocity(&self) -> Result<Vec<f64>, PlanError> {
        let robot = &self.robot;
        let n = robot.dof();
        let mut v = vec![0.0; n];
        let Some(x) = robot.coordinates.iter().position(|name| name == "base_x") else { return Ok(v) };
        v[x] = self.speed_m_s.0;
        if self.speed_m_s.0 == 0.0 {
            return Ok(v);
        }
        let mechanics = |error: delmpc_mechanics::errors::ModelError| PlanError::Mechanics(error.to_string());
        let mut kinematics = Kinematics::new(&robot.tree);
        kinematics.update_positions(&robot.tree, &Configuration::fixed(&self.start)).map_err(mechanics)?;
        let mut jacobian = vec![0.0; 3 * n];
        let mut rows: Vec<Vec<f64>> = Vec::new();
        for contact in &robot.contacts {
            let point = Vector3::from(contact.point);
            let height = kinematics.point_w(contact.body, &point).z - contact.radius;
            if height - self.terrain.height(kinematics.point_w(contact.body, &point).x).value > 1e-3 {
                continue;
            }
            kinematics
                .point_jacobian_into(&robot.tree, contact.body, &point, &mut jacobian)
                .map_err(mechanics)?;
            rows.extend(jacobian.chunks_exact(n).map(<[f64]>::to_vec));
        }
        // The rest of the base keeps its attitude and may only rise or sink.
        let free: Vec<usize> =
            (0..n).filter(|&j| j >= robot.base_coordinates || robot.coordinates[j] == "base_z").collect();
        let matrix = DMatrix::from_fn(rows.len(), free.len(), |r, c| rows[r][free[c]]);
        let right = DVector::from_fn(rows.len(), |r, _| -rows[r][x] * v[x]);
        let solution = matrix.svd(true, true).solve(&right, 1e-9).map_err(|error| {
            PlanError::Mechanics(format!("no joint rates keep the feet still at the start: {error}"))
        })?;
        for (c, &j) in free.iter().enumerate() {
            v[j] = solution[c];
        }
        Ok(v)
    }

    /// The guess of a motion: the start posture moved along a cubic in time with the two end speeds, raised in between.
    ///
    /// `noise` shifts coordinate `j` at the time fraction `s` (0 for none).
    pub fn guess(&self, problem: &Problem, noise: impl Fn(usize, f64) -> f64) -> Vec<f64> {
        let layout = problem.layout;
        let stages = problem.stages;
        let n = layout.n;
        let x_at = self.robot.coordinates.iter().position(|name| name == "base_x");
        let z_at = self.robot.coordinates.iter().position(|name| name == "base_z");
        let horizon = self.horizon_s;
        // Cubic with x(0) = 0, x(1) = distance and the end speeds.
        let (v0, v1) = (self.speed_m_s.0 * horizon, self.speed_m_s.1 * horizon);
        let (c2, c3) = (3.0 * self.distance_m - 2.0 * v0 - v1, v0 + v1 - 2.0 * self.distance_m);
        let state = |s: f64, j: usize| {
            let mut q = self.start[j] + noise(j, s);
            if Some(j) == x_at {
                q += s * (v0 + s * (c2 + s * c3));
            }
            if Some(j) == z_at {
                q += self.guess_lift_m;
            }
            q
        };
        let mut guess = vec![0.0; layout.plan(stages)];
        let dt = horizon / stages as f64;
        let law = &problem.law;
        let share = 1.0 / problem.contacts.len().max(1) as f64;
        for k in 0..=stages {
            let s = k as f64 / stages as f64;
            let at = problem.boundary(k);
            for j in 0..n {
                guess[at + j] = state(s, j);
                let h = 1e-4;
                guess[at + n + j] = (state(s + h, j) - state(s - h, j)) / (2.0 * h * horizon);
                if Some(j) == z_at {
                    guess[at + n + j] = 0.0;
                }
            }
            guess[at + 2 * n] = k as f64 * dt;
            if k == stages {
                break;
            }
            let at = layout.inner_at(k);
            for j in 0..n {
                guess[at + j] = state(s + 0.5 / stages as f64, j);
            }
            for node in 0..3 {
                if layout.wrench > 0 {
                    guess[at + layout.sole(node) + 2] = crate::stage::WEIGHTS[node];
                }
            }
            for i in 0..problem.contacts.len() {
                for node in 0..3 {
                    let normal = at + layout.contact(i) + law.normal(node) - law.first_impulse();
                    guess[normal] = share * crate::stage::WEIGHTS[node];
                    let slip = at + layout.contact(i) + law.slip(node) - law.first_impulse();
                    guess[slip] = 0.05;
                }
            }
        }
        guess
    }
}

/// Diagonal of the mass matrix.
fn mass_diagonal(robot: &PlanRobot, q: &[f64]) -> Result<Vec<f64>, PlanError> {
    use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
    let mechanics = |error: delmpc_mechanics::errors::ModelError| PlanError::Mechanics(error.to_string());
    let n = robot.dof();
    let mut kinematics = Kinematics::new(&robot.tree);
    kinematics.update_positions(&robot.tree, &Configuration::fixed(q)).map_err(mechanics)?;
    let mut matrix = vec![0.0; n * n];
    let mut workspace = MassMatrixWorkspace::new(&robot.tree);
    mass_matrix_into(&robot.tree, &kinematics, &mut workspace, &mut matrix).map_err(mechanics)?;
    Ok((0..n).map(|j| matrix[j * n + j]).collect())
}
