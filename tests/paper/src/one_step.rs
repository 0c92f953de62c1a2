//! One step of the trapezoidal integrator as a root-finding problem, the same for all methods of figure 1.
//!
//! Unknown: `q^1`, residual `r(q^1) = p + D_1 L_d(q^0, q^1)` by Algorithm 1. All methods start from `q^0 + Δt q̇` and stop at
//! `|r|_2 <= 1e-8` (the tolerance of the quasi-Newton method's published experiments). A root further than a radian from the start is
//! not a continuation of the motion and counts as a failure, as it does in the integrator.

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::prelude::*;

use crate::pendulum::Initial;

/// N m s.
pub const TOLERANCE: f64 = 1e-8;
/// Residuals beyond this do not come back.
const DIVERGED: f64 = 1e12;
/// rad.
const TURN_LIMIT: f64 = 1.0;

/// How a method ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// With the number of changes of `q^1`.
    Solved(usize),
    /// Diverged, out of iterations, or at a spurious root.
    Failed,
}

impl Outcome {
    /// Whether it found the root.
    pub fn is_solved(self) -> bool {
        matches!(self, Self::Solved(_))
    }
}

/// What an iterate is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// A root.
    Root,
    /// Not yet one.
    Open,
    /// Out of reach.
    Lost,
}

/// The problem with the iterate and everything evaluated at it.
#[derive(Clone, Debug)]
pub struct OneStep {
    /// The pendulum.
    pub tree: KinematicTree,
    /// Nodes and Algorithm 1.
    pub del: DelWorkspace,
    /// `r`, valid after [`Self::evaluate`].
    pub residual: Vec<f64>,
    /// `|r|_2`, likewise.
    pub residual_size: f64,
    start: Vec<f64>,
    rate: Vec<f64>,
    guess: Vec<f64>,
    state: State,
    time_step: f64,
    torques: Vec<f64>,
}

impl OneStep {
    /// For steps of `time_step` (s).
    ///
    /// # Errors
    /// [`ModelError::TimeStep`] unless positive and finite.
    pub fn new(tree: &KinematicTree, time_step: f64) -> Result<Self, ModelError> {
        let del = DelWorkspace::new(tree, &LobattoRule::new(1)?, time_step, ForceCapacity::default())?;
        let n = tree.dof();
        Ok(Self {
            tree: tree.clone(),
            del,
            residual: vec![0.0; n],
            residual_size: 0.0,
            start: vec![0.0; n],
            rate: vec![0.0; n],
            guess: vec![0.0; n],
            state: State::zeros(tree),
            time_step,
            torques: vec![0.0; n],
        })
    }

    /// Begins at `state`, whose rate is `initial.v`.
    ///
    /// # Errors
    /// [`StepError`] for a state that is not finite or does not fit.
    pub fn begin(&mut self, state: &State, initial: &Initial) -> Result<(), StepError> {
        self.del.begin(&self.tree, state, &StepForces::held(&self.torques))?;
        self.state.copy_from(state);
        self.rate.copy_from_slice(&initial.v);
        let time_step = self.time_step;
        for (i, start) in self.start.iter_mut().enumerate() {
            *start = initial.q[i] + time_step * initial.v[i];
        }
        self.restart();
        Ok(())
    }

    /// Back to the start.
    pub fn restart(&mut self) {
        for (i, start) in self.start.iter().enumerate() {
            self.del.set_node(1, i, *start);
        }
    }

    /// Makes it the problem of half the step, from its own start. Returns whether the state is accepted.
    pub fn halve(&mut self) -> bool {
        let half = 0.5 * self.time_step;
        let begun = self.change_time_step(half);
        for (i, rate) in self.rate.iter().enumerate() {
            self.del.set_node(1, i, self.state.q[i] + half * rate);
        }
        begun
    }

    /// Back to the whole step, from the parabola through the start, its rate and the present iterate at half the step.
    pub fn restore(&mut self) -> bool {
        let n = self.rate.len();
        for i in 0..n {
            let (start, moved) = (self.state.q[i], 0.5 * self.time_step * self.rate[i]);
            let bend = self.del.node(1, i) - start - moved;
            self.guess[i] = start + 2.0 * moved + 4.0 * bend;
        }
        let begun = self.change_time_step(self.time_step);
        for (i, guess) in self.guess.iter().enumerate() {
            self.del.set_node(1, i, *guess);
        }
        begun
    }

    fn change_time_step(&mut self, time_step: f64) -> bool {
        self.del.set_time_step(time_step).is_ok()
            && self.del.begin(&self.tree, &self.state, &StepForces::held(&self.torques)).is_ok()
    }

    /// `r` at the iterate.
    pub fn evaluate(&mut self) -> Progress {
        self.del.evaluate(&self.tree, &[]);
        self.del.residual_into(&self.tree, &mut self.residual);
        self.residual_size = self.residual.iter().map(|r| r * r).sum::<f64>().sqrt();
        if self.residual_size <= TOLERANCE {
            Progress::Root
        } else if self.residual_size < DIVERGED {
            Progress::Open
        } else {
            Progress::Lost
        }
    }

    /// Moves the iterate by `scale` times `direction`.
    pub fn step(&mut self, scale: f64, direction: &[f64]) {
        for (i, change) in direction.iter().enumerate() {
            self.del.move_node(1, i, scale * change);
        }
    }

    /// A root is the outcome if it continues the motion.
    pub fn accept(&self, iterations: usize) -> Outcome {
        let near = |(i, start): (usize, &f64)| (self.del.node(1, i) - start).abs() <= TURN_LIMIT;
        if self.start.iter().enumerate().all(near) { Outcome::Solved(iterations) } else { Outcome::Failed }
    }
}
