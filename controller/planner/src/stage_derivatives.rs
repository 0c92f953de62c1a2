//! First derivatives of a stage's rows and the Hessian with given curvature multipliers.
//!
//! ```text
//! H = ∇²( J - Σ_r l_r c_r )
//! y·DEL, node β:   f = Δt η·L_q + ν·L_q̇,  η = y_β,  ν = Σ_α b^{βα} y_α,  z = Σ_γ b^{βγ} q^γ = Δt q̇;   X = ε-part of ∇²L along (η, ν/Δt)
//! f_qq = Δt X_qq   f_qz = X_qq̇   f_zz = X_q̇q̇/Δt      f_tq = L_qq η - X_qq̇ q̇      f_tz = -(X_q̇q̇ q̇ + L_q̇q̇ ν/Δt)/Δt
//! f_tt = ( q̇ᵀ X_q̇q̇ q̇ + 2 (ν/Δt)ᵀ L_q̇q̇ q̇ )/Δt
//! ```
//!
//! The same combination of `L_qq, L_qq̇, L_q̇q̇` (without the ε) gives the blocks of the Jacobian of DEL.

use crate::contact_derivatives::ContactSupport;
use crate::contact_law::Homotopy;
use crate::dense::padded;
use crate::node::Pair;
use crate::points::{Contraction, gradient, position};
use crate::problem::{Problem, Square};
use crate::scalar::{Dual, Lanes, Scalar};
use crate::stage::{DERIVATIVE, Engine, StageValues, VELOCITY_LANE, WEIGHTS, del_rows, lanes_of, plain_rows};

/// Derivatives of one stage.
#[derive(Clone, Debug)]
pub struct StageDerivatives {
    /// Leading dimension of the panel and the Hessian.
    pub ld: usize,
    /// DEL rows, one column of length `ld` each.
    pub panel: Vec<f64>,
    /// Rows of every contact in its own unknowns ([`ContactSupport`]), `rows x support` each.
    pub contacts: Vec<Vec<f64>>,
    /// Clearance rows at [`crate::problem::CLEARANCE_AT`] in `q(c)`: `4 x points x n`.
    pub clearance: Vec<f64>,
    /// `∂x/∂q(c)` of the same points.
    pub(crate) clearance_x: Vec<f64>,
    /// Curvature of the bound at the same points, weighted by its multiplier.
    pub(crate) bends: Vec<f64>,
    /// `H`, lower triangle, column-major.
    pub hessian: Vec<f64>,
    /// Gradient of the cost.
    pub cost_gradient: Vec<f64>,
}

impl StageDerivatives {
    /// Creates the memory of a stage.
    pub fn new(problem: &Problem, supports: &[ContactSupport]) -> Self {
        let (n, size) = (problem.layout.n, problem.layout.stage);
        let ld = padded(size);
        let points = 4 * problem.clearance.len();
        Self {
            ld,
            panel: vec![0.0; 3 * n * ld],
            contacts: supports.iter().map(|s| vec![0.0; problem.law.rows() * s.columns.len()]).collect(),
            clearance: vec![0.0; points * n],
            clearance_x: vec![0.0; points * n],
            bends: vec![0.0; points],
            hessian: vec![0.0; ld * size],
            cost_gradient: vec![0.0; size],
        }
    }

    #[inline(always)]
    pub(crate) fn add(&mut self, a: usize, b: usize, value: f64) {
        let (column, row) = if a < b { (a, b) } else { (b, a) };
        self.hessian[column * self.ld + row] += value;
    }
}

