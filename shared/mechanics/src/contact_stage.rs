//! The Simpson stage of a floating robot with a set of contacts: solved, or linearised without being solved ("lifted").
//!
//! | letter | meaning |
//! |---|---|
//! | `x = (ε, δq, δV_body, δq̇)` | local coordinates of a [`BoundaryState`], `2 nv`, `nv = 6 + joints` |
//! | `Ξ = (ξ^1..ξ^s, q^1..q^s)` | nodes of the stage, [`crate::floating_base`]; `r`, `J` their residual and Newton matrix |
//! | `λ^0..λ^s` | contact impulses at the nodes; `f = Σ λ^α/Δt` the mean forces |
//! | `h`, `C_h` | leaf constraint and its derivative: the foot stays where it is *at the start of the stage* |
//! | `y = G v`, `C` | velocities of the contact rows, and their map from the twist of the body; force and velocity use the same `C` |
//! | `W` | `G 𝓜⁻¹ Gᵀ` at the end |
//! | `Φ`, `e` | end of the stage as it is, and its distance from the next boundary state |
//!
//! C-RATTLE ([`crate::constraints`]) on the chart-free base. A contact has position rows along its ground axes `T = (t1, t2, n)`, a flat
//! foot rotation rows before them:
//!
//! ```text
//! h = T^T ½ Σ_j r_j^0×r_j^γ ; T^T (x^γ - x^0)        y = T^T ω ; T^T (v + ω×x)          wrench of λ about {0}: [τ + x×f; f]
//! δh^γ = C_h η^γ - C_h0 η^0     C_h = [T^T E 0; T^T[-x^ 1]], C_h0 with E^T and x^0,     E = ½(tr(R_f^0T R_f^γ) 1 - R_f^γ R_f^0T)
//! 1  Γ^α += C^αT λ^α, α = 0..s      (gain of the wrench: [τ×η_ω + x×(f×η_ω); f×η_ω])
//! 2  h^γ = 0, γ = 1..s              interior nodes too: without them the order falls to 2
//! 3  P, p_j += C^T λ^s so that G 𝓜⁻¹(P; p_j) = 0
//! ```
//!
//! A start with `G v ≠ 0` is a touchdown: the inelastic impact is in `λ^0`. With the leaf, `A` keeps its meaning for feet that are not
//! where they were planned; the model holds them where they are, drift is for the next measurement to correct.
//!
//! **Lifted stage.** Nothing is solved; rows, constraint values, end and their derivatives are evaluated once at the nominal:
//!
//! ```text
//! [J 𝒜; 𝒢 ρσ] [δΞ; δΛ] = -[r; h] - [R_x; H_x] x - [R_u; 0] u        X = J⁻¹𝒜,  (𝒢X - ρσ) δΛ = 𝒢Z + h + H_x x,  δΞ = Z - X δΛ
//! x'_raw = T⁻¹(e + Φ_x x + Φ_u u + Φ_Ξ δΞ + Φ_Λ δΛ)                  T, Y, W, y at the next boundary state
//! δλ^s = -W⁻¹(y + Y x'_raw),    x_{k+1} = x'_raw + [0; 𝓜⁻¹G_s^T] δλ^s = A x + B u + d,     f = f_0 + F_x x + F_u u
//! ```
//!
//! where `W = G 𝓜⁻¹ G_s^T` with the force map `G_s` at node s.
//!
//! **Dependent rows** (several points of one body, straight knees): proximal regularisation ρ, `σ = Δt tr(W)/m`, and `ρ tr(W)/m` in the end
//! projection. It acts on the change of the multipliers, so there is no bias at convergence; 1e-8 serves.
//!
//! Cost of a linearisation: factorisation of J, `1 + 2 nv + joints + s m` solves, `(s m)³`, products of `2 s m` rows per column.
//!
//! Source: ours; C-RATTLE: L. O. Jay, SIAM J. Numer. Anal. 33, 1996; lifting: J. Albersmeyer, M. Diehl, SIAM J. Optim. 20, 2010.

use alloc::vec;
use alloc::vec::Vec;

