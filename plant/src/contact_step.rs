//! One step of a robot on unilateral frictional ground: the Simpson step with contact impulses held over it.
//!
//! | letter | meaning |
//! |---|---|
//! | `φ`, `φ̂` | gap of a contact at the start; gap that would be left if its force brought the normal velocity to 0 by the end |
//! | `v_n0`, `v*` | normal velocity at the start; its target at the end |
//! | `λ` | impulses of the step; row `α` of the equations of motion gets `w_α G(q^α)ᵀ λ`, as a force held over the step |
//! | `y`, `W` | velocities of the contacts at the end, `y = G(q^s) M⁻¹ p_{k+1}`; their response `∂y/∂λ` ([`LoadResponse`]) |
//!
//! ```text
//! 1 candidates: φ + 2 Δt min(v_n0, 0) - 2 g Δt² < margin;  none -> the plain step
//! 2 φ̂ = φ + (Δt/2) v_n0;   v* = -φ̂/Δt for φ̂ >= 0 (landing without penetration or rebound), min(-β φ̂/Δt, v_rec) for φ̂ < 0
//! 3 λ := impulses of the last step (0 for contacts that were no candidates)
//! 4 Newton on the DEL equations with λ fixed
//! 5 y, W;  c = y - W λ - v* e_n;  the contact law ([`crate::contact_law`]) gives λ_new
//! 6 stop if |W (λ_new - λ)| <= 1e-7 (|W λ_new| + g Δt);  λ := λ_new;  go to 4 (at most 8 rounds)
//! ```
//!
//! Ground that gives, with spring `k` and damper `d` under a contact, pushes with `f = -k φ_end - d v`, `f >= 0`. With the gap at the end
//! taken as `φ̂ + Δt v` that is the same law with another target and a compliance on the normal's diagonal of `W`:
//!
//! ```text
//! v* = -k φ̂ / (k Δt + d)        W_nn += 1 / (Δt (k Δt + d))        λ_n = f Δt
//! ```
//!
//! Implicit in spring and damper, hence stable at any stiffness, and for `k -> ∞` the rigid law. (Half of `k Δt` acts as a damper.)
//!
//! The state `p` is the physical momentum at every boundary, rest is exact inside the step, and no contact mode is named beforehand.
//! Gains above `1/Δt` on `φ̂` would flip the sign of the gap in every step; above `v_rec` the correction throws the body off the ground.
//!
//! What is reused: the nodes of the last step (extrapolated); factors and `W` for up to 20 steps with the same candidates, unless an
//! impact happens or Newton's method contracts worse than 0.02; between rounds the nodes are moved by `X (λ_new - λ)`. None of it
//! changes the solution, which the iteration alone decides.
//!
//! Source: ours, measured against impulse-at-the-start formulations. The cone law on velocities is J. J. Moreau, *Unilateral
//! contact and dry friction in finite freedom dynamics*, 1988.

use delmpc_mechanics::del_residual::{DelWorkspace, ForceCapacity};
use delmpc_mechanics::errors::{ModelError, StepError};
use delmpc_mechanics::forces::{PointForce, StepForces};
use delmpc_mechanics::load_response::{BoundaryMotion, LoadPoint, LoadResponse};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::spatial::Wrench;
use delmpc_mechanics::state::State;
use delmpc_mechanics::tree::KinematicTree;
use nalgebra::{Matrix3, Vector3};

use crate::contact_law::{ContactLaw, ContactProblem, LawPath, LawReport, Regularisation};
use crate::dense::largest;
use crate::error::{PlantError, require_length};
use crate::step_newton::StepNewton;
use crate::terrain::Terrain;

mod check;
mod report;

use check::{check, check_friction};

pub use report::{ContactOptions, ContactPoint, ContactReport, ContactResult, GroundGive};

/// Reach of the candidate test, m.
const CANDIDATE_MARGIN: f64 = 1e-4;
/// Rounds of a step after which factors and `W` are computed again.
const ROUNDS_PER_RESPONSE: usize = 4;
/// Change of the velocities, relative, after which they are: an impact.
const LARGE_CHANGE: f64 = 0.2;
#[derive(Clone, Copy, Debug)]
struct Candidate {
    contact: usize,
    gap: f64,
    target: f64,
}

