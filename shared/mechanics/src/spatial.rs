//! Spatial (6-vector) algebra on SE(3): poses, twists, wrenches, momenta and inertias.
//!
//! | letter | meaning |
//! |---|---|
//! | `g = (R, p)` | pose: rotation and position of a frame, seen from its reference frame |
//! | `v = [ω; v]` | twist: angular velocity, linear velocity of the point at the origin of the frame |
//! | `F = [τ; f]` | wrench: moment about the origin of the frame, force |
//! | `x^` | the skew matrix of the cross product, `x^ y = x × y` |
//!
//! All 6-vectors are **angular first**. The maps used everywhere:
//!
//! ```text
//! Ad_g = [R 0; p^R R]     ad_v = [ω^ 0; v^ ω^]     ad^D_F = [τ^ f^; f^ 0]   (skew)
//! ad_x^T F = ad^D_F x      F^T ad_x y = y^T ad^D_F x
//! ```
//!
//! Source: R. M. Murray, Z. Li, S. S. Sastry, *A Mathematical Introduction to Robotic Manipulation*, 1994, chapter 2
//! (there linear first); the dual bracket `ad^D` is that of the paper, section 2.1.

use core::ops::{Add, AddAssign, Mul, Neg, Sub};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::real::{sin_cos, sqrt};

/// The skew-symmetric matrix `x^` with `x^ y = x × y`.
#[inline]
pub fn skew(x: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -x.z, x.y, x.z, 0.0, -x.x, -x.y, x.x, 0.0)
}

/// Rotation by `|ω|` about `ω` (Rodrigues): `exp(ω^)`. Unit: rad. Never fails, exact for `ω = 0`.
pub fn exp_rotation(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle_squared = omega.norm_squared();
    let (a, b) = if angle_squared < 1e-6 {
        // Truncation of both series is below 1e-19 here.
        (
            1.0 - angle_squared / 6.0 * (1.0 - angle_squared / 20.0),
            0.5 - angle_squared / 24.0 * (1.0 - angle_squared / 30.0),
        )
    } else {
        let angle = sqrt(angle_squared);
        let (sin, cos) = sin_cos(angle);
        (sin / angle, (1.0 - cos) / angle_squared)
    };
    let k = skew(omega);
    Matrix3::identity() + k * a + k * k * b
}

/// Rotation vector of a rotation matrix, `exp(log(R)^) = R`, `|log R| <= π`. Unit: rad.
///
/// Accurate at both ends: the angle comes from `atan2` of the skew part and the trace, the axis near `π` from the
/// symmetric part.
pub fn log_rotation(rotation: &Matrix3<f64>) -> Vector3<f64> {
    let axial = 0.5
        * Vector3::new(
            rotation[(2, 1)] - rotation[(1, 2)],
            rotation[(0, 2)] - rotation[(2, 0)],
            rotation[(1, 0)] - rotation[(0, 1)],
        );
    let sin = axial.norm();
    let cos = 0.5 * (rotation.trace() - 1.0);
    let angle = crate::real::atan2(sin, cos);
    if cos > -0.99 {
        let scale = if sin < 1e-8 { 1.0 } else { angle / sin };
        return axial * scale;
    }
    // Near a half turn: (R + R^T)/2 = cos 1 + (1 - cos) a a^T; take the largest diagonal entry for the axis.
    let symmetric = 0.5 * (rotation + rotation.transpose());
    let k = symmetric.diagonal().imax();
    let column = symmetric.column(k).into_owned() - Vector3::ith(k, cos);
    let axis = column / column.norm();
    let sign = if axis.dot(&axial) < 0.0 { -1.0 } else { 1.0 };
    axis * (angle * sign)
}

/// Pose of a frame in a reference frame: `x_reference = rotation * x_frame + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidTransform {
    /// Rotation matrix `R`.
    pub rotation: Matrix3<f64>,
    /// Position `p` of the frame's origin, m.
    pub translation: Vector3<f64>,
}

impl Default for RigidTransform {
    fn default() -> Self {
        Self::identity()
    }
}

impl RigidTransform {
    /// The pose `(1, 0)`.
    #[inline]
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// A pure translation, m.
    #[inline]
    pub fn from_translation(translation: Vector3<f64>) -> Self {
        Self { rotation: Matrix3::identity(), translation }
    }

