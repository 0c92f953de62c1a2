//! One stage of the linear-quadratic problem: transition, cost, bounds, outputs.
//!
//! Everything that the recursion and the rollout multiply lies in column panels (file `panel.rs`) over the rows of
//!
//! ```text
//! z̃ = (u, x, 1)        u and (x, 1) padded with zeros to whole blocks of eight
//! ```
//!
//! so that a transition is `x⁺ = [B A d] z̃`, stored transposed, and the linear terms need no code of their own.
//!
//! The cost is a sum of weighted squares, as tasks are: a diagonal on `u`, a diagonal on `x`, and residuals `r = J x + r̄`,
//!
//! ```text
//! ½ Σ R_i u_i² + g_u'u + ½ Σ D_i x_i² + g_x'x + ½ Σ_r (J_r x + r̄_r)² + ½ Σ_s (Z_s z + z̄_s)²
//! ```
//!
//! The first residuals are those of the state, as tasks have them, `Q = D + J'J`, `q = g_x + J'r̄`; the second ones ("squares") those
//! of state and input together, as contact forces have them.
//!
//! `Q` is never formed: the recursion adds `J'J` where it adds the products of its own (`crate::eliminate_inputs`).

use alloc::vec;
use alloc::vec::Vec;

use faer::{Mat, MatMut, MatRef};

use crate::lq_problem::LqSize;
use crate::panel::{Panel, padded, times_transposed};

/// Where the parts of `z̃` begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layout {
    pub inputs: usize,
    pub states: usize,
}

impl Layout {
    /// Row of the first state.
    pub fn first_state(self) -> usize {
        padded(self.inputs)
    }

    /// Row of the constant 1.
    pub fn one(self) -> usize {
        self.first_state() + self.states
    }

