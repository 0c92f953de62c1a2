//! The augmented-Lagrangian barrier: one smooth function, no slacks, no fraction-to-the-boundary rule.
//!
//! ```text
//! equation    (c - δ y)²/2δ                       ŷ = y - c/δ      D = 1/δ
//! inequality  ψ: a = g - δ z, s = (a + √(a²+4μδ))/2, ẑ = μ/s       -μ ln s + (s-a)²/2δ     ψ' = -ẑ     ψ'' = D = ẑ/(s + δ ẑ)
//! ```
//!
//! `δ → 0` is an interior point method, `μ → 0` an augmented Lagrangian. The slack `s` is eliminated in closed form.

/// Parameters of the barrier.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Barrier {
    /// Barrier parameter.
    pub mu: f64,
    /// Penalty parameter.
    pub delta: f64,
}

/// One term of `Φ` at a value of its row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Term {
    /// Value.
    pub value: f64,
    /// Multiplier that the term stands for: minus its first derivative.
    pub multiplier: f64,
    /// Second derivative.
    pub weight: f64,
}

impl Barrier {
    /// Term of an equation `c = 0` with the estimate `y`.
    #[inline(always)]
    pub fn equation(&self, c: f64, y: f64) -> Term {
        let shifted = c - self.delta * y;
        let weight = 1.0 / self.delta;
        Term { value: 0.5 * shifted * shifted * weight, multiplier: -shifted * weight, weight }
    }

    /// Term of an inequality `g >= 0` with the estimate `z`.
    #[inline(always)]
    pub fn inequality(&self, g: f64, z: f64) -> Term {
        let Self { mu, delta } = *self;
        let a = g - delta * z;
        let root = (a * a + 4.0 * mu * delta).sqrt();
        // Neither branch cancels.
        let (slack, multiplier) = if a >= 0.0 {
            let slack = 0.5 * (a + root);
            (slack, mu / slack)
        } else {
            let multiplier = (root - a) / (2.0 * delta);
            (mu / multiplier, multiplier)
        };
        let penalty = 0.5 * delta * multiplier * multiplier;
        Term {
            value: penalty - mu * slack.ln(),
            multiplier,
            weight: multiplier / (slack + delta * multiplier),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_are_those_of_the_value() {
        let barrier = Barrier { mu: 1e-3, delta: 1e-2 };
        for z in [0.0, 0.3, 5.0] {
            for g in [-1.0, -0.01, 0.0, 0.02, 2.0] {
                let h = 1e-6;
                for term in [Barrier::equation, Barrier::inequality] {
                    let (low, at, high) =
                        (term(&barrier, g - h, z), term(&barrier, g, z), term(&barrier, g + h, z));
                    let slope = (high.value - low.value) / (2.0 * h);
                    let curvature = -(high.multiplier - low.multiplier) / (2.0 * h);
                    assert!((slope + at.multiplier).abs() < 1e-6 * (1.0 + slope.abs()));
                    assert!((curvature - at.weight).abs() < 1e-5 * (1.0 + curvature.abs()));
                }
            }
        }
    }
}
