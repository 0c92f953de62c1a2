//! Articulated-body algorithm: `q̈ = M⁻¹ (τ - h)` in O(n), and products with `M⁻¹` alone.
//!
//! | letter | meaning |
//! |---|---|
//! | `I^A`, `p^A` | articulated inertia and bias wrench |
//! | `U = I^A S`, `d = Sᵀ U` | |
//! | `c = ad_v S q̇` | velocity product |
//!
//! ```text
//! outward  v_i = v_par + S_i q̇_i,  c_i = ad_{v_i} S_i q̇_i,  p_i = v_i ×* I_i v_i - m g
//! inward   u_i = τ_i - S_iᵀ p^A_i,  I^A_par += I^A_i - U Uᵀ/d,  p^A_par += p^A_i + (I^A_i - U Uᵀ/d) c_i + U u_i/d
//! outward  q̈_i = (u_i - Uᵀ (a_par + c_i))/d,  a_i = a_par + c_i + S_i q̈_i
//! ```
//!
//! Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, Springer 2008, section 7.3, in frame {0}: articulated inertias are
//! added without transformation. About 250 multiply-adds per body; the passes run with the widest instructions of the processor.

use delmpc_mechanics::prelude::KinematicTree;

use crate::rigid_bodies::{
    Inertia, M6, Pose, RigidBodies, RivalError, V6, add6, array, axpy6, bracket, cross, cross_wrench, dot6,
    symmetric_times, vectorized,
};

/// Workspace for one tree.
#[derive(Clone, Debug)]
pub struct ArticulatedBody {
    bodies: RigidBodies,
    arch: pulp::Arch,
    poses: Vec<Pose>,
    velocities: Vec<V6>,
    /// `c`.
    products: Vec<V6>,
    inertias: Vec<M6>,
    biases: Vec<V6>,
    /// `U`, `1/d`, `u`.
    columns: Vec<V6>,
    inverse: Vec<f64>,
    forces: Vec<f64>,
    accelerations: Vec<V6>,
}

impl ArticulatedBody {
    /// For a tree of revolute joints.
    ///
    /// # Errors
    /// [`RivalError::Unsupported`].
    pub fn new(tree: &KinematicTree) -> Result<Self, RivalError> {
        let bodies = RigidBodies::new(tree)?;
        let n = bodies.dof();
        Ok(Self {
            bodies,
            arch: pulp::Arch::new(),
            poses: vec![Pose::default(); n],
            velocities: vec![[0.0; 6]; n],
            products: vec![[0.0; 6]; n],
            inertias: vec![[[0.0; 8]; 6]; n],
            biases: vec![[0.0; 6]; n],
            columns: vec![[0.0; 6]; n],
            inverse: vec![0.0; n],
            forces: vec![0.0; n],
            accelerations: vec![[0.0; 6]; n],
        })
    }

    /// Number of joints.
    pub fn dof(&self) -> usize {
        self.bodies.dof()
    }

    /// `q̈` without joint torques. O(n), no allocation.
    pub fn acceleration_into(&mut self, q: &[f64], v: &[f64], out: &mut [f64]) {
        vectorized!(self.arch, (), (
            work: &'a mut ArticulatedBody = self, q: &'a [f64] = q, v: &'a [f64] = v, out: &'a mut [f64] = out
        ) => work.accelerate(q, v, out));
    }

    /// Articulated inertias at `q` for [`Self::solve`]. O(n), no allocation.
    pub fn factor(&mut self, q: &[f64]) {
        vectorized!(self.arch, (), (work: &'a mut ArticulatedBody = self, q: &'a [f64] = q) => work.reduce_all(q));
    }

    /// `x := M⁻¹ x` at the configuration last factored: the impulse response of the articulated bodies. O(n), no allocation.
    pub fn solve(&mut self, x: &mut [f64]) {
        vectorized!(self.arch, (), (work: &'a mut ArticulatedBody = self, x: &'a mut [f64] = x) => work.respond(x));
    }

