//! Lobatto quadrature and differentiation on `[0, 1]`: the control nodes of one step.
//!
//! | letter | here | meaning |
//! |---|---|---|
//! | `s` | [`LobattoRule::unknown_nodes`] | nodes per step that are unknown; `s + 1` nodes in all |
//! | `c^α` | [`LobattoRule::nodes`] | node times as fractions of the step, `c^0 = 0`, `c^s = 1` |
//! | `w^α` | [`LobattoRule::weights`] | quadrature weights, sum 1 |
//! | `b^{αβ}` | [`LobattoRule::derivative`] | derivative of the interpolation polynomial: `q̇^α = (1/Δt) Σ_β b^{αβ} q^β` |
//! | `a^{αβ} = w^β b^{βα}` | [`LobattoRule::weighted_derivative`] | its weighted transpose |
//!
//! Nodes are 0, 1 and the roots of `P_s'(2c-1)`; `w_α = 1/(s(s+1) P_s(2c_α-1)²)`;
//! `b` from the barycentric weights `λ_j = 1/Π_{k≠j}(c_j-c_k)`: `b^{ij} = (λ_j/λ_i)/(c_i-c_j)`, `b^{ii} = -Σ_{j≠i} b^{ij}`.
//! Accuracy of the integrator built on it: order `2s` at the step boundaries.
//!
//! Source: the paper, section 2.2; M. Abramowitz, I. Stegun, *Handbook of Mathematical Functions*, 25.4.32;
//! J.-P. Berrut, L. N. Trefethen, *Barycentric Lagrange Interpolation*, SIAM Review 46, 2004.

use alloc::vec;
use alloc::vec::Vec;

use crate::errors::ModelError;
use crate::real::cos;

/// The largest supported number of unknown nodes per step.
///
/// Beyond it the order (`2s = 30`) is past what double precision can show at any usable step.
pub const MAX_UNKNOWN_NODES: usize = 15;

/// Nodes, weights and differentiation matrix of the `(s+1)`-point Lobatto rule on `[0, 1]`.
#[derive(Clone, Debug, PartialEq)]
pub struct LobattoRule {
    nodes: Vec<f64>,
    weights: Vec<f64>,
    derivative: Vec<f64>,
    weighted_derivative: Vec<f64>,
}

impl LobattoRule {
    /// The rule with `s` unknown nodes (`1 <= s <= 15`).
    ///
    /// # Errors
    /// [`ModelError::UnsupportedOrder`] for other `s`.
    pub fn new(s: usize) -> Result<Self, ModelError> {
        if s == 0 || s > MAX_UNKNOWN_NODES {
            return Err(ModelError::UnsupportedOrder { unknown_nodes: s, limit: MAX_UNKNOWN_NODES });
        }
        let nodes = lobatto_nodes(s);
        let weights: Vec<f64> = nodes
            .iter()
            .map(|&c| {
                let (value, _, _) = legendre(s, 2.0 * c - 1.0);
                1.0 / ((s * (s + 1)) as f64 * value * value)
            })
            .collect();
        let count = s + 1;
        let barycentric: Vec<f64> = (0..count)
            .map(|j| 1.0 / (0..count).filter(|&k| k != j).map(|k| nodes[j] - nodes[k]).product::<f64>())
            .collect();
        let mut derivative = vec![0.0; count * count];
        for i in 0..count {
            let mut diagonal = 0.0;
            for j in (0..count).filter(|&j| j != i) {
                let entry = barycentric[j] / barycentric[i] / (nodes[i] - nodes[j]);
                derivative[i * count + j] = entry;
                diagonal -= entry;
            }
            derivative[i * count + i] = diagonal;
        }
        let mut weighted_derivative = vec![0.0; count * count];
        for alpha in 0..count {
            for beta in 0..count {
                weighted_derivative[alpha * count + beta] = weights[beta] * derivative[beta * count + alpha];
            }
        }
        Ok(Self { nodes, weights, derivative, weighted_derivative })
    }

    /// Number of unknown nodes `s`.
    pub fn unknown_nodes(&self) -> usize {
        self.nodes.len() - 1
    }

    /// Node times `c^0..c^s` as fractions of the step.
    pub fn nodes(&self) -> &[f64] {
        &self.nodes
    }

