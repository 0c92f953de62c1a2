//! Algorithm 1: evaluation of the discrete Euler-Lagrange (DEL) equations in O(s n).
//!
//! | letter | field | meaning (all in frame {0}, 6-vectors angular first) |
//! |---|---|---|
//! | `q^α`, `q̇^α` | `q`, `q_dot` | control nodes and their rates, `q̇^α = (1/Δt) Σ_β b^{αβ} q^β` |
//! | `g_i = (R, p)` | `rotation`, `position` | body frame: link axes, origin at the mass centre |
//! | `S_i`, `Ṡ_i` | `joint_twist`, `joint_twist_rate` | joint twist and its rate `ad_{v_i} S_i` |
//! | `v_i` | `velocity` | spatial velocity |
//! | `μ_i` | `momentum` | articulated momentum: of the body and all it carries |
//! | `Γ_i` | `impulse` | articulated impulse `w_α Δt F`, summed over the body and all it carries |
//!
//! ```text
//! outward  g_i = g_par g_{par,i}(q_i)     v_i = v_par + S_i q̇_i     Ṡ_i = ad_{v_i} S_i
//! inward   μ_i = M_i v_i + Σ_chd μ_j      Γ_i = w_α Δt F_i + Σ_chd Γ_j
//! rows     r_i^α = w_α Δt Ṡᵀμ + SᵀΓ + Σ_β a^{αβ} S^βᵀμ^β + w_α Δt Q_i        (+ p_i at α = 0; row s is p_i of the next state)
//! ```
//!
//! Cost: about 400 (s + 1) flops per body; no allocation after construction. Nodes are SIMD lanes.
//! Source: the paper, Algorithm 1 (line 20 of the print has a stray `end for`); rows of the floating base:
//! [`crate::floating_base`].

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Matrix6, Vector3};

use crate::errors::{ModelError, StepError};
use crate::floating_base::BaseLanes;
use crate::forces::{BodySample, JointForces, StepForces};
use crate::lanes::{Instructions, LANES, Quad};
use crate::lobatto::LobattoRule;
use crate::real::sin_cos;
use crate::spatial::{RigidTransform, Twist, Wrench, exp_rotation};
use crate::state::State;
use crate::tree::KinematicTree;

mod held_torque;
mod inward;
mod outward;

pub(crate) use held_torque::HeldTorque;
use inward::Inward;
pub(crate) use inward::{load_arm, weighted_sum};
use outward::Outward;
pub(crate) use outward::{own_momentum, rates};

/// One body at the nodes of one lane group.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct BodyLanes {
    pub rotation: [Quad; 9],
    pub position: [Quad; 3],
    pub joint_twist: [Quad; 6],
    pub joint_twist_rate: [Quad; 6],
    pub velocity: [Quad; 6],
    pub momentum: [Quad; 6],
    pub impulse: [Quad; 6],
}

/// A wrench whose direction in {0} does not follow the body: `f` at the end of an arm that is fixed in the body.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeadLoad {
    pub body: usize,
    /// From the mass centre, link axes.
    pub arm_b: [f64; 3],
    /// A couple `arm × f` without resultant force, instead of a force at the point.
    pub couple: bool,
}

/// Wrench of the laws on one body and its gains, at the nodes of one lane group.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GainLanes {
    /// Wrench that follows the body or depends on its motion: laws, drag, constant body wrench.
    pub wrench: [Quad; 6],
    /// `F_η`, row-major.
    pub eta: [Quad; 36],
    /// `F_ν`, row-major.
    pub nu: [Quad; 36],
}

impl GainLanes {
    const ZERO: Self = Self { wrench: [Quad::ZERO; 6], eta: [Quad::ZERO; 36], nu: [Quad::ZERO; 36] };
}

/// Room for forces outside the model, fixed when a workspace is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ForceCapacity {
    /// Largest number of point forces in a step.
    pub points: usize,
    /// Whether [`crate::forces::WrenchLaw`]s may be given.
    pub laws: bool,
}

