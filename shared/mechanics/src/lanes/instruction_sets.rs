//! [`Simd`] for four lanes of scalar code, AVX2 and AVX-512.

use super::{Quad, Simd, WIDE};

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
    #[inline(always)]
    fn low_halves(self, a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
        [a[0], a[1], b[0], b[1]]
    }
    #[inline(always)]
    fn sums(self, rows: [[f64; 4]; 4]) -> [f64; 4] {
        rows.map(|[a, b, c, d]| (a + b) + (c + d))
    }
    #[inline(always)]
    fn total(self, [a, b, c, d]: [f64; 4]) -> [f64; 4] {
        [(a + c) + (b + d); 4]
    }
    #[inline(always)]
    fn first(self, a: [f64; 4]) -> f64 {
        a[0]
    }
}

/// The operations on four lanes, which AVX2 and AVX-512 share.
#[cfg(target_arch = "x86_64")]
macro_rules! four_lanes_of_pulp {
    () => {
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
        #[inline(always)]
        fn low_halves(self, a: pulp::f64x4, b: pulp::f64x4) -> pulp::f64x4 {
            pulp::cast(self.avx._mm256_permute2f128_pd::<0x20>(pulp::cast(a), pulp::cast(b)))
        }
        #[inline(always)]
        fn sums(self, rows: [pulp::f64x4; 4]) -> pulp::f64x4 {
            let [a, b, c, d] = rows.map(pulp::cast);
            // (a_0 + a_1, b_0 + b_1, a_2 + a_3, b_2 + b_3), and the same of c and d.
            let (ab, cd) = (self.avx._mm256_hadd_pd(a, b), self.avx._mm256_hadd_pd(c, d));
            let low = self.avx._mm256_permute2f128_pd::<0x20>(ab, cd);
            let high = self.avx._mm256_permute2f128_pd::<0x31>(ab, cd);
            pulp::cast(self.avx._mm256_add_pd(low, high))
        }
        #[inline(always)]
        fn total(self, a: pulp::f64x4) -> pulp::f64x4 {
            let a = pulp::cast(a);
            let halves = self.avx._mm256_add_pd(a, self.avx._mm256_permute2f128_pd::<0x01>(a, a));
            pulp::cast(self.avx._mm256_add_pd(halves, self.avx._mm256_permute_pd::<0b0101>(halves)))
        }
        #[inline(always)]
        fn first(self, a: pulp::f64x4) -> f64 {
            a.0
        }
    };
}

#[cfg(target_arch = "x86_64")]
impl Simd for pulp::x86::V3 {
    four_lanes_of_pulp!();
    wide_as_four_lanes!();
}

#[cfg(target_arch = "x86_64")]
impl Simd for pulp::x86::V4 {
    four_lanes_of_pulp!();

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
