//! SIMD lanes over the control nodes of a step.
//!
//! The recursions of the paper do the same arithmetic at every node `α = 0..s`. Here one lane is one node: a quantity of
//! a body is stored as a [`Quad`] of four doubles (nodes 0..3; a rule with more nodes uses several quads, its *groups*),
//! and the kernels are written once over a [`Simd`] token. The processor is asked once, when a workspace is built
//! ([`Instructions::detect`]); a plain build still uses AVX2 and fused multiply-add, and AVX-512 where it pays.
//!
//! The functions here are loops over arrays, not closures: a closure that the compiler leaves out of line loses the
//! instruction set.
//!
//! Every kernel is compiled once per instruction set, and scalar code for four lanes takes the compiler longer than all
//! vector code together. On x86-64 it is therefore an option: without the feature `portable`, processors older than AVX2
//! (2013) are refused by [`ModelError::Processor`]. Other architectures always have it.

use core::ops::{Add, Mul, Neg, Sub};

use crate::errors::ModelError;

/// Lanes in a [`Quad`].
pub(crate) const LANES: usize = 4;
/// Quads in a [`WideLane`].
pub(crate) const WIDE: usize = 4;

/// Four doubles, one per control node.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(32))]
pub(crate) struct Quad(pub [f64; LANES]);

impl Quad {
    pub const ZERO: Quad = Quad([0.0; LANES]);

    pub const fn splat(x: f64) -> Self {
        Quad([x; LANES])
    }
}

