//! A trajectory of the linear-quadratic problem: states at the nodes, inputs of the stages.

use crate::kernels::all_finite;
use crate::lq_problem::LqSize;
use crate::lq_stage::Layout;
use crate::panel::{Panel, transposed_times};

/// States `x_0..x_N` and inputs `u_0..u_{N-1}`, each stage as one vector `z̃ = (u, x, 1)` (`crate::lq_stage`).
#[derive(Clone, Debug)]
pub struct Trajectory {
    layout: Layout,
    stages: usize,
    panel: Panel,
}

impl Trajectory {
    /// Zeros.
    pub fn new(size: LqSize) -> Self {
        let layout = Layout { inputs: size.inputs, states: size.states };
        let mut panel = Panel::zeros(layout.rows(), size.stages + 1);
        for node in 0..=size.stages {
            panel.column_mut(node)[layout.one()] = 1.0;
        }
        Self { layout, stages: size.stages, panel }
    }

    /// Number of stages `N`.
    pub fn stages(&self) -> usize {
        self.stages
    }

    /// `x_k`, `k` in `0..=N`.
    pub fn x(&self, node: usize) -> &[f64] {
        &self.panel.column(node)[self.layout.first_state()..self.layout.one()]
    }

    /// `x_k`, to write.
    pub fn x_mut(&mut self, node: usize) -> &mut [f64] {
        let (first, one) = (self.layout.first_state(), self.layout.one());
        &mut self.panel.column_mut(node)[first..one]
    }

    /// `u_k`, `k` in `0..N`.
    pub fn u(&self, stage: usize) -> &[f64] {
        &self.panel.column(stage)[..self.layout.inputs]
    }

    /// `u_k`, to write.
    pub fn u_mut(&mut self, stage: usize) -> &mut [f64] {
        let inputs = self.layout.inputs;
        &mut self.panel.column_mut(stage)[..inputs]
    }

    /// Whether every entry is finite.
    pub fn is_finite(&self) -> bool {
        all_finite(self.panel.entries())
    }

    /// Copies another trajectory of the same size.
    pub fn copy_from(&mut self, other: &Self) {
        self.panel.entries_mut().copy_from_slice(other.panel.entries());
    }

    /// Adds the states and inputs of another one.
    pub fn add(&mut self, other: &Self) {
        for node in 0..=self.stages {
            self.x_mut(node).iter_mut().zip(other.x(node)).for_each(|(a, b)| *a += b);
        }
        for stage in 0..self.stages {
            self.u_mut(stage).iter_mut().zip(other.u(stage)).for_each(|(a, b)| *a += b);
        }
    }

    /// `u_k = K x_k + k`, from `(K k)'`.
    pub(crate) fn feed_back(&mut self, stage: usize, gain: &Panel) {
        let Layout { inputs, .. } = self.layout;
        let (u, rest) = self.panel.column_mut(stage).split_at_mut(self.layout.first_state());
        transposed_times(gain, rest, &mut u[..inputs]);
    }

    /// `x_{k+1} = [B A d] z̃_k`, from its transpose.
    pub(crate) fn advance(&mut self, stage: usize, transition: &Panel) {
        let (first, one) = (self.layout.first_state(), self.layout.one());
        let (now, next) = self.panel.pair_mut(stage);
        transposed_times(transition, now, &mut next[first..one]);
    }

    /// `z̃_k` with its padding.
    pub(crate) fn z(&self, stage: usize) -> &[f64] {
        self.panel.column(stage)
    }
}