/// Workspace of Algorithm 1: everything the step knows about its nodes.
#[derive(Clone, Debug)]
pub struct DelWorkspace {
    pub(crate) instructions: Instructions,
    pub(crate) rule: LobattoRule,
    pub(crate) time_step: f64,
    /// Lane groups: nodes 0..3, 4..7, ...
    pub(crate) groups: usize,
    /// `w_α Δt` per lane group; zero in unused lanes.
    pub(crate) weights: Vec<Quad>,
    /// `b^{αβ}/Δt`, lanes over α: `[β * groups + g]`.
    pub(crate) derivative: Vec<Quad>,
    /// `a^{αβ}`, lanes over α: `[β * groups + g]`.
    pub(crate) weighted_derivative: Vec<Quad>,
    /// Joint coordinates at the nodes relative to the start of the step, `q^α - q^0`, and the chart `ξ^α` of a floating base:
    /// `[dof * groups + g]`. Rates come from differences, which would lose digits in the coordinates themselves.
    pub(crate) q: Vec<Quad>,
    pub(crate) q_dot: Vec<Quad>,
    pub(crate) joint_forces: Vec<Quad>,
    /// `[body * groups + g]`.
    pub(crate) bodies: Vec<BodyLanes>,
    /// `[g]`, floating base only.
    pub(crate) base: Vec<BaseLanes>,
    /// Raw rows, lanes over α: `[dof * groups + g]`. Base rows lack the Γ term at node s.
    pub(crate) rows: Vec<Quad>,
    pub(crate) loads: Vec<DeadLoad>,
    /// Forces of the loads: `[load * groups + g]`.
    pub(crate) load_forces: Vec<[Quad; 3]>,
    /// Torques of the caller, kept from step to step.
    pub(crate) held_torques: Vec<HeldTorque>,
    /// `[body * groups + g]`, empty for models without body wrenches and laws.
    pub(crate) gains: Vec<GainLanes>,
    pub(crate) start: State,
    pub(crate) capacity: ForceCapacity,
    pub(crate) center: RigidTransform,
    /// `(n; m)` of [`crate::floating_base`], α = 0..s-1: the base rows that the Newton matrix takes for a wrench held in {0}.
    pub(crate) held_rows: Vec<[f64; 6]>,
    load_capacity: usize,
    projections: Vec<[Quad; 6]>,
    /// `(sin, cos)` of the joint coordinates at the start.
    start_sin_cos: Vec<(f64, f64)>,
}

impl DelWorkspace {
    /// A workspace for steps of `time_step` (s) of `tree` by `rule`.
    ///
    /// # Errors
    /// [`ModelError::TimeStep`] unless the step is positive and finite; [`ModelError::Processor`] on x86-64 older than AVX2
    /// (feature `portable`).
    pub fn new(
        tree: &KinematicTree,
        rule: &LobattoRule,
        time_step: f64,
        capacity: ForceCapacity,
    ) -> Result<Self, ModelError> {
        Self::with_loads(tree, rule, time_step, capacity, capacity.points)
    }

    pub(crate) fn with_loads(
        tree: &KinematicTree,
        rule: &LobattoRule,
        time_step: f64,
        capacity: ForceCapacity,
        load_capacity: usize,
    ) -> Result<Self, ModelError> {
        let groups = (rule.unknown_nodes() + LANES) / LANES;
        let nodes = rule.nodes().len();
        let (dof, bodies) = (tree.dof() * groups, tree.body_count() * groups);
        let gains = if tree.has_body_wrenches() || capacity.laws { bodies } else { 0 };
        let mut workspace = Self {
            instructions: Instructions::detect()?,
            rule: rule.clone(),
            time_step: 0.0,
            groups,
            weights: vec![Quad::ZERO; groups],
            derivative: vec![Quad::ZERO; nodes * groups],
            weighted_derivative: vec![Quad::ZERO; nodes * groups],
            q: vec![Quad::ZERO; dof],
            q_dot: vec![Quad::ZERO; dof],
            joint_forces: vec![Quad::ZERO; tree.joint_count() * groups],
            bodies: vec![BodyLanes::default(); bodies],
            base: vec![BaseLanes::default(); if tree.is_floating() { groups } else { 0 }],
            rows: vec![Quad::ZERO; dof],
            loads: Vec::with_capacity(load_capacity),
            load_forces: Vec::with_capacity(load_capacity * groups),
            held_torques: Vec::new(),
            gains: vec![GainLanes::ZERO; gains],
            start: State::zeros(tree),
            center: RigidTransform::identity(),
            capacity,
            held_rows: vec![[0.0; 6]; if tree.is_floating() { rule.unknown_nodes() } else { 0 }],
            load_capacity,
            projections: vec![[Quad::ZERO; 6]; groups],
            start_sin_cos: vec![(0.0, 1.0); tree.joint_count()],
        };
        for alpha in 0..nodes {
            for beta in 0..nodes {
                let at = beta * groups + alpha / LANES;
                workspace.weighted_derivative[at].0[alpha % LANES] = rule.weighted_derivative(alpha, beta);
            }
        }
        workspace.set_time_step(time_step)?;
        Ok(workspace)
    }

