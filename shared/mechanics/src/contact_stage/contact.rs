//! Contacts: where they are, their rows as wrenches in {0}.
//!
//! Letters and equations: [`super`].

use nalgebra::{Matrix3, Vector3};

use crate::errors::ModelError;
use crate::spatial::{RigidTransform, Twist, Wrench};
use crate::tree::KinematicTree;

/// Most rows of one contact.
pub const MAX_ROWS: usize = 6;

/// Whether a contact holds a point or a flat foot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ContactKind {
    /// Three rows: position along the ground axes `(t1, t2, n)`.
    Point,
    /// Six rows: rotation about the ground axes, then position along them.
    Foot,
}

impl ContactKind {
    /// Rows before any are left out: 3 or 6.
    pub fn rows(self) -> usize {
        match self {
            Self::Point => 3,
            Self::Foot => 6,
        }
    }
}

/// A place of a body that may stand on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Body index.
    pub body: usize,
    /// Point or flat foot.
    pub kind: ContactKind,
    /// Contact point in the *link frame* of the body, m (as in [`crate::constraints::ConstraintKind`]).
    pub point_l: Vector3<f64>,
    /// Axes of the sole in link axes (columns); only a foot has them.
    pub sole_l: Matrix3<f64>,
    /// Ground axes `t1, t2, n` in {0} (columns).
    pub axes_w: Matrix3<f64>,
    /// Bit k set: row k of the 3 or 6 is held. Planar robots keep `(x, z)` of a point, `(pitch, x, z)` of a foot.
    pub row_mask: u8,
}

impl Contact {
    /// A point of `body` (link frame, m) on level ground, all rows.
    pub fn point(body: usize, point_l: Vector3<f64>) -> Self {
        Self {
            body,
            kind: ContactKind::Point,
            point_l,
            sole_l: Matrix3::identity(),
            axes_w: Matrix3::identity(),
            row_mask: u8::MAX,
        }
    }

    /// A flat foot of `body` with its reference point (link frame, m) and sole axes (link axes) on level ground, all rows.
    pub fn foot(body: usize, point_l: Vector3<f64>, sole_l: Matrix3<f64>) -> Self {
        Self { kind: ContactKind::Foot, sole_l, ..Self::point(body, point_l) }
    }

    /// The same on ground with other axes (columns `t1, t2, n` in {0}).
    pub fn on(self, axes_w: Matrix3<f64>) -> Self {
        Self { axes_w, ..self }
    }

    /// The same with only the listed rows (0-based).
    pub fn rows(self, rows: &[usize]) -> Self {
        Self { row_mask: rows.iter().fold(0, |mask, row| mask | 1 << row), ..self }
    }

    /// Number of rows held.
    pub fn row_count(&self) -> usize {
        self.kept().count()
    }

    /// The rows held, of [`ContactKind::rows`].
    pub fn kept(&self) -> impl Iterator<Item = usize> + use<> {
        let mask = self.row_mask;
        (0..self.kind.rows()).filter(move |row| mask & (1 << row) != 0)
    }

    /// # Errors
    /// [`ModelError::Unsupported`] for a body that does not exist or no rows; [`ModelError::NotFinite`].
    pub(crate) fn check(&self, tree: &KinematicTree) -> Result<(), ModelError> {
        let body = self.body;
        if body >= tree.body_count() {
            return Err(ModelError::Unsupported { body, reason: "a contact names no body" });
        }
        if self.row_count() == 0 {
            return Err(ModelError::Unsupported { body, reason: "a contact holds no row" });
        }
        for (quantity, values) in [
            ("contact point", self.point_l.as_slice()),
            ("sole axes", self.sole_l.as_slice()),
            ("ground axes", self.axes_w.as_slice()),
        ] {
            if !values.iter().all(|x| x.is_finite()) {
                return Err(ModelError::NotFinite { body, quantity });
            }
        }
        Ok(())
    }

    /// Contact point from the mass centre of the body, link axes.
    pub(crate) fn point_b(&self, tree: &KinematicTree) -> Vector3<f64> {
        self.point_l - tree.bodies()[self.body].inertia.com
    }
}

/// A contact at one pose of its body, in {0}.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Contact point `x`, m.
    pub point_w: Vector3<f64>,
    /// Sole axes `R_f`.
    pub sole_w: Matrix3<f64>,
}

