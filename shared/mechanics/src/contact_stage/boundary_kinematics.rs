//! Everything a controller asks about a floating robot at a stage boundary: contacts, points, mass centre, momenta, inertia.
//!
//! Rows are functionals on twists of {0}, that is wrenches `W`: the entry of the base is `Ad_gᵀ W`, that of joint i `S_iᵀ W`. A row on the
//! velocities `(V_body, q̇)` is at the same time the derivative of a place by `(ε, δq)`.
//!
//! ```text
//! y_row = W·v_b           ∂y_row/∂ε = Ad_gᵀ W'        ∂y_row/∂q_j = Ṡ_jᵀ W + S_jᵀ W'        W' = (ẋ×t; 0), a rotation row (ω×t; 0)
//! ```

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Vector3, Vector6};

use super::boundary_state::BoundaryState;
use super::contact::{Contact, Placement};
use crate::errors::{ModelError, StepError};
use crate::kinematics::{Configuration, Kinematics, Velocity, check_body, check_length};
use crate::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::spatial::{RigidTransform, SpatialInertia, Twist, Wrench};
use crate::state::State;
use crate::tree::{KinematicTree, NO_PARENT};

/// Kinematics and inertia at one boundary state. Allocates in [`BoundaryKinematics::new`] only.
///
/// Vectors of velocities and rows of Jacobians have `nv = 6 + joints` entries: `V_body` (angular first), then joint rates.
#[derive(Clone, Debug)]
pub struct BoundaryKinematics {
    kinematics: Kinematics,
    composites: MassMatrixWorkspace,
    /// Not a number before the first evaluation and after a failed one.
    pose: RigidTransform,
    q: Vec<f64>,
    velocity: Vec<f64>,
    /// On spatial base twists, then on `(V_body, q̇)`.
    mass_w: Vec<f64>,
    mass_b: Vec<f64>,
    factor: MassMatrixFactor,
    /// Articulated momenta.
    momenta_w: Vec<Wrench>,
    /// `Ṡ_i`.
    twist_rates_w: Vec<Twist>,
    momentum_gradient: Vec<f64>,
}

impl BoundaryKinematics {
    /// Room for a floating tree.
    ///
    /// # Errors
    /// [`ModelError::Unsupported`] for a fixed base.
    pub fn new(tree: &KinematicTree) -> Result<Self, ModelError> {
        check_floating(tree)?;
        let nv = tree.dof();
        Ok(Self {
            kinematics: Kinematics::new(tree),
            composites: MassMatrixWorkspace::new(tree),
            pose: nowhere(),
            q: vec![0.0; tree.joint_count()],
            velocity: vec![0.0; nv],
            mass_w: vec![0.0; nv * nv],
            mass_b: vec![0.0; nv * nv],
            factor: MassMatrixFactor::new(tree),
            momenta_w: vec![Wrench::default(); tree.body_count()],
            twist_rates_w: vec![Twist::default(); tree.body_count()],
            momentum_gradient: vec![0.0; nv * tree.joint_count()],
        })
    }

