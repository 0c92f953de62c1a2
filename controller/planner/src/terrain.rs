//! The ground of a plan: height, places where no foot may stand, obstacles that a leg must clear.
//!
//! ```text
//! gap of a contact point          φ  = z - r - height(x)
//! gap in the products             φ' = φ + d Π(x)            Π = (1 - r²)³ over every forbidden stretch, r = -1 .. 1 across it
//! clearance of a leg              z - height(x) >= σ h(x)    h = H/(1 + ((x - x_o)/half_width)^6)
//! ```
//!
//! A force inside a forbidden stretch costs `d Π` of complementarity, so it vanishes. Π falls off from the middle everywhere,
//! so a foot that still carries there is pushed out, and it is exactly zero outside, so a foothold at the margin is as good as
//! any other: a window with tails lets footholds creep away from the edge for hundreds of iterations. The gap itself keeps
//! the feet at or above the ground everywhere. The edges of a step are such stretches too, so every foothold lies on level
//! ground. `σ` of the obstacles grows from 0 to 1 in the first steps of the homotopy; Π needs no growth, it only counts
//! when κ is below `d`.
//!
//! Everything varies along x only and is uniform across: what a plan straight ahead needs.

use serde::{Deserialize, Serialize};

/// Complementarity of a unit force inside a window, m.
const WINDOW_DEPTH_M: f64 = 0.08;
/// Half of the length over which the smooth height of a step rises, m.
const STEP_SOFTNESS_M: f64 = 0.006;

/// A box to clear; no foot stands on it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Obstacle {
    /// Where its middle is, m.
    pub x_m: f64,
    /// Height, m.
    pub height_m: f64,
    /// Length along x, m.
    pub thickness_m: f64,
}

impl Obstacle {
    /// The smooth profile that covers the box with `margin_m` above it: height and half width at half height.
    ///
    /// With the margin 0.04 m a box 0.16 m high and 0.08 m thick has the profile `0.20/(1 + (x/0.065)⁶)`.
    fn profile(&self, margin_m: f64) -> (f64, f64) {
        (self.height_m + margin_m, 0.5 * self.thickness_m + 0.025)
    }
}

/// A stretch without ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gap {
    /// Where it begins, m.
    pub from_m: f64,
    /// Where it ends, m.
    pub to_m: f64,
}

/// A change of the ground's height.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// Where it is, m.
    pub x_m: f64,
    /// Rise (negative: fall), m.
    pub rise_m: f64,
}

/// The ground.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Terrain {
    /// Boxes to clear.
    pub obstacles: Vec<Obstacle>,
    /// Gaps.
    pub gaps: Vec<Gap>,
    /// Steps.
    pub steps: Vec<Step>,
    /// Distance that footholds keep from edges, m.
    pub edge_margin_m: f64,
    /// How much the smooth profile of an obstacle exceeds it in height, m.
    pub obstacle_margin_m: f64,
    /// How far a contact point may sink below the ground, m.
    #[serde(default)]
    pub ground_slack_m: f64,
    /// Half of the length over which a forbidden stretch opens in plans of the handbook's prototype, m; 0 for ours.
    #[serde(default)]
    pub tails_m: f64,
}

/// A function of x with two derivatives.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Profile {
    /// Value.
    pub value: f64,
    /// First derivative.
    pub slope: f64,
    /// Second derivative.
    pub curvature: f64,
}

impl Profile {
    fn add(&mut self, other: Profile) {
        self.value += other.value;
        self.slope += other.slope;
        self.curvature += other.curvature;
    }
}

/// `½ (1 + tanh(x / 2ε))`.
fn rise(x: f64, softness: f64) -> Profile {
    let t = (x / (2.0 * softness)).tanh();
    let sech2 = 1.0 - t * t;
    Profile {
        value: 0.5 * (1.0 + t),
        slope: sech2 / (4.0 * softness),
        curvature: -t * sech2 / (4.0 * softness * softness),
    }
}

/// `(1 - r²)³` between `a` and `b`, 0 outside; `r` is -1 at `a` and 1 at `b`.
fn window(x: f64, a: f64, b: f64) -> Profile {
    let half = 0.5 * (b - a);
    let r = (x - 0.5 * (a + b)) / half;
    let inside = 1.0 - r * r;
    if inside <= 0.0 {
        return Profile::default();
    }
    Profile {
        value: inside * inside * inside,
        slope: -6.0 * r * inside * inside / half,
        curvature: 6.0 * inside * (4.0 * r * r - inside) / (half * half),
    }
}

/// `rise(x - a) rise(b - x)`: the forbidden stretch of the handbook's prototype, with tails outside.
fn window_with_tails(x: f64, a: f64, b: f64, softness: f64) -> Profile {
    let (up, down) = (rise(x - a, softness), rise(b - x, softness));
    Profile {
        value: up.value * down.value,
        slope: up.slope * down.value - up.value * down.slope,
        curvature: up.curvature * down.value - 2.0 * up.slope * down.slope + up.value * down.curvature,
    }
}

impl Terrain {
    /// Level ground without anything on it.
    pub fn flat() -> Self {
        Self { edge_margin_m: 0.015, obstacle_margin_m: 0.04, ..Self::default() }
    }