    /// Pose from a URDF-style origin: position in m and fixed-axis roll, pitch, yaw in rad (`R = Rz Ry Rx`).
    pub fn from_xyz_rpy(xyz: Vector3<f64>, rpy: Vector3<f64>) -> Self {
        let rotation = exp_rotation(&Vector3::new(0.0, 0.0, rpy.z))
            * exp_rotation(&Vector3::new(0.0, rpy.y, 0.0))
            * exp_rotation(&Vector3::new(rpy.x, 0.0, 0.0));
        Self { rotation, translation: xyz }
    }

    /// `g⁻¹`.
    #[inline]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// A point given in this frame, in the reference frame, m.
    #[inline]
    pub fn transform_point(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// `Ad_g v`: a twist given in this frame, in the reference frame.
    #[inline]
    pub fn transform_twist(&self, twist: &Twist) -> Twist {
        let angular = self.rotation * twist.angular;
        Twist { angular, linear: self.rotation * twist.linear + self.translation.cross(&angular) }
    }

    /// `Ad_g⁻¹ v`: a twist given in the reference frame, in this frame.
    #[inline]
    pub fn inverse_transform_twist(&self, twist: &Twist) -> Twist {
        let linear = twist.linear - self.translation.cross(&twist.angular);
        Twist { angular: self.rotation.tr_mul(&twist.angular), linear: self.rotation.tr_mul(&linear) }
    }

    /// `Ad_g⁻ᵀ F`: a wrench given in this frame, in the reference frame.
    #[inline]
    pub fn transform_wrench(&self, wrench: &Wrench) -> Wrench {
        let force = self.rotation * wrench.force;
        Wrench { torque: self.rotation * wrench.torque + self.translation.cross(&force), force }
    }

    /// `Ad_gᵀ F`: a wrench given in the reference frame, in this frame.
    #[inline]
    pub fn inverse_transform_wrench(&self, wrench: &Wrench) -> Wrench {
        let torque = wrench.torque - self.translation.cross(&wrench.force);
        Wrench { torque: self.rotation.tr_mul(&torque), force: self.rotation.tr_mul(&wrench.force) }
    }

    /// The matrix `Ad_g` (6 x 6).
    pub fn adjoint(&self) -> Matrix6<f64> {
        let mut ad = Matrix6::zeros();
        ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation);
        ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&self.rotation);
        ad.fixed_view_mut::<3, 3>(3, 0).copy_from(&(skew(&self.translation) * self.rotation));
        ad
    }
}

impl Mul for RigidTransform {
    type Output = Self;
    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: self.rotation * rhs.rotation,
            translation: self.rotation * rhs.translation + self.translation,
        }
    }
}

/// A motion 6-vector: angular velocity in rad/s, and the linear velocity in m/s of the body point at the frame's origin.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Twist {
    /// Angular part `ω`, rad/s.
    pub angular: Vector3<f64>,
    /// Linear part `v`, m/s.
    pub linear: Vector3<f64>,
}

/// A force 6-vector: a wrench (N·m, N), or an impulse or momentum (N·m·s, N·s).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wrench {
    /// Moment about the frame's origin, N·m.
    pub torque: Vector3<f64>,
    /// Force, N.
    pub force: Vector3<f64>,
}

/// A spatial momentum or impulse: same algebra as a wrench, units N·m·s and N·s.
pub type Momentum = Wrench;

impl Twist {
    /// From the two halves.
    #[inline]
    pub fn new(angular: Vector3<f64>, linear: Vector3<f64>) -> Self {
        Self { angular, linear }
    }

    /// `[ω; v]` as one vector.
    #[inline]
    pub fn to_vector(&self) -> Vector6<f64> {
        stack(&self.angular, &self.linear)
    }

    /// From `[ω; v]`.
    #[inline]
    pub fn from_vector(v: &Vector6<f64>) -> Self {
        Self { angular: v.fixed_rows::<3>(0).into_owned(), linear: v.fixed_rows::<3>(3).into_owned() }
    }

    /// The Lie bracket `ad_self other`.
    #[inline]
    pub fn bracket(&self, other: &Twist) -> Twist {
        Twist {
            angular: self.angular.cross(&other.angular),
            linear: self.linear.cross(&other.angular) + self.angular.cross(&other.linear),
        }
    }
}

impl Wrench {
    /// From the two halves.
    #[inline]
    pub fn new(torque: Vector3<f64>, force: Vector3<f64>) -> Self {
        Self { torque, force }
    }

