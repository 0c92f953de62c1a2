//! The contact law of one contact point over one stage, formulation C.
//!
//! ```text
//! φ^½ >= 0,   φ^1 >= 0,   w := φ^1 + c v_n >= 0,   |τ^α| <= μ n^α,   γ^α >= |s^α|
//! P := (n^0 + n^½)(φ'^0 + φ'^½ + φ'^1) + n^1 (φ'^1 + w') + Σ_α ( τ^α·s^α + μ n^α γ^α )  <= κ
//! ```
//!
//! with the slips `s^0 = x^½ - x^0`, `s^½ = x^1 - x^½`, `s^1 = c v_t`, the gaps `φ` and the gaps with forbidden stretches
//! `φ'` ([`crate::terrain`]). Sums, not pairs: `n^0` and `n^½` act only if the gap is shut at all three nodes, so a landing
//! or lift-off inside a stage is impossible at κ = 0 and the solver moves the stage boundaries onto the events.
//! `τ·s + μ n γ` is the duality gap of maximum dissipation: friction without a polyhedron. Restitution 0.
//!
//! A plan whose feet shall not slide has `μ (n^0 + n^½)(γ^0 + γ^½) + μ n^1 γ^1` in its place: a point that carries stays where it is
//! through its stage, whatever the friction in its cone.
//!
//! An optional row bounds the speed of approach at the end of the stage, before an impact, the less the higher the point is:
//! `φ^0 - 4 φ^½ + 3 φ^1 + v_max Δt + 4 φ^1 >= 0`.
//!
//! Everything here is in the *small variables* of a contact:
//!
//! | range | plane | space | what |
//! |---|---|---|---|
//! | `position(α)` | x, z | x, y, z | contact point at the three nodes, m |
//! | `velocity` | x, z | x, y, z | `G(q^1) v_{k+1}`, m/s |
//! | `normal(α)`, `tangential(α)`, `slip(α)` | 1, 1, 1 | 1, 2, 1 | `n^α`, `τ^α` (in units of S), `γ^α` (m) |
//! | `step` | 1 | 1 | Δt, s |

use crate::terrain::{Profile, Terrain};

/// What a point that is still in the air may approach faster, per height and stage.
const RELIEF: f64 = 4.0;
/// Most small variables.
pub const SMALL: usize = 25;
/// Most rows.
pub const ROWS: usize = 17;
/// Softening of the length of a tangential impulse, units of S.
pub(crate) const IMPULSE_SOFTNESS: f64 = 1e-4;
/// Softening of the length of a slip, m.
pub(crate) const SLIP_SOFTNESS: f64 = 1e-5;

/// Softness of a tangential impulse over κ: a cone that is as round as the products are loose keeps Newton's full steps.
const SOFTNESS_PER_KAPPA: f64 = 10.0;

/// Constants of the law, the same for all contacts of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LawConstants {
    /// Tangential directions: 1 in the plane, 2 in space.
    pub tangents: usize,
    /// Coefficient of friction.
    pub friction: f64,
    /// Whether a point that carries may slide.
    pub sliding: bool,
    /// `c = T/2N`, s.
    pub half_stage_s: f64,
    /// Largest speed of approach before an impact, m/s; none without the row.
    pub touchdown_speed: Option<f64>,
}

/// Where we are on the homotopy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Homotopy {
    /// Bound of the products, S m.
    pub kappa: f64,
    /// How far obstacles have grown, 0 to 1.
    pub sigma: f64,
}

impl Homotopy {
    /// Softening of the lengths of a tangential impulse (units of S) and of a slip (m): cones are round while κ is large.
    pub fn softness(&self) -> [f64; 2] {
        let impulse = (SOFTNESS_PER_KAPPA * self.kappa).clamp(IMPULSE_SOFTNESS, 0.1);
        let slip = (0.1 * SOFTNESS_PER_KAPPA * self.kappa).clamp(SLIP_SOFTNESS, 0.01);
        [impulse, slip]
    }
}