    /// Changes the time step (s).
    ///
    /// # Errors
    /// [`ModelError::TimeStep`] unless positive and finite.
    pub fn set_time_step(&mut self, time_step: f64) -> Result<(), ModelError> {
        if !(time_step.is_finite() && time_step > 0.0) {
            return Err(ModelError::TimeStep { time_step });
        }
        self.time_step = time_step;
        let nodes = self.rule.nodes().len();
        for alpha in 0..nodes {
            let (g, lane) = (alpha / LANES, alpha % LANES);
            self.weights[g].0[lane] = self.rule.weights()[alpha] * time_step;
            for beta in 0..nodes {
                self.derivative[beta * self.groups + g].0[lane] =
                    self.rule.derivative(alpha, beta) / time_step;
            }
        }
        Ok(())
    }

    /// Time step, s.
    pub fn time_step(&self) -> f64 {
        self.time_step
    }

    /// The quadrature rule.
    pub fn rule(&self) -> &LobattoRule {
        &self.rule
    }

    /// Unknown nodes `s`.
    pub fn unknown_nodes(&self) -> usize {
        self.rule.unknown_nodes()
    }

    /// Sets where the step starts and what acts during it. All nodes are put at the start (a floating base at its pose).
    ///
    /// # Errors
    /// [`ModelError::Length`] for slices of the wrong length or too many point forces; [`StepError::NonFinite`] naming the
    /// first NaN or infinite input.
    pub fn begin(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        forces: &StepForces<'_>,
    ) -> Result<(), StepError> {
        self.check_inputs(tree, state, forces)?;
        self.start.copy_from(state);
        for (turn, &q) in self.start_sin_cos.iter_mut().zip(&state.q) {
            *turn = sin_cos(q);
        }
        let groups = self.groups;
        self.q.fill(Quad::ZERO);
        self.set_joint_forces(tree, &forces.joints);
        self.loads.clear();
        self.load_forces.clear();
        for point in forces.points {
            self.loads.push(DeadLoad { body: point.body, arm_b: point.point_b.into(), couple: false });
            for _ in 0..groups {
                self.load_forces.push([0, 1, 2].map(|k| Quad::splat(point.force_w[k])));
            }
        }
        Ok(())
    }

    fn check_inputs(
        &self,
        tree: &KinematicTree,
        state: &State,
        forces: &StepForces<'_>,
    ) -> Result<(), StepError> {
        let length = |quantity, got: usize, expected: usize| {
            if got == expected { Ok(()) } else { Err(ModelError::Length { quantity, got, expected }) }
        };
        let finite = |quantity, values: &[f64]| match values.iter().position(|x| !x.is_finite()) {
            None => Ok(()),
            Some(index) => Err(StepError::NonFinite { quantity, index }),
        };
        let joints = tree.joint_count();
        length("tree (coordinates of the workspace)", tree.dof() * self.groups, self.q.len())?;
        length("joint coordinates q", state.q.len(), joints)?;
        length("momenta p", state.p.len(), tree.dof())?;
        finite("q", &state.q)?;
        finite("p", &state.p)?;
        finite("base rotation", state.base_pose.rotation.as_slice())?;
        finite("base position", state.base_pose.translation.as_slice())?;
        match forces.joints {
            JointForces::Held(u) => {
                length("held joint forces", u.len(), joints)?;
                finite("joint force", u)?;
            }
            JointForces::PerNode(u) => {
                length("joint forces per node", u.len(), joints * self.rule.nodes().len())?;
                finite("joint force", u)?;
            }
        }
        if forces.points.len() > self.capacity.points {
            return Err(ModelError::Length {
                quantity: "point forces (capacity of the workspace)",
                got: forces.points.len(),
                expected: self.capacity.points,
            }
            .into());
        }
        for point in forces.points {
            if point.body >= tree.body_count() {
                return Err(ModelError::Unsupported {
                    body: point.body,
                    reason: "a point force names no body",
                }
                .into());
            }
            finite("point force", point.force_w.as_slice())?;
            finite("point of a point force", point.point_b.as_slice())?;
        }
        if !forces.laws.is_empty() && !self.capacity.laws {
            return Err(ModelError::Unsupported {
                body: forces.laws[0].body(),
                reason: "the workspace was made without room for wrench laws",
            }
            .into());
        }
        match forces.laws.iter().find(|law| law.body() >= tree.body_count()) {
            Some(law) => {
                Err(ModelError::Unsupported { body: law.body(), reason: "a wrench law names no body" }.into())
            }
            None => Ok(()),
        }
    }

