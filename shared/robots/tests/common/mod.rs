//! Reads the expected numbers and compares in Pinocchio's conventions.
#![allow(dead_code, reason = "every test file uses a part of it")]
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "test helper: a file that does not load is a failed test"
)]

use std::path::PathBuf;

use delmpc_mechanics::energy::{kinetic_energy, potential_energy};
use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, bias_force_into, gravity_force_into};
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity, base_pose_from_link};
use delmpc_mechanics::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use delmpc_mechanics::spatial::{RigidTransform, Twist};
use delmpc_mechanics::tree::KinematicTree;
use delmpc_robots::{RobotModel, load};
use nalgebra::{DMatrix, DVector, Quaternion, UnitQuaternion, Vector3};
use serde_json::Value;

/// The agreement asked for: relative to the largest entry.
pub const TOLERANCE: f64 = 1e-9;

pub fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub fn robot(name: &str) -> RobotModel {
    load(root().join("configs/robots").join(name).with_extension("urdf"))
        .unwrap_or_else(|error| panic!("{error}"))
}

pub fn vectors(name: &str) -> Value {
    let file = root().join("tests/vectors/robots").join(name).with_extension("json");
    serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
}

pub fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

pub fn names(value: &Value) -> Vec<String> {
    value.as_array().unwrap().iter().map(|x| x.as_str().unwrap().to_owned()).collect()
}

pub fn matrix(value: &Value) -> DMatrix<f64> {
    let rows: Vec<Vec<f64>> = value.as_array().unwrap().iter().map(numbers).collect();
    DMatrix::from_fn(rows.len(), rows[0].len(), |i, j| rows[i][j])
}

pub fn vector(value: &Value) -> DVector<f64> {
    DVector::from_vec(numbers(value))
}

/// Largest difference over the largest expected entry (at least 1).
#[track_caller]
pub fn assert_close(what: &str, got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let size = expected.iter().fold(1.0, |size: f64, x| size.max(x.abs()));
    let worst = got.iter().zip(expected).fold(0.0, |worst: f64, (a, b)| worst.max((a - b).abs()));
    assert!(worst <= tolerance * size, "{what}: off by {worst:e}, size {size}");
}

/// A floating or fixed state with everything computed from it.
pub struct Evaluation {
    pub kinematics: Kinematics,
    pub mass_matrix: DMatrix<f64>,
    pub gravity: DVector<f64>,
    pub bias: DVector<f64>,
    pub kinetic: f64,
    pub potential: f64,
    pub com: Vector3<f64>,
}

impl Evaluation {
    pub fn new(
        tree: &KinematicTree,
        base_pose_w: RigidTransform,
        base_twist_w: Twist,
        q: &[f64],
        v: &[f64],
    ) -> Self {
        let mut kinematics = Kinematics::new(tree);
        kinematics
            .update(tree, &Configuration::floating(base_pose_w, q), &Velocity::floating(base_twist_w, v))
            .unwrap();
        let dof = tree.dof();
        let mut mass_matrix = vec![0.0; dof * dof];
        mass_matrix_into(tree, &kinematics, &mut MassMatrixWorkspace::new(tree), &mut mass_matrix).unwrap();
        let workspace = &mut InverseDynamicsWorkspace::new(tree);
        let (mut gravity, mut bias) = (vec![0.0; dof], vec![0.0; dof]);
        gravity_force_into(tree, &kinematics, workspace, &mut gravity).unwrap();
        bias_force_into(tree, &kinematics, workspace, &mut bias).unwrap();
        Self {
            mass_matrix: DMatrix::from_row_slice(dof, dof, &mass_matrix),
            gravity: DVector::from_vec(gravity),
            bias: DVector::from_vec(bias),
            kinetic: kinetic_energy(tree, &kinematics),
            potential: potential_energy(tree, &kinematics, q).unwrap(),
            com: kinematics.mass_centre_of_tree_w(tree),
            kinematics,
        }
    }

    /// The same in Pinocchio's velocity `(v_b, ω_b, q̇)`, both at the origin and in the axes of the base link: `V_w = Ad_g (ω_b, v_b)`.
    ///
    /// The bias needs no extra term: `V̇_w = Ad_g (v̇_b + ad_v v) = Ad_g v̇_b`.
    pub fn in_pinocchio_coordinates(mut self, base_link_pose_w: &RigidTransform) -> Self {
        let dof = self.gravity.len();
        let mut map = DMatrix::<f64>::identity(dof, dof);
        let adjoint = base_link_pose_w.adjoint();
        for row in 0..6 {
            for column in 0..6 {
                map[(row, column)] = adjoint[(row, (column + 3) % 6)];
            }
        }
        self.mass_matrix = map.transpose() * self.mass_matrix * &map;
        self.gravity = map.transpose() * self.gravity;
        self.bias = map.transpose() * self.bias;
        self
    }
}

