//! The cone a foot's wrench must stay in.
//!
//! **Cone of a flat foot** with sole polygon in the plane z = 0, friction μ, normal z: with `W = (τ, f)`
//!
//! | rows | |
//! |---|---|
//! | unilateral | `-f_z <= -f_min` |
//! | friction, m sides inscribed in the cone | `cos θ_i f_x + sin θ_i f_y <= μ cos(π/m) f_z` |
//! | pressure point, one per edge with outward normal `(a, b)` and distance `c` | `-a τ_y + b τ_x <= (c - margin) f_z` |
//! | yaw torque about the middle of the sole | `|τ_z| <= κ f_z` |
//!
//! (pressure point `p = (-τ_y, τ_x)/f_z`).
//!
//! A point has the rows of force alone.
//!
//! Source: M. Vukobratović, B. Borovac, *Zero-moment point*, 2004; S. Caron, Q.-C. Pham, Y. Nakamura, *Stability of surface
//! contacts for humanoid robots*, ICRA 2015, for the shape of the cone.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_lq::lq_problem::{OutputRow, RowTag};
use delmpc_messages::ConstraintKind;

use crate::errors::HorizonError;

/// What a flat foot can transmit.
#[derive(Clone, Debug, PartialEq)]
pub struct FlatFoot {
    /// Corners of the sole in its own frame, counter-clockwise from above, m.
    pub polygon: Vec<[f64; 2]>,
    /// Distance the pressure point keeps from every edge, m.
    pub margin_m: f64,
    /// Coefficient of friction the controller counts on.
    pub friction: f64,
    /// Sides of the friction pyramid.
    pub friction_sides: usize,
    /// Yaw torque per normal force, m.
    pub yaw_arm_m: f64,
    /// Least normal force, N.
    pub min_force_n: f64,
}

/// One row `coefficients · (τ, f) <= bound`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConeRow {
    /// On torque, then force.
    pub coefficients: [f64; 6],
    /// Right-hand side.
    pub bound: f64,
    /// What the row is.
    pub tag: RowTag,
}

/// The rows of a flat foot.
#[derive(Clone, Debug)]
pub struct WrenchCone {
    rows: Vec<ConeRow>,
}

impl WrenchCone {
    /// The cone of `foot` for a robot of `weight` (N). `penalty` is the cost per N of force rows; moment rows count a lever arm
    /// of 0.1 m.
    ///
    /// # Errors
    /// [`HorizonError::Value`] for a degenerate polygon or a number out of range.
    pub fn flat_foot(foot: &FlatFoot, weight: f64, penalty: f64) -> Result<Self, HorizonError> {
        let check = |quantity, value: f64, good: bool, rule| {
            if good && value.is_finite() {
                Ok(())
            } else {
                Err(HorizonError::Value { quantity, index: 0, value, rule })
            }
        };
        check("friction", foot.friction, foot.friction > 0.0, "must be positive")?;
        check("yaw arm", foot.yaw_arm_m, foot.yaw_arm_m > 0.0, "must be positive")?;
        check("least normal force", foot.min_force_n, foot.min_force_n >= 0.0, "must not be negative")?;
        check("weight", weight, weight > 0.0, "must be positive")?;
        check("constraint penalty", penalty, penalty > 0.0, "must be positive")?;
        let sides = foot.friction_sides;
        check("friction sides", sides as f64, (3..=32).contains(&sides), "must be 3 to 32")?;
        check("sole corners", foot.polygon.len() as f64, foot.polygon.len() >= 3, "must be at least 3")?;

        const LEVER: f64 = 0.1;
        let force = |kind: ConstraintKind, row: usize| RowTag {
            label: kind as u32,
            row: row as u32,
            penalty,
            scale: weight,
        };
        let moment = |kind: ConstraintKind, row: usize| RowTag {
            label: kind as u32,
            row: row as u32,
            penalty: penalty / LEVER,
            scale: weight * LEVER,
        };
        let mut rows = vec![ConeRow {
            coefficients: [0.0, 0.0, 0.0, 0.0, 0.0, -1.0],
            bound: -foot.min_force_n,
            tag: force(ConstraintKind::Unilateral, 0),
        }];
        let inscribed = libm::cos(core::f64::consts::PI / sides as f64);
        for i in 0..sides {
            let angle = 2.0 * core::f64::consts::PI * i as f64 / sides as f64;
            rows.push(ConeRow {
                coefficients: [0.0, 0.0, 0.0, libm::cos(angle), libm::sin(angle), -foot.friction * inscribed],
                bound: 0.0,
                tag: force(ConstraintKind::Friction, i),
            });
        }
        for (i, p) in foot.polygon.iter().enumerate() {
            let next = foot.polygon[(i + 1) % foot.polygon.len()];
            let (dx, dy) = (next[0] - p[0], next[1] - p[1]);
            let length = libm::sqrt(dx * dx + dy * dy);
            check("sole edge", length, length > 1e-6, "must have a length")?;
            let (a, b) = (dy / length, -dx / length);
            let reach = a * p[0] + b * p[1] - foot.margin_m;
            check(
                "pressure point margin",
                foot.margin_m,
                reach > 0.0,
                "must leave the sole's centre inside",
            )?;
            rows.push(ConeRow {
                coefficients: [b, -a, 0.0, 0.0, 0.0, -reach],
                bound: 0.0,
                tag: moment(ConstraintKind::CentreOfPressure, i),
            });
        }
        for (i, sign) in [1.0, -1.0].into_iter().enumerate() {
            rows.push(ConeRow {
                coefficients: [0.0, 0.0, sign, 0.0, 0.0, -foot.yaw_arm_m],
                bound: 0.0,
                tag: moment(ConstraintKind::YawTorque, i),
            });
        }
        Ok(Self { rows })
    }

    /// The cone of a point: unilateral and friction rows on `(f_x, f_y, f_z)`, the first three of the coefficients zero.
    ///
    /// # Errors
    /// As [`Self::flat_foot`].
    pub fn point(foot: &FlatFoot, weight: f64, penalty: f64) -> Result<Self, HorizonError> {
        // Any sole: its rows go.
        let side = 1.0 + foot.margin_m;
        let square = vec![[side, side], [-side, side], [-side, -side], [side, -side]];
        let mut cone = Self::flat_foot(&FlatFoot { polygon: square, ..foot.clone() }, weight, penalty)?;
        let of_force = [ConstraintKind::Unilateral as u32, ConstraintKind::Friction as u32];
        cone.rows.retain(|row| of_force.contains(&row.tag.label));
        Ok(cone)
    }

    /// The rows.
    pub fn rows(&self) -> &[ConeRow] {
        &self.rows
    }

    /// The rows on the outputs of a stage, of which the wrench is the first six.
    pub fn output_rows(&self) -> impl Iterator<Item = OutputRow> + '_ {
        self.rows.iter().map(|row| OutputRow { coefficients: row.coefficients.to_vec(), tag: row.tag })
    }
}
