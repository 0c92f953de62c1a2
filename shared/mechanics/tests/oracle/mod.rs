//! Reads the oracle vectors of `tests/vectors/` (format: the README there).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![allow(dead_code)]

use delmpc_mechanics::spatial::{RigidTransform, Wrench};
use delmpc_mechanics::tree::{Body, Joint, KinematicTree, LinkInertia, TreeBuilder};
use nalgebra::{Matrix3, Vector3, Vector6};
use serde_json::Value;
use std::path::PathBuf;

pub fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/vectors")
}

pub fn read(name: &str) -> Value {
    let path = folder().join(name);
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap()
}

/// All vector files whose name starts with one of the prefixes, except model tables.
pub fn cases(select: impl Fn(&str) -> bool) -> Vec<(String, Value)> {
    let mut names: Vec<String> = std::fs::read_dir(folder())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".json") && !name.contains(".model.") && select(name))
        .collect();
    names.sort();
    assert!(!names.is_empty());
    names.into_iter().map(|name| (name.clone(), read(&name))).collect()
}

/// Every number below a value, in reading order.
pub fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(items) => items.iter().flat_map(flat).collect(),
        Value::Number(n) => vec![n.as_f64().unwrap()],
        other => panic!("not a number: {other}"),
    }
}

pub fn vector3(value: &Value) -> Vector3<f64> {
    Vector3::from_row_slice(&flat(value))
}

pub fn matrix3(value: &Value) -> Matrix3<f64> {
    Matrix3::from_row_slice(&flat(value))
}

fn number(value: &Value, key: &str) -> f64 {
    value.get(key).map_or(0.0, |v| v.as_f64().unwrap())
}

pub fn model(case: &Value) -> KinematicTree {
    let table = match case.get("model_ref") {
        Some(reference) => read(reference.as_str().unwrap()),
        None => case["model"].clone(),
    };
    let gravity = vector3(&table["gravity"]);
    let bodies = table["bodies"].as_array().unwrap();
    let inertia = |body: &Value| {
        LinkInertia::new(number(body, "mass"), vector3(&body["com"]), matrix3(&body["inertia"]))
    };
    let drag =
        |body: &Value| body.get("drag").map_or_else(Vector6::zeros, |d| Vector6::from_row_slice(&flat(d)));
    let constant = |body: &Value| {
        body.get("wrench_body")
            .map_or_else(Wrench::default, |w| Wrench::from_vector(&Vector6::from_row_slice(&flat(w))))
    };
    let mut builder = TreeBuilder::fixed_base(gravity);
    for (index, body) in bodies.iter().enumerate() {
        if body["joint"] == "floating" {
            assert_eq!(index, 0);
            builder = TreeBuilder::floating_base(gravity, inertia(body));
            builder.set_base_wrenches(drag(body), constant(body));
            continue;
        }
        let parent = body["parent"].as_u64().unwrap() as usize;
        let placement = RigidTransform {
            rotation: matrix3(&body["placement"]["R"]),
            translation: vector3(&body["placement"]["t"]),
        };
        let axis = vector3(&body["axis"]);
        let joint = match body["joint"].as_str().unwrap() {
            "revolute" => Joint::revolute(axis, placement),
            "prismatic" => Joint::prismatic(axis, placement),
            other => panic!("joint {other}"),
        };
        let joint = joint
            .with_damping(number(body, "damping"))
            .with_spring(number(body, "stiffness"), number(body, "rest"));
        let mut spec = Body::new((parent > 0).then(|| parent - 1), joint, inertia(body));
        spec.drag = drag(body);
        spec.constant_wrench_b = constant(body);
        builder.add(spec);
    }
    // Some models of the vectors were drawn at random.
    builder.accept_unreal_inertia();
    builder.build().unwrap()
}

