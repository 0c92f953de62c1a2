//! Branch-sparse block elimination of a vector of stages, leaves first, without fill-in, and its solves.
//!
//! Newton matrix and velocity at the end are one system with 3 x 3 blocks per pair of joints (module doc of
//! [`crate::stage_batch`]). Its blocks are block lower triangular, so the elimination of the Newton matrix and of the mass
//! matrix never meet, except in the row of velocities:
//!
//! ```text
//! factor  for i = n..1:  V_ib = J_ii⁻¹ J_ib      g_ib = M_ii⁻¹ (G_ib - G_ii V_ib)      l_ib = M_ii⁻¹ M_ib          (a, b in anc i)
//!                        J_ab -= J_ai V_ib       G_ab -= G_ai V_ib + M_ai g_ib         M_ab -= M_ai l_ib
//! solve   for a = n..1:  x_a -= Σ_k J_ak x_k     v_a -= Σ_k (G_ak x_k + M_ak v_k)      (k beyond a)
//!                        x_a := J_aa⁻¹ x_a       v_a := M_aa⁻¹ (v_a - G_aa x_a)
//!         for i = 1..n:  x_i -= Σ_b V_ib x_b     v_i -= Σ_b (g_ib x_b + l_ib v_b)      (b in anc i)
//! ```

use super::column_plan::{Block, SIDE};
use super::memory::{BackwardPanel, Batch, ForwardPanel, JOINTS_AT_ONCE, Scratch};
use super::plan::Plan;
use super::{TransitionOutput, WEIGHTS};
use crate::stage_lanes::{StageKernel, StageMemory, StageSimd, Stages, load};

/// Eliminates the Newton matrix; with `full` also the rows of velocities. The mass matrix has its factor already.
pub(crate) struct Factor<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a mut Batch<M>,
    pub scratch: &'a mut Scratch<M>,
    pub full: bool,
}

/// Row-major 2 x 2.
type Block2<S> = [Stages<S>; 4];

/// `target - a b`.
#[inline(always)]
fn update<S: StageSimd>(target: Block2<S>, a: &Block2<S>, b: &Block2<S>) -> Block2<S> {
    [
        a[1].neg_mul_add(b[2], a[0].neg_mul_add(b[0], target[0])),
        a[1].neg_mul_add(b[3], a[0].neg_mul_add(b[1], target[1])),
        a[3].neg_mul_add(b[2], a[2].neg_mul_add(b[0], target[2])),
        a[3].neg_mul_add(b[3], a[2].neg_mul_add(b[1], target[3])),
    ]
}

#[inline(always)]
fn load2<S: StageSimd>(simd: S, panel: &[S::Memory; 7]) -> Block2<S> {
    let mut block = [Stages::load(simd, &panel[0]); 4];
    for k in 1..4 {
        block[k] = Stages::load(simd, &panel[k]);
    }
    block
}

#[inline(always)]
fn store2<S: StageSimd>(panel: &mut [S::Memory; 7], block: Block2<S>) {
    for k in 0..4 {
        panel[k] = block[k].store();
    }
}

impl<M: StageMemory> StageKernel<M> for Factor<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch, full } = self;
        for i in (0..plan.n).rev() {
            eliminate(simd, plan, batch, scratch, i);
        }
        if full {
            for i in (0..plan.n).rev() {
                eliminate_velocity(simd, plan, scratch, i);
            }
        }
    }
}

#[inline(always)]
fn eliminate<S: StageSimd>(
    simd: S,
    plan: &Plan,
    batch: &mut Batch<S::Memory>,
    scratch: &mut Scratch<S::Memory>,
    i: usize,
) {
    let (first, own) = (plan.pair(i), plan.own_pair(i));
    let (forward, backward) = (&mut scratch.forward, &mut scratch.backward);
    let [a, b, c, d] = load2(simd, &backward[own]);
    let product = a * d;
    let determinant = b.neg_mul_add(c, product);
    batch.pivots[i][0] = determinant.store();
    batch.pivots[i][1] = product.store();
    let scale = Stages::splat(simd, 1.0) / determinant;
    let inverse = [d * scale, -(b * scale), -(c * scale), a * scale];
    store2(&mut backward[own], inverse);
    let ancestors = plan.ancestors(i);
    for k in first..own {
        let [v00, v01, v10, v11] = load2(simd, &backward[k]);
        let scaled = [
            inverse[1].mul_add(v10, inverse[0] * v00),
            inverse[1].mul_add(v11, inverse[0] * v01),
            inverse[3].mul_add(v10, inverse[2] * v00),
            inverse[3].mul_add(v11, inverse[2] * v01),
        ];
        store2(&mut backward[k], scaled);
    }
    for (place, &a) in ancestors.iter().enumerate() {
        let target = plan.pair(a as usize);
        let column = load2(simd, &forward[first + place]);
        let row = load2(simd, &backward[first + place]);
        // Rows of `a` towards the root; the own panels lie behind those of all ancestors.
        let (above, beyond) = backward.split_at_mut(first);
        for (cell, source) in above[target..=target + place].iter_mut().zip(beyond.iter()) {
            store2(cell, update(load2(simd, cell), &column, &load2(simd, source)));
        }
        // Columns of `a`.
        let (above, beyond) = forward.split_at_mut(first);
        for (cell, source) in above[target..target + place].iter_mut().zip(beyond.iter()) {
            store2(cell, update(load2(simd, cell), &load2(simd, source), &row));
        }
    }
}