/// The integrator of a robot with contacts, with all its memory.
#[derive(Debug)]
pub struct ContactStep {
    options: ContactOptions,
    time_step: f64,
    gravity: f64,
    weight: f64,
    terrain: Terrain,
    contacts: Vec<ContactPoint>,
    points: Vec<LoadPoint>,
    results: Vec<ContactResult>,
    newton: StepNewton,
    response: LoadResponse,
    law: ContactLaw,
    start: BoundaryMotion,
    end: BoundaryMotion,
    next: State,
    has_previous: bool,
    /// Factorisation `W` was computed with.
    response_generation: u64,
    /// Contacts `W` was computed for; empty for none.
    response_of: Vec<usize>,
    candidates: Vec<Candidate>,
    loads: Vec<LoadPoint>,
    forces: Vec<PointForce>,
    response_w: Vec<f64>,
    response_c: Vec<f64>,
    /// `W` with the compliance of the ground.
    response_with_ground: Vec<f64>,
    free_velocity: Vec<f64>,
    end_velocity: Vec<f64>,
    friction: Vec<f64>,
    last_impulse: Vec<f64>,
    impulse: Vec<f64>,
    new_impulse: Vec<f64>,
    scratch: Vec<f64>,
}

impl ContactStep {
    /// For steps of `time_step` (s) of `tree` on `terrain`.
    ///
    /// # Errors
    /// [`PlantError`] for a number out of range, a contact on a body that does not exist, or a model the integrator refuses.
    pub fn new(
        tree: &KinematicTree,
        time_step: f64,
        contacts: &[ContactPoint],
        terrain: Terrain,
        options: ContactOptions,
    ) -> Result<Self, PlantError> {
        check(tree, contacts, &options)?;
        let rule = LobattoRule::new(options.unknown_nodes)?;
        let capacity = options.max_candidates.min(contacts.len()).max(1);
        let force_capacity = ForceCapacity { points: capacity + options.max_pushes, laws: false };
        let newton = StepNewton::new(tree, &rule, time_step, force_capacity)?;
        let points = contacts
            .iter()
            .map(|contact| LoadPoint {
                body: contact.body,
                point_b: contact.point - tree.bodies()[contact.body].inertia.com,
            })
            .collect();
        let n = 3 * capacity;
        Ok(Self {
            options,
            time_step,
            gravity: tree.gravity_w().norm(),
            weight: tree.gravity_w().norm() * tree.total_mass(),
            terrain,
            contacts: contacts.to_vec(),
            points,
            results: vec![ContactResult::default(); contacts.len()],
            response: LoadResponse::new(tree, &newton.del, &newton.solver, capacity),
            law: ContactLaw::new(capacity, options.regularisation)?,
            start: BoundaryMotion::new(tree),
            end: BoundaryMotion::new(tree),
            next: State::zeros(tree),
            has_previous: false,
            response_generation: 0,
            response_of: Vec::with_capacity(capacity),
            candidates: Vec::with_capacity(contacts.len()),
            loads: Vec::with_capacity(capacity),
            forces: Vec::with_capacity(capacity + options.max_pushes),
            response_w: vec![0.0; n * n],
            response_c: vec![0.0; n * n],
            response_with_ground: vec![0.0; n * n],
            free_velocity: vec![0.0; n],
            end_velocity: vec![0.0; n],
            friction: vec![0.0; capacity],
            last_impulse: vec![0.0; n],
            impulse: vec![0.0; n],
            new_impulse: vec![0.0; n],
            scratch: vec![0.0; n],
            newton,
        })
    }