impl Engine {
    /// Values, first derivatives and the Hessian of a stage. `multipliers` are the curvature multipliers of all rows.
    #[allow(clippy::too_many_arguments)]
    pub fn derivatives(
        &mut self,
        problem: &Problem,
        supports: &[ContactSupport],
        homotopy: Homotopy,
        z: &[f64],
        multipliers: &[f64],
        last: bool,
        values: &mut StageValues,
        out: &mut StageDerivatives,
    ) {
        self.load_duals(problem, z, multipliers);
        let arch = self.arch;
        arch.dispatch(|| self.duals.evaluate(&problem.model, &self.q_dual, &self.rate_dual, true));
        out.panel.fill(0.0);
        out.hessian.fill(0.0);
        arch.dispatch(|| self.inertial(problem, z, values, out));
        arch.dispatch(|| self.contact_forces(problem, z, values, out));
        arch.dispatch(|| self.contact_rows(problem, supports, homotopy, z, multipliers, values, out));
        let n = problem.layout.n;
        for alpha in 0..3 {
            for j in 0..n {
                let scale = problem.row_scale[j];
                values.rows[alpha * n + j] *= scale;
                let row = alpha * n + j;
                for x in &mut out.panel[row * out.ld..(row + 1) * out.ld] {
                    *x *= scale;
                }
            }
        }
        plain_rows(problem, z, &mut values.rows);
        values.cost = add_cost(problem, z, last, out);
        if last {
            values.cost += self.reach(problem, out);
        }
    }

    /// The cost of a point away from where it should be at the end.
    fn reach(&self, problem: &Problem, out: &mut StageDerivatives) -> f64 {
        let Some(reach) = &problem.reach else { return 0.0 };
        let layout = &problem.layout;
        let body = reach.point.body;
        let x = position(&self.duals.bodies[body], &reach.point.point);
        let away = [0, 1, 2].map(|axis| x[axis].re.0[2] - reach.target[axis]);
        let mut force = [Dual::ZERO; 3];
        for axis in 0..3 {
            force[axis].re.0[2] = 2.0 * reach.weight * away[axis];
        }
        let branch = problem.model.branch(body);
        let gradients: Vec<[f64; 3]> = branch
            .iter()
            .map(|&k| gradient(&self.duals.bodies[k].twist, x).map(|component| component.re.0[2]))
            .collect();
        for (a, &j) in branch.iter().enumerate() {
            let dot = |v: &[f64; 3]| (0..3).map(|axis| gradients[a][axis] * v[axis]).sum::<f64>();
            out.cost_gradient[layout.q(1, j)] += 2.0 * reach.weight * dot(&away);
            for (b, &k) in branch.iter().enumerate().take(a + 1) {
                out.add(layout.q(1, j), layout.q(1, k), 2.0 * reach.weight * dot(&gradients[b]));
            }
        }
        let mut contraction = Contraction::<Dual>::NONE;
        contraction.add(x, force);
        contraction.pairs(&problem.model, &self.duals.bodies, body, |j, k, value| {
            out.add(layout.q(1, j), layout.q(1, k), value.re.0[2]);
        });
        reach.weight * away.iter().map(|x| x * x).sum::<f64>()
    }

    /// Lanes with the directions of the table in [`crate::stage`]; the weights of the DEL rows are `-l` times their scale.
    fn load_duals(&mut self, problem: &Problem, z: &[f64], multipliers: &[f64]) {
        let layout = &problem.layout;
        let n = layout.n;
        let dt = z[layout.t(1)] - z[layout.t(0)];
        for j in 0..n {
            let (q, rate) = lanes_of(problem, z, dt, j);
            let y = [0, 1, 2].map(|alpha| -multipliers[alpha * n + j] * problem.row_scale[j]);
            let (mut eta, mut nu) = (Lanes::ZERO, Lanes::ZERO);
            for beta in 0..3 {
                eta.0[beta] = y[beta];
                let total: f64 = (0..3).map(|alpha| DERIVATIVE[beta][alpha] * y[alpha]).sum();
                nu.0[beta] = total / dt;
            }
            nu.0[3] = y[0];
            nu.0[4] = -y[2];
            eta.0[VELOCITY_LANE] = z[layout.v(1, j)];
            self.q_dual[j] = Dual { re: q, eps: eta };
            self.rate_dual[j] = Dual { re: rate, eps: nu };
        }
    }