    /// Rows of a panel over `z̃`.
    pub fn rows(self) -> usize {
        self.first_state() + padded(self.states + 1)
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

/// Residuals `J x + r̄` whose squares, halved, are part of a cost.
#[derive(Clone, Debug)]
pub struct Residuals {
    /// Column per residual: `J_r'`, below it `r̄_r`.
    panel: Panel,
    states: usize,
    count: usize,
}

impl Residuals {
    /// None yet, room for `room` of them over `states` states.
    pub fn new(states: usize, room: usize) -> Self {
        Self { panel: Panel::zeros(states + 1, room), states, count: 0 }
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.count = 0;
    }

    /// Appends one with the value `r̄` and gives its row `J_r`, zeros, to be written. `None`: no room.
    pub fn push(&mut self, value: f64) -> Option<&mut [f64]> {
        if self.count == self.room() {
            return None;
        }
        let column = self.panel.column_mut(self.count);
        self.count += 1;
        let (row, rest) = column.split_at_mut(self.states);
        row.fill(0.0);
        rest[0] = value;
        Some(row)
    }

    /// Residuals there is room for.
    pub fn room(&self) -> usize {
        self.panel.columns()
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// `J_r`.
    pub fn row(&self, residual: usize) -> &[f64] {
        &self.panel.column(residual)[..self.states]
    }

    /// `J_r`, to write.
    pub fn row_mut(&mut self, residual: usize) -> &mut [f64] {
        let states = self.states;
        &mut self.panel.column_mut(residual)[..states]
    }

    /// `r̄_r`.
    pub fn value(&self, residual: usize) -> f64 {
        self.panel.column(residual)[self.states]
    }

    pub(crate) fn panel(&self) -> &Panel {
        &self.panel
    }
}

/// Residuals `Z z + z̄` of state and input whose squares, halved, are part of a cost.
#[derive(Clone, Debug)]
pub struct Squares {
    /// Column per residual: `(Z_u, Z_x, z̄)'` over the rows of `z̃`.
    panel: Panel,
    layout: Layout,
    count: usize,
}

impl Squares {
    fn new(layout: Layout, room: usize) -> Self {
        Self { panel: Panel::zeros(layout.rows(), room), layout, count: 0 }
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.count = 0;
    }

    /// Appends `weight (C z + c - target)` for an output `(C_u, C_x, c)`; `false`: no room.
    pub fn push(&mut self, weight: f64, (by_input, by_state, value): (&[f64], &[f64], f64)) -> bool {
        if self.count == self.panel.columns() {
            return false;
        }
        let (first, one) = (self.layout.first_state(), self.layout.one());
        let column = self.panel.column_mut(self.count);
        self.count += 1;
        for (target, source) in column[..by_input.len()].iter_mut().zip(by_input) {
            *target = weight * source;
        }
        for (target, source) in column[first..first + by_state.len()].iter_mut().zip(by_state) {
            *target = weight * source;
        }
        column[one] = weight * value;
        true
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// `(Z_u, Z_x, z̄)` of a residual.
    pub fn row(&self, residual: usize) -> (&[f64], &[f64], f64) {
        let column = self.panel.column(residual);
        let (first, one) = (self.layout.first_state(), self.layout.one());
        (&column[..self.layout.inputs], &column[first..one], column[one])
    }

    pub(crate) fn panel(&self) -> &Panel {
        &self.panel
    }
}

/// Cost of a stage; see the module.
#[derive(Clone, Debug)]
pub struct StageCost {
    /// `R`, the diagonal.
    pub input_weight: Vec<f64>,
    /// `g_u`.
    pub input_gradient: Vec<f64>,
    /// `D`.
    pub state_weight: Vec<f64>,
    /// `g_x`.
    pub state_gradient: Vec<f64>,
    /// `J, r̄`.
    pub residuals: Residuals,
    /// `Z, z̄`.
    pub squares: Squares,
}

impl StageCost {
    /// Zero.
    pub fn new(inputs: usize, states: usize, residuals: usize, squares: usize) -> Self {
        Self {
            input_weight: vec![0.0; inputs],
            input_gradient: vec![0.0; inputs],
            state_weight: vec![0.0; states],
            state_gradient: vec![0.0; states],
            residuals: Residuals::new(states, residuals),
            squares: Squares::new(Layout { inputs, states }, squares),
        }
    }

    /// `Q = D + J'J` without the squares, full symmetric. Allocates: for start-up, oracles and tests.
    pub fn state_hessian(&self) -> Mat<f64> {
        let states = self.state_weight.len();
        let mut hessian =
            Mat::from_fn(states, states, |i, j| if i == j { self.state_weight[i] } else { 0.0 });
        for r in 0..self.residuals.len() {
            let row = self.residuals.row(r);
            for j in 0..states {
                for i in 0..states {
                    hessian[(i, j)] += row[i] * row[j];
                }
            }
        }
        hessian
    }

    /// `q = g_x + J'r̄` without the squares. Allocates.
    pub fn state_linear_term(&self) -> Vec<f64> {
        let mut gradient = self.state_gradient.clone();
        for r in 0..self.residuals.len() {
            let value = self.residuals.value(r);
            for (g, j) in gradient.iter_mut().zip(self.residuals.row(r)) {
                *g += value * j;
            }
        }
        gradient
    }
}

/// One stage.
#[derive(Clone, Debug)]
pub struct LqStage {
    layout: Layout,
    /// `[B A d]'`.
    transition: Panel,
    /// Column per output: `(C_u, C_x, c)'` of `y = C z + c`.
    outputs: Panel,
    /// Cost.
    pub cost: StageCost,
    /// Bounds on the input; hard.
    pub input: BoxBounds,
    /// Bounds on the state at the start of the stage (stage 0: not read); soft or hard by
    /// [`crate::lq_problem::LqProblem::state_tags`].
    pub state: BoxBounds,
    /// Right-hand sides of the rows on the outputs; infinite: the stage does not have the row.
    pub row_bounds: Vec<f64>,
}

/// One output `y = C_u u + C_x x + c` of a stage, to write.
#[derive(Debug)]
pub struct OutputMut<'a> {
    /// `C_u`.
    pub by_input: &'a mut [f64],
    /// `C_x`.
    pub by_state: &'a mut [f64],
    /// `c`.
    pub value: &'a mut f64,
}

/// `[B A]` of a stage, to write.
#[derive(Debug)]
pub struct TransitionRowsMut<'a> {
    /// Rows of `[B A d]`, `row_stride` apart.
    pub values: &'a mut [f64],
    /// From one row to the next.
    pub row_stride: usize,
    /// Where the states begin in a row.
    pub first_state: usize,
}

impl LqStage {
    /// A stage of zeros, without bounds.
    pub fn new(size: LqSize) -> Self {
        let LqSize { states, inputs, outputs, rows, residuals, squares, .. } = size;
        let layout = Layout { inputs, states };
        Self {
            layout,
            transition: Panel::zeros(layout.rows(), states),
            outputs: Panel::zeros(layout.rows(), outputs),
            cost: StageCost::new(inputs, states, residuals, squares),
            input: BoxBounds::unbounded(inputs),
            state: BoxBounds::unbounded(states),
            row_bounds: vec![f64::INFINITY; rows],
        }
    }

    /// `A`, `n_x x n_x`.
    pub fn a(&self) -> MatRef<'_, f64> {
        self.part(self.layout.first_state(), self.layout.states)
    }

    /// `B`, `n_x x n_u`.
    pub fn b(&self) -> MatRef<'_, f64> {
        self.part(0, self.layout.inputs)
    }

