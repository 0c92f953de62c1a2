//! Derivatives of what contact points add to a stage: their impulses in the DEL rows, the contact law, clearance.
//!
//! `y·Gᵀλ` and `ρ·G v` have the third derivatives of the points' positions as their Hessians: the ε-parts of
//! [`Contraction::pairs`] along `y` and along `v`.

use crate::contact_law::{Homotopy, LawRows};
use crate::points::{Contraction, gradient, position, values};
use crate::problem::{CLEARANCE_AT, Problem};
use crate::scalar::{Dual, Scalar};
use crate::stage::{
    CLEARANCE_LANE, Engine, StageValues, VELOCITY_LANE, clearance_bound, fill_small, force_of, polynomial,
};
use crate::stage_derivatives::StageDerivatives;

/// The unknowns that the rows of a contact depend on, as indices of the stage vector.
///
/// Order: its impulses, then `q^0, q^½, q^1, v_{k+1}` of its branch, then the two times.
#[derive(Clone, Debug)]
pub struct ContactSupport {
    /// Indices.
    pub columns: Vec<usize>,
    depth: usize,
    impulses: usize,
}

impl ContactSupport {
    /// The support of a contact.
    pub fn new(problem: &Problem, contact: usize) -> Self {
        let layout = &problem.layout;
        let impulses = problem.law.impulses();
        let branch = problem.model.branch(problem.contacts[contact].body);
        let mut columns: Vec<usize> = (0..impulses).map(|k| layout.contact(contact) + k).collect();
        for alpha in 0..3 {
            columns.extend(branch.iter().map(|&j| layout.node(alpha, j)));
        }
        columns.extend(branch.iter().map(|&j| layout.v(1, j)));
        columns.extend([layout.t(0), layout.t(1)]);
        Self { columns, depth: branch.len(), impulses }
    }

    /// Position in the support of branch position `at`: 0, 1, 2 for the nodes, 3 for the velocity.
    fn column(&self, block: usize, at: usize) -> usize {
        self.impulses + block * self.depth + at
    }

    fn step_end(&self) -> usize {
        self.columns.len() - 1
    }
}

impl Engine {
    /// `Gᵀλ` in the DEL rows: values, Jacobian, Hessian.
    #[inline(always)]
    pub(crate) fn contact_forces(
        &mut self,
        problem: &Problem,
        z: &[f64],
        values: &mut StageValues,
        out: &mut StageDerivatives,
    ) {
        let (layout, law, model) = (&problem.layout, &problem.law, &problem.model);
        let n = layout.n;
        let first = law.first_impulse();
        let mut done = 0;
        while done < problem.contacts.len() {
            let body = problem.contacts[done].body;
            let mut contraction = Contraction::<Dual>::NONE;
            while let Some(contact) = problem.contacts.get(done).filter(|contact| contact.body == body) {
                let x = position(&self.duals.bodies[body], &contact.point);
                let imp = layout.contact(done);
                let forces = [0, 1, 2].map(|alpha| force_of(problem, z, imp, alpha));
                let mut force = [Dual::ZERO; 3];
                for (alpha, f) in forces.iter().enumerate() {
                    for axis in 0..3 {
                        force[axis].re.0[alpha] = f[axis];
                    }
                }
                contraction.add(x, force);
                for &k in model.branch(body) {
                    let g = gradient(&self.duals.bodies[k].twist, x);
                    for alpha in 0..3 {
                        let row = alpha * n + k;
                        let at = layout.node(alpha, k);
                        let mut component = |axis: usize, unknown: usize| {
                            values.rows[row] += g[axis].re.0[alpha] * forces[alpha][axis];
                            out.panel[row * out.ld + unknown] += problem.unit_ns * g[axis].re.0[alpha];
                            out.add(unknown, at, problem.unit_ns * g[axis].eps.0[alpha]);
                        };
                        let tau = imp + law.tangential(alpha) - first;
                        component(0, tau);
                        if law.tangents == 2 {
                            component(1, tau + 1);
                        }
                        component(2, imp + law.normal(alpha) - first);
                    }
                }
                done += 1;
            }
            contraction.pairs(model, &self.duals.bodies, body, |j, k, value| {
                for alpha in 0..3 {
                    let (a, b) = (layout.node(alpha, j), layout.node(alpha, k));
                    out.panel[(alpha * n + j) * out.ld + b] += value.re.0[alpha];
                    if j != k {
                        out.panel[(alpha * n + k) * out.ld + a] += value.re.0[alpha];
                    }
                    out.add(a, b, value.eps.0[alpha]);
                }
            });
        }
    }