impl LawConstants {
    /// Components of a position.
    pub fn dimension(&self) -> usize {
        self.tangents + 1
    }
    /// Impulses and slip bounds of a contact: `n` (3), `τ` (3 per tangent), `γ` (3).
    pub fn impulses(&self) -> usize {
        6 + 3 * self.tangents
    }
    /// Small variables.
    pub fn small(&self) -> usize {
        4 * self.dimension() + self.impulses() + 1
    }
    /// Rows of a contact.
    pub fn rows(&self) -> usize {
        let cones = if self.tangents == 1 { 12 } else { 6 };
        4 + cones + usize::from(self.touchdown_speed.is_some())
    }
    /// Index of the product row.
    pub fn product_row(&self) -> usize {
        if self.tangents == 1 { 15 } else { 9 }
    }
    /// First small variable of the position at a node.
    pub fn position(&self, node: usize) -> usize {
        node * self.dimension()
    }
    /// First small variable of the end velocity.
    pub fn velocity(&self) -> usize {
        3 * self.dimension()
    }
    /// First small variable of the impulses.
    pub fn first_impulse(&self) -> usize {
        4 * self.dimension()
    }
    /// Normal impulse at a node.
    pub fn normal(&self, node: usize) -> usize {
        self.first_impulse() + node
    }
    /// First tangential impulse at a node.
    pub fn tangential(&self, node: usize) -> usize {
        self.first_impulse() + 3 + node * self.tangents
    }
    /// Slip bound at a node.
    pub fn slip(&self, node: usize) -> usize {
        self.first_impulse() + 3 + 3 * self.tangents + node
    }
    /// The time step.
    pub fn step(&self) -> usize {
        4 * self.dimension() + self.impulses()
    }
}

/// Values of the rows, their gradients, and the curvature of the rows weighted by multipliers.
#[derive(Clone, Debug)]
pub struct LawRows {
    /// `g >= 0`.
    pub value: [f64; ROWS],
    /// Gradient of every row in the small variables.
    pub gradient: [[f64; SMALL]; ROWS],
    /// `-Σ_r l_r ∇²g_r`, symmetric.
    pub curvature: [[f64; SMALL]; SMALL],
    /// `P`, S m.
    pub product: f64,
}

impl Default for LawRows {
    fn default() -> Self {
        Self {
            value: [0.0; ROWS],
            gradient: [[0.0; SMALL]; ROWS],
            curvature: [[0.0; SMALL]; SMALL],
            product: 0.0,
        }
    }
}

/// Evaluation of the law at given small variables.
struct Evaluation<'a> {
    law: &'a LawConstants,
    x: &'a [f64],
    /// `φ`: height of the ground at the nodes.
    ground: [Profile; 3],
    /// `φ'` = φ + d Π: the additional part.
    forbidden: [Profile; 3],
    /// How far the gap rows let a point sink.
    slack: f64,
    /// Softening of the lengths of a tangential impulse and of a slip.
    softness: [f64; 2],
}

impl LawRows {
    /// Values only.
    pub fn values(
        &mut self,
        law: &LawConstants,
        terrain: &Terrain,
        homotopy: Homotopy,
        radius: f64,
        x: &[f64],
    ) {
        Evaluation::new(law, terrain, homotopy, x).values(self, homotopy, radius);
    }

    /// Values, gradients, and the curvature weighted by `-multipliers`.
    pub fn derivatives(
        &mut self,
        law: &LawConstants,
        terrain: &Terrain,
        homotopy: Homotopy,
        radius: f64,
        x: &[f64],
        multipliers: &[f64],
    ) {
        let evaluation = Evaluation::new(law, terrain, homotopy, x);
        evaluation.values(self, homotopy, radius);
        for row in &mut self.gradient {
            *row = [0.0; SMALL];
        }
        for row in &mut self.curvature {
            *row = [0.0; SMALL];
        }
        evaluation.gap_rows(self, multipliers);
        evaluation.cone_rows(self, multipliers);
        evaluation.product_row(self, multipliers[law.product_row()], radius);
    }
}

