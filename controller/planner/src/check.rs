//! A plan checked from its file, with the mechanics alone: nothing here uses the planner's own equations.
//!
//! DEL rows come from Algorithm 1 of `delmpc_mechanics` ([`DelWorkspace`]), momenta from its mass matrix, contact points from
//! its kinematics. The law of contact is evaluated as [`crate::contact_law`] states it, from the numbers of the file.

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::forces::StepForces;
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::state::State;
use nalgebra::Vector3;
use serde::Serialize;
use serde_json::Value;

use crate::contact_law::{IMPULSE_SOFTNESS, SLIP_SOFTNESS, soft_length};
use crate::error::PlanError;
use crate::outline::leg_outline;
use crate::plan_file::Plan;
use crate::robot::PlanRobot;
use crate::stage::polynomial;
use crate::terrain::{Gap, Obstacle, Terrain};

/// Points per stage at which clearance is measured.
const POINTS_PER_STAGE: usize = 10;

/// What a check found. Every figure is the largest violation (or the least margin) of the whole plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Findings {
    /// DEL rows with all contact impulses, units of S.
    pub del_s: f64,
    /// How far a contact point is below the ground at nodes ½ and 1, m.
    pub gap_m: f64,
    /// How far `φ + c v_n` is below 0 at the ends of stages, m.
    pub approach_m: f64,
    /// Friction cones and signs of normal impulses, units of S.
    pub cone_s: f64,
    /// How far a slip exceeds its bound, m.
    pub slip_m: f64,
    /// Largest product of a contact and stage, S m.
    pub product_s_m: f64,
    /// Least distance of soles and shanks from the true obstacles, ten points per stage, m; none without obstacles.
    pub clearance_m: Option<f64>,
    /// Lowest point of soles and shanks (spheres: of the sphere) over the ground between the nodes, m.
    pub lowest_m: f64,
    /// Least distance of a loaded contact from the edge of a gap or step, m; none without edges.
    pub edge_m: Option<f64>,
    /// Mean speed along x, m/s; 0 for a robot that stands.
    pub mean_speed_m_s: f64,
    /// Longest time without any loaded contact, s.
    pub longest_flight_s: f64,
    /// Part of the time over an obstacle that is flight (0 to 1); none without obstacles.
    pub crossing_in_flight: Option<f64>,
    /// Largest torque, N m.
    pub torque_nm: f64,
    /// Largest rate of a driven joint at the boundaries, rad/s.
    pub rate: f64,
    /// Longest stage, s.
    pub longest_stage_s: f64,
    /// Largest impulse of a contact at the end of a stage, units of S.
    pub impact_s: f64,
    /// Fastest approach of a contact before it is loaded, from the polynomial's end, m/s.
    pub touchdown_m_s: f64,
    /// What the sole of a standing robot takes at the nodes; none for robots with contact points.
    pub sole: Option<SoleUse>,
    /// Distance of the hand from its target at the end, m; none without a target.
    pub hand_m: Option<f64>,
}

/// What a standing sole takes: extremes over a plan.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SoleUse {
    /// Pressure point in the sole's frame: least and largest x, y, m.
    pub pressure_m: [[f64; 2]; 2],
    /// Horizontal force over vertical force.
    pub friction: f64,
    /// Yaw torque over vertical force, m.
    pub yaw_arm_m: f64,
    /// Least vertical force over the weight.
    pub least_load: f64,
}

impl SoleUse {
    /// Nothing seen yet.
    pub const NONE: Self = Self {
        pressure_m: [[f64::INFINITY, f64::NEG_INFINITY]; 2],
        friction: 0.0,
        yaw_arm_m: 0.0,
        least_load: f64::INFINITY,
    };

    /// Takes a wrench (force, moment about the sole's origin) into account; `weight` in the units of the force.
    pub fn add(&mut self, wrench: &[f64; 6], weight: f64) {
        let [fx, fy, fz, mx, my, mz] = *wrench;
        for (axis, at) in [-my / fz, mx / fz].into_iter().enumerate() {
            self.pressure_m[axis][0] = self.pressure_m[axis][0].min(at);
            self.pressure_m[axis][1] = self.pressure_m[axis][1].max(at);
        }
        self.friction = self.friction.max(fx.hypot(fy) / fz);
        self.yaw_arm_m = self.yaw_arm_m.max((mz / fz).abs());
        self.least_load = self.least_load.min(fz / weight);
    }
}

/// Bounds of a plan that counts as done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// DEL, units of S.
    pub del_s: f64,
    /// Gaps and slips, m.
    pub gap_m: f64,
    /// Cones, units of S.
    pub cone_s: f64,
    /// Products, S m.
    pub product_s_m: f64,
    /// Least clearance, m.
    pub clearance_m: f64,
}

