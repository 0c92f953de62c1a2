//! What a lifted stage is linearised about: nodes and multipliers, nothing solved.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use super::boundary_state::BoundaryState;
use super::lifted::LiftedStage;
use crate::errors::ModelError;
use crate::kinematics::check_length;
use crate::lobatto::LobattoRule;
use crate::spatial::{exp_rotation, log_rotation};

/// Nodes and multipliers of one stage.
///
/// Multipliers are impulses (N·s, N·m·s) of *all* contacts of the stage's [`super::ContactStage`], in their order; those of contacts
/// that are not active are ignored.
#[derive(Clone, Debug, PartialEq)]
pub struct StageNominal {
    /// Unknown nodes `s`.
    nodes: usize,
    joints: usize,
    rows: usize,
    /// Chart coordinates `ξ^1..ξ^s` of the base, 6 each.
    pub xi: Vec<f64>,
    /// Joint coordinates `q^1..q^s`.
    pub q: Vec<f64>,
    /// `λ^0..λ^s`, `rows` each.
    pub multipliers: Vec<f64>,
}

impl StageNominal {
    /// All zero, for `s` unknown nodes, `joints` joints and `rows` rows of all contacts.
    pub fn new(s: usize, joints: usize, rows: usize) -> Self {
        Self {
            nodes: s,
            joints,
            rows,
            xi: vec![0.0; 6 * s],
            q: vec![0.0; joints * s],
            multipliers: vec![0.0; (s + 1) * rows],
        }
    }

    /// Rows of all contacts.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Nodes on the cubic (Hermite) polynomial between two boundary states `time_step` (s) apart, and multipliers `w_α Δt f` for the
    /// mean forces `f` (N, N·m) of all rows. No allocation.
    ///
    /// ```text
    /// θ = log(R_kᵀR_{k+1}),  R_m = R_k exp(θ/2)       ξ^s = (θ/2, R_mᵀ(p_{k+1}-p_k)/2),  slopes Δt (ω, R_mᵀ ṗ),  ends -ξ^s and ξ^s
    /// ```
    pub fn interpolate(
        &mut self,
        rule: &LobattoRule,
        time_step: f64,
        start: &BoundaryState,
        end: &BoundaryState,
        mean_force: &[f64],
    ) {
        let half = log_rotation(&start.orientation.tr_mul(&end.orientation)) * 0.5;
        let middle = start.orientation * exp_rotation(&half);
        let travel = middle.tr_mul(&(end.position_w - start.position_w)) * 0.5;
        let slopes = [start, end].map(|state| {
            let spin: Vector3<f64> = state.base_velocity_b.fixed_rows::<3>(0).into_owned();
            let linear = state.orientation * state.base_velocity_b.fixed_rows::<3>(3);
            (spin, middle.tr_mul(&linear))
        });
        for alpha in 1..=self.nodes.min(rule.unknown_nodes()) {
            let c = rule.nodes()[alpha];
            // Cubic Hermite polynomials of the value at the end and of both slopes.
            let value = c * c * (3.0 - 2.0 * c);
            let slope_start = time_step * c * (1.0 - c) * (1.0 - c);
            let slope_end = time_step * c * c * (c - 1.0);
            let node = &mut self.xi[(alpha - 1) * 6..alpha * 6];
            for k in 0..3 {
                node[k] =
                    half[k] * (2.0 * value - 1.0) + slopes[0].0[k] * slope_start + slopes[1].0[k] * slope_end;
                node[3 + k] = travel[k] * (2.0 * value - 1.0)
                    + slopes[0].1[k] * slope_start
                    + slopes[1].1[k] * slope_end;
            }
            let node = &mut self.q[(alpha - 1) * self.joints..alpha * self.joints];
            let ends = start.q.iter().zip(&end.q).zip(start.rate.iter().zip(&end.rate));
            for (q, ((first, last), (rate, last_rate))) in node.iter_mut().zip(ends) {
                *q = first * (1.0 - value) + last * value + rate * slope_start + last_rate * slope_end;
            }
        }
        for (alpha, multipliers) in self.multipliers.chunks_exact_mut(self.rows.max(1)).enumerate() {
            let weight = rule.weights().get(alpha).copied().unwrap_or(0.0) * time_step;
            for (multiplier, force) in multipliers.iter_mut().zip(mean_force) {
                *multiplier = weight * force;
            }
        }
    }

    /// # Errors
    /// [`ModelError::Length`] for numbers that do not fit `s` unknown nodes, the joints and the rows.
    pub(super) fn check(&self, s: usize, joints: usize, rows: usize) -> Result<(), ModelError> {
        check_length("base nodes of the nominal", self.xi.len(), 6 * s)?;
        check_length("joint nodes of the nominal", self.q.len(), joints * s)?;
        check_length("multipliers of the nominal", self.multipliers.len(), (s + 1) * rows)?;
        check_length("rows of the nominal", self.rows, rows)
    }

    /// Moves nodes and multipliers by what a linearisation predicts for the deviation `x` at the start and `u` of the inputs: the
    /// second half of a lifted Newton iteration. No allocation.
    pub fn advance(&mut self, lifted: &LiftedStage, x: &[f64], u: &[f64]) {
        let nv = 6 + self.joints;
        for alpha in 1..=self.nodes {
            for k in 0..nv {
                let change = lifted.node_change((alpha - 1) * nv + k, x, u);
                if k < 6 {
                    self.xi[(alpha - 1) * 6 + k] += change;
                } else {
                    self.q[(alpha - 1) * self.joints + k - 6] += change;
                }
            }
        }
        for alpha in 0..=self.nodes {
            for (row, &all) in lifted.row_of_all().iter().enumerate() {
                let change = lifted.multiplier_change(alpha, row, x, u);
                if let Some(multiplier) = self.multipliers.get_mut(alpha * self.rows + all as usize) {
                    *multiplier += change;
                }
            }
        }
    }
}