    fn set_joint_forces(&mut self, tree: &KinematicTree, forces: &JointForces<'_>) {
        let (groups, joints) = (self.groups, tree.joint_count());
        match forces {
            JointForces::Held(u) => {
                for (joint, &u) in u.iter().enumerate() {
                    self.joint_forces[joint * groups..(joint + 1) * groups].fill(Quad::splat(u));
                }
            }
            JointForces::PerNode(u) => {
                for (alpha, at_node) in u.chunks_exact(joints).enumerate() {
                    for (joint, &u) in at_node.iter().enumerate() {
                        self.joint_forces[joint * groups + alpha / LANES].0[alpha % LANES] = u;
                    }
                }
            }
        }
    }

    /// Adds a load whose force differs from node to node (constraint forces); returns its index.
    pub(crate) fn push_load(&mut self, load: DeadLoad) -> usize {
        debug_assert!(self.loads.len() < self.load_capacity, "more loads than the workspace was made for");
        self.loads.push(load);
        for _ in 0..self.groups {
            self.load_forces.push([Quad::ZERO; 3]);
        }
        self.loads.len() - 1
    }

    /// Coordinate `dof` at node `alpha`: joint coordinate, or chart coordinate of a floating base.
    #[inline]
    pub fn node(&self, alpha: usize, dof: usize) -> f64 {
        self.origin(dof) + self.q[dof * self.groups + alpha / LANES].0[alpha % LANES]
    }

    /// Joint coordinate at the start of the step; 0 for the chart of a floating base.
    #[inline(always)]
    fn origin(&self, dof: usize) -> f64 {
        let base = self.start.p.len() - self.start.q.len();
        if dof < base { 0.0 } else { self.start.q[dof - base] }
    }

    /// Rate of coordinate `dof` at node `alpha`.
    #[inline]
    pub fn node_rate(&self, alpha: usize, dof: usize) -> f64 {
        self.q_dot[dof * self.groups + alpha / LANES].0[alpha % LANES]
    }

    /// Sets coordinate `dof` at node `alpha` (1..=s). Node 0 of a floating base's chart follows node s by itself.
    #[inline]
    pub fn set_node(&mut self, alpha: usize, dof: usize, value: f64) {
        let origin = self.origin(dof);
        self.q[dof * self.groups + alpha / LANES].0[alpha % LANES] = value - origin;
    }

    /// Moves coordinate `dof` at node `alpha` (1..=s); keeps the digits of a change that is small beside the coordinate.
    #[inline]
    pub fn move_node(&mut self, alpha: usize, dof: usize, change: f64) {
        self.q[dof * self.groups + alpha / LANES].0[alpha % LANES] += change;
    }

    /// Pose of the body frame (link axes, origin at the mass centre) at node `alpha`, in {0}; valid after [`evaluate`].
    ///
    /// [`evaluate`]: DelWorkspace::evaluate
    pub fn body_pose(&self, body: usize, alpha: usize) -> RigidTransform {
        let lanes = &self.bodies[body * self.groups + alpha / LANES];
        let lane = alpha % LANES;
        RigidTransform {
            rotation: Matrix3::from_fn(|r, c| lanes.rotation[3 * r + c].0[lane]),
            translation: Vector3::from_fn(|r, _| lanes.position[r].0[lane]),
        }
    }