impl Default for Bounds {
    fn default() -> Self {
        Self { del_s: 1e-10, gap_m: 5e-6, cone_s: 5e-6, product_s_m: 2e-5, clearance_m: 0.0 }
    }
}

impl Findings {
    /// Every residual with its bound and whether it holds: name, figure, bound, unit.
    pub fn judged(&self, bounds: &Bounds) -> Vec<(&'static str, f64, f64, &'static str, bool)> {
        let below = |name, value: f64, bound: f64, unit| (name, value, bound, unit, value <= bound);
        let mut list = vec![
            below("DEL rows", self.del_s, bounds.del_s, "S"),
            below("gaps at nodes", self.gap_m, bounds.gap_m, "m"),
            below("speed into the ground", self.approach_m, bounds.gap_m, "m"),
            below("friction cones", self.cone_s, bounds.cone_s, "S"),
            below("slip bounds", self.slip_m, bounds.gap_m, "m"),
            below("products", self.product_s_m, bounds.product_s_m, "S m"),
        ];
        if let Some(clearance) = self.clearance_m {
            let holds = clearance >= bounds.clearance_m;
            list.push(("clearance (at least)", clearance, bounds.clearance_m, "m", holds));
        }
        list
    }

    /// Whether every residual is within its bound.
    pub fn passes(&self, bounds: &Bounds) -> bool {
        self.judged(bounds).iter().all(|&(.., holds)| holds)
    }
}

/// Terrain of a plan: its own, or that of the first version's `task`.
pub fn terrain_of(plan: &Plan) -> Terrain {
    if let Some(terrain) = &plan.terrain {
        return terrain.clone();
    }
    let mut terrain = Terrain::flat();
    let number = |key: &str| plan.task.get(key).and_then(Value::as_f64);
    if let (Some(x_m), Some(height_m), Some(thickness_m)) =
        (number("obstacle_x_m"), number("obstacle_height_m"), number("obstacle_thickness_m"))
    {
        terrain.obstacles.push(Obstacle { x_m, height_m, thickness_m });
    }
    for gap in plan.task.get("gaps_m").and_then(Value::as_array).into_iter().flatten() {
        if let (Some(from_m), Some(to_m)) =
            (gap.get(0).and_then(Value::as_f64), gap.get(1).and_then(Value::as_f64))
        {
            terrain.gaps.push(Gap { from_m, to_m });
            // The first version let a point sink by half a millimetre beside a hole, whose window had tails.
            terrain.ground_slack_m = 5e-4;
            terrain.tails_m = 4e-3;
        }
    }
    terrain
}

/// The robot with the springs and dampers the plan was made with.
///
/// # Errors
/// [`PlanError::PlanFile`] when the plan is of another robot.
pub fn robot_of(plan: &Plan, robot: &PlanRobot) -> Result<PlanRobot, PlanError> {
    let refuse = |what: String| PlanError::PlanFile { file: plan.name.clone(), what };
    if plan.coordinates != robot.coordinates {
        let (theirs, ours) = (plan.coordinates.join(", "), robot.coordinates.join(", "));
        return Err(refuse(format!("coordinates {theirs} are not those of robot `{}`: {ours}", robot.name)));
    }
    let contacts: Vec<&str> = robot.contacts.iter().map(|contact| contact.name.as_str()).collect();
    if plan.contacts != contacts {
        return Err(refuse(format!("contacts are not those of the robot: {}", contacts.join(", "))));
    }
    let springs: Vec<[f64; 2]> = match (&plan.springs, plan.ankle_stiffness) {
        (Some(springs), _) => springs.clone(),
        (None, stiffness) => robot
            .tree
            .bodies()
            .iter()
            .map(|body| {
                let sprung = body.joint.stiffness > 0.0;
                [stiffness.filter(|_| sprung).unwrap_or(body.joint.stiffness), body.joint.rest]
            })
            .collect(),
    };
    robot.with_joint_laws(&plan.joint_damping, &springs)
}

