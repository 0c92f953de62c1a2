//! Response of a solved step to point loads: what a unit force held over the step does to the velocity at its end.
//!
//! This is the response (Delassus) matrix of contact: `W = ∂y/∂λ`, `y` the velocities of the loaded points at the end of the step,
//! `λ` their impulses over the step (force times `Δt`, in {0}).
//!
//! | letter | meaning (frame {0}, 6-vectors angular first) |
//! |---|---|
//! | `e`, `x^α` | unit force; the point it acts on, at node α |
//! | `F^α = w_α [x^α×e; e]` | its impulse at node α (the weights sum to one) |
//! | `J, H` | Newton matrix and Hessian blocks, [`crate::del_hessian`] |
//! | `X` | change of the nodes |
//! | `η`, `ν` | variation of the pose, and of the velocity without its transport, as in [`crate::tangent`] |
//! | `κ` | change of the momenta `M(q) v` with the pose, at fixed velocity |
//!
//! ```text
//! J X = -c      c: joint rows S_iᵀF^α, i on the branch of the loaded body;  floating base: r^0: S^sᵀΣ_{α<s}F^α + S^0ᵀF^0, r^α: S^αᵀF^α
//! δp  = Σ_γ H[s,γ] X^γ + S^sᵀF^s                                              floating base: δP = Σ_γ ∂P^1/∂q^γ X^γ + Σ_{α<=s} F^α
//! δv  = M⁻¹ (δp - κ)     κ: ν_i = ν_par + Ṡδq, Dμ_i = M_iν_i + Σ_chd(Dμ_j - ad^D_{μ_j}S_jδq_j), κ_i = S_iᵀDμ_i
//!                        base: ν = ad_V η, κ_0 = Dμ_0 - ad^D_{μ_0} η
//! W   : δẋ = δv_body + (ν - ad_v η), evaluated at x, + ω×δx                     at the end of the step, v = M⁻¹ p_{k+1}
//! ```
//!
//! `J` and `H` are those of the last factorisation: W has the relative error of the nodes at which it was made.
//! Cost per point: three solves and O(Σ depth); no allocation. Lanes are columns here.
//!
//! Source: ours; `W` is the matrix of É. Delassus, *Mémoire sur la théorie des liaisons finies unilatérales*, 1917, for a step of
//! finite length.

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Vector3;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::{ModelError, StepError};
use crate::lanes::{Instructions, Quad};
use crate::newton_direction::NewtonDirection;
use crate::row_matrix::RowMatrix;
use crate::spatial::Wrench;
use crate::tree::KinematicTree;

mod boundary_motion;
mod end_momenta;

pub use boundary_motion::BoundaryMotion;
use end_momenta::{EndMomenta, MomentumTransport, PointVelocities, base_end};

/// A point of a body that carries a load.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoadPoint {
    /// Body index.
    pub body: usize,
    /// Point from the body's mass centre, link axes, m.
    pub point_b: Vector3<f64>,
}

/// Four columns of the variation of one body.
#[derive(Clone, Copy, Debug, Default)]
struct BodyColumns {
    eta: [Quad; 6],
    nu: [Quad; 6],
    d_momentum: [Quad; 6],
}

/// Workspace: columns of up to a fixed number of points.
#[derive(Clone, Debug)]
pub struct LoadResponse {
    instructions: Instructions,
    /// `X` for 1, 2, ... points: `s dof` rows, three columns per point.
    nodes: Vec<RowMatrix>,
    /// `δp`, then `δv`, likewise with `dof` rows.
    ends: Vec<RowMatrix>,
    /// Variation `η^s` of the base at the end: 6 rows.
    base_twists: Vec<RowMatrix>,
    columns: Vec<BodyColumns>,
    column: Vec<f64>,
    /// For factorisations that do not keep one.
    hessian: Option<DelHessian>,
    count: usize,
}

impl LoadResponse {
    /// For steps of `del` with up to `points` loads, solved by a factorisation like `solver`.
    pub fn new(
        tree: &KinematicTree,
        del: &DelWorkspace,
        solver: &impl NewtonDirection,
        points: usize,
    ) -> Self {
        let matrices =
            |rows: usize| (1..=points).map(|m| RowMatrix::zeros(rows, 3 * m)).collect::<Vec<RowMatrix>>();
        Self {
            instructions: del.instructions,
            nodes: matrices(del.unknown_nodes() * tree.dof()),
            ends: matrices(tree.dof()),
            base_twists: matrices(tree.base_dof()),
            columns: vec![BodyColumns::default(); tree.body_count()],
            column: vec![0.0; tree.dof()],
            hessian: solver.hessian().is_none().then(|| DelHessian::new(tree, del)),
            count: 0,
        }
    }

