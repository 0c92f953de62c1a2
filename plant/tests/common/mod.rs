//! Models and vectors for the plant's tests.
#![allow(dead_code)]

use std::path::PathBuf;

use delmpc_mechanics::prelude::*;
use delmpc_mechanics::velocity::VelocityWorkspace;
use delmpc_plant::contact_step::{ContactOptions, ContactPoint, ContactStep};
use delmpc_plant::terrain::Terrain;
use serde_json::Value;

pub const GRAVITY: f64 = 9.81;

pub fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/vectors")
}

pub fn read(name: &str) -> Value {
    let path = folder().join(name);
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap()
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

fn number(value: &Value, key: &str) -> f64 {
    value.get(key).map_or(0.0, |v| v.as_f64().unwrap())
}

/// The model table of a vector with a fixed base.
pub fn model(case: &Value) -> KinematicTree {
    let table = &case["model"];
    let mut builder = TreeBuilder::fixed_base(vector3(&table["gravity"]));
    for body in table["bodies"].as_array().unwrap() {
        let parent = body["parent"].as_u64().unwrap() as usize;
        let rotation = Matrix3::from_row_slice(&flat(&body["placement"]["R"]));
        let placement = RigidTransform { rotation, translation: vector3(&body["placement"]["t"]) };
        let axis = vector3(&body["axis"]);
        let joint = match body["joint"].as_str().unwrap() {
            "revolute" => Joint::revolute(axis, placement),
            "prismatic" => Joint::prismatic(axis, placement),
            other => panic!("joint {other}"),
        };
        let joint = joint
            .with_damping(number(body, "damping"))
            .with_spring(number(body, "stiffness"), number(body, "rest"));
        let inertia = Matrix3::from_row_slice(&flat(&body["inertia"]));
        let inertia = LinkInertia::new(number(body, "mass"), vector3(&body["com"]), inertia);
        builder.add(Body::new((parent > 0).then(|| parent - 1), joint, inertia));
    }
    builder.accept_unreal_inertia();
    builder.build().unwrap()
}

/// `max|got - want| / max|want|`.
pub fn relative_error(got: &[f64], want: &[f64]) -> f64 {
    error_over(got, want, 1e-300)
}

/// The same with a floor for the scale.
pub fn error_over(got: &[f64], want: &[f64], floor: f64) -> f64 {
    assert_eq!(got.len(), want.len());
    let scale = want.iter().fold(floor, |m, x| m.max(x.abs()));
    got.iter()
        .zip(want)
        .map(|(g, w)| (g - w).abs() / scale)
        .fold(0.0, |m, x| if x > m || x.is_nan() { x } else { m })
}

/// A homogeneous box as a floating tree.
pub fn box_tree(mass: f64, size: Vector3<f64>) -> KinematicTree {
    let square = size.component_mul(&size);
    let inertia = Vector3::new(square.y + square.z, square.x + square.z, square.x + square.y) * (mass / 12.0);
    let link = LinkInertia::new(mass, Vector3::zeros(), Matrix3::from_diagonal(&inertia));
    TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -GRAVITY), link).build().unwrap()
}

/// The four lower corners (`all`: all eight) of a box.
pub fn corners(size: Vector3<f64>, friction: f64, all: bool) -> Vec<ContactPoint> {
    let levels: &[f64] = if all { &[-0.5, 0.5] } else { &[-0.5] };
    let mut points = Vec::new();
    for &z in levels {
        for x in [-0.5, 0.5] {
            for y in [-0.5, 0.5] {
                let point = Vector3::new(x, y, z).component_mul(&size);
                points.push(ContactPoint { body: 0, point, radius: 0.0, friction });
            }
        }
    }
    points
}

pub const FLAT_BOX: [f64; 3] = [0.4, 0.3, 0.2];
pub const TALL_BOX: [f64; 3] = [0.2, 0.3, 0.6];

/// A 10 kg box on the plane z = 0, with the integrator of its contacts.
pub struct BoxWorld {
    pub tree: KinematicTree,
    pub contact: ContactStep,
    pub state: State,
    pub size: Vector3<f64>,
    workspace: VelocityWorkspace,
}

impl BoxWorld {
    pub fn new(size: [f64; 3], friction: f64, dt: f64, all_corners: bool) -> Self {
        let size = Vector3::from(size);
        let tree = box_tree(10.0, size);
        let points = corners(size, friction, all_corners);
        let contact =
            ContactStep::new(&tree, dt, &points, Terrain::plane(0.0), ContactOptions::default()).unwrap();
        let mut state = State::zeros(&tree);
        state.base_pose.translation.z = 0.5 * size.z;
        Self { workspace: VelocityWorkspace::new(&tree), tree, contact, state, size }
    }

    pub fn set_velocity(&mut self, angular: Vector3<f64>, central: Vector3<f64>) {
        set_base_velocity(&self.tree, &mut self.state, angular, central);
    }

    /// Twist of the box: angular velocity and velocity of its centre.
    pub fn velocity(&self) -> (Vector3<f64>, Vector3<f64>) {
        let mut v = vec![0.0; 6];
        VelocityWorkspace::new(&self.tree).velocity_into(&self.tree, &self.state, &mut v).unwrap();
        let angular = Vector3::new(v[0], v[1], v[2]);
        let linear = Vector3::new(v[3], v[4], v[5]);
        (angular, linear + angular.cross(&self.state.base_pose.translation))
    }

    pub fn energy(&mut self) -> f64 {
        let (kinetic, potential) = self.workspace.energy(&self.tree, &self.state).unwrap();
        kinetic + potential
    }

    pub fn lowest_corner(&self) -> f64 {
        corners(self.size, 0.0, true)
            .iter()
            .map(|c| self.state.base_pose.transform_point(&c.point).z)
            .fold(f64::INFINITY, f64::min)
    }

    pub fn push(&self, force: Vector3<f64>, at: Vector3<f64>) -> PointForce {
        PointForce { body: 0, point_b: at, force_w: force }
    }
}

/// Sets the velocity of a floating base (joints at rest): angular, and of its mass centre, in {0}.
pub fn set_base_velocity(
    tree: &KinematicTree,
    state: &mut State,
    angular: Vector3<f64>,
    central: Vector3<f64>,
) {
    let linear = central - angular.cross(&state.base_pose.translation);
    let mut v = vec![0.0; tree.dof()];
    v[..3].copy_from_slice(angular.as_slice());
    v[3..6].copy_from_slice(linear.as_slice());
    VelocityWorkspace::new(tree).set_velocity(tree, state, &v).unwrap();
}
