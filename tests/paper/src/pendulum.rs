//! The pendulums of section 5 and their random initial conditions.
//!
//! | name | link | inertia about the mass centre | gravity |
//! |---|---|---|---|
//! | [`Links::Rods`] | 1 m, 1 kg, mass centre in its middle | 1/12 kg m² across, 1e-3 kg m² along | 9.81 m/s² |
//! | [`Links::UnitInertia`] | 1.5 m, 1 kg, mass centre in its middle | 1 kg m² about every axis | none |
//!
//! The second one is the serial chain of J. Lee, C. K. Liu, F. C. Park, S. S. Srinivasa, *A linear-time variational integrator for
//! multibody systems*, WAFR 2016. All joints turn about the same axis; `q = 0` hangs straight down.

use delmpc_mechanics::prelude::*;

/// What a pendulum is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Links {
    /// Thin rods under gravity.
    Rods,
    /// Unit inertias without gravity.
    UnitInertia,
}

impl Links {
    /// Length of a link, m.
    pub fn length(self) -> f64 {
        match self {
            Self::Rods => 1.0,
            Self::UnitInertia => 1.5,
        }
    }

    /// Name in files.
    pub fn key(self) -> &'static str {
        match self {
            Self::Rods => "rods",
            Self::UnitInertia => "unit_inertia",
        }
    }

    /// Name in plots.
    pub fn title(self) -> &'static str {
        match self {
            Self::Rods => "1 m, 1 kg rods, gravity",
            Self::UnitInertia => "1.5 m links, unit inertia, no gravity",
        }
    }
}

/// A pendulum of `n` links.
///
/// # Errors
/// None for `n >= 1`; an empty tree is refused.
pub fn pendulum(links: Links, n: usize) -> Result<KinematicTree, ModelError> {
    let (length, gravity, inertia) = match links {
        Links::Rods => (links.length(), -9.81, Vector3::new(1.0 / 12.0, 1.0 / 12.0, 1e-3)),
        Links::UnitInertia => (links.length(), 0.0, Vector3::new(1.0, 1.0, 1.0)),
    };
    let link = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.5 * length), Matrix3::from_diagonal(&inertia));
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, gravity));
    let mut parent = None;
    for i in 0..n {
        let height = if i == 0 { 0.0 } else { -length };
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, height));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(Vector3::y(), placement), link)));
    }
    builder.build()
}

/// Independent uniform numbers: SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, *Fast splittable pseudorandom number generators*, OOPSLA
/// 2014). The same seed gives the same experiment everywhere.
#[derive(Clone, Debug)]
pub struct Uniform(u64);

impl Uniform {
    /// A stream of its own for every seed.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next number in `[-half, half)`.
    pub fn symmetric(&mut self, half: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        half * (2.0 * ((z >> 11) as f64 / (1u64 << 53) as f64) - 1.0)
    }

    /// The next `n` numbers in `[-half, half)`.
    pub fn vector(&mut self, n: usize, half: f64) -> Vec<f64> {
        (0..n).map(|_| self.symmetric(half)).collect()
    }
}

/// Angles (rad) and rates (rad/s), each uniform in `[-half, half)`.
#[derive(Clone, Debug)]
pub struct Initial {
    /// Joint angles, rad.
    pub q: Vec<f64>,
    /// Joint rates, rad/s.
    pub v: Vec<f64>,
}

/// `count` initial conditions of a pendulum of `n` links.
pub fn initial_conditions(n: usize, count: usize, half: f64, seed: u64) -> Vec<Initial> {
    let mut uniform = Uniform::new(seed);
    (0..count).map(|_| Initial { q: uniform.vector(n, half), v: uniform.vector(n, half) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_fill_the_interval_and_repeat() {
        let numbers = Uniform::new(1).vector(20_000, 2.0);
        assert_eq!(numbers, Uniform::new(1).vector(20_000, 2.0));
        assert_ne!(numbers, Uniform::new(2).vector(20_000, 2.0));
        assert!(numbers.iter().all(|x| (-2.0..2.0).contains(x)));
        let mean = numbers.iter().sum::<f64>() / 20_000.0;
        let square = numbers.iter().map(|x| x * x).sum::<f64>() / 20_000.0;
        // Standard errors: 0.008 and 0.0084.
        assert!(mean.abs() < 0.04 && (square - 4.0 / 3.0).abs() < 0.04, "{mean} {square}");
    }

    #[test]
    fn pendulums_weigh_what_the_table_says() {
        for links in [Links::Rods, Links::UnitInertia] {
            let tree = pendulum(links, 5).unwrap();
            assert_eq!((tree.joint_count(), tree.total_mass()), (5, 5.0));
            assert_eq!(tree.gravity_w().norm() > 0.0, links == Links::Rods);
        }
    }
}
