//! `delmpc model --svg`: a robot in its postures, as a drawing.
//!
//! The primitives are cut into small flat pieces, projected in parallel, and painted from far to near (painter's algorithm; small pieces
//! keep it right where shapes touch). Cost: O(n log n) in the pieces, a few thousand for a humanoid.

use std::f64::consts::{FRAC_PI_2, PI};
use std::fmt::Write as _;

use delmpc_mechanics::errors::ModelError;
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{Geometry, Posture, RobotModel};
use nalgebra::{Vector2, Vector3};

use crate::report::scene::{Drawn, DrawnSurface, drawn};

/// Largest edge of a piece of a box (m).
const PIECE_M: f64 = 0.08;
/// Segments of a round shape.
const SEGMENTS: usize = 20;
/// From where it is seen: angles from the front to the left, and up (rad).
const AZIMUTH: f64 = 0.87;
const ELEVATION: f64 = 0.2;
/// Height of the tallest posture in the drawing, and the room around (pixels).
const HEIGHT: f64 = 300.0;
const ROOM: f64 = 36.0;
const CAPTION: f64 = 34.0;
const TITLE: f64 = 58.0;
/// Least width of the drawing, for its title (pixels).
const WIDTH: f64 = 380.0;
/// Triangles of all meshes in all postures.
const TRIANGLES: usize = 12_000;
/// Most postures in a row.
const COLUMNS: usize = 4;
const DEFAULT_COLOUR: [f64; 3] = [0.42, 0.48, 0.55];

/// A flat convex piece of a surface.
struct Piece {
    corners: Vec<Vector3<f64>>,
    normal: Vector3<f64>,
    colour: [f64; 3],
}

/// Where a viewer at infinity is.
struct Eye {
    right: Vector3<f64>,
    up: Vector3<f64>,
    back: Vector3<f64>,
}

impl Eye {
    fn new() -> Self {
        let right = Vector3::new(-AZIMUTH.sin(), AZIMUTH.cos(), 0.0);
        let back =
            Vector3::new(ELEVATION.cos() * AZIMUTH.cos(), ELEVATION.cos() * AZIMUTH.sin(), ELEVATION.sin());
        Self { right, up: back.cross(&right), back }
    }

    /// To the right and downwards, m.
    fn see(&self, point: &Vector3<f64>) -> Vector2<f64> {
        Vector2::new(self.right.dot(point), -self.up.dot(point))
    }
}

/// The drawing of a robot in all its postures, or with all joints at zero when it has none, as an SVG document.
///
/// # Errors
/// When a posture does not fit the tree.
pub fn drawing(robot: &RobotModel) -> Result<String, ModelError> {
    let zero = Posture {
        name: "all joints at zero".to_owned(),
        base_link_pose_w: None,
        q: vec![0.0; robot.joint_names.len()],
    };
    let postures = if robot.postures.is_empty() { std::slice::from_ref(&zero) } else { &robot.postures };
    let eye = Eye::new();
    let drawn = drawn(robot, TRIANGLES / postures.len());
    let mut figures = Vec::new();
    for posture in postures {
        let mut pieces = pieces(robot, &drawn, posture, &eye)?;
        pieces.retain(|piece| piece.normal.dot(&eye.back) > 0.0);
        let depth = |piece: &Piece| {
            piece.corners.iter().sum::<Vector3<f64>>().dot(&eye.back) / piece.corners.len() as f64
        };
        pieces.sort_by(|a, b| depth(a).total_cmp(&depth(b)));
        figures.push((posture.name.as_str(), pieces));
    }
    let bounds = figures.iter().map(|(_, pieces)| Bounds::of(pieces, &eye)).collect::<Vec<_>>();
    let largest =
        bounds.iter().fold(Vector2::new(0.1, 0.1), |size: Vector2<f64>, bounds| size.sup(&bounds.size()));
    let scale = HEIGHT / largest.y.max(0.5 * largest.x);
    let columns = figures.len().min(COLUMNS);
    let rows = figures.len().div_ceil(columns);
    let cell = Vector2::new(
        (largest.x * scale + 2.0 * ROOM).max(WIDTH / columns as f64),
        largest.y * scale + ROOM + CAPTION,
    );
    let (width, height) = (columns as f64 * cell.x, TITLE + rows as f64 * cell.y);

    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.0} {height:.0}\" \
         font-family=\"system-ui, 'Noto Sans', 'Liberation Sans', Arial, sans-serif\" fill=\"#17202b\">\n\
         <rect width=\"100%\" height=\"100%\" rx=\"14\" fill=\"#f6f7f9\"/>\n"
    );
    let (joints, mass) = (robot.joint_names.len(), robot.tree.total_mass());
    let _ = writeln!(
        text,
        "<text x=\"{ROOM}\" y=\"36\" font-size=\"20\" font-weight=\"650\">{}<tspan dx=\"12\" font-size=\"14\" font-weight=\"400\" \
         fill=\"#556273\">{joints} joints, {mass:.1} kg</tspan></text>",
        escaped(&robot.name)
    );
    for (index, ((name, pieces), bounds)) in figures.iter().zip(&bounds).enumerate() {
        let corner =
            Vector2::new((index % columns) as f64 * cell.x, TITLE + (index / columns) as f64 * cell.y);
        // Feet of all postures at the same height.
        let shift = corner
            + Vector2::new(
                cell.x / 2.0 - scale * (bounds.low.x + bounds.high.x) / 2.0,
                cell.y - CAPTION - scale * bounds.high.y,
            );
        let _ = writeln!(text, "<g stroke-linejoin=\"round\" stroke-width=\"1.1\">");
        for piece in pieces {
            let points = piece.corners.iter().map(|corner| {
                let at = shift + scale * eye.see(corner);
                format!("{:.1},{:.1}", at.x, at.y)
            });
            let colour = shaded(piece);
            let points = points.collect::<Vec<_>>().join(" ");
            let _ = writeln!(text, "<polygon points=\"{points}\" fill=\"{colour}\" stroke=\"{colour}\"/>");
        }
        let middle = corner.x + cell.x / 2.0;
        let _ = writeln!(
            text,
            "</g>\n<text x=\"{middle:.1}\" y=\"{:.1}\" font-size=\"13\" text-anchor=\"middle\" fill=\"#556273\">{}</text>",
            corner.y + cell.y - 12.0,
            escaped(name)
        );
    }
    text.push_str("</svg>\n");
    Ok(text)
}

