//! Vectors, matrices and spatial brackets in lanes.
//!
//! Loops over arrays, not closures: a closure that the compiler leaves out of line loses the instruction set.

use super::{Lane, Lane3, Lane6, Lane9, Quad, Simd};

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

/// `a bᵀ`, row-major.
#[inline(always)]
pub(crate) fn outer<S: Simd>(a: Lane3<S>, b: Lane3<S>) -> Lane9<S> {
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

/// Element-wise sum.
#[inline(always)]
pub(crate) fn add<S: Simd, const N: usize>(a: [Lane<S>; N], b: [Lane<S>; N]) -> [Lane<S>; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = a[k] + b[k];
    }
    out
}

/// Element-wise difference.
#[inline(always)]
pub(crate) fn sub<S: Simd, const N: usize>(a: [Lane<S>; N], b: [Lane<S>; N]) -> [Lane<S>; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = a[k] - b[k];
    }
    out
}

/// `factor a`, element by element.
#[inline(always)]
pub(crate) fn scale<S: Simd, const N: usize>(factor: Lane<S>, a: [Lane<S>; N]) -> [Lane<S>; N] {
    let mut out = a;
    for k in 0..N {
        out[k] = factor * a[k];
    }
    out
}

/// `factor a + b`, element by element.
#[inline(always)]
pub(crate) fn scale_add<S: Simd, const N: usize>(
    factor: Lane<S>,
    a: [Lane<S>; N],
    b: [Lane<S>; N],
) -> [Lane<S>; N] {
    let mut out = b;
    for k in 0..N {
        out[k] = factor.mul_add(a[k], b[k]);
    }
    out
}

/// Scalar product of 3-vectors.
#[inline(always)]
pub(crate) fn dot3<S: Simd>(a: Lane3<S>, b: Lane3<S>) -> Lane<S> {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

/// Scalar product of 6-vectors.
#[inline(always)]
pub(crate) fn dot6<S: Simd>(a: Lane6<S>, b: Lane6<S>) -> Lane<S> {
    let top = a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]));
    let bottom = a[5].mul_add(b[5], a[4].mul_add(b[4], a[3] * b[3]));
    top + bottom
}

/// `a × b`.
#[inline(always)]
pub(crate) fn cross<S: Simd>(a: Lane3<S>, b: Lane3<S>) -> Lane3<S> {
    [
        a[2].neg_mul_add(b[1], a[1] * b[2]),
        a[0].neg_mul_add(b[2], a[2] * b[0]),
        a[1].neg_mul_add(b[0], a[0] * b[1]),
    ]
}

/// `a × b + c`.
#[inline(always)]
pub(crate) fn cross_add<S: Simd>(a: Lane3<S>, b: Lane3<S>, c: Lane3<S>) -> Lane3<S> {
    [
        a[2].neg_mul_add(b[1], a[1].mul_add(b[2], c[0])),
        a[0].neg_mul_add(b[2], a[2].mul_add(b[0], c[1])),
        a[1].neg_mul_add(b[0], a[0].mul_add(b[1], c[2])),
    ]
}

/// Row-major matrix times vector.
#[inline(always)]
pub(crate) fn mat_vec<S: Simd>(m: &Lane9<S>, v: Lane3<S>) -> Lane3<S> {
    [dot3([m[0], m[1], m[2]], v), dot3([m[3], m[4], m[5]], v), dot3([m[6], m[7], m[8]], v)]
}

/// Row-major matrix times vector, plus a vector.
#[inline(always)]
pub(crate) fn mat_vec_add<S: Simd>(m: &Lane9<S>, v: Lane3<S>, b: Lane3<S>) -> Lane3<S> {
    let mut out = b;
    for r in 0..3 {
        let last = m[3 * r].mul_add(v[0], b[r]);
        out[r] = m[3 * r + 2].mul_add(v[2], m[3 * r + 1].mul_add(v[1], last));
    }
    out
}

/// Transpose of a row-major matrix times vector.
#[inline(always)]
pub(crate) fn mat_tr_vec<S: Simd>(m: &Lane9<S>, v: Lane3<S>) -> Lane3<S> {
    [dot3([m[0], m[3], m[6]], v), dot3([m[1], m[4], m[7]], v), dot3([m[2], m[5], m[8]], v)]
}

/// Product of row-major matrices.
#[inline(always)]
pub(crate) fn mat_mul<S: Simd>(a: &Lane9<S>, b: &Lane9<S>) -> Lane9<S> {
    let mut out = *b;
    for r in 0..3 {
        let row = [a[3 * r], a[3 * r + 1], a[3 * r + 2]];
        for c in 0..3 {
            out[3 * r + c] = dot3(row, [b[c], b[3 + c], b[6 + c]]);
        }
    }
    out
}

/// Symmetric matrix (xx, yy, zz, xy, xz, yz) times vector.
#[inline(always)]
pub(crate) fn sym_vec<S: Simd>(m: &Lane6<S>, v: Lane3<S>) -> Lane3<S> {
    [dot3([m[0], m[3], m[4]], v), dot3([m[3], m[1], m[5]], v), dot3([m[4], m[5], m[2]], v)]
}

/// The two halves of a 6-vector.
#[inline(always)]
pub(crate) fn halves<S: Simd>(v: Lane6<S>) -> (Lane3<S>, Lane3<S>) {
    ([v[0], v[1], v[2]], [v[3], v[4], v[5]])
}

/// A 6-vector from its halves.
#[inline(always)]
pub(crate) fn join<S: Simd>(top: Lane3<S>, bottom: Lane3<S>) -> Lane6<S> {
    [top[0], top[1], top[2], bottom[0], bottom[1], bottom[2]]
}

/// The Lie bracket `ad_v x`.
#[inline(always)]
pub(crate) fn bracket<S: Simd>(v: Lane6<S>, x: Lane6<S>) -> Lane6<S> {
    let ((w, l), (s, n)) = (halves(v), halves(x));
    join(cross(w, s), cross_add(l, s, cross(w, n)))
}

/// The dual bracket `ad^D_F x = [τ×s + f×n; f×s]`.
#[inline(always)]
pub(crate) fn dual_bracket<S: Simd>(wrench: Lane6<S>, x: Lane6<S>) -> Lane6<S> {
    let ((torque, force), (s, n)) = (halves(wrench), halves(x));
    join(cross_add(torque, s, cross(force, n)), cross(force, s))
}
