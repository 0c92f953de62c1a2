//! SIMD lanes over the stages of a horizon: one lane is one stage.
//!
//! [`crate::lanes`] puts the control nodes of *one* step into the lanes; here every lane is a whole step of the same tree. The
//! index structure is the same in all of them, so the kernels of [`crate::stage_batch`] are the scalar algorithms with a number
//! replaced by a vector of stages: no shuffles and no masks; a lane with a NaN does not touch the others. Vectors have eight
//! doubles with AVX-512 and four otherwise.

use core::ops::{Add, Div, Mul, Neg, Sub};

use crate::lanes::{Portable, Quad};

/// One number of every stage of a vector, as it lies in memory.
pub(crate) trait StageMemory: Copy + Default {
    /// Stages in a vector.
    const COUNT: usize;
    fn fill(x: f64) -> Self;
    fn lanes(&self) -> &[f64];
    fn lanes_mut(&mut self) -> &mut [f64];
}

impl StageMemory for Quad {
    const COUNT: usize = 4;
    fn fill(x: f64) -> Self {
        Quad::splat(x)
    }
    #[inline(always)]
    fn lanes(&self) -> &[f64] {
        &self.0
    }
    #[inline(always)]
    fn lanes_mut(&mut self) -> &mut [f64] {
        &mut self.0
    }
}

/// Eight doubles, one per stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Oct(pub [f64; 8]);

impl StageMemory for Oct {
    const COUNT: usize = 8;
    fn fill(x: f64) -> Self {
        Oct([x; 8])
    }
    #[inline(always)]
    fn lanes(&self) -> &[f64] {
        &self.0
    }
    #[inline(always)]
    fn lanes_mut(&mut self) -> &mut [f64] {
        &mut self.0
    }
}

/// Arithmetic on a vector of stages with one instruction set.
pub(crate) trait StageSimd: Copy {
    type Memory: StageMemory;
    type Vector: Copy;
    fn splat(self, x: f64) -> Self::Vector;
    fn load(self, memory: &Self::Memory) -> Self::Vector;
    fn store(self, v: Self::Vector) -> Self::Memory;
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn mul(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    fn div(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// `a b + c`.
    fn mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// `c - a b`.
    fn neg_mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// The larger of `a` and `|x|`; either one for a NaN.
    fn max_abs(self, a: Self::Vector, x: Self::Vector) -> Self::Vector;
    /// As many vectors as there are stages in one, taken from `places` of `rows`, to one vector per stage.
    fn transpose(self, rows: &[Self::Memory], places: &[u32], out: &mut [Self::Memory]);
    /// Runs a kernel with these instructions enabled.
    fn run<K: StageKernel<Self::Memory>>(self, kernel: K);
}

/// Work that runs under any instruction set with the same memory layout. Implementations and all they call must be
/// `#[inline(always)]`, so that the code is generated inside the function that enables the instructions.
pub(crate) trait StageKernel<M: StageMemory> {
    fn run<S: StageSimd<Memory = M>>(self, simd: S);
}

impl StageSimd for Portable {
    type Memory = Quad;
    type Vector = [f64; 4];
    #[inline(always)]
    fn splat(self, x: f64) -> [f64; 4] {
        [x; 4]
    }
    #[inline(always)]
    fn load(self, memory: &Quad) -> [f64; 4] {
        memory.0
    }
    #[inline(always)]
    fn store(self, v: [f64; 4]) -> Quad {
        Quad(v)
    }
    #[inline(always)]
    fn add(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]]
    }
    #[inline(always)]
    fn sub(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] - b[3]]
    }
    #[inline(always)]
    fn mul(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0] * b[0], a[1] * b[1], a[2] * b[2], a[3] * b[3]]
    }
    #[inline(always)]
    fn div(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0] / b[0], a[1] / b[1], a[2] / b[2], a[3] / b[3]]
    }
    #[inline(always)]
    fn mul_add(self, a: [f64; 4], b: [f64; 4], c: [f64; 4]) -> [f64; 4] {
        self.add(self.mul(a, b), c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: [f64; 4], b: [f64; 4], c: [f64; 4]) -> [f64; 4] {
        self.sub(c, self.mul(a, b))
    }
    #[inline(always)]
    fn max_abs(self, a: [f64; 4], x: [f64; 4]) -> [f64; 4] {
        let [x0, x1, x2, x3] = x;
        [a[0].max(x0.abs()), a[1].max(x1.abs()), a[2].max(x2.abs()), a[3].max(x3.abs())]
    }
    #[inline(always)]
    fn transpose(self, rows: &[Quad], places: &[u32], out: &mut [Quad]) {
        transpose_quads(rows, places, out);
    }
    #[inline(always)]
    fn run<K: StageKernel<Quad>>(self, kernel: K) {
        kernel.run(self);
    }
}

