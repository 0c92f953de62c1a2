//! Sine and cosine of a vector of stages.

use super::{StageSimd, Stages};

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
    use super::super::{StageKernel, StageMemory};
    use super::*;
    use crate::lanes::{Portable, Quad};

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