/// `target - (a V + m g)` for rows of velocities.
#[inline(always)]
fn update_velocity<S: StageSimd>(
    simd: S,
    target: &mut [S::Memory; 7],
    (a, m): ([Stages<S>; 2], Stages<S>),
    (v, g): (&Block2<S>, [Stages<S>; 2]),
) {
    for c in 0..2 {
        let mut sum = Stages::load(simd, &target[4 + c]);
        sum = a[0].neg_mul_add(v[c], sum);
        sum = a[1].neg_mul_add(v[2 + c], sum);
        target[4 + c] = m.neg_mul_add(g[c], sum).store();
    }
}

#[inline(always)]
fn eliminate_velocity<S: StageSimd>(simd: S, plan: &Plan, scratch: &mut Scratch<S::Memory>, i: usize) {
    let (first, own) = (plan.pair(i), plan.own_pair(i));
    let (forward, backward) = (&mut scratch.forward, &mut scratch.backward);
    let [.., g0, g1, inverse]: [Stages<S>; 7] = load(simd, &backward[own]);
    for panel in &mut backward[first..own] {
        let [v00, v01, v10, v11, a0, a1, _]: [Stages<S>; 7] = load(simd, panel);
        panel[4] = (inverse * g1.neg_mul_add(v10, g0.neg_mul_add(v00, a0))).store();
        panel[5] = (inverse * g1.neg_mul_add(v11, g0.neg_mul_add(v01, a1))).store();
    }
    for (place, &a) in plan.ancestors(i).iter().enumerate() {
        let target = plan.pair(a as usize);
        let [.., a0, a1, mass]: [Stages<S>; 7] = load(simd, &forward[first + place]);
        let [v00, v01, v10, v11, g0, g1, _]: [Stages<S>; 7] = load(simd, &backward[first + place]);
        let (above, beyond) = backward.split_at_mut(first);
        for (cell, source) in above[target..=target + place].iter_mut().zip(beyond.iter()) {
            let [w00, w01, w10, w11, h0, h1, _]: [Stages<S>; 7] = load(simd, source);
            update_velocity(simd, cell, ([a0, a1], mass), (&[w00, w01, w10, w11], [h0, h1]));
        }
        let (above, beyond) = forward.split_at_mut(first);
        for (cell, source) in above[target..target + place].iter_mut().zip(beyond.iter()) {
            let [.., b0, b1, mass]: [Stages<S>; 7] = load(simd, source);
            update_velocity(simd, cell, ([b0, b1], mass), (&[v00, v01, v10, v11], [g0, g1]));
        }
    }
}

/// Block columns and block rows of all pairs.
type Panels<'a, M> = (&'a [ForwardPanel<M>], &'a [BackwardPanel<M>]);

