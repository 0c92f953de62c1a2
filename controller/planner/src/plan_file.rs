//! The plan file: self-describing JSON, one object per plan, SI units, format `contact-plan/1`.
//!
//! | key | shape | what |
//! |---|---|---|
//! | `coordinates`, `actuated`, `contacts` | names | order of `q` and `v`, of `u`, of the contacts |
//! | `t` | N+1 | stage boundaries, s |
//! | `q`, `v` | N+1 x n | coordinates, and momentum velocity (`p = M(q) v`), at the boundaries |
//! | `q_mid` | N x n | coordinates at node ½ |
//! | `u` | N x inputs | torque held over the stage, N m |
//! | `impulse` | N x contact x 3 nodes x (tangential.., normal) | N s |
//! | `slip_bound` | N x contact x 3 | m |
//! | `impulse_unit_Ns` | | `S = m g T/N` |
//! | `kappa`, `residual` | | last relaxation, S m; largest violation of every kind of row |
//! | `gravity`, `friction`, `joint_damping`, `springs` | | what the rows were computed with |
//! | `task`, `provenance` | | what was asked, and how it was made |
//!
//! Keys of our own beside the format's first version: `springs` (every coordinate's `[stiffness, rest]`; the first version
//! has `ankle_stiffness`), `terrain`, `contact_sets` (per stage and contact `#` loaded, `+` touchdown or load at the end,
//! `.` free), `provenance`.

use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::PlanError;
use crate::problem::Problem;
use crate::terrain::Terrain;

/// The version this library reads and writes.
pub const FORMAT: &str = "contact-plan/1";

/// Impulse (units of S) above which a contact counts as loaded.
pub const LOADED: f64 = 2e-3;

/// A plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Version, [`FORMAT`].
    pub format: String,
    /// Name.
    pub name: String,
    /// What it shows.
    #[serde(default)]
    pub note: String,
    /// Name of the robot.
    pub robot: String,
    /// Coordinates in the order of `q` and `v`.
    pub coordinates: Vec<String>,
    /// Driven coordinates in the order of `u`.
    pub actuated: Vec<String>,
    /// Contact points.
    pub contacts: Vec<String>,
    /// Coefficient of friction.
    pub friction: f64,
    /// Stages.
    pub stages: usize,
    /// Length, s.
    pub horizon_s: f64,
    /// `S`, N s.
    #[serde(rename = "impulse_unit_Ns")]
    pub impulse_unit_ns: f64,
    /// Gravity, m/s².
    pub gravity: f64,
    /// Stiffness of all springs of the robot, N m/rad (first version; `springs` says more).
    #[serde(default)]
    pub ankle_stiffness: Option<f64>,
    /// Stiffness (N m/rad) and rest position (rad) of every coordinate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub springs: Option<Vec<[f64; 2]>>,
    /// Damping of every coordinate, N m s/rad.
    pub joint_damping: Vec<f64>,
    /// The ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub terrain: Option<Terrain>,
    /// Boundaries, s.
    pub t: Vec<f64>,
    /// Coordinates at the boundaries.
    pub q: Vec<Vec<f64>>,
    /// Velocities at the boundaries.
    pub v: Vec<Vec<f64>>,
    /// Coordinates at node ½.
    pub q_mid: Vec<Vec<f64>>,
    /// Torques, N m.
    pub u: Vec<Vec<f64>>,
    /// Impulses, N s.
    pub impulse: Vec<Vec<Vec<Vec<f64>>>>,
    /// Slip bounds, m.
    pub slip_bound: Vec<Vec<Vec<f64>>>,
    /// Name of the sole that the robot stands on throughout; its frame is {0} then.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standing: Option<String>,
    /// Wrench impulse of the ground on that sole about its frame's origin, per stage and node: force, moment (N s, N m s).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sole_wrench: Vec<[[f64; 6]; 3]>,
    /// Contact sets, one text per contact.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub contact_sets: Vec<String>,
    /// Largest violations.
    #[serde(default)]
    pub residual: Map<String, Value>,
    /// Last relaxation, S m.
    pub kappa: f64,
    /// What was asked.
    #[serde(default)]
    pub task: Value,
    /// How it was made.
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub provenance: Value,
    /// Facts from a check on ten points per stage (first version).
    #[serde(default, skip_serializing_if = "Value::is_null")]
    pub facts: Value,
}

