//! The impulse problem as a second-order-cone program on Clarabel, one solver per number of contacts, updated in place.
//!
//! ```text
//! min ½ xᵀ A_s x + xᵀ (d + s e_n)      s.t.  (μ x_n, x_t1, x_t2) ∈ SOC(3) per contact       A_s = (A + Aᵀ)/2,  s_i = μ_i |v_t,i|
//! ```
//!
//! The pattern of `P` is the dense upper triangle; the constraint rows are `-diag(μ; 1; 1)`, permuted, with a zero bound. `s` is the
//! correction of the relaxation: without it a sliding body is lifted. It comes from the velocities of the pass before.
//!
//! Source: P. Goulart, Y. Chen, *Clarabel: An interior-point solver for conic programs with quadratic objectives*, 2024.

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT};

use crate::error::PlantError;

/// Absolute and relative tolerance. 1e-12 often ends "almost solved", which is accepted too.
const TOLERANCE: f64 = 1e-10;
/// Interior-point iterations after which a solve is given up; 7 to 14 are usual.
const MAX_ITERATIONS: u32 = 40;
/// A cone of friction 0 has no interior: the program sees at least this, the refinement the true value.
const SMALLEST_FRICTION: f64 = 1e-6;

/// The cone program for one number of contacts.
pub struct ConeProgram {
    contacts: usize,
    solver: DefaultSolver<f64>,
    hessian: Vec<f64>,
    gradient: Vec<f64>,
    matrix: Vec<f64>,
    friction: Vec<f64>,
}

impl core::fmt::Debug for ConeProgram {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("ConeProgram").field("contacts", &self.contacts).finish_non_exhaustive()
    }
}

impl ConeProgram {
    /// Sets up the solver for `contacts` contacts.
    ///
    /// # Errors
    /// [`PlantError::ConeSolver`] when Clarabel refuses the set-up.
    pub fn new(contacts: usize) -> Result<Self, PlantError> {
        let n = 3 * contacts;
        let refused = || PlantError::ConeSolver { contacts };
        let settings = DefaultSettingsBuilder::default()
            .verbose(false)
            .max_threads(1)
            .max_iter(MAX_ITERATIONS)
            .tol_gap_abs(TOLERANCE)
            .tol_gap_rel(TOLERANCE)
            .tol_feas(TOLERANCE)
            .direct_solve_method(String::from("qdldl"))
            .presolve_enable(false)
            .input_sparse_dropzeros(false)
            .build()
            .map_err(|_| refused())?;
        // Data of the usual size; the equilibration of the set-up stays.
        let (mut column_starts, mut rows, mut hessian) = (vec![0], Vec::new(), Vec::new());
        for column in 0..n {
            for row in 0..=column {
                rows.push(row);
                hessian.push(if row == column { 1.0 } else { 0.1 / n as f64 });
            }
            column_starts.push(rows.len());
        }
        let p = CscMatrix::new(n, n, column_starts, rows, hessian.clone());
        // Column 3i is the first tangent (row 3i + 1), 3i + 1 the second (row 3i + 2), 3i + 2 the normal (row 3i).
        let (mut column_starts, mut rows, mut matrix) = (vec![0], Vec::new(), Vec::new());
        for column in 0..n {
            let (contact, axis) = (column / 3, column % 3);
            rows.push(3 * contact + (axis + 1) % 3);
            matrix.push(if axis == 2 { -0.5 } else { -1.0 });
            column_starts.push(rows.len());
        }
        let a = CscMatrix::new(n, n, column_starts, rows, matrix.clone());
        let gradient = vec![1.0; n];
        let cones = vec![SupportedConeT::SecondOrderConeT(3); contacts];
        let solver =
            DefaultSolver::new(&p, &gradient, &a, &vec![0.0; n], &cones, settings).map_err(|_| refused())?;
        Ok(Self { contacts, solver, hessian, gradient, matrix, friction: vec![0.5; contacts] })
    }

    /// Solves for `x`; returns the interior-point iterations, or `None` when the program was not solved (`x` is untouched).
    ///
    /// `a` is row-major `3m x 3m` and is symmetrised here, `lift` holds `s`. Clarabel makes one small allocation.
    pub fn solve(&mut self, a: &[f64], d: &[f64], mu: &[f64], lift: &[f64], x: &mut [f64]) -> Option<u32> {
        let n = 3 * self.contacts;
        let mut entry = 0;
        for column in 0..n {
            for row in 0..=column {
                self.hessian[entry] = 0.5 * (a[row * n + column] + a[column * n + row]);
                entry += 1;
            }
            self.gradient[column] = d[column] + if column % 3 == 2 { lift[column / 3] } else { 0.0 };
        }
        if self.friction.as_slice() != mu {
            self.friction.copy_from_slice(mu);
            for (contact, mu) in mu.iter().enumerate() {
                self.matrix[3 * contact + 2] = -mu.max(SMALLEST_FRICTION);
            }
            self.solver.update_A(&self.matrix).ok()?;
        }
        self.solver.update_P(&self.hessian).ok()?;
        self.solver.update_q(&self.gradient).ok()?;
        self.solver.solve();
        let solution = &self.solver.solution;
        let usable = matches!(solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved);
        if !usable || solution.x.iter().any(|x| !x.is_finite()) {
            return None;
        }
        x.copy_from_slice(&solution.x);
        Some(solution.iterations)
    }
}
