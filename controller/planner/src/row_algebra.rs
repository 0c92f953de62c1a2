//! Algebra with the rows of a stage: `J d`, `Jᵀ w`, `Jᵀ D J`.

use crate::contact_derivatives::ContactSupport;
use crate::dense::rank_update;
use crate::problem::{CLEARANCE_AT, Problem};
use crate::stage::polynomial;
use crate::stage_derivatives::StageDerivatives;

impl StageDerivatives {
    /// Adds the clearance rows' curvature and `D` terms: `Σ_p D g gᵀ + l h'' x xᵀ` at every fraction, spread to the nodes.
    fn add_clearance(&mut self, problem: &Problem, d: &[f64], scratch: &mut [f64]) {
        let layout = &problem.layout;
        let (n, points) = (layout.n, problem.clearance.len());
        if points == 0 {
            return;
        }
        for (at, &c) in CLEARANCE_AT.iter().enumerate() {
            scratch[..n * n].fill(0.0);
            for p in 0..points {
                let index = at * points + p;
                let weight = d[problem.clearance_row(at, p)];
                let bend = self.bends[index];
                let (g, x) = (&self.clearance[index * n..][..n], &self.clearance_x[index * n..][..n]);
                for &j in problem.model.branch(problem.clearance[p].body) {
                    let (a, b) = (weight * g[j], bend * x[j]);
                    for k in 0..=j {
                        scratch[j * n + k] += a * g[k] + b * x[k];
                    }
                }
            }
            let weights = polynomial(c);
            for j in 0..n {
                for k in 0..=j {
                    let value = scratch[j * n + k];
                    if value == 0.0 {
                        continue;
                    }
                    for alpha in 0..3 {
                        for gamma in 0..3 {
                            let part = weights[alpha] * weights[gamma];
                            if part != 0.0 && (j != k || alpha >= gamma) {
                                self.add(layout.node(alpha, j), layout.node(gamma, k), part * value);
                            }
                        }
                    }
                }
            }
        }
    }

    /// `J d` of all rows.
    pub fn product(&self, problem: &Problem, supports: &[ContactSupport], d: &[f64], out: &mut [f64]) {
        let layout = &problem.layout;
        let n = layout.n;
        for row in 0..problem.equalities() {
            let column = &self.panel[row * self.ld..row * self.ld + layout.stage];
            out[row] = column.iter().zip(d).map(|(a, b)| a * b).sum();
        }
        for (i, support) in supports.iter().enumerate() {
            let width = support.columns.len();
            for r in 0..problem.law.rows() {
                let row = &self.contacts[i][r * width..(r + 1) * width];
                out[problem.contact_row(i) + r] =
                    row.iter().zip(&support.columns).map(|(a, &c)| a * d[c]).sum();
            }
        }
        let points = problem.clearance.len();
        for (at, &c) in CLEARANCE_AT.iter().enumerate() {
            let w = polynomial(c);
            for p in 0..points {
                let g = &self.clearance[(at * points + p) * n..][..n];
                let branch = problem.model.branch(problem.clearance[p].body);
                out[problem.clearance_row(at, p)] = branch
                    .iter()
                    .map(|&j| g[j] * (0..3).map(|alpha| w[alpha] * d[layout.node(alpha, j)]).sum::<f64>())
                    .sum();
            }
        }
        let step = (d[layout.t(1)] - d[layout.t(0)]) / problem.mean_stage_s();
        out[problem.step_row()] = step;
        out[problem.step_row() + 1] = -step;
        for (row, out) in problem.rows.iter().zip(&mut out[problem.linear_row()..]) {
            *out = row.form.iter().map(|&(index, factor)| factor * d[index]).sum();
        }
    }

    /// Adds `Jᵀ w` of all rows.
    pub fn transposed(&self, problem: &Problem, supports: &[ContactSupport], w: &[f64], out: &mut [f64]) {
        let layout = &problem.layout;
        let n = layout.n;
        for row in 0..problem.equalities() {
            let column = &self.panel[row * self.ld..row * self.ld + layout.stage];
            for (x, a) in out.iter_mut().zip(column) {
                *x += a * w[row];
            }
        }
        for (i, support) in supports.iter().enumerate() {
            let width = support.columns.len();
            for r in 0..problem.law.rows() {
                let weight = w[problem.contact_row(i) + r];
                let row = &self.contacts[i][r * width..(r + 1) * width];
                for (a, &c) in row.iter().zip(&support.columns) {
                    out[c] += a * weight;
                }
            }
        }
        let points = problem.clearance.len();
        for (at, &c) in CLEARANCE_AT.iter().enumerate() {
            let parts = polynomial(c);
            for p in 0..points {
                let weight = w[problem.clearance_row(at, p)];
                let g = &self.clearance[(at * points + p) * n..][..n];
                for &j in problem.model.branch(problem.clearance[p].body) {
                    for alpha in 0..3 {
                        out[layout.node(alpha, j)] += parts[alpha] * weight * g[j];
                    }
                }
            }
        }
        let step = (w[problem.step_row()] - w[problem.step_row() + 1]) / problem.mean_stage_s();
        out[layout.t(1)] += step;
        out[layout.t(0)] -= step;
        for (row, &weight) in problem.rows.iter().zip(&w[problem.linear_row()..]) {
            for &(index, factor) in &row.form {
                out[index] += factor * weight;
            }
        }
    }
}

impl StageDerivatives {
    /// Adds `Jᵀ D J` of all rows to the Hessian; `d` holds the weights, the same for all equations.
    pub(crate) fn add_penalty(
        &mut self,
        problem: &Problem,
        supports: &[ContactSupport],
        arch: pulp::Arch,
        d: &[f64],
        scratch: &mut [f64],
    ) {
        let layout = &problem.layout;
        let size = layout.stage;
        rank_update(arch, &mut self.hessian, self.ld, size, &self.panel, problem.equalities(), d[0]);
        for (i, support) in supports.iter().enumerate() {
            let width = support.columns.len();
            let weights = &d[problem.contact_row(i)..][..problem.law.rows()];
            let block = &mut scratch[..width * width];
            block.fill(0.0);
            for (row, &weight) in self.contacts[i].chunks_exact(width).zip(weights) {
                for c in 0..width {
                    let factor = weight * row[c];
                    if factor != 0.0 {
                        for (x, y) in block[c * width..c * width + c + 1].iter_mut().zip(row) {
                            *x += factor * y;
                        }
                    }
                }
            }
            for c in 0..width {
                for e in 0..=c {
                    self.add(support.columns[c], support.columns[e], scratch[c * width + e]);
                }
            }
        }
        self.add_clearance(problem, d, scratch);
        let mean = problem.mean_stage_s();
        let step = (d[problem.step_row()] + d[problem.step_row() + 1]) / (mean * mean);
        let (t0, t1) = (layout.t(0), layout.t(1));
        self.add(t0, t0, step);
        self.add(t1, t1, step);
        self.add(t0, t1, -step);
        for (row, &weight) in problem.rows.iter().zip(&d[problem.linear_row()..]) {
            for (a, &(i, factor)) in row.form.iter().enumerate() {
                for &(k, other) in &row.form[..=a] {
                    self.add(i, k, weight * factor * other);
                }
            }
        }
    }
}