#[inline(always)]
fn transpose_quads(rows: &[Quad], places: &[u32], out: &mut [Quad]) {
    let mut r = [[0.0; 4]; 4];
    for k in 0..4 {
        r[k] = rows[places[k] as usize].0;
    }
    let [a, b, c, d] = r;
    for lane in 0..4 {
        out[lane].0 = [a[lane], b[lane], c[lane], d[lane]];
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn transpose_quads_with(_: pulp::x86::V3, rows: &[Quad], places: &[u32], out: &mut [Quad]) {
    transpose_quads(rows, places, out);
}

/// Three rounds of eight shuffles: pairs of numbers, pairs of pairs, halves.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn transpose_octs(simd: pulp::x86::V4, rows: &[Oct], places: &[u32], out: &mut [Oct]) {
    let avx = simd.avx512f;
    let zero = pulp::cast::<[f64; 8], core::arch::x86_64::__m512d>([0.0; 8]);
    let mut r = [zero; 8];
    for k in 0..8 {
        r[k] = pulp::cast(rows[places[k] as usize].0);
    }
    for odd in 0..2 {
        let mut pairs = [zero; 4];
        for k in 0..4 {
            pairs[k] = if odd == 0 {
                avx._mm512_unpacklo_pd(r[2 * k], r[2 * k + 1])
            } else {
                avx._mm512_unpackhi_pd(r[2 * k], r[2 * k + 1])
            };
        }
        let [a, b, c, d] = pairs;
        let (upper, lower) = (avx._mm512_shuffle_f64x2::<0x88>(a, b), avx._mm512_shuffle_f64x2::<0x88>(c, d));
        out[odd].0 = pulp::cast(avx._mm512_shuffle_f64x2::<0x88>(upper, lower));
        out[4 + odd].0 = pulp::cast(avx._mm512_shuffle_f64x2::<0xdd>(upper, lower));
        let (upper, lower) = (avx._mm512_shuffle_f64x2::<0xdd>(a, b), avx._mm512_shuffle_f64x2::<0xdd>(c, d));
        out[2 + odd].0 = pulp::cast(avx._mm512_shuffle_f64x2::<0x88>(upper, lower));
        out[6 + odd].0 = pulp::cast(avx._mm512_shuffle_f64x2::<0xdd>(upper, lower));
    }
}

/// The operations of one of pulp's tokens.
#[cfg(target_arch = "x86_64")]
macro_rules! with_pulp {
    ($token:ty, $memory:ident, $vector:ident, $splat:ident, $add:ident, $sub:ident, $mul:ident, $div:ident, $fma:ident, $fnma:ident,
     $abs:ident, $max:ident, $transpose:expr) => {
        impl StageSimd for $token {
            type Memory = $memory;
            type Vector = pulp::$vector;
            #[inline(always)]
            fn splat(self, x: f64) -> pulp::$vector {
                self.$splat(x)
            }
            #[inline(always)]
            fn load(self, memory: &$memory) -> pulp::$vector {
                pulp::cast(memory.0)
            }
            #[inline(always)]
            fn store(self, v: pulp::$vector) -> $memory {
                $memory(pulp::cast(v))
            }
            #[inline(always)]
            fn add(self, a: pulp::$vector, b: pulp::$vector) -> pulp::$vector {
                self.$add(a, b)
            }
            #[inline(always)]
            fn sub(self, a: pulp::$vector, b: pulp::$vector) -> pulp::$vector {
                self.$sub(a, b)
            }
            #[inline(always)]
            fn mul(self, a: pulp::$vector, b: pulp::$vector) -> pulp::$vector {
                self.$mul(a, b)
            }
            #[inline(always)]
            fn div(self, a: pulp::$vector, b: pulp::$vector) -> pulp::$vector {
                self.$div(a, b)
            }
            #[inline(always)]
            fn mul_add(self, a: pulp::$vector, b: pulp::$vector, c: pulp::$vector) -> pulp::$vector {
                self.$fma(a, b, c)
            }
            #[inline(always)]
            fn neg_mul_add(self, a: pulp::$vector, b: pulp::$vector, c: pulp::$vector) -> pulp::$vector {
                self.$fnma(a, b, c)
            }
            #[inline(always)]
            fn max_abs(self, a: pulp::$vector, x: pulp::$vector) -> pulp::$vector {
                self.$max(a, self.$abs(x))
            }
            #[inline(always)]
            fn transpose(self, rows: &[$memory], places: &[u32], out: &mut [$memory]) {
                $transpose(self, rows, places, out)
            }
            #[inline(always)]
            fn run<K: StageKernel<$memory>>(self, kernel: K) {
                pulp::Simd::vectorize(self, With { kernel, simd: self });
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
with_pulp!(
    pulp::x86::V3,
    Quad,
    f64x4,
    splat_f64x4,
    add_f64x4,
    sub_f64x4,
    mul_f64x4,
    div_f64x4,
    mul_add_f64x4,
    negate_mul_add_f64x4,
    abs_f64x4,
    max_f64x4,
    transpose_quads_with
);
#[cfg(target_arch = "x86_64")]
with_pulp!(
    pulp::x86::V4,
    Oct,
    f64x8,
    splat_f64x8,
    add_f64x8,
    sub_f64x8,
    mul_f64x8,
    div_f64x8,
    mul_add_f64x8,
    negate_mul_add_f64x8,
    abs_f64x8,
    max_f64x8,
    transpose_octs
);

#[cfg(target_arch = "x86_64")]
struct With<K, S> {
    kernel: K,
    simd: S,
}

#[cfg(target_arch = "x86_64")]
impl<S: StageSimd, K: StageKernel<S::Memory>> pulp::WithSimd for With<K, S> {
    type Output = ();
    #[inline(always)]
    fn with_simd<P: pulp::Simd>(self, _: P) {
        self.kernel.run(self.simd);
    }
}

/// A vector of stages together with the token that may compute on it: gives the kernels ordinary operators.
#[derive(Clone, Copy)]
pub(crate) struct Stages<S: StageSimd> {
    simd: S,
    v: S::Vector,
}

/// A 3-vector of every stage.
pub(crate) type Stages3<S> = [Stages<S>; 3];
/// A 6-vector (angular first) of every stage.
pub(crate) type Stages6<S> = [Stages<S>; 6];

impl<S: StageSimd> Stages<S> {
    #[inline(always)]
    pub fn splat(simd: S, x: f64) -> Self {
        Self { simd, v: simd.splat(x) }
    }
    #[inline(always)]
    pub fn load(simd: S, memory: &S::Memory) -> Self {
        Self { simd, v: simd.load(memory) }
    }
    #[inline(always)]
    pub fn store(self) -> S::Memory {
        self.simd.store(self.v)
    }
    /// `self b + c`.
    #[inline(always)]
    pub fn mul_add(self, b: Self, c: Self) -> Self {
        Self { v: self.simd.mul_add(self.v, b.v, c.v), ..self }
    }
    /// `c - self b`.
    #[inline(always)]
    pub fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self { v: self.simd.neg_mul_add(self.v, b.v, c.v), ..self }
    }
    /// The larger of `self` and `|x|`; either one for a NaN.
    #[inline(always)]
    pub fn max_abs(self, x: Self) -> Self {
        Self { v: self.simd.max_abs(self.v, x.v), ..self }
    }
    /// The same number times a constant of the method.
    #[inline(always)]
    pub fn times(self, x: f64) -> Self {
        self * Self::splat(self.simd, x)
    }
}

impl<S: StageSimd> Add for Stages<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, rhs: Self) -> Self {
        Self { v: self.simd.add(self.v, rhs.v), ..self }
    }
}

impl<S: StageSimd> Sub for Stages<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, rhs: Self) -> Self {
        Self { v: self.simd.sub(self.v, rhs.v), ..self }
    }
}