    /// Most points the workspace has room for.
    pub fn capacity(&self) -> usize {
        self.nodes.len()
    }

    /// Solves for the change of the nodes and momenta per unit impulse at each of the points, with the factors `solver` holds and
    /// the nodes last evaluated in `del`. Columns: `3 point + axis`, axes of {0}.
    ///
    /// # Errors
    /// [`ModelError::Length`] for no points or more than there is room for; [`ModelError::Unsupported`] for a body that does not exist.
    pub fn solve(
        &mut self,
        tree: &KinematicTree,
        del: &DelWorkspace,
        solver: &mut impl NewtonDirection,
        points: &[LoadPoint],
    ) -> Result<(), ModelError> {
        let (got, expected) = (points.len(), self.nodes.len());
        if got == 0 || got > expected {
            return Err(ModelError::Length { quantity: "load points", got, expected });
        }
        if let Some(point) = points.iter().find(|point| point.body >= tree.body_count()) {
            return Err(ModelError::Unsupported { body: point.body, reason: "a load point names no body" });
        }
        self.count = points.len();
        self.load_columns(tree, del, points);
        solver.solve_many(tree, &mut self.nodes[self.count - 1]);
        if let Some(hessian) = &mut self.hessian {
            hessian.evaluate(tree, del);
        }
        let Some(hessian) = self.hessian.as_ref().or_else(|| solver.hessian()) else {
            return Err(ModelError::Unsupported {
                body: 0,
                reason: "the factorisation has no Hessian blocks",
            });
        };
        let work = EndMomenta {
            tree,
            hessian,
            nodes: &self.nodes[self.count - 1],
            ends: &mut self.ends[self.count - 1],
        };
        self.instructions.dispatch(work);
        if tree.is_floating() {
            base_end(
                del,
                hessian,
                &self.nodes[self.count - 1],
                &mut self.ends[self.count - 1],
                &mut self.base_twists[self.count - 1],
                tree,
            );
        }
        self.add_end_impulses(tree, del, points);
        Ok(())
    }

    /// Change of the nodes per unit impulse, row `dof * s + γ - 1`, of the last [`LoadResponse::solve`].
    ///
    /// # Panics
    /// Never after a successful `solve`; an empty matrix stands in before the first.
    pub fn nodes(&self) -> Option<&RowMatrix> {
        self.nodes.get(self.count.wrapping_sub(1))
    }

    /// `W`, row-major `3m x 3m`: the velocities of the points at the end of the step per unit impulse, axes of {0}. Call after
    /// [`LoadResponse::solve`] with the same points, and the motion at the end of the step. The momentum columns are used up.
    ///
    /// # Errors
    /// [`ModelError::Length`] when `points` or `response` have another length than was solved for.
    pub fn velocity_response_into(
        &mut self,
        tree: &KinematicTree,
        motion: &mut BoundaryMotion,
        unknown_nodes: usize,
        points: &[LoadPoint],
        response: &mut [f64],
    ) -> Result<(), ModelError> {
        let m = self.count;
        crate::kinematics::check_length("load points", points.len(), m)?;
        crate::kinematics::check_length("response matrix", response.len(), 9 * m * m)?;
        motion.update_momenta(tree);
        let at = m - 1;
        let stride = self.ends[at].stride();
        for quad in 0..stride {
            self.instructions.dispatch(MomentumTransport {
                tree,
                motion,
                s: unknown_nodes,
                quad,
                nodes: &self.nodes[at],
                base_twists: &self.base_twists[at],
                ends: &mut self.ends[at],
                columns: &mut self.columns,
            });
            for lane in 0..4 {
                let c = 4 * quad + lane;
                if c < 3 * m {
                    for (dof, x) in self.column.iter_mut().enumerate() {
                        *x = self.ends[at].get(dof, c);
                    }
                    motion.factor.solve_in_place(&mut self.column)?;
                    for (dof, x) in self.column.iter().enumerate() {
                        self.ends[at].set(dof, c, *x);
                    }
                }
            }
            self.instructions.dispatch(PointVelocities {
                tree,
                motion,
                quad,
                ends: &self.ends[at],
                columns: &self.columns,
                points,
                response,
            });
        }
        Ok(())
    }

