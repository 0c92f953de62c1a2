//! Algorithm 1, from the leaves inward: impulses of the subtrees and the rows of the residual.
//!
//! Letters and equations: [`super`].

use super::{BodyLanes, DeadLoad, DelWorkspace, GainLanes};
use crate::floating_base::{base_project, base_project_rate};
use crate::lanes::{
    Kernel, LANES, Lane, Lane3, Lane6, Lane9, Quad, Simd, add, cross, cross_add, dot6, halves, join, load,
    mat_tr_vec, mat_vec, mat_vec_add, scale, splat, store, sub,
};
use crate::tree::{BodyConstants, KinematicTree, NO_PARENT};

/// A1.2 and A1.3: wrenches, articulated momenta and impulses, rows.
pub(super) struct Inward<'a> {
    pub(super) tree: &'a KinematicTree,
    pub(super) workspace: &'a mut DelWorkspace,
}

impl Kernel for Inward<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, workspace } = self;
        let groups = workspace.groups;
        own_impulses(simd, tree, workspace);
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let parent = tree.constants()[i].parent;
            for g in 0..groups {
                let body = &workspace.bodies[i * groups + g];
                let momentum: Lane6<S> = load(simd, &body.momentum);
                let impulse: Lane6<S> = load(simd, &body.impulse);
                workspace.projections[g][0] = dot6(load(simd, &body.joint_twist), momentum).quad();
                if parent != NO_PARENT {
                    let target = &mut workspace.bodies[parent * groups + g];
                    target.momentum = store(add(load(simd, &target.momentum), momentum));
                    target.impulse = store(add(load(simd, &target.impulse), impulse));
                }
            }
            for g in 0..groups {
                joint_row(simd, tree, workspace, i, g);
            }
        }
        if tree.is_floating() {
            base_rows(simd, workspace);
        }
    }
}

/// `w_α Δt F_i` of every body.
#[inline(always)]
pub(super) fn own_impulses<S: Simd>(simd: S, tree: &KinematicTree, workspace: &mut DelWorkspace) {
    let groups = workspace.groups;
    let gravity: [f64; 3] = (*tree.gravity_w()).into();
    for (i, constants) in tree.constants().iter().enumerate() {
        let weight: Lane3<S> = splat(simd, &gravity.map(|g| g * constants.mass));
        for g in 0..groups {
            let body = &mut workspace.bodies[i * groups + g];
            let step = Lane::load(simd, &workspace.weights[g]);
            let position: Lane3<S> = load(simd, &body.position);
            let mut wrench = join(cross(position, weight), weight);
            if let Some(gain) = workspace.gains.get_mut(i * groups + g) {
                let mut general = load(simd, &gain.wrench);
                if constants.drag.is_some() || constants.constant_wrench.is_some() {
                    general = add(general, body_fixed_wrench(simd, constants, body));
                }
                gain.wrench = store(general);
                wrench = add(wrench, general);
                if let Some(drag) = &constants.drag {
                    add_drag_gain(simd, drag, body, gain);
                }
            }
            body.impulse = store(scale(step, wrench));
        }
    }
    for (index, dead) in workspace.loads.iter().enumerate() {
        for g in 0..groups {
            let body = &mut workspace.bodies[dead.body * groups + g];
            let step = Lane::load(simd, &workspace.weights[g]);
            let (force, arm) = load_arm(simd, dead, &workspace.load_forces[index * groups + g], body);
            let mut wrench = join(cross(arm, force), force);
            if dead.couple {
                let zero = Lane::splat(simd, 0.0);
                wrench = join(cross(arm, force), [zero; 3]);
            }
            body.impulse = store(crate::lanes::scale_add(step, wrench, load(simd, &body.impulse)));
        }
    }
    if workspace.gains.is_empty() {
        for held in &workspace.held_torques {
            for g in 0..groups {
                let step = Lane::load(simd, &workspace.weights[g]);
                let impulse = &mut workspace.bodies[held.body * groups + g].impulse;
                for k in 0..3 {
                    let torque = Lane::load(simd, &held.torque_w[g][k]);
                    impulse[k] = step.mul_add(torque, Lane::load(simd, &impulse[k])).quad();
                }
            }
        }
    }
}

/// Force of a dead load and the arm it acts on: from the origin of {0} to the point, or the couple's own arm.
#[inline(always)]
pub(crate) fn load_arm<S: Simd>(
    simd: S,
    dead: &DeadLoad,
    force: &[Quad; 3],
    body: &BodyLanes,
) -> (Lane3<S>, Lane3<S>) {
    let rotation = load(simd, &body.rotation);
    let arm_b = splat(simd, &dead.arm_b);
    let arm = if dead.couple {
        mat_vec(&rotation, arm_b)
    } else {
        mat_vec_add(&rotation, arm_b, load(simd, &body.position))
    };
    (load(simd, force), arm)
}