/// Solves one block of `C` columns.
#[inline(always)]
fn solve<S: StageSimd, const C: usize>(
    simd: S,
    plan: &Plan,
    block: &Block,
    sides: &[[S::Memory; SIDE]],
    (forward, backward): Panels<'_, S::Memory>,
    columns: &mut [S::Memory],
) {
    let zero = Stages::splat(simd, 0.0);
    let sides = sides.as_flattened();
    for (row, origins) in block.rows.iter().zip(block.origins.chunks_exact(C)) {
        let at = row.joint as usize * 3 * C;
        let mut sums = [[zero; C]; 3];
        for c in 0..C {
            let side = &sides[origins[c] as usize..][..3];
            for row in 0..3 {
                sums[row][c] = Stages::load(simd, &side[row]);
            }
        }
        for source in &block.sources[row.first as usize..row.end as usize] {
            let panel: [Stages<S>; 7] = load(simd, &forward[source.pair as usize]);
            let from = source.joint as usize * 3 * C;
            subtract(simd, &panel, &columns[from..from + 3 * C], &mut sums);
        }
        let pivot: [Stages<S>; 7] = load(simd, &backward[plan.own_pair(row.joint as usize)]);
        let cells = &mut columns[at..at + 3 * C];
        for c in 0..C {
            let (x, y, v) = (sums[0][c], sums[1][c], sums[2][c]);
            let (first, second) = (pivot[1].mul_add(y, pivot[0] * x), pivot[3].mul_add(y, pivot[2] * x));
            cells[c] = first.store();
            cells[C + c] = second.store();
            cells[2 * C + c] =
                (pivot[6] * pivot[5].neg_mul_add(second, pivot[4].neg_mul_add(first, v))).store();
        }
    }
    for i in 0..plan.n {
        let at = i * 3 * C;
        let mut sums = [[zero; C]; 3];
        if block.support[i] {
            for (sums, cells) in sums.iter_mut().zip(columns[at..at + 3 * C].chunks_exact(C)) {
                for c in 0..C {
                    sums[c] = Stages::load(simd, &cells[c]);
                }
            }
        }
        for (&b, panel) in plan.ancestors(i).iter().zip(&backward[plan.pair(i)..]) {
            let panel: [Stages<S>; 7] = load(simd, panel);
            let from = b as usize * 3 * C;
            subtract(simd, &panel, &columns[from..from + 3 * C], &mut sums);
        }
        let cells = &mut columns[at..at + 3 * C];
        for c in 0..C {
            cells[c] = sums[0][c].store();
            cells[C + c] = sums[1][c].store();
            cells[2 * C + c] = sums[2][c].store();
        }
    }
}

/// `sums -= [J 0; g l] x`.
#[inline(always)]
fn subtract<S: StageSimd, const C: usize>(
    simd: S,
    panel: &[Stages<S>; 7],
    x: &[S::Memory],
    sums: &mut [[Stages<S>; C]; 3],
) {
    let [j00, j01, j10, j11, g0, g1, l] = *panel;
    for c in 0..C {
        let (first, second, rate) =
            (Stages::load(simd, &x[c]), Stages::load(simd, &x[C + c]), Stages::load(simd, &x[2 * C + c]));
        sums[0][c] = j01.neg_mul_add(second, j00.neg_mul_add(first, sums[0][c]));
        sums[1][c] = j11.neg_mul_add(second, j10.neg_mul_add(first, sums[1][c]));
        sums[2][c] = l.neg_mul_add(rate, g1.neg_mul_add(second, g0.neg_mul_add(first, sums[2][c])));
    }
}

/// Newton correction of the nodes and, after a full factorisation, of the velocity at the end. `apply` moves the nodes.
pub(crate) struct Correct<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a mut Batch<M>,
    pub scratch: &'a mut Scratch<M>,
    pub apply: bool,
}

impl<M: StageMemory> StageKernel<M> for Correct<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch, apply } = self;
        let Scratch { sides, forward, backward, columns, .. } = scratch;
        for (i, [first, second]) in batch.residual.iter().enumerate() {
            let at = plan.sides.residual(i);
            let side = &mut sides.as_flattened_mut()[at..at + 2];
            side[0] = (-Stages::load(simd, first)).store();
            side[1] = (-Stages::load(simd, second)).store();
        }
        solve::<S, 1>(simd, plan, &plan.everything, sides, (forward, backward), columns);
        for (i, correction) in batch.correction.iter_mut().enumerate() {
            *correction = [columns[3 * i], columns[3 * i + 1], columns[3 * i + 2]];
            if apply {
                for alpha in 1..=2 {
                    let node = &mut batch.nodes[alpha][i];
                    *node = (Stages::load(simd, node) + Stages::load(simd, &correction[alpha - 1])).store();
                }
            }
        }
    }
}

/// All columns of the linearisation, a block at a time; finished columns go to the caller.
pub(crate) struct Columns<'a, 'o, M> {
    pub plan: &'a Plan,
    pub batch: &'a mut Batch<M>,
    pub scratch: &'a mut Scratch<M>,
    pub output: &'o mut dyn TransitionOutput,
    /// Stages of this vector whose columns are wanted.
    pub stages: core::ops::Range<usize>,
    /// Set to the length of the first room that is too short, and to the one needed.
    pub short: &'a mut Option<(usize, usize)>,
}

impl<M: StageMemory> StageKernel<M> for Columns<'_, '_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(mut self, simd: S) {
        if M::COUNT == 8 {
            all_blocks::<S, 6>(simd, &mut self);
        } else {
            all_blocks::<S, 3>(simd, &mut self);
        }
    }
}