    /// Whether the ground is level everywhere and has no windows.
    pub fn is_flat(&self) -> bool {
        self.gaps.is_empty() && self.steps.is_empty()
    }

    /// Height of the ground (smooth; gaps are covered), m.
    pub fn height(&self, x: f64) -> Profile {
        let mut total = Profile::default();
        for step in &self.steps {
            let up = rise(x - step.x_m, STEP_SOFTNESS_M);
            total.add(Profile {
                value: step.rise_m * up.value,
                slope: step.rise_m * up.slope,
                curvature: step.rise_m * up.curvature,
            });
        }
        total
    }

    /// What is added to the gap in the products: `d Π(x)`, m.
    pub fn forbidden(&self, x: f64) -> Profile {
        let mut total = Profile::default();
        let margin = self.edge_margin_m;
        let gaps = self.gaps.iter().map(|gap| (gap.from_m - margin, gap.to_m + margin));
        let steps = self.steps.iter().map(|step| (step.x_m - margin, step.x_m + margin));
        for (a, b) in gaps.chain(steps) {
            let w =
                if self.tails_m > 0.0 { window_with_tails(x, a, b, self.tails_m) } else { window(x, a, b) };
            total.add(Profile {
                value: WINDOW_DEPTH_M * w.value,
                slope: WINDOW_DEPTH_M * w.slope,
                curvature: WINDOW_DEPTH_M * w.curvature,
            });
        }
        total
    }

    /// What a leg must clear, m: the sum of the obstacles' smooth profiles.
    pub fn obstacle(&self, x: f64) -> Profile {
        let mut total = Profile::default();
        for obstacle in &self.obstacles {
            let (height, half_width) = obstacle.profile(self.obstacle_margin_m);
            let r = (x - obstacle.x_m) / half_width;
            let (r2, r4) = (r * r, r * r * r * r);
            let denominator = 1.0 / (1.0 + r4 * r2);
            let slope = -6.0 * r4 * r * denominator * denominator;
            let curvature = -30.0 * r4 * denominator * denominator
                + 72.0 * r4 * r4 * r2 * denominator * denominator * denominator;
            total.add(Profile {
                value: height * denominator,
                slope: height * slope / half_width,
                curvature: height * curvature / (half_width * half_width),
            });
        }
        total
    }

    /// Signed distance of a point from the true boxes, m (negative inside); infinite without obstacles.
    pub fn distance_to_boxes(&self, x: f64, z: f64) -> f64 {
        self.obstacles.iter().fold(f64::INFINITY, |nearest, obstacle| {
            let dx = (x - obstacle.x_m).abs() - 0.5 * obstacle.thickness_m;
            let dz = z - obstacle.height_m;
            let outside = dx.max(0.0).hypot(dz.max(0.0));
            nearest.min(outside + dx.max(dz).min(0.0))
        })
    }

    /// Distance of a foothold to the nearest edge of a gap or step, m (negative inside a gap).
    pub fn distance_to_edge(&self, x: f64) -> f64 {
        let gaps = self.gaps.iter().map(|gap| (gap.from_m - x).max(x - gap.to_m));
        let steps = self.steps.iter().map(|step| (x - step.x_m).abs());
        gaps.chain(steps).fold(f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_are_those_of_the_values() {
        let terrain = Terrain {
            obstacles: vec![Obstacle { x_m: 0.9, height_m: 0.16, thickness_m: 0.08 }],
            gaps: vec![Gap { from_m: 0.11, to_m: 0.17 }],
            steps: vec![Step { x_m: 0.5, rise_m: 0.05 }],
            ..Terrain::flat()
        };
        let functions: [fn(&Terrain, f64) -> Profile; 3] =
            [Terrain::height, Terrain::forbidden, Terrain::obstacle];
        for f in functions {
            for x in [0.09, 0.1, 0.172, 0.495, 0.503, 0.84, 0.87, 0.93] {
                let h = 1e-6;
                let (low, at, high) = (f(&terrain, x - h), f(&terrain, x), f(&terrain, x + h));
                let slope = (high.value - low.value) / (2.0 * h);
                let curvature = (high.slope - low.slope) / (2.0 * h);
                assert!((slope - at.slope).abs() < 1e-6 * (1.0 + slope.abs()), "{x}");
                assert!((curvature - at.curvature).abs() < 1e-5 * (1.0 + curvature.abs()), "{x}");
            }
        }
    }

    #[test]
    fn the_profile_covers_the_box() {
        let box_at = Obstacle { x_m: 0.9, height_m: 0.16, thickness_m: 0.08 };
        let terrain = Terrain { obstacles: vec![box_at], ..Terrain::flat() };
        for k in 0..=80 {
            let x = 0.86 + 0.001 * f64::from(k);
            assert!(terrain.obstacle(x).value > 0.179, "{x}");
        }
        assert!((terrain.distance_to_boxes(0.9, 0.17) - 0.01).abs() < 1e-15);
        assert!((terrain.distance_to_boxes(0.85, 0.1) - 0.01).abs() < 1e-15);
        assert!((terrain.distance_to_boxes(0.9, 0.15) + 0.01).abs() < 1e-15);
    }
}