    /// Spatial velocity of a body at node `alpha`, in {0}; order `s` only, for wrench laws and logs, not for sensors.
    pub fn body_velocity(&self, body: usize, alpha: usize) -> Twist {
        let lanes = &self.bodies[body * self.groups + alpha / LANES];
        let at = |k: usize| lanes.velocity[k].0[alpha % LANES];
        Twist { angular: Vector3::new(at(0), at(1), at(2)), linear: Vector3::new(at(3), at(4), at(5)) }
    }

    /// Articulated momentum and impulse (`w_α Δt F`) of a body at node `alpha`, in {0}.
    pub fn body_momentum_and_impulse(&self, body: usize, alpha: usize) -> (Wrench, Wrench) {
        let lanes = &self.bodies[body * self.groups + alpha / LANES];
        let read = |v: &[Quad; 6]| {
            let at = |k: usize| v[k].0[alpha % LANES];
            Wrench { torque: Vector3::new(at(0), at(1), at(2)), force: Vector3::new(at(3), at(4), at(5)) }
        };
        (read(&lanes.momentum), read(&lanes.impulse))
    }

    /// Algorithm 1 at the present nodes: fills every body's lanes and the rows. O(s n), no allocation.
    pub fn evaluate(&mut self, tree: &KinematicTree, laws: &[&dyn crate::forces::WrenchLaw]) {
        if tree.is_floating() {
            self.center_chart();
        }
        let instructions = self.instructions;
        instructions.dispatch(Outward { tree, workspace: self, interpolate: true });
        if !self.gains.is_empty() {
            self.evaluate_laws(laws);
        }
        instructions.dispatch(Inward { tree, workspace: self });
    }

    /// Poses, velocities and articulated momenta of a fixed-base tree at separate states instead of nodes: lane `k` gets
    /// `(q, q̇)` number `k`.
    pub(crate) fn evaluate_states(&mut self, tree: &KinematicTree, states: &[(&[f64], &[f64])]) {
        self.start.q.fill(0.0);
        self.start_sin_cos.fill((0.0, 1.0));
        for (lane, (q, q_dot)) in states.iter().enumerate() {
            for dof in 0..tree.dof() {
                self.q[dof * self.groups].0[lane] = q[dof];
                self.q_dot[dof * self.groups].0[lane] = q_dot[dof];
            }
        }
        let instructions = self.instructions;
        instructions.dispatch(Outward { tree, workspace: self, interpolate: false });
        instructions.dispatch(Inward { tree, workspace: self });
    }

    /// `ξ^0 := -ξ^s` and the chart centre that puts node 0 at the given pose.
    fn center_chart(&mut self) {
        let s = self.unknown_nodes();
        let xi: [f64; 6] = core::array::from_fn(|k| self.node(s, k));
        for (k, value) in xi.iter().enumerate() {
            self.set_node(0, k, -value);
            // Unused lanes must stay finite.
            for unused in s + 1..self.groups * LANES {
                self.set_node(unused, k, -value);
            }
        }
        let rotation = self.start.base_pose.rotation * exp_rotation(&Vector3::new(xi[0], xi[1], xi[2]));
        let translation = self.start.base_pose.translation + rotation * Vector3::new(xi[3], xi[4], xi[5]);
        self.center = RigidTransform { rotation, translation };
    }

    fn evaluate_laws(&mut self, laws: &[&dyn crate::forces::WrenchLaw]) {
        for gain in &mut self.gains {
            *gain = GainLanes::ZERO;
        }
        for law in laws {
            let body = law.body();
            for alpha in 0..=self.unknown_nodes() {
                let sample = BodySample {
                    pose_w: self.body_pose(body, alpha),
                    velocity_w: self.body_velocity(body, alpha),
                    time: self.rule.nodes()[alpha] * self.time_step,
                };
                let answer = law.evaluate(&sample);
                let gain = &mut self.gains[body * self.groups + alpha / LANES];
                let lane = alpha % LANES;
                let wrench = answer.wrench_w.to_vector();
                for k in 0..6 {
                    gain.wrench[k].0[lane] += wrench[k];
                }
                add_matrix(&mut gain.eta, &answer.d_pose, lane);
                add_matrix(&mut gain.nu, &answer.d_velocity, lane);
            }
        }
        self.add_torques_to_gains();
    }

