//! Torques that keep their direction in {0}: what a flat foot takes from the ground.

use alloc::vec::Vec;

use super::DelWorkspace;
use crate::lanes::{LANES, Quad};

/// A torque that keeps its direction in {0}. Its gain `τ×η_ω` is not symmetric. In workspaces with wrenches of the general kind it goes
/// with these, else with the loads ([`crate::del_hessian`] corrects the mirror images). Algorithm B.1 does not know it.
#[derive(Clone, Debug)]
pub(crate) struct HeldTorque {
    pub body: usize,
    /// N·m at the nodes: one 3-vector per lane group.
    pub torque_w: Vec<[Quad; 3]>,
}

impl DelWorkspace {
    /// Whether something besides gravity acts that keeps its direction in {0}.
    #[inline(always)]
    pub(crate) fn has_dead_loads(&self) -> bool {
        !self.loads.is_empty() || !self.dead_torques().is_empty()
    }

    /// Held torques that go with the loads.
    #[inline(always)]
    pub(crate) fn dead_torques(&self) -> &[HeldTorque] {
        if self.gains.is_empty() { &self.held_torques } else { &[] }
    }

    pub(super) fn add_torques_to_gains(&mut self) {
        for held in &self.held_torques {
            for (g, [x, y, z]) in held.torque_w.iter().enumerate() {
                let gain = &mut self.gains[held.body * self.groups + g];
                for lane in 0..LANES {
                    let (x, y, z) = (x.0[lane], y.0[lane], z.0[lane]);
                    for (k, value) in [x, y, z].into_iter().enumerate() {
                        gain.wrench[k].0[lane] += value;
                    }
                    // τ^
                    for (at, value) in [(1, -z), (2, y), (6, z), (8, -x), (12, -y), (13, x)] {
                        gain.eta[at].0[lane] += value;
                    }
                }
            }
        }
    }
}