    /// Rows of the contact law and of clearance: values, gradients, curvature.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    pub(crate) fn contact_rows(
        &mut self,
        problem: &Problem,
        supports: &[ContactSupport],
        homotopy: Homotopy,
        z: &[f64],
        multipliers: &[f64],
        rows: &mut StageValues,
        out: &mut StageDerivatives,
    ) {
        let model = &problem.model;
        for body in 0..model.dof() {
            let mut contraction = Contraction::<Dual>::NONE;
            let mut any = false;
            for i in 0..problem.contacts.len() {
                if problem.contacts[i].body == body {
                    any = true;
                    self.contact(
                        problem,
                        &supports[i],
                        i,
                        homotopy,
                        z,
                        multipliers,
                        rows,
                        out,
                        &mut contraction,
                    );
                }
            }
            for p in 0..problem.clearance.len() {
                if problem.clearance[p].body == body {
                    any = true;
                    self.clearance_point(problem, p, homotopy, multipliers, rows, out, &mut contraction);
                }
            }
            if any {
                scatter_curvature(problem, &contraction, self, body, out);
            }
        }
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn contact(
        &mut self,
        problem: &Problem,
        support: &ContactSupport,
        i: usize,
        homotopy: Homotopy,
        z: &[f64],
        multipliers: &[f64],
        rows: &mut StageValues,
        out: &mut StageDerivatives,
        contraction: &mut Contraction<Dual>,
    ) {
        let (layout, law) = (&problem.layout, &problem.law);
        let contact = &problem.contacts[i];
        let axes: &[usize] = if law.tangents == 1 { &[0, 2] } else { &[0, 1, 2] };
        let dimension = axes.len();
        let x = position(&self.duals.bodies[contact.body], &contact.point);
        // Features (positions at the nodes, end velocity) in the support.
        let width = support.columns.len();
        let mut features = vec![0.0; 4 * dimension * width];
        let mut velocity = [0.0; 3];
        for (at, &k) in problem.model.branch(contact.body).iter().enumerate() {
            let g = gradient(&self.duals.bodies[k].twist, x);
            for (a, &axis) in axes.iter().enumerate() {
                for node in 0..3 {
                    features[(node * dimension + a) * width + support.column(node, at)] = g[axis].re.0[node];
                }
                let row = (3 * dimension + a) * width;
                features[row + support.column(2, at)] = g[axis].eps.0[VELOCITY_LANE];
                features[row + support.column(3, at)] = g[axis].re.0[2];
                velocity[a] += g[axis].re.0[2] * z[layout.v(1, k)];
            }
        }
        fill_small(problem, z, layout.contact(i), &values(&x), &velocity, &mut self.small);
        let row = problem.contact_row(i);
        let l = &multipliers[row..row + law.rows()];
        self.law.derivatives(law, &problem.terrain, homotopy, contact.radius, &self.small, l);
        rows.rows[row..row + law.rows()].copy_from_slice(&self.law.value[..law.rows()]);
        rows.products[i] = self.law.product;
        lift_rows(problem, support, &self.law, &features, &mut out.contacts[i]);
        lift_curvature(problem, support, &self.law, &features, out);
        // Curvature of the features, weighted by what the multipliers say of them.
        let mut force = [Dual::ZERO; 3];
        let mut force_velocity = [Dual::ZERO; 3];
        for (a, &axis) in axes.iter().enumerate() {
            for node in 0..3 {
                let small = law.position(node) + a;
                force[axis].re.0[node] =
                    -(0..law.rows()).map(|r| l[r] * self.law.gradient[r][small]).sum::<f64>();
            }
            let small = law.velocity() + a;
            force_velocity[axis].re.0[VELOCITY_LANE] =
                -(0..law.rows()).map(|r| l[r] * self.law.gradient[r][small]).sum::<f64>();
        }
        for axis in 0..3 {
            force[axis] += force_velocity[axis];
        }
        contraction.add(x, force);
    }

    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn clearance_point(
        &self,
        problem: &Problem,
        p: usize,
        homotopy: Homotopy,
        multipliers: &[f64],
        rows: &mut StageValues,
        out: &mut StageDerivatives,
        contraction: &mut Contraction<Dual>,
    ) {
        let n = problem.layout.n;
        let point = &problem.clearance[p];
        let x = position(&self.duals.bodies[point.body], &point.point);
        let mut force = [Dual::ZERO; 3];
        let mut slopes = [0.0; 4];
        for at in 0..CLEARANCE_AT.len() {
            let lane = CLEARANCE_LANE[at];
            let bound = clearance_bound(problem, homotopy, x[0].re.0[lane]);
            let row = problem.clearance_row(at, p);
            rows.rows[row] = x[2].re.0[lane] - point.radius - bound.value + problem.clearance_slack_m[at];
            let l = multipliers[row];
            force[0].re.0[lane] += l * bound.slope;
            force[2].re.0[lane] -= l;
            slopes[at] = bound.slope;
            out.bends[at * problem.clearance.len() + p] = l * bound.curvature;
        }
        contraction.add(x, force);
        for &k in problem.model.branch(point.body) {
            let g = gradient(&self.duals.bodies[k].twist, x);
            for at in 0..CLEARANCE_AT.len() {
                let lane = CLEARANCE_LANE[at];
                let index = (at * problem.clearance.len() + p) * n + k;
                out.clearance[index] = g[2].re.0[lane] - slopes[at] * g[0].re.0[lane];
                out.clearance_x[index] = g[0].re.0[lane];
            }
        }
    }
}

