//! What the joints do while the stance foot carries nothing: they wait for the ground where they are.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `M` | mass matrix of the robot with its foot in the air | kg m² |
//! | `I_j = 1/(M⁻¹)_jj` | what joint j moves when no other joint is held | kg m² |
//! | `w`, `ζ` | fastest frequency, damping ratio | rad/s |
//!
//! ```text
//! d_j = s I_j,  s such that the largest eigenvalue of M⁻¹ D is 2 ζ w        k_j = d_j w / 2ζ
//! ```
//!
//! A law of a robot that stands knows one way to turn the base: against the ground. In the air it turns legs and trunk against each
//! other, and by gyroscope and gains for 33 kg a pelvis of 4 kg. So every joint holds its place, and `w` times the servo's period is
//! far below the 2 at which a sampled damper becomes unstable. The diagonal of `M` alone does not say that: two hips and a waist act on
//! the same pelvis. The ankle is held where the sole lies parallel to the ground it last lay on.
//!
//! Source: own formulation. Sampled stiffness and damping: K. Åström, B. Wittenmark, *Computer-Controlled Systems*, 1997, chapter 3.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_lq::kernels::{CholeskyScratch, factor, solve_factored};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::spatial::{SpatialInertia, Twist};
use delmpc_mechanics::tree::KinematicTree;
use delmpc_messages::Command;
use faer::Mat;
use nalgebra::Vector3;

use crate::errors::ControlError;
use crate::level_stance::LevelStance;

/// `w`, rad/s; less where the servo is slow.
const FREQUENCY: f64 = 60.0;
/// `ζ`.
const DAMPING_RATIO: f64 = 0.8;
/// Largest `w` times the servo's period.
const LARGEST_STEP: f64 = 0.1;
/// Steps of the power iteration: it is a constructor's.
const POWER_ITERATIONS: usize = 300;
/// Part of the weight on the foot from which on the robot has its full torque.
const FULL_LOAD: f64 = 0.2;

/// Gains of all joints.
#[derive(Clone, Debug)]
pub(crate) struct UnloadedRobot {
    foot: usize,
    full_load_n: f64,
    /// Stiffness and damping by joint.
    gains: Vec<(f64, f64)>,
}

impl UnloadedRobot {
    /// For foot `foot` of the messages, that {0} of `tree` is fixed at.
    pub fn new(
        tree: &KinematicTree,
        foot: usize,
        posture: &[f64],
        servo_period_s: f64,
    ) -> Result<Self, ControlError> {
        let inverse = inverse_inertia_in_the_air(tree, posture)?;
        let n = tree.dof();
        let largest = largest_eigenvalue_with_joint_inertias(&inverse);
        let frequency = FREQUENCY.min(LARGEST_STEP / servo_period_s);
        let gains = (0..n).map(|joint| {
            let damping = 2.0 * DAMPING_RATIO * frequency / (largest * inverse[joint][joint]);
            (damping * frequency / (2.0 * DAMPING_RATIO), damping)
        });
        let full_load_n = FULL_LOAD * tree.total_mass() * tree.gravity_w().norm();
        Ok(Self { foot, full_load_n, gains: gains.collect() })
    }

    /// Writes the gains, and for a levelled ankle where the sole is parallel to the ground: `x` is the levelled state, `lean` that of the
    /// ground.
    pub fn write(
        &self,
        level: Option<&LevelStance>,
        x: &[f64],
        lean: [f64; 2],
        message_joint: &[usize],
        command: &mut Command,
    ) {
        command.load_foot.fill(0);
        let Some(full_load) = command.full_load_n.get_mut(self.foot) else { return };
        *full_load = self.full_load_n;
        for (&at, &(stiffness, damping)) in message_joint.iter().zip(&self.gains) {
            command.load_foot[at] = 1 + self.foot as u32;
            command.unloaded_stiffness[at] = stiffness;
            command.unloaded_damping[at] = damping;
        }
        let Some(level) = level else { return };
        for (joint, lean) in level.ankle().into_iter().zip(lean) {
            let at = message_joint[joint];
            for segment in &mut command.segments {
                segment.position_ref[at] = x[joint] + lean;
                segment.velocity_ref[at] = 0.0;
                segment.acceleration_ref[at] = 0.0;
            }
        }
    }
}