    /// Rows, Jacobian and Hessian of the DEL rows without contacts.
    #[inline(always)]
    fn inertial(
        &mut self,
        problem: &Problem,
        z: &[f64],
        values: &mut StageValues,
        out: &mut StageDerivatives,
    ) {
        let (layout, model) = (&problem.layout, &problem.model);
        let n = layout.n;
        let dt = z[layout.t(1)] - z[layout.t(0)];
        let mut lanes = [vec![], vec![], vec![], vec![]];
        for (list, source) in lanes.iter_mut().zip([
            &self.duals.by_position,
            &self.duals.by_rate,
            &self.q_dual,
            &self.rate_dual,
        ]) {
            list.extend(source.iter().map(|x| x.re));
        }
        values.rows[..3 * n].fill(0.0);
        del_rows(problem, z, &lanes[0], &lanes[1], &lanes[2], &lanes[3], &mut values.rows[..3 * n]);

        // Products of the second derivatives with rates and directions, for the columns of the times.
        let mut products = vec![TimeProducts::default(); n];
        for i in 0..n {
            let pairs = self.duals.pairs(i);
            for (&j, pair) in model.branch(i).iter().zip(pairs) {
                let (di, dj) = (Direction::of(self, i), Direction::of(self, j));
                products[i].add(pair, pair.other_rate, &dj);
                if i != j {
                    products[j].add(pair, pair.own_rate, &di);
                }
                let spring = if i == j { model.stiffness[i] } else { 0.0 };
                let damper = if i == j { model.damping[i] } else { 0.0 };
                let blocks = simpson_blocks(
                    dt,
                    |p: &Pair<Dual>| [p.positions.re, p.other_rate.re, p.own_rate.re, p.rates.re],
                    pair,
                );
                for alpha in 0..3 {
                    for gamma in 0..3 {
                        let mut value = blocks[alpha][gamma];
                        if i == j {
                            value -= WEIGHTS[alpha] * damper * DERIVATIVE[alpha][gamma];
                            if alpha == gamma {
                                value -= WEIGHTS[alpha] * dt * spring;
                            }
                        }
                        out.panel[(alpha * n + i) * out.ld + layout.node(gamma, j)] += value;
                        if i != j {
                            out.panel[(gamma * n + j) * out.ld + layout.node(alpha, i)] += value;
                        }
                    }
                }
                let blocks = simpson_blocks(
                    dt,
                    |p: &Pair<Dual>| [p.positions.eps, p.other_rate.eps, p.own_rate.eps, p.rates.eps],
                    pair,
                );
                for alpha in 0..3 {
                    for gamma in 0..3 {
                        if i != j || alpha >= gamma {
                            out.add(layout.node(alpha, i), layout.node(gamma, j), blocks[alpha][gamma]);
                        }
                    }
                }
                momenta(problem, i, j, pair, out);
            }
        }
        self.time_columns(problem, z, &products, out);
    }

