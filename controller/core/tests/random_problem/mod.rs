//! Seeded random LTV problems: an unstable system under input bounds and soft rows.
#![allow(dead_code)]

use delmpc_controller_core::lq_problem::{LqProblem, LqSize, RowTag};
use delmpc_messages::ConstraintKind;

/// A small generator (xorshift64*), so that a seed reproduces a problem.
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// Uniform in -1..1.
    pub fn signed(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// How hard the problem is.
#[derive(Clone, Copy)]
pub struct Limits {
    /// Bound on every input; infinite: none.
    pub input: f64,
    /// Bound of the general rows, which have coefficients of order one.
    pub row: f64,
    /// Bound on every state.
    pub state: f64,
    /// Penalty of rows and states.
    pub penalty: f64,
}

impl Limits {
    pub const NONE: Self =
        Self { input: f64::INFINITY, row: f64::INFINITY, state: f64::INFINITY, penalty: 1e3 };
}

pub fn problem(seed: u64, size: LqSize, limits: Limits) -> LqProblem {
    let mut random = Random::new(seed);
    let mut problem = LqProblem::new(size);
    let (states, inputs) = (size.states, size.inputs);
    for k in 0..size.stages {
        let stage = &mut problem.stages[k];
        for i in 0..states {
            for j in 0..inputs {
                stage.transition[(i, j)] = 0.3 * random.signed();
            }
            for j in 0..states {
                let diagonal = if i == j { 0.9 + 0.3 * random.signed() } else { 0.0 };
                stage.transition[(i, inputs + j)] = diagonal + 0.2 / (states as f64).sqrt() * random.signed();
            }
            stage.defect[i] = 0.01 * random.signed();
        }
        // z'Mz with M = F'F + diagonal
        let width = inputs + states;
        let f: Vec<f64> = (0..width * width).map(|_| random.signed()).collect();
        for i in 0..width {
            for j in 0..=i {
                let product: f64 = (0..width).map(|l| f[l * width + i] * f[l * width + j]).sum();
                let diagonal = if i == j { 0.1 } else { 0.0 };
                stage.hessian[(i, j)] = 0.1 * product / width as f64 + diagonal;
            }
            stage.gradient[i] = 0.05 * random.signed();
        }
        stage.input.upper.fill(limits.input);
        stage.input.lower.fill(-limits.input);
        stage.state.upper.fill(limits.state);
        stage.state.lower.fill(-limits.state);
        if limits.row.is_finite() {
            stage.row_count = size.rows;
            for row in 0..size.rows {
                for i in 0..width {
                    stage.rows[(i, row)] = random.signed();
                }
                stage.row_bound[row] = limits.row;
                stage.row_tag[row] = RowTag {
                    kind: ConstraintKind::Friction,
                    row: row as u32,
                    penalty: limits.penalty,
                    scale: 1.0,
                };
            }
        }
    }
    for i in 0..states {
        problem.terminal_hessian[(i, i)] = 1.0;
        problem.terminal_gradient[i] = 0.05 * random.signed();
        problem.state_tags[i].penalty = limits.penalty;
    }
    problem.terminal_state.upper.fill(limits.state);
    problem.terminal_state.lower.fill(-limits.state);
    problem
}

pub fn start(seed: u64, states: usize, size: f64) -> Vec<f64> {
    let mut random = Random::new(seed ^ 0x55aa);
    (0..states).map(|_| size * random.signed()).collect()
}
