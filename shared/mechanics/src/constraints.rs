//! Holonomic constraints `h(q) = 0`: points, loops and welds, in the C-RATTLE form.
//!
//! | letter | meaning |
//! |---|---|
//! | `h`, `G = ∂h/∂q` | constraint (m rows) and its Jacobian |
//! | `λ^0..λ^s` | multipliers (impulses) at the nodes |
//! | `W^α` | `∂²(λ^α·h)/∂q²` at node α |
//! | `J`, `r` | Newton matrix and residual of the unconstrained step |
//!
//! The paper's equation (6) imposes `h = 0` at every node `1..s` and adds `Gᵀλ^α` to the rows `α < s`. As printed it lacks the
//! multiplier at the end node: the momentum it returns is only first-order accurate and violates `G M⁻¹ p = 0`. C-RATTLE
//! adds it, which restores order 2s in `q` **and** `p` and makes the map symplectic on the constraint manifold:
//!
//! ```text
//! C1  rows r^α + G(q^α)ᵀλ^α = 0 (α < s),  h(q^α) = 0 (α = 1..s);      J[α,α] += W^α  (α = 1..s-1)
//! C2  X = J⁻¹ [ -r | 𝒜 ],   𝒜 = blockdiag(G(q^0)ᵀ..G(q^{s-1})ᵀ),   𝒢 = blockdiag(G(q^1)..G(q^s))
//! C3  δΛ = (𝒢 X_𝒜)⁻¹ (r_c + 𝒢 X_r);   δq = X_r - X_𝒜 δΛ
//! C4  p^{k+1} := p_raw + G(q^s)ᵀλ^s,   (G M⁻¹ Gᵀ) λ^s = -G M⁻¹ p_raw
//! ```
//!
//! Every row is a sum of products of constant directions of {0} with *features*: points fixed in a body, or arms that turn with
//! it (`h = Σ d·X - c`). A weld has the rows `½(R*ᵀR - RᵀR*)^∨` and `x - x*`, linear in the features, so no logarithm appears.
//! A multiplier then acts on the body like a force of fixed direction (a couple for an arm), and `W^α` is its ordinary wrench
//! gain: constraints fit Algorithm B.1 and the branch sparsity without change.
//!
//! Cost of a Newton iteration: one factorisation, `s m + 1` solves, `(s m)³`.
//!
//! **Linearisation** on the manifold, ambient coordinates: the saddle matrix `[J+W, 𝒜; 𝒢, 0]` with the right-hand sides of
//! [`crate::linearize`], then `δp = δp_raw + W^s δq^s + Gᵀδλ^s` with `v = M⁻¹p^{k+1}` and
//!
//! ```text
//! δλ^s = -(G M⁻¹ Gᵀ)⁻¹ [ G M⁻¹ δp_raw + ( ∂(Gv)/∂q - G M⁻¹ ∂(Mv)/∂q ) δq^s ]          (δp_raw with W^s δq^s)
//! ```
//!
//! Limits: fixed base (contacts of a floating one: [`crate::contact_stage`]); rows must be independent (a planar four-bar needs 2 rows
//! of its loop, not 3): dependent rows are refused by their index, drop them with [`Constraint::rows`].
//!
//! Source: the paper, section 3.3; H. C. Andersen, *Rattle*, J. Comput. Phys. 52, 1983; order and symplecticity: L. O. Jay,
//! SIAM J. Numer. Anal. 33, 1996. End-node multiplier for the Galerkin form and its linearisation: ours.

use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3};

use crate::del_residual::DelWorkspace;
use crate::errors::ModelError;
use crate::lanes::LANES;
use crate::tree::KinematicTree;

mod constrained_integrator;

pub use constrained_integrator::ConstrainedIntegrator;

/// Rows whose pivot falls below this, relative to the largest, depend on the others.
const DEPENDENT_ROW: f64 = 1e-10;
const MAX_ITERATIONS: usize = 40;

/// What a constraint holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ConstraintKind {
    /// A body point (link frame, m) stays at a target in {0}: 3 rows `x - target`.
    Point {
        /// Body index.
        body: usize,
        /// Point in the link frame, m.
        point: Vector3<f64>,
        /// Target in {0}, m.
        target_w: Vector3<f64>,
    },
    /// Two body points coincide: 3 rows `x - x2` in the axes of {0}.
    Loop {
        /// First body and its point in the link frame, m.
        first: (usize, Vector3<f64>),
        /// Second body and its point in the link frame, m.
        second: (usize, Vector3<f64>),
    },
    /// A link frame stays at a pose in {0}: 3 rows `½(R*ᵀR - RᵀR*)^∨`, 3 rows `x - x*`.
    Weld {
        /// Body index.
        body: usize,
        /// Target rotation.
        rotation_w: Matrix3<f64>,
        /// Target position, m.
        position_w: Vector3<f64>,
    },
}