/// Checks a plan.
///
/// # Errors
/// [`PlanError::PlanFile`] when the plan is of another robot, [`PlanError::Mechanics`] when the mechanics refuse it.
pub fn check(plan: &Plan, robot: &PlanRobot) -> Result<Findings, PlanError> {
    let robot = robot_of(plan, robot)?;
    let mut checker = Checker::new(plan, &robot)?;
    let lowest_m = if robot.contacts.is_empty() { 0.0 } else { f64::INFINITY };
    let mut findings = Findings { lowest_m, ..Findings::default() };
    for k in 0..plan.stages {
        findings.del_s = findings.del_s.max(checker.del(k)?);
        checker.contacts(k, &mut findings)?;
        checker.clearance(k, &mut findings)?;
        findings.longest_stage_s = findings.longest_stage_s.max(plan.t[k + 1] - plan.t[k]);
        let torque = plan.u[k].iter().fold(0.0f64, |worst, u| worst.max(u.abs()));
        findings.torque_nm = findings.torque_nm.max(torque);
        for &j in &robot.actuated {
            findings.rate = findings.rate.max(plan.v[k + 1][j].abs());
        }
    }
    checker.flights(&mut findings);
    checker.standing(&mut findings)?;
    if let Some(x) = robot.coordinates.iter().position(|name| name == "base_x") {
        findings.mean_speed_m_s = (plan.q[plan.stages][x] - plan.q[0][x]) / plan.t[plan.stages];
    }
    Ok(findings)
}

struct Checker<'a> {
    plan: &'a Plan,
    robot: &'a PlanRobot,
    terrain: Terrain,
    kinematics: Kinematics,
    mass: MassMatrixWorkspace,
    rule: LobattoRule,
    outline: Vec<crate::robot::BodyPoint>,
    jacobian: Vec<f64>,
    /// Time during which a leg is over an obstacle, and the part of it that is flight, s.
    crossing: [f64; 2],
}

fn mechanics(error: impl std::fmt::Display) -> PlanError {
    PlanError::Mechanics(error.to_string())
}

impl<'a> Checker<'a> {
    fn new(plan: &'a Plan, robot: &'a PlanRobot) -> Result<Self, PlanError> {
        let outline = if robot.planar { leg_outline(robot, 47, 85)? } else { robot.contacts.clone() };
        Ok(Self {
            plan,
            robot,
            terrain: terrain_of(plan),
            kinematics: Kinematics::new(&robot.tree),
            mass: MassMatrixWorkspace::new(&robot.tree),
            rule: LobattoRule::new(2).map_err(mechanics)?,
            outline,
            jacobian: vec![0.0; 3 * robot.dof()],
            crossing: [0.0; 2],
        })
    }

    /// `M(q) v`.
    fn momentum(&mut self, q: &[f64], v: &[f64]) -> Result<Vec<f64>, PlanError> {
        let n = self.robot.dof();
        let tree = &self.robot.tree;
        self.kinematics.update_positions(tree, &Configuration::fixed(q)).map_err(mechanics)?;
        let mut matrix = vec![0.0; n * n];
        mass_matrix_into(tree, &self.kinematics, &mut self.mass, &mut matrix).map_err(mechanics)?;
        Ok((0..n).map(|i| (0..n).map(|j| matrix[i * n + j] * v[j]).sum()).collect())
    }

    /// Impulse of a contact at a node along x, y, z, N s.
    fn force(&self, k: usize, contact: usize, node: usize) -> [f64; 3] {
        match self.plan.impulse[k][contact][node][..] {
            [x, z] => [x, 0.0, z],
            [x, y, z] => [x, y, z],
            _ => [0.0; 3],
        }
    }

