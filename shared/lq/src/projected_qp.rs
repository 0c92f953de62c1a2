//! The constrained problem as a projection, solved through its small dual with row generation.
//!
//! **From the LQ problem to a projection.** With `u_k = K_k x_k + k_k + v_k` the cost is a constant plus `½ Σ v_k' H_k v_k`
//! ([`crate::riccati`]). Let `H_k = L_k L_k'` and `w_k = L_k' v_k`. Every constraint row of the horizon is affine in
//! `w = (w_0, .., w_{N-1})`, since `x` is; write row i as `g_i' w <= h_i` with `h_i` its slack on the LQR trajectory (`w = 0`). So
//!
//! ```text
//! min ½ |w|² + Σ_soft ρ_i max(0, g_i'w - h_i)     s.t.  G_hard w <= h_hard                                          (P)
//! ```
//!
//! the projection of the origin on a polyhedron. Its Lagrange dual: `w = -G'y` minimises the Lagrangian, and a penalty `ρ max(0, t)`
//! is `max_{0<=y<=ρ} y t`, hence
//!
//! ```text
//! min ½ y'(G G')y + h'y     s.t.  0 <= y <= ρ      (ρ = ∞: hard)                                                    (D)
//! ```
//!
//! with as many unknowns as rows. `y_i < ρ_i`: the soft row holds; `y_i = ρ_i`: it gives way by `g_i'w - h_i`.
//!
//! **Rows of G by one adjoint sweep.** For a row `F u_j + E x_j` at stage j, with `u = Kx + k + v`:
//!
//! ```text
//! w_j part:  L_j⁻¹ F'           λ_j = E' + K_j' F'
//! w_i part:  L_i⁻¹ B_i' λ_{i+1}      λ_i = A_i' λ_{i+1} + K_i' (B_i' λ_{i+1})        i = j-1 .. 0
//! ```
//!
//! All new rows sweep together (file `adjoint_sweep.rs`). Rows are scaled to `|g_i| = 1` (`y` and `ρ` with them).
//!
//! **Row generation.** On the LQR trajectory no row violated: it is the optimum, nothing is solved. Otherwise (D) is solved over the
//! rows that were active at the last solution ([`ProjectedQp::prepare`]), or when there are none over the most violated ones; the
//! trajectory of `w = -G'y` is checked over the whole horizon, rows newly violated enter, until none is. The optimum over the
//! rows that entered which violates no other row is the optimum over all. When the capacity is used up, rows with `y = 0` leave. If
//! that is not enough, bounds of states leave for bounds of inputs and rows of outputs, never the other way round: a state that rests
//! on its bound asks for a row at every node, and a trajectory that passes it by a little can be followed; one whose torques or contact
//! forces are beyond their limits cannot. What is still violated is counted as dropped, and [`ProjectedQp::unmet`] says how far inputs
//! and outputs of a stage are from what they have to keep.
//!
//! **Solving (D).** From one cycle to the next the set of active rows hardly changes. So a few partitions of block pivoting
//! ([`crate::active_set_dual`]) are tried from the last multipliers: one small Cholesky factorisation each, and where the signs
//! are right the answer is the optimum to round-off. If it does not settle, the interior-point backend solves it, and its answer is
//! polished in the same way.
//!
//! Rows and `G G'` depend on the linearisation only, the slacks `h` on `x_0` too: sweeping the rows belongs to the preparation.
//!
//! Cost: one rollout O(N n²) per round, one sweep O(j n²) per row, one small QP per round. No allocation after
//! [`ProjectedQp::new`], other than the backend's.
//!
//! Source: own formulation; the dual of a projection: S. Boyd, L. Vandenberghe, *Convex Optimization*, 2004,
//! section 5.2; exact penalty: R. Fletcher, *Practical Methods of Optimization*, 1987, section 12.3.

use alloc::boxed::Box;
use alloc::vec;
use alloc::vec::Vec;

use faer::{Mat, MatRef};

use crate::active_set_dual::ActiveSetDual;
use crate::adjoint_sweep::AdjointSweep;
use crate::dual_qp::QpSolver;
use crate::errors::QpError;
use crate::lq_problem::{LqProblem, LqSize, RowId, RowTag};
use crate::lq_stage::Layout;
use crate::riccati::Riccati;
use crate::trajectory::Trajectory;

/// Multipliers this near to a bound, relative to the largest, are taken to be on it when an interior-point answer is polished.
const NEARLY: f64 = 1e-6;
/// Partitions of that.
const POLISHING_PARTITIONS: u32 = 6;

