//! From the state `(q, p)` to velocities and back: `p = M(q) q̇` at step boundaries.
//!
//! At a step boundary this relation holds to the order of the integrator (2s). The rates of the interpolation polynomial at
//! the boundary nodes do **not**: they have order s only and jump between steps. Sensors, logs and controllers use this file.

use alloc::vec;
use alloc::vec::Vec;

use crate::energy::{generalised_momentum_into, kinetic_energy, potential_energy};
use crate::errors::StepError;
use crate::kinematics::{Configuration, Kinematics, Velocity, check_length};
use crate::mass_matrix::{MassMatrixWorkspace, mass_matrix_into};
use crate::mass_matrix_factor::MassMatrixFactor;
use crate::spatial::Twist;
use crate::state::State;
use crate::tree::KinematicTree;

/// Workspace: kinematics, mass matrix and its factor at one configuration.
#[derive(Clone, Debug)]
pub struct VelocityWorkspace {
    kinematics: Kinematics,
    composites: MassMatrixWorkspace,
    mass_matrix: Vec<f64>,
    factor: MassMatrixFactor,
}

impl VelocityWorkspace {
    /// Room for `tree`.
    pub fn new(tree: &KinematicTree) -> Self {
        Self {
            kinematics: Kinematics::new(tree),
            composites: MassMatrixWorkspace::new(tree),
            mass_matrix: vec![0.0; tree.dof() * tree.dof()],
            factor: MassMatrixFactor::new(tree),
        }
    }

    /// Generalised velocity `M(q)⁻¹ p` of a state, one entry per coordinate; a floating base starts with its spatial twist in
    /// {0} (angular, linear). O(Σ depth²).
    ///
    /// # Errors
    /// When the state does not fit the tree or the mass matrix is singular.
    pub fn velocity_into(
        &mut self,
        tree: &KinematicTree,
        state: &State,
        velocity: &mut [f64],
    ) -> Result<(), StepError> {
        check_length("velocity", velocity.len(), tree.dof())?;
        check_length("momenta p", state.p.len(), tree.dof())?;
        self.factor_at(tree, state)?;
        velocity.copy_from_slice(&state.p);
        self.factor.solve_in_place(velocity)?;
        Ok(())
    }

    /// Sets the momenta of a state from a generalised velocity (layout as above). O(n).
    ///
    /// # Errors
    /// When state or velocity do not fit the tree.
    pub fn set_velocity(
        &mut self,
        tree: &KinematicTree,
        state: &mut State,
        velocity: &[f64],
    ) -> Result<(), StepError> {
        self.kinematics.update(tree, &Configuration::of(state), &split(tree, velocity))?;
        generalised_momentum_into(tree, &self.kinematics, &mut state.p)?;
        Ok(())
    }

    /// Kinetic and potential energy of a state, J (springs included). Allocates one vector: for tests and logs.
    ///
    /// # Errors
    /// When the state does not fit the tree or the mass matrix is singular.
    pub fn energy(&mut self, tree: &KinematicTree, state: &State) -> Result<(f64, f64), StepError> {
        let mut velocity = vec![0.0; tree.dof()];
        self.velocity_into(tree, state, &mut velocity)?;
        self.kinematics.update(tree, &Configuration::of(state), &split(tree, &velocity))?;
        let potential = potential_energy(tree, &self.kinematics, &state.q)?;
        Ok((kinetic_energy(tree, &self.kinematics), potential))
    }

    /// Mass matrix (row-major, coordinates squared) and its factor at the configuration of `state`.
    ///
    /// # Errors
    /// As [`VelocityWorkspace::velocity_into`].
    pub fn factor_at(&mut self, tree: &KinematicTree, state: &State) -> Result<(), StepError> {
        self.kinematics.update_positions(tree, &Configuration::of(state))?;
        mass_matrix_into(tree, &self.kinematics, &mut self.composites, &mut self.mass_matrix)?;
        self.factor.factorise(&self.mass_matrix)
    }

    /// The mass matrix last factorised.
    pub fn mass_matrix(&self) -> &[f64] {
        &self.mass_matrix
    }

    /// Its factor.
    pub fn factor(&self) -> &MassMatrixFactor {
        &self.factor
    }

    /// Kinematics last computed.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }
}

/// A generalised velocity vector as base twist and joint rates.
fn split<'a>(tree: &KinematicTree, velocity: &'a [f64]) -> Velocity<'a> {
    if tree.is_floating() && velocity.len() >= 6 {
        let (base, joints) = velocity.split_at(6);
        let twist = Twist::from_vector(&nalgebra::Vector6::from_column_slice(base));
        Velocity::floating(twist, joints)
    } else {
        Velocity::fixed(velocity)
    }
}