impl<'a> Evaluation<'a> {
    fn new(law: &'a LawConstants, terrain: &Terrain, homotopy: Homotopy, x: &'a [f64]) -> Self {
        let (mut ground, mut forbidden) = ([Profile::default(); 3], [Profile::default(); 3]);
        if !terrain.is_flat() {
            for node in 0..3 {
                let along = x[law.position(node)];
                ground[node] = terrain.height(along);
                forbidden[node] = terrain.forbidden(along);
            }
        }
        Self { law, x, ground, forbidden, slack: terrain.ground_slack_m, softness: homotopy.softness() }
    }

    fn height(&self, node: usize) -> usize {
        self.law.position(node) + self.law.tangents
    }

    fn gap(&self, node: usize, radius: f64) -> f64 {
        self.x[self.height(node)] - radius - self.ground[node].value
    }

    /// `s^α` in the direction `t`, and the small variables (index, factor) it consists of.
    fn slip(&self, node: usize, t: usize) -> (f64, [(usize, f64); 2]) {
        let law = self.law;
        let parts = match node {
            0 | 1 => [(law.position(node + 1) + t, 1.0), (law.position(node) + t, -1.0)],
            _ => [(law.velocity() + t, law.half_stage_s), (law.velocity() + t, 0.0)],
        };
        (parts.iter().map(|&(index, factor)| factor * self.x[index]).sum(), parts)
    }

    fn values(&self, out: &mut LawRows, homotopy: Homotopy, radius: f64) {
        let (law, x) = (self.law, self.x);
        let gaps = [0, 1, 2].map(|node| self.gap(node, radius));
        let normal_speed = x[law.velocity() + law.tangents];
        let approach = law.half_stage_s * normal_speed;
        out.value[0] = gaps[1] + self.slack;
        out.value[1] = gaps[2] + self.slack;
        out.value[2] = gaps[2] + approach + self.slack;
        let closed = [0, 1, 2].map(|node| gaps[node] + self.forbidden[node].value);
        let (n0, n1, n2) = (x[law.normal(0)], x[law.normal(1)], x[law.normal(2)]);
        let mut product = (n0 + n1) * (closed[0] + closed[1] + closed[2]) + n2 * (2.0 * closed[2] + approach);
        for node in 0..3 {
            let (n, bound) = (x[law.normal(node)], x[law.slip(node)]);
            let (mut tau2, mut slip2) = (0.0, 0.0);
            for t in 0..law.tangents {
                let tau = x[law.tangential(node) + t];
                let (slip, _) = self.slip(node, t);
                if law.sliding {
                    product += tau * slip;
                }
                tau2 += tau * tau;
                slip2 += slip * slip;
                if law.tangents == 1 {
                    out.value[3 + 2 * node] = law.friction * n - tau;
                    out.value[4 + 2 * node] = law.friction * n + tau;
                    out.value[9 + 2 * node] = bound - slip;
                    out.value[10 + 2 * node] = bound + slip;
                }
            }
            if law.tangents == 2 {
                out.value[3 + node] = law.friction * n - soft_length(tau2, self.softness[0]);
                out.value[6 + node] = bound - soft_length(slip2, self.softness[1]);
            }
            if law.sliding || node == 2 {
                product += law.friction * n * bound;
            }
        }
        if !law.sliding {
            product += law.friction * (n0 + n1) * (x[law.slip(0)] + x[law.slip(1)]);
        }
        out.product = product;
        out.value[law.product_row()] = homotopy.kappa - product;
        if let Some(speed) = law.touchdown_speed {
            out.value[law.product_row() + 1] =
                gaps[0] - 4.0 * gaps[1] + (3.0 + RELIEF) * gaps[2] + speed * x[law.step()];
        }
    }

    /// Adds `factor ∇φ^node` to a gradient.
    fn add_gap(&self, gradient: &mut [f64; SMALL], node: usize, factor: f64) {
        gradient[self.height(node)] += factor;
        gradient[self.law.position(node)] -= factor * self.ground[node].slope;
    }

