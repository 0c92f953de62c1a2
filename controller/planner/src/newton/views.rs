//! What tests ask of a linearisation.

use super::Minimiser;

impl Minimiser<'_> {
    /// `A d` at the last linearisation (for tests).
    pub fn matrix_times(&self, d: &[f64]) -> Vec<f64> {
        let (stages, layout) = (self.problem.stages, self.problem.layout);
        let mut out = vec![0.0; d.len()];
        let (mut z, mut product) = (vec![0.0; layout.stage], vec![0.0; layout.stage]);
        for k in 0..stages {
            layout.gather(stages, k, d, &mut z);
            let (a, ld) = (&self.derivatives[k].hessian, self.derivatives[k].ld);
            product.fill(0.0);
            for j in 0..layout.stage {
                product[j] += a[j * ld + j] * z[j];
                for i in j + 1..layout.stage {
                    product[i] += a[j * ld + i] * z[j];
                    product[j] += a[j * ld + i] * z[i];
                }
            }
            layout.scatter_add(stages, k, &product, &mut out);
        }
        for i in 0..d.len() {
            out[i] += self.bound_diagonal[i] * d[i];
        }
        out
    }

    /// Sets the curvature multipliers of all rows (for tests).
    pub fn set_curvature_multipliers(&mut self, mut value: impl FnMut(usize, usize) -> f64) {
        for (k, list) in self.curvatures.iter_mut().enumerate() {
            for (r, l) in list.iter_mut().enumerate() {
                *l = value(k, r);
            }
        }
    }

    /// The multipliers that the penalty stands for at the last linearisation (for tests).
    pub fn penalty_multipliers(&self) -> &[Vec<f64>] {
        &self.multipliers
    }
}