/// Arithmetic on four lanes with one instruction set.
pub(crate) trait Simd: Copy {
    /// Whether kernels are worth compiling once per common number of nodes (it costs build time).
    const SPECIALISE: bool;
    type Lanes: Copy;
    fn splat(self, x: f64) -> Self::Lanes;
    fn load(self, quad: &Quad) -> Self::Lanes;
    fn store(self, lanes: Self::Lanes) -> Quad;
    fn add(self, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    fn sub(self, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    fn mul(self, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    /// `a b + c`.
    fn mul_add(self, a: Self::Lanes, b: Self::Lanes, c: Self::Lanes) -> Self::Lanes;
    /// `c - a b`.
    fn neg_mul_add(self, a: Self::Lanes, b: Self::Lanes, c: Self::Lanes) -> Self::Lanes;

    /// How many [`Simd::Wide`] a kernel may take at a time and still find registers for its sums.
    const WIDES: usize;
    /// Sixteen doubles: [`WIDE`] neighbouring quads of a row of right-hand sides.
    type Wide: Copy;
    fn wide_splat(self, x: f64) -> Self::Wide;
    fn wide_load(self, quads: &[Quad; WIDE]) -> Self::Wide;
    fn wide_store(self, wide: Self::Wide) -> [Quad; WIDE];
    /// `a b + c`.
    fn wide_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide;
    /// `c - a b`.
    fn wide_neg_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide;
}

/// The wide operations of an instruction set whose widest register is one [`Simd::Lanes`].
macro_rules! wide_as_four_lanes {
    () => {
        const WIDES: usize = 1;
        type Wide = [Self::Lanes; 4];
        #[inline(always)]
        fn wide_splat(self, x: f64) -> Self::Wide {
            [self.splat(x); 4]
        }
        #[inline(always)]
        fn wide_load(self, q: &[Quad; WIDE]) -> Self::Wide {
            [self.load(&q[0]), self.load(&q[1]), self.load(&q[2]), self.load(&q[3])]
        }
        #[inline(always)]
        fn wide_store(self, w: Self::Wide) -> [Quad; WIDE] {
            [self.store(w[0]), self.store(w[1]), self.store(w[2]), self.store(w[3])]
        }
        #[inline(always)]
        fn wide_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide {
            [
                self.mul_add(a[0], b[0], c[0]),
                self.mul_add(a[1], b[1], c[1]),
                self.mul_add(a[2], b[2], c[2]),
                self.mul_add(a[3], b[3], c[3]),
            ]
        }
        #[inline(always)]
        fn wide_neg_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide {
            [
                self.neg_mul_add(a[0], b[0], c[0]),
                self.neg_mul_add(a[1], b[1], c[1]),
                self.neg_mul_add(a[2], b[2], c[2]),
                self.neg_mul_add(a[3], b[3], c[3]),
            ]
        }
    };
}

/// Plain arrays: what every processor can do.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Portable;

#[inline(always)]
fn zip(a: [f64; 4], b: [f64; 4], f: impl Fn(f64, f64) -> f64) -> [f64; 4] {
    [f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])]
}

impl Simd for Portable {
    const SPECIALISE: bool = false;
    wide_as_four_lanes!();
    type Lanes = [f64; 4];
    #[inline(always)]
    fn splat(self, x: f64) -> [f64; 4] {
        [x; 4]
    }
    #[inline(always)]
    fn load(self, quad: &Quad) -> [f64; 4] {
        quad.0
    }
    #[inline(always)]
    fn store(self, lanes: [f64; 4]) -> Quad {
        Quad(lanes)
    }
    #[inline(always)]
    fn add(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        zip(a, b, |x, y| x + y)
    }
    #[inline(always)]
    fn sub(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        zip(a, b, |x, y| x - y)
    }
    #[inline(always)]
    fn mul(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        zip(a, b, |x, y| x * y)
    }
    #[inline(always)]
    fn mul_add(self, a: [f64; 4], b: [f64; 4], c: [f64; 4]) -> [f64; 4] {
        self.add(self.mul(a, b), c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: [f64; 4], b: [f64; 4], c: [f64; 4]) -> [f64; 4] {
        self.sub(c, self.mul(a, b))
    }
}

#[cfg(target_arch = "x86_64")]
impl Simd for pulp::x86::V3 {
    const SPECIALISE: bool = true;
    wide_as_four_lanes!();
    type Lanes = pulp::f64x4;
    #[inline(always)]
    fn splat(self, x: f64) -> pulp::f64x4 {
        self.splat_f64x4(x)
    }
    #[inline(always)]
    fn load(self, quad: &Quad) -> pulp::f64x4 {
        pulp::cast(quad.0)
    }
    #[inline(always)]
    fn store(self, lanes: pulp::f64x4) -> Quad {
        Quad(pulp::cast(lanes))
    }
    #[inline(always)]
    fn add(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.add_f64x4(a, b)
    }
    #[inline(always)]
    fn sub(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.sub_f64x4(a, b)
    }
    #[inline(always)]
    fn mul(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.mul_f64x4(a, b)
    }
    #[inline(always)]
    fn mul_add(self, a: pulp::f64x4, b: pulp::f64x4, c: pulp::f64x4) -> pulp::f64x4 {
        self.mul_add_f64x4(a, b, c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: pulp::f64x4, b: pulp::f64x4, c: pulp::f64x4) -> pulp::f64x4 {
        self.negate_mul_add_f64x4(a, b, c)
    }
}

#[cfg(target_arch = "x86_64")]
impl Simd for pulp::x86::V4 {
    const SPECIALISE: bool = true;
    type Lanes = pulp::f64x4;
    #[inline(always)]
    fn splat(self, x: f64) -> pulp::f64x4 {
        self.splat_f64x4(x)
    }
    #[inline(always)]
    fn load(self, quad: &Quad) -> pulp::f64x4 {
        pulp::cast(quad.0)
    }
    #[inline(always)]
    fn store(self, lanes: pulp::f64x4) -> Quad {
        Quad(pulp::cast(lanes))
    }
    #[inline(always)]
    fn add(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.add_f64x4(a, b)
    }
    #[inline(always)]
    fn sub(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.sub_f64x4(a, b)
    }
    #[inline(always)]
    fn mul(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.mul_f64x4(a, b)
    }
    #[inline(always)]
    fn mul_add(self, a: pulp::f64x4, b: pulp::f64x4, c: pulp::f64x4) -> pulp::f64x4 {
        self.mul_add_f64x4(a, b, c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: pulp::f64x4, b: pulp::f64x4, c: pulp::f64x4) -> pulp::f64x4 {
        self.negate_mul_add_f64x4(a, b, c)
    }

    const WIDES: usize = 2;
    type Wide = [pulp::f64x8; 2];
    #[inline(always)]
    fn wide_splat(self, x: f64) -> [pulp::f64x8; 2] {
        [self.splat_f64x8(x); 2]
    }
    #[inline(always)]
    fn wide_load(self, q: &[Quad; WIDE]) -> [pulp::f64x8; 2] {
        // By registers: through memory, the wide load would wait for two narrow stores.
        let first = self.avx512f._mm512_castpd256_pd512(pulp::cast(q[0].0));
        let second = self.avx512f._mm512_castpd256_pd512(pulp::cast(q[2].0));
        [
            pulp::cast(self.avx512f._mm512_insertf64x4::<1>(first, pulp::cast(q[1].0))),
            pulp::cast(self.avx512f._mm512_insertf64x4::<1>(second, pulp::cast(q[3].0))),
        ]
    }
    #[inline(always)]
    fn wide_store(self, wide: [pulp::f64x8; 2]) -> [Quad; WIDE] {
        let [first, second] = [pulp::cast(wide[0]), pulp::cast(wide[1])];
        [
            Quad(pulp::cast(self.avx512f._mm512_castpd512_pd256(first))),
            Quad(pulp::cast(self.avx512f._mm512_extractf64x4_pd::<1>(first))),
            Quad(pulp::cast(self.avx512f._mm512_castpd512_pd256(second))),
            Quad(pulp::cast(self.avx512f._mm512_extractf64x4_pd::<1>(second))),
        ]
    }
    #[inline(always)]
    fn wide_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide {
        [self.mul_add_f64x8(a[0], b[0], c[0]), self.mul_add_f64x8(a[1], b[1], c[1])]
    }
    #[inline(always)]
    fn wide_neg_mul_add(self, a: Self::Wide, b: Self::Wide, c: Self::Wide) -> Self::Wide {
        [self.negate_mul_add_f64x8(a[0], b[0], c[0]), self.negate_mul_add_f64x8(a[1], b[1], c[1])]
    }
}

/// Work that runs under any instruction set. Implementations and all they call must be `#[inline(always)]`, so that
/// the code is generated inside the function that enables the instructions.
pub(crate) trait Kernel {
    type Output;
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// The instruction set the kernels use, found out once.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Instructions {
    #[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
    Portable,
    #[cfg(target_arch = "x86_64")]
    V3(pulp::x86::V3),
    #[cfg(target_arch = "x86_64")]
    V4(pulp::x86::V3, pulp::x86::V4),
}

impl Instructions {
    /// The best the processor offers.
    ///
    /// # Errors
    /// [`ModelError::Processor`] on x86-64 without AVX2 and fused multiply-add, unless built with the feature `portable`.
    pub fn detect() -> Result<Self, ModelError> {
        #[cfg(target_arch = "x86_64")]
        if let Some(v3) = pulp::x86::V3::try_new() {
            return Ok(match pulp::x86::V4::try_new() {
                Some(v4) => Self::V4(v3, v4),
                None => Self::V3(v3),
            });
        }
        #[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
        return Ok(Self::Portable);
        #[cfg(not(any(not(target_arch = "x86_64"), feature = "portable")))]
        Err(ModelError::Processor)
    }

