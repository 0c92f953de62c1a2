//! Elementary functions on `f64` with and without the standard library.

#[cfg(not(feature = "std"))]
mod implementation {
    pub fn sin_cos(x: f64) -> (f64, f64) {
        libm::sincos(x)
    }
    pub fn sqrt(x: f64) -> f64 {
        libm::sqrt(x)
    }
    pub fn atan2(y: f64, x: f64) -> f64 {
        libm::atan2(y, x)
    }
    pub fn cos(x: f64) -> f64 {
        libm::cos(x)
    }
}

#[cfg(feature = "std")]
mod implementation {
    pub fn sin_cos(x: f64) -> (f64, f64) {
        x.sin_cos()
    }
    pub fn sqrt(x: f64) -> f64 {
        x.sqrt()
    }
    pub fn atan2(y: f64, x: f64) -> f64 {
        y.atan2(x)
    }
    pub fn cos(x: f64) -> f64 {
        x.cos()
    }
}

pub(crate) use implementation::{atan2, cos, sin_cos, sqrt};