use crate::branch_lu::BranchLu;
use crate::del_residual::{DelWorkspace, ForceCapacity, HeldTorque};
use crate::dense_lu::DenseLu;
use crate::errors::{ModelError, StepError};
use crate::kinematics::check_length;
use crate::lanes::Quad;
use crate::lobatto::LobattoRule;
use crate::row_matrix::RowMatrix;
use crate::state::State;
use crate::step::{Integrator, StepOptions};
use crate::tree::KinematicTree;
use nalgebra::{Matrix3, Vector6};

mod boundary_kinematics;
mod boundary_state;
mod contact;
mod end;
mod lifted;
mod newton;
mod nodes;
mod nominal;
mod projection;
mod right_hand_sides;
mod row_product;
mod saddle;

pub use boundary_kinematics::BoundaryKinematics;
pub use boundary_state::BoundaryState;
pub use contact::{Contact, ContactKind, MAX_ROWS, Placement};
pub use lifted::LiftedStage;
pub use nominal::StageNominal;
pub use projection::ContactProjection;

use row_product::SparseRows;

/// Rows whose pivot falls below this, relative to their own, depend on the others.
const DEPENDENT_ROW: f64 = 1e-12;

/// Workspace of one stage of a floating robot, allocated once for a tree, a rule and all contacts the robot may have.
///
/// Stages of a horizon are independent of each other. Linearised one after the other, neighbours share the kinematics of the boundary
/// between them; threads take a clone each.
///
/// # Example
/// A trunk balanced on one leg with a flat foot:
/// ```
/// use delmpc_mechanics::contact_stage::{BoundaryState, Contact, ContactStage};
/// use delmpc_mechanics::prelude::*;
/// let trunk = LinkInertia::new(2.0, Vector3::zeros(), Matrix3::identity() * 0.01);
/// let mut builder = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), trunk);
/// let leg = LinkInertia::new(1.0, Vector3::new(0.0, 0.0, -0.2), Matrix3::identity() * 0.004);
/// let hip = Joint::revolute(Vector3::y(), RigidTransform::identity());
/// let shank = builder.add(Body::new(Some(0), hip, leg));
/// let tree = builder.build()?;
/// let foot = Contact::foot(shank, Vector3::new(0.0, 0.0, -0.4), Matrix3::identity());
/// let mut stage = ContactStage::new(&tree, &LobattoRule::new(2)?, &[foot])?;
/// let (mut nominal, mut lifted) = (stage.nominal(), stage.lifted());
/// let start = BoundaryState::zeros(&tree);
/// let mut end = start.clone();
/// let (dt, u) = (0.02, [0.0]);
/// stage.solve(&tree, dt, &[true], &start, &u, &mut nominal, &mut end)?;
/// stage.linearize(&tree, dt, &[true], &start, &nominal, &u, &end, &mut lifted)?;
/// let weight = 3.0 * 9.81;
/// assert!((lifted.force_row(5)[0] - weight).abs() < 1e-9); // last row of the foot: normal force
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct ContactStage {
    contacts: Vec<Contact>,
    /// First row of every contact among all rows, and their number.
    first_rows: Vec<usize>,
    regularisation: f64,
    del: DelWorkspace,
    solver: BranchLu,
    /// The step without active contacts.
    flight: Integrator,
    start: BoundaryKinematics,
    end: BoundaryKinematics,
    projection: ContactProjection,
    state: State,
    active: Vec<ActiveRow>,
    /// `[node * contacts + contact]`.
    placements: Vec<Placement>,
    /// Change of the momentum at the end, in base axes there, by node γ: `[dof (s + 1) + γ]`.
    impulses: Vec<Vector6<f64>>,
    /// `[1 | x | u]` right-hand sides, then `𝒜`; row `dof * s + node`.
    columns: RowMatrix,
    /// `𝒢Z + h`, then `δΛ`: row `(γ - 1) * m + row`, or `α * m + row`.
    multipliers: RowMatrix,
    /// `x'_raw`, then `x_{k+1}`.
    ends: RowMatrix,
    end_multipliers: RowMatrix,
    /// `𝓜⁻¹G_s^T` in the lower `nv` rows.
    end_responses: RowMatrix,
    schur: DenseLu,
    /// `X = J⁻¹𝒜`, row-major.
    responses: Vec<f64>,
    gradient: SparseRows,
    end_of_nodes: SparseRows,
    end_of_multipliers: SparseRows,
    relatives: end::Relatives,
    /// `∂y/∂(ε, q)` of one contact.
    velocity_gradient: Vec<f64>,
    residual: Vec<f64>,
    change: Vec<f64>,
}

