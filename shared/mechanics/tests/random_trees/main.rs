//! The integrator on random trees of up to 60 joints, fixed and floating: every algorithm against every other and against finite
//! differences.
//!
//! A tree is drawn from a seed: revolute and prismatic joints mixed, parents at random (bodies are numbered parent-first, not
//! depth-first), wide or deep; joint damping, springs, drag, constant wrenches, massless intermediate bodies, point forces and wrench
//! laws as the bits of `traits` say. The cases are the same on every run; a failure prints its input.
#![allow(clippy::panic, clippy::unwrap_used, reason = "helpers of tests: what fails here is a failed test")]

mod linearisation;
mod newton_equations;
#[path = "../random_tree/mod.rs"]
mod random_tree;
mod robot;
mod solutions;

use delmpc_mechanics::newton_direction::NewtonMethod;

const METHODS: [NewtonMethod; 3] = [NewtonMethod::Dense, NewtonMethod::BranchLu, NewtonMethod::Recursive];

/// Relative difference of two ways to form the same matrix: round-off of sums over 60 bodies.
const SAME_MATRIX: f64 = 1e-12;
/// Finite differences with Richardson extrapolation: truncation `h⁴` and round-off `ε|f|/h` with `h` below, relative to the column.
const DIFFERENCES: f64 = 2e-8;
/// Increment of the finite differences.
const INCREMENT: f64 = 1e-3;

/// Central differences of `f` at 0 along a curve, extrapolated: `(4 D(h/2) - D(h)) / 3`.
fn derivative(mut f: impl FnMut(f64) -> Vec<f64>) -> Vec<f64> {
    let mut central = |h: f64| -> Vec<f64> {
        let (ahead, behind) = (f(h), f(-h));
        ahead.iter().zip(&behind).map(|(a, b)| (a - b) / (2.0 * h)).collect()
    };
    let (coarse, fine) = (central(INCREMENT), central(0.5 * INCREMENT));
    fine.iter().zip(&coarse).map(|(fine, coarse)| (4.0 * fine - coarse) / 3.0).collect()
}
