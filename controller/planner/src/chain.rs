//! The Newton system of the stage chain: `Σ_k` of stage matrices in `[Y_k | X_k | X_{k+1}]`.
//!
//! ```text
//! for k = 0..N-1:  A_k[X_k, X_k] += what is left of stage k-1;   partial Cholesky of the columns Y_k, X_k;   the rest goes to k+1
//! last:            Cholesky of X_N
//! ```
//!
//! This is a Riccati sweep forwards in time. Cost per stage: a partial Cholesky of the stage matrix.

use pulp::Arch;

use crate::dense::{backward, forward, padded, partial_cholesky};
use crate::layout::Layout;

/// Factors of the chain.
#[derive(Clone, Debug)]
pub struct Chain {
    arch: Arch,
    layout: Layout,
    stages: usize,
    ld: usize,
    factors: Vec<Vec<f64>>,
    last: Vec<f64>,
    last_ld: usize,
    local: Vec<f64>,
}

impl Chain {
    /// Creates the memory for a chain.
    pub fn new(arch: Arch, layout: Layout, stages: usize) -> Self {
        let ld = padded(layout.stage);
        let last_ld = padded(layout.boundary);
        Self {
            arch,
            layout,
            stages,
            ld,
            factors: vec![vec![0.0; ld * layout.stage]; stages],
            last: vec![0.0; last_ld * layout.boundary],
            last_ld,
            local: vec![0.0; layout.stage],
        }
    }

    /// Factorises `A + diag(diagonal)` with the rows and columns of fixed unknowns replaced by the identity.
    ///
    /// # Errors
    /// The first stage whose matrix is not positive definite.
    pub fn factorise<'a>(
        &mut self,
        matrix: impl Fn(usize) -> &'a [f64],
        diagonal: &[f64],
        fixed: &[bool],
    ) -> Result<(), usize> {
        let Self { layout, ld, stages, .. } = *self;
        let (inner, boundary, size) = (layout.inner, layout.boundary, layout.stage);
        let pivots = inner + boundary;
        for k in 0..stages {
            let a = &mut self.factors[k];
            a.copy_from_slice(matrix(k));
            let at = layout.boundary_at(stages, k);
            let index = |i: usize| if i < inner { layout.inner_at(k) + i } else { at + i - inner };
            let last = k + 1 == stages;
            for i in 0..size {
                let own = i < pivots || last;
                if own {
                    a[i * ld + i] += diagonal[index(i)];
                }
                if fixed[index(i)] {
                    for j in 0..i {
                        a[j * ld + i] = 0.0;
                    }
                    a[i * ld + i..i * ld + size].fill(0.0);
                    a[i * ld + i] = if own { 1.0 } else { 0.0 };
                }
            }
            if k > 0 {
                let (before, after) = self.factors.split_at_mut(k);
                let rest = &before[k - 1];
                for j in 0..boundary {
                    let from = (pivots + j) * ld + pivots;
                    let to = (inner + j) * ld + inner;
                    for i in j..boundary {
                        after[0][to + i] += rest[from + i];
                    }
                }
            }
            partial_cholesky(self.arch, &mut self.factors[k], ld, size, pivots).map_err(|_| k)?;
        }
        let rest = &self.factors[stages - 1];
        for j in 0..boundary {
            for i in j..boundary {
                self.last[j * self.last_ld + i] = rest[(pivots + j) * ld + pivots + i];
            }
        }
        partial_cholesky(self.arch, &mut self.last, self.last_ld, boundary, boundary).map_err(|_| stages)
    }

    /// Solves in place.
    pub fn solve(&mut self, x: &mut [f64]) {
        let Self { layout, ld, stages, .. } = *self;
        let (inner, boundary, size) = (layout.inner, layout.boundary, layout.stage);
        let pivots = inner + boundary;
        for k in 0..stages {
            layout.gather(stages, k, x, &mut self.local);
            forward(&self.factors[k], ld, size, pivots, &mut self.local);
            put(&layout, stages, k, &self.local, x);
        }
        let at = layout.boundary_at(stages, stages);
        let end = &mut x[at..at + boundary];
        forward(&self.last, self.last_ld, boundary, boundary, end);
        backward(&self.last, self.last_ld, boundary, boundary, end);
        for k in (0..stages).rev() {
            layout.gather(stages, k, x, &mut self.local);
            backward(&self.factors[k], ld, size, pivots, &mut self.local);
            put(&layout, stages, k, &self.local, x);
        }
    }
}

fn put(layout: &Layout, stages: usize, k: usize, z: &[f64], plan: &mut [f64]) {
    let (inner, ends) = z.split_at(layout.inner);
    plan[layout.inner_at(k)..layout.inner_at(k + 1)].copy_from_slice(inner);
    let at = layout.boundary_at(stages, k);
    plan[at..at + 2 * layout.boundary].copy_from_slice(ends);
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    #[test]
    fn solves_what_a_dense_cholesky_solves() {
        let layout = Layout::new(3, 2, 1, 4, 0);
        let (stages, ld, size) = (4, padded(layout.stage), layout.plan(4));
        let mut state = 7u64;
        let mut next = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let mut dense = DMatrix::<f64>::zeros(size, size);
        let mut matrices = Vec::new();
        for k in 0..stages {
            let root = DMatrix::from_fn(layout.stage, layout.stage, |_, _| next());
            let block = &root * root.transpose();
            let index = |i: usize| {
                if i < layout.inner {
                    layout.inner_at(k) + i
                } else {
                    layout.boundary_at(stages, k) + i - layout.inner
                }
            };
            let mut a = vec![0.0; ld * layout.stage];
            for j in 0..layout.stage {
                for i in j..layout.stage {
                    a[j * ld + i] = block[(i, j)];
                }
                for i in 0..layout.stage {
                    dense[(index(i), index(j))] += block[(i, j)];
                }
            }
            matrices.push(a);
        }
        let diagonal: Vec<f64> = (0..size).map(|i| 0.1 + 0.01 * i as f64).collect();
        let mut fixed = vec![false; size];
        for i in [layout.boundary_at(stages, 0), layout.boundary_at(stages, 2) + 1, size - 1] {
            fixed[i] = true;
        }
        for i in 0..size {
            dense[(i, i)] += diagonal[i];
            if fixed[i] {
                dense.row_mut(i).fill(0.0);
                dense.column_mut(i).fill(0.0);
                dense[(i, i)] = 1.0;
            }
        }
        let right = DVector::from_fn(size, |i, _| if fixed[i] { 0.0 } else { (i as f64).sin() });
        let expected = dense.cholesky().unwrap().solve(&right);
        let mut chain = Chain::new(Arch::new(), layout, stages);
        chain.factorise(|k| matrices[k].as_slice(), &diagonal, &fixed).unwrap();
        let mut x = right.as_slice().to_vec();
        chain.solve(&mut x);
        for (got, want) in x.iter().zip(expected.iter()) {
            assert!((got - want).abs() < 1e-9 * (1.0 + want.abs()), "{got} {want}");
        }
    }
}