/// What a drawing covers, m.
struct Bounds {
    low: Vector2<f64>,
    high: Vector2<f64>,
}

impl Bounds {
    fn of(pieces: &[Piece], eye: &Eye) -> Self {
        let points = pieces.iter().flat_map(|piece| &piece.corners).map(|corner| eye.see(corner));
        let start = (Vector2::repeat(f64::INFINITY), Vector2::repeat(f64::NEG_INFINITY));
        let (low, high) = points.fold(start, |(low, high), point| (low.inf(&point), high.sup(&point)));
        if low.x.is_finite() {
            Self { low, high }
        } else {
            Self { low: Vector2::zeros(), high: Vector2::zeros() }
        }
    }

    fn size(&self) -> Vector2<f64> {
        self.high - self.low
    }
}

/// All surfaces of a posture in the world.
fn pieces(robot: &RobotModel, drawn: &Drawn, posture: &Posture, eye: &Eye) -> Result<Vec<Piece>, ModelError> {
    let tree = &robot.tree;
    let mut kinematics = Kinematics::new(tree);
    let configuration = if tree.is_floating() {
        let base = robot.base_pose_w(posture).unwrap_or_else(RigidTransform::identity);
        Configuration::floating(base, &posture.q)
    } else {
        Configuration::fixed(&posture.q)
    };
    kinematics.update_positions(tree, &configuration)?;
    let mut all = Vec::new();
    for shape in &drawn.shapes {
        let body = shape
            .attachment
            .body
            .map_or_else(RigidTransform::identity, |body| kinematics.link_poses_w()[body]);
        let pose = body * shape.attachment.pose;
        let colour = shape.rgba.map_or(DEFAULT_COLOUR, |[red, green, blue, _]| [red, green, blue]);
        for quad in surface(&shape.geometry) {
            let corners: Vec<Vector3<f64>> = quad.iter().map(|corner| pose.transform_point(corner)).collect();
            let normal = (corners[2] - corners[0]).cross(&(corners[3] - corners[1]));
            // A quad at a pole is a triangle; one without any area shows nothing.
            if let Some(normal) = normal.try_normalize(1e-12) {
                all.push(Piece { corners, normal, colour });
            }
        }
    }
    for DrawnSurface { body, surface, rgba, .. } in &drawn.meshes {
        let pose = body.map_or_else(RigidTransform::identity, |body| kinematics.link_poses_w()[body]);
        let colour = rgba.map_or(DEFAULT_COLOUR, |[red, green, blue, _]| [red, green, blue]);
        let points: Vec<Vector3<f64>> =
            surface.points.iter().map(|point| pose.transform_point(point)).collect();
        for face in &surface.faces {
            let corners = face.map(|corner| points[corner]);
            let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
            // Files do not agree on which side is outside: both are shown.
            let towards = if normal.dot(&eye.back) < 0.0 { -normal } else { normal };
            if let Some(normal) = towards.try_normalize(1e-12) {
                all.push(Piece { corners: corners.to_vec(), normal, colour });
            }
        }
    }
    Ok(all)
}

