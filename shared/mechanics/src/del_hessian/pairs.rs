//! The pass over the pairs: every joint with its ancestors and with the base.
//!
//! Letters and equations: [`super`].

use super::composites::{
    fixed_direction_gain, fixed_direction_row, general_terms, matrix_times, matrix_tr_times,
};
use super::{ColumnLanes, DelHessian, RowLanes};
use crate::del_residual::DelWorkspace;
use crate::floating_base::{BaseLanes, base_project_both, second_order, second_order_rate};
use crate::kinetic_hessian::{composite_times, kinetic_columns};
use crate::lanes::{
    LANES, Lane, Lane6, Quad, Simd, add, dot3, dot6, dual_bracket, halves, join, load, mat_tr_vec, scale,
    store, sub,
};
use crate::tree::KinematicTree;

/// Lanes of the pair terms, per group, before the nodes are mixed.
#[derive(Clone, Copy)]
pub(super) struct PairTerms<const G: usize> {
    /// `K_q̇q̇`.
    pub(super) mass: [Quad; G],
    /// `w_α Δt (K_qq - V_qq + τ_q)`.
    pub(super) stiffness: [Quad; G],
    /// `K_qq̇ + τ_q̇` of the row's own node.
    pub(super) row: [Quad; G],
    /// `K_q̇q`.
    pub(super) column: [Quad; G],
}

impl<const G: usize> PairTerms<G> {
    const ZERO: Self = Self {
        mass: [Quad::ZERO; G],
        stiffness: [Quad::ZERO; G],
        row: [Quad::ZERO; G],
        column: [Quad::ZERO; G],
    };
}

pub(super) const MAX_GROUPS: usize = (crate::lobatto::MAX_UNKNOWN_NODES + LANES) / LANES;

/// Mixes the nodes: the formula of the module doc for one pair.
#[inline(always)]
pub(super) fn mix<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    out: &mut [Quad],
) {
    for alpha in 0..=s {
        for g in 0..groups {
            let at = alpha * groups + g;
            let mut sum = mixed_momenta(simd, tables, terms, s, groups, alpha, g);
            sum = Lane::load(simd, &terms.column[g]).mul_add(Lane::load(simd, &tables.column[at]), sum);
            sum = Lane::load(simd, &terms.stiffness[g]).mul_add(Lane::load(simd, &tables.unit[at]), sum);
            out[at] = sum.quad();
        }
    }
}

/// [`mix`] of a pair without stiffness and `K_q̇q`.
#[inline(always)]
pub(super) fn mix_momenta<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    out: &mut [Quad],
) {
    for alpha in 0..=s {
        for g in 0..groups {
            out[alpha * groups + g] = mixed_momenta(simd, tables, terms, s, groups, alpha, g).quad();
        }
    }
}

#[inline(always)]
pub(super) fn mixed_momenta<S: Simd, const G: usize>(
    simd: S,
    tables: &Tables<'_>,
    terms: &PairTerms<G>,
    s: usize,
    groups: usize,
    alpha: usize,
    g: usize,
) -> Lane<S> {
    let row = Lane::splat(simd, terms.row[alpha / LANES].0[alpha % LANES]);
    let mut sum = row * Lane::load(simd, &tables.row[alpha * groups + g]);
    for beta in 0..=s {
        let mass = Lane::splat(simd, terms.mass[beta / LANES].0[beta % LANES]);
        let table = &tables.mass[(beta * (s + 1) + alpha) * groups + g];
        sum = mass.mul_add(Lane::load(simd, table), sum);
    }
    sum
}

pub(super) struct Tables<'a> {
    pub(super) mass: &'a [Quad],
    pub(super) row: &'a [Quad],
    pub(super) column: &'a [Quad],
    pub(super) unit: &'a [Quad],
}