    /// Poses, velocities, momenta, mass matrix and its factor at `state`. O(Σ depth²), no allocation.
    ///
    /// # Errors
    /// [`ModelError::Length`] when the state does not fit the tree; [`StepError::NonFinite`]; [`StepError::Singular`] for a singular
    /// mass matrix.
    pub fn update(&mut self, tree: &KinematicTree, state: &BoundaryState) -> Result<(), StepError> {
        check_length("joint coordinates q", state.q.len(), tree.joint_count())?;
        check_length("joint rates", state.rate.len(), tree.joint_count())?;
        let parts: [(&'static str, &[f64]); 5] = [
            ("base orientation", state.orientation.as_slice()),
            ("base position", state.position_w.as_slice()),
            ("joint coordinate", &state.q),
            ("base velocity", state.base_velocity_b.as_slice()),
            ("joint rate", &state.rate),
        ];
        for (quantity, values) in parts {
            if let Some(index) = values.iter().position(|x| !x.is_finite()) {
                return Err(StepError::NonFinite { quantity, index });
            }
        }
        self.pose = nowhere();
        let pose = state.base_pose_w();
        self.q.copy_from_slice(&state.q);
        self.velocity[..6].copy_from_slice(state.base_velocity_b.as_slice());
        self.velocity[6..].copy_from_slice(&state.rate);
        self.kinematics.update_positions(tree, &Configuration::floating(pose, &state.q))?;
        let twist = state.base_twist_w();
        self.kinematics.update_velocities(tree, &Velocity::floating(twist, &state.rate))?;
        mass_matrix_into(tree, &self.kinematics, &mut self.composites, &mut self.mass_w)?;
        self.mass_matrix_in_base_axes(&pose);
        self.factor.factorise(&self.mass_b)?;
        self.pose = pose;
        self.update_momenta(tree);
        self.update_momentum_gradient(tree);
        Ok(())
    }

    /// `diag(Ad_g, 1)ᵀ 𝓜 diag(Ad_g, 1)`.
    fn mass_matrix_in_base_axes(&mut self, pose: &RigidTransform) {
        let nv = self.velocity.len();
        self.mass_b.copy_from_slice(&self.mass_w);
        let adjoint = pose.adjoint();
        let base = nalgebra::Matrix6::from_fn(|r, c| self.mass_w[r * nv + c]);
        let base = adjoint.tr_mul(&(base * adjoint));
        for r in 0..6 {
            for c in 0..6 {
                self.mass_b[r * nv + c] = base[(r.max(c), r.min(c))];
            }
        }
        for j in 6..nv {
            let column = Vector6::from_fn(|r, _| self.mass_w[r * nv + j]);
            let column = pose.inverse_transform_wrench(&Wrench::from_vector(&column)).to_vector();
            for r in 0..6 {
                self.mass_b[r * nv + j] = column[r];
                self.mass_b[j * nv + r] = column[r];
            }
        }
    }

    fn update_momenta(&mut self, tree: &KinematicTree) {
        for i in 0..tree.body_count() {
            let inertia: SpatialInertia = self.kinematics.inertia_w(tree, i);
            self.momenta_w[i] = inertia.mul_twist(&self.kinematics.velocities_w()[i]);
        }
        for i in (1..tree.body_count()).rev() {
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let carried = self.momenta_w[i];
                self.momenta_w[parent] += carried;
            }
        }
    }

    /// Whether the last [`BoundaryKinematics::update`] was at this state.
    pub fn is_at(&self, state: &BoundaryState) -> bool {
        self.pose == state.base_pose_w()
            && self.q == state.q
            && self.velocity[..6] == *state.base_velocity_b.as_slice()
            && self.velocity[6..] == state.rate
    }

    /// Poses and velocities of the bodies.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Pose of the base in {0}: link axes, origin at its mass centre.
    pub fn base_pose_w(&self) -> &RigidTransform {
        &self.pose
    }

    /// `(V_body, q̇)`.
    pub fn velocity(&self) -> &[f64] {
        &self.velocity
    }

    /// Mass matrix on `(V_body, q̇)`, row-major `nv x nv`.
    pub fn mass_matrix(&self) -> &[f64] {
        &self.mass_b
    }

    /// Its branch-sparse factor.
    pub fn factor(&self) -> &MassMatrixFactor {
        &self.factor
    }

    /// Total spatial momentum `P` in {0} about its origin.
    pub fn momentum_w(&self) -> Wrench {
        self.momenta_w[0]
    }

    /// Momentum about the mass centre of the robot in {0}: angular, linear.
    pub fn centroidal_momentum_w(&self, tree: &KinematicTree) -> Wrench {
        let total = self.momenta_w[0];
        let centre = self.kinematics.mass_centre_of_tree_w(tree);
        Wrench::new(total.torque - centre.cross(&total.force), total.force)
    }

