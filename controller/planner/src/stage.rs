//! One stage of formulation C: rows, first derivatives, and the Hessian with given curvature multipliers.
//!
//! ```text
//! M(q_k) v_k + R^0 + Σ_i G_i(q^0)ᵀ λ_i^0 = 0     R^½ + Σ_i G_i(q^½)ᵀ λ_i^½ = 0     R^1 + Σ_i G_i(q^1)ᵀ λ_i^1 - M(q_{k+1}) v_{k+1} = 0
//! R^α = w_α Δt (L_q + Q)^α + Σ_β w_β b^{βα} L_q̇^β        q̇^β = (1/Δt) Σ_γ b^{βγ} q^γ        λ^α = S (τ^α, n^α)
//! ```
//!
//! All configurations of a stage are lanes of one pass of the node recursions:
//!
//! | lane | position | rate | direction of the dual numbers | what for |
//! |---|---|---|---|---|
//! | 0, 1, 2 | `q^0, q^½, q^1` | `q̇^α` | `y_α`, `Σ_β b^{αβ}.. y / Δt` | DEL rows, contacts, their Hessian |
//! | 3, 4 | `q_k`, `q_{k+1}` | `v_k`, `v_{k+1}` | 0, `y_0` and `-y_1` | momenta `M v` |
//! | 5 | `q_{k+1}` | - | `v_{k+1}`, 0 | contact velocities `G v` |
//! | 6, 7 | `q(¼)`, `q(¾)` | - | - | clearance between nodes |

use pulp::Arch;

use crate::contact_law::{Homotopy, LawRows, SMALL};
use crate::node::NodeWork;
use crate::points::{gradient, position};
use crate::problem::{CLEARANCE_AT, Problem};
use crate::scalar::{Dual, LANES, Lanes, Scalar};

/// Simpson's weights.
pub const WEIGHTS: [f64; 3] = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0];
/// `b^{βα}` of Simpson's rule.
pub const DERIVATIVE: [[f64; 3]; 3] = [[-3.0, 4.0, -1.0], [-1.0, 0.0, 1.0], [1.0, -4.0, 3.0]];
/// Lane that holds the configuration of each of [`CLEARANCE_AT`].
pub const CLEARANCE_LANE: [usize; 4] = [6, 1, 7, 2];
/// Lane whose dual direction is the end velocity.
pub const VELOCITY_LANE: usize = 5;

/// Weights of `q^0, q^½, q^1` in the polynomial at the fraction `c` of a stage.
pub fn polynomial(c: f64) -> [f64; 3] {
    [(1.0 - c) * (1.0 - 2.0 * c), 4.0 * c * (1.0 - c), c * (2.0 * c - 1.0)]
}

/// Values of a stage.
#[derive(Clone, Debug)]
pub struct StageValues {
    /// All rows, in the order of [`Problem::row_count`].
    pub rows: Vec<f64>,
    /// `P` of every contact, S m.
    pub products: Vec<f64>,
    /// Cost of the stage.
    pub cost: f64,
}

impl StageValues {
    /// Creates the memory of a stage.
    pub fn new(problem: &Problem) -> Self {
        Self { rows: vec![0.0; problem.row_count()], products: vec![0.0; problem.contacts.len()], cost: 0.0 }
    }
}

/// Workspace that evaluates stages, one after the other.
#[derive(Clone, Debug)]
pub struct Engine {
    pub(crate) arch: Arch,
    nodes: NodeWork<Lanes>,
    pub(crate) duals: NodeWork<Dual>,
    q: Vec<Lanes>,
    rate: Vec<Lanes>,
    pub(crate) q_dual: Vec<Dual>,
    pub(crate) rate_dual: Vec<Dual>,
    pub(crate) law: LawRows,
    pub(crate) small: [f64; SMALL],
    del: Vec<f64>,
}

impl Engine {
    /// Creates the workspace of a problem.
    pub fn new(problem: &Problem) -> Self {
        let n = problem.layout.n;
        Self {
            arch: Arch::new(),
            nodes: NodeWork::new(&problem.model),
            duals: NodeWork::new(&problem.model),
            q: vec![Lanes::ZERO; n],
            rate: vec![Lanes::ZERO; n],
            q_dual: vec![Dual::ZERO; n],
            rate_dual: vec![Dual::ZERO; n],
            law: LawRows::default(),
            small: [0.0; SMALL],
            del: vec![0.0; 3 * n],
        }
    }

