//! Mass properties of links: the rules every real body obeys, and the nearest body for those that break them.
//!
//! Principal moments must satisfy `0 <= I1 <= I2 <= I3 <= I1 + I2`. Repair clamps negative moments to zero and moves the
//! three moments by the same amount, `(+d, +d, -d)/3` with `d = I3 - I1 - I2`, which is the nearest point that obeys.

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::tree::{LinkInertia, TreeBuilder};
use nalgebra::{Matrix3, Vector3};

/// The rule of [`delmpc_mechanics`] that a single body with this inertia would break, if any.
pub(crate) fn check(inertia: &LinkInertia) -> Result<(), ModelError> {
    match TreeBuilder::floating_base(Vector3::zeros(), *inertia).build() {
        Ok(_) | Err(ModelError::MasslessSubtree { .. }) => Ok(()),
        Err(error) => Err(error),
    }
}

/// Model files have as few as three digits: a plate may break the triangle inequality by this part of its largest moment.
const ROUND_OFF: f64 = 5e-3;

/// Whether the triangle inequality is broken by no more than the digits of a model file.
pub(crate) fn is_round_off(inertia: &LinkInertia) -> bool {
    let Err(ModelError::InertiaTriangle { excess, .. }) = check(inertia) else { return false };
    excess <= ROUND_OFF * inertia.inertia.symmetric_eigenvalues().amax()
}

/// Square of a length that no link of a robot is shorter than, m²: inertias below mass times this are round-off around 0.
const SHORTEST_M2: f64 = 1e-14;

/// The inertia, 0 where it is nothing but round-off: the remains of a difference, of either sign.
pub(crate) fn without_round_off(inertia: LinkInertia) -> LinkInertia {
    let is_nothing = inertia.mass > 0.0 && inertia.inertia.amax() <= SHORTEST_M2 * inertia.mass;
    if is_nothing { LinkInertia { inertia: Matrix3::zeros(), ..inertia } } else { inertia }
}

/// The nearest inertia that a body can have, keeping mass, mass centre and principal axes.
pub(crate) fn repair(inertia: &LinkInertia) -> LinkInertia {
    let symmetric = (inertia.inertia + inertia.inertia.transpose()) * 0.5;
    let eigen = symmetric.symmetric_eigen();
    let mut moments = eigen.eigenvalues.map(|moment| moment.max(0.0));
    let excess = 2.0 * moments.max() - moments.sum();
    if excess > 0.0 {
        let largest = moments.imax();
        for (place, moment) in moments.iter_mut().enumerate() {
            *moment += if place == largest { -excess } else { excess } / 3.0;
        }
    }
    let repaired = eigen.eigenvectors * Matrix3::from_diagonal(&moments) * eigen.eigenvectors.transpose();
    let inertia_of_mass = if inertia.mass > 0.0 { repaired } else { Matrix3::zeros() };
    LinkInertia { inertia: (inertia_of_mass + inertia_of_mass.transpose()) * 0.5, ..*inertia }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repaired_inertias_pass() {
        for diagonal in [[1.0, 1.0, 5.0], [-1.0, 2.0, 2.0], [0.0, 0.0, 1.0], [-1.0, -2.0, 3.0]] {
            let rotation = delmpc_mechanics::spatial::exp_rotation(&Vector3::new(0.3, -0.8, 0.4));
            let matrix = rotation * Matrix3::from_diagonal(&Vector3::from(diagonal)) * rotation.transpose();
            let inertia = LinkInertia::new(1.0, Vector3::zeros(), (matrix + matrix.transpose()) * 0.5);
            assert!(check(&inertia).is_err());
            assert_eq!(check(&repair(&inertia)), Ok(()), "{diagonal:?}");
        }
        let good = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity());
        assert_eq!(repair(&good), good);
    }
}
