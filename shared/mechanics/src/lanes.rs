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

mod algebra;
mod instruction_sets;

pub(crate) use algebra::{
    Number, add, bracket, cross, cross_add, dot3, dot6, dual_bracket, halves, join, load, load_strided,
    mat_mul, mat_tr_vec, mat_vec, mat_vec_add, outer, row, scale, scale_add, splat, store, sub, sym_vec,
};
pub(crate) use instruction_sets::Portable;

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
    /// `(a_0, a_1, b_0, b_1)`.
    fn low_halves(self, a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    /// `(Σ a, Σ b, Σ c, Σ d)`.
    fn sums(self, rows: [Self::Lanes; LANES]) -> Self::Lanes;
    /// `Σ a` in every lane.
    fn total(self, a: Self::Lanes) -> Self::Lanes;
    /// Lane 0.
    fn first(self, a: Self::Lanes) -> f64;

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
    /// `(self_0, self_1, b_0, b_1)`.
    #[inline(always)]
    pub fn low_halves(self, b: Self) -> Self {
        Self { lanes: self.simd.low_halves(self.lanes, b.lanes), ..self }
    }
    /// The sum over the lanes of each.
    #[inline(always)]
    pub fn sums([a, b, c, d]: [Self; LANES]) -> Self {
        Self { lanes: a.simd.sums([a.lanes, b.lanes, c.lanes, d.lanes]), ..a }
    }
    /// The sum over the lanes, in all of them.
    #[inline(always)]
    pub fn total(self) -> Self {
        Self { lanes: self.simd.total(self.lanes), ..self }
    }
    #[inline(always)]
    pub fn first(self) -> f64 {
        self.simd.first(self.lanes)
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

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [Quad; 2]);
    impl Kernel for Sum<'_> {
        type Output = [Quad; 6];
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> [Quad; 6] {
            let [a, b] = load(simd, self.0);
            let c = cross([a, b, a], [b, a, b]);
            let [a_b, sums] = [a.low_halves(b).quad(), Lane::sums([a, b, a + b, -a]).quad()];
            let total = a.total().quad();
            assert_eq!(a.first(), self.0[0].0[0]);
            [a.mul_add(b, -a).quad(), (a - b).quad(), c[0].quad(), a_b, sums, total]
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_lanes() {
        let quads = [Quad([1.0, 2.0, -3.0, 0.5]), Quad([4.0, 0.25, 2.0, 8.0])];
        let best = Instructions::detect().unwrap().dispatch(Sum(&quads));
        assert_eq!(best[0].0, [3.0, -1.5, -3.0, 3.5]);
        assert_eq!(best[3].0, [1.0, 2.0, 4.0, 0.25]);
        assert_eq!(best[4].0, [0.5, 14.25, 14.75, -0.5]);
        assert_eq!(best[5].0, [0.5; 4]);
        #[cfg(any(not(target_arch = "x86_64"), feature = "portable"))]
        assert_eq!(best, Instructions::Portable.dispatch(Sum(&quads)));
    }
}
