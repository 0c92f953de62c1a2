//! Vectors, matrices and spatial brackets of whatever stands for a number in a kernel.
//!
//! Loops over arrays, not closures: a closure that the compiler leaves out of line loses the instruction set.

use core::ops::{Add, Mul, Sub};

use super::{Lane, Quad, Simd};

/// What stands for a number in a kernel: one number of every node ([`Lane`]) or of every stage ([`crate::stage_lanes::Stages`]).
pub(crate) trait Number: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {
    /// `self b + c`.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// `c - self b`.
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
}

impl<S: Simd> Number for Lane<S> {
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Lane::mul_add(self, b, c)
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Lane::neg_mul_add(self, b, c)
    }
}

/// Loads `N` consecutive quads.
#[inline(always)]
pub(crate) fn load<S: Simd, const N: usize>(simd: S, quads: &[Quad; N]) -> [Lane<S>; N] {
    let mut out = [Lane::splat(simd, 0.0); N];
    for k in 0..N {
        out[k] = Lane::load(simd, &quads[k]);
    }
    out
}

/// Loads every `stride`-th quad from `at` on: one node group of six coordinates.
#[inline(always)]
pub(crate) fn load_strided<S: Simd, const N: usize>(
    simd: S,
    quads: &[Quad],
    at: usize,
    stride: usize,
) -> [Lane<S>; N] {
    let mut out = [Lane::splat(simd, 0.0); N];
    for k in 0..N {
        out[k] = Lane::load(simd, &quads[k * stride + at]);
    }
    out
}

/// The same constants in every lane.
#[inline(always)]
pub(crate) fn splat<S: Simd, const N: usize>(simd: S, values: &[f64; N]) -> [Lane<S>; N] {
    let mut out = [Lane::splat(simd, 0.0); N];
    for k in 0..N {
        out[k] = Lane::splat(simd, values[k]);
    }
    out
}

/// Stores `N` lanes.
#[inline(always)]
pub(crate) fn store<S: Simd, const N: usize>(lanes: [Lane<S>; N]) -> [Quad; N] {
    let mut out = [Quad::ZERO; N];
    for k in 0..N {
        out[k] = lanes[k].quad();
    }
    out
}

/// `a bᵀ`, row-major.
#[inline(always)]
pub(crate) fn outer<T: Number>(a: [T; 3], b: [T; 3]) -> [T; 9] {
    [
        a[0] * b[0],
        a[0] * b[1],
        a[0] * b[2],
        a[1] * b[0],
        a[1] * b[1],
        a[1] * b[2],
        a[2] * b[0],
        a[2] * b[1],
        a[2] * b[2],
    ]
}

/// Element-wise sum.
#[inline(always)]
pub(crate) fn add<T: Number, const N: usize>(a: [T; N], b: [T; N]) -> [T; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = a[k] + b[k];
    }
    out
}

/// Element-wise difference.
#[inline(always)]
pub(crate) fn sub<T: Number, const N: usize>(a: [T; N], b: [T; N]) -> [T; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = a[k] - b[k];
    }
    out
}

/// `factor a`, element by element.
#[inline(always)]
pub(crate) fn scale<T: Number, const N: usize>(factor: T, a: [T; N]) -> [T; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = factor * a[k];
    }
    out
}

/// `factor a + b`, element by element.
#[inline(always)]
pub(crate) fn scale_add<T: Number, const N: usize>(factor: T, a: [T; N], b: [T; N]) -> [T; N] {
    let mut out = b;
    for k in 0..N {
        out[k] = factor.mul_add(a[k], b[k]);
    }
    out
}

/// Scalar product of 3-vectors.
#[inline(always)]
pub(crate) fn dot3<T: Number>(a: [T; 3], b: [T; 3]) -> T {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

/// Scalar product of 6-vectors.
#[inline(always)]
pub(crate) fn dot6<T: Number>(a: [T; 6], b: [T; 6]) -> T {
    let top = a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]));
    let bottom = a[5].mul_add(b[5], a[4].mul_add(b[4], a[3] * b[3]));
    top + bottom
}

