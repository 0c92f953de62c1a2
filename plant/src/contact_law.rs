//! The contact law of one round: which impulses make the end-of-step velocities obey Signorini and Coulomb.
//!
//! | letter | meaning | unit |
//! |---|---|---|
//! | `λ` | impulses of the step, contact frame: two tangents, normal | N·s |
//! | `W`, `c` | velocities at the end of the step are `W λ + c`, the landing target taken off | 1/kg, m/s |
//! | `σ = tr(W)/3m`, `v̄ = max\|c\|` | scales: `λ = (v̄/σ) x` | |
//! | `ρ`, `ε` | regularisation, centred on the last step's impulses with forgetting | 1 |
//!
//! ```text
//! K ∋ λ ⊥ v + μ|v_t| e_n ∈ K*       v = W λ + c + ρσ (λ - (1-ε) λ_prev)
//! ```
//!
//! `ρ` is a damper between ground and point that acts on *changes* of the force; at a constant force only `ρε = 1e-6` is left. It
//! selects one distribution over redundant corners of a rigid sole.
//!
//! The answer is looked for where it is cheap first:
//!
//! 1. all contacts stick: one linear system; exact when every impulse is inside its cone;
//! 2. Newton on the law ([`crate::friction_cone`]) from the last impulses;
//! 3. the cone program ([`crate::cone_program`]), refined by 2, with the lift corrected in up to four passes;
//! 4. sweeps of projections contact by contact, refined by 2.
//!
//! `W` need not be symmetric in 1, 2 and 4: its antisymmetric part, of relative size Δt, is not lagged.
//!
//! Measured on 4000 random problems (1 to 8 redundant contacts, μ up to 1.2, bodies in full motion; `tests/contact_law.rs`): 3 % stick,
//! 90 % Newton, 7 % cone program, 0.5 % not converged. Of 36 000 steps of dropped boxes none was.

use crate::cone_program::ConeProgram;
use crate::dense::{SmallLu, largest, multiply};
use crate::error::PlantError;
use crate::friction_cone::{SemismoothNewton, law_residual, project, sweep};

/// Residual (scaled) at which an answer is taken.
const ACCEPTED: f64 = 1e-10;
/// Change of the lift (scaled) at which the passes end.
const LIFT_CHANGE: f64 = 1e-7;
/// Passes of cone program and refinement.
const MAX_PASSES: usize = 4;
/// Rounds of sweeps and refinement after that, and sweeps of a round.
const MAX_SWEEP_ROUNDS: usize = 5;
const SWEEPS: usize = 100;

/// Regularisation of the impulse problem.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Regularisation {
    /// `ρ`, relative to the mean diagonal of the response matrix.
    pub strength: f64,
    /// `ε`: share of the last impulses that is forgotten in a step.
    pub forgetting: f64,
}

impl Default for Regularisation {
    fn default() -> Self {
        Self { strength: 1e-4, forgetting: 0.01 }
    }
}

/// One impulse problem, contact by contact; all slices `3m` long but `friction` (`m`) and `response` (`3m x 3m`, row-major).
#[derive(Clone, Copy, Debug)]
pub struct ContactProblem<'a> {
    /// `W`.
    pub response: &'a [f64],
    /// `c`.
    pub free_velocity: &'a [f64],
    /// Friction coefficients.
    pub friction: &'a [f64],
    /// `λ_prev`.
    pub last_impulse: &'a [f64],
}

/// How an answer was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LawPath {
    /// All contacts stick.
    Stick,
    /// Newton from the last impulses.
    Newton,
    /// Cone program and refinement.
    Cone,
}

/// What a solve took and reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LawReport {
    /// Which way led to the answer.
    pub path: LawPath,
    /// Cone programs solved, and their interior-point iterations in all.
    pub cone_solves: u32,
    /// Interior-point iterations in all.
    pub cone_iterations: u32,
    /// Residual of the law, relative to `v̄/σ`.
    pub residual: f64,
    /// Whether the residual is below 1e-10.
    pub converged: bool,
}

