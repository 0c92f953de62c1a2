//! The ground: a plane, boxes on it, gaps in it; all of it may be tilted about the origin of {0}.
//!
//! ```text
//! x = Sᵀ x_w                                               S: slope, from the axes of the ground to {0}
//! plane   φ = z - height                                   (no plane inside a gap)
//! box     φ = max over its six faces of n·(x - face)        negative inside; the face of the maximum is the active one
//! ```
//!
//! Boxes and gaps are given in the axes of the ground. A point sees the surface with the smallest `φ`, and the frame of that face stays
//! the same during a step. The frame's rows are `t1, t2, n`, right-handed; on horizontal ground they are the axes of {0}.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// A box: any orientation about the vertical.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TerrainBox {
    /// Centre, m.
    pub center: Vector3<f64>,
    /// Half of its length, width and height, m.
    pub half_size: Vector3<f64>,
    /// Rotation about the vertical, rad.
    pub yaw: f64,
}

/// A rectangle without ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TerrainGap {
    /// Smallest x and y, m.
    pub min: [f64; 2],
    /// Largest x and y, m.
    pub max: [f64; 2],
}

/// Everything the robot may stand on.
#[derive(Clone, Debug, PartialEq)]
pub struct Terrain {
    /// Height of the plane, m; `None` for no plane.
    pub plane_height: Option<f64>,
    /// Boxes.
    pub boxes: Vec<TerrainBox>,
    /// Gaps in the plane.
    pub gaps: Vec<TerrainGap>,
    /// `S`.
    pub slope: Matrix3<f64>,
}

impl Default for Terrain {
    fn default() -> Self {
        Self::plane(0.0)
    }
}

/// The surface a point sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Distance along the normal, m; negative inside.
    pub gap: f64,
    /// Rows: first tangent, second tangent, normal, in {0}.
    pub frame: Matrix3<f64>,
}

impl Terrain {
    /// A plane and nothing else.
    pub fn plane(height: f64) -> Self {
        Self { plane_height: Some(height), boxes: Vec::new(), gaps: Vec::new(), slope: Matrix3::identity() }
    }

    /// The surface nearest to `x_w`; `None` when there is none at all below it.
    pub fn surface(&self, x_w: &Vector3<f64>) -> Option<Surface> {
        if self.slope == Matrix3::identity() {
            return self.surface_in_ground_axes(x_w);
        }
        let surface = self.surface_in_ground_axes(&self.slope.tr_mul(x_w));
        surface.map(|surface| Surface { frame: surface.frame * self.slope.transpose(), ..surface })
    }

    /// Normal of the plane in {0}.
    pub fn normal_w(&self) -> Vector3<f64> {
        self.slope.column(2).into()
    }

    fn surface_in_ground_axes(&self, x_w: &Vector3<f64>) -> Option<Surface> {
        let mut nearest = self
            .plane_height
            .filter(|_| !self.in_gap(x_w))
            .map(|height| Surface { gap: x_w.z - height, frame: Matrix3::identity() });
        for block in &self.boxes {
            let surface = block.surface(x_w);
            if nearest.is_none_or(|other| surface.gap < other.gap) {
                nearest = Some(surface);
            }
        }
        nearest
    }

    /// Height of the highest ground below or at the place `(x, y)`, in the axes of the ground, m.
    pub fn height_at(&self, x: f64, y: f64) -> Option<f64> {
        let place = Vector3::new(x, y, 0.0);
        let tops = self.boxes.iter().filter(|block| block.covers(&place)).map(TerrainBox::top);
        self.plane_height.filter(|_| !self.in_gap(&place)).into_iter().chain(tops).reduce(f64::max)
    }

    fn in_gap(&self, x: &Vector3<f64>) -> bool {
        self.gaps.iter().any(|gap| (0..2).all(|k| gap.min[k] < x[k] && x[k] < gap.max[k]))
    }
}

impl TerrainBox {
    fn to_box(self, x_w: &Vector3<f64>) -> Vector3<f64> {
        Rotation3::from_axis_angle(&Vector3::z_axis(), -self.yaw) * (x_w - self.center)
    }