/// A constraint and the rows of it that are imposed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Constraint {
    /// What is held.
    pub kind: ConstraintKind,
    /// Bit k set: row k is imposed.
    pub row_mask: u8,
}

impl Constraint {
    /// With all rows.
    pub fn new(kind: ConstraintKind) -> Self {
        Self { kind, row_mask: u8::MAX }
    }

    /// The same with only the listed rows (0-based).
    pub fn rows(self, rows: &[usize]) -> Self {
        Self { row_mask: rows.iter().fold(0, |mask, row| mask | 1 << row), ..self }
    }
}

/// A body point, or an arm that turns with the body.
#[derive(Clone, Copy, Debug)]
struct Feature {
    body: usize,
    /// From the mass centre (point) or as it is (arm), link axes.
    arm_b: Vector3<f64>,
    is_arm: bool,
}

/// `d · X` of one feature in one row.
#[derive(Clone, Copy, Debug)]
struct Term {
    row: usize,
    feature: usize,
    direction_w: Vector3<f64>,
}

/// At most two features with their directions, and the constant.
type RowSpec = ([Option<(usize, Vector3<f64>)>; 2], f64);

/// The rows of all constraints of a tree.
#[derive(Clone, Debug)]
pub struct ConstraintSet {
    features: Vec<Feature>,
    terms: Vec<Term>,
    constants: Vec<f64>,
}

impl ConstraintSet {
    /// Collects and checks constraints of a fixed-base tree.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for a floating base or a body that does not exist; [`ModelError::NotFinite`].
    pub fn new(tree: &KinematicTree, constraints: &[Constraint]) -> Result<Self, ModelError> {
        if tree.is_floating() {
            let reason = "constraints need a fixed base: re-root the tree at the constrained body";
            return Err(ModelError::Unsupported { body: 0, reason });
        }
        let mut set = Self { features: Vec::new(), terms: Vec::new(), constants: Vec::new() };
        for constraint in constraints {
            set.add(tree, constraint)?;
        }
        if set.constants.is_empty() {
            return Err(ModelError::Length { quantity: "constraint rows", got: 0, expected: 1 });
        }
        Ok(set)
    }

    fn add(&mut self, tree: &KinematicTree, constraint: &Constraint) -> Result<(), ModelError> {
        // Rows as (feature, direction) lists and constants, before the mask.
        let mut rows: [RowSpec; 6] = [([None; 2], 0.0); 6];
        let count = match constraint.kind {
            ConstraintKind::Point { body, point, target_w } => {
                let feature = self.feature(tree, body, point, false)?;
                for (axis, row) in rows.iter_mut().enumerate().take(3) {
                    *row = ([Some((feature, Vector3::ith(axis, 1.0))), None], target_w[axis]);
                }
                3
            }
            ConstraintKind::Loop { first, second } => {
                let one = self.feature(tree, first.0, first.1, false)?;
                let two = self.feature(tree, second.0, second.1, false)?;
                for (axis, row) in rows.iter_mut().enumerate().take(3) {
                    let unit = Vector3::ith(axis, 1.0);
                    *row = ([Some((one, unit)), Some((two, -unit))], 0.0);
                }
                3
            }
            ConstraintKind::Weld { body, rotation_w, position_w } => {
                let mut axes = [0; 3];
                for (axis, index) in axes.iter_mut().enumerate() {
                    *index = self.feature(tree, body, Vector3::ith(axis, 1.0), true)?;
                }
                let target = |axis: usize| rotation_w.column(axis).into_owned();
                for axis in 0..3 {
                    // Component of (R*ᵀR - RᵀR*)^∨ / 2: (r*_c·r_b - r*_b·r_c) / 2 for the cyclic triple (axis, b, c).
                    let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
                    rows[axis] = ([Some((axes[b], target(c) * 0.5)), Some((axes[c], target(b) * -0.5))], 0.0);
                }
                let origin = self.feature(tree, body, Vector3::zeros(), false)?;
                for axis in 0..3 {
                    rows[3 + axis] = ([Some((origin, Vector3::ith(axis, 1.0))), None], position_w[axis]);
                }
                6
            }
        };
        for (index, (terms, constant)) in rows.iter().enumerate().take(count) {
            if constraint.row_mask & (1 << index) == 0 {
                continue;
            }
            let row = self.constants.len();
            for &(feature, direction_w) in terms.iter().flatten() {
                let body = self.features[feature].body;
                if !(constant.is_finite() && direction_w.iter().all(|x| x.is_finite())) {
                    return Err(ModelError::NotFinite { body, quantity: "constraint target" });
                }
                self.terms.push(Term { row, feature, direction_w });
            }
            self.constants.push(*constant);
        }
        Ok(())
    }