/// Solver with all its memory, for up to a fixed number of contacts.
#[derive(Debug)]
pub struct ContactLaw {
    regularisation: Regularisation,
    programs: Vec<ConeProgram>,
    newton: SemismoothNewton,
    lu: SmallLu,
    a: Vec<f64>,
    d: Vec<f64>,
    x: Vec<f64>,
    best: Vec<f64>,
    polished: Vec<f64>,
    gradient: Vec<f64>,
    velocity: Vec<f64>,
    lift: Vec<f64>,
}

impl ContactLaw {
    /// For up to `contacts` contacts.
    ///
    /// # Errors
    /// [`PlantError::ConeSolver`] when Clarabel refuses the set-up.
    pub fn new(contacts: usize, regularisation: Regularisation) -> Result<Self, PlantError> {
        let n = 3 * contacts;
        Ok(Self {
            regularisation,
            programs: (1..=contacts).map(ConeProgram::new).collect::<Result<_, _>>()?,
            newton: SemismoothNewton::new(contacts),
            lu: SmallLu::new(n),
            a: vec![0.0; n * n],
            d: vec![0.0; n],
            x: vec![0.0; n],
            best: vec![0.0; n],
            polished: vec![0.0; n],
            gradient: vec![0.0; n],
            velocity: vec![0.0; n],
            lift: vec![0.0; contacts],
        })
    }

    /// Improves `impulse`, which holds a guess, to the solution. Allocates only inside Clarabel, and only when neither sticking nor
    /// Newton's method leads to it.
    pub fn solve(&mut self, problem: &ContactProblem<'_>, impulse: &mut [f64]) -> LawReport {
        let (m, n) = (problem.friction.len(), 3 * problem.friction.len());
        let sigma = (0..n).map(|k| problem.response[k * n + k]).sum::<f64>() / n as f64;
        let scale = self.scale(problem, sigma);
        let mu = problem.friction;
        let mut report = LawReport {
            path: LawPath::Stick,
            cone_solves: 0,
            cone_iterations: 0,
            residual: 0.0,
            converged: true,
        };
        if self.stick(mu, n) {
            write_scaled(&self.x[..n], scale, impulse);
            return report;
        }
        let (a, d) = (&self.a[..n * n], &self.d[..n]);
        let (x, best, velocity) = (&mut self.x[..n], &mut self.best[..n], &mut self.velocity[..n]);

        report.path = LawPath::Newton;
        for (best, impulse) in best.iter_mut().zip(impulse.iter()) {
            *best = impulse / scale;
        }
        (report.residual, _) = self.newton.refine(a, d, mu, best);
        if report.residual > ACCEPTED {
            law_residual(a, d, mu, best, velocity);
            tangential(mu, velocity, &mut self.lift);
            x.copy_from_slice(best);
            for _ in 0..MAX_PASSES {
                report.path = LawPath::Cone;
                report.cone_solves += 1;
                // The program is symmetric: the antisymmetric part acts on the pass before.
                for (r, gradient) in self.gradient[..n].iter_mut().enumerate() {
                    let skew: f64 = (0..n).map(|c| 0.5 * (a[r * n + c] - a[c * n + r]) * x[c]).sum();
                    *gradient = d[r] + skew;
                }
                match self.programs[m - 1].solve(a, &self.gradient[..n], mu, &self.lift[..m], x) {
                    Some(iterations) => report.cone_iterations += iterations,
                    None => break,
                }
                // The lift follows the cone program itself: its fixed point is the law, whatever the refinement does.
                law_residual(a, d, mu, x, velocity);
                let change = tangential(mu, velocity, &mut self.lift);
                let polished = &mut self.polished[..n];
                polished.copy_from_slice(x);
                let (residual, _) = self.newton.refine(a, d, mu, polished);
                if residual < report.residual {
                    report.residual = residual;
                    best.copy_from_slice(polished);
                }
                if report.residual <= ACCEPTED || change <= LIFT_CHANGE {
                    break;
                }
            }
        }
        for _ in 0..MAX_SWEEP_ROUNDS {
            if report.residual <= ACCEPTED {
                break;
            }
            x.copy_from_slice(best);
            sweep(a, d, mu, x, SWEEPS);
            let (residual, _) = self.newton.refine(a, d, mu, x);
            if residual < report.residual {
                report.residual = residual;
                best.copy_from_slice(x);
            }
        }
        report.converged = report.residual <= ACCEPTED;
        if !report.converged {
            for (x, mu) in best.chunks_exact_mut(3).zip(mu) {
                x.copy_from_slice(&project(*mu, [x[0], x[1], x[2]]));
            }
        }
        write_scaled(best, scale, impulse);
        report
    }