/// Base link pose from `[x, y, z, qx, qy, qz, qw]`.
pub fn pose_from_quaternion(v: &[f64]) -> RigidTransform {
    let quaternion = UnitQuaternion::new_normalize(Quaternion::new(v[6], v[3], v[4], v[5]));
    RigidTransform {
        rotation: quaternion.to_rotation_matrix().into_inner(),
        translation: Vector3::new(v[0], v[1], v[2]),
    }
}

/// Sum of the logarithms of the eigenvalues, and the eigenvalues in ascending order.
pub fn spectrum(matrix: &DMatrix<f64>) -> (f64, Vec<f64>) {
    let mut eigenvalues: Vec<f64> = matrix.clone().symmetric_eigenvalues().iter().copied().collect();
    eigenvalues.sort_by(f64::total_cmp);
    (eigenvalues.iter().map(|x| x.ln()).sum(), eigenvalues)
}

/// Compares mass, mass centre, mass matrix figures and gravity at the zero posture of a floating robot.
pub fn check_zero_posture(robot: &RobotModel, expected: &Value) {
    let tree = &robot.tree;
    let zeros = vec![0.0; tree.joint_count()];
    let identity = RigidTransform::identity();
    let base = if tree.is_floating() { base_pose_from_link(tree, &identity) } else { identity };
    let got = Evaluation::new(tree, base, Twist::default(), &zeros, &zeros);
    let got = if tree.is_floating() { got.in_pinocchio_coordinates(&identity) } else { got };
    assert_eq!(tree.dof(), expected["nv"].as_u64().unwrap() as usize);
    assert_close("mass", &[tree.total_mass()], &[number(&expected["total_mass_kg"])], 1e-14);
    assert_close("mass centre", got.com.as_slice(), &numbers(&expected["com_zero_m"]), 1e-13);
    assert_close("trace", &[got.mass_matrix.trace()], &[number(&expected["mass_matrix_trace"])], 1e-12);
    let diagonal = got.mass_matrix.diagonal();
    assert_close("diagonal", diagonal.as_slice(), &numbers(&expected["mass_matrix_diagonal"]), 1e-12);
    let (log_determinant, eigenvalues) = spectrum(&got.mass_matrix);
    assert_close("log det", &[log_determinant], &[number(&expected["mass_matrix_logdet"])], TOLERANCE);
    assert_close("eigenvalues", &eigenvalues, &numbers(&expected["mass_matrix_eigenvalues"]), 1e-12);
    // Relative, one by one: the smallest are a millionth of the largest.
    for (got, expected) in eigenvalues.iter().zip(numbers(&expected["mass_matrix_eigenvalues"])) {
        assert!((got - expected).abs() < TOLERANCE * expected, "{got} {expected}");
    }
    assert_close("gravity", got.gravity.as_slice(), &numbers(&expected["gravity_torque_zero"]), 1e-12);
    assert_eq!(robot.joint_names, names(&expected["joint_order"]));
}

/// Compares everything at the seeded posture.
pub fn check_seeded_posture(robot: &RobotModel, expected: &Value) {
    let tree = &robot.tree;
    let (q, v) = (numbers(&expected["q"]), numbers(&expected["v"]));
    assert_eq!(robot.joint_names, names(&expected["joint_order"]));
    let got = if tree.is_floating() {
        let link = pose_from_quaternion(&numbers(&expected["base_xyz_quat_xyzw"]));
        let body = Twist::new(Vector3::new(v[3], v[4], v[5]), Vector3::new(v[0], v[1], v[2]));
        let twist_w = link.transform_twist(&body);
        Evaluation::new(tree, base_pose_from_link(tree, &link), twist_w, &q, &v[6..])
            .in_pinocchio_coordinates(&link)
    } else {
        Evaluation::new(tree, RigidTransform::identity(), Twist::default(), &q, &v)
    };
    let mass_matrix = matrix(&expected["mass_matrix"]);
    assert_close("mass matrix", got.mass_matrix.as_slice(), mass_matrix.as_slice(), 1e-12);
    assert_close("gravity", got.gravity.as_slice(), &numbers(&expected["gravity_torque"]), 1e-12);
    assert_close("bias", got.bias.as_slice(), &numbers(&expected["bias_coriolis_plus_gravity"]), 1e-12);
    assert_close("kinetic energy", &[got.kinetic], &[number(&expected["kinetic_energy"])], 1e-12);
    // The springs of our model are not in the expected energy.
    let springs = delmpc_mechanics::energy::spring_energy(tree, &q).unwrap();
    assert_close(
        "potential energy",
        &[got.potential - springs],
        &[number(&expected["potential_energy"])],
        1e-12,
    );
    assert_close("mass centre", got.com.as_slice(), &numbers(&expected["com"]), 1e-12);
}
