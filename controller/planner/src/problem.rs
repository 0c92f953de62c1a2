//! What is to be planned: robot, ground, limits, cost, start, in the unknowns of [`crate::layout`].

use crate::contact_law::LawConstants;
use crate::error::PlanError;
use crate::layout::Layout;
use crate::node::NodeModel;
use crate::robot::{BodyPoint, PlanRobot};
use crate::terrain::Terrain;

/// Fractions of a stage at which legs are kept clear of the ground and of obstacles.
pub const CLEARANCE_AT: [f64; 4] = [0.25, 0.5, 0.75, 1.0];

/// Largest slip of a stage, m. Without a bound, a slip bound could grow until its product with a normal impulse that is negative
/// within tolerance pays for any force in the air.
const LARGEST_SLIP_M: f64 = 2.0;

/// A square in the cost of every stage: `weight (Σ factor z - target)²`, times Δt where so said.
#[derive(Clone, Debug, PartialEq)]
pub struct Square {
    /// Unknowns of the stage vector and their factors.
    pub form: Vec<(usize, f64)>,
    /// Target of the form.
    pub target: f64,
    /// Weight.
    pub weight: f64,
    /// Whether the square is integrated over the stage.
    pub per_time: bool,
}

/// A linear row of every stage: `constant + Σ factor z >= 0`.
#[derive(Clone, Debug, PartialEq)]
pub struct LinearRow {
    /// Unknowns of the stage vector and their factors.
    pub form: Vec<(usize, f64)>,
    /// Constant.
    pub constant: f64,
}

/// A point that should be at a place at the end: `weight |x(q_N) - target|²`.
#[derive(Clone, Debug, PartialEq)]
pub struct Reach {
    /// The point.
    pub point: BodyPoint,
    /// Where it should be, m.
    pub target: [f64; 3],
    /// Weight, 1/m².
    pub weight: f64,
}

/// A planning problem.
#[derive(Clone, Debug)]
pub struct Problem {
    /// The robot.
    pub robot: PlanRobot,
    /// Its constants for the node recursions.
    pub model: NodeModel,
    /// The ground.
    pub terrain: Terrain,
    /// The contact law.
    pub law: LawConstants,
    /// Contact points.
    pub contacts: Vec<BodyPoint>,
    /// Points of the legs that keep clear of ground and obstacles.
    pub clearance: Vec<BodyPoint>,
    /// What a point may be below its bound at the fractions [`CLEARANCE_AT`], m.
    pub clearance_slack_m: [f64; 4],
    /// Stages.
    pub stages: usize,
    /// Length of the motion, s.
    pub horizon_s: f64,
    /// Unit of impulse `S = m g T/N`, N s.
    pub unit_ns: f64,
    /// Unknowns.
    pub layout: Layout,
    /// Factor of every coordinate's DEL row (1/S and more for light links).
    pub row_scale: Vec<f64>,
    /// Cost of every stage.
    pub cost: Vec<Square>,
    /// Cost of the last stage's end.
    pub terminal: Vec<Square>,
    /// A point to bring somewhere.
    pub reach: Option<Reach>,
    /// Further rows of every stage.
    pub rows: Vec<LinearRow>,
    /// Lower bound of every unknown of a plan vector.
    pub lower: Vec<f64>,
    /// Upper bound of every unknown of a plan vector. Equal bounds fix it.
    pub upper: Vec<f64>,
    /// Scale of every unknown of a stage vector: what counts 1 in step norms.
    pub scale: Vec<f64>,
    /// Least and largest `Δt_k`, s.
    pub step_bounds: (f64, f64),
}

