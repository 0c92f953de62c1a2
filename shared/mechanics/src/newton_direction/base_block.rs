//! The base-base block of the Newton matrix of a floating tree; letters as in [`crate::floating_base`].

use nalgebra::{Matrix6, Vector3, Vector6};

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::floating_base::SecondOrderMatrix;
use crate::spatial::{Twist, Wrench};

/// The base-base entries of the Newton matrix of a floating tree (module doc of [`crate::del_hessian`]): calls
/// `set([coordinate, α], [coordinate, γ - 1], value)`, row first. `s` is the number of unknown nodes (a constant where the caller wants
/// the loops unrolled).
#[inline(always)]
pub(crate) fn base_block(
    del: &DelWorkspace,
    hessian: &DelHessian,
    s: usize,
    mut set: impl FnMut([usize; 2], [usize; 2], f64),
) {
    let start_twists = base_matrix(del, 0);
    let end_twists = base_matrix(del, s);

    // Change of the total impulse by δξ^s through the rigid shift S^0 δξ^s and through δξ^0 = -δξ^s.
    let mut shifted_impulse = Matrix6::from_fn(|r, k| -hessian.impulse_column(k, 0)[r]);
    let mut rigid = Matrix6::zeros();
    for alpha in 0..=s {
        rigid += Matrix6::from_fn(|r, k| hessian.rigid_column(k, alpha)[r]);
    }
    shifted_impulse += rigid * start_twists;
    let momentum_end = {
        let (_, impulse) = del.body_momentum_and_impulse(0, s);
        del.base_momentum_before_end() + impulse
    };
    let turned = dual_matrix(&momentum_end) * (end_twists + start_twists);
    let curved =
        second_order_matrix(del, s, &momentum_end) - second_order_matrix(del, 0, &del.start_momentum());
    let last_column = end_twists.tr_mul(&(shifted_impulse + turned)) + curved - held_rows_matrix(del, 0);
    for alpha in 1..s {
        let held = held_rows_matrix(del, alpha);
        for k in 0..6 {
            let shifts = hessian.shift_on_base(k, alpha);
            for l in 0..6 {
                for gamma in 1..=s {
                    let mut value = hessian.base_entry(k, l, alpha, gamma);
                    if gamma == s {
                        value += shifts[l] - hessian.base_entry(k, l, alpha, 0) - held[(k, l)];
                    }
                    set([k, alpha], [l, gamma - 1], value);
                }
            }
        }
    }
    for l in 0..6 {
        for gamma in 1..=s {
            let impulses = hessian.impulse_on_base(l, gamma);
            for k in 0..6 {
                let mut value =
                    hessian.base_entry(k, l, 0, gamma) - hessian.base_entry(k, l, s, gamma) + impulses[k];
                if gamma == s {
                    value += last_column[(k, l)] + hessian.shift_on_base(k, 0)[l]
                        - hessian.shift_on_base(k, s)[l]
                        - (hessian.base_entry(k, l, 0, 0) - hessian.base_entry(k, l, s, 0));
                }
                set([k, 0], [l, gamma - 1], value);
            }
        }
    }
}

/// `K^α` of the rows that are held.
pub(crate) fn held_rows_matrix(del: &DelWorkspace, alpha: usize) -> Matrix6<f64> {
    let [n, m] = [0, 3].map(|at| Vector3::from_fn(|k, _| del.held_rows[alpha][at + k]).cross_matrix());
    let end = del.unknown_nodes();
    let x = Vector3::from_fn(|k, _| del.node(end, 3 + k)).cross_matrix();
    let mut change = Matrix6::zeros();
    change.fixed_view_mut::<3, 3>(0, 0).copy_from(&(n - m * x));
    change.fixed_view_mut::<3, 3>(0, 3).copy_from(&m);
    change.fixed_view_mut::<3, 3>(3, 0).copy_from(&m);
    change
}

/// `S^α` of the base as a matrix.
pub(crate) fn base_matrix(del: &DelWorkspace, alpha: usize) -> Matrix6<f64> {
    let (z, p) = del.base_turn_and_position(alpha);
    let mut twists = Matrix6::zeros();
    twists.fixed_view_mut::<3, 3>(0, 0).copy_from(&z);
    twists.fixed_view_mut::<3, 3>(3, 0).copy_from(&(p.cross_matrix() * z));
    twists.fixed_view_mut::<3, 3>(3, 3).copy_from(&del.center.rotation);
    twists
}

/// Matrix of `ad^D_X`.
fn dual_matrix(x: &Wrench) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    for c in 0..6 {
        m.set_column(c, &x.dual_bracket(&Twist::from_vector(&Vector6::ith(c, 1.0))).to_vector());
    }
    m
}

/// `N^α(X)` of the base as a matrix.
pub(crate) fn second_order_matrix(del: &DelWorkspace, alpha: usize, x: &Wrench) -> Matrix6<f64> {
    del.instructions.dispatch(SecondOrderMatrix { base: &del.base, alpha, wrench: x })
}