    fn gap_rows(&self, out: &mut LawRows, l: &[f64]) {
        let law = self.law;
        self.add_gap(&mut out.gradient[0], 1, 1.0);
        self.add_gap(&mut out.gradient[1], 2, 1.0);
        self.add_gap(&mut out.gradient[2], 2, 1.0);
        out.gradient[2][law.velocity() + law.tangents] += law.half_stage_s;
        let mut weights = [0.0, l[0], l[1] + l[2]];
        if let Some(speed) = law.touchdown_speed {
            let row = law.product_row() + 1;
            for (node, factor) in [1.0, -4.0, 3.0 + RELIEF].into_iter().enumerate() {
                self.add_gap(&mut out.gradient[row], node, factor);
                weights[node] += factor * l[row];
            }
            out.gradient[row][law.step()] += speed;
        }
        for node in 0..3 {
            let along = law.position(node);
            out.curvature[along][along] += weights[node] * self.ground[node].curvature;
        }
    }

    fn cone_rows(&self, out: &mut LawRows, l: &[f64]) {
        let (law, x) = (self.law, self.x);
        for node in 0..3 {
            let (n, bound, tau) = (law.normal(node), law.slip(node), law.tangential(node));
            if law.tangents == 1 {
                let (_, parts) = self.slip(node, 0);
                for (sign, cone, slip) in
                    [(-1.0, 3 + 2 * node, 9 + 2 * node), (1.0, 4 + 2 * node, 10 + 2 * node)]
                {
                    out.gradient[cone][n] += law.friction;
                    out.gradient[cone][tau] += sign;
                    out.gradient[slip][bound] += 1.0;
                    for (index, factor) in parts {
                        out.gradient[slip][index] += sign * factor;
                    }
                }
                continue;
            }
            let (cone, slip) = (3 + node, 6 + node);
            out.gradient[cone][n] += law.friction;
            let impulse = [x[tau], x[tau + 1]];
            let (gradient, hessian) = soft_length_derivatives(impulse, self.softness[0]);
            for t in 0..2 {
                out.gradient[cone][tau + t] -= gradient[t];
                for u in 0..2 {
                    out.curvature[tau + t][tau + u] += l[cone] * hessian[t][u];
                }
            }
            out.gradient[slip][bound] += 1.0;
            let slips = [self.slip(node, 0), self.slip(node, 1)];
            let (gradient, hessian) = soft_length_derivatives([slips[0].0, slips[1].0], self.softness[1]);
            for t in 0..2 {
                for (index, factor) in slips[t].1 {
                    out.gradient[slip][index] -= gradient[t] * factor;
                    for u in 0..2 {
                        for (other, other_factor) in slips[u].1 {
                            out.curvature[index][other] += l[slip] * hessian[t][u] * factor * other_factor;
                        }
                    }
                }
            }
        }
    }

    fn product_row(&self, out: &mut LawRows, l: f64, radius: f64) {
        let (law, x) = (self.law, self.x);
        // The row is κ - P: gradient -∇P, weighted curvature +l ∇²P.
        let (g, h) = (&mut out.gradient[law.product_row()], &mut out.curvature);
        let mut both = |a: usize, b: usize, value: f64| {
            h[a][b] += value;
            h[b][a] += value;
        };
        let (n0, n1, n2) = (law.normal(0), law.normal(1), law.normal(2));
        let normal_speed = law.velocity() + law.tangents;
        let closed = [0, 1, 2].map(|node| self.gap(node, radius) + self.forbidden[node].value);
        let total = closed[0] + closed[1] + closed[2];
        g[n0] -= total;
        g[n1] -= total;
        g[n2] -= 2.0 * closed[2] + law.half_stage_s * x[normal_speed];
        g[normal_speed] -= law.half_stage_s * x[n2];
        both(n2, normal_speed, l * law.half_stage_s);
        for node in 0..3 {
            let slope = self.forbidden[node].slope - self.ground[node].slope;
            let curvature = self.forbidden[node].curvature - self.ground[node].curvature;
            let (along, height) = (law.position(node), self.height(node));
            let mut weight = x[n0] + x[n1];
            let mut partners = [(n0, 1.0), (n1, 1.0), (n2, 0.0)];
            if node == 2 {
                weight += 2.0 * x[n2];
                partners[2].1 = 2.0;
            }
            g[height] -= weight;
            g[along] -= weight * slope;
            both(along, along, 0.5 * l * weight * curvature);
            for (n, factor) in partners {
                both(n, height, l * factor);
                both(n, along, l * factor * slope);
            }
            let n = law.normal(node);
            // A point that carries at the start or in the middle of its stage does not slide in either half.
            let bounds = if law.sliding || node == 2 { node..node + 1 } else { 0..2 };
            for bound in bounds.map(|node| law.slip(node)) {
                g[n] -= law.friction * x[bound];
                g[bound] -= law.friction * x[n];
                both(n, bound, l * law.friction);
            }
            if !law.sliding {
                continue;
            }
            for t in 0..law.tangents {
                let tau = law.tangential(node) + t;
                let (slip, parts) = self.slip(node, t);
                g[tau] -= slip;
                for (index, factor) in parts {
                    g[index] -= x[tau] * factor;
                    both(tau, index, l * factor);
                }
            }
        }
    }
}