/// Sizes of a problem before its bounds and costs are filled in.
pub struct Blueprint {
    /// The robot.
    pub robot: PlanRobot,
    /// The ground.
    pub terrain: Terrain,
    /// Coefficient of friction.
    pub friction: f64,
    /// Whether a point that carries may slide.
    pub sliding: bool,
    /// Stages.
    pub stages: usize,
    /// Length of the motion, s.
    pub horizon_s: f64,
    /// Points of the legs that keep clear.
    pub clearance: Vec<BodyPoint>,
    /// Largest speed of approach before an impact, m/s.
    pub touchdown_speed: Option<f64>,
    /// Whether the base is held by a sole on the ground ([`PlanRobot::standing`]).
    pub standing: bool,
}

impl Problem {
    /// Creates a problem without bounds, cost or further rows.
    ///
    /// # Errors
    /// [`PlanError`] for a robot that the node recursions do not handle or numbers out of range.
    pub fn new(blueprint: Blueprint) -> Result<Self, PlanError> {
        let Blueprint {
            robot,
            terrain,
            friction,
            sliding,
            stages,
            horizon_s,
            clearance,
            touchdown_speed,
            standing,
        } = blueprint;
        if stages < 2 {
            return Err(PlanError::OutOfRange {
                key: "plan.stages",
                value: stages as f64,
                rule: "at least 2",
            });
        }
        if !(horizon_s.is_finite() && horizon_s > 0.0) {
            return Err(PlanError::OutOfRange { key: "plan.horizon_s", value: horizon_s, rule: "positive" });
        }
        let model = NodeModel::new(&robot.tree)?;
        let law = LawConstants {
            tangents: if robot.planar { 1 } else { 2 },
            friction,
            sliding,
            half_stage_s: 0.5 * horizon_s / stages as f64,
            touchdown_speed,
        };
        let contacts = robot.contacts.clone();
        let layout = Layout::new(
            robot.dof(),
            robot.actuated.len(),
            contacts.len(),
            law.impulses(),
            if standing { 18 } else { 0 },
        );
        let mean = horizon_s / stages as f64;
        let unit_ns = model.total_mass() * model.gravity() * mean;
        let mut scale = vec![1.0; layout.stage];
        for end in 0..2 {
            for j in 0..layout.n {
                scale[layout.v(end, j)] = 3.0;
            }
            scale[layout.t(end)] = mean;
        }
        let size = layout.plan(stages);
        let mut problem = Self {
            model,
            terrain,
            law,
            contacts,
            clearance,
            clearance_slack_m: [3e-3; 4],
            stages,
            horizon_s,
            unit_ns,
            layout,
            row_scale: vec![1.0 / unit_ns; layout.n],
            cost: Vec::new(),
            terminal: Vec::new(),
            reach: None,
            rows: Vec::new(),
            lower: vec![f64::NEG_INFINITY; size],
            upper: vec![f64::INFINITY; size],
            scale,
            step_bounds: (0.4 * mean, 1.3 * mean),
            robot,
        };
        for k in 0..stages {
            let y = problem.layout.inner_at(k);
            for i in 0..problem.contacts.len() {
                let at = y + problem.layout.contact(i);
                for node in 0..3 {
                    problem.lower[at + problem.law.normal(node) - problem.law.first_impulse()] = 0.0;
                    let slip = at + problem.law.slip(node) - problem.law.first_impulse();
                    (problem.lower[slip], problem.upper[slip]) = (0.0, LARGEST_SLIP_M);
                }
            }
        }
        if standing {
            for k in 0..=stages {
                for j in 0..6 {
                    problem.fix(problem.boundary(k) + j, 0.0);
                    problem.fix(problem.boundary(k) + layout.n + j, 0.0);
                    if k < stages {
                        problem.fix(layout.inner_at(k) + j, 0.0);
                    }
                }
            }
        }
        problem.fix(problem.boundary(0) + 2 * layout.n, 0.0);
        problem.fix(problem.boundary(stages) + 2 * layout.n, horizon_s);
        Ok(problem)
    }

    /// Mean stage length, s: the unit of the stage length rows.
    pub fn mean_stage_s(&self) -> f64 {
        self.horizon_s / self.stages as f64
    }

    /// Where `X_k` begins in a plan vector.
    pub fn boundary(&self, k: usize) -> usize {
        self.layout.boundary_at(self.stages, k)
    }