impl<S: StageSimd> Mul for Stages<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, rhs: Self) -> Self {
        Self { v: self.simd.mul(self.v, rhs.v), ..self }
    }
}

impl<S: StageSimd> Div for Stages<S> {
    type Output = Self;
    #[inline(always)]
    fn div(self, rhs: Self) -> Self {
        Self { v: self.simd.div(self.v, rhs.v), ..self }
    }
}

impl<S: StageSimd> Neg for Stages<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self::splat(self.simd, 0.0) - self
    }
}

// Loops and no closures below: a closure is a function of its own, which the compiler may leave outside the function that
// enables the instructions; every operation would then be a call.

/// Loads `N` consecutive vectors.
#[inline(always)]
pub(crate) fn load<S: StageSimd, const N: usize>(simd: S, memory: &[S::Memory; N]) -> [Stages<S>; N] {
    let mut out = [Stages::load(simd, &memory[0]); N];
    for k in 1..N {
        out[k] = Stages::load(simd, &memory[k]);
    }
    out
}

/// Stores `N` vectors.
#[inline(always)]
pub(crate) fn store<S: StageSimd, const N: usize>(memory: &mut [S::Memory; N], v: [Stages<S>; N]) {
    for k in 0..N {
        memory[k] = v[k].store();
    }
}