    /// Runs a kernel with these instructions enabled.
    #[inline(always)]
    pub fn dispatch<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
            Self::Portable => run_portably(kernel),
            #[cfg(target_arch = "x86_64")]
            Self::V3(v3) | Self::V4(v3, _) => pulp::Simd::vectorize(v3, With { kernel, simd: v3 }),
        }
    }

    /// Runs a kernel that works on rows of sixteen: those gain from the widest registers, the others have four lanes anyway.
    #[inline(always)]
    pub fn dispatch_wide<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::V4(_, v4) => pulp::Simd::vectorize(v4, With { kernel, simd: v4 }),
            other => other.dispatch(kernel),
        }
    }
}

/// Out of line, so that a kernel is compiled once however often it is dispatched.
#[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
#[inline(never)]
fn run_portably<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Portable)
}

#[cfg(target_arch = "x86_64")]
struct With<K, S> {
    kernel: K,
    simd: S,
}

#[cfg(target_arch = "x86_64")]
impl<K: Kernel, S: Simd> pulp::WithSimd for With<K, S> {
    type Output = K::Output;
    #[inline(always)]
    fn with_simd<P: pulp::Simd>(self, _: P) -> K::Output {
        self.kernel.run(self.simd)
    }
}

/// Four lanes together with the token that may compute on them: gives the kernels ordinary operators.
#[derive(Clone, Copy)]
pub(crate) struct Lane<S: Simd> {
    simd: S,
    lanes: S::Lanes,
}