/// The joints' block of `M⁻¹` with nothing fixed, 1/(kg m²), for the `tree` fixed at a foot.
fn inverse_inertia_in_the_air(tree: &KinematicTree, posture: &[f64]) -> Result<Vec<Vec<f64>>, ControlError> {
    let n = tree.dof();
    let mut kinematics = Kinematics::new(tree);
    kinematics.update_positions(tree, &Configuration::fixed(posture))?;
    let axis = |k: usize| Vector3::ith(k % 3, 1.0);
    let twist = |column: usize| match column {
        0..3 => Twist::new(axis(column), Vector3::zeros()),
        3..6 => Twist::new(Vector3::zeros(), axis(column)),
        _ => kinematics.joint_twists_w()[column - 6],
    };
    let mut inertia = Mat::<f64>::zeros(6 + n, 6 + n);
    let mut add = |columns: &[usize], body: &SpatialInertia| {
        for &column in columns {
            let momentum = body.mul_twist(&twist(column));
            for &row in columns {
                inertia[(row, column)] += momentum.dot(&twist(row));
            }
        }
    };
    let mut columns: Vec<usize> = (0..6).collect();
    add(&columns, tree.ground_inertia_w());
    for body in 0..tree.body_count() {
        columns.truncate(6);
        columns.extend(tree.branch(body).iter().map(|joint| 6 + *joint as usize));
        add(&columns, &kinematics.inertia_w(tree, body));
    }
    factor(inertia.as_mut(), &mut CholeskyScratch::new(6 + n))
        .ok_or(ControlError::Model { reason: "its mass matrix with the foot in the air is singular" })?;
    let column = |joint: usize| {
        let mut column = vec![0.0; 6 + n];
        column[6 + joint] = 1.0;
        solve_factored(inertia.as_ref(), &mut column);
        column.split_off(6)
    };
    Ok((0..n).map(column).collect())
}

/// The largest eigenvalue of `M⁻¹ D` with `d_j = I_j`, by power iteration.
fn largest_eigenvalue_with_joint_inertias(inverse: &[Vec<f64>]) -> f64 {
    let n = inverse.len();
    // No joint's direction is missed, no two are alike.
    let mut direction: Vec<f64> = (0..n).map(|j| 1.0 + 0.1 * libm::sin(j as f64)).collect();
    let mut product = vec![0.0; n];
    let mut largest = 0.0;
    for _ in 0..POWER_ITERATIONS {
        for (value, row) in product.iter_mut().zip(inverse) {
            *value = (0..n).map(|j| row[j] / inverse[j][j] * direction[j]).sum();
        }
        largest = libm::sqrt(product.iter().map(|x| x * x).sum());
        if largest <= 0.0 {
            break;
        }
        direction.iter_mut().zip(&product).for_each(|(x, value)| *x = value / largest);
    }
    largest
}

#[cfg(test)]
mod tests {
    use delmpc_mechanics::prelude::*;
    use nalgebra::DMatrix;

    use super::*;

    /// A foot, a light pelvis between two hips, and a trunk: what three dampers do to the pelvis together decides.
    #[test]
    fn dampers_that_act_on_one_light_body_are_counted_together() {
        let inertia = |i: f64| LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * i);
        let mut tree = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
        let hinge = || Joint::revolute(Vector3::y(), RigidTransform::identity());
        let pelvis = tree.add(Body::new(None, hinge(), inertia(0.01)));
        tree.add(Body::new(Some(pelvis), hinge(), inertia(1.0)));
        tree.add(Body::new(Some(pelvis), hinge(), inertia(1.0)));
        tree.set_ground_inertia(SpatialInertia::from_central(1.0, &Vector3::zeros(), &Matrix3::identity()));
        let tree = tree.build().unwrap();
        let robot = UnloadedRobot::new(&tree, 0, &[0.0; 3], 1e-3).unwrap();
        let inverse = inverse_inertia_in_the_air(&tree, &[0.0; 3]).unwrap();
        let driven = DMatrix::from_fn(3, 3, |i, j| inverse[i][j] * robot.gains[j].1);
        let fastest = driven.complex_eigenvalues().iter().map(|v| v.re).fold(0.0, f64::max);
        assert!((fastest / (2.0 * DAMPING_RATIO * FREQUENCY) - 1.0).abs() < 1e-9, "{fastest}");
        // A joint between bodies of 1.01 and 1: alone it moves half of it, with the pelvis free the pelvis.
        assert!((1.0 / inverse[1][1] - 0.01 / 1.01).abs() < 1e-4, "{}", 1.0 / inverse[1][1]);
    }
}