    fn feature(
        &mut self,
        tree: &KinematicTree,
        body: usize,
        point: Vector3<f64>,
        is_arm: bool,
    ) -> Result<usize, ModelError> {
        let Some(spec) = tree.bodies().get(body) else {
            return Err(ModelError::Unsupported { body, reason: "a constraint names no body" });
        };
        if !point.iter().all(|x| x.is_finite()) {
            return Err(ModelError::NotFinite { body, quantity: "constraint point" });
        }
        let arm_b = if is_arm { point } else { point - spec.inertia.com };
        self.features.push(Feature { body, arm_b, is_arm });
        Ok(self.features.len() - 1)
    }

    /// Number of rows `m`.
    pub fn row_count(&self) -> usize {
        self.constants.len()
    }

    /// `X` of a feature at a node.
    fn position(&self, del: &DelWorkspace, feature: usize, alpha: usize) -> Vector3<f64> {
        let Feature { body, arm_b, is_arm } = self.features[feature];
        let pose = del.body_pose(body, alpha);
        if is_arm { pose.rotation * arm_b } else { pose.transform_point(&arm_b) }
    }

    /// `∂X/∂q_k = s_k × X + n_k` (an arm lacks `n_k`).
    fn derivative(
        &self,
        del: &DelWorkspace,
        is_arm: bool,
        x: &Vector3<f64>,
        k: usize,
        alpha: usize,
    ) -> Vector3<f64> {
        let (s, n) = joint_twist(del, k, alpha);
        if is_arm { s.cross(x) } else { s.cross(x) + n }
    }

    /// `h` at node `alpha` of an evaluated step.
    pub fn residual_into(&self, del: &DelWorkspace, alpha: usize, h: &mut [f64]) {
        for (value, constant) in h.iter_mut().zip(&self.constants) {
            *value = -constant;
        }
        for term in &self.terms {
            h[term.row] += term.direction_w.dot(&self.position(del, term.feature, alpha));
        }
    }

    /// `G`, row-major `m x n`, at node `alpha`. O(m depth).
    pub fn jacobian_into(&self, tree: &KinematicTree, del: &DelWorkspace, alpha: usize, g: &mut [f64]) {
        let n = tree.dof();
        g.fill(0.0);
        for term in &self.terms {
            let feature = &self.features[term.feature];
            let x = self.position(del, term.feature, alpha);
            for &k in tree.branch(feature.body) {
                let k = k as usize;
                g[term.row * n + k] +=
                    term.direction_w.dot(&self.derivative(del, feature.is_arm, &x, k, alpha));
            }
        }
    }

    /// `∂(G v)/∂q`, row-major `m x n`, at node `alpha` for rates `v`. O(m depth²).
    pub fn jacobian_rate_into(
        &self,
        tree: &KinematicTree,
        del: &DelWorkspace,
        alpha: usize,
        v: &[f64],
        out: &mut [f64],
    ) {
        let n = tree.dof();
        out.fill(0.0);
        for term in &self.terms {
            self.second_derivatives(tree, del, term, alpha, |j, k, value| {
                out[term.row * n + j] += value * v[k];
            });
        }
    }

    /// `∂²(λ·h)/∂q²`, row-major `n x n`, at node `alpha`. O(m depth²). The step itself gets it as a wrench gain.
    pub fn curvature_into(
        &self,
        tree: &KinematicTree,
        del: &DelWorkspace,
        alpha: usize,
        lambda: &[f64],
        out: &mut [f64],
    ) {
        let n = tree.dof();
        out.fill(0.0);
        for term in &self.terms {
            self.second_derivatives(tree, del, term, alpha, |j, k, value| {
                out[j * n + k] += value * lambda[term.row];
            });
        }
    }

    /// `∂_j∂_k X = s_j × ∂_k X` with `j` above `k`, symmetric.
    fn second_derivatives(
        &self,
        tree: &KinematicTree,
        del: &DelWorkspace,
        term: &Term,
        alpha: usize,
        mut visit: impl FnMut(usize, usize, f64),
    ) {
        let feature = &self.features[term.feature];
        let x = self.position(del, term.feature, alpha);
        let branch = tree.branch(feature.body);
        for (below, &k) in branch.iter().enumerate() {
            let slope = self.derivative(del, feature.is_arm, &x, k as usize, alpha);
            for &j in &branch[..=below] {
                let (s, _) = joint_twist(del, j as usize, alpha);
                let value = term.direction_w.dot(&s.cross(&slope));
                visit(j as usize, k as usize, value);
                if j != k {
                    visit(k as usize, j as usize, value);
                }
            }
        }
    }
}

/// `(s_k, n_k)` of a fixed-base joint at a node.
fn joint_twist(del: &DelWorkspace, k: usize, alpha: usize) -> (Vector3<f64>, Vector3<f64>) {
    let twist = &del.bodies[k * del.groups + alpha / LANES].joint_twist;
    let at = |c: usize| twist[c].0[alpha % LANES];
    (Vector3::new(at(0), at(1), at(2)), Vector3::new(at(3), at(4), at(5)))
}
