//! Algorithms 2 and 3 of a vector of stages: the 3 x 3 blocks of every pair on a branch and the right-hand sides.

use super::memory::{Batch, END, START, Scratch};
use super::plan::Plan;
use super::{DERIVATIVE, NODES, WEIGHTS};
use crate::lanes::{cross, dot3, dot6, halves};
use crate::stage_lanes::{StageKernel, StageMemory, StageSimd, Stages, Stages3, Stages6, load, splat};

/// Fills the panels; with `full` also the rows of velocities and the right-hand sides.
pub(crate) struct Assemble<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a Batch<M>,
    pub scratch: &'a mut Scratch<M>,
    pub full: bool,
}

/// Places of the terms of a pair: at every node `K_q̇q̇`, `∂²K/∂q̇_i∂q_j`, `∂²K/∂q̇_j∂q_i`, `K_qq - V_qq`, four by four;
/// then the two mixed ones with the true velocity at the start and at the end.
const MASS: usize = 0;
const COLUMN: usize = 1;
const ROW: usize = 2;
const STIFFNESS: usize = 3;
const ENDS: [(usize, usize, usize); 2] = [(START, 0, 12), (END, 2, 14)];

impl<M: StageMemory> StageKernel<M> for Assemble<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch, full } = self;
        let step = Stages::load(simd, &batch.time_step);
        let per_step = Stages::splat(simd, 1.0) / step;
        for i in 0..plan.n {
            for alpha in 0..NODES {
                node_terms(simd, plan, scratch, i, alpha);
            }
            if full {
                for (motion, node, at) in ENDS {
                    end_terms(simd, plan, scratch, i, motion, node, at);
                }
            }
            for place in 0..plan.tree.branch(i).len() {
                mix(simd, plan, scratch, (i, place), (step, per_step), full);
            }
        }
    }
}

#[inline(always)]
fn node_terms<S: StageSimd>(simd: S, plan: &Plan, scratch: &mut Scratch<S::Memory>, i: usize, alpha: usize) {
    let a: Stages6<S> = load(simd, &scratch.a[alpha][i]);
    let b: Stages6<S> = load(simd, &scratch.b[alpha][i]);
    let (twists, rates) = (&scratch.twists[alpha], &scratch.twist_rates[alpha]);
    let c: Stages3<S> = cross(halves(a).1, splat(simd, &plan.gravity));
    for (&j, terms) in plan.tree.branch(i).iter().zip(&mut scratch.terms) {
        let twist: Stages6<S> = load(simd, &twists[j as usize]);
        let rate: Stages6<S> = load(simd, &rates[j as usize]);
        let at = 4 * alpha;
        terms[at + MASS] = dot6(twist, a).store();
        terms[at + COLUMN] = dot6(rate, a).store();
        terms[at + ROW] = dot6(twist, b).store();
        terms[at + STIFFNESS] = (dot6(rate, b) + dot3(halves(twist).0, c)).store();
    }
    let constants = &plan.tree.constants()[i];
    let own = &mut scratch.terms[plan.ancestors(i).len()];
    for (kind, constant) in [(ROW, constants.damping), (STIFFNESS, constants.stiffness)] {
        let term = &mut own[4 * alpha + kind];
        *term = (Stages::load(simd, term) - Stages::splat(simd, constant)).store();
    }
}

#[inline(always)]
fn end_terms<S: StageSimd>(
    simd: S,
    plan: &Plan,
    scratch: &mut Scratch<S::Memory>,
    i: usize,
    motion: usize,
    node: usize,
    at: usize,
) {
    let a: Stages6<S> = load(simd, &scratch.a[node][i]);
    let b: Stages6<S> = load(simd, &scratch.b[motion][i]);
    let (twists, rates) = (&scratch.twists[node], &scratch.twist_rates[motion]);
    for (&j, terms) in plan.tree.branch(i).iter().zip(&mut scratch.terms) {
        let twist: Stages6<S> = load(simd, &twists[j as usize]);
        let rate: Stages6<S> = load(simd, &rates[j as usize]);
        terms[at] = dot6(rate, a).store();
        terms[at + 1] = dot6(twist, b).store();
    }
}