    /// Coordinates at a node of a stage.
    fn node(&self, k: usize, node: usize) -> &'a [f64] {
        let plan = self.plan;
        match node {
            0 => &plan.q[k],
            1 => &plan.q_mid[k],
            _ => &plan.q[k + 1],
        }
    }

    /// Largest DEL row of a stage, units of S.
    fn del(&mut self, k: usize) -> Result<f64, PlanError> {
        let n = self.robot.dof();
        let (plan, tree) = (self.plan, &self.robot.tree);
        let start = self.momentum(&plan.q[k], &plan.v[k])?;
        let end = self.momentum(&plan.q[k + 1], &plan.v[k + 1])?;
        let mut torque = vec![0.0; n];
        for (&j, &u) in self.robot.actuated.iter().zip(&plan.u[k]) {
            torque[j] = u;
        }
        let dt = plan.t[k + 1] - plan.t[k];
        let mut del = DelWorkspace::new(tree, &self.rule, dt, ForceCapacity::default()).map_err(mechanics)?;
        let mut state = State::zeros(tree);
        state.q.copy_from_slice(&plan.q[k]);
        state.p.copy_from_slice(&start);
        del.begin(tree, &state, &StepForces::held(&torque)).map_err(mechanics)?;
        for j in 0..n {
            del.set_node(1, j, plan.q_mid[k][j]);
            del.set_node(2, j, plan.q[k + 1][j]);
        }
        del.evaluate(tree, &[]);
        let (mut first, mut next) = (vec![0.0; 2 * n], vec![0.0; n]);
        del.residual_into(tree, &mut first);
        del.next_momentum_into(tree, &mut next);
        let mut rows = vec![0.0; 3 * n];
        for j in 0..n {
            (rows[j], rows[n + j], rows[2 * n + j]) = (first[2 * j], first[2 * j + 1], next[j] - end[j]);
        }
        for node in 0..3 {
            let q = self.node(k, node);
            let tree = &self.robot.tree;
            self.kinematics.update_positions(tree, &Configuration::fixed(q)).map_err(mechanics)?;
            for (i, contact) in self.robot.contacts.iter().enumerate() {
                let force = self.force(k, i, node);
                let point = Vector3::from(contact.point);
                self.kinematics
                    .point_jacobian_into(tree, contact.body, &point, &mut self.jacobian)
                    .map_err(mechanics)?;
                for j in 0..n {
                    for axis in 0..3 {
                        rows[node * n + j] += self.jacobian[axis * n + j] * force[axis];
                    }
                }
            }
        }
        for (node, wrench) in plan.sole_wrench.get(k).into_iter().flatten().enumerate() {
            // Virtual joints: translations along x, y, z, rotations about z, y, x.
            for (j, c) in [0, 1, 2, 5, 4, 3].into_iter().enumerate() {
                rows[node * n + j] += wrench[c];
            }
        }
        Ok(rows.iter().fold(0.0f64, |worst, row| worst.max(row.abs())) / plan.impulse_unit_ns)
    }

    fn positions(&mut self, q: &[f64]) -> Result<Vec<Vector3<f64>>, PlanError> {
        let tree = &self.robot.tree;
        self.kinematics.update_positions(tree, &Configuration::fixed(q)).map_err(mechanics)?;
        let contacts = self.robot.contacts.iter();
        Ok(contacts.map(|c| self.kinematics.point_w(c.body, &Vector3::from(c.point))).collect())
    }

    fn contacts(&mut self, k: usize, findings: &mut Findings) -> Result<(), PlanError> {
        let plan = self.plan;
        let half = 0.5 * plan.horizon_s / plan.stages as f64;
        let dt = plan.t[k + 1] - plan.t[k];
        let s = plan.impulse_unit_ns;
        let tangents = plan.dimension().saturating_sub(1);
        let axes: &[usize] = if tangents == 1 { &[0] } else { &[0, 1] };
        let at = [
            self.positions(self.node(k, 0))?,
            self.positions(self.node(k, 1))?,
            self.positions(self.node(k, 2))?,
        ];
        let velocity = Velocity::fixed(&plan.v[k + 1]);
        self.kinematics.update_velocities(&self.robot.tree, &velocity).map_err(mechanics)?;
        for (i, contact) in self.robot.contacts.iter().enumerate() {
            let x = [at[0][i], at[1][i], at[2][i]];
            let speed = self.kinematics.point_velocity_w(contact.body, &Vector3::from(contact.point));
            let gap = x.map(|x| x.z - contact.radius - self.terrain.height(x.x).value);
            let closed = [0, 1, 2].map(|node| gap[node] + self.terrain.forbidden(x[node].x).value);
            let approach = half * speed.z;
            let slack = self.terrain.ground_slack_m;
            findings.gap_m = findings.gap_m.max(-gap[1] - slack).max(-gap[2] - slack);
            findings.approach_m = findings.approach_m.max(-(gap[2] + approach) - slack);
            let n = [0, 1, 2].map(|node| plan.normal(k, i, node));
            let mut product =
                (n[0] + n[1]) * (closed[0] + closed[1] + closed[2]) + n[2] * (2.0 * closed[2] + approach);
            for node in 0..3 {
                let bound = plan.slip_bound[k][i][node];
                let (mut tau2, mut slip2) = (0.0, 0.0);
                for &axis in axes {
                    let slip = match node {
                        0 | 1 => x[node + 1][axis] - x[node][axis],
                        _ => half * speed[axis],
                    };
                    let tau = plan.impulse[k][i][node][axis.min(tangents - 1)] / s;
                    product += tau * slip;
                    tau2 += tau * tau;
                    slip2 += slip * slip;
                }
                product += plan.friction * n[node] * bound;
                // In space the law's lengths are softened.
                let (tau, slip) = if tangents == 1 {
                    (tau2.sqrt(), slip2.sqrt())
                } else {
                    (soft_length(tau2, IMPULSE_SOFTNESS), soft_length(slip2, SLIP_SOFTNESS))
                };
                findings.cone_s = findings.cone_s.max(tau - plan.friction * n[node]).max(-n[node]);
                findings.slip_m = findings.slip_m.max(slip - bound);
            }
            findings.product_s_m = findings.product_s_m.max(product);
            findings.impact_s = findings.impact_s.max(n[2]);
            if plan.is_loaded(k, i) || n[2] > crate::plan_file::LOADED {
                let edge = self.terrain.distance_to_edge(x[2].x);
                if edge.is_finite() {
                    findings.edge_m = Some(findings.edge_m.unwrap_or(f64::INFINITY).min(edge));
                }
                if !plan.is_loaded(k, i) {
                    let fall = -(gap[0] - 4.0 * gap[1] + 3.0 * gap[2]) / dt;
                    findings.touchdown_m_s = findings.touchdown_m_s.max(fall);
                }
            }
        }
        Ok(())
    }

    fn clearance(&mut self, k: usize, findings: &mut Findings) -> Result<(), PlanError> {
        let n = self.robot.dof();
        let mut q = vec![0.0; n];
        for step in 0..=POINTS_PER_STAGE {
            let w = polynomial(step as f64 / POINTS_PER_STAGE as f64);
            for j in 0..n {
                q[j] = (0..3).map(|node| w[node] * self.node(k, node)[j]).sum();
            }
            let tree = &self.robot.tree;
            self.kinematics.update_positions(tree, &Configuration::fixed(&q)).map_err(mechanics)?;
            let mut over = false;
            for point in &self.outline {
                let x = self.kinematics.point_w(point.body, &Vector3::from(point.point));
                let lowest = x.z - point.radius;
                findings.lowest_m = findings.lowest_m.min(lowest - self.terrain.height(x.x).value);
                let distance = self.terrain.distance_to_boxes(x.x, lowest);
                if distance.is_finite() {
                    findings.clearance_m = Some(findings.clearance_m.unwrap_or(f64::INFINITY).min(distance));
                }
                over |= self.terrain.obstacles.iter().any(|o| (x.x - o.x_m).abs() < 0.5 * o.thickness_m);
            }
            if over {
                let part = (self.plan.t[k + 1] - self.plan.t[k]) / (POINTS_PER_STAGE + 1) as f64;
                self.crossing[0] += part;
                let free = (0..self.plan.contacts.len()).all(|i| !self.plan.is_loaded(k, i));
                self.crossing[1] += if free { part } else { 0.0 };
            }
        }
        Ok(())
    }

    /// What the sole takes, and where the hand ends.
    fn standing(&mut self, findings: &mut Findings) -> Result<(), PlanError> {
        let plan = self.plan;
        let mass: f64 = self.robot.tree.bodies().iter().map(|body| body.inertia.mass).sum();
        for (k, nodes) in plan.sole_wrench.iter().enumerate() {
            let dt = plan.t[k + 1] - plan.t[k];
            for (node, wrench) in nodes.iter().enumerate() {
                let weight = mass * plan.gravity * dt * crate::stage::WEIGHTS[node];
                findings.sole.get_or_insert(SoleUse::NONE).add(wrench, weight);
            }
        }
        let target = plan.task.get("hand").and_then(Value::as_str).zip(plan.task.get("target_m"));
        if let Some((name, target)) = target {
            let frame = self.robot.frames.iter().find(|frame| frame.name == name).ok_or_else(|| {
                PlanError::PlanFile {
                    file: plan.name.clone(),
                    what: format!("the robot has no frame `{name}`"),
                }
            })?;
            let tree = &self.robot.tree;
            let end = Configuration::fixed(&plan.q[plan.stages]);
            self.kinematics.update_positions(tree, &end).map_err(mechanics)?;
            let hand = self.kinematics.point_w(frame.body, &Vector3::from(frame.point));
            let at = |a: usize| target.get(a).and_then(Value::as_f64).unwrap_or(f64::NAN);
            findings.hand_m = Some((hand - Vector3::new(at(0), at(1), at(2))).norm());
        }
        Ok(())
    }

    /// Longest flight, and how much of the time over an obstacle is flight.
    fn flights(&self, findings: &mut Findings) {
        let plan = self.plan;
        if plan.contacts.is_empty() {
            return;
        }
        let in_flight = |k: usize| (0..plan.contacts.len()).all(|i| !plan.is_loaded(k, i));
        let mut length = 0.0;
        for k in 0..plan.stages {
            length = if in_flight(k) { length + plan.t[k + 1] - plan.t[k] } else { 0.0 };
            findings.longest_flight_s = findings.longest_flight_s.max(length);
        }
        let [over, flying] = self.crossing;
        if over > 0.0 {
            findings.crossing_in_flight = Some(flying / over);
        }
    }
}