    /// Residual of the law at `impulse`, relative to `v̄/σ`.
    pub fn residual(&mut self, problem: &ContactProblem<'_>, impulse: &[f64]) -> f64 {
        let n = impulse.len();
        let sigma = (0..n).map(|k| problem.response[k * n + k]).sum::<f64>() / n as f64;
        let scale = self.scale(problem, sigma);
        for (x, impulse) in self.x.iter_mut().zip(impulse) {
            *x = impulse / scale;
        }
        law_residual(&self.a[..n * n], &self.d[..n], problem.friction, &self.x[..n], &mut self.velocity[..n])
    }

    /// Fills `A = W/σ + ρ` and `d = c/v̄ - ρ(1-ε) x_prev`; returns `v̄/σ`.
    fn scale(&mut self, problem: &ContactProblem<'_>, sigma: f64) -> f64 {
        let n = problem.free_velocity.len();
        let Regularisation { strength, forgetting } = self.regularisation;
        // A problem without motion is scaled by its impulses.
        let speed =
            largest(problem.free_velocity).max(1e-6 * sigma * largest(problem.last_impulse)).max(1e-12);
        let scale = speed / sigma;
        for (a, w) in self.a.iter_mut().zip(problem.response) {
            *a = w / sigma;
        }
        for k in 0..n {
            self.a[k * n + k] += strength;
            let centre = strength * (1.0 - forgetting) * problem.last_impulse[k] / scale;
            self.d[k] = problem.free_velocity[k] / speed - centre;
        }
        scale
    }

    /// `x = -A⁻¹ d`; whether all of it is inside the cones.
    fn stick(&mut self, mu: &[f64], n: usize) -> bool {
        if !self.lu.factorise(&self.a[..n * n], n) {
            return false;
        }
        for (x, d) in self.x.iter_mut().zip(&self.d[..n]) {
            *x = -d;
        }
        self.lu.solve(&mut self.x[..n]);
        mu.iter().zip(self.x.chunks_exact(3)).all(|(mu, x)| x[0].hypot(x[1]) <= mu * x[2])
    }

    /// `W x` for a vector of this problem; scratch for the rounds.
    pub(crate) fn apply(response: &[f64], x: &[f64], out: &mut [f64]) {
        multiply(response, x, out);
    }
}

fn write_scaled(x: &[f64], scale: f64, impulse: &mut [f64]) {
    for (impulse, x) in impulse.iter_mut().zip(x) {
        *impulse = x * scale;
    }
}

/// `s_i = μ_i |v_t,i|`; returns the largest change.
fn tangential(mu: &[f64], velocity: &[f64], lift: &mut [f64]) -> f64 {
    let mut change = 0.0f64;
    for ((mu, v), lift) in mu.iter().zip(velocity.chunks_exact(3)).zip(lift) {
        let new = mu * v[0].hypot(v[1]);
        change = change.max((new - *lift).abs());
        *lift = new;
    }
    change
}