/// Mixes the nodes: `H[α,γ]` of one pair, spread over the panels.
#[inline(always)]
fn mix<S: StageSimd>(
    simd: S,
    plan: &Plan,
    scratch: &mut Scratch<S::Memory>,
    (i, place): (usize, usize),
    (step, per_step): (Stages<S>, Stages<S>),
    full: bool,
) {
    let terms: [Stages<S>; 16] = load(simd, &scratch.terms[place]);
    let mass = [terms[MASS] * per_step, terms[4 + MASS] * per_step, terms[8 + MASS] * per_step];
    let h00 = entry::<S, 0, 0>(simd, &terms, &mass, step);
    let h01 = entry::<S, 0, 1>(simd, &terms, &mass, step);
    let h02 = entry::<S, 0, 2>(simd, &terms, &mass, step);
    let h10 = entry::<S, 1, 0>(simd, &terms, &mass, step);
    let h11 = entry::<S, 1, 1>(simd, &terms, &mass, step);
    let h12 = entry::<S, 1, 2>(simd, &terms, &mass, step);
    let h20 = entry::<S, 2, 0>(simd, &terms, &mass, step);
    let h21 = entry::<S, 2, 1>(simd, &terms, &mass, step);
    let h22 = entry::<S, 2, 2>(simd, &terms, &mass, step);
    let pair = plan.pair(i) + place;
    let (forward, backward) = (&mut scratch.forward[pair], &mut scratch.backward[pair]);
    // Row of the body, column of the branch; then the other way round, where H[α,γ] of the pair is H[γ,α].
    store_part(backward, 0, [h01, h02, h11, h12]);
    store_part(forward, 0, [h10, h20, h11, h21]);
    if full {
        let [start_column, start_row, end_column, end_row] = [terms[12], terms[13], terms[14], terms[15]];
        store_part(backward, 4, [-h21, end_column - h22]);
        store_part(forward, 4, [-h12, end_row - h22]);
        let row_of_body = [-(h00 + start_column), -h10, h20];
        let row_of_branch = [-(h00 + start_row), -h01, h02];
        let side = &mut scratch.sides[pair];
        store_part(side, 0, row_of_body);
        store_part(side, 3, row_of_branch);
        store_part(side, 6, [-terms[MASS]]);
    }
}

#[inline(always)]
fn store_part<S: StageSimd, const N: usize>(panel: &mut [S::Memory], at: usize, v: [Stages<S>; N]) {
    for k in 0..N {
        panel[at + k] = v[k].store();
    }
}

/// `H[A,C]` of a pair: section "Hessian blocks" of [`crate::del_hessian`].
#[inline(always)]
fn entry<S: StageSimd, const A: usize, const C: usize>(
    simd: S,
    terms: &[Stages<S>; 16],
    mass: &[Stages<S>; NODES],
    step: Stages<S>,
) -> Stages<S> {
    let mut sum = mass[0].times(WEIGHTS[0] * DERIVATIVE[0][A] * DERIVATIVE[0][C]);
    for beta in 1..NODES {
        let factor = WEIGHTS[beta] * DERIVATIVE[beta][A] * DERIVATIVE[beta][C];
        if factor != 0.0 {
            sum = mass[beta].mul_add(Stages::splat(simd, factor), sum);
        }
    }
    if DERIVATIVE[A][C] != 0.0 {
        sum = terms[4 * A + ROW].mul_add(Stages::splat(simd, WEIGHTS[A] * DERIVATIVE[A][C]), sum);
    }
    if DERIVATIVE[C][A] != 0.0 {
        sum = terms[4 * C + COLUMN].mul_add(Stages::splat(simd, WEIGHTS[C] * DERIVATIVE[C][A]), sum);
    }
    if A == C {
        sum = (terms[4 * A + STIFFNESS] * step).mul_add(Stages::splat(simd, WEIGHTS[A]), sum);
    }
    sum
}