    /// All rows and the cost of a stage. No allocation.
    pub fn values(
        &mut self,
        problem: &Problem,
        homotopy: Homotopy,
        z: &[f64],
        last: bool,
        out: &mut StageValues,
    ) {
        self.load(problem, z);
        let Self { nodes, q, rate, .. } = self;
        self.arch.dispatch(|| nodes.evaluate(&problem.model, q, rate, false));
        self.del.fill(0.0);
        del_rows(
            problem,
            z,
            &self.nodes.by_position,
            &self.nodes.by_rate,
            &self.q,
            &self.rate,
            &mut self.del,
        );
        self.contacts(problem, homotopy, z, out);
        let n = problem.layout.n;
        for alpha in 0..3 {
            for j in 0..n {
                out.rows[alpha * n + j] = self.del[alpha * n + j] * problem.row_scale[j];
            }
        }
        self.clearance(problem, homotopy, out);
        plain_rows(problem, z, &mut out.rows);
        out.cost = cost(problem, z, last);
        if let Some(reach) = problem.reach.as_ref().filter(|_| last) {
            let x = position(&self.nodes.bodies[reach.point.body], &reach.point.point);
            let square: f64 = (0..3).map(|a| (x[a].0[2] - reach.target[a]).powi(2)).sum();
            out.cost += reach.weight * square;
        }
    }

    fn load(&mut self, problem: &Problem, z: &[f64]) {
        let layout = &problem.layout;
        let dt = z[layout.t(1)] - z[layout.t(0)];
        for j in 0..layout.n {
            (self.q[j], self.rate[j]) = lanes_of(problem, z, dt, j);
        }
    }

    fn contacts(&mut self, problem: &Problem, homotopy: Homotopy, z: &[f64], out: &mut StageValues) {
        let (layout, law) = (&problem.layout, &problem.law);
        for (i, contact) in problem.contacts.iter().enumerate() {
            let bodies = &self.nodes.bodies;
            let x = position(&bodies[contact.body], &contact.point);
            let imp = layout.contact(i);
            let axes: &[usize] = if law.tangents == 1 { &[0, 2] } else { &[0, 1, 2] };
            let mut velocity = [0.0; 3];
            for &k in problem.model.branch(contact.body) {
                let g = gradient(&bodies[k].twist, x);
                for (a, &axis) in axes.iter().enumerate() {
                    velocity[a] += g[axis].0[2] * z[layout.v(1, k)];
                }
                for alpha in 0..3 {
                    let force = force_of(problem, z, imp, alpha);
                    let projected: f64 = (0..3).map(|axis| g[axis].0[alpha] * force[axis]).sum();
                    self.del[alpha * layout.n + k] += projected;
                }
            }
            fill_small(problem, z, imp, &x, &velocity, &mut self.small);
            self.law.values(law, &problem.terrain, homotopy, contact.radius, &self.small);
            let row = problem.contact_row(i);
            out.rows[row..row + law.rows()].copy_from_slice(&self.law.value[..law.rows()]);
            out.products[i] = self.law.product;
        }
    }

    fn clearance(&mut self, problem: &Problem, homotopy: Homotopy, out: &mut StageValues) {
        for (p, point) in problem.clearance.iter().enumerate() {
            let x = position(&self.nodes.bodies[point.body], &point.point);
            for at in 0..CLEARANCE_AT.len() {
                let lane = CLEARANCE_LANE[at];
                let bound = clearance_bound(problem, homotopy, x[0].0[lane]);
                out.rows[problem.clearance_row(at, p)] =
                    x[2].0[lane] - point.radius - bound.value + problem.clearance_slack_m[at];
            }
        }
    }
}

/// What a leg must stay above at `x`.
pub(crate) fn clearance_bound(problem: &Problem, homotopy: Homotopy, x: f64) -> crate::terrain::Profile {
    let (ground, obstacle) = (problem.terrain.height(x), problem.terrain.obstacle(x));
    crate::terrain::Profile {
        value: ground.value + homotopy.sigma * obstacle.value,
        slope: ground.slope + homotopy.sigma * obstacle.slope,
        curvature: ground.curvature + homotopy.sigma * obstacle.curvature,
    }
}

/// Position and rate of coordinate `j` in every lane.
#[inline(always)]
pub(crate) fn lanes_of(problem: &Problem, z: &[f64], dt: f64, j: usize) -> (Lanes, Lanes) {
    let layout = &problem.layout;
    let nodes = [z[layout.q(0, j)], z[layout.middle(j)], z[layout.q(1, j)]];
    let at = |c: f64| {
        let w = polynomial(c);
        w[0] * nodes[0] + w[1] * nodes[1] + w[2] * nodes[2]
    };
    let rate = |beta: usize| {
        let b = DERIVATIVE[beta];
        (b[0] * nodes[0] + b[1] * nodes[1] + b[2] * nodes[2]) / dt
    };
    let (v0, v1) = (z[layout.v(0, j)], z[layout.v(1, j)]);
    let mut q = [nodes[2]; LANES];
    (q[0], q[1], q[3], q[6], q[7]) = (nodes[0], nodes[1], nodes[0], at(0.25), at(0.75));
    let mut q_dot = [0.0; LANES];
    (q_dot[0], q_dot[1], q_dot[2], q_dot[3], q_dot[4]) = (rate(0), rate(1), rate(2), v0, v1);
    (Lanes(q), Lanes(q_dot))
}

