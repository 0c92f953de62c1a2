//! Discrete linearisation `δx_{k+1} = A δx_k + B δu` of one solved step.
//!
//! | letter | meaning |
//! |---|---|
//! | `H[α,γ]` | derivative of row α by node γ, [`crate::del_hessian`]; `J` its part `α < s`, `γ >= 1` |
//! | `Z^γ` | derivative of node γ by what the column varies |
//! | `e_0` | selects the rows α = 0 |
//! | `T` | change of coordinates `(q, q̇) → (q, p)` |
//!
//! ```text
//! J Z_q = -H[:,0]      J Z_p = -e_0 ⊗ 1      J Z_u^α = -w_α Δt (e_α ⊗ 1)  (α < s),  Z_u^s = 0
//! A = [ Z_q^(s)                         Z_p^(s)             ]    B^α = [ Z_u^{α,(s)}                                 ]
//!     [ H[s,0] + Σ_γ H[s,γ] Z_q^(γ)     Σ_γ H[s,γ] Z_p^(γ)  ]          [ Σ_γ H[s,γ] Z_u^{α,(γ)} + δ_{αs} w_s Δt 1    ]
//! ```
//!
//! A held input has `B = Σ_α B^α`. Without dissipation `AᵀΩA = Ω`, `Ω = [0 1; -1 0]`.
//!
//! **(q, q̇).** At step boundaries `p = M(q) q̇`, so `δp = K_q̇q δq + M δq̇` and `A' = T_{k+1}⁻¹ A T_k`, `B' = T_{k+1}⁻¹ B` with
//! `T = [1 0; K_q̇q M]`. The change of coordinates is folded into the right-hand sides and the last row.
//!
//! **Three paths.** The matrix path solves all columns at once with the Hessian blocks, O(n Σ depth): fastest for trees of short
//! branches. The recursion over columns ([`Linearizer::linearize_by_recursion`]) is O(n²) for any tree: fastest for long branches.
//! The tangent path takes one Algorithm T, one solve and one Algorithm T per column, also O(n²) but column by column
//! ([`Linearizer::linearize_by_tangent`]); it serves the floating base and checks the others.
//!
//! **Floating base.** Coordinates are minimal and canonical: `x = (ε, δq, δπ, δp_j)` with the pose error `δg = g ε^` and
//! `δπ = Ad_gᵀ(δP + ½ ad^D_P η)`; the ½-term makes the symplectic form constant, so again `AᵀΩA = Ω`.
//!
//! Source: the paper, section 3.4 (its O(n²) is the cost of the Hessian; A and B need the solves as well).

use alloc::vec;
use alloc::vec::Vec;

use crate::del_hessian::DelHessian;
use crate::del_residual::DelWorkspace;
use crate::errors::{ModelError, StepError};
use crate::kinetic_hessian::KineticHessian;
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::newton_direction::{NewtonDirection, NewtonSolver};
use crate::recursive_linearize::{AllColumns, ColumnSweeps};
use crate::recursive_newton::RecursiveNewton;
use crate::row_matrix::RowMatrix;
use crate::step::Integrator;
use crate::tangent::TangentWorkspace;
use crate::tree::KinematicTree;

mod adjoint;
mod end_blocks;
mod end_rows;
mod tangent_path;

use end_blocks::EndBlocks;
pub(crate) use end_rows::SolveMass;
use end_rows::{EndRows, fill_right_hand_sides};

/// Mean length of the branches above which the recursion over columns beats the matrix path, for s = 1, 2, 3 and more.
///
/// Measured with `benches/crossover.rs` (Xeon with AVX-512; chains and stars of 8 to 125 links): equal at 14 to 18 for s = 2 and 20 to 30
/// for s = 3; for s = 1 the matrix path takes two thirds of the recursion at 32, the deepest measured. Atlas on its foot has 9.8.
const CROSSOVER_LINEARIZATION: [f64; 3] = [40.0, 16.0, 26.0];

/// State of the linearised dynamics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StateCoordinates {
    /// `(q, p)`; a floating base: `(ε, δq, δπ, δp_j)`.
    Momentum,
    /// `(q, q̇)`; fixed base.
    Velocity,
}

/// Input of the linearised dynamics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputHold {
    /// One joint force per joint, held over the step.
    Held,
    /// One per joint and node, node-major: `s + 1` blocks of columns.
    PerNode,
}

/// `[A | B]` of one step, `2n x (2n + m)`.
#[derive(Clone, Debug)]
pub struct LinearStep {
    n: usize,
    matrix: RowMatrix,
}

impl LinearStep {
    /// Number of coordinates `n` (half the states).
    pub fn dof(&self) -> usize {
        self.n
    }