    /// Advances `state` by one step. On an error the state is untouched. Allocates only inside Clarabel.
    ///
    /// `joint_forces` are held over the step, `pushes` are forces from outside.
    ///
    /// # Errors
    /// [`StepError`] of the integrator: not converged, singular, input not finite, spurious solution, wrong lengths.
    pub fn step(
        &mut self,
        tree: &KinematicTree,
        state: &mut State,
        joint_forces: &[f64],
        pushes: &[PointForce],
    ) -> Result<ContactReport, StepError> {
        let report = self.solve(tree, state, joint_forces, pushes)?;
        state.copy_from(&self.next);
        Ok(report)
    }

    /// Solves the step from `state` without advancing it: [`ContactStep::next_state`] and [`ContactStep::results`] hold the outcome.
    ///
    /// # Errors
    /// As [`ContactStep::step`].
    pub fn solve(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        joint_forces: &[f64],
        pushes: &[PointForce],
    ) -> Result<ContactReport, StepError> {
        if pushes.len() > self.options.max_pushes {
            let (got, expected) = (pushes.len(), self.options.max_pushes);
            return Err(ModelError::Length { quantity: "pushes", got, expected }.into());
        }
        let continues = self.has_previous && *state == self.next;
        self.has_previous = false;
        if continues {
            core::mem::swap(&mut self.start, &mut self.end);
        } else {
            self.start.update(tree, state)?;
        }
        self.roll_spheres(tree);
        self.find_candidates();
        self.load_impulses();
        self.set_forces(pushes);
        let forces = StepForces::held(joint_forces).with_points(&self.forces);
        self.newton.del.begin(tree, state, &forces)?;
        let mut report = ContactReport { candidates: self.candidates.len(), ..ContactReport::default() };
        self.newton.solve_first(tree, state, self.start.velocity(), continues)?;
        if self.candidates.is_empty() {
            report.rounds = 1;
            report.converged = true;
            self.finish_nodes(tree)?;
        } else {
            self.rounds(tree, pushes.len(), &mut report)?;
        }
        self.keep(tree);
        report.iterations = self.newton.iterations;
        report.factorizations = self.newton.factorizations;
        Ok(report)
    }

    /// Forgets the last step and all impulses: the next one starts from the velocity.
    pub fn forget(&mut self) {
        self.has_previous = false;
        self.response_of.clear();
        self.newton.forget();
        self.results.fill(ContactResult::default());
    }

    /// Sets the impulses (in {0}, N·s) that stand for those of the last step.
    ///
    /// # Errors
    /// [`PlantError::Shape`] unless there is one per contact.
    pub fn set_last_impulses(&mut self, impulses_w: &[Vector3<f64>]) -> Result<(), PlantError> {
        require_length("contact impulses", impulses_w.len(), self.contacts.len())?;
        for (result, impulse) in self.results.iter_mut().zip(impulses_w) {
            result.candidate = true;
            result.impulse_w = *impulse;
        }
        Ok(())
    }

    /// Changes the friction coefficient of a contact.
    ///
    /// # Errors
    /// [`PlantError`] for a negative coefficient or a contact that does not exist.
    pub fn set_friction(&mut self, contact: usize, friction: f64) -> Result<(), PlantError> {
        check_friction(friction)?;
        let expected = self.contacts.len();
        let point = self.contacts.get_mut(contact).ok_or(PlantError::Shape {
            quantity: "contact",
            got: contact,
            expected,
        })?;
        point.friction = friction;
        Ok(())
    }

    /// The contact points.
    pub fn contacts(&self) -> &[ContactPoint] {
        &self.contacts
    }

    /// The ground.
    pub fn terrain(&self) -> &Terrain {
        &self.terrain
    }

    /// Whether the ground does not give.
    pub fn ground_is_rigid(&self) -> bool {
        self.options.ground.is_rigid()
    }

    /// What happened at every contact in the last step.
    pub fn results(&self) -> &[ContactResult] {
        &self.results
    }

    /// State at the end of the last solved step.
    pub fn next_state(&self) -> &State {
        &self.next
    }

    /// Poses and velocities at the end of the last solved step.
    pub fn end_motion(&self) -> &BoundaryMotion {
        &self.end
    }

    /// The nodes of the last solved step.
    pub fn del(&self) -> &DelWorkspace {
        &self.newton.del
    }