/// A row of an active contact.
#[derive(Clone, Copy, Debug)]
struct ActiveRow {
    contact: usize,
    /// Of the 3 or 6 of its kind.
    row: usize,
    /// Among the rows of all contacts.
    of_all: usize,
}

impl ContactStage {
    /// For steps of a floating `tree` by `rule` with any subset of `contacts`.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for a fixed base or a contact of no body; as [`DelWorkspace::new`].
    pub fn new(tree: &KinematicTree, rule: &LobattoRule, contacts: &[Contact]) -> Result<Self, ModelError> {
        boundary_kinematics::check_floating(tree)?;
        let mut first_rows = vec![0];
        for contact in contacts {
            contact.check(tree)?;
            first_rows.push(first_rows[first_rows.len() - 1] + contact.row_count());
        }
        let m = first_rows[contacts.len()];
        let (nv, nu, s) = (tree.dof(), tree.joint_count(), rule.unknown_nodes());
        let mut del = DelWorkspace::with_loads(tree, rule, 1.0, ForceCapacity::default(), contacts.len())?;
        for contact in contacts.iter().filter(|c| c.kind == ContactKind::Foot) {
            let torque_w = vec![[Quad::ZERO; 3]; del.groups];
            del.held_torques.push(HeldTorque { body: contact.body, torque_w });
        }
        let columns = 1 + 2 * nv + nu;
        let projection = ContactProjection::new(tree, contacts);
        let relatives = end::Relatives::new(tree);
        let longest = (0..tree.body_count()).map(|i| tree.branch(i).len()).max().unwrap_or(6);
        Ok(Self {
            contacts: contacts.to_vec(),
            first_rows,
            regularisation: 0.0,
            solver: BranchLu::new(tree, &del),
            flight: Integrator::new(tree, rule, 1.0, StepOptions::default())?,
            start: BoundaryKinematics::new(tree)?,
            end: BoundaryKinematics::new(tree)?,
            projection,
            state: State::zeros(tree),
            active: Vec::with_capacity(m),
            placements: vec![Placement::none(); (s + 1) * contacts.len()],
            impulses: vec![Vector6::zeros(); nv * (s + 1)],
            columns: RowMatrix::zeros(s * nv, columns + s * m),
            multipliers: RowMatrix::zeros(s * m, columns + s * m),
            ends: RowMatrix::zeros(2 * nv, columns),
            end_multipliers: RowMatrix::zeros(m, columns),
            end_responses: RowMatrix::zeros(2 * nv, m),
            schur: DenseLu::new(s * m),
            responses: vec![0.0; s * nv * (s * m).max(1)],
            gradient: SparseRows::new(s * m, s * m * (12 + longest)),
            end_of_nodes: end::end_pattern(&relatives, nv, s),
            end_of_multipliers: SparseRows::new(m.max(6), 6 * s * m + 2 * m * longest),
            relatives,
            velocity_gradient: vec![0.0; MAX_ROWS * nv],
            residual: vec![0.0; s * nv],
            change: vec![0.0; nv],
            del,
        })
    }

    /// The same with the proximal regularisation ρ (0: none; 1e-8 where rows depend on each other).
    pub fn with_regularisation(self, regularisation: f64) -> Self {
        Self { regularisation, ..self }
    }

    /// All contacts.
    pub fn contacts(&self) -> &[Contact] {
        &self.contacts
    }