    /// Quadrature weights `w^0..w^s`.
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// `b^{αβ}`.
    pub fn derivative(&self, alpha: usize, beta: usize) -> f64 {
        self.derivative[alpha * self.nodes.len() + beta]
    }

    /// `a^{αβ} = w^β b^{βα}`.
    pub fn weighted_derivative(&self, alpha: usize, beta: usize) -> f64 {
        self.weighted_derivative[alpha * self.nodes.len() + beta]
    }

    /// Value at `t` (fraction of the step, any real) of the Lagrange polynomial `l_β`. Cost O(s).
    pub fn lagrange(&self, beta: usize, t: f64) -> f64 {
        let own = self.nodes[beta];
        self.nodes.iter().enumerate().filter(|&(k, _)| k != beta).map(|(_, &c)| (t - c) / (own - c)).product()
    }
}

/// `P_s(x)`, `P_s'(x)` and `P_s''(x)` by the three-term recurrence; `|x| < 1` for the derivatives.
fn legendre(s: usize, x: f64) -> (f64, f64, f64) {
    let (mut previous, mut value) = (1.0, x);
    for k in 1..s {
        let k = k as f64;
        let next = ((2.0 * k + 1.0) * x * value - k * previous) / (k + 1.0);
        previous = value;
        value = next;
    }
    let s = s as f64;
    let gap = 1.0 - x * x;
    let first = s * (previous - x * value) / gap;
    let second = (2.0 * x * first - s * (s + 1.0) * value) / gap;
    (value, first, second)
}

fn lobatto_nodes(s: usize) -> Vec<f64> {
    let mut nodes = vec![0.0; s + 1];
    nodes[s] = 1.0;
    for (alpha, node) in nodes.iter_mut().enumerate().take(s).skip(1) {
        // Chebyshev-Lobatto points start the Newton iteration on P_s' in the right interval.
        let mut x = -cos(core::f64::consts::PI * alpha as f64 / s as f64);
        for _ in 0..50 {
            let (_, first, second) = legendre(s, x);
            let change = first / second;
            x -= change;
            if change.abs() < 1e-16 {
                break;
            }
        }
        *node = 0.5 * (1.0 + x);
    }
    nodes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_rules_have_their_closed_form() {
        let simpson = LobattoRule::new(2).unwrap();
        for (got, want) in simpson.nodes().iter().zip([0.0, 0.5, 1.0]) {
            assert!((got - want).abs() < 1e-16);
        }
        for (got, want) in simpson.weights().iter().zip([1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0]) {
            assert!((got - want).abs() < 1e-16);
        }
        let fourth = LobattoRule::new(4).unwrap();
        assert!((fourth.nodes()[1] - 0.5 * (1.0 - (3.0f64 / 7.0).sqrt())).abs() < 1e-15);
        assert!((fourth.weights()[2] - 16.0 / 45.0).abs() < 1e-15);
    }

    #[test]
    fn differentiates_and_integrates_polynomials_exactly() {
        for s in 1..=MAX_UNKNOWN_NODES {
            let rule = LobattoRule::new(s).unwrap();
            let c = rule.nodes();
            for k in 0..=s {
                for alpha in 0..=s {
                    let slope: f64 = (0..=s).map(|b| rule.derivative(alpha, b) * c[b].powi(k as i32)).sum();
                    let exact = if k == 0 { 0.0 } else { k as f64 * c[alpha].powi(k as i32 - 1) };
                    assert!((slope - exact).abs() < 1e-11, "s={s} k={k} α={alpha}: {slope} vs {exact}");
                }
            }
            for k in 0..2 * s {
                let sum: f64 = rule.weights().iter().zip(c).map(|(w, c)| w * c.powi(k as i32)).sum();
                assert!((sum - 1.0 / (k as f64 + 1.0)).abs() < 1e-14, "s={s} k={k}");
            }
            for a in 0..=s {
                for b in 0..=s {
                    assert!((rule.derivative(s - a, s - b) + rule.derivative(a, b)).abs() < 1e-11);
                }
            }
        }
    }

    #[test]
    fn orders_out_of_range_are_refused() {
        assert!(matches!(LobattoRule::new(0), Err(ModelError::UnsupportedOrder { unknown_nodes: 0, .. })));
        assert!(LobattoRule::new(MAX_UNKNOWN_NODES + 1).is_err());
    }
}
