//! Reading the pair terms: one pair of bodies, one joint and the base.
//!
//! Letters and equations: [`super`].

use crate::lanes::{LANES, Quad};

/// One node of a 6-vector.
#[inline(always)]
pub(super) fn lane(quads: &[Quad; 6], node: usize) -> [f64; 6] {
    let mut out = [0.0; 6];
    for k in 0..6 {
        out[k] = quads[k].0[node % LANES];
    }
    out
}

/// The asymmetric part at equal nodes.
#[inline(always)]
pub(super) fn skew(lanes: &[Quad], alpha: usize, gamma: usize) -> f64 {
    if alpha == gamma && !lanes.is_empty() { lanes[alpha / LANES].0[alpha % LANES] } else { 0.0 }
}

/// `H` of one pair of coordinates.
#[derive(Clone, Copy)]
pub(crate) struct PairBlock<'a> {
    pub(super) own: &'a [Quad],
    pub(super) mirror: &'a [Quad],
    pub(super) symmetric: bool,
    pub(super) groups: usize,
    /// What the mirror image has less at equal nodes (lanes); empty without held torques.
    pub(super) skew: &'a [Quad],
}

impl PairBlock<'_> {
    /// `H[α,γ]` with the joint of the body as row.
    #[inline(always)]
    pub fn entry(&self, alpha: usize, gamma: usize) -> f64 {
        self.own[alpha * self.groups + gamma / LANES].0[gamma % LANES]
    }

    /// `H[α,γ]` with the branch coordinate as row.
    #[inline(always)]
    pub fn mirrored(&self, alpha: usize, gamma: usize) -> f64 {
        if self.symmetric {
            return self.entry(gamma, alpha) - skew(self.skew, alpha, gamma);
        }
        self.mirror[alpha * self.groups + gamma / LANES].0[gamma % LANES]
    }
}

/// The Newton matrix between a joint and the base: `H` with the column rule of the module doc.
#[derive(Clone, Copy)]
pub(crate) struct JointAndBase<'a> {
    pub(super) blocks: &'a [Quad],
    pub(super) mirror: &'a [Quad],
    pub(super) shifts: &'a [[Quad; 6]],
    pub(super) impulses: &'a [[Quad; 6]],
    pub(super) s: usize,
    pub(super) groups: usize,
    /// As in [`PairBlock`], six pairs.
    pub(super) skew: &'a [Quad],
}

impl JointAndBase<'_> {
    /// Row α of the joint, column γ of base coordinate `k`.
    #[inline(always)]
    pub fn joint_row(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        let plain = self.plain(k, alpha, gamma);
        if gamma < self.s {
            return plain;
        }
        plain + (self.shifts[alpha / LANES][k].0[alpha % LANES] - self.plain(k, alpha, 0))
    }

    /// Row α of base coordinate `k`, column γ of the joint.
    #[inline(always)]
    pub fn base_row(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        let plain = self.mirrored(k, alpha, gamma);
        if alpha > 0 {
            return plain;
        }
        plain + (self.impulses[gamma / LANES][k].0[gamma % LANES] - self.mirrored(k, self.s, gamma))
    }

    #[inline(always)]
    pub(super) fn plain(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        self.blocks[(k * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }

    #[inline(always)]
    pub(super) fn mirrored(&self, k: usize, alpha: usize, gamma: usize) -> f64 {
        if self.mirror.is_empty() {
            let own =
                if self.skew.is_empty() { &[] } else { &self.skew[k * self.groups..(k + 1) * self.groups] };
            return self.plain(k, gamma, alpha) - skew(own, alpha, gamma);
        }
        self.mirror[(k * (self.s + 1) + alpha) * self.groups + gamma / LANES].0[gamma % LANES]
    }
}
