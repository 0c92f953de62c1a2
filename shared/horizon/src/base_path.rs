//! The way of a robot that is told a velocity: an arc, with a smooth start and a smooth stop.
//!
//! ```text
//! σ(t) = ∫ r dt,   r a cubic ramp from 0 to 1 after the start and back before the stop
//! heading ψ = ψ_0 + ω σ        place p = p_0 + ∫ R(ψ) v dσ = p_0 + R(ψ_0) [ sin ωσ, cos ωσ - 1; 1 - cos ωσ, sin ωσ ] v / ω
//! ```

use nalgebra::{Vector2, Vector3};

/// Place and motion on the path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathPoint {
    /// Place on the ground, m.
    pub position: Vector2<f64>,
    /// Heading, rad.
    pub yaw: f64,
    /// Velocity, m/s.
    pub velocity: Vector2<f64>,
    /// Acceleration along it, m/s².
    pub acceleration: Vector2<f64>,
    /// Turning, rad/s.
    pub yaw_rate: f64,
}

/// The path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BasePath {
    /// Where it begins, m.
    pub origin: Vector2<f64>,
    /// Heading there, rad.
    pub yaw: f64,
    /// Velocity along the robot's axes, m/s.
    pub velocity: Vector2<f64>,
    /// Turning, rad/s.
    pub yaw_rate: f64,
    /// When it begins, s.
    pub start_s: f64,
    /// When it has stopped, s; infinite: never.
    pub stop_s: f64,
    /// How long start and stop take, s.
    pub ramp_s: f64,
}

impl BasePath {
    /// Stands still for ever.
    pub fn still(origin: Vector2<f64>, yaw: f64) -> Self {
        let (velocity, yaw_rate) = (Vector2::zeros(), 0.0);
        Self { origin, yaw, velocity, yaw_rate, start_s: 0.0, stop_s: f64::INFINITY, ramp_s: 1.0 }
    }

    /// The point at a time.
    pub fn at(&self, time_s: f64) -> PathPoint {
        let (length, rate, change) = self.progress(time_s);
        let (turned, yaw) = (self.yaw_rate * length, self.yaw + self.yaw_rate * length);
        // sin(x)/x and (1 - cos(x))/x times the length, without their 0/0.
        let (a, b) = if turned.abs() > 1e-4 {
            (libm::sin(turned) / self.yaw_rate, (1.0 - libm::cos(turned)) / self.yaw_rate)
        } else {
            (length * (1.0 - turned * turned / 6.0), 0.5 * length * turned)
        };
        let v = self.velocity;
        let way = Vector2::new(a * v.x - b * v.y, b * v.x + a * v.y);
        let along = turned_by(&v, yaw);
        PathPoint {
            position: self.origin + turned_by(&way, self.yaw),
            yaw,
            velocity: along * rate,
            acceleration: along * change + Vector2::new(-along.y, along.x) * (self.yaw_rate * rate * rate),
            yaw_rate: self.yaw_rate * rate,
        }
    }

    /// `σ`, `r` and `ṙ`.
    fn progress(&self, time_s: f64) -> (f64, f64, f64) {
        let ramp = self.ramp_s.max(1e-6);
        // Cubic step and its integral, of a time after the ramp began in ramps.
        let step = |x: f64| x * x * (3.0 - 2.0 * x);
        let integral = |x: f64| x * x * x * (1.0 - 0.5 * x);
        let part = |from_s: f64| {
            let x = ((time_s - from_s) / ramp).max(0.0);
            match x < 1.0 {
                true => (ramp * integral(x), step(x), 6.0 * x * (1.0 - x) / ramp),
                false => (ramp * (x - 0.5), 1.0, 0.0),
            }
        };
        let up = part(self.start_s);
        let begin_stop = (self.stop_s - ramp).max(self.start_s + ramp);
        if !begin_stop.is_finite() {
            return up;
        }
        let down = part(begin_stop);
        (up.0 - down.0, up.1 - down.1, up.2 - down.2)
    }
}

/// A vector on the ground, turned.
pub fn turned_by(v: &Vector2<f64>, yaw: f64) -> Vector2<f64> {
    let (s, c) = (libm::sin(yaw), libm::cos(yaw));
    Vector2::new(c * v.x - s * v.y, s * v.x + c * v.y)
}

/// A point on the ground, or above it.
pub fn with_height(point: &Vector2<f64>, z: f64) -> Vector3<f64> {
    Vector3::new(point.x, point.y, z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn velocity_and_acceleration_are_the_derivatives() {
        let path = BasePath {
            origin: Vector2::new(0.3, -0.2),
            yaw: 0.4,
            velocity: Vector2::new(0.2, 0.05),
            yaw_rate: 0.5,
            start_s: 1.0,
            stop_s: 6.0,
            ramp_s: 0.8,
        };
        let h = 1e-5;
        for k in 0..80 {
            let t = 0.1 * f64::from(k) + 0.013;
            let (before, at, after) = (path.at(t - h), path.at(t), path.at(t + h));
            assert!(((after.position - before.position) / (2.0 * h) - at.velocity).norm() < 1e-8);
            assert!(((after.velocity - before.velocity) / (2.0 * h) - at.acceleration).norm() < 1e-4);
            assert!(((after.yaw - before.yaw) / (2.0 * h) - at.yaw_rate).abs() < 1e-8);
        }
        assert_eq!(path.at(0.5).position, path.origin);
        assert!(path.at(7.0).velocity.norm() < 1e-12);
    }
}
