//! Where the unknowns of a stage are.
//!
//! ```text
//! stage vector z_k = [ Y_k | X_k | X_{k+1} ]      X = (q, v, t)      Y = (q^½, u, contacts, sole wrench)
//! plan vector      = [ Y_0 .. Y_{N-1} | X_0 .. X_N ]
//! ```
//!
//! `Y` comes first in a stage: a partial Cholesky of its columns leaves the Schur complement of the boundaries.

/// Sizes and offsets of one stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Coordinates.
    pub n: usize,
    /// Driven coordinates.
    pub inputs: usize,
    /// Contact points.
    pub contacts: usize,
    /// Unknown impulses and slip bounds of a contact.
    pub impulses: usize,
    /// Unknown wrench components of a standing sole over the three nodes (0 or 18).
    pub wrench: usize,
    /// Size of `Y`.
    pub inner: usize,
    /// Size of `X`.
    pub boundary: usize,
    /// Size of a stage vector.
    pub stage: usize,
}

impl Layout {
    /// Lays the unknowns out.
    pub fn new(n: usize, inputs: usize, contacts: usize, impulses: usize, wrench: usize) -> Self {
        let inner = n + inputs + contacts * impulses + wrench;
        let boundary = 2 * n + 1;
        Self { n, inputs, contacts, impulses, wrench, inner, boundary, stage: inner + 2 * boundary }
    }
    /// `q^½_j`.
    pub fn middle(&self, j: usize) -> usize {
        j
    }
    /// `u_j`.
    pub fn input(&self, j: usize) -> usize {
        self.n + j
    }
    /// First unknown of a contact.
    pub fn contact(&self, i: usize) -> usize {
        self.n + self.inputs + i * self.impulses
    }
    /// First component of the sole's wrench at a node.
    pub fn sole(&self, node: usize) -> usize {
        self.n + self.inputs + self.contacts * self.impulses + 6 * node
    }
    /// `q_j` at the start (`end = 0`) or end (1).
    pub fn q(&self, end: usize, j: usize) -> usize {
        self.inner + end * self.boundary + j
    }
    /// `v_j` at the start or end.
    pub fn v(&self, end: usize, j: usize) -> usize {
        self.inner + end * self.boundary + self.n + j
    }
    /// The time at the start or end.
    pub fn t(&self, end: usize) -> usize {
        self.inner + end * self.boundary + 2 * self.n
    }
    /// Coordinate `j` at node α (0, ½, 1).
    pub fn node(&self, alpha: usize, j: usize) -> usize {
        match alpha {
            0 => self.q(0, j),
            1 => self.middle(j),
            _ => self.q(1, j),
        }
    }
    /// Size of a plan vector.
    pub fn plan(&self, stages: usize) -> usize {
        stages * (self.inner + self.boundary) + self.boundary
    }
    /// Where `Y_k` begins in a plan vector.
    pub fn inner_at(&self, k: usize) -> usize {
        k * self.inner
    }
    /// Where `X_k` begins in a plan vector of `stages`.
    pub fn boundary_at(&self, stages: usize, k: usize) -> usize {
        stages * self.inner + k * self.boundary
    }
    /// Copies `z_k` out of a plan vector.
    pub fn gather(&self, stages: usize, k: usize, plan: &[f64], z: &mut [f64]) {
        let (inner, ends) = z.split_at_mut(self.inner);
        inner.copy_from_slice(&plan[self.inner_at(k)..self.inner_at(k + 1)]);
        let at = self.boundary_at(stages, k);
        ends.copy_from_slice(&plan[at..at + 2 * self.boundary]);
    }
    /// Adds a stage vector to a plan vector.
    pub fn scatter_add(&self, stages: usize, k: usize, z: &[f64], plan: &mut [f64]) {
        let (inner, ends) = z.split_at(self.inner);
        for (x, z) in plan[self.inner_at(k)..].iter_mut().zip(inner) {
            *x += z;
        }
        for (x, z) in plan[self.boundary_at(stages, k)..].iter_mut().zip(ends) {
            *x += z;
        }
    }
}