    /// Time step, s.
    pub fn time_step(&self) -> f64 {
        self.time_step
    }

    /// `W` of the last step, row-major, contact frames, candidates only.
    pub fn response(&self) -> &[f64] {
        let n = 3 * self.candidates.len();
        &self.response_c[..n * n]
    }

    /// Contact index of every candidate of the last step, in the order of the rows of [`ContactStep::response`].
    pub fn candidates(&self) -> impl Iterator<Item = usize> + '_ {
        self.candidates.iter().map(|candidate| candidate.contact)
    }

    /// Wrench of the contacts with the given indices over the last step about the origin of {0}, N·m and N.
    pub fn wrench_w(&self, contacts: &[usize]) -> Wrench {
        let mut wrench = Wrench::default();
        for result in contacts.iter().filter_map(|&i| self.results.get(i)) {
            let force = result.impulse_w / self.time_step;
            wrench += Wrench::new(result.mean_point_w.cross(&force), force);
        }
        wrench
    }

    /// The points of spheres that touch.
    fn roll_spheres(&mut self, tree: &KinematicTree) {
        let down = -self.terrain.normal_w();
        for (point, contact) in self.points.iter_mut().zip(&self.contacts) {
            if contact.radius > 0.0 {
                let link = self.start.kinematics().link_poses_w()[contact.body].rotation;
                let lowest = contact.point + link.tr_mul(&down) * contact.radius;
                point.point_b = lowest - tree.bodies()[contact.body].inertia.com;
            }
        }
    }

    fn find_candidates(&mut self) {
        let (dt, g) = (self.time_step, self.gravity);
        let recovery = 0.5 * g * dt / self.options.correction;
        self.candidates.clear();
        for (contact, (point, result)) in self.points.iter().zip(&mut self.results).enumerate() {
            let x = self.start.point_w(point);
            result.start_w = x;
            let was_candidate = result.candidate;
            result.candidate = false;
            let Some(surface) = self.terrain.surface(&x) else {
                result.gap = f64::INFINITY;
                result.impulse_w = Vector3::zeros();
                continue;
            };
            let velocity = surface.frame * self.start.velocity_at_w(point.body, &x);
            if surface.frame != result.frame {
                self.response_of.clear();
            }
            (result.gap, result.frame) = (surface.gap, surface.frame);
            let reach = surface.gap + 2.0 * dt * velocity.z.min(0.0) - 2.0 * g * dt * dt;
            if !was_candidate || reach >= CANDIDATE_MARGIN {
                result.impulse_w = Vector3::zeros();
            }
            if reach < CANDIDATE_MARGIN {
                let left = surface.gap + 0.5 * dt * velocity.z;
                let target = if !self.options.ground.is_rigid() {
                    let GroundGive { stiffness, damping } = self.options.ground;
                    -stiffness * left / (stiffness * dt + damping)
                } else if left >= 0.0 {
                    -left / dt
                } else {
                    (-self.options.correction * left / dt).min(recovery)
                };
                result.candidate = true;
                self.candidates.push(Candidate { contact, gap: surface.gap, target });
            }
        }
        let capacity = self.friction.len();
        if self.candidates.len() > capacity {
            self.candidates.sort_unstable_by(|a, b| a.gap.total_cmp(&b.gap).then(a.contact.cmp(&b.contact)));
            for left_out in &self.candidates[capacity..] {
                self.results[left_out.contact].candidate = false;
                self.results[left_out.contact].impulse_w = Vector3::zeros();
            }
            self.candidates.truncate(capacity);
            self.candidates.sort_unstable_by_key(|candidate| candidate.contact);
        }
    }

    /// Impulses of the last step, in the contact frames, and friction of the candidates.
    fn load_impulses(&mut self) {
        self.loads.clear();
        for (i, candidate) in self.candidates.iter().enumerate() {
            let result = &self.results[candidate.contact];
            let impulse = result.frame * result.impulse_w;
            self.last_impulse[3 * i..3 * i + 3].copy_from_slice(impulse.as_slice());
            self.impulse[3 * i..3 * i + 3].copy_from_slice(impulse.as_slice());
            self.friction[i] = self.contacts[candidate.contact].friction;
            self.loads.push(self.points[candidate.contact]);
        }
    }

    fn impulse_w(&self, i: usize) -> Vector3<f64> {
        let frame = &self.results[self.candidates[i].contact].frame;
        frame.tr_mul(&Vector3::from_column_slice(&self.impulse[3 * i..3 * i + 3]))
    }

    fn set_forces(&mut self, pushes: &[PointForce]) {
        self.forces.clear();
        self.forces.extend_from_slice(pushes);
        for i in 0..self.candidates.len() {
            let LoadPoint { body, point_b } = self.loads[i];
            self.forces.push(PointForce { body, point_b, force_w: self.impulse_w(i) / self.time_step });
        }
    }

    fn rounds(
        &mut self,
        tree: &KinematicTree,
        pushes: usize,
        report: &mut ContactReport,
    ) -> Result<(), StepError> {
        let n = 3 * self.candidates.len();
        let mut rounds_left = ROUNDS_PER_RESPONSE;
        loop {
            self.finish_nodes(tree)?;
            report.rounds += 1;
            if !self.response_is_current() {
                self.update_response(tree)?;
            }
            let law = self.solve_law();
            match law.path {
                LawPath::Stick => report.stick_solves += 1,
                LawPath::Newton => report.newton_solves += 1,
                LawPath::Cone => {}
            }
            report.cone_solves += law.cone_solves;
            report.cone_iterations += law.cone_iterations;
            report.law_residual = law.residual;

            for k in 0..n {
                self.free_velocity[k] = self.new_impulse[k] - self.impulse[k];
            }
            let response = &self.response_c[..n * n];
            ContactLaw::apply(response, &self.free_velocity[..n], &mut self.scratch[..n]);
            report.velocity_change = largest(&self.scratch[..n]);
            ContactLaw::apply(response, &self.new_impulse[..n], &mut self.scratch[..n]);
            let scale = largest(&self.scratch[..n]) + self.gravity * self.time_step;
            let settled = report.velocity_change <= self.options.tolerance * scale;
            report.converged = settled && law.converged;
            if settled || report.rounds >= self.options.max_rounds {
                return Ok(());
            }
            self.move_to_new_impulses(tree, pushes)?;
            rounds_left -= 1;
            let keep = rounds_left > 0 && report.velocity_change <= LARGE_CHANGE * scale;
            if !keep {
                rounds_left = ROUNDS_PER_RESPONSE;
            }
            self.newton.iterate(tree, keep)?;
        }
    }

    fn response_is_current(&self) -> bool {
        let candidates = self.candidates.iter().map(|candidate| candidate.contact);
        self.response_generation == self.newton.generation && self.response_of.iter().copied().eq(candidates)
    }

    /// `W` in the contact frames.
    fn update_response(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        let m = self.candidates.len();
        let n = 3 * m;
        let s = self.options.unknown_nodes;
        self.response_of.clear();
        self.response.solve(tree, &self.newton.del, &mut self.newton.solver, &self.loads)?;
        let world = &mut self.response_w[..n * n];
        self.response.velocity_response_into(tree, &mut self.end, s, &self.loads, world)?;
        for i in 0..m {
            let own = &self.results[self.candidates[i].contact].frame;
            for j in 0..m {
                let other = &self.results[self.candidates[j].contact].frame;
                let block = Matrix3::from_fn(|r, c| world[(3 * i + r) * n + 3 * j + c]);
                let turned = own * block * other.transpose();
                for r in 0..3 {
                    for c in 0..3 {
                        self.response_c[(3 * i + r) * n + 3 * j + c] = turned[(r, c)];
                    }
                }
            }
        }
        self.response_generation = self.newton.generation;
        self.response_of.extend(self.candidates.iter().map(|candidate| candidate.contact));
        Ok(())
    }

    fn solve_law(&mut self) -> LawReport {
        let n = 3 * self.candidates.len();
        for (i, candidate) in self.candidates.iter().enumerate() {
            let point = &self.points[candidate.contact];
            let x = self.end.point_w(point);
            let frame = &self.results[candidate.contact].frame;
            let velocity = frame * self.end.velocity_at_w(point.body, &x);
            self.end_velocity[3 * i..3 * i + 3].copy_from_slice(velocity.as_slice());
        }
        let response = &self.response_c[..n * n];
        ContactLaw::apply(response, &self.impulse[..n], &mut self.scratch[..n]);
        for k in 0..n {
            self.free_velocity[k] = self.end_velocity[k] - self.scratch[k];
        }
        for (i, candidate) in self.candidates.iter().enumerate() {
            self.free_velocity[3 * i + 2] -= candidate.target;
        }
        let GroundGive { stiffness, damping } = self.options.ground;
        let response = if self.options.ground.is_rigid() {
            response
        } else {
            let with_ground = &mut self.response_with_ground[..n * n];
            with_ground.copy_from_slice(response);
            for k in (2..n).step_by(3) {
                with_ground[k * n + k] += 1.0 / (self.time_step * (stiffness * self.time_step + damping));
            }
            with_ground
        };
        let problem = ContactProblem {
            response,
            free_velocity: &self.free_velocity[..n],
            friction: &self.friction[..n / 3],
            last_impulse: &self.last_impulse[..n],
        };
        self.new_impulse[..n].copy_from_slice(&self.impulse[..n]);
        self.law.solve(&problem, &mut self.new_impulse[..n])
    }

    /// `λ := λ_new`, and the nodes where the response puts them.
    fn move_to_new_impulses(&mut self, tree: &KinematicTree, pushes: usize) -> Result<(), StepError> {
        let m = self.candidates.len();
        for i in 0..m {
            let before = self.impulse_w(i);
            self.impulse[3 * i..3 * i + 3].copy_from_slice(&self.new_impulse[3 * i..3 * i + 3]);
            let after = self.impulse_w(i);
            self.scratch[3 * i..3 * i + 3].copy_from_slice((after - before).as_slice());
            self.newton.del.set_point_force(pushes + i, &(after / self.time_step))?;
        }
        let s = self.options.unknown_nodes;
        if let Some(nodes) = self.response.nodes() {
            for dof in 0..tree.dof() {
                for alpha in 1..=s {
                    let row = dof * s + alpha - 1;
                    let change: f64 = (0..3 * m).map(|c| nodes.get(row, c) * self.scratch[c]).sum();
                    self.newton.del.move_node(alpha, dof, change);
                }
            }
        }
        Ok(())
    }

    /// The state and the motion at the end of the step, from the nodes.
    fn finish_nodes(&mut self, tree: &KinematicTree) -> Result<(), StepError> {
        self.newton.del.next_state_into(tree, &mut self.next);
        self.end.update(tree, &self.next)
    }

    /// Stores nodes and impulses for the next step, and what happened at the contacts.
    fn keep(&mut self, tree: &KinematicTree) {
        let count = self.options.unknown_nodes + 1;
        self.newton.keep_nodes(tree);
        self.has_previous = true;
        for (point, result) in self.points.iter().zip(&mut self.results) {
            result.end_w = self.end.point_w(point);
            result.velocity_w = self.end.velocity_at_w(point.body, &result.end_w);
            result.normal_impulse = 0.0;
            result.touching = false;
            result.mean_point_w = Vector3::zeros();
            for alpha in 0..count {
                let weight = self.newton.del.rule().weights()[alpha];
                let pose = self.newton.del.body_pose(point.body, alpha);
                result.mean_point_w += pose.transform_point(&point.point_b) * weight;
            }
        }
        let load_limit = 1e-6 * self.weight * self.time_step;
        for i in 0..self.candidates.len() {
            let impulse = self.impulse_w(i);
            let result = &mut self.results[self.candidates[i].contact];
            result.impulse_w = impulse;
            result.normal_impulse = self.impulse[3 * i + 2];
            result.touching = result.normal_impulse > load_limit;
        }
    }
}
