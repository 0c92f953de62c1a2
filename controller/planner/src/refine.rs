//! A converged plan cut into more stages: the start of a second pass on a finer chain.
//!
//! Every stage is cut into equal parts. Positions come from its polynomial, impulses keep their values in units of the finer
//! `S`: a load that stands is shared by the parts, an impact goes whole to the last one.

use crate::plan_file::LOADED;
use crate::problem::Problem;
use crate::stage::polynomial;

/// Derivative of the polynomial's weights at the fraction `c`.
fn slopes(c: f64) -> [f64; 3] {
    [4.0 * c - 3.0, 4.0 - 8.0 * c, 4.0 * c - 1.0]
}

/// The plan vector of `fine` (a multiple of the stages of `coarse`, same robot and horizon) from one of `coarse`.
///
/// Returns none when the stages do not divide.
pub fn refine(coarse: &Problem, x: &[f64], fine: &Problem) -> Option<Vec<f64>> {
    if !fine.stages.is_multiple_of(coarse.stages) || fine.layout != coarse.layout {
        return None;
    }
    let parts = fine.stages / coarse.stages;
    let layout = coarse.layout;
    let (n, law) = (layout.n, &coarse.law);
    let mut out = vec![0.0; layout.plan(fine.stages)];
    let mut z = vec![0.0; layout.stage];
    for k in 0..coarse.stages {
        layout.gather(coarse.stages, k, x, &mut z);
        let (t0, t1) = (z[layout.t(0)], z[layout.t(1)]);
        let dt = t1 - t0;
        let at = |weights: [f64; 3], j: usize| {
            (0..3).map(|alpha| weights[alpha] * z[layout.node(alpha, j)]).sum::<f64>()
        };
        for part in 0..parts {
            let fraction = |s: f64| (part as f64 + s) / parts as f64;
            let index = k * parts + part;
            let start = fine.boundary(index);
            for j in 0..n {
                out[start + j] = at(polynomial(fraction(0.0)), j);
                out[start + n + j] =
                    if part == 0 { z[layout.v(0, j)] } else { at(slopes(fraction(0.0)), j) / dt };
                out[layout.inner_at(index) + j] = at(polynomial(fraction(0.5)), j);
            }
            out[start + 2 * n] = t0 + fraction(0.0) * dt;
            let inner = layout.inner_at(index);
            for input in 0..layout.inputs {
                out[inner + layout.input(input)] = z[layout.input(input)];
            }
            for i in 0..layout.contacts {
                let (from, to) = (layout.contact(i), inner + layout.contact(i));
                let normal = |node: usize| z[from + law.normal(node) - law.first_impulse()];
                let loaded = normal(0) + normal(1) > LOADED;
                for index in 0..layout.impulses {
                    let small = index + law.first_impulse();
                    let is_slip = small >= law.slip(0);
                    let at_end = small == law.normal(2)
                        || (law.tangential(2)..law.tangential(2) + law.tangents).contains(&small);
                    out[to + index] = if is_slip {
                        z[from + index] / parts as f64
                    } else if loaded {
                        z[from + index]
                    } else if at_end {
                        if part + 1 == parts { z[from + index] * parts as f64 } else { 0.0 }
                    } else {
                        z[from + index]
                    };
                }
            }
        }
    }
    let (from, to) = (coarse.boundary(coarse.stages), fine.boundary(fine.stages));
    out[to..to + layout.boundary].copy_from_slice(&x[from..from + layout.boundary]);
    Some(out)
}