    /// Number of inputs `m`.
    pub fn inputs(&self) -> usize {
        self.matrix.columns() - 2 * self.n
    }

    /// Entry of `A`.
    #[inline(always)]
    pub fn a(&self, row: usize, column: usize) -> f64 {
        self.matrix.get(row, column)
    }

    /// Entry of `B`.
    #[inline(always)]
    pub fn b(&self, row: usize, column: usize) -> f64 {
        self.matrix.get(row, 2 * self.n + column)
    }

    /// `[A | B]`.
    pub fn matrix(&self) -> &RowMatrix {
        &self.matrix
    }
}

/// Workspace of the linearisation for one tree, rule, choice of coordinates and input.
#[derive(Clone, Debug)]
pub struct Linearizer {
    coordinates: StateCoordinates,
    hold: InputHold,
    s: usize,
    /// Right-hand sides, then `Z`: coordinate-major rows.
    z: RowMatrix,
    step: LinearStep,
    /// Where the solver keeps none (Algorithm B.1).
    hessian: DelHessian,
    kinetic: Option<KineticHessian>,
    mass_matrix: Vec<f64>,
    factor: MassMatrixFactor,
    velocities: [Vec<f64>; 2],
    tangent: TangentWorkspace,
    /// Algorithm B.1 for whole steps: fixed base in momentum coordinates, without general wrenches.
    recursive: Option<(RecursiveNewton, ColumnSweeps)>,
    /// Whether the tree is deep enough for it.
    deep: bool,
    column: Vec<f64>,
    momentum: Vec<f64>,
    end: EndBlocks,
}

impl Linearizer {
    /// For the steps of `integrator`.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for velocity coordinates of a floating base.
    pub fn new(
        tree: &KinematicTree,
        integrator: &Integrator,
        coordinates: StateCoordinates,
        hold: InputHold,
    ) -> Result<Self, ModelError> {
        let del = integrator.del();
        let (n, s) = (tree.dof(), del.unknown_nodes());
        let inputs = match hold {
            InputHold::Held => tree.joint_count(),
            InputHold::PerNode => tree.joint_count() * (s + 1),
        };
        let velocity = coordinates == StateCoordinates::Velocity;
        let recursive = (!velocity && !tree.is_floating() && del.gains.is_empty()).then(|| {
            let solver = RecursiveNewton::for_whole_step(tree, del);
            let sweeps = ColumnSweeps::new(tree, solver.shape());
            (solver, sweeps)
        });
        Ok(Self {
            coordinates,
            hold,
            s,
            z: RowMatrix::zeros(s * n, 2 * n + inputs),
            step: LinearStep { n, matrix: RowMatrix::zeros(2 * n, 2 * n + inputs) },
            hessian: DelHessian::new(tree, del),
            kinetic: if velocity { Some(KineticHessian::new(tree)?) } else { None },
            mass_matrix: vec![0.0; if velocity { n * n } else { 0 }],
            factor: MassMatrixFactor::new(tree),
            velocities: [vec![0.0; n], vec![0.0; n]],
            tangent: TangentWorkspace::new(tree, del),
            recursive,
            deep: {
                let sum: usize = (0..tree.body_count()).map(|i| tree.branch(i).len()).sum();
                let limit = CROSSOVER_LINEARIZATION[s.clamp(1, CROSSOVER_LINEARIZATION.len()) - 1];
                sum as f64 > limit * tree.body_count() as f64
            },
            column: vec![0.0; s * n],
            momentum: vec![0.0; n],
            end: EndBlocks::new(tree, s),
        })
    }

    /// `A` and `B` around the step that `integrator` has just solved ([`Integrator::solve`] or [`Integrator::step`]), by the path that
    /// is fastest for the tree. Factorises the Newton matrix at the solution. No allocation.
    ///
    /// # Errors
    /// [`StepError::Singular`] when a factorisation fails.
    pub fn linearize(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
    ) -> Result<&LinearStep, StepError> {
        if tree.is_floating() {
            self.linearize_by_tangent(tree, integrator)
        } else if self.recursive.is_some() && self.deep {
            self.linearize_by_recursion(tree, integrator)
        } else {
            self.linearize_by_matrix(tree, integrator)
        }
    }