/// The same constants in every stage.
#[inline(always)]
pub(crate) fn splat<S: StageSimd, const N: usize>(simd: S, values: &[f64; N]) -> [Stages<S>; N] {
    let mut out = [Stages::splat(simd, values[0]); N];
    for k in 1..N {
        out[k] = Stages::splat(simd, values[k]);
    }
    out
}

/// `a + b`.
#[inline(always)]
pub(crate) fn add<S: StageSimd, const N: usize>(mut a: [Stages<S>; N], b: [Stages<S>; N]) -> [Stages<S>; N] {
    for k in 0..N {
        a[k] = a[k] + b[k];
    }
    a
}

/// `a - b`.
#[inline(always)]
pub(crate) fn sub<S: StageSimd, const N: usize>(mut a: [Stages<S>; N], b: [Stages<S>; N]) -> [Stages<S>; N] {
    for k in 0..N {
        a[k] = a[k] - b[k];
    }
    a
}

/// `x a`.
#[inline(always)]
pub(crate) fn scale<S: StageSimd, const N: usize>(x: Stages<S>, mut a: [Stages<S>; N]) -> [Stages<S>; N] {
    for k in 0..N {
        a[k] = x * a[k];
    }
    a
}

/// `x a + b`.
#[inline(always)]
pub(crate) fn scale_add<S: StageSimd, const N: usize>(
    x: Stages<S>,
    mut a: [Stages<S>; N],
    b: [Stages<S>; N],
) -> [Stages<S>; N] {
    for k in 0..N {
        a[k] = x.mul_add(a[k], b[k]);
    }
    a
}

#[inline(always)]
pub(crate) fn dot3<S: StageSimd>(a: Stages3<S>, b: Stages3<S>) -> Stages<S> {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

#[inline(always)]
pub(crate) fn dot6<S: StageSimd>(a: Stages6<S>, b: Stages6<S>) -> Stages<S> {
    let top = a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]));
    let bottom = a[5].mul_add(b[5], a[4].mul_add(b[4], a[3] * b[3]));
    top + bottom
}

/// `a × b`.
#[inline(always)]
pub(crate) fn cross<S: StageSimd>(a: Stages3<S>, b: Stages3<S>) -> Stages3<S> {
    [
        a[2].neg_mul_add(b[1], a[1] * b[2]),
        a[0].neg_mul_add(b[2], a[2] * b[0]),
        a[1].neg_mul_add(b[0], a[0] * b[1]),
    ]
}

/// `a × b + c`.
#[inline(always)]
pub(crate) fn cross_add<S: StageSimd>(a: Stages3<S>, b: Stages3<S>, c: Stages3<S>) -> Stages3<S> {
    [
        a[2].neg_mul_add(b[1], a[1].mul_add(b[2], c[0])),
        a[0].neg_mul_add(b[2], a[2].mul_add(b[0], c[1])),
        a[1].neg_mul_add(b[0], a[0].mul_add(b[1], c[2])),
    ]
}

/// Row of a row-major matrix.
#[inline(always)]
pub(crate) fn row<S: StageSimd>(m: &[Stages<S>; 9], r: usize) -> Stages3<S> {
    [m[3 * r], m[3 * r + 1], m[3 * r + 2]]
}