/// `a × b`.
#[inline(always)]
pub(crate) fn cross<T: Number>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [
        a[2].neg_mul_add(b[1], a[1] * b[2]),
        a[0].neg_mul_add(b[2], a[2] * b[0]),
        a[1].neg_mul_add(b[0], a[0] * b[1]),
    ]
}

/// `a × b + c`.
#[inline(always)]
pub(crate) fn cross_add<T: Number>(a: [T; 3], b: [T; 3], c: [T; 3]) -> [T; 3] {
    [
        a[2].neg_mul_add(b[1], a[1].mul_add(b[2], c[0])),
        a[0].neg_mul_add(b[2], a[2].mul_add(b[0], c[1])),
        a[1].neg_mul_add(b[0], a[0].mul_add(b[1], c[2])),
    ]
}

/// Row of a row-major matrix.
#[inline(always)]
pub(crate) fn row<T: Number>(m: &[T; 9], r: usize) -> [T; 3] {
    [m[3 * r], m[3 * r + 1], m[3 * r + 2]]
}

/// Row-major matrix times vector.
#[inline(always)]
pub(crate) fn mat_vec<T: Number>(m: &[T; 9], v: [T; 3]) -> [T; 3] {
    [dot3(row(m, 0), v), dot3(row(m, 1), v), dot3(row(m, 2), v)]
}

/// Row-major matrix times vector, plus a vector.
#[inline(always)]
pub(crate) fn mat_vec_add<T: Number>(m: &[T; 9], v: [T; 3], b: [T; 3]) -> [T; 3] {
    let mut out = b;
    for r in 0..3 {
        let last = m[3 * r].mul_add(v[0], b[r]);
        out[r] = m[3 * r + 2].mul_add(v[2], m[3 * r + 1].mul_add(v[1], last));
    }
    out
}

/// Transpose of a row-major matrix times vector.
#[inline(always)]
pub(crate) fn mat_tr_vec<T: Number>(m: &[T; 9], v: [T; 3]) -> [T; 3] {
    [dot3([m[0], m[3], m[6]], v), dot3([m[1], m[4], m[7]], v), dot3([m[2], m[5], m[8]], v)]
}

/// Product of row-major matrices.
#[inline(always)]
pub(crate) fn mat_mul<T: Number>(a: &[T; 9], b: &[T; 9]) -> [T; 9] {
    let mut out = *b;
    for r in 0..3 {
        for c in 0..3 {
            out[3 * r + c] = dot3(row(a, r), [b[c], b[3 + c], b[6 + c]]);
        }
    }
    out
}

/// Symmetric matrix (xx, yy, zz, xy, xz, yz) times vector.
#[inline(always)]
pub(crate) fn sym_vec<T: Number>(m: &[T; 6], v: [T; 3]) -> [T; 3] {
    [dot3([m[0], m[3], m[4]], v), dot3([m[3], m[1], m[5]], v), dot3([m[4], m[5], m[2]], v)]
}

/// The two halves of a 6-vector.
#[inline(always)]
pub(crate) fn halves<T: Number>(v: [T; 6]) -> ([T; 3], [T; 3]) {
    ([v[0], v[1], v[2]], [v[3], v[4], v[5]])
}

/// A 6-vector from its halves.
#[inline(always)]
pub(crate) fn join<T: Number>(top: [T; 3], bottom: [T; 3]) -> [T; 6] {
    [top[0], top[1], top[2], bottom[0], bottom[1], bottom[2]]
}

/// The Lie bracket `ad_v x`.
#[inline(always)]
pub(crate) fn bracket<T: Number>(v: [T; 6], x: [T; 6]) -> [T; 6] {
    let ((w, l), (s, n)) = (halves(v), halves(x));
    join(cross(w, s), cross_add(l, s, cross(w, n)))
}

/// The dual bracket `ad^D_F x = [τ×s + f×n; f×s]`.
#[inline(always)]
pub(crate) fn dual_bracket<T: Number>(wrench: [T; 6], x: [T; 6]) -> [T; 6] {
    let ((torque, force), (s, n)) = (halves(wrench), halves(x));
    join(cross_add(torque, s, cross(force, n)), cross(force, s))
}