#[inline(always)]
fn all_blocks<S: StageSimd, const C: usize>(simd: S, work: &mut Columns<'_, '_, S::Memory>) {
    let plan = work.plan;
    let Scratch { sides, forward, backward, columns, .. } = &mut *work.scratch;
    let step = Stages::load(simd, &work.batch.time_step);
    let force = &mut sides.as_flattened_mut()[plan.sides.force()..];
    for (side, weight) in force.iter_mut().zip([-WEIGHTS[0], -WEIGHTS[1], WEIGHTS[2]]) {
        *side = step.times(weight).store();
    }
    for (block, columns) in plan.blocks.iter().zip(columns.chunks_exact_mut(3 * plan.n * C)) {
        solve::<S, C>(simd, plan, block, sides, (forward, backward), columns);
        if !work.batch.interior.is_empty() {
            keep_interior::<S::Memory, C>(plan, block, columns, &mut work.batch.interior);
        }
    }
    write::<S, C>(simd, plan, work);
}

/// Keeps the sensitivities of the interior nodes of a solved block.
#[inline(always)]
fn keep_interior<M: StageMemory, const C: usize>(
    plan: &Plan,
    block: &Block,
    columns: &[M],
    interior: &mut [M],
) {
    let n = plan.n;
    for (c, column) in block.columns.iter().enumerate() {
        let index = column.index(n);
        let interior = &mut interior[index * n..(index + 1) * n];
        for (cell, cells) in interior.iter_mut().zip(columns.chunks_exact(3 * C)) {
            *cell = cells[c];
        }
    }
}

/// Turns the rows of `q_{k+1}` and `q̇_{k+1}` from vectors of stages to stages, a square of columns at a time, and hands them to the
/// caller. All at the end: between the blocks, whose panels stream through the caches, it would cost as much as solving.
#[inline(always)]
fn write<S: StageSimd, const C: usize>(simd: S, plan: &Plan, work: &mut Columns<'_, '_, S::Memory>) {
    let n = plan.n;
    let count = S::Memory::COUNT;
    let Scratch { columns, transposed, .. } = &mut *work.scratch;
    let width = plan.places.len();
    for first in (0..n).step_by(JOINTS_AT_ONCE) {
        let joints = first..n.min(first + JOINTS_AT_ONCE);
        for (at, turned) in transposed.chunks_exact_mut(width).enumerate().take(2 * joints.len()) {
            let cells = &columns[((first + at / 2) * 3 + 1 + at % 2) * C..];
            for (places, turned) in plan.places.chunks_exact(count).zip(turned.chunks_exact_mut(count)) {
                simd.transpose(cells, places, turned);
            }
        }
        for (lane, stage) in work.stages.clone().enumerate() {
            let rows = work.output.transition(stage);
            let (length, needed) = (rows.values.len(), rows.needed(n));
            if length < needed || rows.first_state < n {
                work.short.get_or_insert((length.min(needed - 1), needed));
                continue;
            }
            for (at, turned) in transposed.chunks_exact(width).enumerate().take(2 * joints.len()) {
                let row = &mut rows.values[(first + at / 2 + at % 2 * n) * rows.row_stride..];
                let (by_input, by_state) = turned.split_at(n.next_multiple_of(count));
                gather(lane, by_input, &mut row[..n]);
                gather(lane, by_state, &mut row[rows.first_state..][..2 * n]);
            }
        }
    }
}

/// The numbers of one lane, out of squares whose rows are the lanes.
#[inline(always)]
fn gather<M: StageMemory>(lane: usize, squares: &[M], out: &mut [f64]) {
    let mut whole = out.chunks_exact_mut(M::COUNT);
    let mut squares = squares.chunks_exact(M::COUNT);
    for (out, square) in (&mut whole).zip(&mut squares) {
        out.copy_from_slice(square[lane].lanes());
    }
    if let Some(square) = squares.next() {
        for (out, from) in whole.into_remainder().iter_mut().zip(square[lane].lanes()) {
            *out = *from;
        }
    }
}

/// `q^1 += correction + ∂q^1/∂(u, q, q̇) (δu, δq, δq̇)`.
pub(crate) struct MoveInterior<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a mut Batch<M>,
    pub scratch: &'a mut Scratch<M>,
}

impl<M: StageMemory> StageKernel<M> for MoveInterior<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch } = self;
        let sums = &mut scratch.end_momentum;
        for (sum, correction) in sums.iter_mut().zip(&batch.correction) {
            *sum = correction[0];
        }
        for (column, deviation) in batch.interior.chunks_exact(plan.n).zip(&batch.deviation) {
            let deviation = Stages::load(simd, deviation);
            for (sum, entry) in sums.iter_mut().zip(column) {
                *sum = deviation.mul_add(Stages::load(simd, entry), Stages::load(simd, sum)).store();
            }
        }
        for (node, sum) in batch.nodes[1].iter_mut().zip(sums.iter()) {
            *node = (Stages::load(simd, node) + Stages::load(simd, sum)).store();
        }
    }
}