/// How the row generation proceeds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectedQpOptions {
    /// Rows the dual has room for.
    pub capacity: usize,
    /// Rows that may enter per round.
    pub rows_per_round: usize,
    /// Rounds after which the last trajectory is taken as it is.
    pub max_rounds: u32,
    /// A row is violated beyond this part of its scale.
    pub tolerance: f64,
    /// Partitions of block pivoting tried before the backend is called; 0: the backend solves everything.
    pub pivots: u32,
}

impl Default for ProjectedQpOptions {
    fn default() -> Self {
        Self { capacity: 128, rows_per_round: 24, max_rounds: 8, tolerance: 1e-9, pivots: 12 }
    }
}

/// A constraint that gave way, or was left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Violation {
    /// Which row.
    pub row: RowId,
    /// What it limits.
    pub tag: RowTag,
    /// By how much, in the row's own unit.
    pub amount: f64,
}

/// What a constrained solve took and found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProjectedQpReport {
    /// Dual problems solved; 0: the LQR solution is the optimum.
    pub solves: u32,
    /// Iterations of the backend or partitions of block pivoting, summed.
    pub iterations: u32,
    /// Dual problems that went to the backend.
    pub backend_solves: u32,
    /// Rows with a positive multiplier at the end.
    pub active_rows: u32,
    /// Violated rows left out because there was no capacity for them, or the rounds were over.
    pub dropped_rows: u32,
    /// Solves in which the backend failed and the built-in active-set method answered instead.
    pub backend_failures: u32,
    /// The largest violation relative to its scale that remains.
    pub worst: Option<Violation>,
}

/// Workspace of the constrained solve.
#[derive(Debug)]
pub struct ProjectedQp {
    size: LqSize,
    options: ProjectedQpOptions,
    rows: Vec<RowId>,
    /// `G`, and `G G'` of rows that are not scaled.
    sweep: AdjointSweep,
    gram: Mat<f64>,
    /// Norm every row was divided by.
    row_norm: Vec<f64>,
    slack: Vec<f64>,
    upper: Vec<f64>,
    y: Vec<f64>,
    row_buffer: Vec<f64>,
    w: Vec<f64>,
    v: Mat<f64>,
    lqr: Trajectory,
    violated: Vec<(f64, RowId)>,
    /// By stage: the largest relative violation of an input or output row that is hard or not in the dual.
    unmet: Vec<f64>,
    /// Rows of the dual that make room.
    leaving: Vec<bool>,
    /// Bounds of states had to leave in this solve: no other enters.
    crowded: bool,
    outputs: Vec<f64>,
    pivoting: ActiveSetDual,
    /// Rows with a positive multiplier at the last solution, and the multiplier in the row's own unit.
    active: Vec<(RowId, f64)>,
    /// Whether the first rows are those of [`ProjectedQp::prepare`].
    prepared: bool,
}

impl ProjectedQp {
    /// Room for problems of this size.
    pub fn new(size: LqSize, options: ProjectedQpOptions) -> Self {
        let LqSize { states, inputs, stages, outputs, rows, .. } = size;
        let capacity = options.capacity;
        let total_rows = (stages + 1) * (2 * (inputs + states) + rows);
        Self {
            size,
            options,
            rows: Vec::with_capacity(capacity),
            sweep: AdjointSweep::new(Layout { inputs, states }, stages, capacity),
            gram: Mat::zeros(capacity, capacity),
            row_norm: vec![1.0; capacity],
            slack: vec![0.0; capacity],
            upper: vec![0.0; capacity],
            y: vec![0.0; capacity],
            row_buffer: vec![0.0; inputs + states],
            w: vec![0.0; stages * inputs],
            v: Mat::zeros(inputs, stages),
            lqr: Trajectory::new(size),
            violated: Vec::with_capacity(total_rows),
            unmet: vec![0.0; stages],
            leaving: vec![false; capacity],
            crowded: false,
            outputs: vec![0.0; outputs],
            pivoting: ActiveSetDual::new(capacity),
            active: Vec::with_capacity(capacity),
            prepared: false,
        }
    }

    /// What can be done before `x_0` is known: brings the rows that were active at the last solution in.
    pub fn prepare(&mut self, problem: &LqProblem, riccati: &Riccati) {
        // A stage may have lost rows since: a foot that lifts off.
        self.active.retain(|(row, _)| problem.bound(*row) < f64::INFINITY);
        self.active.sort_unstable_by_key(|(row, _)| core::cmp::Reverse(*row));
        self.rows.clear();
        self.rows.extend(self.active.iter().map(|(row, _)| *row));
        self.sweep(problem, riccati, 0);
        self.normalise(problem, 0);
        for (i, (_, multiplier)) in self.active.iter().enumerate() {
            self.y[i] = (multiplier * self.row_norm[i]).min(self.upper[i]);
        }
        self.prepared = true;
    }

