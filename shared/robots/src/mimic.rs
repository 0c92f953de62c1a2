//! Mimic joints: reduced coordinates, `q_full = T q + c`.
//!
//! A body of a [`KinematicTree`](delmpc_mechanics::tree::KinematicTree) has one coordinate of its own, so a mimic joint is a full
//! coordinate in the tree and a row here. As `T` and `c` are constant, everything linear projects exactly:
//!
//! ```text
//! q_full = T q + c     q̇_full = T q̇     τ = Tᵀ τ_full     H = Tᵀ H_full T     bias = Tᵀ bias_full
//! ```
//!
//! | with mimic joints | |
//! |---|---|
//! | kinematics, Jacobians, energies, mass matrix, gravity and bias forces, momenta | supported through this map |
//! | the integrator's step, the plant and the controller | not supported: they move every coordinate of the tree freely ([`CoordinateMap::is_identity`] tells) |

use delmpc_mechanics::errors::ModelError;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    /// Reduced coordinate that drives this joint.
    source: usize,
    multiplier: f64,
    offset: f64,
}

/// The constant affine map from reduced to full joint coordinates.
#[derive(Clone, Debug, PartialEq)]
pub struct CoordinateMap {
    rows: Vec<Row>,
    independent: Vec<usize>,
}

/// A joint that follows another: `q = multiplier * q_source + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Follower {
    pub joint: usize,
    pub source: usize,
    pub multiplier: f64,
    pub offset: f64,
}

impl CoordinateMap {
    /// The map without mimic joints.
    pub(crate) fn identity(joints: usize) -> Self {
        let rows = (0..joints).map(|source| Row { source, multiplier: 1.0, offset: 0.0 }).collect();
        Self { rows, independent: (0..joints).collect() }
    }

    /// From the joints that follow others; chains are resolved. `Err` names a joint of a ring and the one it follows.
    pub(crate) fn new(joints: usize, followers: &[Follower]) -> Result<Self, (usize, usize)> {
        let mut follows = vec![None; joints];
        for follower in followers {
            follows[follower.joint] = Some(follower);
        }
        let independent: Vec<usize> = (0..joints).filter(|&joint| follows[joint].is_none()).collect();
        let mut reduced = vec![usize::MAX; joints];
        for (place, &joint) in independent.iter().enumerate() {
            reduced[joint] = place;
        }
        let mut rows = Vec::with_capacity(joints);
        for joint in 0..joints {
            let (mut source, mut multiplier, mut offset) = (joint, 1.0, 0.0);
            let mut steps = 0;
            while let Some(follower) = follows[source] {
                offset += multiplier * follower.offset;
                multiplier *= follower.multiplier;
                source = follower.source;
                steps += 1;
                if steps > joints {
                    return Err((joint, source));
                }
            }
            rows.push(Row { source: reduced[source], multiplier, offset });
        }
        Ok(Self { rows, independent })
    }

    /// The same map with the joints in another order: new joint `k` is old joint `old[k]`.
    pub(crate) fn permuted(&self, old: &[usize]) -> Self {
        let mut new_of_old = vec![0; old.len()];
        for (new, &old) in old.iter().enumerate() {
            new_of_old[old] = new;
        }
        let mut order: Vec<(usize, usize)> = self
            .independent
            .iter()
            .enumerate()
            .map(|(reduced, &joint)| (new_of_old[joint], reduced))
            .collect();
        order.sort_unstable();
        let mut new_reduced = vec![0; order.len()];
        for (place, &(_, reduced)) in order.iter().enumerate() {
            new_reduced[reduced] = place;
        }
        let rows = old
            .iter()
            .map(|&old| Row { source: new_reduced[self.rows[old].source], ..self.rows[old] })
            .collect();
        Self { rows, independent: order.into_iter().map(|(joint, _)| joint).collect() }
    }

    /// Whether there are no mimic joints.
    pub fn is_identity(&self) -> bool {
        self.independent.len() == self.rows.len()
    }

    /// Number of joint coordinates of the tree.
    pub fn full_len(&self) -> usize {
        self.rows.len()
    }

    /// Number of reduced coordinates.
    pub fn reduced_len(&self) -> usize {
        self.independent.len()
    }

    /// The joints that move by themselves: joint index of every reduced coordinate.
    pub fn independent_joints(&self) -> &[usize] {
        &self.independent
    }

    /// Reduced coordinate, multiplier and offset of a joint.
    pub fn row(&self, joint: usize) -> (usize, f64, f64) {
        let Row { source, multiplier, offset } = self.rows[joint];
        (source, multiplier, offset)
    }

    /// `full = T reduced + c`: coordinates.
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices of the wrong length.
    pub fn expand_into(&self, reduced: &[f64], full: &mut [f64]) -> Result<(), ModelError> {
        self.expand_rates_into(reduced, full)?;
        for (value, row) in full.iter_mut().zip(&self.rows) {
            *value += row.offset;
        }
        Ok(())
    }

