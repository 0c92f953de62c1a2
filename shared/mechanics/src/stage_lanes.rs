//! SIMD lanes over the stages of a horizon: one lane is one stage.
//!
//! [`crate::lanes`] puts the control nodes of *one* step into the lanes; here every lane is a whole step of the same tree. The
//! index structure is the same in all of them, so the kernels of [`crate::stage_batch`] are the scalar algorithms with a number
//! replaced by a vector of stages: no shuffles and no masks; a lane with a NaN does not touch the others. Vectors have eight
//! doubles with AVX-512 and four otherwise. Vectors, matrices and brackets of them are those of [`crate::lanes`].

use core::ops::{Add, Div, Mul, Neg, Sub};

use crate::lanes::Number;
#[cfg(any(not(feature = "compact"), target_arch = "x86_64"))]
use crate::lanes::Quad;

mod instruction_sets;
mod sin_cos;

#[cfg(feature = "compact")]
pub(crate) use instruction_sets::OneStage;
pub(crate) use sin_cos::{LARGEST_ANGLE, sin_cos};

/// One number of every stage of a vector, as it lies in memory.
pub(crate) trait StageMemory: Copy + Default {
    /// Stages in a vector.
    const COUNT: usize;
    fn fill(x: f64) -> Self;
    fn lanes(&self) -> &[f64];
    fn lanes_mut(&mut self) -> &mut [f64];
}

#[cfg(any(not(feature = "compact"), target_arch = "x86_64"))]
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

/// One double: a stage by itself.
#[cfg(feature = "compact")]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Single(pub [f64; 1]);

#[cfg(feature = "compact")]
impl StageMemory for Single {
    const COUNT: usize = 1;
    fn fill(x: f64) -> Self {
        Self([x])
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

/// How scalar code does the stages: one at a time with the feature `compact`, else four, as the vectors of other processors.
#[cfg(feature = "compact")]
pub(crate) type ScalarStages = OneStage;
#[cfg(not(feature = "compact"))]
pub(crate) type ScalarStages = crate::lanes::Portable;

/// Eight doubles, one per stage.
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Oct(pub [f64; 8]);

#[cfg(target_arch = "x86_64")]
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

impl<S: StageSimd> Number for Stages<S> {
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Stages::mul_add(self, b, c)
    }
    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Stages::neg_mul_add(self, b, c)
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