impl Plan {
    /// Reads a plan and checks its version and shapes.
    ///
    /// # Errors
    /// [`PlanError::PlanFile`] naming the file and the first thing that does not fit.
    pub fn read(path: &Path) -> Result<Self, PlanError> {
        let refuse = |what: String| PlanError::PlanFile { file: path.display().to_string(), what };
        let text =
            std::fs::read_to_string(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
        let value: Value =
            serde_json::from_str(&text).map_err(|error| refuse(format!("not JSON: {error}")))?;
        match value.get("format").and_then(Value::as_str) {
            Some(FORMAT) => {}
            Some(other) => {
                return Err(refuse(format!("format `{other}`; this program reads `{FORMAT}`")));
            }
            None => return Err(refuse(format!("no key `format`: not a plan (a plan says `{FORMAT}`)"))),
        }
        let plan: Self = serde_json::from_value(value).map_err(|error| refuse(error.to_string()))?;
        plan.check_shapes().map_err(refuse)?;
        Ok(plan)
    }

    /// The file's text.
    ///
    /// # Errors
    /// [`PlanError::PlanFile`] when a number cannot be written.
    pub fn to_json(&self) -> Result<String, PlanError> {
        serde_json::to_string(self)
            .map_err(|error| PlanError::PlanFile { file: self.name.clone(), what: error.to_string() })
    }

    /// Components of an impulse: 2 in the plane, 3 in space.
    pub fn dimension(&self) -> usize {
        self.impulse.first().and_then(|stage| stage.first()?.first()).map_or(0, Vec::len)
    }

    fn check_shapes(&self) -> Result<(), String> {
        let (n, stages) = (self.coordinates.len(), self.stages);
        let length = |key: &str, got: usize, expected: usize| {
            if got == expected {
                Ok(())
            } else {
                Err(format!("`{key}` has {got} entries, expected {expected}"))
            }
        };
        let finite = |key: &str, values: &[f64]| match values.iter().position(|x| !x.is_finite()) {
            None => Ok(()),
            Some(at) => Err(format!("`{key}`: entry {at} is not a number")),
        };
        if stages == 0 {
            return Err("`stages` is 0".to_owned());
        }
        length("t", self.t.len(), stages + 1)?;
        finite("t", &self.t)?;
        length("joint_damping", self.joint_damping.len(), n)?;
        for (key, list, count, width) in [
            ("q", &self.q, stages + 1, n),
            ("v", &self.v, stages + 1, n),
            ("q_mid", &self.q_mid, stages, n),
            ("u", &self.u, stages, self.actuated.len()),
        ] {
            length(key, list.len(), count)?;
            for row in list {
                length(key, row.len(), width)?;
                finite(key, row)?;
            }
        }
        length("impulse", self.impulse.len(), stages)?;
        length("slip_bound", self.slip_bound.len(), stages)?;
        let dimension = self.dimension();
        for (impulses, bounds) in self.impulse.iter().zip(&self.slip_bound) {
            length("impulse of a stage", impulses.len(), self.contacts.len())?;
            length("slip_bound of a stage", bounds.len(), self.contacts.len())?;
            for (nodes, bounds) in impulses.iter().zip(bounds) {
                length("impulse of a contact", nodes.len(), 3)?;
                length("slip_bound of a contact", bounds.len(), 3)?;
                finite("slip_bound", bounds)?;
                for node in nodes {
                    length("impulse of a node", node.len(), dimension)?;
                    finite("impulse", node)?;
                }
            }
        }
        if self.standing.is_some() {
            length("sole_wrench", self.sole_wrench.len(), stages)?;
        }
        if let Some(k) = (0..stages).find(|&k| self.t[k + 1] <= self.t[k]) {
            return Err(format!("`t` does not increase at stage {k}"));
        }
        Ok(())
    }

    /// A plan from a plan vector of a problem.
    pub fn from_vector(problem: &Problem, x: &[f64], name: &str, kappa: f64) -> Self {
        let (layout, law, stages) = (problem.layout, problem.law, problem.stages);
        let n = layout.n;
        let boundary = |k: usize, from: usize| {
            let at = problem.boundary(k) + from;
            x[at..at + n].to_vec()
        };
        let inner = |k: usize, from: usize, count: usize| {
            let at = layout.inner_at(k) + from;
            x[at..at + count].to_vec()
        };
        let s = problem.unit_ns;
        let first = law.first_impulse();
        let impulse = |k: usize, i: usize, node: usize| {
            let at = layout.inner_at(k) + layout.contact(i);
            let tau = at + law.tangential(node) - first;
            let mut list: Vec<f64> = (0..law.tangents).map(|t| s * x[tau + t]).collect();
            list.push(s * x[at + law.normal(node) - first]);
            list
        };
        let bound = |k: usize, i: usize, node: usize| {
            x[layout.inner_at(k) + layout.contact(i) + law.slip(node) - first]
        };
        // The unknowns are in the order of the virtual joints: forces x, y, z, torques about z, y, x.
        let wrench = |k: usize| {
            [0, 1, 2]
                .map(|node| [0, 1, 2, 5, 4, 3].map(|c| s * x[layout.inner_at(k) + layout.sole(node) + c]))
        };
        let names =
            |indices: &[usize]| indices.iter().map(|&j| problem.robot.coordinates[j].clone()).collect();
        let mut plan = Self {
            format: FORMAT.to_owned(),
            name: name.to_owned(),
            note: String::new(),
            robot: problem.robot.name.clone(),
            coordinates: problem.robot.coordinates.clone(),
            actuated: names(&problem.robot.actuated),
            contacts: problem.contacts.iter().map(|contact| contact.name.clone()).collect(),
            friction: law.friction,
            stages,
            horizon_s: problem.horizon_s,
            impulse_unit_ns: s,
            gravity: problem.model.gravity(),
            ankle_stiffness: None,
            springs: Some((0..n).map(|j| [problem.model.stiffness[j], problem.model.rest[j]]).collect()),
            joint_damping: problem.model.damping.clone(),
            terrain: Some(problem.terrain.clone()),
            t: (0..=stages).map(|k| x[problem.boundary(k) + 2 * n]).collect(),
            q: (0..=stages).map(|k| boundary(k, 0)).collect(),
            v: (0..=stages).map(|k| boundary(k, n)).collect(),
            q_mid: (0..stages).map(|k| inner(k, 0, n)).collect(),
            u: (0..stages).map(|k| inner(k, layout.input(0), layout.inputs)).collect(),
            impulse: (0..stages)
                .map(|k| {
                    let of_contact = |i: usize| (0..3).map(|node| impulse(k, i, node)).collect();
                    (0..layout.contacts).map(of_contact).collect()
                })
                .collect(),
            slip_bound: (0..stages)
                .map(|k| {
                    (0..layout.contacts).map(|i| (0..3).map(|node| bound(k, i, node)).collect()).collect()
                })
                .collect(),
            standing: None,
            sole_wrench: if layout.wrench > 0 { (0..stages).map(wrench).collect() } else { Vec::new() },
            contact_sets: Vec::new(),
            residual: Map::new(),
            kappa,
            task: Value::Null,
            provenance: Value::Null,
            facts: Value::Null,
        };
        plan.contact_sets = plan.sets();
        plan
    }

    /// The plan vector of a problem with the same robot and as many stages.
    ///
    /// # Errors
    /// [`PlanError::PlanFile`] when the plan is of another robot or size.
    pub fn to_vector(&self, problem: &Problem) -> Result<Vec<f64>, PlanError> {
        let (layout, law) = (problem.layout, problem.law);
        let refuse = |what: String| PlanError::PlanFile { file: self.name.clone(), what };
        if self.coordinates != problem.robot.coordinates {
            return Err(refuse(format!(
                "coordinates {} are not those of the robot: {}",
                self.coordinates.join(", "),
                problem.robot.coordinates.join(", ")
            )));
        }
        if self.stages != problem.stages || (layout.contacts > 0 && self.dimension() != law.dimension()) {
            return Err(refuse(format!("{} stages, the problem has {}", self.stages, problem.stages)));
        }
        let n = layout.n;
        let mut x = vec![0.0; layout.plan(self.stages)];
        let first = law.first_impulse();
        for k in 0..=self.stages {
            let at = problem.boundary(k);
            x[at..at + n].copy_from_slice(&self.q[k]);
            x[at + n..at + 2 * n].copy_from_slice(&self.v[k]);
            x[at + 2 * n] = self.t[k];
            if k == self.stages {
                break;
            }
            let at = layout.inner_at(k);
            x[at..at + n].copy_from_slice(&self.q_mid[k]);
            x[at + layout.input(0)..at + layout.input(0) + layout.inputs].copy_from_slice(&self.u[k]);
            for (node, wrench) in self.sole_wrench.get(k).into_iter().flatten().enumerate() {
                for (c, from) in [0, 1, 2, 5, 4, 3].into_iter().enumerate() {
                    if layout.wrench > 0 {
                        x[at + layout.sole(node) + c] = wrench[from] / problem.unit_ns;
                    }
                }
            }
            for i in 0..layout.contacts {
                let at = at + layout.contact(i);
                for node in 0..3 {
                    let impulse = &self.impulse[k][i][node];
                    for t in 0..law.tangents {
                        x[at + law.tangential(node) + t - first] = impulse[t] / problem.unit_ns;
                    }
                    x[at + law.normal(node) - first] = impulse[law.tangents] / problem.unit_ns;
                    x[at + law.slip(node) - first] = self.slip_bound[k][i][node];
                }
            }
        }
        Ok(x)
    }

    /// Normal impulse of a contact at a node, units of S.
    pub fn normal(&self, k: usize, contact: usize, node: usize) -> f64 {
        self.impulse[k][contact][node].last().copied().unwrap_or(0.0) / self.impulse_unit_ns
    }

    /// Whether a contact is loaded during a stage.
    pub fn is_loaded(&self, k: usize, contact: usize) -> bool {
        self.normal(k, contact, 0) + self.normal(k, contact, 1) > LOADED
    }

    /// Contact sets, one text per contact: `#` loaded during the stage, `+` touches down at its end, `.` free.
    pub fn sets(&self) -> Vec<String> {
        (0..self.contacts.len())
            .map(|i| {
                (0..self.stages)
                    .map(|k| match (self.is_loaded(k, i), self.normal(k, i, 2) > LOADED) {
                        (true, _) => '#',
                        (false, true) => '+',
                        (false, false) => '.',
                    })
                    .collect()
            })
            .collect()
    }
}