    /// Fixes an unknown of the plan vector.
    pub fn fix(&mut self, index: usize, value: f64) {
        (self.lower[index], self.upper[index]) = (value, value);
    }

    /// Bounds coordinate `j` at all nodes except the start.
    pub fn bound_position(&mut self, j: usize, lower: f64, upper: f64) {
        for k in 0..self.stages {
            for at in [self.layout.inner_at(k) + j, self.boundary(k + 1) + j] {
                (self.lower[at], self.upper[at]) = (self.lower[at].max(lower), self.upper[at].min(upper));
            }
        }
    }

    /// Bounds the rate of coordinate `j` at all boundaries except the start.
    pub fn bound_rate(&mut self, j: usize, limit: f64) {
        for k in 1..=self.stages {
            let at = self.boundary(k) + self.layout.n + j;
            (self.lower[at], self.upper[at]) = (self.lower[at].max(-limit), self.upper[at].min(limit));
        }
    }

    /// Bounds input `j` (index among the driven coordinates) in all stages.
    pub fn bound_input(&mut self, j: usize, limit: f64) {
        for k in 0..self.stages {
            let at = self.layout.inner_at(k) + self.layout.input(j);
            (self.lower[at], self.upper[at]) = (-limit, limit);
        }
    }

    /// Fixes the state at the start.
    pub fn fix_start(&mut self, q: &[f64], v: &[f64]) {
        let at = self.boundary(0);
        for j in 0..self.layout.n {
            self.fix(at + j, q[j]);
            self.fix(at + self.layout.n + j, v[j]);
        }
    }

    /// Whether an unknown of the plan vector is fixed.
    pub fn is_fixed(&self, index: usize) -> bool {
        self.lower[index] == self.upper[index]
    }

    /// Rows of a stage: DEL, contacts, clearance, stage length, further rows.
    pub fn row_count(&self) -> usize {
        self.equalities()
            + self.contacts.len() * self.law.rows()
            + 4 * self.clearance.len()
            + 2
            + self.rows.len()
    }

    /// How many of the rows, the first ones, are equations.
    pub fn equalities(&self) -> usize {
        3 * self.layout.n
    }

    /// First row of contact `i`.
    pub fn contact_row(&self, i: usize) -> usize {
        self.equalities() + i * self.law.rows()
    }

    /// Clearance row of a point at one of [`CLEARANCE_AT`].
    pub fn clearance_row(&self, at: usize, point: usize) -> usize {
        self.contact_row(self.contacts.len()) + at * self.clearance.len() + point
    }

    /// First of the two rows that bound the stage length.
    pub fn step_row(&self) -> usize {
        self.clearance_row(4, 0)
    }

    /// First of the further rows.
    pub fn linear_row(&self) -> usize {
        self.step_row() + 2
    }

    /// A row in words.
    pub fn row_name(&self, row: usize) -> String {
        let n = self.layout.n;
        if row < self.equalities() {
            return format!(
                "DEL row of {} at node {}",
                self.robot.coordinates[row % n],
                ["0", "½", "1"][row / n]
            );
        }
        if row < self.clearance_row(0, 0) {
            let (contact, law) =
                ((row - self.equalities()) / self.law.rows(), (row - self.equalities()) % self.law.rows());
            let what = match law {
                0 | 1 => "gap",
                2 => "speed into the ground",
                _ if law == self.law.product_row() => "product",
                _ if law > self.law.product_row() => "touchdown speed",
                _ => "friction cone or slip bound",
            };
            return format!("{what} of {}", self.contacts[contact].name);
        }
        if row < self.step_row() {
            let point = (row - self.clearance_row(0, 0)) % self.clearance.len();
            return format!("clearance of {}", self.clearance[point].name);
        }
        if row < self.linear_row() {
            "stage length".to_owned()
        } else {
            "joint rate before an impact".to_owned()
        }
    }
}