#[inline(always)]
pub(super) fn joint_pairs<S: Simd, const G: usize>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    s: usize,
    groups: usize,
) {
    let constants = &tree.constants()[i];
    let own = tree.joint_dof(i);
    let mass = constants.subtree_mass;
    let mut rows = [RowLanes::default(); G];
    for g in 0..groups {
        let at = i * groups + g;
        let body = &del.bodies[at];
        let (a, b) = kinetic_columns(simd, mass, &hessian.composites[at], body);
        let twist = load(simd, &body.joint_twist);
        let c = fixed_direction_row(simd, tree, del, hessian, i, at, twist);
        rows[g] = RowLanes { a: store(a), b: store(b), c: store(c) };
    }
    let tables = Tables {
        mass: &hessian.mass_table,
        row: &hessian.row_table,
        column: &hessian.column_table,
        unit: &hessian.unit_table,
    };
    let block = (s + 1) * groups;
    let first_pair = hessian.pair_starts[i];
    // Six columns at once, unless wrenches without a potential ask for all terms.
    let mut done = 0;
    if tree.is_floating() && hessian.general.is_empty() {
        let at = first_pair * block..(first_pair + 6) * block;
        base_pairs_of_joint::<S, G>(simd, del, &rows, &tables, s, groups, &mut hessian.blocks[at]);
        done = 6;
    }
    for (position, &dof) in tree.branch(i).iter().enumerate().skip(done) {
        let j = dof as usize;
        let (mut terms, mut mirror) = (PairTerms::<G>::ZERO, PairTerms::<G>::ZERO);
        for g in 0..groups {
            let column = &hessian.columns[j * groups + g];
            let twist: Lane6<S> = load(simd, &column.twist);
            let rate: Lane6<S> = load(simd, &column.rate);
            let row = &rows[g];
            let (a, b): (Lane6<S>, Lane6<S>) = (load(simd, &row.a), load(simd, &row.b));
            let step = Lane::load(simd, &del.weights[g]);
            let mut stiffness = dot6(rate, b) + dot3(halves(twist).0, load(simd, &row.c));
            let (mut k_row, k_column) = (dot6(twist, b), dot6(rate, a));
            terms.column[g] = k_column.quad();
            terms.mass[g] = dot6(twist, a).quad();
            if j == own {
                stiffness = stiffness - Lane::splat(simd, constants.stiffness);
            }
            if let Some(general) = hessian.general.get(i * groups + g) {
                let body = &del.bodies[i * groups + g];
                let own_twist = load(simd, &body.joint_twist);
                let force = general_terms(simd, general, own_twist, load(simd, &body.joint_twist_rate));
                mirror.mass[g] = terms.mass[g];
                mirror.stiffness[g] = (step * (stiffness + dot6(twist, force.column_pose))).quad();
                mirror.row[g] = (k_column + dot6(twist, force.column_rate)).quad();
                mirror.column[g] = k_row.quad();
                stiffness = stiffness + dot6(rate, force.row_rate) + dot6(twist, force.row_pose);
                k_row = k_row + dot6(twist, force.row_rate);
            }
            if j == own {
                k_row = k_row - Lane::splat(simd, constants.damping);
            }
            terms.stiffness[g] = (step * stiffness).quad();
            terms.row[g] = k_row.quad();
        }
        let at = (first_pair + position) * block;
        mix(simd, &tables, &terms, s, groups, &mut hessian.blocks[at..at + block]);
        if !hessian.mirror.is_empty() {
            mix(simd, &tables, &mirror, s, groups, &mut hessian.mirror[at..at + block]);
        }
    }
}

/// The pairs of a joint with the six base coordinates: products with the columns of `S` and `Ṡ` are projections on the base. Columns of a
/// travel of the chart have no angular part and no rate: only `K_q̇q̇` and `K_qq̇` are left of them.
#[inline(always)]
pub(super) fn base_pairs_of_joint<S: Simd, const G: usize>(
    simd: S,
    del: &DelWorkspace,
    rows: &[RowLanes; G],
    tables: &Tables<'_>,
    s: usize,
    groups: usize,
    blocks: &mut [Quad],
) {
    let mut terms = [PairTerms::<G>::ZERO; 6];
    for g in 0..groups {
        let base = &del.base[g];
        let (a, b): (Lane6<S>, Lane6<S>) = (load(simd, &rows[g].a), load(simd, &rows[g].b));
        let (mass, mass_rate) = base_project_both(simd, base, a);
        let (row, rate) = base_project_both(simd, base, b);
        let fixed = mat_tr_vec(&load(simd, &base.z), load(simd, &rows[g].c));
        let step = Lane::load(simd, &del.weights[g]);
        for k in 0..6 {
            terms[k].mass[g] = mass[k].quad();
            terms[k].row[g] = row[k].quad();
        }
        for k in 0..3 {
            terms[k].column[g] = mass_rate[k].quad();
            terms[k].stiffness[g] = (step * (rate[k] + fixed[k])).quad();
        }
    }
    let block = (s + 1) * groups;
    for (k, out) in blocks.chunks_exact_mut(block).enumerate() {
        if k < 3 {
            mix(simd, tables, &terms[k], s, groups, out);
        } else {
            mix_momenta(simd, tables, &terms[k], s, groups, out);
        }
    }
}