    /// Columns of the two times and of the inputs.
    #[inline(always)]
    fn time_columns(
        &self,
        problem: &Problem,
        z: &[f64],
        products: &[TimeProducts],
        out: &mut StageDerivatives,
    ) {
        let (layout, model) = (&problem.layout, &problem.model);
        let n = layout.n;
        let dt = z[layout.t(1)] - z[layout.t(0)];
        let (t0, t1) = (layout.t(0), layout.t(1));
        let mut input_of = vec![None; n];
        for (input, &j) in problem.robot.actuated.iter().enumerate() {
            input_of[j] = Some(layout.input(input));
        }
        if layout.wrench > 0 {
            for alpha in 0..3 {
                for j in 0..6 {
                    out.panel[(alpha * n + j) * out.ld + layout.sole(alpha) + j] += problem.unit_ns;
                }
            }
        }
        let mut time_time = 0.0;
        for j in 0..n {
            let p = &products[j];
            let (q, rate) = (&self.q_dual[j], &self.rate_dual[j]);
            let joint = |beta: usize| {
                let u = input_of[j].map_or(0.0, |at| z[at]);
                u - model.stiffness[j] * (q.re.0[beta] - model.rest[j])
            };
            for alpha in 0..3 {
                let w = WEIGHTS[alpha];
                // The damper's impulse does not depend on Δt: w Δt d q̇ = w d Σ b q.
                let mut by_step =
                    w * (self.duals.by_position[j].re.0[alpha] + joint(alpha) - p.config_rate.0[alpha]);
                for beta in 0..3 {
                    by_step -= WEIGHTS[beta] * DERIVATIVE[beta][alpha] * p.mass_rate.0[beta] / dt;
                }
                let row = (alpha * n + j) * out.ld;
                out.panel[row + t1] += by_step;
                out.panel[row + t0] -= by_step;
                if let Some(at) = input_of[j] {
                    out.panel[row + at] += w * dt;
                }
            }
            for beta in 0..3 {
                let w = WEIGHTS[beta];
                let eta = q.eps.0[beta];
                let direct = p.stiffness_eta.0[beta] - p.config_rate_eps.0[beta] - model.stiffness[j] * eta;
                let through_rate = -(p.mass_rate_eps.0[beta] + p.mass_nu.0[beta]) / dt;
                for gamma in 0..3 {
                    let own = if gamma == beta { direct } else { 0.0 };
                    let value = w * (own + DERIVATIVE[beta][gamma] * through_rate);
                    out.add(layout.node(gamma, j), t1, value);
                    out.add(layout.node(gamma, j), t0, -value);
                }
                if let Some(at) = input_of[j] {
                    out.add(at, t1, w * eta);
                    out.add(at, t0, -w * eta);
                }
                time_time += w / dt
                    * (rate.re.0[beta] * p.mass_rate_eps.0[beta]
                        + 2.0 * rate.eps.0[beta] * p.mass_rate.0[beta]);
            }
        }
        out.add(t1, t1, time_time);
        out.add(t0, t0, time_time);
        out.add(t0, t1, -time_time);
    }
}

/// What multiplies the second derivatives of a coordinate.
#[derive(Clone, Copy)]
struct Direction {
    rate: Lanes,
    eta: Lanes,
    nu: Lanes,
}

impl Direction {
    #[inline(always)]
    fn of(engine: &Engine, j: usize) -> Self {
        let (q, rate) = (&engine.q_dual[j], &engine.rate_dual[j]);
        Self { rate: rate.re, eta: q.eps, nu: rate.eps }
    }
}

/// Second derivatives of `L` and of its directional derivative times rates and directions.
#[derive(Clone, Copy)]
struct TimeProducts {
    mass_rate: Lanes,
    config_rate: Lanes,
    stiffness_eta: Lanes,
    mass_nu: Lanes,
    mass_rate_eps: Lanes,
    config_rate_eps: Lanes,
}

impl Default for TimeProducts {
    fn default() -> Self {
        Self {
            mass_rate: Lanes::ZERO,
            config_rate: Lanes::ZERO,
            stiffness_eta: Lanes::ZERO,
            mass_nu: Lanes::ZERO,
            mass_rate_eps: Lanes::ZERO,
            config_rate_eps: Lanes::ZERO,
        }
    }
}

impl TimeProducts {
    /// Adds row `i` times entry `j`; `mixed` is `∂²L/∂q_i∂q̇_j`.
    #[inline(always)]
    fn add(&mut self, pair: &Pair<Dual>, mixed: Dual, d: &Direction) {
        self.mass_rate += pair.rates.re * d.rate;
        self.config_rate += mixed.re * d.rate;
        self.stiffness_eta += pair.positions.re * d.eta;
        self.mass_nu += pair.rates.re * d.nu;
        self.mass_rate_eps += pair.rates.eps * d.rate;
        self.config_rate_eps += mixed.eps * d.rate;
    }
}