    /// `[τ; f]` as one vector.
    #[inline]
    pub fn to_vector(&self) -> Vector6<f64> {
        stack(&self.torque, &self.force)
    }

    /// From `[τ; f]`.
    #[inline]
    pub fn from_vector(v: &Vector6<f64>) -> Self {
        Self { torque: v.fixed_rows::<3>(0).into_owned(), force: v.fixed_rows::<3>(3).into_owned() }
    }

    /// The dual bracket `ad^D_F x = ad_xᵀ F`.
    #[inline]
    pub fn dual_bracket(&self, x: &Twist) -> Wrench {
        Wrench {
            torque: self.torque.cross(&x.angular) + self.force.cross(&x.linear),
            force: self.force.cross(&x.angular),
        }
    }

    /// Power `Fᵀ v`, W (for a momentum: twice a kinetic energy).
    #[inline]
    pub fn dot(&self, twist: &Twist) -> f64 {
        self.torque.dot(&twist.angular) + self.force.dot(&twist.linear)
    }
}

fn stack(top: &Vector3<f64>, bottom: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(top.x, top.y, top.z, bottom.x, bottom.y, bottom.z)
}

macro_rules! vector_space {
    ($type:ident, $first:ident, $second:ident) => {
        impl Add for $type {
            type Output = Self;
            #[inline]
            fn add(self, rhs: Self) -> Self {
                Self { $first: self.$first + rhs.$first, $second: self.$second + rhs.$second }
            }
        }
        impl AddAssign for $type {
            #[inline]
            fn add_assign(&mut self, rhs: Self) {
                *self = *self + rhs;
            }
        }
        impl Sub for $type {
            type Output = Self;
            #[inline]
            fn sub(self, rhs: Self) -> Self {
                Self { $first: self.$first - rhs.$first, $second: self.$second - rhs.$second }
            }
        }
        impl Neg for $type {
            type Output = Self;
            #[inline]
            fn neg(self) -> Self {
                Self { $first: -self.$first, $second: -self.$second }
            }
        }
        impl Mul<f64> for $type {
            type Output = Self;
            #[inline]
            fn mul(self, factor: f64) -> Self {
                Self { $first: self.$first * factor, $second: self.$second * factor }
            }
        }
    };
}
vector_space!(Twist, angular, linear);
vector_space!(Wrench, torque, force);

/// Inertia of a rigid body about the origin of the frame it is expressed in.
///
/// Ten numbers: mass `m`, first moment `h = m p`, rotational inertia `J` about the origin;
/// as a matrix `[J, h^; -h^, m 1]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SpatialInertia {
    /// Mass, kg.
    pub mass: f64,
    /// First moment of mass, kg·m.
    pub first_moment: Vector3<f64>,
    /// Rotational inertia about the origin, kg·m².
    pub rotational: Matrix3<f64>,
}

impl SpatialInertia {
    /// From mass, centre of mass and the inertia about the centre of mass (axes of the frame).
    pub fn from_central(mass: f64, com: &Vector3<f64>, inertia_about_com: &Matrix3<f64>) -> Self {
        let p = skew(com);
        Self { mass, first_moment: com * mass, rotational: inertia_about_com - p * p * mass }
    }

    /// Centre of mass and the inertia about it; the inverse of [`SpatialInertia::from_central`]. The mass must be positive.
    pub fn to_central(&self) -> (Vector3<f64>, Matrix3<f64>) {
        let com = self.first_moment / self.mass;
        let p = skew(&com);
        (com, self.rotational + p * p * self.mass)
    }

    /// The same body seen from the reference frame of `pose`: `Ad_g⁻ᵀ M Ad_g⁻¹`.
    pub fn transformed(&self, pose: &RigidTransform) -> Self {
        let rotation = &pose.rotation;
        let h = rotation * self.first_moment;
        let p = skew(&pose.translation);
        let hh = skew(&h);
        Self {
            mass: self.mass,
            first_moment: h + pose.translation * self.mass,
            rotational: rotation * self.rotational * rotation.transpose()
                - p * p * self.mass
                - p * hh
                - hh * p,
        }
    }

    /// Momentum `M v`.
    #[inline]
    pub fn mul_twist(&self, twist: &Twist) -> Momentum {
        Momentum {
            torque: self.rotational * twist.angular + self.first_moment.cross(&twist.linear),
            force: twist.linear * self.mass - self.first_moment.cross(&twist.angular),
        }
    }

