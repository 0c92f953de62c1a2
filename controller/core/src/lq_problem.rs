//! The linear-quadratic problem of one cycle, as a value: what linearising fills and what the solvers read.
//!
//! | letter | meaning | shape |
//! |---|---|---|
//! | `x_k`, `u_k` | deviation of state and input from the nominal | `n_x`, `n_u` |
//! | `[B_k A_k]` | transition, columns in the order `z = (u, x)` | `n_x x (n_u + n_x)` |
//! | `d_k` | defect: where the nominal stage ends minus the next nominal node | `n_x` |
//! | `[R S; S' Q]`, `(r, q)` | stage cost in `z`, lower triangle | `(n_u + n_x)²` |
//! | `P_N`, `p_N` | terminal cost | `n_x²`, `n_x` |
//!
//! ```text
//! min  Σ_k [ ½ z_k' [R S; S' Q]_k z_k + (r, q)_k' z_k ] + ½ x_N' P_N x_N + p_N' x_N + Σ_soft ρ_i max(0, row_i)
//! s.t. x_{k+1} = A_k x_k + B_k u_k + d_k,   x_0 given,
//!      u_lower <= u_k <= u_upper,   x_lower <= x_k <= x_upper (k >= 1),   F_k u_k + E_k x_k <= e_k
//! ```
//!
//! Inputs first: eliminating `u` is then the leading part of one Cholesky factorisation (see [`crate::riccati`]).
//! A row with an infinite penalty `ρ` is hard; with a finite one it gives way where that is cheaper (an exact penalty: as
//! long as its multiplier stays below `ρ` it holds exactly). State rows of stage 0 do not exist: nothing can change `x_0`.
//!
//! Source: D. Q. Mayne et al., *Constrained model predictive control*, Automatica 36, 2000, for the form; exact penalties:
//! R. Fletcher, *Practical Methods of Optimization*, 2nd ed. 1987, section 12.3.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_messages::ConstraintKind;
use faer::{Accum, Mat};

use crate::kernels::gemv;

/// Sizes of an [`LqProblem`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LqSize {
    /// `n_x`.
    pub states: usize,
    /// `n_u`.
    pub inputs: usize,
    /// `N`.
    pub stages: usize,
    /// Room for general constraint rows per stage.
    pub rows: usize,
}

/// A general row `F u + E x <= bound` of a stage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowTag {
    /// What it limits.
    pub kind: ConstraintKind,
    /// Row within that constraint.
    pub row: u32,
    /// Cost per unit of violation; infinite: hard.
    pub penalty: f64,
    /// A natural size of the row's unit, by which violations of different rows are compared.
    pub scale: f64,
}

impl Default for RowTag {
    fn default() -> Self {
        Self { kind: ConstraintKind::None, row: 0, penalty: f64::INFINITY, scale: 1.0 }
    }
}

/// Bounds on a vector, both infinite where there is no limit.
#[derive(Clone, Debug, PartialEq)]
pub struct BoxBounds {
    /// Lowest values.
    pub lower: Vec<f64>,
    /// Highest values.
    pub upper: Vec<f64>,
}

impl BoxBounds {
    /// No bounds on `size` values.
    pub fn unbounded(size: usize) -> Self {
        Self { lower: vec![f64::NEG_INFINITY; size], upper: vec![f64::INFINITY; size] }
    }
}

/// One stage: transition, cost, constraints.
#[derive(Clone, Debug)]
pub struct LqStage {
    /// `[B A]`, `n_x x (n_u + n_x)`.
    pub transition: Mat<f64>,
    /// `d`.
    pub defect: Vec<f64>,
    /// Cost Hessian in `z = (u, x)`; only the lower triangle is read.
    pub hessian: Mat<f64>,
    /// Cost gradient `(r, q)`.
    pub gradient: Vec<f64>,
    /// Bounds on the input; hard.
    pub input: BoxBounds,
    /// Bounds on the state at the start of the stage (stage 0: not read); soft or hard by [`LqProblem::state_tags`].
    pub state: BoxBounds,
    /// General rows, one per **column**: `(F, E)` in the order of `z`, `(n_u + n_x) x rows`.
    pub rows: Mat<f64>,
    /// Right-hand side of every general row.
    pub row_bound: Vec<f64>,
    /// What every general row is.
    pub row_tag: Vec<RowTag>,
    /// General rows in use.
    pub row_count: usize,
}