/// Shift row and impulse column of a joint of a floating tree.
#[inline(always)]
pub(super) fn joint_base_terms<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    g: usize,
) {
    let groups = hessian.groups;
    let body = &del.bodies[i * groups + g];
    let twist = load(simd, &body.joint_twist);
    let rate = load(simd, &body.joint_twist_rate);
    let dof = tree.joint_dof(i);
    shift_and_impulse(simd, tree, del, hessian, i, g, dof, twist, rate);
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(super) fn shift_and_impulse<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    i: usize,
    g: usize,
    dof: usize,
    twist: Lane6<S>,
    rate: Lane6<S>,
) {
    let groups = hessian.groups;
    let at = i * groups + g;
    let step = Lane::load(simd, &del.weights[g]);
    let zero = Lane::splat(simd, 0.0);
    let c = fixed_direction_row(simd, tree, del, hessian, i, at, twist);
    let mut shift = join(c, [zero; 3]);
    let mut gain = fixed_direction_gain(simd, tree, del, hessian, i, at, twist);
    if let Some(general) = hessian.general.get(at) {
        shift = add(shift, matrix_tr_times(simd, &general.eta, twist));
        gain = add(gain, matrix_times(simd, &general.eta, twist));
        gain = add(gain, matrix_times(simd, &general.nu, rate));
    }
    hessian.shift_rows[dof * groups + g] = store(scale(step, shift));
    let turned = dual_bracket(load(simd, &del.bodies[at].impulse), twist);
    hessian.impulse_columns[dof * groups + g] = store(sub(scale(step, gain), turned));
}

/// Columns of `S, Ṡ` of the base.
#[inline(always)]
pub(super) fn base_columns<S: Simd>(
    simd: S,
    base: &BaseLanes,
    hessian: &mut DelHessian,
    groups: usize,
    g: usize,
) {
    let zero = Lane::splat(simd, 0.0);
    for k in 0..6 {
        let mut unit = [zero; 6];
        unit[k] = Lane::splat(simd, 1.0);
        hessian.columns[k * groups + g] = ColumnLanes {
            twist: store(crate::floating_base::base_twist(simd, base, unit)),
            rate: store(crate::floating_base::base_twist_rate(simd, base, unit)),
        };
    }
}

