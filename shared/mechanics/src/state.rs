//! The state `(q, p)` of the discrete mechanics at a step boundary.

use alloc::vec;
use alloc::vec::Vec;

use crate::errors::StepError;
use crate::spatial::RigidTransform;
use crate::tree::KinematicTree;

/// Configuration and discrete momentum at a step boundary.
///
/// | field | fixed base | floating base |
/// |---|---|---|
/// | `base_pose` | not used (identity) | base body frame in {0}: link axes, origin at the **mass centre** |
/// | `q` | joint coordinates, rad or m | the same |
/// | `p` | joint momenta `∂L/∂q̇` | total spatial momentum `P` in {0} about its origin (angular, linear), then joint momenta |
///
/// At a step boundary `p = M(q) q̇` to the order of the integrator (2s); see [`crate::mass_matrix`].
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    /// Pose of the floating base's body frame in {0}.
    pub base_pose: RigidTransform,
    /// Joint coordinates, one per joint.
    pub q: Vec<f64>,
    /// Discrete momentum, one per generalised coordinate.
    pub p: Vec<f64>,
}

impl State {
    /// All coordinates and momenta zero, base at the origin.
    pub fn zeros(tree: &KinematicTree) -> Self {
        Self {
            base_pose: RigidTransform::identity(),
            q: vec![0.0; tree.joint_count()],
            p: vec![0.0; tree.dof()],
        }
    }

    /// Copies another state of the same tree without allocating.
    pub fn copy_from(&mut self, other: &State) {
        self.base_pose = other.base_pose;
        self.q.copy_from_slice(&other.q);
        self.p.copy_from_slice(&other.p);
    }

    /// Refuses a state with a number that is NaN or infinite. O(n), no allocation.
    ///
    /// # Errors
    /// [`StepError::NonFinite`] naming the first one.
    pub fn check_finite(&self) -> Result<(), StepError> {
        let pose = &self.base_pose;
        let parts: [(&'static str, &[f64]); 4] = [
            ("joint coordinate", &self.q),
            ("momentum", &self.p),
            ("base rotation", pose.rotation.as_slice()),
            ("base position", pose.translation.as_slice()),
        ];
        for (quantity, values) in parts {
            if let Some(index) = values.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity, index });
            }
        }
        Ok(())
    }
}