    #[inline(always)]
    fn reduce_all(&mut self, q: &[f64]) {
        for i in 0..self.dof() {
            self.place(i, q[i]);
            self.inertias[i] = self.bodies.inertia(i, &self.poses[i]).matrix();
        }
        for i in (0..self.dof()).rev() {
            self.reduce(i);
        }
    }

    #[inline(always)]
    fn respond(&mut self, x: &mut [f64]) {
        for bias in &mut self.biases {
            *bias = [0.0; 6];
        }
        for i in (0..self.dof()).rev() {
            let bias = self.biases[i];
            x[i] = (x[i] - dot6(&self.poses[i].twist, &bias)) * self.inverse[i];
            let parent = self.bodies.links[i].parent;
            if parent != usize::MAX {
                let handed = axpy6(&bias, x[i], &self.columns[i]);
                self.biases[parent] = add6(&self.biases[parent], &handed);
            }
        }
        for i in 0..self.dof() {
            let parent = self.bodies.links[i].parent;
            let ahead = if parent == usize::MAX { [0.0; 6] } else { self.accelerations[parent] };
            x[i] -= dot6(&self.columns[i], &ahead) * self.inverse[i];
            self.accelerations[i] = axpy6(&ahead, x[i], &self.poses[i].twist);
        }
    }

    #[inline(always)]
    fn place(&mut self, i: usize, q: f64) {
        let parent = self.bodies.links[i].parent;
        self.poses[i] = if parent == usize::MAX {
            self.bodies.pose(i, q, None)
        } else {
            let ahead = self.poses[parent];
            self.bodies.pose(i, q, Some(&ahead))
        };
    }

    /// `U`, `d`, and the inertia handed to the parent (left in its place).
    #[inline(always)]
    fn reduce(&mut self, i: usize) {
        let twist = self.poses[i].twist;
        let column = symmetric_times(&self.inertias[i], &twist);
        let inverse = 1.0 / dot6(&twist, &column);
        self.columns[i] = column;
        self.inverse[i] = inverse;
        let parent = self.bodies.links[i].parent;
        if parent == usize::MAX {
            return;
        }
        let wide = [column[0], column[1], column[2], column[3], column[4], column[5], 0.0, 0.0];
        for r in 0..6 {
            let scale = -column[r] * inverse;
            for c in 0..8 {
                let reduced = scale.mul_add(wide[c], self.inertias[i][r][c]);
                self.inertias[i][r][c] = reduced;
                self.inertias[parent][r][c] += reduced;
            }
        }
    }

