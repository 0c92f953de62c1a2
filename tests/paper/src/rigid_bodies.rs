//! Trees of revolute joints as the rivals see them: flat arrays, everything in frame {0}, 6-vectors angular first.
//!
//! | letter | meaning |
//! |---|---|
//! | `R, x` | rotation of a link, origin of its joint |
//! | `c` | its mass centre |
//! | `S = [s; x×s]` | joint twist |
//! | `v`, `Ṡ = ad_v S` | link twist, rate of the joint twist |
//! | `I = [R I R^T - m c^c^, m c^; -m c^, m]` | spatial inertia about the origin of {0} |
//!
//! The same choice as the integrator's (no transformation between links), so that the rivals gain from it too. Rows of matrices are
//! padded to eight numbers: whole vector registers.

use delmpc_mechanics::prelude::*;

/// 6-vector.
pub type V6 = [f64; 6];
/// 6x6 matrix, rows padded with zeros.
pub type M6 = [[f64; 8]; 6];

/// A tree the rivals cannot simulate.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum RivalError {
    /// Only revolute joints on a fixed base, without springs, damping and drag.
    #[error(
        "body {body}: the rivals know revolute joints without springs, damping and drag on a fixed base only; use such a tree"
    )]
    Unsupported {
        /// Index of the body.
        body: usize,
    },
}

/// What never changes about a link.
#[derive(Clone, Debug)]
pub struct Link {
    /// `usize::MAX` at the root.
    pub parent: usize,
    /// Rotation of the joint: `E0 + cos q E1 + sin q E2`, row by row.
    pub e0: [f64; 9],
    /// Times `cos q`.
    pub e1: [f64; 9],
    /// Times `sin q`.
    pub e2: [f64; 9],
    /// Joint origin in the parent's link axes, m.
    pub origin: [f64; 3],
    /// In link axes.
    pub axis: [f64; 3],
    /// Mass centre in link axes, m.
    pub com: [f64; 3],
    /// kg.
    pub mass: f64,
    /// About the mass centre in link axes: xx, yy, zz, xy, xz, yz.
    pub inertia: [f64; 6],
}

/// Poses and joint twists.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pose {
    /// Rows of `R`.
    pub rotation: [f64; 9],
    /// `x`.
    pub origin: [f64; 3],
    /// `c`.
    pub com: [f64; 3],
    /// `S`.
    pub twist: V6,
}

/// A tree of revolute joints.
#[derive(Clone, Debug)]
pub struct RigidBodies {
    /// Parents first.
    pub links: Vec<Link>,
    /// m/s².
    pub gravity: [f64; 3],
}

/// Runs an expression with the widest instructions of the processor. A type of its own instead of a closure, for the reason told at
/// [`array!`]. Everything it calls has to be `#[inline(always)]`.
macro_rules! vectorized {
    ($arch:expr, $output:ty, ($($name:ident: $kind:ty = $value:expr),+) => $body:expr) => {{
        struct Kernel<'a> {
            $($name: $kind,)+
        }
        impl<'a> pulp::WithSimd for Kernel<'a> {
            type Output = $output;
            #[inline(always)]
            fn with_simd<S: pulp::Simd>(self, _: S) -> $output {
                let Self { $($name,)+ } = self;
                $body
            }
        }
        let arch = $arch;
        arch.dispatch(Kernel { $($name: $value,)+ })
    }};
}
pub(crate) use vectorized;

/// An array by a formula of its index. A loop instead of a closure: closures handed to the library's functions are compiled without
/// the instructions of the caller, and a fused multiply-add is then a function call.
macro_rules! array {
    ($n:literal, $k:ident => $value:expr) => {{
        let mut out = [0.0f64; $n];
        for $k in 0..$n {
            out[$k] = $value;
        }
        out
    }};
}
pub(crate) use array;

/// `a × b`.
#[inline(always)]
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1].mul_add(b[2], -(a[2] * b[1])),
        a[2].mul_add(b[0], -(a[0] * b[2])),
        a[0].mul_add(b[1], -(a[1] * b[0])),
    ]
}

/// `A b` of a 3x3 matrix by rows.
#[inline(always)]
pub fn rotate(a: &[f64; 9], b: [f64; 3]) -> [f64; 3] {
    array!(3, r => a[3 * r].mul_add(b[0], a[3 * r + 1].mul_add(b[1], a[3 * r + 2] * b[2])))
}

