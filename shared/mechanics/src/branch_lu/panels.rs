//! Panels from the Hessian blocks.

use crate::del_hessian::DelHessian;
use crate::lanes::{LANES, Quad};

/// Where the blocks of a joint go.
pub(super) struct JointPanels<'a> {
    pub hessian: &'a DelHessian,
    pub body: usize,
    /// `J_ij`, j on the branch: row α is node α, column `place * s + γ - 1`.
    pub rows: &'a mut [Quad],
    /// `J_ji` transposed, without the joint itself: row `γ - 1`, column `place * s + α`.
    pub columns: &'a mut [Quad],
}

/// Copies the blocks; lanes behind the last one become zero.
pub(super) fn fill_joint_panels(panels: JointPanels<'_>, s: usize) {
    match (s, panels.hessian.is_symmetric()) {
        (1, true) => fill_symmetric::<1>(panels),
        (2, true) => fill_symmetric::<2>(panels),
        (3, true) => fill_symmetric::<3>(panels),
        (s, _) => fill_any(panels, s),
    }
}

/// Up to three unknown nodes: a row of a block is one quad. Four blocks fill `N` quads of every row.
#[inline(always)]
fn fill_symmetric<const N: usize>(panels: JointPanels<'_>) {
    let JointPanels { hessian, body, rows, columns } = panels;
    let blocks = hessian.body_blocks(body);
    let others = &blocks[..blocks.len() - (N + 1)];
    // J_ij[α,γ] = H_ij[α,γ], and J_ji[α,γ] = H_ij[γ,α].
    fill::<N>(rows, blocks, 0, 1);
    fill::<N>(columns, others, 1, 0);
    for place in 0..others.len() / (N + 1) {
        if let Some(skew) = hessian.skew_of(hessian.pair_starts[body] + place, 1, 1).first() {
            for alpha in 1..N {
                let at = place * N + alpha;
                columns[at / LANES * N + alpha - 1].0[at % LANES] -= skew.0[alpha];
            }
        }
    }
}

/// Row α of the panel from rows `first_row + α` of the blocks, from lane `first_lane` on.
#[inline(always)]
fn fill<const N: usize>(panel: &mut [Quad], blocks: &[Quad], first_row: usize, first_lane: usize) {
    let stride = N + 1;
    for (quads, four) in panel.chunks_mut(N * N).zip(blocks.chunks(LANES * stride)) {
        for alpha in 0..N {
            let mut row = [[0.0; LANES]; N];
            if four.len() == LANES * stride {
                for place in 0..LANES {
                    for k in 0..N {
                        let at = place * N + k;
                        row[at / LANES][at % LANES] =
                            four[place * stride + first_row + alpha].0[first_lane + k];
                    }
                }
            } else {
                for (place, block) in four.chunks_exact(stride).enumerate() {
                    for k in 0..N {
                        let at = place * N + k;
                        row[at / LANES][at % LANES] = block[first_row + alpha].0[first_lane + k];
                    }
                }
            }
            for (q, values) in row.iter().enumerate() {
                if let Some(quad) = quads.get_mut(q * N + alpha) {
                    quad.0 = *values;
                }
            }
        }
    }
}

fn fill_any(panels: JointPanels<'_>, s: usize) {
    let JointPanels { hessian, body, rows, columns } = panels;
    let pairs = hessian.pair_starts[body]..hessian.pair_starts[body + 1];
    rows.fill(Quad::ZERO);
    columns.fill(Quad::ZERO);
    for (place, pair) in pairs.clone().enumerate() {
        for alpha in 0..s {
            for gamma in 0..s {
                let at = place * s + gamma;
                rows[at / LANES * s + alpha].0[at % LANES] = hessian.entry(pair, alpha, gamma + 1);
                if pair + 1 < pairs.end {
                    let at = place * s + alpha;
                    columns[at / LANES * s + gamma].0[at % LANES] = hessian.mirrored(pair, alpha, gamma + 1);
                }
            }
        }
    }
}