#[inline(always)]
fn column<S: StageSimd>(m: &[Stages<S>; 9], c: usize) -> Stages3<S> {
    [m[c], m[3 + c], m[6 + c]]
}

/// Row-major matrix times vector.
#[inline(always)]
pub(crate) fn mat_vec<S: StageSimd>(m: &[Stages<S>; 9], v: Stages3<S>) -> Stages3<S> {
    [dot3(row(m, 0), v), dot3(row(m, 1), v), dot3(row(m, 2), v)]
}

/// Product of row-major matrices.
#[inline(always)]
pub(crate) fn mat_mul<S: StageSimd>(a: &[Stages<S>; 9], b: &[Stages<S>; 9]) -> [Stages<S>; 9] {
    let mut out = *a;
    for r in 0..3 {
        for c in 0..3 {
            out[3 * r + c] = dot3(row(a, r), column(b, c));
        }
    }
    out
}

/// Symmetric matrix (xx, yy, zz, xy, xz, yz) times vector.
#[inline(always)]
pub(crate) fn sym_vec<S: StageSimd>(m: &Stages6<S>, v: Stages3<S>) -> Stages3<S> {
    [dot3([m[0], m[3], m[4]], v), dot3([m[3], m[1], m[5]], v), dot3([m[4], m[5], m[2]], v)]
}

/// The two halves of a 6-vector.
#[inline(always)]
pub(crate) fn halves<S: StageSimd>(v: Stages6<S>) -> (Stages3<S>, Stages3<S>) {
    ([v[0], v[1], v[2]], [v[3], v[4], v[5]])
}

/// A 6-vector from its halves.
#[inline(always)]
pub(crate) fn join<S: StageSimd>(top: Stages3<S>, bottom: Stages3<S>) -> Stages6<S> {
    [top[0], top[1], top[2], bottom[0], bottom[1], bottom[2]]
}

/// The Lie bracket `ad_v x`.
#[inline(always)]
pub(crate) fn bracket<S: StageSimd>(v: Stages6<S>, x: Stages6<S>) -> Stages6<S> {
    let ((w, l), (s, n)) = (halves(v), halves(x));
    join(cross(w, s), cross_add(l, s, cross(w, n)))
}

/// The dual bracket `ad^D_F x = [τ×s + f×n; f×s]`.
#[inline(always)]
pub(crate) fn dual_bracket<S: StageSimd>(wrench: Stages6<S>, x: Stages6<S>) -> Stages6<S> {
    let ((torque, force), (s, n)) = (halves(wrench), halves(x));
    join(cross_add(torque, s, cross(force, n)), cross(force, s))
}

/// Adding and subtracting it rounds a number below 2^51 to an integer.
const ROUNDER: f64 = 6_755_399_441_055_744.0;
/// π/2 in three parts; the first two have 33 bits, so that their products with integers below 2^20 are exact.
const HALF_PI: [f64; 3] = [1.570_796_326_734_125_6, 6.077_100_506_303_966e-11, 2.022_266_248_795_950_6e-21];
/// Largest angle [`sin_cos`] reduces without loss, rad.
pub(crate) const LARGEST_ANGLE: f64 = 1e6;

