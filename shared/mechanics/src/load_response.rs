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
use nalgebra::{Matrix6, Vector3, Vector6};

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::{ModelError, StepError};
use crate::kinematics::{Configuration, Kinematics, Velocity};
use crate::lanes::{
    Instructions, Kernel, Lane, Lane3, Lane6, Quad, Simd, add, bracket, cross, cross_add, dot6, dual_bracket,
    halves, join, load, load_strided, scale, scale_add, splat, store, sub, sym_vec,
};
use crate::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::newton_direction::{NewtonDirection, base_matrix};
use crate::row_matrix::RowMatrix;
use crate::spatial::{SpatialInertia, Twist, Wrench};
use crate::state::State;
use crate::tree::{KinematicTree, NO_PARENT};

/// A point of a body that carries a load.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoadPoint {
    /// Body index.
    pub body: usize,
    /// Point from the body's mass centre, link axes, m.
    pub point_b: Vector3<f64>,
}

/// Poses and velocities at a step boundary, from the state alone: `v = M(q)⁻¹ p`.
#[derive(Clone, Debug)]
pub struct BoundaryMotion {
    kinematics: Kinematics,
    composites: MassMatrixWorkspace,
    mass_matrix: Vec<f64>,
    factor: MassMatrixFactor,
    velocity: Vec<f64>,
    inertias_w: Vec<SpatialInertia>,
    momenta_w: Vec<Wrench>,
}

impl BoundaryMotion {
    /// Room for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        Self {
            kinematics: Kinematics::new(tree),
            composites: MassMatrixWorkspace::new(tree),
            mass_matrix: vec![0.0; tree.dof() * tree.dof()],
            factor: MassMatrixFactor::new(tree),
            velocity: vec![0.0; tree.dof()],
            inertias_w: vec![SpatialInertia::default(); tree.body_count()],
            momenta_w: vec![Wrench::default(); tree.body_count()],
        }
    }

    /// Poses, mass matrix, its factor, and the velocity of `state`. O(Σ depth²), no allocation.
    ///
    /// # Errors
    /// When the state does not fit the tree or the mass matrix is singular.
    pub fn update(&mut self, tree: &KinematicTree, state: &State) -> Result<(), StepError> {
        self.kinematics.update_positions(tree, &Configuration::of(state))?;
        mass_matrix_into(tree, &self.kinematics, &mut self.composites, &mut self.mass_matrix)?;
        self.factor.factorise(&self.mass_matrix)?;
        if state.p.len() != self.velocity.len() {
            let (got, expected) = (state.p.len(), self.velocity.len());
            return Err(ModelError::Length { quantity: "momenta p", got, expected }.into());
        }
        self.velocity.copy_from_slice(&state.p);
        self.factor.solve_in_place(&mut self.velocity)?;
        let (base, joints) = self.velocity.split_at(tree.base_dof());
        let rates = if base.is_empty() {
            Velocity::fixed(joints)
        } else {
            Velocity::floating(Twist::from_vector(&Vector6::from_column_slice(base)), joints)
        };
        self.kinematics.update_velocities(tree, &rates)?;
        Ok(())
    }

    /// Poses and velocities of the bodies.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Generalised velocity; a floating base starts with its spatial twist in {0} (angular, linear).
    pub fn velocity(&self) -> &[f64] {
        &self.velocity
    }

    /// Mass matrix, row-major.
    pub fn mass_matrix(&self) -> &[f64] {
        &self.mass_matrix
    }

    /// Its factor.
    pub fn factor(&self) -> &MassMatrixFactor {
        &self.factor
    }

    /// Where a point is, in {0}, m.
    pub fn point_w(&self, point: &LoadPoint) -> Vector3<f64> {
        self.kinematics.mass_centre_pose_w(point.body).transform_point(&point.point_b)
    }

    /// Velocity of the body at the place `x_w`, in {0}, m/s.
    pub fn velocity_at_w(&self, body: usize, x_w: &Vector3<f64>) -> Vector3<f64> {
        let twist = &self.kinematics.velocities_w()[body];
        twist.linear + twist.angular.cross(x_w)
    }

    /// Inertias and articulated momenta of all bodies.
    fn update_momenta(&mut self, tree: &KinematicTree) {
        for i in 0..tree.body_count() {
            self.inertias_w[i] = self.kinematics.inertia_w(tree, i);
            self.momenta_w[i] = self.inertias_w[i].mul_twist(&self.kinematics.velocities_w()[i]);
        }
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let carried = self.momenta_w[i];
                self.momenta_w[parent] += carried;
            }
        }
    }
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

/// `Σ_γ H[s,γ] X^γ` of the joint rows and `Σ_γ ∂P^1/∂q^γ X^γ` (without the rigid shift) of the base rows.
struct EndMomenta<'a> {
    tree: &'a KinematicTree,
    hessian: &'a DelHessian,
    nodes: &'a RowMatrix,
    ends: &'a mut RowMatrix,
}

