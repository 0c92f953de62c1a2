//! Where the blocks of the interface vectors `ζ` and `y` of Algorithm B.1 stand.

use crate::lobatto::MAX_UNKNOWN_NODES;

pub(crate) const MAX_NODES: usize = MAX_UNKNOWN_NODES + 1;

/// Where the blocks of the interface vectors are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Interface {
    pub s: usize,
    /// Rows of one `η` block: 3, or 6 with general wrenches.
    pub eta: usize,
    /// First node with a `DΓ` block: 1, or 0 with general wrenches.
    pub first_impulse: usize,
    /// Also `η^0` and `DΓ^s`, which the linearisation needs ([`crate::recursive_linearize`]); not with general wrenches.
    pub whole_step: bool,
}

impl Interface {
    /// First node with an `η` block.
    #[inline(always)]
    fn first_eta(&self) -> usize {
        usize::from(!self.whole_step)
    }
    #[inline(always)]
    pub fn inputs(&self) -> usize {
        self.eta * (self.s - self.first_eta()) + 6 * (self.s + 1)
    }
    #[inline(always)]
    pub fn outputs(&self) -> usize {
        6 * (self.s + 1) + 6 * (self.s + usize::from(self.whole_step) - self.first_impulse)
    }
    #[inline(always)]
    pub fn eta_at(&self, gamma: usize) -> usize {
        self.eta * (gamma - self.first_eta())
    }
    /// Component `k` of `ν^β`. Components are outermost: a component at all nodes stands together, as in the lanes of Algorithm 1.
    #[inline(always)]
    pub fn nu_at(&self, beta: usize, k: usize) -> usize {
        self.eta * (self.s - self.first_eta()) + k * (self.s + 1) + beta
    }
    /// Component `k` of `Dμ^β`, in the order of `ν`.
    #[inline(always)]
    pub fn momentum_at(&self, beta: usize, k: usize) -> usize {
        k * (self.s + 1) + beta
    }
    #[inline(always)]
    pub fn impulse_at(&self, alpha: usize) -> usize {
        6 * (self.s + 1) + 6 * (alpha - self.first_impulse)
    }
}