/// `sqrt(square + ε²) - ε`.
pub(crate) fn soft_length(square: f64, softness: f64) -> f64 {
    let length = (square + softness * softness).sqrt();
    square / (length + softness)
}

fn soft_length_derivatives(v: [f64; 2], softness: f64) -> ([f64; 2], [[f64; 2]; 2]) {
    let length = (v[0] * v[0] + v[1] * v[1] + softness * softness).sqrt();
    let u = [v[0] / length, v[1] / length];
    let entry = |a: usize, b: usize| (f64::from(u8::from(a == b)) - u[a] * u[b]) / length;
    (u, [[entry(0, 0), entry(0, 1)], [entry(1, 0), entry(1, 1)]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terrain::{Gap, Step};

    fn check(law: LawConstants, terrain: &Terrain) {
        let homotopy = Homotopy { kappa: 0.3, sigma: 0.7 };
        let ns = law.small();
        let x: Vec<f64> = (0..ns).map(|i| 0.12 + 0.02 * (1.7 * i as f64).sin()).collect();
        let l: Vec<f64> = (0..law.rows()).map(|i| 0.3 + (i as f64).cos()).collect();
        let mut at = LawRows::default();
        at.derivatives(&law, terrain, homotopy, 0.01, &x, &l);
        let h = 1e-7;
        for j in 0..ns {
            let (mut low, mut high) = (LawRows::default(), LawRows::default());
            let moved = |change: f64| {
                let mut y = x.clone();
                y[j] += change;
                y
            };
            low.derivatives(&law, terrain, homotopy, 0.01, &moved(-h), &l);
            high.derivatives(&law, terrain, homotopy, 0.01, &moved(h), &l);
            for r in 0..law.rows() {
                let difference = (high.value[r] - low.value[r]) / (2.0 * h);
                let got = at.gradient[r][j];
                assert!((difference - got).abs() < 1e-6 * (1.0 + got.abs()), "row {r}, variable {j}");
            }
            for i in 0..ns {
                let weighted =
                    |rows: &LawRows| -> f64 { (0..law.rows()).map(|r| -l[r] * rows.gradient[r][i]).sum() };
                let difference = (weighted(&high) - weighted(&low)) / (2.0 * h);
                let got = at.curvature[i][j];
                assert!(
                    (difference - got).abs() < 1e-5 * (1.0 + got.abs()),
                    "curvature {i} {j}: {difference} {got}"
                );
            }
        }
    }

    #[test]
    fn gradients_and_curvature_are_those_of_the_values() {
        let terrain = Terrain {
            gaps: vec![Gap { from_m: 0.13, to_m: 0.17 }],
            steps: vec![Step { x_m: 0.11, rise_m: 0.05 }],
            ..Terrain::flat()
        };
        for tangents in [1, 2] {
            for (touchdown_speed, sliding) in [(None, true), (Some(1.5), true), (None, false)] {
                let law =
                    LawConstants { tangents, friction: 0.7, sliding, half_stage_s: 0.04, touchdown_speed };
                check(law, &terrain);
                check(law, &Terrain::flat());
            }
        }
    }
}
