//! Velocities and mass matrix at one end of a step.
//!
//! Letters and equations: [`super`].

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Vector3, Vector6};

use super::LoadPoint;
use crate::errors::{ModelError, StepError};
use crate::kinematics::{Configuration, Kinematics, Velocity};
use crate::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::spatial::{SpatialInertia, Twist, Wrench};
use crate::state::State;
use crate::tree::{KinematicTree, NO_PARENT};

/// Poses and velocities at a step boundary, from the state alone: `v = M(q)⁻¹ p`.
#[derive(Clone, Debug)]
pub struct BoundaryMotion {
    pub(super) kinematics: Kinematics,
    pub(super) composites: MassMatrixWorkspace,
    pub(super) mass_matrix: Vec<f64>,
    pub(super) factor: MassMatrixFactor,
    pub(super) velocity: Vec<f64>,
    pub(super) inertias_w: Vec<SpatialInertia>,
    pub(super) momenta_w: Vec<Wrench>,
}

impl BoundaryMotion {
    /// Room for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        Self {
            kinematics: Kinematics::new(tree),
            composites: MassMatrixWorkspace::new(tree),
            mass_matrix: vec![0.0; tree.dof() * tree.dof()],
            factor: MassMatrixFactor::new(tree),
            velocity: vec![0.0; tree.dof()],
            inertias_w: vec![SpatialInertia::default(); tree.body_count()],
            momenta_w: vec![Wrench::default(); tree.body_count()],
        }
    }

    /// Poses, mass matrix, its factor, and the velocity of `state`. O(Σ depth²), no allocation.
    ///
    /// # Errors
    /// When the state does not fit the tree or the mass matrix is singular.
    pub fn update(&mut self, tree: &KinematicTree, state: &State) -> Result<(), StepError> {
        self.kinematics.update_positions(tree, &Configuration::of(state))?;
        mass_matrix_into(tree, &self.kinematics, &mut self.composites, &mut self.mass_matrix)?;
        self.factor.factorise(&self.mass_matrix)?;
        if state.p.len() != self.velocity.len() {
            let (got, expected) = (state.p.len(), self.velocity.len());
            return Err(ModelError::Length { quantity: "momenta p", got, expected }.into());
        }
        self.velocity.copy_from_slice(&state.p);
        self.factor.solve_in_place(&mut self.velocity)?;
        let (base, joints) = self.velocity.split_at(tree.base_dof());
        let rates = if base.is_empty() {
            Velocity::fixed(joints)
        } else {
            Velocity::floating(Twist::from_vector(&Vector6::from_column_slice(base)), joints)
        };
        self.kinematics.update_velocities(tree, &rates)?;
        Ok(())
    }

    /// Poses and velocities of the bodies.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Generalised velocity; a floating base starts with its spatial twist in {0} (angular, linear).
    pub fn velocity(&self) -> &[f64] {
        &self.velocity
    }

    /// Mass matrix, row-major.
    pub fn mass_matrix(&self) -> &[f64] {
        &self.mass_matrix
    }

    /// Its factor.
    pub fn factor(&self) -> &MassMatrixFactor {
        &self.factor
    }

    /// Where a point is, in {0}, m.
    pub fn point_w(&self, point: &LoadPoint) -> Vector3<f64> {
        self.kinematics.mass_centre_pose_w(point.body).transform_point(&point.point_b)
    }

    /// Velocity of the body at the place `x_w`, in {0}, m/s.
    pub fn velocity_at_w(&self, body: usize, x_w: &Vector3<f64>) -> Vector3<f64> {
        let twist = &self.kinematics.velocities_w()[body];
        twist.linear + twist.angular.cross(x_w)
    }

    /// Inertias and articulated momenta of all bodies.
    pub(super) fn update_momenta(&mut self, tree: &KinematicTree) {
        for i in 0..tree.body_count() {
            self.inertias_w[i] = self.kinematics.inertia_w(tree, i);
            self.momenta_w[i] = self.inertias_w[i].mul_twist(&self.kinematics.velocities_w()[i]);
        }
        for i in (tree.first_joint_body()..tree.body_count()).rev() {
            let parent = tree.constants()[i].parent;
            if parent != NO_PARENT {
                let carried = self.momenta_w[i];
                self.momenta_w[parent] += carried;
            }
        }
    }
}