    /// The 6 x 6 matrix.
    pub fn to_matrix(&self) -> Matrix6<f64> {
        let h = skew(&self.first_moment);
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotational);
        m.fixed_view_mut::<3, 3>(0, 3).copy_from(&h);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&-h);
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * self.mass));
        m
    }
}

impl Add for SpatialInertia {
    type Output = Self;
    fn add(self, rhs: Self) -> Self {
        Self {
            mass: self.mass + rhs.mass,
            first_moment: self.first_moment + rhs.first_moment,
            rotational: self.rotational + rhs.rotational,
        }
    }
}

impl AddAssign for SpatialInertia {
    fn add_assign(&mut self, rhs: Self) {
        *self = *self + rhs;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose() -> RigidTransform {
        RigidTransform {
            rotation: exp_rotation(&Vector3::new(0.3, -1.1, 0.7)),
            translation: Vector3::new(0.5, -0.2, 1.3),
        }
    }

    #[test]
    fn adjoint_of_a_product_is_the_product_of_the_adjoints() {
        let (a, b) = (pose(), pose().inverse() * RigidTransform::from_translation(Vector3::x()) * pose());
        assert!(((a * b).adjoint() - a.adjoint() * b.adjoint()).amax() < 1e-14);
    }

    #[test]
    fn power_does_not_depend_on_the_frame() {
        let v = Twist::new(Vector3::new(1.0, 2.0, -0.5), Vector3::new(0.1, 0.4, 2.0));
        let f = Wrench::new(Vector3::new(-3.0, 0.2, 1.0), Vector3::new(4.0, 1.0, -2.0));
        let g = pose();
        assert!((g.transform_wrench(&f).dot(&g.transform_twist(&v)) - f.dot(&v)).abs() < 1e-14);
        assert!((g.inverse_transform_twist(&g.transform_twist(&v)) - v).to_vector().amax() < 1e-15);
        assert!((g.inverse_transform_wrench(&g.transform_wrench(&f)) - f).to_vector().amax() < 1e-14);
    }

    #[test]
    fn dual_bracket_is_the_transpose_of_the_bracket() {
        let x = Twist::new(Vector3::new(0.4, 0.3, 1.0), Vector3::new(-1.0, 0.0, 2.0));
        let y = Twist::new(Vector3::new(-0.7, 0.1, 0.2), Vector3::new(0.3, 1.5, 0.9));
        let f = Wrench::new(Vector3::new(2.0, 0.3, -1.0), Vector3::new(0.5, -2.0, 1.0));
        assert!((f.dual_bracket(&x).dot(&y) - f.dot(&x.bracket(&y))).abs() < 1e-15);
    }

    #[test]
    fn log_inverts_exp_up_to_a_half_turn() {
        for angle in [0.0, 1e-9, 1e-3, 0.5, 3.0, 3.12, core::f64::consts::PI - 1e-9] {
            let omega = Vector3::new(0.36, 0.48, -0.8) * angle;
            let back = log_rotation(&exp_rotation(&omega));
            assert!((back - omega).norm() < 1e-8 * (1.0 + angle), "angle {angle}: {back} instead of {omega}");
        }
    }

    #[test]
    fn moving_an_inertia_keeps_the_kinetic_energy() {
        let inertia = SpatialInertia::from_central(
            2.0,
            &Vector3::new(0.1, -0.3, 0.2),
            &Matrix3::new(0.3, 0.01, 0.0, 0.01, 0.2, 0.02, 0.0, 0.02, 0.25),
        );
        let v = Twist::new(Vector3::new(1.0, -2.0, 0.5), Vector3::new(0.3, 0.4, -1.0));
        let g = pose();
        let moved = inertia.transformed(&g);
        let (w, expected) = (g.transform_twist(&v), inertia.mul_twist(&v).dot(&v));
        assert!((moved.mul_twist(&w).dot(&w) - expected).abs() < 1e-13);
        let matrix = moved.to_matrix();
        assert!(
            (matrix - g.inverse().adjoint().transpose() * inertia.to_matrix() * g.inverse().adjoint()).amax()
                < 1e-14
        );
        let (com, central) = inertia.to_central();
        assert!((com - Vector3::new(0.1, -0.3, 0.2)).norm() < 1e-15 && (central[(0, 0)] - 0.3).abs() < 1e-15);
    }
}