    /// Solves the constrained problem from the first node of `trajectory`, with the factors of `riccati`.
    ///
    /// The trajectory is always finite when the problem's data are: a backend that fails is replaced by the active-set method, and
    /// if that fails too the last good iterate stands.
    ///
    /// # Errors
    /// [`QpError::NotFinite`] when even the LQR trajectory is not finite.
    pub fn solve(
        &mut self,
        problem: &LqProblem,
        riccati: &Riccati,
        backend: &mut dyn QpSolver,
        trajectory: &mut Trajectory,
    ) -> Result<ProjectedQpReport, QpError> {
        let mut report = ProjectedQpReport::default();
        if !core::mem::take(&mut self.prepared) {
            self.rows.clear();
        }
        let warm = self.rows.len();
        self.active.clear();
        self.crowded = false;
        riccati.rollout(problem, None, trajectory);
        if !trajectory.is_finite() {
            return Err(QpError::NotFinite);
        }
        self.find_violated(problem, trajectory, &mut report);
        if report.worst.is_none() {
            self.rows.clear();
            return Ok(report);
        }
        self.lqr.copy_from(trajectory);
        self.complete(problem, 0);
        for round in 0..self.options.max_rounds {
            // The rows of the last solution make most of the violated ones superfluous: they go first, alone.
            let entered = if round == 0 && warm > 0 { warm } else { self.admit(problem, riccati) };
            report.dropped_rows = self.violated.len() as u32;
            if entered == 0 || !self.solve_dual(backend, &mut report) {
                break;
            }
            self.recover(riccati);
            riccati.rollout(problem, Some(&self.v), trajectory);
            if !trajectory.is_finite() {
                trajectory.copy_from(&self.lqr);
                break;
            }
            self.find_violated(problem, trajectory, &mut report);
            report.dropped_rows = self.violated.len() as u32;
        }
        for (i, row) in self.rows.iter().enumerate().filter(|(i, _)| self.y[*i] > 0.0) {
            self.active.push((*row, self.y[i] / self.row_norm[i]));
        }
        report.active_rows = self.active.len() as u32;
        Ok(report)
    }