/// The whole problem. All memory is taken in [`LqProblem::new`].
#[derive(Clone, Debug)]
pub struct LqProblem {
    size: LqSize,
    /// Stages 0..N.
    pub stages: Vec<LqStage>,
    /// `P_N`; only the lower triangle is read.
    pub terminal_hessian: Mat<f64>,
    /// `p_N`.
    pub terminal_gradient: Vec<f64>,
    /// Bounds on `x_N`.
    pub terminal_state: BoxBounds,
    /// Tag of the bounds of every input.
    pub input_tags: Vec<RowTag>,
    /// Tag of the bounds of every state.
    pub state_tags: Vec<RowTag>,
}

/// Names one constraint row of a problem: stage and index in the order input upper, input lower, state upper, state lower,
/// general rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RowId {
    /// Stage, `N` for the bounds of the terminal state.
    pub stage: u16,
    /// Index within the stage.
    pub index: u16,
}

impl LqProblem {
    /// A problem of zeros, without bounds.
    pub fn new(size: LqSize) -> Self {
        let LqSize { states, inputs, stages, rows } = size;
        let stage = LqStage {
            transition: Mat::zeros(states, inputs + states),
            defect: vec![0.0; states],
            hessian: Mat::zeros(inputs + states, inputs + states),
            gradient: vec![0.0; inputs + states],
            input: BoxBounds::unbounded(inputs),
            state: BoxBounds::unbounded(states),
            rows: Mat::zeros(inputs + states, rows),
            row_bound: vec![0.0; rows],
            row_tag: vec![RowTag::default(); rows],
            row_count: 0,
        };
        let input_tag = |row| RowTag { kind: ConstraintKind::Torque, row: row as u32, ..RowTag::default() };
        let state_tag = |row: usize| {
            let (kind, row) = if row < states / 2 {
                (ConstraintKind::JointPosition, row)
            } else {
                (ConstraintKind::JointVelocity, row - states / 2)
            };
            RowTag { kind, row: row as u32, ..RowTag::default() }
        };
        Self {
            size,
            stages: vec![stage; stages],
            terminal_hessian: Mat::zeros(states, states),
            terminal_gradient: vec![0.0; states],
            terminal_state: BoxBounds::unbounded(states),
            input_tags: (0..inputs).map(input_tag).collect(),
            state_tags: (0..states).map(state_tag).collect(),
        }
    }

    /// The sizes.
    pub fn size(&self) -> LqSize {
        self.size
    }

    /// Bounds on the state at node `node` (0..=N).
    pub fn state_bounds(&self, node: usize) -> &BoxBounds {
        self.stages.get(node).map_or(&self.terminal_state, |stage| &stage.state)
    }

    /// The row's tag.
    pub fn tag(&self, row: RowId) -> RowTag {
        match self.part(row) {
            RowPart::Input { index, .. } => self.input_tags[index],
            RowPart::State { index, .. } => self.state_tags[index],
            RowPart::General { index } => {
                self.stages.get(row.stage as usize).map_or(RowTag::default(), |stage| stage.row_tag[index])
            }
        }
    }

    /// Adds the coefficients of a row in `z = (u, x)` of its stage to `target` (length `n_u + n_x`), times `factor`.
    pub fn add_row(&self, row: RowId, factor: f64, target: &mut [f64]) {
        match self.part(row) {
            RowPart::Input { index, sign } => target[index] += sign * factor,
            RowPart::State { index, sign } => target[self.size.inputs + index] += sign * factor,
            RowPart::General { index } => {
                if let Some(stage) = self.stages.get(row.stage as usize) {
                    for (t, c) in target.iter_mut().zip(stage.rows.col_as_slice(index)) {
                        *t += factor * c;
                    }
                }
            }
        }
    }

