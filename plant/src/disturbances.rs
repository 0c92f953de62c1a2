//! Disturbances: pushes, wrong masses, other friction.

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::forces::PointForce;
use delmpc_mechanics::tree::{KinematicTree, TreeBuilder};
use nalgebra::Vector3;

use crate::error::{PlantError, require};

/// A constant force on a point of a body for a while.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Push {
    /// Body index.
    pub body: usize,
    /// Point in the body's link frame, m.
    pub point: Vector3<f64>,
    /// Direction in {0}; its length does not matter.
    pub direction_w: Vector3<f64>,
    /// Impulse, N·s.
    pub impulse: f64,
    /// Start, s.
    pub start: f64,
    /// Duration, s.
    pub duration: f64,
}

impl Push {
    pub(crate) fn check(&self, tree: &KinematicTree, time_step: f64) -> Result<(), PlantError> {
        let (got, expected) = (self.body, tree.body_count());
        if got >= expected {
            return Err(PlantError::Shape { quantity: "body of a push", got, expected });
        }
        let length = self.direction_w.norm();
        require(length.is_finite() && length > 0.0, "length of a push's direction", length, "positive")?;
        require(self.impulse.is_finite(), "impulse of a push", self.impulse, "finite")?;
        require(self.start.is_finite() && self.start >= 0.0, "start of a push", self.start, "not negative")?;
        let shortest = 0.999 * time_step;
        require(
            self.duration.is_finite() && self.duration >= shortest,
            "duration of a push",
            self.duration,
            "at least one step",
        )?;
        require(self.point.iter().all(|x| x.is_finite()), "point of a push", f64::NAN, "finite")
    }

    /// Force in {0}, averaged over a step from `time`: the whole impulse is given whatever the step.
    pub fn force_over(&self, time: f64, time_step: f64) -> Vector3<f64> {
        let from = time.max(self.start);
        let until = (time + time_step).min(self.start + self.duration);
        // Steps that touch the interval by rounding do not count.
        let share = (until - from) / time_step;
        if share < 1e-9 {
            return Vector3::zeros();
        }
        self.direction_w.normalize() * (self.impulse / self.duration * share)
    }

    /// The force as the integrator takes it; `None` while it does not act.
    pub(crate) fn point_force(&self, tree: &KinematicTree, time: f64, time_step: f64) -> Option<PointForce> {
        let force_w = self.force_over(time, time_step);
        let point_b = self.point - tree.bodies()[self.body].inertia.com;
        (force_w != Vector3::zeros()).then_some(PointForce { body: self.body, point_b, force_w })
    }
}

/// Factors by which the plant's bodies differ from the model the controller has.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelErrors {
    /// Factor on all masses and inertias.
    pub mass_scale: f64,
    /// Further factor on all inertias about the mass centres.
    pub inertia_scale: f64,
    /// Further factors on mass and inertia of single bodies: (body, factor).
    pub body_mass_scale: Vec<(usize, f64)>,
    /// Shift of every body's mass centre, in its link frame, m. The link frames of a robot at zero angles are parallel as a rule: then
    /// the mass centre of the whole robot shifts by this, while it is near that posture.
    pub com_shift: Vector3<f64>,
    /// Factor on all friction coefficients.
    pub friction_scale: f64,
}

impl Default for ModelErrors {
    fn default() -> Self {
        Self {
            mass_scale: 1.0,
            inertia_scale: 1.0,
            body_mass_scale: Vec::new(),
            com_shift: Vector3::zeros(),
            friction_scale: 1.0,
        }
    }
}

impl ModelErrors {
    /// The tree with these errors.
    ///
    /// # Errors
    /// [`PlantError`] for factors that are not positive, bodies that do not exist, or a model that breaks by them.
    pub fn apply(&self, tree: &KinematicTree) -> Result<KinematicTree, PlantError> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        require(positive(self.mass_scale), "mass factor", self.mass_scale, "positive")?;
        require(positive(self.inertia_scale), "inertia factor", self.inertia_scale, "positive")?;
        let friction = self.friction_scale;
        require(friction.is_finite() && friction >= 0.0, "friction factor", friction, "not negative")?;
        let shift = self.com_shift;
        require(shift.iter().all(|x| x.is_finite()), "shift of the mass centres", shift.amax(), "finite")?;
        if *self == (Self { friction_scale: friction, ..Self::default() }) {
            return Ok(tree.clone());
        }
        let mut factors = vec![self.mass_scale; tree.body_count()];
        for &(body, factor) in &self.body_mass_scale {
            require(positive(factor), "mass factor of a body", factor, "positive")?;
            let expected = tree.body_count();
            *factors.get_mut(body).ok_or(PlantError::Shape {
                quantity: "body of a mass factor",
                got: body,
                expected,
            })? *= factor;
        }
        let mut bodies = tree.bodies().iter().zip(&factors).map(|(body, factor)| {
            let mut body = *body;
            body.inertia.mass *= factor;
            body.inertia.com += shift;
            body.inertia.inertia *= factor * self.inertia_scale;
            body
        });
        let mut builder = TreeBuilder::fixed_base(*tree.gravity_w());
        if tree.is_floating() {
            let Some(base) = bodies.next() else { return Err(ModelError::Empty.into()) };
            builder = TreeBuilder::floating_base(*tree.gravity_w(), base.inertia);
            builder.set_base_wrenches(base.drag, base.constant_wrench_b);
        }
        for body in bodies {
            builder.add(body);
        }
        builder.accept_unreal_inertia();
        Ok(builder.build()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_impulse_is_exact_for_any_step_and_offset() {
        for (start, duration, dt) in
            [(0.1, 0.1, 1e-3), (0.1003, 0.0997, 1e-3), (0.2, 0.0017, 5e-4), (0.05, 0.3, 7e-3)]
        {
            let push = Push {
                body: 0,
                point: Vector3::zeros(),
                direction_w: Vector3::new(0.0, 2.0, 0.0),
                impulse: 15.0,
                start,
                duration,
            };
            let steps = (1.0 / dt) as usize;
            let sum: Vector3<f64> = (0..steps).map(|k| push.force_over(k as f64 * dt, dt) * dt).sum();
            assert!((sum - Vector3::new(0.0, 15.0, 0.0)).amax() < 1e-9, "{sum}");
        }
    }
}
