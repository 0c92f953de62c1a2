//! [`StageSimd`] for four stages in scalar code and AVX2, eight in AVX-512.

#[cfg(target_arch = "x86_64")]
use super::Oct;
#[cfg(feature = "compact")]
use super::Single;
use super::{StageKernel, StageSimd};
#[cfg(not(feature = "compact"))]
use crate::lanes::Portable;
#[cfg(any(not(feature = "compact"), target_arch = "x86_64"))]
use crate::lanes::{Quad, Simd};

/// The operations of four stages that are those of four nodes.
#[cfg(any(not(feature = "compact"), target_arch = "x86_64"))]
macro_rules! as_four_lanes {
    () => {
        type Memory = Quad;
        type Vector = <Self as Simd>::Lanes;
        #[inline(always)]
        fn splat(self, x: f64) -> Self::Vector {
            Simd::splat(self, x)
        }
        #[inline(always)]
        fn load(self, memory: &Quad) -> Self::Vector {
            Simd::load(self, memory)
        }
        #[inline(always)]
        fn store(self, v: Self::Vector) -> Quad {
            Simd::store(self, v)
        }
        #[inline(always)]
        fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
            Simd::add(self, a, b)
        }
        #[inline(always)]
        fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
            Simd::sub(self, a, b)
        }
        #[inline(always)]
        fn mul(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
            Simd::mul(self, a, b)
        }
        #[inline(always)]
        fn mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
            Simd::mul_add(self, a, b, c)
        }
        #[inline(always)]
        fn neg_mul_add(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector {
            Simd::neg_mul_add(self, a, b, c)
        }
        #[inline(always)]
        fn transpose(self, rows: &[Quad], places: &[u32], out: &mut [Quad]) {
            transpose_quads(rows, places, out);
        }
    };
}

/// One stage at a time.
#[cfg(feature = "compact")]
#[derive(Clone, Copy, Debug)]
pub(crate) struct OneStage;

#[cfg(feature = "compact")]
impl StageSimd for OneStage {
    type Memory = Single;
    type Vector = f64;
    #[inline(always)]
    fn splat(self, x: f64) -> f64 {
        x
    }
    #[inline(always)]
    fn load(self, memory: &Single) -> f64 {
        memory.0[0]
    }
    #[inline(always)]
    fn store(self, v: f64) -> Single {
        Single([v])
    }
    #[inline(always)]
    fn add(self, a: f64, b: f64) -> f64 {
        a + b
    }
    #[inline(always)]
    fn sub(self, a: f64, b: f64) -> f64 {
        a - b
    }
    #[inline(always)]
    fn mul(self, a: f64, b: f64) -> f64 {
        a * b
    }
    #[inline(always)]
    fn div(self, a: f64, b: f64) -> f64 {
        a / b
    }
    #[inline(always)]
    fn mul_add(self, a: f64, b: f64, c: f64) -> f64 {
        a * b + c
    }
    #[inline(always)]
    fn neg_mul_add(self, a: f64, b: f64, c: f64) -> f64 {
        c - a * b
    }
    #[inline(always)]
    fn max_abs(self, a: f64, x: f64) -> f64 {
        a.max(x.abs())
    }
    #[inline(always)]
    fn transpose(self, rows: &[Single], places: &[u32], out: &mut [Single]) {
        out[0] = rows[places[0] as usize];
    }
    #[inline(always)]
    fn run<K: StageKernel<Single>>(self, kernel: K) {
        kernel.run(self);
    }
}

#[cfg(not(feature = "compact"))]
impl StageSimd for Portable {
    as_four_lanes!();
    #[inline(always)]
    fn div(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0] / b[0], a[1] / b[1], a[2] / b[2], a[3] / b[3]]
    }
    #[inline(always)]
    fn max_abs(self, a: [f64; 4], x: [f64; 4]) -> [f64; 4] {
        let [x0, x1, x2, x3] = x;
        [a[0].max(x0.abs()), a[1].max(x1.abs()), a[2].max(x2.abs()), a[3].max(x3.abs())]
    }
    #[inline(always)]
    fn run<K: StageKernel<Quad>>(self, kernel: K) {
        kernel.run(self);
    }
}

#[cfg(target_arch = "x86_64")]
impl StageSimd for pulp::x86::V3 {
    as_four_lanes!();
    #[inline(always)]
    fn div(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
        self.div_f64x4(a, b)
    }
    #[inline(always)]
    fn max_abs(self, a: pulp::f64x4, x: pulp::f64x4) -> pulp::f64x4 {
        self.max_f64x4(a, self.abs_f64x4(x))
    }
    #[inline(always)]
    fn run<K: StageKernel<Quad>>(self, kernel: K) {
        pulp::Simd::vectorize(self, With { kernel, simd: self });
    }
}

#[cfg(target_arch = "x86_64")]
impl StageSimd for pulp::x86::V4 {
    type Memory = Oct;
    type Vector = pulp::f64x8;
    #[inline(always)]
    fn splat(self, x: f64) -> pulp::f64x8 {
        self.splat_f64x8(x)
    }
    #[inline(always)]
    fn load(self, memory: &Oct) -> pulp::f64x8 {
        pulp::cast(memory.0)
    }
    #[inline(always)]
    fn store(self, v: pulp::f64x8) -> Oct {
        Oct(pulp::cast(v))
    }
    #[inline(always)]
    fn add(self, a: pulp::f64x8, b: pulp::f64x8) -> pulp::f64x8 {
        self.add_f64x8(a, b)
    }
    #[inline(always)]
    fn sub(self, a: pulp::f64x8, b: pulp::f64x8) -> pulp::f64x8 {
        self.sub_f64x8(a, b)
    }
    #[inline(always)]
    fn mul(self, a: pulp::f64x8, b: pulp::f64x8) -> pulp::f64x8 {
        self.mul_f64x8(a, b)
    }
    #[inline(always)]
    fn div(self, a: pulp::f64x8, b: pulp::f64x8) -> pulp::f64x8 {
        self.div_f64x8(a, b)
    }
    #[inline(always)]
    fn mul_add(self, a: pulp::f64x8, b: pulp::f64x8, c: pulp::f64x8) -> pulp::f64x8 {
        self.mul_add_f64x8(a, b, c)
    }
    #[inline(always)]
    fn neg_mul_add(self, a: pulp::f64x8, b: pulp::f64x8, c: pulp::f64x8) -> pulp::f64x8 {
        self.negate_mul_add_f64x8(a, b, c)
    }
    #[inline(always)]
    fn max_abs(self, a: pulp::f64x8, x: pulp::f64x8) -> pulp::f64x8 {
        self.max_f64x8(a, self.abs_f64x8(x))
    }
    #[inline(always)]
    fn transpose(self, rows: &[Oct], places: &[u32], out: &mut [Oct]) {
        transpose_octs(self, rows, places, out);
    }
    #[inline(always)]
    fn run<K: StageKernel<Oct>>(self, kernel: K) {
        pulp::Simd::vectorize(self, With { kernel, simd: self });
    }
}

#[cfg(any(not(feature = "compact"), target_arch = "x86_64"))]
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