    /// Right-hand sides `-c`.
    fn load_columns(&mut self, tree: &KinematicTree, del: &DelWorkspace, points: &[LoadPoint]) {
        let s = del.unknown_nodes();
        let nodes = &mut self.nodes[self.count - 1];
        nodes.clear();
        for (index, point) in points.iter().enumerate() {
            for alpha in 0..=s {
                let x = del.body_pose(point.body, alpha).transform_point(&point.point_b);
                let weight = del.rule().weights()[alpha];
                if alpha < s {
                    for &dof in &tree.branch(point.body)[tree.base_dof().min(tree.branch(point.body).len())..]
                    {
                        let dof = dof as usize;
                        let linear = joint_point_rate(tree, del, dof, alpha, &x);
                        for k in 0..3 {
                            nodes.set(dof * s + alpha, 3 * index + k, -weight * linear[k]);
                        }
                    }
                }
                if tree.is_floating() && alpha < s {
                    for k in 0..3 {
                        let e = Vector3::ith(k, weight);
                        let impulse = Wrench::new(x.cross(&e), e);
                        let own = del.project_base(alpha, &impulse);
                        let end = del.project_base(s, &impulse);
                        for row in 0..6 {
                            nodes.add(row * s + alpha, 3 * index + k, -own[row]);
                            nodes.add(row * s, 3 * index + k, -end[row]);
                        }
                    }
                }
            }
        }
    }

    /// `S^sᵀF^s` of the joints, `Σ_α F^α` of the base.
    fn add_end_impulses(&mut self, tree: &KinematicTree, del: &DelWorkspace, points: &[LoadPoint]) {
        let s = del.unknown_nodes();
        let ends = &mut self.ends[self.count - 1];
        for (index, point) in points.iter().enumerate() {
            let weight = del.rule().weights()[s];
            let x = del.body_pose(point.body, s).transform_point(&point.point_b);
            for &dof in &tree.branch(point.body)[tree.base_dof().min(tree.branch(point.body).len())..] {
                let linear = joint_point_rate(tree, del, dof as usize, s, &x);
                for k in 0..3 {
                    ends.add(dof as usize, 3 * index + k, weight * linear[k]);
                }
            }
            if tree.is_floating() {
                let mut mean = Vector3::zeros();
                for alpha in 0..=s {
                    let x = del.body_pose(point.body, alpha).transform_point(&point.point_b);
                    mean += x * del.rule().weights()[alpha];
                }
                for k in 0..3 {
                    let e = Vector3::ith(k, 1.0);
                    let torque = mean.cross(&e);
                    for row in 0..3 {
                        ends.add(row, 3 * index + k, torque[row]);
                        ends.add(3 + row, 3 * index + k, e[row]);
                    }
                }
            }
        }
    }
}

/// Velocity of the place `x` at node `alpha` per unit rate of joint coordinate `dof`.
fn joint_point_rate(
    tree: &KinematicTree,
    del: &DelWorkspace,
    dof: usize,
    alpha: usize,
    x: &Vector3<f64>,
) -> Vector3<f64> {
    let body = if tree.is_floating() { dof - 5 } else { dof };
    let lanes = &del.bodies[body * del.groups + alpha / crate::lanes::LANES];
    let at = |k: usize| lanes.joint_twist[k].0[alpha % crate::lanes::LANES];
    Vector3::new(at(3), at(4), at(5)) + Vector3::new(at(0), at(1), at(2)).cross(x)
}

/// Point forces of a step, changed without starting it anew.
impl DelWorkspace {
    /// Sets the force (N, frame {0}) of the point force `index` of the step begun; the nodes stay where they are.
    ///
    /// # Errors
    /// [`StepError::NonFinite`] for a force that is not finite, [`ModelError::Length`] when the step has no such force.
    pub fn set_point_force(&mut self, index: usize, force_w: &Vector3<f64>) -> Result<(), StepError> {
        if let Some(bad) = force_w.iter().position(|x| !x.is_finite()) {
            return Err(StepError::NonFinite { quantity: "point force", index: bad });
        }
        let groups = self.groups;
        match self.load_forces.get_mut(index * groups..(index + 1) * groups) {
            Some(lanes) => {
                lanes.fill([0, 1, 2].map(|k| Quad::splat(force_w[k])));
                Ok(())
            }
            None => {
                let (got, expected) = (index + 1, self.load_forces.len() / groups);
                Err(ModelError::Length { quantity: "point forces", got, expected }.into())
            }
        }
    }
}