/// Sine and cosine of angles up to [`LARGEST_ANGLE`], to about one unit in the last place of 1: reduction to `|r| <= π/4` by
/// multiples of π/2, Taylor polynomials of degree 17 and 16 (truncation 1e-18), and the quadrant by arithmetic on 0 and 1.
#[inline(always)]
pub(crate) fn sin_cos<S: StageSimd>(simd: S, x: Stages<S>) -> (Stages<S>, Stages<S>) {
    const SINE: [f64; 8] = [
        -1.0 / 6.0,
        1.0 / 120.0,
        -1.0 / 5040.0,
        1.0 / 362_880.0,
        -1.0 / 39_916_800.0,
        1.0 / 6_227_020_800.0,
        -1.0 / 1_307_674_368_000.0,
        1.0 / 355_687_428_096_000.0,
    ];
    const COSINE: [f64; 8] = [
        -0.5,
        1.0 / 24.0,
        -1.0 / 720.0,
        1.0 / 40_320.0,
        -1.0 / 3_628_800.0,
        1.0 / 479_001_600.0,
        -1.0 / 87_178_291_200.0,
        1.0 / 20_922_789_888_000.0,
    ];
    let one = Stages::splat(simd, 1.0);
    let turns = round(simd, x.times(core::f64::consts::FRAC_2_PI));
    let mut r = x;
    for part in HALF_PI {
        r = turns.neg_mul_add(Stages::splat(simd, part), r);
    }
    let square = r * r;
    let sine = (series(simd, &SINE, square) * square).mul_add(r, r);
    let cosine = series(simd, &COSINE, square).mul_add(square, one);
    // turns = 4 (...) + 2 upper + odd
    let quadrant = round(simd, turns.mul_add(Stages::splat(simd, 0.25), Stages::splat(simd, -0.375)))
        .neg_mul_add(Stages::splat(simd, 4.0), turns);
    let upper = round(simd, quadrant.mul_add(Stages::splat(simd, 0.5), Stages::splat(simd, -0.25)));
    let two = Stages::splat(simd, 2.0);
    let odd = upper.neg_mul_add(two, quadrant);
    let even = one - odd;
    let sine_sign = upper.neg_mul_add(two, one);
    // The cosine is negative in quadrants 1 and 2: where exactly one of the two digits is set.
    let differ = (odd * upper).neg_mul_add(two, odd + upper);
    let cosine_sign = differ.neg_mul_add(two, one);
    (sine_sign * odd.mul_add(cosine, even * sine), cosine_sign * odd.mul_add(sine, even * cosine))
}

/// To the nearest integer, below 2^51.
#[inline(always)]
fn round<S: StageSimd>(simd: S, x: Stages<S>) -> Stages<S> {
    let rounder = Stages::splat(simd, ROUNDER);
    (x + rounder) - rounder
}

/// `Σ c_k x^k`.
#[inline(always)]
fn series<S: StageSimd>(simd: S, coefficients: &[f64; 8], x: Stages<S>) -> Stages<S> {
    let mut sum = Stages::splat(simd, coefficients[7]);
    for k in (0..7).rev() {
        sum = sum.mul_add(x, Stages::splat(simd, coefficients[k]));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    struct SinCos<'a, M>(&'a M, &'a mut [M; 2]);
    impl<M: StageMemory> StageKernel<M> for SinCos<'_, M> {
        #[inline(always)]
        fn run<S: StageSimd<Memory = M>>(self, simd: S) {
            let (sine, cosine) = sin_cos(simd, Stages::load(simd, self.0));
            *self.1 = [sine.store(), cosine.store()];
        }
    }

    fn worst<S: StageSimd>(simd: S) -> f64 {
        let mut worst = 0.0f64;
        for k in 0..20_000 {
            let k = f64::from(k) - 10_000.0;
            for x in [k * 1e-3, k * core::f64::consts::FRAC_PI_4, k * 97.123_4, k * 1e-9] {
                let mut out = [S::Memory::default(); 2];
                simd.run(SinCos(&S::Memory::fill(x), &mut out));
                let (sine, cosine) = x.sin_cos();
                worst = worst.max((out[0].lanes()[1] - sine).abs()).max((out[1].lanes()[0] - cosine).abs());
            }
        }
        worst
    }

    #[test]
    fn sine_and_cosine_are_good_to_a_unit_in_the_last_place() {
        assert!(worst(Portable) < 2.3e-16, "{:e}", worst(Portable));
        #[cfg(target_arch = "x86_64")]
        {
            if let Some(simd) = pulp::x86::V3::try_new() {
                assert!(worst(simd) < 2.3e-16, "{:e}", worst(simd));
            }
            if let Some(simd) = pulp::x86::V4::try_new() {
                assert!(worst(simd) < 2.3e-16, "{:e}", worst(simd));
            }
        }
    }

    #[test]
    fn a_nan_stays_in_its_lane() {
        let mut x = Quad::splat(0.3);
        x.0[2] = f64::NAN;
        let mut out = [Quad::ZERO; 2];
        Portable.run(SinCos(&x, &mut out));
        assert!(out[0].0[2].is_nan() && out[1].0[2].is_nan());
        assert_eq!(out[0].0[0], out[0].0[3]);
        assert!((out[0].0[1] - 0.3f64.sin()).abs() < 2e-16);
    }
}