/// Gradients of a contact's rows in its support.
fn lift_rows(
    problem: &Problem,
    support: &ContactSupport,
    law_rows: &LawRows,
    features: &[f64],
    out: &mut [f64],
) {
    let law = &problem.law;
    let width = support.columns.len();
    let (feature_count, first) = (4 * law.dimension(), law.first_impulse());
    for r in 0..law.rows() {
        let row = &mut out[r * width..(r + 1) * width];
        row.fill(0.0);
        let gradient = &law_rows.gradient[r];
        for f in 0..feature_count {
            if gradient[f] != 0.0 {
                for (x, feature) in row.iter_mut().zip(&features[f * width..(f + 1) * width]) {
                    *x += gradient[f] * feature;
                }
            }
        }
        row[..law.impulses()].copy_from_slice(&gradient[first..first + law.impulses()]);
        row[support.step_end()] += gradient[law.step()];
        row[support.step_end() - 1] -= gradient[law.step()];
    }
}

/// Adds the curvature of the contact law, lifted to the stage vector.
fn lift_curvature(
    problem: &Problem,
    support: &ContactSupport,
    law_rows: &LawRows,
    features: &[f64],
    out: &mut StageDerivatives,
) {
    let law = &problem.law;
    let width = support.columns.len();
    let (feature_count, first) = (4 * law.dimension(), law.first_impulse());
    let columns = &support.columns;
    for a in 0..law.impulses() {
        for b in 0..=a {
            let value = law_rows.curvature[first + a][first + b];
            if value != 0.0 {
                out.add(columns[a], columns[b], value);
            }
        }
        for f in 0..feature_count {
            let value = law_rows.curvature[first + a][f];
            if value != 0.0 {
                for c in law.impulses()..width {
                    let feature = features[f * width + c];
                    if feature != 0.0 {
                        out.add(columns[a], columns[c], value * feature);
                    }
                }
            }
        }
    }
    for f in 0..feature_count {
        for g in 0..feature_count {
            let value = law_rows.curvature[f][g];
            if value == 0.0 {
                continue;
            }
            for c in law.impulses()..width {
                let left = value * features[f * width + c];
                if left == 0.0 {
                    continue;
                }
                for d in law.impulses()..=c {
                    out.add(columns[c], columns[d], left * features[g * width + d]);
                }
            }
        }
    }
}

/// Adds the curvature of the points of a body.
#[inline(always)]
fn scatter_curvature(
    problem: &Problem,
    contraction: &Contraction<Dual>,
    engine: &Engine,
    body: usize,
    out: &mut StageDerivatives,
) {
    let layout = &problem.layout;
    let quarters = [(6, polynomial(0.25)), (7, polynomial(0.75))];
    let between = !problem.clearance.is_empty();
    contraction.pairs(&problem.model, &engine.duals.bodies, body, |j, k, value| {
        for alpha in 0..3 {
            out.add(layout.node(alpha, j), layout.node(alpha, k), value.re.0[alpha]);
        }
        let velocity = value.re.0[VELOCITY_LANE];
        out.add(layout.q(1, j), layout.v(1, k), velocity);
        if j != k {
            out.add(layout.q(1, k), layout.v(1, j), velocity);
        }
        out.add(layout.q(1, j), layout.q(1, k), value.eps.0[VELOCITY_LANE]);
        if between {
            for (lane, weights) in quarters {
                for alpha in 0..3 {
                    for gamma in 0..3 {
                        if j != k || alpha >= gamma {
                            let part = weights[alpha] * weights[gamma] * value.re.0[lane];
                            out.add(layout.node(alpha, j), layout.node(gamma, k), part);
                        }
                    }
                }
            }
        }
    });
}