impl Placement {
    /// Of `contact` when the mass-centre frame of its body (link axes) is at `pose_w`.
    pub fn at(tree: &KinematicTree, contact: &Contact, pose_w: &RigidTransform) -> Self {
        Self {
            point_w: pose_w.transform_point(&contact.point_b(tree)),
            sole_w: pose_w.rotation * contact.sole_l,
        }
    }

    /// Row `row` of the velocity map `C` as a wrench: `y_row = W·v_b`, and the wrench of a unit multiplier.
    pub(crate) fn force_row(&self, contact: &Contact, row: usize) -> Wrench {
        match angular_axis(contact, row) {
            Some(axis) => Wrench::new(contact.axes_w.column(axis).into_owned(), Vector3::zeros()),
            None => point_row(&self.point_w, contact, row),
        }
    }

    /// Row `row` of `∂h/∂η` at this node: `C_h` of [`super`].
    pub(crate) fn gradient_row(&self, contact: &Contact, start: &Placement, row: usize) -> Wrench {
        match angular_axis(contact, row) {
            Some(axis) => {
                let turn = turn_gradient(&start.sole_w, &self.sole_w);
                Wrench::new(turn.tr_mul(&contact.axes_w.column(axis)), Vector3::zeros())
            }
            None => point_row(&self.point_w, contact, row),
        }
    }

    /// The same for the pose at the start of the stage, with the sign of `C_h0`: `δh = .. - C_h0 η^0`.
    pub(crate) fn start_gradient_row(&self, contact: &Contact, node: &Placement, row: usize) -> Wrench {
        match angular_axis(contact, row) {
            Some(axis) => {
                let turn = turn_gradient(&self.sole_w, &node.sole_w);
                Wrench::new(turn * contact.axes_w.column(axis), Vector3::zeros())
            }
            None => point_row(&self.point_w, contact, row),
        }
    }

    /// `h_row`: how far this node is off the leaf through `start`.
    pub(crate) fn defect(&self, contact: &Contact, start: &Placement, row: usize) -> f64 {
        match angular_axis(contact, row) {
            Some(axis) => {
                let mut turn = Vector3::zeros();
                for j in 0..3 {
                    turn += start.sole_w.column(j).cross(&self.sole_w.column(j)) * 0.5;
                }
                contact.axes_w.column(axis).dot(&turn)
            }
            None => contact.axes_w.column(point_axis(contact, row)).dot(&(self.point_w - start.point_w)),
        }
    }

    /// `W'` of `δy_row = W·ν_b + W'·η_b` for a body that moves with `velocity_w`.
    pub(crate) fn transport_row(&self, contact: &Contact, row: usize, velocity_w: &Twist) -> Wrench {
        let moving = match angular_axis(contact, row) {
            Some(axis) => velocity_w.angular.cross(&contact.axes_w.column(axis)),
            None => {
                let point_velocity = velocity_w.linear + velocity_w.angular.cross(&self.point_w);
                point_velocity.cross(&contact.axes_w.column(point_axis(contact, row)))
            }
        };
        Wrench::new(moving, Vector3::zeros())
    }
}

/// The ground axis of a rotation row.
pub(crate) fn angular_axis(contact: &Contact, row: usize) -> Option<usize> {
    (contact.kind == ContactKind::Foot && row < 3).then_some(row)
}

/// The ground axis of a position row.
pub(crate) fn point_axis(contact: &Contact, row: usize) -> usize {
    match contact.kind {
        ContactKind::Point => row,
        ContactKind::Foot => row - 3,
    }
}

fn point_row(point_w: &Vector3<f64>, contact: &Contact, row: usize) -> Wrench {
    let axis = contact.axes_w.column(point_axis(contact, row)).into_owned();
    Wrench::new(point_w.cross(&axis), axis)
}

/// `E = ½(tr(R_f^0ᵀ R_f) 1 - R_f R_f^0ᵀ)`.
fn turn_gradient(start: &Matrix3<f64>, node: &Matrix3<f64>) -> Matrix3<f64> {
    (Matrix3::identity() * start.tr_mul(node).trace() - node * start.transpose()) * 0.5
}

impl Placement {
    /// Before any evaluation.
    pub(super) fn none() -> Self {
        Self { point_w: Vector3::zeros(), sole_w: Matrix3::identity() }
    }
}