    /// Centroidal momentum map, `6 x nv` row-major: the momentum of [`BoundaryKinematics::centroidal_momentum_w`] per velocity.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a wrong slice.
    pub fn centroidal_map_into(&self, tree: &KinematicTree, out: &mut [f64]) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_length("centroidal momentum map", out.len(), 6 * nv)?;
        let centre = self.kinematics.mass_centre_of_tree_w(tree);
        let frame = RigidTransform::from_translation(centre);
        for column in 0..nv {
            let momentum = if column < 6 {
                let twist = self.pose.transform_twist(&Twist::from_vector(&Vector6::ith(column, 1.0)));
                self.composites.composite_inertias_w()[0].mul_twist(&twist)
            } else {
                let body = column - 5;
                let twist = &self.kinematics.joint_twists_w()[body];
                self.composites.composite_inertias_w()[body].mul_twist(twist)
            };
            let momentum = frame.inverse_transform_wrench(&momentum).to_vector();
            for row in 0..6 {
                out[row * nv + column] = momentum[row];
            }
        }
        Ok(())
    }

    /// The state `(pose, q, P, p_j)` of the integrator.
    ///
    /// # Errors
    /// [`ModelError::Length`] when `out` is of another tree.
    pub fn state_into(&self, out: &mut State) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_length("joint coordinates of the state", out.q.len(), nv - 6)?;
        check_length("momenta of the state", out.p.len(), nv)?;
        out.base_pose = self.pose;
        out.q.copy_from_slice(&self.q);
        out.p[..6].copy_from_slice(self.momenta_w[0].to_vector().as_slice());
        for joint in 0..nv - 6 {
            let body = joint + 1;
            out.p[6 + joint] = self.joint_momentum(body);
        }
        Ok(())
    }

    /// `p_j` of the joint of `body`.
    pub(crate) fn joint_momentum(&self, body: usize) -> f64 {
        self.momenta_w[body].dot(&self.kinematics.joint_twists_w()[body])
    }

    /// Row of the functional `wrench_w` on the twist of `body`: `nv` entries.
    pub(crate) fn row_into(&self, tree: &KinematicTree, body: usize, wrench_w: &Wrench, out: &mut [f64]) {
        out.fill(0.0);
        let base = self.pose.inverse_transform_wrench(wrench_w).to_vector();
        out[..6].copy_from_slice(base.as_slice());
        for &dof in &tree.branch(body)[6..] {
            let dof = dof as usize;
            out[dof] = wrench_w.dot(&self.kinematics.joint_twists_w()[dof - 5]);
        }
    }

    /// Where a contact is.
    pub fn placement(&self, tree: &KinematicTree, contact: &Contact) -> Placement {
        Placement::at(tree, contact, &self.kinematics.mass_centre_pose_w(contact.body))
    }

    /// `y = G v` and the rows `G` on `(V_body, q̇)`, `m x nv`, of one contact.
    ///
    /// # Errors
    /// [`ModelError`] for wrong lengths or a body that does not exist.
    pub fn contact_rows_into(
        &self,
        tree: &KinematicTree,
        contact: &Contact,
        y: &mut [f64],
        g: &mut [f64],
    ) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_body(tree, contact.body)?;
        check_length("contact velocities", y.len(), contact.row_count())?;
        check_length("contact rows", g.len(), contact.row_count() * nv)?;
        let placement = self.placement(tree, contact);
        let velocity = &self.kinematics.velocities_w()[contact.body];
        for ((row, y), g) in contact.kept().zip(y).zip(g.chunks_exact_mut(nv)) {
            let wrench = placement.force_row(contact, row);
            *y = wrench.dot(velocity);
            self.row_into(tree, contact.body, &wrench, g);
        }
        Ok(())
    }

    /// `∂y/∂(ε, q)` of one contact at fixed `(V_body, q̇)`, `m x nv`. With `G` it makes up `Y`: `δy = [∂y/∂(ε, q), G] x`.
    ///
    /// # Errors
    /// [`ModelError`] for wrong lengths or a body that does not exist.
    pub fn contact_velocity_gradient_into(
        &self,
        tree: &KinematicTree,
        contact: &Contact,
        out: &mut [f64],
    ) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_body(tree, contact.body)?;
        check_length("contact velocity gradient", out.len(), contact.row_count() * nv)?;
        let placement = self.placement(tree, contact);
        let velocity = &self.kinematics.velocities_w()[contact.body];
        for (row, out) in contact.kept().zip(out.chunks_exact_mut(nv)) {
            let wrench = placement.force_row(contact, row);
            let transport = placement.transport_row(contact, row, velocity);
            self.row_into(tree, contact.body, &transport, out);
            for &dof in &tree.branch(contact.body)[6..] {
                let dof = dof as usize;
                out[dof] += wrench.dot(&self.twist_rates_w[dof - 5]);
            }
        }
        Ok(())
    }

    /// Velocity in {0} of a point of `body` (link frame, m) per `(V_body, q̇)`; also its displacement per `(ε, δq)`. `3 x nv`.
    ///
    /// # Errors
    /// [`ModelError`] for a wrong length or a body that does not exist.
    pub fn point_jacobian_into(
        &self,
        tree: &KinematicTree,
        body: usize,
        point_l: &Vector3<f64>,
        out: &mut [f64],
    ) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_body(tree, body)?;
        check_length("point jacobian", out.len(), 3 * nv)?;
        let x = self.kinematics.point_w(body, point_l);
        for (k, out) in out.chunks_exact_mut(nv).enumerate() {
            let axis = Vector3::ith(k, 1.0);
            self.row_into(tree, body, &Wrench::new(x.cross(&axis), axis), out);
        }
        Ok(())
    }

    /// Angular velocity in {0} of `body` per `(V_body, q̇)`; also its turn per `(ε, δq)`. `3 x nv`.
    ///
    /// # Errors
    /// [`ModelError`] for a wrong length or a body that does not exist.
    pub fn turn_jacobian_into(
        &self,
        tree: &KinematicTree,
        body: usize,
        out: &mut [f64],
    ) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_body(tree, body)?;
        check_length("turn jacobian", out.len(), 3 * nv)?;
        for (k, out) in out.chunks_exact_mut(nv).enumerate() {
            self.row_into(tree, body, &Wrench::new(Vector3::ith(k, 1.0), Vector3::zeros()), out);
        }
        Ok(())
    }

    /// Mass centre of the robot in {0}, m.
    pub fn mass_centre_w(&self, tree: &KinematicTree) -> Vector3<f64> {
        self.kinematics.mass_centre_of_tree_w(tree)
    }

    /// Velocity in {0} of the mass centre per `(V_body, q̇)`; also its displacement per `(ε, δq)`. `3 x nv`.
    ///
    /// # Errors
    /// [`ModelError::Length`] for a wrong slice.
    pub fn mass_centre_jacobian_into(&self, tree: &KinematicTree, out: &mut [f64]) -> Result<(), ModelError> {
        let nv = self.velocity.len();
        check_length("mass centre jacobian", out.len(), 3 * nv)?;
        let total = tree.total_mass();
        for column in 0..nv {
            // The linear momentum of what the coordinate carries.
            let momentum = if column < 6 {
                let twist = self.pose.transform_twist(&Twist::from_vector(&Vector6::ith(column, 1.0)));
                self.composites.composite_inertias_w()[0].mul_twist(&twist)
            } else {
                let body = column - 5;
                let twist = &self.kinematics.joint_twists_w()[body];
                self.composites.composite_inertias_w()[body].mul_twist(twist)
            };
            for row in 0..3 {
                out[row * nv + column] = momentum.force[row] / total;
            }
        }
        Ok(())
    }

    /// Joint torques that hold the posture at rest under contact forces `force` (N, N·m; rows of `contacts`, one after the other), and
    /// the wrench on the base that remains (base axes, at its mass centre): zero when the forces balance the weight.
    ///
    /// # Errors
    /// [`ModelError`] for wrong lengths or a body that does not exist.
    pub fn static_torques_into(
        &self,
        tree: &KinematicTree,
        contacts: &[Contact],
        force: &[f64],
        torques: &mut [f64],
    ) -> Result<Wrench, ModelError> {
        check_length("joint torques", torques.len(), tree.joint_count())?;
        check_length("contact forces", force.len(), contacts.iter().map(Contact::row_count).sum())?;
        let composite = self.composites.composite_inertias_w();
        let gravity = tree.gravity_w();
        for (joint, torque) in torques.iter_mut().enumerate() {
            let (body, constants) = (joint + 1, &tree.constants()[joint + 1]);
            let inertia = &composite[body];
            let weight = Wrench::new(inertia.first_moment.cross(gravity), gravity * inertia.mass);
            let spring = constants.stiffness * (self.q[joint] - constants.rest);
            *torque = spring - weight.dot(&self.kinematics.joint_twists_w()[body]);
        }
        let mut total = Wrench::new(composite[0].first_moment.cross(gravity), gravity * composite[0].mass);
        let mut forces = force.iter();
        for contact in contacts {
            check_body(tree, contact.body)?;
            let placement = self.placement(tree, contact);
            let mut wrench = Wrench::default();
            for row in contact.kept() {
                let value = forces.next().copied().unwrap_or(0.0);
                wrench += placement.force_row(contact, row) * value;
            }
            for &dof in &tree.branch(contact.body)[6..] {
                let body = dof as usize - 5;
                torques[body - 1] -= wrench.dot(&self.kinematics.joint_twists_w()[body]);
            }
            total += wrench;
        }
        Ok(self.pose.inverse_transform_wrench(&total))
    }

    /// Derivatives of the momenta by the joint coordinates at fixed `(V_body, q̇)`, `nv x joints` row-major: rows of `P` in base axes
    /// about its mass centre, and of `p_j`. By `ε` the momenta in base axes do not change.
    pub fn momentum_gradient(&self) -> &[f64] {
        &self.momentum_gradient
    }

    fn update_momentum_gradient(&mut self, tree: &KinematicTree) {
        let joints = tree.joint_count();
        let out = &mut self.momentum_gradient;
        out.fill(0.0);
        let twists = self.kinematics.joint_twists_w();
        let composite = self.composites.composite_inertias_w();
        for i in 1..tree.body_count() {
            let twist = &twists[i];
            self.twist_rates_w[i] = self.kinematics.velocities_w()[i].bracket(twist);
            let own = composite[i].mul_twist(twist);
            let moved =
                composite[i].mul_twist(&self.twist_rates_w[i]) - self.momenta_w[i].dual_bracket(twist);
            let on_base = self.pose.inverse_transform_wrench(&moved).to_vector();
            for r in 0..6 {
                out[r * joints + i - 1] = on_base[r];
            }
            for &dof in &tree.branch(i)[6..] {
                let j = dof as usize - 5;
                out[dof as usize * joints + i - 1] = moved.dot(&twists[j]);
                out[(i + 5) * joints + j - 1] = own.dot(&self.twist_rates_w[j]);
            }
        }
    }
}

/// Equal to no pose.
fn nowhere() -> RigidTransform {
    RigidTransform::from_translation(Vector3::repeat(f64::NAN))
}

pub(crate) fn check_floating(tree: &KinematicTree) -> Result<(), ModelError> {
    if tree.is_floating() {
        return Ok(());
    }
    Err(ModelError::Unsupported { body: 0, reason: "a stage with contacts needs a floating base" })
}