/// Base-base blocks, and the shift rows and impulse columns of the base.
#[inline(always)]
pub(super) fn base_pairs<S: Simd, const G: usize>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    s: usize,
    groups: usize,
) {
    for g in 0..groups {
        for k in 0..6 {
            let column = hessian.columns[k * groups + g];
            let (twist, rate) = (load(simd, &column.twist), load(simd, &column.rate));
            shift_and_impulse(simd, tree, del, hessian, 0, g, k, twist, rate);
            rigid_column(simd, tree, del, hessian, g, k);
        }
    }
    let tables = Tables {
        mass: &hessian.mass_table,
        row: &hessian.row_table,
        column: &hessian.column_table,
        unit: &hessian.unit_table,
    };
    let mass = tree.constants()[0].subtree_mass;
    let block = (s + 1) * groups;
    // N(μ), Ṅ(μ), N(Γ) of every group.
    let mut curved = [[[Quad::ZERO; 18]; 3]; G];
    for g in 0..groups {
        let (base, body) = (&del.base[g], &del.bodies[g]);
        let momentum = load(simd, &body.momentum);
        curved[g] = [
            store(second_order(simd, base, momentum)),
            store(second_order_rate(simd, base, momentum)),
            store(second_order(simd, base, load(simd, &body.impulse))),
        ];
    }
    // What a column brings to all its rows: 𝓜S, 𝓜Ṡ, ad^D_μ Ṡ + 𝒴S + 𝒵Ṡ, 𝒵S.
    let mut carried = [[[Quad::ZERO; 6]; 6]; G];
    let mut carried_rates = [[[Quad::ZERO; 6]; 6]; G];
    let mut forces = [[[Quad::ZERO; 6]; 6]; G];
    let mut drags = [[[Quad::ZERO; 6]; 6]; G];
    for g in 0..groups {
        let momentum: Lane6<S> = load(simd, &del.bodies[g].momentum);
        for l in 0..6 {
            let column = &hessian.columns[l * groups + g];
            let (twist, rate): (Lane6<S>, Lane6<S>) = (load(simd, &column.twist), load(simd, &column.rate));
            carried[g][l] = store(composite_times(simd, mass, &hessian.composites[g], twist));
            carried_rates[g][l] = store(composite_times(simd, mass, &hessian.composites[g], rate));
            let mut force = add(
                dual_bracket(momentum, rate),
                fixed_direction_gain(simd, tree, del, hessian, 0, g, twist),
            );
            if let Some(general) = hessian.general.get(g) {
                force = add(force, matrix_times(simd, &general.nu, rate));
                force = add(force, matrix_times(simd, &general.eta, twist));
                drags[g][l] = store(matrix_times(simd, &general.nu, twist));
            }
            forces[g][l] = store(force);
        }
    }
    // Without general wrenches the entries behind the diagonal are mirror images.
    let symmetric = hessian.general.is_empty();
    for k in 0..6 {
        for l in 0..if symmetric { k + 1 } else { 6 } {
            let mut terms = PairTerms::<G>::ZERO;
            for g in 0..groups {
                let row = &hessian.columns[k * groups + g];
                let (row_twist, row_rate): (Lane6<S>, Lane6<S>) =
                    (load(simd, &row.twist), load(simd, &row.rate));
                let twist: Lane6<S> = load(simd, &hessian.columns[l * groups + g].twist);
                let carried_rate: Lane6<S> = load(simd, &carried_rates[g][l]);
                let step = Lane::load(simd, &del.weights[g]);
                let stiffness = dot6(row_rate, carried_rate) + dot6(row_twist, load(simd, &forces[g][l]));
                // K_ξ̇_l ξ_k for the row's own node is its mirror image.
                let mut k_row = dot6(twist, load(simd, &carried_rates[g][k]));
                let mut k_column = dot6(row_twist, carried_rate);
                if !hessian.general.is_empty() {
                    k_row = k_row + dot6(row_twist, load(simd, &drags[g][l]));
                }
                let mut scaled = step * stiffness;
                let [n, n_rate, n_impulse] = &curved[g];
                if l < 3 {
                    let at = 3 * k + l;
                    k_column = k_column + Lane::load(simd, &n[at]);
                    scaled = step.mul_add(Lane::load(simd, &n_rate[at]), scaled);
                    scaled = scaled + Lane::load(simd, &n_impulse[at]);
                }
                if k < 3 {
                    k_row = k_row + Lane::load(simd, &n[3 * l + k]);
                }
                terms.mass[g] = dot6(row_twist, load(simd, &carried[g][l])).quad();
                terms.stiffness[g] = scaled.quad();
                terms.row[g] = k_row.quad();
                terms.column[g] = k_column.quad();
            }
            let at = (6 * k + l) * block;
            mix(simd, &tables, &terms, s, groups, &mut hessian.base_blocks[at..at + block]);
            if symmetric && l < k {
                let image = (6 * l + k) * block;
                for alpha in 0..=s {
                    for gamma in 0..=s {
                        hessian.base_blocks[image + gamma * groups + alpha / LANES].0[alpha % LANES] =
                            hessian.base_blocks[at + alpha * groups + gamma / LANES].0[gamma % LANES];
                    }
                }
            }
        }
    }
}

/// Change of the total impulse by the unit twist `k` of all that the base carries.
#[inline(always)]
pub(super) fn rigid_column<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    del: &DelWorkspace,
    hessian: &mut DelHessian,
    g: usize,
    k: usize,
) {
    let mut twist = [Lane::splat(simd, 0.0); 6];
    twist[k] = Lane::splat(simd, 1.0);
    let mut gain = fixed_direction_gain(simd, tree, del, hessian, 0, g, twist);
    if let Some(general) = hessian.general.get(g) {
        gain = add(gain, matrix_times(simd, &general.eta, twist));
    }
    let turned = dual_bracket(load(simd, &del.bodies[g].impulse), twist);
    let step = Lane::load(simd, &del.weights[g]);
    hessian.rigid_columns[k * hessian.groups + g] = store(sub(scale(step, gain), turned));
}
