//! Seeded random LTV problems: an unstable system under input bounds and soft rows.
#![allow(dead_code)]

use delmpc_lq::lq_problem::{LqProblem, LqSize, RowTag};
use delmpc_lq::lq_stage::LqStage;

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
        transition(stage, size, &mut random);
        // A full Q = F'F + diagonal.
        for i in 0..inputs {
            stage.cost.input_weight[i] = 0.1 + 0.05 * (1.0 + random.signed());
            stage.cost.input_gradient[i] = 0.05 * random.signed();
        }
        for i in 0..states {
            stage.cost.state_weight[i] = 0.1;
            stage.cost.state_gradient[i] = 0.05 * random.signed();
        }
        stage.cost.residuals.clear();
        while let Some(row) = stage.cost.residuals.push(0.05 * random.signed()) {
            row.iter_mut().for_each(|entry| *entry = (0.1 / states as f64).sqrt() * random.signed());
        }
        stage.row_bounds.fill(limits.row);
        let mut row = vec![0.0; size.inputs + states];
        loop {
            row.iter_mut().for_each(|entry| *entry = 0.2 * random.signed());
            let value = 0.1 * random.signed();
            if !stage.cost.squares.push(1.0, (&row[..size.inputs], &row[size.inputs..], value)) {
                break;
            }
        }
        stage.input.upper.fill(limits.input);
        stage.input.lower.fill(-limits.input);
        stage.state.upper.fill(limits.state);
        stage.state.lower.fill(-limits.state);
        for output in 0..size.outputs {
            let output = stage.output_mut(output);
            output.by_input.iter_mut().chain(output.by_state).for_each(|c| *c = random.signed());
            *output.value = 0.1 * random.signed();
        }
    }
    for (i, row) in problem.output_rows.iter_mut().enumerate() {
        row.coefficients[i] = 1.0;
        row.tag = RowTag { label: 3, row: i as u32, penalty: limits.penalty, scale: 1.0 };
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

fn transition(stage: &mut LqStage, size: LqSize, random: &mut Random) {
    let LqSize { states, inputs, .. } = size;
    for i in 0..states {
        for j in 0..inputs {
            stage.b_mut()[(i, j)] = 0.3 * random.signed();
        }
        for j in 0..states {
            let diagonal = if i == j { 0.9 + 0.3 * random.signed() } else { 0.0 };
            stage.a_mut()[(i, j)] = diagonal + 0.2 / (states as f64).sqrt() * random.signed();
        }
        stage.set_defect(i, 0.01 * random.signed());
    }
}

pub fn start(seed: u64, states: usize, size: f64) -> Vec<f64> {
    let mut random = Random::new(seed ^ 0x55aa);
    (0..states).map(|_| size * random.signed()).collect()
}