    /// `full = T reduced`: rates, accelerations, virtual displacements.
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices of the wrong length.
    pub fn expand_rates_into(&self, reduced: &[f64], full: &mut [f64]) -> Result<(), ModelError> {
        length("reduced coordinates", reduced.len(), self.reduced_len())?;
        length("full coordinates", full.len(), self.full_len())?;
        for (value, row) in full.iter_mut().zip(&self.rows) {
            *value = row.multiplier * reduced[row.source];
        }
        Ok(())
    }

    /// `reduced = Tᵀ full`: forces, momenta, gradients.
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices of the wrong length.
    pub fn project_forces_into(&self, full: &[f64], reduced: &mut [f64]) -> Result<(), ModelError> {
        length("full forces", full.len(), self.full_len())?;
        length("reduced forces", reduced.len(), self.reduced_len())?;
        reduced.fill(0.0);
        for (value, row) in full.iter().zip(&self.rows) {
            reduced[row.source] += row.multiplier * value;
        }
        Ok(())
    }

    /// `reduced = Tᵀ full T` for a row-major matrix whose first `base_dof` coordinates are those of a floating base (0 or 6).
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices of the wrong length.
    pub fn project_matrix_into(
        &self,
        base_dof: usize,
        full: &[f64],
        reduced: &mut [f64],
    ) -> Result<(), ModelError> {
        let (n, m) = (base_dof + self.full_len(), base_dof + self.reduced_len());
        length("full matrix", full.len(), n * n)?;
        length("reduced matrix", reduced.len(), m * m)?;
        reduced.fill(0.0);
        let place = |coordinate: usize| match coordinate.checked_sub(base_dof) {
            Some(joint) => (base_dof + self.rows[joint].source, self.rows[joint].multiplier),
            None => (coordinate, 1.0),
        };
        for i in 0..n {
            let (row, row_factor) = place(i);
            for j in 0..n {
                let (column, column_factor) = place(j);
                reduced[row * m + column] += row_factor * column_factor * full[i * n + j];
            }
        }
        Ok(())
    }
}

fn length(quantity: &'static str, got: usize, expected: usize) -> Result<(), ModelError> {
    if got == expected { Ok(()) } else { Err(ModelError::Length { quantity, got, expected }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain() -> CoordinateMap {
        let follow = |joint, source, multiplier, offset| Follower { joint, source, multiplier, offset };
        CoordinateMap::new(4, &[follow(0, 2, 2.0, 0.5), follow(2, 3, -1.0, 0.25)]).unwrap()
    }

    #[test]
    fn chains_are_resolved() {
        let map = chain();
        assert_eq!(map.independent_joints(), [1, 3]);
        let mut full = [0.0; 4];
        map.expand_into(&[7.0, 2.0], &mut full).unwrap();
        assert_eq!(full, [2.0 * (-2.0 + 0.25) + 0.5, 7.0, -1.75, 2.0]);
        let mut forces = [0.0; 2];
        map.project_forces_into(&[1.0, 10.0, 100.0, 1000.0], &mut forces).unwrap();
        assert_eq!(forces, [10.0, 1000.0 - 100.0 - 2.0]);
        assert!(map.expand_into(&[0.0], &mut full).is_err());
    }

    #[test]
    fn matrices_project_as_the_quadratic_form() {
        let map = chain();
        let full: Vec<f64> = (0..25).map(|k| f64::from(k * k % 7)).collect();
        let mut reduced = [0.0; 9];
        map.project_matrix_into(1, &full, &mut reduced).unwrap();
        let x = [0.3, -1.0, 2.0];
        let mut rates = [0.0; 4];
        map.expand_rates_into(&x[1..], &mut rates).unwrap();
        let y = [x[0], rates[0], rates[1], rates[2], rates[3]];
        let form = |matrix: &[f64], x: &[f64]| -> f64 {
            let n = x.len();
            (0..n * n).map(|k| matrix[k] * x[k / n] * x[k % n]).sum()
        };
        assert!((form(&full, &y) - form(&reduced, &x)).abs() < 1e-12);
    }

    #[test]
    fn rings_are_found_and_orders_changed() {
        let follow = |joint, source| Follower { joint, source, multiplier: 1.0, offset: 0.0 };
        assert!(CoordinateMap::new(3, &[follow(0, 1), follow(1, 0)]).is_err());
        assert!(CoordinateMap::new(3, &[follow(2, 2)]).is_err());
        let map = chain().permuted(&[3, 2, 1, 0]);
        assert_eq!(map.independent_joints(), [0, 2]);
        let mut full = [0.0; 4];
        map.expand_into(&[2.0, 7.0], &mut full).unwrap();
        assert_eq!(full, [2.0, -1.75, 7.0, -3.0]);
        assert!(CoordinateMap::identity(3).is_identity() && !map.is_identity());
    }
}