    /// Other ground axes (columns `t1, t2, n` in {0}) for contact `contact`.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a contact that does not exist; [`ModelError::NotFinite`].
    pub fn set_axes(&mut self, contact: usize, axes_w: Matrix3<f64>) -> Result<(), ModelError> {
        let expected = self.contacts.len();
        let Some(target) = self.contacts.get_mut(contact) else {
            return Err(ModelError::Length { quantity: "contacts", got: contact + 1, expected });
        };
        if !axes_w.iter().all(|x| x.is_finite()) {
            return Err(ModelError::NotFinite { body: target.body, quantity: "ground axes" });
        }
        target.axes_w = axes_w;
        Ok(())
    }

    /// Rows of all contacts.
    pub fn row_count(&self) -> usize {
        self.first_rows[self.contacts.len()]
    }

    /// Rows of one contact among those of all.
    pub fn rows_of(&self, contact: usize) -> core::ops::Range<usize> {
        let end = |k: usize| self.first_rows.get(k).copied().unwrap_or_else(|| self.row_count());
        end(contact)..end(contact + 1)
    }

    /// A nominal of the right size, all zero.
    pub fn nominal(&self) -> StageNominal {
        StageNominal::new(self.del.unknown_nodes(), self.change.len() - 6, self.row_count())
    }

    /// Room for the result of [`ContactStage::linearize`].
    pub fn lifted(&self) -> LiftedStage {
        let nv = self.change.len();
        LiftedStage::new(nv, nv - 6, self.del.unknown_nodes(), self.contacts.len(), self.row_count())
    }

    /// The same without the maps of the nodes, for those who place the nodes otherwise ([`StageNominal::interpolate`]).
    pub fn lifted_without_nodes(&self) -> LiftedStage {
        let mut lifted = self.lifted();
        lifted.nodes = Vec::new();
        lifted
    }

    /// Linearises the unsolved stage between `start` and `end` about `nominal` under held joint forces `u` (N·m or N). No allocation.
    ///
    /// # Errors
    /// [`ModelError`] for wrong lengths or a bad time step; [`StepError::NonFinite`]; [`StepError::Singular`];
    /// [`StepError::RedundantConstraint`] for dependent contact rows (active row index), unless regularised.
    #[allow(clippy::too_many_arguments)]
    pub fn linearize(
        &mut self,
        tree: &KinematicTree,
        time_step: f64,
        active: &[bool],
        start: &BoundaryState,
        nominal: &StageNominal,
        u: &[f64],
        end: &BoundaryState,
        out: &mut LiftedStage,
    ) -> Result<(), StepError> {
        nominal.check(self.del.unknown_nodes(), tree.joint_count(), self.row_count())?;
        out.check(self)?;
        self.begin(tree, time_step, active, start, u)?;
        self.end.update(tree, end)?;
        self.place_nodes(tree, nominal)?;
        self.factor_end_responses(tree, active)?;
        self.solver_factor(tree)?;
        self.fill_columns(tree);
        self.solve_saddle(tree, true)?;
        self.end_rows(tree, end)?;
        self.write(nominal, out);
        Ok(())
    }

    /// The DEL residual at the nodes last evaluated, entry `dof * s + α`, base first.
    pub fn residual(&self) -> &[f64] {
        &self.residual
    }

    /// How far node `gamma` (1..=s) is off the leaf through the start, active row by row (m, or rad for small turns): `h^γ`.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a node that does not exist or a slice that is not as long as there are active rows.
    pub fn leaf_defect_into(&self, gamma: usize, out: &mut [f64]) -> Result<(), ModelError> {
        check_length("leaf defects", out.len(), self.active.len())?;
        let first = gamma * self.contacts.len();
        let Some(placements) = self.placements.get(first..first + self.contacts.len()) else {
            let expected = self.del.unknown_nodes();
            return Err(ModelError::Length { quantity: "nodes", got: gamma, expected });
        };
        for (active, value) in self.active.iter().zip(out) {
            let index = active.contact;
            *value = placements[index].defect(&self.contacts[index], &self.placements[index], active.row);
        }
        Ok(())
    }

    /// Columns `1 + 2 nv + joints` of the maps.
    fn map_columns(&self) -> usize {
        let nv = self.change.len();
        1 + 3 * nv - 6
    }
}
