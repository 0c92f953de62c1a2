//! The scalar of the node recursions: eight lanes of `f64`, and dual numbers on them.
//!
//! A lane is one configuration of a stage (a node, a quarter point, a boundary); all lanes of a stage are evaluated in one
//! pass. [`Dual`] carries a directional derivative beside the value: `f(x + ε d) = f(x) + ε ∂f(x)·d`, `ε² = 0`. Second
//! derivatives evaluated on dual numbers give the third derivatives that the Hessian of `y·DEL` consists of.

use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

/// Configurations evaluated in one pass.
pub const LANES: usize = 8;

/// What the node recursions need of a number.
pub trait Scalar:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// Zero.
    const ZERO: Self;
    /// The same constant in every lane.
    fn constant(x: f64) -> Self;
    /// Product with a constant of the model.
    fn scale(self, x: f64) -> Self;
    /// Sine and cosine.
    fn sin_cos(self) -> (Self, Self);
    /// The values.
    fn value(&self) -> &Lanes;
    /// The directional derivatives.
    fn derivative(&self) -> Lanes;
}

/// Eight values.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Lanes(pub [f64; LANES]);

macro_rules! lanewise {
    ($trait:ident, $method:ident, $operator:tt) => {
        impl $trait for Lanes {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                let mut out = self;
                for lane in 0..LANES {
                    out.0[lane] = self.0[lane] $operator other.0[lane];
                }
                out
            }
        }
    };
}
lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);

impl Neg for Lanes {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Lanes(self.0.map(|x| -x))
    }
}

impl AddAssign for Lanes {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl SubAssign for Lanes {
    #[inline(always)]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

impl Scalar for Lanes {
    const ZERO: Self = Lanes([0.0; LANES]);
    #[inline(always)]
    fn constant(x: f64) -> Self {
        Lanes([x; LANES])
    }
    #[inline(always)]
    fn scale(self, x: f64) -> Self {
        self * Lanes([x; LANES])
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (mut sin, mut cos) = (self, self);
        for lane in 0..LANES {
            (sin.0[lane], cos.0[lane]) = self.0[lane].sin_cos();
        }
        (sin, cos)
    }
    #[inline(always)]
    fn value(&self) -> &Lanes {
        self
    }
    #[inline(always)]
    fn derivative(&self) -> Lanes {
        Lanes::ZERO
    }
}

/// A value and its derivative in one direction.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct Dual {
    /// The value.
    pub re: Lanes,
    /// The derivative.
    pub eps: Lanes,
}

impl Add for Dual {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { re: self.re + other.re, eps: self.eps + other.eps }
    }
}

impl Sub for Dual {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { re: self.re - other.re, eps: self.eps - other.eps }
    }
}

impl Mul for Dual {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self { re: self.re * other.re, eps: self.re * other.eps + self.eps * other.re }
    }
}

impl Neg for Dual {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self { re: -self.re, eps: -self.eps }
    }
}

impl AddAssign for Dual {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl SubAssign for Dual {
    #[inline(always)]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

impl Scalar for Dual {
    const ZERO: Self = Self { re: Lanes::ZERO, eps: Lanes::ZERO };
    #[inline(always)]
    fn constant(x: f64) -> Self {
        Self { re: Lanes::constant(x), eps: Lanes::ZERO }
    }
    #[inline(always)]
    fn scale(self, x: f64) -> Self {
        Self { re: self.re.scale(x), eps: self.eps.scale(x) }
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = self.re.sin_cos();
        (Self { re: sin, eps: self.eps * cos }, Self { re: cos, eps: -(self.eps * sin) })
    }
    #[inline(always)]
    fn value(&self) -> &Lanes {
        &self.re
    }
    #[inline(always)]
    fn derivative(&self) -> Lanes {
        self.eps
    }
}

/// Cross product.
#[inline(always)]
pub fn cross<T: Scalar>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Scalar product.
#[inline(always)]
pub fn dot<T: Scalar>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Sum.
#[inline(always)]
pub fn sum<T: Scalar>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Difference.
#[inline(always)]
pub fn difference<T: Scalar>(a: [T; 3], b: [T; 3]) -> [T; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Product of a vector and a number.
#[inline(always)]
pub fn times<T: Scalar>(a: [T; 3], x: T) -> [T; 3] {
    [a[0] * x, a[1] * x, a[2] * x]
}

/// A constant matrix (row-major) of the model times a rotation from the left: `R m`.
#[inline(always)]
pub fn times_constant<T: Scalar>(r: &[T; 9], m: &[f64; 9]) -> [T; 9] {
    let mut out = [T::ZERO; 9];
    for row in 0..3 {
        for column in 0..3 {
            let mut total = T::ZERO;
            for k in 0..3 {
                let factor = m[3 * k + column];
                if factor != 0.0 {
                    total += r[3 * row + k].scale(factor);
                }
            }
            out[3 * row + column] = total;
        }
    }
    out
}

/// `R v` for a constant vector of the model.
#[inline(always)]
pub fn rotate_constant<T: Scalar>(r: &[T; 9], v: &[f64; 3]) -> [T; 3] {
    let mut out = [T::ZERO; 3];
    for row in 0..3 {
        for k in 0..3 {
            if v[k] != 0.0 {
                out[row] += r[3 * row + k].scale(v[k]);
            }
        }
    }
    out
}