/// Asserts `|got - want| <= tolerance * max|want|` and reports the figure.
pub fn assert_close(what: &str, got: &[f64], want: &[f64], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{what}: length");
    let scale = want.iter().fold(1e-300f64, |m, x| m.max(x.abs()));
    let (at, error) = got
        .iter()
        .zip(want)
        .map(|(g, w)| (g - w).abs() / scale)
        .enumerate()
        .fold((0, 0.0), |best, (i, e)| if e >= best.1 || e.is_nan() { (i, e) } else { best });
    assert!(
        error <= tolerance,
        "{what}: relative error {error:.2e} > {tolerance:.0e} at entry {at} ({} instead of {})",
        got[at],
        want[at]
    );
}

/// Node-major `[node][dof]` to the crate's coordinate-major order `dof * nodes + node`.
pub fn coordinate_major(node_major: &[f64], dof: usize) -> Vec<f64> {
    let nodes = node_major.len() / dof;
    (0..dof).flat_map(|d| (0..nodes).map(move |a| node_major[a * dof + d])).collect()
}

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::forces::StepForces;
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::state::State;

/// One unconstrained case of the vectors, fixed or floating base, ready to evaluate.
pub struct Case {
    pub name: String,
    pub json: Value,
    pub tree: KinematicTree,
    pub s: usize,
    pub dt: f64,
    pub state: State,
    held: Vec<f64>,
    per_node: Option<Vec<f64>>,
}

impl Case {
    pub fn new(name: String, json: Value) -> Self {
        let tree = model(&json);
        let (state, joints) = if tree.is_floating() {
            let start = &json["state0"];
            let mut p = flat(&start["P"]);
            p.extend(flat(&start["pj"]));
            let base_pose =
                RigidTransform { rotation: matrix3(&start["R"]), translation: vector3(&start["p"]) };
            (State { base_pose, q: flat(&start["q"]), p }, tree.joint_count())
        } else {
            let base_pose = RigidTransform::identity();
            (State { base_pose, q: flat(&json["q0"]), p: flat(&json["p0"]) }, tree.dof())
        };
        Self {
            s: json["s"].as_u64().unwrap() as usize,
            dt: json["dt"].as_f64().unwrap(),
            held: json.get("u").map_or(vec![0.0; joints], flat),
            per_node: json.get("u_nodes").map(flat),
            name,
            json,
            tree,
            state,
        }
    }

    pub fn forces(&self) -> StepForces<'_> {
        match &self.per_node {
            Some(u) => StepForces::per_node(u),
            None => StepForces::held(&self.held),
        }
    }

    /// A workspace at the start, and at the vector's unsolved nodes.
    pub fn evaluated(&self) -> DelWorkspace {
        let rule = LobattoRule::new(self.s).unwrap();
        let mut del = DelWorkspace::new(&self.tree, &rule, self.dt, ForceCapacity::default()).unwrap();
        del.begin(&self.tree, &self.state, &self.forces()).unwrap();
        let base = self.tree.base_dof();
        let joints = self.tree.joint_count();
        let eval = &self.json["eval"];
        let q = if base == 0 { flat(&eval["qbar"]) } else { flat(&eval["q"]) };
        for alpha in 1..=self.s {
            for joint in 0..joints {
                del.set_node(alpha, base + joint, q[alpha * joints + joint]);
            }
            for k in 0..base {
                del.set_node(alpha, k, eval["xi"][alpha - 1][k].as_f64().unwrap());
            }
        }
        del.evaluate(&self.tree, &[]);
        del
    }

    /// Node-major rows of a vector field (fixed: [node][dof]; floating: {base, joints}) in coordinate-major order.
    pub fn rows(&self, value: &Value) -> Vec<f64> {
        if self.tree.is_floating() {
            let mut rows = coordinate_major(&flat(&value["base"]), 6);
            if self.tree.joint_count() > 0 {
                rows.extend(coordinate_major(&flat(&value["joints"]), self.tree.joint_count()));
            }
            rows
        } else {
            coordinate_major(&flat(value), self.tree.dof())
        }
    }
}

/// All unconstrained cases, fixed and floating.
pub fn unconstrained() -> impl Iterator<Item = Case> {
    cases(|n| !n.contains("constrained") && !n.contains("contact"))
        .into_iter()
        .map(|(name, json)| Case::new(name, json))
}