/// The DEL rows without contacts, unscaled, added to `del` (node-major).
pub(crate) fn del_rows(
    problem: &Problem,
    z: &[f64],
    by_position: &[Lanes],
    by_rate: &[Lanes],
    q: &[Lanes],
    rate: &[Lanes],
    del: &mut [f64],
) {
    let (layout, model) = (&problem.layout, &problem.model);
    let n = layout.n;
    let dt = z[layout.t(1)] - z[layout.t(0)];
    for j in 0..n {
        for alpha in 0..3 {
            let spring = model.stiffness[j] * (q[j].0[alpha] - model.rest[j]);
            let joint = -model.damping[j] * rate[j].0[alpha] - spring;
            let mut row = WEIGHTS[alpha] * dt * (by_position[j].0[alpha] + joint);
            for beta in 0..3 {
                row += WEIGHTS[beta] * DERIVATIVE[beta][alpha] * by_rate[j].0[beta];
            }
            del[alpha * n + j] += row;
        }
        del[j] += by_rate[j].0[3];
        del[2 * n + j] -= by_rate[j].0[4];
    }
    if layout.wrench > 0 {
        for alpha in 0..3 {
            for j in 0..6 {
                del[alpha * n + j] += problem.unit_ns * z[layout.sole(alpha) + j];
            }
        }
    }
    for (input, &j) in problem.robot.actuated.iter().enumerate() {
        for alpha in 0..3 {
            del[alpha * n + j] += WEIGHTS[alpha] * dt * z[layout.input(input)];
        }
    }
}

/// Impulse of a contact at a node along x, y, z, N s.
#[inline(always)]
pub(crate) fn force_of(problem: &Problem, z: &[f64], imp: usize, alpha: usize) -> [f64; 3] {
    let law = &problem.law;
    let first = law.first_impulse();
    let tau = imp + law.tangential(alpha) - first;
    let n = z[imp + law.normal(alpha) - first];
    let across = if law.tangents == 2 { z[tau + 1] } else { 0.0 };
    [problem.unit_ns * z[tau], problem.unit_ns * across, problem.unit_ns * n]
}

/// The small variables of a contact ([`crate::contact_law`]).
#[inline(always)]
pub(crate) fn fill_small(
    problem: &Problem,
    z: &[f64],
    imp: usize,
    x: &[Lanes; 3],
    velocity: &[f64; 3],
    small: &mut [f64; SMALL],
) {
    let (law, layout) = (&problem.law, &problem.layout);
    for node in 0..3 {
        let at = law.position(node);
        small[at] = x[0].0[node];
        if law.tangents == 2 {
            small[at + 1] = x[1].0[node];
        }
        small[at + law.tangents] = x[2].0[node];
    }
    small[law.velocity()..law.velocity() + law.dimension()].copy_from_slice(&velocity[..law.dimension()]);
    let first = law.first_impulse();
    small[first..first + law.impulses()].copy_from_slice(&z[imp..imp + law.impulses()]);
    small[law.step()] = z[layout.t(1)] - z[layout.t(0)];
}

/// Stage length and further linear rows.
pub(crate) fn plain_rows(problem: &Problem, z: &[f64], rows: &mut [f64]) {
    let layout = &problem.layout;
    let dt = z[layout.t(1)] - z[layout.t(0)];
    let (low, high) = problem.step_bounds;
    let at = problem.step_row();
    rows[at] = (dt - low) / problem.mean_stage_s();
    rows[at + 1] = (high - dt) / problem.mean_stage_s();
    for (row, out) in problem.rows.iter().zip(&mut rows[problem.linear_row()..]) {
        *out = row.constant + row.form.iter().map(|&(index, factor)| factor * z[index]).sum::<f64>();
    }
}

/// Cost of a stage.
fn cost(problem: &Problem, z: &[f64], last: bool) -> f64 {
    let layout = &problem.layout;
    let dt = z[layout.t(1)] - z[layout.t(0)];
    let terminal = if last { problem.terminal.as_slice() } else { &[] };
    let mut total = 0.0;
    for square in problem.cost.iter().chain(terminal) {
        let form: f64 = square.form.iter().map(|&(index, factor)| factor * z[index]).sum();
        let distance = form - square.target;
        total += square.weight * distance * distance * if square.per_time { dt } else { 1.0 };
    }
    total
}