    /// Rows in the last dual and their multipliers (in the row's own unit).
    pub fn multipliers(&self) -> impl Iterator<Item = (RowId, f64)> + '_ {
        self.rows.iter().enumerate().map(|(i, row)| (*row, self.y[i] / self.row_norm[i]))
    }

    /// Largest violation, relative to its row's scale, of a hard input or output row of a stage at the last solution, or of a soft one
    /// that was left out of the dual. Beyond the tolerance the trajectory of that stage is not one the inputs can follow.
    pub fn unmet(&self, stage: usize) -> f64 {
        self.unmet.get(stage).copied().unwrap_or(0.0)
    }

    /// Lists the violated rows that are not in the dual, most violated first, and notes the worst violation of all.
    fn find_violated(
        &mut self,
        problem: &LqProblem,
        trajectory: &Trajectory,
        report: &mut ProjectedQpReport,
    ) {
        let Self { rows, violated, unmet, outputs, options, .. } = self;
        violated.clear();
        unmet.fill(0.0);
        report.worst = None;
        let mut worst_relative = 0.0;
        problem.visit_rows(trajectory, options.tolerance, outputs, |row, amount, scale| {
            let relative = amount / scale;
            if relative > worst_relative {
                worst_relative = relative;
                report.worst = Some(Violation { row, tag: problem.tag(row), amount });
            }
            let left_out = !rows.contains(&row);
            if left_out && violated.len() < violated.capacity() {
                violated.push((relative, row));
            }
            if (left_out || problem.tag(row).penalty == f64::INFINITY)
                && !problem.bounds_a_state(row)
                && let Some(unmet) = unmet.get_mut(row.stage as usize)
            {
                *unmet = unmet.max(relative);
            }
        });
        violated.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    }

    /// Lets the most violated rows into the dual and computes their columns; returns how many.
    fn admit(&mut self, problem: &LqProblem, riccati: &Riccati) -> usize {
        let late = |row: &RowId| problem.bounds_a_state(*row);
        if self.crowded {
            self.violated.retain(|(_, row)| !late(row));
        }
        let wanted = self.violated.len().min(self.options.rows_per_round);
        if wanted == 0 {
            return 0;
        }
        if self.rows.len() + wanted > self.options.capacity {
            self.violated.sort_unstable_by(|(a, row), (b, other)| {
                late(row).cmp(&late(other)).then(b.total_cmp(a)).then(row.cmp(other))
            });
            let urgent = self.violated[..wanted].iter().filter(|(_, row)| !late(row)).count();
            self.make_room(problem, urgent);
        }
        let first = self.rows.len();
        let entered = wanted.min(self.options.capacity - first);
        self.rows.extend(self.violated.drain(..entered).map(|(_, row)| row));
        // The sweep takes the rows from the last stage to the first.
        self.rows[first..].sort_unstable_by(|a, b| b.cmp(a));
        self.sweep(problem, riccati, first);
        self.normalise(problem, first);
        self.complete(problem, first);
        entered
    }

    /// Removes the bounds of states without a multiplier, and as many rows more as `urgent` ones need: the other rows without a
    /// multiplier, then bounds of states that are also in the dual one node earlier, then the others, the latest first.
    fn make_room(&mut self, problem: &LqProblem, urgent: usize) {
        let Self { rows, y, leaving, options, crowded, .. } = self;
        let count = rows.len();
        for i in 0..count {
            leaving[i] = y[i] <= 0.0 && problem.bounds_a_state(rows[i]);
        }
        let mut left = count - leaving[..count].iter().filter(|leaves| **leaves).count();
        for i in 0..count {
            if left + urgent > options.capacity && y[i] <= 0.0 && !leaving[i] {
                leaving[i] = true;
                left -= 1;
            }
        }
        for alone_too in [false, true] {
            while left + urgent > options.capacity {
                let stays = |other: RowId| (0..count).any(|i| rows[i] == other && !leaving[i]);
                let goes = |i: usize| {
                    let earlier = RowId { stage: rows[i].stage.wrapping_sub(1), ..rows[i] };
                    !leaving[i] && problem.bounds_a_state(rows[i]) && (alone_too || stays(earlier))
                };
                let Some(i) = (0..count).filter(|i| goes(*i)).max_by_key(|i| rows[*i].stage) else { break };
                leaving[i] = true;
                left -= 1;
                // They would only come back.
                *crowded = true;
            }
        }
        self.compact();
    }

    /// Takes the rows that leave out of the dual.
    fn compact(&mut self) {
        let mut kept = 0;
        for i in 0..self.rows.len() {
            if self.leaving[i] {
                continue;
            }
            if kept != i {
                self.rows[kept] = self.rows[i];
                self.row_norm[kept] = self.row_norm[i];
                self.slack[kept] = self.slack[i];
                self.upper[kept] = self.upper[i];
                self.y[kept] = self.y[i];
                self.sweep.move_row(i, kept);
                // Rows and columns up to here are in place, those from i on are still where they were.
                for j in 0..self.rows.len() {
                    self.gram[(kept, j)] = self.gram[(i, j)];
                }
                for j in 0..self.rows.len() {
                    self.gram[(j, kept)] = self.gram[(j, i)];
                }
            }
            kept += 1;
        }
        self.rows.truncate(kept);
    }

    /// `G` for the rows from `first` on, by one backward sweep of all of them together.
    fn sweep(&mut self, problem: &LqProblem, riccati: &Riccati, first: usize) {
        let LqSize { inputs, stages, .. } = self.size;
        let Self { rows, sweep, row_buffer, .. } = self;
        let total = rows.len();
        // Rows first..active are in the sweep.
        let mut active = first;
        while rows.get(active).is_some_and(|row| row.stage as usize >= stages) {
            row_buffer.fill(0.0);
            problem.add_row(rows[active], 1.0, row_buffer);
            sweep.set_last(active, &row_buffer[inputs..]);
            active += 1;
        }
        for k in (0..stages).rev() {
            if active > first {
                sweep.propagate(problem.stages[k].transition(), first..active);
            }
            while rows.get(active).is_some_and(|row| row.stage as usize == k) {
                row_buffer.fill(0.0);
                problem.add_row(rows[active], 1.0, row_buffer);
                let (f, e) = row_buffer.split_at(inputs);
                sweep.set(active, f, e);
                active += 1;
            }
            if active > first {
                sweep.project(riccati.factors(k), k, first..active);
            }
            sweep.clear(k, active..total);
        }
    }

    /// Gram entries, norm and upper bound of the rows from `first` on.
    fn normalise(&mut self, problem: &LqProblem, first: usize) {
        let LqSize { inputs, stages, .. } = self.size;
        let total = self.rows.len();
        // The rows go from the last stage to the first: none of the new ones reaches beyond the first of them.
        let last = self.rows.get(first).map_or(0, |row| row.stage as usize + 1);
        self.sweep.update_gram(first..total, last.min(stages) * inputs);
        for i in first..total {
            let norm = libm::sqrt(self.sweep.gram(i, i));
            // A row nothing can change keeps norm 1: its multiplier stays where the box puts it.
            let norm = if norm > f64::MIN_POSITIVE && norm.is_finite() { norm } else { 1.0 };
            self.row_norm[i] = norm;
            self.upper[i] = problem.tag(self.rows[i]).penalty * norm;
            self.y[i] = 0.0;
            for j in 0..=i {
                let entry = self.sweep.gram(i, j) / (norm * self.row_norm[j]);
                self.gram[(i, j)] = entry;
                self.gram[(j, i)] = entry;
            }
        }
    }

    /// Slack on the LQR trajectory of the rows from `first` on.
    fn complete(&mut self, problem: &LqProblem, first: usize) {
        let LqSize { inputs, stages, .. } = self.size;
        for i in first..self.rows.len() {
            let row = self.rows[i];
            let stage = row.stage as usize;
            self.row_buffer.fill(0.0);
            problem.add_row(row, 1.0, &mut self.row_buffer);
            let (f, e) = self.row_buffer.split_at(inputs);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let mut value = dot(e, self.lqr.x(stage));
            if stage < stages {
                value += dot(f, self.lqr.u(stage));
            }
            self.slack[i] = (problem.bound(row) - value) / self.row_norm[i];
        }
    }

    /// Solves (D); `false` when there is no usable answer.
    fn solve_dual(&mut self, backend: &mut dyn QpSolver, report: &mut ProjectedQpReport) -> bool {
        let total = self.rows.len();
        let gram = self.gram.as_ref().submatrix(0, 0, total, total);
        let (slack, upper) = (&self.slack[..total], &self.upper[..total]);
        report.solves += 1;
        let y = &mut self.y[..total];
        if self.options.pivots > 0 {
            let settled = self.pivoting.settle(gram, slack, upper, y, self.options.pivots);
            if let Ok(Some(dual)) = settled {
                report.iterations += dual.iterations;
                return true;
            }
        }
        report.backend_solves += 1;
        match backend.solve(gram, slack, upper, y) {
            Ok(dual) => {
                report.iterations += dual.iterations;
                if self.options.pivots > 0 {
                    report.iterations += polish(&mut self.pivoting, gram, slack, upper, y);
                }
            }
            Err(_) => {
                report.backend_failures += 1;
                match self.pivoting.solve(gram, slack, upper, y) {
                    Ok(dual) => report.iterations += dual.iterations,
                    Err(_) => {
                        y.fill(0.0);
                        return false;
                    }
                }
            }
        }
        true
    }

    /// `w = -G'y`, `v_k = L_k⁻ᵀ w_k`.
    fn recover(&mut self, riccati: &Riccati) {
        let LqSize { inputs, stages, .. } = self.size;
        let y = self.y.iter().zip(&self.row_norm).take(self.rows.len()).map(|(y, norm)| -y / norm);
        self.sweep.transposed_times(y, &mut self.w);
        for k in 0..stages {
            let v = self.v.col_as_slice_mut(k);
            v.copy_from_slice(&self.w[k * inputs..(k + 1) * inputs]);
            riccati.solve_input_factor_transposed(k, v);
        }
    }
}

/// Takes an interior-point answer to round-off: sides from where its multipliers nearly are, then a few partitions. Leaves the answer
/// as it is when they do not settle; returns the partitions.
fn polish(
    pivoting: &mut ActiveSetDual,
    gram: MatRef<'_, f64>,
    slack: &[f64],
    upper: &[f64],
    y: &mut [f64],
) -> u32 {
    let near = NEARLY * crate::kernels::largest(y);
    match pivoting.settle_near(gram, slack, upper, y, near, POLISHING_PARTITIONS) {
        Ok(Some(dual)) => dual.iterations,
        _ => 0,
    }
}

/// The default backend of this build: Clarabel with the standard library, the active-set method without.
///
/// # Errors
/// [`QpError::Refused`] when Clarabel does not accept its set-up.
pub fn default_backend(capacity: usize) -> Result<Box<dyn QpSolver + Send>, QpError> {
    #[cfg(feature = "clarabel")]
    return Ok(Box::new(crate::clarabel_dual::ClarabelDual::new(capacity, 1e-8)?));
    #[cfg(not(feature = "clarabel"))]
    return Ok(Box::new(ActiveSetDual::new(capacity)));
}