    /// The DEL residual `r^α`, `α = 0..s-1`, coordinate-major: entry `dof * s + α`. O(s n).
    ///
    /// # Panics
    /// Never; `out` must hold `s` times the number of coordinates (debug-checked).
    pub fn residual_into(&self, tree: &KinematicTree, out: &mut [f64]) {
        let s = self.unknown_nodes();
        debug_assert_eq!(out.len(), s * tree.dof());
        let base = tree.base_dof();
        for dof in 0..tree.dof() {
            for alpha in 0..s {
                out[dof * s + alpha] = self.rows[dof * self.groups + alpha / LANES].0[alpha % LANES];
            }
        }
        for dof in base..tree.dof() {
            out[dof * s] += self.start.p[dof];
        }
        if tree.is_floating() {
            let momentum = self.start_momentum();
            let before_end = self.base_momentum_before_end();
            let first = self.project_base(0, &momentum);
            let last = self.project_base(s, &before_end);
            for k in 0..6 {
                let row_s = self.rows[k * self.groups + s / LANES].0[s % LANES];
                out[k * s] += first[k] + last[k] - row_s;
            }
        }
    }

    /// Momenta at the end of the step: row s, and `P^1` of a floating base. Meaningful once the residual is zero. O(n).
    pub fn next_momentum_into(&self, tree: &KinematicTree, out: &mut [f64]) {
        let s = self.unknown_nodes();
        for (dof, p) in out.iter_mut().enumerate().take(tree.dof()) {
            *p = self.rows[dof * self.groups + s / LANES].0[s % LANES];
        }
        if tree.is_floating() {
            let (_, end_impulse) = self.body_momentum_and_impulse(0, s);
            let total = self.base_momentum_before_end() + end_impulse;
            out[..6].copy_from_slice(total.to_vector().as_slice());
        }
    }

    pub(crate) fn start_momentum(&self) -> Wrench {
        let p = &self.start.p;
        Wrench { torque: Vector3::new(p[0], p[1], p[2]), force: Vector3::new(p[3], p[4], p[5]) }
    }

    /// `G = P^0 + Σ_{α<s} Γ^α` of a floating base.
    pub(crate) fn base_momentum_before_end(&self) -> Wrench {
        let mut total = self.start_momentum();
        for alpha in 0..self.unknown_nodes() {
            total += self.body_momentum_and_impulse(0, alpha).1;
        }
        total
    }

    /// `Z^α` and the mass centre `p^α` of the floating base.
    pub(crate) fn base_turn_and_position(&self, alpha: usize) -> (Matrix3<f64>, Vector3<f64>) {
        let base = &self.base[alpha / LANES];
        let lane = alpha % LANES;
        let z = Matrix3::from_fn(|r, c| base.z[3 * r + c].0[lane]);
        (z, Vector3::from_fn(|r, _| base.position[r].0[lane]))
    }

    /// `S^αᵀ X` of the floating base.
    pub(crate) fn project_base(&self, alpha: usize, wrench: &Wrench) -> [f64; 6] {
        let (z, position) = self.base_turn_and_position(alpha);
        let upper = z.tr_mul(&(wrench.torque - position.cross(&wrench.force)));
        let lower = self.center.rotation.tr_mul(&wrench.force);
        [upper.x, upper.y, upper.z, lower.x, lower.y, lower.z]
    }

    /// The state at the end of the step. Meaningful once the residual is zero. O(n).
    pub fn next_state_into(&self, tree: &KinematicTree, out: &mut State) {
        let s = self.unknown_nodes();
        for (joint, q) in out.q.iter_mut().enumerate() {
            *q = self.node(s, tree.base_dof() + joint);
        }
        if tree.is_floating() {
            let mut pose = self.body_pose(0, s);
            // One Newton step towards the nearest rotation; momentum is not touched by it.
            pose.rotation =
                pose.rotation * (Matrix3::identity() * 3.0 - pose.rotation.tr_mul(&pose.rotation)) * 0.5;
            out.base_pose = pose;
        }
        self.next_momentum_into(tree, &mut out.p);
    }
}

fn add_matrix(target: &mut [Quad; 36], matrix: &Matrix6<f64>, lane: usize) {
    for r in 0..6 {
        for c in 0..6 {
            target[6 * r + c].0[lane] += matrix[(r, c)];
        }
    }
}