    /// The matrix path, O(n Σ depth): all columns at once with the Hessian blocks. Fixed base, either coordinates.
    ///
    /// # Errors
    /// [`StepError::Singular`] when a factorisation fails; [`ModelError::Unsupported`] for a floating base.
    pub fn linearize_by_matrix(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
    ) -> Result<&LinearStep, StepError> {
        if tree.is_floating() {
            let reason = "the matrix path is for a fixed base";
            return Err(ModelError::Unsupported { body: 0, reason }.into());
        }
        if self.coordinates == StateCoordinates::Velocity {
            self.evaluate_velocities(tree, integrator)?;
        }
        let (del, solver) = integrator.factor_solution(tree)?;
        if solver.hessian().is_none() {
            self.hessian.evaluate(tree, del);
        }
        fill_right_hand_sides(
            tree,
            del,
            solver.hessian().unwrap_or(&self.hessian),
            self.hold,
            self.kinetic.as_ref(),
            &mut self.z,
        );
        solver.solve_many(tree, &mut self.z);
        let hessian = solver.hessian().unwrap_or(&self.hessian);
        self.end.fill(tree, hessian, self.kinetic.as_ref(), self.s);
        let out = &mut self.step.matrix;
        del.instructions.dispatch_wide(EndRows { blocks: &self.end, z: &self.z, out, s: self.s });
        self.add_direct_terms(tree, del, solver);
        if self.kinetic.is_some() {
            del.instructions.dispatch_wide(SolveMass { factor: &self.factor, out: &mut self.step.matrix });
        }
        Ok(&self.step)
    }

    /// The linear step last computed.
    pub fn linear_step(&self) -> &LinearStep {
        &self.step
    }

    /// Velocities `M⁻¹p` at both ends, the kinetic Hessians there, and the factor of the mass matrix at the end.
    fn evaluate_velocities(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
    ) -> Result<(), StepError> {
        let Some(kinetic) = &mut self.kinetic else { return Ok(()) };
        let n = tree.dof();
        let start = &integrator.del().start;
        let end = integrator.next_state();
        // The mass matrix does not depend on the rates: one pass gives it at both ends, a second one the Hessians.
        let [rate_start, rate_end] = &mut self.velocities;
        kinetic.evaluate(tree, &[(&start.q, &start.p), (&end.q, &end.p)])?;
        for (state, (momentum, rate)) in
            [(&start.p, &mut *rate_start), (&end.p, &mut *rate_end)].into_iter().enumerate()
        {
            for i in 0..n {
                for (position, &j) in tree.branch(i).iter().enumerate() {
                    self.mass_matrix[i * n + j as usize] = kinetic.pair(i, position)[0].0[state];
                }
            }
            self.factor.factorise(&self.mass_matrix)?;
            rate.copy_from_slice(momentum);
            self.factor.solve_in_place(rate)?;
        }
        kinetic.evaluate(tree, &[(&start.q, rate_start), (&end.q, rate_end)])?;
        Ok(())
    }

    /// `H[s,0]` in the columns of `q` and `w_s Δt` in those of the input at node s.
    fn add_direct_terms(&mut self, tree: &KinematicTree, del: &DelWorkspace, solver: &NewtonSolver) {
        let hessian = solver.hessian().unwrap_or(&self.hessian);
        let (n, s) = (tree.dof(), self.s);
        let out = &mut self.step.matrix;
        for i in 0..n {
            for (block, &j) in hessian.body_pairs(i, s).zip(tree.branch(i)) {
                let j = j as usize;
                out.add(n + i, j, block.entry(s, 0));
                if i != j {
                    out.add(n + j, i, block.mirrored(s, 0));
                }
            }
            let last = match self.hold {
                InputHold::Held => 2 * n + i,
                InputHold::PerNode => 2 * n + s * n + i,
            };
            out.add(n + i, last, del.rule.weights()[s] * del.time_step);
        }
    }

    /// The fast O(n²) path ([`crate::recursive_linearize`]): one factorisation by Algorithm B.1, two sweeps over sixteen columns at a
    /// time. Fixed base in `(q, p)`, without drag, body wrenches and wrench laws.
    ///
    /// # Errors
    /// [`StepError::Singular`] when the factorisation fails; [`ModelError::Unsupported`] outside its range.
    pub fn linearize_by_recursion(
        &mut self,
        tree: &KinematicTree,
        integrator: &mut Integrator,
    ) -> Result<&LinearStep, StepError> {
        let Some((solver, sweeps)) = &mut self.recursive else {
            let reason = "the recursion over columns is for a fixed base in (q, p) without general wrenches";
            return Err(ModelError::Unsupported { body: 0, reason }.into());
        };
        let del = integrator.del();
        solver.factor(tree, del)?;
        if let Some(responses) = solver.responses() {
            let out = &mut self.step.matrix;
            del.instructions.dispatch_wide(AllColumns { tree, del, hold: self.hold, responses, sweeps, out });
        }
        Ok(&self.step)
    }
}