impl Kernel for EndMomenta<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, hessian, nodes, ends } = self;
        let s = hessian.s;
        let stride = nodes.stride();
        ends.clear();
        for i in tree.first_joint_body()..tree.body_count() {
            let dof = tree.joint_dof(i);
            let first_pair = hessian.pair_starts[i];
            for (position, &column) in tree.branch(i).iter().enumerate() {
                let j = column as usize;
                let pair = first_pair + position;
                for gamma in 1..=s {
                    let mut entry = hessian.entry(pair, s, gamma);
                    if j < tree.base_dof() && gamma == s {
                        entry -= hessian.entry(pair, s, 0);
                    }
                    accumulate(simd, nodes, j * s + gamma - 1, entry, ends, dof, stride);
                    if j >= tree.base_dof() && j != dof {
                        let entry = hessian.mirrored(pair, s, gamma);
                        accumulate(simd, nodes, dof * s + gamma - 1, entry, ends, j, stride);
                    }
                }
            }
            if tree.is_floating() {
                for gamma in 1..=s {
                    let impulse = hessian.impulse_column(dof, gamma);
                    for (row, factor) in impulse.into_iter().enumerate() {
                        accumulate(simd, nodes, dof * s + gamma - 1, factor, ends, row, stride);
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn accumulate<S: Simd>(
    simd: S,
    source: &RowMatrix,
    from: usize,
    factor: f64,
    target: &mut RowMatrix,
    to: usize,
    stride: usize,
) {
    let factor = Lane::splat(simd, factor);
    let source = &source.quads()[from * stride..(from + 1) * stride];
    let target = &mut target.quads_mut()[to * stride..(to + 1) * stride];
    for (t, x) in target.iter_mut().zip(source) {
        *t = factor.mul_add(Lane::load(simd, x), Lane::load(simd, t)).quad();
    }
}

/// The base's part of the end momenta, and its variation `η^s = (S^0 + S^s) δξ^s`.
fn base_end(
    del: &DelWorkspace,
    hessian: &DelHessian,
    nodes: &RowMatrix,
    ends: &mut RowMatrix,
    base_twists: &mut RowMatrix,
    tree: &KinematicTree,
) {
    let s = del.unknown_nodes();
    let (start, end) = (base_matrix(del, 0), base_matrix(del, s));
    // Response of P^1 to δξ^γ; that of γ = s includes node 0 and the rigid shift S^0 δξ^s of the chart centre.
    let impulse_at = |gamma: usize| Matrix6::from_fn(|r, k| hessian.impulse_column(k, gamma)[r]);
    let mut shift = Matrix6::zeros();
    for alpha in 0..=s {
        let rows = Matrix6::from_fn(|k, c| hessian.shift_row(k, alpha)[c]);
        let gain = base_matrix(del, alpha).transpose().lu().solve(&rows).unwrap_or_else(Matrix6::zeros);
        let (_, impulse) = del.body_momentum_and_impulse(0, alpha);
        let turned = Matrix6::from_fn(|r, c| {
            impulse.dual_bracket(&Twist::from_vector(&Vector6::ith(c, 1.0))).to_vector()[r]
        });
        shift += gain - turned;
    }
    let last = impulse_at(s) - impulse_at(0) + shift * start;
    for c in 0..nodes.columns() {
        let mut change = Vector6::from_fn(|r, _| ends.get(r, c));
        for gamma in 1..=s {
            let xi = Vector6::from_fn(|k, _| nodes.get(k * s + gamma - 1, c));
            if gamma < s {
                change += impulse_at(gamma) * xi;
            } else {
                change += last * xi;
                let rigid = start * xi;
                let eta = rigid + end * xi;
                for r in 0..6 {
                    base_twists.set(r, c, eta[r]);
                }
                for i in 1..tree.body_count() {
                    let dof = tree.joint_dof(i);
                    let row = hessian.shift_row(dof, s);
                    let sum: f64 = row.iter().zip(rigid.iter()).map(|(a, b)| a * b).sum();
                    ends.add(dof, c, sum);
                }
            }
        }
        for r in 0..6 {
            ends.set(r, c, change[r]);
        }
    }
}

#[inline(always)]
fn twist_lanes<S: Simd>(simd: S, twist: &Twist) -> Lane6<S> {
    join(splat(simd, &twist.angular.into()), splat(simd, &twist.linear.into()))
}

/// `ends -= κ`, and `η, ν` of all bodies, for one quad of columns.
struct MomentumTransport<'a> {
    tree: &'a KinematicTree,
    motion: &'a BoundaryMotion,
    s: usize,
    quad: usize,
    nodes: &'a RowMatrix,
    base_twists: &'a RowMatrix,
    ends: &'a mut RowMatrix,
    columns: &'a mut [BodyColumns],
}

impl Kernel for MomentumTransport<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, motion, s, quad, nodes, base_twists, ends, columns } = self;
        let stride = nodes.stride();
        let kinematics = &motion.kinematics;
        let zero = [Lane::splat(simd, 0.0); 6];
        if tree.is_floating() {
            let eta: Lane6<S> = load_strided(simd, base_twists.quads(), quad, stride);
            let velocity = twist_lanes(simd, &kinematics.velocities_w()[0]);
            columns[0].eta = store(eta);
            columns[0].nu = store(bracket(velocity, eta));
        }
        for i in tree.first_joint_body()..tree.body_count() {
            let parent = tree.constants()[i].parent;
            let (eta, nu) = if parent == NO_PARENT {
                (zero, zero)
            } else {
                (load(simd, &columns[parent].eta), load(simd, &columns[parent].nu))
            };
            let dof = tree.joint_dof(i);
            let dq = Lane::load(simd, &nodes.quads()[(dof * s + s - 1) * stride + quad]);
            let twist = twist_lanes(simd, &kinematics.joint_twists_w()[i]);
            let rate = kinematics.velocities_w()[i].bracket(&kinematics.joint_twists_w()[i]);
            columns[i].eta = store(scale_add(dq, twist, eta));
            columns[i].nu = store(scale_add(dq, twist_lanes(simd, &rate), nu));
        }
        for i in 0..tree.body_count() {
            let nu = load(simd, &columns[i].nu);
            columns[i].d_momentum = store(inertia_times(simd, &motion.inertias_w[i], nu));
        }
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let d_momentum: Lane6<S> = load(simd, &columns[i].d_momentum);
            let twist = twist_lanes(simd, &kinematics.joint_twists_w()[i]);
            let dof = tree.joint_dof(i);
            let target = &mut ends.quads_mut()[dof * stride + quad];
            *target = (Lane::load(simd, target) - dot6(twist, d_momentum)).quad();
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let dq = Lane::load(simd, &nodes.quads()[(dof * s + s - 1) * stride + quad]);
                let momentum = momentum_lanes(simd, &motion.momenta_w[i]);
                let moved = sub(d_momentum, dual_bracket(momentum, scale(dq, twist)));
                columns[parent].d_momentum = store(add(load(simd, &columns[parent].d_momentum), moved));
            }
        }
        if tree.is_floating() {
            let momentum = momentum_lanes(simd, &motion.momenta_w[0]);
            let eta = load(simd, &columns[0].eta);
            let change = sub(load(simd, &columns[0].d_momentum), dual_bracket(momentum, eta));
            for (k, change) in change.into_iter().enumerate() {
                let target = &mut ends.quads_mut()[k * stride + quad];
                *target = (Lane::load(simd, target) - change).quad();
            }
        }
    }
}

