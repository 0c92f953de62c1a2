//! From a guess to a plan: κ → 0 in two passes.
//!
//! ```text
//! P1 pass 1: κ from κ_start, x factor, to κ_between,   δ = clamp(0.05 κ, 1e-7, 1e-2),  σ = min(1, step/6);   from the guess
//!    pass 2: κ from κ_between (or less), to 1e-6,      δ = 0.3 κ,                      σ = 1;                from pass 1
//!    both with all multipliers zero at first;  μ = 0.1 min(κ, 0.1)
//! P2   rounds (2..4; pass 2: 3; last κ: 14):
//! P3     Newton on Φ until |∇Φ| < 1e-2 min(1, 1e-3/δ)
//! P4     converged or |∇Φ| < 10: y := ŷ, z := ẑ;   violation below the tolerance: next κ;   above ¼ of the last: δ := δ/3
//! ```
//!
//! [`Schedule::planar`]: a rough first pass, a second pass with fresh multipliers.
//! [`Schedule::one_pass`] takes the first pass to the end: multipliers and δ are kept from one κ to the next (a δ that grows
//! again undoes what the rounds before have paid for), and the second pass is for what has not converged then.
//! [`Schedule::spatial`] is that, begun where robots still slide but no longer freely: from κ = 1 all guesses become the same
//! symmetric slide, whose fastest instability is a patter of all feet.

use std::time::Duration;

use crate::barrier::Barrier;
use crate::contact_law::Homotopy;
use crate::error::PlanError;
use crate::newton::{Effort, MOST_HALVINGS, Minimiser};

/// Rounds at the last κ.
const LAST_ROUNDS: usize = 14;
/// Violation at which the last κ ends before its rounds are over.
const LAST_TOLERANCE: f64 = 3e-7;

/// Settings of the homotopy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Whether δ never grows within a pass.
    pub keeps_penalty: bool,
    /// Where pass 1 begins.
    pub kappa_start: f64,
    /// Where pass 1 ends.
    pub kappa_between: f64,
    /// Where pass 2 ends.
    pub kappa_end: f64,
    /// Where the pass of a refined plan begins.
    pub kappa_refined: f64,
    /// `δ/κ` in pass 1.
    pub first_penalty: f64,
    /// Factor from one κ to the next in pass 1.
    pub first_factor: f64,
    /// Factor from one κ to the next in pass 2.
    pub second_factor: f64,
    /// Halvings of a step before it is repeated with more regularisation: a line search (12), or nearly a trust region (1).
    pub halvings: usize,
    /// Newton iterations per round.
    pub iterations: usize,
    /// Violation below which pass 1 goes on to the next κ before its rounds are over.
    pub first_tolerance: f64,
    /// Rounds at each κ of pass 1.
    pub first_rounds: usize,
    /// Violation below which a plan is one.
    pub tolerance: f64,
    /// Smallest penalty parameter.
    pub least_penalty: f64,
    /// `|∇Φ|` (scaled) below which multipliers are updated in pass 1.
    pub first_update: f64,
}

impl Schedule {
    /// Settings for robots in a plane: two passes.
    pub fn planar() -> Self {
        Self {
            keeps_penalty: false,
            kappa_start: 1.0,
            kappa_between: 3e-4,
            kappa_end: 1e-6,
            kappa_refined: 1e-4,
            first_penalty: 0.05,
            first_factor: 0.35,
            second_factor: 0.3,
            halvings: MOST_HALVINGS,
            iterations: 80,
            first_tolerance: 1e-3,
            first_rounds: 2,
            tolerance: 4e-6,
            least_penalty: 1e-9,
            first_update: 10.0,
        }
    }

    /// One pass that keeps its multipliers and δ to the end: for tasks with bounds on what happens before an impact.
    pub fn one_pass() -> Self {
        Self {
            keeps_penalty: true,
            halvings: 1,
            kappa_between: 1e-6,
            first_tolerance: 1e-4,
            first_rounds: 4,
            ..Self::planar()
        }
    }

    /// Settings for robots in space: one pass, begun where robots slide but no longer freely.
    pub fn spatial() -> Self {
        Self { kappa_start: 0.03, ..Self::one_pass() }
    }
}

impl Default for Schedule {
    fn default() -> Self {
        Self::planar()
    }
}

/// Where the homotopy is.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// Pass, 1 or 2.
    pub pass: usize,
    /// Relaxation, S m.
    pub kappa: f64,
    /// Penalty parameter.
    pub delta: f64,
    /// Largest violation of a row.
    pub violation: f64,
    /// Largest scaled entry of `∇Φ`.
    pub gradient: f64,
    /// Cost.
    pub cost: f64,
    /// Effort so far.
    pub effort: Effort,
    /// Part of the way done, an estimate, 0 to 1.
    pub done: f64,
    /// The most violated rows: stage, row, violation.
    pub worst: Vec<(usize, usize, f64)>,
}

/// Whether to go on.
pub type Watcher<'w> = dyn FnMut(&Progress) -> bool + 'w;

/// How the homotopy ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Last state.
    pub progress: Progress,
    /// Whether κ reached its end with the violation below the tolerance.
    pub converged: bool,
    /// Whether the watcher stopped it.
    pub stopped: bool,
}

/// Says when a budget of time is spent.
#[derive(Clone, Copy, Debug)]
pub struct Budget {
    began: std::time::Instant,
    limit: Option<Duration>,
}

