//! Mesh files of a robot: found by the names that its URDF has for them, read as triangles.
//!
//! | name | where it is looked for |
//! |---|---|
//! | `file:///a/b.stl`, `/a/b.stl` | there |
//! | `meshes/b.stl` | from the folder of the URDF |
//! | `package://robot/meshes/b.stl` | `robot/meshes/b.stl` and `meshes/b.stl` in that folder and in those above it |
//!
//! Read are STL, OBJ and COLLADA files of up to 64 MB.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use delmpc_mechanics::prelude::RigidTransform;
use delmpc_robots::{Mesh, RobotModel};
use mesh_loader::Loader;
use nalgebra::Vector3;

use crate::input_file;

/// Larger files are not read, bytes.
const MOST_BYTES: u64 = 64 << 20;

/// Triangles in the axes of the body that carries the mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Triangles {
    /// Corners, m.
    pub points: Vec<Vector3<f64>>,
    /// Three corners each, as indices.
    pub faces: Vec<[usize; 3]>,
}

impl Triangles {
    /// The same surface with at most that many triangles: corners that share a cell of a grid become one, in their middle (vertex
    /// clustering); the grid is as fine as it can be. O(n) for every grid tried, about ten.
    #[must_use]
    pub fn simplified(self, most: usize) -> Self {
        let mut cells = 256.0;
        let mut surface = self.clustered(1024.0);
        while surface.faces.len() > most && cells > 1.0 {
            surface = self.clustered(cells);
            cells /= 1.3;
        }
        surface
    }

    /// With corners joined on a grid of that many cells along the diagonal.
    fn clustered(&self, cells: f64) -> Self {
        let (low, high) = self.bounds();
        let cell = ((high - low).norm() / cells).max(1e-9);
        let mut places: HashMap<[i64; 3], usize> = HashMap::new();
        let mut sums: Vec<(Vector3<f64>, f64)> = Vec::new();
        let mut of_corner = Vec::with_capacity(self.points.len());
        for point in &self.points {
            let key = ((point - low) / cell).map(|x| x.floor() as i64).into();
            let place = *places.entry(key).or_insert_with(|| {
                sums.push((Vector3::zeros(), 0.0));
                sums.len() - 1
            });
            sums[place].0 += point;
            sums[place].1 += 1.0;
            of_corner.push(place);
        }
        let mut seen = HashSet::new();
        let mut faces = Vec::new();
        for face in &self.faces {
            let [a, b, c] = face.map(|corner| of_corner[corner]);
            let mut sorted = [a, b, c];
            sorted.sort_unstable();
            if a != b && b != c && c != a && seen.insert(sorted) {
                faces.push([a, b, c]);
            }
        }
        Self { points: sums.into_iter().map(|(sum, count)| sum / count).collect(), faces }
    }

    /// Smallest and largest coordinates.
    pub fn bounds(&self) -> (Vector3<f64>, Vector3<f64>) {
        let start = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        self.points.iter().fold(start, |(low, high), point| (low.inf(point), high.sup(point)))
    }
}

/// The folder that names of meshes are relative to.
pub fn folder_of(robot: &RobotModel) -> PathBuf {
    let folder = robot.mesh_folder.clone();
    folder.unwrap_or_else(|| robot.file.parent().map(Path::to_owned).unwrap_or_default())
}