#[inline(always)]
fn momentum_lanes<S: Simd>(simd: S, momentum: &Wrench) -> Lane6<S> {
    join(splat(simd, &momentum.torque.into()), splat(simd, &momentum.force.into()))
}

#[inline(always)]
fn inertia_times<S: Simd>(simd: S, inertia: &SpatialInertia, x: Lane6<S>) -> Lane6<S> {
    let (omega, linear) = halves(x);
    let j = &inertia.rotational;
    let rotational: Lane6<S> =
        splat(simd, &[j[(0, 0)], j[(1, 1)], j[(2, 2)], j[(0, 1)], j[(0, 2)], j[(1, 2)]]);
    let h: Lane3<S> = splat(simd, &inertia.first_moment.into());
    let force = sub(scale(Lane::splat(simd, inertia.mass), linear), cross(h, omega));
    join(cross_add(h, linear, sym_vec(&rotational, omega)), force)
}

/// Velocities of the points, for one quad of columns.
struct PointVelocities<'a> {
    tree: &'a KinematicTree,
    motion: &'a BoundaryMotion,
    quad: usize,
    ends: &'a RowMatrix,
    columns: &'a [BodyColumns],
    points: &'a [LoadPoint],
    response: &'a mut [f64],
}

impl Kernel for PointVelocities<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { tree, motion, quad, ends, columns, points, response } = self;
        let stride = ends.stride();
        let width = 3 * points.len();
        let mut last_body = usize::MAX;
        let mut change = [Lane::splat(simd, 0.0); 6];
        for (index, point) in points.iter().enumerate() {
            let velocity = twist_lanes(simd, &motion.kinematics.velocities_w()[point.body]);
            let eta: Lane6<S> = load(simd, &columns[point.body].eta);
            if point.body != last_body {
                last_body = point.body;
                change = sub(load(simd, &columns[point.body].nu), bracket(velocity, eta));
                for &dof in tree.branch(point.body) {
                    let dof = dof as usize;
                    let twist = twist_lanes(simd, &motion.kinematics.column_twist_w(tree, dof));
                    let rate = Lane::load(simd, &ends.quads()[dof * stride + quad]);
                    change = scale_add(rate, twist, change);
                }
            }
            let x: Lane3<S> = splat(simd, &motion.point_w(point).into());
            let (turned, shifted) = halves(eta);
            let moved = cross_add(turned, x, shifted);
            let (spin, slide) = halves(change);
            let point_velocity = cross_add(halves(velocity).0, moved, cross_add(spin, x, slide));
            for (row, lanes) in point_velocity.into_iter().enumerate() {
                let values = lanes.quad().0;
                for (lane, value) in values.into_iter().enumerate() {
                    let c = 4 * quad + lane;
                    if c < width {
                        response[(3 * index + row) * width + c] = value;
                    }
                }
            }
        }
    }
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