/// A 3-vector in every lane.
pub(crate) type Lane3<S> = [Lane<S>; 3];
/// A 6-vector (angular first) in every lane.
pub(crate) type Lane6<S> = [Lane<S>; 6];
/// A row-major 3x3 matrix in every lane.
pub(crate) type Lane9<S> = [Lane<S>; 9];

impl<S: Simd> Lane<S> {
    #[inline(always)]
    pub fn splat(simd: S, x: f64) -> Self {
        Self { simd, lanes: simd.splat(x) }
    }
    #[inline(always)]
    pub fn load(simd: S, quad: &Quad) -> Self {
        Self { simd, lanes: simd.load(quad) }
    }
    #[inline(always)]
    pub fn quad(self) -> Quad {
        self.simd.store(self.lanes)
    }
    /// `self b + c`.
    #[inline(always)]
    pub fn mul_add(self, b: Self, c: Self) -> Self {
        Self { lanes: self.simd.mul_add(self.lanes, b.lanes, c.lanes), ..self }
    }
    /// `c - self b`.
    #[inline(always)]
    pub fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self { lanes: self.simd.neg_mul_add(self.lanes, b.lanes, c.lanes), ..self }
    }
}

impl<S: Simd> Add for Lane<S> {
    type Output = Self;
    #[inline(always)]
    fn add(self, rhs: Self) -> Self {
        Self { lanes: self.simd.add(self.lanes, rhs.lanes), ..self }
    }
}

impl<S: Simd> Sub for Lane<S> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, rhs: Self) -> Self {
        Self { lanes: self.simd.sub(self.lanes, rhs.lanes), ..self }
    }
}

impl<S: Simd> Mul for Lane<S> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, rhs: Self) -> Self {
        Self { lanes: self.simd.mul(self.lanes, rhs.lanes), ..self }
    }
}

impl<S: Simd> Neg for Lane<S> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self::splat(self.simd, 0.0) - self
    }
}

/// Sixteen doubles with their token, for rows of right-hand sides.
#[derive(Clone, Copy)]
pub(crate) struct WideLane<S: Simd> {
    simd: S,
    wide: S::Wide,
}

impl<S: Simd> WideLane<S> {
    #[inline(always)]
    pub fn splat(simd: S, x: f64) -> Self {
        Self { simd, wide: simd.wide_splat(x) }
    }
    #[inline(always)]
    pub fn of(simd: S, quads: &[Quad; WIDE]) -> Self {
        Self { simd, wide: simd.wide_load(quads) }
    }
    #[inline(always)]
    pub fn quads(self) -> [Quad; WIDE] {
        self.simd.wide_store(self.wide)
    }
    #[inline(always)]
    pub fn store(self, row: &mut [Quad], at: usize) {
        if let Some(quads) = row.get_mut(at..).and_then(|rest| rest.first_chunk_mut::<WIDE>()) {
            *quads = self.simd.wide_store(self.wide);
        }
    }
    /// `self b + c`.
    #[inline(always)]
    pub fn mul_add(self, b: Self, c: Self) -> Self {
        Self { wide: self.simd.wide_mul_add(self.wide, b.wide, c.wide), ..self }
    }
    /// `c - self b`.
    #[inline(always)]
    pub fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self { wide: self.simd.wide_neg_mul_add(self.wide, b.wide, c.wide), ..self }
    }
    #[inline(always)]
    pub fn is_zero(self) -> bool {
        let mut zero = true;
        for quad in self.quads() {
            for x in quad.0 {
                zero &= x == 0.0;
            }
        }
        zero
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

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [Quad; 2]);
    impl Kernel for Sum<'_> {
        type Output = [Quad; 3];
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> [Quad; 3] {
            let [a, b] = load(simd, self.0);
            let c = cross([a, b, a], [b, a, b]);
            [a.mul_add(b, -a).quad(), (a - b).quad(), c[0].quad()]
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_lanes() {
        let quads = [Quad([1.0, 2.0, -3.0, 0.5]), Quad([4.0, 0.25, 2.0, 8.0])];
        let best = Instructions::detect().unwrap().dispatch(Sum(&quads));
        assert_eq!(best[0].0, [3.0, -1.5, -3.0, 3.5]);
        #[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
        assert_eq!(best, Instructions::Portable.dispatch(Sum(&quads)));
    }
}