/// Reads a mesh of a robot; `None` when its file is not there or cannot be read.
pub fn read(robot: &RobotModel, mesh: &Mesh) -> Option<Triangles> {
    let path = find(&folder_of(robot), &mesh.file)?;
    let bytes = input_file::read_bytes(&path, MOST_BYTES).ok()?;
    // Names end in .STL as well.
    let lower = PathBuf::from(path.to_string_lossy().to_lowercase());
    let scene = Loader::default().merge_meshes(true).load_from_slice(&bytes, lower).ok()?;
    let mesh_data = scene.meshes.into_iter().next()?;
    let pose: &RigidTransform = &mesh.attachment.pose;
    let to_body = |vertex: &[f32; 3]| {
        let vertex = Vector3::from(vertex.map(f64::from)).component_mul(&mesh.scale);
        pose.transform_point(&vertex)
    };
    let points: Vec<Vector3<f64>> = mesh_data.vertices.iter().map(to_body).collect();
    let faces = mesh_data.faces.iter().map(|face| face.map(|corner| corner as usize));
    let sound_face = |face: &[usize; 3]| face.iter().all(|corner| *corner < points.len());
    // A mirrored surface is seen from its other side.
    let mirrored = mesh.scale.product() < 0.0;
    let outwards = |[a, b, c]: [usize; 3]| if mirrored { [a, c, b] } else { [a, b, c] };
    let faces: Vec<[usize; 3]> = faces.filter(sound_face).map(outwards).collect();
    let sound = !points.is_empty() && points.iter().all(|point| point.iter().all(|x| x.is_finite()));
    sound.then_some(Triangles { points, faces })
}

/// Where the file of that name is.
fn find(folder: &Path, name: &str) -> Option<PathBuf> {
    let present = |path: PathBuf| path.is_file().then_some(path);
    if let Some(path) = name.strip_prefix("file://") {
        return present(PathBuf::from(path));
    }
    let Some(rest) = name.strip_prefix("package://").or_else(|| name.strip_prefix("model://")) else {
        return present(folder.join(name));
    };
    let rest = rest.trim_start_matches('/');
    let inside = rest.split_once('/').map(|(_, inside)| inside);
    let folder = folder.canonicalize().ok()?;
    folder.ancestors().find_map(|above| {
        present(above.join(rest)).or_else(|| inside.and_then(|inside| present(above.join(inside))))
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
mod tests {
    use super::*;

    #[test]
    fn a_simplified_surface_is_near_the_whole_one() {
        // A sphere of 2 x 60 x 60 triangles.
        let at = |i: usize, j: usize| {
            let (a, b) = (std::f64::consts::TAU * i as f64 / 60.0, std::f64::consts::PI * j as f64 / 60.0);
            Vector3::new(b.sin() * a.cos(), b.sin() * a.sin(), b.cos())
        };
        let points: Vec<_> = (0..=60).flat_map(|j| (0..60).map(move |i| at(i, j))).collect();
        let corner = |i: usize, j: usize| j * 60 + i % 60;
        let quads = (0..60).flat_map(|j| (0..60).map(move |i| (i, j)));
        let faces: Vec<_> = quads
            .flat_map(|(i, j)| {
                let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        let whole = Triangles { points, faces };
        let few = whole.clone().simplified(500);
        assert!((100..=500).contains(&few.faces.len()), "{}", few.faces.len());
        assert!(few.points.iter().all(|point| (0.8..=1.0 + 1e-12).contains(&point.norm())));
        let same = whole.clone().simplified(100_000);
        assert!(same.faces.len() > 6000);
    }

    #[test]
    fn files_are_found_by_the_names_of_the_field() {
        let root = std::env::temp_dir().join(format!("delmpc-mesh-{}", std::process::id()));
        let urdf = root.join("robot/urdf");
        std::fs::create_dir_all(&urdf).unwrap();
        std::fs::create_dir_all(root.join("robot/meshes")).unwrap();
        let file = root.join("robot/meshes/a.stl");
        std::fs::write(&file, "solid").unwrap();
        let found = |name: &str| find(&urdf, name).map(|path| path.canonicalize().unwrap());
        let file = file.canonicalize().unwrap();
        for name in ["package://robot/meshes/a.stl", "package:///meshes/a.stl", "../meshes/a.stl"] {
            assert_eq!(found(name).as_ref(), Some(&file), "{name}");
        }
        assert_eq!(found(&format!("file://{}", file.display())), Some(file));
        assert_eq!(found("package://robot/meshes/b.stl"), None);
        std::fs::remove_dir_all(root).unwrap();
    }
}
