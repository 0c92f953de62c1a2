//! The linear-quadratic problem of one cycle, as a value: what linearising fills and what the solvers read.
//!
//! | letter | meaning | shape |
//! |---|---|---|
//! | `x_k`, `u_k` | deviation of state and input from the nominal | `n_x`, `n_u` |
//! | `A_k`, `B_k`, `d_k` | transition; defect: where the nominal stage ends minus the next nominal node | `n_x` rows |
//! | `R`, `r`, `Q`, `q` | stage cost, as weighted squares ([`crate::lq_stage`]) | `n_u`, `n_x²` |
//! | `P_N`, `p_N` | terminal cost | `n_x²`, `n_x` |
//! | `y_k = C_k z_k + c_k` | outputs of a stage that rows limit, here a contact wrench; `z = (u, x)` | `m` |
//!
//! ```text
//! min  Σ_k [ ½ u'R u + r'u + ½ x'Q x + q'x ]_k + ½ x_N' P_N x_N + p_N' x_N + Σ_soft ρ_i max(0, row_i)
//! s.t. x_{k+1} = A_k x_k + B_k u_k + d_k,   x_0 given,
//!      u_lower <= u_k <= u_upper,   x_lower <= x_k <= x_upper (k >= 1),   E y_k <= e
//! ```
//!
//! A row with an infinite penalty `ρ` is hard; with a finite one it gives way where that is cheaper (an exact penalty: as
//! long as its multiplier stays below `ρ` it holds exactly). State rows of stage 0 do not exist: nothing can change `x_0`.
//!
//! Source: D. Q. Mayne et al., *Constrained model predictive control*, Automatica 36, 2000, for the form; exact penalties:
//! R. Fletcher, *Practical Methods of Optimization*, 2nd ed. 1987, section 12.3.

use alloc::vec;
use alloc::vec::Vec;

use faer::Mat;

pub use crate::lq_stage::{BoxBounds, LqStage};
use crate::panel::transposed_times;
use crate::trajectory::Trajectory;

/// Sizes of an [`LqProblem`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LqSize {
    /// `n_x`.
    pub states: usize,
    /// `n_u`.
    pub inputs: usize,
    /// `N`.
    pub stages: usize,
    /// `m`: outputs of a stage.
    pub outputs: usize,
    /// Rows on the outputs of a stage.
    pub rows: usize,
    /// Room for squared residuals of the state in the cost of a stage.
    pub residuals: usize,
    /// Room for squared residuals of state and input in it.
    pub squares: usize,
}

/// What a constraint row is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RowTag {
    /// What it limits: the caller's own number, not read here.
    pub label: u32,
    /// Row within that constraint, the caller's own.
    pub row: u32,
    /// Cost per unit of violation; infinite: hard.
    pub penalty: f64,
    /// A natural size of the row's unit, by which violations of different rows are compared.
    pub scale: f64,
}

impl Default for RowTag {
    fn default() -> Self {
        Self { label: 0, row: 0, penalty: f64::INFINITY, scale: 1.0 }
    }
}

/// One row `coefficients · y <= bound` on the outputs of a stage; the bound is the stage's ([`LqStage::row_bounds`]).
#[derive(Clone, Debug, PartialEq)]
pub struct OutputRow {
    /// On the outputs.
    pub coefficients: Vec<f64>,
    /// What the row is.
    pub tag: RowTag,
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
    /// Rows on the outputs, the same in every stage but for their bounds.
    pub output_rows: Vec<OutputRow>,
}

/// Names one constraint row of a problem: stage and index in the order input upper, input lower, state upper, state lower,
/// rows on the outputs.
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
        let LqSize { states, inputs, stages, .. } = size;
        let tag = |row| RowTag { row: row as u32, ..RowTag::default() };
        Self {
            size,
            stages: vec![LqStage::new(size); stages],
            terminal_hessian: Mat::zeros(states, states),
            terminal_gradient: vec![0.0; states],
            terminal_state: BoxBounds::unbounded(states),
            input_tags: (0..inputs).map(tag).collect(),
            state_tags: (0..states).map(tag).collect(),
            output_rows: vec![
                OutputRow { coefficients: vec![0.0; size.outputs], tag: RowTag::default() };
                size.rows
            ],
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
            RowPart::Output { index } => self.output_rows[index].tag,
        }
    }

    /// Whether a row is a bound of a state, which more inputs than those of its own stage decide.
    pub fn bounds_a_state(&self, row: RowId) -> bool {
        matches!(self.part(row), RowPart::State { .. })
    }

    /// Adds the coefficients of a row in `z = (u, x)` of its stage to `target` (length `n_u + n_x`), times `factor`.
    pub fn add_row(&self, row: RowId, factor: f64, target: &mut [f64]) {
        match self.part(row) {
            RowPart::Input { index, sign } => target[index] += sign * factor,
            RowPart::State { index, sign } => target[self.size.inputs + index] += sign * factor,
            RowPart::Output { index } => {
                let Some(stage) = self.stages.get(row.stage as usize) else { return };
                let (by_input, by_state) = target.split_at_mut(self.size.inputs);
                for (output, coefficient) in self.output_rows[index].coefficients.iter().enumerate() {
                    let (c_u, c_x, _) = stage.output(output);
                    let weight = factor * coefficient;
                    by_input.iter_mut().zip(c_u).for_each(|(t, c)| *t += weight * c);
                    by_state.iter_mut().zip(c_x).for_each(|(t, c)| *t += weight * c);
                }
            }
        }
    }

    /// Right-hand side of a row, less what the constant of the outputs takes up.
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
            RowPart::Output { index } => {
                let row = &self.output_rows[index];
                self.stages.get(node).map_or(f64::INFINITY, |stage| {
                    let constant =
                        |(output, coefficient): (usize, &f64)| coefficient * stage.output(output).2;
                    stage.row_bounds[index] - row.coefficients.iter().enumerate().map(constant).sum::<f64>()
                })
            }
        }
    }

    /// Calls `visit(row, violation, scale)` for every row with a finite bound whose value minus bound exceeds
    /// `threshold * scale`, on a trajectory. `outputs` is scratch of `m` entries.
    pub(crate) fn visit_rows(
        &self,
        trajectory: &Trajectory,
        threshold: f64,
        outputs: &mut [f64],
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
                visit_box(trajectory.u(node), &stage.input, &self.input_tags, 0, &mut check);
            }
            if node > 0 {
                let bounds = self.state_bounds(node);
                visit_box(trajectory.x(node), bounds, &self.state_tags, 2 * inputs, &mut check);
            }
            let first = 2 * (inputs + states);
            let Some(stage) = self.stages.get(node) else { continue };
            transposed_times(stage.outputs(), trajectory.z(node), outputs);
            for (i, (row, bound)) in self.output_rows.iter().zip(&stage.row_bounds).enumerate() {
                if *bound == f64::INFINITY {
                    continue;
                }
                let value: f64 = row.coefficients.iter().zip(&*outputs).map(|(c, y)| c * y).sum();
                check(first + i, value - bound, row.tag.scale);
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
        RowPart::Output { index }
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
    Output { index: usize },
}