/// `∂R^α_i/∂q^γ_j` of the conservative part, from `(L_qq, L_{q_i q̇_j}, L_{q̇_i q_j}, L_q̇q̇)` of one pair.
#[inline(always)]
fn simpson_blocks(dt: f64, parts: impl Fn(&Pair<Dual>) -> [Lanes; 4], pair: &Pair<Dual>) -> [[f64; 3]; 3] {
    let [qq, qv, vq, vv] = parts(pair);
    let mut out = [[0.0; 3]; 3];
    for alpha in 0..3 {
        for gamma in 0..3 {
            let mut value = WEIGHTS[alpha] * DERIVATIVE[alpha][gamma] * qv.0[alpha]
                + WEIGHTS[gamma] * DERIVATIVE[gamma][alpha] * vq.0[gamma];
            if alpha == gamma {
                value += WEIGHTS[alpha] * dt * qq.0[alpha];
            }
            for beta in 0..3 {
                value += WEIGHTS[beta] * DERIVATIVE[beta][alpha] * DERIVATIVE[beta][gamma] * vv.0[beta] / dt;
            }
            out[alpha][gamma] = value;
        }
    }
    out
}

/// `M(q_k) v_k` in row 0 and `-M(q_{k+1}) v_{k+1}` in row 1.
#[inline(always)]
fn momenta(problem: &Problem, i: usize, j: usize, pair: &Pair<Dual>, out: &mut StageDerivatives) {
    let layout = &problem.layout;
    let n = layout.n;
    for (end, lane, node, sign) in [(0, 3, 0, 1.0), (1, 4, 2, -1.0)] {
        // L_q̇iqj and L_q̇jqi; the mass matrix.
        let (own, other) = (sign * pair.own_rate.re.0[lane], sign * pair.other_rate.re.0[lane]);
        let mass = sign * pair.rates.re.0[lane];
        let (row_i, row_j) = ((node * n + i) * out.ld, (node * n + j) * out.ld);
        out.panel[row_i + layout.q(end, j)] += own;
        out.panel[row_i + layout.v(end, j)] += mass;
        if i != j {
            out.panel[row_j + layout.q(end, i)] += other;
            out.panel[row_j + layout.v(end, i)] += mass;
        }
        let positions = pair.positions.eps.0[lane];
        out.add(layout.q(end, i), layout.q(end, j), positions);
        // The ε-parts of ∂²/∂q_j∂q̇_i and ∂²/∂q_i∂q̇_j; the direction carries the sign.
        out.add(layout.q(end, j), layout.v(end, i), pair.own_rate.eps.0[lane]);
        if i != j {
            out.add(layout.q(end, i), layout.v(end, j), pair.other_rate.eps.0[lane]);
        }
    }
}

/// Adds the cost's gradient and Hessian; returns its value.
fn add_cost(problem: &Problem, z: &[f64], last: bool, out: &mut StageDerivatives) -> f64 {
    let layout = &problem.layout;
    let (t0, t1) = (layout.t(0), layout.t(1));
    let dt = z[t1] - z[t0];
    out.cost_gradient.fill(0.0);
    let terminal: &[Square] = if last { &problem.terminal } else { &[] };
    let mut total = 0.0;
    for square in problem.cost.iter().chain(terminal) {
        let distance = square.form.iter().map(|&(i, factor)| factor * z[i]).sum::<f64>() - square.target;
        let length = if square.per_time { dt } else { 1.0 };
        let weight = square.weight * length;
        total += weight * distance * distance;
        for (a, &(i, factor)) in square.form.iter().enumerate() {
            out.cost_gradient[i] += 2.0 * weight * distance * factor;
            for &(k, other) in &square.form[..=a] {
                out.add(i, k, 2.0 * weight * factor * other);
            }
            if square.per_time {
                let cross = 2.0 * square.weight * distance * factor;
                out.add(i, t1, cross);
                out.add(i, t0, -cross);
            }
        }
        if square.per_time {
            out.cost_gradient[t1] += square.weight * distance * distance;
            out.cost_gradient[t0] -= square.weight * distance * distance;
        }
    }
    total
}