    /// `A`, to write.
    pub fn a_mut(&mut self) -> MatMut<'_, f64> {
        self.part_mut(self.layout.first_state(), self.layout.states)
    }

    /// `B`, to write.
    pub fn b_mut(&mut self) -> MatMut<'_, f64> {
        self.part_mut(0, self.layout.inputs)
    }

    /// `d_i`.
    pub fn defect(&self, state: usize) -> f64 {
        self.transition.column(state)[self.layout.one()]
    }

    /// Sets `d_i`.
    pub fn set_defect(&mut self, state: usize, value: f64) {
        let one = self.layout.one();
        self.transition.column_mut(state)[one] = value;
    }

    /// `[B A]` as a linearisation of the whole horizon writes it: row i of a transition from `i * row_stride` on, the inputs first,
    /// the states from `first_state` on.
    pub fn transition_rows(&mut self) -> TransitionRowsMut<'_> {
        let (row_stride, first_state) = (self.transition.stride(), self.layout.first_state());
        TransitionRowsMut { values: self.transition.entries_mut(), row_stride, first_state }
    }

    /// An output, to write.
    pub fn output_mut(&mut self, output: usize) -> OutputMut<'_> {
        let Layout { inputs, states } = self.layout;
        let (by_input, rest) = self.outputs.column_mut(output).split_at_mut(self.layout.first_state());
        let (by_state, rest) = rest.split_at_mut(states);
        OutputMut { by_input: &mut by_input[..inputs], by_state, value: &mut rest[0] }
    }

    /// `(C_u, C_x, c)` of an output.
    pub fn output(&self, output: usize) -> (&[f64], &[f64], f64) {
        let Layout { inputs, .. } = self.layout;
        let column = self.outputs.column(output);
        let (first, one) = (self.layout.first_state(), self.layout.one());
        (&column[..inputs], &column[first..one], column[one])
    }

    /// Sets the outputs to `y = Y (A x + B u + d)`, `Y` given with one state a column: up to a tile of them.
    pub fn set_outputs_through_transition(&mut self, by_end_state: &Panel) {
        times_transposed(&self.transition, by_end_state, &mut self.outputs);
    }

    pub(crate) fn transition(&self) -> &Panel {
        &self.transition
    }

    pub(crate) fn outputs(&self) -> &Panel {
        &self.outputs
    }

    fn part(&self, first: usize, count: usize) -> MatRef<'_, f64> {
        let Layout { states, .. } = self.layout;
        let stride = self.transition.stride();
        let entries = &self.transition.entries()[first..];
        MatRef::from_column_major_slice_with_stride(entries, count, states, stride).transpose()
    }

    fn part_mut(&mut self, first: usize, count: usize) -> MatMut<'_, f64> {
        let Layout { states, .. } = self.layout;
        let stride = self.transition.stride();
        let entries = &mut self.transition.entries_mut()[first..];
        MatMut::from_column_major_slice_with_stride_mut(entries, count, states, stride).transpose_mut()
    }
}