/// `ad_v x` of twists: `[ω×a; ω×b + u×a]` with `v = [ω; u]`, `x = [a; b]`.
#[inline(always)]
pub fn bracket(v: &V6, x: &V6) -> V6 {
    let (w, u) = halves(v);
    let (a, b) = halves(x);
    join(cross(w, a), add3(cross(w, b), cross(u, a)))
}

/// `-ad_vᵀ f`, the cross product of a twist and a wrench: `[ω×τ + u×f; ω×f]`.
#[inline(always)]
pub fn cross_wrench(v: &V6, f: &V6) -> V6 {
    let (w, u) = halves(v);
    let (torque, force) = halves(f);
    join(add3(cross(w, torque), cross(u, force)), cross(w, force))
}

/// Angular and linear part.
#[inline(always)]
pub fn halves(x: &V6) -> ([f64; 3], [f64; 3]) {
    ([x[0], x[1], x[2]], [x[3], x[4], x[5]])
}

/// The reverse of [`halves`].
#[inline(always)]
pub fn join(a: [f64; 3], b: [f64; 3]) -> V6 {
    [a[0], a[1], a[2], b[0], b[1], b[2]]
}

#[inline(always)]
fn add3(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// `a + b`.
#[inline(always)]
pub fn add6(a: &V6, b: &V6) -> V6 {
    array!(6, k => a[k] + b[k])
}

/// `a + x b`.
#[inline(always)]
pub fn axpy6(a: &V6, x: f64, b: &V6) -> V6 {
    array!(6, k => x.mul_add(b[k], a[k]))
}

/// `a · b`.
#[inline(always)]
pub fn dot6(a: &V6, b: &V6) -> f64 {
    let even = a[0].mul_add(b[0], a[2].mul_add(b[2], a[4] * b[4]));
    let odd = a[1].mul_add(b[1], a[3].mul_add(b[3], a[5] * b[5]));
    even + odd
}

/// `A x` of a symmetric matrix, by its rows: whole registers.
#[inline(always)]
pub fn symmetric_times(a: &M6, x: &V6) -> V6 {
    let mut sum = [0.0; 8];
    for k in 0..6 {
        for c in 0..8 {
            sum[c] = x[k].mul_add(a[k][c], sum[c]);
        }
    }
    [sum[0], sum[1], sum[2], sum[3], sum[4], sum[5]]
}

/// The ten numbers of a spatial inertia.
#[derive(Clone, Copy, Debug, Default)]
pub struct Inertia {
    /// kg.
    pub mass: f64,
    /// `m c`, kg m.
    pub first_moment: [f64; 3],
    /// About the origin of {0}: xx, yy, zz, xy, xz, yz.
    pub rotational: [f64; 6],
}

impl Inertia {
    /// `I x`.
    #[inline(always)]
    pub fn times(&self, x: &V6) -> V6 {
        let (w, u) = halves(x);
        let [xx, yy, zz, xy, xz, yz] = self.rotational;
        let h = self.first_moment;
        let turn = cross(h, u);
        let shift = cross(h, w);
        [
            xx.mul_add(w[0], xy.mul_add(w[1], xz.mul_add(w[2], turn[0]))),
            xy.mul_add(w[0], yy.mul_add(w[1], yz.mul_add(w[2], turn[1]))),
            xz.mul_add(w[0], yz.mul_add(w[1], zz.mul_add(w[2], turn[2]))),
            self.mass.mul_add(u[0], -shift[0]),
            self.mass.mul_add(u[1], -shift[1]),
            self.mass.mul_add(u[2], -shift[2]),
        ]
    }

    /// As a matrix.
    #[inline(always)]
    pub fn matrix(&self) -> M6 {
        let [xx, yy, zz, xy, xz, yz] = self.rotational;
        let [x, y, z] = self.first_moment;
        let m = self.mass;
        [
            [xx, xy, xz, 0.0, -z, y, 0.0, 0.0],
            [xy, yy, yz, z, 0.0, -x, 0.0, 0.0],
            [xz, yz, zz, -y, x, 0.0, 0.0, 0.0],
            [0.0, z, -y, m, 0.0, 0.0, 0.0, 0.0],
            [-z, 0.0, x, 0.0, m, 0.0, 0.0, 0.0],
            [y, -x, 0.0, 0.0, 0.0, m, 0.0, 0.0],
        ]
    }

    /// Adds another one.
    #[inline(always)]
    pub fn add(&mut self, other: &Self) {
        self.mass += other.mass;
        for k in 0..3 {
            self.first_moment[k] += other.first_moment[k];
        }
        for k in 0..6 {
            self.rotational[k] += other.rotational[k];
        }
    }
}

/// Row a of one matrix times row b of another.
#[inline(always)]
fn row_product(x: &[f64; 9], y: &[f64; 9], a: usize, b: usize) -> f64 {
    let (a, b) = (3 * a, 3 * b);
    x[a].mul_add(y[b], x[a + 1].mul_add(y[b + 1], x[a + 2] * y[b + 2]))
}

impl RigidBodies {
    /// The arrays of a tree.
    ///
    /// # Errors
    /// [`RivalError::Unsupported`] for anything but plain revolute joints on a fixed base.
    pub fn new(tree: &KinematicTree) -> Result<Self, RivalError> {
        if tree.is_floating() {
            return Err(RivalError::Unsupported { body: 0 });
        }
        let mut links = Vec::with_capacity(tree.body_count());
        for (body, spec) in tree.bodies().iter().enumerate() {
            let joint = &spec.joint;
            let plain = joint.kind == JointKind::Revolute && joint.damping == 0.0 && joint.stiffness == 0.0;
            if !plain || tree.has_drag() {
                return Err(RivalError::Unsupported { body });
            }
            let rows = |m: Matrix3<f64>| -> [f64; 9] { core::array::from_fn(|k| m[(k / 3, k % 3)]) };
            let (axis, place) = (joint.axis, &joint.placement);
            let along = axis * axis.transpose();
            let i = spec.inertia.inertia;
            links.push(Link {
                parent: spec.parent.unwrap_or(usize::MAX),
                e0: rows(place.rotation * along),
                e1: rows(place.rotation * (Matrix3::identity() - along)),
                e2: rows(place.rotation * axis.cross_matrix()),
                origin: place.translation.into(),
                axis: axis.into(),
                com: spec.inertia.com.into(),
                mass: spec.inertia.mass,
                inertia: [i[(0, 0)], i[(1, 1)], i[(2, 2)], i[(0, 1)], i[(0, 2)], i[(1, 2)]],
            });
        }
        Ok(Self { links, gravity: (*tree.gravity_w()).into() })
    }

    /// Number of joints.
    pub fn dof(&self) -> usize {
        self.links.len()
    }

    /// Pose of link `i` on its parent's (`None` at the root).
    #[inline(always)]
    pub fn pose(&self, i: usize, q: f64, parent: Option<&Pose>) -> Pose {
        let link = &self.links[i];
        let (sin, cos) = q.sin_cos();
        let turn = array!(9, k => sin.mul_add(link.e2[k], cos.mul_add(link.e1[k], link.e0[k])));
        let (rotation, origin) = match parent {
            None => (turn, link.origin),
            Some(parent) => {
                let mut rotation = [0.0; 9];
                for r in [0, 3, 6] {
                    for c in 0..3 {
                        let m = &parent.rotation;
                        rotation[r + c] =
                            m[r].mul_add(turn[c], m[r + 1].mul_add(turn[3 + c], m[r + 2] * turn[6 + c]));
                    }
                }
                (rotation, add3(parent.origin, rotate(&parent.rotation, link.origin)))
            }
        };
        let axis = rotate(&rotation, link.axis);
        Pose {
            rotation,
            origin,
            com: add3(origin, rotate(&rotation, link.com)),
            twist: join(axis, cross(origin, axis)),
        }
    }

    /// Spatial inertia of link `i` at a pose.
    #[inline(always)]
    pub fn inertia(&self, i: usize, pose: &Pose) -> Inertia {
        let link = &self.links[i];
        let [xx, yy, zz, xy, xz, yz] = link.inertia;
        let r = &pose.rotation;
        let rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
        // R I, then its product with Rᵀ.
        let mut ri = [0.0; 9];
        for k in [0, 3, 6] {
            for c in 0..3 {
                let column = rows[c];
                ri[k + c] = r[k].mul_add(column[0], r[k + 1].mul_add(column[1], r[k + 2] * column[2]));
            }
        }
        let [x, y, z] = pose.com;
        let m = link.mass;
        let (mx, my, mz) = (m * x, m * y, m * z);
        Inertia {
            mass: m,
            first_moment: [mx, my, mz],
            rotational: [
                my.mul_add(y, mz.mul_add(z, row_product(&ri, r, 0, 0))),
                mx.mul_add(x, mz.mul_add(z, row_product(&ri, r, 1, 1))),
                mx.mul_add(x, my.mul_add(y, row_product(&ri, r, 2, 2))),
                (-mx).mul_add(y, row_product(&ri, r, 0, 1)),
                (-mx).mul_add(z, row_product(&ri, r, 0, 2)),
                (-my).mul_add(z, row_product(&ri, r, 1, 2)),
            ],
        }
    }
}