/// Drag and constant wrench in link axes at the mass centre, moved to the origin of {0}.
#[inline(always)]
pub(super) fn body_fixed_wrench<S: Simd>(simd: S, constants: &BodyConstants, body: &BodyLanes) -> Lane6<S> {
    let zero = Lane::splat(simd, 0.0);
    let rotation: Lane9<S> = load(simd, &body.rotation);
    let position: Lane3<S> = load(simd, &body.position);
    let mut wrench_b = constants.constant_wrench.map_or([zero; 6], |w| splat(simd, &w));
    if let Some(drag) = &constants.drag {
        let drag: Lane6<S> = splat(simd, drag);
        let (omega, linear) = halves(load(simd, &body.velocity));
        let central = sub(linear, cross(position, omega));
        let velocity_b = join(mat_tr_vec(&rotation, omega), mat_tr_vec(&rotation, central));
        for k in 0..6 {
            wrench_b[k] = drag[k].neg_mul_add(velocity_b[k], wrench_b[k]);
        }
    }
    let (torque, force) = halves(wrench_b);
    let force = mat_vec(&rotation, force);
    join(cross_add(position, force, mat_vec(&rotation, torque)), force)
}

/// `F_ν -= Ad_g⁻ᵀ C Ad_g⁻¹` for the diagonal drag `C` in link axes at the mass centre.
#[inline(always)]
pub(super) fn add_drag_gain<S: Simd>(simd: S, drag: &[f64; 6], body: &BodyLanes, gain: &mut GainLanes) {
    let rotation: Lane9<S> = load(simd, &body.rotation);
    let position: Lane3<S> = load(simd, &body.position);
    let nu: [Lane<S>; 36] = load(simd, &gain.nu);
    let drag: Lane6<S> = splat(simd, drag);
    let zero = Lane::splat(simd, 0.0);
    let mut columns = [[zero; 6]; 6];
    for (k, column) in columns.iter_mut().enumerate() {
        let mut twist = [zero; 6];
        twist[k] = Lane::splat(simd, 1.0);
        let (omega, linear) = halves(twist);
        let central = sub(linear, cross(position, omega));
        let (spin_b, slip_b) = (mat_tr_vec(&rotation, omega), mat_tr_vec(&rotation, central));
        let torque = mat_vec(&rotation, core::array::from_fn(|r| drag[r] * spin_b[r]));
        let force = mat_vec(&rotation, core::array::from_fn(|r| drag[3 + r] * slip_b[r]));
        *column = join(cross_add(position, force, torque), force);
    }
    gain.nu = core::array::from_fn(|k| (nu[k] - columns[k % 6][k / 6]).quad());
}

/// `Σ_β a^{αβ} m^β`, lanes over α of group `g`, for component `k` of the projections.
#[inline(always)]
pub(crate) fn weighted_sum<S: Simd>(
    simd: S,
    workspace: &DelWorkspace,
    projections: &[[Quad; 6]],
    k: usize,
    g: usize,
    start: Lane<S>,
) -> Lane<S> {
    let groups = workspace.groups;
    let mut sum = start;
    for beta in 0..=workspace.rule.unknown_nodes() {
        let value = projections[beta / LANES][k].0[beta % LANES];
        let column = Lane::load(simd, &workspace.weighted_derivative[beta * groups + g]);
        sum = column.mul_add(Lane::splat(simd, value), sum);
    }
    sum
}

#[inline(always)]
pub(super) fn joint_row<S: Simd>(
    simd: S,
    tree: &KinematicTree,
    workspace: &mut DelWorkspace,
    i: usize,
    g: usize,
) {
    let groups = workspace.groups;
    let constants = &tree.constants()[i];
    let dof = tree.joint_dof(i);
    let body = &workspace.bodies[i * groups + g];
    let joint = dof - tree.base_dof();
    let mut held = Lane::load(simd, &workspace.joint_forces[joint * groups + g]);
    let q_dot = Lane::load(simd, &workspace.q_dot[dof * groups + g]);
    held = Lane::splat(simd, constants.damping).neg_mul_add(q_dot, held);
    if constants.stiffness != 0.0 {
        let rest = constants.rest - workspace.start.q[joint];
        let stretch = Lane::load(simd, &workspace.q[dof * groups + g]) - Lane::splat(simd, rest);
        held = Lane::splat(simd, constants.stiffness).neg_mul_add(stretch, held);
    }
    held = held + dot6(load(simd, &body.joint_twist_rate), load(simd, &body.momentum));
    let twist: Lane6<S> = load(simd, &body.joint_twist);
    let row = Lane::load(simd, &workspace.weights[g]).mul_add(held, dot6(twist, load(simd, &body.impulse)));
    workspace.rows[dof * groups + g] =
        weighted_sum(simd, workspace, &workspace.projections, 0, g, row).quad();
}

#[inline(always)]
pub(super) fn base_rows<S: Simd>(simd: S, workspace: &mut DelWorkspace) {
    let groups = workspace.groups;
    let s = workspace.rule.unknown_nodes();
    for g in 0..groups {
        let momentum = load(simd, &workspace.bodies[g].momentum);
        workspace.projections[g] = store(base_project(simd, &workspace.base[g], momentum));
    }
    for g in 0..groups {
        let (body, base) = (&workspace.bodies[g], &workspace.base[g]);
        let step = Lane::load(simd, &workspace.weights[g]);
        let mut mask = Quad::splat(1.0);
        if s / LANES == g {
            mask.0[s % LANES] = 0.0;
        }
        let mask = Lane::load(simd, &mask);
        let rate = base_project_rate(simd, base, load(simd, &body.momentum));
        let pushed = scale(mask, base_project(simd, base, load(simd, &body.impulse)));
        for k in 0..6 {
            let start = if k < 3 { step.mul_add(rate[k], pushed[k]) } else { pushed[k] };
            let row = weighted_sum(simd, workspace, &workspace.projections, k, g, start);
            workspace.rows[k * groups + g] = row.quad();
        }
    }
}