    /// Right-hand side of a row.
    pub fn bound(&self, row: RowId) -> f64 {
        let node = row.stage as usize;
        match self.part(row) {
            RowPart::Input { index, sign } => self.stages.get(node).map_or(f64::INFINITY, |stage| {
                if sign > 0.0 { stage.input.upper[index] } else { -stage.input.lower[index] }
            }),
            RowPart::State { index, sign } => {
                let bounds = self.state_bounds(node);
                if sign > 0.0 { bounds.upper[index] } else { -bounds.lower[index] }
            }
            RowPart::General { index } => {
                self.stages.get(node).map_or(f64::INFINITY, |stage| stage.row_bound[index])
            }
        }
    }

    /// Calls `visit(row, violation, scale)` for every row with a finite bound whose value minus bound exceeds
    /// `threshold * scale`, on a trajectory given by columns. `values` is scratch of at least `rows` entries.
    pub(crate) fn visit_rows(
        &self,
        x: &Mat<f64>,
        u: &Mat<f64>,
        threshold: f64,
        values: &mut [f64],
        mut visit: impl FnMut(RowId, f64, f64),
    ) {
        let LqSize { states, inputs, stages, .. } = self.size;
        for node in 0..=stages {
            let id = |index: usize| RowId { stage: node as u16, index: index as u16 };
            let mut check = |index: usize, violation: f64, scale: f64| {
                if violation > threshold * scale {
                    visit(id(index), violation, scale);
                }
            };
            if let Some(stage) = self.stages.get(node) {
                visit_box(u.col_as_slice(node), &stage.input, &self.input_tags, 0, &mut check);
            }
            if node > 0 {
                let bounds = self.state_bounds(node);
                visit_box(x.col_as_slice(node), bounds, &self.state_tags, 2 * inputs, &mut check);
            }
            let general = 2 * (inputs + states);
            let Some(stage) = self.stages.get(node) else { continue };
            let values = &mut values[..stage.row_count];
            let rows = stage.rows.as_ref().subcols(0, stage.row_count).transpose();
            gemv(values, Accum::Replace, rows.subcols(0, inputs), u.col_as_slice(node), 1.0);
            gemv(values, Accum::Add, rows.subcols(inputs, states), x.col_as_slice(node), 1.0);
            for (i, value) in values.iter().enumerate() {
                check(general + i, value - stage.row_bound[i], stage.row_tag[i].scale);
            }
        }
    }

    fn part(&self, row: RowId) -> RowPart {
        let LqSize { states, inputs, .. } = self.size;
        let mut index = row.index as usize;
        for sign in [1.0, -1.0] {
            if index < inputs {
                return RowPart::Input { index, sign };
            }
            index -= inputs;
        }
        for sign in [1.0, -1.0] {
            if index < states {
                return RowPart::State { index, sign };
            }
            index -= states;
        }
        RowPart::General { index }
    }
}

/// Calls `check(index, violation, scale)` for the upper bounds, then the lower ones.
fn visit_box(
    values: &[f64],
    bounds: &BoxBounds,
    tags: &[RowTag],
    first: usize,
    check: &mut impl FnMut(usize, f64, f64),
) {
    for (i, ((value, upper), tag)) in values.iter().zip(&bounds.upper).zip(tags).enumerate() {
        check(first + i, value - upper, tag.scale);
    }
    for (i, ((value, lower), tag)) in values.iter().zip(&bounds.lower).zip(tags).enumerate() {
        check(first + values.len() + i, lower - value, tag.scale);
    }
}

enum RowPart {
    Input { index: usize, sign: f64 },
    State { index: usize, sign: f64 },
    General { index: usize },
}