type Quad = [Vector3<f64>; 4];

/// The surface of a primitive in its own axes, corners counter-clockwise from outside.
fn surface(geometry: &Geometry) -> Vec<Quad> {
    let quarter = |radius: f64, height: f64, from: f64| {
        (0..=6).map(move |step| {
            let angle = from + FRAC_PI_2 * f64::from(step) / 6.0;
            Vector2::new(radius * angle.cos(), height + radius * angle.sin())
        })
    };
    match *geometry {
        Geometry::Box { size } => box_surface(&size),
        Geometry::Cylinder { radius, length } => {
            let z = length / 2.0;
            let profile = [
                [0.0, -z],
                [radius / 2.0, -z],
                [radius, -z],
                [radius, 0.0],
                [radius, z],
                [radius / 2.0, z],
                [0.0, z],
            ];
            lathe(&profile.map(Vector2::from))
        }
        Geometry::Capsule { radius, length } => {
            let lower = quarter(radius, -length / 2.0, -FRAC_PI_2);
            lathe(&lower.chain(quarter(radius, length / 2.0, 0.0)).collect::<Vec<_>>())
        }
        Geometry::Sphere { radius } => lathe(
            &quarter(radius, 0.0, -FRAC_PI_2).chain(quarter(radius, 0.0, 0.0).skip(1)).collect::<Vec<_>>(),
        ),
    }
}

fn box_surface(size: &Vector3<f64>) -> Vec<Quad> {
    let mut quads = Vec::new();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let cells = [u, v].map(|side| (size[side] / PIECE_M).ceil().clamp(1.0, 32.0));
        for side in [-0.5, 0.5] {
            for (i, j) in (0..cells[0] as usize).flat_map(|i| (0..cells[1] as usize).map(move |j| (i, j))) {
                let corner = |a: usize, b: usize| {
                    let mut point = Vector3::zeros();
                    point[axis] = side * size[axis];
                    point[u] = ((i + a) as f64 / cells[0] - 0.5) * size[u];
                    point[v] = ((j + b) as f64 / cells[1] - 0.5) * size[v];
                    point
                };
                let mut quad = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                if side < 0.0 {
                    quad.reverse();
                }
                quads.push(quad);
            }
        }
    }
    quads
}

/// A profile of (radius, height), from below, turned about z.
fn lathe(profile: &[Vector2<f64>]) -> Vec<Quad> {
    let at = |point: &Vector2<f64>, step: usize| {
        let angle = 2.0 * PI * step as f64 / SEGMENTS as f64;
        Vector3::new(point.x * angle.cos(), point.x * angle.sin(), point.y)
    };
    let bands = profile.iter().zip(profile.iter().skip(1));
    let quads = bands.flat_map(|(low, high)| {
        (0..SEGMENTS).map(move |step| [at(low, step), at(low, step + 1), at(high, step + 1), at(high, step)])
    });
    quads.collect()
}

/// The colour in the light from above, the front and the left.
fn shaded(piece: &Piece) -> String {
    let light = Vector3::new(0.55, 0.35, 1.0).normalize();
    let bright = 0.62 + 0.12 * piece.normal.z + 0.42 * piece.normal.dot(&light).max(0.0);
    let [red, green, blue] =
        piece.colour.map(|part| (255.0 * part * bright + 14.0).clamp(0.0, 255.0).round() as u8);
    format!("#{red:02x}{green:02x}{blue:02x}")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn surfaces_are_closed_and_face_outwards() {
        let shapes = [
            Geometry::Box { size: Vector3::new(0.3, 0.5, 0.1) },
            Geometry::Cylinder { radius: 0.1, length: 0.4 },
            Geometry::Capsule { radius: 0.1, length: 0.4 },
            Geometry::Sphere { radius: 0.2 },
        ];
        for shape in shapes {
            let mut area = Vector3::zeros();
            for quad in surface(&shape) {
                let normal = (quad[2] - quad[0]).cross(&(quad[3] - quad[1])) / 2.0;
                let middle = quad.iter().sum::<Vector3<f64>>() / 4.0;
                assert!(normal.dot(&middle) > -1e-12, "{shape:?}: {quad:?}");
                area += normal;
            }
            assert!(area.norm() < 1e-12, "{shape:?} is open: {area}");
        }
    }
}
