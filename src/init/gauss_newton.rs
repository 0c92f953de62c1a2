//! Least squares in a box: Gauss-Newton with Levenberg's damping and steps of bounded length.
//!
//! For postures: a few dozen unknowns, solved once. The Jacobian is one of forward differences.

use nalgebra::{DMatrix, DVector};

/// Longest step of an unknown, rad or m.
const STEP: f64 = 0.3;
/// Levenberg's.
const DAMPING: f64 = 1e-3;
const MOST_STEPS: usize = 300;
/// Of the differences.
const H: f64 = 1e-6;
/// Steps shorter than this end it.
const SHORT: f64 = 1e-9;

/// The unknowns near `start`, between `lower` and `upper`, at which the sum of the squares of `residual` is least.
pub fn least_squares(
    mut residual: impl FnMut(&DVector<f64>) -> DVector<f64>,
    start: &DVector<f64>,
    lower: &DVector<f64>,
    upper: &DVector<f64>,
) -> DVector<f64> {
    let mut x = start.clone();
    for _ in 0..MOST_STEPS {
        let here = residual(&x);
        let mut jacobian = DMatrix::zeros(here.len(), x.len());
        for unknown in 0..x.len() {
            let mut moved = x.clone();
            moved[unknown] += H;
            jacobian.set_column(unknown, &((residual(&moved) - &here) / H));
        }
        let gradient = jacobian.tr_mul(&here);
        // An unknown at a bound that it would leave the box by stays there.
        for unknown in 0..x.len() {
            let held = (x[unknown] <= lower[unknown] && gradient[unknown] > 0.0)
                || (x[unknown] >= upper[unknown] && gradient[unknown] < 0.0);
            if held {
                jacobian.column_mut(unknown).fill(0.0);
            }
        }
        let normal = jacobian.tr_mul(&jacobian) + DMatrix::identity(x.len(), x.len()) * DAMPING;
        let Some(factor) = normal.cholesky() else { break };
        let mut step = -factor.solve(&jacobian.tr_mul(&here));
        let longest = step.amax();
        if longest > STEP {
            step *= STEP / longest;
        }
        let next = (&x + step).sup(lower).inf(upper);
        let moved = (&next - &x).amax();
        x = next;
        if moved < SHORT {
            break;
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_is_found_inside_and_at_a_bound() {
        let valley = |x: &DVector<f64>| DVector::from_vec(vec![x[0] - 1.0, 10.0 * (x[1] - x[0] * x[0])]);
        let box_of = |upper: f64| (DVector::from_element(2, -2.0), DVector::from_element(2, upper));
        let (lower, upper) = box_of(2.0);
        let inside = least_squares(valley, &DVector::from_vec(vec![-1.0, 1.0]), &lower, &upper);
        assert!((inside - DVector::from_vec(vec![1.0, 1.0])).amax() < 1e-6);
        let (lower, upper) = box_of(0.5);
        let edge = least_squares(valley, &DVector::zeros(2), &lower, &upper);
        assert!((edge - DVector::from_vec(vec![0.5, 0.25])).amax() < 1e-2);
    }
}