    fn covers(&self, x_w: &Vector3<f64>) -> bool {
        let x = self.to_box(x_w);
        x.x.abs() <= self.half_size.x && x.y.abs() <= self.half_size.y
    }

    fn top(&self) -> f64 {
        self.center.z + self.half_size.z
    }

    fn surface(&self, x_w: &Vector3<f64>) -> Surface {
        let x = self.to_box(x_w);
        let outside = x.abs() - self.half_size;
        let axis = outside.imax();
        let mut frame = Matrix3::zeros();
        // The top keeps the axes of the box; other faces are cyclic permutations of them, mirrored pairs swap tangents.
        let sign = if x[axis] < 0.0 { -1.0 } else { 1.0 };
        let (first, second) = ((axis + 1) % 3, (axis + 2) % 3);
        let (first, second) = if sign > 0.0 { (first, second) } else { (second, first) };
        frame[(0, first)] = 1.0;
        frame[(1, second)] = 1.0;
        frame[(2, axis)] = sign;
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), -self.yaw);
        Surface { gap: outside[axis], frame: frame * turn.matrix() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step() -> Terrain {
        let block = TerrainBox {
            center: Vector3::new(1.0, 0.0, 0.1),
            half_size: Vector3::new(0.2, 0.5, 0.1),
            yaw: 0.3,
        };
        let gap = TerrainGap { min: [-1.0, -1.0], max: [-0.5, 1.0] };
        Terrain { boxes: vec![block], gaps: vec![gap], ..Terrain::plane(0.0) }
    }

    #[test]
    fn on_the_plane_the_frame_is_the_world() {
        let surface = step().surface(&Vector3::new(0.0, 0.0, 0.03)).unwrap();
        assert_eq!((surface.gap, surface.frame), (0.03, Matrix3::identity()));
    }

    #[test]
    fn above_a_box_its_top_is_the_ground() {
        let surface = step().surface(&Vector3::new(1.0, 0.1, 0.25)).unwrap();
        assert!((surface.gap - 0.05).abs() < 1e-15);
        assert!((surface.frame.row(2) - Vector3::z().transpose()).amax() < 1e-15);
        assert_eq!(step().height_at(1.0, 0.1), Some(0.2));
    }

    #[test]
    fn frames_are_rotations_and_the_gap_is_their_normal_distance() {
        let terrain = step();
        for x in [[0.7, 0.1, 0.05], [1.3, 0.2, 0.11], [1.0, 0.55, 0.1], [1.0, -0.55, 0.1], [1.0, 0.0, 0.3]] {
            let x = Vector3::from(x);
            let here = terrain.boxes[0].surface(&x);
            assert!((here.frame * here.frame.transpose() - Matrix3::identity()).amax() < 1e-15);
            assert!((here.frame.determinant() - 1.0).abs() < 1e-15);
            let moved = terrain.boxes[0].surface(&(x + here.frame.row(2).transpose() * 1e-3));
            assert!((moved.gap - here.gap - 1e-3).abs() < 1e-15);
        }
    }

    #[test]
    fn a_slope_turns_everything_about_the_origin() {
        let slope = *Rotation3::from_euler_angles(0.05, -0.1, 0.0).matrix();
        let (flat, tilted) = (step(), Terrain { slope, ..step() });
        for x in [[0.0, 0.0, 0.03], [1.0, 0.1, 0.25], [-0.7, 0.0, 0.1], [0.7, 0.1, 0.05]] {
            let x = Vector3::from(x);
            let (here, there) = (flat.surface(&x), tilted.surface(&(slope * x)));
            assert_eq!(here.is_some(), there.is_some());
            let Some((here, there)) = here.zip(there) else { continue };
            assert!((here.gap - there.gap).abs() < 1e-15);
            assert!((there.frame - here.frame * slope.transpose()).amax() < 1e-15);
        }
        assert!((tilted.normal_w() - slope * Vector3::z()).norm() < 1e-15);
    }

    #[test]
    fn there_is_no_ground_in_a_gap() {
        let mut terrain = step();
        terrain.boxes.clear();
        assert!(terrain.surface(&Vector3::new(-0.7, 0.0, 0.1)).is_none());
        assert!(terrain.height_at(-0.7, 0.0).is_none());
    }
}