    #[inline(always)]
    fn accelerate(&mut self, q: &[f64], v: &[f64], out: &mut [f64]) {
        for i in 0..self.dof() {
            self.place(i, q[i]);
            let pose = &self.poses[i];
            let parent = self.bodies.links[i].parent;
            let ahead = if parent == usize::MAX { [0.0; 6] } else { self.velocities[parent] };
            let velocity = axpy6(&ahead, v[i], &pose.twist);
            let own = array!(6, k => pose.twist[k] * v[i]);
            self.products[i] = bracket(&velocity, &own);
            let inertia: Inertia = self.bodies.inertia(i, pose);
            let mut bias = cross_wrench(&velocity, &inertia.times(&velocity));
            let weight = array!(3, k => self.bodies.gravity[k] * inertia.mass);
            let torque = cross(pose.com, weight);
            for k in 0..3 {
                bias[k] -= torque[k];
                bias[3 + k] -= weight[k];
            }
            self.velocities[i] = velocity;
            self.biases[i] = bias;
            self.inertias[i] = inertia.matrix();
        }
        for i in (0..self.dof()).rev() {
            self.reduce(i);
            let force = -dot6(&self.poses[i].twist, &self.biases[i]);
            self.forces[i] = force;
            let parent = self.bodies.links[i].parent;
            if parent != usize::MAX {
                let moved = symmetric_times(&self.inertias[i], &self.products[i]);
                let handed = axpy6(&moved, force * self.inverse[i], &self.columns[i]);
                self.biases[parent] = add6(&self.biases[parent], &add6(&self.biases[i], &handed));
            }
        }
        for i in 0..self.dof() {
            let parent = self.bodies.links[i].parent;
            let ahead = if parent == usize::MAX { [0.0; 6] } else { self.accelerations[parent] };
            let carried = add6(&ahead, &self.products[i]);
            out[i] = (self.forces[i] - dot6(&self.columns[i], &carried)) * self.inverse[i];
            self.accelerations[i] = axpy6(&carried, out[i], &self.poses[i].twist);
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::pendulum::{Links, initial_conditions, pendulum};
    use delmpc_mechanics::inverse_dynamics::{InverseDynamicsWorkspace, inverse_dynamics_into};
    use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity};
    use delmpc_mechanics::prelude::*;

    /// A tree with three branches, skew axes and turned placements.
    pub fn tree() -> KinematicTree {
        let mut builder = TreeBuilder::fixed_base(Vector3::new(0.3, -0.2, -9.81));
        let inertia = Matrix3::new(0.3, 0.02, -0.01, 0.02, 0.25, 0.03, -0.01, 0.03, 0.2);
        let parents = [None, Some(0), Some(1), Some(1), Some(3), Some(0)];
        for (k, parent) in parents.into_iter().enumerate() {
            let x = k as f64;
            let place = RigidTransform::from_xyz_rpy(
                Vector3::new(0.1 * x, 0.2, -0.5),
                Vector3::new(0.3 * x, -0.2, 0.1 * x),
            );
            let axis = Vector3::new(1.0, x - 2.0, 0.5 * x).normalize();
            let link = LinkInertia::new(1.0 + 0.2 * x, Vector3::new(0.1, -0.05 * x, -0.3), inertia);
            builder.add(Body::new(parent, Joint::revolute(axis, place), link));
        }
        builder.build().unwrap()
    }

    #[test]
    fn inverse_dynamics_gives_the_torques_back() {
        for tree in [tree(), pendulum(Links::Rods, 12).unwrap(), pendulum(Links::UnitInertia, 32).unwrap()] {
            let n = tree.dof();
            let mut work = ArticulatedBody::new(&tree).unwrap();
            let mut kinematics = Kinematics::new(&tree);
            let mut inverse = InverseDynamicsWorkspace::new(&tree);
            for start in initial_conditions(n, 5, 1.5, 7) {
                let mut acceleration = vec![0.0; n];
                work.acceleration_into(&start.q, &start.v, &mut acceleration);
                kinematics
                    .update(&tree, &Configuration::fixed(&start.q), &Velocity::fixed(&start.v))
                    .unwrap();
                let mut torque = vec![0.0; n];
                let rate = Velocity::fixed(&acceleration);
                inverse_dynamics_into(&tree, &kinematics, &rate, &[], &mut inverse, &mut torque).unwrap();
                let size = acceleration.iter().fold(1.0f64, |m, a| m.max(a.abs()));
                let error = torque.iter().fold(0.0f64, |m, t| m.max(t.abs()));
                assert!(error < 1e-11 * (n * n * n) as f64 * size, "{n}: {error:e} of {size:e}");
            }
        }
    }

    #[test]
    fn the_solve_inverts_the_mass_matrix() {
        let tree = tree();
        let n = tree.dof();
        let mut work = ArticulatedBody::new(&tree).unwrap();
        let start = &initial_conditions(n, 1, 1.5, 3)[0];
        let mut integrator_state = State::zeros(&tree);
        integrator_state.q.copy_from_slice(&start.q);
        let mut velocities = delmpc_mechanics::velocity::VelocityWorkspace::new(&tree);
        velocities.set_velocity(&tree, &mut integrator_state, &start.v).unwrap();
        work.factor(&start.q);
        let mut x = integrator_state.p.clone();
        work.solve(&mut x);
        let error = x.iter().zip(&start.v).fold(0.0f64, |m, (a, b)| m.max((a - b).abs()));
        assert!(error < 1e-12, "{error:e}");
    }
}