impl Budget {
    /// Starts now.
    pub fn start(limit: Option<Duration>) -> Self {
        Self { began: std::time::Instant::now(), limit }
    }
    /// Time since the start.
    pub fn spent(&self) -> Duration {
        self.began.elapsed()
    }
    /// Whether there is time left.
    pub fn is_left(&self) -> bool {
        self.limit.is_none_or(|limit| self.spent() < limit)
    }
}

/// One value of κ.
struct Rung {
    pass: usize,
    kappa: f64,
    sigma: f64,
    delta: f64,
    rounds: usize,
    iterations: usize,
    update: f64,
    tolerance: f64,
    done: f64,
}

/// Both passes.
///
/// # Errors
/// [`PlanError::Indefinite`].
pub fn two_passes(
    minimiser: &mut Minimiser<'_>,
    schedule: &Schedule,
    watch: &mut Watcher<'_>,
) -> Result<Outcome, PlanError> {
    let first = first_pass(minimiser, schedule, watch)?;
    if first.stopped || first.converged {
        return Ok(first);
    }
    second_pass(minimiser, schedule, schedule.kappa_between.max(schedule.kappa_refined), watch)
}

/// Pass 1: from a guess to a rough plan.
///
/// # Errors
/// [`PlanError::Indefinite`].
pub fn first_pass(
    minimiser: &mut Minimiser<'_>,
    schedule: &Schedule,
    watch: &mut Watcher<'_>,
) -> Result<Outcome, PlanError> {
    minimiser.forget_multipliers();
    let mut kappa = schedule.kappa_start;
    let mut step = 0.0;
    let count = ((schedule.kappa_between / kappa).ln() / schedule.first_factor.ln()).ceil().max(1.0);
    loop {
        let last = kappa <= schedule.kappa_end;
        let rung = Rung {
            pass: 1,
            kappa,
            sigma: (step / 6.0f64).min(1.0),
            delta: (schedule.first_penalty * kappa).clamp(1e-7, 1e-2),
            rounds: if last { LAST_ROUNDS } else { schedule.first_rounds },
            iterations: schedule.iterations,
            update: schedule.first_update,
            tolerance: if last { LAST_TOLERANCE } else { kappa.min(schedule.first_tolerance) },
            done: 0.6 * step / count,
        };
        let mut outcome = climb(minimiser, schedule, &rung, watch)?;
        outcome.converged = last && outcome.progress.violation <= schedule.tolerance;
        if outcome.stopped || kappa <= schedule.kappa_between {
            return Ok(outcome);
        }
        kappa = (kappa * schedule.first_factor).max(schedule.kappa_between);
        step += 1.0;
    }
}

/// Pass 2: from a rough plan to a plan, from the relaxation `kappa` on.
///
/// # Errors
/// [`PlanError::Indefinite`].
pub fn second_pass(
    minimiser: &mut Minimiser<'_>,
    schedule: &Schedule,
    mut kappa: f64,
    watch: &mut Watcher<'_>,
) -> Result<Outcome, PlanError> {
    minimiser.forget_multipliers();
    let count = ((schedule.kappa_end / kappa).ln() / schedule.second_factor.ln()).ceil().max(1.0);
    let mut step = 0.0;
    loop {
        let last = kappa <= schedule.kappa_end;
        let rung = Rung {
            pass: 2,
            kappa,
            sigma: 1.0,
            delta: (0.3 * kappa).clamp(schedule.least_penalty, 1e-2),
            rounds: if last { LAST_ROUNDS } else { 3 },
            iterations: schedule.iterations,
            update: 10.0,
            tolerance: if last { LAST_TOLERANCE } else { 1e-4 },
            done: 0.6 + 0.4 * step / (count + 1.0),
        };
        let mut outcome = climb(minimiser, schedule, &rung, watch)?;
        if outcome.stopped || last {
            outcome.converged = outcome.progress.violation <= schedule.tolerance;
            return Ok(outcome);
        }
        kappa = (kappa * schedule.second_factor).max(schedule.kappa_end);
        step += 1.0;
    }
}

fn climb(
    minimiser: &mut Minimiser<'_>,
    schedule: &Schedule,
    rung: &Rung,
    watch: &mut Watcher<'_>,
) -> Result<Outcome, PlanError> {
    let homotopy = Homotopy { kappa: rung.kappa, sigma: rung.sigma };
    minimiser.halvings = schedule.halvings;
    let mut delta = rung.delta;
    if schedule.keeps_penalty {
        delta = delta.min(minimiser.last_penalty);
    }
    let mut before = f64::INFINITY;
    let mut round = 0;
    loop {
        let barrier = Barrier { mu: 0.1 * rung.kappa.min(0.1), delta };
        let descent = minimiser.minimise(homotopy, barrier, rung.iterations)?;
        minimiser.last_penalty = delta;
        if descent.converged || descent.gradient < rung.update {
            minimiser.update_multipliers();
        }
        let violation = minimiser.violation();
        let progress = Progress {
            pass: rung.pass,
            kappa: rung.kappa,
            delta,
            violation,
            gradient: descent.gradient,
            cost: minimiser.cost(),
            effort: minimiser.effort,
            done: rung.done,
            worst: minimiser.worst_rows(5),
        };
        let stopped = !watch(&progress);
        round += 1;
        if stopped || violation < rung.tolerance || round == rung.rounds {
            return Ok(Outcome { progress, converged: false, stopped });
        }
        if violation > 0.25 * before {
            delta = (delta / 3.0).max(schedule.least_penalty);
        }
        before = violation;
    }
}
